"""PSMNet as a matcher: images of any size in, disparity and confidence out."""

from depthpose.depth.config import MatcherConfig, PSMNetConfig
from depthpose.depth.stereo.inference import PSMNetInference
from depthpose.depth.stereo.network_matcher import NetworkMatcher, Views
from depthpose.depth.stereo.plan import Footprint
from depthpose.depth.stereo.psmnet import PSMNet
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
        self._inference = PSMNetInference(
            network, self.dtype, self.device, with_compile=self.config.with_compile
        )

    def run(self, left: Views, right: Views, network: PSMNetConfig) -> list[Match]:
        """Match normalised pairs whose sides suit the network.

        Raises:
            InputError: a memory bound that is too small for them.
        """
        height, width = left.shape[-2:]
        footprint = Footprint(config=network, height=height, width=width, dtype=self.dtype)
        return self._inference.match(
            left,
            right,
            footprint.plan(self.config.max_memory_bytes),
            max_disparity_px=network.max_disparity_px,
            with_confidence=self.config.with_confidence,
        )
