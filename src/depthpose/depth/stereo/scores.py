"""What the scores of the light network say: disparity, confidence, and where the sky is."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.depth.stereo.enlargement import Features, Maps, Quarter
from depthpose.depth.stereo.psmnet import conv_norm_2d
from depthpose.depth.stereo.volume import interpolation_matrix, linear_taps

Scores = Float[Tensor, "b d h4 w4"]

STEP_PX = 4
"""Distance of neighbouring disparities that have a score."""
_WINDOW = 0.15
"""Of a disparity: what lies so near to it counts for its confidence."""
_USUAL_PX = 64
"""A disparity of this size is 1 to the class of the sky."""
_SKY_WIDTH = 32
"""Channels of the class of the sky."""


def mean_of_best(scores: Scores, candidates: int) -> Quarter:
    """Give the expected disparity [px] over the disparities of the highest scores."""
    best = scores.topk(candidates, 1)
    return STEP_PX * (best.values.softmax(1) * best.indices).sum(1)


def mean_of_all(scores: Scores) -> Quarter:
    """Give the expected disparity [px] over all disparities."""
    bins = torch.arange(scores.shape[1], dtype=scores.dtype, device=scores.device)
    return STEP_PX * (scores.softmax(1) * bins[:, None, None]).sum(1)


def confidence_near(scores: Scores, disparity_px: Quarter) -> Quarter:
    """Give the probability of what lies within 15 % of a disparity.

    As the confidence of a generator that selects: depth is then off by no more than about that.
    Between the disparities that have a score, scores are interpolated.
    """
    bins = scores.shape[1]
    count = STEP_PX * (bins - 1) + 1
    matrix = interpolation_matrix(linear_taps(bins, count, scores, align_corners=True), bins)
    probability = F.conv2d(scores, matrix[..., None, None]).softmax(1)
    steps_px = torch.arange(count, dtype=scores.dtype, device=scores.device)[:, None, None]
    distance_px = (steps_px - disparity_px[:, None]).abs()
    window_px = _WINDOW * disparity_px.clamp(min=1)[:, None]
    # Each whole disparity stands for the half pixel on both sides of it.
    share = (window_px + 0.5 - distance_px).clamp(0, 1)
    return (probability * share).sum(1).clamp(0, 1)


class SkyHead(nn.Module):
    """Probability of the sky at 1/4 size; it begins as unlikely everywhere.

    Args:
        widths: channels of the left view's features at 1/4, 1/8, 1/16 and 1/32.
    """

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        quarter, *coarser = widths
        deepest = len(coarser) - 1
        self.coarse = nn.ModuleList(
            conv_norm_2d(w if k == deepest else w + _SKY_WIDTH, _SKY_WIDTH)
            for k, w in enumerate(coarser)
        )
        self.hidden = conv_norm_2d(quarter + _SKY_WIDTH + 2, _SKY_WIDTH)
        self.logit = nn.Conv2d(_SKY_WIDTH, 1, 1)
        nn.init.zeros_(self.logit.weight)
        assert self.logit.bias is not None
        nn.init.constant_(self.logit.bias, -2.0)

    def forward(
        self, levels: tuple[Features, ...], quarter_px: Quarter, confidence: Quarter
    ) -> Quarter:
        """Tell the sky by features of the left view, and by its match, which learns nothing.

        Where the match is near and its confidence high, there is no sky.
        """
        quarter, *coarser = levels
        found: list[Tensor] = []
        for layer, level in zip(reversed(self.coarse), reversed(coarser), strict=True):
            x = F.relu(layer(torch.cat([level, *found], 1)))
            found = [F.interpolate(x, scale_factor=2.0, mode="nearest")]
        match = torch.stack([confidence, quarter_px / _USUAL_PX], 1).detach()
        hidden = F.relu(self.hidden(torch.cat([quarter, *found, match.to(quarter)], 1)))
        return self.logit(hidden)[:, 0].to(confidence).sigmoid()


class Reading(NamedTuple):
    """What the scores say about the left view.

    Attributes:
        heads: disparity [px], the last one the answer: while training that of all scores, enlarged
            without the image, that before the refinement, and that after it; in eval mode the last
            alone. What it says in the sky means nothing where the network has that class.
        confidence: 0..1, in the sky its probability; None where it was not asked for.
        sky: probability of the sky, or None where the network has no such class. In eval mode at
            most a half where the confidence of the match is higher: white walls look like the sky.
    """

    heads: tuple[Maps, ...]
    confidence: Maps | None
    sky: Maps | None
