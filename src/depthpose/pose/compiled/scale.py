"""Steps of point-to-plane ICP with a seventh unknown, the scale of the surface."""

import numpy as np
import torch
from torch import Tensor

from depthpose.pose.compiled import compiled, finite_array
from depthpose.pose.compiled.points import damp, rotation, solve
from depthpose.pose.compiled.target import Target, find_places


def grown(
    local: Tensor,
    times: Tensor,
    middle: Tensor,
    target: Target,
    limits: list[float],
    converged: float,
    is_exact: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the scale of a surface that fits points, from each of several scales.

    Args:
        local: points (b, n, 3) in the model frame, float64.
        times: scales to begin from, (b,).
        middle: of the surface, (3,).
        target: the surface.
        limits: of the steps.
        converged: turn and growth of a step below which it is the last.
        is_exact: whether the nearest surface point is searched, or looked up.

    Returns:
        Scales, moved points, and the variance of each scale for independent errors.

    Raises:
        ValueError: a point is not finite.
    """
    local, times = torch.from_numpy(finite_array(local).copy()), times.clone()
    variance = torch.ones_like(times)
    arrays = (local.numpy(), times.numpy(), middle.numpy(), np.array(limits))
    _grow(*arrays, target, is_exact, converged, variance.numpy())
    return times, local, variance


@compiled
def _shrink(points, times, middle, own):
    """Move points to where they lie beside the surface of its own size."""
    for i in range(len(points)):
        for c in range(3):
            own[i, c] = (points[i, c] - middle[c]) / times + middle[c]


@compiled
def _linearise(points, places, times, middle, limit, surface, normals, rows):
    """Write each point's derivatives by turn, shift and growth, residual and weight: (n, 9)."""
    for i in range(len(points)):
        row, place = rows[i], places[i]
        row[8] = 0.0
        if place < 0:
            continue
        ax = times * (surface[place, 0] - middle[0])
        ay = times * (surface[place, 1] - middle[1])
        az = times * (surface[place, 2] - middle[2])
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
def _move(points, middle, motion, turn):
    """Move points by the inverse of the surface's motion."""
    for i in range(len(points)):
        x = points[i, 0] - middle[0] - motion[3]
        y = points[i, 1] - middle[1] - motion[4]
        z = points[i, 2] - middle[2] - motion[5]
        for c in range(3):
            points[i, c] = x * turn[0, c] + y * turn[1, c] + z * turn[2, c] + middle[c]


@compiled
def _grow(local, times, middle, limits, target, is_exact, converged, variance):
    """Move points and grow a surface about its middle, step by step, in place.

    Args:
        local: (b, n, 3), points in the model frame.
        times: (b,), scales.
        middle: (3,), about which the surface grows.
        limits: (steps,), distances up to which a point counts.
        target: the surface.
        is_exact: whether the nearest point is searched, or looked up.
        converged: turn and growth of a step below which it is the last.
        variance: (b,), written: of the scale, for independent errors.
    """
    count = local.shape[1]
    places = np.full((len(times), count), -1)
    surface, normals = target[0][0], target[1]
    own, rows = np.empty((count, 3)), np.empty((count, 9))
    motion, turn = np.empty(7), np.empty((3, 3))
    for limit in limits:
        most = 0.0
        for p in range(len(times)):
            s, points = times[p], local[p]
            _shrink(points, s, middle, own)
            find_places(own, limit / s, target, is_exact, places[p])
            _linearise(points, places[p], s, middle, limit, surface, normals, rows)
            variance[p] = _step(rows, motion)
            times[p] = min(max(s * (1 + min(max(motion[6], -0.1), 0.1)), 0.5), 2.0)
            rotation(motion[0], motion[1], motion[2], turn)
            _move(points, middle, motion, turn)
            most = max(most, abs(motion[0]), abs(motion[1]), abs(motion[2]), abs(motion[6]))
        if most < converged:
            break
