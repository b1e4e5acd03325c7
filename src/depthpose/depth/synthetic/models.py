"""Models of what stands beside a road: trees, bushes, hedges, lamps, signs, fences, bins.

Crowns are balls and clouds of leaves. Models are made once and placed often.
"""

from functools import cache
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder, between
from depthpose.depth.synthetic.textures import Color, Number, Surface, Values


def add_ball(
    builder: MeshBuilder,
    centre: Values,
    radii_m: Values,
    surface: Surface,
    level: int = 2,
    dents: tuple[np.random.Generator, Number] | None = None,
) -> None:
    """Add an ellipsoid."""
    directions, faces = _sphere(level)
    radii = np.broadcast_to(np.asarray(radii_m, np.float64), 3)
    swell = np.ones(len(directions))
    if dents is not None:
        rng, depth = dents
        for _ in range(6):
            wave = rng.normal(size=3) * rng.uniform(1.5, 4)
            swell += depth / 3 * np.sin(directions @ wave + rng.uniform(0, 6.28))
    points = directions * swell[:, None] * radii + np.asarray(centre)
    normals = directions / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turn = np.arctan2(directions[:, 0], directions[:, 2])
    uv = np.stack([turn, directions[:, 1]], 1) * radii.mean()
    builder.triangles(points[faces], uv[faces], surface, normals[faces])


def add_leaves(
    builder: MeshBuilder,
    rng: np.random.Generator,
    centre: Values,
    radii: Values,
    count: int,
    length_m: Number,
    surface: Surface,
    is_block: bool = False,
) -> None:
    """Add a cloud of triangles that stand for leaves or twigs.

    Args:
        builder: what to add to.
        rng: random numbers.
        centre: of an ellipsoid, or of a block [m].
        radii: of it, along each axis [m].
        count: how many.
        length_m: how long one is.
        surface: colour and material; every leaf gets a shade of its own.
        is_block: fill the surface of a block, as a clipped hedge, not of an ellipsoid.
    """
    places, outward = (_on_block if is_block else _in_ball)(rng, count)
    points = places * np.asarray(radii) + np.asarray(centre)
    along = _unit(rng.normal(size=(count, 3)) + 0.7 * np.cross(outward, [0.3, 1, 0.2]))
    across = _unit(np.cross(along, outward + 0.6 * rng.normal(size=(count, 3))))
    size = length_m * rng.uniform(0.6, 1.4, (count, 1))
    low, side = points - across * size * 0.3, along * size * 0.5
    corners = np.stack([low - side, low + side, points + across * size * 0.6], 1)
    shade = rng.uniform(0.55, 1.25, (count, 1)) * (1 + 0.1 * rng.normal(size=(count, 3)))
    uv = rng.uniform(0, 1, (count, 1, 2)) + np.array([[0, 0], [0.3, 0], [0.15, 0.3]])
    normals = _unit(outward * 0.8 + 0.6 * rng.normal(size=(count, 3)))[:, None]
    builder.triangles(corners, uv, surface, normals, np.asarray(surface.tint) * shade)


def _in_ball(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    outward = _unit(rng.normal(size=(count, 3)))
    return outward * np.sqrt(rng.uniform(0.45, 1, (count, 1))), outward


def _on_block(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    places = rng.uniform(-1, 1, (count, 3))
    axis = rng.integers(0, 3, count)
    rows = np.arange(count)
    places[rows, axis] = np.sign(places[rows, axis]) * rng.uniform(0.8, 1.05, count)
    return places, _unit(places)


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return vectors / (np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-9)


@cache
def _sphere(level: int) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """An icosahedron whose faces are cut in four, ``level`` times."""
    t = (1 + 5**0.5) / 2
    corners = [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0), (0, -1, t), (0, 1, t),
               (0, -1, -t), (0, 1, -t), (t, 0, -1), (t, 0, 1), (-t, 0, -1), (-t, 0, 1)]  # fmt: skip
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4),
             (11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8),
             (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]  # fmt: skip
    points = _unit(np.array(corners, float))[np.array(faces)]
    for _ in range(level):
        a, b, c = points.transpose(1, 0, 2)
        ab, bc, ca = (_unit(p + q) for p, q in ((a, b), (b, c), (c, a)))
        quarters = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        points = np.concatenate([np.stack(quarter, 1) for quarter in quarters])
    return points.reshape(-1, 3), np.arange(3 * len(points)).reshape(-1, 3)


