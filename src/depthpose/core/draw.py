"""Depth, disparity and error maps as colour pictures, and marks drawn on images.

Such a picture is to be looked at; values are read from the NPY file beside it.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

Rgb = tuple[float, float, float]
"""Red, green and blue of a colour, each in [0, 1]."""

# From near to far: a warm, bright end and a dark, cold one, of falling lightness, so that the order
# survives a grey-scale print and colour blindness.
NEAR_TO_FAR: tuple[Rgb, ...] = (
    (1.00, 0.97, 0.70), (0.99, 0.76, 0.35), (0.94, 0.49, 0.28), (0.80, 0.26, 0.38),
    (0.57, 0.16, 0.47), (0.33, 0.12, 0.45), (0.14, 0.08, 0.30), (0.02, 0.02, 0.10),
)  # fmt: skip
_INVALID: Rgb = (0.5, 0.5, 0.5)  # colour of pixels without a value
MAX_DISPARITY_PX = 96.0
"""Disparity of the brightest colour; a larger one has it too [px]."""
_DIMMED = 0.35  # factor by which an image under points is darkened
_LONGEST_LINE_PX = 1e5  # a longer line has an end beyond any picture
_LINE_STEP_PX = 0.5  # between the samples of a line: no pixel on its way is missed


def draw_depth(
    depth_m: Float[Tensor, "h w"], near_m: float = 3.0, far_m: float = 80.0
) -> Float[Tensor, "3 h w"]:
    """Colour depth by its logarithm: ``near_m`` is brightest, ``far_m`` darkest, NaN grey.

    Since the arguments fix the scale, pictures are comparable and a video does not flicker.
    """
    return draw_share((depth_m / near_m).log() / math.log(far_m / near_m))


def draw_disparity(
    disparity_px: Float[Tensor, "h w"], is_sky: Bool[Tensor, "h w"] | None = None
) -> Float[Tensor, "3 h w"]:
    """Colour disparity: 0 is darkest, ``MAX_DISPARITY_PX`` brightest, NaN and the sky grey."""
    share = 1 - disparity_px / MAX_DISPARITY_PX
    if is_sky is not None:
        share = torch.where(is_sky, torch.nan, share)
    return draw_share(share)


def draw_share(share: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Colour a map of positions on the colour scale, 0 (bright) to 1 (dark); NaN becomes grey."""
    anchors = torch.tensor(NEAR_TO_FAR, dtype=torch.float32)
    position = share.nan_to_num(0.0).clamp(0, 1) * (len(anchors) - 1)

    # Interpolate between the colours before and behind that position.
    lower = position.long().clamp(max=len(anchors) - 2)
    fraction = (position - lower)[..., None].float()
    color = torch.lerp(anchors[lower], anchors[lower + 1], fraction)

    color[~torch.isfinite(share)] = torch.tensor(_INVALID)
    return color.permute(2, 0, 1)


def draw_points(
    image: Float[Tensor, "3 h w"],
    depth_m: Float[Tensor, "h w"],
    far_m: float = 80.0,
    radius_px: int = 1,
    near_m: float = 3.0,
) -> Float[Tensor, "3 h w"]:
    """Draw sparse depth (LiDAR) on a darkened image, in the colours of :func:`draw_depth`.

    Each point is a square of ``2 radius_px + 1`` pixels; where squares overlap the nearest point is
    visible.
    """
    squares_m = -_dilate(-depth_m, radius_px)
    colors = draw_depth(squares_m, near_m=near_m, far_m=far_m)
    return torch.where(torch.isnan(squares_m), _DIMMED * image, colors)


def draw_error_points(
    image: Float[Tensor, "3 h w"], error: Float[Tensor, "h w"], worst: float, radius_px: int = 1
) -> Float[Tensor, "3 h w"]:
    """Draw sparse errors as squares on a darkened image: 0 is darkest, ``worst`` brightest.

    Where squares overlap the largest error is visible.
    """
    squares = _dilate(error, radius_px)
    colors = draw_share(1 - squares / worst)
    return torch.where(torch.isnan(squares), _DIMMED * image, colors)


def _dilate(values: Float[Tensor, "h w"], radius_px: int) -> Float[Tensor, "h w"]:
    """Take the largest value within the square of each pixel; NaN where it has none.

    The square reaches ``radius_px`` pixels to each side.
    """
    filled = values.nan_to_num(-torch.inf)[None]
    largest = F.max_pool2d(filled, 2 * radius_px + 1, stride=1, padding=radius_px)[0]
    return torch.where(torch.isfinite(largest), largest, torch.nan)


def draw_lines(
    image: Float[Tensor, "3 h w"],
    ends_px: Float[Tensor, "n 2 2"],
    color: Rgb,
    dash_px: float | None = None,
) -> Float[Tensor, "3 h w"]:
    """Draw lines two pixels wide on a copy of an image; a line with a NaN end is left out.

    Args:
        image: RGB in [0, 1]; it is not changed.
        ends_px: (u, v) of both ends of each line.
        color: colour of the lines.
        dash_px: length of the dashes, and of the gaps between them; None: solid lines.
    """
    height, width = image.shape[1:]
    drawn = image.clone()
    pixel_color = torch.tensor(color).to(image)[:, None]
    brush = torch.cartesian_prod(torch.arange(2), torch.arange(2))  # offsets of 2x2 pixels
    for start, end in ends_px.double().tolist():
        length_px = math.dist(start, end)
        if not 0 < length_px < _LONGEST_LINE_PX:  # False for NaN too
            continue

        # Sample the line densely, without its gaps.
        along_px = torch.arange(0.0, length_px, _LINE_STEP_PX, dtype=torch.float64)
        if dash_px is not None:
            is_dash = (along_px / dash_px).floor() % 2 == 0
            along_px = along_px[is_dash]
        share = (along_px / length_px)[:, None]
        samples = torch.tensor(start) * (1 - share) + torch.tensor(end) * share

        # Colour the pixels of the brush around each sample.
        pixels = (samples.round().long()[:, None] + brush).flatten(0, 1)
        is_inside = ((pixels >= 0) & (pixels < torch.tensor([width, height]))).all(-1)
        u, v = pixels[is_inside].unbind(-1)
        drawn[:, v, u] = pixel_color
    return drawn


def draw_outline(
    image: Float[Tensor, "3 h w"], mask: Bool[Tensor, "h w"], color: Rgb
) -> Float[Tensor, "3 h w"]:
    """Draw the outermost pixels of a mask on a copy of an image: a line one pixel wide."""
    is_near_outside = F.max_pool2d((~mask).float()[None], 3, stride=1, padding=1)[0] > 0
    border_color = torch.tensor(color).to(image)[:, None, None]
    return torch.where(mask & is_near_outside, border_color, image)
