"""Distances in a plane, to points that fill it densely."""

import numpy as np

from depthpose.pose.compiled.choice import compiled, finite_array
from depthpose.pose.compiled.nearest import Array


def distances_to(them: Array, points: Array, side: float) -> Array:
    """Give the distance of points (m, 2) to the nearest of others (n, 2).

    Args:
        them: one at least.
        points: near them, most of them.
        side: of the cells that the others are sorted into.

    Raises:
        ValueError: one is not finite.
    """
    out = np.empty(len(points))
    _distances(finite_array(them), finite_array(points), side, out)
    return out


@compiled
def _distances(them, points, side, out):
    """Give the distance of each point to the nearest of others.

    Args:
        them: (n, 2), one at least.
        points: (m, 2).
        side: of the cells that these are sorted into.
        out: (m,), written.
    """
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for i in range(len(them)):
        low_x, high_x = min(low_x, them[i, 0]), max(high_x, them[i, 0])
        low_y, high_y = min(low_y, them[i, 1]), max(high_y, them[i, 1])
    side = max(side, (high_x - low_x) / 512, (high_y - low_y) / 512)
    columns, rows = int((high_x - low_x) / side) + 1, int((high_y - low_y) / side) + 1
    starts = np.zeros(columns * rows + 1, np.int64)
    cells = np.empty(len(them), np.int64)
    for i in range(len(them)):
        cells[i] = int((them[i, 0] - low_x) / side) * rows + int((them[i, 1] - low_y) / side)
        starts[cells[i] + 1] += 1
    for k in range(1, len(starts)):
        starts[k] += starts[k - 1]
    filled = starts[:-1].copy()
    ordered = np.empty_like(them)
    for i in range(len(them)):
        ordered[filled[cells[i]]] = them[i]
        filled[cells[i]] += 1
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        column = min(max(int(np.floor((x - low_x) / side)), 0), columns - 1)
        row = min(max(int(np.floor((y - low_y) / side)), 0), rows - 1)
        last = max(column, columns - 1 - column, row, rows - 1 - row)
        best, ring = np.inf, 0
        while ring <= last and (ring < 2 or ((ring - 1) * side) ** 2 <= best):
            for c in range(max(column - ring, 0), min(column + ring, columns - 1) + 1):
                step = 1 if abs(c - column) == ring or ring == 0 else 2 * ring
                r = row - ring
                while r <= row + ring:
                    if 0 <= r < rows:
                        for p in range(starts[c * rows + r], starts[c * rows + r + 1]):
                            a, b = ordered[p, 0] - x, ordered[p, 1] - y
                            best = min(best, a * a + b * b)
                    r += step
            ring += 1
        out[i] = np.sqrt(best)
