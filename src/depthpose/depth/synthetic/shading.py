"""The light (linear RGB) from each seen point and from the sky, with shadows and paint on the road.

A stage is a scene made ready for drawing: its triangles as tensors, shadows, openness to the sky.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.render import rasterize_orthographic
from depthpose.depth.synthetic.scene import Markings, StreetScene
from depthpose.depth.synthetic.textures import MATERIALS, NUMBER, SIDE_PX, sample_texture, textures

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
    """Make a scene ready for drawing."""
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


_SPECULAR = torch.tensor([material.specular for material in MATERIALS.values()])
_TRANSLUCENCY = torch.tensor([material.translucency for material in MATERIALS.values()])
_GLOW = torch.tensor([material.glow for material in MATERIALS.values()])
_CHUNK = 1 << 17
"""Points shaded at a time, which bounds the memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hits:
    """Where rays hit triangles.

    Attributes:
        primitive: number of the triangle.
        barycentric: shares of its corners.
        points: in the left camera's frame [m].
        towards: unit vectors along the rays.
        distance_m: from the camera.
    """

    primitive: Int[Tensor, " n"]
    barycentric: Float[Tensor, "n 3"]
    points: Float[Tensor, "n 3"]
    towards: Float[Tensor, "n 3"]
    distance_m: Float[Tensor, " n"]

    def part(self, start: int, stop: int) -> "Hits":
        """Some of them."""
        names = ("primitive", "barycentric", "points", "towards", "distance_m")
        return Hits(**{name: getattr(self, name)[start:stop] for name in names})


@dataclass(frozen=True, kw_only=True, eq=False)
class _Surfaces:
    """What is known of the surface at each hit.

    ``normal`` is smooth, ``plane`` the triangle's own; both look to the camera. ``uv`` is in tiles.
    """

    material: Int[Tensor, " n"]
    albedo: Float[Tensor, "n 3"]
    normal: Float[Tensor, "n 3"]
    plane: Float[Tensor, "n 3"]


def shade(stage: Stage, hits: Hits, focal_px: float) -> Float[Tensor, "n 3"]:
    """Give the light from each hit towards the camera."""
    count = len(hits.primitive)
    parts = [
        _shade(stage, hits.part(start, start + _CHUNK), focal_px)
        for start in range(0, count, _CHUNK)
    ]
    return torch.cat(parts) if parts else torch.zeros(0, 3)


def _shade(stage: Stage, hits: Hits, focal_px: float) -> Float[Tensor, "n 3"]:
    surfaces = _surfaces(stage, hits, focal_px)
    weather = stage.scene.weather
    sun_color = torch.from_numpy(weather.sun_color).float()
    sun, lit = _sunlight(stage, hits, surfaces)
    upward = 0.5 + 0.5 * (surfaces.normal @ stage.up)
    openness = open_share(stage, hits.points + 0.05 * surfaces.plane)
    sky = torch.from_numpy(0.5 * (weather.zenith + weather.horizon)).float()
    ambient = ((0.09 + 0.26 * upward) * openness)[:, None] * sky
    # Light that the ground throws back.
    bounced = ((1 - upward) * openness * 0.045)[:, None] * sun_color
    color = surfaces.albedo * (sun[:, None] * sun_color + ambient + bounced)
    color += surfaces.albedo * (2 * _GLOW[surfaces.material])[:, None]
    _add_mirrored(stage, hits, surfaces, lit, color)
    thick = 1 - torch.exp(-hits.distance_m / weather.haze_m)
    haze = torch.from_numpy(weather.horizon).float() * 0.7
    return torch.lerp(color, haze.expand_as(color), thick[:, None])


