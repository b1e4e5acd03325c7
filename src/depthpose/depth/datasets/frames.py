"""One stereo frame on disk: where its parts lie, its calibration, and reading them.

Calibration files are those of KITTI and plain folders; the depth map of a LiDAR scan equals that of
the published Eigen evaluation to the bit.
"""

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64, Shaped
from torch import Tensor

from depthpose.core import files
from depthpose.core.camera import (
    Camera,
    StereoRig,
    check_image_matches_camera,
    read_camera,
    read_rig,
)
from depthpose.core.camera.camera_file import Matrix, kitti_matrix, plain_facts
from depthpose.core.camera.pinhole import (
    CameraFacts,
    Size,
    camera_from_facts,
    facts_from_projections,
)
from depthpose.core.errors import InputError
from depthpose.core.files.images import KITTI_UNIT
from depthpose.depth.config import TruthKind
from depthpose.depth.types import Map

_MAX_PAIRS_BYTES = 2**24
"""Of a text with a line for each pair of a folder."""


@dataclass(frozen=True, kw_only=True, eq=False)
class KittiCalibration:
    """What a KITTI calibration says of the colour pair (cameras 2 and 3) and the LiDAR."""

    rig: StereoRig  #: intrinsics, baseline and difference of the principal points
    #: homogeneous LiDAR points to homogeneous pixels of camera 2
    pixels_from_velodyne: Float64[np.ndarray, "3 4"] | None


def read_object_calibration(
    path: Path, width: int, height: int, *, is_grey: bool = False
) -> KittiCalibration:
    """Read a text of the object layout: P2, P3 and, for the LiDAR, R0_rect and Tr_velo_to_cam.

    Texts of the KITTI 2012 and 2015 sets (``P2`` or ``P_rect_02``) are read too, and those of
    odometry, whose ``Tr`` goes to the rectified camera 0; of the grey pair, P0 and P1.
    """
    keys = files.read_key_values(path)
    names = ("P2", "P3") if "P2" in keys else ("P_rect_02", "P_rect_03")
    names = ("P0", "P1") if is_grey else names
    rig, left = _projected_rig(path, keys, names, (width, height))
    moved = next((name for name in ("Tr_velo_to_cam", "Tr") if name in keys), None)
    if moved is None:
        return KittiCalibration(rig=rig, pixels_from_velodyne=None)
    rectify = np.eye(3) if moved == "Tr" else kitti_matrix(path, keys, "R0_rect", (3, 3))
    composed = _composed(path, left, rectify, kitti_matrix(path, keys, moved, (3, 4)))
    return KittiCalibration(rig=rig, pixels_from_velodyne=composed)


def read_plain_calibration(path: Path, name: str, width: int, height: int) -> StereoRig:
    """Read a plain folder's ``calib.txt``.

    Either ``focal_px``, ``cx``, ``cy`` and ``baseline_m`` for all pairs, a line each, or one line
    a pair: ``name width height focal_px cx cy baseline_m``, which may go on with ``focal_y_px
    cx_right_minus_left_px``.
    """
    text = files.read_text(path, _MAX_PAIRS_BYTES)
    if re.search(r"^[ \t]*focal_px[ \t]*:", text, re.MULTILINE):
        keys = files.read_key_values(path)
        return _rig(path, plain_facts(path, keys), (width, height))
    lines = re.findall(rf"^[ \t]*{re.escape(name)}[ \t]+(.+)$", text, re.MULTILINE)
    of_frame: list[list[float]] = []
    for line in lines:
        numbers: list[float] = []
        with suppress(ValueError):  # what begins the line counts
            for word in line.split():
                numbers.append(float(word))  # noqa: PERF401  those before an error stay
        of_frame += [numbers] if len(numbers) >= 6 else []
    if lines and not of_frame:
        raise InputError(
            f"{path}: the line of {name!r} is no calibration: {lines[0][:80]!r} does not begin "
            "with six numbers, width height focal_px cx cy baseline_m"
        )
    if len(of_frame) > 1:
        raise InputError(f"{path}: {len(of_frame)} lines for {name!r}. Keep one of them.")
    if not of_frame:
        raise InputError(
            f"{path}: neither 'focal_px: ...' nor a line '{name} width height focal_px cx cy "
            "baseline_m'. Write focal_px, cx, cy and baseline_m, a line each."
        )
    try:
        numbers = of_frame[0] if len(of_frame[0]) == 8 else of_frame[0][:6]
        size = int(numbers[0]), int(numbers[1])
        names = ("focal_px", "cx", "cy", "baseline_m", "focal_y_px", "cx_right_minus_left_px")
        values: dict[str, list[float]] = {n: [v] for n, v in zip(names, numbers[2:], strict=False)}
        return _rig(path, replace(plain_facts(path, values), size=size), size)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: the line of {name!r} is no calibration ({error}).") from error


def _rig(path: Path, facts: CameraFacts, size: Size | None) -> StereoRig:
    """Make the rig of a calibration; the path names it in errors."""
    try:
        rig = camera_from_facts(facts, size)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    assert isinstance(rig, StereoRig), "datasets name both cameras"
    return rig


