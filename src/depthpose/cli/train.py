"""``depthpose depth train``, ``depth calibrate`` and ``pose train``, and their progress."""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import tyro

from depthpose.cli.arguments import (
    Device,
    NewPath,
    Source,
    WeightsName,
    replace_unless_none,
)
from depthpose.core.errors import InputError
from depthpose.core.units import Unit
from depthpose.depth.config import MatcherConfig

if TYPE_CHECKING:  # --help must not load torch
    from tqdm import tqdm

    from depthpose.core.loop import Progress, TrainingConfig
    from depthpose.pose.train.config import SegmentationTraining, ViewsTraining

    _PoseConfig = ViewsTraining | SegmentationTraining

_Config = TypeVar("_Config", bound="TrainingConfig")


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """The length of a training, its machine, and the state that it starts from."""

    steps: int | None = None
    """optimiser steps in place of the config's length."""
    seed: int | None = None
    """decides initial weights, order, random changes and dropout."""
    device: Literal["auto", "cpu"] | None = None
    """auto takes what accelerate finds; cpu takes no GPU."""
    precision: Literal["fp32", "bf16", "fp16"] | None = None
    """arithmetic of the forward pass."""
    resume: bool = False
    """go on from the state that OUT holds."""
    finish: bool = False
    """write weights and card of the state that OUT holds, without another step; Ctrl-C twice does
    the same while it trains."""

    def read(
        self,
        path: Path | None,
        kind: type[_Config],
        default: _Config | None = None,
        workers: int | None = None,
    ) -> _Config:
        """Read the config of a training, or take its defaults, and apply these options.

        Args:
            path: of the config; None: ``default``.
            kind: class of the config.
            default: an instance of it; None: one with its own defaults.
            workers: processes that render views; None: as the config says.
        """
        from depthpose.core.config import read_config

        config = (default or kind()) if path is None else read_config(path, kind)
        self._refuse_long_warmup(config)
        loop = replace_unless_none(
            config.loop,
            workers=workers,
            seed=self.seed,
            device=self.device,
            precision=self.precision,
        )
        if self.steps is not None:
            loop = replace(loop, steps=self.steps, epochs=None)
        return replace(config, loop=loop)

    def _refuse_long_warmup(self, config: "TrainingConfig") -> None:
        """Refuse a warm-up that is longer than the training, whose rate would never be reached.

        A training of few steps in place of the config's (``--steps 20``) is a trial, and may end
        within the warm-up; so may one that is resumed.
        """
        from depthpose.core.loop import AdamConfig

        config_steps = config.loop.steps  # None where they follow from epochs
        if config_steps is None or self.resume or self.finish:
            return
        steps = max(config_steps, self.steps or 0)
        for name, adam in vars(config).items():
            if isinstance(adam, AdamConfig) and adam.warmup_steps > steps:
                raise InputError(
                    f"{name}.warmup_steps is {adam.warmup_steps}, but loop.steps is {steps}, "
                    "so the learning rate would never be reached; take at most "
                    f"{steps}, or 0 for no warm-up"
                )

    def run(
        self,
        run_stage: Callable[[Any, Any], Path],
        config: object,
        out: Path,
        *,
        with_messages: bool = False,
    ) -> int:
        """Train, show the progress, and print the path of the weights and their card.

        Args:
            run_stage: trains by a config and a ``TrainingRun``, and returns the weights file.
            config: config of the training.
            out: the run folder.
            with_messages: print what the training reports besides its progress.

        Returns:
            The exit code.
        """
        from tqdm import tqdm

        from depthpose.core.loop import TrainingRun
        from depthpose.core.processes import find_rank

        is_first = find_rank().rank == 0  # other processes never show a step
        is_logged = is_first and not (sys.stdout.isatty() and sys.stderr.isatty())
        log = ProgressLog() if is_logged else None
        with tqdm(unit=" steps", disable=None if is_first else True) as bar:
            run = TrainingRun(
                folder=out,
                resume=self.resume,
                finish=self.finish,
                on_step=partial(_show_progress, bar, log),
                on_message=partial(print, flush=True) if with_messages and is_first else None,
            )
            path = run_stage(config, run)
        if is_first:
            print(f"trained weights: {path}")
            card = path.with_suffix(".md")
            print(card.read_text() if card.is_file() else "", end="")
        return 0


