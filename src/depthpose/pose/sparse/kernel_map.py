"""Which input voxel meets which output voxel at which offset of a kernel."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Int32, Int64
from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class PairList:
    """Meetings of two levels, offset by offset.

    Attributes:
        fine: row of each pair in the finer level: where the kernel reads.
        coarse: row of each pair in the coarser level: where the kernel stands.
        offset: number of each pair's offset, ascending.
        filled: offsets that have pairs; nobody spends time on the others.
        counts: how many pairs each of them has.
    """

    fine: Int64[Tensor, " pairs"]
    coarse: Int64[Tensor, " pairs"]
    offset: Int64[Tensor, " pairs"]
    filled: tuple[int, ...]
    counts: tuple[int, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Meetings:
    """All meetings of a fine and a coarse level, or of a level with itself.

    Attributes:
        table: row of the fine voxel that each coarse one meets at each offset; -1: none.
        fine_rows: number of voxels of the finer level.
        centre: offset at which each voxel meets itself; None across levels.
    """

    table: Int32[Tensor, "volume coarse_rows"]
    fine_rows: int
    centre: int | None

    @cached_property
    def pairs(self) -> PairList:
        """The meetings listed, but for the centre: there input and output rows are the same."""
        is_pair = self.table >= 0
        if self.centre is not None:
            is_pair[self.centre] = False
        counts = is_pair.sum(1).tolist()
        filled = [number for number, count in enumerate(counts) if count]
        offset, coarse = is_pair.nonzero(as_tuple=True)
        fine = self.table.flatten().index_select(0, offset * self.table.shape[1] + coarse)
        return PairList(
            fine=fine.long(), coarse=coarse, offset=offset, filled=tuple(filled),
            counts=tuple(counts[number] for number in filled),
        )  # fmt: skip

    @cached_property
    def by_fine(self) -> tuple[Tensor, Tensor]:
        """Pairs grouped by fine row: their order, and where in it each row begins."""
        return _grouped(self.pairs.fine, self.pairs.offset, (self.fine_rows, len(self.table)))

    @cached_property
    def by_coarse(self) -> tuple[Tensor, Tensor]:
        """Pairs grouped by coarse row."""
        volume, rows = self.table.shape
        return _grouped(self.pairs.coarse, self.pairs.offset, (rows, volume))


@dataclass(frozen=True, kw_only=True, eq=False)
class KernelMap:
    """Meetings with a direction: what a convolution reads and where it writes.

    Attributes:
        meetings: of the two levels, or of the one.
        is_transposed: False: fine to coarse (or the level to itself); True: coarse to fine.
    """

    meetings: Meetings
    is_transposed: bool = False

    @property
    def transposed(self) -> "KernelMap":
        """The way back: the map of the transposed convolution and of the input's gradient."""
        return KernelMap(meetings=self.meetings, is_transposed=not self.is_transposed)

    @property
    def volume(self) -> int:
        """Number of offsets of the kernel."""
        return len(self.meetings.table)

    @property
    def centre(self) -> int | None:
        """Offset at which each voxel meets itself, which the pairs leave out."""
        return self.meetings.centre

    @property
    def filled(self) -> tuple[int, ...]:
        """Offsets that have pairs."""
        return self.meetings.pairs.filled

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of pairs of each of these offsets."""
        return self.meetings.pairs.counts

    @property
    def rows_in(self) -> Int64[Tensor, " pairs"]:
        """Row that each pair reads."""
        pairs = self.meetings.pairs
        return pairs.coarse if self.is_transposed else pairs.fine

    @property
    def rows_out(self) -> Int64[Tensor, " pairs"]:
        """Row that each pair adds to."""
        pairs = self.meetings.pairs
        return pairs.fine if self.is_transposed else pairs.coarse

    @property
    def outputs(self) -> int:
        """Number of voxels written."""
        return self.meetings.fine_rows if self.is_transposed else self.meetings.table.shape[1]

    def sum_by_output(self, products: Tensor) -> Tensor:
        """Add up the rows of each output voxel, always in the same order.

        A gather, not a scatter: the same bits on every run, on CUDA too, and several times faster
        on the CPU than ``index_add_``.
        """
        order, starts = self.meetings.by_fine if self.is_transposed else self.meetings.by_coarse
        return torch.nn.functional.embedding_bag(order, products, starts, mode="sum")


def kernel_offsets(kernel: int) -> tuple[tuple[int, int, int], ...]:
    """Offsets (x, y, z) in the order of a weight's rows: x fastest, as in MinkowskiEngine."""
    first = -(kernel // 2) if kernel % 2 else 0
    steps = range(first, first + kernel)
    return tuple((x, y, z) for z in steps for y in steps for x in steps)


def _grouped(rows: Tensor, offset: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Give the pairs in the order of their row, and where in that order each row begins.

    A row has at most one pair an offset, so a table of rows by offsets sorts in linear time.
    """
    table = torch.full(shape, -1, dtype=torch.int32, device=rows.device)
    numbers = torch.arange(len(rows), dtype=torch.int32, device=rows.device)
    table.view(-1)[rows * shape[1] + offset] = numbers
    is_pair = table >= 0
    counts = is_pair.sum(1)
    return table[is_pair].long(), counts.cumsum(0) - counts
