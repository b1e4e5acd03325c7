"""Named protocols to rows: predictions are files, metrics read files.

A protocol fixes the truth, the pixels that count and how the prediction is prepared. Numbers of
two protocols do not compare; every row carries its protocol's name.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import read_image
from depthpose.depth.disparity import (
    depth_from_disparity,
    disparity_advice,
    disparity_from_depth,
    resize_disparity,
)
from depthpose.depth.kitti import Dataset, Frame, has_lidar, lidar_truth
from depthpose.depth.kitti import read_disparity as read_truth_disparity
from depthpose.depth.metrics import (
    depth_errors,
    disparity_errors,
    error_by_decile,
    garg_crop,
    score_confidence,
    view_errors,
)
from depthpose.depth.predictions import (
    has_prediction,
    read_confidence,
    read_disparity,
    read_drawn_view,
)

SMALLEST_DEPTH_M = 1e-3


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """How a prediction is held against the truth.

    Attributes:
        summary: one line for people.
        truth: ``velodyne_x`` and ``camera_z`` project one LiDAR scan; ``depth`` and ``disparity``
            read the truth that the dataset ships.
        with_crop_and_cap: only truth inside the crop of Garg et al. and nearer than the cap counts.
    """

    summary: str
    truth: Literal["velodyne_x", "camera_z", "depth", "disparity"]
    with_crop_and_cap: bool


PROTOCOLS = {
    "eigen-raw": Protocol(
        summary="one LiDAR scan, depth = LiDAR x, Garg crop: monodepth's, and the thesis's",
        truth="velodyne_x",
        with_crop_and_cap=True,
    ),
    "eigen-raw-camera": Protocol(
        summary="the same with depth = camera z", truth="camera_z", with_crop_and_cap=True
    ),
    "eigen-improved": Protocol(
        summary="annotated depth maps, no crop: monodepth2's",
        truth="depth",
        with_crop_and_cap=False,
    ),
    "eigen-improved-garg": Protocol(
        summary="annotated depth maps, Garg crop: BTS's, AdaBins'",
        truth="depth",
        with_crop_and_cap=True,
    ),
    "kitti-2015": Protocol(
        summary="disparity: EPE and D1 (> 3 px and > 5 %), all pixels and those both views see",
        truth="disparity",
        with_crop_and_cap=False,
    ),
}


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What evaluating one set of predictions gave.

    Attributes:
        rows: one a cap (or a set of pixels), names to values, ready for a report.
        per_frame: the same for each frame.
        deciles: mean error of the least sure tenth of each frame's pixels (1) to the surest (10),
            for predictions with a confidence.
        skipped: frames that do not count, each with the reason.
    """

    rows: list[dict[str, Any]]
    per_frame: list[dict[str, Any]]
    deciles: list[dict[str, Any]]
    skipped: dict[str, str]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Prepared:
    """A frame's truth and prediction, brought to the size of the image."""

    frame: Frame
    truth: Float[Tensor, "h w"]
    disparity_px: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"] | None
    camera: Camera | None
    view: dict[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Measured:
    """One frame's row of numbers, and its error by decile of confidence."""

    row: dict[str, Any]
    deciles: Float[Tensor, "10"] | None


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
    rule = find_protocol(protocol)
    measured: list[_Measured] = []
    skipped: dict[str, str] = {}
    for index in progress(range(len(dataset))):
        prepared = _prepare(dataset, index, predictions, rule)
        if isinstance(prepared, str):
            skipped[dataset.frames[index].name] = prepared
            continue
        measured += _measure(prepared, rule, caps_m)
    if not measured:
        raise InputError(
            f"{dataset.name}: none of its {len(dataset)} frames has the truth that protocol "
            f"{protocol!r} needs ({rule.truth}). Choose another protocol or folder."
        )
    stamp = {"protocol": protocol, "dataset": dataset.name}
    per_frame = [item.row for item in measured]
    error_name = "epe_px" if rule.truth == "disparity" else "abs_rel"
    return Evaluation(
        rows=[stamp | row for row in _mean_rows(per_frame)],
        per_frame=[stamp | row for row in per_frame],
        deciles=[stamp | row for row in _decile_rows(measured, error_name)],
        skipped=skipped,
    )


def find_protocol(name: str) -> Protocol:
    """Give a protocol by name.

    Raises:
        InputError: there is none; the nearest name is said.
    """
    if name not in PROTOCOLS:
        raise InputError(f"protocol {name!r}: {nearest_name(name, PROTOCOLS)}")
    return PROTOCOLS[name]


def has_truth(frame: Frame, rule: Protocol) -> bool:
    """Whether a frame has the truth that a protocol needs, told by its files alone."""
    match rule.truth:
        case "disparity":
            return frame.disparity is not None
        case "depth":
            return frame.depth is not None
        case _:
            return has_lidar(frame, rule.truth)


def _prepare(dataset: Dataset, index: int, predictions: Path, rule: Protocol) -> _Prepared | str:
    """Read truth and prediction of a frame, or say why it does not count."""
    frame = dataset.frames[index]
    if not has_truth(frame, rule):
        return f"no truth of the kind {rule.truth}"
    if frame.right is None and not has_prediction(predictions, frame.name):
        return "no right view to match, and no prediction"
    truth = _truth(dataset, index, rule)
    camera = dataset.read_rig(index)
    if rule.truth != "disparity" and not isinstance(camera, StereoRig):
        raise InputError(f"{frame.name}: no calibration, so its disparity cannot become metres.")
    height, width = truth.shape
    predicted_px = resize_disparity(read_disparity(predictions, frame.name, camera), height, width)
    true_px = truth
    if rule.truth != "disparity" and isinstance(camera, StereoRig):
        true_px = disparity_from_depth(truth, camera)
    if (advice := disparity_advice(predicted_px, true_px)) is not None:
        raise InputError(f"{predictions / frame.name}: {advice}")
    confidence = read_confidence(predictions, frame.name)
    if confidence is not None and confidence.shape != truth.shape:
        confidence = resize_disparity(confidence, height, width) * (confidence.shape[1] / width)
    return _Prepared(
        frame=frame,
        truth=truth,
        disparity_px=predicted_px,
        confidence=confidence,
        camera=camera,
        view=_measure_view(frame, predictions),
    )


def _measure_view(frame: Frame, predictions: Path) -> dict[str, float]:
    """Compare the drawn right view with the real one, where there are both."""
    drawn = read_drawn_view(predictions, frame.name)
    if drawn is None or frame.right is None:
        return {}
    real = read_image(frame.right)
    if real.shape != drawn.shape:
        raise InputError(
            f"{predictions}: the drawn view of {frame.name} is {drawn.shape[2]}x{drawn.shape[1]}, "
            f"but its right image is {real.shape[2]}x{real.shape[1]}; predict it again"
        )
    return asdict(view_errors(drawn, real))


def _truth(dataset: Dataset, index: int, rule: Protocol) -> Float[Tensor, "h w"]:
    if rule.truth in ("velodyne_x", "camera_z"):
        return lidar_truth(dataset.frames[index], rule.truth)
    shipped = dataset.read_truth(index)
    truth = shipped.disparity_px if rule.truth == "disparity" else shipped.depth_m
    assert truth is not None  # has_truth said so
    return truth


def _measure(prepared: _Prepared, rule: Protocol, caps_m: Sequence[float]) -> list[_Measured]:
    if rule.truth == "disparity":
        return [_measure_disparity(prepared)]
    return [_measure_depth(prepared, rule, cap_m) for cap_m in caps_m]


def _measure_depth(prepared: _Prepared, rule: Protocol, cap_m: float) -> _Measured:
    assert isinstance(prepared.camera, StereoRig)
    predicted_m = clamped_depth(prepared.disparity_px, prepared.camera, cap_m)
    counts = prepared.truth > (SMALLEST_DEPTH_M if rule.with_crop_and_cap else 0.0)
    if rule.with_crop_and_cap:
        counts &= (prepared.truth < cap_m) & garg_crop(*prepared.truth.shape)
    mask = counts & torch.isfinite(predicted_m)
    predicted_m, true_m = predicted_m[mask], prepared.truth[mask]
    row = {"frame": prepared.frame.name, "cap_m": cap_m, "pixels": int(mask.sum())}
    row["coverage"] = float(mask.sum() / counts.sum())
    row |= asdict(depth_errors(predicted_m, true_m)) | prepared.view
    relative = (predicted_m - true_m).abs() / true_m
    return _score(row, relative, prepared.confidence, mask)


def clamped_depth(
    disparity_px: Float[Tensor, "h w"], rig: StereoRig, cap_m: float
) -> Float[Tensor, "h w"]:
    """Turn disparity into depth as the published script does: infinity to 0, then the clamp.

    NaN (no prediction) stays NaN; zero and negative disparity become the smallest depth, as there.
    """
    depth_m = depth_from_disparity(disparity_px, rig).nan_to_num(0.0)
    clamped_m = depth_m.clamp(SMALLEST_DEPTH_M, cap_m)
    return torch.where(torch.isnan(disparity_px), torch.nan, clamped_m)


def _measure_disparity(prepared: _Prepared) -> _Measured:
    counts = torch.isfinite(prepared.truth)
    mask = counts & torch.isfinite(prepared.disparity_px)
    predicted_px, true_px = prepared.disparity_px[mask], prepared.truth[mask]
    row: dict[str, Any] = {"frame": prepared.frame.name, "pixels": int(mask.sum())}
    row["coverage"] = float(mask.sum() / counts.sum())
    row |= asdict(disparity_errors(predicted_px, true_px))
    if prepared.frame.disparity_noc is not None:
        seen_px = read_truth_disparity(prepared.frame.disparity_noc)
        seen = torch.isfinite(seen_px) & torch.isfinite(prepared.disparity_px)
        errors = disparity_errors(prepared.disparity_px[seen], seen_px[seen])
        row |= {"epe_noc_px": errors.epe_px, "d1_noc": errors.d1_all}
    row |= prepared.view
    return _score(row, (predicted_px - true_px).abs(), prepared.confidence, mask)


def _score(
    row: dict[str, Any],
    error: Float[Tensor, " n"],
    confidence: Float[Tensor, "h w"] | None,
    mask: Bool[Tensor, "h w"],
) -> _Measured:
    """Add what the confidence is worth, where there is one."""
    if confidence is None:
        return _Measured(row=row, deciles=None)
    score = asdict(score_confidence(error, confidence[mask]))
    return _Measured(row=row | score, deciles=error_by_decile(error, confidence[mask]))


def _mean_rows(per_frame: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row a cap; each frame counts the same."""
    rows: list[dict[str, Any]] = []
    for cap in _caps(per_frame):
        of_cap = [row for row in per_frame if row.get("cap_m") == cap]
        row: dict[str, Any] = {} if cap is None else {"cap_m": cap}
        row |= {"frames": len(of_cap), "pixels": sum(item["pixels"] for item in of_cap)}
        names = [n for n in of_cap[0] if n not in ("frame", "cap_m", "pixels")]
        names = [n for n in names if all(n in item for item in of_cap)]
        rows.append(row | {n: sum(item[n] for item in of_cap) / len(of_cap) for n in names})
    return rows


def _decile_rows(measured: list[_Measured], error_name: str) -> list[dict[str, Any]]:
    """Ten rows a cap; each frame counts the same."""
    rows: list[dict[str, Any]] = []
    for cap in _caps([item.row for item in measured]):
        of_cap = [item.deciles for item in measured
                  if item.row.get("cap_m") == cap and item.deciles is not None]  # fmt: skip
        if not of_cap:
            continue
        first = {} if cap is None else {"cap_m": cap}
        errors = torch.stack(of_cap).nanmean(0).tolist()
        rows += [
            first | {"frames": len(of_cap), "confidence_decile": k, error_name: error}
            for k, error in enumerate(errors, 1)
        ]
    return rows


def _caps(rows: list[dict[str, Any]]) -> list[float | None]:
    return list(dict.fromkeys(row.get("cap_m") for row in rows))
