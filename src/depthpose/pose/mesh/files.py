"""Model files to points and triangles: PLY, STL, OBJ and GLB.

What a file declares, or may grow to, is checked before it is read in full.
"""

import math
import struct
from array import array
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import numpy as np

from depthpose.core.errors import InputError
from depthpose.core.files import CLOUD_READERS, AnyPath, read_bytes, read_cloud
from depthpose.core.files.disk import make_suffix_error
from depthpose.core.files.points import RaggedLists, read_ply_elements
from depthpose.core.units import Unit
from depthpose.pose.mesh.bodies import mark_part
from depthpose.pose.mesh.glb import read_glb
from depthpose.pose.mesh.polygons import cut_polygons
from depthpose.pose.mesh.shapes import shape_geometry, shape_unit

_MOST_TEXT_BYTES = 2**25  # of an OBJ or STL in text, which are read in some seconds
_NO_FACES = RaggedLists(np.empty(0, np.int64), np.empty(0, np.int64))
_STL_HEADER_BYTES = 84  # of a binary STL: 80 of any text, and the number of its triangles
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", 9), ("attribute", "<u2")])
_NO_AREA = 1e-12  # of the square of the extent: a face of no more is a line or a point
_LEAST_AREA = 1e-6  # of the squared extent: faces of less in all are no surface; a wire has 0.003
_FEWEST_POINTS = 4  # of a model: of a tetrahedron
_FARTHEST = 1e9  # no model has a larger coordinate, in whatever unit; it overflows in float32


AnyModel = AnyPath | object  #: a model file, or a mesh of trimesh or Open3D
FIXED_UNITS: dict[str, Unit] = {".glb": "m"}  #: of formats that fix theirs


def unit_of(model: AnyModel, unit: Unit | None) -> Unit:
    """Find the unit of a model: ``unit``, else that of its format or of the mesh in memory.

    Raises:
        InputError: there is none.
    """
    if isinstance(model, str | Path):
        declared = unit or FIXED_UNITS.get(Path(model).suffix.lower())
    else:
        declared = unit or shape_unit(model)
    if declared is None:
        raise InputError(
            f"{model}: no unit is given, and such a file does not say its own; give --unit mm, "
            "where depth or a cloud is given too --cad-unit mm, or unit: mm in a config"
        )
    return declared


def read_geometry(model: AnyModel) -> tuple[np.ndarray, np.ndarray]:
    """Read points and triangles of a model, in its own unit.

    Returns:
        Points (n, 3), and triangles as their indices (m, 3); bare points have no triangles.

    Raises:
        InputError: the file is missing, damaged or of another format, has no surface, or bodies far
            from each other.

    Warns:
        Notice: a small body far from the rest is left out.
    """
    # From memory, or by the reader of the file's suffix. Bare points need nothing more.
    if not isinstance(model, str | Path):
        vertices, faces = shape_geometry(model)
    elif (suffix := Path(model).suffix.lower()) in MESH_READERS:
        vertices, faces = MESH_READERS[suffix](model)
    elif suffix in CLOUD_READERS:
        return read_cloud(model).points.double().numpy(), np.empty((0, 3), np.int64)
    else:
        suffixes = dict.fromkeys((*MESH_READERS, *CLOUD_READERS))
        raise make_suffix_error(model, "model", tuple(suffixes))
    if len(vertices) < _FEWEST_POINTS or not (np.abs(vertices) < _FARTHEST).all():
        raise InputError(
            f"{model}: holds {len(vertices)} points, or one that is not finite or beyond "
            f"{_FARTHEST:g}; a model needs {_FEWEST_POINTS} and more. Export it again."
        )

    # Polygons become triangles, of which those of the part stay.
    triangles = _convert_to_triangles(str(model), vertices, faces)
    if len(triangles) == 0:
        return vertices, triangles
    return _clean_surface(str(model), vertices, triangles)


def _convert_to_triangles(
    path: AnyPath, vertices: np.ndarray, faces: np.ndarray | RaggedLists
) -> np.ndarray:
    """Convert faces to triangles (m, 3), as indices of vertices; polygons are cut."""
    if isinstance(faces, np.ndarray):  # all of equally many corners
        faces = RaggedLists(np.full(len(faces), faces.shape[1]), faces.reshape(-1))
    sizes = faces.sizes
    corners = faces.values.astype(np.int64)
    if (sizes == 3).all() and ((corners >= 0) & (corners < len(vertices))).all():
        return corners.reshape(-1, 3)
    return cut_polygons(path, vertices, sizes, corners)


