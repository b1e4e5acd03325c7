"""Layers that the stereo networks share, and networks made ready to match.

Volumes can be computed some rows at a time. Batch norm is folded into the convolution before it:
the same function, one pass less.
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple, TypeVar, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

MARGIN = 1.1
"""Allocators keep gaps: measured peaks stay below the sum of the tensors times this ..."""

OVERHEAD_BYTES = 128 << 20
"""... plus this, which the first convolutions take for themselves whatever the size."""


def by_rows(
    function: Callable[..., Tensor],
    inputs: Sequence[Tensor | None],
    *,
    halo: int,
    rows: int | None,
    into: Tensor | None = None,
) -> Tensor:
    """Compute some rows of an answer at a time: the same numbers, with less held in between.

    Rows are the last axis but one. Inputs and answer may have whole multiples of the rows of the
    smallest input, in which everything here is counted: the ``halo`` of rows on each side that an
    answer depends on, and the ``rows`` at a time (None: all). The answer is written ``into`` a
    tensor, perhaps an input of which no answer needs another row than its own.
    """
    if rows is None:
        return function(*inputs)
    height = min(x.shape[-2] for x in inputs if x is not None)
    whole = into
    for first in range(0, height, rows):
        stop = min(first + rows, height)
        before = max(first - halo, 0)
        after = min(stop + halo, height)
        pieces = []
        for x in inputs:
            times = 1 if x is None else x.shape[-2] // height
            pieces.append(None if x is None else x[..., times * before : times * after, :])
        piece_result = function(*pieces)
        times = piece_result.shape[-2] // (after - before)
        if whole is None:  # in the order of memory that convolutions of volumes like
            order = torch.channels_last_3d if piece_result.ndim == 5 else torch.contiguous_format
            size = (*piece_result.shape[:-2], times * height, piece_result.shape[-1])
            whole = torch.empty(
                size, dtype=piece_result.dtype, device=piece_result.device, memory_format=order
            )
        rows_of_piece = piece_result[..., times * (first - before) : times * (stop - before), :]
        whole[..., times * first : times * stop, :] = rows_of_piece
    assert whole is not None, "there are rows"
    return whole


class Taps(NamedTuple):
    """Linear interpolation along one axis: ``(1 - share) x[low] + share x[high]``."""

    low: Tensor
    high: Tensor
    share: Tensor


def linear_taps(small: int, large: int, example: Tensor, *, align_corners: bool) -> Taps:
    """Find where each of ``large`` samples falls among ``small`` ones, as F.interpolate does."""
    index = torch.arange(large, dtype=torch.float64, device=example.device)
    if align_corners:
        at = index * ((small - 1) / max(large - 1, 1))
    else:
        at = ((index + 0.5) * (small / large) - 0.5).clamp(min=0)
    low = at.floor().long().clamp(max=small - 1)
    return Taps(low, (low + 1).clamp(max=small - 1), (at - low).to(example))


def interpolation_matrix(taps: Taps, small: int) -> Float[Tensor, "large small"]:
    """Write linear interpolation as a matrix, to be one product over many pixels."""
    matrix = taps.share.new_zeros(len(taps.low), small)
    rows = torch.arange(len(taps.low), device=matrix.device)
    matrix[rows, taps.low] += 1 - taps.share
    matrix[rows, taps.high] += taps.share
    return matrix


Features = Float[Tensor, "b _ _ _"]
Volume = Float[Tensor, "b _ _ _ _"]
Conv = nn.Conv2d | nn.Conv3d | nn.ConvTranspose3d
Norm = nn.BatchNorm2d | nn.BatchNorm3d
ModuleT = TypeVar("ModuleT", bound=nn.Module)


class ConvNorm(nn.Sequential):
    """A convolution without bias that keeps the size but for its stride, then batch norm.

    A transposed one enlarges by its stride.
    """

    def __init__(
        self,
        kind: type[Conv],
        inputs: int,
        outputs: int,
        kernel: int = 3,
        stride: int = 1,
        dilation: int = 1,
    ) -> None:
        more: dict[str, Any] = {"output_padding": stride - 1} if kind is nn.ConvTranspose3d else {}
        padding = dilation * (kernel // 2)
        conv = kind(inputs, outputs, kernel, stride, padding, dilation=dilation, bias=False, **more)
        norm = nn.BatchNorm2d if kind is nn.Conv2d else nn.BatchNorm3d
        super().__init__(OrderedDict(conv=conv, norm=norm(outputs)))


def _merge_norm(conv: Conv, norm: Norm) -> tuple[Tensor, Tensor]:
    """Merge a convolution and the norm after it to one; give its weight and bias, in float64.

    norm(conv(x)) = gain * (conv(x) - mean) + bias, with gain = weight / sqrt(var + eps).
    """
    assert norm.running_mean is not None
    assert norm.running_var is not None
    gain = norm.weight.double() / (norm.running_var.double() + norm.eps).sqrt()
    bias = (norm.bias.double() - gain * norm.running_mean.double()).detach()
    shape = [1] * conv.weight.ndim
    output_axis = 1 if isinstance(conv, nn.ConvTranspose3d) else 0
    shape[output_axis] = -1
    return (conv.weight.double() * gain.view(shape)).detach(), bias


def fold(network: ModuleT, example: Tensor) -> ModuleT:
    """Fold every batch norm into the convolution before it, in place; give the network.

    In 3D, with a norm or without, convolutions become :class:`VolumeConv`; those that are one
    already stay as they are. Parameters get the type and the device of ``example``.
    """
    for parent in list(network.modules()):
        for name, layer in list(parent.named_children()):
            norm = getattr(layer, "norm", None)
            if isinstance(layer, nn.Conv3d) and not isinstance(parent, ConvNorm):
                bias = torch.zeros(layer.out_channels) if layer.bias is None else layer.bias
                setattr(parent, name, VolumeConv(layer, layer.weight, bias, example))
            if not isinstance(norm, Norm):
                continue
            conv = cast("Conv", layer.conv)
            weight, bias = _merge_norm(conv, norm)
            if isinstance(norm, nn.BatchNorm3d):
                setattr(parent, name, VolumeConv(conv, weight, bias, example))
                continue
            conv.weight.data = weight
            conv.bias = nn.Parameter(bias)
            layer.norm = nn.Identity()
            if isinstance(layer, ConvNorm):  # which then is its convolution
                setattr(parent, name, conv)

    # The order of memory in which convolutions are fast; no gradient is wanted any more.
    for module in network.modules():
        for parameter in () if isinstance(module, VolumeConv) else module.parameters(recurse=False):
            values = parameter.data.to(example)
            order = torch.channels_last if values.ndim == 4 else torch.contiguous_format
            parameter.data = values.contiguous(memory_format=order)
            parameter.requires_grad_(False)
    return network


class VolumeConv(nn.Module):
    """A folded 3x3x3 convolution of whole volumes."""

    def __init__(self, conv: nn.Module, weight: Tensor, bias: Tensor, like: Tensor) -> None:
        super().__init__()
        self.is_transposed = isinstance(conv, nn.ConvTranspose3d)
        self.stride = cast("Conv", conv).stride[0]
        weight = weight.detach().to(like).contiguous()
        self.weight = nn.Parameter(weight, requires_grad=False)
        self.bias = nn.Parameter(bias.detach().to(like), requires_grad=False)
        self.with_onednn = has_onednn_operators()

    def forward(self, volume: Volume) -> Volume:
        """Convolve a volume, in the type of the weights."""
        volume = volume.to(self.weight.dtype)
        is_usable = volume.device.type == "cpu" and volume.dtype in (torch.float32, torch.bfloat16)
        tensors = (volume, self.weight, self.bias)
        ones = (1, 1, 1)
        steps = (self.stride,) * 3
        # oneDNN is called by name: PyTorch's own choice takes a slow path for few rows.
        if is_usable and self.with_onednn and self.is_transposed:
            more = (ones, ones, steps, ones, 1, "none", [], "")
            return torch.ops.mkldnn._convolution_transpose_pointwise(*tensors, *more)
        if is_usable and self.with_onednn:
            return torch.mkldnn_convolution(*tensors, ones, steps, ones, 1)
        if self.is_transposed:
            return F.conv_transpose3d(*tensors, self.stride, 1, 1)
        return F.conv3d(*tensors, self.stride, 1)


@cache
def has_onednn_operators() -> bool:
    """Whether this PyTorch has both oneDNN operators, which it does not document, as used here.

    Without them, or where they answer otherwise than the documented ones, these are called.
    """
    if not torch.backends.mkldnn.is_available():
        return False
    example = torch.empty(0, dtype=torch.float32, device="cpu")
    tensors = example.new_ones(1, 2, 4, 4, 4), example.new_ones(2, 2, 3, 3, 3), example.new_ones(2)
    ones = (1, 1, 1)
    twos = (2, 2, 2)
    more = (ones, ones, twos, ones, 1, "none", [], "")
    try:
        with torch.no_grad():
            convolved = torch.mkldnn_convolution(*tensors, ones, ones, ones, 1)
            transposed = torch.ops.mkldnn._convolution_transpose_pointwise(*tensors, *more)
    except (AttributeError, RuntimeError, TypeError):
        return False
    answers = (
        (convolved, F.conv3d(*tensors, 1, 1)),
        (transposed, F.conv_transpose3d(*tensors, 2, 1, 1)),
    )
    return all(a.shape == b.shape and torch.allclose(a, b) for a, b in answers)
