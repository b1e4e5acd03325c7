"""The loop itself, on Hugging Face accelerate, and the claim of a folder for one training.

Accelerate brings devices and processes, torch the precision. Gradients are averaged here, after the
backward pass: that way a step may run any network any number of times (a discriminator is given a
real and a fake pair), and N processes equal one that accumulates N micro-batches.
"""

import math
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import wraps
from itertools import count
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from depthpose.core.config import config_to_dict, write_config
from depthpose.core.devices import usable_precision
from depthpose.core.errors import InputError, import_extra
from depthpose.core.loop.folder import (
    RUN_FILES,
    STATE,
    Parts,
    RunLogger,
    restore_last,
    saved_states,
)
from depthpose.core.loop.task import LoopConfig, Samples, Task, mixed_seed
from depthpose.core.run import claim_folder, find_rank, held_folders, release_folders

SECOND_CTRL_C_S = 3.0  # between the first Ctrl-C, which stops, and the second, which finishes

_TYPES = {"fp32": None, "bf16": torch.bfloat16, "fp16": torch.float16}
_NOT_DECISIVE = ("workers", "device", "save_every_steps", "validate_every_steps", "log_every_steps")
"""Settings of the loop that change no weight: a resumed run may have others."""

_Config = TypeVar("_Config")


class Interrupted(KeyboardInterrupt):
    """The training was asked to stop (SIGTERM, Ctrl-C); its state is saved."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a training is."""

    step: int  #: steps done
    steps: int  #: steps in all
    numbers: dict[str, float]  #: the latest metrics; empty between two log steps


@dataclass(frozen=True, kw_only=True)
class Run:
    """Folder of a training, and callbacks."""

    folder: Path  #: the run folder; weights, named after what was trained, and card lie in it
    resume: bool = False  #: go on from its last state
    finish: bool = False  #: make weights of its last state, without another step
    on_step: Callable[[Progress], None] | None = None  #: called after each optimiser step
    on_message: Callable[[str], None] | None = None  #: called with each message for the user

    def claim(
        self,
        config: Any,  # noqa: ANN401
        weights: Sequence[str],
        more: Mapping[str, Any] | None = None,
        without: Sequence[str] = (),
    ) -> None:
        """Make the folder this config's own, and write the config into it.

        Args:
            config: of any training; it has ``loop``.
            weights: names of the weights that such a training leaves.
            more: what decides the weights beside the config, such as checksums of files.
            without: settings of the config from which no weight follows.

        Raises:
            InputError: the folder is another config's.
        """
        settings = {"stage": type(config).__name__, **config_to_dict(config), **(more or {})}
        decisive = {k: v for k, v in settings["loop"].items() if k not in _NOT_DECISIVE}
        settings["loop"] = decisive | {"processes": find_rank().world}
        compared = {k: v for k, v in settings.items() if k not in without}
        ends = ("safetensors", "md", "json")
        files = [*RUN_FILES, *(f"{name}.{end}" for name in weights for end in ends)]
        remedy = "choose another, or delete this one"
        for path in (self.folder / f"{name}.safetensors" for name in weights):
            if path.is_file():
                option = "--start" if hasattr(config, "start") else "--generator"
                remedy += f"; to train on from its weights, give a new --out and {option} {path}"
        claim_folder(self.folder, compared, files, remedy)
        write_config(self.folder / "config.yaml", config)

    def train(self, task: Task, samples: Samples, config: LoopConfig) -> float:
        """Train ``task`` in the folder until its last step; its modules hold the result.

        A resumed training goes on from the folder's last state; if that is damaged, with a notice
        from the one before. The result equals that of an uninterrupted run. Under ``accelerate
        launch`` every process calls this; batch norm statistics are rank 0's.

        Args:
            task: what is trained.
            samples: training samples by index.
            config: how long and how.

        Returns:
            What it took, in seconds, together with the runs that it resumed.

        Raises:
            InputError: nothing to train on, a folder with a state and no ``resume``, states that
                are all damaged or of another network, a precision that this machine lacks, or a
                loss that is no longer finite.
            Interrupted: asked to stop; the state is saved first.
        """
        if not len(samples):
            raise InputError("there is no sample to train on; the dataset is empty.")
        is_resumed = self.resume or self.finish
        training = _Training(task, samples, config, self.folder, resume=is_resumed)
        if self.finish and not training.step:
            raise InputError(
                f"{self.folder}: holds no state of a training, so there is none to finish."
            )
        training.steps = training.step if self.finish else training.steps
        with stop_requests() as requests:
            return training.take_steps(self.on_step, requests)


