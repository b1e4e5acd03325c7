"""Reading of camera files of any known format, and writing of depthpose's own JSON.

Formats of plain text are read here, JSON by ``camera_json``, files of ROS, OpenCV and ORB-SLAM by
``camera_fields``. Each gives :class:`CameraFacts`, which ``facts`` checks.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64

from depthpose.core.camera.formats.camera_fields import (
    facts_from_fields,
    facts_from_folder,
    parse_storage,
)
from depthpose.core.camera.formats.camera_json import (
    DOFFS_KEY,
    facts_from_json,
    read_size,
    with_json_keys,
)
from depthpose.core.camera.formats.facts import (
    KNOWN_FILES,
    SAME_DIFFERENCE_PX,
    CameraFacts,
    camera_from_facts,
    camera_keys,
    facts_from_projections,
    refuse_unequal_cameras,
)
from depthpose.core.camera.lens import is_fisheye_lens
from depthpose.core.camera.pinhole import Camera, Size, StereoRig, intrinsics
from depthpose.core.errors import InputError
from depthpose.core.files import AnyPath, read_json, read_key_values, read_text, write_json
from depthpose.core.files.disk import MAX_LIST_BYTES

Matrix = Float64[np.ndarray, "rows columns"]


class KittiPair(NamedTuple):
    """Keys of two cameras in a calibration of KITTI's."""

    left: str  #: key of the projection of the left camera
    right: str  #: key of that of the right camera
    size: str  #: key of width and height of the rectified images; few files have it


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
"""Patterns of camera files that are not read, and what to do with such a file."""
_OWN_FORMAT = (
    'Write {"width": .., "height": .., "K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]}, and '
    '"baseline_m" (metres) of a pair'
)
_TUM = {(517.3, 516.5, 318.6, 255.3), (520.9, 521.0, 325.1, 249.7), (535.4, 539.2, 320.1, 247.6)}
"""Published fx, fy, cx, cy of TUM RGB-D's three cameras, by which its files are recognised."""
_TUM_SIZE = (640, 480)
_TUM_UNIT_M = 1 / 5000
_OPTIONAL_LINES = ("width", "height", "focal_y_px", DOFFS_KEY)
_BARE_NUMBERS = 20  # numbers that are read of a file of bare numbers: more than any format has


def _read_middlebury(path: AnyPath) -> CameraFacts:
    """Read Middlebury's ``calib.txt``: cam0, doffs, baseline [mm], size; cam1 is only checked."""
    keys = read_key_values(path)
    K = read_matrix(path, keys, "cam0", (3, 3))
    right = read_matrix(path, keys, "cam1", (3, 3)) if "cam1" in keys else K
    baseline_mm, doffs_px = (_read_number(path, keys, name) for name in ("baseline", "doffs"))

    refuse_unequal_cameras(K, right)
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
        size=read_size({name: _read_number(path, keys, name) for name in ("width", "height")}),
        baseline_m=baseline_mm / 1000,
        cx_right_minus_left_px=doffs_px,
        is_metric=True,
    )


def facts_from_lines(path: AnyPath, keys: Mapping[str, list[float]]) -> CameraFacts:
    """Read a rig from ``KEY: number`` lines: focal_px, cx, cy, baseline_m, and optional ones.

    The optional keys are width, height, focal_y_px and cx_right_minus_left_px.

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
        cx_right_minus_left_px=values.get(DOFFS_KEY, 0.0),
        is_metric=True,
    )


def read_matrix(
    path: AnyPath, keys: Mapping[str, list[float]], name: str, shape: tuple[int, int]
) -> Matrix:
    """Read a matrix from the ``KEY: numbers`` lines of a calibration, such as KITTI's.

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
    """Choose the first of some pairs whose left projection a calibration has, else the first.

    If the calibration has none of them, :func:`read_matrix` then raises the error that names
    the missing projection.
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
    """Read a file of bare numbers; None where they are no camera.

    It may be ``fx fy cx cy``, perhaps with distortion; the matrix K, perhaps with a baseline [m];
    or a projection P.
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

    # The four numbers, and none, 4, 5 or 8 coefficients of distortion.
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
    """Return the only number of a key of a calibration.

    Raises:
        InputError: the key is missing, or has not one number.
    """
    if len(keys.get(name, [])) != 1:
        raise InputError(f"{path}: {name!r} is missing, or is not one number; copy the file anew")
    return keys[name][0]


@contextmanager
def prefixed_errors(path: AnyPath) -> Iterator[None]:
    """Prefix each :class:`InputError` of the block with the path, unless it begins with it."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{path}"):
            raise
        raise InputError(f"{path}: {error}") from error


def read_camera(path: AnyPath, size: Size | None = None) -> Camera | StereoRig:
    """Read a camera file; the result is a :class:`StereoRig` where the file has a baseline.

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
    with prefixed_errors(path):
        return camera_from_facts(_read_facts(path), size)


def read_rig(path: AnyPath, size: Size | None = None) -> StereoRig:
    """Read the camera file of a stereo rig, as :func:`read_camera` does.

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
    # Sizes of a scaled image are rounded to whole pixels: the aspect agrees to within one pixel.
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
    """Recognise the format of a camera file, and read it.

    A folder of a pair and COLMAP's binary file are told by their paths, other files by content.
    """
    if Path(path).is_dir():
        return facts_from_folder(Path(path))
    if Path(path).name == "cameras.bin":
        raise InputError("of COLMAP cameras.txt is read: colmap model_converter --output_type TXT")
    text = read_text(path, MAX_LIST_BYTES)
    is_json = re.match(r"\s*(\{|\[\s*[-+\[\d])", text)  # an object, or a list of numbers
    if is_json:
        return facts_from_json(read_json(path))

    # Other text: formats that a pattern recognises, else bare numbers, or keys and values.
    facts: CameraFacts | None
    if _MIDDLEBURY.search(text):
        facts = _read_middlebury(path)
    elif _KITTI.search(text):
        facts = _read_kitti(path)
    elif _FOCAL_LINES.search(text):
        facts = facts_from_lines(path, read_key_values(path))
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
                facts = with_json_keys(facts_from_fields(fields), fields)
    if facts is None:
        shown = " ".join(text[:200].split())[:40]
        raise InputError(f"no camera that is known; it begins with {shown!r}. Known: {KNOWN_FILES}")
    return facts


def _read_kitti(path: AnyPath) -> CameraFacts:
    """Read KITTI's colour pair (cameras 2 and 3), else its grey pair; or the left camera alone."""
    keys = read_key_values(path)
    pair = choose_kitti_pair(keys, (*KITTI_COLOR, *KITTI_GREY))
    left_P = read_matrix(path, keys, pair.left, (3, 4))
    right_P = read_matrix(path, keys, pair.right, (3, 4)) if pair.right in keys else None
    size = read_kitti_size(keys, pair)
    return facts_from_projections("a KITTI calibration", left_P, right_P, size)
