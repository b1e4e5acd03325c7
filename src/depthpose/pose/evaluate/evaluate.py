"""Predictions against truth: rows, and their summary."""

import hashlib
import math
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from depthpose.core.errors import InputError
from depthpose.core.frame import make_data_frame
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import BopDataset, BopTarget, Instance
from depthpose.pose.evaluate.detection import score_detections
from depthpose.pose.evaluate.errors import (
    METRICS,
    ErrorContext,
    Errors,
    advise_convention,
    match_instances,
)
from depthpose.pose.mesh import drawn_triangles, symmetry_transforms
from depthpose.pose.metrics import SUCCESS_SHARE
from depthpose.pose.predictions import (
    STAGES,
    Place,
    Prediction,
    additive_seconds,
    place_of,
    read_bop_results,
    read_predictions,
    score_of,
)
from depthpose.pose.types import POSED, ObjectModel, PoseEstimate

Number = float | None


@dataclass(frozen=True, kw_only=True)
class Origin:
    """The method whose predictions a row measures: the first columns of the row."""

    method: str  #: its name
    masks: str = ""  #: kind of masks that it used
    weights: str = ""  #: file or name, where it has any
    weights_sha256: str = ""  #: its first digits; of a file of predictions by others the file's own


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """The conditions under which numbers can be compared: the last columns of a row."""

    diameters: str  #: whose table of diameters
    frames: str  #: data set and split
    frames_sha256: str  #: first digits of :func:`hash_frames`


@dataclass(frozen=True, kw_only=True, eq=False)
class _Row:
    """A row of a table of results."""

    conditions: Conditions | None = None  #: of the evaluation
    origin: Origin | None = None  #: whose predictions it measures

    def columns(self) -> dict[str, Any]:
        """Give the values of the row by column, in the order of the table."""
        columns = {} if self.origin is None else asdict(self.origin)
        if not isinstance(self, ObjectRow):
            columns = {name: columns[name] for name in ("method", "masks") if name in columns}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(self, InstanceRow) and field.name == "errors":
                columns |= {name: self.error(name) for name in METRICS}
            elif field.name == "ms":
                columns |= {f"ms_{stage}": number for stage, number in value.items()}
            elif isinstance(value, Mapping):
                columns |= value
            elif field.name not in _LAST and not (value is None and field.default is None):
                columns[field.name] = value
        return columns | ({} if self.conditions is None else asdict(self.conditions))


_LAST = ("conditions", "origin")


@dataclass(frozen=True, kw_only=True, eq=False)
class InstanceRow(_Row):
    """One instance and the errors of its estimate."""

    instance: str  #: its name
    object: str  # name of its model
    status: str  #: of the estimate; ``missing`` where there is none
    is_success: bool  #: whether ADD (ADD-S of a symmetric object) is below a tenth of the diameter
    score: Number  #: of the answer, larger is surer
    visible_fraction: Number  #: share of the silhouette that is seen, where it is given
    truth: str  #: ``annotated``, or ``fitted`` to the same depth
    diameter_m: float  #: of the table that was asked for
    metric: str  #: ``ADD`` or ``ADD-S``
    errors: Mapping[str, Errors]  #: by the names of ``METRICS``; what is not measured is left out
    #: milliseconds of each stage and in ``total``; None where it has not run. The time of a search
    #: is divided among the estimates of its image.
    ms: Mapping[str, Number]
    reason: str  #: of a refusal

    def error(self, name: str) -> Number:
        """Give an error by its name, or None where it is not measured or infinite."""
        if name not in self.errors:
            return None
        mean = float(self.errors[name].mean())
        return mean if math.isfinite(mean) else None


