"""Augmentation of training pairs, which stay rectified, and degradation of single images.

Degradation imitates the effects of camera, weather and files on a picture; the truth stays.
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

from depthpose.core.arrays import grey_from_rgb
from depthpose.core.errors import InputError
from depthpose.depth.config import AugmentConfig, DegradeConfig
from depthpose.depth.types import View

_HAZE_BRIGHTNESS = (0.5, 1.0)
_HAZE_DENSITY = (0.0, 0.4)
"""Ranges of the grey value of haze (white is 1), and of its share of each pixel."""
_GLARE_TOP = (0.0, 0.6)
_GLARE_LEFT = (0.0, 1.0)
_GLARE_RADIUS = (0.2, 0.8)
_GLARE_STRENGTH = (0.1, 0.6)
"""Ranges of the place of a glare as shares of the height and of the width, of its standard
deviation as a share of the height, and of what it adds to the colours at its place."""
_MIN_BLUR_PX = 0.3
"""Least standard deviation of a blur that can be seen."""
_JPEG_QUALITY = (40.0, 95.0)


def degrade(image: View, config: DegradeConfig, generator: torch.Generator) -> View:
    """Degrade the colours and the sharpness of an image at random; objects stay in place.

    Args:
        image: RGB in [0, 1].
        config: ranges and probabilities of the changes.
        generator: generator of the random numbers.

    Returns:
        The degraded image, RGB in [0, 1].
    """
    if _happens(config.hue_share, generator):
        image = image[torch.randperm(3, generator=generator)]
    image = _change_colors(image, config.color, generator)
    if _happens(config.haze_share, generator):
        haze = torch.full_like(image, _draw_between(*_HAZE_BRIGHTNESS, generator))
        image = torch.lerp(image, haze, _draw_between(*_HAZE_DENSITY, generator))
    if _happens(config.glare_share, generator):
        image = _add_glare(image, generator)
    if _happens(config.blur_share, generator):
        image = _blur(image, _draw_between(_MIN_BLUR_PX, config.blur_px, generator))
    if _happens(config.noise_share, generator):
        noise = torch.randn(image.shape, generator=generator)
        image = image + noise * _draw_between(0.0, config.noise, generator)
    image = image.clamp(0, 1)
    if _happens(config.jpeg_share, generator):
        image = through_jpeg(image, int(_draw_between(*_JPEG_QUALITY, generator)))
    return image


def _draw_between(low: float, high: float, generator: torch.Generator) -> float:
    """Draw a number between two limits, uniformly."""
    return low + (high - low) * float(torch.rand((), generator=generator))


def _happens(probability: float, generator: torch.Generator) -> bool:
    """Draw whether something of a probability happens."""
    return float(torch.rand((), generator=generator)) < probability


def _change_colors(image: View, strength: float, generator: torch.Generator) -> View:
    """Change exposure, contrast, saturation, gamma and tint of an image at random.

    Each is scaled by a factor within 1 +- ``strength``, the tint within 1 +- a third of it.
    """
    low = 1 - strength
    high = 1 + strength
    exposure, contrast, saturation, gamma = (_draw_between(low, high, generator) for _ in range(4))
    third = strength / 3
    tint = torch.tensor([_draw_between(1 - third, 1 + third, generator) for _ in range(3)])

    grey = grey_from_rgb(image)
    image = grey + (image - grey) * saturation
    mean = image.mean()
    contrasted = (image - mean) * contrast + mean
    exposed = contrasted * exposure * tint[:, None, None]
    return exposed.clamp(0, 1) ** gamma


def _add_glare(image: View, generator: torch.Generator) -> View:
    """Add the light of a low sun or a lamp, a Gaussian about a random place."""
    height, width = image.shape[1:]
    # Distances from the place in heights of the image.
    y = torch.linspace(0, 1, height)[:, None] - _draw_between(*_GLARE_TOP, generator)
    x = torch.linspace(0, 1, width) - _draw_between(*_GLARE_LEFT, generator)
    x = x * width / height
    radius = _draw_between(*_GLARE_RADIUS, generator)
    strength = _draw_between(*_GLARE_STRENGTH, generator)
    return image + strength * torch.exp(-(x**2 + y**2) / (2 * radius**2))


def _blur(image: View, std_px: float) -> View:
    """Blur an image by a Gaussian of standard deviation ``std_px``, cut off at 3 px."""
    offsets = torch.arange(-3.0, 4.0)
    kernel = torch.exp(-(offsets**2) / (2 * std_px**2))
    kernel = kernel / kernel.sum()
    padded = F.pad(image[:, None], (3, 3, 3, 3), mode="replicate")
    along_rows = F.conv2d(padded, kernel[None, None, None])
    return F.conv2d(along_rows, kernel[None, None, :, None])[:, 0]


def through_jpeg(image: View, quality: int) -> View:
    """Compress an image as JPEG of ``quality`` (1 to 95), and decode it again.

    Colours are not subsampled.
    """
    pixels = (image.permute(1, 2, 0) * 255).round().byte().numpy()
    file = BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality, subsampling=0)
    decoded = np.array(Image.open(file), np.float32) / 255
    return torch.from_numpy(decoded).permute(2, 0, 1).contiguous()


_UNKNOWN = torch.tensor(torch.nan)


class TrainingPair(NamedTuple):
    """A pair with its truth, as a training sees it.

    Every change of this module keeps ``focal_px * baseline_m / left_px`` the depth of each pixel
    (where the rig has two principal points, their difference is scaled as the focal length is).
    """

    left: Float[Tensor, "*b 3 h w"]  #: RGB in [0, 1]
    right: Float[Tensor, "*b 3 h w"]  #: RGB in [0, 1], rectified, of the same size
    left_px: Float[Tensor, "*b h w"]  #: disparity of the left view [px], NaN for unknown
    #: disparity of the right view, positive too: the truth of the left view after a flip
    right_px: Float[Tensor, "*b h w"]
    #: focal length along the rows (fx) at this size; NaN for unknown
    focal_px: Float[Tensor, "*b"] = _UNKNOWN


def augment(pair: TrainingPair, config: AugmentConfig, generator: torch.Generator) -> TrainingPair:
    """Augment a pair at random: scale, crop, perhaps mirror, change colours (thesis, 2.4.2).

    Args:
        pair: one pair, without a batch axis.
        config: ranges and probabilities of the changes.
        generator: generator of the random numbers.

    Returns:
        A pair of ``config.crop_px``. A smaller pair is padded to it (:func:`pad_pair`), not
        enlarged, for that would change its focal length.

    Raises:
        InputError: the pair is smaller than half of the crop.
    """
    # A random scale, but at least the one that fills half of the crop, where the range allows it.
    low, high = config.scale
    random_scale = _draw_between(low, high, generator)
    sides = zip(config.crop_px, pair.left.shape[-2:], strict=True)
    # One pixel more than half, so that rounding leaves at least half.
    half_filling_scale = max((crop + 1) / 2 / side for crop, side in sides)
    scaled = scale_pair(pair, max(random_scale, min(half_filling_scale, high)))

    height, width = scaled.left.shape[-2:]
    rows, columns = config.crop_px
    cropped = crop_pair(scaled, (min(height, rows), min(width, columns)), generator)
    if _happens(config.flip_share, generator):
        cropped = flip_and_swap(cropped)
    coloured = jitter_colors(cropped, config.jitter, generator)
    differing = make_views_differ(coloured, config, generator)
    return pad_pair(differing, config.crop_px)


def flip_and_swap(pair: TrainingPair) -> TrainingPair:
    """Mirror both views and swap them, which makes a rectified pair again.

    The truth of the new left view is the mirrored truth of the old right one.
    """
    left, right, left_px, right_px = (part.flip(-1) for part in pair[:4])
    return TrainingPair(right, left, right_px, left_px, pair.focal_px)


def scale_pair(pair: TrainingPair, scale: float) -> TrainingPair:
    """Resize a pair to ``scale`` times its size, rounded to whole pixels.

    Disparity and focal length are scaled by the ratio of the widths. Disparity is resized by
    nearest neighbour, so that known and unknown never mix.
    """
    height, width = pair.left.shape[-2:]
    if scale == 1.0:
        return pair
    new_height = max(math.floor(height * scale + 0.5), 1)
    new_width = max(math.floor(width * scale + 0.5), 1)
    size = (new_height, new_width)
    ratio = new_width / width
    left, right = (
        F.interpolate(view[None], size, mode="bilinear", antialias=scale < 1)[0].clamp(0, 1)
        for view in (pair.left, pair.right)
    )
    left_px, right_px = (
        F.interpolate(disparity_px[None, None], size, mode="nearest-exact")[0, 0] * ratio
        for disparity_px in (pair.left_px, pair.right_px)
    )
    return TrainingPair(left, right, left_px, right_px, pair.focal_px * ratio)


def crop_pair(
    pair: TrainingPair, size_px: tuple[int, int], generator: torch.Generator
) -> TrainingPair:
    """Crop a pair to a random window, the same in both views and their truth: disparity stays.

    ``size_px``: rows and columns of the window.

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
    left, right, left_px, right_px = (
        part[..., top : top + rows, first : first + columns] for part in pair[:4]
    )
    return TrainingPair(left, right, left_px, right_px, pair.focal_px)


