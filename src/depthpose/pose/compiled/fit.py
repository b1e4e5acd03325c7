"""Gauss-Newton from keypoints to a pose."""

import numpy as np
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.compiled.algebra import rotation, solve
from depthpose.pose.compiled.choice import compiled

_FARTHEST = 1e9
"""A step beyond this is none."""


def fitted(pose: Rigid, terms: tuple[Tensor, Tensor, Tensor], steps: int) -> tuple[Rigid, Tensor]:
    """Move poses to the least ``sum e^T W e`` with ``e = R m + t - p``.

    Args:
        pose: one or a batch, to begin with, float64.
        terms: keypoints of the model and those that were found, (..., k, 3), and inverse
            covariances W, (..., k, 3, 3), 0 where a keypoint does not count.
        steps: so many.

    Returns:
        The poses, and their information matrices of (rotation, translation), (..., 6, 6).
    """
    R, t_m = pose.R.contiguous().clone(), pose.t_m.contiguous().clone()
    H = R.new_empty(*R.shape[:-2], 6, 6)
    model, found, information = (a.contiguous().numpy() for a in terms)
    keypoints = (model.reshape(-1, *model.shape[-2:]), found.reshape(-1, *found.shape[-2:]))
    _fit(
        R.view(-1, 3, 3).numpy(), t_m.view(-1, 3).numpy(), *keypoints,
        information.reshape(-1, *information.shape[-3:]), steps, H.view(-1, 6, 6).numpy(),
    )  # fmt: skip
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
