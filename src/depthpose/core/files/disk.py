"""Bytes from and to disks, tar shards and object stores; names, and which belong together.

Reading is guarded, writing atomic. A path through a tar shard, ``000000.tar/a.left.png``, is read
as through a folder; a URL is fsspec's.
"""

import json
import os
import re
import secrets
import shutil
import stat
import tarfile
import tempfile
import warnings
from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

from depthpose.core.errors import InputError

AnyPath = str | os.PathLike[str]
"""A path as users give it."""

MAX_FILE_BYTES = 2**28  # largest file that is read whole; a bigger one is a mistake or an attack


@contextmanager
def refused_read(path: AnyPath) -> Iterator[None]:
    """Turn what a disk refuses to give into an :class:`InputError`."""
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path") from error
    except (OSError, MemoryError) as error:
        raise InputError(f"{path}: cannot be read: {error or 'no memory left'}") from error
    except InputError:
        raise
    except ValueError as error:  # a NUL byte in the name
        raise InputError(f"{os.fspath(path)!r}: not a file name: {error}") from error


_ADDRESS = re.compile(r"<[^<>]* at 0x[0-9a-fA-F]+>")  # what Python shows of an object in memory
_PART = ".part-"  # begins the names of files that are being written


@contextmanager
def refused_as(path: AnyPath, kind: str, remedy: str) -> Iterator[None]:
    """Turn whatever a decoder raises on bad bytes into an :class:`InputError`.

    Decoders' warnings are silenced on purpose: they speak of metadata that is not read here, and
    sizes are checked by us.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except InputError:
        raise
    except Exception as error:  # a decoder fed with random bytes may raise anything
        text = _ADDRESS.sub("", f"{type(error).__name__}: {error}")
        said = " ".join(text.split())[:200]
        raise InputError(f"{path}: not a readable {kind} ({said}); {remedy}") from error


@contextmanager
def naming(path: AnyPath) -> Iterator[None]:
    """Begin the message of an :class:`InputError` with the file that it is of."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{path}"):
            raise
        raise InputError(f"{path}: {error}") from error


@contextmanager
def refused_write(path: AnyPath) -> Iterator[None]:
    """Turn what a disk refuses to take into an :class:`InputError`."""
    try:
        yield
    except OSError as error:
        file = next((folder for folder in Path(path).parents if os.path.isfile(folder)), None)  # noqa: PTH113 - which never raises
        if file is not None:
            raise InputError(
                f"{file}: is a file, but a folder is needed there; choose another place"
            ) from error
        raise InputError(
            f"{path}: cannot be written: {error.strerror or error}; "
            "free the space, or choose another place"
        ) from error


def cache_folder() -> Path:
    """Give the folder of what can be fetched or computed again.

    It is ``$DEPTHPOSE_CACHE``, by default ``~/.cache/depthpose``; it need not exist.
    """
    named = os.environ.get("DEPTHPOSE_CACHE")
    return Path(named) if named else Path("~/.cache/depthpose").expanduser()


@contextmanager
def atomic_write(path: AnyPath) -> Iterator[Path]:
    """Write a file whole or not at all.

    Yields a temporary path in the same folder, with the same suffix, to be written inside the
    block. On success it takes the place of ``path``; on any failure or interrupt it is removed
    and ``path`` stays as it was. Missing folders are made.

    Raises:
        InputError: the disk is full, or the place cannot be written to.
    """
    target = Path(path)
    part = target.with_name(f"{_PART}{secrets.token_hex(6)}{target.suffix}")
    try:
        with refused_write(path):
            if target.exists() and not target.is_file():
                # Replacing /dev/null by a file would harm the whole machine.
                raise InputError(
                    f"{target}: a folder or device, which no file may replace; add a name"
                )
            target.parent.mkdir(parents=True, exist_ok=True)
            yield part
            _sync(part)
            part.replace(target)
            _sync(target.parent)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def remove_parts(folder: Path) -> None:
    """Remove what killed writers left in a folder, not below it; none may be at work there."""
    for part in folder.glob(f"{_PART}*"):
        with suppress(OSError):
            part.unlink()


def write_bytes(path: AnyPath, data: bytes) -> None:
    """Write bytes whole or not at all; see :func:`atomic_write`."""
    with atomic_write(path) as part:
        part.write_bytes(data)


def _sync(path: Path) -> None:
    if os.name == "nt":  # which syncs no folder, and no file that is open for reading
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def refused_suffix(path: AnyPath, kind: str, known: tuple[str, ...]) -> InputError:
    """Make the error for a file name with an unknown suffix."""
    suffix = Path(path).suffix or "no suffix"
    return InputError(f"{path}: {suffix} is no {kind} format; use {', '.join(known)}")


