"""Places spread evenly over triangles."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

_PLASTIC = 1.32471795724474602596


def surface_places(
    corners: Float64[Tensor, "f 3 3"], count: int
) -> tuple[Int64[Tensor, " count"], Float64[Tensor, "count 3"]]:
    """Spread places evenly over triangles: the triangle of each, and the shares of its corners.

    Faces are entered in proportion to their area at equal steps, and each point placed by a
    sequence of low discrepancy (Roberts 2018), which is more even than chance.
    """
    doubled = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    bounds = doubled.norm(dim=-1).cumsum(0)
    steps = (torch.arange(count, dtype=torch.float64) + 0.5) / count * bounds[-1]
    face = torch.searchsorted(bounds, steps).clamp(max=len(bounds) - 1)
    order = torch.arange(1, count + 1, dtype=torch.float64)
    u = (order / _PLASTIC) % 1
    v = (order / _PLASTIC**2) % 1
    root = u.sqrt()
    return face, torch.stack([1 - root, root * (1 - v), root * v], -1)
