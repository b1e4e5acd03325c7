"""One integer a voxel: (cloud, x, y, z) packed so that sorting and searching are one-dimensional.

A key holds 12 bits of the cloud's number and 17 bits of each coordinate, z lowest. Adding packed
offsets to a key moves the voxel; coordinates keep off the ends of their field by more than any
kernel reaches, so that a move never carries into the next field.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Int, Int64
from torch import Tensor

from depthpose.core.errors import InputError

FIELD_BITS = 17
HALF = 1 << (FIELD_BITS - 1)
REACH = 1 << 12
"""Farthest that a kernel may look, in voxels of the finest level."""

COORDINATE_LIMIT = HALF - REACH
"""Coordinates lie in [-COORDINATE_LIMIT, COORDINATE_LIMIT)."""

CLOUD_LIMIT = 1 << (63 - 3 * FIELD_BITS)
"""Clouds that one batch can hold."""

Keys = Int64[Tensor, " _"]


def pack(coordinates: Int[Tensor, "n 4"]) -> Keys:
    """Pack rows of (cloud, x, y, z) into keys.

    Raises:
        InputError: a coordinate or the number of clouds does not fit.
    """
    _check_range(coordinates)
    cloud, x, y, z = coordinates.long().unbind(1)
    return (((cloud << FIELD_BITS | x + HALF) << FIELD_BITS | y + HALF) << FIELD_BITS) | z + HALF


def unpack(keys: Keys) -> Int64[Tensor, "n 4"]:
    """Give back what :func:`pack` packed."""
    low = (1 << FIELD_BITS) - 1
    x, y, z = ((keys >> shift * FIELD_BITS & low) - HALF for shift in (2, 1, 0))
    return torch.stack([keys >> 3 * FIELD_BITS, x, y, z], 1)


def packed_move(x: int, y: int, z: int) -> int:
    """Pack an offset: adding it to a key moves the voxel."""
    return (x << 2 * FIELD_BITS) + (y << FIELD_BITS) + z


def coarsen(keys: Keys, stride: int) -> Keys:
    """Give the sorted keys of ``floor(c / stride) * stride``, each once; stride a power of two.

    A field holds c + HALF, which is not negative: clearing its low bits is a floor division for
    negative coordinates too.
    """
    field = packed_move(stride - 1, stride - 1, stride - 1)
    return torch.unique(keys & ~field)


def batch_coordinates(clouds: Sequence[Int[Tensor, "_ 3"]]) -> Int[Tensor, "n 4"]:
    """Put the voxel coordinates of several clouds under each other, each with its number."""
    if not clouds:
        raise InputError("a batch needs a cloud at least, got none; an empty cloud is one too")
    numbered = [torch.nn.functional.pad(xyz, (1, 0), value=i) for i, xyz in enumerate(clouds)]
    return torch.cat(numbered)


def _check_range(coordinates: Int[Tensor, "n 4"]) -> None:
    if not len(coordinates):
        return
    lowest, highest = coordinates.amin(0).tolist(), coordinates.amax(0).tolist()
    if lowest[0] < 0 or highest[0] >= CLOUD_LIMIT:
        raise InputError(
            f"cloud numbers run from {lowest[0]} to {highest[0]}, but a batch holds clouds "
            f"0 .. {CLOUD_LIMIT - 1}; split the batch."
        )
    if min(lowest[1:]) < -COORDINATE_LIMIT or max(highest[1:]) >= COORDINATE_LIMIT:
        raise InputError(
            f"voxel coordinates run from {min(lowest[1:])} to {max(highest[1:])}, but must lie in "
            f"[{-COORDINATE_LIMIT}, {COORDINATE_LIMIT}); centre each cloud on its mean, drop far "
            "points, or take larger voxels."
        )
