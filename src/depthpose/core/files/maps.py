"""Float maps in NPY and PFM files; depth and disparity in 16-bit PNG, 0 where unknown."""

import math
import re
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Shaped
from PIL import Image
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files.disk import (
    AnyPath,
    refused_as,
    refused_suffix,
    write_bytes,
)
from depthpose.core.files.images import FAST_PNG, opened_image
from depthpose.core.files.store import read_bytes

MAP_SUFFIXES = (".npy", ".pfm")
"""Suffixes of files that hold a map of floats."""
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", *MAP_SUFFIXES)
"""Suffixes of depth images of a sensor."""
_HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_MAX_DIMENSIONS, _MAX_VALUES = 8, 2**26
_PFM_HEADER = re.compile(
    rb"P([fF])\s+(\d{1,9})\s+(\d{1,9})\s+([-+]?[0-9.]{1,32}(?:[eE][-+]?\d{1,3})?)(?:\r\n|\s)"
)


def read_map(path: AnyPath) -> Float32[Tensor, "h w"]:
    """Read a map from ``.npy`` (float16, 32 or 64) or one-channel ``.pfm``; NaN where invalid.

    A PFM file marks invalid pixels by infinity, as Middlebury's do; the magnitude of its scale
    is not applied. An NPY file marks them by NaN and may not hold infinity.

    Raises:
        InputError: the file is missing, damaged, of another type or shape, or holds infinity.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".pfm":
        return _read_pfm(path)
    if suffix != ".npy":
        raise refused_suffix(path, "map", MAP_SUFFIXES)
    array = read_npy(path)
    if array.ndim != 2 or array.size == 0:
        raise InputError(f"{path}: a map is (H, W), got {array.shape}; save one channel alone")
    if np.isinf(array).any():
        raise InputError(f"{path}: holds infinity; mark invalid pixels by NaN")
    return torch.from_numpy(array)


def write_map(path: AnyPath, map: Float[Tensor, "h w"]) -> None:
    """Write a map as float32 ``.npy`` (NaN: invalid) or ``.pfm`` (infinity: invalid).

    Raises:
        InputError: the map is empty or holds infinity, the suffix is another, the disk refuses.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in MAP_SUFFIXES:
        raise refused_suffix(path, "map", MAP_SUFFIXES)
    array = map.detach().cpu().float().contiguous().numpy()
    if array.size == 0 or np.isinf(array).any():
        raise InputError(f"{path}: the map is empty or holds infinity; mark invalid pixels by NaN")
    if suffix == ".npy":
        encoded = BytesIO()
        np.save(encoded, array, allow_pickle=False)
        write_bytes(path, encoded.getvalue())
    else:
        height, width = array.shape
        rows = np.where(np.isnan(array), np.inf, array)[::-1].astype("<f4")
        write_bytes(path, f"Pf\n{width} {height}\n-1.0\n".encode() + rows.tobytes())


def read_npy(path: AnyPath) -> np.ndarray:
    """Read a float array of any shape as float32; never unpickles."""
    array = read_numbers(path)
    if array.dtype.kind != "f":
        raise InputError(
            f"{path}: holds {array.dtype}, not float16, 32 or 64; save floats in the unit that is "
            "meant (millimetres as whole numbers: .astype('float32') / 1000 are metres)"
        )
    return to_float32(array)


def read_numbers(path: AnyPath) -> np.ndarray:
    """Read an array of floats or whole numbers of any shape as it is; never unpickles."""
    stream = BytesIO(read_bytes(path))
    with refused_as(path, "NPY file", "save it again with numpy.save"):
        version = np.lib.format.read_magic(stream)
        if version not in _HEADER_READERS:
            raise InputError(f"{path}: NPY version {version}; save plain floats with numpy.save")
        shape, is_fortran, dtype = _HEADER_READERS[version](stream)
        if dtype.kind not in "fiu" or dtype.itemsize > 8:
            raise InputError(
                f"{path}: holds {dtype}, not float16, 32 or 64; save .astype('float32')"
            )
        body = stream.getbuffer()[stream.tell() :]
        if len(shape) > _MAX_DIMENSIONS or any(type(side) is not int for side in shape):
            raise InputError(
                f"{path}: declares an array of shape {str(shape)[:60]}; give whole numbers, "
                f"{_MAX_DIMENSIONS} at most"
            )
        if min(shape, default=1) < 0 or math.prod(shape) * dtype.itemsize != len(body):
            raise InputError(
                f"{path}: declares {dtype} {str(shape)[:60]} but {len(body)} bytes follow; it is "
                "truncated or damaged, save it again"
            )
        if math.prod(shape) > _MAX_VALUES:
            raise InputError(
                f"{path}: {math.prod(shape)} values, more than {_MAX_VALUES}; split it"
            )
        return np.frombuffer(body, dtype).reshape(shape, order="F" if is_fortran else "C")


