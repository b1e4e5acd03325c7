"""Layouts of folders: recognised, packed into tar shards, and KITTI's raw layout written."""

import hashlib
import io
import os
import re
import tarfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from depthpose.core import files
from depthpose.core.errors import InputError
from depthpose.core.files.disk import SOURCE, find_partners, stem_of, write_bytes
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.core.run import is_whole, note_result
from depthpose.depth.datasets.frames import CalibrationStyle, Frame
from depthpose.depth.types import RawFrame

INDEX = "index.json"
"""What a packed data set holds; written last."""
_CALIBRATION = "calibration"
_PARTS = ("left", "right", "velodyne", "scan", "depth", "disparity", "disparity_noc", "sky")
_URL = re.compile(r"([a-z][a-z0-9+]+):/+(?=[^/])")


def pack_frames(
    frames: list[Frame], out: Path, shard_bytes: int, show: Callable[[str], object] = lambda _: None
) -> int:
    """Copy frames into tar shards, in WebDataset's form, and give the number of shards.

    Files are copied as they are, so that what is trained on shards has the weights that it would
    have from the folder. ``KEY.left.png`` and the like lie in ``000000.tar``, calibration in
    ``calibration/``, and ``index.json`` says where each frame's parts are. A shard is written whole
    or not at all, the index last; a second call writes everything again.

    A shard is closed when it has ``shard_bytes``; ``show`` is called with the name of each frame.

    Raises:
        InputError: a file is missing or damaged, or the disk refuses.
    """
    rows: list[dict[str, Any]] = []
    place_of: dict[Path, str] = {}  # where each calibration lies
    for calibration in dict.fromkeys(frame.calibration for frame in frames if frame.calibration):
        place_of[calibration] = place = f"{_CALIBRATION}/{len(place_of):06d}"
        if calibration.is_file():
            place_of[calibration] = place = f"{place}{calibration.suffix}"
            write_bytes(out / place, files.read_bytes(calibration))
        else:  # KITTI raw: the folder of a date
            for file in sorted(calibration.glob("calib_*.txt")):
                write_bytes(out / place / file.name, files.read_bytes(file))
    remaining = list(frames)
    shards = 0
    while remaining:
        name = f"{shards:06d}.tar"
        size = 0
        with files.atomic_write(out / name) as part, tarfile.open(part, "w") as tar:
            while remaining:
                frame = remaining.pop(0)
                key = f"{len(rows):08d}"
                row = {"name": frame.name, "style": frame.style}
                for what in _PARTS:
                    path = getattr(frame, what)
                    if path is None:
                        continue
                    data = files.read_bytes(path)
                    member = tarfile.TarInfo(f"{key}.{what}{path.suffix.lower()}")
                    member.size = len(data)
                    tar.addfile(member, io.BytesIO(data))
                    row[what] = f"{name}/{member.name}"
                    size += len(data)
                if frame.calibration is not None:
                    row["calibration"] = place_of[frame.calibration]
                rows.append(row)
                show(frame.name)
                if size >= shard_bytes:
                    break
        shards += 1
    files.write_json(out / INDEX, {"frames": rows})
    return shards


def packed_frames(folder: Path) -> Iterator[Frame]:
    """List the frames of a packed data set; none where there is no index."""
    index = folder / INDEX
    if not index.is_file():
        return
    columns = {field.name for field in fields(Frame)}
    content = files.read_json(index)
    rows = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(rows, list):
        return  # an index of somebody else
    for number, row in enumerate(rows):
        is_row = isinstance(row, dict) and {"name", "style", "left"} <= set(row) <= columns
        if not is_row or not all(isinstance(value, str) for value in row.values()):
            raise InputError(f"{index}: frame {number} is not as 'depthpose data pack' writes it")
        paths = {k: folder / v for k, v in row.items() if k not in ("name", "style")}
        if not all(path.resolve().is_relative_to(folder.resolve()) for path in paths.values()):
            raise InputError(f"{index}: frame {number} names a file outside of the folder")
        yield Frame(name=row["name"], style=row["style"], **paths)


