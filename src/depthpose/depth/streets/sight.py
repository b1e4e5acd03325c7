"""What is seen from one eye of a stage, at pixel centres and between them."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from depthpose.core.raster import Raster, barycentric_shares, edge_functions, rasterize
from depthpose.depth.streets.stage import Stage

NEAR_M = 0.3

Seen = tuple[Int[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, " n"]]
"""Triangles (-1 where none is met), barycentric shares and depths [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sight:
    """Visibility from one eye.

    Attributes:
        raster: visibility at the pixel centres.
        K: intrinsic matrix.
        eye: where the camera stands, in the left camera's frame [m]; it looks along z.
        edges: edge functions of all triangles; see ``core.raster``.
        volume: what they are divided by.
    """

    raster: Raster
    K: Float64[Tensor, "3 3"]
    eye: Float[Tensor, "3"]
    edges: Float64[Tensor, "n 3 3"]
    volume: Float64[Tensor, " n"]

    def rays(self, pixels: Float64[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        """Directions of pixels, with z = 1."""
        (a, b, c), (_, d, e), _ = self.K.inverse().tolist()
        u, v = pixels.unbind(1)
        return torch.stack([a * u + b * v + c, d * v + e, torch.ones_like(u)], 1).float()


def look(
    stage: Stage, K: Float64[Tensor, "3 3"], size: tuple[int, int], eye: Float[Tensor, "3"]
) -> Sight:
    """Find what each pixel sees.

    Args:
        stage: what to look at.
        K: intrinsic matrix.
        size: height and width of the picture [px].
        eye: where the camera stands, in the left camera's frame [m].
    """
    corners = stage.corners - eye
    raster = rasterize(corners, K, size[1], size[0], NEAR_M, with_barycentric=False)
    edges, volume = edge_functions(corners, K)
    shares = barycentric_shares(edges, volume, raster.primitive)
    raster = replace(raster, barycentric=shares)
    return Sight(raster=raster, K=K, eye=eye, edges=edges, volume=volume)


def nearest_at(
    sight: Sight, candidates: Int[Tensor, "n m"], places: list[Float64[Tensor, "n 2"]]
) -> list[Seen]:
    """Look between the pixel centres, at triangles that were seen near by.

    Args:
        sight: from where.
        candidates: triangles that may be met; -1 none.
        places: one or more lists of pixels (u, v) [px], which share their candidates.

    Returns:
        For each list, the nearest of the candidates on each pixel's ray.
    """
    which = candidates.clamp(min=0).flatten()
    volume = sight.volume.index_select(0, which)[:, None]
    lines = (sight.edges.flatten(1).index_select(0, which) / volume).unflatten(0, candidates.shape)
    missing, row = candidates < 0, torch.arange(len(candidates))
    found = []
    for pixels in places:
        u, v = pixels[:, :1], pixels[:, 1:]
        # Corner by corner: a sum over so short an axis would take ten times as long.
        weights = [
            torch.addcmul(lines[..., i + 2], lines[..., i], u).addcmul_(lines[..., i + 1], v)
            for i in (0, 3, 6)
        ]
        inverse = weights[0] + weights[1] + weights[2]
        least = torch.minimum(torch.minimum(weights[0], weights[1]), weights[2])
        is_missed = (least < -1e-9) | missing | ~(inverse < 1 / NEAR_M)
        inverse, first = inverse.masked_fill_(is_missed, 0).clamp_(min=0).max(1)
        primitive = torch.where(inverse > 0, candidates[row, first], -1)
        chosen = torch.stack([weight[row, first] for weight in weights], 1)
        shares = (chosen / inverse[:, None]).float()
        found.append((primitive, shares, (1 / inverse).float()))
    return found


def neighbours(primitive: Int[Tensor, "h w"], index: Int[Tensor, " n"]) -> Int[Tensor, "n 5"]:
    """Triangles seen at some pixels and at the four beside each."""
    height, width = primitive.shape
    column, row = index % width, index // width
    places = [
        (row + y).clamp(0, height - 1) * width + (column + x).clamp(0, width - 1)
        for x, y in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    flat = primitive.flatten()
    return torch.stack([flat.index_select(0, place) for place in places], 1)
