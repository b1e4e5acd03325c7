"""The pinhole camera and the rectified stereo rig: geometry, and checks of their values.

Projection, back-projection, cropping and scaling; and the values of a camera file of any format,
from which a plausible :class:`Camera` is made.
"""

import json
import math
import sys
import warnings
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.errors import InputError, Notice

MAX_SIDE_PX = 2**20  # largest image side: a larger number in a file is a mistake, and is refused
MAX_BASELINE_M = 100  # no rig on the ground is this wide: such a number was in millimetres
MIN_BASELINE_M = 1e-4  # no two lenses stand so near: such a number was divided once too often

Window = tuple[slice, slice]
"""Rows and columns of an image."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """A pinhole camera without lens distortion. The centre of the first pixel is (0, 0).

    Raises:
        InputError: a value is out of its range.
    """

    width: int  #: width of the image [px]
    height: int  #: height of the image [px]
    K: Float[Tensor, "3 3"]  #: ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]`` [px], float64
    depth_unit_m: float | None = None  #: metres a unit of its depth images, where it has any
    mount_height_m: float | None = None  #: height above the road, where known
    tilt_deg: float | None = None  #: tilt of the optical axis against the road; up is > 0

    def __post_init__(self) -> None:
        for name, (smallest, largest, reason) in _RANGES.items():
            value = getattr(self, name, None)
            if value is not None and not smallest <= value <= largest:
                raise InputError(f"{name} is {str(value)[:24]}, but {reason}")
        check_intrinsics(self.K)


_SIDE = (1, MAX_SIDE_PX, f"an image has 1 to {MAX_SIDE_PX} pixels in a row or column; correct it")
_SMALLEST_POSITIVE = math.ulp(0.0)
_LARGEST_FINITE = sys.float_info.max
_RANGES = {
    "width": _SIDE,
    "height": _SIDE,
    "depth_unit_m": (
        _SMALLEST_POSITIVE, _LARGEST_FINITE,
        "a unit is a positive number of metres; 0.001 means millimetres"
    ),
    "mount_height_m": (0.1, 20, "a camera stands 0.1 to 20 m above the road; give metres"),
    "tilt_deg": (-45, 45, "a road is seen at -45 to 45 degrees; negative looks down"),
    "baseline_m": (
        _SMALLEST_POSITIVE, _LARGEST_FINITE,
        "the right camera stands at a positive x; are left and right exchanged? Give "
        "its distance from the left one in metres"
    ),
}  # fmt: skip
"""Smallest and largest value of a camera's numbers, and the reason for them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoRig(Camera):
    """The left camera of a rectified pair, and where the right one stands.

    depth = fx * baseline_m / (disparity + cx_right_minus_left_px).

    Raises:
        InputError: a value is out of its range.
    """

    baseline_m: float  #: the right camera's x in the left camera's frame [m], positive
    cx_right_minus_left_px: float = 0.0  #: difference of cx (Middlebury's ``doffs``)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.baseline_m >= MAX_BASELINE_M:
            raise InputError(
                f"baseline_m is {self.baseline_m:g}, which looks like millimetres; divide by 1000"
            )
        if self.baseline_m < MIN_BASELINE_M:
            raise InputError(
                f"baseline_m is {self.baseline_m:g}, less than two lenses can stand apart; give "
                "their distance in metres"
            )
        if not math.isfinite(self.cx_right_minus_left_px):
            raise InputError(
                f"cx_right_minus_left_px is {self.cx_right_minus_left_px}; give pixels, or leave "
                "it out where both principal points agree"
            )


def check_intrinsics(K: Tensor) -> None:
    """Refuse a matrix that is no intrinsic matrix.

    Raises:
        InputError: it is not a finite float64 tensor ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]``
            with positive fx and fy.
    """
    form = "[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"
    if not isinstance(K, Tensor):
        raise InputError(
            f"K is a {type(K).__name__}, not a tensor; pass torch.tensor(K, dtype=torch.float64)"
        )
    if tuple(K.shape) != (3, 3):
        raise InputError(f"K is {tuple(K.shape)}, not 3x3; write {form}")
    if K.dtype != torch.float64:
        raise InputError(f"K is of {K.dtype}, not torch.float64; pass K.double()")
    rows = K.tolist()
    if not bool(K.isfinite().all()):
        raise InputError(f"K is {rows}, not finite; write {form}")
    if rows[2] != [0, 0, 1] or rows[1][0] != 0:
        is_transposed = rows[0][1:] == [0, 0] and rows[0][0] != 0 and K[:, 2].tolist() == [0, 0, 1]
        hint = "it looks transposed; " if is_transposed else ""
        raise InputError(f"K is {rows}; {hint}write {form}")
    if rows[0][0] <= 0 or rows[1][1] <= 0:
        raise InputError(
            f"K has fx {rows[0][0]:g} and fy {rows[1][1]:g}, but focal lengths are positive; "
            f"write {form}"
        )


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Float[Tensor, "3 3"]:
    """Make ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` in float64."""
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


