"""Whether what was posed is the object: the size that fits best, and the mirror image."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose.compiled import serves
from depthpose.pose.config import IcpConfig
from depthpose.pose.estimator.fit import BORDER_PX, SHOWN, Seen
from depthpose.pose.estimator.inputs import ObjectCloud
from depthpose.pose.mesh import is_mirror_alike
from depthpose.pose.mesh.models import fibonacci_directions
from depthpose.pose.refine import refine_pose, refine_roughly
from depthpose.pose.surface import NEAR, Surface
from depthpose.pose.types import Fit, Identity, ObjectModel

POINTS = 400
"""Of the cloud, evenly taken."""
_STEPS = 12
_WIDE = 2.0
"""Times the usual limit of a distance in the first step."""
_INDEPENDENT = 10.0
"""So many neighbouring readings err alike: the variance is as many times as large."""
_STARTS = (1.0, 0.87, 1.15)
"""Scales at which the search begins: from one alone it stays there where the copy is smaller."""
_ROUGH_POINTS = 150
_TRUST = 0.03
"""A scale beside 1 must lower the mean squared distance, in squared limits, by so much."""
_CONVERGED = 3e-4
_PLANES = 24
"""Planes across which the posed model is mirrored for a start."""
_CLEAR = 0.05
"""Where the mirror image, roughly fitted, is so much farther from the points than the model, exact
steps do not bring it nearer: in 123 views the gain was then -0.035 at most."""
_FLIP = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
_OFFSET_M = 0.006
"""Sensors are off along the ray as a whole by 3 to 6 mm: so much nearer, a thing looks larger."""
_SURE = 2.0
"""Standard deviations."""
_SIZE_GAIN = 0.05
"""Where another size gains less (0.25 % of the diameter), what is seen of the surface fits at many,
or a sensor errs so: the right pose of a real bowl gains 0.032 at 1.07."""
_MIRROR_GAIN = 0.02
"""Gain from which a cloud is that of a mirrored copy, 0.1 % of the diameter: of right answers for
synthetic views it was at most 0.004, where the mirror image is not nearly the model."""
_OTHER_SIZES = 0.1
"""Sizes so far from 1 must be excluded for an identity to be confirmed."""
_BESIDE = 0.005
"""And no more of the readings may lie beside the silhouette, as those of a larger copy do."""


@dataclass(frozen=True)
class Scale:
    """How many times as large as the model the seen object is, and how sure that is.

    Attributes:
        times: 1 for the model itself.
        sigma: standard deviation of it.
        gain: by how much it lowers the root mean square distance of the points to the surface, in
            units of the distance up to which a point is near.
    """

    times: float
    sigma: float
    gain: float


def scale_of(cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface) -> Scale:
    """Measure the scale of the model that fits a cloud best, the pose moving with it.

    Point-to-plane ICP with a seventh unknown: the model grows about its middle ``c`` by ``s``,
    which moves its point ``p`` across the surface by ``n . (p - c) s``.
    """
    local_m = pose.inverse().apply(take_evenly(cloud_m.double(), POINTS))
    middle_m = (surface.points_m.amin(0) + surface.points_m.amax(0)) / 2
    starts = torch.tensor(_STARTS, dtype=torch.float64)
    few_m = take_evenly(local_m, _ROUGH_POINTS).expand(len(starts), -1, -1)
    times, turned_m, _ = _grow(few_m, starts, middle_m, surface, is_exact=False)
    costs = _distance(turned_m, times, middle_m, surface, is_exact=False).square()
    costs[0] -= _TRUST
    start = starts[costs.argmin()][None]
    times, turned_m, sigma = _grow(local_m[None], start, middle_m, surface, is_exact=True)
    reached = _distance(turned_m, times, middle_m, surface, is_exact=True)
    gain = distance_to(local_m, surface, is_exact=True) - reached[0]
    return Scale(float(times), float(sigma), float(gain))


def _grow(
    local_m: Float64[Tensor, "b n 3"],
    times: Float64[Tensor, " b"],
    middle_m: Float64[Tensor, "3"],
    surface: Surface,
    *,
    is_exact: bool,
) -> tuple[Float64[Tensor, " b"], Float64[Tensor, "b n 3"], Float64[Tensor, " b"]]:
    """Step by step to the scale and place that fit; give also the moved points and the spread."""
    widths = (1 + (_WIDE - 1) * max(0.0, 1 - 2 * step / _STEPS) for step in range(_STEPS))
    limits_m = [NEAR * surface.diameter_m * width for width in widths]
    if serves(local_m, times):
        from depthpose.pose.compiled.icp import grown

        times, local_m, variance = grown(
            local_m, times, middle_m, surface.target, limits_m, _CONVERGED, is_exact
        )
        return times, local_m, (_INDEPENDENT * variance).sqrt()
    sigma = torch.ones_like(times)
    for near_m in limits_m:
        motion, variance = _similar_step(
            local_m, times, middle_m, near_m, surface, is_exact=is_exact
        )
        times = (times * (1 + motion[:, 6].clamp(-0.1, 0.1))).clamp(0.5, 2.0)
        sigma = variance.clamp(min=0).sqrt()
        turn = rotation_by(motion[:, :3])
        local_m = (local_m - middle_m - motion[:, None, 3:6]) @ turn + middle_m
        if float(motion[:, [0, 1, 2, 6]].abs().max()) < _CONVERGED:
            break
    return times, local_m, sigma


def _similar_step(
    local_m: Float64[Tensor, "b n 3"],
    times: Float64[Tensor, " b"],
    middle_m: Float64[Tensor, "3"],
    limit_m: float,
    surface: Surface,
    *,
    is_exact: bool,
) -> tuple[Float64[Tensor, "b 7"], Float64[Tensor, " b"]]:
    """One step of turn, shift and growth about the middle, with a limit; the growth's variance."""
    own_m = (local_m - middle_m) / times[:, None, None] + middle_m
    index = surface.find(own_m, is_exact=is_exact)
    normal = surface.normals[index]
    arm_m = times[:, None, None] * (surface.points_m[index] - middle_m)
    gap_m = local_m - middle_m - arm_m
    residual_m = (normal * gap_m).sum(-1)
    weight = (1 - gap_m.square().sum(-1) / limit_m**2).clamp(min=0).square()
    growth_m = (normal * arm_m).sum(-1, keepdim=True)
    J = torch.cat([torch.linalg.cross(arm_m, normal), normal, growth_m], -1)
    weighted = J.mT * weight[:, None]
    H = weighted @ J
    size = H.diagonal(dim1=1, dim2=2).amax(-1)[:, None, None].clamp(min=1e-9)
    inverse = torch.linalg.inv(H + 1e-9 * size * torch.eye(7, dtype=torch.float64))
    motion = (inverse @ (weighted @ residual_m[..., None])).squeeze(-1)
    left_m = residual_m - (J @ motion[..., None]).squeeze(-1)
    variance = (weight * left_m.square()).sum(-1) / (weight.sum(-1) - 7).clamp(min=1)
    return motion, _INDEPENDENT * variance * inverse[:, 6, 6]


