"""Points as discs on white, near ones before far ones."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError

_GAP_PX = 8

# Spectral of ColorBrewer (Brewer, 2003): red over yellow to blue.
_SPECTRAL = (
    (158, 1, 66), (213, 62, 79), (244, 109, 67), (253, 174, 97), (254, 224, 139), (255, 255, 191),
    (230, 245, 152), (171, 221, 164), (102, 194, 165), (50, 136, 189), (94, 79, 162),
)  # fmt: skip


def spectral(share: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """Colour numbers from 0 (red) over the middle (yellow) to 1 (blue)."""
    anchors = torch.tensor(_SPECTRAL, dtype=torch.float32) / 255
    position = share.float().clamp(0, 1) * (len(anchors) - 1)
    below = position.long().clamp(max=len(anchors) - 2)
    return torch.lerp(anchors[below], anchors[below + 1], (position - below)[:, None])


def blank(height: int, width: int) -> Float[Tensor, "3 h w"]:
    """Give an empty white picture."""
    return torch.ones(3, height, width)


def arrange_grid(
    pictures: Sequence[Float[Tensor, "3 _ _"]], columns: int
) -> Float[Tensor, "3 h w"]:
    """Lay pictures out in rows on white, each in a cell as large as the largest.

    Raises:
        InputError: there is no picture.
    """
    if not pictures:
        raise InputError("a figure of no picture cannot be arranged; give one at least.")
    height = max(picture.shape[1] for picture in pictures)
    width = max(picture.shape[2] for picture in pictures)
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    grid = blank(rows * (height + _GAP_PX) - _GAP_PX, columns * (width + _GAP_PX) - _GAP_PX)
    for k, picture in enumerate(pictures):
        top, left = (k // columns) * (height + _GAP_PX), (k % columns) * (width + _GAP_PX)
        grid[:, top : top + picture.shape[1], left : left + picture.shape[2]] = picture
    return grid


def draw_discs(
    image: Float[Tensor, "3 h w"],
    places: Float[Tensor, "n 3"],
    colors: Float[Tensor, "n 3"],
    radius_px: float,
) -> Float[Tensor, "3 h w"]:
    """Draw points as discs.

    Args:
        image: what they are drawn on; it is not changed.
        places: (u, v) in pixels, and the distance: near ones cover far ones.
        colors: RGB in [0, 1].
        radius_px: of each disc.
    """
    height, width = image.shape[1:]
    reach = int(radius_px) + 1
    steps = torch.cartesian_prod(*[torch.arange(-reach, reach + 1)] * 2)
    steps = steps[steps.double().norm(dim=1) <= radius_px]
    order = places[:, 2].argsort(descending=True, stable=True)
    cells = places[order, None, :2].round().long() + steps
    u, v = cells.unbind(-1)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    # Of the discs that cover a pixel the last in this order, the nearest, is seen.
    rank = torch.arange(len(order))[:, None].expand_as(u)
    seen = torch.full((height * width,), -1)
    seen.scatter_reduce_(0, (v * width + u)[inside], rank[inside], "amax")
    drawn = image.flatten(1).clone()
    is_drawn = seen >= 0
    drawn[:, is_drawn] = colors[order][seen[is_drawn]].to(image).T
    return drawn.view_as(image)
