"""Compiled rotations, nearest neighbours, comparison of rays, and sparse convolution."""

from typing import NamedTuple

import numpy as np

from depthpose.pose.compiled import compiled


@compiled
def damp(H, least):
    """Add a little to the diagonal of normal equations: undetermined unknowns stay as they are."""
    size = least
    for k in range(len(H)):
        size = max(size, H[k, k])
    for k in range(len(H)):
        H[k, k] += 1e-9 * size


@compiled
def tukey_weight(square, limit):
    """Give Tukey's weight of a squared distance: 1 at 0, and 0 from the limit on."""
    share = max(0.0, 1 - square / (limit * limit))
    return share * share


@compiled
def rotation(x, y, z, R):
    """Write the rotation by a rotation vector [rad]: Rodrigues' formula."""
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if angle < 1e-4:
        s, c = 1 - square / 6, 0.5 - square / 24
    else:
        s, c = np.sin(angle) / angle, (1 - np.cos(angle)) / square
    R[0, 0], R[1, 1], R[2, 2] = (
        1 - c * (y * y + z * z),
        1 - c * (x * x + z * z),
        1 - c * (x * x + y * y),
    )
    R[0, 1], R[1, 0] = c * x * y - s * z, c * x * y + s * z
    R[0, 2], R[2, 0] = c * x * z + s * y, c * x * z - s * y
    R[1, 2], R[2, 1] = c * y * z - s * x, c * y * z + s * x


Array = np.ndarray
_LEAF = 8  # most points of a range that is not split any more


class Tree(NamedTuple):
    """Points in the order of a balanced k-d tree, whose ranges are halved down to few points."""

    points: Array  #: (m, 3), float64
    order: Array  #: index that each point had before, (m,)
    axes: Array  #: axis across which each inner node is split, (nodes,)
    values: Array  #: coordinate at which it is split, (nodes,)


@compiled
def build_tree(points):
    """Sort points (m, 3), float64 and one at least, into the fields of a :class:`Tree`."""
    count = len(points)
    order = np.arange(count)
    depth = 0
    while (count >> depth) > _LEAF:
        depth += 1
    axes = np.zeros((1 << depth) - 1, np.int64)
    values = np.zeros((1 << depth) - 1)
    for level in range(depth):
        for k in range(1 << level):
            low, high = 0, count
            for bit in range(level - 1, -1, -1):
                if (k >> bit) & 1:
                    low = (low + high) // 2
                else:
                    high = (low + high) // 2
            widest, axis = -1.0, 0
            for c in range(3):
                least, most = np.inf, -np.inf
                for i in range(low, high):
                    value = points[order[i], c]
                    least, most = min(least, value), max(most, value)
                if most - least > widest:
                    widest, axis = most - least, c
            middle = (low + high) // 2
            _select(points, order, low, high - 1, middle, axis)
            node = (1 << level) - 1 + k
            axes[node], values[node] = axis, points[order[middle], axis]
    return points[order], order, axes, values


@compiled
def _select(points, order, low, high, wanted, axis):
    """Partially sort ``order[low:high + 1]`` by a coordinate: rank ``wanted`` gets to its place.

    Quickselect: smaller ones come before it, larger ones after it.
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
def neighbours(
    x, y, z, points, axes, values, places, squares, stack, bounds, outward=None, eye=None, slack=0.0
):
    """Find the points of a tree nearest to (x, y, z), as many as ``places`` holds.

    ``places`` and ``squares`` hold the best so far, nearest first, and are improved: a square is
    the limit where there is none. ``stack`` and ``bounds`` (64 rows) are memory for the search.
    With ``eye``, a camera, only points that face it count (:func:`faces`, with ``slack``).
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
                k = last
                while k > 0 and squares[k - 1] > square:
                    squares[k], places[k] = squares[k - 1], places[k - 1]
                    k -= 1
                squares[k], places[k] = square, place


@compiled
def faces(place, points, outward, eye, least):
    """Whether a surface point shows a camera (``eye``) its outer side.

    ``least`` is the least component toward the camera, below 0 to count those nearly facing it.
    """
    x, y, z = eye[0] - points[place, 0], eye[1] - points[place, 1], eye[2] - points[place, 2]
    return outward[place, 0] * x + outward[place, 1] * y + outward[place, 2] * z >= least


