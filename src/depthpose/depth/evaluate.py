"""Named protocols to rows: predictions are files, metrics read files.

A protocol fixes the truth, the pixels that count and how the prediction is prepared. Numbers of
two protocols do not compare; every row carries its protocol's name.
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
from depthpose.depth.datasets import Dataset, Frame, has_lidar, lidar_truth, read_disparity
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

_SAME_ASPECT = 1.01
"""Of a map made of an image that was scaled: sides are rounded to whole pixels, often to 32."""
_CLEARLY = 0.7
"""Of the error of the map when it is stretched: with less it is a part of the image."""
_stretched: set[str] = set()
NO_PREDICTION = "no right view to match, and no prediction"


@dataclass(frozen=True)
class Protocol:
    """How a prediction is compared with the truth.

    In all protocols of depth truth counts between 0.001 m and the cap, and predictions are clamped
    to that range.
    """

    summary: str  #: one line for people
    #: ``velodyne_x`` and ``camera_z`` project one LiDAR scan; ``depth`` and ``disparity`` read the
    #: truth that the dataset ships
    truth: Literal["velodyne_x", "camera_z", "depth", "disparity"]
    with_crop: bool = False  #: only truth inside the crop of Garg et al. counts


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
        InputError: there is none; the error names the nearest.
    """
    if name not in PROTOCOLS:
        raise InputError(f"protocol {name!r}: {nearest_name(name, PROTOCOLS)}")
    return PROTOCOLS[name]


def has_truth(frame: Frame, rule: Protocol) -> bool:
    """Whether a frame has the truth that a protocol needs, by its files alone."""
    match rule.truth:
        case "disparity":
            return frame.disparity is not None
        case "depth":
            return frame.depth is not None
        case _:
            return has_lidar(frame, rule.truth)


@dataclass(frozen=True, kw_only=True)
class EvaluationRow:
    """Numbers of one frame, their mean over frames (each counts the same), or one decile of it.

    Its columns are its fields, in order.
    """

    method: str | None = None  #: whose predictions were measured; None, as the next four: not known
    input: str | None = None  #: which images it was given
    speed: str | None = None  #: at which networks ran
    weights: str | None = None  #: name of the file
    weights_sha256: str | None = None  #: the first 12 digits
    protocol: str  #: by which the frames were measured
    dataset: str  #: its name
    frame: str | None = None  #: of one frame, its name
    cap_m: float | None  #: truth beyond it does not count; None for disparity
    frames: int | None = None  #: how many a mean is over
    pixels: int | None = None  #: that were compared, in all frames
    coverage: float | None = None  #: share of the pixels with truth that have a prediction
    #: n, where the numbers are of the n-th tenth of the pixels, from the least sure (1) to the
    #: surest (10)
    confidence_decile: int | None = None
    #: what all frames with a predicted pixel have, in the order of ``depth.metrics.METRICS``, then
    #: those of the drawn view and of the confidence
    metrics: Mapping[str, float]

    def columns(self) -> dict[str, str | int | float]:
        """Give the columns by name, one for each metric, as files and printed tables hold them.

        A field that is None is no column.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        metrics = values.pop("metrics")
        return {**{name: value for name, value in values.items() if value is not None}, **metrics}


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What evaluating one set of predictions gave."""

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
    """One frame's numbers by one cap (None for disparity), and its error by decile."""

    frame: str
    cap_m: float | None
    pixels: int
    coverage: float
    metrics: Mapping[str, float]
    deciles: list[float] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class _Prepared:
    """A frame's truth and prediction, brought to the size of the image."""

    frame: Frame
    truth: Map
    disparity_px: Map
    depth_m: Map | None  # of what was predicted as depth alone, which is compared
    confidence: Map | None
    rig: StereoRig | None
    view: dict[str, float]  # errors of the drawn right view


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
        progress: wraps the sequence of frames, to show how far it is.

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
    """Measure one frame, once for each cap, or give the reason why it does not count.

    Raises:
        InputError: an unknown protocol, or a missing or damaged prediction.
    """
    rule = find_protocol(protocol)
    prepared = _prepare(dataset, index, predictions, rule)
    if isinstance(prepared, str):
        return prepared
    caps: Sequence[float | None] = [None] if rule.truth == "disparity" else caps_m
    measured = [_measure_by_cap(prepared, rule, cap_m) for cap_m in caps]
    with_truth = [result for result in measured if result is not None]
    return with_truth or "no truth within the caps and the crop"


