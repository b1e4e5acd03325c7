"""Predictions measured on a data set: a row an instance, a row an object, the mean."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from depthpose.core.errors import InputError
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import BopDataset, Instance
from depthpose.pose.evaluate.conventions import convention_advice
from depthpose.pose.evaluate.errors import ErrorContext, make_ruler, match, measure
from depthpose.pose.evaluate.rows import Conditions, InstanceRow, ObjectRow, Origin, RiskRow
from depthpose.pose.evaluate.summary import (
    diameter_of,
    frames_hash,
    is_adds,
    mean_row,
    object_row,
    risk_rows,
)
from depthpose.pose.predictions import (
    STAGES,
    Prediction,
    read_bop_results,
    read_predictions,
    score_of,
)
from depthpose.pose.types import PoseEstimate

SUCCESS_SHARE = 0.1


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What evaluating one set of predictions gave.

    Attributes:
        rows: one an object; where there are several the ``mean`` over objects, in which each
            counts the same, and ``all`` over instances, as BOP pools them.
        per_instance: one an instance.
        risk: how many answers are wrong if only the surest are given.
        advice: by which change of all predictions many more were right: another unit or convention
            of poses; None where by none.
    """

    rows: list[ObjectRow]
    per_instance: list[InstanceRow]
    risk: list[RiskRow]
    advice: str | None = None

    def of(self, origin: Origin) -> "Evaluation":
        """Say in each row whose predictions it measures."""
        return replace(
            self,
            rows=[replace(row, origin=origin) for row in self.rows],
            per_instance=[replace(row, origin=origin) for row in self.per_instance],
            risk=[replace(row, origin=origin) for row in self.risk],
        )


def read_any(path: Path) -> list[Prediction]:
    """Read predictions: a folder with ``poses.json``, or anybody's BOP csv.

    Raises:
        InputError: it is neither, damaged, or holds no pose and no refusal.
    """
    found = read_predictions(path) if path.is_dir() else read_bop_results(path)
    if not found:
        raise InputError(f"{path}: holds no pose, so there is nothing to measure; predict some")
    return found


def evaluate(
    dataset: BopDataset,
    predictions: Sequence[Prediction],
    config: EvaluationConfig | None = None,
    progress: Callable[[Sequence[Instance]], Iterable[Instance]] = iter,
) -> Evaluation:
    """Measure predictions; an instance without an answer is a failure and stays in every number.

    A success is an ADD (ADD-S of a symmetric object) below a tenth of the diameter, ``auc`` the
    area to 10 cm; BOP's errors and recalls as ``pose.metrics`` has them.

    Args:
        dataset: instances with truth.
        predictions: of :func:`read_any`.
        config: diameters, which objects by ADD-S, whether VSD.
        progress: wraps the sequence of instances, to show how far it is.

    Raises:
        InputError: there is no instance, no prediction is of this data set, or a file of it is
            damaged.
    """
    config = EvaluationConfig() if config is None else config
    found = match(dataset.instances, predictions, dataset.objects)
    _refuse_unknown(dataset, predictions, found)
    rulers, stages = _rulers(dataset, config), _stages_of(predictions)
    rows = [
        _instance_row(one, found.get(one.name), rulers[one.object_id], stages)
        for one in progress(dataset.instances)
    ]
    conditions = _conditions(dataset, config)
    return Evaluation(
        rows=[replace(row, conditions=conditions) for row in _sum_up(dataset, rows, rulers)],
        per_instance=rows,
        risk=[replace(row, conditions=conditions) for row in risk_rows(rows)],
        advice=convention_advice(dataset, predictions, rulers, SUCCESS_SHARE),
    )


def _rulers(dataset: BopDataset, config: EvaluationConfig) -> dict[int, ErrorContext]:
    return {
        number: make_ruler(
            model,
            diameter_of(model, config),
            is_adds=is_adds(model, config),
            vsd_delta_m=config.vsd_delta_m if config.with_vsd else None,
        )
        for number, model in dataset.objects.items()
    }


def _instance_row(
    instance: Instance, estimate: PoseEstimate | None, ruler: ErrorContext, stages: list[str]
) -> InstanceRow:
    pose = None if estimate is None else estimate.camera_from_model
    errors = measure(pose, instance, ruler)
    seconds = {} if estimate is None else estimate.seconds
    ms = {stage: 1000 * seconds[stage] if stage in seconds else None for stage in stages}
    return InstanceRow(
        instance=instance.name,
        object=ruler.model.name,
        status="missing" if estimate is None else estimate.status,
        is_success=float(errors["error_m"]) < SUCCESS_SHARE * ruler.diameter_m,
        score=None if estimate is None or pose is None else score_of(estimate),
        visible_fraction=instance.visible_fraction,
        truth="annotated" if instance.is_measured else "fitted",
        diameter_m=ruler.diameter_m,
        metric="ADD-S" if ruler.is_adds else "ADD",
        errors=errors,
        ms={**ms, "total": 1000 * sum(seconds.values()) if seconds else None},
        reason="" if estimate is None else estimate.reason,
    )


def _stages_of(predictions: Sequence[Prediction]) -> list[str]:
    """Stages in the order of work; what a method of its own calls otherwise comes last."""
    seen = dict.fromkeys(stage for p in predictions for stage in p.estimate.seconds)
    return [s for s in STAGES if s in seen] + [s for s in seen if s not in STAGES]


def _sum_up(
    dataset: BopDataset, rows: list[InstanceRow], rulers: dict[int, ErrorContext]
) -> list[ObjectRow]:
    summed: list[ObjectRow] = []
    numbers = [instance.object_id for instance in dataset.instances]
    for number, ruler in sorted(rulers.items()):
        own = [row for row, of in zip(rows, numbers, strict=True) if of == number]
        row = object_row(ruler.model.name, own)
        summed.append(replace(row, metric=own[0].metric, diameter_m=ruler.diameter_m))
    if len(summed) > 1:
        summed += [mean_row(summed), object_row("all", rows)]
    return summed


def _conditions(dataset: BopDataset, config: EvaluationConfig) -> Conditions:
    return Conditions(
        diameters=config.diameters,
        frames=f"{dataset.folder.resolve().name} {dataset.split}",
        frames_sha256=frames_hash(dataset.instances)[:12],
    )


def _refuse_unknown(
    dataset: BopDataset, predictions: Sequence[Prediction], found: dict[str, PoseEstimate]
) -> None:
    """A file of another data set would be measured as all missing, and look like a bad method."""
    if len(dataset) == 0:
        raise InputError(f"{dataset.folder}: split {dataset.split!r} has no instance to measure")
    if predictions and not found:
        one = predictions[0]
        raise InputError(
            f"{dataset.folder}: none of the {len(predictions)} predictions is of one of its "
            f"{len(dataset)} instances; the first is of {one.place or one.estimate.name!r}. Give "
            "the predictions of this very split"
        )
