"""Planes through the nearest neighbours of points."""

import numpy as np

from depthpose.pose.compiled.algebra import jacobi
from depthpose.pose.compiled.choice import compiled, finite_array
from depthpose.pose.compiled.nearest import Array, neighbours, planted


def planes_of(every: Array, some: Array, count: int) -> tuple[Array, Array]:
    """Lay a plane through the ``count`` points of ``every`` nearest to each of ``some``.

    Returns:
        Normals (m, 3) toward the origin, and how bent the cloud is there (m,), 0 to 1.

    Raises:
        ValueError: a point is not finite, or ``count`` is 0.
    """
    if count < 1:
        raise ValueError(f"a plane goes through points, and count is {count}")
    normals, bend = np.empty((len(some), 3)), np.empty(len(some))
    given = (finite_array(a.astype(np.float64, copy=False)) for a in (every, some))
    _lay_planes(*given, count, normals, bend)
    return normals, bend


@compiled
def _lay_planes(every, some, count, normals, bend):
    """Lay a plane through the ``count`` points nearest to each of some.

    Args:
        every: (n, 3), float64.
        some: (m, 3).
        count: of neighbours, n at most.
        normals: (m, 3), written: of unit length, toward the origin.
        bend: (m,), written: 0 flat, 1 as a ball.
    """
    points, _, axes, values = planted(every)
    stack, bounds = np.empty((64, 3), np.int64), np.empty((64, 4))
    places, squares = np.zeros(count, np.int64), np.empty(count)
    A, V = np.empty((3, 3)), np.empty((3, 3))
    mean = np.empty(3)
    for i in range(len(some)):
        x, y, z = some[i, 0], some[i, 1], some[i, 2]
        squares[:] = np.inf
        neighbours(x, y, z, points, axes, values, places, squares, stack, bounds)
        mean[:] = 0.0
        for p in places:
            mean += points[p]
        mean /= count
        A[:] = 0.0
        for p in places:
            for k in range(3):
                for m in range(3):
                    A[k, m] += (points[p, k] - mean[k]) * (points[p, m] - mean[m])
        jacobi(A, V)
        least = 0
        for k in range(1, 3):
            if A[k, k] < A[least, least]:
                least = k
        along = V[0, least] * some[i, 0] + V[1, least] * some[i, 1] + V[2, least] * some[i, 2]
        sign = -1.0 if along > 0 else 1.0
        for k in range(3):
            normals[i, k] = sign * V[k, least]
        total = max(A[0, 0] + A[1, 1] + A[2, 2], 1e-30)
        bend[i] = 3 * max(A[least, least], 0.0) / total
