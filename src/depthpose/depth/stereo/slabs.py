"""Volumes by slabs of rows, so that no layer needs a whole volume beside another."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from depthpose.depth.stereo.folding import RowsConv


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