def pad_pair(pair: TrainingPair, size_px: tuple[int, int]) -> TrainingPair:
    """Pad a pair on the right and below with black, whose disparity is unknown (NaN).

    Pixels keep their rows and columns, so disparity and horizon stay the same. The border is not
    reflected, for a reflection has negative disparities. ``size_px``: least rows and columns of
    the result.

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
    padding = (0, max(columns - width, 0), 0, max(rows - height, 0))
    return pair._replace(
        left=F.pad(pair.left, padding),
        right=F.pad(pair.right, padding),
        left_px=F.pad(pair.left_px, padding, value=torch.nan),
        right_px=F.pad(pair.right_px, padding, value=torch.nan),
    )


def jitter_colors(pair: TrainingPair, strength: float, generator: torch.Generator) -> TrainingPair:
    """Change brightness, contrast and saturation at random, alike in both views.

    Each is scaled by a factor between 1 - ``strength`` and 1 + ``strength``.
    """
    factors = 1 + strength * (2 * torch.rand(3, generator=generator) - 1)
    brightness, contrast, saturation = factors.tolist()
    left = pair.left * brightness
    right = pair.right * brightness
    # The mean of both views: contrast about the mean of each would make them differ.
    mean = (left.mean() + right.mean()) / 2
    jittered: list[View] = []
    for view in (left, right):
        contrasted = (view - mean) * contrast + mean
        grey = grey_from_rgb(contrasted)
        saturated = grey + (contrasted - grey) * saturation
        jittered.append(saturated.clamp(0, 1))
    return pair._replace(left=jittered[0], right=jittered[1])


def make_views_differ(
    pair: TrainingPair, config: AugmentConfig, generator: torch.Generator
) -> TrainingPair:
    """Change each view at random, so that they differ as those of two real cameras do.

    Each view is degraded by itself; the rows of the right one are shifted, and a patch of it may
    be erased. Disparity does not change.
    """
    if config.per_view is not None:
        left, right = (
            degrade(view, config.per_view, generator) for view in (pair.left, pair.right)
        )
        pair = pair._replace(left=left, right=right)
    if config.misaligned_px:
        shifts_px = config.misaligned_px * (2 * torch.rand(2, generator=generator) - 1)
        pair = pair._replace(right=shift_up(pair.right, *shifts_px.tolist()))
    if _happens(config.erased_share, generator):
        pair = pair._replace(right=_erase_patch(pair.right, generator))
    return pair


def _erase_patch(image: View, generator: torch.Generator) -> View:
    """Fill a random patch, a sixth to a third of each side, with the image's mean colour."""
    window: list[slice] = []
    for side in image.shape[1:]:
        size = int(side * _draw_between(1.0, 2.0, generator) / 6)
        first = int(torch.randint(side - size + 1, (), generator=generator))
        window.append(slice(first, first + size))
    rows, columns = window
    erased = image.clone()
    erased[:, rows, columns] = image.mean((1, 2))[:, None, None]
    return erased


def shift_up(image: View, at_left_border_px: float, at_right_border_px: float) -> View:
    """Shift the columns of an image up, by amounts given at both borders and linear between them.

    Sampling is bilinear, and the border repeats. Columns stay, and so does disparity.
    """
    height, width = image.shape[1:]
    shifts_px = torch.linspace(at_left_border_px, at_right_border_px, width)
    rows = torch.arange(height)[:, None] + shifts_px
    columns = torch.arange(width).expand(height, width)
    # grid_sample's coordinates: -1 and 1 are the outer borders of the image.
    x = (2 * columns + 1) / width - 1
    y = (2 * rows + 1) / height - 1
    grid = torch.stack([x, y], -1).to(image.dtype)
    return F.grid_sample(image[None], grid[None], padding_mode="border", align_corners=False)[0]
