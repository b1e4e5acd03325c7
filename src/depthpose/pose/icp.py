"""Point-to-plane ICP: refines poses of a model's surface on a cloud."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, cross_matrix, perturb, rotation_by
from depthpose.pose.compiled import (
    GRAZING,
    LOOKED_UP,
    ON_RAY,
    SEARCHED,
    SLACK,
    use_numba,
)
from depthpose.pose.config import IcpConfig
from depthpose.pose.surface import Surface, finite_array, look_along_rays

_CONVERGED = 3e-4  # stop when a step turns [rad] and shifts [diameters] by less than this
_TURN_RAD = math.radians(15)  # by how much further starts are turned
_ROUGH_LIMITS = (3.0, 2.4, 2.0, 1.6, 1.4, 1.2, 1.0, 1.0, 1.0, 1.0)
"""Limits of the rough steps, over the last limit of the exact ones: starts begin farther off."""
_ROUGH_POINTS = 100  # points of the cloud that refine and compare starts
_OCCLUDING_POINTS = 1000  # points of the cloud that show what a pose would occlude
_UNOBSERVED_WEIGHT = 0.3  # of a score: below 1, for something may occlude what is not observed
_OTHER = 0.1  # mean distance between the points of two poses, in diameters, from which they are two
_MOST_OTHERS = 3  # local minima beside the best that are kept
_TRUST = 0.02
"""How much better another pose must score than the first, in shares of the points near the surface:
a plane fits many places, and noise would choose among them. A start's rough end must score better
by as much than its exact end to be preferred."""

_BLOCKS = (0.15, 0.2, 0.3, 0.4)  # sides of the blocks of the jackknife, in diameters
_LEAST_REMAINING = 0.03
"""Share of the information that counts as remaining where a block is left out: else a block that
alone constrains a direction would make it infinitely uncertain."""
_LEAST_SLOPE = 0.25  # least information of the weighted residuals, over that of constant weights


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedPose:
    """A refined pose, with leading batch axes of the poses that it began from."""

    camera_from_model: Rigid  #: the pose
    #: of (rotation, translation) as :class:`~depthpose.pose.types.PoseFit` says, from the
    #: residuals, of which neighbours may be alike, and an offset of all readings along the ray
    #: (``IcpConfig.sensor_offset_m``); what the surface does not fix (a turn of a ball) is far too
    #: uncertain to be missed. Local: of this minimum alone, whether it is the right one or not.
    covariance: Float[Tensor, "*batch 6 6"]
    residual_m: Float[Tensor, "*batch"]  #: root mean square distance to the surface, of what counts
    inlier_share: Float[Tensor, "*batch"]  #: share of the points within the last limit


class BestStart(NamedTuple):
    """The best of several refined poses."""

    refined: RefinedPose  #: the best
    start: int  #: number of the initial pose that it began from
    others: Rigid  #: the best poses beside it, three at most, roughly refined


class _NormalEquations(NamedTuple):
    """Gauss-Newton step of poses: ``information @ motion = gradient``, and what it is made of."""

    information: Float64[Tensor, "*batch 6 6"]
    gradient: Float64[Tensor, "*batch 6"]
    jacobian: Float64[Tensor, "*batch n 6"]  # of the residuals by (rotation, translation)
    weight: Float64[Tensor, "*batch n"]
    residual_m: Float64[Tensor, "*batch n"]
    rms_m: Float64[Tensor, "*batch"]  # of the weighted residuals; infinite where no point counts


def tukey_weight(square_m2: Float64[Tensor, "*n"], limit_m: float) -> Float64[Tensor, "*n"]:
    """Give Tukey's weight of squared distances: 1 at 0, and 0 from the limit on.

    It is the loss of every ICP. Another one is written here, in ``_influence_slope``, and as
    ``tukey_weight`` of ``compiled/points.py``.
    """
    return (1 - square_m2 / limit_m**2).clamp(min=0).square()


def _influence_slope(
    weight: Float64[Tensor, "*batch n"], residual_m: Float64[Tensor, "*batch n"], limit_m: float
) -> Float64[Tensor, "*batch n"]:
    """Give the derivative of weight times residual by the residual, for :func:`tukey_weight`."""
    root = weight.sqrt()
    return root * (root - 4 * (residual_m / limit_m).square())


def refine_pose(
    points_m: Float[Tensor, "n 3"],
    initial: Rigid,
    surface: Surface,
    config: IcpConfig | None = None,
) -> RefinedPose:
    """Move poses so that the cloud lies on the surface; all of a batch at once.

    Every point of a partial cloud has a place on the whole model, so points seek the surface and
    not the reverse. Each step minimises ``sum w (n . (T^-1 x - s))^2`` over the nearest surface
    point ``s`` with normal ``n`` (Chen and Medioni 1991) that faces the camera; the weight is
    Tukey's, and its limit shrinks from ``start_distance`` to ``end_distance``. After half of
    the steps ``s`` is where the ray of ``x`` meets the surface: noise is along the ray, and the
    nearest point would be on another face where it errs inward near an edge, and draw the model
    toward the camera.

    Where no point of the cloud comes near the surface a pose stays as it was, with an
    ``inlier_share`` of 0.

    Args:
        points_m: of the object, in the camera frame.
        initial: poses to begin from, ``camera_from_model``; one or a batch.
        surface: of :func:`~depthpose.pose.surface.prepare_surface`.
        config: limits and number of steps.

    Raises:
        InputError: there is no point, or one is not finite.
    """
    config = IcpConfig() if config is None else config
    # The limit shrinks in even ratios over half of the steps; then it is kept, and checked by.
    start = config.start_distance_diameters
    end = config.end_distance_diameters
    half = max(1, config.iterations // 2)
    shares = [start * (end / start) ** min(1.0, i / half) for i in range(config.iterations)]
    limits_m = [share * surface.diameter_m for share in (*shares, end)]
    pose, index = _iterate(
        points_m, config.cloud_points, initial.double(), surface, limits_m, is_exact=True
    )

    # Uncertainty about the middle of the cloud: of the residuals, and of an offset along the ray.
    cloud = take_evenly(points_m.double(), config.cloud_points)
    equations = _normal_equations(cloud, pose, surface, limits_m[-1], index, ON_RAY)
    covariance = _covariance(cloud, equations, limits_m[-1], surface.diameter_m)
    middle_m = cloud.mean(0)
    ray = torch.nn.functional.normalize(middle_m, dim=0)
    offset_m = config.sensor_offset_m * torch.cat([torch.zeros(3), ray])
    covariance = covariance + torch.outer(offset_m, offset_m)

    # About the camera: w x (p - c) + v = w x p + (v + c x w).
    eye = torch.eye(3, dtype=torch.float64)
    zero = torch.zeros(3, 3, dtype=torch.float64)
    shift = torch.cat([torch.cat([eye, zero], 1), torch.cat([cross_matrix(middle_m), eye], 1)])
    return RefinedPose(
        camera_from_model=Rigid(pose.R.to(points_m), pose.t_m.to(points_m)),
        covariance=(shift @ covariance @ shift.mT).to(points_m),
        residual_m=equations.rms_m.to(points_m),
        inlier_share=(equations.weight > 0).to(points_m).mean(-1),
    )


def refine_best(
    points_m: Float[Tensor, "n 3"],
    initial: Rigid,
    surface: Surface,
    config: IcpConfig | None = None,
) -> BestStart:
    """Refine poses, and rotations of each; give the one that explains the cloud best.

    All are refined roughly, with some of the points and a table of nearest samples
    (:class:`~depthpose.pose.surface.Boxes`). Each is scored by the share of points near the
    surface, less free-space violations and part of the unobserved surface. The best is refined
    exactly, in half of the steps.

    Args:
        points_m: of the object, in the camera frame.
        initial: ``camera_from_model``, one or several; the first is trusted most.
        surface: of :func:`~depthpose.pose.surface.prepare_surface`.
        config: ``starts`` and what :func:`refine_pose` takes.

    Raises:
        InputError: there is no point, or one is not finite.
    """
    config = IcpConfig() if config is None else config
    initial = Rigid(initial.R.reshape(-1, 3, 3), initial.t_m.reshape(-1, 3))
    starts = _rotated_starts(initial.double(), surface, config.starts)
    rough = refine_roughly(points_m, starts, surface, config)
    end_m = config.end_distance_diameters * surface.diameter_m
    score = _score(points_m, rough, surface, end_m)
    best = int(score.argmax())

    is_initial = best < len(initial.R)
    start = initial[best] if is_initial else None
    refined = _refine_exactly(points_m, start, rough[best], surface, config)
    pose = refined.camera_from_model.double()
    return BestStart(refined, best % len(initial.R), _distinct_poses(rough, score, pose, surface))


def _refine_exactly(
    points_m: Float[Tensor, "n 3"],
    start: Rigid | None,
    rough: Rigid,
    surface: Surface,
    config: IcpConfig,
) -> RefinedPose:
    """Refine the best start exactly, in half of the steps.

    From the start itself, where it was no rotated one: rough steps let a pose drift along what
    little constrains. From the rough end, where that explains the cloud better: then the start was
    farther off than exact steps reach.
    """
    half = replace(config, iterations=(config.iterations + 1) // 2)
    if start is not None:
        from_start = refine_pose(points_m, start, surface, half)
        ends = Rigid.stack([from_start.camera_from_model.double(), rough])
        end_m = config.end_distance_diameters * surface.diameter_m
        is_rough_better = float(_score(points_m, ends, surface, end_m).diff()) > 0
        if not is_rough_better:
            return from_start
    near = replace(half, start_distance_diameters=config.end_distance_diameters)
    return refine_pose(points_m, rough, surface, near)


def _rotated_starts(poses: Rigid, surface: Surface, number: int) -> Rigid:
    """Give poses, then all of them rotated about the object's middle by each of the camera's axes.

    ``number``: of starts from each pose, 1 to 7: it alone, then rotated one way and the other.
    """
    axes = torch.eye(3, dtype=torch.float64)
    axes = torch.cat([torch.zeros(1, 3).double(), axes, -axes])[:number]
    rotations = rotation_by(_TURN_RAD * axes)[:, None]
    middle_m = poses.R @ surface.points_m.mean(0) + poses.t_m
    t_m = (rotations @ (poses.t_m - middle_m)[..., None]).squeeze(-1) + middle_m
    return Rigid((rotations @ poses.R).flatten(0, 1), t_m.flatten(0, 1))


def _distinct_poses(
    poses: Rigid, score: Float64[Tensor, " b"], best: Rigid, surface: Surface
) -> Rigid:
    """Give up to three poses, the best first, that differ from each other and from ``best``.

    They differ where their surfaces lie apart: poses that differ by a symmetry are one.
    """
    chosen: list[int] = []
    points_m = surface.points_m[:: max(1, len(surface.points_m) // 50)]
    copies_m = surface.symmetries.apply(points_m)
    for k in score.argsort(descending=True).tolist():
        if len(chosen) == _MOST_OTHERS or score[k] == -torch.inf:
            break
        better = Rigid.stack([best, *(poses[j] for j in chosen)])
        moved_m = (better.inverse() @ poses[k]).apply(points_m)
        gap_m = (moved_m[:, None] - copies_m).norm(dim=-1).mean(-1)
        if float(gap_m.min()) > _OTHER * surface.diameter_m:
            chosen.append(k)
    return poses[chosen]


def refine_roughly(
    points_m: Float[Tensor, "n 3"], starts: Rigid, surface: Surface, config: IcpConfig
) -> Rigid:
    """Refine a batch of poses with a hundred of the points and a table of what lies near.

    Args:
        points_m: of the object, in the camera frame.
        starts: poses in float64, ``camera_from_model``.
        surface: of the model.
        config: its last limit.
    """
    end_m = config.end_distance_diameters * surface.diameter_m
    limits_m = [share * end_m for share in _ROUGH_LIMITS]
    return _iterate(points_m, _ROUGH_POINTS, starts, surface, limits_m, is_exact=False)[0]


def _iterate(
    points_m: Float[Tensor, "m 3"],
    max_points: int,
    pose: Rigid,
    surface: Surface,
    limits_m: list[float],
    *,
    is_exact: bool,
) -> tuple[Rigid, Int64[Tensor, "*batch n"]]:
    """Take Gauss-Newton steps of ICP until the poses move no more.

    Where numba is there the same steps are those of ``refine`` in ``compiled/poses.py``.

    Args:
        points_m: of the object, in the camera frame.
        max_points: so many of them are used, evenly taken.
        pose: one or a batch, ``camera_from_model``.
        surface: of the model.
        limits_m: distance at which a point no longer counts, for each step.
        is_exact: by the nearest sample, later the one on the ray; else by a table of what is near.

    Returns:
        The poses, and for each used point the number of its sample of the surface, or -1.
    """
    if len(points_m) == 0 or not bool(points_m.isfinite().all()):
        raise InputError(
            f"ICP of {len(points_m)} points, {int((~points_m.isfinite().all(-1)).sum())} of them "
            "not finite: leave those out, and refuse a cloud of none."
        )
    cloud = take_evenly(points_m.double(), max_points)
    if use_numba(cloud, pose.R, pose.t_m):
        from depthpose.pose.compiled.poses import refine

        parts = [part.detach().numpy() for part in (pose.R, pose.t_m)]
        R, t_m = (torch.from_numpy(finite_array(part).copy()) for part in parts)
        target = surface.target
        points = finite_array(cloud.detach().numpy())
        arrays = (points, R.view(-1, 3, 3).numpy(), t_m.view(-1, 3).numpy(), np.array(limits_m))
        places = np.full((len(arrays[2]), len(points)), -1)
        refine(*arrays, surface.diameter_m, _CONVERGED, target, is_exact, places)
        index = torch.from_numpy(np.append(target.tree.order, -1)[places])
        return Rigid(R, t_m), index.view(*t_m.shape[:-1], len(points))

    scale = torch.tensor([1.0] * 3 + [surface.diameter_m] * 3, dtype=torch.float64)
    moves = torch.ones_like(pose.t_m[..., :1])
    index = torch.full((*pose.t_m.shape[:-1], len(cloud)), -1)
    steps = len(limits_m) - 1
    for k, limit_m in enumerate(limits_m):
        # Correspondences.
        how = LOOKED_UP
        if is_exact:
            how = SEARCHED if 2 * k < steps else ON_RAY
        matches = match(cloud, pose, surface, limit_m, how, index)
        index = torch.where(moves > 0, matches, index)
        if k == steps:
            break

        # The motion that brings them together. About the middle itself: a turn by w about the
        # camera, which is D away, with the shift that makes it one about the object to first order
        # would leave the object w^2 D / 2 off.
        equations = _normal_equations(cloud, pose, surface, limit_m, index, how)
        motion = torch.linalg.solve(equations.information, equations.gradient) * moves
        turned = perturb(Rigid(pose.R, pose.t_m - cloud.mean(0)), motion)
        pose = Rigid(turned.R, turned.t_m + cloud.mean(0))

        # A pose that hardly moved at the last limit stays.
        if limit_m <= limits_m[-1] and how != SEARCHED:
            moves = ((motion / scale).abs() >= _CONVERGED).any(-1, keepdim=True).double()
            if not bool(moves.any()):
                break
    return pose, index


def _score(
    points_m: Float[Tensor, "n 3"], poses: Rigid, surface: Surface, limit_m: float
) -> Float64[Tensor, " b"]:
    """Score each pose: share of points near the surface, less distance and contradictions.

    The first pose is trusted more.
    """
    cloud = take_evenly(points_m.double(), _OCCLUDING_POINTS)
    free_space_violation, unobserved = look_along_rays(cloud, poses, surface, every=4)
    few = take_evenly(cloud, _ROUGH_POINTS)
    index = match(few, poses, surface, limit_m, LOOKED_UP)
    equations = _normal_equations(few, poses, surface, limit_m, index, LOOKED_UP)
    inlier_share = (equations.weight > 0).double().mean(-1)
    # Of equals, the nearer one.
    closeness = inlier_share - equations.rms_m / surface.diameter_m
    score = closeness - free_space_violation - _UNOBSERVED_WEIGHT * unobserved
    score[0] += _TRUST
    return score


def match(
    cloud_m: Float64[Tensor, "n 3"],
    pose: Rigid,
    surface: Surface,
    limit_m: float,
    how: int,
    before: Int64[Tensor, "*batch n"] | None = None,
) -> Int64[Tensor, "*batch n"]:
    """Give for each point the number of a visible sample of the surface, or -1.

    A sample is visible where its outer side faces the camera, or nearly; one without a known side
    always, and all where the camera is within a ball about the surface.

    Args:
        cloud_m: in the camera frame.
        pose: ``camera_from_model``, one or a batch.
        surface: of the model.
        limit_m: beyond it nothing is searched.
        how: ``LOOKED_UP``, by the table of boxes; ``SEARCHED``, the nearest; or ``ON_RAY``, the
            nearest to where the point's ray meets the plane of its sample ``before``.
        before: what was found a step earlier.
    """
    poses = Rigid(pose.R.reshape(-1, 3, 3), pose.t_m.reshape(-1, 3))
    local_m = poses.inverse().apply(cloud_m)
    eyes_m = poses.inverse().t_m[:, None]
    if how == LOOKED_UP:
        index = surface.boxes.look_up(local_m)
        is_facing = _is_visible(eyes_m, index, surface)
        index = torch.where(is_facing, index, surface.across[index])
        is_good = (index >= 0) & _is_visible(eyes_m, index, surface)
        return torch.where(is_good, index, -1).reshape(*pose.t_m.shape[:-1], -1)
    if how == ON_RAY and before is not None:
        sample = before.reshape(local_m.shape[:2])
        ray_m = local_m - eyes_m
        normal = surface.normals[sample]
        point_m = surface.points_m[sample]
        slope = (normal * ray_m).sum(-1, keepdim=True)
        share = (normal * (point_m - local_m)).sum(-1, keepdim=True) / slope
        is_met = slope.square() > GRAZING**2 * ray_m.square().sum(-1, keepdim=True)
        meet_m = torch.where(is_met, local_m + share * ray_m, point_m)
        local_m = torch.where(sample[..., None] >= 0, meet_m, local_m)

    # Ask for ever more of the nearest samples until one is visible.
    count = 1
    total = len(surface.points_m)
    index = torch.full(local_m.shape[:2], -1)
    of_pose, point = (index < 0).nonzero(as_tuple=True)
    while len(of_pose):
        queries_m = local_m[of_pose, point].numpy()
        _, nearest = surface.tree.query(
            queries_m, k=range(1, count + 1), distance_upper_bound=limit_m
        )
        nearest = torch.from_numpy(nearest)
        is_within = nearest < total  # beyond the limit the tree gives the number of its points
        nearest = nearest.clamp(max=total - 1)
        is_good = is_within & _is_visible(eyes_m[of_pose, 0, None], nearest, surface)
        first = is_good.int().argmax(1)
        is_done = is_good.any(1)
        index[of_pose[is_done], point[is_done]] = nearest[is_done, first[is_done]]
        is_open = ~is_done & is_within.all(1) & (count < total)
        of_pose = of_pose[is_open]
        point = point[is_open]
        count = min(8 * count, total)
    return index.reshape(*pose.t_m.shape[:-1], -1)


def _is_visible(
    eyes_m: Float64[Tensor, "b k 3"], index: Int64[Tensor, "b n"], surface: Surface
) -> Bool[Tensor, "b n"]:
    distance_m = (eyes_m - surface.ball_m[:3]).norm(dim=-1)
    toward_m = ((eyes_m - surface.points_m[index]) * surface.outward[index]).sum(-1)
    return (toward_m >= -SLACK * distance_m) | (distance_m <= surface.ball_m[3])


def _normal_equations(
    cloud: Float[Tensor, "n 3"],
    pose: Rigid,
    surface: Surface,
    limit_m: float,
    index: Int64[Tensor, "*batch n"],
    how: int,
) -> _NormalEquations:
    """Linearise the residuals about the middle of the cloud, where the parameters hardly correlate.

    ``index``: of each point's sample, -1 where it has none; ``how`` it was found, as
    :func:`match` takes it.
    """
    # In the camera frame, where the covariance is wanted.
    normal = surface.normals[index] @ pose.R.mT
    target = surface.points_m[index] @ pose.R.mT + pose.t_m[..., None, :]
    gap = cloud - target
    residual_m = (normal * gap).sum(-1)
    # Tukey's weight of the whole gap: a point beyond an edge is near the plane, not the surface.
    square = gap.square().sum(-1)
    if how == ON_RAY:  # along the ray it is the residual that counts
        along = (gap * cloud).sum(-1).square() / cloud.square().sum(-1)
        square = square - along + residual_m.square()
    weight = torch.where(index >= 0, tukey_weight(square, limit_m), 0.0)
    arm = target - cloud.mean(0)
    # Moving the model by (w, v) moves its point by w x arm + v, and lowers the residual.
    J = torch.cat([torch.linalg.cross(arm, normal), normal], -1)
    weighted = J.mT * weight[..., None, :]
    H = weighted @ J
    # Damped, so that a direction that no point constrains stays where it was.
    size = H.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None].clamp(min=1e-6)
    H = H + 1e-9 * size * torch.eye(6, dtype=torch.float64)
    total = weight.sum(-1)
    mean_square = (weight * residual_m.square()).sum(-1) / total.clamp(min=1e-12)
    return _NormalEquations(
        information=H,
        gradient=(weighted @ residual_m[..., None]).squeeze(-1),
        jacobian=J,
        weight=weight,
        residual_m=residual_m,
        rms_m=torch.where(total > 0, mean_square, torch.inf).sqrt(),
    )


def _covariance(
    cloud: Float64[Tensor, "n 3"], equations: _NormalEquations, limit_m: float, diameter_m: float
) -> Float64[Tensor, "*batch 6 6"]:
    """Give the covariance of a motion (rotation, translation) about the middle of the cloud.

    That of an M-estimator (Huber 1981), ``s^2 A^-1``, assumes independent residuals; those of a
    depth camera are correlated over many pixels. It is therefore inflated by a block jackknife
    (MacKinnon and White 1985): leave out one square block of the view at a time, and measure how
    far the pose moves. This is repeated for several block sizes, and the largest result counts,
    because the correlation length is not known. With few blocks a direction can look certain by
    chance, so no direction is inflated by less than the mean over all, or by less than 1.
    """
    # The information A of the residuals.
    slope = _influence_slope(equations.weight, equations.residual_m, limit_m)
    independent, whitening, spread_m = _independent_factor(equations, slope)
    inflation, directions = _jackknife_inflation(
        cloud, equations, slope, independent, whitening, spread_m, diameter_m
    )
    least = inflation.mean(-1, keepdim=True).clamp(min=1)
    factor = independent @ directions
    return (factor * torch.maximum(inflation, least)[..., None, :]) @ factor.mT


def _independent_factor(
    equations: _NormalEquations, slope: Float64[Tensor, "*batch n"]
) -> tuple[
    Float64[Tensor, "*batch 6 6"], Float64[Tensor, "*batch 6 6"], Float64[Tensor, "*batch 1 1"]
]:
    """Factor the covariance under independent residuals: ``F F^T = s^2 A^-1``.

    Gives the factor ``F``, its inverse and ``s``. ``A`` may be singular to rounding: its
    eigenvalues over those of the information are bounded below.
    """
    J = equations.jacobian
    cholesky = torch.linalg.cholesky(equations.information)
    relative = torch.linalg.solve_triangular(cholesky, J.mT * slope[..., None, :] @ J, upper=False)
    relative = torch.linalg.solve_triangular(cholesky, relative.mT, upper=False)
    values, vectors = torch.linalg.eigh(relative)
    size = values.clamp(min=_LEAST_SLOPE).sqrt()[..., None, :]
    weight = equations.weight
    square_sum = (weight * equations.residual_m.square()).sum(-1)
    variance = square_sum / (weight.sum(-1) - 6).clamp(min=1)
    spread_m = variance.clamp(min=1e-20).sqrt()[..., None, None]
    factor = spread_m * torch.linalg.solve_triangular(cholesky.mT, vectors / size, upper=True)
    inverse_factor = (cholesky @ vectors * size).mT / spread_m
    return factor, inverse_factor, spread_m


def _jackknife_inflation(
    cloud: Float64[Tensor, "n 3"],
    equations: _NormalEquations,
    slope: Float64[Tensor, "*batch n"],
    independent: Float64[Tensor, "*batch 6 6"],
    whitening: Float64[Tensor, "*batch 6 6"],
    spread_m: Float64[Tensor, "*batch 1 1"],
    diameter_m: float,
) -> tuple[Float64[Tensor, "*batch 6"], Float64[Tensor, "*batch 6 6"]]:
    """Give the variances of a block jackknife over the independent ones, and their directions.

    Of several block sizes those with the largest sum; the independent ones (1 each) where no size
    has a larger one. Directions are columns, in the coordinates of ``whitening``, the inverse of
    the factor ``independent``.
    """
    inverse_information = independent @ independent.mT / spread_m.square()
    J = equations.jacobian
    gradients = (equations.weight * equations.residual_m)[..., None] * J
    informations = (slope[..., None] * J)[..., None] * J[..., None, :]
    view_m = cloud[:, :2] / cloud[:, 2:] * cloud[:, 2].mean()
    eye = torch.eye(6, dtype=torch.float64)
    inflation = torch.ones_like(independent[..., 0])
    directions = eye.expand_as(independent)
    for side in _BLOCKS:
        cells = (view_m / (side * diameter_m)).floor() @ torch.tensor([1.0, 1e6]).double()
        _, block = cells.unique(return_inverse=True)
        count = int(block.max()) + 1
        gradient = gradients.new_zeros(*gradients.shape[:-2], count, 6)
        gradient = gradient.index_add_(-2, block, gradients)
        information = informations.new_zeros(*informations.shape[:-3], count, 6, 6)
        information = information.index_add_(-3, block, informations)

        # One Gauss-Newton step without each block, in units of the independent deviations.
        remaining = eye * (1 + _LEAST_REMAINING)
        remaining = remaining - information @ inverse_information[..., None, :, :]
        moves = torch.linalg.solve(remaining, gradient[..., None]).squeeze(-1)
        moves = whitening @ (moves @ inverse_information).mT
        values, vectors = torch.linalg.eigh(moves @ moves.mT)
        is_larger = values.sum(-1, keepdim=True) > inflation.sum(-1, keepdim=True)
        inflation = torch.where(is_larger, values, inflation)
        directions = torch.where(is_larger[..., None], vectors, directions)
    return inflation, directions
