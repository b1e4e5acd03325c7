"""A depth image prepared for a search: points, normals, and the background that is left out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor
from torch.nn.functional import max_pool2d

from depthpose.core.camera import back_project, project
from depthpose.core.camera.pinhole import Window, crop_intrinsics
from depthpose.pose.compiled import array_of, compiled
from depthpose.pose.planes import JUMP_M, JUMP_PER_M, Background, find_wide_planes
from depthpose.pose.sensor import measure_noise_per_m2, plane_tolerance_m
from depthpose.pose.types import KnownBackground, ViewInput

_MOST_PIXELS = 110_000
"""A larger image is thinned to about this size: every n-th of its rows and columns is used."""
_OBJECT_PX = 60
"""Least width of the smallest object in the thinned image, if it is as wide in the full image."""
_WINDOW = 3
"""Reach, in pixels to each side, of the window in which the normal of a pixel is fitted."""
_LEAST_FILLED = 0.4
"""Least share of that window that is of the same surface as the pixel."""
_LEAST_SPREAD_PX4 = 0.3
"""Least determinant of the second moments of the pixels that a normal is fitted to."""
_REGION_MARGIN = 0.5
"""Margin about a region in which planes and neighbours are examined, over its larger side."""

WHOLE = (slice(None), slice(None))
"""The window that is the whole image."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """A depth image, thinned to some hundred thousand pixels."""

    step: int  #: every ``step``-th row and column of the image is used
    depth_m: Float64[Tensor, "h w"]  #: along the optical axis; 0 where there is no reading
    K: Float64[Tensor, "3 3"]  #: intrinsic matrix of the thinned image
    points_m: Float64[Tensor, "h w 3"]  #: the readings as points of the camera frame
    normals: Float64[Tensor, "h w 3"]  #: unit normals of the surface, toward the camera
    is_smooth: Bool[Tensor, "h w"]  #: pixels whose normal could be fitted
    #: largest diameter of an object for which the pixel is background: the wide plane there is too
    #: large to be a side of it. Infinite on a known background, 0 where there is none.
    background_limit_m: Float64[Tensor, "h w"]
    #: least depth of the pixels up to two away; infinite where none has a reading.
    nearest_m: Float64[Tensor, "h w"]
    noise_per_m2: float  #: standard deviation of a reading, for the square of the depth in metres
    backgrounds: Sequence[Background]  #: the one that was given, if any, and the wide planes

    def may_show(self, diameter_m: float, window: Window = WHOLE) -> Bool[Tensor, "h w"]:
        """Mark the pixels of a window that are no background for an object of this diameter."""
        return self.background_limit_m[window] < diameter_m


def crop_to_region(view: ViewInput, margin: float = _REGION_MARGIN) -> ViewInput:
    """Crop a view to its mask, with a margin in which planes and neighbours are visible.

    The margin is a share of the larger side of the mask.
    """
    rows = view.mask.any(1).nonzero()[:, 0]
    columns = view.mask.any(0).nonzero()[:, 0]
    if len(rows) == 0:
        return view
    top, bottom = int(rows[0]), int(rows[-1])
    left, right = int(columns[0]), int(columns[-1])
    margin_px = int(margin * max(bottom - top, right - left))
    window = (
        slice(max(top - margin_px, 0), bottom + margin_px + 1),
        slice(max(left - margin_px, 0), right + margin_px + 1),
    )
    return crop_view(view, window)


def crop_view(view: ViewInput, window: Window) -> ViewInput:
    """Crop a view to rows and columns of its image."""
    # The colour image stays whole: its pixels are of its own camera, and it has its own K.
    background = view.background
    if background is not None:
        background = KnownBackground(
            depth_m=background.depth_m[window], is_seen=background.is_seen[window]
        )
    rows, columns = window
    return replace(
        view,
        depth_m=view.depth_m[window],
        mask=view.mask[window],
        K=crop_intrinsics(view.K, left=columns.start, top=rows.start),
        background=background,
        whole_m=view.depth_m if view.whole_m is None else view.whole_m,
    )


def prepare_frame(
    depth_m: Float[Tensor, "h w"],
    K: Float[Tensor, "3 3"],
    smallest_m: float | None = None,
    background: KnownBackground | None = None,
) -> Frame:
    """Thin a depth image, fit a normal at each pixel, and find the background.

    The background is the given one and, elsewhere, the widest planes.

    Args:
        depth_m: along the optical axis; NaN or 0 where there is no reading.
        K: intrinsic matrix.
        smallest_m: diameter of the smallest object that is looked for: the image is not thinned so
            much that it would be few pixels wide.
        background: surface before which the objects lie, of the whole image, where it is known.
    """
    depth_m = torch.where(depth_m.isfinite() & (depth_m > 0), depth_m, 0.0).double()
    noise_per_m2 = measure_noise_per_m2(depth_m)
    step = _thinning_step(depth_m, float(K[0, 0]), smallest_m)
    depth_m = depth_m[::step, ::step]
    K = K.double() / torch.tensor([[step], [step], [1]])
    points_m = back_project(depth_m, K)
    rays = back_project(torch.ones_like(depth_m), K)
    normals = torch.zeros_like(points_m)
    is_smooth = torch.zeros_like(depth_m, dtype=torch.bool)
    _fit_normals(array_of(depth_m), array_of(rays), array_of(K), normals.numpy(), is_smooth.numpy())

    # A known background is not searched for planes: one before it is made of objects.
    is_searched = depth_m > 0
    backgrounds: list[Background] = []
    if background is not None:
        background_m = background.depth_m[::step, ::step].double().nan_to_num(torch.inf)
        is_seen = background.is_seen[::step, ::step]
        known_background = Background(depth_m=background_m, is_seen=is_seen, diameter_m=math.inf)
        backgrounds.append(known_background)
        is_searched &= ~background_m.isfinite()
    backgrounds += find_wide_planes(depth_m, points_m, normals, rays, noise_per_m2, is_searched)
    limit_m = torch.zeros_like(depth_m)
    for surface in backgrounds:
        limit_m[surface.is_seen] = surface.diameter_m

    read_m = torch.where(depth_m > 0, depth_m, torch.inf)
    nearest_m = -max_pool2d(-read_m[None], 5, 1, 2)[0]
    return Frame(
        step=step, depth_m=depth_m, K=K, points_m=points_m, normals=normals, is_smooth=is_smooth,
        background_limit_m=limit_m, nearest_m=nearest_m, noise_per_m2=noise_per_m2,
        backgrounds=backgrounds,
    )  # fmt: skip


def _thinning_step(
    depth_m: Float64[Tensor, "h w"], focal_px: float, smallest_m: float | None
) -> int:
    """Choose the step between rows that are used: few pixels remain, but enough of an object."""
    step = math.ceil(math.sqrt(depth_m.numel() / _MOST_PIXELS))
    is_read = depth_m > 0
    if smallest_m is None or not bool(is_read.any()):
        return step
    object_px = smallest_m * focal_px / float(depth_m[is_read].median())
    return min(step, max(1, math.floor(object_px / _OBJECT_PX)))


@compiled
def _fit_normals(
    depth_m: Float64[np.ndarray, "h w"],
    rays: Float64[np.ndarray, "h w 3"],
    K: Float64[np.ndarray, "3 3"],
    normals: Float64[np.ndarray, "h w 3"],
    is_smooth: Bool[np.ndarray, "h w"],
) -> None:
    """Fit a plane to each reading and its neighbours; write its normal, and where the fit is good.

    In the image of a plane 1 / depth is linear in x and y: its slopes are fitted by least squares
    in a window, to the pixels that are of the same surface as the middle one.

    Args:
        depth_m: 0 where there is no reading.
        rays: points of the pixels at a depth of 1 m.
        K: intrinsic matrix.
        normals: output, written where there is a reading.
        is_smooth: output, set where there are enough neighbours, all round.
    """
    height, width = depth_m.shape
    least_neighbours = _LEAST_FILLED * (2 * _WINDOW + 1) ** 2
    for row in range(height):
        for column in range(width):
            middle_m = depth_m[row, column]
            if middle_m <= 0:
                continue
            inverse = 1 / middle_m
            limit = (JUMP_M + JUMP_PER_M * middle_m) * inverse * inverse

            # Sums over the neighbours of the same surface: their number, their offsets x and y
            # [px], the difference q of their 1 / depth to that of the middle, and products.
            n = 0
            x = y = q = 0.0
            xx = xy = yy = xq = yq = 0.0
            for v in range(max(0, row - _WINDOW), min(height, row + _WINDOW + 1)):
                for u in range(max(0, column - _WINDOW), min(width, column + _WINDOW + 1)):
                    if depth_m[v, u] <= 0:
                        continue
                    gap = 1 / depth_m[v, u] - inverse
                    if abs(gap) >= limit:
                        continue
                    right = u - column
                    down = v - row
                    n += 1
                    x += right
                    y += down
                    q += gap
                    xx += right * right
                    xy += right * down
                    yy += down * down
                    xq += right * gap
                    yq += down * gap

            # Means, and second moments about them.
            x /= n
            y /= n
            q /= n
            xx = xx / n - x * x
            xy = xy / n - x * y
            yy = yy / n - y * y
            xq = xq / n - x * q
            yq = yq / n - y * q

            # The slopes a and b of q by x and y, of least squares.
            spread = xx * yy - xy * xy
            a = (xq * yy - yq * xy) / max(spread, 1e-9)
            b = (yq * xx - xq * xy) / max(spread, 1e-9)

            # The plane n . X = -1 has 1 / depth = -(n_x x' + n_y y' + n_z) on the ray (x', y', 1).
            normal_x = a * K[0, 0]
            normal_y = b * K[1, 1] + a * K[0, 1]
            along = normal_x * rays[row, column, 0] + normal_y * rays[row, column, 1]
            normal_z = inverse + q - a * x - b * y - along
            length = math.sqrt(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z)
            normals[row, column, 0] = -normal_x / length
            normals[row, column, 1] = -normal_y / length
            normals[row, column, 2] = -normal_z / length
            is_smooth[row, column] = n >= least_neighbours and spread > _LEAST_SPREAD_PX4


class Readings(NamedTuple):
    """The readings of a frame in the directions of points."""

    pixel: Int64[Tensor, "*n"]  #: index of the pixel, row after row; 0 outside the image
    depth_m: Float64[Tensor, "*n"]
    is_read: Bool[Tensor, "*n"]  #: whether the pixel lies in the image and has a reading


def readings_toward(frame: Frame, points_m: Float64[Tensor, "*n 3"]) -> Readings:
    """Look up the readings in the directions of points of the camera frame."""
    height, width = frame.depth_m.shape
    column, row = project(points_m, frame.K).round().unbind(-1)
    is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    is_inside &= points_m[..., 2] > 0
    pixel = torch.where(is_inside, row * width + column, 0).long()
    depth_m = frame.depth_m.flatten()[pixel]
    return Readings(pixel, depth_m, is_inside & (depth_m > 0))


def is_on_background(
    depth_m: Float[Tensor, "h w"], background_m: Float[Tensor, "h w"]
) -> Bool[Tensor, "h w"]:
    """Mark the readings that lie on a known background, within the noise of a depth sensor.

    Edges may be displaced by a pixel in either image: a reading is of the background where it lies
    between the background's least and largest depth at the pixel and its neighbours.

    Args:
        depth_m: the image; 0 or NaN where there is no reading.
        background_m: depth of the background in the same image; NaN where it is not known.
    """
    read_m = torch.where(depth_m > 0, depth_m, 0.0).double()
    tolerance_m = math.sqrt(2) * plane_tolerance_m(read_m, measure_noise_per_m2(read_m))
    behind_m = background_m.double().nan_to_num(torch.inf)
    farthest_m = dilate_depth(behind_m, 1)
    nearest_m = -dilate_depth(-behind_m, 1)
    is_between = (read_m > nearest_m - tolerance_m) & (read_m < farthest_m + tolerance_m)
    return is_between & (read_m > 0) & farthest_m.isfinite()


def dilate_depth(values: Float64[Tensor, "h w"], reach: int) -> Float64[Tensor, "h w"]:
    """Return the largest finite value up to ``reach`` pixels away; infinite where there is none."""
    finite = torch.where(values.isfinite(), values, -torch.inf)
    size = 2 * reach + 1
    wide = max_pool2d(finite[None], (1, size), 1, (0, reach))
    largest = max_pool2d(wide, (size, 1), 1, (reach, 0))[0]
    return torch.where(largest.isfinite(), largest, torch.inf)
