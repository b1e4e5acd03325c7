"""The run folder: metrics, pictures, TensorBoard, and the state that a training resumes from.

::

    config.yaml        every knob (written by the caller)
    run.json           settings, versions, machine, commit
    metrics.jsonl      one line each log step
    pictures/          what validation drew
    tensorboard/       the same for TensorBoard
    state.pt           the last state: what ``resume`` reads
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from depthpose.core.checkpoint import read_torch_file
from depthpose.core.errors import InputError, MissingExtraError
from depthpose.core.files import atomic_write, remove_parts, write_image
from depthpose.core.loop.task import Evidence

_STATE = "state.pt"
_METRICS = "metrics.jsonl"
_PICTURES = "pictures"


class Journal:
    """Writes one run; only the main process of a training has one that writes."""

    def __init__(self, folder: Path, *, is_writer: bool) -> None:
        self.folder = folder
        self._is_writer = is_writer
        self._board: Any = None

    def open(self, step: int) -> None:
        """Begin at ``step``: what a kill left behind goes, lines of later steps and half files."""
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
        self._board = SummaryWriter(str(self.folder / "tensorboard"), purge_step=step + 1)

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Append one line of metrics."""
        if not self._is_writer:
            return
        with (self.folder / _METRICS).open("a") as file:
            file.write(json.dumps({"step": step, **numbers}) + "\n")
        for name, value in numbers.items():
            self._board.add_scalar(name, value, step)

    def show(self, step: int, evidence: Evidence) -> None:
        """Write what validation found."""
        if not self._is_writer:
            return
        if evidence.numbers:
            self.log(step, evidence.numbers)
        for name, picture in evidence.pictures.items():
            write_image(self.folder / _PICTURES / f"{step:07d}_{name}.png", picture)
            self._board.add_image(name, picture, step)

    def save(self, state: Mapping[str, Any]) -> None:
        """Write the state in place of the last one, all or nothing."""
        if self._is_writer:
            with atomic_write(self.folder / _STATE) as part:
                torch.save(dict(state), part)

    def close(self) -> None:
        """Flush what TensorBoard holds back."""
        if self._board is not None:
            self._board.close()


def has_state(folder: Path) -> bool:
    """Whether a run of this folder can be resumed."""
    return (folder / _STATE).is_file()


def read_state(folder: Path) -> Mapping[str, Any]:
    """Read the state that :meth:`Journal.save` wrote.

    Raises:
        InputError: damaged, or not ours.
    """
    state = read_torch_file(folder / _STATE)
    missing = {"step", "modules", "optimizers"} - set(state)
    if missing:
        raise InputError(f"{folder / _STATE}: has no {sorted(missing)}; it is no state of a run.")
    return state


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Read the metrics of a run; a last line that a kill cut short is left out."""
    path = folder / _METRICS
    if not path.is_file():
        return []
    rows: list[dict[str, Any]] = []
    for line in path.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except ValueError:
            break
    return rows
