"""Known objects: read or made, their symmetries as declared, and points of their surface."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from scipy.spatial import ConvexHull, Delaunay, KDTree, QhullError
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, is_rigid, rotation_by
from depthpose.core.units import Unit, metres_of
from depthpose.pose.config import MeshConfig
from depthpose.pose.mesh.colors import read_colors
from depthpose.pose.mesh.files import AnyModel, read_geometry, unit_of
from depthpose.pose.mesh.sampling import spread_over_triangles
from depthpose.pose.mesh.shapes import is_shape, shape_name
from depthpose.pose.types import Axis, ObjectModel, Symmetries

BOP_STEP = 0.01
"""BOP turns about a continuous axis so that no point moves more than this share of the diameter."""


def turn_about(
    direction: Float[Tensor, "3"], point_m: Float[Tensor, "3"], angle_rad: Float[Tensor, "*batch"]
) -> Rigid:
    """Make the rotation by an angle about a line through ``point_m``, by the right-hand rule.

    ``direction`` is that of the line, of any length; the other two arguments may be batches.
    """
    R = rotation_by(angle_rad[..., None].to(direction) * direction / direction.norm())
    return Rigid(R, point_m - (R @ point_m[..., None]).squeeze(-1))


def axis_of_turn(turn: Rigid) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Find the line about which a motion rotates, the inverse of :func:`turn_about`.

    Args:
        turn: rotation about a line by more than 0 and less than 180 degrees.

    Returns:
        The unit vector of the line (3,), by the right-hand rule, and its point nearest to the
        origin (3,) [m].
    """
    # R - R^T is the skew matrix of the direction, times twice the sine of the angle.
    skew = turn.R - turn.R.T
    direction = torch.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
    # The points of the line stay where they are: p = R p + t.
    # Solved without the direction of the line, whose singular value is 0.
    change = torch.eye(3).to(turn.R) - turn.R
    point_m = torch.linalg.pinv(change, rtol=1e-3) @ turn.t_m
    return direction / direction.norm(), point_m


def symmetry_transforms(symmetries: Symmetries, max_step: float = BOP_STEP) -> Rigid:
    """List the transforms ``model_from_model`` that leave the object as it is.

    They are the identity, the discrete ones, and each of them followed by rotations about each
    continuous axis, in equal steps of the full circle. BOP's toolkit leaves out the rotation by 0
    where there is an axis; with it, an exact estimate has no error.

    Args:
        symmetries: of the object.
        max_step: half of the largest step of a rotation about an axis [rad], as BOP counts.

    Returns:
        A batch, the identity first.
    """
    # The identity and the discrete ones.
    identity = Rigid(torch.eye(3)[None], torch.zeros(1, 3))
    discrete = symmetries.discrete
    copies = identity
    if discrete is not None:
        identity = Rigid(identity.R.to(discrete.R), identity.t_m.to(discrete.t_m))
        copies = Rigid.cat([identity, discrete])

    # Each of them followed by rotations.
    steps = math.ceil(math.pi / max_step)
    angles = torch.arange(steps, dtype=torch.float64) * (2 * math.pi / steps)
    transforms = [copies]
    for axis in symmetries.continuous:
        rotations = turn_about(axis.direction.to(copies.R), axis.point_m.to(copies.R), angles[1:])
        products = rotations[:, None] @ copies[None]
        transforms.append(Rigid(products.R.flatten(0, 1), products.t_m.flatten(0, 1)))
    return Rigid.cat(transforms)


def symmetries_from_bop(info: Mapping[str, Any], *, source: str) -> Symmetries:
    """Read the symmetries of an object from its entry in BOP's ``models_info.json``.

    The entry has ``symmetries_discrete`` (4x4, row by row) and ``symmetries_continuous``, both in
    mm. ``symmetries_found`` is ours: true where they were found in the geometry.

    Args:
        info: the entry.
        source: what errors call it.

    Raises:
        InputError: an entry is no rigid transform or no axis.
    """
    rows = info.get("symmetries_discrete", [])
    entries = info.get("symmetries_continuous", [])
    if not isinstance(rows, list) or not isinstance(entries, list):
        raise InputError(f"{source}: its symmetries are no lists; write [...] of them")
    motions = [_motion_from_bop(row, source) for row in rows]
    axes = [_axis_from_bop(entry, source) for entry in entries]
    return Symmetries(
        discrete=Rigid.stack(motions) if motions else None,
        continuous=tuple(axes),
        is_found=info.get("symmetries_found", False) is True,
    )


