"""The stages of a training as tasks of one loop: the losses of a step, and the validation.

The thesis has three: a generator against a discriminator, the matcher, and the generator through
the matcher. The generator that selects learns from pairs and single images, synthetic and real.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from depthpose.core.draw import draw_disparity
from depthpose.core.loop import Update, ValidationResult, make_adam, sample_generator
from depthpose.depth import losses, synthesis
from depthpose.depth.augment import TrainingPair, degrade
from depthpose.depth.config import DegradeConfig
from depthpose.depth.disparity import right_disparity_from_left
from depthpose.depth.metrics import measure
from depthpose.depth.stereo import StereoNetwork, normalise
from depthpose.depth.stereo.matcher import pad_top_right
from depthpose.depth.train.config import (
    FinetuneTraining,
    SelectTraining,
    StereoTraining,
    ViewTraining,
)
from depthpose.depth.train.pairs import TrainingPairs
from depthpose.depth.types import Map, Maps, Mask, View


def _freeze_norm_statistics(module: nn.Module) -> None:
    """Set batch norms to eval mode, so that small batches do not spoil their statistics."""
    for part in module.modules():
        if isinstance(part, nn.BatchNorm2d | nn.BatchNorm3d):
            part.eval()


def _group_parameters(
    network: nn.Module, encoder: nn.Module, encoder_rate: float
) -> list[dict[str, Any]]:
    """Group a network's parameters for the optimiser: those of its encoder, and the rest.

    ``encoder_rate``: learning rate of the encoder, as a share of the rest's.
    """
    encoder_parameters = set(encoder.parameters())
    rest = [p for p in network.parameters() if p not in encoder_parameters]
    trained = [p for p in encoder.parameters() if p.requires_grad]
    return [{"params": trained, "rate": encoder_rate}, {"params": rest}]


class StereoTask:
    """Trains the matcher: smooth L1 on all heads (eq. 2.6), and cross entropy of the sky."""

    def __init__(
        self, matcher: StereoNetwork, config: StereoTraining, held_out: TrainingPairs | None
    ) -> None:
        self.config = config
        self.held_out = held_out
        self.matcher = matcher
        self.modules: dict[str, nn.Module] = {"matcher": matcher}

        # Parts that stay as they are: the encoder's stem, norms, or all but the head of the sky.
        self._with_frozen_norms: list[nn.Module] = []
        if config.with_frozen_stem and matcher.encoder is not None:
            matcher.encoder.freeze_early()
            self._with_frozen_norms.append(matcher.encoder)
        if config.with_frozen_norms:
            self._with_frozen_norms.append(matcher)
        self._only_trained = matcher.sky if config.sky_alone else None
        if self._only_trained is not None:
            matcher.requires_grad_(False)
            self._only_trained.requires_grad_(True)
        self._set_train_mode()

        groups: list[dict[str, Any]]
        if self._only_trained is None and matcher.encoder is not None:
            groups = _group_parameters(matcher, matcher.encoder, config.encoder_rate)
        else:
            groups = [{"params": [p for p in matcher.parameters() if p.requires_grad]}]
        self.optimizers = {"matcher": (make_adam(groups, config.adam), config.adam)}

    def _set_train_mode(self) -> None:
        """Set the matcher to train mode, except for norms and parts that stay as they are."""
        self.matcher.train()
        for module in self._with_frozen_norms:
            _freeze_norm_statistics(module)
        if self._only_trained is not None:
            for part in self.matcher.children():
                part.train(part is self._only_trained)

    def step(self, batch: TrainingPair) -> Iterator[Update]:
        """Match a batch, and yield the one update of the matcher, by ``losses.stereo_loss``."""
        max_disparity_px = self.matcher.config.max_disparity_px
        left = normalise(batch.left)
        right = normalise(batch.right)
        heads_px, sky = self.matcher.forward_with_sky(left, right)
        heads_px = tuple(head_px.float() for head_px in heads_px)
        if sky is not None:
            sky = sky.float()
        loss = losses.stereo_loss(
            heads_px, sky, batch.left_px, max_disparity_px, self.config.sky_weight
        )
        facts = {"epe": _end_point_error(heads_px[-1], batch.left_px, max_disparity_px)}
        if loss.sky is not None:
            facts["sky"] = loss.sky.detach()
        yield Update("matcher", loss.total, facts)

    def validate(self) -> ValidationResult:
        """Match held-out pairs, and measure them by ``validate_pairs``."""
        if self.held_out is None:
            return ValidationResult()
        self.matcher.eval()
        result = validate_pairs(self.matcher, self.held_out)
        self._set_train_mode()
        return result


def _end_point_error(
    predicted_px: Maps, truth_px: Maps, max_disparity_px: int
) -> Float[Tensor, ""]:
    """Average the absolute error [px] over pixels with truth, without a gradient.

    It is 0 where no pixel has truth. Truth from ``max_disparity_px`` on does not count.
    """
    is_valid = (truth_px > 0) & (truth_px < max_disparity_px)
    error_px = (predicted_px.detach() - truth_px.nan_to_num(0.0)).abs()
    return error_px.where(is_valid, 0.0).sum() / is_valid.sum().clamp(min=1)


@torch.no_grad()
def validate_pairs(
    matcher: StereoNetwork, held_out: TrainingPairs, generator: synthesis.Generator | None = None
) -> ValidationResult:
    """Measure a matcher in eval mode on held-out pairs.

    Args:
        matcher: the network.
        held_out: the pairs.
        generator: synthesises the right views, in place of the real ones.

    Returns:
        Means over pairs: end-point error [px] and share of bad pixels; of a matcher that recognises
        the sky, shares of the sky that is missed and of the rest that is taken for sky. Pixels
        taken for sky have a disparity of 0. The picture is of the first pair.
    """
    # The metrics of each pair, by name; those of the sky may have none.
    errors: dict[str, list[float]] = {"epe_px": [], "d1": []}
    sky_shares: dict[str, list[float]] = {"sky_missed": [], "sky_false": []}
    pictures: dict[str, Tensor] = {}
    device = next(matcher.parameters()).device
    for index in range(len(held_out)):
        pair = held_out.read(index)
        right = pair.right
        if generator is not None:
            right = synthesis.draw_right(generator, pair.left[None].to(device))[0].cpu()
        predicted_px, is_sky = _match(matcher, pair.left, right)
        if is_sky is not None:
            predicted_px = torch.where(is_sky, 0.0, predicted_px)
        if index == 0:
            views = [pair.left, right, draw_disparity(predicted_px)]
            pictures["left_right_disparity"] = torch.cat(views, 1)

        is_true_sky = pair.left_px == 0
        has_truth = (pair.left_px > 0) & (pair.left_px < matcher.config.max_disparity_px)
        if is_sky is not None and bool(is_true_sky.any()):
            sky_shares["sky_missed"].append(float((~is_sky[is_true_sky]).float().mean()))
        if is_sky is not None and bool(has_truth.any()):
            sky_shares["sky_false"].append(float(is_sky[has_truth].float().mean()))
        if bool(has_truth.any()):
            metrics = measure("disparity", predicted_px[has_truth], pair.left_px[has_truth])
            errors["epe_px"].append(metrics["epe_px"])
            errors["d1"].append(metrics["d1_all"])

    values_of = errors | {name: shares for name, shares in sky_shares.items() if shares}
    means = {
        f"held_out/{name}": sum(values) / max(len(values), 1) for name, values in values_of.items()
    }
    return ValidationResult(numbers=means, pictures=pictures)


def _match(matcher: StereoNetwork, left: View, right: View) -> tuple[Map, Mask | None]:
    """Match one pair of any size: disparity of the left view [px], and its sky where recognised."""
    device = next(matcher.parameters()).device
    padded_left = pad_top_right(normalise(left.to(device)), matcher.config)
    padded_right = pad_top_right(normalise(right.to(device)), matcher.config)
    heads_px, sky = matcher.forward_with_sky(padded_left[None], padded_right[None])

    # Without the padding, which is at the top and on the right.
    height, width = left.shape[-2:]
    disparity_px = heads_px[-1][0, -height:, :width].float().cpu()
    is_sky = None if sky is None else sky[0, -height:, :width].cpu() > 0.5
    return disparity_px, is_sky


class ViewTask:
    """Trains the U-Net generator as pix2pix does: adversarial loss + ``l1_weight`` L1 (eq. 2.3)."""

    def __init__(
        self,
        generator: synthesis.UNetGenerator,
        config: ViewTraining,
        held_out: TrainingPairs | None,
    ) -> None:
        self.config = config
        self.held_out = held_out
        self.generator = generator.train()
        self.modules: dict[str, nn.Module] = {"generator": generator}
        adam = config.generator_adam
        self.optimizers = {"generator": (make_adam(generator.parameters(), adam), adam)}
        if config.discriminator != "none":
            discriminator = synthesis.Discriminator(
                config.discriminator, config.discriminator_width
            )
            self.modules["discriminator"] = discriminator.train()
            discriminator_adam = config.discriminator_adam
            optimizer = make_adam(discriminator.parameters(), discriminator_adam)
            self.optimizers["discriminator"] = (optimizer, discriminator_adam)

    def step(self, batch: TrainingPair) -> Iterator[Update]:
        """Synthesise right views; yield the update of the discriminator, then of the generator.

        The discriminator scores the views anew after its update. Without one, the generator's is
        the only update, by L1 alone.
        """
        left = 2 * batch.left - 1  # from [0, 1] to [-1, 1]
        right = 2 * batch.right - 1
        drawn = self.generator(left)
        l1 = (drawn - right).abs().mean()  # eq. 2.5
        if self.config.discriminator == "none":
            yield Update("generator", self.config.l1_weight * l1, {"l1": l1.detach()})
            return

        discriminator = self.modules["discriminator"]
        mode = self.config.gan_mode
        real_scores = discriminator(left, right)
        fake_scores = discriminator(left, drawn.detach())
        real_loss = losses.adversarial_loss(real_scores, mode, is_real=True)
        fake_loss = losses.adversarial_loss(fake_scores, mode, is_real=False)
        # Half the sum of both slows the discriminator (pix2pix).
        yield Update("discriminator", (real_loss + fake_loss) / 2, {})

        adversarial = losses.adversarial_loss(discriminator(left, drawn), mode, is_real=True)
        loss = adversarial + self.config.l1_weight * l1
        yield Update("generator", loss, {"l1": l1.detach(), "adversarial": adversarial.detach()})

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Synthesise held-out right views: mean L1 and PSNR [dB], and a picture of the first."""
        if self.held_out is None:
            return ValidationResult()
        self.generator.eval()
        device = next(self.generator.parameters()).device
        l1: list[float] = []
        psnr_db: list[float] = []
        pictures: dict[str, Tensor] = {}
        for index in range(len(self.held_out)):
            pair = self.held_out.read(index)
            drawn = synthesis.draw_right(self.generator, pair.left[None].to(device))[0].cpu()
            difference = drawn - pair.right
            l1.append(float(difference.abs().mean()))
            psnr_db.append(float(-10 * torch.log10(difference.square().mean())))
            if index == 0:
                pictures["left_right_drawn"] = torch.cat([pair.left, pair.right, drawn], 1)
        self.generator.train()
        numbers = {
            "held_out/l1": sum(l1) / len(l1),
            "held_out/psnr": sum(psnr_db) / len(psnr_db),
        }
        return ValidationResult(numbers=numbers, pictures=pictures)


