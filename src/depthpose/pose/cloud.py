"""Depth and mask to the partial cloud of one object, and checks that the cloud can be posed."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import project
from depthpose.core.errors import InputError
from depthpose.pose.config import CloudConfig, EstimateConfig
from depthpose.pose.refusals import Refused
from depthpose.pose.types import (
    CloudInput,
    CloudSample,
    ObjectModel,
    ViewInput,
    ViewSample,
)

_MAJORITY = 0.5  # share from which most points or pixels are of a kind
_WIDEST_TANGENT = 1.73  # of 60 degrees: points that a camera sees lie less far off its axis
_STEEPEST_TANGENT = 10.0  # of 84 degrees: no camera sees a point farther off its axis, or behind it
_LEAST_DEPTH_DIAMETERS = 0.05  # least depth of nearly all points that a camera saw
_NEARLY_ALL = 0.95  # share of points that makes nearly all
_SAMPLED_DEPTHS = 10_000  # readings by which the depth of nearly all is measured
_FLAT_DIAMETERS = 0.002  # root mean square below which a cloud has no extent along an axis
_FARTHEST_M = 1e6  # a coordinate beyond this marks a missing reading
OTHER_FRAME = (
    "Or is the cloud not in the camera's frame (x right, y down, z forward)? A robot's base and "
    "the world have z up: give it as the camera saw it"
)
"""What may be wrong with a cloud that fits no pose: its origin is not where the camera was."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectCloud:
    """A cloud of one object that can be posed."""

    name: str  #: that of the input
    cloud_m: Float[Tensor, "n 3"]  #: all usable points, without flying pixels
    view: ViewInput | None  #: the depth image that shows the cloud; None of a cloud alone
    #: the points are exactly the object's: those which a pose does not explain contradict it
    is_masked: bool


def prepare_cloud(
    pose_input: CloudInput | ViewInput,
    model: ObjectModel,
    cloud_config: CloudConfig,
    config: EstimateConfig,
) -> ObjectCloud:
    """Lift an input to the usable points of its object.

    Args:
        pose_input: a cloud, or a depth image with a mask.
        model: of the object.
        cloud_config: the fewest points of a cloud, and how far off flying pixels are.
        config: how many points of a larger cloud are taken.

    Raises:
        InputError: mask and depth differ in size.
        Refused: it cannot be posed, by its size, place or shape.
    """
    # The readings that may be the object's.
    is_masked = True
    if isinstance(pose_input, ViewInput):
        view = pose_input
        require_same_size(view.mask, view.depth_m)
        points_m = cloud_from_depth(view.depth_m, view.foreground, view.K).float()
    else:
        view = pose_input.view
        is_masked = pose_input.is_masked
        points_m = pose_input.points_m.float()
    readings_m = take_evenly(points_m[is_reading(points_m)], config.max_cloud_points)
    if len(readings_m) == 0:
        raise Refused("too few points", _explain_emptiness(pose_input))

    # Those near their median that a camera can see. In a wrong unit nearly all seem to be flying
    # pixels, and few readings do not say whether the unit or the frame is another.
    cloud_m = _drop_flying_pixels(readings_m, model.diameter_m, cloud_config)
    cloud_m = cloud_m[_is_before_camera(cloud_m)]
    require_points(readings_m, cloud_config)
    _require_frame_and_unit(pose_input, readings_m, cloud_m, model)
    require_points(cloud_m, cloud_config)
    if view is not None:
        _require_in_view(cloud_m, view)
    _require_extent(pose_input, cloud_m, model)
    return ObjectCloud(name=pose_input.name, cloud_m=cloud_m, view=view, is_masked=is_masked)


