"""Which voxels a sparse convolution reads: coordinates as keys, their levels, and neighbours.

A key packs (cloud, x, y, z) so that sorting and searching are one-dimensional: 12 bits of the
cloud's number and 17 bits of each coordinate, z lowest. Adding a packed offset to a key gives the
key of the neighbour; coordinates keep a margin in their field, so that no addition carries into the
next field. All levels and kernel maps of one set of voxels are computed once
(:class:`CoordinateCache`).

Conventions are MinkowskiEngine's (Choy et al., CVPR 2019), so that its published weights fit: a
coarser level holds ``floor(c / 2) * 2`` of the finer one's coordinates, the offsets of a kernel run
with x fastest, odd kernels are centred and even ones start at 0.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Int, Int32, Int64
from torch import Tensor

from depthpose.core.errors import InputError

FIELD_BITS = 17  #: of a coordinate in a key
HALF = 1 << (FIELD_BITS - 1)  #: is added to a coordinate, so that its field is not negative
REACH = 1 << 12  #: farthest that a kernel may look, in voxels of the finest level
COORDINATE_LIMIT = HALF - REACH  #: coordinates lie in [-COORDINATE_LIMIT, COORDINATE_LIMIT)
CLOUD_LIMIT = 1 << (63 - 3 * FIELD_BITS)  #: clouds that one batch can hold
UNIT_KEYS = (1 << 2 * FIELD_BITS, 1 << FIELD_BITS, 1)  #: what moves a key by one along x, y or z

Keys = Int64[Tensor, " _"]  #: packed coordinates


def pack(coordinates: Int[Tensor, "n 4"]) -> Keys:
    """Pack rows of (cloud, x, y, z) into keys.

    Raises:
        InputError: a number of a cloud or a coordinate is out of range.
    """
    # Do they fit their fields?
    if len(coordinates):
        lowest = coordinates.amin(0).tolist()
        highest = coordinates.amax(0).tolist()
        if lowest[0] < 0 or highest[0] >= CLOUD_LIMIT:
            raise InputError(
                f"cloud numbers run from {lowest[0]} to {highest[0]}, but a batch holds clouds "
                f"0 .. {CLOUD_LIMIT - 1}; split the batch."
            )
        low = min(lowest[1:])
        high = max(highest[1:])
        if low < -COORDINATE_LIMIT or high >= COORDINATE_LIMIT:
            raise InputError(
                f"voxel coordinates run from {low} to {high}, but must lie in "
                f"[{-COORDINATE_LIMIT}, {COORDINATE_LIMIT}); centre each cloud on its mean, drop "
                "far points, or take larger voxels."
            )
    keys, *axes = coordinates.long().unbind(1)
    for coordinate in axes:
        keys = keys << FIELD_BITS | coordinate + HALF
    return keys


def unpack(keys: Keys) -> Int64[Tensor, "n 4"]:
    """Unpack keys to rows of (cloud, x, y, z)."""
    field_mask = (1 << FIELD_BITS) - 1
    x, y, z = ((keys >> shift * FIELD_BITS & field_mask) - HALF for shift in (2, 1, 0))
    cloud = keys >> 3 * FIELD_BITS
    return torch.stack([cloud, x, y, z], 1)


Offsets = tuple[tuple[int, int, int], ...]  #: (x, y, z) of a kernel, in voxels of a level

MARGIN = 4
"""Cells about the box: as far as a kernel may reach beyond it. With fewer, a neighbour past the end
of a row would be looked up in the next row."""
MAX_CELLS = 1 << 24  #: of a box that is tabulated
CELLS_PER_VOXEL = 512  #: a box with more cells is mostly empty: binary search is then cheaper
FEW_CELLS = 1 << 16  #: that a box may have beyond these, so that one of few voxels is tabulated


class VoxelIndex:
    """Finds the rows of one level's voxels by their keys.

    A table of all cells of the clouds' common box is some five times as fast as binary search,
    which is used where the box is too large.
    """

    def __init__(self, keys: Keys, step: int) -> None:
        """Index the sorted keys of a level whose voxels lie ``step`` apart."""
        self._keys = keys
        self._step = step
        self._low = self._strides = keys.new_zeros(4)
        self._table: Tensor | None = None  # row of each cell; None: binary search is used
        if not len(keys):
            return

        # The box about all voxels with a margin, if it is not too large; in steps of the level.
        coordinates = unpack(keys)
        coordinates[:, 1:] >>= step.bit_length() - 1
        low = coordinates.amin(0)
        high = coordinates.amax(0)
        sides = (high - low + 1).tolist()
        sides[1:] = [side + 2 * MARGIN for side in sides[1:]]
        cells = sides[0] * sides[1] * sides[2] * sides[3]
        if cells > min(MAX_CELLS, CELLS_PER_VOXEL * len(coordinates) + FEW_CELLS):
            return

        # The row of each cell; one past the last where there is no voxel.
        low[1:] -= MARGIN
        strides = [sides[1] * sides[2] * sides[3], sides[2] * sides[3], sides[3], 1]
        device = low.device
        self._low = low
        self._strides = torch.tensor(strides, device=device)
        self._table = torch.full((cells,), len(coordinates), dtype=torch.int32, device=device)
        rows = torch.arange(len(coordinates), dtype=torch.int32, device=device)
        self._table[((coordinates - low) * self._strides).sum(1)] = rows

    def find(self, keys: Keys, offsets: Offsets) -> Int32[Tensor, "offsets keys"]:
        """Find the row of each voxel at ``key + offset * step``.

        Where there is no such voxel it is one past the last row, for which callers add a row of
        zeros.
        """
        if not len(self._keys):
            return keys.new_zeros(len(offsets), len(keys), dtype=torch.int32)
        xyz = torch.tensor(offsets, device=keys.device)

        # By binary search.
        if self._table is None:
            key_offsets = (xyz * self._step * xyz.new_tensor(UNIT_KEYS)).sum(-1)
            neighbours = keys + key_offsets[:, None]
            rows = torch.searchsorted(self._keys, neighbours).clamp_(max=len(self._keys) - 1)
            return torch.where(self._keys[rows] == neighbours, rows, len(self._keys)).int()

        # By the table.
        coordinates = unpack(keys)
        coordinates[:, 1:] >>= self._step.bit_length() - 1
        cells = ((coordinates - self._low) * self._strides).sum(1)
        cell_offsets = (xyz * self._strides[1:]).sum(-1)
        neighbours = cells + cell_offsets[:, None]
        return self._table.index_select(0, neighbours.flatten()).view(neighbours.shape)


@dataclass(frozen=True, kw_only=True, eq=False)
class PairList:
    """Pairs of neighbours of two levels, offset by offset.

    They are also arranged in a grid, a line for each offset of the kernel, filled from the left.
    """

    fine: Int64[Tensor, " pairs"]  #: row of each pair in the finer level
    coarse: Int64[Tensor, " pairs"]  #: row in the coarser level, of the kernel's centre
    slot: Int64[Tensor, " pairs"]  #: place of each pair in the grid (volume, most)
    filled: tuple[int, ...]  #: offsets that have pairs; the others are skipped
    counts: tuple[int, ...]  #: number of pairs of each of these offsets
    most: int  #: the largest of these counts


class Slots(NamedTuple):
    """The grid of a :class:`PairList`, for one direction of a convolution."""

    read: Int64[Tensor, " slots"]  #: row that each slot reads; one past the last where it is empty
    order: Int64[Tensor, " pairs"]  #: filled slots, grouped by the row that they add to
    starts: Int64[Tensor, " rows"]  #: where in that order each row written begins


@dataclass(frozen=True, kw_only=True, eq=False)
class NeighbourTable:
    """Neighbours between a fine and a coarse level, or of a level with itself."""

    #: row of the fine voxel that each coarse one has at each offset; one past the last where there
    #: is none.
    table: Int32[Tensor, "volume coarse_rows"]
    fine_rows: int  #: number of voxels of the finer level
    centre: int | None  #: offset at which each voxel is its own neighbour; None across levels
    _slots: dict[bool, Slots] = field(default_factory=dict)  #: by direction, made when asked for

    @cached_property
    def pairs(self) -> PairList:
        """The neighbours as a list, without the centre, which pairs each row with itself."""
        # How many pairs each offset has.
        is_pair = self.table < self.fine_rows
        if self.centre is not None:
            is_pair[self.centre] = False
        counts = is_pair.sum(1)
        numbers = counts.tolist()
        filled = tuple(offset for offset, count in enumerate(numbers) if count)

        # The rows of each pair, offset by offset.
        offset, coarse = is_pair.nonzero(as_tuple=True)
        fine = self.table.flatten().index_select(0, offset * self.table.shape[1] + coarse)

        # The slot of a pair: where the line of its offset starts, and its number in the line.
        most = max(numbers, default=0)
        line_starts = torch.arange(len(counts), device=counts.device) * most
        first_pairs = counts.cumsum(0) - counts
        shifts = (line_starts - first_pairs).index_select(0, offset)
        return PairList(
            fine=fine.long(),
            coarse=coarse,
            slot=shifts + torch.arange(len(fine), device=fine.device),
            filled=filled,
            counts=tuple(numbers[offset] for offset in filled),
            most=most,
        )

    def slots(self, *, is_transposed: bool) -> Slots:
        """Arrange the pairs in a grid, computed once for each direction.

        Its filled slots are sorted by the row that they add to. So a convolution gathers the slots
        of each row and sums them in a fixed order, where scattering would add them up in any order.

        ``is_transposed``: coarse rows are read and fine ones written, not the other way round.
        """
        if is_transposed not in self._slots:
            pairs = self.pairs
            coarse_rows = self.table.shape[1]
            read, read_row_count = pairs.fine, self.fine_rows
            written, written_row_count = pairs.coarse, coarse_rows
            if is_transposed:
                read, read_row_count = pairs.coarse, coarse_rows
                written, written_row_count = pairs.fine, self.fine_rows

            # Empty slots read one past the last row.
            grid = read.new_full((len(self.table) * pairs.most,), read_row_count)
            grid[pairs.slot] = read

            # Filled slots by the row that they add to.
            order = pairs.slot[torch.argsort(written, stable=True)]
            counts = torch.bincount(written, minlength=written_row_count)
            self._slots[is_transposed] = Slots(grid, order, counts.cumsum(0) - counts)
        return self._slots[is_transposed]


@dataclass(frozen=True, kw_only=True, eq=False)
class KernelMap:
    """Neighbours with a direction: the rows that a convolution reads and those that it writes."""

    neighbours: NeighbourTable  #: of the two levels, or of the one
    is_transposed: bool = False  #: False: fine to coarse (or the level to itself); True: back

    def by_offset(self) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Iterate over the offsets with pairs: the offset, the rows read, the rows added to."""
        pairs = self.neighbours.pairs
        # Lists of views, each from one call: slicing one by one costs as much as small products.
        fine = pairs.fine.split(pairs.counts)
        coarse = pairs.coarse.split(pairs.counts)
        rows_in, rows_out = (coarse, fine) if self.is_transposed else (fine, coarse)
        return zip(pairs.filled, rows_in, rows_out, strict=True)


