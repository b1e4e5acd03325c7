"""Batch norm folded into the convolution before it: the same function, one pass less."""

from typing import cast

import torch
from torch import Tensor, nn

from depthpose.depth.stereo.features import ConvNorm, FeatureExtractor

Conv = nn.Conv2d | nn.Conv3d | nn.ConvTranspose3d
Norm = nn.BatchNorm2d | nn.BatchNorm3d


def folded_weight(layer: ConvNorm) -> tuple[Tensor, Tensor]:
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


def fold_features(features: FeatureExtractor) -> None:
    """Fold every batch norm of a feature extractor, in place."""
    for layer in list(features.modules()):
        if not isinstance(layer, ConvNorm) or isinstance(layer.norm, nn.Identity):
            continue
        weight, bias = folded_weight(layer)
        conv = cast("nn.Conv2d", layer.conv)
        conv.weight.data = weight.to(conv.weight.dtype)
        conv.bias = nn.Parameter(bias.to(conv.weight.dtype), requires_grad=False)
        layer.norm = nn.Identity()


class RowsConv:
    """A folded 3x3x3 convolution for volumes whose rows stand before disparities.

    Inference keeps volumes as ``(1, C, rows, disparities, columns)`` with channels last in
    memory, so some rows of a volume are one piece of memory and no copy is needed to take them.
    """

    def __init__(self, layer: ConvNorm | nn.Conv3d, like: Tensor) -> None:
        conv = layer.conv if isinstance(layer, ConvNorm) else layer
        self.is_transposed = isinstance(conv, nn.ConvTranspose3d)
        self.stride = cast("Conv", conv).stride[0]
        if isinstance(layer, ConvNorm):
            weight, bias = folded_weight(layer)
            self.bias = bias.to(like)
        else:
            weight, self.bias = layer.weight.detach(), None
        turned = weight.transpose(2, 3).to(like)
        self.weight = turned.contiguous(memory_format=torch.channels_last_3d)

    def __call__(self, rows: Tensor) -> Tensor:
        """Convolve rows that carry their own halo: the result has none."""
        if self.is_transposed:
            # Row 2i+1 looks at rows i and i+1, so the last pair of rows lacks its halo.
            full = nn.functional.conv_transpose3d(rows, self.weight, self.bias, 2, 1, 1)
            return full[:, :, :-2]
        return nn.functional.conv3d(rows, self.weight, self.bias, self.stride, (0, 1, 1))
