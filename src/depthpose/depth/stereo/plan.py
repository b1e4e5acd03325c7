"""How much memory a match takes, and matching by tiles.

Tiles take less memory than a whole pair, and only nearly give the same disparity.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.depth.config import LightConfig, PSMNetConfig
from depthpose.depth.stereo.volume import CHUNK_BYTES
from depthpose.depth.types import Match

MARGIN = 1.1
"""Allocators keep gaps: measured peaks stay below the sum of the tensors times this ..."""

OVERHEAD_BYTES = 128 << 20
"""... plus this, which the first convolutions take for themselves whatever the size."""


@dataclass(frozen=True, kw_only=True)
class Footprint(ABC):
    """A network at a size of images, as far as memory is concerned.

    Volumes are held whole: a bound can be met or refused, not traded for time.

    Attributes:
        config: the network.
        height: rows of the padded image [px].
        width: columns of the padded image [px].
        dtype: what the network computes in.
        rows: at quarter size, computed at a time.
    """

    config: PSMNetConfig | LightConfig
    height: int
    width: int
    dtype: torch.dtype
    rows: int

    @abstractmethod
    def estimate_bytes(self) -> int:
        """Peak memory of activations of one pair [bytes], with margin for the allocator."""

    def refuse_more_than(self, max_memory_bytes: int | None) -> None:
        """Refuse a bound that a match would exceed.

        Raises:
            InputError: it does; the message says how much it takes.
        """
        least = self.estimate_bytes()
        if max_memory_bytes is not None and least > max_memory_bytes:
            quick = "" if self.config.work_focal_px is None else " or speed='quick'"
            raise InputError(
                f"max_memory_bytes={max_memory_bytes} is too small for images of "
                f"{self.height}x{self.width} (padded): this matcher takes {least}; allow "
                f"that, take precision='bf16'{quick}, or match tiles (tile_px)"
            )


@dataclass(frozen=True, kw_only=True)
class PSMNetFootprint(Footprint):
    """PSMNet at a size of images: two volumes of the largest size are held whole."""

    config: PSMNetConfig
    rows: int = 32

    def estimate_bytes(self) -> int:
        """Peak memory of activations of one pair [bytes], with margin for the allocator."""
        height, width = self.height // 4, self.width // 4
        row_bytes = self.config.width * width * self.dtype.itemsize
        map_bytes = row_bytes * height
        bins = self.config.max_disparity_px // 4
        volume_bytes = map_bytes * bins

        def slab_bytes(halo: int) -> int:
            return min(self.rows + 2 * halo, height) * row_bytes * bins

        levels = 6 + len(self.config.pools)
        cost_bytes = 4 * bins * height * width
        # Costs are computed in float32.
        head_slabs = 2 if self.dtype.itemsize >= 4 else 4
        stages = (
            # Five half-size maps in the first stage; joined levels, twice, in the last.
            2 * map_bytes * max(5 * 4, 2 * levels + 12),
            # ``cost0``; of some rows the concatenation, and what a convolution makes of it.
            volume_bytes + 2 * map_bytes + 3 * slab_bytes(4),
            # ``cost0``, what is added to it, three half-size volumes; some rows in the head.
            2 * volume_bytes + 3 * volume_bytes // 4 + head_slabs * slab_bytes(2) + 3 * cost_bytes,
            4 * cost_bytes + 16 * self.height * self.width + 5 * CHUNK_BYTES,
        )
        return int(MARGIN * max(stages)) + OVERHEAD_BYTES


@dataclass(frozen=True, kw_only=True)
class LightFootprint(Footprint):
    """The light network at a size of images: one volume of the largest size is held whole."""

    config: LightConfig
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
