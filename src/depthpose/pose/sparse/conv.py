"""The sparse convolution, ``conv(features, weight, kernel_map)``, and as a module on voxels.

Every way of computing it is gather, multiply, add up; the ways differ in how much is gathered at
once. Without gradients small ones go through a compiled loop, where numba is installed.
"""

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Int64
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from depthpose.core.errors import InputError
from depthpose.pose.compiled import serves
from depthpose.pose.sparse.kernel_map import CoordinateCache, KernelMap, pack, unpack

GRID_PRODUCTS = 1 << 20
"""Where the fullest offset takes up to this many multiplications, all offsets are one batched
product, padded: up to twice as fast. Beyond, padding costs what fewer calls save: offset by offset
(measured by bench/sparse_speed.py)."""

GRID_ELEMENTS = 1 << 29
"""Largest padded table on a GPU, where the calls cost more than the padding: a training step of 128
clouds takes 101 ms with it, one of only 64 clouds offset by offset 169 ms (H200)."""

NARROW = 4
"""Inputs of up to this many channels are laid out as a table: their products are too thin."""

TABLE_ELEMENTS = 1 << 25
"""Largest such table."""


COMPILED_ELEMENTS = 1 << 17
"""Up to so many offsets times outputs the compiled loop, which has no gradient, is the faster."""


def conv(
    features: Float[Tensor, "rows_in c_in"],
    weight: Float[Tensor, "volume c_in c_out"],
    kernel_map: KernelMap,
) -> Float[Tensor, "rows_out c_out"]:
    """Convolve: ``out[o] = sum over pairs (i, k) of o of features[i] @ weight[k]``.

    The same bits on every run on the CPU; on CUDA too under
    ``torch.use_deterministic_algorithms(True)``. Autocast is followed. Gradients once, not twice.
    """
    device = features.device.type
    if torch.is_autocast_enabled(device):
        narrower = torch.get_autocast_dtype(device)
        features, weight = features.to(narrower), weight.to(narrower)
    is_plain = features.dtype == weight.dtype == torch.float32
    near = kernel_map.neighbours
    if is_plain and serves(features, weight) and near.table.numel() <= COMPILED_ELEMENTS:
        from depthpose.pose.compiled.convolve import convolved

        return convolved(features, weight, near.table, near.fine_rows, kernel_map.is_transposed)
    return _Convolution.apply(features, weight, kernel_map)


