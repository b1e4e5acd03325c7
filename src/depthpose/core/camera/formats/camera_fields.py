"""Camera files of ROS (``camera_info``), OpenCV (YAML, XML) and ORB-SLAM, read by their keys."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import torch
import yaml

from depthpose.core.camera.formats.facts import KNOWN_FILES, CameraFacts, facts_from_projections
from depthpose.core.camera.lens import is_fisheye_lens
from depthpose.core.camera.pinhole import Size, intrinsics
from depthpose.core.errors import InputError
from depthpose.core.files import AnyPath, read_text
from depthpose.core.files.disk import MAX_LIST_BYTES, YamlLoader, refuse_yaml_bomb, refused_as

Fields = dict[str, Any]
"""Values of a file by its keys, these in lower case, letters and digits only."""

_YAML_HEAD = re.compile(r"\A\s*%YAML[^\n]*\n")
_XML_DECLARATION = re.compile(r"<!(?!--)")
_MAX_TEXT = 2**18  # longest YAML or XML that is parsed [letters]: ten times a large camera file


def parse_storage(path: AnyPath, text: str) -> Fields | None:
    """Parse the text of a camera file to fields: YAML, or OpenCV's ``FileStorage`` as YAML or XML.

    None where it is none of these, too long, or no mapping.

    Raises:
        InputError: it is damaged, or describes several cameras.
    """
    if len(text) > _MAX_TEXT:
        return None
    if text.lstrip().startswith("<"):
        return _read_opencv_xml(path, text)
    body = _YAML_HEAD.sub("", text)
    with refused_as(path, "camera file", f"correct it there; known are {KNOWN_FILES}"):
        refuse_yaml_bomb(path, body)
        loader = _OpencvYamlLoader(body)
        documents = []
        while loader.check_data():
            documents.append(loader.get_data())
    if not documents or not isinstance(documents[0], Mapping):
        return None

    # A recorded topic of ROS has a document for each message: the same camera at other times, which
    # are in the header.
    fields = normalise_keys(documents[0])
    without_header = fields | {"header": 0}
    for other in documents[1:]:
        is_mapping = isinstance(other, Mapping)
        if is_mapping and normalise_keys(other) | {"header": 0} != without_header:
            raise InputError(
                f"{path}: describes several cameras, one after the other; write each into a file "
                "of its own (those of a pair into a folder)"
            )
    return fields


def _read_opencv_xml(path: AnyPath, text: str) -> Fields | None:
    """Parse the XML of OpenCV's FileStorage; None where it is another XML."""
    if _XML_DECLARATION.search(text):
        raise InputError(
            f"{path}: XML with declarations (<!...>), which no camera needs; drop them"
        )
    with refused_as(path, "camera file", "correct it there"):
        root = ElementTree.fromstring(text)  # noqa: S314  entities are refused above
    if root.tag != "opencv_storage":
        return None
    # A matrix is a node of leaves (rows, cols, data), a number or text is a node alone.
    values: dict[str, Any] = {}
    for node in root:
        leaves = {leaf.tag: leaf.text for leaf in node}
        values[node.tag] = leaves or node.text
    return normalise_keys(values)


def normalise_keys(content: Mapping[Any, Any]) -> Fields:
    """Normalise the keys of a file: lower case, letters and digits only."""
    return {re.sub(r"[^a-z0-9]", "", str(key).lower()): value for key, value in content.items()}


def find_matrix(fields: Fields, keys: tuple[str, ...], count: int) -> np.ndarray | None:
    """Return the matrix of the first of some keys that has ``count`` numbers: 9, 12 or 16.

    The matrix is 3x3, 3x4 or 4x4; None where no key has that many numbers.
    """
    columns = 3 if count == 9 else 4
    for key in keys:
        values = parse_numbers(fields.get(key))
        if values is not None and len(values) == count:
            return np.array(values).reshape(-1, columns)
    return None


def find_number(fields: Fields, key: str) -> float | None:
    """Return the number of a key; None where it has none, or several."""
    values = parse_numbers(fields.get(key))
    return None if values is None or len(values) != 1 else values[0]


