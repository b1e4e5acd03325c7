"""The stages of a training as tasks of one loop: what a step learns, and what is validated.

Those of the thesis are a generator against a discriminator, the matcher, and one through the other.
The generator that selects learns from pairs and single images, synthetic and real, mixed.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

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
from depthpose.depth.types import Maps


class StereoTask:
    """Smooth L1 on all heads (eq. 2.6)."""

    def __init__(
        self, matcher: StereoNetwork, config: StereoTraining, held_out: TrainingPairs | None
    ) -> None:
        self.config = config
        self.held_out = held_out
        self.matcher = matcher
        # What stays as it is: norms, or all but the head of the sky.
        self._with_fixed_norms: list[nn.Module] = []
        if config.with_frozen_stem and matcher.encoder is not None:
            matcher.encoder.freeze_early()
            self._with_fixed_norms.append(matcher.encoder)
        if config.with_frozen_norms:
            self._with_fixed_norms.append(matcher)
        self._trained_alone = matcher.sky if config.sky_alone else None
        if self._trained_alone is not None:
            matcher.requires_grad_(False)
            self._trained_alone.requires_grad_(True)
        self._train()
        self.modules: dict[str, nn.Module] = {"matcher": matcher}

        # What is learnt; an encoder at a share of the learning rate.
        groups = [{"params": [p for p in matcher.parameters() if p.requires_grad]}]
        if self._trained_alone is None and matcher.encoder is not None:
            encoder_parameters = set(matcher.encoder.parameters())
            rest = [p for p in matcher.parameters() if p not in encoder_parameters]
            trained = [p for p in matcher.encoder.parameters() if p.requires_grad]
            groups = [{"params": trained, "rate": config.encoder_rate}, {"params": rest}]
        self.optimizers = {"matcher": (make_adam(groups, config.adam), config.adam)}

    def _train(self) -> None:
        """Set the matcher to training, but for norms and parts that stay as they are."""
        self.matcher.train()
        # Batch norm uses its stored statistics, whatever the mode: small batches spoil them.
        for module in self._with_fixed_norms:
            for part in module.modules():
                if isinstance(part, nn.BatchNorm2d | nn.BatchNorm3d):
                    part.eval()
        if self._trained_alone is not None:
            for part in self.matcher.children():
                part.train(part is self._trained_alone)

    def step(self, batch: TrainingPair) -> Iterator[Update]:
        """One update: match and compare."""
        views = normalise(batch.left), normalise(batch.right)
        heads, sky = self.matcher.forward_with_sky(*views)
        max_disparity_px = self.matcher.config.max_disparity_px
        sky_weight = self.config.sky_weight
        heads = tuple(head.float() for head in heads)
        is_valid = (batch.left_px > 0) & (batch.left_px < max_disparity_px)
        error_px = (heads[-1].detach() - batch.left_px.nan_to_num(0.0)).abs()
        facts = {"epe": error_px.where(is_valid, 0.0).sum() / is_valid.sum().clamp(min=1)}
        if sky is None:
            loss = losses.heads_loss(heads, batch.left_px, max_disparity_px, sky_weight=sky_weight)
        else:
            error = losses.sky_loss(sky.float(), batch.left_px)
            loss = losses.heads_loss(heads, batch.left_px, max_disparity_px) + sky_weight * error
            facts["sky"] = error.detach()
        yield Update("matcher", loss, facts)

    def validate(self) -> ValidationResult:
        """Match held-out pairs: mean error and the share of bad pixels; the first as a picture."""
        if self.held_out is None:
            return ValidationResult()
        self.matcher.eval()
        result = validate_pairs(self.matcher, self.held_out)
        self._train()
        return result


@torch.no_grad()
def validate_pairs(
    matcher: StereoNetwork, held_out: TrainingPairs, generator: synthesis.Generator | None = None
) -> ValidationResult:
    """Measure a matcher on held-out pairs, or on right views that a generator draws.

    What is taken for sky has a disparity of 0. The numbers are means over pairs: end-point error
    [px], share of bad pixels, and shares of the sky that is missed and of the rest taken for sky.
    """
    errors: list[float] = []
    bad_shares: list[float] = []
    missed_shares: list[float] = []
    false_shares: list[float] = []
    pictures = {}
    device = next(matcher.parameters()).device
    for index in range(len(held_out)):
        pair = held_out.read(index)
        right = pair.right
        if generator is not None:
            right = synthesis.draw_right(generator, pair.left[None].to(device))[0].cpu()
        views = (normalise(view.to(device)) for view in (pair.left, right))
        heads, sky = matcher.forward_with_sky(
            *(pad_top_right(v, matcher.config)[None] for v in views)
        )
        height, width = pair.left.shape[-2:]
        predicted_px = heads[-1][0, -height:, :width].float().cpu()
        is_sky = None if sky is None else sky[0, -height:, :width].cpu() > 0.5
        is_known = (pair.left_px > 0) & (pair.left_px < matcher.config.max_disparity_px)
        is_true_sky = pair.left_px == 0
        if is_sky is not None:
            predicted_px = torch.where(is_sky, 0.0, predicted_px)
            if bool(is_true_sky.any()):
                missed_shares.append(float((~is_sky[is_true_sky]).float().mean()))
            if bool(is_known.any()):
                false_shares.append(float(is_sky[is_known].float().mean()))
        if index == 0:
            views = [pair.left, right, draw_disparity(predicted_px)]
            pictures["left_right_disparity"] = torch.cat(views, 1)
        if not bool(is_known.any()):
            continue
        metrics = measure("disparity", predicted_px[is_known], pair.left_px[is_known])
        errors.append(metrics["epe_px"])
        bad_shares.append(metrics["d1_all"])
    by_name = {"epe_px": errors, "d1": bad_shares}
    sky_shares = {"sky_missed": missed_shares, "sky_false": false_shares}
    by_name |= {name: shares for name, shares in sky_shares.items() if shares}
    numbers = {
        f"held_out/{name}": sum(values) / max(len(values), 1) for name, values in by_name.items()
    }
    return ValidationResult(numbers=numbers, pictures=pictures)


class ViewTask:
    """cGAN + lambda L1 (eq. 2.3): the discriminator's update, then the generator's."""

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
            adam = config.discriminator_adam
            self.optimizers["discriminator"] = (make_adam(discriminator.parameters(), adam), adam)

    def step(self, batch: TrainingPair) -> Iterator[Update]:
        """Draw once; the discriminator learns from it, then scores it anew."""
        left = 2 * batch.left - 1
        right = 2 * batch.right - 1
        drawn = self.generator(left)
        l1 = (drawn - right).abs().mean()  # eq. 2.5
        if self.config.discriminator == "none":
            yield Update("generator", self.config.l1_weight * l1, {"l1": l1.detach()})
            return
        discriminator = self.modules["discriminator"]
        mode = self.config.gan_mode
        real = losses.adversarial_loss(discriminator(left, right), mode, is_real=True)
        fake = discriminator(left, drawn.detach())
        # Half the sum of both slows the discriminator (pix2pix).
        d_loss = (real + losses.adversarial_loss(fake, mode, is_real=False)) / 2
        yield Update("discriminator", d_loss, {})
        adversarial = losses.adversarial_loss(discriminator(left, drawn), mode, is_real=True)
        loss = adversarial + self.config.l1_weight * l1
        yield Update("generator", loss, {"l1": l1.detach(), "adversarial": adversarial.detach()})

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Draw held-out right views: L1 and PSNR, and the first as a picture."""
        if self.held_out is None:
            return ValidationResult()
        self.generator.eval()
        errors = []
        squares = []
        pictures = {}
        for index in range(len(self.held_out)):
            pair = self.held_out.read(index)
            device = next(self.generator.parameters()).device
            drawn = synthesis.draw_right(self.generator, pair.left[None].to(device))[0].cpu()
            errors.append(float((drawn - pair.right).abs().mean()))
            squares.append(float((drawn - pair.right).square().mean()))
            if index == 0:
                pictures["left_right_drawn"] = torch.cat([pair.left, pair.right, drawn], 1)
        self.generator.train()
        mean = sum(errors) / len(errors)
        psnr = sum(-10 * torch.log10(torch.tensor(s)).item() for s in squares) / len(squares)
        return ValidationResult(
            numbers={"held_out/l1": mean, "held_out/psnr": psnr}, pictures=pictures
        )


