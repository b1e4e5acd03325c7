"""Pairs, on disk or rendered, as training samples by index."""

import warnings
from collections import Counter
from typing import NamedTuple

import torch

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError, Notice
from depthpose.core.loop import sample_generator, shuffled_index
from depthpose.depth.augment import TrainingPair, augment, scale_pair
from depthpose.depth.config import PairsConfig, TruthKind
from depthpose.depth.datasets import Dataset, known_truths, lidar_truth, open_dataset
from depthpose.depth.disparity import disparity_from_depth, right_disparity_from_left
from depthpose.depth.synthetic import Streets, kitti_rig
from depthpose.depth.types import Map

BASELINE_TOLERANCE = 0.02
"""Relative difference of baselines that one virtual rig may stand for: KITTI's differ by 1.4 %."""


class _Place(NamedTuple):
    """Where a pair comes from: a source, its number there, and the truth that is read."""

    source: Dataset | Streets
    number: int
    truth: TruthKind | None


class TrainingPairs:
    """Frames of several folders, each sample a random one, randomly changed.

    Args:
        config: which pairs, and how.
        seed: decides order and changes.
        needs_truth: read truth, and leave out frames without the kind that ``config.truth`` names.
        is_mixed: take frames without truth, and frames without a right view, too. A left image
            alone stands for both views.
        baseline_m: refuse pairs whose baseline is another (beyond 2 %).

    Attributes:
        frames: those of folders, not what is rendered.
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

        # Where the pairs are: rendered streets, and frames of folders.
        sources: list[list[_Place]] = []
        if config.streets is not None:
            streets = Streets(config.streets)
            exact: TruthKind | None = "disparity" if needs_truth else None
            sources.append([_Place(streets, k, exact) for k in range(len(streets))])
        excluded = set(config.exclude)
        for number, folder in enumerate(config.folders):
            dataset = open_dataset(folder, config.split if number == 0 else None)
            excluded -= {frame.name for frame in dataset.frames}
            usable = _usable_places(dataset, config, needs_truth=needs_truth, is_mixed=is_mixed)
            sources.append(usable)
        if excluded:
            raise InputError(
                f"exclude names {sorted(excluded)}, which no folder holds; a misspelt name would "
                "train on what should be left out"
            )

        # At most so many of each source, at equal distances: neighbours in a drive look alike.
        self._places: list[_Place] = []
        for places in sources:
            most = len(places) if config.limit is None else min(config.limit, len(places))
            last = len(places) - 1
            self._places += [places[round(k * last / max(most - 1, 1))] for k in range(most)]

        # What they are called, and which truth each source has.
        numbered = ((source, number) for source, number, _ in self._places)
        self.frames = [source.frames[n] for source, n in numbered if isinstance(source, Dataset)]
        names = (
            (source.name if isinstance(source, Dataset) else _STREETS, truth)
            for source, _, truth in self._places
        )
        self.truths = tuple(dict.fromkeys(f"{name}: {truth}" for name, truth in names if truth))
        self._cache: dict[int, TrainingPair] = {}
        if baseline_m is not None:
            self._refuse_other_rigs(baseline_m)

    def _refuse_other_rigs(self, baseline_m: float) -> None:
        """Refuse pairs of another baseline, before any work: it would change the metric scale."""
        rigs = {
            source.frames[number].name: source.read_rig(number)
            for source, number, _ in self._places
            if isinstance(source, Dataset)
        }
        if self.config.streets is not None:  # five rigs, and perhaps millions of streets
            rigs |= {f"street with KITTI's rig {n}": kitti_rig(n) for n in range(5)}
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
        return len(self._places)

    def __getitem__(self, sample_index: int) -> TrainingPair:
        """Make the n-th sample."""
        index = shuffled_index(sample_index, len(self), self.seed)
        generator = sample_generator(sample_index, self.seed)
        return augment(self.read(index), self.config.augment, generator)

    def read(self, index: int) -> TrainingPair:
        """Read one whole pair at the config's focal length, unchanged otherwise."""
        if not self.config.with_cache:
            return self._read(index)
        if index not in self._cache:
            pair = self._read(index)
            views = [(view * 255).round().to(torch.uint8) for view in (pair.left, pair.right)]
            self._cache[index] = pair._replace(left=views[0], right=views[1])
        cached = self._cache[index]
        return cached._replace(left=cached.left.float() / 255, right=cached.right.float() / 255)

    def _read(self, index: int) -> TrainingPair:
        """Read a pair, and its truth if it is needed; 0 in the sky, where that is known."""
        source, number, kind = self._places[index]
        if isinstance(source, Dataset):
            name = source.frames[number].name
            views = source.read_input(number)
            rig = views.camera if isinstance(views.camera, StereoRig) else None
            left_px = _truth_of_frame(source, number, kind, rig)
            right_px = None
        else:
            name = f"street {number}"
            sample = source[number]
            views = sample.input
            rig = views.camera
            left_px = _with_sky_at_zero(sample.truth.disparity_px, kind)
            right_px = _with_sky_at_zero(sample.truth.right_disparity_px, kind)

        if left_px is None:
            left_px = torch.full_like(views.left[0], torch.nan)
        right = views.right
        if right is None:  # of an image alone: a sample says that it has no right view
            right = views.left
            right_px = left_px
        elif right_px is None:
            right_px = right_disparity_from_left(left_px)
        focal_px = torch.tensor(torch.nan if rig is None else float(rig.K[0, 0]))
        pair = TrainingPair(views.left, right, left_px, right_px, focal_px)

        wanted_px = self.config.focal_px
        if wanted_px is None:
            return pair
        if rig is None:
            raise InputError(
                f"{name}: has no calibration, so it cannot be brought to a "
                f"focal length of {wanted_px} px; add one, exclude it, or leave focal_px out"
            )
        return scale_pair(pair, wanted_px / float(focal_px))


