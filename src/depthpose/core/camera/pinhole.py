"""The two cameras, a pinhole and the left one of a rectified pair, and their geometry.

Projection, back-projection, and what cropping, scaling and padding do to a camera; fundamental and
essential matrices of a rectified rig (Hartley and Zisserman 2004, chapters 9 and 11).
"""

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError

MAX_SIDE_PX = 2**20
"""Largest image side: a larger number in a file is a mistake, and is refused."""
MAX_BASELINE_M = 100
"""No rig on the ground is this wide: such a number was in millimetres."""
MIN_BASELINE_M = 1e-4
"""No two lenses stand so near: such a number was divided once too often."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """A pinhole camera without lens distortion. The centre of the first pixel is (0, 0).

    Attributes:
        width: image width [px].
        height: image height [px].
        K: intrinsic matrix ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]`` [px], float64.
        depth_unit_m: metres a unit of this camera's depth images, where it has any.
        mount_height_m: height above the road, where known.
        tilt_deg: of the optical axis against the road, where known; positive looks up.

    Raises:
        InputError: a value is out of its range.
    """

    width: int
    height: int
    K: Float[Tensor, "3 3"]
    depth_unit_m: float | None = None
    mount_height_m: float | None = None
    tilt_deg: float | None = None

    def __post_init__(self) -> None:
        for name, size in (("width", self.width), ("height", self.height)):
            if not 1 <= size <= MAX_SIDE_PX:
                raise InputError(
                    f"{name} is {str(size)[:20]}, but an image has 1 to {MAX_SIDE_PX} pixels in a "
                    "row or column; correct it"
                )
        check_intrinsics(self.K)
        if self.depth_unit_m is not None and not 0 < self.depth_unit_m < math.inf:
            raise InputError(
                f"depth_unit_m is {self.depth_unit_m}, but a unit is a positive number of metres; "
                "0.001 means millimetres"
            )
        if self.mount_height_m is not None and not 0.1 <= self.mount_height_m <= 20:
            raise InputError(
                f"mount_height_m is {self.mount_height_m}, but a camera stands 0.1 to 20 m above "
                "the road; give metres"
            )
        if self.tilt_deg is not None and not -45 <= self.tilt_deg <= 45:
            raise InputError(
                f"tilt_deg is {self.tilt_deg}, but a road is seen at -45 to 45 degrees; negative "
                "looks down"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoRig(Camera):
    """The left camera of a rectified pair, and where the right one stands.

    Attributes:
        baseline_m: the right camera's x in the left camera's frame [m], positive.
        cx_right_minus_left_px: difference of the two principal points (Middlebury's ``doffs``).
            depth = fx * baseline_m / (disparity + cx_right_minus_left_px).

    Raises:
        InputError: a value is out of its range.
    """

    baseline_m: float
    cx_right_minus_left_px: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.baseline_m < math.inf:
            raise InputError(
                f"baseline_m is {self.baseline_m}, but the right camera stands at a positive x; "
                "are left and right exchanged? Give its distance from the left one in metres"
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
        InputError: the shape, the type or a value of ``K`` is wrong.
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


AnyCamera = TypeVar("AnyCamera", bound=Camera)


def pixel_grid(
    height: int,
    width: int,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> Float[Tensor, "{height} {width} 2"]:
    """List the (u, v) of every pixel centre [px]; the first is (0, 0)."""
    u = torch.arange(width, dtype=dtype, device=device)
    v = torch.arange(height, dtype=dtype, device=device)
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)


def project(
    points_m: Float[Tensor, "*batch n 3"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch n 2"]:
    """Project camera-frame points to pixels: ``(u, v, 1) ~ K @ (x, y, z)``.

    Any unit of length gives the same pixels. A point that is not in front of the camera
    (``z <= 0``) has no picture: its pixel is NaN, and no gradient flows through it. Near
    ``z = 0`` pixels and gradients grow without bound.
    """
    z = points_m[..., 2:]
    is_seen = z > 0
    rays = points_m / torch.where(is_seen, z, 1)
    pixels = (rays @ K.to(points_m).mT)[..., :2]
    return torch.where(is_seen, pixels, torch.nan)


def back_project(
    depth_m: Float[Tensor, "*batch h w"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch h w 3"]:
    """Lift a depth map to camera-frame points [m], one a pixel; NaN where depth is NaN.

    ``depth * K^-1 @ (u, v, 1)``: the inverse of :func:`project` where depth is positive.
    """
    height, width = depth_m.shape[-2:]
    intrinsic = K.to(depth_m)
    pixels = pixel_grid(height, width, depth_m.dtype, depth_m.device)
    y = (pixels[..., 1] - intrinsic[1, 2]) / intrinsic[1, 1]
    x = (pixels[..., 0] - intrinsic[0, 2] - intrinsic[0, 1] * y) / intrinsic[0, 0]
    return torch.stack([x, y, torch.ones_like(x)], -1) * depth_m[..., None]


def crop_camera(camera: AnyCamera, left: int, top: int, width: int, height: int) -> AnyCamera:
    """Make the camera of a window of the image.

    Args:
        camera: the camera of the whole image.
        left: first column kept [px].
        top: first row kept [px].
        width: columns kept [px].
        height: rows kept [px].

    Raises:
        InputError: the window does not lie inside the image.
    """
    is_inside = left >= 0 and top >= 0 and width >= 1 and height >= 1
    if not is_inside or left + width > camera.width or top + height > camera.height:
        raise InputError(
            f"the window {width}x{height} at ({left}, {top}) does not lie inside the image of "
            f"{camera.width}x{camera.height}; make it smaller"
        )
    K = camera.K.clone()
    K[:2, 2] -= K.new_tensor([left, top])
    return replace(camera, width=width, height=height, K=K)


def resize_camera(camera: AnyCamera, width: int, height: int) -> AnyCamera:
    """Make the camera of the image scaled to ``width`` x ``height``.

    Pixel centres are whole numbers, so borders lie at -0.5 and ``cx' = (cx + 0.5) s - 0.5``: what
    ``interpolate(align_corners=False)`` does to the image.

    Raises:
        InputError: a size is not positive.
    """
    if width < 1 or height < 1:
        raise InputError(f"cannot resize to {width}x{height}; both sizes are 1 at least")
    sx, sy = width / camera.width, height / camera.height
    scale = camera.K.new_tensor([[sx, 0, sx / 2 - 0.5], [0, sy, sy / 2 - 0.5], [0, 0, 1]])
    resized = replace(camera, width=width, height=height, K=scale @ camera.K)
    if isinstance(resized, StereoRig):
        return replace(resized, cx_right_minus_left_px=resized.cx_right_minus_left_px * sx)
    return resized
