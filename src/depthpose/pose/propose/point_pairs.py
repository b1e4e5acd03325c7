"""Point pair features: candidate poses of a known surface in a cloud, without a network.

Drost et al., Model Globally, Match Locally, CVPR 2010; which model points are kept, neighbouring
bins and the check of every candidate follow Vidal et al., Sensors 2018.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from torch import Tensor
from torch.nn.functional import normalize

from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose.compiled import array_of
from depthpose.pose.geometry.grid import thin_cloud
from depthpose.pose.geometry.surface import UNOBSERVED_WEIGHT, Surface, look_along_rays
from depthpose.pose.mesh.models import fibonacci_directions
from depthpose.pose.propose.pair_votes import (
    FEATURES,
    TURNS,
    cast_votes,
    describe_all_pairs,
)

STEP = 0.07
"""Least distance between points of the model, and width of a bin of the length of a pair, both over
the diameter."""
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
_SHUFFLE_SEED = 0
"""Seed of the order of alike pairs, so that a model always has the same table."""
_RAYS_EVERY = 16
"""One in this many points of the surface is used to count free-space violations."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PairTable:
    """Pairs of points of a model, sorted by their features."""

    #: of the surface that is visible from outside, 0.07 diameters apart or more, in the order of
    #: the model's faces.
    points_m: Float64[Tensor, "m 3"]
    bases: Float64[Tensor, "m 3 3"]  #: outward normal and two tangents of each point, as columns
    bounds: Int32[Tensor, " bounds"]  #: pairs ``bounds[k]`` to ``bounds[k + 1]`` have feature ``k``
    first: Int32[Tensor, " pairs"]  #: index of the first point of each pair
    #: angle of the second point about the normal of the first, from its first tangent; in bins of a
    #: full rotation divided by ``TURNS``.
    turn: Float32[Tensor, " pairs"]
    surface: Surface  #: of the model


def prepare_pairs(surface: Surface) -> PairTable:
    """Make the table of a surface's point pairs, once for the search in many clouds.

    Args:
        surface: of the model; normals may point to either side.
    """
    # Points of the visible surface, thinned until there are few enough.
    points_m, normals = _find_points_seen_from_afar(surface)
    step_m = STEP * surface.diameter_m
    chosen = thin_cloud(points_m, normals, step_m)
    while len(chosen) > _MODEL_POINTS:
        step_m *= _COARSER
        chosen = thin_cloud(points_m, normals, step_m)
    points_m = points_m[chosen]
    bases = _make_bases(normals[chosen])

    # All pairs of two different points, in the order of their first points: the number of each
    # pair's feature, and its angle.
    count = len(points_m)
    first_point = torch.arange(count).repeat_interleave(count - 1)
    bin_m = STEP * surface.diameter_m
    feature_array, turn_array = describe_all_pairs(array_of(points_m), array_of(bases), bin_m)
    feature = torch.from_numpy(feature_array)
    turn = torch.from_numpy(turn_array)

    # Sorted by feature. They are shuffled before, so that the first pairs of a feature are a random
    # sample of all of its pairs.
    generator = torch.Generator().manual_seed(_SHUFFLE_SEED)
    shuffle = torch.randperm(len(first_point), generator=generator)
    sorted_feature, sorting = feature[shuffle].sort(stable=True)
    order = shuffle[sorting]

    # Where the pairs of each feature begin.
    sizes = torch.bincount(sorted_feature, minlength=FEATURES)
    bounds = torch.cat([sizes.new_zeros(1), sizes.cumsum(0)])
    return PairTable(
        points_m=points_m,
        bases=bases,
        bounds=bounds.int(),
        first=first_point[order].int(),
        turn=turn[order].float(),
        surface=surface,
    )


def propose_poses(
    points_m: Float64[Tensor, "n 3"],
    normals: Float64[Tensor, "n 3"],
    table: PairTable,
    count: int,
    generator: torch.Generator,
) -> Rigid:
    """Propose poses of a model in a cloud: pairs of points vote, and the proposals are scored.

    Args:
        points_m: points of the cloud, about 0.05 diameters apart, in the camera frame.
        normals: of these points, toward the camera.
        table: pairs of the model.
        count: how many poses at most.
        generator: chooses the reference points.

    Returns:
        Poses ``camera_from_model``, the best first.
    """
    chosen = torch.randperm(len(points_m), generator=generator)[:_SCENE_POINTS]
    points_m = points_m[chosen]
    normals = normals[chosen]
    references = torch.arange(min(_REFERENCES, len(points_m)))
    poses, _ = vote_poses(points_m, normals, references, table, _PEAKS)
    scores = _score_poses(points_m, normals, poses, table.surface)
    best = scores.argsort(descending=True, stable=True)[:count]
    return poses[best]


