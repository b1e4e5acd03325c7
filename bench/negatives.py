"""Random parts, and things that may be taken for a known object, for benches and tests."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch

from depthpose.core.rigid import Rigid
from depthpose.core.units import metres_of
from depthpose.pose.mesh import MIRROR_ALIKE, make_model, mirror_deviation
from depthpose.pose.synthetic.parts import (
    PARTS,
    Mesh,
    join,
    make_box,
    make_circle,
    make_part,
    make_ring,
    move,
    revolve,
    rotate,
)
from depthpose.pose.synthetic.random_numbers import random_index, random_rotation, uniform
from depthpose.pose.types import ObjectModel

NegativeKind = Literal[
    "another object", "scaled", "mirrored", "blob", "plate", "box or cylinder", "ball", "hand"
]
"""A kind of thing that is not the object that is searched for."""
SCALES = (0.8, 0.9, 1.1, 1.25)  # of a scaled copy
_SIZES = (0.5, 1.1)
"""Of a negative that is no changed model, in diameters of the object."""


def negative_kinds(model: ObjectModel) -> tuple[NegativeKind, ...]:
    """List what is a negative of an object: its mirror image only where it differs from it."""
    kinds: tuple[NegativeKind, ...] = get_args(NegativeKind)
    if mirror_deviation(model) > MIRROR_ALIKE:
        return kinds
    return tuple(kind for kind in kinds if kind != "mirrored")


def negative_of(
    model: ObjectModel,
    kind: NegativeKind,
    others: Sequence[ObjectModel],
    generator: torch.Generator,
    scale: float | None = None,
) -> ObjectModel:
    """Make a negative of an object, with the object's name.

    Args:
        model: the object that is searched for.
        kind: of negative.
        others: objects of which another one is taken; where there is none, one of our parts.
        generator: of random choices.
        scale: of a scaled copy; None: one of :data:`SCALES`.
    """
    if kind == "another object":
        candidates = [other for other in others if other.name != model.name]
        if not candidates:
            candidates = [make_part(name) for name in PARTS if name != model.name]
        other = candidates[random_index(generator, len(candidates))]
        return dataclasses.replace(other, name=model.name)
    if kind == "scaled":
        return scaled(model, scale or SCALES[random_index(generator, len(SCALES))])
    if kind == "mirrored":
        return mirrored(model)
    return _solid(model, kind, generator)


def scaled(model: ObjectModel, scale: float) -> ObjectModel:
    """Scale an object."""
    return dataclasses.replace(
        model,
        vertices_m=scale * model.vertices_m,
        keypoints_m=scale * model.keypoints_m,
        diameter_m=scale * model.diameter_m,
    )


def mirrored(model: ObjectModel) -> ObjectModel:
    """Mirror an object across the plane x = 0."""
    flip = torch.tensor([-1.0, 1.0, 1.0])
    return dataclasses.replace(
        model,
        vertices_m=model.vertices_m * flip,
        normals=model.normals * flip,
        keypoints_m=model.keypoints_m * flip,
        faces=model.faces.flip(-1),
    )


def _solid(model: ObjectModel, kind: NegativeKind, generator: torch.Generator) -> ObjectModel:
    import trimesh

    mesh: Any
    size_m = model.diameter_m * uniform(generator, *_SIZES)
    width_m = uniform(generator, 0.3, 1.0) * size_m
    height_m = uniform(generator, 0.3, 1.0) * size_m
    match kind:
        case "plate":
            mesh = trimesh.creation.box((size_m, width_m, 0.01 * size_m))
        case "ball":
            mesh = trimesh.creation.icosphere(3, 0.5 * size_m)
        case "blob":
            mesh = trimesh.creation.icosphere(3, 0.5 * size_m)
            mesh.vertices *= _bumps(torch.tensor(mesh.vertices), generator).numpy()
        case "hand":
            mesh = _hand(size_m, generator)
        case _ if random_index(generator, 2):
            mesh = trimesh.creation.box((size_m, width_m, height_m))
        case _:
            mesh = trimesh.creation.cylinder(0.5 * width_m, size_m, 32)
    vertices_m = torch.tensor(mesh.vertices)
    faces = torch.tensor(mesh.faces)
    return make_model(vertices_m, faces, name=model.name, number=model.number)


def _bumps(points: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Compute a factor for the radius at each point: a sum of waves over the directions."""
    direction = torch.nn.functional.normalize(points.double(), dim=-1)
    waves = 2 * torch.randn(6, 3, generator=generator).double()
    phases = 2 * math.pi * torch.rand(6, generator=generator).double()
    return 1 + 0.12 * (direction @ waves.T + phases).sin().sum(-1, keepdim=True)


