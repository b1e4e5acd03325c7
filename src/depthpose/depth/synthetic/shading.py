"""Light (linear RGB) of visible points and of the sky.

A stage is a scene prepared for rendering: its triangles as tensors, and its shadow maps.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.depth.synthetic.materials import MATERIAL_IDS, MATERIALS
from depthpose.depth.synthetic.mesh import Mesh
from depthpose.depth.synthetic.road_paint import ROAD_TILE_M, paint_road
from depthpose.depth.synthetic.scene import SyntheticScene
from depthpose.depth.synthetic.shadows import (
    SKY_AREA,
    SUN_AREAS,
    ShadowMap,
    render_shadow_map,
    sky_openness,
    sunlit_share,
)
from depthpose.depth.synthetic.textures import (
    SIDE_PX,
    Indices,
    Numbers,
    Vectors,
    look_up_noise,
    make_textures,
    sample_texture,
)

_FULL_PIXELS = 1242 * 375
"""Size of KITTI's images, at which shadow maps have their full size."""

_GROUND = ("road", "pavement", "grass", "dirt", "curb", "hills")
"""Nearly flat materials: they cast no visible shadow, and would cover the shadow maps several
times."""


_UV = slice(0, 6)
_NORMALS = slice(6, 15)
TINT = slice(15, 18)
PLANE_NORMAL = slice(18, 21)
_TEXELS_PER_M = 21
"""Columns of the attributes of a triangle. They are one tensor, for one look-up is faster."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """A scene prepared for rendering; vectors are unit vectors in the left camera's frame."""

    scene: SyntheticScene
    corners: Float[Tensor, "n 3 3"]  # triangles in the left camera's frame [m]
    # For each triangle: uv (6), normals (9), tint (3), plane normal (3), texels per metre (1).
    attributes: Float[Tensor, "n 22"]
    material: Indices  # number of the material
    layer: Indices  # number of the texture
    surface_id: Indices  # equal where there is no visible edge: same object, same material
    to_sun: Float[Tensor, "3"]
    up: Float[Tensor, "3"]  # towards the sky
    sun_maps: list[ShadowMap]  # near and far shadow maps; none under clouds
    sky_map: ShadowMap  # surfaces above each point


def prepare_stage(scene: SyntheticScene, pixels: int = _FULL_PIXELS) -> Stage:
    """Prepare a scene for rendering; shadow maps are finer for pictures of more pixels."""
    corners = torch.from_numpy(scene.mesh.corners)
    material = torch.from_numpy(scene.mesh.material.astype(np.int64))
    object_id = torch.from_numpy(scene.mesh.object_id.astype(np.int64))

    rotation = torch.from_numpy(scene.camera_from_world).float()
    to_sun = rotation @ torch.from_numpy(scene.weather.sun).float()
    up = rotation @ torch.tensor([0.0, -1, 0])

    # Shadow maps of all but the ground.
    casts_shadow = torch.ones(len(MATERIALS), dtype=torch.bool)
    casts_shadow[[MATERIAL_IDS[name] for name in _GROUND]] = False
    casters = corners[casts_shadow[material]]
    size_share = float(np.clip((pixels / _FULL_PIXELS) ** (1 / 3), 0.4, 1))
    sun_areas = () if scene.weather.is_overcast else SUN_AREAS
    return Stage(
        scene=scene,
        corners=corners,
        attributes=_collect_attributes(scene.mesh),
        material=material,
        layer=torch.from_numpy(scene.mesh.layer.astype(np.int64)),
        surface_id=object_id * len(MATERIALS) + material,
        to_sun=to_sun,
        up=up,
        sun_maps=[render_shadow_map(casters, to_sun, area, size_share) for area in sun_areas],
        sky_map=render_shadow_map(casters, up, SKY_AREA, size_share),
    )


def _collect_attributes(mesh: Mesh) -> Float[Tensor, "n 22"]:
    """Collect the attributes of a mesh's triangles; see :class:`Stage`."""
    corners = torch.from_numpy(mesh.corners)
    uv = torch.from_numpy(mesh.uv)
    normals = torch.from_numpy(mesh.normals)
    tint = torch.from_numpy(mesh.tint)
    cross_m2 = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    plane_normal = F.normalize(cross_m2, dim=1)

    # Texels per metre: the root of twice the triangle's area in the texture over that in space.
    a = uv[:, 1] - uv[:, 0]
    b = uv[:, 2] - uv[:, 0]
    area_tiles = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).abs()
    area_m2 = cross_m2.norm(dim=1).clamp(min=1e-12)
    tiles_per_m = (area_tiles / area_m2).sqrt().clamp(1e-4, 50)
    texels_per_m = (tiles_per_m * SIDE_PX)[:, None]
    attributes = [uv.flatten(1), normals.flatten(1), tint, plane_normal, texels_per_m]
    return torch.cat(attributes, 1)