def _require_in_view(cloud_m: Float[Tensor, "m 3"], view: ViewInput) -> None:
    """Raise :class:`Refused` where most points of a cloud lie outside its own depth image."""
    height, width = view.depth_m.shape
    column, row = project(cloud_m.double(), view.K.double()).round().unbind(-1)
    is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    outside_share = 1 - float(is_inside.double().mean())
    if outside_share > _MAJORITY:
        raise Refused(
            "unusable input",
            f"{outside_share:.0%} of the points lie outside the {width}x{height} depth image that "
            "they are given with; give the image and the camera that they were measured by",
        )


def _explain_emptiness(pose_input: CloudInput | ViewInput) -> str:
    """Explain why an input has no reading at all."""
    if isinstance(pose_input, ViewInput):
        return why_nothing_seen(pose_input)
    if len(pose_input.points_m) == 0:
        return "the cloud is empty"
    if bool((pose_input.points_m == 0).all(-1).any()):
        return "the cloud is (0, 0, 0), no reading, in every point"
    return "the cloud has no point with finite coordinates"


def why_nothing_seen(view: ViewInput) -> str:
    """Explain why no masked pixel of a view has a depth."""
    masked = int(view.mask.sum())
    if masked == 0 and view.is_region:
        return "nothing of it is detected in this image: there is no box or mask of it"
    if masked == 0:
        return "the mask is empty: no pixel of it is the object"
    if not bool((view.depth_m > 0).any()):
        return "the depth image has no reading at all: every pixel is 0 or NaN"
    if view.background is not None and bool((view.mask & view.background.is_seen).any()):
        return "in the mask every reading lies on the background: nothing lies before it there"
    return f"none of the {masked} masked pixels has a depth reading"


def _require_extent(
    pose_input: CloudInput | ViewInput, cloud_m: Float[Tensor, "m 3"], model: ObjectModel
) -> None:
    """Raise :class:`Refused` where a cloud has no extent along an axis."""
    # A plane or a line can slide within itself: in how many directions has the cloud no extent?
    centred = cloud_m.double() - cloud_m.double().mean(0)
    extent_m = torch.linalg.eigvalsh(centred.T @ centred / len(centred)).clamp(min=0).sqrt()
    flat_axes = int((extent_m < _FLAT_DIAMETERS * model.diameter_m).sum())
    if flat_axes == 0:
        return
    shape = {1: "in a plane", 2: "on a line", 3: "in one place"}[flat_axes]
    reason = (
        f"the points lie {shape}, so that motions along it change nothing that is seen; look from "
        "a side that shows more of the object"
    )
    if isinstance(pose_input, ViewInput) and flat_axes == 1:
        reason += ", or give the mask of this image: this one may lie on the background"
    raise Refused("not observable", reason)


def _require_frame_and_unit(
    pose_input: CloudInput | ViewInput,
    readings_m: Float[Tensor, "n 3"],
    cloud_m: Float[Tensor, "m 3"],
    model: ObjectModel,
) -> None:
    """Raise :class:`Refused` where a cloud is in another frame or unit than camera and model.

    ``readings_m`` are all readings in the mask, ``cloud_m`` those that are used.
    """
    # The size is measured without flying pixels, if those are few.
    has_few_flying = len(cloud_m) > _MAJORITY * len(readings_m)
    size_advice = advise_unit(model.diameter_m, cloud_m if has_few_flying else readings_m)

    # A camera sees only points before it: a cloud about the origin is in another frame.
    is_about_origin = float(readings_m.median(0).values.norm()) < model.diameter_m / 2
    depth_m = take_evenly(readings_m[:, 2], _SAMPLED_DEPTHS)
    nearest_m = float(depth_m.quantile(0.05))  # 1 - _NEARLY_ALL
    is_centred = is_about_origin and nearest_m < _LEAST_DEPTH_DIAMETERS * model.diameter_m
    if isinstance(pose_input, CloudInput) and is_centred and size_advice is None:
        raise Refused(
            "unusable input",
            "the cloud lies about the origin, where the camera is: it was centred, or is in "
            "the frame of the model; give it in the camera's frame, as it was seen",
        )
    axes_advice = advise_frame(readings_m)
    if axes_advice is not None:
        raise Refused("unusable input", axes_advice)

    # Some background in the mask makes a cloud larger, and does not mean another unit.
    if size_advice is not None and not (has_few_flying and size_advice.is_cloud_larger):
        hint = _hint_at_size_mistakes(pose_input.mask) if isinstance(pose_input, ViewInput) else ""
        raise Refused(
            "unusable input",
            f"{size_advice.message} (the object is {model.diameter_m:.3g} m long{hint})",
        )
    unseen_share = float((~_is_before_camera(readings_m)).float().mean())
    if unseen_share > 1 - _NEARLY_ALL:
        raise Refused(
            "unusable input",
            f"{unseen_share:.0%} of the points lie behind the camera or beside it, where it sees "
            f"none: are they another sensor's? {OTHER_FRAME}",
        )


