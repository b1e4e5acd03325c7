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

_PRECISIONS = {"fp32": "no", "bf16": "bf16", "fp16": "fp16"}


def make_accelerator(config: LoopConfig) -> Any:  # noqa: ANN401 - accelerate is an extra
    """Bring up accelerate with the device and precision of a config.

    bf16 becomes fp32, with a notice, on a processor without it.

    Raises:
        MissingExtraError: accelerate is not installed.
        InputError: the precision needs a GPU.
    """
    try:
        from accelerate import Accelerator
        from accelerate.state import AcceleratorState
        from accelerate.utils import InitProcessGroupKwargs
    except ImportError as error:
        raise MissingExtraError("accelerate", "train", "training") from error
    # A second training of this process may have another precision; accelerate keeps the first.
    AcceleratorState._reset_state()
    # The others wait while rank 0 looks at the held-out samples.
    precision = usable_precision(config.precision, _device(config))
    patience = InitProcessGroupKwargs(timeout=timedelta(hours=2))
    accelerator = Accelerator(
        cpu=config.device == "cpu",
        mixed_precision=_PRECISIONS[precision],
        kwargs_handlers=[patience],
    )
    if config.precision == "fp16" and accelerator.scaler is None:
        raise InputError(
            "precision 'fp16' cannot be used here: it needs a GPU. Take bf16, which a CPU has too."
        )
    return accelerator


def _device(config: LoopConfig) -> torch.device:
    """Give what accelerate will choose."""
    is_accelerated = config.device != "cpu" and torch.accelerator.is_available()
    found = torch.accelerator.current_accelerator() if is_accelerated else None
    return found or torch.device("cpu")


def leave_signals_to_the_loop(_: int) -> None:
    """Take a worker out of the job's process group: a signal to the group is for the loop.

    A worker that dies takes the loop with it before its state is saved.
    """
    os.setsid()


class Wish:
    """What whoever runs a training asked it to do, by signals."""

    def __init__(self) -> None:
        self._asked: list[tuple[int, float]] = []

    def remember(self, number: int, _: FrameType | None) -> None:
        """Take a signal; the first Ctrl-C is told what a second one does."""
        if not self._asked and number == signal.SIGINT:
            os.write(2, _SECOND.encode())  # print may be at work itself
        self._asked.append((number, time.monotonic()))

    def to_stop(self) -> bool:
        """Whether to stop after the step, with the state saved."""
        return bool(self._asked)

    def to_finish(self) -> bool:
        """Whether to take the steps so far for all: Ctrl-C twice. Waits for the second one."""
        presses = [at for number, at in self._asked if number == signal.SIGINT]
        while len(presses) == 1 and time.monotonic() - presses[0] < PATIENCE_S:
            time.sleep(0.05)
            presses = [at for number, at in self._asked if number == signal.SIGINT]
        return len(presses) > 1


PATIENCE_S = 3.0
"""Between the first Ctrl-C and the second."""
_SECOND = (
    "\ndepthpose: stopping after this step. Press Ctrl-C again within 3 s to finish now: what "
    "follows the last step is done, and the weights are written.\n"
)


@contextmanager
def polite_stop() -> Iterator[Wish]:
    """Let SIGTERM and Ctrl-C end the training after the step, with its state saved."""
    wish = Wish()
    try:
        before = {s: signal.signal(s, wish.remember) for s in (signal.SIGTERM, signal.SIGINT)}
    except ValueError:  # not the main thread: whoever runs us handles signals
        before = {}
    try:
        yield wish
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
