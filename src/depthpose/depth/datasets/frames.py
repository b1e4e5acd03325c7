"""One stereo frame on disk: where its parts lie, and reading them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from depthpose.core.camera import Camera, check_image_matches_camera, read_camera, read_rig
from depthpose.core.errors import InputError
from depthpose.core.files import (
    MAP_SUFFIXES,
    image_size,
    read_depth_png,
    read_disparity_png,
    read_image,
    read_map,
    read_points_bin,
)
from depthpose.depth.config import TruthKind
from depthpose.depth.datasets.calibration import (
    KittiCalibration,
    LidarDepth,
    project_lidar,
    read_object_calibration,
    read_plain_calibration,
    read_raw_calibration,
)
from depthpose.depth.types import StereoInput, StereoTruth

CalibrationStyle = Literal["raw", "object", "grey", "middlebury", "plain", "camera"]


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Paths of one frame; None where the dataset has no such file.

    Attributes:
        name: unique in its dataset and usable as a file name.
        left: left image (camera 2 of KITTI).
        right: right image (camera 3).
        calibration: file, or for ``raw`` the folder of the date.
        style: how the calibration is written.
        velodyne: one LiDAR scan, float32 x, y, z, reflectance.
        scan: a LiDAR scan that was drawn into the left image already, 16-bit camera z, metres x
            256 (``velodyne_raw`` of KITTI's depth-prediction set).
        depth: depth of the left image, 16-bit PNG (metres x 256), or PFM or NPY in metres.
        disparity: disparity of the left image, 16-bit PNG (x 256), PFM or NPY, hidden pixels too.
        disparity_noc: that of the pixels alone that both views see.
        sky: 8-bit PNG of the left image, not 0 where it shows the sky.
    """

    name: str
    left: Path
    right: Path | None = None
    calibration: Path | None = None
    style: CalibrationStyle = "plain"
    velodyne: Path | None = None
    scan: Path | None = None
    depth: Path | None = None
    disparity: Path | None = None
    disparity_noc: Path | None = None
    sky: Path | None = None

    def seen_files(self, *, with_right: bool = True) -> list[Path]:
        """List what an estimate depends on: left image, right image, files of the calibration."""
        files = [self.left]
        if with_right and self.right is not None:
            files.append(self.right)
        if self.calibration is not None and self.calibration.is_dir():
            files += sorted(self.calibration.glob("calib_*.txt"))
        elif self.calibration is not None:
            files.append(self.calibration)
        return files


def frame_input(frame: Frame) -> StereoInput:
    """Read images and calibration of a frame.

    Raises:
        InputError: a file is missing or damaged, or the two views differ in size.
    """
    left = read_image(frame.left)
    right = None if frame.right is None else read_image(frame.right)
    if frame.right is not None and right is not None:
        _check_size(frame.right, right, (left.shape[2], left.shape[1]))
    return StereoInput(name=frame.name, left=left, right=right, camera=frame_camera(frame))


def frame_truth(frame: Frame) -> StereoTruth:
    """Read the truth that the dataset ships as maps; a LiDAR scan is for :func:`lidar_truth`.

    Raises:
        InputError: a map is damaged, or of another size than the left image.
    """
    depth_m = None if frame.depth is None else read_depth(frame.depth)
    disparity_px = None if frame.disparity is None else read_disparity(frame.disparity)
    is_sky = None if frame.sky is None else read_image(frame.sky)[0] > 0
    parts = ((frame.depth, depth_m), (frame.disparity, disparity_px), (frame.sky, is_sky))
    for path, values in parts:
        if path is not None and values is not None:
            _check_size(path, values, image_size(frame.left))
    return StereoTruth(disparity_px=disparity_px, depth_m=depth_m, is_sky=is_sky)


def frame_camera(frame: Frame) -> Camera | None:
    """Read the camera of a frame, or None where it has no calibration; of a pair, the rig.

    Raises:
        InputError: the calibration is damaged, or that of images of another size.
    """
    if frame.calibration is None:
        return None
    path, size = frame.calibration, image_size(frame.left)
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
    width, height = image_size(frame.left)
    if frame.style == "raw":
        return read_raw_calibration(frame.calibration, width, height)
    return read_object_calibration(frame.calibration, width, height, is_grey=frame.style == "grey")


def known_truths(frame: Frame) -> tuple[TruthKind, ...]:
    """Say which kinds of truth a frame has."""
    is_annotated = frame.depth is not None and not _is_plain(frame)
    kinds: dict[TruthKind, bool] = {
        "scan": has_lidar(frame, "camera_z"),
        "annotated": is_annotated,
        "disparity": frame.disparity is not None,
    }
    return tuple(kind for kind, is_there in kinds.items() if is_there)


def has_lidar(frame: Frame, depth: LidarDepth) -> bool:
    """Whether :func:`lidar_truth` has something to draw."""
    return frame.velodyne is not None or (depth == "camera_z" and _drawn_scan(frame) is not None)


def lidar_truth(frame: Frame, depth: LidarDepth) -> Float[Tensor, "h w"]:
    """Draw the LiDAR scan of a frame into its left image; NaN where no point falls.

    Where there is no scan but a drawn one (``lidar_depth/`` of a plain folder, ``velodyne_raw`` of
    KITTI's depth-prediction set; camera z), it serves ``camera_z`` as it is.

    Raises:
        InputError: no scan (see :func:`has_lidar`), or one without calibration.
    """
    drawn = _drawn_scan(frame)
    if frame.velodyne is None and drawn is not None and depth == "camera_z":
        depth_m = read_depth(drawn)
        _check_size(drawn, depth_m, image_size(frame.left))
        return depth_m
    if frame.velodyne is None:
        raise InputError(f"{frame.name}: has no LiDAR scan of the kind {depth}.")
    pixels_from_velodyne = kitti_calibration(frame).pixels_from_velodyne
    if pixels_from_velodyne is None:
        raise InputError(
            f"{frame.name}: its calibration says nothing of the LiDAR; calib_velo_to_cam.txt (or "
            "Tr_velo_to_cam in an object text) is missing."
        )
    width, height = image_size(frame.left)
    points = read_points_bin(frame.velodyne)
    return project_lidar(points, pixels_from_velodyne, (height, width), depth)


def _drawn_scan(frame: Frame) -> Path | None:
    return frame.depth if _is_plain(frame) else frame.scan


def _is_plain(frame: Frame) -> bool:
    """Whether the depth of a frame is a LiDAR scan, as that of plain folders of pairs is."""
    return frame.style in ("plain", "camera") and frame.scan is None


def _check_size(path: Path, values: Shaped[Tensor, "*any h w"], size: tuple[int, int]) -> None:
    height, width = values.shape[-2:]
    if (width, height) != size:
        raise InputError(
            f"{path}: is {width}x{height}, but its left image is {size[0]}x{size[1]}; "
            "do the two belong together?"
        )


def read_disparity(path: Path) -> Float[Tensor, "h w"]:
    """Read true disparity from a 16-bit PNG, PFM or NPY; NaN where it is unknown, 0 or below."""
    return _known(path) if path.suffix.lower() in MAP_SUFFIXES else read_disparity_png(path)


def read_depth(path: Path) -> Float[Tensor, "h w"]:
    """Read true depth [m] from a 16-bit PNG (x 256), PFM or NPY; NaN where it is unknown."""
    return _known(path) if path.suffix.lower() in MAP_SUFFIXES else read_depth_png(path)


def _known(path: Path) -> Float[Tensor, "h w"]:
    values = read_map(path)
    return torch.where(values > 0, values, torch.nan)
