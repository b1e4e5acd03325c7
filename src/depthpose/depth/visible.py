"""Where an image shows nothing: borders without a picture, surfaces without any texture."""

from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera.rectified import grey_of

_SAME = 3 / 255
"""By which a border of one colour varies: noise of JPEG and videos."""
_DARK = 24 / 255
"""The bars of films are black, which videos store as 16 of 255."""
_BLACK = 2 / 255
"""What a rectified image has where the raw one shows nothing, as it is stored in JPEG too."""
_LEAST_BAR = 0.01
_LEAST_SHARE = 0.0005
"""Of a side, and of the image: what is smaller is a dark pixel of the picture."""
_LEAST_PICTURE = 0.1
"""Of the image: where less would be left, it is black or plain itself, and nothing is a border."""
_LEAST_FILLED = 0.95
"""Of a black region's pixels: so many have nothing but black towards a side of the image."""
_MIXED_PX = 2
"""So far into the border, pixels are a mixture of picture and black: cubic resampling."""
_PATCH_SHARE = 8 / 1242
_LEAST_RADIUS_PX = 4
"""Radius of a patch, as a share of the width."""
_ROUNDING = 0.5 / 255
"""Spread of grey values in a patch, below which it is rounding alone: half a level of 8 bits."""


def without_picture(image: Float[Tensor, "3 h w"]) -> Bool[Tensor, "h w"]:
    """Find borders that show nothing, such as those of rectification.

    These are bars of one colour along whole sides (letterboxes), dark or at two opposite sides, and
    black regions along the border, as rectification leaves them.
    """
    height, width = image.shape[1:]
    blank = torch.zeros(height, width, dtype=torch.bool, device=image.device)
    rows = _bars(image)
    columns = _bars(image.mT)
    blank[: rows[0]] = True
    blank[height - rows[1] :] = True
    blank[:, : columns[0]] = True
    blank[:, width - columns[1] :] = True

    border = _black_border((image.amax(0) <= _BLACK).cpu().numpy())
    blank |= torch.from_numpy(border).to(blank.device)
    return blank if float((~blank).float().mean()) >= _LEAST_PICTURE else torch.zeros_like(blank)


def _black_border(is_black: np.ndarray) -> np.ndarray:
    """Find what rectification leaves black; a dark thing at the border is of the picture.

    The picture of a rectified image is bulged or cut straight: a black region beside it reaches a
    corner of the image or along half a side, and has no holes.
    """
    height, width = is_black.shape
    sides = (is_black[0], is_black[-1], is_black[:, 0], is_black[:, -1])
    if not any(side.any() for side in sides):
        return np.zeros_like(is_black)
    # Pixels between which and a side of the image everything is black.
    from_side = np.zeros_like(is_black)
    for axis in (0, 1):
        from_side |= np.logical_and.accumulate(is_black, axis)
        from_side |= np.flip(np.logical_and.accumulate(np.flip(is_black, axis), axis), axis)

    regions, count = cast("tuple[np.ndarray, int]", ndimage.label(is_black))
    corners = regions[[0, 0, -1, -1], [0, -1, 0, -1]]
    area_px = np.bincount(regions.ravel(), minlength=count + 1)
    filled_px = np.bincount(regions[from_side], minlength=count + 1)
    reaches = np.isin(np.arange(count + 1), corners)
    for side in (regions[0], regions[-1], regions[:, 0], regions[:, -1]):
        reaches |= np.bincount(side, minlength=count + 1) > len(side) / 2
    is_border = reaches & (area_px >= _LEAST_SHARE * height * width)
    is_border &= filled_px >= _LEAST_FILLED * area_px
    is_border[0] = False  # what is not black
    return ndimage.binary_dilation(is_border[regions], iterations=_MIXED_PX)


def _bars(image: Float[Tensor, "3 _ _"]) -> tuple[int, int]:
    """Count the first and the last rows of one colour, where they are bars.

    A bar ends at a row of several colours, which tells it from a ramp of brightness. A bar that is
    not dark counts only where there is one at the other end too.
    """
    counts: list[int] = []
    dark: list[bool] = []
    least = image.amin(2)  # of each channel and row
    most = image.amax(2)
    for low, high in ((least, most), (least.flip(1), most.flip(1))):
        is_same = (high - low[:, :1] <= _SAME) & (high[:, :1] - low <= _SAME)
        count = int(is_same.all(0).long().cumprod(0).sum())
        is_ended = count < image.shape[1] and float((high - low)[:, count].amax()) > _SAME
        is_bar = is_ended and count >= max(2, _LEAST_BAR * image.shape[1])
        counts.append(count if is_bar else 0)
        dark.append(float(high[:, 0].amax()) <= _DARK)
    is_at_both = min(counts) > 0
    first, last = (
        n if is_dark or is_at_both else 0 for n, is_dark in zip(counts, dark, strict=True)
    )
    return first, last


def texture(image: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
    """Give how well each place can be matched, from 0 (plain) to 1.

    It is 0 where the patch around a pixel is plain, such as a wall or what is over-exposed, and 1
    where its grey values spread by more than rounding does.
    """
    grey = grey_of(image).float()
    radius = max(_LEAST_RADIUS_PX, round(_PATCH_SHARE * grey.shape[1]))
    grey = F.pad(grey[None], (radius,) * 4, mode="replicate")[0].double()
    along = F.avg_pool2d(torch.stack([grey, grey.square()]), (1, 2 * radius + 1), 1)
    mean, mean_square = F.avg_pool2d(along, (2 * radius + 1, 1), 1)
    spread = (mean_square - mean.square()).clamp_min(0).sqrt()
    return (spread / _ROUNDING).clamp(max=1).float()
