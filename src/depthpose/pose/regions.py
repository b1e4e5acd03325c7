"""A depth image without masks to regions that may each be one object, its planes taken away."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import back_project

_TOLERANCE_M = 0.004
_TOLERANCE_PER_M = 0.003
"""Points lie on a plane up to 4 mm, and 3 mm for the square of their depth in metres: a Kinect's
noise grows so."""
_JUMP_M = 0.004
_JUMP_PER_M = 0.012
"""Neighbours are of one region up to this difference in depth, and this share of it."""
_PLANES = 6
_HYPOTHESES = 400
_SAMPLE = 4000
_LEAST_SHARE = 0.04
"""Of the readings: a plane of fewer is no table or wall."""
_WIDER = 1.3
"""A plane is wider than the largest object by so much, or it may be a side of one."""
_LEAST_PIXELS = 60
_MOST_REGIONS = 40
_MOST_SIDE = 96
"""Pixels of a region's longer side that are used for splitting it; of a larger one every n-th."""
_NECKS = (1, 2, 3, 4, 6, 8, 12, 16)
"""A region is split where it is narrower than twice this in such pixels."""
_PIECE = (0.05, 0.85)
"""Of a region: smaller pieces are bumps of its outline, and larger ones it itself."""
_ALIKE = 0.8
"""Intersection over union of pieces that are one."""


Plane = tuple[Float64[Tensor, "3"], Float64[Tensor, ""]]
"""Unit normal, and the distance [m] of the origin along it."""


class Regions(NamedTuple):
    """What is left of a depth image without its planes.

    Attributes:
        clouds_m: the points of each region in the camera frame, the largest first, 40 at most.
        pieces_m: those of parts of regions that are connected by a narrow neck.
        is_plane: which pixels show a plane that was taken away.
    """

    clouds_m: list[Float[Tensor, "_ 3"]]
    pieces_m: list[Float[Tensor, "_ 3"]]
    is_plane: Bool[Tensor, "h w"]


def find_regions(
    depth_m: Float[Tensor, "h w"],
    K: Float[Tensor, "3 3"],
    largest_m: float,
) -> Regions:
    """Take dominant planes away and part what is left where its depth jumps.

    Planes are found one after the other by RANSAC (Fischler and Bolles 1981) and refitted. One is
    kept whose largest connected piece is hardly wider than the largest object, because it may be a
    side of it, or a cut through several objects.

    Args:
        depth_m: along the optical axis; NaN where there is no reading.
        K: intrinsic matrix.
        largest_m: diameter of the largest object.
    """
    points_m = back_project(depth_m.double(), K.double())
    is_left = points_m.isfinite().all(-1) & (depth_m > 0)
    is_plane, is_searched = torch.zeros_like(is_left), is_left.clone()
    least = _LEAST_SHARE * int(is_left.sum())
    generator = torch.Generator().manual_seed(0)
    for _ in range(_PLANES):
        plane = largest_plane(points_m[is_searched], generator)
        if plane is None:
            break
        near = is_on_plane(points_m, plane) & is_left
        if int((near & is_searched).sum()) < least:
            break
        piece = _largest_piece(depth_m, near)
        if int(piece.sum()) >= least and _width_m(points_m[piece]) >= _WIDER * largest_m:
            is_left &= ~near
            is_plane |= near
        is_searched &= ~near
    label = label_regions(depth_m, is_left)
    pixels = torch.bincount(label[is_left], minlength=1) if bool(is_left.any()) else torch.zeros(1)
    order = pixels.argsort(descending=True, stable=True)[:_MOST_REGIONS]
    wanted = [int(k) for k in order if int(pixels[k]) >= _LEAST_PIXELS]
    masks = [is_left & (label == k) for k in wanted]
    pieces = [piece for mask in masks for piece in split_at_necks(mask)]
    points_m = points_m.float()
    return Regions([points_m[mask] for mask in masks], [points_m[p] for p in pieces], is_plane)


def label_regions(
    depth_m: Float[Tensor, "h w"], is_left: Bool[Tensor, "h w"]
) -> Int64[Tensor, "h w"]:
    """Number the pixels that hang together: neighbours, at corners too, without a jump in depth.

    Args:
        depth_m: of each pixel.
        is_left: the pixels that count; what is beside them has the number of a region of its own.
    """
    height, width = depth_m.shape
    index = torch.arange(height * width).reshape(height, width)
    rows, columns = [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a, b = _beside(index, down, right)
        z_a, z_b = _beside(depth_m, down, right)
        both = torch.logical_and(*_beside(is_left, down, right))
        joined = both & ((z_a - z_b).abs() < _JUMP_M + _JUMP_PER_M * torch.minimum(z_a, z_b))
        rows.append(a[joined])
        columns.append(b[joined])
    a, b = torch.cat(rows).numpy(), torch.cat(columns).numpy()
    size = height * width
    graph = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(size, size))
    return (
        torch.from_numpy(connected_components(graph, directed=False)[1])
        .long()
        .reshape(height, width)
    )


