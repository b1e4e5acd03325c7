"""The task that trains the generator that selects, and its samples.

It learns from pairs and single images, synthetic and real.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from depthpose.core.draw import draw_disparity
from depthpose.core.loop import Update, ValidationResult, make_adam, make_sample_generator
from depthpose.depth import generators, losses, synthesis
from depthpose.depth.augment import degrade
from depthpose.depth.config import DegradeConfig
from depthpose.depth.disparity import right_disparity_from_left
from depthpose.depth.metrics import measure
from depthpose.depth.train.config import SelectTraining
from depthpose.depth.train.pairs import TrainingPairs
from depthpose.depth.train.stereo_task import (
    average_metrics,
    freeze_norm_statistics,
    group_parameters,
)
from depthpose.depth.types import Map, Maps, Mask


class SelectionSample(NamedTuple):
    """A sample or batch of the selecting generator's training.

    Disparity is NaN where it is unknown, and 0 in the sky.
    """

    degraded: Float[Tensor, "*b 3 h w"]  # the degraded left image: the input
    left: Float[Tensor, "*b 3 h w"]  # the left image itself, which the right view is made of
    right: Float[Tensor, "*b 3 h w"]
    left_px: Float[Tensor, "*b h w"]
    right_px: Float[Tensor, "*b h w"]
    has_right: Bool[Tensor, "*b"]  # whether there is a right image; else ``right`` is the left one


class SelectionSamples:
    """Samples by index, of which an evenly spread share comes from a second source.

    The first source sets the length of an epoch.

    Args:
        sources: one or two sources of pairs.
        more_share: share of the samples from the second source, if there is one.
        config: degradation of the input.
        seed: seed of the random numbers.

    Attributes:
        truths: which kind of truth each source gives, as :class:`TrainingPairs` has it.
    """

    def __init__(
        self, sources: Sequence[TrainingPairs], more_share: float, config: DegradeConfig, seed: int
    ) -> None:
        self.sources = sources
        self.config = config
        self.seed = seed
        self.more_share = more_share if len(sources) > 1 else 0.0
        self.truths = tuple(truth for source in sources for truth in source.truths)

    def __len__(self) -> int:
        return len(self.sources[0])

    def __getitem__(self, sample_index: int) -> SelectionSample:
        """Make the sample of an index.

        It is of the second source where the share of samples up to it reaches a new whole number.
        """
        second_before = int(sample_index * self.more_share)  # samples of the second source so far
        second_after = int((sample_index + 1) * self.more_share)
        if second_after > second_before:
            pair = self.sources[1][second_before]
        else:
            pair = self.sources[0][sample_index - second_before]

        # Where one image stands for both views, the right one's truth follows from the left one's.
        has_right = not torch.equal(pair.left, pair.right)
        right_px = pair.right_px if has_right else right_disparity_from_left(pair.left_px)
        generator = make_sample_generator(sample_index, self.seed + 1)
        return SelectionSample(
            degraded=degrade(pair.left, self.config, generator),
            left=pair.left,
            right=pair.right,
            left_px=pair.left_px,
            right_px=right_px,
            has_right=torch.tensor(has_right),
        )


_MAX_DEPTH_M = 80.0
"""Truth beyond this does not count, and estimates are clamped to it, as in Eigen's protocol."""


