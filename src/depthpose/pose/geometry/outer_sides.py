"""The outer side of a surface: that from which more of it is visible, whatever its mesh is like.

Files of models have triangles in either orientation, walls without thickness, and inner surfaces.
"""

from itertools import product

import numpy as np
from scipy.spatial import KDTree

from depthpose.pose.mesh.models import fibonacci_directions

_DIRECTIONS = 32  # axes along which a surface is viewed, from both ends
_CELL_SPACINGS = 2.0  # side of a cell in mean distances of samples: four in each on average
_SHEET_SPACINGS = 0.5  # distance from a sample's plane up to which others are of its sheet
_LEAST_COSINE = 0.3  # least cosine to its normal at which a side of a sample is examined
_LEAST_VISIBLE = 0.1  # least share of directions from which an outer side is visible
_MOST_INNER = 0.4  # largest share for the inner side, over that of the outer side
_LEAST_COMPONENT = 0.577  # 1 / sqrt(3): a unit vector has a component as large, or larger


def find_outer_sides(
    points: np.ndarray, normals: np.ndarray, spacing: float, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Flip normals to the side from which the surface is visible from afar.

    Walls thinner than half the distance of the samples, open sheets and hidden surfaces have no
    outer side: their normals become 0.

    Args:
        points: samples of the surface (n, 3).
        normals: to either side (n, 3).
        spacing: mean distance of neighbouring samples.
        limit: farthest distance to a sample of an opposite side.

    Returns:
        The outward normals (n, 3); and for each sample the index of the nearest one of an opposite
        side, or -1.
    """
    # The outer side is visible from clearly more directions than the inner one.
    share = _measure_visible_shares(points, normals, _CELL_SPACINGS * spacing)
    is_clear = share.max(0) > _LEAST_VISIBLE
    is_clear &= share.min(0) < _MOST_INNER * share.max(0)
    sign = np.where(share.argmax(0) == 0, 1, -1)  # of the outer side
    outward = normals * (sign * is_clear)[:, None]
    across = _find_nearest_opposite(points, outward, limit)
    return outward, across


def _measure_visible_shares(points: np.ndarray, normals: np.ndarray, cell: float) -> np.ndarray:
    """Measure from how many directions each side of each sample is visible.

    Args:
        points: samples of the surface (n, 3).
        normals: to either side (n, 3).
        cell: side of the cells of an image in which samples hide each other.

    Returns:
        The share of the directions that a side faces from which it is visible (2, n); the first
        side is that of the normal.
    """
    visible_count = np.zeros((2, len(points)))
    facing_count = np.full((2, len(points)), 1e-9)
    for axis in fibonacci_directions(_DIRECTIONS).numpy():
        # The cell of each sample in an image across the direction.
        _, _, frame = np.linalg.svd(axis[None])
        pixels = np.floor(points @ frame[1:].T / cell).astype(np.int64)
        column, row = (pixels - pixels.min(0)).T
        cell_of_point = column * (row.max() + 1) + row

        # Visible are the samples in the plane of the one of their cell that is nearest to the
        # camera: of several writes to one place the last stays.
        cosine = normals @ axis
        far_to_near = np.argsort(points @ axis)
        nearest = np.empty(cell_of_point.max() + 1, np.int64)
        for sign in (1, -1):  # a camera in this direction, and in the other
            order = far_to_near[::sign]
            nearest[cell_of_point[order]] = order
            front = nearest[cell_of_point]
            off_plane = ((points - points[front]) * normals[front]).sum(1)
            is_in_front = np.abs(off_plane) < _SHEET_SPACINGS / _CELL_SPACINGS * cell
            for side, side_sign in enumerate((1, -1)):
                is_facing = sign * side_sign * cosine > _LEAST_COSINE
                visible_count[side] += is_facing & is_in_front
                facing_count[side] += is_facing
    return visible_count / facing_count


def _find_nearest_opposite(points: np.ndarray, outward: np.ndarray, limit: float) -> np.ndarray:
    """Find for each sample the nearest one that faces the other way, as through a wall.

    Samples are searched in six groups, of normals that have a large component along an axis, in its
    direction or against it: every normal is in one or more of them.

    Args:
        points: samples of the surface (n, 3).
        outward: their outward normals (n, 3), 0 where none is known.
        limit: farthest distance of such a sample.

    Returns:
        Its index (n,), or -1.
    """
    across = np.full(len(points), -1)
    nearest = np.full(len(points), np.inf)
    for axis, sign in product(range(3), (1, -1)):
        (group,) = np.nonzero(sign * outward[:, axis] > _LEAST_COMPONENT)
        if len(group) == 0:
            continue
        distance, neighbour = KDTree(points[group]).query(points, distance_upper_bound=limit)
        candidate = group[np.minimum(neighbour, len(group) - 1)]
        is_opposite = (outward[candidate] * outward).sum(1) < 0
        is_better = is_opposite & (distance < nearest)
        across = np.where(is_better, candidate, across)
        nearest = np.where(is_better, distance, nearest)
    return across
