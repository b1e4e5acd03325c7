"""The stereo rigs of KITTI's five recording days, as published."""

from typing import NamedTuple

import torch

from depthpose.core.camera import StereoRig
from depthpose.depth.config import StreetsConfig
from depthpose.depth.synthetic.randomness import Stream, make_rng


class _Rig(NamedTuple):
    """Size, focal length and principal point [px], and baseline."""

    width: int
    height: int
    focal_px: float
    cx: float
    cy: float
    baseline_m: float


_RIGS = (
    _Rig(1242, 375, 721.5377, 609.5593, 172.8540, 0.5327),
    _Rig(1224, 370, 707.0493, 604.0814, 180.5066, 0.5373),
    _Rig(1238, 374, 718.3351, 600.3891, 181.5122, 0.5301),
    _Rig(1226, 370, 707.0912, 601.8873, 183.1104, 0.5371),
    _Rig(1241, 376, 718.8560, 607.1928, 185.2157, 0.5372),
)
_SHARES = (0.6, 0.1, 0.1, 0.1, 0.1)
"""Share of the frames of each: nearly all benchmarks are of the first day."""

KITTI_RIG_COUNT = len(_RIGS)


def draw_rig_number(config: StreetsConfig, index: int) -> int:
    """Draw which of KITTI's rigs a frame has, from its index and the seed of the config."""
    rng = make_rng(Stream.RIG, config.seed, index)
    return int(rng.choice(KITTI_RIG_COUNT, p=_SHARES))


def kitti_rig(number: int = 0) -> StereoRig:
    """Return the rig of one of KITTI's five recording days, counted from 0."""
    rig = _RIGS[number]
    K = torch.tensor(
        [[rig.focal_px, 0, rig.cx], [0, rig.focal_px, rig.cy], [0, 0, 1]], dtype=torch.float64
    )
    return StereoRig(width=rig.width, height=rig.height, K=K, baseline_m=rig.baseline_m)
