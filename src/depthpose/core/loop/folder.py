"""The files of a training in its folder: metrics, pictures, TensorBoard, states, and the card."""

import json
import os
import shlex
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard
from zipfile import ZipFile

import torch
from torch import Tensor, nn

from depthpose.core.checkpoint import add_terms, list_misfits, read_torch_file
from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError, Notice, import_extra
from depthpose.core.files import atomic_write, read_text, remove_parts, write_image
from depthpose.core.files.disk import refuse_heavy_text, refused_as, refused_write
from depthpose.core.loop.task import TrainingConfig, ValidationResult

STATE = "state.pt"  # the last saved state of a training
STATE_BEFORE = "state.before.pt"  # the one before, in case the last is damaged
_STATE_KEYS = ("step", "modules", "optimizers", "scaler", "average")
_METRICS = "metrics.jsonl"
_PICTURES = "pictures"
RUN_FILES = ("config.yaml", _METRICS, _PICTURES, "tensorboard", STATE, STATE_BEFORE)
"""What a training leaves in its folder beside weights."""
_HELD_OUT = "held_out/"  # begins the names of metrics of the validation
_METRICS_SIGN_BYTES = {b"{": 250, b",": 60}
"""Memory of the Python object that begins with such a sign of the metrics file [bytes]."""


