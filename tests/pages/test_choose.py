import pytest
from hypothesis import given
from hypothesis import strategies as st

from depthpose.report.page import (
    MOST_VIEWS,
    choose_ranked,
    choose_views,
    share_views,
    spread_evenly,
)


@pytest.mark.parametrize(
    ("total", "number", "places"), [(10, 2, [2, 7]), (3, 5, [0, 1, 2]), (3, 0, []), (0, 2, [])]
)
def test_the_middle_of_each_part_is_chosen(total: int, number: int, places: list[int]) -> None:
    assert spread_evenly(total, number) == places


@given(st.lists(st.booleans(), max_size=40))
def test_views_are_few_and_refusals_among_them(is_ok: list[bool]) -> None:
    chosen = choose_views(is_ok)
    assert len(chosen) == min(len(is_ok), MOST_VIEWS)
    assert chosen == sorted(set(chosen))
    refused = is_ok.count(False)
    assert sum(not is_ok[k] for k in chosen) >= min(refused, 2)
    assert sum(is_ok[k] for k in chosen) >= min(len(is_ok) - refused, MOST_VIEWS - 2)


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [
        ([], []),
        ([0.3], [("only", 0)]),
        ([0.3, 0.1], [("worst", 0), ("best", 1)]),
        ([0.3, 0.1, 0.2, 0.5, 0.4], [("worst", 3), ("median", 0), ("best", 1)]),
        ([0.1, 0.1, 0.1], [("worst", 2), ("median", 1), ("best", 0)]),
    ],
)
def test_the_worst_the_median_and_the_best_are_chosen_once(
    errors: list[float], chosen: list[tuple[str, int]]
) -> None:
    assert choose_ranked(errors) == chosen
    assert choose_ranked(errors, 1) == chosen[:1]


@given(st.integers(0, 20))
def test_all_sets_together_get_no_more_views_than_a_page_holds(sets: int) -> None:
    shares = share_views(sets)
    assert len(shares) == sets
    assert sum(shares) <= MOST_VIEWS
    assert sum(share > 0 for share in shares) == min(sets, MOST_VIEWS)
