"""PSMNet, stacked hourglass: a rectified pair to disparity (Chang and Chen, CVPR 2018).

The features of one view come first: residual layers and a spatial pyramid, at 1/4 size.
"""

from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.depth.config import PSMNetConfig
from depthpose.depth.stereo.network_matcher import Maps, StereoNetwork
from depthpose.depth.stereo.volume import by_rows


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
        """Give features of each pixel with local and global context."""
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


Features = Float[Tensor, "b _ _ _"]
Volume = Float[Tensor, "b _ _ _ _"]


def conv_norm_3d(inputs: int, outputs: int, stride: int = 1) -> ConvNorm:
    """Make a 3x3x3 convolution with batch norm."""
    conv = nn.Conv3d(inputs, outputs, 3, stride, 1, bias=False)
    return ConvNorm(conv, nn.BatchNorm3d(outputs))


def deconv_norm_3d(inputs: int, outputs: int) -> ConvNorm:
    """Make a transposed 3x3x3 convolution that doubles the size, with batch norm."""
    conv = nn.ConvTranspose3d(inputs, outputs, 3, 2, 1, output_padding=1, bias=False)
    return ConvNorm(conv, nn.BatchNorm3d(outputs))


class Hourglass(nn.Module):
    """Down to a quarter of the volume and back, to let far evidence reach each voxel."""

    def __init__(self, c: int) -> None:
        super().__init__()
        self.down1 = conv_norm_3d(c, 2 * c, stride=2)
        self.same1 = conv_norm_3d(2 * c, 2 * c)
        self.down2 = conv_norm_3d(2 * c, 2 * c, stride=2)
        self.same2 = conv_norm_3d(2 * c, 2 * c)
        self.up2 = deconv_norm_3d(2 * c, 2 * c)
        self.up1 = deconv_norm_3d(2 * c, c)

    def forward(
        self, x: Volume, first: Volume | None, before: Volume | None
    ) -> tuple[Volume, Volume]:
        """Answer the half-size volumes going down and coming up, between ``down1`` and ``up1``.

        Args:
            x: what ``down1`` made of the volume that the hourglass refines; it is overwritten.
            first: half-size volume of the first hourglass going down; None in the first itself.
            before: half-size volume of the hourglass before, coming up; None in the first.
        """
        down = self.same1(x.relu_())
        down = (down if before is None else down.add_(before)).relu_()
        up = self.up2(self.same2(self.down2(down).relu_()).relu_())
        return down, up.add_(down if first is None else first).relu_()


class Head(nn.Module):
    """Volume of features to one cost a voxel; a larger cost means a likelier match."""

    def __init__(self, c: int) -> None:
        super().__init__()
        self.hidden = conv_norm_3d(c, c)
        self.cost = nn.Conv3d(c, 1, 3, 1, 1, bias=False)

    def forward(self, x: Volume) -> Volume:
        """Score each voxel."""
        return self.cost(self.hidden(x).relu_())


def concatenation_volume(
    left: Float[Tensor, "b c h w"], right: Float[Tensor, "b c h w"], bins: int
) -> Volume:
    """Put left features beside the right ones that each disparity would match them with.

    Voxel ``(d, y, x)`` holds ``left[y, x]`` and ``right[y, x - d]``, or zeros where the right
    pixel falls outside the image.
    """
    b, c, h, w = left.shape
    volume = left.new_zeros(b, 2 * c, bins, h, w)
    for d in range(min(bins, w)):
        volume[:, :c, d, :, d:] = left[..., d:]
        volume[:, c:, d, :, d:] = right[..., : w - d]
    return volume


def soft_argmin(cost: Volume, size: tuple[int, int, int], *, align_corners: bool) -> Maps:
    """Enlarge the cost to ``size`` (disparities, rows, columns) and take the expected disparity.

    ``sum_d d softmax(cost)_d`` [px], eq. 2.2 of the thesis; costs are likelihoods here, so no
    sign stands before them.
    """
    if cost.dtype in (torch.bfloat16, torch.float16):
        cost = cost.float()  # 8 bits of mantissa would round the expectation to whole pixels
    full = F.interpolate(cost, size=size, mode="trilinear", align_corners=align_corners)[:, 0]
    disparity_px = torch.arange(size[0], dtype=full.dtype, device=full.device)
    return (full.softmax(1) * disparity_px[:, None, None]).sum(1)