@compiled
def nearest_many(queries, tree):
    """Give the index of the point nearest to each query (n, 3), float64, and its distance."""
    index, distance = np.empty(len(queries), np.int64), np.empty(len(queries))
    stack, bounds = np.empty((64, 3), np.int64), np.empty((64, 4))
    points, order, axes, values = tree
    place, square = np.zeros(1, np.int64), np.empty(1)
    for i in range(len(queries)):
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        a, b, c = points[place[0], 0] - x, points[place[0], 1] - y, points[place[0], 2] - z
        square[0] = a * a + b * b + c * c
        neighbours(x, y, z, points, axes, values, place, square, stack, bounds)
        index[i], distance[i] = order[place[0]], np.sqrt(square[0])
    return index, distance


@compiled
def _cell(x, y, z, scale, column, row, half):
    """Give the index of the cell of a ray; rays far off are in a cell at the border."""
    u = min(max(np.floor(x / z * scale - column), -half), half) + half
    v = min(max(np.floor(y / z * scale - row), -half), half) + half
    return int(u) * (2 * half + 1) + int(v)


@compiled
def compare_rays(cloud, Rs, ts, points, scale, column, row, half, limit):
    """Compute ``look_along_rays`` of ``surface.py`` for each pose.

    ``scale`` is cells per unit of x / z, (``column``, ``row``) the middle cell, ``half`` the cells
    to each side of it, and ``limit`` how far before a point the surface must lie to occlude it.
    """
    violation, unobserved = np.empty(len(ts)), np.empty(len(ts))
    cells = (2 * half + 1) ** 2
    is_observed = np.zeros(cells, np.bool_)
    cloud_cells = np.empty(len(cloud), np.int64)
    for i in range(len(cloud)):
        cloud_cells[i] = _cell(cloud[i, 0], cloud[i, 1], cloud[i, 2], scale, column, row, half)
        is_observed[cloud_cells[i]] = True
    nearest = np.empty(cells)
    for b in range(len(ts)):
        R, t = Rs[b], ts[b]
        nearest[:] = np.inf
        for p in range(len(points)):
            sx, sy, sz = points[p, 0], points[p, 1], points[p, 2]
            z = R[2, 0] * sx + R[2, 1] * sy + R[2, 2] * sz + t[2]
            if z <= 0:
                continue
            x = R[0, 0] * sx + R[0, 1] * sy + R[0, 2] * sz + t[0]
            y = R[1, 0] * sx + R[1, 1] * sy + R[1, 2] * sz + t[1]
            cell = _cell(x, y, max(z, 1e-6), scale, column, row, half)
            nearest[cell] = min(nearest[cell], z)
        total, missed = 0, 0
        for k in range(cells):
            if nearest[k] < np.inf:
                total += 1
                missed += not is_observed[k]
        occluded = 0
        for i in range(len(cloud)):
            occluded += nearest[cloud_cells[i]] < cloud[i, 2] - limit
        violation[b] = occluded / len(cloud) if total else 1.0
        unobserved[b] = missed / total if total else 1.0
    return violation, unobserved


@compiled
def _add_row(out, row, weight):
    """Add ``row @ weight`` to ``out``: four inputs at once, so that each output is loaded once."""
    inputs, outputs = weight.shape
    whole = inputs - inputs % 4
    for c in range(0, whole, 4):
        a, b, e, f = row[c], row[c + 1], row[c + 2], row[c + 3]
        wa, wb, we, wf = weight[c], weight[c + 1], weight[c + 2], weight[c + 3]
        for k in range(outputs):
            out[k] += a * wa[k] + b * wb[k] + e * we[k] + f * wf[k]
    for c in range(whole, inputs):
        a, wa = row[c], weight[c]
        for k in range(outputs):
            out[k] += a * wa[k]


@compiled
def convolve(x, weight, table, is_transposed, out):
    """Convolve sparse rows: ``out[o] += sum over neighbours (i, k) of o of x[i] @ weight[k]``.

    Args:
        x: features of the inputs (rows, channels).
        weight: of each offset k (offsets, inputs, outputs).
        table: row of the fine grid that is the neighbour of each coarse row at each offset, or the
            number of fine rows where there is none (offsets, coarse rows).
        is_transposed: whether the inputs are the coarse rows.
        out: features of the outputs, added to.
    """
    fine = len(out) if is_transposed else len(x)
    for k in range(len(table)):
        kernel = weight[k]
        for coarse in range(table.shape[1]):
            row = table[k, coarse]
            if row < fine:
                if is_transposed:
                    _add_row(out[row], x[coarse], kernel)
                else:
                    _add_row(out[coarse], x[row], kernel)