TREES = 18
BUSHES = 8
HEDGES = 4
"""How many different models there are of each."""

_GREENS: list[Color] = [
    (0.1, 0.16, 0.03), (0.15, 0.2, 0.04), (0.07, 0.12, 0.035), (0.22, 0.2, 0.04), (0.26, 0.14, 0.03)
]  # fmt: skip
_TREE_LEAVES = ((1400, 0.33), (400, 0.52), (100, 0.85))
_BUSH_LEAVES = ((110, 0.15), (40, 0.22))
"""How many leaves a whole crown has, and how long one is [m]: more of them, smaller, when near."""

_BARK: Color = (0.22, 0.18, 0.14)


def leaf_color(rng: np.random.Generator) -> Color:
    """Draw a colour of leaves: mostly greens, some of autumn."""
    base = np.array(_GREENS[rng.choice(5, p=[0.36, 0.28, 0.2, 0.11, 0.05])])
    r, g, b = base * rng.uniform(0.7, 1.35) * (1 + 0.06 * rng.normal(size=3))
    return float(r), float(g), float(b)


@cache
def tree(number: int, coarseness: int = 0) -> Mesh:
    """Give tree model ``number``, about 10 m high: round crowns, columns and conifers.

    Coarseness 0 is to be seen from near, 1 from some 30 m, 2 from far away.
    """
    rng = np.random.default_rng([11, number])
    builder = MeshBuilder()
    kind = number % 6
    leaves = _TREE_LEAVES[coarseness]
    if kind == 4:
        _conifer(builder, rng, leaves)
    else:
        _broadleaf(builder, rng, leaves, is_slim=kind == 5)
    return builder.finish()


