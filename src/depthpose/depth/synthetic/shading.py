"""Light (linear RGB) of visible points and of the sky, with shadows and the markings of the road.

A stage is a scene prepared for drawing: its triangles as tensors, and its shadow maps.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.render import rasterize_orthographic
from depthpose.depth.synthetic import mesh as surfaces
from depthpose.depth.synthetic.mesh import MATERIALS, NUMBER, SIDE_PX, Indices, Numbers, Vectors
from depthpose.depth.synthetic.scene import StreetScene

_SUN_MAPS = ((18.0, (-3.0, 36.0), 1024), (60.0, (-5.0, 115.0), 768))
_SKY_MAP = (28.0, (-3.0, 64.0), 512)
"""Half width, range ahead [m] and side [px] of the shadow maps of sun and sky."""

_GROUND = ("road", "pavement", "grass", "dirt", "curb", "hills")
"""Nearly flat materials: they cast no visible shadow, and would cover the shadow maps several
times."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightMap:
    """A shadow map: depth of the first surface along a light; points beyond it are in shadow."""

    depth_m: Float[Tensor, "side side"]
    rotation: Float[Tensor, "3 3"]  # rotation from the camera's frame to that of the light
    low: Float[Tensor, "2"]  # the light-frame corner of the map [m]
    pixels_per_m: Float[Tensor, "2"]  # scale of its columns and rows
    texel_m: float  # the larger of its two pixel sizes

    def place(self, points: Vectors) -> tuple[Tensor, Tensor, Tensor]:
        """Project points to the map: column and row [px], and depth along the light [m]."""
        rotated = points @ self.rotation.T
        column, row = ((rotated[:, :2] - self.low) * self.pixels_per_m).unbind(1)
        return column, row, rotated[:, 2]


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """A scene prepared for drawing; vectors are unit vectors in the left camera's frame."""

    scene: StreetScene
    corners: Float[Tensor, "n 3 3"]  # triangles in the left camera's frame [m]
    # For each triangle: uv (6), normals (9), tint (3), plane normal (3), texels per metre (1).
    attributes: Float[Tensor, "n 22"]
    material: Indices  # number of the material
    layer: Indices  # number of the texture
    kind: Indices  # equal where there is no visible edge: same object, same material
    to_sun: Float[Tensor, "3"]
    up: Float[Tensor, "3"]  # towards the sky
    sun_maps: list[LightMap]  # near and far shadow maps; none under clouds
    sky_map: LightMap  # surfaces above each point


def prepare(scene: StreetScene, pixels: int = 1242 * 375) -> Stage:
    """Prepare a scene for drawing; shadow maps are finer for pictures of more pixels."""
    size_share = float(np.clip((pixels / (1242 * 375)) ** (1 / 3), 0.4, 1))
    mesh = scene.mesh
    corners = torch.from_numpy(mesh.corners)
    material = torch.from_numpy(mesh.material.astype(np.int64))

    # Attributes of the triangles; texels per metre from areas in the texture and in space.
    uv = torch.from_numpy(mesh.uv)
    normal_m2 = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    a = uv[:, 1] - uv[:, 0]
    b = uv[:, 2] - uv[:, 0]
    uv_area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).abs()
    tiles_per_m = (uv_area / normal_m2.norm(dim=1).clamp(min=1e-12)).sqrt().clamp(1e-4, 50)
    normals = torch.from_numpy(mesh.normals)
    tint = torch.from_numpy(mesh.tint)
    plane_normal = F.normalize(normal_m2, dim=1)
    texels_per_m = (tiles_per_m * SIDE_PX)[:, None]
    attributes = [uv.flatten(1), normals.flatten(1), tint, plane_normal, texels_per_m]

    # Shadow maps of all but the ground.
    rotation = torch.from_numpy(scene.camera_from_world).float()
    to_sun = rotation @ torch.from_numpy(scene.weather.sun).float()
    up = rotation @ torch.tensor([0.0, -1, 0])
    casts_shadow = torch.ones(len(MATERIALS), dtype=torch.bool)
    casts_shadow[[NUMBER[name] for name in _GROUND]] = False
    casters = corners[casts_shadow[material]]
    sun_maps = () if scene.weather.is_overcast else _SUN_MAPS
    return Stage(
        scene=scene,
        corners=corners,
        attributes=torch.cat(attributes, 1),
        material=material,
        layer=torch.from_numpy(mesh.layer.astype(np.int64)),
        kind=torch.from_numpy(mesh.thing.astype(np.int64)) * len(MATERIALS) + material,
        to_sun=to_sun,
        up=up,
        sun_maps=[_draw_light_map(casters, to_sun, *sun_map, size_share) for sun_map in sun_maps],
        sky_map=_draw_light_map(casters, up, *_SKY_MAP, size_share),
    )