def local_folder(folder: Path | str) -> Path:
    """Give the folder itself; for a URL, a local one to which its shards come as they are read.

    It is in ``$DEPTHPOSE_CACHE``, by default ``~/.cache/depthpose``.
    """
    text = str(folder)
    if _URL.match(text) is None:
        return Path(folder)
    url = _URL.sub(r"\1://", text, count=1).rstrip("/")  # a Path has made one slash of two
    local = files.cache_folder() / "shards" / hashlib.sha256(url.encode()).hexdigest()[:16]
    from depthpose.core.files.disk import fetch  # fsspec takes time
    from depthpose.core.files.stores import exists, join, list_tree

    if not exists(join(url, INDEX)):
        raise InputError(f"{url}: holds no {INDEX}; 'depthpose data pack' makes one")
    for name, of_file in list_tree(join(url, _CALIBRATION)).items():
        if ".." not in Path(name).parts:
            fetch(of_file, local / _CALIBRATION / name)
    fetch(join(url, INDEX), local / INDEX)
    files.write_json(local / SOURCE, {"url": url})
    return local


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How the files of a dataset lie in its folder."""

    find: Callable[[Path], Iterable[Frame]]  # the frames of a folder; none in another layout
    parts: str  # the files and folders by which people recognise it


def find_frames(folder: Path) -> tuple[str, list[Frame]]:
    """Recognise the layout of a folder and list its frames, sorted by name."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder. Give the folder of a dataset.")
    folder = Path(os.path.abspath(folder))  # noqa: PTH100  '.' has no name, and a link keeps its own
    for name, layout in LAYOUTS.items():
        frames = sorted(layout.find(folder), key=lambda frame: frame.name)
        if frames:
            return name, frames
    children = sorted(folder.iterdir())
    names = ", ".join(path.name for path in children[:8]) or "nothing"
    inside = [
        path.name
        for path in children[:50]
        if path.is_dir() and any(next(iter(layout.find(path)), None) for layout in LAYOUTS.values())
    ]
    hint = f" Open one of its folders instead: {', '.join(inside)}." if inside else ""
    drives = (folder, *children, *folder.glob("*/*_extract"))
    if any(path.name.endswith("_extract") for path in drives):
        hint += (
            " Drives called _extract hold KITTI's raw images, which are neither rectified nor "
            "synchronised: take those called _sync."
        )
    known_layouts = ", ".join(f"{name} ({layout.parts})" for name, layout in LAYOUTS.items())
    raise InputError(
        f"{folder}: no layout that is known here. It holds {names}. Known: {known_layouts}.{hint}"
    )


def _frames(
    lefts: list[Path], style: CalibrationStyle, prefix: str = "", **parts: Mapping[str, Path]
) -> Iterator[Frame]:
    """Frames of left images, with the parts of the same stem."""
    for left in lefts:
        others = {part: files_of_part.get(stem_of(left)) for part, files_of_part in parts.items()}
        yield Frame(name=prefix + stem_of(left), left=left, style=style, **others)


def _raw(folder: Path) -> Iterable[Frame]:
    """KITTI raw: a root of dates, a date or a drive; its depth-prediction set inside or beside."""
    itself = [folder] if folder.name.endswith("_sync") else []
    for drive in sorted([*itself, *folder.glob("*_sync"), *folder.glob("*/*_sync")]):
        date = drive.parent
        lefts = _listed(drive / "image_02/data")
        is_calibrated = (date / "calib_cam_to_cam.txt").exists()
        maps: list[Path] = []  # of the left camera, wherever in the tree the dataset was opened
        for kind, archive in (("velodyne_raw", "velodyne"), ("groundtruth", "annotated")):
            inside = f"proj_depth/{kind}/image_02"
            tops = (date, date / f"data_depth_{archive}", date.parent)
            roots = [*tops, date.parent / f"data_depth_{archive}"]
            homes = [root / part / drive.name for root in roots for part in ("train", "val")]
            folders = (home / inside for home in (drive, *homes) if (home / inside).is_dir())
            maps.append(next(folders, drive / inside))
        yield from _frames(
            lefts,
            "raw",
            f"{drive.name}_",
            calibration={stem_of(left): date for left in lefts if is_calibrated},
            right=_by_stem(drive / "image_03/data"),
            velodyne=_by_stem(drive / "velodyne_points/data", (".bin",)),
            scan=_by_stem(maps[0]),
            depth=_by_stem(maps[1]),
            disparity=_by_stem(drive / "disp_occ"),
            disparity_noc=_by_stem(drive / "disp_noc"),
            sky=_by_stem(drive / "sky"),
        )


def _depth_selection(folder: Path) -> Iterable[Frame]:
    """KITTI's frames for completion and prediction of depth: cropped, each with its camera."""
    inner = folder / "val_selection_cropped"
    home = inner if inner.is_dir() else folder
    if not (home / "intrinsics").is_dir():
        return
    lenses = _by_stem(home / "intrinsics", (".txt",))
    scans = _by_stem(home / "velodyne_raw")
    depth = _by_stem(home / "groundtruth_depth")
    for left in _listed(home / "image"):
        yield Frame(
            name=stem_of(left),
            left=left,
            calibration=lenses.get(stem_of(left)),
            style="camera",
            scan=scans.get(stem_of(left).replace("_image_", "_velodyne_raw_", 1)),
            depth=depth.get(stem_of(left).replace("_image_", "_groundtruth_depth_", 1)),
        )


