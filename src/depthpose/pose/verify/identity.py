"""Whether what was posed is the object: its size, its handedness, and nothing that contradicts it.

Another size is fitted as a seventh unknown of ICP, and the mirror image as a model of its own.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, fit_rigid
from depthpose.pose.compiled import array_of, compiled, cross, dot, minus, vector
from depthpose.pose.geometry.surface import NEAR, SampleTree, Surface, match
from depthpose.pose.icp import (
    Residuals,
    build_normal_equations,
    make_rotation,
    refine_exactly,
    refine_roughly,
    tukey_weight,
)
from depthpose.pose.mesh import MIRROR_ALIKE
from depthpose.pose.mesh.models import fibonacci_directions
from depthpose.pose.sensor import EDGE_PX, INDEPENDENT_SIDES, LARGEST_OFFSET_M
from depthpose.pose.types import Evidence, Identity
from depthpose.pose.verify.evidence import Observation, compare
from depthpose.pose.verify.hypotheses import Hypothesis
from depthpose.pose.verify.target_object import TargetObject

POINTS = 400  #: points of the cloud that are compared, evenly taken
_ROUGH_POINTS = 150  # of these points, those that compare starts
_ROUGH_MIRROR_POINTS = 100  # of these points, those that compare starts of the mirror image
_STEPS = 12  # steps of ICP with a scale
_WIDE_STEP = 2.0  # distance limit of the first step, over the usual distance limit
_CONVERGED = 3e-4  # ICP with a scale stops at a smaller step [rad, diameters, share of the size]
_LARGEST_GROWTH = 0.1  # by which the size changes in one step, at most
_LEAST_SCALE = 0.5
_LARGEST_SCALE = 2.0
_CORRELATED_READINGS = 10.0  # factor of the variance, since as many neighbours share their error
_STARTS = (1.0, 0.87, 1.15)
"""Scales at which ICP starts: from 1 alone it would stay there for smaller copies."""
_FIRST_START_BONUS = 0.03
"""Subtracted from the mean squared distance of the start at scale 1, in squared limits of nearness
(``NEAR`` of the diameter)."""
_MIRROR_STEPS = 30  # exact steps of ICP with the mirror image
_MIRROR_PLANES = 24  # planes across which the posed model is mirrored, each for a start
_CLEARLY_WORSE = 0.05
"""Where the mirror image, roughly fitted, is so much farther from the points than the model, exact
steps do not bring it nearer: in 123 views the gain was then -0.035 at most. A distance is in limits
of nearness."""
_FLIP = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)  # the mirror image across x = 0
_LEAST_INFORMATION = 1e-9  # a step of ICP with a scale is damped by a billionth of it at least
_DEVIATIONS = 2.0  # standard deviations up to which the estimated size may be wrong
_SIZE_GAIN = 0.05
"""Least gain (:attr:`Scale.gain`) by which another size counts, 0.25 % of the diameter. With less
the visible surface fits at many sizes, or the sensor errs: the right pose of a real bowl gains
0.032 at 1.07."""
_EQUAL_AGREEMENT = 0.05
"""Difference of the shares that support two sizes up to which an image shows either as well."""
_MIRROR_GAIN = 0.02
"""Gain from which a cloud is that of a mirrored copy, 0.1 % of the diameter. Right answers for
synthetic views gained 0.004 at most, where the mirror image is not nearly the model."""
_OTHER_SIZES = 0.1  # sizes that differ by so much must be excluded to confirm an identity
_NEAR_SIZE = 0.03  # difference up to which a size is still the model's, beside its own error


@dataclass(frozen=True)
class Scale:
    """How many times as large as the model the observed object is, and how certain that is."""

    times: float  #: 1 for the model itself
    #: ``camera_from_model`` of a model that is so many times as large about its origin.
    pose: Rigid
    sigma: float  #: standard deviation of ``times``
    #: how much it lowers the root mean square distance of the points to the surface, in limits of
    #: nearness (``NEAR`` of the diameter).
    gain: float


def measure_scale(cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface) -> Scale:
    """Measure the scale of the model that fits a cloud best, the pose moving with it.

    Point-to-plane ICP with a seventh unknown: the model grows about its middle ``c`` by ``s``,
    which moves its point ``p`` across the surface by ``n . (p - c) s``.

    Args:
        cloud_m: points of the object, in the camera frame.
        pose: ``camera_from_model``.
        surface: of the model.
    """
    # The best of several starting scales, roughly.
    local_m = pose.inverse().apply(take_evenly(cloud_m.double(), POINTS))
    starts = torch.tensor(_STARTS, dtype=torch.float64)
    few_m = take_evenly(local_m, _ROUGH_POINTS).expand(len(starts), -1, -1)
    scales, moved_m = _fit_scale(few_m, starts, surface, is_exact=False)
    costs = measure_distance(moved_m, surface, scales, is_exact=False).square()
    costs[0] -= _FIRST_START_BONUS
    start = starts[costs.argmin()][None]

    # From it exactly.
    scale, moved_m = _fit_scale(local_m[None], start, surface, is_exact=True)
    distance = measure_distance(moved_m, surface, scale, is_exact=True)[0]
    gain = measure_distance(local_m, surface, is_exact=True) - distance
    residuals = _linearise_growth(
        array_of(moved_m[0]),
        float(scale),
        array_of(surface.middle_m),
        surface.near_m,
        surface.sample_tree,
        True,
        np.full(moved_m.shape[1], -1),
    )
    sigma = _estimate_scale_deviation(residuals, surface.deviation_m)

    # The points were moved in place of the surface, which grew about its middle.
    moved_from_local = fit_rigid(local_m, moved_m[0], torch.ones(len(local_m)).double())
    grown = pose.double() @ moved_from_local.inverse()
    origin_m = (1 - scale) * surface.middle_m  # of the model, moved as it grows
    grown = Rigid(grown.R, grown.apply(origin_m[None])[0])
    return Scale(times=float(scale), pose=grown, sigma=sigma, gain=float(gain))


def _estimate_scale_deviation(residuals: Residuals, object_std_m: float) -> float:
    """Estimate the standard deviation of a scale.

    It has two causes: noise of the readings, which neighbours share, and sides of the real object
    that deviate from the model by ``object_std_m``.
    """
    weight = residuals.weight
    H, _ = build_normal_equations(residuals, _LEAST_INFORMATION)
    inverse = float(np.linalg.inv(H)[6, 6])
    degrees = max(1.0, weight.sum() - 7)  # of freedom, with seven unknowns
    noise_m2 = (weight * residuals.distance**2).sum() / degrees
    variance = _CORRELATED_READINGS * noise_m2 * inverse
    variance += object_std_m**2 * weight.sum() * inverse / INDEPENDENT_SIDES
    return math.sqrt(max(0.0, variance))


def _fit_scale(
    local_m: Float64[Tensor, "b n 3"],
    start_scales: Float64[Tensor, " b"],
    surface: Surface,
    *,
    is_exact: bool,
) -> tuple[Float64[Tensor, " b"], Float64[Tensor, "b n 3"]]:
    """Iterate point-to-plane ICP with a scale as a seventh unknown.

    Args:
        local_m: points in the model frame, for each start.
        start_scales: scales to begin with.
        surface: of the model.
        is_exact: whether the nearest samples are searched, not looked up in a table.

    Returns:
        The scale that each start ends at, and its points, moved rigidly.
    """
    # The limit of a distance shrinks over half of the steps, then stays.
    factors = [1 + (_WIDE_STEP - 1) * max(0.0, 1 - 2 * step / _STEPS) for step in range(_STEPS)]
    limits_m = surface.near_m * np.array(factors)
    moved = array_of(local_m).copy()
    scales = array_of(start_scales).copy()
    _grow(
        moved,
        scales,
        array_of(surface.middle_m),
        surface.diameter_m,
        limits_m,
        surface.sample_tree,
        is_exact,
    )
    return torch.from_numpy(scales), torch.from_numpy(moved)


@compiled
def _grow(
    local: Float64[np.ndarray, "b n 3"],
    times: Float64[np.ndarray, " b"],
    middle: Float64[np.ndarray, "3"],
    diameter: float,
    limits: Float64[np.ndarray, " steps"],
    target: SampleTree,
    is_exact: bool,
) -> None:
    """Take steps of ICP with a scale, until no start moves any more.

    Args:
        local: points in the model frame, for each start; changed.
        times: scale of each start; changed.
        middle: about which the surface grows.
        diameter: of the surface.
        limits: of the distance, for each step.
        target: samples of the surface.
        is_exact: whether samples are searched, not looked up in a table.
    """
    places = np.full(local.shape[:2], -1)
    for limit in limits:
        largest = 0.0
        for start in range(len(times)):
            residuals = _linearise_growth(
                local[start], times[start], middle, limit, target, is_exact, places[start]
            )
            H, b = build_normal_equations(residuals, _LEAST_INFORMATION)
            motion = np.linalg.solve(H, b)  # rotation, translation, growth
            growth = min(max(motion[6], -_LARGEST_GROWTH), _LARGEST_GROWTH)
            grown = times[start] * (1 + growth)
            times[start] = min(max(grown, _LEAST_SCALE), _LARGEST_SCALE)

            # The points move by the inverse of the surface's motion.
            rotation = make_rotation(motion)
            local[start] = (local[start] - middle - motion[3:6]) @ rotation + middle
            for k in (0, 1, 2, 6):
                largest = max(largest, abs(motion[k]))
            for k in (3, 4, 5):
                largest = max(largest, abs(motion[k]) / diameter)
        if largest < _CONVERGED:
            break


@compiled
def _linearise_growth(
    local: Float64[np.ndarray, "n 3"],
    scale: float,
    middle: Float64[np.ndarray, "3"],
    limit: float,
    target: SampleTree,
    is_exact: bool,
    places: Int64[np.ndarray, " n"],
) -> Residuals:
    """Match points with a surface ``scale`` times as large, and linearise their distances from it.

    The unknowns are rotation and translation of the surface, and its growth about its middle.
    Samples count whichever way they face.

    Args:
        local: points in the model frame.
        scale: of the surface.
        middle: about which it grows.
        limit: distance from which a point has no weight.
        target: samples of the surface at its own size.
        is_exact: whether samples are searched, not looked up in a table.
        places: of the samples of the points, or -1; written.
    """
    # Matched with the surface at its own size.
    count = len(local)
    unscaled = (local - middle) / scale + middle
    centre = (middle[0], middle[1], middle[2])
    match(unscaled, target, centre, -np.inf, limit / scale, is_exact, places)
    residuals = Residuals(np.zeros((count, 7)), np.zeros(count), np.zeros(count))
    for i in range(count):
        if places[i] < 0:
            continue

        # The distance, and how the surface's motion and growth change it.
        normal = vector(target.normals, places[i])
        x, y, z = minus(vector(target.tree.points, places[i]), centre)
        arm = (scale * x, scale * y, scale * z)
        gap = minus(minus(vector(local, i), centre), arm)
        weight = tukey_weight(dot(gap, gap), limit)
        if weight <= 0:
            continue
        moment = cross(arm, normal)
        for c in range(3):
            residuals.jacobian[i, c] = moment[c]
            residuals.jacobian[i, 3 + c] = normal[c]
        residuals.jacobian[i, 6] = dot(normal, arm)
        residuals.distance[i] = dot(normal, gap)
        residuals.weight[i] = weight
    return residuals


def measure_distance(
    local_m: Float64[Tensor, "*batch n 3"],
    surface: Surface,
    times: Float64[Tensor, "*batch"] | None = None,
    *,
    is_exact: bool,
) -> Float64[Tensor, "*batch"]:
    """Measure the root mean square distance of points to a surface, in limits of nearness.

    Distances are cut off at 1, the limit.

    Args:
        local_m: points in the model frame.
        surface: of the model.
        times: scale of the surface about its middle, of each batch; None: its own size.
        is_exact: whether the nearest samples are searched, not looked up in a table.
    """
    if times is not None:
        local_m = (local_m - surface.middle_m) / times[:, None, None] + surface.middle_m
    distance_m = surface.nearest(local_m, is_exact=is_exact).distance_m
    if times is not None:
        distance_m = times[..., None] * distance_m
    return (distance_m / surface.near_m).clamp(max=1).square().mean(-1).sqrt()


def measure_mirror_gain(cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface) -> float:
    """Measure how much nearer a cloud lies to the mirror image of the model, in its best pose.

    The cloud is mirrored in place of the model, so that ICP finds a pose. The distances of ICP are
    fixed, as in :func:`measure_scale`: the gains that decide were measured with them.

    Returns:
        The gain in root mean square distance, in limits of nearness; negative where the mirror
        image fits worse. It is measured roughly where the mirror image is clearly worse.
    """
    # The cloud, mirrored across the x axis of the camera, which stays where it is.
    cloud_m = take_evenly(cloud_m.double(), POINTS)
    mirrored_m = cloud_m * _FLIP

    # Starts: the model reflected at many planes through its middle, and mirrored as the cloud was.
    normals = fibonacci_directions(_MIRROR_PLANES)
    reflections = torch.eye(3).double() - 2 * normals[:, :, None] * normals[:, None]
    R = _FLIP[:, None] * pose.R.double() @ reflections
    middle_m = _FLIP * pose.double().apply(surface.middle_m[None])[0]
    starts = Rigid(R, middle_m - R @ surface.middle_m)
    rough = refine_roughly(mirrored_m, starts, surface, NEAR)

    # Is the mirror image clearly worse?
    few_m = take_evenly(mirrored_m, _ROUGH_MIRROR_POINTS).expand(len(rough.R), -1, -1)
    distance = measure_distance(rough.inverse().apply(few_m), surface, is_exact=False)
    local_m = pose.double().inverse().apply(cloud_m)
    few_m = take_evenly(local_m, _ROUGH_MIRROR_POINTS)
    unmirrored = measure_distance(few_m, surface, is_exact=False)
    if float(distance.min() - unmirrored) > _CLEARLY_WORSE:
        return float(unmirrored - distance.min())

    # Exactly, from the best start alone: the best three had no other gain in 24 views.
    best = distance.argmin()[None]
    refined = refine_exactly(
        mirrored_m,
        rough[best],
        surface,
        iterations=_MIRROR_STEPS,
        start_diameters=NEAR,
        end_diameters=NEAR,
    )
    exact_m = refined.camera_from_model.inverse().apply(mirrored_m[None])
    distance = measure_distance(exact_m, surface, is_exact=True)
    unmirrored = measure_distance(local_m, surface, is_exact=True)
    return float(unmirrored - distance.min())


def _bound_size_error(distance_m: float, focal_px: float, diameter_m: float) -> float:
    """Bound the share by which an offset and displaced edges of a sensor may change a size."""
    edges_m = 2 * EDGE_PX * distance_m / focal_px
    return _bound_offset_error(distance_m) + edges_m / diameter_m


def _bound_offset_error(distance_m: float) -> float:
    """Bound the share by which a sensor's offset may change a size: that of the distance."""
    return LARGEST_OFFSET_M / distance_m