@dataclass(frozen=True, kw_only=True)
class ObjectRow(_Row):
    """The instances of an object, the ``mean`` of objects, or ``all`` instances."""

    object: str  # what the row is called
    instances: int  #: how many
    annotated: int  #: how many of them have a pose that was annotated, not fitted
    success: float  #: share of instances
    refused: float  #: share of instances without an answer
    wrong: float  #: share of instances with an answer that is no success
    coverage: float  #: share of instances with an answer
    #: the summaries of ``METRICS``, ``ar`` and medians; None where not measured.
    scores: Mapping[str, Number]
    ms: Mapping[str, Number]  #: mean milliseconds of each stage and in ``total``
    metric: str | None = None  #: ``ADD`` or ``ADD-S``, where it is of one object
    diameter_m: float | None = None  #: the same


@dataclass(frozen=True, kw_only=True)
class RiskRow(_Row):
    """The share of wrong estimates among those of the highest scores."""

    coverage: float  #: share of all instances that is answered
    answers: int  #: their number
    least_score: Number  #: of the least sure of them
    risk: float  #: share of wrong ones among them


_PRECISIONS = ("ap", "ap_mssd", "ap_mspd")
_RECALLS = ("ar_vsd", "ar_mssd", "ar_mspd")
_DECILES = 10


def sum_up_object(name: str, rows: Sequence[InstanceRow]) -> ObjectRow:
    """Sum up the instances of an object, or of all objects.

    ``success``, ``refused`` and ``wrong`` add up to 1: an instance without a pose is refused.
    Medians are over the instances with a pose, all else over all instances.
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
        scores=_summarise_errors(rows),
        ms={stage: _average([row.ms[stage] for row in rows]) for stage in rows[0].ms},
    )


def average_objects(rows: Sequence[ObjectRow]) -> ObjectRow:
    """Average the rows of objects: each object counts the same, as in LineMOD's tables."""
    count = len(rows)
    scores: dict[str, Number] = {}
    for name in rows[0].scores:
        values = [row.scores[name] for row in rows]
        # A recall needs all objects. A median may lack those without a pose, and BOP's precision
        # those of which too little is visible.
        may_lack = name in _PRECISIONS or name.endswith("_median")
        scores[name] = _average(values) if may_lack or None not in values else None
    return ObjectRow(
        object="mean",
        instances=sum(row.instances for row in rows),
        annotated=sum(row.annotated for row in rows),
        success=sum(row.success for row in rows) / count,
        refused=sum(row.refused for row in rows) / count,
        wrong=sum(row.wrong for row in rows) / count,
        coverage=sum(row.coverage for row in rows) / count,
        scores=scores,
        ms={stage: _average([row.ms[stage] for row in rows]) for stage in rows[0].ms},
    )


def measure_risk(rows: Sequence[InstanceRow]) -> list[RiskRow]:
    """Measure the share of wrong poses among those of the highest scores, at ten coverages.

    A ``coverage`` of 0.1 is a tenth of all instances. The rows end where there are no more poses.
    """
    # The answers, the surest first, and how many of them make each coverage.
    answered = [row for row in rows if row.status in POSED and row.score is not None]
    answered.sort(key=lambda row: -(row.score or 0.0))
    tenths = (round(k * len(rows) / _DECILES) for k in range(1, _DECILES + 1))
    counts = dict.fromkeys(min(count, len(answered)) for count in tenths)
    return [
        RiskRow(
            coverage=count / len(rows),
            answers=count,
            least_score=answered[count - 1].score,
            risk=sum(not row.is_success for row in answered[:count]) / count,
        )
        for count in counts
        if count
    ]


