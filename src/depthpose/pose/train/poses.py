"""Training of networks that pose: of directions, and of the regressed depth image."""

import dataclasses
import math
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from depthpose.core.checkpoint import (
    file_sha256,
    find_weights,
    read_checkpoint,
    refuse_other_network,
)
from depthpose.core.errors import InputError
from depthpose.core.files import write_json
from depthpose.core.loop import (
    TrainingRun,
    Update,
    add_origin,
    make_sample_generator,
    releases_folder,
    write_card,
)
from depthpose.core.processes import find_rank
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import lift_sample
from depthpose.pose.config import SHAPE_FEATURES, RefusalConfig
from depthpose.pose.losses import direction_loss, model_point_loss
from depthpose.pose.mesh import sample_surface, symmetry_transforms
from depthpose.pose.networks.baselines import (
    DepthCrop,
    DepthImageNet,
    PointNet,
    PointNetConfig,
    cut_depth,
    make_poses,
)
from depthpose.pose.networks.resunet import ResUNet, fold_norms, unfold_norms
from depthpose.pose.networks.sparse import Voxels
from depthpose.pose.propose import fit_pose, vote_ransac
from depthpose.pose.train.clouds import (
    BEYOND_TRAINING,
    TRIES,
    CloudBatch,
    TrainingClouds,
    TrainingViews,
    read_models,
    voxelise_sample,
)
from depthpose.pose.train.config import DepthImageTraining, PoseTraining, ViewsTraining
from depthpose.pose.train.held_out import (
    HELD_OUT_SEED,
    ViewsTask,
    format_held_out_table,
    measure_add,
    score_held_out,
)
from depthpose.pose.types import ObjectModel, ViewSample
from depthpose.pose.verify.copies import describe_near_symmetries
from depthpose.pose.weights import (
    AnyNetwork,
    DirectionNet,
    PoseWeights,
    build_pose_network,
    read_pose_weights,
    write_pose_weights,
)

_SYMMETRY_STEP_RAD = 0.05  # half the step about an axis of revolution; votes err by more


class PoseTask(ViewsTask):
    """Trains directions from each point to the keypoints of its object (thesis, 3.3).

    For a symmetric object the copy of the truth is chosen once for each cloud.
    """

    method = "ransac"

    def __init__(
        self, network: DirectionNet, models: Sequence[ObjectModel], config: PoseTraining
    ) -> None:
        super().__init__(network, models, config)
        self.network = network
        self.config = config
        # Keypoints of each object under each of its symmetries (classes, copies, k, 3).
        copies = stack_symmetries(models, _SYMMETRY_STEP_RAD)
        keypoints_m = torch.stack([model.keypoints_m.double() for model in models])
        self._copies_m = (keypoints_m[:, None] @ copies.R.mT + copies.t_m[:, :, None]).float()

    def step(self, batch: CloudBatch) -> Iterator[Update]:
        """Make one update: the loss of all clouds at once."""
        directions = self.network.directions(batch.network_input).float()
        # The true keypoints of each cloud, in all copies (clouds, copies, k, 3).
        copies_m = self._copies_m.to(batch.R)[batch.class_of]
        copies_m = copies_m @ batch.R.mT[:, None] + batch.t_m[:, None, None]
        cloud_of_point = batch.coordinates[:, 0].long()
        loss = direction_loss(
            directions, batch.points_m, copies_m, cloud_of_point, self.config.loss
        )
        yield Update("network", loss, {"directions": loss.detach()})

    def measure_view(self, view: ViewSample, index: int) -> float:
        """Pose the cloud of a view by voting and measure ADD; infinite for too few points."""
        # The cloud of the view, in the axes of its grid.
        number = index % len(self.models)
        generator = make_sample_generator(index, HELD_OUT_SEED)
        model = self.models[number]
        config = self.config.cloud
        sample = lift_sample(view, model.diameter_m, config)
        if len(sample.input.points_m) < config.min_points:
            return math.inf
        cloud = voxelise_sample(sample, number, config, generator)

        # Its votes, and the pose that they fit best.
        device = next(self.network.parameters()).device
        batch = TrainingClouds.collate([cloud])
        points = CloudBatch(*(part.to(device) for part in batch)).network_input
        vote = vote_ransac(points.points_m, self.network.directions(points).float())
        fit = fit_pose(vote.keypoints_m.cpu(), vote.covariance_m2.cpu(), model.keypoints_m)
        return measure_add(fit.camera_from_model, Rigid(cloud.R, cloud.t_m), model)


