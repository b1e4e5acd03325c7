"""Model files to :class:`ObjectModel`: PLY, STL, OBJ and GLB, with faces or points alone.

What a file declares, or may grow to, is checked before it is read in full.
"""

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files import AnyPath, cloud_suffixes, read_bytes, read_cloud
from depthpose.core.files.disk import refused_as, refused_suffix
from depthpose.pose.config import MeshConfig, Unit, metres_of
from depthpose.pose.mesh.sampling import (
    estimate_normals,
    farthest_points,
    fibonacci_directions,
    sample_surface,
)
from depthpose.pose.types import ObjectModel, Symmetries

_MOST_TEXT = {".stl": 2**26, ".obj": 2**25, ".ply": 12 * 2**20}
"""Bytes of text that trimesh reads in less than a gigabyte, by measurement."""
_MOST_VALUES = 2 * 10**7
"""That the accessors of a GLB may declare: six million points."""
_MOST_NODES, _MOST_SCENE_BYTES = 10_000, 2**22
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def refuse_too_large(path: AnyPath, suffix: str, data: bytes) -> None:
    """Refuse a model that would fill the memory while it is read.

    Raises:
        InputError: too much text, or a scene that declares more than it can hold.
    """
    if suffix == ".glb":
        _refuse_scene(path, data)
    elif _is_text(suffix, data) and len(data) > _MOST_TEXT[suffix]:
        raise InputError(
            f"{path}: {len(data)} bytes of text, more than the {_MOST_TEXT[suffix]} that are read "
            f"of a {suffix}; save it as binary PLY or STL"
        )


def _is_text(suffix: str, data: bytes) -> bool:
    """Recognise text as trimesh does: an STL is binary if its length is that of its triangles."""
    if suffix == ".ply":
        return b"format ascii" in data[: 2**16]
    if suffix == ".stl" and len(data) >= 84:
        return len(data) != 84 + 50 * struct.unpack("<I", data[80:84])[0]
    return True


def _refuse_scene(path: AnyPath, data: bytes) -> None:
    """Refuse a GLB by the JSON at its head: accessors without bytes hold as many zeros as said."""
    with refused_as(path, "GLB", "export it again"):
        (size,) = struct.unpack("<I", data[12:16])
        if size > _MOST_SCENE_BYTES:
            raise InputError(f"{path}: {size} bytes of JSON in a GLB; export the part alone")
        scene: Any = json.loads(data[20 : 20 + size])
        for link in filter(None, (buffer.get("uri") for buffer in scene.get("buffers", []))):
            if not link.startswith("data:"):
                raise InputError(
                    f"{path}: its numbers are in another file, {link[:60]!r}, and a GLB is read "
                    "alone; export it as one file, with its buffers inside"
                )
        accessors = scene.get("accessors", [])
        values = [_values(accessor) for accessor in accessors]
        placed = sum(
            values[part["attributes"]["POSITION"]]
            for node in scene.get("nodes", [])
            if "mesh" in node
            for part in scene["meshes"][node["mesh"]]["primitives"]
            if "POSITION" in part.get("attributes", {})
        )
        nodes = len(scene.get("nodes", []))
    if max(sum(values), placed) > _MOST_VALUES or nodes > _MOST_NODES:
        raise InputError(
            f"{path}: declares {max(sum(values), placed)} numbers in {nodes} nodes, more than "
            f"{_MOST_VALUES} and {_MOST_NODES}; export the part alone"
        )


def _values(accessor: Mapping[str, Any]) -> int:
    return abs(int(accessor["count"])) * _WIDTHS[accessor["type"]]


_COARSE = 1000
"""A mesh of fewer points (a CAD box has eight) also takes keypoints from inside its faces."""
_NO_AREA = 1e-12
"""Of the square of the extent: a face of no more is a line or a point."""
_LEAST_AREA = 1e-6
"""Of the square of the extent: all faces of less are no surface. A wire has 0.003."""
_LARGEST_M, _SMALLEST_M = 20.0, 0.002
_FARTHEST = 1e9
"""A coordinate beyond belongs to no model, in whatever unit, and overflows in float32."""


