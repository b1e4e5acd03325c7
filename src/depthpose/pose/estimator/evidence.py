"""By what poses that fit are compared: signals that need no truth, larger for a worse pose."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, cross_matrix
from depthpose.pose.cloud import local_planes
from depthpose.pose.estimator.prepare import Prepared
from depthpose.pose.surface import NEAR, Surface, look_along_rays

_SAMPLED = 1000
"""At most so many points of the cloud are used, evenly taken."""
_THINNED = 500
"""Of so many points 20 neighbours reach about 0.08 diameters: far enough for normals that a real
sensor's noise, alike from pixel to pixel, does not turn."""
_TILTED = 250
"""At so many of them the normal is looked at."""
_COMPARED = 100
"""At about so many points a copy is chosen."""
_FLOOR = 0.01
"""Added to a signal before its logarithm is taken."""


def disagreement(
    cloud: Prepared, outputs: Float[Tensor, "n k c"], copies_m: Float[Tensor, "b m k 3"]
) -> Float64[Tensor, " b"]:
    """Mean angle between the network's directions and those to the keypoints of each pose [rad].

    Args:
        cloud: what the network saw.
        outputs: its directions.
        copies_m: for each pose the keypoints of the copies that the network could not distinguish
            from it; the copy counts at which the directions point best, by their mean cosine.
    """
    directions = normalize(outputs[..., :3].double(), dim=-1)
    points_m = cloud.points_m.double()

    def cosines(some_m: Tensor, few: int) -> Float64[Tensor, "*batch m k"]:
        way = normalize(some_m[..., None, :, :] - points_m[::few, None], dim=-1)
        return (directions[::few] * way).sum(-1)

    best = torch.zeros(len(copies_m), dtype=torch.long)
    if copies_m.shape[1] > 1:
        few = max(1, len(points_m) // _COMPARED)
        best = cosines(copies_m, few).mean((-2, -1)).argmax(-1)
    chosen_m = copies_m[torch.arange(len(copies_m)), best]
    return cosines(chosen_m, 1).clamp(-1, 1).arccos().mean((-2, -1))


def log_signal(signal: float) -> float:
    """Take the logarithm in which signals are weighed: finite where there is none."""
    return math.log(_FLOOR + signal)


class CloudNormals(NamedTuple):
    """Some points of a cloud in float64, and their normals."""

    points_m: Float64[Tensor, "n 3"]
    normals: Float64[Tensor, "n 3"]


def cloud_normals(cloud_m: Float[Tensor, "n 3"]) -> CloudNormals:
    """Lay planes through some points of a cloud, once for all poses that are compared with it.

    Args:
        cloud_m: of the object, in the camera frame.
    """
    thinned_m = take_evenly(cloud_m.double(), _THINNED)
    some_m = take_evenly(thinned_m, _TILTED)
    return CloudNormals(some_m, local_planes(thinned_m, some_m)[0])


def surface_signals(
    cloud_m: Float[Tensor, "n 3"],
    poses: Rigid,
    surface: Surface,
    normals: CloudNormals | None = None,
) -> list[dict[str, float]]:
    """Say for each pose how well its surface explains the cloud, and the cloud the surface.

    A point seen through the posed surface contradicts the pose; surface that nobody saw may merely
    be occluded by something else.

    Args:
        cloud_m: of the object, in the camera frame.
        poses: of the object, a batch.
        surface: of its model.
        normals: of the cloud; None: they are computed.
    """
    normals = cloud_normals(cloud_m) if normals is None else normals
    limit_m = NEAR * surface.diameter_m
    points_m = take_evenly(cloud_m.double(), _SAMPLED)
    distance_m, _ = _nearest(points_m, poses, surface)
    is_near = distance_m < limit_m
    number = is_near.sum(-1)
    near_m2 = torch.where(is_near, distance_m.square(), 0.0).sum(-1) / number.clamp(min=1)
    front, unseen = look_along_rays(cloud_m.double(), poses, surface)
    columns = {
        "tilt": tilt_of(normals, poses, surface),
        "gap": torch.where(number > 0, near_m2.sqrt(), limit_m) / surface.diameter_m,
        "far": 1 - number / len(points_m),
        "front": front,
        "unseen": unseen,
    }
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]