class SelectTask:
    """Trains the generator that selects.

    The loss is the relative error and the cross entropy of both views' disparity, and the L1 of the
    right view.
    """

    def __init__(
        self,
        generator: generators.SelectionGenerator,
        config: SelectTraining,
        held_out: TrainingPairs | None,
    ) -> None:
        self.config = config
        self.held_out = held_out
        self.generator = generator
        if config.with_frozen_stem:
            generator.encoder.freeze_early()
        generator.encoder.mixed_style.share = config.style_share
        self.modules: dict[str, nn.Module] = {"generator": generator}
        self._set_train_mode()
        groups = group_parameters(generator, generator.encoder, config.encoder_rate)
        self.optimizers = {"generator": (make_adam(groups, config.adam), config.adam)}

    def _set_train_mode(self) -> None:
        """Set the generator to train mode, except for the encoder's norms if its stem is frozen."""
        self.generator.train()
        if self.config.with_frozen_stem:
            freeze_norm_statistics(self.generator.encoder)

    def step(self, batch: SelectionSample) -> Iterator[Update]:
        """Estimate disparities and synthesise right views; yield the generator's one update."""
        left_logits, right_logits = self.generator(batch.degraded)
        left_loss = self._compute_disparity_loss(left_logits, batch.left_px)
        right_loss = self._compute_disparity_loss(right_logits, batch.right_px)
        loss = left_loss + self.config.right_share * right_loss
        facts = {"left": left_loss.detach(), "right": right_loss.detach()}

        # The right view, at half size as the logits are; where there is a real one.
        if self.config.view_weight:
            left = F.avg_pool2d(batch.left, 2)
            right = F.avg_pool2d(batch.right, 2)
            drawn = synthesis.mix_shifts(left, right_logits.float(), self.generator.planes / 2)
            image_losses = losses.view_loss(drawn, right)
            pair_count = batch.has_right.sum().clamp(min=1)
            view_loss = (image_losses * batch.has_right).sum() / pair_count
            loss = loss + self.config.view_weight * view_loss
            facts["view"] = view_loss.detach()
        yield Update("generator", loss, facts)

    def _compute_disparity_loss(
        self, logits: Float[Tensor, "b k rows columns"], truth_px: Maps
    ) -> Float[Tensor, ""]:
        """Compute the loss of one view's disparity, and of its classes where they have a weight."""
        # The disparity that the logits mean, at the size of the truth.
        planes = self.generator.planes
        half_log_px, _, _ = synthesis.read_logits(logits, planes)
        size = truth_px.shape[1:]
        log_px = F.interpolate(half_log_px[:, None], size, mode="bilinear", align_corners=False)
        range_px = self.generator.config.disparity_px
        loss = losses.log_disparity_loss(log_px[:, 0], truth_px, range_px)
        if not self.config.plane_weight:
            return loss

        # The truth at half size: the nearest point of the four pixels of each logit; unknown is -1.
        half_px = F.max_pool2d(truth_px.nan_to_num(-1.0)[:, None], 2)[:, 0]
        half_px = torch.where(half_px < 0, torch.nan, half_px)
        return loss + self.config.plane_weight * losses.plane_loss(logits, half_px, planes)

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Measure held-out left images: relative error, share within 25 % (d1), missed sky."""
        if self.held_out is None:
            return ValidationResult()
        self.generator.eval()
        device = next(self.generator.parameters()).device
        config = self.generator.config
        synthesiser = synthesis.SelectionSynthesiser(self.generator, device)
        far_px = config.virtual_focal_px * config.virtual_baseline_m / _MAX_DEPTH_M
        measured: list[dict[str, float]] = []
        pictures: dict[str, Tensor] = {}
        for index in range(len(self.held_out)):
            pair = self.held_out.read(index)
            views = synthesiser.synthesise(pair.left[None])
            assert views.matches is not None
            (match,) = views.matches
            assert match.is_sky is not None
            predicted_px = match.disparity_px.where(~match.is_sky, 0.0).clamp(min=far_px)
            if index == 0:
                shown = [pair.left, pair.right, views.right[0], draw_disparity(predicted_px)]
                pictures["left_right_drawn_disparity"] = torch.cat(shown, 1)
            measured.append(_measure_single(predicted_px, match.is_sky, pair.left_px, far_px))
        self._set_train_mode()
        return ValidationResult(numbers=average_metrics(measured), pictures=pictures)


def _measure_single(
    predicted_px: Map, is_sky: Mask, truth_px: Map, far_px: float
) -> dict[str, float]:
    """Measure the disparity of one image as depth: its metrics, of those that its truth allows.

    Args:
        predicted_px: disparity for the rig that the generator imitates.
        is_sky: what is taken for sky.
        truth_px: true disparity; 0 in the sky, NaN where it is unknown.
        far_px: disparity of the farthest truth that counts.
    """
    metrics: dict[str, float] = {}
    has_truth = truth_px >= far_px
    if bool(has_truth.any()) and bool(predicted_px.isfinite().all()):
        # 1 / disparity is depth in another unit, on which these metrics do not depend.
        errors = measure("depth", 1 / predicted_px[has_truth], 1 / truth_px[has_truth])
        metrics = {"abs_rel": errors["abs_rel"], "d1": errors["d1"]}
    elif bool(has_truth.any()):  # of a network that diverged
        metrics = {"abs_rel": math.nan, "d1": math.nan}

    is_true_sky = truth_px == 0
    if bool(is_true_sky.any()):
        metrics["sky_missed"] = float((~is_sky[is_true_sky]).float().mean())
    return metrics
