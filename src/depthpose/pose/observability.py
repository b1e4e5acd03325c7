"""How well an observation determines a pose, and the motions that it leaves free."""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, cross_matrix
from depthpose.pose.surface import NEAR, Surface
from depthpose.pose.types import Axis, Symmetries

_SAMPLED = 1000  # points of the cloud that say how well it determines a pose


def free_motions(axes: tuple[Axis, ...], camera_from_model: Rigid) -> Float[Tensor, "m 6"]:
    """Give the motions of the camera frame that turn the object about its axes of revolution.

    Unit vectors of (rotation, translation): along them no observation says anything, the variance
    is infinite, and the pose is valid all the same. Two axes make a ball, which is free to turn
    about the third too.
    """
    rows = []
    centre_m = Symmetries(continuous=axes).ball_centre_m
    if centre_m is not None:  # turns about two axes of a ball make those about every axis
        axes = tuple(Axis(direction=row, point_m=centre_m) for row in torch.eye(3).to(centre_m))
    for axis in axes if centre_m is not None else axes[:1]:
        direction = camera_from_model.R @ axis.direction.to(camera_from_model.R)
        point_m = camera_from_model.apply(axis.point_m.to(camera_from_model.R)[None])[0]
        # Turning by w about a line through c moves c nowhere: w x c + v = 0.
        motion = torch.cat([direction, torch.linalg.cross(point_m, direction)])
        rows.append(motion / motion.norm())
    return torch.stack(rows) if rows else camera_from_model.R.new_zeros(0, 6)


def observability(
    cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface, free: Float[Tensor, "m 6"]
) -> tuple[float, Float64[Tensor, "6"]] | None:
    """Measure how well the seen surface determines the pose: 0 where a motion is unobservable.

    A motion ``y = (d/2 w, v)`` about the middle of the cloud moves a surface point at ``a`` with
    normal ``n`` across itself by ``n . v + (a x n) . w``. The observability is the root mean square
    of that over the points near the surface, for the unit motion that moves it least (Gelfand et
    al., Geometrically Stable Sampling for the ICP Algorithm, 2003). Motions of declared symmetries
    (``free``) are left out. The weakest motion is given too: (rotation, translation at the middle
    of the cloud), of unit length after scaling. None where fewer than six points lie near the
    surface.
    """
    points = take_evenly(cloud_m.double(), _SAMPLED)
    local_m = pose.inverse().apply(points)
    index = surface.nearest(local_m)
    near = (local_m - surface.points_m[index]).norm(dim=-1) < NEAR * surface.diameter_m
    if int(near.sum()) < 6:
        return None
    normal = (surface.normals[index] @ pose.R.mT)[near]
    middle = points.mean(0)
    radius_m = surface.diameter_m / 2
    arm = points[near] - middle
    J = torch.cat([torch.linalg.cross(arm, normal) / radius_m, normal], -1)
    # Declared symmetries as motions about the middle, turns in metres at the radius.
    turn = free[:, :3].double()
    shift = free[:, 3:].double()
    motions = torch.cat([turn * radius_m, shift + turn @ cross_matrix(middle)], -1)
    _, _, rows = torch.linalg.svd(motions)  # the last ones are orthogonal to all of them
    basis = rows[int(torch.linalg.matrix_rank(motions, rtol=1e-9)) :].T
    values, vectors = torch.linalg.eigh(basis.T @ (J.T @ J / len(J)) @ basis)
    return float(values[0].clamp(min=0).sqrt()), basis @ vectors[:, 0]


def without_motions(
    covariance: Float[Tensor, "6 6"], free: Float[Tensor, "m 6"]
) -> Float[Tensor, "6 6"]:
    """Give the covariance where the pose does not move along ``free``: finite, and 0 along them."""
    if len(free) == 0:
        return covariance
    _, sizes, rows = torch.linalg.svd(free.double())
    basis = rows[int((sizes > 1e-9 * sizes[0]).sum()) :].T
    # Rotations and metres differ in size; the information of the rest is what counts.
    information = torch.linalg.inv(covariance.double())
    inner = torch.linalg.inv(basis.T @ information @ basis)
    return (basis @ inner @ basis.T).to(covariance)
