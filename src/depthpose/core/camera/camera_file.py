"""Reading of camera files of any known format, and writing of depthpose's own JSON.

Text and JSON are read here, files of ROS and OpenCV by ``stored_camera``. A caller may also give a
matrix, a mapping or a focal length in place of a file.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.camera.lens import is_fisheye_lens
from depthpose.core.camera.pinhole import (
    KNOWN_FILES,
    MAX_SIDE_PX,
    OPTIONAL_KEYS,
    SAME_DIFFERENCE_PX,
    Camera,
    CameraFacts,
    Size,
    StereoRig,
    camera_from_facts,
    camera_keys,
    check_intrinsics,
    facts_from_projections,
    intrinsics,
    refuse_apart,
)
from depthpose.core.camera.stored_camera import (
    Fields,
    facts_from_fields,
    facts_from_folder,
    find_distortion,
    find_number,
    is_ros,
    normalise_keys,
    parse_storage,
    read_baseline_m,
    with_fisheye,
)
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import AnyPath, read_json, read_key_values, read_text, write_json
from depthpose.core.files.disk import MAX_LIST_BYTES

Matrix = Float64[np.ndarray, "rows columns"]


class KittiPair(NamedTuple):
    """Keys of two cameras in a calibration of KITTI's."""

    left: str  #: projection of the left camera
    right: str  #: projection of the right camera
    size: str  #: width and height of the rectified images; few files have it


KITTI_COLOR = (
    KittiPair("P2", "P3", "S_rect_02"),
    KittiPair("P_rect_02", "P_rect_03", "S_rect_02"),
)
"""The colour pair in the object and the raw layout."""
KITTI_GREY = (
    KittiPair("P0", "P1", "S_rect_00"),
    KittiPair("P_rect_00", "P_rect_01", "S_rect_00"),
)
"""The grey pair in the object and the raw layout."""
_KITTI = re.compile(r"^(?:P|P_rect_0)[0-3]\s*:\s*[-+.\d]", re.MULTILINE)
_MIDDLEBURY = re.compile(r"^cam0\s*=", re.MULTILINE)
_FOCAL_LINES = re.compile(r"^[ \t]*focal_px[ \t]*:", re.MULTILINE)
_COLMAP = re.compile(r"^\d+ ([A-Z_]{3,}) (\d{1,7}) (\d{1,7}) ([-+.\deE ]+)$", re.MULTILINE)
_FOREIGN = {
    r"^\[(LEFT|RIGHT)_CAM_": "the factory calibration of a ZED, which is that of its raw images: "
    "take fx, fy, cx, cy and the baseline of the rectified ones from its SDK "
    "(calibration_parameters)",
    r"^[ \t]*Intrinsic of ": "a list of a RealSense's cameras: take that of your stream and size",
}
"""Signs of camera files that are not read."""
_OWN_FORMAT = (
    'Write {"width": .., "height": .., "K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]}, and '
    '"baseline_m" (metres) of a pair'
)
_TUM = {(517.3, 516.5, 318.6, 255.3), (520.9, 521.0, 325.1, 249.7), (535.4, 539.2, 320.1, 247.6)}
"""Published fx, fy, cx, cy of TUM RGB-D's three cameras, which belong to no other data."""
_TUM_SIZE = (640, 480)
_TUM_UNIT_M = 1 / 5000
_DOFFS = "cx_right_minus_left_px"
_OPTIONAL_LINES = ("width", "height", "focal_y_px", _DOFFS)
_MAX_FOCAL_PX = 1e6  # larger numbers are no focal length
_LARGEST_NUMBER = 1e300  # largest number of JSON: larger whole numbers have no float
_BARE_NUMBERS = 20  # numbers that are read of a file of bare numbers: more than any format has


