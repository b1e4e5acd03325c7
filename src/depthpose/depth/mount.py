"""The mount of a camera above the road, and the scale of depth that follows from it.

A network estimates depth from where the ground lies in the image, as in the images it was trained
on, and from how large objects look. Where the ground lies follows from the camera's mount, which
the image, earlier frames or the user tell more exactly. Both depths are averaged at each pixel,
weighted by their inverse variances.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import Camera
from depthpose.core.errors import InputError
from depthpose.depth.config import SelectionConfig
from depthpose.depth.ground import fit_ground
from depthpose.depth.horizon import Angles, find_angles
from depthpose.depth.types import DepthEstimate, Ground, Map, StereoInput

_MAX_TILT_DIFFERENCE_DEG = 8.0
"""Largest difference of the user's tilt from that of the road in the map, which was off by at most
5.5 degrees in the 59 views."""
_MAP_TILT_STD_DEG = 0.8
_MAP_ROLL_STD_DEG = 1.2
"""Standard deviations of tilt and roll of the road in a depth map."""
_ROAD_STD_DEG = 0.3
"""Standard deviation of the near road's tilt against that of the far road, along which the edges
run."""
_TILT_CHANGE_DEG = 0.3
"""Standard deviation of a vehicle's tilt and roll from frame to frame."""
_MEASURED_TILT_STD_DEG = 0.2
_MEASURED_HEIGHT_STD = 0.03
"""Standard deviations of what the user measured, of the height as a share of it: a tape measure is
more exact, but a loaded car stands lower."""
_LOG_HEIGHT_PER_DEG = 0.06
"""Correction of the logarithm of the map's height for each degree by which the map's tilt is too
large. A map has the camera height of its training near by, and the true one far away, where objects
of known size give the depth; together this looks like a tilt: 2.4 degrees for each unit of the
logarithm of height on synthetic streets. Most of a tilt's error has other causes, so this is the
slope that remains by Bayes' rule."""
_HEIGHT_STD = 0.15
_HEIGHT_NOISE = 0.06
"""Standard deviations of an estimated height, as shares of it: of the error that all frames have in
common, and of that which differs between them."""
_STANDING_STD = 0.12
"""Standard deviation of the logarithm of an object's depth, by the ground where it stands."""
_OFF_PLANE_LOG = 0.1
"""Difference of a pixel from the map's plane, in the logarithm of depth: with less it is ground,
with twice as much it stands on the ground, and between them it is partly each."""
_MAX_GROUND_DEPTH_M = 400.0
"""Largest depth of the ground: above its horizon it has none."""
_DEFAULT_NETWORK = SelectionConfig()
"""The config of networks that do not say how far their roads are off."""
_DECIMALS = 6
"""Decimals of the values of a mount: as files hold them, so that a rerun continues from the same
values."""
_WINDOW_PX = 5
"""Side of the square around a pixel whose distance was measured."""


@dataclass
class MountFilter:
    """The mount of one camera on one vehicle, filtered over frames in order.

    The height is constant: it is the mean of all frames. The tilt may change from frame to frame,
    and is smoothed (a Kalman filter whose state is the last frame's :class:`Ground`).
    """

    last: Ground | None = None  #: road of the last frame that shows one


def find_mount(
    fit: Ground,
    image: StereoInput,
    before: Ground | None = None,
    network: SelectionConfig = _DEFAULT_NETWORK,
) -> Ground:
    """Find the camera's height, tilt and roll above a road, with their standard deviations.

    Height and tilt that the camera states are taken as they are. Else three estimates of the tilt
    are averaged by their inverse variances: that of the road in the map, that of the frame before,
    and that of the edges in the image (:func:`find_angles`). The height is that in the map,
    corrected for the error of the map's tilt, and averaged over the frames.

    Args:
        fit: the road in the map of the image (:func:`fit_ground`).
        image: the image and its camera.
        before: the mount by the frames before, where they are of the same camera.
        network: config of the network that estimated the map, which says by how much its roads are
            tilted too far.
    """
    # The tilt that is expected, which the edges of the image then improve.
    camera = image.camera
    assert camera is not None
    map_tilt_deg = fit.tilt_deg - network.road_tilt_off_deg
    expected = _expected_angles(fit, map_tilt_deg, before)
    if camera.tilt_deg is not None:
        expected = replace(expected, tilt_deg=camera.tilt_deg, tilt_std_deg=_MEASURED_TILT_STD_DEG)
    angles = find_angles(image.left, camera, expected)

    # Edges estimate the roll beside a tilt that is stated, but do not change that tilt.
    if camera.tilt_deg is not None:
        tilt_deg = camera.tilt_deg
        tilt_std_deg = _MEASURED_TILT_STD_DEG
    else:
        tilt_deg = angles.tilt_deg
        tilt_std_deg = math.hypot(angles.tilt_std_deg, _ROAD_STD_DEG)

    if camera.mount_height_m is not None:
        height_m = camera.mount_height_m
        height_std = _MEASURED_HEIGHT_STD
    else:
        height_m, height_std = _estimate_height(fit.height_m, map_tilt_deg - tilt_deg, before)

    values = {
        "height_m": height_m,
        "tilt_deg": tilt_deg,
        "roll_deg": angles.roll_deg,
        "share": fit.share,
        "height_std_m": height_std * height_m,
        "tilt_std_deg": tilt_std_deg,
    }
    return Ground(**{name: round(value, _DECIMALS) for name, value in values.items()})


