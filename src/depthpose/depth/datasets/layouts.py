"""Layouts of dataset folders, and how they are recognised."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from depthpose.core import files
from depthpose.core.errors import InputError
from depthpose.core.files.disk import find_partners, normalise_stem
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.depth.datasets.frames import CalibrationStyle, FramePaths
from depthpose.depth.datasets.packed import find_packed_frames


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A way in which the files of a dataset lie in its folder."""

    # lists the frames of a folder; none where the folder has another layout
    find: Callable[[Path], Iterable[FramePaths]]
    parts: str  # files and folders of the layout, for errors


def find_frames(folder: Path) -> tuple[str, list[FramePaths]]:
    """Recognise the layout of a folder; return its name, and the frames sorted by name.

    Raises:
        InputError: no such folder, or no layout is recognised.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder. Give the folder of a dataset.")
    folder = Path(os.path.abspath(folder))  # noqa: PTH100  '.' has no name, and a link keeps its own
    for name, layout in LAYOUTS.items():
        frames = sorted(layout.find(folder), key=lambda frame: frame.name)
        if frames:
            return name, frames
    raise _make_layout_error(folder)


def _has_layout(folder: Path) -> bool:
    """Whether a folder has a frame of any layout."""
    first_frames = (next(iter(layout.find(folder)), None) for layout in LAYOUTS.values())
    return any(first_frames)


def _make_layout_error(folder: Path) -> InputError:
    """Make the error of a folder whose layout is not recognised, with what to do."""
    children = sorted(folder.iterdir())
    names = ", ".join(path.name for path in children[:8]) or "nothing"
    datasets = [path.name for path in children[:50] if path.is_dir() and _has_layout(path)]
    hint = f" Open one of its folders instead: {', '.join(datasets)}." if datasets else ""
    possible_drives = (folder, *children, *folder.glob("*/*_extract"))
    if any(path.name.endswith("_extract") for path in possible_drives):
        hint += (
            " Drives called _extract hold KITTI's raw images, which are neither rectified nor "
            "synchronised: take those called _sync."
        )
    known_layouts = ", ".join(f"{name} ({layout.parts})" for name, layout in LAYOUTS.items())
    return InputError(
        f"{folder}: no layout that is known here. It holds {names}. Known: {known_layouts}.{hint}"
    )


def _make_frames(
    lefts: list[Path], style: CalibrationStyle, prefix: str = "", **parts: Mapping[str, Path]
) -> Iterator[FramePaths]:
    """Make the frames of left images.

    Args:
        lefts: the left images.
        style: format of the calibrations.
        prefix: begins the name of each frame, which ends in the image's stem.
        parts: for each other field of :class:`FramePaths`, its files by the stems of the images.
    """
    for left in lefts:
        stem = normalise_stem(left)
        others = {field: by_stem.get(stem) for field, by_stem in parts.items()}
        yield FramePaths(name=prefix + stem, left=left, style=style, **others)


def _find_raw(folder: Path) -> Iterable[FramePaths]:
    """Find the frames of KITTI raw, and of its depth-prediction set inside or beside it.

    ``folder`` is a root of dates, a date or a drive.
    """
    drives = [*folder.glob("*_sync"), *folder.glob("*/*_sync")]
    if folder.name.endswith("_sync"):
        drives.append(folder)
    for drive in sorted(drives):
        date = drive.parent
        lefts = _list_files(drive / "image_02/data")
        is_calibrated = (date / "calib_cam_to_cam.txt").exists()
        yield from _make_frames(
            lefts,
            "raw",
            f"{drive.name}_",
            calibration={normalise_stem(left): date for left in lefts if is_calibrated},
            right=_list_by_stem(drive / "image_03/data"),
            velodyne=_list_by_stem(drive / "velodyne_points/data", (".bin",)),
            scan=_list_by_stem(_find_depth_maps(drive, "velodyne_raw", "velodyne")),
            depth=_list_by_stem(_find_depth_maps(drive, "groundtruth", "annotated")),
            disparity=_list_by_stem(drive / "disp_occ"),
            disparity_noc=_list_by_stem(drive / "disp_noc"),
            sky=_list_by_stem(drive / "sky"),
        )


def _find_depth_maps(drive: Path, kind: str, archive: str) -> Path:
    """Find the folder of a drive's left maps of KITTI's depth-prediction set.

    Its archives are unpacked into the drive, into the folder of the date or of all dates, or beside
    it. ``kind``: name of the maps' folder; ``archive``: end of their archive's name.
    """
    maps = f"proj_depth/{kind}/image_02"
    date = drive.parent
    root = date.parent
    unpacked = f"data_depth_{archive}"
    candidates = [drive / maps]
    for place in (date, date / unpacked, root, root / unpacked):
        candidates += [place / part / drive.name / maps for part in ("train", "val")]
    return next((candidate for candidate in candidates if candidate.is_dir()), drive / maps)


def _find_depth_selection(folder: Path) -> Iterable[FramePaths]:
    """Find KITTI's frames for completion and prediction of depth: cropped, each with its camera."""
    inner = folder / "val_selection_cropped"
    root = inner if inner.is_dir() else folder
    if not (root / "intrinsics").is_dir():
        return
    intrinsics = _list_by_stem(root / "intrinsics", (".txt",))
    scans = _list_by_stem(root / "velodyne_raw")
    depth = _list_by_stem(root / "groundtruth_depth")
    for left in _list_files(root / "image"):
        stem = normalise_stem(left)
        yield FramePaths(
            name=stem,
            left=left,
            calibration=intrinsics.get(stem),
            style="camera",
            scan=scans.get(stem.replace("_image_", "_velodyne_raw_", 1)),
            depth=depth.get(stem.replace("_image_", "_groundtruth_depth_", 1)),
        )


