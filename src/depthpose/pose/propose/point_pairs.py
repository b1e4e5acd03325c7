"""Point pair features: candidate poses of a known surface in a cloud, without a network.

Drost et al., Model Globally, Match Locally, CVPR 2010; which model points are kept, neighbouring
bins and the check of every candidate follow Vidal et al., Sensors 2018.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, Int64, UInt32
from torch import Tensor
from torch.nn.functional import normalize

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, geodesic_rad, rotation_by
from depthpose.pose.compiled import array_of, compiled
from depthpose.pose.config import IcpConfig
from depthpose.pose.grid import thin_cloud
from depthpose.pose.icp import refine_roughly
from depthpose.pose.mesh import true_symmetries
from depthpose.pose.mesh.models import fibonacci_directions
from depthpose.pose.surface import NEAR, Surface, look_along_rays, prepare_surface
from depthpose.pose.types import ObjectModel

STEP = 0.07
"""Least distance between points of the model, and width of a bin of the length of a pair, both over
the diameter."""
DISTANCES = 15
"""Bins of the length of a point pair; one more holds all longer pairs."""
ANGLES = 15
"""Bins of each of the three angles of a point pair, from 0 to 180 degrees."""
TURNS = 30
"""Bins of the rotation about the normal of the first point of a pair, from 0 to 360 degrees."""
_MOST_ALIKE = 150
"""Largest number of pairs of the model with one feature that vote: all pairs of a plane are alike
and tell little."""
_MODEL_POINTS = 800
"""Largest number of points of a model that form pairs."""
_COARSER = 1.1
"""Factor by which the least distance of these points grows until there are few enough."""
_SCENE_POINTS = 400
"""Largest number of points of a cloud that form pairs."""
_REFERENCES = 50
"""Points of a cloud that vote with each of the others."""
_PEAKS = 6
"""Poses that each of these points proposes."""
_VIEWS = 30
"""Directions from which the model is viewed, to find the visible sides of its surface."""
_LEAST_COSINE = 0.2
"""Least cosine between the normal of a surface and a direction from which it is visible."""
_CELLS = 40
"""Cells along the diameter of the model; in each, points hide those behind them."""
_SCORED_POINTS = 100
"""Points of the cloud by which proposed poses are compared."""
_NEAR_ROUGHLY = 0.1
"""Largest distance, in diameters, of a point that is near the surface at a proposed, rough pose."""
_RAYS_EVERY = 16
"""Every so-many-th point of the surface is used to count free-space violations."""
_UNOBSERVED_WEIGHT = 0.3
"""Weight in a score of the share of the surface that should be visible and was not observed."""

# For the search of a model in itself.
_SELF_REFERENCES = 40
"""Points of the model that vote with each of the others."""
_SELF_PEAKS = 48
"""Motions that each of these points proposes."""
_SELF_COMPARED = 250
"""Points of the surface by which motions are compared."""
_LEAST_SHARE = 0.25
"""Least share of the surface that a motion must move onto the surface."""
_LEAST_OF_BEST = 0.85
"""Least ratio of that share to the share of the best motion."""
_NEAR_SYMMETRY = 0.8
"""Share from which a motion is a near-symmetry, and may differ little from another motion."""
_MIN_COSINE = 0.7
"""Least cosine between the normal of a moved point and that of the surface there."""
_APART_RAD = math.radians(12)
"""Least angle between two near-symmetries; between other motions it is five times as large."""
_MOST_TURNS = 36
"""Largest number of motions that are given."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PairTable:
    """Pairs of points of a model, sorted by their features."""

    #: of the surface that is visible from outside, 0.07 diameters apart or more, in the order of
    #: the model's faces.
    points_m: Float64[Tensor, "m 3"]
    frames: Float64[Tensor, "m 3 3"]  #: outward normal and two tangents of each point, as columns
    bounds: Int32[Tensor, " bounds"]  #: pairs ``bounds[k]`` to ``bounds[k + 1]`` have feature ``k``
    first: Int32[Tensor, " pairs"]  #: index of the first point of each pair
    #: angle of the second point about the normal of the first, from its first tangent.
    turn_rad: Float32[Tensor, " pairs"]
    surface: Surface  #: of the model


