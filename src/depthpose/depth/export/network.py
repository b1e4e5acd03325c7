"""The networks, and what a synthesiser does around its own, with dynamic shapes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.core.export import Value, network_model
from depthpose.depth.export.steps import (
    columns,
    pads,
    ratio,
    resized_image,
    resized_map,
    rows,
    size_of,
)
from depthpose.depth.stereo import StereoNetwork
from depthpose.depth.stereo.light import LightStereo
from depthpose.depth.stereo.psmnet import PSMNet
from depthpose.depth.stereo.volume import WINDOW_PX, interpolation_matrix, linear_taps
from depthpose.depth.synthesis import Generator, SelectionGenerator, UNetGenerator
from depthpose.depth.synthesis.selection import read_logits
from depthpose.depth.synthesis.synthesiser import COLUMNS_SHARE, ROWS_SHARE

Maps = Float[Tensor, "b rows columns"]


class DynamicPSMNet(nn.Module):
    """PSMNet with its soft arg-min, in eval mode.

    Disparities are few and fixed, so their interpolation is a matrix; rows and columns are resized.
    """

    matrix: Tensor

    def __init__(self, network: PSMNet) -> None:
        super().__init__()
        self.network = network
        config = network.config
        self.bins = config.max_disparity_px // 4
        taps = linear_taps(
            self.bins, config.max_disparity_px, torch.zeros(1), align_corners=config.align_corners
        )
        self.register_buffer("matrix", interpolation_matrix(taps, self.bins)[..., None, None])

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
        """Give disparity [px] and confidence of normalised images."""
        near, far = self.network.features(left), self.network.features(right)
        cost = self.network.costs_of(gathered_volume(near, far, self.bins))[-1][:, 0]
        align = self.network.config.align_corners
        wide = F.interpolate(cost, left.shape[-2:], mode="bilinear", align_corners=align)
        probability = F.conv2d(wide, self.matrix).softmax(1)
        steps_px = torch.arange(self.network.config.max_disparity_px).to(cost)[:, None, None]
        disparity_px = (probability * steps_px).sum(1)
        is_near = (steps_px - disparity_px[:, None]).abs() <= WINDOW_PX
        return disparity_px, (probability * is_near).sum(1).clamp(0, 1)


class DynamicLightStereo(nn.Module):
    """The light network with what its matcher makes of its scores."""

    def __init__(self, network: LightStereo) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Maps, ...]:
        """Give disparity [px], confidence and, with that class, the sky of normalised images."""
        reach = self.network.config.max_disparity_px
        read = self.network.read(left, right, reach, with_confidence=True)
        assert read.confidence is not None
        sky = () if read.sky is None else ((read.sky > 0.5).float(),)
        return read.heads[-1], read.confidence, *sky


DYNAMIC_SHAPE_NETWORKS: dict[type[StereoNetwork], Callable[[Any], nn.Module]] = {
    PSMNet: DynamicPSMNet,
    LightStereo: DynamicLightStereo,
}
"""Each kind of matcher network in its form with dynamic shapes: a new kind is one entry."""


def dynamic_shape_network(matcher: StereoNetwork) -> nn.Module:
    """Give a matcher's network, with its post-processing, in a form with dynamic shapes.

    Raises:
        InputError: a matcher that has no such form.
    """
    if type(matcher) not in DYNAMIC_SHAPE_NETWORKS:
        known = ", ".join(kind.__name__ for kind in DYNAMIC_SHAPE_NETWORKS)
        raise InputError(
            f"the matcher is {type(matcher).__name__}, and no file is made of it; give weights of "
            f"one of {known}."
        )
    return DYNAMIC_SHAPE_NETWORKS[type(matcher)](matcher).eval()


class DynamicSelection(nn.Module):
    """The generator that selects, and what its logits say, at half of the image's sides."""

    def __init__(self, generator: SelectionGenerator) -> None:
        super().__init__()
        self.generator = generator

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, ...]:
        """Give log of disparity, sky and confidence of the left view; the first two of the right.

        Disparity is counted in pixels of the image's width. Where the weights know streets, how
        probable one is follows, (b,).
        """
        features = self.generator.encoder(image)
        left, right = (
            read_logits(logits, self.generator.planes) for logits in self.generator.decode(features)
        )
        street = self.generator.find_street(features[-1])
        return *left, *right[:2], *(() if street is None else (street,))


