"""One stereo frame on disk: the paths of its files, its calibration, and its truth.

Calibration files are those of KITTI and of plain folders. The depth map of a LiDAR scan equals that
of the published Eigen evaluation to the bit.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

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
from depthpose.core.camera.formats.camera_file import (
    KITTI_COLOR,
    KITTI_GREY,
    KittiPair,
    Matrix,
    choose_kitti_pair,
    facts_from_lines,
    prefixed_errors,
    read_kitti_size,
    read_matrix,
)
from depthpose.core.camera.formats.facts import (
    CameraFacts,
    camera_from_facts,
    facts_from_projections,
)
from depthpose.core.camera.pinhole import Size
from depthpose.core.errors import InputError
from depthpose.core.files.images import KITTI_UNIT
from depthpose.depth.config import TruthKind
from depthpose.depth.types import Map

_MAX_PAIRS_BYTES = 2**24
"""Largest calibration file with a line for each pair of a folder."""


@dataclass(frozen=True, kw_only=True, eq=False)
class KittiCalibration:
    """KITTI's calibration of the colour pair (cameras 2 and 3, or the grey pair) and the LiDAR."""

    rig: StereoRig  #: intrinsics, baseline and difference of the principal points
    #: maps homogeneous LiDAR points to homogeneous pixels of the left camera; None where the files
    #: have no calibration of the LiDAR
    pixels_from_velodyne: Float64[np.ndarray, "3 4"] | None


def read_object_calibration(
    path: Path, width: int, height: int, *, is_grey: bool = False
) -> KittiCalibration:
    """Read a calibration of the object layout: P2, P3 and, for the LiDAR, R0_rect, Tr_velo_to_cam.

    Files of the KITTI 2012 and 2015 sets (``P2`` or ``P_rect_02``) are read too, and those of
    odometry, whose ``Tr`` is a transform to the rectified camera 0.

    Args:
        path: the file.
        width: width of the images [px].
        height: height of the images [px].
        is_grey: read the grey pair, P0 and P1, in place of the colour pair.

    Raises:
        InputError: a matrix is missing or damaged, or the file is of images of another size.
    """
    keys = files.read_key_values(path)
    pair = choose_kitti_pair(keys, KITTI_GREY if is_grey else KITTI_COLOR)
    rig, left = _rig_from_projections(path, keys, pair, (width, height))

    # The LiDAR.
    if "Tr_velo_to_cam" in keys:
        camera_from_velodyne = read_matrix(path, keys, "Tr_velo_to_cam", (3, 4))
        rectify = read_matrix(path, keys, "R0_rect", (3, 3))
    elif "Tr" in keys:
        camera_from_velodyne = read_matrix(path, keys, "Tr", (3, 4))
        rectify = np.eye(3)
    else:
        return KittiCalibration(rig=rig, pixels_from_velodyne=None)
    pixels_from_velodyne = _compose_projection(path, left, rectify, camera_from_velodyne)
    return KittiCalibration(rig=rig, pixels_from_velodyne=pixels_from_velodyne)


def read_plain_calibration(path: Path, name: str, width: int, height: int) -> StereoRig:
    """Read a plain folder's ``calib.txt``.

    The file has either ``focal_px``, ``cx``, ``cy`` and ``baseline_m`` for all pairs, a line each;
    or one line for each pair, ``name width height focal_px cx cy baseline_m``, which may continue
    with ``focal_y_px cx_right_minus_left_px``.

    Args:
        path: the file.
        name: name of the pair.
        width: width of the images [px].
        height: height of the images [px].

    Raises:
        InputError: there is no calibration of the pair, several, or one that is damaged.
    """
    text = files.read_text(path, _MAX_PAIRS_BYTES)
    if re.search(r"^[ \t]*focal_px[ \t]*:", text, re.MULTILINE):
        keys = files.read_key_values(path)
        return _make_rig(path, facts_from_lines(path, keys), (width, height))

    # The line of the pair; other pairs' names may begin with this one's, and a space. Such a name
    # may go on with numbers, which would be another image size.
    lines = re.findall(rf"^[ \t]*{re.escape(name)}[ \t]+(.+)$", text, re.MULTILINE)
    numbers_of_lines = [_parse_leading_numbers(line) for line in lines]
    calibrations = [numbers for numbers in numbers_of_lines if len(numbers) in (6, 8)]
    if lines and not calibrations:
        raise InputError(
            f"{path}: the line of {name!r} is no calibration: {lines[0][:80]!r} does not begin "
            "with six numbers, width height focal_px cx cy baseline_m, or with eight, which go on "
            "with focal_y_px cx_right_minus_left_px"
        )
    if len(calibrations) > 1:
        of_image_size = [numbers for numbers in calibrations if numbers[:2] == [width, height]]
        calibrations = of_image_size or calibrations
    if len(calibrations) > 1:
        raise InputError(f"{path}: {len(calibrations)} lines for {name!r}. Keep one of them.")
    if not calibrations:
        raise InputError(
            f"{path}: neither 'focal_px: ...' nor a line '{name} width height focal_px cx cy "
            "baseline_m'. Write focal_px, cx, cy and baseline_m, a line each."
        )
    (numbers,) = calibrations
    columns = ("focal_px", "cx", "cy", "baseline_m", "focal_y_px", "cx_right_minus_left_px")
    values = {column: [number] for column, number in zip(columns, numbers[2:], strict=False)}
    try:
        size = int(numbers[0]), int(numbers[1])
        return _make_rig(path, replace(facts_from_lines(path, values), size=size), size)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: the line of {name!r} is no calibration ({error}).") from error


