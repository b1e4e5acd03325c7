import math

import pytest
import torch
from tests.pose.synthetic_objects import generator, random_pose
from torch import Tensor

from depthpose.core.config import config_from_dict
from depthpose.core.errors import InputError
from depthpose.core.rigid import geodesic_rad
from depthpose.pose.config import VotingConfig
from depthpose.pose.propose import fit_pose, meet_lines, vote_ransac

METHODS = {
    "nearest": lambda *votes: meet_lines(*votes, refinements=0),
    "least squares": meet_lines,
    "ransac": vote_ransac,
    "ransac by distance": lambda *votes: vote_ransac(
        *votes, config=VotingConfig(inlier_test="distance")
    ),
}


def exact_votes(
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
    points, directions, keypoints = exact_votes(batch=(2,))
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
    points, directions, _ = exact_votes(1)
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
    points, directions, _ = exact_votes(3, batch=(3,))
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
    points, directions, _ = exact_votes(4, n=40)
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
    points, directions, keypoints = exact_votes(5, n=2000)
    noisy = with_noise(directions, 0.1)
    nearest = meet_lines(points, noisy, refinements=0).keypoints_m
    likely = meet_lines(points, noisy).keypoints_m
    error, better = ((k - keypoints).norm(dim=-1).mean() for k in (nearest, likely))
    assert error > 0.005
    assert better < error / 5


def test_ransac_overrules_a_third_of_wrong_votes() -> None:
    points, directions, keypoints = exact_votes(6)
    directions = with_noise(directions, 0.01)
    wrong = with_noise(torch.zeros_like(directions), 1.0, seed=7)
    directions[::3] = wrong[::3]
    ransac, squares = vote_ransac(points, directions), meet_lines(points, directions)
    assert float((ransac.keypoints_m - keypoints).norm(dim=-1).max()) < 0.003
    assert float((squares.keypoints_m - keypoints).norm(dim=-1).max()) > 0.003
    assert ransac.inlier_share.tolist() == pytest.approx([2 / 3] * 8, abs=0.02)


def test_a_vote_that_points_away_is_no_inlier_by_angle_but_by_distance() -> None:
    points, directions, keypoints = exact_votes(7)
    directions[::4] *= -1
    by_angle = vote_ransac(points, directions)
    assert by_angle.inlier_share.tolist() == pytest.approx([0.75] * 8)
    assert torch.allclose(by_angle.keypoints_m, keypoints)
    by_distance = vote_ransac(points, directions, config=VotingConfig(inlier_test="distance"))
    assert by_distance.inlier_share.tolist() == [1] * 8


def test_the_same_seed_gives_the_same_answer() -> None:
    points, directions, _ = exact_votes(8)
    directions = with_noise(directions, 0.2)
    first, again = (vote_ransac(points, directions) for _ in range(2))
    other = vote_ransac(points, directions, config=VotingConfig(seed=1))
    assert torch.equal(first.keypoints_m, again.keypoints_m)
    assert not torch.equal(first.keypoints_m, other.keypoints_m)


@pytest.mark.parametrize("method", ["nearest", "least squares", "ransac"])
def test_covariances_of_keypoints_are_honest(method: str) -> None:
    """The squared error over its covariance follows chi-square with 3 degrees of freedom."""
    runs = 300
    points, directions, keypoints = exact_votes(9, n=150)
    noisy = with_noise(directions.expand(runs, -1, -1, -1), 0.02, seed=10)
    vote = METHODS[method](points.expand(runs, -1, -1), noisy)
    mean = vote.keypoints_m.mean(0) if method == "nearest" else keypoints  # the bias is known
    error = (vote.keypoints_m - mean)[..., None]
    square = (error.mT @ torch.linalg.inv(vote.covariance_m2) @ error).flatten()
    assert float(square.mean()) == pytest.approx(3, rel=0.15)
    # 95 % of chi-square(3) lies below 7.815.
    assert float((square < 7.815).double().mean()) == pytest.approx(0.95, abs=0.025)


@pytest.mark.parametrize("method", ["nearest", "least squares"])
def test_few_lines_look_no_surer_than_they_are(method: str) -> None:
    """n lines of rank 2 leave 2 n - 3 residuals free: their mean square is divided by as many."""
    points, directions, _ = exact_votes(9, n=4)
    noisy = with_noise(directions, 0.02, seed=10)
    once = METHODS[method](points, noisy)
    twice = METHODS[method](points.repeat(2, 1), noisy.repeat(2, 1, 1))
    assert torch.allclose(once.keypoints_m, twice.keypoints_m)
    # Of eight independent lines with these residuals half the covariance is left.
    expected = once.covariance_m2 / 2 * (16 / (16 - 3)) / (8 / (8 - 3))
    assert torch.allclose(twice.covariance_m2, expected, rtol=1e-6)


def test_parallel_votes_are_detected_by_their_condition() -> None:
    points = torch.rand(50, 3, generator=generator(5)).double()
    directions = torch.tensor([0, 0, 1.0]).double().expand(50, 2, 3)
    vote = meet_lines(points, directions)
    assert vote.condition.tolist() == [math.inf] * 2
    assert bool(vote.keypoints_m.isfinite().all())
    assert bool(vote_ransac(points, directions).keypoints_m.isfinite().all())


def test_a_point_on_its_keypoint_does_no_harm() -> None:
    points, directions, keypoints = exact_votes(10)
    points[0] = keypoints[0]
    directions = torch.nn.functional.normalize(keypoints - points[:, None], dim=-1)
    assert float(directions[0, 0].norm()) == 0
    for method in METHODS.values():
        assert float((method(points, directions).keypoints_m - keypoints).abs().max()) < 1e-8


def test_float32_is_enough() -> None:
    points, directions, keypoints = exact_votes(11)
    for method in METHODS.values():
        vote = method(points.float(), directions.float())
        assert vote.keypoints_m.dtype == torch.float32
        assert float((vote.keypoints_m - keypoints).abs().max()) < 1e-5


def test_too_few_votes_are_refused() -> None:
    points, directions, _ = exact_votes(12, n=5)
    weight = torch.zeros(5, 8).double()
    weight[0] = 1
    for method in METHODS.values():
        with pytest.raises(InputError, match=r"1 directions of some keypoint .* two lines"):
            method(points, directions, weight)
        with pytest.raises(InputError, match="0 directions"):
            method(points, 0 * directions)


@pytest.mark.parametrize(
    ("setting", "value", "said"),
    [
        ("hypotheses", 0, "hypotheses must be in .*default is 128"),
        ("min_cosine", 1.5, r"min_cosine must be in \(0, 1\)"),
        ("max_distance_m", 5.0, "max_distance_m must be in"),
        ("refinements", -1, "refinements must be in"),
        ("max_condition", 1.0, "max_condition must be in"),
        ("rigidity_diameters", 0.0, "rigidity_diameters must be in"),
    ],
)
def test_settings_out_of_range_are_refused(setting: str, value: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        config_from_dict({setting: value}, VotingConfig, source="test")