def parse_numbers(value: object) -> list[float] | None:
    """Convert a matrix of OpenCV, a list, a list of lists, text or a number to a list of numbers.

    None where there are none, or something else is among them.

    Raises:
        InputError: one of them is NaN or infinite.
    """
    content: Any = value.get("data") if isinstance(value, Mapping) else value
    words: list[Any] = []
    if isinstance(content, str):
        words = content.split()
    elif isinstance(content, list):
        for row in content:
            words += row if isinstance(row, list) else [row]
    else:
        words = [content]
    try:
        floats = [float(word) for word in words if not isinstance(word, bool)]
    except (TypeError, ValueError, OverflowError):
        return None
    if not np.isfinite(floats).all():
        raise InputError("a matrix of it holds NaN or infinity; calibrate again")
    return floats if floats and len(floats) == len(words) else None


class _OpencvYamlLoader(YamlLoader):
    """Loads YAML of plain values, and values with OpenCV's tags as plain ones."""


def _construct_opencv_node(loader: Any, _suffix: str, node: yaml.Node) -> object:  # noqa: ANN401 - yaml's
    """Construct a node of OpenCV's YAML, whatever its tag is, as a plain mapping, list or text."""
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)


_OpencvYamlLoader.add_multi_constructor("tag:yaml.org,2002:opencv-", _construct_opencv_node)


_SUFFIXES = (".yaml", ".yml", ".xml")
CAMERA_SUFFIXES = (".json", *_SUFFIXES, ".txt", ".conf")
"""Suffixes of the files that a camera may be read from."""
# Keys of a camera's values, the usual ones first.
_K = ("k", "cameramatrix", "intrinsicmatrix", "k1", "m1", "cameramatrix1", "cameramatrixleft")
_K_RIGHT = ("k2", "m2", "cameramatrix2", "cameramatrixright")
_D = ("d", "d1", "d2", "coeffs")
_P = ("p", "projectionmatrix", "p1")
_WIDTH = ("width", "imagewidth")
_HEIGHT = ("height", "imageheight")
_ROS = ("projectionmatrix", "distortionmodel", "p")  # keys by which a ``camera_info`` is recognised
_DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_PARALLEL_TOLERANCE = 1e-3  # of R, and of T beside its x, for cameras to count as parallel
_UNDISTORT_P = "cv2.undistort(image, K, distortion, None, P[:, :3]) (image_proc in ROS)"
_UNDISTORT_FISHEYE = (
    "cv2.fisheye.undistortImage(image, K, distortion, Knew=K), or Knew=P[:, :3] where there is a P"
)
_RECTIFY_FISHEYE = (
    "'depthpose data rectify', or by cv2.fisheye.initUndistortRectifyMap and cv2.remap, each view "
    "with its own K, R and P"
)
_RECTIFY = (
    "'depthpose data rectify', or by cv2.initUndistortRectifyMap and cv2.remap, each view with its "
    "own K, R and P (stereo_image_proc in ROS)"
)


def facts_from_fields(fields: Fields) -> CameraFacts | None:
    """Read the camera and the lens that fields describe; None where they describe no camera.

    Raises:
        InputError: the lens is neither a pinhole nor an equidistant fisheye, or a value is wrong.
    """
    is_fisheye = is_fisheye_lens(fields)
    facts = _read_facts_without_lens(fields)
    return None if facts is None else with_fisheye(facts, is_fisheye=bool(is_fisheye))


def with_fisheye(facts: CameraFacts, *, is_fisheye: bool) -> CameraFacts:
    """Add that the lens is a fisheye, if it is, and how its images are undistorted."""
    if not is_fisheye:
        return facts
    undistort = _UNDISTORT_FISHEYE if facts.baseline_m is None else _RECTIFY_FISHEYE
    return replace(facts, is_fisheye=True, undistort=undistort)


def _read_facts_without_lens(fields: Fields) -> CameraFacts | None:
    """Read the camera that fields describe, but for its lens model; None where they describe none.

    The first of these that the fields have is read: settings of ORB-SLAM, two projections, the
    matrix Q of stereoRectify, one projection, K.
    """
    if "cam0" in fields and "cam1" in fields:
        raise InputError(
            "a camchain of Kalibr, whose images are not rectified; 'depthpose data rectify' "
            "rectifies them and writes the camera of the result"
        )
    for prefix in ("camera", "camera1"):
        if f"{prefix}fx" in fields:
            return _facts_from_orb_slam(fields, prefix)

    size = find_size(fields)
    distortion = find_distortion(fields)
    kind = "a camera_info of ROS" if is_ros(fields) else "a camera of OpenCV"
    undistort = _RECTIFY
    left = find_published_matrix(fields, _P, 12)
    right = find_matrix(fields, ("p2",), 12)
    Q = find_matrix(fields, ("q",), 16)
    if right is not None:
        left = _require_matrix(left, "P1")
        facts = facts_from_projections("a rig of OpenCV", left, right, size)
    elif Q is not None:
        facts = _facts_from_reprojection_matrix(Q, size)
    elif left is None or left[0, 0] == 0:
        return _facts_from_intrinsics(fields, kind, distortion)
    elif left[0, 3] == 0:  # of a single camera, or of one above another, which make no rig
        facts = facts_from_projections(kind, left, None, size)
        undistort = _UNDISTORT_P
    else:
        facts = _facts_from_right_projection(left, kind, size)
    return replace(facts, distortion=distortion, undistort=undistort)


