"""What a trained network is worth: its refusal calibrated, its success on views that nobody saw."""

import dataclasses
from collections.abc import Mapping

import torch

from depthpose.core.errors import InputError
from depthpose.pose.config import EstimateConfig, ObjectsConfig, RefusalConfig
from depthpose.pose.estimator import GeoPoseNet, calibrate_refusal
from depthpose.pose.metrics import is_within_diameter
from depthpose.pose.objects import Objects
from depthpose.pose.train.config import CalibrationConfig, HeldOutConfig
from depthpose.pose.train.held_out import held_out_objects, pose_error
from depthpose.pose.types import PoseEstimate
from depthpose.pose.weights import PoseWeights

_CALIBRATION_SEED = 0xCA11B
_FIRST = 50
_TOGETHER = 32
_KEPT = ("min_hold", "max_scale_error", "candidate_slopes")
"""Of a refusal: not chosen by calibration."""

Table = Mapping[str, Mapping[str, float | None]]
"""By occlusion in percent: shares of right, wrong and refused, and the median error of the answers
in diameters, None where there is no answer."""


def calibrated(weights: PoseWeights, made: ObjectsConfig, config: CalibrationConfig) -> PoseWeights:
    """Choose when answers are withheld, on made views from easy to hard.

    Where not one view is answered there is nothing to choose by, and the weights stay as they are.
    Where none of the first 50 of each object is right, no more are looked at.
    """
    if config.number == 0:
        return weights
    kept = {name: getattr(weights.refusal, name) for name in _KEPT}
    opened = RefusalConfig(max_risk=1.0, **kept)
    open_weights = dataclasses.replace(weights, refusal=opened)
    views = dataclasses.replace(
        made,
        seed=made.seed + _CALIBRATION_SEED,
        views=None,
        resolution=(1.0, 1.0),
        occluded_share=1.0,
        occlusion=config.occlusion,
    )
    estimates: list[PoseEstimate] = []
    is_right: list[bool] = []
    for number in dict.fromkeys((min(_FIRST, config.number), config.number)):
        some = dataclasses.replace(views, number=number * len(weights.models))
        estimates, errors = _posed(open_weights, Objects(weights.models, some, weights.cloud))
        is_right = is_within_diameter(torch.tensor(errors)).tolist()
        if not any(is_right):
            break
    try:
        refusal = calibrate_refusal(estimates, is_right, config.max_wrong_share)
    except InputError:
        return weights
    refusal = dataclasses.replace(refusal, **kept)
    return dataclasses.replace(weights, refusal=refusal)


def judged(weights: PoseWeights, made: ObjectsConfig, config: HeldOutConfig) -> Table:
    """Count right, wrong and refused answers of the whole estimator, by occlusion."""
    table: dict[str, dict[str, float | None]] = {}
    for occlusion in config.occlusions:
        objects = held_out_objects(weights.models, made, weights.cloud, config, occlusion)
        estimates, errors = _posed(weights, objects)
        answered = [e for e, estimate in zip(errors, estimates, strict=True) if estimate.is_ok]
        right = int(is_within_diameter(torch.tensor(answered)).sum())
        table[f"{round(100 * occlusion)}"] = {
            "right": right / len(errors),
            "wrong": (len(answered) - right) / len(errors),
            "refused": 1 - len(answered) / len(errors),
            "median": sorted(answered)[len(answered) // 2] if answered else None,
        }
    return table


def table_text(table: Table) -> str:
    """Show what was counted, for people."""
    lines = [
        "Made views that no training saw, posed with voting, ICP and refusal; right is an "
        "ADD(-S) below a tenth of the diameter.",
        "",
        "| hidden % | right % | wrong % | refused % | median error, % of diameter |",
        "| --- | --- | --- | --- | --- |",
    ]
    for hidden, row in table.items():
        given = [row[k] for k in ("right", "wrong", "refused", "median")]
        values = " | ".join("-" if value is None else f"{100 * value:.1f}" for value in given)
        lines.append(f"| {hidden} | {values} |")
    return "\n".join(lines)


def _posed(weights: PoseWeights, objects: Objects) -> tuple[list[PoseEstimate], list[float]]:
    net = GeoPoseNet(weights, EstimateConfig())
    estimates, errors = [], []
    for start in range(0, len(objects), _TOGETHER):
        samples = [objects[i] for i in range(start, min(start + _TOGETHER, len(objects)))]
        found = net.estimate_many([sample.input for sample in samples])
        estimates += found
        for offset, (estimate, sample) in enumerate(zip(found, samples, strict=True)):
            model = weights.models[(start + offset) % len(weights.models)]
            errors.append(pose_error(estimate, sample.truth, model))
    return estimates, errors
