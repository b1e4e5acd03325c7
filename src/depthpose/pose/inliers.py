"""A pose beside a depth image: its inliers, and its share in the background."""

import math

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from depthpose.core.camera import back_project
from depthpose.core.rigid import Rigid
from depthpose.pose.frame import Frame, crop_view, dilate_depth, readings_toward
from depthpose.pose.geometry.rendering import find_window_about
from depthpose.pose.geometry.surface import Surface
from depthpose.pose.planes import Background
from depthpose.pose.sensor import plane_tolerance_m
from depthpose.pose.types import ViewInput


def view_inliers(view: ViewInput, pose: Rigid, surface: Surface) -> Bool[Tensor, "h w"]:
    """Mark the inliers of a pose in the mask of a view: the readings on the posed surface."""
    pose = pose.double()
    window = find_window_about(
        surface, pose, view.K.double(), *view.depth_m.shape, margin_m=surface.near_m
    )
    part = crop_view(view, window)
    points_m = back_project(part.depth_m.double(), part.K.double())
    is_candidate = (part.depth_m > 0) & part.depth_m.isfinite() & part.mask
    inliers = torch.zeros(view.depth_m.shape, dtype=torch.bool)
    inliers[window] = _lies_on_surface(points_m, is_candidate, pose, surface)
    return inliers


def frame_inliers(frame: Frame, pose: Rigid, surface: Surface) -> Bool[Tensor, "h w"]:
    """Mark the inliers of a pose in a frame; readings of the background are none."""
    pose = pose.double()
    window = find_window_about(
        surface, pose, frame.K, *frame.depth_m.shape, margin_m=surface.near_m
    )
    is_candidate = (frame.depth_m[window] > 0) & frame.may_show(surface.diameter_m, window)
    inliers = torch.zeros(frame.depth_m.shape, dtype=torch.bool)
    inliers[window] = _lies_on_surface(frame.points_m[window], is_candidate, pose, surface)
    return inliers


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

    is_inlier = is_candidate.clone()
    is_inlier[is_candidate] = distance_m < surface.near_m
    return is_inlier


def share_in_background(frame: Frame, pose: Rigid, surface: Surface) -> float:
    """Measure the share of a posed surface that would lie in the background, 0..1.

    Of several backgrounds it is the largest share in one. A plane that may be a side of the object
    is no background.

    Args:
        frame: of the searched part of the image, whose backgrounds count.
        pose: ``camera_from_model``.
        surface: of the model.
    """
    points_m = pose.apply(surface.points_m)
    shares = (
        _share_behind(frame, background, points_m, surface.near_m)
        for background in frame.backgrounds
        if background.diameter_m >= surface.diameter_m
    )
    return max(shares, default=0.0)


def _share_behind(
    frame: Frame, background: Background, points_m: Float64[Tensor, "n 3"], margin_m: float
) -> float:
    """Measure the share of points that lie behind a background, where it is not observed to end.

    The camera sees what lies before a background, and the background may end where the camera sees
    farther. Its edges may be displaced by the margin, so its depth is dilated by it.

    Args:
        frame: the image.
        background: one of the image.
        points_m: points of a posed surface, in the camera frame.
        margin_m: distance behind the background, beyond the sensor's noise, from which a point
            counts.

    Returns:
        Between 0 and 1.
    """
    # Within the margin of a point the background is no deeper than its deepest pixel there.
    margin_px = margin_m * float(frame.K[0, 0] / points_m[:, 2].median().clamp(min=1e-6))
    reach = min(math.ceil(margin_px), min(frame.depth_m.shape) // 2)
    readings = readings_toward(frame, points_m)
    row = readings.pixel // frame.depth_m.shape[1]
    column = readings.pixel % frame.depth_m.shape[1]
    top = max(0, int(row.min()) - reach)
    left = max(0, int(column.min()) - reach)
    bottom = int(row.max()) + reach + 1
    right = int(column.max()) + reach + 1
    deepest_m = dilate_depth(background.depth_m[top:bottom, left:right], reach)
    limit_m = deepest_m[row - top, column - left]
    limit_m = limit_m + margin_m + plane_tolerance_m(limit_m, frame.noise_per_m2)
    # Where the camera saw farther than the background it has ended; what lies before it hides it.
    is_present = readings.is_read & (readings.depth_m < limit_m)
    is_behind = points_m[:, 2] > limit_m
    return float((is_present & is_behind).double().mean())
