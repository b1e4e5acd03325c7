"""The report of the check of a dataset: problems and notices, one line each."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from depthpose.core.errors import InputError

_LFS_POINTER = b"version https://git-lfs"


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A fault of a dataset, or with the kind ``note`` a fact worth knowing."""

    path: Path  #: the file or folder
    kind: str  #: ``missing``, ``unreadable``, ``mismatch``, ``empty`` or ``note``
    message: str  #: what is wrong, or worth knowing


@dataclass(frozen=True, kw_only=True)
class CheckReport:
    """The result of checking a folder."""

    layout: str  #: the layout that was recognised
    counts: dict[str, int]  #: number of frames, and of frames with each part, by name
    problems: list[Problem]  #: what would stop a command or spoil its results
    notices: list[Problem]  #: what only limits them, such as frames without a right view

    @property
    def is_ok(self) -> bool:
        """Whether there is no problem."""
        return not self.problems

    @property
    def summary(self) -> str:
        """Summarise the report in a line for people."""
        parts = ", ".join(f"{count} {part}" for part, count in self.counts.items())
        verdict = "nothing is wrong" if self.is_ok else f"{len(self.problems)} problems"
        return f"{self.layout}: {parts}; {verdict}, {len(self.notices)} notices"


def make_report(layout: str, counts: dict[str, int], remarks: list[Problem]) -> CheckReport:
    """Make the report of a check; remarks of the kind ``note`` become its notices.

    Args:
        layout: the layout that was recognised.
        counts: number of frames, and of frames with each part, by name.
        remarks: all faults and notes.
    """
    return CheckReport(
        layout=layout,
        counts=counts,
        problems=[problem for problem in remarks if problem.kind != "note"],
        notices=[problem for problem in remarks if problem.kind == "note"],
    )


def make_unreadable(path: Path, error: InputError) -> Problem:
    """Make the problem of a file that could not be read.

    Its message is that of the error, unless the file is a Git LFS pointer: a short text that stands
    for a large file until ``git lfs pull``.
    """
    message = str(error).removeprefix(f"{path}: ")
    with suppress(OSError), path.open("rb") as file:
        is_pointer = file.read(len(_LFS_POINTER)) == _LFS_POINTER
        if is_pointer:
            message = "is a Git LFS pointer, not the file; run 'git lfs pull' at its source"
    return Problem(path=path, kind="unreadable", message=message)