def _parse_leading_numbers(line: str) -> list[float]:
    """Return the numbers with which a line begins, up to the first word that is none."""
    numbers: list[float] = []
    for word in line.split():
        try:
            numbers.append(float(word))
        except ValueError:
            break
    return numbers


def _make_rig(path: Path, facts: CameraFacts, size: Size | None) -> StereoRig:
    """Make the rig of a calibration, whose file ``path`` is named in errors."""
    with prefixed_errors(path):
        rig = camera_from_facts(facts, size)
    assert isinstance(rig, StereoRig), "datasets name both cameras"
    return rig


def _rig_from_projections(
    path: Path, keys: Mapping[str, list[float]], pair: KittiPair, size: Size
) -> tuple[StereoRig, Matrix]:
    """Make the rig of a calibration's two projections, and return it with the left projection.

    Args:
        path: the file, for errors.
        keys: what it holds.
        pair: which keys are those of both cameras.
        size: width and height of the images.

    Raises:
        InputError: a projection is missing or damaged, or of images of another size.
    """
    left, right = (read_matrix(path, keys, name, (3, 4)) for name in (pair.left, pair.right))
    stated_size = read_kitti_size(keys, pair) or size
    if stated_size != size:
        raise InputError(
            f"{path}: {pair.size} says {stated_size[0]}x{stated_size[1]}, but the image is "
            f"{size[0]}x{size[1]}. It was cropped or scaled: give its own calibration, in a "
            "folder of pairs."
        )
    with prefixed_errors(path):
        facts = facts_from_projections("a KITTI calibration", left, right)
    return _make_rig(path, facts, size), left


def _compose_projection(
    path: Path,
    left: Float64[np.ndarray, "3 4"],
    rectify: Float64[np.ndarray, "3 3"],
    camera_from_velodyne: Float64[np.ndarray, "3 4"],
) -> Float64[np.ndarray, "3 4"]:
    """Multiply three matrices to the projection of LiDAR points to pixels of the left camera.

    Args:
        path: the file that they are of, for errors.
        left: projection of rectified camera coordinates to pixels.
        rectify: rotation of camera coordinates to rectified ones.
        camera_from_velodyne: transform of LiDAR coordinates to camera coordinates.

    Raises:
        InputError: the product is not finite.
    """
    rectified_from_camera = np.eye(4)
    rectified_from_camera[:3, :3] = rectify
    homogeneous = np.eye(4)
    homogeneous[:3] = camera_from_velodyne
    with np.errstate(all="ignore"):
        projection = left @ rectified_from_camera @ homogeneous
    if not np.isfinite(projection).all():
        raise InputError(f"{path}: its matrices multiply to infinity. Copy the file anew.")
    return projection


LidarDepth = Literal["velodyne_x", "camera_z"]
"""Which coordinate of a LiDAR point is its depth: x of the scanner, or z of the camera."""


