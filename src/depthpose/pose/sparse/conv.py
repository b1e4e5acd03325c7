"""The sparse convolution, ``conv(features, weight, kernel_map)``, and its matrix products.

Every way of computing it is gather, multiply, add up; the ways differ in how much is gathered at
once. Without gradients small ones go through a compiled loop, where numba is installed.

Products go in blocks of rows through the faster of torch's two CPU libraries.
"""

from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from depthpose.pose.compiled import serves
from depthpose.pose.sparse.kernel_map import KernelMap

BLOCK_PRODUCTS = 1 << 23
"""Multiplications in a block: fewer cost more calls, more fall out of the cache (measured)."""


def block_rows(x: Tensor, kernel: Tensor) -> int:
    """Rows to multiply at once; all of them where oneDNN does not serve.

    On an AMD processor oneDNN makes a convolution of 10,000 voxels 1.4 times as fast as MKL does,
    but it compiles code for each new shape, which takes milliseconds: blocks keep to one shape,
    and ragged ends go to MKL.
    """
    if not _has_onednn(x):
        return 1 << 62
    return max(1, BLOCK_PRODUCTS // kernel.numel())


def multiply(
    rows: Float[Tensor, "n inputs"], kernel: Float[Tensor, "inputs outputs"], block: int
) -> Float[Tensor, "n outputs"]:
    """Multiply up to ``block`` rows."""
    if len(rows) < block or not _has_onednn(rows):
        return torch.mm(rows, kernel)
    return torch.ops.mkldnn._linear_pointwise(rows, kernel.T, None, "none", [], "")


def add_product(out: Tensor, x: Tensor, kernel: Tensor) -> Tensor:
    """Add ``x @ kernel`` to ``out`` in place."""
    block = block_rows(x, kernel)
    for part, rows in zip(out.split(block), x.split(block), strict=True):
        if len(rows) < block:
            part.addmm_(rows, kernel)
        else:
            part.add_(multiply(rows, kernel, block))
    return out


def _has_onednn(x: Tensor) -> bool:
    is_usable = x.device.type == "cpu" and x.dtype == torch.float32
    return is_usable and _has_private_product()


@cache
def _has_private_product() -> bool:
    """Whether this torch multiplies strided float32 through oneDNN, by an operator private to it.

    Without it every product goes through ``torch.mm``: the same numbers, more slowly.
    """
    if not torch.backends.mkldnn.is_available():
        return False
    rows, kernel = torch.ones(2, 3, dtype=torch.float32), torch.ones(3, 4, dtype=torch.float32)
    try:
        product = torch.ops.mkldnn._linear_pointwise(rows, kernel.T, None, "none", [], "")
    except (AttributeError, RuntimeError, TypeError):  # renamed, not built in, other arguments
        return False
    return torch.equal(product, torch.full_like(product, 3.0))


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
    if _is_compiled(features, weight, kernel_map):
        from depthpose.pose.compiled.convolve import convolved

        m = kernel_map
        return convolved(
            features, weight, m.neighbours.table, m.neighbours.fine_rows, m.is_transposed
        )
    return _Convolution.apply(features, weight, kernel_map)


Gradients = tuple[Tensor | None, Tensor | None]
"""Of the features and of the weight."""


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
        features, weight = ctx.saved_tensors
        gradient = gradient.contiguous()
        wanted = ctx.needs_input_grad[:2]
        if _is_narrow(features, ctx.kernel_map):
            way = _gradients_by_table
        else:
            is_gridded = _is_gridded(features, weight, ctx.kernel_map)
            way = _gradients_by_grid if is_gridded else _gradients_by_offset
        return *way(gradient, features, weight, ctx.kernel_map, wanted), None


def _convolve(x: Tensor, weight: Tensor, m: KernelMap) -> Tensor:
    if _is_narrow(x, m):
        return _table(x, m).T @ weight.flatten(0, 1)
    out = _by_grid(x, weight, m) if _is_gridded(x, weight, m) else _by_offset(x, weight, m)
    return out if m.centre is None else add_product(out, x, weight[m.centre])


def _by_grid(x: Tensor, weight: Tensor, m: KernelMap) -> Tensor:
    """Gather, multiply and add up all offsets in one operation each, padded to the fullest."""
    products = torch.bmm(_read(x, m.grid_in, m), weight)
    return m.sum_by_output(products.flatten(0, 1))


def _by_offset(x: Tensor, weight: Tensor, m: KernelMap) -> Tensor:
    """Gather and add up an offset at a time: its pairs write each row once at most."""
    out = x.new_zeros(m.outputs, weight.shape[2])
    # Lists of views, each from one call: slicing one by one costs as much as small products.
    kernels = weight.unbind()
    reads, writes = m.rows_in.split(m.counts), m.rows_out.split(m.counts)
    for offset, read, write in zip(m.filled, reads, writes, strict=True):
        _add_rows(out, write, (x, read), kernels[offset])
    return out


def _add_rows(out: Tensor, write: Tensor, source: tuple[Tensor, Tensor], kernel: Tensor) -> None:
    """Add ``x[read] @ kernel`` to the rows ``write`` of ``out``, block by block."""
    x, read = source
    block = block_rows(x, kernel)
    for reads, writes in zip(read.split(block), write.split(block), strict=True):
        out.index_add_(0, writes, multiply(x.index_select(0, reads), kernel, block))


def _gradients_by_table(
    gradient: Tensor, x: Tensor, weight: Tensor, m: KernelMap, wanted: tuple[bool, ...]
) -> Gradients:
    # The first layer's input is no parameter's child: its gradient is seldom wanted and not cheap.
    for_x = _convolve(gradient, weight.mT, m.transposed) if wanted[0] else None
    return for_x, (_table(x, m) @ gradient).view(weight.shape) if wanted[1] else None


def _gradients_by_grid(
    gradient: Tensor, x: Tensor, weight: Tensor, m: KernelMap, wanted: tuple[bool, ...]
) -> Gradients:
    pulls = _read(gradient, m.grid_out, m)
    for_x = for_weight = None
    if wanted[0]:
        for_x = m.transposed.sum_by_output(torch.bmm(pulls, weight.mT).flatten(0, 1))
    if wanted[1]:
        for_weight = torch.bmm(_read(x, m.grid_in, m).mT, pulls)
    return _with_centre(gradient, x, weight, m, (for_x, for_weight))


def _gradients_by_offset(
    gradient: Tensor, x: Tensor, weight: Tensor, m: KernelMap, wanted: tuple[bool, ...]
) -> Gradients:
    for_x = torch.zeros_like(x) if wanted[0] else None
    for_weight = torch.empty_like(weight) if wanted[1] else None
    kernels, pulled = weight.mT.unbind(), () if for_weight is None else for_weight.unbind()
    if for_weight is not None:
        for offset in set(range(m.volume)).difference(m.filled):
            pulled[offset].zero_()
    reads, writes = m.rows_in.split(m.counts), m.rows_out.split(m.counts)
    for offset, read, write in zip(m.filled, reads, writes, strict=True):
        if for_weight is not None:
            pulls = gradient.index_select(0, write)
            torch.mm(x.index_select(0, read).T, pulls, out=pulled[offset])
        if for_x is not None:
            _add_rows(for_x, read, (gradient, write), kernels[offset])
    return _with_centre(gradient, x, weight, m, (for_x, for_weight))


def _with_centre(
    gradient: Tensor, x: Tensor, weight: Tensor, m: KernelMap, so_far: Gradients
) -> Gradients:
    """Add the part of the offset at which each voxel is its own neighbour."""
    for_x, for_weight = so_far
    if m.centre is not None and for_x is not None:
        add_product(for_x, gradient, weight[m.centre].T)
    if m.centre is not None and for_weight is not None:
        torch.mm(x.T, gradient, out=for_weight[m.centre])
    return so_far


def _read(x: Tensor, slots: Tensor, m: KernelMap) -> Tensor:
    """Gather the slots of (volume, most); empty ones read a row of zeros."""
    padded = torch.nn.functional.pad(x, (0, 0, 0, 1))
    return padded.index_select(0, slots).view(m.volume, m.most, x.shape[1])


def _table(x: Tensor, m: KernelMap) -> Tensor:
    """Lay out what each output voxel reads: (volume * channels, outputs), 0 where it is empty."""
    padded = torch.nn.functional.pad(x, (0, 0, 0, 1))
    rows = m.neighbours.table
    read = padded.index_select(0, rows.flatten()).view(*rows.shape, x.shape[1])
    return read.transpose(1, 2).reshape(m.volume * x.shape[1], m.outputs)


def _is_compiled(x: Tensor, weight: Tensor, m: KernelMap) -> bool:
    is_plain = x.dtype == weight.dtype == torch.float32
    return is_plain and serves(x, weight) and m.neighbours.table.numel() <= COMPILED_ELEMENTS


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
