"""A cloud on a grid: the voxels of a network, one point for each cell, and planes at points."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int64
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.pose.config import CloudConfig

_MOST_CELLS_ACROSS = 2**20  # largest number of cells of a grid along an axis
_NEIGHBOURS = 20  # points to which the plane at a point is fitted


@dataclass(frozen=True, kw_only=True, eq=False)
class VoxelGrid:
    """The cells of a grid that a cloud fills, and the point of each cell that votes."""

    #: of the filled cells, ``floor((x - mean) / voxel)`` of the rotated cloud; no two are equal.
    coordinates: Int64[Tensor, "m 3"]
    points_m: Float[Tensor, "m 3"]  #: the first point of each cell, in the camera frame
    kept: Int64[Tensor, " m"]  #: index of that point in the cloud, ascending
    row_of_point: Int64[Tensor, " n"]  #: index of the cell of each point of the cloud
    grid_from_camera: Float[Tensor, "3 3"]  #: rotation of the cloud to the axes of the grid
    #: of each cell, in the axes of the grid: the number 1 or, with shape, also the place of the
    #: mean of its points in the cell (-1 to 1), log2 of their number, the normal toward the camera,
    #: and the curvature (0 in a plane, 1 in a ball).
    features: Float[Tensor, "m c"]


def sample_points(
    points_m: Float[Tensor, "n 3"], count: int | None, generator: torch.Generator
) -> Float[Tensor, "m 3"]:
    """Return ``count`` points chosen at random, in their order; all where there are fewer."""
    if count is None or len(points_m) <= count:
        return points_m
    index = torch.randperm(len(points_m), generator=generator)[:count].sort().values
    return points_m[index.to(points_m.device)]


def voxelise(points_m: Float[Tensor, "n 3"], config: CloudConfig) -> VoxelGrid:
    """Put a cloud on a grid about its mean, without scaling it; keep the first point of each cell.

    The grid's axes are the camera's, or with ``config.with_sight_axis`` rotated by the least angle
    so that the third points at the cloud's mean. Votes are cast from the kept points, not from the
    centres of cells.

    Args:
        points_m: the cloud in the camera frame, one point at least.
        config: side of a cell, axes and features.

    Raises:
        InputError: there is no point, one is not finite, or the cloud is over a million voxels
            wide.
    """
    if len(points_m) == 0:
        raise InputError("voxelise: the cloud has no point; see require_points first.")
    if not bool(points_m.isfinite().all()):
        # One NaN would move the mean, and with it every point, into one cell.
        count = int((~points_m.isfinite().all(-1)).sum())
        raise InputError(f"voxelise: {count} points are not finite; leave such points out.")

    # The cell of each point.
    mean_m = points_m.mean(0)
    grid_from_camera = torch.eye(3).to(points_m)
    if config.with_sight_axis and float(mean_m.norm()) > 0:
        grid_from_camera = rotation_from_z_to(mean_m).mT.to(points_m)
    places = (points_m - mean_m) @ grid_from_camera.mT / config.voxel_m
    cells = torch.floor(places).long()
    extent = int((cells.amax(0) - cells.amin(0)).max()) + 1
    if extent > _MOST_CELLS_ACROSS:
        raise InputError(
            f"voxelise: the cloud is {extent} voxels of {config.voxel_m} m wide; are its points in "
            "mm, or is one of them far away? Give metres."
        )

    # The first point of each filled cell, and the cells in the order of these points.
    x, y, z = (cells - cells.amin(0)).unbind(1)
    key = (x * extent + y) * extent + z  # a number for each cell
    _, cell_of_point = torch.unique(key, return_inverse=True)
    kept, cell_of_row = _find_first_in_cells(cell_of_point).sort()
    row_of_point = cell_of_row.argsort()[cell_of_point]

    features = torch.ones(len(kept), 1, dtype=torch.float32, device=kept.device)
    if config.with_shape:
        shape = _describe_cells(points_m, places, kept, row_of_point, grid_from_camera)
        features = torch.cat([features, shape.float()], 1)
    return VoxelGrid(
        coordinates=cells[kept],
        points_m=points_m[kept],
        kept=kept,
        row_of_point=row_of_point,
        grid_from_camera=grid_from_camera,
        features=features,
    )


def _describe_cells(
    points_m: Float[Tensor, "n 3"],
    places: Float[Tensor, "n 3"],
    kept: Int64[Tensor, " m"],
    row_of_point: Int64[Tensor, " n"],
    grid_from_camera: Float[Tensor, "3 3"],
) -> Float[Tensor, "m 8"]:
    """Describe the shape of a cloud in each cell: the features after the first of a grid.

    Args:
        points_m: the cloud.
        places: its points in sides of a cell, in the axes of the grid.
        kept: index of the point of each cell that is kept.
        row_of_point: the cell of each point.
        grid_from_camera: rotation to the axes of the grid.
    """
    # The mean of the points of each cell about the middle of the cell, in half cells.
    inside = places - torch.floor(places)
    counts = torch.bincount(row_of_point).to(inside)[:, None]
    sums = inside.new_zeros(len(counts), 3).index_add(0, row_of_point, inside)
    means = 2 * sums / counts - 1

    # The plane at the kept point.
    normals, curvature = fit_local_planes(points_m.double().cpu(), points_m[kept].double().cpu())
    normals = normals @ grid_from_camera.double().cpu().mT
    plane = torch.cat([normals, curvature], 1).to(sums)
    return torch.cat([means, counts.log2(), plane], 1)


def _find_first_in_cells(cell_of_point: Int64[Tensor, " n"]) -> Int64[Tensor, " cells"]:
    """Find the index of the first point of each cell; cells are numbered from 0, none is empty."""
    count = len(cell_of_point)
    index = torch.arange(count, device=cell_of_point.device)
    first = torch.full((int(cell_of_point.max()) + 1,), count, device=cell_of_point.device)
    return first.scatter_reduce_(0, cell_of_point, index, "amin")


def sample_and_voxelise(cloud_m: Float[Tensor, "n 3"], config: CloudConfig, seed: int) -> VoxelGrid:
    """Put at most ``config.max_points`` points of a cloud, chosen at random, on a grid."""
    generator = torch.Generator().manual_seed(seed)
    return voxelise(sample_points(cloud_m, config.max_points, generator), config)


def rotation_from_z_to(direction: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Compute the rotation by the least angle that carries the z axis to a direction, in float64.

    Rodrigues' formula with ``1 / (1 + z)``. For the direction opposite to the axis, where many are
    as small, it is the half turn about x.
    """
    x, y, z = (direction / direction.norm()).tolist()
    if z < -1 + 1e-9:
        return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    k = 1 / (1 + z)
    rows = [[1 - k * x * x, -k * x * y, x], [-k * x * y, 1 - k * y * y, y], [-x, -y, z]]
    return torch.tensor(rows, dtype=torch.float64)


