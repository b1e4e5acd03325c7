"""Sparse convolution in torch operations, CPU and CUDA alike, and layers made of it.

Features are convolved on the voxels that a :mod:`~depthpose.pose.networks.kernel_map` relates. A
convolution gathers, multiplies and adds up; its three methods differ in how much is gathered at
once.
"""

from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Int64
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from depthpose.core.errors import InputError
from depthpose.pose.networks.kernel_map import CoordinateCache, KernelMap, pack, unpack

GRID_PRODUCTS = 1 << 20
"""Most multiplications of the offset with the most pairs for which all offsets are one batched
product, padded: up to twice as fast. Beyond, padding costs more than fewer calls save (measured by
bench/sparse_speed.py)."""
GRID_ELEMENTS = 1 << 29
"""Most elements of the padded grid on a GPU, where calls cost more than the padding: a training
step of 128 clouds takes 101 ms with it, one of only 64 clouds offset by offset 169 ms (H200)."""
NARROW = 4  #: most channels of inputs that are gathered as a table: products are too thin else
TABLE_ELEMENTS = 1 << 25  #: most elements of such a table


def convolve(
    features: Float[Tensor, "rows_in c_in"],
    weight: Float[Tensor, "volume c_in c_out"],
    kernel_map: KernelMap,
) -> Float[Tensor, "rows_out c_out"]:
    """Convolve features: ``out[o] = sum over pairs (i, k) of o of features[i] @ weight[k]``.

    Results are the same to the bit on every run on the CPU; on CUDA too under
    ``torch.use_deterministic_algorithms(True)``. Autocast is followed. There are first derivatives,
    no second ones.

    Args:
        features: a row for each voxel that is read.
        weight: a matrix for each offset of the kernel, of which there are ``volume``.
        kernel_map: which voxels are neighbours.
    """
    device = features.device.type
    if torch.is_autocast_enabled(device):
        narrower = torch.get_autocast_dtype(device)
        features = features.to(narrower)
        weight = weight.to(narrower)
    return _Convolution.apply(features, weight, kernel_map)


class _Convolution(torch.autograd.Function):
    """:func:`convolve` for autograd, which saves no more than the features and the weight."""

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
        """Compute the gradients of the features and of the weight, where they are wanted.

        With the pairs (i, o) of offset k, the gradient g and the features x, as rows: ``dx_i = sum
        over pairs of i of g_o @ W_k^T``, a convolution back, and ``dW_k = sum over pairs of k of
        x_i^T @ g_o``.
        """
        x, weight = ctx.saved_tensors
        kernel_map: KernelMap = ctx.kernel_map
        gradient = gradient.contiguous()
        wants_x, wants_weight, _ = ctx.needs_input_grad

        # The gradient of the features: not wanted in the first layer, since no parameter lies
        # before its input.
        back = KernelMap(
            neighbours=kernel_map.neighbours, is_transposed=not kernel_map.is_transposed
        )
        for_x = _convolve(gradient, weight.mT, back) if wants_x else None
        if not wants_weight:
            return for_x, None, None
        return for_x, _differentiate_weight(x, weight, gradient, kernel_map), None


def _differentiate_weight(
    x: Tensor, weight: Tensor, gradient: Tensor, kernel_map: KernelMap
) -> Tensor:
    """Compute the gradient of the weight, by the method that convolved.

    Args:
        x: features that were convolved.
        weight: of the kernel.
        gradient: of the output.
        kernel_map: of the convolution.
    """
    method = _choose_method(x, weight, kernel_map)
    if method == "table":  # all inputs of each output: one product for all offsets
        return (_gather_table(x, kernel_map) @ gradient).view(weight.shape)
    if method == "grid":  # x_i and g_o of each pair in the same slot: one batched product
        back = KernelMap(
            neighbours=kernel_map.neighbours, is_transposed=not kernel_map.is_transposed
        )
        for_weight = torch.bmm(_gather_slots(x, kernel_map).mT, _gather_slots(gradient, back))
    else:  # a product for each offset, of its pairs alone
        for_weight = torch.zeros_like(weight)
        for offset, read, written in kernel_map.by_offset():
            gradient_of_pairs = gradient.index_select(0, written)
            torch.mm(x.index_select(0, read).T, gradient_of_pairs, out=for_weight[offset])
    # Pairs leave out the centre, where i = o for each row: nothing is gathered for it.
    centre = kernel_map.neighbours.centre
    if centre is not None:
        torch.mm(x.T, gradient, out=for_weight[centre])
    return for_weight