_SPECULAR, _TRANSLUCENCY, _GLOW = torch.tensor(
    [(m.specular, m.translucency, m.glow) for m in MATERIALS.values()]
).T
"""Properties of the materials by their numbers."""
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
    """Compute the linear RGB from each hit towards the camera, in chunks of bounded memory.

    ``focal_px``: focal length of the camera, by which the textures' level of detail is chosen.
    """
    lights: list[Vectors] = []
    for start in range(0, max(len(hits.primitive), 1), _CHUNK):
        chunk = {
            field.name: getattr(hits, field.name)[start : start + _CHUNK] for field in fields(Hits)
        }
        lights.append(_shade(stage, Hits(**chunk), focal_px))
    return torch.cat(lights)


def _shade(stage: Stage, hits: Hits, focal_px: float) -> Vectors:
    """Compute the linear RGB from each hit towards the camera: sun, sky, reflections and haze."""
    weather = stage.scene.weather
    rows = stage.attributes.index_select(0, hits.primitive)
    material = stage.material.index_select(0, hits.primitive)

    # The normal of the triangle's plane, and the interpolated one; both face the camera.
    plane = rows[:, PLANE_NORMAL]
    facing = _dot(plane, hits.towards)
    plane = torch.where(facing[:, None] > 0, -plane, plane)
    normal = _interpolate(rows[:, _NORMALS], hits.barycentric)
    normal = normal / _dot(normal, normal).sqrt()[:, None]
    normal = torch.where((_dot(normal, plane) < 0)[:, None], -normal, normal)

    albedo = _compute_albedo(stage, hits, rows, facing.abs(), focal_px)

    # Light of the sun, where it is not in shadow; leaves let some through.
    sun_slant = normal @ stage.to_sun
    through = _TRANSLUCENCY[material]
    faces_sun = (plane @ stage.to_sun > 0).float()
    sun = (1 - through) * sun_slant.clamp(min=0) * faces_sun + through * sun_slant.abs()
    lit = torch.ones_like(sun)
    if stage.sun_maps:
        reached = (sun > 0).nonzero()[:, 0]
        lit[reached] = sunlit_share(stage.sun_maps, hits.points[reached], plane[reached])
    sun_color = torch.from_numpy(weather.sun_color).float()

    # Light of the sky, as far as it is not occluded, and light that the ground reflects.
    upward = 0.5 + 0.5 * (normal @ stage.up)
    openness = sky_openness(stage.sky_map, hits.points + 0.05 * plane)
    sky_color = torch.from_numpy(0.5 * (weather.zenith + weather.horizon)).float()
    ambient = ((0.09 + 0.26 * upward) * openness)[:, None] * sky_color
    bounced = ((1 - upward) * openness * 0.045)[:, None] * sun_color

    # What the surface reflects, and the glow of lamps. The factors of all light were chosen until
    # streets looked like KITTI's.
    color = albedo * ((sun * lit)[:, None] * sun_color + ambient + bounced)
    color += albedo * (2 * _GLOW[material])[:, None]
    _add_reflections(stage, hits.towards, normal, _SPECULAR[material], lit, color)

    haze_share = 1 - torch.exp(-hits.distance_m / weather.haze_m)
    haze_color = torch.from_numpy(weather.horizon).float() * 0.7
    return torch.lerp(color, haze_color.expand_as(color), haze_share[:, None])


_STAIN_TILES_PER_M = 0.021
"""Tiles of the field of stains per metre along x and z."""


def _compute_albedo(
    stage: Stage, hits: Hits, rows: Float[Tensor, "n 22"], facing: Numbers, focal_px: float
) -> Vectors:
    """Compute the share of the light that each surface reflects diffusely, by channel.

    Args:
        stage: the scene.
        hits: the points.
        rows: attributes of their triangles.
        facing: cosines of the angles between the rays and the planes' normals, 0 to 1.
        focal_px: focal length of the camera.
    """
    # The texture's level is a compromise between the width of a pixel's footprint and its length,
    # which grows with the slant.
    textures = make_textures()
    layer = stage.layer.index_select(0, hits.primitive)
    uv = _interpolate(rows[:, _UV], hits.barycentric)
    footprint_m = hits.distance_m / focal_px
    lengthening = facing.clamp(min=0.03) ** -0.6
    level = torch.log2(footprint_m * rows[:, _TEXELS_PER_M] * lengthening + 1e-9)
    albedo = sample_texture(textures, layer, uv, level) * rows[:, TINT]

    # Stains over metres hide that textures repeat.
    x, y, z = hits.points.unbind(1)
    shift_u, shift_v = stage.scene.weather.shift
    u = x * _STAIN_TILES_PER_M + y * 0.013 + shift_u
    v = z * _STAIN_TILES_PER_M + shift_v
    albedo *= (1 + 0.07 * look_up_noise(textures.stains, u, v))[:, None]

    material = stage.material.index_select(0, hits.primitive)
    on_road = (material == MATERIAL_IDS["road"]).nonzero()[:, 0]
    if len(on_road):
        place_m = uv[on_road] * ROAD_TILE_M
        width_m = footprint_m[on_road]
        length_m = width_m / facing[on_road].clamp(min=0.02)
        albedo[on_road] = paint_road(stage.scene, albedo[on_road], place_m, width_m, length_m)
    return albedo


