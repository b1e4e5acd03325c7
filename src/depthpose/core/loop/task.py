"""What the training loop takes: its settings and those of Adam, a task, and samples by index."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.config import Seed, Settings
from depthpose.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class AdamConfig(Settings):
    """Adam (Kingma and Ba 2015), and its learning rate over the training."""

    learning_rate: Annotated[float, "(0, 1)"] = 1e-4
    """Step size at the start."""

    beta1: Annotated[float, "[0, 1)"] = 0.9
    """Decay of the mean of the gradient; 0.5 for adversarial training."""

    beta2: Annotated[float, "[0, 1)"] = 0.999
    """Decay of the mean of the squared gradient."""

    schedule: Literal["constant", "constant-linear", "halving", "cosine"] = "constant"
    """constant; constant-linear (second half falls to zero); halving; cosine (falls to zero)."""

    halvings: Annotated[int, "[1, inf)"] = 4
    """Equal parts of a training; ``halving`` halves after each but the last."""

    warmup_steps: Annotated[int, "[0, inf)"] = 0
    """Steps over which the rate rises linearly from zero."""

    weight_decay: Annotated[float, "[0, inf)"] = 0.0
    """Share of the weights that a step subtracts, times its learning rate (AdamW)."""

    def rate_at(self, step: int, steps: int) -> float:
        """Compute the learning rate of ``step`` (0, 1, ...) in a training of ``steps``."""
        progress = step / steps
        factors = {
            "constant": 1.0,
            "constant-linear": min(1.0, 2 * (1 - progress)),
            "halving": 0.5 ** math.floor(self.halvings * progress),
            "cosine": 0.5 * (1 + math.cos(math.pi * progress)),
        }
        warmup = min(1.0, (step + 1) / self.warmup_steps) if self.warmup_steps else 1.0
        return self.learning_rate * factors[self.schedule] * warmup


@dataclass(frozen=True, kw_only=True)
class LoopConfig(Settings):
    """The settings of the training loop: how a task is trained, and for how long."""

    INSTEAD: ClassVar[dict[str, str]] = {"steps": "epochs", "epochs": "steps"}
    """A config file that gives one of these removes the other's default."""

    steps: Annotated[int | None, "(0, inf)"] = None
    """Optimiser steps; or give ``epochs``."""

    epochs: Annotated[float | None, "(0, inf)"] = None
    """Passes over the data; or give ``steps``."""

    batch_size: Annotated[int, "(0, inf)"] = 4
    """Samples of a micro-batch, in each process."""

    accumulate: Annotated[int, "(0, inf)"] = 1
    """Micro-batches whose gradients are averaged before a step. The view stage holds the graphs of
    all of them until the discriminator has been updated."""

    precision: Literal["fp32", "bf16", "fp16"] = "fp32"
    """Precision of the forward pass; fp16 needs a GPU. A processor without bf16 takes fp32."""

    clip_norm: Annotated[float | None, "(0, inf)"] = None
    """Largest norm of an optimiser's gradient; None: as it is."""

    seed: Seed = 0
    """Decides order, augmentation and dropout; the initial weights are the task's."""

    save_every_steps: Annotated[int, "(0, inf)"] = 200
    """Steps between two saved states."""

    validate_every_steps: Annotated[int, "(0, inf)"] = 1000
    """Steps between two validations; there is always one after the last step."""

    log_every_steps: Annotated[int, "(0, inf)"] = 10
    """Steps averaged into one line of metrics."""

    workers: Annotated[int, "[0, inf)"] = 0
    """Processes that make samples; 0: the training process itself."""

    ema_decay: Annotated[float | None, "(0, 1)"] = None
    """Decay of the moving average of the weights, which is then what is exported; None: off. The
    first steps decay faster, so that the initial weights are soon forgotten."""

    device: Literal["auto", "cpu"] = "auto"
    """auto: the accelerator that ``accelerate`` finds; cpu: none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.steps is None) == (self.epochs is None):
            raise InputError(
                f"a training is as long as steps or epochs say: give one of the two, got "
                f"steps={self.steps}, epochs={self.epochs}"
            )

    def total_steps(self, samples: int, processes: int) -> int:
        """Compute the number of optimiser steps of a training.

        Args:
            samples: number of samples of an epoch.
            processes: number of processes that train together.
        """
        if self.steps is not None:
            return self.steps
        assert self.epochs is not None
        samples_a_step = self.batch_size * self.accumulate * processes
        return max(1, round(self.epochs * samples / samples_a_step))


@dataclass(frozen=True, kw_only=True)
class TrainingConfig(Settings):
    """What the configs of all trainings have."""

    WEIGHTS_SETTINGS: ClassVar[tuple[str, ...]] = ("start",)
    """Settings that may name weights to begin with, that of the trained network first."""

    loop: LoopConfig = LoopConfig(steps=10000)
    """Length, batches, seed and precision of the training."""

    @property
    def initial_weights(self) -> dict[str, str]:
        """The weights that the training begins with: setting to name or file."""
        names = {setting: getattr(self, setting) for setting in self.WEIGHTS_SETTINGS}
        return {setting: name for setting, name in names.items() if name}


def make_adam(
    parameters: Iterable[nn.Parameter] | list[dict[str, Any]], config: AdamConfig
) -> torch.optim.Adam:
    """Make the optimiser; the loop sets its learning rate before each step.

    Args:
        parameters: parameters, or groups of them. A group may have a ``rate``, the factor of its
            learning rate.
        config: settings of Adam.
    """
    kind = torch.optim.AdamW if config.weight_decay else torch.optim.Adam
    return kind(
        parameters,
        lr=config.learning_rate,
        betas=(config.beta1, config.beta2),
        weight_decay=config.weight_decay,
        fused=True,  # a quarter of the time of torch's other implementations, on a CPU too
    )


class Update(NamedTuple):
    """The part of a step that one optimiser takes."""

    optimizer: str  #: its name among the task's optimisers
    loss: Float[Tensor, ""]  #: what it minimises
    facts: Mapping[str, Tensor]  #: further numbers for the log, by name


@dataclass(frozen=True, kw_only=True, eq=False)
class ValidationResult:
    """The result of a validation."""

    numbers: Mapping[str, float] = field(default_factory=dict)  #: metrics by name
    pictures: Mapping[str, Float[Tensor, "3 _ _"]] = field(default_factory=dict)  #: images by name


@runtime_checkable
class Task(Protocol):
    """The networks that are trained, and the computation of their losses."""

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Return the networks by name; all of them are saved and resumed."""
        ...

    @property
    def optimizers(self) -> Mapping[str, tuple[torch.optim.Optimizer, AdamConfig]]:
        """Return the optimisers and their settings by name; a parameter is in one at most."""
        ...

    def step(self, batch: Any) -> Iterator[Update]:  # noqa: ANN401 - the task's own batch
        """Compute a step on a batch: yield the update of one optimiser after the other.

        Each optimiser steps before the next update is computed: an adversarial task yields the
        discriminator's update, then the generator's, whose loss uses the updated discriminator.
        """
        ...

    def validate(self) -> ValidationResult:
        """Evaluate held-out samples; the networks' mode (train or eval) is restored afterwards."""
        ...


