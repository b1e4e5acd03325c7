"""Check from the images alone that two images are a rectified pair, and left and right in order.

Corners (Shi and Tomasi 1994) of one image are sought in the whole of the other, on a reduced copy,
by zero-mean normalised cross-correlation (Lewis 1995); a match that is good, has no rival and is
mutual is placed to a fraction of a pixel on a larger copy.
"""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from depthpose.core.errors import InputError

_COARSE_PIXELS = 36_000  # of the copy in which matches are sought
_FINE_PIXELS = 180_000  # of that in which they are placed
_RADIUS = 5  # of a patch of the coarse copy: 11x11 pixels
_FINE_RADIUS = 7  # of a patch of the fine copy: 15x15 pixels
_REACH = 4  # of the fine search around a coarse match
_CELL = 8  # one corner a cell spreads the corners over the image
_MAX_CORNERS = 200
_MIN_CORNER = 1e-5  # smaller eigenvalue, for grey in [0, 1]: below is noise
_MIN_CONTRAST = 0.01  # standard deviation of the grey values of a patch
_MIN_DEVIATION = 0.004  # of those of an image
_MIN_SCORE = 0.8
_MAX_RIVAL = 0.95  # of the best score: a rival so near means a repeated pattern
_RIVAL_RADIUS = 4
_RETURN_PX = 1

_MIN_MATCHES = 25
_MIN_WRONG = 12  # so few show that rows differ, but not that they agree
_MIN_TEXTURED = 60  # corners of an image from which the share below can be judged
_MIN_FOUND = 0.1  # share of the corners that both images of a pair have in common
_MAX_ALIKE = 0.7  # of them look like some place of another scene; more is a repeated pattern
_MAX_OFFSET_PX = 1.0  # street pairs have up to 0.3
_MAX_SPREAD_PX = 0.75  # street pairs have 0.1 to 0.4; a turn by 0.3 degrees makes 1.2 to 2.5
_LIMITS_WIDTH = 1280  # of wider images the limits grow with the width
_MAX_SHARE_SWAPPED = 0.2
_SAME_PX = 0.5  # a match within this of its own place has not moved
_SAME_SHARE = 0.9  # of matches that have not moved: both images show the same view
_MAD_TO_DEVIATION = 1.4826  # of a normal distribution
_SOME_CORNERS = 100  # that are looked for in a mirrored, turned or scaled right image
_MIN_SOME = 20  # of them that must match there
_LUMA = (0.299, 0.587, 0.114)  # shares of red, green and blue in the brightness, ITU-R BT.601
_CHANGES = [
    *((sign * turn, 1.0) for turn in (90.0, 20.0, 40.0, 65.0) for sign in (1, -1)),
    (0.0, 1.5), (0.0, 0.67),
]  # fmt: skip
"""Turns [degrees] and scales of the right image that are tried where it does not match."""

Grey = Float[Tensor, "_ _"]
Places = Int[Tensor, "_ 2"]
Flags = Bool[Tensor, "_"]


@dataclass(frozen=True, kw_only=True)
class RectificationReport:
    """What the matches between two images say about the pair.

    NaN stands where there are no matches, None where there are too few. They are no pair where one
    image shows nothing, both show the same view, or they do not belong together.
    """

    vertical_offset_px: float = math.nan  #: median of the right row less the left row
    vertical_spread_px: float = math.nan  #: its median absolute deviation, as a standard deviation
    positive_share: float = math.nan  #: of disparities beyond 1 px; NaN: none is
    corners: int = 0  #: corners of the left image that were sought in the right one
    matches: int = 0  #: matches that all this rests on
    is_pair: bool | None = None  #: whether the images belong together
    is_rectified: bool | None = None  #: whether rows agree
    is_swapped: bool | None = None  #: whether the left image is the right one
    message: str  #: the finding, and the remedy where there is one
    #: column and row in the left image of each match [px]
    places_px: Float[Tensor, "n 2"] = field(
        default_factory=lambda: torch.zeros(0, 2), repr=False, compare=False
    )
    #: column of each match in the left image less that in the right one [px]
    disparities_px: Float[Tensor, " n"] = field(
        default_factory=lambda: torch.zeros(0), repr=False, compare=False
    )

    @property
    def is_wrong(self) -> bool:
        """Whether a pair like this gives wrong depth."""
        return self.is_pair is False or self.is_rectified is False or bool(self.is_swapped)


