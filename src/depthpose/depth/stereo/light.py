"""The light matcher: correlation of groups of features at 1/4 size, a small hourglass.

- Features: EfficientNet-Lite0 sees the image at half size, two convolutions see it at full size,
  and a decoder joins both at 1/4.
- Volume: cosines of groups of features (Guo et al., CVPR 2019), refined by one 3D hourglass that
  the image guides (Bangunharcana et al., CoEx, IROS 2021).
- Disparity: the mean over the few best disparities (CoEx), enlarged by learned convex combinations
  of nine neighbours (Teed and Deng, RAFT, ECCV 2020), whose disparities are compared at half size.
- Refinement: both views are compared around that disparity at half size, and a few convolutions
  correct it (Khamis et al., StereoNet, ECCV 2018; Tankovich et al., HITNet, CVPR 2021).
- Sky: a class of its own, from what the left view shows and how surely it was matched.
"""

from functools import partial
from itertools import pairwise, product
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.depth.config import LightConfig
from depthpose.depth.disparity import LEAST_PX
from depthpose.depth.stereo import layers
from depthpose.depth.stereo.layers import ConvNorm, Features, Volume, by_rows
from depthpose.depth.stereo.matcher import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    STEP_PX,
    NetworkMatcher,
    StereoNetwork,
)
from depthpose.depth.synthesis import LiteEncoder
from depthpose.depth.types import Maps, Match, Views

Quarter = Float[Tensor, "b h4 w4"]

STEM = 16
"""Channels at half size."""
_OFFSETS = (-2, -1, 0, 1, 2)
"""Differences from the disparity [pixels at half size] at which the refinement compares the
views."""
_GROUPS = 4
_REFINED = 32
"""Groups of features that the refinement compares, and its channels at half size."""


class ViewFeatures(NamedTuple):
    """Features of a view, at 1/2 of the image's sides, and at 1/4, 1/8, 1/16 and 1/32."""

    half: Features
    levels: tuple[Features, ...]


