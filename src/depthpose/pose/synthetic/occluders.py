"""Random shapes that occlude an exact share of an object."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.pose.synthetic.random_numbers import random_index, uniform

Depth = Float[Tensor, "h w"]
Mask = Bool[Tensor, "h w"]


def draw_levels(height: int, width: int, generator: torch.Generator) -> Depth:
    """Draw an image whose sublevel sets are half-planes, ellipses, boxes or convex polygons.

    The pixels below a level are the shape of an occluder: of the size that the level chooses.
    """
    # Coordinates about a random place, along a random direction and across it.
    size = max(height, width)
    angle = uniform(generator, 0.0, 2 * math.pi)
    stretch = uniform(generator, 0.3, 1.0)
    row = uniform(generator, 0.0, float(height))
    column = uniform(generator, 0.0, float(width))
    v = (torch.arange(height)[:, None] - row) / size
    u = (torch.arange(width)[None] - column) / size
    along = math.cos(angle) * u + math.sin(angle) * v
    across = (math.cos(angle) * v - math.sin(angle) * u) * stretch
    match random_index(generator, 4):
        case 0:  # half-planes
            return along
        case 1:  # ellipses
            return along.square() + across.square()
        case 2:  # boxes
            return torch.maximum(along.abs(), across.abs())
        case _:
            return _draw_polygon_levels(along, across, generator)


def _draw_polygon_levels(along: Depth, across: Depth, generator: torch.Generator) -> Depth:
    """Draw an image whose sublevel sets are convex polygons of three to six sides.

    ``along`` and ``across`` are the coordinates of each pixel, about the middle of the polygons.
    """
    # The direction of each side's normal, and its distance from the middle.
    sides = 3 + random_index(generator, 4)
    gaps = torch.rand(sides, generator=generator).cumsum(0)
    angles = 2 * math.pi * gaps / (gaps[-1] + uniform(generator, 0.2, 0.8))
    extents = 0.5 + torch.rand(sides, generator=generator)

    # The size of the polygon on which each pixel lies, by its farthest side.
    levels = torch.full_like(along, -torch.inf)
    for angle, extent in zip(angles.tolist(), extents.tolist(), strict=True):
        toward_side = math.cos(angle) * along + math.sin(angle) * across
        levels = torch.maximum(levels, toward_side / extent)
    return levels


def occlude(
    depth_m: Depth, silhouette: Mask, share: float, generator: torch.Generator
) -> tuple[Depth, Mask]:
    """Occlude exactly a share of a silhouette by something before it.

    Args:
        depth_m: depth of the object and of what is behind it.
        silhouette: pixels of the object.
        share: of these pixels, 0..1, that is occluded.
        generator: of random numbers.

    Returns:
        The depth with the occluder, and the part of the silhouette that stays visible.
    """
    count = round(share * int(silhouette.sum()))
    levels = draw_levels(depth_m.shape[0], depth_m.shape[1], generator)
    gap_m = uniform(generator, 0.005, 0.15)
    if count == 0:
        return depth_m, silhouette
    level = levels[silhouette].kthvalue(count).values
    is_hidden = levels <= level

    # The occluder is nearer than all that it occludes.
    nearest_m = depth_m.masked_fill(~(silhouette & is_hidden), torch.inf).min()
    occluder_m = (nearest_m - gap_m).clamp(min=0.1 * nearest_m)
    return torch.where(is_hidden, occluder_m, depth_m), silhouette & ~is_hidden
