"""One integer a voxel: (cloud, x, y, z) packed so that sorting and searching are one-dimensional.

A key holds 12 bits of the cloud's number and 17 bits of each coordinate, z lowest. Adding packed
offsets to a key moves the voxel; coordinates keep off the ends of their field by more than any
kernel reaches, so that a move never carries into the next field.

Rows are found by keys through a table of a box, by binary search, or by a compiled walk along both
lists.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Int, Int32, Int64
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.pose.compiled import serves

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


Moves = tuple[tuple[int, int, int], ...]

MARGIN = 4
"""Cells about the box: as far as a kernel may look beyond it (:func:`reach_beyond`). With fewer a
look past one row's end would find the next row."""

MAX_CELLS = 1 << 24
CELLS_PER_VOXEL = 512
"""A box with more cells than these is mostly air: binary search is then the cheaper."""


def reach_beyond(kernel: int, stride: int) -> int:
    """Cells that a kernel looks beyond the box of the finer level's voxels.

    A coarser voxel lies up to ``stride - 1`` cells below the lowest finer one in it. An odd kernel
    looks both ways from it, an even one forward alone.
    """
    return kernel // 2 + stride - 1 if kernel % 2 else max(kernel, stride) - 1


class VoxelIndex:
    """Finds rows of one level's voxels.

    Where the clouds' common box is small enough, a table of its cells answers by one gather, some
    five times faster than binary search; a compiled walk along the sorted keys needs neither. All
    find the same.
    """

    def __init__(self, keys: Keys, step: int) -> None:
        """Index the sorted keys of a level whose voxels lie ``step`` apart."""
        self._keys, self._step = keys, step
        self._low = self._strides = keys.new_zeros(4)
        self._table: Tensor | None = None
        self._is_compiled = serves(keys)
        if len(keys) and not self._is_compiled:
            self._lay_out()

    def find(self, standing: Keys, moves: Moves) -> Int32[Tensor, "moves standing"]:
        """Give the row of each voxel ``standing + move * step``.

        Where there is none, one past the last row: a row of zeros put there answers for it.
        """
        if not len(self._keys):
            return standing.new_zeros(len(moves), len(standing), dtype=torch.int32)
        if self._is_compiled:
            from depthpose.pose.compiled.convolve import rows_of

            packed = [packed_move(*move) * self._step for move in moves]
            return torch.from_numpy(rows_of(self._keys.numpy(), standing.numpy(), packed))
        if self._table is None:
            return self._by_search(standing, moves)
        cells = self._cells(standing)
        offsets = (torch.tensor(moves, device=cells.device) * self._strides[1:]).sum(-1)
        wanted = offsets[:, None] + cells
        return self._table.index_select(0, wanted.flatten()).view(wanted.shape)

    def _lay_out(self) -> None:
        coordinates = self._cell_coordinates(self._keys)
        low, high = coordinates.amin(0), coordinates.amax(0)
        sides = (high - low + 1).tolist()
        sides[1:] = [side + 2 * MARGIN for side in sides[1:]]
        cells = sides[0] * sides[1] * sides[2] * sides[3]
        if cells > min(MAX_CELLS, CELLS_PER_VOXEL * len(coordinates) + MAX_CELLS // 256):
            return
        low[1:] -= MARGIN
        strides = [sides[1] * sides[2] * sides[3], sides[2] * sides[3], sides[3], 1]
        device = low.device
        self._low, self._strides = low, torch.tensor(strides, device=device)
        self._table = torch.full((cells,), len(coordinates), dtype=torch.int32, device=device)
        rows = torch.arange(len(coordinates), dtype=torch.int32, device=device)
        self._table[self._cells(self._keys)] = rows

    def _cell_coordinates(self, keys: Keys) -> Int64[Tensor, "n 4"]:
        coordinates = unpack(keys)
        coordinates[:, 1:] >>= self._step.bit_length() - 1
        return coordinates

    def _cells(self, keys: Keys) -> Int64[Tensor, " _"]:
        return ((self._cell_coordinates(keys) - self._low) * self._strides).sum(1)

    def _by_search(self, standing: Keys, moves: Moves) -> Int32[Tensor, "moves standing"]:
        packed = [packed_move(*move) * self._step for move in moves]
        wanted = standing + torch.tensor(packed, device=standing.device)[:, None]
        rows = torch.searchsorted(self._keys, wanted).clamp_(max=len(self._keys) - 1)
        return torch.where(self._keys[rows] == wanted, rows, len(self._keys)).int()
