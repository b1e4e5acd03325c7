"""Table 3.3: ways to find keypoints from the same directions: success and time."""

import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.baselines.one_by_one import ransac_one_by_one
from depthpose.pose.cloud import cloud_from_depth, refusal_of, sample_points, voxelise
from depthpose.pose.config import CloudConfig, VotingConfig
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.metrics import add_share, is_within_diameter
from depthpose.pose.network import ResUNet
from depthpose.pose.sparse import Voxels
from depthpose.pose.types import ObjectModel, ViewSample, Vote
from depthpose.pose.voting import fit_pose, meet_lines, vote_ransac

_ADD_POINTS = 1000
LOOP_HYPOTHESES = 50
"""Of the loop: published practice."""
OUR_HYPOTHESES = (50, 128, 1024)
_LOOP = "RANSAC, one by one (NumPy)"

Points = Float[Tensor, "n 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class VotingCase:
    """One cloud with the network's directions, and what they should give.

    Attributes:
        points_m: where the votes start.
        directions: of unit length.
        model: the object.
        truth: its pose.
        is_adds: whether ADD-S decides.
    """

    points_m: Points
    directions: Float[Tensor, "n k 3"]
    model: ObjectModel
    truth: Rigid
    is_adds: bool


@dataclass(frozen=True, kw_only=True)
class VotingRow:
    """A way of voting, measured.

    Attributes:
        points: at most so many of each cloud.
        votes: points of a cloud, their mean.
        method: the way.
        hypotheses: of RANSAC.
        inlier_test: of RANSAC.
        instances: how many clouds.
        success: percent of them whose pose is right.
        milliseconds: of the vote alone, the median.
        times_faster: than the loop.
    """

    points: int
    votes: float
    method: str
    hypotheses: int | None
    inlier_test: str
    instances: int
    success: float
    milliseconds: float
    times_faster: float = 1.0

    def columns(self) -> dict[str, Any]:
        """Give the columns of a table, in its order."""
        titles = {"inlier_test": "inliers by", "times_faster": "times faster"}
        return {titles.get(name, name): value for name, value in asdict(self).items()}


def cases_of(
    net: GeoPoseNet, views: Iterable[ViewSample], points: int
) -> Iterator[VotingCase | None]:
    """Give the votes of up to so many points of each view; None where it has too few to be posed.

    Every point votes from its own place; points of one voxel share the network's direction.

    Args:
        net: whose directions; its objects have the names in the views.
        views: with truth.
        points: at most so many of each, chosen at random, the same each time.

    Raises:
        InputError: the weights are of another kind.
    """
    network = net.weights.network
    if not isinstance(network, ResUNet):
        raise InputError("table 3.3 compares ways of voting: give weights of the sparse network")
    numbers = {model.name: k for k, model in enumerate(net.weights.models)}
    for view in views:
        number = numbers[view.input.object]
        model, given = net.weights.models[number], view.input
        cloud = cloud_from_depth(given.depth_m, given.mask, given.K, model.diameter_m).float()
        generator = torch.Generator().manual_seed(0)
        points_m = sample_points(cloud, points, generator)
        if refusal_of(points_m, net.weights.cloud) is not None:
            yield None
            continue
        yield VotingCase(
            points_m=points_m,
            directions=_directions(network, points_m, number, net.weights.cloud),
            model=model,
            truth=view.truth.camera_from_model,
            is_adds=not model.symmetries.is_none,
        )


def compare_voting(cases: Sequence[VotingCase | None], points: int) -> list[VotingRow]:
    """Let every way vote on every case, one after the other, and sum up.

    The pose follows by the same fit for all: without the covariances that only ours give. What has
    too few points is a failure of every way. The time is that of the vote alone, its median, on one
    thread.
    """
    usable = [case for case in cases if case is not None]
    if not usable:
        raise InputError(f"none of the {len(cases)} views has enough points to be posed")
    votes = sum(len(case.points_m) for case in usable) / len(usable)
    rows: list[VotingRow] = []
    for method, hypotheses, test, vote in _ways():
        with _one_thread():
            vote(usable[0])  # warm
            outcomes = [_outcome(case, vote) for case in usable]
        row = VotingRow(
            points=points,
            votes=votes,
            method=method,
            hypotheses=hypotheses,
            inlier_test=test,
            instances=len(cases),
            success=100 * sum(good for good, _ in outcomes) / len(cases),
            milliseconds=1000 * statistics.median(seconds for _, seconds in outcomes),
        )
        rows.append(row)
    slow = next(row.milliseconds for row in rows if row.method == _LOOP)
    return [replace(row, times_faster=slow / row.milliseconds) for row in rows]


@contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _ways() -> Iterator[tuple[str, int | None, str, Callable[[VotingCase], Tensor]]]:
    yield (_LOOP, LOOP_HYPOTHESES, "angle", _loop)
    for hypotheses in OUR_HYPOTHESES:
        for test in ("angle", "distance"):
            config = VotingConfig(hypotheses=hypotheses, inlier_test=test)
            yield ("RANSAC, ours", hypotheses, test, _ransac(config))
    yield ("least squares, published", None, "", lambda case: _lines(case, 0).keypoints_m)
    yield ("least squares, ours", None, "", lambda case: _lines(case, 3).keypoints_m)


def _loop(case: VotingCase) -> Tensor:
    points, directions = (part.double().numpy() for part in (case.points_m, case.directions))
    found: np.ndarray = ransac_one_by_one(points, directions, LOOP_HYPOTHESES)
    return torch.from_numpy(found)


def _ransac(config: VotingConfig) -> Callable[[VotingCase], Tensor]:
    return lambda case: vote_ransac(case.points_m, case.directions, None, config).keypoints_m


def _lines(case: VotingCase, refinements: int) -> Vote:
    return meet_lines(case.points_m, case.directions, None, refinements)


def _outcome(case: VotingCase, vote: Callable[[VotingCase], Tensor]) -> tuple[bool, float]:
    # Processor time of the one thread: other work on the machine does not count.
    start = time.thread_time()
    keypoints_m = vote(case)
    seconds = time.thread_time() - start
    return _is_success(case, keypoints_m.double()), seconds


def _is_success(case: VotingCase, keypoints_m: Float[Tensor, "k 3"]) -> bool:
    alike = torch.eye(3, dtype=torch.float64).expand(len(keypoints_m), 3, 3)
    pose = fit_pose(keypoints_m, alike, case.model.keypoints_m).camera_from_model
    step = max(1, len(case.model.vertices_m) // _ADD_POINTS)
    points_m, diameter_m = case.model.vertices_m[::step], case.model.diameter_m
    share = add_share(pose, case.truth, points_m, diameter_m, is_adds=case.is_adds)
    return bool(is_within_diameter(torch.tensor(share)))


@torch.inference_mode()
def _directions(
    network: ResUNet, points_m: Points, number: int, cloud: CloudConfig
) -> Float[Tensor, "n k 3"]:
    """Give the direction of every point; those of a voxel share it."""
    grid = voxelise(points_m, cloud)
    rows = torch.cat([torch.zeros_like(grid.coordinates[:, :1]), grid.coordinates], 1)
    voxels = Voxels.from_points(rows, grid.features)
    outputs = network.forward_class(voxels, number)[..., :3] @ grid.grid_from_camera
    return torch.nn.functional.normalize(outputs, dim=-1)[grid.row_of_point]
