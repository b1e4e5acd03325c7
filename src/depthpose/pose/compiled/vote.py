"""Votes of lines to keypoints, and keypoints to a pose; the formulas are those of pose.voting."""

import numpy as np
import torch
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.compiled import compiled, finite_array
from depthpose.pose.compiled.points import jacobi, rotation, solve

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
def _add_equations(R, t, model, found, information, H, b):
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
    for p in range(len(ts)):
        R, t = Rs[p], ts[p]
        for _ in range(steps):
            _add_equations(R, t, model[p], found[p], information[p], H, b)
            solve(H, b, motion)
            if not np.abs(motion).max() < _FARTHEST:  # keypoints that fix nothing
                break
            rotation(motion[0], motion[1], motion[2], turn)
            R[:] = turn @ R
            t[:] = turn @ t + motion[3:]
        _add_equations(R, t, model[p], found[p], information[p], Hs[p], b)


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
    out[:] = A
    for c in range(3):
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
        M[:] = A
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
        covariances[k] = spare * (inverse @ (gradient @ gradient.T) @ inverse)
