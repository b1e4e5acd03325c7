"""Model files to points and triangles: PLY, STL, OBJ and GLB; polygons are cut.

What a file declares, or may grow to, is checked before it is read in full.
"""

import json
import math
import struct
from array import array
from codecs import BOM_UTF8
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from depthpose.core.errors import InputError
from depthpose.core.files import CLOUD_READERS, AnyPath, read_bytes, read_cloud
from depthpose.core.files.disk import make_suffix_error, refused_as
from depthpose.core.files.points import RaggedLists, read_ply_elements
from depthpose.core.units import Unit
from depthpose.pose.mesh.bodies import mark_part
from depthpose.pose.mesh.shapes import shape_geometry, shape_unit

_MOST_VALUES = 2 * 10**7  # that the accessors of a GLB may declare: six million points
_MOST_TEXT = 2**25  # bytes of an OBJ or STL in text, which are read in some seconds
_NO_FACES = RaggedLists(np.empty(0, np.int64), np.empty(0, np.int64))
_MOST_NODES = 10_000  # of a GLB's scene
_MOST_SCENE_BYTES = 2**22  # of the JSON that describes it
_MOST_NESTED = 6e7  # sum of the cubes of the depths of a GLB's nodes: some ten seconds of trimesh
_TRIANGLE_FAN = 6  # mode of a primitive of glTF
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
"""Numbers of an element of an accessor of glTF."""
_KNOWN = ("KHR_materials", "KHR_texture", "KHR_lights", "KHR_xmp", "EXT_texture", "KHR_mesh_quant")
"""Beginnings of the names of glTF extensions that change no surface, or that trimesh reads."""
_NO_AREA = 1e-12  # of the square of the extent: a face of no more is a line or a point
_LEAST_AREA = 1e-6  # of the squared extent: faces of less in all are no surface; a wire has 0.003
_FARTHEST = 1e9  # no model has a larger coordinate, in whatever unit; it overflows in float32


AnyModel = AnyPath | object  #: a model file, or a mesh of trimesh or Open3D
FIXED_UNITS: dict[str, Unit] = {".glb": "m"}  #: of formats that fix theirs


def unit_of(path: AnyModel, unit: Unit | None) -> Unit:
    """Give the unit of a model: the one given, else that of its format or of the mesh itself.

    Raises:
        InputError: there is none.
    """
    if isinstance(path, str | Path):
        declared = unit or FIXED_UNITS.get(Path(path).suffix.lower())
    else:
        declared = unit or shape_unit(path)
    if declared is None:
        raise InputError(
            f"{path}: no unit is given, and such a file does not say its own; give --unit mm, "
            "where depth or a cloud is given too --cad-unit mm, or unit: mm in a config"
        )
    return declared


def read_geometry(path: AnyModel) -> tuple[np.ndarray, np.ndarray]:
    """Read points and triangles of a model in its own unit; bare points have no triangles.

    Raises:
        InputError: the file is missing, damaged or of another format, has no surface, or bodies far
            from each other.

    Warns:
        Notice: a small body far from the rest is left out.
    """
    # By the reader of its suffix; bare points need nothing more.
    if not isinstance(path, str | Path):
        vertices, faces = shape_geometry(path)
    else:
        suffix = Path(path).suffix.lower()
        if suffix not in MESH_READERS:
            if suffix not in CLOUD_READERS:
                suffixes = dict.fromkeys((*MESH_READERS, *CLOUD_READERS))
                raise make_suffix_error(path, "model", tuple(suffixes))
            return read_cloud(path).points.double().numpy(), np.empty((0, 3), np.int64)
        vertices, faces = MESH_READERS[suffix](path)
    if len(vertices) < 4 or not (np.abs(vertices) < _FARTHEST).all():
        raise InputError(
            f"{path}: holds {len(vertices)} points, or one that is not finite or beyond "
            f"{_FARTHEST:g}; a model needs 4 and more. Export it again."
        )

    # Polygons become triangles, of which those of the part stay.
    triangles = _convert_to_triangles(str(path), vertices, faces)
    if len(triangles) == 0:
        return vertices, triangles
    return _clean_surface(str(path), vertices, triangles)


