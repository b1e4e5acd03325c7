"""Depth and mask to the partial cloud of one object, its checks, and the grid of a network."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float64, Int64
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError
from depthpose.pose.config import CloudConfig, EstimateConfig
from depthpose.pose.types import (
    CloudInput,
    CloudSample,
    ObjectModel,
    Refusal,
    ViewInput,
    ViewSample,
)

_LARGEST_CELL = 2**20  # cells of a grid along an axis, at most
_NEIGHBOURS = 20  # to which the plane at a point is fitted
_MAJORITY = 0.5
_WIDEST_TANGENT = 1.73  # points that a camera sees lie less than 60 degrees off its axis
_BEFORE_CAMERA_DIAMETERS = 0.05  # nearly all points that a camera saw lie farther before it
_FLAT_DIAMETERS = 0.002  # below this root mean square a cloud has no extent
_FARTHEST_M = 1e6  # a coordinate beyond this marks a missing reading


@dataclass(frozen=True, kw_only=True, eq=False)
class VoxelGrid:
    """The cells of a grid that a cloud fills, and the point of each cell that votes."""

    #: of the filled cells, ``floor((x - mean) / voxel)`` of the rotated cloud; no two are equal.
    coordinates: Int64[Tensor, "m 3"]
    points_m: Float[Tensor, "m 3"]  #: the first point of each cell, in the camera frame
    kept: Int64[Tensor, " m"]  #: index of that point in the cloud, ascending
    row_of_point: Int64[Tensor, " n"]  #: index of the cell of each point of the cloud
    grid_from_camera: Float[Tensor, "3 3"]  #: rotation of the cloud to the axes of the grid
    #: of each cell, in the axes of the grid: the number 1 or, with shape, also the place of its
    #: mean in the cell (-1 to 1), log2 of its number of points, the normal toward the camera, and
    #: the curvature (0 in a plane, 1 in a ball).
    features: Float[Tensor, "m c"]


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
) -> ObjectCloud | Refusal:
    """Lift an input to the usable points of its object, or say why it cannot be posed.

    Args:
        pose_input: a cloud, or a depth image with a mask.
        model: of the object.
        cloud_config: limits: the fewest points, and how far flying pixels are.
        config: how many points of a larger cloud are taken.
    """
    # The readings that may be the object's.
    is_masked = True
    if isinstance(pose_input, ViewInput):
        view = pose_input
        mask = view.mask if view.background is None else view.mask & ~view.background.is_seen
        points_m = cloud_from_depth(view.depth_m, mask, view.K).float()
    else:
        view = pose_input.view
        is_masked = pose_input.is_masked
        points_m = pose_input.points_m.float()
    readings_m = take_evenly(points_m[is_reading(points_m)], config.max_cloud_points)
    if len(readings_m) == 0:
        return Refusal(status="too few points", reason=_explain_emptiness(pose_input))

    # Those near their middle, if they can be posed.
    cloud_m = _drop_flying_pixels(readings_m, model.diameter_m, cloud_config)
    refusal = _refuse_unposable(pose_input, readings_m, cloud_m, model, cloud_config)
    if refusal is not None:
        return refusal
    return ObjectCloud(name=pose_input.name, cloud_m=cloud_m, view=view, is_masked=is_masked)


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


def _refuse_unposable(
    pose_input: CloudInput | ViewInput,
    readings_m: Float[Tensor, "n 3"],
    cloud_m: Float[Tensor, "m 3"],
    model: ObjectModel,
    cloud_config: CloudConfig,
) -> Refusal | None:
    """Refuse a cloud that cannot be posed, by its size, place and shape; None where it can.

    ``readings_m`` are all readings in the mask, ``cloud_m`` those without flying pixels.
    """
    # First of all readings: few of them do not say whether the unit or the frame is another.
    too_few = why_too_few(readings_m, cloud_config)
    if too_few is not None:
        return Refusal(status="too few points", reason=too_few)
    unusable = _explain_other_frame_or_unit(pose_input, readings_m, cloud_m, model)
    if unusable is not None:
        return Refusal(status="unusable input", reason=unusable)
    # Then without flying pixels: in a wrong unit nearly all seem to be such, so it is asked last.
    too_few = why_too_few(cloud_m, cloud_config)
    if too_few is not None:
        return Refusal(status="too few points", reason=too_few)

    # A plane or a line can slide within itself: in how many directions has the cloud no extent?
    centred = cloud_m.double() - cloud_m.double().mean(0)
    extent_m = torch.linalg.eigvalsh(centred.T @ centred / len(centred)).clamp(min=0).sqrt()
    flat_axes = int((extent_m < _FLAT_DIAMETERS * model.diameter_m).sum())
    if flat_axes == 0:
        return None
    shape = {1: "in a plane", 2: "on a line", 3: "in one place"}[flat_axes]
    reason = (
        f"the points lie {shape}, so that motions along it change nothing that is seen; look from "
        "a side that shows more of the object"
    )
    if isinstance(pose_input, ViewInput) and flat_axes == 1:
        reason += ", or give the mask of this image: this one may lie on the background"
    return Refusal(status="not observable", reason=reason)


def _explain_other_frame_or_unit(
    pose_input: CloudInput | ViewInput,
    readings_m: Float[Tensor, "n 3"],
    cloud_m: Float[Tensor, "m 3"],
    model: ObjectModel,
) -> str | None:
    """Explain that a cloud is in another frame or unit than camera and model; None where it is not.

    ``readings_m`` are all readings in the mask, ``cloud_m`` those without flying pixels.
    """
    # The size is measured without flying pixels, if those are few.
    are_few_flying = len(cloud_m) > _MAJORITY * len(readings_m)
    size_advice = advise_unit(model.diameter_m, cloud_m if are_few_flying else readings_m)

    # A camera sees only points before it: a cloud about the origin is in another frame.
    is_about_origin = float(readings_m.median(0).values.norm()) < model.diameter_m / 2
    nearest_m = float(take_evenly(readings_m[:, 2], 10_000).quantile(0.05))
    is_centred = is_about_origin and nearest_m < _BEFORE_CAMERA_DIAMETERS * model.diameter_m
    if isinstance(pose_input, CloudInput) and is_centred and size_advice is None:
        return (
            "the cloud lies about the origin, where the camera is: it was centred, or is in "
            "the frame of the model; give it in the camera's frame, as it was seen"
        )
    axes_advice = advise_frame(readings_m)
    if axes_advice is not None:
        return axes_advice
    if size_advice is None:
        return None
    # Some background in the mask makes a cloud larger, and does not mean another unit.
    if are_few_flying and size_advice.is_cloud_larger:
        return None
    hint = _hint_at_size_mistakes(pose_input.mask) if isinstance(pose_input, ViewInput) else ""
    return f"{size_advice.message} (the object is {model.diameter_m:.3g} m long{hint})"


def _hint_at_size_mistakes(mask: Bool[Tensor, "h w"]) -> str:
    """Name the mistakes with a mask or camera, other than a unit, that change a cloud's size."""
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
        diameter_m: of the object, to drop flying pixels; None: keep all.
        config: how far a point may lie.

    Raises:
        InputError: mask and depth differ in size.
    """
    if depth_m.shape != mask.shape:
        raise make_size_error(mask, depth_m)
    is_read = mask & torch.isfinite(depth_m) & (depth_m > 0)
    # As ``back_project`` does, for these pixels alone.
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
    """Drop points far from the median of one point or more: background at the mask's border."""
    offset_m = (points_m - points_m.median(0).values).norm(dim=-1)
    return points_m[~(offset_m > diameter_m * config.max_offset_diameters)]


