"""Tables 3.1 and 3.2: published LineMOD rows (ADD(-S) below 10 % of the diameter), and ours.

Table 3.3: ways to find keypoints from the same directions, their success and time.
"""

import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import cloud_from_depth, why_too_few
from depthpose.pose.config import VotingConfig
from depthpose.pose.evaluate import ObjectRow
from depthpose.pose.grid import sample_points, voxelise
from depthpose.pose.metrics import SUCCESS_SHARE, add_m, adds_m
from depthpose.pose.network import ResUNet
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.propose import fit_pose, meet_lines, vote_ransac
from depthpose.pose.types import ObjectModel, ViewSample, VotingPoints

TITLES = {
    "3.1": "Table 3.1: comparison with baselines on LineMOD, ADD(-S)",
    "3.2": "Table 3.2: 6D pose on LineMOD, ADD(-S)",
    "3.3": "Table 3.3: RANSAC against least squares",
}
"""Titles of the thesis's tables. Its text at hand ends before their numbers: the published rows of
table 3.2 are those that its captions and chapter refer to, from the papers themselves."""

LINEMOD = {
    1: "ape", 2: "benchvise", 4: "camera", 5: "can", 6: "cat", 8: "driller", 9: "duck",
    10: "eggbox*", 11: "glue*", 12: "holepuncher", 13: "iron", 14: "lamp", 15: "phone",
}  # fmt: skip
"""Column of each object, by BOP's number; ADD-S where there is a star."""

LINEMOD_DIAMETERS_M = {
    1: 0.102099, 2: 0.247506, 3: 0.167355, 4: 0.172492, 5: 0.201404, 6: 0.154546, 7: 0.124264,
    8: 0.261472, 9: 0.108999, 10: 0.164628, 11: 0.175889, 12: 0.145543, 13: 0.278078, 14: 0.282601,
    15: 0.212358,
}  # fmt: skip
"""All of LineMOD's diameters, as BOP and Linemod_preprocessed have them; no row has 3 and 7."""

_NUMBERS = {name.rstrip("*"): number for number, name in LINEMOD.items()} | {
    "bowl": 3, "cam": 4, "cup": 7,
}  # fmt: skip
_SAME_DIAMETER = 0.02
"""Largest relative difference of diameters of a model without a name, known by it alone."""
_SAME_NAMED = 0.25
"""The same of a model with a name: tables of LineMOD's diameters differ by up to 16 %."""

PEERS = ("PointFusion", "DenseFusion, per pixel", "DenseFusion, iterative")
"""Trained, as ours, as one network of all objects: the rows that differences are taken from."""


@dataclass(frozen=True)
class PublishedRow:
    """One printed row: percent of the objects of :data:`LINEMOD`, in its order, and their mean."""

    method: str  #: its name
    input: str  # of the method; after "#:" the docs would take the builtin for it
    printed: str  #: percent of each object; empty where only the mean is printed
    mean: float  #: percent
    note: str  #: what else it takes to compare it
    source: str  #: where it is printed


_TABLES = "tables in the READMEs of ethnhe/PVN3D and j96w/DenseFusion"
_FFB6D = "table in the README of ethnhe/FFB6D"
_EACH = "one network an object, some 20,000 synthetic images of each"
_Row = PublishedRow

ROWS = (
    _Row("PVNet", "RGB",
         "43.6 99.9 86.9 95.5 79.3 96.4 52.6 99.2 95.7 82.0 98.9 99.3 92.4", 86.3, _EACH, _TABLES),
    _Row("CDPN", "RGB",
         "64.4 97.8 91.7 95.9 83.8 96.2 66.8 99.7 99.6 85.8 97.9 97.9 90.8", 89.9, "", _TABLES),
    _Row("DPOD", "RGB", "", 95.2, "only the mean is read", _FFB6D),
    _Row("Implicit + ICP", "RGB-D",
         "20.6 64.3 63.2 76.1 72.0 41.6 32.4 98.6 96.4 49.9 63.1 91.7 71.0", 64.7, "",
         _TABLES),
    _Row("SSD-6D + ICP", "RGB-D",
         "65 80 78 86 70 73 66 100 100 49 78 73 79", 79.0,
         "without decimals; the mean of these numbers is 76.7",
         _TABLES),
    _Row("PointFusion", "RGB-D",
         "70.4 80.7 60.8 61.1 79.1 47.3 63.0 99.9 99.3 71.8 83.2 62.3 78.8", 73.7, "",
         _TABLES),
    _Row("DenseFusion, per pixel", "RGB-D",
         "79.5 84.2 76.5 86.6 88.8 77.7 76.3 99.9 99.4 79.0 92.1 92.3 88.0", 86.2,
         "lost detections leave its denominator", _TABLES),
    _Row("DenseFusion, iterative", "RGB-D",
         "92.3 93.2 94.4 93.1 96.5 87.0 92.3 99.8 100.0 92.1 97.0 95.3 92.8", 94.3,
         "lost detections leave its denominator", _TABLES),
    _Row("G2L-Net", "RGB-D", "", 98.7, "only the mean is read", _FFB6D),
    _Row("PVN3D", "RGB-D",
         "97.3 99.7 99.6 99.5 99.8 99.3 98.2 99.8 100.0 99.9 99.7 99.8 99.5", 99.4, _EACH, _TABLES),
    _Row("FFB6D", "RGB-D", "", 99.7, _EACH, _FFB6D),
)  # fmt: skip
"""Every figure as printed. Not like for like: see the notes, and the diameters."""


