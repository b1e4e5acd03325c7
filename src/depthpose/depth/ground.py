"""The road in a depth map: how high the camera stands, how it is tilted, and metres by that.

A network judges depth by where the ground is, as the camera of its training saw it, and by how
large things look. Where the ground is follows from the camera's mount, which the image itself, the
frames before or the user know better. Both are joined for each pixel by their uncertainties.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from depthpose.core.camera import Camera
from depthpose.core.errors import InputError
from depthpose.depth.config import SelectionConfig
from depthpose.depth.horizon import Angles, find_angles
from depthpose.depth.types import DepthEstimate, Ground, Map, StereoInput

_INLIER = 0.06
"""Inverse depths within this share of the plane's belong to it."""
_POINTS = 2000  # that a plane is fitted to
_DRAWS = 200  # of three points for a plane
_REFITS = 3
_FEWEST_POINTS = 60  # with depth in the lower part of an image
_FEWEST_ON_PLANE = 30  # of them
_STRIPS = 8  # of columns, of which the jackknife leaves one out at a time
_LEAST_SHARE = 0.25
"""Of the points in the lower part of the image, on the plane; with less there is no ground."""
_MOST_ROLL_DEG = 10.0
_MAX_TAN_TILT = math.tan(math.radians(25))
_MAX_TAN_ROLL = math.tan(math.radians(_MOST_ROLL_DEG))
_LEAST_HEIGHT_M = 0.2
_MOST_HEIGHT_M = 20.0
_MOST_ROAD_TILT_DEG = 15.0
"""Steeper planes were no road in any of 59 views by cameras tilted up to 7 degrees."""
_MOST_TILT_APART_DEG = 8.0
"""Of a given tilt and that of the road in the map, which was at most 5.5 degrees off in these."""
_MAP_TILT_STD_DEG = 0.8
_MAP_ROLL_STD_DEG = 1.2
_ROAD_STD_DEG = 0.3
"""Of the near road's tilt against that of the far one, to which edges run."""
_TILT_STEP_DEG = 0.3
"""By which a vehicle tilts from frame to frame."""
_GIVEN_TILT_STD_DEG = 0.2
_GIVEN_HEIGHT_STD = 0.03
"""As a share; a tape measure is better, but a loaded car stands lower."""
_HEIGHT_PER_DEG = 0.06
"""By how much of a share the camera stands higher, where the map's tilt is a degree too large. A
map has the height of its training near by, and the true one far off, where things have sizes, which
together look like a tilt: 2.4 degrees a unit of the logarithm of height on synthetic streets. Most
of what a tilt is off has other causes, so this is the slope that remains by Bayes' rule."""
_HEIGHT_STD = 0.15
_HEIGHT_NOISE = 0.06
"""Of an estimated height, as shares: the deviation of all frames alike, and that between them."""
_FOOT_STD = 0.12
"""Of the logarithm of depth by where things touch the ground."""
_ON_PLANE = 0.1
"""What is off the map's plane by less, in the logarithm of depth, is ground; by twice as much, it
stands on it."""
_FARTHEST_M = 400.0
"""Largest depth of the ground: beyond its horizon it has none."""
_RIG = SelectionConfig()
_DECIMALS = 6
"""Of the numbers of a mount: as files hold them, so that a rerun goes on from the same."""
_WINDOW_PX = 5
"""Side of the square around a pixel whose distance is known."""