class _Fits(NamedTuple):
    """What other fits of a model to a cloud found, and how far their results may be off."""

    name: str  #: of the model
    scale: Scale  #: that fits best
    is_size_seen: bool  #: whether the image supports it as well as the model's size
    mirror_gain: float | None  #: None where the mirror image is the model itself
    size_tolerance: float  #: share by which a right object may seem to differ in size
    mirror_tolerance: float  #: gain of the mirror image that deviating sides explain
    offset_error: float  #: share by which a sensor's offset may change the size


def identify(
    best: Hypothesis, observation: Observation, target: TargetObject, max_size_error: float
) -> Identity:
    """Check whether a posed object has the size and the handedness of its model.

    Args:
        best: the pose, with its evidence.
        observation: of the object.
        target: the object.
        max_size_error: share by which a real object may differ in size from its model.
    """
    # The best fits of another size and of the mirror image.
    cloud_m = observation.cloud_m
    surface = target.surface
    scale = measure_scale(cloud_m, best.pose, surface)
    has_mirror_image = target.copies.mirror > MIRROR_ALIKE
    gain = measure_mirror_gain(cloud_m, best.pose, surface) if has_mirror_image else None

    # Errors that explain a difference: of the sensor, and of sides that deviate from the model.
    distance_m = float(cloud_m[:, 2].median())
    sensor_error = _bound_size_error(distance_m, observation.focal_px, surface.diameter_m)
    sides_m = surface.deviation_m / math.sqrt(INDEPENDENT_SIDES)
    fits = _Fits(
        name=target.model.name,
        scale=scale,
        is_size_seen=_is_size_seen(scale, best, observation, surface),
        mirror_gain=gain,
        size_tolerance=max_size_error + sensor_error,
        mirror_tolerance=sides_m / surface.near_m,
        offset_error=_bound_offset_error(distance_m),
    )

    # What they say of the object.
    is_size_measured = fits.is_size_seen or scale.gain <= _SIZE_GAIN
    reason = _explain_contradiction(fits)
    if reason:
        status = "contradicted"
    else:
        reason = _explain_unconfirmed(fits, best.evidence)
        status = "not excluded" if reason else "confirmed"
    return Identity(
        status=status,
        size=scale.times if is_size_measured else None,
        size_deviation=scale.sigma if is_size_measured else None,
        mirror_gain=None if gain is None else NEAR * gain,
        reason=reason,
    )


