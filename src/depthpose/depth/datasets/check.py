"""The check of a folder before hours of work: everything wrong, a line each."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import Camera, RectificationReport, StereoRig, check_rectified
from depthpose.core.errors import InputError
from depthpose.core.files import MAP_SUFFIXES, image_size, read_image, read_points_bin
from depthpose.core.files.disk import stem_of
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.core.findings import CheckReport, Problem, make_report, unreadable
from depthpose.depth.datasets.dataset import read_split
from depthpose.depth.datasets.frames import Frame, frame_camera, kitti_calibration, read_depth
from depthpose.depth.datasets.layouts import find_frames
from depthpose.depth.disparity import disparity_from_depth
from depthpose.depth.types import Map

_MAX_DEPTH_M = 200
"""KITTI's LiDAR sees 120 m."""
_TRUTH_RADIUS = 3
_TRUTH_PX = 2.0
_TRUTH_SHARE = 0.03
"""A value within so many pixels of a match may be so far from its disparity: px, and a share."""
_MIN_TRUTH = 25
"""Matches with truth beside them, without which a map is not judged."""
_AGREE = 0.6
"""Least share of these that a true map agrees with: 0.7 to 0.97 on 80 real pairs, and 0.59 at most
of maps of another scale, shift or turn."""
_TRUTH_SCALES = (2.0, 0.5, 256.0, 1 / 256, 16.0, 1 / 16, 1000.0, 0.001)
"""Factors of disparity that are tried where a map does not agree."""