def read_model(
    path: AnyPath,
    unit: Unit,
    *,
    name: str | None = None,
    number: int = 0,
    symmetries: Symmetries | None = None,
    config: MeshConfig | None = None,
) -> ObjectModel:
    """Read a model file.

    Args:
        path: mesh (PLY, STL, OBJ, GLB) or bare points (PLY, PCD, NPY, text).
        unit: unit of the numbers in the file; no format but GLB says it.
        name: what samples call the object; None: the file's name.
        number: BOP's ``obj_id``.
        symmetries: as declared; None: none.
        config: how many keypoints.

    Raises:
        InputError: the file is missing, damaged or of another format, holds no extent or faces
            without area, or is so large or small that the unit must be another.
    """
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


def read_geometry(path: AnyPath) -> tuple[np.ndarray, np.ndarray]:
    """Read points and faces of a model file in the file's own unit; bare points have no faces.

    Raises:
        InputError: the file is missing, damaged or of another format, or has no surface.
    """
    suffix = Path(path).suffix.lower()
    if suffix in MESH_READERS:
        return MESH_READERS[suffix](path)
    if suffix not in cloud_suffixes():
        known = dict.fromkeys((*mesh_suffixes(), *cloud_suffixes()))
        raise refused_suffix(path, "model", tuple(known))
    return read_cloud(path).points.double().numpy(), np.empty((0, 3), np.int64)


def mesh_suffixes() -> tuple[str, ...]:
    """Name the suffixes of model files that may have faces, in lower case."""
    return tuple(MESH_READERS)


def _read_mesh(path: AnyPath) -> tuple[np.ndarray, np.ndarray]:
    suffix = Path(path).suffix.lower()
    data = read_bytes(path)
    refuse_too_large(path, suffix, data)
    with refused_as(path, "model", "export it again"):
        import trimesh

        loaded: Any = trimesh.load(
            BytesIO(data), suffix[1:], process=False, skip_materials=True, allow_remote=False
        )
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_mesh()
        vertices = np.asarray(loaded.vertices, np.float64).reshape(-1, 3)
        faces = np.asarray(getattr(loaded, "faces", np.empty((0, 3))), np.int64).reshape(-1, 3)
    if len(vertices) < 4 or not (np.abs(vertices) < _FARTHEST).all():
        raise InputError(
            f"{path}: holds {len(vertices)} points, or one that is not finite or beyond "
            f"{_FARTHEST:g}; a model needs 4 and more. Export it again."
        )
    return vertices, _sound_faces(path, vertices, faces)


MESH_READERS: dict[str, Callable[[AnyPath], tuple[np.ndarray, np.ndarray]]] = {
    ".ply": _read_mesh,
    ".stl": _read_mesh,
    ".obj": _read_mesh,
    ".glb": _read_mesh,
}
"""Suffix to reader of points (n, 3; float64) and faces (f, 3; int64), in the file's unit."""


def _sound_faces(path: AnyPath, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Drop faces without area, and all but the first of those on the same three points.

    A face and its reverse would cancel in the normals. Holes are no flaw.
    """
    if len(faces) == 0:
        return faces
    wrong = (faces < 0) | (faces >= len(vertices))
    if wrong.any():
        face, corner = np.argwhere(wrong)[0]
        raise InputError(
            f"{path}: face {face} names point {faces[face, corner]}, but the {len(vertices)} "
            f"points are numbered 0 .. {len(vertices) - 1}; the file is damaged. Export it again."
        )
    corners = vertices[faces]
    sides = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1) / 2
    square = float(np.ptp(vertices, axis=0).max()) ** 2
    if area.sum() <= _LEAST_AREA * square:
        raise InputError(
            f"{path}: its {len(faces)} faces have no area, so there is no surface to see; all are "
            "lines or points. Export it again as triangles, or as points without faces."
        )
    # By place, not by number: STL repeats the points of every face.
    _, place = np.unique(vertices, axis=0, return_inverse=True)
    _, first = np.unique(np.sort(place.reshape(-1)[faces], axis=-1), axis=0, return_index=True)
    is_first = np.zeros(len(faces), bool)
    is_first[first] = True
    return faces[is_first & (area > _NO_AREA * square)]


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
            "Then say unit mm."
        )
    if 0 < extent_m < _SMALLEST_M and unit == "mm":
        raise InputError(
            f"{path}: the model is {extent_m * 1000:g} mm long, below what a sensor resolves; is "
            "it in metres? Then say unit m; of BOP, whose models are in mm, multiply it by 1000."
        )