def _facts_from_orb_slam(fields: Fields, prefix: str) -> CameraFacts:
    """Read the settings of ORB-SLAM, whose keys of intrinsics begin with ``prefix``."""
    fx, fy, cx, cy = (
        find_number(fields, f"{prefix}{key}") or 0.0 for key in ("fx", "fy", "cx", "cy")
    )
    units_a_metre = find_number(fields, "depthmapfactor")
    units_a_metre = units_a_metre or find_number(fields, "rgbddepthmapfactor")
    baseline_m = None
    if units_a_metre is None:  # the baseline of an RGB-D camera is an invented one
        baseline_m = find_number(fields, "stereob")
        fx_times_baseline = find_number(fields, "camerabf")
        if baseline_m is None and fx_times_baseline is not None and fx > 0:
            baseline_m = fx_times_baseline / fx
    distortion = {key: fields.get(f"{prefix}{key}") for key in _DISTORTION_KEYS}
    return CameraFacts(
        kind="settings of ORB-SLAM",
        K=intrinsics(fx, fy, cx, cy),
        size=find_size({key: fields.get(f"camera{key}") for key in ("width", "height")}),
        baseline_m=baseline_m,
        depth_unit_m=1 / units_a_metre if units_a_metre else None,
        distortion=find_distortion(distortion),
    )


def _facts_from_reprojection_matrix(Q: np.ndarray, size: Size | None) -> CameraFacts:
    """Read the rig of stereoRectify's ``(x, y, z, w) = Q (u, v, disparity, 1)``.

    ``Q[3, 2]`` is 1 / baseline.
    """
    with np.errstate(all="ignore"):
        baseline_m = float(1 / Q[3, 2])
    return CameraFacts(
        kind="a rig of OpenCV",
        K=intrinsics(Q[2, 3], Q[2, 3], -Q[0, 3], -Q[1, 3]),
        size=size,
        baseline_m=baseline_m,
        cx_right_minus_left_px=float(Q[3, 3]) * baseline_m,
    )


def _facts_from_right_projection(P: np.ndarray, kind: str, size: Size | None) -> CameraFacts:
    """Read a rig from the right camera's projection alone, whose ``Tx`` is -fx times the baseline.

    That does not hold where both cameras are measured from a third one: the facts warn of that.
    """
    left = np.c_[P[:, :3], [0, 0, 0]]
    facts = facts_from_projections(kind, left, P, size)
    doubt = (
        "it is the right one alone, whose Tx gives a baseline of "
        f"{facts.baseline_m:g} m: that of the pair only where the left one's Tx is 0 "
        "(KITTI's is not); name the folder of both files to be sure"
    )
    return replace(facts, doubt=doubt)


def is_ros(fields: Fields) -> bool:
    """Whether fields have a key of ROS's ``camera_info``."""
    return any(key in fields for key in _ROS)


def is_ros_pair(first: Fields, second: Fields) -> bool:
    """Whether two files are the ``camera_info`` of a pair, and not OpenCV's of both cameras."""
    return is_ros(first) and is_ros(second) and "p2" not in first | second


def read_pair_files(folder: Path) -> tuple[Fields, Fields]:
    """Read the two YAML or XML files of a folder, in the order of their names.

    Raises:
        InputError: there are not two, or one of them cannot be read.
    """
    with refused_as(folder, "folder", "check who may read it"):
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES)
    contents = [parse_storage(file, read_text(file, MAX_LIST_BYTES)) for file in files]
    if len(files) != 2 or None in contents:
        raise InputError(
            f"a folder with {len(files)} files of {', '.join(_SUFFIXES)}; a camera of two files is "
            "left.yaml and right.yaml of ROS, or intrinsics.yml and extrinsics.yml of OpenCV, in "
            "a folder of their own"
        )
    first, second = (fields for fields in contents if fields is not None)
    return first, second


