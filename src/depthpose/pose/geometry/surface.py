"""The surface of a model: what of it lies near a point, and what of it a camera sees."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int32, Int64
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, normalize, pad

from depthpose.core.rigid import Rigid
from depthpose.pose.compiled import Vector, array_of, compiled, dot, vector
from depthpose.pose.geometry.kdtree import (
    Tree,
    build_tree,
    faces_camera,
    find_nearest_facing,
    find_nearest_points,
    square_distance,
)
from depthpose.pose.geometry.outer_sides import find_outer_sides
from depthpose.pose.mesh import sample_surface, symmetry_transforms
from depthpose.pose.mesh.models import drawn_triangles, fibonacci_directions, triangulate_points
from depthpose.pose.types import ObjectModel

CAD_DEVIATION_M = 0.001
SCAN_DEVIATION_M = 0.002
"""Standard deviation of a real object's surface from a designed model, and from a scanned one, if
the user gives none."""
NEAR = 0.05  #: diameters: a point of the cloud within this distance lies on the posed surface
_OPPOSITE_DIAMETERS = 3 * NEAR  # largest distance of a sample on the other side of a wall
_OCCLUDED_DIAMETERS = 1.5 * NEAR  # from which a point behind the surface counts as occluded by it
_AXIS_STEP = 0.1  # half of the step between the rotations about a continuous axis [rad]
_CELL = 1 / 24  # side of a cell of an image or of rays, in diameters: it holds several samples
_REACH = 72
"""Cells to each side of the middle of the cloud that are distinguished, three diameters; points
farther off count as if they lay at this border."""
UNOBSERVED_WEIGHT = 0.3
"""Weight in a score of the share of the surface that should be visible and was not observed. It is
below 1, the weight of free-space violations, for something may occlude it."""
_NEAREST_SHARE = 0.1  # points nearer than this share of the median depth were not observed
_BOXES = 48  # boxes along the longest side of a model, to look up near samples without a search
_BOX_MARGIN = 0.15  # distance by which the boxes reach beyond the model, in diameters
_VIEWS = 256  # directions from which a model is viewed
_VIEW_POINTS = 160  # largest number of points of a view
_PROBED_SPACINGS = 500  # samples by which the mean distance of neighbours is measured
_PROBED_THIRDS = 1000  # samples by which the distance of the third nearest is measured
_MOST_FACES = 100_000
"""Largest number of faces that are rendered; a model with more is rendered by its samples."""
_EDGE_STEP = 0.08
"""Difference in depth, in diameters, from which neighbouring cells are the two sides of an edge."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NearestTable:
    """The surface point nearest to the middle of each box of a grid, looked up without a search."""

    low_m: Float64[Tensor, "3"]  #: corner of the grid, in the model frame
    side_m: float  #: of a box
    counts: Int64[Tensor, "3"]  #: boxes along each axis
    nearest: Int64[Tensor, " boxes"]  #: index of the surface point; z varies fastest

    def look_up(self, points_m: Float64[Tensor, "*batch n 3"]) -> Int64[Tensor, "*batch n"]:
        """Find the index of the surface point nearest to the middle of the box about each point.

        A point outside the grid takes the box at the border.
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


class SampleTree(NamedTuple):
    """The samples of a surface for compiled loops, in the order of a k-d tree.

    The *place* of a sample is its row in this order.
    """

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
    target: SampleTree,
    eye: Vector,
    least: float,
    limit: float,
    is_exact: bool,
    places: Int64[np.ndarray, " n"],
) -> None:
    """Match each point with a sample that faces the camera: write its place, or -1.

    Args:
        points: in the model frame.
        target: the samples.
        eye: centre of the camera in the model frame.
        least: how nearly a sample faces it (:func:`~depthpose.pose.geometry.kdtree.faces_camera`).
        limit: distance of the farthest sample, where the match is exact.
        is_exact: True: the nearest sample that faces the camera is searched; False: one near the
            point is looked up, or that on the other side of the wall.
        places: written. On entry those of earlier matches, or -1, from which searches begin.
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

        # The earlier match, or the sample of the box or across its wall, if it faces the camera.
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
            if square == limit * limit:  # no guess, or one that is too far away
                place = -1
            place = find_nearest_facing(point, tree, eye, least, place, square)
        places[i] = place


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """The points of a model that a far camera sees from many directions, in the model frame."""

    toward: Float64[Tensor, "v 3"]  #: unit vectors to the camera
    points_m: Float64[Tensor, "v n 3"]  #: visible ones, evenly spread; NaN where there are fewer
    #: of these points, toward the camera: means over cells, as those of an image are over pixels.
    normals: Float64[Tensor, "v n 3"]
    #: whether a point is on no rim or edge, of which sensors lose readings.
    is_inner: Bool[Tensor, "v n"]


