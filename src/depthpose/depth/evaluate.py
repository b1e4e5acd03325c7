"""Evaluation of predictions in files by a named protocol: rows of metrics.

A protocol fixes the truth, the pixels that count and how the prediction is prepared. Numbers of
two protocols are not comparable, so every row carries its protocol's name.
"""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError, Notice, nearest_name
from depthpose.core.files import read_image
from depthpose.core.frame import data_frame
from depthpose.depth import disparity
from depthpose.depth import predictions as files
from depthpose.depth.datasets import (
    Dataset,
    FramePaths,
    has_lidar,
    read_disparity,
    read_lidar_depth,
)
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.metrics import (
    RANKING,
    SMALLEST_DEPTH_M,
    error_by_decile,
    garg_crop,
    measure,
    score_confidence,
    view_errors,
)
from depthpose.depth.types import DepthError, DepthEstimate, Map, StereoInput

_ASPECT_TOLERANCE = 1.01
"""Ratio of two aspects that are still the same: the sides of a scaled image are rounded to whole
pixels, often to multiples of 32."""
_CROP_ERROR_SHARE = 0.7
"""Share of the error of a stretched map: a map with less error than that as a crop is a crop of the
image."""
_noticed_sizes: set[str] = set()
NO_PREDICTION = "no right view to match, and no prediction"


@dataclass(frozen=True)
class Protocol:
    """A rule by which predictions are compared with the truth.

    In all protocols of depth, truth counts between 0.001 m and the cap, and predictions are clamped
    to that range.
    """

    summary: str  #: one line for people
    #: ``velodyne_x`` and ``camera_z`` project one LiDAR scan; ``depth`` and ``disparity`` read the
    #: truth that the dataset ships
    truth: Literal["velodyne_x", "camera_z", "depth", "disparity"]
    with_crop: bool = False  #: only truth inside the crop of Garg et al. counts

    @property
    def is_disparity(self) -> bool:
        """Whether disparity [px] is compared, which has no cap, and not depth [m]."""
        return self.truth == "disparity"


PROTOCOLS = {
    "eigen-raw": Protocol(
        "one LiDAR scan, depth = LiDAR x, Garg crop: monodepth's, and the thesis's",
        "velodyne_x",
        with_crop=True,
    ),
    "eigen-raw-camera": Protocol("the same with depth = camera z", "camera_z", with_crop=True),
    "eigen-improved": Protocol("annotated depth maps, no crop: monodepth2's", "depth"),
    "eigen-improved-garg": Protocol(
        "annotated depth maps, Garg crop: BTS's, AdaBins'", "depth", with_crop=True
    ),
    "kitti-2015": Protocol(
        "disparity: EPE and D1 (> 3 px and > 5 %), all pixels and those both views see", "disparity"
    ),
}


def find_protocol(name: str) -> Protocol:
    """Give a protocol by name.

    Raises:
        InputError: there is none; the error suggests the most similar name.
    """
    if name not in PROTOCOLS:
        raise InputError(f"protocol {name!r}: {nearest_name(name, PROTOCOLS)}")
    return PROTOCOLS[name]


def has_truth(frame: FramePaths, rule: Protocol) -> bool:
    """Whether a frame has files of the truth that a protocol needs; none is read."""
    match rule.truth:
        case "disparity":
            return frame.disparity is not None
        case "depth":
            return frame.depth is not None
        case _:
            return has_lidar(frame, rule.truth)


