"""What the check of a data set finds: its problems and notices, one line each."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from depthpose.core.errors import InputError

_LFS_POINTER = b"version https://git-lfs"


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One fault of a data set, or a fact worth knowing."""

    path: Path  #: the file or folder
    kind: str  #: ``missing``, ``unreadable``, ``mismatch``, ``empty`` or ``note``
    message: str  #: what is wrong


@dataclass(frozen=True, kw_only=True)
class CheckReport:
    """The result of checking a folder."""

    layout: str  #: the layout that was recognised
    counts: dict[str, int]  #: how many frames, and how many of them have each part
    problems: list[Problem]  #: what would stop or spoil work
    notices: list[Problem]  #: what only limits it, such as frames without a right view

    @property
    def is_ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems

    @property
    def summary(self) -> str:
        """Summarise the result in a line for people."""
        parts = ", ".join(f"{count} {part}" for part, count in self.counts.items())
        verdict = "nothing is wrong" if self.is_ok else f"{len(self.problems)} problems"
        return f"{self.layout}: {parts}; {verdict}, {len(self.notices)} notices"


def make_report(layout: str, counts: dict[str, int], remarks: list[Problem]) -> CheckReport:
    """Make the report of a check: ``remarks`` of the kind ``note`` are notices, others problems."""
    return CheckReport(
        layout=layout,
        counts=counts,
        problems=[problem for problem in remarks if problem.kind != "note"],
        notices=[problem for problem in remarks if problem.kind == "note"],
    )


def unreadable(path: Path, error: InputError) -> Problem:
    """Make the problem of a file that could not be read: ``error``, unless it is a Git LFS pointer.

    A pointer is a short text that stands for a large file until ``git lfs pull``.
    """
    message = str(error).removeprefix(f"{path}: ")
    with suppress(OSError), path.open("rb") as file:
        is_pointer = file.read(len(_LFS_POINTER)) == _LFS_POINTER
        if is_pointer:
            message = "is a Git LFS pointer, not the file; run 'git lfs pull' at its source"
    return Problem(path=path, kind="unreadable", message=message)