def find_turns(model: ObjectModel) -> dict[str, Any]:
    """Find the motions after which most of a model's surface lies on itself; symmetries left out.

    A mug has them about its axis: but for its handle it looks alike. A bracket has half turns,
    after which half of it lies on itself. They are found by searching the model in itself.

    Returns:
        JSON values: ``turns``, 4x4 matrices ``model_from_model`` in metres, the best first, and
        ``near``, how many of the first ones are near-symmetries, with 80 % of the surface or more.
    """
    # Motions that pairs of points vote for.
    surface = prepare_surface(replace(model, symmetries=true_symmetries(model)))
    table = prepare_pairs(surface)
    # References from all sides, not from the first faces alone.
    references = take_evenly(torch.arange(len(table.points_m)), _SELF_REFERENCES)
    candidates, _ = vote_poses(table.points_m, table.frames[..., 0], references, table, _SELF_PEAKS)
    candidates = candidates[_choose_distinct_turns(candidates, surface)[0]]

    # Refined as poses before a camera in the middle of the model, from where all is visible.
    points_m = surface.points_m - surface.middle_m
    starts = Rigid(candidates.R, candidates.t_m - surface.middle_m)
    candidates = refine_roughly(points_m, starts, surface, IcpConfig())
    candidates = Rigid(candidates.R, candidates.t_m + surface.middle_m)
    candidates = candidates[_choose_distinct_turns(candidates, surface)[0]]

    # Products of two are candidates too, which fill gaps between those that were found.
    products = candidates[:, None] @ candidates
    products = Rigid(products.R.flatten(0, 1), products.t_m.flatten(0, 1))
    candidates = Rigid.cat([candidates, products])
    chosen, near = _choose_distinct_turns(candidates, surface)
    return {"turns": candidates[chosen].matrix().tolist(), "near": near}


