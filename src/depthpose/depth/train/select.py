"""Stage 1 of the generator that selects: disparity where there is truth, the view where a pair.

Its samples are pairs and single images, synthetic and real, mixed.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from depthpose.core.draw import draw_disparity
from depthpose.core.loop import Update, ValidationResult, make_adam, sample_generator
from depthpose.depth.augment import TrainingPair, degrade
from depthpose.depth.config import DegradeConfig
from depthpose.depth.disparity import right_disparity_from_left
from depthpose.depth.losses import DISPARITY_LOSSES, plane_loss, view_loss
from depthpose.depth.synthesis import SelectionGenerator
from depthpose.depth.synthesis.selection import log_expectation, mix_shifts
from depthpose.depth.synthesis.synthesiser import SelectionSynthesiser
from depthpose.depth.train.config import SelectTraining
from depthpose.depth.train.pairs import TrainingPairs


class SelectionSample(NamedTuple):
    """What one step of the selecting generator sees of an image.

    Disparities are NaN where unknown, and 0 in the sky.

    Attributes:
        seen: the left image as a camera may deliver it: the network's input.
        left: the left image itself, which the right view is drawn from.
        right: the right image.
        left_px: disparity of the left view.
        right_px: disparity of the right view.
        has_right: whether there is a right image; else ``right`` repeats the left one.
    """

    seen: Float[Tensor, "*b 3 h w"]
    left: Float[Tensor, "*b 3 h w"]
    right: Float[Tensor, "*b 3 h w"]
    left_px: Float[Tensor, "*b h w"]
    right_px: Float[Tensor, "*b h w"]
    has_right: Bool[Tensor, "*b"]


class SelectionSamples:
    """Samples by index: a share of the indices draws from the second source, evenly spread.

    Args:
        sources: the pairs that set the length of an epoch; and perhaps others, e.g. real ones
            beside synthetic ones.
        more_share: share of the samples that draws from the others.
        config: changes of the input alone.
        seed: decides the changes.

    Attributes:
        truths: which kind of truth each source gives.
    """

    def __init__(
        self, sources: Sequence[TrainingPairs], more_share: float, config: DegradeConfig, seed: int
    ) -> None:
        self.sources, self.config, self.seed = sources, config, seed
        self.more_share = more_share if len(sources) > 1 else 0.0
        self.truths = tuple(said for source in sources for said in source.truths)

    def __len__(self) -> int:
        return len(self.sources[0])

    def __getitem__(self, sample_index: int) -> SelectionSample:
        """Make the n-th sample."""
        before, now = int(sample_index * self.more_share), int((sample_index + 1) * self.more_share)
        pair = self.sources[1][before] if now > before else self.sources[0][sample_index - before]
        seen = degrade(pair.left, self.config, sample_generator(sample_index, self.seed + 1))
        return as_sample(pair, seen)


def as_sample(pair: TrainingPair, seen: Float[Tensor, "3 h w"]) -> SelectionSample:
    """Make a sample of a pair; one image that stands for both views has no right one."""
    left, right, left_px, right_px, _ = pair
    has_right = torch.tensor(not torch.equal(left, right))
    if not has_right:
        right_px = right_disparity_from_left(left_px)
    return SelectionSample(seen, left, right, left_px, right_px, has_right)


_CAP_M = 80.0
"""Truth beyond this does not count, and no estimate lies beyond it, as in Eigen's protocol."""