def _convert_to_triangles(
    path: AnyPath, vertices: np.ndarray, faces: np.ndarray | RaggedLists
) -> np.ndarray:
    """Convert faces to triangles (m, 3): as they are, or polygons cut."""
    if isinstance(faces, np.ndarray):
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

    Of faces on the same three points the first stays: a face and its reverse would cancel in the
    normals. Holes are no flaw.

    Returns:
        Vertices and faces. Where no body is dropped, the vertices are all those given, unused ones
        too; else they are those of the remaining faces alone, numbered anew.

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
    _, first = np.unique(np.sort(merged, axis=-1), axis=0, return_index=True)
    is_kept = np.isin(np.arange(len(faces)), first) & (area > _NO_AREA * extent_squared)
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

    # The list of a face has one of several names: vertex_indices, vertex_index, ...
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
    """Split text into lines; yield the number and the words of each, without comments.

    The first word is in lower case. A backslash at the end of a line joins it with the next.
    """
    if len(data) > _MOST_TEXT:
        raise InputError(
            f"{path}: {len(data)} bytes of text, more than the {_MOST_TEXT} that are read; save it "
            "as binary PLY or STL"
        )
    joined = bytearray()  # of lines so far; it grows in place, as bytes do not
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
    """Read triangles; as text if the file says so and its length is not that of its triangles."""
    # What the header declares, and what follows it.
    data = read_bytes(path)
    (count,) = struct.unpack("<I", data[80:84]) if len(data) >= 84 else (0,)
    records, spare_bytes = divmod(len(data) - 84, 50)
    head = data[: 2**16].removeprefix(BOM_UTF8).lstrip().lower()
    is_text = head.startswith(b"solid") and b"facet" in head and b"\0" not in head
    if is_text and (records, spare_bytes) != (count, 0):
        return _read_stl_text(path, data)

    # Writers that stream leave the count at 0; a byte or two after the last record do no harm.
    if records < 1 or (records != count and (count or spare_bytes)):
        raise InputError(
            f"{path}: declares {count} triangles, and {max(0, len(data) - 84)} bytes follow, those "
            f"of {max(0, records)}; it is truncated or no STL. Export it again."
        )
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", 9), ("attribute", "<u2")])
    corners = np.frombuffer(data, record, records, 84)["corners"].reshape(-1, 3)
    return corners.astype(np.float64), RaggedLists(np.full(records, 3), np.arange(3 * records))


def _read_stl_text(path: AnyPath, data: bytes) -> tuple[np.ndarray, RaggedLists]:
    """Read the facets of one or more solids; a loop of four corners and more is a polygon."""
    points = array("d")
    ends = array("q", [0])  # of loops, in points
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
    points = array("d")
    sizes = array("q")
    corners = array("q")
    has_curves = False
    highest = 0
    highest_line = 0
    # Points and faces, line by line.
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
    """Read the indices of a face's points, of which ``count`` stand before its line."""
    indices: list[int] = []
    with suppress(ValueError):
        indices = [int(word.partition(b"/")[0]) for word in words[1:]]
    if not indices or 0 in indices or min(indices) < -count or max(indices) > _MOST_TEXT:
        raise InputError(
            f"{path}: line {line}, {b' '.join(words)[:60].decode('latin-1')!r}: a face names "
            f"points from 1 on, or back from -1 to -{count}; export it again"
        )
    return indices


