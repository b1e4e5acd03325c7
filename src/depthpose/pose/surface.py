"""The surface of a model: what of it lies near a point, and what of it a camera would see."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int32, Int64
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize, pad

from depthpose.core.rigid import Rigid
from depthpose.pose.compiled import Vector, array_of, compiled, dot, vector
from depthpose.pose.kdtree import (
    Tree,
    build_tree,
    faces_camera,
    find_nearest_facing,
    find_nearest_points,
    square_distance,
)
from depthpose.pose.mesh import sample_surface, symmetry_transforms
from depthpose.pose.mesh.models import drawn_triangles, fibonacci_directions, triangulate_points
from depthpose.pose.types import ObjectModel

NEAR = 0.05  #: diameters: a point of the cloud within this distance lies on the posed surface
_AXIS_STEP = 0.1  # half of the step between the rotations about a continuous axis [rad]
_CELL = 1 / 24  # side of a cell of an image or of rays, in diameters: it holds several samples
_REACH = 72
"""Cells to each side of the middle of the cloud that are distinguished, three diameters; points
farther off count as if they lay at this border."""
_NEAREST_SHARE = 0.1  # points nearer than this share of the median depth were not observed
_BOXES = 48  # boxes along the longest side of a model, to look up near samples without a search
_BOX_MARGIN = 0.15  # distance by which the boxes reach beyond the model, in diameters
_VIEWS = 256  # directions from which a model is viewed
_POINTS = 160  # largest number of points of a view
_MOST_FACES = 100_000
"""Largest number of faces that are rendered; of a larger model its samples are, which are fewer."""
_EDGE_STEP = 0.08
"""Difference in depth, in diameters, from which neighbouring cells are the two sides of an edge."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Boxes:
    """A table of near surface points: for each box of a grid, the one nearest to its middle."""

    low_m: Float64[Tensor, "3"]  #: corner of the grid, in the model frame
    side_m: float  #: of a box
    counts: Int64[Tensor, "3"]  #: boxes along each axis
    nearest: Int64[Tensor, " boxes"]  #: number of the surface point, axes one after the other

    def look_up(self, points_m: Float64[Tensor, "*batch n 3"]) -> Int64[Tensor, "*batch n"]:
        """Give the index of the surface point nearest to the middle of each point's box.

        For a point outside the grid the box at the border is used.
        """
        points = array_of(points_m).reshape(-1, 3)
        low = self.low_m.numpy()
        counts = self.counts.numpy()
        index = _look_up_all(points, low, self.side_m, counts, self.nearest.numpy())
        return torch.from_numpy(index).reshape(points_m.shape[:-1])


@compiled
def _find_box(
    point: Vector,
    low: Float64[np.ndarray, "3"],
    side: float,
    counts: Int64[np.ndarray, "3"],
) -> int:
    """Find the number of the box that holds a point, or of the nearest one at the border."""
    number = 0
    for c in range(3):
        box = min(max(int((point[c] - low[c]) / side), 0), counts[c] - 1)
        number = number * counts[c] + box
    return number


@compiled
def _look_up_all(
    points: Float64[np.ndarray, "n 3"],
    low: Float64[np.ndarray, "3"],
    side: float,
    counts: Int64[np.ndarray, "3"],
    table: Int64[np.ndarray, " boxes"],
) -> Int64[np.ndarray, " n"]:
    """Look up the value of a table for the box of each point."""
    values = np.empty(len(points), np.int64)
    for i in range(len(points)):
        values[i] = table[_find_box(vector(points, i), low, side, counts)]
    return values


class Target(NamedTuple):
    """The samples of a surface for compiled loops, in the order of a k-d tree: their *places*."""

    tree: Tree  #: of the samples, with their outward normals
    normals: Float64[np.ndarray, "m 3"]  #: of the samples, to either side
    across: Int32[np.ndarray, " m"]  #: place of the sample on the other side of a wall, or -1
    low: Float64[np.ndarray, "3"]  #: corner of the grid of boxes
    side: float  #: of a box
    counts: Int64[np.ndarray, "3"]  #: boxes along each axis
    table: Int32[np.ndarray, " boxes"]  #: place of the sample nearest to the middle of each box
    ball: Float64[np.ndarray, "4"]  #: middle and radius; a camera within it sees no side