def _draw_light_map(
    corners: Float[Tensor, "n 3 3"],
    to_light: Float[Tensor, "3"],
    half_m: float,
    reach_m: tuple[float, float],
    full_px: int,
    share: float,
) -> LightMap:
    """Draw a shadow map: the depth along a light, over a part of the scene before the camera.

    Args:
        corners: corners of the triangles that cast shadows [m].
        to_light: direction to the light.
        half_m: extent of that part to the left and to the right.
        reach_m: its nearest and farthest distance ahead.
        full_px: side of the map at full size.
        share: share of the full size.
    """
    side_px = round(full_px * share)
    away = F.normalize(-to_light, dim=0)
    aside = torch.tensor([1.0, 0, 0]) if abs(float(away[0])) < 0.9 else torch.tensor([0.0, 0, 1])
    x = F.normalize(torch.linalg.cross(aside, away), dim=0)
    rotation = torch.stack([x, torch.linalg.cross(away, x), away])

    # The box about that part, from the ground to 3 m above the camera, fills the map.
    box = torch.tensor([[x, y, z] for x in (-half_m, half_m) for y in (1.7, -3) for z in reach_m])
    box_in_map = (box @ rotation.T)[:, :2]
    low = box_in_map.amin(0)
    high = box_in_map.amax(0)
    scale = (side_px - 1) / (high - low)
    rotated = corners @ rotation.T
    placed = torch.cat([(rotated[..., :2] - low) * scale, rotated[..., 2:]], -1)
    drawn = rasterize_orthographic(placed, side_px, side_px, with_barycentric=False)
    return LightMap(
        depth_m=drawn.depth_m.nan_to_num(nan=1e6),
        rotation=rotation,
        low=low,
        pixels_per_m=scale,
        texel_m=float(1 / scale.min()),
    )


