"""Volumes computed some rows at a time, and the disparity expected from a volume of costs."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

CHUNK_BYTES = 6 << 20
"""Size of one piece of the soft arg-min; it fits the caches."""


def by_rows(
    function: Callable[..., Tensor],
    inputs: Sequence[Tensor | None],
    *,
    halo: int,
    rows: int | None,
    into: Tensor | None = None,
) -> Tensor:
    """Compute some rows of an answer at a time: the same numbers, with less held in between.

    Rows stand last but one. Inputs and answer may have whole multiples of the rows of the smallest
    input, in which everything here is counted.

    Args:
        function: of the inputs; its answer depends on nearby rows alone.
        inputs: tensors; None stays None.
        halo: so many rows to each side an answer depends on.
        rows: at a time; None: all.
        into: where the answer is written, perhaps over an input of which no answer needs another
            row than its own; None: a new tensor.
    """
    if rows is None:
        return function(*inputs)
    given = [x.shape[-2] for x in inputs if x is not None]
    height, whole = min(given), into
    for first in range(0, height, rows):
        stop = min(first + rows, height)
        before, after = max(first - halo, 0), min(stop + halo, height)
        some = function(*(_rows_of(x, height, before, after) for x in inputs))
        times = some.shape[-2] // (after - before)
        if whole is None:
            whole = _empty_like(some, times * height)
        own = some[..., times * (first - before) : times * (stop - before), :]
        whole[..., times * first : times * stop, :] = own
    assert whole is not None, "there are rows"
    return whole


def _rows_of(x: Tensor | None, height: int, first: int, stop: int) -> Tensor | None:
    if x is None:
        return None
    times = x.shape[-2] // height
    return x[..., times * first : times * stop, :]


def _empty_like(some: Tensor, height: int) -> Tensor:
    """Make room for all rows, in the order of memory that convolutions of volumes like."""
    return torch.empty(
        (*some.shape[:-2], height, some.shape[-1]),
        dtype=some.dtype,
        device=some.device,
        memory_format=torch.channels_last_3d if some.ndim == 5 else torch.contiguous_format,
    )


WINDOW_PX = 2.0
"""Half width of the window whose probability is the confidence; ranks errors best (AUSE)."""


class Size(NamedTuple):
    """Disparities, rows and columns of the full-size volume."""

    bins: int
    rows: int
    columns: int


class Taps(NamedTuple):
    """Linear interpolation along one axis: ``(1 - share) x[low] + share x[high]``."""

    low: Tensor
    high: Tensor
    share: Tensor


def linear_taps(small: int, large: int, like: Tensor, *, align_corners: bool) -> Taps:
    """Find where each of ``large`` samples falls among ``small`` ones, as F.interpolate does."""
    index = torch.arange(large, dtype=torch.float64, device=like.device)
    if align_corners:
        at = index * ((small - 1) / max(large - 1, 1))
    else:
        at = ((index + 0.5) * (small / large) - 0.5).clamp(min=0)
    low = at.floor().long().clamp(max=small - 1)
    return Taps(low, (low + 1).clamp(max=small - 1), (at - low).to(like))


def interpolation_matrix(taps: Taps, small: int) -> Float[Tensor, "large small"]:
    """Write linear interpolation as a matrix, to be one product over many pixels."""
    matrix = taps.share.new_zeros(len(taps.low), small)
    rows = torch.arange(len(taps.low), device=matrix.device)
    matrix[rows, taps.low] += 1 - taps.share
    matrix[rows, taps.high] += taps.share
    return matrix


def expected_disparity(
    cost: Float[Tensor, "h4 w4 d4"],
    size: Size,
    *,
    align_corners: bool,
    chunk_bytes: int = CHUNK_BYTES,
    with_confidence: bool,
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"] | None]:
    """Enlarge the cost to ``size`` and take the expected disparity [px], some rows at a time.

    Equals :func:`depthpose.depth.stereo.psmnet.soft_argmin`.

    Args:
        cost: quarter-size cost, larger where a match is likelier, in float32 or wider.
        size: of the answer.
        align_corners: as in ``F.interpolate``.
        chunk_bytes: largest size of one full-size piece; about four are alive at a time.
        with_confidence: answer also the probability within ``WINDOW_PX`` of the expectation.
    """
    vertical = linear_taps(cost.shape[0], size.rows, cost, align_corners=align_corners)
    horizontal = linear_taps(cost.shape[1], size.columns, cost, align_corners=align_corners)
    deep = linear_taps(cost.shape[2], size.bins, cost, align_corners=align_corners)
    matrix = interpolation_matrix(deep, cost.shape[2]).T.contiguous()
    disparity_px = cost.new_empty(size.rows, size.columns)
    confidence = torch.empty_like(disparity_px) if with_confidence else None
    step = max(1, chunk_bytes // (size.columns * size.bins * cost.element_size()))
    for first in range(0, size.rows, step):
        y = slice(first, first + step)
        rows = _mix(cost, Taps(*(t[y] for t in vertical)), 0)
        probability = (_mix(rows, horizontal, 1) @ matrix).softmax(-1)
        _reduce(probability, disparity_px[y], None if confidence is None else confidence[y])
    return disparity_px, confidence


def _mix(x: Tensor, taps: Taps, axis: int) -> Tensor:
    shape = [1] * x.ndim
    shape[axis] = -1
    return torch.lerp(
        x.index_select(axis, taps.low), x.index_select(axis, taps.high), taps.share.view(shape)
    )


def _reduce(
    probability: Float[Tensor, "n w d"],
    disparity_px: Float[Tensor, "n w"],
    confidence: Float[Tensor, "n w"] | None,
) -> None:
    """Write expectation, and the probability near it, into the given rows."""
    bins = torch.arange(probability.shape[-1], device=probability.device).to(probability)
    torch.matmul(probability, bins, out=disparity_px)
    if confidence is not None:
        near = (bins - disparity_px[..., None]).abs_() <= WINDOW_PX
        torch.sum(probability.mul_(near), -1, out=confidence)
        confidence.clamp_(0, 1)
