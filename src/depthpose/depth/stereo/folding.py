"""Batch norm folded into the convolution before it: the same function, one pass less."""

from functools import cache
from typing import TypeVar, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.depth.stereo.psmnet import ConvNorm

Conv = nn.Conv2d | nn.Conv3d | nn.ConvTranspose3d
Norm = nn.BatchNorm2d | nn.BatchNorm3d
Volume = Float[Tensor, "b _ _ _ _"]
ModuleT = TypeVar("ModuleT", bound=nn.Module)


def folded_weight(layer: nn.Module) -> tuple[Tensor, Tensor]:
    """Weight and bias of the one convolution that equals ``layer`` in eval mode, in float64.

    ``norm(conv(x)) = gain * (conv(x) - mean) + bias`` with ``gain = weight / sqrt(var + eps)``.
    """
    conv, norm = cast("Conv", layer.conv), cast("Norm", layer.norm)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    gain = norm.weight.double() / (norm.running_var.double() + norm.eps).sqrt()
    bias = norm.bias.double() - gain * norm.running_mean.double()
    output_axis = 1 if isinstance(conv, nn.ConvTranspose3d) else 0
    shape = [1] * conv.weight.ndim
    shape[output_axis] = -1
    return (conv.weight.double() * gain.view(shape)).detach(), bias.detach()


def fold_features(features: ModuleT, like: Tensor) -> ModuleT:
    """Fold every batch norm after a 2D convolution, in place, and bring all to ``like``'s type."""
    for layer in list(features.modules()):
        if not isinstance(getattr(layer, "norm", None), nn.BatchNorm2d):
            continue
        weight, bias = folded_weight(layer)
        conv = cast("nn.Conv2d", layer.conv)
        conv.weight.data = weight
        conv.bias = nn.Parameter(bias)
        layer.norm = nn.Identity()
    for parameter in features.parameters():
        cast_ = parameter.data.to(like)
        parameter.data = cast_.contiguous(memory_format=_memory_format(cast_))
        parameter.requires_grad_(False)
    return features


def _memory_format(x: Tensor) -> torch.memory_format:
    return torch.channels_last if x.ndim == 4 else torch.contiguous_format


def fold_volumes(module: ModuleT, like: Tensor) -> ModuleT:
    """Fold every batch norm after a 3D convolution, in place; oneDNN is called by name after it.

    So it is in 3D convolutions without a norm.
    """
    for layer in list(module.modules()):
        if isinstance(layer, ConvNorm) and isinstance(layer.norm, nn.BatchNorm3d):
            layer.conv = VolumeConv(layer.conv, *folded_weight(layer), like)
            layer.norm = nn.Identity()
        for name, conv in list(layer.named_children()):
            if isinstance(conv, nn.Conv3d):
                bias = torch.zeros(conv.out_channels) if conv.bias is None else conv.bias
                setattr(layer, name, VolumeConv(conv, conv.weight, bias, like))
    return module


class VolumeConv(nn.Module):
    """A folded 3x3x3 convolution of whole volumes."""

    def __init__(self, conv: nn.Module, weight: Tensor, bias: Tensor, like: Tensor) -> None:
        super().__init__()
        self.is_transposed = isinstance(conv, nn.ConvTranspose3d)
        self.stride = cast("Conv", conv).stride[0]
        weight = weight.detach().to(like).contiguous(memory_format=torch.channels_last_3d)
        self.weight = nn.Parameter(weight, requires_grad=False)
        self.bias = nn.Parameter(bias.detach().to(like), requires_grad=False)

    def forward(self, volume: Volume) -> Volume:
        """Convolve a volume, in the type of the weights."""
        volume = volume.to(self.weight.dtype)
        if self.is_transposed:
            transposed = _onednn_transposed if _has_onednn(volume) else _transposed
            return transposed(volume, self.weight, self.bias)
        convolved = _onednn_convolved if _has_onednn(volume) else _convolved
        return convolved(volume, self.weight, self.bias, self.stride)


def _convolved(volume: Tensor, weight: Tensor, bias: Tensor, stride: int) -> Tensor:
    return nn.functional.conv3d(volume, weight, bias, stride, 1)


def _onednn_convolved(volume: Tensor, weight: Tensor, bias: Tensor, stride: int) -> Tensor:
    strides = (stride,) * 3
    return torch.mkldnn_convolution(volume, weight, bias, (1, 1, 1), strides, (1, 1, 1), 1)


def _transposed(volume: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return nn.functional.conv_transpose3d(volume, weight, bias, 2, 1, 1)


def _onednn_transposed(volume: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    sizes = ((1, 1, 1), (1, 1, 1), (2, 2, 2), (1, 1, 1), 1)
    args = (volume, weight, bias, *sizes, "none", [], "")
    return torch.ops.mkldnn._convolution_transpose_pointwise(*args)


def _has_onednn(x: Tensor) -> bool:
    """Whether to call oneDNN by name: PyTorch's own choice takes a slow path for few rows."""
    is_usable = x.device.type == "cpu" and x.dtype in (torch.float32, torch.bfloat16)
    return is_usable and has_onednn_operators()


@cache
def has_onednn_operators() -> bool:
    """Whether this PyTorch has both oneDNN operators, which it does not document, as used here.

    Without them, or where they answer otherwise than the documented ones, these are called.
    """
    if not torch.backends.mkldnn.is_available():
        return False
    volume, weight, bias = torch.ones(1, 2, 4, 4, 4), torch.ones(2, 2, 3, 3, 3), torch.ones(2)
    try:
        with torch.no_grad():
            found = (
                _onednn_convolved(volume, weight, bias, 1),
                _onednn_transposed(volume, weight, bias),
            )
    except (AttributeError, RuntimeError, TypeError):
        return False
    wanted = (_convolved(volume, weight, bias, 1), _transposed(volume, weight, bias))
    both = zip(found, wanted, strict=True)
    return all(one.shape == other.shape and torch.allclose(one, other) for one, other in both)
