"""A config to a trained weights file, as commands run it."""

import dataclasses
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from depthpose.core.checkpoint import find_weights
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.files import write_json
from depthpose.core.loop import Run, releases_folder, write_card
from depthpose.core.run import find_rank
from depthpose.pose.baselines import PointNet, PointNetConfig
from depthpose.pose.network import ResUNet, ResUNetConfig, fold_norms, unfold_norms
from depthpose.pose.sparse import Voxels
from depthpose.pose.train.clouds import TrainingClouds, read_models
from depthpose.pose.train.config import PoseTraining
from depthpose.pose.train.depth_image import train_depth_image
from depthpose.pose.train.held_out import HeldOut, score_held_out, table_text
from depthpose.pose.train.other_configs import (
    DepthImageTraining,
    PointNetTraining,
    SegmentationTraining,
)
from depthpose.pose.train.segmentation import train_segmentation
from depthpose.pose.train.task import (
    PoseTask,
    card_facts,
    claim_run,
    packed,
    train_words,
    with_classes,
)
from depthpose.pose.types import ObjectModel
from depthpose.pose.weights import (
    PoseWeights,
    read_pose_network,
    read_pose_weights,
    write_pose_weights,
)

_STATISTICS_CLOUDS = 64
"""Clouds from which batch norm statistics, lost by folding, are computed again."""


@releases_folder
def train_pose(config: PoseTraining, run: Run) -> Path:
    """Train a network of directions, ours or the PointNet; give its weights file."""
    torch.manual_seed(config.loop.seed)
    models = read_models(config.models, run.on_message)
    config = dataclasses.replace(config, network=with_classes(config.network, models, config.cloud))
    clouds = TrainingClouds(
        models,
        config.objects,
        config.frames,
        config.cloud,
        config.loop.seed,
        first_alone=config.first_alone,
    )
    if config.loop.workers > 1 and (config.frames is None or config.frames.share < 1):
        clouds.synthetic.draw_stored(config.loop.workers)
    held_out = HeldOut(models, config.objects, config.cloud, config.held_out)
    network = _network_of(config.network)
    if config.start is not None:
        _start_from(network, config.start, clouds)
    claim_run(config, run, config.models.cad)
    task = PoseTask(network, models, config, held_out)
    seconds = run.train(task, clouds, config.loop)
    if run.on_message is not None:
        run.on_message("trained; now it is measured on synthetic views: a minute or more")
    if isinstance(network, PointNet):
        return _leave(run.folder / "pointnet.safetensors", network, models, config, seconds)
    return _leave(run.folder / "pose.safetensors", fold_norms(network), models, config, seconds)


STAGES = {
    "pose": (PoseTraining, train_pose),
    "pointnet": (PointNetTraining, train_pose),
    "depth-image": (DepthImageTraining, train_depth_image),
    "segmentation": (SegmentationTraining, train_segmentation),
}
"""Config and function of each network, by its word on the command line."""


def _leave(
    path: Path,
    network: ResUNet | PointNet,
    models: tuple[ObjectModel, ...],
    config: PoseTraining,
    seconds: float,
) -> Path:
    """Write the weights, measure the file, and write its card."""
    if find_rank().rank:
        return path  # statistics of batch norm are rank 0's, and so is the file
    weights = _as_written(packed(network, models, config), with_half=config.with_half)
    write_pose_weights(path, weights, with_half=config.with_half)
    table = score_held_out(read_pose_weights(path), config.objects, config.held_out)
    write_json(path.with_suffix(".json"), {"held_out": table})
    write_card(
        path, train_words(path.stem, config), seconds, card_facts(weights), table_text(table)
    )
    return path


def _as_written(weights: PoseWeights, *, with_half: bool) -> PoseWeights:
    """Give what a file of these weights holds: 16 bits round them."""
    with TemporaryDirectory() as home:
        path = Path(home) / "weights.safetensors"
        write_pose_weights(path, weights, with_half=with_half)
        return read_pose_weights(path)


def _network_of(config: ResUNetConfig | PointNetConfig) -> ResUNet | PointNet:
    return PointNet(config) if isinstance(config, PointNetConfig) else ResUNet(config)


def _start_from(network: ResUNet | PointNet, start: str, clouds: TrainingClouds) -> None:
    """Copy weights; of other objects, all but the last layer.

    Written weights are folded: they have no norms, but biases. Batch norm takes both up. New
    input features of a voxel get weights of zero.

    Raises:
        InputError: a network of another shape.
    """
    found = read_pose_network(find_weights(start))
    if isinstance(found, ResUNet) and isinstance(network, ResUNet):
        found = _with_inputs(found, network.config.inputs)
    wanted, given = config_to_dict(network.config), config_to_dict(found.config)
    has_norms = isinstance(network, ResUNet) and network.config.norm == "batch"
    free = ("classes", "norm", "with_bias") if has_norms else ("classes",)
    for name, value in wanted.items():
        if name not in free and given.get(name) != value:
            raise InputError(
                f"{start}: was trained with {name} = {given.get(name)!r}, but the config says "
                f"{value!r}. Give the config the weights' own."
            )
    if (
        isinstance(network, ResUNet)
        and isinstance(found, ResUNet)
        and network.config.norm != "none"
    ):
        batch = clouds.collate([clouds[index] for index in range(_STATISTICS_CLOUDS)])
        unfold_norms(found, network, Voxels.from_points(batch.coordinates, batch.features))
        return
    state = found.state_dict()
    if found.config.classes != network.config.classes:
        state |= {k: v for k, v in network.state_dict().items() if k.startswith("final.")}
    network.load_state_dict(state)


def _with_inputs(network: ResUNet, inputs: int) -> ResUNet:
    """Give a network more inputs, with weights of zero."""
    more = inputs - network.config.inputs
    if more <= 0:
        return network
    state, first = network.state_dict(), "down.0.conv.weight"
    silent = state[first].new_zeros(len(state[first]), more, state[first].shape[2])
    wider = ResUNet(dataclasses.replace(network.config, inputs=inputs))
    wider.load_state_dict({**state, first: torch.cat([state[first], silent], 1)})
    return wider.eval()
