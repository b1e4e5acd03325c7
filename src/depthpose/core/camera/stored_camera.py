"""Cameras of ROS (``camera_info``), OpenCV (YAML, XML) and ORB-SLAM: what their names mean."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import torch
import yaml

from depthpose.core.camera.lens import is_fisheye_lens
from depthpose.core.camera.pinhole import (
    KNOWN_FILES,
    CameraFacts,
    Size,
    facts_from_projections,
    intrinsics,
)
from depthpose.core.errors import InputError
from depthpose.core.files import AnyPath, read_text
from depthpose.core.files.disk import MAX_LIST_BYTES, YamlLoader, refuse_yaml_bomb, refused_as

Names = dict[str, Any]  # values by name; names in small letters and digits alone

_YAML_HEAD = re.compile(r"\A\s*%YAML[^\n]*\n")
_DECLARATION = re.compile(r"<!(?!--)")
_MAX_TEXT = 2**18  # longest YAML or XML that is parsed: ten times the largest camera file


def read_storage(path: AnyPath, text: str) -> Names | None:
    """Parse YAML (OpenCV's kind too), or the XML of OpenCV; None where it is neither."""
    if len(text) > _MAX_TEXT:
        return None
    if text.lstrip().startswith("<"):
        return _read_opencv_xml(path, text)
    body = _YAML_HEAD.sub("", text)
    with refused_as(path, "camera file", f"correct it there; known are {KNOWN_FILES}"):
        refuse_yaml_bomb(path, body)
        loader = _Loader(body)
        documents = []
        while loader.check_data():
            documents.append(loader.get_data())
    if not documents or not isinstance(documents[0], Mapping):
        return None

    # A recorded topic of ROS has a document for each message: the same camera at other times.
    names = named(documents[0])
    camera = names | {"header": 0}
    for other in documents[1:]:
        if isinstance(other, Mapping) and named(other) | {"header": 0} != camera:
            raise InputError(
                f"{path}: describes several cameras, one after the other; write each into a file "
                "of its own (those of a pair into a folder)"
            )
    return names


def _read_opencv_xml(path: AnyPath, text: str) -> Names | None:
    """Parse the XML of OpenCV's FileStorage; None where it is another XML."""
    if _DECLARATION.search(text):
        raise InputError(
            f"{path}: XML with declarations (<!...>), which no camera needs; drop them"
        )
    with refused_as(path, "camera file", "correct it there"):
        root = ElementTree.fromstring(text)  # noqa: S314  entities are refused above
    if root.tag != "opencv_storage":
        return None
    nodes = {node.tag: {leaf.tag: leaf.text for leaf in node} or node.text for node in root}
    return named(nodes)


def named(content: Mapping[Any, Any]) -> Names:
    """Normalise the names of a file: lower case, letters and digits only."""
    return {re.sub(r"[^a-z0-9]", "", str(key).lower()): value for key, value in content.items()}


def matrix(names: Names, keys: tuple[str, ...], count: int) -> np.ndarray | None:
    """Take the first matrix of ``count`` numbers among some names, in rows."""
    for name in keys:
        values = numbers(names.get(name))
        if values is not None and len(values) == count:
            return np.array(values).reshape(count // (4 if count > 9 else 3), -1)
    return None


def scalar(names: Names, name: str) -> float | None:
    """Read one number."""
    values = numbers(names.get(name))
    return None if values is None or len(values) != 1 else values[0]


def numbers(value: object) -> list[float] | None:
    """Read the numbers of a matrix, a list of lists, a list, text or one number; else None."""
    words: Any = value.get("data") if isinstance(value, Mapping) else value
    if isinstance(words, list):
        words = [v for row in words for v in (row if isinstance(row, list) else [row])]
    else:
        words = words.split() if isinstance(words, str) else [words]
    try:
        floats = [float(word) for word in words if not isinstance(word, bool)]
    except (TypeError, ValueError, OverflowError):
        return None
    if not np.isfinite(floats).all():
        raise InputError("a matrix of it holds NaN or infinity; calibrate again")
    return floats if floats and len(floats) == len(words) else None


class _Loader(YamlLoader):
    """Plain values, OpenCV's tags ignored."""


def _of_opencv(loader: Any, _suffix: str, node: yaml.Node) -> object:  # noqa: ANN401 - yaml's
    """Construct a node of OpenCV's YAML, whatever its tag is, as a plain mapping, list or text."""
    kind = {
        yaml.MappingNode: loader.construct_mapping,
        yaml.SequenceNode: loader.construct_sequence,
    }
    return (
        kind[type(node)](node, deep=True) if type(node) in kind else loader.construct_scalar(node)
    )


_Loader.add_multi_constructor("tag:yaml.org,2002:opencv-", _of_opencv)


_SUFFIXES = (".yaml", ".yml", ".xml")
CAMERA_SUFFIXES = (".json", *_SUFFIXES, ".txt", ".conf")
"""Suffixes of the files that a camera may be read from."""
_K = ("k", "cameramatrix", "intrinsicmatrix", "k1", "m1", "cameramatrix1", "cameramatrixleft")
_K_RIGHT = ("k2", "m2", "cameramatrix2", "cameramatrixright")
_D = ("d", "d1", "d2", "coeffs")
_P = ("p", "projectionmatrix", "p1")
_WIDTH = ("width", "imagewidth")
_HEIGHT = ("height", "imageheight")
_ROS = ("projectionmatrix", "distortionmodel", "p")
_DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_LEVEL = 1e-3
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


def facts_from_names(names: Names) -> CameraFacts | None:
    """Take the camera that some names describe; None where they describe none."""
    is_fisheye = is_fisheye_lens(names)  # may refuse what is no camera otherwise
    facts = _facts_without_lens(names)
    return None if facts is None else with_lens(facts, is_fisheye=bool(is_fisheye))


def with_lens(facts: CameraFacts, *, is_fisheye: bool) -> CameraFacts:
    """Add whether the lens is a fisheye, and the function that undistorts its images."""
    if not is_fisheye:
        return facts
    undistort = _UNDISTORT_FISHEYE if facts.baseline_m is None else _RECTIFY_FISHEYE
    return replace(facts, is_fisheye=True, undistort=undistort)


def _facts_without_lens(names: Names) -> CameraFacts | None:
    """Take the camera that names and values describe; None where they describe none.

    In this order: settings of ORB-SLAM, two projections, Q of stereoRectify, one projection, K.
    """
    if "cam0" in names and "cam1" in names:
        raise InputError(
            "a camchain of Kalibr, whose images are not rectified; 'depthpose data rectify' "
            "rectifies them and writes the camera of the result"
        )
    settings = next((prefix for prefix in ("camera", "camera1") if f"{prefix}fx" in names), None)
    if settings is not None:
        fx, fy, cx, cy = (
            scalar(names, f"{settings}{key}") or 0.0 for key in ("fx", "fy", "cx", "cy")
        )
        baseline_m = scalar(names, "stereob")
        product = scalar(names, "camerabf")
        factor = scalar(names, "depthmapfactor") or scalar(names, "rgbddepthmapfactor")
        is_rgbd = factor is not None
        if baseline_m is None and product is not None and not is_rgbd and fx > 0:
            baseline_m = product / fx  # of an RGB-D camera it is a made-up one
        return CameraFacts(
            kind="settings of ORB-SLAM",
            K=intrinsics(fx, fy, cx, cy),
            size=size_of({key: names.get(f"camera{key}") for key in ("width", "height")}),
            baseline_m=None if is_rgbd else baseline_m,
            depth_unit_m=1 / factor if factor else None,
            distortion=coefficients_of(
                {key: names.get(f"{settings}{key}") for key in _DISTORTION_KEYS}
            ),
        )
    left = published(names, _P, 12)
    right = matrix(names, ("p2",), 12)
    distortion = coefficients_of(names)
    undistort = _RECTIFY
    kind = "a camera_info of ROS" if is_ros(names) else "a camera of OpenCV"
    if right is not None:
        facts = facts_from_projections("a rig of OpenCV", _need(left, "P1"), right, size_of(names))
    elif (Q := matrix(names, ("q",), 16)) is not None:
        # (x, y, z, w) = Q (u, v, disparity, 1), with Q[3, 2] = 1 / baseline.
        with np.errstate(all="ignore"):
            baseline_m = float(1 / Q[3, 2])
        facts = CameraFacts(
            kind="a rig of OpenCV",
            K=intrinsics(Q[2, 3], Q[2, 3], -Q[0, 3], -Q[1, 3]),
            size=size_of(names),
            baseline_m=baseline_m,
            cx_right_minus_left_px=float(Q[3, 3]) * baseline_m,
        )
    elif left is not None and left[0, 0] != 0:
        if left[0, 3] == 0 and left[1, 3] == 0:  # of a single camera
            undistort = _UNDISTORT_P
            facts = facts_from_projections(kind, left, None, size_of(names))
        else:  # of the right one of a pair: Tx = -fx B, unless a third camera is at 0
            first = np.c_[left[:, :3], [0, 0, 0]]
            facts = facts_from_projections(kind, first, left, size_of(names))
            doubt = (
                "it is the right one alone, whose Tx gives a baseline of "
                f"{facts.baseline_m:g} m: that of the pair only where the left one's Tx is 0 "
                "(KITTI's is not); name the folder of both files to be sure"
            )
            facts = replace(facts, doubt=doubt)
    else:
        return _from_intrinsics(names, kind, distortion)
    return replace(facts, distortion=distortion, undistort=undistort)


def is_ros(names: Names) -> bool:
    """Whether names are those of a ``camera_info``."""
    return any(name in names for name in _ROS)


def read_two_files(folder: Path) -> tuple[Names, Names]:
    """Read the two files of a folder, in the order of their names."""
    with refused_as(folder, "folder", "check who may read it"):
        files = sorted(p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES)
    read = [read_storage(path, read_text(path, MAX_LIST_BYTES)) for path in files]
    if len(files) != 2 or None in read:
        raise InputError(
            f"a folder with {len(files)} files of {', '.join(_SUFFIXES)}; a camera of two files is "
            "left.yaml and right.yaml of ROS, or intrinsics.yml and extrinsics.yml of OpenCV, in "
            "a folder of their own"
        )
    first, second = (names for names in read if names is not None)
    return first, second


def facts_from_folder(folder: Path) -> CameraFacts:
    """Take the two files of a pair: each of a camera of ROS, or together those of OpenCV."""
    first, second = read_two_files(folder)
    if not (is_ros(first) and is_ros(second)) or "p2" in first | second:
        facts = facts_from_names(first | second)
        if facts is None:
            raise InputError("its two files together describe no camera")
        return facts
    return facts_from_ros_pair(first, second)


def facts_from_ros_pair(first: Names, second: Names) -> CameraFacts:
    """Take the two cameras of a pair."""
    left, right = ros_pair(first, second)
    P, other = (_need(published(names, _P, 12), "projection_matrix") for names in (left, right))
    facts = facts_from_projections("a pair of camera_info", P, other, size_of(first))
    coefficients = (*coefficients_of(first), *coefficients_of(second))
    facts = replace(facts, distortion=coefficients, undistort=_RECTIFY)
    are_fisheyes = [is_fisheye_lens(names_of_camera) for names_of_camera in (first, second)]
    return with_lens(facts, is_fisheye=any(are_fisheyes))


def ros_pair(first: Names, second: Names) -> tuple[Names, Names]:
    """Give the left ``camera_info`` of a pair and the right one.

    ``Tx`` is -fx times the x of a camera, from the left one or, as in KITTI, from a third.
    """
    Tx = [_need(matrix(names, _P, 12), "projection_matrix")[0, 3] for names in (first, second)]
    if Tx[0] == Tx[1]:
        raise InputError(
            f"the projections of the two camera_info have Tx {Tx[0]:g} and {Tx[1]:g}, where that "
            "of the right one is smaller by fx times the baseline; calibrate them as a pair"
        )
    if size_of(first) != size_of(second):
        raise InputError("the two camera_info are of images of two sizes; a pair has one")
    return (first, second) if Tx[0] > Tx[1] else (second, first)


def _from_intrinsics(names: Names, kind: str, distortion: tuple[float, ...]) -> CameraFacts | None:
    """Take K, or fx, fy, cx and cy; with R and T of stereoCalibrate a rectified pair."""
    K = published(names, _K, 9)
    if K is None:
        is_realsense = "ppx" in names
        keys = ("fx", "fy", "ppx", "ppy") if is_realsense else ("fx", "fy", "cx", "cy")
        values = [value for name in keys if (value := scalar(names, name)) is not None]
        if len(values) < len(keys):
            return None
        fx, fy, cx, cy = values
        return CameraFacts(
            kind="a camera of RealSense" if is_realsense else "fx, fy, cx, cy",
            K=intrinsics(fx, fy, cx, cy),
            size=size_of(names),
            baseline_m=baseline_of(names),
            depth_unit_m=scalar(names, "depthscale") if is_realsense else None,
            distortion=distortion,
        )
    facts = CameraFacts(kind=kind, K=torch.from_numpy(K), size=size_of(names))
    T = numbers(names.get("t"))  # of stereoCalibrate, as R
    R = numbers(names.get("r"))
    if T is not None and len(T) == 3:
        eye = np.eye(3).ravel()
        is_turned = R is not None and len(R) == 9 and not np.allclose(R, eye, atol=_LEVEL)
        if is_turned or max(abs(T[1]), abs(T[2])) > _LEVEL * abs(T[0]):
            raise InputError(
                "R and T of a pair that is not rectified, and no P1 and P2; rectify the images by "
                "'depthpose data rectify', or by cv2.stereoRectify and write its P1 and P2 too"
            )
        right = matrix(names, _K_RIGHT, 9)
        right = K if right is None else right
        left = np.c_[K, [0, 0, 0]]
        right = np.c_[right, [right[0, 0] * T[0], 0, 0]]
        facts = facts_from_projections(kind, left, right, size_of(names))
    return replace(facts, distortion=distortion)


def baseline_of(names: Names) -> float | None:
    """Read ``baseline_m``; a baseline under another name, whose unit is unknown, is refused."""
    for name in names:
        if name.startswith("baseline") and name != "baselinem":
            raise InputError(f"its {name!r} may be in any unit; write baseline_m, in metres")
    return scalar(names, "baselinem")


def coefficients_of(names: Names) -> tuple[float, ...]:
    """Take every coefficient of every lens: whatever is called distortion, and loose k1, p1."""
    coefficients = [scalar(names, name) for name in _DISTORTION_KEYS]
    for name, value in names.items():
        is_list = name in _D or name.startswith(("distcoef", "distortioncoef"))
        if is_list or name.startswith("distortion"):
            is_named = isinstance(value, Mapping) and "data" not in value
            inner = value.get("data") if isinstance(value, Mapping) and not is_named else value
            numbers_of_lens = numbers(list(value.values()) if is_named else value)
            if numbers_of_lens is None and is_list and inner:
                raise InputError(f"its {name} are no list of numbers; write [k1, k2, p1, p2, k3]")
            coefficients += numbers_of_lens or []
    return tuple(value for value in coefficients if value is not None)


def published(names: Names, keys: tuple[str, ...], count: int) -> np.ndarray | None:
    """Read a matrix and adapt it to the image that ROS publishes: cut to its ROI, then binned."""
    P = matrix(names, keys, count)
    if P is None:
        return None
    (left, top), _, (across, down) = _window(names)
    P[:2] -= [[left], [top]] * P[2]
    scale = np.array([[1 / across], [1 / down]])
    P[:2] = P[:2] * scale + (scale / 2 - 0.5) * P[2]
    return P


def _window(names: Names) -> tuple[Size, Size, Size]:
    """Corner and size of the ROI [px of the full image], 0 where it is all; binning."""
    inner = names.get("roi")
    roi = named(inner) if isinstance(inner, Mapping) else {}
    read = [scalar(roi, key) for key in ("xoffset", "yoffset", "width", "height")]
    read += [scalar(names, key) for key in ("binningx", "binningy")]
    left, top, width, height, across, down = (int(value or 0) for value in read)
    if min(left, top, width, height, across, down) < 0:
        raise InputError("its roi or its binning holds a negative number; write what was published")
    return (left, top), (width, height), (across or 1, down or 1)


def size_of(names: Names) -> Size | None:
    """Read the image's size, where the file has it; of ROS, that of the published image."""
    width, height = (
        next((v for name in keys if (v := scalar(names, name)) is not None), None)
        for keys in (_WIDTH, _HEIGHT)
    )
    size = numbers(names.get("imagesize") or names.get("size"))
    if width is None and size is not None and len(size) == 2:
        width, height = size
    if not width or not height:
        return None
    (left, top), (roi_width, roi_height), (across, down) = _window(names)
    if left + roi_width > width or top + roi_height > height:
        raise InputError(
            f"its roi, {roi_width}x{roi_height} at ({left}, {top}), leaves the image of "
            f"{width:g}x{height:g}; width and height are those of the full image"
        )
    return int(roi_width or width) // across, int(roi_height or height) // down


def _need(matrix: np.ndarray | None, name: str) -> np.ndarray:
    if matrix is None:
        raise InputError(f"there is no {name} of 12 numbers; write the whole pair")
    return matrix
