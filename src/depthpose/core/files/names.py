"""Names of files: their order, and which belong together."""

import re
from collections.abc import Iterable
from pathlib import Path

from depthpose.core.errors import InputError


def natural_order(path: Path) -> tuple[list[list[str | int]], Path]:
    """Give the key that sorts paths by name, and numbers in names by value: 2 before 10."""
    pieces = [re.split(r"(\d+)", part) for part in (*path.parent.parts, path.stem)]
    # Every second piece is a run of digits, so that like is compared with like.
    return [[int(p) if k % 2 else p for k, p in enumerate(part)] for part in pieces], path


def refuse_unpaired(first: Iterable[str], second: Iterable[str], said: str) -> None:
    """Refuse two sides of which some names are on both, and others on one alone.

    Args:
        first: names of the files of one side, without suffix.
        second: of the other.
        said: what to call the two.

    Raises:
        InputError: the first such name.
    """
    names, others = set(first), set(second)
    if names & others and names != others:
        raise InputError(
            f"{said}: {min(names ^ others)!r} is on one side alone, and others have a partner of "
            "their name; remove it, or add its partner"
        )
