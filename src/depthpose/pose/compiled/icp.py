"""Steps of point-to-plane ICP for a batch of poses."""

import numpy as np
import torch
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.compiled import LOOKED_UP, ON_RAY, SEARCHED, compiled, finite_array
from depthpose.pose.compiled.points import damp, rotation, solve
from depthpose.pose.compiled.target import Target, match


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
    """Refine a pose or a batch of poses; give them and the number of each point's sample, or -1.

    Args:
        cloud: (n, 3), float64, in the camera frame.
        pose: ``camera_from_model``, float64.
        target: the surface.
        limits: of the steps, and of what is found after them.
        converged: turn and shift of a step below which it is the last.
        scale: the length by which a shift is measured.
        is_exact: whether the nearest surface point is searched, or looked up.

    Raises:
        ValueError: a value is not finite.
    """
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
    """Move poses in place, step by step, each until it moves no more.

    Args:
        cloud: (n, 3), in the camera frame.
        Rs: (b, 3, 3), rotations ``camera_from_model``.
        ts: (b, 3), translations.
        limits: (steps + 1,), distances up to which a point counts; the last moves nothing.
        scale: length that a shift is measured by.
        converged: turn [rad] and shift of a step below which it is the last.
        target: the surface.
        is_exact: whether the nearest point is searched, or looked up.
        every: (b, n), -1; written: places of the surface points.
    """
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
