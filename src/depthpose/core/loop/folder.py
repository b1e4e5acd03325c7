"""The run folder: metrics, pictures, TensorBoard, the states to resume from, and the card."""

import json
import os
import shlex
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import torch
from torch import Tensor, nn

from depthpose.core.checkpoint import misfits, read_torch_file
from depthpose.core.errors import InputError, Notice, import_extra
from depthpose.core.files import atomic_write, read_text, remove_parts, write_image
from depthpose.core.files.disk import refuse_heavy, refused_as, refused_write
from depthpose.core.loop.task import ValidationResult
from depthpose.core.run import environment

# the last, and the one before, if that is damaged
STATE = "state.pt"
BEFORE = "state.before.pt"
_NEEDED = ("step", "modules", "optimizers", "scaler", "average")
_METRICS = "metrics.jsonl"
_PICTURES = "pictures"
RUN_FILES = ("config.yaml", _METRICS, _PICTURES, "tensorboard", STATE, BEFORE)
"""What a training leaves in its folder beside weights."""
_HELD_OUT = "held_out/"  # begins the names of numbers that validation found


@dataclass(eq=False)
class RunLogger:
    """Writes one run; only the main process of a training has one that writes."""

    folder: Path
    _: KW_ONLY
    is_writer: bool
    has_good_last: bool = True  #: else the state before it is kept when the next is saved
    board: Any = None  #: TensorBoard's, once opened

    def open(self, step: int) -> None:
        """Begin at ``step``: remove what a killed run left: later lines and partial files."""
        if not self.is_writer:
            return
        for folder in (self.folder, self.folder / _PICTURES):
            remove_parts(folder)
        earlier = [row for row in read_metrics(self.folder) if row["step"] <= step]
        with atomic_write(self.folder / _METRICS) as part:
            part.write_text("".join(json.dumps(row) + "\n" for row in earlier))
        import_extra("tensorboard", "tensorboard", "train", "training")
        from torch.utils.tensorboard.writer import SummaryWriter

        with refused_write(self.folder):
            self.board = SummaryWriter(str(self.folder / "tensorboard"), purge_step=step + 1)

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Append one line of metrics."""
        if not self.is_writer:
            return
        with refused_write(self.folder / _METRICS):
            with (self.folder / _METRICS).open("a") as file:
                file.write(json.dumps({"step": step, **numbers}) + "\n")
            for name, value in numbers.items():
                self.board.add_scalar(name, value, step)

    def show(self, step: int, result: ValidationResult) -> None:
        """Write what validation found."""
        if not self.is_writer:
            return
        if result.numbers:
            self.log(step, result.numbers)
        for name, picture in result.pictures.items():
            write_image(self.folder / _PICTURES / f"{step:07d}_{name}.png", picture)
            with refused_write(self.folder):
                self.board.add_image(name, picture, step)

    def save(self, state: Mapping[str, Any]) -> None:
        """Write the last state, all or nothing; the previous one is kept beside it."""
        if not self.is_writer:
            return
        packed = BytesIO()  # on a full disk torch.save would say anything but that
        torch.save(dict(state), packed)
        last = self.folder / STATE
        before = self.folder / BEFORE
        with atomic_write(last) as part:
            part.write_bytes(packed.getbuffer())
            if self.has_good_last and last.is_file():
                before.unlink(missing_ok=True)
                try:
                    os.link(last, before)  # a second name: there is a last state at any moment
                except OSError:  # a disk without links
                    with suppress(OSError):
                        last.replace(before)
        self.has_good_last = True

    def close(self) -> None:
        """Flush what TensorBoard holds back."""
        if self.board is not None:
            with refused_write(self.folder):
                self.board.close()


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Read the metrics of a run; a last line that a kill cut short is left out.

    Raises:
        InputError: another line is damaged: no step and numbers by name.
    """
    path = folder / _METRICS
    if not path.is_file():
        return []
    rows: list[dict[str, Any]] = []
    text = read_text(path)
    refuse_heavy(path, text.encode(), {b"{": 250, b",": 60})  # bytes of memory
    for number, line in enumerate(StringIO(text), 1):
        row = None
        with suppress(ValueError, RecursionError):
            row = json.loads(line)
        if (
            isinstance(row, dict)
            and isinstance(row.get("step"), int)
            # A whole number of 2**63 and beyond is no count, and none that is shown.
            and all(type(v) is float or (type(v) is int and abs(v) < 2**63) for v in row.values())
        ):
            rows.append(row)
        elif line.endswith("\n"):
            raise InputError(
                f"{path}: line {number} is no step with numbers. Delete that line, or the file: it "
                "holds curves alone, and no training goes on from it."
            )
    return rows


def card_text(name: str, facts: Mapping[str, str], measured: str = "") -> str:
    """Say what weights of this name are, a line a fact, and in Markdown what was measured."""
    lines = [f"- **{key.replace('_', ' ').capitalize()}**: {value}" for key, value in facts.items()]
    return "\n".join([f"# {name}", "", *lines, *(["", measured.strip()] if measured else []), ""])


