"""The mount of a camera above the road, and the scale of depth that follows from it.

The mount is the camera's height, tilt and roll above the road. A network estimates depth partly
from where the ground lies in an image, as if the camera were mounted like those of its training.
Edges in the image, earlier frames or the user tell the mount more exactly, and with it the depth of
the ground. This depth and the network's are averaged at each pixel, weighted by their inverse
variances.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError
from depthpose.depth.config import GeneratorConfig, SelectionConfig
from depthpose.depth.ground import fit_ground
from depthpose.depth.horizon import Angles, find_angles
from depthpose.depth.types import DepthEstimate, DepthInput, Ground, Map

_MAX_TILT_DIFFERENCE_DEG = 8.0
"""Largest difference of the user's tilt from that of the road in the map, which was off by at most
5.5 degrees in the 59 views of ``_MAX_ROAD_TILT_DEG`` in ``depth/ground.py``."""
_MAP_TILT_STD_DEG = 0.8
_MAP_ROLL_STD_DEG = 1.2
"""Standard deviations of tilt and roll of the road in a network's depth map."""
_ROAD_STD_DEG = 0.3
"""Standard deviation of the near road's tilt against that of the far road, along which the edges
run."""
_TILT_CHANGE_DEG = 0.3
"""Standard deviation of a vehicle's tilt and roll from frame to frame."""
_MEASURED_TILT_STD_DEG = 0.2
_MEASURED_HEIGHT_STD_SHARE = 0.03
"""Standard deviations of what the user measured, of the height as a share of it: a tape measure is
more exact, but a loaded car stands lower."""
_LOG_HEIGHT_PER_DEG = 0.06
"""Correction of the logarithm of the map's height for each degree by which the map's tilt is too
large. A map has the camera height of its training near by, and the true one far away, where objects
of known size give the depth; together this looks like a tilt: 2.4 degrees for each unit of the
logarithm of height on synthetic streets. Most of a tilt's error has other causes, so this is the
slope that remains by Bayes' rule."""
_COMMON_HEIGHT_STD = 0.15
_FRAME_HEIGHT_STD = 0.06
"""Standard deviations of an estimated height, as shares of it: of the error that all frames have in
common, and of that which differs between them."""
_STANDING_LOG_STD = 0.12
"""Standard deviation of the logarithm of an object's depth, by the ground where it stands."""
_OFF_PLANE_LOG = 0.1
"""Difference of a pixel from the map's plane, in the logarithm of depth: with less it is ground,
with twice as much it stands on the ground, and in between it counts partly as each."""
_MAX_GROUND_DEPTH_M = 400.0
"""Largest depth of the ground: above its horizon it has none."""
_DEFAULT_NETWORK = SelectionConfig()
_DECIMALS = 6
"""Decimals of the values of a mount: as files hold them, so that a rerun continues from the same
values."""
_WINDOW_RADIUS_PX = 2
"""By how many pixels a window reaches to each side of a measured point: 5 x 5 pixels."""


@dataclass
class MountFilter:
    """The mount of one camera on one vehicle, filtered over frames in order.

    The height is taken to be constant, and averaged over the frames. The tilt may change from frame
    to frame, and is smoothed (a Kalman filter whose state is the last mount).
    """

    last: Ground | None = None  #: mount by the frames so far; None before the first with a road


