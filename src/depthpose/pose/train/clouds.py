"""The objects of a training, its samples of synthetic views or real frames, and held-out views."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Generic, NamedTuple, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.core.loop import ValidationResult, make_adam, sample_generator, shuffled_index
from depthpose.core.rigid import Rigid
from depthpose.pose.baselines import DepthImageNet
from depthpose.pose.cloud import lift_sample, why_too_few
from depthpose.pose.config import CloudConfig, ObjectsConfig
from depthpose.pose.datasets import open_bop
from depthpose.pose.datasets.layouts import read_bop_models, read_models_info
from depthpose.pose.grid import sample_points, voxelise
from depthpose.pose.mesh import (
    read_model,
    refuse_one_name,
    sample_surface,
    symmetry_transforms,
    with_found_symmetries,
)
from depthpose.pose.metrics import SUCCESS_SHARE, add_of_nearest_m
from depthpose.pose.network_pose import DepthImageRegressor, GeoPoseNet
from depthpose.pose.synthetic import Objects, make_part
from depthpose.pose.train.config import HeldOutConfig, ModelsConfig, PoseTraining, ViewsTraining
from depthpose.pose.types import (
    CloudSample,
    ObjectModel,
    PoseEstimate,
    ViewSample,
    VotingPoints,
)
from depthpose.pose.weights import PoseWeights

TRIES = 20  #: samples in a row that may show too few points
BEYOND_TRAINING = 2**32  #: samples of each object: no training has so many


class Cloud(NamedTuple):
    """One training sample: the point of each voxel, and the true pose, in the axes of the grid."""

    points_m: Float[Tensor, "n 3"]  #: in the axes of the grid about its camera
    coordinates: Int[Tensor, "n 3"]  #: (x, y, z) of their voxels
    features: Float[Tensor, "n c"]  #: of their voxels
    class_number: int  #: of the object
    R: Float[Tensor, "3 3"]  #: rotation of the pose
    t_m: Float[Tensor, "3"]  #: its translation


class CloudBatch(NamedTuple):
    """Several clouds, one after the other."""

    points_m: Float[Tensor, "points 3"]  #: each cloud in the axes of its grid about its camera
    coordinates: Int[Tensor, "points 4"]  #: (cloud, x, y, z) of each point's voxel
    features: Float[Tensor, "points c"]  #: of each voxel
    class_of: Int[Tensor, " clouds"]  #: class of each cloud
    R: Float[Tensor, "clouds 3 3"]  #: rotation of each cloud's pose
    t_m: Float[Tensor, "clouds 3"]  #: translation

    @property
    def network_input(self) -> VotingPoints:
        """The input of the network: everything but the truth."""
        return VotingPoints(
            points_m=self.points_m,
            coordinates=self.coordinates,
            features=self.features,
            class_of_point=self.class_of[self.coordinates[:, 0].long()],
        )


Config = TypeVar("Config", bound=ViewsTraining)


class TrainingViews(Generic[Config]):
    """The views of a training by sample index: synthetic ones, real frames, or both.

    ``seed`` determines the order of frames and the choice of points.
    """

    def __init__(self, models: Sequence[ObjectModel], config: Config, seed: int) -> None:
        self.models = models
        self.config = config
        self.seed = seed
        self.synthetic = Objects(models, config.objects, config.cloud)
        self._class_of = {model.name: k for k, model in enumerate(models)}
        self._frames = config.frames
        self._real = None
        frames = config.frames
        if frames is not None:
            dataset = open_bop(frames.folder, frames.split)
            self._real = dataset.of_objects(*(model.number for model in models))
            names = {model.number: model.name for model in models}
            for number, instances in self._real.objects.items():
                if names[number] != instances.name:
                    raise InputError(
                        f"{frames.folder}: object {number} is called {instances.name!r} there, and "
                        f"{names[number]!r} here; take the models from this folder (models: bop)"
                    )

    def __len__(self) -> int:
        if self._frames is None or self._real is None:
            return len(self.synthetic)
        return max(1, round(len(self._real) / self._frames.share))

    def _choose_view(self, place: int, generator: torch.Generator) -> tuple[ViewSample, bool]:
        """Choose a frame, with the probability of their share, or a synthetic view.

        The second value is whether it is a frame.
        """
        share = 0.0 if self._frames is None else self._frames.share
        if self._real is not None and float(torch.rand((), generator=generator)) < share:
            return self._real[shuffled_index(place, len(self._real), self.seed)], True
        return self.synthetic.view(place), False


class TrainingClouds(TrainingViews[PoseTraining]):
    """A cloud by sample index, synthetic or of a frame."""

    def __getitem__(self, index: int) -> Cloud:
        """Make the sample of an index; one with too few points is replaced by another.

        Raises:
            InputError: 20 in a row have too few points, so that the config must be wrong.
        """
        generator = sample_generator(index, self.seed)
        cloud_config = self.config.cloud
        # Sample i shows object i modulo their number.
        objects = len(self.models)
        for attempt in range(TRIES):
            # A further attempt takes an index beyond any training, of the same object.
            place = index + attempt * objects * BEYOND_TRAINING
            # At the start all show the first object, as multiples of the number do.
            if place < self.config.first_alone:
                place *= objects

            # Its cloud; that of a frame as a rolled camera sees it.
            view, is_frame = self._choose_view(place, generator)
            number = self._class_of[view.input.object]
            sample = lift_sample(view, self.models[number].diameter_m, cloud_config)
            if self._frames is not None and is_frame:
                angle_rad = 2 * math.pi * float(torch.rand((), generator=generator))
                if self._frames.with_roll:
                    sample = _roll_camera(sample, angle_rad)
            if why_too_few(sample.input.points_m, cloud_config) is None:
                return voxelise_sample(sample, number, cloud_config, generator)
        raise InputError(
            f"sample {index}: {TRIES} samples in a row have fewer than "
            f"{cloud_config.min_points} points; bring the camera nearer (distance_m), or lower "
            "min_points"
        )

    @staticmethod
    def collate(clouds: Sequence[Cloud]) -> CloudBatch:
        """Make a batch of clouds, one after the other."""
        coordinates: list[Tensor] = []
        for number, cloud in enumerate(clouds):
            numbers = torch.full((len(cloud.points_m), 1), number)
            coordinates.append(torch.cat([numbers, cloud.coordinates], 1))
        return CloudBatch(
            points_m=torch.cat([c.points_m for c in clouds]),
            coordinates=torch.cat(coordinates),
            features=torch.cat([c.features for c in clouds]),
            class_of=torch.tensor([c.class_number for c in clouds]),
            R=torch.stack([c.R for c in clouds]),
            t_m=torch.stack([c.t_m for c in clouds]),
        )


def _roll_camera(sample: CloudSample, angle_rad: float) -> CloudSample:
    """Roll the camera of a sample about its optical axis: its cloud and pose rotate."""
    c = math.cos(angle_rad)
    s = math.sin(angle_rad)
    roll = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    pose = sample.truth.camera_from_model
    rolled = Rigid(roll @ pose.R.float(), roll @ pose.t_m.float())
    points_m = sample.input.points_m.float() @ roll.mT
    return CloudSample(
        input=dataclasses.replace(sample.input, points_m=points_m),
        truth=dataclasses.replace(sample.truth, camera_from_model=rolled),
    )


def voxelise_sample(
    sample: CloudSample, class_number: int, config: CloudConfig, generator: torch.Generator
) -> Cloud:
    """Choose points of a sample and voxelise them, as an estimate does.

    Cloud and true pose are rotated to the axes of the grid.

    Args:
        sample: cloud and pose.
        class_number: of its object in the network.
        config: how many points, and the grid.
        generator: chooses the points.
    """
    points = sample_points(sample.input.points_m, config.max_points, generator)
    voxels = voxelise(points, config)
    grid_from_camera = voxels.grid_from_camera.float()
    pose = sample.truth.camera_from_model
    return Cloud(
        points_m=voxels.points_m.float() @ grid_from_camera.mT,
        coordinates=voxels.coordinates,
        features=voxels.features,
        class_number=class_number,
        R=grid_from_camera @ pose.R.float(),
        t_m=grid_from_camera @ pose.t_m.float(),
    )


def read_models(
    config: ModelsConfig, on_message: Callable[[str], None] | None = None
) -> tuple[ObjectModel, ...]:
    """Read the models that a training names.

    ``on_message`` is called with a sentence on symmetries that were found in a model.

    Raises:
        InputError: no model is named, or models of two kinds, CAD files without their unit, two of
            one name, or a damaged file.
    """
    # From one of three sources.
    sources = [name for name in ("cad", "bop", "parts") if getattr(config, name)]
    if len(sources) > 1:
        raise InputError(f"{' and '.join(sources)} are given; take the models from one of them")
    if config.parts:
        return tuple(make_part(p, n, config.mesh) for n, p in enumerate(config.parts, start=1))
    if not config.bop and not config.cad:
        raise InputError("there is no object to learn; name its CAD file (--cad FILE --unit mm)")
    if config.bop:
        folder = Path(config.bop)
        numbers = config.objects or _list_model_numbers(folder)
        models = tuple(read_bop_models(folder, numbers, config.mesh).values())
    else:
        models = tuple(
            read_model(path, config.unit, number=number, config=config.mesh)
            for number, path in enumerate(config.cad, start=1)
        )
        refuse_one_name(models)

    # With the symmetries of their shapes, where these are wanted.
    return tuple(
        with_found_symmetries(
            model,
            on_message,
            is_taken=config.with_found_symmetries,
            tolerance=config.symmetry_tolerance,
        )
        for model in models
    )


def _list_model_numbers(folder: Path) -> tuple[int, ...]:
    """List the numbers of all models of a data set, by their files and ``models_info``.

    Raises:
        InputError: there is none.
    """
    home, infos = read_models_info(folder)
    files = [path.stem.removeprefix("obj_") for path in home.glob("obj_*.ply")]
    numbers = {int(name) for name in files if name.isdigit()} | set(infos)
    if not numbers:
        raise InputError(f"{home}: holds no obj_NNNNNN.ply; put the models there")
    return tuple(sorted(numbers))


HELD_OUT_SEED = 0x4E1D  #: added to the seed of the views that are trained on
_SURFACE_POINTS = 1000  # by which ADD is measured


class ViewsTask:
    """Base of the tasks that train one network which poses, and validate it on held-out views.

    The views are rendered at the full resolution, equally many of each object at each occlusion.
    ``method`` says in the names of numbers how the network poses.
    """

    method: ClassVar[str]

    def __init__(
        self, network: nn.Module, models: Sequence[ObjectModel], config: ViewsTraining
    ) -> None:
        self.models = tuple(models)
        self.training = config
        self.modules: dict[str, nn.Module] = {"network": network.train()}
        self.optimizers = {"network": (make_adam(network.parameters(), config.adam), config.adam)}
        self._held_out: dict[float, list[ViewSample]] = {}

    def measure_held_out(self, view: ViewSample, index: int) -> float:
        """Pose a held-out view without ICP and refusal, and measure ADD by ``measure_add``."""
        raise NotImplementedError

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Measure ADD by occlusion: the share below a tenth of the diameter, and the median."""
        numbers: dict[str, float] = {}
        self.modules["network"].eval()
        config = self.training
        for occlusion in config.held_out.occlusions:
            # Views are drawn once.
            if occlusion not in self._held_out:
                objects = make_held_out_objects(
                    self.models, config.objects, config.cloud, config.held_out, occlusion
                )
                self._held_out[occlusion] = [objects.view(k) for k in range(len(objects))]

            # The error of each, and what the numbers of all are.
            views = self._held_out[occlusion]
            errors = torch.tensor([self.measure_held_out(view, k) for k, view in enumerate(views)])
            place = f"held_out/occluded_{round(100 * occlusion)}/{self.method}"
            numbers[f"{place}_add_10"] = float((errors < SUCCESS_SHARE).float().mean())
            numbers[f"{place}_median"] = float(errors.median())
        self.modules["network"].train()
        return ValidationResult(numbers=numbers)


