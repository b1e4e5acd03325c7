"""A folder of stereo frames, opened."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError, nearest_name
from depthpose.depth.datasets.frames import (
    Frame,
    frame_camera,
    frame_input,
    frame_truth,
    has_lidar,
    lidar_truth,
)
from depthpose.depth.datasets.layouts import find_frames
from depthpose.depth.datasets.packed import local_folder
from depthpose.depth.datasets.splits import Split, read_split
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.types import StereoInput, StereoSample, StereoTruth


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Frames of one folder; nothing is read before it is asked for.

    Attributes:
        name: the folder's name, and the split's.
        layout: which layout was recognised.
        frames: where each frame's parts lie.
    """

    name: str
    layout: str
    frames: list[Frame]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> StereoSample:
        """Read one sample: images, calibration and truth."""
        return StereoSample(input=self.read_input(index), truth=self.read_truth(index))

    def read_input(self, index: int) -> StereoInput:
        """Read images and calibration alone."""
        return frame_input(self.frames[index])

    def read_truth(self, index: int) -> StereoTruth:
        """Read the truth alone."""
        return frame_truth(self.frames[index])

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
    return Dataset(
        name=f"{name} {chosen.name}", layout=layout, frames=_select(folder, frames, chosen)
    )


def join_datasets(datasets: Sequence[Dataset], without: Sequence[str] = ()) -> Dataset:
    """Make one dataset of several, less the frames of some names.

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
    """Refuse to measure by what is trained on.

    Args:
        trained: frames of the training.
        measured: frames that the result is measured on.
        what: these are, for the error.
        remedy: for the error.

    Raises:
        InputError: a left image is in both.
    """
    seen = {frame.left.resolve() for frame in trained}
    common = [frame.name for frame in measured if frame.left.resolve() in seen]
    if common:
        raise InputError(
            f"{len(common)} of the {what} are trained on too, {common[0]} first, so their error "
            f"would be too good; {remedy}"
        )


def read_known_depth(dataset: Dataset, index: int) -> Float[Tensor, "h w"] | None:
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


def _select(folder: Path, frames: list[Frame], split: Split) -> list[Frame]:
    by_name = {frame.name: frame for frame in frames}
    missing = [name for name in split.names if name not in by_name]
    if missing:
        raise InputError(
            f"{folder}: {len(missing)} of the {len(split.names)} frames of {split.name} are "
            f"missing, first {', '.join(missing[:3])}. 'depthpose data check' lists them all; "
            "without a split what is there is used."
        )
    return [by_name[name] for name in split.names]