_MOST_SHOWN = 6


def natural_order(path: Path) -> tuple[list[list[str | int]], Path]:
    """Give the key that sorts paths by name, and numbers in names by value: 2 before 10."""
    pieces = [re.split(r"(\d+)", part) for part in (*path.parent.parts, path.stem)]
    # Every second piece is a run of digits, so that like is compared with like.
    return [[int(p) if k % 2 else p for k, p in enumerate(part)] for part in pieces], path


def find_partners(first: Sequence[str], second: Sequence[str], said: str) -> list[int]:
    """Give for each name of one side the index of its partner on the other.

    Names belong together that are equal; else those that are equal without what all names of their
    side share (``left_0004`` and ``right_0004``, ``1_L`` and ``1_R``), numbers by value. Two lone
    names belong together unless each has numbers and none of them is the other's.
    """
    keys: tuple[Sequence[Hashable], Sequence[Hashable]] = first, second
    if not set(first) & set(second):
        keys = _own_parts(first, second)
    places = {key: place for place, key in enumerate(keys[1])}
    counts = [Counter(side) for side in keys]
    both = [*zip(first, keys[0], strict=True), *zip(second, keys[1], strict=True)]
    lone = [name for name, key in both if counts[0][key] != 1 or counts[1][key] != 1]
    if lone:
        shown = ", ".join(map(repr, lone[:_MOST_SHOWN])) + (", ..." if lone[_MOST_SHOWN:] else "")
        raise InputError(
            f"{said} hold {len(first)} and {len(second)} files, and no partner of the same name or "
            f"number is there for {shown}; remove these, add their partners, or rename them"
        )
    return [places[key] for key in keys[0]]


def _own_parts(first: Sequence[str], second: Sequence[str]) -> tuple[list[Any], list[Any]]:
    """Take from each name what the names of its side share, and read numbers by value."""
    split = [[re.split(r"(\d+)", name) for name in side] for side in (first, second)]
    if len(first) == len(second) == 1:
        numbers = [{int(piece) for piece in side[0][1::2]} for side in split]
        is_other = all(numbers) and not numbers[0] & numbers[1]
        return [first[0] if is_other else ""], [second[0] if is_other else ""]
    if len({len(pieces) for side in split for pieces in side}) > 1:
        split = [[[name] for name in side] for side in (first, second)]
    keys: list[list[tuple[str, ...]]] = [[() for _ in side] for side in split]
    for k in range(len(split[0][0])):
        columns = [[pieces[k] for pieces in side] for side in split]
        if all(len(set(column)) == 1 for column in columns):
            continue  # the side, or what both share
        for side, column in enumerate(columns):
            texts = column
            for turn in (1, -1):
                turned = [text[::turn] for text in texts]
                low, high = min(turned), max(turned)  # what these two share, all share
                ends = (k for k, (a, b) in enumerate(zip(low, high, strict=False)) if a != b)
                shared = re.sub(r"\d+$", "", low[: next(ends, len(low))])
                texts = [text[len(shared) :][::turn] for text in turned]
            parts = [re.sub(r"\d+", lambda found: str(int(found[0])), text) for text in texts]
            keys[side] = [(*key, part) for key, part in zip(keys[side], parts, strict=True)]
    return keys[0], keys[1]


SOURCE = "source.json"  # beside shards fetched when first read: {"url": ...}, where from
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
        if shard is None:
            status = inside.stat()
            if stat.S_ISDIR(status.st_mode):
                raise InputError(f"{path}: a folder where a file is needed; name a file inside it")
            if not stat.S_ISREG(status.st_mode):
                raise InputError(
                    f"{path}: a device or pipe; save its content to a regular file first"
                )
            if status.st_size > most:
                raise InputError(
                    f"{path}: {status.st_size} bytes, more than the {most} that are read of such a "
                    "file; thin it out or split it"
                )
            return inside.read_bytes()
        name = inside.relative_to(shard).as_posix()
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
            raise InputError(
                f"{shard}/{name}: {size} bytes, more than the {most} that are read of it"
            )
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
        return read_bytes(path)
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
        return {p.name: read_bytes(p) for p in sorted(path.glob(f"*{suffix}")) if _shown(p.name)}
    with _file_system(folder, "listed") as (fs, inner):
        names = sorted(e["name"] for e in _details(fs, inner) if e["name"].endswith(suffix))
        return {PurePosixPath(name).name: fs.cat_file(name) for name in names}


def publish(file: Path, url: str) -> None:
    """Put a finished local file under its final name, whole or not at all."""
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
    if (path := local_path(url)) is not None:
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
    """List files, not hidden ones, by their suffixes: one, those of a folder or of a pattern."""
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