class _Convolution(torch.autograd.Function):
    """Saves the features and the weight alone: what is gathered is gathered again."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:  # noqa: ANN401
        ctx.save_for_backward(features, weight)
        ctx.kernel_map = kernel_map
        return _convolve(features, weight, kernel_map)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        gradient: Tensor,
    ) -> tuple[Tensor | None, Tensor | None, None]:
        x, weight = ctx.saved_tensors
        m: KernelMap = ctx.kernel_map
        gradient = gradient.contiguous()
        wants_x, wants_weight, _ = ctx.needs_input_grad
        # The first layer's input is no parameter's child: its gradient is seldom wanted.
        for_x = _convolve(gradient, weight.mT, m.transposed) if wants_x else None
        if not wants_weight:
            return for_x, None, None
        if _is_narrow(x, m):
            return for_x, (_table(x, m) @ gradient).view(weight.shape), None
        if _is_gridded(x, weight, m):
            found = torch.bmm(_read(x, m).mT, _read(gradient, m.transposed))
        else:
            found = torch.zeros_like(weight)
            for offset, read, write in m.by_offset():
                pulls = gradient.index_select(0, write)
                torch.mm(x.index_select(0, read).T, pulls, out=found[offset])
        if m.centre is not None:
            torch.mm(x.T, gradient, out=found[m.centre])
        return for_x, found, None


def _convolve(x: Tensor, weight: Tensor, m: KernelMap) -> Tensor:
    if _is_narrow(x, m):
        return _table(x, m).T @ weight.flatten(0, 1)
    if _is_gridded(x, weight, m):  # all offsets in one operation each, padded to the fullest
        out = m.sum_by_output(torch.bmm(_read(x, m), weight).flatten(0, 1))
    else:  # an offset at a time: its pairs write each row once at most
        out, kernels = x.new_zeros(m.outputs, weight.shape[2]), weight.unbind()
        for offset, read, write in m.by_offset():
            out.index_add_(0, write, x.index_select(0, read) @ kernels[offset])
    return out if m.centre is None else out.addmm_(x, weight[m.centre])


def _read(x: Tensor, m: KernelMap) -> Tensor:
    """Gather the slots of (volume, most); empty ones read a row of zeros."""
    padded = F.pad(x, (0, 0, 0, 1))
    return padded.index_select(0, m.grid_in).view(m.volume, m.most, x.shape[1])


def _table(x: Tensor, m: KernelMap) -> Tensor:
    """Lay out what each output voxel reads: (volume * channels, outputs), 0 where it is empty."""
    padded = F.pad(x, (0, 0, 0, 1))
    rows = m.neighbours.table
    read = padded.index_select(0, rows.flatten()).view(*rows.shape, x.shape[1])
    return read.transpose(1, 2).reshape(m.volume * x.shape[1], m.outputs)


def _is_narrow(x: Tensor, m: KernelMap) -> bool:
    channels = x.shape[1]
    elements = m.outputs * m.volume * channels
    return not m.is_transposed and channels <= NARROW and elements <= TABLE_ELEMENTS


def _is_gridded(x: Tensor, weight: Tensor, m: KernelMap) -> bool:
    if x.is_cuda:
        # CUDA adds up offset by offset in no fixed order, so only a grid is the same on each run.
        is_fixed = torch.are_deterministic_algorithms_enabled()
        return is_fixed or m.volume * m.most * max(weight.shape[1:]) <= GRID_ELEMENTS
    return m.most * weight[0].numel() <= GRID_PRODUCTS


@dataclass(frozen=True, kw_only=True, eq=False)
class Voxels:
    """Features of the voxels of one level, of one or several clouds.

    Rows are in the order of the level's sorted keys, so the order in which points were given
    changes no bit of any result; :meth:`at_points` answers in the order given.

    Attributes:
        features: one row a voxel.
        cache: coordinates of all levels, and the kernel maps among them.
        level: coordinates here are multiples of ``2**level``.
        row_of_point: row at level 0 of each point given.
    """

    features: Float[Tensor, "n c"]
    cache: CoordinateCache
    level: int = 0
    row_of_point: Int64[Tensor, " points"]

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
        given = pack(coordinates)
        keys, row_of_point, counts = torch.unique(given, return_inverse=True, return_counts=True)
        repeated = counts > 1
        if bool(repeated.any()):
            cloud, *xyz = unpack(keys[repeated][:1])[0].tolist()
            raise InputError(
                f"{int((counts - 1).sum())} points share a voxel with another, the first at {xyz} "
                f"of cloud {cloud}; keep one point a voxel."
            )
        features = features[torch.argsort(given)]
        return cls(features=features, cache=CoordinateCache(keys), row_of_point=row_of_point)

    @property
    def coordinates(self) -> Int64[Tensor, "n 4"]:
        """(cloud, x, y, z) of each row, in voxels of level 0."""
        return self.cache.coordinates(self.level)

    def with_features(self, features: Float[Tensor, "m c2"], level: int | None = None) -> "Voxels":
        """Give other features of the same level, or of another one of the same voxels."""
        level = self.level if level is None else level
        assert len(features) == len(self.cache.keys(level)), "features and voxels differ in number"
        return Voxels(
            features=features, cache=self.cache, level=level, row_of_point=self.row_of_point
        )

    def at_points(self) -> Float[Tensor, "points c"]:
        """Features of the voxel of each point, in the order in which points were given."""
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
        self.kernel, self.stride = kernel, stride
        self.weight = nn.Parameter(torch.empty(kernel**3, inputs, outputs))
        self.bias = nn.Parameter(torch.zeros(outputs)) if has_bias else None
        # Voxels of a surface fill about 1.5 k^2 of a kernel's k^3 cells (counted: 13 to 14 of 27).
        # Where it is transposed, each coarse voxel feeds about 4 fine ones.
        taps = 1.5 * kernel**2 if kernel > 1 else 1.0
        taps = max(1.0, taps / stride**2) if self.is_transposed else taps
        nn.init.normal_(self.weight, std=(2 / (taps * inputs)) ** 0.5)

    def forward(self, voxels: Voxels) -> Voxels:
        """Convolve."""
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
