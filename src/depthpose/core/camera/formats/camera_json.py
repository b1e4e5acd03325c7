"""Cameras in JSON: depthpose's own, and those of BOP, Open3D, ROS, OpenCV and RealSense."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera.formats.camera_fields import (
    Fields,
    facts_from_fields,
    find_distortion,
    find_number,
    is_ros,
    normalise_keys,
    read_baseline_m,
    with_fisheye,
)
from depthpose.core.camera.formats.facts import KNOWN_FILES, OPTIONAL_KEYS, CameraFacts
from depthpose.core.camera.lens import is_fisheye_lens
from depthpose.core.camera.pinhole import MAX_SIDE_PX, Size, intrinsics
from depthpose.core.errors import InputError, suggest_name

DOFFS_KEY = "cx_right_minus_left_px"
"""Key of the difference between the principal points of a pair, Middlebury's ``doffs``."""
_LARGEST_NUMBER = 1e300  # largest number of JSON: larger whole numbers have no float
_NEEDED = ("width", "height", "K")
_KEYS = (*_NEEDED, "baseline_m", DOFFS_KEY, *OPTIONAL_KEYS)
"""Keys of depthpose's own format."""
_BOP_KEYS = ("fx", "fy", "cx", "cy")


def facts_from_json(content: object) -> CameraFacts:
    """Read the camera of a JSON value: in depthpose's own format, or in that of another system.

    Raises:
        InputError: it is in no known format, or a key is unknown, missing or of another type.
    """
    if not isinstance(content, dict) or not content.keys() <= set(_KEYS):
        facts = _read_foreign_json(content)
        if facts is not None:
            return facts

    # In depthpose's own format mistakes are named.
    assert isinstance(content, dict)
    if not content.keys() & set(_KEYS):
        keys = ", ".join(map(repr, content))
        raise InputError(f"no camera that is known; its keys are {keys:.80}. Known: {KNOWN_FILES}")
    for key in content:
        if key not in _KEYS:
            raise InputError(f"unknown key {key!r}; {suggest_name(key, _KEYS)}")
    missing = [key for key in _NEEDED if key not in content]
    if missing:
        raise InputError(f"missing {', '.join(map(repr, missing))}; add it to the camera")
    if "cx_right_minus_left_px" in content and "baseline_m" not in content:
        raise InputError("'cx_right_minus_left_px' needs 'baseline_m' beside it; add it")

    optional_keys = ("baseline_m", DOFFS_KEY, *OPTIONAL_KEYS)
    values: dict[str, Any] = {
        key: _read_json_number(content, key) for key in optional_keys if key in content
    }
    size = read_size(content)
    return CameraFacts(
        kind="a camera", K=_read_matrix(content["K"]), size=size, is_metric=True, **values
    )


def _read_foreign_json(content: object) -> CameraFacts | None:
    """Read the JSON of another system: a bare matrix, ROS, OpenCV, RealSense, Open3D or BOP.

    None where it is of none of these.
    """
    if isinstance(content, list) and len(content) in (3, 9):  # rows, or flat
        return CameraFacts(kind="a matrix", K=_read_matrix(content))
    if not isinstance(content, dict):
        raise InputError(
            f"a camera is a JSON object with the keys {', '.join(_KEYS)}, "
            f"not a {type(content).__name__}"
        )

    fields = normalise_keys(content)
    facts = None
    is_fisheye = bool(is_fisheye_lens(fields))
    # Matrices of OpenCV are objects with ``data``; ``ppx`` is RealSense's cx.
    is_opencv = any(isinstance(value, dict) and "data" in value for value in content.values())
    if is_opencv or is_ros(fields) or {"ppx", "cameramatrix"} & fields.keys():
        facts = with_json_keys(facts_from_fields(fields), fields)

    # A key of depthpose's own: the caller names what is wrong with the others.
    if facts is not None or "K" in content:
        return facts
    open3d_intrinsic = content.get("intrinsic", content)
    if "cam_K" in content:
        facts = _facts_from_scene_camera({"0": content})
    elif isinstance(open3d_intrinsic, dict) and "intrinsic_matrix" in open3d_intrinsic:
        facts = _facts_from_open3d(open3d_intrinsic)
    elif content.keys() >= set(_BOP_KEYS):
        fx, fy, cx, cy = (_read_json_number(content, key) for key in _BOP_KEYS)
        facts = CameraFacts(
            kind="a camera of BOP",
            K=intrinsics(fx, fy, cx, cy),
            size=read_size(content) if {"width", "height"} <= content.keys() else None,
            baseline_m=read_baseline_m(fields),
            depth_unit_m=_read_bop_unit_m(content),
            distortion=find_distortion(fields),
        )
    elif content and all(
        isinstance(image, dict) and "cam_K" in image for image in content.values()
    ):
        facts = _facts_from_scene_camera(content)

    return None if facts is None else with_fisheye(facts, is_fisheye=is_fisheye)


