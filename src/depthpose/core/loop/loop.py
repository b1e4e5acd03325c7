"""The training loop, on Hugging Face accelerate, and the claim of a folder for one training.

Accelerate provides devices and processes, torch the precision. Gradients are averaged over the
processes here, after the backward pass. So a step may run a network any number of times (a
discriminator judges a real and a fake pair), and N processes equal one that accumulates N times as
many micro-batches.
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

from depthpose.core.checkpoint import add_terms, file_sha256, find_weights, warn_of_terms
from depthpose.core.config import config_to_dict, write_config
from depthpose.core.devices import usable_precision
from depthpose.core.errors import InputError, import_extra
from depthpose.core.loop.folder import (
    RUN_FILES,
    STATE,
    Parts,
    RunLogger,
    list_saved_states,
    restore_last,
)
from depthpose.core.loop.task import (
    LoopConfig,
    Samples,
    Task,
    TrainingConfig,
    Update,
    mix_seed,
)
from depthpose.core.processes import find_rank
from depthpose.core.run_folder import claim_folder, held_folders, release_folders

SECOND_CTRL_C_S = 3.0  # between the first Ctrl-C, which stops, and the second, which finishes
_POLL_S = 0.05  # between two looks for the second Ctrl-C

_AUTOCAST_TYPES = {"fp32": None, "bf16": torch.bfloat16, "fp16": torch.float16}
_WITHOUT_EFFECT = (
    "workers", "device", "save_every_steps", "validate_every_steps", "log_every_steps"
)  # fmt: skip
"""Settings of the loop that change no weight: a resumed run may have others."""

_Config = TypeVar("_Config")


class Interrupted(KeyboardInterrupt):
    """The training was asked to stop (SIGTERM, Ctrl-C); its state is saved."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """The progress of a training."""

    step: int  #: steps taken
    steps: int  #: steps in all
    numbers: dict[str, float]  #: metrics by name; empty but for every ``log_every_steps`` steps


@dataclass(frozen=True, kw_only=True)
class TrainingRun:
    """A run of a training: its folder, how it begins, and callbacks."""

    folder: Path  #: for states, metrics, weights (named after what was trained) and their card
    resume: bool = False  #: go on from the last state in the folder
    finish: bool = False  #: write the weights of that state, without another step
    on_step: Callable[[Progress], None] | None = None  #: called after each optimiser step
    on_message: Callable[[str], None] | None = None  #: called with each message for the user

    def claim(
        self,
        config: TrainingConfig,
        weights: Sequence[str],
        more: Mapping[str, Any] | None = None,
    ) -> None:
        """Claim the folder for a training with this config, and write the config into it.

        Warns where weights that the training begins with have terms of use.

        Args:
            config: the config.
            weights: names of the weights that the training writes.
            more: what decides the weights besides the config, such as checksums of files.

        Raises:
            InputError: the folder is that of another config, or there are no such weights to begin
                with.
        """
        warn_of_terms(add_terms({}, config.initial_weights.values()))

        # What decides the weights: the config, the weights to begin with, and the number of
        # processes, by which the samples of a step are divided. What is held out is measured alone.
        checksums = {
            f"{setting}_sha256": file_sha256(find_weights(name))
            for setting, name in config.initial_weights.items()
        }
        stage = type(config).__name__
        settings = {"stage": stage, **config_to_dict(config), **checksums, **(more or {})}
        settings.pop("held_out", None)
        loop = {
            name: value for name, value in settings["loop"].items() if name not in _WITHOUT_EFFECT
        }
        settings["loop"] = loop | {"processes": find_rank().world}

        # The files of the run, and what to do where the folder is that of another one.
        files = list(RUN_FILES)
        for name in weights:
            files += [f"{name}.{suffix}" for suffix in ("safetensors", "md", "json")]
        remedy = "choose another, or delete this one"
        option = f"--{config.WEIGHTS_SETTINGS[0]}"
        for name in weights:
            path = self.folder / f"{name}.safetensors"
            if path.is_file():
                remedy += f"; to train on from its weights, give a new --out and {option} {path}"
        claim_folder(self.folder, settings, files, remedy)
        write_config(self.folder / "config.yaml", config)

    def train(self, task: Task, samples: Samples, config: LoopConfig) -> float:
        """Train a task to the last step; the result is in the task's networks.

        A resumed training goes on from the folder's last state or, with a notice, from the one
        before if that is damaged. The result equals that of an uninterrupted run. Under
        ``accelerate launch`` every process calls this; statistics of batch norm are rank 0's.

        Args:
            task: the networks, their losses and optimisers.
            samples: training samples by index.
            config: settings of the loop.

        Returns:
            The duration of the training, including earlier runs that it resumed [s].

        Raises:
            InputError: there are no samples, the folder has a state and ``resume`` is not set, all
                its states are damaged or of another network, the machine lacks the precision, or a
                loss is not finite.
            Interrupted: the training was asked to stop, and its state is saved.
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
        with collect_stop_requests() as requests:
            return training.take_steps(self.on_step, requests)


