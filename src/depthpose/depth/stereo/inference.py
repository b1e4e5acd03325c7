"""PSMNet as it is run: the same function as ``psmnet.PSMNet``, faster and in bounded memory.

- Batch norm is folded; tensors keep their channels last, the fastest layout for convolutions.
- The first volume convolution runs on the two views, and no concatenation volume is ever made.
- Volumes are computed by slabs of rows. Only one full-size volume, ``cost0``, is held whole.
- The soft arg-min enlarges the cost a few rows at a time.
"""

import copy
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.depth.stereo.folding import CostConv, RowsConv, fold_features, folded_weight
from depthpose.depth.stereo.plan import Steps
from depthpose.depth.stereo.psmnet import ConvNorm, Head, Hourglass, PSMNet
from depthpose.depth.stereo.volume import (
    ConvolvedPair,
    FirstLayer,
    Size,
    Slab,
    convolve,
    expected_disparity,
    spans,
    whole,
)
from depthpose.depth.types import Match

Views = Float[Tensor, "b 3 h w"]


class PSMNetInference:
    """A trained PSMNet made ready to run; the weights are copied.

    Args:
        network: the trained network.
        dtype: what volumes and features are computed in; the soft arg-min is float32 at least.
        device: where to compute.
        with_compile: compile the feature extractor with torch.compile.
    """

    def __init__(
        self,
        network: PSMNet,
        dtype: torch.dtype = torch.float32,
        device: torch.device | None = None,
        *,
        with_compile: bool = False,
    ) -> None:
        self.config = network.config
        self._like = torch.empty(0, dtype=dtype, device=device)
        features = fold_features(copy.deepcopy(network.features).eval(), self._like)
        self.features = torch.compile(features) if with_compile else features
        first, *rest = (cast("ConvNorm", layer) for layer in (*network.dres0, *network.dres1))
        self.first = FirstLayer(*folded_weight(first), self._like)
        self.residual = [RowsConv(layer, self._like) for layer in rest]
        self.hourglasses = [
            _FoldedHourglass(cast("Hourglass", hourglass), self._like)
            for hourglass in network.hourglasses
        ]
        self.heads = [_FoldedHead(cast("Head", head), self._like) for head in network.heads]

    @torch.no_grad()
    def match(
        self,
        left: Views,
        right: Views,
        steps: Steps,
        *,
        max_disparity_px: int | None = None,
        with_confidence: bool = False,
    ) -> list[Match]:
        """Match normalised pairs of one size whose sides suit the network.

        ``max_disparity_px`` takes the place of the network's own: it looks over disparities with
        the same filters everywhere, so it can look farther than it did in training.
        """
        reach_px = max_disparity_px or self.config.max_disparity_px
        size = Size(reach_px, *left.shape[2:])
        found = [
            expected_disparity(
                cost,
                size,
                align_corners=self.config.align_corners,
                chunk_bytes=steps.chunk_bytes,
                with_confidence=with_confidence,
            )
            for cost in self.cost(left, right, steps, reach_px)
        ]
        return [Match(disparity_px=d, confidence=c) for d, c in found]

    def cost(
        self, left: Views, right: Views, steps: Steps, max_disparity_px: int | None = None
    ) -> Float[Tensor, "b h4 w4 d4"]:
        """Answer the cost after the last hourglass."""
        bins = (max_disparity_px or self.config.max_disparity_px) // 4
        cost0 = whole(self._cost0(self._look(left, right, bins), steps))
        pass_ = _Pass(self, cost0, steps)
        for index in range(3):
            pass_.run(index)
        return pass_.finish()

    def _look(self, left: Views, right: Views, bins: int) -> list[ConvolvedPair]:
        both = zip(self._describe(left), self._describe(right), strict=True)
        return [self.first.look(one[None], other[None], bins) for one, other in both]

    def _describe(self, views: Views) -> Float[Tensor, "b c h4 w4"]:
        batch = views.to(self._like)
        return self.features(batch.contiguous(memory_format=torch.channels_last))

    def _cost0(self, pairs: list[ConvolvedPair], steps: Steps) -> Float[Tensor, "b c h d w"]:
        """Run the layers before the hourglasses."""
        height = pairs[0].height
        size = (height, pairs[0].bins, pairs[0].width)
        cost0 = empty_volume(self._like, (len(pairs), self.config.width), size)
        for first, stop in spans(height, steps.rows):
            begin, end = max(first - 3, 0), min(stop + 3, height)
            x = Slab(_joined([pair.rows(begin, end) for pair in pairs]), begin, height)
            x = relu(convolve(self.residual[0], x, first - 2, stop + 2))
            y = relu(convolve(self.residual[1], x, first - 1, stop + 1))
            y = convolve(self.residual[2], y, first, stop).values
            torch.add(y, x.rows(first, stop), out=cost0[:, :, first:stop])
        return cost0


