"""Point pair features: candidate poses of a known surface in a cloud, without a network.

Drost et al., Model Globally, Match Locally, CVPR 2010; which model points are kept, neighbouring
bins and the check of every candidate follow Vidal et al., Sensors 2018.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float32, Float64, Int32, Int64
from torch import Tensor
from torch.nn.functional import normalize

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, geodesic_rad, rotation_by
from depthpose.pose.cloud import thin
from depthpose.pose.compiled import ANGLES, DISTANCES, MOST_ALIKE, TURNS, use_numba
from depthpose.pose.config import IcpConfig
from depthpose.pose.icp import refine_roughly
from depthpose.pose.mesh import true_symmetries
from depthpose.pose.mesh.models import fibonacci_directions
from depthpose.pose.surface import (
    NEAR,
    Surface,
    finite_array,
    look_along_rays,
    prepare_surface,
)
from depthpose.pose.types import ObjectModel

STEP = 0.07
"""Of the diameter: distance of the points of the model, and a bin of the distances of a pair."""
_MODEL_POINTS = 800
"""Of the model at most; where there are more, their distance grows by the factor below."""
_COARSER = 1.1
_SCENE_POINTS = 400
"""Of a cloud at most."""
_REFERENCES = 50
"""Points of a cloud that vote with each of the others."""
_PEAKS = 6
"""Poses that each of them proposes."""
_REFERENCES_AT_ONCE = 20
_VIEWS = 30
"""Directions from which the model is viewed, to find the visible sides of its surface."""
_LEAST_COSINE = 0.2
"""Of the angle between its normal and a view, at which a surface is visible."""
_CELLS = 40
"""Cells along the diameter in which points hide those behind them."""
_SCORED_POINTS = 100
"""Of the cloud, by which proposed poses are compared."""
_NEAR_ROUGHLY = 0.1
"""Of the diameter: points within this distance of a proposed pose, which is rough, are near it."""
_RAYS_EVERY = 16
"""Of so many points of the surface one is used to count free-space violations."""
_UNOBSERVED_WEIGHT = 0.3
"""Weight in a score of the share of the surface that should be visible and was not observed."""

# A model that is searched in itself.
_SELF_REFERENCES = 40
"""Points that vote."""
_SELF_PEAKS = 48
"""Poses that each proposes."""
_SELF_COMPARED = 250
"""Points by which poses are compared."""
_LEAST_SHARE = 0.25
"""Least share of the surface that a motion moves onto the surface."""
_LEAST_OF_BEST = 0.85
"""Least ratio of that share to the one of the best motion."""
_NEAR_SYMMETRY = 0.8
"""Share from which a motion is a near-symmetry, and may be near another one."""
_MIN_COSINE = 0.7
"""Of the normals of a moved point and of the surface there."""
_APART_RAD = math.radians(12)
"""Least angle between two motions."""
_MOST_TURNS = 36


@dataclass(frozen=True, kw_only=True, eq=False)
class PairTable:
    """Pairs of points of a model, sorted by their features.

    Attributes:
        points_m: of the surface that is visible from outside, 0.07 diameters apart or more, in the
            order of the model's faces.
        frames: of each point its outward normal and two tangents, as columns.
        bounds: pairs ``bounds[k]`` to ``bounds[k + 1]`` have feature ``k``.
        first: index of the first point of each pair.
        turn_rad: angle of the second point about the normal of the first, from its first tangent.
        surface: of the model.
    """

    points_m: Float64[Tensor, "m 3"]
    frames: Float64[Tensor, "m 3 3"]
    bounds: Int32[Tensor, " bounds"]
    first: Int32[Tensor, " pairs"]
    turn_rad: Float32[Tensor, " pairs"]
    surface: Surface


def find_turns(model: ObjectModel) -> dict[str, Any]:
    """Find the motions after which most of a model's surface lies on itself; symmetries left out.

    A mug has them about its axis: but for its handle it looks alike. A bracket has half turns,
    after which half of it lies on itself. They are found by searching the model in itself.

    Returns:
        JSON values: ``turns``, 4x4 matrices ``model_from_model`` in metres, the best first, and
        ``near``, how many of the first ones are near-symmetries, with 80 % of the surface or more.
    """
    surface = prepare_surface(replace(model, symmetries=true_symmetries(model)))
    table = prepare_pairs(surface)
    # References from all sides, not from the first faces alone.
    references = take_evenly(torch.arange(len(table.points_m)), _SELF_REFERENCES)
    candidates, _ = vote_poses(table.points_m, table.frames[..., 0], references, table, _SELF_PEAKS)
    candidates = candidates[_distinct_turns(candidates, surface)[0]]

    # Refined as poses before a camera in the middle of the model, from where all is visible.
    points_m = surface.points_m - surface.middle_m
    starts = Rigid(candidates.R, candidates.t_m - surface.middle_m)
    candidates = refine_roughly(points_m, starts, surface, IcpConfig())
    candidates = Rigid(candidates.R, candidates.t_m + surface.middle_m)
    candidates = candidates[_distinct_turns(candidates, surface)[0]]

    # Products of two are candidates too, which fill gaps between those that were found.
    products = candidates[:, None] @ candidates
    products = Rigid(products.R.flatten(0, 1), products.t_m.flatten(0, 1))
    candidates = Rigid.cat([candidates, products])
    chosen, near = _distinct_turns(candidates, surface)
    return {"turns": candidates[chosen].matrix().tolist(), "near": near}


def _distinct_turns(turns: Rigid, surface: Surface) -> tuple[list[int], int]:
    """Choose the motions after which most of a surface lies on itself, the best first.

    None is within 12 degrees of a better one, of a symmetry, or of a product of these; one that is
    no near-symmetry is not within 60 degrees, since any small motion leaves the surface near
    itself.

    Returns:
        Indices of the chosen motions, and how many of them are near-symmetries.
    """
    # The share of the surface that each motion moves onto the surface.
    every = max(1, len(surface.points_m) // _SELF_COMPARED)
    local_m = turns.inverse().apply(surface.points_m[::every])
    index = surface.boxes.look_up(local_m)
    is_alike = (local_m - surface.points_m[index]).norm(dim=-1) < NEAR * surface.diameter_m
    cosine = ((surface.normals[index] @ turns.R.mT) * surface.normals[::every]).sum(-1)
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
    points_m, normals = _visible_from_outside(surface)
    step_m = STEP * surface.diameter_m
    while len(kept := thin(points_m, normals, step_m)) > _MODEL_POINTS:
        step_m *= _COARSER
    points_m = points_m[kept]
    frames = _frames(normals[kept])

    # All pairs of two different points, by feature. Within a feature they are shuffled, so that the
    # first ones are a sample of all.
    count = len(points_m)
    first, second = (~torch.eye(count, dtype=torch.bool)).nonzero(as_tuple=True)
    bins, turn_rad = _features(points_m, frames, first, second, surface.diameter_m)
    shuffle = torch.randperm(len(first), generator=torch.Generator().manual_seed(0))
    feature = _feature_index(bins.floor().long())[shuffle]
    feature, order = feature.sort(stable=True)
    order = shuffle[order]
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


def _visible_from_outside(
    surface: Surface,
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"]]:
    """Give the points that a far camera sees from anywhere, with normals toward it.

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
    is_visible = torch.stack(visible_from)
    cosine = directions @ surface.normals.T
    front = (is_visible & (cosine > _LEAST_COSINE)).any(0)
    back = (is_visible & (-cosine > _LEAST_COSINE)).any(0)
    points_m = torch.cat([surface.points_m[front], surface.points_m[back]])
    return points_m, torch.cat([surface.normals[front], -surface.normals[back]])


