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
from depthpose.core.errors import InputError, Notice, suggest_name
from depthpose.core.files import read_image
from depthpose.depth import disparity
from depthpose.depth import predictions as files
from depthpose.depth.datasets import Dataset, FramePaths, has_lidar, read_lidar_depth
from depthpose.depth.metrics import SMALLEST_DEPTH_M, garg_crop, view_errors
from depthpose.depth.types import Map
from depthpose.depth.unit_mistakes import find_unit_mistake

_ASPECT_TOLERANCE = 1.01
"""Ratio of two aspects that are still the same: the sides of a scaled image are rounded to whole
pixels, often to multiples of 32."""
_CROP_ERROR_SHARE = 0.7
"""A map is a crop of the image where its error as a crop is below this share of its error as a
stretched map."""
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
    """Return the protocol of a name.

    Raises:
        InputError: there is none; the error suggests the most similar name.
    """
    if name not in PROTOCOLS:
        raise InputError(f"protocol {name!r}: {suggest_name(name, PROTOCOLS)}")
    return PROTOCOLS[name]


def has_truth(frame: FramePaths, protocol: Protocol) -> bool:
    """Whether a frame has files of the truth that a protocol needs; none is read."""
    match protocol.truth:
        case "disparity":
            return frame.disparity is not None
        case "depth":
            return frame.depth is not None
        case _:
            return has_lidar(frame, protocol.truth)


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedFrame:
    """A frame's truth and prediction, at the size of the truth."""

    frame: FramePaths  #: the frame
    truth: Map  #: depth [m] or disparity [px], as the protocol says
    disparity_px: Map  #: predicted disparity
    depth_m: Map | None  #: predicted depth, where depth was predicted and no disparity
    confidence: Map | None  #: confidence of the prediction; None where it has none
    #: the frame's rig, or where depth was predicted without one, a rig that stands in for it; None
    #: where disparity is compared and the frame has no rig
    rig: StereoRig | None
    view_metrics: dict[str, float]  #: metrics of the synthesised right view, by name


def clamped_depth_from_disparity(disparity_px: Map, rig: StereoRig, cap_m: float) -> Map:
    """Convert disparity to depth, clamped to 0.001 m .. ``cap_m``, as the published Eigen script.

    NaN (no prediction) stays NaN; zero and negative disparity become the smallest depth, as there.
    """
    depth_m = disparity.depth_from_disparity(disparity_px, rig).nan_to_num(0.0)
    clamped_m = depth_m.clamp(SMALLEST_DEPTH_M, cap_m)
    return torch.where(torch.isnan(disparity_px), torch.nan, clamped_m)


def prepare_frame(
    dataset: Dataset,
    index: int,
    predictions: Path,
    protocol: Protocol,
    given_notices: set[str] | None = None,
) -> PreparedFrame | str:
    """Read truth and prediction of a frame, at the size of the truth.

    Args:
        dataset: the frames.
        index: number of the frame.
        predictions: folder of the predictions.
        protocol: says which truth is read.
        given_notices: notices on frames before, which are not given again; those on this frame are
            added. None: there is no frame before.

    Returns:
        Both, or the reason why the frame is not measured.

    Raises:
        InputError: the prediction is missing or damaged, or of another unit, sign or size.
    """
    given_notices = set() if given_notices is None else given_notices
    frame = dataset.frames[index]
    path = predictions / frame.name
    if not has_truth(frame, protocol):
        return f"no truth of the kind {protocol.truth}"
    if frame.right is None and not files.has_prediction(predictions, frame.name):
        return NO_PREDICTION
    truth = _read_truth(dataset, index, protocol)

    # The prediction: depth is compared as it was predicted, or made from the predicted disparity.
    rig = dataset.read_rig(index)
    depth_m = None
    if not protocol.is_disparity:
        has_disparity = files.has_prediction(predictions, frame.name, of_disparity=True)
        if rig is None or not has_disparity:
            depth_m = files.read_depth(predictions, frame.name)
        if rig is None and depth_m is None:
            raise InputError(
                f"{frame.name}: no calibration of a pair, so its disparity cannot become metres; "
                f"predict depth ({frame.name}.depth_m.npy), or give the frame its baseline"
            )
    if rig is None and depth_m is not None:
        # A disparity beside the depth is of another rig than this one.
        rig = _make_stand_in_rig(truth)
        stored_px = files.disparity_of_predicted_depth(depth_m, rig, f"{path}.depth_m.npy")
    else:
        stored_px = files.read_disparity(
            predictions, frame.name, rig, with_disparity_png=protocol.is_disparity
        )
    true_px = truth
    if not protocol.is_disparity and rig is not None:
        true_px = disparity.disparity_from_depth(truth, rig)
    predicted_px = _resize_to_truth(true_px, stored_px, path, given_notices)

    # Refuse mistaken units and signs. Where principal points differ, the disparity of far points is
    # negative; the sum with their difference is not.
    cx_difference_px = 0.0 if rig is None else rig.cx_right_minus_left_px
    mistake = find_unit_mistake(
        predicted_px + cx_difference_px, true_px + cx_difference_px, given_notices
    )
    if mistake is not None:
        raise InputError(f"{path}: {mistake}")

    confidence = files.read_part(predictions, frame.name, "confidence.npy")
    if confidence is not None and confidence.shape != truth.shape:
        confidence = disparity.resize_map(confidence, *truth.shape)
    return PreparedFrame(
        frame=frame,
        truth=truth,
        disparity_px=predicted_px,
        # Depth of another size is compared by way of the resized disparity.
        depth_m=depth_m if depth_m is not None and depth_m.shape == truth.shape else None,
        confidence=confidence,
        rig=rig,
        view_metrics=_measure_view(frame, predictions),
    )