class _FoldedHourglass:
    def __init__(self, hourglass: Hourglass, like: Tensor) -> None:
        self.down1 = RowsConv(hourglass.down1, like)
        self.same1 = RowsConv(hourglass.same1, like)
        self.down2 = RowsConv(hourglass.down2, like)
        self.same2 = RowsConv(hourglass.same2, like)
        self.up2 = RowsConv(hourglass.up2, like)
        self.up1 = RowsConv(hourglass.up1, like)


class _FoldedHead:
    def __init__(self, head: Head, like: Tensor) -> None:
        self.hidden = RowsConv(head.hidden, like)
        self.cost = CostConv(head.cost, like)


class _Pass:
    """One pass through the hourglasses, and the half-size volumes that it keeps."""

    def __init__(self, net: PSMNetInference, cost0: Slab, steps: Steps) -> None:
        self.net, self.cost0, self.steps = net, cost0, steps
        b, c, h, d, w = cost0.values.shape
        self.half = ((b, 2 * c), (h // 2, d // 2, w // 2))
        self.cost = cost0.values.new_zeros(b, h, d, w, dtype=net.heads[0].cost.dtype)
        self.first_down: Slab | None = None
        self.up: Slab | None = None

    def run(self, index: int) -> None:
        """Run hourglass ``index``; what it adds is made where it is next used."""
        hourglass = self.net.hourglasses[index]
        down = self._same1(hourglass, self._down1(hourglass, index))
        deep = relu(convolve(hourglass.down2, down, 0, down.height // 2))
        deep = relu(convolve(hourglass.same2, deep, 0, deep.height))
        self.first_down = self.first_down or down
        # These are not used again; the plan of memory relies on it.
        self.up = down = None
        self.up = self._up2(hourglass, deep, self.first_down)

    def finish(self) -> Float[Tensor, "b h4 w4 d4"]:
        """Score the volume after the last hourglass."""
        for first, stop in spans(self.cost0.height, self.steps.rows):
            self._score(2, self._refined(3, first, stop), first, stop)
        return self.cost.transpose(2, 3).contiguous()

    def _refined(self, index: int, first: int, stop: int) -> Slab:
        """Input of hourglass ``index``, rows ``first - 2 .. stop + 1``."""
        if index == 0:
            return self.cost0
        assert self.up is not None
        x = convolve(self.net.hourglasses[index - 1].up1, self.up, first - 2, stop + 2)
        x.values.add_(self.cost0.rows(x.first, x.first + x.values.shape[2]))
        return x

    def _down1(self, hourglass: _FoldedHourglass, index: int) -> Slab:
        half = empty_volume(self.cost0.values, *self.half)
        for first, stop in spans(self.cost0.height, self.steps.rows):
            x = self._refined(index, first, stop)
            if index:
                self._score(index - 1, x, first, stop)
            y = convolve(hourglass.down1, x, first // 2, stop // 2)
            torch.clamp_min(y.values, 0, out=half[:, :, first // 2 : stop // 2])
        return whole(half)

    def _score(self, index: int, x: Slab, first: int, stop: int) -> None:
        head = self.net.heads[index]
        hidden = relu(convolve(head.hidden, x, first - 1, stop + 1))
        for cost, rows in zip(self.cost, hidden.rows(first - 1, stop + 1), strict=True):
            cost[first:stop] += head.cost(rows)

    def _same1(self, hourglass: _FoldedHourglass, x: Slab) -> Slab:
        """Second layer on the way down, plus what came up from the hourglass before."""
        # What came up is read row by row, so the answer may take its place.
        out = torch.empty_like(x.values) if self.up is None else self.up.values
        for first, stop in spans(x.height, self.steps.rows):
            y = convolve(hourglass.same1, x, first, stop).values
            if self.up is not None:
                y += out[:, :, first:stop]
            torch.clamp_min(y, 0, out=out[:, :, first:stop])
        return whole(out)

    def _up2(self, hourglass: _FoldedHourglass, deep: Slab, first_down: Slab) -> Slab:
        out = torch.empty_like(first_down.values)
        for first, stop in spans(first_down.height, self.steps.rows):
            y = convolve(hourglass.up2, deep, first, stop).values
            y += first_down.rows(first, stop)
            torch.clamp_min(y, 0, out=out[:, :, first:stop])
        return whole(out)


def relu(slab: Slab) -> Slab:
    """Clamp at zero, in place."""
    slab.values.relu_()
    return slab


def _joined(slabs: list[Tensor]) -> Tensor:
    return slabs[0] if len(slabs) == 1 else torch.cat(slabs)


def empty_volume(like: Tensor, head: tuple[int, int], size: tuple[int, int, int]) -> Tensor:
    """Make volumes ``(pairs, channels, *size)`` whose channels stand last in memory."""
    return torch.empty(
        (*head, *size),
        dtype=like.dtype,
        device=like.device,
        memory_format=torch.channels_last_3d,
    )
