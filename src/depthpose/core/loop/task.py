"""What a training gives to the loop: a task, and samples by index."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.loop.config import AdamConfig


class Update(NamedTuple):
    """One optimiser's part of a step: the loss that it minimises, and numbers for the log."""

    optimizer: str
    loss: Float[Tensor, ""]
    facts: Mapping[str, Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class ValidationResult:
    """What a validation found.

    Attributes:
        numbers: metrics by name.
        pictures: images by name.
    """

    numbers: Mapping[str, float] = field(default_factory=dict)
    pictures: Mapping[str, Float[Tensor, "3 _ _"]] = field(default_factory=dict)


@runtime_checkable
class Task(Protocol):
    """What is trained."""

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Networks by name; all of them are saved and resumed."""
        ...

    @property
    def optimizers(self) -> Mapping[str, tuple[torch.optim.Optimizer, AdamConfig]]:
        """Optimisers with their settings; each parameter is in at most one of them."""
        ...

    def step(self, batch: Any) -> Iterator[Update]:  # noqa: ANN401 - the task's own batch
        """Yield one update after the other; each optimiser steps before the next is computed.

        An adversarial task yields the discriminator's update, then the generator's, whose loss then
        uses the updated discriminator.
        """
        ...

    def validate(self) -> ValidationResult:
        """Evaluate held-out samples; the task sets and restores the networks' mode."""
        ...


@runtime_checkable
class Samples(Protocol):
    """Training samples by their index in the whole training, over all epochs.

    Sample n depends on n alone, so any process can make it at any time: order, resuming and the
    number of processes change nothing.

    Where samples differ in size, there may be a method ``collate`` (a list of samples to a batch).
    """

    def __len__(self) -> int:
        """Samples of one epoch."""
        ...

    def __getitem__(self, sample_index: int, /) -> Any:  # noqa: ANN401 - a tuple of tensors
        """Make a sample."""
        ...


def shuffled_index(sample_index: int, count: int, seed: int) -> int:
    """Turn an index in the whole training into one of the data; each epoch is shuffled anew."""
    epoch, position = divmod(sample_index, count)
    order = torch.randperm(count, generator=_generator(seed, epoch, 1))
    return int(order[position])


def sample_generator(sample_index: int, seed: int) -> torch.Generator:
    """Random numbers for the augmentation of one sample."""
    return _generator(seed, sample_index, 2)


def mixed_seed(*numbers: int) -> int:
    """Mix numbers into one seed, so that neighbours have nothing in common (splitmix64)."""
    state = 0
    for number in numbers:
        state = (state + number + 0x9E3779B97F4A7C15) % 2**64
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) % 2**64
        state ^= state >> 31
    return state >> 1


def _generator(*numbers: int) -> torch.Generator:
    return torch.Generator().manual_seed(mixed_seed(*numbers))
