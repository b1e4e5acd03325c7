import torch
from hypothesis import given
from hypothesis import strategies as st

from depthpose.core.arrays import take_evenly


@given(st.integers(0, 300), st.integers(1, 300))
def test_rows_are_taken_at_even_steps_in_their_order(total: int, count: int) -> None:
    rows = torch.arange(total)
    taken = take_evenly(rows, count)
    assert len(taken) == min(total, count)
    if total <= count:
        assert torch.equal(taken, rows)
        return
    assert int(taken[0]) == 0
    steps = taken.diff(append=torch.tensor([total]))
    assert set(steps.tolist()) <= {total // count, total // count + 1}
    assert torch.equal(take_evenly(torch.stack([rows, -rows], -1), count)[:, 1], -taken)