@runtime_checkable
class Samples(Protocol):
    """Training samples by their index in the whole training, over all epochs.

    Sample n depends on n alone, and any process can make it at any time: so a resumed training, and
    one with more processes, sees the same samples.

    If samples differ in size, a method ``collate`` makes a batch of a list of samples.
    """

    def __len__(self) -> int:
        """Return the number of samples of an epoch."""
        ...

    def __getitem__(self, sample_index: int, /) -> Any:  # noqa: ANN401 - a tuple of tensors
        """Make the sample of an index, 0 or more; there is no upper limit."""
        ...


# Streams of random numbers that are independent of each other, by what they are for.
_ORDER_STREAM = 1
_SAMPLE_STREAM = 2


def shuffle_index(sample_index: int, count: int, seed: int) -> int:
    """Map an index in the whole training to one of ``count`` data, shuffled anew each epoch."""
    epoch, position = divmod(sample_index, count)
    order_seed = mix_seed(seed, epoch, _ORDER_STREAM)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(order_seed))
    return int(order[position])


def make_sample_generator(sample_index: int, seed: int) -> torch.Generator:
    """Make the generator of random numbers by which one sample is augmented."""
    return torch.Generator().manual_seed(mix_seed(seed, sample_index, _SAMPLE_STREAM))


def mix_seed(*numbers: int) -> int:
    """Mix numbers into one seed (splitmix64), so that similar numbers make unrelated seeds."""
    state = 0
    # Shifts and constants are those of splitmix64.
    for number in numbers:
        state = (state + number + 0x9E3779B97F4A7C15) % 2**64
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) % 2**64
        state ^= state >> 31
    return state >> 1  # 63 bits, as ``Seed`` allows
