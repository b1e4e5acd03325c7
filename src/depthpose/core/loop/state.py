"""The last two states of a training: written whole, and checked before one is used.

``state.pt`` is the last, ``state.before.pt`` the one before it.
"""

import os
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import ZipFile

import torch
from torch import Tensor, nn

from depthpose.core.checkpoint import misfits, read_torch_file
from depthpose.core.errors import InputError, Notice
from depthpose.core.files import atomic_write
from depthpose.core.files.disk import refused_as

_NEEDED = ("step", "modules", "optimizers", "scaler", "average")
STATE, BEFORE = "state.pt", "state.before.pt"


def saved_states(folder: Path) -> list[Path]:
    """List the states that a folder holds, the last one first."""
    return [path for name in (STATE, BEFORE) if (path := folder / name).is_file()]


def saved_step(folder: Path) -> int:
    """Give the step of the last state that is whole; 0 where there is none."""
    for path in saved_states(folder):
        with suppress(InputError):
            return _read_state(path)["step"]
    return 0


def write_state(folder: Path, state: Mapping[str, Any], *, keeps_last: bool) -> None:
    """Write the last state, all or nothing.

    Args:
        folder: of the run.
        state: tensors, numbers and containers of these.
        keeps_last: the last state until now becomes the one before; else that one stays.

    Raises:
        InputError: the disk refuses.
    """
    packed = BytesIO()  # on a full disk torch.save would say anything but that
    torch.save(dict(state), packed)
    with atomic_write(folder / STATE) as part:
        part.write_bytes(packed.getbuffer())
        if keeps_last and (folder / STATE).is_file():
            _keep(folder / STATE, folder / BEFORE)


@dataclass(frozen=True, kw_only=True, eq=False)
class Parts:
    """What a state is of: everything of a training that its steps change.

    Attributes:
        modules: networks by name.
        optimizers: with the averages of gradients that they keep, by name.
        scaler: of the loss; its state is empty but in fp16.
        average: moving averages of the networks' tensors, where there are any.
    """

    modules: Mapping[str, nn.Module]
    optimizers: Mapping[str, Any]
    scaler: torch.amp.GradScaler
    average: Mapping[str, dict[str, Tensor]]

    def state(self) -> dict[str, Any]:
        """Give what is written."""
        return {
            "modules": {name: module.state_dict() for name, module in self.modules.items()},
            "optimizers": {name: adam.state_dict() for name, adam in self.optimizers.items()},
            "scaler": self.scaler.state_dict(),
            "average": dict(self.average),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take everything from a state that fits."""
        for name, module in self.modules.items():
            module.load_state_dict(state["modules"][name])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        if self.scaler.is_enabled() and state["scaler"]:
            self.scaler.load_state_dict(state["scaler"])
        for name, held in self.average.items():
            for key, tensor in state["average"][name].items():
                held[key].copy_(tensor)

    def misfits(self, state: Mapping[str, Any]) -> list[str]:
        """Say what a state has missing, more, or in another shape."""
        problems: list[str] = []
        for name, module in self.modules.items():
            problems += _named(name, misfits(module.state_dict(), state["modules"][name]))
        for name, held in self.average.items():
            problems += _named(f"average of {name}", misfits(held, state["average"][name]))
        for name, optimizer in self.optimizers.items():
            found = _optimizer_misfits(optimizer.param_groups, state["optimizers"][name])
            problems += _named(f"optimiser of {name}", found)
        return problems


class Restored(NamedTuple):
    """Where a training goes on: the state that was taken, its step, the time until then."""

    path: Path
    step: int
    seconds: float


def restore_last(folder: Path, parts: Parts) -> Restored:
    """Go on from the last state, or, where it is damaged, with a notice from the one before it.

    Raises:
        InputError: no state is whole and of this training; each is explained.
    """
    damages: list[str] = []
    for path in saved_states(folder):
        try:
            found = _restore(path, parts)
        except InputError as error:
            damages.append(str(error))
            continue
        if path.name != STATE:
            reason = "; ".join(damages) or f"{folder}: there is no {STATE}"
            notice = f"{reason}; the training goes on from {path.name}, step {found.step}"
            warnings.warn(notice, Notice, stacklevel=2)
        return found
    raise InputError(
        f"{'; '.join(damages)}; no state is left to go on from. Take another folder, whose "
        "training may 'start' from weights, or delete these states to begin anew"
    )


def _restore(path: Path, parts: Parts) -> Restored:
    state = _read_state(path)
    with refused_as(path, "state of this training", "it is damaged, or of another training"):
        if problems := parts.misfits(state):
            raise InputError(
                f"{path}: {len(problems)} tensors do not fit this network: "
                f"{', '.join(problems[:3])}; it is the state of another one"
            )
        parts.restore(state)
        seconds = float(state.get("seconds", 0.0))  # older states do not know it
    return Restored(path, state["step"], seconds)


def _read_state(path: Path) -> Mapping[str, Any]:
    with refused_as(path, "state of a training", "it is damaged"), ZipFile(path) as archive:
        if (part := archive.testzip()) is not None:  # torch reads over flipped bits
            raise ValueError(f"{part} is not as it was written")
    state = read_torch_file(path)
    if missing := [name for name in _NEEDED if name not in state]:
        raise InputError(f"{path}: has no {missing}, so it is no state of a training")
    step = state["step"]
    if not isinstance(step, int) or isinstance(step, bool) or step < 0:
        raise InputError(f"{path}: its step is {step!r}, where a whole number belongs")
    return state


def _keep(last: Path, before: Path) -> None:
    """Name the last state a second time, so that there is one of its name at any moment."""
    before.unlink(missing_ok=True)
    try:
        os.link(last, before)
    except OSError:  # a disk without links
        with suppress(OSError):
            last.replace(before)


def _named(owner: str, problems: Sequence[str]) -> list[str]:
    return [f"{owner}: {problem}" for problem in problems]


def _optimizer_misfits(groups: Sequence[Mapping[str, Any]], given: Mapping[str, Any]) -> list[str]:
    """Say which averages of gradients have not the shape of their parameter."""
    counts = [len(group["params"]) for group in groups]
    held = [len(group["params"]) for group in given["param_groups"]]
    if counts != held:
        return [f"it moved groups of {held} parameters, not of {counts}"]
    parameters: list[Tensor] = [p for group in groups for p in group["params"]]
    return [
        f"{key} of parameter {k} is {tuple(value.shape)}, not {tuple(parameters[k].shape)}"
        for k, values in given["state"].items()
        for key, value in values.items()
        if isinstance(value, Tensor) and value.ndim and value.shape != parameters[k].shape
    ]