def _frames(normals: Float64[Tensor, "n 3"]) -> Float64[Tensor, "n 3 3"]:
    """Give each normal and two tangents, as columns."""
    least = torch.eye(3, dtype=torch.float64)[normals.abs().argmin(-1)]
    first = normalize(torch.linalg.cross(normals, least), dim=-1)
    return torch.stack([normals, first, torch.linalg.cross(normals, first)], -1)


def _features(
    points_m: Float64[Tensor, "n 3"],
    frames: Float64[Tensor, "n 3 3"],
    first: Int64[Tensor, " p"],
    second: Int64[Tensor, " p"],
    diameter_m: float,
) -> tuple[Float64[Tensor, "p 4"], Float64[Tensor, " p"]]:
    """Give the features of pairs of points, and the angle of the second about the first's normal.

    The features are the distance, the angles of both normals to the line between the points, and
    the angle between the normals; as fractions of bins.
    """
    offset_m = points_m[second] - points_m[first]
    local_m = (offset_m[:, None] @ frames[first]).squeeze(1)
    distance_m = offset_m.norm(dim=-1)
    divisor_m = distance_m.clamp(min=1e-12)
    n, m = frames[first, :, 0], frames[second, :, 0]
    cosines = torch.stack(
        [local_m[:, 0] / divisor_m, (m * offset_m).sum(-1) / divisor_m, (n * m).sum(-1)], -1
    )
    angles = cosines.clamp(-1, 1).arccos() * (ANGLES / math.pi)
    bins = torch.cat([(distance_m / (STEP * diameter_m))[:, None], angles], 1)
    return bins, torch.atan2(local_m[:, 2], local_m[:, 1])


