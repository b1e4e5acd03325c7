"""The shipped networks on a GPU: the answers of the CPU. Skipped where there is none."""

import dataclasses

import pytest
import torch
from tests.synthetic_street import make_street

from depthpose import FakestereoNet, GeoPoseNet
from depthpose.core.rigid import geodesic_rad
from depthpose.depth.config import MatcherConfig
from depthpose.pose.config import EstimateConfig, ObjectsConfig
from depthpose.pose.synthetic import SyntheticViews

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]


def test_poses_are_those_of_the_cpu() -> None:
    on_cpu = GeoPoseNet.load("parts")
    on_gpu = GeoPoseNet.load("parts", config=EstimateConfig(device="cuda"))
    views = SyntheticViews(
        on_cpu.weights.models, ObjectsConfig(number=20, views=None), on_cpu.weights.cloud
    )
    inputs = [views.view(index).input for index in range(len(views))]
    expected, found = on_cpu.estimate_many(inputs), on_gpu.estimate_many(inputs)
    assert [one.status for one in found] == [one.status for one in expected]
    assert sum(one.is_posed for one in found) >= 8
    for mine, theirs in zip(found, expected, strict=True):
        if mine.camera_from_model is None or theirs.camera_from_model is None:
            continue
        assert mine.camera_from_model.t_m.device.type == "cpu"
        off_m = mine.camera_from_model.t_m - theirs.camera_from_model.t_m
        assert float(off_m.norm()) < 2e-4
        turn_rad = geodesic_rad(mine.camera_from_model.R, theirs.camera_from_model.R)
        assert float(turn_rad) < 0.01


@pytest.mark.parametrize("has_right", [False, True])
def test_depth_is_that_of_the_cpu(has_right: bool) -> None:
    given = make_street(0.4).input
    right = given.right if has_right else None
    config = MatcherConfig()
    on_cpu, on_gpu = (
        FakestereoNet.load("default", config=dataclasses.replace(config, device=device)).estimate(
            given.left, given.camera, right=right
        )
        for device in ("cpu", "cuda")
    )
    assert on_cpu.depth_m is not None
    assert on_gpu.depth_m is not None
    mine, theirs = on_gpu.depth_m.cpu(), on_cpu.depth_m
    is_known = mine.isfinite() & theirs.isfinite()
    assert float((mine.isfinite() == theirs.isfinite()).float().mean()) > 0.99
    off = ((mine - theirs).abs() / theirs)[is_known]
    assert float(off.median()) < 1e-3
    assert float((off < 0.01).float().mean()) > 0.95
