"""Poses: steps of point-to-plane ICP, of a scale beside, and from votes to keypoints to a pose.

The formulas are those of pose.refine, pose.estimator.fit and pose.voting.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.compiled import (
    GRAZING,
    LOOKED_UP,
    ON_RAY,
    SEARCHED,
    SLACK,
    compiled,
    finite_array,
)
from depthpose.pose.compiled.points import (
    Array,
    Tree,
    damp,
    faces,
    jacobi,
    neighbours,
    rotation,
    solve,
)


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


@compiled
def match(cloud, R, t, limit, target, how, local, eye, places):
    """Find for each point of a cloud the place of a surface point that the camera may see."""
    for c in range(3):
        eye[c] = -(R[0, c] * t[0] + R[1, c] * t[1] + R[2, c] * t[2])
    for i in range(len(cloud)):
        x, y, z = cloud[i, 0] - t[0], cloud[i, 1] - t[1], cloud[i, 2] - t[2]
        for c in range(3):
            local[i, c] = R[0, c] * x + R[1, c] * y + R[2, c] * z
    sought = _meet_planes(local, eye, target, places) if how == ON_RAY else local
    x, y, z = eye[0] - target.ball[0], eye[1] - target.ball[1], eye[2] - target.ball[2]
    distance = np.sqrt(x * x + y * y + z * z)
    # A camera within the ball sees no side.
    least = -SLACK * distance if distance > target.ball[3] else -np.inf
    find_places(sought, limit, target, how != LOOKED_UP, places, eye, least)


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
            meet[i, 0], meet[i, 1], meet[i, 2] = point[0], point[1], point[2]
    return meet


@compiled
def find_places(local, limit, target, is_exact, places, eye=None, least=0.0):
    """Find the place of the surface point near each point."""
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


def refined(
    cloud: Tensor,
    pose: Rigid,
    target: Target,
    limits: list[float],
    converged: float,
    scale: float,
    *,
    is_exact: bool,
) -> tuple[Rigid, Tensor]:
    """Refine a pose or a batch of poses; give them and the number of each point's sample, or -1."""
    assert pose.R.shape[:-2] == pose.t_m.shape[:-1], "a translation for each rotation"
    R, t_m = (torch.from_numpy(finite_array(a).copy()) for a in (pose.R, pose.t_m))
    given = (finite_array(cloud), R.view(-1, 3, 3).numpy(), t_m.view(-1, 3).numpy())
    places = np.full((len(given[2]), len(given[0])), -1)
    _refine(*given, np.array(limits), scale, converged, target, is_exact, places)
    index = torch.from_numpy(np.append(target.tree.order, -1)[places])
    return Rigid(R, t_m), index.view(*t_m.shape[:-1], -1)


@compiled
def _add_equations(local, places, R, arm, limit, points, normals, eye, how, H, b):
    """Add up the normal equations of one pose about a point, from which ``arm`` is its origin."""
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
        residual, square = mx * gx + my * gy + mz * gz, gx * gx + gy * gy + gz * gz
        if how == ON_RAY:
            x, y, z = local[i, 0] - eye[0], local[i, 1] - eye[1], local[i, 2] - eye[2]
            along = gx * x + gy * y + gz * z
            square += residual * residual - along * along / (x * x + y * y + z * z)
        share = 1 - square / (limit * limit)
        if share <= 0:
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
            scaled = share * share * J[k]
            b[k] += scaled * residual
            for m in range(k + 1):
                H[k, m] += scaled * J[m]


@compiled
def _move(turn, motion, middle, R, t):
    """Turn a pose about a point and shift it."""
    x, y, z = t[0] - middle[0], t[1] - middle[1], t[2] - middle[2]
    for c in range(3):
        t[c] = turn[c, 0] * x + turn[c, 1] * y + turn[c, 2] * z + middle[c] + motion[3 + c]
        x_c, y_c, z_c = R[0, c], R[1, c], R[2, c]
        for k in range(3):
            R[k, c] = turn[k, 0] * x_c + turn[k, 1] * y_c + turn[k, 2] * z_c