def _read_middlebury(path: AnyPath) -> CameraFacts:
    """Read Middlebury's ``calib.txt``: cam0, doffs, baseline [mm], size; cam1 is only checked."""
    keys = read_key_values(path)
    K = kitti_matrix(path, keys, "cam0", (3, 3))
    right = kitti_matrix(path, keys, "cam1", (3, 3)) if "cam1" in keys else K
    baseline_mm, doffs_px = (_read_number(path, keys, name) for name in ("baseline", "doffs"))

    refuse_apart(K, right)
    cx_difference_px = right[0, 2] - K[0, 2]
    if "cam1" in keys and abs(cx_difference_px - doffs_px) > SAME_DIFFERENCE_PX:
        raise InputError(
            f"{path}: doffs is {doffs_px:g}, but cx of cam1 less that of cam0 is "
            f"{cx_difference_px:g}; write the true one of the two"
        )
    if 0 < baseline_mm < 1:
        raise InputError(
            f"{path}: baseline is {baseline_mm:g}, and Middlebury's is in millimetres; where it is "
            f"in metres, write {1000 * baseline_mm:g}"
        )

    return CameraFacts(
        kind="a Middlebury calibration",
        K=torch.from_numpy(K),
        size=_read_size({name: _read_number(path, keys, name) for name in ("width", "height")}),
        baseline_m=baseline_mm / 1000,
        cx_right_minus_left_px=doffs_px,
        is_metric=True,
    )


def plain_facts(path: AnyPath, keys: Mapping[str, list[float]]) -> CameraFacts:
    """Read the rig of ``KEY: number`` lines: focal_px, cx, cy, baseline_m, and optional ones.

    Args:
        path: the file, for errors.
        keys: its numbers by key.

    Raises:
        InputError: a key is missing, or has not one number.
    """
    optional = [key for key in _OPTIONAL_LINES if key in keys]
    wanted = ("focal_px", "cx", "cy", "baseline_m", *optional)
    values = {key: _read_number(path, keys, key) for key in wanted}
    focal_px = values["focal_px"]
    has_size = {"width", "height"} <= values.keys()
    return CameraFacts(
        kind="a calibration",
        K=intrinsics(focal_px, values.get("focal_y_px", focal_px), values["cx"], values["cy"]),
        size=(int(values["width"]), int(values["height"])) if has_size else None,
        baseline_m=values["baseline_m"],
        cx_right_minus_left_px=values.get(_DOFFS, 0.0),
        is_metric=True,
    )


def kitti_matrix(
    path: AnyPath, keys: Mapping[str, list[float]], name: str, shape: tuple[int, int]
) -> Matrix:
    """Read a matrix of a calibration of ``KEY: numbers`` lines, such as KITTI's.

    Args:
        path: the file, for errors.
        keys: its numbers by key.
        name: key of the matrix.
        shape: its rows and columns.

    Raises:
        InputError: it is missing, or of another number of values.
    """
    if name not in keys:
        raise InputError(f"{path}: has no line '{name}:', which such a calibration holds.")
    if len(keys[name]) != shape[0] * shape[1]:
        raise InputError(
            f"{path}: {name} holds {len(keys[name])} numbers instead of {shape[0] * shape[1]}. "
            "Copy the file anew."
        )
    return np.array(keys[name], dtype=np.float64).reshape(shape)


def choose_kitti_pair(keys: Mapping[str, list[float]], pairs: Sequence[KittiPair]) -> KittiPair:
    """Choose the first of some pairs whose left projection a calibration has.

    Where it has none of them, the first pair is given: :func:`kitti_matrix` then raises the error
    that names its missing projection.
    """
    return next((pair for pair in pairs if pair.left in keys), pairs[0])


def read_kitti_size(keys: Mapping[str, list[float]], pair: KittiPair) -> Size | None:
    """Read width and height [px] of the rectified images of a pair; None where they are absent."""
    sides = keys.get(pair.size, [])
    return (int(sides[0]), int(sides[1])) if len(sides) == 2 else None