def thin_cloud(
    points_m: Float64[Tensor, "n 3"], normals: Float64[Tensor, "n 3"], step_m: float
) -> Int64[Tensor, " m"]:
    """Choose points of a cloud: in each cell of a grid one for each octant of normals.

    The octant of a normal is the signs of its x, y and z. So both sides of a thin sheet, and the
    faces at an edge, keep a point each where they share a cell.

    Args:
        points_m: one at least.
        normals: of the points.
        step_m: side of a cell.

    Returns:
        Indices of the chosen points, the first in each cell and octant; ascending.
    """
    cells = ((points_m - points_m.amin(0)) / step_m).long()
    octants = (normals > 0).long()
    cells_and_octants = torch.cat([cells, octants], 1)
    _, cell_of_point = torch.unique(cells_and_octants, dim=0, return_inverse=True)
    return _find_first_in_cells(cell_of_point).sort().values


def fit_local_planes(
    cloud_m: Float64[Tensor, "n 3"], chosen_m: Float64[Tensor, "m 3"]
) -> tuple[Float64[Tensor, "m 3"], Float64[Tensor, "m 1"]]:
    """Fit a plane to the 20 points of a cloud that are nearest to each of the chosen points.

    Returns:
        The unit normal of each plane, toward the camera; the curvature of the cloud there, from the
        least eigenvalue of the neighbours' scatter: 0 (flat) to 1 (as wide in all directions).
    """
    # The neighbours of each point, about their mean.
    count = min(_NEIGHBOURS, len(cloud_m))
    _, index = KDTree(cloud_m.numpy()).query(chosen_m.numpy(), k=count, workers=1)
    near_m = cloud_m[torch.as_tensor(index).reshape(len(chosen_m), count)]
    near_m = near_m - near_m.mean(1, keepdim=True)

    # The normal is the direction in which they extend least.
    eigenvalues, axes = torch.linalg.eigh(near_m.mT @ near_m)
    normals = axes[:, :, 0]
    is_behind = (normals * chosen_m).sum(-1, keepdim=True) > 0
    total = eigenvalues.sum(1, keepdim=True).clamp(min=1e-30)
    curvature = 3 * eigenvalues[:, :1].clamp(min=0) / total
    return torch.where(is_behind, -normals, normals), curvature