@compiled
def _refine(cloud, Rs, ts, limits, scale, converged, target, is_exact, every):
    """Move poses in place, step by step, each until it moves no more."""
    middle = np.zeros(3)
    for i in range(len(cloud)):
        middle += cloud[i]
    middle /= len(cloud)
    points, normals = target.tree.points, target.normals
    local, eye, turn = np.empty_like(cloud), np.empty(3), np.empty((3, 3))
    H, b, motion = np.empty((6, 6)), np.empty(6), np.empty(6)
    for p in range(len(ts)):
        R, t, places = Rs[p], ts[p], every[p]
        for k in range(len(limits)):
            limit, how = limits[k], SEARCHED if is_exact else LOOKED_UP
            if is_exact and 2 * k >= len(limits) - 1:
                how = ON_RAY
            match(cloud, R, t, limit, target, how, local, eye, places)
            if k == len(limits) - 1:
                break
            _add_equations(local, places, R, t - middle, limit, points, normals, eye, how, H, b)
            damp(H, 1e-6)
            solve(H, b, motion)
            rotation(motion[0], motion[1], motion[2], turn)
            _move(turn, motion, middle, R, t)
            most = 0.0
            for c in range(6):
                most = max(most, abs(motion[c]) / (1.0 if c < 3 else scale))
            if most < converged and how != SEARCHED and limit <= limits[-1]:
                break


