"""The stages of the thesis: generator against discriminator, matcher, one through the other."""

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from depthpose.core.draw import draw_disparity
from depthpose.core.loop import Update, ValidationResult, make_adam
from depthpose.depth.augment import TrainingPair
from depthpose.depth.losses import (
    adversarial_loss,
    discriminator_loss,
    disparity_loss,
    heads_loss,
    l1_loss,
    sky_loss,
    valid_disparity,
)
from depthpose.depth.stereo import StereoNetwork, normalise
from depthpose.depth.stereo.network_matcher import pad_top_right
from depthpose.depth.synthesis import Generator, UNetGenerator, make_discriminator
from depthpose.depth.synthesis.synthesiser import draw_right
from depthpose.depth.train.config import FinetuneTraining, StereoTraining, ViewTraining
from depthpose.depth.train.pairs import TrainingPairs


class StereoTask:
    """Smooth L1 on all heads (eq. 2.6)."""

    def __init__(
        self,
        matcher: StereoNetwork,
        config: StereoTraining,
        held_out: TrainingPairs | None,
    ) -> None:
        self.config, self.held_out = config, held_out
        self.matcher = matcher
        self._fixed = matcher.encoder if config.with_frozen_stem else None
        if self._fixed is not None:
            self._fixed.freeze_early()
        self._alone = matcher.sky if config.sky_alone else None
        if self._alone is not None:
            matcher.requires_grad_(False)
            self._alone.requires_grad_(True)
        self._train()
        self.modules: dict[str, nn.Module] = {"matcher": matcher}
        self.optimizers = {"matcher": (make_adam(self._groups(), config.adam), config.adam)}

    def _groups(self) -> list[dict[str, object]]:
        if self._alone is not None or self.matcher.encoder is None:
            return [{"params": [p for p in self.matcher.parameters() if p.requires_grad]}]
        encoder = list(self.matcher.encoder.parameters())
        ours = set(encoder)
        rest = [p for p in self.matcher.parameters() if p not in ours]
        learnt = [p for p in encoder if p.requires_grad]
        return [{"params": learnt, "rate": self.config.encoder_rate}, {"params": rest}]

    def _train(self) -> None:
        self.matcher.train()
        if self._fixed is not None:
            self._fixed.keep_statistics()
        if self._alone is not None:
            for part in self.matcher.children():
                part.train(part is self._alone)

    def step(self, batch: TrainingPair) -> Iterator[Update]:
        """One update: match and compare."""
        views = normalise(batch.left), normalise(batch.right)
        heads, sky = self.matcher.forward_with_sky(*views)
        reach, sky_weight = self.matcher.config.max_disparity_px, self.config.sky_weight
        heads = tuple(head.float() for head in heads)
        facts = {"epe": mean_error_px(heads[-1], batch.left_px, reach)}
        if sky is None:
            loss = heads_loss(heads, batch.left_px, reach, sky_weight=sky_weight)
        else:
            error = sky_loss(sky.float(), batch.left_px)
            loss = heads_loss(heads, batch.left_px, reach) + sky_weight * error
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


def validate_pairs(
    matcher: StereoNetwork,
    held_out: TrainingPairs,
    draw: Callable[[Tensor], Tensor] | None = None,
) -> ValidationResult:
    """Disparity error of a matcher on held-out pairs, or on right views that ``draw`` draws.

    What is taken for sky has a disparity of 0.
    """
    errors, bad, missed, false, pictures = [], [], [], [], {}
    for index in range(len(held_out)):
        pair = held_out.read(index)
        right = pair.right if draw is None else draw(pair.left)
        found, is_sky = match_whole(matcher, pair.left, right)
        is_known = valid_disparity(pair.left_px[None], matcher.config.max_disparity_px)[0]
        is_true_sky = pair.left_px == 0
        if is_sky is not None:
            found = torch.where(is_sky, 0.0, found)
            if bool(is_true_sky.any()):
                missed.append(float((~is_sky[is_true_sky]).float().mean()))
            if bool(is_known.any()):
                false.append(float(is_sky[is_known].float().mean()))
        if index == 0:
            views = [pair.left, right, draw_disparity(found)]
            pictures["left_right_disparity"] = torch.cat(views, 1)
        if not bool(is_known.any()):
            continue
        error = (found - pair.left_px)[is_known].abs()
        errors.append(float(error.mean()))
        is_bad = (error > 3) & (error > 0.05 * pair.left_px[is_known])
        bad.append(float(is_bad.float().mean()))
    named = {"epe_px": errors, "d1": bad}
    named |= {name: v for name, v in (("sky_missed", missed), ("sky_false", false)) if v}
    numbers = {f"held_out/{name}": sum(v) / max(len(v), 1) for name, v in named.items()}
    return ValidationResult(numbers=numbers, pictures=pictures)


