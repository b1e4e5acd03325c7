"""The check of a dataset's files before hours of work: lists every problem."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import Camera, RectificationReport, StereoRig, check_rectified
from depthpose.core.errors import InputError
from depthpose.core.files import MAP_SUFFIXES, image_size, read_image, read_points_bin
from depthpose.core.files.disk import normalise_stem
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.core.findings import CheckReport, Problem, make_report, make_unreadable
from depthpose.depth.datasets.dataset import read_split
from depthpose.depth.datasets.frames import (
    FramePaths,
    read_depth,
    read_frame_camera,
    read_kitti_calibration,
)
from depthpose.depth.datasets.layouts import find_frames
from depthpose.depth.disparity import disparity_from_depth
from depthpose.depth.types import Map

_MAX_DEPTH_M = 200
"""KITTI's LiDAR reaches 120 m."""
_TRUTH_RADIUS_PX = 3
"""Truth agrees with a match if any value within this distance does."""
_TRUTH_TOLERANCE_PX = 2.0
_TRUTH_TOLERANCE_SHARE = 0.03
"""Largest difference of agreeing disparities: these pixels plus this share of the disparity."""
_MIN_MATCHES = 25
"""Number of matches with truth near them, with fewer of which a map is not judged."""
_MIN_AGREEMENT = 0.6
"""Share of these matches that a true map agrees with: 0.7 to 0.97 on 80 real pairs, and at most
0.59 with maps that are scaled, shifted or rotated."""
_TRUTH_SCALES = (2.0, 0.5, 256.0, 1 / 256, 16.0, 1 / 16, 1000.0, 0.001)
"""Factors of disparity that are tried where a map does not agree."""


