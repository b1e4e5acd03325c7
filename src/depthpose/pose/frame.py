"""A depth image prepared for a search: points, normals, and the background that is left out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize, pad

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import back_project, project
from depthpose.pose.sensor import NOISE_PER_M2, measure_noise_per_m2, plane_tolerance_m
from depthpose.pose.types import KnownBackground

_MOST_PIXELS = 110_000
"""Of a larger image every n-th row and column is used, so that about so many pixels remain."""
_OBJECT_PX = 60
"""Pixels that an object is wide at least, if the image has them."""
_WINDOW = 3
"""Pixels to each side of one through which its plane is laid."""
_FILLED = 0.4
"""Least share of the window that is of the same surface."""
_BENDINGS = 3
"""A sensor bends walls: what lies on a plane is found again so often, each time bent as it was."""
_ALONG = math.cos(math.radians(20))
_JUMP_M = 0.004
_JUMP_PER_M = 0.012
"""Neighbours are of one surface up to this difference in depth, and this share of it."""
_PLANES = 6
_HYPOTHESES = 400
_SAMPLE = 4000
_LEAST_SHARE = 0.04
"""Of the readings: a plane of fewer is no table or wall."""
_LEAST_POINTS = 60
_SEEN_BEHIND = 0.08
"""Of the readings within its outline no more lie behind a table or wall. Real ones have up to 4 %,
planes through the tops of several parts from 12 % on."""
_WIDER, _LONGER = 1.3, 3.0
"""A plane that is wider than an object by so much is none of its sides; nor is one that is so much
longer, but for sides of several that lie in one plane and touch."""


Plane = tuple[Float64[Tensor, "3"], Float64[Tensor, ""]]
"""Unit normal, and the distance [m] of the origin along it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """A depth image, thinned to some hundred thousand pixels.

    Attributes:
        step: every so many rows and columns of the image are used.
        depth_m: 0 where there is no reading.
        K: of the thinned image.
        points_m: in the camera frame.
        normals: toward the camera.
        is_smooth: where a normal is known.
        background_limit_m: up to this diameter [m] an object is too small to have the wide plane at
            a pixel as a side, so that for it the pixel is background; infinite on a known
            background, 0 elsewhere. What it means for an object is :meth:`may_show`.
        nearest_m: least depth of the pixels up to two away; infinite where none has a reading.
        noise_per_m2: standard deviation of a reading, for the square of the depth in metres.
        backgrounds: the known one, and the wide planes.
    """

    step: int
    depth_m: Float64[Tensor, "h w"]
    K: Float64[Tensor, "3 3"]
    points_m: Float64[Tensor, "h w 3"]
    normals: Float64[Tensor, "h w 3"]
    is_smooth: Bool[Tensor, "h w"]
    background_limit_m: Float64[Tensor, "h w"]
    nearest_m: Float64[Tensor, "h w"]
    noise_per_m2: float
    backgrounds: Sequence["Background"]

    def may_show(self, diameter_m: float) -> Bool[Tensor, "h w"]:
        """Mark the pixels that are of no background before which an object so large lies."""
        return self.background_limit_m < diameter_m


@dataclass(frozen=True, kw_only=True, eq=False)
class Background:
    """A surface before which objects lie: a known bin or table, or a wide plane.

    Attributes:
        depth_m: at which the ray of a pixel meets it, behind objects too; infinite where it does
            not, or nothing is known.
        diameter_m: up to which no object has it as a side, as ``Frame.background_limit_m``.
    """

    depth_m: Float64[Tensor, "h w"]
    diameter_m: float


