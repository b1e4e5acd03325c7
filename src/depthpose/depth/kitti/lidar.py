"""One LiDAR scan as a sparse depth map, as the published Eigen evaluation makes it, to the bit."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

LidarDepth = Literal["velodyne_x", "camera_z"]


def project_lidar(
    points: Float[Tensor, "n 4"],
    pixels_from_velodyne: Float64[np.ndarray, "3 4"],
    size: tuple[int, int],
    depth: LidarDepth,
) -> Float[Tensor, "h w"]:
    """Draw a scan into camera 2; NaN where no point falls. No interpolation.

    Points behind the scanner are dropped, pixels are rounded half to even and then moved by -1
    (KITTI's Matlab indices), points are written in file order, and where several share the index
    ``v (W - 1) + u - 1`` the smallest depth goes to the first such point's pixel. That index is
    not one to one, (v, W - 1) and (v + 1, 0) collide, so border columns differ from a true minimum;
    the published script does so, and its numbers are kept.

    Args:
        points: x forward, y left, z up [m], reflectance, in file order.
        pixels_from_velodyne: see :class:`KittiCalibration`.
        size: height and width of the image.
        depth: ``velodyne_x``, the published protocol's (about 0.27 m more), or ``camera_z``.
    """
    height, width = size
    homogeneous = points.numpy().astype(np.float32).copy()
    homogeneous[:, 3] = 1.0
    homogeneous = homogeneous[homogeneous[:, 0] >= 0]
    with np.errstate(all="ignore"):  # points on the plane of the camera divide by zero
        projected = (pixels_from_velodyne @ homogeneous.T.astype(np.float64)).T
        pixel = np.round(projected[:, :2] / projected[:, 2:3]) - 1
    value_m = homogeneous[:, 0].astype(np.float64) if depth == "velodyne_x" else projected[:, 2]
    is_inside = ((pixel >= 0) & (pixel < (width, height))).all(1)
    u, v = pixel[is_inside].astype(np.int64).T
    written = _write_in_order(u, v, value_m[is_inside], (height, width))
    written[written < 0] = 0
    with np.errstate(over="ignore"):
        as_float32 = torch.from_numpy(written.astype(np.float32))
    return torch.where(as_float32 > 0, as_float32, torch.nan)


def _write_in_order(
    u: np.ndarray, v: np.ndarray, value_m: Float64[np.ndarray, " n"], size: tuple[int, int]
) -> Float64[np.ndarray, "h w"]:
    height, width = size
    canvas = np.zeros((height, width))
    # The last point of a pixel wins: keep one write a pixel, for NumPy promises no order.
    flat = v * width + u
    last_of_reversed = np.unique(flat[::-1], return_index=True)
    canvas.flat[last_of_reversed[0]] = value_m[::-1][last_of_reversed[1]]
    shared = v * (width - 1) + u - 1
    index, first, count = np.unique(shared, return_index=True, return_counts=True)
    smallest = np.full(len(index), np.inf)
    np.minimum.at(smallest, np.searchsorted(index, shared), value_m)
    # Colliding groups never write the same pixel twice: each pixel has one shared index.
    again = count > 1
    canvas[v[first[again]], u[first[again]]] = smallest[again]
    return canvas
