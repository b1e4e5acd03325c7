"""Entries of BOP's JSON to numbers, poses and cameras; everything wrong is said with its place."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from depthpose.core.camera.pinhole import check_intrinsics
from depthpose.core.errors import InputError
from depthpose.core.files import read_json
from depthpose.core.rigid import Rigid

_ROTATION_SLACK = 1e-2
"""Published annotations are rounded; LineMOD's rotations are off by up to a few thousandths."""


MOST = 10**9
"""Of scenes, images and objects: their numbers name files."""


def entry_number(key: object) -> int | None:
    """Take the number that names a scene, an image or an object; None where it is none."""
    text = str(key)
    return int(text) if len(text) <= 9 and text.isascii() and text.isdecimal() else None


def read_mapping(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        InputError: it cannot be read, or holds something else.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds a {type(content).__name__}, where names to values belong")
    return content


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read a JSON file that holds a list of objects.

    Raises:
        InputError: it cannot be read, or holds something else.
    """
    content = read_json(path)
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise InputError(f"{path}: is no list of objects, one an entry")
    return content


def numbers(entry: object, key: str, count: int, source: str) -> list[float]:
    """Take ``count`` finite numbers.

    Raises:
        InputError: there are others, or none.
    """
    found = entry.get(key) if isinstance(entry, Mapping) else None
    if not isinstance(found, list) or len(found) != count or not all(map(_is_number, found)):
        raise InputError(f"{source}: {key} is {_short(found)}, where {count} numbers belong")
    return [float(value) for value in found]


def integer(entry: object, key: str, source: str) -> int:
    """Take a whole number of 0 or more.

    Raises:
        InputError: it is something else, or missing.
    """
    found = entry.get(key) if isinstance(entry, Mapping) else None
    if not isinstance(found, int) or isinstance(found, bool) or not 0 <= found <= MOST:
        raise InputError(
            f"{source}: {key} is {_short(found)}, where a number from 0 to {MOST} belongs"
        )
    return found


def number(entry: object, key: str, default: float | None, source: str) -> float:
    """Take a finite number; ``default`` where it is missing and there is one.

    Raises:
        InputError: it is something else.
    """
    found = entry.get(key, default) if isinstance(entry, Mapping) else None
    if not _is_number(found):
        raise InputError(f"{source}: {key} is {_short(found)}, where a number belongs")
    assert isinstance(found, int | float)
    return float(found)


def pose_from_bop(entry: object, source: str) -> Rigid:
    """Read ``cam_R_m2c`` (row by row) and ``cam_t_m2c`` (mm).

    Raises:
        InputError: the rotation is none, or a number is missing.
    """
    return make_pose(
        numbers(entry, "cam_R_m2c", 9, source), numbers(entry, "cam_t_m2c", 3, source), source
    )


def make_pose(R: list[float], t_mm: list[float], source: str) -> Rigid:
    """Make a pose of nine numbers row by row and three in mm, its rotation made exact.

    Raises:
        InputError: the nine numbers are far from a rotation.
    """
    rough = torch.tensor(R, dtype=torch.float64).reshape(3, 3)
    u, sizes, vh = torch.linalg.svd(rough)
    if float((sizes - 1).abs().max()) > _ROTATION_SLACK or float(torch.linalg.det(rough)) < 0:
        raise InputError(
            f"{source}: the rotation {_short(R)} is none: its determinant is "
            f"{float(torch.linalg.det(rough)):.3f}, its stretches {_short(sizes.tolist())}. Write "
            "a rotation, row by row"
        )
    return Rigid(u @ vh, torch.tensor(t_mm, dtype=torch.float64) * 0.001)


def camera_from_bop(entry: object, source: str) -> tuple[Float64[Tensor, "3 3"], float]:
    """Read ``cam_K`` and ``depth_scale`` (mm a unit) as K and metres a unit.

    Raises:
        InputError: K is none, or the scale not positive.
    """
    K = torch.tensor(numbers(entry, "cam_K", 9, source), dtype=torch.float64).reshape(3, 3)
    try:
        check_intrinsics(K)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    scale_mm = number(entry, "depth_scale", 1.0, source)
    if scale_mm <= 0:
        raise InputError(f"{source}: depth_scale is {scale_mm:g}; it is millimetres a unit")
    return K, 0.001 * scale_mm


def _is_number(value: object) -> bool:
    # A whole number beyond 1e300 has no float.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
