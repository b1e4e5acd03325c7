"""Projection, back-projection, and what cropping, scaling and padding do to a camera."""

from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera.model import Camera, StereoRig
from depthpose.core.errors import InputError

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
            f"{camera.width}x{camera.height}; make it smaller, or pad_camera first"
        )
    return replace(camera, width=width, height=height, K=_move(camera.K, -left, -top))


def pad_camera(camera: AnyCamera, left: int, top: int, right: int, bottom: int) -> AnyCamera:
    """Make the camera of an image with columns and rows added at its sides [px].

    Raises:
        InputError: a number is negative.
    """
    if min(left, top, right, bottom) < 0:
        raise InputError(
            f"padding {(left, top, right, bottom)} (left, top, right, bottom) is negative; "
            "crop_camera takes pixels away"
        )
    return replace(
        camera,
        width=camera.width + left + right,
        height=camera.height + top + bottom,
        K=_move(camera.K, left, top),
    )


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


def _move(K: Float[Tensor, "3 3"], right: int, down: int) -> Float[Tensor, "3 3"]:
    moved = K.clone()
    moved[0, 2] += right
    moved[1, 2] += down
    return moved
