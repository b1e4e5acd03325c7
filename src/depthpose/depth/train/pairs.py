"""Training samples by index: pairs on disk, or rendered while training."""

import warnings
from collections import Counter
from typing import NamedTuple

import torch

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError, Notice
from depthpose.core.loop import make_sample_generator, shuffle_index
from depthpose.depth.augment import TrainingPair, augment, scale_pair
from depthpose.depth.config import PairsConfig, TruthKind
from depthpose.depth.datasets import (
    Dataset,
    FramePaths,
    list_truth_kinds,
    open_dataset,
    read_lidar_depth,
)
from depthpose.depth.disparity import disparity_from_depth, right_disparity_from_left
from depthpose.depth.synthetic import KITTI_RIG_COUNT, Streets, kitti_rig
from depthpose.depth.types import Map

BASELINE_TOLERANCE = 0.02
"""Relative difference of baselines that one virtual rig may stand for: KITTI's differ by 1.4 %."""


class _PairRef(NamedTuple):
    """Where a pair is, and what is read of it."""

    source: Dataset | Streets
    number: int  # index of the pair in its source
    truth: TruthKind | None  # the kind of truth that is read; None: none


class TrainingPairs:
    """Pairs of several folders and rendered streets, shuffled and randomly changed.

    Args:
        config: which pairs, and how they are changed.
        seed: seed of the order and the changes.
        needs_truth: read truth, and leave out frames without the kind that ``config.truth`` names.
        is_mixed: use frames without truth, and frames without a right view, too. The left image of
            the latter stands for both views.
        baseline_m: refuse pairs whose baseline differs from it by more than 2 %.

    Attributes:
        frames: frames of the folders, without the rendered streets.
        truths: which kind of truth each source gives, ``NAME: KIND``; empty where none is needed.

    Raises:
        InputError: no folder, a folder without a usable pair, or with several kinds of truth of
            which none is chosen, an excluded frame that is not there, or a pair without
            calibration where the focal length or depth needs one.
    """

    def __init__(
        self,
        config: PairsConfig,
        seed: int,
        *,
        needs_truth: bool,
        is_mixed: bool = False,
        baseline_m: float | None = None,
    ) -> None:
        self.config = config
        self.seed = seed
        if not config.folders and config.streets is None:
            raise InputError("there is nothing to train on: name a folder of pairs (--data PATH).")

        self._refs: list[_PairRef] = []
        for refs in _list_pairs(config, needs_truth=needs_truth, is_mixed=is_mixed):
            self._refs += _spread_evenly(refs, config.limit)
        if not self._refs:
            raise InputError("streets.frames is 0, so there is no pair; give 1 or more streets.")

        # The frames on disk, and the truth of each source.
        self.frames: list[FramePaths] = []
        truths: dict[str, None] = {}  # in order, each once
        for source, number, truth in self._refs:
            if isinstance(source, Dataset):
                self.frames.append(source.frames[number])
            if truth is not None:
                name = source.name if isinstance(source, Dataset) else _STREETS
                truths[f"{name}: {truth}"] = None
        self.truths = tuple(truths)
        self._cache: dict[int, TrainingPair] = {}
        if baseline_m is not None:
            self._refuse_other_rigs(baseline_m)

    def _refuse_other_rigs(self, baseline_m: float) -> None:
        """Refuse pairs of another baseline, which would change the metric scale.

        Raises:
            InputError: a pair has another baseline, or no calibration.
        """
        rigs = {
            source.frames[number].name: source.read_rig(number)
            for source, number, _ in self._refs
            if isinstance(source, Dataset)
        }
        if self.config.streets is not None:  # perhaps millions of streets, but of five rigs
            rigs |= {f"street with KITTI's rig {n}": kitti_rig(n) for n in range(KITTI_RIG_COUNT)}
        for name, rig in rigs.items():
            if rig is None:
                raise InputError(
                    f"{name}: has no calibration, and the generator imitates one rig; add one, or "
                    "exclude the frame"
                )
            if abs(rig.baseline_m / baseline_m - 1) > BASELINE_TOLERANCE:
                raise InputError(
                    f"{name}: its baseline is {rig.baseline_m:.4f} m, but the generator imitates "
                    f"one rig of {baseline_m} m. Train it on pairs of one rig, and set "
                    "virtual_baseline_m to that rig's."
                )

    def __len__(self) -> int:
        return len(self._refs)

    def __getitem__(self, sample_index: int) -> TrainingPair:
        """Make a sample: the pair at a place of the shuffled order, randomly changed."""
        index = shuffle_index(sample_index, len(self), self.seed)
        generator = make_sample_generator(sample_index, self.seed)
        return augment(self.read(index), self.config.augment, generator)

    def read(self, index: int) -> TrainingPair:
        """Read one whole pair at the config's focal length, unchanged otherwise.

        Raises:
            InputError: a file is damaged, or the pair has no calibration where one is needed.
        """
        if not self.config.with_cache:
            return self._read(index)
        if index not in self._cache:  # views are cached in 8 bits, a quarter of the memory
            pair = self._read(index)
            left = (pair.left * 255).round().to(torch.uint8)
            right = (pair.right * 255).round().to(torch.uint8)
            self._cache[index] = pair._replace(left=left, right=right)
        cached = self._cache[index]
        return cached._replace(left=cached.left.float() / 255, right=cached.right.float() / 255)

    def _read(self, index: int) -> TrainingPair:
        """Read a pair, and its truth if that is needed: disparity, 0 in a sky that is labelled.

        NaN is unknown: all of it, where no truth is needed.
        """
        # Views, rig and truth of a folder's frame or of a rendered street.
        source, number, kind = self._refs[index]
        if isinstance(source, Dataset):
            name = source.frames[number].name
            views = source.read_input(number)
            rig = views.camera if isinstance(views.camera, StereoRig) else None
            left_px = _read_truth(source, number, kind, rig)
            right_px = None
        else:
            name = f"street {number}"
            sample = source[number]
            views = sample.input
            rig = views.camera
            left_px = _with_sky_at_zero(sample.truth.disparity_px, kind)
            right_px = _with_sky_at_zero(sample.truth.right_disparity_px, kind)

        # What is missing: truth, and the right view or its truth.
        if left_px is None:
            left_px = torch.full_like(views.left[0], torch.nan)
        right = views.right
        if right is None:  # a single image: it stands for both views
            right = views.left
            right_px = left_px
        elif right_px is None:
            right_px = right_disparity_from_left(left_px)
        focal_px = torch.tensor(torch.nan if rig is None else float(rig.K[0, 0]))
        pair = TrainingPair(views.left, right, left_px, right_px, focal_px)

        # The config's focal length, by another size.
        target_focal_px = self.config.focal_px
        if target_focal_px is None:
            return pair
        if rig is None:
            raise InputError(
                f"{name}: has no calibration, so it cannot be brought to a "
                f"focal length of {target_focal_px} px; add one, exclude it, or leave focal_px out"
            )
        return scale_pair(pair, target_focal_px / float(focal_px))


