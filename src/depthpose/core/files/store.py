"""Files in tar shards, and in object stores: by path or fsspec URL, published whole.

A path that leads through a tar shard, ``000000.tar/a.left.png``, is read as through a folder.
"""

import json
import shutil
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

from depthpose.core.errors import InputError
from depthpose.core.files.disk import (
    MAX_FILE_BYTES,
    AnyPath,
    atomic_write,
    natural_order,
    read_file,
    refused_read,
)

SOURCE = "source.json"
"""Beside shards that are fetched when they are first read: ``{"url": ...}``, where from."""
_STORES = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss")
"""Stores in which an upload appears whole or not at all."""


def read_bytes(path: AnyPath, most: int = MAX_FILE_BYTES) -> bytes:
    """Read a regular file whole, or one in a shard; more than ``most`` bytes are refused unread.

    A shard that is not here yet is fetched first, from where its folder's ``source.json`` says.

    Raises:
        InputError: there is no such file, or it is none that can be read; the shard is damaged, or
            the store that it comes from does not answer.
    """
    inside = Path(path)
    with refused_read(path):
        is_in_shard = ".tar/" in inside.as_posix()
        shards = (p for p in inside.parents if is_in_shard and p.suffix == ".tar")
        shard = next((p for p in shards if not p.is_dir()), None)
        if shard is not None:
            return _read_member(shard, inside.relative_to(shard).as_posix(), most)
    return read_file(path, most)


def _read_member(shard: Path, name: str, most: int) -> bytes:
    if not shard.exists():
        source = shard.parent / SOURCE
        if not source.is_file():
            raise InputError(f"{shard}: no such file; check the path")
        fetch(join(json.loads(source.read_text())["url"], shard.name), shard)
    status = shard.stat()
    place = _places(shard, status.st_mtime_ns, status.st_size).get(name)
    if place is None:
        raise InputError(f"{shard}: holds no file {name!r}; pack the data set again")
    offset, size = place
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


def is_url(path: str) -> bool:
    """Whether a path names its file system: ``s3://bucket/key``."""
    return "://" in path


def local_path(url: str) -> Path | None:
    """Give the local path behind a path or ``file://`` URL; None in an object store."""
    if not is_url(url):
        return Path(url)
    protocol, _, rest = url.partition("://")
    return Path(rest) if protocol in ("file", "local") else None


def join(folder: str, *names: str) -> str:
    """Join names to a folder or its URL."""
    return "/".join([folder.rstrip("/"), *names])


def absolute(path: str) -> str:
    """Give a path that means the same in every process; URLs do already."""
    local = local_path(path)
    return path if local is None else str(local.absolute())


def read_from(url: str) -> bytes:
    """Read a file whole."""
    path = local_path(url)
    if path is not None:
        return read_file(path)
    with _file_system(url, "read") as (fs, inner):
        return fs.cat_file(inner)


def exists(url: str) -> bool:
    """Whether there is a file."""
    path = local_path(url)
    if path is not None:
        return path.is_file()
    with _file_system(url, "looked for") as (fs, inner):
        return bool(fs.isfile(inner))


def read_all(folder: str, suffix: str) -> dict[str, bytes]:
    """Read the files of a folder, not below it, by suffix; none where there is no folder."""
    path = local_path(folder)
    if path is not None:
        return {p.name: read_file(p) for p in sorted(path.glob(f"*{suffix}")) if _shown(p.name)}
    with _file_system(folder, "listed") as (fs, inner):
        names = [e["name"] for e in _details(fs, inner) if e["name"].endswith(suffix)]
        contents = fs.cat(names) if names else {}
        return {PurePosixPath(p).name: contents[p] for p in sorted(contents)}


def publish(file: Path, url: str) -> None:
    """Put a finished local file under its final name, whole or not at all.

    On a disk it is copied beside the place and renamed; an object store shows an upload only when
    it is complete.
    """
    path = local_path(url)
    if path is not None:
        with atomic_write(path) as part:
            shutil.copyfile(file, part)
        return
    refuse_unsafe(url)
    with _file_system(url, "written") as (fs, inner):
        fs.put_file(str(file), inner)


def publish_bytes(data: bytes, url: str) -> None:
    """Put bytes under a name, whole or not at all; see :func:`publish`."""
    with tempfile.TemporaryDirectory(prefix="depthpose-") as scratch:
        file = Path(scratch) / "part"
        file.write_bytes(data)
        publish(file, url)