@torch.no_grad()
def match_whole(
    matcher: StereoNetwork,
    left: Float[Tensor, "3 h w"],
    right: Float[Tensor, "3 h w"],
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"] | None]:
    """Match one pair of any size with the network as it stands [px]; say where it sees the sky."""
    device = next(matcher.parameters()).device
    height, width = left.shape[-2:]
    padded = [pad_top_right(normalise(v.to(device)), matcher.config)[None] for v in (left, right)]
    heads, sky = matcher.forward_with_sky(*padded)
    found = heads[-1][0, -height:, :width].float().cpu()
    return found, None if sky is None else sky[0, -height:, :width].cpu() > 0.5


@torch.no_grad()
def mean_error_px(
    found_px: Float[Tensor, "b h w"], truth_px: Float[Tensor, "b h w"], max_px: int
) -> Float[Tensor, ""]:
    """Mean absolute disparity error over the pixels with truth [px]."""
    is_valid = valid_disparity(truth_px, max_px)
    error = torch.where(is_valid, (found_px - truth_px.nan_to_num(0.0)).abs(), 0.0)
    return error.sum() / is_valid.sum().clamp(min=1)


class ViewTask:
    """cGAN + lambda L1 (eq. 2.3): the discriminator's update, then the generator's."""

    def __init__(
        self, generator: UNetGenerator, config: ViewTraining, held_out: TrainingPairs | None
    ) -> None:
        self.config, self.held_out = config, held_out
        self.generator = generator.train()
        self.modules: dict[str, nn.Module] = {"generator": generator}
        self.optimizers = {
            "generator": (
                make_adam(generator.parameters(), config.generator_adam),
                config.generator_adam,
            )
        }
        if config.discriminator != "none":
            discriminator = make_discriminator(config.discriminator, config.discriminator_width)
            self.modules["discriminator"] = discriminator.train()
            self.optimizers["discriminator"] = (
                make_adam(discriminator.parameters(), config.discriminator_adam),
                config.discriminator_adam,
            )

    def step(self, batch: TrainingPair) -> Iterator[Update]:
        """Draw once; the discriminator learns from it, then scores it anew."""
        left, right = 2 * batch.left - 1, 2 * batch.right - 1
        drawn = self.generator(left)
        l1 = l1_loss(drawn, right)
        if self.config.discriminator == "none":
            yield Update("generator", self.config.l1_weight * l1, {"l1": l1.detach()})
            return
        discriminator, mode = self.modules["discriminator"], self.config.gan_mode
        d_loss = discriminator_loss(
            discriminator(left, right), discriminator(left, drawn.detach()), mode
        )
        yield Update("discriminator", d_loss, {})
        fooled = adversarial_loss(discriminator(left, drawn), mode, is_real=True)
        loss = fooled + self.config.l1_weight * l1
        yield Update("generator", loss, {"l1": l1.detach(), "adversarial": fooled.detach()})

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Draw held-out right views: L1 and PSNR, and the first as a picture."""
        if self.held_out is None:
            return ValidationResult()
        self.generator.eval()
        errors, squares, pictures = [], [], {}
        for index in range(len(self.held_out)):
            pair = self.held_out.read(index)
            device = next(self.generator.parameters()).device
            drawn = draw_right(self.generator, pair.left[None].to(device))[0].cpu()
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
        generator: Generator,
        matcher: StereoNetwork,
        config: FinetuneTraining,
        held_out: TrainingPairs | None,
    ) -> None:
        self.config, self.held_out = config, held_out
        self.generator = generator.train()
        self.matcher = matcher.eval().requires_grad_(False)
        self.modules: dict[str, nn.Module] = {"generator": generator, "matcher": matcher}
        self.optimizers = {
            "generator": (make_adam(generator.parameters(), config.adam), config.adam)
        }

    def step(self, batch: TrainingPair) -> Iterator[Update]:
        """One update: draw, match, compare with the truth."""
        drawn = draw_right(self.generator, batch.left)
        (found_px,) = self.matcher(normalise(batch.left), normalise(drawn))
        reach = self.matcher.config.max_disparity_px
        found_px = found_px.float()
        loss = disparity_loss(found_px, batch.left_px, reach)
        l1 = l1_loss(2 * drawn, 2 * batch.right)
        facts = {"epe": mean_error_px(found_px, batch.left_px, reach), "l1": l1.detach()}
        yield Update("generator", loss + self.config.l1_weight * l1, facts)

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Depth of held-out left images; the first drawn view as a picture."""
        if self.held_out is None:
            return ValidationResult()
        self.generator.eval()
        device = next(self.generator.parameters()).device

        def draw(left: Tensor) -> Tensor:
            return draw_right(self.generator, left[None].to(device))[0].cpu()

        result = validate_pairs(self.matcher, self.held_out, draw)
        self.generator.train()
        return result
