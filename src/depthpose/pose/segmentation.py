"""Masks of known objects in a picture, by a network that was trained on them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from scipy import ndimage
from torch import Tensor

from depthpose.core.arrays import Image
from depthpose.core.checkpoint import (
    Checkpoint,
    build_network,
    find_weights,
    halve_state,
    read_checkpoint,
    save_checkpoint,
    warn_of_terms,
)
from depthpose.core.config import config_from_dict, config_to_dict
from depthpose.core.devices import usable_device
from depthpose.core.errors import InputError
from depthpose.core.files.images import check_image
from depthpose.pose.networks.fcn import FCN, SegmentationConfig, normalise_colors

KIND = "segmentation"  #: of files of segmentation weights


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentationWeights:
    """The contents of a weights file of this kind."""

    network: FCN  #: in eval mode; class 0 is the background, class ``1 + i`` is ``objects[i]``
    objects: tuple[str, ...]  #: names, in the order of the classes
    numbers: tuple[int, ...]  #: BOP's ``obj_id`` of each
    #: the card in short: ``trained_on``, ``licence`` and the like.
    facts: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        assert len(self.objects) == len(self.numbers) == self.network.classes - 1


@dataclass(frozen=True)
class _FileConfig:
    """The config in a file of segmentation weights."""

    network: SegmentationConfig = field(default_factory=SegmentationConfig)  #: of the network
    objects: tuple[str, ...] = ()  #: names, in the order of the classes
    numbers: tuple[int, ...] = ()  #: BOP's ``obj_id`` of each


def write_segmentation(
    path: Path, weights: SegmentationWeights, *, with_half: bool = False
) -> None:
    """Write a network with its config and objects to one ``.safetensors`` file.

    ``with_half`` stores 16-bit floats: half the size.
    """
    network = weights.network
    config = {
        "network": config_to_dict(network.config),
        "objects": list(weights.objects),
        "numbers": list(weights.numbers),
    }
    state = halve_state(network) if with_half else network.state_dict()
    save_checkpoint(path, Checkpoint(kind=KIND, config=config, state=state, facts=weights.facts))


@dataclass(frozen=True, kw_only=True, eq=False)
class Segmentation:
    """The objects that were found in an image."""

    #: of the instances of each object, by its name, the highest score first; an object that was
    #: not found has no entry.
    masks: Mapping[str, Bool[Tensor, "n h w"]]
    scores: Mapping[str, Float[Tensor, " n"]]  #: mean probability of the object on each mask, 0..1


class Segmenter:
    """Segments known objects in images of any size.

    ::

        masks = Segmenter.load("segmentation.safetensors").segment(image).masks
    """

    def __init__(self, weights: SegmentationWeights, device: torch.device | str = "cpu") -> None:
        self.weights = weights
        self.device = usable_device(device)
        self._network = weights.network.eval().to(self.device)

    @classmethod
    def load(cls, name: str | Path, device: torch.device | str = "cpu") -> "Segmenter":
        """Load weights by path, or by the name of weights that came with the package.

        Raises:
            InputError: there is no such file, or it holds something else, or weights that do not
                fit their own config.
        """
        path = find_weights(name)
        checkpoint = read_checkpoint(path, KIND)
        config = config_from_dict(checkpoint.config, _FileConfig, source=str(path))
        classes = len(config.objects)
        if classes != len(config.numbers) or not classes:
            raise InputError(
                f"{path}: its config names {classes} objects and {len(config.numbers)} numbers; "
                "each object has both. Export it again."
            )
        network = build_network(lambda: FCN(classes, config.network), checkpoint, str(path))
        weights = SegmentationWeights(network=network.eval(), objects=config.objects,
                                      numbers=config.numbers, facts=checkpoint.facts)  # fmt: skip
        warn_of_terms(weights.facts)
        return cls(weights, device)

    def segment(self, image: Image) -> Segmentation:
        """Find the objects of an image of any size, a tensor of RGB in [0, 1] (not OpenCV's BGR).

        Raises:
            InputError: the tensor is no such image.
        """
        check_image(image, "the image")
        probability = predict_probabilities(self._network, image)
        label = probability.argmax(0)
        config = self._network.config
        masks: dict[str, Tensor] = {}
        scores: dict[str, Tensor] = {}
        for number, name in enumerate(self.weights.objects, 1):
            parts = find_connected_parts(label == number, config)
            if len(parts):
                score = torch.stack([probability[number][part].mean() for part in parts])
                order = score.argsort(descending=True)
                masks[name] = parts[order]
                scores[name] = score[order]
        return Segmentation(masks=masks, scores=scores)


@torch.no_grad()
def predict_probabilities(network: FCN, image: Image) -> Float[Tensor, "classes h w"]:
    """Predict the probability of background and objects at each pixel of an image of any size.

    The image is resized to the network's long side, and padded at the bottom and right to multiples
    of 32 by its last rows and columns. The logits are cropped and resized back.
    """
    # Resized to the network's long side.
    device = next(network.parameters()).device
    height, width = image.shape[-2:]
    scale = network.config.long_side_px / max(height, width)
    size = (max(1, math.floor(height * scale + 0.5)), max(1, math.floor(width * scale + 0.5)))
    small = image.to(device)
    if size != (height, width):
        small = F.interpolate(small[None], size, mode="bilinear", antialias=True)[0].clamp(0, 1)

    # Padded for the network, and cropped and resized back.
    bottom = -size[0] % 32
    right = -size[1] % 32
    padded = F.pad(normalise_colors(small)[None], (0, right, 0, bottom), mode="replicate")
    logits = network(padded)[..., : size[0], : size[1]]
    logits = F.interpolate(logits, (height, width), mode="bilinear", align_corners=False)
    return logits[0].float().softmax(0).cpu()


def find_connected_parts(
    mask: Bool[Tensor, "h w"], config: SegmentationConfig
) -> Bool[Tensor, "n h w"]:
    """Find the connected parts of a mask that are large enough, or the largest of them alone.

    Args:
        mask: the pixels of an object.
        config: ``min_share``, and ``with_one_instance`` for the largest alone.

    Returns:
        A mask for each part.
    """
    label, pixels = label_parts(mask)
    least_px = max(1, math.ceil(config.min_share * mask.numel()))
    kept = (pixels >= least_px).nonzero()[:, 0]
    if config.with_one_instance and len(kept):
        kept = pixels.argmax()[None]
    return label == kept[:, None, None]


def label_parts(mask: Bool[Tensor, "h w"]) -> tuple[Int64[Tensor, "h w"], Int64[Tensor, " n"]]:
    """Label the connected parts of a mask; pixels that touch at a corner are connected.

    Returns:
        The label of each pixel, 0 outside the mask; and the number of pixels of each label, 0 for
        label 0.
    """
    numbered = np.empty(mask.shape, np.int32)
    ndimage.label(mask.cpu().numpy(), structure=[[1] * 3] * 3, output=numbered)
    label = torch.from_numpy(numbered).long()
    pixels = torch.bincount(label.flatten(), minlength=1)
    pixels[0] = 0
    return label, pixels
