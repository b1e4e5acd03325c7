"""How much memory a match takes, slabs that stay below a bound, and matching by tiles.

Tiles take less memory than a whole pair, and only nearly give the same disparity.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.depth.config import LightConfig, PSMNetConfig
from depthpose.depth.types import Match

MARGIN = 1.1
"""Allocators keep gaps: measured peaks stay below the sum of the tensors times this ..."""

OVERHEAD_BYTES = 128 << 20
"""... plus this, which the first convolutions take for themselves whatever the size."""

CHUNK_BYTES = 6 << 20
"""Size of one piece of the soft arg-min; it fits the caches."""


@dataclass(frozen=True)
class Steps:
    """How much is computed at a time.

    Attributes:
        rows: quarter-size rows of a slab, even.
        chunk_bytes: size of one piece of the soft arg-min.
    """

    rows: int = 12
    chunk_bytes: int = CHUNK_BYTES


@dataclass(frozen=True, kw_only=True)
class Footprint:
    """A network at a size of images, as far as memory is concerned.

    Attributes:
        config: the network.
        height: rows of the padded image [px].
        width: columns of the padded image [px].
        dtype: what volumes are computed in.
    """

    config: PSMNetConfig
    height: int
    width: int
    dtype: torch.dtype

    def estimate_bytes(self, steps: Steps) -> int:
        """Peak memory of activations [bytes]: the largest stage, with margin for the allocator."""
        stages = (
            self._features_bytes(),
            self._first_layers_bytes(steps),
            self._hourglass_bytes(steps),
            self._expectation_bytes(steps),
        )
        return int(MARGIN * max(stages)) + OVERHEAD_BYTES

    def plan(self, max_memory_bytes: int | None) -> Steps:
        """Choose the largest slabs that stay below the bound.

        Raises:
            InputError: even the smallest slabs need more; the message says how much.
        """
        steps = Steps()
        if max_memory_bytes is None:
            return steps
        while self.estimate_bytes(steps) > max_memory_bytes and steps.rows > 2:
            steps = replace(steps, rows=steps.rows - 2)
        least = self.estimate_bytes(steps)
        if least > max_memory_bytes:
            raise InputError(
                f"max_memory_bytes={max_memory_bytes} is too small for images of "
                f"{self.height}x{self.width} (padded): the least that works is {least}; allow "
                f"that, take precision='bf16', or match tiles (tile_px)"
            )
        return steps

    @property
    def _row_bytes(self) -> int:
        """One row of a volume at quarter size."""
        return self._map_bytes * (self.config.max_disparity_px // 4) // (self.height // 4)

    @property
    def _map_bytes(self) -> int:
        """One quarter-size map of features."""
        return self.config.width * (self.height // 4) * (self.width // 4) * self.dtype.itemsize

    @property
    def _volume_bytes(self) -> int:
        return self._row_bytes * (self.height // 4)

    def _features_bytes(self) -> int:
        """Five half-size maps in the first stage; joined levels, twice, in the last."""
        levels = 6 + len(self.config.pools)
        return self._map_bytes * max(5 * 4, 2 * levels + 12)

    def _first_layers_bytes(self, steps: Steps) -> int:
        """``cost0``, both views convolved in 21 ways, and three layers of a slab."""
        return self._volume_bytes + 21 * self._map_bytes + (3 * steps.rows + 16) * self._row_bytes

    def _hourglass_bytes(self, steps: Steps) -> int:
        """``cost0``, three half-size volumes (a quarter of it each) and a slab in the head."""
        tap_rows = 27 * 4 / (self.config.width * self.dtype.itemsize)
        slab_rows = (2 + tap_rows) * (steps.rows + 2) + 2 * (steps.rows + 6)
        cost_bytes = self._volume_bytes * 4 // (self.config.width * self.dtype.itemsize)
        held = self._volume_bytes + 3 * self._volume_bytes // 4 + 2 * cost_bytes
        return held + int(slab_rows * self._row_bytes)

    def _expectation_bytes(self, steps: Steps) -> int:
        """Quarter-size cost, full-size maps, and the pieces in between."""
        cost_bytes = 4 * self._volume_bytes // (self.config.width * self.dtype.itemsize)
        row_bytes = 4 * self.width * self.config.max_disparity_px
        return (
            2 * cost_bytes + 16 * self.height * self.width + 5 * max(steps.chunk_bytes, row_bytes)
        )


@dataclass(frozen=True, kw_only=True)
class LightFootprint:
    """The light network at a size of images, as far as memory is concerned.

    One volume of the largest size is held whole: a bound can be met or refused, not traded for
    time.

    Attributes:
        config: the network.
        height: rows of the padded image [px].
        width: columns of the padded image [px].
        dtype: what the network computes in.
        rows: at quarter size, computed at a time.
    """

    config: LightConfig
    height: int
    width: int
    dtype: torch.dtype
    rows: int = 16

    def estimate_bytes(self) -> int:
        """Peak memory of activations of one pair [bytes], with margin for the allocator."""
        pixels = self.height * self.width // 16
        slab_pixels = min((self.rows + 4) * self.width // 4, pixels)
        halves = 2 if self.config.with_agreement or self.config.with_refinement else 1
        kept = pixels * (halves * 4 * 16 + 3 * self.config.width) * self.dtype.itemsize
        # Both views in float32: at this size, normalised, padded.
        images = 6 * 3 * 4 * self.height * self.width
        stages = (self._volume_bytes(pixels, slab_pixels), self._weights_bytes(slab_pixels))
        return int(MARGIN * (images + kept + max(stages))) + OVERHEAD_BYTES // 2

    def _volume_bytes(self, pixels: int, slab_pixels: int) -> int:
        """A volume at quarter size, the smaller ones, and three of the rows at a time."""
        widest = max(self.config.groups, self.config.volume_widths[0])
        voxel_bytes = widest * (self.config.max_disparity_px // 4) * self.dtype.itemsize
        return voxel_bytes * (7 * pixels // 4 + 3 * slab_pixels)

    def _weights_bytes(self, pixels: int) -> int:
        """Weights that enlarge maps, thrice, and what they are made of at half size.

        The refinement takes less.
        """
        joined = 4 * (16 + self.config.width + 32) * self.dtype.itemsize
        compared = 4 * (4 * 16 + 9 + 3 * 9) * 4 if self.config.with_agreement else 0
        return pixels * (joined + compared + 3 * 4 * 36 * 4)

    def refuse_more_than(self, max_memory_bytes: int | None) -> None:
        """Refuse a bound that a match would exceed.

        Raises:
            InputError: it does; the message says how much it takes.
        """
        least = self.estimate_bytes()
        if max_memory_bytes is not None and least > max_memory_bytes:
            raise InputError(
                f"max_memory_bytes={max_memory_bytes} is too small for images of "
                f"{self.height}x{self.width} (padded): the light matcher takes {least}; allow "
                f"that, take precision='bf16' or speed='quick', or match tiles (tile_px)"
            )


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
    total = left.new_zeros(4, h, w)
    with_confidence = with_sky = True
    for y in _spans(h, tiling.rows, tiling.overlap, 0):
        for x in _spans(w, tiling.columns, tiling.overlap, tiling.reach):
            tile = match(left[:, y.seen, x.seen], right[:, y.seen, x.seen])
            inner = (_inside(y), _inside(x))
            weight = (y.weight[:, None] * x.weight).to(left)
            total[0, y.counted, x.counted] += weight
            total[1, y.counted, x.counted] += weight * tile.disparity_px[inner]
            with_confidence, with_sky = tile.confidence is not None, tile.is_sky is not None
            if tile.confidence is not None:
                total[2, y.counted, x.counted] += weight * tile.confidence[inner]
            if tile.is_sky is not None:
                total[3, y.counted, x.counted] += weight * tile.is_sky[inner]
    disparity_px, confidence, sky = total[1:] / total[0]
    return Match(
        disparity_px=disparity_px,
        confidence=confidence if with_confidence else None,
        is_sky=sky > 0.5 if with_sky else None,
    )


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
