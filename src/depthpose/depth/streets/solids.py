"""Round and leafy bodies: balls, and clouds of leaves."""

from functools import cache

import numpy as np
from jaxtyping import Float, Int

from depthpose.depth.streets.materials import Number, Surface, Values
from depthpose.depth.streets.mesh import MeshBuilder


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