def make_held_out_objects(
    models: Sequence[ObjectModel],
    synthetic: ObjectsConfig,
    cloud: CloudConfig,
    config: HeldOutConfig,
    occlusion: float,
) -> Objects:
    """Make views that no training uses, all of one occlusion.

    Args:
        models: of the objects.
        synthetic: the views of the training, of which these differ by seed and resolution.
        cloud: how they are lifted to clouds.
        config: how many views of each object.
        occlusion: occluded share of the silhouette.
    """
    held_out_config = dataclasses.replace(
        synthetic,
        number=config.number * len(models),
        seed=synthetic.seed + HELD_OUT_SEED,
        views=None,
        resolution=(1.0, 1.0),
        occluded_share=1.0,
        occlusion=(occlusion, occlusion),
    )
    return Objects(models, held_out_config, cloud)


def measure_add(estimated: Rigid | None, truth: Rigid, model: ObjectModel) -> float:
    """Measure ADD to the nearest symmetric pose, in diameters; infinite without an estimate."""
    if estimated is None:
        return math.inf
    points_m, _ = sample_surface(model, _SURFACE_POINTS)
    copies = symmetry_transforms(model.symmetries)
    return float(add_of_nearest_m(estimated, truth, points_m, copies)) / model.diameter_m


_CLOUDS_AT_ONCE = 32