def find_linemod_number(model: ObjectModel) -> int:
    """Find BOP's number of the object of LineMOD that a model is, by its name and diameter.

    A model without a name is known by its number and diameter.

    Raises:
        InputError: it is none of them.
    """
    is_named = model.name != f"obj_{model.number:06d}"
    number = _NUMBERS.get(model.name.lower(), 0) if is_named else model.number
    diameter_m = LINEMOD_DIAMETERS_M.get(number, 0.0)
    largest_difference = _SAME_NAMED if is_named else _SAME_DIAMETER
    if abs(diameter_m / model.diameter_m - 1) <= largest_difference:
        return number
    remark = f"; LineMOD's object {number} is {diameter_m:.4f} m" if diameter_m else ""
    raise InputError(
        f"object {model.number} ({model.name}, {model.diameter_m:.4f} m across) is none of "
        f"LineMOD{remark}. Table 3.2 compares with numbers of LineMOD's objects; for other data "
        "sets take 'reproduce 3.1', or leave the object out by --objects"
    )


def join_by_object(
    rows: Sequence[ObjectRow], numbers: Mapping[str, int], *, with_published: bool
) -> list[dict[str, Any]]:
    """Turn the rows of evaluations into a row a method and kind of masks, in percent.

    Args:
        rows: of ``pose.evaluate``, with their origin and conditions.
        numbers: BOP's number of each object, by the name in the rows; with printed rows that of
            LineMOD's object (:func:`find_linemod_number`).
        with_published: set the printed rows of LineMOD before ours, and the differences to
            ``PEERS`` after; else (table 3.1) the differences of the first method to the others.

    Returns:
        The columns of each row; ``source`` is ``published``, ``ours`` or ``difference`` (ours less
        the other). The mean of ours is over the objects that were measured; a difference of means
        is given only where both are over the same objects.
    """
    # Ours: a row for each method and kind of masks, a column for each object.
    columns: dict[str, str] = {}
    for name, number in numbers.items():
        columns[name] = LINEMOD.get(number, name) if with_published else name
    groups: dict[tuple[str, str], list[ObjectRow]] = {}
    for row in rows:
        assert row.origin is not None, "rows of an evaluation say whose they are"
        groups.setdefault((row.origin.method, row.origin.masks), []).append(row)
    our_rows = [_make_our_row(group, columns) for group in groups.values()]
    names = list(columns.values())
    if not with_published:
        differences = [_subtract_row(our_rows[0], other, names) for other in our_rows[1:]]
        return [*our_rows, *differences]

    # The printed ones before them, and the differences to our peers after.
    printed = [
        {
            "source": "published",
            "method": row.method,
            "masks": "",
            "input": row.input,
            **dict(zip(LINEMOD.values(), map(float, row.printed.split()), strict=False)),
            "mean": row.mean,
            "diameters": "pvnet" if row.method == "PVNet" else "bop",
            "note": row.note,
            "printed in": row.source,
        }
        for row in ROWS
    ]
    peers = [row for row in printed if row["method"] in PEERS]
    differences = [_subtract_row(row, peer, names) for row in our_rows for peer in peers]
    return [*printed, *our_rows, *differences]


def _make_our_row(rows: Sequence[ObjectRow], columns: Mapping[str, str]) -> dict[str, Any]:
    """Make the row of one method of ours: percentages of each object, by the table's columns."""
    by_name = {row.object: row for row in rows}
    # Of one object there is no row of means: it is its own.
    mean = by_name.get("mean", rows[0])
    origin = mean.origin
    conditions = mean.conditions
    assert origin is not None
    assert conditions is not None
    return {
        "source": "ours",
        "method": origin.method,
        "masks": origin.masks,
        "input": "depth",
        **{column: 100 * by_name[name].success for name, column in columns.items()},
        "mean": 100 * mean.success,
        "refused": 100 * mean.refused,
        "wrong": 100 * mean.wrong,
        "auc": 100 * (mean.scores["auc"] or 0.0),
        "instances": mean.instances,
        "diameters": conditions.diameters,
        "weights": origin.weights,
        "weights_sha256": origin.weights_sha256,
        "frames": conditions.frames,
        "frames_sha256": conditions.frames_sha256,
        **{f"ms_{stage}": value for stage, value in mean.ms.items()},
    }


