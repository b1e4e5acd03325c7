"""Voxels as integers, and which input voxel is the neighbour of which output voxel.

A key packs (cloud, x, y, z) so that sorting and searching are one-dimensional: 12 bits of the
cloud's number and 17 bits of each coordinate, z lowest. Adding packed offsets to a key moves the
voxel; coordinates keep off the ends of their field by more than any kernel reaches, so that a move
never carries into the next field. Rows are found by keys through a table of a box, by binary
search, or by a compiled walk along both lists.

All levels and kernel maps of one set of voxels are made once (:class:`CoordinateCache`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
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
    """Pack rows of (cloud, x, y, z) into keys."""
    if len(coordinates):
        lowest, highest = coordinates.amin(0).tolist(), coordinates.amax(0).tolist()
        if lowest[0] < 0 or highest[0] >= CLOUD_LIMIT:
            raise InputError(
                f"cloud numbers run from {lowest[0]} to {highest[0]}, but a batch holds clouds "
                f"0 .. {CLOUD_LIMIT - 1}; split the batch."
            )
        low, high = min(lowest[1:]), max(highest[1:])
        if low < -COORDINATE_LIMIT or high >= COORDINATE_LIMIT:
            raise InputError(
                f"voxel coordinates run from {low} to {high}, but must lie in "
                f"[{-COORDINATE_LIMIT}, {COORDINATE_LIMIT}); centre each cloud on its mean, drop "
                "far points, or take larger voxels."
            )
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


def batch_coordinates(clouds: Sequence[Int[Tensor, "_ 3"]]) -> Int[Tensor, "n 4"]:
    """Put the voxel coordinates of several clouds under each other, each with its number."""
    if not clouds:
        raise InputError("a batch needs a cloud at least, got none; an empty cloud is one too")
    numbered = [torch.nn.functional.pad(xyz, (1, 0), value=i) for i, xyz in enumerate(clouds)]
    return torch.cat(numbered)


Moves = tuple[tuple[int, int, int], ...]

MARGIN = 4
"""Cells about the box: as far as a kernel may look beyond it. With fewer a look past one row's end
would find the next row."""

MAX_CELLS = 1 << 24
CELLS_PER_VOXEL = 512
"""A box with more cells than these is mostly air: binary search is then the cheaper."""


class VoxelIndex:
    """Finds rows of one level's voxels, the same in each of three ways.

    A compiled walk along the sorted keys where it serves; a table of the cells of the clouds'
    common box where that is small enough, some five times faster than binary search; or that.
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
        packed = [packed_move(*move) * self._step for move in moves]
        if self._is_compiled:
            from depthpose.pose.compiled.convolve import rows_of

            moved = np.array(packed, np.int64)
            return torch.from_numpy(rows_of(self._keys.numpy(), standing.numpy(), moved))
        if self._table is None:
            wanted = standing + torch.tensor(packed, device=standing.device)[:, None]
            rows = torch.searchsorted(self._keys, wanted).clamp_(max=len(self._keys) - 1)
            return torch.where(self._keys[rows] == wanted, rows, len(self._keys)).int()
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


@dataclass(frozen=True, kw_only=True, eq=False)
class PairList:
    """Neighbours of two levels, offset by offset.

    Attributes:
        fine: row of each pair in the finer level: where the kernel reads.
        coarse: row of each pair in the coarser level: where the kernel is centred.
        slot: place of each pair in a grid of (volume, most).
        filled: offsets that have pairs; the others are skipped.
        counts: how many pairs each of them has.
        most: the largest of these counts.
    """

    fine: Int64[Tensor, " pairs"]
    coarse: Int64[Tensor, " pairs"]
    slot: Int64[Tensor, " pairs"]
    filled: tuple[int, ...]
    counts: tuple[int, ...]
    most: int


