"""What a camera at the origin sees of posed surfaces, in cells of rays."""

import numpy as np
import torch
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.compiled.choice import compiled, finite_array


def compare_rays(
    cloud: Tensor,
    poses: Rigid,
    points: Tensor,
    rays: tuple[float, float, float, int],
    limit: float,
) -> tuple[Tensor, Tensor]:
    """Compare a cloud with each pose of a surface.

    Args:
        cloud: (n, 3), before the camera, float64.
        poses: a batch, ``camera_from_model``, float64.
        points: (m, 3), of the surface.
        rays: cells for a unit of slope, column and row of the middle cell, cells to each side.
        limit: how far before a point the surface occludes it.

    Returns:
        For each pose the share of points that the surface would have occluded, and the share of the
        surface's cells in which nothing was seen.

    Raises:
        ValueError: a value is not finite.
    """
    assert len(poses.R) == len(poses.t_m), "a translation for each rotation"
    front = torch.empty(len(poses.R), dtype=torch.float64)
    unseen = torch.empty_like(front)
    given = (finite_array(a) for a in (cloud, poses.R, poses.t_m, points))
    _look(*given, *rays, limit, front.numpy(), unseen.numpy())
    return front, unseen


@compiled
def _cell(x, y, z, scale, column, row, reach):
    """Number the cell of a ray, those far off at the border."""
    u = min(max(np.floor(x / z * scale - column), -reach), reach) + reach
    v = min(max(np.floor(y / z * scale - row), -reach), reach) + reach
    return int(u) * (2 * reach + 1) + int(v)


@compiled
def _look(cloud, Rs, ts, points, scale, column, row, reach, limit, front, unseen):
    """Compare a cloud with each of several poses of a surface.

    Args:
        cloud: (n, 3), before the camera.
        Rs: (b, 3, 3), rotations of the poses.
        ts: (b, 3), translations.
        points: (m, 3), of the surface.
        scale: cells for a unit of a ray's slope.
        column: of the middle cell.
        row: of the middle cell.
        reach: cells to each side of it.
        limit: how far before a point the surface occludes it.
        front: (b,), written: share of points that the surface would have occluded.
        unseen: (b,), written: share of the surface's cells in which nothing was seen.
    """
    cells = (2 * reach + 1) ** 2
    is_seen = np.zeros(cells, np.bool_)
    theirs = np.empty(len(cloud), np.int64)
    for i in range(len(cloud)):
        theirs[i] = _cell(cloud[i, 0], cloud[i, 1], cloud[i, 2], scale, column, row, reach)
        is_seen[theirs[i]] = True
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
            mine = _cell(x, y, max(z, 1e-6), scale, column, row, reach)
            nearest[mine] = min(nearest[mine], z)
        total, missed = 0, 0
        for k in range(cells):
            if nearest[k] < np.inf:
                total += 1
                missed += not is_seen[k]
        occluded = 0
        for i in range(len(cloud)):
            occluded += nearest[theirs[i]] < cloud[i, 2] - limit
        front[b] = occluded / len(cloud) if total else 1.0
        unseen[b] = missed / total if total else 1.0
