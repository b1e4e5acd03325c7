"""Pairs whose principal points differ so that far points have negative disparities."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError
from depthpose.depth.types import Match

_MOST_APART_PX = 64
_LEAST_PX, _CUT_OFF = 2.0, 0.01
"""Of Middlebury's Motorcycle 0.3 % of the pixels are matched below 2 px; of a street cut so that
points beyond 19 m have negative disparities 1.6 % by SGBM, and 4.5 % by a network."""


def match_to_infinity(
    match: Callable[[Tensor, Tensor, Camera | None], Match],
    left: Float[Tensor, "3 h w"],
    right: Float[Tensor, "3 h w"],
    camera: Camera | None,
) -> Match:
    """Match a pair; again, from infinity, where its rig cuts off what is far.

    Args:
        match: of two views and their camera.
        left: RGB in [0, 1].
        right: of the same size, rectified.
        camera: of the pair; None: its principal points are taken as equal.
    """
    found = match(left, right, camera)
    columns = infinity_shift_px(camera)
    if camera is None or columns == 0 or not is_cut_off(found):
        return found
    try:
        widened = match(*moved_apart(left, right, columns), _widened(camera, columns))
    except InputError:  # nothing lies so far
        return found
    return join_far(found, widened, columns)


def infinity_shift_px(camera: Camera | None) -> int:
    """Columns by which two views are moved apart so that points at infinity lie at 0 px or more.

    Where the right principal point lies farther right than the left one, far points have negative
    disparities, which no matcher searches. No more than 64 px: beyond, near points would leave the
    matcher's range.
    """
    apart_px = camera.cx_right_minus_left_px if isinstance(camera, StereoRig) else 0.0
    return math.ceil(apart_px) if 0 < apart_px <= _MOST_APART_PX else 0


def is_cut_off(match: Match) -> bool:
    """Whether points seem to lie beyond the least disparity: many pixels at it, or few matched.

    The sky does not count.
    """
    disparity_px = match.disparity_px
    if match.is_sky is not None:
        disparity_px = disparity_px[~match.is_sky]
    count = int(disparity_px.isfinite().sum())
    is_least = disparity_px < _LEAST_PX
    return 2 * count < disparity_px.numel() or int(is_least.sum()) > _CUT_OFF * count


def moved_apart(
    left: Float[Tensor, "3 h w"], right: Float[Tensor, "3 h w"], columns: int
) -> tuple[Float[Tensor, "3 h w2"], Float[Tensor, "3 h w2"]]:
    """Widen both views by repeating their borders, so that every disparity grows by ``columns``.

    Columns are added on the left of the left view and on the right of the right one. Nothing of
    either is lost.
    """
    wide = F.pad(left[None], (columns, 0, 0, 0), mode="replicate")[0]
    return wide, F.pad(right[None], (0, columns, 0, 0), mode="replicate")[0]


def join_far(near: Match, widened: Match, columns: int) -> Match:
    """Take the match of the views that were moved apart, and where it has none the one before."""
    far_px = widened.disparity_px[:, columns:] - columns
    is_far = far_px.isfinite()
    sure = near.confidence
    if sure is not None and widened.confidence is not None:
        sure = torch.where(is_far, widened.confidence[:, columns:], sure)
    is_sky = None if widened.is_sky is None else widened.is_sky[:, columns:]
    disparity_px = torch.where(is_far, far_px, near.disparity_px)
    return Match(disparity_px=disparity_px, confidence=sure, is_sky=is_sky)


def _widened(camera: Camera, columns: int) -> Camera:
    """Give the camera of a left view with so many more columns on its left."""
    K = camera.K.clone()
    K[0, 2] += columns
    wider = replace(camera, width=camera.width + columns, K=K)
    if isinstance(wider, StereoRig):
        apart_px = wider.cx_right_minus_left_px - columns
        wider = replace(wider, cx_right_minus_left_px=apart_px)
    return wider
