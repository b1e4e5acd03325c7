"""Files and folders by path or URL (``s3://bucket/key``): a disk, or fsspec's file systems."""

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from depthpose.core.errors import InputError
from depthpose.core.files.disk import atomic_write, file_system, natural_order, read_bytes

_STORES = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss")
"""Stores in which an upload appears whole or not at all."""


def local_path(url: str) -> Path | None:
    """Give the local path behind a path or ``file://`` URL; None in an object store."""
    if "://" not in url:
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
        return read_bytes(path)
    with file_system(url, "read") as (fs, inner):
        return fs.cat_file(inner)


def exists(url: str) -> bool:
    """Whether there is a file."""
    path = local_path(url)
    if path is not None:
        return path.is_file()
    with file_system(url, "looked for") as (fs, inner):
        return bool(fs.isfile(inner))


def read_all(folder: str, suffix: str) -> dict[str, bytes]:
    """Read the files of a folder, not below it, by suffix; none where there is no folder."""
    path = local_path(folder)
    if path is not None:
        files = sorted(p for p in path.glob(f"*{suffix}") if not p.name.startswith("."))
        return {file.name: read_bytes(file) for file in files}
    with file_system(folder, "listed") as (fs, inner):
        names = sorted(e["name"] for e in _details(fs, inner) if e["name"].endswith(suffix))
        return {PurePosixPath(name).name: fs.cat_file(name) for name in names}


def publish(content: bytes | Path, url: str) -> None:
    """Put bytes, or a finished local file, under a final name, whole or not at all."""
    path = local_path(url)
    if path is not None:
        with atomic_write(path) as part:
            if isinstance(content, bytes):
                part.write_bytes(content)
            else:
                shutil.copyfile(content, part)
        return
    refuse_unsafe(url)
    with file_system(url, "written") as (fs, inner):
        if isinstance(content, bytes):
            fs.pipe_file(inner, content)
        else:
            fs.put_file(str(content), inner)


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
    if (path := local_path(url)) is not None:
        return path
    copy = Path(tempfile.mkdtemp(dir=scratch)) / PurePosixPath(url).name
    with file_system(url, "read") as (fs, inner):
        fs.get_file(inner, str(copy))
    return copy


def list_files(path: str, suffixes: Sequence[str]) -> list[str]:
    """List files, not hidden ones, by their suffixes: one, those of a folder or of a pattern."""
    with file_system(path, "listed") as (fs, inner):
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
    shown = (p for p in files if not PurePosixPath(p).name.startswith("."))
    files = [p for p in shown if PurePosixPath(p).suffix.lower() in suffixes]
    files.sort(key=lambda p: natural_order(Path(p)))
    if not files:
        raise InputError(
            f"{path}: no {', '.join(suffixes)} file there; give a file, a folder or a pattern"
        )
    prefix = f"{path.partition('://')[0]}://" if "://" in path else ""
    return [f"{prefix}{p}" for p in files]


def list_sizes(folder: str) -> dict[str, int]:
    """Give the sizes [bytes] of the files of a folder, by name; none where there is no folder."""
    with file_system(folder, "listed") as (fs, inner):
        return {PurePosixPath(e["name"]).name: int(e["size"]) for e in _details(fs, inner)}


def list_tree(url: str) -> dict[str, str]:
    """List all files below a folder: their URLs by their names in it; none without a folder."""
    with file_system(url, "listed") as (fs, inner):
        root = inner.rstrip("/")
        names = [path.removeprefix(root).lstrip("/") for path in fs.find(inner)]
    return {name: join(url, name) for name in sorted(names)}


def _details(fs: Any, folder: str) -> list[dict[str, Any]]:  # noqa: ANN401  fsspec has no types
    try:
        return [entry for entry in fs.ls(folder, detail=True) if entry["type"] == "file"]
    except FileNotFoundError:
        return []
