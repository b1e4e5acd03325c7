"""Which side of a surface is its outer one, found from the surface alone."""

import numpy as np
from scipy.spatial import KDTree

from depthpose.pose.mesh.sampling import fibonacci_directions

_DIRECTIONS = 32
_CELL = 2.0
"""Side of a ray's cell in mean distances of samples: four samples in each on average."""
_SAME = 0.5
"""Up to so many mean distances from another's plane a sample is of the same sheet."""
_SLANT = 0.3
"""Least cosine at which a sample is looked at."""
_SEEN = 0.1
"""Least share of directions from which an outer side is seen."""
_CLEARER = 0.4
"""The inner side is seen in at most so many times the directions of the outer."""


def cell_of(points: np.ndarray, tree: KDTree) -> float:
    """Give the side of a cell in which a ray finds about four samples of a surface."""
    near = tree.query(points[:: max(1, len(points) // 500)], k=min(5, len(points)))[0][:, -1]
    return _CELL * float(np.median(near)) * np.sqrt(np.pi) / 2


def outward_normals(points: np.ndarray, normals: np.ndarray, cell: float) -> np.ndarray:
    """Turn normals to the side from which the surface is seen from afar.

    What is thinner than half the distance of the samples, open sheets and what is never seen have
    no outer side: their normals become 0.

    Args:
        points: (m, 3), samples of a surface.
        normals: (m, 3), of either side.
        cell: side of a ray's cell.
    """
    seen, looked = np.zeros((2, len(points))), np.full((2, len(points)), 1e-9)
    for axis in fibonacci_directions(_DIRECTIONS).numpy():
        across = np.linalg.svd(axis[None])[2][1:]
        flat = np.floor(points @ across.T / cell).astype(np.int64)
        flat -= flat.min(0)
        place = flat[:, 0] * (flat[:, 1].max() + 1) + flat[:, 1]
        slant = normals @ axis
        order = np.argsort(points @ axis)
        first = np.empty(place.max() + 1, np.int64)
        for way in (1, -1):  # toward a camera in this direction, and in the other
            first[place[order[::way]]] = order[::way]
            front = first[place]
            off = ((points - points[front]) * normals[front]).sum(1)
            is_seen = np.abs(off) < _SAME / _CELL * cell
            for side in (0, 1):
                facing = way * (1 - 2 * side) * slant > _SLANT
                seen[side] += facing & is_seen
                looked[side] += facing
    share = seen / looked
    outer = share.argmax(0)
    is_clear = (share.max(0) > _SEEN) & (share.min(0) < _CLEARER * share.max(0))
    return normals * ((1 - 2 * outer) * is_clear)[:, None]


def across_walls(points: np.ndarray, outward: np.ndarray, limit: float) -> np.ndarray:
    """Give for each sample the number of the nearest one of an opposite side, or -1, (m,).

    Args:
        points: (m, 3).
        outward: (m, 3), of :func:`outward_normals`.
        limit: the thickest wall.
    """
    across, nearest = np.full(len(points), -1), np.full(len(points), np.inf)
    for column, sign in ((c, s) for c in range(3) for s in (1, -1)):
        (own,) = np.nonzero(sign * outward[:, column] > 0.577)
        if len(own) == 0:
            continue
        distance, found = KDTree(points[own]).query(points, distance_upper_bound=limit)
        number = own[np.minimum(found, len(own) - 1)]
        is_opposite = (outward[number] * outward).sum(1) < 0
        is_better = is_opposite & (distance < nearest)
        across = np.where(is_better, number, across)
        nearest = np.where(is_better, distance, nearest)
    return across