def _expected_angles(fit: Ground, map_tilt_deg: float, before: Ground | None) -> Angles:
    """Give tilt and roll by the map and the frame before, which the edges then improve.

    ``map_tilt_deg``: the tilt of ``fit``, without the systematic error of the network.
    """
    expected = Angles(
        tilt_deg=map_tilt_deg,
        tilt_std_deg=_MAP_TILT_STD_DEG,
        roll_deg=fit.roll_deg,
        roll_std_deg=_MAP_ROLL_STD_DEG,
    )
    if before is None:
        return expected

    tilt_std_before_deg = math.hypot(before.tilt_std_deg, _TILT_CHANGE_DEG)
    tilt_deg, tilt_std_deg = _weighted_mean(
        (expected.tilt_deg, expected.tilt_std_deg), (before.tilt_deg, tilt_std_before_deg)
    )
    # A mount does not hold the deviation of its roll: edges halve that of the map's.
    roll_std_before_deg = math.hypot(_MAP_ROLL_STD_DEG / 2, _TILT_CHANGE_DEG)
    roll_deg, roll_std_deg = _weighted_mean(
        (expected.roll_deg, expected.roll_std_deg), (before.roll_deg, roll_std_before_deg)
    )
    return Angles(
        tilt_deg=tilt_deg,
        tilt_std_deg=tilt_std_deg,
        roll_deg=roll_deg,
        roll_std_deg=roll_std_deg,
    )


def _estimate_height(
    map_height_m: float, tilt_error_deg: float, before: Ground | None
) -> tuple[float, float]:
    """Correct the camera's height in a map for its error of tilt, and average it over the frames.

    ``tilt_error_deg``: the tilt in the map less the true one. Gives the height [m], and its
    standard deviation as a share of it.
    """
    height_m = map_height_m * math.exp(_LOG_HEIGHT_PER_DEG * tilt_error_deg)
    noise = _HEIGHT_NOISE
    if before is not None:
        # The frames before have a noise of their own beside the error that all have in common.
        variance_before = (before.height_std_m / before.height_m) ** 2
        noise_before = math.sqrt(max(variance_before - _HEIGHT_STD**2, 0))
        log_height, noise = _weighted_mean(
            (math.log(height_m), noise), (math.log(before.height_m), noise_before)
        )
        height_m = math.exp(log_height)
    return height_m, math.hypot(_HEIGHT_STD, noise)


def _weighted_mean(first: tuple[float, float], second: tuple[float, float]) -> tuple[float, float]:
    """Average two values, each with its standard deviation, weighted by inverse variances.

    Gives the mean and its standard deviation.
    """
    weights = [1 / max(std, 1e-9) ** 2 for _, std in (first, second)]
    mean = (weights[0] * first[0] + weights[1] * second[0]) / sum(weights)
    return mean, math.sqrt(1 / sum(weights))


def scale_by_mount(
    estimate: DepthEstimate,
    image: StereoInput,
    mount: MountFilter | None = None,
    network: SelectionConfig = _DEFAULT_NETWORK,
) -> DepthEstimate:
    """Find the camera's mount, and correct the depth of each pixel by the ground that follows.

    An object stands on the road, so what corrects the road at its foot corrects the object too:
    inverse depth changes by a factor and a plane. This depth and the map's own are averaged by the
    inverse variances of their logarithms. The variance of the ground's depth grows with the
    distance, for the tilt is not known exactly, and is larger for objects than for the ground
    itself.

    Args:
        estimate: depth by the network.
        image: the image of which it is. Height and tilt that its camera states are used.
        mount: the mount by the frames before; it is updated by this frame.
        network: config of the network, with the standard deviation of its depth.

    Returns:
        The corrected estimate with its ``ground``, the mount; unchanged where it shows no road.

    Raises:
        InputError: the camera states a height or tilt, and the map shows no road, or one of quite
            another tilt.
    """
    camera = image.camera
    assert camera is not None and estimate.depth_m is not None  # noqa: PT018
    fit = fit_ground(estimate.depth_m, camera)
    _refuse_contradiction(camera, fit, image.name)
    if fit is None:
        return estimate
    before = None if mount is None else mount.last
    ground = find_mount(fit, image, before, network)
    if mount is not None:
        mount.last = ground
    factor = _depth_factor(estimate.depth_m, camera, fit, ground, network)
    return replace(rescale(estimate, factor), ground=ground)