def _hint_at_size_mistakes(mask: Bool[Tensor, "h w"]) -> str:
    """Name the mistakes with a mask, K or depth unit that change the size of a cloud."""
    share = float(mask.float().mean())
    border = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    if share > _MAJORITY and float(border.float().mean()) > _MAJORITY:
        return f"; the mask covers {share:.0%} of the image and its border: is it inverted?"
    return (
        "; a mask of more than it, or a K of another image size, changes the size of its "
        "cloud too, and so does another depth unit: 0.001 m of most sensors, 0.0002 m of "
        "TUM RGB-D, 1/256 m of KITTI"
    )


def cloud_from_depth(
    depth_m: Float[Tensor, "h w"],
    mask: Bool[Tensor, "mask_h mask_w"],
    K: Float[Tensor, "3 3"],
    diameter_m: float | None = None,
    config: CloudConfig | None = None,
) -> Float[Tensor, "n 3"]:
    """Lift the masked pixels that have a depth to points of the camera frame.

    Args:
        depth_m: along the optical axis; NaN where there is no reading.
        mask: the object's pixels.
        K: intrinsic matrix of the depth image.
        diameter_m: of the object, to drop flying pixels; None: all points are kept.
        config: how many diameters from their median points are kept.

    Raises:
        InputError: mask and depth differ in size.
    """
    require_same_size(mask, depth_m)
    is_read = mask & torch.isfinite(depth_m) & (depth_m > 0)

    # depth * K^-1 (u, v, 1), as ``back_project`` computes it of a whole image.
    v, u = is_read.nonzero(as_tuple=True)
    (fx, skew, cx), (_, fy, cy), _ = K.tolist()
    y = (v.to(depth_m) - cy) / fy
    x = (u.to(depth_m) - cx - skew * y) / fx
    points_m = torch.stack([x, y, torch.ones_like(x)], -1) * depth_m[is_read][:, None]
    if diameter_m is None or len(points_m) == 0:
        return points_m
    return _drop_flying_pixels(points_m, diameter_m, config or CloudConfig())


def _drop_flying_pixels(
    points_m: Float[Tensor, "n 3"], diameter_m: float, config: CloudConfig
) -> Float[Tensor, "m 3"]:
    """Drop the points far from their median: background at the mask's border. One is needed."""
    offset_m = (points_m - points_m.median(0).values).norm(dim=-1)
    return points_m[~(offset_m > diameter_m * config.max_offset_diameters)]


def lift_sample(view: ViewSample, diameter_m: float, config: CloudConfig) -> CloudSample:
    """Lift a view of an object, of diameter ``diameter_m``, to its cloud without flying pixels."""
    pose_input = view.input
    points_m = cloud_from_depth(
        pose_input.depth_m, pose_input.mask, pose_input.K, diameter_m, config
    )
    cloud = CloudInput(name=pose_input.name, points_m=points_m, object=pose_input.object)
    return CloudSample(input=cloud, truth=view.truth)


