"""Objects of near scenes: machine parts, household objects and the shapes of clutter.

Each ``_add_*`` function adds one object about its centre (3,) [m], of a size [m] and rotated by
``R``: ``R[:, 1]`` is the axis of round objects, and points down for upright ones.
"""

from itertools import pairwise

import numpy as np

from depthpose.depth.synthetic.clutter import CLUTTER_SHAPES, draw_appearance
from depthpose.depth.synthetic.materials import Appearance
from depthpose.depth.synthetic.mesh import MeshBuilder, Rotation
from depthpose.depth.synthetic.randomness import draw_rotation

PLAIN_MATERIALS = ("paint", "skin", "plaster", "metal")
"""Materials with next to no texture where a tile of them is much larger than the surface."""


def draw_near_kind(rng: np.random.Generator) -> str:
    """Draw the kind of an object."""
    return _KINDS[int(rng.integers(len(_KINDS)))]


def draw_near_appearance(
    rng: np.random.Generator, size_m: float, plain_share: float = 0.3
) -> Appearance:
    """Draw the appearance of an object of ``size_m``.

    ``plain_share``: probability of a material with next to no texture, beside those that
    :func:`draw_appearance` draws.
    """
    appearance = draw_appearance(rng, size_m)
    if rng.random() >= plain_share:
        return appearance
    material = PLAIN_MATERIALS[int(rng.integers(len(PLAIN_MATERIALS)))]
    return appearance._replace(material=material, tile_m=size_m * rng.uniform(3, 40))


def add_near_object(builder: MeshBuilder, kind: str, centre: np.ndarray, size_m: float) -> None:
    """Add an object of a kind about its centre (3,) [m], of random appearance and rotation."""
    builder.begin_object()

    # Drawn for shapes of clutter too, which draw their own: a change would change earlier scenes.
    appearance = draw_near_appearance(builder.rng, size_m)
    R = draw_rotation(builder.rng) if builder.rng.random() < 0.6 else np.eye(3)
    if kind in CLUTTER_SHAPES:
        CLUTTER_SHAPES[kind](builder, centre, size_m)
    else:
        _SHAPES[kind](builder, centre, size_m, appearance, R)


def _add_bracket(
    builder: MeshBuilder, centre: np.ndarray, size_m: float, appearance: Appearance, R: Rotation
) -> None:
    """Add two plates at a right angle, with a rib."""
    length, width, height = size_m * builder.rng.uniform(0.4, 1, 3)
    thick = size_m * builder.rng.uniform(0.04, 0.15)
    plates = (  # the middle of each, from the centre, and its size
        ((0, 0, 0), (length, thick, width)),
        ((-length / 2, -height / 2, 0), (thick, height, width)),
        ((-length / 3, -height / 5, 0), (length / 2, height / 2, thick)),
    )
    for offset, size in plates:
        builder.add_box(centre + R @ np.array(offset), size, appearance, R)


def _add_flange(
    builder: MeshBuilder, centre: np.ndarray, size_m: float, appearance: Appearance, R: Rotation
) -> None:
    """Add a tube with a thick disc at its start."""
    _add_discs_on_tube(builder, centre, size_m, appearance, R, disc_count=1)


def _add_spool(
    builder: MeshBuilder, centre: np.ndarray, size_m: float, appearance: Appearance, R: Rotation
) -> None:
    """Add a tube with a thick disc at both ends."""
    _add_discs_on_tube(builder, centre, size_m, appearance, R, disc_count=2)


def _add_discs_on_tube(
    builder: MeshBuilder,
    centre: np.ndarray,
    size_m: float,
    appearance: Appearance,
    R: Rotation,
    disc_count: int,
) -> None:
    """Add a tube with a thick disc at its start, or for ``disc_count`` 2 at both ends."""
    axis = R[:, 1]
    disc_radius = size_m * builder.rng.uniform(0.3, 0.6)
    length = size_m * builder.rng.uniform(0.15, 1.0)
    start = centre - axis * length / 2
    end = centre + axis * length / 2
    tube_radius = disc_radius * builder.rng.uniform(0.3, 0.7)
    builder.add_tube(start, end, tube_radius, appearance, 24)
    for face in (start, end)[:disc_count]:
        other_face = face + axis * disc_radius * builder.rng.uniform(0.05, 0.25)
        builder.add_tube(face, other_face, disc_radius, appearance, 32)
        builder.add_disc(face, axis, disc_radius, appearance, 32)
        builder.add_disc(other_face, axis, disc_radius, appearance, 32)
    builder.add_disc(end, axis, tube_radius, appearance, 24)


