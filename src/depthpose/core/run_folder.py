"""The output folder of a run: its lock, and records of settings, sources and finished results.

A command claims its folder: it locks it, and writes ``run.json`` with settings, versions, machine
and commit. ``sources.json`` has the file that each result is made from. A line of ``results.jsonl``
names a finished result, with size and time of its files, by which the next run tells that it is
whole. Several processes of one launch (:mod:`depthpose.core.processes`) share a folder: each makes
its share of the results, and they see each other's in ``results.jsonl``.
"""

import json
import os
import re
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError
from depthpose.core.files import read_json, refused_as, remove_parts, stores, write_json
from depthpose.core.files.disk import refuse_broken_link, refused_write
from depthpose.core.processes import find_rank

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None


RECORD = "run.json"
RESULTS = "results.jsonl"
_SOURCES = "sources.json"
_LOCK = ".lock"
_FILES_BEFORE_RESULTS = (RECORD, _SOURCES, _LOCK)  # what a folder holds before its first result
NOT_OURS = (
    "is there already, and no run of this command wrote it; choose another --out, or move it away"
)
"""Error about a file that a run would write over."""
_FRAME = re.compile(r"_\d{6}$")  # number of a frame, which ends the name of its result
_LOCK_POLL_S = 0.1  # between two tries to lock a folder

_locks: dict[Path, int] = {}  # folders that are locked, and the descriptors of their locks


def lock_folder(folder: Path, *, is_shared: bool, timeout_s: float = 10.0) -> bool:
    """Lock a folder against other commands until :func:`release_folders` or the process's end.

    A file system or a machine without locks keeps no other command out.

    Args:
        folder: made where it is missing.
        is_shared: admit other processes of the same launch.
        timeout_s: how long to wait for another command that has locked the folder.

    Returns:
        Whether the lock is new; False where this process holds it already.

    Raises:
        InputError: another command still holds the lock after that time, or nothing can be written
            there.
    """
    refuse_broken_link(folder)
    if folder.resolve() in _locks:
        return False
    with refused_write(folder / _LOCK):
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)

    deadline = time.monotonic() + timeout_s
    while fcntl is not None:
        try:
            kind = fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
            break
        except BlockingIOError as error:
            if time.monotonic() > deadline:
                os.close(descriptor)
                raise InputError(
                    f"{folder}: another command is writing there; wait until it has ended, or "
                    "choose another folder"
                ) from error
            time.sleep(_LOCK_POLL_S)
        except OSError:  # no locks on this file system
            break

    _locks[folder.resolve()] = descriptor
    return True


def held_folders() -> frozenset[Path]:
    """Return the folders that this process has locked."""
    return frozenset(_locks)


def release_folders(but: Collection[Path] = ()) -> None:
    """Unlock the folders that this process has locked, except those in ``but``."""
    for folder in _locks.keys() - set(but):
        descriptor = _locks.pop(folder)
        with suppress(OSError):
            if fcntl is not None:
                # Closing is not enough: forked processes have the file open too.
                fcntl.flock(descriptor, fcntl.LOCK_UN)
        os.close(descriptor)


