"""Views that no training uses: the validation of a training, and the table of its card."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import nn

from depthpose.core.loop import ValidationResult, make_adam
from depthpose.core.rigid import Rigid
from depthpose.pose.config import CloudConfig, ObjectsConfig
from depthpose.pose.mesh import sample_surface, symmetry_transforms
from depthpose.pose.metrics import SUCCESS_SHARE, add_of_nearest_m
from depthpose.pose.network_pose import DepthImageRegressor, GeoPoseNet
from depthpose.pose.networks.baselines import DepthImageNet
from depthpose.pose.synthetic import SyntheticViews
from depthpose.pose.train.config import HeldOutConfig, ViewsTraining
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewSample
from depthpose.pose.weights import PoseWeights

HELD_OUT_SEED = 0x4E1D  #: added to the seed of the views that are trained on, to have others
_SURFACE_POINTS = 1000  # by which ADD is measured


class ViewsTask:
    """Base of the tasks that train one network which poses, and validate it on held-out views.

    The views are rendered at the full resolution, equally many of each object at each occlusion.
    """

    method: ClassVar[str]  #: how the network poses, in the names of the validation's numbers

    def __init__(
        self, network: nn.Module, models: Sequence[ObjectModel], config: ViewsTraining
    ) -> None:
        self.models = tuple(models)
        self.training = config
        self.modules: dict[str, nn.Module] = {"network": network.train()}
        self.optimizers = {"network": (make_adam(network.parameters(), config.adam), config.adam)}
        self._held_out: dict[float, list[ViewSample]] = {}

    def measure_view(self, view: ViewSample, index: int) -> float:
        """Pose a held-out view without ICP and refusal, and measure its ADD in diameters.

        Args:
            view: of the object with the number ``index`` modulo that of the models.
            index: of the view.
        """
        raise NotImplementedError

    @torch.no_grad()
    def validate(self) -> ValidationResult:
        """Measure ADD by occlusion: the share below a tenth of the diameter, and the median."""
        numbers: dict[str, float] = {}
        self.modules["network"].eval()
        config = self.training
        for occlusion in config.held_out.occlusions:
            # Views are rendered once.
            if occlusion not in self._held_out:
                views = make_held_out_views(
                    self.models, config.objects, config.cloud, config.held_out, occlusion
                )
                self._held_out[occlusion] = [views.view(k) for k in range(len(views))]

            # The error of each, and the numbers of all.
            samples = self._held_out[occlusion]
            errors = torch.tensor([self.measure_view(view, k) for k, view in enumerate(samples)])
            name = f"held_out/occluded_{round(100 * occlusion)}/{self.method}"
            numbers[f"{name}_add_10"] = float((errors < SUCCESS_SHARE).float().mean())
            numbers[f"{name}_median"] = float(errors.median())
        self.modules["network"].train()
        return ValidationResult(numbers=numbers)


def make_held_out_views(
    models: Sequence[ObjectModel],
    synthetic: ObjectsConfig,
    cloud: CloudConfig,
    config: HeldOutConfig,
    occlusion: float,
) -> SyntheticViews:
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
    return SyntheticViews(models, held_out_config, cloud)


def measure_add(estimated: Rigid | None, truth: Rigid, model: ObjectModel) -> float:
    """Measure the ADD of a pose to the nearest symmetric copy of the truth, in diameters.

    Args:
        estimated: ``camera_from_model``; None: there is no estimate, and the error is infinite.
        truth: the true pose.
        model: of the object.
    """
    if estimated is None:
        return math.inf
    points_m, _ = sample_surface(model, _SURFACE_POINTS)
    copies = symmetry_transforms(model.symmetries)
    return float(add_of_nearest_m(estimated, truth, points_m, copies)) / model.diameter_m


_CLOUDS_AT_ONCE = 32  # views that are rendered and estimated at a time

HeldOutTable = Mapping[str, Mapping[str, float | None]]
"""By occlusion in percent: the shares ``right``, ``ambiguous``, ``wrong`` and ``refused``, and the
``median`` error of all poses in diameters, None where there is none."""


def score_held_out(
    weights: PoseWeights, synthetic: ObjectsConfig, config: HeldOutConfig
) -> HeldOutTable:
    """Measure the shares of right, ambiguous, wrong and refused estimates, by occlusion.

    A pose of too low a certainty is ambiguous, whether right or not.

    Args:
        weights: the network and its objects.
        synthetic: the views, but for their occlusion.
        config: occlusions, and views of each object at each.
    """
    table: dict[str, dict[str, float | None]] = {}
    for occlusion in config.occlusions:
        views = make_held_out_views(weights.models, synthetic, weights.cloud, config, occlusion)
        estimates, errors = _estimate_views(weights, views)
        pairs = zip(errors, estimates, strict=True)
        ok_errors = [error for error, estimate in pairs if estimate.is_ok]
        posed_errors = sorted(error for error in errors if error < math.inf)
        right = sum(error < SUCCESS_SHARE for error in ok_errors)
        table[f"{round(100 * occlusion)}"] = {
            "right": right / len(errors),
            "ambiguous": (len(posed_errors) - len(ok_errors)) / len(errors),
            "wrong": (len(ok_errors) - right) / len(errors),
            "refused": 1 - len(posed_errors) / len(errors),
            "median": posed_errors[len(posed_errors) // 2] if posed_errors else None,
        }
    return table


def format_held_out_table(table: HeldOutTable) -> str:
    """Format a table of held-out views as Markdown."""
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
    weights: PoseWeights, views: SyntheticViews
) -> tuple[list[PoseEstimate], list[float]]:
    """Estimate the pose of each view; return the estimates, and their ADD in diameters."""
    is_regressed = isinstance(weights.network, DepthImageNet)
    net = DepthImageRegressor(weights) if is_regressed else GeoPoseNet(weights)
    estimates: list[PoseEstimate] = []
    errors: list[float] = []
    for start in range(0, len(views), _CLOUDS_AT_ONCE):
        places = range(start, min(start + _CLOUDS_AT_ONCE, len(views)))
        samples = [views.view(place) for place in places]
        posed = net.estimate_many([sample.input for sample in samples])
        estimates += posed
        for place, estimate, sample in zip(places, posed, samples, strict=True):
            model = weights.models[place % len(weights.models)]
            pose = estimate.camera_from_model
            errors.append(measure_add(pose, sample.truth.camera_from_model, model))
    return estimates, errors
