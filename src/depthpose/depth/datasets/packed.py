"""Datasets packed into tar shards, for object stores: writing, finding and fetching them."""

import hashlib
import io
import re
import tarfile
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

from depthpose.core import files
from depthpose.core.errors import InputError, suggest_name
from depthpose.core.files.disk import SOURCE, write_bytes
from depthpose.depth.datasets.frames import CALIBRATION_STYLES, FramePaths

INDEX = "index.json"
"""File of a packed dataset that lists its frames; written last."""
_CALIBRATION = "calibration"
_PACKED_FIELDS = ("left", "right", "velodyne", "scan", "depth", "disparity", "disparity_noc", "sky")
_URL = re.compile(r"([a-z][a-z0-9+]+):/+(?=[^/])")


def pack_frames(
    frames: list[FramePaths],
    out: Path,
    shard_bytes: int,
    show: Callable[[str], object] = lambda _: None,
) -> int:
    """Copy frames into tar shards, in WebDataset's form, and return the number of shards.

    Files are copied as they are, so that a training on shards gives the weights that it would give
    on the folder. ``KEY.left.png`` and the like lie in ``000000.tar``, calibration in
    ``calibration/``, and ``index.json`` lists each frame's files. Each file is written whole or not
    at all, the index last; a second call removes what an interrupted one left half-written, and
    writes everything again.

    Args:
        frames: the frames.
        out: the folder of the shards.
        shard_bytes: a shard is closed when it has at least so many bytes.
        show: called with the name of each frame.

    Raises:
        InputError: a file is missing or damaged, or the disk refuses.
    """
    files.remove_parts(out)
    packed_calibrations = _pack_calibrations(frames, out)
    rows: list[dict[str, Any]] = []
    remaining = deque(frames)
    shard_count = 0
    while remaining:
        # A shard is filled until it is large enough, or no frame is left.
        shard = f"{shard_count:06d}.tar"
        size = 0
        with files.atomic_write(out / shard) as part, tarfile.open(part, "w") as tar:
            while remaining:
                frame = remaining.popleft()
                row: dict[str, Any] = {"name": frame.name, "style": frame.style}
                for field in _PACKED_FIELDS:
                    path = getattr(frame, field)
                    if path is not None:
                        member = f"{len(rows):08d}.{field}{path.suffix.lower()}"
                        size += _add_member(tar, member, files.read_bytes(path))
                        row[field] = f"{shard}/{member}"
                if frame.calibration is not None:
                    row["calibration"] = packed_calibrations[frame.calibration]
                rows.append(row)
                show(frame.name)
                if size >= shard_bytes:
                    break
        shard_count += 1
    files.write_json(out / INDEX, {"frames": rows})
    return shard_count


def _add_member(tar: tarfile.TarFile, name: str, data: bytes) -> int:
    """Add a file to a shard, and return its size [bytes]."""
    member = tarfile.TarInfo(name)
    member.size = len(data)
    tar.addfile(member, io.BytesIO(data))
    return len(data)


def _pack_calibrations(frames: list[FramePaths], out: Path) -> dict[Path, str]:
    """Copy the calibrations of frames; return the path in ``out`` of each."""
    packed: dict[Path, str] = {}
    for calibration in dict.fromkeys(frame.calibration for frame in frames if frame.calibration):
        path = f"{_CALIBRATION}/{len(packed):06d}"
        if calibration.is_file():
            path += calibration.suffix
            write_bytes(out / path, files.read_bytes(calibration))
        else:  # KITTI raw: the folder of a date
            for file in sorted(calibration.glob("calib_*.txt")):
                write_bytes(out / path / file.name, files.read_bytes(file))
        packed[calibration] = path
    return packed


def find_packed_frames(folder: Path) -> Iterator[FramePaths]:
    """List the frames of a packed dataset; none where there is no index.

    Raises:
        InputError: the index is damaged, or names a file outside of the folder.
    """
    index = folder / INDEX
    if not index.is_file():
        return
    content = files.read_json(index)
    rows = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(rows, list):
        return  # an index of another program
    known_fields = {field.name for field in fields(FramePaths)}
    required_fields = {"name", "style", "left"}
    for number, row in enumerate(rows):
        has_fields = isinstance(row, dict) and required_fields <= set(row) <= known_fields
        if not has_fields or not all(isinstance(value, str) for value in row.values()):
            raise InputError(f"{index}: frame {number} is not as 'depthpose data pack' writes it")
        if row["style"] not in CALIBRATION_STYLES:
            hint = suggest_name(row["style"], CALIBRATION_STYLES)
            raise InputError(f"{index}: frame {number} has the style {row['style']!r}; {hint}")
        paths = {
            field: folder / path for field, path in row.items() if field not in ("name", "style")
        }
        if not all(path.resolve().is_relative_to(folder.resolve()) for path in paths.values()):
            raise InputError(f"{index}: frame {number} names a file outside of the folder")
        yield FramePaths(name=row["name"], style=row["style"], **paths)


def resolve_folder(folder: Path | str) -> Path:
    """Return the folder itself; for a URL of packed shards, a local folder in their place.

    The local folder is in ``$DEPTHPOSE_CACHE``, by default ``~/.cache/depthpose``. Index and
    calibration are fetched at once, shards when they are read.

    Raises:
        InputError: the URL has no index of packed shards.
    """
    text = str(folder)
    if _URL.match(text) is None:
        return Path(folder)
    url = _URL.sub(r"\1://", text, count=1).rstrip("/")  # Path made one slash of two
    local = files.cache_folder() / "shards" / hashlib.sha256(url.encode()).hexdigest()[:16]
    from depthpose.core.files.disk import fetch  # fsspec takes time
    from depthpose.core.files.stores import exists, join, list_tree

    if not exists(join(url, INDEX)):
        raise InputError(f"{url}: holds no {INDEX}; 'depthpose data pack' makes one")
    for name, file_url in list_tree(join(url, _CALIBRATION)).items():
        if ".." not in Path(name).parts:
            fetch(file_url, local / _CALIBRATION / name)
    fetch(join(url, INDEX), local / INDEX)
    files.write_json(local / SOURCE, {"url": url})
    return local
