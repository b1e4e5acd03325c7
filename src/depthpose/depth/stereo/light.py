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
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.depth.config import LightConfig
from depthpose.depth.encoder import LiteEncoder
from depthpose.depth.stereo.enlargement import (
    STEM,
    ConvexUpsampling,
    Features,
    Maps,
    Quarter,
    Refinement,
    Seen,
    ViewFeatures,
    enlarge,
    unit_groups,
)
from depthpose.depth.stereo.network_matcher import IMAGENET_MEAN, IMAGENET_STD, StereoNetwork
from depthpose.depth.stereo.psmnet import Shape, conv_norm_2d, conv_norm_3d, deconv_norm_3d
from depthpose.depth.stereo.scores import (
    STEP_PX,
    Reading,
    Scores,
    SkyHead,
    confidence_near,
    mean_of_all,
    mean_of_best,
)
from depthpose.depth.stereo.volume import by_rows

Volume = Float[Tensor, "b _ _ _ _"]

_DEEP = 96
"""Channels of the decoder at 1/32, twice those at 1/16 and 1/8."""


class LightFeatures(nn.Module):
    """One view to features at 1/2 to 1/32 of its sides."""

    def __init__(self, config: LightConfig) -> None:
        super().__init__()
        w = config.width
        self.stem = conv_norm_2d(3, STEM, Shape(3, 2))
        self.quarter = nn.ModuleList([conv_norm_2d(STEM, w, Shape(3, 2)), conv_norm_2d(w, w)])
        self.encoder = LiteEncoder(config.encoder_width, levels=4)
        self.top = conv_norm_2d(self.encoder.channels[3], _DEEP, Shape(1))
        quarter, eighth, sixteenth, _ = self.encoder.channels
        skips = (sixteenth, eighth, quarter + w)
        self.widths = (w, _DEEP // 2, _DEEP // 2, _DEEP)
        outputs, above = self.widths[-2::-1], self.widths[:0:-1]
        self.decoder = nn.ModuleList(
            conv_norm_2d(a + skip, out) for a, skip, out in zip(above, skips, outputs, strict=True)
        )
        mean, deviation = (torch.tensor(v)[:, None, None] for v in (IMAGENET_MEAN, IMAGENET_STD))
        self.register_buffer("mean", mean, persistent=False)
        self.register_buffer("deviation", deviation, persistent=False)

    mean: Tensor
    deviation: Tensor

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> ViewFeatures:
        """Give features of each pixel with local and global context."""
        image = image.contiguous(memory_format=torch.channels_last)
        half = F.relu(self.stem(image))
        quarter = half
        for layer in self.quarter:
            quarter = F.relu(layer(quarter))
        skips = self.encoder(
            F.avg_pool2d(image, 2) * self.deviation.to(image) + self.mean.to(image)
        )
        levels = [F.relu(self.top(skips[3]))]
        seen = (skips[2], skips[1], torch.cat([skips[0], quarter], 1))
        for layer, skip in zip(self.decoder, seen, strict=True):
            above = F.interpolate(levels[-1], scale_factor=2.0, mode="nearest")
            levels.append(F.relu(layer(torch.cat([above, skip], 1))))
        return ViewFeatures(half, tuple(levels[::-1]))


def correlation_volume(
    left: Float[Tensor, "b c h w"], right: Float[Tensor, "b c h w"], bins: int, groups: int
) -> Float[Tensor, "b {groups} {bins} h w"]:
    """Give the cosine of each group of features of ``left[y, x]`` and ``right[y, x - d]``.

    Zero where the right pixel falls outside the image.
    """
    width = left.shape[-1]
    left, right = unit_groups(left, groups), F.pad(unit_groups(right, groups), (bins - 1, 0))
    firsts = (bins - 1 - d for d in range(bins))
    # Groups last, as convolutions of volumes want them: no copy is made.
    cosines = [(left * right[..., k : k + width]).sum(2).permute(0, 2, 3, 1) for k in firsts]
    return torch.stack(cosines, 1).permute(0, 4, 1, 2, 3)


class Aggregation(nn.Module):
    """Correlation volume to one score a voxel: an image-guided hourglass of three scales."""

    def __init__(self, config: LightConfig, guide_widths: tuple[int, ...]) -> None:
        super().__init__()
        self.config, v = config, config.volume_widths
        self.first = conv_norm_3d(config.groups, v[0])
        steps = list(pairwise(v))
        self.down = nn.ModuleList(conv_norm_3d(a, b, stride=2) for a, b in steps)
        self.same = nn.ModuleList(conv_norm_3d(b, b) for _, b in steps)
        self.up = nn.ModuleList(deconv_norm_3d(b, a) for a, b in steps)
        self.joined = nn.ModuleList(conv_norm_3d(a, a) for a in v[:-1])
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
    ) -> Scores:
        """Score each disparity by the descriptions of both views; more is likelier.

        With ``rows``, and no gradient, one volume of the largest size is held, instead of four.
        """
        guides = [
            torch.sigmoid(guide(level))[:, :, None]
            for guide, level in zip(self.guides, levels, strict=True)
        ]

        def begin(left: Features, right: Features, guide: Volume) -> Volume:
            volume = correlation_volume(left, right, bins, self.config.groups)
            volume = volume.contiguous(memory_format=torch.channels_last_3d)
            return _product(self.first(volume).relu_(), guide)

        def raised(up: nn.Module, volume: Volume, larger: Volume) -> Volume:
            return up(volume).add_(larger).relu_()

        def end(volume: Volume) -> Volume:
            return self.score(self.joined[0](volume).relu_())

        scales = [by_rows(begin, (left, right, guides[0]), halo=1, rows=rows)]
        for down, same, guide in zip(self.down, self.same, guides[1:], strict=True):
            scales.append(_product(same(down(scales[-1]).relu_()).relu_(), guide))
        x = scales.pop()
        for up, joined in zip(self.up[:0:-1], self.joined[:0:-1], strict=True):
            x = joined(raised(up, x, scales.pop())).relu_()
        largest, half = scales.pop(), None if rows is None else rows // 2
        x = by_rows(partial(raised, self.up[0]), (x, largest), halo=1, rows=half, into=largest)
        return by_rows(end, (x,), halo=2, rows=rows)[:, 0]