def _sunlit_share(stage: Stage, points: Vectors, normals: Vectors) -> Numbers:
    """Give the share of the sun that reaches each point: 0 in shadow, 1 lit, soft over a texel."""
    lit = torch.ones(len(points))
    # From the far map to the near one, which is finer and replaces it.
    for light in reversed(stage.sun_maps):
        # Points are lifted off their surface, or it would shade itself in stripes.
        column, row, depth_m = light.place(points + normals * (2 * light.texel_m))
        side = len(light.depth_m)
        is_inside = (column > 1) & (row > 1) & (column < side - 3) & (row < side - 3)
        left = column.floor().clamp(1, side - 3)
        top = row.floor().clamp(1, side - 3)
        across = column - left
        down = row - top
        start = top.long() * side + left.long()
        flat = light.depth_m.flatten()
        limit = depth_m - 0.8 * light.texel_m
        upper_left, upper_right, lower_left, lower_right = (
            (flat.index_select(0, start + step) >= limit).float() for step in (0, 1, side, side + 1)
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


def _sky_openness(sky_map: LightMap, points: Vectors) -> Numbers:
    """Estimate how open each point is to the sky (ambient occlusion), 1 where none is hidden.

    Of five texels around a point on the sky's map, each that is higher hides a part of the sky.
    """
    column, row, depth_m = sky_map.place(points)
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


_SPECULAR, _TRANSLUCENCY, _GLOW = torch.tensor(
    [(m.specular, m.translucency, m.glow) for m in MATERIALS.values()]
).T
_CHUNK = 1 << 17
"""Points shaded at a time, which bounds the memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hits:
    """Points where rays hit triangles."""

    primitive: Indices  # number of the triangle
    barycentric: Vectors  # shares of its corners
    points: Vectors  # in the left camera's frame [m]
    towards: Vectors  # unit vectors along the rays
    distance_m: Numbers  # from the camera


def shade(stage: Stage, hits: Hits, focal_px: float) -> Vectors:
    """Give the light from each hit towards the camera, as :func:`_shade` does, in chunks."""
    names = vars(hits)
    chunks = zip(*(values.split(_CHUNK) for values in names.values()), strict=True)
    return torch.cat(
        [_shade(stage, Hits(**dict(zip(names, chunk, strict=True))), focal_px) for chunk in chunks]
    )


def _shade(stage: Stage, hits: Hits, focal_px: float) -> Vectors:
    """Give the linear RGB from each hit towards the camera: sun, sky, reflections and haze."""
    rows = stage.attributes.index_select(0, hits.primitive)
    material = stage.material.index_select(0, hits.primitive)
    layer = stage.layer.index_select(0, hits.primitive)

    # The normal of the triangle's plane, and the interpolated one; both face the camera.
    plane = rows[:, 18:21]
    facing = _dot(plane, hits.towards)
    plane = torch.where(facing[:, None] > 0, -plane, plane)
    first, second, third = hits.barycentric.split(1, 1)
    uv, normal = (
        a * first + b * second + c * third
        for a, b, c in (rows[:, :6].chunk(3, 1), rows[:, 6:15].chunk(3, 1))
    )
    normal = normal / _dot(normal, normal).sqrt()[:, None]
    normal = torch.where((_dot(normal, plane) < 0)[:, None], -normal, normal)

    # The colour by texture. Its level is a compromise between the pixel footprint's width and its
    # length, which grows with the slant.
    footprint_m = hits.distance_m / focal_px
    level = torch.log2(footprint_m * rows[:, 21] * facing.abs().clamp(min=0.03) ** -0.6 + 1e-9)
    albedo = surfaces.sample_texture(surfaces.textures(), layer, uv, level) * rows[:, 15:18]

    # Stains over metres hide that textures repeat.
    weather = stage.scene.weather
    points = hits.points
    u = points[:, 0] * 0.021 + points[:, 1] * 0.013 + weather.shift[0]
    stains = _look_up(surfaces.textures().stains, u, points[:, 2] * 0.021 + weather.shift[1])
    albedo *= (1 + 0.07 * stains)[:, None]

    is_road = (material == NUMBER["road"]).nonzero()[:, 0]
    if len(is_road):
        place_m = uv[is_road] * 3.0
        width_m = footprint_m[is_road]
        length_m = width_m / facing[is_road].abs().clamp(min=0.02)
        albedo[is_road] = _paint_road(stage.scene, albedo[is_road], place_m, width_m, length_m)

    # Light of the sun, where it is not in shadow; leaves let some through.
    slant = normal @ stage.to_sun
    through = _TRANSLUCENCY[material]
    faced = (plane @ stage.to_sun > 0).float()
    sun = (1 - through) * slant.clamp(min=0) * faced + through * slant.abs()
    lit = torch.ones_like(sun)
    if stage.sun_maps:
        reached = (sun > 0).nonzero()[:, 0]
        lit[reached] = _sunlit_share(stage, points[reached], plane[reached])
    sun_color = torch.from_numpy(weather.sun_color).float()

    # Light of the sky, as far as it is not occluded.
    upward = 0.5 + 0.5 * (normal @ stage.up)
    openness = _sky_openness(stage.sky_map, points + 0.05 * plane)
    sky = torch.from_numpy(0.5 * (weather.zenith + weather.horizon)).float()
    ambient = ((0.09 + 0.26 * upward) * openness)[:, None] * sky
    # Light that the ground reflects.
    bounced = ((1 - upward) * openness * 0.045)[:, None] * sun_color
    color = albedo * ((sun * lit)[:, None] * sun_color + ambient + bounced)
    color += albedo * (2 * _GLOW[material])[:, None]
    _add_reflections(stage, hits.towards, normal, _SPECULAR[material], lit, color)

    haze_share = 1 - torch.exp(-hits.distance_m / weather.haze_m)
    haze = torch.from_numpy(weather.horizon).float() * 0.7
    return torch.lerp(color, haze.expand_as(color), haze_share[:, None])


def _dot(a: Vectors, b: Vectors) -> Numbers:
    """Give the dot product of each row; a sum over so short an axis takes ten times as long."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _add_reflections(
    stage: Stage, towards: Vectors, normal: Vectors, mirror: Numbers, lit: Numbers, color: Vectors
) -> None:
    """Add the reflections in glass, paint and metal to ``color``: sky, a skyline and the sun.

    Args:
        stage: the scene.
        towards: unit vectors along the rays.
        normal: unit normals of the surfaces.
        mirror: reflectance at normal incidence.
        lit: share of the sun that reaches the points.
        color: linear RGB, which is changed in place.
    """
    glossy = (mirror > 0).nonzero()[:, 0]
    if not len(glossy):
        return
    normal = normal[glossy]
    towards = towards[glossy]
    mirror = mirror[glossy]
    aligned = _dot(towards, normal)
    mirrored = towards - 2 * aligned[:, None] * normal
    share = mirror + (1 - mirror) * (1 + aligned.clamp(-1, 0)) ** 5  # Schlick's approximation
    light = sky_light(stage, mirrored, with_sun=False)
    turn = torch.atan2(mirrored[:, 0], mirrored[:, 2])
    shift = 6.3 * stage.scene.weather.shift[0]
    skyline = 0.14 + 0.12 * torch.sin(turn * 5 + shift) + 0.07 * torch.sin(turn * 17 + 2 * shift)
    hidden = torch.sigmoid((skyline - mirrored @ stage.up) * 25)
    light *= (1 - 0.78 * hidden)[:, None]
    glint = 2 * lit[glossy] * (mirrored @ stage.to_sun).clamp(min=0) ** 300
    sun_color = torch.from_numpy(stage.scene.weather.sun_color).float()
    diffuse = color[glossy] * (1 - share)[:, None]
    color[glossy] = diffuse + share[:, None] * light + glint[:, None] * sun_color


