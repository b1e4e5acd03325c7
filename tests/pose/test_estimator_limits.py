"""Estimates at the limits: clouds of millions of points, and covariances that must be honest."""

import math
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from tests.pose.synthetic_objects import (
    CAMERA,
    Oracle,
    bracket,
    cloud_of,
    pose_at,
    tiny_weights,
)
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from depthpose.core.rigid import Rigid
from depthpose.pose.config import CloudConfig, EstimateConfig, RefusalConfig, VotingConfig
from depthpose.pose.mesh import make_model
from depthpose.pose.network_pose import CloudJob
from depthpose.pose.registration import Registration
from depthpose.pose.types import PoseEstimate

MILLIONS = 4_000_000


class _Largest(TorchDispatchMode):
    """Remembers the size of the largest tensor that any operation gives."""

    bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # noqa: ANN401
        found = func(*args, **(kwargs or {}))
        for part in found if isinstance(found, tuple | list) else (found,):
            if isinstance(part, Tensor):
                self.bytes = max(self.bytes, part.numel() * part.element_size())
        return found


def test_millions_of_points_are_answered_in_the_memory_of_few() -> None:
    part, truth = bracket(), pose_at()
    seen = cloud_of(part, truth).float()
    cloud = seen.repeat(MILLIONS // len(seen) + 1, 1)[:MILLIONS]
    net = Oracle(tiny_weights(part), [truth])
    # Nothing grows beyond the cloud itself in 64 bits: no pairs, no grid, no tree of all points.
    assert net.config == EstimateConfig(refusal=RefusalConfig())
    with _Largest() as largest:
        found = net.estimate(cloud=cloud)
    assert found.status == "ok", found.reason
    assert found.camera_from_model is not None
    assert float((found.camera_from_model.t_m - truth.t_m).norm()) < 0.002
    assert largest.bytes <= 8 * cloud.numel()


class _Noisy(Oracle):
    """True directions, each turned by noise of its own, other noise each time."""

    generator = torch.Generator().manual_seed(0)

    def _run_network(self, group: Sequence[CloudJob | PoseEstimate]) -> None:
        super()._run_network(group)
        for one in group:
            assert isinstance(one, CloudJob)
            noise = torch.randn(one.directions.shape, generator=self.generator)
            one.directions = one.directions + 0.03 * noise


def _misfit(found: PoseEstimate, truth: Rigid) -> float:
    """Squared error of a pose in units of its own covariance: 6 on average."""
    assert found.camera_from_model is not None
    assert found.covariance is not None
    R = truth.R.double() @ found.camera_from_model.R.double().T
    sine = torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    turn = sine * (1 + float(sine.norm()) ** 2 / 6)
    shift_m = truth.t_m.double() - R @ found.camera_from_model.t_m.double()
    error = torch.cat([turn, shift_m])
    return float(error @ torch.linalg.solve(found.covariance.double(), error))


def test_the_covariance_of_an_estimate_says_how_far_it_is_off() -> None:
    """Squared errors in units of the covariance are chi-square of 6 degrees of freedom."""
    part, trials = bracket(), 40
    config = EstimateConfig(with_icp=False, voting=VotingConfig(method="least squares"))
    weights = tiny_weights(part, cloud=CloudConfig(max_points=200))
    net, misfits = _Noisy(weights, [], config=config), []
    for seed in range(trials):
        truth = pose_at(seed=seed)
        net.truths = [truth]
        misfits.append(_misfit(net.estimate(cloud=cloud_of(part, truth)), truth))
    mean = sum(misfits) / trials
    spread = math.sqrt(2 * 6 / trials)
    assert abs(mean - 6) < 4 * spread
    # 16.8 is passed by one of a hundred.
    assert sum(misfit > 16.8 for misfit in misfits) <= 5


def _plane() -> Tensor:
    return (0.7 + 0.0005 * torch.arange(240.0))[:, None].repeat(1, 320)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("depth_m", "times"),
    [
        (torch.full((240, 320), torch.nan), 1.0),
        (_plane(), 1.0),
        (_plane() + 0.05 * (torch.arange(320) > 200), 10.0),
    ],
    ids=["every reading missing", "one plane", "a model larger than the view"],
)
def test_an_image_that_shows_nothing_of_use_is_refused_with_a_reason(
    depth_m: Tensor, times: float
) -> None:
    part = bracket()
    net = Registration([make_model(times * part.vertices_m, part.faces, name="part")])
    with _Largest() as largest:
        found = net.estimate(depth=depth_m, mask=torch.ones(240, 320), camera=CAMERA)
        assert not found.is_posed
        assert found.reason
        assert not any(estimate.is_posed for estimate in net.find(depth_m, CAMERA))
    assert largest.bytes < 100e6
