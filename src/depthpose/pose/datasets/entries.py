"""Entries of JSON and YAML files of datasets: their numbers, poses and cameras, checked."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeGuard

import torch
from jaxtyping import Float64
from torch import Tensor

from depthpose.core.camera.pinhole import check_intrinsics
from depthpose.core.errors import InputError
from depthpose.core.files import read_json, read_text
from depthpose.core.files.disk import parse_yaml, refuse_heavy_text
from depthpose.core.rigid import Rigid

_ROTATION_SLACK = 1e-2  # published ones are rounded; LineMOD's are off by a few thousandths
_LARGEST_NUMBER = 1e300  # a whole number beyond it has no float
_LONGEST_SHOWN = 80  # characters of what a file holds, in a message
_YAML_BYTES = {b"[": 750, b"{": 750, b",": 450, b":": 500, b"\n": 500, b"- ": 500}
"""Bytes that a value after each of these takes while it is read, measured with PyYAML 6."""

LARGEST_ID = 10**9  #: of scenes, images and objects: their numbers name files


def parse_entry_number(key: object) -> int | None:
    """Parse the number by which a scene, image or object is named; None where it is no number."""
    text = str(key)
    return int(text) if len(text) <= 9 and text.isascii() and text.isdecimal() else None


def read_mapping(path: Path) -> dict[Any, Any]:
    """Read a JSON or YAML file that holds values by name.

    Raises:
        InputError: it is missing, damaged, too large or holds something else.
    """
    if path.suffix == ".json":
        content = read_json(path)
    else:
        text = read_text(path)
        refuse_heavy_text(path, text.encode(), _YAML_BYTES)
        content = parse_yaml(path, text)
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds a {type(content).__name__}, where names to values belong")
    return content


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read a JSON file that holds a list of objects, one an entry.

    Raises:
        InputError: it is missing, damaged or holds something else.
    """
    return check_rows(read_json(path), str(path))


def check_rows(content: object, source: str) -> list[dict[str, Any]]:
    """Check that content of a file is a list of objects; ``source`` names it in errors.

    Returns:
        The content.

    Raises:
        InputError: it is something else.
    """
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise InputError(f"{source}: is no list of objects, one an entry")
    return content


def read_numbers(entry: object, key: str, count: int, source: str) -> list[float]:
    """Read a list of finite numbers from an entry.

    Args:
        entry: of a file, a mapping.
        key: of the list in it.
        count: how many numbers belong there.
        source: of the entry, in errors.

    Raises:
        InputError: there is no such list.
    """
    values = entry.get(key) if isinstance(entry, Mapping) else None
    if not isinstance(values, list) or len(values) != count or not all(map(_is_finite, values)):
        raise InputError(f"{source}: {key} is {_shorten(values)}, where {count} numbers belong")
    return [float(value) for value in values]


def read_integer(entry: object, key: str, source: str) -> int:
    """Read a whole number from 0 to ``LARGEST_ID`` from an entry.

    Args:
        entry: of a file, a mapping.
        key: of the number in it.
        source: of the entry, in errors.

    Raises:
        InputError: there is no such number.
    """
    value = entry.get(key) if isinstance(entry, Mapping) else None
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= LARGEST_ID:
        raise InputError(
            f"{source}: {key} is {_shorten(value)}, where a number from 0 to {LARGEST_ID} belongs"
        )
    return value


def read_number(entry: object, key: str, default: float | None, source: str) -> float:
    """Read a finite number from an entry.

    Args:
        entry: of a file, a mapping.
        key: of the number in it.
        default: is returned where the key is missing; None: it must be there.
        source: of the entry, in errors.

    Raises:
        InputError: there is no such number.
    """
    value = entry.get(key, default) if isinstance(entry, Mapping) else None
    if not _is_finite(value):
        raise InputError(f"{source}: {key} is {_shorten(value)}, where a number belongs")
    return float(value)


def _is_finite(value: Any) -> TypeGuard[float]:  # noqa: ANN401  JSON
    """Whether a value of JSON is a number that is finite as a float; true and false are none."""
    return type(value) in (int, float) and abs(value) < _LARGEST_NUMBER


def make_pose(R: list[float], t_mm: list[float], source: str) -> Rigid:
    """Make a pose of the numbers that a file holds.

    The rotation is replaced by the nearest exact one, for published numbers are rounded.

    Args:
        R: nine numbers of the rotation matrix, row by row.
        t_mm: three of the translation.
        source: of the numbers, in errors.

    Raises:
        InputError: the matrix is no rotation, and is not one that was rounded.
    """
    rough = torch.tensor(R, dtype=torch.float64).reshape(3, 3)
    u, sizes, vh = torch.linalg.svd(rough)
    determinant = float(torch.linalg.det(rough))
    if float((sizes - 1).abs().max()) > _ROTATION_SLACK or determinant < 0:
        raise InputError(
            f"{source}: the rotation {_shorten(R)} is none: its determinant is "
            f"{determinant:.3f}, its stretches {_shorten(sizes.tolist())}. "
            "Write a rotation, row by row"
        )
    return Rigid(u @ vh, torch.tensor(t_mm, dtype=torch.float64) * 0.001)


def read_bop_camera(entry: object, source: str) -> tuple[Float64[Tensor, "3 3"], float]:
    """Read ``cam_K`` and ``depth_scale`` (mm a unit) of an entry of BOP's cameras.

    Returns:
        The intrinsic matrix, and metres in a unit of the depth image.

    Raises:
        InputError: there is no such matrix, or the scale is none.
    """
    K = torch.tensor(read_numbers(entry, "cam_K", 9, source), dtype=torch.float64).reshape(3, 3)
    try:
        check_intrinsics(K)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    scale_mm = read_number(entry, "depth_scale", 1.0, source)
    if scale_mm <= 0:
        raise InputError(f"{source}: depth_scale is {scale_mm:g}; it is millimetres a unit")
    return K, 0.001 * scale_mm


def _shorten(value: object) -> str:
    """Shorten what a file holds, for a message."""
    text = repr(value)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN - 3]}..."
