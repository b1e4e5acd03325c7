"""How far a cloud and a posed silhouette reach beyond each other: a copy of another size does."""

import torch
from jaxtyping import Float, Float64
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid
from depthpose.pose.compiled import serves
from depthpose.pose.surface import NEAR, Surface
from depthpose.pose.types import ViewInput

_SAMPLED = 1000
"""At most so many points of the cloud are compared, evenly taken."""
_OVER = 0.98
"""Quantile of the points: a few may be the border's."""
_SHORT = 0.95
"""Quantile of the silhouette's cells: its border has errors of the sensor and of the mask."""
_CELL = 1 / 64
"""Side of a cell of the silhouette, in diameters."""
_CELLS = 2**20
"""More than a row of them has."""


def overhang(cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface) -> float:
    """Measure how far the cloud reaches beyond the posed silhouette, in diameters.

    Distances are across the view, at the depth of the cloud; the cloud's outermost 2 % do not
    count.

    Args:
        cloud_m: of the object, in the camera frame.
        pose: ``camera_from_model``.
        surface: of the model.
    """
    cloud, posed, _ = _across(cloud_m, pose, surface)
    return float(_distances(posed, cloud).quantile(_OVER))


def shortfall(
    view: ViewInput, cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface
) -> float:
    """Measure how far the posed silhouette reaches beyond the cloud, in diameters.

    It counts where the camera saw what lies behind the posed surface: what is occluded, or has no
    reading, says nothing. 5 % of the silhouette do not count.

    Args:
        view: depth and camera; its mask does not matter.
        cloud_m: of the object, in the camera frame.
        pose: ``camera_from_model``.
        surface: of the model.
    """
    cloud, posed, posed_m = _across(cloud_m, pose, surface)
    rays = posed_m @ view.K.double().T
    u, v = (rays[:, :2] / rays[:, 2:]).round().long().unbind(-1)
    height, width = view.depth_m.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    seen_m = view.depth_m.double()[v.clamp(0, height - 1), u.clamp(0, width - 1)]
    is_behind = inside & (seen_m > posed_m[:, 2] + NEAR * surface.diameter_m)
    apart = posed.new_zeros(len(posed))
    apart[is_behind] = _distances(cloud, posed[is_behind])
    cell = (posed / _CELL).floor().long()
    _, number = (cell[:, 0] * _CELLS + cell[:, 1]).unique(return_inverse=True)
    farthest = apart.new_zeros(int(number.max()) + 1).scatter_reduce_(0, number, apart, "amax")
    return float(farthest.quantile(_SHORT))


def _distances(
    them: Float64[Tensor, "n 2"], points: Float64[Tensor, "m 2"]
) -> Float64[Tensor, " m"]:
    """Give the distance of points to the nearest of others."""
    if serves(them, points):
        from depthpose.pose.compiled.outline import distances_to

        return torch.from_numpy(distances_to(them.numpy(), points.numpy(), _CELL))
    return torch.from_numpy(KDTree(them.numpy()).query(points.numpy(), workers=1)[0])


def _across(
    cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface
) -> tuple[Float64[Tensor, "k 2"], Float64[Tensor, "m 2"], Float64[Tensor, "m 3"]]:
    """Give points and posed surface across the view, in diameters, and the latter in the camera."""
    cloud_m = take_evenly(cloud_m.double(), _SAMPLED)
    posed_m = pose.double().apply(surface.points_m)
    posed_m[:, 2].clamp_(min=0.1 * float(cloud_m[:, 2].median()))
    scale = cloud_m[:, 2].median() / surface.diameter_m
    cloud, posed = (points[:, :2] / points[:, 2:] * scale for points in (cloud_m, posed_m))
    return cloud, posed, posed_m
