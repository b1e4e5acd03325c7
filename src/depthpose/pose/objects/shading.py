"""Light on what is seen: linear RGB."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import back_project
from depthpose.core.raster import Raster
from depthpose.pose.augment import uniform
from depthpose.pose.objects.solids import Placed


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
