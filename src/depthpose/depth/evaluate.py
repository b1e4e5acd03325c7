"""Evaluation of predictions in files by a named protocol: rows of metrics."""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from depthpose.core.data_frame import make_data_frame
from depthpose.core.errors import InputError, Notice
from depthpose.depth import disparity
from depthpose.depth import predictions as files
from depthpose.depth.datasets import Dataset, read_disparity
from depthpose.depth.datasets.frames import check_map_size
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.metrics import RANKING, error_by_decile, measure, score_confidence
from depthpose.depth.protocols import (
    NO_PREDICTION,
    PROTOCOLS,
    PreparedFrame,
    Protocol,
    apply_protocol,
    find_protocol,
    has_truth,
    prepare_frame,
)
from depthpose.depth.types import DepthEstimate, DepthInput, ErrorMaps, Map


@dataclass(frozen=True, kw_only=True)
class EvaluationRow:
    """A row of a table: metrics of one frame, their mean over frames, or those of a decile.

    Each frame counts the same. The columns of the table are the fields in this order.
    """

    method: str | None = None  #: method that predicted; None, as in the next four fields: not known
    input: str | None = None  #: which images the method had
    speed: str | None = None  #: at which its networks ran
    weights: str | None = None  #: name of their file
    weights_sha256: str | None = None  #: the first 12 digits
    protocol: str  #: protocol by which the frames were measured
    dataset: str  #: its name
    frame: str | None = None  #: name of the frame, in a row of one frame
    cap_m: float | None  #: truth beyond it does not count; None for disparity
    frames: int | None = None  #: number of frames, in a row of means
    pixels: int | None = None  #: number of pixels that were compared, in all frames
    coverage: float | None = None  #: share of the pixels with truth that have a prediction
    #: in a row of the n-th tenth of the pixels: n, from 1 (the least confidence) to 10
    confidence_decile: int | None = None
    #: metrics that all frames with a compared pixel have, in the order of
    #: ``depth.metrics.METRICS``, then those of the synthesised view and of the confidence
    metrics: Mapping[str, float]

    def columns(self) -> dict[str, str | int | float]:
        """Return the columns of files and tables: the fields that are not None, and each metric."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        metrics = values.pop("metrics")
        columns = {name: value for name, value in values.items() if value is not None}
        return columns | metrics


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Result of the evaluation of one folder of predictions."""

    rows: list[EvaluationRow]  #: means over frames, one row for each cap
    per_frame: list[EvaluationRow]  #: one row for each frame and cap
    #: mean error of the least sure tenth of each frame's pixels (1) to the surest (10), for
    #: predictions with a confidence
    deciles: list[EvaluationRow]
    skipped: dict[str, str]  #: frames that do not count, each with the reason

    def to_frame(self) -> Any:  # noqa: ANN401  pandas is no dependency
        """Return ``per_frame`` as a ``pandas.DataFrame``; the columns are those of its table.

        Raises:
            ImportError: pandas is not installed.
        """
        return make_data_frame(row.columns() for row in self.per_frame)


@dataclass(frozen=True, kw_only=True)
class FrameMetrics:
    """Metrics of one frame at one cap."""

    frame: str  #: its name
    cap_m: float | None  #: None for disparity
    pixels: int  #: number of pixels that were compared
    coverage: float  #: share of the pixels with truth that have a prediction
    metrics: Mapping[str, float]  #: by name; empty where no pixel was compared
    #: mean error of each tenth of the pixels, by rising confidence; None without a confidence
    deciles: list[float] | None = None