def _distance(
    local_m: Float64[Tensor, "b n 3"],
    times: Float64[Tensor, " b"],
    middle_m: Float64[Tensor, "3"],
    surface: Surface,
    *,
    is_exact: bool,
) -> Float64[Tensor, " b"]:
    """Distance to the surface so many times as large."""
    own_m = (local_m - middle_m) / times[:, None, None] + middle_m
    return distance_to(own_m, surface, times, is_exact=is_exact)


def distance_to(
    local_m: Float64[Tensor, "*batch n 3"],
    surface: Surface,
    times: Float64[Tensor, "*batch"] | None = None,
    *,
    is_exact: bool,
) -> Float64[Tensor, "*batch"]:
    """Root mean square distance of points to a surface, in limits of nearness, cut off at 1."""
    gap_m = (local_m - surface.points_m[surface.find(local_m, is_exact=is_exact)]).norm(dim=-1)
    if times is not None:
        gap_m = times[..., None] * gap_m
    return (gap_m / (NEAR * surface.diameter_m)).clamp(max=1).square().mean(-1).sqrt()


def mirror_gain(cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface) -> float:
    """Measure by how much nearer the points lie to the mirror image of the model, where it fits.

    The cloud is mirrored in place of the model, so that ICP finds a pose.
    """
    local_m = pose.inverse().apply(take_evenly(cloud_m.double(), POINTS))
    middle_m = (surface.points_m.amin(0) + surface.points_m.amax(0)) / 2
    mirrored_m = (local_m - middle_m) * _FLIP + middle_m
    config = IcpConfig()
    tried = refine_roughly(mirrored_m, _mirrored(middle_m), surface, config)
    few_m = take_evenly(mirrored_m, 100).expand(len(tried.R), -1, -1)
    rough = distance_to(tried.inverse().apply(few_m), surface, is_exact=False)
    own = distance_to(take_evenly(local_m, 100), surface, is_exact=False)
    if float(rough.min() - own) > _CLEAR:
        return float(own - rough.min())
    nearest = rough.argmin()[None]  # one is enough: three found no other gain in 24 views
    config = replace(config, start_distance_diameters=config.end_distance_diameters)
    found = refine_pose(mirrored_m, tried[nearest], surface, config)
    exact_m = found.camera_from_model.inverse().apply(mirrored_m[None])
    own = distance_to(local_m, surface, is_exact=True)
    return float(own - distance_to(exact_m, surface, is_exact=True).min())


