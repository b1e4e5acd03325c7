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
from depthpose.core.files.disk import refused_as, refused_suffix
from depthpose.core.files.points import Ragged, read_ply_elements
from depthpose.core.units import Unit
from depthpose.pose.mesh.bodies import faces_of_part
from depthpose.pose.mesh.shapes import shape_geometry, shape_unit

_MOST_VALUES = 2 * 10**7  # that the accessors of a GLB may declare: six million points
_MOST_TEXT = 2**25  # bytes of an OBJ or STL in text, which are read in some seconds
_NO_FACES = Ragged(np.empty(0, np.int64), np.empty(0, np.int64))
_MOST_NODES = 10_000  # of a GLB's scene
_MOST_SCENE_BYTES = 2**22  # of the JSON that describes it
_MOST_NESTED = 6e7  # sum of the cubes of the depths of a GLB's nodes: some ten seconds of trimesh
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_KNOWN = ("KHR_materials", "KHR_texture", "KHR_lights", "KHR_xmp", "EXT_texture", "KHR_mesh_quant")
"""How extensions of glTF begin that change no surface, or that trimesh reads."""
_NO_AREA = 1e-12  # of the square of the extent: a face of no more is a line or a point
_LEAST_AREA = 1e-6  # of the squared extent: all faces of less are no surface; a wire has 0.003
_FARTHEST = 1e9  # a coordinate beyond is no model's, in whatever unit, and overflows in float32


AnyModel = AnyPath | object  #: a model file, or a mesh of trimesh or Open3D
FIXED_UNITS: dict[str, Unit] = {".glb": "m"}  #: of formats that fix theirs


def unit_of(path: AnyModel, unit: Unit | None) -> Unit:
    """Give the unit of a model: what is said, else what its format fixes, or the mesh itself says.

    Raises:
        InputError: neither.
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
    if not isinstance(path, str | Path):
        vertices, faces = shape_geometry(path)
    else:
        suffix = Path(path).suffix.lower()
        if suffix not in MESH_READERS:
            if suffix not in CLOUD_READERS:
                suffixes = dict.fromkeys((*MESH_READERS, *CLOUD_READERS))
                raise refused_suffix(path, "model", tuple(suffixes))
            return read_cloud(path).points.double().numpy(), np.empty((0, 3), np.int64)
        vertices, faces = MESH_READERS[suffix](path)
    if len(vertices) < 4 or not (np.abs(vertices) < _FARTHEST).all():
        raise InputError(
            f"{path}: holds {len(vertices)} points, or one that is not finite or beyond "
            f"{_FARTHEST:g}; a model needs 4 and more. Export it again."
        )
    if isinstance(faces, np.ndarray):
        faces = Ragged(np.full(len(faces), faces.shape[1]), faces.reshape(-1))
    sizes = faces.sizes
    corners = faces.values.astype(np.int64)
    if (sizes == 3).all() and ((corners >= 0) & (corners < len(vertices))).all():
        faces = corners.reshape(-1, 3)
    else:
        faces = cut_polygons(str(path), vertices, sizes, corners)
    if len(faces) == 0:
        return vertices, faces
    # Dropped are faces without area, and all but the first of those on the same three points: a
    # face and its reverse would cancel in the normals. Holes are no flaw.
    sides = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1) / 2
    square = float(np.ptp(vertices, axis=0).max()) ** 2
    if area.sum() <= _LEAST_AREA * square:
        raise InputError(
            f"{path}: its {len(faces)} faces have no area, so there is no surface to see; all are "
            "lines or points. Export it again as triangles, or as points without faces."
        )
    # By place, not by number: STL repeats the points of every face.
    places, place = np.unique(vertices, axis=0, return_inverse=True)
    merged = place.reshape(-1)[faces]
    _, first = np.unique(np.sort(merged, axis=-1), axis=0, return_index=True)
    kept = np.isin(np.arange(len(faces)), first) & (area > _NO_AREA * square)
    faces = faces[kept]
    merged = merged[kept]
    area = area[kept]
    is_part = faces_of_part(str(path), places, merged, area)
    if is_part.all():
        return vertices, faces
    used, faces = np.unique(faces[is_part], return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _read_ply(path: AnyPath) -> tuple[np.ndarray, Ragged]:
    """Read vertices and faces; the list of a face has one of several names."""
    columns, lists = read_ply_elements(path)
    if not columns.keys() >= set("xyz"):
        raise InputError(f"{path}: no x, y and z among {list(columns)}. Export it again.")
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN, and refused as such
        vertices = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], -1)
    faces = [name for name in lists if name.split()[0] in ("face", "tristrips")]
    indices = [name for name in faces if name.startswith("face ") and "ind" in name]
    named = [name for name in indices if "vert" in name] or indices
    values = lists[named[0]].values if len(named) == 1 else np.array([math.nan])
    if faces and not ((np.abs(values) < _FARTHEST).all() and (values % 1 == 0).all()):
        raise InputError(
            f"{path}: the lists of its faces are {faces}, where one 'face vertex_indices' of whole "
            "numbers is needed. Export it again."
        )
    return vertices, lists[named[0]] if named else _NO_FACES


def _rows_of(path: AnyPath, data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Give the words of each line and its number: the first in lower case, without comments."""
    if len(data) > _MOST_TEXT:
        raise InputError(
            f"{path}: {len(data)} bytes of text, more than the {_MOST_TEXT} that are read; save it "
            "as binary PLY or STL"
        )
    before = bytearray()  # which grows in place, as bytes do not
    text = data.removeprefix(BOM_UTF8).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    # A backslash joins lines; behind one that ends the file comes an empty line.
    for number, line in enumerate(BytesIO(text + b"\n\n"), 1):
        if line.endswith(b"\\\n"):
            before += line[:-2]
            continue
        words = bytes(before + line).partition(b"#")[0].split()
        before.clear()
        if words:
            yield number, [words[0].lower(), *words[1:]]