def fit_ground(depth_m: Map, camera: Camera) -> Ground | None:
    """Fit a plane to the lower part of a depth map: RANSAC on inverse depth, then least squares.

    None where a quarter of the lower part does not lie on one that could be ground.
    """
    rays, inverse, strips = _lower_points(depth_m, camera)
    if len(inverse) < _FEWEST_POINTS:
        return None

    # RANSAC: planes through three points, below the camera, and tilted and rolled as cameras of
    # vehicles and hands are.
    chance = torch.Generator().manual_seed(0)
    drawn = torch.randint(len(inverse), (_DRAWS, 3), generator=chance)
    planes = torch.linalg.solve_ex(rays[drawn], inverse[drawn])[0]
    size = planes.norm(dim=1).clamp(min=1e-9)
    tan_tilt = planes[:, 2].abs() / planes[:, 1]
    tan_roll = planes[:, 0].abs() / planes[:, 1]
    is_upright = (planes[:, 1] > 0) & (tan_tilt < _MAX_TAN_TILT) & (tan_roll < _MAX_TAN_ROLL)
    is_near = (size > 1 / _MOST_HEIGHT_M) & (size < 1 / _LEAST_HEIGHT_M)
    is_usable = planes.isfinite().all(1) & is_upright & is_near
    errors = (planes[is_usable] @ rays.T / inverse - 1).abs()
    if not len(errors):
        return None
    is_on = errors[int((errors < _INLIER).sum(1).argmax())] < _INLIER

    # Least squares over the points on the best of them.
    plane, angles = _fit_plane(rays[is_on], inverse[is_on])
    for _ in range(_REFITS):
        is_on = (rays @ plane / inverse - 1).abs() < _INLIER
        if int(is_on.sum()) < _FEWEST_ON_PLANE:
            return None
        plane, angles = _fit_plane(rays[is_on], inverse[is_on])
    share = float(is_on.double().mean())
    height_m, tilt_deg, roll_deg = angles
    is_upright = abs(tilt_deg) <= _MOST_ROAD_TILT_DEG and abs(roll_deg) < _MOST_ROLL_DEG
    if share < _LEAST_SHARE or not (is_upright and _LEAST_HEIGHT_M < height_m < _MOST_HEIGHT_M):
        return None

    # The jackknife's deviation: how far the fit moves when a strip of columns is left out.
    selections = [is_on & (strips != strip) for strip in range(_STRIPS)]
    selections = [selection for selection in selections if int(selection.sum()) >= _FEWEST_ON_PLANE]
    fits = torch.tensor([_fit_plane(rays[k], inverse[k])[1] for k in selections])
    count = len(fits)
    deviation = ((count - 1) / count * ((fits - fits.mean(0)) ** 2).sum(0)).sqrt()
    return Ground(
        height_m=height_m,
        tilt_deg=tilt_deg,
        roll_deg=roll_deg,
        share=share,
        height_std_m=float(deviation[0]),
        tilt_std_deg=float(deviation[1]),
    )


def _lower_points(
    depth_m: Map, camera: Camera
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"], Int[Tensor, " n"]]:
    """Give rays (z = 1), inverse depths and column strips of points in the lower middle."""
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


def _fit_plane(
    rays: Float[Tensor, "n 3"], inverse: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "3"], tuple[float, float, float]]:
    """Fit a plane to points by least squares of their relative depth errors.

    Args:
        rays: through the points, with z = 1.
        inverse: their inverse depths [1/m].

    Returns:
        The plane, with ``plane @ ray = 1 / depth``; and the camera's height over it [m], tilt and
        roll [degrees].
    """
    points_m = rays / inverse[:, None]
    plane = torch.linalg.lstsq(points_m, torch.ones_like(inverse)[:, None]).solution[:, 0]
    x, y, z = plane.tolist()
    height_m = 1 / math.hypot(x, y, z)
    tilt_deg = -math.degrees(math.atan2(z, y))
    roll_deg = -math.degrees(math.atan2(x, y))
    return plane, (height_m, tilt_deg, roll_deg)


@dataclass
class MountFilter:
    """What the frames of one camera on one vehicle, taken in order, say of its mount together.

    The height is held: it is the mean of all frames. The tilt is free to change from frame to
    frame, and smoothed (a Kalman filter whose state is the last frame's :class:`Ground`).
    """

    last: Ground | None = None  #: of the last frame with a road


