"""The light matcher: correlation of groups of features at 1/4 size, a small hourglass.

Its layers are in ``light_layers``. Disparity is the mean over the few best disparities (CoEx,
Bangunharcana et al., IROS 2021), enlarged and refined by features of both views.
"""

from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.depth.config import LightConfig
from depthpose.depth.disparity import MIN_DISPARITY_PX
from depthpose.depth.encoder import LiteEncoder
from depthpose.depth.stereo import layers
from depthpose.depth.stereo.layers import by_rows
from depthpose.depth.stereo.light_layers import (
    Aggregation,
    ConvexUpsampling,
    LightFeatures,
    Quarter,
    Refinement,
    Scores,
    SkyHead,
)
from depthpose.depth.stereo.network_matcher import STEP_PX, NetworkMatcher, StereoNetwork
from depthpose.depth.types import Maps, Match, Views

_CANDIDATES = 2
"""Disparities of the highest scores whose mean is the answer."""
_WINDOW = 0.15
"""Share of a disparity: what lies nearer to it than that counts for its confidence."""


def confidence_near(scores: Scores, disparity_px: Quarter, first_px: int = 0) -> Quarter:
    """Give the probability of what lies within 15 % of a disparity, as selecting generators do.

    Between the disparities that have a score, scores are interpolated. The first score is that of
    ``first_px``.
    """
    bins = scores.shape[1]
    count = STEP_PX * (bins - 1) + 1
    matrix = layers.interpolation_matrix(
        layers.linear_taps(bins, count, scores, align_corners=True), bins
    )
    probability = F.conv2d(scores, matrix[..., None, None]).softmax(1)
    steps_px = torch.arange(count, dtype=scores.dtype, device=scores.device)[:, None, None]
    distance_px = (first_px + steps_px - disparity_px[:, None]).abs()
    window_px = _WINDOW * disparity_px.clamp(min=1)[:, None]
    # Each whole disparity stands for the half pixel on both sides of it.
    share = (window_px + 0.5 - distance_px).clamp(0, 1)
    return (probability * share).sum(1).clamp(0, 1)


class Reading(NamedTuple):
    """Disparity, confidence and sky of the left view, as read off the scores.

    While training there is a head of all scores, enlarged without the image, one before the
    refinement, and one after it; in eval mode the last alone. What a head says in the sky means
    nothing where the network has that class; in eval mode the sky is at most a half where the
    confidence of the match is higher: white walls look like the sky.
    """

    heads: tuple[Maps, ...]  # disparity [px], the last one the answer
    confidence: Maps | None  # 0..1, in the sky its probability; None where it was not asked for
    sky: Maps | None  # its probability; None where the network has no such class


class LightStereo(StereoNetwork):
    """Rectified pair to disparity at a fraction of PSMNet's operations.

    Images are RGB normalised by ImageNet's mean and deviation; both sides are multiples of 32.
    """

    #: at 1/4 size, an even number, that are computed at a time where something large would be held,
    #: with no gradient; None, as in training and in exported graphs: all
    rows: int | None = None

    def __init__(self, config: LightConfig | None = None) -> None:
        super().__init__()
        self.config = config or LightConfig()
        if self.config.width % self.config.groups:
            raise InputError(
                f"width must be a multiple of groups, got width={self.config.width} and "
                f"groups={self.config.groups}; take 48 and 8"
            )
        self.features = LightFeatures(self.config)
        self.describe = nn.Conv2d(self.config.width, self.config.width, 1, bias=False)
        self.aggregation = Aggregation(self.config, self.features.widths)
        self.enlargement = ConvexUpsampling(self.config.width)
        self.refinement = Refinement()
        self.sky_head = SkyHead(self.features.widths) if self.config.with_sky else None

    @property
    def encoder(self) -> LiteEncoder:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The part that may begin with weights of ImageNet: the encoder of the features."""
        return self.features.encoder

    @property
    def sky(self) -> SkyHead | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The class of the sky."""
        return self.sky_head

    def forward(self, left: Views, right: Views) -> tuple[Maps, ...]:
        """Give the disparity maps of :meth:`read`."""
        return self.read(left, right, self.config.max_disparity_px).heads

    def forward_with_sky(self, left: Views, right: Views) -> tuple[tuple[Maps, ...], Maps | None]:
        """Give the disparity maps of :meth:`read`, and the probability of the sky."""
        read = self.read(left, right, self.config.max_disparity_px)
        return read.heads, read.sky

    def read(
        self,
        left: Views,
        right: Views,
        max_disparity_px: int,
        *,
        first_px: int = 0,
        with_confidence: bool = False,
    ) -> Reading:
        """Match the pair, and read disparity, confidence and sky off the scores.

        Args:
            left: normalised left views.
            right: normalised right views.
            max_disparity_px: number of disparities that are searched.
            first_px: the least of them, a multiple of 4; negative where rigs have principal points
                apart.
            with_confidence: say how sure each pixel is.

        Raises:
            InputError: the images' size does not suit the network.
        """
        h, w = left.shape[-2:]
        if h % 32 or w % 32:
            raise InputError(
                f"the light matcher takes sides that are multiples of 32, got {h}x{w}; pad the "
                "pair, as LightMatcher does"
            )
        left_features = self.features(left)
        right_features = self.features(right)
        descriptions = (
            self.describe(left_features.levels[0]),
            self.describe(right_features.levels[0]),
        )
        right_half = right_features.half
        del right_features  # its levels are large

        # Disparity at 1/4 size: the mean over the few best.
        bins = max_disparity_px // STEP_PX
        first = first_px // STEP_PX
        scores = self.aggregation(*descriptions, bins, left_features.levels, self.rows, first)
        # In float32 at least: 8 bits would round the expectation to whole pixels.
        scores = scores.to(torch.promote_types(scores.dtype, torch.float32))
        best = scores.topk(_CANDIDATES, 1)
        quarter_px = first_px + STEP_PX * (best.values.softmax(1) * best.indices).sum(1)

        # Confidence and sky at 1/4 size.
        quarters = [quarter_px]
        if with_confidence or self.sky_head is not None:
            with torch.no_grad():
                # By rows: probabilities between the scores are the largest volume.
                parts = (scores, quarter_px)
                near_px = partial(confidence_near, first_px=first_px)
                quarters.append(by_rows(near_px, parts, halo=0, rows=self.rows))
        if self.sky_head is not None:
            quarters.append(self.sky_head(left_features.levels, *quarters))
        coarse_px = None
        if self.training:  # the mean over all disparities
            steps = torch.arange(bins, dtype=scores.dtype, device=scores.device)[:, None, None]
            coarse_px = first_px + STEP_PX * (scores.softmax(1) * steps).sum(1, keepdim=True)
        del scores

        # All of them at full size, and the disparity refined there.
        left_half = left_features.half
        parts = (torch.stack(quarters, 1), left_half, left_features.levels[0], right_half)
        enlarged_px, *rest = by_rows(self.enlargement, parts, halo=2, rows=self.rows).unbind(1)
        parts = (enlarged_px, left_half, right_half)
        half_rows = None if self.rows is None else 2 * self.rows
        refine = partial(self.refinement, least_px=first_px + MIN_DISPARITY_PX)
        heads = (by_rows(refine, parts, halo=5, rows=half_rows),)
        if coarse_px is not None:
            wide_px = F.interpolate(coarse_px, scale_factor=4.0, mode="bilinear")[:, 0]
            heads = (wide_px, enlarged_px, *heads)
        confidence = rest[0] if with_confidence else None
        if self.sky_head is None:
            return Reading(heads, confidence, None)
        matched, sky = rest  # the match's confidence, and the probability of the sky
        if not self.training:
            sky = torch.where(sky > matched, sky, sky.clamp(max=0.5))
        if confidence is not None:
            confidence = torch.where(sky > 0.5, sky, matched * (1 - sky))
        return Reading(heads, confidence, sky)