def releases_folder(stage: Callable[[_Config, Run], Path]) -> Callable[[_Config, Run], Path]:
    """Let other commands into the folder of a training when its weights are written."""

    @wraps(stage)
    def run_stage(config: _Config, run: Run) -> Path:
        """Run the stage, and release the folders that it claimed, also where it fails."""
        before = held_folders()
        try:
            return stage(config, run)
        finally:
            release_folders(but=before)

    return run_stage


class _Training:
    def __init__(
        self, task: Task, samples: Samples, config: LoopConfig, folder: Path, *, resume: bool
    ) -> None:
        """Bring everything to the device and, where asked, to the state of an earlier run."""
        self.task = task
        self.samples = samples
        self.config = config
        accelerate = import_extra("accelerate", "accelerate", "train", "training")
        # The other processes wait while rank 0 validates.
        patience = accelerate.InitProcessGroupKwargs(timeout=timedelta(hours=2))
        try:  # without precision: accelerate keeps that of a process's first training
            self.accelerator = accelerate.Accelerator(
                mixed_precision="no", cpu=config.device == "cpu", kwargs_handlers=[patience]
            )
        except ValueError as error:
            raise InputError(
                f"device {config.device!r} cannot be used in this process, which has trained on "
                f"another; start this training in a process of its own ({error})"
            ) from error
        device = self.accelerator.device
        if config.precision == "fp16" and device.type == "cpu":
            raise InputError(
                "precision 'fp16' cannot be used here: it needs a GPU. Take bf16, which a CPU has "
                "too."
            )
        self.precision = _TYPES[usable_precision(config.precision, device)]  # None: fp32
        scaler = torch.amp.GradScaler(device.type, enabled=self.precision is torch.float16)
        self.world = self.accelerator.num_processes
        self.steps = config.total_steps(len(samples), self.world)
        self.logger = RunLogger(folder, is_writer=self.accelerator.is_main_process)
        self.step = 0
        self.began = time.monotonic()
        self.sums: dict[str, tuple[float, int]] = {}
        saved = saved_states(folder)
        if saved and not resume:
            raise InputError(f"{folder}: holds a training. Add --resume, or take another folder.")
        for module in task.modules.values():
            module.to(device)
        if not saved and self.world > 1:  # every process begins with rank 0's weights
            from accelerate.utils import broadcast

            for module in task.modules.values():
                for tensor in module.state_dict().values():
                    tensor.copy_(broadcast(tensor))
        has_average = config.ema_decay is not None
        self.parts = Parts(
            modules=task.modules,
            optimizers={name: adam for name, (adam, _) in task.optimizers.items()},
            scaler=scaler,
            average={
                name: {key: tensor.clone() for key, tensor in m.state_dict().items()}
                for name, m in task.modules.items()
                if has_average
            },
        )
        if saved:
            path, self.step, seconds = restore_last(folder, self.parts)
            self.began -= seconds
            self.logger.has_good_last = path.name == STATE
        self.logger.open(self.step)

    def take_steps(
        self, on_step: Callable[[Progress], None] | None, requests: Sequence[tuple[int, float]]
    ) -> float:
        """Take the remaining steps; give the seconds of the whole training.

        ``requests``: signals that ask it to stop, by number and time; the list grows meanwhile.

        Raises:
            Interrupted: it was asked to stop, and its state is saved.
        """
        batches = self._batches()
        while self.step < self.steps:
            self._take_step([next(batches) for _ in range(self.config.accumulate)])
            self.step += 1

            # One Ctrl-C stops; a second one within seconds makes this step the last.
            stop = self._any_process(bool(requests))
            presses = [at for number, at in requests if number == signal.SIGINT]
            while len(presses) == 1 and time.monotonic() - presses[0] < SECOND_CTRL_C_S:
                time.sleep(0.05)
                presses = [at for number, at in requests if number == signal.SIGINT]
            if stop and self._any_process(len(presses) > 1):
                self.steps = self.step

            numbers: dict[str, float] = {}
            is_last = self.step == self.steps
            if is_last or self.step % self.config.log_every_steps == 0:
                numbers = {name: total / terms for name, (total, terms) in self.sums.items()}
                self.sums = {}
                self.logger.log(self.step, numbers)
            if is_last or self.step % self.config.validate_every_steps == 0:
                if self.accelerator.is_main_process:
                    self._validate()
                self.accelerator.wait_for_everyone()
            if stop or is_last or self.step % self.config.save_every_steps == 0:
                seconds = time.monotonic() - self.began
                self.logger.save({"step": self.step, "seconds": seconds, **self.parts.state()})
            if on_step is not None and self.accelerator.is_main_process:
                on_step(Progress(step=self.step, steps=self.steps, numbers=numbers))
            if stop and self.step < self.steps:
                self.logger.close()
                self.accelerator.wait_for_everyone()  # rank 0 may still be writing
                raise Interrupted(
                    f"stopped after step {self.step} of {self.steps}, --resume goes on from there, "
                    "--finish makes weights of it"
                )
        self.accelerator.wait_for_everyone()  # none leaves while another still needs it
        self._load_weights(self.parts.average)  # what is exported
        self.logger.close()
        return time.monotonic() - self.began

    def _validate(self) -> None:
        """Validate with the averaged weights, if there are any, and log the result."""
        average = self.parts.average
        trained = {
            name: {key: tensor.clone() for key, tensor in m.state_dict().items()}
            for name, m in self.task.modules.items()
            if average
        }
        self._load_weights(average)
        self.logger.show(self.step, self.task.validate())
        self._load_weights(trained)

    def _batches(self) -> Iterator[Any]:
        """Load this process's micro-batches, from the first that is still to do."""
        from accelerate.utils import send_to_device

        # Micro-batch m of a step belongs to place m // world of process m % world: N processes see
        # in a step what one process sees that accumulates N times as much.
        rank = self.accelerator.process_index
        size = self.config.batch_size
        places = range(self.step * self.config.accumulate, self.steps * self.config.accumulate)
        starts = ((place * self.world + rank) * size for place in places)
        loader = DataLoader(
            self.samples,  # pyright: ignore[reportArgumentType]
            batch_sampler=(list(range(start, start + size)) for start in starts),
            num_workers=self.config.workers,
            collate_fn=getattr(self.samples, "collate", None),
            pin_memory=self.accelerator.device.type == "cuda",
            worker_init_fn=_leave_process_group,
        )
        return (send_to_device(batch, self.accelerator.device) for batch in loader)

    def _take_step(self, micro_batches: list[Any]) -> None:
        """Take one step: the first optimiser's update for all micro-batches, then the second's.

        A task yields one loss for each of its optimisers (``Task.step``).
        """
        iterators = [iter(self.task.step(batch)) for batch in micro_batches]
        for number in count():
            owner = None
            for place, iterator in enumerate(iterators):
                # Dropout follows the micro-batch, not the process that happens to hold it.
                micro = place * self.world + self.accelerator.process_index
                torch.manual_seed(mixed_seed(self.config.seed, self.step, micro, number))
                device = self.accelerator.device.type
                precision = self.precision
                with torch.autocast(device, precision, enabled=precision is not None):
                    update = next(iterator, None)
                if update is None:
                    continue
                name = update.optimizer
                loss = update.loss.detach()
                # fp16 overflows now and then, and its scaler skips such steps by itself.
                if self.config.precision != "fp16" and not math.isfinite(float(loss)):
                    raise InputError(
                        f"the {name}'s loss is {float(loss)} at step {self.step}. Start anew in "
                        "another folder with a lower learning_rate, with clip_norm, or in "
                        "precision fp32; 'start' can take weights from before."
                    )
                share = self.parts.scaler.scale(update.loss / len(iterators))
                groups = self.parts.optimizers[name].param_groups
                share.backward(inputs=[p for group in groups for p in group["params"]])
                for fact, value in {"loss": loss, **update.facts}.items():
                    total, terms = self.sums.get(f"{name}/{fact}", (0.0, 0))
                    self.sums[f"{name}/{fact}"] = (total + float(value), terms + 1)
                owner = owner or name
            if owner is None:
                break
            self._step_optimizer(owner)
        if self.config.ema_decay is not None:
            self._update_average(self.config.ema_decay)

    def _update_average(self, ema_decay: float) -> None:
        """Move the average of the weights towards them; at first faster, as it begins at random."""
        decay = min(ema_decay, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for name, module in self.task.modules.items():
                for key, tensor in module.state_dict().items():
                    average = self.parts.average[name][key]
                    if tensor.is_floating_point():
                        average.lerp_(tensor, 1 - decay)
                    else:
                        average.copy_(tensor)

    def _step_optimizer(self, name: str) -> None:
        """Average the gradients over processes and step the optimiser."""
        optimizer, adam = self.task.optimizers[name]
        for group in optimizer.param_groups:
            group["lr"] = adam.rate_at(self.step, self.steps) * group.get("rate", 1.0)
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        if self.world > 1:
            grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
            flat = torch.cat([grad.flatten() for grad in grads])
            mean: Tensor = self.accelerator.reduce(flat, "mean")
            parts = mean.split([grad.numel() for grad in grads])
            for parameter, part in zip(parameters, parts, strict=True):
                parameter.grad = part.view_as(parameter)
        scaler = self.parts.scaler
        if self.config.clip_norm is not None:
            scaler.unscale_(optimizer)
            torch.nn.utils.clip_grad_norm_(parameters, self.config.clip_norm)
        scaler.step(optimizer)
        scaler.update()
        optimizer.zero_grad()

    def _load_weights(self, states: Mapping[str, dict[str, Tensor]]) -> None:
        for name, state in states.items():
            self.task.modules[name].load_state_dict(state)

    def _any_process(self, is_asked: bool) -> bool:
        if self.world == 1:
            return is_asked
        flag = torch.tensor([float(is_asked)], device=self.accelerator.device)
        return bool(float(self.accelerator.reduce(flag, "sum")) > 0)


@contextmanager
def stop_requests() -> Iterator[list[tuple[int, float]]]:
    """Let SIGTERM and Ctrl-C end the training after the step, with its state saved.

    Gives a list that grows by the number and the time of each signal.
    """
    requests: list[tuple[int, float]] = []

    def remember(number: int, _: FrameType | None) -> None:
        """Note a signal and when it came; the loop looks after each step."""
        if not requests and number == signal.SIGINT:
            message = (
                "\ndepthpose: stopping after this step. Press Ctrl-C again within 3 s to finish "
                "now: the weights of the steps so far are written.\n"
            )
            os.write(2, message.encode())  # print may be at work itself
        requests.append((number, time.monotonic()))

    handlers = {}
    with suppress(ValueError):  # not the main thread: whoever runs us handles signals
        numbers = (signal.SIGTERM, signal.SIGINT)
        handlers = {number: signal.signal(number, remember) for number in numbers}
    try:
        yield requests
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _leave_process_group(_: int) -> None:
    """Leave the job's process group: a signal to it must not end workers before a save."""
    os.setsid()
