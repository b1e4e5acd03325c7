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
from depthpose.pose.compiled import GRAZING, SLACK, use_numba
from depthpose.pose.config import IcpConfig
from depthpose.pose.surface import Surface, finite_array, look_along_rays

_CONVERGED = 3e-4  # stop when a step rotates [rad] and shifts [diameters] by less than this
_START_ROTATION_RAD = math.radians(15)  # of further starts from the initial pose
_ROUGH_LIMITS = (3.0, 2.4, 2.0, 1.6, 1.4, 1.2, 1.0, 1.0, 1.0, 1.0)
"""Limits of the rough steps, over the last limit of the exact ones: starts begin farther off."""
_ROUGH_POINTS = 100  # points of the cloud that refine and compare starts
_OCCLUSION_POINTS = 1000  # points of the cloud by which free-space violations are counted
_UNOBSERVED_WEIGHT = 0.3  # in a score: below 1, for something may occlude what is not observed
_DISTINCT_DIAMETERS = 0.1  # mean distance between the surfaces of two poses that are distinct
_MOST_OTHERS = 3  # local minima beside the best that are returned
_FIRST_POSE_BONUS = 0.02
"""Added to the score of the first pose, a share of points near the surface: another one must be
better by more, since a plane fits many places and noise would choose among them."""

