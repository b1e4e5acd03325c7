"""Model files to :class:`ObjectModel`: with faces, or points alone."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files import AnyPath
from depthpose.pose.config import MeshConfig, Unit, metres_of
from depthpose.pose.mesh.files import read_geometry, unit_of
from depthpose.pose.mesh.sampling import (
    estimate_normals,
    farthest_points,
    fibonacci_directions,
    sample_surface,
)
from depthpose.pose.types import ObjectModel, Symmetries

_COARSE = 1000
"""A mesh of fewer points (a CAD box has eight) also takes keypoints from inside its faces."""
_LARGEST_M, _SMALLEST_M = 20.0, 0.002


def read_model(
    path: AnyPath,
    unit: Unit | None = None,
    *,
    name: str | None = None,
    number: int = 0,
    symmetries: Symmetries | None = None,
    config: MeshConfig | None = None,
) -> ObjectModel:
    """Read a model file.

    Args:
        path: mesh (PLY, STL, OBJ, GLB) or bare points (PLY, PCD, NPY, text).
        unit: unit of the numbers in the file; None: a GLB, whose are metres.
        name: what samples call the object; None: the file's name.
        number: BOP's ``obj_id``.
        symmetries: as declared; None: none.
        config: how many keypoints.

    Raises:
        InputError: the file is missing, damaged or of another format, holds no extent or faces
            without area, has no unit, or is so large or small that the unit must be another.
    """
    unit = unit_of(path, unit)
    scale = metres_of(unit)
    vertices, faces = read_geometry(path)
    vertices_m = torch.from_numpy(vertices) * scale
    _refuse_unit(path, vertices_m, unit)
    return make_model(
        vertices_m,
        torch.from_numpy(faces),
        name=Path(path).stem if name is None else name,
        number=number,
        symmetries=symmetries,
        config=config,
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
    """Make a model of points and faces that are in memory; the rest is computed.

    Raises:
        InputError: all points are one, or fewer of them differ than keypoints are wanted.
    """
    config = MeshConfig() if config is None else config
    # Points of no face are not surface: one stray would set the diameter and take a keypoint.
    if len(faces):
        kept, faces = torch.unique(faces, return_inverse=True)
        vertices_m = vertices_m[kept]
    vertices_m = vertices_m.float()
    normals = _vertex_normals(vertices_m, faces) if len(faces) else estimate_normals(vertices_m)
    model = ObjectModel(
        name=name,
        number=number,
        vertices_m=vertices_m,
        faces=faces.long().reshape(-1, 3),
        normals=normals,
        diameter_m=exact_diameter(vertices_m),
        keypoints_m=vertices_m[:0],
        symmetries=Symmetries() if symmetries is None else symmetries,
    )
    return _with_keypoints(model, config.keypoints)


def refuse_one_name(models: Sequence[ObjectModel]) -> None:
    """Refuse models of one name: an object is known by its name.

    Raises:
        InputError: the name, and the numbers of the models that have it.
    """
    names = [model.name for model in models]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        numbers = " and ".join(str(model.number) for model in models if model.name == twice[0])
        raise InputError(
            f"two models are called {twice[0]!r} (numbers {numbers}: obj_id of a data set, the "
            "place among CAD files), and an object is known by its name; rename one"
        )


_HULL = 8000
"""Corners of a hull of which all pairs are compared; more take seconds."""
_DIRECTIONS = 4096
"""No direction is farther than 0.03 rad from one of these, whose cosine is 0.9995."""


def exact_diameter(points_m: Float[Tensor, "n 3"]) -> float:
    """Largest distance of two points [m]: both are corners of the convex hull.

    Of a hull of more than 8,000 corners, those farthest in many directions are compared:
    less than 0.05 % too short.
    """
    points = np.unique(points_m.double().cpu().numpy(), axis=0)
    # All on one plane, or fewer than four: there is no hull, and every pair is looked at.
    with suppress(QhullError, ValueError):
        points = points[ConvexHull(points).vertices]
    everything = torch.from_numpy(points)
    if len(everything) > _HULL:
        everything = everything[_farthest_each_way(everything)]
    exactly = "donot_use_mm_for_euclid_dist"
    rows = (torch.cdist(row, everything, compute_mode=exactly) for row in everything.split(1024))
    return max(float(row.max()) for row in rows)


def _farthest_each_way(points: Float64[Tensor, "n 3"]) -> Int64[Tensor, " m"]:
    """Number the points that lie farthest forwards or backwards in evenly spread directions."""
    directions = fibonacci_directions(_DIRECTIONS).T
    found = []
    for some in directions.split(256, dim=1):
        along = points @ some
        found += [along.argmax(0), along.argmin(0)]
    return torch.cat(found).unique()


def _with_keypoints(model: ObjectModel, count: int) -> ObjectModel:
    candidates = model.vertices_m
    if len(model.faces) and len(candidates) < _COARSE:
        candidates = torch.cat([candidates, sample_surface(model, 4096)[0]])
    keypoints_m = candidates[farthest_points(candidates, count)]
    fields = {**vars(model), "keypoints_m": keypoints_m}
    return ObjectModel(**fields)


def _vertex_normals(vertices_m: Tensor, faces: Tensor) -> Tensor:
    """Mean of the normals of the faces at a vertex, each by its area."""
    corners = vertices_m.double()[faces]
    doubled = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = torch.zeros(len(vertices_m), 3, dtype=torch.float64)
    for corner in range(3):
        total.index_add_(0, faces[:, corner], doubled)
    return (total / total.norm(dim=-1, keepdim=True).clamp(min=1e-300)).to(vertices_m)


def _refuse_unit(path: AnyPath, vertices_m: Tensor, unit: Unit) -> None:
    extent_m = float((vertices_m.amax(0) - vertices_m.amin(0)).max())
    if extent_m > _LARGEST_M and unit == "m":
        raise InputError(
            f"{path}: the model is {extent_m:g} m long, and no sensor sees it whole; is it in mm? "
            "Then say unit mm (or cm)."
        )
    if 0 < extent_m < _SMALLEST_M and unit == "mm":
        raise InputError(
            f"{path}: the model is {extent_m * 1000:g} mm long, below what a sensor resolves; is "
            "it in metres? Then say unit m; of BOP, whose models are in mm, multiply it by 1000."
        )