def _interpolate(values: Float[Tensor, "n _"], shares: Vectors) -> Float[Tensor, "n _"]:
    """Interpolate values at the three corners of triangles, one after the other in each row.

    ``shares``: barycentric coordinates.
    """
    a, b, c = values.chunk(3, 1)
    first, second, third = shares.split(1, 1)
    return a * first + b * second + c * third


def _dot(a: Vectors, b: Vectors) -> Numbers:
    """Compute the dot product of each row; a sum over so short an axis takes ten times as long."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _add_reflections(
    stage: Stage,
    towards: Vectors,
    normal: Vectors,
    specular: Numbers,
    lit: Numbers,
    color: Vectors,
) -> None:
    """Add the reflections in glass, paint and metal to ``color``: sky, a skyline and the sun.

    Args:
        stage: the scene.
        towards: unit vectors along the rays.
        normal: unit normals of the surfaces.
        specular: reflectance at normal incidence.
        lit: share of the sun that reaches the points.
        color: linear RGB, which is changed in place.
    """
    glossy = (specular > 0).nonzero()[:, 0]
    if not len(glossy):
        return
    weather = stage.scene.weather
    normal = normal[glossy]
    towards = towards[glossy]
    specular = specular[glossy]

    # The mirrored ray, and the share that is reflected (Schlick's approximation).
    aligned = _dot(towards, normal)
    mirrored = towards - 2 * aligned[:, None] * normal
    share = specular + (1 - specular) * (1 + aligned.clamp(-1, 0)) ** 5

    # The sky, darker below a skyline that is a sum of two waves over the azimuth.
    light = sky_light(stage, mirrored, with_sun=False)
    azimuth = torch.atan2(mirrored[:, 0], mirrored[:, 2])
    phase = 6.3 * weather.shift[0]
    skyline = 0.14 + 0.12 * torch.sin(azimuth * 5 + phase)
    skyline = skyline + 0.07 * torch.sin(azimuth * 17 + 2 * phase)
    hidden = torch.sigmoid((skyline - mirrored @ stage.up) * 25)
    light *= (1 - 0.78 * hidden)[:, None]

    glint = 2 * lit[glossy] * (mirrored @ stage.to_sun).clamp(min=0) ** 300
    sun_color = torch.from_numpy(weather.sun_color).float()
    diffuse = color[glossy] * (1 - share)[:, None]
    color[glossy] = diffuse + share[:, None] * light + glint[:, None] * sun_color


def sky_light(stage: Stage, towards: Vectors, *, with_sun: bool = True) -> Vectors:
    """Compute the linear RGB of the sky, or below the horizon of the ground, in each direction.

    ``towards``: unit vectors away from the camera. ``with_sun``: the sun's disc too.
    """
    weather = stage.scene.weather
    zenith = torch.from_numpy(weather.zenith).float()
    horizon = torch.from_numpy(weather.horizon).float()
    sun_color = torch.from_numpy(weather.sun_color).float()

    # From the horizon to the zenith.
    height = towards @ stage.up
    zenith_share = (height.clamp(0, 1) ** 0.33)[:, None]
    shape = (len(height), 3)
    color = torch.lerp(horizon.expand(shape), zenith.expand(shape), zenith_share)

    # Clouds on a plane above, which fade towards the horizon.
    on_plane = towards / height.clamp(min=0.03)[:, None]
    u = on_plane[:, 0] * 0.05 + weather.shift[0]
    v = on_plane[:, 2] * 0.05 + weather.shift[1]
    density = look_up_noise(make_textures().clouds, u, v)
    cover = torch.sigmoid(3 * (density - 1.4 + 2.2 * weather.cloud)) * (height * 6).clamp(0, 1)
    cloud_color = (horizon * 0.9 + sun_color * 0.12).expand_as(color)
    color = torch.lerp(color, cloud_color, (0.8 * cover)[:, None])

    # The halo of the sun, wide and narrow, and its disc.
    toward_sun = (towards @ stage.to_sun).clamp(min=0)
    glow = 0.12 * toward_sun**8 + 0.3 * toward_sun**64
    if with_sun:
        glow = glow + 4 * toward_sun**1500
    color = color + glow[:, None] * sun_color

    ground = 0.3 * (horizon + 0.25 * sun_color) * 0.5
    is_above_ground = height > -0.02
    return torch.where(is_above_ground[:, None], color, ground.expand_as(color))