@compiled
def match(
    points: Float64[np.ndarray, "n 3"],
    target: Target,
    eye: Vector,
    least: float,
    limit: float,
    is_exact: bool,
    places: Int64[np.ndarray, " n"],
) -> None:
    """Write the place of the sample near each point of the model frame into ``places``, or -1.

    Args:
        points: in the model frame.
        target: the samples.
        eye: the camera in the model frame; samples count that show it their outer side.
        least: how nearly they do (:func:`~depthpose.pose.kdtree.faces_camera`).
        limit: distance of the farthest sample, of exact matches.
        is_exact: whether the nearest sample is searched, not looked up in the table, and of two
            sides of a wall the one that faces the camera.
        places: on entry those of the matches before, or -1, from which exact searches begin.
    """
    # Taken out of the tuple once, not for each point.
    tree = target.tree
    samples = tree.points
    outward = tree.outward
    across = target.across
    table = target.table
    low = target.low
    side = target.side
    counts = target.counts
    for i in range(len(points)):
        point = vector(points, i)
        place = places[i]

        # The match before or the sample of the box, if it faces the camera; else none.
        if not is_exact or place < 0:
            place = np.int64(table[_find_box(point, low, side, counts)])
            if not faces_camera(samples, outward, place, eye, least):
                place = np.int64(across[place])
        if place >= 0 and not faces_camera(samples, outward, place, eye, least):
            place = -1

        # From there the nearest one is searched.
        if is_exact:
            square = limit * limit
            if place >= 0:
                square = min(square, square_distance(samples, place, point))
            if square == limit * limit:  # the guess is too far away
                place = -1
            place = find_nearest_facing(point, tree, eye, least, place, square)
        places[i] = place


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """The visible points of a model from many directions of a far camera, in the model's frame."""

    toward: Float64[Tensor, "v 3"]  #: unit vectors to the camera
    points_m: Float64[Tensor, "v n 3"]  #: visible ones, evenly spread; NaN where there are fewer
    normals: Float64[Tensor, "v n 3"]  #: of these points
    #: whether the surface goes on around a point: no rim or edge, which sensors cut.
    is_inner: Bool[Tensor, "v n"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Samples of a model's surface, computed once and used for every cloud."""

    points_m: Float64[Tensor, "m 3"]  #: of the surface, in the model frame
    normals: Float64[Tensor, "m 3"]  #: of these points, to either side
    outward: Float64[Tensor, "m 3"]  #: normals on the outer side, 0 where none is known
    triangles_m: Float64[Tensor, "f 3 3"]  #: corners of what is rendered, in the model frame
    across: Int64[Tensor, " m"]  #: index of the sample on the other side of a wall, or -1
    diameter_m: float  #: of the object
    spacing_m: float  #: distance from a point to the third nearest, in the median
    middle_m: Float64[Tensor, "3"]  #: of the box about the surface, along the axes of the model
    ball_m: Float64[Tensor, "4"]  #: middle and radius of a ball about the surface
    symmetries: Rigid  #: declared and found, ``model_from_model``, the identity first
    boxes: Boxes  #: a table of near points, some thirty times as fast as a search

    def nearest(self, points_m: Float64[Tensor, "*batch n 3"]) -> Int64[Tensor, "*batch n"]:
        """Give the index of the surface point nearest to each point of the model frame."""
        index = find_nearest_points(array_of(points_m).reshape(-1, 3), self.target.tree)
        return torch.from_numpy(index).reshape(points_m.shape[:-1])

    @cached_property
    def plane_normals(self) -> Float64[Tensor, "f 3"]:
        """Unit normals of the triangles, to either side."""
        first, second, third = self.triangles_m.unbind(1)
        return normalize(torch.linalg.cross(second - first, third - first), dim=-1, eps=1e-300)

    @cached_property
    def plane_offsets_m(self) -> Float64[Tensor, " f"]:
        """Distances of the triangles' planes from the model's origin, along their normals."""
        return (self.plane_normals * self.triangles_m[:, 0]).sum(-1)

    @cached_property
    def box_corners_m(self) -> Float64[Tensor, "8 3"]:
        """Corners of the box about the triangles, along the axes of the model."""
        low_m = self.triangles_m.amin((0, 1))
        high_m = self.triangles_m.amax((0, 1))
        return torch.cartesian_prod(*torch.stack([low_m, high_m], -1))

    @cached_property
    def views(self) -> Views:
        """The visible points from many directions, computed once for many images."""
        half = fibonacci_directions(_VIEWS // 2).double()
        toward = torch.cat([half, -half])
        # The last two rows of each frame are two axes across the direction.
        _, _, frames = torch.linalg.svd(toward[:, None])
        views = [
            _view_from(self, direction, frame[1:])
            for direction, frame in zip(toward, frames, strict=True)
        ]
        return Views(
            toward=toward,
            points_m=torch.stack([view.points_m for view in views]),
            normals=torch.stack([view.normals for view in views]),
            is_inner=torch.stack([view.is_inner for view in views]),
        )

    @cached_property
    def target(self) -> Target:
        """The samples as compiled loops take them.

        They are copies: where a surface is sent to another process, torch moves its tensors to
        shared memory and frees the old one, and an array on that memory would point at nothing.
        """
        tree = build_tree(array_of(self.points_m), array_of(self.outward))
        # The place of each sample in the tree; the last one, -1, is that of no sample.
        place = np.full(len(self.points_m) + 1, -1)
        place[tree.order] = np.arange(len(self.points_m))
        boxes = self.boxes
        return Target(
            tree=tree,
            normals=np.ascontiguousarray(self.normals.numpy()[tree.order]),
            # In 32 bits: half of the memory, which is read at random.
            across=place[self.across.numpy()[tree.order]].astype(np.int32),
            low=boxes.low_m.numpy().copy(),
            side=boxes.side_m,
            counts=boxes.counts.numpy().copy(),
            table=place[boxes.nearest.numpy()].astype(np.int32),
            ball=self.ball_m.numpy().copy(),
        )


class _View(NamedTuple):
    """The visible points from one direction: a row of each part of :class:`Views`."""

    points_m: Float64[Tensor, "n 3"]  #: NaN where there are fewer
    normals: Float64[Tensor, "n 3"]  #: of these points
    is_inner: Bool[Tensor, " n"]  #: whether it is on no rim or edge


def _view_from(surface: Surface, toward: Tensor, across: Tensor) -> _View:
    """Choose the points of a surface that a far camera sees, 160 at most.

    Args:
        surface: of the model.
        toward: unit vector to the camera.
        across: two unit vectors across it, (2, 3).
    """
    # An image along parallel rays: in each cell the sample that is nearest to the camera.
    cell_m = _CELL * surface.diameter_m
    side = 2 * round(0.5 / _CELL) + 10
    centred_m = surface.points_m - surface.middle_m
    column, row = (centred_m @ across.T / cell_m).floor().long().add(side // 2).unbind(-1)
    place = row * side + column
    height_m = centred_m @ toward
    nearest_m = height_m.new_full((side**2,), -torch.inf)
    nearest_m = nearest_m.scatter_reduce_(0, place, height_m, "amax")
    is_nearest = height_m == nearest_m[place]
    sample = torch.full((side**2,), len(place))
    sample[place[is_nearest]] = torch.arange(len(place))[is_nearest]
    image_m = nearest_m.reshape(1, side, side)

    # Where samples are sparse the far side shows through the gaps: no camera sees it.
    front_m = max_pool2d(image_m, 3, 1, 1).flatten()
    is_visible = nearest_m > front_m - _EDGE_STEP * surface.diameter_m
    is_visible &= nearest_m.isfinite()

    # Inner cells: two from the silhouette, whose single empty cells are closed first, and with no
    # neighbour across an edge.
    closed = max_pool2d(image_m.isfinite().double(), 3, 1, 1)
    eroded = -max_pool2d(-closed, 5, 1, 2)
    depth_m = torch.where(image_m.isfinite(), -image_m, -torch.inf)
    farthest_m = max_pool2d(depth_m, 3, 1, 1)
    is_inner = (eroded > 0) & (-farthest_m > image_m - _EDGE_STEP * surface.diameter_m)

    # The points of these cells, shuffled: every n-th of them is a sample of all.
    cells = is_visible.nonzero()[:, 0]
    shuffle = torch.randperm(len(cells), generator=torch.Generator().manual_seed(0))
    cells = cells[shuffle[:_POINTS]]
    visible = sample[cells]
    return _View(
        points_m=_pad_rows(surface.points_m[visible], _POINTS),
        normals=_pad_rows(surface.normals[visible], _POINTS),
        is_inner=pad(is_inner.flatten()[cells], (0, _POINTS - len(cells))),
    )


def _pad_rows(rows: Float64[Tensor, "n 3"], count: int) -> Float64[Tensor, "{count} 3"]:
    """Add rows of NaN up to ``count``."""
    return pad(rows, (0, 0, 0, count - len(rows)), value=torch.nan)


def prepare_surface(model: ObjectModel, count: int = 10_000) -> Surface:
    """Sample the surface of a model once for many clouds, by ``count`` points."""
    # Samples, and the triangles that are rendered.
    points_m, normals = (part.double() for part in sample_surface(model, count))
    is_large = len(model.faces) > _MOST_FACES
    triangles_m = triangulate_points(points_m, normals) if is_large else drawn_triangles(model)
    tree = KDTree(points_m.numpy())

    # The outer side of each sample, by cells that hold about four samples.
    few_m = points_m.numpy()[:: max(1, len(points_m) // 500)]
    distance_m, _ = tree.query(few_m, k=min(5, len(points_m)))
    cell_m = _CELL_SPACINGS * float(np.median(distance_m[:, -1])) * np.sqrt(np.pi) / 2
    limit_m = 3 * NEAR * model.diameter_m
    sides = _find_outer_sides(points_m.numpy(), normals.numpy(), cell_m, limit_m)
    outward, across = (torch.from_numpy(part) for part in sides)

    # How far samples lie apart, and how far the surface extends.
    few_m = points_m.numpy()[:: max(1, len(points_m) // 1000)]
    distance_m, _ = tree.query(few_m, k=4, workers=1)
    middle_m = (points_m.amin(0) + points_m.amax(0)) / 2
    radius_m = (points_m - middle_m).norm(dim=-1).amax()
    return Surface(
        points_m=points_m,
        normals=normals,
        outward=outward,
        triangles_m=triangles_m.double(),
        across=across,
        diameter_m=model.diameter_m,
        spacing_m=float(np.median(distance_m[:, -1])),
        middle_m=middle_m,
        ball_m=torch.cat([middle_m, radius_m[None]]),
        symmetries=symmetry_transforms(model.symmetries, _AXIS_STEP).double(),
        boxes=_make_boxes(points_m, tree, _BOX_MARGIN * model.diameter_m),
    )


def _make_boxes(points_m: Float64[Tensor, "m 3"], tree: KDTree, margin_m: float) -> Boxes:
    """Tabulate the surface point nearest to each box of a grid that reaches beyond the points."""
    low_m = points_m.amin(0) - margin_m
    size_m = points_m.amax(0) + margin_m - low_m
    side_m = float(size_m.max()) / _BOXES
    counts = (size_m / side_m).ceil().clamp(min=1).long()
    middles_m = [(torch.arange(int(count)) + 0.5) * side_m for count in counts]
    grid_m = torch.cartesian_prod(*middles_m).double() + low_m
    nearest = torch.from_numpy(tree.query(grid_m.numpy(), workers=1)[1])
    return Boxes(low_m=low_m, side_m=side_m, counts=counts, nearest=nearest)


_SIDE_DIRECTIONS = 32
_CELL_SPACINGS = 2.0  # side of a cell in mean distances of samples: four in each on average
_SAME_SHEET = 0.5  # mean distances from a sample's plane up to which others are of its sheet
_LEAST_COSINE = 0.3  # least cosine to its normal at which a side of a sample is examined
_LEAST_VISIBLE = 0.1  # least share of directions from which an outer side is visible
_MOST_INNER = 0.4  # largest share for the inner side, over that of the outer side


def _find_outer_sides(
    points: np.ndarray, normals: np.ndarray, cell: float, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Flip normals to the side from which the surface is visible from afar.

    Walls thinner than half the distance of the samples, open sheets and hidden surfaces have no
    outer side: their normals become 0.

    Args:
        points: samples of the surface (n, 3).
        normals: to either side (n, 3).
        cell: side of the cells in which samples hide each other.
        limit: farthest distance to a sample of an opposite side.

    Returns:
        The normals (n, 3); and for each sample the index of the nearest one of an opposite side, or
        -1.
    """
    share = _measure_visible_shares(points, normals, cell)
    # The outer side is visible from clearly more directions than the inner one.
    outer = share.argmax(0)
    is_clear = share.max(0) > _LEAST_VISIBLE
    is_clear &= share.min(0) < _MOST_INNER * share.max(0)
    outward = normals * ((1 - 2 * outer) * is_clear)[:, None]
    across = _find_nearest_opposite(points, outward, limit)
    return outward, across


def _measure_visible_shares(points: np.ndarray, normals: np.ndarray, cell: float) -> np.ndarray:
    """Measure the share of directions from which both sides of each sample are visible (2, n).

    It is a share of the directions that a side faces. The first side is that of the normal.

    Args:
        points: samples of the surface (n, 3).
        normals: to either side (n, 3).
        cell: side of the cells in which samples hide each other.
    """
    visible_count = np.zeros((2, len(points)))
    facing_count = np.full((2, len(points)), 1e-9)
    for axis in fibonacci_directions(_SIDE_DIRECTIONS).numpy():
        # The cell of each sample in an image across the direction.
        across = np.linalg.svd(axis[None])[2][1:]
        flat = np.floor(points @ across.T / cell).astype(np.int64)
        flat -= flat.min(0)
        place = flat[:, 0] * (flat[:, 1].max() + 1) + flat[:, 1]

        # Visible are the samples in the plane of the first one of their cell.
        cosine = normals @ axis
        order = np.argsort(points @ axis)
        first = np.empty(place.max() + 1, np.int64)
        for sign in (1, -1):  # toward a camera in this direction, and in the other
            first[place[order[::sign]]] = order[::sign]
            front = first[place]
            off_plane = ((points - points[front]) * normals[front]).sum(1)
            is_in_front = np.abs(off_plane) < _SAME_SHEET / _CELL_SPACINGS * cell
            for side in (0, 1):
                is_facing = sign * (1 - 2 * side) * cosine > _LEAST_COSINE
                visible_count[side] += is_facing & is_in_front
                facing_count[side] += is_facing
    return visible_count / facing_count


def _find_nearest_opposite(points: np.ndarray, outward: np.ndarray, limit: float) -> np.ndarray:
    """Find for each sample the nearest one that faces the other way, as through a wall, or -1.

    Samples are searched by six groups of normals, each about a direction of an axis: every normal
    has a component of 1 / sqrt(3) or more.
    """
    across = np.full(len(points), -1)
    nearest = np.full(len(points), np.inf)
    for axis, sign in product(range(3), (1, -1)):
        (group,) = np.nonzero(sign * outward[:, axis] > 0.577)
        if len(group) == 0:
            continue
        distance, neighbour = KDTree(points[group]).query(points, distance_upper_bound=limit)
        candidate = group[np.minimum(neighbour, len(group) - 1)]
        is_opposite = (outward[candidate] * outward).sum(1) < 0
        is_better = is_opposite & (distance < nearest)
        across = np.where(is_better, candidate, across)
        nearest = np.where(is_better, distance, nearest)
    return across


def look_along_rays(
    cloud_m: Float64[Tensor, "n 3"], poses: Rigid, surface: Surface, every: int = 1
) -> tuple[Float64[Tensor, " b"], Float64[Tensor, " b"]]:
    """Compare an observed cloud with what a camera at the origin would see of a posed surface.

    Rays are binned in cells, each as wide, where the object is, as 1/24 of its diameter.

    Args:
        cloud_m: in the camera frame.
        poses: a batch, ``camera_from_model``.
        surface: of the model.
        every: of how many points of the surface one is used.

    Returns:
        The share of the points that the posed surface would have occluded (free-space violation),
        and the share of the cells of the posed surface in which nothing was observed. Both 1 where
        the surface lies behind the camera.
    """
    # Points nearer to the camera than most were not observed.
    median_m = float(cloud_m[:, 2].median())
    cloud_m = cloud_m[cloud_m[:, 2] > _NEAREST_SHARE * max(median_m, 0.0)]
    if len(cloud_m) == 0:
        ones = torch.ones(len(poses.R), dtype=torch.float64)
        return ones, ones

    # Cells of rays about the middle of the cloud.
    scale = median_m / (_CELL * surface.diameter_m)
    observed_rays = cloud_m[:, :2] / cloud_m[:, 2:] * scale
    middle = observed_rays.median(0).values.floor()
    limit_m = 1.5 * NEAR * surface.diameter_m
    violation, unobserved = _compare_rays(
        array_of(cloud_m),
        array_of(poses.R),
        array_of(poses.t_m),
        array_of(surface.points_m[::every]),
        scale,
        array_of(middle),
        limit_m,
    )
    return torch.from_numpy(violation), torch.from_numpy(unobserved)


@compiled
def _compare_rays(
    cloud: Float64[np.ndarray, "n 3"],
    Rs: Float64[np.ndarray, "b 3 3"],
    ts: Float64[np.ndarray, "b 3"],
    points: Float64[np.ndarray, "m 3"],
    scale: float,
    middle: Float64[np.ndarray, "2"],
    limit: float,
) -> tuple[Float64[np.ndarray, " b"], Float64[np.ndarray, " b"]]:
    """Compute both shares of :func:`look_along_rays` for each pose.

    Args:
        cloud: in the camera frame.
        Rs: rotation of each pose.
        ts: translation of each pose.
        points: of the surface, in the model frame.
        scale: cells per unit of x / z and y / z.
        middle: column and row of the middle cell.
        limit: how far before a point the surface must lie to occlude it.
    """
    # The cells in which something was observed.
    cells = (2 * _REACH + 1) ** 2
    cell_of_point = np.empty(len(cloud), np.int64)
    is_observed = np.zeros(cells, np.bool_)
    for i in range(len(cloud)):
        cell_of_point[i] = _find_cell(cloud[i, 0], cloud[i, 1], cloud[i, 2], scale, middle)
        is_observed[cell_of_point[i]] = True

    # Each pose: the cells that it covers, those of them without a point, and points behind it.
    violation, unobserved = np.ones(len(ts)), np.ones(len(ts))
    nearest = np.empty(cells)  # depth of the nearest point of the posed surface in each cell
    for b in range(len(ts)):
        _draw_cells(points, Rs[b], ts[b], scale, middle, nearest)
        posed = 0
        missed = 0
        for k in range(cells):
            if nearest[k] < np.inf:
                posed += 1
                missed += not is_observed[k]
        occluded = 0
        for i in range(len(cloud)):
            occluded += nearest[cell_of_point[i]] < cloud[i, 2] - limit
        if posed > 0:
            violation[b] = occluded / len(cloud)
            unobserved[b] = missed / posed
    return violation, unobserved


@compiled
def _draw_cells(
    points: Float64[np.ndarray, "m 3"],
    R: Float64[np.ndarray, "3 3"],
    t: Float64[np.ndarray, "3"],
    scale: float,
    middle: Float64[np.ndarray, "2"],
    nearest: Float64[np.ndarray, " cells"],
) -> None:
    """Write the depth of the nearest posed point in each cell; infinity where there is none.

    Args:
        points: of the surface, in the model frame.
        R: rotation of the pose.
        t: its translation.
        scale: cells per unit of x / z and y / z.
        middle: column and row of the middle cell.
        nearest: is written.
    """
    nearest[:] = np.inf
    for i in range(len(points)):
        point = vector(points, i)
        z = dot(vector(R, 2), point) + t[2]
        if z <= 0:
            continue
        x = dot(vector(R, 0), point) + t[0]
        y = dot(vector(R, 1), point) + t[1]
        cell = _find_cell(x, y, max(z, 1e-6), scale, middle)
        nearest[cell] = min(nearest[cell], z)


@compiled
def _find_cell(x: float, y: float, z: float, scale: float, middle: Float64[np.ndarray, "2"]) -> int:
    """Find the cell of the ray through a point; rays far off are in a cell at the border."""
    column = min(max(np.floor(x / z * scale - middle[0]), -_REACH), _REACH) + _REACH
    row = min(max(np.floor(y / z * scale - middle[1]), -_REACH), _REACH) + _REACH
    return int(column) * (2 * _REACH + 1) + int(row)