def _list_pairs(config: PairsConfig, *, needs_truth: bool, is_mixed: bool) -> list[list[_PairRef]]:
    """List the usable pairs of each source: the rendered streets, and each folder.

    The arguments are those of :class:`TrainingPairs`.

    Raises:
        InputError: a folder is of no use, or an excluded frame is in none.
    """
    sources: list[list[_PairRef]] = []
    if config.streets is not None:
        streets = Streets(config.streets)
        kind: TruthKind | None = "disparity" if needs_truth else None
        sources.append([_PairRef(streets, number, kind) for number in range(len(streets))])

    missing = set(config.exclude)
    for folder_number, folder in enumerate(config.folders):
        dataset = open_dataset(folder, config.split if folder_number == 0 else None)
        missing -= {frame.name for frame in dataset.frames}
        usable = _list_usable_pairs(dataset, config, needs_truth=needs_truth, is_mixed=is_mixed)
        sources.append(usable)
    if missing:
        raise InputError(
            f"exclude names {sorted(missing)}, which no folder holds; a misspelt name would "
            "train on what should be left out"
        )
    return sources


def _spread_evenly(refs: list[_PairRef], limit: int | None) -> list[_PairRef]:
    """Choose at most ``limit`` pairs, evenly spread: neighbours in a drive look alike."""
    count = len(refs) if limit is None else min(limit, len(refs))
    last = len(refs) - 1
    return [refs[round(k * last / max(count - 1, 1))] for k in range(count)]


