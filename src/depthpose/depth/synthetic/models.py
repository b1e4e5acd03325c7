"""Models on and beside a road: trees, hedges, lamps, signs, fences, bins, vehicles and people.

Crowns are balls and clouds of leaves; vehicles are lofted from cross-sections. A model is made once
and placed many times.
"""

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from depthpose.depth.synthetic.mesh import (
    Color,
    Mesh,
    MeshBuilder,
    Number,
    Surface,
    Values,
    between,
)


def add_ball(
    b: MeshBuilder,
    centre: Values,
    radii_m: Values,
    surface: Surface,
    level: int = 2,
    dents: Number = 0.0,
) -> None:
    """Add an ellipsoid: an icosahedron whose faces are divided in four ``level`` times.

    ``dents``: amplitude of random dents, as a share of the radius.
    """
    directions = _make_sphere(level)
    radii = np.broadcast_to(np.asarray(radii_m, np.float64), 3)
    swell = np.ones(len(directions))
    for _ in range(6 if dents else 0):
        wave = b.rng.normal(size=3) * b.rng.uniform(1.5, 4)
        swell += dents / 3 * np.sin(directions @ wave + b.rng.uniform(0, 6.28))
    points = directions * swell[:, None] * radii + np.asarray(centre)
    normals = directions / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turn = np.arctan2(directions[:, 0], directions[:, 2])
    uv = np.stack([turn, directions[:, 1]], 1) * radii.mean()
    points, uv, normals = (x.reshape(-1, 3, x.shape[1]) for x in (points, uv, normals))
    b.triangles(points, uv, surface, normals)


def add_leaves(
    b: MeshBuilder,
    centre: Values,
    radii: Values,
    count: int,
    length_m: Number,
    surface: Surface,
    is_block: bool = False,
) -> None:
    """Add a cloud of triangles that look like leaves or twigs, each of its own shade.

    Args:
        b: adds them.
        centre: centre of the cloud [m].
        radii: radii of the ellipsoid that they fill, or half sides of the block [m].
        count: number of leaves.
        length_m: mean length of a leaf.
        surface: surface of the leaves.
        is_block: fill the surface of a block, as of a clipped hedge, in place of an ellipsoid.
    """
    rng = b.rng
    if is_block:
        places = rng.uniform(-1, 1, (count, 3))
        axis = rng.integers(0, 3, count)
        rows = range(count)
        places[rows, axis] = np.sign(places[rows, axis]) * rng.uniform(0.8, 1.05, count)
        outward = _scale_to_unit(places)
    else:
        outward = _scale_to_unit(rng.normal(size=(count, 3)))
        places = outward * np.sqrt(rng.uniform(0.45, 1, (count, 1)))
    points = places * np.asarray(radii) + np.asarray(centre)
    along = _scale_to_unit(rng.normal(size=(count, 3)) + 0.7 * np.cross(outward, [0.3, 1, 0.2]))
    across = _scale_to_unit(np.cross(along, outward + 0.6 * rng.normal(size=(count, 3))))
    size = length_m * rng.uniform(0.6, 1.4, (count, 1))
    low = points - across * size * 0.3
    side = along * size * 0.5
    corners = np.stack([low - side, low + side, points + across * size * 0.6], 1)
    shade = rng.uniform(0.55, 1.25, (count, 1)) * (1 + 0.1 * rng.normal(size=(count, 3)))
    uv = rng.uniform(0, 1, (count, 1, 2)) + np.array([[0, 0], [0.3, 0], [0.15, 0.3]])
    normals = _scale_to_unit(outward * 0.8 + 0.6 * rng.normal(size=(count, 3)))[:, None]
    b.triangles(corners, uv, surface, normals, np.asarray(surface.tint) * shade)


def _scale_to_unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Scale vectors to length 1."""
    return vectors / (np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-9)


@cache
def _make_sphere(level: int) -> Float[np.ndarray, "n 3"]:
    """Make the corners of a unit sphere's triangles: an icosahedron, divided ``level`` times."""
    t = (1 + 5**0.5) / 2
    corners = [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0), (0, -1, t), (0, 1, t),
               (0, -1, -t), (0, 1, -t), (t, 0, -1), (t, 0, 1), (-t, 0, -1), (-t, 0, 1)]  # fmt: skip
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4),
             (11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8),
             (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]  # fmt: skip
    points = _scale_to_unit(np.array(corners, float))[np.array(faces)]
    for _ in range(level):
        a, b, c = points.transpose(1, 0, 2)
        ab, bc, ca = (_scale_to_unit(p + q) for p, q in ((a, b), (b, c), (c, a)))
        quarters = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        points = np.concatenate([np.stack(quarter, 1) for quarter in quarters])
    return points.reshape(-1, 3)


