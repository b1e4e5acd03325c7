"""One folder per run: what made it (settings, versions, machine, commit), its lock, its results.

A line of ``results.jsonl`` names a result, and size and time of its files, which a rerun compares.
"""

import json
import os
import platform
import re
import subprocess
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import torch

from depthpose.core.errors import InputError
from depthpose.core.files import read_json, refused_as, remove_parts, stores, write_json
from depthpose.core.files.disk import refuse_broken_link, refused_write

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None


RECORD = "run.json"
RESULTS = "results.jsonl"
_SOURCES = "sources.json"
_LOCK = ".lock"
_OF_RUNS = (RECORD, _SOURCES, _LOCK)  # what a folder holds before its first result
NOT_OURS = (
    "is there already, and no run of this command wrote it; choose another --out, or move it away"
)
"""Of a file that a run would write over."""
_FRAME = re.compile(r"_\d{6}$")
_PACKAGES = ("depthpose", "torch", "numpy", "opencv-python-headless")

Item = TypeVar("Item")

_locks: dict[Path, int] = {}  # folders that are locked, and the descriptors of their locks


def lock_folder(folder: Path, *, is_shared: bool, timeout_s: float = 10.0) -> bool:
    """Lock a folder against other commands until :func:`release_folders`, or the process ends.

    Where the file system or the machine has no locks, nothing is held.

    Args:
        folder: made where it is missing.
        is_shared: let other processes of the same launch in.
        timeout_s: how long another command may take to end.

    Returns:
        Whether the folder is this process's from now on, and was not before.

    Raises:
        InputError: another command holds the folder, and goes on holding it; or nothing can be
            written there.
    """
    refuse_broken_link(folder)
    if folder.resolve() in _locks:
        return False
    with refused_write(folder / _LOCK):
        folder.mkdir(parents=True, exist_ok=True)
        file = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    last = time.monotonic() + timeout_s
    while fcntl is not None:
        try:
            fcntl.flock(file, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            break
        except BlockingIOError as error:
            if time.monotonic() > last:
                os.close(file)
                raise InputError(
                    f"{folder}: another command is writing there; wait until it has ended, or "
                    "choose another folder"
                ) from error
            time.sleep(0.1)
        except OSError:  # no locks on this file system
            break
    _locks[folder.resolve()] = file
    return True


def held_folders() -> frozenset[Path]:
    """Give the folders that this process has locked."""
    return frozenset(_locks)


def release_folders(but: Collection[Path] = ()) -> None:
    """Let other commands into the folders that this process has claimed, but for these."""
    for folder in _locks.keys() - set(but):
        file = _locks.pop(folder)
        with suppress(OSError):
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_UN)  # processes that were forked have the file too
        os.close(file)


@dataclass(frozen=True, kw_only=True)
class ProcessRank:
    """Rank of this process among several that share the work through files."""

    rank: int = 0  #: 0 .. world - 1
    world: int = 1  #: how many processes there are

    def share_of(self, items: Sequence[Item]) -> Sequence[Item]:
        """Give the part of a list that this process does: every ``world``-th item."""
        return items[self.rank :: self.world]


def find_rank() -> ProcessRank:
    """Read RANK and WORLD_SIZE, as ``torchrun`` and ``accelerate launch`` set them.

    Raises:
        InputError: they are no numbers that go together.
    """
    variables = (os.environ.get("RANK", "0"), os.environ.get("WORLD_SIZE", "1"))
    if not all(word.isdecimal() for word in variables) or not int(variables[0]) < int(variables[1]):
        raise InputError(
            f"RANK is {variables[0]!r} and WORLD_SIZE {variables[1]!r}, but a rank is "
            "0 .. WORLD_SIZE - 1; let torchrun or accelerate launch set them, or unset both"
        )
    return ProcessRank(rank=int(variables[0]), world=int(variables[1]))


def wait_for(
    names: Sequence[str], is_there: Callable[[str], bool], timeout_s: float = 3600.0
) -> None:
    """Wait until other processes have finished all of these.

    ``timeout_s`` is how long nothing new may appear: a process that died finishes nothing.

    Raises:
        InputError: the time is up; what is missing is named.
    """
    missing = [name for name in names if not is_there(name)]
    last_news = time.monotonic()
    while missing:
        if time.monotonic() - last_news > timeout_s:
            raise InputError(
                f"nothing new for {timeout_s:.0f} s and {len(missing)} of {len(names)} are "
                f"missing, first {missing[0]!r}: another process may have failed. Start again; "
                "what is finished is kept."
            )
        time.sleep(min(0.2, timeout_s))
        still = [name for name in missing if not is_there(name)]
        last_news = time.monotonic() if len(still) < len(missing) else last_news
        missing = still


