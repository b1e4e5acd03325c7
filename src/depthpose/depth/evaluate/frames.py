"""The named protocols, and one frame: truth and prediction of one size, ready to be compared."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import read_image
from depthpose.depth.datasets import Dataset, Frame, has_lidar, lidar_truth
from depthpose.depth.disparity import (
    depth_from_disparity,
    disparity_advice,
    disparity_from_depth,
    resize_disparity,
)
from depthpose.depth.metrics import SMALLEST_DEPTH_M, garg_crop, view_errors
from depthpose.depth.predictions import (
    has_disparity,
    has_prediction,
    read_confidence,
    read_depth,
    read_disparity,
    read_drawn_view,
    read_sky,
)
from depthpose.depth.types import DepthEstimate

NO_PREDICTION = "no right view to match, and no prediction"


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """How a prediction is compared with the truth.

    In all protocols of depth truth counts between 0.001 m and the cap, and predictions are clamped
    to that range.

    Attributes:
        summary: one line for people.
        truth: ``velodyne_x`` and ``camera_z`` project one LiDAR scan; ``depth`` and ``disparity``
            read the truth that the dataset ships.
        with_crop: only truth inside the crop of Garg et al. counts.
    """

    summary: str
    truth: Literal["velodyne_x", "camera_z", "depth", "disparity"]
    with_crop: bool


PROTOCOLS = {
    "eigen-raw": Protocol(
        summary="one LiDAR scan, depth = LiDAR x, Garg crop: monodepth's, and the thesis's",
        truth="velodyne_x",
        with_crop=True,
    ),
    "eigen-raw-camera": Protocol(
        summary="the same with depth = camera z", truth="camera_z", with_crop=True
    ),
    "eigen-improved": Protocol(
        summary="annotated depth maps, no crop: monodepth2's", truth="depth", with_crop=False
    ),
    "eigen-improved-garg": Protocol(
        summary="annotated depth maps, Garg crop: BTS's, AdaBins'", truth="depth", with_crop=True
    ),
    "kitti-2015": Protocol(
        summary="disparity: EPE and D1 (> 3 px and > 5 %), all pixels and those both views see",
        truth="disparity",
        with_crop=False,
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """A frame's truth and prediction, brought to the size of the image.

    What was predicted as depth alone is compared as it is, by ``depth_m``.
    """

    frame: Frame
    truth: Float[Tensor, "h w"]
    disparity_px: Float[Tensor, "h w"]
    depth_m: Float[Tensor, "h w"] | None
    confidence: Float[Tensor, "h w"] | None
    camera: Camera | None
    view: dict[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """The two maps that a frame's numbers are of: metres, or pixels of disparity.

    Attributes:
        predicted: as the protocol prepares it; NaN where there is no prediction.
        truth: NaN where it does not count.
    """

    predicted: Float[Tensor, "h w"]
    truth: Float[Tensor, "h w"]


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameResult:
    """The maps of a frame that show where its error is.

    Attributes:
        estimate: at the size of the image.
        error: absolute disparity error [px], or absolute depth error as a share of the truth; NaN
            where nothing is compared.
        true_depth_m: the truth that counts as depth; None where it is a disparity without a rig.
    """

    estimate: DepthEstimate
    error: Float[Tensor, "h w"]
    true_depth_m: Float[Tensor, "h w"] | None


def frame_result(
    dataset: Dataset, index: int, predictions: Path, protocol: str, cap_m: float | None
) -> FrameResult:
    """Read one frame again as :func:`evaluate` measured it.

    Args:
        dataset: as it was measured.
        index: of the frame.
        predictions: the folder.
        protocol: a key of ``PROTOCOLS``.
        cap_m: of the row; None for a protocol of disparity.

    Raises:
        InputError: the frame does not count, or a file is damaged.
    """
    rule = find_protocol(protocol)
    prepared = prepare(dataset, index, predictions, rule)
    if isinstance(prepared, str):
        raise InputError(f"{dataset.frames[index].name}: {prepared}; choose a frame that counts")
    rig = prepared.camera if isinstance(prepared.camera, StereoRig) else None
    depth_m = None if rig is None else depth_from_disparity(prepared.disparity_px, rig)
    is_sky = read_sky(predictions, prepared.frame.name)
    if is_sky is not None and depth_m is not None and is_sky.shape == depth_m.shape:
        depth_m = torch.where(is_sky, torch.nan, depth_m)
    if cap_m is None:
        compared = compare_disparity(prepared)
        error = (compared.predicted - compared.truth).abs()
        true_m = None if rig is None else depth_from_disparity(compared.truth, rig)
    else:
        compared = compare_depth(prepared, rule, cap_m)
        error = (compared.predicted - compared.truth).abs() / compared.truth
        true_m = compared.truth
    estimate = DepthEstimate(
        depth_m=depth_m,
        disparity_px=prepared.disparity_px,
        confidence=prepared.confidence,
        right=read_drawn_view(predictions, prepared.frame.name),
        is_sky=is_sky,
    )
    return FrameResult(estimate=estimate, error=error, true_depth_m=true_m)


def compare_depth(prepared: Prepared, rule: Protocol, cap_m: float) -> Compared:
    """Choose the true metres that count, and clamp the predicted ones."""
    assert isinstance(prepared.camera, StereoRig)
    truth = prepared.truth
    counts = (truth > SMALLEST_DEPTH_M) & (truth < cap_m)
    if rule.with_crop:
        counts &= garg_crop(*truth.shape)
    predicted_m = prepared.depth_m
    if predicted_m is None:
        predicted_m = clamped_depth(prepared.disparity_px, prepared.camera, cap_m)
    return Compared(
        predicted=predicted_m.clamp(SMALLEST_DEPTH_M, cap_m),
        truth=torch.where(counts, truth, torch.nan),
    )


def compare_disparity(prepared: Prepared) -> Compared:
    """Take disparity as it is."""
    return Compared(predicted=prepared.disparity_px, truth=prepared.truth)


def clamped_depth(
    disparity_px: Float[Tensor, "h w"], rig: StereoRig, cap_m: float
) -> Float[Tensor, "h w"]:
    """Turn disparity into depth as the published script does: infinity to 0, then the clamp.

    NaN (no prediction) stays NaN; zero and negative disparity become the smallest depth, as there.
    """
    depth_m = depth_from_disparity(disparity_px, rig).nan_to_num(0.0)
    clamped_m = depth_m.clamp(SMALLEST_DEPTH_M, cap_m)
    return torch.where(torch.isnan(disparity_px), torch.nan, clamped_m)


def prepare(dataset: Dataset, index: int, predictions: Path, rule: Protocol) -> Prepared | str:
    """Read truth and prediction of a frame, or say why it does not count."""
    frame = dataset.frames[index]
    if not has_truth(frame, rule):
        return f"no truth of the kind {rule.truth}"
    if frame.right is None and not has_prediction(predictions, frame.name):
        return NO_PREDICTION
    if rule.truth in ("velodyne_x", "camera_z"):
        truth = lidar_truth(frame, rule.truth)
    else:
        shipped = dataset.read_truth(index)
        truth = shipped.disparity_px if rule.truth == "disparity" else shipped.depth_m
    assert truth is not None, "has_truth said so"
    height, width = truth.shape
    camera, depth_m = dataset.read_rig(index), None
    if rule.truth != "disparity" and (camera is None or not has_disparity(predictions, frame.name)):
        depth_m = read_depth(predictions, frame.name)
    if rule.truth != "disparity" and camera is None:
        if depth_m is None:
            raise InputError(
                f"{frame.name}: no calibration of a pair, so its disparity cannot become metres; "
                f"predict depth ({frame.name}.depth_m.npy), or give the frame its baseline"
            )
        K = torch.tensor([[width, 0, 0], [0, width, 0], [0, 0, 1]], dtype=torch.float64)
        camera = StereoRig(width=width, height=height, K=K, baseline_m=1.0)  # depth takes any
    is_stereo = rule.truth == "disparity"
    found_px = read_disparity(predictions, frame.name, camera, with_disparity_png=is_stereo)
    predicted_px = resize_disparity(found_px, height, width)
    true_px = truth
    if rule.truth != "disparity" and isinstance(camera, StereoRig):
        true_px = disparity_from_depth(truth, camera)
    # With principal points apart, the disparity of far points is negative.
    apart_px = camera.cx_right_minus_left_px if isinstance(camera, StereoRig) else 0.0
    if (advice := disparity_advice(predicted_px + apart_px, true_px + apart_px)) is not None:
        raise InputError(f"{predictions / frame.name}: {advice}")
    confidence = read_confidence(predictions, frame.name)
    if confidence is not None and confidence.shape != truth.shape:
        confidence = resize_disparity(confidence, height, width) * (confidence.shape[1] / width)
    return Prepared(
        frame=frame,
        truth=truth,
        disparity_px=predicted_px,
        depth_m=depth_m if depth_m is not None and depth_m.shape == truth.shape else None,
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
    return view_errors(drawn, real)