def _broadleaf(
    builder: MeshBuilder, rng: np.random.Generator, leaves: tuple[int, Number], is_slim: bool
) -> None:
    bark = Surface("bark", _BARK, 1.0, int(rng.integers(2)))
    trunk_m, radius_m = (
        rng.uniform(2.2, 4.2),
        rng.uniform(1.1, 1.5) if is_slim else rng.uniform(2, 3.2),
    )
    top = np.array([rng.normal(0, 0.2), -trunk_m, rng.normal(0, 0.2)])
    thick_m = rng.uniform(0.13, 0.28)
    builder.tube((0, 0.2, 0), top, (thick_m, thick_m * 0.65), bark, 10)
    blobs = int(rng.integers(6, 11))
    for blob in range(blobs):
        # A ring of clumps around and above the trunk's top, the last one at the tip.
        height = -(10 - trunk_m - 1.2) * (blob + 0.3) / blobs
        turn, out = rng.uniform(0, 6.28), radius_m * rng.uniform(0.3, 0.75)
        out *= 1 - 0.6 * (blob / blobs) ** 2
        centre = top + np.array([out * np.cos(turn), height - 0.4, out * np.sin(turn)])
        builder.tube(top, centre, (thick_m * 0.4, 0.03), bark, 5)
        radii = radius_m * rng.uniform(0.42, 0.68) * np.array([1, rng.uniform(0.7, 0.95), 1])
        _clump(builder, rng, centre, radii, leaves[0] // blobs, leaves[1])


def _conifer(builder: MeshBuilder, rng: np.random.Generator, leaves: tuple[int, Number]) -> None:
    bark = Surface("bark", _BARK, 1.0, 1)
    builder.tube((0, 0.2, 0), (0, -9, 0), (0.22, 0.05), bark, 8)
    tiers = 9
    for tier in range(tiers):
        share = tier / tiers
        radius_m = rng.uniform(1.8, 2.4) * (1 - share) + 0.25
        radii = np.array([radius_m, 0.75, radius_m])
        centre = (0, -1.2 - 8.6 * share, 0)
        _clump(builder, rng, centre, radii, leaves[0] // tiers, leaves[1])


def _clump(
    builder: MeshBuilder,
    rng: np.random.Generator,
    centre: Values,
    radii: Values,
    count: int,
    length_m: Number,
) -> None:
    """A dark core that occludes what is behind, and leaves about it."""
    light = rng.uniform(0.8, 1.15)
    core = Surface("leaf", (0.3 * light, 0.3 * light, 0.3 * light), 0.9, int(rng.integers(3)))
    is_near = length_m < 0.4
    add_ball(builder, centre, np.asarray(radii) * 0.76, core, int(is_near), (rng, 0.25))
    surface = Surface("leaf", (light * 0.7, light * 0.7, light * 0.7), 0.9, int(rng.integers(3)))
    add_leaves(builder, rng, centre, radii, count, length_m, surface)


@cache
def bush(number: int, coarseness: int = 0) -> Mesh:
    """Give bush model ``number``, about 1 m high and 1.4 m wide; coarseness 1 from far away."""
    rng = np.random.default_rng([12, number])
    builder = MeshBuilder()
    for _ in range(int(rng.integers(1, 4))):
        radii = np.array([0.55, 0.5, 0.55]) * rng.uniform(0.7, 1.1)
        centre = (rng.normal(0, 0.25), -radii[1] * 0.85, rng.normal(0, 0.25))
        _clump(builder, rng, centre, radii, *_BUSH_LEAVES[coarseness])
    return builder.finish()


@cache
def hedge(number: int) -> Mesh:
    """Give hedge model ``number``: 4 m along z, 1 m high, 0.7 m wide, clipped."""
    rng = np.random.default_rng([13, number])
    builder = MeshBuilder()
    variant = int(rng.integers(3))
    builder.box((0, -0.48, 0), (0.6, 0.96, 4.0), Surface("leaf", (0.42, 0.42, 0.42), 0.8, variant))
    surface = Surface("leaf", (0.7, 0.7, 0.7), 0.9, variant)
    size = (0.35, 0.5, 2.0)
    add_leaves(builder, rng, (0, -0.5, 0), size, 420, 0.13, surface, is_block=True)
    return builder.finish()


def add_wood_edge(
    builder: MeshBuilder,
    rng: np.random.Generator,
    line: tuple[Number, Number, Number, Number],
    height_m: Number,
) -> None:
    """Add the dark, uneven front of a dense wood, which closes the view behind single trees.

    ``line`` is x and s of its start, then of its end [m].
    """
    x0, s0, x1, s1 = line
    count = max(3, int(np.hypot(x1 - x0, s1 - s0) / 1.5))
    share = np.linspace(0, 1, count)
    x = x0 + (x1 - x0) * share + rng.normal(0, 0.6, count)
    s = s0 + (s1 - s0) * share + rng.normal(0, 0.3, count)
    rows = np.array([0.3, -0.35, -0.75, -1.0]) * height_m
    out = rng.normal(0, 0.5, (len(rows), count))
    up = rows[:, None] * np.clip(1 + 0.13 * rng.normal(size=count), 0.6, 1.4)
    points = np.stack([x + out, up, s + 0.5 * out[::-1]], -1)
    along = np.arange(count) * 1.5
    r, g, b = leaf_color(rng)
    builder.begin_thing()
    surface = Surface("leaf", (0.3 * r, 0.3 * g, 0.3 * b), 3.0, int(rng.integers(3)))
    for low, high in pairwise(range(len(rows))):
        below, above = (np.stack([along, -up[row]], 1) for row in (low, high))
        faces, uv = between(points[low], points[high]), between(below, above)
        shade = rng.uniform(0.4, 1.3, (count - 1, 1))
        builder.quads(faces, uv, surface, tint=shade * np.asarray(surface.tint))
    leaf = surface._replace(tint=(0.6 * r, 0.6 * g, 0.6 * b))
    for start in range(0, count - 4, 4):
        if s[start] < 80:  # farther away they would be less than a pixel
            middle = (x[start + 2], -0.52 * height_m, s[start + 2])
            size = (1.3, 0.55 * height_m, 3.6)
            add_leaves(builder, rng, middle, size, 300, 0.5, leaf, is_block=True)


_GREY = Surface("metal", (0.25, 0.26, 0.27))
_DARK = Surface("metal", (0.03, 0.035, 0.035))
WOOD = Surface("wood", (0.16, 0.12, 0.09))
"""What poles are made of."""

_SIGN_COLORS: list[Color] = [
    (0.5, 0.02, 0.02),
    (0.03, 0.09, 0.4),
    (0.75, 0.75, 0.72),
    (0.6, 0.42, 0.02),
]
FENCE_M = 4.0
"""Length of one piece of fence, along z."""


@cache
def lamp(number: int) -> Mesh:
    """Give a street lamp at the kerb; its arm reaches towards +x."""
    rng = np.random.default_rng([41, number])
    builder = MeshBuilder()
    height = rng.uniform(5, 9)
    pole = (
        Surface("metal", (0.22, 0.23, 0.23))
        if number % 3
        else Surface("concrete", (0.4, 0.39, 0.37))
    )
    builder.tube((0, 0.1, 0), (0, -height, 0), (0.1, 0.055), pole, 10)
    builder.tube((0, 0, 0), (0, -0.9, 0), (0.13, 0.13), pole, 10)
    if number % 2:
        reach = rng.uniform(1.2, 2.4)
        builder.tube((0, -height, 0), (reach, -height - 0.3, 0), (0.045, 0.035), pole)
        builder.box((reach + 0.25, -height - 0.3, 0), (0.7, 0.12, 0.24), _GREY)
    else:
        builder.box((0, -height - 0.2, 0), (0.4, 0.4, 0.4), _GREY, taper=1.5)
    return builder.finish()


@cache
def sign(number: int) -> Mesh:
    """Give a traffic sign whose face looks along -z, to the oncoming camera."""
    rng = np.random.default_rng([42, number])
    builder = MeshBuilder()
    height, radius = rng.uniform(2.1, 2.8), rng.uniform(0.3, 0.42)
    builder.tube((0, 0.1, 0), (0, -height - radius, 0), (0.035, 0.035), _GREY)
    color = _SIGN_COLORS[number % 4]
    face = Surface("sign", (0.8, 0.8, 0.78), 1.0, number)
    if number % 5 == 4:
        wide = rng.uniform(0.8, 2.2)
        board = Surface("sign", color, 1.0, number)
        builder.box((0, -height, -0.05), (wide, 0.7, 0.04), board)
        builder.box(
            (0, -height, -0.075),
            (wide * 0.9, 0.56, 0.02),
            Surface("sign", (0.7, 0.7, 0.68), 0.8, number + 1),
        )
        return builder.finish()
    sides = (20, 3, 4, 8)[number % 4]
    builder.disc((0, -height, -0.045), (0, 0, -1), radius, Surface("metal", color), sides)
    builder.disc((0, -height, -0.055), (0, 0, -1), radius * 0.78, face, sides)
    builder.disc((0, -height, -0.035), (0, 0, 1), radius, _GREY, sides)
    return builder.finish()


@cache
def traffic_light(number: int) -> Mesh:
    """Give a traffic light looking along -z; every second one reaches over the road, to +x."""
    rng = np.random.default_rng([43, number])
    builder = MeshBuilder()
    builder.tube((0, 0.1, 0), (0, -3.4, 0), (0.08, 0.07), _DARK, 10)
    heads = [(0.0, -2.6)]
    if number % 2:
        builder.tube((0, -3.4, 0), (0, -5.6, 0), (0.09, 0.08), _DARK, 10)
        builder.tube((0, -5.6, 0), (4.2, -5.8, 0), (0.07, 0.05), _DARK)
        heads.append((4.0, -5.3))
    lit = int(rng.integers(3))
    for x, y in heads:
        builder.box((x, y, -0.14), (0.34, 0.95, 0.26), _DARK)
        builder.box((x, y, -0.02), (0.5, 1.1, 0.02), _DARK)
        for i, color in enumerate([(0.9, 0.03, 0.02), (0.9, 0.5, 0.03), (0.03, 0.75, 0.25)]):
            glow = 1.0 if i == lit else 0.1
            lens = Surface("lamp", (color[0] * glow, color[1] * glow, color[2] * glow))
            builder.disc((x, y - 0.29 + 0.29 * i, -0.28), (0, 0, -1), 0.105, lens)
    return builder.finish()


@cache
def small_thing(number: int) -> Mesh:
    """Give a bin, a box, a bollard, a guide post, a bench or a bus stop's pillar."""
    rng = np.random.default_rng([44, number])
    builder = MeshBuilder()
    kind = number % 6
    color = tuple(rng.uniform(0.02, 0.3, 3))
    if kind == 0:
        builder.box((0, -0.5, 0), (0.55, 1.0, 0.6), Surface("concrete", color), taper=1.1)
        builder.box((0, -1.03, 0), (0.6, 0.08, 0.66), Surface("concrete", color))
    elif kind == 1:
        builder.box((0, -0.6, 0), (0.5, 1.2, 0.9), Surface("concrete", (0.3, 0.33, 0.3)))
    elif kind == 2:
        builder.tube((0, 0.1, 0), (0, -0.95, 0), (0.06, 0.06), _DARK)
        builder.tube((0, -0.7, 0), (0, -0.82, 0), (0.065, 0.065), Surface("lamp", (0.7, 0.7, 0.7)))
    elif kind == 3:
        builder.box((0, -0.5, 0), (0.12, 1.0, 0.1), Surface("concrete", (0.75, 0.75, 0.74)))
        builder.box((0, -0.82, 0), (0.13, 0.2, 0.11), _DARK)
    elif kind == 4:
        for height in (0.45, 0.75):
            builder.box(
                (0.2 * (height > 0.6), -height, 0),
                (0.35 - 0.3 * (height > 0.6), 0.05 + 0.25 * (height > 0.6), 1.6),
                Surface("wood", (0.25, 0.17, 0.1)),
            )
        for z in (-0.6, 0.6):
            builder.box((0, -0.22, z), (0.3, 0.44, 0.06), _DARK)
    else:
        builder.tube(
            (0, 0, 0),
            (0, -2.9, 0),
            (0.6, 0.6),
            Surface("poster", (0.7, 0.68, 0.62), 1.9, number),
            14,
        )
        builder.tube((0, -2.9, 0), (0, -3.2, 0), (0.66, 0.3), _GREY, 14)
    return builder.finish()


@cache
def fence(number: int) -> Mesh:
    """Give one piece of fence or wall along z: slats, bars, wire, a rail, or a low wall."""
    rng = np.random.default_rng([45, number])
    builder = MeshBuilder()
    kind = number % 5
    ends = np.array([-FENCE_M / 2, FENCE_M / 2])
    if kind == 0:
        wood = Surface("wood", tuple(np.array([0.25, 0.17, 0.1]) * rng.uniform(0.6, 1.6)))
        _bars(builder, wood, (0.02, 1.1, 0.11), 0.16, (0.25, 0.85))
    elif kind == 1:
        _bars(builder, _DARK, (0.02, 1.2, 0.02), 0.14, (0.15, 1.1))
    elif kind == 2:
        green = Surface("metal", (0.04, 0.13, 0.08))
        _bars(builder, green, (0.05, 1.2, 0.05), 2.0, (0.2, 0.45, 0.7, 0.95, 1.15))
    elif kind == 3:
        builder.box((0, -0.6, 0), (0.06, 0.3, FENCE_M), Surface("metal", (0.4, 0.41, 0.42)))
        for z in ends / 2:
            builder.box((0.06, -0.35, z), (0.08, 0.8, 0.12), _GREY)
    else:
        height = rng.uniform(0.6, 1.9)
        stuff = ("brick", "stone", "plaster", "concrete")[(number // 5) % 4]
        tint = (0.35, 0.2, 0.15) if stuff == "brick" else (0.5, 0.47, 0.42)
        builder.box((0, -height / 2, 0), (0.25, height, FENCE_M), Surface(stuff, tint, 2.0, number))
        builder.box(
            (0, -height - 0.04, 0), (0.33, 0.08, FENCE_M), Surface("concrete", (0.45, 0.44, 0.42))
        )
    return builder.finish()


def _bars(
    builder: MeshBuilder,
    surface: Surface,
    bar_m: tuple[Number, Number, Number],
    step_m: Number,
    rails_m: tuple[float, ...],
) -> None:
    for z in np.arange(-FENCE_M / 2, FENCE_M / 2 - 0.01, step_m):
        builder.box((0, -bar_m[1] / 2, z), bar_m, surface)
    for height in rails_m:
        builder.box((0.02, -height, 0), (0.03, 0.05, FENCE_M), surface)


def add_wires(builder: MeshBuilder, start: np.ndarray, stop: np.ndarray) -> None:
    """Hang a cable between two points [m]."""
    share = np.linspace(0, 1, 7)[:, None]
    points = start * (1 - share) + stop * share
    points[:, 1] += (4 * share * (1 - share))[:, 0] * 0.02 * np.linalg.norm(stop - start)
    for a, b in pairwise(points):
        builder.tube(a, b, (0.018, 0.018), _DARK, 3)
