"""FCN (Long, Shelhamer and Darrell, CVPR 2015) on a residual encoder.

With its settings and its weights on disk, which hold the names of its objects.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.checkpoint import (
    Checkpoint,
    build_network,
    half_state,
    read_checkpoint,
    save_checkpoint,
)
from depthpose.core.config import config_from_dict, config_to_dict
from depthpose.core.config_values import check_settings
from depthpose.core.errors import InputError
from depthpose.pose.resnet import ResNet18


@dataclass(frozen=True, kw_only=True)
class SegmentationConfig:
    """The network, how an image is brought to it, and what becomes of its answer."""

    stride: Literal[8, 16, 32] = 8
    """FCN-8s, 16s or 32s: stride in pixels of the finest features that are used."""

    widths: tuple[int, int, int, int] = (64, 128, 256, 512)
    """Channels of the encoder's stages; published weights have these."""

    long_side_px: int = 640
    """Images are brought to this long side before the network, up or down, and the answer is
    brought back."""

    with_one_instance: bool = True
    """An image shows each object once: the largest connected part is kept, the others are errors.
    Else each connected part is an instance."""

    min_share: float = 0.0005
    """Parts below this share of the image's pixels are no object (150 pixels of 640x480)."""

    def __post_init__(self) -> None:
        """Refuse sizes that the network cannot have."""
        check_settings(self, widths="[1, inf)", long_side_px="[32, inf)", min_share="[0, 1)")


class FCN(nn.Module):
    """An image to the logits of background and objects at each of its pixels.

    Each level scores classes by a 1x1 convolution; the coarse scores are enlarged twice by a
    learned convolution that begins bilinear, and added to the next finer ones, which begin at zero
    (section 4.1 of the paper). The last enlargement, to pixels, is bilinear and fixed.
    """

    def __init__(self, objects: int, config: SegmentationConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or SegmentationConfig()
        self.classes = classes = objects + 1
        self.encoder = ResNet18(widths=config.widths)
        levels = {8: 3, 16: 2, 32: 1}[config.stride]
        coarsest_first = config.widths[:0:-1][:levels]
        self.scores = nn.ModuleList(nn.Conv2d(width, classes, 1) for width in coarsest_first)
        self.enlarge = nn.ModuleList(_bilinear_twice(classes) for _ in range(levels - 1))
        for score in self.scores[1:]:
            for parameter in score.parameters():
                nn.init.zeros_(parameter)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b classes h w"]:
        """Give logits, background first; both sides of the image are multiples of 32.

        Colours have ImageNet's mean and spread taken off
        (``pose.resnet.normalise_colors``).
        """
        features = self.encoder(image)[::-1]
        found = self.scores[0](features[0])
        for enlarge, score, finer in zip(
            self.enlarge, self.scores[1:], features[1 : len(self.scores)], strict=True
        ):
            found = enlarge(found) + score(finer)
        size = (image.shape[-2], image.shape[-1])
        return F.interpolate(found, size, mode="bilinear", align_corners=False)


def _bilinear_twice(classes: int) -> nn.ConvTranspose2d:
    """Make a learned enlargement that begins as the bilinear one, each class by itself."""
    layer = nn.ConvTranspose2d(classes, classes, 4, 2, 1, bias=False)
    ramp = torch.tensor([0.25, 0.75, 0.75, 0.25])
    with torch.no_grad():
        layer.weight.zero_()
        every = torch.arange(classes)
        layer.weight[every, every] = ramp[:, None] * ramp
    return layer


KIND = "segmentation"


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentationWeights:
    """What a weights file of this kind holds.

    Attributes:
        network: in eval mode; class 0 is the background, class ``1 + i`` is ``objects[i]``.
        objects: names, in the order of the classes.
        numbers: BOP's ``obj_id`` of each.
        facts: the card in short: ``trained_on``, ``licence`` and the like.
    """

    network: FCN
    objects: tuple[str, ...]
    numbers: tuple[int, ...]
    facts: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        assert len(self.objects) == len(self.numbers) == self.network.classes - 1


def write_segmentation(
    path: Path, weights: SegmentationWeights, *, with_half: bool = False
) -> None:
    """Write a network with its config and objects to one ``.safetensors`` file.

    Args:
        path: where to.
        weights: what to write.
        with_half: store 16-bit floats: half the size.
    """
    config = {
        "network": config_to_dict(weights.network.config),
        "objects": list(weights.objects),
        "numbers": list(weights.numbers),
    }
    network = weights.network
    state = half_state(network) if with_half else network.state_dict()
    save_checkpoint(path, Checkpoint(kind=KIND, config=config, state=state, facts=weights.facts))


def read_segmentation(path: Path) -> SegmentationWeights:
    """Read what :func:`write_segmentation` wrote.

    Raises:
        InputError: no such weights, or weights that do not fit their own config.
    """
    checkpoint = read_checkpoint(path, KIND)
    config = config_from_dict(checkpoint.config, _FileConfig, source=str(path))
    if len(config.objects) != len(config.numbers) or not config.objects:
        raise InputError(
            f"{path}: its config names {len(config.objects)} objects and {len(config.numbers)} "
            "numbers; each object has both. Export it again."
        )
    count, network_config = len(config.objects), config.network
    network = build_network(lambda: FCN(count, network_config), checkpoint, str(path))
    return SegmentationWeights(
        network=network.eval(),
        objects=config.objects,
        numbers=config.numbers,
        facts=checkpoint.facts,
    )


@dataclass(frozen=True)
class _FileConfig:
    network: SegmentationConfig = dataclasses.field(default_factory=SegmentationConfig)
    objects: tuple[str, ...] = ()
    numbers: tuple[int, ...] = ()