def _read_truth(
    dataset: Dataset, number: int, kind: TruthKind | None, rig: StereoRig | None
) -> Map | None:
    """Read the true disparity of a frame's left view [px] from a kind of truth, 0 in the sky.

    None where ``kind`` is None. ``rig``: of the frame, which converts depth.

    Raises:
        InputError: the truth is depth, and there is no rig.
    """
    if kind is None:
        return None
    if kind == "disparity":
        truth = dataset.read_truth(number)
        assert truth.disparity_px is not None, "frames without truth were left out"
        if truth.is_sky is None:
            return truth.disparity_px
        return torch.where(truth.is_sky, 0.0, truth.disparity_px)
    if rig is None:
        raise InputError(
            f"{dataset.frames[number].name}: has depth as its truth but no calibration of the "
            "pair, so it cannot become disparity; add the calibration, or exclude the frame"
        )
    depth_m = dataset.read_truth(number).depth_m
    if kind == "scan":
        depth_m = read_lidar_depth(dataset.frames[number], "camera_z")
    assert depth_m is not None, "frames without truth were left out"
    return disparity_from_depth(depth_m, rig)


def _with_sky_at_zero(exact_px: Map | None, kind: TruthKind | None) -> Map | None:
    """Set the disparity of a rendered view to 0 in the sky; None where no truth is needed."""
    return None if exact_px is None or kind is None else exact_px.nan_to_num(0.0)


def _list_usable_pairs(
    dataset: Dataset, config: PairsConfig, *, needs_truth: bool, is_mixed: bool
) -> list[_PairRef]:
    """List the pairs of a folder that can be learnt from, with one kind of truth if it is needed.

    ``is_mixed``: frames without truth, and those without a right view, count too.

    Raises:
        InputError: no frame can be used, or none has the truth of the config, or the folder has
            several kinds of truth and the config chooses none.
    """
    name = dataset.name

    # The kinds of truth of each frame that has the views.
    kinds_by_index = {
        index: list_truth_kinds(frame)
        for index, frame in enumerate(dataset.frames)
        if (frame.right is not None or is_mixed) and frame.name not in config.exclude
    }
    single = sum(frame.right is None for frame in dataset.frames)
    if single and not is_mixed and kinds_by_index:
        message = f"{name}: {single} of {len(dataset)} images have no right view, and are left out"
        warnings.warn(message, Notice, stacklevel=2)

    # One kind is learnt from: the config's, or the only one that there is.
    kind: TruthKind | None = None
    if needs_truth:
        counts: Counter[TruthKind] = Counter(
            kind for kinds in kinds_by_index.values() for kind in kinds
        )
        listed = ", ".join(f"{kind} of {count} frames" for kind, count in counts.items())
        if config.truth is not None and counts and config.truth not in counts:
            raise InputError(f"{name}: no frame has truth: {config.truth}; there is {listed}")
        if config.truth is None and len(counts) > 1:
            raise InputError(
                f"{name}: has several kinds of truth ({listed}), and one kind alone is learnt "
                "from; set truth in pairs (or held_out) of the config to one of "
                f"{', '.join(counts)}"
            )
        kind = config.truth or next(iter(counts), None)

    # Frames with that truth; where sources are mixed, pairs without truth too.
    refs = [
        _PairRef(dataset, index, kind if kind in kinds else None)
        for index, kinds in kinds_by_index.items()
    ]
    if is_mixed:  # a single image without truth teaches nothing
        usable = [ref for ref in refs if ref.truth or dataset.frames[ref.number].right is not None]
    else:
        usable = [ref for ref in refs if ref.truth or not needs_truth]
    if not usable:
        if is_mixed:
            needed = "a right view or a truth"
        else:
            needed = "a right view and a truth" if needs_truth else "a right view"
        raise InputError(f"{name}: no frame has {needed}; nothing to train on.")
    return usable


_STREETS = "synthetic streets"
"""Name of rendered streets in ``run.json``, which a resumed training compares."""
