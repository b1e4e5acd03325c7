"""The first volume convolution, without the volume.

The concatenation volume holds ``left[y, x]`` and ``right[y, x - d]``: a convolution over it is a
2D convolution of each view, looked up and added for each disparity. Only the four columns beside
the edge ``x = d`` where the volume turns to zero, and the last column, need more care.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

View = Float[Tensor, "1 c h w"]
Looked = Float[Tensor, "h w k"]


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

    def look(self, left: View, right: View, bins: int) -> "LookedPair":
        """Convolve both views once, for all disparities."""
        return LookedPair(self, left, right, bins)


class LookedPair:
    """Both views convolved; hands out rows of the layer's output.

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

    def _summed(self, left: View, weight: Tensor, taps: tuple[int, ...]) -> tuple[Looked, Looked]:
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


def _look(view: View, weight: Tensor) -> Looked:
    """Convolve one view, 3x3; the answer has its channels last."""
    weight = weight.contiguous(memory_format=torch.channels_last)
    return F.conv2d(view, weight, padding=1)[0].permute(1, 2, 0)