def _motion_from_bop(row: object, source: str) -> Rigid:
    """Read an entry of ``symmetries_discrete``: a 4x4 matrix row by row, its translation in mm."""
    try:
        matrix = torch.tensor(row, dtype=torch.float64).reshape(4, 4)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(
            f"{source}: the symmetry {repr(row)[:80]} is not 16 numbers; write a 4x4 matrix row by "
            "row"
        ) from error
    if not is_rigid(matrix, slack=1e-3):
        raise InputError(
            f"{source}: the symmetry {repr(row)[:200]} is no rigid motion; its upper left 3x3 is a "
            "rotation, its last row 0 0 0 1"
        )
    return Rigid(matrix[:3, :3], 0.001 * matrix[:3, 3])


def _axis_from_bop(entry: object, source: str) -> Axis:
    """Read an entry of ``symmetries_continuous``: an axis, and a point on it in mm."""
    fields = entry if isinstance(entry, Mapping) else {}
    direction = _parse_vector(fields.get("axis"))
    offset_mm = _parse_vector(fields.get("offset", [0, 0, 0]))
    length = 0.0 if direction is None else float(direction.norm())
    if direction is None or offset_mm is None or not 0 < length < math.inf:
        raise InputError(
            f'{source}: the continuous symmetry {repr(entry)[:80]} is not {{"axis": [x, y, z], '
            '"offset": [x, y, z]} with an axis of some length'
        )
    return Axis(direction=direction / length, point_m=0.001 * offset_mm)


def _parse_vector(values: object) -> Float64[Tensor, "3"] | None:
    """Parse a list of three numbers as a vector; None where it is none."""
    try:
        return torch.tensor(values, dtype=torch.float64).reshape(3)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return None


def symmetries_to_bop(symmetries: Symmetries) -> dict[str, Any]:
    """Convert symmetries to entries of ``models_info.json``; empty lists are left out."""
    info: dict[str, Any] = {}
    if symmetries.discrete is not None:
        R = symmetries.discrete.R
        t_mm = 1000 * symmetries.discrete.t_m
        upper_rows = torch.cat([R, t_mm[..., None]], -1).flatten(1).tolist()
        info["symmetries_discrete"] = [[*rows, 0.0, 0.0, 0.0, 1.0] for rows in upper_rows]
    if symmetries.continuous:
        info["symmetries_continuous"] = [
            {"axis": axis.direction.tolist(), "offset": (1000 * axis.point_m).tolist()}
            for axis in symmetries.continuous
        ]
    if symmetries.is_found and info:
        info["symmetries_found"] = True
    return info


_NORMAL_NEIGHBOURS = 16  # to which the plane at a bare point is fitted
_GAP_POINTS = 20_000  # of a surface between its vertices, by which a gap to it is measured


def farthest_points(points_m: Float[Tensor, "n 3"], count: int) -> Int64[Tensor, " count"]:
    """Choose points each of which is farthest from all before it.

    The first is farthest from the centre of the bounding box, which does not depend on how densely
    a part is meshed (as PVNet). Of equals the earliest is taken, so that a mesh always has the same
    points.

    Returns:
        Their indices, in the order in which they were chosen.

    Raises:
        InputError: there are fewer different points than wanted.
    """
    points = points_m.double().cpu().numpy()
    centre = (points.min(0) + points.max(0)) / 2
    gap_squared = ((points - centre) ** 2).sum(-1)  # of each point to the nearest chosen one
    chosen = []
    for _ in range(count):
        farthest = int(gap_squared.argmax())
        if gap_squared[farthest] == 0 and chosen:
            raise InputError(
                f"the model has only {len(chosen)} different points, and {count} keypoints are to "
                "be chosen among them; give a mesh with triangles, or more points"
            )
        chosen.append(farthest)
        distance_squared = ((points - points[farthest]) ** 2).sum(-1)
        # The centre counts for the choice of the first point alone.
        is_first = len(chosen) == 1
        gap_squared = distance_squared if is_first else np.minimum(gap_squared, distance_squared)
    return torch.tensor(chosen)