AnyCamera = TypeVar("AnyCamera", bound=Camera)


def pixel_grid(
    height: int,
    width: int,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> Float[Tensor, "{height} {width} 2"]:
    """Make the map of the pixel centres (u, v) [px] of an image; the first is (0, 0)."""
    u = torch.arange(width, dtype=dtype, device=device)
    v = torch.arange(height, dtype=dtype, device=device)
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)


def project(
    points_m: Float[Tensor, "*batch n 3"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch n 2"]:
    """Project camera-frame points to pixels: ``(u, v, 1) ~ K @ (x, y, z)``.

    Any unit of length gives the same pixels. A point that is not in front of the camera
    (``z <= 0``) has no image: its pixel is NaN, and no gradient flows through it. Near
    ``z = 0`` pixels and gradients grow without bound.
    """
    z = points_m[..., 2:]
    is_in_front = z > 0
    rays = points_m / torch.where(is_in_front, z, 1)
    pixels = (rays @ K.to(points_m).mT)[..., :2]
    return torch.where(is_in_front, pixels, torch.nan)


def back_project(
    depth_m: Float[Tensor, "*batch h w"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch h w 3"]:
    """Lift a depth map to camera-frame points [m], one a pixel; NaN where depth is NaN.

    ``depth * K^-1 @ (u, v, 1)``: the inverse of :func:`project` where depth is positive.
    """
    height, width = depth_m.shape[-2:]
    (fx, skew, cx), (_, fy, cy), _ = K.to(depth_m)
    u, v = pixel_grid(height, width, depth_m.dtype, depth_m.device).unbind(-1)
    y = (v - cy) / fy
    x = (u - cx - skew * y) / fx
    return torch.stack([x, y, torch.ones_like(x)], -1) * depth_m[..., None]


def clip_window(left: int, top: int, right: int, bottom: int, height: int, width: int) -> Window:
    """Give the rows and columns of a window [px], as far as they lie in an image.

    ``right`` and ``bottom`` are the first column and row beyond the window.
    """
    rows = slice(min(max(top, 0), height), min(max(bottom, 0), height))
    columns = slice(min(max(left, 0), width), min(max(right, 0), width))
    return rows, columns


def crop_intrinsics(K: Float[Tensor, "3 3"], left: int, top: int) -> Float[Tensor, "3 3"]:
    """Make the intrinsic matrix of a window that begins at column ``left`` and row ``top`` [px]."""
    K = K.clone()
    K[:2, 2] -= K.new_tensor([left, top])
    return K


def crop_camera(camera: AnyCamera, left: int, top: int, width: int, height: int) -> AnyCamera:
    """Make the camera of a window of the image.

    ``left`` and ``top`` are the first column and row of the window [px].

    Raises:
        InputError: the window does not lie inside the image.
    """
    is_inside = left >= 0 and top >= 0 and width >= 1 and height >= 1
    if not is_inside or left + width > camera.width or top + height > camera.height:
        raise InputError(
            f"the window {width}x{height} at ({left}, {top}) does not lie inside the image of "
            f"{camera.width}x{camera.height}; make it smaller"
        )
    return replace(camera, width=width, height=height, K=crop_intrinsics(camera.K, left, top))


def resize_camera(camera: AnyCamera, width: int, height: int) -> AnyCamera:
    """Make the camera of the image scaled to ``width`` x ``height``.

    Pixel centres are whole numbers, so borders lie at -0.5 and ``cx' = (cx + 0.5) s - 0.5``: what
    ``interpolate(align_corners=False)`` does to the image.

    Raises:
        InputError: a size is not positive.
    """
    if width < 1 or height < 1:
        raise InputError(f"cannot resize to {width}x{height}; both sizes are 1 at least")
    sx = width / camera.width
    sy = height / camera.height
    scale = camera.K.new_tensor([[sx, 0, sx / 2 - 0.5], [0, sy, sy / 2 - 0.5], [0, 0, 1]])
    resized = replace(camera, width=width, height=height, K=scale @ camera.K)
    if isinstance(resized, StereoRig):
        return replace(resized, cx_right_minus_left_px=resized.cx_right_minus_left_px * sx)
    return resized


Size = tuple[int, int]  # width and height [px]

KNOWN_FILES = (
    "our JSON (width, height, K), BOP's camera.json, KITTI's calibration (P2 or P_rect_02), "
    "Middlebury's calib.txt, TUM's 'fx fy cx cy', a matrix of 9 numbers, focal_px lines, "
    "camera_info of ROS, FileStorage of OpenCV (YAML, XML, JSON), settings of ORB-SLAM, intrinsics "
    "of RealSense and Open3D (JSON), COLMAP's cameras.txt"
)
"""Formats of camera files, for errors."""

OPTIONAL_KEYS = ("depth_unit_m", "mount_height_m", "tilt_deg")  # beside the matrix

_NORMALISED_FX = 2  # a smaller fx is divided by the width
_MM_FX_SHARE = 0.1  # a focal length below a tenth of the width sees 157 degrees: no pinhole does
_MAX_FX_SHARE = 200  # largest fx as a multiple of the width: it spans 0.3 degrees
_MIN_UNIT_M = 1e-6  # least unit of depth images: with a smaller one 16 bits would end before 7 cm
_FILE_BASELINE_M = 5.0  # a file's number of 50 to 120 is in mm or cm, though a plane may be as wide
WIDE_BASELINE_M = 2.0  # wider than cars' rigs: cm, or squares of a board, where no unit is named
_MIN_FILE_BASELINE_M = 1e-3
_MAX_CM = 30  # a larger number without a unit is in millimetres
_SAME_FOCAL_SHARE = 1e-3  # share by which the focal lengths of a rectified pair may differ
_SAME_ROW_PX = 0.5  # difference that cy of a rectified pair may have
SAME_DIFFERENCE_PX = 1.0  # difference of doffs from that of the two matrices
_MAX_SQUEEZE = 1.8  # ratio of fx to fy or fy to fx; KITTI's images squeezed to 512x256 have 1.66
_NO_DISTORTION = 1e-8  # largest coefficient that counts as 0
_OFF_CENTRE = 0.1  # share of the size that a principal point may be off; KITTI's is below 0.04
_SAME_SHARE = 0.05  # by which shares along x and y may differ and still mean another resolution
_QUARTER = 0.25  # share of the size beyond which a point off the centre is doubted anyway
_CORNER = 0.1  # share of the size at which a principal point is in the corner


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraFacts:
    """Values of a camera file before they are checked; the image's size may be missing."""

    kind: str  # kind of file, for errors
    K: Float[Tensor, "3 3"]
    size: Size | None = None
    baseline_m: float | None = None
    cx_right_minus_left_px: float = 0.0
    is_metric: bool = False  # whether the format says the unit of the baseline
    depth_unit_m: float | None = None
    mount_height_m: float | None = None
    tilt_deg: float | None = None
    distortion: tuple[float, ...] = ()  # coefficients; none, or zeros, of a pinhole
    is_fisheye: bool = False  # equidistant: without coefficients it is no pinhole either
    undistort: str = "cv2.undistort(image, K, distortion)"
    doubt: str = ""  # what the file alone cannot say: shown where a camera is made of it


def facts_from_projections(
    kind: str,
    left: Float64[np.ndarray, "3 4"],
    right: Float64[np.ndarray, "3 4"] | None,
    size: Size | None = None,
) -> CameraFacts:
    """Read the rectified projections P of a pair, or of a single camera.

    ``P[0, 3]`` is -fx times the x of the camera [m].

    Raises:
        InputError: the two are not those of one rectified pair.
    """
    K = torch.from_numpy(left[:, :3].copy())
    if right is None:
        return CameraFacts(kind=kind, K=K, size=size)
    if not (left[0, 0] > 0 and right[0, 0] > 0):
        raise InputError("the focal lengths of the two projections are not positive; copy it anew")
    refuse_apart(left, right)
    # KITTI counts x from camera 0, ROS and OpenCV from the left one.
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


def refuse_apart(left: Float64[np.ndarray, "3 _"], right: Float64[np.ndarray, "3 _"]) -> None:
    """Refuse two matrices that are not of one rectified pair: only cx may differ."""
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
    """Make the camera of a file, once its values are plausible.

    Args:
        facts: values of the file.
        size: width and height of the image, where the file does not say it.

    Raises:
        InputError: the values cannot be those of an undistorted image, in pixels and metres.

    Warns:
        Notice: they are doubtful.
    """
    _refuse_distortion(facts, size)
    camera = make_camera(facts, size)
    _refuse_focal_length(camera)
    refuse_unequal_focal_lengths(camera.K)
    refuse_outside(camera.K, camera.width, camera.height)
    if isinstance(camera, StereoRig):
        _refuse_rig(camera, is_metric=facts.is_metric)
    unit_m = camera.depth_unit_m or 1.0
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
    """Refuse a lens with distortion, and say how to undistort and which camera results."""
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
    way = 'written as ours: width, height, K, "baseline_m"'
    max_baseline_m = WIDE_BASELINE_M
    if is_metric:
        way = "made in Python, as a StereoRig"
        max_baseline_m = _FILE_BASELINE_M
    refuse_baseline(rig.baseline_m, f"a rig that is truly this wide is {way}", max_baseline_m)
    if abs(rig.cx_right_minus_left_px) >= rig.width:
        raise InputError(
            f"the principal points differ by {rig.cx_right_minus_left_px:g} px, more than the "
            f"image of {rig.width}x{rig.height} is wide; are both cameras of one size? Copy them "
            "anew"
        )


def make_camera(facts: CameraFacts, size: Size | None) -> Camera:
    """Make a camera, or a rig where there is a baseline, without checking that it is plausible."""
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
    """Convert a camera to the mapping that depthpose's JSON holds; absent values are left out."""
    keys: dict[str, Any] = {"width": camera.width, "height": camera.height, "K": camera.K.tolist()}
    if isinstance(camera, StereoRig):
        keys["baseline_m"] = camera.baseline_m
        if camera.cx_right_minus_left_px:
            keys["cx_right_minus_left_px"] = camera.cx_right_minus_left_px
    optional = {key: getattr(camera, key) for key in OPTIONAL_KEYS}
    return keys | {key: value for key, value in optional.items() if value is not None}


def refuse_other_resolution(K: Float[Tensor, "3 3"], width: int, height: int) -> None:
    """Refuse a K that looks like that of the same picture at another resolution.

    The principal point of a lens lies near the centre. With K of another resolution it is off the
    centre by the same share in both directions, which a crop seldom is.

    Raises:
        InputError: that is so, or the point lies outside the image.
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


def suspicious_centre(camera: Camera) -> str | None:
    """Describe a principal point that looks like that of another image size; else None.

    It is doubted as well where it is more than a quarter of the size off the centre.
    """
    try:
        refuse_other_resolution(camera.K, camera.width, camera.height)
    except InputError as error:
        return str(error)
    cx = float(camera.K[0, 2])
    cy = float(camera.K[1, 2])
    x_share = (cx + 0.5) / camera.width
    y_share = (cy + 0.5) / camera.height
    if max(abs(x_share - 0.5), abs(y_share - 0.5)) <= _QUARTER:
        return None
    return (
        f"the principal point ({cx:g}, {cy:g}) lies at {x_share:.0%} of the width and "
        f"{y_share:.0%} of the height of {camera.width}x{camera.height}, more than a quarter off "
        "the centre: is K of another size? Scale fx, fy, cx and cy as the image was. Of a crop it "
        "may be right"
    )


def _refuse_normalised(K: Float[Tensor, "3 3"], width: int, height: int) -> None:
    """Refuse a K whose rows are divided by the size of the image."""
    if K[0, 0] <= _NORMALISED_FX < width / 10:
        raise InputError(
            f"K has fx {float(K[0, 0]):g} for {width}x{height} pixels, so it looks normalised; "
            "multiply its first row by the width and its second by the height"
        )


def refuse_baseline(length: float, remedy: str, most_m: float = WIDE_BASELINE_M) -> None:
    """Refuse a distance between two cameras, said to be in metres, that no rig has.

    Args:
        length: the distance.
        remedy: what to do if it is true, for the error.
        most_m: distances from here on are refused.

    Raises:
        InputError: it is too short or too long; the message suggests the unit it may be in.
    """
    if length < _MIN_FILE_BASELINE_M:
        raise InputError(
            f"baseline_m is {length:g}, less than two lenses can stand apart; write metres, once "
            f"({length * 1000:g} if it was divided by 1000 without need)"
        )
    if length < most_m:
        return
    unit = "millimetres; divide by 1000"
    if length < _MAX_CM:
        unit = (
            f"centimetres; divide by 100 ({length / 100:g}). If it is in millimetres, divide by "
            "1000; if in squares of the calibration board, multiply by the side of one in metres"
        )
    raise InputError(f"baseline_m is {length:g}, which looks like {unit} ({remedy})")


def refuse_unequal_focal_lengths(K: Float[Tensor, "3 3"]) -> None:
    """Refuse a K whose two focal lengths differ too much for one lens."""
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