@dataclass(eq=False)
class RunLogger:
    """Writes metrics, pictures and states of a training; only that of the main process does."""

    folder: Path  #: of the training
    _: KW_ONLY
    is_writer: bool  #: whether this is the main process; others write nothing
    is_last_intact: bool = True  #: whether the last state is undamaged, and worth keeping
    board: Any = None  #: TensorBoard's writer, once opened

    def open(self, step: int) -> None:
        """Open the log at ``step``, and remove later metrics and partial files of a killed run."""
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
        """Append the metrics of a step."""
        if not self.is_writer:
            return
        with refused_write(self.folder / _METRICS):
            with (self.folder / _METRICS).open("a") as file:
                file.write(json.dumps({"step": step, **numbers}) + "\n")
            for name, value in numbers.items():
                self.board.add_scalar(name, value, step)

    def show(self, step: int, result: ValidationResult) -> None:
        """Log the metrics and write the images of a validation."""
        if not self.is_writer:
            return
        if result.numbers:
            self.log(step, result.numbers)
        for name, picture in result.pictures.items():
            write_image(self.folder / _PICTURES / f"{step:07d}_{name}.png", picture)
            with refused_write(self.folder):
                self.board.add_image(name, picture, step)

    def save(self, state: Mapping[str, Any]) -> None:
        """Write the last state, whole or not at all, and keep the previous one beside it.

        If that is damaged, the one before it is kept.
        """
        if not self.is_writer:
            return
        encoded = BytesIO()  # in memory, as errors of torch.save do not name a full disk
        torch.save(dict(state), encoded)
        last = self.folder / STATE
        before = self.folder / STATE_BEFORE
        with atomic_write(last) as part:
            part.write_bytes(encoded.getbuffer())
            if self.is_last_intact and last.is_file():
                before.unlink(missing_ok=True)
                try:
                    os.link(last, before)  # not a move, so that there is always a last state
                except OSError:  # a disk without links
                    with suppress(OSError):
                        last.replace(before)
        self.is_last_intact = True

    def close(self) -> None:
        """Close TensorBoard's writer, which then writes what it still holds in memory."""
        if self.board is not None:
            with refused_write(self.folder):
                self.board.close()


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Read the metrics of a training: for each logged step the numbers by name, ``step`` included.

    A last line that a kill cut short is left out.

    Raises:
        InputError: another line is damaged.
    """
    path = folder / _METRICS
    if not path.is_file():
        return []
    rows: list[dict[str, Any]] = []
    text = read_text(path)
    refuse_heavy_text(path, text.encode(), _METRICS_SIGN_BYTES)
    for number, line in enumerate(StringIO(text), 1):
        row = None
        with suppress(ValueError, RecursionError):
            row = json.loads(line)
        if _is_metrics_row(row):
            rows.append(row)
        elif line.endswith("\n"):
            raise InputError(
                f"{path}: line {number} is no step with numbers. Delete that line, or the file: it "
                "holds curves alone, and no training goes on from it."
            )
    return rows


def _is_metrics_row(row: object) -> TypeGuard[dict[str, Any]]:
    """Whether a line of the metrics file is a step and numbers by name."""
    if not isinstance(row, dict) or not isinstance(row.get("step"), int):
        return False
    for value in row.values():
        is_count = type(value) is int and abs(value) < 2**63  # what TensorBoard can show
        if type(value) is not float and not is_count:
            return False
    return True


def format_card(name: str, facts: Mapping[str, str], measured: str = "") -> str:
    """Format a card of weights as Markdown: the name, a line for each fact, then ``measured``."""
    lines = [f"# {name}", ""]
    lines += [f"- **{key.replace('_', ' ').capitalize()}**: {fact}" for key, fact in facts.items()]
    if measured:
        lines += ["", measured.strip()]
    return "\n".join([*lines, ""])


def add_origin(facts: Mapping[str, str], config: TrainingConfig) -> dict[str, str]:
    """Add to the facts of a card the stage and the initial weights, whose terms bind the new ones.

    Args:
        facts: for the card of trained weights.
        config: of their training.
    """
    origin = {**facts, "stage": type(config).__name__}
    initial_weights = config.initial_weights.values()
    if initial_weights:
        origin["began_with"] = ", ".join(Path(name).stem for name in initial_weights)
    return add_terms(origin, initial_weights)


def write_card(
    weights: Path, words: str, seconds: float, facts: Mapping[str, str], measured: str
) -> None:
    """Write the card of trained weights, ``NAME.md`` beside their file.

    Args:
        weights: the file of the weights, in the folder of the training.
        words: words of the command, such as ``depth train view``.
        seconds: duration of the training.
        facts: facts for the card, besides the command and the time.
        measured: Markdown of what was measured, such as :func:`format_last_validation`.
    """
    folder = weights.parent
    versions = describe_environment()
    machine = ", ".join(versions[name] for name in ("machine", "gpu") if name in versions)
    step = 0  # step of the last state that is not damaged, which is read last
    for path in reversed(list_saved_states(folder)):
        with suppress(InputError):
            step = _read_state(path)["step"]
    duration = _describe_duration(seconds)
    record = {
        "command": f"`depthpose {words} --config config.yaml --out {shlex.quote(folder.name)}`",
        "time": f"{step} steps in {duration} on {machine}; {versions['date']}",
    }
    with atomic_write(weights.with_suffix(".md")) as part:
        part.write_text(format_card(weights.stem, {**facts, **record}, measured))


def _describe_duration(seconds: float) -> str:
    """Format a duration in seconds, minutes or hours."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def format_last_validation(folder: Path, sentence: str) -> str:
    """Format the metrics of a training's last validation as a Markdown table.

    Args:
        folder: folder of the training.
        sentence: stands above the table: what was validated on, and what the numbers mean.
    """
    last_metrics: dict[str, float] = {}
    for row in read_metrics(folder):
        metrics = {name: value for name, value in row.items() if name.startswith(_HELD_OUT)}
        last_metrics = metrics or last_metrics
    if not last_metrics:
        return "Nothing was held out, so nothing was measured."
    lines = [
        f"| {name.removeprefix(_HELD_OUT)} | {value:.4g} |" for name, value in last_metrics.items()
    ]
    return "\n".join([sentence, "", "| held out | |", "| --- | --- |", *lines])


