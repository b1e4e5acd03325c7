"""Trees, bushes, hedges and the edges of woods: dark cores with clouds of leaves about them.

A model is made once and placed many times, by :func:`mesh.place_model`.
"""

from functools import cache
from itertools import pairwise

import numpy as np

from depthpose.depth.synthetic.materials import Appearance, Color, Number
from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder, Values, quads_between, scale_to_unit
from depthpose.depth.synthetic.randomness import Stream, make_rng


def add_leaves(
    builder: MeshBuilder,
    centre: Values,
    radii: Values,
    count: int,
    length_m: Number,
    appearance: Appearance,
    is_block: bool = False,
) -> None:
    """Add a cloud of triangles that look like leaves or twigs, each of its own shade.

    Args:
        builder: takes the triangles.
        centre: centre of the cloud [m].
        radii: radii of the ellipsoid that they fill, or half sides of the block [m].
        count: number of leaves.
        length_m: mean length of a leaf.
        appearance: appearance of the leaves.
        is_block: fill the surface of a block, as of a clipped hedge, in place of an ellipsoid.
    """
    rng = builder.rng

    # Positions in the unit ball or cube, mostly near its surface, and directions outwards.
    if is_block:
        positions = rng.uniform(-1, 1, (count, 3))
        axis = rng.integers(0, 3, count)
        rows = range(count)
        side = np.sign(positions[rows, axis])
        positions[rows, axis] = side * rng.uniform(0.8, 1.05, count)
        outward = scale_to_unit(positions)
    else:
        outward = scale_to_unit(rng.normal(size=(count, 3)))
        positions = outward * np.sqrt(rng.uniform(0.45, 1, (count, 1)))
    points = positions * np.asarray(radii) + np.asarray(centre)

    # A triangle at each: its base lies along the leaf, its tip across. Leaves tend to lie around
    # the nearly upright axis of the cloud.
    along = scale_to_unit(rng.normal(size=(count, 3)) + 0.7 * np.cross(outward, [0.3, 1, 0.2]))
    across = scale_to_unit(np.cross(along, outward + 0.6 * rng.normal(size=(count, 3))))
    length = length_m * rng.uniform(0.6, 1.4, (count, 1))
    base = points - across * length * 0.3
    half_base = along * length * 0.5
    tip = points + across * length * 0.6
    corners = np.stack([base - half_base, base + half_base, tip], 1)

    shade = rng.uniform(0.55, 1.25, (count, 1)) * (1 + 0.1 * rng.normal(size=(count, 3)))
    uv = rng.uniform(0, 1, (count, 1, 2)) + np.array([[0, 0], [0.3, 0], [0.15, 0.3]])
    normals = scale_to_unit(outward * 0.8 + 0.6 * rng.normal(size=(count, 3)))[:, None]
    builder.add_triangles(corners, uv, appearance, normals, np.asarray(appearance.tint) * shade)


TREE_COUNT = 18
BUSH_COUNT = 8
HEDGE_COUNT = 4
"""Number of different models of each."""
TREE_HEIGHT_M = 10
"""Height of a tree model, about."""

_GREENS: list[Color] = [
    (0.1, 0.16, 0.03), (0.15, 0.2, 0.04), (0.07, 0.12, 0.035), (0.22, 0.2, 0.04), (0.26, 0.14, 0.03)
]  # fmt: skip
_GREEN_SHARES = (0.36, 0.28, 0.2, 0.11, 0.05)
_TREE_LEAVES = ((1400, 0.33), (400, 0.52), (100, 0.85))
_BUSH_LEAVES = ((110, 0.15), (40, 0.22))
"""Number of leaves of a crown and their length [m], from near to far."""
_CONIFER_LAYERS = 9

_BARK: Color = (0.22, 0.18, 0.14)


def draw_leaf_color(rng: np.random.Generator) -> Color:
    """Draw a colour of leaves: mostly greens, some of autumn."""
    base = np.array(_GREENS[rng.choice(len(_GREENS), p=_GREEN_SHARES)])
    red, green, blue = base * rng.uniform(0.7, 1.35) * (1 + 0.06 * rng.normal(size=3))
    return float(red), float(green), float(blue)


