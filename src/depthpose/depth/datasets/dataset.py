"""A folder of stereo frames, opened; and the Eigen splits, by name or from others' lists."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import pairwise
from pathlib import Path

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import image_size, read_image, read_text
from depthpose.depth.datasets.frames import (
    Frame,
    check_map_size,
    frame_camera,
    has_lidar,
    lidar_truth,
    read_depth,
    read_disparity,
)
from depthpose.depth.datasets.layouts import find_frames, local_folder
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.types import Map, StereoInput, StereoSample, StereoTruth

# Files of ours: drives in order, each with its frame numbers as ranges.
_SHIPPED = ("eigen-train", "eigen-val", "eigen-test", "eigen-benchmark")
# Lists that are others together; the thesis trains on this one (2.4.1).
_JOINED = {"eigen-train-val": ("eigen-train", "eigen-val")}
SPLIT_NAMES = (*_SHIPPED, *_JOINED)

_MAX_BYTES = 2**24
"""Of a list of frames: twenty times KITTI's."""


@dataclass(frozen=True, kw_only=True)
class Split:
    """A list of frames of KITTI raw."""

    name: str  #: ``eigen-test`` and the like, or the file's name where it is no known list
    #: (drive, frame number), e.g. ``("2011_09_26_drive_0002_sync", 69)``, sorted
    frames: tuple[tuple[str, int], ...]

    @property
    def names(self) -> list[str]:
        """Names as those of :class:`Frame`, sorted."""
        return [f"{drive}_{frame:010d}" for drive, frame in self.frames]


def read_split(name: str | Path) -> Split:
    """Give a split by name, or read a file of monodepth's or monodepth2's form.

    A file whose frames, as a set, are those of a known split gets that split's name. Of
    monodepth2's lists the lines of the left camera (``l``) count.

    Raises:
        InputError: neither a name nor a file, or a line that cannot be understood.
    """
    if str(name) in SPLIT_NAMES:
        return _shipped_split(str(name))
    path = Path(name)
    try:
        is_there = path.is_file()
    except OSError:  # a name too long for the disk
        is_there = False
    if not is_there:
        hint = nearest_name(str(name), SPLIT_NAMES)
        raise InputError(f"split {str(name)!r}: no such file; {hint}")
    text = read_text(path, _MAX_BYTES)
    frames: set[tuple[str, int]] = set()
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if not line:
            continue
        drives = set(re.findall(r"\d{4}_\d\d_\d\d_drive_\d{4}_sync", line, re.ASCII))
        images = re.findall(r"image_0[23]/(?:data/)?(\d{1,10})\.\w", line, re.ASCII)
        as_words = re.fullmatch(r"\S+\s+(\d{1,10})\s+([lr])", line, re.ASCII)
        numbers = {int(n) for n in (images if as_words is None else as_words.groups()[:1])}
        if len(drives) != 1 or len(numbers) != 1:
            raise InputError(
                f"{path}: line {number} is {line[:60]!r}, but a frame is 'DATE/DRIVE FRAME l' "
                "(monodepth2) or two image paths of one frame (monodepth)."
            )
        if as_words is None or as_words[2] == "l":
            frames.add((drives.pop(), numbers.pop()))
    if not frames:
        raise InputError(
            f"{path}: names no frame. Each line is 'DATE/DRIVE FRAME l' or two images."
        )
    listed = tuple(sorted(frames))
    same = [key for key in SPLIT_NAMES if _shipped_split(key).frames == listed]
    return Split(name=same[0] if same else path.name, frames=listed)