@dataclass(frozen=True, kw_only=True, eq=False)
class NeighbourTable:
    """Neighbours between a fine and a coarse level, or of a level with itself.

    Attributes:
        table: row of the fine voxel that each coarse one has at each offset; one past the last
            where there is none.
        fine_rows: number of voxels of the finer level.
        centre: offset at which each voxel is its own neighbour; None across levels.
    """

    table: Int32[Tensor, "volume coarse_rows"]
    fine_rows: int
    centre: int | None

    @cached_property
    def pairs(self) -> PairList:
        """The neighbours listed, but for the centre: there input and output rows are the same."""
        is_pair = self.table < self.fine_rows
        if self.centre is not None:
            is_pair[self.centre] = False
        counts = is_pair.sum(1)
        numbers = counts.tolist()
        filled = tuple(offset for offset, count in enumerate(numbers) if count)
        offset, coarse = is_pair.nonzero(as_tuple=True)
        fine = self.table.flatten().index_select(0, offset * self.table.shape[1] + coarse)
        # The pairs of an offset fill its line of the grid from the left.
        most = max(numbers, default=0)
        shifts = torch.arange(len(counts), device=counts.device) * most
        lines = (shifts - counts.cumsum(0) + counts).index_select(0, offset)
        return PairList(
            fine=fine.long(), coarse=coarse, filled=filled,
            slot=lines + torch.arange(len(fine), device=fine.device),
            counts=tuple(numbers[offset] for offset in filled), most=most,
        )  # fmt: skip

    @cached_property
    def fine_grid(self) -> Int64[Tensor, " slots"]:
        """Fine row of each slot; one past the last row where the slot is empty."""
        return self._grid(self.pairs.fine, self.fine_rows)

    @cached_property
    def coarse_grid(self) -> Int64[Tensor, " slots"]:
        """Coarse row of each slot; one past the last row where the slot is empty."""
        return self._grid(self.pairs.coarse, self.table.shape[1])

    @cached_property
    def by_fine(self) -> tuple[Tensor, Tensor]:
        """Slots grouped by fine row: their order, and where in it each row begins."""
        return self._grouped(self.pairs.fine, self.fine_rows)

    @cached_property
    def by_coarse(self) -> tuple[Tensor, Tensor]:
        """Slots grouped by coarse row."""
        return self._grouped(self.pairs.coarse, self.table.shape[1])

    def _grid(self, rows: Tensor, nobody: int) -> Tensor:
        grid = rows.new_full((len(self.table) * self.pairs.most,), nobody)
        grid[self.pairs.slot] = rows
        return grid

    def _grouped(self, rows: Tensor, count: int) -> tuple[Tensor, Tensor]:
        counts = torch.bincount(rows, minlength=count)
        return self.pairs.slot[torch.argsort(rows, stable=True)], counts.cumsum(0) - counts


