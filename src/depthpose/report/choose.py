"""Which estimates a page shows: few enough that the file stays below about 20 MB."""

from collections.abc import Sequence

MOST_VIEWS = 6
_REFUSED = 2
"""Refusals shown at least, where there are so many."""


def spread_evenly(total: int, number: int) -> list[int]:
    """Choose so many of 0 .. total - 1, the middle of each equal part; all where there are fewer.

    None where ``number`` is 0.
    """
    number = min(number, total)
    return [(2 * k + 1) * total // (2 * number) for k in range(number)]


def choose_answers(is_ok: Sequence[bool], most: int = MOST_VIEWS) -> list[int]:
    """Choose answers and some refusals, each spread evenly; give their places in order."""
    answered = [k for k, ok in enumerate(is_ok) if ok]
    refused = [k for k, ok in enumerate(is_ok) if not ok]
    few = min(len(refused), max(_REFUSED, most - len(answered)), most)
    chosen = [refused[i] for i in spread_evenly(len(refused), few)]
    chosen += [answered[i] for i in spread_evenly(len(answered), most - few)]
    return sorted(chosen)


def choose_ranked(errors: Sequence[float], most: int = 3) -> list[tuple[str, int]]:
    """Choose the worst, the median and the best of finite errors; at most so many, each once."""
    order = sorted(range(len(errors)), key=errors.__getitem__)
    if len(order) <= 1:
        return [("only", place) for place in order][:most]
    places = [("worst", order[-1]), ("median", order[(len(order) - 1) // 2]), ("best", order[0])]
    if len(order) == 2:
        del places[1]
    return places[:most]


def share_views(sets: int) -> list[int]:
    """Give each of several sets of predictions its number of views; the last may get none."""
    each = max(1, MOST_VIEWS // max(1, sets))
    return [each if k * each < MOST_VIEWS else 0 for k in range(sets)]
