"""A config to a trained weights file: the three stages as commands run them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from depthpose.core.checkpoint import file_sha256, find_weights
from depthpose.core.config import config_to_dict, write_config
from depthpose.core.loop import LoopConfig, Progress, Task, train
from depthpose.core.run import claim_folder
from depthpose.depth.config import PairsConfig
from depthpose.depth.stereo import PSMNet
from depthpose.depth.synthesis import UNetGenerator
from depthpose.depth.train.config import FinetuneTraining, StereoTraining, ViewTraining
from depthpose.depth.train.finetune import FinetuneTask
from depthpose.depth.train.pairs import TrainingPairs
from depthpose.depth.train.stereo import StereoTask
from depthpose.depth.train.view import ViewTask
from depthpose.depth.weights import read_generator, read_matcher, write_depth_weights


@dataclass(frozen=True, kw_only=True)
class Run:
    """Where a training lives, and who watches.

    Attributes:
        folder: the run folder; the weights are ``generator.safetensors`` or
            ``matcher.safetensors`` in it.
        resume: go on from its last state.
        on_step: told after each step.
    """

    folder: Path
    resume: bool = False
    on_step: Callable[[Progress], None] | None = None


def train_view(config: ViewTraining, run: Run) -> Path:
    """Train the generator; give its weights file."""
    torch.manual_seed(config.loop.seed)
    rig_m = config.generator.virtual_baseline_m
    pairs = _pairs(config.pairs, config.loop, needs_truth=False, baseline_m=rig_m)
    held_out = _held_out(config.held_out, needs_truth=False)
    generator = UNetGenerator(config.generator)
    if config.start is not None:
        generator.load_state_dict(read_generator(find_weights(config.start)).state_dict())
    _walk(ViewTask(generator, config, held_out), pairs, config, run)
    return _export(run, config, generator=generator)


def train_stereo(config: StereoTraining, run: Run) -> Path:
    """Train the matcher; give its weights file."""
    torch.manual_seed(config.loop.seed)
    pairs = _pairs(config.pairs, config.loop, needs_truth=True)
    held_out = _held_out(config.held_out, needs_truth=True)
    matcher = PSMNet(config.matcher)
    if config.start is not None:
        matcher.load_state_dict(read_matcher(find_weights(config.start)).state_dict())
    _walk(StereoTask(matcher, config, held_out), pairs, config, run)
    return _export(run, config, matcher=matcher)


def train_finetune(config: FinetuneTraining, run: Run) -> Path:
    """Fine-tune the generator through the frozen matcher; give the weights file of both."""
    torch.manual_seed(config.loop.seed)
    generator = read_generator(find_weights(config.generator))
    matcher = read_matcher(find_weights(config.matcher))
    rig_m = generator.config.virtual_baseline_m
    pairs = _pairs(config.pairs, config.loop, needs_truth=True, baseline_m=rig_m)
    held_out = _held_out(config.held_out, needs_truth=True)
    _walk(FinetuneTask(generator, matcher, config, held_out), pairs, config, run)
    return _export(run, config, generator=generator, matcher=matcher)


STAGES = {
    "view": (ViewTraining, train_view),
    "stereo": (StereoTraining, train_stereo),
    "finetune": (FinetuneTraining, train_finetune),
}
"""Config and function of each stage, by its word on the command line."""


def _walk(task: Task, pairs: TrainingPairs, config: Any, run: Run) -> None:  # noqa: ANN401
    """Claim the folder for this config, then train."""
    settings = {"stage": type(config).__name__, **config_to_dict(config)}
    for knob in ("start", "generator", "matcher"):
        if isinstance(name := settings.get(knob), str):
            settings[f"{knob}_sha256"] = file_sha256(find_weights(name))
    claim_folder(run.folder, settings)
    write_config(run.folder / "config.yaml", config)
    train(task, pairs, config.loop, run.folder, resume=run.resume, on_step=run.on_step)


def _export(
    run: Run,
    config: Any,  # noqa: ANN401
    *,
    generator: UNetGenerator | None = None,
    matcher: PSMNet | None = None,
) -> Path:
    names = [name for name, part in (("generator", generator), ("matcher", matcher)) if part]
    path = run.folder / f"{names[0] if len(names) == 1 else 'fakestereo'}.safetensors"
    facts = {
        "trained_on": ", ".join(Path(folder).name for folder in config.pairs.folders),
        "stage": type(config).__name__,
        "licence": "not stated; that of the training data binds",
    }
    write_depth_weights(path, generator=generator, matcher=matcher, facts=facts)
    return path


def _pairs(
    config: PairsConfig, loop: LoopConfig, *, needs_truth: bool, baseline_m: float | None = None
) -> TrainingPairs:
    return TrainingPairs(config, loop.seed, needs_truth=needs_truth, baseline_m=baseline_m)


def _held_out(config: PairsConfig | None, *, needs_truth: bool) -> TrainingPairs | None:
    return None if config is None else TrainingPairs(config, 0, needs_truth=needs_truth)
