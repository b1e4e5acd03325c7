"""Names of files in tables and in the settings of runs."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from depthpose.core.checkpoint import file_sha256
from depthpose.core.errors import InputError


def name_with_checksum(path: Path) -> str:
    """Return a file's name and the start of its SHA-256, by which a changed file is told apart.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        return f"{path.name} {file_sha256(path)[:12]}"
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give another file") from error


def name_files(words: Sequence[str], paths: Sequence[Path | None]) -> list[str]:
    """Name files by their stems, with folders in front where stems are equal.

    Args:
        words: what was typed for each.
        paths: the file of each; None: the word is no file, and is its own name.

    Raises:
        InputError: two of them are the same.
    """
    placed_names = [
        (None, word) if path is None else (path.parent, path.stem)
        for word, path in zip(words, paths, strict=True)
    ]
    return distinct_names(placed_names)


def distinct_names(placed_names: Sequence[tuple[Path | None, str]]) -> list[str]:
    """Make names distinct: equal ones get as many folders in front as it takes to tell them apart.

    Args:
        placed_names: the folder that each lies in, None where it lies in none, and its name.

    Returns:
        The names, in their order; folders are joined by hyphens: ``FOLDER-NAME``.

    Raises:
        InputError: two have one name and folder.
    """
    parts: list[tuple[str, ...]] = []  # of each the folders above it, and its name
    for folder, name in placed_names:
        folders = folder.resolve().parts[1:] if folder else ()  # without the root
        parts.append((*folders, name))
    for path_parts, count in Counter(parts).items():
        if count > 1:
            raise InputError(
                f"{'/'.join(path_parts[-2:])}: {count} that are given have this name, and their "
                "results would be one; give it once, or rename a file"
            )

    # Equal names are lengthened by a folder, all at once, until none are equal.
    names: list[str] = []
    part_counts = [1] * len(parts)
    for _ in range(max(map(len, parts), default=0)):
        names = [
            "-".join(path_parts[-count:])
            for path_parts, count in zip(parts, part_counts, strict=True)
        ]
        uses = Counter(names)
        part_counts = [
            count + 1 if uses[name] > 1 else count
            for count, name in zip(part_counts, names, strict=True)
        ]
    return names