def claim_folder(
    folder: Path,
    settings: Mapping[str, Any],
    results: Iterable[str | Path] = (),
    remedy: str = "choose another, or delete this one",
) -> None:
    """Make ``folder`` the output folder of a run with these settings, or continue such a run.

    It is locked for this process, or for all processes of one launch, until
    :func:`depthpose.core.run_folder.release_folders`. Partial files of a killed run are removed.

    Args:
        folder: made where it is missing.
        settings: JSON values that decide the results; compared with those of an earlier run.
        results: files and folders that the run will write. Those that exist already must be of an
            earlier run, which has left its record.
        remedy: what the user can do about a folder of other settings, for the error.

    Raises:
        InputError: the folder holds a run with other settings (the first difference is named), or
            a file that is not the run's and would be written over, or another command is writing
            there.
    """
    record = folder / RECORD
    # Listed before the record is looked for, which other processes of a launch write first.
    existing = [name for name in (_SOURCES, *results) if os.path.lexists(folder / name)]
    if existing and not record.exists():
        raise InputError(f"{folder / existing[0]}: {NOT_OURS}")
    is_only_process = find_rank().world == 1
    is_newly_locked = lock_folder(folder, is_shared=not is_only_process)
    try:
        try:
            earlier = read_settings(folder)
        except InputError as error:
            raise InputError(
                f"{error}. What made the results is not known any more: choose another folder, or "
                "delete this one"
            ) from error
        # The settings of a run that failed before its first result may be replaced.
        has_no_results = all(path.name in _FILES_BEFORE_RESULTS for path in folder.iterdir())
        is_replaceable = is_only_process and has_no_results
        if earlier is None or (is_replaceable and earlier != settings):
            (folder / _SOURCES).unlink(missing_ok=True)
            write_json(record, {"settings": dict(settings), "environment": describe_environment()})
        elif earlier != settings:
            refuse_other_settings(folder, earlier, settings, remedy)
    except InputError:
        if is_newly_locked:
            release_folders(but=held_folders() - {folder.resolve()})
        raise
    if is_newly_locked and is_only_process:
        remove_parts(folder)


def claim_names(
    folder: Path,
    sources: Mapping[str, Path | Sequence[Path]],
    endings: Sequence[str] = (),
    videos: Collection[str] = (),
    is_finished: Callable[[str], bool] | None = None,
) -> None:
    """Record in ``sources.json`` which file each result is made from, and refuse another file.

    Args:
        folder: folder of the results, claimed before (:func:`claim_folder`).
        sources: the source file of each result, by the result's name, or several: the first
            identifies the source, and a change of any is noticed.
        endings: what follows a name in the names of its result files.
        videos: names whose result files also have the number of a frame, ``NAME_000000``.
        is_finished: whether a name has a result; None: whether there is a file of the name and one
            of the endings.

    Raises:
        InputError: an earlier run made a result of that name from another file, or the file has
            changed since, or a file that no run wrote has the name of a result.
    """
    # Listed before the record is read, which other processes write before their results.
    files_by_stem = _list_files_by_stem(folder, endings)
    recorded = read_sources(folder)
    present = {name: _describe_source(files) for name, files in sources.items()}

    if is_finished is None:
        # A video counts as finished where there is a file of one of its frames.
        videos_with_frames = [_FRAME.sub("", stem) for stem in files_by_stem]
        is_finished = {*files_by_stem, *videos_with_frames}.__contains__
    for name, source in present.items():
        earlier = recorded.get(name, source)
        if earlier.path != source.path:
            raise InputError(
                f"{folder}: {name!r} is the result of {earlier.path}, not of {source.path}; two "
                "files of one name need two folders: choose another"
            )
        if earlier.has_changed(source) and is_finished(name):
            files = sources[name]
            shown = source.path if isinstance(files, Path) else " or ".join(map(str, files))
            raise InputError(
                f"{shown}: has changed since its result {name!r} in {folder} was "
                "made; choose another folder, or delete this one"
            )

    # Files of results without a recorded source; those of a video have a name for each frame.
    new_names = present.keys() - recorded.keys()
    result_files: dict[str, Path] = {}
    for stem, file in files_by_stem.items():
        is_of_new_video = _FRAME.sub("", stem) in new_names & set(videos)
        if stem in new_names or (is_of_new_video and stem not in recorded):
            result_files[stem] = file
    _revoke_results(folder, new_names, result_files)

    if any(recorded.get(name) != source for name, source in present.items()):
        write_json(folder / _SOURCES, recorded | present)


def _revoke_results(folder: Path, names: Collection[str], files: Mapping[str, Path]) -> None:
    """Note that the results of names without a recorded source are to be made again.

    Args:
        folder: folder of the results.
        names: names of the results.
        files: files of the results, by their names, or those of their frames.

    Raises:
        InputError: no run wrote one of the files.
    """
    # A note without files says that a result is to be made again.
    noted = read_results(folder)
    for stem, file in files.items():
        if file.relative_to(folder).as_posix() not in noted.get(stem, {}):
            raise InputError(f"{file}: {NOT_OURS}")
        note_result(folder, stem, [])
    for name in names:
        if noted.get(name):
            note_result(folder, name, [])


