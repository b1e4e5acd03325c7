"""Files and folders on a disk or in an object store, by path or URL (``s3://bucket/key``)."""

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from depthpose.core.errors import InputError
from depthpose.core.files.disk import atomic_write, natural_sort_key, open_file_system, read_bytes

_ATOMIC_STORES = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss")
"""Protocols of stores in which an upload appears whole or not at all."""


def local_path(url: str) -> Path | None:
    """Return the local path that a path or ``file://`` URL names; None for an object store."""
    if "://" not in url:
        return Path(url)
    protocol, _, rest = url.partition("://")
    return Path(rest) if protocol in ("file", "local") else None


def join(folder: str, *names: str) -> str:
    """Join names to a folder or its URL."""
    return "/".join([folder.rstrip("/"), *names])


def absolute(path: str) -> str:
    """Make a local path absolute; a URL is returned as it is."""
    local = local_path(path)
    return path if local is None else str(local.absolute())


def read_from(url: str) -> bytes:
    """Read the bytes of a file by its path or URL.

    Raises:
        InputError: it is missing or cannot be read.
    """
    path = local_path(url)
    if path is not None:
        return read_bytes(path)
    with open_file_system(url, "read") as (fs, inner):
        return fs.cat_file(inner)


def exists(url: str) -> bool:
    """Whether there is a file at a path or URL; folders are none."""
    path = local_path(url)
    if path is not None:
        return path.is_file()
    with open_file_system(url, "looked for") as (fs, inner):
        return bool(fs.isfile(inner))


def read_all(folder: str, suffix: str) -> dict[str, bytes]:
    """Read all files of a folder that have a suffix: their contents by their names.

    Hidden files and subfolders are left out. Empty where there is no such folder.
    """
    path = local_path(folder)
    if path is not None:
        files = sorted(file for file in path.glob(f"*{suffix}") if not file.name.startswith("."))
        return {file.name: read_bytes(file) for file in files}
    with open_file_system(folder, "listed") as (fs, inner):
        paths = sorted(entry["name"] for entry in _list_entries(fs, inner))
        return {
            PurePosixPath(path).name: fs.cat_file(path) for path in paths if path.endswith(suffix)
        }


def publish(content: bytes | Path, url: str) -> None:
    """Write bytes, or copy a local file, to a path or URL, whole or not at all.

    Raises:
        InputError: nothing can be written there, or a killed upload might leave half a file.
    """
    path = local_path(url)
    if path is not None:
        with atomic_write(path) as part:
            if isinstance(content, bytes):
                part.write_bytes(content)
            else:
                shutil.copyfile(content, part)
        return
    refuse_unsafe(url)
    with open_file_system(url, "written") as (fs, inner):
        if isinstance(content, bytes):
            fs.pipe_file(inner, content)
        else:
            fs.put_file(str(content), inner)


def refuse_unsafe(url: str) -> None:
    """Refuse a URL whose store may show half a file after a killed upload.

    Raises:
        InputError: it does.
    """
    protocol = url.partition("://")[0]
    if local_path(url) is None and protocol not in _ATOMIC_STORES:
        raise InputError(
            f"{url}: {protocol}:// may show half a file when an upload is cut off; write results "
            f"to a local path, or to one of {', '.join(f'{name}://' for name in _ATOMIC_STORES)}"
        )


def local_copy(url: str, scratch: Path) -> Path:
    """Return the local path of a file; one in a store is copied into a new folder in ``scratch``.

    Raises:
        InputError: it is in a store and cannot be read there.
    """
    if (path := local_path(url)) is not None:
        return path
    copy = Path(tempfile.mkdtemp(dir=scratch)) / PurePosixPath(url).name
    with open_file_system(url, "read") as (fs, inner):
        fs.get_file(inner, str(copy))
    return copy


def list_files(path: str, suffixes: Sequence[str]) -> list[str]:
    """List the files that a path, folder or pattern names, as paths or URLs sorted by name.

    Hidden files are left out; numbers in names are sorted by their value.

    Args:
        path: path or URL of a file or a folder, or a pattern of such.
        suffixes: suffixes of the files, in lower case.

    Raises:
        InputError: there is no such file.
    """
    with open_file_system(path, "listed") as (fs, inner):
        if fs.isfile(inner):
            listed = [inner]
        elif fs.isdir(inner) or not any(sign in inner for sign in "*?["):
            # What is missing is listed as an empty folder.
            listed = [entry["name"] for entry in _list_entries(fs, inner)]
        else:
            listed = fs.glob(_escape_folder(fs, inner))
    files: list[str] = []
    for file in listed:
        is_hidden = PurePosixPath(file).name.startswith(".")
        if not is_hidden and PurePosixPath(file).suffix.lower() in suffixes:
            files.append(file)
    files.sort(key=lambda file: natural_sort_key(Path(file)))
    if not files:
        raise InputError(
            f"{path}: no {', '.join(suffixes)} file there; give a file, a folder or a pattern"
        )
    protocol = f"{path.partition('://')[0]}://" if "://" in path else ""
    return [f"{protocol}{file}" for file in files]


def _escape_folder(fs: Any, pattern: str) -> str:  # noqa: ANN401  fsspec has no types
    """Escape brackets in the folder of a pattern, as far as a folder of that very name exists."""
    folder, _, rest = pattern.rpartition("/")
    while "[" in folder and not fs.isdir(folder):
        folder, _, last = folder.rpartition("/")
        rest = f"{last}/{rest}"
    if "[" not in folder:
        return pattern
    return f"{folder.replace('[', '[[]')}/{rest}"


def list_sizes(folder: str) -> dict[str, int]:
    """List the sizes [bytes] of the files of a folder, by name; empty where there is no folder."""
    with open_file_system(folder, "listed") as (fs, inner):
        entries = _list_entries(fs, inner)
    return {PurePosixPath(entry["name"]).name: int(entry["size"]) for entry in entries}


def list_tree(url: str) -> dict[str, str]:
    """List all files in a folder and below: their URLs by their paths in it.

    Empty where there is no such folder.
    """
    with open_file_system(url, "listed") as (fs, inner):
        root = inner.rstrip("/")
        names = [path.removeprefix(root).lstrip("/") for path in fs.find(inner)]
    return {name: join(url, name) for name in sorted(names)}


def _list_entries(fs: Any, folder: str) -> list[dict[str, Any]]:  # noqa: ANN401  fsspec has no types
    """List fsspec's entries (name, size and more) of the files of a folder; empty without it."""
    try:
        return [entry for entry in fs.ls(folder, detail=True) if entry["type"] == "file"]
    except FileNotFoundError:
        return []