def split_at_necks(mask: Bool[Tensor, "h w"]) -> list[Bool[Tensor, "h w"]]:
    """Split a region where it is narrow: two things that touch are often one region.

    What is left of it farther than some width from its outline is labelled, and each pixel belongs
    to the label that is nearest. Several widths are tried, so pieces may overlap.
    """
    rows, columns = (mask.any(k).nonzero()[:, 0] for k in (1, 0))
    box = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
    own = mask[box].numpy()
    step = -(-max(own.shape) // _MOST_SIDE)
    small = np.pad(own[::step, ::step], 2)
    inside = np.asarray(ndimage.distance_transform_edt(ndimage.binary_closing(small)))
    cell = np.ix_(*(np.arange(size) // step + 2 for size in own.shape))
    found = list[np.ndarray]()
    for width in _NECKS:
        label = np.zeros(small.shape, np.int32)
        ndimage.label(inside > width, output=label)
        if not label.any():
            break
        nearest = np.zeros((2, *small.shape), np.int32)
        ndimage.distance_transform_edt(
            label == 0, return_distances=False, return_indices=True, indices=nearest
        )
        label = np.where(own, label[tuple(nearest)][cell], 0)
        pixels = np.bincount(label[own])
        least, most = max(_LEAST_PIXELS, _PIECE[0] * own.sum()), _PIECE[1] * own.sum()
        for k in np.flatnonzero((pixels >= least) & (pixels <= most)):
            if not any(_is_alike(label == k, one) for one in found):
                found.append(label == k)
    pieces = [torch.zeros_like(mask) for _ in found]
    for piece, one in zip(pieces, found, strict=True):
        piece[box] = torch.from_numpy(one)
    return pieces


def _is_alike(piece: np.ndarray, other: np.ndarray) -> bool:
    return bool((piece & other).sum() > _ALIKE * (piece | other).sum())


def _largest_piece(depth_m: Float[Tensor, "h w"], near: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    label = label_regions(depth_m, near)
    return near & (label == torch.bincount(label[near]).argmax())


def part_cloud(points_m: Float[Tensor, "n 3"], count: int) -> list[Float[Tensor, "_ 3"]]:
    """Split a cloud that is too large for one object into parts of points near to each other.

    Lloyd's k-means from farthest points.
    """
    some = take_evenly(points_m, 2000)
    middles = some[:1]
    for _ in range(count - 1):
        middles = torch.cat([middles, some[torch.cdist(some, middles).amin(1).argmax()][None]])
    for _ in range(10):
        label = torch.cdist(some, middles).argmin(1)
        middles = torch.stack(
            [some[label == k].mean(0) if (label == k).any() else middles[k] for k in range(count)]
        )
    label = torch.cdist(points_m, middles).argmin(1)
    return [points_m[label == k] for k in range(count)]


def extent_m(points_m: Float[Tensor, "n 3"]) -> float:
    """Say how long a cloud is: twice the distance from its median that 95 % stay within."""
    some_m = take_evenly(points_m, 100_000)
    distance = (some_m - some_m.median(0).values).norm(dim=-1)
    return 2 * float(distance.quantile(0.95))


def _beside(grid: Tensor, down: int, right: int) -> tuple[Tensor, Tensor]:
    """Give each pixel and its neighbour so many rows down and columns to the right."""
    height, width = grid.shape
    left = max(0, -right)
    first = grid[: height - down, left : width - max(0, right)]
    second = grid[down:, left + right : width - max(0, right) + right]
    return first, second


def largest_plane(points_m: Float64[Tensor, "n 3"], generator: torch.Generator) -> Plane | None:
    """Give the plane that most points lie on; None for fewer than 60 points.

    Args:
        points_m: in the camera frame.
        generator: of the hypotheses of RANSAC.
    """
    some = take_evenly(points_m, _SAMPLE)
    if len(some) < _LEAST_PIXELS:
        return None
    triple = torch.randint(len(some), (_HYPOTHESES, 3), generator=generator)
    a, b, c = some[triple].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    length = normal.norm(dim=-1, keepdim=True)
    normal = normal / length.clamp(min=1e-12)
    offset = (normal * a).sum(-1)
    on = ((some @ normal.T - offset).abs() < _tolerance_m(some)[:, None]) & (length[:, 0] > 1e-8)
    best = int(on.sum(0).argmax())
    plane = (normal[best], offset[best])
    for _ in range(3):
        near = some[is_on_plane(some, plane)]
        if len(near) < 3:
            return None
        middle = near.mean(0)
        _, axes = torch.linalg.eigh((near - middle).T @ (near - middle))
        plane = (axes[:, 0], axes[:, 0] @ middle)
    return plane


def _tolerance_m(points_m: Float64[Tensor, "*batch 3"]) -> Float64[Tensor, "*batch"]:
    return _TOLERANCE_M + _TOLERANCE_PER_M * points_m[..., 2].square()


def is_on_plane(points_m: Float64[Tensor, "*batch 3"], plane: Plane) -> Bool[Tensor, "*batch"]:
    """Whether points lie on a plane, as far as a depth sensor measures it.

    Args:
        points_m: in the camera frame.
        plane: as :func:`largest_plane` gives it.
    """
    normal, offset = plane
    return (points_m @ normal - offset).abs() < _tolerance_m(points_m)


def _width_m(points_m: Float64[Tensor, "n 3"]) -> float:
    """How wide a plane is across its narrow direction, but for a tenth of its points."""
    some = take_evenly(points_m, _SAMPLE)
    offset = some - some.mean(0)
    _, axes = torch.linalg.eigh(offset.T @ offset)
    along = offset @ axes[:, 1]
    return float(along.quantile(0.95) - along.quantile(0.05))
