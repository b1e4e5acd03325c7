"""Settings of the loop and of Adam, and how a learning rate changes over a training."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import nn

from depthpose.core.config_values import check_settings
from depthpose.core.errors import InputError, refuse_seed

Schedule = Literal["constant", "constant-linear", "halving", "cosine"]


@dataclass(frozen=True, kw_only=True)
class AdamConfig:
    """Adam (Kingma and Ba 2015), and its learning rate over the training."""

    learning_rate: float = 1e-4
    """Step size at the start."""

    beta1: float = 0.9
    """Decay of the mean of the gradient; 0.5 for adversarial training."""

    beta2: float = 0.999
    """Decay of the mean of its square."""

    schedule: Schedule = "constant"
    """constant; constant-linear (second half falls to zero); halving; cosine (falls to zero)."""

    halvings: int = 4
    """Equal parts of a training; ``halving`` halves after each but the last."""

    warmup_steps: int = 0
    """Steps over which the rate rises linearly from zero."""

    weight_decay: float = 0.0
    """Share of the weights taken off at a rate of 1, apart from the gradient (AdamW)."""

    def __post_init__(self) -> None:
        """Refuse values that cannot train."""
        check_settings(
            self,
            learning_rate="(0, 1)",
            beta1="[0, 1)",
            beta2="[0, 1)",
            halvings="[1, inf)",
            warmup_steps="[0, inf)",
            weight_decay="[0, inf)",
        )

    def rate_at(self, step: int, steps: int) -> float:
        """Learning rate of ``step`` (0, 1, ...) in a training of ``steps``."""
        done = step / steps
        factors = {
            "constant": 1.0,
            "constant-linear": min(1.0, 2 * (1 - done)),
            "halving": 0.5 ** math.floor((self.halvings) * done),
            "cosine": 0.5 * (1 + math.cos(math.pi * done)),
        }
        warm = min(1.0, (step + 1) / self.warmup_steps) if self.warmup_steps else 1.0
        return self.learning_rate * factors[self.schedule] * warm


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """How a task is trained, and for how long."""

    INSTEAD: ClassVar[dict[str, str]] = {"steps": "epochs", "epochs": "steps"}
    """A config file that gives one of these removes the other's default."""

    steps: int | None = None
    """Optimiser steps; or give ``epochs``."""

    epochs: float | None = None
    """Passes over the data; or give ``steps``."""

    batch_size: int = 4
    """Samples of a micro-batch, in each process."""

    accumulate: int = 1
    """Micro-batches whose gradients are averaged before a step. The view stage holds the graphs of
    all of them until the discriminator has been updated."""

    precision: Literal["fp32", "bf16", "fp16"] = "fp32"
    """Arithmetic of the forward pass; fp16 needs a GPU. A processor without bf16 takes fp32."""

    clip_norm: float | None = None
    """Largest norm of an optimiser's gradient; None: as it is."""

    seed: int = 0
    """Decides order, augmentation and dropout; the initial weights are the task's."""

    save_every_steps: int = 200
    """Steps between two saved states."""

    validate_every_steps: int = 1000
    """Steps between two validations; there is always one after the last step."""

    log_every_steps: int = 10
    """Steps averaged into one line of metrics."""

    workers: int = 0
    """Processes that make samples; 0: the training process itself."""

    ema_decay: float | None = None
    """Decay of the moving average of the weights, which is then what is exported; None: off. The
    first steps decay faster, so that the initial weights are soon forgotten."""

    device: Literal["auto", "cpu"] = "auto"
    """auto: the accelerator that ``accelerate`` finds; cpu: none."""

    def __post_init__(self) -> None:
        """Refuse a loop that cannot run."""
        if (self.steps is None) == (self.epochs is None):
            raise InputError(
                f"a training is as long as steps or epochs say: give one of the two, got "
                f"steps={self.steps}, epochs={self.epochs}"
            )
        counts = ("steps", "epochs", "batch_size", "accumulate", "save_every_steps",
                  "validate_every_steps", "log_every_steps", "clip_norm")  # fmt: skip
        positive = dict.fromkeys(counts, "(0, inf)")
        check_settings(self, **positive, workers="[0, inf)", ema_decay="(0, 1)")
        refuse_seed(self.seed)

    def total_steps(self, samples: int, processes: int) -> int:
        """Number of optimiser steps for a dataset of ``samples`` on ``processes``."""
        if self.steps is not None:
            return self.steps
        assert self.epochs is not None
        return max(
            1, round(self.epochs * samples / (self.batch_size * self.accumulate * processes))
        )


def refuse_long_warmup(config: Any, steps: int | None) -> None:  # noqa: ANN401 - of any training
    """Refuse a warm-up that is longer than the training: the learning rate would never arrive.

    Args:
        config: of the training.
        steps: of the training; None, of ``epochs``: they are not known yet.

    Raises:
        InputError: the setting, its value and the steps.
    """
    for name, adam in vars(config).items():
        if isinstance(adam, AdamConfig) and steps is not None and adam.warmup_steps > steps:
            raise InputError(
                f"{name}.warmup_steps is {adam.warmup_steps}, but loop.steps is {steps}, so the "
                f"learning rate would never be reached; take at most {steps}, or 0 for no warm-up"
            )


def make_adam(
    parameters: Iterable[nn.Parameter] | list[dict[str, Any]], config: AdamConfig
) -> torch.optim.Adam:
    """Make the optimiser; the loop sets its learning rate before each step.

    Args:
        parameters: what it updates; or groups, whose ``rate`` is their share of the learning rate.
        config: its settings.
    """
    betas = (config.beta1, config.beta2)
    # One pass over memory: a quarter of the time of torch's other two ways, on a CPU too.
    kind = torch.optim.AdamW if config.weight_decay else torch.optim.Adam
    decay = config.weight_decay
    return kind(parameters, lr=config.learning_rate, betas=betas, weight_decay=decay, fused=True)