def find_mount(
    map_ground: Ground,
    image: DepthInput,
    before: Ground | None = None,
    network: GeneratorConfig | SelectionConfig = _DEFAULT_NETWORK,
) -> Ground:
    """Estimate the camera's height, tilt and roll above a road, with their standard deviations.

    Height and tilt that ``image.camera`` states are taken as they are. Otherwise three estimates of
    the tilt are averaged by their inverse variances: that of the road in the depth map, that of the
    frame before, and that of the edges in the image (:func:`find_angles`). The height is that in
    the depth map, corrected for the error of its tilt, and averaged over the frames.

    Args:
        map_ground: the road in the depth map of the image (:func:`fit_ground`).
        image: the image and its camera.
        before: the mount by the frames before; None for the first frame of a camera.
        network: config of the network that estimated the map, which says by how much its roads are
            tilted too far.
    """
    # Prior angles by the depth map and the frame before, which the edges of the image improve.
    camera = image.camera
    assert camera is not None
    map_tilt_deg = map_ground.tilt_deg - network.road_tilt_off_deg
    prior = _predict_angles(map_tilt_deg, map_ground.roll_deg, before)
    if camera.tilt_deg is not None:
        prior = replace(prior, tilt_deg=camera.tilt_deg, tilt_std_deg=_MEASURED_TILT_STD_DEG)
    angles = find_angles(image.left, camera, prior)

    # The edges estimate the roll, and the tilt where the camera does not state it.
    if camera.tilt_deg is not None:
        tilt_deg = camera.tilt_deg
        tilt_std_deg = _MEASURED_TILT_STD_DEG
    else:
        tilt_deg = angles.tilt_deg
        tilt_std_deg = math.hypot(angles.tilt_std_deg, _ROAD_STD_DEG)

    if camera.mount_height_m is not None:
        height_m = camera.mount_height_m
        height_std_share = _MEASURED_HEIGHT_STD_SHARE
    else:
        tilt_error_deg = map_tilt_deg - tilt_deg
        height_m, height_std_share = _estimate_height(map_ground.height_m, tilt_error_deg, before)

    # Rounded as files hold it, so that a rerun continues from the same values.
    values = {
        "height_m": height_m,
        "tilt_deg": tilt_deg,
        "roll_deg": angles.roll_deg,
        "share": map_ground.share,
        "height_std_m": height_std_share * height_m,
        "tilt_std_deg": tilt_std_deg,
    }
    return Ground(**{name: round(value, _DECIMALS) for name, value in values.items()})


def _predict_angles(map_tilt_deg: float, map_roll_deg: float, before: Ground | None) -> Angles:
    """Predict tilt and roll from the depth map and the frame before, without the image's edges.

    ``map_tilt_deg`` and ``map_roll_deg``: those of the road in the map, without the systematic
    error of the network's tilt.
    """
    tilt = _Normal(map_tilt_deg, _MAP_TILT_STD_DEG)
    roll = _Normal(map_roll_deg, _MAP_ROLL_STD_DEG)
    if before is not None:
        tilt_std_before_deg = math.hypot(before.tilt_std_deg, _TILT_CHANGE_DEG)
        tilt = _fuse(tilt, _Normal(before.tilt_deg, tilt_std_before_deg))
        # A mount does not hold the deviation of its roll: edges halve that of the map's.
        roll_std_before_deg = math.hypot(_MAP_ROLL_STD_DEG / 2, _TILT_CHANGE_DEG)
        roll = _fuse(roll, _Normal(before.roll_deg, roll_std_before_deg))
    return Angles(
        tilt_deg=tilt.mean, tilt_std_deg=tilt.std, roll_deg=roll.mean, roll_std_deg=roll.std
    )


def _estimate_height(
    map_height_m: float, tilt_error_deg: float, before: Ground | None
) -> tuple[float, float]:
    """Correct the camera's height in a map for its error of tilt, and average it over the frames.

    Args:
        map_height_m: height of the camera above the road in the depth map.
        tilt_error_deg: tilt of the road in the map less the true one.
        before: the mount by the frames before.

    Returns:
        The height [m], and its standard deviation as a share of it.
    """
    height_m = map_height_m * math.exp(_LOG_HEIGHT_PER_DEG * tilt_error_deg)
    if before is None:
        return height_m, math.hypot(_COMMON_HEIGHT_STD, _FRAME_HEIGHT_STD)

    # Frames are averaged by the errors that differ between them. That of the frames before is what
    # their variance has beside the error that all frames have in common.
    variance_before = (before.height_std_m / before.height_m) ** 2
    frame_std_before = math.sqrt(max(variance_before - _COMMON_HEIGHT_STD**2, 0))
    log_height = _fuse(
        _Normal(math.log(height_m), _FRAME_HEIGHT_STD),
        _Normal(math.log(before.height_m), frame_std_before),
    )
    return math.exp(log_height.mean), math.hypot(_COMMON_HEIGHT_STD, log_height.std)


class _Normal(NamedTuple):
    """An estimate of a number: a normal distribution."""

    mean: float
    std: float


