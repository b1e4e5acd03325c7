"""Files, arrays or tensors to clouds that can be posed, or the reason why they cannot."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import (
    AnyLens,
    Camera,
    camera_of,
    check_image_matches_camera,
    refuse_other_resolution,
    refuse_outside,
)
from depthpose.core.camera.camera_file import intrinsics_of
from depthpose.core.errors import InputError
from depthpose.core.files import read_cloud, read_stored_depth
from depthpose.core.rigid import Rigid
from depthpose.core.units import Unit, metres_of
from depthpose.pose.cloud import (
    VoxelGrid,
    cloud_from_depth,
    frame_advice,
    is_flying,
    is_reading,
    refusal_of,
    sample_points,
    voxelise,
)
from depthpose.pose.config import CloudConfig, EstimateConfig
from depthpose.pose.datasets import mask_from_rle, number_objects, one_mask, read_labels
from depthpose.pose.mesh import unit_advice
from depthpose.pose.segmentation import label_parts
from depthpose.pose.types import CloudInput, ObjectModel, Status, ViewInput

AnyArray = str | Path | np.ndarray | Tensor  #: a file, an array or a tensor
AnyMask = AnyArray | Mapping[str, Any]  #: a mask, its file, or COCO's run lengths
_SMALLEST_INSTANCE = 0.2
"""Pieces of a mask below this share of the largest are fragments of a segmentation, not objects."""
AnyInput = CloudInput | ViewInput
_MOST = 0.5  # where most points are farther from their median than the object is long, refuse
_BEFORE = 0.05  # nearly all points of a seen cloud are so many diameters before the camera
_THIN = 0.002  # below this root mean square, in diameters, a cloud has no extent


def cloud_input(cloud: AnyArray, unit: Unit, object: str, name: str) -> CloudInput:
    """Take points in a unit to a cloud in metres."""
    points = read_cloud(cloud).points if isinstance(cloud, str | Path) else _tensor(cloud)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"{name}: the cloud is of shape {tuple(points.shape)}; give points as rows of x, y and "
            "z: (n, 3)"
        )
    return CloudInput(
        name=name, points_m=(points.double() * metres_of(unit)).float(), object=object
    )


def view_input(
    depth: AnyArray,
    mask: AnyMask | None,
    camera: AnyLens | None,
    object: str,
    name: str,
    unit: Unit | None = None,
) -> ViewInput:
    """Take a depth image, a mask and a camera to a view in metres."""
    values = read_stored_depth(depth) if isinstance(depth, str | Path) else _tensor(depth)
    if values.ndim != 2:
        raise InputError(f"{name}: the depth is of shape {tuple(values.shape)}, not (h, w)")
    height, width = values.shape
    is_said = isinstance(camera, str | Path | Mapping | float | int)
    known = camera_of(camera, (width, height)) if is_said else camera
    said_m = known.depth_unit_m if isinstance(known, Camera) else None
    file = str(depth) if isinstance(depth, str | Path) else name
    given_m = None if unit is None else metres_of(unit)
    if not values.is_floating_point():
        if given_m is not None and said_m is not None and given_m != said_m:
            raise InputError(
                f"{file}: unit {unit} is {given_m:g} m, but its camera says depth_unit_m "
                f"{said_m:g}; omit one of the two (the unit of a CAD file is --cad-unit)"
            )
        given_m = said_m if given_m is None else given_m
        if given_m is None:
            raise InputError(
                f"{file}: its depth is in whole numbers, and nothing says of what; give a camera "
                'with "depth_unit_m" (0.001 where they are millimetres, 0.0002 of TUM RGB-D, '
                "0.00390625 of KITTI), --unit mm (in Python unit='mm'), or metres as floats"
            )
        values = values.double()
    depth_m = torch.where(values > 0, values * (given_m or 1.0), torch.nan).float()
    pixels = torch.ones(height, width).bool()
    if mask is not None:
        said = str(mask) if isinstance(mask, str | Path) else name
        pixels = one_mask(labels_input(mask, name), said)
    if tuple(pixels.shape) != (height, width):
        raise InputError(
            f"{name}: the mask is of shape {tuple(pixels.shape)}, but the depth image of "
            f"{(height, width)}; give the mask of this very image"
        )
    if isinstance(known, Camera):
        check_image_matches_camera(known, width, height, name)
    K = known.K if isinstance(known, Camera) else intrinsics_of(known)
    try:
        # A crop may leave the centre; its camera says the size, which was compared above.
        refuse = refuse_outside if isinstance(known, Camera) else refuse_other_resolution
        refuse(K, width, height)
    except InputError as error:
        raise InputError(
            f"{name}: K is of another image or size: {error}. Resizing an image by s makes fx, fy, "
            "cx and cy s times as large"
        ) from error
    return ViewInput(name=name, depth_m=depth_m, mask=pixels, K=K, object=object)


def rigid_input(pose: Rigid | AnyArray) -> Rigid:
    """Take a transform, or its 4x4 matrix in metres."""
    if isinstance(pose, Rigid):
        return pose
    matrix = torch.zeros(0) if isinstance(pose, str | Path) else _tensor(pose).double()
    if tuple(matrix.shape) != (4, 4):
        raise InputError(
            f"first is a {type(pose).__name__} of shape {tuple(matrix.shape)}; give a Rigid, or "
            "the 4x4 matrix camera_from_model in metres"
        )
    R, last = matrix[:3, :3], matrix.new_tensor([0, 0, 0, 1])
    is_rotation = torch.allclose(R @ R.T, torch.eye(3).to(R), atol=1e-4) and torch.det(R) > 0
    if not is_rotation or not torch.equal(matrix[3], last):
        raise InputError(
            "first is no rigid transform; give [R t; 0 0 0 1], R a rotation, t in metres (a "
            "transposed matrix has t in its last row)"
        )
    return Rigid(R.contiguous(), matrix[:3, 3].contiguous())


def split_instances(labels: Int64[Tensor, "h w"]) -> list[Bool[Tensor, "h w"]]:
    """Split a mask into one for each object, from the largest down.

    Where it numbers several, they are these; else its connected pieces: pixels that touch at a
    corner are connected, and a piece below a fifth of the largest is a fragment, left out.
    """
    numbers, pixels = labels[labels != 0].unique(return_counts=True)
    if len(numbers) > 1:
        order = pixels.argsort(descending=True, stable=True)
        return [labels == number for number in numbers[order]]
    label, pixels = label_parts(labels != 0)
    order = pixels.argsort(descending=True, stable=True)
    least = max(1, math.ceil(_SMALLEST_INSTANCE * int(pixels.max())))
    return [label == k for k in order if int(pixels[k]) >= least]


def labels_input(mask: AnyMask, name: str) -> Int64[Tensor, "_ _"]:
    """Take a mask to the numbers of its objects, as :func:`read_labels` gives them.

    Of fractions in [0, 1], which are probabilities, those above a half are the object.
    """
    if isinstance(mask, str | Path):
        return read_labels(Path(mask))
    if isinstance(mask, Mapping):
        return mask_from_rle(mask, name).long()
    values = _tensor(mask)
    if values.is_floating_point() and not bool((values % 1 == 0).all()):
        if not bool(((values >= 0) & (values <= 1)).all()):
            raise InputError(
                f"{name}: the mask holds fractions outside [0, 1], or NaN; give True and False "
                "(logits > 0), whole numbers of objects, or probabilities"
            )
        values = values > 0.5
    whole = values.long()
    return number_objects(whole.numpy()) if whole.ndim == 2 else whole


def _tensor(values: Any) -> Tensor:  # noqa: ANN401  whatever a caller has
    if isinstance(values, Tensor) and not values.is_complex():
        # Of unsigned numbers torch computes little but with bytes.
        is_odd = values.dtype in (torch.uint16, torch.uint32, torch.uint64)
        return (values.long() if is_odd else values).detach().cpu()
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        is_complex = array.dtype.kind == "c"
        what = "complex numbers where real" if is_complex else f"a {type(values).__name__} where"
        raise InputError(
            f"{what} numbers belong; give a tensor or array of numbers, "
            "or a file's path (of a camera: a Camera, its file or its matrix K)"
        )
    if array.dtype.kind == "u" and array.dtype.itemsize > 1:
        array = array.astype(np.int64)
    if array.dtype.kind == "f" and array.dtype.itemsize > 8:
        array = array.astype(np.float64)
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    return torch.from_numpy(np.require(array, requirements=["C", "W"]))  # Pillow lends read-only


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectCloud:
    """A cloud that can be posed."""

    cloud_m: Float[Tensor, "n 3"]  #: all usable points, without flying pixels
    points_m: Float[Tensor, "m 3"]  #: those that the network sees and that vote, one a voxel
    voxels: VoxelGrid  #: of the network's grid
    view: ViewInput | None  #: the depth image that shows the cloud; None of a cloud alone


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why there is no pose."""

    status: Status
    reason: str