@dataclass(frozen=True, kw_only=True)
class EvaluationRow:
    """Metrics of one frame, their mean over frames (each counts the same), or those of a decile.

    The columns of a table are the fields in this order.
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
        """Give the columns of files and tables: the fields that are not None, and each metric."""
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
        """Give ``per_frame`` as a ``pandas.DataFrame``; the columns are those of its table.

        Raises:
            ImportError: pandas is not installed.
        """
        return data_frame(row.columns() for row in self.per_frame)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Metrics of one frame at one cap."""

    frame: str  #: its name
    cap_m: float | None  #: None for disparity
    pixels: int  #: number of pixels that were compared
    coverage: float  #: share of the pixels with truth that have a prediction
    metrics: Mapping[str, float]  #: by name; empty where no pixel was compared
    #: mean error of each tenth of the pixels, by rising confidence; None without a confidence
    deciles: list[float] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class _PreparedFrame:
    """A frame's truth and prediction, at the size of the image."""

    frame: FramePaths
    truth: Map  # depth [m] or disparity [px], as the protocol says
    disparity_px: Map
    depth_m: Map | None  # where depth was predicted and no disparity
    confidence: Map | None
    rig: StereoRig | None
    view_metrics: dict[str, float]  # metrics of the synthesised right view


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
    measured = {
        dataset.frames[index].name: measure_frame(dataset, index, predictions, protocol, caps_m)
        for index in progress(range(len(dataset)))
    }
    return summarise(dataset, protocol, measured)


def measure_frame(
    dataset: Dataset, index: int, predictions: Path, protocol: str, caps_m: Sequence[float]
) -> list[Measured] | str:
    """Measure one frame at each cap, or give the reason why it does not count.

    Raises:
        InputError: an unknown protocol, or a missing or damaged prediction.
    """
    rule = find_protocol(protocol)
    prepared = _prepare_frame(dataset, index, predictions, rule)
    if isinstance(prepared, str):
        return prepared
    caps: Sequence[float | None] = [None] if rule.is_disparity else caps_m
    results = [_measure_at_cap(prepared, rule, cap_m) for cap_m in caps]
    measured = [result for result in results if result is not None]
    return measured or "no truth within the caps and the crop"


def _measure_at_cap(
    prepared: _PreparedFrame, rule: Protocol, cap_m: float | None
) -> Measured | None:
    """Measure a frame at one cap (None for disparity); None where it has no truth within it."""
    predicted, truth = _apply_protocol(prepared, rule, cap_m)
    has_truth = torch.isfinite(truth)
    is_compared = has_truth & torch.isfinite(predicted)
    if not bool(has_truth.any()):
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
    return Measured(
        frame=prepared.frame.name,
        cap_m=cap_m,
        pixels=int(is_compared.sum()),
        coverage=float(is_compared.sum() / has_truth.sum()),
        metrics=metrics,
        deciles=deciles,
    )


def _measure_non_occluded(prepared: _PreparedFrame) -> dict[str, float]:
    """Measure the disparity of the pixels that both views show; {} where they have no truth."""
    if prepared.frame.disparity_noc is None:
        return {}
    truth_px = read_disparity(prepared.frame.disparity_noc)
    is_compared = torch.isfinite(truth_px) & torch.isfinite(prepared.disparity_px)
    if not bool(is_compared.any()):
        return {}
    return measure("disparity_noc", prepared.disparity_px[is_compared], truth_px[is_compared])


def summarise(
    dataset: Dataset, protocol: str, results: Mapping[str, list[Measured] | str]
) -> Evaluation:
    """Make the rows of all frames and their means, wherever the frames were measured.

    ``results``: what :func:`measure_frame` gave, by the name of the frame.

    Raises:
        InputError: no frame has truth.
    """
    # One result for each frame and cap.
    measured: list[Measured] = []
    skipped: dict[str, str] = {}
    for frame in dataset.frames:
        outcome = results[frame.name]
        if isinstance(outcome, str):
            skipped[frame.name] = outcome
        else:
            measured += outcome
    if not measured:
        raise _nothing_measured(dataset, protocol, skipped)

    make_row = partial(EvaluationRow, protocol=protocol, dataset=dataset.name)
    per_frame = [
        make_row(
            frame=result.frame,
            cap_m=result.cap_m,
            pixels=result.pixels,
            coverage=result.coverage,
            metrics=result.metrics,
        )
        for result in measured
    ]

    # The means of each cap.
    ranking_metric = RANKING["disparity" if find_protocol(protocol).is_disparity else "depth"]
    rows: list[EvaluationRow] = []
    deciles: list[EvaluationRow] = []
    for cap_m in dict.fromkeys(result.cap_m for result in measured):
        at_cap = [result for result in measured if result.cap_m == cap_m]
        if not any(result.pixels for result in at_cap):
            raise InputError(f"{dataset.name}: no prediction has a pixel where there is truth")
        rows.append(
            make_row(
                cap_m=cap_m,
                frames=len(at_cap),
                pixels=sum(result.pixels for result in at_cap),
                coverage=sum(result.coverage for result in at_cap) / len(at_cap),
                metrics=_average_metrics(at_cap),
            )
        )

        # Mean errors of tenths of the pixels, from the least confidence to the largest.
        by_decile = [result.deciles for result in at_cap if result.deciles is not None]
        if by_decile:
            errors = torch.tensor(by_decile, dtype=torch.float64).nanmean(0).tolist()
            deciles += [
                make_row(
                    cap_m=cap_m,
                    frames=len(by_decile),
                    confidence_decile=decile,
                    metrics={ranking_metric: error},
                )
                for decile, error in enumerate(errors, 1)
            ]
    return Evaluation(rows=rows, per_frame=per_frame, deciles=deciles, skipped=skipped)


