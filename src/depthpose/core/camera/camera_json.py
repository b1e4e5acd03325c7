"""Cameras in JSON: our own, and those of BOP."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera.facts import CameraFacts, Size
from depthpose.core.camera.model import MAX_SIDE_PX
from depthpose.core.errors import InputError, nearest_name

_NEEDED = ("width", "height", "K")
_RIG = ("baseline_m", "cx_right_minus_left_px")
_KEYS = (*_NEEDED, *_RIG, "depth_unit_m")
_BOP = ("fx", "fy", "cx", "cy")
_MM = 0.001


def facts_from_json(content: object) -> CameraFacts:
    """Take the camera of a JSON file: ours, BOP's ``camera.json`` or its ``scene_camera.json``.

    Raises:
        InputError: it is none of them, or a value is wrong.
    """
    if isinstance(content, dict) and "K" not in content:
        if content.keys() >= set(_BOP):
            return _from_bop(content)
        if content and all(isinstance(v, dict) and "cam_K" in v for v in content.values()):
            return _from_scene(content)
    return _from_keys(_check_keys(content))


def _from_keys(keys: dict[str, Any]) -> CameraFacts:
    return CameraFacts(
        kind="a camera",
        K=_matrix(keys["K"]),
        size=_size(keys),
        baseline_m=_number(keys, "baseline_m") if "baseline_m" in keys else None,
        cx_right_minus_left_px=_number({_RIG[1]: 0, **keys}, _RIG[1]),
        depth_unit_m=_number(keys, "depth_unit_m") if "depth_unit_m" in keys else None,
    )


def _from_bop(keys: dict[str, Any]) -> CameraFacts:
    """BOP: ``fx``, ``fy``, ``cx``, ``cy``, ``width``, ``height``; ``depth_scale`` in mm a unit."""
    fx, fy, cx, cy = (_number(keys, key) for key in _BOP)
    return CameraFacts(
        kind="a camera of BOP",
        K=torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64),
        size=_size(keys) if {"width", "height"} <= keys.keys() else None,
        depth_unit_m=_bop_unit_m(keys),
    )


def _from_scene(images: dict[str, dict[str, Any]]) -> CameraFacts:
    entries = list(images.values())
    first = entries[0]
    if any(e["cam_K"] != first["cam_K"] or _bop_unit_m(e) != _bop_unit_m(first) for e in entries):
        raise InputError(
            f"a scene_camera.json of BOP whose {len(entries)} images have several cameras; write "
            "that of one image into a file, or open the data set by --bop"
        )
    flat = first["cam_K"]
    if not isinstance(flat, list) or len(flat) != 9:
        raise InputError(f"'cam_K' is {flat!r:.80}, where 9 numbers belong")
    return CameraFacts(
        kind="a scene_camera.json of BOP",
        K=_matrix([flat[0:3], flat[3:6], flat[6:9]]),
        depth_unit_m=_bop_unit_m(first),
    )


def _bop_unit_m(keys: dict[str, Any]) -> float | None:
    return _MM * _number(keys, "depth_scale") if "depth_scale" in keys else None


def _check_keys(content: object) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise InputError(
            f"a camera is a JSON object with the keys {', '.join(_KEYS)}, "
            f"not a {type(content).__name__}"
        )
    for key in content:
        if key not in _KEYS:
            raise InputError(f"unknown key {key!r}; {nearest_name(key, _KEYS)}")
    missing = [key for key in _NEEDED if key not in content]
    if missing:
        raise InputError(f"missing {', '.join(map(repr, missing))}; add it to the camera")
    if "cx_right_minus_left_px" in content and "baseline_m" not in content:
        raise InputError("'cx_right_minus_left_px' needs 'baseline_m' beside it; add it")
    return content


def _size(keys: dict[str, Any]) -> Size:
    return _whole(keys, "width"), _whole(keys, "height")


def _whole(keys: dict[str, Any], key: str) -> int:
    value = keys[key]
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) > MAX_SIDE_PX:
        raise InputError(f"{key!r} is {repr(value)[:80]}; give a whole number of pixels")
    return value


def _number(keys: dict[str, Any], key: str) -> float:
    value = keys[key]
    if not _is_number(value):
        raise InputError(f"{key!r} is {repr(value)[:80]}; give a number")
    return float(value)


def _matrix(value: object) -> Float[Tensor, "3 3"]:
    rows = value if isinstance(value, list) else []
    is_square = len(rows) == 3 and all(isinstance(row, list) and len(row) == 3 for row in rows)
    if not is_square or not all(_is_number(x) for row in rows for x in row):
        shown = repr(value)[:80]
        raise InputError(f"'K' is {shown}; write [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]")
    return torch.tensor([[float(x) for x in row] for row in rows], dtype=torch.float64)


def _is_number(value: object) -> bool:
    # A whole number beyond 1e300 has no float.
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e300
