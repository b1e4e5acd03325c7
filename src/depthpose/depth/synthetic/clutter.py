"""Clutter: shapes of all kinds and surfaces, floating before a ground, a wall or in a box.

Streets alone teach a matcher what streets look like: upright walls beside a plane. Clutter has
thin, slanted, round, leafy, textureless, repetitive and mirroring things at every distance.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from depthpose.depth.synthetic.materials import Color, Surface, Values
from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder, Rotation
from depthpose.depth.synthetic.scene import Markings, StreetScene, draw_weather
from depthpose.depth.synthetic.vegetation import add_ball, add_leaves

_DEPTHS_M = (3.5, 45.0)
"""Nearest and farthest middle of a thing; with KITTI's rig 110 and 9 px of disparity."""

_PLAIN = ("paint", "skin", "glass", "plaster", "metal")
_RICH = ("pavement", "grass", "brick", "stone", "concrete", "roof", "bark", "leaf", "wood", "side",
         "pane", "plate", "sign", "poster", "cloth", "dirt", "hills")  # fmt: skip
_PLAIN_SHARE = 0.3

_NO_MARKINGS = Markings(
    lines=np.zeros((0, 4)), bars=np.zeros((0, 5)), brightness=0.5, wheel_tracks=(0.0, 3.0)
)


def make_clutter(seed: tuple[int, ...]) -> StreetScene:
    """Make the clutter that belongs to ``seed``.

    Args:
        seed: any whole numbers.
    """
    rng = np.random.default_rng([74, *seed])
    builder = MeshBuilder()
    _BACKDROPS[int(rng.integers(len(_BACKDROPS)))](builder, rng)
    for _ in range(int(rng.integers(12, 60))):
        builder.begin_thing()
        _add_shape(builder, rng)
    return StreetScene(
        mesh=_in_front(builder.finish()),
        markings=_NO_MARKINGS,
        weather=draw_weather(rng),
        camera_from_world=np.eye(3),
        place="clutter",
    )


def _in_front(mesh: Mesh) -> Mesh:
    """Leave out triangles that come nearer than the rig's largest disparity allows."""
    kept = mesh.corners[:, :, 2].min(1) > 0.85 * _DEPTHS_M[0]
    # A backdrop reaches behind the camera; its triangles are large and stay.
    size = np.ptp(mesh.corners, axis=1).max(1)
    return mesh.part(kept | (size > _DEPTHS_M[0]))


def _color(rng: np.random.Generator) -> Color:
    """Any colour, from nearly black to nearly white, mostly pale."""
    grey = float(np.exp(rng.uniform(np.log(0.03), np.log(0.8))))
    r, g, b = np.clip(grey * np.exp(rng.normal(0, rng.choice([0.05, 0.4, 1.0]), 3)), 0.01, 0.9)
    return (float(r), float(g), float(b))


def _surface(rng: np.random.Generator, size_m: float) -> Surface:
    names = _PLAIN if rng.random() < _PLAIN_SHARE else _RICH
    tile_m = size_m * float(np.exp(rng.uniform(np.log(0.15), np.log(3))))
    return Surface(names[int(rng.integers(len(names)))], _color(rng), tile_m, int(rng.integers(8)))


