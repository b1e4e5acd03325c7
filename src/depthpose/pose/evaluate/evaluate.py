"""Predictions against truth: a row for each instance, and rows that sum them up."""

import hashlib
import math
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from depthpose.core.data_frame import make_data_frame
from depthpose.core.errors import InputError
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import BopDataset, BopTarget, Instance
from depthpose.pose.evaluate.detection import average_measured, score_detections
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
    frames: str  #: dataset and split
    frames_sha256: str  #: first digits of :func:`hash_frames`


@dataclass(frozen=True, kw_only=True, eq=False)
class _Row:
    """A row of a table of results."""

    conditions: Conditions | None = None  #: of the evaluation
    origin: Origin | None = None  #: whose predictions it measures

    def columns(self) -> dict[str, Any]:
        """List the values of the row by column: method and masks, its own, the conditions."""
        columns: dict[str, Any] = {}
        if self.origin is not None:
            columns = {"method": self.origin.method, "masks": self.origin.masks}
        for field in fields(self):
            if field.name not in ("conditions", "origin"):
                columns |= self._columns_of_field(field.name)
        if self.conditions is not None:
            columns |= asdict(self.conditions)
        return columns

    def _columns_of_field(self, name: str) -> dict[str, Any]:
        """List the columns of a field: its value, or one column for each entry of a mapping."""
        value = getattr(self, name)
        if name == "ms":
            return {f"ms_{stage}": stage_ms for stage, stage_ms in value.items()}
        return dict(value) if isinstance(value, Mapping) else {name: value}


@dataclass(frozen=True, kw_only=True, eq=False)
class InstanceRow(_Row):
    """One instance and the errors of its estimate."""

    instance: str  #: its name
    object: str  # name of its model
    status: str  #: of the estimate; ``missing`` where there is none
    is_success: bool  #: whether ADD (ADD-S of a symmetric object) is below a tenth of the diameter
    score: float | None  #: of the estimated pose, larger is surer
    visible_fraction: float | None  #: share of the silhouette that is seen, where it is annotated
    truth: str  #: ``annotated``, or ``fitted`` to the same depth
    diameter_m: float  #: by the table that ``EvaluationConfig.diameters`` names
    metric: str  #: of a success, ``ADD`` or ``ADD-S``
    errors: Mapping[str, Errors]  #: by the names of ``METRICS``; what is not measured is left out
    #: milliseconds of each stage and in ``total``; None where it has not run. The time of a search
    #: is divided among the estimates of its image.
    ms: Mapping[str, float | None]
    reason: str  #: of a refusal

    def error(self, name: str) -> float | None:
        """Return an error by its name in ``METRICS``; of VSD the mean over its tolerances.

        None where it is not measured. None, too, where it is infinite, as without a pose: the
        tables are also written as JSON, which has no infinity.
        """
        if name not in self.errors:
            return None
        mean = float(self.errors[name].mean())
        return mean if math.isfinite(mean) else None

    def _columns_of_field(self, name: str) -> dict[str, Any]:
        """List the columns of a field: every error has one, measured or not."""
        if name == "errors":
            return {metric: self.error(metric) for metric in METRICS}
        return super()._columns_of_field(name)


@dataclass(frozen=True, kw_only=True)
class ObjectRow(_Row):
    """The instances of an object, the ``mean`` of objects, or ``all`` instances."""

    object: str  # what the row is called
    instances: int  #: how many
    annotated: int  #: how many of them have a pose that was annotated, not fitted
    success: float  #: share of instances whose pose is a success (:class:`InstanceRow`)
    refused: float  #: share of instances without a pose
    wrong: float  #: share of instances with a pose that is no success
    coverage: float  #: share of instances with a pose
    #: the summaries of ``METRICS``, ``ar``, medians and BOP's precisions; None where not measured.
    scores: Mapping[str, float | None]
    ms: Mapping[str, float | None]  #: mean milliseconds of each stage and in ``total``
    metric: str | None = None  #: of a success, ``ADD`` or ``ADD-S``, in the row of one object
    diameter_m: float | None = None  #: of the object, in the row of one object

    def columns(self) -> dict[str, Any]:
        """List the values of the row by column, with all columns of the origin."""
        columns = super().columns()
        return columns if self.origin is None else asdict(self.origin) | columns

    def _columns_of_field(self, name: str) -> dict[str, Any]:
        """List the columns of a field; metric and diameter are those of a single object."""
        if name in ("metric", "diameter_m") and getattr(self, name) is None:
            return {}
        return super()._columns_of_field(name)