def _average_metrics(results: Sequence[Measured]) -> dict[str, float]:
    """Average over frames with a compared pixel the metrics that all of them have."""
    compared = [result.metrics for result in results if result.pixels]
    common = [name for name in compared[0] if all(name in metrics for metrics in compared)]
    return {name: sum(metrics[name] for metrics in compared) / len(compared) for name in common}


def _nothing_measured(dataset: Dataset, protocol: str, skipped: Mapping[str, str]) -> InputError:
    """Make the error of a dataset of which no frame could be measured, with the remedy."""
    unpredicted = [name for name, reason in skipped.items() if reason == NO_PREDICTION]
    if unpredicted:
        return InputError(
            f"{dataset.name}: no frame has both truth and a prediction; {unpredicted[0]!r} has the "
            f"truth and {NO_PREDICTION}. Predictions are called {files.EXPECTED}"
        )
    rule = find_protocol(protocol)
    fitting = [
        name
        for name, other in PROTOCOLS.items()
        if other.truth != rule.truth and any(has_truth(frame, other) for frame in dataset.frames)
    ]
    remedy = f"--protocol {' or '.join(fitting)} fits." if fitting else "Choose another folder."
    return InputError(
        f"{dataset.name}: none of its {len(dataset)} frames has the truth that protocol "
        f"{protocol!r} needs ({rule.truth}). {remedy}"
    )


def frame_result(
    dataset: Dataset, index: int, predictions: Path, protocol: str, cap_m: float | None
) -> tuple[DepthEstimate, DepthError]:
    """Read the estimate of one frame, and its error at each pixel, as :func:`evaluate` has them.

    Every map and picture has the size of the truth. By a protocol of disparity the error is that of
    disparity [px], and ``cap_m`` None; else it is that of depth as a share of the true depth.

    Raises:
        InputError: the frame does not count, or a file is damaged.
    """
    rule = find_protocol(protocol)
    name = dataset.frames[index].name
    prepared = _prepare_frame(dataset, index, predictions, rule)
    if isinstance(prepared, str):
        raise InputError(f"{name}: {prepared}; choose a frame that counts")
    rig = prepared.rig
    size = prepared.truth.shape

    # The whole prediction, without the sky.
    depth_m = None if rig is None else disparity.depth_from_disparity(prepared.disparity_px, rig)
    sky = files.read_part(predictions, name, "sky.png")
    is_sky = None if sky is None else disparity.resized_map((sky[0] > 0).float(), *size) > 0.5
    if is_sky is not None and depth_m is not None:
        depth_m = torch.where(is_sky, torch.nan, depth_m)
    right = files.read_part(predictions, name, "right.png")
    if right is not None:
        right = disparity.resize_image(right, *size)

    # The error at the pixels that count.
    predicted, truth = _apply_protocol(prepared, rule, cap_m)
    error = (predicted - truth).abs()
    true_m: Map | None = truth
    if not rule.is_disparity:
        error = error / truth
    else:
        true_m = None if rig is None else disparity.depth_from_disparity(truth, rig)

    estimate = DepthEstimate(
        depth_m=depth_m,
        disparity_px=prepared.disparity_px,
        confidence=prepared.confidence,
        right=right,
        is_sky=is_sky,
    )
    return estimate, DepthError(error=error, is_disparity=rule.is_disparity, true_depth_m=true_m)


