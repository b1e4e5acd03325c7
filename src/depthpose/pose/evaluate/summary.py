"""Rows of instances to rows of objects, to their mean and to risk by coverage."""

import hashlib
import math
import statistics
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import torch

from depthpose.core.errors import InputError
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import BopDataset, Instance, Target
from depthpose.pose.evaluate.errors import METRICS
from depthpose.pose.evaluate.rows import InstanceRow, Number, ObjectRow, RiskRow
from depthpose.pose.metrics import risk_coverage
from depthpose.pose.predictions import Place, place_of
from depthpose.pose.types import POSED, ObjectModel

_RECALLS = ("ar_vsd", "ar_mssd", "ar_mspd")
_DECILES = 10


def object_row(name: str, rows: Sequence[InstanceRow]) -> ObjectRow:
    """Sum up the instances of an object, or of all objects.

    ``success``, ``refused`` and ``wrong`` add up to 1: an instance without an answer is refused.
    Medians are of the answers alone; all else counts everything.

    Args:
        name: what the row is called.
        rows: one an instance.
    """
    count = len(rows)
    success = sum(row.is_success for row in rows) / count
    coverage = sum(row.status in POSED for row in rows) / count
    return ObjectRow(
        object=name,
        instances=count,
        annotated=sum(row.truth == "annotated" for row in rows),
        success=success,
        refused=1 - coverage,
        wrong=coverage - success,
        coverage=coverage,
        scores=_scores(rows),
        ms={stage: _mean([row.ms[stage] for row in rows]) for stage in rows[0].ms},
    )


def mean_row(rows: Sequence[ObjectRow]) -> ObjectRow:
    """Average the rows of objects: each object counts the same, as in LineMOD's tables."""
    count = len(rows)
    scores = {name: [row.scores[name] for row in rows] for name in rows[0].scores}
    return ObjectRow(
        object="mean",
        instances=sum(row.instances for row in rows),
        annotated=sum(row.annotated for row in rows),
        success=sum(row.success for row in rows) / count,
        refused=sum(row.refused for row in rows) / count,
        wrong=sum(row.wrong for row in rows) / count,
        coverage=sum(row.coverage for row in rows) / count,
        # A recall of some objects alone would pass for that of all; a median is of the answers.
        scores={
            name: _mean(values) if None not in values or name.endswith("_median") else None
            for name, values in scores.items()
        },
        ms={stage: _mean([row.ms[stage] for row in rows]) for stage in rows[0].ms},
    )


def risk_rows(rows: Sequence[InstanceRow]) -> list[RiskRow]:
    """Say how many answers are wrong if only the surest are given: ten shares of all instances.

    ``coverage`` 0.1 is the surest tenth of the instances. It ends with the answers.
    """
    answered = [row for row in rows if row.status in POSED and row.score is not None]
    answered.sort(key=lambda row: -(row.score or 0.0))
    ranks = torch.full((len(rows),), math.inf, dtype=torch.float64)
    ranks[: len(answered)] = torch.arange(len(answered), dtype=torch.float64)
    is_right = torch.zeros(len(rows), dtype=torch.bool)
    is_right[: len(answered)] = torch.tensor([row.is_success for row in answered], dtype=torch.bool)
    coverage, risk = risk_coverage(ranks, is_right)
    tenths = (round(k * len(rows) / _DECILES) for k in range(1, _DECILES + 1))
    counts = dict.fromkeys(min(count, len(answered)) for count in tenths)
    return [
        RiskRow(
            coverage=float(coverage[count - 1]),
            answers=count,
            least_score=answered[count - 1].score,
            risk=float(risk[count - 1]),
        )
        for count in counts
        if count
    ]


def _scores(rows: Sequence[InstanceRow]) -> dict[str, Number]:
    """Sum up every metric; then BOP's average recall; then the medians of the answers."""
    answered = [row for row in rows if row.status in POSED]
    diameters_m = torch.tensor([row.diameter_m for row in rows], dtype=torch.float64)
    found: dict[str, Number] = {}
    for name, metric in METRICS.items():
        is_measured = all(name in row.errors for row in rows)
        errors = torch.stack([row.errors[name] for row in rows]) if is_measured else None
        for column, summary in metric.summaries.items():
            found[column] = None if errors is None else summary(errors, diameters_m)
    known = [value for value in map(found.get, _RECALLS) if value is not None]
    found["ar"] = sum(known) / len(_RECALLS) if len(known) == len(_RECALLS) else None
    for name in (name for name, metric in METRICS.items() if metric.has_median):
        values = [float(row.errors[name].mean()) for row in answered if name in row.errors]
        found[f"{name}_median"] = statistics.median(values) if values else None
    return found


def _mean(values: Sequence[Number]) -> Number:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def frames_hash(instances: Sequence[Instance]) -> str:
    """Give the SHA-256 of the list of instances, a line each: scene, image, object, place."""
    lines = (f"{i.scene_id} {i.image_id} {i.object_id} {i.index}\n" for i in instances)
    return hashlib.sha256("".join(sorted(lines)).encode()).hexdigest()


def of_targets(dataset: BopDataset, targets: Sequence[Target]) -> BopDataset:
    """Keep the instances that a list of targets asks for, the most visible where it takes fewer.

    Raises:
        InputError: a target is not annotated so many times.
    """
    found: dict[Place, list[Instance]] = defaultdict(list)
    for instance in dataset.instances:
        found[place_of(instance)].append(instance)
    kept: list[Instance] = []
    for target in targets:
        place = Place(target.scene_id, target.image_id, target.object_id)
        there = sorted(found[place], key=lambda i: -(i.visible_fraction or 0.0))
        if len(there) < target.count:
            raise InputError(
                f"{dataset.folder}: the targets ask for {target.count} of object "
                f"{target.object_id} in scene {target.scene_id}, image {target.image_id}, but "
                f"{len(there)} are annotated in split {dataset.split!r}; give the list of this "
                "very split"
            )
        kept += there[: target.count]
    kept.sort(key=lambda i: (i.scene_id, i.image_id, i.index))
    return replace(dataset, instances=kept)


PVNET_DIAMETERS_M = {
    1: 0.097430, 2: 0.286908, 4: 0.171593, 5: 0.193416, 6: 0.152633, 8: 0.259425, 9: 0.107131,
    10: 0.176364, 11: 0.164857, 12: 0.148204, 13: 0.303153, 14: 0.285155, 15: 0.208394,
}  # fmt: skip
"""Of LineMOD's 13 objects by BOP's number, as PVNet's published evaluation has them."""

_OTHER_DATA_SET = 0.25


def diameter_of(model: ObjectModel, config: EvaluationConfig) -> float:
    """Give the diameter [m] that the thresholds are shares of.

    Raises:
        InputError: PVNet's table is asked for an object that it does not have.
    """
    if config.diameters == "bop":
        return model.diameter_m
    printed_m = PVNET_DIAMETERS_M.get(model.number, 0.0)
    if abs(printed_m / model.diameter_m - 1) > _OTHER_DATA_SET:
        raise InputError(
            f"object {model.number} ({model.name}) has a diameter of {model.diameter_m:.3f} m, "
            "which is no object of PVNet's table of LineMOD; take the data set's diameters, bop"
        )
    return printed_m


def is_adds(model: ObjectModel, config: EvaluationConfig) -> bool:
    """Whether an object is measured by ADD-S."""
    return config.adds == "all" or not model.symmetries.is_none
