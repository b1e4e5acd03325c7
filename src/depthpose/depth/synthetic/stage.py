"""A scene made ready for drawing: its triangles as tensors, shadows and openness to the sky."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.render import rasterize_orthographic
from depthpose.depth.synthetic.materials import MATERIALS, NUMBER
from depthpose.depth.synthetic.scene import StreetScene
from depthpose.depth.synthetic.textures import SIDE_PX

_SUN_MAPS = ((18.0, (-3.0, 36.0), 1024), (60.0, (-5.0, 115.0), 768))
_SKY_MAP = (28.0, (-3.0, 64.0), 512)
"""Half width, reach [m] and side [px] of the maps that look along the light."""

_GROUND = ("road", "pavement", "grass", "dirt", "curb", "hills")
"""Nearly flat: it casts no shadow that is seen, and would cover these maps several times."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightMap:
    """How far along the light the first surface lies: what is beyond is in shadow.

    Attributes:
        depth_m: the map.
        rotation: from the camera's frame to that of the light.
        low: the light-frame corner of the map [m].
        pixels_per_m: scale of its columns and rows.
        texel_m: the larger of its two pixel sizes.
    """

    depth_m: Float[Tensor, "side side"]
    rotation: Float[Tensor, "3 3"]
    low: Float[Tensor, "2"]
    pixels_per_m: Float[Tensor, "2"]
    texel_m: float

    def place(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Column and row [px], and depth along the light [m]."""
        turned = points @ self.rotation.T
        pixels = (turned[:, :2] - self.low) * self.pixels_per_m
        return torch.cat([pixels, turned[:, 2:]], 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """What drawing looks up.

    Attributes:
        scene: what is drawn.
        corners: triangles in the left camera's frame [m].
        attributes: a row a triangle: uv (6), normals (9), tint (3), plane normal (3) and texels a
            metre (1).
        material: number of the material.
        layer: number of the texture.
        kind: equal where no edge shows between two triangles: same thing, same material.
        to_sun: unit vector towards the sun, in the camera's frame.
        up: the same towards the sky.
        sun_maps: near and far shadows; none under clouds.
        sky_map: what lies above.
    """

    scene: StreetScene
    corners: Float[Tensor, "n 3 3"]
    attributes: Float[Tensor, "n 22"]
    material: Int[Tensor, " n"]
    layer: Int[Tensor, " n"]
    kind: Int[Tensor, " n"]
    to_sun: Float[Tensor, "3"]
    up: Float[Tensor, "3"]
    sun_maps: list[LightMap]
    sky_map: LightMap


def prepare(scene: StreetScene, pixels: int = 1242 * 375) -> Stage:
    """Make a scene ready for drawing.

    Args:
        scene: what will be drawn.
        pixels: how many the pictures will have: small ones need no fine shadows.
    """
    share = float(np.clip((pixels / (1242 * 375)) ** (1 / 3), 0.4, 1))
    mesh = scene.mesh
    corners = torch.from_numpy(mesh.corners)
    turn = torch.from_numpy(scene.camera_from_world).float()
    to_sun = turn @ torch.from_numpy(scene.weather.sun).float()
    up = turn @ torch.tensor([0.0, -1, 0])
    material = torch.from_numpy(mesh.material.astype(np.int64))
    hides = torch.ones(len(MATERIALS), dtype=torch.bool)
    hides[[NUMBER[name] for name in _GROUND]] = False
    casters = corners[hides[material]]
    maps = () if scene.weather.is_overcast else _SUN_MAPS
    return Stage(
        scene=scene,
        corners=corners,
        attributes=_attributes(scene, corners),
        material=material,
        layer=torch.from_numpy(mesh.layer.astype(np.int64)),
        kind=torch.from_numpy(mesh.thing.astype(np.int64)) * len(MATERIALS) + material,
        to_sun=to_sun,
        up=up,
        sun_maps=[_light_map(casters, to_sun, one, share) for one in maps],
        sky_map=_light_map(casters, up, _SKY_MAP, share),
    )


def _attributes(scene: StreetScene, corners: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 22"]:
    uv = torch.from_numpy(scene.mesh.uv)
    side, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = torch.linalg.cross(side, other)
    area = across.norm(dim=1)
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    tiles = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).abs()
    texels_per_m = (tiles / area.clamp(min=1e-12)).sqrt().clamp(1e-4, 50) * SIDE_PX
    normals, tint = torch.from_numpy(scene.mesh.normals), torch.from_numpy(scene.mesh.tint)
    plane = F.normalize(across, dim=1)
    return torch.cat([uv.flatten(1), normals.flatten(1), tint, plane, texels_per_m[:, None]], 1)


def _light_map(
    corners: Float[Tensor, "n 3 3"],
    to_light: Float[Tensor, "3"],
    region: tuple[float, tuple[float, float], int],
    share: float,
) -> LightMap:
    """Draw the depth along a light over a part of the scene before the camera."""
    half_m, reach_m, full_px = region
    side_px = round(full_px * share)
    away = F.normalize(-to_light, dim=0)
    aside = torch.tensor([1.0, 0, 0]) if abs(float(away[0])) < 0.9 else torch.tensor([0.0, 0, 1])
    x = F.normalize(torch.linalg.cross(aside, away), dim=0)
    rotation = torch.stack([x, torch.linalg.cross(away, x), away])
    box = torch.tensor([[a, b, c] for a in (-half_m, half_m) for b in (1.7, -3) for c in reach_m])
    within = (box @ rotation.T)[:, :2]
    low, high = within.amin(0), within.amax(0)
    scale = (side_px - 1) / (high - low)
    turned = corners @ rotation.T
    placed = torch.cat([(turned[..., :2] - low) * scale, turned[..., 2:]], -1)
    drawn = rasterize_orthographic(placed, side_px, side_px, with_barycentric=False)
    return LightMap(
        depth_m=drawn.depth_m.nan_to_num(nan=1e6),
        rotation=rotation,
        low=low,
        pixels_per_m=scale,
        texel_m=float(1 / scale.min()),
    )


def sunlit_share(
    stage: Stage, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
) -> Float[Tensor, " n"]:
    """How much of the sun reaches each point: 0 in shadow, 1 lit, soft over a texel."""
    lit = torch.ones(len(points))
    # From the far map to the near one, which is finer and has the last word.
    for light in reversed(stage.sun_maps):
        share, is_inside = _share_before(light, points, normals)
        lit = torch.where(is_inside, share, lit)
    return lit


def _share_before(
    light: LightMap, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, " n"], Bool[Tensor, " n"]]:
    # Lifted off the surface, or its own texels would shade it in stripes.
    placed = light.place(points + normals * (2 * light.texel_m))
    side = len(light.depth_m)
    column, row = placed[:, 0], placed[:, 1]
    is_inside = (column > 1) & (row > 1) & (column < side - 3) & (row < side - 3)
    left, top = column.floor().clamp(1, side - 3), row.floor().clamp(1, side - 3)
    across, down = column - left, row - top
    start = top.long() * side + left.long()
    flat = light.depth_m.flatten()
    limit = placed[:, 2] - 0.8 * light.texel_m
    a, b, c, d = (
        (flat.index_select(0, start + step) >= limit).float() for step in (0, 1, side, side + 1)
    )
    upper, lower = torch.lerp(a, b, across), torch.lerp(c, d, across)
    return torch.lerp(upper, lower, down).clamp(0, 1), is_inside


def open_share(stage: Stage, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """How open each point is to the sky above, from a few places around it."""
    light = stage.sky_map
    placed = light.place(points)
    side = len(light.depth_m)
    column, row = placed[:, 0], placed[:, 1]
    is_inside = (column > 10) & (row > 10) & (column < side - 11) & (row < side - 11)
    start = row.clamp(10, side - 11).long() * side + column.clamp(10, side - 11).long()
    flat = light.depth_m.flatten()
    hidden = torch.zeros(len(points))
    for x, y in ((5, 2), (-2, 5), (-5, -2), (2, -5), (1, 1)):
        above_m = placed[:, 2] - flat.index_select(0, start + (y * side + x)) - 0.08
        hidden += torch.where(above_m > 0, 1 / (1 + 0.25 * above_m.clamp(min=0)), 0)
    return torch.where(is_inside, 1 - 0.17 * hidden, 1.0)
