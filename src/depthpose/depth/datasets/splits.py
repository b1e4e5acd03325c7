"""The Eigen splits by name, and the same lists in others' forms."""

import hashlib
import re
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import read_text

# Frames, and the sha256 of our own file: drives in order, each with its frame numbers as ranges.
_SHIPPED = {
    "eigen-train": (22600, "f9847f01ab8d86d3cf84300174d56d8a9704af19b544f04b448be35da1402163"),
    "eigen-val": (888, "70e87b93882aebff8edba6b584ec8d9190c7e017c5b740c664ed8700bd1c6c99"),
    "eigen-test": (697, "f4162df9d7bd431e9f2b87625769f686ea254df13ad904710e1258002522a78c"),
    "eigen-benchmark": (652, "00a9ea3d79fa9ff08884cc5297a6233968518128f6e8d561b90a1cda5b006b9a"),
}
# Lists that are others together; the thesis trains on this one (2.4.1).
_JOINED = {"eigen-train-val": ("eigen-train", "eigen-val")}
SPLIT_NAMES = (*_SHIPPED, *_JOINED)
# Files that others ship under these names; the lists are the same.
_MONODEPTH_SHA256 = {
    "5baf510a33fa2f81b97642d86deebc2b6da752cedbcf87f1c741b2f601f16782": "eigen-train",
    "f8e938222a019027521bf8bc7933b068aa0cafe6c29d5f796e09da3635ff4785": "eigen-val",
    "78b73fe7d2ef9c352b54e6e5dd0578bbbf62257280b3d5bfb1e30bd451a35006": "eigen-test",
}

_MAX_BYTES = 2**24
"""Of a list of frames: twenty times KITTI's."""


@dataclass(frozen=True, kw_only=True)
class Split:
    """A list of frames of KITTI raw.

    Attributes:
        name: ``eigen-test`` and the like, or the file's name where it is no known list.
        frames: (drive, frame number), e.g. ``("2011_09_26_drive_0002_sync", 69)``, sorted.
    """

    name: str
    frames: tuple[tuple[str, int], ...]

    @property
    def names(self) -> list[str]:
        """Names as those of :class:`Frame`, sorted."""
        return [f"{drive}_{frame:010d}" for drive, frame in self.frames]


def read_split(name: str | Path) -> Split:
    """Give a split by name, or read a file of monodepth's or monodepth2's form.

    A file whose frames, as a set, are those of a known split gets that split's name. Of
    monodepth2's lists the lines of the left camera (``l``) count.

    Raises:
        InputError: neither a name nor a file, or a line that cannot be understood.
    """
    if str(name) in SPLIT_NAMES:
        return _known(str(name))
    path = Path(name)
    try:
        is_there = path.is_file()
    except OSError:  # a name too long for the disk
        is_there = False
    if not is_there:
        hint = nearest_name(str(name), SPLIT_NAMES)
        raise InputError(f"split {str(name)!r}: no such file; {hint}")
    text = read_text(path, _MAX_BYTES)
    known = _MONODEPTH_SHA256.get(hashlib.sha256(text.encode()).hexdigest())
    if known is not None:
        return _shipped(known)
    lines = ((i, line.strip()) for i, line in enumerate(text.splitlines(), 1))
    frames = {_parse_line(path, i, line) for i, line in lines if line} - {None}
    if not frames:
        raise InputError(
            f"{path}: names no frame. Each line is 'DATE/DRIVE FRAME l' or two images."
        )
    listed = tuple(sorted(frame for frame in frames if frame is not None))
    same = [key for key in SPLIT_NAMES if _known(key).frames == listed]
    return Split(name=same[0] if same else path.name, frames=listed)


def _parse_line(path: Path, number: int, line: str) -> tuple[str, int] | None:
    """Read one line; None for a frame of the right camera."""
    drives = set(re.findall(r"\d{4}_\d\d_\d\d_drive_\d{4}_sync", line, re.ASCII))
    images = {int(n) for n in re.findall(r"image_0[23]/(?:data/)?(\d{1,10})\.\w", line, re.ASCII)}
    as_words = re.fullmatch(r"\S+\s+(\d{1,10})\s+([lr])", line, re.ASCII)
    numbers = {int(as_words[1])} if as_words is not None else images
    if len(drives) != 1 or len(numbers) != 1:
        raise InputError(
            f"{path}: line {number} is {line[:60]!r}, but a frame is 'DATE/DRIVE FRAME l' "
            "(monodepth2) or two image paths of one frame (monodepth)."
        )
    if as_words is not None and as_words[2] == "r":
        return None
    return drives.pop(), numbers.pop()


@cache
def _known(name: str) -> Split:
    if name not in _JOINED:
        return _shipped(name)
    frames = {frame for part in _JOINED[name] for frame in _shipped(part).frames}
    return Split(name=name, frames=tuple(sorted(frames)))


@cache
def _shipped(name: str) -> Split:
    count, sha256 = _SHIPPED[name]
    text = resources.files("depthpose.depth.datasets").joinpath(f"lists/{name}.txt").read_text()
    if hashlib.sha256(text.encode()).hexdigest() != sha256:
        raise InputError(f"split {name!r}: the list in the package was changed. Install it anew.")
    frames = tuple(
        (drive, frame)
        for drive, _, ranges in (line.partition(" ") for line in text.splitlines())
        for frame in _expand(ranges)
    )
    assert len(frames) == count
    return Split(name=name, frames=frames)


def _expand(ranges: str) -> list[int]:
    """``"0-3 7"`` to ``[0, 1, 2, 3, 7]``."""
    ends = [[int(end) for end in word.split("-")] for word in ranges.split()]
    return [frame for end in ends for frame in range(end[0], end[-1] + 1)]