class PSMNet(StereoNetwork):
    """Rectified pair to disparity: features, concatenation volume, three hourglasses, three heads.

    Images are RGB normalised by ImageNet's mean and deviation; both sides are multiples of 16 and
    at least ``config.min_side_px``. The default size has 5,224,768 parameters.

    Attributes:
        rows: at 1/4 size, that are computed at a time where something large would be held, with no
            gradient; None, as in training and in exported graphs: all.
    """

    rows: int | None = None

    def __init__(self, config: PSMNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or PSMNetConfig()
        c = self.config.width
        self.features = FeatureExtractor(self.config)
        self.dres0 = nn.ModuleList([conv_norm_3d(2 * c, c), conv_norm_3d(c, c)])
        self.dres1 = nn.ModuleList([conv_norm_3d(c, c), conv_norm_3d(c, c)])
        self.hourglasses = nn.ModuleList([Hourglass(c) for _ in range(3)])
        self.heads = nn.ModuleList([Head(c) for _ in range(3)])
        self.apply(_initialise)

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Maps, ...]:
        """Match the pair.

        Returns:
            Disparity of the left view [px], after each of the three hourglasses while training,
            after the last alone in eval mode. The last is always the answer.

        Raises:
            InputError: the images' size does not suit the network.
        """
        self._check_size(left)
        size = (self.config.max_disparity_px, left.shape[-2], left.shape[-1])
        costs = self.costs(left, right)
        align = self.config.align_corners
        return tuple(
            soft_argmin(cost, size, align_corners=align)
            for cost in (costs if self.training else costs[-1:])
        )

    def costs(
        self,
        left: Float[Tensor, "b 3 h w"],
        right: Float[Tensor, "b 3 h w"],
        max_disparity_px: int | None = None,
    ) -> tuple[Volume, Volume, Volume]:
        """Answer the quarter-size cost after each hourglass; each adds to the one before.

        ``max_disparity_px`` takes the place of the network's own: the same filters look over all
        disparities, so they can look farther than they did in training.
        """
        bins = (max_disparity_px or self.config.max_disparity_px) // 4

        def begin(left: Features, right: Features) -> Volume:
            return self._aggregate(concatenation_volume(left, right, bins))

        views = self.features(left), self.features(right)
        # Four convolutions follow each other.
        return self._costs_from(by_rows(begin, views, halo=4, rows=self.rows))

    def costs_of(self, volume: Volume) -> tuple[Volume, Volume, Volume]:
        """Answer the costs of a concatenation volume, however it was made."""
        return self._costs_from(self._aggregate(volume))

    def _aggregate(self, volume: Volume) -> Volume:
        x = self.dres0[0](volume).relu_()
        del volume
        x = self.dres0[1](x).relu_()
        return self.dres1[1](self.dres1[0](x).relu_()).add_(x)

    def _costs_from(self, cost0: Volume) -> tuple[Volume, Volume, Volume]:
        x, first, up, costs = cost0, None, None, []
        for module, head in zip(self.hourglasses, self.heads, strict=True):
            hourglass = cast("Hourglass", module)
            # Under the same name, so that one volume of the full size is held beside ``cost0``.
            x = hourglass.down1(x)
            down, up = hourglass(x, first, up)
            first = down if first is None else first
            del down
            x = hourglass.up1(up).add_(cost0)
            cost = by_rows(head, (x,), halo=2, rows=self.rows)
            costs.append(cost + costs[-1] if costs else cost)
        return cast("tuple[Volume, Volume, Volume]", tuple(costs))

    def _check_size(self, image: Float[Tensor, "b 3 h w"]) -> None:
        h, w = image.shape[-2:]
        least = self.config.min_side_px
        if h % 16 or w % 16 or min(h, w) < least:
            raise InputError(
                f"PSMNet takes sides that are multiples of 16 and at least {least} px, got "
                f"{h}x{w}; pad the pair, as PSMNetMatcher does"
            )


def _initialise(module: nn.Module) -> None:
    """Draw weights as the authors did: deconvolutions keep PyTorch's default."""
    if isinstance(module, nn.Conv2d | nn.Conv3d):
        taps = module.weight[0, 0].numel()
        nn.init.normal_(module.weight, 0, (2 / (taps * module.out_channels)) ** 0.5)
