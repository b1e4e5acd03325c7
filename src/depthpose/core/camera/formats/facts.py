"""The values of a camera file of any format, and the camera that is made of them if plausible.

A file may be of another resolution, in other units, or of a lens with distortion. Such mistakes are
refused here for all formats.
"""

import json
import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.camera.pinhole import Camera, Size, StereoRig
from depthpose.core.errors import InputError, Notice

KNOWN_FILES = (
    "our JSON (width, height, K), BOP's camera.json, KITTI's calibration (P2 or P_rect_02), "
    "Middlebury's calib.txt, TUM's 'fx fy cx cy', a matrix of 9 numbers, focal_px lines, "
    "camera_info of ROS, FileStorage of OpenCV (YAML, XML, JSON), settings of ORB-SLAM, intrinsics "
    "of RealSense and Open3D (JSON), COLMAP's cameras.txt"
)
"""Formats of camera files, for errors."""

OPTIONAL_KEYS = ("depth_unit_m", "mount_height_m", "tilt_deg")  # beside the matrix

# What is plausible in a file. Focal lengths, as multiples of the width:
_NORMALISED_FX = 2  # an fx [px] up to this one has been divided by the width
_MM_FX_SHARE = 0.1  # a smaller fx is in millimetres: as pixels it would span 157 degrees or more
_MAX_FX_SHARE = 200  # largest fx: it spans 0.3 degrees
# Units and distances:
_MIN_UNIT_M = 1e-6  # least unit of depth images: with a smaller one 16 bits would end before 7 cm
_MAX_METRIC_BASELINE_M = 5.0  # of a format that names metres; 50 or more are mm or cm all the same
WIDE_BASELINE_M = 2.0  # of other formats: wider is in cm, or in squares of a calibration board
_MIN_FILE_BASELINE_M = 1e-3
_MAX_CM = 30  # a wider baseline without a unit is in millimetres, not centimetres
# The two cameras of a rectified pair:
_SAME_FOCAL_SHARE = 1e-3  # share by which the focal lengths of a rectified pair may differ
_SAME_ROW_PX = 0.5  # difference that cy of a rectified pair may have
SAME_DIFFERENCE_PX = 1.0  # by how much Middlebury's doffs may differ from that of its two matrices
# Lenses and principal points:
_MAX_SQUEEZE = 1.8  # ratio of fx to fy or fy to fx; KITTI's images squeezed to 512x256 have 1.66
_NO_DISTORTION = 1e-8  # largest coefficient that counts as 0
_OFF_CENTRE = 0.1  # share of the size that a principal point may be off; KITTI's is below 0.04
_SAME_SHARE = 0.05  # by how much the shares along x and y may differ where K is of another size
_FAR_OFF_CENTRE = 0.25  # share of the size that makes a principal point doubtful in any case
_CORNER = 0.1  # share of the size within which a principal point is in the upper left corner


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraFacts:
    """Values of a camera file before they are checked; fields without a comment as in a camera."""

    kind: str  #: kind of the file, with which errors begin
    K: Float[Tensor, "3 3"]
    size: Size | None = None  #: of the image; None: the file does not say it
    baseline_m: float | None = None  #: None: a single camera
    cx_right_minus_left_px: float = 0.0
    is_metric: bool = False  #: whether the format defines the baseline in metres
    depth_unit_m: float | None = None
    mount_height_m: float | None = None
    tilt_deg: float | None = None
    distortion: tuple[float, ...] = ()  #: coefficients of the lens; none or zeros: undistorted
    is_fisheye: bool = False  #: an equidistant lens, which distorts without coefficients too
    undistort: str = "cv2.undistort(image, K, distortion)"  #: how to undistort, for the error
    doubt: str = ""  #: a warning that is shown when a camera is made of it