_BLOCK_DIAMETERS = (0.15, 0.2, 0.3, 0.4)  # sides of the blocks of the jackknife
_LEAST_REMAINING = 0.03
"""Share of the information that counts as remaining where a block is left out: else a block that
alone constrains a direction would make it infinitely uncertain."""
_LEAST_SLOPE = 0.25
"""Least information of the residuals with Tukey's weights as they change with the residual, over
that with the weights held constant."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedPose:
    """A refined pose, with leading batch axes of the poses that it began from."""

    camera_from_model: Rigid  #: the pose
    #: of (rotation, translation) as in :class:`~depthpose.pose.types.PoseFit`. It allows for
    #: correlated residuals and for an offset of all readings along the ray
    #: (``IcpConfig.sensor_offset_m``). A motion that the surface leaves free, such as a rotation of
    #: a ball, has a very large variance. It describes this local minimum, right or wrong.
    covariance: Float[Tensor, "*batch 6 6"]
    residual_m: Float[Tensor, "*batch"]  #: weighted root mean square distance to the surface
    inlier_share: Float[Tensor, "*batch"]  #: share of the points within the last limit


class BestStart(NamedTuple):
    """The best of several refined poses."""

    refined: RefinedPose  #: the best
    others: Rigid  #: the best poses beside it, three at most, roughly refined


class _NormalEquations(NamedTuple):
    """Gauss-Newton step of poses, ``information @ motion = gradient``, and its residuals."""

    information: Float64[Tensor, "*batch 6 6"]
    gradient: Float64[Tensor, "*batch 6"]
    jacobian: Float64[Tensor, "*batch n 6"]  # of the residuals by (rotation, translation)
    weight: Float64[Tensor, "*batch n"]
    residual_m: Float64[Tensor, "*batch n"]
    rms_m: Float64[Tensor, "*batch"]  # of the weighted residuals; infinite where no point counts


def tukey_weight(square_m2: Float64[Tensor, "*n"], limit_m: float) -> Float64[Tensor, "*n"]:
    """Give Tukey's weight of squared distances: 1 at 0, and 0 from the limit on.

    Every ICP weights its residuals so. To use another loss, change this function,
    ``_influence_slope`` and ``tukey_weight`` in ``compiled/points.py``.
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
    # The limit shrinks in even ratios over half of the steps, then stays. A last limit is for the
    # residuals of the final pose.
    start = config.start_distance_diameters
    end = config.end_distance_diameters
    half = max(1, config.iterations // 2)
    limits = [start * (end / start) ** min(1.0, i / half) for i in range(config.iterations)]
    limits_m = [limit * surface.diameter_m for limit in (*limits, end)]
    pose, index = _iterate(
        points_m, config.cloud_points, initial.double(), surface, limits_m, is_exact=True
    )

    # Covariance about the middle of the cloud, of the residuals and of an offset along the ray.
    cloud_m = take_evenly(points_m.double(), config.cloud_points)
    equations = _normal_equations(cloud_m, pose, surface, limits_m[-1], index, is_along_rays=True)
    covariance = _covariance(cloud_m, equations, limits_m[-1], surface.diameter_m)
    middle_m = cloud_m.mean(0)
    ray = torch.nn.functional.normalize(middle_m, dim=0)
    offset_m = config.sensor_offset_m * torch.cat([torch.zeros(3), ray])
    covariance = covariance + torch.outer(offset_m, offset_m)

    # The same about the camera: w x (p - c) + v = w x p + (v + c x w).
    eye = torch.eye(3, dtype=torch.float64)
    zero = torch.zeros(3, 3, dtype=torch.float64)
    camera_from_middle = torch.cat(
        [torch.cat([eye, zero], 1), torch.cat([cross_matrix(middle_m), eye], 1)]
    )
    covariance = camera_from_middle @ covariance @ camera_from_middle.mT
    return RefinedPose(
        camera_from_model=Rigid(pose.R.to(points_m), pose.t_m.to(points_m)),
        covariance=covariance.to(points_m),
        residual_m=equations.rms_m.to(points_m),
        inlier_share=(equations.weight > 0).to(points_m).mean(-1),
    )


def refine_best(
    points_m: Float[Tensor, "n 3"],
    initial: Rigid,
    surface: Surface,
    config: IcpConfig | None = None,
) -> BestStart:
    """Refine poses, and rotated copies of each, and give the one that explains the cloud best.

    All are refined roughly (:func:`refine_roughly`). Each is scored by the share of points near the
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
    score = _score_poses(points_m, rough, surface, end_m)
    best = int(score.argmax())

    # The starts are the initial poses, then their rotated copies in the same order.
    is_initial = best < len(initial.R)
    start = initial[best] if is_initial else None
    refined = _refine_exactly(points_m, start, rough[best], surface, config)
    others = _distinct_poses(rough, score, refined.camera_from_model.double(), surface)
    return BestStart(refined=refined, others=others)


def _refine_exactly(
    points_m: Float[Tensor, "n 3"],
    start: Rigid | None,
    rough: Rigid,
    surface: Surface,
    config: IcpConfig,
) -> RefinedPose:
    """Refine the best start exactly, in half of the steps, from before or after its rough steps.

    Exact steps begin from the pose before, since rough steps let a pose drift where it is weakly
    constrained. They begin from the pose after where that explains the cloud better: the start was
    then farther off than exact steps reach.

    Args:
        points_m: of the object, in the camera frame.
        start: the initial pose; None where it is a rotated copy, of which the rough end is used.
        rough: the pose after rough steps from the start.
        surface: of the model.
        config: of all steps.
    """
    half = replace(config, iterations=(config.iterations + 1) // 2)
    if start is not None:
        from_start = refine_pose(points_m, start, surface, half)
        ends = Rigid.stack([from_start.camera_from_model.double(), rough])
        end_m = config.end_distance_diameters * surface.diameter_m
        score_exact, score_rough = _score_poses(points_m, ends, surface, end_m).tolist()
        if score_rough <= score_exact:
            return from_start
    near = replace(half, start_distance_diameters=config.end_distance_diameters)
    return refine_pose(points_m, rough, surface, near)


def _rotated_starts(poses: Rigid, surface: Surface, number: int) -> Rigid:
    """Give poses, then all of them rotated about the object's middle by each of the camera's axes.

    ``number`` is the starts from each pose, 1 to 7: itself, then rotated by 15 degrees about x, y
    and z, then the other way.
    """
    axes = torch.eye(3, dtype=torch.float64)
    axes = torch.cat([torch.zeros(1, 3).double(), axes, -axes])[:number]
    rotations = rotation_by(_START_ROTATION_RAD * axes)[:, None]
    middle_m = poses.R @ surface.points_m.mean(0) + poses.t_m
    t_m = (rotations @ (poses.t_m - middle_m)[..., None]).squeeze(-1) + middle_m
    return Rigid((rotations @ poses.R).flatten(0, 1), t_m.flatten(0, 1))


def _distinct_poses(
    poses: Rigid, score: Float64[Tensor, " b"], best: Rigid, surface: Surface
) -> Rigid:
    """Give up to three poses, the best first, that are distinct from each other and from ``best``.

    Distinct are poses whose surfaces lie apart; poses that differ by a symmetry are the same.
    """
    chosen: list[int] = []
    points_m = surface.points_m[:: max(1, len(surface.points_m) // 50)]
    symmetric_m = surface.symmetries.apply(points_m)
    for k in score.argsort(descending=True).tolist():
        if len(chosen) == _MOST_OTHERS or score[k] == -torch.inf:
            break
        better = Rigid.stack([best, *(poses[j] for j in chosen)])
        moved_m = (better.inverse() @ poses[k]).apply(points_m)
        distance_m = (moved_m[:, None] - symmetric_m).norm(dim=-1).mean(-1)
        if float(distance_m.min()) > _DISTINCT_DIAMETERS * surface.diameter_m:
            chosen.append(k)
    return poses[chosen]


def refine_roughly(
    points_m: Float[Tensor, "n 3"], starts: Rigid, surface: Surface, config: IcpConfig
) -> Rigid:
    """Refine a batch of poses fast: with a hundred points and a table of nearest samples.

    Args:
        points_m: of the object, in the camera frame.
        starts: poses in float64, ``camera_from_model``.
        surface: of the model; its table is :class:`~depthpose.pose.surface.Boxes`.
        config: ``end_distance_diameters`` is used.
    """
    end_m = config.end_distance_diameters * surface.diameter_m
    limits_m = [ratio * end_m for ratio in _ROUGH_LIMITS]
    poses, _ = _iterate(points_m, _ROUGH_POINTS, starts, surface, limits_m, is_exact=False)
    return poses


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

    Exact steps match each point with its nearest sample of the surface in the first half of the
    steps, and with the sample on its ray in the second; other steps look samples up in a table.
    ``refine`` in ``compiled/poses.py`` takes the same steps where numba is installed.

    Args:
        points_m: of the object, in the camera frame.
        max_points: so many of them are used, evenly taken.
        pose: one or a batch, ``camera_from_model``.
        surface: of the model.
        limits_m: distance at which a point no longer counts, for each step; the last one is for
            the samples that are returned.
        is_exact: whether samples are searched, not looked up.

    Returns:
        The poses, and for each used point the index of its sample of the surface, or -1.
    """
    if len(points_m) == 0 or not bool(points_m.isfinite().all()):
        raise InputError(
            f"ICP of {len(points_m)} points, {int((~points_m.isfinite().all(-1)).sum())} of them "
            "not finite: leave those out, and refuse a cloud of none."
        )
    cloud_m = take_evenly(points_m.double(), max_points)
    if use_numba(cloud_m, pose.R, pose.t_m):
        return _iterate_compiled(cloud_m, pose, surface, limits_m, is_exact=is_exact)

    middle_m = cloud_m.mean(0)
    scale = torch.tensor([1.0] * 3 + [surface.diameter_m] * 3, dtype=torch.float64)
    is_moving = torch.ones_like(pose.t_m[..., :1])  # 1 or 0 for each pose
    index = torch.full((*pose.t_m.shape[:-1], len(cloud_m)), -1)
    last = len(limits_m) - 1
    for step, limit_m in enumerate(limits_m):
        # Correspondences; those of a pose that has converged stay.
        is_along_rays = is_exact and 2 * step >= last
        if is_along_rays:
            matches = _match_along_rays(cloud_m, pose, surface, limit_m, index)
        elif is_exact:
            matches = _match_nearest(cloud_m, pose, surface, limit_m)
        else:
            matches = _match_by_table(cloud_m, pose, surface)
        index = torch.where(is_moving > 0, matches, index)
        if step == last:
            break

        # One Gauss-Newton step. It is taken about the middle of the cloud: a rotation by w about
        # the camera, D away, with the shift that cancels it to first order would leave the object
        # w^2 D / 2 off.
        equations = _normal_equations(
            cloud_m, pose, surface, limit_m, index, is_along_rays=is_along_rays
        )
        motion = torch.linalg.solve(equations.information, equations.gradient) * is_moving
        moved = perturb(Rigid(pose.R, pose.t_m - middle_m), motion)
        pose = Rigid(moved.R, moved.t_m + middle_m)

        # A pose that hardly moved, with the last limit and the last kind of match, has converged.
        has_last_kind = is_along_rays or not is_exact
        if limit_m <= limits_m[-1] and has_last_kind:
            is_moving = ((motion / scale).abs() >= _CONVERGED).any(-1, keepdim=True).double()
            if not bool(is_moving.any()):
                break
    return pose, index


def _iterate_compiled(
    cloud_m: Float64[Tensor, "n 3"],
    pose: Rigid,
    surface: Surface,
    limits_m: list[float],
    *,
    is_exact: bool,
) -> tuple[Rigid, Int64[Tensor, "*batch n"]]:
    """Take the steps of :func:`_iterate` by numba, on copies of the poses."""
    from depthpose.pose.compiled.poses import refine

    R = torch.from_numpy(finite_array(pose.R.detach().numpy()).copy())
    t_m = torch.from_numpy(finite_array(pose.t_m.detach().numpy()).copy())
    points = finite_array(cloud_m.detach().numpy())
    rotations = R.view(-1, 3, 3).numpy()
    translations = t_m.view(-1, 3).numpy()
    target = surface.target
    places = np.full((len(translations), len(points)), -1)
    refine(
        points,
        rotations,
        translations,
        np.array(limits_m),
        surface.diameter_m,
        _CONVERGED,
        target,
        is_exact,
        places,
    )

    # From places in the tree to samples; place -1, of no sample, takes the -1 appended.
    index = torch.from_numpy(np.append(target.tree.order, -1)[places])
    return Rigid(R, t_m), index.view(*t_m.shape[:-1], len(points))


def _score_poses(
    points_m: Float[Tensor, "n 3"], poses: Rigid, surface: Surface, limit_m: float
) -> Float64[Tensor, " b"]:
    """Score poses by how they explain a cloud; the first one, which is trusted more, gets a bonus.

    A score is the share of points near the surface, less their distance, free-space violations and
    part of the unobserved surface.
    """
    cloud_m = take_evenly(points_m.double(), _OCCLUSION_POINTS)
    free_space_violation, unobserved = look_along_rays(cloud_m, poses, surface, every=4)
    few_m = take_evenly(cloud_m, _ROUGH_POINTS)
    index = _match_by_table(few_m, poses, surface)
    equations = _normal_equations(few_m, poses, surface, limit_m, index, is_along_rays=False)
    inlier_share = (equations.weight > 0).double().mean(-1)
    # Of poses with equal shares the nearer one is better.
    closeness = inlier_share - equations.rms_m / surface.diameter_m
    score = closeness - free_space_violation - _UNOBSERVED_WEIGHT * unobserved
    score[0] += _FIRST_POSE_BONUS
    return score


def _in_model_frame(
    cloud_m: Float64[Tensor, "n 3"], pose: Rigid
) -> tuple[Float64[Tensor, "b n 3"], Float64[Tensor, "b 1 3"]]:
    """Give the cloud and the camera in the model frame of each pose; one pose is a batch of one."""
    poses = Rigid(pose.R.reshape(-1, 3, 3), pose.t_m.reshape(-1, 3))
    inverse = poses.inverse()
    return inverse.apply(cloud_m), inverse.t_m[:, None]


def _match_by_table(
    cloud_m: Float64[Tensor, "n 3"], pose: Rigid, surface: Surface
) -> Int64[Tensor, "*batch n"]:
    """Look up a visible sample of the surface near each point; -1 where the table has none.

    Where the sample in the table faces away, that on the other side of the wall is taken.
    """
    local_m, camera_m = _in_model_frame(cloud_m, pose)
    index = surface.boxes.look_up(local_m)
    is_facing = _is_visible(camera_m, index, surface)
    index = torch.where(is_facing, index, surface.across[index])
    is_matched = (index >= 0) & _is_visible(camera_m, index, surface)
    return torch.where(is_matched, index, -1).reshape(*pose.t_m.shape[:-1], -1)


def _match_nearest(
    cloud_m: Float64[Tensor, "n 3"], pose: Rigid, surface: Surface, limit_m: float
) -> Int64[Tensor, "*batch n"]:
    """Find the nearest visible sample of the surface within the limit of each point, or -1."""
    local_m, camera_m = _in_model_frame(cloud_m, pose)
    return _nearest_visible(local_m, camera_m, surface, limit_m).reshape(*pose.t_m.shape[:-1], -1)


def _match_along_rays(
    cloud_m: Float64[Tensor, "n 3"],
    pose: Rigid,
    surface: Surface,
    limit_m: float,
    previous: Int64[Tensor, "*batch n"],
) -> Int64[Tensor, "*batch n"]:
    """Find the visible sample nearest to where the ray of each point meets the surface, or -1.

    The surface there is the plane of the point's ``previous`` sample. Where the ray grazes it, that
    sample itself is the query, and where there was none the point.
    """
    local_m, camera_m = _in_model_frame(cloud_m, pose)
    sample = previous.reshape(local_m.shape[:2])
    ray_m = local_m - camera_m
    normal = surface.normals[sample]
    sample_m = surface.points_m[sample]
    slope = (normal * ray_m).sum(-1, keepdim=True)
    share = (normal * (sample_m - local_m)).sum(-1, keepdim=True) / slope
    is_meeting = slope.square() > GRAZING**2 * ray_m.square().sum(-1, keepdim=True)
    meeting_m = torch.where(is_meeting, local_m + share * ray_m, sample_m)
    query_m = torch.where(sample[..., None] >= 0, meeting_m, local_m)
    return _nearest_visible(query_m, camera_m, surface, limit_m).reshape(*pose.t_m.shape[:-1], -1)


def _nearest_visible(
    query_m: Float64[Tensor, "b n 3"],
    camera_m: Float64[Tensor, "b 1 3"],
    surface: Surface,
    limit_m: float,
) -> Int64[Tensor, "b n"]:
    """Find the visible sample nearest to each point of the model frame, or -1 beyond the limit."""
    total = len(surface.points_m)
    index = torch.full(query_m.shape[:2], -1)
    pose, point = (index < 0).nonzero(as_tuple=True)  # of the queries without an answer yet

    # Ask for ever more of the nearest samples until one is visible.
    count = 1
    while len(pose) > 0:
        _, nearest = surface.tree.query(
            query_m[pose, point].numpy(), k=range(1, count + 1), distance_upper_bound=limit_m
        )
        nearest = torch.from_numpy(nearest)
        is_within = nearest < total  # beyond the limit the tree gives the number of its points
        nearest = nearest.clamp(max=total - 1)
        is_match = is_within & _is_visible(camera_m[pose, 0, None], nearest, surface)
        first = is_match.int().argmax(1)
        has_match = is_match.any(1)
        index[pose[has_match], point[has_match]] = nearest[has_match, first[has_match]]
        is_open = ~has_match & is_within.all(1) & (count < total)
        pose = pose[is_open]
        point = point[is_open]
        count = min(8 * count, total)
    return index


def _is_visible(
    camera_m: Float64[Tensor, "b k 3"], index: Int64[Tensor, "b n"], surface: Surface
) -> Bool[Tensor, "b n"]:
    """Whether samples show a camera, in the model frame, their outer side, or nearly so.

    A sample whose outer side is not known counts as visible, and all do where the camera is within
    the ball about the surface.
    """
    distance_m = (camera_m - surface.ball_m[:3]).norm(dim=-1)
    facing_m = ((camera_m - surface.points_m[index]) * surface.outward[index]).sum(-1)
    return (facing_m >= -SLACK * distance_m) | (distance_m <= surface.ball_m[3])


def _normal_equations(
    cloud_m: Float[Tensor, "n 3"],
    pose: Rigid,
    surface: Surface,
    limit_m: float,
    index: Int64[Tensor, "*batch n"],
    *,
    is_along_rays: bool,
) -> _NormalEquations:
    """Linearise the residuals about the middle of the cloud, where the parameters hardly correlate.

    Args:
        cloud_m: in the camera frame.
        pose: one or a batch, ``camera_from_model``.
        surface: of the model.
        limit_m: distance from which a point has no weight.
        index: of each point's sample, -1 where it has none.
        is_along_rays: whether the samples lie on the rays of their points; then the residual
            replaces the part of the distance that lies along the ray.
    """
    # In the camera frame, as the covariance is.
    normal = surface.normals[index] @ pose.R.mT
    sample_m = surface.points_m[index] @ pose.R.mT + pose.t_m[..., None, :]
    gap_m = cloud_m - sample_m
    residual_m = (normal * gap_m).sum(-1)

    # Weighted by the whole distance: a point beyond an edge is near the plane, not the surface.
    square_m2 = gap_m.square().sum(-1)
    if is_along_rays:
        along_ray_m2 = (gap_m * cloud_m).sum(-1).square() / cloud_m.square().sum(-1)
        square_m2 = square_m2 - along_ray_m2 + residual_m.square()
    weight = torch.where(index >= 0, tukey_weight(square_m2, limit_m), 0.0)

    # Moving the model by (w, v) moves its point by w x arm + v, and lowers the residual.
    arm_m = sample_m - cloud_m.mean(0)
    J = torch.cat([torch.linalg.cross(arm_m, normal), normal], -1)
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
    cloud_m: Float64[Tensor, "n 3"],
    equations: _NormalEquations,
    limit_m: float,
    diameter_m: float,
) -> Float64[Tensor, "*batch 6 6"]:
    """Give the covariance of a motion (rotation, translation) about the middle of the cloud.

    That of an M-estimator (Huber 1981), ``s^2 A^-1``, assumes independent residuals; those of a
    depth camera are correlated over many pixels. It is therefore inflated by a block jackknife
    (MacKinnon and White 1985): leave out one square block of the view at a time, and measure how
    far the pose moves. This is repeated for several block sizes, and the largest result counts,
    because the correlation length is not known. With few blocks a direction can look certain by
    chance, so no direction is inflated by less than the mean over all, or by less than 1.
    """
    slope = _influence_slope(equations.weight, equations.residual_m, limit_m)
    independent, whitening, spread_m = _independent_factor(equations, slope)
    inflation, directions = _jackknife_inflation(
        cloud_m, equations, slope, independent, whitening, spread_m, diameter_m
    )
    least = inflation.mean(-1, keepdim=True).clamp(min=1)
    inflation = torch.maximum(inflation, least)
    factor = independent @ directions
    return (factor * inflation[..., None, :]) @ factor.mT


