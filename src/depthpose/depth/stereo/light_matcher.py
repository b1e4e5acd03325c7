"""The light network as a matcher: images of any size in, disparity and confidence out."""

import copy

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from depthpose.depth.config import LightConfig, MatcherConfig
from depthpose.depth.stereo.light import LightStereo, enlarge, mean_of_best
from depthpose.depth.stereo.network_matcher import NetworkMatcher, Views
from depthpose.depth.stereo.volume import WINDOW_PX
from depthpose.depth.types import Match


class LightMatcher(NetworkMatcher):
    """The light network with the world around it: normalisation, padding, device.

    The weights are copied: training ``network`` further does not change this matcher. Where the
    processor has no bf16, ``config`` says fp32 in its place.

    Raises:
        InputError: the device does not exist on this machine.
    """

    fine_pixels = 500_000
    """Pixels of a fine match at most: a whole image of KITTI."""

    def __init__(self, network: LightStereo, config: MatcherConfig | None = None) -> None:
        super().__init__(network.config, config)
        self._network = copy.deepcopy(network).eval().to(self.device, self.dtype)

    def run(self, left: Views, right: Views, network: LightConfig) -> list[Match]:
        """Match normalised pairs whose sides suit the network."""
        scores, weights = self._network.scores(
            left.to(self.dtype), right.to(self.dtype), network.max_disparity_px
        )
        quarter_px = 4 * mean_of_best(scores, network.candidates)
        found_px = enlarge(quarter_px, weights)
        if not self.config.with_confidence:
            return [Match(disparity_px=one) for one in found_px]
        sure = enlarge(confidence(scores, quarter_px), weights)
        return [Match(disparity_px=d, confidence=c) for d, c in zip(found_px, sure, strict=True)]


def confidence(
    scores: Float[Tensor, "b d h w"], disparity_px: Float[Tensor, "b h w"]
) -> Float[Tensor, "b h w"]:
    """Give the probability of what lies within ``WINDOW_PX`` of a disparity.

    As PSMNet's: scores are interpolated between the disparities that have one, four pixels apart.
    """
    bins = torch.arange(4 * scores.shape[1] - 3, device=scores.device)[:, None, None]
    wide = F.interpolate(
        scores.flatten(2)[:, None],
        (len(bins), scores[0, 0].numel()),
        mode="bilinear",
        align_corners=True,
    )
    probability = wide[:, 0].softmax(1).unflatten(2, scores.shape[2:])
    is_near = (bins - disparity_px[:, None]).abs() <= WINDOW_PX
    return (probability * is_near).sum(1).clamp(0, 1)
