"""The regressed depth image as a task of the loop."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from depthpose.core.checkpoint import find_weights
from depthpose.core.errors import InputError
from depthpose.core.loop import (
    Run,
    Update,
    ValidationResult,
    held_out_text,
    make_adam,
    releases_folder,
    sample_generator,
    write_card,
)
from depthpose.core.rigid import Rigid
from depthpose.core.run import find_rank
from depthpose.pose.baselines import DepthCrop, DepthImageNet, cut_depth, poses_of
from depthpose.pose.config import EstimateConfig, RefusalConfig
from depthpose.pose.estimator import DepthImageRegressor
from depthpose.pose.losses import model_point_loss
from depthpose.pose.mesh import sample_surface
from depthpose.pose.metrics import is_within_diameter
from depthpose.pose.synthetic import Objects
from depthpose.pose.train.clouds import epoch_samples, frame_place, open_frames, read_models
from depthpose.pose.train.held_out import held_out_objects, pose_error
from depthpose.pose.train.other_configs import DepthImageTraining
from depthpose.pose.train.task import (
    card_facts,
    claim_run,
    packed,
    symmetric_copies,
    train_words,
    with_classes,
)
from depthpose.pose.types import ObjectModel, ViewSample
from depthpose.pose.weights import PoseWeights, read_pose_weights, write_pose_weights

_TRIES = 20
_SYMMETRY_STEP = 0.2
"""Turns about a continuous axis are tried every 23 degrees: half of that is far below the error
that this network is left with."""
_MEASURED = (
    "Synthetic views that no training saw, by occluded %, posed without ICP: the share with an "
    "ADD, to the nearest symmetric pose, below a tenth of the diameter (add_10), and its median in "
    "diameters."
)
"""What the numbers of validation are."""


class CropSample(NamedTuple):
    """A crop, or a batch of them, with truth."""

    crop: DepthCrop
    class_of: Int[Tensor, "*b"]
    R: Float[Tensor, "*b 3 3"]
    t_m: Float[Tensor, "*b 3"]


class TrainingCrops:
    """A crop of a view, synthetic or of a frame, by sample index.

    Args:
        models: the objects; class k is ``models[k]``.
        config: which views, and how they are cut.
        seed: of the order of frames.
    """

    def __init__(
        self, models: Sequence[ObjectModel], config: DepthImageTraining, seed: int
    ) -> None:
        self.config, self.seed = config, seed
        self.models = models
        self.synthetic = Objects(models, config.objects, config.cloud)
        self._class_of = {model.name: k for k, model in enumerate(models)}
        frames = config.frames
        self._real = None if frames is None else open_frames(frames, models, config.cloud)

    def __len__(self) -> int:
        """Samples of an epoch: each frame once, or as many as there are synthetic views."""
        return epoch_samples(self.config.frames, self._real, len(self.synthetic))

    def __getitem__(self, index: int) -> CropSample:
        """Make the sample of an index; one with too few pixels is replaced by another.

        Raises:
            InputError: so many in a row have too few pixels that the config must be wrong.
        """
        for attempt in range(_TRIES):
            # Far beyond any training, and the same object.
            sample = self._view(index + attempt * len(self.models) * 2**32)
            number = self._class_of[sample.input.object]
            crop = cut_depth(sample.input, self.config.network, self.models[number].diameter_m)
            if crop is not None:
                pose = sample.truth.camera_from_model
                return CropSample(crop, torch.tensor(number), pose.R.float(), pose.t_m.float())
        raise InputError(
            f"{_TRIES} views in a row have fewer than {self.config.network.min_points} masked "
            "pixels with a depth; bring the camera nearer (distance_m), or lower min_points"
        )

    def _view(self, index: int) -> ViewSample:
        generator = sample_generator(index, self.seed)
        place = frame_place(self.config.frames, self._real, index, self.seed, generator)
        if self._real is None or place is None:
            return self.synthetic.view(index)
        return self._real.view(self._real.instances[place])


class DepthImageTask:
    """ADD of the regressed pose against the nearest symmetric copy of the truth."""

    def __init__(
        self,
        network: DepthImageNet,
        models: tuple[ObjectModel, ...],
        config: DepthImageTraining,
    ) -> None:
        self.config, self.models = config, models
        self.network = network.train()
        self.modules: dict[str, nn.Module] = {"network": network}
        self.optimizers = {"network": (make_adam(network.parameters(), config.adam), config.adam)}
        self._points_m = surface_points(models, config.surface_points)
        self._copies = symmetric_copies(models, _SYMMETRY_STEP).float()
        self._diameter_m = torch.tensor([model.diameter_m for model in models])
        self._views: dict[float, list[ViewSample]] = {}

    def step(self, batch: CropSample) -> Iterator[Update]:
        """One update: regress, move the model's points, compare; in diameters."""
        which, device = batch.class_of, batch.R.device
        outputs = self.network(batch.crop.image, which).float()
        copies = Rigid(self._copies.R.to(device)[which], self._copies.t_m.to(device)[which])
        points_m = self._points_m.to(device)[which]
        truth = Rigid(batch.R, batch.t_m)
        error_m = model_point_loss(poses_of(outputs, batch.crop), truth, points_m, copies)
        yield Update("network", (error_m / self._diameter_m.to(device)[which]).mean(), {})

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Pose held-out views with the current network, without ICP."""
        cpu = DepthImageNet(self.network.config)
        cpu.load_state_dict(self.network.state_dict())
        weights = PoseWeights(network=cpu, models=self.models, cloud=self.config.cloud,
                              refusal=RefusalConfig(), facts={})  # fmt: skip
        regressor = DepthImageRegressor(weights, EstimateConfig(with_icp=False))
        numbers: dict[str, float] = {}
        for occlusion in self.config.held_out.occlusions:
            views = self._held_out(occlusion)
            found = regressor.estimate_many([view.input for view in views])
            errors = torch.tensor([
                pose_error(estimate, view.truth, self.models[index % len(self.models)])
                for index, (estimate, view) in enumerate(zip(found, views, strict=True))
            ])  # fmt: skip
            place = f"held_out/occluded_{round(100 * occlusion)}/regressed"
            numbers[f"{place}_add_10"] = float(is_within_diameter(errors).float().mean())
            numbers[f"{place}_median"] = float(errors.median())
        return ValidationResult(numbers=numbers)

    def _held_out(self, occlusion: float) -> list[ViewSample]:
        if occlusion not in self._views:
            c = self.config
            synthetic = held_out_objects(self.models, c.objects, c.cloud, c.held_out, occlusion)
            self._views[occlusion] = [synthetic.view(index) for index in range(len(synthetic))]
        return self._views[occlusion]


@releases_folder
def train_depth_image(config: DepthImageTraining, run: Run) -> Path:
    """Train the regression of depth images; give its weights file."""
    torch.manual_seed(config.loop.seed)
    models = read_models(config.models, run.on_message)
    config = dataclasses.replace(config, network=with_classes(config.network, models, config.cloud))
    network = DepthImageNet(config.network)
    if config.start is not None:
        found = read_pose_weights(find_weights(config.start)).network
        if found.config != config.network:
            raise InputError(
                f"{config.start}: holds {found.config}, but the config says {config.network}. Give "
                "the config the weights' own."
            )
        network.load_state_dict(found.state_dict())
    claim_run(config, run, config.models.cad)
    crops = TrainingCrops(models, config, config.loop.seed)
    task = DepthImageTask(network, models, config)
    seconds = run.train(task, crops, config.loop)
    path = run.folder / "depth-image.safetensors"
    if find_rank().rank:
        return path
    weights = packed(network, models, config)
    write_pose_weights(path, weights, with_half=config.with_half)
    measured = held_out_text(run.folder, _MEASURED)
    write_card(path, train_words("depth-image", config), seconds, card_facts(weights), measured)
    return path


def surface_points(models: Sequence[ObjectModel], count: int) -> Float[Tensor, "classes n 3"]:
    """Points of each object's surface; those of a sparse model of points come again."""
    every = [sample_surface(model, count)[0] for model in models]
    return torch.stack([points[torch.arange(count) % len(points)] for points in every])