def clamped_depth(disparity_px: Map, rig: StereoRig, cap_m: float) -> Map:
    """Convert disparity to depth between 0.001 m and a cap, as the published Eigen script does.

    NaN (no prediction) stays NaN; zero and negative disparity become the smallest depth, as there.
    """
    depth_m = disparity.depth_from_disparity(disparity_px, rig).nan_to_num(0.0)
    clamped_m = depth_m.clamp(SMALLEST_DEPTH_M, cap_m)
    return torch.where(torch.isnan(disparity_px), torch.nan, clamped_m)


def _prepare_frame(
    dataset: Dataset, index: int, predictions: Path, rule: Protocol
) -> _PreparedFrame | str:
    """Read truth and prediction of a frame, or give the reason why it is not measured.

    Raises:
        InputError: the prediction is missing or damaged, or of another unit, sign or size.
    """
    frame = dataset.frames[index]
    if not has_truth(frame, rule):
        return f"no truth of the kind {rule.truth}"
    if frame.right is None and not files.has_prediction(predictions, frame.name):
        return NO_PREDICTION

    # The truth.
    if rule.truth in ("velodyne_x", "camera_z"):
        truth = read_lidar_depth(frame, rule.truth)
    else:
        stored_truth = dataset.read_truth(index)
        truth = stored_truth.disparity_px if rule.is_disparity else stored_truth.depth_m
    assert truth is not None, "has_truth said so"
    height, width = truth.shape

    # The prediction. Depth is compared as it was predicted, or made from the predicted disparity.
    rig = dataset.read_rig(index)
    depth_m = None
    has_disparity = files.has_prediction(predictions, frame.name, of_disparity=True)
    if not rule.is_disparity and (rig is None or not has_disparity):
        depth_m = files.read_depth(predictions, frame.name)
    if not rule.is_disparity and rig is None:
        if depth_m is None:
            raise InputError(
                f"{frame.name}: no calibration of a pair, so its disparity cannot become metres; "
                f"predict depth ({frame.name}.depth_m.npy), or give the frame its baseline"
            )
        # Any rig will do: it is undone where depth is compared.
        K = torch.tensor([[width, 0, 0], [0, width, 0], [0, 0, 1]], dtype=torch.float64)
        rig = StereoRig(width=width, height=height, K=K, baseline_m=1.0)
    stored_px = files.read_disparity(
        predictions, frame.name, rig, with_disparity_png=rule.is_disparity
    )
    true_px = truth
    if not rule.is_disparity and rig is not None:
        true_px = disparity.disparity_from_depth(truth, rig)
    predicted_px = _resize_to_truth(true_px, stored_px, predictions / frame.name)

    # Units and signs; where principal points differ, the disparity of far points is negative.
    cx_difference_px = 0.0 if rig is None else rig.cx_right_minus_left_px
    advice = disparity.disparity_advice(predicted_px + cx_difference_px, true_px + cx_difference_px)
    if advice is not None:
        raise InputError(f"{predictions / frame.name}: {advice}")

    confidence = files.read_part(predictions, frame.name, "confidence.npy")
    if confidence is not None and confidence.shape != truth.shape:
        confidence = disparity.resized_map(confidence, height, width)
    return _PreparedFrame(
        frame=frame,
        truth=truth,
        disparity_px=predicted_px,
        depth_m=depth_m if depth_m is not None and depth_m.shape == truth.shape else None,
        confidence=confidence,
        rig=rig,
        view_metrics=_measure_view(frame, predictions),
    )


def _measure_view(frame: FramePaths, predictions: Path) -> dict[str, float]:
    """Compare the synthesised right view of a frame with the real one; {} where one is missing."""
    synthesised = files.read_part(predictions, frame.name, "right.png")
    if synthesised is None or frame.right is None:
        return {}
    real = read_image(frame.right)
    if real.shape != synthesised.shape:
        raise InputError(
            f"{predictions}: the drawn view of {frame.name} is "
            f"{synthesised.shape[2]}x{synthesised.shape[1]}, but its right image is "
            f"{real.shape[2]}x{real.shape[1]}; predict it again"
        )
    return view_errors(synthesised, real)


