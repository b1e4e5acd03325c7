"""Steps of point-to-plane ICP, and of a scale: the formulas of pose.icp and pose.identity."""

from typing import NamedTuple

import numpy as np

from depthpose.pose.compiled import GRAZING, SLACK, compiled
from depthpose.pose.compiled.points import (
    Array,
    Tree,
    damp,
    faces,
    neighbours,
    rotation,
    tukey_weight,
)


class Target(NamedTuple):
    """A surface for compiled functions, with a table of near points to look up without a search."""

    tree: Tree  #: of the surface points
    normals: Array  #: of these, in the tree's order, (m, 3)
    low: Array  #: corner of the table, (3,)
    side: float  #: of its boxes
    counts: Array  #: boxes along each axis, (3,)
    table: Array  #: place in the tree of the point nearest to the middle of each box
    outward: Array  #: normals on the outer side, 0 where none is known, (m, 3)
    across: Array  #: place of the point on the other side of a wall, or -1, (m,)
    ball: Array  #: middle and radius; a camera within it sees no side, (4,)


@compiled
def _meet_planes(local, eye, target, places):
    """Give where the ray of each point meets the plane of its sample.

    The sample itself where the ray grazes the plane; the point where it has no sample.
    """
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
            meet[i, 0], meet[i, 1], meet[i, 2] = point[0], point[1], point[2]
    return meet


@compiled
def find_places(local, limit, target, is_exact, places, eye=None, least=0.0):
    """Write the place in the tree of the surface point near each point into ``places``.

    Exactly, the nearest within ``limit``, or -1; else the one of the table. With ``eye``, a camera,
    only points that show it their outer side count (:func:`faces`). Exact searches begin from
    what ``places`` holds, -1 for no guess.
    """
    points, axes, values = target.tree.points, target.tree.axes, target.tree.values
    low, side, counts, outward = target.low, target.side, target.counts, target.outward
    stack, bounds = np.empty((64, 3), np.int64), np.empty((64, 4))
    nearest, square = np.empty(1, np.int64), np.empty(1)
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
            nearest[0], square[0] = -1, limit * limit
            if place >= 0:
                a, b, c = points[place, 0] - x, points[place, 1] - y, points[place, 2] - z
                if a * a + b * b + c * c < limit * limit:
                    nearest[0], square[0] = place, a * a + b * b + c * c
            neighbours(
                x, y, z, points, axes, values, nearest, square, stack, bounds, outward, eye, least
            )
            place = nearest[0]
        places[i] = place


@compiled
def _write_equations(local, places, R, arm, limit, points, normals, eye, is_along_rays, H, b):
    """Write the normal equations of one pose, ``H @ motion = b``, about the middle of the cloud.

    ``arm`` is the translation of the pose less that middle; otherwise as ``_normal_equations`` of
    ``icp.py``, with the cloud and the camera (``eye``) in the model frame.
    """
    H[:] = 0.0
    b[:] = 0.0
    J = np.empty(6)
    for i in range(len(local)):
        place = places[i]
        if place < 0:
            continue
        px, py, pz = points[place, 0], points[place, 1], points[place, 2]
        mx, my, mz = normals[place, 0], normals[place, 1], normals[place, 2]
        gx, gy, gz = local[i, 0] - px, local[i, 1] - py, local[i, 2] - pz
        residual = mx * gx + my * gy + mz * gz
        square = gx * gx + gy * gy + gz * gz
        if is_along_rays:
            x, y, z = local[i, 0] - eye[0], local[i, 1] - eye[1], local[i, 2] - eye[2]
            along = gx * x + gy * y + gz * z
            square += residual * residual - along * along / (x * x + y * y + z * z)
        weight = tukey_weight(square, limit)
        if weight <= 0:
            continue
        nx = R[0, 0] * mx + R[0, 1] * my + R[0, 2] * mz
        ny = R[1, 0] * mx + R[1, 1] * my + R[1, 2] * mz
        nz = R[2, 0] * mx + R[2, 1] * my + R[2, 2] * mz
        ax = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + arm[0]
        ay = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + arm[1]
        az = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + arm[2]
        J[0], J[1], J[2] = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
        J[3], J[4], J[5] = nx, ny, nz
        for k in range(6):
            scaled = weight * J[k]
            b[k] += scaled * residual
            for m in range(6):
                H[k, m] += scaled * J[m]