def _summarise_errors(rows: Sequence[InstanceRow]) -> dict[str, Number]:
    """Summarise the errors of some instances by the columns of a table; None: not measured.

    Recalls and areas are over all instances, of which one without an estimate is missed; medians
    are over the instances with an estimate.
    """
    # The summaries of each error.
    diameters_m = torch.tensor([row.diameter_m for row in rows], dtype=torch.float64)
    scores: dict[str, Number] = {}
    for name, metric in METRICS.items():
        is_measured = all(name in row.errors for row in rows)
        errors = torch.stack([row.errors[name] for row in rows]) if is_measured else None
        for column, summary in metric.summaries.items():
            scores[column] = None if errors is None else summary(errors, diameters_m)

    # BOP's average recall is the mean over its three errors.
    recalls = [scores[name] for name in _RECALLS]
    measured_recalls = [recall for recall in recalls if recall is not None]
    is_complete = len(measured_recalls) == len(recalls)
    scores["ar"] = sum(measured_recalls) / len(recalls) if is_complete else None

    # Medians, of poses alone.
    posed = [row for row in rows if row.status in POSED]
    for name, metric in METRICS.items():
        if metric.has_median:
            errors = [float(row.errors[name].mean()) for row in posed if name in row.errors]
            scores[f"{name}_median"] = statistics.median(errors) if errors else None
    return scores


def _average(values: Sequence[Number]) -> Number:
    """Average the values that are not None; None where there are none."""
    numbers = [value for value in values if value is not None]
    return sum(numbers) / len(numbers) if numbers else None


def hash_frames(instances: Sequence[Instance]) -> str:
    """Compute the SHA-256 of a list of instances, a line each: scene, image, object and place."""
    lines = (f"{i.scene_id} {i.image_id} {i.object_id} {i.index}\n" for i in instances)
    return hashlib.sha256("".join(sorted(lines)).encode()).hexdigest()


def select_targets(dataset: BopDataset, targets: Sequence[BopTarget]) -> BopDataset:
    """Keep the instances of a list of targets, the most visible ones of each.

    Raises:
        InputError: a target has fewer annotations than its count, or none of them has any.
    """
    # What is annotated, by place and by image.
    of_place: dict[Place, list[Instance]] = defaultdict(list)
    of_image: dict[tuple[int, int], list[Instance]] = defaultdict(list)
    for instance in dataset.instances:
        of_place[place_of(instance)].append(instance)
        of_image[instance.scene_id, instance.image_id].append(instance)

    # Of each target as many as it asks for.
    chosen: list[Instance] = []
    for target in targets:
        instances = of_image[target.scene_id, target.image_id]
        if target.object_id is not None:
            place = Place(target.scene_id, target.image_id, target.object_id)
            instances = sorted(of_place[place], key=lambda i: -(i.visible_fraction or 0.0))
        if len(instances) < (target.count or 0):
            raise InputError(
                f"{dataset.folder}: the targets ask for {target.count} of object "
                f"{target.object_id} in scene {target.scene_id}, image {target.image_id}, but "
                f"{len(instances)} are annotated in split {dataset.split!r}; give the list of this "
                "very split"
            )
        chosen += instances[: target.count]
    if not chosen:
        raise InputError(
            f"{dataset.folder}: nothing that the {len(targets)} targets ask for is annotated in "
            f"split {dataset.split!r}; give the list of this very split"
        )
    chosen.sort(key=lambda i: (i.scene_id, i.image_id, i.index))
    return replace(dataset, instances=chosen)


PVNET_DIAMETERS_M = {
    1: 0.097430, 2: 0.286908, 4: 0.171593, 5: 0.193416, 6: 0.152633, 8: 0.259425, 9: 0.107131,
    10: 0.176364, 11: 0.164857, 12: 0.148204, 13: 0.303153, 14: 0.285155, 15: 0.208394,
}  # fmt: skip
"""Of LineMOD's 13 objects by BOP's number, as PVNet's published evaluation has them."""

_OTHER_DATA_SET = 0.25