def facts_from_projections(
    kind: str,
    left: Float64[np.ndarray, "3 4"],
    right: Float64[np.ndarray, "3 4"] | None,
    size: Size | None = None,
) -> CameraFacts:
    """Read K, and of a pair the baseline, from rectified projections P = K [I | t].

    ``P[0, 3]`` is -fx times the x of the camera [m].

    Args:
        kind: kind of the file, for errors.
        left: P of the left camera, or of a single one.
        right: P of the right camera; None: there is none.
        size: width and height of the image, where the file has it.

    Raises:
        InputError: the two are not those of one rectified pair.
    """
    K = torch.from_numpy(left[:, :3].copy())
    if right is None:
        return CameraFacts(kind=kind, K=K, size=size)
    if not (left[0, 0] > 0 and right[0, 0] > 0):
        raise InputError("the focal lengths of the two projections are not positive; copy it anew")
    refuse_unequal_cameras(left, right)
    # Only the difference counts: KITTI measures x from camera 0, ROS and OpenCV from the left one.
    with np.errstate(all="ignore"):  # what overflows is refused as a baseline
        baseline_m = left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0]
        down_m = left[1, 3] / left[1, 1] - right[1, 3] / right[1, 1]
        cx_difference_px = right[0, 2] - left[0, 2]
    if abs(down_m) > abs(baseline_m):
        raise InputError("its cameras stand one above the other; turn the images by 90 degrees")
    return CameraFacts(
        kind=kind,
        K=K,
        size=size,
        baseline_m=float(baseline_m),
        cx_right_minus_left_px=float(cx_difference_px),
    )


def refuse_unequal_cameras(
    left: Float64[np.ndarray, "3 _"], right: Float64[np.ndarray, "3 _"]
) -> None:
    """Refuse two matrices K or P that are not of one rectified pair: only cx may differ.

    Raises:
        InputError: fx, fy or cy differ.
    """
    shared = (
        ("fx", (0, 0), _SAME_FOCAL_SHARE * left[0, 0]),
        ("fy", (1, 1), _SAME_FOCAL_SHARE * left[1, 1]),
        ("cy", (1, 2), _SAME_ROW_PX),
    )
    for name, index, tolerance in shared:
        if not math.isclose(left[index], right[index], rel_tol=0, abs_tol=abs(tolerance)):
            raise InputError(
                f"{name} of the left camera is {left[index]:g} and of the right one "
                f"{right[index]:g}, but a rectified pair shares fx, fy and cy; are they of two "
                "calibrations, or of raw images ('depthpose data rectify')? Copy both of one "
                "rectification"
            )


def camera_from_facts(facts: CameraFacts, size: Size | None) -> Camera:
    """Make a camera of the values of its file, if they are plausible.

    Args:
        facts: values of the file.
        size: width and height of the image, where the file does not say it.

    Raises:
        InputError: the values cannot be those of an undistorted image, in pixels and metres.

    Warns:
        Notice: they are possible, but doubtful.
    """
    _refuse_distortion(facts, size)
    camera = make_camera(facts, size)
    _refuse_focal_length(camera)
    refuse_unequal_focal_lengths(camera.K)
    refuse_outside(camera.K, camera.width, camera.height)
    if isinstance(camera, StereoRig):
        _refuse_rig(camera, is_metric=facts.is_metric)
    unit_m = camera.depth_unit_m or 1.0  # without a unit nothing is refused
    if not _MIN_UNIT_M <= unit_m <= 1:
        finding = "finer than any sensor's; it is metres a unit: 0.001 means millimetres"
        if unit_m > 1:
            finding = f"which looks like units a metre; it is metres a unit: write {1 / unit_m:g}"
        raise InputError(f"depth_unit_m is {unit_m:g}, {finding}")

    # A centre far off is of another resolution, unless the file names this very size.
    doubt = facts.doubt
    try:
        refuse_other_resolution(camera.K, camera.width, camera.height)
    except InputError as error:
        if facts.size is None:
            raise
        doubt = f"{error}. The file names that size itself, so it is believed: a crop may be so"
    if doubt:
        warnings.warn(f"{facts.kind}: {doubt}", Notice, stacklevel=2)
    return camera


def _refuse_distortion(facts: CameraFacts, size: Size | None) -> None:
    """Refuse a lens with distortion; the error says how to undistort, and which camera results."""
    if not facts.is_fisheye and all(abs(k) <= _NO_DISTORTION for k in facts.distortion):
        return
    next_step = "and give the camera of the result"
    if facts.size or size:
        next_step += f": {json.dumps(camera_keys(make_camera(facts, size)))}"
    fisheye = " of a fisheye" if facts.is_fisheye else ""
    coefficients = ", ".join(f"{k:g}" for k in facts.distortion) or "no coefficients"
    raise InputError(
        f"{facts.kind} with lens distortion{fisheye} ({coefficients}), and only images without "
        f"are understood; undistort them by {facts.undistort}, {next_step}"
    )