def _independent_factor(
    equations: _NormalEquations, slope: Float64[Tensor, "*batch n"]
) -> tuple[
    Float64[Tensor, "*batch 6 6"], Float64[Tensor, "*batch 6 6"], Float64[Tensor, "*batch 1 1"]
]:
    """Factor the covariance under independent residuals: ``F F^T = s^2 A^-1``.

    Gives the factor ``F``, its inverse and ``s``. ``A = sum slope J J^T`` may be singular to
    rounding: its eigenvalues over those of the information are bounded below.
    """
    # A in coordinates in which the information matrix is the identity.
    J = equations.jacobian
    A = J.mT * slope[..., None, :] @ J
    cholesky = torch.linalg.cholesky(equations.information)
    relative = torch.linalg.solve_triangular(cholesky, A, upper=False)
    relative = torch.linalg.solve_triangular(cholesky, relative.mT, upper=False)
    values, vectors = torch.linalg.eigh(relative)
    size = values.clamp(min=_LEAST_SLOPE).sqrt()[..., None, :]

    # The deviation s of the residuals, with 6 degrees of freedom less.
    weight = equations.weight
    square_sum = (weight * equations.residual_m.square()).sum(-1)
    variance = square_sum / (weight.sum(-1) - 6).clamp(min=1)
    spread_m = variance.clamp(min=1e-20).sqrt()[..., None, None]
    factor = spread_m * torch.linalg.solve_triangular(cholesky.mT, vectors / size, upper=True)
    inverse_factor = (cholesky @ vectors * size).mT / spread_m
    return factor, inverse_factor, spread_m


