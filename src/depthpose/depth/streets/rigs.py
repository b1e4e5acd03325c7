"""Stereo rigs: those of KITTI's recording days, and others."""

from dataclasses import replace

import numpy as np
import torch

from depthpose.core.camera import StereoRig, crop_camera, resize_camera
from depthpose.depth.config import StreetsConfig

KITTI_RIGS = (
    (1242, 375, 721.5377, 609.5593, 172.8540, 0.5327),
    (1224, 370, 707.0493, 604.0814, 180.5066, 0.5373),
    (1238, 374, 718.3351, 600.3891, 181.5122, 0.5301),
    (1226, 370, 707.0912, 601.8873, 183.1104, 0.5371),
    (1241, 376, 718.8560, 607.1928, 185.2157, 0.5372),
)
"""Width, height, focal length, principal point [px] and baseline [m] of the five recording days."""

_KITTI_SHARES = (0.6, 0.1, 0.1, 0.1, 0.1)
"""Nearly all benchmarks are of the first day."""


def street_rig(config: StreetsConfig, index: int) -> tuple[StereoRig, float]:
    """Give the rig of a frame and the height of its mount [m], without drawing the frame."""
    return draw_rig(np.random.default_rng([72, config.seed, index]), config)


def rig_number(config: StreetsConfig, index: int) -> int:
    """Say which of KITTI's rigs a frame has, where ``config.rigs`` knows no others.

    Rigs cannot be told apart by their size: small pictures of two of them are of one.
    """
    full = replace(config, scale=1.0, crop=None)
    width = street_rig(full, index)[0].width
    return next(n for n, rig in enumerate(KITTI_RIGS) if rig[0] == width)


def kitti_rig(number: int = 0) -> StereoRig:
    """Give the rig of one of KITTI's five recording days, as published."""
    width, height, focal_px, cx, cy, baseline_m = KITTI_RIGS[number]
    K = torch.tensor([[focal_px, 0, cx], [0, focal_px, cy], [0, 0, 1]], dtype=torch.float64)
    return StereoRig(width=width, height=height, K=K, baseline_m=baseline_m)


def draw_rig(rng: np.random.Generator, config: StreetsConfig) -> tuple[StereoRig, float]:
    """Draw the rig of a frame, scaled and cropped as asked, and the height of its mount [m]."""
    is_kitti = config.rigs == "kitti" or rng.random() < 0.5
    if is_kitti:
        rig, mount_m = kitti_rig(int(rng.choice(len(KITTI_RIGS), p=_KITTI_SHARES))), 1.65
    else:
        rig, mount_m = _other_rig(rng), rng.uniform(1.1, 2.2)
    width, height = (max(1, round(side * config.scale)) for side in (rig.width, rig.height))
    rig = resize_camera(rig, width, height)
    if config.crop is None:
        return rig, mount_m
    rows, columns = min(config.crop[0], height), min(config.crop[1], width)
    left = int(rng.integers(width - columns + 1))
    top = int(rng.integers(height - rows + 1))
    return crop_camera(rig, left, top, columns, rows), mount_m


def _other_rig(rng: np.random.Generator) -> StereoRig:
    width = int(rng.integers(900, 1600))
    height = int(width / rng.uniform(1.6, 3.3))
    focal_px = width * rng.uniform(0.45, 1.1)
    ratio = 1 + rng.normal(0, 0.004)
    cx, cy = width * (0.5 + rng.normal(0, 0.015)), height * (0.5 + rng.normal(0, 0.03))
    K = torch.tensor([[focal_px, 0, cx], [0, focal_px * ratio, cy], [0, 0, 1]], dtype=torch.float64)
    baseline_m = float(np.exp(rng.uniform(np.log(0.12), np.log(0.8))))
    return StereoRig(width=width, height=height, K=K, baseline_m=baseline_m)