@cache
def _shipped_split(name: str) -> Split:
    """Read a split that ships, or join those that it consists of."""
    if name in _JOINED:
        joined = {frame for part in _JOINED[name] for frame in _shipped_split(part).frames}
        return Split(name=name, frames=tuple(sorted(joined)))
    text = resources.files("depthpose.depth.datasets").joinpath(f"lists/{name}.txt").read_text()
    frames = tuple(
        (drive, frame)
        for drive, _, ranges in (line.partition(" ") for line in text.splitlines())
        for ends in (word.split("-") for word in ranges.split())  # "0-3 7" is 0, 1, 2, 3, 7
        for frame in range(int(ends[0]), int(ends[-1]) + 1)
    )
    return Split(name=name, frames=frames)


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Frames of one folder; nothing is read before it is asked for."""

    name: str  #: the folder's name, and the split's
    layout: str  #: which layout was recognised
    frames: list[Frame]  #: where each frame's parts lie

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> StereoSample:
        """Read one sample: images, calibration and truth."""
        return StereoSample(input=self.read_input(index), truth=self.read_truth(index))

    def read_input(self, index: int) -> StereoInput:
        """Read images and calibration alone."""
        frame = self.frames[index]
        left = read_image(frame.left)
        right = None if frame.right is None else read_image(frame.right)
        if frame.right is not None and right is not None:
            check_map_size(frame.right, right, (left.shape[2], left.shape[1]))
        return StereoInput(name=frame.name, left=left, right=right, camera=frame_camera(frame))

    def read_truth(self, index: int) -> StereoTruth:
        """Read the truth that comes as maps; a LiDAR scan is for :func:`lidar_truth`."""
        frame = self.frames[index]
        depth_m = None if frame.depth is None else read_depth(frame.depth)
        disparity_px = None if frame.disparity is None else read_disparity(frame.disparity)
        is_sky = None if frame.sky is None else read_image(frame.sky)[0] > 0
        parts = ((frame.depth, depth_m), (frame.disparity, disparity_px), (frame.sky, is_sky))
        for path, values in parts:
            if path is not None and values is not None:
                check_map_size(path, values, image_size(frame.left))
        return StereoTruth(disparity_px=disparity_px, depth_m=depth_m, is_sky=is_sky)

    def read_rig(self, index: int) -> StereoRig | None:
        """Read the calibration alone; None where the frame has none of a pair."""
        camera = frame_camera(self.frames[index])
        return camera if isinstance(camera, StereoRig) else None


def open_dataset(folder: Path | str, split: str | Path | None = None) -> Dataset:
    """Open a KITTI, Middlebury or plain folder, or packed shards; the layout is recognised.

    Args:
        folder: the dataset's root (KITTI's ``training`` folder will do too); of packed shards
            perhaps a URL such as ``s3://bucket/streets``.
        split: name or file of a split: only its frames, which must all be there.

    Raises:
        InputError: no such folder or layout, two images of one name, or frames of the split are
            missing.
    """
    folder = local_folder(folder)
    layout, frames = find_frames(folder)
    for frame, after in pairwise(frames):
        if frame.name == after.name:
            raise InputError(f"{after.left}: has the same name as {frame.left}; remove one.")
    name = folder.resolve().name
    if split is None:
        return Dataset(name=name, layout=layout, frames=frames)
    chosen = read_split(split)
    by_name = {frame.name: frame for frame in frames}
    missing = [name for name in chosen.names if name not in by_name]
    if missing:
        raise InputError(
            f"{folder}: {len(missing)} of the {len(chosen.names)} frames of {chosen.name} are "
            f"missing, first {', '.join(missing[:3])}. 'depthpose data check' lists them all; "
            "without a split what is there is used."
        )
    chosen_frames = [by_name[name] for name in chosen.names]
    return Dataset(name=f"{name} {chosen.name}", layout=layout, frames=chosen_frames)


def join_datasets(datasets: Sequence[Dataset], without: Sequence[str] = ()) -> Dataset:
    """Join several datasets, without the frames of some names.

    Raises:
        InputError: a name that no frame has, which would leave in what was to be kept out.
    """
    frames = [frame for dataset in datasets for frame in dataset.frames]
    unknown = sorted(set(without) - {frame.name for frame in frames})
    if unknown:
        raise InputError(
            f"no frame of {', '.join(d.name for d in datasets)} is called {unknown[0]!r}; "
            f"{nearest_name(unknown[0], {frame.name for frame in frames})[:300]}"
        )
    return Dataset(
        name=" + ".join(dataset.name for dataset in datasets),
        layout=" + ".join(dict.fromkeys(dataset.layout for dataset in datasets)),
        frames=[frame for frame in frames if frame.name not in without],
    )


def refuse_common(
    trained: Iterable[Frame], measured: Iterable[Frame], what: str, remedy: str
) -> None:
    """Refuse frames that are both trained on and measured.

    The error says ``what`` the measured frames are, and the ``remedy``.

    Raises:
        InputError: a left image is in both.
    """
    trained_files = {frame.left.resolve() for frame in trained}
    common = [frame.name for frame in measured if frame.left.resolve() in trained_files]
    if common:
        raise InputError(
            f"{len(common)} of the {what} are trained on too, {common[0]} first, so their error "
            f"would be too good; {remedy}"
        )


def read_known_depth(dataset: Dataset, index: int) -> Map | None:
    """Read what is known of the left image's depth [m]: LiDAR, depth map or disparity, in order.

    None where the frame has no truth at all.
    """
    frame = dataset.frames[index]
    if has_lidar(frame, "camera_z"):
        return lidar_truth(frame, "camera_z")
    truth = dataset.read_truth(index)
    if truth.depth_m is not None or truth.disparity_px is None:
        return truth.depth_m
    rig = dataset.read_rig(index)
    return None if rig is None else depth_from_disparity(truth.disparity_px, rig)