@dataclass(frozen=True, kw_only=True)
class RiskRow(_Row):
    """The share of wrong estimates among those of the highest scores."""

    coverage: float  #: share of all instances that these estimates are of
    answers: int  #: number of these estimates
    least_score: float | None  #: the lowest of their scores
    risk: float  #: share of wrong ones among them


_PRECISIONS = ("ap", "ap_mssd", "ap_mspd")  # columns of BOP's precision of 6D detection
_RECALLS = ("ar_vsd", "ar_mssd", "ar_mspd")  # columns whose mean is BOP's average recall
_COVERAGES = 10  # at which the risk is measured: tenths of all instances


def summarise_instances(name: str, rows: Sequence[InstanceRow]) -> ObjectRow:
    """Summarise the instances of an object, or of all objects, in a row called ``name``.

    ``coverage`` is the share of instances with a pose; those without one are ``refused``. So
    ``success``, ``wrong`` and ``refused`` add up to 1. Medians are over the instances with a pose,
    all else over all instances.
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
        ms={stage: average_measured([row.ms[stage] for row in rows]) for stage in rows[0].ms},
    )


def average_objects(rows: Sequence[ObjectRow]) -> ObjectRow:
    """Average the rows of objects: each object counts the same, as in LineMOD's tables."""
    count = len(rows)
    scores: dict[str, float | None] = {}
    for name in rows[0].scores:
        values = [row.scores[name] for row in rows]
        # A recall needs all objects. A median may lack those without a pose, and BOP's precision
        # those of which too little is visible.
        is_partial_allowed = name in _PRECISIONS or name.endswith("_median")
        is_averaged = is_partial_allowed or None not in values
        scores[name] = average_measured(values) if is_averaged else None
    return ObjectRow(
        object="mean",
        instances=sum(row.instances for row in rows),
        annotated=sum(row.annotated for row in rows),
        success=sum(row.success for row in rows) / count,
        refused=sum(row.refused for row in rows) / count,
        wrong=sum(row.wrong for row in rows) / count,
        coverage=sum(row.coverage for row in rows) / count,
        scores=scores,
        ms={stage: average_measured([row.ms[stage] for row in rows]) for stage in rows[0].ms},
    )


def measure_risk(rows: Sequence[InstanceRow]) -> list[RiskRow]:
    """Measure the share of wrong poses among those of the highest scores, at ten coverages.

    A ``coverage`` of 0.1 is a tenth of all instances. The rows end where there are no more poses.
    """
    # The poses, the surest first.
    answered = [row for row in rows if row.status in POSED and row.score is not None]
    answered.sort(key=lambda row: -(row.score or 0.0))

    # How many of them make each coverage; beyond the last one the number repeats, and counts once.
    tenths = [round(k * len(rows) / _COVERAGES) for k in range(1, _COVERAGES + 1)]
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


def _summarise_errors(rows: Sequence[InstanceRow]) -> dict[str, float | None]:
    """Summarise the errors of some instances; returns a number, or None, for each column.

    Recalls and areas are over all instances, of which one without a pose is missed; medians are
    over the instances with a pose. None where an error is not measured.
    """
    # The summaries of each error.
    diameters_m = torch.tensor([row.diameter_m for row in rows], dtype=torch.float64)
    scores: dict[str, float | None] = {}
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