def _hand(size_m: float, generator: torch.Generator) -> Any:  # noqa: ANN401  trimesh's types
    """Make a hand of capsules: a palm and five fingers that bend."""
    import trimesh

    palm = trimesh.creation.box((0.45 * size_m, 0.45 * size_m, 0.14 * size_m))
    pieces = [palm]
    for k in range(5):
        length = size_m * uniform(generator, 0.25, 0.5)
        finger = trimesh.creation.capsule(length, size_m * uniform(generator, 0.04, 0.07))
        # The rotation that is nearest to a mixture of the identity and a random one.
        mixture = torch.eye(3) + 0.6 * (random_rotation(generator) - torch.eye(3))
        u, _, vh = torch.linalg.svd(mixture)
        position_m = torch.tensor([0.1 * (k - 2), 0.2, 0.0]) * size_m
        pose = Rigid((u @ vh).double(), position_m.double())
        pieces.append(finger.apply_transform(pose.matrix().numpy()))
    return trimesh.util.concatenate(pieces)


def random_part(generator: torch.Generator, name: str = "part") -> ObjectModel:
    """Make a part of three to six boxes, tubes and cones that run into one another.

    Args:
        generator: of the sizes, in millimetres from 3 to 90, and places.
        name: what samples call it.
    """
    pieces = []
    for _ in range(3 + random_index(generator, 4)):
        piece = _random_solid(generator)
        for axis in np.eye(3).tolist():
            piece = rotate(piece, (axis[0], axis[1], axis[2]), 90.0 * random_index(generator, 4))
        if random_index(generator, 4) == 0:
            piece = rotate(piece, (0.0, 0.0, 1.0), uniform(generator, 0.0, 90.0))
        pieces.append(move(piece, tuple(uniform(generator, -35.0, 35.0) for _ in range(3))))
    vertices, faces = join(*pieces)
    return make_model(torch.from_numpy(vertices) * metres_of("mm"), torch.from_numpy(faces),
                      name=name)  # fmt: skip


def random_simple_part(generator: torch.Generator, name: str = "part") -> ObjectModel:
    """Make a box, a tube, a cup, or a profile of the shape of an L, T or U.

    All but an L of unlike legs have symmetries, which the model does not name
    (:func:`~depthpose.pose.mesh.with_found_symmetries` finds them).

    Args:
        generator: of kind and sizes, in millimetres.
        name: what samples call it.
    """
    width, depth, length = (uniform(generator, 20.0, 90.0) for _ in range(3))
    wall = uniform(generator, 3.0, 10.0)
    bore = uniform(generator, 0.3, 0.9)
    foot = make_box((width, wall, length))
    web = make_box((wall, depth, length))
    edge = (width - wall) / 2
    left, middle, right = (move(web, (x, depth / 2, 0.0)) for x in (-edge, 0.0, edge))
    solids = [
        make_box((width, depth, length)),
        make_ring(make_circle(width / 2), make_circle(bore * width / 2), length),
        _cup(width / 2, length, wall),
        join(foot, left),
        join(foot, middle),
        join(foot, left, right),
    ]
    vertices, faces = solids[random_index(generator, len(solids))]
    return make_model(torch.from_numpy(vertices) * metres_of("mm"), torch.from_numpy(faces),
                      name=name)  # fmt: skip


def _cup(radius: float, height: float, wall: float) -> Mesh:
    inner = radius - min(wall, radius / 2)
    return revolve([(0.0, 0.0), (radius, 0.0), (radius, height), (inner, height),
                      (inner, radius - inner), (0.0, radius - inner)])  # fmt: skip


def _random_solid(generator: torch.Generator) -> Mesh:
    """Make a box, a tube or a cone."""
    kind = random_index(generator, 3)
    height = uniform(generator, 10.0, 90.0)
    if kind == 0:
        return make_box((uniform(generator, 4.0, 80.0), uniform(generator, 4.0, 60.0), height))
    lower_radius = uniform(generator, 3.0, 35.0)
    upper_radius = uniform(generator, 3.0, 35.0)
    if kind == 1:
        bore = uniform(generator, 0.2, 0.8) * lower_radius
        return make_ring(make_circle(lower_radius), make_circle(bore), height)
    return revolve([(0.0, 0.0), (lower_radius, 0.0), (upper_radius, height), (0.0, height)])