def _clean_surface(
    path: AnyPath, vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Drop faces without area, repeated faces, and small bodies far from the part.

    Where faces have the same three points, the first stays: a face and its reverse would cancel in
    the normals. Holes are no flaw.

    Returns:
        Vertices and faces. Where no body is dropped, the vertices are the same, unused ones too;
        else they are those of the remaining faces alone, numbered anew.

    Raises:
        InputError: the faces have no area, or bodies lie far from each other.
    """
    # Is there a surface at all?
    sides = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1) / 2
    extent_squared = float(np.ptp(vertices, axis=0).max()) ** 2
    if area.sum() <= _LEAST_AREA * extent_squared:
        raise InputError(
            f"{path}: its {len(faces)} faces have no area, so there is no surface to see; all are "
            "lines or points. Export it again as triangles, or as points without faces."
        )

    # Points are compared by place, not by index: STL repeats the points of every face.
    unique_points, index_of_vertex = np.unique(vertices, axis=0, return_inverse=True)
    merged = index_of_vertex.reshape(-1)[faces]

    # The first face on its three points, if it has an area.
    _, first_faces = np.unique(np.sort(merged, axis=-1), axis=0, return_index=True)
    is_first = np.isin(np.arange(len(faces)), first_faces)
    is_kept = is_first & (area > _NO_AREA * extent_squared)

    # The part among the bodies of these faces.
    faces = faces[is_kept]
    is_part = mark_part(path, unique_points, merged[is_kept], area[is_kept])
    if is_part.all():
        return vertices, faces  # vertices of no face stay, and all keep their numbers

    # The vertices of dropped bodies go, and with them all others of no face.
    used, faces = np.unique(faces[is_part], return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _read_ply(path: AnyPath) -> tuple[np.ndarray, RaggedLists]:
    """Read vertices and faces of a PLY file."""
    columns, lists = read_ply_elements(path)
    if not columns.keys() >= set("xyz"):
        raise InputError(f"{path}: no x, y and z among {list(columns)}. Export it again.")
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN, and refused as such
        vertices = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], -1)

    # The list of a face's corners has one of several names: vertex_indices, vertex_index, ...
    face_lists = [name for name in lists if name.split()[0] in ("face", "tristrips")]
    index_lists = [name for name in face_lists if name.startswith("face ") and "ind" in name]
    vertex_lists = [name for name in index_lists if "vert" in name] or index_lists
    is_unique = len(vertex_lists) == 1
    values = lists[vertex_lists[0]].values if is_unique else np.array([math.nan])
    if face_lists and not ((np.abs(values) < _FARTHEST).all() and (values % 1 == 0).all()):
        raise InputError(
            f"{path}: the lists of its faces are {face_lists}, where one 'face vertex_indices' of "
            "whole numbers is needed. Export it again."
        )
    return vertices, lists[vertex_lists[0]] if vertex_lists else _NO_FACES


def _split_lines(path: AnyPath, data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Split text into lines; yield the number and the words of each that has words.

    Comments are left out, and the first word is in lower case. A backslash at the end of a line
    joins it with the next.
    """
    if len(data) > _MOST_TEXT_BYTES:
        raise InputError(
            f"{path}: {len(data)} bytes of text, more than the {_MOST_TEXT_BYTES} that are read; "
            "save it as binary PLY or STL"
        )
    joined = bytearray()  # lines that end by a backslash; it grows in place, as bytes do not
    text = data.removeprefix(BOM_UTF8).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    # An empty line is added, for a backslash may end the file.
    for number, line in enumerate(BytesIO(text + b"\n\n"), 1):
        if line.endswith(b"\\\n"):
            joined += line[:-2]
            continue
        words = bytes(joined + line).partition(b"#")[0].split()
        joined.clear()
        if words:
            yield number, [words[0].lower(), *words[1:]]


def _read_point(path: AnyPath, line: int, words: list[bytes]) -> list[float]:
    """Read x, y and z of a line; a weight or a colour may follow them."""
    with suppress(ValueError):
        point = [float(word) for word in words[1:4]]
        if len(point) == 3:
            return point
    raise InputError(
        f"{path}: line {line}, {b' '.join(words)[:60].decode('latin-1')!r}, does not give x, y and "
        "z with decimal points; export it again"
    )


def _read_stl(path: AnyPath) -> tuple[np.ndarray, RaggedLists]:
    """Read vertices and triangles of an STL file, binary or text.

    It is text if it begins so, unless its length is that of a binary file's triangles.
    """
    # What the header declares, and what follows it.
    data = read_bytes(path)
    body_bytes = len(data) - _STL_HEADER_BYTES
    (count,) = struct.unpack("<I", data[80:84]) if body_bytes >= 0 else (0,)
    records, spare_bytes = divmod(body_bytes, _STL_TRIANGLE.itemsize)
    head = data[: 2**16].removeprefix(BOM_UTF8).lstrip().lower()
    is_text = head.startswith(b"solid") and b"facet" in head and b"\0" not in head
    if is_text and (records, spare_bytes) != (count, 0):
        return _read_stl_text(path, data)

    # Writers that stream leave the count at 0; a byte or two after the last record do no harm.
    if records < 1 or (records != count and (count or spare_bytes)):
        raise InputError(
            f"{path}: declares {count} triangles, and {max(0, body_bytes)} bytes follow, those "
            f"of {max(0, records)}; it is truncated or no STL. Export it again."
        )
    triangles = np.frombuffer(data, _STL_TRIANGLE, records, _STL_HEADER_BYTES)
    vertices = triangles["corners"].reshape(-1, 3).astype(np.float64)
    return vertices, RaggedLists(np.full(records, 3), np.arange(3 * records))


def _read_stl_text(path: AnyPath, data: bytes) -> tuple[np.ndarray, RaggedLists]:
    """Read vertices and faces of an STL file in text, of one or more solids.

    A loop of four corners and more is a polygon.
    """
    points = array("d")  # x, y and z of one after the other
    ends = array("q", [0])  # number of points up to the end of each loop
    keyword = b""
    for line, words in _split_lines(path, data):
        keyword = words[0]
        if keyword == b"vertex":
            points.extend(_read_point(path, line, words))
        elif keyword == b"endloop":
            ends.append(len(points) // 3)
    if keyword != b"endsolid" or ends[-1] != len(points) // 3:
        raise InputError(
            f"{path}: STL in text that ends by {keyword.decode('latin-1')[:20]!r}, not by "
            "'endsolid'; it is truncated. Export it again."
        )
    return np.array(points).reshape(-1, 3), RaggedLists(np.diff(ends), np.arange(ends[-1]))


def _read_obj(path: AnyPath) -> tuple[np.ndarray, RaggedLists]:
    """Read vertices and polygons of an OBJ file."""
    # Points and faces, line by line.
    points = array("d")  # x, y and z of one after the other
    sizes = array("q")  # corners of each face
    corners = array("q")
    has_curves = False
    highest = 0
    highest_line = 0  # of the highest index, for an error
    for line, words in _split_lines(path, read_bytes(path)):
        if words[0] == b"v":
            points.extend(_read_point(path, line, words))
        elif words[0] in (b"f", b"fo"):  # fo of old writers is the same
            count = len(points) // 3
            indices = _read_face(path, line, words, count)
            if max(indices) > highest:
                highest = max(indices)
                highest_line = line
            sizes.append(len(indices))
            # Indices begin with 1; negative ones count back from the points before the line.
            corners.extend(k - 1 if k > 0 else count + k for k in indices)
        has_curves |= words[0] in (b"surf", b"curv", b"curv2", b"l")

    # Do they make a surface?
    vertices = np.array(points).reshape(-1, 3)
    if has_curves and not sizes:
        raise InputError(
            f"{path}: holds free-form surfaces or lines alone, and no triangles. Export it again."
        )
    if highest > len(vertices):
        raise InputError(
            f"{path}: line {highest_line} names point {highest} of {len(vertices)}; it is damaged. "
            "Export it again."
        )
    return vertices, RaggedLists(np.array(sizes, np.int64), np.array(corners, np.int64))


def _read_face(path: AnyPath, line: int, words: list[bytes], count: int) -> list[int]:
    """Read the indices of a face's points from its line, before which ``count`` points stand."""
    indices: list[int] = []
    with suppress(ValueError):
        indices = [int(word.partition(b"/")[0]) for word in words[1:]]
    if not indices or 0 in indices or min(indices) < -count or max(indices) > _MOST_TEXT_BYTES:
        raise InputError(
            f"{path}: line {line}, {b' '.join(words)[:60].decode('latin-1')!r}: a face names "
            f"points from 1 on, or back from -1 to -{count}; export it again"
        )
    return indices


MESH_READERS: dict[str, Callable[[AnyPath], tuple[np.ndarray, np.ndarray | RaggedLists]]] = {
    ".ply": _read_ply,
    ".stl": _read_stl,
    ".obj": _read_obj,
    ".glb": read_glb,
}
"""Readers by suffix: of points (n, 3; float64) in the file's unit, and faces (f, n; int64)."""