TREES = 18
TREE_M = 10
"""Height of a tree model, about."""
BUSHES = 8
HEDGES = 4
"""Number of different models of each."""

_GREENS: list[Color] = [
    (0.1, 0.16, 0.03), (0.15, 0.2, 0.04), (0.07, 0.12, 0.035), (0.22, 0.2, 0.04), (0.26, 0.14, 0.03)
]  # fmt: skip
_TREE_LEAVES = ((1400, 0.33), (400, 0.52), (100, 0.85))
_BUSH_LEAVES = ((110, 0.15), (40, 0.22))
"""Number of leaves of a crown and their length [m], from near to far."""

_BARK: Color = (0.22, 0.18, 0.14)


def leaf_color(rng: np.random.Generator) -> Color:
    """Draw a colour of leaves: mostly greens, some of autumn."""
    base = np.array(_GREENS[rng.choice(5, p=[0.36, 0.28, 0.2, 0.11, 0.05])])
    r, g, b = base * rng.uniform(0.7, 1.35) * (1 + 0.06 * rng.normal(size=3))
    return float(r), float(g), float(b)


@cache
def tree(number: int, coarseness: int = 0) -> Mesh:
    """Give tree model ``number``, about 10 m high: round crowns, columns and conifers.

    Coarseness 0 is for near trees, 1 from about 30 m on, 2 for far ones.
    """
    b = MeshBuilder(np.random.default_rng((11, number)))
    rng = b.rng
    kind = number % 6
    leaves, length_m = _TREE_LEAVES[coarseness]
    if kind == 4:  # a conifer
        b.tube((0, 0.2, 0), (0, -9, 0), (0.22, 0.05), Surface("bark", _BARK, 1.0, 1), 8)
        for share in np.arange(9) / 9:
            radius_m = rng.uniform(1.8, 2.4) * (1 - share) + 0.25
            centre = (0, -1.2 - 8.6 * share, 0)
            _add_clump(b, centre, np.array([radius_m, 0.75, radius_m]), leaves // 9, length_m)
        return b.finish()
    bark = Surface("bark", _BARK, 1.0, int(rng.integers(2)))
    trunk_m = rng.uniform(2.2, 4.2)
    radius_m = rng.uniform(1.1, 1.5) if kind == 5 else rng.uniform(2, 3.2)
    top = np.array([rng.normal(0, 0.2), -trunk_m, rng.normal(0, 0.2)])
    thick_m = rng.uniform(0.13, 0.28)
    b.tube((0, 0.2, 0), top, (thick_m, thick_m * 0.65), bark, 10)
    clumps = int(rng.integers(6, 11))
    for clump in range(clumps):
        # A ring of clumps around and above the trunk's top, the last one at the tip.
        height = -(10 - trunk_m - 1.2) * (clump + 0.3) / clumps
        turn = rng.uniform(0, 6.28)
        out = radius_m * rng.uniform(0.3, 0.75)
        out *= 1 - 0.6 * (clump / clumps) ** 2
        centre = top + np.array([out * np.cos(turn), height - 0.4, out * np.sin(turn)])
        b.tube(top, centre, (thick_m * 0.4, 0.03), bark, 5)
        radii = radius_m * rng.uniform(0.42, 0.68) * np.array([1, rng.uniform(0.7, 0.95), 1])
        _add_clump(b, centre, radii, leaves // clumps, length_m)
    return b.finish()


def _add_clump(
    b: MeshBuilder, centre: Values, radii: np.ndarray, count: int, length_m: Number
) -> None:
    """Add a clump of leaves: a dark core that occludes the background, and leaves about it."""
    # Grey: the clump gets its colour where it is placed.
    light = b.rng.uniform(0.8, 1.15)
    dark = 0.3 * light
    pale = light * 0.7
    core = Surface("leaf", (dark, dark, dark), 0.9, int(b.rng.integers(3)))
    add_ball(b, centre, radii * 0.76, core, int(length_m < 0.4), 0.25)
    surface = Surface("leaf", (pale, pale, pale), 0.9, int(b.rng.integers(3)))
    add_leaves(b, centre, radii, count, length_m, surface)


@cache
def bush(number: int, coarseness: int = 0) -> Mesh:
    """Give bush model ``number``, about 1 m high and 1.4 m wide; coarseness 1 for far ones."""
    b = MeshBuilder(np.random.default_rng((12, number)))
    rng = b.rng
    for _ in range(int(rng.integers(1, 4))):
        radii = np.array([0.55, 0.5, 0.55]) * rng.uniform(0.7, 1.1)
        centre = (rng.normal(0, 0.25), -radii[1] * 0.85, rng.normal(0, 0.25))
        _add_clump(b, centre, radii, *_BUSH_LEAVES[coarseness])
    return b.finish()


@cache
def hedge(number: int) -> Mesh:
    """Give hedge model ``number``: 4 m along z, 1 m high, 0.7 m wide, clipped."""
    b = MeshBuilder(np.random.default_rng((13, number)))
    variant = int(b.rng.integers(3))
    b.box((0, -0.48, 0), (0.6, 0.96, 4.0), Surface("leaf", (0.42, 0.42, 0.42), 0.8, variant))
    surface = Surface("leaf", (0.7, 0.7, 0.7), 0.9, variant)
    add_leaves(b, (0, -0.5, 0), (0.35, 0.5, 2.0), 420, 0.13, surface, is_block=True)
    return b.finish()


def add_wood_edge(
    b: MeshBuilder, start: tuple[Number, Number], stop: tuple[Number, Number], height_m: Number
) -> None:
    """Add the dark, uneven edge of a dense wood, the background of single trees.

    Both ends are x and s [m].
    """
    rng = b.rng
    x0, s0 = start
    x1, s1 = stop
    count = max(3, int(np.hypot(x1 - x0, s1 - s0) / 1.5))
    share = np.linspace(0, 1, count)
    x = x0 + (x1 - x0) * share + rng.normal(0, 0.6, count)
    s = s0 + (s1 - s0) * share + rng.normal(0, 0.3, count)

    # Points of four rows, one above the other, that lean in and out.
    rows = np.array([0.3, -0.35, -0.75, -1.0]) * height_m
    out = rng.normal(0, 0.5, (len(rows), count))
    up = rows[:, None] * np.clip(1 + 0.13 * rng.normal(size=count), 0.6, 1.4)
    points = np.stack([x + out, up, s + 0.5 * out[::-1]], -1)

    # Dark leaves between each two rows.
    along = np.arange(count) * 1.5
    color = np.array(leaf_color(rng))
    b.thing += 1
    surface = Surface("leaf", tuple(0.3 * color), 3.0, int(rng.integers(3)))
    for low, high in pairwise(range(len(rows))):
        below, above = (np.stack([along, -up[row]], 1) for row in (low, high))
        shade = rng.uniform(0.4, 1.3, (count - 1, 1))
        tint = shade * np.asarray(surface.tint)
        b.quads(between(points[low], points[high]), between(below, above), surface, tint=tint)

    # Single leaves that break its outline.
    leaf = surface._replace(tint=tuple(0.6 * color))
    for first in range(0, count - 4, 4):
        if s[first] < 80:  # farther away they would be less than a pixel
            middle = (x[first + 2], -0.52 * height_m, s[first + 2])
            add_leaves(b, middle, (1.3, 0.55 * height_m, 3.6), 300, 0.5, leaf, is_block=True)


_GREY = Surface("metal", (0.25, 0.26, 0.27))
_DARK = Surface("metal", (0.03, 0.035, 0.035))
_SIGN_COLORS: list[Color] = [
    (0.5, 0.02, 0.02), (0.03, 0.09, 0.4), (0.75, 0.75, 0.72), (0.6, 0.42, 0.02)
]  # fmt: skip
FENCE_M = 4.0
"""Length of one piece of fence, along z."""


@cache
def lamp(number: int) -> Mesh:
    """Give a street lamp at the kerb; its arm reaches towards +x."""
    b = MeshBuilder(np.random.default_rng((41, number)))
    height = b.rng.uniform(5, 9)
    steel = Surface("metal", (0.22, 0.23, 0.23))
    stone = Surface("concrete", (0.4, 0.39, 0.37))
    pole = steel if number % 3 else stone
    b.tube((0, 0.1, 0), (0, -height, 0), (0.1, 0.055), pole, 10)
    b.tube((0, 0, 0), (0, -0.9, 0), 0.13, pole, 10)
    if number % 2:
        reach = b.rng.uniform(1.2, 2.4)
        b.tube((0, -height, 0), (reach, -height - 0.3, 0), (0.045, 0.035), pole)
        b.box((reach + 0.25, -height - 0.3, 0), (0.7, 0.12, 0.24), _GREY)
    else:
        b.box((0, -height - 0.2, 0), (0.4, 0.4, 0.4), _GREY, taper=1.5)
    return b.finish()


@cache
def sign(number: int) -> Mesh:
    """Give a traffic sign whose face looks along -z, to the oncoming camera."""
    b = MeshBuilder(np.random.default_rng((42, number)))
    height = b.rng.uniform(2.1, 2.8)
    radius = b.rng.uniform(0.3, 0.42)
    b.tube((0, 0.1, 0), (0, -height - radius, 0), 0.035, _GREY)
    color = _SIGN_COLORS[number % 4]
    sides = (20, 3, 4, 8)[number % 4]
    if number % 5 == 4:
        wide = b.rng.uniform(0.8, 2.2)
        b.box((0, -height, -0.05), (wide, 0.7, 0.04), Surface("sign", color, 1.0, number))
        words = Surface("sign", (0.7, 0.7, 0.68), 0.8, number + 1)
        b.box((0, -height, -0.075), (wide * 0.9, 0.56, 0.02), words)
        return b.finish()
    face = Surface("sign", (0.8, 0.8, 0.78), 1.0, number)
    b.disc((0, -height, -0.045), (0, 0, -1), radius, Surface("metal", color), sides)
    b.disc((0, -height, -0.055), (0, 0, -1), radius * 0.78, face, sides)
    b.disc((0, -height, -0.035), (0, 0, 1), radius, _GREY, sides)
    return b.finish()


@cache
def traffic_light(number: int) -> Mesh:
    """Give a traffic light looking along -z; every second one reaches over the road, to +x."""
    b = MeshBuilder(np.random.default_rng((43, number)))
    b.tube((0, 0.1, 0), (0, -3.4, 0), (0.08, 0.07), _DARK, 10)
    heads = [(0.0, -2.6)]
    if number % 2:
        b.tube((0, -3.4, 0), (0, -5.6, 0), (0.09, 0.08), _DARK, 10)
        b.tube((0, -5.6, 0), (4.2, -5.8, 0), (0.07, 0.05), _DARK)
        heads.append((4.0, -5.3))
    lit = int(b.rng.integers(3))
    for x, y in heads:
        b.box((x, y, -0.14), (0.34, 0.95, 0.26), _DARK)
        b.box((x, y, -0.02), (0.5, 1.1, 0.02), _DARK)
        for i, color in enumerate([(0.9, 0.03, 0.02), (0.9, 0.5, 0.03), (0.03, 0.75, 0.25)]):
            lens = Surface("lamp", tuple(np.array(color) * (1.0 if i == lit else 0.1)))
            b.disc((x, y - 0.29 + 0.29 * i, -0.28), (0, 0, -1), 0.105, lens)
    return b.finish()


@cache
def small_thing(number: int) -> Mesh:
    """Give a bin, a box, a bollard, a guide post, a bench or a bus stop's pillar."""
    b = MeshBuilder(np.random.default_rng((44, number)))
    kind = number % 6
    plain = Surface("concrete", tuple(b.rng.uniform(0.02, 0.3, 3)))
    if kind == 0:
        b.box((0, -0.5, 0), (0.55, 1.0, 0.6), plain, taper=1.1)
        b.box((0, -1.03, 0), (0.6, 0.08, 0.66), plain)
    elif kind == 1:
        b.box((0, -0.6, 0), (0.5, 1.2, 0.9), Surface("concrete", (0.3, 0.33, 0.3)))
    elif kind == 2:
        b.tube((0, 0.1, 0), (0, -0.95, 0), 0.06, _DARK)
        b.tube((0, -0.7, 0), (0, -0.82, 0), 0.065, Surface("lamp", (0.7, 0.7, 0.7)))
    elif kind == 3:
        b.box((0, -0.5, 0), (0.12, 1.0, 0.1), Surface("concrete", (0.75, 0.75, 0.74)))
        b.box((0, -0.82, 0), (0.13, 0.2, 0.11), _DARK)
    elif kind == 4:
        wood = Surface("wood", (0.25, 0.17, 0.1))
        b.box((0, -0.45, 0), (0.35, 0.05, 1.6), wood)
        b.box((0.2, -0.75, 0), (0.05, 0.3, 1.6), wood)
        for z in (-0.6, 0.6):
            b.box((0, -0.22, z), (0.3, 0.44, 0.06), _DARK)
    else:
        poster = Surface("poster", (0.7, 0.68, 0.62), 1.9, number)
        b.tube((0, 0, 0), (0, -2.9, 0), 0.6, poster, 14)
        b.tube((0, -2.9, 0), (0, -3.2, 0), (0.66, 0.3), _GREY, 14)
    return b.finish()


@cache
def fence(number: int) -> Mesh:
    """Give one piece of fence or wall along z: slats, bars, wire, a rail, or a low wall."""
    b = MeshBuilder(np.random.default_rng((45, number)))
    rng = b.rng
    kind = number % 5
    if kind < 3:  # size and distance of the bars, heights of the rails [m]
        slats = (0.02, 1.1, 0.11), 0.16, (0.25, 0.85)
        bars = (0.02, 1.2, 0.02), 0.14, (0.15, 1.1)
        wire = (0.05, 1.2, 0.05), 2.0, (0.2, 0.45, 0.7, 0.95, 1.15)
        bar_m, step_m, rails_m = (slats, bars, wire)[kind]
        surface = (_DARK, _DARK, Surface("metal", (0.04, 0.13, 0.08)))[kind]
        if kind == 0:
            surface = Surface("wood", tuple(np.array([0.25, 0.17, 0.1]) * rng.uniform(0.6, 1.6)))
        for z in np.arange(-FENCE_M / 2, FENCE_M / 2 - 0.01, step_m):
            b.box((0, -bar_m[1] / 2, z), bar_m, surface)
        for height in rails_m:
            b.box((0.02, -height, 0), (0.03, 0.05, FENCE_M), surface)
    elif kind == 3:
        b.box((0, -0.6, 0), (0.06, 0.3, FENCE_M), Surface("metal", (0.4, 0.41, 0.42)))
        for z in (-FENCE_M / 4, FENCE_M / 4):
            b.box((0.06, -0.35, z), (0.08, 0.8, 0.12), _GREY)
    else:
        height = rng.uniform(0.6, 1.9)
        stuff = ("brick", "stone", "plaster", "concrete")[(number // 5) % 4]
        tint = (0.35, 0.2, 0.15) if stuff == "brick" else (0.5, 0.47, 0.42)
        b.box((0, -height / 2, 0), (0.25, height, FENCE_M), Surface(stuff, tint, 2.0, number))
        coping = Surface("concrete", (0.45, 0.44, 0.42))
        b.box((0, -height - 0.04, 0), (0.33, 0.08, FENCE_M), coping)
    return b.finish()


class Body(NamedTuple):
    """Shape of a kind of vehicle; positions of its parts are shares of its length and height."""

    size_m: tuple[Number, Number, Number]  # length, width and height
    # of each cross-section: place along the length (rear -0.5), heights of belt line and roof
    stations: tuple[tuple[Number, Number, Number], ...]
    glazed: tuple[int, int]  # first and last cross-section with windows between them
    wheels: tuple[float, ...]  # places of the axles
    share: Number  # share of all vehicles


_HATCH = ((-0.5, 0.4, 0.45), (-0.49, 0.6, 0.62), (-0.45, 0.62, 0.66), (-0.35, 0.62, 0.96),
          (-0.05, 0.62, 1.0), (0.07, 0.62, 0.98), (0.25, 0.61, 0.63), (0.45, 0.52, 0.54),
          (0.49, 0.42, 0.44), (0.5, 0.3, 0.34))  # fmt: skip
_SEDAN = ((-0.5, 0.4, 0.48), (-0.49, 0.62, 0.66), (-0.33, 0.64, 0.68), (-0.19, 0.64, 0.97),
          (-0.04, 0.64, 1.0), (0.07, 0.63, 0.98), (0.24, 0.62, 0.64), (0.45, 0.52, 0.55),
          (0.49, 0.42, 0.45), (0.5, 0.3, 0.34))  # fmt: skip
_WAGON = ((-0.5, 0.4, 0.45), (-0.495, 0.6, 0.63), (-0.47, 0.62, 0.66), (-0.42, 0.62, 0.93),
          (-0.05, 0.62, 1.0), (0.08, 0.62, 0.98), (0.25, 0.61, 0.63), (0.46, 0.52, 0.54),
          (0.49, 0.42, 0.44), (0.5, 0.3, 0.34))  # fmt: skip
_VAN = ((-0.5, 0.5, 0.9), (-0.48, 0.55, 1.0), (-0.46, 0.55, 1.0), (0.12, 0.55, 1.0),
        (0.2, 0.55, 0.98), (0.36, 0.52, 0.56), (0.48, 0.42, 0.46), (0.5, 0.3, 0.34))  # fmt: skip
_BOXY = ((-0.5, 0.5, 0.96), (-0.49, 0.5, 1.0), (0.2, 0.5, 1.0), (0.44, 0.5, 0.97),
         (0.49, 0.46, 0.84), (0.5, 0.3, 0.4))  # fmt: skip

BODIES: dict[str, Body] = {
    "hatch": Body((4.0, 1.72, 1.48), _HATCH, (2, 6), (-0.31, 0.31), 0.32),
    "sedan": Body((4.6, 1.8, 1.44), _SEDAN, (2, 6), (-0.3, 0.31), 0.22),
    "wagon": Body((4.6, 1.8, 1.5), _WAGON, (2, 6), (-0.3, 0.31), 0.2),
    "suv": Body((4.6, 1.9, 1.75), _WAGON, (2, 6), (-0.3, 0.31), 0.1),
    "van": Body((5.1, 1.95, 2.05), _VAN, (2, 5), (-0.31, 0.32), 0.1),
    "lorry": Body((7.4, 2.4, 3.1), _BOXY, (3, 4), (-0.36, 0.36), 0.04),
    "bus": Body((11.0, 2.5, 3.0), _BOXY, (1, 4), (-0.28, 0.3), 0.02),
}
MODELS = 4
"""Number of different models of each kind."""

PAINTS: list[tuple[Color, float]] = [
    ((0.52, 0.53, 0.55), 0.24), ((0.02, 0.02, 0.023), 0.2), ((0.16, 0.17, 0.19), 0.16),
    ((0.8, 0.8, 0.78), 0.15), ((0.35, 0.025, 0.025), 0.08), ((0.03, 0.07, 0.25), 0.08),
    ((0.05, 0.12, 0.07), 0.03), ((0.33, 0.28, 0.2), 0.04), ((0.55, 0.35, 0.03), 0.02),
]  # fmt: skip
_BLACK = Surface("tyre", (0.02, 0.02, 0.022))


@cache
def vehicle(kind: str, number: int) -> Mesh:
    """Give model ``number`` of a kind, white, looking along z."""
    b = MeshBuilder(np.random.default_rng((21, list(BODIES).index(kind), number)))
    body = BODIES[kind]
    size = np.array(body.size_m) * b.rng.uniform(0.95, 1.05, 3)
    shift = np.zeros((len(body.stations), 3))
    shift[2:-2, 0] = b.rng.normal(0, 0.008, len(shift) - 4)
    stations = np.array(body.stations) + shift

    # The body, in rings of nine faces: flanks (0 to 2 and 6 to 8), and the roof between them.
    rings = [_make_ring(station, size) for station in stations]
    for i, (rear, front) in enumerate(pairwise(rings)):
        is_glazed = body.glazed[0] <= i < body.glazed[1]
        is_steep = abs(stations[i + 1, 2] - stations[i, 2]) > 0.2
        for j in range(9):
            face = np.stack([rear[j], rear[j + 1], front[j + 1], front[j]])
            if is_glazed and (j in (2, 6) or (is_steep and j in (3, 4, 5))):
                _add_window(b, face)
            elif j in (3, 4, 5):
                b.quads([face], [np.stack([face[:, 0], face[:, 2]], -1)], Surface("paint"))
            else:
                uv = np.stack([face[:, 2] / size[0] + 0.5, -face[:, 1] / size[2]], -1)
                b.quads([face], [uv], Surface("side", variant=int(size[0] * 100)))
    for ring in (rings[0], rings[-1]):
        hub = np.broadcast_to(ring.mean(0), ring.shape)
        faces = np.stack([hub, ring, np.roll(ring, -1, 0)], 1)
        b.triangles(faces, faces[..., :2], Surface("paint"))

    rim = Surface("wheel", (0.4, 0.41, 0.43), 1.0, number)
    for side in (-1, 1):
        for share in body.wheels:
            _add_wheel(b, size, side, share * size[0], rim)
    _add_trim(b, *size)
    return b.finish()


def _add_window(b: MeshBuilder, face: Float[np.ndarray, "4 3"]) -> None:
    """Add a pane in a dark frame, the four-cornered face of a body; it looks outwards."""
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    b.quads([face], [uv], Surface("tyre", (0.015, 0.015, 0.017)))
    middle = face.mean(0)
    outward = np.cross(face[1] - face[0], face[3] - face[0])
    outward *= 0.006 / (np.linalg.norm(outward) + 1e-9)

    # Towards the outside, by two rules of which the second has the last word: a pane looks up or
    # away from the origin, and away from the middle of its body.
    outward *= 1 if outward @ middle > 0 or outward[1] < 0 else -1
    if outward @ (middle - np.array([0, middle[1] * 0.5, 0])) < 0:
        outward = -outward
    pane = middle + (face - middle) * 0.93 + outward
    b.quads([pane], [uv], Surface("glass", (0.03, 0.035, 0.04)))


def _add_wheel(
    b: MeshBuilder, size: Float[np.ndarray, "3"], side: int, axle_m: Number, rim: Surface
) -> None:
    """Add a wheel in its arch, on the right (1) or the left (-1) side of a body.

    ``size``: length, width and height of the body [m]; ``axle_m``: place of the axle along it.
    """
    radius = 0.31 if size[2] < 2.5 else 0.47
    axis = (side, 0, 0)
    hub = np.array([side * (size[1] / 2 + 0.01), -radius, axle_m])
    b.disc(hub - [side * 0.004, 0.02, 0], axis, radius * 1.18, _BLACK, 16)
    b.tube(hub - [side * 0.22, 0, 0], hub, radius, _BLACK, 16)
    b.disc(hub + np.array([side * 0.003, 0, 0]), axis, radius, _BLACK, 16)
    b.disc(hub + np.array([side * 0.012, 0, 0]), axis, radius * 0.66, rim, 12)


def _make_ring(
    station: Float[np.ndarray, "3"], size: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "10 3"]:
    """Make a cross-section of a vehicle: sill, flank, belt, roof edge and roof of both sides."""
    length, width, height = size
    place = station[0]
    belt = station[1] * height
    roof = station[2] * height
    sill = 0.16 * min(height, 1.8) + 0.03
    half = width / 2 * (1 - 0.1 * abs(2 * place) ** 6)
    lean = 0.8 if height < 1.9 else 0.93
    high = half * lean if roof > belt + 0.1 else half * 0.95
    x = [half * 0.96, half, half * 0.985, high, high * 0.6]
    y = [sill, sill + 0.4 * (belt - sill), belt, roof, roof + 0.012 * height]
    side = [(a, -b, place * length) for a, b in zip(x, y, strict=True)]
    return np.array(side + [(-a, b, c) for a, b, c in reversed(side)])


def _add_trim(b: MeshBuilder, length: float, width: float, height: float) -> None:
    """Add lights, mirrors, plates, bumpers and a tall one's rear window to a vehicle of a size [m].

    It drives along z, its ground is y = 0, and y points down.
    """
    low = min(height, 1.6)  # lights of tall vehicles are no higher than those of a car
    sill = 0.16 * min(height, 1.8) + 0.03  # as the body's lower edge
    white = Surface("lamp", (0.8, 0.81, 0.83))
    red = Surface("lamp", (0.4, 0.02, 0.02))
    b.box((0, -sill + 0.02, 0), (width * 0.9, 0.14, length * 0.94), _BLACK)  # the underbody
    for side in (-1, 1):
        headlight_x = side * width * 0.36
        rear_light_x = side * width * 0.4
        b.box((headlight_x, -0.46 * low, 0.487 * length), (0.32, 0.13, 0.08), white)
        b.box((rear_light_x, -0.55 * low, -0.488 * length), (0.2, 0.22, 0.06), red)
        mirror = (side * (width / 2 + 0.08), -0.66 * min(height, 2), 0.2 * length)
        b.box(mirror, (0.18, 0.13, 0.1), Surface("paint"))
    plate = Surface("plate", (0.8, 0.8, 0.76), 0.52)
    b.box((0, -0.42 * low, -0.502 * length), (0.52, 0.12, 0.03), plate)
    b.box((0, -0.28 * low, 0.503 * length), (0.52, 0.12, 0.03), plate)
    b.box((0, -0.33 * low, 0.495 * length), (width * 0.55, 0.12, 0.04), _BLACK)  # the grille
    b.box((0, -0.24 * low, -0.496 * length), (width * 0.94, 0.16, 0.06), _BLACK)  # rear bumper
    if height > 1.9:  # the rear window of tall vehicles is upright
        pane = Surface("glass", (0.03, 0.03, 0.035))
        where = (0, -0.74 * height, -0.499 * length)
        b.box(where, (width * 0.72, height * 0.28, 0.02), pane)


WALKERS = 10
RIDERS = 5
"""Number of different models of each."""

_SKINS: list[Color] = [(0.5, 0.31, 0.22), (0.42, 0.25, 0.17), (0.2, 0.11, 0.07)]
_RUBBER = Surface("tyre", (0.025, 0.025, 0.028))


@cache
def walker(number: int) -> Mesh:
    """Give a person on foot who faces along z, at a random moment of a step."""
    b = MeshBuilder(np.random.default_rng((31, number)))
    height = b.rng.uniform(1.55, 1.9)
    step = b.rng.uniform(-0.28, 0.28)
    coat = _draw_cloth(b, 0.45)
    trousers = _draw_cloth(b, 0.22)
    for side in (-1, 1):
        foot = (side * 0.1, -0.04, side * step)
        hip = np.array([side * 0.09, -0.48 * height, 0])
        b.tube(foot, hip, (0.06, 0.09), trousers)
        b.box((foot[0], -0.04, foot[2] + 0.05), (0.09, 0.08, 0.26), _RUBBER)
        hand = (side * 0.27, -0.47 * height, -side * step * 0.8)
        b.tube(hand, (side * 0.2, -0.81 * height, 0), (0.045, 0.06), coat)
    hip = np.array([0, -0.48 * height, 0])
    neck = np.array([0, -0.82 * height, 0.02])
    _add_upper_body(b, hip, neck, np.array([0, -0.93 * height, 0.03]), coat)
    if b.rng.random() < 0.4:
        b.box((0.3, -0.4 * height, 0), (0.12, 0.3, 0.34), _draw_cloth(b, 0.4))
    return b.finish()


def _add_bicycle_wheel(b: MeshBuilder, z: float, metal: Surface) -> None:
    """Add a wheel of a bicycle that rides along z: its tyre, its axle and its spokes."""
    angle = np.linspace(0, 2 * np.pi, 19)
    rim = np.stack([0 * angle, -0.34 + 0.33 * np.cos(angle), z + 0.33 * np.sin(angle)], 1)
    for start, stop in pairwise(rim):
        b.tube(start, stop, 0.02, _RUBBER, 4)
    b.tube((-0.05, -0.34, z), (0.05, -0.34, z), 0.03, metal, 5)
    for spoke in rim[:-1:3]:
        b.tube((0, -0.34, z), spoke, 0.005, metal, 3)


@cache
def rider(number: int) -> Mesh:
    """Give a person on a bicycle, riding along z."""
    b = MeshBuilder(np.random.default_rng((32, number)))
    frame = Surface("metal", tuple(b.rng.uniform(0.03, 0.4, 3)))
    for z in (-0.52, 0.52):
        _add_bicycle_wheel(b, z, frame)

    # The frame, its handlebar and its saddle.
    joints = {"rear": (-0.34, -0.52), "front": (-0.34, 0.52), "saddle": (-0.9, -0.2),
              "pedals": (-0.3, -0.02), "head": (-0.86, 0.36), "bar": (-1.05, 0.36)}  # fmt: skip
    links = ("rear saddle", "rear pedals", "pedals saddle", "pedals head", "saddle head",
             "head front", "head bar")  # fmt: skip
    for link in links:
        start, stop = ((0.0, *joints[name]) for name in link.split())
        b.tube(start, stop, 0.022, frame, 5)
    b.tube((-0.28, -1.06, 0.36), (0.28, -1.06, 0.36), 0.016, _RUBBER, 4)
    b.box((0, -0.94, -0.22), (0.16, 0.06, 0.26), _RUBBER)

    # The person: legs on the pedals, hands on the handlebar.
    coat = _draw_cloth(b, 0.45)
    trousers = _draw_cloth(b, 0.22)
    hip = np.array([0, -0.98, -0.22])
    neck = np.array([0, -1.5, 0.02])
    for side in (-1, 1):
        knee = (side * 0.1, -0.68, 0.15)
        pedal = (side * 0.1, -0.28 - 0.13 * side, 0.0)
        b.tube(pedal, knee, (0.05, 0.065), trousers)
        b.tube(knee, hip + np.array([side * 0.08, 0, 0]), (0.065, 0.09), trousers)
        shoulder = neck + np.array([side * 0.18, 0, 0])
        b.tube((side * 0.25, -1.08, 0.42), shoulder, (0.04, 0.055), coat)
    _add_upper_body(b, hip, neck, np.array([0, -1.7, 0.08]), coat)
    return b.finish()


def _add_upper_body(
    b: MeshBuilder, hip: np.ndarray, neck: np.ndarray, head: np.ndarray, coat: Surface
) -> None:
    """Add a trunk with shoulders, sometimes a bag, a neck and a head with hair."""
    middle = (hip + neck) / 2
    b.tube(hip, middle, (0.17, 0.2), coat, 10)
    b.tube(middle, neck, (0.2, 0.16), coat, 10)
    add_ball(b, neck, (0.2, 0.09, 0.13), coat, 1)
    if b.rng.random() < 0.3:
        bag = hip * 0.35 + neck * 0.65 - [0, 0, 0.2]
        b.box(bag, (0.3, 0.42, 0.18), _draw_cloth(b, 0.4))
    skin = Surface("skin", _SKINS[b.rng.integers(len(_SKINS))])
    hair = Surface("cloth", tuple(b.rng.uniform(0.01, 0.25) * np.array([1, 0.8, 0.6])))
    b.tube(head + np.array([0, 0.2, 0]), head, 0.06, skin, 6)
    add_ball(b, head, (0.085, 0.125, 0.1), skin, 2)
    add_ball(b, head - [0, 0.03, 0.02], (0.098, 0.11, 0.105), hair, 2)


def _draw_cloth(b: MeshBuilder, light: Number) -> Surface:
    """Draw a cloth of random colour, no brighter than ``light``."""
    color = b.rng.uniform(0.1, 1, 3) * b.rng.uniform(0.15, 1) * light
    return Surface("cloth", tuple(color), 0.6, int(b.rng.integers(4)))
