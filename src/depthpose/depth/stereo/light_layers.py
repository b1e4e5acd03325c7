"""Layers of the light matcher: features, aggregation, upsampling, refinement, and the sky.

- Features: EfficientNet-Lite0 sees the image at half size, two convolutions see it at full size,
  and a decoder joins both at 1/4.
- Volume: cosines of groups of features (Guo et al., CVPR 2019), refined by one 3D hourglass that
  the image guides (Bangunharcana et al., CoEx, IROS 2021).
- Upsampling: learned convex combinations of nine neighbours (Teed and Deng, RAFT, ECCV 2020), whose
  disparities are compared at half size.
- Refinement: both views are compared around a disparity at half size, and a few convolutions
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

from depthpose.core.arrays import IMAGENET_MEAN, IMAGENET_STD
from depthpose.depth.config import LightConfig
from depthpose.depth.disparity import MIN_DISPARITY_PX
from depthpose.depth.encoder import LiteEncoder
from depthpose.depth.stereo.layers import ConvNorm, Features, Volume, by_rows
from depthpose.depth.types import Maps, Views

QuarterMaps = Float[Tensor, "b h4 w4"]  # at 1/4 of the image's sides

HALF_CHANNELS = 16
"""Channels of the features at half size."""
_UPSAMPLING_CHANNELS = 32
"""Channels from which the weights of the upsampling are computed, at half size."""
_OFFSETS_PX = (-2, -1, 0, 1, 2)
"""Differences from the disparity, in pixels at half size, at which the refinement compares the
views."""
_REFINEMENT_GROUPS = 4
_REFINEMENT_CHANNELS = 32
"""Groups of features that the refinement compares, and its channels at half size."""
_SKY_UNIT_PX = 64
"""Disparities are divided by this for the head of the sky, so that they are near 1."""
_SKY_CHANNELS = 32
"""Channels of the head of the sky."""
_DEEPEST_CHANNELS = 96
"""Channels of the decoder at 1/32, twice those at 1/16 and 1/8."""


class ViewFeatures(NamedTuple):
    """Features of a view, at 1/2 of the image's sides, and at 1/4, 1/8, 1/16 and 1/32."""

    half: Features
    levels: tuple[Features, ...]


