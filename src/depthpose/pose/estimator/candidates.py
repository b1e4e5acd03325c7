"""Poses that fit: the evidence against each, how likely each is, how they differ in words."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.cloud import ObjectCloud, local_planes
from depthpose.pose.config import EstimateConfig, IcpConfig
from depthpose.pose.mesh import (
    kept,
    mirror_deviation,
    near_symmetries,
    sample_surface,
    symmetry_transforms,
)
from depthpose.pose.mesh import true_symmetries as find_true
from depthpose.pose.refine import RefinedPose, refine_pose, refine_roughly
from depthpose.pose.surface import NEAR, Surface, look_along_rays
from depthpose.pose.types import ObjectModel
from depthpose.pose.voting.point_pairs import PairTable, find_turns

_SAMPLED = 1000
"""At most so many points of the cloud are used, evenly taken."""
_THINNED = 500
"""Of so many points 20 neighbours reach about 0.08 diameters: far enough for normals that a real
sensor's noise, alike from pixel to pixel, does not turn."""
_TILTED = 250
"""At so many of them the normal is looked at."""
_COMPARED = 100
"""At about so many points a copy is chosen."""
_SAME = 0.1
"""Mean distance of the model's points at two poses, in diameters, up to which they are one."""
_STEP = math.pi / 16
_ICP_POINTS = 250
"""Points of the cloud that refine candidates."""
_TURNED_STEPS = 4
"""Exact steps of ICP for turned poses, which were refined roughly: a mug has some 20."""
_LEFT, _LEFT_MORE = 0.01, 0.1
"""Of a mask's readings a pose may leave so large a share unexplained beyond what the best of its
turns leaves, and so many times as many: else what is seen, as a handle, says that it is none."""
_POINTS = 100
_ALONG = math.cos(math.radians(15))
_LONGER = 1.15
"""An axis is the longest or shortest where it differs by so much from the next."""


def disagreement(
    cloud: ObjectCloud, outputs: Float[Tensor, "n k c"], copies_m: Float[Tensor, "b m k 3"]
) -> Float64[Tensor, " b"]:
    """Mean angle between the network's directions and those to the keypoints of each pose [rad].

    ``copies_m``: for each pose the keypoints of the copies that the network could not distinguish
    from it; the copy counts at which the directions point best, by their mean cosine.
    """
    directions = normalize(outputs.double(), dim=-1)
    points_m = cloud.points_m.double()
    few = max(1, len(points_m) // _COMPARED)
    way = normalize(copies_m[..., None, :, :] - points_m[::few, None], dim=-1)
    best = (directions[::few] * way).sum(-1).mean((-2, -1)).argmax(-1)
    chosen_m = copies_m[torch.arange(len(copies_m)), best]
    way = normalize(chosen_m[:, None] - points_m[:, None], dim=-1)
    return (directions * way).sum(-1).clamp(-1, 1).arccos().mean((-2, -1))


def surface_signals(
    cloud_m: Float[Tensor, "n 3"], poses: Rigid, surface: Surface
) -> list[dict[str, float]]:
    """Say for each pose how well its surface explains the cloud, and the cloud the surface.

    A point seen through the posed surface contradicts the pose; surface that nobody saw may merely
    be occluded by something else.
    """
    tilt, limit_m = tilt_of(cloud_m, poses, surface), NEAR * surface.diameter_m
    points_m = take_evenly(cloud_m.double(), _SAMPLED)
    distance_m, _ = nearest_posed(points_m, poses, surface)
    is_near = distance_m < limit_m
    number = is_near.sum(-1)
    near_m2 = torch.where(is_near, distance_m.square(), 0.0).sum(-1) / number.clamp(min=1)
    front, unseen = look_along_rays(cloud_m.double(), poses, surface)
    columns = {
        "tilt": tilt,
        "gap": torch.where(number > 0, near_m2.sqrt(), limit_m) / surface.diameter_m,
        "far": 1 - number / len(points_m),
        "front": front,
        "unseen": unseen,
    }
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]


