"""The light network as a matcher: images of any size in, disparity and confidence out."""

import copy

import torch

from depthpose.depth.config import LightConfig, MatcherConfig
from depthpose.depth.stereo.folding import fold_features, fold_volumes
from depthpose.depth.stereo.light import LightStereo
from depthpose.depth.stereo.network_matcher import NetworkMatcher, Views
from depthpose.depth.stereo.plan import LightFootprint
from depthpose.depth.types import Match


class LightMatcher(NetworkMatcher):
    """The light network with pre- and post-processing: normalisation, padding, device.

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
        # A GPU has the memory, and is busy with whole volumes alone.
        self._network.rows = LightFootprint.rows if self.device.type == "cpu" else None
        if self.config.with_compile:
            self._network.features.compile()

    def run(self, left: Views, right: Views, network: LightConfig) -> list[Match]:
        """Match normalised pairs whose sides suit the network.

        Raises:
            InputError: a memory bound that is too small for them.
        """
        height, width = left.shape[-2:]
        footprint = LightFootprint(
            config=network,
            height=height,
            width=width,
            dtype=self.dtype,
            rows=self._network.rows or height // 4,
        )
        footprint.refuse_more_than(self.config.max_memory_bytes)
        read = self._network.read(
            left.to(self.dtype),
            right.to(self.dtype),
            network.max_disparity_px,
            with_confidence=self.config.with_confidence,
        )
        nothing = [None] * len(left)
        sure = nothing if read.confidence is None else read.confidence
        sky = nothing if read.sky is None else read.sky > 0.5
        parts = zip(read.heads[-1], sure, sky, strict=True)
        return [Match(disparity_px=d, confidence=c, is_sky=s) for d, c, s in parts]
