"""Calibration files to a rig and a LiDAR projection, and one scan as a sparse depth map.

Files are those of KITTI and plain folders; the depth map of a scan equals that of the
published Eigen evaluation to the bit.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.camera.camera_file import (
    Matrix,
    kitti_matrix,
    kitti_size,
    plain_facts,
)
from depthpose.core.camera.pinhole import (
    CameraFacts,
    Size,
    camera_from_facts,
    facts_from_projections,
)
from depthpose.core.errors import InputError
from depthpose.core.files import read_key_values, read_text

_MAX_PAIRS_BYTES = 2**24
"""Of a text with a line for each pair of a folder."""


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
    left = kitti_matrix(cameras, keys, "P_rect_02", (3, 4))
    _check_size(cameras, keys, width, height)
    right = kitti_matrix(cameras, keys, "P_rect_03", (3, 4))
    rig = _projected_rig(cameras, left, right, (width, height))
    lidar = folder / "calib_velo_to_cam.txt"
    if not lidar.is_file():
        return KittiCalibration(rig=rig, pixels_from_velodyne=None)
    rectify = _square(kitti_matrix(cameras, keys, "R_rect_00", (3, 3)))
    of_lidar = read_key_values(lidar)
    R, t = kitti_matrix(lidar, of_lidar, "R", (3, 3)), kitti_matrix(lidar, of_lidar, "T", (3, 1))
    composed = _compose(lidar, left, rectify, _square(np.hstack([R, t])))
    return KittiCalibration(rig=rig, pixels_from_velodyne=composed)


def read_object_calibration(
    path: Path, width: int, height: int, *, is_grey: bool = False
) -> KittiCalibration:
    """Read a text of the object layout: P2, P3 and, for the LiDAR, R0_rect and Tr_velo_to_cam.

    Texts of the KITTI 2012 and 2015 sets (``P2`` or ``P_rect_02``) are read too, and those of
    odometry, whose ``Tr`` goes to the rectified camera 0; of the grey pair, P0 and P1.

    Raises:
        InputError: missing, or a matrix missing or of the wrong size.
    """
    keys = read_key_values(path)
    names = ("P2", "P3") if "P2" in keys else ("P_rect_02", "P_rect_03")
    names = ("P0", "P1") if is_grey else names
    left, right = (kitti_matrix(path, keys, name, (3, 4)) for name in names)
    _check_size(path, keys, width, height)
    rig = _projected_rig(path, left, right, (width, height))
    moved = next((name for name in ("Tr_velo_to_cam", "Tr") if name in keys), None)
    if moved is None:
        return KittiCalibration(rig=rig, pixels_from_velodyne=None)
    turned = np.eye(3) if moved == "Tr" else kitti_matrix(path, keys, "R0_rect", (3, 3))
    rectify, camera_from_velodyne = (
        _square(turned),
        _square(kitti_matrix(path, keys, moved, (3, 4))),
    )
    composed = _compose(path, left, rectify, camera_from_velodyne)
    return KittiCalibration(rig=rig, pixels_from_velodyne=composed)


def read_plain_calibration(path: Path, name: str, width: int, height: int) -> StereoRig:
    """Read a plain folder's ``calib.txt``.

    Either ``focal_px``, ``cx``, ``cy`` and ``baseline_m`` for all pairs, a line each, or one line
    a pair: ``name width height focal_px cx cy baseline_m``, which may go on with ``focal_y_px
    cx_right_minus_left_px``.

    Raises:
        InputError: a value missing, or no line for this pair.
    """
    text = read_text(path, _MAX_PAIRS_BYTES)
    if re.search(r"^[ \t]*focal_px[ \t]*:", text, re.MULTILINE):
        keys = read_key_values(path)
        return _rig(path, plain_facts(path, keys), (width, height))
    lines = re.findall(rf"^[ \t]*{re.escape(name)}[ \t]+(.+)$", text, re.MULTILINE)
    own = [numbers for line in lines if len(numbers := _numbers_of(line)) >= 6]
    if lines and not own:
        raise InputError(
            f"{path}: the line of {name!r} is no calibration: {lines[0][:80]!r} does not begin "
            "with six numbers, width height focal_px cx cy baseline_m"
        )
    if len(own) > 1:
        raise InputError(f"{path}: {len(own)} lines for {name!r}. Keep one of them.")
    if not own:
        raise InputError(
            f"{path}: neither 'focal_px: ...' nor a line '{name} width height focal_px cx cy "
            "baseline_m'. Write focal_px, cx, cy and baseline_m, a line each."
        )
    try:
        numbers = own[0] if len(own[0]) == 8 else own[0][:6]
        size = int(numbers[0]), int(numbers[1])
        names = ("focal_px", "cx", "cy", "baseline_m", "focal_y_px", "cx_right_minus_left_px")
        values: dict[str, list[float]] = {n: [v] for n, v in zip(names, numbers[2:], strict=False)}
        return _rig(path, replace(plain_facts(path, values), size=size), size)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: the line of {name!r} is no calibration ({error}).") from error


def _numbers_of(line: str) -> list[float]:
    """Give the numbers that begin a line."""
    numbers = list[float]()
    for word in line.split():
        try:
            numbers.append(float(word))
        except ValueError:
            break
    return numbers


def _rig(path: Path, facts: CameraFacts, size: Size | None) -> StereoRig:
    try:
        rig = camera_from_facts(facts, size)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    assert isinstance(rig, StereoRig), "datasets name both cameras"
    return rig


def _projected_rig(path: Path, left: Matrix, right: Matrix, size: Size) -> StereoRig:
    try:
        facts = facts_from_projections("a KITTI calibration", left, right)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return _rig(path, facts, size)


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
    size = kitti_size(keys) or (width, height)
    if size != (width, height):
        raise InputError(
            f"{path}: S_rect_02 says {size[0]}x{size[1]}, but the image is {width}x{height}. It "
            "was cropped or scaled: give its own calibration, in a folder of pairs."
        )


def _square(matrix: Matrix) -> Float64[np.ndarray, "4 4"]:
    """Extend a 3x3 rotation or a 3x4 transform to 4x4."""
    extended = np.eye(4)
    extended[: matrix.shape[0], : matrix.shape[1]] = matrix
    return extended


LidarDepth = Literal["velodyne_x", "camera_z"]


def project_lidar(
    points: Float[Tensor, "n 4"],
    pixels_from_velodyne: Float64[np.ndarray, "3 4"],
    size: tuple[int, int],
    depth: LidarDepth,
) -> Float[Tensor, "h w"]:
    """Draw a scan into camera 2; NaN where no point falls. No interpolation.

    Points behind the scanner are dropped, pixels are rounded half to even and then moved by -1
    (KITTI's Matlab indices), points are written in file order, and where several share the index
    ``v (W - 1) + u - 1`` the smallest depth goes to the first such point's pixel. That index is
    not one to one, (v, W - 1) and (v + 1, 0) collide, so border columns differ from a true minimum;
    the published script does so, and its numbers are kept.

    Args:
        points: x forward, y left, z up [m], reflectance, in file order.
        pixels_from_velodyne: see :class:`KittiCalibration`.
        size: height and width of the image.
        depth: ``velodyne_x``, the published protocol's (about 0.27 m more), or ``camera_z``.
    """
    height, width = size
    homogeneous = points.numpy().astype(np.float32).copy()
    homogeneous[:, 3] = 1.0
    homogeneous = homogeneous[homogeneous[:, 0] >= 0]
    with np.errstate(all="ignore"):  # points on the plane of the camera divide by zero
        projected = (pixels_from_velodyne @ homogeneous.T.astype(np.float64)).T
        pixel = np.round(projected[:, :2] / projected[:, 2:3]) - 1
    value_m = homogeneous[:, 0].astype(np.float64) if depth == "velodyne_x" else projected[:, 2]
    is_inside = ((pixel >= 0) & (pixel < (width, height))).all(1)
    u, v = pixel[is_inside].astype(np.int64).T
    written = _write_in_order(u, v, value_m[is_inside], (height, width))
    written[written < 0] = 0
    with np.errstate(over="ignore"):
        as_float32 = torch.from_numpy(written.astype(np.float32))
    return torch.where(as_float32 > 0, as_float32, torch.nan)


def _write_in_order(
    u: np.ndarray, v: np.ndarray, value_m: Float64[np.ndarray, " n"], size: tuple[int, int]
) -> Float64[np.ndarray, "h w"]:
    height, width = size
    canvas = np.zeros((height, width))
    # The last point of a pixel wins: keep one write a pixel, for NumPy promises no order.
    flat = v * width + u
    last_of_reversed = np.unique(flat[::-1], return_index=True)
    canvas.flat[last_of_reversed[0]] = value_m[::-1][last_of_reversed[1]]
    shared = v * (width - 1) + u - 1
    index, first, count = np.unique(shared, return_index=True, return_counts=True)
    smallest = np.full(len(index), np.inf)
    np.minimum.at(smallest, np.searchsorted(index, shared), value_m)
    # Colliding groups never write the same pixel twice: each pixel has one shared index.
    again = count > 1
    canvas[v[first[again]], u[first[again]]] = smallest[again]
    return canvas