@dataclass(frozen=True, kw_only=True, eq=False)
class Parts:
    """The parts of a training that its steps change, and that a saved state holds."""

    modules: Mapping[str, nn.Module]  #: networks by name
    optimizers: Mapping[str, Any]  #: optimisers by name
    scaler: torch.amp.GradScaler  #: its state is empty except in fp16
    average: Mapping[str, dict[str, Tensor]]  #: moving averages of weights, by network and tensor

    def collect_state(self) -> dict[str, Any]:
        """Collect the states of all parts, for saving."""
        return {
            "modules": {name: module.state_dict() for name, module in self.modules.items()},
            "optimizers": {name: adam.state_dict() for name, adam in self.optimizers.items()},
            "scaler": self.scaler.state_dict(),
            "average": dict(self.average),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Load a saved state into all parts.

        Raises:
            InputError: tensors do not fit; the first ones are named.
        """
        problems = self._list_misfits(state)
        for name, optimizer in self.optimizers.items():
            problems += _restore_optimizer(name, optimizer, state["optimizers"][name])
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

    def _list_misfits(self, state: Mapping[str, Any]) -> list[str]:
        """List the tensors of a saved state that do not fit the networks and averages."""
        present = self.collect_state()
        problems: list[str] = []
        for prefix, part in (("", "modules"), ("average of ", "average")):
            for name, tensors in present[part].items():
                problems += [
                    f"{prefix}{name}: {fault}" for fault in list_misfits(tensors, state[part][name])
                ]
        return problems


def _restore_optimizer(
    name: str, optimizer: torch.optim.Optimizer, saved: dict[str, Any]
) -> list[str]:
    """Load the saved state of an optimiser, and list its tensors that do not fit the parameters."""
    counts = [len(group["params"]) for group in optimizer.param_groups]
    saved_counts = [len(group["params"]) for group in saved["param_groups"]]
    if counts != saved_counts:
        return [
            f"optimiser of {name}: it moved groups of {saved_counts} parameters, not of {counts}"
        ]
    # Loaded first, because the saved tensors are then listed by parameter.
    optimizer.load_state_dict(saved)
    problems: list[str] = []
    for number, (parameter, values) in enumerate(optimizer.state.items()):
        for key, value in values.items():
            if value.ndim and value.shape != parameter.shape:
                problems.append(
                    f"optimiser of {name}: {key} of parameter {number} is {tuple(value.shape)}, "
                    f"not {tuple(parameter.shape)}"
                )
    return problems


def list_saved_states(folder: Path) -> list[Path]:
    """List the files of saved states in a folder, the last one first."""
    paths = [folder / STATE, folder / STATE_BEFORE]
    return [path for path in paths if path.is_file()]


class RestoredState(NamedTuple):
    """What is known of a state that was restored."""

    path: Path  #: its file
    step: int  #: steps until then
    seconds: float  #: duration of the training until then


def restore_last(folder: Path, parts: Parts) -> RestoredState:
    """Restore the last state that is not damaged.

    Args:
        folder: folder of the training.
        parts: what the state is loaded into.

    Raises:
        InputError: all states are damaged or of another network.

    Warns:
        Notice: the last state is damaged, and the one before is taken.
    """
    damages: list[str] = []
    for path in list_saved_states(folder):
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
        return RestoredState(path=path, step=step, seconds=seconds)
    raise InputError(
        f"{'; '.join(damages)}; no state is left to go on from. Take another folder, whose "
        "training may 'start' from weights, or delete these states to begin anew"
    )


def _read_state(path: Path) -> Mapping[str, Any]:
    """Read a saved state, and check its checksums and that it has all parts."""
    with refused_as(path, "state of a training", "it is damaged"), ZipFile(path) as archive:
        damaged_part = archive.testzip()  # torch itself ignores flipped bits
        if damaged_part is not None:
            raise ValueError(f"{damaged_part} is not as it was written")
    state = read_torch_file(path)
    missing = [key for key in _STATE_KEYS if key not in state]
    if missing:
        raise InputError(f"{path}: has no {missing}, so it is no state of a training")
    step = state["step"]
    if not isinstance(step, int) or isinstance(step, bool) or step < 0:
        raise InputError(f"{path}: its step is {step!r}, where a whole number belongs")
    return state
