"""Writing rendered pairs with their truth, in KITTI's raw layout and in Middlebury's."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from depthpose.core import files
from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError
from depthpose.core.files.disk import write_bytes
from depthpose.core.run_folder import is_result_finished, note_result
from depthpose.depth.types import RawFrame

_CALIBRATION_FILES = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")


def has_raw_frame(folder: Path, drive: str, number: int) -> bool:
    """Whether all files of a frame of :func:`write_raw_frame` exist as they were written."""
    last = f"{drive[:10]}/{drive}/disp_occ/{number:010d}.png"
    return is_result_finished(folder, f"{drive}/{number:010d}", [last])


def has_calibration(folder: Path, date: str) -> bool:
    """Whether the calibration of a date exists as it was written."""
    return is_result_finished(folder, date, [f"{date}/{name}" for name in _CALIBRATION_FILES])


def write_raw_frame(folder: Path, drive: str, number: int, frame: RawFrame) -> None:
    """Write a frame in KITTI's raw layout: images, LiDAR scan, disparity, sky, and calibration.

    ``image_02/data``, ``image_03/data`` and ``velodyne_points/data`` are KITTI's own folders;
    disparity, which KITTI raw does not have, goes beside them into ``disp_occ`` (all pixels) and
    ``disp_noc`` (those that both views show), as 16-bit PNG x 256, and the sky into ``sky``. The
    calibration is written once for each date.

    Args:
        folder: the root of the dates.
        drive: ``DATE_drive_NNNN_sync``.
        number: number of the frame in its drive.
        frame: the images and their truth.

    Raises:
        InputError: the date already has another calibration, or the disk refuses.
    """
    date = drive[:10]
    _write_calibration(folder, date, frame)
    name = f"{number:010d}"
    home = folder / date / drive
    left = home / f"image_02/data/{name}.png"
    right = home / f"image_03/data/{name}.png"
    scan = home / f"velodyne_points/data/{name}.bin"
    sky = home / f"sky/{name}.png"
    visible = home / f"disp_noc/{name}.png"
    disparity = home / f"disp_occ/{name}.png"

    files.write_image(left, frame.left)
    files.write_image(right, frame.right)
    if frame.lidar_points is not None:
        points = frame.lidar_points.float().contiguous().numpy().astype("<f4")
        write_bytes(scan, points.tobytes())
    files.write_image(sky, frame.is_sky.float().expand(3, -1, -1))
    visible_px = torch.where(frame.occluded, torch.nan, frame.disparity_px)
    files.write_depth_png(visible, visible_px)
    files.write_depth_png(disparity, frame.disparity_px)
    scans = [] if frame.lidar_points is None else [scan]
    note_result(folder, f"{drive}/{name}", [left, right, *scans, sky, visible, disparity])


def has_scene(folder: Path, name: str) -> bool:
    """Whether all files of a scene of :func:`write_scene` exist as they were written."""
    return is_result_finished(folder, name, [f"{name}/disp0.pfm"])


def write_scene(folder: Path, name: str, frame: RawFrame) -> None:
    """Write a pair in Middlebury's layout, each with its own rig: images, disparity, calibration.

    ``NAME/im0.png``, ``im1.png``, ``disp0.pfm`` (occluded pixels too, infinity where unknown) and
    ``calib.txt``.

    Raises:
        InputError: the disk refuses.
    """
    left = folder / name / "im0.png"
    right = folder / name / "im1.png"
    disparity = folder / name / "disp0.pfm"
    calibration = folder / name / "calib.txt"
    files.write_image(left, frame.left)
    files.write_image(right, frame.right)
    files.write_map(disparity, frame.disparity_px)
    write_bytes(calibration, _format_middlebury_rig(frame.rig).encode())
    note_result(folder, name, [left, right, disparity, calibration])


def _format_middlebury_rig(rig: StereoRig) -> str:
    """Format a rig as Middlebury's ``calib.txt``; its baseline is in millimetres."""
    right_K = rig.K.clone()
    right_K[0, 2] += rig.cx_right_minus_left_px
    lines: list[str] = []
    for camera, K in (("cam0", rig.K), ("cam1", right_K)):
        rows = [" ".join(f"{value:.10g}" for value in row) for row in K.tolist()]
        lines.append(f"{camera}=[{'; '.join(rows)}]")
    lines += [
        f"doffs={rig.cx_right_minus_left_px:.10g}",
        f"baseline={1000 * rig.baseline_m:.10g}",
        f"width={rig.width}",
        f"height={rig.height}",
    ]
    return "\n".join(lines) + "\n"


def _write_calibration(folder: Path, date: str, frame: RawFrame) -> None:
    """Write the calibration of a date, unless it exists as it was written.

    Raises:
        InputError: the existing calibration is another.
    """
    rig = frame.rig
    left = np.zeros((3, 4))
    left[:, :3] = rig.K.numpy()
    right = left.copy()
    right[0, 2] += rig.cx_right_minus_left_px
    right[0, 3] = -right[0, 0] * rig.baseline_m
    size = np.array([rig.width, rig.height])
    camera_matrices = {
        "S_rect_02": size,
        "R_rect_00": np.eye(3),
        "P_rect_02": left,
        "S_rect_03": size,
        "P_rect_03": right,
    }
    transform = frame.camera_from_velodyne
    lidar_matrices = {"R": transform[:3, :3], "T": transform[:3, 3]}

    is_written = has_calibration(folder, date)
    paths = [folder / date / name for name in _CALIBRATION_FILES]
    for path, matrices in zip(paths, (camera_matrices, lidar_matrices), strict=True):
        text = _format_matrices(matrices)
        if not is_written:
            write_bytes(path, text.encode())
        elif files.read_text(path) != text:
            raise InputError(
                f"{path}: belongs to frames of another rig or scale; write these to another folder"
            )
    if not is_written:
        note_result(folder, date, paths)


def _format_matrices(matrices: Mapping[str, np.ndarray]) -> str:
    """Format matrices by name as KITTI's calibration files have them: a line each, row by row."""
    lines: list[str] = []
    for name, matrix in matrices.items():
        values = " ".join(f"{value:.12e}" for value in matrix.ravel())
        lines.append(f"{name}: {values}")
    return "\n".join(lines) + "\n"