def write_card(
    weights: Path, words: str, seconds: float, facts: Mapping[str, str], measured: str
) -> None:
    """Write ``W.md`` beside the weights: what they are, the command, its time, what was measured.

    ``words`` are those of the command, as ``depth train view``; ``measured`` is Markdown, as
    :func:`held_out_text` where validation measured.
    """
    folder = weights.parent
    versions = environment()
    machine = ", ".join(versions[name] for name in ("machine", "gpu") if name in versions)
    took = f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
    took = took if seconds < 7200 else f"{seconds / 3600:.1f} h"
    step = 0  # of the last state that is whole
    for path in reversed(saved_states(folder)):
        with suppress(InputError):
            step = _read_state(path)["step"]
    record = {
        "command": f"`depthpose {words} --config config.yaml --out {shlex.quote(folder.name)}`",
        "time": f"{step} steps in {took} on {machine}; {versions['date']}",
    }
    with atomic_write(weights.with_suffix(".md")) as part:
        part.write_text(card_text(weights.stem, {**facts, **record}, measured))


def held_out_text(folder: Path, sentence: str) -> str:
    """Describe a run's last validation; ``sentence``: of what, and what the numbers mean."""
    lines: list[str] = []
    for row in read_metrics(folder):
        measured = {k: value for k, value in row.items() if k.startswith(_HELD_OUT)}
        if measured:
            lines = [f"| {k.removeprefix(_HELD_OUT)} | {v:.4g} |" for k, v in measured.items()]
    if not lines:
        return "Nothing was held out, so nothing was measured."
    return "\n".join([sentence, "", "| held out | |", "| --- | --- |", *lines])


@dataclass(frozen=True, kw_only=True, eq=False)
class Parts:
    """Everything of a training that its steps change, by name: what a saved state holds."""

    modules: Mapping[str, nn.Module]
    optimizers: Mapping[str, Any]
    scaler: torch.amp.GradScaler  # its state is empty but in fp16
    average: Mapping[str, dict[str, Tensor]]  # moving averages of the weights

    def state(self) -> dict[str, Any]:
        """Give what is written."""
        return {
            "modules": {name: module.state_dict() for name, module in self.modules.items()},
            "optimizers": {name: adam.state_dict() for name, adam in self.optimizers.items()},
            "scaler": self.scaler.state_dict(),
            "average": dict(self.average),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over a state; one that does not fit is refused with what differs."""
        present = self.state()
        problems = [
            f"{words}{key}: {fault}"
            for words, name in (("", "modules"), ("average of ", "average"))
            for key, tensors in present[name].items()
            for fault in misfits(tensors, state[name][key])
        ]
        for name, optimizer in self.optimizers.items():
            saved = state["optimizers"][name]
            counts = [len(group["params"]) for group in optimizer.param_groups]
            saved_counts = [len(group["params"]) for group in saved["param_groups"]]
            if counts != saved_counts:
                problems.append(
                    f"optimiser of {name}: it moved groups of {saved_counts} parameters, not of "
                    f"{counts}"
                )
                continue
            optimizer.load_state_dict(saved)
            problems += [
                f"optimiser of {name}: {key} of parameter {k} is {tuple(value.shape)}, not "
                f"{tuple(parameter.shape)}"
                for k, (parameter, values) in enumerate(optimizer.state.items())
                for key, value in values.items()
                if value.ndim and value.shape != parameter.shape
            ]
        if problems:
            raise InputError(
                f"{len(problems)} tensors do not fit this network: {', '.join(problems[:3])}; it "
                "is the state of another one"
            )
        for name, module in self.modules.items():
            module.load_state_dict(state["modules"][name])
        for name, tensors in self.average.items():
            for key, tensor in tensors.items():
                tensor.copy_(state["average"][name][key])
        if self.scaler.is_enabled() and state["scaler"]:
            self.scaler.load_state_dict(state["scaler"])


def saved_states(folder: Path) -> list[Path]:
    """List the saved states of a folder, the last one first."""
    return [path for name in (STATE, BEFORE) if (path := folder / name).is_file()]


def restore_last(folder: Path, parts: Parts) -> tuple[Path, int, float]:
    """Restore the last state that is intact; give its path, step and seconds of training."""
    damages: list[str] = []
    for path in saved_states(folder):
        try:
            state = _read_state(path)
            remedy = "it is damaged, or of another training"
            with refused_as(path, "state of this training", remedy):
                parts.restore(state)
                step = state["step"]
                seconds = float(state.get("seconds", 0.0))
        except InputError as error:
            message = str(error)
            damages.append(message if message.startswith(str(path)) else f"{path}: {message}")
            continue
        if path.name != STATE:
            reason = "; ".join(damages) or f"{folder}: there is no {STATE}"
            notice = f"{reason}; the training goes on from {path.name}, step {step}"
            warnings.warn(notice, Notice, stacklevel=2)
        return path, step, seconds
    raise InputError(
        f"{'; '.join(damages)}; no state is left to go on from. Take another folder, whose "
        "training may 'start' from weights, or delete these states to begin anew"
    )


def _read_state(path: Path) -> Mapping[str, Any]:
    """Read a saved state of a training whose checksums are right and which has all parts."""
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
