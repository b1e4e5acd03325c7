"""Frames written in KITTI's raw layout, so that whatever reads KITTI reads them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError
from depthpose.core.files import atomic_write, read_text, write_disparity_png, write_image


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
    """Whether a frame is there as a whole: what is written last is there."""
    return _disparity_file(folder, drive, number).is_file()


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
    _write_calibration(home.parent, frame)
    name = f"{number:010d}"
    write_image(home / "image_02/data" / f"{name}.png", frame.left)
    write_image(home / "image_03/data" / f"{name}.png", frame.right)
    if frame.points is not None:
        with atomic_write(home / "velodyne_points/data" / f"{name}.bin") as part:
            part.write_bytes(frame.points.float().contiguous().numpy().astype("<f4").tobytes())
    write_image(home / "sky" / f"{name}.png", frame.is_sky.float().expand(3, -1, -1))
    seen_by_both = torch.where(frame.occluded, torch.nan, frame.disparity_px)
    write_disparity_png(home / "disp_noc" / f"{name}.png", seen_by_both)
    write_disparity_png(_disparity_file(folder, drive, number), frame.disparity_px)


def _disparity_file(folder: Path, drive: str, number: int) -> Path:
    return folder / drive[:10] / drive / "disp_occ" / f"{number:010d}.png"


def _write_calibration(date: Path, frame: RawFrame) -> None:
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
    _write_once(date / "calib_cam_to_cam.txt", cameras)
    _write_once(date / "calib_velo_to_cam.txt", {"R": transform[:3, :3], "T": transform[:3, 3]})


def _write_once(path: Path, matrices: dict[str, np.ndarray]) -> None:
    lines = [
        f"{name}: " + " ".join(f"{value:.12e}" for value in matrix.ravel())
        for name, matrix in matrices.items()
    ]
    text = "\n".join(lines) + "\n"
    if not path.is_file():
        with atomic_write(path) as part:
            part.write_text(text)
    elif read_text(path) != text:
        raise InputError(
            f"{path}: belongs to frames of another rig or scale; write these to another folder"
        )
