"""The road in a depth map: how high the camera stands, how it is tilted, and metres by that."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from depthpose.core.camera import Camera
from depthpose.core.errors import InputError
from depthpose.depth.types import DepthEstimate, Ground, Map, StereoInput

_INLIER = 0.06
"""Inverse depths within this share of the plane's belong to it."""
_POINTS = 2000
_DRAWS = 200
_STRIPS = 8
_LEAST_SHARE = 0.25
"""Of the points in the lower part of the image, on the plane; with less there is no ground."""
_MOST_ROLL_DEG = 10.0
_MOST_TILT, _MOST_ROLL = (math.tan(math.radians(angle)) for angle in (25, _MOST_ROLL_DEG))
_LEAST_HEIGHT_M = 0.2
_MOST_HEIGHT_M = 20.0
_MOST_ROAD_TILT_DEG = 15.0
_MOST_TILT_APART_DEG = 8.0
"""Steeper planes were no road in any of 59 views by cameras tilted up to 7 degrees, and roads were
at most 5.5 degrees off the true tilt."""
_ON_PLANE = 0.15
_FARTHEST_M = 200.0
"""What is off the plane by less, in the logarithm of depth, lies on it; by twice as much, not."""
_WINDOW_PX = 5
"""Side of the square around a pixel whose distance is known."""


def fit_ground(depth_m: Map, camera: Camera) -> Ground | None:
    """Fit a plane to the lower part of a depth map: RANSAC on inverse depth, then least squares.

    None where a quarter of the lower part does not lie on one that could be ground.
    """
    rays, inverse, strips = _lower_points(depth_m, camera)
    if len(inverse) < 60:
        return None
    chance = torch.Generator().manual_seed(0)
    drawn = torch.randint(len(inverse), (_DRAWS, 3), generator=chance)
    planes = torch.linalg.solve_ex(rays[drawn], inverse[drawn])[0]
    # Below the camera, and tilted and rolled as cameras of vehicles and hands are.
    size = planes.norm(dim=1).clamp(min=1e-9)
    tilt, roll = (planes[:, k].abs() / planes[:, 1] for k in (2, 0))
    is_upright = (planes[:, 1] > 0) & (tilt < _MOST_TILT) & (roll < _MOST_ROLL)
    is_near = (size > 1 / _MOST_HEIGHT_M) & (size < 1 / _LEAST_HEIGHT_M)
    is_usable = planes.isfinite().all(1) & is_upright & is_near
    errors = (planes[is_usable] @ rays.T / inverse - 1).abs()
    if not len(errors):
        return None
    is_on = errors[int((errors < _INLIER).sum(1).argmax())] < _INLIER
    plane, angles = _fit_plane(rays[is_on], inverse[is_on])
    for _ in range(3):
        plane, angles = _fit_plane(rays[is_on], inverse[is_on])
        is_on = (rays @ plane / inverse - 1).abs() < _INLIER
        if int(is_on.sum()) < 30:
            return None
    share, (height_m, tilt_deg, roll_deg) = float(is_on.double().mean()), angles
    is_upright = abs(tilt_deg) <= _MOST_ROAD_TILT_DEG and abs(roll_deg) < _MOST_ROLL_DEG
    if share < _LEAST_SHARE or not (is_upright and _LEAST_HEIGHT_M < height_m < _MOST_HEIGHT_M):
        return None
    selections = [k for k in (is_on & (strips != n) for n in range(_STRIPS)) if int(k.sum()) >= 30]
    parts = torch.tensor([_fit_plane(rays[k], inverse[k])[1] for k in selections])
    # The jackknife's deviation: how far the fit moves when a part of the columns is left out.
    spread = ((len(parts) - 1) / len(parts) * ((parts - parts.mean(0)) ** 2).sum(0)).sqrt()
    return Ground(
        height_m=height_m, tilt_deg=tilt_deg, roll_deg=roll_deg, share=share,
        height_std_m=float(spread[0]), tilt_std_deg=float(spread[1]),
    )  # fmt: skip


