"""Bytes from and to the disk: guarded reading, atomic writing."""

import os
import re
import secrets
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from depthpose.core.errors import InputError

AnyPath = str | os.PathLike[str]
"""A path as users give it."""

MAX_FILE_BYTES = 2**28
"""Nothing that is read whole is larger; a bigger file is a mistake or an attack."""


def read_file(path: AnyPath, most: int = MAX_FILE_BYTES) -> bytes:
    """Read a regular file whole.

    Args:
        path: the file.
        most: bytes beyond which it is refused unread: files of its kind are smaller.

    Raises:
        InputError: there is no such file, or it is a folder, a device, too large or unreadable.
    """
    with refused_read(path):
        _refuse_irregular(path, Path(path).stat(), most)
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


def _refuse_irregular(path: AnyPath, status: os.stat_result, most: int) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise InputError(f"{path}: a folder where a file is needed; name a file inside it")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: a device or pipe; save its content to a regular file first")
    if status.st_size > most:
        raise InputError(
            f"{path}: {status.st_size} bytes, more than the {most} that are read of such a file; "
            "thin it out or split it"
        )


_ADDRESS = re.compile(r"<[^<>]* at 0x[0-9a-fA-F]+>")
"""What Python shows of an object in memory."""
_PART = ".part-"
"""Begins the names of files that are being written."""


@contextmanager
def refused_as(path: AnyPath, kind: str, remedy: str) -> Iterator[None]:
    """Turn whatever a decoder raises on bad bytes into an :class:`InputError`.

    Decoders' warnings are silenced on purpose: they speak of metadata that is not read here, and
    sizes are checked by us.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:  # a decoder fed with random bytes may raise anything
        text = _ADDRESS.sub("", f"{type(error).__name__}: {error}")
        said = " ".join(text.split())[:200]
        raise InputError(f"{path}: not a readable {kind} ({said}); {remedy}") from error


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
            _refuse_to_replace(target)
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


def _refuse_to_replace(target: Path) -> None:
    # Replacing /dev/null by a file would harm the whole machine.
    if target.exists() and not target.is_file():
        raise InputError(f"{target}: a folder or device, which no file may replace; add a name")


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
