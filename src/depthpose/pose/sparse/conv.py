"""The sparse convolution itself, behind one seam: ``conv(features, weight, kernel_map)``.

Every way of computing it is gather, multiply, add up; the ways differ in how much is gathered at
once. A faster kernel would replace :func:`conv` and nothing else.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from depthpose.pose.sparse.kernel_map import KernelMap

BUFFER_ELEMENTS = 1 << 21
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
        back = ctx.kernel_map.transposed
        with_features, with_weight, _ = ctx.needs_input_grad
        return (
            _convolve(gradient, weight.transpose(1, 2), back) if with_features else None,
            _weight_gradient(features, gradient, ctx.kernel_map) if with_weight else None,
            None,
        )


def _convolve(x: Tensor, weight: Tensor, m: KernelMap) -> Tensor:
    if _is_narrow(x, m):
        return _table(x, m) @ weight.flatten(0, 1)
    if _is_small(len(m.rows_in) * max(weight.shape[1:])):
        out = _at_once(x, weight, m)
    else:
        out = _by_offset(x, weight, m)
    return out if m.pairs.centre is None else out.addmm_(x, weight[m.pairs.centre])


def _at_once(x: Tensor, weight: Tensor, m: KernelMap) -> Tensor:
    """Gather and add up all pairs in one operation each: least overhead, most memory."""
    rows = x.index_select(0, m.rows_in)
    products = x.new_empty(len(rows), weight.shape[2])
    for offset, first, last in m.pairs.segments:
        torch.mm(rows[first:last], weight[offset], out=products[first:last])
    return m.sum_by_output(products)


def _by_offset(x: Tensor, weight: Tensor, m: KernelMap) -> Tensor:
    """Gather and add up an offset at a time: its pairs write each row once at most."""
    out = x.new_zeros(m.outputs, weight.shape[2])
    for offset, first, last in m.pairs.segments:
        products = x.index_select(0, m.rows_in[first:last]) @ weight[offset]
        out.index_add_(0, m.rows_out[first:last], products)
    return out


def _weight_gradient(x: Tensor, gradient: Tensor, m: KernelMap) -> Tensor:
    shape = (m.pairs.volume, x.shape[1], gradient.shape[1])
    if _is_narrow(x, m):
        return (_table(x, m).T @ gradient).view(shape)
    out = x.new_zeros(shape)
    for offset, first, last in m.pairs.segments:
        read = x.index_select(0, m.rows_in[first:last])
        torch.mm(read.T, gradient.index_select(0, m.rows_out[first:last]), out=out[offset])
    if m.pairs.centre is not None:
        torch.mm(x.T, gradient, out=out[m.pairs.centre])
    return out


def _table(x: Tensor, m: KernelMap) -> Tensor:
    """Lay out what each output voxel reads: (outputs, volume * channels), 0 where it is empty."""
    table = x.new_zeros(m.outputs, m.pairs.volume, x.shape[1])
    table[m.rows_out, m.pairs.offset] = x[m.rows_in]
    if m.pairs.centre is not None:
        table[:, m.pairs.centre] = x
    return table.flatten(1)


def _is_narrow(x: Tensor, m: KernelMap) -> bool:
    channels = x.shape[1]
    return channels <= NARROW and m.outputs * m.pairs.volume * channels <= TABLE_ELEMENTS


def _is_small(elements: int) -> bool:
    return elements <= BUFFER_ELEMENTS or torch.are_deterministic_algorithms_enabled()
