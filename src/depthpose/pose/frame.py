"""A depth image prepared for a search: points, normals, and the background that is left out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor
from torch.nn.functional import max_pool2d

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import back_project, project
from depthpose.core.camera.pinhole import Window
from depthpose.pose.compiled import array_of, compiled
from depthpose.pose.sensor import NOISE_PER_M2, measure_noise_per_m2, plane_tolerance_m
from depthpose.pose.types import KnownBackground

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
_JUMP_M = 0.004
_JUMP_PER_M = 0.012
"""Neighbours lie on one surface if their depths differ by less than the first, in metres, and the
second times the depth together."""

# Wide planes.
_MOST_PLANES = 6  # largest number of wide planes that are looked for in an image
_HYPOTHESES = 400  # planes through three readings that RANSAC compares
_REFITS = 3  # times that a plane is fitted again to the readings on it
_SAMPLE = 4000  # largest number of readings that a plane is fitted to
_LEAST_SHARE = 0.04
"""A plane that holds a smaller share of the image's readings is no table or wall."""
_LEAST_POINTS = 60
"""Least number of readings that a plane is fitted to."""
_BEND_REFITS = 3
"""Fits of the bend that the sensor gives a plane, each to the readings on the fit before."""
_PARALLEL_COSINE = math.cos(math.radians(20))
"""Least cosine between a plane's normal and that of a reading that it may hold."""
_MOST_BEHIND = 0.08
"""Largest share of the readings within the outline of a table or wall that lie behind it. Real
tables have up to 4 %, planes through the tops of several parts from 12 % on."""
_BEHIND_TOLERANCES = 2
"""Tolerances of a plane, by more than which a reading must lie behind it to count as behind."""
_WIDTH_RATIO = 1.3
_LENGTH_RATIO = 3.0
"""A plane is no side of an object if its width is above the first ratio times the diameter of the
object, or its length above the second. The second is larger because sides of several objects may
lie in one plane and touch."""


WHOLE = (slice(None), slice(None))
"""The window that is the whole image."""


class Plane(NamedTuple):
    """A plane in the camera frame: the points whose dot product with the normal is the offset."""

    normal: Float64[Tensor, "3"]  #: of length 1
    offset_m: Float64[Tensor, ""]  #: distance of the plane from the camera, along the normal


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
    backgrounds: Sequence["Background"]  #: the one that was given, if any, and the wide planes

    def may_show(self, diameter_m: float, window: Window = WHOLE) -> Bool[Tensor, "h w"]:
        """Mark the pixels of a window that are no background for an object of this diameter."""
        return self.background_limit_m[window] < diameter_m


@dataclass(frozen=True, kw_only=True, eq=False)
class Background:
    """A surface before which objects lie: a known bin or table, or a wide plane."""

    #: depth at which the ray of a pixel meets the surface, also behind objects; infinite where the
    #: ray does not meet it, or where that is not known.
    depth_m: Float64[Tensor, "h w"]
    diameter_m: float  #: largest diameter of an object that cannot have it as a side


