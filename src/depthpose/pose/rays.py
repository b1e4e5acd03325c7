"""Whether a depth image holds depth along the optical axis, or distance along each pixel's ray.

Simulators and some cameras write the distance ``r`` from the camera to the point, where ``z = r /
sqrt(1 + x^2 + y^2)`` belongs for the ray ``(x, y, 1)``. Where ``r`` is taken for ``z``, every table
and wall is bent towards the camera, as much as a ball whose radius is their distance. On a plane
``1 / z`` is linear in x and y, so that a plane of some extent tells one from the other.
"""

import warnings

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import Notice

_SAMPLES = 1000  # readings of an image that are examined
_LEAST_SAMPLES = 10  # fewer readings tell nothing
_HYPOTHESES = 120  # planes that RANSAC tries for each plane that it finds
_MOST_PLANES = 3  # that are searched for in an image
_REFITS = 3  # of a plane to the readings on it
_LEAST_VOLUME = 1e-9  # least determinant of three readings [m^3]: near 0 they fix no plane
_TOLERANCE_M = 0.0015
_TOLERANCE_PER_M2 = 0.004
"""Distance up to which a reading lies on a plane: the first, and the second times the square of its
depth in metres."""
_LEAST_SHARE = 0.05  # least share of the readings that make a plane
_LEAST_RATIO = 1.1
"""Least ratio of the readings on planes under the better assumption to those under the other."""
_LEAST_BEND = 0.007
"""Least bend of the planes that distance along the ray would make, as a share of their depth, for
it to be measured: sensors bend planes themselves, by up to 0.1 % of the depth in real frames."""
_RAY_BEND = (0.75, 1.3)
"""Measured bends of a depth image that holds distance. Real frames have -0.08 to 0.08, and 0.92 to
1.08 after their depth was turned into distance."""

_warned: set[tuple[float, ...]] = set()
"""Intrinsics of the cameras for which the notice was given, once each."""


def warn_of_rays(depth_m: Float[Tensor, "h w"], K: Float[Tensor, "3 3"]) -> None:
    """Warn, once for each camera, that a depth image seems to hold distance along the ray.

    Args:
        depth_m: NaN or 0 where there is no reading.
        K: intrinsic matrix.
    """
    camera = tuple(K.flatten().tolist())
    if camera in _warned:
        return
    bend = measure_ray_bend(depth_m, K)
    if bend is None or not _RAY_BEND[0] < bend < _RAY_BEND[1]:
        return
    _warned.add(camera)
    warnings.warn(
        "a depth image looks like distance along each pixel's ray, for its planes are bent so, but "
        "depth is along the optical axis: its poses are up to centimetres off. Divide it by "
        "sqrt(1 + ((u - cx) / fx)^2 + ((v - cy) / fy)^2), or write depth to the image plane",
        Notice,
        stacklevel=3,
    )


def measure_ray_bend(depth_m: Float[Tensor, "h w"], K: Float[Tensor, "3 3"]) -> float | None:
    """Measure how planes are bent: 0 where readings are depth along the axis, 1 along the ray.

    Planes are searched by RANSAC under both assumptions. Those of the assumption under which more
    readings lie on planes are refitted, with the bend as a further unknown.

    Args:
        depth_m: NaN or 0 where there is no reading.
        K: intrinsic matrix.

    Returns:
        The bend that the planes share; None where they are too few or too small to tell.
    """
    # Some readings, and the lengths of their rays.
    v, u = (depth_m > 0).nonzero(as_tuple=True)
    pixels = take_evenly(torch.stack([u, v, torch.ones_like(u)], 1), _SAMPLES)
    reading_m = depth_m[pixels[:, 1], pixels[:, 0]].double()
    rays = pixels.double() @ torch.linalg.inv(K.double()).mT
    is_finite = reading_m.isfinite()
    rays = rays[is_finite]
    reading_m = reading_m[is_finite]
    if len(rays) < _LEAST_SAMPLES:
        return None
    ray_length = rays.norm(dim=1)

    # Under which assumption do clearly more readings lie on planes?
    axis_planes = _find_planes(rays, reading_m, torch.ones_like(ray_length))
    ray_planes = _find_planes(rays, reading_m, ray_length)
    axis_count = sum(int(is_on.sum()) for is_on in axis_planes)
    ray_count = sum(int(is_on.sum()) for is_on in ray_planes)
    count = max(axis_count, ray_count)
    if count < _LEAST_RATIO * min(axis_count, ray_count):
        return None
    planes = axis_planes if axis_count > ray_count else ray_planes

    return _fit_shared_bend(planes, rays, reading_m, ray_length)


