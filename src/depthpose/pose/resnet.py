"""The residual encoder of 18 layers (He et al. 2016), and the import of its published weights."""

from collections.abc import Mapping
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

KIND = "resnet18"
WIDTHS = (64, 128, 256, 512)
"""Channels of the four stages in the published network."""

Widths = tuple[int, int, int, int]
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet's colours in [0, 1]: what published weights expect to be taken off."""


class BasicBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut; the first may halve the size."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(
                nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)
            )

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d i j"]:
        """Add to what comes in, or to its projection; the answer is not negative."""
        branch = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        return F.relu(branch + (x if self.downsample is None else self.downsample(x)))


class ResNet18(nn.Module):
    """An image to features at 1/8, 1/16 and 1/32 of its size.

    Parts carry the names that published state dicts give them, so that those load as they are.
    """

    def __init__(self, inputs: int = 3, widths: Widths = WIDTHS) -> None:
        super().__init__()
        self.widths = widths
        self.conv1 = nn.Conv2d(inputs, widths[0], 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(widths[0])
        self.layer1 = _stage(widths[0], widths[0], 1)
        self.layer2 = _stage(widths[0], widths[1], 2)
        self.layer3 = _stage(widths[1], widths[2], 2)
        self.layer4 = _stage(widths[2], widths[3], 2)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(
        self, image: Float[Tensor, "b c h w"]
    ) -> tuple[Float[Tensor, "b c8 _ _"], Float[Tensor, "b c16 _ _"], Float[Tensor, "b c32 _ _"]]:
        """Give the features of the last three stages, the finest first."""
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(image))), 3, 2, 1)
        eighth = self.layer2(self.layer1(x))
        sixteenth = self.layer3(eighth)
        return eighth, sixteenth, self.layer4(sixteenth)


def normalise_colors(image: Float[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 3 h w"]:
    """Take ImageNet's mean off RGB in [0, 1], and divide by its spread."""
    mean, std = (image.new_tensor(values)[:, None, None] for values in (MEAN, STD))
    return (image - mean) / std


def resnet18_from_published(state: Mapping[str, Tensor]) -> ResNet18:
    """Make the encoder, in eval mode, from torchvision's state dict of a classifier on ImageNet.

    The classifier's own layer (``fc``) is left out, and so is ``module.``; all else must agree.

    Raises:
        InputError: a name is missing, unknown or holds another shape; nothing is half loaded.
    """
    given = {name.removeprefix("module."): value for name, value in state.items()}
    for name in ("fc.weight", "fc.bias"):
        given.pop(name, None)
    network = ResNet18()
    # The count of batches steers nothing at inference, and old files do not hold it.
    spare = {k: t for k, t in network.state_dict().items() if k.endswith("num_batches_tracked")}
    load_weights(network, Checkpoint(kind=KIND, config={}, state={**spare, **given}), KIND)
    return network.eval()


def import_resnet18(file: Path, out: Path) -> None:
    """Turn published weights of ImageNet into an encoder that trainings can start from.

    Args:
        file: a ``.pth`` of tensors, read without running any code in it, or ``.safetensors``.
        out: the ``.safetensors`` file to write.

    Raises:
        InputError: not the weights of such a network.
    """
    state = read_published(file, "ResNet-18")
    try:
        network = resnet18_from_published(state)
    except InputError as error:
        raise InputError(f"{file}: not the published weights of a ResNet-18: {error}") from error
    said = {
        "trained_on": "ImageNet, as its publisher says",
        "licence": "as published by its authors",
    }
    save_imported(out, KIND, network, file, said)


def read_encoder_state(path: Path) -> Mapping[str, Tensor]:
    """Read the tensors that :func:`import_resnet18` wrote, for a network to start from.

    Raises:
        InputError: no such weights.
    """
    return read_checkpoint(path, KIND).state


def _stage(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(BasicBlock(inputs, outputs, stride), BasicBlock(outputs, outputs, 1))
