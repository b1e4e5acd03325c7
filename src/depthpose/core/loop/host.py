"""What the loop runs on: devices and processes by accelerate, and the signals that stop it."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from types import FrameType
from typing import Any

import torch

from depthpose.core.devices import usable_precision
from depthpose.core.errors import InputError, MissingExtraError
from depthpose.core.loop.config import LoopConfig

_TYPES = {"fp32": None, "bf16": torch.bfloat16, "fp16": torch.float16}


def make_accelerator(config: LoopConfig) -> Any:  # noqa: ANN401 - accelerate is an extra
    """Set up accelerate for the device and the processes of a training.

    Precision is the loop's own (:class:`Arithmetic`): accelerate keeps that of a process's first
    training, as it keeps the device.

    Raises:
        MissingExtraError: accelerate is not installed.
        InputError: a CPU is wanted, and this process has trained on a GPU before.
    """
    try:
        from accelerate import Accelerator
        from accelerate.utils import InitProcessGroupKwargs
    except ImportError as error:
        raise MissingExtraError("accelerate", "train", "training") from error
    # The other processes wait while rank 0 validates.
    patience = InitProcessGroupKwargs(timeout=timedelta(hours=2))
    on_cpu = config.device == "cpu"
    try:
        return Accelerator(mixed_precision="no", cpu=on_cpu, kwargs_handlers=[patience])
    except ValueError as error:
        raise InputError(
            f"device {config.device!r} cannot be used in this process, which has trained on "
            f"another; start this training in a process of its own ({error})"
        ) from error


class Arithmetic:
    """Autocast, and the scaling of the loss that fp16 needs."""

    def __init__(self, config: LoopConfig, device: torch.device) -> None:
        """Take the precision of a config; bf16 becomes fp32, with a notice, where it is unknown.

        Args:
            config: whose precision is taken.
            device: where networks are.

        Raises:
            InputError: fp16 on a CPU.
        """
        if config.precision == "fp16" and device.type == "cpu":
            raise InputError(
                "precision 'fp16' cannot be used here: it needs a GPU. Take bf16, which a CPU has "
                "too."
            )
        self._device = device.type
        self._type = _TYPES[usable_precision(config.precision, device)]
        self.scaler = torch.amp.GradScaler(self._device, enabled=self._type is torch.float16)

    def autocast(self) -> torch.autocast:
        """Give the context of a forward pass."""
        return torch.autocast(self._device, self._type, enabled=self._type is not None)


def leave_process_group(_: int) -> None:
    """Take a worker out of the job's process group: a signal to the group is for the loop.

    If a worker is killed, the loop ends before it saves its state.
    """
    os.setsid()


class StopRequest:
    """Signals received: whether to stop a training, or to finish it."""

    def __init__(self) -> None:
        self._asked: list[tuple[int, float]] = []

    def remember(self, number: int, _: FrameType | None) -> None:
        """Remember a signal; at the first Ctrl-C print what a second one does."""
        if not self._asked and number == signal.SIGINT:
            os.write(2, _SECOND.encode())  # print may be at work itself
        self._asked.append((number, time.monotonic()))

    def to_stop(self) -> bool:
        """Whether to stop after the step, with the state saved."""
        return bool(self._asked)

    def to_finish(self) -> bool:
        """Whether to take the steps so far for all: Ctrl-C twice. Waits for the second one."""
        presses = [at for number, at in self._asked if number == signal.SIGINT]
        while len(presses) == 1 and time.monotonic() - presses[0] < SECOND_CTRL_C_S:
            time.sleep(0.05)
            presses = [at for number, at in self._asked if number == signal.SIGINT]
        return len(presses) > 1


SECOND_CTRL_C_S = 3.0
"""Between the first Ctrl-C and the second."""
_SECOND = (
    "\ndepthpose: stopping after this step. Press Ctrl-C again within 3 s to finish now: the "
    "weights of the steps so far are written.\n"
)


@contextmanager
def graceful_stop() -> Iterator[StopRequest]:
    """Let SIGTERM and Ctrl-C end the training after the step, with its state saved."""
    request = StopRequest()
    try:
        before = {s: signal.signal(s, request.remember) for s in (signal.SIGTERM, signal.SIGINT)}
    except ValueError:  # not the main thread: whoever runs us handles signals
        before = {}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
