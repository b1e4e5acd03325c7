"""How well an observation determines a pose, and the motions that it leaves free."""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, cross_matrix
from depthpose.pose.geometry.surface import Surface
from depthpose.pose.types import Axis, Symmetries

_SAMPLED = 1000  # points of the cloud by which observability is measured


def free_motions(axes: tuple[Axis, ...], camera_from_model: Rigid) -> Float[Tensor, "m 6"]:
    """Compute the motions that rotate an object about its axes of revolution.

    No observation constrains a pose along them; it is valid all the same. An object with two axes
    is a ball, free to rotate about a third too.

    Args:
        axes: of revolution, in the model frame.
        camera_from_model: the pose.

    Returns:
        Unit vectors (rotation, translation) in the camera frame; none, one, or a ball's three.
    """
    # The axes: three of a ball, else one at most.
    centre_m = Symmetries(continuous=axes).ball_centre_m
    if centre_m is not None:
        axes = tuple(Axis(direction=row, point_m=centre_m) for row in torch.eye(3).to(centre_m))
    else:  # several that do not make a ball are parallel: one axis
        axes = axes[:1]

    # A rotation by w about a line through c leaves c where it is: w x c + v = 0.
    rows: list[Tensor] = []
    for axis in axes:
        direction = camera_from_model.R @ axis.direction.to(camera_from_model.R)
        point_m = camera_from_model.apply(axis.point_m.to(camera_from_model.R)[None])[0]
        motion = torch.cat([direction, torch.linalg.cross(point_m, direction)])
        rows.append(motion / motion.norm())
    return torch.stack(rows) if rows else camera_from_model.R.new_zeros(0, 6)


def observability(
    cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface, free: Float[Tensor, "m 6"]
) -> tuple[float, Float64[Tensor, "6"]] | None:
    """Measure how well the observed surface determines the pose: 0 where a motion is unobservable.

    A motion ``y = (d/2 w, v)`` about the middle of the cloud, with the diameter ``d``, moves a
    surface point at ``a`` with normal ``n`` across the surface by ``n . v + (a x n) . w``. The
    observability is the root mean square of that over the points near the surface, for the unit
    motion ``y`` for which it is least (Gelfand et al., Geometrically Stable Sampling for the ICP
    Algorithm, 2003).

    Args:
        cloud_m: points of the object, in the camera frame.
        pose: ``camera_from_model``.
        surface: of the model.
        free: motions of symmetries (:func:`free_motions`), which are left out.

    Returns:
        The observability and that weakest motion ``y``; None where fewer than six points lie near
        the surface.
    """
    # The points that lie near the surface.
    points_m = take_evenly(cloud_m.double(), _SAMPLED)
    local_m = pose.inverse().apply(points_m)
    nearest = surface.nearest(local_m)
    is_near = nearest.distance_m < surface.near_m
    if int(is_near.sum()) < 6:
        return None

    # Displacement of each point across the surface by each unknown.
    normal = (surface.normals[nearest.sample] @ pose.R.mT)[is_near]
    middle_m = points_m.mean(0)
    radius_m = surface.diameter_m / 2
    arm_m = points_m[is_near] - middle_m
    J = torch.cat([torch.linalg.cross(arm_m, normal) / radius_m, normal], -1)

    # A basis of the motions that no symmetry leaves free: those orthogonal to ``free``, which is
    # taken about the middle, with rotations in metres at the radius.
    rotation = free[:, :3].double()
    translation = free[:, 3:].double()
    motions = torch.cat([rotation * radius_m, translation + rotation @ cross_matrix(middle_m)], -1)
    _, _, rows = torch.linalg.svd(motions)
    rank = int(torch.linalg.matrix_rank(motions, rtol=1e-9))
    basis = rows[rank:].T

    # The mean square displacement is least for the eigenvector of the least eigenvalue.
    mean_square = J.T @ J / len(J)
    values, vectors = torch.linalg.eigh(basis.T @ mean_square @ basis)
    least = float(values[0].clamp(min=0).sqrt())
    return least, basis @ vectors[:, 0]


def without_motions(
    covariance: Float[Tensor, "6 6"], free: Float[Tensor, "m 6"]
) -> Float[Tensor, "6 6"]:
    """Condition the covariance of a pose on no motion along ``free``.

    Args:
        covariance: of (rotation, translation), which may be huge along these motions.
        free: unit vectors of (rotation, translation); without any the covariance stays as it is.

    Returns:
        The covariance of the other motions; it is 0 along ``free``.
    """
    if len(free) == 0:
        return covariance
    # A basis of the other motions.
    _, sizes, rows = torch.linalg.svd(free.double())
    rank = int((sizes > 1e-9 * sizes[0]).sum())
    basis = rows[rank:].T

    # To condition is to restrict the information, the inverse of the covariance, to them.
    information = torch.linalg.inv(covariance.double())
    inner = torch.linalg.inv(basis.T @ information @ basis)
    return (basis @ inner @ basis.T).to(covariance)