ROWS = 16
"""Rows at quarter size that a matcher computes at a time."""


def light_bytes(
    config: LightConfig, height: int, width: int, dtype: torch.dtype, rows: int = ROWS
) -> int:
    """Estimate the peak memory of a padded pair [bytes], with margin for the allocator.

    One volume of the largest size is held whole; ``rows`` at quarter size are computed at a time.
    """
    pixels = height * width // 16
    slab_pixels = min((rows + 4) * width // 4, pixels)
    feature_bytes = pixels * (2 * 4 * 16 + 3 * config.width) * dtype.itemsize
    # Both views in float32: at this size, normalised, padded.
    images = 6 * 3 * 4 * height * width
    # A volume at quarter size, the smaller ones, and three of the rows at a time.
    widest = max(config.groups, config.volume_widths[0])
    voxel_bytes = widest * (config.max_disparity_px // 4) * dtype.itemsize
    volumes = voxel_bytes * (7 * pixels // 4 + 3 * slab_pixels)
    # Weights that enlarge maps, thrice, and what they are made of at half size; the refinement
    # takes less.
    joined = 4 * (16 + config.width + 32) * dtype.itemsize
    compared = 4 * (4 * 16 + 9 + 3 * 9) * 4
    weights = slab_pixels * (joined + compared + 3 * 4 * 36 * 4)
    return (
        int(layers.MARGIN * (images + feature_bytes + max(volumes, weights)))
        + layers.OVERHEAD_BYTES // 2
    )


class LightMatcher(NetworkMatcher):
    """The light network with pre- and post-processing, as :class:`NetworkMatcher` says."""

    fine_pixels = 650_000
    """Pixels of a fine match at most: an image of KITTI, enlarged 1.18 times."""
    largest_upscale = 1.5
    largest_span_factor = 1.75
    finds_range = True
    activation_bytes = staticmethod(light_bytes)

    def fold(self, network: LightStereo, example: Tensor) -> LightStereo:
        """Fold batch norm, and compute some rows at a time."""
        # A GPU has the memory, and is busy with whole volumes alone.
        network.rows = ROWS if self.device.type == "cpu" else None
        return layers.fold(network, example)

    def run(
        self, left: Views, right: Views, network_config: LightConfig, first_px: int = 0
    ) -> list[Match]:
        """Match normalised pairs whose sides suit the network."""
        read = self._network.read(
            left.to(self.dtype),
            right.to(self.dtype),
            network_config.max_disparity_px,
            first_px=first_px,
            with_confidence=self.config.with_confidence,
        )
        nothing = [None] * len(left)
        confidence = nothing if read.confidence is None else read.confidence
        sky = nothing if read.sky is None else read.sky > 0.5
        parts = zip(read.heads[-1], confidence, sky, strict=True)
        return [Match(disparity_px=d, confidence=c, is_sky=s) for d, c, s in parts]