def _resize_to_truth(true_px: Map, stored_px: Float[Tensor, "_ _"], path: Path) -> Map:
    """Resize a predicted disparity to the size of the truth.

    A map of another aspect, as networks give it that take squeezed images, is stretched, with a
    notice. ``path`` names the prediction in errors.

    Raises:
        InputError: the map is transposed, or a crop of the image's.
    """
    height, width = true_px.shape
    rows, columns = stored_px.shape
    stretched_px = disparity.resized_map(stored_px, height, width) * (width / columns)
    aspect_ratio = columns * height / (rows * width)
    if 1 / _ASPECT_TOLERANCE < aspect_ratio < _ASPECT_TOLERANCE:
        return stretched_px

    sizes = f"{columns}x{rows}, and its truth {width}x{height}"
    transposed_ratio = rows * height / (columns * width)
    if 1 / _ASPECT_TOLERANCE < transposed_ratio < _ASPECT_TOLERANCE:
        raise InputError(f"{path}: is {sizes}: it is transposed; save rows first, (H, W)")
    if rows <= height and columns <= width:
        _refuse_crop(true_px, stored_px, stretched_px, f"{path}: is {sizes}")
    if sizes not in _noticed_sizes:
        _noticed_sizes.add(sizes)  # once for all frames of a data set
        message = (
            f"{path}: is {sizes}, of another aspect, so it is stretched: right where the image was "
            "squeezed for it; what was cut out of the image is put into a map of its size, NaN "
            "around it"
        )
        warnings.warn(message, Notice, stacklevel=2)
    return stretched_px


def _refuse_crop(
    true_px: Map, stored_px: Float[Tensor, "_ _"], stretched_px: Map, context: str
) -> None:
    """Refuse a predicted disparity that fits a crop of the truth better than all of it.

    Crops are cut out of the middle of the columns, and of the middle or the bottom of the rows, as
    KITTI's of 1216x352. ``stretched_px`` is the prediction at the size of the truth, ``context``
    begins the error.
    """
    height, width = true_px.shape
    rows, columns = stored_px.shape
    left = (width - columns) // 2
    errors_px: dict[int, float] = {}
    for top in ((height - rows) // 2, height - rows):
        window_px = true_px[top : top + rows, left : left + columns]
        errors_px[top] = float((stored_px - window_px).abs().nanmedian())
    top = min(errors_px, key=lambda row: errors_px[row])
    stretched_error_px = float((stretched_px - true_px).abs().nanmedian())
    if errors_px[top] < _CROP_ERROR_SHARE * stretched_error_px:
        raise InputError(
            f"{context}: it is a part of the image, cut out at column {left}, row "
            f"{top} (there the median error is {errors_px[top]:.2f} px, stretched to all of it "
            f"{stretched_error_px:.2f} px); put it into a map of {width}x{height}, NaN around it"
        )


def _apply_protocol(
    prepared: _PreparedFrame, rule: Protocol, cap_m: float | None
) -> tuple[Map, Map]:
    """Clamp the prediction and mask the truth as the protocol says.

    Both are disparity [px] or depth [m], as the protocol compares; NaN where there is no
    prediction, and where there is no truth or it does not count. Only depth has a ``cap_m``.
    """
    truth = prepared.truth
    if rule.is_disparity:
        return prepared.disparity_px, truth
    assert cap_m is not None, "depth is compared up to a cap"
    is_counted = (truth > SMALLEST_DEPTH_M) & (truth < cap_m)
    if rule.with_crop:
        is_counted &= garg_crop(*truth.shape)
    predicted_m = prepared.depth_m
    if predicted_m is None:
        assert prepared.rig is not None
        predicted_m = clamped_depth(prepared.disparity_px, prepared.rig, cap_m)
    clamped_m = predicted_m.clamp(SMALLEST_DEPTH_M, cap_m)
    return clamped_m, torch.where(is_counted, truth, torch.nan)


def measure_image_confidence(net: FakestereoNet, images: Iterable[StereoInput]) -> list[float]:
    """Estimate images, and give the ``DepthEstimate.image_confidence`` of each, 0..1.

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