def stack_symmetries(models: Sequence[ObjectModel], step_rad: float) -> Rigid:
    """Stack the symmetries of all objects as a batch ``model_from_model`` (classes, copies).

    Objects with fewer are filled up with the identity. ``step_rad`` is half the step between
    rotations about an axis of revolution.
    """
    of_models = [symmetry_transforms(model.symmetries, step_rad).double() for model in models]
    most = max(len(copies.R) for copies in of_models)
    R = torch.eye(3).double().repeat(len(models), most, 1, 1)
    t_m = torch.zeros(len(models), most, 3).double()
    for k, copies in enumerate(of_models):
        R[k, : len(copies.R)] = copies.R
        t_m[k, : len(copies.R)] = copies.t_m
    return Rigid(R, t_m)


_ROTATIONS_ON_CARD = 3  # rotations by which an object looks nearly alike, on a card


WEIGHTS_FILES = ("pose", "pointnet", "depth-image", "segmentation")
"""Names of the weights that a training of this package may write, one of them in a folder."""


def make_pose_weights(
    network: AnyNetwork, models: tuple[ObjectModel, ...], config: ViewsTraining
) -> PoseWeights:
    """Make the weights of a trained network and its objects, with the facts for their card."""
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
        facts=add_origin(facts, config),
    )


_IMAGE_SYMMETRY_STEP_RAD = 0.2
"""Half the step between rotations about a continuous axis: 11 degrees, far below the error that
remains after training."""


class CropSample(NamedTuple):
    """A crop, or a batch of them, with truth."""

    crop: DepthCrop  #: that the network sees
    class_of: Int[Tensor, "*b"]  #: class of its object
    R: Float[Tensor, "*b 3 3"]  #: rotation of the pose
    t_m: Float[Tensor, "*b 3"]  #: its translation


class TrainingCrops(TrainingViews[DepthImageTraining]):
    """Crops of views to regress poses from, by sample index: of synthetic views or frames."""

    def __getitem__(self, index: int) -> CropSample:
        """Make the sample of an index; one with too few pixels is replaced by another.

        Raises:
            InputError: 20 in a row have too few pixels, so that the config must be wrong.
        """
        for attempt in range(TRIES):
            # A further attempt takes an index beyond any training, of the same object.
            place = index + attempt * len(self.models) * BEYOND_TRAINING
            view, _ = self._choose_view(place, make_sample_generator(place, self.seed))
            number = self._class_of[view.input.object]
            crop = cut_depth(view.input, self.config.network, self.models[number].diameter_m)
            if crop is not None:
                pose = view.truth.camera_from_model
                return CropSample(crop, torch.tensor(number), pose.R.float(), pose.t_m.float())
        raise InputError(
            f"{TRIES} views in a row have fewer than {self.config.network.min_points} masked "
            "pixels with a depth; bring the camera nearer (distance_m), or lower min_points"
        )


