"""Camera files of any known format to :class:`Camera` or :class:`StereoRig`; ours is written.

What a caller has in place of a file, a matrix, a mapping or a focal length, becomes a camera too.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera.camera_text import facts_from_json, facts_from_text
from depthpose.core.camera.facts import (
    KNOWN_FILES,
    OPTIONAL_KEYS,
    CameraFacts,
    Size,
    camera_from_facts,
    camera_keys,
)
from depthpose.core.camera.pinhole import Camera, StereoRig, check_intrinsics
from depthpose.core.camera.storage import Names, named, read_storage, scalar
from depthpose.core.camera.stored_camera import facts_from_names, is_ros, read_folder
from depthpose.core.errors import InputError
from depthpose.core.files import AnyPath, read_json, read_text, write_json
from depthpose.core.files.text import MAX_LIST_BYTES

_DOFFS = "cx_right_minus_left_px"


def read_camera(path: AnyPath, size: Size | None = None) -> Camera | StereoRig:
    """Read a camera; a :class:`StereoRig` where the file has a baseline.

    The format is recognised by the content: our JSON, BOP, KITTI, Middlebury, TUM, ROS, OpenCV,
    ORB-SLAM (``docs/conventions.md``). A folder may hold the two files of a pair.

    Args:
        path: the file, or the folder of a pair's two files.
        size: width and height of the image, for formats that do not say it.

    Raises:
        InputError: the file is missing or damaged, of no known format, of a lens with distortion,
            without a size where none is given, or a value cannot be that of a camera in pixels
            and metres.
    """
    try:
        return camera_from_facts(_read_facts(path), size)
    except InputError as error:
        said = str(error)
        raise InputError(said if said.startswith(f"{path}") else f"{path}: {said}") from error


def read_rig(path: AnyPath, size: Size | None = None) -> StereoRig:
    """Read a stereo rig; see :func:`read_camera`.

    Raises:
        InputError: as there, or the file has no baseline.
    """
    camera = read_camera(path, size)
    if isinstance(camera, StereoRig):
        return camera
    raise InputError(
        f"{path}: no 'baseline_m', without which disparity cannot become metres; add the distance "
        'between the two cameras in metres, such as "baseline_m": 0.12 (of ROS or OpenCV, name '
        "the folder that holds both files of the pair)"
    )


def write_camera(path: AnyPath, camera: Camera) -> None:
    """Write a camera or rig as JSON, so that :func:`read_camera` returns the same.

    Raises:
        InputError: the disk refuses.
    """
    write_json(path, camera_keys(camera))


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


def _read_facts(path: AnyPath) -> CameraFacts:
    if Path(path).is_dir():
        return read_folder(Path(path))
    if Path(path).name == "cameras.bin":
        raise InputError("of COLMAP cameras.txt is read: colmap model_converter --output_type TXT")
    text = read_text(path, MAX_LIST_BYTES)
    if re.match(r"\s*(\{|\[\s*[-+\[\d])", text):
        return _json_facts(read_json(path))
    facts = facts_from_text(path, text)
    if facts is None:
        names = read_storage(path, text)
        facts = None if names is None else _with_own_keys(facts_from_names(names), names)
    if facts is None:
        shown = " ".join(text[:200].split())[:40]
        raise InputError(f"no camera that is known; it begins with {shown!r}. Known: {KNOWN_FILES}")
    return facts


def _with_own_keys(facts: CameraFacts | None, names: Names) -> CameraFacts | None:
    """Take what files of ROS and OpenCV lack from the keys of our JSON, where they were added."""
    if facts is None:
        return None
    added: dict[str, float] = {}
    for key in ("baseline_m", _DOFFS, *OPTIONAL_KEYS):
        value = names.get(key.replace("_", ""))
        if value is None or (key != _DOFFS and getattr(facts, key) is not None):
            continue
        number = scalar(names, key.replace("_", ""))
        if number is None:
            raise InputError(f"{key} is {value!r}; write a number")
        added[key] = number
    return replace(facts, **added, is_metric=facts.is_metric or "baseline_m" in added)


def _json_facts(content: object) -> CameraFacts:
    """Take the names of ROS, OpenCV (whose matrices are objects with ``data``) or others."""
    if isinstance(content, dict):
        names = named(content)
        is_storage = any(isinstance(value, dict) and "data" in value for value in content.values())
        if is_storage or is_ros(names) or {"ppx", "cameramatrix"} & names.keys():
            facts = _with_own_keys(facts_from_names(names), names)
            if facts is not None:
                return facts
    return facts_from_json(content)


AnyCamera = (
    str | Path | Camera | Mapping[str, Any] | Sequence[Sequence[float]] | np.ndarray | Tensor
)
"""A camera, its file, what our JSON or BOP's holds as a dict, or its 3x3 matrix K alone."""


