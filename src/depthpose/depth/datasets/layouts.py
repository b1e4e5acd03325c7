"""Folders to frames: which layout this is, and where each frame's parts lie."""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from depthpose.core.errors import InputError
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
        annotated = _depth_folder(drive, "groundtruth", "data_depth_annotated")
        scans = _depth_folder(drive, "velodyne_raw", "data_depth_velodyne")
        for left in _images(drive / "image_02/data"):
            yield Frame(
                name=f"{drive.name}_{left.stem}",
                left=left,
                right=_partner(drive / "image_03/data", left.stem),
                calibration=date if (date / "calib_cam_to_cam.txt").exists() else None,
                style="raw",
                velodyne=_existing(drive / "velodyne_points/data" / f"{left.stem}.bin"),
                scan=_existing(scans / f"{left.stem}.png"),
                depth=_existing(annotated / f"{left.stem}.png"),
                disparity=_existing(drive / "disp_occ" / f"{left.stem}.png"),
                disparity_noc=_existing(drive / "disp_noc" / f"{left.stem}.png"),
                sky=_existing(drive / "sky" / f"{left.stem}.png"),
            )


def _depth_folder(drive: Path, kind: str, archive: str) -> Path:
    """Find maps of a drive's left camera, wherever in the tree the dataset was opened.

    KITTI's depth-prediction set holds them as ``train|val/DRIVE/proj_depth/KIND/image_02``, its
    downloads each in a folder of the archive's name.
    """
    inside = f"proj_depth/{kind}/image_02"
    homes = (drive.parent, drive.parent.parent)
    roots = [root for home in homes for root in (home, home / archive)]
    homes = [drive, *(root / part / drive.name for root in roots for part in ("train", "val"))]
    return next((home / inside for home in homes if (home / inside).is_dir()), drive / inside)


def _object_or_2015(folder: Path) -> Iterable[Frame]:
    home = folder / "training" if (folder / "training/image_2").is_dir() else folder
    lefts = _images(home / "image_2")
    is_stereo = any(left.stem.endswith("_10") for left in lefts)  # its testing folder too
    for left in lefts:
        if is_stereo and not left.stem.endswith("_10"):
            continue
        number = left.stem.removesuffix("_10")
        yield Frame(
            name=left.stem,
            left=left,
            right=_partner(home / "image_3", left.stem),
            calibration=_existing(home / "calib" / f"{left.stem}.txt")
            or _existing(home / "calib_cam_to_cam" / f"{number}.txt"),
            style="object",
            velodyne=_existing(home / "velodyne" / f"{left.stem}.bin"),
            depth=_existing(home / "gt_depth_map" / f"{left.stem}.png"),
            disparity=_existing(home / "disp_occ_0" / f"{left.stem}.png"),
            disparity_noc=_existing(home / "disp_noc_0" / f"{left.stem}.png"),
        )


def _kitti_2012(folder: Path) -> Iterable[Frame]:
    home = folder / "training" if (folder / "training/colored_0").is_dir() else folder
    for left in _images(home / "colored_0"):
        if left.stem.endswith("_10"):
            yield Frame(
                name=left.stem,
                left=left,
                right=_partner(home / "colored_1", left.stem),
                calibration=_existing(home / "calib" / f"{left.stem.removesuffix('_10')}.txt"),
                style="object",
                disparity=_existing(home / "disp_occ" / f"{left.stem}.png"),
                disparity_noc=_existing(home / "disp_noc" / f"{left.stem}.png"),
            )


def _middlebury(folder: Path) -> Iterable[Frame]:
    for scene in [folder, *folder.glob("*"), *folder.glob("*/*")]:
        if (scene / "calib.txt").is_file() and (scene / "im0.png").is_file():
            yield Frame(
                name="_".join(scene.relative_to(folder).parts) or scene.name,
                left=scene / "im0.png",
                right=_existing(scene / "im1.png"),
                calibration=scene / "calib.txt",
                style="middlebury",
                disparity=_existing(scene / "disp0GT.pfm") or _existing(scene / "disp0.pfm"),
            )


def _pairs(folder: Path) -> Iterable[Frame]:
    cameras = (_existing(folder / f"camera{suffix}") for suffix in (".json", ".yaml", ".yml"))
    camera = next((path for path in cameras if path is not None), None)
    text = _existing(folder / "calib.txt")
    for left in _images(folder / "left"):
        yield Frame(
            name=left.stem,
            left=left,
            right=_partner(folder / "right", left.stem),
            calibration=camera or text,
            style="camera" if camera else "plain",
            depth=_existing(folder / "lidar_depth" / f"{left.stem}.png"),
            disparity=_existing(folder / "disp_occ" / f"{left.stem}.png"),
        )


LAYOUTS = {
    "packed shards": Layout(find=packed_frames, parts="index.json of 'depthpose data pack'"),
    "KITTI raw": Layout(find=_raw, parts="DATE/DATE_drive_NNNN_sync/image_02/data"),
    "KITTI object or 2015": Layout(
        find=_object_or_2015, parts="image_2, image_3, calib or disp_occ_0"
    ),
    "KITTI 2012": Layout(find=_kitti_2012, parts="colored_0, colored_1"),
    "Middlebury": Layout(find=_middlebury, parts="SCENE/im0.png, calib.txt"),
    "pairs": Layout(find=_pairs, parts="left, right, calib.txt or camera.json, .yaml"),
}
"""Layouts of folders, tried in this order: a new one is a function and one entry here."""


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    found = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted(path for path in found if path.suffix.lower() in LISTED_SUFFIXES)


def _partner(folder: Path, stem: str) -> Path | None:
    candidates = (folder / f"{stem}{ending}" for ending in LISTED_SUFFIXES)
    return next((path for path in candidates if path.is_file()), None)


def _existing(path: Path) -> Path | None:
    return path if path.is_file() else None
