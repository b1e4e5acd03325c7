"""Depth maps as COLMAP's dense reconstruction keeps them (``stereo/depth_maps``)."""

import re

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files.disk import AnyPath, read_bytes, write_bytes

_HEADER = re.compile(rb"(\d{1,6})&(\d{1,6})&(\d{1,3})&")


def read_colmap_map(path: AnyPath) -> Float32[Tensor, "h w"]:
    """Read a depth map; NaN where the file holds 0 or less.

    ``WIDTH&HEIGHT&CHANNELS&`` in text, then little-endian float32, columns fastest, as
    ``scripts/python/read_dense.py`` of COLMAP reads it.

    Raises:
        InputError: the file is missing, truncated, of another kind, or has several channels.
    """
    data = read_bytes(path)
    header = _HEADER.match(data)
    if header is None:
        raise InputError(f"{path}: no 'WIDTH&HEIGHT&CHANNELS&' at its start; no map of COLMAP")
    width, height, channels = (int(number) for number in header.groups())
    body = memoryview(data)[header.end() :]
    if channels != 1:
        raise InputError(f"{path}: {channels} channels, a map of normals; depth maps have one")
    if width * height == 0 or len(body) != 4 * width * height:
        raise InputError(
            f"{path}: declares {width}x{height} floats but {len(body)} bytes follow; copy it anew"
        )
    rows = torch.from_numpy(np.frombuffer(body, "<f4").reshape(height, width).astype(np.float32))
    return torch.where(rows > 0, rows, torch.nan)


def write_colmap_map(path: AnyPath, depth: Float[Tensor, "h w"]) -> None:
    """Write a depth map as :func:`read_colmap_map` reads it; 0 where it is NaN.

    Args:
        path: ``stereo/depth_maps/IMAGE.geometric.bin``, IMAGE with its own suffix.
        depth: in the unit of the reconstruction, NaN where nothing is known.

    Raises:
        InputError: the map is empty or holds infinity, or the disk refuses.
    """
    rows = depth.detach().cpu().float().nan_to_num(0.0, torch.inf, -torch.inf).numpy()
    if rows.size == 0 or np.isinf(rows).any():
        raise InputError(f"{path}: the map is empty or holds infinity; mark invalid pixels by NaN")
    height, width = rows.shape
    write_bytes(path, f"{width}&{height}&1&".encode() + rows.astype("<f4").tobytes())
