import math
from pathlib import Path

import pytest
import torch
from tests.pose.synthetic_objects import generator, random_pose
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, cross_matrix, perturb
from depthpose.pose.config import CloudConfig
from depthpose.pose.datasets import open_bop
from depthpose.pose.geometry.grid import voxelise
from depthpose.pose.geometry.surface import prepare_surface
from depthpose.pose.icp import refine_exactly
from depthpose.pose.metrics import add_m
from depthpose.pose.propose import (
    find_consistent_keypoints,
    fit_pose,
    vote_ransac,
)
from depthpose.pose.types import Axis
from depthpose.pose.verify.observability import free_motions
from depthpose.report.pose import select_object_points


def misfit(pose: Rigid, model: Tensor, found: Tensor, covariance: Tensor) -> Tensor:
    """Squared distances in units of their covariance, over the degrees of freedom."""
    error = (pose.apply(model) - found)[..., None]
    square = (error.mT @ torch.linalg.inv(covariance) @ error).sum((-1, -2, -3))
    return square / (3 * len(model) - 6)


def test_covariances_of_poses_are_honest() -> None:
    runs = 2000
    model = torch.randn(8, 3, generator=generator(0)).double() * 0.06
    pose = random_pose(11)
    shape = torch.randn(8, 3, 3, generator=generator(12)).double()
    covariance = (shape @ shape.mT + 0.2 * torch.eye(3)) * 0.002**2
    root = torch.linalg.cholesky(covariance)
    noise = torch.randn(runs, 8, 3, 1, generator=generator(13), dtype=torch.float64)
    found = pose.apply(model) + (root @ noise).squeeze(-1)
    fit = fit_pose(found, covariance.expand(runs, 8, 3, 3), model)
    # true = exp(rotation) found: the motion that is missing.
    turn = pose.R @ fit.camera_from_model.R.mT
    rotation = torch.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0],
                            turn[:, 1, 0] - turn[:, 0, 1]], -1) / 2  # fmt: skip
    shift = pose.t_m - (turn @ fit.camera_from_model.t_m[..., None]).squeeze(-1)
    error = torch.cat([rotation, shift], -1)[..., None]
    square = (error.mT @ torch.linalg.inv(fit.covariance) @ error).flatten()
    assert float(square.mean()) == pytest.approx(6, rel=0.06)
    # 95 % of chi-square(6) lies below 12.59.
    assert float((square < 12.592).double().mean()) == pytest.approx(0.95, abs=0.02)
    misfits = misfit(fit.camera_from_model, model, found, covariance)
    assert float(misfits.mean()) == pytest.approx(1, abs=0.03)


def test_kabsch_never_reflects() -> None:
    model = torch.randn(8, 3, generator=generator(1)).double()
    mirrored = model * torch.tensor([1, 1, -1])
    flat = model * torch.tensor([1, 1, 0])
    found = torch.stack([mirrored, random_pose(3).apply(flat), mirrored.flip(0)])
    for known in (model, flat):
        fit = fit_pose(found, torch.eye(3).double().expand(3, 8, 3, 3), known)
        R = fit.camera_from_model.R
        assert torch.allclose(torch.linalg.det(R), torch.ones(3).double())
        assert torch.allclose(R @ R.mT, torch.eye(3).double().expand(3, 3, 3))


def test_the_pose_follows_the_model_frame() -> None:
    model = torch.randn(8, 3, generator=generator(2)).double() * 0.05
    found = random_pose(4).apply(model) + 0.002 * torch.randn(8, 3, generator=generator(5))
    covariance = torch.eye(3).double().expand(8, 3, 3) * 1e-6
    other = random_pose(6)
    first = fit_pose(found, covariance, model).camera_from_model
    second = fit_pose(found, covariance, other.apply(model)).camera_from_model @ other
    assert torch.allclose(first.R, second.R)
    assert torch.allclose(first.t_m, second.t_m)


def test_a_sure_keypoint_outweighs_unsure_ones() -> None:
    model = torch.randn(8, 3, generator=generator(3)).double() * 0.05
    found = model.clone()
    found[0] += 0.05
    covariance = torch.eye(3).double().expand(8, 3, 3) * 1e-6
    covariance = covariance.clone()
    covariance[0] *= 1e6
    fit = fit_pose(found, covariance, model)
    assert float((fit.camera_from_model.R - torch.eye(3)).abs().max()) < 1e-4
    kept = torch.arange(8) > 0
    without = fit_pose(found, torch.eye(3).double().expand(8, 3, 3), model, kept)
    assert float(without.residual_m) < 1e-9


@pytest.mark.parametrize("seed", [0, 2, 7])
def test_unused_keypoints_change_no_weight_of_the_others(seed: int) -> None:
    random = generator(seed)
    model = torch.randn(8, 3, generator=random).double() * 0.05
    true = random_pose(seed)
    std_m = torch.tensor([1e-4, 1e-4, 1e-4, 0.25, 0.05, 0.05, 0.05, 0.05]).double()
    found = true.apply(model) + std_m[:, None] * torch.randn(8, 3, generator=random).double()
    covariance = std_m.square()[:, None, None] * torch.eye(3).double()
    used = torch.arange(8) < 4
    fit = fit_pose(found, covariance, model, used).camera_from_model
    alone = fit_pose(found[used], covariance[used], model[used]).camera_from_model
    assert torch.allclose(fit.R, alone.R, atol=1e-9)
    assert torch.allclose(fit.t_m, alone.t_m, atol=1e-9)


