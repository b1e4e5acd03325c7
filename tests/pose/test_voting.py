import math

import pytest
import torch
from torch import Tensor

from depthpose.core.config import config_from_dict
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.config import VotingConfig
from depthpose.pose.types import Axis
from depthpose.pose.voting import (
    consistent_keypoints,
    cross_matrix,
    distance_errors,
    fit_pose,
    free_motions,
    meet_lines,
    perturb,
    vote_ransac,
)

METHODS = {
    "nearest": lambda *votes: meet_lines(*votes, refinements=0),
    "least squares": meet_lines,
    "ransac": vote_ransac,
    "ransac by distance": lambda *votes: vote_ransac(
        *votes, config=VotingConfig(inlier_test="distance")
    ),
}


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_pose(seed: int, batch: tuple[int, ...] = ()) -> Rigid:
    q, _ = torch.linalg.qr(torch.randn(*batch, 3, 3, generator=generator(seed)).double())
    shift = torch.tensor([0.1, -0.1, 0.9]).double().expand(*batch, 3)
    return Rigid(q * torch.linalg.det(q)[..., None, None], shift)


def made_votes(
    seed: int = 0, n: int = 300, batch: tuple[int, ...] = ()
) -> tuple[Tensor, Tensor, Tensor]:
    """Points on half of a ball, keypoints about it, and the exact directions between them."""
    points = torch.randn(*batch, n, 3, generator=generator(seed)).double()
    points = points / points.norm(dim=-1, keepdim=True) * 0.05
    points = points * torch.tensor([1, 1, 0.5]) + torch.tensor([0.1, 0.0, 0.8])
    keypoints = torch.randn(*batch, 8, 3, generator=generator(seed + 99)).double() * 0.06
    keypoints = keypoints + torch.tensor([0.1, 0.0, 0.83])
    directions = keypoints[..., None, :, :] - points[..., :, None, :]
    return points, directions / directions.norm(dim=-1, keepdim=True), keypoints


def with_noise(directions: Tensor, sigma: float, seed: int = 5) -> Tensor:
    noise = torch.randn(directions.shape, generator=generator(seed), dtype=torch.float64)
    noisy = directions + sigma * noise
    return noisy / noisy.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("method", METHODS)
