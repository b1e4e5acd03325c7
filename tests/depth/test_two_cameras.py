"""One synthetic scene, seen by cameras of several focal lengths and sizes, has one depth."""

import dataclasses

import pytest
import torch
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.checkpoint import SHIPPED
from depthpose.depth.config import StreetsConfig
from depthpose.depth.disparity import resize_image
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.synthetic import kitti_rig, make_street, render_scene
from depthpose.depth.types import DepthInput

ALLOWED = 0.05
"""Median relative difference: at another size, and where the street is seen half as much again to
either side."""


def rig(focal_px: float, width: int, height: int) -> StereoRig:
    """KITTI's baseline; the horizon at the same share of the height."""
    K = torch.tensor(
        [[focal_px, 0, width / 2 - 0.5], [0, focal_px, 0.46 * height], [0, 0, 1]],
        dtype=torch.float64,
    )
    return dataclasses.replace(kitti_rig(0), width=width, height=height, K=K)


def depth_m(net: FakestereoNet, camera: StereoRig) -> Tensor:
    config = StreetsConfig(seed=9, jpeg_share=0.0, rectification_error_px=0.0)
    frame = render_scene(make_street((9, 2)), camera, config, (9, 2))
    estimate = net.estimate_input(
        DepthInput(name="street", left=frame.left, right=None, camera=camera)
    )
    assert estimate.depth_m is not None
    return estimate.depth_m


@pytest.mark.slow
@pytest.mark.skipif(not (SHIPPED / "default.safetensors").is_file(), reason="no weights ship yet")
def test_one_scene_has_the_same_metres_through_every_camera() -> None:
    net = FakestereoNet.load("default")
    seen = depth_m(net, rig(360.0, 620, 188))
    larger = depth_m(net, rig(540.0, 930, 282))
    wider = depth_m(net, rig(360.0, 930, 188))
    for other in (larger, wider[:, 155:775]):
        same_size = resize_image(other[None].expand(3, -1, -1) / 1000, 188, 620)[0] * 1000
        relative = (same_size - seen).abs() / seen
        assert float(relative.isfinite().float().mean()) > 0.7, "the rest is sky in one of the two"
        assert float(relative.nanmedian()) < ALLOWED
