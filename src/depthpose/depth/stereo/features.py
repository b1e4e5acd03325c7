"""Features of one view for stereo matching: residual layers and a spatial pyramid, at 1/4 size."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.depth.config import PSMNetConfig


class ConvNorm(nn.Module):
    """A convolution without bias, then batch normalisation."""

    def __init__(self, conv: nn.Module, norm: nn.Module) -> None:
        super().__init__()
        self.conv = conv
        self.norm = norm

    def forward(self, x: Float[Tensor, "b c *size"]) -> Float[Tensor, "b k *smaller"]:
        """Convolve and normalise."""
        return self.norm(self.conv(x))


class Shape(NamedTuple):
    """Window, stride and dilation of a convolution."""

    kernel: int = 3
    stride: int = 1
    dilation: int = 1


PLAIN = Shape()


def conv_norm_2d(inputs: int, outputs: int, shape: Shape = PLAIN) -> ConvNorm:
    """Make a 2D convolution that keeps the size (but for its stride), with batch norm."""
    padding = shape.dilation * (shape.kernel // 2)
    conv = nn.Conv2d(
        inputs, outputs, shape.kernel, shape.stride, padding, shape.dilation, bias=False
    )
    return ConvNorm(conv, nn.BatchNorm2d(outputs))


class Block(nn.Module):
    """Two convolutions and a shortcut; no ReLU after the sum, as in the paper's code."""

    def __init__(self, inputs: int, outputs: int, stride: int, dilation: int) -> None:
        super().__init__()
        self.first = conv_norm_2d(inputs, outputs, Shape(3, stride, dilation))
        self.second = conv_norm_2d(outputs, outputs, Shape(3, 1, dilation))
        keeps_size = stride == 1 and inputs == outputs
        self.shortcut = None if keeps_size else conv_norm_2d(inputs, outputs, Shape(1, stride))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b k h2 w2"]:
        """Add what two convolutions see to the input."""
        shortcut = x if self.shortcut is None else self.shortcut(x)
        return self.second(F.relu(self.first(x))) + shortcut


def make_stage(inputs: int, outputs: int, count: int, shape: Shape) -> nn.Sequential:
    """Make ``count`` blocks of which the first changes the channels and the size."""
    first = Block(inputs, outputs, shape.stride, shape.dilation)
    rest = (Block(outputs, outputs, 1, shape.dilation) for _ in range(count - 1))
    return nn.Sequential(first, *rest)


class FeatureExtractor(nn.Module):
    """One view to ``width`` features for each pixel of a quarter-size grid."""

    def __init__(self, config: PSMNetConfig) -> None:
        super().__init__()
        c = config.width
        self.align_corners = config.align_corners
        self.pools = config.pools
        self.stem = nn.ModuleList(
            [conv_norm_2d(3, c, Shape(3, 2)), conv_norm_2d(c, c), conv_norm_2d(c, c)]
        )
        counts = config.blocks
        self.stages = nn.ModuleList(
            [
                make_stage(c, c, counts[0], PLAIN),
                make_stage(c, 2 * c, counts[1], Shape(3, 2)),
                make_stage(2 * c, 4 * c, counts[2], PLAIN),
                make_stage(4 * c, 4 * c, counts[3], Shape(3, 1, 2)),
            ]
        )
        self.pyramid = nn.ModuleList([conv_norm_2d(4 * c, c, Shape(1)) for _ in config.pools])
        self.fuse = conv_norm_2d((6 + len(config.pools)) * c, 4 * c)
        self.project = nn.Conv2d(4 * c, c, 1, bias=False)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c h4 w4"]:
        """Describe each pixel by its surroundings near and far."""
        x = image
        for layer in self.stem:
            x = F.relu(layer(x))
        raw = self.stages[1](self.stages[0](x))
        last = self.stages[3](self.stages[2](raw))
        levels = [self._pool(last, i) for i in reversed(range(len(self.pools)))]
        return self.project(F.relu(self.fuse(torch.cat([raw, last, *levels], 1))))

    def _pool(self, x: Float[Tensor, "b c h w"], level: int) -> Float[Tensor, "b k h w"]:
        pooled = F.relu(self.pyramid[level](F.avg_pool2d(x, self.pools[level])))
        return F.interpolate(
            pooled, size=x.shape[-2:], mode="bilinear", align_corners=self.align_corners
        )