def _feature_index(bins: Int64[Tensor, "*b 4"]) -> Int64[Tensor, "*b"]:
    """Give the index of four bins together; values beyond the bins are in the last one."""
    d, a, b, c = bins.clamp(min=0).unbind(-1)
    a, b, c = (angle.clamp(max=ANGLES - 1) for angle in (a, b, c))
    return ((d.clamp(max=DISTANCES) * ANGLES + a) * ANGLES + b) * ANGLES + c


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
    frames = _frames(normals)
    peaks = min(peaks, len(table.points_m))
    if use_numba(points_m):
        from depthpose.pose.compiled.pairs import vote

        shape = (len(references), peaks)
        number = torch.zeros(shape, dtype=torch.int64)
        turn_bin = torch.zeros(shape, dtype=torch.int64)
        votes = torch.zeros(shape, dtype=torch.float64)
        vote(
            finite_array(points_m.numpy()), finite_array(frames.numpy()), references.numpy(),
            table.bounds.numpy(), table.first.numpy(), table.turn_rad.numpy(), len(table.points_m),
            STEP * table.surface.diameter_m, number.numpy(), turn_bin.numpy(), votes.numpy(),
        )  # fmt: skip
        number = number.flatten()
        turn_bin = turn_bin.flatten()
        votes = votes.flatten()
    else:
        chunks = [_peaks(points_m, frames, chunk, table, peaks)
                  for chunk in references.split(_REFERENCES_AT_ONCE)]  # fmt: skip
        number, turn_bin, votes = (torch.cat(parts) for parts in zip(*chunks, strict=True))

    # The poses that put model points and their normals on reference points, by turns about these.
    angle = ((turn_bin + 0.5) * (2 * math.pi / TURNS)).double()
    turn = rotation_by(angle[:, None] * angle.new_tensor([1.0, 0.0, 0.0]))
    reference = references.repeat_interleave(peaks)
    R = frames[reference] @ turn @ table.frames[number].mT
    t_m = points_m[reference] - (R @ table.points_m[number][..., None]).squeeze(-1)
    return Rigid(R, t_m), votes