def _odometry(folder: Path) -> Iterable[Frame]:
    """A sequence of KITTI odometry, or the folder of all: in colour, else in grey."""
    homes = [folder, *sorted(folder.glob("*")), *sorted(folder.glob("*sequences/*"))]
    for home in (*homes, *sorted(folder.glob("dataset/sequences/*"))):
        if not (home / "calib.txt").is_file():
            continue
        is_grey = not (home / "image_2").is_dir()
        lefts = _listed(home / ("image_0" if is_grey else "image_2"))
        yield from _frames(
            lefts,
            "grey" if is_grey else "object",
            "" if home == folder else f"{home.name}_",
            calibration={stem_of(left): home / "calib.txt" for left in lefts},
            right=_by_stem(home / ("image_1" if is_grey else "image_3")),
            velodyne=_by_stem(home / "velodyne", (".bin",)),
        )


def _benchmark(folder: Path, left_name: str, right_name: str, ending: str) -> Iterable[Frame]:
    """KITTI object, 2012 or 2015: of the stereo sets the frames that have truth, NNNNNN_10."""
    home = folder / "training" if (folder / "training" / left_name).is_dir() else folder
    lefts = _listed(home / left_name)
    # Of the stereo sets the testing folder too.
    lefts = [left for left in lefts if stem_of(left).endswith("_10")] or lefts
    texts = _by_stem(home / "calib_cam_to_cam", (".txt",)) | _by_stem(home / "calib", (".txt",))
    texts = {f"{stem}_10": path for stem, path in texts.items()} | texts
    return _frames(
        lefts,
        "object",
        calibration=texts,
        right=_by_stem(home / right_name),
        velodyne=_by_stem(home / "velodyne", (".bin",)),
        depth=_by_stem(home / "gt_depth_map"),
        disparity=_by_stem(home / f"disp_occ{ending}"),
        disparity_noc=_by_stem(home / f"disp_noc{ending}"),
    )


def _middlebury(folder: Path) -> Iterable[Frame]:
    """Find the scenes of a folder in Middlebury's layout, up to two folders deep."""
    for scene in [folder, *folder.glob("*"), *folder.glob("*/*")]:
        if not (scene / "calib.txt").is_file():
            continue
        views = _by_stem(scene, LISTED_SUFFIXES)
        truth = _by_stem(scene, (".pfm",))
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
    """Find the frames of a plain folder: left, right, lidar_depth, disp_occ and a calibration."""
    cameras = _by_stem(folder, (".json", ".yaml", ".yml"))
    camera = cameras.get("camera")
    text = folder / "calib.txt"
    lefts = _listed(folder / "left")
    right = _by_stem(folder / "right")
    if right and not any(stem_of(left) in right for left in lefts):
        with suppress(InputError):  # left_0004 and right_0004
            order = find_partners([stem_of(left) for left in lefts], list(right), str(folder))
            views = list(right.values())
            right = {stem_of(left): views[k] for left, k in zip(lefts, order, strict=True)}
    calibration = camera or (text if text.is_file() else None)
    return _frames(
        lefts,
        "camera" if camera else "plain",
        calibration={stem_of(left): calibration for left in lefts if calibration},
        right=right,
        depth=_by_stem(folder / "lidar_depth"),
        disparity=_by_stem(folder / "disp_occ"),
    )


LAYOUTS = {
    "packed shards": Layout(find=packed_frames, parts="index.json of 'depthpose data pack'"),
    "KITTI raw": Layout(find=_raw, parts="DATE/DATE_drive_NNNN_sync/image_02/data"),
    "KITTI depth selection": Layout(
        find=_depth_selection, parts="val_selection_cropped: image, groundtruth_depth, intrinsics"
    ),
    "KITTI odometry": Layout(find=_odometry, parts="sequences/NN/image_2, image_3, calib.txt"),
    "KITTI object or 2015": Layout(
        find=partial(_benchmark, left_name="image_2", right_name="image_3", ending="_0"),
        parts="image_2, image_3, calib or disp_occ_0",
    ),
    "KITTI 2012": Layout(
        find=partial(_benchmark, left_name="colored_0", right_name="colored_1", ending=""),
        parts="colored_0, colored_1",
    ),
    "Middlebury": Layout(find=_middlebury, parts="SCENE/im0.png, calib.txt"),
    "pairs": Layout(find=_pairs, parts="left, right, calib.txt or camera.json, .yaml"),
}
"""Layouts of folders, tried in this order: a new one is a function and one entry here."""