def _read_colmap(text: str) -> CameraFacts:
    """Read COLMAP's ``cameras.txt``, a line a camera: number, model, size, parameters."""
    cameras = {match.groups() for match in _COLMAP.finditer(text)}
    if len(cameras) > 1:
        raise InputError(
            f"a cameras.txt of COLMAP with {len(cameras)} different cameras; keep the line of one"
        )

    model, width, height, parameters = cameras.pop()
    is_fisheye = bool(is_fisheye_lens({"cameramodel": model}))
    try:
        values = [float(word) for word in parameters.split()]
    except ValueError as error:
        raise InputError(f"a camera of COLMAP whose parameters are {parameters:.60}") from error
    has_one_focal_length = model.startswith(("SIMPLE_", "RADIAL"))
    if has_one_focal_length:
        values.insert(0, values[0])
    if len(values) < 4:
        raise InputError(f"a camera of COLMAP with {len(values)} parameters; copy it anew")

    fx, fy, cx, cy = values[:4]
    return CameraFacts(
        kind=f"a {model} camera of COLMAP",
        K=intrinsics(fx, fy, cx - 0.5, cy - 0.5),  # its first pixel is centred at (0.5, 0.5)
        size=(int(width), int(height)),
        distortion=tuple(values[4:]),
        is_fisheye=is_fisheye,
        undistort="colmap image_undistorter",
    )


def _read_bare_numbers(text: str) -> CameraFacts | None:
    """Read bare numbers: ``fx fy cx cy`` and distortion; K, perhaps with a baseline; or P.

    None where they are none of these.
    """
    lines = (line.partition("#")[0] for line in text.splitlines())
    words = " ".join(lines).replace(",", " ").split()
    try:
        numbers = [float(word) for word in words[:_BARE_NUMBERS]]
    except ValueError:
        return None
    count = len(numbers)

    # A transposed K is taken too: the check of a matrix says what is wrong with it.
    is_K = count in (9, 10) and [0, 0, 1] in (numbers[6:9], numbers[2:9:3])
    if is_K:
        K = torch.tensor(numbers[:9], dtype=torch.float64).reshape(3, 3)
        baseline_m = numbers[9] if count == 10 else None
        return CameraFacts(kind="a matrix", K=K, baseline_m=baseline_m)

    is_projection = count in (12, 16) and numbers[8:11] == [0, 0, 1]
    if is_projection:
        P = torch.tensor(numbers[:12], dtype=torch.float64).reshape(3, 4)
        fx = numbers[0]
        minus_fx_baseline = numbers[3]
        baseline_m = -minus_fx_baseline / fx if minus_fx_baseline and fx else None
        return CameraFacts(kind="a matrix", K=P[:, :3].contiguous(), baseline_m=baseline_m)

    if count not in (4, 8, 9, 12):
        return None
    is_tum = tuple(numbers[:4]) in _TUM
    return CameraFacts(
        kind="a camera of TUM RGB-D" if is_tum else "fx fy cx cy",
        K=intrinsics(*numbers[:4]),
        size=_TUM_SIZE if is_tum else None,
        depth_unit_m=_TUM_UNIT_M if is_tum else None,
        distortion=tuple(numbers[4:]),
    )


def _read_number(path: AnyPath, keys: Mapping[str, list[float]], name: str) -> float:
    """Return the number of a key of a calibration, which must be there and be only one."""
    if len(keys.get(name, [])) != 1:
        raise InputError(f"{path}: {name!r} is missing, or is not one number; copy the file anew")
    return keys[name][0]


_NEEDED = ("width", "height", "K")
_KEYS = (*_NEEDED, "baseline_m", _DOFFS, *OPTIONAL_KEYS)
_BOP = ("fx", "fy", "cx", "cy")


def facts_from_json(content: object) -> CameraFacts:
    """Read the camera of a JSON file: depthpose's own, or a known one of other systems.

    Raises:
        InputError: it is none, or a key is unknown, missing or of another type.
    """
    if not isinstance(content, dict) or not content.keys() <= set(_KEYS):
        facts = _read_foreign_json(content)
        if facts is not None:
            return facts

    # A mistake of depthpose's own keys is named.
    assert isinstance(content, dict)
    if not content.keys() & set(_KEYS):
        keys = ", ".join(map(repr, content))
        raise InputError(f"no camera that is known; its keys are {keys:.80}. Known: {KNOWN_FILES}")
    for key in content:
        if key not in _KEYS:
            raise InputError(f"unknown key {key!r}; {nearest_name(key, _KEYS)}")
    missing = [key for key in _NEEDED if key not in content]
    if missing:
        raise InputError(f"missing {', '.join(map(repr, missing))}; add it to the camera")
    if "cx_right_minus_left_px" in content and "baseline_m" not in content:
        raise InputError("'cx_right_minus_left_px' needs 'baseline_m' beside it; add it")

    optional_keys = ("baseline_m", _DOFFS, *OPTIONAL_KEYS)
    values: dict[str, Any] = {
        key: _read_json_number(content, key) for key in optional_keys if key in content
    }
    size = _read_size(content)
    return CameraFacts(
        kind="a camera", K=_read_matrix(content["K"]), size=size, is_metric=True, **values
    )