def _add_bottle(
    builder: MeshBuilder, centre: np.ndarray, size_m: float, appearance: Appearance, R: Rotation
) -> None:
    """Add a bottle: a cylinder, a cone and a narrow cylinder, closed at the narrow end alone.

    Its neck points along the axis: an unrotated bottle is upside down. It stays so, for a turned
    one would change earlier scenes.
    """
    axis = R[:, 1]
    radius = size_m * builder.rng.uniform(0.15, 0.3)
    start = centre - axis * size_m / 2
    heights = np.cumsum([0, *(size_m * builder.rng.uniform(0.1, 0.5, 3))])
    neck_radius = radius * builder.rng.uniform(0.2, 0.5)
    radii = (radius, radius, neck_radius, neck_radius)
    for (low, high), frustum_radii in zip(pairwise(heights), pairwise(radii), strict=True):
        builder.add_tube(start + axis * low, start + axis * high, frustum_radii, appearance, 24)
    builder.add_disc(start + axis * heights[-1], axis, neck_radius, appearance, 24)


def _add_mug(
    builder: MeshBuilder, centre: np.ndarray, size_m: float, appearance: Appearance, R: Rotation
) -> None:
    """Add a cup with an inner and an outer wall, a bottom, and a bent handle.

    Its open end is that along the axis: an unrotated cup is upside down. It stays so, for a turned
    one would change earlier scenes.
    """
    axis = R[:, 1]
    radius = size_m * builder.rng.uniform(0.25, 0.4)
    start = centre - axis * size_m / 2
    end = centre + axis * size_m / 2
    builder.add_tube(start, end, radius, appearance, 28)
    builder.add_tube(start, end, 0.9 * radius, appearance, 28)
    builder.add_disc(start, axis, radius, appearance, 28)  # the bottom

    # The handle is an arc of an ellipse beside the cup.
    joints: list[np.ndarray] = []
    for angle in np.linspace(-1.2, 1.2, 8):
        outwards = R[:, 0] * (radius * (0.8 + 0.7 * np.cos(angle)))
        joints.append(centre + outwards + axis * (0.4 * size_m * np.sin(angle)))
    for joint, next_joint in pairwise(joints):
        builder.add_tube(joint, next_joint, 0.12 * radius, appearance, 8)


def _add_books(
    builder: MeshBuilder, centre: np.ndarray, size_m: float, _: Appearance, R: Rotation
) -> None:
    """Add a pile of books from the centre down; each is an object with its own appearance."""
    down = np.array([0.0, 1, 0])
    offset = np.zeros(3)
    for _book in range(int(builder.rng.integers(2, 9))):
        builder.begin_object()
        thick = size_m * builder.rng.uniform(0.03, 0.15)
        width = size_m * builder.rng.uniform(0.4, 0.7)
        length = size_m * builder.rng.uniform(0.5, 0.9)
        middle = centre + R @ (offset + down * thick / 2)
        appearance = draw_near_appearance(builder.rng, size_m)
        builder.add_box(middle, (width, thick, length), appearance, R)
        offset = offset + down * thick


def _add_cable(
    builder: MeshBuilder, centre: np.ndarray, size_m: float, appearance: Appearance, R: Rotation
) -> None:
    """Add thin tubes end to end, along a random walk of directions."""
    start = centre
    heading = R[0]
    for _ in range(int(builder.rng.integers(5, 25))):
        end = start + heading * size_m * 0.12
        builder.add_tube(start, end, size_m * 0.02, appearance, 6)
        start = end
        heading = heading + builder.rng.normal(0, 0.4, 3)
        heading = heading / np.linalg.norm(heading)


def _add_stool(
    builder: MeshBuilder, centre: np.ndarray, size_m: float, appearance: Appearance, R: Rotation
) -> None:
    """Add a square seat on four legs."""
    half = size_m / 2
    seat = (size_m, 0.08 * size_m, size_m)
    builder.add_box(centre - R[:, 1] * half, seat, appearance, R)
    for x, z in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        foot = centre + R @ np.array([0.9 * x * half, half, 0.9 * z * half])
        head = foot - R[:, 1] * size_m
        builder.add_tube(head, foot, size_m * 0.03, appearance, 8)


_SHAPES = {
    "bracket": _add_bracket,
    "flange": _add_flange,
    "spool": _add_spool,
    "bottle": _add_bottle,
    "mug": _add_mug,
    "books": _add_books,
    "cable": _add_cable,
    "stool": _add_stool,
}
_KINDS = ("ball", "box", "box", "card", "pole", "fence", "wheel", "lattice", "leaves",
          "bracket", "flange", "spool", "bottle", "mug", "books", "cable", "stool")  # fmt: skip
"""A kind is repeated in proportion to how often it is drawn."""
