"""What one camera of a stage sees at pixel centres and between them, and the light of it."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from depthpose.core.render import Raster, barycentric_shares, edge_functions, rasterize
from depthpose.depth.synthetic.shading import Hits, shade, sky_light
from depthpose.depth.synthetic.stage import Stage

NEAR_M = 0.3

Seen = tuple[Int[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, " n"]]
"""Triangles (-1 where none is met), barycentric shares and depths [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sight:
    """Visibility from one camera.

    Attributes:
        raster: visibility at the pixel centres.
        K: intrinsic matrix.
        eye: position of the camera in the left camera's frame [m]; it looks along z.
        edges: edge functions of all triangles; see ``core.render``.
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
        stage: the scene.
        K: intrinsic matrix.
        size: height and width of the picture [px].
        eye: position of the camera in the left camera's frame [m].
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


_OFFSETS = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))
"""Where in an edge pixel light is sampled: a turned square, which treats no direction badly."""


def draw_light(stage: Stage, sight: Sight, *, with_antialiasing: bool) -> Float[Tensor, "h w 3"]:
    """Give linear RGB, before any sensor.

    Args:
        stage: what is drawn.
        sight: from where it is seen.
        with_antialiasing: take four samples in pixels where an edge shows.
    """
    height, width = sight.raster.primitive.shape
    is_edge = torch.zeros(height * width, dtype=torch.bool)
    if with_antialiasing:
        is_edge = _edge_pixels(stage, sight.raster).flatten()
    light = torch.zeros(height * width, 3)
    whole, mixed = (~is_edge).nonzero()[:, 0], is_edge.nonzero()[:, 0]
    light[whole] = _light(stage, sight, _centres(whole, width), _seen_at(sight, whole))
    if len(mixed):
        light[mixed] = _light_of_edges(stage, sight, mixed)
    return light.reshape(height, width, 3)


def _centres(index: Int[Tensor, " n"], width: int) -> Float64[Tensor, "n 2"]:
    return torch.stack([index % width, index // width], 1).double()


def _seen_at(sight: Sight, index: Int[Tensor, " n"]) -> Seen:
    raster = sight.raster
    assert raster.barycentric is not None
    shares, primitive, depth_m = (
        values.flatten(0, 1).index_select(0, index)
        for values in (raster.barycentric, raster.primitive, raster.depth_m)
    )
    return primitive, shares, depth_m


def _edge_pixels(stage: Stage, raster: Raster) -> Bool[Tensor, "h w"]:
    """Pixels beside which something else is seen, or the same thing bent sharply."""
    seen = raster.primitive.clamp(min=0)
    kind = torch.where(raster.primitive >= 0, stage.kind[seen], -1)
    normal = stage.attributes[:, 18:21].index_select(0, seen.flatten()).unflatten(0, seen.shape)
    edge = torch.zeros_like(kind, dtype=torch.bool)
    for one, other in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
    ):
        is_other = raster.primitive[one] != raster.primitive[other]
        is_bent = _aligned(normal[one], normal[other]) < 0.9
        differs = is_other & ((kind[one] != kind[other]) | is_bent)
        edge[one] |= differs
        edge[other] |= differs
    return edge


def _aligned(one: Float[Tensor, "h w 3"], other: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    both = one * other
    return (both[..., 0] + both[..., 1] + both[..., 2]).abs()


def _light_of_edges(stage: Stage, sight: Sight, mixed: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """Mean light of four places in each edge pixel."""
    candidates = neighbours(sight.raster.primitive, mixed)
    centre = _centres(mixed, sight.raster.primitive.shape[1])
    own = _seen_at(sight, mixed)
    places = [centre + torch.tensor(offset, dtype=torch.float64) for offset in _OFFSETS]
    found = []
    for seen in nearest_at(sight, candidates, places):
        # A gap between all that was seen near by: take what the pixel's centre sees.
        is_lost = (seen[0] < 0) & (candidates >= 0).all(1)
        found.append([
            torch.where(is_lost if one.ndim == 1 else is_lost[:, None], instead, one)
            for one, instead in zip(seen, own, strict=True)
        ])  # fmt: skip
    primitive, shares, depth = (torch.cat(parts) for parts in zip(*found, strict=True))
    light = _light(stage, sight, torch.cat(places), (primitive, shares, depth))
    # A glint in a quarter of a pixel would outshine the rest, as it does not in a sensor.
    return light.clamp(max=4).reshape(len(_OFFSETS), -1, 3).mean(0)


def _light(
    stage: Stage, sight: Sight, pixels: Float64[Tensor, "n 2"], seen: Seen
) -> Float[Tensor, "n 3"]:
    primitive, shares, depth = seen
    rays = sight.rays(pixels)
    length = rays.norm(dim=1)
    towards = rays / length[:, None]
    light = torch.empty_like(rays)
    sky = (primitive < 0).nonzero()[:, 0]
    light[sky] = sky_light(stage, towards[sky])
    hit = (primitive >= 0).nonzero()[:, 0]
    hits = Hits(
        primitive=primitive.index_select(0, hit),
        barycentric=shares.index_select(0, hit),
        points=(rays * depth[:, None] + sight.eye).index_select(0, hit),
        towards=towards.index_select(0, hit),
        distance_m=(length * depth).index_select(0, hit),
    )
    light[hit] = shade(stage, hits, float(sight.K[0, 0]))
    return light
