"""Names of files: their order, and which belong together."""

import re
from collections import Counter
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

from depthpose.core.errors import InputError

_MOST_SHOWN = 6


def natural_order(path: Path) -> tuple[list[list[str | int]], Path]:
    """Give the key that sorts paths by name, and numbers in names by value: 2 before 10."""
    pieces = [re.split(r"(\d+)", part) for part in (*path.parent.parts, path.stem)]
    # Every second piece is a run of digits, so that like is compared with like.
    return [[int(p) if k % 2 else p for k, p in enumerate(part)] for part in pieces], path


def find_partners(first: Sequence[str], second: Sequence[str], said: str) -> list[int]:
    """Give for each name of one side the index of its partner on the other.

    Names belong together that are equal; else those that are equal without what all names of their
    side share (``left_0004`` and ``right_0004``, ``1_L`` and ``1_R``), numbers by value. Two lone
    names belong together unless each has numbers and none of them is the other's.

    Args:
        first: names of the files of one side, without suffix.
        second: of the other.
        said: what to call the two.

    Raises:
        InputError: some have no partner; they are named.
    """
    keys: tuple[Sequence[Hashable], Sequence[Hashable]] = first, second
    if not set(first) & set(second):
        keys = _own_parts(first, second)
    places = {key: place for place, key in enumerate(keys[1])}
    counts = [Counter(side) for side in keys]
    both = [*zip(first, keys[0], strict=True), *zip(second, keys[1], strict=True)]
    lone = [name for name, key in both if counts[0][key] != 1 or counts[1][key] != 1]
    if lone:
        shown = ", ".join(map(repr, lone[:_MOST_SHOWN])) + (", ..." if lone[_MOST_SHOWN:] else "")
        raise InputError(
            f"{said} hold {len(first)} and {len(second)} files, and no partner of the same name or "
            f"number is there for {shown}; remove these, add their partners, or rename them"
        )
    return [places[key] for key in keys[0]]


def _own_parts(first: Sequence[str], second: Sequence[str]) -> tuple[list[Any], list[Any]]:
    """Take from each name what the names of its side share, and read numbers by value."""
    split = [[re.split(r"(\d+)", name) for name in side] for side in (first, second)]
    if len(first) == len(second) == 1:
        numbers = [{int(piece) for piece in side[0][1::2]} for side in split]
        is_other = all(numbers) and not numbers[0] & numbers[1]
        return [first[0] if is_other else ""], [second[0] if is_other else ""]
    if len({len(pieces) for side in split for pieces in side}) > 1:
        split = [[[name] for name in side] for side in (first, second)]
    keys: list[list[tuple[str, ...]]] = [[() for _ in side] for side in split]
    for k in range(len(split[0][0])):
        columns = [[pieces[k] for pieces in side] for side in split]
        if all(len(set(column)) == 1 for column in columns):
            continue  # the side, or what both share
        for side, column in enumerate(columns):
            parts = _without_shared(column)
            keys[side] = [(*key, part) for key, part in zip(keys[side], parts, strict=True)]
    return keys[0], keys[1]


def _without_shared(texts: list[str]) -> list[str]:
    """Cut the beginning and the end that all have, but within no number; drop leading zeros."""
    for turn in (1, -1):
        turned = [text[::turn] for text in texts]
        low, high = min(turned), max(turned)  # what these two share, all share
        ends = (k for k, (a, b) in enumerate(zip(low, high, strict=False)) if a != b)
        shared = re.sub(r"\d+$", "", low[: next(ends, len(low))])
        texts = [text[len(shared) :][::turn] for text in turned]
    return [re.sub(r"\d+", lambda found: str(int(found[0])), text) for text in texts]