@dataclass(frozen=True)
class FieldOfView:
    """The horizontal angle that an image spans, in place of a focal length [degrees]."""

    degrees: float

    def __post_init__(self) -> None:
        """Refuse angles that no pinhole has."""
        if not 1 <= self.degrees <= 170:
            raise InputError(
                f"fov is {self.degrees:g} degrees; a pinhole camera spans 1 to 170 degrees from "
                "left to right"
            )


AnyLens = AnyCamera | FieldOfView | float | np.number[Any]
"""The same, or the focal length [px] or field of view alone: the principal point is then the
image's centre."""


def camera_of(camera: AnyLens | None, size: Size) -> Camera | None:
    """Make the camera of an image from what is known of it; None where nothing is.

    Args:
        camera: what is known. A dict without width and height, a matrix and a focal length take
            the size of the image.
        size: width and height of the image.

    Raises:
        InputError: it is no camera of this image.
    """
    if camera is None or isinstance(camera, Camera):
        return camera
    if isinstance(camera, str | Path):
        return read_camera(Path(camera), size)
    if isinstance(camera, FieldOfView):
        camera = size[0] / 2 / math.tan(math.radians(camera.degrees / 2))
    if isinstance(camera, int | float):
        return centred_camera(size, camera)
    if isinstance(camera, np.generic | np.ndarray | Tensor) and camera.ndim == 0:
        return centred_camera(size, float(camera))
    if isinstance(camera, Mapping):
        return camera_from_facts(_from_mapping(camera, size), size)
    return camera_from_facts(CameraFacts(kind="a matrix K", K=intrinsics_of(camera)), size)


def choose_lens(
    camera: AnyLens | None, focal_px: float | None, fov_deg: float | None = None
) -> AnyLens | None:
    """Give the one that was given; None where none was.

    Raises:
        InputError: several were, or the field of view is none.
    """
    fov = None if fov_deg is None else FieldOfView(fov_deg)
    named = {"camera": camera, "focal_px": focal_px, "fov_deg": fov}
    given = {name: lens for name, lens in named.items() if lens is not None}
    if len(given) > 1:
        first, second = list(given)[:2]
        raise InputError(f"{first} and {second} are both given; omit one of the two")
    return next(iter(given.values()), None)


def centred_camera(size: Size, focal_px: float) -> Camera:
    """Make the camera of which the focal length alone is known; its axis meets the centre.

    Raises:
        InputError: no focal length in pixels.
    """
    if not 1 < focal_px < 1e6:
        raise InputError(f"focal_px is {focal_px}: not a focal length in pixels; KITTI's is 721.5")
    width, height = size
    K = [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
    return Camera(width=width, height=height, K=torch.tensor(K, dtype=torch.float64))


def intrinsics_of(K: object) -> Float[Tensor, "3 3"]:
    """Take a 3x3 list, array or tensor of any real numbers as an intrinsic matrix, in float64.

    Raises:
        InputError: it is none.
    """
    values = K.detach().cpu().numpy() if isinstance(K, Tensor) else K
    try:
        matrix = torch.from_numpy(np.array("none" if K is None else values, dtype=np.float64))
        matrix = matrix.reshape(3, 3) if matrix.shape == (9,) else matrix
    except (TypeError, ValueError) as error:
        raise InputError(
            f"camera is a {type(K).__name__}; give a Camera(width=, height=, K=), or a StereoRig "
            "for metres from a pair, its file, a dict of its keys, or the 3x3 matrix K"
        ) from error
    check_intrinsics(matrix)
    return matrix


def _from_mapping(camera: Mapping[str, Any], size: Size) -> CameraFacts:
    keys = {key: np.asarray(value).tolist() for key, value in camera.items()}
    if {"width", "height"} & keys.keys():
        return _json_facts(keys)
    # Without a size of its own the matrix may be that of another resolution: that is checked.
    facts = _json_facts({"width": size[0], "height": size[1], **keys})
    return replace(facts, size=None)