class FinetuneTask:
    """Smooth L1 of the final disparity map moves the generator alone (thesis, 2.5.3).

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
        """One update: draw, match, compare with the truth."""
        drawn = synthesis.draw_right(self.generator, batch.left)
        (predicted_px,) = self.matcher(normalise(batch.left), normalise(drawn))
        max_disparity_px = self.matcher.config.max_disparity_px
        predicted_px = predicted_px.float()
        loss = losses.disparity_loss(predicted_px, batch.left_px, max_disparity_px)
        l1 = (2 * drawn - 2 * batch.right).abs().mean()
        is_valid = (batch.left_px > 0) & (batch.left_px < max_disparity_px)
        error_px = (predicted_px.detach() - batch.left_px.nan_to_num(0.0)).abs()
        epe = error_px.where(is_valid, 0.0).sum() / is_valid.sum().clamp(min=1)
        facts = {"epe": epe, "l1": l1.detach()}
        yield Update("generator", loss + self.config.l1_weight * l1, facts)

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Depth of held-out left images; the first drawn view as a picture."""
        if self.held_out is None:
            return ValidationResult()
        self.generator.eval()
        result = validate_pairs(self.matcher, self.held_out, self.generator)
        self.generator.train()
        return result


class SelectionSample(NamedTuple):
    """What one step of the selecting generator sees; disparity is NaN if unknown, 0 in the sky."""

    observed: Float[Tensor, "*b 3 h w"]  # the left image as a camera may deliver it: the input
    left: Float[Tensor, "*b 3 h w"]  # the left image itself, which the right view is drawn from
    right: Float[Tensor, "*b 3 h w"]
    left_px: Float[Tensor, "*b h w"]
    right_px: Float[Tensor, "*b h w"]
    has_right: Bool[Tensor, "*b"]  # whether there is a right image; else ``right`` is the left one


