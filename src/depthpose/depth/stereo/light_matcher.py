"""The light network as a matcher: images of any size in, disparity and confidence out."""

import copy

import torch

from depthpose.depth.config import LightConfig, MatcherConfig
from depthpose.depth.stereo.enlargement import enlarge
from depthpose.depth.stereo.folding import fold_features, fold_volumes
from depthpose.depth.stereo.light import LightStereo, confidence_near, mean_of_best
from depthpose.depth.stereo.network_matcher import NetworkMatcher, Views
from depthpose.depth.stereo.plan import LightFootprint
from depthpose.depth.types import Match

_ROWS = 16
"""Rows at quarter size whose confidence is computed at a time: probabilities between the scores are
the largest of all volumes."""


class LightMatcher(NetworkMatcher):
    """The light network with the world around it: normalisation, padding, device.

    The weights are copied: training ``network`` further does not change this matcher. Where the
    processor has no bf16, ``config`` says fp32 in its place.

    Raises:
        InputError: the device does not exist on this machine.
    """

    fine_pixels = 650_000
    """Pixels of a fine match at most: an image of KITTI, enlarged 1.18 times."""
    most_enlarged = 1.5
    most_reach = 1.75

    def __init__(self, network: LightStereo, config: MatcherConfig | None = None) -> None:
        super().__init__(network.config, config)
        like = torch.empty(0, dtype=self.dtype, device=self.device)
        folded = fold_volumes(copy.deepcopy(network).eval().to(self.device), like)
        self._network = fold_features(folded, like)
        if self.config.with_compile:
            self._network.features.compile()

    def run(self, left: Views, right: Views, network: LightConfig) -> list[Match]:
        """Match normalised pairs whose sides suit the network.

        Raises:
            InputError: a memory bound that is too small for them.
        """
        height, width = left.shape[-2:]
        footprint = LightFootprint(config=network, height=height, width=width, dtype=self.dtype)
        footprint.refuse_more_than(self.config.max_memory_bytes)
        scores, seen = self._network.scores(
            left.to(self.dtype), right.to(self.dtype), network.max_disparity_px
        )
        quarter_px = mean_of_best(scores, network.candidates)
        weights = self._network.enlargement(seen, quarter_px).to(scores.dtype)
        found_px = self._network.refine(enlarge(quarter_px, weights), seen)
        if not self.config.with_confidence:
            return [Match(disparity_px=one) for one in found_px]
        rows = zip(scores.split(_ROWS, 2), quarter_px.split(_ROWS, 1), strict=True)
        sure = enlarge(torch.cat([confidence_near(*some) for some in rows], 1), weights)
        return [Match(disparity_px=d, confidence=c) for d, c in zip(found_px, sure, strict=True)]
