"""Depth as Open3D takes it."""

import importlib.util
import sys

import numpy as np
import pytest
import torch

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import MissingExtraError
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.types import DepthInput, Match

H, W, F = 4, 6, 8.0
DEPTH_M = torch.arange(1, H * W + 1, dtype=torch.float32).reshape(H, W) * 4
DEPTH_M[1, 2] = torch.nan


def pair() -> DepthInput:
    K = torch.tensor([[F, 0, 2.5], [0, F, 1.5], [0, 0, 1]], dtype=torch.float64)
    rig = StereoRig(width=W, height=H, K=K, baseline_m=0.5)
    left = torch.rand(3, H, W, generator=torch.Generator().manual_seed(0))
    return DepthInput(name="a", left=left, right=left.flip(2), camera=rig)


class KnowsDepth:
    """A matcher that answers ``DEPTH_M`` for every pair."""

    def match(
        self,
        left: torch.Tensor,  # noqa: ARG002
        right: torch.Tensor,  # noqa: ARG002
        camera: Camera | None = None,  # noqa: ARG002
    ) -> Match:
        return Match(disparity_px=F * 0.5 / DEPTH_M)


def test_an_estimate_holds_its_coloured_cloud_up_to_a_distance() -> None:
    seen = pair()
    cloud = FakestereoNet(KnowsDepth()).estimate_input(seen).cloud(far_m=80.0)
    is_near = DEPTH_M.flatten() <= 80
    assert torch.allclose(cloud.points[:, 2], DEPTH_M.flatten()[is_near])
    assert cloud.color is not None
    assert torch.equal(cloud.color, seen.left.permute(1, 2, 0).reshape(-1, 3)[is_near])
    x_m, y_m, z_m = cloud.points[0].tolist()
    assert (x_m, y_m, z_m) == pytest.approx((-2.5 / F * 4, -1.5 / F * 4, 4.0))


def test_without_open3d_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    found = FakestereoNet(KnowsDepth()).estimate_input(pair())
    with pytest.raises(MissingExtraError, match=r"pip install -e '.\[open3d\]'"):
        found.to_open3d()


@pytest.mark.skipif(importlib.util.find_spec("open3d") is None, reason="open3d is not installed")
def test_open3d_gets_the_same_points_and_colours() -> None:
    found = FakestereoNet(KnowsDepth()).estimate_input(pair())
    cloud, theirs = found.cloud(), found.to_open3d()
    assert type(theirs).__name__ == "PointCloud"
    assert np.allclose(np.asarray(theirs.points), cloud.points.numpy())
    assert cloud.color is not None
    assert np.allclose(np.asarray(theirs.colors), cloud.color.numpy())