def _read_glb(path: AnyPath) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (n, 3) and faces (m, 3) of a binary GLB, all its nodes placed."""
    data = read_bytes(path)
    _refuse_scene(path, data)
    with refused_as(path, "model", "export it again"):
        import trimesh

        loaded: Any = trimesh.load(
            BytesIO(data), "glb", process=False, skip_materials=True, allow_remote=False
        )
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_mesh()
        faces = np.asarray(getattr(loaded, "faces", np.empty((0, 3))), np.int64).reshape(-1, 3)
        return np.asarray(loaded.vertices, np.float64).reshape(-1, 3), faces


def _refuse_scene(path: AnyPath, data: bytes) -> None:
    """Refuse a GLB by the JSON at its head, before its numbers are read.

    It may declare more numbers than are read, since an accessor without bytes stands for as many
    zeros as it declares; numbers in another file; or features of glTF that are not read.
    """
    if not data.startswith(b"glTF"):
        raise InputError(f"{path}: begins by {data[:12]!r}, not by 'glTF'; export it as binary GLB")
    with refused_as(path, "GLB", "export it again"):
        (size,) = struct.unpack("<I", data[12:16])
        if size > _MOST_SCENE_BYTES:
            raise InputError(f"{path}: {size} bytes of JSON in a GLB; export the part alone")

        # What the scene declares.
        scene: Any = json.loads(data[20 : 20 + size])
        nodes = scene.get("nodes", [])
        values = _count_values(scene)
        work = _refuse_nodes(path, nodes)
        unread = _list_unread_features(scene)
        links = [str(buffer.get("uri") or "data:") for buffer in scene.get("buffers", [])]
        outside = [link for link in links if not link.startswith("data:")]

    # Is it all read, and in seconds?
    if outside:
        raise InputError(
            f"{path}: its numbers are in another file, {outside[0][:60]!r}, and a GLB is read "
            "alone; export it as one file, with its buffers inside"
        )
    if unread:
        raise InputError(
            f"{path}: needs {unread[0][:60]!r}, which is not read; export it as plain triangles, "
            "uncompressed"
        )
    if work > _MOST_NESTED:
        raise InputError(
            f"{path}: its {len(nodes)} nodes hang too deep in each other to be read in seconds; "
            "export the part alone, its transforms applied"
        )
    if values > _MOST_VALUES or len(nodes) > _MOST_NODES:
        raise InputError(
            f"{path}: declares {values} numbers in {len(nodes)} nodes, more than {_MOST_VALUES} "
            f"and {_MOST_NODES}; export the part alone"
        )


def _count_values(scene: Any) -> int:  # noqa: ANN401  JSON
    """Count the numbers of a glTF scene: of its accessors, or of the points that nodes place."""
    # The numbers of each accessor, and those of the points of every node.
    accessors = scene.get("accessors", [])
    values = [abs(int(entry["count"])) * _WIDTHS[entry["type"]] for entry in accessors]
    placed = 0
    for node in scene.get("nodes", []):
        if "mesh" not in node:
            continue
        for primitive in scene["meshes"][node["mesh"]]["primitives"]:
            if "POSITION" in primitive.get("attributes", {}):
                placed += values[primitive["attributes"]["POSITION"]]
    return max(sum(values), placed)


def _list_unread_features(scene: Any) -> list[str]:  # noqa: ANN401  JSON
    """Name the features of a glTF scene that change its surface, and are not read."""
    # Extensions and ways to make triangles.
    unread = [n for n in scene.get("extensionsRequired", []) if not n.startswith(_KNOWN)]
    accessors = scene.get("accessors", [])
    meshes = scene.get("meshes", [])
    primitives = [primitive for mesh in meshes for primitive in mesh["primitives"]]
    unread += ["TRIANGLE_FAN" for p in primitives if p.get("mode") == _TRIANGLE_FAN]

    # Accessors of points and of faces, by index.
    positions = [p["attributes"]["POSITION"] for p in primitives if "POSITION" in p["attributes"]]
    indices = [p["indices"] for p in primitives if "indices" in p]
    unread += ["normalized positions" for k in positions if accessors[k].get("normalized")]
    unread += ["sparse accessors" for k in (*positions, *indices) if accessors[k].get("sparse")]

    # What moves the points of a mesh.
    mesh_nodes = [node for node in scene.get("nodes", []) if "mesh" in node]
    unread += ["a skin" for node in mesh_nodes if "skin" in node]
    unread += ["morph targets" for entry in (*meshes, *mesh_nodes) if any(entry.get("weights", []))]
    return unread


def _refuse_nodes(path: AnyPath, nodes: list[dict[str, Any]]) -> float:
    """Refuse nodes that make no trees or have impossible transforms; give the cost of placing all.

    Readers place such nodes differently, or lose their meshes. The cost is that of trimesh's
    products of matrices: the sum of the cubes of the nodes' depths.
    """
    # One parent at most, and numbers that a sensor's world has.
    parents: dict[int, int] = {}
    for number, node in enumerate(nodes):
        for child in node.get("children", []):
            if parents.setdefault(child, number) != number:
                raise InputError(
                    f"{path}: node {child} hangs under nodes {parents[child]} and {number}; of a "
                    "tree each has one parent. Export it again."
                )
        for name in ("matrix", "translation", "rotation", "scale"):
            numbers = [abs(float(value)) for value in node.get(name, [])]
            wild = [value for value in numbers if not value < _FARTHEST]  # NaN too
            if wild:
                raise InputError(
                    f"{path}: the {name} of node {number} holds {wild[0]:g}, which moves nothing "
                    "to where a sensor sees it; export it again"
                )

    # The depth of each node, from the roots on; a circle of nodes has no root.
    depths: dict[int, int] = {}
    open_nodes = [(number, 1) for number in range(len(nodes)) if number not in parents]
    while open_nodes:
        number, depth = open_nodes.pop()
        depths[number] = depth
        open_nodes += [(child, depth + 1) for child in nodes[number].get("children", [])]
    if len(depths) < len(nodes):
        lost = next(number for number in range(len(nodes)) if number not in depths)
        raise InputError(
            f"{path}: node {lost} hangs under itself, in a circle of nodes; export it again"
        )
    return sum(float(depth) ** 3 for depth in depths.values())


MESH_READERS: dict[str, Callable[[AnyPath], tuple[np.ndarray, np.ndarray | RaggedLists]]] = {
    ".ply": _read_ply,
    ".stl": _read_stl,
    ".obj": _read_obj,
    ".glb": _read_glb,
}
"""Readers by suffix: of points (n, 3; float64) in the file's unit, and faces (f, n; int64)."""