def _product(volume: Volume, guide: Volume) -> Volume:
    """Multiply a volume by its guide, in place where no gradient needs the old values."""
    return volume * guide if torch.is_grad_enabled() else volume.mul_(guide)


class LightStereo(StereoNetwork):
    """Rectified pair to disparity at a fraction of PSMNet's operations.

    Images are RGB normalised by ImageNet's mean and deviation; both sides are multiples of 32.

    Attributes:
        rows: at 1/4 size, an even number, that are computed at a time where something large would
            be held, with no gradient; None, as in training and in exported graphs: all.
    """

    rows: int | None = None

    def __init__(self, config: LightConfig | None = None) -> None:
        super().__init__()
        self.config = config or LightConfig()
        self.features = LightFeatures(self.config)
        self.describe = nn.Conv2d(self.config.width, self.config.width, 1, bias=False)
        self.aggregation = Aggregation(self.config, self.features.widths)
        self.enlargement = ConvexUpsampling(
            self.config.width, with_agreement=self.config.with_agreement
        )
        self.refinement = Refinement() if self.config.with_refinement else None
        self.sky_head = SkyHead(self.features.widths) if self.config.with_sky else None

    @property
    def encoder(self) -> LiteEncoder:
        """Of ImageNet, in the features."""
        return self.features.encoder

    @property
    def sky(self) -> SkyHead | None:
        """The class of the sky."""
        return self.sky_head

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Maps, ...]:
        """Give the disparity maps of :meth:`read`."""
        return self.read(left, right, self.config.max_disparity_px).heads

    def forward_with_sky(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[tuple[Maps, ...], Maps | None]:
        """Give the disparity maps of :meth:`read`, and the probability of the sky."""
        read = self.read(left, right, self.config.max_disparity_px)
        return read.heads, read.sky

    def read(
        self,
        left: Float[Tensor, "b 3 h w"],
        right: Float[Tensor, "b 3 h w"],
        max_disparity_px: int,
        *,
        with_confidence: bool = False,
    ) -> Reading:
        """Match the pair, and read disparity, confidence and sky off the scores.

        Raises:
            InputError: the images' size does not suit the network.
        """
        scores, seen = self.scores(left, right, max_disparity_px)
        quarter_px = mean_of_best(scores, self.config.candidates)
        quarters = [quarter_px]
        if with_confidence or self.sky_head is not None:
            with torch.no_grad():
                quarters.append(self._confidence(scores, quarter_px))
        if self.sky_head is not None:
            quarters.append(self.sky_head(seen.left.levels, *quarters))
        coarse_px = mean_of_all(scores)[:, None] if self.training else None
        del scores
        found_px, *rest = self.enlarge(torch.stack(quarters, 1), seen).unbind(1)
        heads = (found_px,) if self.refinement is None else (found_px, self.refine(found_px, seen))
        if coarse_px is None:
            heads = heads[-1:]
        else:
            wide_px = F.interpolate(coarse_px, scale_factor=4.0, mode="bilinear")[:, 0]
            heads = (wide_px, *heads)
        confidence = rest[0] if with_confidence else None
        if self.sky_head is None:
            return Reading(heads, confidence, None)
        sure, sky = rest
        if not self.training:
            sky = torch.where(sky > sure, sky, sky.clamp(max=0.5))
        if confidence is not None:
            confidence = torch.where(sky > 0.5, sky, sure * (1 - sky))
        return Reading(heads, confidence, sky)

    def _confidence(self, scores: Scores, quarter_px: Quarter) -> Quarter:
        """By rows: probabilities between the scores are the largest volume."""
        if self.rows is None:
            return confidence_near(scores, quarter_px)
        parts = zip(scores.split(self.rows, 2), quarter_px.split(self.rows, 1), strict=True)
        return torch.cat([confidence_near(*part) for part in parts], 1)

    def enlarge(self, quarters: Float[Tensor, "b k h4 w4"], seen: Seen) -> Float[Tensor, "b k h w"]:
        """Bring maps to the images' size by weights that follow the first, the disparity [px]."""

        def enlarged(
            quarters: Tensor,
            left_half: Features,
            left_quarter: Features,
            right_half: Features | None,
        ) -> Tensor:
            near = Seen(ViewFeatures(left_half, (left_quarter,)), right_half)
            weights = self.enlargement(near, quarters[:, 0])
            return torch.stack([enlarge(one, weights) for one in quarters.unbind(1)], 1)

        parts = (quarters, seen.left.half, seen.left.levels[0], seen.right_half)
        return by_rows(enlarged, parts, halo=2, rows=self.rows)

    def refine(self, found_px: Maps, seen: Seen) -> Maps:
        """Correct an enlarged disparity, where the network has that part."""
        refinement = self.refinement
        if refinement is None:
            return found_px

        def refined(found_px: Maps, left_half: Features, right_half: Features) -> Maps:
            return refinement(Seen(ViewFeatures(left_half, ()), right_half), found_px)

        half = None if self.rows is None else 2 * self.rows
        parts = (found_px, seen.left.half, seen.right_half)
        return by_rows(refined, parts, halo=5, rows=half)

    def scores(
        self,
        left: Float[Tensor, "b 3 h w"],
        right: Float[Tensor, "b 3 h w"],
        max_disparity_px: int,
    ) -> tuple[Scores, Seen]:
        """Answer a score for each disparity at 1/4 size, and what the enlargement sees.

        Scores are float32 at least: 8 bits would round the expectation to whole pixels.
        """
        self._check_size(left)
        near, far = self.features(left), self.features(right)
        described = self.describe(near.levels[0]), self.describe(far.levels[0])
        compares = self.config.with_agreement or self.config.with_refinement
        right_half = far.half if compares else None
        del far
        bins = max_disparity_px // STEP_PX
        scores = self.aggregation(*described, bins, near.levels, self.rows)
        wide = torch.promote_types(scores.dtype, torch.float32)
        return scores.to(wide), Seen(near, right_half)

    def _check_size(self, image: Float[Tensor, "b 3 h w"]) -> None:
        h, w = image.shape[-2:]
        if h % 32 or w % 32:
            raise InputError(
                f"the light matcher takes sides that are multiples of 32, got {h}x{w}; pad the "
                "pair, as LightMatcher does"
            )
