"""Shadow maps: what the sun does not reach, and how much of the sky a point sees."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.render import rasterize_orthographic
from depthpose.depth.synthetic.textures import Numbers, Vectors


@dataclass(frozen=True, kw_only=True)
class MapArea:
    """The part of the scene before the camera that a shadow map covers."""

    half_m: float  # its extent to the left and to the right
    reach_m: tuple[float, float]  # its nearest and farthest distance ahead
    side_px: int  # side of the map at full size


SUN_AREAS = (
    MapArea(half_m=18.0, reach_m=(-3.0, 36.0), side_px=1024),
    MapArea(half_m=60.0, reach_m=(-5.0, 115.0), side_px=768),
)
"""A fine map of what is near, and a coarse one of what is far."""
SKY_AREA = MapArea(half_m=28.0, reach_m=(-3.0, 64.0), side_px=512)
_AREA_Y_M = (1.7, -3)
"""Vertical extent of these areas: from the ground to 3 m above the camera."""
_NO_SURFACE_M = 1e6
"""Depth in a shadow map where there is no surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShadowMap:
    """Depth of the first surface along a light; points beyond it are in shadow."""

    depth_m: Float[Tensor, "side side"]
    rotation: Float[Tensor, "3 3"]  # rotation from the camera's frame to that of the light
    low: Float[Tensor, "2"]  # the light-frame corner of the map [m]
    pixels_per_m: Float[Tensor, "2"]  # scale of its columns and rows
    texel_m: float  # the larger of its two pixel sizes

    def project(self, points: Vectors) -> tuple[Numbers, Numbers, Numbers]:
        """Project points to the map: column and row [px], and depth along the light [m]."""
        rotated = points @ self.rotation.T
        column, row = ((rotated[:, :2] - self.low) * self.pixels_per_m).unbind(1)
        return column, row, rotated[:, 2]


def render_shadow_map(
    corners: Float[Tensor, "n 3 3"], to_light: Float[Tensor, "3"], area: MapArea, share: float
) -> ShadowMap:
    """Render a shadow map of an area.

    Args:
        corners: corners of the triangles that cast shadows [m].
        to_light: direction to the light.
        area: what the map covers.
        share: side of the map, as a share of ``area.side_px``.
    """
    # Axes of the light's frame: z away from the light.
    side_px = round(area.side_px * share)
    z = F.normalize(-to_light, dim=0)
    aside = torch.tensor([1.0, 0, 0]) if abs(float(z[0])) < 0.9 else torch.tensor([0.0, 0, 1])
    x = F.normalize(torch.linalg.cross(aside, z), dim=0)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z])

    # The box about the area fills the map.
    x_m = (-area.half_m, area.half_m)
    box = torch.tensor(list(product(x_m, _AREA_Y_M, area.reach_m)))
    box_in_map = (box @ rotation.T)[:, :2]
    low = box_in_map.amin(0)
    high = box_in_map.amax(0)
    pixels_per_m = (side_px - 1) / (high - low)

    rotated = corners @ rotation.T
    projected = torch.cat([(rotated[..., :2] - low) * pixels_per_m, rotated[..., 2:]], -1)
    raster = rasterize_orthographic(projected, side_px, side_px, with_barycentric=False)
    return ShadowMap(
        depth_m=raster.depth_m.nan_to_num(nan=_NO_SURFACE_M),
        rotation=rotation,
        low=low,
        pixels_per_m=pixels_per_m,
        texel_m=float(1 / pixels_per_m.min()),
    )


def sunlit_share(sun_maps: Sequence[ShadowMap], points: Vectors, normals: Vectors) -> Numbers:
    """Compute the share of the sun that reaches each point: 0 in shadow, 1 lit, soft over a texel.

    Args:
        sun_maps: shadow maps of the sun, from near to far.
        points: points [m], in the left camera's frame.
        normals: unit normals of the planes on which they lie.
    """
    lit = torch.ones(len(points))
    # From the far map to the near one, which is finer and replaces it.
    for shadow_map in reversed(sun_maps):
        # Points are lifted off their surface, or it would shade itself in stripes.
        lifted = points + normals * (2 * shadow_map.texel_m)
        column, row, depth_m = shadow_map.project(lifted)
        side = len(shadow_map.depth_m)
        is_inside = (column > 1) & (row > 1) & (column < side - 3) & (row < side - 3)
        left = column.floor().clamp(1, side - 3)
        top = row.floor().clamp(1, side - 3)
        across = column - left
        down = row - top

        # Whether each of the four texels about the point is lit, interpolated.
        texel = top.long() * side + left.long()
        flat_m = shadow_map.depth_m.flatten()
        limit_m = depth_m - 0.8 * shadow_map.texel_m  # the point's own surface may be so near
        upper_left, upper_right, lower_left, lower_right = (
            (flat_m.index_select(0, texel + step) >= limit_m).float()
            for step in (0, 1, side, side + 1)
        )
        upper = torch.lerp(upper_left, upper_right, across)
        lower = torch.lerp(lower_left, lower_right, across)
        lit = torch.where(is_inside, torch.lerp(upper, lower, down).clamp(0, 1), lit)
    return lit


_OCCLUDER_OFFSETS_PX = ((5, 2), (-2, 5), (-5, -2), (2, -5), (1, 1))
"""Columns and rows from a point on the sky's map to the texels that may hide the sky from it: one
in each direction, and a neighbour."""
_OCCLUSION_MARGIN_PX = 10
"""Distance from the border of the sky's map within which nothing is hidden: surfaces beyond it are
not known."""
_OCCLUDER_CLEARANCE_M = 0.08
"""Least height above a point from which a surface hides the sky from it: a slope does not hide its
own."""
_OCCLUSION_DECAY_PER_M = 0.25
"""The higher above the point an occluder is, the less it hides: half as much at 4 m."""
_OCCLUSION_OF_TEXEL = 0.17
"""Share of the sky that an occluder just above the point hides. Like the decay it is not measured,
but was chosen, with the other light, until streets looked like KITTI's."""


def sky_openness(sky_map: ShadowMap, points: Vectors) -> Numbers:
    """Estimate how open each point is to the sky (ambient occlusion), 1 where none is hidden.

    Five texels around the point are read on the sky's map; each that is higher hides a part.
    """
    column, row, depth_m = sky_map.project(points)
    side = len(sky_map.depth_m)
    low = _OCCLUSION_MARGIN_PX
    high = side - 1 - _OCCLUSION_MARGIN_PX
    is_inside = (column > low) & (row > low) & (column < high) & (row < high)
    texel = row.clamp(low, high).long() * side + column.clamp(low, high).long()

    top_m = sky_map.depth_m.flatten()
    hidden = torch.zeros(len(points))
    for x, y in _OCCLUDER_OFFSETS_PX:
        occluder_m = top_m.index_select(0, texel + (y * side + x))
        above_m = depth_m - occluder_m - _OCCLUDER_CLEARANCE_M
        weight = 1 / (1 + _OCCLUSION_DECAY_PER_M * above_m.clamp(min=0))
        hidden += torch.where(above_m > 0, weight, 0)
    return torch.where(is_inside, 1 - _OCCLUSION_OF_TEXEL * hidden, 1.0)