def test_two_keypoints_fix_no_pose() -> None:
    with pytest.raises(InputError, match="fixed by 3"):
        fit_pose(torch.rand(8, 3).double(), torch.eye(3).double().expand(8, 3, 3),
                 torch.rand(8, 3).double(), torch.arange(8) < 2)  # fmt: skip


def test_keypoints_that_break_rigidity_are_dropped() -> None:
    model = torch.randn(8, 3, generator=generator(4)).double() * 0.1
    found = random_pose(7, (3,)).apply(model.expand(3, 8, 3))
    assert find_consistent_keypoints(found, model, 1e-12).all()
    found[1, 2] += 0.1
    found[2, [0, 5]] -= torch.tensor([0.1, 0.05, -0.2]).double()
    stays = find_consistent_keypoints(found, model, 0.01)
    assert stays[0].all()
    assert (~stays[1]).nonzero().flatten().tolist() == [2]
    assert (~stays[2]).nonzero().flatten().tolist() == [0, 5]
    some = find_consistent_keypoints(found, model, 0.01, torch.arange(8).expand(3, 8) > 3)
    assert some[1].tolist() == [False] * 4 + [True] * 4


def test_a_perturbation_is_a_motion_of_the_camera_frame() -> None:
    pose = random_pose(8)
    motion = torch.tensor([0, 0, math.pi / 2, 1, 2, 3]).double()
    moved = perturb(pose, motion)
    turn = torch.tensor([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]).double()
    assert torch.allclose(moved.R, turn @ pose.R)
    assert torch.allclose(moved.t_m, turn @ pose.t_m + motion[3:])
    v, w = torch.rand(2, 3).unbind()
    assert torch.allclose(cross_matrix(v) @ w, torch.linalg.cross(v, w))


def test_free_motions_leave_points_of_the_axis_where_they_are() -> None:
    pose = random_pose(9)
    axis = Axis(direction=torch.tensor([0, 1.0, 0]), point_m=torch.tensor([0.1, 0, 0]))
    (motion,) = free_motions((axis,), pose)
    assert float(motion.norm()) == pytest.approx(1)
    on_axis = pose.apply(torch.tensor([[0.1, 0.3, 0]]).double())[0]
    speed = torch.linalg.cross(motion[:3], on_axis) + motion[3:]
    assert float(speed.norm()) < 1e-9
    assert free_motions((), pose).shape == (0, 6)


def test_two_axes_free_every_turn_about_their_meeting() -> None:
    pose, centre = random_pose(9), torch.tensor([0.1, 0.2, 0.3]).double()
    up = torch.tensor([0, 0, 1.0]).double()
    slant = torch.tensor([0.6, 0, 0.8]).double()
    # Each is given by a point of its own.
    axes = tuple(Axis(direction=d, point_m=centre + s * d) for d, s in ((up, 0.5), (slant, -0.2)))
    motions = free_motions(axes, pose)
    assert motions.shape == (3, 6)
    assert int(torch.linalg.matrix_rank(motions)) == 3
    at = pose.apply(centre[None])[0]
    speed = torch.linalg.cross(motions[:, :3], at.expand(3, 3)) + motions[:, 3:]
    assert float(speed.norm()) < 1e-6
    # The same axis twice is one axis.
    assert free_motions((axes[0], axes[0]), pose).shape == (1, 6)


def test_the_whole_way_on_the_real_cat(real: Path) -> None:
    """Depth, voxels, votes of a network that errs by 3 degrees and is wrong a tenth of the time."""
    data = open_bop(real / "pose/lm")
    view, model = data[0], data.objects[data.instances[0].object_id]
    true, points_m = (
        view.truth.camera_from_model,
        select_object_points(view.input, model.diameter_m),
    )
    points = points_m[voxelise(points_m, CloudConfig(voxel_m=0.004)).kept].double()
    keypoints = true.apply(model.keypoints_m.double())
    directions = torch.nn.functional.normalize(keypoints - points[:, None], dim=-1)
    noise = torch.randn(directions.shape, generator=generator(0), dtype=torch.float64)
    noise[::10] *= 20
    vote = vote_ransac(points, directions + 0.05 * noise)
    used = find_consistent_keypoints(vote.keypoints_m, model.keypoints_m, 0.1 * model.diameter_m)
    assert used.all()
    fit = fit_pose(vote.keypoints_m, vote.covariance_m2, model.keypoints_m.double(), used)
    keypoints_m = model.keypoints_m.double()
    found = (fit.camera_from_model, keypoints_m, vote.keypoints_m, vote.covariance_m2)
    assert float(misfit(*found)) < 3
    error_m = add_m(fit.camera_from_model, true, model.vertices_m[::7])
    assert float(error_m) < 0.02 * model.diameter_m
    refined = refine_exactly(points, fit.camera_from_model, prepare_surface(model))
    error_m = add_m(refined.camera_from_model, true, model.vertices_m[::7])
    assert float(error_m) < 0.025 * model.diameter_m
