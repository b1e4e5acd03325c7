"""Camera files: JSON to :class:`Camera` or :class:`StereoRig`, and back."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera.model import Camera, StereoRig
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import AnyPath, read_json, write_json

_NEEDED = ("width", "height", "K")
_RIG = ("baseline_m", "cx_right_minus_left_px")
_KEYS = (*_NEEDED, *_RIG, "depth_unit_m")
_NORMALISED_FX = 2
_MM_FX_SHARE = 0.1
"""A focal length below a tenth of the width sees 157 degrees: no pinhole does."""
_FILE_BASELINE_M = 10
"""Millimetres of common rigs (50 to 120) pass as metres in a plane's rig, never in a file."""


def read_camera(path: AnyPath) -> Camera | StereoRig:
    """Read a camera from JSON; a :class:`StereoRig` where ``baseline_m`` is given.

    Keys: ``width``, ``height`` and ``K``; for a rig ``baseline_m`` and, where the principal points
    differ, ``cx_right_minus_left_px``; ``depth_unit_m`` where there is a depth image.

    Raises:
        InputError: the file is missing or damaged, a key is missing or unknown, or a value cannot
            be that of a camera in pixels and metres.
    """
    keys = _check_keys(path, read_json(path))
    try:
        camera = _camera_from_keys(keys)
        _check_pixels(camera)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return camera


def read_rig(path: AnyPath) -> StereoRig:
    """Read a stereo rig from JSON; see :func:`read_camera`.

    Raises:
        InputError: as there, or ``baseline_m`` is missing.
    """
    camera = read_camera(path)
    if isinstance(camera, StereoRig):
        return camera
    raise InputError(
        f"{path}: no 'baseline_m', without which disparity cannot become metres; add the distance "
        'between the two cameras in metres, such as "baseline_m": 0.54'
    )


def write_camera(path: AnyPath, camera: Camera) -> None:
    """Write a camera or rig as JSON, so that :func:`read_camera` returns the same.

    Raises:
        InputError: the disk refuses.
    """
    keys: dict[str, Any] = {"width": camera.width, "height": camera.height, "K": camera.K.tolist()}
    if isinstance(camera, StereoRig):
        keys["baseline_m"] = camera.baseline_m
        if camera.cx_right_minus_left_px:
            keys["cx_right_minus_left_px"] = camera.cx_right_minus_left_px
    if camera.depth_unit_m is not None:
        keys["depth_unit_m"] = camera.depth_unit_m
    write_json(path, keys)


def check_image_matches_camera(camera: Camera, width: int, height: int, name: str) -> None:
    """Refuse an image whose size is not the camera's.

    Raises:
        InputError: the sizes differ; where the aspect agrees, resizing is offered.
    """
    if (width, height) == (camera.width, camera.height):
        return
    # Scaled sizes are rounded to whole pixels, so the aspect agrees to within one.
    is_scaled = abs(width * camera.height - height * camera.width) <= max(
        camera.width, camera.height
    )
    remedy = (
        f"the aspect agrees: resize the image to {camera.width}x{camera.height}, or the camera "
        f"with resize_camera(camera, {width}, {height})"
        if is_scaled
        else "the aspect differs too: follow a crop with crop_camera, or give that image's camera"
    )
    raise InputError(
        f"{name} is {width}x{height} but its camera is {camera.width}x{camera.height}; {remedy}"
    )


def _check_keys(path: AnyPath, content: object) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise InputError(
            f"{path}: a camera is a JSON object with the keys {', '.join(_KEYS)}, "
            f"not a {type(content).__name__}"
        )
    for key in content:
        if key not in _KEYS:
            raise InputError(f"{path}: unknown key {key!r}; {nearest_name(key, _KEYS)}")
    missing = [key for key in _NEEDED if key not in content]
    if missing:
        raise InputError(f"{path}: missing {', '.join(map(repr, missing))}; add it to the camera")
    if "cx_right_minus_left_px" in content and "baseline_m" not in content:
        raise InputError(f"{path}: 'cx_right_minus_left_px' needs 'baseline_m' beside it; add it")
    return content


def _camera_from_keys(keys: dict[str, Any]) -> Camera:
    width, height = _whole(keys, "width"), _whole(keys, "height")
    matrix = _matrix(keys["K"])
    unit_m = _number(keys, "depth_unit_m") if "depth_unit_m" in keys else None
    if "baseline_m" not in keys:
        return Camera(width=width, height=height, K=matrix, depth_unit_m=unit_m)
    return StereoRig(
        width=width,
        height=height,
        K=matrix,
        depth_unit_m=unit_m,
        baseline_m=_number(keys, "baseline_m"),
        cx_right_minus_left_px=_number({"cx_right_minus_left_px": 0, **keys}, _RIG[1]),
    )


def _whole(keys: dict[str, Any], key: str) -> int:
    value = keys[key]
    if not isinstance(value, int) or isinstance(value, bool):
        raise InputError(f"{key!r} is {value!r}; give a whole number of pixels")
    return value


def _number(keys: dict[str, Any], key: str) -> float:
    value = keys[key]
    if not _is_number(value):
        raise InputError(f"{key!r} is {value!r}; give a number")
    return float(value)


def _matrix(value: object) -> Float[Tensor, "3 3"]:
    rows = value if isinstance(value, list) else []
    is_square = len(rows) == 3 and all(isinstance(row, list) and len(row) == 3 for row in rows)
    if not is_square or not all(_is_number(x) for row in rows for x in row):
        shown = repr(value)[:80]
        raise InputError(f"'K' is {shown}; write [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]")
    return torch.tensor(rows, dtype=torch.float64)


def _is_number(value: object) -> bool:
    # A whole number beyond 1e300 has no float.
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e300


def _check_pixels(camera: Camera) -> None:
    fx, cx, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (0, 2), (1, 2)))
    size = f"{camera.width}x{camera.height}"
    if fx <= _NORMALISED_FX < camera.width / 10:
        raise InputError(
            f"K has fx {fx:g} for {size} pixels, so it looks normalised; multiply its first row by "
            "the width and its second by the height"
        )
    if fx < _MM_FX_SHARE * camera.width:
        raise InputError(
            f"K has fx {fx:g} for {size} pixels, so it looks like millimetres; divide by the "
            "width of a pixel in mm"
        )
    if not (-0.5 <= cx <= camera.width - 0.5 and -0.5 <= cy <= camera.height - 0.5):
        raise InputError(
            f"the principal point ({cx:g}, {cy:g}) lies outside the image of {size}; do K and the "
            "size belong together?"
        )
    if isinstance(camera, StereoRig) and camera.baseline_m >= _FILE_BASELINE_M:
        raise InputError(
            f"baseline_m is {camera.baseline_m:g}, which looks like millimetres; divide by 1000 "
            "(a rig that is truly this wide is made in Python, as a StereoRig)"
        )