class ConvexUpsampling(nn.Module):
    """Maps at 1/4 size to full size: each pixel is a mean of nine neighbours, by learnt weights.

    These also depend on how alike both views are under the disparity of each neighbour: where two
    surfaces meet, this says which one a pixel belongs to. That part is initialised to zero.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.hidden = ConvNorm(nn.Conv2d, STEM + width, 32)
        self.weights = nn.Conv2d(32, 4 * 9, 1)
        self.compared = ConvNorm(nn.Conv2d, STEM, STEM)
        self.agreement = nn.Conv2d(9, 32, 3, 1, 1, bias=False)
        nn.init.zeros_(self.agreement.weight)

    def forward(
        self,
        quarters: Float[Tensor, "b k h4 w4"],
        left_half: Features,
        left_quarter: Features,
        right_half: Features,
    ) -> Float[Tensor, "b k h w"]:
        """Bring maps, the first the disparity [px], to full size by features of both views."""
        wide = F.interpolate(left_quarter, scale_factor=2.0, mode="nearest")
        x = self.hidden(torch.cat([left_half, wide], 1))

        # The cosine of features at half size under the disparity of each of nine neighbours.
        near, far = (
            F.normalize(self.compared(half).float(), dim=1, eps=1e-3)
            for half in (left_half, right_half)
        )
        shifts = (_gather_neighbours(quarters[:, 0].detach()) / 2).unbind(1)
        cosines = torch.stack([(near * _shift_columns(far, shift)).sum(1) for shift in shifts], 1)
        x = F.relu(x + self.agreement(cosines.to(x)))

        # Nine weights that sum to one, for each of the four pixels that a pixel at half size is.
        b, _, h, w = x.shape
        weights = self.weights(x).float().reshape(b, 9, 4, h, w).softmax(1)
        enlarged = [
            F.pixel_shuffle((weights * _gather_neighbours(quarter)[:, :, None]).sum(1), 2)
            for quarter in quarters.unbind(1)
        ]
        return torch.cat(enlarged, 1)


def _shift_columns(
    right: Float[Tensor, "b c h2 w2"], shift: Float[Tensor, "b h2 w2"]
) -> Float[Tensor, "b c h2 w2"]:
    """Give for each left pixel the features ``shift`` pixels to the left in the right view."""
    lines = torch.arange(right.shape[2], device=right.device).float()
    columns = torch.arange(right.shape[3], device=right.device).float()
    # The last index as a tensor: the exporter to ONNX takes no quotient of unknown sizes.
    rows = (2 * lines / lines[-1:] - 1)[:, None]
    x = 2 * (columns - shift) / columns[-1:] - 1
    return F.grid_sample(right, torch.stack([x, rows.expand_as(x)], -1), align_corners=True)


class Refinement(nn.Module):
    """A correction of the disparity of each pixel, from both views compared around it.

    Its output is initialised to zero.
    """

    def __init__(self) -> None:
        super().__init__()
        self.compared = ConvNorm(nn.Conv2d, STEM, STEM)
        input_width = _GROUPS * len(_OFFSETS) + STEM + 4
        widths = (input_width, _REFINED, _REFINED)
        dilations = (1, 2, 1)
        self.layers = nn.ModuleList(
            ConvNorm(nn.Conv2d, width, _REFINED, dilation=dilation)
            for width, dilation in zip(widths, dilations, strict=True)
        )
        self.correction = nn.Conv2d(_REFINED, 4, 1)
        for parameter in self.correction.parameters():
            nn.init.zeros_(parameter)

    def forward(
        self,
        enlarged_px: Maps,
        left_half: Features,
        right_half: Features,
        least_px: float = LEAST_PX,
    ) -> Maps:
        """Correct a disparity of the left view [px] by features of both views at half size."""
        # The disparities of the four pixels that a pixel at half size is, and their mean.
        four_px = F.pixel_unshuffle(enlarged_px.detach()[:, None], 2) / 2
        mean_px = four_px.mean(1)

        # The cosine of each group of features at five disparities about the mean.
        left = self.compared(left_half)
        right = self.compared(right_half)
        near, far = (unit_groups(half.float(), _GROUPS) for half in (left, right))
        cosines: list[Tensor] = []
        for offset in _OFFSETS:
            shifted = _shift_columns(far.flatten(1, 2), mean_px + offset)
            cosines.append((near * shifted.unflatten(1, near.shape[1:3])).sum(2))

        x = torch.cat([*cosines, left_half.float(), four_px - mean_px[:, None]], 1).to(left)
        for layer in self.layers:
            x = F.relu(layer(x))
        correction_px = F.pixel_shuffle(self.correction(x).to(enlarged_px), 2)[:, 0]
        # Frozen, it passes gradients on to what drew the views.
        corrected = (enlarged_px.detach() if self.training else enlarged_px) + correction_px
        return corrected if self.training else corrected.clamp_min(least_px)


def _gather_neighbours(quarter: Quarter) -> Float[Tensor, "b 9 h2 w2"]:
    """Gather for each pixel at half size the nine neighbours at a quarter of the size."""
    h, w = quarter.shape[1:]
    padded = F.pad(quarter[:, None], (1, 1, 1, 1), mode="replicate")
    near = [padded[:, :, y : y + h, x : x + w] for y, x in product(range(3), repeat=2)]
    return F.interpolate(torch.cat(near, 1), scale_factor=2.0, mode="nearest")


def unit_groups(features: Float[Tensor, "b c h w"], groups: int) -> Float[Tensor, "b g k h w"]:
    """Bring each group of features to length 1."""
    b, c, h, w = features.shape
    grouped = features.contiguous().view(b, groups, c // groups, h, w)
    return grouped * (grouped.square().sum(2, keepdim=True) + 1e-6).rsqrt()


Scores = Float[Tensor, "b d h4 w4"]

_CANDIDATES = 2
"""Disparities of the highest scores whose mean is the answer."""
_WINDOW = 0.15
"""Share of a disparity: what lies nearer to it than that counts for its confidence."""
_USUAL_PX = 64
"""A disparity of this size is 1 to the class of the sky."""
_SKY_WIDTH = 32
"""Channels of the class of the sky."""


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


class SkyHead(nn.Module):
    """Probability of the sky at 1/4 size, by features of these widths; it begins as unlikely."""

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        quarter, *coarser = widths
        deepest = len(coarser) - 1
        self.coarse = nn.ModuleList(
            ConvNorm(nn.Conv2d, w if k == deepest else w + _SKY_WIDTH, _SKY_WIDTH)
            for k, w in enumerate(coarser)
        )
        self.hidden = ConvNorm(nn.Conv2d, quarter + _SKY_WIDTH + 2, _SKY_WIDTH)
        self.logit = nn.Conv2d(_SKY_WIDTH, 1, 1)
        for parameter, value in zip(self.logit.parameters(), (0.0, -2.0), strict=True):
            nn.init.constant_(parameter, value)

    def forward(
        self, levels: tuple[Features, ...], quarter_px: Quarter, confidence: Quarter
    ) -> Quarter:
        """Give the probability of the sky by features of the left view and by its match.

        Args:
            levels: features from 1/4 size down.
            quarter_px: disparity at 1/4 size. Detached: no gradient reaches the matcher by it.
            confidence: its confidence, likewise: what is surely matched as near is no sky.
        """
        quarter, *coarser = levels
        context: list[Tensor] = []  # of the coarser levels; the coarsest one has none
        for layer, level in zip(reversed(self.coarse), reversed(coarser), strict=True):
            x = F.relu(layer(torch.cat([level, *context], 1)))
            context = [F.interpolate(x, scale_factor=2.0, mode="nearest")]
        match = torch.stack([confidence, quarter_px / _USUAL_PX], 1).detach()
        hidden = F.relu(self.hidden(torch.cat([quarter, *context, match.to(quarter)], 1)))
        return self.logit(hidden)[:, 0].to(confidence).sigmoid()


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


_DEEP = 96
"""Channels of the decoder at 1/32, twice those at 1/16 and 1/8."""


class LightFeatures(nn.Module):
    """One view to features at 1/2 to 1/32 of its sides."""

    def __init__(self, config: LightConfig) -> None:
        super().__init__()
        # Down: a plain branch to 1/4 size for fine details, and an encoder to 1/32.
        width = config.width
        self.stem = ConvNorm(nn.Conv2d, 3, STEM, stride=2)
        self.quarter = nn.ModuleList(
            [ConvNorm(nn.Conv2d, STEM, width, stride=2), ConvNorm(nn.Conv2d, width, width)]
        )
        self.encoder = LiteEncoder(config.encoder_width, levels=4)
        self.top = ConvNorm(nn.Conv2d, self.encoder.channels[3], _DEEP, 1)

        # Up: each level takes the one above, and the encoder's features of its size.
        quarter, eighth, sixteenth, _ = self.encoder.channels
        skips = (sixteenth, eighth, quarter + width)
        self.widths = (width, _DEEP // 2, _DEEP // 2, _DEEP)
        outputs = self.widths[-2::-1]
        above = self.widths[:0:-1]
        self.decoder = nn.ModuleList(
            ConvNorm(nn.Conv2d, a + skip, out)
            for a, skip, out in zip(above, skips, outputs, strict=True)
        )
        mean, deviation = (torch.tensor(v)[:, None, None] for v in (IMAGENET_MEAN, IMAGENET_STD))
        self.register_buffer("mean", mean, persistent=False)
        self.register_buffer("deviation", deviation, persistent=False)

    mean: Tensor
    deviation: Tensor

    def forward(self, image: Views) -> ViewFeatures:
        """Give features of each pixel with local and global context."""
        image = image.contiguous(memory_format=torch.channels_last)
        half = F.relu(self.stem(image))
        quarter = half
        for layer in self.quarter:
            quarter = F.relu(layer(quarter))
        # The encoder takes RGB in [0, 1], at half size.
        small = F.avg_pool2d(image, 2) * self.deviation.to(image) + self.mean.to(image)
        of_quarter, of_eighth, of_sixteenth, deepest = self.encoder(small)
        levels = [F.relu(self.top(deepest))]
        skips = (of_sixteenth, of_eighth, torch.cat([of_quarter, quarter], 1))
        for layer, skip in zip(self.decoder, skips, strict=True):
            above = F.interpolate(levels[-1], scale_factor=2.0, mode="nearest")
            levels.append(F.relu(layer(torch.cat([above, skip], 1))))
        return ViewFeatures(half, tuple(levels[::-1]))


def correlation_volume(
    left: Float[Tensor, "b g k h w"], right: Float[Tensor, "b g k h w"], bins: int, first: int = 0
) -> Float[Tensor, "b g {bins} h w"]:
    """Give the cosine of each of :func:`unit_groups` of ``left[y, x]`` and ``right[y, x - d]``.

    Disparities d are ``first``, which may be negative, and those that follow. Zero where the right
    pixel falls outside the image.
    """
    before = max(first + bins - 1, 0)
    after = max(-first, 0)
    width = left.shape[-1]
    padded = F.pad(right, (before, after))
    cosines = []
    for disparity in range(first, first + bins):
        # Groups last, as convolutions of volumes want them: no copy is made.
        start = before - disparity
        products = left * padded[..., start : start + width]
        cosines.append(products.sum(2).permute(0, 2, 3, 1))
    return torch.stack(cosines, 1).permute(0, 4, 1, 2, 3)


class Aggregation(nn.Module):
    """Correlation volume to one score a voxel: an image-guided hourglass of three scales."""

    def __init__(self, config: LightConfig, guide_widths: tuple[int, ...]) -> None:
        super().__init__()
        self.groups = config.groups
        v = config.volume_widths
        self.first = ConvNorm(nn.Conv3d, config.groups, v[0])
        steps = list(pairwise(v))
        self.down = nn.ModuleList(ConvNorm(nn.Conv3d, a, b, stride=2) for a, b in steps)
        self.same = nn.ModuleList(ConvNorm(nn.Conv3d, b, b) for _, b in steps)
        self.up = nn.ModuleList(ConvNorm(nn.ConvTranspose3d, b, a, stride=2) for a, b in steps)
        self.joined = nn.ModuleList(ConvNorm(nn.Conv3d, a, a) for a in v[:-1])
        self.guides = nn.ModuleList(
            nn.Conv2d(g, c, 1) for g, c in zip(guide_widths, v, strict=True)
        )
        self.score = nn.Conv3d(v[0], 1, 3, 1, 1, bias=False)

    def forward(
        self,
        left: Features,
        right: Features,
        bins: int,
        levels: tuple[Features, ...],
        rows: int | None = None,
        first: int = 0,
    ) -> Scores:
        """Score each disparity by the descriptions of both views; more is likelier.

        With ``rows``, and no gradient, one volume of the largest size is held, instead of four.
        """
        guides = [
            torch.sigmoid(guide(level))[:, :, None]
            for guide, level in zip(self.guides, levels, strict=True)
        ]
        # In place where no gradient needs the old values.
        product = torch.Tensor.mul if torch.is_grad_enabled() else torch.Tensor.mul_

        def make_volume(left: Features, right: Features, guide: Volume) -> Volume:
            """Make the cost volume of some rows, and weigh it by the guide."""
            near = unit_groups(left, self.groups)
            far = unit_groups(right, self.groups)
            volume = correlation_volume(near, far, bins, first)
            volume = volume.contiguous(memory_format=torch.channels_last_3d)
            return product(self.first(volume).relu_(), guide)

        def add_enlarged(up: nn.Module, volume: Volume, larger: Volume) -> Volume:
            """Enlarge a volume, and add it to the larger one of the way down."""
            return up(volume).add_(larger).relu_()

        def score_volume(volume: Volume) -> Volume:
            """Give one score for each disparity of each pixel."""
            return self.score(self.joined[0](volume).relu_())

        # Down: each scale has half the size of the one before.
        scales = [by_rows(make_volume, (left, right, guides[0]), halo=1, rows=rows)]
        for down, same, guide in zip(self.down, self.same, guides[1:], strict=True):
            scales.append(product(same(down(scales[-1]).relu_()).relu_(), guide))

        # Up again; the largest size by rows.
        x = scales.pop()
        for up, joined in zip(self.up[:0:-1], self.joined[:0:-1], strict=True):
            x = joined(add_enlarged(up, x, scales.pop())).relu_()
        largest = scales.pop()
        half = None if rows is None else rows // 2
        x = by_rows(
            partial(add_enlarged, self.up[0]), (x, largest), halo=1, rows=half, into=largest
        )
        return by_rows(score_volume, (x,), halo=2, rows=rows)[:, 0]


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
        refine = partial(self.refinement, least_px=first_px + LEAST_PX)
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