@dataclass(kw_only=True)
class ProgressLog:
    """Prints the first step, the last one, and a line a minute between them."""

    interval_s: float = 60.0  #: least time between two lines
    clock: Callable[[], float] = time.monotonic  #: tells the time [s]
    first_step: int | None = None  #: the first step that was shown; None: none was
    first_s: float = 0.0  #: when it was shown
    printed_s: float = 0.0  #: when the last line was printed
    numbers: dict[str, float] = field(default_factory=dict)  #: the latest losses and metrics

    def show(self, progress: "Progress") -> None:
        """Print a line if one is due: step, minutes left, and the latest numbers."""
        now_s = self.clock()
        self.numbers = progress.numbers or self.numbers
        if self.first_step is None:
            self.first_step = progress.step
            self.first_s = now_s
        elif progress.step < progress.steps and now_s - self.printed_s < self.interval_s:
            return
        self.printed_s = now_s
        parts = [f"step {progress.step} of {progress.steps}"]
        if self.first_step < progress.step < progress.steps:
            s_per_step = (now_s - self.first_s) / (progress.step - self.first_step)
            left_s = (progress.steps - progress.step) * s_per_step
            parts.append(f"{left_s / 60:.0f} min left")
        parts += [f"{name} {value:.4g}" for name, value in self.numbers.items()]
        print(", ".join(parts), flush=True)


def _show_progress(bar: "tqdm[Any]", log: ProgressLog | None, progress: "Progress") -> None:
    """Move the bar to a step, and print a line of the log where one is due."""
    if bar.total is None:  # the first step, of a resumed run not number 1
        bar.reset(progress.steps)
        bar.initial = progress.step - 1
        bar.n = progress.step - 1
    bar.update(progress.step - bar.n)
    if progress.numbers:
        bar.set_postfix({name: f"{value:.4g}" for name, value in progress.numbers.items()})
    if log is not None:
        log.show(progress)


_HELD_OUT_PAIRS = 20
"""Pairs of a folder that validate, by default."""