def _subtract_row(
    our_row: Mapping[str, Any], other: Mapping[str, Any], names: Sequence[str]
) -> dict[str, Any]:
    """Subtract a row from one of ours, by the names of our objects."""
    # Means are compared only where both are over the same objects.
    compared = names if other["source"] == "ours" else [n for n in LINEMOD.values() if n in other]
    difference = {
        "source": "difference",
        "method": f"{our_row['method']} - {other['method']}",
        "masks": our_row["masks"],
        **{name: our_row[name] - other[name] for name in names if name in compared},
        "mean": our_row["mean"] - other["mean"] if set(compared) == set(names) else None,
    }
    if our_row["diameters"] != other["diameters"]:
        difference["diameters"] = f"{our_row['diameters']} against {other['diameters']}"
    return difference


_ADD_POINTS = 1000
"""About how many vertices of a model ADD(-S) is measured at."""
LOOP_HYPOTHESES = 50
"""Hypotheses of the loop, as published ones take."""
OUR_HYPOTHESES = (50, 128, 1024)


@dataclass(frozen=True, kw_only=True, eq=False)
class VotingCase:
    """The votes of one cloud, and the truth."""

    points_m: Float[Tensor, "n 3"]  #: in the camera frame
    directions: Float[Tensor, "n k 3"]  #: the network's at these points, of length 1
    model: ObjectModel  #: the object
    truth: Rigid  #: ``camera_from_model``
    is_adds: bool  #: whether ADD-S decides, not ADD


def collect_votes(
    net: GeoPoseNet, views: Iterable[ViewSample], points: int
) -> Iterator[VotingCase | None]:
    """Collect the votes of some points of each view; None where it has too few to be posed.

    The points are chosen at random, the same each time. Each votes from its own position; points of
    one voxel share the network's direction.

    Args:
        net: the network, whose objects have the names in the views.
        views: with truth.
        points: most points of a view that vote.

    Raises:
        InputError: the weights are of another kind.
    """
    network = net.weights.network
    if not isinstance(network, ResUNet):
        raise InputError("table 3.3 compares ways of voting: give weights of the sparse network")
    numbers = {model.name: k for k, model in enumerate(net.weights.models)}
    for view in views:
        # Some points of the object.
        number = numbers[view.input.object]
        model = net.weights.models[number]
        view_input = view.input
        cloud = cloud_from_depth(
            view_input.depth_m, view_input.mask, view_input.K, model.diameter_m
        ).float()
        generator = torch.Generator().manual_seed(0)
        points_m = sample_points(cloud, points, generator)
        if why_too_few(points_m, net.weights.cloud) is not None:
            yield None
            continue

        # The network's directions at their voxels.
        grid = voxelise(points_m, net.weights.cloud)
        coordinates = torch.nn.functional.pad(grid.coordinates, (1, 0))  # all of cloud 0
        voxels = VotingPoints(
            points_m=grid.points_m,
            coordinates=coordinates,
            features=grid.features,
            class_of_point=torch.full((len(coordinates),), number),
        )
        with torch.inference_mode():
            outputs = network.directions(voxels) @ grid.grid_from_camera
            directions = torch.nn.functional.normalize(outputs, dim=-1)[grid.row_of_point]
        yield VotingCase(
            points_m=points_m,
            directions=directions,
            model=model,
            truth=view.truth.camera_from_model,
            is_adds=not model.symmetries.is_none,
        )


def compare_voting(cases: Sequence[VotingCase | None], points: int) -> list[dict[str, Any]]:
    """Compare methods of voting on the same cases; give the columns of a row for each method.

    The pose follows from the keypoints by the same fit for all, without covariances, which only our
    methods give. The time is the median of the vote alone, on one thread.

    Args:
        cases: of :func:`collect_votes`; None counts as a failure of every method.
        points: most points of a view, for its column.

    Raises:
        InputError: every case is None.
    """
    usable = [case for case in cases if case is not None]
    if not usable:
        raise InputError(f"none of the {len(cases)} views has enough points to be posed")
    rows: list[dict[str, Any]] = []
    for voting in _list_voting_methods():
        successes, seconds = _time_votes(usable, voting.vote)
        row = {
            "points": points,
            "votes": sum(len(case.points_m) for case in usable) / len(usable),
            "method": voting.name,
            "hypotheses": voting.hypotheses,
            "inliers by": voting.inlier_test,
            "instances": len(cases),
            "success": 100 * successes / len(cases),
            "milliseconds": 1000 * statistics.median(seconds),
        }
        rows.append(row)
    loop_ms = rows[0]["milliseconds"]
    return [row | {"times faster": loop_ms / row["milliseconds"]} for row in rows]


