"""Held-out synthetic views: how often the network finds the pose."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.loop import ValidationResult, sample_generator
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import refusal_of
from depthpose.pose.config import CloudConfig, EstimateConfig, ObjectsConfig
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.mesh import sample_surface, symmetry_transforms
from depthpose.pose.metrics import add_of_nearest_m, is_within_diameter
from depthpose.pose.synthetic import Objects
from depthpose.pose.train.clouds import Cloud, collate_clouds, voxelised_cloud
from depthpose.pose.train.config import HeldOutConfig
from depthpose.pose.types import ObjectModel, PoseEstimate, PoseTruth, Vote
from depthpose.pose.voting import fit_pose, meet_lines, vote_ransac
from depthpose.pose.weights import DirectionNet, PoseWeights

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
        missing = [math.inf] * (self._wanted - len(self._of(occlusion)))
        return {method: torch.tensor(errors + missing) for method, errors in found.items()}

    @property
    def _wanted(self) -> int:
        return self.config.number * len(self.models)

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
            seen = collate_clouds(part).seen.to(device)
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