def facts_from_folder(folder: Path) -> CameraFacts:
    """Read the rig of a folder: two cameras of ROS, or OpenCV's intrinsics and extrinsics."""
    first, second = read_pair_files(folder)
    if is_ros_pair(first, second):
        return facts_from_ros_pair(first, second)
    facts = facts_from_fields(first | second)
    if facts is None:
        raise InputError("its two files together describe no camera")
    return facts


def facts_from_ros_pair(first: Fields, second: Fields) -> CameraFacts:
    """Read the rig of two ``camera_info``, in any order."""
    left, right = order_ros_pair(first, second)
    left_P, right_P = (
        _require_matrix(find_published_matrix(fields, _P, 12), "projection_matrix")
        for fields in (left, right)
    )
    facts = facts_from_projections("a pair of camera_info", left_P, right_P, find_size(first))
    coefficients = (*find_distortion(first), *find_distortion(second))
    facts = replace(facts, distortion=coefficients, undistort=_RECTIFY)
    are_fisheyes = [is_fisheye_lens(fields) for fields in (first, second)]
    return with_fisheye(facts, is_fisheye=any(are_fisheyes))


def order_ros_pair(first: Fields, second: Fields) -> tuple[Fields, Fields]:
    """Return the left ``camera_info`` of a pair, then the right one.

    ``Tx``, -fx times the x of a camera, tells them apart.

    Raises:
        InputError: both have the same Tx, or images of other sizes.
    """
    projections = [
        _require_matrix(find_matrix(fields, _P, 12), "projection_matrix")
        for fields in (first, second)
    ]
    first_Tx, second_Tx = (P[0, 3] for P in projections)
    if first_Tx == second_Tx:
        raise InputError(
            f"the projections of the two camera_info have Tx {first_Tx:g} and {second_Tx:g}, where "
            "that of the right one is smaller by fx times the baseline; calibrate them as a pair"
        )
    if find_size(first) != find_size(second):
        raise InputError("the two camera_info are of images of two sizes; a pair has one")
    return (first, second) if first_Tx > second_Tx else (second, first)


def _facts_from_intrinsics(
    fields: Fields, kind: str, distortion: tuple[float, ...]
) -> CameraFacts | None:
    """Read K, or fx, fy, cx and cy; None where there are neither.

    With R and T of stereoCalibrate, K is that of the left camera of a rectified pair.
    """
    size = find_size(fields)
    K = find_published_matrix(fields, _K, 9)
    if K is None:
        is_realsense = "ppx" in fields
        keys = ("fx", "fy", "ppx", "ppy") if is_realsense else ("fx", "fy", "cx", "cy")
        numbers = [find_number(fields, key) for key in keys]
        values = [number for number in numbers if number is not None]
        if len(values) < len(keys):
            return None
        fx, fy, cx, cy = values
        return CameraFacts(
            kind="a camera of RealSense" if is_realsense else "fx, fy, cx, cy",
            K=intrinsics(fx, fy, cx, cy),
            size=size,
            baseline_m=read_baseline_m(fields),
            depth_unit_m=find_number(fields, "depthscale") if is_realsense else None,
            distortion=distortion,
        )

    # OpenCV's calibration of a pair has R and T from the left camera to the right one.
    facts = CameraFacts(kind=kind, K=torch.from_numpy(K), size=size)
    T = parse_numbers(fields.get("t"))
    R = parse_numbers(fields.get("r"))
    if T is not None and len(T) == 3:
        no_rotation = np.eye(3).ravel()
        is_rotated = (
            R is not None
            and len(R) == 9
            and not np.allclose(R, no_rotation, atol=_PARALLEL_TOLERANCE)
        )
        if is_rotated or max(abs(T[1]), abs(T[2])) > _PARALLEL_TOLERANCE * abs(T[0]):
            raise InputError(
                "R and T of a pair that is not rectified, and no P1 and P2; rectify the images by "
                "'depthpose data rectify', or by cv2.stereoRectify and write its P1 and P2 too"
            )
        right_K = find_matrix(fields, _K_RIGHT, 9)
        right_K = K if right_K is None else right_K
        left_P = np.c_[K, [0, 0, 0]]
        right_P = np.c_[right_K, [right_K[0, 0] * T[0], 0, 0]]
        facts = facts_from_projections(kind, left_P, right_P, size)
    return replace(facts, distortion=distortion)


def read_baseline_m(fields: Fields) -> float | None:
    """Read ``baseline_m``; a baseline under another key, whose unit is unknown, is refused."""
    for key in fields:
        if key.startswith("baseline") and key != "baselinem":
            raise InputError(f"its {key!r} may be in any unit; write baseline_m, in metres")
    return find_number(fields, "baselinem")