def _read_foreign_json(content: object) -> CameraFacts | None:
    """Read the JSON of other systems: a bare matrix, ROS, OpenCV, RealSense, Open3D or BOP.

    None where it is of none of them.
    """
    if isinstance(content, list) and len(content) in (3, 9):
        return CameraFacts(kind="a matrix", K=_read_matrix(content))
    if not isinstance(content, dict):
        raise InputError(
            f"a camera is a JSON object with the keys {', '.join(_KEYS)}, "
            f"not a {type(content).__name__}"
        )

    fields = normalise_keys(content)
    facts = None
    is_fisheye = bool(is_fisheye_lens(fields))
    # Matrices of OpenCV are objects with ``data``.
    is_opencv = any(isinstance(value, dict) and "data" in value for value in content.values())
    if is_opencv or is_ros(fields) or {"ppx", "cameramatrix"} & fields.keys():
        facts = _with_json_keys(facts_from_fields(fields), fields)

    # Keys of depthpose in a camera of no other system: its own reader names what is wrong.
    if facts is not None or "K" in content:
        return facts
    open3d_intrinsic = content.get("intrinsic", content)
    if "cam_K" in content:
        facts = _from_scene_camera({"0": content})
    elif isinstance(open3d_intrinsic, dict) and "intrinsic_matrix" in open3d_intrinsic:
        facts = _from_open3d(open3d_intrinsic)
    elif content.keys() >= set(_BOP):
        fx, fy, cx, cy = (_read_json_number(content, key) for key in _BOP)
        facts = CameraFacts(
            kind="a camera of BOP",
            K=intrinsics(fx, fy, cx, cy),
            size=_read_size(content) if {"width", "height"} <= content.keys() else None,
            baseline_m=read_baseline_m(fields),
            depth_unit_m=_read_bop_unit_m(content),
            distortion=find_distortion(fields),
        )
    elif content and all(
        isinstance(image, dict) and "cam_K" in image for image in content.values()
    ):
        facts = _from_scene_camera(content)

    return None if facts is None else with_fisheye(facts, is_fisheye=is_fisheye)


def _from_open3d(keys: dict[str, Any]) -> CameraFacts:
    """Read Open3D's ``PinholeCameraIntrinsic``, whose flat matrix is stored column by column."""
    K = _read_matrix(keys["intrinsic_matrix"])
    is_by_columns = isinstance(keys["intrinsic_matrix"][0], int | float)
    if is_by_columns:
        K = K.T.contiguous()
    size = _read_size(keys) if {"width", "height"} <= keys.keys() else None
    return CameraFacts(kind="a camera of Open3D", K=K, size=size)


