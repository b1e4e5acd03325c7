"""Point-to-plane ICP: refines poses of a model's surface on a cloud."""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, move_reference, rotation_by
from depthpose.pose.compiled import Vector, array_of, compiled, cross, dot, minus, rotate, vector
from depthpose.pose.config import IcpConfig
from depthpose.pose.geometry.surface import (
    UNOBSERVED_WEIGHT,
    SampleTree,
    Surface,
    look_along_rays,
    match,
)
from depthpose.pose.types import PoseFit

_SLACK = 0.1  # sine of the angle up to which a surface that faces away counts as visible
_GRAZING = 0.1  # sine of the angle between a ray and a plane below which they do not meet nearby
_CONVERGED = 3e-4  # ICP stops when a step rotates [rad] and shifts [diameters] by less than this
_LEAST_INFORMATION = 1e-6  # a step is damped by a billionth of it at least
_START_ROTATION_RAD = math.radians(15)  # angle between the initial pose and further starts
_STEPS_ALONE = 30  # exact steps of a pose that no rough ones brought near
_ROUGH_DISTANCES = (3.0, 2.4, 2.0, 1.6, 1.4, 1.2, 1.0, 1.0, 1.0, 1.0)
"""Distances of the rough steps, over the last one of the exact steps: a start may be far from the
points."""
_ROUGH_POINTS = 100  # points of the cloud that refine and compare starts
_OCCLUSION_POINTS = 1000  # points of the cloud by which free-space violations are counted
_OCCLUSION_EVERY = 4  # one in this many points of the surface is used for that
_COMPARED_POINTS = 50  # points of the model, about, by which poses are told to be distinct
_DISTINCT_DIAMETERS = 0.1  # mean distance between the surfaces of two poses that are distinct
_MOST_OTHERS = 3  # largest number of local minima that are returned beside the best
_TRUSTED_BONUS = 0.02
"""Added to the score of the pose that is trusted more, which is a share of points near the surface:
the first of several, and what exact steps from a start end at. Another pose must be better by more:
a plane fits at many poses, and noise would choose among them."""

_BLOCK_DIAMETERS = (0.15, 0.2, 0.3, 0.4)  # sides of the blocks that the jackknife leaves out
_LEAST_REMAINING = 0.03
"""Least share of the information that counts as remaining where a block is left out: a block that
alone constrains a direction would else make it infinitely uncertain."""
_LEAST_SLOPE = 0.25
"""Least ratio of the information with Tukey's weights, which change with the residuals, to the
information with the weights held constant."""


class Residuals(NamedTuple):
    """Distances of points from the planes of their samples, for compiled loops.

    Rows are 0 of a point without a sample, or whose sample is too far away.
    """

    jacobian: Float64[np.ndarray, "n unknowns"]  #: of the distances
    distance: Float64[np.ndarray, " n"]  #: along the normal of the sample
    weight: Float64[np.ndarray, " n"]  #: by ``tukey_weight``


class Linearised(NamedTuple):
    """Refined poses' residuals, and their information about (rotation, translation)."""

    information: Float64[Tensor, "*batch 6 6"]  #: damped
    jacobian: Float64[Tensor, "*batch n 6"]  #: of the residuals
    weight: Float64[Tensor, "*batch n"]  #: of each point
    residual_m: Float64[Tensor, "*batch n"]  #: of each point

    @property
    def inlier_share(self) -> Float64[Tensor, "*batch"]:
        """Share of the points that count, being nearer than the last distance."""
        return (self.weight > 0).double().mean(-1)

    @property
    def rms_m(self) -> Float64[Tensor, "*batch"]:
        """Root mean square of the weighted residuals; infinite where no point counts."""
        total = self.weight.sum(-1)
        mean_square = (self.weight * self.residual_m.square()).sum(-1) / total.clamp(min=1e-12)
        return torch.where(total > 0, mean_square, torch.inf).sqrt()


@compiled
def tukey_weight(
    square: float | Float64[np.ndarray, "*n"], limit: float
) -> float | Float64[np.ndarray, "*n"]:
    """Compute Tukey's weight of squared distances: 1 at 0, and 0 from the limit on.

    Every ICP weights its residuals so. To use another loss, change this function and
    ``_differentiate_influence``.
    """
    share = np.maximum(0.0, 1 - square / (limit * limit))
    return share * share


