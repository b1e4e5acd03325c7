"""Points spread evenly over triangles."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

_PLASTIC = 1.32471795724474602596  # plastic number, the root of x^3 = x + 1


def spread_over_triangles(
    corners: Float64[Tensor, "f 3 3"], count: int
) -> tuple[Int64[Tensor, " count"], Float64[Tensor, "count 3"]]:
    """Spread points evenly over triangles, always the same ones.

    Points are at equal steps of the cumulated area, and placed in their triangle by a sequence of
    low discrepancy (Roberts 2018), which is more even than random numbers.

    Args:
        corners: of each triangle.
        count: how many points.

    Returns:
        The triangle of each point, and its barycentric coordinates there.
    """
    # The triangle of each point, by equal steps of the area.
    doubled = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    bounds = doubled.norm(dim=-1).cumsum(0)
    steps = (torch.arange(count, dtype=torch.float64) + 0.5) / count * bounds[-1]
    face = torch.searchsorted(bounds, steps).clamp(max=len(bounds) - 1)

    # Its place there, by two numbers of the sequence. The root of the first makes the density even:
    # a triangle is the wider the farther from its first corner.
    order = torch.arange(1, count + 1, dtype=torch.float64)
    u = (order / _PLASTIC) % 1
    v = (order / _PLASTIC**2) % 1
    root = u.sqrt()
    return face, torch.stack([1 - root, root * (1 - v), root * v], -1)