def find_mount(
    fit: Ground,
    image: StereoInput,
    before: Ground | None = None,
    rig: SelectionConfig = _RIG,
) -> Ground:
    """Find the camera's height, tilt and roll above a road, with their deviations.

    What the camera says of its mount is taken. Else three estimates of the tilt are joined by their
    deviations: that of the road in the map, that of the frame before, and that of the edges in the
    image (:func:`find_angles`). The height is that in the map, corrected for its wrong tilt.

    Args:
        fit: the road in the map of the image (:func:`fit_ground`).
        image: the image and its camera.
        before: the mount by the frames before, where they are of the same camera.
        rig: of the network that estimated the map; by how much its roads are tilted too far.
    """
    camera = image.camera
    assert camera is not None
    expected = Angles(
        tilt_deg=fit.tilt_deg - rig.road_tilt_off_deg, tilt_std_deg=_MAP_TILT_STD_DEG,
        roll_deg=fit.roll_deg, roll_std_deg=_MAP_ROLL_STD_DEG,
    )  # fmt: skip
    if before is not None:
        tilt_std_deg = math.hypot(before.tilt_std_deg, _TILT_STEP_DEG)
        tilt = _join((expected.tilt_deg, expected.tilt_std_deg), (before.tilt_deg, tilt_std_deg))
        # A mount does not hold the deviation of its roll: edges halve that of the map's.
        roll_std_deg = math.hypot(_MAP_ROLL_STD_DEG / 2, _TILT_STEP_DEG)
        roll = _join((expected.roll_deg, expected.roll_std_deg), (before.roll_deg, roll_std_deg))
        expected = Angles(
            tilt_deg=tilt[0], tilt_std_deg=tilt[1], roll_deg=roll[0], roll_std_deg=roll[1]
        )
    if camera.tilt_deg is not None:
        expected = replace(expected, tilt_deg=camera.tilt_deg, tilt_std_deg=_GIVEN_TILT_STD_DEG)
    angles = find_angles(image.left, camera, expected)
    tilt_deg = angles.tilt_deg
    tilt_std_deg = math.hypot(angles.tilt_std_deg, _ROAD_STD_DEG)
    if camera.tilt_deg is not None:
        tilt_deg = camera.tilt_deg
        tilt_std_deg = _GIVEN_TILT_STD_DEG

    if camera.mount_height_m is not None:
        height_m = camera.mount_height_m
        share = _GIVEN_HEIGHT_STD
    else:
        off_deg = fit.tilt_deg - rig.road_tilt_off_deg - tilt_deg
        height_m = fit.height_m * math.exp(_HEIGHT_PER_DEG * off_deg)
        noise = _HEIGHT_NOISE
        if before is not None:
            # The deviation of the frames before is larger than what they share by their noise.
            past = math.sqrt(max((before.height_std_m / before.height_m) ** 2 - _HEIGHT_STD**2, 0))
            mean = _join((math.log(height_m), noise), (math.log(before.height_m), past))
            height_m = math.exp(mean[0])
            noise = mean[1]
        share = math.hypot(_HEIGHT_STD, noise)
    numbers = {
        "height_m": height_m, "tilt_deg": tilt_deg, "roll_deg": angles.roll_deg,
        "share": fit.share, "height_std_m": share * height_m, "tilt_std_deg": tilt_std_deg,
    }  # fmt: skip
    return Ground(**{name: round(number, _DECIMALS) for name, number in numbers.items()})


def _join(first: tuple[float, float], second: tuple[float, float]) -> tuple[float, float]:
    """Combine two estimates with their deviations, weighted by inverse variances."""
    weights = [1 / max(std, 1e-9) ** 2 for _, std in (first, second)]
    mean = (weights[0] * first[0] + weights[1] * second[0]) / sum(weights)
    return mean, math.sqrt(1 / sum(weights))


