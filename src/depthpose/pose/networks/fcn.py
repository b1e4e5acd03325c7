"""Image to classes of pixels: FCN (Long et al., CVPR 2015) over a residual encoder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.arrays import IMAGENET_MEAN, IMAGENET_STD
from depthpose.core.checkpoint import (
    Checkpoint,
    load_weights,
    read_published,
    save_imported,
)
from depthpose.core.config import Settings
from depthpose.core.errors import InputError

ENCODER_KIND = "resnet18"  #: of files with the encoder alone
WIDTHS = (64, 128, 256, 512)  #: channels of the four stages in the published network

Widths = tuple[int, int, int, int]  #: channels of the four stages of an encoder


class BasicBlock(nn.Module):
    """A residual block: two 3x3 convolutions beside a shortcut; the first may halve the size."""

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
        """Add the branch to the input, or to its projection, and apply ReLU."""
        inner = F.relu(self.bn1(self.conv1(x)))
        branch = self.bn2(self.conv2(inner))
        shortcut = x if self.downsample is None else self.downsample(x)
        return F.relu(branch + shortcut)


class ResNet18(nn.Module):
    """A network from an image to features at 1/8, 1/16 and 1/32 of its size (He et al. 2016).

    Its modules have the names of torchvision's state dict, so that it loads unchanged.
    """

    def __init__(self, inputs: int = 3, widths: Widths = WIDTHS) -> None:
        super().__init__()
        self.widths = widths
        self.conv1 = nn.Conv2d(inputs, widths[0], 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(widths[0])
        input_widths = (widths[0], *widths[:3])
        self.layer1, self.layer2, self.layer3, self.layer4 = (
            nn.Sequential(BasicBlock(inputs, width, stride), BasicBlock(width, width, 1))
            for inputs, width, stride in zip(input_widths, widths, (1, 2, 2, 2), strict=True)
        )
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(
        self, image: Float[Tensor, "b c h w"]
    ) -> tuple[Float[Tensor, "b c8 _ _"], Float[Tensor, "b c16 _ _"], Float[Tensor, "b c32 _ _"]]:
        """Compute the features of the last three stages, the finest first."""
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(image))), 3, 2, 1)
        eighth = self.layer2(self.layer1(x))
        sixteenth = self.layer3(eighth)
        return eighth, sixteenth, self.layer4(sixteenth)


def normalise_colors(image: Float[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 3 h w"]:
    """Subtract ImageNet's mean from RGB in [0, 1], and divide by its standard deviation."""
    mean = image.new_tensor(IMAGENET_MEAN)[:, None, None]
    std = image.new_tensor(IMAGENET_STD)[:, None, None]
    return (image - mean) / std


def import_resnet18(file: Path, out: Path) -> None:
    """Convert torchvision's weights of ImageNet to an encoder that trainings can start from.

    The layer of the classifier (``fc``) is left out, and so is the prefix ``module.`` of names; all
    else must agree.

    Args:
        file: a ``.pth`` of tensors, read without running any code in it, or ``.safetensors``.
        out: path of the encoder's weights.

    Raises:
        InputError: not the weights of such a network; nothing is written.
    """
    published = read_published(file, "ResNet-18")
    tensors = {name.removeprefix("module."): value for name, value in published.items()}
    tensors = {name: value for name, value in tensors.items() if not name.startswith("fc.")}
    network = ResNet18()
    # The count of batches is not used at inference, and old files do not hold it.
    state = network.state_dict()
    counts = {name: state[name] for name in state if name.endswith("num_batches_tracked")}
    checkpoint = Checkpoint(kind=ENCODER_KIND, config={}, state={**counts, **tensors})
    try:
        load_weights(network, checkpoint, ENCODER_KIND)
    except InputError as error:
        raise InputError(f"{file}: not the published weights of a ResNet-18: {error}") from error
    facts = {
        "trained_on": "ImageNet, as its publisher says",
        "licence": "as published by its authors",
    }
    save_imported(out, ENCODER_KIND, network.eval(), file, facts)


@dataclass(frozen=True, kw_only=True)
class SegmentationConfig(Settings):
    """Settings of the network, of its input image, and of the masks made of its output."""

    stride: Literal[8, 16, 32] = 8
    """FCN-8s, 16s or 32s: stride in pixels of the finest features that are used."""

    widths: Annotated[tuple[int, int, int, int], "[1, inf)"] = (64, 128, 256, 512)
    """Channels of the encoder's stages; published weights have these."""

    long_side_px: Annotated[int, "[32, inf)"] = 640
    """Images are resized to this long side before the network, up or down, and its output is
    resized back."""

    with_one_instance: bool = True
    """An image shows each object once: the largest connected part is kept, the others are errors.
    Else each connected part is an instance."""

    min_share: Annotated[float, "[0, 1)"] = 0.0005
    """Parts below this share of the image's pixels are no object (150 pixels of 640x480)."""


class FCN(nn.Module):
    """A network from an image to the logits of background and objects at each pixel.

    Each level scores classes by a 1x1 convolution. Coarse scores are upsampled by 2 by a learned
    convolution, initially bilinear, and added to the next finer ones, initially zero (section 4.1
    of the paper). The last upsampling, to pixels, is bilinear and fixed.
    """

    def __init__(self, objects: int, config: SegmentationConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or SegmentationConfig()
        self.classes = classes = objects + 1
        self.encoder = ResNet18(widths=config.widths)

        # Scores of each level that is used, and the upsampling between them.
        levels = {8: 3, 16: 2, 32: 1}[config.stride]
        coarsest_first = config.widths[:0:-1][:levels]
        self.scores = nn.ModuleList(nn.Conv2d(width, classes, 1) for width in coarsest_first)
        self.enlarge = nn.ModuleList(
            nn.ConvTranspose2d(classes, classes, 4, 2, 1, bias=False) for _ in range(levels - 1)
        )
        with torch.no_grad():
            for parameter in self.scores[1:].parameters():
                parameter.zero_()
            # Upsampling is initially bilinear, each class by itself.
            ramp = torch.tensor([0.25, 0.75, 0.75, 0.25])
            index = torch.arange(classes)
            for weight in self.enlarge.parameters():
                weight.zero_()
                weight[index, index] = ramp[:, None] * ramp

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b classes h w"]:
        """Compute the logits of each class, background first.

        Args:
            image: colours normalised by :func:`normalise_colors`; its sides are multiples of 32.
        """
        coarsest, *finer_levels = self.encoder(image)[::-1][: len(self.scores)]
        scores = self.scores[0](coarsest)
        for enlarge, score, finer in zip(self.enlarge, self.scores[1:], finer_levels, strict=True):
            scores = enlarge(scores) + score(finer)
        size = (image.shape[-2], image.shape[-1])
        return F.interpolate(scores, size, mode="bilinear", align_corners=False)
