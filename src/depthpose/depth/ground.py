"""The road in a depth map: a plane that is fitted to the lower part of the image."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from depthpose.core.camera import Camera
from depthpose.depth.types import Ground, Map

_MAX_RELATIVE_ERROR = 0.06
"""Largest difference of the inverse depth of an inlier from that of the plane, as a share of it."""
_POINTS = 2000
"""Number of points that a plane is fitted to, about."""
_RANSAC_SAMPLES = 200
"""Planes that are tried, each through three random points."""
_REFITS = 3
"""Least-squares fits after the first, each to the inliers of the one before."""
_MIN_POINTS = 60
"""Least number of points with depth in the lower part of an image, for a fit."""
_MIN_INLIERS = 30
"""Least number of inliers, for a fit."""
_STRIPS = 8
"""Strips of columns; the jackknife leaves one out at a time."""
_MIN_INLIER_SHARE = 0.25
"""Least share of inliers among the points in the lower part of the image; with fewer there is no
ground."""
_MAX_ROLL_DEG = 10.0
_MAX_TAN_TILT = math.tan(math.radians(25))
_MAX_TAN_ROLL = math.tan(math.radians(_MAX_ROLL_DEG))
_MIN_HEIGHT_M = 0.2
_MAX_HEIGHT_M = 20.0
"""Limits of the planes that RANSAC draws: those of cameras on vehicles and in hands."""
_MAX_ROAD_TILT_DEG = 15.0
"""Steeper planes were no road in any of 59 views by cameras tilted up to 7 degrees."""


def fit_ground(depth_m: Map, camera: Camera) -> Ground | None:
    """Fit a plane to the lower part of a depth map: RANSAC on inverse depth, then least squares.

    None where less than a quarter of the lower part lies on a plane that could be a road: below the
    camera, and nearly level.
    """
    rays, inverse, strips = _sample_lower_points(depth_m, camera)
    if len(inverse) < _MIN_POINTS:
        return None
    is_inlier = _find_ransac_inliers(rays, inverse)
    if is_inlier is None:
        return None

    # Least squares over the inliers, which are then found anew.
    plane = _fit_plane(rays[is_inlier], inverse[is_inlier])
    for _ in range(_REFITS):
        is_inlier = (rays @ plane / inverse - 1).abs() < _MAX_RELATIVE_ERROR
        if int(is_inlier.sum()) < _MIN_INLIERS:
            return None
        plane = _fit_plane(rays[is_inlier], inverse[is_inlier])
    share = float(is_inlier.double().mean())
    height_m, tilt_deg, roll_deg = _compute_mount(plane)
    is_level = abs(tilt_deg) <= _MAX_ROAD_TILT_DEG and abs(roll_deg) < _MAX_ROLL_DEG
    has_height = _MIN_HEIGHT_M < height_m < _MAX_HEIGHT_M
    if share < _MIN_INLIER_SHARE or not is_level or not has_height:
        return None

    stds = _estimate_jackknife_stds(rays, inverse, strips, is_inlier)
    if stds is None:
        return None
    height_std_m, tilt_std_deg = stds
    return Ground(
        height_m=height_m,
        tilt_deg=tilt_deg,
        roll_deg=roll_deg,
        share=share,
        height_std_m=height_std_m,
        tilt_std_deg=tilt_std_deg,
    )


def _find_ransac_inliers(
    rays: Float[Tensor, "n 3"], inverse: Float[Tensor, " n"]
) -> Bool[Tensor, " n"] | None:
    """Find the points on a plane by RANSAC: planes through three random points each are tried.

    ``rays`` and ``inverse``: as for :func:`_fit_plane`.

    Returns:
        Whether each point lies on the plane that most points lie on. Planes that are too steep, or
        not below the camera at a height of vehicles and hands, do not count; None where no other
        was drawn.
    """
    random = torch.Generator().manual_seed(0)
    triples = torch.randint(len(inverse), (_RANSAC_SAMPLES, 3), generator=random)
    planes = torch.linalg.solve_ex(rays[triples], inverse[triples])[0]

    # The norm of a plane is 1 / height; y is down.
    norm = planes.norm(dim=1).clamp(min=1e-9)
    tan_tilt = planes[:, 2].abs() / planes[:, 1]
    tan_roll = planes[:, 0].abs() / planes[:, 1]
    is_level = (planes[:, 1] > 0) & (tan_tilt < _MAX_TAN_TILT) & (tan_roll < _MAX_TAN_ROLL)
    has_height = (norm > 1 / _MAX_HEIGHT_M) & (norm < 1 / _MIN_HEIGHT_M)
    is_usable = planes.isfinite().all(1) & is_level & has_height

    relative_errors = (planes[is_usable] @ rays.T / inverse - 1).abs()
    if not len(relative_errors):
        return None
    is_inlier = relative_errors < _MAX_RELATIVE_ERROR  # (planes, points)
    best = int(is_inlier.sum(1).argmax())
    return is_inlier[best]


def _estimate_jackknife_stds(
    rays: Float[Tensor, "n 3"],
    inverse: Float[Tensor, " n"],
    strips: Int[Tensor, " n"],
    is_inlier: Bool[Tensor, " n"],
) -> tuple[float, float] | None:
    """Estimate the standard deviations of height [m] and tilt [degrees] of a fitted plane.

    They are the jackknife's: the plane is fitted again without each strip of columns in turn. None
    where too few points remain without a strip.

    Args:
        rays: as for :func:`_fit_plane`.
        inverse: as for :func:`_fit_plane`.
        strips: number of the strip of columns in which each point lies.
        is_inlier: whether each point lies on the plane.
    """
    mounts: list[tuple[float, float, float]] = []
    for strip in range(_STRIPS):
        remains = is_inlier & (strips != strip)
        if int(remains.sum()) >= _MIN_INLIERS:
            mounts.append(_compute_mount(_fit_plane(rays[remains], inverse[remains])))
    n = len(mounts)
    if n < 2:
        return None
    # Variance of the jackknife: (n - 1) / n times the sum of squares about the mean.
    values = torch.tensor(mounts)
    variance = (n - 1) / n * ((values - values.mean(0)) ** 2).sum(0)
    height_std_m, tilt_std_deg, _ = variance.sqrt().tolist()
    return height_std_m, tilt_std_deg


def _sample_lower_points(
    depth_m: Map, camera: Camera
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"], Int[Tensor, " n"]]:
    """Sample points with depth on a regular grid: in the lower 2/5 and the middle 5/7 of a map.

    Returns:
        Their rays (z = 1), inverse depths [1/m], and the strip of columns in which each lies.
    """
    height, width = depth_m.shape
    top = height * 3 // 5
    left = width // 7
    right = width * 6 // 7
    step = max(math.isqrt((height - top) * width // _POINTS), 1)
    rows = torch.arange(top, height, step)
    columns = torch.arange(left, right, step)
    v, u = (part.flatten() for part in torch.meshgrid(rows, columns, indexing="ij"))
    inverse = 1 / depth_m.detach().cpu().double()[v, u]
    has_depth = inverse.isfinite() & (inverse > 0)
    pixels = torch.stack([u, v, torch.ones_like(u)], 1).double()
    rays = pixels @ torch.linalg.inv(camera.K).T
    strips = (u - left) * _STRIPS // (right - left)
    return rays[has_depth], inverse[has_depth], strips[has_depth]


def _fit_plane(rays: Float[Tensor, "n 3"], inverse: Float[Tensor, " n"]) -> Float[Tensor, "3"]:
    """Fit a plane to points by least squares of their relative depth errors.

    Args:
        rays: through the points, with z = 1.
        inverse: their inverse depths [1/m].

    Returns:
        The plane, with ``plane @ ray = 1 / depth``, so ``plane @ point = 1``.
    """
    points_m = rays / inverse[:, None]
    return torch.linalg.lstsq(points_m, torch.ones_like(inverse)[:, None]).solution[:, 0]


def _compute_mount(plane: Float[Tensor, "3"]) -> tuple[float, float, float]:
    """Compute the camera's height over a plane [m], and its tilt and roll against it [degrees]."""
    x, y, z = plane.tolist()
    height_m = 1 / math.hypot(x, y, z)
    tilt_deg = -math.degrees(math.atan2(z, y))
    roll_deg = -math.degrees(math.atan2(x, y))
    return height_m, tilt_deg, roll_deg
