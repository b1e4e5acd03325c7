"""Folders to frames: which layout this is, and where each frame's parts lie."""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from depthpose.core.errors import InputError
from depthpose.core.files import MAP_SUFFIXES
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.depth.datasets.frames import Frame
from depthpose.depth.datasets.packed import packed_frames


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How the files of a dataset lie in its folder.

    Attributes:
        find: gives the frames of a folder; none where it has another layout.
        parts: the files and folders by which people recognise it.
    """

    find: Callable[[Path], Iterable[Frame]]
    parts: str


def find_frames(folder: Path) -> tuple[str, list[Frame]]:
    """Recognise the layout of a folder and list its frames, sorted by name.

    Raises:
        InputError: no such folder, no known layout, or no image.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder. Give the folder of a dataset.")
    folder = Path(os.path.abspath(folder))  # noqa: PTH100  '.' has no name, and a link keeps its own
    known = _recognise(folder)
    if known is not None:
        return known
    children = sorted(folder.iterdir())
    found = ", ".join(path.name for path in children[:8]) or "nothing"
    inside = [path.name for path in children[:50] if path.is_dir() and _recognise(path)]
    hint = f" Open one of its folders instead: {', '.join(inside)}." if inside else ""
    if any(
        path.name.endswith("_extract") for path in (folder, *children, *folder.glob("*/*_extract"))
    ):
        hint += (
            " Drives called _extract hold KITTI's raw images, which are neither rectified nor "
            "synchronised: take those called _sync."
        )
    known_layouts = ", ".join(f"{name} ({one.parts})" for name, one in LAYOUTS.items())
    raise InputError(
        f"{folder}: no layout that is known here. It holds {found}. Known: {known_layouts}.{hint}"
    )


def _recognise(folder: Path) -> tuple[str, list[Frame]] | None:
    for name, layout in LAYOUTS.items():
        frames = sorted(layout.find(folder), key=lambda frame: frame.name)
        if frames:
            return name, frames
    return None


def _raw(folder: Path) -> Iterable[Frame]:
    """KITTI raw: a root of dates, a date or a drive; its depth-prediction set inside or beside."""
    itself = [folder] if folder.name.endswith("_sync") else []
    for drive in sorted([*itself, *folder.glob("*_sync"), *folder.glob("*/*_sync")]):
        date = drive.parent
        right, disparity, disparity_noc, sky = (
            _by_stem(drive / part) for part in ("image_03/data", "disp_occ", "disp_noc", "sky")
        )
        annotated = _by_stem(_depth_folder(drive, "groundtruth", "data_depth_annotated"))
        scans = _by_stem(_depth_folder(drive, "velodyne_raw", "data_depth_velodyne"))
        points = _by_stem(drive / "velodyne_points/data", (".bin",))
        for left in _images(drive / "image_02/data"):
            yield Frame(
                name=f"{drive.name}_{left.stem}",
                left=left,
                right=right.get(left.stem),
                calibration=date if (date / "calib_cam_to_cam.txt").exists() else None,
                style="raw",
                velodyne=points.get(left.stem),
                scan=scans.get(left.stem),
                depth=annotated.get(left.stem),
                disparity=disparity.get(left.stem),
                disparity_noc=disparity_noc.get(left.stem),
                sky=sky.get(left.stem),
            )


def _depth_folder(drive: Path, kind: str, archive: str) -> Path:
    """Find maps of a drive's left camera, wherever in the tree the dataset was opened."""
    inside = f"proj_depth/{kind}/image_02"
    homes = (drive.parent, drive.parent.parent)
    roots = [root for home in homes for root in (home, home / archive)]
    homes = [drive, *(root / part / drive.name for root in roots for part in ("train", "val"))]
    return next((home / inside for home in homes if (home / inside).is_dir()), drive / inside)


def _depth_selection(folder: Path) -> Iterable[Frame]:
    """KITTI's frames for completion and prediction of depth: cropped, each with its camera."""
    inner = folder / "val_selection_cropped"
    home = inner if inner.is_dir() else folder
    if not (home / "intrinsics").is_dir():
        return
    lenses = _by_stem(home / "intrinsics", (".txt",))
    scans, depth = _by_stem(home / "velodyne_raw"), _by_stem(home / "groundtruth_depth")
    for left in _images(home / "image"):
        yield Frame(
            name=left.stem,
            left=left,
            calibration=lenses.get(left.stem),
            style="camera",
            scan=scans.get(left.stem.replace("_image_", "_velodyne_raw_", 1)),
            depth=depth.get(left.stem.replace("_image_", "_groundtruth_depth_", 1)),
        )


