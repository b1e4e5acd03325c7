"""Check from the images alone that two images are a rectified pair, and left and right in order.

Corners (Shi and Tomasi 1994) of one image are matched to the whole of the other, on a reduced copy,
by zero-mean normalised cross-correlation (Lewis 1995). A match that is good, unambiguous and mutual
is refined to a fraction of a pixel on a larger copy.
"""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn import functional

from depthpose.core.arrays import grey_from_rgb
from depthpose.core.errors import InputError

# Matching of corners.
_COARSE_PIXELS = 36_000  # pixels of the copy on which corners are matched
_FINE_PIXELS = 180_000  # pixels of the copy on which matches are refined
_RADIUS = 5  # half side of a patch of the coarse copy: 11x11 pixels
_FINE_RADIUS = 7  # half side of a patch of the fine copy: 15x15 pixels
_FINE_REACH = 4  # pixels of the fine copy that are searched around a coarse match
_CELL = 8  # pixels; one corner a cell spreads the corners over the image
_MAX_CORNERS = 200
_MIN_CORNER = 1e-5  # smaller eigenvalue, for grey in [0, 1]: below is noise
_MIN_CONTRAST = 0.01  # standard deviation of the grey values of a patch
_MIN_DEVIATION = 0.004  # least standard deviation of the grey values of an image
_MIN_SCORE = 0.8  # correlation of a good match
_MAX_RIVAL = 0.95  # share of the best score: a second match so good means a repeated pattern
_RIVAL_RADIUS = 4  # pixels around the best match whose scores are part of its peak
_MUTUAL_PX = 1  # a corner that is matched back may miss itself by this much

# What the matches must be like in a rectified pair.
_MIN_MATCHES = 25
_MIN_WRONG = 12  # matches that show that rows differ, but not that they agree
_MIN_TEXTURED = 60  # corners of an image from which the shares below can be judged
_MIN_MATCHED_SHARE = 0.1  # share of the corners that match between both images of a pair
_MAX_ALIKE_SHARE = 0.7  # of the corners match something in another scene; more: a repeated pattern
_MAX_OFFSET_PX = 1.0  # street pairs have up to 0.3
_MAX_SPREAD_PX = 0.75  # street pairs have 0.1 to 0.4; a rotation by 0.3 degrees makes 1.2 to 2.5
_LIMITS_WIDTH = 1280  # in wider images the limits grow with the width
_MAX_SHARE_SWAPPED = 0.2  # largest share of positive disparities in a swapped pair
_SAME_PX = 0.5  # a match within this distance of the same pixel has not moved
_SAME_SHARE = 0.9  # share of matches that have not moved: both images show the same view
_MAD_TO_DEVIATION = 1.4826  # median absolute deviation to standard deviation, where normal
_FIT_ROUNDS = 5  # least-squares fits, each without the outliers of the one before
_INLIER_MEDIANS = 2.5  # residual of an inlier, in medians of all residuals

# Search for the change of a right image that does not match.
_TRIED_CORNERS = 100  # corners that are matched to a mirrored, rotated or scaled right image
_MIN_TRIED_MATCHES = 20  # least number of these corners that match
_TRIED_CHANGES = [
    *((sign * angle, 1.0) for angle in (90.0, 20.0, 40.0, 65.0) for sign in (1, -1)),
    (0.0, 1.5), (0.0, 0.67),
]  # fmt: skip
"""Rotations [degrees] and scales of the right image that are tried where it does not match."""

_GreyImage = Float[Tensor, "_ _"]
_Pixels = Int[Tensor, "n 2"]  # (column, row) of each


