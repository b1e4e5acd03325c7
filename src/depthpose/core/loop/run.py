"""A training's folder: claimed for one config, trained in, resumed or finished."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

from depthpose.core.config import config_to_dict, write_config
from depthpose.core.lock import held_folders, release_folders
from depthpose.core.loop.config import LoopConfig
from depthpose.core.loop.journal import run_files
from depthpose.core.loop.loop import Progress, train
from depthpose.core.loop.task import Samples, Task
from depthpose.core.run import claim_folder, find_rank

_FREE = ("workers", "device", "save_every_steps", "validate_every_steps", "log_every_steps")
"""Settings of the loop that change no weight: a resumed run may have others."""

_Config = TypeVar("_Config")


@dataclass(frozen=True, kw_only=True)
class Run:
    """Folder of a training, and callbacks.

    Attributes:
        folder: the run folder; the weights lie in it, named after what was trained, and their card
            beside them.
        resume: go on from its last state.
        finish: make weights of its last state, without another step.
        on_step: called after each optimiser step.
        on_message: called with each message for the user.
    """

    folder: Path
    resume: bool = False
    finish: bool = False
    on_step: Callable[[Progress], None] | None = None
    on_message: Callable[[str], None] | None = None

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
        decisive = {k: v for k, v in settings["loop"].items() if k not in _FREE}
        settings["loop"] = decisive | {"processes": find_rank().world}
        kept = {k: v for k, v in settings.items() if k not in without}
        files = [file for name in weights for file in run_files(name)]
        remedy = "choose another, or delete this one"
        for path in (self.folder / f"{name}.safetensors" for name in weights):
            if path.is_file():
                option = "--start" if hasattr(config, "start") else "--generator"
                remedy += f"; to train on from its weights, give a new --out and {option} {path}"
        claim_folder(self.folder, kept, files, remedy)
        write_config(self.folder / "config.yaml", config)

    def train(self, task: Task, samples: Samples, config: LoopConfig) -> float:
        """Train in the folder; give the seconds of it, over all its parts.

        Raises:
            InputError: as :func:`depthpose.core.loop.train`.
        """
        return train(
            task,
            samples,
            config,
            self.folder,
            resume=self.resume,
            finish=self.finish,
            on_step=self.on_step,
        )


def releases_folder(stage: Callable[[_Config, Run], Path]) -> Callable[[_Config, Run], Path]:
    """Let other commands into the folder of a training when its weights are written."""

    @wraps(stage)
    def run_stage(config: _Config, run: Run) -> Path:
        before = held_folders()
        try:
            return stage(config, run)
        finally:
            release_folders(but=before)

    return run_stage
