"""Bytes from and to the disk: guarded reading, atomic writing; names, and which belong together."""

import os
import re
import secrets
import stat
import warnings
from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from depthpose.core.errors import InputError

AnyPath = str | os.PathLike[str]
"""A path as users give it."""

MAX_FILE_BYTES = 2**28  # largest file that is read whole; a bigger one is a mistake or an attack


def read_file(path: AnyPath, most: int = MAX_FILE_BYTES) -> bytes:
    """Read a regular file whole."""
    with refused_read(path):
        status = Path(path).stat()
        if stat.S_ISDIR(status.st_mode):
            raise InputError(f"{path}: a folder where a file is needed; name a file inside it")
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path}: a device or pipe; save its content to a regular file first")
        if status.st_size > most:
            raise InputError(
                f"{path}: {status.st_size} bytes, more than the {most} that are read of such a "
                "file; thin it out or split it"
            )
        return Path(path).read_bytes()


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
    """Turn what a disk refuses to take into an :class:`InputError`.

    Encoders that hide the disk's own error (torch's, safetensors') write to memory first.
    """
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
            parts = _without_shared(column)
            keys[side] = [(*key, part) for key, part in zip(keys[side], parts, strict=True)]
    return keys[0], keys[1]


def _without_shared(texts: list[str]) -> list[str]:
    """Cut the beginning and the end that all have, but within no number; drop leading zeros."""
    for turn in (1, -1):
        turned = [text[::turn] for text in texts]
        low, high = min(turned), max(turned)  # what these two share, all share
        ends = (k for k, (a, b) in enumerate(zip(low, high, strict=False)) if a != b)
        shared = re.sub(r"\d+$", "", low[: next(ends, len(low))])
        texts = [text[len(shared) :][::turn] for text in turned]
    return [re.sub(r"\d+", lambda found: str(int(found[0])), text) for text in texts]
