"""Stage 3: depth teaches the generator through the frozen matcher."""

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from depthpose.core.loop import Evidence, Turn, make_adam
from depthpose.depth.augment import TrainingPair
from depthpose.depth.losses import disparity_loss, l1_loss
from depthpose.depth.stereo import PSMNet
from depthpose.depth.stereo.psmnet_matcher import normalise
from depthpose.depth.synthesis import Generator
from depthpose.depth.synthesis.synthesiser import draw_right
from depthpose.depth.train.config import FinetuneTraining
from depthpose.depth.train.pairs import TrainingPairs
from depthpose.depth.train.stereo import held_out_evidence, mean_error_px


class FinetuneTask:
    """Smooth L1 of the final disparity map moves the generator alone (thesis, 2.5.3).

    The matcher keeps its weights and its batch norm statistics: it stays in eval mode.
    """

    def __init__(
        self,
        generator: Generator,
        matcher: PSMNet,
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

    def step(self, batch: TrainingPair) -> Iterator[Turn]:
        """One turn: draw, match, compare with the truth."""
        drawn = draw_right(self.generator, batch.left)
        (found_px,) = self.matcher(normalise(batch.left), normalise(drawn))
        reach = self.matcher.config.max_disparity_px
        found_px = found_px.float()
        loss = disparity_loss(found_px, batch.left_px, reach)
        l1 = l1_loss(2 * drawn, 2 * batch.right)
        facts = {"epe": mean_error_px(found_px, batch.left_px, reach), "l1": l1.detach()}
        yield Turn("generator", loss + self.config.l1_weight * l1, facts)

    @torch.no_grad()
    def validate(self) -> Evidence:
        """Depth of held-out left images; the first drawn view as a picture."""
        if self.held_out is None:
            return Evidence()
        self.generator.eval()
        device = next(self.generator.parameters()).device

        def draw(left: Tensor) -> Tensor:
            return draw_right(self.generator, left[None].to(device))[0].cpu()

        evidence = held_out_evidence(self.matcher, self.held_out, draw)
        self.generator.train()
        return evidence