def _refuse_focal_length(camera: Camera) -> None:
    """Refuse a focal length that is not in pixels of the camera's image."""
    _refuse_normalised(camera.K, camera.width, camera.height)
    fx = float(camera.K[0, 0])
    if _MM_FX_SHARE <= fx / camera.width <= _MAX_FX_SHARE:
        return
    finding = "which sees less than 0.3 degrees; give it in pixels of this image"
    if fx < _MM_FX_SHARE * camera.width:
        finding = "so it looks like millimetres; divide by the width of a pixel in mm"
    raise InputError(f"K has fx {fx:g} for {camera.width}x{camera.height} pixels, {finding}")


def _refuse_rig(rig: StereoRig, *, is_metric: bool) -> None:
    """Refuse a baseline that is not in metres, and principal points that are too far apart.

    Where ``is_metric``, the format names metres, and a wider rig is believed.
    """
    remedy = 'a rig that is truly this wide is written as ours: width, height, K, "baseline_m"'
    max_baseline_m = WIDE_BASELINE_M
    if is_metric:
        remedy = "a rig that is truly this wide is made in Python, as a StereoRig"
        max_baseline_m = _MAX_METRIC_BASELINE_M
    refuse_baseline(rig.baseline_m, remedy, max_baseline_m)
    if abs(rig.cx_right_minus_left_px) >= rig.width:
        raise InputError(
            f"the principal points differ by {rig.cx_right_minus_left_px:g} px, more than the "
            f"image of {rig.width}x{rig.height} is wide; are both cameras of one size? Copy them "
            "anew"
        )


def make_camera(facts: CameraFacts, size: Size | None) -> Camera:
    """Make a camera, or a rig where there is a baseline, without checks of plausibility.

    Raises:
        InputError: the size is missing, or a value is out of a camera's range.
    """
    image_size = facts.size or size
    if image_size is None:
        raise InputError(
            f"{facts.kind} without the image's size; give it beside the image, or write a camera "
            "of ours (width, height, K)"
        )
    common: dict[str, Any] = {"width": image_size[0], "height": image_size[1], "K": facts.K}
    common |= {key: getattr(facts, key) for key in OPTIONAL_KEYS}
    if facts.baseline_m is None:
        return Camera(**common)
    doffs_px = facts.cx_right_minus_left_px
    return StereoRig(**common, baseline_m=facts.baseline_m, cx_right_minus_left_px=doffs_px)


def camera_keys(camera: Camera) -> dict[str, Any]:
    """Convert a camera to the object of depthpose's JSON; values that it lacks are left out."""
    keys: dict[str, Any] = {"width": camera.width, "height": camera.height, "K": camera.K.tolist()}
    if isinstance(camera, StereoRig):
        keys["baseline_m"] = camera.baseline_m
        if camera.cx_right_minus_left_px:
            keys["cx_right_minus_left_px"] = camera.cx_right_minus_left_px
    optional = {key: getattr(camera, key) for key in OPTIONAL_KEYS}
    return keys | {key: value for key, value in optional.items() if value is not None}


def refuse_other_resolution(K: Float[Tensor, "3 3"], width: int, height: int) -> None:
    """Refuse a K that seems to be of the same picture at another resolution.

    The principal point of a lens lies near the centre. By a K of another resolution it is off the
    centre by the same share of the size in both directions, as it seldom is in a crop.

    Raises:
        InputError: K seems so, is normalised, or has its principal point outside the image.
    """
    _refuse_normalised(K, width, height)
    refuse_outside(K, width, height)
    cx = float(K[0, 2])
    cy = float(K[1, 2])
    x_share = (cx + 0.5) / width - 0.5
    y_share = (cy + 0.5) / height - 0.5
    scale = 1 + x_share + y_share  # ratio of the resolution of K to that of the image
    is_same_share = abs(x_share - y_share) <= _SAME_SHARE * max(scale, 1)
    if min(abs(x_share), abs(y_share)) < _OFF_CENTRE or not is_same_share:
        return
    if scale < _CORNER:
        raise InputError(
            f"the principal point ({cx:g}, {cy:g}) lies in the corner of the image; where nobody "
            f"measured it, take the centre, ({(width - 1) / 2:g}, {(height - 1) / 2:g})"
        )
    raise InputError(
        f"the principal point ({cx:g}, {cy:g}) lies far off the centre of the image of "
        f"{width}x{height}: K looks like that of about {width * scale:.0f}x{height * scale:.0f}. "
        f"Multiply fx, fy, cx and cy by {1 / scale:.3g}, or take the image of that size"
    )