def releases_folder(
    stage: Callable[[_Config, TrainingRun], Path],
) -> Callable[[_Config, TrainingRun], Path]:
    """Decorate a training stage so that it unlocks its folder for other commands when it ends."""

    @wraps(stage)
    def run_stage(config: _Config, run: TrainingRun) -> Path:
        """Run the stage, and unlock the folders that it claimed, also where it fails."""
        before = held_folders()
        try:
            return stage(config, run)
        finally:
            release_folders(but=before)

    return run_stage


class _Training:
    """The state of a training in progress, and its steps."""

    def __init__(
        self, task: Task, samples: Samples, config: LoopConfig, folder: Path, *, resume: bool
    ) -> None:
        """Move the networks to the device and, with ``resume``, restore the folder's last state."""
        self.task = task
        self.samples = samples
        self.config = config
        self.accelerator = _make_accelerator(config)
        device = self.accelerator.device
        if config.precision == "fp16" and device.type == "cpu":
            raise InputError(
                "precision 'fp16' cannot be used here: it needs a GPU. Take bf16, which a CPU has "
                "too."
            )
        self.autocast_type = _AUTOCAST_TYPES[usable_precision(config.precision, device)]

        # Its length, and how far it is.
        self.process_count = self.accelerator.num_processes
        self.steps = config.total_steps(len(samples), self.process_count)
        self.logger = RunLogger(folder, is_writer=self.accelerator.is_main_process)
        self.step = 0
        self.began = time.monotonic()
        self.sums: dict[str, tuple[float, int]] = {}  # sum and number of terms of each metric

        saved = list_saved_states(folder)
        if saved and not resume:
            raise InputError(f"{folder}: holds a training. Add --resume, or take another folder.")

        # The networks on the device, with equal weights in all processes.
        for module in task.modules.values():
            module.to(device)
        if not saved and self.process_count > 1:
            _copy_weights_of_rank_0(task)
        self.parts = Parts(
            modules=task.modules,
            optimizers={name: adam for name, (adam, _) in task.optimizers.items()},
            scaler=torch.amp.GradScaler(device.type, enabled=self.autocast_type is torch.float16),
            average={} if config.ema_decay is None else _copy_weights(task),
        )

        if saved:
            restored = restore_last(folder, self.parts)
            self.step = restored.step
            self.began -= restored.seconds
            self.logger.is_last_intact = restored.path.name == STATE
        self.logger.open(self.step)

    def take_steps(
        self, on_step: Callable[[Progress], None] | None, requests: Sequence[tuple[int, float]]
    ) -> float:
        """Take the remaining steps; log, validate and save as often as the config says.

        Args:
            on_step: called after each step.
            requests: signals that asked to stop, collected by :func:`collect_stop_requests`; the
                list grows meanwhile.

        Returns:
            The duration of the whole training [s].

        Raises:
            Interrupted: it was asked to stop, and its state is saved.
        """
        batches = self._load_batches()
        while self.step < self.steps:
            self._take_step([next(batches) for _ in range(self.config.accumulate)])
            self.step += 1

            # One request saves and stops, two finish with the weights of this step.
            is_stopped = self._is_true_in_any_process(bool(requests))
            is_finish_requested = _wait_for_second_press(requests)
            if is_stopped and self._is_true_in_any_process(is_finish_requested):
                self.steps = self.step

            metrics: dict[str, float] = {}
            is_last = self.step == self.steps
            if is_last or self.step % self.config.log_every_steps == 0:
                metrics = {name: total / terms for name, (total, terms) in self.sums.items()}
                self.sums = {}
                self.logger.log(self.step, metrics)

            if is_last or self.step % self.config.validate_every_steps == 0:
                if self.accelerator.is_main_process:
                    self._validate()
                self.accelerator.wait_for_everyone()

            if is_stopped or is_last or self.step % self.config.save_every_steps == 0:
                seconds = time.monotonic() - self.began
                self.logger.save(
                    {"step": self.step, "seconds": seconds, **self.parts.collect_state()}
                )
            if on_step is not None and self.accelerator.is_main_process:
                on_step(Progress(step=self.step, steps=self.steps, numbers=metrics))

            if is_stopped and self.step < self.steps:
                self.logger.close()
                self.accelerator.wait_for_everyone()  # rank 0 may still be writing
                raise Interrupted(
                    f"stopped after step {self.step} of {self.steps}, --resume goes on from there, "
                    "--finish makes weights of it"
                )

        self.accelerator.wait_for_everyone()  # no process ends while another still needs it
        self._load_weights(self.parts.average)  # where there is an average, it is exported
        self.logger.close()
        return time.monotonic() - self.began

    def _validate(self) -> None:
        """Validate with the averaged weights, if there are any, and log the result."""
        trained = _copy_weights(self.task) if self.parts.average else {}
        self._load_weights(self.parts.average)
        self.logger.show(self.step, self.task.validate())
        self._load_weights(trained)

    def _load_batches(self) -> Iterator[Any]:
        """Yield this process's micro-batches of the remaining steps, on its device."""
        from accelerate.utils import send_to_device

        # Processes take micro-batches in turn: N processes use in a step the same samples as one
        # process that accumulates N times as many.
        rank = self.accelerator.process_index
        size = self.config.batch_size
        accumulate = self.config.accumulate
        # In each round every process takes one micro-batch.
        rounds = range(self.step * accumulate, self.steps * accumulate)
        starts = ((number * self.process_count + rank) * size for number in rounds)
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
        """Take a step of one optimiser after the other, each by the gradients of all micro-batches.

        The task yields an update for each optimiser (``Task.step``).
        """
        updates_of_batches = [iter(self.task.step(batch)) for batch in micro_batches]
        for update_number in count():
            optimizer_name = None
            for index, updates in enumerate(updates_of_batches):
                # Dropout depends on the micro-batch, not on the process that computes it.
                micro_batch = index * self.process_count + self.accelerator.process_index
                seed = mix_seed(self.config.seed, self.step, micro_batch, update_number)
                torch.manual_seed(seed)
                with torch.autocast(
                    self.accelerator.device.type,
                    self.autocast_type,
                    enabled=self.autocast_type is not None,
                ):
                    update = next(updates, None)
                if update is not None:
                    self._backpropagate(update, len(micro_batches))
                    optimizer_name = optimizer_name or update.optimizer
            if optimizer_name is None:  # the task has no further update
                break
            self._step_optimizer(optimizer_name)
        if self.config.ema_decay is not None:
            self._update_average(self.config.ema_decay)

    def _backpropagate(self, update: Update, micro_batches: int) -> None:
        """Add the gradients of a micro-batch's loss, and its numbers to the metrics.

        Args:
            update: its loss and numbers.
            micro_batches: number of micro-batches of the step, over which gradients are averaged.

        Raises:
            InputError: the loss is not finite.
        """
        name = update.optimizer
        loss = update.loss.detach()
        # fp16 overflows now and then, and its scaler skips such steps by itself.
        if self.config.precision != "fp16" and not math.isfinite(float(loss)):
            raise InputError(
                f"the {name}'s loss is {float(loss)} at step {self.step}. Start anew in "
                "another folder with a lower learning_rate, with clip_norm, or in "
                "precision fp32; 'start' can take weights from before."
            )
        scaled_loss = self.parts.scaler.scale(update.loss / micro_batches)
        scaled_loss.backward(inputs=_list_parameters(self.parts.optimizers[name]))
        for fact, value in {"loss": loss, **update.facts}.items():
            total, terms = self.sums.get(f"{name}/{fact}", (0.0, 0))
            self.sums[f"{name}/{fact}"] = (total + float(value), terms + 1)

    def _update_average(self, ema_decay: float) -> None:
        """Move the moving average of the weights towards the weights.

        The decay is lower in the first steps, so that the initial weights are soon forgotten.
        """
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
        """Average the gradients over all processes, and step an optimiser."""
        optimizer, adam = self.task.optimizers[name]
        for group in optimizer.param_groups:
            group["lr"] = adam.rate_at(self.step, self.steps) * group.get("rate", 1.0)
        parameters = _list_parameters(optimizer)
        if self.process_count > 1:
            gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
            flat = torch.cat([gradient.flatten() for gradient in gradients])
            mean: Tensor = self.accelerator.reduce(flat, "mean")
            means = mean.split([gradient.numel() for gradient in gradients])
            for parameter, gradient in zip(parameters, means, strict=True):
                parameter.grad = gradient.view_as(parameter)
        scaler = self.parts.scaler
        if self.config.clip_norm is not None:
            scaler.unscale_(optimizer)
            torch.nn.utils.clip_grad_norm_(parameters, self.config.clip_norm)
        scaler.step(optimizer)
        scaler.update()
        optimizer.zero_grad()

    def _load_weights(self, states: Mapping[str, dict[str, Tensor]]) -> None:
        """Load weights into the task's networks of these names."""
        for name, state in states.items():
            self.task.modules[name].load_state_dict(state)

    def _is_true_in_any_process(self, is_true: bool) -> bool:
        """Whether a condition holds in any process; all must call this at the same point."""
        if self.process_count == 1:
            return is_true
        flag = torch.tensor([float(is_true)], device=self.accelerator.device)
        return bool(float(self.accelerator.reduce(flag, "sum")) > 0)