def _from_scene_camera(images: dict[str, dict[str, Any]]) -> CameraFacts:
    """Read the camera of BOP's scene_camera.json, which must be the same for all images."""
    entries = list(images.values())
    first = entries[0]
    for entry in entries:
        has_same_K = entry["cam_K"] == first["cam_K"]
        if not has_same_K or _read_bop_unit_m(entry) != _read_bop_unit_m(first):
            raise InputError(
                f"a scene_camera.json of BOP whose {len(entries)} images have several cameras; "
                "write that of one image into a file, or open the data set by --bop"
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
    """Read the unit of depth images [m] of a camera of BOP; None where it has none."""
    if "depth_scale" in keys:
        return 0.001 * _read_json_number(keys, "depth_scale")  # millimetres a unit
    return _read_json_number(keys, "depth_unit_m") if "depth_unit_m" in keys else None


def _read_size(keys: dict[str, Any]) -> Size:
    """Read width and height [px], which must be whole numbers."""
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
    """Read the 9 numbers of K, nested or flat."""
    try:
        return torch.from_numpy(np.array(value, dtype=np.float64).reshape(3, 3))
    except (TypeError, ValueError, OverflowError) as error:
        shown = repr(value)[:80]
        raise InputError(
            f"'K' is {shown}; write [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"
        ) from error


@contextmanager
def errors_naming(path: AnyPath) -> Iterator[None]:
    """Begin the message of an :class:`InputError` raised inside the block with the file's path."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{path}"):
            raise
        raise InputError(f"{path}: {error}") from error


def read_camera(path: AnyPath, size: Size | None = None) -> Camera | StereoRig:
    """Read a camera; a :class:`StereoRig` where the file has a baseline.

    The format, one of ``KNOWN_FILES``, is recognised by the content. A folder may hold the two
    files of a pair.

    Args:
        path: the file, or the folder of a pair's two files.
        size: width and height of the image, for formats that do not say it.

    Raises:
        InputError: the file is missing or damaged, of no known format, of a lens with distortion,
            without a size where none is given, or a value cannot be that of a camera in pixels
            and metres.
    """
    with errors_naming(path):
        return camera_from_facts(_read_facts(path), size)


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
    # The sizes of a scaled image are rounded to whole pixels: the aspect agrees to within one.
    aspect_error = abs(width * camera.height - height * camera.width)
    remedy = "the aspect differs too: follow a crop with crop_camera, or give that image's camera"
    if aspect_error <= max(camera.width, camera.height):
        remedy = (
            f"the aspect agrees: resize the image to {camera.width}x{camera.height}, or the camera "
            f"with resize_camera(camera, {width}, {height})"
        )
    raise InputError(
        f"{name} is {width}x{height} but its camera is {camera.width}x{camera.height}; {remedy}"
    )


def _read_facts(path: AnyPath) -> CameraFacts:
    """Recognise the format of a camera file by its content, and read it."""
    if Path(path).is_dir():
        return facts_from_folder(Path(path))
    if Path(path).name == "cameras.bin":
        raise InputError("of COLMAP cameras.txt is read: colmap model_converter --output_type TXT")
    text = read_text(path, MAX_LIST_BYTES)
    if re.match(r"\s*(\{|\[\s*[-+\[\d])", text):
        return facts_from_json(read_json(path))

    # Other text: formats that a word of theirs tells, else bare numbers, or keys and values.
    facts: CameraFacts | None
    if _MIDDLEBURY.search(text):
        facts = _read_middlebury(path)
    elif _KITTI.search(text):
        facts = _read_kitti(path)
    elif _FOCAL_LINES.search(text):
        facts = plain_facts(path, read_key_values(path))
    elif _COLMAP.search(text):
        facts = _read_colmap(text)
    else:
        for sign, description in _FOREIGN.items():
            if re.search(sign, text, re.MULTILINE):
                raise InputError(f"{description}. {_OWN_FORMAT}")
        facts = _read_bare_numbers(text)
        if facts is None:
            fields = parse_storage(path, text)
            if fields is not None:
                facts = _with_json_keys(facts_from_fields(fields), fields)
    if facts is None:
        shown = " ".join(text[:200].split())[:40]
        raise InputError(f"no camera that is known; it begins with {shown!r}. Known: {KNOWN_FILES}")
    return facts


def _read_kitti(path: AnyPath) -> CameraFacts:
    """Read KITTI's colour pair (cameras 2 and 3), else its grey pair; or the left camera alone."""
    keys = read_key_values(path)
    pair = choose_kitti_pair(keys, (*KITTI_COLOR, *KITTI_GREY))
    left_P = kitti_matrix(path, keys, pair.left, (3, 4))
    right_P = kitti_matrix(path, keys, pair.right, (3, 4)) if pair.right in keys else None
    size = read_kitti_size(keys, pair)
    return facts_from_projections("a KITTI calibration", left_P, right_P, size)


def _with_json_keys(facts: CameraFacts | None, fields: Fields) -> CameraFacts | None:
    """Add values under keys of depthpose's JSON, which a file of ROS or OpenCV may have besides."""
    if facts is None:
        return None
    added: dict[str, float] = {}
    for key in ("baseline_m", _DOFFS, *OPTIONAL_KEYS):
        field = key.replace("_", "")
        value = fields.get(field)
        is_set = key != _DOFFS and getattr(facts, key) is not None
        if value is None or is_set:
            continue
        number = find_number(fields, field)
        if number is None:
            raise InputError(f"{key} is {value!r}; write a number")
        added[key] = number
    return replace(facts, **added, is_metric=facts.is_metric or "baseline_m" in added)


AnyCamera = (
    str | Path | Camera | Mapping[str, Any] | Sequence[Sequence[float]] | np.ndarray | Tensor
)
"""A camera, its file, a dict of the keys of our JSON or of BOP's, or its 3x3 matrix K alone."""


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
"""A camera in any form of ``AnyCamera``, or its focal length [px] or field of view alone: the
principal point is then the image's centre."""


def camera_of(camera: AnyLens | None, size: Size) -> Camera | None:
    """Make the camera of an image from any form that a caller may have it in; None stays None.

    Args:
        camera: a camera, its file, a dict, a matrix, a focal length or a field of view. A dict
            without width and height, a matrix and a focal length take the size of the image.
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
    if isinstance(camera, np.generic | np.ndarray | Tensor) and camera.ndim == 0:
        camera = float(camera)
    if isinstance(camera, int | float):
        return _make_focal_camera(camera, size)
    if isinstance(camera, Mapping):
        keys = {key: np.asarray(value).tolist() for key, value in camera.items()}
        if {"width", "height"} & keys.keys():
            return camera_from_facts(facts_from_json(keys), size)
        facts = facts_from_json({"width": size[0], "height": size[1], **keys})
        # The size is not of the dict: whether K is of another resolution is to be checked.
        return camera_from_facts(replace(facts, size=None), size)
    return camera_from_facts(CameraFacts(kind="a matrix K", K=intrinsics_of(camera)), size)


def _make_focal_camera(focal_px: float, size: Size) -> Camera:
    """Make the camera of a focal length, whose principal point is the centre of the image."""
    if not 1 < focal_px < _MAX_FOCAL_PX:
        raise InputError(f"focal_px is {focal_px}: not a focal length in pixels; KITTI's is 721.5")
    width, height = size
    K = intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    return Camera(width=width, height=height, K=K)


def choose_lens(
    camera: AnyLens | None, focal_px: float | None, fov_deg: float | None = None
) -> AnyLens | None:
    """Return the argument that is not None, the field of view as :class:`FieldOfView`.

    None where all are None.

    Raises:
        InputError: more than one is set, or no pinhole has such a field of view.
    """
    fov = None if fov_deg is None else FieldOfView(fov_deg)
    arguments = {"camera": camera, "focal_px": focal_px, "fov_deg": fov}
    chosen = {name: lens for name, lens in arguments.items() if lens is not None}
    if len(chosen) > 1:
        first, second = list(chosen)[:2]
        raise InputError(f"{first} and {second} are both given; omit one of the two")
    return next(iter(chosen.values()), None)


def intrinsics_of(K: object) -> Float[Tensor, "3 3"]:
    """Convert a 3x3 list, array or tensor of any real numbers to an intrinsic matrix in float64.

    Raises:
        InputError: it is no intrinsic matrix.
    """
    values = K.detach().cpu().numpy() if isinstance(K, Tensor) else K
    try:
        # numpy would read None as NaN.
        matrix = torch.from_numpy(np.array("none" if K is None else values, dtype=np.float64))
        matrix = matrix.reshape(3, 3) if matrix.shape == (9,) else matrix
    except (TypeError, ValueError) as error:
        raise InputError(
            f"camera is a {type(K).__name__}; give a Camera(width=, height=, K=), or a StereoRig "
            "for metres from a pair, its file, a dict of its keys, or the 3x3 matrix K"
        ) from error
    check_intrinsics(matrix)
    return matrix