def _refuse_contradiction(camera: Camera, fit: Ground | None, name: str) -> None:
    """Refuse a height or tilt that the camera states, where the map contradicts it.

    ``fit``: the road in the map, None where there is none; ``name``: of the image, for the error.
    """
    if fit is None:
        mount_values = {
            "height": (camera.mount_height_m, "m"),
            "tilt": (camera.tilt_deg, "degrees"),
        }
        for quantity, (value, unit) in mount_values.items():
            if value is not None:
                raise InputError(
                    f"{name}: no road is seen in its lower part, so a camera {quantity} of "
                    f"{value:g} {unit} cannot set the scale; omit it, or give --known-distance"
                )
        return
    tilt_deg = camera.tilt_deg
    if tilt_deg is not None and abs(tilt_deg - fit.tilt_deg) > _MAX_TILT_DIFFERENCE_DEG:
        raise InputError(
            f"{name}: a tilt of {tilt_deg:g} degrees is given, and the road that is seen "
            f"says {fit.tilt_deg:.1f}. Negative is down; correct it, or omit it"
        )


def _depth_factor(
    depth_m: Map, camera: Camera, fit: Ground, ground: Ground, network: SelectionConfig
) -> Map:
    """Give the factor by which the mount corrects the depth of each pixel.

    ``fit``: the road in the map; ``ground``: the road that the mount says.
    """
    # The depth by the ground: the road moves from its plane in the map to that of the mount.
    map_plane = _plane_of(fit)
    mount_plane = _plane_of(ground)
    scale = float(mount_plane[1] / map_plane[1])
    inverse_change = _spread_plane(mount_plane - scale * map_plane, camera, depth_m)
    inverse = scale / depth_m + inverse_change
    ground_depth_m = 1 / inverse.clamp(min=1 / _MAX_GROUND_DEPTH_M)

    # How surely a pixel is no ground but stands on it: 0..1.
    plane_ratio = _spread_plane(map_plane, camera, depth_m) * depth_m
    off_plane = plane_ratio.clamp(min=1e-3).log().abs()
    stands = (off_plane / _OFF_PLANE_LOG - 1).clamp(0, 1)

    # A tilt that is off by an angle changes the logarithm of depth by it times depth / height. The
    # error of a height that is estimated by the map is an error of the map too: it does not count.
    tilt_std = math.radians(ground.tilt_std_deg) / ground.height_m
    ground_variance = (
        (torch.maximum(ground_depth_m, depth_m) * tilt_std).square()
        + stands * _STANDING_STD**2
        + _MEASURED_HEIGHT_STD**2
    )
    weight = network.depth_std**2 / (network.depth_std**2 + ground_variance)
    return (ground_depth_m / depth_m) ** weight


def _spread_plane(plane: Float[Tensor, "3"], camera: Camera, like: Map) -> Map:
    """Compute the inverse depth of a plane, ``plane @ ray`` (z = 1), at every pixel [1/m].

    ``like``: a map of the size, type and device of the result.
    """
    a, b, c = (plane @ torch.linalg.inv(camera.K)).tolist()
    height, width = like.shape
    u = torch.arange(width, dtype=like.dtype, device=like.device)
    v = torch.arange(height, dtype=like.dtype, device=like.device)
    return a * u + (b * v + c)[:, None]


def _plane_of(ground: Ground) -> Float[Tensor, "3"]:
    """Give the plane of the ground, with ``plane @ ray = 1 / depth`` for rays with z = 1."""
    tan_tilt = math.tan(math.radians(ground.tilt_deg))
    tan_roll = math.tan(math.radians(ground.roll_deg))
    direction = torch.tensor([-tan_roll, 1.0, -tan_tilt], dtype=torch.float64)
    return direction / direction.norm() / ground.height_m


def rescale(estimate: DepthEstimate, factor: float | Map) -> DepthEstimate:
    """Give an estimate whose depth is multiplied, and whose disparity is divided, by ``factor``.

    The sky keeps its disparity. A single factor multiplies the height of the ground too; a map of
    factors leaves the ground as it is.
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
    """Scale an estimate so that the depth around one pixel is the measured one.

    Args:
        estimate: an estimate with depth.
        name: name of the image, for errors.
        distance: column, row [px] and camera z [m] of the measured point. Its depth in the estimate
            is the median of the 5x5 pixels around it.

    Raises:
        InputError: the pixel lies outside the image or has no depth (the sky), or the distance is
            not positive.
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
    radius = _WINDOW_PX // 2
    x = round(column)
    y = round(row)
    if not bool(estimate.depth_m[min(y, height - 1), min(x, width - 1)].isfinite()):
        raise InputError(f"{context}: there is no depth at this pixel (the sky?); take another")
    rows = slice(max(y - radius, 0), y + radius + 1)
    columns = slice(max(x - radius, 0), x + radius + 1)
    window_m = estimate.depth_m[rows, columns]
    return rescale(estimate, metres / float(window_m[window_m.isfinite()].median()))