def evaluate(
    dataset: Dataset,
    predictions: Path,
    protocol: str,
    caps_m: Sequence[float] = (80.0, 50.0),
    progress: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> Evaluation:
    """Measure the predictions in a folder by a named protocol.

    Args:
        dataset: frames with truth; those without are listed as skipped.
        predictions: folder of ``NAME.disparity_px.npy`` (see ``predictions``).
        protocol: a key of ``PROTOCOLS``.
        caps_m: truth beyond a cap does not count and predictions are clamped to it; one row each.
        progress: wraps the sequence of frame indices to show the progress, as ``tqdm`` does.

    Raises:
        InputError: an unknown protocol, a missing prediction, or no frame with truth.
    """
    given_notices: set[str] = set()  # each once for all frames
    metrics_by_frame: dict[str, list[FrameMetrics] | str] = {}
    for index in progress(range(len(dataset))):
        name = dataset.frames[index].name
        metrics_by_frame[name] = measure_frame(
            dataset, index, predictions, protocol, caps_m, given_notices
        )
    return summarise(dataset, protocol, metrics_by_frame)


def measure_frame(
    dataset: Dataset,
    index: int,
    predictions: Path,
    protocol: str,
    caps_m: Sequence[float],
    given_notices: set[str] | None = None,
) -> list[FrameMetrics] | str:
    """Measure one frame at each cap.

    Args:
        dataset: frames with truth.
        index: number of the frame.
        predictions: folder of the predictions.
        protocol: a key of ``PROTOCOLS``.
        caps_m: as for :func:`evaluate`.
        given_notices: notices on frames before, which are not given again; those on this frame are
            added. None: there is no frame before.

    Returns:
        Metrics at each cap within which the frame has truth, or the reason why it does not count.

    Raises:
        InputError: an unknown protocol, or a missing or damaged prediction.
    """
    rule = find_protocol(protocol)
    prepared = prepare_frame(dataset, index, predictions, rule, given_notices)
    if isinstance(prepared, str):
        return prepared
    caps: Sequence[float | None] = [None] if rule.is_disparity else caps_m
    metrics_of_caps = [_measure_at_cap(prepared, rule, cap_m) for cap_m in caps]
    metrics = [at_cap for at_cap in metrics_of_caps if at_cap is not None]
    return metrics or "no truth within the caps and the crop"


def _measure_at_cap(
    prepared: PreparedFrame, rule: Protocol, cap_m: float | None
) -> FrameMetrics | None:
    """Measure a frame at one cap (None for disparity); None where it has no truth within it."""
    predicted, truth = apply_protocol(prepared, rule, cap_m)
    is_true = torch.isfinite(truth)
    is_compared = is_true & torch.isfinite(predicted)
    if not bool(is_true.any()):
        return None

    metrics: dict[str, float] = {}
    deciles = None
    if bool(is_compared.any()):
        error = (predicted - truth).abs()
        if rule.is_disparity:
            metrics |= measure("disparity", predicted[is_compared], truth[is_compared])
            metrics |= _measure_non_occluded(prepared)
        else:
            metrics |= measure("depth", predicted[is_compared], truth[is_compared])
            error = error / truth
        metrics |= prepared.view_metrics
        # A confidence is judged by how well it ranks the pixels by their errors.
        if prepared.confidence is not None:
            errors = error[is_compared]
            confidences = prepared.confidence[is_compared]
            metrics |= score_confidence(errors, confidences)
            deciles = error_by_decile(errors, confidences).tolist()
    return FrameMetrics(
        frame=prepared.frame.name,
        cap_m=cap_m,
        pixels=int(is_compared.sum()),
        coverage=float(is_compared.sum() / is_true.sum()),
        metrics=metrics,
        deciles=deciles,
    )


def _measure_non_occluded(prepared: PreparedFrame) -> dict[str, float]:
    """Measure the disparity of the pixels that both views show; {} where they have no truth."""
    if prepared.frame.disparity_noc is None:
        return {}
    truth_px = read_disparity(prepared.frame.disparity_noc)
    height, width = prepared.truth.shape
    check_map_size(prepared.frame.disparity_noc, truth_px, (width, height))
    is_compared = torch.isfinite(truth_px) & torch.isfinite(prepared.disparity_px)
    if not bool(is_compared.any()):
        return {}
    return measure("disparity_noc", prepared.disparity_px[is_compared], truth_px[is_compared])


def summarise(
    dataset: Dataset, protocol: str, metrics_by_frame: Mapping[str, list[FrameMetrics] | str]
) -> Evaluation:
    """Make the rows of all frames and their means, wherever the frames were measured.

    Args:
        dataset: the frames.
        protocol: a key of ``PROTOCOLS``.
        metrics_by_frame: what :func:`measure_frame` returned, by the name of the frame.

    Raises:
        InputError: no frame has truth.
    """
    # Metrics of each frame at each cap.
    measured: list[FrameMetrics] = []
    skipped: dict[str, str] = {}
    for frame in dataset.frames:
        frame_metrics = metrics_by_frame[frame.name]
        if isinstance(frame_metrics, str):
            skipped[frame.name] = frame_metrics
        else:
            measured += frame_metrics
    if not measured:
        raise _make_nothing_measured_error(dataset, protocol, skipped)

    per_frame = [
        EvaluationRow(
            protocol=protocol,
            dataset=dataset.name,
            frame=metrics.frame,
            cap_m=metrics.cap_m,
            pixels=metrics.pixels,
            coverage=metrics.coverage,
            metrics=metrics.metrics,
        )
        for metrics in measured
    ]
    rows: list[EvaluationRow] = []
    deciles: list[EvaluationRow] = []
    for cap_m in dict.fromkeys(metrics.cap_m for metrics in measured):
        at_cap = [metrics for metrics in measured if metrics.cap_m == cap_m]
        rows.append(_make_mean_row(dataset.name, protocol, at_cap))
        deciles += _make_decile_rows(dataset.name, protocol, at_cap)
    return Evaluation(rows=rows, per_frame=per_frame, deciles=deciles, skipped=skipped)


def _make_mean_row(name: str, protocol: str, at_cap: Sequence[FrameMetrics]) -> EvaluationRow:
    """Make the row of the means over the frames of the dataset ``name``, measured at one cap.

    Raises:
        InputError: no pixel was compared.
    """
    if not any(metrics.pixels for metrics in at_cap):
        raise InputError(f"{name}: no prediction has a pixel where there is truth")
    return EvaluationRow(
        protocol=protocol,
        dataset=name,
        cap_m=at_cap[0].cap_m,
        frames=len(at_cap),
        pixels=sum(metrics.pixels for metrics in at_cap),
        coverage=sum(metrics.coverage for metrics in at_cap) / len(at_cap),
        metrics=_average_metrics(at_cap),
    )


def _make_decile_rows(
    name: str, protocol: str, at_cap: Sequence[FrameMetrics]
) -> list[EvaluationRow]:
    """Make the rows of the mean errors of tenths of the pixels, from the least confidence up.

    There is none where no frame of the dataset ``name`` has a confidence.
    """
    with_confidence = [metrics.deciles for metrics in at_cap if metrics.deciles is not None]
    if not with_confidence:
        return []
    ranking_metric = RANKING["disparity" if find_protocol(protocol).is_disparity else "depth"]
    mean_errors = torch.tensor(with_confidence, dtype=torch.float64).nanmean(0).tolist()
    return [
        EvaluationRow(
            protocol=protocol,
            dataset=name,
            cap_m=at_cap[0].cap_m,
            frames=len(with_confidence),
            confidence_decile=decile,
            metrics={ranking_metric: mean_error},
        )
        for decile, mean_error in enumerate(mean_errors, 1)
    ]


def _average_metrics(at_cap: Sequence[FrameMetrics]) -> dict[str, float]:
    """Average the metrics that all frames with a compared pixel have, over these frames."""
    compared = [frame.metrics for frame in at_cap if frame.pixels]
    common_names = [name for name in compared[0] if all(name in metrics for metrics in compared)]
    return {
        name: sum(metrics[name] for metrics in compared) / len(compared) for name in common_names
    }


def _make_nothing_measured_error(
    dataset: Dataset, protocol: str, skipped: Mapping[str, str]
) -> InputError:
    """Make the error of a dataset of which no frame could be measured, with the remedy.

    ``skipped``: the reasons, by the name of the frame.
    """
    unpredicted = [name for name, reason in skipped.items() if reason == NO_PREDICTION]
    if unpredicted:
        return InputError(
            f"{dataset.name}: no frame has both truth and a prediction; {unpredicted[0]!r} has the "
            f"truth and {NO_PREDICTION}. Predictions are called {files.EXPECTED}"
        )
    rule = find_protocol(protocol)
    fitting_names = [
        name
        for name, other in PROTOCOLS.items()
        if other.truth != rule.truth and any(has_truth(frame, other) for frame in dataset.frames)
    ]
    remedy = "Choose another folder."
    if fitting_names:
        remedy = f"--protocol {' or '.join(fitting_names)} fits."
    return InputError(
        f"{dataset.name}: none of its {len(dataset)} frames has the truth that protocol "
        f"{protocol!r} needs ({rule.truth}). {remedy}"
    )


def read_frame_result(
    dataset: Dataset, index: int, predictions: Path, protocol: str, cap_m: float | None
) -> tuple[DepthEstimate, ErrorMaps]:
    """Read the estimate of one frame, and compute its error at each pixel, for a page.

    Every map and picture has the size of the truth.

    Args:
        dataset: frames with truth.
        index: number of the frame.
        predictions: folder of the predictions.
        protocol: a key of ``PROTOCOLS``. By one of disparity the error is that of disparity [px],
            else that of depth as a share of the true depth.
        cap_m: truth beyond it does not count; None for disparity.

    Raises:
        InputError: the frame does not count, or a file is damaged.
    """
    rule = find_protocol(protocol)
    name = dataset.frames[index].name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Notice)  # given when the frame was measured
        prepared = prepare_frame(dataset, index, predictions, rule)
    if isinstance(prepared, str):
        raise InputError(f"{name}: {prepared}; choose a frame that counts")
    rig = prepared.rig
    size = prepared.truth.shape

    # The whole prediction, without the sky.
    depth_m = None if rig is None else disparity.depth_from_disparity(prepared.disparity_px, rig)
    sky = files.read_part(predictions, name, "sky.png")
    is_sky = None if sky is None else disparity.resize_map((sky[0] > 0).float(), *size) > 0.5
    if is_sky is not None and depth_m is not None:
        depth_m = torch.where(is_sky, torch.nan, depth_m)
    right = files.read_part(predictions, name, "right.png")
    if right is not None:
        right = disparity.resize_image(right, *size)

    # The error at the pixels that count.
    predicted, truth = apply_protocol(prepared, rule, cap_m)
    error = (predicted - truth).abs()
    true_m: Map | None
    if rule.is_disparity:
        true_m = None if rig is None else disparity.depth_from_disparity(truth, rig)
    else:
        error = error / truth
        true_m = truth

    estimate = DepthEstimate(
        input=dataset.read_input(index),
        depth_m=depth_m,
        disparity_px=prepared.disparity_px,
        confidence=prepared.confidence,
        right=right,
        is_sky=is_sky,
    )
    return estimate, ErrorMaps(error=error, is_disparity=rule.is_disparity, true_depth_m=true_m)


def measure_image_confidence(net: FakestereoNet, images: Iterable[DepthInput]) -> list[float]:
    """Estimate images, and return the ``DepthEstimate.image_confidence`` of each, 0..1.

    Raises:
        InputError: the weights have no such confidence, or an image cannot be estimated.
    """
    confidences: list[float] = []
    for image in images:
        image_confidence = net.estimate_input(replace(image, right=None)).image_confidence
        if image_confidence is None:
            raise InputError(
                "these weights have no generator with a confidence of its own; take those of "
                "'depthpose depth train select'"
            )
        confidences.append(image_confidence)
    return confidences