def grown(
    local: Tensor,
    times: Tensor,
    middle: Tensor,
    target: Target,
    limits: list[float],
    converged: float,
    is_exact: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the scale of a surface that fits points, from each of several scales."""
    local, times = torch.from_numpy(finite_array(local).copy()), times.clone()
    variance = torch.ones_like(times)
    arrays = (local.numpy(), times.numpy(), middle.numpy(), np.array(limits))
    _grow(*arrays, target, is_exact, converged, variance.numpy())
    return times, local, variance


@compiled
def _step(rows, motion):
    """Solve for turn, shift and growth; give the variance of the growth."""
    H, b, total = np.zeros((7, 7)), np.zeros(7), 0.0
    for i in range(len(rows)):
        weight = rows[i, 8]
        if weight == 0:
            continue
        total += weight
        for k in range(7):
            scaled = weight * rows[i, k]
            b[k] += scaled * rows[i, 7]
            for m in range(k + 1):
                H[k, m] += scaled * rows[i, m]
    damp(H, 1e-9)
    factor, unit, column = H.copy(), np.zeros(7), np.empty(7)
    solve(factor, b, motion)
    unit[6] = 1.0
    solve(H, unit, column)
    square = 0.0
    for i in range(len(rows)):
        if rows[i, 8] > 0:
            left = rows[i, 7]
            for k in range(7):
                left -= rows[i, k] * motion[k]
            square += rows[i, 8] * left * left
    return max(square / max(total - 7, 1.0) * column[6], 0.0)


@compiled
def _grow(local, times, middle, limits, target, is_exact, converged, variance):
    """Move points and grow a surface about its middle, step by step, in place."""
    count = local.shape[1]
    places = np.full((len(times), count), -1)
    surface, normals = target.tree.points, target.normals
    rows, motion, turn = np.empty((count, 9)), np.empty(7), np.empty((3, 3))
    for limit in limits:
        most = 0.0
        for p in range(len(times)):
            s, points = times[p], local[p]
            own = (points - middle) / s + middle  # beside the surface of its own size
            find_places(own, limit / s, target, is_exact, places[p])
            for i in range(count):  # derivatives by turn, shift and growth, residual, weight
                row, place = rows[i], places[p, i]
                row[8] = 0.0
                if place < 0:
                    continue
                ax = s * (surface[place, 0] - middle[0])
                ay = s * (surface[place, 1] - middle[1])
                az = s * (surface[place, 2] - middle[2])
                gx = points[i, 0] - middle[0] - ax
                gy = points[i, 1] - middle[1] - ay
                gz = points[i, 2] - middle[2] - az
                share = 1 - (gx * gx + gy * gy + gz * gz) / (limit * limit)
                if share <= 0:
                    continue
                nx, ny, nz = normals[place, 0], normals[place, 1], normals[place, 2]
                row[0], row[1], row[2] = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
                row[3], row[4], row[5], row[6] = nx, ny, nz, nx * ax + ny * ay + nz * az
                row[7], row[8] = nx * gx + ny * gy + nz * gz, share * share
            variance[p] = _step(rows, motion)
            times[p] = min(max(s * (1 + min(max(motion[6], -0.1), 0.1)), 0.5), 2.0)
            rotation(motion[0], motion[1], motion[2], turn)
            for i in range(count):  # by the inverse of the surface's motion
                x = points[i, 0] - middle[0] - motion[3]
                y = points[i, 1] - middle[1] - motion[4]
                z = points[i, 2] - middle[2] - motion[5]
                for c in range(3):
                    points[i, c] = x * turn[0, c] + y * turn[1, c] + z * turn[2, c] + middle[c]
            most = max(most, abs(motion[0]), abs(motion[1]), abs(motion[2]), abs(motion[6]))
        if most < converged:
            break


_FARTHEST = 1e9
"""A step beyond this is none."""


def fitted(
    pose: Rigid, model: Tensor, found: Tensor, information: Tensor, steps: int
) -> tuple[Rigid, Tensor]:
    """Move poses to the least ``sum e^T W e`` with ``e = R m + t - p``.

    Args:
        pose: one or a batch, to begin with, float64.
        model: keypoints of the model, (..., k, 3).
        found: those that were found, (..., k, 3).
        information: inverse covariances W, (..., k, 3, 3), 0 where a keypoint does not count.
        steps: so many.

    Returns:
        The poses, and their information matrices of (rotation, translation), (..., 6, 6).
    """
    R, t_m = pose.R.contiguous().clone(), pose.t_m.contiguous().clone()
    H = R.new_empty(*R.shape[:-2], 6, 6)
    keypoints = (a.contiguous().numpy().reshape(-1, *a.shape[-2:]) for a in (model, found))
    W = information.contiguous().numpy().reshape(-1, *information.shape[-3:])
    poses = (R.view(-1, 3, 3).numpy(), t_m.view(-1, 3).numpy())
    _fit(*poses, *keypoints, W, steps, H.view(-1, 6, 6).numpy())
    return Rigid(R, t_m), H


@compiled
def _add_keypoints(R, t, model, found, information, H, b):
    """Add up the normal equations, ``J = [-[R m + t]_x, I]``."""
    H[:] = 0.0
    b[:] = 0.0
    J, WJ, moved = np.zeros((3, 6)), np.empty((3, 6)), np.empty(3)
    J[0, 3] = J[1, 4] = J[2, 5] = 1.0
    for i in range(len(model)):
        W = information[i]
        for c in range(3):
            moved[c] = t[c]
            for m in range(3):
                moved[c] += R[c, m] * model[i, m]
        x, y, z = moved
        J[0, 1], J[0, 2], J[1, 0], J[1, 2], J[2, 0], J[2, 1] = z, -y, -z, x, y, -x
        for c in range(3):
            for k in range(6):
                WJ[c, k] = W[c, 0] * J[0, k] + W[c, 1] * J[1, k] + W[c, 2] * J[2, k]
        for k in range(6):
            for c in range(3):
                b[k] += WJ[c, k] * (found[i, c] - moved[c])
                for m in range(6):
                    H[k, m] += J[c, k] * WJ[c, m]


@compiled
def _fit(Rs, ts, model, found, information, steps, Hs):
    H, b, motion, turn = np.empty((6, 6)), np.empty(6), np.empty(6), np.empty((3, 3))
    origin = np.zeros(3)
    for p in range(len(ts)):
        R, t = Rs[p], ts[p]
        for _ in range(steps):
            _add_keypoints(R, t, model[p], found[p], information[p], H, b)
            solve(H, b, motion)
            if not np.abs(motion).max() < _FARTHEST:  # keypoints that fix nothing
                break
            rotation(motion[0], motion[1], motion[2], turn)
            _move(turn, motion, origin, R, t)
        _add_keypoints(R, t, model[p], found[p], information[p], Hs[p], b)


_SMALLEST = 1e-12


def met(
    points: Tensor, directions: Tensor, weights: Tensor, refinements: int, nearest: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the point where the lines of each keypoint meet best.

    Args:
        points: about their mean, (1, 3, n), float64 as the others.
        directions: of unit length, (k, 3, n).
        weights: (k, n).
        refinements: steps after the nearest point.
        nearest: points nearer to a keypoint than this share of the mean distance weigh no more.

    Returns:
        Points (k, 3) about the points' mean, covariances (k, 3, 3), condition numbers (k,).

    Raises:
        ValueError: a value is not finite.
    """
    count = len(directions)
    out = [torch.empty(count, *shape, dtype=torch.float64) for shape in ((3,), (3, 3), ())]
    arrays = (finite_array(a) for a in (points, directions, weights))
    _meet(*arrays, refinements, nearest, *(a.numpy() for a in out))
    return out[0], out[1], out[2]


@compiled
def _damped(A, out):
    size = max(A[0, 0] + A[1, 1] + A[2, 2], 1e-300)
    for c in range(3):
        for k in range(3):
            out[c, k] = A[c, k]
        out[c, c] += 1e-12 * size


@compiled
def _add_outer(A, amount, x, y, z):
    """Add ``amount (I - q q^T)``, of the lower half."""
    A[0, 0] += amount * (1 - x * x)
    A[1, 1] += amount * (1 - y * y)
    A[2, 2] += amount * (1 - z * z)
    A[1, 0] -= amount * x * y
    A[2, 0] -= amount * x * z
    A[2, 1] -= amount * y * z


@compiled
def _mirror(A):
    A[0, 1], A[0, 2], A[1, 2] = A[1, 0], A[2, 0], A[2, 1]


@compiled
def _gradients(local, n, w, p, nearest, A, gradient):
    """Write the information matrix and the gradient of each line, over the sum of weights."""
    total, mean = 0.0, 0.0
    for i in range(len(w)):
        x, y, z = p[0] - local[0, i], p[1] - local[1, i], p[2] - local[2, i]
        mean += np.sqrt(x * x + y * y + z * z) / len(w)
        total += w[i]
    least = nearest * max(mean, _SMALLEST)
    A[:] = 0.0
    for i in range(len(w)):
        x, y, z = p[0] - local[0, i], p[1] - local[1, i], p[2] - local[2, i]
        distance = max(np.sqrt(x * x + y * y + z * z), _SMALLEST)
        x, y, z = x / distance, y / distance, z / distance
        distance = max(distance, least)
        cosine = n[0, i] * x + n[1, i] * y + n[2, i] * z
        pull = w[i] / distance / total
        gradient[0, i] = (n[0, i] - x * cosine) * pull
        gradient[1, i] = (n[1, i] - y * cosine) * pull
        gradient[2, i] = (n[2, i] - z * cosine) * pull
        _add_outer(A, pull / distance * max(cosine, 0.5), x, y, z)
    _mirror(A)


@compiled
def _meet(local, n, w, refinements, nearest, points, covariances, conditions):
    local = local[0]
    count = local.shape[1]
    A, V, M = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    gradient, pull, step, unit = np.empty((3, count)), np.empty(3), np.empty(3), np.empty(3)
    inverse, spread = np.empty((3, 3)), 0.0
    for i in range(count):
        spread += (local[0, i] ** 2 + local[1, i] ** 2 + local[2, i] ** 2) / count
    for k in range(len(points)):
        p = points[k]
        # The point nearest to all lines, and its matrix over the sum of weights.
        A[:] = 0.0
        pull[:] = 0.0
        total = 0.0
        for i in range(count):
            x, y, z = local[0, i], local[1, i], local[2, i]
            nx, ny, nz = n[k, 0, i], n[k, 1, i], n[k, 2, i]
            along = nx * x + ny * y + nz * z
            _add_outer(A, w[k, i], nx, ny, nz)
            pull[0] += w[k, i] * (x - nx * along)
            pull[1] += w[k, i] * (y - ny * along)
            pull[2] += w[k, i] * (z - nz * along)
            total += w[k, i]
        A /= total
        pull /= total
        _mirror(A)
        _damped(A, M)
        solve(M, pull, p)
        M = A.copy()
        jacobi(M, V)
        low, high = min(M[0, 0], M[1, 1], M[2, 2]), max(M[0, 0], M[1, 1], M[2, 2])
        conditions[k] = high / low if low > 1e-7 else np.inf
        for _ in range(refinements):
            _gradients(local, n[k], w[k], p, nearest, A, gradient)
            for c in range(3):
                pull[c] = gradient[c].sum()
            _damped(A, M)
            solve(M, pull, step)
            limit = np.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2 + spread)
            size = max(np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2), _SMALLEST)
            for c in range(3):
                p[c] += step[c] * min(limit / size, 1.0)
        if refinements == 0:
            for i in range(count):
                x, y, z = p[0] - local[0, i], p[1] - local[1, i], p[2] - local[2, i]
                along = n[k, 0, i] * x + n[k, 1, i] * y + n[k, 2, i] * z
                gradient[0, i] = (x - n[k, 0, i] * along) * w[k, i] / total
                gradient[1, i] = (y - n[k, 1, i] * along) * w[k, i] / total
                gradient[2, i] = (z - n[k, 2, i] * along) * w[k, i] / total
        for c in range(3):
            unit[:] = 0.0
            unit[c] = 1.0
            _damped(A, M)
            solve(M, unit, inverse[c])
        votes = (w[k] > 0).sum()
        spare = 2 * votes / max(2 * votes - 3, 1)
        covariance = spare * (inverse @ (gradient @ gradient.T) @ inverse)
        for c in range(3):
            for m in range(3):
                covariances[k, c, m] = covariance[c, m]