def _find_odometry(folder: Path) -> Iterable[FramePaths]:
    """Find the frames of KITTI odometry: the colour pairs, else the grey ones.

    ``folder`` is a sequence, or holds all sequences.
    """
    sequences = [folder]
    for pattern in ("*", "*sequences/*", "dataset/sequences/*"):
        sequences += sorted(folder.glob(pattern))
    for sequence in sequences:
        if not (sequence / "calib.txt").is_file():
            continue
        is_grey = not (sequence / "image_2").is_dir()
        lefts = _list_files(sequence / ("image_0" if is_grey else "image_2"))
        yield from _make_frames(
            lefts,
            "grey" if is_grey else "object",
            "" if sequence == folder else f"{sequence.name}_",
            calibration={normalise_stem(left): sequence / "calib.txt" for left in lefts},
            right=_list_by_stem(sequence / ("image_1" if is_grey else "image_3")),
            velodyne=_list_by_stem(sequence / "velodyne", (".bin",)),
        )


def _find_object_or_2015(folder: Path) -> Iterable[FramePaths]:
    """Find the frames of KITTI object, or those of KITTI 2015 that have truth."""
    return _find_benchmark(folder, "image_2", "image_3", "_0")


def _find_2012(folder: Path) -> Iterable[FramePaths]:
    """Find the frames of KITTI 2012 that have truth."""
    return _find_benchmark(folder, "colored_0", "colored_1", "")


def _find_benchmark(
    folder: Path, left_name: str, right_name: str, ending: str
) -> Iterable[FramePaths]:
    """Find the frames of KITTI object, 2012 or 2015; of 2012 and 2015 only those with truth.

    Args:
        folder: the set, or its folder ``training``.
        left_name: folder of the left images.
        right_name: folder of the right images.
        ending: ending of the names of folders with true disparity.
    """
    root = folder / "training" if (folder / "training" / left_name).is_dir() else folder
    lefts = _list_files(root / left_name)
    # Frames of the stereo sets are NNNNNN_10 and, without truth, NNNNNN_11; object has neither.
    lefts = [left for left in lefts if normalise_stem(left).endswith("_10")] or lefts
    # The calibration NNNNNN.txt is that of object's frame NNNNNN, or of the stereo sets' NNNNNN_10.
    texts = _list_by_stem(root / "calib_cam_to_cam", (".txt",)) | _list_by_stem(
        root / "calib", (".txt",)
    )
    texts = {f"{stem}_10": path for stem, path in texts.items()} | texts
    return _make_frames(
        lefts,
        "object",
        calibration=texts,
        right=_list_by_stem(root / right_name),
        velodyne=_list_by_stem(root / "velodyne", (".bin",)),
        depth=_list_by_stem(root / "gt_depth_map"),
        disparity=_list_by_stem(root / f"disp_occ{ending}"),
        disparity_noc=_list_by_stem(root / f"disp_noc{ending}"),
    )