def _choose_distinct_turns(turns: Rigid, surface: Surface) -> tuple[list[int], int]:
    """Choose the motions after which most of a surface lies on itself, the best first.

    None is within 12 degrees of a better one, of a symmetry, or of a product of these; one that is
    no near-symmetry is not within 60 degrees, since any small motion leaves the surface near
    itself.

    Returns:
        Indices of the chosen motions, and how many of them are near-symmetries.
    """
    # The share of the surface that each motion moves onto the surface.
    step = max(1, len(surface.points_m) // _SELF_COMPARED)
    local_m = turns.inverse().apply(surface.points_m[::step])
    index = surface.boxes.look_up(local_m)
    is_alike = (local_m - surface.points_m[index]).norm(dim=-1) < NEAR * surface.diameter_m
    cosine = ((surface.normals[index] @ turns.R.mT) * surface.normals[::step]).sum(-1)
    share = (is_alike & (cosine.abs() > _MIN_COSINE)).double().mean(-1)

    chosen: list[int] = []
    excluded_R = surface.symmetries.R  # of symmetries, and of chosen motions after them
    for k in share.argsort(descending=True).tolist():
        least = _LEAST_OF_BEST * float(share[chosen[0]]) if chosen else _LEAST_SHARE
        if share[k] < max(least, _LEAST_SHARE) or len(chosen) == _MOST_TURNS:
            break
        apart_rad = _APART_RAD if share[k] >= _NEAR_SYMMETRY else 5 * _APART_RAD
        if float(geodesic_rad(turns.R[k].expand_as(excluded_R), excluded_R).min()) > apart_rad:
            chosen.append(k)
            excluded_R = torch.cat([excluded_R, turns.R[k] @ surface.symmetries.R])
    return chosen, int((share[chosen] >= _NEAR_SYMMETRY).sum())


def prepare_pairs(surface: Surface) -> PairTable:
    """Sort the pairs of a surface's points by their features, once for many clouds.

    Args:
        surface: of the model; normals may point to either side.
    """
    # Points of the visible surface, few enough.
    points_m, normals = _find_visible_points(surface)
    step_m = STEP * surface.diameter_m
    chosen = thin_cloud(points_m, normals, step_m)
    while len(chosen) > _MODEL_POINTS:
        step_m *= _COARSER
        chosen = thin_cloud(points_m, normals, step_m)
    points_m = points_m[chosen]
    frames = _make_frames(normals[chosen])

    # All pairs of two different points, by feature. Within a feature they are shuffled, so that the
    # first ones are a sample of all.
    count = len(points_m)
    first = torch.arange(count).repeat_interleave(count - 1)
    bin_m = STEP * surface.diameter_m
    keys, turns = _describe_all_pairs(array_of(points_m), array_of(frames), bin_m)
    turn_rad = torch.from_numpy(turns)
    shuffle = torch.randperm(len(first), generator=torch.Generator().manual_seed(0))
    feature, order = torch.from_numpy(keys)[shuffle].sort(stable=True)
    order = shuffle[order]

    # Where the pairs of each feature begin.
    sizes = torch.bincount(feature, minlength=(DISTANCES + 1) * ANGLES**3)
    bounds = torch.cat([sizes.new_zeros(1), sizes.cumsum(0)])
    return PairTable(
        points_m=points_m,
        frames=frames,
        bounds=bounds.int(),
        first=first[order].int(),
        turn_rad=turn_rad[order].float(),
        surface=surface,
    )


def propose_poses(
    points_m: Float64[Tensor, "n 3"],
    normals: Float64[Tensor, "n 3"],
    table: PairTable,
    count: int,
    generator: torch.Generator,
) -> Rigid:
    """Propose poses, the best first: each reference point votes with every other point.

    Args:
        points_m: of the cloud, about 0.05 diameters apart, in the camera frame.
        normals: of these points, toward the camera.
        table: pairs of the model.
        count: how many poses at most.
        generator: chooses the reference points.
    """
    chosen = torch.randperm(len(points_m), generator=generator)
    chosen = chosen[:_SCENE_POINTS]
    points_m = points_m[chosen]
    normals = normals[chosen]
    references = torch.arange(min(_REFERENCES, len(points_m)))
    poses, _ = vote_poses(points_m, normals, references, table, _PEAKS)
    scores = _score_poses(points_m, normals, poses, table.surface)
    best = scores.argsort(descending=True, stable=True)[:count]
    return poses[best]


def _find_visible_points(
    surface: Surface,
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"]]:
    """Find the points that a far camera sees from anywhere, with normals toward it.

    A point of a thin sheet, both of whose sides are visible, is given twice.
    """
    half = fibonacci_directions(_VIEWS // 2).double()
    directions = torch.cat([half, -half])
    visible_from: list[Tensor] = []
    for toward in directions:
        # In each cell of an image, points near the one nearest to the camera are visible.
        across = torch.linalg.svd(toward[None]).Vh[1:]
        cells = ((surface.points_m @ across.T) / surface.diameter_m * _CELLS).floor().long()
        column, row = (cells - cells.amin(0)).unbind(-1)
        width = int(row.max()) + 1
        cell = column * width + row
        toward_m = surface.points_m @ toward
        nearest_m = torch.full(((int(column.max()) + 1) * width,), -torch.inf, dtype=torch.float64)
        nearest_m.scatter_reduce_(0, cell, toward_m, "amax")
        visible_from.append(toward_m > nearest_m[cell] - surface.diameter_m / _CELLS)

    # The sides that face one of these cameras.
    is_visible = torch.stack(visible_from)
    cosine = directions @ surface.normals.T
    front = (is_visible & (cosine > _LEAST_COSINE)).any(0)
    back = (is_visible & (-cosine > _LEAST_COSINE)).any(0)
    points_m = torch.cat([surface.points_m[front], surface.points_m[back]])
    return points_m, torch.cat([surface.normals[front], -surface.normals[back]])


def _make_frames(normals: Float64[Tensor, "n 3"]) -> Float64[Tensor, "n 3 3"]:
    """Make a frame of each normal: it and two tangents, as columns."""
    # The first tangent is across the axis along which the normal points least.
    least = torch.eye(3, dtype=torch.float64)[normals.abs().argmin(-1)]
    first = normalize(torch.linalg.cross(normals, least), dim=-1)
    return torch.stack([normals, first, torch.linalg.cross(normals, first)], -1)


@compiled
def _describe_all_pairs(
    points: Float64[np.ndarray, "m 3"], frames: Float64[np.ndarray, "m 3 3"], step: float
) -> tuple[Int64[np.ndarray, " pairs"], Float64[np.ndarray, " pairs"]]:
    """Compute the key of the feature of every pair of points, and the turn of its second point."""
    count = len(points)
    keys = np.empty(count * (count - 1), np.int64)
    turns = np.empty(count * (count - 1))
    feature = np.empty(4)
    pair = 0
    for i in range(count):
        for j in range(count):
            if j == i:
                continue
            turns[pair] = _write_feature(points, frames, i, j, step, feature)
            keys[pair] = _make_key(feature)
            pair += 1
    return keys, turns


@compiled
def _write_feature(
    points: Float64[np.ndarray, "n 3"],
    frames: Float64[np.ndarray, "n 3 3"],
    i: int,
    j: int,
    step: float,
    feature: Float64[np.ndarray, "4"],
) -> float:
    """Write the feature of a pair of points; give the angle of the second about the first's normal.

    The feature is the distance, the angles of both normals to the line between the points, and the
    angle between the normals (Drost et al., equation 1); as fractions of bins.

    Args:
        points: of the model or the scene.
        frames: normal and two tangents of each, as columns.
        i: index of the first point of the pair.
        j: index of the second.
        step: a bin of the distance.
        feature: is written.
    """
    # The way from the first point to the second along the first's normal and tangents, and along
    # the second's normal; and the cosine of the two normals.
    along, aside, up = 0.0, 0.0, 0.0
    along_second = 0.0
    cosine = 0.0
    square = 0.0
    for c in range(3):
        way = points[j, c] - points[i, c]
        square += way * way
        along += way * frames[i, c, 0]
        aside += way * frames[i, c, 1]
        up += way * frames[i, c, 2]
        along_second += way * frames[j, c, 0]
        cosine += frames[i, c, 0] * frames[j, c, 0]
    distance = max(np.sqrt(square), 1e-12)
    feature[0] = distance / step
    feature[1] = _measure_angle(along / distance)
    feature[2] = _measure_angle(along_second / distance)
    feature[3] = _measure_angle(cosine)
    return np.arctan2(up, aside)


@compiled
def _measure_angle(cosine: float) -> float:
    """Convert a cosine to its angle in bins."""
    return np.arccos(min(1.0, max(-1.0, cosine))) * (ANGLES / np.pi)


@compiled
def _make_key(feature: Float64[np.ndarray, "4"]) -> int:
    """Make one number of the bins of a feature."""
    key = 0
    for k in range(4):
        key = key * ANGLES + _clamp_bin(int(feature[k]), k)
    return key


@compiled
def _clamp_bin(number: int, k: int) -> int:
    """Find the bin of part ``k`` of a feature; values beyond the bins are in the last one."""
    last = DISTANCES if k == 0 else ANGLES - 1
    return min(max(number, 0), last)


def vote_poses(
    points_m: Float64[Tensor, "n 3"],
    normals: Float64[Tensor, "n 3"],
    references: Int64[Tensor, " r"],
    table: PairTable,
    peaks: int,
) -> tuple[Rigid, Float64[Tensor, " b"]]:
    """Let every pair of a reference point vote for a model point and a turn about its normal.

    A pair votes by its own bins and, in each of its four features, by the nearest other bin. Rare
    features weigh more, and a turn votes once for a feature: flat parts would outvote the rest
    (Hinterstoisser et al., Going Further with Point Pair Features, ECCV 2016).

    Args:
        points_m: of the scene, about 0.05 diameters apart, in the camera frame.
        normals: of these points, toward the camera.
        references: indices of the points that vote with each of the others.
        table: pairs of the model.
        peaks: poses that each reference proposes.

    Returns:
        Poses and their votes, reference after reference.
    """
    frames = _make_frames(normals)
    peaks_of_each = _vote(
        array_of(points_m),
        array_of(frames),
        references.numpy(),
        _PairArrays(table.bounds.numpy(), table.first.numpy(), table.turn_rad.numpy()),
        len(table.points_m),
        STEP * table.surface.diameter_m,
        min(peaks, len(table.points_m)),
    )
    number, turn_bin, votes = (torch.from_numpy(part).flatten() for part in peaks_of_each)

    # The poses that put model points and their normals on reference points, by turns about these.
    angle = ((turn_bin + 0.5) * (2 * math.pi / TURNS)).double()
    turn = rotation_by(angle[:, None] * angle.new_tensor([1.0, 0.0, 0.0]))
    reference = references.repeat_interleave(peaks_of_each[0].shape[1])
    R = frames[reference] @ turn @ table.frames[number].mT
    t_m = points_m[reference] - (R @ table.points_m[number][..., None]).squeeze(-1)
    return Rigid(R, t_m), votes


class _PairArrays(NamedTuple):
    """Parts of :class:`PairTable` for compiled loops."""

    bounds: Int32[np.ndarray, " bounds"]  #: of the features
    first: Int32[np.ndarray, " pairs"]  #: point of each pair
    turn: Float32[np.ndarray, " pairs"]  #: of each pair [rad]


@compiled
def _vote(
    points: Float64[np.ndarray, "n 3"],
    frames: Float64[np.ndarray, "n 3 3"],
    references: Int64[np.ndarray, " r"],
    pairs: _PairArrays,
    models: int,
    step: float,
    peaks: int,
) -> tuple[
    Int64[np.ndarray, "r peaks"], Int64[np.ndarray, "r peaks"], Float64[np.ndarray, "r peaks"]
]:
    """Let every pair of a reference point vote; give points, turns and votes of its peaks.

    Args:
        points: of the scene.
        frames: normal and two tangents of each, as columns.
        references: indices of the points that vote with each of the others.
        pairs: of the model.
        models: number of its points.
        step: a bin of the distance of a pair.
        peaks: of each reference that are given: model points, bins of turns, and votes.
    """
    shape = (len(references), peaks)
    best_point = np.empty(shape, np.int64)
    best_turn = np.empty(shape, np.int64)
    best_votes = np.empty(shape)
    counts = np.zeros((models, TURNS), np.float32)
    voted = np.zeros(len(pairs.bounds), np.uint32)  # bit b: the feature has had a vote of turn b
    feature = np.empty(4)
    for r in range(len(references)):
        i = references[r]
        counts[:] = 0
        voted[:] = 0
        # With every other point that is neither too near nor too far.
        for j in range(len(points)):
            square = 0.0
            for c in range(3):
                square += (points[j, c] - points[i, c]) ** 2
            if square > step * step and square < (DISTANCES * step) ** 2:
                turn = _write_feature(points, frames, i, j, step, feature)
                _vote_by_pair(feature, turn, pairs, voted, counts)
        _find_peaks(counts, best_point[r], best_turn[r], best_votes[r])
    return best_point, best_turn, best_votes


@compiled
def _vote_by_pair(
    feature: Float64[np.ndarray, "4"],
    turn: float,
    pairs: _PairArrays,
    voted: UInt32[np.ndarray, " bounds"],
    counts: Float32[np.ndarray, "m turns"],
) -> None:
    """Add the votes of the model's pairs with the feature of a pair of the scene, or nearly so.

    Args:
        feature: of the pair of the scene, as fractions of bins.
        turn: of its second point about the normal of the first.
        pairs: of the model.
        voted: for each feature, which turns have voted; changed.
        counts: votes of each model point and turn; changed.
    """
    key = _make_key(feature)
    _add_votes(key, turn, pairs, voted, counts)

    # In each part of the feature the bin next to the pair's too; beyond the last it is the same.
    for k in range(4):
        pair_bin = int(feature[k])
        beside = pair_bin + (-1 if feature[k] - pair_bin < 0.5 else 1)
        change = _clamp_bin(beside, k) - _clamp_bin(pair_bin, k)
        if change != 0:
            _add_votes(key + change * ANGLES ** (3 - k), turn, pairs, voted, counts)


@compiled
def _add_votes(
    key: int,
    turn: float,
    pairs: _PairArrays,
    voted: UInt32[np.ndarray, " bounds"],
    counts: Float32[np.ndarray, "m turns"],
) -> None:
    """Add the votes of the model's pairs with a feature; a turn votes once for it."""
    low = pairs.bounds[key]
    high = pairs.bounds[key + 1]
    bit = np.uint32(1 << min(int((turn + np.pi) / (2 * np.pi) * TURNS), TURNS - 1))
    if high == low or voted[key] & bit:
        return
    voted[key] |= bit
    weight = np.float32(1 / np.sqrt(high - low))  # rare features weigh more
    for p in range(low, min(high, low + _MOST_ALIKE)):
        counts[pairs.first[p], _find_turn_bin(turn - pairs.turn[p])] += weight


@compiled
def _find_turn_bin(turn: float) -> int:
    """Find the bin of the difference of two angles between -pi and pi."""
    value = turn * (TURNS / (2 * np.pi))
    b = int(value + TURNS if value < 0 else value)
    return b - TURNS if b >= TURNS else b


@compiled
def _find_peaks(
    counts: Float32[np.ndarray, "m turns"],
    best_point: Int64[np.ndarray, " peaks"],
    best_turn: Int64[np.ndarray, " peaks"],
    best_votes: Float64[np.ndarray, " peaks"],
) -> None:
    """Write the model points with the most votes, at the best turn of each.

    Args:
        counts: votes of each model point and turn.
        best_point: is written: model points, those of the most votes first.
        best_turn: is written: bins of turns.
        best_votes: is written.
    """
    # The best turn of each model point.
    models = len(counts)
    most = np.empty(models)
    turn = np.empty(models, np.int64)
    for m in range(models):
        most[m] = -1.0
        for b in range(TURNS):
            # Neighbouring turns share their votes.
            votes = 2 * counts[m, b] + counts[m, b - 1] + counts[m, (b + 1) % TURNS]
            if votes > most[m]:
                most[m] = votes
                turn[m] = b

    # The points of the most votes, one after the other.
    for k in range(len(best_point)):
        m = np.argmax(most)
        best_point[k] = m
        best_turn[k] = turn[m]
        best_votes[k] = most[m]
        most[m] = -1.0


def _score_poses(
    points_m: Float64[Tensor, "n 3"],
    normals: Float64[Tensor, "n 3"],
    poses: Rigid,
    surface: Surface,
) -> Float64[Tensor, " b"]:
    """Score poses: points near the surface, by how normals fit, less contradictions.

    These are free-space violations and part of the unobserved surface.
    """
    # Points near the surface, by how their normals fit.
    inverse = poses.inverse()
    local_m = points_m[:_SCORED_POINTS] @ inverse.R.mT + inverse.t_m[:, None]
    local_normals = normals[:_SCORED_POINTS] @ inverse.R.mT
    index = surface.boxes.look_up(local_m)
    limit_m = _NEAR_ROUGHLY * surface.diameter_m
    is_near = (local_m - surface.points_m[index]).norm(dim=-1) < limit_m
    cosine = (local_normals * surface.normals[index]).sum(-1).abs()
    support = (is_near * cosine).mean(-1)

    # And what contradicts the pose.
    free_space_violation, unobserved = look_along_rays(points_m, poses, surface, every=_RAYS_EVERY)
    return support - free_space_violation - _UNOBSERVED_WEIGHT * unobserved
