"""Objects of near scenes: machine parts, household objects and the shapes of clutter.

Each ``_add_*`` function adds one object about its centre, of a size and rotated by ``R``:
``R[:, 1]`` is the axis of round objects, and points down for upright ones.
"""

from itertools import pairwise

import numpy as np

from depthpose.depth.synthetic.mesh import MeshBuilder, Rotation, Surface
from depthpose.depth.synthetic.scene import add_shape, random_rotation, random_surface

PLAIN = ("paint", "skin", "plaster", "metal")
"""Materials with next to no texture where a tile of them is much larger than the surface."""

_KINDS = ("ball", "box", "box", "card", "pole", "fence", "wheel", "lattice", "leaves",
          "bracket", "flange", "spool", "bottle", "mug", "books", "cable", "stool")  # fmt: skip
"""A kind is repeated in proportion to how often it is drawn."""


def random_kind(rng: np.random.Generator) -> str:
    """Draw the kind of an object."""
    return _KINDS[int(rng.integers(len(_KINDS)))]


def random_near_surface(
    rng: np.random.Generator, size_m: float, plain_share: float = 0.3
) -> Surface:
    """Draw a surface for an object of ``size_m``; a share of them has next to no texture."""
    surface = random_surface(rng, size_m)
    if rng.random() >= plain_share:
        return surface
    material = PLAIN[int(rng.integers(len(PLAIN)))]
    return surface._replace(material=material, tile_m=size_m * rng.uniform(3, 40))


def add_thing(b: MeshBuilder, kind: str, centre: np.ndarray, size_m: float) -> None:
    """Add an object of a kind about its centre (3,) [m], with a random surface and rotation."""
    b.thing += 1
    surface = random_near_surface(b.rng, size_m)
    R = random_rotation(b.rng) if b.rng.random() < 0.6 else np.eye(3)
    match kind:
        case "bracket":
            _add_bracket(b, centre, size_m, surface, R)
        case "flange" | "spool":
            _add_discs_on_tube(b, centre, size_m, surface, R, discs=1 if kind == "flange" else 2)
        case "bottle":
            _add_bottle(b, centre, size_m, surface, R)
        case "mug":
            _add_mug(b, centre, size_m, surface, R)
        case "books":
            _add_books(b, centre, size_m, R)
        case "cable":
            _add_cable(b, centre, size_m, surface, R)
        case "stool":
            _add_stool(b, centre, size_m, surface, R)
        case _:
            add_shape(b, kind, centre, size_m)


def _add_bracket(
    b: MeshBuilder, centre: np.ndarray, size_m: float, surface: Surface, R: Rotation
) -> None:
    """Add two plates at a right angle, with a rib."""
    long, wide, high = size_m * b.rng.uniform(0.4, 1, 3)
    thick = size_m * b.rng.uniform(0.04, 0.15)
    plates = (
        ((0, 0, 0), (long, thick, wide)),
        ((-long / 2, -high / 2, 0), (thick, high, wide)),
        ((-long / 3, -high / 5, 0), (long / 2, high / 2, thick)),
    )
    for offset, size in plates:
        b.box(centre + R @ np.array(offset), size, surface, R)


def _add_discs_on_tube(
    b: MeshBuilder, centre: np.ndarray, size_m: float, surface: Surface, R: Rotation, discs: int
) -> None:
    """Add a tube with a thick disc at its start (a flange), or at both ends (a spool)."""
    axis = R[:, 1]
    radius = size_m * b.rng.uniform(0.3, 0.6)
    length = size_m * b.rng.uniform(0.15, 1.0)
    start = centre - axis * length / 2
    end = centre + axis * length / 2
    tube_radius = radius * b.rng.uniform(0.3, 0.7)
    b.tube(start, end, tube_radius, surface, 24)
    for face in (start, end)[:discs]:
        other_face = face + axis * radius * b.rng.uniform(0.05, 0.25)
        b.tube(face, other_face, radius, surface, 32)
        b.disc(face, axis, radius, surface, 32)
        b.disc(other_face, axis, radius, surface, 32)
    b.disc(end, axis, tube_radius, surface, 24)


def _add_bottle(
    b: MeshBuilder, centre: np.ndarray, size_m: float, surface: Surface, R: Rotation
) -> None:
    """Add a cylinder, a cone and a narrow cylinder on each other, closed at the narrow end."""
    axis = R[:, 1]
    radius = size_m * b.rng.uniform(0.15, 0.3)
    start = centre - axis * size_m / 2
    heights = np.cumsum([0, *(size_m * b.rng.uniform(0.1, 0.5, 3))])
    neck_radius = radius * b.rng.uniform(0.2, 0.5)
    radii = (radius, radius, neck_radius, neck_radius)
    for (low, high), frustum_radii in zip(pairwise(heights), pairwise(radii), strict=True):
        b.tube(start + axis * low, start + axis * high, frustum_radii, surface, 24)
    b.disc(start + axis * heights[-1], axis, neck_radius, surface, 24)


def _add_mug(
    b: MeshBuilder, centre: np.ndarray, size_m: float, surface: Surface, R: Rotation
) -> None:
    """Add a cup with an inner and an outer wall, and a bent handle."""
    axis = R[:, 1]
    radius = size_m * b.rng.uniform(0.25, 0.4)
    start = centre - axis * size_m / 2
    end = centre + axis * size_m / 2
    b.tube(start, end, radius, surface, 28)
    b.tube(start, end, 0.9 * radius, surface, 28)
    b.disc(start, axis, radius, surface, 28)
    handle = [
        centre
        + R[:, 0] * (radius * (0.8 + 0.7 * np.cos(angle)))
        + axis * (0.4 * size_m * np.sin(angle))
        for angle in np.linspace(-1.2, 1.2, 8)
    ]
    for joint, next_joint in pairwise(handle):
        b.tube(joint, next_joint, 0.12 * radius, surface, 8)


def _add_books(b: MeshBuilder, centre: np.ndarray, size_m: float, R: Rotation) -> None:
    """Add a pile of books; each is an object with its own surface."""
    down = np.array([0.0, 1, 0])
    offset = np.zeros(3)
    for _ in range(int(b.rng.integers(2, 9))):
        b.thing += 1
        thick = size_m * b.rng.uniform(0.03, 0.15)
        size = (size_m * b.rng.uniform(0.4, 0.7), thick, size_m * b.rng.uniform(0.5, 0.9))
        b.box(centre + R @ (offset + down * thick / 2), size, random_near_surface(b.rng, size_m), R)
        offset = offset + down * thick


def _add_cable(
    b: MeshBuilder, centre: np.ndarray, size_m: float, surface: Surface, R: Rotation
) -> None:
    """Add thin tubes end to end, along a random walk of directions."""
    start = centre
    heading = R[0]
    for _ in range(int(b.rng.integers(5, 25))):
        end = start + heading * size_m * 0.12
        b.tube(start, end, size_m * 0.02, surface, 6)
        start = end
        heading = heading + b.rng.normal(0, 0.4, 3)
        heading = heading / np.linalg.norm(heading)


def _add_stool(
    b: MeshBuilder, centre: np.ndarray, size_m: float, surface: Surface, R: Rotation
) -> None:
    """Add a square seat on four legs."""
    half = size_m / 2
    b.box(centre - R[:, 1] * half, (size_m, 0.08 * size_m, size_m), surface, R)
    for x, z in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        foot = centre + R @ np.array([0.9 * x * half, half, 0.9 * z * half])
        head = foot - R[:, 1] * size_m
        b.tube(head, foot, size_m * 0.03, surface, 8)