def _by_stem(
    folder: Path, suffixes: tuple[str, ...] = (*LISTED_SUFFIXES, *files.MAP_SUFFIXES)
) -> dict[str, Path]:
    """List files by their stems; of two suffixes the first one counts, in capitals or not."""
    paths = sorted(_listed(folder, suffixes), key=lambda path: suffixes.index(path.suffix.lower()))
    return {stem_of(path): path for path in reversed(paths)}


def _listed(folder: Path, suffixes: tuple[str, ...] = LISTED_SUFFIXES) -> list[Path]:
    if not folder.is_dir():
        return []
    paths = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted(path for path in paths if path.suffix.lower() in suffixes and path.is_file())


_CALIBRATION_FILES = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")


def has_raw_frame(folder: Path, drive: str, number: int) -> bool:
    """Whether a frame is there, and every file of it as it was written."""
    last = f"{drive[:10]}/{drive}/disp_occ/{number:010d}.png"
    return is_whole(folder, f"{drive}/{number:010d}", [last])


def has_calibration(folder: Path, date: str) -> bool:
    """Whether the calibration of a date is there as it was written."""
    return is_whole(folder, date, [f"{date}/{name}" for name in _CALIBRATION_FILES])


def write_raw_frame(folder: Path, drive: str, number: int, frame: RawFrame) -> None:
    """Write a frame: images, LiDAR scan, disparity, and once a date the calibration.

    ``image_02/data``, ``image_03/data`` and ``velodyne_points/data`` are KITTI's own folders;
    disparity, which KITTI raw has not, goes beside them into ``disp_occ`` (all pixels) and
    ``disp_noc`` (those that both views show), as 16-bit PNG x 256, and the sky into ``sky``.

    ``drive`` is ``DATE_drive_NNNN_sync``, ``number`` that of the frame in it.

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

    files.write_image(new("image_02/data"), frame.left)
    files.write_image(new("image_03/data"), frame.right)
    if frame.lidar_points is not None:
        scan = frame.lidar_points.float().contiguous().numpy().astype("<f4")
        write_bytes(new("velodyne_points/data", ".bin"), scan.tobytes())
    files.write_image(new("sky"), frame.is_sky.float().expand(3, -1, -1))
    seen_by_both = torch.where(frame.occluded, torch.nan, frame.disparity_px)
    files.write_depth_png(new("disp_noc"), seen_by_both)
    files.write_depth_png(new("disp_occ"), frame.disparity_px)
    note_result(folder, f"{drive}/{name}", written)


def has_scene(folder: Path, name: str) -> bool:
    """Whether a scene of :func:`write_scene` is there, and every file of it as it was written."""
    return is_whole(folder, name, [f"{name}/disp0.pfm"])


def write_scene(folder: Path, name: str, frame: RawFrame) -> None:
    """Write a pair of a rig of its own in Middlebury's layout: images, disparity, calibration.

    ``NAME/im0.png``, ``im1.png``, ``disp0.pfm`` (hidden pixels too, infinity where unknown) and
    ``calib.txt``.

    Raises:
        InputError: the disk refuses.
    """
    home = folder / name
    rig = frame.rig
    written = [home / part for part in ("im0.png", "im1.png", "disp0.pfm", "calib.txt")]
    files.write_image(written[0], frame.left)
    files.write_image(written[1], frame.right)
    files.write_map(written[2], frame.disparity_px)
    right = rig.K.clone()
    right[0, 2] += rig.cx_right_minus_left_px
    matrices = (
        "; ".join(" ".join(f"{value:.10g}" for value in row) for row in K.tolist())
        for K in (rig.K, right)
    )
    lines = [f"cam{k}=[{text}]" for k, text in enumerate(matrices)]
    lines += [
        f"doffs={rig.cx_right_minus_left_px:.10g}",
        f"baseline={1000 * rig.baseline_m:.10g}",
        f"width={rig.width}",
        f"height={rig.height}",
    ]
    write_bytes(written[3], ("\n".join(lines) + "\n").encode())
    note_result(folder, name, written)


def _write_calibration(folder: Path, date: str, frame: RawFrame) -> None:
    """Write the calibration of a date once; one that is not as it was written, again."""
    rig = frame.rig
    eye = np.eye(3)
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
    paths = [folder / date / name for name in _CALIBRATION_FILES]
    for path, matrices in zip(paths, (cameras, poses), strict=True):
        lines = [
            f"{name}: " + " ".join(f"{value:.12e}" for value in matrix.ravel())
            for name, matrix in matrices.items()
        ]
        text = "\n".join(lines) + "\n"
        if not is_there:
            write_bytes(path, text.encode())
        elif files.read_text(path) != text:
            raise InputError(
                f"{path}: belongs to frames of another rig or scale; write these to another folder"
            )
    if not is_there:
        note_result(folder, date, paths)