class SelectTask:
    """Relative error and cross entropy of both views' disparity, L1 of the drawn right view."""

    def __init__(
        self, generator: SelectionGenerator, config: SelectTraining, held_out: TrainingPairs | None
    ) -> None:
        self.config, self.held_out = config, held_out
        self.generator = generator
        if config.with_frozen_stem:
            generator.encoder.freeze_early()
        self.modules: dict[str, nn.Module] = {"generator": generator}
        self._train()
        self.optimizers = {"generator": (make_adam(self._groups(), config.adam), config.adam)}

    def _groups(self) -> list[dict[str, object]]:
        encoder = [p for p in self.generator.encoder.parameters() if p.requires_grad]
        rest = [
            p for name, p in self.generator.named_parameters() if not name.startswith("encoder.")
        ]
        return [{"params": encoder, "rate": self.config.encoder_rate}, {"params": rest}]

    def _train(self) -> None:
        self.generator.train()
        if self.config.with_frozen_stem:
            self.generator.encoder.keep_statistics()

    def step(self, batch: SelectionSample) -> Iterator[Update]:
        """One update: predict disparity, warp the right view, compare."""
        planes = self.generator.planes
        left, right = self.generator(batch.seen)
        losses = [self._truth_loss(left, batch.left_px), self._truth_loss(right, batch.right_px)]
        loss = losses[0] + self.config.right_share * losses[1]
        facts = {"left": losses[0].detach(), "right": losses[1].detach()}
        if self.config.view_weight:
            small = [F.avg_pool2d(view, 2) for view in (batch.left, batch.right)]
            drawn = mix_shifts(small[0], right.float(), planes / 2)
            views = view_loss(drawn, small[1])
            view = (views * batch.has_right).sum() / batch.has_right.sum().clamp(min=1)
            loss = loss + self.config.view_weight * view
            facts["view"] = view.detach()
        yield Update("generator", loss, facts)

    def _truth_loss(
        self, logits: Float[Tensor, "b k rows columns"], truth_px: Float[Tensor, "b h w"]
    ) -> Float[Tensor, ""]:
        """Losses of the disparity of one view."""
        planes, range_px = self.generator.planes, self.generator.config.disparity_px
        log_px = log_expectation(logits, planes)[:, None]
        log_px = F.interpolate(log_px, truth_px.shape[1:], mode="bilinear", align_corners=False)
        loss = DISPARITY_LOSSES[self.config.disparity_loss](log_px[:, 0], truth_px, range_px)
        if not self.config.plane_weight:
            return loss
        # The nearest point of the four pixels that a logit stands for; unknown is -1.
        coarse = F.max_pool2d(truth_px.nan_to_num(-1.0)[:, None], 2)[:, 0]
        coarse = torch.where(coarse < 0, torch.nan, coarse)
        return loss + self.config.plane_weight * plane_loss(logits, coarse, planes)

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Depth of held-out left images; of the first, drawn view and disparity as a picture."""
        if self.held_out is None:
            return ValidationResult()
        self.generator.eval()
        device = next(self.generator.parameters()).device
        result = held_out_depth(SelectionSynthesiser(self.generator, device), self.held_out)
        self._train()
        return result


def held_out_depth(synthesiser: SelectionSynthesiser, held_out: TrainingPairs) -> ValidationResult:
    """Relative error of depth (AbsRel), share within 25 % (d1), share of the sky that is missed."""
    rig = synthesiser.config
    far_px = rig.virtual_focal_px * rig.virtual_baseline_m / _CAP_M
    errors, within, missed, pictures = [], [], [], {}
    for index in range(len(held_out)):
        pair = held_out.read(index)
        drawn = synthesiser.draw(pair.left[None])
        assert drawn.disparity_px is not None and drawn.is_sky is not None  # noqa: PT018
        is_sky = drawn.is_sky[0]
        found_px = torch.where(is_sky, 0.0, drawn.disparity_px[0]).clamp(min=far_px)
        if index == 0:
            views = [pair.left, pair.right, drawn.right[0], draw_disparity(found_px)]
            pictures["left_right_drawn_disparity"] = torch.cat(views, 1)
        is_known, is_true_sky = pair.left_px >= far_px, pair.left_px == 0
        if bool(is_known.any()):
            ratio = pair.left_px[is_known] / found_px[is_known]
            errors.append(float((ratio - 1).abs().mean()))
            within.append(float((torch.maximum(ratio, 1 / ratio) < 1.25).float().mean()))
        if bool(is_true_sky.any()):
            missed.append(float((~is_sky[is_true_sky]).float().mean()))
    numbers = {"abs_rel": errors, "d1": within, "sky_missed": missed}
    means = {f"held_out/{k}": sum(v) / len(v) for k, v in numbers.items() if v}
    return ValidationResult(numbers=means, pictures=pictures)