def prepare_frame(
    depth_m: Float[Tensor, "h w"],
    K: Float[Tensor, "3 3"],
    smallest_m: float | None = None,
    background: KnownBackground | None = None,
) -> Frame:
    """Thin a depth image, fit a normal at each pixel, and find the background.

    The background is the given one and, elsewhere, the widest planes, which are found one after the
    other by RANSAC (Fischler and Bolles 1981).

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
        is_searched &= ~background_m.isfinite()
        backgrounds.append(Background(depth_m=background_m, diameter_m=math.inf))
    planes, limit_m = _wide_planes(depth_m, points_m, normals, rays, noise_per_m2, is_searched)
    backgrounds += planes
    if background is not None:
        limit_m[background.is_seen[::step, ::step] & (limit_m == 0)] = torch.inf

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
            limit = (_JUMP_M + _JUMP_PER_M * middle_m) * inverse * inverse

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


def _wide_planes(
    depth_m: Float64[Tensor, "h w"],
    points_m: Float64[Tensor, "h w 3"],
    normals: Float64[Tensor, "h w 3"],
    rays: Float64[Tensor, "h w 3"],
    noise_per_m2: float,
    is_searched: Bool[Tensor, "h w"],
) -> tuple[list[Background], Float64[Tensor, "h w"]]:
    """Find tables and walls one after the other; return them and ``Frame.background_limit_m``.

    Args:
        depth_m: 0 where there is no reading.
        points_m: the readings as points of the camera frame.
        normals: unit normals at the readings, toward the camera.
        rays: points of the pixels at a depth of 1 m.
        noise_per_m2: as in :class:`Frame`.
        is_searched: readings that may be of a plane.
    """
    is_free = is_searched.clone()  # of no plane yet
    limit_m = torch.zeros_like(depth_m)
    planes: list[Background] = []
    least_px = max(_LEAST_POINTS, _LEAST_SHARE * int((depth_m > 0).sum()))
    generator = torch.Generator().manual_seed(0)  # the same image, the same planes
    for _ in range(_MOST_PLANES):
        # The plane of the most readings.
        plane = largest_plane(points_m[is_free], generator, noise_per_m2)
        if plane is None:
            break
        is_near = is_on_plane(points_m, plane, noise_per_m2) & is_free
        if int(is_near.sum()) < least_px:
            break

        # Its largest connected piece, and the pieces of the surface as the sensor bends it.
        is_parallel = is_free & ((normals @ plane.normal).abs() > _PARALLEL_COSINE)
        is_bent = is_near | _is_on_bent_plane(points_m, plane, is_near, is_parallel, noise_per_m2)
        piece, surface = _pieces_of_plane(depth_m, is_near, is_bent)
        is_free &= ~is_near
        if int(piece.sum()) < least_px:
            continue
        is_free &= ~surface

        # No readings lie behind a table or wall; a plane through the tops of parts has gaps.
        plane_depth_m = plane.offset_m / (rays @ plane.normal)
        plane_depth_m = torch.where(plane_depth_m > 0, plane_depth_m, torch.inf)
        behind_share = _share_of_readings_behind(depth_m, plane_depth_m, surface, noise_per_m2)
        if behind_share > _MOST_BEHIND:
            continue

        diameter_m = _largest_background_diameter(points_m[piece])
        limit_m[surface] = diameter_m
        planes.append(Background(depth_m=plane_depth_m, diameter_m=diameter_m))
    return planes, limit_m


def _pieces_of_plane(
    depth_m: Float64[Tensor, "h w"], is_near: Bool[Tensor, "h w"], is_bent: Bool[Tensor, "h w"]
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Find the largest connected piece of a plane, and all of the bent plane that belongs to it.

    Args:
        depth_m: 0 where there is no reading.
        is_near: readings on the flat plane.
        is_bent: readings on the plane as the sensor bends it, those on the flat one among them.

    Returns:
        The flat readings of the largest piece; and the bent pieces of which more than half is flat.
    """
    label = label_regions(depth_m, is_bent)
    near_px = torch.bincount(label[is_near], minlength=int(label.max()) + 1)
    bent_px = torch.bincount(label[is_bent], minlength=len(near_px))
    piece = is_near & (label == near_px.argmax())
    surface = (near_px > 0.5 * bent_px)[label] & is_bent
    return piece, surface


def _share_of_readings_behind(
    depth_m: Float64[Tensor, "h w"],
    plane_depth_m: Float64[Tensor, "h w"],
    surface: Bool[Tensor, "h w"],
    noise_per_m2: float,
) -> float:
    """Measure the share of readings within the outline of a surface that lie behind its plane."""
    margin_m = _BEHIND_TOLERANCES * plane_tolerance_m(plane_depth_m, noise_per_m2)
    is_behind = depth_m > plane_depth_m + margin_m
    is_read_within = _fill_outline(surface) & (depth_m > 0)
    return float(is_behind[is_read_within].double().mean())


def _largest_background_diameter(points_m: Float64[Tensor, "n 3"]) -> float:
    """Measure the diameter from which on an object may have a plane so wide and long as a side."""
    some_m = take_evenly(points_m, _SAMPLE)
    offset_m = some_m - some_m.mean(0)
    # Ascending: the first axis is the plane's normal, the second its width, the third its length.
    # Both are measured without the outermost 5 % of the points at each end.
    _, axes = torch.linalg.eigh(offset_m.T @ offset_m)
    along_m = offset_m @ axes[:, 1:]
    width_m, length_m = (along_m.quantile(0.95, 0) - along_m.quantile(0.05, 0)).tolist()
    return max(width_m / _WIDTH_RATIO, length_m / _LENGTH_RATIO)