def check_dataset(
    folder: Path,
    split: str | Path | None = None,
    *,
    with_decoding: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> CheckReport:
    """Check every file of a dataset in any layout that ``open_dataset`` recognises.

    Args:
        folder: the dataset's root.
        split: name or file of a split: only its frames are checked.
        with_decoding: decode the images; else only their headers are read.
        progress: called with the number of frames done and of all frames.

    Raises:
        InputError: no such folder, or no layout is recognised.
    """
    folder = Path(folder)
    layout, frames = find_frames(folder)
    problems: list[Problem] = []
    if split is not None:
        chosen_split = read_split(split)
        frame_of = {frame.name: frame for frame in frames}
        frames = []
        for name in chosen_split.names:
            if name in frame_of:
                frames.append(frame_of[name])
            else:
                message = f"frame {name} of {chosen_split.name}"
                problems.append(Problem(path=folder, kind="missing", message=message))
    problems += _check_folder(folder, frames)
    for done, frame in enumerate(frames, 1):
        problems += _check_frame(frame, with_decoding=with_decoding)
        if progress is not None:
            progress(done, len(frames))

    # How many frames have a file of each part, by the fields of such files.
    fields_of_parts = {
        "right views": ("right",),
        "calibrations": ("calibration",),
        "LiDAR scans": ("velodyne", "scan"),
        "depth maps": ("depth",),
        "disparity maps": ("disparity",),
    }
    counts = {"frames": len(frames)}
    for part, names in fields_of_parts.items():
        counts[part] = sum(any(getattr(frame, name) for name in names) for frame in frames)
    return make_report(layout, counts, problems)


def _check_folder(folder: Path, frames: list[FramePaths]) -> Iterator[Problem]:
    """Yield duplicate names, mixed formats, single right views, and folders without use."""
    path_of: dict[str, Path] = {}
    for frame in frames:
        if frame.name in path_of:
            message = f"has the same name as {path_of[frame.name]}; rename one"
            yield Problem(path=frame.left, kind="mismatch", message=message)
        path_of[frame.name] = frame.left

    # Compression changes what networks predict, so a mixture is worth knowing.
    views = [path for frame in frames for path in (frame.left, frame.right) if path is not None]
    if len({path.suffix.lower() in (".jpg", ".jpeg") for path in views}) > 1:
        yield Problem(path=folder, kind="note", message="mixes PNG and JPEG images")

    # Right views without a left one, by all files of the folders: a split leaves pairs out on
    # purpose.
    folders = {
        (frame.left.parent, frame.right.parent)
        for frame in frames
        if frame.right and normalise_stem(frame.right) == normalise_stem(frame.left)
    }
    for left_folder, right_folder in sorted(folders):
        if left_folder == right_folder or not left_folder.is_dir():  # in a shard
            continue
        stems = {normalise_stem(path) for path in left_folder.iterdir()}
        for path in sorted(right_folder.iterdir()):
            is_view = path.suffix.lower() in LISTED_SUFFIXES and path.name[0] != "."
            if is_view and normalise_stem(path) not in stems:
                yield Problem(path=path, kind="missing", message="has no left view")

    # Folders of a plain dataset of which no frame has a file.
    for name, part in (("right", "right"), ("lidar_depth", "depth"), ("disp_occ", "disparity")):
        has_files = (folder / name).is_dir() and any((folder / name).iterdir())
        if has_files and not any(getattr(frame, part) for frame in frames):
            suffixes = LISTED_SUFFIXES if part == "right" else (*LISTED_SUFFIXES, *MAP_SUFFIXES)
            formats = ", ".join(suffixes)
            message = f"holds no file of a frame's name in a format that is read: {formats}"
            yield Problem(path=folder / name, kind="missing", message=message)


def _check_frame(frame: FramePaths, *, with_decoding: bool) -> Iterator[Problem]:
    """Yield the problems of a frame's views, calibration, LiDAR scan and truth.

    ``with_decoding``: decode the images and compare both views; else check their sizes alone.
    """
    # Views that are missing, unreadable or of two sizes.
    size = None
    images: list[Tensor] = []
    for path in (frame.left, frame.right):
        if path is None:
            yield Problem(path=frame.left, kind="note", message="has no right view")
            continue
        try:
            if with_decoding:
                images.append(read_image(path))
                image_px = (images[-1].shape[2], images[-1].shape[1])
            else:
                image_px = image_size(path)
        except InputError as error:
            yield make_unreadable(path, error)
            continue
        if size is not None and image_px != size:
            message = f"is {image_px[0]}x{image_px[1]}, but its left image is {size[0]}x{size[1]}"
            yield Problem(path=path, kind="mismatch", message=message)
        size = size or image_px

    # Views that are not rectified.
    rig = None
    report = None
    if frame.right is not None and len(images) == 2 and images[0].shape == images[1].shape:
        with suppress(InputError):  # _check_calibration reports it
            rig = read_frame_camera(frame)
        cx_difference_px = rig.cx_right_minus_left_px if isinstance(rig, StereoRig) else 0.0
        report = check_rectified(images[0], images[1], cx_difference_px)
        if report.is_wrong or report.is_rectified is None:
            message = f"beside {frame.left.name}: {report.message}"
            kind = "mismatch" if report.is_wrong else "note"
            yield Problem(path=frame.right, kind=kind, message=message)

    yield from _check_calibration(frame)
    if frame.velodyne is not None:
        yield from _check_scan(frame.velodyne)
    for path in (frame.scan, frame.depth, frame.disparity, frame.disparity_noc):
        if path is not None and size is not None:
            is_depth = path in (frame.scan, frame.depth)
            yield from _check_truth(path, size, rig, report, is_depth=is_depth)


def _check_calibration(frame: FramePaths) -> Iterator[Problem]:
    """Yield the problems of a frame's calibration: missing, unreadable, or without the LiDAR."""
    if frame.calibration is None and frame.velodyne is None:
        message = "has no calibration: disparity only, no metres"
        yield Problem(path=frame.left, kind="note", message=message)
    elif frame.calibration is None:
        message = "has no calibration, so its scan cannot be projected"
        yield Problem(path=frame.left, kind="missing", message=message)
    else:
        try:
            read_frame_camera(frame)
            if frame.velodyne and read_kitti_calibration(frame).pixels_from_velodyne is None:
                message = f"says nothing of the LiDAR, and {frame.velodyne.name} is there"
                yield Problem(path=frame.calibration, kind="missing", message=message)
        except InputError as error:
            yield make_unreadable(frame.calibration, error)


def _check_scan(path: Path) -> Iterator[Problem]:
    """Yield the problem of a LiDAR scan that is unreadable or empty."""
    try:
        if not len(read_points_bin(path)):
            yield Problem(path=path, kind="empty", message="holds no LiDAR point")
    except InputError as error:
        yield make_unreadable(path, error)


def _check_truth(
    path: Path,
    size: tuple[int, int],
    rig: Camera | StereoRig | None,
    report: RectificationReport | None,
    *,
    is_depth: bool,
) -> Iterator[Problem]:
    """Yield the problems of a map of depth or disparity: size, range or values do not fit its pair.

    Args:
        path: path of the map.
        size: width and height of the left image.
        rig: the cameras, where they are known.
        report: matches between the views; None: values are not compared with them.
        is_depth: whether the map holds depth, not disparity.
    """
    try:
        truth = read_depth(path)
    except InputError as error:
        yield make_unreadable(path, error)
        return
    height, width = truth.shape
    if (width, height) != size:
        message = f"is {width}x{height}, but its left image is {size[0]}x{size[1]}"
        yield Problem(path=path, kind="mismatch", message=message)
    if not bool(torch.isfinite(truth).any()):
        yield Problem(path=path, kind="empty", message="holds no value")
    largest = float(truth.nan_to_num(0.0).max())
    limit, unit = (_MAX_DEPTH_M, "m") if is_depth else (width, "px")
    if largest > limit:
        message = f"holds {largest:g} {unit}, beyond {limit} {unit}; is its unit 1/256?"
        yield Problem(path=path, kind="mismatch", message=message)
    if report is None or report.is_wrong or (width, height) != size:
        return
    if is_depth:
        if not isinstance(rig, StereoRig):
            return
        truth = disparity_from_depth(truth, rig)
    yield from _check_agreement(path, truth, report)


def _check_agreement(path: Path, truth_px: Map, report: RectificationReport) -> Iterator[Problem]:
    """Yield a problem if few matches between the views agree with a true map of disparity.

    Its message names the change of the map that would agree, such as another unit.
    """
    agreement = _measure_agreement(truth_px, report)
    if agreement is None or agreement.share >= _MIN_AGREEMENT:
        return
    message = (
        f"agrees with {agreement.share:.0%} of {agreement.match_count} matches between left and "
        "right"
    )

    # The change of the map that agrees best.
    changes = {f"{scale:g} times its disparities": truth_px * scale for scale in _TRUTH_SCALES}
    changes |= {"mirrored": truth_px.flip(1), "upside down": truth_px.flip(0)}
    best_share = max(_MIN_AGREEMENT, agreement.share)
    hint = ""
    for change, changed_px in changes.items():
        changed = _measure_agreement(changed_px, report)
        if changed is not None and changed.share >= best_share:
            best_share = changed.share
            hint = f"; {change} it agrees with {best_share:.0%}"
    message = f"{message}{hint}: is it of this pair, and in which unit?"
    yield Problem(path=path, kind="mismatch", message=message)


class _Agreement(NamedTuple):
    """How well a map of disparity agrees with matches between the views."""

    share: float  # share of the matches that agree with it
    match_count: int  # number of the matches that have truth near them


def _measure_agreement(disparity_px: Map, report: RectificationReport) -> _Agreement | None:
    """Measure how many matches agree with a map, of those with truth near them.

    None where these are too few.
    """
    # Matched corners lie at edges, so each value in a window may be that of the match.
    side = 2 * _TRUTH_RADIUS_PX + 1
    padded = F.pad(disparity_px.float(), (_TRUTH_RADIUS_PX,) * 4, value=float("nan"))
    windows = padded.unfold(0, side, 1).unfold(1, side, 1)
    column, row = report.places_px.round().long().unbind(-1)
    height, width = disparity_px.shape
    near_px = windows[row.clamp(0, height - 1), column.clamp(0, width - 1)].flatten(1)

    # The matches that any value in their window is close enough to.
    matched_px = report.disparities_px[:, None]
    tolerance_px = _TRUTH_TOLERANCE_PX + _TRUTH_TOLERANCE_SHARE * matched_px.abs()
    has_truth = torch.isfinite(near_px).any(1)
    agrees = ((near_px - matched_px).abs() <= tolerance_px).any(1)
    count = int(has_truth.sum())
    if count < _MIN_MATCHES:
        return None
    return _Agreement(float(agrees[has_truth].float().mean()), count)