def prepare_frame(
    depth_m: Float[Tensor, "h w"],
    K: Float[Tensor, "3 3"],
    smallest_m: float | None = None,
    known: KnownBackground | None = None,
) -> Frame:
    """Lay a plane through the neighbours of each pixel, and find the background.

    Beside the known one it is the widest planes, which are found one after the other by RANSAC
    (Fischler and Bolles 1981) and refitted.

    Args:
        depth_m: along the optical axis; NaN or 0 where there is no reading.
        K: intrinsic matrix.
        smallest_m: diameter of the smallest object that is looked for: the image is not thinned so
            much that it would be few pixels wide.
        known: background that is known, of the whole image.
    """
    # Thinned, but not so much that the smallest object would be few pixels wide.
    depth_m = torch.where(depth_m.isfinite() & (depth_m > 0), depth_m, 0.0).double()
    noise_per_m2 = measure_noise_per_m2(depth_m)
    step = math.ceil(math.sqrt(depth_m.numel() / _MOST_PIXELS))
    is_read = depth_m > 0
    if smallest_m is not None and bool(is_read.any()):
        object_px = smallest_m * float(K[0, 0]) / float(depth_m[is_read].median())
        step = min(step, max(1, math.floor(object_px / _OBJECT_PX)))
    depth_m = depth_m[::step, ::step]
    K = K.double() / torch.tensor([[step], [step], [1]])

    points_m = back_project(depth_m, K)
    normals, is_smooth = _normals(depth_m, points_m, K)

    # The background: a known one, and elsewhere wide planes.
    is_searched = depth_m > 0
    backgrounds: list[Background] = []
    if known is not None:  # a plane before a known background is made of objects
        known_m = known.depth_m[::step, ::step].double().nan_to_num(torch.inf)
        is_searched &= ~known_m.isfinite()
        backgrounds.append(Background(depth_m=known_m, diameter_m=math.inf))
    rays = back_project(torch.ones_like(depth_m), K)
    planes, limit_m = _wide_planes(depth_m, points_m, normals, rays, noise_per_m2, is_searched)
    backgrounds += planes
    if known is not None:
        limit_m[known.is_seen[::step, ::step] & (limit_m == 0)] = torch.inf
    nearest_m = -max_pool2d(-torch.where(depth_m > 0, depth_m, torch.inf)[None], 5, 1, 2)[0]
    return Frame(
        step=step, depth_m=depth_m, K=K, points_m=points_m, normals=normals, is_smooth=is_smooth,
        background_limit_m=limit_m, nearest_m=nearest_m, noise_per_m2=noise_per_m2,
        backgrounds=backgrounds,
    )  # fmt: skip


