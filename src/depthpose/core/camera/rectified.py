"""Check from the images alone that a pair is rectified, and left and right not swapped.

Corners of the left image are sought in the right one over a window that a rectified pair does not
need: rows above and below, columns on both sides. Where they are found shows what was done to the
pair.

Corners of one image are found in the other by zero-mean normalised cross-correlation, computed by
FFT (Lewis 1995), of corners chosen by the smaller eigenvalue of the structure tensor (Shi and
Tomasi 1994). A match is kept where it is good, has no rival and is mutual.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from depthpose.core.arrays import grey_of
from depthpose.core.errors import InputError

REACH_X, REACH_Y = 192, 6
_RADIUS = 7  # of a patch: 15x15 pixels
_SIDE = 2 * _RADIUS + 1
_CELL = 24  # one corner a cell spreads the corners over the image
_MAX_CORNERS = 320
_MIN_CORNER = 1e-5  # smaller eigenvalue, for grey in [0, 1]: below is noise
_MIN_CONTRAST = 0.01 * _SIDE  # norm of a patch less its mean: a standard deviation of 0.01
_MIN_SCORE = 0.8
_MAX_RIVAL = 0.95  # of the best score: a rival so near means a repeated pattern
_RIVAL_RADIUS = 5
_RETURN_PX = 1


def match_corners(
    left: Float[Tensor, "h w"], right: Float[Tensor, "h w"]
) -> Float[Tensor, "matches 2"]:
    """Find corners of the left grey image in the right one.

    Returns:
        Shifts (x, y), right less left [px], of the matches that can be trusted.
    """
    if min(left.shape) < 2 * _CELL:
        return left.new_empty(0, 2)
    corners = _find_corners(left)
    if len(corners) == 0:
        return left.new_empty(0, 2)
    shift, is_good = _search(left, right, corners)
    corners, shift = corners[is_good], shift[is_good]
    if len(corners) == 0:
        return left.new_empty(0, 2)
    back, is_good = _search(right, left, corners + shift.round().long())
    is_mutual = ((back + shift).abs() <= _RETURN_PX).all(-1) & is_good
    return shift[is_mutual]


def _find_corners(grey: Float[Tensor, "h w"]) -> Int[Tensor, "n 2"]:
    padded = functional.pad(grey[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    dx, dy = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2, (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    products = torch.stack([dx * dx, dx * dy, dy * dy])[None]
    xx, xy, yy = functional.avg_pool2d(products, 7, stride=1, padding=3)[0]
    smaller = (xx + yy) / 2 - ((xx - yy).square() / 4 + xy.square()).sqrt()
    inside = torch.zeros_like(smaller)
    inside[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS] = smaller[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS]
    best, index = functional.max_pool2d(inside[None, None], _CELL, return_indices=True)
    strongest = best.flatten().topk(min(_MAX_CORNERS, best.numel()))
    places = index.flatten()[strongest.indices[strongest.values > _MIN_CORNER]]
    return torch.stack([places % grey.shape[1], places // grey.shape[1]], -1)


def _search(
    source: Float[Tensor, "h w"], target: Float[Tensor, "h w"], corners: Int[Tensor, "n 2"]
) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, " n"]]:
    """Find the best shift of each corner, to a fraction of a pixel, and whether to trust it."""
    scores = _scores(source, target, corners)
    columns = scores.shape[-1]
    best, index = scores.flatten(1).max(1)
    row, column = index // columns, index % columns
    is_inside = (row > 0) & (row < 2 * REACH_Y) & (column > 0) & (column < 2 * REACH_X)
    rival = _rival(scores, row, column)
    is_good = is_inside & (best > _MIN_SCORE) & (rival < _MAX_RIVAL * best)
    # A best score at the rim is not trusted, so there any neighbour will do.
    row, column = row.clamp(1, 2 * REACH_Y - 1), column.clamp(1, 2 * REACH_X - 1)
    n = torch.arange(len(corners), device=scores.device)
    x = column + _peak(*(scores[n, row, column + i] for i in (-1, 0, 1)))
    y = row + _peak(*(scores[n, row + i, column] for i in (-1, 0, 1)))
    return torch.stack([x - REACH_X, y - REACH_Y], -1), is_good


def _scores(
    source: Float[Tensor, "h w"], target: Float[Tensor, "h w"], corners: Int[Tensor, "n 2"]
) -> Float[Tensor, "n rows columns"]:
    """Correlate each corner's patch with the target at every shift of the window, in [-1, 1]."""
    rim_x, rim_y = REACH_X + _RADIUS, REACH_Y + _RADIUS
    rows, columns = 2 * REACH_Y + 1, 2 * REACH_X + 1
    patches = _windows(functional.pad(source, (_RADIUS,) * 4), corners, _SIDE, _SIDE)
    patches = patches - patches.mean((1, 2), keepdim=True)
    padded = functional.pad(target, (rim_x, rim_x, rim_y, rim_y))
    strips = _windows(padded, corners, rows + 2 * _RADIUS, columns + 2 * _RADIUS)
    spectrum = torch.fft.rfft2(strips) * torch.fft.rfft2(patches, s=strips.shape[1:]).conj()
    products = torch.fft.irfft2(spectrum, s=strips.shape[1:])[:, :rows, :columns]
    contrast = _windows(_contrast(padded), corners, rows, columns)
    is_image = functional.pad(torch.ones_like(target), (rim_x, rim_x, rim_y, rim_y))
    is_whole = _windows(_box_mean(is_image) > 0.999, corners, rows, columns)
    norm = contrast * patches.norm(dim=(1, 2))[:, None, None]
    is_usable = is_whole & (contrast > _MIN_CONTRAST)
    return torch.where(is_usable, products / norm.clamp_min(1e-6), -1)