def _odometry(folder: Path) -> Iterable[Frame]:
    """A sequence of KITTI odometry, or the folder of all: in colour, else in grey."""
    homes = [folder, *sorted(folder.glob("*")), *sorted(folder.glob("*sequences/*"))]
    for home in (*homes, *sorted(folder.glob("dataset/sequences/*"))):
        one, other = (
            ("image_2", "image_3") if (home / "image_2").is_dir() else ("image_0", "image_1")
        )
        if not (home / "calib.txt").is_file():
            continue
        right, points = _by_stem(home / other), _by_stem(home / "velodyne", (".bin",))
        for left in _images(home / one):
            yield Frame(
                name=left.stem if home == folder else f"{home.name}_{left.stem}",
                left=left,
                right=right.get(left.stem),
                calibration=home / "calib.txt",
                style="object" if one == "image_2" else "grey",
                velodyne=points.get(left.stem),
            )


def _benchmark(folder: Path, one: str, other: str, ending: str) -> Iterable[Frame]:
    """KITTI object, 2012 or 2015: of the stereo sets the frames that have truth, NNNNNN_10."""
    home = folder / "training" if (folder / "training" / one).is_dir() else folder
    lefts = _images(home / one)
    is_stereo = any(left.stem.endswith("_10") for left in lefts)  # its testing folder too
    right, depth, disparity, disparity_noc = (
        _by_stem(home / part)
        for part in (other, "gt_depth_map", f"disp_occ{ending}", f"disp_noc{ending}")
    )
    texts = _by_stem(home / "calib_cam_to_cam", (".txt",)) | _by_stem(home / "calib", (".txt",))
    points = _by_stem(home / "velodyne", (".bin",))
    for left in lefts:
        if is_stereo and not left.stem.endswith("_10"):
            continue
        yield Frame(
            name=left.stem,
            left=left,
            right=right.get(left.stem),
            calibration=texts.get(left.stem) or texts.get(left.stem.removesuffix("_10")),
            style="object",
            velodyne=points.get(left.stem),
            depth=depth.get(left.stem),
            disparity=disparity.get(left.stem),
            disparity_noc=disparity_noc.get(left.stem),
        )


def _middlebury(folder: Path) -> Iterable[Frame]:
    for scene in [folder, *folder.glob("*"), *folder.glob("*/*")]:
        if not (scene / "calib.txt").is_file():
            continue
        views, truth = _by_stem(scene, LISTED_SUFFIXES), _by_stem(scene, (".pfm",))
        if "im0" in views:
            yield Frame(
                name="_".join(scene.relative_to(folder).parts) or scene.name,
                left=views["im0"],
                right=views.get("im1"),
                calibration=scene / "calib.txt",
                style="middlebury",
                disparity=truth.get("disp0GT") or truth.get("disp0"),
            )


def _pairs(folder: Path) -> Iterable[Frame]:
    cameras = _by_stem(folder, (".json", ".yaml", ".yml"))
    camera, text = cameras.get("camera"), folder / "calib.txt"
    right, depth, disparity = (
        _by_stem(folder / part) for part in ("right", "lidar_depth", "disp_occ")
    )
    for left in _images(folder / "left"):
        yield Frame(
            name=left.stem,
            left=left,
            right=right.get(left.stem),
            calibration=camera or (text if text.is_file() else None),
            style="camera" if camera else "plain",
            depth=depth.get(left.stem),
            disparity=disparity.get(left.stem),
        )


LAYOUTS = {
    "packed shards": Layout(find=packed_frames, parts="index.json of 'depthpose data pack'"),
    "KITTI raw": Layout(find=_raw, parts="DATE/DATE_drive_NNNN_sync/image_02/data"),
    "KITTI depth selection": Layout(
        find=_depth_selection, parts="val_selection_cropped: image, groundtruth_depth, intrinsics"
    ),
    "KITTI odometry": Layout(find=_odometry, parts="sequences/NN/image_2, image_3, calib.txt"),
    "KITTI object or 2015": Layout(
        find=partial(_benchmark, one="image_2", other="image_3", ending="_0"),
        parts="image_2, image_3, calib or disp_occ_0",
    ),
    "KITTI 2012": Layout(
        find=partial(_benchmark, one="colored_0", other="colored_1", ending=""),
        parts="colored_0, colored_1",
    ),
    "Middlebury": Layout(find=_middlebury, parts="SCENE/im0.png, calib.txt"),
    "pairs": Layout(find=_pairs, parts="left, right, calib.txt or camera.json, .yaml"),
}
"""Layouts of folders, tried in this order: a new one is a function and one entry here."""


def _images(folder: Path) -> list[Path]:
    return _listed(folder, LISTED_SUFFIXES)


def _by_stem(
    folder: Path, suffixes: tuple[str, ...] = (*LISTED_SUFFIXES, *MAP_SUFFIXES)
) -> dict[str, Path]:
    """List files by their names; of two suffixes the first one counts, in capitals or not."""
    files = sorted(_listed(folder, suffixes), key=lambda path: suffixes.index(path.suffix.lower()))
    return {path.stem: path for path in reversed(files)}


def _listed(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    if not folder.is_dir():
        return []
    found = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted(path for path in found if path.suffix.lower() in suffixes and path.is_file())