def test_perfect_directions_give_perfect_keypoints_and_pose(method: str) -> None:
    points, directions, keypoints = made_votes(batch=(2,))
    vote = METHODS[method](points, directions)
    assert float((vote.keypoints_m - keypoints).abs().max()) < 1e-9
    assert vote.inlier_share.min() == 1
    assert float(vote.covariance_m2.abs().max()) < 1e-12
    pose = random_pose(1, (2,))
    model = torch.randn(8, 3, generator=generator(3)).double() * 0.06
    found = pose.apply(model.expand(2, 8, 3))
    fit = fit_pose(found, torch.eye(3).double().expand(2, 8, 3, 3) * 1e-6, model)
    assert float(geodesic_rad(fit.camera_from_model.R, pose.R).max()) < 1e-9
    assert float((fit.camera_from_model.t_m - pose.t_m).abs().max()) < 1e-9
    assert float(fit.residual_m.max()) < 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_keypoints_move_with_the_cloud(method: str) -> None:
    points, directions, _ = made_votes(1)
    directions = with_noise(directions, 0.03)
    motion = random_pose(2)
    here = METHODS[method](points, directions)
    there = METHODS[method](motion.apply(points), directions @ motion.R.mT)
    # By distance hardly any vote is an inlier of 0.5 mm, and rounding may change which.
    tolerance = 1e-6 if method != "ransac by distance" else 1e-3
    assert torch.allclose(motion.apply(here.keypoints_m), there.keypoints_m, atol=tolerance)
    turned = motion.R @ here.covariance_m2 @ motion.R.mT
    assert torch.allclose(turned, there.covariance_m2, atol=tolerance**2, rtol=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_batches_and_weights_change_no_single_answer(method: str) -> None:
    points, directions, _ = made_votes(3, batch=(3,))
    # Half a millimetre of tolerance leaves no inliers of noisier votes.
    directions = with_noise(directions, 0.002 if method == "ransac by distance" else 0.02)
    weight = torch.ones(3, 300, 8).double()
    weight[1:, 200:] = 0
    together = METHODS[method](points, directions, weight)
    alone = METHODS[method](points[1:, :200], directions[1:, :200])
    # RANSAC draws its pairs by place in the batch: its answers agree as well as its noise.
    tolerance = 2e-3 if "ransac" in method else 1e-9
    assert torch.allclose(together.keypoints_m[1:], alone.keypoints_m, atol=tolerance)


def test_the_nearest_point_is_that_of_the_normal_equations() -> None:
    points, directions, _ = made_votes(4, n=40)
    directions = with_noise(directions, 0.2)
    weight = torch.rand(40, 8, generator=generator(0)).double()
    found = meet_lines(points, 3 * directions, weight, refinements=0)
    for k in range(8):
        A, b = torch.zeros(3, 3).double(), torch.zeros(3).double()
        for x, n, w in zip(points, directions[:, k], weight[:, k], strict=True):
            P = torch.eye(3).double() - torch.outer(n, n)
            A, b = A + w * P, b + w * P @ x
        assert torch.allclose(found.keypoints_m[k], torch.linalg.solve(A, b))
        values = torch.linalg.eigvalsh(A)
        assert float(found.condition[k]) == pytest.approx(float(values[2] / values[0]))


def test_refinement_takes_the_bias_of_noisy_directions_away() -> None:
    """Nearest points are drawn toward the cloud; the most likely ones are not."""
    points, directions, keypoints = made_votes(5, n=2000)
    noisy = with_noise(directions, 0.1)
    nearest = meet_lines(points, noisy, refinements=0).keypoints_m
    likely = meet_lines(points, noisy).keypoints_m
    error, better = ((k - keypoints).norm(dim=-1).mean() for k in (nearest, likely))
    assert error > 0.005
    assert better < error / 5


def test_ransac_overrules_a_third_of_wrong_votes() -> None:
    points, directions, keypoints = made_votes(6)
    directions = with_noise(directions, 0.01)
    wrong = with_noise(torch.zeros_like(directions), 1.0, seed=7)
    directions[::3] = wrong[::3]
    ransac, squares = vote_ransac(points, directions), meet_lines(points, directions)
    assert float((ransac.keypoints_m - keypoints).norm(dim=-1).max()) < 0.003
    assert float((squares.keypoints_m - keypoints).norm(dim=-1).max()) > 0.003
    assert ransac.inlier_share.tolist() == pytest.approx([2 / 3] * 8, abs=0.02)


def test_a_vote_that_points_away_is_no_inlier_by_angle_but_by_distance() -> None:
    points, directions, keypoints = made_votes(7)
    directions[::4] *= -1
    by_angle = vote_ransac(points, directions)
    assert by_angle.inlier_share.tolist() == pytest.approx([0.75] * 8)
    assert torch.allclose(by_angle.keypoints_m, keypoints)
    by_distance = vote_ransac(points, directions, config=VotingConfig(inlier_test="distance"))
    assert by_distance.inlier_share.tolist() == [1] * 8


def test_the_same_seed_gives_the_same_answer() -> None:
    points, directions, _ = made_votes(8)
    directions = with_noise(directions, 0.2)
    first, again = (vote_ransac(points, directions) for _ in range(2))
    other = vote_ransac(points, directions, config=VotingConfig(seed=1))
    assert torch.equal(first.keypoints_m, again.keypoints_m)
    assert not torch.equal(first.keypoints_m, other.keypoints_m)


@pytest.mark.parametrize("method", ["nearest", "least squares", "ransac"])
def test_covariances_of_keypoints_are_honest(method: str) -> None:
    """The squared error over its covariance follows chi-square with 3 degrees of freedom."""
    runs = 300
    points, directions, keypoints = made_votes(9, n=150)
    noisy = with_noise(directions.expand(runs, -1, -1, -1), 0.02, seed=10)
    vote = METHODS[method](points.expand(runs, -1, -1), noisy)
    mean = vote.keypoints_m.mean(0) if method == "nearest" else keypoints  # the bias is known
    error = (vote.keypoints_m - mean)[..., None]
    square = (error.mT @ torch.linalg.inv(vote.covariance_m2) @ error).flatten()
    assert float(square.mean()) == pytest.approx(3, rel=0.15)
    # 95 % of chi-square(3) lies below 7.815.
    assert float((square < 7.815).double().mean()) == pytest.approx(0.95, abs=0.025)


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
    assert float(fit.misfit.mean()) == pytest.approx(1, abs=0.03)


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
    assert without.is_used.tolist() == kept.tolist()


def test_two_keypoints_fix_no_pose() -> None:
    with pytest.raises(InputError, match="fixed by 3"):
        fit_pose(torch.rand(8, 3).double(), torch.eye(3).double().expand(8, 3, 3),
                 torch.rand(8, 3).double(), torch.arange(8) < 2)  # fmt: skip


def test_keypoints_that_break_rigidity_are_outvoted() -> None:
    model = torch.randn(8, 3, generator=generator(4)).double() * 0.1
    found = random_pose(7, (3,)).apply(model.expand(3, 8, 3))
    errors = distance_errors(found, model)
    assert errors.shape == (3, 8, 8)
    assert float(errors.abs().max()) < 1e-12
    found[1, 2] += 0.1
    found[2, [0, 5]] -= torch.tensor([0.1, 0.05, -0.2]).double()
    stays = consistent_keypoints(found, model, 0.01)
    assert stays[0].all()
    assert (~stays[1]).nonzero().flatten().tolist() == [2]
    assert (~stays[2]).nonzero().flatten().tolist() == [0, 5]
    some = consistent_keypoints(found, model, 0.01, torch.arange(8).expand(3, 8) > 3)
    assert some[1].tolist() == [False] * 4 + [True] * 4


def test_parallel_votes_are_told_by_their_condition() -> None:
    points = torch.rand(50, 3, generator=generator(5)).double()
    directions = torch.tensor([0, 0, 1.0]).double().expand(50, 2, 3)
    vote = meet_lines(points, directions)
    assert vote.condition.tolist() == [math.inf] * 2
    assert bool(vote.keypoints_m.isfinite().all())
    assert bool(vote_ransac(points, directions).keypoints_m.isfinite().all())


def test_a_point_on_its_keypoint_does_no_harm() -> None:
    points, directions, keypoints = made_votes(10)
    points[0] = keypoints[0]
    directions = torch.nn.functional.normalize(keypoints - points[:, None], dim=-1)
    assert float(directions[0, 0].norm()) == 0
    for method in METHODS.values():
        assert float((method(points, directions).keypoints_m - keypoints).abs().max()) < 1e-8


def test_float32_is_enough() -> None:
    points, directions, keypoints = made_votes(11)
    for method in METHODS.values():
        vote = method(points.float(), directions.float())
        assert vote.keypoints_m.dtype == torch.float32
        assert float((vote.keypoints_m - keypoints).abs().max()) < 1e-5


def test_too_few_votes_are_refused() -> None:
    points, directions, _ = made_votes(12, n=5)
    weight = torch.zeros(5, 8).double()
    weight[0] = 1
    for method in METHODS.values():
        with pytest.raises(InputError, match=r"1 directions of some keypoint .* two lines"):
            method(points, directions, weight)
        with pytest.raises(InputError, match="0 directions"):
            method(points, 0 * directions)


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


@pytest.mark.parametrize(
    ("knob", "value", "said"),
    [
        ("hypotheses", 0, "take 128"),
        ("min_cosine", 1.5, "0.99 means 8 degrees"),
        ("max_distance_m", 5.0, "half a millimetre"),
        ("refinements", -1, "take 0 or more"),
        ("max_condition", 1.0, "take 1000"),
        ("rigidity_diameters", 0.0, "take 0.1"),
    ],
)
def test_knobs_out_of_range_are_refused(knob: str, value: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        config_from_dict({knob: value}, VotingConfig, source="test")