def refuse_outside(K: Float[Tensor, "3 3"], width: int, height: int) -> None:
    """Refuse a K whose principal point lies outside the image.

    Raises:
        InputError: it does.
    """
    cx = float(K[0, 2])
    cy = float(K[1, 2])
    if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
        raise InputError(
            f"the principal point ({cx:g}, {cy:g}) lies outside the image of {width}x{height}; do "
            "K and the size belong together?"
        )


def describe_suspicious_centre(camera: Camera) -> str | None:
    """Describe why the principal point of a camera is doubtful; None where it is not.

    It is where it seems to be of another image size, or is off the centre by more than a quarter of
    the size.
    """
    try:
        refuse_other_resolution(camera.K, camera.width, camera.height)
    except InputError as error:
        return str(error)
    cx = float(camera.K[0, 2])
    cy = float(camera.K[1, 2])
    x_share = (cx + 0.5) / camera.width
    y_share = (cy + 0.5) / camera.height
    if max(abs(x_share - 0.5), abs(y_share - 0.5)) <= _FAR_OFF_CENTRE:
        return None
    return (
        f"the principal point ({cx:g}, {cy:g}) lies at {x_share:.0%} of the width and "
        f"{y_share:.0%} of the height of {camera.width}x{camera.height}, more than a quarter off "
        "the centre: is K of another size? Scale fx, fy, cx and cy as the image was. Of a crop it "
        "may be right"
    )


def _refuse_normalised(K: Float[Tensor, "3 3"], width: int, height: int) -> None:
    """Refuse a K whose rows are divided by the size of the image."""
    # An image of a few columns may truly have so small an fx.
    if K[0, 0] <= _NORMALISED_FX < width / 10:
        raise InputError(
            f"K has fx {float(K[0, 0]):g} for {width}x{height} pixels, so it looks normalised; "
            "multiply its first row by the width and its second by the height"
        )


def refuse_baseline(baseline_m: float, remedy: str, most_m: float = WIDE_BASELINE_M) -> None:
    """Refuse a baseline that is plausible in another unit, but not in metres.

    Args:
        baseline_m: the distance between two cameras [m], as the file has it.
        remedy: what to do if it is true, for the error.
        most_m: a baseline of this length or more is refused as too long [m].

    Raises:
        InputError: it is too short or too long; the message suggests the unit it may be in.
    """
    if baseline_m < _MIN_FILE_BASELINE_M:
        raise InputError(
            f"baseline_m is {baseline_m:g}, less than two lenses can stand apart; write metres, "
            f"once ({baseline_m * 1000:g} if it was divided by 1000 without need)"
        )
    if baseline_m < most_m:
        return
    unit = "millimetres; divide by 1000"
    if baseline_m < _MAX_CM:
        unit = (
            f"centimetres; divide by 100 ({baseline_m / 100:g}). If it is in millimetres, divide "
            "by 1000; if in squares of the calibration board, multiply by the side of one in metres"
        )
    raise InputError(f"baseline_m is {baseline_m:g}, which looks like {unit} ({remedy})")


def refuse_unequal_focal_lengths(K: Float[Tensor, "3 3"]) -> None:
    """Refuse a K whose fx and fy differ by more than those of any common image.

    Raises:
        InputError: they do.
    """
    fx = float(K[0, 0])
    fy = float(K[1, 1])
    if not 1 / _MAX_SQUEEZE < fy / fx < _MAX_SQUEEZE:
        shape = "higher than wide" if fx > fy else "wider than high"
        raise InputError(
            f"K has fx {fx:g} and fy {fy:g}, as if pixels were {max(fx / fy, fy / fx):.2g} times "
            f"{shape}; if the image was resized, multiply fx by the horizontal and fy by the "
            "vertical factor of the resize. If its pixels truly are so, resize the image, and K "
            "with it, until they are square"
        )