def _surfaces(stage: Stage, hits: Hits, focal_px: float) -> _Surfaces:
    rows = stage.attributes.index_select(0, hits.primitive)
    shares = hits.barycentric
    material, layer = (
        numbers.index_select(0, hits.primitive) for numbers in (stage.material, stage.layer)
    )
    uv = _mix(rows[:, :6], shares, 2)
    plane = rows[:, 18:21]
    facing = _dot(plane, hits.towards)
    plane = torch.where(facing[:, None] > 0, -plane, plane)
    normal = _mix(rows[:, 6:15], shares, 3)
    normal = normal / _dot(normal, normal).sqrt()[:, None]
    normal = torch.where((_dot(normal, plane) < 0)[:, None], -normal, normal)
    footprint_m = hits.distance_m / focal_px
    # A compromise between the footprint's width and its length, which grows when seen aslant.
    level = torch.log2(footprint_m * rows[:, 21] * facing.abs().clamp(min=0.03) ** -0.6 + 1e-9)
    albedo = sample_texture(textures(), layer, uv, level) * rows[:, 15:18]
    albedo *= _stain(stage, hits.points)[:, None]
    is_road = (material == NUMBER["road"]).nonzero()[:, 0]
    if len(is_road):
        place_m, width_m = uv[is_road] * 3.0, footprint_m[is_road]
        length_m = width_m / facing[is_road].abs().clamp(min=0.02)
        albedo[is_road] = paint_road(stage.scene, albedo[is_road], place_m, width_m, length_m)
    return _Surfaces(material=material, albedo=albedo, normal=normal, plane=plane)


def _mix(
    values: Float[Tensor, "n triple"], shares: Float[Tensor, "n 3"], width: int
) -> Float[Tensor, "n m"]:
    a, b, c = values[:, :width], values[:, width : 2 * width], values[:, 2 * width :]
    return a * shares[:, :1] + b * shares[:, 1:2] + c * shares[:, 2:]


