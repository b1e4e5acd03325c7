"""The light matcher: correlation of groups of features at 1/4 size, a small hourglass.

Its layers are in ``light_layers``. Disparity is the mean over the few best disparities (CoEx,
Bangunharcana et al., IROS 2021), enlarged and refined by features of both views.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from depthpose.core.camera import Camera
from depthpose.core.errors import InputError
from depthpose.depth.config import LightConfig
from depthpose.depth.disparity import MIN_DISPARITY_PX
from depthpose.depth.encoder import LiteEncoder
from depthpose.depth.stereo import layers
from depthpose.depth.stereo.layers import Features, by_rows
from depthpose.depth.stereo.light_layers import (
    HALF_CHANNELS,
    Aggregation,
    ConvexUpsampling,
    LightFeatures,
    QuarterMaps,
    Refinement,
    Scores,
    SkyHead,
    ViewFeatures,
)
from depthpose.depth.stereo.matcher import check_views, infinity_px
from depthpose.depth.stereo.network_matcher import (
    STEP_PX,
    NetworkMatcher,
    SearchRange,
    StereoNetwork,
)
from depthpose.depth.stereo.search_range import (
    choose_search_range,
    doubt_hidden,
    doubt_outside,
    measure_disparity_range,
)
from depthpose.depth.types import Maps, Match, View, Views

_CANDIDATES = 2
"""Number of the highest scores over whose disparities the expectation is taken."""
_WINDOW_SHARE = 0.15
"""The confidence is the probability of disparities within this share of the estimated one."""


def confidence_near(scores: Scores, disparity_px: QuarterMaps, first_px: int = 0) -> QuarterMaps:
    """Compute the probability of disparities within 15 % of an estimated one, at quarter size.

    Args:
        scores: scores at steps of ``STEP_PX``; between them scores are interpolated.
        disparity_px: the estimated disparity [px of the full size].
        first_px: disparity of the first score.
    """
    bins = scores.shape[1]
    count = STEP_PX * (bins - 1) + 1  # of whole disparities
    taps = layers.linear_taps(bins, count, scores, align_corners=True)
    matrix = layers.interpolation_matrix(taps, bins)
    probability = F.conv2d(scores, matrix[..., None, None]).softmax(1)
    steps_px = torch.arange(count, dtype=scores.dtype, device=scores.device)[:, None, None]
    distance_px = (first_px + steps_px - disparity_px[:, None]).abs()
    window_px = _WINDOW_SHARE * disparity_px.clamp(min=1)[:, None]
    # Each whole disparity stands for the half pixel on both sides of it.
    share_in_window = (window_px + 0.5 - distance_px).clamp(0, 1)
    return (probability * share_in_window).sum(1).clamp(0, 1)


class LightOutput(NamedTuple):
    """Disparity, confidence and sky of the left view, at the size of the image."""

    #: disparity [px]: in eval mode that after the refinement alone; in training first the
    #: expectation over all scores, enlarged without the image, then the disparity before the
    #: refinement, and that after it. In the sky it has no meaning, if the network has that class
    heads: tuple[Maps, ...]
    confidence: Maps | None  #: 0..1; in the sky its probability. None where it was not asked for
    #: probability of the sky, None where the network has no such class. In eval mode at most a half
    #: where the confidence of the match is higher, for white walls look like the sky
    sky: Maps | None


class LightStereo(StereoNetwork):
    """Rectified pair to disparity at a fraction of PSMNet's operations.

    Images are RGB normalised by ImageNet's mean and deviation; both sides are multiples of 32.
    """

    #: rows at 1/4 size, an even number, that are computed at a time where a large volume would be
    #: held, with no gradient; None, as in training and in exported graphs: all
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
        """Estimate the disparity maps of ``LightOutput``."""
        return self.match_views(left, right, self.config.max_disparity_px).heads

    def forward_with_sky(self, left: Views, right: Views) -> tuple[tuple[Maps, ...], Maps | None]:
        """Estimate the disparity maps of ``LightOutput``, and the probability of the sky."""
        output = self.match_views(left, right, self.config.max_disparity_px)
        return output.heads, output.sky

    def match_views(
        self,
        left: Views,
        right: Views,
        span_px: int,
        *,
        first_px: int = 0,
        with_confidence: bool = False,
    ) -> LightOutput:
        """Estimate disparity, confidence and sky of the left views.

        Args:
            left: normalised left views.
            right: normalised right views.
            span_px: number of disparities that are searched.
            first_px: the least of them, a multiple of 4; negative where rigs have principal points
                apart.
            with_confidence: estimate the confidence too.

        Raises:
            InputError: the images' size does not suit the network.
        """
        height, width = left.shape[-2:]
        if height % 32 or width % 32:
            raise InputError(
                f"the light matcher takes sides that are multiples of 32, got {height}x{width}; "
                "pad the pair, as LightMatcher does"
            )
        left_features = self.features(left)
        scores, right_half = self._score_disparities(
            left_features, right, span_px // STEP_PX, first_px // STEP_PX
        )

        # Disparity, confidence and sky at 1/4 size; the sky needs the confidence.
        quarter_px = _expect_best(scores, first_px)
        quarter_confidence = None
        quarter_sky = None
        if with_confidence or self.sky_head is not None:
            near = partial(confidence_near, first_px=first_px)
            with torch.no_grad():
                # By rows: probabilities between the scores are the largest volume.
                quarter_confidence = by_rows(near, (scores, quarter_px), halo=0, rows=self.rows)
        if self.sky_head is not None:
            quarter_sky = self.sky_head(left_features.levels, quarter_px, quarter_confidence)
        coarse_px = _expect_all(scores, first_px) if self.training else None
        del scores  # the largest tensor that is still held

        # All of them at full size. The halo is what neighbours reach: two rows at 1/4 size.
        quarter_maps = (quarter_px, quarter_confidence, quarter_sky)
        quarters = torch.stack([values for values in quarter_maps if values is not None], 1)
        inputs = (quarters, left_features.half, left_features.levels[0], right_half)
        enlarged = by_rows(self.enlargement, inputs, halo=2, rows=self.rows)
        enlarged_px = enlarged[:, 0]
        match_confidence = None if quarter_confidence is None else enlarged[:, 1]
        sky = None if quarter_sky is None else enlarged[:, 2]

        # The disparity refined. The halo is what convolutions reach: five rows at 1/2 size.
        refine = partial(self.refinement, least_px=first_px + MIN_DISPARITY_PX)
        half_rows = None if self.rows is None else 2 * self.rows
        inputs = (enlarged_px, left_features.half, right_half)
        refined_px = by_rows(refine, inputs, halo=5, rows=half_rows)
        heads = (refined_px,) if coarse_px is None else (coarse_px, enlarged_px, refined_px)

        if sky is None:
            return LightOutput(heads, match_confidence, None)
        assert match_confidence is not None, "the sky needs it"
        if not self.training:
            # The sky wins only where it is surer than the match.
            sky = torch.where(sky > match_confidence, sky, sky.clamp(max=0.5))
        if not with_confidence:
            return LightOutput(heads, None, sky)
        confidence = torch.where(sky > 0.5, sky, match_confidence * (1 - sky))
        return LightOutput(heads, confidence, sky)

    def _score_disparities(
        self, left_features: ViewFeatures, right: Views, bins: int, first: int
    ) -> tuple[Scores, Features]:
        """Score each disparity of each pixel at 1/4 size.

        Args:
            left_features: features of the left views.
            right: normalised right views.
            bins: number of disparities at 1/4 size.
            first: the least of them.

        Returns:
            The scores; and the features of the right views at half size.
        """
        right_features = self.features(right)
        right_half = right_features.half
        left_description = self.describe(left_features.levels[0])
        right_description = self.describe(right_features.levels[0])
        del right_features  # its levels are large
        scores = self.aggregation(
            left_description, right_description, bins, left_features.levels, self.rows, first
        )
        # In float32 at least: 8 bits would round the expectation to whole pixels.
        return scores.to(torch.promote_types(scores.dtype, torch.float32)), right_half


def _expect_best(scores: Scores, first_px: int) -> QuarterMaps:
    """Compute the expected disparity over those of the highest scores [px of the full size].

    ``first_px``: disparity of the first score.
    """
    best = scores.topk(_CANDIDATES, 1)
    return first_px + STEP_PX * (best.values.softmax(1) * best.indices).sum(1)


def _expect_all(scores: Scores, first_px: int) -> Maps:
    """Compute the expected disparity over all scores [px], enlarged bilinearly to full size.

    ``first_px``: disparity of the first score.
    """
    steps = torch.arange(scores.shape[1], dtype=scores.dtype, device=scores.device)
    expected_step = (scores.softmax(1) * steps[:, None, None]).sum(1, keepdim=True)
    quarter_px = first_px + STEP_PX * expected_step
    return F.interpolate(quarter_px, scale_factor=4.0, mode="bilinear")[:, 0]


ROWS = 16
"""Rows at quarter size that a matcher computes at a time."""


def light_bytes(
    config: LightConfig,
    span_px: int,
    height: int,
    width: int,
    dtype: torch.dtype,
    rows: int = ROWS,
) -> int:
    """Estimate the peak memory of matching a padded pair [bytes], with margin for the allocator.

    One volume of ``span_px`` disparities is held whole; ``rows`` at quarter size are computed at a
    time.
    """
    float_bytes = 4
    quarter_pixels = height * width // 16
    slab_pixels = min((rows + 4) * width // 4, quarter_pixels)  # of the rows, with their halo
    # Of each pixel at quarter size, four at half size.
    half_features = 2 * 4 * HALF_CHANNELS  # of both views
    quarter_features = 3 * config.width
    feature_bytes = quarter_pixels * (half_features + quarter_features) * dtype.itemsize
    # Both views, three channels: at this size, normalised, padded.
    image_bytes = 2 * 3 * 3 * float_bytes * height * width
    # A volume at quarter size, the smaller ones, and three of the rows at a time.
    widest = max(config.groups, config.volume_widths[0])
    volume_pixel_bytes = widest * (span_px // STEP_PX) * dtype.itemsize
    volume_bytes = volume_pixel_bytes * (7 * quarter_pixels // 4 + 3 * slab_pixels)
    # Weights that enlarge maps, thrice, and what they are made of at half size: joined features,
    # and nine comparisons in float32. The refinement takes less.
    joined_bytes = 4 * (HALF_CHANNELS + config.width + 32) * dtype.itemsize
    compared_bytes = 4 * (4 * HALF_CHANNELS + 9 + 3 * 9) * float_bytes
    weight_bytes = 3 * 4 * 36 * float_bytes
    enlargement_bytes = slab_pixels * (joined_bytes + compared_bytes + weight_bytes)

    total_bytes = image_bytes + feature_bytes + max(volume_bytes, enlargement_bytes)
    return int(layers.MARGIN * total_bytes) + layers.OVERHEAD_BYTES // 2


class LightMatcher(NetworkMatcher):
    """The light network with pre- and post-processing, as :class:`NetworkMatcher` says.

    It measures where the disparities of a pair lie, and searches there.
    """

    takes_largest_disparity = True
    fine_pixels = 650_000
    """Pixels of a fine match at most: an image of KITTI, enlarged 1.18 times."""
    largest_upscale = 1.5
    largest_span_factor = 1.75
    activation_bytes = staticmethod(light_bytes)

    def fold(self, network: LightStereo, example: Tensor) -> LightStereo:
        """Fold batch norm, and compute some rows at a time."""
        # A GPU has the memory, and some rows alone would not keep it busy.
        network.rows = ROWS if self.device.type == "cpu" else None
        return layers.fold(network, example)

    @torch.no_grad()
    def match(self, left: Tensor, right: Tensor, camera: Camera | None = None) -> Match:
        """Match one pair of any size within the range of its disparities, which is measured.

        The match has a ``warning`` where disparities lie beyond what was searched.

        Args:
            left: left image, ``(3, H, W)`` RGB in [0, 1].
            right: right image, the same size.
            camera: camera of the left image; None: it is not known.

        Raises:
            InputError: as :meth:`NetworkMatcher.match`.
        """
        check_views(left, right)
        measured = measure_disparity_range(self, left, right, infinity_px(camera))
        search = choose_search_range(self, measured, left.shape[1:], camera)
        with_check = self.config.with_left_right_check
        match = self.match_within(left, right, search, camera, with_left_right_check=with_check)
        if not with_check:
            match = doubt_hidden(match, measured)
        return doubt_outside(match, measured, search, self.config.max_disparity_px)

    def run(self, left: View, right: View, search: SearchRange) -> Match:
        """Match a normalised pair whose sides suit the network."""
        output = self._network.match_views(
            left[None].to(self.dtype),
            right[None].to(self.dtype),
            search.span_px,
            first_px=search.first_px,
            with_confidence=self.config.with_confidence,
        )
        return Match(
            disparity_px=output.heads[-1][0],
            confidence=None if output.confidence is None else output.confidence[0],
            is_sky=None if output.sky is None else output.sky[0] > 0.5,
        )

    def usual_search(self, size: Sequence[int], camera: Camera | None) -> SearchRange:
        """Compute the search of a camera's pairs, as :meth:`NetworkMatcher.usual_search`.

        Without a camera, a fine match has ``fine_pixels``, and searches the most disparities.
        """
        trained = self.network_config
        is_as_given = self.config.speed == "quick" or trained.work_focal_px is None
        if camera is not None or is_as_given:
            return super().usual_search(size, camera)
        span_px = self.whole_steps(trained.max_disparity_px * self.largest_span_factor)
        return SearchRange(scale=self.fine_scale(size), first_px=0, span_px=span_px)
