"""Solids of a scene, triangles with normals, colour and pattern, and the light on them.

Light is linear RGB.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import back_project
from depthpose.core.loop import sample_generator
from depthpose.core.render import Raster
from depthpose.core.rigid import Rigid
from depthpose.pose.augment import uniform, whole
from depthpose.pose.synthetic.views import surfel_triangles
from depthpose.pose.types import ObjectModel

_WAVES = 6
_COLOUR_SEED = 0xC0102


@dataclass(frozen=True, kw_only=True, eq=False)
class Pattern:
    """Colour of a point: a base colour, and waves of brightness and hue through space.

    Attributes:
        base: linear RGB.
        waves: how each colour follows each wave.
        frequencies: of the waves [rad/m].
        phases: theirs.
        gloss: share of light that is mirrored.
    """

    base: Float[Tensor, "3"]
    waves: Float[Tensor, "w 3"]
    frequencies: Float[Tensor, "w 3"]
    phases: Float[Tensor, " w"]
    gloss: float

    def at(self, points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Colour of points of the object's own frame."""
        waves = torch.tanh(2 * (points_m @ self.frequencies.mT + self.phases).sin())
        return (self.base * (1 + waves @ self.waves)).clamp(0.01, 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """One thing of a scene.

    Attributes:
        triangles_m: in its own frame.
        normals: of their corners.
        pattern: its colour.
        number: its ``obj_id``; None: no known object.
    """

    triangles_m: Float[Tensor, "n 3 3"]
    normals: Float[Tensor, "n 3 3"]
    pattern: Pattern
    number: int | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """A solid in the camera's frame."""

    solid: Solid
    camera_from_model: Rigid


def random_pattern(
    generator: torch.Generator, size_m: float, colourful: tuple[float, float] = (0.0, 0.8)
) -> Pattern:
    """Draw a colour, plain or patterned, with features of about a third of a size."""
    strength = uniform(generator, 0.0, 0.25)
    directions = torch.randn(_WAVES, 3, generator=generator)
    grey, hue = uniform(generator, 0.1, 0.8), torch.rand(3, generator=generator)
    share = uniform(generator, *colourful)
    common = torch.randn(_WAVES, 1, generator=generator)
    own = 0.5 * torch.randn(_WAVES, 3, generator=generator)
    return Pattern(
        base=(1 - share) * grey + share * hue,
        waves=strength * (common + own) / math.sqrt(_WAVES),
        frequencies=directions * (2 * math.pi / size_m * uniform(generator, 1.0, 4.0)),
        phases=2 * math.pi * torch.rand(_WAVES, generator=generator),
        gloss=uniform(generator, 0.0, 0.4),
    )


def solid_of(model: ObjectModel) -> Solid:
    """Prepare a known object: it looks alike in every frame of every data set."""
    generator = sample_generator(model.number, _COLOUR_SEED)
    pattern = random_pattern(generator, model.diameter_m, (0.7, 1.0))
    if len(model.faces):
        corners, normals = model.triangles_m, model.normals[model.faces]
    else:
        corners = surfel_triangles(model)
        each = len(corners) // len(model.vertices_m)
        normals = model.normals.repeat_interleave(each, 0)[:, None].expand(-1, 3, 3)
    return Solid(triangles_m=corners, normals=normals, pattern=pattern, number=model.number)


def random_clutter(generator: torch.Generator) -> Solid:
    """Draw a box, a ball or a can of no known object."""
    import trimesh

    size_m = uniform(generator, 0.04, 0.15)
    flat, thin = uniform(generator, 0.3, 1.0), uniform(generator, 0.3, 1.0)
    match whole(generator, 3):
        case 0:
            mesh = trimesh.creation.box((size_m, flat * size_m, thin * size_m))
        case 1:
            mesh = trimesh.creation.icosphere(3, 0.5 * size_m)
        case _:
            mesh = trimesh.creation.cylinder(0.5 * flat * size_m, size_m, 32)
    corners = torch.tensor(mesh.triangles, dtype=torch.float32)
    normals = torch.tensor(mesh.face_normals, dtype=torch.float32)[:, None].expand(-1, 3, 3)
    return Solid(
        triangles_m=corners,
        normals=normals,
        pattern=random_pattern(generator, size_m),
        number=None,
    )


def table_of(side_m: float, generator: torch.Generator) -> Solid:
    """Draw a table's top about the origin, at height 0."""
    h = 0.5 * side_m
    corners = torch.tensor([[-h, -h, 0.0], [h, -h, 0.0], [h, h, 0.0], [-h, h, 0.0]])
    return Solid(
        triangles_m=corners[torch.tensor([[0, 1, 2], [0, 2, 3]])],
        normals=torch.tensor([0.0, 0.0, 1.0]).expand(2, 3, 3),
        pattern=random_pattern(generator, uniform(generator, 0.05, 0.5)),
        number=None,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Light:
    """A lamp far away, and light from everywhere.

    Attributes:
        towards: unit vector to the lamp, in the camera's frame.
        lamp: its linear RGB.
        ambient: that of the surroundings.
    """

    towards: Float[Tensor, "3"]
    lamp: Float[Tensor, "3"]
    ambient: Float[Tensor, "3"]


def random_light(up: Float[Tensor, "3"], generator: torch.Generator) -> Light:
    """Draw a lamp above the table, warm or cold, strong or weak."""
    towards = F.normalize(1.2 * up + 0.8 * torch.randn(3, generator=generator), dim=0)
    strength, warmth = uniform(generator, 0.3, 0.9), uniform(generator, -0.15, 0.15)
    colour = torch.tensor([1 + warmth, 1.0, 1 - warmth])
    return Light(
        towards=towards,
        lamp=strength * colour,
        ambient=uniform(generator, 0.2, 0.6) * (2 - colour),
    )


def shade(
    placed: Sequence[Placed], raster: Raster, K: Float[Tensor, "3 3"], light: Light
) -> Float[Tensor, "n 3"]:
    """Colour of each pixel that sees something, in the order of the image's rows.

    Lambert's law and a mirrored lamp (Blinn 1977); no shadow is cast.
    """
    assert raster.barycentric is not None
    is_seen = raster.primitive >= 0
    points, share = back_project(raster.depth_m, K)[is_seen], raster.barycentric[is_seen]
    primitive = raster.primitive[is_seen]
    colour = torch.zeros_like(points)
    start = 0
    for thing in placed:
        stop = start + len(thing.solid.triangles_m)
        own = ((primitive >= start) & (primitive < stop)).nonzero()[:, 0]
        corners = thing.solid.normals[primitive[own] - start]
        normal = (corners * share[own, :, None]).sum(1) @ thing.camera_from_model.R.mT
        local = thing.camera_from_model.inverse().apply(points[own])
        lit = _lit(points[own], F.normalize(normal, dim=-1), light, thing.solid.pattern.gloss)
        base, mirrored = lit
        colour[own] = thing.solid.pattern.at(local) * base + mirrored
        start = stop
    return colour


def backdrop(
    height: int, width: int, generator: torch.Generator
) -> Float[Tensor, "3 {height} {width}"]:
    """Draw what is behind the table: blots of several sizes over a colour, out of focus."""
    image = torch.rand(3, 1, 1, generator=generator) * torch.ones(1, height, width)
    for cells in (3, 8, 24):
        blots = torch.randn(1, 3, cells, cells, generator=generator)
        smooth = F.interpolate(blots, (height, width), mode="bilinear", align_corners=False)
        image = image + uniform(generator, 0.0, 0.25) * smooth[0]
    return image.clamp(0, 1)


def _lit(
    points: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"], light: Light, gloss: float
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Light that a white surface would scatter, and what it mirrors."""
    sight = F.normalize(-points, dim=-1)
    # Both sides of a thin part are seen.
    normal = normal * torch.where((normal * sight).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    facing = (normal @ light.towards).clamp(min=0)[:, None]
    half = F.normalize(sight + light.towards, dim=-1)
    shine = (normal * half).sum(-1, keepdim=True).clamp(min=0) ** (1 / math.radians(2))
    # From below comes half of what comes from above.
    open_sky = 0.75 + 0.25 * (normal @ light.towards)[:, None]
    return light.ambient * open_sky + light.lamp * facing, gloss * shine * light.lamp
