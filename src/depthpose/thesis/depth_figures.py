"""Figures 2-1 and 2-5 of the thesis: the same scene seen, synthesised, estimated and measured."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.draw import depth_scale, draw_depth, draw_points
from depthpose.core.errors import InputError
from depthpose.depth.types import DepthEstimate, StereoInput
from depthpose.report.tables import Drawing

_NEAR_M, _FAR_M = 3.0, 80.0
_GAP_PX = 8
_BAR_PX = 18

DEPTH_SCALE = (
    f"Depth in every panel: {_NEAR_M:.0f} m (bright) to {_FAR_M:.0f} m (dark), logarithmic"
)
"""What the colours mean; the bar below a grid runs from near to far."""


def draw_figure_2_5(
    pair: StereoInput, lidar_m: Float[Tensor, "h w"] | None, estimate: DepthEstimate
) -> list[Drawing]:
    """Make a column of figure 2-5: left, real right, predicted depth, predicted right, LiDAR.

    The predicted right view is left out where a real one was matched, and each of the real right
    view and the LiDAR (one scan drawn into the left image, NaN elsewhere) where there is none.
    """
    panels = [Drawing(caption="left image", image=pair.left)]
    if pair.right is not None:
        panels.append(Drawing(caption="real right image", image=pair.right))
    panels.append(_depth("predicted depth", pair, estimate))
    if estimate.right is not None:
        panels.append(Drawing(caption="predicted right image", image=estimate.right))
    return panels + _lidar(pair, lidar_m)


def draw_figure_2_1(
    pair: StereoInput,
    lidar_m: Float[Tensor, "h w"] | None,
    mono: DepthEstimate,
    stereo: DepthEstimate,
) -> list[Drawing]:
    """Make the six panels of figure 2-1, in its order.

    Args:
        pair: the frame, with its real right view.
        lidar_m: one scan drawn into the left image, NaN where no point falls.
        mono: the estimate from the left view alone, with the right view that it synthesised.
        stereo: the estimate from the real pair, by the same matcher.

    Raises:
        InputError: the frame has no right view, or the estimate no synthesised one.
    """
    if pair.right is None or mono.right is None:
        lacking = "the frame has no right view" if pair.right is None else "no view was synthesised"
        raise InputError(f"{pair.name}: figure 2-1 compares two right views, but {lacking}.")
    return [
        Drawing(caption="(a) left image", image=pair.left),
        Drawing(caption="(b) real right image", image=pair.right),
        Drawing(caption="(c) synthesised right image", image=mono.right),
        _depth("(d) depth from left and synthesised right", pair, mono),
        _depth("(e) depth from left and real right", pair, stereo),
        *(replace(panel, caption=f"(f) {panel.caption}") for panel in _lidar(pair, lidar_m)),
    ]


def arrange(columns: Sequence[Sequence[Drawing]], width_px: int = 621) -> Float[Tensor, "3 h w"]:
    """Lay panels out on white in columns ``width_px`` wide, over the depth scale.

    Raises:
        InputError: there is no panel.
    """
    if not any(columns):
        raise InputError("a figure of no panel cannot be arranged; give a frame at least.")
    shrunk = [[shrink_to_width(panel.image, width_px) for panel in column] for column in columns]
    count = max(map(len, shrunk))
    heights = [max(c[k].shape[1] for c in shrunk if k < len(c)) for k in range(count)]
    total_width = len(shrunk) * (width_px + _GAP_PX) - _GAP_PX
    bar_top = sum(heights) + count * _GAP_PX
    canvas = torch.ones(3, bar_top + _BAR_PX, total_width)
    for x, column in enumerate(shrunk):
        left = x * (width_px + _GAP_PX)
        for y, image in enumerate(column):
            top = sum(heights[:y]) + y * _GAP_PX
            canvas[:, top : top + image.shape[1], left : left + width_px] = image
    ramp_m = torch.logspace(0, 1, total_width, base=_FAR_M / _NEAR_M) * _NEAR_M
    canvas[:, bar_top:] = draw_depth(ramp_m[None], _NEAR_M, _FAR_M)
    return canvas


def _depth(caption: str, pair: StereoInput, estimate: DepthEstimate) -> Drawing:
    if estimate.depth_m is None:
        raise InputError(f"{pair.name}: a figure shows metres; give a camera with a baseline.")
    image = draw_depth(estimate.depth_m, _NEAR_M, _FAR_M)
    return Drawing(caption=caption, image=image, scale=depth_scale(_NEAR_M, _FAR_M))


def _lidar(pair: StereoInput, lidar_m: Float[Tensor, "h w"] | None) -> list[Drawing]:
    if lidar_m is None:
        return []
    # Figures show frames at half their size, where a single pixel would fade: points are 5 wide.
    image = draw_points(pair.left, lidar_m, _FAR_M, radius_px=2)
    return [Drawing(caption="LiDAR", image=image, scale=depth_scale(_NEAR_M, _FAR_M))]


def shrink_to_width(image: Float[Tensor, "3 _ _"], width_px: int) -> Float[Tensor, "3 _ _"]:
    """Scale a picture to a width, its proportions kept, every pixel an average."""
    height = max(1, round(image.shape[1] * width_px / image.shape[2]))
    return F.interpolate(image[None], (height, width_px), mode="area")[0]
