"""The answer: the likeliest pose, or why it is withheld.

It must fit what the camera saw, be fixed by it, and be of that object: its size, its handedness.
The posed surface is compared with the readings at the sensor's own scale.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torch.nn.functional import max_pool2d

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, cross_matrix, rotation_by
from depthpose.pose.cloud import ObjectCloud, Refusal, cloud_from_depth, grow_mask
from depthpose.pose.compiled import use_numba
from depthpose.pose.config import EstimateConfig, IcpConfig, RefusalConfig
from depthpose.pose.estimator.candidates import (
    Candidate,
    KnownObject,
    PoseAmbiguities,
    difference_of,
    nearest_posed,
)
from depthpose.pose.mesh import MIRROR_ALIKE
from depthpose.pose.mesh.models import fibonacci_directions
from depthpose.pose.refine import refine_pose, refine_roughly
from depthpose.pose.surface import BESIDE, NEAR, Surface, finite_array
from depthpose.pose.types import (
    Alternative,
    AnyInput,
    Axis,
    Fit,
    Identity,
    PoseEstimate,
    Symmetries,
    ViewInput,
    Vote,
)

BORDER_PX = 2
"""Readings so near an edge may be of either side: stereo and structured light match windows, and
a mask ends so far from the silhouette."""
_SHOWN = 0.95  # so much of the seen surface agrees at a right pose that a sensor reads well
_NOISES = 3.0
_WIDEST = 2.0  # times the usual limit, whatever the noise: beyond, what was read is no surface
FLOOR = 0.01
"""Added to a signal before its logarithm is taken, which is finite where there is none."""
_NAMED = 0.02  # candidates of a smaller share are not named
_SAMPLED = 1000  # points of the cloud that say how well it fixes a pose
_COMPARED = 1000  # readings of the object, evenly taken, that are laid on the surface
_LAG_PX = 3  # noise is compared so far apart: neighbouring pixels of a real sensor err alike
_FINEST = 0.01  # of the diameter: models are no more exact
_CELLS = 40  # of the z-buffer along a diameter, at most; no finer than pixels and samples
_GRAZING = 0.2  # cosine below which a surface is not compared: no sensor reads it well
_WIDE = 0.6  # half of the window about the object, in diameters


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """What a camera saw about an object, in a window of its image."""

    depth_m: Float64[Tensor, "h w"]  #: NaN where there is no reading
    is_own: Bool[Tensor, "h w"]  #: the pixels that are said to be the object's
    K: Float64[Tensor, "3 3"]  #: of the window
    noise_m: float  #: standard deviation of a reading, of what neighbours do not share


def seen_about(cloud_m: Float[Tensor, "n 3"], view: ViewInput | None, diameter_m: float) -> Seen:
    """Cut the window of an object out of its view; a cloud alone is drawn as its camera saw it."""
    cloud_m = cloud_m.double()
    if view is None:  # a camera to which the points of the cloud are a pixel apart
        rays = cloud_m[:, :2] / cloud_m[:, 2:]
        apart = torch.cdist(take_evenly(rays, 200), take_evenly(rays, 5000))
        apart = apart.masked_fill(apart < 1e-9, torch.inf).amin(-1)
        focal = 1 / (1.5 * float(apart.median()))
        focal *= (min(len(rays), 5000) / len(rays)) ** -0.5
        K = torch.diag(torch.tensor([focal, focal, 1.0], dtype=torch.float64))
    else:
        K = view.K.double()
    u, v = (cloud_m @ K.T)[:, :2].div(cloud_m[:, 2:]).round().long().unbind(-1)
    reach = int(_WIDE * diameter_m / float(cloud_m[:, 2].median()) * float(K[0, 0])) + 4
    low = torch.stack([u.amin(), v.amin()]) - reach
    high = torch.stack([u.amax(), v.amax()]) + reach + 1
    if view is not None:
        size = torch.tensor(view.depth_m.shape).flip(0)
        low, high = low.clamp(min=0), torch.minimum(high, size)
    (left, top), (right, bottom) = low.tolist(), high.tolist()
    inside = (u >= left) & (u < right) & (v >= top) & (v < bottom)
    place = ((v - top) * (right - left) + u - left)[inside]
    own = torch.zeros(bottom - top, right - left, dtype=torch.bool)
    own.view(-1)[place] = True
    own = grow_mask(grow_mask(own, 1), -1)  # of a large cloud some points are left out
    if view is None:
        drawn_m = torch.full((own.numel(),), torch.inf, dtype=torch.float64)
        drawn_m.scatter_reduce_(0, place, cloud_m[inside, 2], "amin")
        depth_m = drawn_m.view(own.shape)
    else:
        depth_m = view.depth_m[top:bottom, left:right].double()
    depth_m = torch.where(depth_m.isfinite() & (depth_m > 0), depth_m, torch.nan)
    moved = K.clone()
    moved[:2, 2] -= torch.tensor([left, top], dtype=torch.float64)
    # Noise by second differences, which a slope does not change.
    own_m, found = torch.where(grow_mask(own, -1), depth_m, torch.nan), []
    for along_m in (own_m, own_m.T):
        ends_m = along_m[:, : -2 * _LAG_PX] + along_m[:, 2 * _LAG_PX :]
        bent_m = (ends_m - 2 * along_m[:, _LAG_PX:-_LAG_PX]).flatten()
        found.append(bent_m[bent_m.isfinite()])
    bent_m = torch.cat(found).abs()
    noise_m = 1.4826 * float(bent_m.median()) / 6**0.5 if len(bent_m) > 0 else 0.0
    return Seen(depth_m=depth_m, is_own=own, K=moved, noise_m=noise_m)


def fit_of(seen: Seen, pose: Rigid, surface: Surface, rim: int = 0) -> Fit:
    """Compare a posed surface with what the camera saw.

    Each visible place of the surface is compared with the readings about its pixel, of which the
    nearest in depth counts: the sensor's edges are blurred. Beyond the noise they lie on the
    surface, behind it (the camera saw through the surface), or before it: as part of the object,
    which contradicts the pose, or of something that occludes it.

    Args:
        seen: about the object.
        pose: of the surface.
        surface: of the model.
        rim: so many cells, of a fortieth of the diameter or more, beside the silhouette and before
            what is farther off the camera may see through: stereo cuts edges.
    """
    pose = pose.double()
    points_m, normals = pose.apply(surface.points_m), surface.normals @ pose.R.mT
    near_m = NEAR * surface.diameter_m
    limit_m = min(max(_NOISES * seen.noise_m, near_m), _WIDEST * near_m)
    nothing = Fit(agrees=0.0, seen=0.0, beyond=1.0, explained=0.0, noise_m=seen.noise_m)
    if float(points_m[:, 2].min()) <= 0:
        return nothing
    pixel = (points_m @ seen.K.T)[:, :2] / points_m[:, 2:]
    cosine = ((normals * points_m).sum(-1) / points_m.norm(dim=-1)).abs()
    # Drawn into cells that are large enough to leave no hole.
    pixel_m = float(points_m[:, 2].median()) / float(seen.K[0, 0])
    side_m = max(pixel_m, surface.diameter_m / _CELLS, 1.5 * surface.spacing_m)
    side_px = side_m / pixel_m
    cell = (pixel / side_px).floor().long()
    border = int(-(-BORDER_PX // side_px))
    low = cell.amin(0) - border - 1
    columns, rows = (cell.amax(0) + border + 2 - low).tolist()
    number = (cell[:, 1] - low[1]) * columns + cell[:, 0] - low[0]
    drawn_m = torch.full((rows * columns,), torch.inf, dtype=torch.float64)
    drawn_m.scatter_reduce_(0, number, points_m[:, 2], "amin")
    nearest_m = -max_pool2d(-drawn_m.view(1, rows, columns), 3, 1, 1).flatten()[number]
    filled = grow_mask(grow_mask(drawn_m.view(rows, columns).isfinite(), 1), -1)
    is_covered = grow_mask(filled, border)  # cells within the silhouette or its border
    front_m = drawn_m.nan_to_num(posinf=-torch.inf).view(1, rows, columns)
    is_step = max_pool2d(front_m, 2 * rim + 1, 1, rim) > front_m + BESIDE * surface.diameter_m
    is_inner = (grow_mask(filled, -rim) & ~is_step[0]).flatten()[number]
    hidden_m = 2 * side_m * (1 - cosine.square()).sqrt() / cosine.clamp(min=_GRAZING)
    is_visible = points_m[:, 2] < nearest_m + _FINEST * surface.diameter_m + hidden_m
    height, width = seen.depth_m.shape
    u, v = pixel.round().long().unbind(-1)
    is_visible &= (cosine > _GRAZING) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = u[is_visible], v[is_visible]
    area, depth_m, is_inner = cosine[is_visible], points_m[is_visible, 2], is_inner[is_visible]
    if len(depth_m) == 0:
        return nothing
    # How far behind the surface the reading is that is nearest to it; NaN where there is none.
    off_m, steps = torch.full_like(depth_m, torch.nan), range(-BORDER_PX, BORDER_PX + 1)
    for down, right in product(steps, steps):
        read_m = seen.depth_m[(v + down).clamp(0, height - 1), (u + right).clamp(0, width - 1)]
        behind_m = read_m - depth_m
        is_nearer = ~(off_m.abs() <= behind_m.abs()) & behind_m.isfinite()
        off_m = torch.where(is_nearer, behind_m, off_m)
    off_m = off_m * area
    own = grow_mask(seen.is_own, -BORDER_PX)
    own = own if bool(own.any()) else seen.is_own  # thin things are all border
    agrees = float(area[off_m.abs() <= limit_m].sum())
    through = float(area[(off_m > limit_m) & is_inner].sum())
    bulges = float(area[(off_m < -limit_m) & own[v, u]].sum())
    read = (own & seen.depth_m.isfinite()).nonzero().flip(-1)
    column, row = ((read / side_px).floor().long() - low).unbind(-1)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    inside &= is_covered[row.clamp(0, rows - 1), column.clamp(0, columns - 1)]
    beyond = float((~inside).double().mean()) if len(read) else 0.0
    read_m = take_evenly(cloud_from_depth(seen.depth_m, own, seen.K), _COMPARED)
    local_m = pose.inverse().apply(read_m)
    apart_m = (local_m - surface.points_m[surface.nearest(local_m)]).norm(dim=-1)
    compared = agrees + through + bulges
    return Fit(
        agrees=agrees / compared if compared > 0 else 0.0,
        seen=agrees / float(area.sum()),
        beyond=beyond,
        explained=float((apart_m < limit_m).double().mean()) if len(apart_m) else 0.0,
        noise_m=seen.noise_m,
    )


POINTS = 400  #: of the cloud, evenly taken
_STEPS = 12
_WIDE_STEP = 2.0  # times the usual limit of a distance in the first step
_INDEPENDENT = 10.0  # so many neighbouring readings err alike: the variance is so many times larger
_STARTS = (1.0, 0.87, 1.15)
"""Scales at which the search begins: from one alone it stays there where the copy is smaller."""
_ROUGH_POINTS = 150
_TRUST = 0.03  # a scale beside 1 must lower the mean squared distance, in squared limits, so much
_CONVERGED = 3e-4
_PLANES = 24  # planes across which the posed model is mirrored for a start
_CLEAR = 0.05
"""Where the mirror image, roughly fitted, is so much farther from the points than the model, exact
steps do not bring it nearer: in 123 views the gain was then -0.035 at most."""
_FLIP = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
_OFFSET_M = 0.006  # sensors are off along the ray by 3 to 6 mm: so much nearer, things look larger
_SURE = 2.0  # standard deviations
_SIZE_GAIN = 0.05
"""Where another size gains less (0.25 % of the diameter), what is seen of the surface fits at many,
or a sensor errs so: the right pose of a real bowl gains 0.032 at 1.07."""
_MIRROR_GAIN = 0.02
"""Gain from which a cloud is that of a mirrored copy, 0.1 % of the diameter: of right answers for
synthetic views it was at most 0.004, where the mirror image is not nearly the model."""
_OTHER_SIZES = 0.1  # sizes so far from 1 must be excluded for an identity to be confirmed
_NEAR_SIZE = 0.05  # and the size that fits is as near to 1, beside its deviation and an offset
_BESIDE = 0.005  # and no more readings may lie beside the silhouette, as a larger copy's do


@dataclass(frozen=True)
class Scale:
    """How many times as large as the model the seen object is, and how sure that is."""

    times: float  #: 1 for the model itself
    sigma: float  #: standard deviation of it
    #: by how much it lowers the root mean square distance of the points to the surface, in units of
    #: the distance up to which a point is near.
    gain: float


def scale_of(cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface) -> Scale:
    """Measure the scale of the model that fits a cloud best, the pose moving with it.

    Point-to-plane ICP with a seventh unknown: the model grows about its middle ``c`` by ``s``,
    which moves its point ``p`` across the surface by ``n . (p - c) s``.
    """
    local_m = pose.inverse().apply(take_evenly(cloud_m.double(), POINTS))
    middle_m = surface.middle_m
    starts = torch.tensor(_STARTS, dtype=torch.float64)
    few_m = take_evenly(local_m, _ROUGH_POINTS).expand(len(starts), -1, -1)
    times, turned_m, _ = _grow(few_m, starts, middle_m, surface, is_exact=False)
    costs = distance_to(turned_m, surface, times, is_exact=False).square()
    costs[0] -= _TRUST
    start = starts[costs.argmin()][None]
    times, turned_m, sigma = _grow(local_m[None], start, middle_m, surface, is_exact=True)
    reached = distance_to(turned_m, surface, times, is_exact=True)
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
    widths = (1 + (_WIDE_STEP - 1) * max(0.0, 1 - 2 * step / _STEPS) for step in range(_STEPS))
    limits_m = [NEAR * surface.diameter_m * width for width in widths]
    if use_numba(local_m, times):
        from depthpose.pose.compiled.poses import grow

        local_m, times = torch.from_numpy(finite_array(local_m.numpy()).copy()), times.clone()
        variance = torch.ones_like(times)
        arrays = (local_m.numpy(), times.numpy(), middle_m.numpy(), np.array(limits_m))
        grow(*arrays, surface.target, is_exact, _CONVERGED, variance.numpy())
        return times, local_m, (_INDEPENDENT * variance).sqrt()
    sigma = torch.ones_like(times)
    for limit_m in limits_m:
        own_m = (local_m - middle_m) / times[:, None, None] + middle_m
        index = surface.nearest(own_m) if is_exact else surface.boxes.look_up(own_m)
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
        sigma = (_INDEPENDENT * variance * inverse[:, 6, 6]).clamp(min=0).sqrt()
        times = (times * (1 + motion[:, 6].clamp(-0.1, 0.1))).clamp(0.5, 2.0)
        turn = rotation_by(motion[:, :3])
        local_m = (local_m - middle_m - motion[:, None, 3:6]) @ turn + middle_m
        if float(motion[:, [0, 1, 2, 6]].abs().max()) < _CONVERGED:
            break
    return times, local_m, sigma


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
        local_m = (local_m - surface.ball_m[:3]) / times[:, None, None] + surface.ball_m[:3]
    index = surface.nearest(local_m) if is_exact else surface.boxes.look_up(local_m)
    gap_m = (local_m - surface.points_m[index]).norm(dim=-1)
    if times is not None:
        gap_m = times[..., None] * gap_m
    return (gap_m / (NEAR * surface.diameter_m)).clamp(max=1).square().mean(-1).sqrt()


def mirror_gain(cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface) -> float:
    """Measure by how much nearer the points lie to the mirror image of the model, where it fits.

    The cloud is mirrored in place of the model, so that ICP finds a pose.
    """
    local_m = pose.inverse().apply(take_evenly(cloud_m.double(), POINTS))
    middle_m = surface.middle_m
    mirrored_m = (local_m - middle_m) * _FLIP + middle_m
    config = IcpConfig()
    normals = fibonacci_directions(_PLANES)  # of planes that mirror the cloud back
    R = _FLIP[:, None] * (torch.eye(3).double() - 2 * normals[:, :, None] * normals[:, None])
    tried = refine_roughly(mirrored_m, Rigid(R, middle_m - R @ middle_m), surface, config)
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


def sensor_size_error(distance_m: float, focal_px: float, diameter_m: float) -> float:
    """Give the share by which an offset and displaced edges of a sensor may change a size."""
    return _OFFSET_M / distance_m + 2 * BORDER_PX * distance_m / focal_px / diameter_m


def identity_of(
    cloud: ObjectCloud,
    pose: Rigid,
    known: KnownObject,
    copies: PoseAmbiguities,
    fit: Fit,
    seen: Seen,
    max_size_error: float,
) -> Identity:
    """Fit another size and the mirror image, and say whether one of them is what was seen."""
    model, surface = known.model, known.surface
    scale = scale_of(cloud.cloud_m, pose, surface)
    mirror = None
    if copies.mirror > MIRROR_ALIKE:
        mirror = mirror_gain(cloud.cloud_m, pose, surface)
    distance_m = float(cloud.cloud_m[:, 2].double().median())
    sensor = sensor_size_error(distance_m, float(seen.K[0, 0]), surface.diameter_m)
    off = abs(scale.times - 1)
    is_other_size = off > max_size_error + sensor + _SURE * scale.sigma and scale.gain > _SIZE_GAIN
    words = (
        f"{scale.times:.2f} times the model's size fits best (standard deviation {scale.sigma:.2f})"
    )
    status, reason = "not excluded", ""
    if mirror is not None and mirror > max(_MIRROR_GAIN, scale.gain if is_other_size else 0.0):
        status = "contradicted"
        reason = (
            f"the mirror image of {model.name} fits better (by {NEAR * mirror:.2%} of the "
            "diameter): a mirrored copy, another object, or a camera whose x or y axis points "
            "the other way"
        )
    elif is_other_size:
        status = "contradicted"
        reason = (
            f"{words}, and the sensor explains {max_size_error + sensor:.0%}: a copy "
            "of another size, another object, or a wrong unit or camera"
        )
    elif off + _SURE * scale.sigma > _OTHER_SIZES + sensor:
        reason = f"what was seen does not fix the size: {words}"
    elif mirror is not None and mirror > -_MIRROR_GAIN:
        reason = f"the mirror image of {model.name} fits what was seen as well"
    elif scale.gain > _SIZE_GAIN:
        reason = f"{words}, which a sensor's errors may explain"
    elif off > max(_NEAR_SIZE, _SURE * scale.sigma) + _OFFSET_M / distance_m:
        reason = f"{words}, and not that of the model"
    elif fit.beyond > _BESIDE:
        reason = f"{fit.beyond:.1%} of the object's readings lie beside the posed silhouette"
    elif fit.agrees < _SHOWN:
        reason = f"{1 - fit.agrees:.0%} of what was seen of the surface does not agree"
    else:
        status = "confirmed"
    return Identity(
        status=status,
        size=scale.times,
        size_deviation=scale.sigma,
        mirror_gain=None if mirror is None else NEAR * mirror,
        reason=reason,
    )


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
) -> tuple[float, Float64[Tensor, "6"]]:
    """Measure how well the seen surface determines the pose: 0 where a motion is unobservable.

    A motion ``y = (d/2 w, v)`` about the middle of the cloud moves a surface point at ``a`` with
    normal ``n`` across itself by ``n . v + (a x n) . w``. The observability is the root mean square
    of that over the points near the surface, for the unit motion that moves it least (Gelfand et
    al., Geometrically Stable Sampling for the ICP Algorithm, 2003). Motions of declared symmetries
    (``free``) are left out. The weakest motion is given too: (rotation, translation at the middle
    of the cloud), of unit length after scaling.
    """
    points = take_evenly(cloud_m.double(), _SAMPLED)
    distance_m, index = nearest_posed(points, pose, surface)
    near = distance_m < NEAR * surface.diameter_m
    weakest = torch.zeros(6, dtype=torch.float64)
    if int(near.sum()) < 6:
        return 0.0, weakest
    normal = (surface.normals[index] @ pose.R.mT)[near]
    middle, radius_m = points.mean(0), surface.diameter_m / 2
    arm = points[near] - middle
    J = torch.cat([torch.linalg.cross(arm, normal) / radius_m, normal], -1)
    # Declared symmetries as motions about the middle, turns in metres at the radius.
    turn, shift = free[:, :3].double(), free[:, 3:].double()
    own = torch.cat([turn * radius_m, shift + turn @ cross_matrix(middle)], -1)
    _, _, rows = torch.linalg.svd(own)  # the last ones are orthogonal to all of them
    basis = rows[int(torch.linalg.matrix_rank(own, rtol=1e-9)) :].T
    values, vectors = torch.linalg.eigh(basis.T @ (J.T @ J / len(J)) @ basis)
    return float(values[0].clamp(min=0).sqrt()), basis @ vectors[:, 0]


def without_motions(
    covariance: Float[Tensor, "6 6"], free: Float[Tensor, "m 6"]
) -> Float[Tensor, "6 6"]:
    """Give the covariance where the pose does not move along ``free``: finite, and 0 along them."""
    _, sizes, rows = torch.linalg.svd(free.double())
    basis = rows[int((sizes > 1e-9 * sizes[0]).sum()) :].T
    # Rotations and metres differ in size; the information of the rest is what counts.
    information = torch.linalg.inv(covariance.double())
    inner = torch.linalg.inv(basis.T @ information @ basis)
    return (basis @ inner @ basis.T).to(covariance)


def answer_of(
    cloud: ObjectCloud,
    known: KnownObject,
    candidates: Sequence[Candidate],
    evidence: Sequence[dict[str, float]],
    refusal: RefusalConfig,
    config: EstimateConfig,
    seconds: dict[str, float],
    vote: Vote | None = None,
) -> PoseEstimate:
    """Choose among poses by the evidence against each; ask whether it fits and is that object."""
    began = time.perf_counter()
    surface, copies = known.surface, known.copies
    assert copies is not None, "found with the candidates"
    shares = share_out(evidence, refusal.candidate_slopes)
    number, *others = shares.argsort(descending=True, stable=True).tolist()
    seen = seen_about(cloud.cloud_m, cloud.view, surface.diameter_m)
    pose, covariance, residual_m = candidates[number]
    fit = fit_of(seen, pose, surface)
    free = free_motions(known.model.symmetries.continuous, pose)
    observable, motion = observability(cloud.cloud_m, pose, surface, free)
    whole, _ = observability(pose.apply(surface.points_m), pose, surface, free)
    fixed = observable / max(whole, FLOOR)
    found = _chance_found(fit, evidence[number], fixed, surface.diameter_m)
    shares = shares * found  # the rest is that of a pose that was not found
    reason, identity = misfit_of(fit, refusal), None
    if reason is None and observable < refusal.min_observability:
        what = "turn" if float(motion[:3].norm()) > math.sqrt(0.5) else "shift"
        reason = Refusal(
            status="not observable",
            reason=f"the seen part of the object leaves one {what} undetermined: it moves the "
            f"surface along its normals by {observable:.1%} of the motion only; no declared "
            "symmetry allows it. Declare the symmetry, or look from a side that shows more",
        )
    elif reason is None and found < refusal.min_found:
        reason = Refusal(
            status="doubtful",
            reason=f"with a chance of {found:.0%} the right pose is among those that were found: "
            f"{1 - fit.agrees:.0%} of the seen surface disagrees, {1 - fit.explained:.0%} of the "
            f"readings are elsewhere, and the view fixes the pose {fixed:.0%} as well as it could",
        )
    if reason is None and config.with_icp and refusal.max_size_error < 1:
        identity = identity_of(cloud, pose, known, copies, fit, seen, refusal.max_size_error)
        if identity.status == "contradicted":
            reason = Refusal(status="doubtful", reason=identity.reason)
    facts: dict[str, Any] = {
        "name": cloud.name,
        "object": known.model.name,
        "keypoints_m": None if vote is None else vote.keypoints_m.float(),
        "inlier_share": None if vote is None else float(vote.inlier_share.mean()),
        "residual_m": residual_m,
        "signals": evidence[number],
        "fit": fit,
        "identity": identity,
        "seconds": {**seconds, "check": time.perf_counter() - began},
    }
    if reason is not None:  # all that was found out but the pose: nobody takes it for an answer
        is_doubted_cloud = cloud.view is None and reason.status == "doubtful"
        said = reason.reason + OTHER_FRAME * is_doubted_cloud
        return PoseEstimate(status=reason.status, reason=said, **facts)
    if len(free):
        covariance = without_motions(covariance, free)
    alternatives = tuple(
        Alternative(
            difference=difference_of(candidates[k].pose, pose, copies),
            camera_from_model=candidates[k].pose.float(),
            probability=float(shares[k]),
            signals=evidence[k],
        )
        for k in others
        if float(shares[k]) >= _NAMED
    )
    answer = PoseEstimate(
        status="ok",
        camera_from_model=pose.float(),  # worked out in float64, given as points and models come
        covariance=covariance.float(),
        free_motions=free.float(),
        certainty=float(shares[number]),
        alternatives=alternatives,
        **facts,
    )
    return with_status(answer, config.min_certainty)


OTHER_FRAME = (
    ". Or is the cloud not in the camera's frame (x right, y down, z forward)? A robot's base and "
    "the world have z up: give it as the camera saw it"
)
"""What may be wrong with a cloud that fits no pose: its origin is not where the camera was."""


def _chance_found(fit: Fit, signals: Mapping[str, float], fixed: float, diameter_m: float) -> float:
    """Give the chance that the right pose is among those found, by signs of the likeliest."""
    signs = (  # of a logistic regression on synthetic views of all shipped objects
        (1 - fit.agrees, 1.0),
        (1 - fit.explained, 0.35),
        (signals.get("disagree", 0.4), 2.6),  # registration is as one that disagrees so much
        (fit.noise_m / diameter_m, 0.5),
        (min(fixed, 1.0), -1.6),
    )
    return 1 / (1 + 200 * math.prod((FLOOR + sign) ** power for sign, power in signs))


def share_out(
    candidates: Sequence[Mapping[str, float]], slopes: Mapping[str, float]
) -> Float64[Tensor, " b"]:
    """Share the probability of one among candidates: ``exp(-sum slope log(0.01 + signal))``."""
    odds = [  # registration has no signal of a network
        -sum(slopes[k] * math.log(FLOOR + one[k]) for k in one if k in slopes) for one in candidates
    ]
    return torch.tensor(odds, dtype=torch.float64).softmax(0)


def with_status(answer: PoseEstimate, min_certainty: float) -> PoseEstimate:
    """Say that a pose is ambiguous where its certainty is below the limit, and else ok."""
    certainty, others = answer.certainty, len(answer.alternatives)
    if certainty is None:  # refused, or not compared
        return answer
    if certainty >= min_certainty:
        return replace(answer, status="ok", reason="")
    reason = (
        f"this pose has a certainty of {certainty:.0%}, below min_certainty {min_certainty:.0%}: "
        + (f"{others} others fit too" if others else "others may fit")
    )
    return replace(answer, status="ambiguous", reason=reason)


def misfit_of(fit: Fit, limits: RefusalConfig) -> Refusal | None:
    """Say why a pose does not fit what the camera saw; None where it does."""
    if fit.agrees < limits.min_agreement:
        reason = (
            f"of the posed surface that was seen {1 - fit.agrees:.0%} lies where the camera saw "
            f"something else, and {1 - limits.min_agreement:.0%} may: another object or pose"
        )
    elif fit.beyond > limits.max_beyond:
        reason = (
            f"{fit.beyond:.1%} of the object's readings lie beside the posed silhouette, and "
            f"{limits.max_beyond:.0%} may: another object, a larger one, or a mask of more than it"
        )
    else:
        return None
    return Refusal(status="doubtful", reason=reason)


def refused(given: AnyInput, refusal: Refusal, seconds: dict[str, float]) -> PoseEstimate:
    """Give the estimate of an input without a pose."""
    return PoseEstimate(
        name=given.name,
        object=given.object,
        status=refusal.status,
        reason=refusal.reason,
        seconds=seconds,
    )
