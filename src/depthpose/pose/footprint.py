"""Where a posed surface lies in an image: what it explains there, and what is about it."""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.camera import back_project, project
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import grow_mask
from depthpose.pose.frame import Frame, is_on_plane, largest_plane, share_behind
from depthpose.pose.sensor import EDGE_PX
from depthpose.pose.surface import NEAR, Surface
from depthpose.pose.types import KnownBackground, ViewInput

_FLAT = 0.9
"""What lies on one plane by so large a share is flat: anything of its outline looks the same."""
_CONTINUED = 0.4
"""Where the plane goes on beside so much of it, the outline is a cut through something larger."""
_RIM = 0.05
"""Width of what is looked at beside it, in diameters."""
_REGION_MARGIN = 0.5
"""Of the larger side of a region: so far about it planes and neighbours are looked at."""
_SUNK = 0.05
"""Of a surface no larger share lies in a bin, table or wall: its pose is off by less."""


def explained_mask(image: Frame | ViewInput, pose: Rigid, surface: Surface) -> Bool[Tensor, "h w"]:
    """Mark the pixels whose points lie on a posed surface; in a frame, none of its background."""
    pose = pose.double()
    window = _pixels_about(image, pose, surface)
    depth_m = image.depth_m[window].double()
    if isinstance(image, Frame):
        points_m = image.points_m[window]
        is_explained = (depth_m > 0) & image.may_show(surface.diameter_m)[window]
    else:
        points_m = back_project(depth_m, _window_intrinsics(image.K, window).double())
        is_explained = points_m.isfinite().all(-1) & image.mask[window]
    local_m = pose.inverse().apply(points_m[is_explained])
    distance_m = (local_m - surface.points_m[surface.boxes.look_up(local_m)]).norm(dim=-1)
    # The nearest sample is nearer than the one of the box by its diagonal at most.
    limit_m = NEAR * surface.diameter_m
    is_open = (distance_m >= limit_m) & (distance_m < limit_m + math.sqrt(3) * surface.boxes.side_m)
    nearest_m = surface.points_m[surface.nearest(local_m[is_open])]
    distance_m[is_open] = (local_m[is_open] - nearest_m).norm(dim=-1)
    is_explained[is_explained.clone()] = distance_m < limit_m
    explained = torch.zeros(image.depth_m.shape, dtype=torch.bool)
    explained[window] = is_explained
    return explained


def _pixels_about(image: Frame | ViewInput, pose: Rigid, surface: Surface) -> tuple[slice, slice]:
    """Rows and columns in which a posed surface lies, with a margin."""
    height, width = image.depth_m.shape
    posed_m = pose.double().apply(surface.points_m)
    pixel = project(posed_m[posed_m[:, 2] > 0], image.K.double())
    if len(pixel) == 0:
        return slice(0, 0), slice(0, 0)
    low = pixel.amin(0)
    high = pixel.amax(0)
    margin = 0.1 * (high - low) + 2 * EDGE_PX
    left, top = (low - margin).floor().tolist()
    right, bottom = (high + margin).ceil().tolist()
    rows = slice(min(max(int(top), 0), height), min(max(int(bottom) + 1, 0), height))
    columns = slice(min(max(int(left), 0), width), min(max(int(right) + 1, 0), width))
    return rows, columns


def _window_intrinsics(
    K: Float[Tensor, "3 3"], window: tuple[slice, slice]
) -> Float[Tensor, "3 3"]:
    """Intrinsic matrix of a part of an image."""
    K = K.clone()
    K[0, 2] -= window[1].start
    K[1, 2] -= window[0].start
    return K


def window_of_region(view: ViewInput) -> ViewInput:
    """Cut a view about its mask, with a margin in which planes and neighbours show."""
    rows, columns = view.mask.any(1).nonzero()[:, 0], view.mask.any(0).nonzero()[:, 0]
    if len(rows) == 0:
        return view
    margin = int(_REGION_MARGIN * max(int(rows[-1] - rows[0]), int(columns[-1] - columns[0])))
    part = (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + margin + 1),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + margin + 1),
    )
    return _cut(view, part)


def _cut(view: ViewInput, part: tuple[slice, slice]) -> ViewInput:
    """Cut a part out of a view."""
    K = _window_intrinsics(view.K, part)
    background = view.background
    if background is not None:
        background = KnownBackground(
            depth_m=background.depth_m[part], is_seen=background.is_seen[part]
        )
    return replace(
        view, depth_m=view.depth_m[part], mask=view.mask[part], K=K, background=background
    )


def why_background_excludes(frame: Frame, view: ViewInput, pose: Rigid, surface: Surface) -> str:
    """Say why the background of an image excludes a pose; nothing where it does not."""
    if is_cut_out(view, pose, surface, frame.noise_per_m2):
        return "it would be cut out of a plane that goes on beside it"
    points_m = pose.apply(surface.points_m)
    wider = [other for other in frame.backgrounds if other.diameter_m >= surface.diameter_m]
    for background in wider:
        share = share_behind(frame, background, points_m, NEAR * surface.diameter_m)
        if share > _SUNK:
            return f"{share:.0%} of it would lie in the bin, table or wall before which it is seen"
    return ""


def is_cut_out(view: ViewInput, pose: Rigid, surface: Surface, noise_per_m2: float) -> bool:
    """Whether what lies on a posed surface is flat, and goes on in its plane beyond the outline.

    Args:
        view: in which the pose was found.
        pose: of the object.
        surface: of its model.
        noise_per_m2: of the view, as of :class:`~depthpose.pose.frame.Frame`.
    """
    window = _cut(view, _pixels_about(view, pose, surface))
    explained = explained_mask(window, pose, surface)
    points_m = back_project(window.depth_m.double(), window.K.double())
    plane = largest_plane(points_m[explained], torch.Generator().manual_seed(0), noise_per_m2)
    if plane is None:
        return False
    if float(is_on_plane(points_m[explained], plane, noise_per_m2).double().mean()) < _FLAT:
        return False
    pixel_m = float(points_m[explained][:, 2].median() / window.K[0, 0])
    reach = EDGE_PX + math.ceil(_RIM * surface.diameter_m / pixel_m)
    rim = grow_mask(explained, reach) & ~grow_mask(explained, EDGE_PX)
    if window.background is not None:
        rim &= ~window.background.is_seen
    return float(is_on_plane(points_m[rim], plane, noise_per_m2).double().mean()) > _CONTINUED
