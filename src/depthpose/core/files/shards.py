"""Files in tar shards, read as if each shard were a folder: ``000000.tar/a.left.png``."""

import json
import tarfile
from functools import lru_cache
from pathlib import Path, PurePosixPath

from depthpose.core.errors import InputError
from depthpose.core.files.disk import MAX_FILE_BYTES, AnyPath, read_file, refused_read

SOURCE = "source.json"
"""Beside shards that are fetched when they are first read: ``{"url": ...}``, where from."""
_SUFFIX = ".tar"


def read_bytes(path: AnyPath, most: int = MAX_FILE_BYTES) -> bytes:
    """Read a regular file whole, or one in a shard; more than ``most`` bytes are refused unread.

    Raises:
        InputError: there is no such file, or it is none that can be read.
    """
    with refused_read(path):
        member = split_member(Path(path))
        if member is not None:
            return read_member(*member, most)
    return read_file(path, most)


def split_member(path: Path) -> tuple[Path, str] | None:
    """Take a path apart at the shard that it leads through; None where it leads through none."""
    if f"{_SUFFIX}/" not in path.as_posix():
        return None
    for parent in path.parents:
        if parent.suffix == _SUFFIX and not parent.is_dir():
            return parent, str(PurePosixPath(*path.relative_to(parent).parts))
    return None


def read_member(shard: Path, name: str, most: int) -> bytes:
    """Read a file of a shard; a shard that is not here yet is fetched first.

    Args:
        shard: the tar file.
        name: of the file in it.
        most: bytes beyond which it is refused unread.

    Raises:
        InputError: there is no such shard or file, it is damaged or too large, or the store that
            it comes from does not answer.
    """
    if not shard.exists():
        _fetch(shard)
    status = shard.stat()
    found = _places(shard, status.st_mtime_ns, status.st_size).get(name)
    if found is None:
        raise InputError(f"{shard}: holds no file {name!r}; pack the data set again")
    offset, size = found
    if size > most:
        raise InputError(f"{shard}/{name}: {size} bytes, more than the {most} that are read of it")
    with shard.open("rb") as file:
        file.seek(offset)
        data = file.read(size)
    if len(data) < size:
        raise InputError(f"{shard}: ends within {name!r}; pack or fetch it again")
    return data


@lru_cache(maxsize=4096)
def _places(shard: Path, _changed_ns: int, _size: int) -> dict[str, tuple[int, int]]:
    """Say where each file of a shard begins, and how many bytes it has."""
    try:
        with tarfile.open(shard, "r:") as tar:
            return {m.name: (m.offset_data, m.size) for m in tar if m.isfile() and not m.sparse}
    except (tarfile.TarError, OSError, EOFError) as error:
        raise InputError(f"{shard}: not a readable tar shard ({error}); pack it again") from error


def _fetch(shard: Path) -> None:
    """Fetch a shard from its folder's location."""
    from depthpose.core.files.store import fetch, join  # fsspec takes time to load

    source = shard.parent / SOURCE
    if not source.is_file():
        raise InputError(f"{shard}: no such file; check the path")
    fetch(join(json.loads(source.read_text())["url"], shard.name), shard)