def train_depth(
    stage: tyro.conf.Positional[Literal["view", "select", "stereo", "finetune"]],
    out: NewPath,
    config: Path | None = None,
    data: tuple[Source, ...] = (),
    held_out: tuple[Source, ...] = (),
    generator: WeightsName | None = None,
    matcher: WeightsName | None = None,
    start: WeightsName | None = None,
    encoder: WeightsName | None = None,
    training: TrainingOptions = TrainingOptions(),
) -> int:
    """Train a generator, a matcher, or a generator through a matcher, in stages.

        view      the thesis's generator, a U-Net (pix2pix) for the right view; needs pairs
        select    a generator that warps the left image to the right view, and estimates depth
                  itself; needs pairs with truth
        stereo    the matcher; needs pairs with truth
        finetune  either generator through the frozen matcher; needs weights of both

    A config holds every setting; the options change what they name. The run folder keeps config,
    metrics, pictures, TensorBoard and the last state: --resume goes on from there, to the weights
    of a run that nothing stopped. On many: 'accelerate launch -m depthpose depth train ...'.

        depthpose depth train view --config configs/depth/view.yaml --data kitti --out runs/view

    Args:
        stage: what is trained: view, select, stereo or finetune.
        out: the run folder.
        config: YAML with what differs from the thesis's settings.
        data: folders of pairs to learn from; they replace the config's.
        held_out: folders of pairs for validation alone; by default 20 of each, evenly spaced.
        generator: finetune: weights of the generator to begin with.
        matcher: finetune: weights whose matcher matches the synthesised view; it is not changed.
        start: view, select, stereo: weights to begin with.
        encoder: select, stereo with a light network: weights of the encoder to begin with, of
            'depthpose weights import efficientnet-lite0'.
    """
    from depthpose.depth.config import PairsConfig
    from depthpose.depth.train import STAGES

    kind, run_stage = STAGES[stage]
    settings = training.read(config, kind)
    settings = replace(settings, pairs=replace_unless_none(settings.pairs, folders=data or None))
    if held_out:
        # A generator is measured at the focal length of its own rig, whatever it is trained on.
        focal_px = settings.pairs.focal_px if stage == "stereo" else None
        default_pairs = PairsConfig(
            focal_px=focal_px, truth=settings.pairs.truth, limit=_HELD_OUT_PAIRS
        )
        pairs = replace(settings.held_out or default_pairs, folders=held_out)
        settings = replace(settings, held_out=pairs)

    # The weights to begin with; each stage takes other ones.
    weights = {"generator": generator, "matcher": matcher, "start": start, "encoder": encoder}
    usable_names = {field.name for field in fields(settings)}
    if stage != "finetune":
        usable_names -= {"generator", "matcher"}
    for name, value in weights.items():
        if value is not None and name not in usable_names:
            raise InputError(f"--{name} has no meaning for '{stage}'; see --help.")
    return training.run(run_stage, replace_unless_none(settings, **weights), out)


def calibrate_refusal(
    weights: tyro.conf.Positional[WeightsName],
    data: list[Path],
    out: NewPath,
    alarm_share: float = 0.01,
    split: str | None = None,
    device: Device = "cpu",
) -> int:
    """Set below which confidence an image is refused as out of distribution.

    'depth predict' refuses below a threshold of the confidence (of weights that know streets how
    probable one is, else the mean over the image). It is set so that a share of images like those
    of the training is refused. Tensors stay as they are.

        depthpose depth calibrate mine.safetensors --data my_pairs --out mine-calibrated.safetensors

    Args:
        weights: weights with a generator that selects, by name or file.
        data: folders of such images: KITTI raw, object, 2012/2015, or plain folders of pairs.
        out: the file of the calibrated weights.
        alarm_share: share of these images that may be refused.
        split: name or file of a split, for the first folder.
    """
    from tqdm import tqdm

    from depthpose.core.checkpoint import find_weights
    from depthpose.core.run_folder import refuse_to_replace
    from depthpose.depth.datasets import join_datasets, open_dataset
    from depthpose.depth.estimator import FakestereoNet
    from depthpose.depth.evaluate import measure_image_confidence
    from depthpose.depth.weights import calibrate_weights, refuse_alarm_share

    refuse_to_replace(out)
    if out.suffix != ".safetensors":
        raise InputError(f"{out}: end the name in .safetensors")
    path = find_weights(weights)
    parts = [open_dataset(folder, split if k == 0 else None) for k, folder in enumerate(data)]
    dataset = join_datasets(parts)
    refuse_alarm_share(len(dataset), alarm_share)
    net = FakestereoNet.load(path, config=MatcherConfig(device=device), allow_ood=True)
    indices = tqdm(range(len(dataset)), unit=" images", disable=None)
    confidences = measure_image_confidence(net, map(dataset.read_input, indices))
    threshold = calibrate_weights(path, confidences, alarm_share, out)
    print(f"{len(confidences)} images: confidence {min(confidences):.3f} to {max(confidences):.3f}")
    print(f"refused below {threshold:.3f}; calibrated weights: {out}")
    return 0


_START = "parts"
"""Weights that a CAD file begins with by default: they ship, under a licence for any use."""
_NO_START = "nothing"
"""Word of ``--start`` that begins without weights."""


