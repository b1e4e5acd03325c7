import errno
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from depthpose.cli import main
from depthpose.core.checkpoint import Checkpoint, save_checkpoint
from depthpose.core.config import write_config
from depthpose.core.errors import InputError
from depthpose.core.export import Export, Graph, write_export
from depthpose.core.files import (
    PointCloud,
    atomic_write,
    read_bytes,
    stores,
    write_cloud,
    write_depth_png,
    write_image,
    write_json,
    write_map,
    write_video,
)
from depthpose.core.files.disk import natural_sort_key
from depthpose.core.loop import RunLogger
from depthpose.core.run_folder import claim_folder, lock_folder
from depthpose.report.page import Section, write_page, write_table


def test_a_finished_write_is_whole_and_makes_its_folders(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b" / "x.bin"
    with atomic_write(target) as part:
        assert part.parent == target.parent
        assert part.suffix == target.suffix
        part.write_bytes(b"new")
        assert not target.exists()
    assert target.read_bytes() == b"new"
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.parametrize("failure", [KeyboardInterrupt, RuntimeError, SystemExit])
def test_a_broken_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, failure: type[BaseException]
) -> None:
    target = tmp_path / "x.bin"
    target.write_bytes(b"old")

    def half() -> None:
        with atomic_write(target) as part:
            part.write_bytes(b"half")
            raise failure

    with pytest.raises(failure):
        half()
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_new_file_takes_the_place_of_the_old_one_and_does_not_write_into_it(
    tmp_path: Path,
) -> None:
    target, other = tmp_path / "x.json", tmp_path / "link.json"
    write_json(target, "old")
    other.hardlink_to(target)
    write_json(target, "new")
    assert other.read_text() == '"old"\n'


def test_a_full_disk_is_named(tmp_path: Path) -> None:
    target = tmp_path / "x.bin"

    def fill() -> None:
        with atomic_write(target) as part:
            part.write_bytes(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(InputError, match=r"x\.bin: cannot be written: No space left on device"):
        fill()
    assert list(tmp_path.iterdir()) == []


def test_a_block_that_writes_nothing_is_an_error(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match="cannot be written: No such file"),
        atomic_write(tmp_path / "x.bin"),
    ):
        pass


def test_a_folder_and_a_device_are_not_replaced(tmp_path: Path) -> None:
    for place in (tmp_path, Path("/dev/null")):
        with pytest.raises(InputError, match="a folder or device, which no file may replace"):
            write_json(place, {})
    assert not Path("/dev/null").is_file()


def test_a_file_in_the_way_of_a_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    said = f"^{tmp_path}/file: is a file, but a folder is needed there; choose another place$"
    for below in ("x.json", "deep/x.json"):
        with pytest.raises(InputError, match=said):
            write_json(tmp_path / "file" / below, {})


def test_a_name_that_no_disk_takes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot be written: .*long"):
        write_json(tmp_path / ("x" * 300) / "x.json", {})


def test_a_written_file_has_the_rights_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    write_json(tmp_path / "x.json", {})
    assert (tmp_path / "x.json").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_file_too_large_is_refused_unread(tmp_path: Path) -> None:
    with (tmp_path / "huge.npy").open("wb") as file:
        file.truncate(5 * 2**30)
    with pytest.raises(InputError, match=r"huge\.npy: 5368709120 bytes, more than the 268435456"):
        read_bytes(tmp_path / "huge.npy")


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.0, 0.01, 0.05, 0.2])
def test_a_killed_writer_never_leaves_half_a_file(tmp_path: Path, delay_s: float) -> None:
    target = tmp_path / "x.bin"
    target.write_bytes(b"a" * 10_000_000)
    code = (
        "import sys\nfrom depthpose.core.files.disk import write_bytes\nprint('go', flush=True)\n"
        "while True:\n    for c in b'bc': write_bytes(sys.argv[1], bytes([c]) * 10_000_000)"
    )
    writer = subprocess.Popen([sys.executable, "-c", code, str(target)], stdout=subprocess.PIPE)
    with writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        with pytest.raises(subprocess.TimeoutExpired):
            writer.wait(delay_s)
        writer.kill()
    content = target.read_bytes()
    assert len(content) == 10_000_000
    assert len(set(content)) == 1


@dataclass(frozen=True)
class Knobs:
    text: str = 200_000 * "x"


NOISE = {"a": torch.randn(100_000)}


class Heavy(Graph):
    """A graph of one large tensor."""

    def model(self, facts: Mapping[str, Any]) -> Any:  # noqa: ANN401, ARG002
        from onnx import helper, numpy_helper

        held = numpy_helper.from_array(NOISE["a"].numpy(), "a")
        return helper.make_model(helper.make_graph([], "g", [], [], [held]))


