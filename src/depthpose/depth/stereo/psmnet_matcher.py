"""PSMNet as a matcher: images of any size in, disparity and confidence out."""

import copy
from typing import cast

import torch
from torch import nn

from depthpose.depth.config import MatcherConfig, PSMNetConfig
from depthpose.depth.stereo.folding import VolumeConv, fold_features, fold_volumes
from depthpose.depth.stereo.network_matcher import NetworkMatcher, Views
from depthpose.depth.stereo.plan import PSMNetFootprint
from depthpose.depth.stereo.psmnet import PSMNet
from depthpose.depth.stereo.volume import Size, expected_disparity
from depthpose.depth.types import Match


class PSMNetMatcher(NetworkMatcher):
    """PSMNet with pre- and post-processing: normalisation, padding, device, memory.

    The weights are copied: training ``network`` further does not change this matcher. Where the
    processor has no bf16, ``config`` says fp32 in its place.

    Raises:
        InputError: the device does not exist on this machine.
    """

    fine_pixels = 280_000
    """Pixels of a fine match at most: an image of KITTI at three quarters of its resolution."""

    def __init__(self, network: PSMNet, config: MatcherConfig | None = None) -> None:
        super().__init__(network.config, config)
        like = torch.empty(0, dtype=self.dtype, device=self.device)
        self._network = copy.deepcopy(network).eval().to(self.device)
        for head in self._network.heads:
            # In float32 at least: 8 bits would round the expectation to whole pixels.
            cost, wide = cast("nn.Conv3d", head.cost), torch.empty(0, device=self.device)
            head.cost = VolumeConv(cost, cost.weight, torch.zeros(1), wide)
        fold_volumes(self._network, like)
        fold_features(self._network.features, like)
        self._network.rows = PSMNetFootprint.rows
        if self.config.with_compile:
            self._network.features.compile()

    def run(self, left: Views, right: Views, network: PSMNetConfig) -> list[Match]:
        """Match normalised pairs whose sides suit the network.

        Raises:
            InputError: a memory bound that is too small for them.
        """
        height, width = left.shape[-2:]
        footprint = PSMNetFootprint(config=network, height=height, width=width, dtype=self.dtype)
        footprint.refuse_more_than(self.config.max_memory_bytes)
        near, far = (one.to(self.dtype, memory_format=torch.channels_last) for one in (left, right))
        costs = self._network.costs(near, far, network.max_disparity_px)[-1][:, 0]
        found = [
            expected_disparity(
                cost.permute(1, 2, 0).contiguous(),
                Size(network.max_disparity_px, height, width),
                align_corners=network.align_corners,
                with_confidence=self.config.with_confidence,
            )
            for cost in costs
        ]
        return [Match(disparity_px=d, confidence=c) for d, c in found]