def _differentiate_influence(
    weight: Float64[Tensor, "*batch n"], residual_m: Float64[Tensor, "*batch n"], limit_m: float
) -> Float64[Tensor, "*batch n"]:
    """Differentiate weight times residual by the residual, for :func:`tukey_weight`."""
    root = weight.sqrt()
    return root * (root - 4 * (residual_m / limit_m).square())


def icp(
    points_m: Float[Tensor, "m 3"],
    poses: Rigid,
    surface: Surface,
    *,
    distances_m: Sequence[float],
    max_points: int,
    is_exact: bool,
) -> tuple[Rigid, Linearised]:
    """Move poses so that the cloud lies on the surface: point-to-plane ICP, of each by itself.

    Every point of a partial cloud has a place on the whole model, so points seek the surface and
    not the reverse. Each step minimises ``sum w (n . (T^-1 x - s))^2`` over the nearest surface
    point ``s`` with normal ``n`` (Chen and Medioni 1991) that faces the camera; the weight is
    Tukey's. In the second half of exact steps ``s`` is where the ray of ``x`` meets the surface,
    for noise is along the ray. The nearest point would do harm there: of a reading that noise puts
    behind an edge it lies on another face, and such readings draw the model toward the camera.

    Where no point of the cloud comes near the surface a pose stays as it was.

    Args:
        points_m: points of the object, in the camera frame.
        poses: poses to begin from, ``camera_from_model``, in float64; one or a batch.
        surface: of :func:`~depthpose.pose.geometry.surface.prepare_surface`.
        distances_m: distance from the surface at which a point's weight is 0: one for each
            Gauss-Newton step, and a last one for the residuals, after which no step follows.
        max_points: largest number of points that are used, evenly taken.
        is_exact: whether the nearest surface points are searched in a tree, not looked up in a
            table (:class:`~depthpose.pose.geometry.surface.NearestTable`), which is faster.

    Returns:
        The refined poses, and the residuals and the information of each.

    Raises:
        InputError: there is no point, or one is not finite.
    """
    if len(points_m) == 0 or not bool(points_m.isfinite().all()):
        raise InputError(
            f"ICP of {len(points_m)} points, {int((~points_m.isfinite().all(-1)).sum())} of them "
            "not finite: leave those out, and refuse a cloud of none."
        )

    # The compiled loop changes rotations and translations in place, and writes the residuals of
    # each pose into a row of these arrays.
    cloud = array_of(take_evenly(points_m.double(), max_points))
    R = array_of(poses.R).copy()
    t_m = array_of(poses.t_m).copy()
    rotations = R.reshape(-1, 3, 3)
    translations = t_m.reshape(-1, 3)
    batch = (len(translations), len(cloud))
    jacobian = np.zeros((*batch, 6))
    weight = np.zeros(batch)
    residual_m = np.zeros(batch)
    information = np.empty((batch[0], 6, 6))
    for k in range(batch[0]):
        information[k] = _gauss_newton(
            cloud,
            rotations[k],
            translations[k],
            np.array(distances_m),
            surface.diameter_m,
            surface.sample_tree,
            is_exact,
            Residuals(jacobian[k], residual_m[k], weight[k]),
        )

    # Back to the batch axes of the poses.
    shape = poses.t_m.shape[:-1]
    parts = (information, jacobian, weight, residual_m)
    tensors = [torch.from_numpy(part).reshape(*shape, *part.shape[1:]) for part in parts]
    return Rigid(torch.from_numpy(R), torch.from_numpy(t_m)), Linearised(*tensors)


def refine_roughly(
    points_m: Float[Tensor, "n 3"],
    poses: Rigid,
    surface: Surface,
    end_diameters: float = IcpConfig.end_distance_diameters,
) -> Rigid:
    """Refine a batch of poses fast: by a hundred points and the table of surface points.

    Args:
        points_m: points of the object, in the camera frame.
        poses: in float64, ``camera_from_model``.
        surface: of the model.
        end_diameters: distance of the last step.

    Raises:
        InputError: there is no point, or one is not finite.
    """
    end_m = end_diameters * surface.diameter_m
    distances_m = [ratio * end_m for ratio in _ROUGH_DISTANCES]
    refined, _ = icp(
        points_m,
        poses,
        surface,
        distances_m=distances_m,
        max_points=_ROUGH_POINTS,
        is_exact=False,
    )
    return refined


