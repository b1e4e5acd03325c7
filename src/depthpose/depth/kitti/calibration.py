"""Calibration texts of KITTI, Middlebury and plain folders to a rig and a LiDAR projection."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError
from depthpose.core.files import read_key_values, read_text

Matrix = Float64[np.ndarray, "rows columns"]


@dataclass(frozen=True, kw_only=True, eq=False)
class KittiCalibration:
    """What a KITTI calibration says of the colour pair (cameras 2 and 3) and the LiDAR.

    Attributes:
        rig: intrinsics, baseline and difference of the principal points.
        pixels_from_velodyne: homogeneous LiDAR points to homogeneous pixels of camera 2.
    """

    rig: StereoRig
    pixels_from_velodyne: Float64[np.ndarray, "3 4"] | None


def read_raw_calibration(folder: Path, width: int, height: int) -> KittiCalibration:
    """Read a date's ``calib_cam_to_cam.txt`` and, where it is, ``calib_velo_to_cam.txt``.

    Raises:
        InputError: missing, or a matrix missing or of the wrong size.
    """
    cameras = folder / "calib_cam_to_cam.txt"
    keys = read_key_values(cameras)
    left = _matrix(cameras, keys, "P_rect_02", (3, 4))
    _check_size(cameras, keys, width, height)
    rig = _rig(cameras, left, _matrix(cameras, keys, "P_rect_03", (3, 4)), width, height)
    lidar = folder / "calib_velo_to_cam.txt"
    if not lidar.is_file():
        return KittiCalibration(rig=rig, pixels_from_velodyne=None)
    rectify = _square(_matrix(cameras, keys, "R_rect_00", (3, 3)))
    of_lidar = read_key_values(lidar)
    R, t = _matrix(lidar, of_lidar, "R", (3, 3)), _matrix(lidar, of_lidar, "T", (3, 1))
    composed = _compose(lidar, left, rectify, _square(np.hstack([R, t])))
    return KittiCalibration(rig=rig, pixels_from_velodyne=composed)


def read_object_calibration(path: Path, width: int, height: int) -> KittiCalibration:
    """Read a text of the object layout: P2, P3 and, for the LiDAR, R0_rect and Tr_velo_to_cam.

    Texts of the KITTI 2012 and 2015 sets (``P2`` or ``P_rect_02``) are read too.

    Raises:
        InputError: missing, or a matrix missing or of the wrong size.
    """
    keys = read_key_values(path)
    names = ("P2", "P3") if "P2" in keys else ("P_rect_02", "P_rect_03")
    left, right = (_matrix(path, keys, name, (3, 4)) for name in names)
    _check_size(path, keys, width, height)
    rig = _rig(path, left, right, width, height)
    if "Tr_velo_to_cam" not in keys:
        return KittiCalibration(rig=rig, pixels_from_velodyne=None)
    rectify = _square(_matrix(path, keys, "R0_rect", (3, 3)))
    camera_from_velodyne = _square(_matrix(path, keys, "Tr_velo_to_cam", (3, 4)))
    composed = _compose(path, left, rectify, camera_from_velodyne)
    return KittiCalibration(rig=rig, pixels_from_velodyne=composed)


def read_middlebury_calibration(path: Path) -> StereoRig:
    """Read Middlebury 2014's ``calib.txt``: cam0, doffs, baseline in millimetres, size.

    Raises:
        InputError: missing, or a value missing or not a number.
    """
    text = read_text(path)
    found = dict(re.findall(r"^(\w+)=(.*)$", text, re.MULTILINE))
    try:
        rows = [row.split() for row in found["cam0"].strip().strip("[]").split(";")]
        K = torch.tensor([[float(value) for value in row] for row in rows], dtype=torch.float64)
        return StereoRig(
            width=int(found["width"]),
            height=int(found["height"]),
            K=K,
            baseline_m=float(found["baseline"]) / 1000,
            cx_right_minus_left_px=float(found["doffs"]),
        )
    except KeyError as error:
        raise InputError(
            f"{path}: has no line {error.args[0]}=...; a Middlebury calib.txt holds cam0, doffs, "
            "baseline, width and height."
        ) from error
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: not a Middlebury calibration ({error}).") from error


def read_plain_calibration(path: Path, name: str, width: int, height: int) -> StereoRig:
    """Read a plain folder's ``calib.txt``.

    Either ``focal_px``, ``cx``, ``cy`` and ``baseline_m`` for all pairs, a line each, or one line
    a pair: ``name width height focal_px cx cy baseline_m``.

    Raises:
        InputError: a value missing, or no line for this pair.
    """
    text = read_text(path)
    if re.search(r"^\s*focal_px\s*:", text, re.MULTILINE):
        keys = read_key_values(path)
        values = [_number(path, keys, key) for key in ("focal_px", "cx", "cy", "baseline_m")]
        size = [int(_number(path, keys, key)) if key in keys else side
                for key, side in (("width", width), ("height", height))]  # fmt: skip
        return _simple_rig(path, size, values)
    own = [words for line in text.splitlines() if (words := line.split()) and words[0] == name]
    if len(own) > 1:
        raise InputError(f"{path}: {len(own)} lines for {name!r}. Keep one of them.")
    if not own or len(own[0]) < 7:
        raise InputError(
            f"{path}: neither 'focal_px: ...' nor a line '{name} width height focal_px cx cy "
            "baseline_m'. Write focal_px, cx, cy and baseline_m, a line each."
        )
    try:
        numbers = [float(word) for word in own[0][1:7]]
        return _simple_rig(path, [int(numbers[0]), int(numbers[1])], numbers[2:])
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: the line of {name!r} is no calibration ({error}).") from error


def _simple_rig(path: Path, size: list[int], values: list[float]) -> StereoRig:
    focal_px, cx, cy, baseline_m = values
    K = torch.tensor([[focal_px, 0, cx], [0, focal_px, cy], [0, 0, 1]], dtype=torch.float64)
    return _built(path, size[0], size[1], K, baseline_m, 0.0)


def _rig(path: Path, left: Matrix, right: Matrix, width: int, height: int) -> StereoRig:
    """Derive the rig from two projections: f = P2[0,0], B = b3 - b2 with b = -P[0,3] / P[0,0]."""
    if not (left[0, 0] > 0 and right[0, 0] > 0):
        raise InputError(f"{path}: the focal lengths of cameras 2 and 3 are not positive.")
    with np.errstate(all="ignore"):  # what overflows is refused as a baseline
        baseline_m = -right[0, 3] / right[0, 0] + left[0, 3] / left[0, 0]
        difference_px = right[0, 2] - left[0, 2]
    K = torch.from_numpy(left[:, :3].copy())
    return _built(path, width, height, K, float(baseline_m), float(difference_px))


def _compose(
    path: Path,
    left: Matrix,
    rectify: Float64[np.ndarray, "4 4"],
    camera_from_velodyne: Float64[np.ndarray, "4 4"],
) -> Float64[np.ndarray, "3 4"]:
    with np.errstate(all="ignore"):
        composed = left @ rectify @ camera_from_velodyne
    if not np.isfinite(composed).all():
        raise InputError(f"{path}: its matrices multiply to infinity. Copy the file anew.")
    return composed


def _check_size(path: Path, keys: Mapping[str, list[float]], width: int, height: int) -> None:
    size = keys.get("S_rect_02", [width, height])
    if size != [width, height]:
        said = "x".join(f"{number:g}" for number in size)
        raise InputError(
            f"{path}: S_rect_02 says {said}, but the image is {width}x{height}. It was cropped or "
            "scaled: give its own calibration, in a folder of pairs."
        )


def _built(
    path: Path, width: int, height: int, K: torch.Tensor, baseline_m: float, difference_px: float
) -> StereoRig:
    try:
        return StereoRig(width=width, height=height, K=K, baseline_m=baseline_m,
                         cx_right_minus_left_px=difference_px)  # fmt: skip
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _matrix(
    path: Path, keys: Mapping[str, list[float]], name: str, shape: tuple[int, int]
) -> Matrix:
    if name not in keys:
        raise InputError(f"{path}: has no line '{name}:', which a KITTI calibration holds.")
    if len(keys[name]) != shape[0] * shape[1]:
        raise InputError(
            f"{path}: {name} holds {len(keys[name])} numbers instead of {shape[0] * shape[1]}. "
            "Copy the file anew."
        )
    return np.array(keys[name], dtype=np.float64).reshape(shape)


def _square(matrix: Matrix) -> Float64[np.ndarray, "4 4"]:
    """Extend a 3x3 rotation or a 3x4 transform to 4x4."""
    extended = np.eye(4)
    extended[: matrix.shape[0], : matrix.shape[1]] = matrix
    return extended


def _number(path: Path, keys: Mapping[str, list[float]], name: str) -> float:
    if len(keys.get(name, [])) != 1:
        raise InputError(f"{path}: '{name}: NUMBER' is missing or holds several numbers.")
    return keys[name][0]
