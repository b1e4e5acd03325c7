"""The pinhole camera and the rectified stereo rig: projection, back-projection, crops, scaling."""

import math
import sys
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError

MAX_SIDE_PX = 2**20  # largest width and height of an image: a larger number is a mistake
MAX_BASELINE_M = 100  # no rig on the ground is this wide: such a number is in millimetres
MIN_BASELINE_M = 1e-4  # no two lenses stand so near: such a number was divided once too often

Size = tuple[int, int]
"""Width and height of an image [px]."""
Window = tuple[slice, slice]
"""Rows and columns of a part of an image."""
CameraT = TypeVar("CameraT", bound="Camera")


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """A pinhole camera without lens distortion. The centre of the first pixel is (0, 0).

    Raises:
        InputError: a value is out of its range.
    """

    width: int  #: width of the image [px]
    height: int  #: height of the image [px]
    K: Float[Tensor, "3 3"]  #: ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]`` [px], float64
    depth_unit_m: float | None = None  #: unit of its depth images [m]; None: it has none
    mount_height_m: float | None = None  #: height above the road [m]; None: unknown
    #: angle of the optical axis to the road [degrees], positive upwards; None: unknown
    tilt_deg: float | None = None

    def __post_init__(self) -> None:
        for name, (smallest, largest, reason) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not smallest <= value <= largest:
                raise InputError(f"{name} is {str(value)[:_MOST_LETTERS]}, but {reason}")
        check_intrinsics(self.K)


_SIDE = (1, MAX_SIDE_PX, f"an image has 1 to {MAX_SIDE_PX} pixels in a row or column; correct it")
_MOST_LETTERS = 24  # of a wrong value in an error: a whole number may have thousands of digits
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
        if not 0 < self.baseline_m <= _LARGEST_FINITE:
            raise InputError(
                f"baseline_m is {str(self.baseline_m)[:_MOST_LETTERS]}, but the right camera "
                "stands at a positive x; are left and right exchanged? Give its distance from the "
                "left one in metres"
            )
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
    """Project points in the camera's frame to pixels (u, v): ``z (u, v, 1) = K (x, y, z)``.

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
    """Lift a depth map to points in the camera's frame [m], one a pixel; NaN where depth is NaN.

    ``depth * K^-1 @ (u, v, 1)``: the inverse of :func:`project` where depth is positive.
    """
    height, width = depth_m.shape[-2:]
    (fx, skew, cx), (_, fy, cy), _ = K.to(depth_m)
    u, v = pixel_grid(height, width, depth_m.dtype, depth_m.device).unbind(-1)
    y = (v - cy) / fy
    x = (u - cx - skew * y) / fx
    return torch.stack([x, y, torch.ones_like(x)], -1) * depth_m[..., None]


def clip_window(left: int, top: int, right: int, bottom: int, height: int, width: int) -> Window:
    """Clip a window to an image.

    Args:
        left: first column of the window [px].
        top: first row.
        right: first column beyond the window.
        bottom: first row beyond it.
        height: rows of the image.
        width: columns of the image.

    Returns:
        Rows and columns of the window that lie in the image; empty slices where none do.
    """
    rows = slice(min(max(top, 0), height), min(max(bottom, 0), height))
    columns = slice(min(max(left, 0), width), min(max(right, 0), width))
    return rows, columns


def crop_intrinsics(K: Float[Tensor, "3 3"], left: int, top: int) -> Float[Tensor, "3 3"]:
    """Make the intrinsic matrix of a window that begins at column ``left`` and row ``top`` [px]."""
    K = K.clone()
    K[:2, 2] -= K.new_tensor([left, top])
    return K


def crop_camera(camera: CameraT, left: int, top: int, width: int, height: int) -> CameraT:
    """Make the camera of a window of the image.

    Args:
        camera: camera of the image.
        left: first column of the window [px].
        top: first row.
        width: number of columns.
        height: number of rows.

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


def resize_camera(camera: CameraT, width: int, height: int) -> CameraT:
    """Make the camera of the image scaled to ``width`` x ``height`` [px].

    Pixel centres are whole numbers and the image begins at -0.5, so ``cx' = (cx + 0.5) s - 0.5``,
    as ``interpolate(align_corners=False)`` scales images.

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
