"""Options that do not go together or are out of range; streams that cannot be written."""

import errno
import io
import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from random import Random

import pytest

from depthpose.cli import COMMANDS, lasting_streams, main
from depthpose.cli.arguments import make_parser
from depthpose.cli.depth.options import MatcherOptions
from depthpose.cli.option_rules import (
    IGNORED_RULES,
    RULES,
    IgnoredRule,
    Rule,
    TypedOptions,
    refuse_combinations,
)
from depthpose.core.errors import InputError

IGNORED = [
    ("depth match", "l r --camera c --min-confidence 0.9", "--min-confidence"),
    ("data make objects", "--pile 3 --clutter 4 4", "--clutter"),
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
REFUSED = [
    ("pose predict", "", "give one of --cloud, --depth, --left and --bop"),
    ("pose predict", "--cloud c --depth=d", "give one of --cloud, --depth, --left and --bop"),
    ("pose predict", "--depth d --camera c --depth None", "give one of --cloud, --depth, --left"),
    ("pose predict", "--cloud None", "give one of --cloud, --depth, --left and --bop"),
    ("pose predict", "--depth d --camera=None", "--depth needs --camera or --focal-px"),
    ("pose predict", "--left l --right r", "--left needs --right and --camera"),
    ("pose predict", "--left l --camera c", "--left needs --right and --camera"),
    ("pose predict", "--depth d --focal-px 9 --mask m --box 1,2,3,4", "--mask, --box and"),
    ("pose predict", "--depth d --camera c --box 1,2,3,4 --detections e", "--mask, --box and"),
    ("pose predict", "--depth d --camera c --mask m --bin b", "--bin: where is it?"),
    ("pose predict", "--bop b --weights register --voting ransac", "--weights register: regis"),
    ("pose predict", "--cloud c --method register --cad", "--method register looks for CAD files"),
    ("pose track", "--cloud c --depth d", "give one of --depth with --camera, --cloud and --bop"),
    ("pose track", "--depth d", "--depth needs --camera beside it"),
    ("pose track", "--bop b --weights register", "--weights register: registration is asked for"),
    ("pose track", "--cloud c --method register", "--method register looks for CAD files"),
    ("pose evaluate", "--bop b --weights", "measure --weights FILE, --csv FILE or --predictions"),
    ("depth predict", "l --engine ray --matcher w", "--engine ray takes --matcher sgbm or"),
    ("depth evaluate", "--data d", "measure --weights FILE, --matcher sgbm, --predictions"),
    ("depth evaluate", "--baseline rows", "a baseline is fitted to training frames: give --train"),
    ("reproduce 3.1", "--weights v w", "give --linemod FOLDER, or --bop FOLDER"),
    ("reproduce 3.2", "--bop b", "there is nothing to measure; give --weights FILE or --csv"),
]
USED = [
    ("depth match", "l r --camera c --cloud --min-confidence 0.9"),
    ("pose evaluate", "--bop b --weights registered.safetensors --voting ransac"),
    ("depth predict", "--engine ray --matcher sgbm a.png b.png"),
    ("pose predict", "--bop d --camera None"),
    ("pose predict", "--bop d --method register --masks seg.safetensors --device cuda"),
    ("pose evaluate", "--bop d --weights register --masks truth seg.safetensors --device cuda"),
    ("pose predict", "--cad p.stl --cloud c.ply"),
    ("pose predict", "--left l --right r --camera c --mask m --color p --color-camera o"),
    ("pose predict", "--depth d --camera c --box 1,2,3,4 --bin b --bin-pose p --cad-unit mm"),
    ("pose track", "--cloud c --method register --cad p.stl --cad-unit mm --symmetry z,2"),
    ("pose predict", "--left l --right r --camera c --cad p.stl --device cuda:0"),
    ("pose predict", "--cloud c.ply --voting ransac --hypotheses 64"),
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
        refuse_combinations(command, words.split())


@pytest.mark.parametrize(("command", "words", "error"), REFUSED)
def test_options_that_do_not_go_together_are_refused(command: str, words: str, error: str) -> None:
    with pytest.raises(InputError) as refused:
        refuse_combinations(command, words.split())
    assert error in str(refused.value)


class _Recorder(TypedOptions):
    """Options of which each look at them says something else, and that keep what was looked at."""

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()
        self.random = Random(0)

    def __missing__(self, name: str) -> list[str]:
        self.names.add(name)
        return self.random.choice([[], [name], ["ray"], ["register"]])


@pytest.mark.parametrize("rule", [*IGNORED_RULES, *RULES])
def test_a_rule_names_options_of_its_commands_alone(rule: IgnoredRule | Rule) -> None:
    recorder = _Recorder()
    for _ in range(100):
        rule.when(recorder)
    is_ignored = isinstance(rule, IgnoredRule)
    text = rule.reason if is_ignored else rule.error
    of_this_command = re.sub(r"'depthpose .*?'", "", text)  # without those of another
    named = recorder.names | set(re.findall(r"--([a-z-]+)", of_this_command))
    named |= set(rule.ignored) if is_ignored else set()
    assert named
    for command in rule.commands:
        module, _, function = COMMANDS[command][0].partition(":")
        _, options = make_parser(getattr(import_module(f"depthpose.cli.{module}"), function))
        assert named <= {option.name.replace("_", "-") for option in options}, command


@pytest.mark.parametrize(("command", "words"), USED)
def test_an_option_with_effect_is_not(command: str, words: str) -> None:
    refuse_combinations(command, words.split())


def test_the_command_refuses_it_in_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["pose", "track", "--cloud", "x", "--split", "test", "--out", "o"]
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("depthpose: error: --split: has no effect here; it is of a dataset")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "depth match l r --camera c --cloud --min-confidence 2",
            "--min-confidence 2: give 0 to 1",
        ),
        ("depth predict l --cloud --min-confidence -1", "--min-confidence -1: give 0 to 1"),
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