def _make_accelerator(config: LoopConfig) -> Any:  # noqa: ANN401  accelerate is loaded where it is used
    """Make accelerate's ``Accelerator``, which knows the device and the processes of this launch.

    Raises:
        InputError: this process has trained on another device.
        MissingExtraError: accelerate is not installed.
    """
    accelerate = import_extra("accelerate", "accelerate", "train", "training")
    # The other processes wait while rank 0 validates.
    process_group = accelerate.InitProcessGroupKwargs(timeout=timedelta(hours=2))
    try:
        # Without its own precision, since it would keep that of a process's first training.
        return accelerate.Accelerator(
            mixed_precision="no", cpu=config.device == "cpu", kwargs_handlers=[process_group]
        )
    except ValueError as error:
        raise InputError(
            f"device {config.device!r} cannot be used in this process, which has trained on "
            f"another; start this training in a process of its own ({error})"
        ) from error


def _copy_weights_of_rank_0(task: Task) -> None:
    """Copy the initial weights of rank 0 to all processes."""
    from accelerate.utils import broadcast

    for module in task.modules.values():
        for tensor in module.state_dict().values():
            tensor.copy_(broadcast(tensor))


def _copy_weights(task: Task) -> dict[str, dict[str, Tensor]]:
    """Copy the weights of all networks of a task, by network and tensor."""
    return {
        name: {key: tensor.clone() for key, tensor in module.state_dict().items()}
        for name, module in task.modules.items()
    }