def sample_surface(
    model: ObjectModel, count: int
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Spread points evenly over the surface of a model, always the same ones.

    A model of points has no faces: some of its points are taken, evenly by their order.

    Args:
        model: the object.
        count: how many points; a model of points may have fewer.

    Returns:
        The points [m] and their outward normals, in the model frame.
    """
    if len(model.faces) == 0:
        # Farthest points would be more even, but take quadratic time.
        return take_evenly(model.vertices_m, count), take_evenly(model.normals, count)
    corners = model.vertices_m[model.faces].double()
    face, barycentric = spread_over_triangles(corners, count)
    points = (corners[face] * barycentric[..., None]).sum(-2)
    # The cross product of two edges is normal to the face, and as long as twice its area.
    edges = corners[:, 1:] - corners[:, :1]
    normals = torch.linalg.cross(edges[:, 0], edges[:, 1])[face]
    normals = normals / normals.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    return points.to(model.vertices_m), normals.to(model.vertices_m)


_MOST_POINTS = 10_000
"""Most points of a model that are joined by triangles: their tetrahedralization takes a second."""
_NEIGHBOURS = 12
"""A triangle's circumcircle is no larger than the distance of a corner to its twelfth neighbour:
where points are random a circle without any is seldom so large."""
_LEAST_ALONG = 0.5
"""Least cosine between the normals of a triangle and of its points, in the mean of the three: a
triangle that bridges a hole or a thin wall stands across the surface."""


def drawn_triangles(model: ObjectModel) -> Float[Tensor, "n 3 3"]:
    """Make the triangles by which a model is drawn: its faces, or triangles between bare points."""
    if len(model.faces):
        return model.vertices_m[model.faces]
    return triangulate_points(*sample_surface(model, _MOST_POINTS))


def triangulate_points(
    points_m: Float[Tensor, "p 3"], normals: Float[Tensor, "p 3"]
) -> Float[Tensor, "n 3 3"]:
    """Join neighbouring points of a surface by triangles, whose corners are returned.

    As an alpha shape (Edelsbrunner and Mücke 1994): triangles of the Delaunay tetrahedra whose
    circumcircle is small, here beside the distances of neighbouring points, and that lie along the
    surface by its normals. Triangles within a body remain too: nothing sees them.
    """
    points = points_m.double().numpy()
    if len(points) <= 4:  # a tetrahedron is no surface
        return points_m.new_zeros(0, 3, 3)

    # The largest circumcircle at each point, by the distance of its neighbours.
    count = min(_NEIGHBOURS + 1, len(points))  # the nearest is the point itself
    distance_m, _ = KDTree(points).query(points, count, workers=1)
    largest_radius_m = distance_m[:, -1]

    # Each triangle of each tetrahedron, once. Joggled (QJ), points of one plane have some as well.
    tetrahedra = Delaunay(points, qhull_options="QJ").simplices
    triangles = np.concatenate([np.delete(tetrahedra, corner, axis=1) for corner in range(4)])
    triangles = np.unique(np.sort(triangles, axis=1), axis=0)

    # The radius of a circumcircle is the product of the sides over four times the area.
    corners = points[triangles]
    sides = corners - np.roll(corners, 1, axis=1)
    across = np.cross(sides[:, 0], sides[:, 1])
    doubled_area = np.maximum(np.linalg.norm(across, axis=1), 1e-300)
    radius_m = np.linalg.norm(sides, axis=2).prod(1) / (2 * doubled_area)
    is_small = radius_m < largest_radius_m[triangles].max(1)

    # Does the triangle's normal agree with those of its corners?
    triangle_normals = across / doubled_area[:, None]
    corner_normals = normals.double().numpy()[triangles]
    cosine = np.abs(np.einsum("tci,ti->tc", corner_normals, triangle_normals))
    is_along = cosine.mean(1) > _LEAST_ALONG
    return torch.from_numpy(corners[is_small & is_along]).to(points_m)


def gap_to_surface_m(points_m: Float[Tensor, "n 3"], model: ObjectModel) -> float:
    """Measure the largest distance of some points from a model's surface [m].

    The surface is represented by its vertices and 20,000 points between them, a hundredth of the
    diameter apart.
    """
    samples_m, _ = sample_surface(model, _GAP_POINTS)
    surface_m = torch.cat([model.vertices_m, samples_m])
    return float(torch.cdist(points_m, surface_m).amin(1).max())


def fibonacci_directions(count: int) -> Float[Tensor, "count 3"]:
    """Spread unit vectors evenly over the half of the sphere with z > 0, by a Fibonacci lattice."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - i / count
    golden_ratio = (1 + 5**0.5) / 2
    angle = 2 * math.pi * golden_ratio * i
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], -1)