def tilt_of(cloud_m: Float[Tensor, "n 3"], poses: Rigid, surface: Surface) -> Float64[Tensor, " b"]:
    """Mean of 1 - |cosine| between planes laid through a cloud and each posed surface near it."""
    thinned_m = take_evenly(cloud_m.double(), _THINNED)
    some_m = take_evenly(thinned_m, _TILTED)
    normals, _ = local_planes(thinned_m, some_m)
    distance_m, index = nearest_posed(some_m, poses, surface)
    is_near = distance_m < NEAR * surface.diameter_m
    cosine = (normals * (surface.normals[index] @ poses.R.mT)).sum(-1).abs()
    return 1 - torch.where(is_near, cosine, 0.0).sum(-1) / is_near.sum(-1).clamp(min=1)


def nearest_posed(
    points_m: Float64[Tensor, "n 3"], pose: Rigid, surface: Surface
) -> tuple[Float64[Tensor, "*batch n"], Int64[Tensor, "*batch n"]]:
    """Distance of each point to a posed surface, and the number of the point of it there."""
    local_m = pose.inverse().apply(points_m)
    index = surface.nearest(local_m)
    return (local_m - surface.points_m[index]).norm(dim=-1), index


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseAmbiguities:
    """Pose ambiguities of a model."""

    same: Rigid  #: ``model_from_model`` of the copies that are one answer, the identity first
    near: Rigid  #: of those that are another answer and look nearly alike
    turns: Rigid  #: of those that look alike but for a part, as a mug's handle, the best first
    mostly: int  #: so many of the turns leave 80 % of the surface alike
    mirror: float  #: how far the mirror image deviates from the model, in diameters
    trained: Rigid  #: of those that a network was trained to treat as one, the identity first
    points_m: Float64[Tensor, "n 3"]  #: of the model, by which poses are compared
    middle_m: Float64[Tensor, "3"]  #: of its box
    axes: Float64[Tensor, "3 3"]  #: rows: its principal axes, from the longest
    lengths_m: Float64[Tensor, "3"]  #: its extent along each
    diameter_m: float  #: of the model


@dataclass(kw_only=True, eq=False)
class KnownObject:
    """An object, and what is made of its model once for all clouds, when it is first wanted."""

    number: int  #: among the models of an estimator
    model: ObjectModel
    surface: Surface
    copies: PoseAmbiguities | None = None
    pairs: PairTable | None = None


class Candidate(NamedTuple):
    """A pose that may be the right one, its covariance and what distance is left [m]."""

    pose: Rigid
    covariance: Float[Tensor, "6 6"]
    residual_m: float


def find_copies(model: ObjectModel, *, up_to_symmetry: bool) -> PoseAmbiguities:
    """Search a model for near-symmetries and turns, or count these as one answer with the true."""
    points_m = sample_surface(model, 2000)[0].double()
    near = [one.model_from_model for one in near_symmetries(model)]
    none = Rigid(torch.zeros(0, 3, 3).double(), torch.zeros(0, 3).double())
    alike = Rigid.stack(near) if near else none
    found = kept(model, find_turns, "turns")
    rows = torch.tensor(found["turns"], dtype=torch.float64).reshape(-1, 4, 4)
    turns, mostly = Rigid(rows[:, :3, :3], rows[:, :3, 3]), found["mostly"]
    true, mirror = find_true(model), mirror_deviation(model)
    same = symmetry_transforms(true, _STEP).double()
    if up_to_symmetry:
        every = symmetry_transforms(model.symmetries, _STEP)
        if near:  # what is between them is nearly alike too
            alike, turns, mostly = Rigid.cat([alike, turns[:mostly]]), turns[mostly:], 0
        same = Rigid.cat([same, every.double(), alike])
        alike = none
    trained = symmetry_transforms(model.symmetries, 2 * _STEP)
    compared_m = take_evenly(points_m, _POINTS)
    centre_m = true.ball_centre_m
    if centre_m is not None:  # every turn of a ball is the same pose: its centre alone says where
        compared_m = centre_m.to(points_m)[None]
        alike, turns, mostly = none, none, 0
    offset_m = points_m - points_m.mean(0)
    axes = torch.linalg.eigh(offset_m.T @ offset_m).eigenvectors.T.flip(0)
    along_m = points_m @ axes.T
    return PoseAmbiguities(
        same=same,
        near=alike,
        turns=turns,
        mostly=mostly,
        mirror=mirror,
        trained=trained.double(),
        points_m=compared_m,
        middle_m=(points_m.amin(0) + points_m.amax(0)) / 2,
        axes=axes,
        lengths_m=along_m.amax(0) - along_m.amin(0),
        diameter_m=model.diameter_m,
    )


