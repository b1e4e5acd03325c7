"""Sparse convolution in torch operations, CPU and CUDA alike.

Conventions are MinkowskiEngine's (Choy et al., CVPR 2019), so that its published weights fit:
a coarser level holds ``floor(c / 2) * 2`` of the finer one's coordinates, the offsets of a kernel
run with x fastest, odd kernels are centred and even ones start at 0.

A key packs (cloud, x, y, z) so that sorting and searching are one-dimensional: 12 bits of the
cloud's number and 17 bits of each coordinate, z lowest. Adding a packed offset to a key gives the
key of the neighbour; coordinates keep a margin in their field, so that no addition carries into the
next field. All levels and kernel maps of one set of voxels are made once
(:class:`CoordinateCache`).

A convolution gathers, multiplies and adds up; its three methods differ in how much is gathered at
once.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Int32, Int64
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from depthpose.core.errors import InputError

FIELD_BITS = 17
HALF = 1 << (FIELD_BITS - 1)
REACH = 1 << 12  #: farthest that a kernel may look, in voxels of the finest level

COORDINATE_LIMIT = HALF - REACH  #: coordinates lie in [-COORDINATE_LIMIT, COORDINATE_LIMIT)

CLOUD_LIMIT = 1 << (63 - 3 * FIELD_BITS)  #: clouds that one batch can hold

AXES = (1 << 2 * FIELD_BITS, 1 << FIELD_BITS, 1)  #: added to a key, moves it by one along x, y or z

Keys = Int64[Tensor, " _"]


def pack(coordinates: Int[Tensor, "n 4"]) -> Keys:
    """Pack rows of (cloud, x, y, z) into keys."""
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
    cloud, x, y, z = coordinates.long().unbind(1)
    return (((cloud << FIELD_BITS | x + HALF) << FIELD_BITS | y + HALF) << FIELD_BITS) | z + HALF


def unpack(keys: Keys) -> Int64[Tensor, "n 4"]:
    """Unpack keys to rows of (cloud, x, y, z)."""
    field_mask = (1 << FIELD_BITS) - 1
    x, y, z = ((keys >> shift * FIELD_BITS & field_mask) - HALF for shift in (2, 1, 0))
    return torch.stack([keys >> 3 * FIELD_BITS, x, y, z], 1)


Moves = tuple[tuple[int, int, int], ...]

MARGIN = 4
"""Cells about the box: as far as a kernel may reach beyond it. With fewer, a neighbour past the end
of a row would be looked up in the next row."""

MAX_CELLS = 1 << 24
CELLS_PER_VOXEL = 512  #: a box with more cells is mostly empty: binary search is then cheaper


class VoxelIndex:
    """Finds rows of one level's voxels by their keys.

    By a table of all cells of the clouds' common box where that is small enough, which is some five
    times as fast as binary search; else by binary search.
    """

    def __init__(self, keys: Keys, step: int) -> None:
        """Index the sorted keys of a level whose voxels lie ``step`` apart."""
        self._keys = keys
        self._step = step
        self._low = self._strides = keys.new_zeros(4)
        self._table: Tensor | None = None
        if not len(keys):
            return

        # The box about all voxels with a margin, if it is not too large.
        coordinates = unpack(keys)
        coordinates[:, 1:] >>= step.bit_length() - 1
        low = coordinates.amin(0)
        high = coordinates.amax(0)
        sides = (high - low + 1).tolist()
        sides[1:] = [side + 2 * MARGIN for side in sides[1:]]
        cells = sides[0] * sides[1] * sides[2] * sides[3]
        if cells > min(MAX_CELLS, CELLS_PER_VOXEL * len(coordinates) + MAX_CELLS // 256):
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

    def find(self, keys: Keys, moves: Moves) -> Int32[Tensor, "moves keys"]:
        """Find the row of each voxel at ``key + move * step``.

        Where there is no such voxel it is one past the last row, for which callers add a row of
        zeros.
        """
        if not len(self._keys):
            return keys.new_zeros(len(moves), len(keys), dtype=torch.int32)
        offsets = torch.tensor(moves, device=keys.device)

        # By binary search.
        if self._table is None:
            packed = (offsets * self._step * offsets.new_tensor(AXES)).sum(-1)
            neighbours = keys + packed[:, None]
            rows = torch.searchsorted(self._keys, neighbours).clamp_(max=len(self._keys) - 1)
            return torch.where(self._keys[rows] == neighbours, rows, len(self._keys)).int()

        # By the table.
        coordinates = unpack(keys)
        coordinates[:, 1:] >>= self._step.bit_length() - 1
        cells = ((coordinates - self._low) * self._strides).sum(1)
        neighbours = (offsets * self._strides[1:]).sum(-1)[:, None] + cells
        return self._table.index_select(0, neighbours.flatten()).view(neighbours.shape)


@dataclass(frozen=True, kw_only=True, eq=False)
class PairList:
    """Neighbours of two levels, offset by offset."""

    fine: Int64[Tensor, " pairs"]  #: row of each pair in the finer level: where the kernel reads
    coarse: Int64[Tensor, " pairs"]  #: row of each pair in the coarser level: the kernel's centre
    slot: Int64[Tensor, " pairs"]  #: place of each pair in a grid of (volume, most)
    filled: tuple[int, ...]  #: offsets that have pairs; the others are skipped
    counts: tuple[int, ...]  #: how many pairs each of them has
    most: int  #: the largest of these counts


class Slots(NamedTuple):
    """Pairs in a grid of (volume, most), for one direction of a convolution."""

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

        # The pairs of an offset fill its line of the grid from the left.
        most = max(numbers, default=0)
        shifts = torch.arange(len(counts), device=counts.device) * most
        lines = (shifts - counts.cumsum(0) + counts).index_select(0, offset)
        return PairList(
            fine=fine.long(), coarse=coarse, filled=filled,
            slot=lines + torch.arange(len(fine), device=fine.device),
            counts=tuple(numbers[offset] for offset in filled), most=most,
        )  # fmt: skip

    def slots(self, *, is_transposed: bool) -> Slots:
        """Arrange the pairs in a grid; ``is_transposed`` is from coarse rows to fine ones."""
        if is_transposed not in self._slots:
            pairs = self.pairs
            read = pairs.fine
            inputs = self.fine_rows
            written = pairs.coarse
            outputs = self.table.shape[1]
            if is_transposed:
                read, inputs, written, outputs = written, outputs, read, inputs
            # Empty slots read one past the last row.
            grid = read.new_full((len(self.table) * pairs.most,), inputs)
            grid[pairs.slot] = read
            # Filled slots by the row that they add to.
            order = pairs.slot[torch.argsort(written, stable=True)]
            counts = torch.bincount(written, minlength=outputs)
            self._slots[is_transposed] = Slots(grid, order, counts.cumsum(0) - counts)
        return self._slots[is_transposed]


@dataclass(frozen=True, kw_only=True, eq=False)
class KernelMap:
    """Neighbours with a direction: the rows that a convolution reads and those that it writes."""

    neighbours: NeighbourTable  #: of the two levels, or of the one
    is_transposed: bool = False  #: False: fine to coarse (or the level to itself); True: back

    def by_offset(self) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Give each offset that has pairs, the rows that these read, and those that they add to."""
        pairs = self.neighbours.pairs
        # Lists of views, each from one call: slicing one by one costs as much as small products.
        fine = pairs.fine.split(pairs.counts)
        coarse = pairs.coarse.split(pairs.counts)
        rows_in, rows_out = (coarse, fine) if self.is_transposed else (fine, coarse)
        return zip(pairs.filled, rows_in, rows_out, strict=True)