def _is_size_seen(
    scale: Scale, best: Hypothesis, observation: Observation, surface: Surface
) -> bool:
    """Whether the image supports the model of another size as well as the model of its own size.

    The model is compared in a unit of length in which it has its own size. Points beside an object
    lie near a larger model too, beyond which the camera then sees.
    """
    resized = compare(
        observation.in_units_of(scale.times),
        Rigid(scale.pose.R, scale.pose.t_m / scale.times),
        surface,
    )
    return resized.agreement >= best.evidence.agreement - _EQUAL_AGREEMENT


def _explain_contradiction(fits: _Fits) -> str:
    """Explain which other fit is clearly better than that of the model; empty where none is."""
    scale = fits.scale
    largest_error = fits.size_tolerance + _DEVIATIONS * scale.sigma
    is_other_size = (
        abs(scale.times - 1) > largest_error and scale.gain > _SIZE_GAIN and fits.is_size_seen
    )

    # Where both another size and the mirror image fit better, the one that gains more is named.
    size_gain = scale.gain if is_other_size else 0.0
    least_gain = max(_MIRROR_GAIN, fits.mirror_tolerance, size_gain)
    if fits.mirror_gain is not None and fits.mirror_gain > least_gain:
        return (
            f"the mirror image of {fits.name} fits better (by {NEAR * fits.mirror_gain:.2%} of the "
            "diameter): a mirrored copy, another object, or a camera whose x or y axis points "
            "the other way"
        )
    if is_other_size:
        return (
            f"{_describe_size(scale)}, and the sensor explains {fits.size_tolerance:.0%}: a copy "
            "of another size, another object, or a wrong unit, camera or focal length"
        )
    return ""


