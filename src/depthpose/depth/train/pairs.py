"""Pairs on disk as training samples by ticket."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.loop import shuffled_index, ticket_generator
from depthpose.depth.augment import TrainingPair, augment, scale_pair
from depthpose.depth.config import PairsConfig
from depthpose.depth.disparity import disparity_from_depth, right_disparity_from_left
from depthpose.depth.kitti import Dataset, open_dataset
from depthpose.depth.kitti.frames import Frame, lidar_truth

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
        self._baseline_m = baseline_m
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
        rig, right = sample.input.camera, sample.input.right
        assert right is not None, "frames without a right view were left out"
        self._check_baseline(dataset, place)
        left_px = truth_disparity(dataset, place)
        if left_px is None:
            left_px = torch.full_like(sample.input.left[0], torch.nan)
        right_px = right_disparity_from_left(left_px)
        pair = TrainingPair(sample.input.left, right, left_px, right_px)
        if self.config.focal_px is None:
            return pair
        if rig is None:
            raise InputError(
                f"{sample.input.name}: has no calibration, so it cannot be brought to a focal "
                f"length of {self.config.focal_px} px; add one, exclude it, or leave focal_px out"
            )
        return scale_pair(pair, self.config.focal_px / float(rig.K[0, 0]), (1, 1))

    def _check_baseline(self, dataset: Dataset, place: int) -> None:
        if self._baseline_m is None:
            return
        rig = dataset.read_rig(place)
        if rig and abs(rig.baseline_m / self._baseline_m - 1) > BASELINE_TOLERANCE:
            raise InputError(
                f"{dataset.frames[place].name}: its baseline is {rig.baseline_m:.4f} m, but the "
                f"generator imitates one rig of {self._baseline_m} m. Train it on pairs of one "
                "rig, and set virtual_baseline_m to that rig's."
            )


def truth_disparity(dataset: Dataset, place: int) -> Float[Tensor, "h w"] | None:
    """Disparity that a frame can be trained on: as shipped, or from depth, or from its LiDAR."""
    frame, rig = dataset.frames[place], dataset.read_rig(place)
    truth = dataset.read_truth(place)
    if truth.disparity_px is not None:
        return truth.disparity_px
    if rig is None:
        return None
    if truth.depth_m is not None:
        return disparity_from_depth(truth.depth_m, rig)
    if frame.velodyne is not None:
        return disparity_from_depth(lidar_truth(frame, "camera_z"), rig)
    return None


def _find_frames(config: PairsConfig, *, needs_truth: bool) -> list[tuple[Dataset, int]]:
    if not config.folders:
        raise InputError("there is nothing to train on: name a folder of pairs (--data PATH).")
    excluded = set(config.exclude)
    found: list[tuple[Dataset, int]] = []
    for number, folder in enumerate(config.folders):
        dataset = open_dataset(Path(folder), config.split if number == 0 else None)
        usable = [
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


def _spread(items: Sequence[tuple[Dataset, int]], count: int) -> list[tuple[Dataset, int]]:
    """Take ``count`` items at equal distances: neighbours in a drive look alike."""
    if count >= len(items):
        return list(items)
    return [items[round(k * (len(items) - 1) / max(count - 1, 1))] for k in range(count)]
