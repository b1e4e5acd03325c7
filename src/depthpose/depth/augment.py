"""Random changes of training pairs that stay rectified pairs, and degradations of single images.

Degradations are the effects of camera, weather and files on a picture; truth does not change.
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

from depthpose.core.camera.rectified import grey_from_rgb
from depthpose.core.errors import InputError
from depthpose.depth.config import AugmentConfig, DegradeConfig
from depthpose.depth.types import View


def degrade(image: View, config: DegradeConfig, generator: torch.Generator) -> View:
    """Change colours and sharpness of an image at random, but not where objects are.

    Args:
        image: RGB in [0, 1].
        config: ranges and probabilities of the changes.
        generator: generator of the random numbers.
    """

    def between(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    def happens(share: float) -> bool:
        return between(0.0, 1.0) < share

    if happens(config.hue_share):
        image = image[torch.randperm(3, generator=generator)]

    # Colours: every image.
    low = 1 - config.colour
    high = 1 + config.colour
    exposure, contrast, saturation, gamma = (between(low, high) for _ in range(4))
    third = config.colour / 3
    tint = torch.tensor([between(1 - third, 1 + third) for _ in range(3)])
    grey = grey_from_rgb(image)
    image = grey + (image - grey) * saturation
    mean = image.mean()
    image = ((image - mean) * contrast + mean) * exposure * tint[:, None, None]
    image = image.clamp(0, 1) ** gamma

    if happens(config.haze_share):
        haze = torch.full_like(image, between(0.5, 1.0))
        image = torch.lerp(image, haze, between(0.0, 0.4))
    if happens(config.glare_share):
        # A low sun or a lamp, whose light fades with the distance from its place.
        height, width = image.shape[1:]
        y = torch.linspace(0, 1, height)[:, None] - between(0.0, 0.6)
        x = (torch.linspace(0, 1, width) - between(0.0, 1.0)) * width / height
        radius = between(0.2, 0.8)
        image = image + between(0.1, 0.6) * torch.exp(-(x**2 + y**2) / (2 * radius**2))
    if happens(config.blur_share):
        image = _blur(image, between(0.3, config.blur_px))
    if happens(config.noise_share):
        noise = torch.randn(image.shape, generator=generator)
        image = image + noise * between(0.0, config.noise)
    image = image.clamp(0, 1)
    if happens(config.jpeg_share):
        image = through_jpeg(image, int(between(40.0, 95.0)))
    return image


def _blur(image: View, deviation_px: float) -> View:
    """Blur an image by a Gaussian of a standard deviation, cut off at 3 px."""
    offsets = torch.arange(-3.0, 4.0)
    kernel = torch.exp(-(offsets**2) / (2 * deviation_px**2))
    kernel = kernel / kernel.sum()
    padded = F.pad(image[:, None], (3, 3, 3, 3), mode="replicate")
    along_rows = F.conv2d(padded, kernel[None, None, None])
    return F.conv2d(along_rows, kernel[None, None, :, None])[:, 0]


def through_jpeg(image: View, quality: int) -> View:
    """Compress an image as JPEG of ``quality`` (1 to 95), colours at full size, and decode it."""
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
    """Scale, crop, perhaps mirror, and change the colours of a pair (thesis, 2.4.2).

    A pair smaller than the crop is padded (:func:`pad_pair`), not enlarged, for that would change
    its focal length.

    Raises:
        InputError: the pair is smaller than half of the crop.
    """
    # A random scale, but at least the one that fills half of the crop, where the range allows it.
    low, high = config.scale
    scale = low + (high - low) * float(torch.rand((), generator=generator))
    sides = zip(config.crop_px, pair.left.shape[-2:], strict=True)
    half_scale = max((crop + 1) / 2 / side for crop, side in sides)
    scaled = scale_pair(pair, max(scale, min(half_scale, high)))

    height, width = scaled.left.shape[-2:]
    rows, columns = config.crop_px
    cropped = crop_pair(scaled, (min(height, rows), min(width, columns)), generator)
    if float(torch.rand((), generator=generator)) < config.flip_share:
        cropped = flip_and_swap(cropped)
    coloured = jitter_colors(cropped, config.jitter, generator)
    differing = set_apart(coloured, config, generator)
    return pad_pair(differing, config.crop_px)


def flip_and_swap(pair: TrainingPair) -> TrainingPair:
    """Mirror both views and swap them, which gives a rectified pair again.

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
    """Cut the same random window out of both views and their truth, so that disparity stays.

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
    """Pad a pair on the right and below with black that has no truth.

    Rows and columns of the picture keep their numbers, so disparity and horizon stay where they
    are. A reflected border would have the negative of every disparity. ``size_px``: rows and
    columns that the result has at least.

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
    """Scale brightness, contrast and saturation at random, by the same factors in both views.

    The factors lie between 1 - ``strength`` and 1 + ``strength``.
    """
    factors = 1 + strength * (2 * torch.rand(3, generator=generator) - 1)
    brightness, contrast, saturation = factors.tolist()
    left = pair.left * brightness
    right = pair.right * brightness
    mean = (left.mean() + right.mean()) / 2  # of both, or the views would come to differ

    def change(view: View) -> View:
        contrasted = (view - mean) * contrast + mean
        grey = grey_from_rgb(contrasted)
        return (grey + (contrasted - grey) * saturation).clamp(0, 1)

    return pair._replace(left=change(left), right=change(right))


def set_apart(
    pair: TrainingPair, config: AugmentConfig, generator: torch.Generator
) -> TrainingPair:
    """Make the views differ at random, as those of two real cameras; disparity does not change.

    Each view is degraded by itself; the right one is misaligned, and may lose a patch.
    """
    if config.per_view is not None:
        left, right = (
            degrade(view, config.per_view, generator) for view in (pair.left, pair.right)
        )
        pair = pair._replace(left=left, right=right)
    if config.misaligned_px:
        shifts_px = config.misaligned_px * (2 * torch.rand(2, generator=generator) - 1)
        pair = pair._replace(right=shift_rows(pair.right, *shifts_px.tolist()))
    if float(torch.rand((), generator=generator)) < config.erased_share:
        # A patch of a sixth to a third of each side gets the mean colour.
        window: list[slice] = []
        for side in pair.right.shape[1:]:
            size = int(side * (1 + float(torch.rand((), generator=generator))) / 6)
            first = int(torch.randint(side - size + 1, (), generator=generator))
            window.append(slice(first, first + size))
        rows, columns = window
        erased = pair.right.clone()
        erased[:, rows, columns] = pair.right.mean((1, 2))[:, None, None]
        pair = pair._replace(right=erased)
    return pair


def shift_rows(image: View, left_px: float, right_px: float) -> View:
    """Move an image up: by ``left_px`` at its left border, ``right_px`` at its right one.

    The shift is linear between the borders. Columns stay, and so does disparity.
    """
    height, width = image.shape[1:]
    rows = torch.arange(height)[:, None] + torch.linspace(left_px, right_px, width)
    columns = torch.arange(width).expand(height, width)
    # grid_sample's coordinates: -1 and 1 are the outer borders of the image.
    x = (2 * columns + 1) / width - 1
    y = (2 * rows + 1) / height - 1
    grid = torch.stack([x, y], -1).to(image.dtype)
    return F.grid_sample(image[None], grid[None], padding_mode="border", align_corners=False)[0]