def kernel_offsets(kernel: int) -> tuple[tuple[int, int, int], ...]:
    """List offsets (x, y, z) in the order of a weight's rows: x fastest, as in MinkowskiEngine."""
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
    _indices: dict[int, VoxelIndex] = field(
        default_factory=dict
    )  #: of the levels that were searched
    #: by (finer level, kernel, levels between).
    _neighbours: dict[tuple[int, int, int], NeighbourTable] = field(default_factory=dict)

    def keys(self, level: int) -> Keys:
        """Give the sorted keys of a level."""
        if level == 0:
            return self.finest
        if level not in self._coarser:
            # A field holds c + HALF, which is not negative: clearing its low bits is a floor
            # division for negative coordinates too.
            low_bits = (2**level - 1) * sum(AXES)
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
            is_transposed: True writes a finer level, False a coarser one.
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
            table = self._indices[fine].find(self.keys(fine + levels), kernel_offsets(kernel))
            centre = None if levels else kernel**3 // 2
            self._neighbours[key] = NeighbourTable(
                table=table, fine_rows=len(self.keys(fine)), centre=centre
            )
        return KernelMap(neighbours=self._neighbours[key], is_transposed=is_transposed)


GRID_PRODUCTS = 1 << 20
"""Where the offset with the most pairs takes up to this many multiplications, all offsets are one
batched product, padded: up to twice as fast. Beyond, padding costs more than fewer calls save
(measured by bench/sparse_speed.py)."""

