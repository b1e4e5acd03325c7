"""Planes in the readings of a depth sensor; the wide ones are tables and walls behind objects."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.pose.compiled import array_of, compiled
from depthpose.pose.sensor import NOISE_PER_M2, plane_tolerance_m

JUMP_M = 0.004
JUMP_PER_M = 0.012
"""Neighbours lie on one surface if their depths differ by less than the first, in metres, and the
second times the depth together."""

# Fits.
_HYPOTHESES = 400  # planes through three readings that RANSAC compares
_REFITS = 3  # times that a plane is fitted again to the readings on it
_SAMPLE = 4000  # largest number of readings that a plane is fitted to
_LEAST_POINTS = 60
"""Least number of readings that a plane is fitted to."""
_BEND_REFITS = 3
"""Fits of the bend that the sensor gives a plane, each to the readings on the fit before."""

# Wide planes.
_MOST_PLANES = 6  # largest number of wide planes that are looked for in an image
_LEAST_SHARE = 0.04
"""A plane that holds a smaller share of the image's readings is no table or wall."""
_PARALLEL_COSINE = math.cos(math.radians(20))
"""Least cosine between a plane's normal and that of a reading that it may hold."""
_LEAST_FLAT = 0.5
"""A connected piece of a bent plane belongs to it if a larger share lies on the flat one."""
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


class Plane(NamedTuple):
    """A plane in the camera frame: the points whose dot product with the normal is the offset."""

    normal: Float64[Tensor, "3"]  #: of length 1
    offset_m: Float64[Tensor, ""]  #: distance of the plane from the camera, along the normal

    def height_m(self, points_m: Float64[Tensor, "*batch 3"]) -> Float64[Tensor, "*batch"]:
        """Measure the signed distance of points from the plane, along its normal."""
        return points_m @ self.normal - self.offset_m


@dataclass(frozen=True, kw_only=True, eq=False)
class Background:
    """A surface before which objects lie: a known bin or table, or a wide plane."""

    #: depth at which the ray of a pixel meets the surface, also behind objects; infinite where the
    #: ray does not meet it, or where that is not known.
    depth_m: Float64[Tensor, "h w"]
    is_seen: Bool[Tensor, "h w"]  #: whether the reading of the pixel lies on it
    diameter_m: float  #: largest diameter of an object that cannot have it as a side


def find_wide_planes(
    depth_m: Float64[Tensor, "h w"],
    points_m: Float64[Tensor, "h w 3"],
    normals: Float64[Tensor, "h w 3"],
    rays: Float64[Tensor, "h w 3"],
    noise_per_m2: float,
    is_searched: Bool[Tensor, "h w"],
) -> list[Background]:
    """Find tables and walls one after the other, each in the readings that the others leave.

    A table or wall is a plane with many readings, of which many are connected, and with few
    readings behind it. A sensor bends it, so that its readings are those of a quadratic about it.

    Args:
        depth_m: 0 where there is no reading.
        points_m: the readings as points of the camera frame.
        normals: unit normals at the readings, toward the camera.
        rays: points of the pixels at a depth of 1 m.
        noise_per_m2: standard deviation of a reading, for the square of its depth in metres.
        is_searched: readings that may be of a plane.
    """
    is_free = is_searched.clone()  # of no plane yet
    planes: list[Background] = []
    least_px = max(_LEAST_POINTS, _LEAST_SHARE * int((depth_m > 0).sum()))
    generator = torch.Generator().manual_seed(0)  # the same image, the same planes
    for _ in range(_MOST_PLANES):
        # The plane of the most readings.
        plane = largest_plane(points_m[is_free], generator, noise_per_m2)
        if plane is None:
            break
        is_flat = is_free & is_on_plane(points_m, plane, noise_per_m2)
        if int(is_flat.sum()) < least_px:
            break

        # What is connected in it: its largest piece says how large it is, and whether it is one.
        is_parallel = is_free & ((normals @ plane.normal).abs() > _PARALLEL_COSINE)
        is_bent = is_flat | _is_on_bent_plane(points_m, plane, is_flat, is_parallel, noise_per_m2)
        label = label_regions(depth_m, is_bent)
        largest = _largest_region(label, is_flat)
        is_free &= ~is_flat
        if int(largest.sum()) < least_px:
            continue
        is_seen = _regions_mostly_in(label, is_flat, is_bent)
        is_free &= ~is_seen

        # No readings lie behind a table or wall; a plane through the tops of parts has gaps.
        plane_depth_m = plane.offset_m / (rays @ plane.normal)
        plane_depth_m = torch.where(plane_depth_m > 0, plane_depth_m, torch.inf)
        behind_share = _share_of_readings_behind(depth_m, plane_depth_m, is_seen, noise_per_m2)
        if behind_share <= _MOST_BEHIND:
            diameter_m = _largest_background_diameter(points_m[largest])
            planes.append(Background(depth_m=plane_depth_m, is_seen=is_seen, diameter_m=diameter_m))
    return planes