def _projected_rig(
    path: Path, keys: Mapping[str, list[float]], names: tuple[str, str], size: Size
) -> tuple[StereoRig, Matrix]:
    """The rig of two projections, and that of the left camera."""
    left, right = (kitti_matrix(path, keys, name, (3, 4)) for name in names)
    sides = keys.get("S_rect_02", [])  # of the rectified images
    declared = (int(sides[0]), int(sides[1])) if len(sides) == 2 else size
    if declared != size:
        raise InputError(
            f"{path}: S_rect_02 says {declared[0]}x{declared[1]}, but the image is "
            f"{size[0]}x{size[1]}. It was cropped or scaled: give its own calibration, in a "
            "folder of pairs."
        )
    try:
        facts = facts_from_projections("a KITTI calibration", left, right)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return _rig(path, facts, size), left


def _composed(
    path: Path,
    left: Float64[np.ndarray, "3 4"],
    rectify: Float64[np.ndarray, "3 3"],
    camera_from_velodyne: Float64[np.ndarray, "3 4"],
) -> Float64[np.ndarray, "3 4"]:
    """Compose the transform of LiDAR points to pixels; 3x3 and 3x4 parts are extended to 4x4."""
    turned = np.eye(4)
    moved = np.eye(4)
    turned[:3, :3] = rectify
    moved[:3] = camera_from_velodyne
    with np.errstate(all="ignore"):
        composed = left @ turned @ moved
    if not np.isfinite(composed).all():
        raise InputError(f"{path}: its matrices multiply to infinity. Copy the file anew.")
    return composed


LidarDepth = Literal["velodyne_x", "camera_z"]


def project_lidar(
    points: Float[Tensor, "n 4"],
    pixels_from_velodyne: Float64[np.ndarray, "3 4"],
    size: tuple[int, int],
    depth: LidarDepth,
) -> Map:
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
    # The last point of a pixel wins: keep one write a pixel, for NumPy promises no order.
    value_m = value_m[is_inside]
    written = np.zeros((height, width))
    pixels, last = np.unique((v * width + u)[::-1], return_index=True)
    written.flat[pixels] = value_m[::-1][last]
    shared = v * (width - 1) + u - 1
    index, first, count = np.unique(shared, return_index=True, return_counts=True)
    smallest = np.full(len(index), np.inf)
    np.minimum.at(smallest, np.searchsorted(index, shared), value_m)
    # Colliding groups never write the same pixel twice: each pixel has one shared index.
    again = count > 1
    written[v[first[again]], u[first[again]]] = smallest[again]
    written[written < 0] = 0
    with np.errstate(over="ignore"):
        as_float32 = torch.from_numpy(written.astype(np.float32))
    return torch.where(as_float32 > 0, as_float32, torch.nan)


