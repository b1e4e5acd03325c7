"""The light that comes from a seen point, and from the sky: linear RGB."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from depthpose.depth.synthetic.materials import MATERIALS, NUMBER
from depthpose.depth.synthetic.paint import paint_road
from depthpose.depth.synthetic.stage import Stage, open_share, sunlit_share
from depthpose.depth.synthetic.textures import SIDE_PX, sample_texture, textures

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
        foot = (footprint_m[is_road], facing[is_road].abs())
        albedo[is_road] = paint_road(stage.scene, albedo[is_road], uv[is_road] * 3.0, foot)
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
    field, (x, y) = textures().stains, stage.scene.weather.shift
    column = ((points[:, 0] * 0.021 + points[:, 1] * 0.013 + x) * SIDE_PX).long() % SIDE_PX
    row = ((points[:, 2] * 0.021 + y) * SIDE_PX).long() % SIDE_PX
    return 1 + 0.07 * field.flatten().index_select(0, row * SIDE_PX + column)


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
    column = ((far[:, 0] * 0.05 + weather.shift[0]) * SIDE_PX).long() % SIDE_PX
    row = ((far[:, 2] * 0.05 + weather.shift[1]) * SIDE_PX).long() % SIDE_PX
    density = textures().clouds.flatten().index_select(0, row * SIDE_PX + column)
    cover = torch.sigmoid(3 * (density - 1.4 + 2.2 * weather.cloud))
    return cover * (height * 6).clamp(0, 1), is_sky
