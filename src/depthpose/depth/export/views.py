"""Right views in a graph: what a synthesiser does around its network, at any size."""

from dataclasses import dataclass

import numpy as np
import torch

from depthpose.core.errors import InputError
from depthpose.core.export import Value, network_model
from depthpose.depth.export.network import SizelessSelection
from depthpose.depth.export.steps import (
    columns,
    pads,
    ratio,
    resized_image,
    resized_map,
    rows,
    size_of,
)
from depthpose.depth.synthesis import Generator, SelectionGenerator, UNetGenerator
from depthpose.depth.synthesis.synthesiser import COLUMNS_SHARE, ROWS_SHARE


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnValues:
    """What a generator answers: :class:`~depthpose.depth.synthesis.Drawn`, as values of a graph."""

    right: Value
    disparity_px: Value | None = None
    confidence: Value | None = None
    is_sky: Value | None = None


def drawn(left: Value, generator: Generator) -> DrawnValues:
    """Draw right views.

    Raises:
        InputError: the generator draws by chance.
    """
    if isinstance(generator, SelectionGenerator):
        return _selected(left, generator)
    if generator.config.test_mode != "running":
        raise InputError(
            "the generator's test_mode is 'batch': it draws with dropout, other views each time, "
            "which a file cannot be held to; export weights whose test_mode is 'running'."
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
    network = network_model(SizelessSelection(generator).eval(), [example], multiple)
    found = [m.slice([0, 0], even / 2, [1, 2]) for m in left.graph.call(network, image)]
    log_px, sky, sure, right_log_px, right_sky = (resized_map(m, size) for m in found)
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