def _fuse(first: _Normal, second: _Normal) -> _Normal:
    """Average two independent estimates of one number, weighted by their inverse variances."""
    # At least 1e-9, so that an estimate without error has a finite weight.
    first_weight = 1 / max(first.std, 1e-9) ** 2
    second_weight = 1 / max(second.std, 1e-9) ** 2
    weight = first_weight + second_weight
    mean = (first_weight * first.mean + second_weight * second.mean) / weight
    return _Normal(mean, math.sqrt(1 / weight))


def scale_by_mount(
    estimate: DepthEstimate,
    mount: MountFilter | None = None,
    network: GeneratorConfig | SelectionConfig = _DEFAULT_NETWORK,
) -> DepthEstimate:
    """Correct the depth of each pixel by the camera's mount above the road.

    The mount says how deep the road is; an object stands on the road, and is moved with the road at
    its foot. This depth and the network's are averaged by the inverse variances of their
    logarithms. The variance of the former grows with the distance, for the tilt is not known
    exactly, and is larger for objects than for the road itself.

    Args:
        estimate: depth by the network. Height and tilt that the camera of its image states are
            used.
        mount: the mount by the frames before; it is updated by this frame.
        network: config of the network, with the standard deviation of its depth.

    Returns:
        The corrected estimate with its ``ground``, the mount; unchanged where it shows no road.

    Raises:
        InputError: the camera states a height or tilt, and the map shows no road, or one of quite
            another tilt.
    """
    image = estimate.input
    camera = image.camera
    assert camera is not None
    assert estimate.depth_m is not None
    map_ground = fit_ground(estimate.depth_m, camera)
    _refuse_contradiction(camera, map_ground, image.name)
    if map_ground is None:
        return estimate
    before = None if mount is None else mount.last
    ground = find_mount(map_ground, image, before, network)
    if mount is not None:
        mount.last = ground
    factor = _compute_depth_factor(estimate.depth_m, camera, map_ground, ground, network)
    return replace(rescale(estimate, factor), ground=ground)


def _refuse_contradiction(camera: Camera, map_ground: Ground | None, name: str) -> None:
    """Refuse a height or tilt that the camera states, where the depth map contradicts it.

    ``map_ground``: the road in the map, None where there is none; ``name``: of the image.
    """
    if map_ground is None:
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
    if tilt_deg is not None and abs(tilt_deg - map_ground.tilt_deg) > _MAX_TILT_DIFFERENCE_DEG:
        raise InputError(
            f"{name}: a tilt of {tilt_deg:g} degrees is given, and the road that is seen "
            f"says {map_ground.tilt_deg:.1f}. Negative is down; correct it, or omit it"
        )


def _compute_depth_factor(
    depth_m: Map,
    camera: Camera,
    map_ground: Ground,
    ground: Ground,
    network: GeneratorConfig | SelectionConfig,
) -> Map:
    """Compute the factor by which the mount corrects the depth of each pixel.

    Args:
        depth_m: depth by the network.
        camera: camera of the image.
        map_ground: the road in ``depth_m``.
        ground: the road by the mount.
        network: config of the network.
    """
    # Depth by the ground: 1 / z' = s / z + (mount_plane - s map_plane) @ ray maps the road in the
    # depth map to that of the mount, and moves objects with it.
    map_plane = _compute_plane(map_ground)
    mount_plane = _compute_plane(ground)
    scale = float(mount_plane[1] / map_plane[1])
    inverse_change = _compute_inverse_depth(mount_plane - scale * map_plane, camera, depth_m)
    inverse = scale / depth_m + inverse_change
    ground_depth_m = 1 / inverse.clamp(min=1 / _MAX_GROUND_DEPTH_M)

    # How surely a pixel is no ground but stands on it, 0..1: by its distance from the plane.
    plane_ratio = _compute_inverse_depth(map_plane, camera, depth_m) * depth_m
    off_plane = plane_ratio.clamp(min=1e-3).log().abs()
    standing_probability = (off_plane / _OFF_PLANE_LOG - 1).clamp(0, 1)

    # Variance of the logarithm of this depth. An error of the tilt changes the logarithm by the
    # angle times depth / height. The error of a height that is estimated by the map is an error of
    # the map too: it does not count.
    log_std_per_metre = math.radians(ground.tilt_std_deg) / ground.height_m
    tilt_variance = (torch.maximum(ground_depth_m, depth_m) * log_std_per_metre).square()
    standing_variance = standing_probability * _STANDING_LOG_STD**2
    ground_variance = tilt_variance + standing_variance + _MEASURED_HEIGHT_STD_SHARE**2

    # The mean of both logarithms, weighted by inverse variances, as a factor of the depth.
    network_variance = network.depth_std**2
    ground_weight = network_variance / (network_variance + ground_variance)
    return (ground_depth_m / depth_m) ** ground_weight


