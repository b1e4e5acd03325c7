"""What every command that writes leaves on a full disk, in a read-only folder, and when killed.

The disk is a tmpfs of the test's own, filled up to some share of what the command writes.
"""

import io
import json
import os
import random
import subprocess
import tarfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from safetensors.torch import load as load_safetensors
from tests.outcomes.child import Ended, run
from tests.outcomes.commands import COMMANDS, Command, make_inputs

pytestmark = [
    pytest.mark.slow,
    # Warnings of a fork server that this process starts are not ours.
    pytest.mark.filterwarnings("default"),
]
KILLS = int(os.environ.get("DEPTHPOSE_KILLS", "2"))
PREDICTING_KILLS = int(os.environ.get("DEPTHPOSE_PREDICTING_KILLS", "8"))
_PAGE = 4096
"""Bytes that such a disk gives at once."""
SHARES = (0.0, 0.3, 0.8)
"""Of the space that a command needs."""
SAME = {".npy", ".png", ".ply", ".safetensors", ".tar", ".bin", ".onnx"}
"""Kinds of files whose bytes are the same in every run; other files name times or places."""
EVERY = pytest.mark.parametrize("command", COMMANDS, ids=lambda one: one.name.replace(" ", "_"))


@dataclass(frozen=True)
class Reference:
    """What a command leaves that nothing disturbs."""

    files: dict[str, bytes]
    ended: Ended

    @property
    def size(self) -> int:
        """Bytes on the disk."""
        return size_of(self.files)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_inputs(tmp_path_factory.mktemp("inputs"))


@pytest.fixture(scope="module")
def references() -> dict[Command, Reference]:
    return {}


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """An empty disk of memory, of this test alone."""
    with mounted(tmp_path / "disk") as place:
        yield place


@contextmanager
def mounted(place: Path) -> Iterator[Path]:
    place.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=256m", "tmpfs", str(place)]
    if subprocess.run(words, capture_output=True, check=False).returncode:
        pytest.skip("no disk can be mounted here: run as root")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


@pytest.fixture
def reference(
    command: Command, home: Path, disk: Path, references: dict[Command, Reference]
) -> Reference:
    """The undisturbed run, made once; the disk is empty afterwards."""
    if command not in references:
        ended = run(command.given(home, disk))
        assert ended.code == 0, ended.said
        references[command] = Reference(files=files_of(disk), ended=ended)
        subprocess.run(["find", str(disk), "-mindepth", "1", "-delete"], check=True)
    return references[command]


