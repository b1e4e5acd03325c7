"""The projector of dots of an active stereo camera."""

from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.depth.synthetic.randomness import Stream, make_rng
from depthpose.depth.synthetic.visibility import Visibility


@dataclass(frozen=True, kw_only=True)
class Projector:
    """A projector of dots, as active stereo cameras have."""

    place_m: tuple[float, float, float]  #: its position in the left camera's frame
    dots_per_radian: float  #: density of the dots
    strength: float  #: light of a dot as a share of the other light


_PATTERN_DOTS = 341
_DOT_STEP_PX = 3
"""The pattern has a dot for 3 x 3 pixels on average, and 341 x 341 of them: its sides of 1024
pixels, a power of two, are quick to tile."""


@cache
def _make_dots() -> Float[Tensor, "1024 1024"]:
    """Make a pattern of dots at random places that can be tiled, of brightness 0 to 1.5.

    The last row and column are dark.
    """
    rng = make_rng(Stream.DOTS)
    count = _PATTERN_DOTS**2
    side = _DOT_STEP_PX * _PATTERN_DOTS
    pattern = torch.zeros(side + 1, side + 1)
    row, column = torch.from_numpy(rng.integers(0, side, (2, count)))
    pattern[row, column] = torch.from_numpy(rng.uniform(0.5, 1, count)).float()
    kernel = torch.tensor([[0.2, 0.5, 0.2], [0.5, 1.0, 0.5], [0.2, 0.5, 0.2]])
    padded = F.pad(pattern[None, None], (1, 1, 1, 1), mode="circular")
    return F.conv2d(padded, kernel[None, None])[0, 0].clamp(max=1.5)


def project_dots(
    light: Float[Tensor, "h w 3"], visibility: Visibility, projector: Projector
) -> Float[Tensor, "h w 3"]:
    """Add the light of the projector's dots to that which reaches a camera.

    The projector has no shadows: surfaces that are hidden from it have dots too.
    """
    # The points that are visible at the pixels, in the projector's frame.
    depth_m = visibility.raster.depth_m
    height, width = depth_m.shape
    column, row = torch.meshgrid(
        torch.arange(width).double(), torch.arange(height).double(), indexing="xy"
    )
    rays = torch.stack([column, row, torch.ones_like(row)], -1) @ visibility.K.inverse().T
    points_m = rays.float() * depth_m[..., None] + visibility.eye
    points_m = points_m - torch.tensor(projector.place_m)

    # Their places in the pattern, which is tiled and sampled bilinearly.
    pattern = _make_dots()
    side = len(pattern)
    pixels_per_radian = _DOT_STEP_PX * projector.dots_per_radian
    x = (pixels_per_radian * points_m[..., 0] / points_m[..., 2]).nan_to_num(0.0)
    y = (pixels_per_radian * points_m[..., 1] / points_m[..., 2]).nan_to_num(0.0)
    left = x.floor().long()
    top = y.floor().long()
    x_share = x - x.floor()
    y_share = y - y.floor()
    upper, lower = (
        torch.lerp(pattern[r % side, left % side], pattern[r % side, (left + 1) % side], x_share)
        for r in (top, top + 1)
    )
    dots = torch.lerp(upper, lower, y_share).where(depth_m.isfinite(), 0.0)
    return light * (1 + projector.strength * dots[..., None])
