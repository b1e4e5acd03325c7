"""Protocols of the evaluation, and truth and prediction of a frame as a protocol compares them.

A protocol fixes the truth, the pixels that count and how the prediction is prepared. Numbers of
two protocols are not comparable.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError, Notice, nearest_name
from depthpose.core.files import read_image
from depthpose.depth import disparity
from depthpose.depth import predictions as files
from depthpose.depth.datasets import Dataset, Frame, has_lidar, lidar_truth
from depthpose.depth.metrics import SMALLEST_DEPTH_M, garg_crop, view_errors
from depthpose.depth.types import Map

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


def has_truth(frame: Frame, rule: Protocol) -> bool:
    """Whether a frame has files of the truth that a protocol needs; none is read."""
    match rule.truth:
        case "disparity":
            return frame.disparity is not None
        case "depth":
            return frame.depth is not None
        case _:
            return has_lidar(frame, rule.truth)


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedFrame:
    """A frame's truth and prediction, at the size of the image."""

    frame: Frame
    truth: Map  # depth [m] or disparity [px], as the protocol says
    disparity_px: Map
    depth_m: Map | None  # where depth was predicted and no disparity
    confidence: Map | None
    rig: StereoRig | None
    view_metrics: dict[str, float]  # metrics of the synthesised right view


def clamped_depth(disparity_px: Map, rig: StereoRig, cap_m: float) -> Map:
    """Convert disparity to depth between 0.001 m and a cap, as the published Eigen script does.

    NaN (no prediction) stays NaN; zero and negative disparity become the smallest depth, as there.
    """
    depth_m = disparity.depth_from_disparity(disparity_px, rig).nan_to_num(0.0)
    clamped_m = depth_m.clamp(SMALLEST_DEPTH_M, cap_m)
    return torch.where(torch.isnan(disparity_px), torch.nan, clamped_m)


def prepare_frame(
    dataset: Dataset, index: int, predictions: Path, rule: Protocol
) -> PreparedFrame | str:
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
        truth = lidar_truth(frame, rule.truth)
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
    advice = disparity.find_unit_mistake(
        predicted_px + cx_difference_px, true_px + cx_difference_px
    )
    if advice is not None:
        raise InputError(f"{predictions / frame.name}: {advice}")

    confidence = files.read_part(predictions, frame.name, "confidence.npy")
    if confidence is not None and confidence.shape != truth.shape:
        confidence = disparity.resize_map(confidence, height, width)
    return PreparedFrame(
        frame=frame,
        truth=truth,
        disparity_px=predicted_px,
        depth_m=depth_m if depth_m is not None and depth_m.shape == truth.shape else None,
        confidence=confidence,
        rig=rig,
        view_metrics=_measure_view(frame, predictions),
    )


def _measure_view(frame: Frame, predictions: Path) -> dict[str, float]:
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
    stretched_px = disparity.resize_map(stored_px, height, width) * (width / columns)
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


def apply_protocol(prepared: PreparedFrame, rule: Protocol, cap_m: float | None) -> tuple[Map, Map]:
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