class ConvexUpsampling(nn.Module):
    """Maps at 1/4 size to full size: each pixel is a mean of nine neighbours, by learnt weights.

    The weights also depend on how alike both views are under the disparity of each neighbour: where
    two surfaces meet, this says which one a pixel belongs to. That part is initialised to zero.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.hidden = ConvNorm(nn.Conv2d, HALF_CHANNELS + width, _UPSAMPLING_CHANNELS)
        # Of nine neighbours, for each of the four pixels that a pixel at half size is.
        self.weights = nn.Conv2d(_UPSAMPLING_CHANNELS, 4 * 9, 1)
        self.compared = ConvNorm(nn.Conv2d, HALF_CHANNELS, HALF_CHANNELS)
        self.agreement = nn.Conv2d(9, _UPSAMPLING_CHANNELS, 3, 1, 1, bias=False)
        nn.init.zeros_(self.agreement.weight)

    def forward(
        self,
        quarters: Float[Tensor, "b k h4 w4"],
        left_half: Features,
        left_quarter: Features,
        right_half: Features,
    ) -> Float[Tensor, "b k h w"]:
        """Enlarge maps to full size.

        Args:
            quarters: the maps, the first of which is the disparity of the left view, in pixels of
                the full size.
            left_half: features of the left view at half size.
            left_quarter: features of the left view at a quarter of the size.
            right_half: features of the right view at half size.
        """
        wide = F.interpolate(left_quarter, scale_factor=2.0, mode="nearest")
        x = self.hidden(torch.cat([left_half, wide], 1))

        # The cosine of both views' features under the disparity of each of nine neighbours.
        left, right = (
            F.normalize(self.compared(half).float(), dim=1, eps=1e-3)
            for half in (left_half, right_half)
        )
        half_disparity_px = _gather_neighbours(quarters[:, 0].detach()) / 2
        cosines = [
            (left * _shift_right_view(right, neighbour_px)).sum(1)
            for neighbour_px in half_disparity_px.unbind(1)
        ]
        x = F.relu(x + self.agreement(torch.stack(cosines, 1).to(x)))

        # Nine weights that sum to one, for each of the four pixels that a pixel at half size is.
        b, _, h, w = x.shape
        weights = self.weights(x).float().reshape(b, 9, 4, h, w).softmax(1)
        enlarged: list[Tensor] = []
        for quarter in quarters.unbind(1):
            neighbours = _gather_neighbours(quarter)[:, :, None]
            four_pixels = (weights * neighbours).sum(1)
            enlarged.append(F.pixel_shuffle(four_pixels, 2))
        return torch.cat(enlarged, 1)


def _shift_right_view(
    right: Float[Tensor, "b c h2 w2"], disparity_px: Float[Tensor, "b h2 w2"]
) -> Float[Tensor, "b c h2 w2"]:
    """Sample the features of the right view at ``x - disparity`` for each left pixel x.

    ``disparity_px``: in pixels of ``right``.
    """
    rows = torch.arange(right.shape[2], device=right.device).float()
    columns = torch.arange(right.shape[3], device=right.device).float()
    # grid_sample's coordinates: -1 and 1 are the centres of the outer pixels. The last index is
    # taken as a tensor, for the exporter to ONNX takes no quotient of unknown sizes.
    y = (2 * rows / rows[-1:] - 1)[:, None]
    x = 2 * (columns - disparity_px) / columns[-1:] - 1
    return F.grid_sample(right, torch.stack([x, y.expand_as(x)], -1), align_corners=True)


class Refinement(nn.Module):
    """A correction of the disparity of each pixel, from both views compared around it.

    Its convolution of the correction is initialised to zero.
    """

    def __init__(self) -> None:
        super().__init__()
        self.compared = ConvNorm(nn.Conv2d, HALF_CHANNELS, HALF_CHANNELS)
        # Cosines, features of the left view, and the disparities of four pixels about their mean.
        input_width = _REFINEMENT_GROUPS * len(_OFFSETS_PX) + HALF_CHANNELS + 4
        widths = (input_width, _REFINEMENT_CHANNELS, _REFINEMENT_CHANNELS)
        dilations = (1, 2, 1)
        self.layers = nn.ModuleList(
            ConvNorm(nn.Conv2d, width, _REFINEMENT_CHANNELS, dilation=dilation)
            for width, dilation in zip(widths, dilations, strict=True)
        )
        self.correction = nn.Conv2d(_REFINEMENT_CHANNELS, 4, 1)
        for parameter in self.correction.parameters():
            nn.init.zeros_(parameter)

    def forward(
        self,
        enlarged_px: Maps,
        left_half: Features,
        right_half: Features,
        least_px: float = MIN_DISPARITY_PX,
    ) -> Maps:
        """Correct a disparity of the left view by features of both views.

        Args:
            enlarged_px: the disparity, at full size.
            left_half: features of the left view at half size.
            right_half: features of the right view at half size.
            least_px: in eval mode, the least disparity of the result.
        """
        # A pixel at half size covers four pixels at full size: their disparities, and the mean of
        # these, in pixels at half size.
        four_px = F.pixel_unshuffle(enlarged_px.detach()[:, None], 2) / 2
        mean_px = four_px.mean(1)

        # The cosine of each group of features at five disparities about the mean.
        left_features = self.compared(left_half)
        right_features = self.compared(right_half)
        left_groups = unit_groups(left_features.float(), _REFINEMENT_GROUPS)
        right_groups = unit_groups(right_features.float(), _REFINEMENT_GROUPS)
        right_channels = right_groups.flatten(1, 2)
        cosines: list[Tensor] = []
        for offset_px in _OFFSETS_PX:
            shifted = _shift_right_view(right_channels, mean_px + offset_px)
            shifted_groups = shifted.unflatten(1, left_groups.shape[1:3])
            cosines.append((left_groups * shifted_groups).sum(2))

        # The correction of each of the four pixels.
        inputs = [*cosines, left_half.float(), four_px - mean_px[:, None]]
        x = torch.cat(inputs, 1).to(left_features)
        for layer in self.layers:
            x = F.relu(layer(x))
        correction_px = F.pixel_shuffle(self.correction(x).to(enlarged_px), 2)[:, 0]
        if self.training:
            return enlarged_px.detach() + correction_px
        # Not detached: a frozen matcher in a larger training passes gradients on to its views.
        return (enlarged_px + correction_px).clamp_min(least_px)


def _gather_neighbours(quarter: QuarterMaps) -> Float[Tensor, "b 9 h2 w2"]:
    """Gather, for each pixel at half size, the 3 x 3 values around it of a map at quarter size."""
    h, w = quarter.shape[1:]
    padded = F.pad(quarter[:, None], (1, 1, 1, 1), mode="replicate")
    neighbours = [padded[:, :, y : y + h, x : x + w] for y, x in product(range(3), repeat=2)]
    return F.interpolate(torch.cat(neighbours, 1), scale_factor=2.0, mode="nearest")


def unit_groups(features: Float[Tensor, "b c h w"], groups: int) -> Float[Tensor, "b g k h w"]:
    """Divide the features of each pixel into groups, and scale each group to length 1."""
    b, c, h, w = features.shape
    grouped = features.contiguous().view(b, groups, c // groups, h, w)
    squared_length = grouped.square().sum(2, keepdim=True)
    return grouped * (squared_length + 1e-6).rsqrt()


Scores = Float[Tensor, "b d h4 w4"]


class SkyHead(nn.Module):
    """Probability of the sky at 1/4 size; before training it is small.

    ``widths``: channels of the features at 1/4, 1/8, 1/16 and 1/32 size.
    """

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        quarter, *coarser = widths
        *inner, deepest = coarser
        # Each level but the deepest also sees what the next coarser one says.
        inputs = [*(width + _SKY_CHANNELS for width in inner), deepest]
        self.coarse = nn.ModuleList(ConvNorm(nn.Conv2d, c, _SKY_CHANNELS) for c in inputs)
        # 2: the confidence and the disparity of the match.
        self.hidden = ConvNorm(nn.Conv2d, quarter + _SKY_CHANNELS + 2, _SKY_CHANNELS)
        self.logit = nn.Conv2d(_SKY_CHANNELS, 1, 1)
        # Weight 0 and bias -2: a probability of 12 % everywhere.
        for parameter, value in zip(self.logit.parameters(), (0.0, -2.0), strict=True):
            nn.init.constant_(parameter, value)

    def forward(
        self, levels: tuple[Features, ...], quarter_px: QuarterMaps, confidence: QuarterMaps
    ) -> QuarterMaps:
        """Estimate the probability of the sky from features of the left view and from its match.

        The match helps, since what is surely matched as near is no sky. No gradient reaches the
        matcher by it.

        Args:
            levels: features at 1/4, 1/8, 1/16 and 1/32 size.
            quarter_px: disparity at 1/4 size [px of the full size].
            confidence: confidence of this disparity, 0..1.
        """
        # From the coarsest level to that at 1/8 size: each sees its features, and the enlarged
        # output of the level before, if there is one.
        quarter_features, *coarser = levels
        from_coarser: list[Tensor] = []
        for layer, features in zip(reversed(self.coarse), reversed(coarser), strict=True):
            x = F.relu(layer(torch.cat([features, *from_coarser], 1)))
            from_coarser = [F.interpolate(x, scale_factor=2.0, mode="nearest")]

        # At 1/4 size, beside the match.
        match = torch.stack([confidence, quarter_px / _SKY_UNIT_PX], 1).detach()
        x = torch.cat([quarter_features, *from_coarser, match.to(quarter_features)], 1)
        hidden = F.relu(self.hidden(x))
        return self.logit(hidden)[:, 0].to(confidence).sigmoid()


class LightFeatures(nn.Module):
    """One view to features at 1/2, 1/4, 1/8, 1/16 and 1/32 of its sides."""

    mean: Tensor
    std: Tensor

    def __init__(self, config: LightConfig) -> None:
        super().__init__()
        # Down: a plain branch to 1/4 size for fine details, and an encoder to 1/32.
        width = config.width
        self.stem = ConvNorm(nn.Conv2d, 3, HALF_CHANNELS, stride=2)
        self.quarter = nn.ModuleList(
            [ConvNorm(nn.Conv2d, HALF_CHANNELS, width, stride=2), ConvNorm(nn.Conv2d, width, width)]
        )
        self.encoder = LiteEncoder(config.encoder_width, levels=4)
        self.top = ConvNorm(nn.Conv2d, self.encoder.channels[3], _DEEPEST_CHANNELS, 1)

        # Up: each level takes the next coarser one, and the encoder's features of its own size.
        quarter, eighth, sixteenth, _ = self.encoder.channels
        inner_channels = _DEEPEST_CHANNELS // 2
        self.widths = (width, inner_channels, inner_channels, _DEEPEST_CHANNELS)
        self.decoder = nn.ModuleList(
            [
                ConvNorm(nn.Conv2d, _DEEPEST_CHANNELS + sixteenth, inner_channels),
                ConvNorm(nn.Conv2d, inner_channels + eighth, inner_channels),
                ConvNorm(nn.Conv2d, inner_channels + quarter + width, width),
            ]
        )
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)

    def forward(self, image: Views) -> ViewFeatures:
        """Compute the features of views that are normalised by ImageNet's mean and deviation."""
        image = image.contiguous(memory_format=torch.channels_last)
        half = F.relu(self.stem(image))
        quarter = half
        for layer in self.quarter:
            quarter = F.relu(layer(quarter))
        # The encoder takes RGB in [0, 1], at half size.
        small = F.avg_pool2d(image, 2) * self.std.to(image) + self.mean.to(image)
        of_quarter, of_eighth, of_sixteenth, deepest = self.encoder(small)
        levels = [F.relu(self.top(deepest))]
        skips = (of_sixteenth, of_eighth, torch.cat([of_quarter, quarter], 1))
        for layer, skip in zip(self.decoder, skips, strict=True):
            coarser = F.interpolate(levels[-1], scale_factor=2.0, mode="nearest")
            levels.append(F.relu(layer(torch.cat([coarser, skip], 1))))
        return ViewFeatures(half, tuple(reversed(levels)))