def gathered_volume(
    left: Float[Tensor, "b c h w"], right: Float[Tensor, "b c h w"], bins: int
) -> Float[Tensor, "b c2 {bins} h w"]:
    """Make ``concatenation_volume`` by one gather in place of a copy a disparity."""
    column = torch.arange(left.shape[-1]) - torch.arange(bins)[:, None]
    is_inside = (column >= 0).to(left.dtype)
    sides = [left[..., None, :] * is_inside, right[..., column.clamp(min=0)] * is_inside]
    return torch.cat(sides, 1).transpose(2, 3)


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnValues:
    """:class:`~depthpose.depth.synthesis.SynthesisedViews` as values of a graph."""

    right: Value
    disparity_px: Value | None = None
    confidence: Value | None = None
    is_sky: Value | None = None
    street: Value | None = None


def drawn(left: Value, generator: Generator) -> DrawnValues:
    """Draw right views.

    Raises:
        InputError: the generator is stochastic (dropout at test time).
    """
    if isinstance(generator, SelectionGenerator):
        return _selected(left, generator)
    if generator.config.test_mode != "running":
        raise InputError(
            "the generator's test_mode is 'batch': it draws with dropout, other views each time, "
            "so no file can agree with it; export weights whose test_mode is 'running'."
        )
    return DrawnValues(right=_painted(left, generator))


def _painted(left: Value, generator: UNetGenerator) -> Value:
    """What ``draw_right`` does: near a multiple stretched to it, else mirrored up to one."""
    size, multiple = size_of(left), generator.config.side_multiple_px
    stretched = _near_multiple(size, multiple)
    image = resized_image(left, stretched) * np.float32(2) - np.float32(1)
    example = torch.zeros(2, 3, 2 * multiple, 3 * multiple)
    network = network_model(generator, [example], multiple)
    (found,) = left.graph.call(network, _mirrored(image, stretched, multiple))
    cropped = (found + np.float32(1)).slice([0, 0], stretched, [2, 3]) / np.float32(2)
    return resized_image(cropped, size)


def _selected(left: Value, generator: SelectionGenerator) -> DrawnValues:
    """What ``select_views`` and ``shift_left`` do."""
    size, multiple = size_of(left), generator.config.side_multiple_px
    # Even, since logits stand for two rows and two columns.
    even = (_near_multiple(size, multiple) / 2 * 2).op("Max", 2)
    image = _mirrored(resized_image(left, even), even, multiple)
    example = torch.rand(2, 3, 2 * multiple, 3 * multiple)
    network = network_model(DynamicSelection(generator).eval(), [example], multiple)
    found = left.graph.call(network, image)
    maps = [m.slice([0, 0], even / 2, [1, 2]) for m in found[:5]]
    log_px, sky, sure, right_log_px, right_sky = (resized_map(m, size) for m in maps)
    scale = ratio(size, even)
    is_sky = sky.op("Greater", np.float32(0.5))
    known = sure * (sky * np.float32(-1) + np.float32(1))
    shift_px = right_log_px.op("Exp") * scale
    right_is_sky = right_sky.op("Greater", np.float32(0.5))
    return DrawnValues(
        right=_shifted(left, right_is_sky.op("Where", np.float32(0), shift_px)),
        disparity_px=log_px.op("Exp") * scale,
        confidence=is_sky.op("Where", sky, known),
        is_sky=is_sky,
        street=found[5] if generator.config.with_street else None,
    )


def _shifted(left: Value, shift_px: Value) -> Value:
    """Look the left image up at ``x + shift``; beyond the border the border repeats."""
    size = size_of(left)
    places = [_numbers(side(size)) for side in (rows, columns)]
    row = places[0].op("Unsqueeze", [1])
    y, x = (
        (values * np.float32(2) + np.float32(1)) / side(size).cast(np.float32) - np.float32(1)
        for values, side in ((row, rows), (shift_px + places[1], columns))
    )
    grid = left.graph.op("Concat", *(
        v.op("Expand", shift_px.op("Shape")).op("Unsqueeze", [-1]) for v in (x, y)), axis=-1
    )  # fmt: skip
    return left.op("GridSample", grid, mode="bilinear", padding_mode="border", align_corners=0)


def _numbers(count: Value) -> Value:
    """Give 0, 1, ... as float32."""
    whole = count.op("Squeeze", [0])
    return count.graph.op("Range", 0, whole, 1).cast(np.float32)


def _near_multiple(size: Value, multiple: int) -> Value:
    """Give the multiple that a side is close to, or the side itself."""
    sides = size.cast(np.float64)
    nearest = (sides / float(multiple)).op("Round").op("Max", 1.0) * float(multiple)
    off = (nearest - sides).op("Abs")
    is_near = off.op("LessOrEqual", sides * np.array([ROWS_SHARE, COLUMNS_SHARE]))
    return is_near.op("Where", nearest, sides).cast(np.int64)


def _mirrored(image: Value, size: Value, multiple: int) -> Value:
    """Mirror the right and lower border until both sides are multiples."""
    lacking = (size + (multiple - 1)) / multiple * multiple - size
    return image.op("Pad", pads(image, after=lacking), mode="reflect")
