"""Stage 1: the generator against its discriminator."""

from collections.abc import Iterator

import torch
from torch import nn

from depthpose.core.loop import Evidence, Turn, make_adam
from depthpose.depth.augment import TrainingPair
from depthpose.depth.losses import adversarial_loss, discriminator_loss, l1_loss
from depthpose.depth.synthesis import UNetGenerator, make_discriminator
from depthpose.depth.synthesis.synthesiser import draw_right
from depthpose.depth.train.config import ViewTraining
from depthpose.depth.train.pairs import TrainingPairs


class ViewTask:
    """cGAN + lambda L1 (eq. 2.3): the discriminator's turn, then the generator's."""

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
            judge = make_discriminator(config.discriminator, config.discriminator_width)
            self.modules["discriminator"] = judge.train()
            self.optimizers["discriminator"] = (
                make_adam(judge.parameters(), config.discriminator_adam),
                config.discriminator_adam,
            )

    def step(self, batch: TrainingPair) -> Iterator[Turn]:
        """Draw once; the discriminator learns from it, then judges it anew."""
        left, right = 2 * batch.left - 1, 2 * batch.right - 1
        drawn = self.generator(left)
        l1 = l1_loss(drawn, right)
        if self.config.discriminator == "none":
            yield Turn("generator", self.config.l1_weight * l1, {"l1": l1.detach()})
            return
        judge, mode = self.modules["discriminator"], self.config.gan_mode
        judged = discriminator_loss(judge(left, right), judge(left, drawn.detach()), mode)
        yield Turn("discriminator", judged, {})
        fooled = adversarial_loss(judge(left, drawn), mode, is_real=True)
        loss = fooled + self.config.l1_weight * l1
        yield Turn("generator", loss, {"l1": l1.detach(), "adversarial": fooled.detach()})

    @torch.no_grad()
    def validate(self) -> Evidence:
        """Draw held-out right views: L1 and PSNR, and the first as a picture."""
        if self.held_out is None:
            return Evidence()
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
        return Evidence(numbers={"held_out/l1": mean, "held_out/psnr": psnr}, pictures=pictures)
