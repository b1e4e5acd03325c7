"""Point-to-plane ICP: a pose slides onto the cloud along the model's surface."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, cross_matrix, perturb
from depthpose.pose.config import IcpConfig
from depthpose.pose.mesh import sample_surface, turn_about
from depthpose.pose.types import ObjectModel

_CONVERGED = 1e-4
"""Stop when a step turns by less than this [rad] and shifts by less than this in diameters."""
_TURN_RAD = math.radians(15)
"""By how much further starts are turned."""
_TRUST = 0.02
"""Another start must bring so large a share of the points nearer to the surface than the given one
to be believed: a plane fits many places, and noise would choose among them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """What of a model the refinement needs; made once, used for every cloud.

    Attributes:
        points_m: of the surface, in the model frame.
        normals: theirs; their side does not matter.
        diameter_m: of the object.
        tree: finds the nearest of them.
    """

    points_m: Float[Tensor, "m 3"]
    normals: Float[Tensor, "m 3"]
    diameter_m: float
    tree: KDTree


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """A refined pose, with leading batch axes of the poses that it began from.

    Attributes:
        camera_from_model: the pose.
        covariance: of (rotation, translation) as :class:`~depthpose.pose.types.PoseFit` says, from
            the curvature of the sum and the spread of the residuals, if the points were
            independent; what the surface does not fix (a turn of a ball) is far too uncertain to
            be missed.
        residual_m: root mean square distance to the surface, of the points that count.
        inlier_share: share of the points within the last limit of the surface.
    """

    camera_from_model: Rigid
    covariance: Float[Tensor, "*batch 6 6"]
    residual_m: Float[Tensor, "*batch"]
    inlier_share: Float[Tensor, "*batch"]


def prepare_surface(model: ObjectModel, config: IcpConfig | None = None) -> Surface:
    """Sample a model once for many refinements."""
    config = IcpConfig() if config is None else config
    points, normals = (part.double() for part in sample_surface(model, config.surface_points))
    return Surface(
        points_m=points,
        normals=normals,
        diameter_m=model.diameter_m,
        tree=KDTree(points.numpy()),
    )


def refine_pose(
    points_m: Float[Tensor, "n 3"],
    initial: Rigid,
    surface: Surface,
    config: IcpConfig | None = None,
) -> Refined:
    """Move poses so that the cloud lies on the surface; all of a batch at once.

    Every point of a partial cloud has a place on the whole model, so points seek the surface and
    not the reverse. Each step minimises ``sum w (n . (T^-1 x - s))^2`` over the nearest surface
    point ``s`` with normal ``n`` (Chen and Medioni 1991); the weight is Tukey's, and its limit
    shrinks from ``start_distance`` to ``end_distance``.

    Where no point of the cloud comes near the surface a pose stays as it was, with an
    ``inlier_share`` of 0.

    Args:
        points_m: of the object, in the camera frame.
        initial: poses to begin from, ``camera_from_model``; one or a batch.
        surface: of :func:`prepare_surface`.
        config: limits and number of steps.

    Raises:
        InputError: there is no point, or one is not finite.
    """
    config = IcpConfig() if config is None else config
    if len(points_m) == 0 or not bool(points_m.isfinite().all()):
        raise InputError(
            f"ICP of {len(points_m)} points, {int((~points_m.isfinite().all(-1)).sum())} of them "
            "not finite: leave those out, and refuse a cloud of none."
        )
    cloud = take_evenly(points_m.double(), config.cloud_points)
    pose = Rigid(initial.R.double(), initial.t_m.double())
    scale = torch.tensor([1.0] * 3 + [surface.diameter_m] * 3, dtype=torch.float64)
    for limit_m in _limits(config, surface.diameter_m):
        H, pull, _, _ = _normal_equations(cloud, pose, surface, limit_m)
        motion = torch.linalg.solve(H, pull)
        pose = perturb(pose, _about(motion, _middle(cloud)))
        if limit_m <= config.end_distance_diameters * surface.diameter_m and bool(
            ((motion / scale).abs() < _CONVERGED).all()
        ):
            break
    limit_m = config.end_distance_diameters * surface.diameter_m
    H, _, residual_m, weight = _normal_equations(cloud, pose, surface, limit_m)
    return _result(points_m, pose, (H, residual_m, weight), _middle(cloud))