@dataclass(frozen=True, kw_only=True)
class RectificationReport:
    """Whether two images are a rectified pair, as the matches between them show.

    A number is NaN without matches, a judgement None with too few of them. The images are no pair
    where one shows nothing, both show the same view, or they are of different scenes.
    """

    vertical_offset_px: float = math.nan  #: median of the row in the right image less the left one
    #: median absolute deviation of these differences, as a standard deviation
    vertical_spread_px: float = math.nan
    #: share of positive disparities among those beyond 1 px; NaN: none is beyond
    positive_share: float = math.nan
    corners: int = 0  #: number of corners of the left image that were sought in the right one
    matches: int = 0  #: number of corners that were found there
    is_pair: bool | None = None  #: whether the images belong together
    is_rectified: bool | None = None  #: whether matches lie in the same rows
    is_swapped: bool | None = None  #: whether left and right are exchanged
    message: str  #: the findings in words, with a remedy where one is needed
    #: column and row of each match in the left image [px]
    places_px: Float[Tensor, "n 2"] = field(
        default_factory=lambda: torch.zeros(0, 2), repr=False, compare=False
    )
    #: column of each match in the left image less that in the right one [px]
    disparities_px: Float[Tensor, " n"] = field(
        default_factory=lambda: torch.zeros(0), repr=False, compare=False
    )

    @property
    def is_wrong(self) -> bool:
        """Whether depth of these images would be wrong."""
        return self.is_pair is False or self.is_rectified is False or bool(self.is_swapped)


def check_rectified(
    left: Float[Tensor, "3 h w"], right: Float[Tensor, "3 h2 w2"], cx_difference_px: float = 0.0
) -> RectificationReport:
    """Check by their content whether two images are a rectified pair, with left and right in order.

    Where few corners match, mirrored, rotated and scaled versions of the right image are tried, and
    the report names the change that explains it. Too few corners are no error, but undecided.

    Args:
        left: the left image, RGB in [0, 1].
        right: the right image, of the same size.
        cx_difference_px: principal point of the right image less that of the left one, in x.

    Raises:
        InputError: the sizes differ.
    """
    if left.shape != right.shape:
        left_size, right_size = (f"{image.shape[-1]}x{image.shape[-2]}" for image in (left, right))
        raise InputError(
            f"the left image is {left_size} but the right one {right_size}; both images of a "
            "rectified pair have one size, rectify them again"
        )
    if torch.equal(left, right):
        finding = "left and right are the same picture; give the view of each camera"
        return RectificationReport(is_pair=False, message=finding)
    with torch.no_grad():
        left_grey, right_grey = (_reduce_to_grey(image, _COARSE_PIXELS) for image in (left, right))
        for side, grey in (("left", left_grey), ("right", right_grey)):
            deviation = float(grey.std(correction=0))
            if deviation < _MIN_DEVIATION:
                finding = (
                    f"the {side} image shows nothing that could be matched: its grey values have "
                    f"a standard deviation of {deviation:.4f} (at least {_MIN_DEVIATION:g} is "
                    "needed); is the lens covered, or the file empty?"
                )
                return RectificationReport(is_pair=False, message=finding)

        corners = _find_corners(left_grey)
        coarse = _match_corners(left_grey, right_grey, corners)
        if len(coarse.source_px) < _MIN_MATCHES:
            report = _explain_few_matches(left_grey, right_grey, corners, coarse)
            if report is not None:
                return report
        matches = _refine_matches(left, right, coarse)

    report = _judge_matches(matches, len(corners), left.shape[-1], cx_difference_px)
    centre_px = torch.tensor([left.shape[-1], left.shape[-2]]) / 2
    return replace(
        report,
        places_px=matches.from_centre_px + centre_px,
        disparities_px=-matches.shift_px[:, 0].float(),
    )


def _explain_few_matches(
    left: _GreyImage, right: _GreyImage, corners: _Pixels, coarse: "_CoarseMatches"
) -> RectificationReport | None:
    """Report that the right image is changed, or of another scene; None where neither is clear.

    Args:
        left: coarse copy of the left image.
        right: coarse copy of the right image.
        corners: all corners of the left one.
        coarse: the few of them that match.
    """
    match_count = len(coarse.source_px)
    unmatched = RectificationReport(corners=len(corners), matches=match_count, message="")
    change = _find_change(left, right, corners)
    if change is not None:
        return replace(unmatched, is_rectified=False, message=change)

    has_few_matches = match_count < _MIN_MATCHED_SHARE * len(corners)
    has_repeated_pattern = coarse.good_count >= _MAX_ALIKE_SHARE * len(corners)
    is_textured = len(corners) >= _MIN_TEXTURED
    if not has_few_matches or has_repeated_pattern or not is_textured:
        return None
    finding = (
        f"the images do not belong together: {match_count} of {len(corners)} corners of the left "
        f"image are found in the right one (at least {_MIN_MATCHED_SHARE:.0%} are needed); give "
        "both views of one moment"
    )
    return replace(unmatched, is_pair=False, message=finding)


