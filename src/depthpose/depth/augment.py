"""Random changes that keep a stereo pair a stereo pair, and degradations of the input alone.

Degradations are what a camera, weather and files do to a picture; truth never changes by them.
"""

import math
from io import BytesIO
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from depthpose.core.camera.rectified import grey_of
from depthpose.core.errors import InputError
from depthpose.depth.config import AugmentConfig, DegradeConfig
from depthpose.depth.types import View


def degrade(image: View, config: DegradeConfig, generator: torch.Generator) -> View:
    """Change colours and sharpness of an image at random, but not where things are.

    Args:
        image: RGB in [0, 1].
        config: how much, and how often.
        generator: decides.
    """

    def between(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    if between(0.0, 1.0) < config.hue_share:
        image = image[torch.randperm(3, generator=generator)]
    low = 1 - config.colour
    high = 1 + config.colour
    exposure, contrast, saturation, gamma = (between(low, high) for _ in range(4))
    third = config.colour / 3
    tint = torch.tensor([between(1 - third, 1 + third) for _ in range(3)])
    grey = grey_of(image)
    image = grey + (image - grey) * saturation
    mean = image.mean()
    image = ((image - mean) * contrast + mean) * exposure * tint[:, None, None]
    image = image.clamp(0, 1) ** gamma
    if between(0.0, 1.0) < config.haze_share:
        grey = torch.full_like(image, between(0.5, 1.0))
        image = torch.lerp(image, grey, between(0.0, 0.4))
    if between(0.0, 1.0) < config.glare_share:  # it fades from one place on: a low sun, a lamp
        height, width = image.shape[1:]
        y = torch.linspace(0, 1, height)[:, None] - between(0.0, 0.6)
        x = (torch.linspace(0, 1, width) - between(0.0, 1.0)) * width / height
        reach = between(0.2, 0.8)
        image = image + between(0.1, 0.6) * torch.exp(-(x**2 + y**2) / (2 * reach**2))
    if between(0.0, 1.0) < config.blur_share:
        places = torch.arange(-3.0, 4.0)
        deviation_px = between(0.3, config.blur_px)
        kernel = torch.exp(-(places**2) / (2 * deviation_px**2))
        kernel = kernel / kernel.sum()
        padded = F.pad(image[:, None], (3, 3, 3, 3), mode="replicate")
        blurred = F.conv2d(padded, kernel[None, None, None])
        image = F.conv2d(blurred, kernel[None, None, :, None])[:, 0]
    if between(0.0, 1.0) < config.noise_share:
        noise = torch.randn(image.shape, generator=generator)
        image = image + noise * between(0.0, config.noise)
    image = image.clamp(0, 1)
    if between(0.0, 1.0) < config.jpeg_share:
        image = through_jpeg(image, int(between(40.0, 95.0)))
    return image


def through_jpeg(image: View, quality: int) -> View:
    """Give what is left of an image after JPEG of ``quality`` (1 to 95), 4:4:4."""
    pixels = (image.permute(1, 2, 0) * 255).round().byte().numpy()
    file = BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality, subsampling=0)
    decoded = np.array(Image.open(file), np.float32) / 255
    return torch.from_numpy(decoded).permute(2, 0, 1).contiguous()


_UNKNOWN = torch.tensor(torch.nan)


class TrainingPair(NamedTuple):
    """A pair on its way into a network.

    Whatever is done to it, ``focal_px * baseline_m / left_px`` stays the depth of each pixel
    (where the rig has two principal points, their difference is scaled as the focal length is).
    """

    left: Float[Tensor, "*b 3 h w"]  #: RGB in [0, 1]
    right: Float[Tensor, "*b 3 h w"]  #: RGB in [0, 1], rectified, of the same size
    left_px: Float[Tensor, "*b h w"]  #: disparity of the left view [px], NaN for unknown
    #: disparity of the right view, counted positive as well: what is truth after a flip
    right_px: Float[Tensor, "*b h w"]
    #: focal length along the rows (fx) at this size; NaN for unknown
    focal_px: Float[Tensor, "*b"] = _UNKNOWN


def augment(pair: TrainingPair, config: AugmentConfig, generator: torch.Generator) -> TrainingPair:
    """Scale, crop, perhaps mirror, and change the colours of a pair (thesis, 2.4.2).

    What is smaller than the crop is padded (:func:`pad_pair`): enlarged, it would be seen at
    another focal length than the rest.

    Raises:
        InputError: the pair is smaller than half of the crop.
    """
    low, high = config.scale
    drawn = low + (high - low) * float(torch.rand((), generator=generator))
    # None at which half of the crop would be black, if a larger one is allowed.
    sides = zip(config.crop_px, pair.left.shape[-2:], strict=True)
    half = max((crop + 1) / 2 / side for crop, side in sides)
    scaled = scale_pair(pair, max(drawn, min(half, high)))
    height, width = scaled.left.shape[-2:]
    rows, columns = config.crop_px
    cropped = crop_pair(scaled, (min(height, rows), min(width, columns)), generator)
    if float(torch.rand((), generator=generator)) < config.flip_share:
        cropped = flip_and_swap(cropped)
    coloured = jitter_colors(cropped, config.jitter, generator)
    return pad_pair(set_apart(coloured, config, generator), config.crop_px)


