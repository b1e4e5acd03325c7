"""A k-d tree of surface points, whose search may be limited to points that face a camera."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from depthpose.pose.compiled import Vector, compiled, dot, minus, vector

Place = int | np.int64  #: of a point, in the order of a tree

_LEAF = 8  # most points of a range that is not split any more
_MOST_WAITING = 64  # ranges that wait to be searched: fewer than the tree has levels


class Tree(NamedTuple):
    """Surface points in the order of a balanced k-d tree, whose ranges are halved down to a few.

    Node ``k`` is split into ``2 k + 1``, of the smaller coordinates, and ``2 k + 2``.
    """

    points: Float64[np.ndarray, "m 3"]  #: of the surface
    outward: Float64[np.ndarray, "m 3"]  #: normals on their outer side, 0 where none is known
    order: Int64[np.ndarray, " m"]  #: index that each point had before
    axes: Int64[np.ndarray, " nodes"]  #: axis across which each node is split
    values: Float64[np.ndarray, " nodes"]  #: coordinate at which it is split


@compiled
def build_tree(points: Float64[np.ndarray, "m 3"], outward: Float64[np.ndarray, "m 3"]) -> Tree:
    """Sort points, one at least, and their normals into a tree."""
    # As many levels as leave a few points to each range of the last one.
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
            axis = _find_widest_axis(points, order, low, high)
            middle = (low + high) // 2
            _select_rank(points, order, low, high - 1, middle, axis)
            node = (1 << level) - 1 + k
            axes[node] = axis
            values[node] = points[order[middle], axis]
    return Tree(points[order], outward[order], order, axes, values)


@compiled
def _find_range(k: int, level: int, count: int) -> tuple[int, int]:
    """Find the range of points of node ``k`` of a level: each bit of ``k`` chooses a half."""
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
    wanted: int,
    axis: int,
) -> None:
    """Partially sort ``order[low:high + 1]`` by a coordinate: rank ``wanted`` gets to its place.

    Quickselect (Hoare 1961): smaller ones come before it, larger ones after it.

    Args:
        points: in any order.
        order: indices of points; changed.
        low: first place of the range that is sorted.
        high: its last place.
        wanted: the rank, as a place in the range.
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
        if wanted <= j:
            high = j
        elif wanted >= i:
            low = i
        else:
            return


@compiled
def faces(
    points: Float64[np.ndarray, "m 3"],
    outward: Float64[np.ndarray, "m 3"],
    place: Place,
    eye: Vector,
    least: float,
) -> bool:
    """Whether a point shows a camera, ``eye``, its outer side.

    Args:
        points: of a tree.
        outward: their normals.
        place: of the point.
        eye: the camera.
        least: the least component of the outward normal along the way to the camera, in units of
            length; below 0 it lets points count that nearly face it, and all at minus infinity.
    """
    return dot(vector(outward, place), minus(eye, vector(points, place))) >= least


@compiled
def square_distance(points: Float64[np.ndarray, "m 3"], place: Place, query: Vector) -> float:
    """Give the squared distance of a point of the tree from another one."""
    way = minus(vector(points, place), query)
    return dot(way, way)


@compiled
def find_nearest_facing(
    query: Vector,
    tree: Tree,
    eye: Vector,
    least: float,
    best: Place,
    best_square: float,
) -> Place:
    """Find the place of the nearest point that faces a camera (:func:`faces`).

    Args:
        query: the point whose neighbour is searched.
        tree: of the points.
        eye: the camera.
        least: how nearly a point must face it (:func:`faces`).
        best: place of a guess, or -1; it is returned where no point is nearer than
            ``best_square``.
        best_square: squared distance of the guess; only points nearer than it are searched.
    """
    points, outward, _, axes, values = tree
    # The ranges that wait: node, first point and one past the last; and how far they are from the
    # query, squared, along each axis and in all.
    ranges = np.empty((_MOST_WAITING, 3), np.int64)
    gaps = np.empty((_MOST_WAITING, 4))
    ranges[0, 0], ranges[0, 1], ranges[0, 2] = 0, 0, len(points)
    gaps[0, :] = 0.0
    waiting = 1
    while waiting > 0:
        waiting -= 1
        node = ranges[waiting, 0]
        low, high = ranges[waiting, 1], ranges[waiting, 2]
        x, y, z = gaps[waiting, 0], gaps[waiting, 1], gaps[waiting, 2]
        square = gaps[waiting, 3]
        if square >= best_square:
            continue

        # Down to the few points beside the query; the other half of each node waits.
        while node < len(axes):
            axis = axes[node]
            middle = (low + high) // 2
            gap = query[axis] - values[node]
            beyond = square - (x if axis == 0 else y if axis == 1 else z) + gap * gap
            is_low = gap < 0
            if beyond < best_square:
                ranges[waiting, 0] = 2 * node + (2 if is_low else 1)
                ranges[waiting, 1] = middle if is_low else low
                ranges[waiting, 2] = high if is_low else middle
                gaps[waiting, 0], gaps[waiting, 1], gaps[waiting, 2] = x, y, z
                gaps[waiting, axis] = gap * gap
                gaps[waiting, 3] = beyond
                waiting += 1
            node = 2 * node + (1 if is_low else 2)
            low, high = (low, middle) if is_low else (middle, high)

        # The points of that last range, one by one.
        for place in range(low, high):
            square = square_distance(points, place, query)
            if square < best_square and faces(points, outward, place, eye, least):
                best, best_square = place, square
    return best


@compiled
def find_nearest_points(queries: Float64[np.ndarray, "n 3"], tree: Tree) -> Int64[np.ndarray, " n"]:
    """Find the index, as it was before sorting, of the point nearest to each query."""
    index = np.empty(len(queries), np.int64)
    anywhere = (0.0, 0.0, 0.0)
    place = np.int64(0)
    for i in range(len(queries)):
        query = vector(queries, i)
        # The answer of the query before is the guess: neighbours in an image lie near each other.
        square = square_distance(tree.points, place, query)
        place = find_nearest_facing(query, tree, anywhere, -np.inf, place, square)
        index[i] = tree.order[place]
    return index