def refuse_unsafe(url: str) -> None:
    """Refuse a place for results where a killed upload may leave half a file."""
    protocol = url.partition("://")[0]
    if local_path(url) is None and protocol not in _STORES:
        raise InputError(
            f"{url}: {protocol}:// may show half a file when an upload is cut off; write results "
            f"to a local path, or to one of {', '.join(f'{name}://' for name in _STORES)}"
        )


def local_copy(url: str, scratch: Path) -> Path:
    """Give a file as a local path: itself on a disk, else a copy in a new folder in ``scratch``.

    Raises:
        InputError: it is in a store and cannot be read there.
    """
    path = local_path(url)
    if path is not None:
        return path
    copy = Path(tempfile.mkdtemp(dir=scratch)) / PurePosixPath(url).name
    with _file_system(url, "read") as (fs, inner):
        fs.get_file(inner, str(copy))
    return copy


def fetch(url: str, path: Path) -> None:
    """Copy a file to the disk, whole or not at all."""
    with atomic_write(path) as part, _file_system(url, "read") as (fs, inner):
        fs.get_file(inner, str(part))


@contextmanager
def opened(url: str) -> Iterator[Any]:
    """Open a file for reading from its beginning to its end."""
    with _file_system(url, "read") as (fs, inner):
        file = fs.open(inner, "rb")
    with file:
        yield file


def list_files(path: str, suffixes: Sequence[str]) -> list[str]:
    """List files by their suffixes: a file itself, those of a folder, or those of a pattern.

    Args:
        path: a path or URL of a file, a folder, or a pattern with ``*``, ``?`` or ``**``.
        suffixes: in lower case, with the dot.

    Returns:
        Paths or URLs in the order of their names; hidden files are left out.

    Raises:
        InputError: nothing was found.
    """
    with _file_system(path, "listed") as (fs, inner):
        if fs.isfile(inner):
            files = [inner]
        elif fs.isdir(inner) or not any(mark in inner for mark in "*?["):
            files = [entry["name"] for entry in _details(fs, inner)]
        else:
            # Brackets in the name of a folder that is there stand for themselves.
            home, _, rest = inner.rpartition("/")
            while "[" in home and not fs.isdir(home):
                home, _, last = home.rpartition("/")
                rest = f"{last}/{rest}"
            files = fs.glob(f"{home.replace('[', '[[]')}/{rest}" if "[" in home else inner)
    kept = [p for p in files if PurePosixPath(p).suffix.lower() in suffixes and _shown(p)]
    kept.sort(key=lambda p: natural_order(Path(p)))
    if not kept:
        raise InputError(
            f"{path}: no {', '.join(suffixes)} file there; give a file, a folder or a pattern"
        )
    prefix = f"{path.partition('://')[0]}://" if is_url(path) else ""
    return [f"{prefix}{p}" for p in kept]


def list_sizes(folder: str) -> dict[str, int]:
    """Give the sizes [bytes] of the files of a folder, by name; none where there is no folder."""
    with _file_system(folder, "listed") as (fs, inner):
        return {PurePosixPath(e["name"]).name: int(e["size"]) for e in _details(fs, inner)}


def remove(url: str) -> None:
    """Remove a file."""
    with _file_system(url, "removed") as (fs, inner):
        fs.rm_file(inner)


def list_tree(url: str) -> dict[str, str]:
    """List all files below a folder: their URLs by their names in it; none without a folder."""
    with _file_system(url, "listed") as (fs, inner):
        root = inner.rstrip("/")
        names = [path.removeprefix(root).lstrip("/") for path in fs.find(inner)]
    return {name: join(url, name) for name in sorted(names)}


def _details(fs: Any, folder: str) -> list[dict[str, Any]]:  # noqa: ANN401  fsspec has no types
    try:
        return [entry for entry in fs.ls(folder, detail=True) if entry["type"] == "file"]
    except FileNotFoundError:
        return []


def _shown(path: str) -> bool:
    return not PurePosixPath(path).name.startswith(".")


@contextmanager
def _file_system(url: str, done: str) -> Iterator[tuple[Any, str]]:
    """Give the file system of a URL and the path there; its errors become :class:`InputError`."""
    try:
        from fsspec.core import url_to_fs  # takes time to load

        fs, inner = url_to_fs(url)
        fs.invalidate_cache()
        yield fs, inner
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"{url}: no such file; check the path") from error
    except ImportError as error:
        raise InputError(f"{url}: its file system is not installed: {error}") from error
    except Exception as error:  # each file system raises errors of its own
        said = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(
            f"{url}: cannot be {done} ({said}); check the address and the credentials"
        ) from error
