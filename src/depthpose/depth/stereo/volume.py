"""Volumes computed some rows at a time, and PSMNet's first convolution and expected disparity.

PSMNet's concatenation volume holds ``left[y, x]`` and ``right[y, x - d]``: a convolution over it is
a 2D convolution of each view, looked up and added for each disparity. Only the four columns beside
the edge ``x = d`` where the volume turns to zero, and the last column, need more care.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from depthpose.depth.stereo.folding import RowsConv

View = Float[Tensor, "1 c h w"]
ConvolvedView = Float[Tensor, "h w k"]


class FirstLayer:
    """A 3x3x3 convolution and ReLU over the concatenation volume of two feature maps.

    Args:
        weight: ``(k, 2c, 3, 3, 3)`` over (disparity, row, column), norm folded in.
        bias: ``(k,)``.
        like: its type and device are computed with.
    """

    def __init__(self, weight: Tensor, bias: Tensor, like: Tensor) -> None:
        self.bias = bias.to(like)
        left, right = weight.to(like).chunk(2, dim=1)
        # By how much of the row a tap sees: all, from its own column on, from the next one on.
        seen = torch.tensor([[1, 1, 1], [0, 1, 1], [0, 0, 1]], device=like.device).to(like)
        self._left = torch.stack([left * s for s in seen], 1)
        self._right = right

    def look(self, left: View, right: View, bins: int) -> "ConvolvedPair":
        """Convolve both views once, for all disparities."""
        return ConvolvedPair(self, left, right, bins)


class ConvolvedPair:
    """Both views convolved; computes rows of the layer's output.

    Written with ``d' = d + i - 1`` for the plane that tap ``i`` along disparity sees, and
    ``v = x - d'`` for the right column there: the plane holds zeros where ``v < 0``.
    """

    def __init__(self, layer: FirstLayer, left: View, right: View, bins: int) -> None:
        self.bins = bins
        self.bias = layer.bias
        self.height, self.width = left.shape[-2:]
        d = torch.arange(bins, device=left.device)[:, None]
        x = torch.arange(self.width, device=left.device)
        self._looked_at = (x - d).clamp(min=0).flatten()
        self._is_beyond_edge = (x >= d + 2)[..., None]
        near = min(self.width, bins + 2)
        self._near = [
            [_look(left[..., : near + 1], layer._left[:, s, :, i])[:, :near] for s in range(3)]
            for i in range(3)
        ]
        # Column 0 of these is v = -1, whose last tap alone meets the image.
        self._right = [_look(F.pad(right, (1, 0)), layer._right[:, :, i]) for i in range(3)]
        last = torch.zeros_like(layer._right)
        last[..., 2] = layer._right[..., 2]
        self._last = [_look(F.pad(right, (1, 0)), last[:, :, i]) for i in range(3)]
        full = layer._left[:, 0]
        self._sums = [self._summed(left, full, taps) for taps in ((1, 2), (0, 1, 2), (0, 1))]

    def _summed(
        self, left: View, weight: Tensor, taps: tuple[int, ...]
    ) -> tuple[ConvolvedView, ConvolvedView]:
        """What both views give where all ``taps`` meet the image: left at x, right at x - d."""
        left_sum = _look(left, weight[:, :, list(taps)].sum(2)) + self.bias
        right_sum = torch.zeros_like(left_sum)
        for i in taps:
            # right_sum[u] += right_i[v = u - i + 1], which is kept at column v + 1.
            part = self._right[i][:, max(2 - i, 0) :]
            begin = max(i - 2, 0)
            stop = min(self.width - begin, part.shape[1])
            right_sum[:, begin : begin + stop] += part[:, :stop]
        return left_sum, right_sum

    def rows(self, first: int, stop: int) -> Float[Tensor, "1 k n d w"]:
        """Rows ``first .. stop - 1`` of the layer's output, all disparities and columns."""
        y = slice(first, stop)
        left_sum, right_sum = self._sums[1]
        out = right_sum[y].index_select(1, self._looked_at)
        out = out.view(stop - first, self.bins, self.width, -1)
        out += left_sum[y, None]
        for d, (left_end, right_end) in ((0, self._sums[0]), (self.bins - 1, self._sums[2])):
            shifted = right_end[y].index_select(1, self._looked_at.view(self.bins, -1)[d])
            torch.add(left_end[y], shifted, out=out[:, d])
        torch.where(self._is_beyond_edge, out, self.bias, out=out)
        self._add_edge(out, y)
        self._correct_last_column(out, y)
        return out.relu_().permute(3, 0, 1, 2)[None]

    def _add_edge(self, out: Tensor, y: slice) -> None:
        """Fill columns ``d - 2 .. d + 1``, where some taps meet the zero side of the edge."""
        for j in range(4):
            for i in range(3):
                v = j - 1 - i
                begin, stop = self._planes_with(i, j)
                if v < -1 or begin >= stop:
                    continue
                seen = {-1: 2, 0: 1}.get(v, 0)
                left = self._near[i][seen][y, begin + j - 2 : stop + j - 2]
                right = self._right[i][y, v + 1, None]
                d = torch.arange(begin, stop, device=out.device)
                out[:, d, d + j - 2] += left + right

    def _planes_with(self, tap: int, j: int) -> tuple[int, int]:
        """Disparities for which plane ``d + tap - 1`` and column ``d + j - 2`` both exist."""
        begin = max(1 - tap, 2 - j, 0)
        return begin, min(self.bins + 1 - tap, self.bins, self.width + 2 - j)

    def _correct_last_column(self, out: Tensor, y: slice) -> None:
        """Take back the tap that looked, in the right view, beyond the volume's last column."""
        for i in range(3):
            begin, stop = max(1 - i, 0), min(self.bins + 1 - i, self.bins, self.width + 2 - i)
            d = torch.arange(begin, stop, device=out.device)
            out[:, d, self.width - 1] -= self._last[i][y, self.width + 1 - d - i]