Table = Mapping[str, Mapping[str, float | None]]
"""By occlusion in percent: the shares ``right``, ``ambiguous``, ``wrong`` and ``refused``, and the
``median`` error of all poses in diameters, None where there is none."""


def score_held_out(weights: PoseWeights, synthetic: ObjectsConfig, config: HeldOutConfig) -> Table:
    """Measure the shares of right, ambiguous, wrong and refused estimates, by occlusion.

    A pose of too low a certainty is ambiguous, whether right or not.

    Args:
        weights: the network and its objects.
        synthetic: the views, but for their occlusion.
        config: occlusions, and views of each object at each.
    """
    table: dict[str, dict[str, float | None]] = {}
    for occlusion in config.occlusions:
        objects = make_held_out_objects(weights.models, synthetic, weights.cloud, config, occlusion)
        estimates, errors = _estimate_views(weights, objects)
        answered = [e for e, estimate in zip(errors, estimates, strict=True) if estimate.is_ok]
        posed = sorted(e for e in errors if e < math.inf)
        right = sum(e < SUCCESS_SHARE for e in answered)
        table[f"{round(100 * occlusion)}"] = {
            "right": right / len(errors),
            "ambiguous": (len(posed) - len(answered)) / len(errors),
            "wrong": (len(answered) - right) / len(errors),
            "refused": 1 - len(posed) / len(errors),
            "median": posed[len(posed) // 2] if posed else None,
        }
    return table


def format_table(table: Table) -> str:
    """Format a table as Markdown."""
    lines = [
        "Synthetic views that no training saw, posed with ICP and refusal; right is an "
        "ADD, to the nearest symmetric pose, below a tenth of the diameter.",
        "",
        "| occluded % | right % | ambiguous % | wrong % | refused % | median error, % of size |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for occlusion, row in table.items():
        cells: list[str] = []
        for column in ("right", "ambiguous", "wrong", "refused", "median"):
            value = row[column]
            cells.append("-" if value is None else f"{100 * value:.1f}")
        lines.append(f"| {occlusion} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _estimate_views(
    weights: PoseWeights, objects: Objects
) -> tuple[list[PoseEstimate], list[float]]:
    """Estimate views of objects; give the estimates and their errors by ADD [diameters]."""
    is_regressed = isinstance(weights.network, DepthImageNet)
    net = DepthImageRegressor(weights) if is_regressed else GeoPoseNet(weights)
    estimates: list[PoseEstimate] = []
    errors: list[float] = []
    for start in range(0, len(objects), _CLOUDS_AT_ONCE):
        places = range(start, min(start + _CLOUDS_AT_ONCE, len(objects)))
        samples = [objects.view(place) for place in places]
        posed = net.estimate_many([sample.input for sample in samples])
        estimates += posed
        for place, estimate, sample in zip(places, posed, samples, strict=True):
            model = weights.models[place % len(weights.models)]
            pose = estimate.camera_from_model
            errors.append(measure_add(pose, sample.truth.camera_from_model, model))
    return estimates, errors
