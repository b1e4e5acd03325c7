"""A posed model rendered as a depth camera would see it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from depthpose.core.camera.pinhole import clip_window, crop_intrinsics, project
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.compiled import use_numba
from depthpose.pose.surface import Surface

_NEAR_M = 0.01
"""What is nearer to the camera is not rendered."""


class Rendering(NamedTuple):
    """A rendered surface, in the part of an image that it covers."""

    depth_m: np.ndarray  #: (h, w), along the optical axis; NaN where nothing is rendered
    cosine: np.ndarray  #: (h, w), between ray and normal; 1 where nothing is rendered
    window: tuple[slice, slice]  #: rows and columns of the part


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
    pose = pose.double()
    window = _window_about(surface, pose, K, height, width)
    rows, columns = window
    shape = rows.stop - rows.start, columns.stop - columns.start
    if 0 in shape:
        return Rendering(np.empty((0, 0)), np.empty((0, 0)), (slice(0, 0), slice(0, 0)))
    window_K = crop_intrinsics(K, columns.start, rows.start)
    depth_m = np.full(shape, np.inf, dtype=np.float32)
    face = np.full(shape, -1, dtype=np.int64)
    if use_numba(surface.triangles_m):
        from depthpose.pose.compiled.triangles import draw_triangles

        draw_triangles(
            surface.triangles_m.numpy(),
            pose.R.numpy(),
            pose.t_m.numpy(),
            window_K.numpy(),
            _NEAR_M,
            depth_m,
            face,
        )
    else:
        posed_m = pose.apply(surface.triangles_m)
        raster = rasterize(posed_m, window_K, shape[1], shape[0], _NEAR_M, with_barycentric=False)
        face = raster.primitive.numpy()
        depth_m = raster.depth_m.float().numpy()

    # A ray meets the plane of its triangle at the depth, so its cosine follows from the distance
    # of the plane from the camera: distance = depth * |ray| * cosine.
    is_drawn = face >= 0
    depth_m = np.where(is_drawn, depth_m, np.nan)
    camera_m = -(pose.R.mT @ pose.t_m)  # in the model frame
    distance_m = (surface.plane_offsets_m - surface.plane_normals @ camera_m).abs().numpy()
    cosine = np.ones(shape)
    ray_length = _ray_lengths(window_K.numpy(), *shape)
    cosine[is_drawn] = distance_m[face[is_drawn]] / (depth_m * ray_length)[is_drawn]
    return Rendering(depth_m, cosine, window)


def _ray_lengths(K: np.ndarray, height: int, width: int) -> np.ndarray:
    """Length of the ray of each pixel up to a depth of 1, (h, w)."""
    y = (np.arange(height)[:, None] - K[1, 2]) / K[1, 1]
    x = (np.arange(width) - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.sqrt(x**2 + y**2 + 1)


def _window_about(
    surface: Surface, pose: Rigid, K: Float64[Tensor, "3 3"], height: int, width: int
) -> tuple[slice, slice]:
    """Rows and columns of an image that a posed surface may cover."""
    corners_m = pose.apply(surface.box_corners_m)
    if float(corners_m[:, 2].amax()) < _NEAR_M:
        return slice(0, 0), slice(0, 0)
    if float(corners_m[:, 2].amin()) < _NEAR_M:
        return slice(0, height), slice(0, width)
    pixels = project(corners_m, K)
    left, top = (int(value) for value in pixels.amin(0).floor().tolist())
    right, bottom = (int(value) for value in pixels.amax(0).ceil().tolist())
    return clip_window(left, top, right + 1, bottom + 1, height, width)