def refine_exactly(
    points_m: Float[Tensor, "n 3"],
    poses: Rigid,
    surface: Surface,
    *,
    iterations: int = _STEPS_ALONE,
    start_diameters: float = IcpConfig.start_distance_diameters,
    end_diameters: float = IcpConfig.end_distance_diameters,
    max_points: int = IcpConfig.cloud_points,
    sensor_offset_m: float = IcpConfig.sensor_offset_m,
) -> PoseFit:
    """Refine poses by the nearest surface points, and estimate their covariance.

    The covariance allows for correlated residuals, and for an offset of all readings along the ray.
    A motion that the surface leaves free, such as a rotation of a ball, has a very large variance.

    Args:
        points_m: points of the object, in the camera frame.
        poses: poses to begin from, ``camera_from_model``; one or a batch.
        surface: of the model.
        iterations: largest number of steps.
        start_diameters: distance of the first step; it shrinks in even ratios over half of the
            steps, then stays.
        end_diameters: distance of the last steps, and of the inliers.
        max_points: largest number of points that are used, evenly taken.
        sensor_offset_m: standard deviation of an offset of all readings.

    Returns:
        The fits, with the batch axes of ``poses``. Where no point comes near the surface the pose
        is the one given, and its ``inlier_share`` 0.

    Raises:
        InputError: there is no point, or one is not finite.
    """
    half = max(1, iterations // 2)
    ratio = end_diameters / start_diameters
    distances = [start_diameters * ratio ** min(1.0, step / half) for step in range(iterations)]
    distances_m = [distance * surface.diameter_m for distance in (*distances, end_diameters)]
    refined, equations = icp(
        points_m,
        poses.double(),
        surface,
        distances_m=distances_m,
        max_points=max_points,
        is_exact=True,
    )

    # Covariance about the middle of the cloud, of the residuals and of an offset along the ray.
    cloud_m = take_evenly(points_m.double(), max_points)
    covariance = _estimate_covariance(cloud_m, equations, distances_m[-1], surface.diameter_m)
    middle_m = cloud_m.mean(0)
    ray = torch.nn.functional.normalize(middle_m, dim=0)
    offset_m = sensor_offset_m * torch.cat([torch.zeros(3), ray])
    covariance = covariance + torch.outer(offset_m, offset_m)

    # The same about the camera.
    covariance = move_reference(covariance, middle_m)
    return PoseFit(
        camera_from_model=Rigid(refined.R.to(points_m), refined.t_m.to(points_m)),
        covariance=covariance.to(points_m),
        residual_m=equations.rms_m.to(points_m),
        inlier_share=equations.inlier_share.to(points_m),
    )


def refine_best(
    points_m: Float[Tensor, "n 3"],
    poses: Rigid,
    surface: Surface,
    config: IcpConfig,
    rotated: Rigid | None = None,
) -> tuple[PoseFit, Rigid]:
    """Refine poses roughly, choose the one that explains the cloud best, and refine it exactly.

    Args:
        points_m: points of the object, in the camera frame.
        poses: ``camera_from_model``, one or several; the first is trusted most.
        surface: of the model.
        config: settings of the exact steps.
        rotated: further starts (:func:`rotate_starts`), in float64; None: the poses alone.

    Returns:
        The best pose, and up to three other local minima, roughly refined, in float64.

    Raises:
        InputError: there is no point, or one is not finite.
    """
    # Coarse, on all of them.
    poses = Rigid(poses.R.reshape(-1, 3, 3), poses.t_m.reshape(-1, 3)).double()
    starts = poses if rotated is None else Rigid.cat([poses, rotated])
    rough = refine_roughly(points_m, starts, surface, config.end_distance_diameters)

    # The best of them.
    end_m = config.end_distance_diameters * surface.diameter_m
    score = _score_poses(points_m, rough, surface, end_m)
    score[0] += _TRUSTED_BONUS
    best = int(score.argmax())

    # Fine, on that one.
    start = poses[best] if best < len(poses.R) else None
    refined = _refine_chosen(points_m, start, rough[best], surface, config)
    others = _choose_distinct_poses(rough, score, refined.camera_from_model.double(), surface)
    return refined, others


def rotate_starts(poses: Rigid, surface: Surface, starts: int) -> Rigid:
    """Rotate poses about the object's middle by 15 degrees, for ICP to start from too.

    Args:
        poses: a batch, ``camera_from_model``, in float64.
        surface: of the model.
        starts: from each pose, 1 to 7: the pose itself, then rotated about the x, y and z axis of
            the camera, then the other way.

    Returns:
        The rotated poses, those of the first rotation first; the given ones are not among them.
    """
    eye = torch.eye(3, dtype=torch.float64)
    axes = torch.cat([eye, -eye])[: starts - 1]
    rotations = rotation_by(_START_ROTATION_RAD * axes)[:, None]
    middle_m = poses.R @ surface.points_m.mean(0) + poses.t_m
    t_m = (rotations @ (poses.t_m - middle_m)[..., None]).squeeze(-1) + middle_m
    return Rigid((rotations @ poses.R).flatten(0, 1), t_m.flatten(0, 1))


def _score_poses(
    points_m: Float[Tensor, "n 3"], poses: Rigid, surface: Surface, limit_m: float
) -> Float64[Tensor, " b"]:
    """Score poses by how they explain a cloud.

    A score is the share of points near the surface, less their distance, free-space violations and
    part of the unobserved surface.
    """
    # What the posed surface would hide, and what of it was not observed.
    cloud_m = take_evenly(points_m.double(), _OCCLUSION_POINTS)
    free_space_violation, unobserved = look_along_rays(
        cloud_m, poses, surface, every=_OCCLUSION_EVERY
    )

    # How many points lie near it. Of poses with equal shares the nearer one is better.
    few_m = take_evenly(cloud_m, _ROUGH_POINTS)
    _, equations = icp(
        few_m,
        poses,
        surface,
        distances_m=[limit_m],  # no step: matches and residuals alone
        max_points=_ROUGH_POINTS,
        is_exact=False,
    )
    closeness = equations.inlier_share - equations.rms_m / surface.diameter_m
    return closeness - free_space_violation - UNOBSERVED_WEIGHT * unobserved


def _refine_chosen(
    points_m: Float[Tensor, "n 3"],
    start: Rigid | None,
    rough: Rigid,
    surface: Surface,
    config: IcpConfig,
) -> PoseFit:
    """Refine the best start exactly, from before or after its rough steps.

    Exact steps begin from the pose before, since rough steps let a pose drift where it is weakly
    constrained. They begin from the pose after where that explains the cloud better: the start was
    then farther off than exact steps reach.

    Args:
        points_m: points of the object, in the camera frame.
        start: the pose before; None where it is a rotated start, of which the rough end is used.
        rough: the pose after rough steps from the start.
        surface: of the model.
        config: settings of the exact steps.
    """
    end_diameters = config.end_distance_diameters
    refine = partial(
        refine_exactly,
        points_m,
        surface=surface,
        iterations=config.iterations,
        end_diameters=end_diameters,
        max_points=config.cloud_points,
        sensor_offset_m=config.sensor_offset_m,
    )
    if start is not None:
        from_start = refine(start, start_diameters=config.start_distance_diameters)
        ends = Rigid.stack([from_start.camera_from_model.double(), rough])
        end_m = end_diameters * surface.diameter_m
        score_exact, score_rough = _score_poses(points_m, ends, surface, end_m).tolist()
        if score_rough <= score_exact + _TRUSTED_BONUS:
            return from_start
    return refine(rough, start_diameters=end_diameters)


def _choose_distinct_poses(
    poses: Rigid, score: Float64[Tensor, " b"], best: Rigid, surface: Surface
) -> Rigid:
    """Choose up to three poses, the best first, distinct from each other and from ``best``.

    The distance of two poses is the mean distance between the places that they give the same point
    of the model, the least over the symmetries of the model.
    """
    chosen: list[int] = []
    points_m = surface.points_m[:: max(1, len(surface.points_m) // _COMPARED_POINTS)]
    symmetric_m = surface.symmetries.apply(points_m)  # (symmetries, points, 3)
    for k in score.argsort(descending=True).tolist():
        # The score is -inf where no point counts: its residual is infinite. All later ones are too.
        if len(chosen) == _MOST_OTHERS or score[k] == -torch.inf:
            break
        better = Rigid.stack([best, *(poses[j] for j in chosen)])
        # Where pose k puts the points, seen from each better pose, which has them at symmetric_m.
        moved_m = (better.inverse() @ poses[k]).apply(points_m)  # (better poses, points, 3)
        distance_m = (moved_m[:, None] - symmetric_m).norm(dim=-1).mean(-1)
        if float(distance_m.min()) > _DISTINCT_DIAMETERS * surface.diameter_m:
            chosen.append(k)
    return poses[chosen]


@compiled
def _gauss_newton(
    cloud: Float64[np.ndarray, "n 3"],
    R: Float64[np.ndarray, "3 3"],
    t: Float64[np.ndarray, "3"],
    limits: Float64[np.ndarray, " steps"],
    diameter: float,
    target: SampleTree,
    is_exact: bool,
    residuals: Residuals,
) -> Float64[np.ndarray, "6 6"]:
    """Move a pose in place by point-to-plane ICP; write its residuals, return its information.

    Exact steps match each point with its nearest sample of the surface in the first half of the
    steps, and with the sample on its ray in the second; other steps look samples up in a table.

    Args:
        cloud: in the camera frame.
        R: rotation of the pose; changed.
        t: its translation; changed.
        limits: ``distances_m`` of :func:`icp`.
        diameter: of the object.
        target: samples of the surface.
        is_exact: whether the nearest samples are searched, not looked up in a table.
        residuals: output.
    """
    middle = cloud.sum(0) / len(cloud)
    places = np.full(len(cloud), -1)
    last = len(limits) - 1
    has_converged = False
    H = np.empty((6, 6))
    for step in range(len(limits)):
        limit = limits[step]
        is_along_rays = is_exact and 2 * step >= last
        local = (cloud - t) @ R
        camera = -(t @ R)
        eye = (camera[0], camera[1], camera[2])

        # Match each point with a sample that faces the camera; all samples do where the camera is
        # within the ball about the surface. The matches of a pose that has converged stay.
        if not has_converged:
            queries = _meet_planes(local, eye, target, places) if is_along_rays else local
            way = minus(eye, (target.ball[0], target.ball[1], target.ball[2]))
            distance = np.sqrt(dot(way, way))
            least = -_SLACK * distance if distance > target.ball[3] else -np.inf
            match(queries, target, eye, least, limit, is_exact, places)

        # Linearise about the middle of the cloud. About the camera, at a distance D, rotation and
        # shift nearly cancel, and what linearising leaves out is an error of w^2 D / 2.
        _linearise(local, eye, places, R, t - middle, limit, target, is_along_rays, residuals)
        H, b = build_normal_equations(residuals, _LEAST_INFORMATION)
        if step == last or has_converged:
            break

        # One Gauss-Newton step.
        motion = np.linalg.solve(H, b)
        rotation = make_rotation(motion)
        t[:] = rotation @ (t - middle) + middle + motion[3:]
        R[:] = rotation @ R

        # A pose that hardly moved, with the last limit and the last kind of match, has converged.
        largest = 0.0
        for k in range(3):
            largest = max(largest, abs(motion[k]), abs(motion[3 + k]) / diameter)
        has_last_kind = is_along_rays or not is_exact
        has_converged = largest < _CONVERGED and has_last_kind and limit <= limits[last]
    return H


@compiled
def _meet_planes(
    local: Float64[np.ndarray, "n 3"],
    eye: Vector,
    target: SampleTree,
    places: Int64[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 3"]:
    """Intersect the ray of each point with the plane of its sample, in the model frame.

    Where the ray grazes the plane it is the sample itself; a point without a sample stays.

    Args:
        local: points in the model frame.
        eye: the camera there.
        target: the samples.
        places: of the samples of the points, or -1.
    """
    meet = local.copy()
    for i in range(len(local)):
        place = places[i]
        if place < 0:
            continue
        point = vector(local, i)
        ray = minus(point, eye)
        normal = vector(target.normals, place)
        sample = vector(target.tree.points, place)
        slope = dot(normal, ray)
        is_grazing = slope * slope <= _GRAZING * _GRAZING * dot(ray, ray)
        share = 0.0 if is_grazing else dot(normal, minus(sample, point)) / slope
        for c in range(3):
            meet[i, c] = sample[c] if is_grazing else point[c] + share * ray[c]
    return meet


@compiled
def _linearise(
    local: Float64[np.ndarray, "n 3"],
    eye: Vector,
    places: Int64[np.ndarray, " n"],
    R: Float64[np.ndarray, "3 3"],
    arm_of_model: Float64[np.ndarray, "3"],
    limit: float,
    target: SampleTree,
    is_along_rays: bool,
    residuals: Residuals,
) -> None:
    """Write the residuals of a pose, with their derivatives by a motion of the model.

    The motion is about the middle of the cloud, where its parameters hardly correlate.

    Args:
        local: the cloud in the model frame.
        eye: the camera there.
        places: of the samples of the points, or -1.
        R: rotation of the pose.
        arm_of_model: from the middle of the cloud to the model's origin, in the camera frame.
        limit: distance from which a point has no weight.
        target: the samples.
        is_along_rays: whether the samples lie on the rays of their points; then the residual
            replaces the part of the distance that lies along the ray.
        residuals: output.
    """
    residuals.jacobian[:] = 0.0
    residuals.distance[:] = 0.0
    residuals.weight[:] = 0.0
    for i in range(len(local)):
        if places[i] < 0:
            continue
        point = vector(local, i)
        sample = vector(target.tree.points, places[i])
        normal = vector(target.normals, places[i])
        gap = minus(point, sample)
        distance = dot(normal, gap)

        # Weighted by the whole distance: a point beyond an edge is near the plane, not the surface.
        square = dot(gap, gap)
        if is_along_rays:
            ray = minus(point, eye)
            along = dot(gap, ray)
            square += distance * distance - along * along / dot(ray, ray)
        weight = tukey_weight(square, limit)
        if weight <= 0:
            continue

        # Moving the model by (w, v) moves its sample by w x arm + v, and lowers the residual.
        x, y, z = rotate(R, sample)
        arm = (x + arm_of_model[0], y + arm_of_model[1], z + arm_of_model[2])
        seen_normal = rotate(R, normal)
        moment = cross(arm, seen_normal)
        for c in range(3):
            residuals.jacobian[i, c] = moment[c]
            residuals.jacobian[i, 3 + c] = seen_normal[c]
        residuals.distance[i] = distance
        residuals.weight[i] = weight


@compiled
def build_normal_equations(
    residuals: Residuals, least_size: float
) -> tuple[Float64[np.ndarray, "k k"], Float64[np.ndarray, " k"]]:
    """Build the weighted normal equations of a Gauss-Newton step, ``H @ motion = b``.

    H is damped, so that an unknown that no point constrains stays where it was: by a billionth of
    the largest number of its diagonal, or of ``least_size``.
    """
    unknowns = residuals.jacobian.shape[1]
    H = np.zeros((unknowns, unknowns))
    b = np.zeros(unknowns)
    for i in range(len(residuals.weight)):
        if residuals.weight[i] <= 0:
            continue
        for k in range(unknowns):
            scaled = residuals.weight[i] * residuals.jacobian[i, k]
            b[k] += scaled * residuals.distance[i]
            for m in range(unknowns):
                H[k, m] += scaled * residuals.jacobian[i, m]

    # Damped by its largest number.
    size = least_size
    for k in range(unknowns):
        size = max(size, H[k, k])
    for k in range(unknowns):
        H[k, k] += 1e-9 * size
    return H, b


@compiled
def make_rotation(motion: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, "3 3"]:
    """Make the rotation of a motion, whose first three numbers are a rotation vector [rad].

    Rodrigues' formula.
    """
    x, y, z = motion[0], motion[1], motion[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    # sin(a) / a and (1 - cos(a)) / a^2, by their series at a small angle.
    s = 1 - square / 6
    c = 0.5 - square / 24
    if angle >= 1e-4:
        s = np.sin(angle) / angle
        c = (1 - np.cos(angle)) / square
    R = np.empty((3, 3))
    R[0, 0] = 1 - c * (y * y + z * z)
    R[1, 1] = 1 - c * (x * x + z * z)
    R[2, 2] = 1 - c * (x * x + y * y)
    R[0, 1] = c * x * y - s * z
    R[1, 0] = c * x * y + s * z
    R[0, 2] = c * x * z + s * y
    R[2, 0] = c * x * z - s * y
    R[1, 2] = c * y * z - s * x
    R[2, 1] = c * y * z + s * x
    return R


def _estimate_covariance(
    cloud_m: Float64[Tensor, "n 3"],
    equations: Linearised,
    limit_m: float,
    diameter_m: float,
) -> Float64[Tensor, "*batch 6 6"]:
    """Estimate the covariance of a motion (rotation, translation) about the middle of the cloud.

    That of an M-estimator (Huber 1981), ``s^2 A^-1``, assumes independent residuals; those of a
    depth camera are correlated over many pixels. It is therefore inflated by a block jackknife
    (MacKinnon and White 1985): leave out one square block of the view at a time, and measure how
    far the pose moves. This is repeated for several block sizes, and the largest result counts,
    because the correlation length is not known. With few blocks a direction can look certain by
    chance, so no direction is inflated by less than the mean over all, or by less than 1.

    Args:
        cloud_m: the points of the residuals, in the camera frame.
        equations: residuals, weights and information of each pose.
        limit_m: distance from which a point has no weight.
        diameter_m: of the object.
    """
    slope = _differentiate_influence(equations.weight, equations.residual_m, limit_m)
    independent, whitening, spread_m = _factor_independent_covariance(equations, slope)
    inflation, directions = _measure_inflation(
        cloud_m, equations, slope, independent, whitening, spread_m, diameter_m
    )
    least = inflation.mean(-1, keepdim=True).clamp(min=1)
    inflation = torch.maximum(inflation, least)
    factor = independent @ directions
    return (factor * inflation[..., None, :]) @ factor.mT


def _factor_independent_covariance(
    equations: Linearised, slope: Float64[Tensor, "*batch n"]
) -> tuple[
    Float64[Tensor, "*batch 6 6"], Float64[Tensor, "*batch 6 6"], Float64[Tensor, "*batch 1 1"]
]:
    """Factor the covariance under independent residuals: ``F F^T = s^2 A^-1``.

    Returns the factor ``F``, its inverse and ``s``. ``A = sum slope J J^T`` may be singular to
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


def _measure_inflation(
    cloud_m: Float64[Tensor, "n 3"],
    equations: Linearised,
    slope: Float64[Tensor, "*batch n"],
    independent: Float64[Tensor, "*batch 6 6"],
    whitening: Float64[Tensor, "*batch 6 6"],
    spread_m: Float64[Tensor, "*batch 1 1"],
    diameter_m: float,
) -> tuple[Float64[Tensor, "*batch 6"], Float64[Tensor, "*batch 6 6"]]:
    """Measure how many times as large as under independent residuals a jackknife's variances are.

    Several block sizes are tried, and the one whose ratios have the largest sum is taken.

    Args:
        cloud_m: the points of the residuals, in the camera frame.
        equations: residuals, weights and information of each pose.
        slope: of the influence of each residual.
        independent: factor of the covariance under independent residuals.
        whitening: its inverse.
        spread_m: standard deviation of the residuals.
        diameter_m: of the object.

    Returns:
        The ratios along six directions, 1 where no block size has a larger sum; and these
        directions, as columns in the coordinates of ``whitening``.
    """
    # What each point adds to the gradient and to the information.
    inverse_information = independent @ independent.mT / spread_m.square()
    J = equations.jacobian
    gradients = (equations.weight * equations.residual_m)[..., None] * J
    informations = (slope[..., None] * J)[..., None] * J[..., None, :]

    # The largest inflation of all block sizes.
    image_m = cloud_m[:, :2] / cloud_m[:, 2:] * cloud_m[:, 2].mean()
    eye = torch.eye(6, dtype=torch.float64)
    inflation = torch.ones_like(independent[..., 0])
    directions = eye.expand_as(independent)
    for side in _BLOCK_DIAMETERS:
        # Sums over the points of each block; its key is the column plus a million times the row.
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

        # Is it larger than those of the sizes before?
        is_larger = values.sum(-1, keepdim=True) > inflation.sum(-1, keepdim=True)
        inflation = torch.where(is_larger, values, inflation)
        directions = torch.where(is_larger[..., None], vectors, directions)
    return inflation, directions