def project_lidar(
    points: Float[Tensor, "n 4"],
    pixels_from_velodyne: Float64[np.ndarray, "3 4"],
    size: tuple[int, int],
    depth: LidarDepth,
) -> Map:
    """Project a LiDAR scan to a sparse depth map of camera 2, as the published Eigen script does.

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

    Returns:
        Depth [m], NaN where no point falls; nothing is interpolated.
    """
    height, width = size
    homogeneous = points.numpy().astype(np.float32).copy()
    homogeneous[:, 3] = 1.0
    homogeneous = homogeneous[homogeneous[:, 0] >= 0]
    with np.errstate(all="ignore"):  # points on the plane of the camera divide by zero
        projected = (pixels_from_velodyne @ homogeneous.T.astype(np.float64)).T
        pixels = np.round(projected[:, :2] / projected[:, 2:3]) - 1
    point_m = homogeneous[:, 0].astype(np.float64) if depth == "velodyne_x" else projected[:, 2]
    is_inside = ((pixels >= 0) & (pixels < (width, height))).all(1)
    u, v = pixels[is_inside].astype(np.int64).T
    point_m = point_m[is_inside]

    # The last point of a pixel counts: one write for each pixel, since NumPy promises no order.
    depth_m = np.zeros((height, width))
    written_pixels, last = np.unique((v * width + u)[::-1], return_index=True)
    depth_m.flat[written_pixels] = point_m[::-1][last]

    # Where several points share an index, the smallest depth goes to the pixel of the first. No
    # pixel is written twice, for each pixel has one index.
    shared_index = v * (width - 1) + u - 1
    indices, first, count = np.unique(shared_index, return_index=True, return_counts=True)
    smallest_m = np.full(len(indices), np.inf)
    np.minimum.at(smallest_m, np.searchsorted(indices, shared_index), point_m)
    is_shared = count > 1
    depth_m[v[first[is_shared]], u[first[is_shared]]] = smallest_m[is_shared]

    depth_m[depth_m < 0] = 0
    with np.errstate(over="ignore"):
        depth_map = torch.from_numpy(depth_m.astype(np.float32))
    return torch.where(depth_map > 0, depth_map, torch.nan)


CalibrationStyle = Literal["raw", "object", "grey", "middlebury", "plain", "camera"]
"""Format of a frame's calibration: KITTI's raw, object, or object of the grey pair; Middlebury's;
``calib.txt`` of a plain folder; or a camera file."""
CALIBRATION_STYLES: tuple[CalibrationStyle, ...] = get_args(CalibrationStyle)


@dataclass(frozen=True, kw_only=True)
class FramePaths:
    """Paths of one frame; None where the dataset has no such file."""

    name: str  #: unique in its dataset and usable as a file name
    left: Path  #: left image (camera 2 of KITTI)
    right: Path | None = None  #: right image (camera 3)
    calibration: Path | None = None  #: file, or for ``raw`` the folder of the date
    style: CalibrationStyle = "plain"  #: format of the calibration
    velodyne: Path | None = None  #: one LiDAR scan, float32 x, y, z, reflectance
    #: a depth map of one LiDAR scan in the left image, 16-bit camera z, metres x 256
    #: (``velodyne_raw`` of KITTI's depth-prediction set)
    scan: Path | None = None
    #: depth of the left image, 16-bit PNG (metres x 256), or PFM or NPY in metres
    depth: Path | None = None
    #: disparity of the left image, 16-bit PNG (x 256), PFM or NPY, of occluded pixels too
    disparity: Path | None = None
    disparity_noc: Path | None = None  #: disparity of those pixels alone that both views show
    sky: Path | None = None  #: 8-bit PNG of the left image, not 0 where it shows the sky

    def list_input_files(self, *, with_right: bool = True) -> list[Path]:
        """List the files an estimate depends on: left image, right image, calibration."""
        paths = [self.left]
        if with_right and self.right is not None:
            paths.append(self.right)
        if self.calibration is not None and self.calibration.is_dir():
            paths += sorted(self.calibration.glob("calib_*.txt"))
        elif self.calibration is not None:
            paths.append(self.calibration)
        return paths


def read_frame_camera(frame: FramePaths) -> Camera | None:
    """Read the camera of a frame, for a pair its rig; None where it has no calibration.

    Raises:
        InputError: the calibration is damaged, or of images of another size.
    """
    if frame.calibration is None:
        return None
    path = frame.calibration
    size = files.image_size(frame.left)
    match frame.style:
        case "raw" | "object" | "grey":
            camera = read_kitti_calibration(frame).rig
        case "middlebury":
            camera = read_rig(path)
        case "camera":
            camera = read_camera(path, size) if frame.right is None else read_rig(path, size)
        case "plain":
            camera = read_plain_calibration(path, frame.name, *size)
    check_image_matches_camera(camera, *size, str(frame.left))
    return camera


def read_kitti_calibration(frame: FramePaths) -> KittiCalibration:
    """Read rig and LiDAR projection of a frame in KITTI's raw or object layout.

    Raises:
        InputError: the frame has no such calibration.
    """
    if frame.calibration is None or frame.style not in ("raw", "object", "grey"):
        raise InputError(
            f"{frame.name}: no KITTI calibration, so its LiDAR scan cannot be projected. Put "
            "calib_cam_to_cam.txt and calib_velo_to_cam.txt into the folder of its date."
        )
    size = files.image_size(frame.left)
    if frame.style != "raw":
        return read_object_calibration(frame.calibration, *size, is_grey=frame.style == "grey")
    return _read_raw_calibration(frame.calibration, size)