def _find_points_seen_from_afar(
    surface: Surface,
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"]]:
    """Find the points of a surface that far cameras see, with normals toward them.

    A point of a thin sheet, both of whose sides are visible, is found twice.
    """
    # From which directions each point is visible.
    half = fibonacci_directions(_VIEWS // 2).double()
    directions = torch.cat([half, -half])
    is_visible = torch.stack([_mark_visible(surface, toward) for toward in directions])

    # The sides that face one of these cameras.
    cosine = directions @ surface.normals.T
    front = (is_visible & (cosine > _LEAST_COSINE)).any(0)
    back = (is_visible & (-cosine > _LEAST_COSINE)).any(0)
    points_m = torch.cat([surface.points_m[front], surface.points_m[back]])
    return points_m, torch.cat([surface.normals[front], -surface.normals[back]])


def _mark_visible(surface: Surface, toward: Float64[Tensor, "3"]) -> Bool[Tensor, " m"]:
    """Mark the points of a surface that a far camera in a direction sees, if they face it.

    In each cell of its image, points near the one nearest to the camera are visible.
    """
    # The cell of each point.
    across = torch.linalg.svd(toward[None]).Vh[1:]  # two directions along the image
    places = ((surface.points_m @ across.T) / surface.diameter_m * _CELLS).floor().long()
    column, row = (places - places.amin(0)).unbind(-1)
    rows = int(row.max()) + 1
    columns = int(column.max()) + 1
    cell = column * rows + row

    # The nearest point of each cell.
    toward_m = surface.points_m @ toward
    nearest_m = torch.full((columns * rows,), -torch.inf, dtype=torch.float64)
    nearest_m.scatter_reduce_(0, cell, toward_m, "amax")
    return toward_m > nearest_m[cell] - surface.diameter_m / _CELLS


def _make_bases(normals: Float64[Tensor, "n 3"]) -> Float64[Tensor, "n 3 3"]:
    """Make an orthonormal basis of each normal: it and two tangents, as columns."""
    # The first tangent is across the axis along which the normal points least.
    least = torch.eye(3, dtype=torch.float64)[normals.abs().argmin(-1)]
    first = normalize(torch.linalg.cross(normals, least), dim=-1)
    return torch.stack([normals, first, torch.linalg.cross(normals, first)], -1)


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
        points_m: points of the scene, about 0.05 diameters apart, in the camera frame.
        normals: of these points, toward the camera.
        references: indices of the points that vote with each of the others.
        table: pairs of the model.
        peaks: poses that each reference proposes, if the model has as many points.

    Returns:
        Poses ``camera_from_model`` and their votes, reference after reference.
    """
    bases = _make_bases(normals)
    peaks = min(peaks, len(table.points_m))
    best_point, best_turn, best_votes = cast_votes(
        array_of(points_m),
        array_of(bases),
        references.numpy(),
        table.bounds.numpy(),
        table.first.numpy(),
        table.turn.numpy(),
        len(table.points_m),
        STEP * table.surface.diameter_m,
        peaks,
    )
    model_point = torch.from_numpy(best_point).flatten()
    turn_bin = torch.from_numpy(best_turn).flatten()
    votes = torch.from_numpy(best_votes).flatten()

    # The poses that put model points and their normals on reference points, by turns about these:
    # about the first axis of the bases.
    angle = ((turn_bin + 0.5) * (2 * math.pi / TURNS)).double()
    turn = rotation_by(angle[:, None] * angle.new_tensor([1.0, 0.0, 0.0]))
    reference = references.repeat_interleave(peaks)
    R = bases[reference] @ turn @ table.bases[model_point].mT
    t_m = points_m[reference] - (R @ table.points_m[model_point][..., None]).squeeze(-1)
    return Rigid(R, t_m), votes


def _score_poses(
    points_m: Float64[Tensor, "n 3"],
    normals: Float64[Tensor, "n 3"],
    poses: Rigid,
    surface: Surface,
) -> Float64[Tensor, " b"]:
    """Score poses by the cloud, to rank proposals.

    A score is the share of points near the posed surface, by how their normals fit, less what
    contradicts the pose: points in free space, and a part of the unobserved surface.
    """
    # The cloud in the model frame, and the nearest points of the surface.
    inverse = poses.inverse()
    local_m = inverse.apply(points_m[:_SCORED_POINTS])
    local_normals = normals[:_SCORED_POINTS] @ inverse.R.mT
    nearest = surface.nearest(local_m, is_exact=False)
    is_near = nearest.distance_m < _NEAR_ROUGHLY * surface.diameter_m

    # What supports each pose, and what contradicts it.
    cosine = (local_normals * surface.normals[nearest.sample]).sum(-1).abs()
    support = (is_near * cosine).mean(-1)
    free_space_violation, unobserved = look_along_rays(points_m, poses, surface, every=_RAYS_EVERY)
    return support - free_space_violation - UNOBSERVED_WEIGHT * unobserved