def _list_parameters(optimizer: Any) -> list[Tensor]:  # noqa: ANN401
    """List the parameters of an optimiser."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def _wait_for_second_press(requests: Sequence[tuple[int, float]]) -> bool:
    """Whether Ctrl-C was pressed twice; after a first press, wait some seconds for a second."""
    while True:
        presses = [pressed_s for number, pressed_s in requests if number == signal.SIGINT]
        if len(presses) != 1 or time.monotonic() - presses[0] >= SECOND_CTRL_C_S:
            return len(presses) > 1
        time.sleep(_POLL_S)


@contextmanager
def collect_stop_requests() -> Iterator[list[tuple[int, float]]]:
    """Collect SIGTERM and Ctrl-C inside the block, where they do not end the process.

    Yields a list of signals that grows by the number and the time [s] of each.
    """
    requests: list[tuple[int, float]] = []

    def record_signal(number: int, _: FrameType | None) -> None:
        """Add a signal to the list; at the first Ctrl-C tell the user what a second one does."""
        if not requests and number == signal.SIGINT:
            message = (
                "\ndepthpose: stopping after this step. Press Ctrl-C again within 3 s to finish "
                "now: the weights of the steps so far are written.\n"
            )
            os.write(2, message.encode())  # the signal may have interrupted a print
        requests.append((number, time.monotonic()))

    earlier_handlers = {}
    with suppress(ValueError):  # outside the main thread the caller handles signals
        numbers = (signal.SIGTERM, signal.SIGINT)
        earlier_handlers = {number: signal.signal(number, record_signal) for number in numbers}
    try:
        yield requests
    finally:
        for number, handler in earlier_handlers.items():
            signal.signal(number, handler)


def _leave_process_group(_: int) -> None:
    """Put a data worker into a session of its own, where signals to the training do not end it."""
    os.setsid()