def _fit_shared_bend(
    planes: list[Bool[Tensor, " n"]],
    rays: Float64[Tensor, "n 3"],
    reading_m: Float64[Tensor, " n"],
    ray_length: Float64[Tensor, " n"],
) -> float | None:
    """Fit planes and one bend for all of them by least squares; return the bend.

    A reading d on a plane (a, b, c) has ``(1 + bend (length - 1)) / d = a x + b y + c``, where its
    ray (x, y, 1) has this ``length``. Times d this is linear in the plane and the bend, with point
    = d ray::

        1 = (a, b, c) . point + bend (1 - length)

    Each plane has unknowns of its own, which are of no interest, so they are projected out: the
    coefficient of ``1 - length`` is that of a regression of residuals on residuals, of both sides
    after a fit to the points alone (Frisch, Waugh and Lovell).

    Args:
        planes: which readings lie on each.
        rays: of the readings, with z = 1.
        reading_m: values of the depth image.
        ray_length: lengths of the rays.

    Returns:
        The bend; None without planes, or where they are too small to tell.
    """
    # The regression of residuals on residuals, summed over the planes.
    count = 0
    numerator = 0.0
    denominator = 0.0
    for is_on in planes:
        points_m = rays[is_on] * reading_m[is_on, None]
        ones = torch.ones(len(points_m), dtype=torch.float64)
        regressor = 1 - ray_length[is_on]
        fit = torch.linalg.lstsq(points_m, torch.stack([ones, regressor], 1)).solution
        ones_residual = ones - points_m @ fit[:, 0]
        regressor_residual = regressor - points_m @ fit[:, 1]
        count += len(points_m)
        numerator += float((ones_residual * regressor_residual).sum())
        denominator += float(regressor_residual.square().sum())

    # The residual of the regressor is how far the ray's distance bends a reading off its plane, as
    # a share of its depth.
    if count == 0 or denominator < count * _LEAST_BEND**2:
        return None
    return numerator / denominator


def _find_planes(
    rays: Float64[Tensor, "n 3"],
    reading_m: Float64[Tensor, " n"],
    reading_per_depth: Float64[Tensor, " n"],
) -> list[Bool[Tensor, " n"]]:
    """Find planes one after the other by RANSAC; return which readings lie on each.

    Planes are ``n . x = 1``, as in the fit of the bend: residuals are shares of the distance of a
    plane, where :func:`~depthpose.pose.planes.largest_plane` measures distances from it.

    Args:
        rays: of the readings, with z = 1.
        reading_m: values of the depth image.
        reading_per_depth: the assumption, readings over depths along the axis: 1, or the lengths of
            the rays.
    """
    depth_m = reading_m / reading_per_depth
    points_m = rays * depth_m[:, None]
    tolerance = _TOLERANCE_M / depth_m + _TOLERANCE_PER_M2 * depth_m
    generator = torch.Generator().manual_seed(0)  # the same image, the same planes
    is_free = torch.ones(len(rays), dtype=torch.bool)  # of no plane yet
    least_count = max(3, _LEAST_SHARE * len(rays))
    planes: list[Bool[Tensor, " n"]] = []
    while len(planes) < _MOST_PLANES and int(is_free.sum()) >= least_count:
        # Planes n . x = 1 through three readings each; the one with the most readings on it.
        free = is_free.nonzero()[:, 0]
        chosen = torch.randint(len(free), (_HYPOTHESES, 3), generator=generator)
        triples = points_m[free[chosen]]
        triples = triples[torch.linalg.det(triples).abs() > _LEAST_VOLUME]
        if len(triples) == 0:
            break
        ones = torch.ones(len(triples), 3, 1, dtype=torch.float64)
        normals = torch.linalg.solve(triples, ones)
        residual = (points_m @ normals[..., 0].mT - 1).abs()  # distance over that of the plane
        is_on = (residual < tolerance[:, None]) & is_free[:, None]
        is_on_best = is_on[:, int(is_on.sum(0).argmax())]

        # Fitted anew to all readings on it.
        for _ in range(_REFITS):
            ones = torch.ones(int(is_on_best.sum()), 1, dtype=torch.float64)
            normal = torch.linalg.lstsq(points_m[is_on_best], ones).solution[:, 0]
            is_on_best = is_free & ((points_m @ normal - 1).abs() < tolerance)
        if int(is_on_best.sum()) < least_count:
            break
        planes.append(is_on_best)
        is_free &= ~is_on_best
    return planes
