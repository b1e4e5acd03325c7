"""The networks as matchers: folded weights, memory, and the kinds that weights files name.

Batch norm is folded into the convolution before it: the same function, one pass less.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.depth.config import LightConfig, MatcherConfig, PSMNetConfig
from depthpose.depth.stereo.light import LightStereo
from depthpose.depth.stereo.matcher import Matcher, NetworkMatcher, StereoNetwork
from depthpose.depth.stereo.psmnet import CHUNK_BYTES, ConvNorm, PSMNet, expected_disparity
from depthpose.depth.types import Match, Views

MARGIN = 1.1
"""Allocators keep gaps: measured peaks stay below the sum of the tensors times this ..."""

OVERHEAD_BYTES = 128 << 20
"""... plus this, which the first convolutions take for themselves whatever the size."""


PSMNET_ROWS, LIGHT_ROWS = 32, 16
"""Rows at quarter size that are computed at a time."""


def psmnet_bytes(
    config: PSMNetConfig, height: int, width: int, dtype: torch.dtype, rows: int = PSMNET_ROWS
) -> int:
    """Peak memory of activations of one padded pair [bytes], with margin for the allocator.

    Two volumes of the largest size are held whole; ``rows`` at quarter size are computed at a time.
    """
    h, w = height // 4, width // 4
    row_bytes = config.width * w * dtype.itemsize
    map_bytes = row_bytes * h
    bins = config.max_disparity_px // 4
    volume_bytes = map_bytes * bins

    slab2_bytes, slab4_bytes = (min(rows + 2 * halo, h) * row_bytes * bins for halo in (2, 4))
    levels = 6 + len(config.pools)
    cost_bytes = 4 * bins * h * w
    # Costs are computed in float32.
    head_slabs = 2 if dtype.itemsize >= 4 else 4
    stages = (
        # Five half-size maps in the first stage; joined levels, twice, in the last.
        2 * map_bytes * max(5 * 4, 2 * levels + 12),
        # ``cost0``; of some rows the concatenation, and what a convolution makes of it.
        volume_bytes + 2 * map_bytes + 3 * slab4_bytes,
        # ``cost0``, what is added to it, three half-size volumes; some rows in the head.
        2 * volume_bytes + 3 * volume_bytes // 4 + head_slabs * slab2_bytes + 3 * cost_bytes,
        4 * cost_bytes + 16 * height * width + 5 * CHUNK_BYTES,
    )
    return int(MARGIN * max(stages)) + OVERHEAD_BYTES


def light_bytes(
    config: LightConfig, height: int, width: int, dtype: torch.dtype, rows: int = LIGHT_ROWS
) -> int:
    """Peak memory of activations of one padded pair [bytes], with margin for the allocator.

    One volume of the largest size is held whole; ``rows`` at quarter size are computed at a time.
    """
    pixels = height * width // 16
    slab_pixels = min((rows + 4) * width // 4, pixels)
    halves = 2 if config.with_agreement or config.with_refinement else 1
    kept = pixels * (halves * 4 * 16 + 3 * config.width) * dtype.itemsize
    # Both views in float32: at this size, normalised, padded.
    images = 6 * 3 * 4 * height * width
    # A volume at quarter size, the smaller ones, and three of the rows at a time.
    widest = max(config.groups, config.volume_widths[0])
    voxel_bytes = widest * (config.max_disparity_px // 4) * dtype.itemsize
    volumes = voxel_bytes * (7 * pixels // 4 + 3 * slab_pixels)
    # Weights that enlarge maps, thrice, and what they are made of at half size; the refinement
    # takes less.
    joined = 4 * (16 + config.width + 32) * dtype.itemsize
    compared = 4 * (4 * 16 + 9 + 3 * 9) * 4 if config.with_agreement else 0
    weights = slab_pixels * (joined + compared + 3 * 4 * 36 * 4)
    return int(MARGIN * (images + kept + max(volumes, weights))) + OVERHEAD_BYTES // 2


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
    for parent in list(features.modules()):
        for name, layer in list(parent.named_children()):
            if isinstance(getattr(layer, "norm", None), nn.BatchNorm2d):
                weight, bias = folded_weight(layer)
                conv = cast("nn.Conv2d", layer.conv)
                conv.weight.data = weight
                conv.bias = nn.Parameter(bias)
                layer.norm = nn.Identity()
                if isinstance(layer, ConvNorm):  # which then is its convolution
                    setattr(parent, name, conv)
    for parameter in features.parameters():
        values = parameter.data.to(like)
        order = torch.channels_last if values.ndim == 4 else torch.contiguous_format
        parameter.data = values.contiguous(memory_format=order)
        parameter.requires_grad_(False)
    return features


def fold_volumes(module: ModuleT, like: Tensor) -> ModuleT:
    """Fold every batch norm after a 3D convolution, in place; oneDNN is called by name after it.

    So it is in 3D convolutions without a norm.
    """
    for parent in list(module.modules()):
        for name, layer in list(parent.named_children()):
            if isinstance(layer, ConvNorm) and isinstance(layer.norm, nn.BatchNorm3d):
                setattr(parent, name, VolumeConv(layer.conv, *folded_weight(layer), like))
            elif isinstance(layer, nn.Conv3d) and not isinstance(parent, ConvNorm):
                bias = torch.zeros(layer.out_channels) if layer.bias is None else layer.bias
                setattr(parent, name, VolumeConv(layer, layer.weight, bias, like))
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
        is_usable = volume.device.type == "cpu" and volume.dtype in (torch.float32, torch.bfloat16)
        # oneDNN is called by name: PyTorch's own choice takes a slow path for few rows.
        by_name = is_usable and has_onednn_operators()
        if self.is_transposed:
            if by_name:
                return _onednn_transposed(volume, self.weight, self.bias)
            return F.conv_transpose3d(volume, self.weight, self.bias, 2, 1, 1)
        if by_name:
            return _onednn_convolved(volume, self.weight, self.bias, self.stride)
        return F.conv3d(volume, self.weight, self.bias, self.stride, 1)


def _onednn_convolved(volume: Tensor, weight: Tensor, bias: Tensor, stride: int) -> Tensor:
    ones, strides = (1, 1, 1), (stride,) * 3
    return torch.mkldnn_convolution(volume, weight, bias, ones, strides, ones, 1)


def _onednn_transposed(volume: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    ones, twos = (1, 1, 1), (2, 2, 2)
    args = (volume, weight, bias, ones, ones, twos, ones, 1, "none", [], "")
    return torch.ops.mkldnn._convolution_transpose_pointwise(*args)


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
            convolved = _onednn_convolved(volume, weight, bias, 1)
            transposed = _onednn_transposed(volume, weight, bias)
    except (AttributeError, RuntimeError, TypeError):
        return False
    both = (
        (convolved, F.conv3d(volume, weight, bias, 1, 1)),
        (transposed, F.conv_transpose3d(volume, weight, bias, 2, 1, 1)),
    )
    return all(one.shape == other.shape and torch.allclose(one, other) for one, other in both)


class PSMNetMatcher(NetworkMatcher):
    """PSMNet with pre- and post-processing, as :class:`NetworkMatcher` says."""

    fine_pixels = 280_000
    """Pixels of a fine match at most: an image of KITTI at three quarters of its resolution."""

    def fold(self, network: PSMNet, like: Tensor) -> PSMNet:
        """Fold batch norm, and compute some rows at a time."""
        for head in network.heads:
            # In float32 at least: 8 bits would round the expectation to whole pixels.
            cost, wide = cast("nn.Conv3d", head.cost), torch.empty(0, device=self.device)
            head.cost = VolumeConv(cost, cost.weight, torch.zeros(1), wide)
        fold_volumes(network, like)
        fold_features(network.features, like)
        network.rows = PSMNET_ROWS
        return network

    def activation_bytes(self, network: PSMNetConfig, height: int, width: int) -> int:
        """Peak memory of activations of one pair of suitable sides [bytes]."""
        return psmnet_bytes(network, height, width, self.dtype)

    def run(self, left: Views, right: Views, network: PSMNetConfig) -> list[Match]:
        """Match normalised pairs whose sides suit the network."""
        near, far = (one.to(self.dtype, memory_format=torch.channels_last) for one in (left, right))
        costs = self._network.costs(near, far, network.max_disparity_px)[-1][:, 0]
        found = [
            expected_disparity(
                cost.permute(1, 2, 0).contiguous(),
                (network.max_disparity_px, *left.shape[-2:]),
                align_corners=network.align_corners,
                with_confidence=self.config.with_confidence,
            )
            for cost in costs
        ]
        return [Match(disparity_px=d, confidence=c) for d, c in found]


class LightMatcher(NetworkMatcher):
    """The light network with pre- and post-processing, as :class:`NetworkMatcher` says."""

    fine_pixels = 650_000
    """Pixels of a fine match at most: an image of KITTI, enlarged 1.18 times."""
    most_enlarged = 1.5
    most_disparities = 1.75

    def fold(self, network: LightStereo, like: Tensor) -> LightStereo:
        """Fold batch norm, and compute some rows at a time."""
        # A GPU has the memory, and is busy with whole volumes alone.
        network.rows = LIGHT_ROWS if self.device.type == "cpu" else None
        return fold_features(fold_volumes(network, like), like)

    def activation_bytes(self, network: LightConfig, height: int, width: int) -> int:
        """Peak memory of activations of one pair of suitable sides [bytes]."""
        rows = self._network.rows or height // 4
        return light_bytes(network, height, width, self.dtype, rows)

    def run(self, left: Views, right: Views, network: LightConfig) -> list[Match]:
        """Match normalised pairs whose sides suit the network."""
        read = self._network.read(
            left.to(self.dtype),
            right.to(self.dtype),
            network.max_disparity_px,
            with_confidence=self.config.with_confidence,
        )
        nothing = [None] * len(left)
        sure = nothing if read.confidence is None else read.confidence
        sky = nothing if read.sky is None else read.sky > 0.5
        parts = zip(read.heads[-1], sure, sky, strict=True)
        return [Match(disparity_px=d, confidence=c, is_sky=s) for d, c, s in parts]


@dataclass(frozen=True, kw_only=True)
class MatcherKind:
    """What it takes to read, write and run one kind of matcher.

    Attributes:
        config: dataclass of the network's sizes and conventions, which its weights file holds.
        network: makes the module of a config, and keeps it as the attribute ``config``.
        matcher: makes a matcher of a module in eval mode.
    """

    config: type
    network: type[StereoNetwork]
    matcher: Callable[[Any, MatcherConfig], Matcher]


MATCHERS = {
    "psmnet": MatcherKind(config=PSMNetConfig, network=PSMNet, matcher=PSMNetMatcher),
    "light": MatcherKind(config=LightConfig, network=LightStereo, matcher=LightMatcher),
}
"""Kinds of matchers with weights: a new one is a file with its three parts and one entry here."""


def make_matcher(network: StereoNetwork, config: MatcherConfig) -> Matcher:
    """Make the matcher of a network of any kind.

    Raises:
        InputError: no kind has such a network.
    """
    for kind in MATCHERS.values():
        if isinstance(network, kind.network):
            return kind.matcher(network, config)
    raise InputError(
        f"{type(network).__name__} is no network of a matcher; known are {', '.join(MATCHERS)}"
    )
