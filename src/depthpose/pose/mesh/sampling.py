"""Points that represent a surface: farthest ones, even ones, and the normals of bare points."""

import math

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError
from depthpose.pose.types import ObjectModel

_NEIGHBOURS = 16
_DENSE = 20_000
_PLASTIC = 1.32471795724474602596


def farthest_points(points_m: Float[Tensor, "n 3"], count: int) -> Int64[Tensor, " count"]:
    """Choose points each of which is farthest from all before it; the first, from the centre.

    The centre of the bounding box, as PVNet does: it does not depend on how densely a part is
    meshed. Of equals the earliest in the file is taken, so that a mesh always has the same points.

    Raises:
        InputError: there are fewer different points than wanted.
    """
    points = points_m.double().cpu().numpy()
    centre = (points.min(0) + points.max(0)) / 2
    nearest = ((points - centre) ** 2).sum(-1)
    chosen = []
    for _ in range(count):
        farthest = int(nearest.argmax())
        if nearest[farthest] == 0 and chosen:
            raise InputError(
                f"the model has only {len(chosen)} different points, and {count} keypoints are to "
                "be chosen among them; give a mesh with triangles, or more points"
            )
        chosen.append(farthest)
        distance = ((points - points[farthest]) ** 2).sum(-1)
        # All are measured to the chosen ones alone: the centre decides the first alone.
        nearest = distance if len(chosen) == 1 else np.minimum(nearest, distance)
    return torch.tensor(chosen)


def sample_surface(
    model: ObjectModel, count: int
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Spread points evenly over the surface, always the same ones, with their outward normals.

    Faces are entered in proportion to their area at equal steps, and each point placed by a
    sequence of low discrepancy (Roberts 2018), which is more even than chance. A model of points
    gives its own in even steps of their order, at most all.

    Args:
        model: the object.
        count: how many; a model of points may have fewer.
    """
    if len(model.faces) == 0:
        # Farthest points would be evener, and quadratic; point models are even as they come.
        return take_evenly(model.vertices_m, count), take_evenly(model.normals, count)
    corners = model.triangles_m.double()
    doubled = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = doubled.norm(dim=-1)
    bounds = area.cumsum(0)
    steps = (torch.arange(count, dtype=torch.float64) + 0.5) / count * bounds[-1]
    face = torch.searchsorted(bounds, steps).clamp(max=len(area) - 1)
    order = torch.arange(1, count + 1, dtype=torch.float64)
    u, v = (order / _PLASTIC) % 1, (order / _PLASTIC**2) % 1
    root = u.sqrt()
    share = torch.stack([1 - root, root * (1 - v), root * v], -1)
    points = (corners[face] * share[..., None]).sum(-2)
    normals = doubled[face] / area[face, None].clamp(min=1e-300)
    return points.to(model.vertices_m), normals.to(model.vertices_m)


def gap_to_surface_m(points_m: Float[Tensor, "n 3"], model: ObjectModel) -> float:
    """Say how far off a model's surface the farthest of some points lies [m].

    The surface is its vertices and 20,000 points between them, a hundredth of the diameter apart:
    the vertices of a coarse mesh alone are far from most of it.
    """
    surface_m = torch.cat([model.vertices_m, sample_surface(model, _DENSE)[0]])
    return float(torch.cdist(points_m, surface_m).amin(1).max())


def estimate_normals(points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Estimate unit normals of bare points by the plane through the nearest 16, pointing outward.

    Outward is away from the mean of the points: right for convex parts alone. What needs no side,
    as point-to-plane distance, may use them everywhere.
    """
    points = points_m.double().cpu().numpy()
    _, index = KDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
    near = points[index.reshape(len(points), -1)]
    near = near - near.mean(1, keepdims=True)
    _, axes = np.linalg.eigh(near.transpose(0, 2, 1) @ near)
    normals = axes[:, :, 0]
    is_inward = ((points - points.mean(0)) * normals).sum(-1) < 0
    normals[is_inward] *= -1
    return torch.from_numpy(normals).to(points_m)


def fibonacci_directions(count: int) -> Float[Tensor, "count 3"]:
    """Spread unit vectors evenly over half of the sphere (an axis needs no sign)."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - i / count
    angle = math.pi * (1 + 5**0.5) * i
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], -1)
