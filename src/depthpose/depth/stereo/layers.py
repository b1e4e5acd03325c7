"""Layers that the stereo networks share: convolutions, interpolation, computation by rows.

Volumes can be computed some rows at a time, in less memory. For matching, batch norm is folded into
the convolution before it: the same function, one pass less.
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
OVERHEAD_BYTES = 128 << 20
"""The measured peak of the memory stays below the sum of the tensors times ``MARGIN``, for the gaps
of the allocator, plus ``OVERHEAD_BYTES``, which the first convolutions take whatever the size."""


def by_rows(
    function: Callable[..., Tensor],
    inputs: Sequence[Tensor | None],
    *,
    halo: int,
    rows: int | None,
    into: Tensor | None = None,
) -> Tensor:
    """Compute a function of tensors some rows at a time: the same result, in less memory.

    Rows are the last axis but one. Inputs and result may have whole multiples of the rows of the
    smallest input; ``halo`` and ``rows`` are counted in rows of that one.

    Args:
        function: from slices of the inputs to the same rows of the result.
        inputs: the tensors that are sliced; None is passed on.
        halo: number of rows on each side that a row of the result depends on.
        rows: number of rows that are computed at a time; None: all at once.
        into: tensor that the result is written to, perhaps an input of which each row of the result
            depends on its own row alone; None: a new one.

    Returns:
        The result of all rows: ``into``, or a new tensor.
    """
    if rows is None:
        return function(*inputs)
    height = min(x.shape[-2] for x in inputs if x is not None)
    result = into
    for first in range(0, height, rows):
        stop = min(first + rows, height)
        halo_first = max(first - halo, 0)
        halo_stop = min(stop + halo, height)
        slices = [
            None if x is None else _slice_rows(x, halo_first, halo_stop, x.shape[-2] // height)
            for x in inputs
        ]
        part = function(*slices)
        multiple = part.shape[-2] // (halo_stop - halo_first)
        if result is None:  # in the memory format that convolutions of volumes are fast in
            order = torch.channels_last_3d if part.ndim == 5 else torch.contiguous_format
            size = (*part.shape[:-2], multiple * height, part.shape[-1])
            result = torch.empty(size, dtype=part.dtype, device=part.device, memory_format=order)
        part_without_halo = _slice_rows(part, first - halo_first, stop - halo_first, multiple)
        _slice_rows(result, first, stop, multiple).copy_(part_without_halo)
    assert result is not None, "there are rows"
    return result


def _slice_rows(x: Tensor, first: int, stop: int, multiple: int) -> Tensor:
    """Take rows of a tensor that has ``multiple`` rows for each of those that are counted."""
    return x[..., multiple * first : multiple * stop, :]


class Taps(NamedTuple):
    """Linear interpolation along one axis: ``(1 - share) x[low] + share x[high]``.

    ``low`` and ``high`` are indices, one for each sample of the result.
    """

    low: Tensor
    high: Tensor
    share: Tensor


def linear_taps(small: int, large: int, example: Tensor, *, align_corners: bool) -> Taps:
    """Compute the interpolation from ``small`` to ``large`` samples, as F.interpolate does it.

    ``example``: a tensor of the type and device of the shares.
    """
    index = torch.arange(large, dtype=torch.float64, device=example.device)
    if align_corners:
        position = index * ((small - 1) / max(large - 1, 1))
    else:
        position = ((index + 0.5) * (small / large) - 0.5).clamp(min=0)
    low = position.floor().long().clamp(max=small - 1)
    high = (low + 1).clamp(max=small - 1)
    return Taps(low, high, (position - low).to(example))


def interpolation_matrix(taps: Taps, small: int) -> Float[Tensor, "large small"]:
    """Compute the matrix of a linear interpolation from ``small`` samples: ``matrix @ x``."""
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
    """A convolution without bias, then batch norm.

    It keeps the size but for its stride: a transposed convolution enlarges by it, others shrink.
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
        options: dict[str, Any] = {"dilation": dilation, "bias": False}
        if kind is nn.ConvTranspose3d:
            options["output_padding"] = stride - 1
        padding = dilation * (kernel // 2)
        conv = kind(inputs, outputs, kernel, stride, padding, **options)
        norm = nn.BatchNorm2d if kind is nn.Conv2d else nn.BatchNorm3d
        super().__init__(OrderedDict(conv=conv, norm=norm(outputs)))


def _merge_norm(conv: Conv, norm: Norm) -> tuple[Tensor, Tensor]:
    """Compute weight and bias of the one convolution that equals a convolution and its norm.

    norm(conv(x)) = gain * (conv(x) - mean) + bias, with gain = weight / sqrt(var + eps). Both are
    float64.
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
    """Fold every batch norm into the convolution before it, in place, and return the network.

    Convolutions of volumes become :class:`VolumeConv`, with a norm or without, unless they are one
    already. Parameters get the type and the device of ``example``, and need no gradient.
    """
    for parent in list(network.modules()):
        for name, layer in list(parent.named_children()):
            norm = getattr(layer, "norm", None)
            if isinstance(layer, nn.Conv3d) and not isinstance(parent, ConvNorm):
                bias = torch.zeros(layer.out_channels) if layer.bias is None else layer.bias
                setattr(parent, name, VolumeConv(layer, layer.weight, bias, example))
            elif isinstance(norm, Norm):
                setattr(parent, name, _fold_norm(layer, norm, example))

    # In the memory format that convolutions are fast in.
    for module in network.modules():
        if isinstance(module, VolumeConv):
            continue
        for parameter in module.parameters(recurse=False):
            values = parameter.data.to(example)
            order = torch.channels_last if values.ndim == 4 else torch.contiguous_format
            parameter.data = values.contiguous(memory_format=order)
            parameter.requires_grad_(False)
    return network


def _fold_norm(layer: nn.Module, norm: Norm, example: Tensor) -> nn.Module:
    """Fold the norm of a layer with ``conv`` and ``norm``; return what takes the layer's place."""
    conv = cast("Conv", layer.conv)
    weight, bias = _merge_norm(conv, norm)
    if isinstance(norm, nn.BatchNorm3d):
        return VolumeConv(conv, weight, bias, example)
    conv.weight.data = weight
    conv.bias = nn.Parameter(bias)
    if isinstance(layer, ConvNorm):
        return conv
    layer.norm = nn.Identity()  # other layers also pad
    return layer


class VolumeConv(nn.Module):
    """A 3x3x3 convolution of whole volumes, for inference.

    Args:
        conv: the convolution that it takes the place of.
        weight: its weight, with the norm folded in.
        bias: its bias, with the norm folded in.
        example: a tensor of the type and device of the computation.
    """

    def __init__(self, conv: nn.Module, weight: Tensor, bias: Tensor, example: Tensor) -> None:
        super().__init__()
        self.is_transposed = isinstance(conv, nn.ConvTranspose3d)
        self.stride = cast("Conv", conv).stride[0]
        weight = weight.detach().to(example).contiguous()
        self.weight = nn.Parameter(weight, requires_grad=False)
        self.bias = nn.Parameter(bias.detach().to(example), requires_grad=False)
        self.with_onednn = has_onednn_operators()

    def forward(self, volume: Volume) -> Volume:
        """Convolve a volume, in the type of the weights."""
        volume = volume.to(self.weight.dtype)
        is_usable = volume.device.type == "cpu" and volume.dtype in (torch.float32, torch.bfloat16)
        tensors = (volume, self.weight, self.bias)
        # oneDNN is called by name: PyTorch's own choice takes a slow path for few rows.
        if is_usable and self.with_onednn:
            convolve = _onednn_conv_transpose3d if self.is_transposed else _onednn_conv3d
            return convolve(*tensors, self.stride)
        if self.is_transposed:
            return F.conv_transpose3d(*tensors, self.stride, 1, 1)
        return F.conv3d(*tensors, self.stride, 1)


def _onednn_conv3d(volume: Volume, weight: Tensor, bias: Tensor, stride: int) -> Volume:
    """Compute ``F.conv3d(volume, weight, bias, stride, 1)`` by oneDNN."""
    padding = dilation = (1, 1, 1)
    groups = 1
    return torch.mkldnn_convolution(volume, weight, bias, padding, (stride,) * 3, dilation, groups)


def _onednn_conv_transpose3d(volume: Volume, weight: Tensor, bias: Tensor, stride: int) -> Volume:
    """Compute ``F.conv_transpose3d(volume, weight, bias, stride, 1, 1)`` by oneDNN."""
    padding = output_padding = dilation = (1, 1, 1)
    groups = 1
    no_activation = ("none", [], "")
    return torch.ops.mkldnn._convolution_transpose_pointwise(
        volume,
        weight,
        bias,
        padding,
        output_padding,
        (stride,) * 3,
        dilation,
        groups,
        *no_activation,
    )


@cache
def has_onednn_operators() -> bool:
    """Whether both oneDNN operators, which PyTorch does not document, work as they are used here.

    They do where they compute the same as the documented ones.
    """
    if not torch.backends.mkldnn.is_available():
        return False
    example = torch.empty(0, dtype=torch.float32, device="cpu")
    tensors = example.new_ones(1, 2, 4, 4, 4), example.new_ones(2, 2, 3, 3, 3), example.new_ones(2)
    try:
        with torch.no_grad():
            convolved = _onednn_conv3d(*tensors, 1)
            transposed = _onednn_conv_transpose3d(*tensors, 2)
    except (AttributeError, RuntimeError, TypeError):
        return False
    results = (
        (convolved, F.conv3d(*tensors, 1, 1)),
        (transposed, F.conv_transpose3d(*tensors, 2, 1, 1)),
    )
    return all(a.shape == b.shape and torch.allclose(a, b) for a, b in results)
