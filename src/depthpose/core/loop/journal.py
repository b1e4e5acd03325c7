"""The run folder: metrics, pictures, TensorBoard, the state to resume from, and the card.

::

    config.yaml        every setting (written by the caller)
    run.json           settings, versions, machine, commit
    metrics.jsonl      one line each log step
    pictures/          what validation drew
    tensorboard/       the same for TensorBoard
    state.pt           the last state: what ``resume`` reads
    state.before.pt    the one before it, read where the last is damaged
"""

import json
import shlex
from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

from depthpose.core.errors import InputError, MissingExtraError
from depthpose.core.files import atomic_write, read_text, remove_parts, write_image
from depthpose.core.files.disk import refused_write
from depthpose.core.files.text import refuse_heavy
from depthpose.core.loop.state import BEFORE, STATE, saved_step, write_state
from depthpose.core.loop.task import ValidationResult
from depthpose.core.run import environment

_METRICS = "metrics.jsonl"
_PICTURES = "pictures"
_MEMORY_OF = {b"{": 250, b",": 60}
_MOST = 2**63
"""A whole number beyond is no count, and none that is shown."""


def run_files(weights: str) -> list[str]:
    """Name what a training leaves in its folder, with weights of this name."""
    own = ["config.yaml", _METRICS, _PICTURES, "tensorboard", STATE, BEFORE]
    return [*own, *(f"{weights}.{ending}" for ending in ("safetensors", "md", "json"))]


class Journal:
    """Writes one run; only the main process of a training has one that writes."""

    def __init__(self, folder: Path, *, is_writer: bool) -> None:
        self.folder = folder
        self._is_writer = is_writer
        self._board: Any = None
        self._has_good_last = True

    def open(self, step: int) -> None:
        """Begin at ``step``: remove what a killed run left: later lines and partial files."""
        if not self._is_writer:
            return
        for folder in (self.folder, self.folder / _PICTURES):
            remove_parts(folder)
        path = self.folder / _METRICS
        kept = [row for row in read_metrics(self.folder) if row["step"] <= step]
        with atomic_write(path) as part:
            part.write_text("".join(json.dumps(row) + "\n" for row in kept))
        try:
            from torch.utils.tensorboard.writer import SummaryWriter
        except ImportError as error:
            raise MissingExtraError("tensorboard", "train", "training") from error
        with refused_write(self.folder):
            self._board = SummaryWriter(str(self.folder / "tensorboard"), purge_step=step + 1)

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Append one line of metrics."""
        if not self._is_writer:
            return
        with refused_write(self.folder / _METRICS):
            with (self.folder / _METRICS).open("a") as file:
                file.write(json.dumps({"step": step, **numbers}) + "\n")
            for name, value in numbers.items():
                self._board.add_scalar(name, value, step)

    def show(self, step: int, result: ValidationResult) -> None:
        """Write what validation found."""
        if not self._is_writer:
            return
        if result.numbers:
            self.log(step, result.numbers)
        for name, picture in result.pictures.items():
            write_image(self.folder / _PICTURES / f"{step:07d}_{name}.png", picture)
            with refused_write(self.folder):
                self._board.add_image(name, picture, step)

    def save(self, state: Mapping[str, Any]) -> None:
        """Write the last state, all or nothing; the one until now becomes the one before."""
        if self._is_writer:
            write_state(self.folder, state, keeps_last=self._has_good_last)
            self._has_good_last = True

    def keep_resumed_state(self, state: Path) -> None:
        """Keep the state that the training was resumed from when the next one is saved."""
        self._has_good_last = state.name == STATE

    def close(self) -> None:
        """Flush what TensorBoard holds back."""
        if self._board is not None:
            with refused_write(self.folder):
                self._board.close()


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
    refuse_heavy(path, text.encode(), _MEMORY_OF)
    for number, line in enumerate(StringIO(text), 1):
        row = _row(line)
        if row is not None:
            rows.append(row)
        elif line.endswith("\n"):
            raise InputError(
                f"{path}: line {number} is no step with numbers. Delete that line, or the file: it "
                "holds curves alone, and no training goes on from it."
            )
    return rows


def _row(line: str) -> dict[str, Any] | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(row, dict) or not all(map(_is_number, row.values())):
        return None
    return row if isinstance(row.get("step"), int) else None


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return isinstance(value, float) or abs(value) < _MOST


_HELD_OUT = "held_out/"
"""Begins the names of numbers that validation found."""


def card_text(name: str, facts: Mapping[str, str], measured: str = "") -> str:
    """Say what weights are, and what was measured of them.

    Args:
        name: of the weights.
        facts: a line each.
        measured: Markdown that follows.
    """
    lines = [f"- **{_as_label(fact)}**: {value}" for fact, value in facts.items()]
    return "\n".join([f"# {name}", "", *lines, *(["", measured.strip()] if measured else []), ""])


def write_card(
    weights: Path, words: str, seconds: float, facts: Mapping[str, str], measured: str
) -> None:
    """Write ``W.md`` beside the weights: what they are, the command, its time, what was measured.

    Args:
        weights: the file, in the folder of its run.
        words: of the command that trains such, as ``depth train view``.
        seconds: what the training took.
        facts: of the weights.
        measured: Markdown; :func:`held_out_text` where validation measured.
    """
    folder, here = weights.parent, environment()
    where = ", ".join(here[name] for name in ("machine", "gpu") if name in here)
    made = {
        "command": f"`depthpose {words} --config config.yaml --out {shlex.quote(folder.name)}`",
        "time": f"{saved_step(folder)} steps in {_duration(seconds)} on {where}; {here['date']}",
    }
    with atomic_write(weights.with_suffix(".md")) as part:
        part.write_text(card_text(weights.stem, {**facts, **made}, measured))


def held_out_text(folder: Path, sentence: str) -> str:
    """Show what the last validation of a run found.

    Args:
        folder: of the run.
        sentence: what was evaluated, and what the numbers mean.
    """
    found = [
        {name: value for name, value in row.items() if name.startswith(_HELD_OUT)}
        for row in read_metrics(folder)
    ]
    found = [numbers for numbers in found if numbers]
    if not found:
        return "Nothing was held out, so nothing was measured."
    rows = [
        f"| {name.removeprefix(_HELD_OUT)} | {value:.4g} |" for name, value in found[-1].items()
    ]
    return "\n".join([sentence, "", "| held out | |", "| --- | --- |", *rows])


def _as_label(name: str) -> str:
    return name.replace("_", " ").capitalize()


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