def environment() -> dict[str, str]:
    """Give what a number was measured with: versions, device, threads, commit, date."""
    facts = {"date": datetime.now(UTC).strftime("%Y-%m-%d"), "python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            facts[name] = version(name)
    facts["machine"] = (
        f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads"
    )
    if torch.cuda.is_available():
        facts["gpu"] = torch.cuda.get_device_name()
    package_folder = str(Path(__file__).resolve().parent)
    command = ["git", "-C", package_folder, "describe", "--always", "--dirty", "--exclude", "*"]
    with suppress(OSError, subprocess.TimeoutExpired):
        commit = subprocess.run(command, capture_output=True, text=True, check=False, timeout=5)  # noqa: S603
        if commit.returncode == 0 and commit.stdout.strip():
            facts["commit"] = commit.stdout.strip()
    return facts


def claim_folder(
    folder: Path,
    settings: Mapping[str, Any],
    results: Iterable[str | Path] = (),
    remedy: str = "choose another, or delete this one",
) -> None:
    """Make ``folder`` the output folder of a run with these settings, or continue such a run.

    It is this process's until :func:`depthpose.core.run.release_folders`, and that of all
    processes of one launch. What a killed run left half written in it is removed.

    Args:
        folder: made where it is missing.
        settings: JSON values that decide the results; compared with those of an earlier run.
        results: files and folders that the run will write. They are its own where an earlier run
            has left its record; without a record, something else wrote what is there.
        remedy: what to do about a folder of other settings.

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
    is_alone = find_rank().world == 1
    is_new = lock_folder(folder, is_shared=not is_alone)
    try:
        try:
            earlier = read_settings(folder)
        except InputError as error:
            raise InputError(
                f"{error}. What made the results is not known any more: choose another folder, or "
                "delete this one"
            ) from error
        # A run that failed before its first result binds no other to its settings.
        is_free = is_alone and all(path.name in _OF_RUNS for path in folder.iterdir())
        if earlier is None or (is_free and earlier != settings):
            (folder / _SOURCES).unlink(missing_ok=True)
            write_json(record, {"settings": dict(settings), "environment": environment()})
        elif earlier != settings:
            refuse_other_settings(folder, earlier, settings, remedy)
    except InputError:
        if is_new:
            release_folders(but=held_folders() - {folder.resolve()})
        raise
    if is_new and is_alone:
        remove_parts(folder)


def claim_names(
    folder: Path,
    sources: Mapping[str, Path | Sequence[Path]],
    endings: Sequence[str] = (),
    videos: Collection[str] = (),
    is_finished: Callable[[str], bool] | None = None,
) -> None:
    """Reserve names of results for the files that they are made from.

    Args:
        folder: where the results go, claimed before (:func:`claim_folder`).
        sources: the file behind each name; of several, the first gives it, and all decide it.
        endings: what follows a name in the names of its results.
        videos: those of the names whose results bear the number of a frame too.
        is_finished: whether a name has a result; None: whether there is a file of the name and one
            of the endings.

    Raises:
        InputError: an earlier run made a result of that name from another file, or the file has
            changed since, or a file that no run wrote has the name of a result.
    """
    record = folder / _SOURCES
    # Listed before the record is read: what another process writes, its record names by then.
    results = {
        file.name.removesuffix(ending): file
        for file in (sorted(folder.iterdir()) if folder.is_dir() else ())
        for ending in endings
        if file.name.endswith(ending)
    }
    recorded = read_sources(folder)
    finished = {*results, *(_FRAME.sub("", stem) for stem in results)}

    # The file behind each name, and the size and time by which a change of it is noticed.
    wanted: dict[str, list[str]] = {}
    for name, files in sources.items():
        files_of_name = [files] if isinstance(files, Path) else list(files)
        stamps: list[str] = []
        for path in files_of_name:
            with suppress(OSError):
                facts = path.stat()
                if path.is_file():
                    stamps.append(f"{facts.st_size} bytes of {facts.st_mtime_ns}")
        wanted[name] = [str(files_of_name[0].resolve()), ", ".join(stamps)]

    # Refuse a name that an earlier run gave to another file, and a file that has changed since.
    for name, (path, stamp) in wanted.items():
        earlier, before = recorded.get(name, [path, stamp])
        if earlier != path:
            raise InputError(
                f"{folder}: {name!r} is the result of {earlier}, not of {path}; two files of "
                "one name need two folders: choose another"
            )
        is_other = before and stamp and before != stamp
        if is_other and (name in finished if is_finished is None else is_finished(name)):
            files = sources[name]
            named = path if isinstance(files, Path) else " or ".join(map(str, files))
            raise InputError(
                f"{named}: has changed since its result {name!r} in {folder} was "
                "made; choose another folder, or delete this one"
            )

    # Of a name that is new, refuse files that no run wrote; what runs wrote is made again.
    new = wanted.keys() - recorded.keys()
    noted = read_results(folder)
    for stem, file in results.items():
        is_frame = _FRAME.sub("", stem) in new & set(videos)
        if stem not in recorded and (stem in new or is_frame):
            if file.relative_to(folder).as_posix() not in noted.get(stem, {}):
                raise InputError(f"{file}: {NOT_OURS}")
            note_result(folder, stem, [])
    for name in filter(noted.get, new):  # of which source is not known any more
        note_result(folder, name, [])

    if any(recorded.get(name) != entry for name, entry in wanted.items()):
        write_json(record, recorded | wanted)


def read_sources(folder: Path) -> dict[str, list[str]]:
    """Give the path and stamp (size and time) of each result's source, by the result's name.

    Empty where the record is missing or damaged.
    """
    if not (folder / _SOURCES).exists():
        return {}
    content = None
    with suppress(InputError):
        content = read_json(folder / _SOURCES)
    if not isinstance(content, dict):
        return {}
    return {name: entry for name, entry in content.items() if _is_source(entry)}


def _is_source(entry: object) -> bool:
    """Whether an entry of the record is a path and a stamp."""
    return isinstance(entry, list) and len(entry) == 2 and all(isinstance(v, str) for v in entry)


def refuse_to_replace(path: Path) -> None:
    """Refuse to write over a file that exists.

    Raises:
        InputError: there is one.
    """
    if os.path.lexists(path):
        raise InputError(f"{path}: is there already; delete it, or give another name")


def read_settings(folder: Path | str) -> dict[str, Any] | None:
    """Give the settings that made a folder, by path or URL, or None where no run claimed it.

    Raises:
        InputError: its record is damaged.
    """
    if isinstance(folder, str) and "://" in folder:
        record = stores.join(folder, RECORD)
        with refused_as(record, "record of a run", "choose another folder"):
            content = json.loads(stores.read_from(record)) if stores.exists(record) else None
    else:
        record = Path(folder) / RECORD
        content = read_json(record) if record.is_file() else None
    if content is None:
        return None
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
    """Refuse a folder that was made by other settings.

    Raises:
        InputError: the first difference is named.
    """
    before = _flat(earlier)
    now = _flat(settings)
    for name in sorted(before.keys() | now.keys()):
        # A later version may add settings: one that either does not know counts as off.
        is_off = (name not in before or name not in now) and not (before | now)[name]
        if before.get(name) != now.get(name) and not is_off:
            raise InputError(
                f"{folder}: holds results made with {name} = {before.get(name)!r}, but now it is "
                f"{now.get(name)!r}. Two settings never share a folder: {remedy}."
            )


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Name nested settings by their path: ``pairs.limit``."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        is_nested = isinstance(value, Mapping)
        flat |= _flat(value, f"{prefix}{name}.") if is_nested else {f"{prefix}{name}": value}
    return flat


_read: dict[Path, tuple[int, int, dict[str, dict[str, Any]]]] = {}
"""Cache by results file: its inode, up to which byte it was read, and the results in it."""


def note_result(folder: Path, name: str, files: Iterable[Path]) -> None:
    """Record that a result is finished, with its files; with none, that it is to be made again."""
    stats = {file.relative_to(folder).as_posix(): file.stat() for file in files}
    stamps = {file: [status.st_size, status.st_mtime_ns] for file, status in stats.items()}
    # In one piece, and apart from what a killed process may have left of its last line.
    line = f"\n{json.dumps({'name': name, 'files': stamps})}\n".encode()
    with refused_write(folder / RESULTS), (folder / RESULTS).open("ab", buffering=0) as file:
        while line:  # a full disk takes a part of it, and refuses the rest
            line = line[file.write(line) :]


def is_whole(folder: Path, name: str, needed: Collection[str]) -> bool:
    """Whether a result exists, and every file of it is as it was written, by size and time.

    Args:
        folder: of the results.
        name: of the result.
        needed: files, relative to the folder, without which it is not finished. Of a result of
            which nothing is noted, as after a loss of the notes, no file is known to be whole.
    """
    noted = read_results(folder).get(name, {})
    try:
        stats = {file: (folder / file).stat() for file in {*noted, *needed}}
    except OSError:
        return False
    stamps = {file: [status.st_size, status.st_mtime_ns] for file, status in stats.items()}
    return bool(noted) and stamps == noted


def read_results(folder: Path) -> dict[str, dict[str, list[int]]]:
    """Give the files of each result and their stamps: size [bytes], time of the last change [ns].

    What has been noted since it was asked last is read.
    """
    path = (folder / RESULTS).absolute()
    try:
        status = path.stat()
        number, end, results = _read.get(path, (status.st_ino, 0, {}))
        if number != status.st_ino or status.st_size < end:
            end = 0
            results = {}
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