_COARSE_MESH = 1000  # a mesh of fewer points (a box: eight) also takes keypoints inside its faces
_KEYPOINT_CANDIDATES = 4096  # inside the faces of such a mesh
_LARGEST_M = 20.0  # a model in metres that is larger is likely in millimetres
_SMALLEST_M = 0.002  # a model in millimetres that is smaller is likely in metres


def read_model(
    path: AnyModel,
    unit: Unit | None = None,
    *,
    name: str | None = None,
    number: int = 0,
    symmetries: Symmetries | None = None,
    config: MeshConfig | None = None,
) -> ObjectModel:
    """Read a model file.

    Args:
        path: mesh (PLY, STL, OBJ, GLB) or bare points (PLY, PCD, NPY, text), whose colours are
            read where it has some; or a mesh or cloud of trimesh or Open3D.
        unit: unit of the numbers in the file; None where it is fixed (a GLB is in metres), or the
            mesh in memory says its own.
        name: what samples call the object; None: the file's name, or that of a mesh
            (``metadata["name"]`` of trimesh), or object_NUMBER.
        number: BOP's ``obj_id``.
        symmetries: as declared; None: none.
        config: how many keypoints.

    Raises:
        InputError: the file is missing, damaged or of another format, holds no extent or faces
            without area, has no unit, or is so large or small that the unit must be another.
    """
    # What it is called.
    is_file = isinstance(path, str | Path)
    if not is_file and not is_shape(path):
        raise InputError(
            f"a {type(path).__name__} is no model: give files, or meshes of trimesh or Open3D, one "
            "by one"
        )
    if name is None:
        name = Path(path).stem if is_file else shape_name(path, number)

    # Its points, of a size that a sensor sees.
    unit = unit_of(path, unit)
    unit_m = metres_of(unit)
    vertices, faces = read_geometry(path)
    vertices_m = torch.from_numpy(vertices) * unit_m
    _refuse_other_unit(path, unit, float((vertices_m.amax(0) - vertices_m.amin(0)).max()))
    model = make_model(
        vertices_m,
        torch.from_numpy(faces),
        name=name,
        number=number,
        symmetries=symmetries,
        config=config,
    )
    return replace(model, colors=read_colors(path, unit_m, model)) if is_file else model


def _refuse_other_unit(path: AnyModel, unit: Unit, extent_m: float) -> None:
    """Refuse a model that is so long or short [m] in its unit that another must be meant."""
    if extent_m > _LARGEST_M and unit == "m":
        raise InputError(
            f"{path}: the model is {extent_m:g} m long, and no sensor sees it whole; is it in mm? "
            "Then say unit mm (or cm); beside depth or a cloud that is --cad-unit."
        )
    if 0 < extent_m < _SMALLEST_M and unit == "mm":
        raise InputError(
            f"{path}: the model is {extent_m * 1000:g} mm long, below what a sensor resolves; is "
            "it in metres? Then say unit m; of BOP, whose models are in mm, multiply it by 1000."
        )


def make_model(
    vertices_m: Float[Tensor, "v 3"],
    faces: Tensor,
    *,
    name: str,
    number: int = 0,
    symmetries: Symmetries | None = None,
    config: MeshConfig | None = None,
) -> ObjectModel:
    """Make a model of points and faces in memory; normals, diameter and keypoints are computed.

    Args:
        vertices_m: points of the model frame.
        faces: (f, 3), indices of their corners; of bare points none.
        name: what samples call the object.
        number: BOP's ``obj_id``.
        symmetries: as declared; None: none.
        config: how many keypoints.

    Raises:
        InputError: all points are one, or fewer of them differ than keypoints are wanted.
    """
    config = MeshConfig() if config is None else config
    # Points of no face are not surface: one stray would set the diameter and take a keypoint.
    if len(faces):
        kept, faces = torch.unique(faces, return_inverse=True)
        vertices_m = vertices_m[kept]
    vertices_m = vertices_m.float()
    normals = (
        _average_vertex_normals(vertices_m, faces) if len(faces) else _fit_point_normals(vertices_m)
    )
    model = ObjectModel(
        name=name,
        number=number,
        vertices_m=vertices_m,
        faces=faces.long().reshape(-1, 3),
        normals=normals,
        diameter_m=measure_diameter(vertices_m),
        keypoints_m=vertices_m[:0],
        symmetries=Symmetries() if symmetries is None else symmetries,
    )

    # Keypoints, among the vertices and, of a coarse mesh, points inside its faces.
    candidates = vertices_m
    if len(faces) and len(candidates) < _COARSE_MESH:
        inside_m, _ = sample_surface(model, _KEYPOINT_CANDIDATES)
        candidates = torch.cat([candidates, inside_m])
    return replace(model, keypoints_m=candidates[farthest_points(candidates, config.keypoints)])


