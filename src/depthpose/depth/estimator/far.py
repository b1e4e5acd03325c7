"""Pairs whose principal points differ: they are matched as if both were the same."""

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


def match_to_infinity(
    match: Callable[[Tensor, Tensor, Camera | None], Match],
    left: Float[Tensor, "3 h w"],
    right: Float[Tensor, "3 h w"],
    camera: Camera | None,
) -> Match:
    """Match a pair; with principal points apart, after its views were moved by their difference.

    What is farthest then has a disparity of 0 px, where matchers search, and what is nearest that
    of a rig whose principal points agree. Disparities of the views as given are returned.
    Where the right view shows nothing of the left one, the confidence is 0.

    Args:
        match: of two views and their camera.
        left: RGB in [0, 1].
        right: of the same size, rectified.
        camera: of the pair; None: its principal points are taken as equal.

    Raises:
        InputError: the principal points lie farther apart than the images are wide.
    """
    rig = camera if isinstance(camera, StereoRig) else None
    columns = 0 if rig is None else math.ceil(rig.cx_right_minus_left_px)
    if rig is None or columns == 0:
        return match(left, right, camera)
    width, apart_px = left.shape[2], rig.cx_right_minus_left_px
    if abs(columns) >= width:
        raise InputError(
            f"cx_right_minus_left_px is {apart_px:g}, and the images are {width} px wide: the "
            "two views share nothing that is far away. Take both principal points from one "
            "calibration of images of this size."
        )
    added = max(columns, 0)
    K = rig.K.clone()
    K[0, 2] += added
    moved = replace(rig, width=width + added, K=K, cx_right_minus_left_px=apart_px - columns)
    # New columns repeat the border; those cut off the right view show nothing of the left one.
    wide_left = F.pad(left[None], (added, 0, 0, 0), mode="replicate")[0]
    wide_right = F.pad(right[None], (added - columns, added, 0, 0), mode="replicate")[0]
    found = match(wide_left, wide_right[..., : width + added], moved)
    disparity_px = found.disparity_px[:, added:] - columns
    sure, is_sky = (
        None if part is None else part[:, added:] for part in (found.confidence, found.is_sky)
    )
    if sure is not None:  # the right view shows none of the first columns, even at infinity
        sure = torch.where(torch.arange(width, device=sure.device) < -columns, 0.0, sure)
    return Match(disparity_px=disparity_px, confidence=sure, is_sky=is_sky)
