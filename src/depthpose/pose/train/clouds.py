"""The objects of a training, and its samples of synthetic views or real frames."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.loop import make_sample_generator, shuffle_index
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import lift_sample
from depthpose.pose.config import CloudConfig
from depthpose.pose.datasets import BopDataset, open_bop
from depthpose.pose.datasets.layouts import read_bop_models, read_models_info
from depthpose.pose.geometry.grid import sample_points, voxelise
from depthpose.pose.mesh import (
    describe_found_symmetries,
    read_model,
    refuse_equal_names,
    with_found_symmetries,
)
from depthpose.pose.synthetic import SyntheticViews, make_part
from depthpose.pose.train.config import FramesConfig, ModelsConfig, PoseTraining, ViewsTraining
from depthpose.pose.types import (
    CloudSample,
    ObjectModel,
    ViewSample,
    VotingPoints,
)

TRIES = 20  #: samples in a row that may show too few points
BEYOND_TRAINING = 2**32  #: samples of each object: no training has so many


class TrainingCloud(NamedTuple):
    """One training sample: the point of each voxel, and the true pose.

    Both are in the axes of the voxel grid about the camera.
    """

    points_m: Float[Tensor, "n 3"]  #: one of each voxel
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

    Args:
        models: of the objects.
        config: of the views.
        seed: of the order of frames and the choice of points.

    Raises:
        InputError: there are no such frames, or their objects have other names than the models.
    """

    def __init__(self, models: Sequence[ObjectModel], config: Config, seed: int) -> None:
        self.models = models
        self.config = config
        self.seed = seed
        self.synthetic = SyntheticViews(models, config.objects, config.cloud)
        self._class_of = {model.name: k for k, model in enumerate(models)}
        self._frames = config.frames
        self._real = None if config.frames is None else _open_frames(config.frames, models)

    def __len__(self) -> int:
        if self._frames is None or self._real is None:
            return len(self.synthetic)
        return max(1, round(len(self._real) / self._frames.share))

    def _choose_view(self, place: int, generator: torch.Generator) -> tuple[ViewSample, bool]:
        """Choose a frame, with the probability of their share, or synthetic view ``place``.

        Returns:
            The view, and whether it is a frame.
        """
        share = 0.0 if self._frames is None else self._frames.share
        if self._real is not None and float(torch.rand((), generator=generator)) < share:
            return self._real[shuffle_index(place, len(self._real), self.seed)], True
        return self.synthetic.view(place), False


def _open_frames(config: FramesConfig, models: Sequence[ObjectModel]) -> BopDataset:
    """Open the real frames of a training, of its objects alone.

    Raises:
        InputError: there are none, or an object has another name there.
    """
    frames = open_bop(config.folder, config.split)
    frames = frames.of_objects(*(model.number for model in models))
    names = {model.number: model.name for model in models}
    for number, model in frames.objects.items():
        if names[number] != model.name:
            raise InputError(
                f"{config.folder}: object {number} is called {model.name!r} there, and "
                f"{names[number]!r} here; take the models from this folder (models: bop)"
            )
    return frames


class TrainingClouds(TrainingViews[PoseTraining]):
    """Clouds to learn directions from, by sample index: of synthetic views or frames."""

    def __getitem__(self, index: int) -> TrainingCloud:
        """Make the sample of an index; one with too few points is replaced by another.

        Raises:
            InputError: 20 in a row have too few points, so that the config must be wrong.
        """
        generator = make_sample_generator(index, self.seed)
        cloud_config = self.config.cloud
        # Sample i shows object i modulo their number.
        objects = len(self.models)
        for attempt in range(TRIES):
            # A further attempt takes an index beyond any training, of the same object.
            place = index + attempt * objects * BEYOND_TRAINING
            # At the start all show the first object, as multiples of the number do.
            if place < self.config.first_alone:
                place *= objects

            # Its cloud; that of a frame as a camera sees it that is rolled at random.
            view, is_frame = self._choose_view(place, generator)
            number = self._class_of[view.input.object]
            sample = lift_sample(view, self.models[number].diameter_m, cloud_config)
            if self._frames is not None and is_frame:
                angle_rad = 2 * math.pi * float(torch.rand((), generator=generator))
                if self._frames.with_roll:
                    sample = _roll_camera(sample, angle_rad)
            if len(sample.input.points_m) >= cloud_config.min_points:
                return voxelise_sample(sample, number, cloud_config, generator)
        raise InputError(
            f"sample {index}: {TRIES} samples in a row have fewer than "
            f"{cloud_config.min_points} points; bring the camera nearer (distance_m), or lower "
            "min_points"
        )

    @staticmethod
    def collate(clouds: Sequence[TrainingCloud]) -> CloudBatch:
        """Make a batch of clouds, one after the other."""
        coordinates: list[Tensor] = []
        for number, cloud in enumerate(clouds):
            cloud_numbers = torch.full((len(cloud.points_m), 1), number)
            coordinates.append(torch.cat([cloud_numbers, cloud.coordinates], 1))
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
    cosine = math.cos(angle_rad)
    sine = math.sin(angle_rad)
    roll = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    pose = sample.truth.camera_from_model
    rolled = Rigid(roll @ pose.R.float(), roll @ pose.t_m.float())
    points_m = sample.input.points_m.float() @ roll.mT
    return CloudSample(
        input=dataclasses.replace(sample.input, points_m=points_m),
        truth=dataclasses.replace(sample.truth, camera_from_model=rolled),
    )


def voxelise_sample(
    sample: CloudSample, class_number: int, config: CloudConfig, generator: torch.Generator
) -> TrainingCloud:
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
    return TrainingCloud(
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
    """Read the models of the objects that a training learns.

    Args:
        config: where they are, and whether symmetries of their shapes are searched.
        on_message: called with a sentence on symmetries that were found in a model.

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
        refuse_equal_names(models)

    # With the symmetries of their shapes, if these are wanted; else they are only reported.
    are_used = config.with_found_symmetries
    if not are_used and on_message is None:
        return models
    searched = tuple(with_found_symmetries(model, config.symmetry_tolerance) for model in models)
    if on_message is not None:
        for sentence in describe_found_symmetries(models, searched, are_used=are_used):
            on_message(sentence)
    return searched if are_used else models


def _list_model_numbers(folder: Path) -> tuple[int, ...]:
    """List the numbers of all models of a dataset, by their files and ``models_info``.

    Raises:
        InputError: there is none.
    """
    home, infos = read_models_info(folder)
    files = [path.stem.removeprefix("obj_") for path in home.glob("obj_*.ply")]
    numbers = {int(name) for name in files if name.isdigit()} | set(infos)
    if not numbers:
        raise InputError(f"{home}: holds no obj_NNNNNN.ply; put the models there")
    return tuple(sorted(numbers))