def _fill_outline(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Fill a mask: add the pixels between two of its pixels both in their row and their column."""
    is_within = torch.ones_like(mask)
    for axis in (0, 1):
        is_after = mask.int().cummax(axis).values > 0
        is_before = mask.flip(axis).int().cummax(axis).values.flip(axis) > 0
        is_within &= is_after & is_before
    return is_within


def _is_on_bent_plane(
    points_m: Float64[Tensor, "h w 3"],
    plane: Plane,
    is_near: Bool[Tensor, "h w"],
    is_parallel: Bool[Tensor, "h w"],
    noise_per_m2: float,
) -> Bool[Tensor, "h w"]:
    """Mark the readings on a plane as the sensor bends it.

    The bend is a quadratic in x and y of the image, fitted to the readings on it, from those near
    the flat plane on.

    Args:
        points_m: the readings as points of the camera frame.
        plane: the flat one.
        is_near: readings on it.
        is_parallel: readings whose normals are parallel to the plane's; no others are marked.
        noise_per_m2: as in :class:`Frame`.
    """
    parallel_m = points_m[is_parallel]
    off_m = parallel_m @ plane.normal - plane.offset_m
    x, y = (parallel_m[:, :2] / parallel_m[:, 2:].clamp(min=1e-6)).unbind(-1)
    terms = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1)
    tolerance_m = plane_tolerance_m(parallel_m[:, 2], noise_per_m2)
    is_on = is_near[is_parallel]
    for _ in range(_BEND_REFITS):
        A = take_evenly(terms[is_on], _SAMPLE)
        b = take_evenly(off_m[is_on], _SAMPLE)
        if len(b) < _LEAST_POINTS:
            break
        coefficients = torch.linalg.lstsq(A, b[:, None]).solution
        bend_m = (terms @ coefficients)[:, 0]
        is_on = (off_m - bend_m).abs() < tolerance_m
    is_on_bend = torch.zeros_like(is_parallel)
    is_on_bend[is_parallel] = is_on
    return is_on_bend


def largest_plane(
    points_m: Float64[Tensor, "n 3"], generator: torch.Generator, noise_per_m2: float = NOISE_PER_M2
) -> Plane | None:
    """Find the plane that most points lie on, by RANSAC; None for fewer than 60 points."""
    some_m = take_evenly(points_m, _SAMPLE)
    if len(some_m) < _LEAST_POINTS:
        return None

    # Planes through three points each; the one with the most points on it.
    triple = torch.randint(len(some_m), (_HYPOTHESES, 3), generator=generator)
    a, b, c = some_m[triple].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    length = normal.norm(dim=-1, keepdim=True)
    normal = normal / length.clamp(min=1e-12)
    offset_m = (normal * a).sum(-1)
    tolerance_m = plane_tolerance_m(some_m[:, 2], noise_per_m2)
    is_on = (some_m @ normal.T - offset_m).abs() < tolerance_m[:, None]
    is_on &= length[:, 0] > 1e-8  # three points on a line make no plane
    best = int(is_on.sum(0).argmax())
    plane = Plane(normal[best], offset_m[best])

    # Refitted to the points on it.
    for _ in range(_REFITS):
        near_m = some_m[is_on_plane(some_m, plane, noise_per_m2)]
        if len(near_m) < 3:
            return None
        middle_m = near_m.mean(0)
        _, axes = torch.linalg.eigh((near_m - middle_m).T @ (near_m - middle_m))
        plane = Plane(axes[:, 0], axes[:, 0] @ middle_m)
    return plane


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


def share_behind(
    frame: Frame, background: Background, points_m: Float64[Tensor, "n 3"], margin_m: float
) -> float:
    """Measure the share of points that lie behind a background, where it is not observed to end.

    Args:
        frame: the image.
        background: one of the image.
        points_m: points of a posed surface, in the camera frame.
        margin_m: distance behind the background, beyond the sensor's noise, from which a point
            counts.

    Returns:
        Between 0 and 1.
    """
    # Within the margin of a point the background is no deeper than its deepest pixel there.
    margin_px = margin_m * float(frame.K[0, 0] / points_m[:, 2].median().clamp(min=1e-6))
    reach = min(math.ceil(margin_px), min(frame.depth_m.shape) // 2)
    readings = readings_toward(frame, points_m)
    row = readings.pixel // frame.depth_m.shape[1]
    column = readings.pixel % frame.depth_m.shape[1]
    top = max(0, int(row.min()) - reach)
    left = max(0, int(column.min()) - reach)
    bottom = int(row.max()) + reach + 1
    right = int(column.max()) + reach + 1
    deepest_m = _largest_about(background.depth_m[top:bottom, left:right], reach)
    limit_m = deepest_m[row - top, column - left]
    limit_m = limit_m + margin_m + plane_tolerance_m(limit_m, frame.noise_per_m2)
    # Where the camera saw farther than the background it has ended; what lies before it hides it.
    is_present = readings.is_read & (readings.depth_m < limit_m)
    is_behind = points_m[:, 2] > limit_m
    return float((is_present & is_behind).double().mean())


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
    farthest_m = _largest_about(behind_m, 1)
    nearest_m = -_largest_about(-behind_m, 1)
    is_between = (read_m > nearest_m - tolerance_m) & (read_m < farthest_m + tolerance_m)
    return is_between & (read_m > 0) & farthest_m.isfinite()


def _largest_about(values: Float64[Tensor, "h w"], reach: int) -> Float64[Tensor, "h w"]:
    """Return the largest finite value up to ``reach`` pixels away; infinite where there is none."""
    finite = torch.where(values.isfinite(), values, -torch.inf)
    size = 2 * reach + 1
    wide = max_pool2d(finite[None], (1, size), 1, (0, reach))
    largest = max_pool2d(wide, (size, 1), 1, (reach, 0))[0]
    return torch.where(largest.isfinite(), largest, torch.inf)


def is_on_plane(
    points_m: Float64[Tensor, "*batch 3"], plane: Plane, noise_per_m2: float = NOISE_PER_M2
) -> Bool[Tensor, "*batch"]:
    """Whether points of the camera frame lie on a plane, within the noise of a depth sensor."""
    tolerance_m = plane_tolerance_m(points_m[..., 2], noise_per_m2)
    return (points_m @ plane.normal - plane.offset_m).abs() < tolerance_m


def label_regions(
    depth_m: Float64[Tensor, "h w"], is_counted: Bool[Tensor, "h w"]
) -> Int64[Tensor, "h w"]:
    """Label the connected regions of the marked pixels, each by the index of one of its pixels.

    Neighbours, diagonal ones too, are connected where their depth does not jump. Each pixel that is
    not marked is a region of its own.
    """
    label = _label_regions(array_of(depth_m), array_of(is_counted))
    return torch.from_numpy(label).reshape(depth_m.shape)


# The half of the eight neighbours that a scan by rows meets before the pixel: (row, column) steps.
_EARLIER_NEIGHBOURS = ((-1, -1), (-1, 0), (-1, 1), (0, -1))


@compiled
def _label_regions(
    depth_m: Float64[np.ndarray, "h w"], is_counted: Bool[np.ndarray, "h w"]
) -> Int64[np.ndarray, " pixels"]:
    """Do as :func:`label_regions`, by union-find: a pixel points toward the root of its region."""
    height, width = depth_m.shape
    parent = np.arange(height * width)
    for row in range(height):
        for column in range(width):
            if not is_counted[row, column]:
                continue
            for row_step, column_step in _EARLIER_NEIGHBOURS:
                other_row = row + row_step
                other_column = column + column_step
                if other_row < 0 or other_column < 0 or other_column >= width:
                    continue
                if not is_counted[other_row, other_column]:
                    continue
                here_m = depth_m[row, column]
                there_m = depth_m[other_row, other_column]
                if abs(here_m - there_m) < _JUMP_M + _JUMP_PER_M * min(here_m, there_m):
                    root = _find_root(parent, row * width + column)
                    parent[root] = _find_root(parent, other_row * width + other_column)
    for pixel in range(len(parent)):
        parent[pixel] = _find_root(parent, pixel)
    return parent


@compiled
def _find_root(parent: Int64[np.ndarray, " pixels"], pixel: int) -> int:
    """Find the root of a pixel's region, and halve the path to it."""
    while parent[pixel] != pixel:
        parent[pixel] = parent[parent[pixel]]
        pixel = parent[pixel]
    return pixel