def prepare_errors(model: ObjectModel, config: EvaluationConfig) -> ErrorContext:
    """Prepare an object for the measurement of errors, by the settings of an evaluation.

    Raises:
        InputError: PVNet's table is asked for an object that it does not have.
    """
    diameter_m = model.diameter_m
    if config.diameters == "pvnet":
        diameter_m = PVNET_DIAMETERS_M.get(model.number, 0.0)
        if abs(diameter_m / model.diameter_m - 1) > _OTHER_DATA_SET:
            raise InputError(
                f"object {model.number} ({model.name}) has a diameter of {model.diameter_m:.3f} m, "
                "which is no object of PVNet's table of LineMOD; take the data set's diameters, bop"
            )
    return ErrorContext(
        model=model,
        diameter_m=diameter_m,
        is_adds=config.adds == "all" or not model.symmetries.is_none,
        vsd_delta_m=config.vsd_delta_m if config.with_vsd else None,
        symmetries=symmetry_transforms(model.symmetries),
        triangles_m=drawn_triangles(model).double(),
    )


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What evaluating one set of predictions gave."""

    #: one an object; where there are several the ``mean`` over objects, in which each counts the
    #: same, and ``all`` over instances, as BOP pools them.
    rows: list[ObjectRow]
    per_instance: list[InstanceRow]  #: one an instance
    risk: list[RiskRow]  #: how many answers are wrong if only the surest are given
    #: by which change of all predictions many more were right: another unit or convention of poses;
    #: None where by none.
    advice: str | None = None

    def to_frame(self) -> Any:  # noqa: ANN401  pandas is no dependency
        """Give ``per_instance`` as a ``pandas.DataFrame``; the columns are those of its table.

        Raises:
            ImportError: pandas is not installed.
        """
        return make_data_frame(row.columns() for row in self.per_instance)


def read_any(path: Path) -> list[Prediction]:
    """Read predictions: a folder with ``poses.json``, or anybody's BOP csv.

    Raises:
        InputError: it is neither, damaged, or holds no pose and no refusal.
    """
    predictions = read_predictions(path) if path.is_dir() else read_bop_results(path)
    if not predictions:
        raise InputError(f"{path}: holds no pose, so there is nothing to measure; predict some")
    return predictions


def evaluate(
    dataset: BopDataset,
    predictions: Sequence[Prediction],
    config: EvaluationConfig | None = None,
    progress: Callable[[Sequence[Instance]], Iterable[Instance]] = iter,
    origin: Origin | None = None,
) -> Evaluation:
    """Measure predictions; an instance without an estimate counts as a failure in every number.

    A success is an ADD (ADD-S of a symmetric object) below a tenth of the diameter, ``auc`` the
    area to 10 cm; BOP's errors and recalls as ``pose.metrics`` has them, and its precision of 6D
    detection as :func:`~depthpose.pose.evaluate.detection.score_detections` has it.

    Args:
        dataset: instances with truth.
        predictions: of :func:`read_any`.
        config: diameters, which objects by ADD-S, whether VSD.
        progress: wraps the sequence of instances, to show how far it is.
        origin: whose predictions they are, for the columns of the rows.

    Raises:
        InputError: there is no instance, no prediction is of this data set, or a file of it is
            damaged.
    """
    # Which estimate is of which instance?
    config = EvaluationConfig() if config is None else config
    matched = match_instances(dataset.instances, predictions, dataset.objects)
    if len(dataset) == 0:
        raise InputError(f"{dataset.folder}: split {dataset.split!r} has no instance to measure")
    # A file of another data set would be measured as all missing, and look like a bad method.
    if predictions and not matched:
        prediction = predictions[0]
        raise InputError(
            f"{dataset.folder}: none of the {len(predictions)} predictions is of one of its "
            f"{len(dataset)} instances; the first is of "
            f"{prediction.place or prediction.estimate.name!r}. Give the predictions of "
            "this very split"
        )

    # Rows of instances. Stages in the order of work; those of other methods come last.
    timed = dict.fromkeys(stage for p in predictions for stage in p.estimate.seconds)
    stages = [s for s in STAGES if s in timed] + [s for s in timed if s not in STAGES]
    seconds_of = {
        prediction.estimate: seconds
        for prediction, seconds in zip(predictions, additive_seconds(predictions), strict=True)
    }
    contexts = {number: prepare_errors(model, config) for number, model in dataset.objects.items()}
    rows: list[InstanceRow] = []
    for instance in progress(dataset.instances):
        estimate = matched.get(instance.name)
        row = _measure_instance(instance, estimate, contexts[instance.object_id])
        ms = {} if estimate is None else _list_stage_ms(estimate, seconds_of[estimate])
        columns = [*stages, "total"]
        rows.append(replace(row, ms={column: ms.get(column) for column in columns}))
    conditions = Conditions(
        diameters=config.diameters,
        frames=f"{dataset.folder.resolve().name} {dataset.split}",
        frames_sha256=hash_frames(dataset.instances)[:12],
    )

    # Rows of objects, with BOP's precision of detection.
    measured = {
        (matched[row.instance].name, row.instance): row.errors
        for row in rows
        if row.instance in matched
    }
    precision = score_detections(dataset, predictions, contexts, measured)
    rows_of_object: dict[int, list[InstanceRow]] = defaultdict(list)
    for row, instance in zip(rows, dataset.instances, strict=True):
        rows_of_object[instance.object_id].append(row)
    object_rows: list[ObjectRow] = []
    for number, context in sorted(contexts.items()):
        row = sum_up_object(context.model.name, rows_of_object[number])
        row = replace(row, scores={**row.scores, **precision[number]})
        metric = rows_of_object[number][0].metric
        object_rows.append(replace(row, metric=metric, diameter_m=context.diameter_m))
    if len(object_rows) > 1:
        # BOP's precision is that of an object, or the mean over objects: "all" has none.
        all_row = sum_up_object("all", rows)
        all_row = replace(all_row, scores={**all_row.scores, **dict.fromkeys(_PRECISIONS)})
        object_rows += [average_objects(object_rows), all_row]
    return Evaluation(
        rows=[replace(row, conditions=conditions, origin=origin) for row in object_rows],
        per_instance=[replace(row, origin=origin) for row in rows],
        risk=[replace(r, conditions=conditions, origin=origin) for r in measure_risk(rows)],
        advice=advise_convention(dataset, predictions, contexts),
    )


def _measure_instance(
    instance: Instance, estimate: PoseEstimate | None, context: ErrorContext
) -> InstanceRow:
    """Measure one instance, without its times.

    Without a pose its errors are those of a missing estimate.
    """
    pose = None if estimate is None else estimate.camera_from_model
    errors: dict[str, Errors] = {}
    for name, metric in METRICS.items():
        if metric.is_wanted(context):
            error = metric.missing if pose is None else metric.measure(pose, instance, context)
            errors[name] = torch.as_tensor(error, dtype=torch.float64).reshape(-1)
    return InstanceRow(
        instance=instance.name,
        object=context.model.name,
        status="missing" if estimate is None else estimate.status,
        is_success=float(errors["error_m"]) < SUCCESS_SHARE * context.diameter_m,
        score=None if estimate is None or pose is None else score_of(estimate),
        visible_fraction=instance.visible_fraction,
        truth="annotated" if instance.is_measured else "fitted",
        diameter_m=context.diameter_m,
        metric="ADD-S" if context.is_adds else "ADD",
        errors=errors,
        ms={},
        reason="" if estimate is None else estimate.reason,
    )


def _list_stage_ms(estimate: PoseEstimate, additive: Mapping[str, float]) -> dict[str, float]:
    """List the milliseconds of each stage of an estimate, and in ``total``, if it has any.

    ``additive``: its seconds of :func:`additive_seconds`, whose sum is the total.
    """
    if not estimate.seconds:
        return {}
    seconds = {**estimate.seconds, **additive, "total": sum(additive.values())}
    return {stage: 1000 * stage_s for stage, stage_s in seconds.items()}
