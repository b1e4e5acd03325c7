"""The loop itself, on Hugging Face accelerate.

Accelerate brings devices and processes, torch the precision. Gradients are averaged here, after the
backward pass: that way a step may run any network any number of times (a discriminator is given a
real and a fake pair), and N processes equal one that accumulates N micro-batches.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from depthpose.core.errors import InputError
from depthpose.core.loop.config import LoopConfig
from depthpose.core.loop.host import (
    Arithmetic,
    StopRequest,
    graceful_stop,
    leave_process_group,
    make_accelerator,
)
from depthpose.core.loop.journal import Journal
from depthpose.core.loop.state import Parts, restore_last, saved_states
from depthpose.core.loop.task import Samples, Task, Update, mixed_seed


class Interrupted(KeyboardInterrupt):
    """The training was asked to stop (SIGTERM, Ctrl-C); its state is saved."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a training is.

    Attributes:
        step: steps done.
        steps: steps in all.
        numbers: the latest metrics; empty between two log steps.
    """

    step: int
    steps: int
    numbers: dict[str, float]


def train(
    task: Task,
    samples: Samples,
    config: LoopConfig,
    folder: Path,
    *,
    resume: bool = False,
    finish: bool = False,
    on_step: Callable[[Progress], None] | None = None,
) -> float:
    """Train ``task`` until its last step; its modules hold the result.

    Under ``accelerate launch`` every process calls this; batch norm statistics are rank 0's.

    Args:
        task: what is trained.
        samples: training samples by index.
        config: how long and how.
        folder: the run folder.
        resume: go on from the folder's last state; if it is damaged, with a notice from the one
            before. The result equals that of an uninterrupted run.
        finish: make weights of that state, without further steps.
        on_step: called after each step, in the main process.

    Returns:
        What it took, in seconds, together with the runs that it resumed.

    Raises:
        InputError: nothing to train on, a folder with a state and no ``resume``, states that are
            all damaged or of another network, a precision that this machine lacks, or a loss that
            is no longer finite.
        Interrupted: asked to stop; the state is saved first.
    """
    if not len(samples):
        raise InputError("there is no sample to train on; the dataset is empty.")
    run = _Run(task, samples, config, folder)
    run.start(resume=resume or finish)
    if finish and not run.step:
        raise InputError(f"{folder}: holds no state of a training, so there is none to finish.")
    run.steps = run.step if finish else run.steps
    with graceful_stop() as request:
        run.take_steps(on_step, request)
    return run.seconds


class _Run:
    def __init__(self, task: Task, samples: Samples, config: LoopConfig, folder: Path) -> None:
        self.task, self.samples, self.config = task, samples, config
        self.accelerator = make_accelerator(config)
        self.arithmetic = Arithmetic(config, self.accelerator.device)
        self.scaler = self.arithmetic.scaler
        self.world = self.accelerator.num_processes
        self.steps = config.total_steps(len(samples), self.world)
        self.journal = Journal(folder, is_writer=self.accelerator.is_main_process)
        self.step = 0
        self._began = time.monotonic()
        self.sums: dict[str, tuple[float, int]] = {}
        self.average: dict[str, dict[str, Tensor]] = {}

    def start(self, *, resume: bool) -> None:
        """Bring everything to the device and, where asked, to the state of an earlier run."""
        folder = self.journal.folder
        saved = saved_states(folder)
        if saved and not resume:
            raise InputError(f"{folder}: holds a training. Add --resume, or take another folder.")
        for module in self.task.modules.values():
            module.to(self.accelerator.device)
        self.optimizers = {name: adam for name, (adam, _) in self.task.optimizers.items()}
        if not saved:
            self._agree_on_weights()
        if self.config.ema_decay is not None:
            self.average = {name: _copied(m) for name, m in self.task.modules.items()}
        if saved:
            path, self.step, seconds = restore_last(folder, self._parts())
            self._began -= seconds
            self.journal.keep_resumed_state(path)
        self.journal.open(self.step)

    @property
    def seconds(self) -> float:
        """What it took until now, with the runs before this one."""
        return time.monotonic() - self._began

    def take_steps(self, on_step: Callable[[Progress], None] | None, request: StopRequest) -> None:
        """Take the remaining steps; if asked to finish, the current step is the last."""
        batches = self._batches()
        while self.step < self.steps:
            micro_batches = [next(batches) for _ in range(self.config.accumulate)]
            self._take_step(micro_batches)
            self.step += 1
            stop = self._any_process(request.to_stop())
            if stop and self._any_process(request.to_finish()):
                self.steps = self.step
            numbers = self._log()
            if self._is_due(self.config.validate_every_steps):
                self._validate()
            if stop or self._is_due(self.config.save_every_steps):
                self.save()
            if on_step is not None and self.accelerator.is_main_process:
                on_step(Progress(step=self.step, steps=self.steps, numbers=numbers))
            if stop and self.step < self.steps:
                self.journal.close()
                self.accelerator.wait_for_everyone()  # rank 0 may still be writing
                raise Interrupted(
                    f"stopped after step {self.step} of {self.steps}, --resume goes on from there, "
                    "--finish makes weights of it"
                )
        self.accelerator.wait_for_everyone()  # none leaves while another still needs it
        self._load(self.average)  # what is exported
        self.journal.close()

    def save(self) -> None:
        """Write the state, all or nothing."""
        now = {"step": self.step, "seconds": self.seconds}
        self.journal.save({**now, **self._parts().state()})

    def _parts(self) -> Parts:
        return Parts(
            modules=self.task.modules,
            optimizers=self.optimizers,
            scaler=self.scaler,
            average=self.average,
        )

    def _take_step(self, micro_batches: list[Any]) -> None:
        """Run the first update of all micro-batches, then the second, and so on."""
        iterators = [iter(self.task.step(batch)) for batch in micro_batches]
        number = 0
        while True:
            updates = list(self._backward_all(iterators, number))
            if not updates:
                break
            self._move(updates[0])
            number += 1
        if self.config.ema_decay is not None:
            self._update_average(self.config.ema_decay)

    def _backward_all(self, iterators: list[Iterator[Update]], number: int) -> Iterator[str]:
        for place, iterator in enumerate(iterators):
            # Dropout follows the micro-batch, not the process that happens to hold it.
            micro = place * self.world + self.accelerator.process_index
            torch.manual_seed(mixed_seed(self.config.seed, self.step, micro, number))
            with self.arithmetic.autocast():
                update = next(iterator, None)
            if update is None:
                continue
            self._refuse_bad_loss(update.optimizer, float(update.loss.detach()))
            parameters = _parameters(self.optimizers[update.optimizer])
            self.scaler.scale(update.loss / len(iterators)).backward(inputs=parameters)
            self._remember({"loss": update.loss.detach(), **update.facts}, update.optimizer)
            yield update.optimizer

    def _move(self, name: str) -> None:
        """Average the gradients over processes and step the optimiser."""
        optimizer = self.optimizers[name]
        _, adam = self.task.optimizers[name]
        for group in optimizer.param_groups:
            group["lr"] = adam.rate_at(self.step, self.steps) * group.get("rate", 1.0)
        parameters = _parameters(optimizer)
        if self.world > 1:
            self._average_gradients(parameters)
        if self.config.clip_norm is not None:
            self.scaler.unscale_(optimizer)
            torch.nn.utils.clip_grad_norm_(parameters, self.config.clip_norm)
        self.scaler.step(optimizer)
        self.scaler.update()
        optimizer.zero_grad()

    def _average_gradients(self, parameters: list[Tensor]) -> None:
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([grad.flatten() for grad in grads])
        mean: Tensor = self.accelerator.reduce(flat, "mean")
        parts = mean.split([grad.numel() for grad in grads])
        for parameter, part in zip(parameters, parts, strict=True):
            parameter.grad = part.view_as(parameter)

    def _batches(self) -> Iterator[Any]:
        first = self.step * self.config.accumulate
        loader = DataLoader(
            self.samples,  # pyright: ignore[reportArgumentType]
            batch_sampler=_SampleIndices(self, first),
            num_workers=self.config.workers,
            collate_fn=getattr(self.samples, "collate", None),
            pin_memory=self.accelerator.device.type == "cuda",
            worker_init_fn=leave_process_group,
        )
        from accelerate.utils import send_to_device

        return (send_to_device(batch, self.accelerator.device) for batch in loader)

    def _validate(self) -> None:
        if self.accelerator.is_main_process:
            own = {name: _copied(m) for name, m in self.task.modules.items() if self.average}
            self._load(self.average)
            self.journal.show(self.step, self.task.validate())
            self._load(own)
        self.accelerator.wait_for_everyone()

    def _load(self, states: dict[str, dict[str, Tensor]]) -> None:
        for name, state in states.items():
            self.task.modules[name].load_state_dict(state)

    def _is_due(self, every: int) -> bool:
        return self.step % every == 0 or self.step == self.steps

    def _remember(self, facts: dict[str, Tensor], owner: str) -> None:
        for name, value in facts.items():
            total, count = self.sums.get(f"{owner}/{name}", (0.0, 0))
            self.sums[f"{owner}/{name}"] = (total + float(value), count + 1)

    def _log(self) -> dict[str, float]:
        if not self._is_due(self.config.log_every_steps):
            return {}
        numbers = {name: total / count for name, (total, count) in self.sums.items()}
        self.sums = {}
        self.journal.log(self.step, numbers)
        return numbers

    def _refuse_bad_loss(self, owner: str, loss: float) -> None:
        # fp16 overflows now and then, and its scaler skips such steps by itself.
        if self.config.precision != "fp16" and not math.isfinite(loss):
            raise InputError(
                f"the {owner}'s loss is {loss} at step {self.step}. Start anew in another folder "
                "with a lower learning_rate, with clip_norm, or in precision fp32; 'start' can "
                "take weights from before."
            )

    def _any_process(self, is_asked: bool) -> bool:
        if self.world == 1:
            return is_asked
        flag = torch.tensor([float(is_asked)], device=self.accelerator.device)
        return bool(float(self.accelerator.reduce(flag, "sum")) > 0)

    def _agree_on_weights(self) -> None:
        """Every process begins with rank 0's weights, whatever seed built its own."""
        if self.world > 1:
            from accelerate.utils import broadcast

            for module in self.task.modules.values():
                for tensor in module.state_dict().values():
                    tensor.copy_(broadcast(tensor))

    @torch.no_grad()
    def _update_average(self, most: float) -> None:
        decay = min(most, (1 + self.step) / (10 + self.step))
        for name, module in self.task.modules.items():
            for key, tensor in module.state_dict().items():
                held = self.average[name][key]
                if tensor.is_floating_point():
                    held.lerp_(tensor, 1 - decay)
                else:
                    held.copy_(tensor)


class _SampleIndices:
    """Sample indices of this process's micro-batches, from the first that is still to do.

    Micro-batch m of a step belongs to place ``m // world`` of process ``m % world``: N processes
    see in a step what one process sees that accumulates N times as much.
    """

    def __init__(self, run: _Run, first: int) -> None:
        self.size = run.config.batch_size
        self.world, self.rank = run.world, run.accelerator.process_index
        self.places = range(first, run.steps * run.config.accumulate)

    def __iter__(self) -> Iterator[list[int]]:
        for place in self.places:
            start = (place * self.world + self.rank) * self.size
            yield list(range(start, start + self.size))

    def __len__(self) -> int:
        return len(self.places)


def _parameters(optimizer: torch.optim.Optimizer) -> list[Tensor]:
    return [p for group in optimizer.param_groups for p in group["params"]]


def _copied(module: torch.nn.Module) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in module.state_dict().items()}
