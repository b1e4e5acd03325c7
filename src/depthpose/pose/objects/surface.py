"""What of a model a camera may see: triangles, and the box of their picture."""

import math

import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull, KDTree, QhullError
from torch import Tensor

from depthpose.pose.types import ObjectModel

_CORNERS = 6
"""Of a disc: three quarters of its area, in four triangles."""
_REACH = 1.6
"""Radius of a disc, in spacings of its points: neighbours then overlap, and nothing shows through
where the points are twice as far apart as usual."""


def drawn_triangles(model: ObjectModel) -> Float[Tensor, "n 3 3"]:
    """Give the faces of a model, or a disc at each point of one that has no faces."""
    return model.triangles_m if len(model.faces) else surfel_triangles(model)


def surfel_triangles(model: ObjectModel) -> Float[Tensor, "n 3 3"]:
    """Lay a flat six-cornered disc on each point, across its normal (Pfister et al. 2000).

    Each is as large as its own neighbourhood is sparse: the distance to the third nearest point,
    but no more than twice the usual one, so that a stray point makes no plate.
    """
    points = model.vertices_m.double()
    distance, _ = KDTree(points.numpy()).query(points.numpy(), k=min(4, len(points)))
    spacing = torch.from_numpy(distance[:, -1])
    radius = _REACH * spacing.clamp(max=2 * float(spacing.median())) / 2**0.5
    normal = model.normals.double()
    # Any axis that is not along the normal.
    helper = torch.eye(3, dtype=torch.float64)[normal.abs().argmin(1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(normal, helper), dim=-1)
    second = torch.linalg.cross(normal, first)
    angle = 2 * math.pi * torch.arange(_CORNERS, dtype=torch.float64) / _CORNERS
    spokes = first[:, None] * angle.cos()[:, None] + second[:, None] * angle.sin()[:, None]
    corners = points[:, None] + radius[:, None, None] * spokes
    fan = torch.tensor([[0, i, i + 1] for i in range(1, _CORNERS - 1)])
    return corners[:, fan].flatten(0, 1).to(model.vertices_m)


def hull_points(triangles_m: Float[Tensor, "n 3 3"]) -> Float[Tensor, "m 3"]:
    """Give the corners of the convex hull: their picture's box is the whole object's."""
    points = triangles_m.reshape(-1, 3).double()
    try:
        return points[torch.from_numpy(ConvexHull(points.numpy()).vertices).long()]
    except (QhullError, ValueError):  # flat: every corner counts
        return points