@compiled
def refine(cloud, Rs, ts, limits, diameter, converged, target, is_exact, all_places):
    """Take the steps of ``_iterate`` of ``icp.py``: move poses in place, each until it converges.

    ``all_places`` (poses, points) receives each point's place in the tree, or -1.
    """
    middle = cloud.sum(0) / len(cloud)
    points, normals = target.tree.points, target.normals
    local, eye, rotated = np.empty_like(cloud), np.empty(3), np.empty((3, 3))
    H, b = np.empty((6, 6)), np.empty(6)
    last = len(limits) - 1
    for p in range(len(ts)):
        R, t, places = Rs[p], ts[p], all_places[p]
        for step in range(len(limits)):
            limit = limits[step]
            is_along_rays = is_exact and 2 * step >= last

            # Visible samples of the surface; all are where the camera is within the ball.
            eye[:] = -(t @ R)
            local[:] = (cloud - t) @ R
            queries = _meet_planes(local, eye, target, places) if is_along_rays else local
            distance = np.linalg.norm(eye - target.ball[:3])
            least = -SLACK * distance if distance > target.ball[3] else -np.inf
            find_places(queries, limit, target, is_exact, places, eye, least)
            if step == last:
                break

            # One Gauss-Newton step about the middle of the cloud.
            arm = t - middle
            _write_equations(
                local, places, R, arm, limit, points, normals, eye, is_along_rays, H, b
            )
            damp(H, 1e-6)
            motion = np.linalg.solve(H, b)
            rotation(motion[0], motion[1], motion[2], rotated)
            t[:] = rotated @ (t - middle) + middle + motion[3:]
            R[:] = rotated @ R

            has_last_kind = is_along_rays or not is_exact
            most = max(np.abs(motion[:3]).max(), np.abs(motion[3:]).max() / diameter)
            if most < converged and has_last_kind and limit <= limits[-1]:
                break


@compiled
def grow(local, times, middle, limits, target, is_exact, converged):
    """Iterate ICP with a scale, in place, as ``_fit_scale`` of ``identity.py``.

    Args:
        local: points (starts, n, 3) in the model frame; moved.
        times: scale of the surface for each start; changed.
        middle: about which the surface grows.
        limits: distance from which a point has no weight, for each step.
        target: the surface.
        is_exact: whether nearest points are searched, not looked up.
        converged: largest step, in radians and scale, at which it stops.
    """
    count = local.shape[1]
    places = np.full((len(times), count), -1)
    surface, normals = target.tree.points, target.normals
    turn = np.empty((3, 3))
    J, residual, weight = np.zeros((count, 7)), np.zeros(count), np.empty(count)
    for limit in limits:
        most = 0.0
        for p in range(len(times)):
            s, points = times[p], local[p]
            unscaled = (points - middle) / s + middle  # beside the surface at scale 1
            find_places(unscaled, limit / s, target, is_exact, places[p])
            for i in range(count):  # derivatives by rotation, translation and growth
                row, place = J[i], places[p, i]
                weight[i] = 0.0
                if place < 0:
                    continue
                ax = s * (surface[place, 0] - middle[0])
                ay = s * (surface[place, 1] - middle[1])
                az = s * (surface[place, 2] - middle[2])
                gx = points[i, 0] - middle[0] - ax
                gy = points[i, 1] - middle[1] - ay
                gz = points[i, 2] - middle[2] - az
                weight[i] = tukey_weight(gx * gx + gy * gy + gz * gz, limit)
                if weight[i] <= 0:
                    continue
                nx, ny, nz = normals[place, 0], normals[place, 1], normals[place, 2]
                row[0], row[1], row[2] = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
                row[3], row[4], row[5], row[6] = nx, ny, nz, nx * ax + ny * ay + nz * az
                residual[i] = nx * gx + ny * gy + nz * gz
            weighted = J * weight.reshape(-1, 1)
            H = weighted.T @ J
            damp(H, 1e-9)
            motion = np.linalg.solve(H, weighted.T @ residual)  # rotation, translation, growth
            times[p] = min(max(s * (1 + min(max(motion[6], -0.1), 0.1)), 0.5), 2.0)
            rotation(motion[0], motion[1], motion[2], turn)
            # The points move by the inverse of the surface's motion.
            points[:] = (points - middle - motion[3:6]) @ turn + middle
            most = max(most, abs(motion[0]), abs(motion[1]), abs(motion[2]), abs(motion[6]))
        if most < converged:
            break
