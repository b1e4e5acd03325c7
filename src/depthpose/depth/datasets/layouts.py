"""Layouts of dataset folders: recognising them, packing tar shards, writing synthetic pairs."""

import hashlib
import io
import os
import re
import tarfile
from collections import deque
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
from depthpose.core.files.disk import SOURCE, find_partners, normalise_stem, write_bytes
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.core.run import is_whole, note_result
from depthpose.depth.datasets.frames import CalibrationStyle, Frame
from depthpose.depth.types import RawFrame

INDEX = "index.json"
"""File of a packed data set that lists its frames; written last."""
_CALIBRATION = "calibration"
_PACKED_FIELDS = ("left", "right", "velodyne", "scan", "depth", "disparity", "disparity_noc", "sky")
_URL = re.compile(r"([a-z][a-z0-9+]+):/+(?=[^/])")


def pack_frames(
    frames: list[Frame], out: Path, shard_bytes: int, show: Callable[[str], object] = lambda _: None
) -> int:
    """Copy frames into tar shards, in WebDataset's form, and give the number of shards.

    Files are copied as they are, so that a training on shards gives the weights that it would give
    on the folder. ``KEY.left.png`` and the like lie in ``000000.tar``, calibration in
    ``calibration/``, and ``index.json`` lists each frame's files. Each file is written whole or not
    at all, the index last; a second call writes everything again.

    Args:
        frames: the frames.
        out: the folder of the shards.
        shard_bytes: a shard is closed when it has at least so many bytes.
        show: called with the name of each frame.

    Raises:
        InputError: a file is missing or damaged, or the disk refuses.
    """
    packed_calibrations = _pack_calibrations(frames, out)
    rows: list[dict[str, Any]] = []
    remaining = deque(frames)
    shard_count = 0
    while remaining:
        shard = f"{shard_count:06d}.tar"
        size = 0
        with files.atomic_write(out / shard) as part, tarfile.open(part, "w") as tar:
            while remaining:
                frame = remaining.popleft()
                row: dict[str, Any] = {"name": frame.name, "style": frame.style}
                for field in _PACKED_FIELDS:
                    path = getattr(frame, field)
                    if path is not None:
                        member = f"{len(rows):08d}.{field}{path.suffix.lower()}"
                        size += _add_member(tar, member, files.read_bytes(path))
                        row[field] = f"{shard}/{member}"
                if frame.calibration is not None:
                    row["calibration"] = packed_calibrations[frame.calibration]
                rows.append(row)
                show(frame.name)
                if size >= shard_bytes:
                    break
        shard_count += 1
    files.write_json(out / INDEX, {"frames": rows})
    return shard_count


def _add_member(tar: tarfile.TarFile, name: str, data: bytes) -> int:
    """Add a file to a shard, and give its size [bytes]."""
    member = tarfile.TarInfo(name)
    member.size = len(data)
    tar.addfile(member, io.BytesIO(data))
    return len(data)


def _pack_calibrations(frames: list[Frame], out: Path) -> dict[Path, str]:
    """Copy the calibrations of frames; give the path in ``out`` of each."""
    packed: dict[Path, str] = {}
    for calibration in dict.fromkeys(frame.calibration for frame in frames if frame.calibration):
        path = f"{_CALIBRATION}/{len(packed):06d}"
        if calibration.is_file():
            path += calibration.suffix
            write_bytes(out / path, files.read_bytes(calibration))
        else:  # KITTI raw: the folder of a date
            for file in sorted(calibration.glob("calib_*.txt")):
                write_bytes(out / path / file.name, files.read_bytes(file))
        packed[calibration] = path
    return packed


def packed_frames(folder: Path) -> Iterator[Frame]:
    """List the frames of a packed data set; none where there is no index.

    Raises:
        InputError: the index is damaged, or names a file outside of the folder.
    """
    index = folder / INDEX
    if not index.is_file():
        return
    content = files.read_json(index)
    rows = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(rows, list):
        return  # an index of another program
    known_fields = {field.name for field in fields(Frame)}
    for number, row in enumerate(rows):
        is_row = isinstance(row, dict) and {"name", "style", "left"} <= set(row) <= known_fields
        if not is_row or not all(isinstance(value, str) for value in row.values()):
            raise InputError(f"{index}: frame {number} is not as 'depthpose data pack' writes it")
        paths = {
            field: folder / path for field, path in row.items() if field not in ("name", "style")
        }
        if not all(path.resolve().is_relative_to(folder.resolve()) for path in paths.values()):
            raise InputError(f"{index}: frame {number} names a file outside of the folder")
        yield Frame(name=row["name"], style=row["style"], **paths)


