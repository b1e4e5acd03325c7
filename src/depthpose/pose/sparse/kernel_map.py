"""Which input voxel is the neighbour of which output voxel at which offset of a kernel.

All levels and kernel maps of one set of voxels are made once (:class:`CoordinateCache`).
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Int32, Int64
from torch import Tensor

from depthpose.pose.sparse.keys import (
    MARGIN,
    REACH,
    Keys,
    VoxelIndex,
    coarsen,
    reach_beyond,
    unpack,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class PairList:
    """Neighbours of two levels, offset by offset.

    Attributes:
        fine: row of each pair in the finer level: where the kernel reads.
        coarse: row of each pair in the coarser level: where the kernel is centred.
        slot: place of each pair in a grid of (volume, most), where ``most`` is the largest count.
        filled: offsets that have pairs; the others are skipped.
        counts: how many pairs each of them has.
    """

    fine: Int64[Tensor, " pairs"]
    coarse: Int64[Tensor, " pairs"]
    slot: Int64[Tensor, " pairs"]
    filled: tuple[int, ...]
    counts: tuple[int, ...]

    @property
    def most(self) -> int:
        """Pairs of the fullest offset."""
        return max(self.counts, default=0)


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
        shifts = torch.arange(len(counts), device=counts.device) * max(numbers, default=0)
        lines = (shifts - counts.cumsum(0) + counts).index_select(0, offset)
        return PairList(
            fine=fine.long(), coarse=coarse, filled=filled,
            slot=lines + torch.arange(len(fine), device=fine.device),
            counts=tuple(numbers[offset] for offset in filled),
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
        return _grouped(self.pairs.fine, self.pairs.slot, self.fine_rows)

    @cached_property
    def by_coarse(self) -> tuple[Tensor, Tensor]:
        """Slots grouped by coarse row."""
        return _grouped(self.pairs.coarse, self.pairs.slot, self.table.shape[1])

    def _grid(self, rows: Tensor, nobody: int) -> Tensor:
        grid = rows.new_full((len(self.table) * self.pairs.most,), nobody)
        grid[self.pairs.slot] = rows
        return grid


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
    def filled(self) -> tuple[int, ...]:
        """Offsets that have pairs."""
        return self.neighbours.pairs.filled

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of pairs of each of these offsets."""
        return self.neighbours.pairs.counts

    @property
    def rows_in(self) -> Int64[Tensor, " pairs"]:
        """Row that each pair reads."""
        pairs = self.neighbours.pairs
        return pairs.coarse if self.is_transposed else pairs.fine

    @property
    def rows_out(self) -> Int64[Tensor, " pairs"]:
        """Row that each pair adds to."""
        pairs = self.neighbours.pairs
        return pairs.fine if self.is_transposed else pairs.coarse

    @property
    def outputs(self) -> int:
        """Number of voxels written."""
        return self.neighbours.fine_rows if self.is_transposed else self.neighbours.table.shape[1]

    @property
    def grid_in(self) -> Int64[Tensor, " slots"]:
        """Row that each slot of (volume, most) reads; one past the last where it is empty."""
        return self.neighbours.coarse_grid if self.is_transposed else self.neighbours.fine_grid

    @property
    def grid_out(self) -> Int64[Tensor, " slots"]:
        """Row that each slot adds to; one past the last where it is empty."""
        return self.neighbours.fine_grid if self.is_transposed else self.neighbours.coarse_grid

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


def _grouped(rows: Tensor, slot: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Give the slots in the order of their row, and where in that order each row begins."""
    counts = torch.bincount(rows, minlength=count)
    return slot[torch.argsort(rows, stable=True)], counts.cumsum(0) - counts


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
            self._keys[level] = coarsen(self.keys(level - 1), 2**level)
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
        reach = reach_beyond(kernel, stride)
        assert reach <= MARGIN, f"kernel {kernel} with stride {stride} looks {reach} cells beyond"
        levels = stride.bit_length() - 1
        fine = level - levels if is_transposed else level
        assert fine >= 0, f"level {level} has no level {levels} finer"
        key = (fine, kernel, levels)
        if key not in self._neighbours:
            self._neighbours[key] = self._find_neighbours(*key)
        return KernelMap(neighbours=self._neighbours[key], is_transposed=is_transposed)

    def _find_neighbours(self, fine: int, kernel: int, levels: int) -> NeighbourTable:
        assert kernel * 2**fine <= REACH, f"kernel {kernel} at level {fine} reaches too far"
        if fine not in self._indices:
            self._indices[fine] = VoxelIndex(self.keys(fine), 2**fine)
        table = self._indices[fine].find(self.keys(fine + levels), kernel_offsets(kernel))
        centre = None if levels else kernel**3 // 2
        return NeighbourTable(table=table, fine_rows=len(self.keys(fine)), centre=centre)
