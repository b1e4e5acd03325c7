"""What a model file declares or may grow to, looked at before it is read in full."""

import json
import struct
from collections.abc import Mapping
from typing import Any

from depthpose.core.errors import InputError
from depthpose.core.files import AnyPath
from depthpose.core.files.disk import refused_as

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
    """Tell text as trimesh does: an STL is binary where its length is that of its triangles."""
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