class SelectionSamples:
    """Samples by index: a share of the indices draws from the second source, evenly spread.

    The first source sets the length of an epoch; ``config`` changes the input alone.
    ``truths`` says which kind of truth each source gives.
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
        """Make the sample of an index, from the second source wherever its share is full again."""
        from_second = int(sample_index * self.more_share)  # of the samples before
        is_of_second = int((sample_index + 1) * self.more_share) > from_second
        if is_of_second:
            pair = self.sources[1][from_second]
        else:
            pair = self.sources[0][sample_index - from_second]
        # Where one image stands for both views, the right one's truth follows from the left one's.
        has_right = not torch.equal(pair.left, pair.right)
        right_px = pair.right_px if has_right else right_disparity_from_left(pair.left_px)
        generator = sample_generator(sample_index, self.seed + 1)
        return SelectionSample(
            observed=degrade(pair.left, self.config, generator),
            left=pair.left,
            right=pair.right,
            left_px=pair.left_px,
            right_px=right_px,
            has_right=torch.tensor(has_right),
        )


_CAP_M = 80.0
"""Truth beyond this does not count, and no estimate lies beyond it, as in Eigen's protocol."""


class SelectTask:
    """Relative error and cross entropy of both views' disparity, L1 of the drawn right view."""

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
        self._train()
        # What is trained, the encoder apart, at a share of the learning rate.
        encoder_parameters = set(generator.encoder.parameters())
        rest = [p for p in generator.parameters() if p not in encoder_parameters]
        trained = [p for p in generator.encoder.parameters() if p.requires_grad]
        groups = [{"params": trained, "rate": config.encoder_rate}, {"params": rest}]
        self.optimizers = {"generator": (make_adam(groups, config.adam), config.adam)}

    def _train(self) -> None:
        """Set the generator to training, but for the norms of a frozen stem."""
        self.generator.train()
        if self.config.with_frozen_stem:
            # Batch norm uses its stored statistics, whatever the mode: small batches spoil them.
            for part in self.generator.encoder.modules():
                if isinstance(part, nn.BatchNorm2d):
                    part.eval()

    def step(self, batch: SelectionSample) -> Iterator[Update]:
        """One update: predict disparity, warp the right view, compare."""
        planes = self.generator.planes
        left, right = self.generator(batch.observed)
        left_loss = self._truth_loss(left, batch.left_px)
        right_loss = self._truth_loss(right, batch.right_px)
        loss = left_loss + self.config.right_share * right_loss
        facts = {"left": left_loss.detach(), "right": right_loss.detach()}
        if self.config.view_weight:
            small = [F.avg_pool2d(view, 2) for view in (batch.left, batch.right)]
            drawn = synthesis.mix_shifts(small[0], right.float(), planes / 2)
            views = losses.view_loss(drawn, small[1])
            view = (views * batch.has_right).sum() / batch.has_right.sum().clamp(min=1)
            loss = loss + self.config.view_weight * view
            facts["view"] = view.detach()
        yield Update("generator", loss, facts)

    def _truth_loss(
        self, logits: Float[Tensor, "b k rows columns"], truth_px: Maps
    ) -> Float[Tensor, ""]:
        """Losses of the disparity of one view."""
        planes = self.generator.planes
        range_px = self.generator.config.disparity_px
        log_px = synthesis.read_logits(logits, planes)[0][:, None]
        log_px = F.interpolate(log_px, truth_px.shape[1:], mode="bilinear", align_corners=False)
        disparity_loss = losses.GENERATOR_DISPARITY_LOSSES[self.config.disparity_loss]
        loss = disparity_loss(log_px[:, 0], truth_px, range_px)
        if not self.config.plane_weight:
            return loss
        # The nearest point of the four pixels that a logit stands for; unknown is -1.
        coarse = F.max_pool2d(truth_px.nan_to_num(-1.0)[:, None], 2)[:, 0]
        coarse = torch.where(coarse < 0, torch.nan, coarse)
        return loss + self.config.plane_weight * losses.plane_loss(logits, coarse, planes)

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Relative error of held-out left images, share within 25 % (d1), share of missed sky."""
        if self.held_out is None:
            return ValidationResult()
        self.generator.eval()
        device = next(self.generator.parameters()).device
        rig = self.generator.config
        synthesiser = synthesis.SelectionSynthesiser(self.generator, device)
        far_px = rig.virtual_focal_px * rig.virtual_baseline_m / _CAP_M
        errors = []
        within = []
        missed = []
        pictures = {}
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
            is_known = pair.left_px >= far_px
            is_true_sky = pair.left_px == 0
            if bool(is_known.any()):
                metrics = {"abs_rel": math.nan, "d1": math.nan}  # of a network that diverged
                if bool(predicted_px.isfinite().all()):
                    # Of depth without its unit, which these do not depend on.
                    metrics = measure(
                        "depth", 1 / predicted_px[is_known], 1 / pair.left_px[is_known]
                    )
                errors.append(metrics["abs_rel"])
                within.append(metrics["d1"])
            if bool(is_true_sky.any()):
                missed.append(float((~is_sky[is_true_sky]).float().mean()))
        self._train()
        numbers = {"abs_rel": errors, "d1": within, "sky_missed": missed}
        means = {f"held_out/{k}": sum(v) / len(v) for k, v in numbers.items() if v}
        return ValidationResult(numbers=means, pictures=pictures)
