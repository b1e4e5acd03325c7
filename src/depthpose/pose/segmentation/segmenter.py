"""One image to the masks of its objects, and their intersection over union over many images."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Int64
from scipy import ndimage
from torch import Tensor

from depthpose.core.arrays import Image, check_image
from depthpose.core.checkpoint import find_weights, warn_of_terms
from depthpose.core.devices import usable_device
from depthpose.pose.resnet import normalise_colors
from depthpose.pose.segmentation.network import (
    FCN,
    SegmentationConfig,
    SegmentationWeights,
    read_segmentation,
)

_MULTIPLE = 32


@dataclass(frozen=True, kw_only=True, eq=False)
class Segmentation:
    """What one image shows.

    Attributes:
        masks: of the instances of each object that was found, the surest first; an object that was
            not found has no entry.
        scores: mean probability of the object over each of those masks, 0..1.
    """

    masks: Mapping[str, Bool[Tensor, "n h w"]]
    scores: Mapping[str, Float[Tensor, " n"]]

    def best(self, object: str) -> Bool[Tensor, "h w"] | None:
        """Give the surest mask of an object; None where it was not found."""
        found = self.masks.get(object)
        return None if found is None else found[0]


class Segmenter:
    """Finds known objects in an image: sizes, colours and connected parts are its concern.

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
            InputError: there is no such file, or it holds something else.
        """
        weights = read_segmentation(find_weights(name))
        warn_of_terms(weights.facts)
        return cls(weights, device)

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of what it knows."""
        return self.weights.objects

    def segment(self, image: Image) -> Segmentation:
        """Find the objects of an image of any size, a tensor of RGB in [0, 1] (not OpenCV's BGR).

        Raises:
            InputError: it is no such image.
        """
        check_image(image, "the image")
        probability = class_probabilities(self._network, image)
        label = probability.argmax(0)
        config = self._network.config
        masks: dict[str, Tensor] = {}
        scores: dict[str, Tensor] = {}
        for number, name in enumerate(self.objects, 1):
            parts = connected_parts(label == number, config)
            if len(parts):
                score = torch.stack([probability[number][part].mean() for part in parts])
                order = score.argsort(descending=True)
                masks[name], scores[name] = parts[order], score[order]
        return Segmentation(masks=masks, scores=scores)


@torch.no_grad()
def class_probabilities(network: FCN, image: Image) -> Float[Tensor, "classes h w"]:
    """Give the probability of background and objects at each pixel of an image of any size.

    The image is brought to the network's long side, both sides padded at the bottom and right to
    multiples of 32 by its last rows and columns; the logits are cut and brought back.
    """
    device = next(network.parameters()).device
    height, width = image.shape[-2:]
    scale = network.config.long_side_px / max(height, width)
    size = tuple(max(1, math.floor(side * scale + 0.5)) for side in (height, width))
    small = resize_image(image.to(device), (size[0], size[1]))
    bottom, right = (-side % _MULTIPLE for side in size)
    padded = F.pad(normalise_colors(small)[None], (0, right, 0, bottom), mode="replicate")
    logits = network(padded)[..., : size[0], : size[1]]
    logits = F.interpolate(logits, (height, width), mode="bilinear", align_corners=False)
    return logits[0].float().softmax(0).cpu()


def resize_image(image: Image, size: tuple[int, int]) -> Float[Tensor, "3 rows columns"]:
    """Resize an image to (rows, columns), averaging where it shrinks."""
    if tuple(image.shape[-2:]) == size:
        return image
    return F.interpolate(image[None], size, mode="bilinear", antialias=True)[0].clamp(0, 1)


def connected_parts(mask: Bool[Tensor, "h w"], config: SegmentationConfig) -> Bool[Tensor, "n h w"]:
    """Split a mask into parts whose pixels touch; those that are large enough.

    With one instance an image, the largest alone.
    """
    label, pixels = label_parts(mask)
    least = max(1, math.ceil(config.min_share * mask.numel()))
    large = (pixels >= least).nonzero()[:, 0]
    if config.with_one_instance and len(large):
        large = pixels.argmax()[None]
    return label == large[:, None, None]


def label_parts(mask: Bool[Tensor, "h w"]) -> tuple[Int64[Tensor, "h w"], Int64[Tensor, " n"]]:
    """Number the parts of a mask whose pixels touch, at corners too.

    Returns:
        The number of each pixel's part, 0 beside the mask; and by number how many pixels a part
        has, 0 for number 0.
    """
    numbered = np.empty(mask.shape, np.int32)
    ndimage.label(mask.cpu().numpy(), structure=[[1] * 3] * 3, output=numbered)
    label = torch.from_numpy(numbered).long()
    pixels = torch.bincount(label.flatten(), minlength=1)
    pixels[0] = 0
    return label, pixels


class Overlap:
    """Counts pixels of each class that are found, true and both, over all images given.

    Args:
        classes: background and objects.
    """

    def __init__(self, classes: int) -> None:
        self.both = torch.zeros(classes, dtype=torch.int64)
        self.either = torch.zeros(classes, dtype=torch.int64)

    def add(self, found: Int[Tensor, "*b h w"], truth: Int[Tensor, "*b h w"]) -> None:
        """Count one image, or a batch."""
        classes = len(self.both)
        pairs = (truth * classes + found).flatten().cpu()
        table = torch.bincount(pairs, minlength=classes**2).view(classes, classes)
        self.both += table.diagonal()
        self.either += table.sum(0) + table.sum(1) - table.diagonal()

    def iou(self) -> Float[Tensor, " classes"]:
        """Intersection over union of each class; NaN for one that is neither found nor true."""
        return torch.where(self.either > 0, self.both / self.either, torch.nan)
