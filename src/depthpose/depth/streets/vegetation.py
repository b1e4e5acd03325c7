"""Trees, bushes and hedges, as models that are made once and placed many times."""

from functools import cache
from itertools import pairwise

import numpy as np

from depthpose.depth.streets.materials import Color, Number, Surface
from depthpose.depth.streets.mesh import Mesh, MeshBuilder
from depthpose.depth.streets.solids import add_ball, add_leaves

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
    """A dark core that hides what is behind, and leaves about it."""
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
