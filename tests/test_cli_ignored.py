"""Options that would be ignored, and streams that cannot be written."""

import errno
import io
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from depthpose.cli import lasting_streams, main
from depthpose.cli.depth.options import MatcherOptions
from depthpose.cli.ignored_options import refuse_ignored
from depthpose.core.errors import InputError

IGNORED = [
    ("pose predict", "--method register --cad p.stl --weights parts", "--weights"),
    ("pose predict", "--voting least-squares --method=register", "--voting"),
    ("pose track", "--method register --weights ycb", "--weights"),
    ("pose track", "--method register --device cuda", "--device"),
    ("pose predict", "--voting least-squares --hypotheses 64", "--hypotheses"),
    ("pose predict", "--hypotheses=64 --voting=least-squares", "--hypotheses"),
    ("pose predict", "--depth d.png --camera c.json --batch 4", "--batch"),
    ("pose predict", "--cad p.stl --cloud c.ply --method network", "--cad"),
    ("pose predict", "--cad p.stl --cloud c.ply --batch 4", "--batch"),
    ("pose predict", "--bop b --masks truth --mask m", "--mask"),
    ("pose predict", "--bop b --engine ray", "--engine"),
    ("pose predict", "--depth d --mask m --camera c --masks truth", "--masks"),
    ("pose track", "--depth d --camera c --split test", "--split"),
    ("pose evaluate", "--bop b --csv a.csv --no-icp --masks truth", "--masks and --no-icp"),
    ("pose evaluate", "--bop b --weights register --voting ransac", "--voting"),
    ("depth predict", "a.png --answer own --max_memory 1GB", "--max_memory"),
    ("depth predict", "a.png --camera c --focal-px 7 --fov 9", "--focal-px and --fov"),
    ("depth predict", "a.png --block 8 --workers 2", "--workers and --block"),
    ("depth match", "l r --engine ray --worker-gpus 1", "--worker-gpus"),
    ("depth match", "l r --matcher sgbm --left-right-check", "--left-right-check"),
    ("depth evaluate", "--weights a --holes leave", "--holes"),
    ("depth evaluate", "--weights a --train t", "--train"),
    ("depth evaluate", "--baseline rows --train-without a", "--train-without"),
    ("depth evaluate", "--weights quick:a fine:b --speed fine", "--speed"),
    ("depth evaluate", "--weights own:a --precision bf16", "--precision"),
    ("depth evaluate", "--protocol kitti-2015 --cap 50", "--cap"),
    ("weights complete", "w --models . --unit m", "--unit"),
]
USED = [
    ("pose predict", "--cad p.stl --cloud c.ply"),
    ("pose predict", "--voting ransac --hypotheses 64"),
    ("pose predict", "--depth d.png --mask m.png --camera c.json --batch 4"),
    ("pose evaluate", "--bop b --weights register parts --voting ransac --no-icp"),
    ("depth predict", "a.png --engine ray --worker-gpus 0.5 --device cuda:1"),
    ("pose predict", "--depth d.csv --camera c --engine ray --batch 4"),
    ("depth evaluate", "--matcher sgbm --holes leave --baseline rows --train t"),
    ("depth evaluate", "--weights quick:a b --speed fine --protocol eigen-raw --cap 50"),
]


@pytest.mark.parametrize(("command", "words", "named"), IGNORED)
def test_an_option_without_effect_is_refused(command: str, words: str, named: str) -> None:
    with pytest.raises(InputError, match=rf"^{named}: has no effect here; .* Leave {named} out$"):
        refuse_ignored(command, words.split())


@pytest.mark.parametrize(("command", "words"), USED)
def test_an_option_with_effect_is_not(command: str, words: str) -> None:
    refuse_ignored(command, words.split())


def test_the_command_refuses_it_in_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["pose", "track", "--cloud", "x", "--split", "test", "--out", "o"]
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("depthpose: error: --split: has no effect here; it is of a dataset")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("depth match l r --camera c --min-confidence 2", "--min-confidence 2: give 0 to 1"),
        ("depth predict l --min-confidence -1", "--min-confidence -1: give 0 to 1"),
        ("depth predict l --batch 0", "--batch 0: give 1 or more"),
        ("depth predict l --engine ray --worker-gpus -1 --device cuda", "--worker-gpus -1.0: give"),
        ("depth predict l --engine ray --workers 0", "--workers 0: give 1 or more"),
        ("pose predict --cloud c --batch 0", "--batch 0: give 1 or more"),
        ("reproduce 3.1 --bop b --weights v w --pictures -1", "--pictures -1: give 0 or more"),
    ],
)
def test_a_value_out_of_range_is_refused_before_files_are_looked_up(
    words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words.split(), "--out", "o"]) == 2
    assert capsys.readouterr().err.startswith(f"depthpose: error: {message}")


@pytest.mark.parametrize(
    ("text", "size"),
    [("1G", 10**9), ("1GB", 10**9), ("800m", 8 * 10**8), ("1.5GiB", 3 * 2**29), ("2Ki", 2048),
     (" 7 ", 7), ("12 B", 12), ("1T", 10**12)],
)  # fmt: skip
def test_sizes_are_read_as_people_write_them(text: str, size: int) -> None:
    assert MatcherOptions(max_memory=text).config.max_memory_bytes == size


class Full(io.StringIO):
    """A stream on a full disk."""

    def __init__(self, error: type[OSError], number: int) -> None:
        super().__init__()
        self.error = error(number, "what the system says")

    def write(self, _: str, /) -> int:
        raise self.error


@pytest.mark.parametrize(
    ("stream", "code", "said"),
    [
        (lambda: Full(OSError, errno.ENOSPC), 1, "cannot be written: what the system says"),
        (lambda: Full(BrokenPipeError, errno.EPIPE), 141, ""),
        (lambda: None, 1, "cannot be written: it is closed"),
    ],
)
def test_a_command_ends_its_work_though_nobody_can_read_it(
    stream: Callable[[], object],
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    made: list[Path] = []

    def work() -> int:
        sys.stdout.write("before\n")
        (tmp_path / "result").write_text("whole")
        made.append(tmp_path / "result")
        sys.stdout.write("after\n")
        return 0

    monkeypatch.setattr("depthpose.cli._run", lambda _: work())
    monkeypatch.setattr(sys, "stdout", stream())
    assert main(["anything"]) == code
    assert made[0].read_text() == "whole"
    errors = capsys.readouterr().err
    assert said in errors
    assert errors.count("\n") == bool(said)


def test_messages_that_nobody_can_read_stop_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    for stream in (None, Full(OSError, errno.ENOSPC)):
        monkeypatch.setattr(sys, "stderr", stream)
        with lasting_streams() as output:
            sys.stderr.write("a message\n")
        assert output.failure is None


def test_a_name_that_is_not_utf8_is_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", written)
    with lasting_streams():
        sys.stdout.write("n\udcfe.png")
    assert written.buffer.getvalue() == rb"n\udcfe.png"