_MOST_CORNERS = 5_000  # of one polygon
_MOST_CLIPPED = 2e8
"""Steps that clip all polygons that are not convex, some ten seconds: each takes about its corners
times 1,000 plus its reflex corners."""
_MOST_TOGETHER = 2**20  # corners of polygons that are cut at a time
_MOST_ROUNDS = 3  # about a polygon in search of ears; one that needs more crosses itself
_FLAT = 1e-9  # of the square of a polygon's extent: an area that is smaller is none
_OVERLAP = 1e-3  # of all area: share that polygons which cross themselves may cover twice


def cut_polygons(
    path: AnyPath, vertices: np.ndarray, sizes: np.ndarray, corners: np.ndarray
) -> np.ndarray:
    """Cut simple polygons without holes into triangles of the same corners, in their order.

    A polygon that is not planar is cut as it looks along its normal (Newell's).

    Args:
        path: of the file, for errors.
        vertices: points (n, 3).
        sizes: number of corners of each polygon.
        corners: indices of their points, one polygon after the other.

    Raises:
        InputError: an index is out of range, a polygon has too many corners or crosses itself.
    """
    # Do all corners exist, and has each polygon a number of them that can be cut?
    starts = np.cumsum(sizes) - sizes
    is_wrong = (corners < 0) | (corners >= len(vertices))
    if is_wrong.any():
        first = int(is_wrong.argmax())
        face = int(np.searchsorted(starts, first, "right")) - 1
        raise InputError(
            f"{path}: face {face} names point {corners[first]}, but the {len(vertices)} points are "
            f"numbered 0 .. {len(vertices) - 1}; the file is damaged. Export it again."
        )
    is_wrong = ((sizes > 0) & (sizes < 3)) | (sizes > _MOST_CORNERS)
    if is_wrong.any():
        face = int(is_wrong.argmax())
        raise InputError(
            f"{path}: face {face} has {sizes[face]} corners, and 3 to "
            f"{_MOST_CORNERS} are read; the file is truncated, or export it as triangles"
        )

    # Polygons of equally many corners together.
    pieces = [np.empty((0, 3), np.int64)]
    owners = [np.empty(0, np.int64)]  # polygon of each triangle
    overlap = np.zeros(len(sizes))  # area of each polygon that its triangles cover twice
    area = 0.0
    steps = 0.0
    for group in _group_by_size(sizes):
        size = int(sizes[group[0]])
        polygons = corners[starts[group, None] + np.arange(size)]
        normals, is_reflex = _find_reflex(vertices[polygons])
        reflex = is_reflex.sum(1)
        steps += float((size * (1000.0 + reflex[reflex > 0])).sum())
        if steps > _MOST_CLIPPED:
            raise InputError(
                f"{path}: its polygons that are not convex have too many corners to be cut in some "
                f"seconds (one of {size} among them); export it as triangles"
            )

        # Cut, as indices of the polygon's corners, then of the points.
        local = _cut_equal_polygons(vertices[polygons], normals, is_reflex)
        triangles = np.take_along_axis(polygons[:, None], local, 2)
        pieces.append(triangles.reshape(-1, 3))
        owners.append(group.repeat(size - 2))
        if size > 3:
            areas, covered_twice = _measure_overlap(vertices[triangles], normals)
            overlap[group] = covered_twice
            area += float(areas.sum())
    if overlap.sum() > _OVERLAP * area:
        raise InputError(
            f"{path}: face {overlap.argmax()} crosses itself (its corners are not in the order of "
            "its border), so its surface is unknown; export it as triangles"
        )
    return np.concatenate(pieces)[np.argsort(np.concatenate(owners), kind="stable")]