@cache
def make_tree(number: int, coarseness: int = 0) -> Mesh:
    """Make tree model ``number``, about 10 m high: of six, four are round, one slim, one a conifer.

    Coarseness 0 is for near trees, 1 for farther ones, 2 for the farthest, with the fewest leaves.
    """
    builder = MeshBuilder(make_rng(Stream.TREE, number))
    leaf_count, leaf_m = _TREE_LEAVES[coarseness]
    kind = number % 6
    if kind == 4:
        _add_conifer(builder, leaf_count, leaf_m)
    else:
        _add_round_tree(builder, leaf_count, leaf_m, is_slim=kind == 5)
    return builder.finish()


def _add_conifer(builder: MeshBuilder, leaf_count: int, leaf_m: float) -> None:
    """Add a straight trunk, and layers of leaves that grow narrower towards the top."""
    rng = builder.rng
    bark = Appearance("bark", _BARK, 1.0, 1)
    builder.add_tube((0, 0.2, 0), (0, -9, 0), (0.22, 0.05), bark, 8)
    for share in np.arange(_CONIFER_LAYERS) / _CONIFER_LAYERS:
        radius_m = rng.uniform(1.8, 2.4) * (1 - share) + 0.25
        centre = (0, -1.2 - 8.6 * share, 0)
        radii = np.array([radius_m, 0.75, radius_m])
        _add_clump(builder, centre, radii, leaf_count // _CONIFER_LAYERS, leaf_m)


def _add_round_tree(builder: MeshBuilder, leaf_count: int, leaf_m: float, *, is_slim: bool) -> None:
    """Add a trunk, and branches that each end in a clump of leaves."""
    rng = builder.rng
    bark = Appearance("bark", _BARK, 1.0, int(rng.integers(2)))
    trunk_m = rng.uniform(2.2, 4.2)
    radius_m = rng.uniform(1.1, 1.5) if is_slim else rng.uniform(2, 3.2)
    trunk_top = np.array([rng.normal(0, 0.2), -trunk_m, rng.normal(0, 0.2)])
    thick_m = rng.uniform(0.13, 0.28)
    builder.add_tube((0, 0.2, 0), trunk_top, (thick_m, thick_m * 0.65), bark, 10)

    # A spiral of clumps around and above the trunk's top, the last one at the tip.
    clump_count = int(rng.integers(6, 11))
    crown_m = TREE_HEIGHT_M - trunk_m - 1.2
    for clump in range(clump_count):
        y = -crown_m * (clump + 0.3) / clump_count
        angle = rng.uniform(0, 6.28)
        out = radius_m * rng.uniform(0.3, 0.75)
        out *= 1 - 0.6 * (clump / clump_count) ** 2
        centre = trunk_top + np.array([out * np.cos(angle), y - 0.4, out * np.sin(angle)])
        builder.add_tube(trunk_top, centre, (thick_m * 0.4, 0.03), bark, 5)
        radii = radius_m * rng.uniform(0.42, 0.68) * np.array([1, rng.uniform(0.7, 0.95), 1])
        _add_clump(builder, centre, radii, leaf_count // clump_count, leaf_m)


def _add_clump(
    builder: MeshBuilder, centre: Values, radii: np.ndarray, leaf_count: int, leaf_m: Number
) -> None:
    """Add a clump of leaves: a dark core that occludes the background, and leaves about it.

    It is grey: a clump gets its colour where its model is placed.
    """
    brightness = builder.rng.uniform(0.8, 1.15)
    dark = 0.3 * brightness
    pale = brightness * 0.7
    core = Appearance("leaf", (dark, dark, dark), 0.9, int(builder.rng.integers(3)))
    level = 1 if leaf_m < 0.4 else 0  # small leaves are those of near clumps
    builder.add_ellipsoid(centre, radii * 0.76, core, level, 0.25)
    leaves = Appearance("leaf", (pale, pale, pale), 0.9, int(builder.rng.integers(3)))
    add_leaves(builder, centre, radii, leaf_count, leaf_m, leaves)


@cache
def make_bush(number: int, coarseness: int = 0) -> Mesh:
    """Make bush model ``number``, about 1 m high and 1.4 m wide; coarseness 1 for far ones."""
    builder = MeshBuilder(make_rng(Stream.BUSH, number))
    rng = builder.rng
    leaf_count, leaf_m = _BUSH_LEAVES[coarseness]
    for _ in range(int(rng.integers(1, 4))):
        radii = np.array([0.55, 0.5, 0.55]) * rng.uniform(0.7, 1.1)
        centre = (rng.normal(0, 0.25), -radii[1] * 0.85, rng.normal(0, 0.25))
        _add_clump(builder, centre, radii, leaf_count, leaf_m)
    return builder.finish()


@cache
def make_hedge(number: int) -> Mesh:
    """Make hedge model ``number``: 4 m along z, 1 m high, 0.7 m wide, clipped."""
    builder = MeshBuilder(make_rng(Stream.HEDGE, number))
    variant = int(builder.rng.integers(3))
    core = Appearance("leaf", (0.42, 0.42, 0.42), 0.8, variant)
    builder.add_box((0, -0.48, 0), (0.6, 0.96, 4.0), core)
    leaves = Appearance("leaf", (0.7, 0.7, 0.7), 0.9, variant)
    add_leaves(builder, (0, -0.5, 0), (0.35, 0.5, 2.0), 420, 0.13, leaves, is_block=True)
    return builder.finish()


_EDGE_STEP_M = 1.5
"""Distance of the points along the edge of a wood."""
_EDGE_LEAF_REACH_M = 80
"""Distance ahead up to which such an edge has single leaves; beyond, they are less than a pixel."""


def add_wood_edge(
    builder: MeshBuilder,
    start: tuple[Number, Number],
    stop: tuple[Number, Number],
    height_m: Number,
) -> None:
    """Add the dark, uneven edge of a dense wood, the background of single trees.

    ``start`` and ``stop`` are its ends: x to the right and s along the road [m].
    """
    rng = builder.rng
    x0, s0 = start
    x1, s1 = stop
    count = max(3, int(np.hypot(x1 - x0, s1 - s0) / _EDGE_STEP_M))
    share = np.linspace(0, 1, count)
    x = x0 + (x1 - x0) * share + rng.normal(0, 0.6, count)
    s = s0 + (s1 - s0) * share + rng.normal(0, 0.3, count)

    # Points of four rows, one above the other, that lean in and out.
    row_y = np.array([0.3, -0.35, -0.75, -1.0]) * height_m  # down: the first is below ground
    lean = rng.normal(0, 0.5, (len(row_y), count))
    y = row_y[:, None] * np.clip(1 + 0.13 * rng.normal(size=count), 0.6, 1.4)
    lean_ahead = 0.5 * lean[::-1]  # the same numbers, of other rows
    points = np.stack([x + lean, y, s + lean_ahead], -1)

    # Dark leaves between each two rows.
    along_m = np.arange(count) * _EDGE_STEP_M
    color = np.array(draw_leaf_color(rng))
    builder.begin_object()
    dark = Appearance("leaf", tuple(0.3 * color), 3.0, int(rng.integers(3)))
    for lower, upper in pairwise(range(len(row_y))):
        uv_m = [np.stack([along_m, -y[row]], 1) for row in (lower, upper)]
        shade = rng.uniform(0.4, 1.3, (count - 1, 1))
        builder.add_quads(
            quads_between(points[lower], points[upper]),
            quads_between(*uv_m),
            dark,
            tint=shade * np.asarray(dark.tint),
        )

    # Single leaves that break its outline, in blocks of four steps.
    leaf = dark._replace(tint=tuple(0.6 * color))
    for first in range(0, count - 4, 4):
        if s[first] < _EDGE_LEAF_REACH_M:
            middle = (x[first + 2], -0.52 * height_m, s[first + 2])
            add_leaves(builder, middle, (1.3, 0.55 * height_m, 3.6), 300, 0.5, leaf, is_block=True)