def lift_sample(view: ViewSample, diameter_m: float, config: CloudConfig) -> CloudSample:
    """Lift a view of an object to its cloud, without flying pixels."""
    pose_input = view.input
    points_m = cloud_from_depth(
        pose_input.depth_m, pose_input.mask, pose_input.K, diameter_m, config
    )
    cloud = CloudInput(name=pose_input.name, points_m=points_m, object=pose_input.object)
    return CloudSample(input=cloud, truth=view.truth)


def make_size_error(
    mask: Bool[Tensor, "mask_h mask_w"], depth_m: Float[Tensor, "h w"]
) -> InputError:
    """Make the error of a mask that is not of this depth image."""
    return InputError(
        f"the mask is {mask.shape[1]}x{mask.shape[0]}, but the depth image is "
        f"{depth_m.shape[1]}x{depth_m.shape[0]}; give the mask of this very image"
    )


def grow_mask(mask: Bool[Tensor, "h w"], grow_px: int) -> Bool[Tensor, "h w"]:
    """Grow a mask by ``grow_px`` pixels in a square; shrink it where the number is negative."""
    if grow_px == 0:
        return mask
    # To shrink a mask is to grow what is beside it.
    source = (mask if grow_px > 0 else ~mask).float()[None, None]
    size = 2 * abs(grow_px) + 1
    # A square, one axis after the other.
    wide = F.max_pool2d(source, (1, size), 1, (0, size // 2))
    grown = F.max_pool2d(wide, (size, 1), 1, (size // 2, 0))[0, 0] > 0
    return grown if grow_px > 0 else ~grown


def is_reading(points_m: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Mark the points of a cloud that were measured.

    Drivers write NaN, infinity, the largest float or (0, 0, 0) where there is no return.
    """
    return (points_m.abs() < _FARTHEST_M).all(-1) & (points_m != 0).any(-1)


def why_too_few(points_m: Float[Tensor, "n 3"], config: CloudConfig | None = None) -> str | None:
    """Explain why a cloud is too small to be posed; None where it is not."""
    config = CloudConfig() if config is None else config
    if len(points_m) >= config.min_points:
        return None
    return (
        f"the cloud has {len(points_m)} points, fewer than the {config.min_points} that a pose "
        "takes: is the mask empty, or the depth missing there?"
    )


_PER_METRE = {"mm": 1000.0, "cm": 100.0, "inches": 39.37}
_MM = {"cm": 10.0, "inches": 25.4}

# Size of a cloud over the diameter of its model.
_LARGEST_RATIO = 1.5  # a cloud is part of its object; noise and grown masks make it somewhat larger
_SMALLEST_RATIO = 0.1  # a cloud of less cannot be posed anyway
_LIKELY_RATIO = 0.3  # least in the right unit, for a cloud that is too large to be likely of that
_USUAL_RATIO = 0.7  # of a usual view of an object
_AS_LIKELY = 0.3  # difference of log ratios, up to which a unit fits nearly as well as the best


class UnitAdvice(NamedTuple):
    """That a model and a cloud of it seem to be of different units."""

    is_cloud_larger: bool  #: than the model; else it is too small
    message: str  #: how much larger or smaller it is, and the likely units


def advise_unit(model_diameter_m: float, points_m: Float[Tensor, "n 3"]) -> UnitAdvice | None:
    """Advise where the model and the cloud seem to be of different units; None where they agree.

    The size of a cloud is twice the distance from its median that 95 % of the points stay within:
    a few flying pixels do not change it.

    Args:
        model_diameter_m: of the model, in what was taken for metres.
        points_m: of the object, in what was taken for metres.
    """
    if len(points_m) < 2:
        return None
    # The size of the cloud over that of the model.
    distance_m = (points_m - points_m.median(0).values).norm(dim=-1)
    rank = 1 + int(0.95 * (len(distance_m) - 1))
    size_m = 2 * float(distance_m.kthvalue(rank).values)
    if size_m <= 0:
        return None
    ratio = size_m / model_diameter_m
    if _SMALLEST_RATIO <= ratio <= _LARGEST_RATIO:
        return None

    # Is one of the two in a smaller unit than metres?
    is_cloud_larger = ratio > 1
    larger = "cloud" if is_cloud_larger else "model"
    smaller = "model" if is_cloud_larger else "cloud"
    # Five times too large is a mask of more than the object sooner than a sliver in inches.
    least = _LIKELY_RATIO if is_cloud_larger else _SMALLEST_RATIO
    units = _name_likely_units(ratio, least)
    if units:
        times = max(ratio, 1 / ratio)
        message = f"your {larger} is {times:.0f} times larger than the {smaller}: is it in {units}?"
        return UnitAdvice(is_cloud_larger, message)

    # Or the smaller one in a larger unit, where the other is in mm?
    likely: list[str] = []
    for unit, mm in _MM.items():
        corrected = ratio / mm if is_cloud_larger else ratio * mm
        if _LIKELY_RATIO <= corrected <= _LARGEST_RATIO:
            likely.append(unit)
    other_unit = f" Or is the {smaller} in {' or '.join(likely)}?" if likely else ""
    relation = "larger" if is_cloud_larger else "smaller"
    message = (
        f"the cloud is {max(ratio, 1 / ratio):.1f} times {relation} than the model: is this the "
        f"right object, and does the mask fit it?{other_unit}"
    )
    return UnitAdvice(is_cloud_larger, message)


def _name_likely_units(ratio: float, least: float) -> str:
    """Name the units of the larger of cloud and model that would explain the ratio of their sizes.

    ``ratio`` is that of cloud to model; it must lie above ``least`` in the right unit.
    """
    distance_of_unit: dict[str, float] = {}
    for unit, factor in _PER_METRE.items():
        corrected = ratio / factor if ratio > 1 else ratio * factor
        if least <= corrected <= _LARGEST_RATIO:
            distance_of_unit[unit] = abs(math.log(corrected / _USUAL_RATIO))
    if not distance_of_unit:
        return ""
    best = min(distance_of_unit.values())
    return " or ".join(
        unit for unit, distance in distance_of_unit.items() if distance < best + _AS_LIKELY
    )


def advise_frame(points_m: Float[Tensor, "n 3"]) -> str | None:
    """Advise where a cloud lies in another frame than x right, y down, z forward; None elsewhere.

    The points that a camera sees lie before it, less than 60 degrees off its axis.
    """
    # Does another axis than z point forward?
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


def sample_points(
    points_m: Float[Tensor, "n 3"], count: int | None, generator: torch.Generator
) -> Float[Tensor, "m 3"]:
    """Choose ``count`` points at random and keep their order; all where there are fewer."""
    if count is None or len(points_m) <= count:
        return points_m
    index = torch.randperm(len(points_m), generator=generator)[:count].sort().values
    return points_m[index.to(points_m.device)]


def voxelise(points_m: Float[Tensor, "n 3"], config: CloudConfig) -> VoxelGrid:
    """Put a cloud on a grid about its mean, without scaling it; keep the first point of each cell.

    The grid's axes are the camera's, or with ``with_sight_axis`` rotated by the least angle so that
    the third points at the cloud's mean. Votes are cast from the kept points, not from the centres
    of cells.

    Raises:
        InputError: there is no point, one is not finite, or the cloud is over a million voxels
            wide.
    """
    if len(points_m) == 0:
        raise InputError("voxelise: the cloud has no point; see why_too_few first.")
    if not bool(points_m.isfinite().all()):
        # One NaN would move the mean, and with it every point, into one cell.
        count = int((~points_m.isfinite().all(-1)).sum())
        raise InputError(f"voxelise: {count} points are not finite; leave such points out.")

    # The cell of each point.
    mean_m = points_m.mean(0)
    grid_from_camera = torch.eye(3).to(points_m)
    if config.with_sight_axis and float(mean_m.norm()) > 0:
        grid_from_camera = turn_axis_to(mean_m).mT.to(points_m)
    places = (points_m - mean_m) @ grid_from_camera.mT / config.voxel_m
    cells = torch.floor(places).long()
    extent = int((cells.amax(0) - cells.amin(0)).max()) + 1
    if extent > _LARGEST_CELL:
        raise InputError(
            f"voxelise: the cloud is {extent} voxels of {config.voxel_m} m wide; are its points in "
            "mm, or is one of them far away? Give metres."
        )

    # The first point of each filled cell, and the cells in the order of these points.
    local = cells - cells.amin(0)
    key = (local[:, 0] * extent + local[:, 1]) * extent + local[:, 2]
    _, cell = torch.unique(key, return_inverse=True)
    order = torch.arange(len(cells), device=cells.device)
    first = torch.full((int(cell.max()) + 1,), len(cells), device=cells.device)
    kept, rank = first.scatter_reduce_(0, cell, order, "amin").sort()
    row_of_point = rank.argsort()[cell]

    # The number 1 of each cell, and its shape.
    features = torch.ones(len(kept), 1, dtype=torch.float32, device=kept.device)
    if config.with_shape:
        # The mean of the points of each cell about its middle, in half cells; and their number.
        inside = places - cells
        counts = torch.bincount(row_of_point).to(inside)[:, None]
        sums = inside.new_zeros(len(counts), 3).index_add(0, row_of_point, inside)
        means = 2 * sums / counts - 1
        # The plane there.
        normals, curvature = local_planes(points_m.double().cpu(), points_m[kept].double().cpu())
        normals = normals @ grid_from_camera.double().cpu().mT
        plane = torch.cat([normals, curvature], 1).to(sums)
        shape = torch.cat([means, counts.log2(), plane], 1)
        features = torch.cat([features, shape.float()], 1)
    return VoxelGrid(
        coordinates=cells[kept],
        points_m=points_m[kept],
        kept=kept,
        row_of_point=row_of_point,
        grid_from_camera=grid_from_camera,
        features=features,
    )


def sample_and_voxelise(cloud_m: Float[Tensor, "n 3"], config: CloudConfig, seed: int) -> VoxelGrid:
    """Put at most ``max_points`` of a cloud, chosen at random, on the grid of a network."""
    generator = torch.Generator().manual_seed(seed)
    return voxelise(sample_points(cloud_m, config.max_points, generator), config)


def turn_axis_to(direction: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Give the rotation by the least angle that carries the z axis to a direction, in float64.

    Rodrigues' formula with ``1 / (1 + z)``. For the direction opposite to the axis, where many are
    as small, it is the half turn about x.
    """
    x, y, z = (direction / direction.norm()).tolist()
    if z < -1 + 1e-9:
        return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    k = 1 / (1 + z)
    rows = [[1 - k * x * x, -k * x * y, x], [-k * x * y, 1 - k * y * y, y], [-x, -y, z]]
    return torch.tensor(rows, dtype=torch.float64)


def thin(
    points_m: Float64[Tensor, "n 3"], normals: Float64[Tensor, "n 3"], step_m: float
) -> Int64[Tensor, " m"]:
    """Choose one point of each cell of a grid and each octant of normals in it; give the indices.

    Args:
        points_m: at least one.
        normals: of the points.
        step_m: side of a cell.
    """
    cells = ((points_m - points_m.amin(0)) / step_m).long()
    cells = torch.cat([cells, (normals > 0).long()], 1)
    _, place = torch.unique(cells, dim=0, return_inverse=True)

    # The first point of each.
    first = torch.full((int(place.max()) + 1,), len(points_m))
    first = first.scatter_reduce_(0, place, torch.arange(len(points_m)), "amin")
    return first.sort().values


def local_planes(
    cloud_m: Float64[Tensor, "n 3"], chosen_m: Float64[Tensor, "m 3"]
) -> tuple[Float64[Tensor, "m 3"], Float64[Tensor, "m 1"]]:
    """Fit a plane to the 20 points of a cloud that are nearest to each of the chosen points.

    Returns:
        The normal of each toward the camera; the curvature of the cloud there, from the least
        eigenvalue of the neighbours' scatter: 0 (flat) to 1 (as wide in all directions).
    """
    # The neighbours of each point, about their mean.
    count = min(_NEIGHBOURS, len(cloud_m))
    index = KDTree(cloud_m.numpy()).query(chosen_m.numpy(), k=count, workers=1)[1]
    near_m = cloud_m[torch.as_tensor(index).reshape(len(chosen_m), count)]
    near_m = near_m - near_m.mean(1, keepdim=True)

    # The normal is the direction in which they extend least.
    eigenvalues, axes = torch.linalg.eigh(near_m.mT @ near_m)
    normals = axes[:, :, 0]
    is_behind = (normals * chosen_m).sum(-1, keepdim=True) > 0
    total = eigenvalues.sum(1, keepdim=True).clamp(min=1e-30)
    curvature = 3 * eigenvalues[:, :1].clamp(min=0) / total
    return torch.where(is_behind, -normals, normals), curvature