def find_distortion(fields: Fields) -> tuple[float, ...]:
    """Collect the distortion coefficients under any key, of both lenses where there are two.

    They tell only whether a lens distorts. They are collected in no particular order, so they
    cannot undistort an image.

    Raises:
        InputError: a key of coefficients alone, such as ``D`` or ``distCoeffs``, holds none. Other
            keys that begin with ``distortion`` may hold words, as ``distortion_model`` does: these
            are skipped.
    """
    loose = [find_number(fields, key) for key in _DISTORTION_KEYS]
    coefficients = [number for number in loose if number is not None]
    for key, value in fields.items():
        is_list_key = key in _D or key.startswith(("distcoef", "distortioncoef"))
        if not is_list_key and not key.startswith("distortion"):
            continue
        is_matrix = isinstance(value, Mapping) and "data" in value
        is_by_name = isinstance(value, Mapping) and not is_matrix
        is_empty = not (value["data"] if is_matrix else value)
        numbers = parse_numbers(list(value.values()) if is_by_name else value)
        if numbers is None and is_list_key and not is_empty:
            raise InputError(f"its {key} are no list of numbers; write [k1, k2, p1, p2, k3]")
        coefficients += numbers or []
    return tuple(coefficients)


def find_published_matrix(fields: Fields, keys: tuple[str, ...], count: int) -> np.ndarray | None:
    """Find K or P, and convert it to the image that ROS publishes: cropped to its ROI, then binned.

    Arguments are those of :func:`find_matrix`; None where there is no such matrix.
    """
    matrix = find_matrix(fields, keys, count)
    if matrix is None:
        return None
    window = _read_window(fields)
    matrix[:2] -= [[window.left], [window.top]] * matrix[2]
    # Pixel centres are whole numbers, so binning maps u to (u + 0.5) scale - 0.5.
    scale = np.array([[1 / window.x_binning], [1 / window.y_binning]])
    matrix[:2] = matrix[:2] * scale + (scale / 2 - 0.5) * matrix[2]
    return matrix


class _Window(NamedTuple):
    """The part of the full image that ROS publishes: the ROI [px], and pixels binned to one."""

    left: int
    top: int
    width: int  # 0 where the ROI is the whole image
    height: int
    x_binning: int
    y_binning: int


def _read_window(fields: Fields) -> _Window:
    """Read the ROI and the binning of ROS; without them the window is the whole image.

    Raises:
        InputError: a number is negative.
    """
    content = fields.get("roi")
    roi = normalise_keys(content) if isinstance(content, Mapping) else {}
    roi_keys = ("xoffset", "yoffset", "width", "height")
    left, top, width, height = (int(find_number(roi, key) or 0) for key in roi_keys)
    x_binning, y_binning = (int(find_number(fields, f"binning{axis}") or 0) for axis in "xy")
    if min(left, top, width, height, x_binning, y_binning) < 0:
        raise InputError("its roi or its binning holds a negative number; write what was published")
    return _Window(left, top, width, height, x_binning or 1, y_binning or 1)


def find_size(fields: Fields) -> Size | None:
    """Read the image's size, where the file has it; for ROS that of the published image."""
    width = _find_first_number(fields, _WIDTH)
    height = _find_first_number(fields, _HEIGHT)
    size = parse_numbers(fields.get("imagesize") or fields.get("size"))
    if width is None and size is not None and len(size) == 2:
        width, height = size
    if not width or not height:
        return None
    window = _read_window(fields)
    if window.left + window.width > width or window.top + window.height > height:
        raise InputError(
            f"its roi, {window.width}x{window.height} at ({window.left}, {window.top}), leaves the "
            f"image of {width:g}x{height:g}; width and height are those of the full image"
        )
    columns = int(window.width or width) // window.x_binning
    rows = int(window.height or height) // window.y_binning
    return columns, rows


def _find_first_number(fields: Fields, keys: tuple[str, ...]) -> float | None:
    """Return the number of the first of some keys that has one; None where none has."""
    for key in keys:
        number = find_number(fields, key)
        if number is not None:
            return number
    return None


def _require_matrix(matrix: np.ndarray | None, name: str) -> np.ndarray:
    """Return a projection matrix, or refuse a file that lacks it; ``name`` is its key."""
    if matrix is None:
        raise InputError(f"there is no {name} of 12 numbers; write the whole pair")
    return matrix
