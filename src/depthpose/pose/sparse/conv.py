"""The sparse convolution itself, behind one seam: ``conv(features, weight, kernel_map)``.

Every way of computing it is gather, multiply, add up; the ways differ in how much is gathered at
once. A faster kernel would replace :func:`conv` and nothing else.
"""

from collections.abc import Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from depthpose.pose.sparse.kernel_map import KernelMap

BUFFER_ELEMENTS = 1 << 20
"""Products of all pairs up to this many numbers are added up at once; beyond, an offset at a
time, which stays in the processor's cache (measured by bench/sparse_speed.py)."""

NARROW = 4
"""Inputs of up to this many channels are laid out as a table: their products are too thin."""

TABLE_ELEMENTS = 1 << 25
"""Largest such table."""


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
        features, weight = ctx.saved_tensors
        gradient = gradient.contiguous()
        back, (with_features, with_weight, _) = ctx.kernel_map.transposed, ctx.needs_input_grad
        return (
            _convolve(gradient, weight.transpose(1, 2), back) if with_features else None,
            _weight_gradient(features, gradient, ctx.kernel_map) if with_weight else None,
            None,
        )


def _convolve(x: Tensor, weight: Tensor, m: KernelMap) -> Tensor:
    if _is_narrow(x, m):
        return _table(x, m).T @ weight.flatten(0, 1)
    if _is_small(len(m.rows_in) * max(weight.shape[1:])):
        out = _at_once(x, weight, m)
    else:
        out = _by_offset(x, weight, m)
    return out if m.centre is None else out.addmm_(x, weight[m.centre])


def _at_once(x: Tensor, weight: Tensor, m: KernelMap) -> Tensor:
    """Gather and add up all pairs in one operation each: least overhead, most memory."""
    rows = x.index_select(0, m.rows_in)
    products = x.new_empty(len(rows), weight.shape[2])
    # Lists of views, each made by one call: slicing one by one would cost as much as multiplying.
    kernels, parts = weight.unbind(), products.split(m.counts)
    for offset, read, part in zip(m.filled, rows.split(m.counts), parts, strict=True):
        torch.mm(read, kernels[offset], out=part)
    return m.sum_by_output(products)


def _by_offset(x: Tensor, weight: Tensor, m: KernelMap) -> Tensor:
    """Gather and add up an offset at a time: its pairs write each row once at most."""
    out = x.new_zeros(m.outputs, weight.shape[2])
    reads, writes = m.rows_in.split(m.counts), m.rows_out.split(m.counts)
    for offset, read, write in zip(m.filled, reads, writes, strict=True):
        out.index_add_(0, write, x.index_select(0, read) @ weight[offset])
    return out


def _weight_gradient(x: Tensor, gradient: Tensor, m: KernelMap) -> Tensor:
    shape = (m.volume, x.shape[1], gradient.shape[1])
    if _is_narrow(x, m):
        return (_table(x, m) @ gradient).view(shape)
    out = x.new_empty(shape)
    kernels = out.unbind()
    for offset in set(range(m.volume)) - {*m.filled, m.centre}:
        kernels[offset].zero_()
    for offset, rows, pulls in zip(m.filled, *_gathered(x, gradient, m), strict=True):
        torch.mm(rows.T, pulls, out=kernels[offset])
    if m.centre is not None:
        torch.mm(x.T, gradient, out=kernels[m.centre])
    return out


def _gathered(
    x: Tensor, gradient: Tensor, m: KernelMap
) -> tuple[Iterable[Tensor], Iterable[Tensor]]:
    """Give what each offset read and what pulls at it: all at once if that is little."""
    if _is_small(len(m.rows_in) * max(x.shape[1], gradient.shape[1])):
        reads, pulls = x.index_select(0, m.rows_in), gradient.index_select(0, m.rows_out)
        return reads.split(m.counts), pulls.split(m.counts)
    return (
        (x.index_select(0, rows) for rows in m.rows_in.split(m.counts)),
        (gradient.index_select(0, rows) for rows in m.rows_out.split(m.counts)),
    )


def _table(x: Tensor, m: KernelMap) -> Tensor:
    """Lay out what each output voxel reads: (volume * channels, outputs), 0 where it is empty."""
    padded = torch.nn.functional.pad(x, (0, 0, 0, 1))
    # -1 of an empty cell finds the row of zeros, if it is made a row number.
    rows = torch.where(m.meetings.table < 0, len(x), m.meetings.table)
    read = padded.index_select(0, rows.flatten()).view(*rows.shape, x.shape[1])
    return read.transpose(1, 2).reshape(m.volume * x.shape[1], m.outputs)


def _is_narrow(x: Tensor, m: KernelMap) -> bool:
    channels = x.shape[1]
    elements = m.outputs * m.volume * channels
    return not m.is_transposed and channels <= NARROW and elements <= TABLE_ELEMENTS


def _is_small(elements: int) -> bool:
    return elements <= BUFFER_ELEMENTS or torch.are_deterministic_algorithms_enabled()
