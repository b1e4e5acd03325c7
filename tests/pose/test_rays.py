"""Distance along the ray in place of depth along the axis: planes tell."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from depthpose.core.errors import Notice
from depthpose.pose.inputs import view_input
from depthpose.pose.rays import measure_ray_bend

K = torch.tensor([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]], dtype=torch.float64)
NORMALS = {"wall": (0.0, 0.0, -1.0), "table": (0.0, -0.7, -0.7), "side": (0.6, 0.1, -0.8)}


def rays(K: Tensor = K) -> Tensor:
    v, u = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], -1).double()
    return pixels @ torch.linalg.inv(K).mT


def plane(normal: tuple[float, float, float], noise_m: float = 0.002) -> Tensor:
    """Depth along the axis of a plane a metre away, with noise."""
    n = torch.tensor(normal, dtype=torch.float64)
    depth_m = -n.norm() / (rays() @ n)
    depth_m = torch.where((depth_m > 0) & (depth_m < 4), depth_m, torch.nan)
    noise = torch.randn(240, 320, generator=torch.Generator().manual_seed(0)).double()
    return depth_m + noise_m * depth_m.square() * noise


def with_ball(depth_m: Tensor) -> Tensor:
    """A ball of 24 cm before it, whose surface is no plane."""
    at = torch.tensor([0.1, 0.05, 0.8], dtype=torch.float64)
    along = rays() @ at
    square = rays().square().sum(-1)
    root = along.square() - square * (at.square().sum() - 0.12**2)
    ball_m = (along - root.clamp(min=0).sqrt()) / square
    return torch.where((root > 0) & ~(depth_m < ball_m), ball_m, depth_m)


@pytest.mark.parametrize("name", NORMALS)
def test_a_plane_is_straight_in_depth_and_bent_in_distance(name: str) -> None:
    depth_m = with_ball(plane(NORMALS[name]))
    distance_m = depth_m * rays().norm(dim=-1)
    assert measure_ray_bend(depth_m, K) == pytest.approx(0, abs=0.05)
    assert measure_ray_bend(distance_m, K) == pytest.approx(1, abs=0.05)


def test_what_is_no_plane_or_too_small_a_one_is_no_answer() -> None:
    ball_m = with_ball(torch.full((240, 320), torch.nan, dtype=torch.float64))
    ball_m = torch.where(ball_m.isnan(), 0.0, ball_m)
    assert measure_ray_bend(ball_m, K) is None
    assert measure_ray_bend(torch.zeros(240, 320), K) is None
    # As a lens of twelve times the focal length sees it.
    far = torch.diag(torch.tensor([12.0, 12.0, 1.0]).double()) @ K
    far[:2, 2] = K[:2, 2]
    distance_m = rays(far).norm(dim=-1)
    assert measure_ray_bend(distance_m, far) is None


def test_a_view_of_distances_is_told_of_once_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("depthpose.pose.rays._warned", set())
    depth_m = plane(NORMALS["table"]).float()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        view_input(depth_m, None, K, "part", "view")
    distance_m = depth_m * rays().norm(dim=-1).float()
    with pytest.warns(Notice, match=r"distance along each pixel's ray.* Divide it by sqrt\(1 \+"):
        view_input(distance_m, None, K, "part", "view")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        view_input(distance_m, None, K, "part", "next")
    other = K + torch.diag(torch.tensor([3.0, 3.0, 0.0]).double())
    with pytest.warns(Notice, match="distance along each pixel's ray"):
        view_input(distance_m, None, other, "part", "of another camera")


def test_real_depth_is_along_the_axis_and_real_distance_is_told_of(real: Path) -> None:
    """Bins of parts among them, in which little is a plane."""
    told: list[bool] = []
    for file in sorted((real / "pose").glob("bins/*/*/depth.png")):
        camera = json.loads(file.with_name("camera.json").read_text())
        lens = torch.tensor(camera["K"], dtype=torch.float64)
        stored = np.array(Image.open(file)).astype(np.float64)
        depth_m = camera["depth_unit_m"] * torch.from_numpy(stored)
        bend = measure_ray_bend(depth_m, lens)
        assert bend is None or abs(bend) < 0.1
        v, u = torch.meshgrid(*map(torch.arange, depth_m.shape), indexing="ij")
        pixels = torch.stack([u, v, torch.ones_like(u)], -1).double()
        stretch = (pixels @ torch.linalg.inv(lens).mT).norm(dim=-1)
        bend = measure_ray_bend(stretch * depth_m, lens)
        assert bend is None or abs(bend - 1) < 0.1
        told.append(bend is not None)
    assert len(told) == 11
    assert sum(told) == 9