def to_float32(array: np.ndarray) -> np.ndarray:
    """Copy to native contiguous float32; what float32 cannot hold becomes infinity."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.array(array, dtype=np.float32, order="C")


def _read_pfm(path: AnyPath) -> Float32[Tensor, "h w"]:
    data = read_bytes(path)
    header = _PFM_HEADER.match(data)
    if header is None:
        raise InputError(f"{path}: no PFM header ('Pf', width, height, scale); is it a PFM file?")
    if header[1] == b"F":
        raise InputError(f"{path}: a colour PFM (PF), not a map; save one channel (Pf)")
    width, height = int(header[2]), int(header[3])
    body = memoryview(data)[header.end() :]
    if width * height == 0 or width * height * 4 != len(body):
        raise InputError(
            f"{path}: declares {width}x{height} floats but {len(body)} bytes follow; it is "
            "truncated or damaged, save it again"
        )
    with refused_as(path, "PFM scale", "it must be a number other than 0"):
        scale = float(header[4])
    if scale == 0 or not math.isfinite(scale):
        raise InputError(f"{path}: PFM scale {scale}; its sign gives the byte order, so not 0")
    rows = np.frombuffer(body, "<f4" if scale < 0 else ">f4").reshape(height, width)
    array = to_float32(rows[::-1])
    array[~np.isfinite(array)] = np.nan
    return torch.from_numpy(array)


KITTI_UNIT = 1 / 256  # KITTI stores metres and pixels of disparity times 256


def read_depth_png(path: AnyPath, unit_m: float = KITTI_UNIT) -> Float32[Tensor, "h w"]:
    """Read depth [m] from a 16-bit PNG; NaN where the file holds 0.

    Args:
        path: a 16-bit greyscale PNG, or a TIFF of that kind, as BOP's ITODD has.
        unit_m: metres a unit.

    Raises:
        InputError: the file is missing, damaged, 8-bit or coloured, or the unit makes no sense.
    """
    _check_unit(path, unit_m)
    with opened_image(path) as image:
        if image.format not in ("PNG", "TIFF") or image.mode not in ("I;16", "I;16B"):
            raise InputError(
                f"{path}: a {image.format} of mode {image.mode}, where depth or disparity needs a "
                "16-bit greyscale PNG; an 8-bit or colour file is a picture of it, not the data"
            )
        units = torch.from_numpy(np.asarray(image).astype(np.float32))
    return torch.where(units > 0, units * unit_m, torch.nan)


def read_stored_depth(path: AnyPath) -> Shaped[Tensor, "h w"]:
    """Read depth as it is stored: whole numbers of a 16-bit PNG, TIFF or NPY; floats of the others.

    Whole numbers are 0 where there is no reading, floats NaN.

    Raises:
        InputError: the file is missing, damaged, no map, or a picture of one.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        raise refused_suffix(path, "depth image", DEPTH_SUFFIXES)
    if suffix == ".npy" and (array := read_numbers(path)).dtype.kind != "f":
        if array.ndim != 2:
            raise InputError(f"{path}: depth is (H, W), got {array.shape}; save one channel alone")
        return torch.from_numpy(array.astype(np.int64))
    if suffix in MAP_SUFFIXES:
        return read_map(path)
    if suffix != ".png":
        with opened_image(path) as image:
            if image.mode in ("F", "I"):
                return torch.from_numpy(np.array(image))
    return read_depth_png(path, 1.0).nan_to_num(0.0).int()


def write_depth_png(
    path: AnyPath, depth_m: Float[Tensor, "h w"], unit_m: float = KITTI_UNIT
) -> None:
    """Write depth [m] as a 16-bit PNG; 0 where it is NaN, not positive or beyond 65535 units.

    Raises:
        InputError: the map is empty, the unit makes no sense, or the disk refuses.
    """
    _check_unit(path, unit_m)
    if depth_m.numel() == 0:
        raise InputError(f"{path}: an empty map {tuple(depth_m.shape)} makes no PNG; give pixels")
    units = (depth_m.detach().cpu().double() / unit_m).round()
    units = torch.where((units >= 1) & (units <= 65535), units, 0)
    encoded = BytesIO()
    with refused_as(path, "map", "check its size"):
        Image.fromarray(units.numpy().astype(np.uint16)).save(encoded, "PNG", **FAST_PNG)
    write_bytes(path, encoded.getvalue())


def read_disparity_png(path: AnyPath) -> Float32[Tensor, "h w"]:
    """Read disparity [px] from a 16-bit PNG of px x 256; NaN where the file holds 0.

    Raises:
        InputError: the file is missing, damaged, 8-bit or coloured.
    """
    return read_depth_png(path)


def write_disparity_png(path: AnyPath, disparity_px: Float[Tensor, "h w"]) -> None:
    """Write disparity [px] as a 16-bit PNG of px x 256; 0 where invalid or 256 px and beyond.

    Raises:
        InputError: the map is empty, or the disk refuses.
    """
    write_depth_png(path, disparity_px)


def _check_unit(path: AnyPath, unit: float) -> None:
    if not (math.isfinite(unit) and unit > 0):
        raise InputError(f"{path}: a unit of {unit} is not positive; KITTI's is 1/256, BOP's 0.001")
