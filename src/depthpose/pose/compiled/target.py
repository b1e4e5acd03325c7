"""A surface that points seek: what of it lies near each of them, or on the ray of each."""

from typing import NamedTuple

import numpy as np

from depthpose.pose.compiled import GRAZING, LOOKED_UP, ON_RAY, SLACK, compiled
from depthpose.pose.compiled.points import Array, Tree, faces, neighbours, tree_of


class Target(NamedTuple):
    """A surface, and the table by which what is near is looked up without searching.

    Attributes:
        tree: of the surface points.
        normals: of these, in the tree's order, (m, 3).
        low: corner of the table, (3,).
        side: of its boxes.
        counts: boxes along each axis, (3,).
        table: place in the tree of the point nearest to the middle of each box.
        outward: normals on the outer side, 0 where none is known, (m, 3).
        across: place of the point on the other side of a wall, or -1, (m,).
        ball: middle and radius; a camera within it sees no side, (4,).
    """

    tree: Tree
    normals: Array
    low: Array
    side: float
    counts: Array
    table: Array
    outward: Array
    across: Array
    ball: Array


def target_of(
    points: Array,
    normals: Array,
    boxes: tuple[Array, float, Array, Array],
    outward: Array,
    across: Array,
    ball: Array,
) -> Target:
    """Prepare a surface once.

    Args:
        points: (m, 3).
        normals: (m, 3).
        boxes: corner, side, counts, and the number of the point nearest to each box.
        outward: (m, 3).
        across: (m,), numbers.
        ball: (4,).
    """
    low, side, counts, nearest = boxes
    tree = tree_of(points)
    place = np.full(len(points) + 1, -1)
    place[tree.order] = np.arange(len(points))
    table = place[nearest].astype(np.int32)  # half of the memory: it is read at random
    normals, outward = (np.ascontiguousarray(a[tree.order]) for a in (normals, outward))
    far = place[across[tree.order]].astype(np.int32)
    return Target(tree, normals, low, side, counts, table, outward, far, ball)


@compiled
def match(cloud, R, t, limit, target, how, local, eye, places):
    """Find for each point of a cloud the place of a surface point that the camera may see.

    Args:
        cloud: (n, 3), in the camera frame.
        R: (3, 3), rotation ``camera_from_model``.
        t: (3,), translation.
        limit: -1 stands for a surface that is farther off, where it is searched.
        target: the surface.
        how: ``LOOKED_UP``, ``SEARCHED`` or ``ON_RAY``.
        local: (n, 3), written: the cloud in the model frame.
        eye: (3,), written: the camera there.
        places: (n,), written; what was there is where a search begins, and the plane that a ray
            meets.
    """
    for c in range(3):
        eye[c] = -(R[0, c] * t[0] + R[1, c] * t[1] + R[2, c] * t[2])
    for i in range(len(cloud)):
        x, y, z = cloud[i, 0] - t[0], cloud[i, 1] - t[1], cloud[i, 2] - t[2]
        for c in range(3):
            local[i, c] = R[0, c] * x + R[1, c] * y + R[2, c] * z
    sought = _meet_planes(local, eye, target, places) if how == ON_RAY else local
    least = _least(eye, target.ball)
    find_places(sought, limit, target, how != LOOKED_UP, places, eye, least)


@compiled
def _least(eye, ball):
    """What :func:`faces` must give; anything where the camera is within the ball."""
    x, y, z = eye[0] - ball[0], eye[1] - ball[1], eye[2] - ball[2]
    distance = np.sqrt(x * x + y * y + z * z)
    return -SLACK * distance if distance > ball[3] else -np.inf


@compiled
def _meet_planes(local, eye, target, places):
    """Give where each ray meets the plane of its sample; a point without one stays."""
    meet = local.copy()
    for i in range(len(local)):
        place = places[i]
        if place < 0:
            continue
        x, y, z = local[i, 0] - eye[0], local[i, 1] - eye[1], local[i, 2] - eye[2]
        mx, my, mz = target.normals[place, 0], target.normals[place, 1], target.normals[place, 2]
        point, slope = target.tree.points[place], mx * x + my * y + mz * z
        if slope * slope > GRAZING * GRAZING * (x * x + y * y + z * z):
            off = mx * (point[0] - local[i, 0])
            off += my * (point[1] - local[i, 1]) + mz * (point[2] - local[i, 2])
            share = off / slope
            meet[i, 0] += share * x
            meet[i, 1] += share * y
            meet[i, 2] += share * z
        else:
            meet[i] = point
    return meet


@compiled
def find_places(local, limit, target, is_exact, places, eye=None, least=0.0):
    """Find the place of the surface point near each point.

    Args:
        local: (n, 3), in the model frame.
        limit: where the answer is searched, -1 stands for a surface that is farther off.
        target: the surface.
        is_exact: whether the nearest is searched, or looked up.
        places: (n,), written; where it is searched, what was there is where the search begins, and
            -1 for a place that is looked up.
        eye: (3,), a camera that must see the point; None: none does.
        least: of :func:`faces`.
    """
    points, axes, values = target.tree.points, target.tree.axes, target.tree.values
    low, side, counts, outward = target.low, target.side, target.counts, target.outward
    stack, bounds = np.empty((64, 3), np.int64), np.empty((64, 4))
    found, square = np.empty(1, np.int64), np.empty(1)
    for i in range(len(local)):
        x, y, z = local[i, 0], local[i, 1], local[i, 2]
        place = places[i]
        if not is_exact or place < 0:
            u = min(max(int((x - low[0]) / side), 0), counts[0] - 1)
            v = min(max(int((y - low[1]) / side), 0), counts[1] - 1)
            w = min(max(int((z - low[2]) / side), 0), counts[2] - 1)
            place = int(target.table[(u * counts[1] + v) * counts[2] + w])
            if eye is not None and not faces(place, points, outward, eye, least):
                place = int(target.across[place])
        if eye is not None and place >= 0 and not faces(place, points, outward, eye, least):
            place = -1
        if is_exact:
            found[0], square[0] = -1, limit * limit
            if place >= 0:
                a, b, c = points[place, 0] - x, points[place, 1] - y, points[place, 2] - z
                if a * a + b * b + c * c < limit * limit:
                    found[0], square[0] = place, a * a + b * b + c * c
            neighbours(
                x, y, z, points, axes, values, found, square, stack, bounds, outward, eye, least
            )
            place = found[0]
        places[i] = place
