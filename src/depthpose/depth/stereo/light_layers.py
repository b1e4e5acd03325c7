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

Quarter = Float[Tensor, "b h4 w4"]


STEM = 16
"""Channels at half size."""
_OFFSETS = (-2, -1, 0, 1, 2)
"""Differences from the disparity [pixels at half size] at which the refinement compares the
views."""
_GROUPS = 4
_REFINED = 32
_USUAL_PX = 64
"""A disparity of this size is 1 to the class of the sky."""
_SKY_WIDTH = 32
"""Channels of the class of the sky."""
_DEEP = 96
"""Channels of the decoder at 1/32, twice those at 1/16 and 1/8."""


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
        least_px: float = MIN_DISPARITY_PX,
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
