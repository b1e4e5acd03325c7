"""Samples of the generator that selects: pairs and single images, synthetic and real, mixed."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.loop import ticket_generator
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import DegradeConfig
from depthpose.depth.degrade import degrade
from depthpose.depth.disparity import right_disparity_from_left
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
    """Samples by ticket: a share of the tickets draws from the second source, evenly spread.

    Args:
        sources: the pairs that set the length of an epoch; and perhaps others, e.g. real ones
            beside synthetic ones.
        more_share: share of the tickets that draws from the others.
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

    def __getitem__(self, ticket: int) -> SelectionSample:
        """Make the sample of a ticket."""
        before, now = int(ticket * self.more_share), int((ticket + 1) * self.more_share)
        pair = self.sources[1][before] if now > before else self.sources[0][ticket - before]
        seen = degrade(pair.left, self.config, ticket_generator(ticket, self.seed + 1))
        return as_sample(pair, seen)


def as_sample(pair: TrainingPair, seen: Float[Tensor, "3 h w"]) -> SelectionSample:
    """Make a sample of a pair; one image that stands for both views has no right one."""
    left, right, left_px, right_px, _ = pair
    has_right = torch.tensor(not torch.equal(left, right))
    if not has_right:
        right_px = right_disparity_from_left(left_px)
    return SelectionSample(seen, left, right, left_px, right_px, has_right)