class CloudDirections(NamedTuple):
    """A cloud and the network's directions at its points."""

    cloud: ObjectCloud
    directions: Float[Tensor, "n k 3"]


def prepare_cloud(
    given: AnyInput, model: ObjectModel, cloud: CloudConfig, config: EstimateConfig
) -> ObjectCloud | Refusal:
    """Lift, thin, drop flying pixels, check, sample and put on the grid of the network."""
    if isinstance(given, ViewInput):
        points_m = cloud_from_depth(given.depth_m, given.mask, given.K).float()
        nothing = nothing_seen(given) if len(points_m) == 0 else ""
    else:
        points_m = given.points_m.float()
        is_zero = bool((points_m == 0).all(-1).any())
        nothing = "the cloud has no point with finite coordinates"
        nothing = "the cloud is (0, 0, 0), no reading, in every point" if is_zero else nothing
        nothing = "the cloud is empty" if len(points_m) == 0 else nothing
    points_m = take_evenly(points_m[is_reading(points_m)], config.max_cloud_points)
    if len(points_m) == 0:
        return Refusal(status="too few points", reason=nothing)
    kept_m = points_m[~is_flying(points_m, cloud.max_offset_diameters * model.diameter_m)]
    if (refusal := _refusal_of(given, points_m, kept_m, model, cloud)) is not None:
        return refusal
    generator = torch.Generator().manual_seed(config.voting.seed)
    sampled_m = sample_points(kept_m, cloud.max_points, generator)
    voxels = voxelise(sampled_m, cloud)
    view = given if isinstance(given, ViewInput) else given.view
    return ObjectCloud(cloud_m=kept_m, points_m=sampled_m[voxels.kept], voxels=voxels, view=view)