def _measure_by_cap(prepared: _Prepared, rule: Protocol, cap_m: float | None) -> Measured | None:
    """Measure a frame by one cap, None for disparity; None where no truth is within it."""
    predicted, truth = _compared(prepared, rule, cap_m)
    has_truth = torch.isfinite(truth)
    is_compared = has_truth & torch.isfinite(predicted)
    if not bool(has_truth.any()):
        return None

    metrics: dict[str, float] = {}
    deciles = None
    if bool(is_compared.any()):
        error = (predicted - truth).abs()
        if cap_m is None:
            metrics |= measure("disparity", predicted[is_compared], truth[is_compared])
            metrics |= _visible_in_both(prepared)
        else:
            metrics |= measure("depth", predicted[is_compared], truth[is_compared])
            error = error / truth
        metrics |= prepared.view
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


def _visible_in_both(prepared: _Prepared) -> dict[str, float]:
    """Measure the disparity of pixels that both views see, where the frame has their truth."""
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
    """Make the rows of a table of its frames, the same ones wherever they were measured.

    ``results`` has for each frame's name what :func:`measure_frame` gave.

    Raises:
        InputError: no frame has truth.
    """
    outcomes = {frame.name: results[frame.name] for frame in dataset.frames}
    skipped = {name: reason for name, reason in outcomes.items() if isinstance(reason, str)}
    measured = [
        frame_row
        for outcome in outcomes.values()
        if not isinstance(outcome, str)
        for frame_row in outcome
    ]
    if not measured:
        raise _nothing_measured(dataset, protocol, skipped)

    row = partial(EvaluationRow, protocol=protocol, dataset=dataset.name)
    columns = ("frame", "cap_m", "pixels", "coverage", "metrics")
    per_frame = [
        row(**{name: getattr(frame_row, name) for name in columns}) for frame_row in measured
    ]
    evaluation = Evaluation(rows=[], per_frame=per_frame, deciles=[], skipped=skipped)
    for cap_m in dict.fromkeys(frame_row.cap_m for frame_row in measured):
        of_cap = [frame_row for frame_row in measured if frame_row.cap_m == cap_m]

        # Means over frames: coverage over all, metrics over those with a compared pixel.
        compared = [frame_row for frame_row in of_cap if frame_row.pixels]
        if not compared:
            raise InputError(f"{dataset.name}: no prediction has a pixel where there is truth")
        names = [
            name
            for name in compared[0].metrics
            if all(name in frame_row.metrics for frame_row in compared)
        ]
        metrics = {
            name: sum(frame_row.metrics[name] for frame_row in compared) / len(compared)
            for name in names
        }
        coverage = sum(frame_row.coverage for frame_row in of_cap) / len(of_cap)
        pixels = sum(frame_row.pixels for frame_row in of_cap)
        evaluation.rows.append(
            row(cap_m=cap_m, frames=len(of_cap), pixels=pixels, coverage=coverage, metrics=metrics)
        )

        # Errors by tenths of the pixels, from the least sure to the surest.
        deciles = [frame_row.deciles for frame_row in of_cap if frame_row.deciles is not None]
        errors = torch.tensor(deciles, dtype=torch.float64).nanmean(0).tolist() if deciles else []
        ranked_by = RANKING["disparity" if cap_m is None else "depth"]
        for decile, error in enumerate(errors, 1):
            metrics = {ranked_by: error}
            evaluation.deciles.append(
                row(cap_m=cap_m, frames=len(deciles), confidence_decile=decile, metrics=metrics)
            )
    return evaluation


def _nothing_measured(dataset: Dataset, protocol: str, skipped: Mapping[str, str]) -> InputError:
    """Make the error of a dataset of which no frame could be measured, with the remedy."""
    without = next((name for name, reason in skipped.items() if reason == NO_PREDICTION), None)
    if without is not None:
        return InputError(
            f"{dataset.name}: no frame has both truth and a prediction; {without!r} has the truth "
            f"and {NO_PREDICTION}. Predictions are called {files.EXPECTED}"
        )
    rule = find_protocol(protocol)
    others = {name: other for name, other in PROTOCOLS.items() if other.truth != rule.truth}
    fitting = [
        name
        for name, other in others.items()
        if any(has_truth(frame, other) for frame in dataset.frames)
    ]
    remedy = f"--protocol {' or '.join(fitting)} fits." if fitting else "Choose another folder."
    return InputError(
        f"{dataset.name}: none of its {len(dataset)} frames has the truth that protocol "
        f"{protocol!r} needs ({rule.truth}). {remedy}"
    )