def _average_vertex_normals(
    vertices_m: Float[Tensor, "v 3"], faces: Tensor
) -> Float[Tensor, "v 3"]:
    """Average at each vertex the normals of its faces, weighted by their areas, to unit vectors."""
    corners = vertices_m.double()[faces]
    sides = corners[:, 1:] - corners[:, :1]
    doubled = torch.linalg.cross(sides[:, 0], sides[:, 1])  # normals, twice as long as the area
    total = torch.zeros(len(vertices_m), 3, dtype=torch.float64)
    for corner in range(3):
        total.index_add_(0, faces[:, corner], doubled)
    return (total / total.norm(dim=-1, keepdim=True).clamp(min=1e-300)).to(vertices_m)


def _fit_point_normals(points_m: Float[Tensor, "v 3"]) -> Float[Tensor, "v 3"]:
    """Fit a plane to the nearest 16 points of each point, and compute its unit normal.

    It points away from the mean of all points: to the outer side of convex parts alone.
    Point-to-plane distances need no side.
    """
    points = points_m.double().cpu().numpy()
    _, index = KDTree(points).query(points, k=min(_NORMAL_NEIGHBOURS, len(points)))
    near = points[index.reshape(len(points), -1)]
    near = near - near.mean(1, keepdims=True)
    _, axes = np.linalg.eigh(near.transpose(0, 2, 1) @ near)
    outward = axes[:, :, 0]  # of the least extent
    outward[((points - points.mean(0)) * outward).sum(-1) < 0] *= -1
    return torch.from_numpy(outward).to(points_m)


def refuse_equal_names(models: Sequence[ObjectModel]) -> None:
    """Refuse models two of which have the same name, by which an object is known.

    Raises:
        InputError: with the name, and the numbers of the models that have it.
    """
    names = [model.name for model in models]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        numbers = " and ".join(str(model.number) for model in models if model.name == twice[0])
        raise InputError(
            f"two models are called {twice[0]!r} (numbers {numbers}: obj_id of a dataset, the "
            "place among CAD files), and an object is known by its name; rename one"
        )


_MOST_HULL_CORNERS = 8000  # of which all pairs are compared; more take seconds
_HULL_DIRECTIONS = 4096  # no direction is farther than 0.03 rad from one of these: cosine 0.9995
_DIRECTIONS_AT_ONCE = 256  # for memory
_CORNERS_AT_ONCE = 1024
_EXACT_DISTANCES = "donot_use_mm_for_euclid_dist"  # not by a matrix product, which cancels digits


def measure_diameter(points_m: Float[Tensor, "n 3"]) -> float:
    """Measure the largest distance of two points [m], which are corners of the convex hull.

    If the hull has more than 8,000 corners, those farthest in many directions are compared: the
    result is less than 0.05 % too short.
    """
    points = np.unique(points_m.double().cpu().numpy(), axis=0)
    # Points of one plane, or fewer than four, have no hull: all of them are compared.
    with suppress(QhullError, ValueError):
        points = points[ConvexHull(points).vertices]
    corners = torch.from_numpy(points)
    if len(corners) > _MOST_HULL_CORNERS:
        farthest = []
        all_directions = fibonacci_directions(_HULL_DIRECTIONS).T
        for directions in all_directions.split(_DIRECTIONS_AT_ONCE, dim=1):
            along = corners @ directions
            farthest += [along.argmax(0), along.argmin(0)]
        corners = corners[torch.cat(farthest).unique()]
    longest_m = 0.0
    for some_corners in corners.split(_CORNERS_AT_ONCE):
        distance_m = torch.cdist(some_corners, corners, compute_mode=_EXACT_DISTANCES)
        longest_m = max(longest_m, float(distance_m.max()))
    return longest_m