GRID_ELEMENTS = 1 << 29
"""Largest padded table on a GPU, where the calls cost more than the padding: a training step of 128
clouds takes 101 ms with it, one of only 64 clouds offset by offset 169 ms (H200)."""

NARROW = 4  #: channels up to which inputs are gathered as a table: products are too thin else

TABLE_ELEMENTS = 1 << 25  #: largest such table


def conv(
    features: Float[Tensor, "rows_in c_in"],
    weight: Float[Tensor, "volume c_in c_out"],
    kernel_map: KernelMap,
) -> Float[Tensor, "rows_out c_out"]:
    """Convolve features: ``out[o] = sum over pairs (i, k) of o of features[i] @ weight[k]``.

    The same bits on every run on the CPU; on CUDA too under
    ``torch.use_deterministic_algorithms(True)``. Autocast is followed. Gradients once, not twice.
    """
    device = features.device.type
    if torch.is_autocast_enabled(device):
        narrower = torch.get_autocast_dtype(device)
        features = features.to(narrower)
        weight = weight.to(narrower)
    return _Convolution.apply(features, weight, kernel_map)


class _Convolution(torch.autograd.Function):
    """Saves the features and the weight alone: what is gathered is gathered again."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:  # noqa: ANN401
        """Convolve, and save what the gradients need."""
        ctx.save_for_backward(features, weight)
        ctx.kernel_map = kernel_map
        return _convolve(features, weight, kernel_map)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        gradient: Tensor,
    ) -> tuple[Tensor | None, Tensor | None, None]:
        """Give the gradients of the features and of the weight, where they are wanted.

        With the pairs (i, o) of offset k, the gradient g and the features x, as rows: ``dx_i = sum
        over pairs of i of g_o @ W_k^T``, a convolution back, and ``dW_k = sum over pairs of k of
        x_i^T @ g_o``. The latter by the method of the way forward.
        """
        x, weight = ctx.saved_tensors
        kernel_map: KernelMap = ctx.kernel_map
        gradient = gradient.contiguous()
        wants_x, wants_weight, _ = ctx.needs_input_grad

        # The gradient of the features: seldom wanted of the first layer's input, which is no
        # parameter's child.
        back = KernelMap(
            neighbours=kernel_map.neighbours, is_transposed=not kernel_map.is_transposed
        )
        for_x = _convolve(gradient, weight.mT, back) if wants_x else None
        if not wants_weight:
            return for_x, None, None

        # The gradient of the weight.
        method = _choose_method(x, weight, kernel_map)
        if method == "table":  # all inputs of each output: one product for all offsets
            return for_x, (_gather_table(x, kernel_map) @ gradient).view(weight.shape), None
        if method == "grid":  # x_i and g_o of each pair in the same slot: one batched product
            for_weight = torch.bmm(_gather_slots(x, kernel_map).mT, _gather_slots(gradient, back))
        else:  # a product for each offset, of its pairs alone
            for_weight = torch.zeros_like(weight)
            for offset, read, write in kernel_map.by_offset():
                gradient_of_pairs = gradient.index_select(0, write)
                torch.mm(x.index_select(0, read).T, gradient_of_pairs, out=for_weight[offset])
        # The pairs leave out the centre, where i = o for each row: nothing need be gathered for it.
        # The table has it.
        if (centre := kernel_map.neighbours.centre) is not None:
            torch.mm(x.T, gradient, out=for_weight[centre])
        return for_x, for_weight, None


def _convolve(x: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:
    """Convolve features by the fastest method for their size; see :func:`_choose_method`."""
    method = _choose_method(x, weight, kernel_map)
    near = kernel_map.neighbours
    if method == "table":
        return _gather_table(x, kernel_map).T @ weight.flatten(0, 1)
    if method == "grid":  # all offsets at once, padded to the one with the most pairs
        products = torch.bmm(_gather_slots(x, kernel_map), weight).flatten(0, 1)
        # The slots of an output are gathered, not scattered: the same bits on every run, on CUDA
        # too, and several times faster on the CPU than ``index_add_``.
        slots = near.slots(is_transposed=kernel_map.is_transposed)
        out = F.embedding_bag(slots.order, products, slots.starts, mode="sum")
    else:  # an offset at a time: its pairs write each row once at most
        written = near.fine_rows if kernel_map.is_transposed else near.table.shape[1]
        out = x.new_zeros(written, weight.shape[2])
        kernels = weight.unbind()
        for offset, read, write in kernel_map.by_offset():
            out.index_add_(0, write, x.index_select(0, read) @ kernels[offset])
    # Pairs leave out the voxel itself, which the table has.
    return out if near.centre is None else out.addmm_(x, weight[near.centre])


def _gather_slots(x: Tensor, kernel_map: KernelMap) -> Tensor:
    """Gather the input row of each pair into a padded grid (volume, most, channels).

    ``most`` is the number of pairs of the fullest offset; empty slots are zero.
    """
    near = kernel_map.neighbours
    padded = F.pad(x, (0, 0, 0, 1))
    read = padded.index_select(0, near.slots(is_transposed=kernel_map.is_transposed).read)
    return read.view(len(near.table), near.pairs.most, x.shape[1])


def _gather_table(x: Tensor, kernel_map: KernelMap) -> Tensor:
    """Gather the inputs of each output voxel (volume * channels, outputs); 0 for no neighbour."""
    padded = F.pad(x, (0, 0, 0, 1))
    rows = kernel_map.neighbours.table
    read = padded.index_select(0, rows.flatten()).view(*rows.shape, x.shape[1])
    return read.transpose(1, 2).reshape(len(rows) * x.shape[1], rows.shape[1])


def _choose_method(
    x: Tensor, weight: Tensor, kernel_map: KernelMap
) -> Literal["table", "grid", "offset by offset"]:
    """Choose how much is gathered at once: all inputs, the padded pairs, or those of one offset."""
    table = kernel_map.neighbours.table
    channels = x.shape[1]
    is_small = channels <= NARROW and table.numel() * channels <= TABLE_ELEMENTS
    if is_small and not kernel_map.is_transposed:
        return "table"
    most = kernel_map.neighbours.pairs.most
    is_gridded = most * weight[0].numel() <= GRID_PRODUCTS
    if x.is_cuda:
        # CUDA adds up offset by offset in no fixed order, so only a grid is the same on each run.
        is_fixed = torch.are_deterministic_algorithms_enabled()
        is_gridded = is_fixed or len(table) * most * max(weight.shape[1:]) <= GRID_ELEMENTS
    return "grid" if is_gridded else "offset by offset"


@dataclass(frozen=True, kw_only=True, eq=False)
class Voxels:
    """Features of the voxels of one level, of one or several clouds.

    Rows are in the order of the level's sorted keys, so the order in which points were given
    changes no bit of any result; :meth:`at_points` answers in the order given.
    """

    features: Float[Tensor, "n c"]  #: one row a voxel
    cache: CoordinateCache  #: coordinates of all levels, and the kernel maps among them
    level: int = 0  #: coordinates here are multiples of ``2**level``
    row_of_point: Int64[Tensor, " points"]  #: row at level 0 of each point given

    @classmethod
    def from_points(
        cls, coordinates: Int[Tensor, "points 4"], features: Float[Tensor, "points c"] | None = None
    ) -> "Voxels":
        """Make voxels from rows of (cloud, x, y, z).

        Args:
            coordinates: integers; clouds are numbered from 0, x, y, z may be negative.
            features: of each point; None: the number 1.

        Raises:
            InputError: coordinates out of range, or two points in one voxel.
        """
        if features is None:
            features = torch.ones(len(coordinates), 1, device=coordinates.device)
        keys_of_points = pack(coordinates)
        keys, row_of_point, counts = torch.unique(
            keys_of_points, return_inverse=True, return_counts=True
        )
        repeated = counts > 1
        if bool(repeated.any()):
            cloud, *xyz = unpack(keys[repeated][:1])[0].tolist()
            raise InputError(
                f"{int((counts - 1).sum())} points share a voxel with another, the first at {xyz} "
                f"of cloud {cloud}; keep one point a voxel."
            )
        features = features[torch.argsort(keys_of_points)]
        return cls(features=features, cache=CoordinateCache(keys), row_of_point=row_of_point)

    def with_features(self, features: Float[Tensor, "m c2"], level: int | None = None) -> "Voxels":
        """Give other features of the same level, or of another one of the same voxels."""
        level = self.level if level is None else level
        assert len(features) == len(self.cache.keys(level)), "features and voxels differ in number"
        return Voxels(
            features=features, cache=self.cache, level=level, row_of_point=self.row_of_point
        )

    def at_points(self) -> Float[Tensor, "points c"]:
        """Give the features of the voxel of each point, in the order in which points were given."""
        assert self.level == 0, f"points lie in voxels of level 0, these are of level {self.level}"
        return self.features[self.row_of_point]


class RowNorm(nn.BatchNorm1d):
    """Batch norm over rows (voxels, points, clouds), which takes a single one.

    One row has no variance; torch refuses it in training. Its running statistics serve instead.
    """

    def forward(self, input: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """Normalise each channel over all rows."""
        if len(input) > 1:
            return super().forward(input)
        statistics = (self.running_mean, self.running_var)
        return F.batch_norm(input, *statistics, self.weight, self.bias, eps=self.eps)


class SparseConv(nn.Module):
    """Convolution on voxels; with a stride it writes the coarser level.

    ``weight`` is (kernel^3, inputs, outputs), its rows in the order of ``kernel_offsets``.
    """

    is_transposed = False

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1, *, has_bias: bool = False
    ) -> None:
        super().__init__()
        self.kernel = kernel
        self.stride = stride
        self.weight = nn.Parameter(torch.empty(kernel**3, inputs, outputs))
        self.bias = nn.Parameter(torch.zeros(outputs)) if has_bias else None
        # Voxels of a surface fill about 1.5 k^2 of a kernel's k^3 cells (counted: 13 to 14 of 27).
        # Where it is transposed, each coarse voxel feeds about 4 fine ones.
        taps = 1.5 * kernel**2 if kernel > 1 else 1.0
        taps = max(1.0, taps / stride**2) if self.is_transposed else taps
        nn.init.normal_(self.weight, std=(2 / (taps * inputs)) ** 0.5)

    def forward(self, voxels: Voxels) -> Voxels:
        """Convolve voxels; with a stride the answer is of another level."""
        level = voxels.level
        if self.kernel == 1 and self.stride == 1:
            features = voxels.features @ self.weight[0]
        else:
            kernel_map = voxels.cache.kernel_map(
                level, self.kernel, self.stride, is_transposed=self.is_transposed
            )
            features = conv(voxels.features, self.weight, kernel_map)
            levels = self.stride.bit_length() - 1
            level += -levels if self.is_transposed else levels
        return voxels.with_features(features if self.bias is None else features + self.bias, level)


class SparseConvTranspose(SparseConv):
    """Transposed convolution: back onto the stored voxels of the finer level."""

    is_transposed = True