def _list_files_by_stem(folder: Path, endings: Sequence[str]) -> dict[str, Path]:
    """List the files of a folder that have one of the endings, by their names without it."""
    files: dict[str, Path] = {}
    for file in sorted(folder.iterdir()) if folder.is_dir() else ():
        for ending in endings:
            if file.name.endswith(ending):
                files[file.name.removesuffix(ending)] = file
    return files


class Source(NamedTuple):
    """What a result is made from, as ``sources.json`` records it."""

    path: str  #: of the first file
    stamp: str  #: sizes and times of the last change of all files; "" where there are none

    def has_changed(self, now: "Source") -> bool:
        """Whether the files differ from those recorded; False where a stamp is unknown."""
        return bool(self.stamp and now.stamp) and self.stamp != now.stamp


def _describe_source(files: Path | Sequence[Path]) -> Source:
    """Describe the files of a source: the path of the first, and sizes and times of all."""
    paths = [files] if isinstance(files, Path) else list(files)
    stamps: list[str] = []
    for path in paths:
        with suppress(OSError):
            status = path.stat()
            if path.is_file():
                stamps.append(f"{status.st_size} bytes of {status.st_mtime_ns}")
    return Source(path=str(paths[0].resolve()), stamp=", ".join(stamps))


def read_sources(folder: Path) -> dict[str, Source]:
    """Read the source of each result from ``sources.json``, by the result's name.

    Empty where the record is missing or damaged; damaged entries are left out.
    """
    if not (folder / _SOURCES).exists():
        return {}
    content = None
    with suppress(InputError):
        content = read_json(folder / _SOURCES)
    if not isinstance(content, dict):
        return {}
    sources: dict[str, Source] = {}
    for name, entry in content.items():
        is_intact = isinstance(entry, list) and len(entry) == 2
        if is_intact and all(isinstance(part, str) for part in entry):
            sources[name] = Source(*entry)
    return sources


def refuse_to_replace(path: Path) -> None:
    """Refuse to write over what exists at a path, be it a file, a folder or a broken link.

    Raises:
        InputError: something exists there.
    """
    if os.path.lexists(path):
        raise InputError(f"{path}: is there already; delete it, or give another name")


def read_settings(folder: Path | str) -> dict[str, Any] | None:
    """Read the settings of the run that claimed a folder, or None where no run did.

    Args:
        folder: path, or URL of a folder in an object store.

    Raises:
        InputError: its record is damaged.
    """
    if isinstance(folder, str) and "://" in folder:
        record = stores.join(folder, RECORD)
        with refused_as(record, "record of a run", "choose another folder"):
            if not stores.exists(record):
                return None
            content = json.loads(stores.read_from(record))
    else:
        record = Path(folder) / RECORD
        if not record.is_file():
            return None
        content = read_json(record)
    settings = content.get("settings") if isinstance(content, dict) else None
    if not isinstance(settings, dict):
        raise InputError(
            f"{record}: not a record of a run: it has no 'settings'; choose another folder"
        )
    return settings


def refuse_other_settings(
    folder: Path | str,
    earlier: Mapping[str, Any],
    settings: Mapping[str, Any],
    remedy: str = "choose another, or delete this one",
) -> None:
    """Refuse a folder whose results were made with other settings.

    Args:
        folder: path or URL, for the error.
        earlier: settings that the results were made with.
        settings: settings of the present run.
        remedy: what the user can do, for the error.

    Raises:
        InputError: two settings differ; the first difference is named.
    """
    before = _flatten(earlier)
    now = _flatten(settings)
    for name in sorted(before.keys() | now.keys()):
        # A later version may add settings: one that a side lacks counts there as switched off.
        is_missing = name not in before or name not in now
        is_off = is_missing and not (before | now)[name]
        if before.get(name) != now.get(name) and not is_off:
            raise InputError(
                f"{folder}: holds results made with {name} = {before.get(name)!r}, but now it is "
                f"{now.get(name)!r}. Two settings never share a folder: {remedy}."
            )


