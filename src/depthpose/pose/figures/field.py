"""Figure 3-4: directions to a keypoint in the plane of x and y, and where they meet."""

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.draw import draw_lines
from depthpose.pose.figures.canvas import blank, draw_discs

_ARROWS = 220
_ARROW_PX = 22.0
_HEAD = 0.35
_YELLOW, _RED, _INK = (0.95, 0.75, 0.0), (0.85, 0.05, 0.05), (0.15, 0.25, 0.55)


def draw_field(
    points_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    true_m: Float[Tensor, "3"],
    voted_m: Float[Tensor, "3"] | None = None,
    size_px: int = 480,
) -> Float[Tensor, "3 size size"]:
    """Draw directions of some points; a yellow star at the true keypoint, a red cross at the voted.

    An arrow is as long as its direction lies in the plane: one that points away from the viewer is
    short. The part that is shown holds the cloud and both keypoints.

    Args:
        points_m: in the camera frame.
        directions: of unit length, one a point.
        true_m: the keypoint, in the camera frame.
        voted_m: what the directions were said to meet at.
        size_px: side of the picture.
    """
    marks = torch.stack([true_m, true_m if voted_m is None else voted_m]).double()[:, :2]
    plane = points_m.double()[:, :2]
    everything = torch.cat([plane, marks])
    low, high = everything.amin(0), everything.amax(0)
    scale = (size_px - 3 * _ARROW_PX) / float((high - low).max().clamp(min=1e-9))
    middle = (low + high) / 2

    def place(xy: Float[Tensor, "m 2"]) -> Float[Tensor, "m 2"]:
        return (xy - middle) * scale + size_px / 2

    chosen = take_evenly(torch.arange(len(plane)), _ARROWS)
    starts = place(plane[chosen])
    image = _draw_arrows(blank(size_px, size_px), starts, directions.double()[chosen, :2])
    image = _draw_star(image, place(marks[:1])[0])
    return image if voted_m is None else _draw_cross(image, place(marks[1:])[0])


def _draw_arrows(
    image: Float[Tensor, "3 h w"], starts: Float[Tensor, "m 2"], ways: Float[Tensor, "m 2"]
) -> Float[Tensor, "3 h w"]:
    shafts = _ARROW_PX * ways
    tips = starts + shafts
    lines = [torch.stack([starts, tips], 1)]
    for side in (-1.0, 1.0):
        across = side * torch.stack([-shafts[:, 1], shafts[:, 0]], 1)
        lines.append(torch.stack([tips, tips - _HEAD * shafts + 0.5 * _HEAD * across], 1))
    return draw_lines(image, torch.cat(lines), _INK, width_px=1)


def _draw_star(image: Float[Tensor, "3 h w"], at: Float[Tensor, "2"]) -> Float[Tensor, "3 h w"]:
    angle = torch.arange(10, dtype=torch.float64) * torch.pi / 5 - torch.pi / 2
    reach = torch.where(torch.arange(10) % 2 == 0, 12.0, 5.0).double()
    tips = at + torch.stack([angle.cos(), angle.sin()], 1) * reach[:, None]
    # Filled by spokes: a star is small.
    steps = torch.linspace(0, 1, 40, dtype=torch.float64)[:, None, None]
    rim = (tips[None] * (1 - steps) + tips.roll(-1, 0)[None] * steps).flatten(0, 1)
    spokes = torch.stack([at.expand_as(rim), rim], 1)
    image = draw_lines(image, spokes, _YELLOW, width_px=2)
    return draw_lines(image, torch.stack([tips, tips.roll(-1, 0)], 1), (0.0, 0.0, 0.0), width_px=1)


def _draw_cross(image: Float[Tensor, "3 h w"], at: Float[Tensor, "2"]) -> Float[Tensor, "3 h w"]:
    arms = torch.tensor([[[-9.0, -9], [9, 9]], [[-9, 9], [9, -9]]], dtype=torch.float64)
    white = draw_lines(image, at + arms * 1.2, (1.0, 1.0, 1.0), width_px=6)
    return draw_discs(
        draw_lines(white, at + arms, _RED, width_px=4),
        torch.tensor([[float(at[0]), float(at[1]), 0.0]]), torch.tensor([_RED]), 2.0,
    )  # fmt: skip
