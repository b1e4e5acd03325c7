"""A posed model rendered as a depth camera would see it.

A z-buffer in a compiled loop, fast enough to compare many poses with an image. Synthetic images,
which need exact pixels and coordinates on the triangles for their textures, are drawn by
:mod:`depthpose.core.render`.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from depthpose.core.camera.pinhole import Window, clip_window, crop_intrinsics, project
from depthpose.core.rigid import Rigid
from depthpose.pose.compiled import array_of, compiled
from depthpose.pose.geometry.surface import Surface

_NEAR_M = 0.01
"""A triangle with a corner nearer to the camera than this is not rendered."""


class Rendering(NamedTuple):
    """A rendered surface, in the part of an image that it covers."""

    depth_m: np.ndarray  #: (h, w), along the optical axis; NaN where nothing is rendered
    cosine: np.ndarray  #: (h, w), between ray and normal to either side; 1 elsewhere
    window: Window  #: rows and columns of the part


def render_surface(
    surface: Surface, pose: Rigid, K: Float64[Tensor, "3 3"], height: int, width: int
) -> Rendering:
    """Render the triangles of a surface.

    Args:
        surface: of the model.
        pose: ``camera_from_model``.
        K: intrinsic matrix of the image.
        height: rows of the image.
        width: its columns.
    """
    # The triangles, drawn into the part of the image about them.
    pose = pose.double()
    window = find_window_about(surface, pose, K, height, width)
    rows, columns = window
    shape = rows.stop - rows.start, columns.stop - columns.start
    if 0 in shape:
        return Rendering(np.empty((0, 0)), np.empty((0, 0)), (slice(0, 0), slice(0, 0)))
    window_K = crop_intrinsics(K, columns.start, rows.start)
    inverse_depth = np.zeros(shape, dtype=np.float32)
    face = np.full(shape, -1, dtype=np.int64)
    _draw_triangles(
        array_of(surface.triangles_m),
        array_of(pose.R),
        array_of(pose.t_m),
        array_of(window_K),
        inverse_depth,
        face,
    )

    # A ray meets the plane of its triangle at the depth, so its cosine follows from the distance
    # of the plane from the camera: distance = depth * |ray| * cosine.
    is_drawn = face >= 0
    depth_m = np.full(shape, np.nan, dtype=np.float32)
    depth_m[is_drawn] = 1 / inverse_depth[is_drawn]
    camera_m = -(pose.R.mT @ pose.t_m)  # in the model frame
    distance_m = (surface.plane_offsets_m - surface.plane_normals @ camera_m).abs().numpy()
    cosine = np.ones(shape)
    ray_length = _measure_ray_lengths(window_K.numpy(), *shape)
    cosine[is_drawn] = distance_m[face[is_drawn]] / (depth_m * ray_length)[is_drawn]
    return Rendering(depth_m, cosine, window)


@compiled
def _draw_triangles(
    corners_m: Float64[np.ndarray, "f 3 3"],
    R: Float64[np.ndarray, "3 3"],
    t_m: Float64[np.ndarray, "3"],
    K: Float64[np.ndarray, "3 3"],
    inverse_depth: Float32[np.ndarray, "h w"],
    face: Int64[np.ndarray, "h w"],
) -> None:
    """Write 1 / depth and the number of the nearest triangle into the pixels that it covers.

    Without clipping: a triangle with a corner nearer than ``_NEAR_M`` is left out.

    Args:
        corners_m: of the triangles, in the model frame.
        R: rotation of the pose.
        t_m: its translation.
        K: intrinsic matrix of the window.
        inverse_depth: 1 / depth [1/m], 0 at first; changed.
        face: -1 at first; changed.
    """
    height, width = inverse_depth.shape
    u = np.empty(3)
    v = np.empty(3)
    z = np.empty(3)
    for f in range(len(corners_m)):
        # The corners in the image, pinhole model.
        for k in range(3):
            x_m, y_m, z_m = corners_m[f, k]
            x = R[0, 0] * x_m + R[0, 1] * y_m + R[0, 2] * z_m + t_m[0]
            y = R[1, 0] * x_m + R[1, 1] * y_m + R[1, 2] * z_m + t_m[1]
            z[k] = R[2, 0] * x_m + R[2, 1] * y_m + R[2, 2] * z_m + t_m[2]
            u[k] = (K[0, 0] * x + K[0, 1] * y) / z[k] + K[0, 2]
            v[k] = K[1, 1] * y / z[k] + K[1, 2]
        area = (u[1] - u[0]) * (v[2] - v[0]) - (u[2] - u[0]) * (v[1] - v[0])
        if min(z[0], z[1], z[2]) < _NEAR_M or area == 0:
            continue

        # The pixels of its box that lie inside, where it is nearer than what was drawn before.
        left = max(0, int(np.ceil(min(u[0], u[1], u[2]))))
        right = min(width - 1, int(np.floor(max(u[0], u[1], u[2]))))
        top = max(0, int(np.ceil(min(v[0], v[1], v[2]))))
        bottom = min(height - 1, int(np.floor(max(v[0], v[1], v[2]))))
        inverse_area = 1 / area
        inverse_0 = 1 / z[0]
        inverse_1 = 1 / z[1]
        inverse_2 = 1 / z[2]
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                # Barycentric coordinates, in which 1 / depth is linear.
                a = ((u[1] - column) * (v[2] - row) - (u[2] - column) * (v[1] - row)) * inverse_area
                b = ((u[2] - column) * (v[0] - row) - (u[0] - column) * (v[2] - row)) * inverse_area
                c = 1 - a - b
                if a < 0 or b < 0 or c < 0:
                    continue
                inverse = a * inverse_0 + b * inverse_1 + c * inverse_2
                if inverse > inverse_depth[row, column]:
                    inverse_depth[row, column] = inverse
                    face[row, column] = f


def _measure_ray_lengths(K: np.ndarray, height: int, width: int) -> np.ndarray:
    """Measure the length of each pixel's ray up to a depth of 1, (h, w)."""
    y = (np.arange(height)[:, None] - K[1, 2]) / K[1, 1]
    x = (np.arange(width) - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.sqrt(x**2 + y**2 + 1)


def find_window_about(
    surface: Surface,
    pose: Rigid,
    K: Float64[Tensor, "3 3"],
    height: int,
    width: int,
    margin_m: float = 0.0,
) -> Window:
    """Find the rows and columns of an image that a posed surface may cover.

    They are empty if it is behind the camera, and the whole image if it is partly behind it.

    Args:
        surface: of the model.
        pose: ``camera_from_model``.
        K: intrinsic matrix of the image.
        height: rows of the image.
        width: its columns.
        margin_m: what lies within this distance of the surface is in the window too.
    """
    # The corners of a box about the surface. Behind the camera it covers nothing; partly behind,
    # perhaps the whole image.
    low_m, high_m = surface.box_m
    box_m = torch.stack([low_m - margin_m, high_m + margin_m], -1)
    corners_m = pose.apply(torch.cartesian_prod(*box_m))
    if float(corners_m[:, 2].amax()) < _NEAR_M:
        return slice(0, 0), slice(0, 0)
    if float(corners_m[:, 2].amin()) < _NEAR_M:
        return slice(0, height), slice(0, width)

    # Else the box about the projected corners.
    pixels = project(corners_m, K)
    left, top = (int(value) for value in pixels.amin(0).floor().tolist())
    right, bottom = (int(value) for value in pixels.amax(0).ceil().tolist())
    return clip_window(left, top, right + 1, bottom + 1, height, width)