def flip_and_swap(pair: TrainingPair) -> TrainingPair:
    """Mirror both views and swap them: the mirrored right view is the left one of a true pair.

    Truth of the new left view is the mirrored truth of the old right one, or none.
    """
    left, right, left_px, right_px = (part.flip(-1) for part in pair[:4])
    return TrainingPair(right, left, right_px, left_px, pair.focal_px)


def scale_pair(pair: TrainingPair, scale: float) -> TrainingPair:
    """Resize a pair to ``scale`` of its size.

    Both sides keep one ratio but for rounding; disparity and focal length are scaled by the ratio
    of the widths. Disparity is resized by nearest neighbour, so that known and unknown never mix.
    """
    height, width = pair.left.shape[-2:]
    if scale == 1.0:
        return pair
    size = (max(math.floor(height * scale + 0.5), 1), max(math.floor(width * scale + 0.5), 1))
    ratio = size[1] / width
    left, right = (
        F.interpolate(i[None], size, mode="bilinear", antialias=scale < 1)[0].clamp(0, 1)
        for i in (pair.left, pair.right)
    )
    left_px, right_px = (
        F.interpolate(m[None, None], size, mode="nearest-exact")[0, 0] * ratio
        for m in (pair.left_px, pair.right_px)
    )
    return TrainingPair(left, right, left_px, right_px, pair.focal_px * ratio)


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
    parts = (part[..., top : top + rows, first : first + columns] for part in pair[:4])
    left, right, left_px, right_px = parts
    return TrainingPair(left, right, left_px, right_px, pair.focal_px)


def pad_pair(pair: TrainingPair, size_px: tuple[int, int]) -> TrainingPair:
    """Fill a pair up to a size with black, without truth, on the right and below.

    Rows and columns of the picture keep their numbers, so disparity and horizon stay where they
    are. A mirrored border would have the negative of every disparity.

    Raises:
        InputError: more than half of the rows or of the columns would be black.
    """
    height, width = pair.left.shape[-2:]
    rows, columns = size_px
    if 2 * height < rows or 2 * width < columns:
        raise InputError(
            f"a pair of {height}x{width} (rows x columns) fills less than half of a crop of "
            f"{rows}x{columns}; lower crop_px, or leave such pairs out"
        )
    beyond = (0, max(columns - width, 0), 0, max(rows - height, 0))
    return pair._replace(
        left=F.pad(pair.left, beyond),
        right=F.pad(pair.right, beyond),
        left_px=F.pad(pair.left_px, beyond, value=torch.nan),
        right_px=F.pad(pair.right_px, beyond, value=torch.nan),
    )


def jitter_colors(pair: TrainingPair, strength: float, generator: torch.Generator) -> TrainingPair:
    """Scale brightness, contrast and saturation by 1 +- ``strength``, alike in both views."""
    brightness, contrast, saturation = (
        1 + strength * (2 * torch.rand(3, generator=generator) - 1)
    ).tolist()
    left = pair.left * brightness
    right = pair.right * brightness
    mean = (left.mean() + right.mean()) / 2  # one anchor, or the views would drift apart
    views = []
    for view in (left, right):
        contrasted = (view - mean) * contrast + mean
        grey = grey_of(contrasted)
        views.append((grey + (contrasted - grey) * saturation).clamp(0, 1))
    return pair._replace(left=views[0], right=views[1])


def set_apart(
    pair: TrainingPair, config: AugmentConfig, generator: torch.Generator
) -> TrainingPair:
    """Change each view on its own, as two real cameras differ; disparity does not change."""
    if config.per_view is not None:
        left, right = (
            degrade(view, config.per_view, generator) for view in (pair.left, pair.right)
        )
        pair = pair._replace(left=left, right=right)
    if config.misaligned_px:
        ends = config.misaligned_px * (2 * torch.rand(2, generator=generator) - 1)
        pair = pair._replace(right=shift_rows(pair.right, *ends.tolist()))
    if float(torch.rand((), generator=generator)) < config.erased_share:
        # A patch of a sixth to a third of each side gets the mean colour.
        patch = []
        for side in pair.right.shape[1:]:
            size = int(side * (1 + float(torch.rand((), generator=generator))) / 6)
            first = int(torch.randint(side - size + 1, (), generator=generator))
            patch.append(slice(first, first + size))
        erased = pair.right.clone()
        erased[:, patch[0], patch[1]] = pair.right.mean((1, 2))[:, None, None]
        pair = pair._replace(right=erased)
    return pair


def shift_rows(image: View, left_px: float, right_px: float) -> View:
    """Look each pixel up so many rows further down, in proportion between the two borders.

    Columns stay, and so does disparity.
    """
    height, width = image.shape[1:]
    rows = torch.arange(height)[:, None] + torch.linspace(left_px, right_px, width)
    columns = torch.arange(width).expand(height, width)
    places = [(2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1]
    grid = torch.stack(places, -1).to(image.dtype)
    return F.grid_sample(image[None], grid[None], padding_mode="border", align_corners=False)[0]
