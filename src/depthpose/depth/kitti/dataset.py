"""A folder of stereo frames, opened."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError
from depthpose.depth.kitti.frames import Frame, frame_input, frame_rig, frame_truth
from depthpose.depth.kitti.layouts import find_frames
from depthpose.depth.kitti.splits import Split, read_split
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
        """Read the calibration alone; None where the frame has none."""
        return frame_rig(self.frames[index])


def open_dataset(folder: Path, split: str | Path | None = None) -> Dataset:
    """Open a KITTI, Middlebury or plain folder; its layout is recognised.

    Args:
        folder: the dataset's root (KITTI's ``training`` folder will do too).
        split: name or file of a split: only its frames, which must all be there.

    Raises:
        InputError: no such folder or layout, two images of one name, or frames of the split are
            missing.
    """
    folder = Path(folder)
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


def _select(folder: Path, frames: list[Frame], split: Split) -> list[Frame]:
    by_name = {frame.name: frame for frame in frames}
    missing = [name for name in split.names if name not in by_name]
    if missing:
        raise InputError(
            f"{folder}: {len(missing)} of the {len(split.names)} frames of {split.name} are "
            f"missing, first {', '.join(missing[:3])}. 'depthpose data check' lists them all; "
            "leave --split away to use what is there."
        )
    return [by_name[name] for name in split.names]