def scale_by_mount(
    estimate: DepthEstimate,
    image: StereoInput,
    mount: MountFilter | None = None,
    rig: SelectionConfig = _RIG,
) -> DepthEstimate:
    """Find the camera's mount, and correct each pixel's depth by where the ground then is.

    An object stands on the road, so what corrects the road at its foot corrects the object too:
    inverse depth changes by a factor and a plane. This and the map's own depth are joined by
    inverse variances of their logarithms. That of the ground grows with the distance, for its tilt
    is not known exactly, and is larger for what stands on it than for the ground itself.

    Args:
        estimate: depth as the network judges it.
        image: what it was judged by. Height and tilt of its camera are taken where they are given.
        mount: of the frames before, in whose place that of this frame comes.
        rig: of the network, with the deviation of its depth.

    Returns:
        The corrected estimate with its ``ground``, the mount; unchanged where no road is seen.

    Raises:
        InputError: a height or tilt is given, and no road is seen or its tilt is far off.
    """
    camera = image.camera
    name = image.name
    assert camera is not None and estimate.depth_m is not None  # noqa: PT018
    fit = fit_ground(estimate.depth_m, camera)
    if fit is None:
        mount_values = {
            "height": (camera.mount_height_m, "m"),
            "tilt": (camera.tilt_deg, "degrees"),
        }
        for what, (number, unit) in mount_values.items():
            if number is not None:
                raise InputError(
                    f"{name}: no road is seen in its lower part, so a camera {what} of "
                    f"{number:g} {unit} cannot set the scale; omit it, or give --known-distance"
                )
        return estimate
    if camera.tilt_deg is not None and abs(camera.tilt_deg - fit.tilt_deg) > _MOST_TILT_APART_DEG:
        raise InputError(
            f"{name}: a tilt of {camera.tilt_deg:g} degrees is given, and the road that is seen "
            f"says {fit.tilt_deg:.1f}. Negative is down; correct it, or omit it"
        )
    ground = find_mount(fit, image, None if mount is None else mount.last, rig)
    if mount is not None:
        mount.last = ground

    depth_m = estimate.depth_m
    map_plane = _plane(fit)
    road_plane = _plane(ground)
    multiple = float(road_plane[1] / map_plane[1])
    inverse = multiple / depth_m + _plane_at_pixels(
        road_plane - multiple * map_plane, camera, depth_m
    )
    by_ground_m = 1 / inverse.clamp(min=1 / _FARTHEST_M)
    off_plane = (_plane_at_pixels(map_plane, camera, depth_m) * depth_m).clamp(min=1e-3).log().abs()
    stands = (off_plane / _ON_PLANE - 1).clamp(0, 1)
    # A tilt that is off by an angle changes the logarithm of depth by it times depth / height. What
    # a height is off that is estimated by the map, the map's depth is off too: it does not count.
    tilt_std = math.radians(ground.tilt_std_deg) / ground.height_m
    ground_variance = (
        (torch.maximum(by_ground_m, depth_m) * tilt_std).square()
        + stands * _FOOT_STD**2
        + _GIVEN_HEIGHT_STD**2
    )
    weight = rig.depth_std**2 / (rig.depth_std**2 + ground_variance)
    return replace(rescale(estimate, (by_ground_m / depth_m) ** weight), ground=ground)


def _plane_at_pixels(plane: Float[Tensor, "3"], camera: Camera, example: Map) -> Map:
    """Give the inverse depth of a plane, ``plane @ ray`` (z = 1), at every pixel of a map."""
    a, b, c = (plane @ torch.linalg.inv(camera.K)).tolist()
    height, width = example.shape
    u = torch.arange(width, dtype=example.dtype, device=example.device)
    v = torch.arange(height, dtype=example.dtype, device=example.device)
    return a * u + (b * v + c)[:, None]


def _plane(ground: Ground) -> Float[Tensor, "3"]:
    """Give the plane of the ground, with ``plane @ ray = 1 / depth`` for rays with z = 1."""
    tilt, roll = (math.tan(math.radians(angle)) for angle in (ground.tilt_deg, ground.roll_deg))
    plane = torch.tensor([-roll, 1.0, -tilt], dtype=torch.float64)
    return plane / plane.norm() / ground.height_m


def rescale(estimate: DepthEstimate, factor: float | Map) -> DepthEstimate:
    """Multiply the depth of an estimate by ``factor``, and divide its disparity by it.

    The sky keeps its disparity. The height of the ground is multiplied by a single factor alone.
    """
    assert estimate.depth_m is not None
    ground = estimate.ground
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