def size_of(files: Mapping[str, bytes]) -> int:
    return sum(-(-len(data) // _PAGE) * _PAGE for data in files.values())


def files_of(disk: Path) -> dict[str, bytes]:
    paths = sorted(path for path in disk.rglob("*") if path.is_file())
    return {str(path.relative_to(disk)): path.read_bytes() for path in paths}


def _members(data: bytes) -> None:
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        assert tar.getmembers()


def _lines(data: bytes) -> None:
    # Lines are added one by one; only the last of a killed process may be cut.
    assert all(json.loads(line) for line in data.decode().split("\n")[:-1])


def _ends_a_line(data: bytes) -> None:
    assert data.endswith(b"\n")


def _ends_a_page(data: bytes) -> None:
    assert data.rstrip().endswith(b"</html>")


READERS: Mapping[str, Callable[[bytes], object]] = {
    ".json": json.loads,
    ".jsonl": _lines,
    ".png": lambda data: Image.open(io.BytesIO(data)).load(),
    ".jpg": lambda data: Image.open(io.BytesIO(data)).load(),
    ".npy": lambda data: np.load(io.BytesIO(data)),
    ".safetensors": load_safetensors,
    ".pt": lambda data: torch.load(io.BytesIO(data), weights_only=True),
    ".html": _ends_a_page,
    ".tar": _members,
    ".yaml": yaml.safe_load,
    "results.jsonl": bytes.decode,  # its readers pass over a line that was cut
    **dict.fromkeys((".csv", ".md", ".txt"), _ends_a_line),
}
"""By name or suffix, what fails on a file that is not whole; others are compared byte by byte."""


def assert_nothing_partial(disk: Path, reference: Reference, *, is_killed: bool) -> None:
    for name, data in files_of(disk).items():
        path = disk / name
        if path.name.startswith(".part-"):
            assert is_killed, name
        elif name != "filler":
            READERS.get(path.name, READERS.get(path.suffix, bytes))(data)
            wanted = reference.files.get(name)
            assert path.suffix not in SAME or wanted is None or wanted == data, name


def assert_complete(disk: Path, reference: Reference) -> None:
    found = {name: data for name, data in files_of(disk).items() if not _is_deep_part(name)}
    is_other = {name for name in found.keys() ^ reference.files.keys() if "tfevents" not in name}
    assert not is_other
    assert_nothing_partial(disk, reference, is_killed=True)


def _is_deep_part(name: str) -> bool:
    """Whether it is half of a file that a kill left below the folder of the results.

    Beside a single file, too: whose folder it lies in is not known.
    """
    folder, _, file = name.rpartition("/")
    return file.startswith(".part-") and folder != "out"


def assert_refused(ended: Ended, said: str) -> None:
    assert ended.code == 2, ended.said
    assert "Traceback" not in ended.said
    lines = [line for line in ended.said.splitlines() if line.startswith("depthpose: error: ")]
    assert len(lines) == 1, ended.said
    assert "cannot be written: " in lines[0]
    assert said in lines[0]


def fill(disk: Path, left: int) -> None:
    """Leave so many bytes on a disk."""
    filler = disk / "filler"
    filler.unlink(missing_ok=True)
    space = os.statvfs(disk)
    with filler.open("wb") as file:
        pages = space.f_bavail - max(left, 0) // _PAGE
        os.posix_fallocate(file.fileno(), 0, pages * _PAGE)


@EVERY
def test_a_full_disk(command: Command, home: Path, disk: Path, reference: Reference) -> None:
    before: dict[str, bytes] = {}
    # The files of the demo are written by what writes those of other commands, and take long.
    for share in SHARES[1:2] if command.name == "demo" else SHARES:
        fill(disk, int(share * reference.size) - size_of(before))
        ended = run(command.given(home, disk), temporary=disk)
        assert_refused(ended, "No space left on device")
        assert_nothing_partial(disk, reference, is_killed=False)
        now = files_of(disk)
        now.pop("filler")
        assert before.keys() <= now.keys(), "what was there is still there"
        before = now
    (disk / "filler").unlink()
    ended = run(command.given(home, disk))
    assert ended.code == reference.ended.code, ended.said
    assert_complete(disk, reference)


@EVERY
def test_a_read_only_folder(command: Command, home: Path, disk: Path, reference: Reference) -> None:
    def set_mode(mode: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{mode}", str(disk)], check=True)

    set_mode("ro")
    assert_refused(run(command.given(home, disk)), "Read-only file system")
    assert not files_of(disk)
    set_mode("rw")
    for name in list(reference.files)[: 1 if command.is_file else None]:
        (disk / name).parent.mkdir(parents=True, exist_ok=True)
        (disk / name).write_bytes(reference.files[name])
    set_mode("ro")
    ended = run(command.given(home, disk))
    # Where all is done, some commands only say so.
    if ended.code != 0 and "is there already" not in ended.said:
        assert_refused(ended, "Read-only file system")
    now = files_of(disk)
    assert all(reference.files[name] == data for name, data in now.items())


@EVERY
def test_a_killed_process(command: Command, home: Path, disk: Path, reference: Reference) -> None:
    moments = random.Random(int(os.environ.get("DEPTHPOSE_SEED", "0")))
    is_predicting = command.name in ("depth predict", "depth match", "pose predict")
    kills = PREDICTING_KILLS if is_predicting else 1 if command.name == "demo" else KILLS
    before: set[str] = set()
    if not command.is_file:
        # As if a process had been killed while it wrote; whoever ends the work removes it.
        (disk / "out").mkdir()
        (disk / "out" / ".part-0123456789ab.tar").write_bytes(b"half")
    for _ in range(kills):
        moment_s = moments.uniform(0.1, 1.0) * reference.ended.seconds
        ended = run(command.given(home, disk), kill_after_s=moment_s)
        assert ended.code in (-9, reference.ended.code) or _is_done(ended, command), ended.said
        assert_nothing_partial(disk, reference, is_killed=True)
        now = {name for name in files_of(disk) if "/.part-" not in f"/{name}"}
        assert before <= now, "what was there is still there"
        before = now
    ended = run(command.given(home, disk))
    assert ended.code == reference.ended.code or _is_done(ended, command), ended.said
    assert_complete(disk, reference)


def _is_done(ended: Ended, command: Command) -> bool:
    """Whether it refuses to write again the one file that it has finished."""
    once = command.is_file or command.name == "data pack"
    return once and ended.code == 2 and "is there already" in ended.said