def _explain_unconfirmed(fits: _Fits, evidence: Evidence) -> str:
    """Explain what keeps a model without contradiction from being confirmed; empty if nothing."""
    scale = fits.scale
    size_error = abs(scale.times - 1)
    deviation = _DEVIATIONS * scale.sigma

    # Is another size or the mirror image excluded?
    if size_error + deviation + fits.offset_error > _OTHER_SIZES:
        hidden = (
            "" if fits.is_size_seen else ", but not the image: points beside the object hide it"
        )
        return f"what was seen does not fix the size: {_describe_size(scale)}{hidden}"
    if fits.mirror_gain is not None and fits.mirror_gain > -_MIRROR_GAIN:
        return f"the mirror image of {fits.name} fits what was seen as well"

    # And is it the model's own size, with nothing that contradicts it?
    if scale.gain > _SIZE_GAIN:
        return f"{_describe_size(scale)}, which a sensor's errors may explain"
    if size_error > max(_NEAR_SIZE, deviation) + fits.offset_error:
        return f"{_describe_size(scale)}, and not that of the model"
    contradicted = evidence.contradicted + evidence.continued
    if contradicted > 0:
        share = contradicted / (evidence.supported + contradicted)
        return (
            f"{share:.1%} of what was compared contradicts the model: a similar part, or one that "
            "differs from its file"
        )
    return ""


def _describe_size(scale: Scale) -> str:
    """Describe the size that fits best, and how certain it is."""
    return (
        f"{scale.times:.2f} times the model's size fits best (standard deviation {scale.sigma:.2f})"
    )
