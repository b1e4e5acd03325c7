"""Is this pair of images rectified, and the right way round? Asked of the images alone.

Corners of the left image are sought in the right one by zero-mean normalised cross-correlation
(Lewis 1995), over a window that a rectified pair does not need: rows above and below, and columns
on both sides. Where the best matches lie then tells what was done to the pair.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from depthpose.core.errors import InputError

_RADIUS = 7  # of a patch: 15x15 pixels
_REACH_X, _REACH_Y = 192, 6
_WORK_WIDTH = 1280
_CELL = 24  # one corner a cell spreads the corners over the image
_MAX_CORNERS = 320
_MIN_STRENGTH = 1e-5
_MIN_NORM = 0.05
_NEAR = 4  # what counts as the same place [px]
_MIN_SCORE = 0.85
_MAX_RIVAL = 0.95  # of the best score: a rival so near means a repeated pattern
_MIN_MATCHES = 30
_MAX_OFFSET_PX = 0.75
_MAX_SPREAD_PX = 0.75
_MIN_DISPARITY_PX = 1.0
_MAX_SHARE_SWAPPED = 0.2


@dataclass(frozen=True, kw_only=True)
class RectificationReport:
    """What the matches between two images say about the pair.

    Attributes:
        vertical_offset_px: median of the right row less the left row.
        vertical_spread_px: median absolute deviation of it, scaled to a standard deviation.
        positive_share: share of positive disparities among those of a pixel or more; NaN where
            there are none.
        matches: matches that all this rests on.
        is_rectified: whether rows agree; None where too few matches tell.
        is_swapped: whether left is right; None where too few matches tell.
        message: the finding, and the remedy where there is one.
    """

    vertical_offset_px: float
    vertical_spread_px: float
    positive_share: float
    matches: int
    is_rectified: bool | None
    is_swapped: bool | None
    message: str


def check_rectified(
    left: Float[Tensor, "3 h w"], right: Float[Tensor, "3 h w"]
) -> RectificationReport:
    """Check that rows of a pair agree and that left is left.

    Offsets up to 6 rows and disparities up to 192 columns are found; images wider than 1280 are
    scaled down first, which widens both. Too few matches (a dark or bare scene, a larger offset)
    give None, never an alarm.

    Raises:
        InputError: the sizes differ.
    """
    if left.shape != right.shape:
        raise InputError(
            f"left is {_size(left)} but right is {_size(right)}; both images of a rectified pair "
            "have one size"
        )
    scale = min(1.0, _WORK_WIDTH / left.shape[-1])
    shift, is_sure = _match(_grey(left, scale), _grey(right, scale))
    return _report(shift[is_sure] / scale)


def _size(image: Float[Tensor, "3 h w"]) -> str:
    return f"{image.shape[-1]}x{image.shape[-2]}"


def _grey(image: Float[Tensor, "3 h w"], scale: float) -> Float[Tensor, "h2 w2"]:
    grey = image.mean(0)[None, None]
    if scale < 1:
        grey = functional.interpolate(grey, scale_factor=scale, mode="area")
    return grey[0, 0]


def _corners(grey: Float[Tensor, "h w"]) -> Int[Tensor, "n 2"]:
    """Rows and columns of the strongest corner of each cell (Shi and Tomasi 1994)."""
    dy, dx = torch.gradient(grey)
    products = torch.stack([dx * dx, dx * dy, dy * dy])[None]
    a, b, c = functional.avg_pool2d(products, 5, 1, 2)[0]
    strength = (a + c) / 2 - (((a - c) / 2) ** 2 + b * b).sqrt()
    margin = _RADIUS + _REACH_Y
    inner = strength[margin:-margin, _RADIUS:-_RADIUS]
    if min(inner.shape) < 1:
        return torch.zeros(0, 2, dtype=torch.int64)
    best, place = functional.max_pool2d(
        inner[None, None], _CELL, ceil_mode=True, return_indices=True
    )
    order = best.flatten().argsort(descending=True)[:_MAX_CORNERS]
    order = order[best.flatten()[order] > _MIN_STRENGTH]
    chosen = place.flatten()[order]
    rows, columns = chosen // inner.shape[1], chosen % inner.shape[1]
    return torch.stack([rows + margin, columns + _RADIUS], 1)


def _match(
    left: Float[Tensor, "h w"], right: Float[Tensor, "h w"]
) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, " n"]]:
    """Find each corner of the left image in the right one.

    Returns:
        Row and column in the right image less those in the left one, and whether to trust them:
        the patches are alike, and no other place is nearly as good.
    """
    corners = _corners(left)
    if len(corners) == 0:
        return torch.zeros(0, 2), torch.zeros(0, dtype=torch.bool)
    patch = _windows(left, corners, _RADIUS, _RADIUS)
    strip = _windows(right, corners, _RADIUS + _REACH_Y, _RADIUS + _REACH_X)
    score = _correlation(patch, strip)
    best, place = score.flatten(1).max(1)
    row, column = place // score.shape[2], place % score.shape[2]
    near_row = (torch.arange(score.shape[1]) - row[:, None]).abs() <= _NEAR
    near_column = (torch.arange(score.shape[2]) - column[:, None]).abs() <= _NEAR
    is_near = near_row[:, :, None] & near_column[:, None, :]
    rival = score.masked_fill(is_near, -1.0).flatten(1).amax(1)
    at_best = score[torch.arange(len(score)), :, column]
    shift = torch.stack([row + _parabola(at_best, row) - _REACH_Y, column - float(_REACH_X)], 1)
    return shift, (best > _MIN_SCORE) & (rival < _MAX_RIVAL * best)


def _windows(
    image: Float[Tensor, "h w"], centres: Int[Tensor, "n 2"], reach_y: int, reach_x: int
) -> Float[Tensor, "n 2*{reach_y}+1 2*{reach_x}+1"]:
    """Cut a window around each centre; outside the image it is NaN-free zero."""
    padded = functional.pad(image, (reach_x, reach_x, reach_y, reach_y))
    rows = centres[:, 0, None] + torch.arange(2 * reach_y + 1)
    columns = centres[:, 1, None] + torch.arange(2 * reach_x + 1)
    return padded[rows[:, :, None], columns[:, None, :]]


def _correlation(
    patch: Float[Tensor, "n size size"], strip: Float[Tensor, "n h w"]
) -> Float[Tensor, "n rows columns"]:
    """Zero-mean normalised cross-correlation of each patch along its strip; flat places give 0."""
    size = patch.shape[-1]
    centred = patch - patch.mean((1, 2), keepdim=True)
    centred = centred / torch.linalg.vector_norm(centred, dim=(1, 2), keepdim=True).clamp(min=1e-6)
    # Numerically the variance wants values near zero.
    strip = strip - patch.mean((1, 2), keepdim=True)
    product = functional.conv2d(strip[None], centred[:, None], groups=len(strip))[0]
    mean = functional.avg_pool2d(strip, size, 1)
    variance = functional.avg_pool2d(strip**2, size, 1) - mean**2
    norm = (variance.clamp(min=0) * size**2).sqrt()
    return torch.where(norm > _MIN_NORM, product / norm.clamp(min=_MIN_NORM), 0.0)


def _parabola(values: Float[Tensor, "n k"], peak: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Where between the samples the peak lies; 0 at the border."""
    inner = peak.clamp(1, values.shape[1] - 2)
    below, at, above = (values.gather(1, (inner + step)[:, None])[:, 0] for step in (-1, 0, 1))
    curve = below - 2 * at + above
    offset = (below - above) / (2 * torch.where(curve < 0, curve, -1.0))
    return torch.where((inner == peak) & (curve < 0), offset.clamp(-0.5, 0.5), 0.0)