CalibrationStyle = Literal["raw", "object", "grey", "middlebury", "plain", "camera"]


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Paths of one frame; None where the dataset has no such file."""

    name: str  #: unique in its dataset and usable as a file name
    left: Path  #: left image (camera 2 of KITTI)
    right: Path | None = None  #: right image (camera 3)
    calibration: Path | None = None  #: file, or for ``raw`` the folder of the date
    style: CalibrationStyle = "plain"  #: how the calibration is written
    velodyne: Path | None = None  #: one LiDAR scan, float32 x, y, z, reflectance
    #: a LiDAR scan that was drawn into the left image already, 16-bit camera z, metres x 256
    #: (``velodyne_raw`` of KITTI's depth-prediction set)
    scan: Path | None = None
    #: depth of the left image, 16-bit PNG (metres x 256), or PFM or NPY in metres
    depth: Path | None = None
    #: disparity of the left image, 16-bit PNG (x 256), PFM or NPY, hidden pixels too
    disparity: Path | None = None
    disparity_noc: Path | None = None  #: that of the pixels alone that both views see
    sky: Path | None = None  #: 8-bit PNG of the left image, not 0 where it shows the sky

    def seen_files(self, *, with_right: bool = True) -> list[Path]:
        """List what an estimate depends on: left image, right image, files of the calibration."""
        paths = [self.left]
        if with_right and self.right is not None:
            paths.append(self.right)
        if self.calibration is not None and self.calibration.is_dir():
            paths += sorted(self.calibration.glob("calib_*.txt"))
        elif self.calibration is not None:
            paths.append(self.calibration)
        return paths


def frame_camera(frame: Frame) -> Camera | None:
    """Read the camera of a frame, or None where it has no calibration; of a pair, the rig."""
    if frame.calibration is None:
        return None
    path = frame.calibration
    size = files.image_size(frame.left)
    match frame.style:
        case "raw" | "object" | "grey":
            camera = kitti_calibration(frame).rig
        case "middlebury":
            camera = read_rig(path)
        case "camera":
            camera = read_camera(path, size) if frame.right is None else read_rig(path, size)
        case "plain":
            camera = read_plain_calibration(path, frame.name, *size)
    check_image_matches_camera(camera, *size, str(frame.left))
    return camera


def kitti_calibration(frame: Frame) -> KittiCalibration:
    """Read rig and LiDAR projection of a frame in KITTI's raw or object layout.

    Raises:
        InputError: the frame has no such calibration.
    """
    if frame.calibration is None or frame.style not in ("raw", "object", "grey"):
        raise InputError(
            f"{frame.name}: no KITTI calibration, so its LiDAR scan cannot be projected. Put "
            "calib_cam_to_cam.txt and calib_velo_to_cam.txt into the folder of its date."
        )
    home = frame.calibration
    size = files.image_size(frame.left)
    if frame.style != "raw":
        return read_object_calibration(home, *size, is_grey=frame.style == "grey")
    cameras = home / "calib_cam_to_cam.txt"
    lidar = home / "calib_velo_to_cam.txt"
    keys = files.read_key_values(cameras)
    rig, left = _projected_rig(cameras, keys, ("P_rect_02", "P_rect_03"), size)
    if not lidar.is_file():
        return KittiCalibration(rig=rig, pixels_from_velodyne=None)
    rectify = kitti_matrix(cameras, keys, "R_rect_00", (3, 3))
    of_lidar = files.read_key_values(lidar)
    R = kitti_matrix(lidar, of_lidar, "R", (3, 3))
    t = kitti_matrix(lidar, of_lidar, "T", (3, 1))
    composed = _composed(lidar, left, rectify, np.hstack([R, t]))
    return KittiCalibration(rig=rig, pixels_from_velodyne=composed)


def known_truths(frame: Frame) -> tuple[TruthKind, ...]:
    """Give the kinds of truth that a frame has."""
    kinds: dict[TruthKind, bool] = {
        "scan": has_lidar(frame, "camera_z"),
        "annotated": frame.depth is not None and frame.depth != _drawn_scan(frame),
        "disparity": frame.disparity is not None,
    }
    return tuple(kind for kind, is_there in kinds.items() if is_there)


def has_lidar(frame: Frame, depth: LidarDepth) -> bool:
    """Whether :func:`lidar_truth` has something to draw."""
    return frame.velodyne is not None or (depth == "camera_z" and _drawn_scan(frame) is not None)


def lidar_truth(frame: Frame, depth: LidarDepth) -> Map:
    """Draw the LiDAR scan of a frame into its left image; NaN where no point falls.

    Where there is no scan but a drawn one (``lidar_depth/`` of a plain folder, ``velodyne_raw`` of
    KITTI's depth-prediction set; camera z), it is taken for ``camera_z`` as it is.

    Raises:
        InputError: no scan (see :func:`has_lidar`), or one without calibration.
    """
    drawn = _drawn_scan(frame)
    if frame.velodyne is None and drawn is not None and depth == "camera_z":
        depth_m = read_depth(drawn)
        check_map_size(drawn, depth_m, files.image_size(frame.left))
        return depth_m
    if frame.velodyne is None:
        raise InputError(f"{frame.name}: has no LiDAR scan of the kind {depth}.")
    pixels_from_velodyne = kitti_calibration(frame).pixels_from_velodyne
    if pixels_from_velodyne is None:
        raise InputError(
            f"{frame.name}: its calibration says nothing of the LiDAR; calib_velo_to_cam.txt (or "
            "Tr_velo_to_cam in an object text) is missing."
        )
    width, height = files.image_size(frame.left)
    points = files.read_points_bin(frame.velodyne)
    return project_lidar(points, pixels_from_velodyne, (height, width), depth)


def _drawn_scan(frame: Frame) -> Path | None:
    """Give the map of a LiDAR scan: the depth of a plain folder of pairs is one."""
    is_plain = frame.style in ("plain", "camera") and frame.scan is None
    return frame.depth if is_plain else frame.scan


def check_map_size(path: Path, values: Shaped[Tensor, "*any h w"], size: tuple[int, int]) -> None:
    """Refuse a map of another size than its left image, (width, height)."""
    height, width = values.shape[-2:]
    if (width, height) != size:
        raise InputError(
            f"{path}: is {width}x{height}, but its left image is {size[0]}x{size[1]}; "
            "do the two belong together?"
        )


def read_disparity(path: Path) -> Map:
    """Read true disparity from a 16-bit PNG or TIFF, a TIFF of floats, PFM or NPY.

    NaN where it is unknown, 0 or below, or so large that no pixel of the right image is meant.
    """
    values = read_depth(path)
    return torch.where(values < values.shape[1], values, torch.nan)


def read_depth(path: Path) -> Map:
    """Read true depth [m] as :func:`read_disparity`, of 16 bits x 256; NaN where it is unknown."""
    values = (
        files.read_map(path)
        if path.suffix.lower() in files.MAP_SUFFIXES
        else files.read_stored_depth(path)
    )
    if not values.is_floating_point():
        values = values * KITTI_UNIT
    return torch.where((values > 0) & (values < torch.inf), values, torch.nan)
