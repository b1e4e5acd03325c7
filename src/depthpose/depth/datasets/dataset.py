"""Datasets of stereo frames, and their splits: the Eigen splits by name, or lists in files."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import pairwise
from pathlib import Path

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError, suggest_name
from depthpose.core.files import image_size, read_image, read_text
from depthpose.depth.datasets.frames import (
    FramePaths,
    check_map_size,
    has_lidar,
    read_depth,
    read_disparity,
    read_frame_camera,
    read_lidar_depth,
)
from depthpose.depth.datasets.layouts import find_frames
from depthpose.depth.datasets.packed import resolve_folder
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.types import DepthInput, DepthSample, DepthTruth, Map

_SHIPPED_SPLITS = ("eigen-train", "eigen-val", "eigen-test", "eigen-benchmark")
"""Splits that come as files: a line for each drive, with its frame numbers as ranges."""
_JOINED_SPLITS = {"eigen-train-val": ("eigen-train", "eigen-val")}
"""Splits that consist of others; the thesis trains on this one (2.4.1)."""
SPLIT_NAMES = (*_SHIPPED_SPLITS, *_JOINED_SPLITS)

_MAX_BYTES = 2**24
"""Largest file of a split: twenty times that of all frames of KITTI."""


@dataclass(frozen=True, kw_only=True)
class Split:
    """A list of frames of KITTI raw."""

    name: str  #: a name such as ``eigen-test``, or that of the file of another list
    #: (drive, frame number), e.g. ``("2011_09_26_drive_0002_sync", 69)``, sorted
    frames: tuple[tuple[str, int], ...]

    @property
    def names(self) -> list[str]:
        """The names of the frames, as those of :class:`FramePaths`, sorted."""
        return [f"{drive}_{frame:010d}" for drive, frame in self.frames]


def read_split(name: str | Path) -> Split:
    """Read a split by its name, or a file in monodepth's or monodepth2's format.

    A file with the same set of frames as a split of ``SPLIT_NAMES`` gets that split's name. Of
    monodepth2's lists the lines of the left camera (``l``) count.

    Raises:
        InputError: neither a name nor a file, or a line that cannot be parsed.
    """
    if str(name) in SPLIT_NAMES:
        return _read_shipped_split(str(name))
    path = Path(name)
    try:
        is_file = path.is_file()
    except OSError:  # a name too long for the disk
        is_file = False
    if not is_file:
        hint = suggest_name(str(name), SPLIT_NAMES)
        raise InputError(f"split {str(name)!r}: no such file; {hint}")

    text = read_text(path, _MAX_BYTES)
    frames: set[tuple[str, int]] = set()
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if line:
            frame = _parse_split_line(line, f"{path}: line {number}")
            if frame is not None:
                frames.add(frame)
    if not frames:
        raise InputError(
            f"{path}: names no frame. Each line is 'DATE/DRIVE FRAME l' or two images."
        )

    # A file with the frames of a known split is called by its name.
    listed = tuple(sorted(frames))
    equal_splits = [key for key in SPLIT_NAMES if _read_shipped_split(key).frames == listed]
    return Split(name=equal_splits[0] if equal_splits else path.name, frames=listed)


def _parse_split_line(line: str, context: str) -> tuple[str, int] | None:
    """Parse drive and frame number of a line; None where it is of the right camera.

    ``context`` begins the error of a line that names no frame, or several.
    """
    drives = set(re.findall(r"\d{4}_\d\d_\d\d_drive_\d{4}_sync", line, re.ASCII))
    monodepth2 = re.fullmatch(r"\S+\s+(\d{1,10})\s+([lr])", line, re.ASCII)
    if monodepth2 is not None:
        numbers = {int(monodepth2[1])}
    else:
        images = re.findall(r"image_0[23]/(?:data/)?(\d{1,10})\.\w", line, re.ASCII)
        numbers = {int(image) for image in images}
    if len(drives) != 1 or len(numbers) != 1:
        raise InputError(
            f"{context} is {line[:60]!r}, but a frame is 'DATE/DRIVE FRAME l' "
            "(monodepth2) or two image paths of one frame (monodepth)."
        )
    if monodepth2 is not None and monodepth2[2] == "r":
        return None
    return drives.pop(), numbers.pop()


@cache
def _read_shipped_split(name: str) -> Split:
    """Read a split of ``SPLIT_NAMES``, or join those that it consists of."""
    if name in _JOINED_SPLITS:
        joined: set[tuple[str, int]] = set()
        for part in _JOINED_SPLITS[name]:
            joined.update(_read_shipped_split(part).frames)
        return Split(name=name, frames=tuple(sorted(joined)))
    text = resources.files("depthpose.depth.datasets").joinpath(f"lists/{name}.txt").read_text()
    frames: list[tuple[str, int]] = []
    for line in text.splitlines():
        drive, *ranges = line.split()
        for number_range in ranges:  # "0-3 7" is 0, 1, 2, 3, 7
            first, _, last = number_range.partition("-")
            frames += [(drive, number) for number in range(int(first), int(last or first) + 1)]
    return Split(name=name, frames=tuple(frames))


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Frames of one folder, by their paths; files are read on demand."""

    name: str  #: the name of the folder, followed by that of the split
    layout: str  #: name of the layout that was recognised
    frames: list[FramePaths]  #: paths of each frame

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> DepthSample:
        """Read one sample: images, calibration and truth."""
        return DepthSample(input=self.read_input(index), truth=self.read_truth(index))

    def read_input(self, index: int) -> DepthInput:
        """Read images and calibration of a frame, without its truth."""
        frame = self.frames[index]
        left = read_image(frame.left)
        right = None if frame.right is None else read_image(frame.right)
        if frame.right is not None and right is not None:
            check_map_size(frame.right, right, (left.shape[2], left.shape[1]))
        return DepthInput(name=frame.name, left=left, right=right, camera=read_frame_camera(frame))

    def read_truth(self, index: int) -> DepthTruth:
        """Read the true maps of a frame; :func:`read_lidar_depth` draws one of a LiDAR scan."""
        frame = self.frames[index]
        depth_m = None if frame.depth is None else read_depth(frame.depth)
        disparity_px = None if frame.disparity is None else read_disparity(frame.disparity)
        is_sky = None if frame.sky is None else read_image(frame.sky)[0] > 0
        maps = ((frame.depth, depth_m), (frame.disparity, disparity_px), (frame.sky, is_sky))
        for path, values in maps:
            if path is not None and values is not None:
                check_map_size(path, values, image_size(frame.left))
        return DepthTruth(disparity_px=disparity_px, depth_m=depth_m, is_sky=is_sky)

    def read_rig(self, index: int) -> StereoRig | None:
        """Read the calibration of a frame; None where it has none, or one of a single camera."""
        camera = read_frame_camera(self.frames[index])
        return camera if isinstance(camera, StereoRig) else None