def _read_raw_calibration(folder: Path, size: Size) -> KittiCalibration:
    """Read a calibration of the raw layout: two files in the folder of a date.

    That of the LiDAR may be missing. ``size``: width and height of the images.

    Raises:
        InputError: a matrix is missing or damaged, or the files are of images of another size.
    """
    camera_file = folder / "calib_cam_to_cam.txt"
    lidar_file = folder / "calib_velo_to_cam.txt"
    camera_keys = files.read_key_values(camera_file)
    raw_pair = KITTI_COLOR[1]  # [0] is that of the object layout
    rig, left = _rig_from_projections(camera_file, camera_keys, raw_pair, size)
    if not lidar_file.is_file():
        return KittiCalibration(rig=rig, pixels_from_velodyne=None)
    rectify = read_matrix(camera_file, camera_keys, "R_rect_00", (3, 3))
    lidar_keys = files.read_key_values(lidar_file)
    R = read_matrix(lidar_file, lidar_keys, "R", (3, 3))
    t = read_matrix(lidar_file, lidar_keys, "T", (3, 1))
    pixels_from_velodyne = _compose_projection(lidar_file, left, rectify, np.hstack([R, t]))
    return KittiCalibration(rig=rig, pixels_from_velodyne=pixels_from_velodyne)


def list_truth_kinds(frame: FramePaths) -> tuple[TruthKind, ...]:
    """List the kinds of truth that a frame has files of; ``annotated`` is a map of depth."""
    kinds: dict[TruthKind, bool] = {
        "scan": has_lidar(frame, "camera_z"),
        "annotated": frame.depth is not None and frame.depth != _find_scan_map(frame),
        "disparity": frame.disparity is not None,
    }
    return tuple(kind for kind, has_kind in kinds.items() if has_kind)


def has_lidar(frame: FramePaths, depth: LidarDepth) -> bool:
    """Whether a frame has a LiDAR scan, or a map of one, for :func:`read_lidar_depth`."""
    return frame.velodyne is not None or (depth == "camera_z" and _find_scan_map(frame) is not None)


def read_lidar_depth(frame: FramePaths, depth: LidarDepth) -> Map:
    """Read the depth map of a frame's LiDAR scan [m]; NaN where no point falls.

    Where a frame has no scan but a map of one (``lidar_depth/`` of a plain folder,
    ``velodyne_raw`` of KITTI's depth-prediction set), that map is read for ``camera_z``.

    Raises:
        InputError: no scan (see :func:`has_lidar`), or one without calibration.
    """
    scan_map = _find_scan_map(frame)
    if frame.velodyne is None and scan_map is not None and depth == "camera_z":
        depth_m = read_depth(scan_map)
        check_map_size(scan_map, depth_m, files.image_size(frame.left))
        return depth_m
    if frame.velodyne is None:
        raise InputError(f"{frame.name}: has no LiDAR scan of the kind {depth}.")
    pixels_from_velodyne = read_kitti_calibration(frame).pixels_from_velodyne
    if pixels_from_velodyne is None:
        raise InputError(
            f"{frame.name}: its calibration says nothing of the LiDAR; calib_velo_to_cam.txt (or "
            "Tr_velo_to_cam in an object text) is missing."
        )
    width, height = files.image_size(frame.left)
    points = files.read_points_bin(frame.velodyne)
    return project_lidar(points, pixels_from_velodyne, (height, width), depth)


def _find_scan_map(frame: FramePaths) -> Path | None:
    """Find the depth map of a LiDAR scan, if there is one; that of a plain folder counts as one."""
    is_plain = frame.style in ("plain", "camera") and frame.scan is None
    return frame.depth if is_plain else frame.scan


def check_map_size(path: Path, values: Shaped[Tensor, "*any h w"], size: tuple[int, int]) -> None:
    """Refuse a map whose size is not ``size``, width and height of its left image.

    Raises:
        InputError: it has another size; ``path`` names it.
    """
    height, width = values.shape[-2:]
    if (width, height) != size:
        raise InputError(
            f"{path}: is {width}x{height}, but its left image is {size[0]}x{size[1]}; "
            "do the two belong together?"
        )


def read_disparity(path: Path) -> Map:
    """Read true disparity [px] from a 16-bit PNG or TIFF (x 256), a TIFF of floats, PFM or NPY.

    NaN where it is unknown, 0 or below, or at least the width of the image.
    """
    values = read_depth(path)
    return torch.where(values < values.shape[1], values, torch.nan)


def read_depth(path: Path) -> Map:
    """Read true depth [m] from the formats of :func:`read_disparity`; NaN where it is unknown."""
    is_map = path.suffix.lower() in files.MAP_SUFFIXES
    values = files.read_map(path) if is_map else files.read_stored_depth(path)
    if not values.is_floating_point():
        values = values * KITTI_UNIT
    return torch.where((values > 0) & (values < torch.inf), values, torch.nan)