def train_pose(
    out: NewPath,
    config: Path | None = None,
    cad: tuple[Source, ...] = (),
    unit: Unit | None = None,
    symmetries: Literal["none", "found"] | None = None,
    data: Source | None = None,
    what: Literal["pose", "segmentation", "depth-image", "pointnet"] = "pose",
    start: WeightsName | None = None,
    workers: int | None = None,
    training: TrainingOptions = TrainingOptions(),
) -> int:
    """Train a network on your CAD file, or by a config.

    Views of the object are rendered while it trains: no photograph is needed. OUT holds the weights
    with the model in them, their card with what held-out views measured, config, metrics and
    states. --resume goes on; --finish, or Ctrl-C twice, writes weights of the steps so far.

        depthpose pose train --cad part.stl --unit mm --out my_part
        depthpose pose predict --cloud scan.ply --unit mm --weights my_part/pose.safetensors ...

    Args:
        out: the run folder.
        config: YAML with what differs from the defaults.
        cad: model files; one network learns them all.
        unit: unit of the numbers in the files.
        symmetries: found: detect symmetries of the part and count equivalent poses as one; by
            default they are only printed.
        data: folder of a dataset; it takes the place of the config's, for models and frames.
        what: pose: the network of directions; segmentation: its masks; the others are baselines.
        start: weights to begin with, by name or file. A CAD file without a config begins with
            'parts'; 'nothing' begins anew and takes twice the steps.
        workers: processes that render views beside the one that trains.
    """
    from depthpose.pose.train import STAGES
    from depthpose.pose.train.config import configure_own_part

    # A CAD file without a config has the defaults of a training from trained weights.
    kind, run_stage = STAGES[what]
    is_fine_tuned = what == "pose" and bool(cad) and start != _NO_START
    default = configure_own_part(_START) if is_fine_tuned else kind()
    settings = training.read(config, kind, default=default, workers=workers)

    # Options take the place of what the config says.
    if start is not None:
        settings = replace(settings, start=None if start == _NO_START else start)
    settings = _with_models(settings, cad, unit, symmetries)
    if data is not None:
        settings = _with_dataset(settings, data)
    return training.run(run_stage, settings, out, with_messages=True)


def _with_models(
    config: "_PoseConfig",
    cad: tuple[str, ...],
    unit: Unit | None,
    symmetries: Literal["none", "found"] | None,
) -> "_PoseConfig":
    """Return the config of a training of poses with the models of :func:`train_pose`'s options.

    Options that were left out change nothing.
    """
    from depthpose.pose.train.config import SegmentationTraining

    if isinstance(config, SegmentationTraining) or not (cad or unit or symmetries):
        return config
    models = replace_unless_none(config.models, cad=cad or None, unit=unit)
    if symmetries is not None:
        models = replace(models, with_found_symmetries=symmetries == "found")
    if cad:  # they take the place of a dataset's models
        models = replace(models, bop=None, objects=(), parts=())
    return replace(config, models=models)


def _with_dataset(config: "_PoseConfig", folder: str) -> "_PoseConfig":
    """Return the config of a training of poses with the models and frames of another dataset.

    What the config does not take from a dataset, such as models of CAD files, stays.

    Raises:
        InputError: the config takes nothing from a dataset.
    """
    from depthpose.pose.train.config import SegmentationTraining

    if isinstance(config, SegmentationTraining):
        held_out = None if config.held_out is None else replace(config.held_out, folder=folder)
        images = replace(config.images, folder=folder)
        return replace(config, images=images, held_out=held_out)

    # ``bop`` is None where models are CAD files, ``frames`` where all views are synthetic.
    models = config.models
    frames = config.frames
    if models.bop is None and frames is None:
        raise InputError(
            f"--data {folder}: the config learns from no dataset; see --cad and --what"
        )
    if models.bop is not None:
        models = replace(models, bop=folder)
    if frames is not None:
        frames = replace(frames, folder=folder)
    return replace(config, models=models, frames=frames)