def _truth_of_frame(
    dataset: Dataset, number: int, kind: TruthKind | None, rig: StereoRig | None
) -> Map | None:
    """Read the disparity of a frame's left view [px] from its kind of truth; None without one."""
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
        depth_m = lidar_truth(dataset.frames[number], "camera_z")
    assert depth_m is not None, "frames without truth were left out"
    return disparity_from_depth(depth_m, rig)


def _with_sky_at_zero(exact_px: Map | None, kind: TruthKind | None) -> Map | None:
    """Give the exact disparity of a made view, 0 in the sky; None where no truth is wanted."""
    return None if exact_px is None or kind is None else exact_px.nan_to_num(0.0)


def _usable_places(
    dataset: Dataset, config: PairsConfig, *, needs_truth: bool, is_mixed: bool
) -> list[_Place]:
    """Frames of a folder that can be learnt from, all with one kind of truth if it is needed."""
    name = dataset.name
    wanted = config.truth

    # The kinds of truth of each frame that has the views.
    kinds_by_index = {
        index: known_truths(frame)
        for index, frame in enumerate(dataset.frames)
        if (frame.right is not None or is_mixed) and frame.name not in config.exclude
    }
    alone = sum(frame.right is None for frame in dataset.frames)
    if alone and not is_mixed and kinds_by_index:
        message = f"{name}: {alone} of {len(dataset)} images have no right view, and are left out"
        warnings.warn(message, Notice, stacklevel=2)

    # One kind is learnt from: the config's, or the only one that there is.
    kind: TruthKind | None = None
    if needs_truth:
        counts: Counter[TruthKind] = Counter(
            kind for kinds in kinds_by_index.values() for kind in kinds
        )
        listed = ", ".join(f"{kind} of {count} frames" for kind, count in counts.items())
        if wanted is not None and counts and wanted not in counts:
            raise InputError(f"{name}: no frame has truth: {wanted}; there is {listed}")
        if wanted is None and len(counts) > 1:
            raise InputError(
                f"{name}: has several kinds of truth ({listed}), and one kind alone is learnt "
                "from; set truth in pairs (or held_out) of the config to one of "
                f"{', '.join(counts)}"
            )
        kind = wanted or next(iter(counts), None)

    # Frames with that truth; where sources are mixed, pairs without truth too.
    places = [
        _Place(dataset, index, kind if kind in kinds else None)
        for index, kinds in kinds_by_index.items()
    ]
    if is_mixed:  # an image alone without truth teaches nothing
        usable = [p for p in places if p.truth or dataset.frames[p.number].right is not None]
    else:
        usable = [p for p in places if p.truth or not needs_truth]
    if not usable:
        what = " or ".join if is_mixed else " and ".join
        parts = ["a right view", "a truth"] if needs_truth or is_mixed else ["a right view"]
        raise InputError(f"{name}: no frame has {what(parts)}; nothing to train on.")
    return usable


_STREETS = "synthetic streets"
"""As ``run.json`` names them: a resumed training compares the names."""