def observability(
    cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface, free: Float[Tensor, "m 6"]
) -> tuple[float, Float64[Tensor, "6"]]:
    """Measure how well the seen surface determines the pose: 0 where a motion is unobservable.

    A motion ``y = (d/2 w, v)`` about the middle of the cloud moves a surface point at ``a`` with
    normal ``n`` across itself by ``n . v + (a x n) . w``. The observability is the root mean square
    of that over the points near the surface, for the unit motion that moves it least (Gelfand et
    al., Geometrically Stable Sampling for the ICP Algorithm, 2003).

    Args:
        cloud_m: of the object, in the camera frame.
        pose: of the object.
        surface: of its model.
        free: declared symmetries, as :func:`~depthpose.pose.voting.free_motions` gives them; they
            are left out.

    Returns:
        The observability, and the weakest motion: (rotation, translation at the middle of the
        cloud), unit length after scaling.
    """
    points = take_evenly(cloud_m.double(), _SAMPLED)
    distance_m, index = _nearest(points, pose, surface)
    near = distance_m < NEAR * surface.diameter_m
    weakest = torch.zeros(6, dtype=torch.float64)
    if int(near.sum()) < 6:
        return 0.0, weakest
    normal = (surface.normals[index] @ pose.R.mT)[near]
    middle, radius_m = points.mean(0), surface.diameter_m / 2
    arm = points[near] - middle
    J = torch.cat([torch.linalg.cross(arm, normal) / radius_m, normal], -1)
    basis = _complement(_scaled(free.double(), middle, radius_m))
    values, vectors = torch.linalg.eigh(basis.T @ (J.T @ J / len(J)) @ basis)
    return float(values[0].clamp(min=0).sqrt()), basis @ vectors[:, 0]


def without_motions(
    covariance: Float[Tensor, "6 6"], free: Float[Tensor, "m 6"]
) -> Float[Tensor, "6 6"]:
    """Give the covariance where the pose does not move along ``free``: finite, and 0 along them."""
    if len(free) == 0:
        return covariance
    basis = _complement(free.double())
    # Rotations and metres differ in size; the information of the rest is what counts.
    information = torch.linalg.inv(covariance.double())
    inner = torch.linalg.inv(basis.T @ information @ basis)
    return (basis @ inner @ basis.T).to(covariance)


def tilt_of(cloud: CloudNormals, poses: Rigid, surface: Surface) -> Float64[Tensor, " b"]:
    """Mean of 1 - |cosine| between normals of the cloud and of each posed surface near it."""
    distance_m, index = _nearest(cloud.points_m, poses, surface)
    is_near = distance_m < NEAR * surface.diameter_m
    cosine = (cloud.normals * (surface.normals[index] @ poses.R.mT)).sum(-1).abs()
    return 1 - torch.where(is_near, cosine, 0.0).sum(-1) / is_near.sum(-1).clamp(min=1)


def _nearest(
    points_m: Float64[Tensor, "n 3"], pose: Rigid, surface: Surface
) -> tuple[Float64[Tensor, "*batch n"], Int64[Tensor, "*batch n"]]:
    """Distance of each point to a posed surface, and the number of the point of it there."""
    local_m = pose.inverse().apply(points_m)
    index = surface.nearest(local_m)
    return (local_m - surface.points_m[index]).norm(dim=-1), index


def _scaled(
    motions: Float64[Tensor, "m 6"], middle: Float64[Tensor, "3"], radius_m: float
) -> Float64[Tensor, "m 6"]:
    """Write motions about the origin as motions about ``middle``, turns in metres at the radius."""
    turn, shift = motions[:, :3], motions[:, 3:]
    return torch.cat([turn * radius_m, shift + turn @ cross_matrix(middle)], -1)


def _complement(motions: Float64[Tensor, "m 6"]) -> Float64[Tensor, "6 r"]:
    """Give an orthonormal basis of what is orthogonal to all of the motions."""
    if len(motions) == 0:
        return torch.eye(6, dtype=torch.float64)
    _, values, rows = torch.linalg.svd(motions)
    rank = int((values > 1e-9 * values[0]).sum())
    return rows[rank:].T