def _convolve(x: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:
    """Convolve features by the fastest method for their size; see :func:`_choose_method`."""
    method = _choose_method(x, weight, kernel_map)
    neighbours = kernel_map.neighbours
    if method == "table":  # the centre, too
        return _gather_table(x, kernel_map).T @ weight.flatten(0, 1)
    if method == "grid":  # all offsets at once, padded to the one with the most pairs
        products = torch.bmm(_gather_slots(x, kernel_map), weight).flatten(0, 1)
        # The slots of an output are gathered, not scattered: the same bits on every run, on CUDA
        # too, and several times faster on the CPU than ``index_add_``.
        slots = neighbours.slots(is_transposed=kernel_map.is_transposed)
        out = F.embedding_bag(slots.order, products, slots.starts, mode="sum")
    else:  # an offset at a time: its pairs write each row once at most
        coarse_rows = neighbours.table.shape[1]
        rows_out = neighbours.fine_rows if kernel_map.is_transposed else coarse_rows
        out = x.new_zeros(rows_out, weight.shape[2])
        kernels = weight.unbind()
        for offset, read, written in kernel_map.by_offset():
            out.index_add_(0, written, x.index_select(0, read) @ kernels[offset])
    # Pairs leave out the centre, where each voxel reads itself.
    return out if neighbours.centre is None else out.addmm_(x, weight[neighbours.centre])


def _gather_slots(x: Tensor, kernel_map: KernelMap) -> Tensor:
    """Gather the input row of each pair into a padded grid (volume, most, channels).

    ``most`` is the number of pairs of the fullest offset; empty slots are zero.
    """
    neighbours = kernel_map.neighbours
    slots = neighbours.slots(is_transposed=kernel_map.is_transposed)
    padded = F.pad(x, (0, 0, 0, 1))
    gathered = padded.index_select(0, slots.read)
    return gathered.view(len(neighbours.table), neighbours.pairs.most, x.shape[1])


def _gather_table(x: Tensor, kernel_map: KernelMap) -> Tensor:
    """Gather the inputs of each output voxel (volume * channels, outputs); 0 for no neighbour."""
    padded = F.pad(x, (0, 0, 0, 1))
    table = kernel_map.neighbours.table
    gathered = padded.index_select(0, table.flatten()).view(*table.shape, x.shape[1])
    return gathered.transpose(1, 2).reshape(len(table) * x.shape[1], table.shape[1])


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

    Rows are in the order of the level's sorted keys, so the order of the points changes no bit of
    any result; :meth:`at_points` returns to that order.
    """

    features: Float[Tensor, "n c"]  #: one row a voxel
    cache: CoordinateCache  #: coordinates of all levels, and the kernel maps among them
    level: int = 0  #: coordinates here are multiples of ``2**level``
    row_of_point: Int64[Tensor, " points"]  #: row at level 0 of the voxel of each point

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
        """Return the same voxels with other features, of the same level or of ``level``."""
        level = self.level if level is None else level
        assert len(features) == len(self.cache.keys(level)), "features and voxels differ in number"
        return Voxels(
            features=features, cache=self.cache, level=level, row_of_point=self.row_of_point
        )

    def at_points(self) -> Float[Tensor, "points c"]:
        """Return the features of the voxel of each point, in the order of the points."""
        assert self.level == 0, f"points lie in voxels of level 0, these are of level {self.level}"
        return self.features[self.row_of_point]


class RowNorm(nn.BatchNorm1d):
    """Batch norm over rows (voxels, points, clouds), also of a single row.

    One row has no variance, and torch refuses it in training: the running statistics are used.
    """

    def forward(self, input: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """Normalise each channel over all rows."""
        if len(input) > 1:
            return super().forward(input)
        statistics = (self.running_mean, self.running_var)
        return F.batch_norm(input, *statistics, self.weight, self.bias, eps=self.eps)


class SparseConv(nn.Module):
    """Convolution on voxels; with a stride it writes the coarser level.

    ``weight`` is (kernel^3, inputs, outputs), its rows in the order of ``list_offsets``.
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
        # He initialisation, by the number of inputs that an output sums. Voxels of a surface fill
        # about 1.5 k^2 of a kernel's k^3 cells (counted: 13 to 14 of 27). Where it is transposed,
        # an output reads coarser voxels, of which a surface has 1 / stride^2 as many.
        neighbour_count = 1.5 * kernel**2 if kernel > 1 else 1.0
        if self.is_transposed:
            neighbour_count = max(1.0, neighbour_count / stride**2)
        nn.init.normal_(self.weight, std=(2 / (neighbour_count * inputs)) ** 0.5)

    def forward(self, voxels: Voxels) -> Voxels:
        """Convolve the features; with a stride the result is of another level."""
        level = voxels.level
        if self.kernel == 1 and self.stride == 1:
            features = voxels.features @ self.weight[0]
        else:
            kernel_map = voxels.cache.kernel_map(
                level, self.kernel, self.stride, is_transposed=self.is_transposed
            )
            features = convolve(voxels.features, self.weight, kernel_map)
            levels = self.stride.bit_length() - 1
            level += -levels if self.is_transposed else levels
        return voxels.with_features(features if self.bias is None else features + self.bias, level)


class SparseConvTranspose(SparseConv):
    """Transposed convolution: back onto the stored voxels of the finer level."""

    is_transposed = True