def _normals(
    depth_m: Float64[Tensor, "h w"], points_m: Float64[Tensor, "h w 3"], K: Float64[Tensor, "3 3"]
) -> tuple[Float64[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
    """Fit 1 / depth, which is linear in the picture of a plane, in a window of the same surface."""
    height, width = depth_m.shape
    depth_m = depth_m.float()  # differences of neighbours are exact enough, and twice as fast
    inverse = torch.where(depth_m > 0, 1 / depth_m, 0.0)
    limit = (_JUMP_M + _JUMP_PER_M * depth_m) * inverse.square()
    padded = pad(inverse, (_WINDOW,) * 4)
    side = 2 * _WINDOW + 1

    # Sums over the neighbours of the same surface: their number, the places x and y, what q their
    # 1 / depth is beyond that of the middle, and products of these.
    n, x, y, q, xx, xy, yy, xq, yq = depth_m.new_zeros(9, height, width)
    for down in range(-_WINDOW, _WINDOW + 1):
        for right in range(-_WINDOW, _WINDOW + 1):
            top, left = _WINDOW + down, _WINDOW + right
            other = padded[top : top + height, left : left + width]
            gap = other - inverse
            is_same = ((other > 0) & (gap.abs() < limit)).to(depth_m)
            gap = gap * is_same
            n += is_same
            x += right * is_same
            y += down * is_same
            q += gap
            xx += right * right * is_same
            xy += right * down * is_same
            yy += down * down * is_same
            xq += right * gap
            yq += down * gap

    # Means, and second moments about them.
    count = n.clamp(min=1)
    x, y, q = x / count, y / count, q / count
    xx, xy, yy = xx / count - x * x, xy / count - x * y, yy / count - y * y
    xq, yq = xq / count - x * q, yq / count - y * q

    # The slopes a and b of q by x and y, of least squares.
    spread = xx * yy - xy * xy
    a = (xq * yy - yq * xy) / spread.clamp(min=1e-9)
    b = (yq * xx - xq * xy) / spread.clamp(min=1e-9)

    # n . X = -1 for the ray (x', y', 1): 1 / depth = -(n_x x' + n_y y' + n_z).
    along = torch.stack([a * K[0, 0], b * K[1, 1]], -1)
    ray = torch.where((depth_m > 0)[..., None], points_m[..., :2] * inverse[..., None], 0.0)
    last = inverse + q - a * x - b * y - (along * ray).sum(-1)
    normals = -normalize(torch.cat([along, last[..., None]], -1), dim=-1)
    return normals.double(), (n >= _FILLED * side * side) & (spread > 0.3) & (depth_m > 0)


def _wide_planes(
    depth_m: Float64[Tensor, "h w"],
    points_m: Float64[Tensor, "h w 3"],
    normals: Float64[Tensor, "h w 3"],
    rays: Float64[Tensor, "h w 3"],
    noise_per_m2: float,
    is_searched: Bool[Tensor, "h w"],
) -> tuple[list[Background], Float64[Tensor, "h w"]]:
    """Find wide planes one after the other by RANSAC; give them and ``Frame.background_limit_m``.

    Args:
        depth_m: 0 where there is no reading.
        points_m: in the camera frame.
        normals: toward the camera.
        rays: points of the pixels at a depth of 1 m.
        noise_per_m2: as in :class:`Frame`.
        is_searched: readings that may be of a plane.
    """
    is_left = is_searched.clone()  # of no plane yet
    limit_m = torch.zeros_like(depth_m)
    planes: list[Background] = []
    least = max(_LEAST_POINTS, _LEAST_SHARE * int((depth_m > 0).sum()))
    generator = torch.Generator().manual_seed(0)
    for _ in range(_PLANES):
        # The plane of the most readings.
        plane = largest_plane(points_m[is_left], generator, noise_per_m2)
        if plane is None:
            break
        is_near = is_on_plane(points_m, plane, noise_per_m2) & is_left
        if int(is_near.sum()) < least:
            break

        # The largest connected piece of it, and all that joins such pieces as the sensor bends it.
        is_along = is_left & ((normals @ plane[0]).abs() > _ALONG)
        is_bent = is_near | _bent(points_m, plane, is_near, is_along, noise_per_m2)
        label = label_regions(depth_m, is_bent)
        near_px = torch.bincount(label[is_near], minlength=int(label.max()) + 1)
        bent_px = torch.bincount(label[is_bent], minlength=len(near_px))
        piece = is_near & (label == near_px.argmax())
        is_left &= ~is_near
        if int(piece.sum()) < least:
            continue
        joined = (near_px > 0.5 * bent_px)[label] & is_bent
        is_left &= ~joined

        # Nothing is seen behind a table or wall; a plane through the tops of parts has gaps.
        on_rays_m = plane[1] / (rays @ plane[0])
        on_rays_m = torch.where(on_rays_m > 0, on_rays_m, torch.inf)
        is_behind = depth_m > on_rays_m + 2 * plane_tolerance_m(on_rays_m, noise_per_m2)
        is_read_within = _outline(joined) & (depth_m > 0)
        if float(is_behind[is_read_within].double().mean()) > _SEEN_BEHIND:
            continue

        # An object of up to this diameter has no side as wide or as long.
        some = take_evenly(points_m[piece], _SAMPLE)
        offset = some - some.mean(0)
        _, axes = torch.linalg.eigh(offset.T @ offset)
        along = offset @ axes[:, 1:]
        width_m, length_m = (along.quantile(0.95, 0) - along.quantile(0.05, 0)).tolist()
        diameter_m = max(width_m / _WIDER, length_m / _LONGER)
        limit_m[joined] = diameter_m
        planes.append(Background(depth_m=on_rays_m, diameter_m=diameter_m))
    return planes, limit_m


def _outline(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Fill a mask: what lies between two of its pixels both in its row and in its column."""
    is_within = torch.ones_like(mask)
    for along in (0, 1):
        is_after = mask.int().cummax(along).values > 0
        is_before = mask.flip(along).int().cummax(along).values.flip(along) > 0
        is_within &= is_after & is_before
    return is_within


def _bent(
    points_m: Float64[Tensor, "h w 3"],
    plane: Plane,
    near: Bool[Tensor, "h w"],
    is_along: Bool[Tensor, "h w"],
    noise_per_m2: float,
) -> Bool[Tensor, "h w"]:
    """Mark what is turned as a plane and lies on it as the sensor bends it, by a quadratic."""
    off_m = points_m @ plane[0] - plane[1]
    x, y = (points_m[..., :2] / points_m[..., 2:].clamp(min=1e-6)).unbind(-1)
    terms = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1)
    tolerance_m = plane_tolerance_m(points_m[..., 2], noise_per_m2)
    is_bent = near & is_along
    for _ in range(_BENDINGS):
        A, b = (take_evenly(grid[is_bent], _SAMPLE) for grid in (terms, off_m))
        if len(b) < _LEAST_POINTS:
            break
        bend_m = terms @ torch.linalg.lstsq(A, b[:, None]).solution
        is_bent = is_along & ((off_m - bend_m[..., 0]).abs() < tolerance_m)
    return is_bent


def largest_plane(
    points_m: Float64[Tensor, "n 3"], generator: torch.Generator, noise_per_m2: float = NOISE_PER_M2
) -> Plane | None:
    """Give the plane that most points lie on, by RANSAC; None for fewer than 60 points."""
    some = take_evenly(points_m, _SAMPLE)
    if len(some) < _LEAST_POINTS:
        return None
    triple = torch.randint(len(some), (_HYPOTHESES, 3), generator=generator)
    a, b, c = some[triple].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    length = normal.norm(dim=-1, keepdim=True)
    normal = normal / length.clamp(min=1e-12)
    offset = (normal * a).sum(-1)
    tolerance_m = plane_tolerance_m(some[:, 2], noise_per_m2)
    on = (some @ normal.T - offset).abs() < tolerance_m[:, None]
    on &= length[:, 0] > 1e-8
    best = int(on.sum(0).argmax())
    plane = (normal[best], offset[best])
    for _ in range(3):
        near = some[is_on_plane(some, plane, noise_per_m2)]
        if len(near) < 3:
            return None
        middle = near.mean(0)
        _, axes = torch.linalg.eigh((near - middle).T @ (near - middle))
        plane = (axes[:, 0], axes[:, 0] @ middle)
    return plane


class Readings(NamedTuple):
    """The pixels in whose direction points lie, their depth, and whether they have one."""

    pixel: Int64[Tensor, "*n"]
    depth_m: Float64[Tensor, "*n"]
    is_read: Bool[Tensor, "*n"]


def readings_toward(frame: Frame, points_m: Float64[Tensor, "*n 3"]) -> Readings:
    """Look up what was read in the direction of points of the camera frame."""
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
    """Give the share of points that lie behind a background, where it is not known to end.

    Args:
        frame: the image.
        background: one of the image.
        points_m: of a posed surface, in the camera frame.
        margin_m: a point counts from so far behind, beyond what the sensor's noise explains.

    Returns:
        Between 0 and 1.
    """
    # Within the margin of a point the background is no deeper than its deepest pixel there.
    margin_px = margin_m * float(frame.K[0, 0] / points_m[:, 2].median().clamp(min=1e-6))
    reach = min(math.ceil(margin_px), min(frame.depth_m.shape) // 2)
    limit_m = _largest_about(background.depth_m, reach)
    limit_m += margin_m + plane_tolerance_m(limit_m, frame.noise_per_m2)
    readings = readings_toward(frame, points_m)
    limit_m = limit_m.flatten()[readings.pixel]
    # What stands before the background hides it; where the camera saw farther it has ended.
    is_solid = readings.is_read & (readings.depth_m < limit_m)
    return float((is_solid & (points_m[:, 2] > limit_m)).double().mean())


def is_on_background(
    depth_m: Float[Tensor, "h w"], background_m: Float[Tensor, "h w"]
) -> Bool[Tensor, "h w"]:
    """Mark the readings that lie on a known background, as far as a depth sensor measures it.

    Both images have errors, and a pixel may see what its neighbour should: a reading is of the
    background between the nearest and the farthest that it has there, beyond the noise.

    Args:
        depth_m: the image; 0 or NaN where there is no reading.
        background_m: depth of the background in the same image; NaN where it is not known.
    """
    read_m = torch.where(depth_m > 0, depth_m, 0.0).double()
    tolerance_m = math.sqrt(2) * plane_tolerance_m(read_m, measure_noise_per_m2(read_m))
    known_m = background_m.double().nan_to_num(torch.inf)
    farthest_m = _largest_about(known_m, 1)
    nearest_m = -_largest_about(-known_m, 1)
    is_between = (read_m > nearest_m - tolerance_m) & (read_m < farthest_m + tolerance_m)
    return is_between & (read_m > 0) & farthest_m.isfinite()


def _largest_about(values: Float64[Tensor, "h w"], reach: int) -> Float64[Tensor, "h w"]:
    """Give the largest of the finite values up to so many pixels away; infinite without one."""
    finite = torch.where(values.isfinite(), values, -torch.inf)
    largest = max_pool2d(finite[None], 2 * reach + 1, 1, reach)[0]
    return torch.where(largest.isfinite(), largest, torch.inf)


def is_on_plane(
    points_m: Float64[Tensor, "*batch 3"], plane: Plane, noise_per_m2: float = NOISE_PER_M2
) -> Bool[Tensor, "*batch"]:
    """Whether points of the camera frame lie on a plane, as far as a depth sensor measures it."""
    normal, offset = plane
    tolerance_m = plane_tolerance_m(points_m[..., 2], noise_per_m2)
    return (points_m @ normal - offset).abs() < tolerance_m


def label_regions(
    depth_m: Float[Tensor, "h w"], is_counted: Bool[Tensor, "h w"]
) -> Int64[Tensor, "h w"]:
    """Number the connected regions: neighbours, at corners too, without a jump in depth.

    Those that ``is_counted`` marks; each other pixel has the number of a region of its own.
    """
    height, width = depth_m.shape
    index = torch.arange(height * width).reshape(height, width)
    rows, columns = [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        # Each pixel, and its neighbour so many rows down and columns to the right.
        first = slice(height - down), slice(max(0, -right), width - max(0, right))
        second = slice(down, None), slice(max(0, right), width - max(0, -right))
        z_a, z_b = depth_m[first], depth_m[second]
        joined = (z_a - z_b).abs() < _JUMP_M + _JUMP_PER_M * torch.minimum(z_a, z_b)
        joined &= is_counted[first] & is_counted[second]
        rows.append(index[first][joined])
        columns.append(index[second][joined])
    a, b = torch.cat(rows).numpy(), torch.cat(columns).numpy()
    size = height * width
    graph = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(size, size))
    return (
        torch.from_numpy(connected_components(graph, directed=False)[1])
        .long()
        .reshape(height, width)
    )
