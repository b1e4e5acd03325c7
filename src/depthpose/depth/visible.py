"""Where an image shows nothing that can be matched: blank borders, and surfaces without texture."""

from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.arrays import grey_from_rgb

_MAX_VARIATION = 3 / 255
"""Largest variation of the values in a border of one colour: noise of JPEG and videos."""
_MAX_DARK = 24 / 255
"""Largest value of a dark bar: the bars of films are black, which videos store as 16 of 255."""
_MAX_BLACK = 2 / 255
"""Largest value of the black of a rectified image, as JPEG stores it too."""
_MIN_BAR_SHARE = 0.01
"""Least width of a bar as a share of the image's side: a narrower one is part of the picture."""
_MIN_REGION_SHARE = 0.0005
"""Least share of the image that is a black region: a smaller one is part of the picture."""
_MIN_PICTURE_SHARE = 0.1
"""Least share of the image that is left as the picture: where less would remain, the image is black
or plain itself, and has no border."""
_MIN_FILLED_SHARE = 0.95
"""Least share of a black region's pixels that have nothing but black between them and a side of the
image."""
_MIXED_BORDER_PX = 2
"""Width of the edge of a black region where cubic resampling mixes picture and black."""
_RADIUS_SHARE = 8 / 1242
_MIN_RADIUS_PX = 4
"""Radius of a patch: a share of the image's width (8 px of KITTI's 1242), but at least 4 px."""
_ROUNDING_STD = 0.5 / 255
"""Standard deviation of grey values that rounding to 8 bits can make: half a level."""


def find_blank_borders(image: Float[Tensor, "3 h w"]) -> Bool[Tensor, "h w"]:
    """Find blank borders, which show nothing of the scene; True where a pixel belongs to one.

    These are bars of one colour along whole sides (letterboxes), dark or at two opposite sides, and
    black regions along the border, as rectification leaves them. ``image``: RGB in [0, 1].
    """
    height, width = image.shape[1:]
    is_blank = torch.zeros(height, width, dtype=torch.bool, device=image.device)
    top, bottom = _count_bar_rows(image)
    left, right = _count_bar_rows(image.mT)
    is_blank[:top] = True
    is_blank[height - bottom :] = True
    is_blank[:, :left] = True
    is_blank[:, width - right :] = True

    border = _find_black_border((image.amax(0) <= _MAX_BLACK).cpu().numpy())
    is_blank |= torch.from_numpy(border).to(is_blank.device)
    picture_share = float((~is_blank).float().mean())
    return is_blank if picture_share >= _MIN_PICTURE_SHARE else torch.zeros_like(is_blank)


def _find_black_border(is_black: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Find the black regions that rectification leaves, but not dark objects at the border.

    The picture of a rectified image is bulged or cut straight: a black region beside it reaches a
    corner of the image or along half a side, and has no holes.
    """
    height, width = is_black.shape
    if not any(side.any() for side in _take_sides(is_black)):
        return np.zeros_like(is_black)
    # Pixels with nothing but black between them and a side of the image.
    is_black_to_side = np.zeros_like(is_black)
    for axis in (0, 1):
        to_first = np.logical_and.accumulate(is_black, axis)
        to_last = np.flip(np.logical_and.accumulate(np.flip(is_black, axis), axis), axis)
        is_black_to_side |= to_first | to_last

    # Label 0 is what is not black; the regions follow.
    labels, region_count = cast("tuple[np.ndarray, int]", ndimage.label(is_black))
    count = region_count + 1
    corner_labels = labels[[0, 0, -1, -1], [0, -1, 0, -1]]
    is_border = np.isin(np.arange(count), corner_labels)
    for side in _take_sides(labels):
        is_border |= np.bincount(side, minlength=count) > len(side) / 2
    area_px = np.bincount(labels.ravel(), minlength=count)
    filled_px = np.bincount(labels[is_black_to_side], minlength=count)
    is_border &= area_px >= _MIN_REGION_SHARE * height * width
    is_border &= filled_px >= _MIN_FILLED_SHARE * area_px
    is_border[0] = False
    return ndimage.binary_dilation(is_border[labels], iterations=_MIXED_BORDER_PX)


def _take_sides(values: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the first and the last row, and the first and the last column, of an image."""
    return values[0], values[-1], values[:, 0], values[:, -1]


def _count_bar_rows(image: Float[Tensor, "3 _ _"]) -> tuple[int, int]:
    """Count the rows of the bars at the top and the bottom; 0 where there is no bar.

    A bar has one colour, and ends at a row of several colours, which tells it from a ramp of
    brightness. A bar that is not dark counts only where there is one at the other end too.
    """
    lowest = image.amin(2)  # of each channel and row
    highest = image.amax(2)
    top = _count_first_rows(lowest, highest)
    bottom = _count_first_rows(lowest.flip(1), highest.flip(1))
    if top and bottom:
        return top, bottom
    if float(highest[:, 0].amax()) > _MAX_DARK:
        top = 0
    if float(highest[:, -1].amax()) > _MAX_DARK:
        bottom = 0
    return top, bottom


def _count_first_rows(lowest: Float[Tensor, "3 rows"], highest: Float[Tensor, "3 rows"]) -> int:
    """Count the rows of a bar that begins at the first row; 0 if there is none.

    ``lowest`` and ``highest``: least and largest value of each channel in each row.
    """
    rows = lowest.shape[1]
    # Rows whose values differ little from all those of the first row.
    is_below_limit = highest - lowest[:, :1] <= _MAX_VARIATION
    is_above_limit = highest[:, :1] - lowest <= _MAX_VARIATION
    is_like_first = (is_below_limit & is_above_limit).all(0)
    count = int(is_like_first.long().cumprod(0).sum())
    if count == rows or count < max(2, _MIN_BAR_SHARE * rows):
        return 0
    has_colors_after = float((highest - lowest)[:, count].amax()) > _MAX_VARIATION
    return count if has_colors_after else 0


def measure_texture(image: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
    """Measure the texture around each pixel, by which it can be matched: 0 (none) to 1 (enough).

    The measure is the standard deviation of the grey values in the patch around a pixel, as a share
    of what rounding to 8 bits makes of it, up to 1. It is 0 on plain walls and where the image is
    over-exposed.
    """
    grey = grey_from_rgb(image).float()
    radius = max(_MIN_RADIUS_PX, round(_RADIUS_SHARE * grey.shape[1]))
    grey = F.pad(grey[None], (radius,) * 4, mode="replicate")[0].double()
    # Means over each patch, along the rows and then along the columns.
    side = 2 * radius + 1
    row_means = F.avg_pool2d(torch.stack([grey, grey.square()]), (1, side), 1)
    mean, mean_square = F.avg_pool2d(row_means, (side, 1), 1)
    deviation = (mean_square - mean.square()).clamp_min(0).sqrt()
    return (deviation / _ROUNDING_STD).clamp(max=1).float()