def _report(shift_px: Float[Tensor, "n 2"]) -> RectificationReport:
    """Judge the trusted matches."""
    matches = len(shift_px)
    if matches < _MIN_MATCHES:
        message = (
            f"only {matches} sure matches between the two images, too few to tell whether the pair "
            "is rectified"
        )
        return RectificationReport(
            vertical_offset_px=math.nan, vertical_spread_px=math.nan, positive_share=math.nan,
            matches=matches, is_rectified=None, is_swapped=None, message=message,
        )  # fmt: skip
    vertical_px, disparity_px = shift_px[:, 0], -shift_px[:, 1]
    offset_px = float(vertical_px.median())
    spread_px = 1.4826 * float((vertical_px - offset_px).abs().median())
    far = disparity_px[disparity_px.abs() >= _MIN_DISPARITY_PX]
    share = float((far > 0).float().mean()) if len(far) else math.nan
    is_swapped = len(far) >= _MIN_MATCHES and share < _MAX_SHARE_SWAPPED
    is_rectified = abs(offset_px) <= _MAX_OFFSET_PX and spread_px <= _MAX_SPREAD_PX
    return RectificationReport(
        vertical_offset_px=offset_px, vertical_spread_px=spread_px, positive_share=share,
        matches=matches, is_rectified=is_rectified, is_swapped=is_swapped,
        message=_words(offset_px, spread_px, share, is_swapped=is_swapped, is_ok=is_rectified),
    )  # fmt: skip


def _words(
    offset_px: float, spread_px: float, share: float, *, is_swapped: bool, is_ok: bool
) -> str:
    if is_swapped:
        return (
            f"left and right look swapped: only {share:.0%} of the matches move to the left from "
            "the left image to the right one. Swap the two images"
        )
    if not is_ok:
        return (
            f"the pair is not rectified: matching points lie {offset_px:+.1f} rows apart (spread "
            f"{spread_px:.1f}). Rectify it with the calibration of the rig"
        )
    return "rows agree, and left is left"
