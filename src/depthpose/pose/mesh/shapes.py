"""Meshes and clouds of trimesh and Open3D in memory: their points, triangles and unit."""

from pathlib import Path
from typing import Any

import numpy as np

from depthpose.core.errors import InputError
from depthpose.core.units import Unit

_UNITS: dict[str, Unit] = {
    "m": "m", "meter": "m", "meters": "m", "metre": "m", "metres": "m",
    "cm": "cm", "centimeter": "cm", "centimeters": "cm",
    "mm": "mm", "millimeter": "mm", "millimeters": "mm",
}  # fmt: skip
"""Names of units in trimesh."""


def is_shape(value: object) -> bool:
    """Whether a value is an object of trimesh or Open3D; neither is imported for that."""
    return type(value).__module__.partition(".")[0] in ("trimesh", "open3d")


def shape_geometry(shape: Any) -> tuple[np.ndarray, np.ndarray]:  # noqa: ANN401  no types of theirs
    """Read points (n, 3) and triangles (m, 3) of a shape in memory; a cloud has no triangles.

    A shape is a ``Trimesh``, ``Scene`` or ``PointCloud`` of trimesh, or a ``TriangleMesh`` or
    ``PointCloud`` of Open3D, of its tensors too.

    Raises:
        InputError: the shape is something else, or has no points.
    """
    if not is_shape(shape):
        raise InputError(
            f"a {type(shape).__name__} is no model; give a file, a trimesh.Trimesh, or a "
            "TriangleMesh of Open3D"
        )
    if hasattr(shape, "to_legacy"):  # of Open3D's tensors
        shape = shape.to_legacy()
    if hasattr(shape, "to_mesh"):  # a scene of trimesh, its nodes in their places
        shape = shape.to_mesh()
    points = next((getattr(shape, n) for n in ("vertices", "points") if hasattr(shape, n)), None)
    faces = next((getattr(shape, n) for n in ("faces", "triangles") if hasattr(shape, n)), None)
    if points is None or len(points) == 0:
        raise InputError(
            f"a {type(shape).__name__} without points is no model; give a mesh or a cloud that has "
            "some"
        )
    triangles = np.empty((0, 3), np.int64) if faces is None else np.asarray(faces, np.int64)
    return np.asarray(points, np.float64).reshape(-1, 3), triangles.reshape(-1, 3)


def shape_unit(shape: Any) -> Unit | None:  # noqa: ANN401
    """Read the unit that a shape declares; None where it declares none that is known."""
    return _UNITS.get(str(getattr(shape, "units", None)).lower())


def shape_name(shape: Any, number: int) -> str:  # noqa: ANN401
    """Find the name of a shape: its own, that of its file, or ``object_NUMBER``."""
    metadata = getattr(shape, "metadata", None) or {}
    file = getattr(getattr(shape, "source", None), "file_name", None)
    name = metadata.get("name") or file or metadata.get("file_name")
    return f"object_{number}" if not name else Path(str(name)).stem
