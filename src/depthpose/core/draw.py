"""Maps as pictures. A picture is for eyes only: values are read from the NPY beside it."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

# From near to far: a warm, bright end and a dark, cold one, of falling lightness, so that the order
# survives a grey-scale print and colour blindness.
NEAR_TO_FAR = (
    (1.00, 0.97, 0.70), (0.99, 0.76, 0.35), (0.94, 0.49, 0.28), (0.80, 0.26, 0.38),
    (0.57, 0.16, 0.47), (0.33, 0.12, 0.45), (0.14, 0.08, 0.30), (0.02, 0.02, 0.10),
)  # fmt: skip
_INVALID = (0.5, 0.5, 0.5)
_LARGEST_PX = 96.0  # disparity of the brightest colour
_DIMMED = 0.35  # brightness of a picture under points


def draw_depth(
    depth_m: Float[Tensor, "h w"], near_m: float = 3.0, far_m: float = 80.0
) -> Float[Tensor, "3 h w"]:
    """Colour depth by its logarithm, near bright and far dark, on a scale fixed by the arguments.

    A fixed scale makes two pictures comparable and a video steady; grey marks invalid pixels.
    """
    return draw_share((depth_m / near_m).log() / math.log(far_m / near_m))


def draw_disparity(
    disparity_px: Float[Tensor, "h w"], is_sky: Bool[Tensor, "h w"] | None = None
) -> Float[Tensor, "3 h w"]:
    """Colour disparity, large (near) bright, on the fixed scale 0..96 px; sky is grey."""
    share = 1 - disparity_px / _LARGEST_PX
    return draw_share(share if is_sky is None else torch.where(is_sky, torch.nan, share))


def draw_share(share: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Colour numbers in 0 (bright) to 1 (dark); NaN becomes grey."""
    anchors = torch.tensor(NEAR_TO_FAR, dtype=torch.float32)
    position = share.nan_to_num(0.0).clamp(0, 1) * (len(anchors) - 1)
    below = position.long().clamp(max=len(anchors) - 2)
    color = torch.lerp(anchors[below], anchors[below + 1], (position - below)[..., None].float())
    color[~torch.isfinite(share)] = torch.tensor(_INVALID)
    return color.permute(2, 0, 1)


def draw_points(
    image: Float[Tensor, "3 h w"],
    depth_m: Float[Tensor, "h w"],
    far_m: float = 80.0,
    radius_px: int = 1,
    near_m: float = 3.0,
) -> Float[Tensor, "3 h w"]:
    """Lay sparse depth (LiDAR) over a darkened image, each point grown to a square.

    Its side is ``2 radius_px + 1`` pixels; where squares overlap the nearest point is seen.
    """
    grown_m = -_grow(-depth_m, radius_px)
    return torch.where(
        torch.isnan(grown_m), _DIMMED * image, draw_depth(grown_m, near_m=near_m, far_m=far_m)
    )


def draw_error_points(
    image: Float[Tensor, "3 h w"], error: Float[Tensor, "h w"], top: float, radius_px: int = 1
) -> Float[Tensor, "3 h w"]:
    """Lay sparse errors over a darkened image as :func:`draw_points` does; the largest is seen.

    0 is dark and ``top`` bright.
    """
    grown = _grow(error, radius_px)
    return torch.where(torch.isnan(grown), _DIMMED * image, draw_share(1 - grown / top))


def _grow(values: Float[Tensor, "h w"], radius_px: int) -> Float[Tensor, "h w"]:
    """Grow each number to a square; where squares overlap the largest wins."""
    filled = values.nan_to_num(-torch.inf)[None]
    grown = F.max_pool2d(filled, 2 * radius_px + 1, 1, radius_px)[0]
    return torch.where(torch.isfinite(grown), grown, torch.nan)


def draw_lines(
    image: Float[Tensor, "3 h w"],
    ends_px: Float[Tensor, "n 2 2"],
    color: tuple[float, float, float],
    dash_px: float | None = None,
) -> Float[Tensor, "3 h w"]:
    """Draw lines two pixels wide, clipped to the picture; a line with a NaN end is not drawn.

    Args:
        image: what they are drawn on; it is not changed.
        ends_px: (u, v) of both ends of each.
        color: RGB in [0, 1].
        dash_px: length of the dashes, and of the gaps between them; None: no gap.
    """
    height, width = image.shape[1:]
    drawn = image.clone()
    ink = torch.tensor(color).to(image)[:, None]
    brush = torch.cartesian_prod(torch.arange(2), torch.arange(2))
    for start, end in ends_px.double().tolist():
        length = math.dist(start, end)
        if not 0 < length < 1e5:  # NaN, a point, or beyond any picture
            continue
        way = torch.arange(0.0, length, 0.5, dtype=torch.float64)
        if dash_px is not None:
            way = way[(way / dash_px).floor() % 2 == 0]
        share = (way / length)[:, None]
        line = torch.tensor(start) * (1 - share) + torch.tensor(end) * share
        cells = (line.round().long()[:, None] + brush).flatten(0, 1)
        inside = ((cells >= 0) & (cells < torch.tensor([width, height]))).all(-1)
        u, v = cells[inside].unbind(-1)
        drawn[:, v, u] = ink
    return drawn


def draw_outline(
    image: Float[Tensor, "3 h w"], mask: Bool[Tensor, "h w"], color: tuple[float, float, float]
) -> Float[Tensor, "3 h w"]:
    """Draw the border of a mask, inside it, one pixel wide."""
    grown = F.max_pool2d((~mask).float()[None], 3, 1, 1)[0] > 0
    ink = torch.tensor(color).to(image)[:, None, None]
    return torch.where(mask & grown, ink, image)
