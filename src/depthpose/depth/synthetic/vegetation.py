"""Trees, bushes and hedges, and the balls and clouds of leaves that they are made of."""

from functools import cache
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from depthpose.depth.synthetic.materials import Color, Number, Surface, Values
from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder


def add_ball(
    builder: MeshBuilder,
    centre: Values,
    radii_m: Values,
    surface: Surface,
    level: int = 2,
    dents: tuple[np.random.Generator, Number] | None = None,
) -> None:
    """Add an ellipsoid.

    Args:
        builder: what to add to.
        centre: its middle [m].
        radii_m: one radius, or one an axis.
        surface: what covers it.
        level: how often the icosahedron is refined.
        dents: random numbers and the depth of dents, as a share of the radius.
    """
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
    where: tuple[Values, Values],
    leaves: tuple[int, Number],
    surface: Surface,
    is_block: bool = False,
) -> None:
    """Add a cloud of triangles that stand for leaves or twigs.

    Args:
        builder: what to add to.
        rng: random numbers.
        where: centre and radii of an ellipsoid, or of a block [m].
        leaves: how many, and how long one is [m].
        surface: colour and material; every leaf gets a shade of its own.
        is_block: fill the surface of a block, as a clipped hedge, not of an ellipsoid.
    """
    (centre, radii), (count, length_m) = where, leaves
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

    Args:
        number: which model.
        coarseness: 0 to be seen from near, 1 from some 30 m, 2 from far away.
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
        _clump(builder, rng, (centre, radii), (leaves[0] // blobs, leaves[1]))


def _conifer(builder: MeshBuilder, rng: np.random.Generator, leaves: tuple[int, Number]) -> None:
    bark = Surface("bark", _BARK, 1.0, 1)
    builder.tube((0, 0.2, 0), (0, -9, 0), (0.22, 0.05), bark, 8)
    tiers = 9
    for tier in range(tiers):
        share = tier / tiers
        radius_m = rng.uniform(1.8, 2.4) * (1 - share) + 0.25
        radii = np.array([radius_m, 0.75, radius_m])
        _clump(builder, rng, ((0, -1.2 - 8.6 * share, 0), radii), (leaves[0] // tiers, leaves[1]))


def _clump(
    builder: MeshBuilder,
    rng: np.random.Generator,
    where: tuple,
    leaves: tuple[int, Number],
) -> None:
    """A dark core that occludes what is behind, and leaves about it."""
    centre, radii = where
    light = rng.uniform(0.8, 1.15)
    core = Surface("leaf", (0.3 * light, 0.3 * light, 0.3 * light), 0.9, int(rng.integers(3)))
    is_near = leaves[1] < 0.4
    add_ball(builder, centre, np.asarray(radii) * 0.76, core, int(is_near), (rng, 0.25))
    surface = Surface("leaf", (light * 0.7, light * 0.7, light * 0.7), 0.9, int(rng.integers(3)))
    add_leaves(builder, rng, where, leaves, surface)


@cache
def bush(number: int, coarseness: int = 0) -> Mesh:
    """Give bush model ``number``, about 1 m high and 1.4 m wide; coarseness 1 from far away."""
    rng = np.random.default_rng([12, number])
    builder = MeshBuilder()
    for _ in range(int(rng.integers(1, 4))):
        radii = np.array([0.55, 0.5, 0.55]) * rng.uniform(0.7, 1.1)
        centre = (rng.normal(0, 0.25), -radii[1] * 0.85, rng.normal(0, 0.25))
        _clump(builder, rng, (centre, radii), _BUSH_LEAVES[coarseness])
    return builder.finish()


@cache
def hedge(number: int) -> Mesh:
    """Give hedge model ``number``: 4 m along z, 1 m high, 0.7 m wide, clipped."""
    rng = np.random.default_rng([13, number])
    builder = MeshBuilder()
    variant = int(rng.integers(3))
    builder.box((0, -0.48, 0), (0.6, 0.96, 4.0), Surface("leaf", (0.42, 0.42, 0.42), 0.8, variant))
    surface = Surface("leaf", (0.7, 0.7, 0.7), 0.9, variant)
    add_leaves(builder, rng, ((0, -0.5, 0), (0.35, 0.5, 2.0)), (420, 0.13), surface, is_block=True)
    return builder.finish()


def add_wood_edge(
    builder: MeshBuilder,
    rng: np.random.Generator,
    line: tuple[Number, Number, Number, Number],
    height_m: Number,
) -> None:
    """Add the dark, uneven front of a dense wood, which closes the view behind single trees.

    Args:
        builder: what to add to.
        rng: random numbers.
        line: x and s of its start, x and s of its end [m].
        height_m: of the wood, more or less.
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
        places = (np.stack([along, -up[row]], 1) for row in (low, high))
        faces, uv = (
            np.stack([a[:-1], a[1:], c[1:], c[:-1]], 1)
            for a, c in ((points[low], points[high]), tuple(places))
        )
        shade = rng.uniform(0.4, 1.3, (count - 1, 1))
        builder.quads(faces, uv, surface, tint=shade * np.asarray(surface.tint))
    leaf = surface._replace(tint=(0.6 * r, 0.6 * g, 0.6 * b))
    for start in range(0, count - 4, 4):
        if s[start] < 80:  # farther away they would be less than a pixel
            middle, reach = (
                (x[start + 2], -0.52 * height_m, s[start + 2]),
                (1.3, 0.55 * height_m, 3.6),
            )
            add_leaves(builder, rng, (middle, reach), (300, 0.5), leaf, is_block=True)
