"""A config to a trained weights file, as commands run it."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from depthpose.core.checkpoint import file_sha256, find_weights
from depthpose.core.config import config_to_dict, write_config
from depthpose.core.errors import InputError
from depthpose.core.loop import Progress, train
from depthpose.core.run import claim_folder, find_shard
from depthpose.pose.config import RefusalConfig
from depthpose.pose.network import ResUNet, ResUNetConfig, fold_norms
from depthpose.pose.train.clouds import TrainingClouds
from depthpose.pose.train.config import PoseTraining
from depthpose.pose.train.held_out import HeldOut
from depthpose.pose.train.models import read_models
from depthpose.pose.train.task import PoseTask
from depthpose.pose.types import ObjectModel
from depthpose.pose.weights import PoseWeights, read_pose_weights, write_pose_weights

_FREE = ("workers", "device", "save_every_steps", "validate_every_steps", "log_every_steps")
"""Knobs of the loop that change no weight: a resumed run may have others."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """Where a training lives, and who watches.

    Attributes:
        folder: the run folder; the weights are ``pose.safetensors`` in it.
        resume: go on from its last state.
        on_step: told after each step.
        tell: told what a person should know before it begins.
    """

    folder: Path
    resume: bool = False
    on_step: Callable[[Progress], None] | None = None
    tell: Callable[[str], None] | None = None


def train_pose(config: PoseTraining, run: Run) -> Path:
    """Train the direction network; give its weights file."""
    torch.manual_seed(config.loop.seed)
    models = read_models(config.models, run.tell)
    config = dataclasses.replace(config, network=_sized(config.network, config, models))
    clouds = TrainingClouds(models, config.objects, config.frames, config.cloud, config.loop.seed)
    held_out = HeldOut(models, config.objects, config.cloud, config.held_out)
    network = ResUNet(config.network)
    if config.start is not None:
        _start_from(network, config.start)
    _claim(config, run)
    task = PoseTask(network, models, config, held_out)
    train(task, clouds, config.loop, run.folder, resume=run.resume, on_step=run.on_step)
    return _export(network, models, config, run)


STAGES = {"pose": (PoseTraining, train_pose)}
"""Config and function of each network, by its word on the command line."""


def _sized(
    network: ResUNetConfig, config: PoseTraining, models: tuple[ObjectModel, ...]
) -> ResUNetConfig:
    return dataclasses.replace(network, classes=len(models), keypoints=config.models.mesh.keypoints)


def _claim(config: PoseTraining, run: Run) -> None:
    """Make the folder this config's own."""
    settings = {"stage": type(config).__name__, **config_to_dict(config)}
    settings["loop"] = {k: v for k, v in settings["loop"].items() if k not in _FREE}
    settings["loop"]["processes"] = find_shard().world
    settings.pop("held_out")
    settings["models"]["sha256"] = [file_sha256(Path(path)) for path in config.models.cad]
    if config.start is not None:
        settings["start_sha256"] = file_sha256(find_weights(config.start))
    claim_folder(run.folder, settings)
    write_config(run.folder / "config.yaml", config)


def _start_from(network: ResUNet, start: str) -> None:
    """Copy weights; batch norm that was folded for use cannot be had back."""
    found = read_pose_weights(find_weights(start)).network
    wanted, given = config_to_dict(network.config), config_to_dict(found.config)
    for knob, value in wanted.items():
        if given[knob] != value:
            raise InputError(
                f"{start}: was trained with {knob} = {given[knob]!r}, but the config says "
                f"{value!r}. Give the config the weights' own."
            )
    network.load_state_dict(found.state_dict())


def _export(
    network: ResUNet, models: tuple[ObjectModel, ...], config: PoseTraining, run: Run
) -> Path:
    path = run.folder / "pose.safetensors"
    if find_shard().rank:
        return path  # statistics of batch norm are rank 0's, and so is the file
    names = ", ".join(model.name for model in models)
    source = "made views" if config.frames is None else f"{config.frames.folder} and made views"
    weights = PoseWeights(
        network=fold_norms(network.cpu().eval()),
        models=models,
        cloud=config.cloud,
        refusal=RefusalConfig(),
        facts={
            "trained_on": f"{source} of {names}",
            "stage": type(config).__name__,
            "licence": "not stated; that of the models binds",
        },
    )
    write_pose_weights(path, weights, with_half=config.with_half)
    return path