def sky_light(stage: Stage, towards: Vectors, *, with_sun: bool = True) -> Vectors:
    """Give the linear RGB of the sky, or below the horizon of the ground, in each direction.

    ``towards``: unit vectors away from the camera. ``with_sun``: the sun's disc too.
    """
    weather = stage.scene.weather
    height = towards @ stage.up
    zenith, horizon, sun_color = (
        torch.from_numpy(color).float()
        for color in (weather.zenith, weather.horizon, weather.sun_color)
    )
    share = (height.clamp(0, 1) ** 0.33)[:, None]
    color = torch.lerp(horizon.expand(len(height), 3), zenith.expand(len(height), 3), share)
    far = towards / height.clamp(min=0.03)[:, None]
    u = far[:, 0] * 0.05 + weather.shift[0]
    v = far[:, 2] * 0.05 + weather.shift[1]
    density = _look_up(surfaces.textures().clouds, u, v)
    cover = torch.sigmoid(3 * (density - 1.4 + 2.2 * weather.cloud)) * (height * 6).clamp(0, 1)
    lit = (horizon * 0.9 + sun_color * 0.12).expand_as(color)
    color = torch.lerp(color, lit, (0.8 * cover)[:, None])
    toward_sun = (towards @ stage.to_sun).clamp(min=0)
    glow = 0.12 * toward_sun**8 + 0.3 * toward_sun**64
    if with_sun:
        glow = glow + 4 * toward_sun**1500
    color = color + glow[:, None] * sun_color
    ground = 0.3 * (horizon + 0.25 * sun_color) * 0.5
    return torch.where((height > -0.02)[:, None], color, ground.expand_as(color))


