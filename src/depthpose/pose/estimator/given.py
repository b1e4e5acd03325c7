"""What a caller hands over, files, arrays or tensors, to the room's own inputs."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from depthpose.core.camera import Camera, check_image_matches_camera, read_camera
from depthpose.core.camera.model import check_intrinsics
from depthpose.core.errors import InputError
from depthpose.core.files import read_cloud, read_depth_png, read_map
from depthpose.pose.bop import read_mask
from depthpose.pose.config import METRES, Unit
from depthpose.pose.segmentation import label_parts
from depthpose.pose.types import CloudInput, ViewInput

AnyArray = str | Path | np.ndarray | Tensor
"""A file, an array or a tensor."""
AnyCamera = str | Path | Camera | np.ndarray | Tensor
"""A camera, its file, or its intrinsic matrix alone."""
_SMALLEST_INSTANCE = 0.2
"""Pieces of a mask below this share of the largest are crumbs of a segmentation, not objects."""


def cloud_input(cloud: AnyArray, unit: Unit, object: str, name: str) -> CloudInput:
    """Take points in a unit to a cloud in metres.

    Raises:
        InputError: a file that cannot be read, or no rows of three numbers.
    """
    points = read_cloud(cloud).points if isinstance(cloud, str | Path) else _tensor(cloud)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"{name}: the cloud is of shape {tuple(points.shape)}; give points as rows of x, y and "
            "z: (n, 3)"
        )
    return CloudInput(name=name, points_m=(points.double() * METRES[unit]).float(), object=object)


def view_input(
    depth: AnyArray, mask: AnyArray, camera: AnyCamera, object: str, name: str
) -> ViewInput:
    """Take a depth image, a mask and a camera to a view in metres.

    Raises:
        InputError: a file that cannot be read, sizes that disagree, whole numbers without a unit,
            a matrix that belongs to another image.
    """
    known = read_camera(camera) if isinstance(camera, str | Path) else camera
    depth_m = _depth(depth, known.depth_unit_m if isinstance(known, Camera) else None, name)
    pixels = read_mask(Path(mask)) if isinstance(mask, str | Path) else _tensor(mask) != 0
    height, width = depth_m.shape
    if tuple(pixels.shape) != (height, width):
        raise InputError(
            f"{name}: the mask is of shape {tuple(pixels.shape)}, but the depth image of "
            f"{(height, width)}; give the mask of this very image"
        )
    K = _intrinsics(known, width, height, name)
    return ViewInput(name=name, depth_m=depth_m, mask=pixels, K=K, object=object)


def split_instances(mask: Bool[Tensor, "h w"]) -> list[Bool[Tensor, "h w"]]:
    """Split a mask into its connected pieces, from the largest down; crumbs are left out.

    Pixels that touch at a corner are connected. A piece below a fifth of the largest is a crumb.
    """
    label, pixels = label_parts(mask)
    order = pixels.argsort(descending=True, stable=True)
    least = max(1, math.ceil(_SMALLEST_INSTANCE * int(pixels.max())))
    return [label == k for k in order if int(pixels[k]) >= least]


def _depth(depth: AnyArray, unit_m: float | None, name: str) -> Float[Tensor, "h w"]:
    if isinstance(depth, str | Path):
        if Path(depth).suffix.lower() != ".png":
            return _refuse_no_picture(read_map(Path(depth)), name)
        return read_depth_png(depth, _unit(unit_m, str(depth)))
    values = _refuse_no_picture(_tensor(depth), name)
    if not values.is_floating_point():
        values = values.double() * _unit(unit_m, name)
    return torch.where(values > 0, values, torch.nan).float()


def _unit(unit_m: float | None, name: str) -> float:
    if unit_m is None:
        raise InputError(
            f"{name}: its depth is in whole numbers, and nothing says of what; give a camera with "
            '"depth_unit_m" (0.001 where they are millimetres), or metres as floats'
        )
    return unit_m


def _intrinsics(
    camera: Camera | np.ndarray | Tensor, width: int, height: int, name: str
) -> Float[Tensor, "3 3"]:
    if isinstance(camera, Camera):
        check_image_matches_camera(camera, width, height, name)
        K = camera.K
    else:
        K = _tensor(camera).double()
        check_intrinsics(K)
    cx, cy = float(K[0, 2]), float(K[1, 2])
    if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
        raise InputError(
            f"{name}: K has its principal point at ({cx:g}, {cy:g}), outside the depth image of "
            f"{width}x{height}; it is of another image or size. Resizing an image by s makes fx, "
            "fy, cx and cy s times as large"
        )
    return K


def _refuse_no_picture(values: Tensor, name: str) -> Shaped[Tensor, "h w"]:
    if values.ndim != 2:
        raise InputError(f"{name}: the depth is of shape {tuple(values.shape)}, not (h, w)")
    return values


def _tensor(values: Any) -> Tensor:  # noqa: ANN401  whatever a caller holds
    if isinstance(values, Tensor):
        return values.detach().cpu()
    array = np.asarray(values)
    if array.dtype == np.uint16:
        array = array.astype(np.int32)  # torch computes little with uint16
    return torch.from_numpy(np.ascontiguousarray(array))
