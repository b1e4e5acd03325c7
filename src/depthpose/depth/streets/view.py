"""The light that one eye of a stage receives, pixel by pixel."""

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from depthpose.core.raster import Raster
from depthpose.depth.streets.shading import Hits, shade, sky_light
from depthpose.depth.streets.sight import Seen, Sight, nearest_at, neighbours
from depthpose.depth.streets.stage import Stage

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