class DepthImageTask(ViewsTask):
    """Trains a network that regresses poses, by their ADD to the nearest symmetric truth."""

    method = "regressed"

    def __init__(
        self, network: DepthImageNet, models: tuple[ObjectModel, ...], config: DepthImageTraining
    ) -> None:
        super().__init__(network, models, config)
        self.network = network
        self.config = config
        # Equally many points of each surface; those of a model of fewer points are repeated.
        count = config.surface_points
        surfaces_m = [sample_surface(model, count)[0] for model in models]
        self._points_m = torch.stack([
            points_m[torch.arange(count) % len(points_m)] for points_m in surfaces_m
        ])  # fmt: skip
        self._copies = stack_symmetries(models, _IMAGE_SYMMETRY_STEP_RAD).float()
        self._diameter_m = torch.tensor([model.diameter_m for model in models])

    def step(self, batch: CropSample) -> Iterator[Update]:
        """Make one update: regress poses and compare the points of the models, in diameters."""
        class_of = batch.class_of
        device = batch.R.device
        outputs = self.network(batch.crop.image, class_of).float()
        poses = make_poses(outputs, batch.crop)
        copies = Rigid(self._copies.R.to(device)[class_of], self._copies.t_m.to(device)[class_of])
        points_m = self._points_m.to(device)[class_of]
        error_m = model_point_loss(poses, Rigid(batch.R, batch.t_m), points_m, copies)
        diameter_m = self._diameter_m.to(device)[class_of]
        yield Update("network", (error_m / diameter_m).mean(), {})

    def measure_view(self, view: ViewSample, index: int) -> float:
        """Regress the pose of a view and measure ADD; infinite for too few pixels."""
        number = index % len(self.models)
        model = self.models[number]
        device = next(self.network.parameters()).device
        crop = cut_depth(view.input, self.network.config, model.diameter_m)
        if crop is None:
            return math.inf
        batch = DepthCrop(*(part[None].to(device) for part in crop))
        outputs = self.network(batch.image, torch.tensor([number], device=device))
        poses = make_poses(outputs, batch)
        pose = Rigid(poses.R[0].cpu(), poses.t_m[0].cpu())
        return measure_add(pose, view.truth.camera_from_model, model)


_STATISTICS_CLOUDS = 64  # from which statistics of batch norm, lost by folding, are computed anew
_KINDS = {DepthImageNet: "depth-image", PointNet: "pointnet", ResUNet: "pose"}
"""Name of each network's weights file."""


@releases_folder
def train_pose_network(config: PoseTraining | DepthImageTraining, run: TrainingRun) -> Path:
    """Train the network that a config has, ours or a baseline.

    Returns:
        The path of its weights.

    Raises:
        InputError: settings, models or weights to begin with that do not fit.
    """
    # The objects, and the network, perhaps with weights to begin with.
    torch.manual_seed(config.loop.seed)
    models = read_models(config.models, run.on_message)
    config = _set_network_sizes(config, models)
    task, samples = _build_training(config, models)
    if config.start is not None:
        _copy_start(task.network, config.start, samples)

    # The folder is claimed only now: until here a setting may be refused.
    checksums = [file_sha256(Path(path)) for path in config.models.cad]
    run.claim(config, WEIGHTS_FILES, {"sha256": checksums})
    seconds = run.train(task, samples, config.loop)
    path = run.folder / f"{_KINDS[type(task.network)]}.safetensors"
    if run.on_message is not None:
        run.on_message("trained; now it is measured on synthetic views: a minute or more")
    if find_rank().rank:
        return path  # statistics of batch norm are rank 0's, and so is the file

    # Weights, with norms folded into their convolutions.
    network = task.network
    inference_network = fold_norms(network) if isinstance(network, ResUNet) else network
    trained_weights = make_pose_weights(inference_network, models, config)
    write_pose_weights(path, trained_weights, with_half=config.with_half)

    # Their card, measured with the weights as the file holds them: 16 bits round them.
    weights = read_pose_weights(path)
    held_out_rows = score_held_out(weights, config.objects, config.held_out)
    write_json(path.with_suffix(".json"), {"held_out": held_out_rows})
    _write_pose_card(path, weights, config, seconds, format_held_out_table(held_out_rows))
    return path


