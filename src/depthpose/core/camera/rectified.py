"""Is this pair of images rectified, and the right way round? Asked of the images alone.

Corners of the left image are sought in the right one over a window that a rectified pair does not
need: rows above and below, columns on both sides. Where they are found tells what was done to the
pair.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from depthpose.core.camera.matching import match_corners
from depthpose.core.errors import InputError

_WORK_WIDTH = 1280
_MIN_MATCHES = 25
_MAX_OFFSET_PX = 1.0  # street pairs have up to 0.3
_MAX_SPREAD_PX = 0.75  # street pairs have 0.1 to 0.4; a turn by 0.3 degrees makes 1.2 to 2.5
_MAX_SHARE_SWAPPED = 0.2
_MAD_TO_DEVIATION = 1.4826  # of a normal distribution
_LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601


@dataclass(frozen=True, kw_only=True)
class RectificationReport:
    """What the matches between two images say about the pair.

    Attributes:
        vertical_offset_px: median of the right row less the left row; NaN without matches.
        vertical_spread_px: median absolute deviation of it, scaled to a standard deviation.
        positive_share: share of positive disparities among those beyond a pixel; NaN where there
            are none.
        matches: matches that all this rests on.
        is_rectified: whether rows agree; None where too few matches tell.
        is_swapped: whether the left image is the right one; None where too few matches tell.
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
    give None, never an alarm; unless enough match once the right image is mirrored or turned over,
    which is said.

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
    weights = image.new_tensor(_LUMA)[:, None, None]
    grey = (image * weights).sum(0).float()
    if scale < 1:
        height, width = (max(1, round(size * scale)) for size in grey.shape)
        grey = functional.interpolate(grey[None, None], (height, width), mode="area")[0, 0]
    # Correlation by FFT is the more exact the nearer the values lie to 0.
    return grey - grey.mean()


def _size(image: Float[Tensor, "3 h w"]) -> str:
    return f"{image.shape[-1]}x{image.shape[-2]}"