def list_offsets(kernel: int) -> Offsets:
    """List the offsets of a kernel of this size in the order of a weight's rows, x fastest."""
    first = -(kernel // 2) if kernel % 2 else 0
    steps = range(first, first + kernel)
    return tuple((x, y, z) for z in steps for y in steps for x in steps)


@dataclass(eq=False)
class CoordinateCache:
    """Sorted keys of every level, and the neighbours of every kernel that was used.

    Level ``l`` holds coordinates that are multiples of ``2**l``. A transposed convolution lands on
    the stored coordinates of the finer level, never on new ones.
    """

    finest: Keys  #: sorted, distinct keys of level 0
    _coarser: dict[int, Keys] = field(default_factory=dict)  #: keys of levels above 0
    #: by level, of those that were searched.
    _indices: dict[int, VoxelIndex] = field(default_factory=dict)
    #: by (finer level, kernel, levels between).
    _neighbours: dict[tuple[int, int, int], NeighbourTable] = field(default_factory=dict)

    def keys(self, level: int) -> Keys:
        """Return the sorted keys of a level."""
        if level == 0:
            return self.finest
        if level not in self._coarser:
            # A field holds c + HALF, which is not negative: clearing its low bits is a floor
            # division for negative coordinates too.
            low_bits = (2**level - 1) * sum(UNIT_KEYS)
            self._coarser[level] = torch.unique(self.keys(level - 1) & ~low_bits)
        return self._coarser[level]

    def kernel_map(
        self, level: int, kernel: int, stride: int = 1, *, is_transposed: bool = False
    ) -> KernelMap:
        """Find the rows that a convolution reads and writes.

        Args:
            level: the level that it reads.
            kernel: its size: 1, 3, 5 or 7 (3 at most with stride 4); with a stride 2 and 4 too.
            stride: a power of two; with 1 it writes the level that it reads.
            is_transposed: True writes a finer level, False a coarser one or, without a stride, the
                same.
        """
        assert stride & (stride - 1) == 0, f"stride must be a power of two, got {stride}"
        assert kernel % 2 or stride > 1, "an even kernel has no centre: it needs a stride"
        # A coarser voxel lies up to stride - 1 cells below the lowest finer one; an odd kernel
        # looks both ways from it, an even one forward alone.
        beyond = kernel // 2 + stride - 1 if kernel % 2 else max(kernel, stride) - 1
        assert beyond <= MARGIN, f"kernel {kernel} with stride {stride} looks {beyond} cells beyond"

        # The finer of the two levels, from which the map is made for both directions.
        levels = stride.bit_length() - 1
        fine = level - levels if is_transposed else level
        assert fine >= 0, f"level {level} has no level {levels} finer"
        key = (fine, kernel, levels)
        if key not in self._neighbours:
            assert kernel * 2**fine <= REACH, f"kernel {kernel} at level {fine} reaches too far"
            if fine not in self._indices:
                self._indices[fine] = VoxelIndex(self.keys(fine), 2**fine)
            table = self._indices[fine].find(self.keys(fine + levels), list_offsets(kernel))
            centre = None if levels else kernel**3 // 2
            self._neighbours[key] = NeighbourTable(
                table=table, fine_rows=len(self.keys(fine)), centre=centre
            )
        return KernelMap(neighbours=self._neighbours[key], is_transposed=is_transposed)