def hash_frames(instances: Sequence[Instance]) -> str:
    """Compute the SHA-256 of a list of instances, a line each: scene, image, object and index."""
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
"""Diameters of LineMOD's 13 objects by BOP's number, as PVNet's published evaluation has them."""

_LARGEST_DIFFERENCE = 0.25
"""Largest share by which PVNet's diameter of an object differs from the model's: an object that
differs by more is of another dataset."""


def prepare_errors(model: ObjectModel, config: EvaluationConfig) -> ErrorContext:
    """Prepare an object for the measurement of errors, by the settings of an evaluation.

    Raises:
        InputError: PVNet's table is asked for an object that it does not have.
    """
    diameter_m = model.diameter_m
    if config.diameters == "pvnet":
        diameter_m = PVNET_DIAMETERS_M.get(model.number, 0.0)
        if abs(diameter_m / model.diameter_m - 1) > _LARGEST_DIFFERENCE:
            raise InputError(
                f"object {model.number} ({model.name}) has a diameter of {model.diameter_m:.3f} m, "
                "which is no object of PVNet's table of LineMOD; take the dataset's diameters, bop"
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
    """The results of one set of predictions."""

    #: one for each object; where there are several also the ``mean`` over objects, in which each
    #: counts the same, and ``all`` over instances, as BOP pools them.
    rows: list[ObjectRow]
    per_instance: list[InstanceRow]  #: one for each instance
    risk: list[RiskRow]  #: share of wrong poses if only the surest are given
    #: a change of all predictions, such as another unit or convention of poses, after which many
    #: more were right; None where there is none.
    advice: str | None = None

    def to_frame(self) -> Any:  # noqa: ANN401  pandas is no dependency
        """Convert ``per_instance`` to a ``pandas.DataFrame``; the columns are those of its table.

        Raises:
            ImportError: pandas is not installed.
        """
        return make_data_frame(row.columns() for row in self.per_instance)


def read_any_predictions(path: Path) -> list[Prediction]:
    """Read predictions of a folder with ``poses.json``, or of a BOP csv by any method.

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
        predictions: of :func:`read_any_predictions`.
        config: diameters, which objects by ADD-S, whether VSD.
        progress: wraps the sequence of instances, to show the progress.
        origin: whose predictions they are, for the columns of the rows.

    Raises:
        InputError: there is no instance, no prediction is of this dataset, or a file of it is
            damaged.
    """
    config = EvaluationConfig() if config is None else config
    matched = _match_predictions(dataset, predictions)
    contexts = {number: prepare_errors(model, config) for number, model in dataset.objects.items()}
    rows = _measure_instances(progress(dataset.instances), predictions, matched, contexts)
    object_rows = _summarise_objects(dataset, predictions, matched, contexts, rows)
    conditions = Conditions(
        diameters=config.diameters,
        frames=f"{dataset.folder.resolve().name} {dataset.split}",
        frames_sha256=hash_frames(dataset.instances)[:12],
    )
    return Evaluation(
        rows=[replace(row, conditions=conditions, origin=origin) for row in object_rows],
        per_instance=[replace(row, origin=origin) for row in rows],
        risk=[replace(row, conditions=conditions, origin=origin) for row in measure_risk(rows)],
        advice=advise_convention(dataset, predictions, contexts),
    )


def _match_predictions(
    dataset: BopDataset, predictions: Sequence[Prediction]
) -> dict[str, PoseEstimate]:
    """Match estimates with instances by the instances' names; refuse those of another dataset."""
    matched = match_instances(dataset.instances, predictions, dataset.objects)
    if len(dataset) == 0:
        raise InputError(f"{dataset.folder}: split {dataset.split!r} has no instance to measure")
    # A file of another dataset would be measured as all missing, and look like a bad method.
    if predictions and not matched:
        prediction = predictions[0]
        raise InputError(
            f"{dataset.folder}: none of the {len(predictions)} predictions is of one of its "
            f"{len(dataset)} instances; the first is of "
            f"{prediction.place or prediction.estimate.name!r}. Give the predictions of "
            "this very split"
        )
    return matched


def _measure_instances(
    instances: Iterable[Instance],
    predictions: Sequence[Prediction],
    matched: Mapping[str, PoseEstimate],
    contexts: Mapping[int, ErrorContext],
) -> list[InstanceRow]:
    """Measure the errors of each instance, and list the times of its estimate.

    Args:
        instances: all of a dataset.
        predictions: all of them, among which the time of a search is divided.
        matched: the estimate of each instance that has one, by the instance's name.
        contexts: of the errors, by the number of the object.
    """
    # Columns of times: stages in the order in which they run; those of other methods come last.
    timed = dict.fromkeys(stage for p in predictions for stage in p.estimate.seconds)
    stages = [stage for stage in STAGES if stage in timed]
    stages += [stage for stage in timed if stage not in STAGES]
    seconds_of = {
        prediction.estimate: seconds
        for prediction, seconds in zip(predictions, additive_seconds(predictions), strict=True)
    }

    rows: list[InstanceRow] = []
    for instance in instances:
        estimate = matched.get(instance.name)
        row = _measure_instance(instance, estimate, contexts[instance.object_id])
        ms = {} if estimate is None else _list_stage_ms(estimate, seconds_of[estimate])
        rows.append(replace(row, ms={column: ms.get(column) for column in (*stages, "total")}))
    return rows


def _summarise_objects(
    dataset: BopDataset,
    predictions: Sequence[Prediction],
    matched: Mapping[str, PoseEstimate],
    contexts: Mapping[int, ErrorContext],
    rows: Sequence[InstanceRow],
) -> list[ObjectRow]:
    """Summarise each object; if there are several, also their mean, and all instances.

    Args:
        dataset: with the instances.
        predictions: all of them.
        matched: the estimate of each instance that has one, by the instance's name.
        contexts: of the errors, by the number of the object.
        rows: of the instances, in the order of the dataset.
    """
    # BOP's precision of detection, for which most errors are measured already.
    measured = {
        (matched[row.instance].name, row.instance): row.errors
        for row in rows
        if row.instance in matched
    }
    precision = score_detections(dataset, predictions, contexts, measured)

    # Each object, in the order of their numbers.
    rows_of_object: dict[int, list[InstanceRow]] = defaultdict(list)
    for row, instance in zip(rows, dataset.instances, strict=True):
        rows_of_object[instance.object_id].append(row)
    object_rows: list[ObjectRow] = []
    for number, context in sorted(contexts.items()):
        row = summarise_instances(context.model.name, rows_of_object[number])
        row = replace(row, scores={**row.scores, **precision[number]})
        metric = rows_of_object[number][0].metric
        object_rows.append(replace(row, metric=metric, diameter_m=context.diameter_m))
    if len(object_rows) == 1:
        return object_rows

    # BOP's precision is that of an object, or the mean over objects: "all" has none.
    all_row = summarise_instances("all", rows)
    all_row = replace(all_row, scores={**all_row.scores, **dict.fromkeys(_PRECISIONS)})
    return [*object_rows, average_objects(object_rows), all_row]


def _measure_instance(
    instance: Instance, estimate: PoseEstimate | None, context: ErrorContext
) -> InstanceRow:
    """Measure the errors of one instance; without a pose they are those of a missing estimate.

    The row has no times yet.
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
    """List the milliseconds of each stage of an estimate, and in ``total``; none without times.

    ``additive``: its seconds of :func:`additive_seconds`, whose sum is the total.
    """
    if not estimate.seconds:
        return {}
    seconds = {**estimate.seconds, **additive, "total": sum(additive.values())}
    return {stage: 1000 * stage_s for stage, stage_s in seconds.items()}