def with_copies(known: KnownObject, *, up_to_symmetry: bool) -> KnownObject:
    """Search an object's near-symmetries, if nothing has yet."""
    if known.copies is None:
        known.copies = find_copies(known.model, up_to_symmetry=up_to_symmetry)
    return known


def near_symmetry_lines(model: ObjectModel) -> list[str]:
    """Say after which turns a model looks nearly as before, and by how much it deviates."""
    copies = find_copies(model, up_to_symmetry=False)
    here = Rigid(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    return [
        f"{difference_of(one.model_from_model, here, copies)} ({one.deviation:.1%})"
        for one in near_symmetries(model)
    ]


def turn_best(
    cloud_m: Float64[Tensor, "n 3"],
    best: Candidate,
    others: Rigid,
    known: KnownObject,
    icp: IcpConfig,
) -> tuple[Candidate, Rigid, list[Candidate]]:
    """Compare a refined pose with its turns: a handle that is seen says which of them it is.

    Args:
        cloud_m: all that a mask shows, not what one pose explains of it.
        best: the pose.
        others: at which ICP ended elsewhere.
        known: the object.
        icp: of the refinement.

    Returns:
        The pose, or the one that explains the most where it explains clearly less; and of the
        others and of its turns those that explain nearly as much.
    """
    copies, surface = known.copies, known.surface
    assert copies is not None, "with_copies comes first"
    turns = copies.turns[: copies.mostly]  # of less than that anything fits some copy
    if len(turns.R) == 0:
        return best, others, []
    rough = refine_roughly(cloud_m, best.pose @ turns, surface, icp)
    every = Rigid.cat([best.pose[None], others, rough])
    left, count = unexplained(cloud_m, every, surface), 1 + len(others.R)
    most = left.min() * (1 + _LEFT_MORE) + _LEFT
    icp = replace(icp, start_distance_diameters=icp.end_distance_diameters)
    if left[0] > (left.min() + most) / 2:  # what is answered explains more than what is named
        half = replace(icp, iterations=(icp.iterations + 1) // 2)
        refined = refine_pose(cloud_m, every[[int(left.argmin())]], surface, half)
        best = (*_near_points(refined), best)[0]
    others, rough = others[left[1:count] <= most], rough[left[count:] <= most]
    turned = best.pose @ turns
    turned = turned[unexplained(cloud_m, turned, surface) <= most]
    if len(turned.R) == 0:  # what is seen says which it is
        return best, others, []
    icp = replace(icp, iterations=_TURNED_STEPS, cloud_points=min(_ICP_POINTS, icp.cloud_points))
    found = _near_points(refine_pose(cloud_m, rough, surface, icp)) if len(rough.R) else []
    return best, others, found + [best._replace(pose=turned[k]) for k in range(len(turned.R))]


def unexplained(
    cloud_m: Float64[Tensor, "n 3"], poses: Rigid, surface: Surface
) -> Float64[Tensor, " b"]:
    """Share of a cloud that is not near each posed surface, by the table of what lies near."""
    local_m = poses.inverse().apply(take_evenly(cloud_m, _SAMPLED))
    gap_m = (local_m - surface.points_m[surface.boxes.look_up(local_m)]).norm(dim=-1)
    return (gap_m > NEAR * surface.diameter_m).double().mean(-1)


def find_candidates(
    cloud_m: Float[Tensor, "n 3"],
    best: Candidate,
    others: Rigid,
    turned: Sequence[Candidate],
    known: KnownObject,
    config: EstimateConfig,
    *,
    is_refined: bool,
) -> list[Candidate]:
    """Refine ``others``, at which ICP ended elsewhere, and the nearly symmetric copies of the best.

    The best comes first, then those that are other poses than it and than each other, then those
    of ``turned``. Where the best was not refined the copies stay where they are.
    """
    copies = known.copies
    assert copies is not None, "with_copies comes first"
    starts = Rigid.cat([others, best.pose @ copies.near])
    if is_refined and len(starts.R):
        short = replace(
            config.icp,
            iterations=(config.icp.iterations + 1) // 2,
            cloud_points=min(_ICP_POINTS, config.icp.cloud_points),
        )
        tried = _near_points(refine_pose(cloud_m.double(), starts, known.surface, short))
    else:
        tried = [best._replace(pose=starts[k]) for k in range(len(starts.R))]
    candidates = [best]
    for k, one in enumerate([*tried, *turned]):
        every = Rigid.stack([other.pose for other in candidates])[:, None] @ copies.same
        gap_m = one.pose.apply(copies.points_m) - every.apply(copies.points_m)
        apart = gap_m.norm(dim=-1).mean(-1).amin(-1) / copies.diameter_m
        # Of turned ones, twice as dense, one is near the truth wherever that is.
        least = _SAME if k < len(tried) else _SAME / 2
        if float(apart[0]) >= _SAME and float(apart.min()) >= least:
            candidates.append(one)
    return candidates


def _near_points(found: RefinedPose) -> list[Candidate]:
    """Give refined poses as candidates; leave out those that are near no point."""
    return [
        Candidate(found.camera_from_model[k], found.covariance[k], float(found.residual_m[k]))
        for k in range(len(found.inlier_share))
        if float(found.inlier_share[k]) > 0
    ]


def difference_of(pose: Rigid, from_pose: Rigid, copies: PoseAmbiguities) -> str:
    """Say how a pose differs from another: by which turn about which axis of the model."""
    turn = from_pose.R.double().mT @ pose.R.double()
    angle = math.degrees(float(geodesic_rad(turn, torch.eye(3, dtype=torch.float64))))
    middle_m = copies.middle_m[None]
    shift_m = float((pose.apply(middle_m) - from_pose.apply(middle_m)).norm())
    # The direction that the turn leaves alone, of the sign of a turn by up to 180 degrees.
    axis = torch.linalg.svd(turn - torch.eye(3, dtype=turn.dtype)).Vh[-1]
    skew = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    axis = axis if float(axis @ skew) >= 0 else -axis
    lengths, names = copies.lengths_m, {}
    if lengths[0] > _LONGER * lengths[1]:
        names[0] = "the long axis"
    if lengths[1] > _LONGER * lengths[2]:
        names[2] = "the short axis"
    if len(names) == 2:  # then the one between is known too
        names[1] = "the middle axis"
    x, y, z = (round(value, 2) + 0.0 for value in axis.tolist())  # no -0.00
    along = [name for k, name in names.items() if abs(float(copies.axes[k] @ axis)) > _ALONG]
    about = along[0] if along else f"the model's axis ({x:.2f}, {y:.2f}, {z:.2f})"
    words = f"turned by {angle:.0f} degrees about {about}"
    if shift_m > _SAME / 2 * copies.diameter_m:
        words += f" and shifted by {1000 * shift_m:.0f} mm"
    return words