def frame_result(
    dataset: Dataset, index: int, predictions: Path, protocol: str, cap_m: float | None
) -> tuple[DepthEstimate, DepthError]:
    """Give the estimate of one frame and its error by pixel, as :func:`evaluate` measured them.

    Both have the size of the truth. ``cap_m`` is that of the row, None for a protocol of disparity;
    the error is then one of disparity [px], else one of depth as a share of the true depth.

    Raises:
        InputError: the frame does not count, or a file is damaged.
    """
    rule = find_protocol(protocol)
    name = dataset.frames[index].name
    prepared = _prepare(dataset, index, predictions, rule)
    if isinstance(prepared, str):
        raise InputError(f"{name}: {prepared}; choose a frame that counts")
    rig = prepared.rig

    # What is shown: the whole prediction, without the sky.
    depth_m = None if rig is None else disparity.depth_from_disparity(prepared.disparity_px, rig)
    sky = files.read_part(predictions, name, "sky.png")
    is_sky = None if sky is None else sky[0] > 0
    if is_sky is not None and depth_m is not None and is_sky.shape == depth_m.shape:
        depth_m = torch.where(is_sky, torch.nan, depth_m)

    # What is measured: the pixels that count, clamped to the cap.
    predicted, truth = _compared(prepared, rule, cap_m)
    error = (predicted - truth).abs()
    if cap_m is not None:
        error = error / truth
        true_m = truth
    else:
        true_m = None if rig is None else disparity.depth_from_disparity(truth, rig)

    estimate = DepthEstimate(
        depth_m=depth_m,
        disparity_px=prepared.disparity_px,
        confidence=prepared.confidence,
        right=files.read_part(predictions, name, "right.png"),
        is_sky=is_sky,
    )
    return estimate, DepthError(error=error, is_disparity=cap_m is None, true_depth_m=true_m)


def clamped_depth(disparity_px: Map, rig: StereoRig, cap_m: float) -> Map:
    """Turn disparity into depth as the published script does: infinity to 0, then the clamp.

    NaN (no prediction) stays NaN; zero and negative disparity become the smallest depth, as there.
    """
    depth_m = disparity.depth_from_disparity(disparity_px, rig).nan_to_num(0.0)
    clamped_m = depth_m.clamp(SMALLEST_DEPTH_M, cap_m)
    return torch.where(torch.isnan(disparity_px), torch.nan, clamped_m)


def _prepare(dataset: Dataset, index: int, predictions: Path, rule: Protocol) -> _Prepared | str:
    """Read truth and prediction of a frame, or give the reason why it is not measured."""
    frame = dataset.frames[index]
    is_stereo = rule.truth == "disparity"
    if not has_truth(frame, rule):
        return f"no truth of the kind {rule.truth}"
    if frame.right is None and not files.has_prediction(predictions, frame.name):
        return NO_PREDICTION
    if rule.truth in ("velodyne_x", "camera_z"):
        truth = lidar_truth(frame, rule.truth)
    else:
        shipped = dataset.read_truth(index)
        truth = shipped.disparity_px if is_stereo else shipped.depth_m
    assert truth is not None, "has_truth said so"
    height, width = truth.shape

    # Depth that was predicted as such is compared as it is; else it follows from the disparity.
    rig = dataset.read_rig(index)
    depth_m = None
    has_disparity = files.has_prediction(predictions, frame.name, of_disparity=True)
    if not is_stereo and (rig is None or not has_disparity):
        depth_m = files.read_depth(predictions, frame.name)
    if not is_stereo and rig is None:
        if depth_m is None:
            raise InputError(
                f"{frame.name}: no calibration of a pair, so its disparity cannot become metres; "
                f"predict depth ({frame.name}.depth_m.npy), or give the frame its baseline"
            )
        K = torch.tensor([[width, 0, 0], [0, width, 0], [0, 0, 1]], dtype=torch.float64)
        rig = StereoRig(width=width, height=height, K=K, baseline_m=1.0)  # depth takes any
    stored_px = files.read_disparity(predictions, frame.name, rig, with_disparity_png=is_stereo)
    true_px = truth if is_stereo or rig is None else disparity.disparity_from_depth(truth, rig)
    predicted_px = _at_size_of(true_px, stored_px, predictions / frame.name)
    # With principal points apart, the disparity of far points is negative.
    cx_difference_px = 0.0 if rig is None else rig.cx_right_minus_left_px
    advice = disparity.disparity_advice(predicted_px + cx_difference_px, true_px + cx_difference_px)
    if advice is not None:
        raise InputError(f"{predictions / frame.name}: {advice}")

    confidence = files.read_part(predictions, frame.name, "confidence.npy")
    if confidence is not None and confidence.shape != truth.shape:
        confidence = disparity.resized_map(confidence, height, width)
    return _Prepared(
        frame=frame,
        truth=truth,
        disparity_px=predicted_px,
        depth_m=depth_m if depth_m is not None and depth_m.shape == truth.shape else None,
        confidence=confidence,
        rig=rig,
        view=_synthesised_view_errors(frame, predictions),
    )


