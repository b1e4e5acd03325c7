"""Whether a pose fits: the posed surface against what the camera saw, at the sensor's own scale."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor
from torch.nn.functional import max_pool2d

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import back_project
from depthpose.core.rigid import Rigid
from depthpose.pose.augment import grow_mask
from depthpose.pose.surface import NEAR, Surface
from depthpose.pose.types import Fit, ViewInput

BORDER_PX = 2
"""Readings so near an edge may be of either side: stereo and structured light match windows, and
a mask ends so far from the silhouette."""
SHOWN = 0.95
"""Of what was seen of the surface so much agrees at a right pose that a sensor reads well."""
_NOISES = 3.0
_WIDEST = 2.0
"""Times the usual limit, whatever the noise: beyond, what was read is no surface."""
_COMPARED = 1000
"""Readings of the object, evenly taken, that are laid on the surface."""
_LAG_PX = 3
"""Noise is compared so far apart: neighbouring pixels of a real sensor err alike."""
_FINEST = 0.01
"""Of the diameter: models are no more exact."""
_CELLS = 40
"""Of the z-buffer along a diameter, at most; no finer than the pixels and the surface's points."""
_GRAZING = 0.2
"""Cosine below which a surface is not compared: no sensor reads it well."""
_WIDE = 0.6
"""Half of the window about the object, in diameters."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """What a camera saw about an object, in a window of its image.

    Attributes:
        depth_m: NaN where there is no reading.
        is_own: the pixels that are said to be the object's.
        K: of the window.
        noise_m: standard deviation of a reading, of what neighbours do not share.
    """

    depth_m: Float64[Tensor, "h w"]
    is_own: Bool[Tensor, "h w"]
    K: Float64[Tensor, "3 3"]
    noise_m: float


def seen_about(cloud_m: Float[Tensor, "n 3"], view: ViewInput | None, diameter_m: float) -> Seen:
    """Cut the window of an object out of its view; a cloud alone is drawn as its camera saw it."""
    cloud_m = cloud_m.double()
    K = _camera_of(cloud_m) if view is None else view.K.double()
    u, v = (cloud_m @ K.T)[:, :2].div(cloud_m[:, 2:]).round().long().unbind(-1)
    reach = int(_WIDE * diameter_m / float(cloud_m[:, 2].median()) * float(K[0, 0])) + 4
    low = torch.stack([u.amin(), v.amin()]) - reach
    high = torch.stack([u.amax(), v.amax()]) + reach + 1
    if view is not None:
        size = torch.tensor(view.depth_m.shape).flip(0)
        low, high = low.clamp(min=0), torch.minimum(high, size)
    (left, top), (right, bottom) = low.tolist(), high.tolist()
    inside = (u >= left) & (u < right) & (v >= top) & (v < bottom)
    place = ((v - top) * (right - left) + u - left)[inside]
    own = torch.zeros(bottom - top, right - left, dtype=torch.bool)
    own.view(-1)[place] = True
    own = grow_mask(grow_mask(own, 1), -1)  # of a large cloud some points are left out
    if view is None:
        drawn_m = torch.full((own.numel(),), torch.inf, dtype=torch.float64)
        drawn_m.scatter_reduce_(0, place, cloud_m[inside, 2], "amin")
        depth_m = drawn_m.view(own.shape)
    else:
        depth_m = view.depth_m[top:bottom, left:right].double()
    depth_m = torch.where(depth_m.isfinite() & (depth_m > 0), depth_m, torch.nan)
    moved = K.clone()
    moved[:2, 2] -= torch.tensor([left, top], dtype=torch.float64)
    return Seen(depth_m=depth_m, is_own=own, K=moved, noise_m=_noise_m(depth_m, own))


def fit_of(seen: Seen, pose: Rigid, surface: Surface) -> Fit:
    """Compare a posed surface with what the camera saw.

    Each visible place of the surface is compared with the readings about its pixel, of which the
    nearest in depth counts: the sensor's edges are blurred. Beyond the noise they lie on the
    surface, behind it (the camera saw through the surface), or before it: as part of the object,
    which contradicts the pose, or of something that occludes it.
    """
    pose = pose.double()
    points_m, normals = pose.apply(surface.points_m), surface.normals @ pose.R.mT
    near_m = NEAR * surface.diameter_m
    limit_m = min(max(_NOISES * seen.noise_m, near_m), _WIDEST * near_m)
    nothing = Fit(agrees=0.0, seen=0.0, beyond=1.0, explained=0.0, noise_m=seen.noise_m)
    if float(points_m[:, 2].min()) <= 0:
        return nothing
    pixel = (points_m @ seen.K.T)[:, :2] / points_m[:, 2:]
    cosine = ((normals * points_m).sum(-1) / points_m.norm(dim=-1)).abs()
    buffer = _drawn(pixel, points_m[:, 2], surface, seen.K)
    hidden_m = 2 * buffer.side_m * (1 - cosine.square()).sqrt() / cosine.clamp(min=_GRAZING)
    is_visible = points_m[:, 2] < buffer.nearest_m + _FINEST * surface.diameter_m + hidden_m
    is_visible &= (cosine > _GRAZING) & _inside(pixel.round().long(), seen.depth_m)
    u, v = pixel[is_visible].round().long().unbind(-1)
    area, depth_m = cosine[is_visible], points_m[is_visible, 2]
    if len(depth_m) == 0:
        return nothing
    off_m = _nearest_reading(seen.depth_m, u, v, depth_m) * area
    own = grow_mask(seen.is_own, -BORDER_PX)
    own = own if bool(own.any()) else seen.is_own  # thin things are all border
    agrees = float(area[off_m.abs() <= limit_m].sum())
    through = float(area[off_m > limit_m].sum())
    bulges = float(area[(off_m < -limit_m) & own[v, u]].sum())
    read = (own & seen.depth_m.isfinite()).nonzero().flip(-1)
    beyond = float((~buffer.covers(read)).double().mean()) if len(read) else 0.0
    read_m = take_evenly(
        back_project(seen.depth_m, seen.K)[own & seen.depth_m.isfinite()], _COMPARED
    )
    local_m = pose.inverse().apply(read_m)
    apart_m = (local_m - surface.points_m[surface.nearest(local_m)]).norm(dim=-1)
    compared = agrees + through + bulges
    return Fit(
        agrees=agrees / compared if compared > 0 else 0.0,
        seen=agrees / float(area.sum()),
        beyond=beyond,
        explained=float((apart_m < limit_m).double().mean()) if len(apart_m) else 0.0,
        noise_m=seen.noise_m,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Buffer:
    """Cells of an image in which a posed surface was drawn.

    Attributes:
        low: column and row of the first cell.
        side_px: of a cell.
        side_m: of a cell at the object.
        is_near: cells within the border of the silhouette.
        nearest_m: for each point of the surface the nearest depth in the cells about it.
    """

    low: Int64[Tensor, "2"]
    side_px: float
    side_m: float
    is_near: Bool[Tensor, "rows columns"]
    nearest_m: Float64[Tensor, " m"]

    def covers(self, pixels: Int64[Tensor, "n 2"]) -> Bool[Tensor, " n"]:
        """Whether pixels (u, v) lie within the silhouette or its border."""
        column, row = ((pixels / self.side_px).floor().long() - self.low).unbind(-1)
        rows, columns = self.is_near.shape
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        return inside & self.is_near[row.clamp(0, rows - 1), column.clamp(0, columns - 1)]


def _drawn(
    pixel: Float64[Tensor, "m 2"],
    depth_m: Float64[Tensor, " m"],
    surface: Surface,
    K: Float64[Tensor, "3 3"],
) -> _Buffer:
    """Draw the points of a surface into cells that are large enough to leave no hole."""
    pixel_m = float(depth_m.median()) / float(K[0, 0])
    side_m = max(pixel_m, surface.diameter_m / _CELLS, 1.5 * surface.spacing_m)
    side_px = side_m / pixel_m
    cell = (pixel / side_px).floor().long()
    border = int(-(-BORDER_PX // side_px))
    low, high = cell.amin(0) - border - 1, cell.amax(0) + border + 2
    columns, rows = (high - low).tolist()
    number = (cell[:, 1] - low[1]) * columns + cell[:, 0] - low[0]
    drawn_m = torch.full((rows * columns,), torch.inf, dtype=torch.float64)
    drawn_m.scatter_reduce_(0, number, depth_m, "amin")
    about_m = -max_pool2d(-drawn_m.view(1, rows, columns), 3, 1, 1)
    filled = grow_mask(grow_mask(drawn_m.view(rows, columns).isfinite(), 1), -1)
    return _Buffer(
        low=low,
        side_px=side_px,
        side_m=side_m,
        is_near=grow_mask(filled, border),
        nearest_m=about_m.flatten()[number],
    )


def _nearest_reading(
    depths_m: Float64[Tensor, "h w"],
    u: Int64[Tensor, " n"],
    v: Int64[Tensor, " n"],
    depth_m: Float64[Tensor, " n"],
) -> Float64[Tensor, " n"]:
    """Give how far behind a depth the reading is that is nearest to it; NaN where there is none."""
    height, width = depths_m.shape
    steps = range(-BORDER_PX, BORDER_PX + 1)
    best_m = torch.full_like(depth_m, torch.nan)
    for down in steps:
        for right in steps:
            read_m = depths_m[(v + down).clamp(0, height - 1), (u + right).clamp(0, width - 1)]
            off_m = read_m - depth_m
            best_m = torch.where(~(best_m.abs() <= off_m.abs()) & off_m.isfinite(), off_m, best_m)
    return best_m


def _noise_m(depth_m: Float64[Tensor, "h w"], is_own: Bool[Tensor, "h w"]) -> float:
    """Give the noise of the readings by their second differences, which a slope does not change."""
    own_m, found = torch.where(grow_mask(is_own, -1), depth_m, torch.nan), []
    for along_m in (own_m, own_m.T):
        ends_m = along_m[:, : -2 * _LAG_PX] + along_m[:, 2 * _LAG_PX :]
        bent_m = (ends_m - 2 * along_m[:, _LAG_PX:-_LAG_PX]).flatten()
        found.append(bent_m[bent_m.isfinite()])
    bent_m = torch.cat(found).abs()
    return 1.4826 * float(bent_m.median()) / 6**0.5 if len(bent_m) > 0 else 0.0


def _camera_of(cloud_m: Float64[Tensor, "n 3"]) -> Float64[Tensor, "3 3"]:
    """Give the intrinsic matrix of a camera to which the points of a cloud are a pixel apart."""
    rays = cloud_m[:, :2] / cloud_m[:, 2:]
    some = take_evenly(rays, 200)
    apart = torch.cdist(some, take_evenly(rays, 5000))
    apart = apart.masked_fill(apart < 1e-9, torch.inf).amin(-1)
    focal = 1 / (1.5 * float(apart.median()))
    focal *= (min(len(rays), 5000) / len(rays)) ** -0.5
    return torch.diag(torch.tensor([focal, focal, 1.0], dtype=torch.float64))


def _inside(pixel: Int64[Tensor, "n 2"], image: Float64[Tensor, "h w"]) -> Bool[Tensor, " n"]:
    size = torch.tensor(image.shape).flip(0)
    return ((pixel >= 0) & (pixel < size)).all(-1)