def refine_best(
    points_m: Float[Tensor, "n 3"],
    initial: Rigid,
    surface: Surface,
    config: IcpConfig | None = None,
) -> Refined:
    """Refine one pose, and beside it ones turned from it; give what explains the cloud best.

    All begin with a quarter of the points; the best goes on with all of them.

    Args:
        points_m: of the object, in the camera frame.
        initial: ``camera_from_model``.
        surface: of :func:`prepare_surface`.
        config: ``starts`` and what :func:`refine_pose` takes.

    Raises:
        InputError: there is no point, or one is not finite.
    """
    config = IcpConfig() if config is None else config
    if config.starts == 1:
        return refine_pose(points_m, initial, surface, config)
    few = replace(config, cloud_points=max(100, config.cloud_points // 4))
    tried = refine_pose(points_m, _starts(initial, surface, config.starts), surface, few)
    # Points near the surface count; of equals, the nearer ones.
    value = tried.inlier_share - tried.residual_m / surface.diameter_m
    value[0] += _TRUST
    best = int(value.argmax())
    found = tried.camera_from_model
    slow = replace(config, start_distance_diameters=config.end_distance_diameters)
    return refine_pose(points_m, Rigid(found.R[best], found.t_m[best]), surface, slow)


def _starts(pose: Rigid, surface: Surface, count: int) -> Rigid:
    """Give the pose, and the same turned about axes through the middle of the object."""
    pose = Rigid(pose.R.double(), pose.t_m.double())
    middle_m = pose.apply(surface.points_m.mean(0)[None])[0]
    axes = torch.eye(3, dtype=pose.R.dtype)[: count - 1]
    angle = torch.tensor(_TURN_RAD, dtype=pose.R.dtype)
    turns = [turn_about(axis, middle_m, angle) @ pose for axis in axes]
    return Rigid(
        torch.stack([pose.R, *(turn.R for turn in turns)]),
        torch.stack([pose.t_m, *(turn.t_m for turn in turns)]),
    )


def _limits(config: IcpConfig, diameter_m: float) -> list[float]:
    """Shrink the limit in even ratios over half of the steps; then keep it."""
    start, end = config.start_distance_diameters, config.end_distance_diameters
    half = max(1, config.iterations // 2)
    shares = [start * (end / start) ** min(1.0, i / half) for i in range(config.iterations)]
    return [share * diameter_m for share in shares]


def _middle(cloud: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    return cloud.mean(0)


def _normal_equations(
    cloud: Float[Tensor, "n 3"], pose: Rigid, surface: Surface, limit_m: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Linearise about the middle of the cloud, where turning and shifting hardly mix."""
    inverse = pose.inverse()
    local = cloud @ inverse.R.mT + inverse.t_m[..., None, :]
    _, index = surface.tree.query(local.numpy(), workers=1)
    index = torch.from_numpy(index)
    # In the camera frame, where the covariance is wanted.
    normal = surface.normals[index] @ pose.R.mT
    target = surface.points_m[index] @ pose.R.mT + pose.t_m[..., None, :]
    gap = cloud - target
    residual_m = (normal * gap).sum(-1)
    # Tukey's weight of the whole gap: a point beyond an edge is near the plane, not the surface.
    weight = (1 - gap.square().sum(-1) / limit_m**2).clamp(min=0).square()
    arm = target - _middle(cloud)
    # Moving the model by (w, v) moves its point by w x arm + v, and lowers the residual.
    J = torch.cat([torch.linalg.cross(arm, normal), normal], -1)
    weighted = J.mT * weight[..., None, :]
    H = weighted @ J
    # A direction that no point speaks of stays where it was.
    size = H.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None].clamp(min=1e-6)
    H = H + 1e-9 * size * torch.eye(6, dtype=torch.float64)
    return H, (weighted @ residual_m[..., None]).squeeze(-1), residual_m, weight


def _about(motion: Float[Tensor, "*batch 6"], middle: Tensor) -> Float[Tensor, "*batch 6"]:
    """Turn (rotation, translation) about a point into one about the origin of the camera."""
    return motion @ _shift(middle).mT


def _shift(middle: Float[Tensor, "3"]) -> Float[Tensor, "6 6"]:
    # w x (p - c) + v = w x p + (v + c x w)
    eye, zero = torch.eye(3, dtype=middle.dtype), torch.zeros(3, 3, dtype=middle.dtype)
    return torch.cat([torch.cat([eye, zero], 1), torch.cat([cross_matrix(middle), eye], 1)])


def _result(
    points_m: Tensor, pose: Rigid, terms: tuple[Tensor, Tensor, Tensor], middle: Tensor
) -> Refined:
    H, residual_m, weight = terms
    total = weight.sum(-1)
    variance = (weight * residual_m.square()).sum(-1) / (total - 6).clamp(min=1)
    shift = _shift(middle)
    covariance = shift @ (variance[..., None, None] * torch.linalg.inv(H)) @ shift.mT
    mean_square = (weight * residual_m.square()).sum(-1) / total.clamp(min=1e-12)
    rms_m = torch.where(total > 0, mean_square, torch.inf).sqrt()
    return Refined(
        camera_from_model=Rigid(pose.R.to(points_m), pose.t_m.to(points_m)),
        covariance=covariance.to(points_m),
        residual_m=rms_m.to(points_m),
        inlier_share=(weight > 0).to(points_m).mean(-1),
    )