class Nearest(NamedTuple):
    """The surface points nearest to given points."""

    sample: Int64[Tensor, "*batch n"]  #: its index among ``Surface.points_m``
    distance_m: Float64[Tensor, "*batch n"]  #: to it


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Samples of a model's surface, computed once and used for every cloud."""

    points_m: Float64[Tensor, "m 3"]  #: of the surface, in the model frame
    normals: Float64[Tensor, "m 3"]  #: of these points, to either side
    outward: Float64[Tensor, "m 3"]  #: outward normals, 0 where the outer side is not known
    triangles_m: Float64[Tensor, "f 3 3"]  #: corners of the rendered triangles, in the model frame
    across: Int64[Tensor, " m"]  #: index of the sample on the other side of a wall, or -1
    diameter_m: float  #: of the object
    deviation_m: float  #: standard deviation of the real object's surface from this one
    spacing_m: float  #: median distance from a point to its third nearest neighbour
    middle_m: Float64[Tensor, "3"]  #: of the box about the surface, along the axes of the model
    ball_m: Float64[Tensor, "4"]  #: middle and radius of a ball about the surface
    symmetries: Rigid  #: declared and found, ``model_from_model``, the identity first
    boxes: NearestTable  #: of near surface points, some thirty times as fast as a search

    @property
    def near_m(self) -> float:
        """Distance within which a point of the cloud lies on the posed surface."""
        return NEAR * self.diameter_m

    def nearest(self, local_m: Float64[Tensor, "*batch n 3"], *, is_exact: bool = True) -> Nearest:
        """Find the surface point nearest to each point.

        Args:
            local_m: points in the model frame.
            is_exact: whether the nearest one is searched. Else one near the point is looked up in
                ``boxes``: for many poses, or where a distance off by a box is good enough.
        """
        if is_exact:
            index = find_nearest_points(array_of(local_m).reshape(-1, 3), self.sample_tree.tree)
            sample = torch.from_numpy(index).reshape(local_m.shape[:-1])
        else:
            sample = self.boxes.look_up(local_m)
        distance_m = (local_m - self.points_m[sample]).norm(dim=-1)
        return Nearest(sample, distance_m)

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
    def box_m(self) -> Float64[Tensor, "2 3"]:
        """The lowest and the highest corner of the box about the triangles, in the model frame."""
        return torch.stack([self.triangles_m.amin((0, 1)), self.triangles_m.amax((0, 1))])

    @cached_property
    def views(self) -> Views:
        """The visible points from 256 directions."""
        half = fibonacci_directions(_VIEWS // 2).double()
        toward = torch.cat([half, -half])
        # The last two rows of each frame are unit vectors across the direction.
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
    def sample_tree(self) -> SampleTree:
        """The samples as compiled loops take them.

        They are copies: where a surface is sent to another process, torch moves its tensors to
        shared memory and frees the old one, and an array on that memory would point at nothing.
        """
        tree = build_tree(array_of(self.points_m), array_of(self.outward))
        # The place of each sample in the tree. The last entry, which index -1 reads, stays -1.
        place = np.full(len(self.points_m) + 1, -1)
        place[tree.order] = np.arange(len(self.points_m))
        boxes = self.boxes
        return SampleTree(
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
    """The visible points from one direction: a row of each field of :class:`Views`."""

    points_m: Float64[Tensor, "n 3"]  #: NaN where there are fewer
    normals: Float64[Tensor, "n 3"]  #: of these points, toward the camera
    is_inner: Bool[Tensor, " n"]  #: whether it is on no rim or edge


def _view_from(surface: Surface, toward: Tensor, across: Tensor) -> _View:
    """Choose at most 160 of the points of a surface that a far camera sees.

    Args:
        surface: of the model.
        toward: unit vector to the camera.
        across: two unit vectors across it, (2, 3).
    """
    # An image along parallel rays: in each cell the sample that is nearest to the camera. About the
    # ball that holds the surface there are five more cells.
    cell_m = _CELL * surface.diameter_m
    side = 2 * (math.ceil(float(surface.ball_m[3]) / cell_m) + 5)
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

    # Where samples are sparse, the image has far samples in the gaps that no camera would see. With
    # them goes surface that is tilted by more than some 60 degrees, which sensors hardly read.
    front_m = max_pool2d(image_m, 3, 1, 1).flatten()
    is_visible = nearest_m > front_m - _EDGE_STEP * surface.diameter_m
    is_visible &= nearest_m.isfinite()

    # Inner cells are two or more from the silhouette, in which single empty cells are filled first,
    # and have no neighbour across an edge in depth.
    closed = max_pool2d(image_m.isfinite().double(), 3, 1, 1)
    eroded = -max_pool2d(-closed, 5, 1, 2)
    depth_m = torch.where(image_m.isfinite(), -image_m, -torch.inf)
    farthest_m = max_pool2d(depth_m, 3, 1, 1)
    is_inner = (eroded > 0) & (-farthest_m > image_m - _EDGE_STEP * surface.diameter_m)

    # Normals of an image are fitted to windows, so that near an edge they are between those of its
    # two sides. Those of a cell are means over it and its neighbours.
    facing = surface.normals * (surface.normals @ toward).sign()[:, None]
    image_normals = facing.new_zeros(side**2, 3)
    image_normals[is_visible] = facing[sample[is_visible]]
    window_means = avg_pool2d(image_normals.T.reshape(3, side, side), 3, 1, 1)
    normals = normalize(window_means.flatten(1).T, dim=-1)

    # The points of visible cells, shuffled, so that the first ones of them are spread evenly; by
    # one seed, so that a model always has the same views.
    cells = is_visible.nonzero()[:, 0]
    shuffle = torch.randperm(len(cells), generator=torch.Generator().manual_seed(0))
    cells = cells[shuffle[:_VIEW_POINTS]]
    return _View(
        points_m=_pad_rows(surface.points_m[sample[cells]], _VIEW_POINTS),
        normals=_pad_rows(normals[cells], _VIEW_POINTS),
        is_inner=pad(is_inner.flatten()[cells], (0, _VIEW_POINTS - len(cells))),
    )


def _pad_rows(rows: Float64[Tensor, "n 3"], count: int) -> Float64[Tensor, "{count} 3"]:
    """Append rows of NaN until there are ``count``."""
    return pad(rows, (0, 0, 0, count - len(rows)), value=torch.nan)


def prepare_surface(
    model: ObjectModel, count: int = 10_000, deviation_m: float | None = None
) -> Surface:
    """Sample the surface of a model, and compute what every cloud needs.

    Args:
        model: the object.
        count: number of samples.
        deviation_m: standard deviation of the real object's surface from it; None: 2 mm from a
            scan, 1 mm from another model.
    """
    if deviation_m is None:
        deviation_m = SCAN_DEVIATION_M if model.is_scan else CAD_DEVIATION_M

    # Samples, and the triangles that are rendered.
    points_m, normals = (part.double() for part in sample_surface(model, count))
    is_large = len(model.faces) > _MOST_FACES
    triangles_m = triangulate_points(points_m, normals) if is_large else drawn_triangles(model)
    tree = KDTree(points_m.numpy())

    # The outer side of each sample. Of random samples, one in a square of the mean distance, the
    # fourth nearest is at 2 / sqrt(pi) such distances: pi r^2 holds four.
    few_m = points_m.numpy()[:: max(1, len(points_m) // _PROBED_SPACINGS)]
    distance_m, _ = tree.query(few_m, k=min(5, len(points_m)))
    mean_spacing_m = float(np.median(distance_m[:, -1])) * np.sqrt(np.pi) / 2
    limit_m = _OPPOSITE_DIAMETERS * model.diameter_m
    sides = find_outer_sides(points_m.numpy(), normals.numpy(), mean_spacing_m, limit_m)
    outward, across = (torch.from_numpy(part) for part in sides)

    # How far samples lie apart, and how far the surface extends.
    few_m = points_m.numpy()[:: max(1, len(points_m) // _PROBED_THIRDS)]
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
        deviation_m=deviation_m,
        spacing_m=float(np.median(distance_m[:, -1])),
        middle_m=middle_m,
        ball_m=torch.cat([middle_m, radius_m[None]]),
        symmetries=symmetry_transforms(model.symmetries, _AXIS_STEP).double(),
        boxes=_tabulate_nearest(points_m, tree, _BOX_MARGIN * model.diameter_m),
    )


def _tabulate_nearest(
    points_m: Float64[Tensor, "m 3"], tree: KDTree, margin_m: float
) -> NearestTable:
    """Tabulate the surface point nearest to each box of a grid.

    Args:
        points_m: points of the surface.
        tree: of these points.
        margin_m: by which the grid reaches beyond them.
    """
    low_m = points_m.amin(0) - margin_m
    size_m = points_m.amax(0) + margin_m - low_m
    side_m = float(size_m.max()) / _BOXES
    counts = (size_m / side_m).ceil().clamp(min=1).long()
    middles_m = [(torch.arange(int(count)) + 0.5) * side_m for count in counts]
    grid_m = torch.cartesian_prod(*middles_m).double() + low_m
    _, nearest = tree.query(grid_m.numpy(), workers=1)
    nearest = torch.from_numpy(nearest)
    return NearestTable(low_m=low_m, side_m=side_m, counts=counts, nearest=nearest)


def look_along_rays(
    cloud_m: Float64[Tensor, "n 3"], poses: Rigid, surface: Surface, every: int = 1
) -> tuple[Float64[Tensor, " b"], Float64[Tensor, " b"]]:
    """Compare an observed cloud with what a camera at the origin would see of a posed surface.

    Rays are binned in cells, each as wide, where the object is, as 1/24 of its diameter.

    Args:
        cloud_m: the observed points, in the camera frame.
        poses: a batch, ``camera_from_model``.
        surface: of the model.
        every: n: every n-th point of the surface is used.

    Returns:
        For each pose the share of the points that the posed surface would have occluded (free-space
        violation), and the share of the cells of the posed surface in which nothing was observed.
        Both are 1 where the surface lies behind the camera.
    """
    # Points nearer to the camera than most were not observed.
    median_m = float(cloud_m[:, 2].median())
    cloud_m = cloud_m[cloud_m[:, 2] > _NEAREST_SHARE * max(median_m, 0.0)]
    if len(cloud_m) == 0:
        ones = torch.ones(len(poses.R), dtype=torch.float64)
        return ones, ones

    # Cells of rays about the middle of the cloud; ``scale`` is in cells per unit of x / z.
    scale = median_m / (_CELL * surface.diameter_m)
    observed_rays = cloud_m[:, :2] / cloud_m[:, 2:] * scale
    middle = observed_rays.median(0).values.floor()
    limit_m = _OCCLUDED_DIAMETERS * surface.diameter_m
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

    # For each pose: the cells that its surface covers, those of them without a point, and points
    # behind it.
    violation, unobserved = np.ones(len(ts)), np.ones(len(ts))
    nearest = np.empty(cells)  # depth of the nearest point of the posed surface in each cell
    for b in range(len(ts)):
        _draw_cells(points, Rs[b], ts[b], scale, middle, nearest)
        covered_count = 0
        missed_count = 0
        for k in range(cells):
            if nearest[k] < np.inf:
                covered_count += 1
                missed_count += not is_observed[k]
        occluded_count = 0
        for i in range(len(cloud)):
            occluded_count += nearest[cell_of_point[i]] < cloud[i, 2] - limit
        if covered_count > 0:
            violation[b] = occluded_count / len(cloud)
            unobserved[b] = missed_count / covered_count
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
        nearest: output.
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
    """Find the cell of the ray through a point (x, y, z); rays far off are in a cell at the border.

    Args:
        x: of the point, in the camera frame.
        y: of the point.
        z: of the point, above 0.
        scale: cells per unit of x / z and y / z.
        middle: column and row of the middle cell.
    """
    column = np.floor(x / z * scale - middle[0])
    row = np.floor(y / z * scale - middle[1])
    column = min(max(column, -_REACH), _REACH) + _REACH
    row = min(max(row, -_REACH), _REACH) + _REACH
    return int(column) * (2 * _REACH + 1) + int(row)
