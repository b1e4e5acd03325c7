"""Which input voxel meets which output voxel at which offset of a kernel."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Int64
from torch import Tensor

from depthpose.pose.sparse.keys import Keys, packed_move

Segment = tuple[int, int, int]
"""Offset number, and the first and past-the-last pair that it has."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pairs:
    """All meetings of a fine and a coarse level (or of a level with itself), offset by offset.

    Offsets without a pair have no segment, so that nobody spends time on them.

    Attributes:
        fine: row of each pair in the finer level: where the kernel reads.
        coarse: row of each pair in the coarser level: where the kernel stands.
        offset: number of each pair's offset.
        segments: which pairs belong to which offset.
        centre: offset at which each voxel meets itself, left out of the pairs; None across levels.
        volume: number of offsets of the kernel.
        fine_rows: number of voxels of the finer level.
        coarse_rows: number of voxels of the coarser level.
    """

    fine: Int64[Tensor, " pairs"]
    coarse: Int64[Tensor, " pairs"]
    offset: Int64[Tensor, " pairs"]
    segments: tuple[Segment, ...]
    centre: int | None
    volume: int
    fine_rows: int
    coarse_rows: int

    @cached_property
    def by_fine(self) -> tuple[Tensor, Tensor]:
        """Pairs grouped by fine row, as :func:`_grouped` gives them."""
        return _grouped(self.fine, self.offset, self.fine_rows, self.volume)

    @cached_property
    def by_coarse(self) -> tuple[Tensor, Tensor]:
        """Pairs grouped by coarse row."""
        return _grouped(self.coarse, self.offset, self.coarse_rows, self.volume)


@dataclass(frozen=True, kw_only=True, eq=False)
class KernelMap:
    """Pairs with a direction: what a convolution reads and where it writes.

    Attributes:
        pairs: the meetings.
        is_transposed: False: fine to coarse (or the level to itself); True: coarse to fine.
    """

    pairs: Pairs
    is_transposed: bool = False

    @property
    def transposed(self) -> "KernelMap":
        """The way back: the map of the transposed convolution and of the input's gradient."""
        return KernelMap(pairs=self.pairs, is_transposed=not self.is_transposed)

    @property
    def rows_in(self) -> Int64[Tensor, " pairs"]:
        """Row that each pair reads."""
        return self.pairs.coarse if self.is_transposed else self.pairs.fine

    @property
    def rows_out(self) -> Int64[Tensor, " pairs"]:
        """Row that each pair adds to."""
        return self.pairs.fine if self.is_transposed else self.pairs.coarse

    @property
    def inputs(self) -> int:
        """Number of voxels read."""
        return self.pairs.coarse_rows if self.is_transposed else self.pairs.fine_rows

    @property
    def outputs(self) -> int:
        """Number of voxels written."""
        return self.pairs.fine_rows if self.is_transposed else self.pairs.coarse_rows

    def sum_by_output(self, products: Tensor) -> Tensor:
        """Add up the rows of each output voxel, always in the same order.

        A gather, not a scatter: the same bits on every run, on CUDA too, and several times faster
        on the CPU than ``index_add_``.
        """
        order, starts = self.pairs.by_fine if self.is_transposed else self.pairs.by_coarse
        return torch.nn.functional.embedding_bag(order, products, starts, mode="sum")


def kernel_offsets(kernel: int) -> tuple[tuple[int, int, int], ...]:
    """Offsets (x, y, z) in the order of a weight's rows: x fastest, as in MinkowskiEngine."""
    steps = _steps(kernel)
    return tuple((x, y, z) for z in steps for y in steps for x in steps)


def match_level(keys: Keys, kernel: int, step: int) -> Pairs:
    """Pair each voxel of a level with its neighbours; the kernel is odd.

    Half the offsets are searched; the other half are the same pairs the other way round.
    """
    columns = kernel * kernel // 2 + 1
    at, standing, reading = _search(keys, keys, kernel, step, columns)
    # The last column is the kernel's own axis: its upper half mirrors its lower one.
    is_new = (at % kernel**2 < columns - 1) | (at < kernel**3 // 2)
    at, standing, reading = at[is_new], standing[is_new], reading[is_new]
    mirrored = kernel**3 - 1 - at
    return _pairs(
        torch.cat([at, mirrored]),
        torch.cat([reading, standing]),
        torch.cat([standing, reading]),
        (kernel**3, len(keys), len(keys)),
        centre=kernel**3 // 2,
    )


def match_levels(fine: Keys, coarse: Keys, kernel: int, step: int) -> Pairs:
    """Pair each coarse voxel with the fine ones that its kernel reads, ``step`` apart."""
    at, standing, reading = _search(coarse, fine, kernel, step, kernel * kernel)
    return _pairs(at, reading, standing, (kernel**3, len(fine), len(coarse)), centre=None)


def _steps(kernel: int) -> range:
    first = -(kernel // 2) if kernel % 2 else 0
    return range(first, first + kernel)


def _search(
    standing: Keys, reading: Keys, kernel: int, step: int, columns: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Find pairs at the offsets of the first ``columns`` (x, y) of a kernel.

    z is the lowest field, so the voxels of a column are neighbours in sorted order: one binary
    search finds the first, and the next ones are read off.

    Returns:
        Offset number, standing row and reading row of each pair, sorted by offset.
    """
    steps = _steps(kernel)
    moves = [packed_move(x, y, steps[0]) * step for y in steps for x in steps][:columns]
    wanted = standing + torch.tensor(moves, device=standing.device)[:, None]
    rows = torch.searchsorted(reading, wanted)
    ended = torch.nn.functional.pad(reading, (0, 1), value=torch.iinfo(torch.int64).max)
    hits, found = [], []
    for _ in steps:
        hits.append(ended[rows] == wanted)
        found.append(rows)
        rows, wanted = rows + hits[-1], wanted + step
    is_pair = torch.stack(hits)
    level, column, row = is_pair.nonzero(as_tuple=True)
    return level * kernel**2 + column, row, torch.stack(found)[is_pair]


def _pairs(
    at: Tensor, fine: Tensor, coarse: Tensor, sizes: tuple[int, int, int], centre: int | None
) -> Pairs:
    volume, fine_rows, coarse_rows = sizes
    numbers, counts = (t.tolist() for t in torch.unique_consecutive(at, return_counts=True))
    segments, first = [], 0
    for number, count in zip(numbers, counts, strict=True):
        segments.append((number, first, first + count))
        first += count
    return Pairs(
        fine=fine, coarse=coarse, offset=at, segments=tuple(segments), centre=centre,
        volume=volume, fine_rows=fine_rows, coarse_rows=coarse_rows,
    )  # fmt: skip


def _grouped(rows: Tensor, offset: Tensor, count: int, volume: int) -> tuple[Tensor, Tensor]:
    """Give the pairs in the order of their row, and where in that order each row begins.

    A row has at most one pair an offset, so a table of rows by offsets sorts in linear time.
    """
    table = torch.full((count, volume), -1, dtype=torch.int64, device=rows.device)
    table[rows, offset] = torch.arange(len(rows), device=rows.device)
    is_pair = table >= 0
    counts = is_pair.sum(1)
    return table[is_pair], counts.cumsum(0) - counts