def require_same_size(mask: Bool[Tensor, "mask_h mask_w"], depth_m: Float[Tensor, "h w"]) -> None:
    """Raise an :class:`InputError` where a mask and a depth image differ in size."""
    if mask.shape != depth_m.shape:
        raise InputError(
            f"the mask is {mask.shape[1]}x{mask.shape[0]}, but the depth image is "
            f"{depth_m.shape[1]}x{depth_m.shape[0]}; give the mask of this very image"
        )


def grow_mask(mask: Bool[Tensor, "h w"], grow_px: int) -> Bool[Tensor, "h w"]:
    """Dilate a mask by a square of ``2 grow_px + 1`` pixels; erode it where that is negative."""
    # An eroded mask is what the dilated complement leaves.
    grown = mask if grow_px >= 0 else ~mask
    # Along each axis the union of the mask moved by every number of pixels, to both sides.
    for axis in (0, 1):
        source = grown
        grown = source.clone()
        length = source.shape[axis]
        for moved_px in range(1, min(abs(grow_px), length - 1) + 1):
            kept = length - moved_px
            grown.narrow(axis, 0, kept).logical_or_(source.narrow(axis, moved_px, kept))
            grown.narrow(axis, moved_px, kept).logical_or_(source.narrow(axis, 0, kept))
    return grown if grow_px >= 0 else ~grown