def _mirrored(middle_m: Float64[Tensor, "3"]) -> Rigid:
    """Poses of the mirrored cloud: those at which a plane through the middle mirrors it back."""
    normals = fibonacci_directions(_PLANES)
    across = torch.eye(3, dtype=torch.float64) - 2 * normals[:, :, None] * normals[:, None]
    R = _FLIP[:, None] * across
    return Rigid(R, middle_m - R @ middle_m)


def identity_of(
    cloud: ObjectCloud,
    pose: Rigid,
    model: ObjectModel,
    surface: Surface,
    fit: Fit,
    seen: Seen,
    max_size_error: float,
) -> Identity:
    """Fit another size and the mirror image, and say whether one of them is what was seen."""
    scale = scale_of(cloud.cloud_m, pose, surface)
    mirror = None
    if not is_mirror_alike(model):
        mirror = mirror_gain(cloud.cloud_m, pose, surface)
    distance_m = float(cloud.cloud_m[:, 2].double().median())
    border_m = BORDER_PX * distance_m / float(seen.K[0, 0])
    sensor = _OFFSET_M / distance_m + 2 * border_m / surface.diameter_m
    off = abs(scale.times - 1)
    is_other_size = off > max_size_error + sensor + _SURE * scale.sigma and scale.gain > _SIZE_GAIN
    measured = {
        "size": scale.times,
        "size_deviation": scale.sigma,
        "mirror_gain": None if mirror is None else NEAR * mirror,
    }
    if mirror is not None and mirror > max(_MIRROR_GAIN, scale.gain if is_other_size else 0.0):
        reason = (
            f"the mirror image of {model.name} fits better (by {NEAR * mirror:.2%} of the "
            "diameter): a mirrored copy, another object, or a camera whose x or y axis points "
            "the other way"
        )
        return Identity(status="contradicted", reason=reason, **measured)
    if is_other_size:
        reason = (
            f"{_size_words(scale)}, and the sensor explains {max_size_error + sensor:.0%}: a copy "
            "of another size, another object, or a wrong unit or camera"
        )
        return Identity(status="contradicted", reason=reason, **measured)
    reason = ""
    if off + _SURE * scale.sigma > _OTHER_SIZES + sensor:
        reason = f"what was seen does not fix the size: {_size_words(scale)}"
    elif mirror is not None and mirror > -_MIRROR_GAIN:
        reason = f"the mirror image of {model.name} fits what was seen as well"
    elif scale.gain > _SIZE_GAIN:
        reason = f"{_size_words(scale)}, which a sensor's errors may explain"
    elif fit.beyond > _BESIDE:
        reason = f"{fit.beyond:.1%} of the object's readings lie beside the posed silhouette"
    elif fit.agrees < SHOWN:
        reason = f"{1 - fit.agrees:.0%} of what was seen of the surface does not agree"
    return Identity(status="not excluded" if reason else "confirmed", reason=reason, **measured)


def _size_words(scale: Scale) -> str:
    return (
        f"{scale.times:.2f} times the model's size fits best (standard deviation {scale.sigma:.2f})"
    )