def _facts_from_open3d(keys: dict[str, Any]) -> CameraFacts:
    """Read Open3D's ``PinholeCameraIntrinsic``, whose flat matrix is stored column by column."""
    K = _read_matrix(keys["intrinsic_matrix"])
    is_by_columns = isinstance(keys["intrinsic_matrix"][0], int | float)
    if is_by_columns:
        K = K.T.contiguous()
    size = read_size(keys) if {"width", "height"} <= keys.keys() else None
    return CameraFacts(kind="a camera of Open3D", K=K, size=size)


def _facts_from_scene_camera(images: dict[str, dict[str, Any]]) -> CameraFacts:
    """Read the camera of BOP's scene_camera.json, which must be the same for all images."""
    entries = list(images.values())
    first = entries[0]
    for entry in entries:
        has_same_K = entry["cam_K"] == first["cam_K"]
        if not has_same_K or _read_bop_unit_m(entry) != _read_bop_unit_m(first):
            raise InputError(
                f"a scene_camera.json of BOP whose {len(entries)} images have several cameras; "
                "write that of one image into a file, or open the dataset by --bop"
            )
    flat = first["cam_K"]
    if not isinstance(flat, list) or len(flat) != 9:
        raise InputError(f"'cam_K' is {flat!r:.80}, where 9 numbers belong")
    return CameraFacts(
        kind="a scene_camera.json of BOP",
        K=_read_matrix(flat),
        depth_unit_m=_read_bop_unit_m(first),
    )


def _read_bop_unit_m(keys: dict[str, Any]) -> float | None:
    """Read the unit of depth images from a camera of BOP [m]; None where it has none."""
    if "depth_scale" in keys:
        return 0.001 * _read_json_number(keys, "depth_scale")  # millimetres a unit
    return _read_json_number(keys, "depth_unit_m") if "depth_unit_m" in keys else None


def read_size(keys: dict[str, Any]) -> Size:
    """Read ``width`` and ``height`` [px], which must be whole numbers."""
    what = "a whole number of pixels"
    for key in ("width", "height"):
        value = _read_json_number(keys, key, what)
        if value != int(value) or abs(value) > MAX_SIDE_PX:
            raise InputError(f"{key!r} is {repr(keys[key])[:80]}; give {what}")
    return int(keys["width"]), int(keys["height"])


def _read_json_number(keys: dict[str, Any], key: str, what: str = "a number") -> float:
    """Read a number of a JSON file; ``what`` says in the error what belongs there."""
    value = keys[key]
    is_number = type(value) in (int, float)  # a bool is none
    if not is_number or not abs(value) < _LARGEST_NUMBER:
        raise InputError(f"{key!r} is {repr(value)[:80]}; give {what}")
    return float(value)


def _read_matrix(value: object) -> Float[Tensor, "3 3"]:
    """Read a 3x3 matrix of 9 numbers, nested or flat, row by row."""
    try:
        return torch.from_numpy(np.array(value, dtype=np.float64).reshape(3, 3))
    except (TypeError, ValueError, OverflowError) as error:
        shown = repr(value)[:80]
        raise InputError(
            f"'K' is {shown}; write [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"
        ) from error


def with_json_keys(facts: CameraFacts | None, fields: Fields) -> CameraFacts | None:
    """Add the values that a file of ROS or OpenCV has under keys of depthpose's own JSON.

    Values that ``facts`` has already stay as they are. None stays None.
    """
    if facts is None:
        return None
    added: dict[str, float] = {}
    for key in ("baseline_m", DOFFS_KEY, *OPTIONAL_KEYS):
        field = key.replace("_", "")
        value = fields.get(field)
        # Of the difference of cx ``facts`` has 0 where it has none: the key always counts.
        is_set = key != DOFFS_KEY and getattr(facts, key) is not None
        if value is None or is_set:
            continue
        number = find_number(fields, field)
        if number is None:
            raise InputError(f"{key} is {value!r}; write a number")
        added[key] = number
    return replace(facts, **added, is_metric=facts.is_metric or "baseline_m" in added)