@dataclass(frozen=True, kw_only=True, eq=False)
class KernelMap:
    """Neighbours with a direction: what a convolution reads and where it writes.

    Attributes:
        neighbours: of the two levels, or of the one.
        is_transposed: False: fine to coarse (or the level to itself); True: coarse to fine.
    """

    neighbours: NeighbourTable
    is_transposed: bool = False

    @property
    def transposed(self) -> "KernelMap":
        """The way back: the map of the transposed convolution and of the input's gradient."""
        return KernelMap(neighbours=self.neighbours, is_transposed=not self.is_transposed)

    @property
    def volume(self) -> int:
        """Number of offsets of the kernel."""
        return len(self.neighbours.table)

    @property
    def centre(self) -> int | None:
        """Offset at which each voxel is its own neighbour, which the pairs leave out."""
        return self.neighbours.centre

    @property
    def most(self) -> int:
        """Pairs of the fullest offset."""
        return self.neighbours.pairs.most

    @property
    def outputs(self) -> int:
        """Number of voxels written."""
        return self.neighbours.fine_rows if self.is_transposed else self.neighbours.table.shape[1]

    @property
    def grid_in(self) -> Int64[Tensor, " slots"]:
        """Row that each slot of (volume, most) reads; one past the last where it is empty."""
        return self.neighbours.coarse_grid if self.is_transposed else self.neighbours.fine_grid

    def by_offset(self) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Give each filled offset with the rows that its pairs read, and those they add to."""
        pairs = self.neighbours.pairs
        # Lists of views, each from one call: slicing one by one costs as much as small products.
        fine, coarse = pairs.fine.split(pairs.counts), pairs.coarse.split(pairs.counts)
        rows_in, rows_out = (coarse, fine) if self.is_transposed else (fine, coarse)
        return zip(pairs.filled, rows_in, rows_out, strict=True)

    def sum_by_output(self, products: Tensor) -> Tensor:
        """Add up the slots of each output voxel, always in the same order.

        A gather, not a scatter: the same bits on every run, on CUDA too, and several times faster
        on the CPU than ``index_add_``.
        """
        order, starts = self.neighbours.by_fine if self.is_transposed else self.neighbours.by_coarse
        return torch.nn.functional.embedding_bag(order, products, starts, mode="sum")


def kernel_offsets(kernel: int) -> tuple[tuple[int, int, int], ...]:
    """Offsets (x, y, z) in the order of a weight's rows: x fastest, as in MinkowskiEngine."""
    first = -(kernel // 2) if kernel % 2 else 0
    steps = range(first, first + kernel)
    return tuple((x, y, z) for z in steps for y in steps for x in steps)


class CoordinateCache:
    """Sorted keys of every level, and the neighbours of every kernel that was used.

    Level ``l`` holds coordinates that are multiples of ``2**l``. A transposed convolution lands on
    the stored coordinates of the finer level, never on new ones.
    """

    def __init__(self, keys: Keys) -> None:
        """Begin with the sorted, distinct keys of level 0."""
        self._keys = {0: keys}
        self._indices: dict[int, VoxelIndex] = {}
        self._neighbours: dict[tuple[int, int, int], NeighbourTable] = {}

    def keys(self, level: int) -> Keys:
        """Give the sorted keys of a level."""
        if level not in self._keys:
            # A field holds c + HALF, which is not negative: clearing its low bits is a floor
            # division for negative coordinates too.
            low_bits = packed_move(2**level - 1, 2**level - 1, 2**level - 1)
            self._keys[level] = torch.unique(self.keys(level - 1) & ~low_bits)
        return self._keys[level]

    def coordinates(self, level: int) -> Tensor:
        """Give (cloud, x, y, z) of each voxel of a level, in voxels of level 0."""
        return unpack(self.keys(level))

    def kernel_map(
        self, level: int, kernel: int, stride: int = 1, *, is_transposed: bool = False
    ) -> KernelMap:
        """Find what a convolution reads and writes.

        Args:
            level: the level that it reads.
            kernel: its size: 1, 3, 5 or 7 (3 at most with stride 4); with a stride 2 and 4 too.
            stride: a power of two; with 1 it writes the level that it reads.
            is_transposed: True writes a finer level, False a coarser one.
        """
        assert stride & (stride - 1) == 0, f"stride must be a power of two, got {stride}"
        assert kernel % 2 or stride > 1, "an even kernel has no centre: it needs a stride"
        # A coarser voxel lies up to stride - 1 cells below the lowest finer one; an odd kernel
        # looks both ways from it, an even one forward alone.
        beyond = kernel // 2 + stride - 1 if kernel % 2 else max(kernel, stride) - 1
        assert beyond <= MARGIN, f"kernel {kernel} with stride {stride} looks {beyond} cells beyond"
        levels = stride.bit_length() - 1
        fine = level - levels if is_transposed else level
        assert fine >= 0, f"level {level} has no level {levels} finer"
        key = (fine, kernel, levels)
        if key not in self._neighbours:
            assert kernel * 2**fine <= REACH, f"kernel {kernel} at level {fine} reaches too far"
            if fine not in self._indices:
                self._indices[fine] = VoxelIndex(self.keys(fine), 2**fine)
            table = self._indices[fine].find(self.keys(fine + levels), kernel_offsets(kernel))
            centre = None if levels else kernel**3 // 2
            self._neighbours[key] = NeighbourTable(
                table=table, fine_rows=len(self.keys(fine)), centre=centre
            )
        return KernelMap(neighbours=self._neighbours[key], is_transposed=is_transposed)