def local_folder(folder: Path | str) -> Path:
    """Give the folder itself; for a URL of packed shards, a local folder in their place.

    That is in ``$DEPTHPOSE_CACHE``, by default ``~/.cache/depthpose``. Index and calibration are
    fetched at once, shards when they are read.

    Raises:
        InputError: the URL has no index of packed shards.
    """
    text = str(folder)
    if _URL.match(text) is None:
        return Path(folder)
    url = _URL.sub(r"\1://", text, count=1).rstrip("/")  # Path made one slash of two
    local = files.cache_folder() / "shards" / hashlib.sha256(url.encode()).hexdigest()[:16]
    from depthpose.core.files.disk import fetch  # fsspec takes time
    from depthpose.core.files.stores import exists, join, list_tree

    if not exists(join(url, INDEX)):
        raise InputError(f"{url}: holds no {INDEX}; 'depthpose data pack' makes one")
    for name, file_url in list_tree(join(url, _CALIBRATION)).items():
        if ".." not in Path(name).parts:
            fetch(file_url, local / _CALIBRATION / name)
    fetch(join(url, INDEX), local / INDEX)
    files.write_json(local / SOURCE, {"url": url})
    return local


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A way in which the files of a dataset lie in its folder."""

    find: Callable[[Path], Iterable[Frame]]  # gives the frames of a folder; none of another layout
    parts: str  # files and folders of the layout, for errors


def find_frames(folder: Path) -> tuple[str, list[Frame]]:
    """Recognise the layout of a folder; give its name, and the frames sorted by name.

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
) -> Iterator[Frame]:
    """Make the frames of left images.

    ``parts``: for each other field of :class:`Frame`, its files by the stems of the left images.
    """
    for left in lefts:
        stem = normalise_stem(left)
        others = {field: by_stem.get(stem) for field, by_stem in parts.items()}
        yield Frame(name=prefix + stem, left=left, style=style, **others)


def _find_raw(folder: Path) -> Iterable[Frame]:
    """Find the frames of KITTI raw, and of its depth-prediction set inside or beside it.

    ``folder`` is a root of dates, a date or a drive.
    """
    own_drive = [folder] if folder.name.endswith("_sync") else []
    for drive in sorted([*own_drive, *folder.glob("*_sync"), *folder.glob("*/*_sync")]):
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


def _find_depth_selection(folder: Path) -> Iterable[Frame]:
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
        yield Frame(
            name=stem,
            left=left,
            calibration=intrinsics.get(stem),
            style="camera",
            scan=scans.get(stem.replace("_image_", "_velodyne_raw_", 1)),
            depth=depth.get(stem.replace("_image_", "_groundtruth_depth_", 1)),
        )


def _find_odometry(folder: Path) -> Iterable[Frame]:
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


def _find_benchmark(folder: Path, left_name: str, right_name: str, ending: str) -> Iterable[Frame]:
    """Find the frames of KITTI object, 2012 or 2015; of 2012 and 2015 only those with truth.

    ``ending``: ending of the names of folders with true disparity.
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


def _find_middlebury(folder: Path) -> Iterable[Frame]:
    """Find the scenes of a folder in Middlebury's layout, up to two folders deep."""
    for scene in [folder, *folder.glob("*"), *folder.glob("*/*")]:
        if not (scene / "calib.txt").is_file():
            continue
        views = _list_by_stem(scene, LISTED_SUFFIXES)
        truth = _list_by_stem(scene, (".pfm",))
        if "im0" in views:
            yield Frame(
                name="_".join(scene.relative_to(folder).parts) or scene.name,
                left=views["im0"],
                right=views.get("im1"),
                calibration=scene / "calib.txt",
                style="middlebury",
                disparity=truth.get("disp0GT") or truth.get("disp0"),
            )