def correlation_volume(
    left: Float[Tensor, "b g k h w"], right: Float[Tensor, "b g k h w"], bins: int, first: int = 0
) -> Float[Tensor, "b g {bins} h w"]:
    """Compute the cosine of each group of features of ``left[y, x]`` and ``right[y, x - d]``.

    Zero where the right pixel falls outside the image.

    Args:
        left: features of the left view, in groups of length 1 (:func:`unit_groups`).
        right: those of the right view.
        bins: number of disparities d [px of these views].
        first: the first disparity, which may be negative; the others follow.
    """
    padding_left = max(first + bins - 1, 0)
    padding_right = max(-first, 0)
    width = left.shape[-1]
    padded = F.pad(right, (padding_left, padding_right))
    cosines = []
    for disparity in range(first, first + bins):
        start = padding_left - disparity
        products = left * padded[..., start : start + width]
        # Groups last in memory, as convolutions of volumes want them: no copy is made.
        cosines.append(products.sum(2).permute(0, 2, 3, 1))
    return torch.stack(cosines, 1).permute(0, 4, 1, 2, 3)


class Aggregation(nn.Module):
    """Correlation volume to one score a voxel: an hourglass of four scales, guided by the image.

    ``guide_widths``: channels of the image's features at each scale.
    """

    def __init__(self, config: LightConfig, guide_widths: tuple[int, ...]) -> None:
        super().__init__()
        self.groups = config.groups
        widths = config.volume_widths
        steps = list(pairwise(widths))  # channels of each scale and of the next coarser one
        conv = nn.Conv3d
        up_conv = nn.ConvTranspose3d
        self.first = ConvNorm(conv, config.groups, widths[0])
        self.down = nn.ModuleList(ConvNorm(conv, fine, coarse, stride=2) for fine, coarse in steps)
        self.same = nn.ModuleList(ConvNorm(conv, coarse, coarse) for _, coarse in steps)
        self.up = nn.ModuleList(ConvNorm(up_conv, coarse, fine, stride=2) for fine, coarse in steps)
        self.joined = nn.ModuleList(ConvNorm(conv, fine, fine) for fine, _ in steps)
        self.guides = nn.ModuleList(
            nn.Conv2d(guide_width, width, 1)
            for guide_width, width in zip(guide_widths, widths, strict=True)
        )
        self.score = nn.Conv3d(widths[0], 1, 3, 1, 1, bias=False)

    def forward(
        self,
        left: Features,
        right: Features,
        bins: int,
        levels: tuple[Features, ...],
        rows: int | None = None,
        first: int = 0,
    ) -> Scores:
        """Score each disparity of each pixel; a larger score is likelier.

        With ``rows``, and no gradient, one volume of the largest size is held, instead of four.

        Args:
            left: descriptions of the left view's pixels, at quarter size.
            right: those of the right view.
            bins: number of disparities [px at quarter size].
            levels: features of the left view at each scale, which guide the aggregation.
            rows: how many rows at quarter size are computed at a time, an even number; None: all.
            first: the first disparity, which may be negative.
        """
        guides = [
            torch.sigmoid(guide(level))[:, :, None]
            for guide, level in zip(self.guides, levels, strict=True)
        ]

        # Down: each scale has half the size of the one before.
        make_volume = partial(self._make_volume, bins=bins, first=first)
        volumes = [by_rows(make_volume, (left, right, guides[0]), halo=1, rows=rows)]
        for down, same, guide in zip(self.down, self.same, guides[1:], strict=True):
            smaller = same(down(volumes[-1]).relu_()).relu_()
            volumes.append(_multiply(smaller, guide))

        # Up again, the coarsest first; the largest size, whose layers are the first, by rows.
        x = volumes.pop()
        for up, joined in zip(self.up[:0:-1], self.joined[:0:-1], strict=True):
            x = joined(_add_enlarged(up, x, volumes.pop())).relu_()
        largest = volumes.pop()
        half_rows = None if rows is None else rows // 2
        add_enlarged = partial(_add_enlarged, self.up[0])
        x = by_rows(add_enlarged, (x, largest), halo=1, rows=half_rows, into=largest)
        return by_rows(self._score_volume, (x,), halo=2, rows=rows)[:, 0]

    def _make_volume(
        self, left: Features, right: Features, guide: Volume, *, bins: int, first: int
    ) -> Volume:
        """Correlate the descriptions of both views, convolve, and weigh the volume by its guide."""
        left_groups = unit_groups(left, self.groups)
        right_groups = unit_groups(right, self.groups)
        volume = correlation_volume(left_groups, right_groups, bins, first)
        volume = volume.contiguous(memory_format=torch.channels_last_3d)
        return _multiply(self.first(volume).relu_(), guide)

    def _score_volume(self, volume: Volume) -> Volume:
        """Compute one score for each disparity of each pixel."""
        return self.score(self.joined[0](volume).relu_())


def _multiply(volume: Volume, guide: Volume) -> Volume:
    """Multiply a volume by its guide; in place where no gradient needs the old values."""
    return volume.mul(guide) if torch.is_grad_enabled() else volume.mul_(guide)


def _add_enlarged(up: nn.Module, volume: Volume, larger: Volume) -> Volume:
    """Enlarge a volume by ``up``, and add the larger volume from the way down."""
    return up(volume).add_(larger).relu_()