def _peaks(
    points_m: Float64[Tensor, "n 3"],
    frames: Float64[Tensor, "n 3 3"],
    references: Int64[Tensor, " r"],
    table: PairTable,
    peaks: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Vote without numba; give model points, bins of turns, and votes of each reference's peaks."""
    diameter_m = table.surface.diameter_m
    model_points = len(table.points_m)

    # Pairs of each reference and the points that are neither too near nor too far.
    step_m = STEP * diameter_m
    distance_m = (points_m[references, None] - points_m).norm(dim=-1)
    is_paired = (distance_m > step_m) & (distance_m < DISTANCES * step_m)
    row, second = is_paired.nonzero(as_tuple=True)
    feature, turn_rad = _features(points_m, frames, references[row], second, diameter_m)

    # Each looks up its own bins and, in each of its four features, the nearest other bin.
    own_bin = feature.floor().long()
    aside = torch.where(feature - own_bin < 0.5, -1, 1)
    beside = own_bin[:, None] + aside[:, None] * torch.eye(4, dtype=torch.int64)
    keys = torch.cat([_feature_index(own_bin)[:, None], _feature_index(beside)], 1)
    model_pairs = (table.bounds[keys + 1] - table.bounds[keys]).long()
    is_own_again = keys[:, 1:] == keys[:, :1]  # beyond the last bin
    model_pairs[:, 1:][is_own_again] = 0

    # A turn votes once for a feature: of look-ups that have both alike the first counts.
    turn_bin = _turn_bin((turn_rad + math.pi) / (2 * math.pi))
    vote = (row[:, None] * len(table.bounds) + keys) * TURNS + turn_bin[:, None]
    vote = torch.where(model_pairs > 0, vote, -1).flatten()
    lookup = _first_of_each(vote)
    lookup = lookup[vote[lookup] >= 0].sort().values

    # The model's pairs of each look-up; of a frequent feature the first ones.
    alike = model_pairs.flatten()[lookup]
    read = alike.clamp(max=MOST_ALIKE)
    of_read = torch.repeat_interleave(torch.arange(len(read)), read)
    offset = torch.arange(len(of_read)) - (read.cumsum(0) - read)[of_read]
    model_pair = table.bounds[keys.flatten()[lookup][of_read]] + offset
    scene_pair = lookup[of_read] // keys.shape[1]

    # A vote for a model point and a turn; rare features weigh more, and neighbouring turns share.
    turn = (turn_rad[scene_pair] - table.turn_rad[model_pair]) / (2 * math.pi) % 1
    model_point = row[scene_pair] * model_points + table.first[model_pair]
    weight = 1 / alike[of_read].double().sqrt()
    bins = len(references) * model_points * TURNS
    votes = torch.bincount(model_point * TURNS + _turn_bin(turn), weight, minlength=bins)
    votes = votes.reshape(len(references), model_points, TURNS)
    votes = 2 * votes + votes.roll(1, -1) + votes.roll(-1, -1)

    # The best turn of each model point, and of these the best model points.
    most, best_turn = votes.max(-1)
    best = most.topk(peaks)
    number = best.indices
    return number.flatten(), best_turn.gather(1, number).flatten(), best.values.flatten()


def _turn_bin(share: Float64[Tensor, " n"]) -> Int64[Tensor, " n"]:
    """Give the bin of a turn, which is a share of the full circle."""
    return (share * TURNS).long().clamp(max=TURNS - 1)


def _first_of_each(numbers: Int64[Tensor, " n"]) -> Int64[Tensor, " m"]:
    """Give the index of the first occurrence of each distinct number, in the order of numbers."""
    distinct, index = numbers.unique(return_inverse=True)
    first = torch.full((len(distinct),), len(numbers))
    return first.scatter_reduce_(0, index, torch.arange(len(numbers)), "amin")


def _score_poses(
    points_m: Float64[Tensor, "n 3"],
    normals: Float64[Tensor, "n 3"],
    poses: Rigid,
    surface: Surface,
) -> Float64[Tensor, " b"]:
    """Score poses: points near the surface, by how normals fit, less contradictions.

    These are free-space violations and part of the unobserved surface.
    """
    inverse = poses.inverse()
    local_m = points_m[:_SCORED_POINTS] @ inverse.R.mT + inverse.t_m[:, None]
    local_normals = normals[:_SCORED_POINTS] @ inverse.R.mT
    index = surface.boxes.look_up(local_m)
    limit_m = _NEAR_ROUGHLY * surface.diameter_m
    is_near = (local_m - surface.points_m[index]).norm(dim=-1) < limit_m
    cosine = (local_normals * surface.normals[index]).sum(-1).abs()
    free_space_violation, unobserved = look_along_rays(points_m, poses, surface, every=_RAYS_EVERY)
    support = (is_near * cosine).mean(-1)
    return support - free_space_violation - _UNOBSERVED_WEIGHT * unobserved