class FinetuneTask:
    """Trains the generator by the smooth L1 of the matcher's disparity (thesis, 2.5.3).

    The matcher keeps its weights and its batch norm statistics: it stays in eval mode.
    """

    def __init__(
        self,
        generator: synthesis.Generator,
        matcher: StereoNetwork,
        config: FinetuneTraining,
        held_out: TrainingPairs | None,
    ) -> None:
        self.config = config
        self.held_out = held_out
        self.generator = generator.train()
        self.matcher = matcher.eval().requires_grad_(False)
        self.modules: dict[str, nn.Module] = {"generator": generator, "matcher": matcher}
        self.optimizers = {
            "generator": (make_adam(generator.parameters(), config.adam), config.adam)
        }

    def step(self, batch: TrainingPair) -> Iterator[Update]:
        """Synthesise right views and match them; yield the one update of the generator."""
        drawn = synthesis.draw_right(self.generator, batch.left)
        (predicted_px,) = self.matcher(normalise(batch.left), normalise(drawn))
        predicted_px = predicted_px.float()
        max_disparity_px = self.matcher.config.max_disparity_px
        disparity_loss = losses.disparity_loss(predicted_px, batch.left_px, max_disparity_px)
        l1 = (2 * drawn - 2 * batch.right).abs().mean()  # of images in [-1, 1]
        epe = _end_point_error(predicted_px, batch.left_px, max_disparity_px)
        facts = {"epe": epe, "l1": l1.detach()}
        yield Update("generator", disparity_loss + self.config.l1_weight * l1, facts)

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Match held-out left images with synthesised views (``validate_pairs``)."""
        if self.held_out is None:
            return ValidationResult()
        self.generator.eval()
        result = validate_pairs(self.matcher, self.held_out, self.generator)
        self.generator.train()
        return result


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
        generator = sample_generator(sample_index, self.seed + 1)
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
        generator: synthesis.SelectionGenerator,
        config: SelectTraining,
        held_out: TrainingPairs | None,
    ) -> None:
        self.config = config
        self.held_out = held_out
        self.generator = generator
        if config.with_frozen_stem:
            generator.encoder.freeze_early()
        self.modules: dict[str, nn.Module] = {"generator": generator}
        self._set_train_mode()
        groups = _group_parameters(generator, generator.encoder, config.encoder_rate)
        self.optimizers = {"generator": (make_adam(groups, config.adam), config.adam)}

    def _set_train_mode(self) -> None:
        """Set the generator to train mode, except for the encoder's norms if its stem is frozen."""
        self.generator.train()
        if self.config.with_frozen_stem:
            _freeze_norm_statistics(self.generator.encoder)

    def step(self, batch: SelectionSample) -> Iterator[Update]:
        """Estimate disparities and synthesise right views; yield the generator's one update."""
        left_logits, right_logits = self.generator(batch.degraded)
        left_loss = self._disparity_loss(left_logits, batch.left_px)
        right_loss = self._disparity_loss(right_logits, batch.right_px)
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

    def _disparity_loss(
        self, logits: Float[Tensor, "b k rows columns"], truth_px: Maps
    ) -> Float[Tensor, ""]:
        """Compute the loss of one view's disparity, and of its classes where they have a weight."""
        # The disparity that the logits mean, at the size of the truth.
        planes = self.generator.planes
        half_log_px, _, _ = synthesis.read_logits(logits, planes)
        size = truth_px.shape[1:]
        log_px = F.interpolate(half_log_px[:, None], size, mode="bilinear", align_corners=False)
        disparity_loss = losses.GENERATOR_DISPARITY_LOSSES[self.config.disparity_loss]
        loss = disparity_loss(log_px[:, 0], truth_px, self.generator.config.disparity_px)
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
        # The metrics of each pair, by name.
        values_of: dict[str, list[float]] = {"abs_rel": [], "d1": [], "sky_missed": []}
        pictures: dict[str, Tensor] = {}
        for index in range(len(self.held_out)):
            pair = self.held_out.read(index)
            drawn = synthesiser.draw(pair.left[None])
            assert drawn.disparity_px is not None
            assert drawn.is_sky is not None
            is_sky = drawn.is_sky[0]
            predicted_px = drawn.disparity_px[0].where(~is_sky, 0.0).clamp(min=far_px)
            if index == 0:
                views = [pair.left, pair.right, drawn.right[0], draw_disparity(predicted_px)]
                pictures["left_right_drawn_disparity"] = torch.cat(views, 1)

            has_truth = pair.left_px >= far_px
            if bool(has_truth.any()):
                metrics = {"abs_rel": math.nan, "d1": math.nan}  # of a network that diverged
                if bool(predicted_px.isfinite().all()):
                    # 1 / disparity is depth in another unit, on which these metrics do not depend.
                    true_depth = 1 / pair.left_px[has_truth]
                    metrics = measure("depth", 1 / predicted_px[has_truth], true_depth)
                values_of["abs_rel"].append(metrics["abs_rel"])
                values_of["d1"].append(metrics["d1"])
            is_true_sky = pair.left_px == 0
            if bool(is_true_sky.any()):
                values_of["sky_missed"].append(float((~is_sky[is_true_sky]).float().mean()))
        self._set_train_mode()
        means = {
            f"held_out/{name}": sum(values) / len(values)
            for name, values in values_of.items()
            if values
        }
        return ValidationResult(numbers=means, pictures=pictures)
