"""What a room hands to the loop, and the tickets that name its samples."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.loop.config import AdamConfig


class Turn(NamedTuple):
    """One optimiser's turn in a step: the loss that it follows, and facts for the log."""

    optimizer: str
    loss: Float[Tensor, ""]
    facts: Mapping[str, Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """What a look at held-out samples found.

    Attributes:
        numbers: metrics by name.
        pictures: images by name.
    """

    numbers: Mapping[str, float] = field(default_factory=dict)
    pictures: Mapping[str, Float[Tensor, "3 _ _"]] = field(default_factory=dict)


@runtime_checkable
class Task(Protocol):
    """What is trained. The loop knows no network."""

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Networks by name; all of them are saved and resumed."""
        ...

    @property
    def optimizers(self) -> Mapping[str, tuple[torch.optim.Optimizer, AdamConfig]]:
        """Optimisers with their knobs; a parameter belongs to one of them at most."""
        ...

    def step(self, batch: Any) -> Iterator[Turn]:  # noqa: ANN401 - the task's own batch
        """Yield one turn after the other; the optimiser has moved before the next is asked for.

        An adversarial task yields the discriminator's turn, then the generator's, whose loss then
        sees the discriminator that has just learnt.
        """
        ...

    def validate(self) -> Evidence:
        """Look at held-out samples; the networks' mode is the task's to set and restore."""
        ...


@runtime_checkable
class Samples(Protocol):
    """Training samples by ticket: the number of a sample in the whole training.

    What ticket n gives depends on n alone, so that any process can make it at any time: this is
    what makes order, resuming and many processes one and the same thing.

    Where samples differ in size, a method ``collate`` (a list of samples to a batch) may stand
    beside these two.
    """

    def __len__(self) -> int:
        """Tickets of one epoch."""
        ...

    def __getitem__(self, ticket: int, /) -> Any:  # noqa: ANN401 - a tuple of tensors of the room's own
        """Make the sample of a ticket."""
        ...


def shuffled_index(ticket: int, count: int, seed: int) -> int:
    """Index of the sample that a ticket draws: each epoch is a shuffle of its own."""
    epoch, position = divmod(ticket, count)
    order = torch.randperm(count, generator=_generator(seed, epoch, 1))
    return int(order[position])


def ticket_generator(ticket: int, seed: int) -> torch.Generator:
    """Random numbers for the augmentation of one ticket."""
    return _generator(seed, ticket, 2)


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
