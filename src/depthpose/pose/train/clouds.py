"""The objects of a training, their clouds, synthetic or real, and those held out."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.loop import ValidationResult, sample_generator, shuffled_index
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import refusal_of, sample_points, voxelise
from depthpose.pose.config import CloudConfig, EstimateConfig, ObjectsConfig
from depthpose.pose.datasets import BopDataset, open_bop
from depthpose.pose.datasets.layouts import models_folder, read_bop_models, read_models_info
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.mesh import (
    read_model,
    refuse_one_name,
    sample_surface,
    symmetry_transforms,
    with_found_symmetries,
)
from depthpose.pose.metrics import add_of_nearest_m, is_within_diameter
from depthpose.pose.synthetic import Objects, make_part
from depthpose.pose.train.config import FramesConfig, HeldOutConfig, ModelsConfig
from depthpose.pose.types import (
    CloudInput,
    CloudSample,
    ObjectModel,
    PoseEstimate,
    PoseTruth,
    SeenPoints,
    Vote,
)
from depthpose.pose.voting import fit_pose, meet_lines, vote_ransac
from depthpose.pose.weights import DirectionNet, PoseWeights

_TRIES = 20


class Cloud(NamedTuple):
    """One training sample: the points that were kept, and the truth, in the axes of the grid."""

    points_m: Float[Tensor, "n 3"]
    coordinates: Int[Tensor, "n 3"]
    features: Float[Tensor, "n c"]
    class_number: int
    R: Float[Tensor, "3 3"]
    t_m: Float[Tensor, "3"]


class CloudBatch(NamedTuple):
    """Several clouds, one after the other.

    Attributes:
        points_m: of all clouds, each in the axes of its grid about its camera.
        coordinates: (cloud, x, y, z) of each point's voxel.
        features: of each voxel.
        class_of: class of each cloud.
        R: rotation of each cloud's pose.
        t_m: translation.
    """

    points_m: Float[Tensor, "points 3"]
    coordinates: Int[Tensor, "points 4"]
    features: Float[Tensor, "points c"]
    class_of: Int[Tensor, " clouds"]
    R: Float[Tensor, "clouds 3 3"]
    t_m: Float[Tensor, "clouds 3"]

    @property
    def instance(self) -> Int[Tensor, " points"]:
        """Which cloud each point belongs to."""
        return self.coordinates[:, 0].long()

    @property
    def seen(self) -> SeenPoints:
        """What the network is shown: everything but the truth."""
        return SeenPoints(
            points_m=self.points_m,
            coordinates=self.coordinates,
            features=self.features,
            class_of_point=self.class_of[self.instance],
        )


class TrainingClouds:
    """A cloud by sample index, synthetic or of a frame.

    Args:
        models: the objects; class k is ``models[k]``.
        synthetic: how synthetic views look.
        frames: real frames, and their share.
        cloud: points and voxels.
        seed: of the order of frames and of the choice of points.
        first_alone: so many synthetic views at the start show the first object.

    Raises:
        InputError: frames of other objects.
    """

    def __init__(
        self,
        models: Sequence[ObjectModel],
        synthetic: ObjectsConfig,
        frames: FramesConfig | None,
        cloud: CloudConfig,
        seed: int,
        first_alone: int = 0,
    ) -> None:
        self.cloud, self.seed, self.frames = cloud, seed, frames
        self._first_alone = first_alone
        self.synthetic = Objects(models, synthetic, cloud)
        self._class_of = {model.name: k for k, model in enumerate(models)}
        self._real = None if frames is None else open_frames(frames, models, cloud)

    def __len__(self) -> int:
        """Samples of an epoch: each frame once, or as many as there are synthetic views."""
        return epoch_samples(self.frames, self._real, len(self.synthetic))

    def __getitem__(self, index: int) -> Cloud:
        """Make the sample of an index; one with too few points is replaced by another.

        Raises:
            InputError: so many in a row have too few points that the config must be wrong.
        """
        generator = sample_generator(index, self.seed)
        for attempt in range(_TRIES):
            # Far beyond any training, and the same object.
            sample = self._sample(index + attempt * len(self._class_of) * 2**32, generator)
            points = sample.input.points_m
            if refusal_of(points, self.cloud) is None:
                number = self._class_of[sample.input.object]
                return voxelised_cloud(sample, number, self.cloud, generator)
        raise InputError(
            f"sample {index}: {_TRIES} samples in a row have fewer than "
            f"{self.cloud.min_points} points; bring the camera nearer (distance_m), or lower "
            "min_points"
        )

    @staticmethod
    def collate(clouds: Sequence[Cloud]) -> CloudBatch:
        """Put clouds one after the other."""
        numbers = [torch.full((len(c.points_m), 1), k) for k, c in enumerate(clouds)]
        return CloudBatch(
            points_m=torch.cat([c.points_m for c in clouds]),
            coordinates=torch.cat(
                [torch.cat([n, c.coordinates], 1) for n, c in zip(numbers, clouds, strict=True)]
            ),
            features=torch.cat([c.features for c in clouds]),
            class_of=torch.tensor([c.class_number for c in clouds]),
            R=torch.stack([c.R for c in clouds]),
            t_m=torch.stack([c.t_m for c in clouds]),
        )

    def _sample(self, index: int, generator: torch.Generator) -> CloudSample:
        # Sample i shows object i modulo their number.
        index = index * len(self._class_of) if index < self._first_alone else index
        place = frame_place(self.frames, self._real, index, self.seed, generator)
        if self._real is None or self.frames is None or place is None:
            return self.synthetic.sample(index)
        sample = self._real[place]
        angle = 2 * math.pi * float(torch.rand((), generator=generator))
        return _rolled(sample, angle) if self.frames.with_roll else sample


def voxelised_cloud(
    sample: CloudSample, class_number: int, config: CloudConfig, generator: torch.Generator
) -> Cloud:
    """Take points of a sample and put them on the grid, as an estimate would.

    Cloud and truth are turned with the grid.
    """
    points = sample_points(sample.input.points_m, config.max_points, generator)
    voxels = voxelise(points, config)
    turn, pose = voxels.grid_from_camera.float(), sample.truth.camera_from_model
    return Cloud(
        points_m=points[voxels.kept].float() @ turn.mT,
        coordinates=voxels.coordinates,
        features=voxels.features,
        class_number=class_number,
        R=turn @ pose.R.float(),
        t_m=turn @ pose.t_m.float(),
    )


def epoch_samples(frames: FramesConfig | None, real: BopDataset | None, synthetic: int) -> int:
    """Samples of an epoch: each frame once, or as many as there are synthetic views."""
    if frames is None or real is None:
        return synthetic
    return max(1, round(len(real) / frames.share))


def frame_place(
    frames: FramesConfig | None,
    real: BopDataset | None,
    index: int,
    seed: int,
    generator: torch.Generator,
) -> int | None:
    """Choose which instance of the frames a sample shows; None: it is a synthetic view."""
    if frames is None or real is None or float(torch.rand((), generator=generator)) >= frames.share:
        return None
    return shuffled_index(index, len(real), seed)


def open_frames(
    frames: FramesConfig, models: Sequence[ObjectModel], cloud: CloudConfig
) -> BopDataset:
    """Open the real frames of a training, of its objects alone."""
    dataset = open_bop(frames.folder, frames.split, cloud=cloud)
    dataset = dataset.of_objects(*(model.number for model in models))
    known = {model.number: model.name for model in models}
    for number, found in dataset.objects.items():
        if known[number] != found.name:
            raise InputError(
                f"{frames.folder}: object {number} is called {found.name!r} there, and "
                f"{known[number]!r} here; take the models from this folder (models: bop)"
            )
    return dataset


def _rolled(sample: CloudSample, angle_rad: float) -> CloudSample:
    """Turn the camera about its optical axis: cloud and pose turn with it."""
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    turn = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    given, pose = sample.input, sample.truth.camera_from_model
    points_m = given.points_m.float() @ turn.mT
    turned = Rigid(turn @ pose.R.float(), turn @ pose.t_m.float())
    return CloudSample(
        input=CloudInput(name=given.name, points_m=points_m, object=given.object),
        truth=PoseTruth(
            camera_from_model=turned,
            visible_fraction=sample.truth.visible_fraction,
            is_measured=sample.truth.is_measured,
        ),
    )


def read_models(
    config: ModelsConfig, on_message: Callable[[str], None] | None = None
) -> tuple[ObjectModel, ...]:
    """Read the models that a training names.

    Args:
        config: which.
        on_message: called with symmetries that were found and are not declared, taken or not.

    Raises:
        InputError: none is named, or of two kinds, CAD files without their unit, two have one name,
            or a file is damaged.
    """
    given = [name for name in ("cad", "bop", "parts") if getattr(config, name)]
    if len(given) > 1:
        raise InputError(f"{' and '.join(given)} are given; take the models from one of them")
    if config.parts:
        return tuple(make_part(p, n, config.mesh) for n, p in enumerate(config.parts, start=1))
    if not config.bop and not config.cad:
        raise InputError("there is no object to learn; name its CAD file (--cad FILE --unit mm)")
    if config.bop:
        folder = Path(config.bop)
        numbers = config.objects or _numbers(models_folder(folder))
        models = tuple(read_bop_models(folder, numbers, config.mesh).values())
    else:
        models = tuple(
            read_model(path, config.unit, number=number, config=config.mesh)
            for number, path in enumerate(config.cad, start=1)
        )
        refuse_one_name(models)
    return tuple(
        with_found_symmetries(
            model,
            on_message,
            is_taken=config.with_found_symmetries,
            tolerance=config.symmetry_tolerance,
        )
        for model in models
    )


def _numbers(home: Path) -> list[int]:
    known = read_models_info(home)
    files = [path.stem.removeprefix("obj_") for path in home.glob("obj_*.ply")]
    found = sorted({int(name) for name in files if name.isdigit()} | set(known))
    if not found:
        raise InputError(f"{home}: holds no obj_NNNNNN.ply; put the models there")
    return found


HELD_OUT_SEED = 0x4E1D
"""Added to the seed of the views that are trained on."""
_TOGETHER = 8
_SURFACE = 1000


class HeldOut:
    """Clouds that are rendered once, and measured at each validation.

    Each is a rendering of its own at the full resolution; so many of each object are at each
    occlusion. One that shows too few points to be posed counts as a failure.

    Args:
        models: the objects; class k is ``models[k]``.
        synthetic: how the views of the training look.
        cloud: points and voxels.
        config: how many.
    """

    def __init__(
        self,
        models: Sequence[ObjectModel],
        synthetic: ObjectsConfig,
        cloud: CloudConfig,
        config: HeldOutConfig,
    ) -> None:
        self.models, self.config = models, config
        self._surfaces = [sample_surface(model, _SURFACE)[0] for model in models]
        self._synthetic, self._cloud = synthetic, cloud
        self._clouds: dict[float, list[Cloud]] = {}

    @torch.no_grad()
    def look(self, network: DirectionNet) -> ValidationResult:
        """Share of ADD below a tenth of the diameter, and its median; to the nearest symmetry."""
        numbers: dict[str, float] = {}
        for occlusion in self.config.occlusions:
            for method, errors in self._errors(network, occlusion).items():
                place = f"held_out/occluded_{round(100 * occlusion)}/{method}"
                numbers[f"{place}_add_10"] = float(is_within_diameter(errors).float().mean())
                numbers[f"{place}_median"] = float(errors.median())
        return ValidationResult(numbers=numbers)

    def _errors(self, network: DirectionNet, occlusion: float) -> dict[str, Float[Tensor, " n"]]:
        methods = ["lines", "ransac"] if self.config.with_ransac else ["lines"]
        found: dict[str, list[float]] = {method: [] for method in methods}
        for cloud, directions in self._directions(network, self._of(occlusion)):
            points = cloud.points_m.to(directions)
            found["lines"].append(self._error(meet_lines(points, directions), cloud))
            if self.config.with_ransac:
                found["ransac"].append(self._error(vote_ransac(points, directions), cloud))
        wanted = self.config.number * len(self.models)
        missing = [math.inf] * (wanted - len(self._of(occlusion)))
        return {method: torch.tensor(errors + missing) for method, errors in found.items()}

    def _error(self, vote: Vote, cloud: Cloud) -> float:
        """ADD to the nearest symmetric pose, in diameters."""
        model = self.models[cloud.class_number]
        fit = fit_pose(vote.keypoints_m.cpu(), vote.covariance_m2.cpu(), model.keypoints_m)
        truth, points = Rigid(cloud.R, cloud.t_m), self._surfaces[cloud.class_number]
        return _share(fit.camera_from_model, truth, model, points)

    def _directions(
        self, network: DirectionNet, clouds: Sequence[Cloud]
    ) -> Iterator[tuple[Cloud, Float[Tensor, "n k 3"]]]:
        device = next(network.parameters()).device
        for start in range(0, len(clouds), _TOGETHER):
            part = clouds[start : start + _TOGETHER]
            seen = TrainingClouds.collate(part).seen.to(device)
            outputs = network.directions(seen).float()[..., :3]
            sizes = [len(cloud.points_m) for cloud in part]
            yield from zip(part, outputs.split(sizes), strict=True)

    def _of(self, occlusion: float) -> list[Cloud]:
        if occlusion not in self._clouds:
            objects = held_out_objects(
                self.models, self._synthetic, self._cloud, self.config, occlusion
            )
            self._clouds[occlusion] = list(self._voxelised(objects))
        return self._clouds[occlusion]

    def _voxelised(self, objects: Objects) -> Iterator[Cloud]:
        for index in range(len(objects)):
            sample = objects[index]
            if refusal_of(sample.input.points_m, self._cloud) is None:
                generator = sample_generator(index, HELD_OUT_SEED)
                number = index % len(self.models)
                yield voxelised_cloud(sample, number, self._cloud, generator)


def held_out_objects(
    models: Sequence[ObjectModel],
    synthetic: ObjectsConfig,
    cloud: CloudConfig,
    config: HeldOutConfig,
    occlusion: float,
) -> Objects:
    """Make the views that no training sees, all of one occlusion."""
    config_here = dataclasses.replace(
        synthetic,
        number=config.number * len(models),
        seed=synthetic.seed + HELD_OUT_SEED,
        views=None,
        resolution=(1.0, 1.0),
        occluded_share=1.0,
        occlusion=(occlusion, occlusion),
    )
    return Objects(models, config_here, cloud)


def pose_error(estimate: PoseEstimate, truth: PoseTruth, model: ObjectModel) -> float:
    """ADD to the nearest symmetric pose, in diameters; infinite where there is no answer."""
    found = estimate.camera_from_model
    if found is None:
        return math.inf
    return _share(found, truth.camera_from_model, model, sample_surface(model, _SURFACE)[0])


def _share(found: Rigid, truth: Rigid, model: ObjectModel, points_m: Tensor) -> float:
    copies = symmetry_transforms(model.symmetries)
    return float(add_of_nearest_m(found, truth, points_m, copies)) / model.diameter_m


_CLOUDS_AT_ONCE = 32

Table = Mapping[str, Mapping[str, float | None]]
"""By occlusion in percent: shares of right, ambiguous, wrong and refused, and the median error of
all poses in diameters, None where there is none."""


def score_held_out(weights: PoseWeights, synthetic: ObjectsConfig, config: HeldOutConfig) -> Table:
    """Count right, wrong and refused answers of the whole estimator, by occlusion.

    Ambiguous are those whose certainty is too low for an answer, whether right or not.
    """
    table: dict[str, dict[str, float | None]] = {}
    for occlusion in config.occlusions:
        objects = held_out_objects(weights.models, synthetic, weights.cloud, config, occlusion)
        estimates, errors = _posed(weights, objects)
        answered = [e for e, estimate in zip(errors, estimates, strict=True) if estimate.is_ok]
        posed = sorted(e for e in errors if e < math.inf)
        right = int(is_within_diameter(torch.tensor(answered)).sum())
        table[f"{round(100 * occlusion)}"] = {
            "right": right / len(errors),
            "ambiguous": (len(posed) - len(answered)) / len(errors),
            "wrong": (len(answered) - right) / len(errors),
            "refused": 1 - len(posed) / len(errors),
            "median": posed[len(posed) // 2] if posed else None,
        }
    return table


def table_text(table: Table) -> str:
    """Show what was counted, for people."""
    lines = [
        "Synthetic views that no training saw, posed with voting, ICP and refusal; right is an "
        "ADD, to the nearest symmetric pose, below a tenth of the diameter.",
        "",
        "| occluded % | right % | ambiguous % | wrong % | refused % | median error, % of size |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for occlusion, row in table.items():
        given = [row[k] for k in ("right", "ambiguous", "wrong", "refused", "median")]
        values = " | ".join("-" if value is None else f"{100 * value:.1f}" for value in given)
        lines.append(f"| {occlusion} | {values} |")
    return "\n".join(lines)


def _posed(weights: PoseWeights, objects: Objects) -> tuple[list[PoseEstimate], list[float]]:
    net = GeoPoseNet(weights, EstimateConfig())
    estimates, errors = [], []
    for start in range(0, len(objects), _CLOUDS_AT_ONCE):
        samples = [
            objects.view(i) for i in range(start, min(start + _CLOUDS_AT_ONCE, len(objects)))
        ]
        found = net.estimate_many([sample.input for sample in samples])
        estimates += found
        for offset, (estimate, sample) in enumerate(zip(found, samples, strict=True)):
            model = weights.models[(start + offset) % len(weights.models)]
            errors.append(pose_error(estimate, sample.truth, model))
    return estimates, errors