def check_rectified(
    left: Float[Tensor, "3 h w"], right: Float[Tensor, "3 h2 w2"], cx_difference_px: float = 0.0
) -> RectificationReport:
    """Check that two images are a pair, that its rows agree and that left is left.

    Where too few corners match, the right image is also sought mirrored, turned and scaled, and
    what is found is reported; a scene with too few corners gives None, not an error.

    Args:
        left: RGB in [0, 1].
        right: of the same size.
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
        # Images without texture match nothing.
        left_grey, right_grey = (_grey(image, _COARSE_PIXELS) for image in (left, right))
        for side, grey in (("left", left_grey), ("right", right_grey)):
            deviation = float(grey.std(correction=0))
            if deviation < _MIN_DEVIATION:
                finding = (
                    f"the {side} image shows nothing that could be matched: its grey values have "
                    f"a standard deviation of {deviation:.4f} (at least {_MIN_DEVIATION:g} is "
                    "needed); is the lens covered, or the file empty?"
                )
                return RectificationReport(is_pair=False, message=finding)

        # Where few corners match: is one image changed, or of another scene?
        corners = _find_corners(left_grey)
        places, matched, alike_count = _match_corners(left_grey, right_grey, corners)
        if len(places) < _MIN_MATCHES:
            unlike = RectificationReport(corners=len(corners), matches=len(places), message="")
            change = _find_change(left_grey, right_grey, corners)
            if change is not None:
                return replace(unlike, is_rectified=False, message=change)
            has_few_matches = len(places) < _MIN_FOUND * len(corners)
            is_other = has_few_matches and alike_count < _MAX_ALIKE * len(corners)
            if is_other and len(corners) >= _MIN_TEXTURED:
                finding = (
                    f"the images do not belong together: {len(places)} of {len(corners)} corners "
                    f"of the left image are found in the right one (at least {_MIN_FOUND:.0%} are "
                    "needed); give both views of one moment"
                )
                return replace(unlike, is_pair=False, message=finding)
        matched_px, shift_px = _place_finely(left, right, places, matched)
    report = _report(matched_px, shift_px, len(corners), left.shape[-1], cx_difference_px)
    centre = torch.tensor([left.shape[-1], left.shape[-2]]) / 2
    return replace(report, places_px=matched_px + centre, disparities_px=-shift_px[:, 0].float())


def _find_corners(grey: Grey) -> Places:
    padded = functional.pad(grey[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    dx = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    dy = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    products = torch.stack([dx * dx, dx * dy, dy * dy])[None]
    xx, xy, yy = functional.avg_pool2d(products, 5, stride=1, padding=2)[0]
    smaller = (xx + yy) / 2 - ((xx - yy).square() / 4 + xy.square()).sqrt()
    inside = torch.zeros_like(smaller)
    inside[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS] = smaller[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS]
    best, index = functional.max_pool2d(
        inside[None, None], _CELL, ceil_mode=True, return_indices=True
    )
    strongest = best.flatten().topk(min(_MAX_CORNERS, best.numel()))
    places = index.flatten()[strongest.indices[strongest.values > _MIN_CORNER]]
    return torch.stack([places % grey.shape[1], places // grey.shape[1]], -1)


def _match_corners(source: Grey, target: Grey, corners: Places) -> tuple[Places, Places, int]:
    """Give corners with a mutual match, where they match, and how many have any good match."""
    matched, is_alike, is_sole = _search_patches(source, target, corners)
    alike_count = int(is_alike.sum())
    corners = corners[is_alike & is_sole]
    matched = matched[is_alike & is_sole]
    back, is_alike, is_sole = _search_patches(target, source, matched)
    is_mutual = ((back - corners).abs() <= _RETURN_PX).all(-1) & is_alike & is_sole
    return corners[is_mutual], matched[is_mutual], alike_count


def _search_patches(source: Grey, target: Grey, corners: Places) -> tuple[Places, Flags, Flags]:
    """Find the best match of each corner's patch, whether it is good, and whether it is unique."""
    if len(corners) == 0:
        return corners, corners[:, 0].bool(), corners[:, 0].bool()
    patches = _normalised(_windows(source, corners - _RADIUS, 2 * _RADIUS + 1))
    side = 2 * _RADIUS + 1
    mean, mean_square = functional.avg_pool2d(torch.stack([target, target.square()]), side, 1)
    deviation = (mean_square - mean.square()).clamp_min(0).sqrt()
    scores = functional.conv2d(target[None, None], patches[:, None])[0]
    scores = (scores / (side * deviation.clamp_min(1e-6))).where(deviation > _MIN_CONTRAST, -1)
    best, index = scores.flatten(1).max(1)
    best_place = torch.stack([index % scores.shape[2], index // scores.shape[2]], -1)
    # What is near the best is no rival.
    scores = functional.pad(scores, (_RIVAL_RADIUS,) * 4, value=-1.0)
    near = torch.arange(2 * _RIVAL_RADIUS + 1)
    n = torch.arange(len(best_place))[:, None, None]
    scores[
        n, best_place[:, 1, None, None] + near[:, None], best_place[:, 0, None, None] + near
    ] = -1
    rival = scores.flatten(1).amax(1)
    return best_place + _RADIUS, best > _MIN_SCORE, rival < _MAX_RIVAL * best


def _windows(image: Grey, first: Places, side: int) -> Float[Tensor, "n side side"]:
    """Cut windows whose first pixels are these (x, y)."""
    steps = torch.arange(side)
    return image[first[:, 1, None, None] + steps[:, None], first[:, 0, None, None] + steps]


def _normalised(patches: Tensor) -> Tensor:
    centred = patches - patches.mean((-2, -1), keepdim=True)
    return centred / centred.norm(dim=(-2, -1), keepdim=True).clamp_min(1e-6)


def _place_finely(
    left: Float[Tensor, "3 h w"], right: Float[Tensor, "3 h w"], places: Places, matched: Places
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2"]]:
    """Give the places of matches from the centre, and their shifts, right less left [px]."""
    left_grey, right_grey = (_grey(image, _FINE_PIXELS) for image in (left, right))
    enlargement = left_grey.shape[1] / _grey(left, _COARSE_PIXELS).shape[1]
    places, matched = (((p + 0.5) * enlargement - 0.5).round().long() for p in (places, matched))

    # Correlate each left patch with all patches up to _REACH pixels from the coarse match.
    side = 2 * _FINE_RADIUS + 1
    rim = _FINE_RADIUS + _REACH
    left_padded = functional.pad(left_grey, (rim,) * 4)
    right_padded = functional.pad(right_grey, (rim,) * 4)
    patches = _normalised(_windows(left_padded, places + _REACH, side))
    windows = _windows(right_padded, matched, 2 * rim + 1)
    candidates = _normalised(windows.unfold(1, side, 1).unfold(2, side, 1))
    scores = (candidates * patches[:, None, None]).sum((-2, -1))

    # A good one lies inside of what was searched.
    best, index = scores.flatten(1).max(1)
    row = index // scores.shape[2]
    column = index % scores.shape[2]
    last = 2 * _REACH
    is_good = (best > _MIN_SCORE) & (row > 0) & (row < last) & (column > 0) & (column < last)

    # To a fraction of a pixel: the top of the parabola through three scores, half a pixel off at
    # most.
    row = row.clamp(1, last - 1)
    column = column.clamp(1, last - 1)
    n = torch.arange(len(places))
    peak = torch.stack([column, row], -1).float()
    for axis in (0, 1):
        before, at, after = (scores[n, row + k * axis, column + k * (1 - axis)] for k in (-1, 0, 1))
        curvature = (2 * at - before - after).clamp_min(1e-6)
        peak[:, axis] += ((after - before) / (2 * curvature)).clamp(-0.5, 0.5)
    shift = matched - places + peak - _REACH
    scale = left_grey.shape[1] / left.shape[2]
    centre = torch.tensor([left_grey.shape[1], left_grey.shape[0]]) / 2
    return ((places - centre) / scale)[is_good], (shift / scale)[is_good]


def _find_change(left: Grey, right: Grey, corners: Places) -> str | None:
    """Say by which change the right image would match: mirrored, rotated or scaled; None: by none.

    ``corners``: of the left image, some of which are matched after each change.
    """
    some_corners = corners[:_SOME_CORNERS]
    flips = {
        "mirrored": right.flip(1),
        "upside down": right.flip(0, 1),
        "mirrored top to bottom": right.flip(0),
    }
    for change, back in flips.items():
        if len(_match_corners(left, back, some_corners)[0]) >= _MIN_SOME:
            return f"the right image is {change} beside the left one; turn it back"
    height, width = right.shape
    for turn_deg, scale in _CHANGES:
        turn_rad = math.radians(-turn_deg)
        c = scale * math.cos(turn_rad)
        s = scale * math.sin(turn_rad)
        affine = torch.tensor([[[c, s * height / width, 0], [-s * width / height, c, 0]]])
        grid = functional.affine_grid(affine, [1, 1, height, width], align_corners=False)
        back = functional.grid_sample(right[None, None], grid, align_corners=False)[0, 0]
        places, matched, _ = _match_corners(left, back, some_corners)
        if len(places) >= _MIN_SOME:
            rest_deg, rest_scale, _ = _fit_rows(places, (matched - places)[:, 1])
            turn_deg += rest_deg  # noqa: PLW2901
            return (
                f"the right image is turned by about {round(turn_deg)} degrees and scaled by about "
                f"{scale * rest_scale:.2f} beside the left one; rectify the pair"
            )
    return None


def _report(
    places_px: Tensor, shift_px: Tensor, corners: int, width: int, cx_difference_px: float
) -> RectificationReport:
    """Summarise the matches; their places are counted from the centre [px]."""
    # How far rows are off, robustly, and how many disparities are positive.
    matches = len(shift_px)
    disparity_px = cx_difference_px - shift_px[:, 0]
    clear = disparity_px[disparity_px.abs() > 1]
    share = float((clear > 0).float().mean()) if len(clear) else math.nan
    offset = math.nan
    spread = math.nan
    if matches:
        offset = float(shift_px[:, 1].median())
        spread = _MAD_TO_DEVIATION * float((shift_px[:, 1] - offset).abs().median())

    # Against limits that grow with the image.
    larger = max(1.0, width / _LIMITS_WIDTH)
    most_offset = larger * _MAX_OFFSET_PX
    most_spread = larger * _MAX_SPREAD_PX
    is_same = shift_px.abs().amax(-1) <= larger * _SAME_PX
    is_level = abs(offset) <= most_offset and spread <= most_spread
    is_known = matches >= _MIN_MATCHES or (matches >= _MIN_WRONG and not is_level)
    report = RectificationReport(
        vertical_offset_px=offset,
        vertical_spread_px=spread,
        positive_share=share,
        corners=corners,
        matches=matches,
        is_pair=float(is_same.float().mean()) < _SAME_SHARE if is_known else None,
        is_rectified=is_level if is_known else None,
        is_swapped=share <= _MAX_SHARE_SWAPPED if len(clear) >= _MIN_MATCHES else None,
        message="",
    )

    # In words.
    if not is_known:
        message = (
            f"only {matches} of the {_MIN_MATCHES} matches needed: cannot tell whether the pair is "
            "rectified"
        )
        return replace(report, message=message)
    findings: list[str] = []
    if report.is_pair is False:
        findings.append(
            f"left and right show the same view: {float(is_same.float().mean()):.0%} of what "
            f"matches lies within {larger * _SAME_PX:.2g} px of its place; give the view of each "
            "camera"
        )
    elif report.is_swapped:
        findings.append(
            f"left and right look swapped (only {share:.0%} of disparities are positive); exchange "
            "the two images (or both are mirrored: mirror them back)"
        )
    if report.is_rectified is False:
        turn_deg, scale, remaining_px = _fit_rows(places_px, shift_px[:, 1])
        turn = f", turned by {turn_deg:+.1f} degrees and scaled by {scale:.3f}"
        findings.append(
            f"rows do not agree: the right image lies {offset:+.1f} px lower, with a spread of "
            f"{spread:.1f} px{turn if remaining_px < spread / 2 else ''} (at most "
            f"{most_offset:.3g} and {most_spread:.3g} are allowed); rectify the pair ('depthpose "
            "data rectify', with the calibration of both cameras)"
        )
    good = f"rows agree to {abs(offset):.1f} px, with a spread of {spread:.1f} px"
    return replace(report, message=f"{'. '.join(findings) or good} ({matches} matches)")


def _fit_rows(places_px: Tensor, lower_px: Tensor) -> tuple[float, float, float]:
    """Fit how the right image is rotated and scaled, by robust least squares.

    Args:
        places_px: of matched corners, from the middle of the image (n, 2).
        lower_px: how much lower each lies in the right image (n).

    Returns:
        Rotation [degrees], scale, and the deviation of the residuals [px].
    """
    places_px = places_px.float()
    lower_px = lower_px.float()
    design = torch.cat([torch.ones_like(places_px[:, :1]), places_px], -1)
    is_near = torch.ones_like(lower_px, dtype=torch.bool)
    residual_px = lower_px
    fit = lower_px.new_zeros(3)
    for _ in range(5):
        fit = torch.linalg.lstsq(design[is_near], lower_px[is_near, None]).solution[:, 0]
        residual_px = (lower_px - design @ fit).abs()
        is_near = residual_px <= 2.5 * residual_px.median() + 1e-3
    _, across, down = fit.tolist()
    deviation_px = _MAD_TO_DEVIATION * float(residual_px.median())
    return math.degrees(math.atan(across)), 1 + down, deviation_px


def grey_of(image: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
    """Give the brightness of an RGB image (luma of ITU-R BT.601)."""
    return (image * image.new_tensor(_LUMA)[:, None, None]).sum(0)


def _grey(image: Float[Tensor, "3 h w"], pixels: int) -> Float[Tensor, "h2 w2"]:
    """Bring an image to grey of at most so many pixels and a mean of 0."""
    grey = grey_of(image).float()
    scale = math.sqrt(pixels / grey.numel())
    if scale < 1:
        size = [max(1, round(side * scale)) for side in grey.shape]
        grey = functional.interpolate(grey[None, None], size, mode="area")[0, 0]
    # Correlation is the more exact the nearer the values lie to 0.
    return (grey - grey.mean()).cpu()
