"""One command at a time writes into a folder."""

import json
import os
import time
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from depthpose.core.errors import InputError
from depthpose.core.files import write_json
from depthpose.core.files.disk import refused_write

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None


def write_once(record: Path, content: Mapping[str, Any]) -> None:
    """Write the record of a run, unless another process has just done so."""
    own = record.with_name(f".part-{os.getpid()}-{record.name}")
    with refused_write(record):
        record.parent.mkdir(parents=True, exist_ok=True)
    write_json(own, content)
    try:
        with suppress(FileExistsError):
            os.link(own, record)
    except OSError:  # a file system without links
        write_json(record, content)
    finally:
        own.unlink(missing_ok=True)


_locks: dict[Path, int] = {}
"""Records of the folders that this process writes to, locked, and their descriptors."""


def lock_folder(record: Path, *, is_shared: bool, timeout_s: float = 10.0) -> bool:
    """Lock a folder against other commands until :func:`release_folders`, or the process ends.

    A POSIX lock: it ends with the process, however that ends, and workers do not inherit it.
    Where the file system or the machine has none, nothing is held.

    Args:
        record: a file in the folder that no command replaces.
        is_shared: let other processes of the same launch in.
        timeout_s: how long another command may take to end.

    Returns:
        Whether the folder is this process's alone from now on.

    Raises:
        InputError: another command holds the folder, and goes on holding it; or nothing can be
            written there.
    """
    if fcntl is None:
        return False
    # Reading the record has let the lock go: a POSIX lock ends as its file is closed anywhere.
    held = _locks.get(record.resolve())
    with refused_write(record):
        file = os.open(record, os.O_RDWR) if held is None else held
    kind = fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX
    last = time.monotonic() + timeout_s
    while True:
        try:
            fcntl.lockf(file, kind | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() > last:
                _close(record, file)
                raise InputError(
                    f"{record.parent}: another command is writing there; wait until it has ended, "
                    "or choose another folder"
                ) from error
            time.sleep(0.1)
        except OSError:  # no locks on this file system
            _close(record, file)
            return False
        else:
            _locks[record.resolve()] = file
            return held is None and not is_shared


def rewrite_record(record: Path, content: Mapping[str, Any]) -> None:
    """Write other content into the record of a folder that this process has locked.

    Through the file that holds the lock: another one would let it go when it is closed.
    """
    file = _locks.get(record.resolve())
    if file is None:  # no locks here
        write_json(record, content)
        return
    data = f"{json.dumps(content, indent=2)}\n".encode()
    os.pwrite(file, data, 0)
    os.ftruncate(file, len(data))


def _close(record: Path, file: int) -> None:
    _locks.pop(record.resolve(), None)
    os.close(file)


def held_folders() -> frozenset[Path]:
    """Give the records of the folders that this process holds."""
    return frozenset(_locks)


def release_folders(but: Collection[Path] = ()) -> None:
    """Let other commands into the folders that this process has claimed.

    Args:
        but: records of folders that it goes on holding.
    """
    for record in [record for record in _locks if record not in but]:
        os.close(_locks.pop(record))