def _place(path: AnyPath, line: int, words: list[bytes]) -> list[float]:
    """Take x, y and z of a line; what follows them is a weight or a colour."""
    with suppress(ValueError):
        place = [float(word) for word in words[1:4]]
        if len(place) == 3:
            return place
    raise InputError(
        f"{path}: line {line}, {b' '.join(words)[:60].decode('latin-1')!r}, does not give x, y and "
        "z with decimal points; export it again"
    )


def _read_stl(path: AnyPath) -> tuple[np.ndarray, Ragged]:
    """Read triangles; text if it says so and its length is not that of its triangles."""
    data = read_bytes(path)
    (count,) = struct.unpack("<I", data[80:84]) if len(data) >= 84 else (0,)
    there, more = divmod(len(data) - 84, 50)
    head = data[: 2**16].removeprefix(BOM_UTF8).lstrip().lower()
    is_text = head.startswith(b"solid") and b"facet" in head and b"\0" not in head
    if is_text and (there, more) != (count, 0):
        # Facets of one or more solids; a loop of four corners and more is a polygon.
        places = array("d")
        ends = array("q", [0])
        last = b""
        for number, words in _rows_of(path, data):
            last = words[0]
            if last == b"vertex":
                places.extend(_place(path, number, words))
            elif last == b"endloop":
                ends.append(len(places) // 3)
        if last != b"endsolid" or ends[-1] != len(places) // 3:
            raise InputError(
                f"{path}: STL in text that ends by {last.decode('latin-1')[:20]!r}, not by "
                "'endsolid'; it is truncated. Export it again."
            )
        return np.array(places).reshape(-1, 3), Ragged(np.diff(ends), np.arange(ends[-1]))
    # Writers that stream leave the count at 0; a byte or two behind the last one do no harm.
    if there < 1 or (there != count and (count or more)):
        raise InputError(
            f"{path}: declares {count} triangles, and {max(0, len(data) - 84)} bytes follow, those "
            f"of {max(0, there)}; it is truncated or no STL. Export it again."
        )
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", 9), ("attribute", "<u2")])
    corners = np.frombuffer(data, record, there, 84)["corners"].reshape(-1, 3)
    return corners.astype(np.float64), Ragged(np.full(there, 3), np.arange(3 * there))


def _read_obj(path: AnyPath) -> tuple[np.ndarray, Ragged]:
    """Read vertices and polygons; negative numbers count back from the line they stand in."""
    places = array("d")
    sizes = array("q")
    corners = array("q")
    is_other = False
    highest = 0
    highest_line = 0
    for number, words in _rows_of(path, read_bytes(path)):
        if words[0] == b"v":
            places.extend(_place(path, number, words))
        elif words[0] in (b"f", b"fo"):  # fo of old writers is the same
            there = len(places) // 3
            named = [0]
            with suppress(ValueError):
                named = [int(word.partition(b"/")[0]) for word in words[1:]] or [0]
            if 0 in named or min(named) < -there or max(named) > _MOST_TEXT:
                raise InputError(
                    f"{path}: line {number}, {b' '.join(words)[:60].decode('latin-1')!r}: a face "
                    f"names points from 1 on, or back from -1 to -{there}; export it again"
                )
            if max(named) > highest:
                highest = max(named)
                highest_line = number
            sizes.append(len(named))
            corners.extend(k - 1 if k > 0 else there + k for k in named)
        is_other |= words[0] in (b"surf", b"curv", b"curv2", b"l")
    vertices = np.array(places).reshape(-1, 3)
    if highest > len(vertices) or (is_other and not sizes):
        problem = f"line {highest_line} names point {highest} of {len(vertices)}; it is damaged"
        problem = problem if sizes else "holds free-form surfaces or lines alone, and no triangles"
        raise InputError(f"{path}: {problem}. Export it again.")
    return vertices, Ragged(np.array(sizes, np.int64), np.array(corners, np.int64))


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
    """Refuse a GLB by the JSON at its head: accessors without bytes hold as many zeros as said."""
    if not data.startswith(b"glTF"):
        raise InputError(f"{path}: begins by {data[:12]!r}, not by 'glTF'; export it as binary GLB")
    with refused_as(path, "GLB", "export it again"):
        (size,) = struct.unpack("<I", data[12:16])
        if size > _MOST_SCENE_BYTES:
            raise InputError(f"{path}: {size} bytes of JSON in a GLB; export the part alone")
        scene: Any = json.loads(data[20 : 20 + size])
        accessors = scene.get("accessors", [])
        values = [abs(int(entry["count"])) * _WIDTHS[entry["type"]] for entry in accessors]
        placed = sum(
            values[part["attributes"]["POSITION"]]
            for node in scene.get("nodes", [])
            if "mesh" in node
            for part in scene["meshes"][node["mesh"]]["primitives"]
            if "POSITION" in part.get("attributes", {})
        )
        nodes = len(scene.get("nodes", []))
        work = _refuse_nodes(path, scene.get("nodes", []))
        needed = [n for n in scene.get("extensionsRequired", []) if not n.startswith(_KNOWN)]
        parts = [part for mesh in scene.get("meshes", []) for part in mesh["primitives"]]
        needed += ["TRIANGLE_FAN" for part in parts if part.get("mode") == 6]
        places = [p["attributes"]["POSITION"] for p in parts if "POSITION" in p["attributes"]]
        needed += ["normalized positions" for k in places if accessors[k].get("normalized")]
        read = [*places, *(part["indices"] for part in parts if "indices" in part)]
        needed += ["sparse accessors" for k in read if accessors[k].get("sparse")]
        meshes = [node for node in scene.get("nodes", []) if "mesh" in node]
        needed += ["a skin" for node in meshes if "skin" in node]
        weights = [entry.get("weights", []) for entry in (*scene.get("meshes", []), *meshes)]
        needed += ["morph targets" for entry_weights in weights if any(entry_weights)]
        links = [str(buffer.get("uri") or "data:") for buffer in scene.get("buffers", [])]
        outside = [link for link in links if not link.startswith("data:")]
    if outside:
        raise InputError(
            f"{path}: its numbers are in another file, {outside[0][:60]!r}, and a GLB is read "
            "alone; export it as one file, with its buffers inside"
        )
    if needed:
        raise InputError(
            f"{path}: needs {needed[0][:60]!r}, which is not read; export it as plain triangles, "
            "uncompressed"
        )
    if work > _MOST_NESTED:
        raise InputError(
            f"{path}: its {nodes} nodes hang too deep in each other to be read in seconds; export "
            "the part alone, its transforms applied"
        )
    if max(sum(values), placed) > _MOST_VALUES or nodes > _MOST_NODES:
        raise InputError(
            f"{path}: declares {max(sum(values), placed)} numbers in {nodes} nodes, more than "
            f"{_MOST_VALUES} and {_MOST_NODES}; export the part alone"
        )


def _refuse_nodes(path: AnyPath, nodes: list[dict[str, Any]]) -> float:
    """Refuse nodes that are no trees, or whose numbers no transform has; give what they cost.

    Readers differ in what they make of them: a mesh would be lost, or placed anywhere. The cost is
    that of trimesh's products of matrices, the sum of the cubes of the nodes' depths.
    """
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
    depths: dict[int, int] = {}
    left = [(number, 1) for number in range(len(nodes)) if number not in parents]
    while left:
        number, depth = left.pop()
        depths[number] = depth
        left += [(child, depth + 1) for child in nodes[number].get("children", [])]
    if len(depths) < len(nodes):
        lost = next(number for number in range(len(nodes)) if number not in depths)
        raise InputError(
            f"{path}: node {lost} hangs under itself, in a circle of nodes; export it again"
        )
    return sum(float(depth) ** 3 for depth in depths.values())


MESH_READERS: dict[str, Callable[[AnyPath], tuple[np.ndarray, np.ndarray | Ragged]]] = {
    ".ply": _read_ply,
    ".stl": _read_stl,
    ".obj": _read_obj,
    ".glb": _read_glb,
}
"""Suffix to reader of points (n, 3; float64) in the file's unit, and faces (f, corners; int64)."""


_MOST_CORNERS = 5_000  # of one polygon
_MOST_CLIPPED = 2e8
"""Of polygons that are not convex, the sum of corners times 1,000 and the corners that turn back:
each is clipped in about so many steps, together some ten seconds."""
_MOST_TOGETHER = 2**20  # corners of polygons that are cut at a time
_MOST_ROUNDS = 3  # about a polygon in search of ears; one that needs more crosses itself
_FLAT = 1e-9  # of the square of a polygon's area: a corner that turns back by less is straight
_OVERLAP = 1e-3  # of all area: polygons that cross themselves may lay so much of it twice


def cut_polygons(
    path: AnyPath, vertices: np.ndarray, sizes: np.ndarray, corners: np.ndarray
) -> np.ndarray:
    """Cut simple polygons without holes into triangles of the same corners, in their order.

    A polygon that is not planar is cut as it looks along the normal of its area (Newell's).
    """
    starts = np.cumsum(sizes) - sizes
    wrong = (corners < 0) | (corners >= len(vertices))
    if wrong.any():
        at = int(wrong.argmax())
        face = int(np.searchsorted(starts, at, "right")) - 1
        raise InputError(
            f"{path}: face {face} names point {corners[at]}, but the {len(vertices)} points are "
            f"numbered 0 .. {len(vertices) - 1}; the file is damaged. Export it again."
        )
    wrong = ((sizes > 0) & (sizes < 3)) | (sizes > _MOST_CORNERS)
    if wrong.any():
        raise InputError(
            f"{path}: face {wrong.argmax()} has {sizes[wrong.argmax()]} corners, and 3 to "
            f"{_MOST_CORNERS} are read; the file is truncated, or export it as triangles"
        )
    pieces = [np.empty((0, 3), np.int64)]
    owners = [np.empty(0, np.int64)]
    overlap = np.zeros(len(sizes))
    area = 0.0
    steps = 0.0
    order = np.argsort(sizes, kind="stable")
    for which in _alike(sizes, order):
        size = int(sizes[which[0]])
        polygons = corners[starts[which, None] + np.arange(size)]
        normals, is_back = _back_turns(vertices[polygons])
        backs = is_back.sum(1)
        steps += float((size * (1000.0 + backs[backs > 0])).sum())
        if steps > _MOST_CLIPPED:
            raise InputError(
                f"{path}: its polygons that are not convex have too many corners to be cut in some "
                f"seconds (one of {size} among them); export it as triangles"
            )
        local = _cut(vertices[polygons], normals, is_back)
        triangles = np.take_along_axis(polygons[:, None], local, 2)
        pieces.append(triangles.reshape(-1, 3))
        owners.append(which.repeat(size - 2))
        if size > 3:
            sides = vertices[triangles[..., 1:]] - vertices[triangles[..., :1]]
            doubled = np.cross(sides[..., 0, :], sides[..., 1, :])
            length = np.linalg.norm(normals, axis=-1)
            along = np.abs(np.einsum("mtc,mc->mt", doubled, normals)).sum(-1)
            each = np.linalg.norm(doubled, axis=-1).sum(-1)
            seen = np.divide(along, length, where=length > _FLAT * each, out=each.copy())
            overlap[which] = seen - length
            area += float(each.sum())
    if overlap.sum() > _OVERLAP * area:
        raise InputError(
            f"{path}: face {overlap.argmax()} crosses itself (its corners are not in the order of "
            "its border), so its surface is unknown; export it as triangles"
        )
    return np.concatenate(pieces)[np.argsort(np.concatenate(owners), kind="stable")]


def _alike(sizes: np.ndarray, order: np.ndarray) -> Iterator[np.ndarray]:
    """Give the numbers of polygons of equally many corners, so many that they fit in memory."""
    for alike in np.split(order, np.flatnonzero(np.diff(sizes[order])) + 1):
        size = int(sizes[alike[0]]) if len(alike) else 0
        step = max(1, _MOST_TOGETHER // max(size, 1))
        for start in range(0, len(alike) if size > 2 else 0, step):
            yield alike[start : start + step]


def _back_turns(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give the normals (m, 3) of polygons (m, n, 3), and which corners turn back (m, n)."""
    points = points - points[:, :1]
    after = np.roll(points, -1, 1)
    before = np.roll(points, 1, 1)
    normals = np.cross(points, after).sum(1)
    turns = np.einsum("mnc,mc->mn", np.cross(points - before, after - points), normals)
    return normals, turns < -_FLAT * (normals**2).sum(-1, keepdims=True)


def _cut(points: np.ndarray, normals: np.ndarray, is_back: np.ndarray) -> np.ndarray:
    """Cut polygons (m, n, 3) of equally many corners; give their corners (m, n - 2, 3)."""
    count = points.shape[1]
    points = points - points[:, :1]
    steps = np.arange(count - 2)
    fan = np.stack([0 * steps, steps + 1, steps + 2], -1)
    local = np.repeat(fan[None], len(points), 0)
    for k in np.flatnonzero(is_back.any(1)):
        # Projected along its normal, which then points at the viewer.
        across = np.cross(normals[k], np.eye(3)[np.abs(normals[k]).argmin()])
        basis = np.stack([across, np.cross(normals[k], across)], -1)
        flat = points[k] @ (basis / np.linalg.norm(basis, axis=0).clip(1e-300))
        local[k] = _clip_ears(flat, is_back[k])
    return local


def _clip_ears(points: np.ndarray, is_back: np.ndarray) -> list[list[int]]:
    """Cut off a corner whose triangle holds no other, again and again; points (n, 2), in order.

    If a triangle holds any, then one of the corners that turn back. A cut changes what its two
    neighbours are, so that these alone are looked at again: three corners for each that is cut.
    """
    count = len(points)
    ears = list[list[int]]()
    rounds = 0
    before = [*range(-1, count - 1)]
    after = [*range(1, count), 0]
    before[0] = count - 1
    least = _FLAT * float(np.ptp(points, axis=0).max()) ** 2
    is_left = [True] * count
    is_waiting = [True] * count
    waiting = deque([*range(1, count), 0])
    is_cut = False
    must_cut = False
    while len(ears) < count - 3:
        if not waiting:
            # No ear is left: the polygon crosses itself, or touches itself. All are looked at once
            # more, and if there is none then, any corner is cut.
            waiting.extend(k for k in range(count) if is_left[k])
            for k in waiting:
                is_waiting[k] = True
            must_cut = not is_cut
            is_cut = False
            rounds = rounds + 1
        k = waiting.popleft()
        is_waiting[k] = False
        if not is_left[k]:
            continue
        ear = [before[k], k, after[k]]
        if not (must_cut or rounds > _MOST_ROUNDS or _is_ear(points, ear, is_back, least)):
            continue
        ears.append(ear)
        is_left[k] = False
        is_back[k] = False
        is_cut = True
        must_cut = False
        after[ear[0]], before[ear[2]] = ear[2], ear[0]
        # The corner before comes later: a fan of needles is cut where it can be avoided.
        for beside in (ear[2], ear[0]):
            if not is_waiting[beside]:
                waiting.append(beside)
                is_waiting[beside] = True
    return [*ears, [k for k in range(count) if is_left[k]]]


def _is_ear(points: np.ndarray, corners: list[int], is_back: np.ndarray, least: float) -> bool:
    """Whether the triangle of three corners in a row lies within, and holds no other corner."""
    ear = points[corners]
    sides = np.roll(ear, -1, 0) - ear
    turn = sides[0, 0] * sides[1, 1] - sides[0, 1] * sides[1, 0]
    is_flat = abs(turn) <= least
    if is_flat:  # a straight corner is cut off with no area
        return True
    if turn < 0:
        return False
    # Another corner lies within if it is on the inner side of all three sides.
    offsets = points[is_back] - ear[:, None]  # from each corner of the ear to each other corner
    is_within = (sides[:, :1] * offsets[..., 1] >= sides[:, 1:] * offsets[..., 0]).all(0)
    is_within &= offsets.any(-1).all(0)  # one at the place of a corner of the ear does no harm
    return not is_within.any()
