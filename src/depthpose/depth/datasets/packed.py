"""Data sets packed into tar shards: few large files, read by index, from a disk or a store."""

import hashlib
import io
import re
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import fields
from itertools import groupby
from pathlib import Path
from typing import Any

from depthpose.core.errors import InputError
from depthpose.core.files import atomic_write, cache_folder, read_bytes, read_json, write_json
from depthpose.core.files.disk import write_bytes
from depthpose.core.files.store import SOURCE
from depthpose.depth.datasets.frames import Frame

INDEX = "index.json"
"""What a packed data set holds; written last."""
_CALIBRATION = "calibration"
_PARTS = ("left", "right", "velodyne", "scan", "depth", "disparity", "disparity_noc", "sky")
_URL = re.compile(r"([a-z][a-z0-9+]+):/+(?=[^/])")


def pack_frames(
    frames: list[Frame], out: Path, shard_bytes: int, show: Callable[[str], object] = lambda _: None
) -> int:
    """Copy frames into tar shards, in WebDataset's form, and give the number of shards.

    Files are copied as they are, so that what is trained on shards has the weights that it would
    have from the folder. ``KEY.left.png`` and the like lie in ``000000.tar``, calibration in
    ``calibration/``, and ``index.json`` says where each frame's parts are. A shard is written whole
    or not at all, the index last; a second call writes everything again.

    Args:
        frames: what is packed, in order.
        out: a folder of its own.
        shard_bytes: a shard is closed when it has this many.
        show: called with the name of each frame.

    Raises:
        InputError: a file is missing or damaged, or the disk refuses.
    """
    rows: list[dict[str, Any]] = []
    kept: dict[Path, str] = {}
    shards = 0
    for number, group in groupby(_numbered(frames, shard_bytes), key=lambda pair: pair[0]):
        name = f"{number:06d}.tar"
        with atomic_write(out / name) as part, tarfile.open(part, "w") as tar:
            for _, frame in group:
                key = f"{len(rows):08d}"
                row = {"name": frame.name, "style": frame.style}
                row |= {what: f"{name}/{file}" for what, file in _add(tar, key, frame)}
                if frame.calibration is not None:
                    row["calibration"] = _keep(frame.calibration, out, kept)
                rows.append(row)
                show(frame.name)
        shards += 1
    write_json(out / INDEX, {"frames": rows})
    return shards


def packed_frames(folder: Path) -> Iterator[Frame]:
    """List the frames of a packed data set; none where there is no index.

    Raises:
        InputError: the index is damaged.
    """
    index = folder / INDEX
    if not index.is_file():
        return
    known = {field.name for field in fields(Frame)}
    found = read_json(index)
    rows = found.get("frames") if isinstance(found, dict) else None
    if not isinstance(rows, list):
        return  # an index of somebody else
    for number, row in enumerate(rows):
        is_row = isinstance(row, dict) and {"name", "style", "left"} <= set(row) <= known
        if not is_row or not all(isinstance(value, str) for value in row.values()):
            raise InputError(f"{index}: frame {number} is not as 'depthpose data pack' writes it")
        paths = {k: folder / v for k, v in row.items() if k not in ("name", "style")}
        if not all(path.resolve().is_relative_to(folder.resolve()) for path in paths.values()):
            raise InputError(f"{index}: frame {number} names a file outside of the folder")
        yield Frame(name=row["name"], style=row["style"], **paths)


def local_folder(folder: Path | str) -> Path:
    """Give the folder itself; for a URL, a local one to which its shards come as they are read.

    It is in ``$DEPTHPOSE_CACHE``, by default ``~/.cache/depthpose``.

    Raises:
        InputError: the store does not answer, or holds no packed data set there.
    """
    text = str(folder)
    if _URL.match(text) is None:
        return Path(folder)
    url = _URL.sub(r"\1://", text, count=1).rstrip("/")  # a Path has made one slash of two
    here = cache_folder() / "shards" / hashlib.sha256(url.encode()).hexdigest()[:16]
    _fetch_small(url, here)
    write_json(here / SOURCE, {"url": url})
    return here


def _fetch_small(url: str, here: Path) -> None:
    """Fetch calibration and, last, the index."""
    from depthpose.core.files.store import exists, fetch, join, list_tree  # fsspec takes time

    if not exists(join(url, INDEX)):
        raise InputError(f"{url}: holds no {INDEX}; 'depthpose data pack' makes one")
    for name, of_file in list_tree(join(url, _CALIBRATION)).items():
        if ".." not in Path(name).parts:
            fetch(of_file, here / _CALIBRATION / name)
    fetch(join(url, INDEX), here / INDEX)


def _numbered(frames: list[Frame], shard_bytes: int) -> Iterator[tuple[int, Frame]]:
    """Say which shard each frame goes into."""
    number, size = 0, 0
    for frame in frames:
        if size >= shard_bytes:
            number, size = number + 1, 0
        size += sum(path.stat().st_size for _, path in _files(frame))
        yield number, frame


def _files(frame: Frame) -> Iterator[tuple[str, Path]]:
    for part in _PARTS:
        path = getattr(frame, part)
        if path is not None:
            yield part, path


def _add(tar: tarfile.TarFile, key: str, frame: Frame) -> Iterator[tuple[str, str]]:
    """Copy the files of a frame; give what each is, and its name."""
    for part, path in _files(frame):
        data = read_bytes(path)
        member = tarfile.TarInfo(f"{key}.{part}{path.suffix.lower()}")
        member.size = len(data)
        tar.addfile(member, io.BytesIO(data))
        yield part, member.name


def _keep(calibration: Path, out: Path, kept: dict[Path, str]) -> str:
    """Copy the calibration of a frame, once."""
    if calibration not in kept:
        kept[calibration] = place = f"{_CALIBRATION}/{len(kept):06d}"
        if calibration.is_file():
            kept[calibration] = place = f"{place}{calibration.suffix}"
            write_bytes(out / place, read_bytes(calibration))
        else:  # KITTI raw: the folder of a date
            for file in sorted(calibration.glob("calib_*.txt")):
                write_bytes(out / place / file.name, read_bytes(file))
    return kept[calibration]
