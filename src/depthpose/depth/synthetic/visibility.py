"""What a camera sees of a scene: the triangle at each pixel or ray, and the light from it."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from depthpose.core.render import Raster, barycentric_shares, edge_functions, rasterize
from depthpose.depth.synthetic.shading import (
    PLANE_NORMAL,
    Hits,
    Stage,
    shade,
    sky_light,
)
from depthpose.depth.synthetic.textures import Indices, Numbers, Vectors

NEAR_PLANE_M = 0.3
"""Depth of the near plane: nearer surfaces are not drawn."""


class Nearest(NamedTuple):
    """The nearest triangle on each of some rays."""

    primitive: Indices  # number of the triangle, -1 where there is none
    shares: Vectors  # barycentric coordinates
    depth_m: Numbers  # camera z

    def select(self, index: Indices) -> "Nearest":
        """Return the nearest triangles on the rays of these numbers."""
        return Nearest(*(values.index_select(0, index) for values in self))


@dataclass(frozen=True, kw_only=True, eq=False)
class Visibility:
    """Which triangles are visible from one camera."""

    raster: Raster  # visibility at the pixel centres
    K: Float64[Tensor, "3 3"]
    eye: Float[Tensor, "3"]  # its position in the left camera's frame [m]; it looks along z
    edges: Float64[Tensor, "n 3 3"]  # edge functions of all triangles; see ``core.render``
    volume: Float64[Tensor, " n"]  # divisors of the edge functions


def view_from(
    stage: Stage, K: Float64[Tensor, "3 3"], size: tuple[int, int], eye: Float[Tensor, "3"]
) -> Visibility:
    """Find the triangle that is visible at each pixel from ``eye`` [m].

    ``size``: height and width of the image [px].
    """
    height, width = size
    corners = stage.corners - eye
    raster = rasterize(corners, K, width, height, NEAR_PLANE_M, with_barycentric=False)
    edges, volume = edge_functions(corners.double() @ K.to(corners.device).mT)
    shares = barycentric_shares(edges, volume, raster.primitive)
    raster = replace(raster, barycentric=shares)
    return Visibility(raster=raster, K=K, eye=eye, edges=edges, volume=volume)


def find_nearest(
    visibility: Visibility, candidates: Int[Tensor, "n m"], places: list[Float64[Tensor, "n 2"]]
) -> list[Nearest]:
    """Find the nearest triangle on rays between the pixel centres, among candidates of each ray.

    Args:
        visibility: what the camera of the rays sees.
        candidates: numbers of triangles that are visible near each ray, -1 for none.
        places: lists of pixels (u, v) [px], which share the candidates.

    Returns:
        The nearest triangles, for each list of ``places``.
    """
    index = candidates.clamp(min=0).flatten()
    volume = visibility.volume.index_select(0, index)[:, None]
    edges = visibility.edges.flatten(1).index_select(0, index) / volume
    edges = edges.unflatten(0, candidates.shape)
    is_missing = candidates < 0
    row = torch.arange(len(candidates))
    results: list[Nearest] = []
    for pixels in places:
        u = pixels[:, :1]
        v = pixels[:, 1:]
        # Edge functions of the corners, a u + b v + c, one by one: a sum over so short an axis
        # would take ten times as long. Their sum is the inverse depth.
        weights = [
            torch.addcmul(edges[..., k + 2], edges[..., k], u).addcmul_(edges[..., k + 1], v)
            for k in (0, 3, 6)
        ]
        inverse_depth = weights[0] + weights[1] + weights[2]
        smallest = torch.minimum(torch.minimum(weights[0], weights[1]), weights[2])
        is_outside = smallest < -1e-9  # of the triangle; the rounding of an edge is inside
        is_too_near = ~(inverse_depth < 1 / NEAR_PLANE_M)
        is_missed = is_outside | is_missing | is_too_near

        inverse_depth = inverse_depth.masked_fill_(is_missed, 0).clamp_(min=0)
        inverse_depth, nearest = inverse_depth.max(1)
        primitive = torch.where(inverse_depth > 0, candidates[row, nearest], -1)
        nearest_weights = torch.stack([weight[row, nearest] for weight in weights], 1)
        shares = (nearest_weights / inverse_depth[:, None]).float()
        results.append(Nearest(primitive, shares, (1 / inverse_depth).float()))
    return results


def find_neighbours(primitive: Int[Tensor, "h w"], index: Indices) -> Int[Tensor, "n 5"]:
    """Find the triangles that are visible at some pixels and at the four neighbours of each.

    Args:
        primitive: number of the triangle that is visible at each pixel.
        index: indices of the pixels in the flattened image.
    """
    height, width = primitive.shape
    column = index % width
    row = index // width
    flat = primitive.flatten()
    visible: list[Tensor] = []
    for x, y in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        rows = (row + y).clamp(0, height - 1)
        columns = (column + x).clamp(0, width - 1)
        visible.append(flat.index_select(0, rows * width + columns))
    return torch.stack(visible, 1)


_SAMPLE_OFFSETS_PX = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))
"""Samples of an edge pixel: a rotated square, which has no preferred direction."""
_MAX_SAMPLE_LIGHT = 4
"""Most light of such a sample: a glint in a quarter of a pixel would outshine the rest, as it does
not in a sensor."""


def render_light(stage: Stage, visibility: Visibility) -> Float[Tensor, "h w 3"]:
    """Compute the linear RGB that reaches each pixel, before any sensor.

    A pixel has the light of its centre; a pixel at an edge the mean of four samples (antialiasing).
    """
    assert visibility.raster.barycentric is not None
    height, width = visibility.raster.primitive.shape
    index = torch.arange(height * width)
    centres = torch.stack([index % width, index // width], 1).double()
    is_edge = _find_edge_pixels(stage, visibility.raster).flatten()
    inner = (~is_edge).nonzero()[:, 0]
    edge = is_edge.nonzero()[:, 0]

    at_centre = Nearest(
        visibility.raster.primitive.flatten(),
        visibility.raster.barycentric.flatten(0, 1),
        visibility.raster.depth_m.flatten(),
    )
    light = torch.zeros(height * width, 3)
    light[inner] = _compute_light_of_rays(
        stage, visibility, centres[inner], at_centre.select(inner)
    )
    if len(edge):
        light[edge] = _compute_light_of_edges(
            stage, visibility, edge, centres[edge], at_centre.select(edge)
        )
    return light.reshape(height, width, 3)


_BENT_COSINE = 0.9
"""Two planes meet at an edge if the cosine of the angle between their normals is below this."""


def _find_edge_pixels(stage: Stage, raster: Raster) -> Bool[Tensor, "h w"]:
    """Find pixels with a neighbour of another surface, or of the same one at a sharp angle."""
    visible = raster.primitive.clamp(min=0)
    surface_id = torch.where(raster.primitive >= 0, stage.surface_id[visible], -1)
    normal = stage.attributes[:, PLANE_NORMAL].index_select(0, visible.flatten())
    normal = normal.unflatten(0, visible.shape)
    is_edge = torch.zeros(raster.primitive.shape, dtype=torch.bool)

    # Each pixel beside the one to its left, then beside the one above it.
    every = slice(None)
    after = slice(1, None)
    before = slice(None, -1)
    for here, beside in (((every, after), (every, before)), ((after, every), (before, every))):
        is_other_triangle = raster.primitive[here] != raster.primitive[beside]
        is_other_surface = surface_id[here] != surface_id[beside]
        x, y, z = (normal[here] * normal[beside]).unbind(-1)
        is_bent = (x + y + z).abs() < _BENT_COSINE
        differs = is_other_triangle & (is_other_surface | is_bent)
        is_edge[here] |= differs
        is_edge[beside] |= differs
    return is_edge


def _compute_light_of_edges(
    stage: Stage,
    visibility: Visibility,
    index: Indices,
    centres: Float64[Tensor, "n 2"],
    at_centre: Nearest,
) -> Vectors:
    """Compute the mean light of four samples of each edge pixel, of the triangles visible near it.

    Args:
        stage: the scene.
        visibility: what the camera sees.
        index: indices of the edge pixels in the flattened image.
        centres: (u, v) of their centres [px].
        at_centre: the triangles at their centres.
    """
    candidates = find_neighbours(visibility.raster.primitive, index)
    offsets = torch.tensor(_SAMPLE_OFFSETS_PX, dtype=torch.float64)
    places = [centres + offset for offset in offsets]
    samples: list[Nearest] = []
    for sample in find_nearest(visibility, candidates, places):
        # A gap between the triangles that are visible near by: take that at the pixel's centre.
        is_gap = (sample.primitive < 0) & (candidates >= 0).all(1)
        filled = Nearest(
            torch.where(is_gap, at_centre.primitive, sample.primitive),
            torch.where(is_gap[:, None], at_centre.shares, sample.shares),
            torch.where(is_gap, at_centre.depth_m, sample.depth_m),
        )
        samples.append(filled)
    nearest = Nearest(*(torch.cat(parts) for parts in zip(*samples, strict=True)))
    light = _compute_light_of_rays(stage, visibility, torch.cat(places), nearest)
    return light.clamp(max=_MAX_SAMPLE_LIGHT).reshape(len(places), -1, 3).mean(0)


def _compute_light_of_rays(
    stage: Stage, visibility: Visibility, pixels: Float64[Tensor, "n 2"], nearest: Nearest
) -> Vectors:
    """Compute the linear RGB that comes along rays, from the nearest triangle or the sky.

    ``pixels``: (u, v) of the rays [px].
    """
    # The rays (x, y, 1) = K^-1 (u, v, 1).
    (a, b, c), (_, d, e), _ = visibility.K.inverse().tolist()
    u, v = pixels.unbind(1)
    rays = torch.stack([a * u + b * v + c, d * v + e, torch.ones_like(u)], 1).float()
    length = rays.norm(dim=1)
    towards = rays / length[:, None]
    sky = (nearest.primitive < 0).nonzero()[:, 0]
    hit = (nearest.primitive >= 0).nonzero()[:, 0]

    light = torch.empty_like(rays)
    light[sky] = sky_light(stage, towards[sky])
    points_m = rays * nearest.depth_m[:, None] + visibility.eye
    hits = Hits(
        primitive=nearest.primitive.index_select(0, hit),
        barycentric=nearest.shares.index_select(0, hit),
        points=points_m.index_select(0, hit),
        towards=towards.index_select(0, hit),
        distance_m=(length * nearest.depth_m).index_select(0, hit),
    )
    light[hit] = shade(stage, hits, float(visibility.K[0, 0]))
    return light
