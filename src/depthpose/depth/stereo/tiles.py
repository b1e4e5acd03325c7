"""Matching by tiles: less memory than one whole pair takes, and only nearly the same answer."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.depth.types import Match

Image = Float[Tensor, "3 h w"]


class Tiling(NamedTuple):
    """Size of a tile's own part, what neighbours share, and what lies to the left besides [px].

    A left pixel at x matches a right one at x - disparity, so each tile sees ``reach`` more
    columns on its left than it answers for.
    """

    rows: int
    columns: int
    overlap: int
    reach: int


class Span(NamedTuple):
    """One tile along one axis: what it sees, from where it counts, and its weights there."""

    seen: slice
    counted: slice
    weight: Float[Tensor, " n"]


def match_tiles(
    match: Callable[[Image, Image], Match], left: Image, right: Image, tiling: Tiling
) -> Match:
    """Match tile by tile and blend the answers linearly where tiles overlap."""
    h, w = left.shape[-2:]
    total = left.new_zeros(3, h, w)
    with_confidence = True
    for y in _spans(h, tiling.rows, tiling.overlap, 0):
        for x in _spans(w, tiling.columns, tiling.overlap, tiling.reach):
            tile = match(left[:, y.seen, x.seen], right[:, y.seen, x.seen])
            inner = (_inside(y), _inside(x))
            weight = (y.weight[:, None] * x.weight).to(left)
            total[0, y.counted, x.counted] += weight
            total[1, y.counted, x.counted] += weight * tile.disparity_px[inner]
            with_confidence = tile.confidence is not None
            if tile.confidence is not None:
                total[2, y.counted, x.counted] += weight * tile.confidence[inner]
    disparity_px, confidence = total[1:] / total[0]
    return Match(disparity_px=disparity_px, confidence=confidence if with_confidence else None)


def _inside(span: Span) -> slice:
    first = span.counted.start - span.seen.start
    return slice(first, first + span.counted.stop - span.counted.start)


def _spans(length: int, step: int, overlap: int, reach: int) -> list[Span]:
    spans = []
    for own_first in range(0, length, step):
        own_stop = min(own_first + step, length)
        first, stop = max(own_first - overlap, 0), min(own_stop + overlap, length)
        at = torch.arange(first, stop) + 0.5
        ramp = max(2 * overlap, 1)
        rising = (at - own_first + overlap) / ramp if own_first else torch.ones_like(at)
        falling = (own_stop + overlap - at) / ramp if own_stop < length else torch.ones_like(at)
        weight = rising.clamp(0, 1) * falling.clamp(0, 1)
        spans.append(Span(slice(max(first - reach, 0), stop), slice(first, stop), weight))
    return spans