def _find_corners(grey: _GreyImage) -> _Pixels:
    """Find the strongest corner in each cell of an image, the strongest of all first.

    The strength is the smaller eigenvalue of the structure tensor (Shi and Tomasi 1994).
    """
    # Structure tensor [[xx, xy], [xy, yy]]: products of the gradient, averaged over 5x5 pixels.
    padded = functional.pad(grey[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    dx = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    dy = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    products = torch.stack([dx * dx, dx * dy, dy * dy])[None]
    xx, xy, yy = functional.avg_pool2d(products, 5, stride=1, padding=2)[0]
    eigenvalue = (xx + yy) / 2 - ((xx - yy).square() / 4 + xy.square()).sqrt()

    # Patches around corners must lie inside the image.
    inner = slice(_RADIUS, -_RADIUS)
    strength = torch.zeros_like(eigenvalue)
    strength[inner, inner] = eigenvalue[inner, inner]

    best, index = functional.max_pool2d(
        strength[None, None], _CELL, ceil_mode=True, return_indices=True
    )
    strongest = best.flatten().topk(min(_MAX_CORNERS, best.numel()))
    is_corner = strongest.values > _MIN_CORNER
    pixels = index.flatten()[strongest.indices[is_corner]]
    return torch.stack([pixels % grey.shape[1], pixels // grey.shape[1]], -1)


class _CoarseMatches(NamedTuple):
    """Corners of one copy that have a mutual, unambiguous match in the other."""

    source_px: _Pixels  # the corners
    target_px: _Pixels  # their matches
    good_count: int  # number of corners with any good match, ambiguous ones too


def _match_corners(source: _GreyImage, target: _GreyImage, corners: _Pixels) -> _CoarseMatches:
    """Match corners of ``source`` to ``target``, and back."""
    forth = _match_patches(source, target, corners)
    is_usable = forth.is_good & forth.is_unambiguous
    source_px = corners[is_usable]
    target_px = forth.target_px[is_usable]

    back = _match_patches(target, source, target_px)
    returns = ((back.target_px - source_px).abs() <= _MUTUAL_PX).all(-1)
    is_mutual = returns & back.is_good & back.is_unambiguous
    return _CoarseMatches(
        source_px=source_px[is_mutual],
        target_px=target_px[is_mutual],
        good_count=int(forth.is_good.sum()),
    )


class _PatchMatches(NamedTuple):
    """The best match of each patch in the whole target."""

    target_px: _Pixels
    is_good: Bool[Tensor, " n"]  # it correlates well
    is_unambiguous: Bool[Tensor, " n"]  # no other place correlates about as well


def _match_patches(source: _GreyImage, target: _GreyImage, corners: _Pixels) -> _PatchMatches:
    """Match the patch of ``source`` around each corner to all patches of ``target``."""
    if len(corners) == 0:
        no_flags = corners[:, 0].bool()
        return _PatchMatches(corners, no_flags, no_flags)

    # Correlation of each patch with all patches of the target: their product, where the patch has
    # a mean of 0 and a norm of 1, divided by the norm of the target's patch about its mean.
    side = 2 * _RADIUS + 1
    patches = _normalise_patches(_crop_windows(source, corners - _RADIUS, side))
    mean, mean_square = functional.avg_pool2d(torch.stack([target, target.square()]), side, 1)
    deviation = (mean_square - mean.square()).clamp_min(0).sqrt()
    products = functional.conv2d(target[None, None], patches[:, None])[0]
    scores = products / (side * deviation.clamp_min(1e-6))
    scores = scores.where(deviation > _MIN_CONTRAST, -1)
    best, index = scores.flatten(1).max(1)
    column = index % scores.shape[2]
    row = index // scores.shape[2]

    # The second best match, apart from the surroundings of the best.
    scores = functional.pad(scores, (_RIVAL_RADIUS,) * 4, value=-1.0)
    steps = torch.arange(2 * _RIVAL_RADIUS + 1)
    n = torch.arange(len(corners))[:, None, None]
    scores[n, row[:, None, None] + steps[:, None], column[:, None, None] + steps] = -1
    rival = scores.flatten(1).amax(1)
    return _PatchMatches(
        target_px=torch.stack([column, row], -1) + _RADIUS,
        is_good=best > _MIN_SCORE,
        is_unambiguous=rival < _MAX_RIVAL * best,
    )


def _crop_windows(image: _GreyImage, first: _Pixels, side: int) -> Float[Tensor, "n side side"]:
    """Crop square windows out of an image; ``first`` are their upper left pixels."""
    steps = torch.arange(side)
    columns = first[:, 0, None, None] + steps
    rows = first[:, 1, None, None] + steps[:, None]
    return image[rows, columns]


def _normalise_patches(patches: Tensor) -> Tensor:
    """Scale patches (..., h, w) to a mean of 0 and a norm of 1."""
    centred = patches - patches.mean((-2, -1), keepdim=True)
    return centred / centred.norm(dim=(-2, -1), keepdim=True).clamp_min(1e-6)


class _Matches(NamedTuple):
    """Refined matches, in pixels of the images."""

    from_centre_px: Float[Tensor, "n 2"]  # place in the left image, from its centre
    shift_px: Float[Tensor, "n 2"]  # place in the right image less that in the left one


def _refine_matches(
    left: Float[Tensor, "3 h w"], right: Float[Tensor, "3 h w"], coarse: _CoarseMatches
) -> _Matches:
    """Refine matches of the coarse copies to a fraction of a pixel; bad ones are left out."""
    left_grey, right_grey = (_reduce_to_grey(image, _FINE_PIXELS) for image in (left, right))
    enlargement = left_grey.shape[1] / _reduce_to_grey(left, _COARSE_PIXELS).shape[1]
    left_px, right_px = (
        ((pixels + 0.5) * enlargement - 0.5).round().long()
        for pixels in (coarse.source_px, coarse.target_px)
    )

    # Correlate each left patch with all patches up to _FINE_REACH pixels from the coarse match.
    # In padded images a pixel lies ``rim`` farther, and its patch begins _FINE_RADIUS before it.
    side = 2 * _FINE_RADIUS + 1
    rim = _FINE_RADIUS + _FINE_REACH
    left_padded = functional.pad(left_grey, (rim,) * 4)
    right_padded = functional.pad(right_grey, (rim,) * 4)
    patches = _normalise_patches(_crop_windows(left_padded, left_px + _FINE_REACH, side))
    windows = _crop_windows(right_padded, right_px, 2 * rim + 1)
    candidates = _normalise_patches(windows.unfold(1, side, 1).unfold(2, side, 1))
    scores = (candidates * patches[:, None, None]).sum((-2, -1))

    # A best match at the border of the search has its peak beyond it.
    best, index = scores.flatten(1).max(1)
    row = index // scores.shape[2]
    column = index % scores.shape[2]
    last = 2 * _FINE_REACH
    is_good = (best > _MIN_SCORE) & (row > 0) & (row < last) & (column > 0) & (column < last)

    # Along each axis the top of the parabola through three scores, half a pixel off at most:
    # (after - before) / (2 (2 middle - before - after)).
    row = row.clamp(1, last - 1)
    column = column.clamp(1, last - 1)
    n = torch.arange(len(left_px))
    peak = torch.stack([column, row], -1).float()
    for axis in (0, 1):
        before, middle, after = (
            scores[n, row + step * axis, column + step * (1 - axis)] for step in (-1, 0, 1)
        )
        curvature = (2 * middle - before - after).clamp_min(1e-6)
        peak[:, axis] += ((after - before) / (2 * curvature)).clamp(-0.5, 0.5)

    # From the fine copy to the pixels of the image.
    shift = right_px - left_px + peak - _FINE_REACH
    scale = left_grey.shape[1] / left.shape[2]
    centre = torch.tensor([left_grey.shape[1], left_grey.shape[0]]) / 2
    from_centre_px = (left_px - centre) / scale
    return _Matches(from_centre_px=from_centre_px[is_good], shift_px=(shift / scale)[is_good])


def _find_change(left: _GreyImage, right: _GreyImage, corners: _Pixels) -> str | None:
    """Find out whether the right image is mirrored, rotated or scaled beside the left one.

    With each change undone, some of the ``corners`` of the left image are matched to it.

    Returns:
        The change in words; None where none explains that the images do not match.
    """
    tried_corners = corners[:_TRIED_CORNERS]
    flips = {
        "mirrored": right.flip(1),
        "upside down": right.flip(0, 1),
        "mirrored top to bottom": right.flip(0),
    }
    for change, restored in flips.items():
        matches = _match_corners(left, restored, tried_corners)
        if len(matches.source_px) >= _MIN_TRIED_MATCHES:
            return f"the right image is {change} beside the left one; turn it back"
    for rotation_deg, scale in _TRIED_CHANGES:
        # Sampled at points farther apart by the scale, an image that was enlarged shrinks back.
        restored = _warp(right, -rotation_deg, scale)
        matches = _match_corners(left, restored, tried_corners)
        if len(matches.source_px) >= _MIN_TRIED_MATCHES:
            shift_px = matches.target_px - matches.source_px
            remaining = _fit_rows(matches.source_px, shift_px[:, 1])
            total_deg = round(rotation_deg + remaining.rotation_deg)
            return (
                f"the right image is turned by about {total_deg} degrees and scaled by about "
                f"{scale * remaining.scale:.2f} beside the left one; rectify the pair"
            )
    return None


def _warp(image: _GreyImage, rotation_deg: float, scale: float) -> _GreyImage:
    """Resample an image at points that are rotated about its centre and scaled from there."""
    height, width = image.shape
    cosine = scale * math.cos(math.radians(rotation_deg))
    sine = scale * math.sin(math.radians(rotation_deg))
    affine = torch.tensor(
        [[[cosine, sine * height / width, 0], [-sine * width / height, cosine, 0]]]
    )
    grid = functional.affine_grid(affine, [1, 1, height, width], align_corners=False)
    return functional.grid_sample(image[None, None], grid, align_corners=False)[0, 0]


def _judge_matches(
    matches: _Matches, corners: int, width: int, cx_difference_px: float
) -> RectificationReport:
    """Judge a pair by its matches: whether it is one, rectified, and not swapped.

    Args:
        matches: refined matches.
        corners: number of corners that were to be matched.
        width: width of the images [px].
        cx_difference_px: principal point of the right image less that of the left one, in x.
    """
    # Disparities near 0 say nothing about the order of the images.
    disparity_px = cx_difference_px - matches.shift_px[:, 0]
    clear_px = disparity_px[disparity_px.abs() > 1]
    positive_share = float((clear_px > 0).float().mean()) if len(clear_px) else math.nan

    # By how much rows differ: median, and median absolute deviation.
    match_count = len(matches.shift_px)
    offset_px = math.nan
    spread_px = math.nan
    if match_count:
        row_shift_px = matches.shift_px[:, 1]
        offset_px = float(row_shift_px.median())
        spread_px = _MAD_TO_DEVIATION * float((row_shift_px - offset_px).abs().median())

    growth = max(1.0, width / _LIMITS_WIDTH)
    unmoved_px = growth * _SAME_PX
    unmoved_share = float((matches.shift_px.abs().amax(-1) <= unmoved_px).float().mean())
    max_offset_px = growth * _MAX_OFFSET_PX
    max_spread_px = growth * _MAX_SPREAD_PX
    is_level = abs(offset_px) <= max_offset_px and spread_px <= max_spread_px
    is_decided = match_count >= _MIN_MATCHES or (match_count >= _MIN_WRONG and not is_level)
    is_order_decided = len(clear_px) >= _MIN_MATCHES

    report = RectificationReport(
        vertical_offset_px=offset_px,
        vertical_spread_px=spread_px,
        positive_share=positive_share,
        corners=corners,
        matches=match_count,
        is_pair=unmoved_share < _SAME_SHARE if is_decided else None,
        is_rectified=is_level if is_decided else None,
        is_swapped=positive_share <= _MAX_SHARE_SWAPPED if is_order_decided else None,
        message="",
    )
    if not is_decided:
        message = (
            f"only {match_count} of the {_MIN_MATCHES} matches needed: cannot tell whether the "
            "pair is rectified"
        )
        return replace(report, message=message)

    findings: list[str] = []
    if report.is_pair is False:
        findings.append(
            f"left and right show the same view: {unmoved_share:.0%} of what matches lies within "
            f"{unmoved_px:.2g} px of its place; give the view of each camera"
        )
    elif report.is_swapped:
        findings.append(
            f"left and right look swapped (only {positive_share:.0%} of disparities are positive); "
            "exchange the two images (or both are mirrored: mirror them back)"
        )
    if report.is_rectified is False:
        change = _describe_rotation(matches, spread_px)
        findings.append(
            f"rows do not agree: the right image lies {offset_px:+.1f} px lower, with a spread of "
            f"{spread_px:.1f} px{change} (at most {max_offset_px:.3g} and {max_spread_px:.3g} are "
            "allowed); rectify the pair ('depthpose data rectify', with the calibration of both "
            "cameras)"
        )
    if not findings:
        findings = [f"rows agree to {abs(offset_px):.1f} px, with a spread of {spread_px:.1f} px"]
    return replace(report, message=f"{'. '.join(findings)} ({match_count} matches)")


def _describe_rotation(matches: _Matches, spread_px: float) -> str:
    """Describe the rotation and scale of the right image that explain most of the spread of rows.

    "" where none does.
    """
    fit = _fit_rows(matches.from_centre_px, matches.shift_px[:, 1])
    if fit.residual_px >= spread_px / 2:
        return ""
    return f", turned by {fit.rotation_deg:+.1f} degrees and scaled by {fit.scale:.3f}"


class _RowFit(NamedTuple):
    """How the right image is rotated and scaled beside the left one."""

    rotation_deg: float
    scale: float
    residual_px: float  # deviation of the rows that is left


def _fit_rows(from_centre_px: Shaped[Tensor, "n 2"], lower_px: Shaped[Tensor, " n"]) -> _RowFit:
    """Fit how the right image is rotated and scaled, by least squares that drop outliers.

    Rotated by a small angle and scaled, a point (x, y) lies ``c + angle * x + (scale - 1) * y``
    lower.

    Args:
        from_centre_px: pixels of matched corners, from the centre of the image.
        lower_px: by how much each lies lower in the right image.
    """
    from_centre_px = from_centre_px.float()
    lower_px = lower_px.float()
    design = torch.cat([torch.ones_like(from_centre_px[:, :1]), from_centre_px], -1)
    is_inlier = torch.ones_like(lower_px, dtype=torch.bool)
    residual_px = lower_px
    fit = lower_px.new_zeros(3)
    for _ in range(_FIT_ROUNDS):
        fit = torch.linalg.lstsq(design[is_inlier], lower_px[is_inlier, None]).solution[:, 0]
        residual_px = (lower_px - design @ fit).abs()
        # The margin keeps all points of a perfect fit.
        is_inlier = residual_px <= _INLIER_MEDIANS * residual_px.median() + 1e-3
    _, x_slope, y_slope = fit.tolist()
    return _RowFit(
        rotation_deg=math.degrees(math.atan(x_slope)),
        scale=1 + y_slope,
        residual_px=_MAD_TO_DEVIATION * float(residual_px.median()),
    )


def _reduce_to_grey(image: Float[Tensor, "3 h w"], pixels: int) -> Float[Tensor, "h2 w2"]:
    """Convert an image to grey with a mean of 0, reduced to at most ``pixels`` pixels."""
    grey = grey_from_rgb(image).float()
    scale = math.sqrt(pixels / grey.numel())
    if scale < 1:
        size = [max(1, round(side * scale)) for side in grey.shape]
        grey = functional.interpolate(grey[None, None], size, mode="area")[0, 0]
    # Correlation is the more exact the nearer the values lie to 0.
    return (grey - grey.mean()).cpu()