def _lower_points(
    depth_m: Map, camera: Camera
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"], Int[Tensor, " n"]]:
    """Rays (z = 1), inverse depths and column strips of points below and not at the sides."""
    height, width = depth_m.shape
    top = height * 3 // 5
    step = max(math.isqrt((height - top) * width // _POINTS), 1)
    rows = torch.arange(top, height, step)
    columns = torch.arange(width // 7, width * 6 // 7, step)
    v, u = (part.flatten() for part in torch.meshgrid(rows, columns, indexing="ij"))
    inverse = 1 / depth_m.detach().cpu().double()[v, u]
    has_depth = inverse.isfinite() & (inverse > 0)
    pixels = torch.stack([u, v, torch.ones_like(u)], 1).double()
    rays = pixels @ torch.linalg.inv(camera.K).T
    return rays[has_depth], inverse[has_depth], (u * _STRIPS // width)[has_depth]


def _fit_plane(
    rays: Float[Tensor, "n 3"], inverse: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "3"], tuple[float, float, float]]:
    """Fit ``plane @ ray = 1 / depth``; its height [m], tilt and roll [degrees] too."""
    weighed = rays / inverse[:, None]
    plane = torch.linalg.lstsq(weighed, torch.ones_like(inverse)[:, None]).solution[:, 0]
    x, y, z = plane.tolist()
    tilt_deg, roll_deg = (-math.degrees(math.atan2(across, y)) for across in (z, x))
    return plane, (1 / math.hypot(x, y, z), tilt_deg, roll_deg)


def scale_by_mount(estimate: DepthEstimate, image: StereoInput) -> DepthEstimate:
    """Find the ground and, where the camera's height is known, correct the scale by it.

    How large things look says another scale, so that the square root of the ground's factor is
    taken. With a tilt too the plane is known, and what lies on the ground gets its depth.
    """
    camera = image.camera
    name = image.name
    assert camera is not None and estimate.depth_m is not None  # noqa: PT018
    ground = fit_ground(estimate.depth_m, camera)
    if camera.mount_height_m is None:
        return replace(estimate, ground=ground)
    if ground is None:
        raise InputError(
            f"{name}: no road is seen in its lower part, so a camera height of "
            f"{camera.mount_height_m:g} m cannot set the scale; omit it, or give --known-distance"
        )
    if camera.tilt_deg is None:
        return rescale(estimate, (camera.mount_height_m / ground.height_m) ** 0.5, fit=ground)
    mounted = replace(ground, height_m=camera.mount_height_m, tilt_deg=camera.tilt_deg)
    rays, inverse, _ = _lower_points(estimate.depth_m, camera)
    true_inverse = rays @ _plane(mounted)
    is_on = ((rays @ _plane(ground) / inverse - 1).abs() < _INLIER) & (true_inverse > 0)
    if abs(camera.tilt_deg - ground.tilt_deg) > _MOST_TILT_APART_DEG or int(is_on.sum()) < 30:
        raise InputError(
            f"{name}: a tilt of {camera.tilt_deg:g} degrees is given, and the road that is seen "
            f"says {ground.tilt_deg:.1f}. Negative is down; correct it, or omit it"
        )
    factor = (inverse[is_on] / true_inverse[is_on]).median() ** 0.5
    height, width = estimate.depth_m.shape
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], 2).double() @ torch.linalg.inv(camera.K).T
    depth_m = estimate.depth_m.cpu().double()
    off = (rays @ _plane(ground) * depth_m).log().abs()
    on_plane = (2 - off / _ON_PLANE).clamp(0, 1).nan_to_num(0.0)
    to_plane = 1 / (rays @ _plane(mounted)).clamp(min=1 / _FARTHEST_M) / depth_m
    changed = factor ** (1 - on_plane) * to_plane**on_plane
    return replace(rescale(estimate, changed.to(estimate.depth_m)), ground=mounted)


def _plane(ground: Ground) -> Float[Tensor, "3"]:
    tilt, roll = (math.tan(math.radians(angle)) for angle in (ground.tilt_deg, ground.roll_deg))
    plane = torch.tensor([-roll, 1.0, -tilt], dtype=torch.float64)
    return plane / plane.norm() / ground.height_m


def rescale(
    estimate: DepthEstimate, factor: float | Map, *, fit: Ground | None = None
) -> DepthEstimate:
    """Multiply the depth of an estimate by ``factor``, and divide its disparity; not the sky's."""
    assert estimate.depth_m is not None
    ground = estimate.ground if fit is None else fit
    if ground is not None and not isinstance(factor, Tensor):
        ground = replace(
            ground, height_m=ground.height_m * factor, height_std_m=ground.height_std_m * factor
        )
    px = estimate.disparity_px / factor
    if estimate.is_sky is not None:
        px = torch.where(estimate.is_sky, estimate.disparity_px, px)
    return replace(estimate, depth_m=estimate.depth_m * factor, disparity_px=px, ground=ground)


def scale_by_distance(
    estimate: DepthEstimate, name: str, distance: tuple[float, float, float]
) -> DepthEstimate:
    """Make the depth around a pixel what was measured there: its column, its row, camera z [m].

    The median of 5x5 pixels counts; ``name`` is the image's, for errors.

    Raises:
        InputError: a pixel outside the image, no depth around it (the sky), or no distance.
    """
    column, row, metres = distance
    assert estimate.depth_m is not None
    height, width = estimate.depth_m.shape
    context = f"{name}: known distance {column:g},{row:g},{metres:g}"
    if not (math.isfinite(metres) and metres > 0):
        raise InputError(f"{context}: metres must be a positive number")
    if not (-0.5 <= column < width - 0.5 and -0.5 <= row < height - 0.5):
        raise InputError(
            f"{context}: the image is {width}x{height}, columns 0 to {width - 1} and rows 0 to "
            f"{height - 1}; give X,Y,METRES of a pixel of it"
        )
    reach = _WINDOW_PX // 2
    x = round(column)
    y = round(row)
    around = estimate.depth_m[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
    if not bool(estimate.depth_m[min(y, height - 1), min(x, width - 1)].isfinite()):
        raise InputError(f"{context}: there is no depth at this pixel (the sky?); take another")
    return rescale(estimate, metres / float(around[around.isfinite()].median()))