def _dot(one: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Written out: a sum over so short an axis would take ten times as long."""
    return one[:, 0] * other[:, 0] + one[:, 1] * other[:, 1] + one[:, 2] * other[:, 2]


def _stain(stage: Stage, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Unevenness over metres, which hides that textures repeat."""
    x, y = stage.scene.weather.shift
    u = points[:, 0] * 0.021 + points[:, 1] * 0.013 + x
    return 1 + 0.07 * _looked_up(textures().stains, u, points[:, 2] * 0.021 + y)


def _sunlight(
    stage: Stage, hits: Hits, surfaces: _Surfaces
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """The sun's light on each point, and the share of the sun that is not hidden from it."""
    slant = surfaces.normal @ stage.to_sun
    through = _TRANSLUCENCY[surfaces.material]
    faced = (surfaces.plane @ stage.to_sun > 0).float()
    light = (1 - through) * slant.clamp(min=0) * faced + through * slant.abs()
    lit = torch.ones_like(light)
    if stage.sun_maps:
        reached = (light > 0).nonzero()[:, 0]
        lit[reached] = sunlit_share(stage, hits.points[reached], surfaces.plane[reached])
    return light * lit, lit


def _add_mirrored(
    stage: Stage,
    hits: Hits,
    surfaces: _Surfaces,
    lit: Float[Tensor, " n"],
    color: Float[Tensor, "n 3"],
) -> None:
    """Mix in what glass, paint and metal mirror: the sky, a made-up skyline, the sun."""
    mirror = _SPECULAR[surfaces.material]
    some = (mirror > 0).nonzero()[:, 0]
    if not len(some):
        return
    normal, towards = surfaces.normal[some], hits.towards[some]
    aligned = _dot(towards, normal)
    mirrored = towards - 2 * aligned[:, None] * normal
    share = mirror[some] + (1 - mirror[some]) * (1 + aligned.clamp(-1, 0)) ** 5
    light = sky_light(stage, mirrored, with_sun=False)
    turn = torch.atan2(mirrored[:, 0], mirrored[:, 2])
    shift = 6.3 * stage.scene.weather.shift[0]
    skyline = 0.14 + 0.12 * torch.sin(turn * 5 + shift) + 0.07 * torch.sin(turn * 17 + 2 * shift)
    hidden = torch.sigmoid((skyline - mirrored @ stage.up) * 25)
    light *= (1 - 0.78 * hidden)[:, None]
    glint = 2 * lit[some] * (mirrored @ stage.to_sun).clamp(min=0) ** 300
    sun_color = torch.from_numpy(stage.scene.weather.sun_color).float()
    own = color[some] * (1 - share)[:, None]
    color[some] = own + share[:, None] * light + glint[:, None] * sun_color


def sky_light(
    stage: Stage, towards: Float[Tensor, "n 3"], *, with_sun: bool = True
) -> Float[Tensor, "n 3"]:
    """Give the light of the sky (and of the ground, below) from each direction."""
    weather = stage.scene.weather
    zenith, horizon, sun_color = (
        torch.from_numpy(color).float()
        for color in (weather.zenith, weather.horizon, weather.sun_color)
    )
    height = towards @ stage.up
    color = torch.lerp(horizon.expand(len(height), 3), zenith.expand(len(height), 3),
                       (height.clamp(0, 1) ** 0.33)[:, None])  # fmt: skip
    cover, is_sky = _clouds(stage, towards, height)
    lit = (horizon * 0.9 + sun_color * 0.12).expand_as(color)
    color = torch.lerp(color, lit, (0.8 * cover)[:, None])
    toward_sun = (towards @ stage.to_sun).clamp(min=0)
    glow = 0.12 * toward_sun**8 + 0.3 * toward_sun**64
    if with_sun:
        glow = glow + 4 * toward_sun**1500
    color = color + glow[:, None] * sun_color
    ground = 0.3 * (horizon + 0.25 * sun_color) * 0.5
    return torch.where(is_sky[:, None], color, ground.expand_as(color))


def _clouds(
    stage: Stage, towards: Float[Tensor, "n 3"], height: Float[Tensor, " n"]
) -> tuple[Float[Tensor, " n"], Bool[Tensor, " n"]]:
    weather = stage.scene.weather
    is_sky = height > -0.02
    far = towards / height.clamp(min=0.03)[:, None]
    u, v = far[:, 0] * 0.05 + weather.shift[0], far[:, 2] * 0.05 + weather.shift[1]
    density = _looked_up(textures().clouds, u, v)
    cover = torch.sigmoid(3 * (density - 1.4 + 2.2 * weather.cloud))
    return cover * (height * 6).clamp(0, 1), is_sky


_PATCH_M = 9.0


def paint_road(
    scene: StreetScene,
    albedo: Float[Tensor, "n 3"],
    place_m: Float[Tensor, "n 2"],
    width_m: Float[Tensor, " n"],
    length_m: Float[Tensor, " n"],
) -> Float[Tensor, "n 3"]:
    """Give the colour of the asphalt with what is painted on it, at places (x, s) of the road.

    Lines are narrower than a pixel far away, so they cover it by the share of its footprint, which
    has this width and length.
    """
    x, s = place_m.unbind(1)
    cover = _cover(scene.markings, x, s, width_m, length_m)
    wear = torch.sigmoid(3 * (_looked_up(textures().stains, x * 0.13, s * 0.13) + 1.4))
    paint = (cover * scene.markings.brightness * (0.3 + 0.7 * wear))[:, None]
    worn = albedo * _wear(scene, x, s)[:, None]
    return torch.lerp(worn, worn.new_tensor([0.8, 0.8, 0.77]).expand_as(worn), paint)


def _cover(
    markings: Markings, x: Tensor, s: Tensor, width_m: Tensor, length_m: Tensor
) -> Float[Tensor, " n"]:
    """How much of each pixel is painted."""
    cover = torch.zeros_like(x)
    for at, half, period, dash in markings.lines.tolist():
        line = _inside(x - at, half, width_m)
        if dash < period:
            line = line * _inside(s % period - period / 2, dash / 2, length_m)
        cover = torch.maximum(cover, line)
    for at, half, first, last, is_striped in markings.bars.tolist():
        bar = _inside(s - at, half, length_m)
        bar = bar * _inside(x - (first + last) / 2, (last - first) / 2, width_m)
        if is_striped:
            bar = bar * _inside(x % 1.0 - 0.5, 0.25, width_m)
        cover = torch.maximum(cover, bar)
    return cover


def _inside(off: Tensor, half: float, foot: Tensor) -> Tensor:
    """Share of a footprint that lies within ``half`` of a line."""
    foot = foot.clamp(min=1e-3)
    return ((half - off.abs()) / foot + 0.5).clamp(0, 1) * (2 * half / foot).clamp(max=1)


def _wear(scene: StreetScene, x: Tensor, s: Tensor) -> Float[Tensor, " n"]:
    """Darker where wheels roll, where it was mended, and on covers."""
    first, lane_m = scene.markings.wheel_tracks
    within = ((x - first) / lane_m) % 1
    tracks = torch.exp(-(((within - 0.25) / 0.09) ** 2)) + torch.exp(
        -(((within - 0.75) / 0.09) ** 2)
    )
    factor = 1 - 0.08 * tracks
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
    return factor * (1 - 0.35 * seam * (scene.weather.shift[1] > 0.5))


def _looked_up(field: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Values of a field of noise, which repeats, at places in tiles."""
    column, row = (u * SIDE_PX).long() % SIDE_PX, (v * SIDE_PX).long() % SIDE_PX
    return field.flatten().index_select(0, row * SIDE_PX + column)