def _find_middlebury(folder: Path) -> Iterable[FramePaths]:
    """Find the scenes of a folder in Middlebury's layout, up to two folders deep."""
    for scene in [folder, *folder.glob("*"), *folder.glob("*/*")]:
        if not (scene / "calib.txt").is_file():
            continue
        views = _list_by_stem(scene, LISTED_SUFFIXES)
        truth = _list_by_stem(scene, (".pfm",))
        if "im0" in views:
            yield FramePaths(
                name="_".join(scene.relative_to(folder).parts) or scene.name,
                left=views["im0"],
                right=views.get("im1"),
                calibration=scene / "calib.txt",
                style="middlebury",
                disparity=truth.get("disp0GT") or truth.get("disp0"),
            )


def _find_pairs(folder: Path) -> Iterable[FramePaths]:
    """Find the frames of a plain folder: left, right, lidar_depth, disp_occ and a calibration."""
    cameras = _list_by_stem(folder, (".json", ".yaml", ".yml"))
    camera = cameras.get("camera")
    text = folder / "calib.txt"
    calibration = camera or (text if text.is_file() else None)

    # Right views by the stems of the left ones, which may differ: left_0004 and right_0004.
    lefts = _list_files(folder / "left")
    right = _list_by_stem(folder / "right")
    if right and not any(normalise_stem(left) in right for left in lefts):
        with suppress(InputError):  # no pairs of names: the left images are single
            partners = find_partners(
                [normalise_stem(left) for left in lefts], list(right), str(folder)
            )
            views = list(right.values())
            right = {
                normalise_stem(left): views[k] for left, k in zip(lefts, partners, strict=True)
            }
    return _make_frames(
        lefts,
        "camera" if camera else "plain",
        calibration={normalise_stem(left): calibration for left in lefts if calibration},
        right=right,
        depth=_list_by_stem(folder / "lidar_depth"),
        disparity=_list_by_stem(folder / "disp_occ"),
    )


LAYOUTS = {
    "packed shards": Layout(find=find_packed_frames, parts="index.json of 'depthpose data pack'"),
    "KITTI raw": Layout(find=_find_raw, parts="DATE/DATE_drive_NNNN_sync/image_02/data"),
    "KITTI depth selection": Layout(
        find=_find_depth_selection,
        parts="val_selection_cropped: image, groundtruth_depth, intrinsics",
    ),
    "KITTI odometry": Layout(find=_find_odometry, parts="sequences/NN/image_2, image_3, calib.txt"),
    "KITTI object or 2015": Layout(
        find=_find_object_or_2015,
        parts="image_2, image_3, calib or disp_occ_0",
    ),
    "KITTI 2012": Layout(
        find=_find_2012,
        parts="colored_0, colored_1",
    ),
    "Middlebury": Layout(find=_find_middlebury, parts="SCENE/im0.png, calib.txt"),
    "pairs": Layout(find=_find_pairs, parts="left, right, calib.txt or camera.json, .yaml"),
}
"""Layouts of folders, tried in this order: a new one is a function and one entry here."""


def _list_by_stem(
    folder: Path, suffixes: tuple[str, ...] = (*LISTED_SUFFIXES, *files.MAP_SUFFIXES)
) -> dict[str, Path]:
    """List files by their stems; of files of one stem, that of the first suffix counts."""
    paths = _list_files(folder, suffixes)
    paths.sort(key=lambda path: suffixes.index(path.suffix.lower()))
    return {normalise_stem(path): path for path in reversed(paths)}  # the last one of a stem stays


def _list_files(folder: Path, suffixes: tuple[str, ...] = LISTED_SUFFIXES) -> list[Path]:
    """List the files of a folder with one of the suffixes, in any case; [] without a folder."""
    if not folder.is_dir():
        return []
    paths = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted(path for path in paths if path.suffix.lower() in suffixes and path.is_file())
