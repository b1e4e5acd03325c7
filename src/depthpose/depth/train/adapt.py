"""Self-supervised adaptation of a matcher to one rig's pairs; kept only if it is better.

The loss warps the other view by the disparity of each view and compares (Godard et al., CVPR
2017), where the disparities of both views agree: elsewhere one of the two does not see the point.
Labels of the initial matcher, where both views agreed at full size, regularise it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch import nn

from depthpose.core.checkpoint import file_sha256, find_weights
from depthpose.core.errors import InputError
from depthpose.core.loop import Update, ValidationResult, make_adam
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import MatcherConfig, PairsConfig, StreetsConfig
from depthpose.depth.datasets import Dataset, open_dataset
from depthpose.depth.disparity import warp_right_to_left
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.labels import LabelConfig, is_consistent, label_pairs, match_both_ways
from depthpose.depth.losses import heads_loss, photometric_error, smoothness_loss
from depthpose.depth.metrics import disparity_errors
from depthpose.depth.stereo import NetworkMatcher, StereoNetwork, make_matcher, normalise
from depthpose.depth.synthetic import Streets
from depthpose.depth.train.config import AdaptTraining
from depthpose.depth.types import Mask, StereoInput

_LIMITS = LabelConfig()
"""When the disparities of both views agree."""
_FORGOTTEN = 0.005
"""More bad disparities on synthetic streets than this share are too many."""
_NOTHING = 0.002
"""A change by this share is none."""
_STREETS_SEED = 977


class AdaptTask:
    """Photometric error of both views, smoothness, and the labels of the start.

    Args:
        matcher: a network that is trained by the stage ``stereo``.
        config: weights of the losses.
    """

    def __init__(self, matcher: StereoNetwork, config: AdaptTraining) -> None:
        self.config, self.matcher = config, matcher.train()
        for part in matcher.modules():
            # Statistics stay those of the training before: one or two pairs have none.
            if isinstance(part, nn.BatchNorm2d | nn.BatchNorm3d):
                part.eval()
        self.modules: dict[str, nn.Module] = {"matcher": matcher}
        parameters = [p for p in matcher.parameters() if p.requires_grad]
        self.optimizers = {"matcher": (make_adam(parameters, config.adam), config.adam)}

    def step(self, batch: TrainingPair) -> Iterator[Update]:
        """One update: match both ways, warp each view to the other."""
        views = torch.cat([batch.left, batch.right.flip(-1)])
        others = torch.cat([batch.right, batch.left.flip(-1)])
        heads = [head.float() for head in self.matcher(normalise(views), normalise(others))]
        found_px, count = heads[-1], len(batch.left)
        # The mean difference where both ways agree; the first ``count`` are left views.
        looked_up = torch.stack(list(map(warp_right_to_left, others, found_px)))
        both = zip(found_px, found_px.roll(count, 0).flip(-1), strict=True)
        is_seen = torch.stack([is_consistent(one, back, _LIMITS) for one, back in both])
        error = photometric_error(views, looked_up.nan_to_num(0.0))
        error = torch.where(is_seen, error, 0.0).sum() / is_seen.sum().clamp(min=1)
        smooth = smoothness_loss(found_px, views)
        max_disparity_px = self.matcher.config.max_disparity_px
        label = heads_loss([head[:count] for head in heads], batch.left_px, max_disparity_px)
        config = self.config
        loss = config.photometric_weight * error + config.smooth_weight * smooth
        loss = loss + config.label_weight * label
        facts = {"photometric": error.detach(), "smooth": smooth.detach(), "label": label.detach()}
        yield Update("matcher", loss, facts)

    def validate(self) -> ValidationResult:
        """Nothing: the held-out pairs are looked at once, at the end."""
        return ValidationResult()


@dataclass(frozen=True, kw_only=True)
class AdaptMetrics:
    """What a matcher does on held-out pairs, and on synthetic streets (None without any)."""

    # Difference of left views and right ones looked up, where the start's two disparities agreed.
    photometric: float
    # Share of pixels whose disparities of both views do not agree, or that are newly taken for sky.
    disagreeing: float
    street_d1: float | None  # share of bad disparities
    street_epe_px: float | None  # mean error [px]


class AdaptationCheck:
    """Measures a matcher before and after, and refuses what became worse.

    Args:
        pairs: pairs of the rig that are not trained on.
        streets: how many synthetic streets.
        config: how matchers run.
    """

    def __init__(self, pairs: Sequence[StereoInput], streets: int, config: MatcherConfig) -> None:
        self.pairs, self.config = pairs, config
        made = Streets(StreetsConfig(seed=_STREETS_SEED, scale=0.5, frames=max(streets, 1)))
        self.streets = [made[index] for index in range(streets)]
        self._seen: list[Mask] = []
        self._sky: list[Mask | None] = []

    @torch.no_grad()
    def measure(self, matcher: StereoNetwork) -> AdaptMetrics:
        """Measure a network in eval mode; the first one decides which pixels count."""
        net = FakestereoNet(make_matcher(matcher, self.config))
        errors, apart = [], []
        for number, pair in enumerate(self.pairs):
            found, right_px = match_both_ways(net, pair)
            left_px = found.disparity_px
            agrees = is_consistent(left_px, right_px, _LIMITS)
            if len(self._seen) == number:
                self._seen.append(agrees)
                self._sky.append(found.is_sky)
            before = self._sky[number]
            if found.is_sky is not None and before is not None:
                agrees &= before | ~found.is_sky  # nothing disagrees where all is sky
            assert pair.right is not None
            looked_up = warp_right_to_left(pair.right, left_px)
            counts = self._seen[number] & looked_up[0].isfinite()
            error = photometric_error(pair.left[None], looked_up.nan_to_num(0.0)[None])[0]
            errors.append(error[counts].mean())
            apart.append((~agrees).float().mean())
        bad, off_px = [], []
        for street in self.streets:
            truth_px = street.truth.disparity_px
            assert truth_px is not None
            found_px = net.estimate_pair(street.input, with_check=False).disparity_px
            counts = truth_px > 0
            of_street = disparity_errors(found_px[counts], truth_px[counts])
            bad.append(of_street.d1_all)
            off_px.append(of_street.epe_px)
        return AdaptMetrics(
            photometric=float(torch.stack(errors).mean()),
            disagreeing=float(torch.stack(apart).mean()),
            street_d1=sum(bad) / len(bad) if bad else None,
            street_epe_px=sum(off_px) / len(off_px) if bad else None,
        )


def refuse_worse(before: AdaptMetrics, after: AdaptMetrics) -> None:
    """Refuse a matcher that lost more than it gained."""
    said = f"before {asdict(before)}, after {asdict(after)}"
    advice = "no weights are written; take fewer steps, a lower learning_rate, or more pairs"
    changes = [
        getattr(after, name) / max(getattr(before, name), 1e-9) - 1
        for name in ("photometric", "disagreeing")
    ]
    # NaN, where no pixel could be compared, is no gain either.
    if not (all(c <= _NOTHING for c in changes) and any(c <= -_NOTHING for c in changes)):
        raise InputError(f"the held-out pairs fit no better: {said}; {advice}.")
    if (after.street_d1 or 0.0) > (before.street_d1 or 0.0) + _FORGOTTEN:
        raise InputError(
            f"synthetic streets are matched worse by more than {_FORGOTTEN:.1%} bad disparities: "
            f"{said}; {advice}."
        )


def split_pairs(
    folder: str, split: str | None, share: float, exclude: Sequence[str] = ()
) -> tuple[Dataset, list[int], list[int]]:
    """Open a folder of pairs; give the numbers of those to train on, and of the last, held out.

    Frames that ``exclude`` names are neither.
    """
    dataset = open_dataset(folder, split)
    usable = [
        n
        for n, frame in enumerate(dataset.frames)
        if frame.right and frame.calibration and frame.name not in exclude
    ]
    usable.sort(key=lambda n: dataset.frames[n].name)
    if len(usable) < 2:
        raise InputError(
            f"{dataset.name}: {len(usable)} of {len(dataset.frames)} frames have a right view and "
            "a calibration; two at least are needed, one to train on and one to measure by"
        )
    number = min(max(1, round(share * len(usable))), len(usable) - 1)
    return dataset, usable[:-number], usable[-number:]


def fine_focal_px(config: AdaptTraining, network: StereoNetwork) -> float:
    """Give the focal length of a fine match of the first held-out pair, not enlarged [px]."""
    folder, split = config.pairs.folders[0], config.pairs.split
    dataset, _, back = split_pairs(folder, split, config.validation_share, config.pairs.exclude)
    camera = dataset.read_input(back[0]).camera
    assert camera is not None, "pairs with a calibration"
    matcher = make_matcher(network, MatcherConfig())
    assert isinstance(matcher, NetworkMatcher)
    largest_px = max(float(camera.K[0, 0]), matcher.network_config.work_focal_px or 0.0)
    return min(matcher.work_focal_px(camera), largest_px)


def label_folders(config: AdaptTraining, home: Path) -> tuple[PairsConfig, list[StereoInput]]:
    """Label pairs by the start, once, below ``home``; give what to train on, and the rest."""
    folders: list[str] = []
    kept: list[StereoInput] = []
    path = find_weights(config.start)
    device = "cuda" if config.loop.device == "auto" and torch.cuda.is_available() else "cpu"
    net = FakestereoNet.load(path, matcher=path, config=MatcherConfig(device=device))
    for number, folder in enumerate(config.pairs.folders):
        split = config.pairs.split if number == 0 else None
        dataset, shown, back = split_pairs(
            folder, split, config.validation_share, config.pairs.exclude
        )
        kept += [dataset.read_input(n) for n in back]
        held_out = [dataset.frames[n].name for n in back]
        settings = {"dataset": dataset.name, "held_out": held_out} | asdict(_LIMITS)
        settings["weights_sha256"] = file_sha256(path)
        place = home / f"{number}-{Path(folder).name}"
        for _ in label_pairs(net, dataset, _LIMITS, place, settings, shown):
            pass
        folders.append(str(place))
    pairs = replace(config.pairs, folders=tuple(folders), exclude=(), truth="disparity", split=None)
    return pairs, kept
