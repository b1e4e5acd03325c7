"""Which readings of an image a posed surface explains, and its share in the background."""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from depthpose.core.camera import back_project
from depthpose.core.camera.pinhole import Window, crop_intrinsics
from depthpose.core.rigid import Rigid
from depthpose.pose.frame import Frame, share_behind
from depthpose.pose.geometry.rendering import find_window_about
from depthpose.pose.geometry.surface import Surface
from depthpose.pose.types import KnownBackground, ViewInput

_REGION_MARGIN = 0.5
"""Margin about a region in which planes and neighbours are examined, over its larger side."""


def explained_mask(view: ViewInput, pose: Rigid, surface: Surface) -> Bool[Tensor, "h w"]:
    """Mark the pixels in a view's mask whose readings lie on a posed surface."""
    pose = pose.double()
    window = find_window_about(
        surface, pose, view.K.double(), *view.depth_m.shape, margin_m=surface.near_m
    )
    part = _crop_view(view, window)
    points_m = back_project(part.depth_m.double(), part.K.double())
    is_candidate = (part.depth_m > 0) & part.depth_m.isfinite() & part.mask
    explained = torch.zeros(view.depth_m.shape, dtype=torch.bool)
    explained[window] = _lies_on_surface(points_m, is_candidate, pose, surface)
    return explained


def explained_frame_mask(frame: Frame, pose: Rigid, surface: Surface) -> Bool[Tensor, "h w"]:
    """Mark the pixels of a frame, outside its background, whose readings lie on a posed surface."""
    pose = pose.double()
    window = find_window_about(
        surface, pose, frame.K, *frame.depth_m.shape, margin_m=surface.near_m
    )
    is_candidate = (frame.depth_m[window] > 0) & frame.may_show(surface.diameter_m, window)
    explained = torch.zeros(frame.depth_m.shape, dtype=torch.bool)
    explained[window] = _lies_on_surface(frame.points_m[window], is_candidate, pose, surface)
    return explained


def _lies_on_surface(
    points_m: Float64[Tensor, "h w 3"],
    is_candidate: Bool[Tensor, "h w"],
    pose: Rigid,
    surface: Surface,
) -> Bool[Tensor, "h w"]:
    """Mark the candidates among points of the camera frame that lie on a posed surface."""
    local_m = pose.inverse().apply(points_m[is_candidate])
    distance_m = surface.nearest(local_m, is_exact=False).distance_m

    # The sample of a point's box is farther than its nearest one by the box's diagonal at most:
    # only between these limits the nearest is searched.
    diagonal_m = math.sqrt(3) * surface.boxes.side_m
    is_undecided = (distance_m >= surface.near_m) & (distance_m < surface.near_m + diagonal_m)
    distance_m[is_undecided] = surface.nearest(local_m[is_undecided]).distance_m

    is_explained = is_candidate.clone()
    is_explained[is_candidate] = distance_m < surface.near_m
    return is_explained


def crop_to_region(view: ViewInput, margin: float = _REGION_MARGIN) -> ViewInput:
    """Crop a view to its mask, with a margin in which planes and neighbours are visible.

    The margin is a share of the larger side of the mask.
    """
    rows = view.mask.any(1).nonzero()[:, 0]
    columns = view.mask.any(0).nonzero()[:, 0]
    if len(rows) == 0:
        return view
    top, bottom = int(rows[0]), int(rows[-1])
    left, right = int(columns[0]), int(columns[-1])
    margin_px = int(margin * max(bottom - top, right - left))
    window = (
        slice(max(top - margin_px, 0), bottom + margin_px + 1),
        slice(max(left - margin_px, 0), right + margin_px + 1),
    )
    return _crop_view(view, window)


def _crop_view(view: ViewInput, window: Window) -> ViewInput:
    """Crop a view to rows and columns of its image."""
    # The colour image stays whole: its pixels are of its own camera, and it has its own K.
    background = view.background
    if background is not None:
        background = KnownBackground(
            depth_m=background.depth_m[window], is_seen=background.is_seen[window]
        )
    rows, columns = window
    return replace(
        view,
        depth_m=view.depth_m[window],
        mask=view.mask[window],
        K=crop_intrinsics(view.K, left=columns.start, top=rows.start),
        background=background,
    )


def share_in_background(frame: Frame, pose: Rigid, surface: Surface) -> float:
    """Measure the share of a posed surface that would lie in the background, 0..1.

    Of several backgrounds it is the largest share in one. Planes of which the object may have one
    as a side are none.

    Args:
        frame: of the searched part of the image, whose backgrounds count.
        pose: ``camera_from_model``.
        surface: of the model.
    """
    points_m = pose.apply(surface.points_m)
    shares = (
        share_behind(frame, background, points_m, surface.near_m)
        for background in frame.backgrounds
        if background.diameter_m >= surface.diameter_m
    )
    return max(shares, default=0.0)