def _measure_overlap(corners: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measure the area of polygons' triangles, and how much of it covers their polygon twice.

    Both are doubled, as the length of a normal is the doubled area of its polygon. A polygon
    without area, whose normal is 0, counts whole.

    Args:
        corners: of the triangles of each polygon (m, t, 3, 3).
        normals: of the polygons (m, 3).
    """
    sides = corners[..., 1:, :] - corners[..., :1, :]
    doubled = np.cross(sides[..., 0, :], sides[..., 1, :])
    length = np.linalg.norm(normals, axis=-1)
    along = np.abs(np.einsum("mtc,mc->mt", doubled, normals)).sum(-1)
    area = np.linalg.norm(doubled, axis=-1).sum(-1)
    projected = np.divide(along, length, where=length > _FLAT * area, out=area.copy())
    return area, projected - length


def _group_by_size(sizes: np.ndarray) -> Iterator[np.ndarray]:
    """Group polygons of equally many corners, as their indices; no group exceeds the memory."""
    order = np.argsort(sizes, kind="stable")
    for same_size in np.split(order, np.flatnonzero(np.diff(sizes[order])) + 1):
        size = int(sizes[same_size[0]]) if len(same_size) else 0
        if size < 3:
            continue
        step = max(1, _MOST_TOGETHER // size)
        for start in range(0, len(same_size), step):
            yield same_size[start : start + step]


def _find_reflex(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the normals (m, 3) of polygons (m, n, 3), and which corners are reflex (m, n)."""
    points = points - points[:, :1]
    after = np.roll(points, -1, 1)
    before = np.roll(points, 1, 1)
    normals = np.cross(points, after).sum(1)
    turns = np.einsum("mnc,mc->mn", np.cross(points - before, after - points), normals)
    return normals, turns < -_FLAT * (normals**2).sum(-1, keepdims=True)


def _cut_equal_polygons(
    points: np.ndarray, normals: np.ndarray, is_reflex: np.ndarray
) -> np.ndarray:
    """Cut polygons (m, n, 3) into triangles; give the corners of each, as indices (m, n - 2, 3).

    Convex polygons are cut as fans, others by ear clipping.
    """
    # As fans.
    count = points.shape[1]
    points = points - points[:, :1]
    steps = np.arange(count - 2)
    fan = np.stack([0 * steps, steps + 1, steps + 2], -1)
    local = np.repeat(fan[None], len(points), 0)

    # By ears, where a corner is reflex.
    for k in np.flatnonzero(is_reflex.any(1)):
        # Projected along its normal, which then points at the viewer.
        across = np.cross(normals[k], np.eye(3)[np.abs(normals[k]).argmin()])
        basis = np.stack([across, np.cross(normals[k], across)], -1)
        flat = points[k] @ (basis / np.linalg.norm(basis, axis=0).clip(1e-300))
        local[k] = _clip_ears(flat, is_reflex[k])
    return local


def _clip_ears(points: np.ndarray, is_reflex: np.ndarray) -> list[list[int]]:
    """Cut off ears: corners whose triangles hold no other corner.

    A triangle that holds any corner holds a reflex one, so that only these are tested. A cut
    changes its two neighbours alone, which are then examined again.

    Args:
        points: corners of the polygon (n, 2), in order.
        is_reflex: which of them are reflex (n,); changed.

    Returns:
        Corners of the triangles, as indices.
    """
    # The corners beside each one that are left, and the corners that are to be examined.
    count = len(points)
    ears: list[list[int]] = []
    before = [count - 1, *range(count - 1)]
    after = [*range(1, count), 0]
    least = _FLAT * float(np.ptp(points, axis=0).max()) ** 2
    is_left = [True] * count
    is_waiting = [True] * count
    waiting = deque([*range(1, count), 0])
    # Each corner is examined once a round. A cut may straighten a reflex corner, and makes none: a
    # flag that is out of date costs a test alone.
    rounds = 0
    is_cut = False  # whether an ear was cut in this round
    must_cut = False
    while len(ears) < count - 3:
        if not waiting:
            # No ear is left: the polygon crosses itself, or touches itself. All corners are
            # examined once more, and if none is an ear then, any one is cut.
            waiting.extend(k for k in range(count) if is_left[k])
            for k in waiting:
                is_waiting[k] = True
            must_cut = not is_cut
            is_cut = False
            rounds = rounds + 1

        # Is the next one an ear?
        k = waiting.popleft()
        is_waiting[k] = False
        if not is_left[k]:
            continue
        ear = [before[k], k, after[k]]
        if not (must_cut or rounds > _MOST_ROUNDS or _is_ear(points, ear, is_reflex, least)):
            continue

        # Then it is cut off, and its neighbours become those of each other.
        ears.append(ear)
        is_left[k] = False
        is_reflex[k] = False
        is_cut = True
        must_cut = False
        after[ear[0]] = ear[2]
        before[ear[2]] = ear[0]
        # The corner after the ear comes first: so ears do not fan out from one corner as needles.
        for beside in (ear[2], ear[0]):
            if not is_waiting[beside]:
                waiting.append(beside)
                is_waiting[beside] = True
    return [*ears, [k for k in range(count) if is_left[k]]]


def _is_ear(points: np.ndarray, corners: list[int], is_reflex: np.ndarray, least: float) -> bool:
    """Whether the triangle of three successive corners lies in the polygon, and holds no other one.

    ``least`` is twice the area below which the middle corner is straight, and an ear.
    """
    # A straight corner is cut off with no area; a reflex one is no ear.
    ear = points[corners]
    sides = np.roll(ear, -1, 0) - ear
    turn = sides[0, 0] * sides[1, 1] - sides[0, 1] * sides[1, 0]
    if abs(turn) <= least:
        return True
    if turn < 0:
        return False

    # Another corner lies within if it is on the inner side of all three sides.
    offsets = points[is_reflex] - ear[:, None]  # from each corner of the ear to each other corner
    is_within = (sides[:, :1] * offsets[..., 1] >= sides[:, 1:] * offsets[..., 0]).all(0)
    is_within &= offsets.any(-1).all(0)  # one at the place of a corner of the ear does no harm
    return not is_within.any()