@contextmanager
def small_disk() -> Iterator[None]:
    """Let no file of this process be larger than 100 kB: what a full disk does, sooner."""
    resource = pytest.importorskip("resource", reason="a system without limits of file size")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_every_writer_names_a_full_disk_and_leaves_nothing(tmp_path: Path) -> None:
    long, images = "x" * 200_000, [torch.rand(3, 300, 300) for _ in range(9)]
    weights = Checkpoint(kind="k", config={}, state=NOISE)
    graph = Export(graph=Heavy, cases=list, limits={}, facts={})
    writers: dict[str, Callable[[Path], object]] = {
        "weights": lambda p: save_checkpoint(p / "w.safetensors", weights),
        "state": lambda p: RunLogger(p, is_writer=True).save(NOISE),
        "run record": lambda p: claim_folder(p, {"a": long}),
        "config": lambda p: write_config(p / "c.yaml", Knobs()),
        "page": lambda p: write_page(p / "page.html", "t", [Section(title="t", text=long)], {}),
        "table": lambda p: write_table(p, [{"a": long}]),
        "cloud": lambda p: write_cloud(p / "c.ply", PointCloud(points=torch.rand(50_000, 3))),
        "map": lambda p: write_map(p / "m.npy", images[0][0].repeat(2, 2)),
        "picture": lambda p: write_image(p / "p.png", images[0]),
        "depth": lambda p: write_depth_png(p / "d.png", 200 * images[0][0]),
        "avi": lambda p: write_video(p / "v.avi", images, 10.0),
        "mp4": lambda p: write_video(p / "v.mp4", images, 10.0),
        "graph": lambda p: write_export(p / "g.onnx", graph),
    }
    for name, write in writers.items():
        with (
            small_disk(),
            pytest.raises(InputError, match=r"cannot be written: File too large|disk is full"),
        ):
            write(tmp_path / name)
        left = [path.name for path in tmp_path.rglob("*") if path.is_file()]
        assert set(left) <= {".lock"}, name
    # TensorBoard writes in a thread of its own, so the metrics are full first.
    logger = RunLogger(tmp_path, is_writer=True)
    logger.open(0)
    (tmp_path / "metrics.jsonl").write_text(99_000 * " ")
    with (
        small_disk(),
        pytest.raises(InputError, match=r"metrics\.jsonl: cannot be written: File too large"),
    ):
        logger.log(1, {2_000 * "x": 1.0})
    logger.close()


def test_a_folder_may_be_called_as_a_pattern_is_written(tmp_path: Path) -> None:
    folder = tmp_path / "run[1]"
    folder.mkdir()
    (folder / "0.json").write_bytes(b"{}")
    assert stores.read_all(str(folder), ".json") == {"0.json": b"{}"}
    assert stores.read_all(f"file://{folder}", ".json") == {"0.json": b"{}"}
    assert stores.exists(str(folder / "0.json"))


def in_order(*names: str) -> list[str]:
    """Sort names, given in their order, from the other end."""
    paths = sorted((Path(name) for name in reversed(names)), key=natural_sort_key)
    return [str(path) for path in paths]


def test_names_are_sorted_by_the_value_of_their_numbers() -> None:
    names = ["a2.png", "a10.png", "b1_left.png", "b1_right.png", "b09.png", "b10.png"]
    assert in_order(*names) == names


def test_decimals_are_sorted_as_decimals() -> None:
    """Times in seconds, whose writer leaves out zeros at their ends."""
    times = ["0.3", "0.45", "0.5", "0.625", "0.7", "0.85", "0.9", "1.05", "10.0"]
    assert in_order(*(f"{time}.png" for time in times)) == [f"{time}.png" for time in times]
    long = ["1311868164.363181.png", "1311868164.4.png", "1311868165.png", "1311868165.0001.png"]
    assert in_order(*long) == long
    folders = ["run 0.25/a.png", "run 0.5/a.png", "run 0.5/b.png"]
    assert in_order(*folders) == folders


def test_three_numbers_between_points_are_no_decimal() -> None:
    names = ["v1.2.9.png", "v1.2.10.png", "v1.10.1.png", "frame.2.png", "frame.10.png"]
    assert in_order(*names[3:], *names[:3]) == names[3:] + names[:3]


@pytest.mark.parametrize("behind", ["", "deeper/out"])
def test_links_that_lead_nowhere_are_named(
    tmp_path: Path, behind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not 'free the space', and no traceback."""
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    (tmp_path / "gone").symlink_to("nowhere/x")
    (tmp_path / "cloud.xyz").write_text("1 2 3\n")
    for link, leads in (("a", "in a circle"), ("gone", "to 'nowhere/x', which is not there")):
        out = tmp_path / link / behind
        said = f"{tmp_path / link}: is a link that leads {leads}; remove it, or choose another"
        words = ["pose", "predict", "--cloud", str(tmp_path / "cloud.xyz"), "--out", str(out)]
        assert main(words) == 2
        assert said in capsys.readouterr().err
        for write in (
            partial(lock_folder, is_shared=False),
            lambda path: write_json(path / "x.json", {}),
        ):
            with pytest.raises(InputError, match=re.escape(said)):
                write(out)


def test_a_link_to_a_folder_is_one(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to("there")
    write_json(tmp_path / "link/new/x.json", {})
    assert (tmp_path / "there/new/x.json").is_file()
