"""Frames written in KITTI's raw layout, so that whatever reads KITTI reads them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError
from depthpose.core.files import read_text, write_disparity_png, write_image
from depthpose.core.files.disk import write_bytes
from depthpose.core.results import is_whole, note_result

_CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")


@dataclass(frozen=True, kw_only=True, eq=False)
class RawFrame:
    """What is written of one frame.

    Attributes:
        left: left image (camera 2).
        right: right image (camera 3).
        rig: the cameras.
        disparity_px: of the left image; NaN where unknown.
        occluded: left pixels that the right view does not show.
        is_sky: left pixels that show the sky.
        points: one LiDAR scan, x forward, y left, z up [m] and reflectance; or None.
        camera_from_velodyne: from the LiDAR to the left camera.
    """

    left: Float[Tensor, "3 h w"]
    right: Float[Tensor, "3 h w"]
    rig: StereoRig
    disparity_px: Float[Tensor, "h w"]
    occluded: Bool[Tensor, "h w"]
    is_sky: Bool[Tensor, "h w"]
    points: Float[Tensor, "n 4"] | None
    camera_from_velodyne: Float64[np.ndarray, "4 4"]


def has_raw_frame(folder: Path, drive: str, number: int) -> bool:
    """Whether a frame is there, and every file of it as it was written."""
    last = _disparity_file(folder, drive, number).relative_to(folder).as_posix()
    return is_whole(folder, f"{drive}/{number:010d}", [last])


def has_calibration(folder: Path, date: str) -> bool:
    """Whether the calibration of a date is there as it was written."""
    return is_whole(folder, date, [f"{date}/{name}" for name in _CALIBRATION])


def write_raw_frame(folder: Path, drive: str, number: int, frame: RawFrame) -> None:
    """Write a frame: images, LiDAR scan, disparity, and once a date the calibration.

    ``image_02/data``, ``image_03/data`` and ``velodyne_points/data`` are KITTI's own folders;
    disparity, which KITTI raw has not, goes beside them into ``disp_occ`` (all pixels) and
    ``disp_noc`` (those that both views show), as 16-bit PNG x 256, and the sky into ``sky``.

    Args:
        folder: the dataset's root.
        drive: ``DATE_drive_NNNN_sync``.
        number: of the frame, in its drive.
        frame: what to write.

    Raises:
        InputError: the date already has another calibration, or the disk refuses.
    """
    home = folder / drive[:10] / drive
    _write_calibration(folder, drive[:10], frame)
    name = f"{number:010d}"
    written: list[Path] = []

    def new(place: str, suffix: str = ".png") -> Path:
        written.append(home / place / f"{name}{suffix}")
        return written[-1]

    write_image(new("image_02/data"), frame.left)
    write_image(new("image_03/data"), frame.right)
    if frame.points is not None:
        scan = frame.points.float().contiguous().numpy().astype("<f4")
        write_bytes(new("velodyne_points/data", ".bin"), scan.tobytes())
    write_image(new("sky"), frame.is_sky.float().expand(3, -1, -1))
    seen_by_both = torch.where(frame.occluded, torch.nan, frame.disparity_px)
    write_disparity_png(new("disp_noc"), seen_by_both)
    write_disparity_png(new("disp_occ"), frame.disparity_px)
    note_result(folder, f"{drive}/{name}", written)


def _disparity_file(folder: Path, drive: str, number: int) -> Path:
    return folder / drive[:10] / drive / "disp_occ" / f"{number:010d}.png"


def _write_calibration(folder: Path, date: str, frame: RawFrame) -> None:
    """Write the calibration of a date once; one that is not as it was written, again."""
    rig, eye = frame.rig, np.eye(3)
    left = np.zeros((3, 4))
    left[:, :3] = rig.K.numpy()
    right = left.copy()
    right[0, 2] += rig.cx_right_minus_left_px
    right[0, 3] = -right[0, 0] * rig.baseline_m
    size = np.array([rig.width, rig.height])
    cameras = {"S_rect_02": size, "R_rect_00": eye, "P_rect_02": left,
               "S_rect_03": size, "P_rect_03": right}  # fmt: skip
    transform = frame.camera_from_velodyne
    poses = {"R": transform[:3, :3], "T": transform[:3, 3]}
    is_there = has_calibration(folder, date)
    files = [folder / date / name for name in _CALIBRATION]
    for path, matrices in zip(files, (cameras, poses), strict=True):
        lines = [
            f"{name}: " + " ".join(f"{value:.12e}" for value in matrix.ravel())
            for name, matrix in matrices.items()
        ]
        text = "\n".join(lines) + "\n"
        if not is_there:
            write_bytes(path, text.encode())
        elif read_text(path) != text:
            raise InputError(
                f"{path}: belongs to frames of another rig or scale; write these to another folder"
            )
    if not is_there:
        note_result(folder, date, files)
