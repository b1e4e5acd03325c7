"""Training of the direction network."""

import dataclasses
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.checkpoint import bound_facts, file_sha256, find_weights, warn_of_terms
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.files import write_json
from depthpose.core.loop import (
    Run,
    Update,
    ValidationResult,
    make_adam,
    releases_folder,
    write_card,
)
from depthpose.core.rigid import Rigid
from depthpose.core.run import find_rank
from depthpose.pose.baselines import PointNet, PointNetConfig
from depthpose.pose.config import CloudConfig, RefusalConfig
from depthpose.pose.estimator.candidates import near_symmetry_lines
from depthpose.pose.losses import direction_loss
from depthpose.pose.mesh import symmetry_transforms
from depthpose.pose.network import ResUNet, fold_norms, unfold_norms
from depthpose.pose.sparse import Voxels
from depthpose.pose.train.clouds import (
    CloudBatch,
    HeldOut,
    TrainingClouds,
    read_models,
    score_held_out,
    table_text,
)
from depthpose.pose.train.config import PoseTraining, ViewsTraining
from depthpose.pose.types import ObjectModel
from depthpose.pose.weights import (
    AnyNetwork,
    DirectionNet,
    PoseWeights,
    read_pose_network,
    read_pose_weights,
    write_pose_weights,
)

_SYMMETRY_STEP = 0.05
"""Turns about a continuous axis are tried every 5.7 degrees; the vote's own error is larger."""


class PoseTask:
    """Directions from each point to the keypoints of its object (thesis, 3.3).

    A symmetric object's copy of the truth is chosen once for each cloud.
    """

    def __init__(
        self,
        network: DirectionNet,
        models: Sequence[ObjectModel],
        config: PoseTraining,
        held_out: HeldOut | None,
    ) -> None:
        self.config, self.held_out = config, held_out
        self.network = network.train()
        self.modules: dict[str, nn.Module] = {"network": network}
        self.optimizers = {"network": (make_adam(network.parameters(), config.adam), config.adam)}
        self._copies_m = keypoint_copies(models)

    def step(self, batch: CloudBatch) -> Iterator[Update]:
        """One update: all clouds at once."""
        directions = self.network.directions(batch.seen).float()
        copies = self._copies_m.to(batch.R)[batch.class_of]
        copies_m = copies @ batch.R.mT[:, None] + batch.t_m[:, None, None]
        loss = direction_loss(
            directions, batch.points_m, copies_m, batch.instance, self.config.loss
        )
        yield Update("network", loss, {"directions": loss.detach()})

    def validate(self) -> ValidationResult:
        """Pose held-out views with the current network."""
        if self.held_out is None:
            return ValidationResult()
        self.network.eval()
        result = self.held_out.look(self.network)
        self.network.train()
        return result


def keypoint_copies(models: Sequence[ObjectModel]) -> Float[Tensor, "classes copies k 3"]:
    """Keypoints of each object under each of its symmetries; the first is repeated to the most."""
    turns = symmetric_copies(models, _SYMMETRY_STEP)
    keypoints_m = torch.stack([model.keypoints_m.double() for model in models])
    return (keypoints_m[:, None] @ turns.R.mT + turns.t_m[:, :, None]).float()


def symmetric_copies(models: Sequence[ObjectModel], step_rad: float) -> Rigid:
    """``model_from_model`` of each object (classes, copies); the identity fills the shorter."""
    every = [symmetry_transforms(model.symmetries, step_rad).double() for model in models]
    most = max(len(copies.R) for copies in every)
    R = torch.eye(3).double().repeat(len(models), most, 1, 1)
    t_m = torch.zeros(len(models), most, 3).double()
    for k, copies in enumerate(every):
        R[k, : len(copies.R)], t_m[k, : len(copies.R)] = copies.R, copies.t_m
    return Rigid(R, t_m)


_TURNS_ON_CARD = 3
"""Turns of an object that look nearly alike, on a card."""


def claim_run(config: Any, run: Run, files: Sequence[str] = ()) -> None:  # noqa: ANN401
    """Make the folder this config's own."""
    more: dict[str, Any] = {"sha256": [file_sha256(Path(path)) for path in files]}
    if config.start is not None:
        more["start_sha256"] = file_sha256(find_weights(config.start))
        warn_of_terms(bound_facts({}, [config.start]))
    weights = ("pose", "pointnet", "depth-image", "segmentation")
    run.claim(config, weights, more, without=("held_out", "calibration"))