def _windows(image: Tensor, corners: Int[Tensor, "n 2"], height: int, width: int) -> Tensor:
    """Cut ``height`` x ``width`` windows whose first pixels are the corners' (x, y)."""
    rows = corners[:, 1, None] + torch.arange(height, device=image.device)
    columns = corners[:, 0, None] + torch.arange(width, device=image.device)
    return image[rows[:, :, None], columns[:, None, :]]


def _contrast(image: Float[Tensor, "h w"]) -> Float[Tensor, "h2 w2"]:
    variance = _box_mean(image.square()) - _box_mean(image).square()
    return variance.clamp_min(0).sqrt() * _SIDE


def _box_mean(image: Float[Tensor, "h w"]) -> Float[Tensor, "h2 w2"]:
    return functional.avg_pool2d(image[None, None], _SIDE, stride=1)[0, 0]


def _rival(
    scores: Float[Tensor, "n rows columns"], row: Int[Tensor, " n"], column: Int[Tensor, " n"]
) -> Float[Tensor, " n"]:
    rows = torch.arange(scores.shape[1], device=scores.device)
    columns = torch.arange(scores.shape[2], device=scores.device)
    is_near_row = (rows - row[:, None]).abs() <= _RIVAL_RADIUS
    is_near_column = (columns - column[:, None]).abs() <= _RIVAL_RADIUS
    is_near = is_near_row[:, :, None] & is_near_column[:, None, :]
    return scores.masked_fill(is_near, -1).flatten(1).amax(1)


