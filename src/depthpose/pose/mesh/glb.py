"""Binary glTF (GLB): vertices and faces by trimesh, once the JSON at its head is checked."""

import json
import struct
from io import BytesIO
from typing import Any

import numpy as np

from depthpose.core.errors import InputError
from depthpose.core.files import AnyPath, read_bytes
from depthpose.core.files.disk import refused_as

_LARGEST_NUMBER = 1e9  # of a transform: no model has a larger one, in whatever unit
_MOST_SCENE_BYTES = 2**22  # of the JSON that describes the scene
_MOST_NODES = 10_000
_MOST_VALUES = 2 * 10**7  # that the accessors may declare: six million points
_MOST_PLACING_COST = 6e7  # some ten seconds of trimesh
_TRIANGLE_FAN = 6  # mode of a primitive
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
"""Numbers of an element of an accessor."""
_READ_EXTENSIONS = (
    "KHR_materials", "KHR_texture", "KHR_lights", "KHR_xmp", "EXT_texture", "KHR_mesh_quant",
)  # fmt: skip
"""Beginnings of the names of extensions that change no surface, or that trimesh reads."""


def read_glb(path: AnyPath) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (n, 3) and faces (m, 3) of a GLB: of all nodes, where the scene places them.

    Raises:
        InputError: the file is missing or damaged, or holds what is not read, or too much.
    """
    data = read_bytes(path)
    _refuse_unread_scene(path, data)
    with refused_as(path, "model", "export it again"):
        import trimesh

        loaded: Any = trimesh.load(
            BytesIO(data), "glb", process=False, skip_materials=True, allow_remote=False
        )
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_mesh()
        faces = np.asarray(getattr(loaded, "faces", np.empty((0, 3))), np.int64).reshape(-1, 3)
        return np.asarray(loaded.vertices, np.float64).reshape(-1, 3), faces


def _refuse_unread_scene(path: AnyPath, data: bytes) -> None:
    """Refuse a GLB whose JSON declares what is not read, before its numbers are read.

    That are too many numbers (an accessor without bytes stands for as many zeros as it declares),
    numbers in another file, and features of glTF that change the surface.
    """
    if not data.startswith(b"glTF"):
        raise InputError(f"{path}: begins by {data[:12]!r}, not by 'glTF'; export it as binary GLB")
    with refused_as(path, "GLB", "export it again"):
        # A header of 12 bytes, the length and the type of the JSON of 4 bytes each, the JSON.
        (size,) = struct.unpack("<I", data[12:16])
        if size > _MOST_SCENE_BYTES:
            raise InputError(f"{path}: {size} bytes of JSON in a GLB; export the part alone")

        # What the scene declares.
        scene: Any = json.loads(data[20 : 20 + size])
        nodes = scene.get("nodes", [])
        values = _count_values(scene)
        _refuse_wild_transforms(path, nodes)
        depths = _measure_node_depths(path, nodes)
        unread = _list_unread_features(scene)
        links = [str(buffer.get("uri") or "data:") for buffer in scene.get("buffers", [])]
        outside = [link for link in links if not link.startswith("data:")]

    # Can all of it be read?
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

    # Can it be read in seconds? To place a node takes trimesh about the cube of its depth.
    if sum(float(depth) ** 3 for depth in depths) > _MOST_PLACING_COST:
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
    """Count the numbers of a glTF scene: of its accessors, or of the points that nodes place.

    The larger count is returned: several nodes may place the points of one accessor.
    """
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
    """List the features of a glTF scene that change its surface and are not read, by name."""
    # Extensions, and ways to make triangles.
    unread = [
        name
        for name in scene.get("extensionsRequired", [])
        if not name.startswith(_READ_EXTENSIONS)
    ]
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


def _refuse_wild_transforms(path: AnyPath, nodes: list[dict[str, Any]]) -> None:
    """Refuse nodes whose transforms hold NaN, or numbers too large for any model."""
    for number, node in enumerate(nodes):
        for name in ("matrix", "translation", "rotation", "scale"):
            sizes = [abs(float(value)) for value in node.get(name, [])]
            wild = [size for size in sizes if not size < _LARGEST_NUMBER]  # NaN too
            if wild:
                raise InputError(
                    f"{path}: the {name} of node {number} holds {wild[0]:g}, which is no "
                    "place or size of a model; export it again"
                )


def _measure_node_depths(path: AnyPath, nodes: list[dict[str, Any]]) -> list[int]:
    """Measure the depths of all nodes in their trees, 1 of a root.

    Nodes that make no trees are refused: readers place them differently, or lose their meshes.
    """
    # One parent at most.
    parents: dict[int, int] = {}
    for number, node in enumerate(nodes):
        for child in node.get("children", []):
            if parents.setdefault(child, number) != number:
                raise InputError(
                    f"{path}: node {child} hangs under nodes {parents[child]} and {number}; of a "
                    "tree each has one parent. Export it again."
                )

    # From the roots on; a circle of nodes has no root.
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
    return list(depths.values())
