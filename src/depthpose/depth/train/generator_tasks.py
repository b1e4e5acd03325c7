"""The tasks that train a generator of right views: against a discriminator, and through a matcher.

They are stages 1 and 3 of the thesis (2.4.2, 2.5.3).
"""

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from depthpose.core.loop import Update, ValidationResult, make_adam
from depthpose.depth import generators, losses, synthesis
from depthpose.depth.augment import TrainingPair
from depthpose.depth.stereo import StereoNetwork, normalise
from depthpose.depth.train.config import FinetuneTraining, ViewTraining
from depthpose.depth.train.pairs import TrainingPairs
from depthpose.depth.train.stereo_task import end_point_error, validate_pairs


class ViewTask:
    """Trains the U-Net generator as pix2pix does: adversarial loss + ``l1_weight`` L1 (eq. 2.3)."""

    def __init__(
        self,
        generator: generators.UNetGenerator,
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
            discriminator = generators.Discriminator(
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
            drawn = synthesis.synthesise_right(self.generator, pair.left[None].to(device))[0].cpu()
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
        generator: generators.Generator,
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
        drawn = synthesis.synthesise_right(self.generator, batch.left)
        (predicted_px,) = self.matcher(normalise(batch.left), normalise(drawn))
        predicted_px = predicted_px.float()
        max_disparity_px = self.matcher.config.max_disparity_px
        disparity_loss = losses.disparity_loss(predicted_px, batch.left_px, max_disparity_px)
        l1 = (2 * drawn - 2 * batch.right).abs().mean()  # of images in [-1, 1]
        epe = end_point_error(predicted_px, batch.left_px, max_disparity_px)
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