_PATCH_M = 9.0
"""Length of the stretches of road, of which each may have a patch or a manhole."""


def _paint_road(
    scene: StreetScene,
    albedo: Vectors,
    place_m: Float[Tensor, "n 2"],
    width_m: Numbers,
    length_m: Numbers,
) -> Vectors:
    """Add markings, wheel tracks, patches and seams to the colour of the asphalt.

    Args:
        scene: the street.
        albedo: albedo of the asphalt.
        place_m: coordinates (x, s) on the road.
        width_m: width of the pixels' footprints.
        length_m: their length along the road.
    """
    x, s = place_m.unbind(1)

    # Lines along the road and bars across it, each as a share of the pixel's footprint: far ones
    # are narrower than a pixel.
    cover = torch.zeros_like(x)
    for at, half, period, dash in scene.markings.lines.tolist():
        line = _covered_share(x - at, half, width_m)
        if dash < period:
            line = line * _covered_share(s % period - period / 2, dash / 2, length_m)
        cover = torch.maximum(cover, line)
    for at, half, first, last, is_striped in scene.markings.bars.tolist():
        bar = _covered_share(s - at, half, length_m)
        bar = bar * _covered_share(x - (first + last) / 2, (last - first) / 2, width_m)
        if is_striped:
            bar = bar * _covered_share(x % 1.0 - 0.5, 0.25, width_m)
        cover = torch.maximum(cover, bar)
    wear = torch.sigmoid(3 * (_look_up(surfaces.textures().stains, x * 0.13, s * 0.13) + 1.4))
    paint = (cover * scene.markings.brightness * (0.3 + 0.7 * wear))[:, None]

    # Wheels darken two tracks in each lane.
    first, lane_m = scene.markings.wheel_tracks
    within = ((x - first) / lane_m) % 1
    left, right = (torch.exp(-(((within - at) / 0.09) ** 2)) for at in (0.25, 0.75))
    factor = 1 - 0.08 * (left + right)

    # In some stretches a patch of new asphalt, or the cover of a manhole.
    cell = torch.floor(s / _PATCH_M)
    chance = torch.sin(cell * 12.9898 + 97 * scene.weather.shift[0]) * 43758.5453
    chance = chance - chance.floor()
    along = s - cell * _PATCH_M
    middle = first + chance * 2 * lane_m
    is_patch = ((x - middle).abs() < 0.5 + chance) & ((along - 4).abs() < 1 + 2.5 * chance)
    factor = torch.where(is_patch & (chance > 0.6), factor * (0.45 + 0.45 * chance), factor)
    is_cover = ((x - middle) ** 2 + (along - 2) ** 2 < 0.1) & (chance < 0.35)
    factor = torch.where(is_cover, factor * 0.5, factor)

    # Tar in the seams between lanes.
    seam = torch.exp(-(((within - 0.02 - 0.015 * torch.sin(s * 0.7)) / 0.012) ** 2))
    worn = albedo * (factor * (1 - 0.35 * seam * (scene.weather.shift[1] > 0.5)))[:, None]
    return torch.lerp(worn, worn.new_tensor([0.8, 0.8, 0.77]).expand_as(worn), paint)


def _covered_share(off: Tensor, half: float, foot: Tensor) -> Tensor:
    """Give the share of a footprint of size ``foot`` that lies within ``half`` of a line.

    ``off``: distance of the footprint's centre from the line.
    """
    foot = foot.clamp(min=1e-3)
    return ((half - off.abs()) / foot + 0.5).clamp(0, 1) * (2 * half / foot).clamp(max=1)


def _look_up(field: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Look up a repeating field of noise at places that are counted in tiles."""
    column = (u * SIDE_PX).long() % SIDE_PX
    row = (v * SIDE_PX).long() % SIDE_PX
    return field.flatten().index_select(0, row * SIDE_PX + column)