def check_dataset(
    folder: Path,
    split: str | Path | None = None,
    *,
    with_decoding: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> CheckReport:
    """Check every file of a dataset in any layout that ``open_dataset`` knows, or of its split.

    Without decoding only headers and sizes are read. ``progress`` is called with the number of
    frames done and of all frames.

    Raises:
        InputError: no such folder, or no layout that is known.
    """
    folder = Path(folder)
    layout, frames = find_frames(folder)
    problems: list[Problem] = []
    if split is not None:
        chosen = read_split(split)
        frames_here = {frame.name: frame for frame in frames}
        missing = [name for name in chosen.names if name not in frames_here]
        problems += [
            Problem(path=folder, kind="missing", message=f"frame {n} of {chosen.name}")
            for n in missing
        ]
        frames = [frames_here[name] for name in chosen.names if name in frames_here]
    problems += _check_folder(folder, frames)
    for done, frame in enumerate(frames, 1):
        problems += _check_images(frame, with_decoding=with_decoding)
        if progress is not None:
            progress(done, len(frames))
    parts = {"right views": ("right",), "calibrations": ("calibration",),
             "LiDAR scans": ("velodyne", "scan"), "depth maps": ("depth",),
             "disparity maps": ("disparity",)}  # fmt: skip
    counts = {"frames": len(frames)} | {
        what: sum(any(getattr(frame, part) for part in names) for frame in frames)
        for what, names in parts.items()
    }
    return make_report(layout, counts, problems)


def _check_folder(folder: Path, frames: list[Frame]) -> Iterator[Problem]:
    """Find duplicate names, mixed formats, lone right views, and maps without an image."""
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
    # The folders are listed, not the frames: a split leaves many pairs out on purpose.
    folders = {
        (f.left.parent, f.right.parent)
        for f in frames
        if f.right and stem_of(f.right) == stem_of(f.left)
    }
    for left, right in sorted(folders):
        if left == right or not left.is_dir():  # packed
            continue
        stems = {stem_of(path) for path in left.iterdir()}
        for path in sorted(right.iterdir()):
            is_view = path.suffix.lower() in LISTED_SUFFIXES and path.name[0] != "."
            if is_view and stem_of(path) not in stems:
                yield Problem(path=path, kind="missing", message="has no left view")
    for name, part in (("right", "right"), ("lidar_depth", "depth"), ("disp_occ", "disparity")):
        is_there = (folder / name).is_dir() and any((folder / name).iterdir())
        if is_there and not any(getattr(frame, part) for frame in frames):
            suffixes = ", ".join((*LISTED_SUFFIXES, *(() if part == "right" else MAP_SUFFIXES)))
            message = f"holds no file of a frame's name in a format that is read: {suffixes}"
            yield Problem(path=folder / name, kind="missing", message=message)


def _check_images(frame: Frame, *, with_decoding: bool) -> Iterator[Problem]:
    """Report views that are missing, unreadable, of two sizes or not rectified; then the truth.

    ``with_decoding``: decode the images, and compare both views; else look at their sizes alone.
    """
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
            yield unreadable(path, error)
            continue
        if size is not None and image_px != size:
            message = f"is {image_px[0]}x{image_px[1]}, but its left image is {size[0]}x{size[1]}"
            yield Problem(path=path, kind="mismatch", message=message)
        size = size or image_px
    rig = None
    report = None
    if frame.right is not None and len(images) == 2 and images[0].shape == images[1].shape:
        with suppress(InputError):  # which is told by itself
            rig = frame_camera(frame)
        cx_difference_px = rig.cx_right_minus_left_px if isinstance(rig, StereoRig) else 0.0
        report = check_rectified(images[0], images[1], cx_difference_px)
        if report.is_wrong or report.is_rectified is None:
            message = f"beside {frame.left.name}: {report.message}"
            yield Problem(
                path=frame.right, kind="mismatch" if report.is_wrong else "note", message=message
            )
    yield from _check_measurements(frame)
    for path in (frame.scan, frame.depth, frame.disparity, frame.disparity_noc):
        if path is not None and size is not None:
            is_depth = path in (frame.scan, frame.depth)
            yield from _check_truth(path, size, rig, report, is_depth=is_depth)


def _check_measurements(frame: Frame) -> Iterator[Problem]:
    """Calibration and LiDAR points."""
    if frame.calibration is None:
        if frame.velodyne is None:
            yield Problem(
                path=frame.left,
                kind="note",
                message="has no calibration: disparity only, no metres",
            )
        else:
            message = "has no calibration, so its scan cannot be projected"
            yield Problem(path=frame.left, kind="missing", message=message)
    else:
        try:
            frame_camera(frame)
            if frame.velodyne and kitti_calibration(frame).pixels_from_velodyne is None:
                message = f"says nothing of the LiDAR, and {frame.velodyne.name} is there"
                yield Problem(path=frame.calibration, kind="missing", message=message)
        except InputError as error:
            yield unreadable(frame.calibration, error)
    if frame.velodyne is not None:
        try:
            if not len(read_points_bin(frame.velodyne)):
                yield Problem(path=frame.velodyne, kind="empty", message="holds no LiDAR point")
        except InputError as error:
            yield unreadable(frame.velodyne, error)


def _check_truth(
    path: Path,
    size: tuple[int, int],
    rig: Camera | StereoRig | None,
    report: RectificationReport | None,
    *,
    is_depth: bool,
) -> Iterator[Problem]:
    """Check size and range of a map, and whether it fits the images of its pair."""
    try:
        truth = read_depth(path)
    except InputError as error:
        yield unreadable(path, error)
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
    best = _agreement(truth, report)
    changed = ""
    if best is None or best[0] >= _AGREE:
        return
    message = f"agrees with {best[0]:.0%} of {best[1]} matches between left and right"
    changes = {f"{scale:g} times its disparities": truth * scale for scale in _TRUTH_SCALES}
    changes |= {"mirrored": truth.flip(1), "upside down": truth.flip(0)}
    for words, other in changes.items():
        agreement = _agreement(other, report)
        if agreement is not None and agreement[0] >= max(_AGREE, best[0]):
            best = agreement
            changed = f"; {words} it agrees with {agreement[0]:.0%}"
    message = f"{message}{changed}: is it of this pair, and in which unit?"
    yield Problem(path=path, kind="mismatch", message=message)


def _agreement(disparity_px: Map, report: RectificationReport) -> tuple[float, int] | None:
    """Give share and number of matches that agree with a map; None where these are too few."""
    # Corners lie at edges, so a value within a window may be the one that a match saw.
    side = 2 * _TRUTH_RADIUS + 1
    padded = F.pad(disparity_px.float(), (_TRUTH_RADIUS,) * 4, value=float("nan"))
    windows = padded.unfold(0, side, 1).unfold(1, side, 1)
    column, row = report.places_px.round().long().unbind(-1)
    height, width = disparity_px.shape
    near = windows[row.clamp(0, height - 1), column.clamp(0, width - 1)].flatten(1)
    matched_px = report.disparities_px[:, None]
    is_there = torch.isfinite(near).any(1)
    is_near = (near - matched_px).abs() <= _TRUTH_PX + _TRUTH_SHARE * matched_px.abs()
    count = int(is_there.sum())
    if count < _MIN_TRUTH:
        return None
    return float(is_near.any(1)[is_there].float().mean()), count