def open_dataset(folder: Path | str, split: str | Path | None = None) -> Dataset:
    """Open a KITTI, Middlebury or plain folder, or packed shards, and recognise its layout.

    Args:
        folder: the dataset's root (KITTI's ``training`` folder will do too); of packed shards
            perhaps a URL such as ``s3://bucket/streets``.
        split: name or file of a split: the dataset has its frames, which must all exist.

    Raises:
        InputError: no such folder or layout, two images of one name, or frames of the split are
            missing.
    """
    folder = resolve_folder(folder)
    layout, frames = find_frames(folder)
    for frame, after in pairwise(frames):
        if frame.name == after.name:
            raise InputError(f"{after.left}: has the same name as {frame.left}; remove one.")
    name = folder.resolve().name
    if split is None:
        return Dataset(name=name, layout=layout, frames=frames)
    chosen_split = read_split(split)
    frame_of = {frame.name: frame for frame in frames}
    missing = [name for name in chosen_split.names if name not in frame_of]
    if missing:
        raise InputError(
            f"{folder}: {len(missing)} of the {len(chosen_split.names)} frames of "
            f"{chosen_split.name} are "
            f"missing, first {', '.join(missing[:3])}. 'depthpose data check' lists them all; "
            "without a split what is there is used."
        )
    chosen_frames = [frame_of[name] for name in chosen_split.names]
    return Dataset(name=f"{name} {chosen_split.name}", layout=layout, frames=chosen_frames)


def join_datasets(datasets: Sequence[Dataset], without: Sequence[str] = ()) -> Dataset:
    """Join several datasets, and leave out the frames whose names are in ``without``.

    Raises:
        InputError: ``without`` has a name that no frame has, such as a misspelt one.
    """
    frames = [frame for dataset in datasets for frame in dataset.frames]
    unknown = sorted(set(without) - {frame.name for frame in frames})
    if unknown:
        raise InputError(
            f"no frame of {', '.join(d.name for d in datasets)} is called {unknown[0]!r}; "
            f"{suggest_name(unknown[0], {frame.name for frame in frames})[:300]}"
        )
    return Dataset(
        name=" + ".join(dataset.name for dataset in datasets),
        layout=" + ".join(dict.fromkeys(dataset.layout for dataset in datasets)),
        frames=[frame for frame in frames if frame.name not in without],
    )


def refuse_shared_frames(
    trained: Iterable[FramePaths], measured: Iterable[FramePaths], noun: str, remedy: str
) -> None:
    """Refuse frames that are both trained on and measured.

    Args:
        trained: frames that are trained on.
        measured: frames on which an error is measured.
        noun: what the error calls the latter.
        remedy: how the error ends.

    Raises:
        InputError: a left image is in both.
    """
    trained_files = {frame.left.resolve() for frame in trained}
    common = [frame.name for frame in measured if frame.left.resolve() in trained_files]
    if common:
        raise InputError(
            f"{len(common)} of the {noun} are trained on too, {common[0]} first, so their error "
            f"would be too good; {remedy}"
        )


def read_true_depth(dataset: Dataset, index: int) -> Map | None:
    """Read the true depth of a left image [m]: of its LiDAR scan, else its depth map or disparity.

    None where the frame has no truth, or disparity without a calibration.
    """
    frame = dataset.frames[index]
    if has_lidar(frame, "camera_z"):
        return read_lidar_depth(frame, "camera_z")
    truth = dataset.read_truth(index)
    if truth.depth_m is not None or truth.disparity_px is None:
        return truth.depth_m
    rig = dataset.read_rig(index)
    return None if rig is None else depth_from_disparity(truth.disparity_px, rig)
