"""Disparity to depth and back, resizing, warping, and the left-right check."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import StereoRig


def depth_from_disparity(
    disparity_px: Float[Tensor, "*batch h w"], rig: StereoRig
) -> Float[Tensor, "*batch h w"]:
    """Triangulate a rectified pair: ``depth = fx B / (disparity + cx_right - cx_left)``.

    An error of e px at depth z is one of ``e z^2 / (fx B)`` metres: it grows with the square.
    NaN comes out where the disparity is NaN, or puts the point at infinity or behind the camera.
    """
    shifted_px = disparity_px + rig.cx_right_minus_left_px
    depth_m = float(rig.K[0, 0]) * rig.baseline_m / shifted_px
    return torch.where(shifted_px > 0, depth_m, torch.nan)


def disparity_from_depth(
    depth_m: Float[Tensor, "*batch h w"], rig: StereoRig
) -> Float[Tensor, "*batch h w"]:
    """Undo :func:`depth_from_disparity`; NaN where depth is NaN or not positive."""
    disparity_px = float(rig.K[0, 0]) * rig.baseline_m / depth_m - rig.cx_right_minus_left_px
    return torch.where(depth_m > 0, disparity_px, torch.nan)


def resize_disparity(
    disparity_px: Float[Tensor, "h w"], height: int, width: int
) -> Float[Tensor, "height width"]:
    """Resize bilinearly (pixel centres at halves) and scale the values by the ratio of the widths.

    Disparity is what is interpolated, never depth: depth is not linear between two pixels.
    """
    own_width = disparity_px.shape[1]
    if disparity_px.shape == (height, width):
        return disparity_px
    resized = F.interpolate(disparity_px[None, None], (height, width), mode="bilinear")[0, 0]
    return resized * (width / own_width)


def warp_right_to_left(
    right: Float[Tensor, "c h w"], disparity_px: Float[Tensor, "h w"]
) -> Float[Tensor, "c h w"]:
    """Look up, for each left pixel x, the right view at ``x - disparity`` (bilinear).

    NaN where the disparity is NaN or the pixel looked up lies outside the right view.
    """
    height, width = disparity_px.shape
    columns = torch.arange(width, device=right.device) - disparity_px
    rows = torch.arange(height, device=right.device)[:, None].expand(height, width)
    is_inside = (columns >= 0) & (columns <= width - 1)
    # grid_sample's corners: -1 and 1 are the centres of the outer pixels.
    grid = torch.stack(
        [2 * columns.nan_to_num(0.0) / max(width - 1, 1) - 1, 2 * rows / max(height - 1, 1) - 1], -1
    ).to(right.dtype)
    looked_up = F.grid_sample(right[None], grid[None], padding_mode="border", align_corners=True)
    return torch.where(is_inside, looked_up[0], torch.nan)


def left_right_difference_px(
    left_px: Float[Tensor, "h w"], right_px: Float[Tensor, "h w"]
) -> Float[Tensor, "h w"]:
    """Compare the disparity of the left view with that of the right view at the same point.

    Small where both views agree, large at occlusions; NaN where the point leaves the right view.
    """
    return (left_px - warp_right_to_left(right_px[None], left_px)[0]).abs()
