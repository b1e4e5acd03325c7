"""Whether what was posed is the object: its size, its handedness, and nothing that contradicts it.

Another size is fitted as a seventh unknown of ICP, and the mirror image as a model of its own.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose.compiled import use_numba
from depthpose.pose.config import IcpConfig
from depthpose.pose.icp import refine_pose, refine_roughly, tukey_weight
from depthpose.pose.mesh import MIRROR_ALIKE
from depthpose.pose.mesh.models import fibonacci_directions
from depthpose.pose.sensor import EDGE_PX, INDEPENDENT_SIDES, LARGEST_OFFSET_M
from depthpose.pose.surface import NEAR, Surface, finite_array
from depthpose.pose.types import Evidence, Identity

POINTS = 400  #: of the cloud, evenly taken
_STEPS = 12
_WIDE_STEP = 2.0  # times the usual limit of a distance in the first step
_INDEPENDENT = 10.0  # so many neighbouring readings err alike: the variance is so many times larger
_STARTS = (1.0, 0.87, 1.15)
"""Scales at which ICP starts: from 1 alone it stays there for smaller copies."""
_ROUGH_POINTS = 150
_TRUST = 0.03
"""A start beside 1 must lower the mean squared distance so much, in squared limits of nearness."""
_CONVERGED = 3e-4
_PLANES = 24  # planes across which the posed model is mirrored for a start
_CLEAR = 0.05
"""Where the mirror image, roughly fitted, is so much farther from the points than the model, exact
steps do not bring it nearer: in 123 views the gain was then -0.035 at most."""
_FLIP = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
_SURE = 2.0  # standard deviations
_SIZE_GAIN = 0.05
"""Where another size gains less (0.25 % of the diameter), what is seen of the surface fits at many,
or a sensor errs so: the right pose of a real bowl gains 0.032 at 1.07."""
_MIRROR_GAIN = 0.02
"""Gain from which a cloud is that of a mirrored copy, 0.1 % of the diameter: of right answers for
synthetic views it was at most 0.004, where the mirror image is not nearly the model."""
_OTHER_SIZES = 0.1  # sizes so far from 1 must be excluded for an identity to be confirmed
_NEAR_SIZE = 0.03  # and the size that fits is as near to 1, beside its deviation and an offset


@dataclass(frozen=True)
class Scale:
    """How many times as large as the model the seen object is, and how sure that is."""

    times: float  #: 1 for the model itself
    sigma: float  #: standard deviation of it
    #: by how much it lowers the root mean square distance of the points to the surface, in units of
    #: the distance up to which a point is near.
    gain: float


def scale_of(
    cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface, object_std_m: float
) -> Scale:
    """Measure the scale of the model that fits a cloud best, the pose moving with it.

    Point-to-plane ICP with a seventh unknown: the model grows about its middle ``c`` by ``s``,
    which moves its point ``p`` across the surface by ``n . (p - c) s``.

    Args:
        cloud_m: points of the object, in the camera frame.
        pose: ``camera_from_model``.
        surface: of the model.
        object_std_m: standard deviation of the real surface from the model.
    """
    local_m = pose.inverse().apply(take_evenly(cloud_m.double(), POINTS))
    starts = torch.tensor(_STARTS, dtype=torch.float64)
    few_m = take_evenly(local_m, _ROUGH_POINTS).expand(len(starts), -1, -1)
    times, grown_m = _grow(few_m, starts, surface, is_exact=False)
    costs = distance_to(grown_m, surface, times, is_exact=False).square()
    costs[0] -= _TRUST
    start = starts[costs.argmin()][None]
    times, grown_m = _grow(local_m[None], start, surface, is_exact=True)
    reached = distance_to(grown_m, surface, times, is_exact=True)
    gain = distance_to(local_m, surface, is_exact=True) - reached[0]
    equations = _growth_equations(grown_m, times, surface, NEAR * surface.diameter_m, is_exact=True)
    return Scale(float(times), _scale_deviation(equations, object_std_m), float(gain))


class _Equations(NamedTuple):
    """Point-to-plane equations of turn, shift and growth, one a point."""

    J: Float64[Tensor, "b n 7"]
    residual_m: Float64[Tensor, "b n"]
    weight: Float64[Tensor, "b n"]


def _growth_equations(
    local_m: Float64[Tensor, "b n 3"],
    times: Float64[Tensor, " b"],
    surface: Surface,
    limit_m: float,
    *,
    is_exact: bool,
) -> _Equations:
    """Linearise the distances of points to a surface that is so many times as large."""
    middle_m = surface.middle_m
    scale = times[:, None, None]
    unscaled_m = (local_m - middle_m) / scale + middle_m
    index = surface.nearest(unscaled_m) if is_exact else surface.boxes.look_up(unscaled_m)
    normal = surface.normals[index]
    arm_m = scale * (surface.points_m[index] - middle_m)
    offset_m = local_m - middle_m - arm_m
    growth_m = (normal * arm_m).sum(-1, keepdim=True)
    return _Equations(
        J=torch.cat([torch.linalg.cross(arm_m, normal), normal, growth_m], -1),
        residual_m=(normal * offset_m).sum(-1),
        weight=tukey_weight(offset_m.square().sum(-1), limit_m),
    )


def _damped(H: Float64[Tensor, "b 7 7"]) -> Float64[Tensor, "b 7 7"]:
    """Damp what the points leave undetermined."""
    largest = H.diagonal(dim1=1, dim2=2).amax(-1)[:, None, None].clamp(min=1e-9)
    return H + 1e-9 * largest * torch.eye(7, dtype=torch.float64)


def _scale_deviation(equations: _Equations, object_std_m: float) -> float:
    """Standard deviation of a scale: noise that neighbours share, and sides that deviate."""
    J = equations.J[0]
    weight = equations.weight[0]
    inverse = torch.linalg.inv(_damped(((J.mT * weight) @ J)[None]))[0]
    noise_m2 = (weight * equations.residual_m[0].square()).sum() / (weight.sum() - 7).clamp(min=1)
    variance = _INDEPENDENT * noise_m2 * inverse[6, 6]
    variance += object_std_m**2 * weight.sum() * inverse[6, 6] / INDEPENDENT_SIDES
    return float(variance.clamp(min=0).sqrt())


def _grow(
    local_m: Float64[Tensor, "b n 3"],
    times: Float64[Tensor, " b"],
    surface: Surface,
    *,
    is_exact: bool,
) -> tuple[Float64[Tensor, " b"], Float64[Tensor, "b n 3"]]:
    """Iterate point-to-plane ICP with a scale; give the scales and the moved points."""
    middle_m = surface.middle_m
    widths = (1 + (_WIDE_STEP - 1) * max(0.0, 1 - 2 * step / _STEPS) for step in range(_STEPS))
    limits_m = [NEAR * surface.diameter_m * width for width in widths]
    if use_numba(local_m, times):
        from depthpose.pose.compiled.poses import grow

        local_m = torch.from_numpy(finite_array(local_m.numpy()).copy())
        times = times.clone()
        arrays = (local_m.numpy(), times.numpy(), middle_m.numpy(), np.array(limits_m))
        grow(*arrays, surface.target, is_exact, _CONVERGED)
        return times, local_m
    for limit_m in limits_m:
        J, residual_m, weight = _growth_equations(
            local_m, times, surface, limit_m, is_exact=is_exact
        )
        weighted = J.mT * weight[:, None]
        motion = torch.linalg.solve(_damped(weighted @ J), weighted @ residual_m[..., None])[..., 0]
        times = (times * (1 + motion[:, 6].clamp(-0.1, 0.1))).clamp(0.5, 2.0)
        turn = rotation_by(motion[:, :3])
        local_m = (local_m - middle_m - motion[:, None, 3:6]) @ turn + middle_m
        if float(motion[:, [0, 1, 2, 6]].abs().max()) < _CONVERGED:
            break
    return times, local_m


def distance_to(
    local_m: Float64[Tensor, "*batch n 3"],
    surface: Surface,
    times: Float64[Tensor, "*batch"] | None = None,
    *,
    is_exact: bool,
) -> Float64[Tensor, "*batch"]:
    """Root mean square distance of points to a surface, in limits of nearness, cut off at 1.

    With ``times`` the surface is so many times as large, grown about its middle.
    """
    if times is not None:
        local_m = (local_m - surface.middle_m) / times[:, None, None] + surface.middle_m
    index = surface.nearest(local_m) if is_exact else surface.boxes.look_up(local_m)
    gap_m = (local_m - surface.points_m[index]).norm(dim=-1)
    if times is not None:
        gap_m = times[..., None] * gap_m
    return (gap_m / (NEAR * surface.diameter_m)).clamp(max=1).square().mean(-1).sqrt()


def mirror_gain(cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface) -> float:
    """Measure by how much nearer the points lie to the mirror image of the model, in its best pose.

    The cloud is mirrored in place of the model, so that ICP finds a pose. Negative where the
    mirror image fits worse: by a rough fit, where that is clearly worse already.
    """
    # Mirrored once, the cloud is brought back by rotations: a reflection at each of many planes.
    local_m = pose.inverse().apply(take_evenly(cloud_m.double(), POINTS))
    middle_m = surface.middle_m
    mirrored_m = (local_m - middle_m) * _FLIP + middle_m
    config = IcpConfig()
    normals = fibonacci_directions(_PLANES)  # of planes that mirror the cloud back
    R = _FLIP[:, None] * (torch.eye(3).double() - 2 * normals[:, :, None] * normals[:, None])
    tried = refine_roughly(mirrored_m, Rigid(R, middle_m - R @ middle_m), surface, config)

    # Roughly: is the mirror image clearly worse?
    few_m = take_evenly(mirrored_m, 100).expand(len(tried.R), -1, -1)
    rough = distance_to(tried.inverse().apply(few_m), surface, is_exact=False)
    unmirrored = distance_to(take_evenly(local_m, 100), surface, is_exact=False)
    if float(rough.min() - unmirrored) > _CLEAR:
        return float(unmirrored - rough.min())

    # Exactly, from the best of them: three found no other gain in 24 views.
    nearest = rough.argmin()[None]
    config = replace(config, start_distance_diameters=config.end_distance_diameters)
    refined = refine_pose(mirrored_m, tried[nearest], surface, config)
    exact_m = refined.camera_from_model.inverse().apply(mirrored_m[None])
    unmirrored = distance_to(local_m, surface, is_exact=True)
    return float(unmirrored - distance_to(exact_m, surface, is_exact=True).min())


def sensor_size_error(distance_m: float, focal_px: float, diameter_m: float) -> float:
    """Give the share by which an offset and displaced edges of a sensor may change a size.

    What looks nearer by the offset looks larger by the same share.
    """
    return LARGEST_OFFSET_M / distance_m + 2 * EDGE_PX * distance_m / focal_px / diameter_m


def identify(
    cloud_m: Float[Tensor, "n 3"],
    pose: Rigid,
    name: str,
    surface: Surface,
    mirror_deviation: float,
    evidence: Evidence,
    focal_px: float,
    max_size_error: float,
    object_std_m: float,
) -> Identity:
    """Fit another size and the mirror image, and say whether one of them is what was seen.

    Args:
        cloud_m: points of the object, in the camera frame.
        pose: ``camera_from_model``.
        name: of the model.
        surface: of the model.
        mirror_deviation: of the mirror image from the model, in diameters.
        evidence: of the pose.
        focal_px: of the depth image.
        max_size_error: by so much a real object may differ in size from its model.
        object_std_m: standard deviation of its surface from the model's.
    """
    scale = scale_of(cloud_m, pose, surface, object_std_m)
    mirror = None
    if mirror_deviation > MIRROR_ALIKE:
        mirror = mirror_gain(cloud_m, pose, surface)
    distance_m = float(cloud_m[:, 2].double().median())
    offset_error = LARGEST_OFFSET_M / distance_m  # what looks nearer by the offset looks larger
    sensor_error = sensor_size_error(distance_m, focal_px, surface.diameter_m)
    size_error = abs(scale.times - 1)
    largest_error = max_size_error + sensor_error + _SURE * scale.sigma
    is_other_size = size_error > largest_error and scale.gain > _SIZE_GAIN
    size = (
        f"{scale.times:.2f} times the model's size fits best (standard deviation {scale.sigma:.2f})"
    )

    status = "not excluded"
    reason = ""
    # Sides that deviate from the model may fit its mirror image a little better.
    deviation = object_std_m / math.sqrt(INDEPENDENT_SIDES) / (NEAR * surface.diameter_m)
    least_gain = max(_MIRROR_GAIN, deviation, scale.gain if is_other_size else 0.0)
    if mirror is not None and mirror > least_gain:
        status = "contradicted"
        reason = (
            f"the mirror image of {name} fits better (by {NEAR * mirror:.2%} of the "
            "diameter): a mirrored copy, another object, or a camera whose x or y axis points "
            "the other way"
        )
    elif is_other_size:
        status = "contradicted"
        reason = (
            f"{size}, and the sensor explains {max_size_error + sensor_error:.0%}: a copy "
            "of another size, another object, or a wrong unit, camera or focal length"
        )
    elif size_error + _SURE * scale.sigma + offset_error > _OTHER_SIZES:
        reason = f"what was seen does not fix the size: {size}"
    elif mirror is not None and mirror > -_MIRROR_GAIN:
        reason = f"the mirror image of {name} fits what was seen as well"
    elif scale.gain > _SIZE_GAIN:
        reason = f"{size}, which a sensor's errors may explain"
    elif size_error > max(_NEAR_SIZE, _SURE * scale.sigma) + offset_error:
        reason = f"{size}, and not that of the model"
    elif evidence.contradicted > 0:
        reason = (
            f"{evidence.contradicted / (evidence.supported + evidence.contradicted):.1%} of what "
            "was compared contradicts the model: a similar part, or one that differs from its file"
        )
    else:
        status = "confirmed"
    return Identity(
        status=status,
        size=scale.times,
        size_deviation=scale.sigma,
        mirror_gain=None if mirror is None else NEAR * mirror,
        reason=reason,
    )
