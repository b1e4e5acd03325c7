"""Which files each result of a folder is made of, so that what is damaged or missing is noticed.

A line of ``results.jsonl`` names a result, and size, time and checksum of its files. A rerun
compares sizes and times; a file is read again only where its time is another one, as of a copy.
"""

import json
import os
import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from depthpose.core.files.disk import refused_write

RESULTS = "results.jsonl"
_CHUNK_BYTES = 2**22

_read: dict[Path, tuple[int, int, dict[str, dict[str, Any]]]] = {}
"""Cache by results file: its inode, up to which byte it was read, and the results in it."""


def file_stamp(path: Path) -> list[int]:
    """Give size [bytes], time of the last change [ns] and CRC-32 of a file."""
    status = path.stat()
    return [status.st_size, status.st_mtime_ns, _checksum(path)]


def is_unchanged(path: Path, stamp: Sequence[int]) -> bool:
    """Whether a file is as it was when it had this stamp."""
    try:
        status = path.stat()
        size, time_ns, checksum = stamp
        is_same_size = path.is_file() and status.st_size == size
        return is_same_size and (status.st_mtime_ns == time_ns or _checksum(path) == checksum)
    except (OSError, ValueError):
        return False


def note_result(folder: Path, name: str, files: Iterable[Path]) -> None:
    """Remember that a result is finished, and its files; none: that it is to be made again."""
    with refused_write(folder / RESULTS):
        _append(folder, name, {f.relative_to(folder).as_posix(): file_stamp(f) for f in files})


def is_whole(folder: Path, name: str, needed: Collection[str]) -> bool:
    """Whether a result is there, and every file of it as it was written.

    Args:
        folder: of the results.
        name: of the result.
        needed: files, relative to the folder, without which it is not finished. Where nothing is
            noted of the result, they alone decide: they are written last, and whole.
    """
    noted = _results(folder).get(name)
    if noted is None:
        return all((folder / file).is_file() for file in needed)
    if not noted.keys() >= set(needed):
        return False
    if not all(is_unchanged(folder / file, stamp) for file, stamp in noted.items()):
        return False
    times = {file: (folder / file).stat().st_mtime_ns for file in noted}
    if any(stamp[1] != times[file] for file, stamp in noted.items()):  # a copy: read once
        with suppress(OSError):
            _append(folder, name, {f: [s[0], times[f], s[2]] for f, s in noted.items()})
    return True


def noted_files(folder: Path, name: str) -> list[Path]:
    """Give the files that a run has noted of a result."""
    return [folder / file for file in _results(folder).get(name, {})]


def _append(folder: Path, name: str, stamps: Mapping[str, Sequence[int]]) -> None:
    # In one piece, and apart from what a killed process may have left of its last line.
    line = f"\n{json.dumps({'name': name, 'files': stamps})}\n".encode()
    file = os.open(folder / RESULTS, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    try:
        while line:  # a full disk takes a part of it, and refuses the rest
            line = line[os.write(file, line) :]
    finally:
        os.close(file)


def _results(folder: Path) -> dict[str, dict[str, Any]]:
    """Read what has been noted since it was read last."""
    path = (folder / RESULTS).absolute()
    try:
        status = path.stat()
        number, end, results = _read.get(path, (status.st_ino, 0, {}))
        if number != status.st_ino or status.st_size < end:
            end, results = 0, {}
        if status.st_size > end:
            with path.open("rb") as file:
                file.seek(end)
                text = file.read()
            whole = text.rfind(b"\n") + 1  # of another process, that may be writing
            for line in filter(None, text[:whole].split(b"\n")):
                with suppress(ValueError, KeyError, TypeError, AttributeError):
                    row = json.loads(line)
                    results[str(row["name"])] = dict(row["files"].items())
            end += whole
        _read[path] = (status.st_ino, end, results)
    except OSError:
        return {}
    return results


def _checksum(path: Path) -> int:
    checksum = 0
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            checksum = zlib.crc32(chunk, checksum)
    return checksum