def train_words(what: str, config: ViewsTraining) -> str:
    """Give the command that trains this, with its CAD files, for the card."""
    cad = [word for path in config.models.cad for word in ("--cad", path)]
    unit = ["--unit", config.models.unit] if cad and config.models.unit else []
    return shlex.join(["pose", "train", "--what", what, *cad, *unit])


def packed(
    network: AnyNetwork, models: tuple[ObjectModel, ...], config: ViewsTraining
) -> PoseWeights:
    """Put a trained network and its objects together, with what the card says of them."""
    frames = "" if config.frames is None else f"{Path(config.frames.folder).name} and "
    names = ", ".join(model.name for model in models)
    facts = {"trained_on": f"{frames}synthetic views of {names}", "licence": config.models.licence}
    if config.models.terms:
        facts["terms"] = config.models.terms
    return PoseWeights(
        network=network.cpu().eval(),
        models=models,
        cloud=config.cloud,
        refusal=RefusalConfig(),
        facts=with_origin(facts, config),
    )


def card_facts(weights: PoseWeights) -> dict[str, str]:
    """Put before the facts of weights their objects, sizes, and turns that look nearly alike."""
    known = ", ".join(f"{m.name} ({1000 * m.diameter_m:.0f} mm)" for m in weights.models)
    lines = {model.name: near_symmetry_lines(model) for model in weights.models}
    near = "; ".join(
        f"{name}: {', '.join(some[:_TURNS_ON_CARD])}" for name, some in lines.items() if some
    )
    return {"objects": known} | ({"nearly_alike": near} if near else {}) | dict(weights.facts)


def with_origin(facts: Mapping[str, str], config: Any) -> dict[str, str]:  # noqa: ANN401
    """Add to a card the stage, and the weights that it began with: their terms bind it too."""
    origin = {**facts, "stage": type(config).__name__}
    if config.start is None:
        return origin
    return bound_facts({**origin, "began_with": Path(config.start).stem}, [config.start])


def with_classes(
    network: Any,  # noqa: ANN401
    models: Sequence[ObjectModel],
    cloud: CloudConfig,
) -> Any:  # noqa: ANN401
    """Give a network's config the classes and keypoints of the objects, the inputs of the cloud."""
    sizes = {
        "classes": len(models),
        "keypoints": len(models[0].keypoints_m),
        "inputs": cloud.features,
    }
    known = {field.name for field in dataclasses.fields(network)}
    return dataclasses.replace(network, **{k: v for k, v in sizes.items() if k in known})


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
    if isinstance(config.network, PointNetConfig):
        network = PointNet(config.network)
    else:
        network = ResUNet(config.network)
    if config.start is not None:
        _start_from(network, config.start, clouds)
    claim_run(config, run, config.models.cad)
    task = PoseTask(network, models, config, held_out)
    seconds = run.train(task, clouds, config.loop)
    if run.on_message is not None:
        run.on_message("trained; now it is measured on synthetic views: a minute or more")
    if isinstance(network, PointNet):
        return _save(run.folder / "pointnet.safetensors", network, models, config, seconds)
    return _save(run.folder / "pose.safetensors", fold_norms(network), models, config, seconds)


def _save(
    path: Path,
    network: ResUNet | PointNet,
    models: tuple[ObjectModel, ...],
    config: PoseTraining,
    seconds: float,
) -> Path:
    """Write the weights, measure the file, and write its card."""
    if find_rank().rank:
        return path  # statistics of batch norm are rank 0's, and so is the file
    write_pose_weights(path, packed(network, models, config), with_half=config.with_half)
    weights = read_pose_weights(path)  # as the file holds them: 16 bits round them
    table = score_held_out(weights, config.objects, config.held_out)
    write_json(path.with_suffix(".json"), {"held_out": table})
    write_card(
        path, train_words(path.stem, config), seconds, card_facts(weights), table_text(table)
    )
    return path


def _start_from(network: ResUNet | PointNet, start: str, clouds: TrainingClouds) -> None:
    """Copy weights; of other objects, all but the last layer.

    Written weights are folded: they have no norms, but biases. Batch norm takes both up. New
    input features of a voxel get weights of zero.
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
    if has_norms and isinstance(network, ResUNet) and isinstance(found, ResUNet):
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