def _peak(
    before: Float[Tensor, " n"], at: Float[Tensor, " n"], after: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """Place the top of the parabola through three scores, within half a pixel of the middle."""
    curvature = (2 * at - before - after).clamp_min(1e-6)
    return ((after - before) / (2 * curvature)).clamp(-0.5, 0.5)


_WORK_WIDTH = 1280
_MIN_MATCHES = 25
_MAX_OFFSET_PX = 1.0  # street pairs have up to 0.3
_MAX_SPREAD_PX = 0.75  # street pairs have 0.1 to 0.4; a turn by 0.3 degrees makes 1.2 to 2.5
_MAX_SHARE_SWAPPED = 0.2
_MAD_TO_DEVIATION = 1.4826  # of a normal distribution


@dataclass(frozen=True, kw_only=True)
class RectificationReport:
    """What the matches between two images say about the pair.

    Attributes:
        vertical_offset_px: median of the right row less the left row; NaN without matches.
        vertical_spread_px: median absolute deviation of it, scaled to a standard deviation.
        positive_share: share of positive disparities among those beyond a pixel; NaN where there
            are none.
        matches: matches that all this rests on.
        is_rectified: whether rows agree; None with too few matches.
        is_swapped: whether the left image is the right one; None with too few matches.
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
    left: Float[Tensor, "3 h w"], right: Float[Tensor, "3 h2 w2"]
) -> RectificationReport:
    """Check that the rows of a pair agree and that left is left.

    Offsets below 6 rows and disparities below 192 columns are found; images wider than 1280 are
    scaled down first, which widens both. Too few matches (a dark or bare scene, a larger offset)
    give None, not an error; if enough match once the right image is mirrored or rotated,
    that is reported.

    Raises:
        InputError: the sizes differ.
    """
    if left.shape != right.shape:
        raise InputError(
            f"the left image is {_size(left)} but the right one {_size(right)}; both images of a "
            "rectified pair have one size, rectify them again"
        )
    scale = min(1.0, _WORK_WIDTH / left.shape[-1])
    with torch.no_grad():
        one, other = _grey(left, scale), _grey(right, scale)
        shift_px = match_corners(one, other) / scale
        if len(shift_px) < _MIN_MATCHES:
            for how, turned in _turned(other).items():
                if len(match_corners(one, turned)) >= _MIN_MATCHES:
                    return _turned_report(shift_px, how)
    return _report(shift_px)


def _turned(grey: Float[Tensor, "h w"]) -> dict[str, Float[Tensor, "h w"]]:
    return {
        "mirrored": grey.flip(1),
        "upside down": grey.flip(0, 1),
        "mirrored top to bottom": grey.flip(0),
    }


def _turned_report(shift_px: Float[Tensor, "n 2"], how: str) -> RectificationReport:
    return replace(
        _report(shift_px),
        is_rectified=False,
        message=f"the right image is {how} beside the left one; turn it back",
    )


def _report(shift_px: Float[Tensor, "n 2"]) -> RectificationReport:
    disparity_px = -shift_px[:, 0]
    clear = disparity_px[disparity_px.abs() > 1]
    offset = float(shift_px[:, 1].nanmedian()) if len(shift_px) else math.nan
    deviation = (shift_px[:, 1] - offset).abs()
    spread = _MAD_TO_DEVIATION * float(deviation.nanmedian()) if len(shift_px) else math.nan
    share = float((clear > 0).float().mean()) if len(clear) else math.nan
    is_known, is_order_known = len(shift_px) >= _MIN_MATCHES, len(clear) >= _MIN_MATCHES
    is_level = abs(offset) <= _MAX_OFFSET_PX and spread <= _MAX_SPREAD_PX
    is_rectified = is_level if is_known else None
    is_swapped = share <= _MAX_SHARE_SWAPPED if is_order_known else None
    return RectificationReport(
        vertical_offset_px=offset,
        vertical_spread_px=spread,
        positive_share=share,
        matches=len(shift_px),
        is_rectified=is_rectified,
        is_swapped=is_swapped,
        message=_message(shift_px, (offset, spread, share), (is_rectified, is_swapped)),
    )


def _message(
    shift_px: Float[Tensor, "n 2"],
    measured: tuple[float, float, float],
    verdict: tuple[bool | None, bool | None],
) -> str:
    offset, spread, share = measured
    is_rectified, is_swapped = verdict
    if is_rectified is None:
        return (
            f"only {len(shift_px)} of the {_MIN_MATCHES} matches needed: cannot tell whether the "
            "pair is rectified"
        )
    findings = []
    if is_swapped:
        findings.append(
            f"left and right look swapped (only {share:.0%} of disparities are positive); exchange "
            "the two images (or both are mirrored: mirror them back)"
        )
    if not is_rectified:
        findings.append(
            f"rows do not agree: the right image lies {offset:+.1f} px lower, with a spread of "
            f"{spread:.1f} px (at most {_MAX_OFFSET_PX:g} and {_MAX_SPREAD_PX:g} are allowed); "
            "rectify the pair ('depthpose data rectify', with the calibration of both cameras)"
        )
    good = f"rows agree to {abs(offset):.1f} px, with a spread of {spread:.1f} px"
    return f"{'. '.join(findings) or good} ({len(shift_px)} matches)"


def _grey(image: Float[Tensor, "3 h w"], scale: float) -> Float[Tensor, "h2 w2"]:
    grey = grey_of(image).float()
    if scale < 1:
        height, width = (max(1, round(size * scale)) for size in grey.shape)
        grey = functional.interpolate(grey[None, None], (height, width), mode="area")[0, 0]
    # Correlation by FFT is the more exact the nearer the values lie to 0.
    return grey - grey.mean()


def _size(image: Float[Tensor, "3 h w"]) -> str:
    return f"{image.shape[-1]}x{image.shape[-2]}"
