"""Samples of the generator that selects: pairs and single images, synthetic and real, mixed."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.loop import ticket_generator
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import DegradeConfig
from depthpose.depth.degrade import degrade
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
    """Samples by ticket: a share of the tickets draws from ``more``, evenly spread.

    Args:
        pairs: the pairs that set the length of an epoch.
        more: other pairs, e.g. real ones beside synthetic ones.
        more_share: share of the tickets that draws from ``more``.
        config: changes of the input alone.
        seed: decides the changes.
    """

    def __init__(
        self,
        pairs: TrainingPairs,
        more: TrainingPairs | None,
        more_share: float,
        config: DegradeConfig,
        seed: int,
    ) -> None:
        self.pairs, self.more, self.config, self.seed = pairs, more, config, seed
        self.more_share = 0.0 if more is None else more_share

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, ticket: int) -> SelectionSample:
        """Make the sample of a ticket."""
        before, now = int(ticket * self.more_share), int((ticket + 1) * self.more_share)
        if self.more is not None and now > before:
            pair = self.more[before]
        else:
            pair = self.pairs[ticket - before]
        seen = degrade(pair.left, self.config, ticket_generator(ticket, self.seed + 1))
        return as_sample(pair, seen)


def as_sample(pair: TrainingPair, seen: Float[Tensor, "3 h w"]) -> SelectionSample:
    """Make a sample of a pair; a right view that is not there is NaN."""
    has_right = ~pair.right.isnan().any()
    right = torch.where(has_right, pair.right, pair.left)
    return SelectionSample(seen, pair.left, right, pair.left_px, pair.right_px, has_right)