def _jackknife_inflation(
    cloud_m: Float64[Tensor, "n 3"],
    equations: _NormalEquations,
    slope: Float64[Tensor, "*batch n"],
    independent: Float64[Tensor, "*batch 6 6"],
    whitening: Float64[Tensor, "*batch 6 6"],
    spread_m: Float64[Tensor, "*batch 1 1"],
    diameter_m: float,
) -> tuple[Float64[Tensor, "*batch 6"], Float64[Tensor, "*batch 6 6"]]:
    """Give the ratios of a block jackknife's variances to independent ones, and their directions.

    Of several block sizes the one with the largest sum is taken; the ratios are 1 where no size has
    a larger sum. Directions are columns, in the coordinates of ``whitening``, the inverse of the
    factor ``independent``.
    """
    inverse_information = independent @ independent.mT / spread_m.square()
    J = equations.jacobian
    gradients = (equations.weight * equations.residual_m)[..., None] * J
    informations = (slope[..., None] * J)[..., None] * J[..., None, :]
    image_m = cloud_m[:, :2] / cloud_m[:, 2:] * cloud_m[:, 2].mean()
    eye = torch.eye(6, dtype=torch.float64)
    inflation = torch.ones_like(independent[..., 0])
    directions = eye.expand_as(independent)
    for side in _BLOCK_DIAMETERS:
        # Sums over the points of each block; a block's key is its column plus a million rows.
        keys = (image_m / (side * diameter_m)).floor() @ torch.tensor([1.0, 1e6]).double()
        _, block = keys.unique(return_inverse=True)
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