class _Voting(NamedTuple):
    """A method of voting: its columns of table 3.3, and the function from votes to keypoints."""

    name: str
    hypotheses: int | None
    inlier_test: str
    vote: Callable[[VotingCase], Tensor]


def _list_voting_methods() -> list[_Voting]:
    """List the methods of table 3.3; the loop, which the others are compared with, is the first."""
    methods = [_Voting("RANSAC, one by one (NumPy)", LOOP_HYPOTHESES, "angle", _vote_by_loop)]
    for hypotheses in OUR_HYPOTHESES:
        for inlier_test in ("angle", "distance"):
            config = VotingConfig(hypotheses=hypotheses, inlier_test=inlier_test)
            vote = partial(_vote_by_ransac, config=config)
            methods.append(_Voting("RANSAC, ours", hypotheses, inlier_test, vote))
    for name, steps in (("least squares, published", 0), ("least squares, ours", 3)):
        methods.append(_Voting(name, None, "", partial(_vote_by_least_squares, steps=steps)))
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


def _time_votes(
    cases: Sequence[VotingCase], vote: Callable[[VotingCase], Tensor]
) -> tuple[int, list[float]]:
    """Count the cases that a method of voting poses right, and measure the seconds of each vote.

    Seconds are the processor time of one thread: other work on the machine does not count.
    """
    success_count = 0
    seconds: list[float] = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        vote(cases[0])  # warms up
        for case in cases:
            start = time.thread_time()
            keypoints_m = vote(case)
            seconds.append(time.thread_time() - start)
            success_count += _is_right(keypoints_m, case)
    finally:
        torch.set_num_threads(threads)
    return success_count, seconds


def _is_right(keypoints_m: Float[Tensor, "k 3"], case: VotingCase) -> bool:
    """Whether the pose of voted keypoints has an ADD(-S) below a tenth of the diameter."""
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
    hypotheses: int = 50,
    min_cosine: float = 0.99,
    seed: int = 0,
) -> Float64[np.ndarray, "k 3"]:
    """Find every keypoint with a loop over keypoints and hypotheses.

    A hypothesis is the point nearest to the lines of two random points; its inliers are the points
    from which the cosine between unit direction and hypothesis is more than ``min_cosine``. The one
    with the most is refitted to its inliers. Published practice is 50 hypotheses for each keypoint.

    Args:
        points_m: where the votes start.
        directions: unit vectors.
        hypotheses: for each keypoint.
        min_cosine: of inliers.
        seed: of the pairs of points.
    """
    random = np.random.default_rng(seed)
    keypoints: list[np.ndarray] = []
    for k in range(directions.shape[1]):
        # The hypothesis of most inliers.
        n = directions[:, k]
        most_inliers = -1
        best_inliers = np.ones(len(n), bool)
        for _ in range(hypotheses):
            pair = random.choice(len(points_m), 2, replace=False)
            try:
                hypothesis = np.linalg.solve(*_build_normal_equations(points_m[pair], n[pair]))
            except np.linalg.LinAlgError:
                continue
            offsets = hypothesis - points_m
            distances = np.sqrt((offsets * offsets).sum(1)).clip(1e-300)
            inliers = (offsets * n).sum(1) / distances > min_cosine
            count = np.count_nonzero(inliers)
            if count > most_inliers:
                most_inliers = count
                best_inliers = inliers

        # Refitted to them.
        try:
            refitted = np.linalg.solve(
                *_build_normal_equations(points_m[best_inliers], n[best_inliers])
            )
        except np.linalg.LinAlgError:  # no inlier but parallel ones, or none: all votes count
            refitted = np.linalg.lstsq(*_build_normal_equations(points_m, n), rcond=None)[0]
        keypoints.append(refitted)
    return np.stack(keypoints)


def _build_normal_equations(points_m: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Build A and b of the normal equations ``A x = b`` of the point nearest to lines.

    The lines go through ``points_m`` along the unit directions ``n``; A is singular if they are
    parallel.
    """
    A = len(points_m) * np.eye(3) - n.T @ n
    return A, points_m.sum(0) - n.T @ (n * points_m).sum(1)