def _is_on_bent_plane(
    points_m: Float64[Tensor, "h w 3"],
    plane: Plane,
    is_flat: Bool[Tensor, "h w"],
    is_parallel: Bool[Tensor, "h w"],
    noise_per_m2: float,
) -> Bool[Tensor, "h w"]:
    """Mark the readings on a plane as the sensor bends it.

    Errors of calibration bend planes smoothly. The bend is a quadratic in x and y of the image; it
    is fitted to the readings on it several times, first to those on the flat plane.

    Args:
        points_m: the readings as points of the camera frame.
        plane: the flat one.
        is_flat: readings on it.
        is_parallel: readings whose normals are parallel to the plane's; no others are marked.
        noise_per_m2: as in :func:`find_wide_planes`.
    """
    parallel_m = points_m[is_parallel]
    off_m = plane.height_m(parallel_m)
    x, y = (parallel_m[:, :2] / parallel_m[:, 2:].clamp(min=1e-6)).unbind(-1)
    terms = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1)
    tolerance_m = plane_tolerance_m(parallel_m[:, 2], noise_per_m2)
    is_on = is_flat[is_parallel]
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


def _largest_region(label: Int64[Tensor, "h w"], mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Mark the pixels of a mask that are of the region with the most of them."""
    return mask & (label == torch.bincount(label[mask]).argmax())


def _regions_mostly_in(
    label: Int64[Tensor, "h w"], part: Bool[Tensor, "h w"], whole: Bool[Tensor, "h w"]
) -> Bool[Tensor, "h w"]:
    """Mark the regions of a whole mask of which most pixels are in a part of the mask.

    Regions of a bent plane that are hardly on the flat one are other things beside it.
    """
    whole_px = torch.bincount(label[whole], minlength=label.numel())  # a label is a pixel's index
    part_px = torch.bincount(label[part], minlength=label.numel())
    return (part_px > _LEAST_FLAT * whole_px)[label] & whole


def _share_of_readings_behind(
    depth_m: Float64[Tensor, "h w"],
    plane_depth_m: Float64[Tensor, "h w"],
    surface: Bool[Tensor, "h w"],
    noise_per_m2: float,
) -> float:
    """Measure the share of readings within the outline of a surface that lie behind its plane.

    It is the test of free space: what the camera sees through is no surface.
    """
    margin_m = _BEHIND_TOLERANCES * plane_tolerance_m(plane_depth_m, noise_per_m2)
    is_behind = depth_m > plane_depth_m + margin_m
    is_read_within = _fill_outline(surface) & (depth_m > 0)
    return float(is_behind[is_read_within].double().mean())


def _fill_outline(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Fill the gaps of a mask: pixels between two of its own in their row and in their column."""
    is_within = torch.ones_like(mask)
    for axis in (0, 1):
        is_after = mask.int().cummax(axis).values > 0
        is_before = mask.flip(axis).int().cummax(axis).values.flip(axis) > 0
        is_within &= is_after & is_before
    return is_within


def _largest_background_diameter(points_m: Float64[Tensor, "n 3"]) -> float:
    """Measure the diameter from which on an object may have a plane of this extent as a side.

    ``points_m`` are on the plane. Its width and length are along its principal axes.
    """
    some_m = take_evenly(points_m, _SAMPLE)
    offset_m = some_m - some_m.mean(0)
    # Ascending: the first axis is the plane's normal, the second its width, the third its length.
    # Both are measured without the outermost 5 % of the points at each end.
    _, axes = torch.linalg.eigh(offset_m.T @ offset_m)
    along_m = offset_m @ axes[:, 1:]
    width_m, length_m = (along_m.quantile(0.95, 0) - along_m.quantile(0.05, 0)).tolist()
    return max(width_m / _WIDTH_RATIO, length_m / _LENGTH_RATIO)


def largest_plane(
    points_m: Float64[Tensor, "n 3"], generator: torch.Generator, noise_per_m2: float = NOISE_PER_M2
) -> Plane | None:
    """Find the plane that most points lie on by RANSAC (Fischler and Bolles 1981).

    None for fewer than 60 points.
    """
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


def is_on_plane(
    points_m: Float64[Tensor, "*batch 3"], plane: Plane, noise_per_m2: float = NOISE_PER_M2
) -> Bool[Tensor, "*batch"]:
    """Whether points of the camera frame lie on a plane, within the noise of a depth sensor."""
    tolerance_m = plane_tolerance_m(points_m[..., 2], noise_per_m2)
    return plane.height_m(points_m).abs() < tolerance_m


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
                if abs(here_m - there_m) < JUMP_M + JUMP_PER_M * min(here_m, there_m):
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