def _synthesised_view_errors(frame: Frame, predictions: Path) -> dict[str, float]:
    """Compare the drawn right view of a frame with the real one, where there are both."""
    drawn = files.read_part(predictions, frame.name, "right.png")
    if drawn is None or frame.right is None:
        return {}
    real = read_image(frame.right)
    if real.shape != drawn.shape:
        raise InputError(
            f"{predictions}: the drawn view of {frame.name} is "
            f"{drawn.shape[2]}x{drawn.shape[1]}, but its right image is "
            f"{real.shape[2]}x{real.shape[1]}; predict it again"
        )
    return view_errors(drawn, real)


def _at_size_of(true_px: Map, stored_px: Float[Tensor, "_ _"], path: Path) -> Map:
    """Bring a prediction to the size of the truth.

    Networks that take squeezed images give maps of another aspect, which are stretched back, with a
    notice; a map that is turned, or a part of the image's, is refused.
    """
    height, width = true_px.shape
    rows, columns = stored_px.shape
    stretched_px = disparity.resized_map(stored_px, height, width) * (width / columns)
    aspect = columns * height / (rows * width)
    turned = rows * height / (columns * width)
    if 1 / _SAME_ASPECT < aspect < _SAME_ASPECT:
        return stretched_px
    sizes = f"{columns}x{rows}, and its truth {width}x{height}"
    if 1 / _SAME_ASPECT < turned < _SAME_ASPECT:
        raise InputError(f"{path}: is {sizes}: it is transposed; save rows first, (H, W)")
    if rows <= height and columns <= width:
        left = (width - columns) // 2
        errors_px = {}
        for top in ((height - rows) // 2, height - rows):  # from the middle, or as KITTI's 1216x352
            window = true_px[top : top + rows, left : left + columns]
            errors_px[top] = float((stored_px - window).abs().nanmedian())
        top = min(errors_px, key=lambda row: errors_px[row])
        stretched = float((stretched_px - true_px).abs().nanmedian())
        if errors_px[top] < _CLEARLY * stretched:
            raise InputError(
                f"{path}: is {sizes}: it is a part of the image, cut out at column {left}, row "
                f"{top} (there the median error is {errors_px[top]:.2f} px, stretched to all of it "
                f"{stretched:.2f} px); put it into a map of {width}x{height}, NaN around it"
            )
    if sizes not in _stretched:
        _stretched.add(sizes)  # of a whole data set once
        message = (
            f"{path}: is {sizes}, of another aspect, so it is stretched: right where the image was "
            "squeezed for it; what was cut out of the image is put into a map of its size, NaN "
            "around it"
        )
        warnings.warn(message, Notice, stacklevel=2)
    return stretched_px


def _compared(prepared: _Prepared, rule: Protocol, cap_m: float | None) -> tuple[Map, Map]:
    """Prepare prediction and truth as the protocol says; NaN where there is none or none counts."""
    truth = prepared.truth
    predicted_m = prepared.depth_m
    if cap_m is None:
        return prepared.disparity_px, truth
    counts = (truth > SMALLEST_DEPTH_M) & (truth < cap_m)
    if rule.with_crop:
        counts &= garg_crop(*truth.shape)
    if predicted_m is None:
        assert prepared.rig is not None
        predicted_m = clamped_depth(prepared.disparity_px, prepared.rig, cap_m)
    return predicted_m.clamp(SMALLEST_DEPTH_M, cap_m), torch.where(counts, truth, torch.nan)


def measure_image_confidence(net: FakestereoNet, images: Iterable[StereoInput]) -> list[float]:
    """Give the confidence in each image as a whole, 0..1 (``DepthEstimate.image_confidence``)."""
    confidences: list[float] = []
    for image in images:
        image_confidence = net.estimate_pair(replace(image, right=None)).image_confidence
        if image_confidence is None:
            raise InputError(
                "these weights have no generator with a confidence of its own; take those of "
                "'depthpose depth train select'"
            )
        confidences.append(image_confidence)
    return confidences