def _rotation(rng: np.random.Generator) -> Rotation:
    """Any rotation, all equally likely."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def _add_shape(builder: MeshBuilder, rng: np.random.Generator) -> None:
    near, far = np.log(_DEPTHS_M)
    z = float(np.exp(rng.uniform(near, far)))
    centre = np.array([rng.uniform(-0.95, 0.95) * z, rng.uniform(-0.3, 0.3) * z, z])
    size_m = min(z, 25.0) * float(np.exp(rng.uniform(np.log(0.03), np.log(0.3))))
    shape = _SHAPES[int(rng.integers(len(_SHAPES)))]
    shape(builder, rng, centre, size_m)


def _ball(b: MeshBuilder, rng: np.random.Generator, centre: np.ndarray, size_m: float) -> None:
    radii = size_m / 2 * rng.uniform(0.5, 1.5, 3)
    dents = (rng, rng.uniform(0, 0.5)) if rng.random() < 0.6 else None
    add_ball(b, centre, radii, _surface(rng, size_m), 3, dents)


def _box(b: MeshBuilder, rng: np.random.Generator, centre: np.ndarray, size_m: float) -> None:
    R = _rotation(rng) if rng.random() < 0.5 else np.eye(3)
    sides = size_m * np.exp(rng.normal(0, 0.6, 3))
    b.box(centre, sides, _surface(rng, size_m), R, rng.uniform(0.4, 1))


def _card(b: MeshBuilder, rng: np.random.Generator, centre: np.ndarray, size_m: float) -> None:
    R = _rotation(rng)
    along, up = R[0] * size_m * rng.uniform(0.5, 2), R[1] * size_m * rng.uniform(0.5, 2)
    b.rectangle(centre - (along + up) / 2, along, up, _surface(rng, size_m))


def _pole(b: MeshBuilder, rng: np.random.Generator, centre: np.ndarray, size_m: float) -> None:
    half = _rotation(rng)[0] * size_m * rng.uniform(0.7, 3)
    if rng.random() < 0.5:
        half = half * [0.05, 1, 0.05]
    radius = size_m * float(np.exp(rng.uniform(np.log(0.01), np.log(0.2))))
    b.tube(centre - half, centre + half, (radius, radius * rng.uniform(0.3, 1)),
           _surface(rng, size_m), 10)  # fmt: skip


def _fence(b: MeshBuilder, rng: np.random.Generator, centre: np.ndarray, size_m: float) -> None:
    """Bars side by side: what repeats has many matches."""
    turn = rng.uniform(-0.8, 0.8)
    along = np.array([np.cos(turn), 0, np.sin(turn)]) * size_m * rng.uniform(1, 3)
    up = np.array([0, size_m / 2, 0])
    surface = _surface(rng, size_m)
    count = int(rng.integers(4, 20))
    radius = float(np.linalg.norm(along)) / count * rng.uniform(0.05, 0.3)
    for share in np.linspace(-0.5, 0.5, count):
        b.tube(centre + share * along - up, centre + share * along + up, (radius, radius), surface)
    for height in (-0.8, 0.8):
        ends = centre + height * up - along / 2, centre + height * up + along / 2
        b.tube(*ends, (radius, radius), surface)


def _wheel(b: MeshBuilder, rng: np.random.Generator, centre: np.ndarray, size_m: float) -> None:
    """A rim with spokes: what lies behind is seen through the gaps."""
    R = _rotation(rng) if rng.random() < 0.5 else np.eye(3)
    surface = _surface(rng, size_m)
    radius = size_m * rng.uniform(0.5, 1.2)
    angles = np.linspace(0, 2 * np.pi, 25)
    rim = centre + radius * (np.cos(angles)[:, None] * R[0] + np.sin(angles)[:, None] * R[1])
    thick = radius * rng.uniform(0.03, 0.2)
    for start, end in pairwise(rim):
        b.tube(start, end, (thick, thick), surface, 6)
    thin = radius * rng.uniform(0.01, 0.08)
    for place in np.linspace(0, 24, int(rng.integers(3, 14)), endpoint=False).astype(int):
        b.tube(centre, rim[place], (thin * rng.uniform(1, 2), thin), surface, 6)


def _lattice(b: MeshBuilder, rng: np.random.Generator, centre: np.ndarray, size_m: float) -> None:
    """Flat bars that cross, as shelves, window frames and the backs of benches do."""
    R = _rotation(rng) if rng.random() < 0.3 else np.eye(3)
    sides = size_m * rng.uniform(0.6, 2.5, 2)
    surface, deep = _surface(rng, size_m), size_m * float(np.exp(rng.uniform(-4, 0)))
    for axis in (0, 1):
        count = int(rng.integers(2, 8))
        wide = sides[axis] / count * rng.uniform(0.05, 0.4)
        for share in np.linspace(-0.5, 0.5, count):
            bar = np.array([*sides, deep])
            bar[axis] = wide
            b.box(centre + share * sides[axis] * R[:, axis], bar, surface, R)


def _leaves(b: MeshBuilder, rng: np.random.Generator, centre: np.ndarray, size_m: float) -> None:
    radii = size_m * rng.uniform(0.4, 1.2, 3)
    leaves = int(rng.integers(100, 1200)), size_m * rng.uniform(0.03, 0.2)
    add_leaves(b, rng, (centre, radii), leaves, _surface(rng, size_m), bool(rng.random() < 0.3))


_SHAPES: tuple[Callable[[MeshBuilder, np.random.Generator, np.ndarray, float], None], ...] = (
    _ball, _box, _box, _card, _pole, _pole, _fence, _wheel, _lattice, _leaves,
)  # fmt: skip


def _ground(builder: MeshBuilder, rng: np.random.Generator) -> None:
    """A plane below, somewhat aslant, and the sky."""
    y, slope = rng.uniform(1.0, 3.0), rng.normal(0, 0.02)
    _sheet(builder, rng, [-150, y, 0], [300, rng.normal(0, 8), 0], [0, slope * 300, 300])


def _wall(builder: MeshBuilder, rng: np.random.Generator) -> None:
    """A plane across the view, turned to either side, and a ground."""
    turn, z = rng.uniform(-0.9, 0.9), rng.uniform(18, 60)
    along = np.array([np.cos(turn), rng.normal(0, 0.1), np.sin(turn)]) * 300
    _sheet(builder, rng, np.array([0, 20, z]) - along / 2, along, [0, -40, rng.normal(0, 10)])
    _ground(builder, rng)


def _box_inside(builder: MeshBuilder, rng: np.random.Generator) -> None:
    """Four walls and a floor, with a ceiling or without."""
    half, depth = rng.uniform(3, 14), rng.uniform(8, 45)
    floor, top = rng.uniform(1, 3), rng.uniform(-6, -2)
    height = floor - top
    _sheet(builder, rng, [-half, floor, 0], [2 * half, 0, 0], [0, 0, depth])
    _sheet(builder, rng, [-half, floor, depth], [2 * half, 0, 0], [0, -height, 0])
    for x in (-half, half):
        _sheet(builder, rng, [x, floor, 0], [0, 0, depth], [0, -height, 0])
    if rng.random() < 0.6:
        _sheet(builder, rng, [-half, top, 0], [2 * half, 0, 0], [0, 0, depth])


_BACKDROPS = (_ground, _wall, _box_inside)


def _sheet(
    builder: MeshBuilder,
    rng: np.random.Generator,
    corner: Values,
    along: Values,
    up: Values,
) -> None:
    builder.begin_thing()
    builder.rectangle(corner, along, up, _surface(rng, rng.uniform(0.5, 4)))
