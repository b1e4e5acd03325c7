"""A small adversarial task for tests of the loop."""

import time
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

from depthpose.core.loop import (
    AdamConfig,
    LoopConfig,
    TrainingRun,
    Update,
    ValidationResult,
    make_adam,
    make_sample_generator,
    shuffle_index,
)

ADAM = AdamConfig(learning_rate=0.01, schedule="cosine")


class ToyTask:
    """A regressor with dropout and batch norm, and a discriminator that takes the first turn."""

    def __init__(self, pause_s: float = 0.0, factor: float = 1.0) -> None:
        torch.manual_seed(5)
        self.pause_s, self.factor = pause_s, factor
        layers = [nn.Linear(3, 8), nn.BatchNorm1d(8), nn.Dropout(0.3), nn.Linear(8, 1)]
        self.modules = {"regressor": nn.Sequential(*layers), "discriminator": nn.Linear(1, 1)}
        self.optimizers = {
            n: (make_adam(m.parameters(), ADAM), ADAM) for n, m in self.modules.items()
        }

    def step(self, batch: tuple[Tensor, Tensor]) -> Iterator[Update]:
        time.sleep(self.pause_s)
        x, y = batch
        found = self.modules["regressor"](x)
        discriminator = self.modules["discriminator"]
        yield Update(
            "discriminator", (discriminator(found.detach()) - discriminator(y)).square().mean(), {}
        )
        loss = (found - y).square().mean() + 0.1 * discriminator(found).square().mean()
        yield Update("regressor", self.factor * loss, {"double": 2 * loss.detach()})

    def validate(self) -> ValidationResult:
        picture = torch.full((3, 4, 4), 0.5)
        return ValidationResult(numbers={"held_out/one": 1.0}, pictures={"grey": picture})


class ToySamples:
    def __len__(self) -> int:
        return 20

    def __getitem__(self, sample_index: int) -> tuple[Tensor, Tensor]:
        index = shuffle_index(sample_index, 20, 3)
        noise = torch.randn(3, generator=make_sample_generator(sample_index, 3))
        x = torch.tensor([index / 20, 1.0, -0.5]) + 0.1 * noise
        return x, x.sum(0, keepdim=True)


def weights(task: ToyTask) -> dict[str, Tensor]:
    return {f"{n}.{k}": t for n, m in task.modules.items() for k, t in m.state_dict().items()}


def write_slowly(path: Path, data: bytes) -> None:
    """Stand in for a slow disk: half a state for a long time."""
    with path.open("wb") as file:
        file.write(data[: len(data) // 2])
        file.flush()
        time.sleep(60)


def train_toy(
    folder: Path,
    steps: int,
    *,
    accumulate: int = 1,
    pause_s: float = 0.0,
    workers: int = 0,
    with_slow_disk: bool = False,
) -> None:
    """Train, or go on: for processes to be killed and launched."""
    config = LoopConfig(
        steps=steps,
        batch_size=4,
        accumulate=accumulate,
        save_every_steps=3,
        workers=workers,
        device="cpu",
    )
    if with_slow_disk:
        Path.write_bytes = write_slowly  # pyright: ignore[reportAttributeAccessIssue]
    TrainingRun(folder=folder, resume=True).train(ToyTask(pause_s), ToySamples(), config)
