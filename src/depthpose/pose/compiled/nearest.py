"""Nearest neighbours in a k-d tree, for points of a surface or of a cloud."""

from typing import NamedTuple

import numpy as np

from depthpose.pose.compiled.choice import compiled, finite_array

Array = np.ndarray
_LEAF = 8
"""Points of a range that is not parted any more."""


class Tree(NamedTuple):
    """Points in the order of a balanced k-d tree, whose ranges are halved down to few points.

    Attributes:
        points: (m, 3), float64.
        order: number that each had before, (m,).
        axes: across which axis each inner node is parted, (nodes,).
        values: where, (nodes,).
    """

    points: Array
    order: Array
    axes: Array
    values: Array


def tree_of(points: Array) -> Tree:
    """Sort points (m, 3) into a tree; one at least, float64.

    Raises:
        ValueError: one is not finite.
    """
    return Tree(*planted(finite_array(points)))


def nearest_of(points: Array, tree: Tree) -> tuple[Array, Array]:
    """Give the number of the point nearest to each of (..., 3), float64, and its distance.

    Raises:
        ValueError: one is not finite.
    """
    queries = finite_array(points).reshape(-1, 3)
    index, distance = np.empty(len(queries), np.int64), np.empty(len(queries))
    _nearest_many(queries, tree, index, distance)
    return index.reshape(points.shape[:-1]), distance.reshape(points.shape[:-1])


@compiled
def planted(points):
    """Give the fields of a :class:`Tree`."""
    count = len(points)
    order = np.arange(count)
    depth = 0
    while (count >> depth) > _LEAF:
        depth += 1
    axes = np.zeros((1 << depth) - 1, np.int64)
    values = np.zeros((1 << depth) - 1)
    for level in range(depth):
        for k in range(1 << level):
            low, high = _range_of(level, k, count)
            axis = _widest(points, order, low, high)
            middle = (low + high) // 2
            _select(points, order, low, high - 1, middle, axis)
            node = (1 << level) - 1 + k
            axes[node], values[node] = axis, points[order[middle], axis]
    return points[order], order, axes, values


@compiled
def _range_of(level, k, count):
    low, high = 0, count
    for bit in range(level - 1, -1, -1):
        middle = (low + high) // 2
        if (k >> bit) & 1:
            low = middle
        else:
            high = middle
    return low, high


@compiled
def _widest(points, order, low, high):
    best, axis = -1.0, 0
    for c in range(3):
        least, most = np.inf, -np.inf
        for i in range(low, high):
            value = points[order[i], c]
            least, most = min(least, value), max(most, value)
        if most - least > best:
            best, axis = most - least, c
    return axis


@compiled
def _select(points, order, low, high, wanted, axis):
    """Bring the one of rank ``wanted`` to its place, smaller ones before it."""
    while low < high:
        pivot = points[order[(low + high) // 2], axis]
        i, j = low, high
        while i <= j:
            while points[order[i], axis] < pivot:
                i += 1
            while points[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if wanted <= j:
            high = j
        elif wanted >= i:
            low = i
        else:
            return


@compiled
def neighbours(
    x, y, z, points, axes, values, places, squares, stack, bounds, outward=None, eye=None, slack=0.0
):
    """Find the places of a tree nearest to a point: as many as ``places`` holds, the nearest first.

    Args:
        x: of the point.
        y: of the point.
        z: of the point.
        points: of the tree.
        axes: of the tree.
        values: of the tree.
        places: (k,), written; what was there stays where nothing is nearer.
        squares: (k,), squared distances of ``places``, ascending: beyond them nothing is wanted.
        stack: (64, 3) whole numbers, memory.
        bounds: (64, 4), memory.
        outward: (m, 3), normals of the places.
        eye: (3,), a camera that a place must face; None: all count.
        slack: of :func:`faces`, which is true from there.
    """
    inner, last, top = len(axes), len(places) - 1, 0
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, 0, len(points)
    bounds[0, :] = 0.0
    while top >= 0:
        node, low, high = stack[top, 0], stack[top, 1], stack[top, 2]
        gx, gy, gz, least = bounds[top, 0], bounds[top, 1], bounds[top, 2], bounds[top, 3]
        top -= 1
        if least >= squares[last]:
            continue
        while node < inner:
            axis, middle = axes[node], (low + high) // 2
            gap = (x if axis == 0 else y if axis == 1 else z) - values[node]
            beyond = least - (gx if axis == 0 else gy if axis == 1 else gz) + gap * gap
            is_low = gap < 0
            if beyond < squares[last]:
                top += 1
                stack[top, 0] = 2 * node + (2 if is_low else 1)
                stack[top, 1], stack[top, 2] = (middle, high) if is_low else (low, middle)
                bounds[top, 0] = gap * gap if axis == 0 else gx
                bounds[top, 1] = gap * gap if axis == 1 else gy
                bounds[top, 2] = gap * gap if axis == 2 else gz
                bounds[top, 3] = beyond
            node = 2 * node + (1 if is_low else 2)
            low, high = (low, middle) if is_low else (middle, high)
        for place in range(low, high):
            a, b, c = points[place, 0] - x, points[place, 1] - y, points[place, 2] - z
            square = a * a + b * b + c * c
            if square < squares[last] and (
                eye is None or faces(place, points, outward, eye, slack)
            ):
                _insert(places, squares, last, place, square)


@compiled
def faces(place, points, outward, eye, least):
    """Whether a surface point shows its outer side to a camera, or nearly."""
    x, y, z = eye[0] - points[place, 0], eye[1] - points[place, 1], eye[2] - points[place, 2]
    return outward[place, 0] * x + outward[place, 1] * y + outward[place, 2] * z >= least


@compiled
def _insert(places, squares, last, place, square):
    """Put a neighbour among the nearest so far."""
    k = last
    while k > 0 and squares[k - 1] > square:
        squares[k], places[k] = squares[k - 1], places[k - 1]
        k -= 1
    squares[k], places[k] = square, place


@compiled
def _nearest_many(queries, tree, index, distance):
    stack, bounds = np.empty((64, 3), np.int64), np.empty((64, 4))
    points, order, axes, values = tree
    place, square = np.zeros(1, np.int64), np.empty(1)
    for i in range(len(queries)):
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        a, b, c = points[place[0], 0] - x, points[place[0], 1] - y, points[place[0], 2] - z
        square[0] = a * a + b * b + c * c
        neighbours(x, y, z, points, axes, values, place, square, stack, bounds)
        index[i], distance[i] = order[place[0]], np.sqrt(square[0])