def _flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings: each is named by its path, such as ``pairs.limit``."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


@dataclass(kw_only=True)
class _ResultsLog:
    """The content of a ``results.jsonl``, up to where it has been read."""

    inode: int  # identifies the file, which may be replaced by another
    end: int = 0  # byte up to which it has been read
    # of each finished result, by its name: the stamps of its files, by their paths
    results: dict[str, dict[str, list[int]]] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)  # reasons, by the names of results


_logs: dict[Path, _ResultsLog] = {}  # what was read of each file, so that only new lines are read


def note_result(folder: Path, name: str, files: Iterable[Path]) -> None:
    """Append to ``results.jsonl`` that a result is finished, with its files and their stamps.

    Without files the note says the contrary: the result is to be made again.
    """
    stamps = {file.relative_to(folder).as_posix(): _read_stamp(file) for file in files}
    _append_result(folder, {"name": name, "files": stamps})


def note_failure(folder: Path, name: str, reason: str) -> None:
    """Append to ``results.jsonl`` why a result could not be made.

    Other processes of a launch then wait for it no longer; the next run tries it again.
    """
    _append_result(folder, {"name": name, "files": {}, "failure": reason})


def _append_result(folder: Path, row: Mapping[str, Any]) -> None:
    """Append an entry to ``results.jsonl``, on a line of its own."""
    # The line break in front separates it from what a killed process may have left of a line.
    line = f"\n{json.dumps(row)}\n".encode()
    with refused_write(folder / RESULTS), (folder / RESULTS).open("ab", buffering=0) as file:
        while line:  # a full disk writes a part of it, and fails at the next try
            written = file.write(line)
            line = line[written:]


def _read_stamp(file: Path) -> list[int]:
    """Return size [bytes] and time of the last change [ns] of a file."""
    status = file.stat()
    return [status.st_size, status.st_mtime_ns]


def is_result_finished(folder: Path, name: str, needed: Collection[str]) -> bool:
    """Whether a result is noted as finished and its files are as they were written.

    Args:
        folder: folder of the results.
        name: name of the result.
        needed: files, relative to the folder, that must be among those of the result.
    """
    noted_stamps = read_results(folder).get(name, {})
    if not noted_stamps:
        return False
    try:
        stamps = {file: _read_stamp(folder / file) for file in {*noted_stamps, *needed}}
    except OSError:
        return False
    return stamps == noted_stamps


def read_results(folder: Path) -> dict[str, dict[str, list[int]]]:
    """Read which results of a folder are finished, from ``results.jsonl``.

    Returns:
        The stamps of the files of each result by its name. A stamp is the size [bytes] and the time
        of the last change [ns] by path, relative to the folder. A result that is to be made again
        has no files. Empty where nothing is noted or the file cannot be read.
    """
    return _read_log(folder).results


def read_failures(folder: Path) -> dict[str, str]:
    """Read why results of a folder could not be made, by name (:func:`note_failure`).

    Results that were made later are left out.
    """
    return _read_log(folder).failures


def _read_log(folder: Path) -> _ResultsLog:
    """Read ``results.jsonl``; where it was read before, only the lines added since."""
    path = (folder / RESULTS).absolute()
    try:
        status = path.stat()
        log = _logs.get(path)
        if log is None or log.inode != status.st_ino or log.end > status.st_size:
            log = _ResultsLog(inode=status.st_ino)  # the file is new, or was replaced or cut
        text = b""
        if status.st_size > log.end:
            with path.open("rb") as file:
                file.seek(log.end)
                text = file.read()
    except OSError:
        return _ResultsLog(inode=0)

    whole_lines = text.rfind(b"\n") + 1  # another process may be writing the last line
    for line in filter(None, text[:whole_lines].split(b"\n")):
        with suppress(ValueError, KeyError, TypeError, AttributeError):  # a damaged line
            row = json.loads(line)
            name = str(row["name"])
            log.results[name] = dict(row["files"].items())
            log.failures.pop(name, None)
            if "failure" in row:
                log.failures[name] = str(row["failure"])
    log.end += whole_lines
    _logs[path] = log
    return log