def _read_truth(dataset: Dataset, index: int, protocol: Protocol) -> Map:
    """Read the truth of a frame that has the files of it: depth [m] or disparity [px]."""
    if protocol.truth in ("velodyne_x", "camera_z"):
        return read_lidar_depth(dataset.frames[index], protocol.truth)
    stored_truth = dataset.read_truth(index)
    truth = stored_truth.disparity_px if protocol.is_disparity else stored_truth.depth_m
    assert truth is not None, "has_truth said so"
    return truth


def _make_stand_in_rig(truth_m: Map) -> StereoRig:
    """Make a rig by which depth becomes disparity and back, for a frame that has no rig.

    Any rig will do, for it is undone where depth is compared.
    """
    height, width = truth_m.shape
    K = torch.tensor([[width, 0, 0], [0, width, 0], [0, 0, 1]], dtype=torch.float64)
    return StereoRig(width=width, height=height, K=K, baseline_m=1.0)


def _measure_view(frame: FramePaths, predictions: Path) -> dict[str, float]:
    """Measure the synthesised right view of a frame by the real one; {} where one is missing."""
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


def _resize_to_truth(
    true_px: Map, stored_px: Float[Tensor, "_ _"], path: Path, given_notices: set[str]
) -> Map:
    """Resize a predicted disparity, in pixels of its own width, to the size of the truth.

    A map of another aspect, as of a network that takes squeezed images, is stretched, with a
    notice.

    Args:
        true_px: the true disparity.
        stored_px: the prediction, as it was read.
        path: names the prediction in errors.
        given_notices: as for :func:`prepare_frame`.

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
    if sizes not in given_notices:
        given_notices.add(sizes)
        message = (
            f"{path}: is {sizes}, of another aspect, so it is stretched, which is right for a "
            "squeezed image; of a cropped one, paste the result into a map of the image's size "
            "that is NaN elsewhere"
        )
        warnings.warn(message, Notice, stacklevel=2)
    return stretched_px


def _refuse_crop(
    true_px: Map, stored_px: Float[Tensor, "_ _"], stretched_px: Map, context: str
) -> None:
    """Refuse a predicted disparity that fits a crop of the truth better than all of it.

    Crops are tried in the middle of the columns, and in the middle or at the bottom of the rows, as
    KITTI's of 1216x352.

    Args:
        true_px: the true disparity.
        stored_px: the prediction, as it was read.
        stretched_px: the prediction, stretched to the size of the truth.
        context: begins the error.
    """
    height, width = true_px.shape
    rows, columns = stored_px.shape
    left = (width - columns) // 2
    error_of_top_px: dict[int, float] = {}  # median error by the crop's first row
    for top in ((height - rows) // 2, height - rows):
        window_px = true_px[top : top + rows, left : left + columns]
        error_of_top_px[top] = float((stored_px - window_px).abs().nanmedian())
    best_top = min(error_of_top_px, key=lambda top: error_of_top_px[top])
    crop_error_px = error_of_top_px[best_top]
    stretched_error_px = float((stretched_px - true_px).abs().nanmedian())
    if crop_error_px < _CROP_ERROR_SHARE * stretched_error_px:
        raise InputError(
            f"{context}: it is a part of the image, cut out at column {left}, row "
            f"{best_top} (there the median error is {crop_error_px:.2f} px, stretched to all of it "
            f"{stretched_error_px:.2f} px); put it into a map of {width}x{height}, NaN around it"
        )


def apply_protocol(
    prepared: PreparedFrame, protocol: Protocol, cap_m: float | None
) -> tuple[Map, Map]:
    """Clamp the prediction and mask the truth as the protocol says.

    Args:
        prepared: truth and prediction of the frame.
        protocol: the protocol.
        cap_m: depth beyond which truth does not count; None for disparity.

    Returns:
        The prediction, NaN where there is none; and the truth, NaN where there is none or it does
        not count. Both are disparity [px] or depth [m], as the protocol compares.
    """
    truth = prepared.truth
    if protocol.is_disparity:
        return prepared.disparity_px, truth
    assert cap_m is not None, "depth is compared up to a cap"
    is_counted = (truth > SMALLEST_DEPTH_M) & (truth < cap_m)
    if protocol.with_crop:
        is_counted &= garg_crop(*truth.shape)
    predicted_m = prepared.depth_m
    if predicted_m is None:
        assert prepared.rig is not None
        predicted_m = clamped_depth_from_disparity(prepared.disparity_px, prepared.rig, cap_m)
    clamped_m = predicted_m.clamp(SMALLEST_DEPTH_M, cap_m)
    return clamped_m, torch.where(is_counted, truth, torch.nan)
