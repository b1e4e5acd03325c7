"""What several files that may have one name are called in folders and tables."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from depthpose.core.errors import InputError


def distinct_names(files: Sequence[tuple[Path | None, str]]) -> list[str]:
    """Give each its own name; of equal ones, with as many folders above it as tell them apart.

    Args:
        files: the folder that something lies in, None where it lies in none, and its name.

    Raises:
        InputError: two of one name lie in one folder, or one is given twice.
    """
    parts = [(*(folder.resolve().parts[1:] if folder else ()), name) for folder, name in files]
    for some, count in Counter(parts).items():
        if count > 1:
            raise InputError(
                f"{'/'.join(some[-2:])}: {count} that are given bear this name, and their results "
                "would be one; give it once, or rename a file"
            )
    names: list[str] = []
    depths = [1] * len(parts)
    for _ in range(max(map(len, parts), default=0)):
        names = ["-".join(some[-depth:]) for some, depth in zip(parts, depths, strict=True)]
        counts = Counter(names)
        depths = [d + (counts[name] > 1) for d, name in zip(depths, names, strict=True)]
    return names