def _is_before_camera(points_m: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Mark the points of the camera frame that a camera can see: before it, and not far aside."""
    aside_m = points_m[:, :2].abs().amax(-1)
    return points_m[:, 2] > aside_m / _STEEPEST_TANGENT


def is_reading(points_m: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Mark the points of a cloud that were measured.

    Drivers write NaN, infinity, the largest float or (0, 0, 0) where there is no return.
    """
    return (points_m.abs() < _FARTHEST_M).all(-1) & (points_m != 0).any(-1)


def require_points(points_m: Float[Tensor, "n 3"], config: CloudConfig | None = None) -> None:
    """Raise :class:`Refused` where a cloud has fewer than ``config.min_points`` points."""
    config = CloudConfig() if config is None else config
    if len(points_m) < config.min_points:
        raise Refused(
            "too few points",
            f"the cloud has {len(points_m)} points, fewer than the {config.min_points} that a pose "
            "takes: is the mask empty, or the depth missing there?",
        )


_UNITS_PER_METRE = {"mm": 1000.0, "cm": 100.0, "inches": 39.37}
_MM_PER_UNIT = {"cm": 10.0, "inches": 25.4}

# Size of a cloud over the diameter of its model.
_LARGEST_RATIO = 1.5  # a cloud is part of its object; noise and grown masks make it somewhat larger
_SMALLEST_RATIO = 0.1  # a smaller part of an object cannot be posed anyway
_LIKELY_RATIO = 0.3  # least corrected ratio at which a unit of a too large cloud is suggested
_USUAL_RATIO = 0.7  # of a usual view of an object
_LOG_RATIO_TIE = 0.3  # difference of log ratios up to which a unit fits nearly as well as the best


class UnitAdvice(NamedTuple):
    """Advice that a model and a cloud of it seem to be in different units."""

    is_cloud_larger: bool  #: than the model; else it is too small
    message: str  #: how much larger or smaller it is, and the likely units


def advise_unit(model_diameter_m: float, points_m: Float[Tensor, "n 3"]) -> UnitAdvice | None:
    """Advise where a model and a cloud seem to be in different units; None where their sizes agree.

    Args:
        model_diameter_m: of the model, in what was taken for metres.
        points_m: points of the object, in what was taken for metres.
    """
    size_m = _measure_size(points_m)
    if size_m <= 0:
        return None
    ratio = size_m / model_diameter_m
    if _SMALLEST_RATIO <= ratio <= _LARGEST_RATIO:
        return None

    # Is the larger one in a smaller unit than metres?
    is_cloud_larger = ratio > 1
    larger, smaller = ("cloud", "model") if is_cloud_larger else ("model", "cloud")
    # A cloud 5x too large more likely comes from an oversized mask than from a small visible part
    # in inches, so a larger visible share is required.
    min_corrected_ratio = _LIKELY_RATIO if is_cloud_larger else _SMALLEST_RATIO
    units = _name_likely_units(ratio, min_corrected_ratio)
    if units:
        times = max(ratio, 1 / ratio)
        message = f"your {larger} is {times:.0f} times larger than the {smaller}: is it in {units}?"
        return UnitAdvice(is_cloud_larger, message)

    # Both may be in wrong units: the larger in mm, the smaller in cm or inches.
    likely: list[str] = []
    for unit, factor in _MM_PER_UNIT.items():
        corrected = ratio / factor if is_cloud_larger else ratio * factor
        if _LIKELY_RATIO <= corrected <= _LARGEST_RATIO:
            likely.append(unit)
    other_unit = f" Or is the {smaller} in {' or '.join(likely)}?" if likely else ""
    relation = "larger" if is_cloud_larger else "smaller"
    message = (
        f"the cloud is {max(ratio, 1 / ratio):.1f} times {relation} than the model: is this the "
        f"right object, and does the mask fit it?{other_unit}"
    )
    return UnitAdvice(is_cloud_larger, message)


def _measure_size(points_m: Float[Tensor, "n 3"]) -> float:
    """Measure the size of a cloud [m]; 0 for fewer than two points.

    It is twice the distance from the median within which 95 % of the points lie: a few flying
    pixels do not change it.
    """
    if len(points_m) < 2:
        return 0.0
    distance_m = (points_m - points_m.median(0).values).norm(dim=-1)
    rank = 1 + int(_NEARLY_ALL * (len(distance_m) - 1))
    return 2 * float(distance_m.kthvalue(rank).values)


def _name_likely_units(ratio: float, min_corrected_ratio: float) -> str:
    """Name the units that the larger of cloud and model is likely in, where metres were assumed.

    Args:
        ratio: size of the cloud over the diameter of the model.
        min_corrected_ratio: least ratio in the right unit.

    Returns:
        The units, joined by "or"; empty where none explains the ratio.
    """
    log_error_of_unit: dict[str, float] = {}
    for unit, factor in _UNITS_PER_METRE.items():
        corrected = ratio / factor if ratio > 1 else ratio * factor
        if min_corrected_ratio <= corrected <= _LARGEST_RATIO:
            log_error_of_unit[unit] = abs(math.log(corrected / _USUAL_RATIO))
    best = min(log_error_of_unit.values(), default=0.0)
    return " or ".join(
        unit for unit, error in log_error_of_unit.items() if error < best + _LOG_RATIO_TIE
    )


def advise_frame(points_m: Float[Tensor, "n 3"]) -> str | None:
    """Advise how to rotate a cloud that is not in the camera frame (x right, y down, z forward).

    The points that a camera sees lie before it, less than 60 degrees off its axis. None where they
    do.
    """
    # Does x or y point forward, instead of z?
    across_m = points_m[:, :2].median(0).values.abs()
    forward_m = points_m[:, 2].median().abs()
    if float(across_m.max()) > _WIDEST_TANGENT * float(forward_m):
        axis = "xy"[int(across_m.argmax())]
        return (
            f"the points lie along {axis}, more than 60 degrees off z: does {axis} point forward, "
            "as x does in LiDAR and robot frames? Turn the cloud to x right, y down, z forward: of "
            "(x forward, y left, z up) that is (-y, -z, x)"
        )

    # Or does z point backward?
    behind = float((points_m[:, 2] <= 0).float().mean())
    if behind <= _MAJORITY:
        return None
    return (
        f"{behind:.0%} of the points lie behind the camera (z <= 0): is its z backward or in "
        "another frame? Turn the cloud to x right, y down, z forward: of OpenGL's (x right, y up, "
        "z backward) that is (x, -y, -z)"
    )
