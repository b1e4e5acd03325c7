"""Depth and disparity in 16-bit greyscale PNG files: whole units, 0 where nothing is known."""

import math
from io import BytesIO

import numpy as np
import torch
from jaxtyping import Float, Float32
from PIL import Image
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files.disk import AnyPath, refused_as, write_bytes
from depthpose.core.files.images import FAST_PNG, opened_image

KITTI_UNIT = 1 / 256
"""KITTI stores metres and pixels of disparity times 256."""


def read_depth_png(path: AnyPath, unit_m: float = KITTI_UNIT) -> Float32[Tensor, "h w"]:
    """Read depth [m] from a 16-bit PNG; NaN where the file holds 0.

    Args:
        path: a 16-bit greyscale PNG, or a TIFF of that kind, as BOP's ITODD has.
        unit_m: metres a unit.

    Raises:
        InputError: the file is missing, damaged, 8-bit or coloured, or the unit makes no sense.
    """
    return _read_units(path, unit_m)


def write_depth_png(
    path: AnyPath, depth_m: Float[Tensor, "h w"], unit_m: float = KITTI_UNIT
) -> None:
    """Write depth [m] as a 16-bit PNG; 0 where it is NaN, not positive or beyond 65535 units.

    Raises:
        InputError: the map is empty, the unit makes no sense, or the disk refuses.
    """
    _write_units(path, depth_m, unit_m)


def read_disparity_png(path: AnyPath) -> Float32[Tensor, "h w"]:
    """Read disparity [px] from a 16-bit PNG of px x 256; NaN where the file holds 0.

    Raises:
        InputError: the file is missing, damaged, 8-bit or coloured.
    """
    return _read_units(path, KITTI_UNIT)


def write_disparity_png(path: AnyPath, disparity_px: Float[Tensor, "h w"]) -> None:
    """Write disparity [px] as a 16-bit PNG of px x 256; 0 where invalid or 256 px and beyond.

    Raises:
        InputError: the map is empty, or the disk refuses.
    """
    _write_units(path, disparity_px, KITTI_UNIT)


def _read_units(path: AnyPath, unit: float) -> Float32[Tensor, "h w"]:
    _check_unit(path, unit)
    with opened_image(path) as image:
        if image.format not in ("PNG", "TIFF") or image.mode != "I;16":
            raise InputError(
                f"{path}: a {image.format} of mode {image.mode}, where depth or disparity needs a "
                "16-bit greyscale PNG; an 8-bit or colour file is a picture of it, not the data"
            )
        units = torch.from_numpy(np.asarray(image).astype(np.float32))
    return torch.where(units > 0, units * unit, torch.nan)


def _write_units(path: AnyPath, values: Float[Tensor, "h w"], unit: float) -> None:
    _check_unit(path, unit)
    if values.numel() == 0:
        raise InputError(f"{path}: an empty map {tuple(values.shape)} makes no PNG; give pixels")
    units = (values.detach().cpu().double() / unit).round()
    units = torch.where((units >= 1) & (units <= 65535), units, 0)
    encoded = BytesIO()
    with refused_as(path, "map", "check its size"):
        Image.fromarray(units.numpy().astype(np.uint16)).save(encoded, "PNG", **FAST_PNG)
    write_bytes(path, encoded.getvalue())


def _check_unit(path: AnyPath, unit: float) -> None:
    if not (math.isfinite(unit) and unit > 0):
        raise InputError(f"{path}: a unit of {unit} is not positive; KITTI's is 1/256, BOP's 0.001")
