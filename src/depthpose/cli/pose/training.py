"""``depthpose pose train``."""

import dataclasses
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from depthpose.cli.help import group
from depthpose.cli.options import TrainingOptions, changed
from depthpose.cli.training import progress_bar, say_trained
from depthpose.core.errors import InputError
from depthpose.core.units import Unit

if TYPE_CHECKING:
    from depthpose.pose.train import PoseTraining

_START = "parts"
"""The weights that ship and may go with any licence."""

_NOTHING = "nothing"
"""The word for no weights."""


@group
class LearntOptions:
    """What is learnt, and from what."""

    cad: tuple[str, ...] = ()
    """model files; one network learns them all."""
    unit: Unit | None = None
    """of the numbers in the files."""
    symmetries: Literal["none", "found"] | None = None
    """found: detect symmetries of the part and count equivalent poses as one; by default they are
    only printed."""
    data: str | None = None
    """folder of a data set; it takes the place of the config's, for models and frames."""
    what: Literal["pose", "segmentation", "depth-image", "pointnet"] = "pose"
    """pose: the network of directions; segmentation: the masks for it; depth-image and pointnet:
    baselines."""
    start: str | None = None
    """weights to begin with, by name or file. A CAD file without a config begins with 'parts';
    'nothing' begins anew and takes twice the steps."""

    def default(self) -> "PoseTraining | None":
        """Give the settings of a training without a config, where they are not the network's."""
        from depthpose.pose.train.config import own_part

        is_own = self.what == "pose" and self.cad and self.start != _NOTHING
        return own_part(self.start or _START) if is_own else None

    def applied(self, chosen: Any) -> Any:  # noqa: ANN401 - any config of a training
        """Give the config of a training with these."""
        if self.start is not None:
            start = None if self.start == _NOTHING else self.start
            chosen = dataclasses.replace(chosen, start=start)
        if self.cad or self.unit or self.symmetries:
            chosen = dataclasses.replace(chosen, models=self._models(chosen))
        return chosen if self.data is None else _with_data(chosen, self.data)

    def _models(self, chosen: Any) -> Any:  # noqa: ANN401 - any config of a training
        if self.what == "segmentation":
            raise InputError(
                "--cad has no meaning for 'segmentation', which learns from pictures: make them by "
                "'depthpose data make objects --cad ...' and name the folder in the config"
            )
        taken = changed(chosen.models, cad=self.cad or None, unit=self.unit)
        if self.cad:  # they take the place of a data set's models
            taken = dataclasses.replace(taken, bop=None, objects=(), parts=())
        found = None if self.symmetries is None else self.symmetries == "found"
        return changed(taken, with_found_symmetries=found)


def train(
    out: Path,
    config: Path | None = None,
    learnt: LearntOptions = LearntOptions(),
    workers: int | None = None,
    training: TrainingOptions = TrainingOptions(),
) -> int:
    """Train a network on your CAD file, or by a config.

    Views of the object are rendered while it trains: no photograph is needed. At the end the
    whole is measured on held-out views; OUT holds the weights with the model in them, their card,
    config, metrics and states. A training that stopped goes on with
    --resume; --finish, or Ctrl-C twice, writes weights of the steps so far. Without a terminal a
    line is printed each minute.

        depthpose pose train --cad part.stl --unit mm --out my_part
        depthpose pose predict --cloud scan.ply --unit mm --weights my_part/pose.safetensors ...

    Args:
        out: the run folder.
        config: YAML with what differs from the defaults.
        workers: processes that render views beside the one that trains.
    """
    from depthpose.core.loop import Run
    from depthpose.core.run import find_rank
    from depthpose.pose.mesh import unit_of
    from depthpose.pose.train import STAGES

    kind, run_stage = STAGES[learnt.what]
    chosen = training.read(config, kind, default=learnt.default(), workers=workers)
    for path in learnt.cad:
        unit_of(path, learnt.unit)
    chosen = learnt.applied(chosen)
    is_first = find_rank().rank == 0
    with progress_bar(training.view) as on_step:
        on_message = partial(print, flush=True) if is_first else None
        run = Run(
            folder=out,
            resume=training.resume,
            finish=training.finish,
            on_step=on_step,
            on_message=on_message,
        )
        path = run_stage(chosen, run)
    if is_first:
        say_trained(path)
    return 0


def _with_data(chosen: Any, data: str) -> Any:  # noqa: ANN401 - any config of a training
    """Name the data set wherever the config names one."""
    changes = {}
    if (models := getattr(chosen, "models", None)) is not None and models.bop is not None:
        changes["models"] = dataclasses.replace(models, bop=data)
    for part in ("frames", "images", "held_out"):
        if hasattr(getattr(chosen, part, None), "folder"):
            changes[part] = dataclasses.replace(getattr(chosen, part), folder=data)
    if not changes:
        raise InputError(f"--data {data}: the config learns from no data set; see --cad and --what")
    return dataclasses.replace(chosen, **changes)
