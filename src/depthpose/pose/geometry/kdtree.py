"""A k-d tree of surface points, whose search may be limited to points that face a camera."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from depthpose.pose.compiled import Vector, compiled, dot, minus, vector

TreePlace = int | np.int64  #: row of a point in the arrays of a tree

_LEAF = 8  # mean number of points of a range, rounded down, at which no more ranges are split
_MOST_WAITING = 64  # ranges that wait to be searched, one a level: no tree has as many levels


class Tree(NamedTuple):
    """Surface points in the order of a balanced k-d tree, whose nodes are ranges of the points.

    Node ``k`` is split at its middle point into ``2 k + 1``, with the smaller coordinates, and
    ``2 k + 2``. Node 0 holds all points, the last ones a few each.
    """

    points: Float64[np.ndarray, "m 3"]  #: of the surface
    outward: Float64[np.ndarray, "m 3"]  #: outward normals, 0 where the outer side is not known
    order: Int64[np.ndarray, " m"]  #: index of each point before it was sorted
    axes: Int64[np.ndarray, " nodes"]  #: axis across which each node is split
    values: Float64[np.ndarray, " nodes"]  #: coordinate along this axis at which it is split


@compiled
def build_tree(points: Float64[np.ndarray, "m 3"], outward: Float64[np.ndarray, "m 3"]) -> Tree:
    """Build a tree of points, one at least, and their outward normals."""
    # As many levels as leave ``_LEAF`` points to a range of the last one in the mean, rounded down:
    # some hold one more (17 points are split into 8 and 9).
    count = len(points)
    order = np.arange(count)
    depth = 0
    while (count >> depth) > _LEAF:
        depth += 1
    axes = np.zeros((1 << depth) - 1, np.int64)
    values = np.zeros((1 << depth) - 1)

    # Each range is split at the middle of its points, across its longest side.
    for level in range(depth):
        for k in range(1 << level):
            low, high = _find_range(k, level, count)
            middle = (low + high) // 2
            axis = _find_widest_axis(points, order, low, high)
            _select_rank(points, order, low, high - 1, middle, axis)
            node = (1 << level) - 1 + k  # after the 2^level - 1 nodes of the levels above
            axes[node] = axis
            values[node] = points[order[middle], axis]
    return Tree(points[order], outward[order], order, axes, values)


@compiled
def _find_range(k: int, level: int, count: int) -> tuple[int, int]:
    """Find the first point and one past the last of the ``k``-th node of a level.

    The bits of ``k``, the highest first, choose the lower (0) or the upper half of a range.
    """
    low, high = 0, count
    for bit in range(level - 1, -1, -1):
        if (k >> bit) & 1:
            low = (low + high) // 2
        else:
            high = (low + high) // 2
    return low, high


@compiled
def _find_widest_axis(
    points: Float64[np.ndarray, "m 3"], order: Int64[np.ndarray, " m"], low: int, high: int
) -> int:
    """Find the axis along which the points ``order[low:high]`` extend farthest."""
    widest = -1.0
    axis = 0
    for c in range(3):
        least, most = np.inf, -np.inf
        for i in range(low, high):
            least = min(least, points[order[i], c])
            most = max(most, points[order[i], c])
        if most - least > widest:
            widest = most - least
            axis = c
    return axis


@compiled
def _select_rank(
    points: Float64[np.ndarray, "m 3"],
    order: Int64[np.ndarray, " m"],
    low: int,
    high: int,
    rank: int,
    axis: int,
) -> None:
    """Partially sort ``order[low:high + 1]`` by a coordinate, in place, about the entry ``rank``.

    Smaller ones come before this entry, larger ones after it: quickselect (Hoare 1961).

    Args:
        points: in any order.
        order: indices of points; changed.
        low: first place of the range that is sorted.
        high: its last place.
        rank: place in ``order`` whose entry is then that of the sorted range.
        axis: of the coordinate.
    """
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
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            return


@compiled
def faces_camera(
    points: Float64[np.ndarray, "m 3"],
    outward: Float64[np.ndarray, "m 3"],
    place: TreePlace,
    eye: Vector,
    least: float,
) -> bool:
    """Whether a point shows a camera its outer side: ``outward . (eye - point) >= least``.

    Args:
        points: of a tree.
        outward: their outward normals.
        place: of the point.
        eye: centre of the camera.
        least: 0: the outer side is seen; below 0 points count too that nearly face the camera, at
            minus infinity all.
    """
    to_camera = minus(eye, vector(points, place))
    return dot(vector(outward, place), to_camera) >= least


@compiled
def square_distance(points: Float64[np.ndarray, "m 3"], place: TreePlace, query: Vector) -> float:
    """Compute the squared distance of a point of the tree from a query point."""
    offset = minus(vector(points, place), query)
    return dot(offset, offset)


@compiled
def find_nearest_facing(
    query: Vector,
    tree: Tree,
    eye: Vector,
    least: float,
    best: TreePlace,
    best_square: float,
) -> TreePlace:
    """Find the place of the nearest point that faces a camera (:func:`faces_camera`).

    The tree is searched depth first. The distance of the query from the box of a node follows from
    that of the node above, since they differ along one axis (Arya and Mount 1993).

    Args:
        query: the point whose neighbour is searched.
        tree: of the points.
        eye: centre of the camera.
        least: how nearly a point must face it (:func:`faces_camera`).
        best: place of a guess, or -1.
        best_square: squared distance of the guess; only points nearer than it are searched.

    Returns:
        The place of the nearest point; ``best`` where none is nearer than ``best_square``.
    """
    points, outward, _, axes, values = tree
    # A stack of the ranges that wait: the node, its first point and one past its last; and the
    # squared distance of the query from the box of the node, along x, y and z, and their sum.
    ranges = np.empty((_MOST_WAITING, 3), np.int64)
    square_gaps = np.empty((_MOST_WAITING, 4))
    ranges[0, 0], ranges[0, 1], ranges[0, 2] = 0, 0, len(points)
    square_gaps[0, :] = 0.0
    waiting = 1
    while waiting > 0:
        waiting -= 1
        node = ranges[waiting, 0]
        low, high = ranges[waiting, 1], ranges[waiting, 2]
        x, y, z = square_gaps[waiting, 0], square_gaps[waiting, 1], square_gaps[waiting, 2]
        box_square = square_gaps[waiting, 3]
        if box_square >= best_square:
            continue

        # Down to the range about the query, by the half of each node on its side.
        while node < len(axes):
            axis = axes[node]
            middle = (low + high) // 2
            gap = query[axis] - values[node]
            if gap < 0:
                near, far = 2 * node + 1, 2 * node + 2
                far_low, far_high = middle, high
                high = middle
            else:
                near, far = 2 * node + 2, 2 * node + 1
                far_low, far_high = low, middle
                low = middle

            # The other half waits if it may hold a nearer point. Along the axis of the split it is
            # as far as the split, along the others as far as the node.
            along_axis = x if axis == 0 else y if axis == 1 else z
            far_square = box_square - along_axis + gap * gap
            if far_square < best_square:
                ranges[waiting, 0], ranges[waiting, 1], ranges[waiting, 2] = far, far_low, far_high
                square_gaps[waiting, 0], square_gaps[waiting, 1] = x, y
                square_gaps[waiting, 2], square_gaps[waiting, 3] = z, far_square
                square_gaps[waiting, axis] = gap * gap
                waiting += 1
            node = near

        # The points of that last range, one by one.
        for place in range(low, high):
            square = square_distance(points, place, query)
            if square < best_square and faces_camera(points, outward, place, eye, least):
                best, best_square = place, square
    return best


@compiled
def find_nearest_points(queries: Float64[np.ndarray, "n 3"], tree: Tree) -> Int64[np.ndarray, " n"]:
    """Find the point nearest to each query, facing anywhere; its index as it was before sorting."""
    index = np.empty(len(queries), np.int64)
    eye = (0.0, 0.0, 0.0)  # of no account: at a least of minus infinity every point faces it
    place = np.int64(0)
    for i in range(len(queries)):
        query = vector(queries, i)
        # The guess is the neighbour of the query before: queries in a row lie near each other.
        square = square_distance(tree.points, place, query)
        place = find_nearest_facing(query, tree, eye, -np.inf, place, square)
        index[i] = tree.order[place]
    return index
