"""Pairs, on disk or made, as training samples by ticket."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError
from depthpose.core.loop import shuffled_index, ticket_generator
from depthpose.depth.augment import TrainingPair, augment, scale_pair
from depthpose.depth.config import PairsConfig
from depthpose.depth.disparity import disparity_from_depth, right_disparity_from_left
from depthpose.depth.kitti import Dataset, open_dataset
from depthpose.depth.kitti.frames import Frame, lidar_truth
from depthpose.depth.streets import Streets, kitti_rig, street_rig
from depthpose.depth.types import StereoSample

BASELINE_TOLERANCE = 0.02
"""Relative difference of baselines that one virtual rig may stand for: KITTI's differ by 1.4 %."""


class TrainingPairs:
    """Frames of several folders, each ticket a random one, randomly changed.

    Args:
        config: which pairs, and how.
        seed: decides order and changes.
        needs_truth: leave out frames without disparity or depth.
        baseline_m: refuse pairs whose baseline is another (beyond 2 %).

    Raises:
        InputError: no folder, no usable pair, an excluded frame that is not there, or a pair
            without calibration where the focal length or depth needs one.
    """

    def __init__(
        self,
        config: PairsConfig,
        seed: int,
        *,
        needs_truth: bool,
        baseline_m: float | None = None,
    ) -> None:
        self.config, self.seed = config, seed
        self._frames = _find_frames(config, needs_truth=needs_truth)
        self._needs_truth = needs_truth
        if baseline_m is not None:
            self._check_baselines(baseline_m)
        self._cache: dict[int, tuple[Tensor, ...]] = {}

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, ticket: int) -> TrainingPair:
        """Make the sample of a ticket."""
        index = shuffled_index(ticket, len(self), self.seed)
        return augment(self.read(index), self.config.augment, ticket_generator(ticket, self.seed))

    def read(self, index: int) -> TrainingPair:
        """Read one whole pair at the config's focal length, unchanged otherwise."""
        if not self.config.with_cache:
            return self._read(index)
        if index not in self._cache:
            pair = self._read(index)
            views = [(view * 255).round().to(torch.uint8) for view in (pair.left, pair.right)]
            self._cache[index] = (*views, pair.left_px, pair.right_px)
        left, right, left_px, right_px = self._cache[index]
        return TrainingPair(left.float() / 255, right.float() / 255, left_px, right_px)

    def _read(self, index: int) -> TrainingPair:
        dataset, place = self._frames[index]
        sample = dataset[place]
        given, rig = sample.input, sample.input.camera
        assert given.right is not None, "frames without a right view were left out"
        left_px = right_px = torch.full_like(given.left[0], torch.nan)
        if self._needs_truth:
            left_px = _truth_disparity(sample)
            if left_px is None and isinstance(dataset, Dataset):
                left_px = _scanned_disparity(dataset.frames[place], rig)
            assert left_px is not None, "frames without truth were left out"
            right_px = sample.truth.right_disparity_px
            right_px = right_disparity_from_left(left_px) if right_px is None else right_px
        pair = TrainingPair(given.left, given.right, left_px, right_px)
        if self.config.focal_px is None:
            return pair
        if rig is None:
            raise InputError(
                f"{given.name}: has no calibration, so it cannot be brought to a focal "
                f"length of {self.config.focal_px} px; add one, exclude it, or leave focal_px out"
            )
        return scale_pair(pair, self.config.focal_px / float(rig.K[0, 0]), (1, 1))

    def _check_baselines(self, wanted_m: float) -> None:
        """Look at every rig before any work: a pair of another one would teach other metres."""
        for name, rig in self._rigs():
            if rig is None:
                raise InputError(
                    f"{name}: has no calibration, and the generator imitates one rig; add one, or "
                    "exclude the frame"
                )
            if abs(rig.baseline_m / wanted_m - 1) > BASELINE_TOLERANCE:
                raise InputError(
                    f"{name}: its baseline is {rig.baseline_m:.4f} m, but the generator imitates "
                    f"one rig of {wanted_m} m. Train it on pairs of one rig, and set "
                    "virtual_baseline_m to that rig's."
                )

    def _rigs(self) -> Iterator[tuple[str, StereoRig | None]]:
        for dataset, place in self._frames:
            if isinstance(dataset, Dataset):
                yield dataset.frames[place].name, dataset.read_rig(place)
            elif dataset.config.rigs != "kitti":
                yield f"street {place}", street_rig(dataset.config, place)[0]
        made = self.config.streets
        if made is not None and made.rigs == "kitti":  # five rigs, and perhaps millions of streets
            yield from ((f"street with KITTI's rig {n}", kitti_rig(n)) for n in range(5))


def _truth_disparity(sample: StereoSample) -> Float[Tensor, "h w"] | None:
    """Disparity that the dataset knows, or that follows from depth."""
    truth, rig = sample.truth, sample.input.camera
    if truth.disparity_px is not None:
        return truth.disparity_px
    if truth.depth_m is not None and isinstance(rig, StereoRig):
        return disparity_from_depth(truth.depth_m, rig)
    return None


def _scanned_disparity(frame: Frame, rig: Camera | None) -> Float[Tensor, "h w"] | None:
    """Disparity of the LiDAR points alone."""
    if frame.velodyne is None:
        return None
    if not isinstance(rig, StereoRig):
        raise InputError(
            f"{frame.name}: has a LiDAR scan but no calibration, so it is no truth; add the "
            "calibration, or exclude the frame"
        )
    return disparity_from_depth(lidar_truth(frame, "camera_z"), rig)


def _find_frames(config: PairsConfig, *, needs_truth: bool) -> list[tuple[Dataset | Streets, int]]:
    if not config.folders and config.streets is None:
        raise InputError("there is nothing to train on: name a folder of pairs (--data PATH).")
    excluded = set(config.exclude)
    found: list[tuple[Dataset | Streets, int]] = []
    if config.streets is not None:
        made = Streets(config.streets)
        places = [(made, place) for place in range(len(made))]
        found += places if config.limit is None else _spread(places, config.limit)
    for number, folder in enumerate(config.folders):
        dataset = open_dataset(Path(folder), config.split if number == 0 else None)
        usable: list[tuple[Dataset | Streets, int]] = [
            (dataset, place)
            for place, frame in enumerate(dataset.frames)
            if frame.name not in config.exclude and _is_usable(frame, needs_truth=needs_truth)
        ]
        excluded -= {frame.name for frame in dataset.frames}
        found += usable if config.limit is None else _spread(usable, config.limit)
    if excluded:
        raise InputError(
            f"exclude names {sorted(excluded)}, which no folder holds; a misspelt name would "
            "train on what should be left out"
        )
    if not found:
        what = "a right view and a truth" if needs_truth else "a right view"
        raise InputError(f"{', '.join(config.folders)}: no frame has {what}; nothing to train on.")
    return found


def _is_usable(frame: Frame, *, needs_truth: bool) -> bool:
    has_truth = frame.disparity or frame.depth or frame.velodyne
    return frame.right is not None and bool(has_truth or not needs_truth)


def _spread(
    items: Sequence[tuple[Dataset | Streets, int]], count: int
) -> list[tuple[Dataset | Streets, int]]:
    """Take ``count`` items at equal distances: neighbours in a drive look alike."""
    if count >= len(items):
        return list(items)
    return [items[round(k * (len(items) - 1) / max(count - 1, 1))] for k in range(count)]