def _compute_inverse_depth(plane: Float[Tensor, "3"], camera: Camera, example: Map) -> Map:
    """Compute the inverse depth of a plane, ``plane @ ray`` (z = 1), at every pixel [1/m].

    ``example``: a map of the size, type and device of the result.
    """
    # plane @ ray with ray = K^-1 (u, v, 1) is a u + b v + c.
    a, b, c = (plane @ torch.linalg.inv(camera.K)).tolist()
    height, width = example.shape
    u = torch.arange(width, dtype=example.dtype, device=example.device)
    v = torch.arange(height, dtype=example.dtype, device=example.device)
    return a * u + (b * v + c)[:, None]


def _compute_plane(ground: Ground) -> Float[Tensor, "3"]:
    """Compute the plane of the ground, with ``plane @ ray = 1 / depth`` for rays with z = 1."""
    tan_tilt = math.tan(math.radians(ground.tilt_deg))
    tan_roll = math.tan(math.radians(ground.roll_deg))
    down = torch.tensor([-tan_roll, 1.0, -tan_tilt], dtype=torch.float64)
    return down / down.norm() / ground.height_m


def rescale(estimate: DepthEstimate, factor: float | Map) -> DepthEstimate:
    """Multiply the depth of an estimate by a factor, or each pixel by its own.

    The distance of disparity from that of infinity is divided by it; a rig whose principal points
    differ sees infinity at another disparity than 0. The sky keeps its disparity. A single factor
    multiplies the height of the ground too; a map of factors leaves the ground as it is.
    """
    assert estimate.depth_m is not None
    ground = estimate.ground
    if ground is not None and not isinstance(factor, Tensor):
        ground = replace(
            ground, height_m=ground.height_m * factor, height_std_m=ground.height_std_m * factor
        )
    camera = estimate.input.camera
    infinity_px = -camera.cx_right_minus_left_px if isinstance(camera, StereoRig) else 0.0
    disparity_px = infinity_px + (estimate.disparity_px - infinity_px) / factor
    if estimate.is_sky is not None:
        disparity_px = torch.where(estimate.is_sky, estimate.disparity_px, disparity_px)
    depth_m = estimate.depth_m * factor
    return replace(estimate, depth_m=depth_m, disparity_px=disparity_px, ground=ground)


def scale_by_distance(
    estimate: DepthEstimate, distance: tuple[float, float, float]
) -> DepthEstimate:
    """Scale an estimate so that the depth around one pixel is the measured one.

    Args:
        estimate: an estimate with depth.
        distance: column, row [px] and camera z [m] of the measured point. Its depth in the estimate
            is the median of the 5 x 5 pixels around it.

    Raises:
        InputError: the pixel lies outside the image or has no depth (the sky), or the distance is
            not positive.
    """
    column, row, distance_m = distance
    assert estimate.depth_m is not None
    height, width = estimate.depth_m.shape
    context = f"{estimate.input.name}: known distance {column:g},{row:g},{distance_m:g}"
    if not (math.isfinite(distance_m) and distance_m > 0):
        raise InputError(f"{context}: metres must be a positive number")
    if not (-0.5 <= column < width - 0.5 and -0.5 <= row < height - 0.5):
        raise InputError(
            f"{context}: the image is {width}x{height}, columns 0 to {width - 1} and rows 0 to "
            f"{height - 1}; give X,Y,METRES of a pixel of it"
        )
    x = round(column)
    y = round(row)
    if not bool(estimate.depth_m[y, x].isfinite()):
        raise InputError(f"{context}: there is no depth at this pixel (the sky?); take another")
    rows = slice(max(y - _WINDOW_RADIUS_PX, 0), y + _WINDOW_RADIUS_PX + 1)
    columns = slice(max(x - _WINDOW_RADIUS_PX, 0), x + _WINDOW_RADIUS_PX + 1)
    window_m = estimate.depth_m[rows, columns]
    estimated_m = float(window_m[window_m.isfinite()].median())
    return rescale(estimate, distance_m / estimated_m)
