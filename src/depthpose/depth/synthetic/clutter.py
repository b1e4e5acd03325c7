"""Clutter: scenes of objects at random places, before a backdrop.

Its objects are thin, slanted, round, leafy, textureless, repetitive and reflecting, and at every
distance, as those of streets are not.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from depthpose.depth.synthetic.materials import Appearance
from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder, Values
from depthpose.depth.synthetic.plants import add_leaves
from depthpose.depth.synthetic.randomness import (
    Stream,
    draw_log_uniform,
    draw_rotation,
    make_rng,
)
from depthpose.depth.synthetic.scene import NO_MARKINGS, SyntheticScene, draw_weather

_DEPTHS_M = (3.5, 45.0)
"""Nearest and farthest centre of an object of clutter; with KITTI's rig 110 and 9 px of
disparity."""

_PLAIN_MATERIALS = ("paint", "skin", "glass", "plaster", "metal")
_TEXTURED_MATERIALS = ("pavement", "grass", "brick", "stone", "concrete", "roof", "bark", "leaf",
                       "wood", "side", "pane", "plate", "sign", "poster", "cloth", "dirt",
                       "hills")  # fmt: skip
_PLAIN_SHARE = 0.3
"""Share of the objects with a material of next to no texture."""


def make_clutter(seed: tuple[int, ...]) -> SyntheticScene:
    """Make the clutter that belongs to ``seed``, any whole numbers."""
    rng = make_rng(Stream.CLUTTER, *seed)
    builder = MeshBuilder(rng)

    match int(rng.integers(3)):
        case 2:
            _add_box_from_inside(builder)
        case 1:
            _add_backdrop_wall(builder)
            _add_backdrop_ground(builder)
        case _:
            _add_backdrop_ground(builder)

    for _ in range(int(rng.integers(12, 60))):
        builder.begin_object()
        z = draw_log_uniform(rng, *_DEPTHS_M)
        centre = np.array([rng.uniform(-0.95, 0.95) * z, rng.uniform(-0.3, 0.3) * z, z])
        size_m = min(z, 25.0) * draw_log_uniform(rng, 0.03, 0.3)
        kind = _KINDS[int(rng.integers(len(_KINDS)))]
        CLUTTER_SHAPES[kind](builder, centre, size_m)
    return SyntheticScene(
        mesh=_remove_near(builder.finish()),
        markings=NO_MARKINGS,
        weather=draw_weather(rng),
        camera_from_world=np.eye(3),
        place="clutter",
    )


def _add_sheet(builder: MeshBuilder, corner: Values, along: Values, up: Values) -> None:
    """Add a large rectangle as one object: a corner and its two sides, as vectors [m]."""
    builder.begin_object()
    appearance = draw_appearance(builder.rng, builder.rng.uniform(0.5, 4))
    builder.add_rectangle(corner, along, up, appearance)


def _add_box_from_inside(builder: MeshBuilder) -> None:
    """Add a floor, a back wall, two side walls and at times a ceiling, seen from inside."""
    rng = builder.rng
    half_x = rng.uniform(3, 14)
    depth = rng.uniform(8, 45)
    floor_y = rng.uniform(1, 3)
    ceiling_y = rng.uniform(-6, -2)
    across = [2 * half_x, 0, 0]
    ahead = [0, 0, depth]
    up = [0, ceiling_y - floor_y, 0]
    _add_sheet(builder, [-half_x, floor_y, 0], across, ahead)
    _add_sheet(builder, [-half_x, floor_y, depth], across, up)
    for x in (-half_x, half_x):
        _add_sheet(builder, [x, floor_y, 0], ahead, up)
    if rng.random() < 0.6:
        _add_sheet(builder, [-half_x, ceiling_y, 0], across, ahead)


def _add_backdrop_wall(builder: MeshBuilder) -> None:
    """Add a wall of 300 m across the view, which may be slanted."""
    rng = builder.rng
    yaw = rng.uniform(-0.9, 0.9)
    z = rng.uniform(18, 60)
    along = np.array([np.cos(yaw), rng.normal(0, 0.1), np.sin(yaw)]) * 300
    up = [0, -40, rng.normal(0, 10)]
    _add_sheet(builder, np.array([0, 20, z]) - along / 2, along, up)


def _add_backdrop_ground(builder: MeshBuilder) -> None:
    """Add a slightly slanted ground of 300 m across and ahead."""
    rng = builder.rng
    y = rng.uniform(1.0, 3.0)
    slope = rng.normal(0, 0.02)
    _add_sheet(builder, [-150, y, 0], [300, rng.normal(0, 8), 0], [0, slope * 300, 300])


def _remove_near(mesh: Mesh) -> Mesh:
    """Remove triangles of objects that are nearer than the rig's largest disparity allows.

    The backdrop reaches behind the camera; it is told by its large triangles.
    """
    nearest_m, _ = _DEPTHS_M  # of centres; surfaces may be a little nearer
    is_far = mesh.corners[:, :, 2].min(1) > 0.85 * nearest_m
    is_backdrop = np.ptp(mesh.corners, axis=1).max(1) > nearest_m
    return mesh.select(is_far | is_backdrop)


def draw_appearance(rng: np.random.Generator, size_m: float) -> Appearance:
    """Draw a material and a colour, grey to saturated, for an object of ``size_m``."""
    is_plain = rng.random() < _PLAIN_SHARE
    materials = _PLAIN_MATERIALS if is_plain else _TEXTURED_MATERIALS
    tile_m = size_m * draw_log_uniform(rng, 0.15, 3.0)
    material = materials[int(rng.integers(len(materials)))]

    # Channels differ little from a grey, or somewhat, or much.
    grey = draw_log_uniform(rng, 0.03, 0.8)
    saturation = rng.choice([0.05, 0.4, 1.0])
    color = np.clip(grey * np.exp(rng.normal(0, saturation, 3)), 0.01, 0.9)
    return Appearance(material, tuple(color.tolist()), tile_m, int(rng.integers(8)))


def _add_ball(builder: MeshBuilder, centre: np.ndarray, size_m: float) -> None:
    """Add an ellipsoid, at times with dents."""
    rng = builder.rng
    radii = size_m / 2 * rng.uniform(0.5, 1.5, 3)
    dents = rng.uniform(0, 0.5) if rng.random() < 0.6 else 0.0
    builder.add_ellipsoid(centre, radii, draw_appearance(rng, size_m), 3, dents)


def _add_box(builder: MeshBuilder, centre: np.ndarray, size_m: float) -> None:
    """Add a box that may be tapered."""
    rng = builder.rng
    R = draw_rotation(rng) if rng.random() < 0.5 else np.eye(3)
    sides = size_m * np.exp(rng.normal(0, 0.6, 3))
    appearance = draw_appearance(rng, size_m)
    builder.add_box(centre, sides, appearance, R, taper=rng.uniform(0.4, 1))


def _add_card(builder: MeshBuilder, centre: np.ndarray, size_m: float) -> None:
    """Add a rectangle at any slant."""
    rng = builder.rng
    R = draw_rotation(rng)
    along = R[0] * size_m * rng.uniform(0.5, 2)
    up = R[1] * size_m * rng.uniform(0.5, 2)
    appearance = draw_appearance(rng, size_m)
    builder.add_rectangle(centre - (along + up) / 2, along, up, appearance)


def _add_pole(builder: MeshBuilder, centre: np.ndarray, size_m: float) -> None:
    """Add a tapered pole, in half of the cases a nearly upright one."""
    rng = builder.rng
    half = draw_rotation(rng)[0] * size_m * rng.uniform(0.7, 3)
    if rng.random() < 0.5:
        half = half * [0.05, 1, 0.05]
    radius = size_m * draw_log_uniform(rng, 0.01, 0.2)
    radii = (radius, radius * rng.uniform(0.3, 1))
    builder.add_tube(centre - half, centre + half, radii, draw_appearance(rng, size_m), 10)


def _add_fence(builder: MeshBuilder, centre: np.ndarray, size_m: float) -> None:
    """Add bars side by side with two rails: a repetition, which has many false matches."""
    rng = builder.rng
    yaw = rng.uniform(-0.8, 0.8)
    along = np.array([np.cos(yaw), 0, np.sin(yaw)]) * size_m * rng.uniform(1, 3)
    half_bar = np.array([0, size_m / 2, 0])
    appearance = draw_appearance(rng, size_m)
    count = int(rng.integers(4, 20))
    radius = float(np.linalg.norm(along)) / count * rng.uniform(0.05, 0.3)
    for share in np.linspace(-0.5, 0.5, count):
        middle = centre + share * along
        builder.add_tube(middle - half_bar, middle + half_bar, radius, appearance)
    for height in (-0.8, 0.8):
        middle = centre + height * half_bar
        builder.add_tube(middle - along / 2, middle + along / 2, radius, appearance)


def _add_wheel(builder: MeshBuilder, centre: np.ndarray, size_m: float) -> None:
    """Add a rim with spokes: the background is visible through the gaps."""
    rng = builder.rng
    R = draw_rotation(rng) if rng.random() < 0.5 else np.eye(3)
    appearance = draw_appearance(rng, size_m)
    radius = size_m * rng.uniform(0.5, 1.2)
    rim_sides = 24
    angle = np.linspace(0, 2 * np.pi, rim_sides + 1)[:, None]
    rim = centre + radius * (np.cos(angle) * R[0] + np.sin(angle) * R[1])
    rim_radius = radius * rng.uniform(0.03, 0.2)
    for start, end in pairwise(rim):
        builder.add_tube(start, end, rim_radius, appearance, 6)

    spoke_radius = radius * rng.uniform(0.01, 0.08)
    spoke_count = int(rng.integers(3, 14))
    corners = np.linspace(0, rim_sides, spoke_count, endpoint=False).astype(int)
    for corner in corners:
        radii = (spoke_radius * rng.uniform(1, 2), spoke_radius)
        builder.add_tube(centre, rim[corner], radii, appearance, 6)


def _add_lattice(builder: MeshBuilder, centre: np.ndarray, size_m: float) -> None:
    """Add flat bars that cross, as shelves, window frames and benches have."""
    rng = builder.rng
    R = draw_rotation(rng) if rng.random() < 0.3 else np.eye(3)
    sides = size_m * rng.uniform(0.6, 2.5, 2)
    appearance = draw_appearance(rng, size_m)
    depth_m = size_m * float(np.exp(rng.uniform(-4, 0)))
    for axis in (0, 1):
        count = int(rng.integers(2, 8))
        bar = np.array([*sides, depth_m])
        bar[axis] = sides[axis] / count * rng.uniform(0.05, 0.4)
        for share in np.linspace(-0.5, 0.5, count):
            middle = centre + share * sides[axis] * R[:, axis]
            builder.add_box(middle, bar, appearance, R)


def _add_leaf_cloud(builder: MeshBuilder, centre: np.ndarray, size_m: float) -> None:
    """Add a cloud of leaves, an ellipsoid or a block."""
    rng = builder.rng
    radii = size_m * rng.uniform(0.4, 1.2, 3)
    count = int(rng.integers(100, 1200))
    length_m = size_m * rng.uniform(0.03, 0.2)
    appearance = draw_appearance(rng, size_m)
    is_block = bool(rng.random() < 0.3)
    add_leaves(builder, centre, radii, count, length_m, appearance, is_block)


CLUTTER_SHAPES: dict[str, Callable[[MeshBuilder, np.ndarray, float], None]] = {
    "ball": _add_ball,
    "box": _add_box,
    "card": _add_card,
    "pole": _add_pole,
    "fence": _add_fence,
    "wheel": _add_wheel,
    "lattice": _add_lattice,
    "leaves": _add_leaf_cloud,
}
"""Adds an object of each kind about a point (3,) [m], of a size [m], with random appearance and
proportions."""
_KINDS = ("ball", "box", "box", "card", "pole", "pole", "fence", "wheel", "lattice", "leaves")
"""A kind is repeated in proportion to how often it is drawn."""