def _look(view: View, weight: Tensor) -> ConvolvedView:
    """Convolve one view, 3x3; the answer has its channels last."""
    weight = weight.contiguous(memory_format=torch.channels_last)
    return F.conv2d(view, weight, padding=1)[0].permute(1, 2, 0)


@dataclass(frozen=True, eq=False)
class Slab:
    """Some rows of a volume.

    Attributes:
        values: ``(pairs, C, rows, disparities, columns)``, channels last in memory.
        first: the row of the volume that ``values`` begin with.
        height: rows of the whole volume.
    """

    values: Float[Tensor, "b c n d w"]
    first: int
    height: int

    def rows(self, first: int, stop: int) -> Float[Tensor, "b c m d w"]:
        """Rows ``first .. stop - 1``; zeros outside the volume, as a convolution pads."""
        inside_first, inside_stop = max(first, 0), min(stop, self.height)
        assert self.first <= inside_first
        assert inside_stop <= self.first + self.values.shape[2]
        inside = self.values[:, :, inside_first - self.first : inside_stop - self.first]
        above, below = inside_first - first, stop - inside_stop
        if above == below == 0:
            return inside
        return F.pad(inside, (0, 0, 0, 0, above, below))


def convolve(conv: RowsConv, slab: Slab, first: int, stop: int) -> Slab:
    """Compute rows ``first .. stop - 1`` of a convolution, those of them that exist."""
    if conv.is_transposed:
        height = 2 * slab.height
        first, stop = max(first, 0) // 2 * 2, min(stop + stop % 2, height)
        return Slab(conv(slab.rows(first // 2, stop // 2 + 1)), first, height)
    height = slab.height // conv.stride
    first, stop = max(first, 0), min(stop, height)
    halo = slab.rows(conv.stride * first - 1, conv.stride * (stop - 1) + 2)
    return Slab(conv(halo), first, height)


def whole(values: Float[Tensor, "b c n d w"]) -> Slab:
    """A volume as the slab of all its rows."""
    return Slab(values, 0, values.shape[2])


def spans(height: int, step: int) -> Iterator[tuple[int, int]]:
    """Cut ``height`` rows into pieces of ``step``."""
    for first in range(0, height, step):
        yield first, min(first + step, height)


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
    for first, stop in spans(height, rows):
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
    chunk_bytes: int,
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
