"""Random changes that keep a stereo pair a stereo pair."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.depth.config import AugmentConfig

_LUMA = (0.299, 0.587, 0.114)


class TrainingPair(NamedTuple):
    """A pair on its way into a network: images in [0, 1], disparity [px] with NaN for unknown.

    ``right_px`` is the disparity of the right view, counted positive as well: what is truth after
    a flip.
    """

    left: Float[Tensor, "*b 3 h w"]
    right: Float[Tensor, "*b 3 h w"]
    left_px: Float[Tensor, "*b h w"]
    right_px: Float[Tensor, "*b h w"]


def augment(pair: TrainingPair, config: AugmentConfig, generator: torch.Generator) -> TrainingPair:
    """Scale, crop, perhaps mirror, and change the colours of a pair (thesis, 2.4.2)."""
    scaled = scale_pair(pair, _draw_scale(config, generator), config.crop_px)
    cropped = crop_pair(scaled, config.crop_px, generator)
    if float(torch.rand((), generator=generator)) < config.flip_share:
        cropped = flip_and_swap(cropped)
    return jitter_colors(cropped, config.jitter, generator)


def flip_and_swap(pair: TrainingPair) -> TrainingPair:
    """Mirror both views and swap them: the mirrored right view is the left one of a true pair.

    Truth of the new left view is the mirrored truth of the old right one, or none.
    """
    mirrored = [part.flip(-1) for part in (pair.right, pair.left, pair.right_px, pair.left_px)]
    return TrainingPair(*mirrored)


def scale_pair(pair: TrainingPair, scale: float, least_px: tuple[int, int]) -> TrainingPair:
    """Resize a pair to ``scale`` of its size (but ``least_px`` rows and columns at least).

    Both sides keep one ratio but for rounding; disparity is scaled by the ratio of the widths.
    It is resized by nearest neighbour, so that known and unknown never mix.
    """
    height, width = pair.left.shape[-2:]
    scale = max(scale, least_px[0] / height, least_px[1] / width)
    if scale == 1.0:
        return pair
    size = (max(math.floor(height * scale + 0.5), 1), max(math.floor(width * scale + 0.5), 1))
    images = [
        F.interpolate(i[None], size, mode="bilinear", antialias=scale < 1)[0].clamp(0, 1)
        for i in (pair.left, pair.right)
    ]
    ratio = size[1] / width
    maps = [
        F.interpolate(m[None, None], size, mode="nearest-exact")[0, 0] * ratio
        for m in (pair.left_px, pair.right_px)
    ]
    return TrainingPair(images[0], images[1], maps[0], maps[1])


def crop_pair(
    pair: TrainingPair, size_px: tuple[int, int], generator: torch.Generator
) -> TrainingPair:
    """Cut the same random window out of everything: columns must agree, or disparity is lost.

    Raises:
        InputError: the window is larger than the images.
    """
    height, width = pair.left.shape[-2:]
    rows, columns = size_px
    if rows > height or columns > width:
        raise InputError(
            f"a crop of {rows}x{columns} (rows x columns) does not fit into images of "
            f"{height}x{width}; lower crop_px"
        )
    top = int(torch.randint(height - rows + 1, (), generator=generator))
    first = int(torch.randint(width - columns + 1, (), generator=generator))
    window = [part[..., top : top + rows, first : first + columns] for part in pair]
    return TrainingPair(*window)


def jitter_colors(pair: TrainingPair, strength: float, generator: torch.Generator) -> TrainingPair:
    """Scale brightness, contrast and saturation by 1 +- ``strength``, alike in both views."""
    brightness, contrast, saturation = (
        1 + strength * (2 * torch.rand(3, generator=generator) - 1)
    ).tolist()
    left, right = pair.left * brightness, pair.right * brightness
    mean = (left.mean() + right.mean()) / 2  # one anchor, or the views would drift apart
    views = [_saturate((view - mean) * contrast + mean, saturation) for view in (left, right)]
    return TrainingPair(views[0].clamp(0, 1), views[1].clamp(0, 1), pair.left_px, pair.right_px)


def _saturate(image: Float[Tensor, "3 h w"], factor: float) -> Float[Tensor, "3 h w"]:
    grey = (image * image.new_tensor(_LUMA)[:, None, None]).sum(0)
    return grey + (image - grey) * factor


def _draw_scale(config: AugmentConfig, generator: torch.Generator) -> float:
    low, high = config.scale
    return low + (high - low) * float(torch.rand((), generator=generator))
