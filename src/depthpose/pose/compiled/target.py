"""A surface that points seek: what of it lies near each of them."""

from typing import NamedTuple

import numpy as np

from depthpose.pose.compiled.choice import compiled
from depthpose.pose.compiled.nearest import Array, Tree, neighbours, tree_of


class Target(NamedTuple):
    """A surface, and the table by which what is near is looked up without searching.

    Attributes:
        tree: of the surface points.
        normals: of these, in the tree's order, (m, 3).
        low: corner of the table, (3,).
        side: of its boxes.
        counts: boxes along each axis, (3,).
        table: place in the tree of the point nearest to the middle of each box.
    """

    tree: Tree
    normals: Array
    low: Array
    side: float
    counts: Array
    table: Array


def target_of(points: Array, normals: Array, boxes: tuple[Array, float, Array, Array]) -> Target:
    """Prepare a surface once.

    Args:
        points: (m, 3).
        normals: (m, 3).
        boxes: corner, side, counts, and the number of the point nearest to each box.
    """
    low, side, counts, nearest = boxes
    tree = tree_of(points)
    place = np.empty_like(tree.order)
    place[tree.order] = np.arange(len(place))
    table = place[nearest].astype(np.int32)  # half of the memory: it is read at random
    return Target(tree, np.ascontiguousarray(normals[tree.order]), low, side, counts, table)


@compiled
def find_places(local, limit, target, is_exact, places):
    """Find the place of the surface point near each point.

    Args:
        local: (n, 3), in the model frame.
        limit: where the answer is searched, -1 stands for a surface that is farther off.
        target: the surface.
        is_exact: whether the nearest is searched, or looked up.
        places: (n,), written; where it is searched, what was there is where the search begins, and
            -1 for a place that is looked up.
    """
    (points, _, axes, values), _, low, side, counts, table = target
    stack, bounds = np.empty((64, 3), np.int64), np.empty((64, 4))
    found, square = np.empty(1, np.int64), np.empty(1)
    for i in range(len(local)):
        x, y, z = local[i, 0], local[i, 1], local[i, 2]
        place = places[i]
        if not is_exact or place < 0:
            u = min(max(int((x - low[0]) / side), 0), counts[0] - 1)
            v = min(max(int((y - low[1]) / side), 0), counts[1] - 1)
            w = min(max(int((z - low[2]) / side), 0), counts[2] - 1)
            place = table[(u * counts[1] + v) * counts[2] + w]
        if is_exact:
            a, b, c = points[place, 0] - x, points[place, 1] - y, points[place, 2] - z
            found[0], square[0] = place, a * a + b * b + c * c
            if square[0] >= limit * limit:
                found[0], square[0] = -1, limit * limit
            neighbours(x, y, z, points, axes, values, found, square, stack, bounds)
            place = found[0]
        places[i] = place