def _set_network_sizes(
    config: PoseTraining | DepthImageTraining, models: Sequence[ObjectModel]
) -> PoseTraining | DepthImageTraining:
    """Set the network's classes and keypoints by the objects, and its inputs by the cloud.

    Only those are set that the config of the network has.
    """
    sizes = {
        "classes": len(models),
        "keypoints": len(models[0].keypoints_m),
        "inputs": SHAPE_FEATURES if config.cloud.with_shape else 1,
    }
    network_sizes = {name: size for name, size in sizes.items() if hasattr(config.network, name)}
    network = dataclasses.replace(config.network, **network_sizes)
    return dataclasses.replace(config, network=network)


def _build_training(
    config: PoseTraining | DepthImageTraining, models: tuple[ObjectModel, ...]
) -> tuple[PoseTask | DepthImageTask, TrainingClouds | TrainingCrops]:
    """Build what a config trains: its task with a new network, and its samples."""
    if isinstance(config, DepthImageTraining):
        crops = TrainingCrops(models, config, config.loop.seed)
        return DepthImageTask(DepthImageNet(config.network), models, config), crops
    clouds = TrainingClouds(models, config, config.loop.seed)
    has_synthetic = config.frames is None or config.frames.share < 1
    if config.loop.workers > 1 and has_synthetic:
        clouds.synthetic.render_stored(config.loop.workers)
    if isinstance(config.network, PointNetConfig):
        return PoseTask(PointNet(config.network), models, config), clouds
    return PoseTask(ResUNet(config.network), models, config), clouds


def _write_pose_card(
    path: Path,
    weights: PoseWeights,
    config: PoseTraining | DepthImageTraining,
    seconds: float,
    held_out: str,
) -> None:
    """Write the card beside weights: the command, the objects, and the table of held-out views."""
    # The command, as far as its options are known here.
    cad_options = [word for file in config.models.cad for word in ("--cad", file)]
    if cad_options and config.models.unit:
        cad_options += ["--unit", config.models.unit]
    command = shlex.join(["pose", "train", "--what", path.stem, *cad_options])

    # The objects, and the rotations that no view of them may tell apart.
    objects = ", ".join(f"{m.name} ({1000 * m.diameter_m:.0f} mm)" for m in weights.models)
    facts = {"objects": objects}
    near_symmetries: list[str] = []
    for model in weights.models:
        rotations = describe_near_symmetries(model)[:_ROTATIONS_ON_CARD]
        if rotations:
            near_symmetries.append(f"{model.name}: {', '.join(rotations)}")
    if near_symmetries:
        facts["nearly_alike"] = "; ".join(near_symmetries)
    write_card(path, command, seconds, facts | dict(weights.facts), held_out)


def _copy_start(network: AnyNetwork, start: str, samples: TrainingViews[Any]) -> None:
    """Copy the weights that a training begins with into the network that it trains.

    Where the numbers of objects differ the last layer, which is theirs, stays as it is; a network
    on depth images takes weights of the same number alone.

    Args:
        network: the network to train; changed.
        start: name or file of the weights.
        samples: from which statistics of batch norm are computed.

    Raises:
        InputError: the file is of another network, or of other settings.
    """
    # A network with batch norm takes up the biases that written weights have in place of norms.
    path = find_weights(start)
    loaded = build_pose_network(read_checkpoint(path), str(path))
    if isinstance(network, ResUNet) and network.config.norm == "batch":
        refuse_other_network(network, loaded, start, ("classes", "norm", "with_bias"))
        assert isinstance(loaded, ResUNet)
        assert isinstance(samples, TrainingClouds)
        batch = samples.collate([samples[index] for index in range(_STATISTICS_CLOUDS)])
        unfold_norms(loaded, network, Voxels.from_points(batch.coordinates, batch.features))
        return

    # Others are copied, but for the last layer of other objects.
    may_differ = () if isinstance(network, DepthImageNet) else ("classes",)
    refuse_other_network(network, loaded, start, may_differ)
    state = loaded.state_dict()
    if loaded.config.classes != network.config.classes:
        initial = network.state_dict()
        state |= {name: initial[name] for name in initial if name.startswith("final.")}
    network.load_state_dict(state)