def _find_pairs(folder: Path) -> Iterable[Frame]:
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
    "packed shards": Layout(find=packed_frames, parts="index.json of 'depthpose data pack'"),
    "KITTI raw": Layout(find=_find_raw, parts="DATE/DATE_drive_NNNN_sync/image_02/data"),
    "KITTI depth selection": Layout(
        find=_find_depth_selection,
        parts="val_selection_cropped: image, groundtruth_depth, intrinsics",
    ),
    "KITTI odometry": Layout(find=_find_odometry, parts="sequences/NN/image_2, image_3, calib.txt"),
    "KITTI object or 2015": Layout(
        find=partial(_find_benchmark, left_name="image_2", right_name="image_3", ending="_0"),
        parts="image_2, image_3, calib or disp_occ_0",
    ),
    "KITTI 2012": Layout(
        find=partial(_find_benchmark, left_name="colored_0", right_name="colored_1", ending=""),
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
    paths = sorted(
        _list_files(folder, suffixes), key=lambda path: suffixes.index(path.suffix.lower())
    )
    return {normalise_stem(path): path for path in reversed(paths)}


def _list_files(folder: Path, suffixes: tuple[str, ...] = LISTED_SUFFIXES) -> list[Path]:
    """List the files of a folder with one of the suffixes, in any case; [] without a folder."""
    if not folder.is_dir():
        return []
    paths = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted(path for path in paths if path.suffix.lower() in suffixes and path.is_file())


_CALIBRATION_FILES = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")


def has_raw_frame(folder: Path, drive: str, number: int) -> bool:
    """Whether all files of a frame of :func:`write_raw_frame` exist as they were written."""
    last = f"{drive[:10]}/{drive}/disp_occ/{number:010d}.png"
    return is_whole(folder, f"{drive}/{number:010d}", [last])


def has_calibration(folder: Path, date: str) -> bool:
    """Whether the calibration of a date exists as it was written."""
    return is_whole(folder, date, [f"{date}/{name}" for name in _CALIBRATION_FILES])


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
    written: list[Path] = []

    def next_path(part: str, suffix: str = ".png") -> Path:
        written.append(folder / date / drive / part / f"{name}{suffix}")
        return written[-1]

    files.write_image(next_path("image_02/data"), frame.left)
    files.write_image(next_path("image_03/data"), frame.right)
    if frame.lidar_points is not None:
        scan = frame.lidar_points.float().contiguous().numpy().astype("<f4")
        write_bytes(next_path("velodyne_points/data", ".bin"), scan.tobytes())
    files.write_image(next_path("sky"), frame.is_sky.float().expand(3, -1, -1))
    visible_px = torch.where(frame.occluded, torch.nan, frame.disparity_px)
    files.write_depth_png(next_path("disp_noc"), visible_px)
    files.write_depth_png(next_path("disp_occ"), frame.disparity_px)
    note_result(folder, f"{drive}/{name}", written)


def has_scene(folder: Path, name: str) -> bool:
    """Whether all files of a scene of :func:`write_scene` exist as they were written."""
    return is_whole(folder, name, [f"{name}/disp0.pfm"])


def write_scene(folder: Path, name: str, frame: RawFrame) -> None:
    """Write a pair in Middlebury's layout, each with its own rig: images, disparity, calibration.

    ``NAME/im0.png``, ``im1.png``, ``disp0.pfm`` (occluded pixels too, infinity where unknown) and
    ``calib.txt``.

    Raises:
        InputError: the disk refuses.
    """
    scene = folder / name
    rig = frame.rig
    written = [scene / part for part in ("im0.png", "im1.png", "disp0.pfm", "calib.txt")]

    files.write_image(written[0], frame.left)
    files.write_image(written[1], frame.right)
    files.write_map(written[2], frame.disparity_px)

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
    write_bytes(written[3], ("\n".join(lines) + "\n").encode())
    note_result(folder, name, written)


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
        lines = [
            f"{name}: " + " ".join(f"{value:.12e}" for value in matrix.ravel())
            for name, matrix in matrices.items()
        ]
        text = "\n".join(lines) + "\n"
        if not is_written:
            write_bytes(path, text.encode())
        elif files.read_text(path) != text:
            raise InputError(
                f"{path}: belongs to frames of another rig or scale; write these to another folder"
            )
    if not is_written:
        note_result(folder, date, paths)
