"""Table 3.3: ways to find keypoints from the same directions, their success and time."""

import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.config import VotingConfig
from depthpose.pose.geometry.grid import sample_points, voxelise
from depthpose.pose.metrics import SUCCESS_SHARE, add_m, adds_m
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.networks.resunet import ResUNet
from depthpose.pose.propose import fit_pose, meet_lines, vote_ransac
from depthpose.pose.types import ObjectModel, ViewSample, VotingPoints

_ADD_POINTS = 1000
"""About how many vertices of a model ADD(-S) is measured at."""
_SAMPLING_SEED = 0
"""Seed by which the voting points of a view are chosen."""
LOOP_HYPOTHESES = 50
"""Hypotheses of the loop for each keypoint, as published practice has them."""
OUR_HYPOTHESES = (50, 128, 1024)
"""Hypotheses of our RANSAC: as many as the loop, the default, and more than help."""
_REWEIGHTING_STEPS = 3
"""Steps in which our least squares reweights the votes; the published one has none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class VotingCase:
    """The votes of one cloud for its keypoints, and the true pose of its object."""

    points_m: Float[Tensor, "n 3"]  #: the points that vote, in the camera frame
    directions: Float[Tensor, "n k 3"]  #: from each of them to each keypoint, of length 1
    model: ObjectModel  #: the object
    truth: Rigid  #: its true ``camera_from_model``
    is_adds: bool  #: whether ADD-S decides, not ADD


def collect_votes(
    net: GeoPoseNet, views: Iterable[ViewSample], max_points: int
) -> Iterator[VotingCase | None]:
    """Collect the votes of some points of each view; None where it has too few to be posed.

    The points are chosen at random, the same each time. Each votes from its own position; points of
    one voxel share the network's direction.

    Args:
        net: the network, whose objects have the names in the views.
        views: with truth.
        max_points: most points of a view that vote.

    Raises:
        InputError: the weights are of another kind.
    """
    network = net.weights.network
    if not isinstance(network, ResUNet):
        raise InputError("table 3.3 compares ways of voting: give weights of the sparse network")
    class_of_object = {model.name: k for k, model in enumerate(net.weights.models)}
    for view in views:
        # Some points of the object.
        object_class = class_of_object[view.input.object]
        model = net.weights.models[object_class]
        view_input = view.input
        cloud_m = cloud_from_depth(
            view_input.depth_m, view_input.mask, view_input.K, model.diameter_m
        ).float()
        generator = torch.Generator().manual_seed(_SAMPLING_SEED)
        points_m = sample_points(cloud_m, max_points, generator)
        if len(points_m) < net.weights.cloud.min_points:
            yield None
            continue

        # The network's directions at their voxels.
        grid = voxelise(points_m, net.weights.cloud)
        coordinates = torch.nn.functional.pad(grid.coordinates, (1, 0))  # all of cloud 0
        voxels = VotingPoints(
            points_m=grid.points_m,
            coordinates=coordinates,
            features=grid.features,
            class_of_point=torch.full((len(coordinates),), object_class),
        )
        with torch.inference_mode():
            outputs = network.directions(voxels) @ grid.grid_from_camera
            voxel_directions = torch.nn.functional.normalize(outputs, dim=-1)
        yield VotingCase(
            points_m=points_m,
            directions=voxel_directions[grid.row_of_point],
            model=model,
            truth=view.truth.camera_from_model,
            is_adds=not model.symmetries.is_none,
        )


def compare_voting(cases: Sequence[VotingCase | None], max_points: int) -> list[dict[str, Any]]:
    """Compare methods of voting on the same cases; return the columns of a row for each method.

    The pose follows from the keypoints by the same fit for all, without covariances, which only our
    methods give. The time is the median of the vote alone, on one thread.

    Args:
        cases: those of :func:`collect_votes`; None counts as a failure of every method.
        max_points: most points of a view, for the column ``points``.

    Raises:
        InputError: every case is None.
    """
    usable = [case for case in cases if case is not None]
    if not usable:
        raise InputError(f"none of the {len(cases)} views has enough points to be posed")
    rows: list[dict[str, Any]] = []
    for voting in _list_voting_methods():
        success_count, seconds = _run_votes(usable, voting.vote)
        row = {
            "points": max_points,
            "votes": sum(len(case.points_m) for case in usable) / len(usable),
            "method": voting.name,
            "hypotheses": voting.hypotheses,
            "inliers by": voting.inlier_test,
            "instances": len(cases),
            "success": 100 * success_count / len(cases),
            "milliseconds": 1000 * statistics.median(seconds),
        }
        rows.append(row)
    loop_ms = rows[0]["milliseconds"]
    return [row | {"times faster": loop_ms / row["milliseconds"]} for row in rows]


class _VotingMethod(NamedTuple):
    """A method of voting: its columns of table 3.3, and its function."""

    name: str  #: name in the table
    hypotheses: int | None  #: of RANSAC for each keypoint; None: it is least squares
    inlier_test: str  #: what decides which votes are inliers; empty: nothing does
    vote: Callable[[VotingCase], Tensor]  #: finds the keypoints (k, 3) [m] by the votes


def _list_voting_methods() -> list[_VotingMethod]:
    """List the methods of table 3.3; the loop, which the others are compared with, is the first."""
    methods = [_VotingMethod("RANSAC, one by one (NumPy)", LOOP_HYPOTHESES, "angle", _vote_by_loop)]
    for hypotheses in OUR_HYPOTHESES:
        for inlier_test in ("angle", "distance"):
            config = VotingConfig(hypotheses=hypotheses, inlier_test=inlier_test)
            vote = partial(_vote_by_ransac, config=config)
            methods.append(_VotingMethod("RANSAC, ours", hypotheses, inlier_test, vote))
    for name, steps in (
        ("least squares, published", 0),
        ("least squares, ours", _REWEIGHTING_STEPS),
    ):
        methods.append(_VotingMethod(name, None, "", partial(_vote_by_least_squares, steps=steps)))
    return methods


def _vote_by_loop(case: VotingCase) -> Tensor:
    """Find keypoints by the loop of :func:`ransac_one_by_one`."""
    points_m = case.points_m.double().numpy()
    directions = case.directions.double().numpy()
    return torch.from_numpy(ransac_one_by_one(points_m, directions, LOOP_HYPOTHESES))


def _vote_by_ransac(case: VotingCase, config: VotingConfig) -> Tensor:
    """Find keypoints by our RANSAC."""
    return vote_ransac(case.points_m, case.directions, None, config).keypoints_m


def _vote_by_least_squares(case: VotingCase, steps: int) -> Tensor:
    """Find keypoints by least squares, reweighted in ``steps`` steps."""
    return meet_lines(case.points_m, case.directions, None, steps).keypoints_m


def _run_votes(
    cases: Sequence[VotingCase], vote: Callable[[VotingCase], Tensor]
) -> tuple[int, list[float]]:
    """Vote in every case.

    Returns:
        The number of cases that are posed right, and the processor time [s] of each vote on one
        thread, to which other processes on the machine add nothing.
    """
    success_count = 0
    seconds: list[float] = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        vote(cases[0])  # a first call prepares what later ones reuse
        for case in cases:
            start = time.thread_time()
            keypoints_m = vote(case)
            seconds.append(time.thread_time() - start)
            success_count += _is_right(keypoints_m, case)
    finally:
        torch.set_num_threads(threads)
    return success_count, seconds


def _is_right(keypoints_m: Float[Tensor, "k 3"], case: VotingCase) -> bool:
    """Whether the pose that voted keypoints have is right: ADD(-S) below a tenth of the diameter.

    The pose is fitted with the same weight for all keypoints.
    """
    isotropic = torch.eye(3, dtype=torch.float64).expand(len(keypoints_m), 3, 3)
    fit = fit_pose(keypoints_m.double(), isotropic, case.model.keypoints_m)
    step = max(1, len(case.model.vertices_m) // _ADD_POINTS)
    points_m = case.model.vertices_m[::step]
    measure = adds_m if case.is_adds else add_m
    error_m = float(measure(fit.camera_from_model, case.truth, points_m))
    return error_m / case.model.diameter_m < SUCCESS_SHARE


def ransac_one_by_one(
    points_m: Float64[np.ndarray, "n 3"],
    directions: Float64[np.ndarray, "n k 3"],
    hypotheses: int = LOOP_HYPOTHESES,
    min_cosine: float = 0.99,
    seed: int = 0,
) -> Float64[np.ndarray, "k 3"]:
    """Find every keypoint with a loop over keypoints and hypotheses.

    A hypothesis is the point nearest to the lines of two random votes; its inliers are the votes
    whose direction has a cosine of more than ``min_cosine`` with that to the hypothesis. The
    hypothesis of most inliers is refitted to them. Published practice is 50 hypotheses for each
    keypoint.

    Args:
        points_m: the points that vote.
        directions: unit vectors from each point to each keypoint.
        hypotheses: number of hypotheses for each keypoint.
        min_cosine: least cosine of an inlier.
        seed: seed of the random pairs of votes.

    Returns:
        The keypoints [m].
    """
    random = np.random.default_rng(seed)
    keypoints_m: list[np.ndarray] = []
    for k in range(directions.shape[1]):
        n = directions[:, k]
        is_inlier = _find_most_inliers(points_m, n, hypotheses, min_cosine, random)
        try:
            A, b = _build_normal_equations(points_m[is_inlier], n[is_inlier])
            keypoint_m = np.linalg.solve(A, b)
        except np.linalg.LinAlgError:  # no inlier but parallel ones, or none: all votes count
            A, b = _build_normal_equations(points_m, n)
            keypoint_m = np.linalg.lstsq(A, b, rcond=None)[0]
        keypoints_m.append(keypoint_m)
    return np.stack(keypoints_m)


def _find_most_inliers(
    points_m: np.ndarray,
    n: np.ndarray,
    hypotheses: int,
    min_cosine: float,
    random: np.random.Generator,
) -> np.ndarray:
    """Find the hypothesis of one keypoint that has the most inliers.

    Args:
        points_m: the points that vote, (n, 3).
        n: unit direction from each to the keypoint, (n, 3).
        hypotheses: how many are tried, each of two random votes.
        min_cosine: least cosine of an inlier.
        random: draws the votes.

    Returns:
        Whether each vote is an inlier of it, (n,).
    """
    most_inliers = -1
    best_is_inlier = np.ones(len(n), bool)
    for _ in range(hypotheses):
        pair = random.choice(len(points_m), 2, replace=False)
        A, b = _build_normal_equations(points_m[pair], n[pair])
        try:
            hypothesis_m = np.linalg.solve(A, b)
        except np.linalg.LinAlgError:  # the two lines are parallel
            continue
        offsets_m = hypothesis_m - points_m
        distances_m = np.sqrt((offsets_m * offsets_m).sum(1)).clip(1e-300)  # never divide by 0
        cosines = (offsets_m * n).sum(1) / distances_m
        is_inlier = cosines > min_cosine
        count = np.count_nonzero(is_inlier)
        if count > most_inliers:
            most_inliers = count
            best_is_inlier = is_inlier
    return best_is_inlier


def _build_normal_equations(points_m: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Build A and b of the normal equations ``A x = b`` of the point x nearest to lines.

    The lines go through the points p along the unit directions n. The squared distance of x from
    one is ``|(I - n n^T) (x - p)|^2``, so ``A = sum(I - n n^T)`` and ``b = sum((I - n n^T) p)``. A
    is singular if all lines are parallel.
    """
    A = len(points_m) * np.eye(3) - n.T @ n
    b = points_m.sum(0) - n.T @ (n * points_m).sum(1)
    return A, b