def nothing_seen(view: ViewInput) -> str:
    """Say why no masked pixel of a view has a depth."""
    masked = int(view.mask.sum())
    if masked == 0:
        return "the mask is empty: no pixel of it is the object"
    if not bool((view.depth_m > 0).any()):
        return "the depth image has no reading at all: every pixel is 0 or NaN"
    return f"none of the {masked} masked pixels has a depth reading"


def _refusal_of(
    given: AnyInput,
    points_m: Float[Tensor, "n 3"],
    kept_m: Float[Tensor, "m 3"],
    model: ObjectModel,
    cloud: CloudConfig,
) -> Refusal | None:
    """Refuse a cloud by its place, its size and its shape; ``kept_m`` has no flying pixels."""
    if (few := refusal_of(points_m, cloud)) is not None:
        return Refusal(status="too few points", reason=few)
    # Of the object's size is what is left without flying pixels, if those are few.
    sized_m = kept_m if len(kept_m) > _MOST * len(points_m) else points_m
    advice = unit_advice(model.diameter_m, sized_m)
    # What was seen is wholly before the camera; a cloud about the origin is in no other axes.
    is_about_origin = float(points_m.median(0).values.norm()) < model.diameter_m / 2
    least_m = float(take_evenly(points_m[:, 2], 10_000).quantile(0.05))
    is_centred = is_about_origin and least_m < _BEFORE * model.diameter_m
    unusable = frame_advice(points_m)
    if isinstance(given, CloudInput) and is_centred and advice is None:
        unusable = (
            "the cloud lies about the origin, where the camera is: it was centred, or is in "
            "the frame of the model; give it in the camera's frame, as it was seen"
        )
    # Some background in the mask is not of another size.
    elif not unusable and advice and not (sized_m is kept_m and "larger than the model" in advice):
        hint = ""
        if isinstance(given, ViewInput):  # what else changes the size of a cloud
            mask = given.mask.float()
            edge = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
            hint = (
                "; a mask of more than it, or a K of another image size, changes the size of its "
                "cloud too, and so does another depth unit: 0.001 m of most sensors, 0.0002 m of "
                "TUM RGB-D, 1/256 m of KITTI"
            )
            if (share := float(mask.mean())) > _MOST and float(edge.mean()) > _MOST:
                hint = f"; the mask covers {share:.0%} of the image and its border: is it inverted?"
        unusable = f"{advice} (the object is {model.diameter_m:.3g} m long{hint})"
    if unusable is not None:
        return Refusal(status="unusable input", reason=unusable)
    if (few := refusal_of(kept_m, cloud)) is not None:
        return Refusal(status="too few points", reason=few)
    centred = kept_m.double() - kept_m.double().mean(0)
    extent_m = torch.linalg.eigvalsh(centred.T @ centred / len(centred)).clamp(min=0).sqrt()
    flat = int((extent_m < _THIN * model.diameter_m).sum())
    if flat == 0:
        return None
    shape = {1: "in a plane", 2: "on a line", 3: "in one place"}[flat]
    beside = isinstance(given, ViewInput) and flat == 1
    return Refusal(
        status="not observable",
        reason=f"the points lie {shape}, so that motions along it change nothing that is seen; "
        "look from a side that shows more of the object"
        f"{', or give the mask of this image: this one may lie on the background' * beside}",
    )
