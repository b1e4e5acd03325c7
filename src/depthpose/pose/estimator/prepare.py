"""An input to the cloud that the network sees, or the reason why it cannot be posed."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.arrays import take_evenly
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
from depthpose.pose.mesh import unit_advice
from depthpose.pose.types import CloudInput, ObjectModel, Status, ViewInput

AnyInput = CloudInput | ViewInput
_MOST = 0.5
"""Where most points lie farther from their median than the object is long, they are not its."""
_BEFORE = 0.05
"""Nearly all points of a cloud that was seen lie so many diameters before the camera, and more."""
_THIN = 0.002
"""Below this root mean square, in diameters, a cloud has no extent."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """A cloud that can be posed.

    Attributes:
        cloud_m: all usable points, without flying pixels.
        points_m: those that the network sees and that vote, one a voxel.
        voxels: of the network's grid.
        view: the depth image that shows the cloud; None where the cloud alone is known.
    """

    cloud_m: Float[Tensor, "n 3"]
    points_m: Float[Tensor, "m 3"]
    voxels: VoxelGrid
    view: ViewInput | None


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why there is no pose."""

    status: Status
    reason: str


class Voted(NamedTuple):
    """A cloud and the network's outputs for its points."""

    cloud: Prepared
    outputs: Float[Tensor, "n k c"]


def prepare_cloud(
    given: AnyInput, model: ObjectModel, cloud: CloudConfig, config: EstimateConfig
) -> Prepared | Refusal:
    """Lift, thin, drop flying pixels, check, sample and put on the grid of the network.

    Raises:
        InputError: mask and depth differ in size.
    """
    points_m = _points_of(given, config.max_cloud_points)
    if isinstance(points_m, Refusal):
        return points_m
    if (few := refusal_of(points_m, cloud)) is not None:
        return Refusal(status="too few points", reason=few)
    kept_m = points_m[~is_flying(points_m, cloud.max_offset_diameters * model.diameter_m)]
    refusal = (
        _place_refusal(given, points_m, kept_m, model)
        or _size_refusal(given, points_m, kept_m, model)
        or _shape_refusal(given, kept_m, model, cloud)
    )
    if refusal is not None:
        return refusal
    generator = torch.Generator().manual_seed(config.voting.seed)
    sampled_m = sample_points(kept_m, cloud.max_points, generator)
    voxels = voxelise(sampled_m, cloud)
    view = given if isinstance(given, ViewInput) else given.view
    return Prepared(cloud_m=kept_m, points_m=sampled_m[voxels.kept], voxels=voxels, view=view)


def _points_of(given: AnyInput, most: int) -> Float[Tensor, "n 3"] | Refusal:
    if isinstance(given, ViewInput):
        points_m = cloud_from_depth(given.depth_m, given.mask, given.K).float()
        if len(points_m) == 0:
            return Refusal(status="too few points", reason=nothing_seen(given))
    else:
        points_m = given.points_m.float()
    read_m = take_evenly(points_m[is_reading(points_m)], most)
    if len(read_m) == 0:
        is_zero = bool((points_m == 0).all(-1).any())
        finite = "is (0, 0, 0), no reading, in every point"
        what = finite if is_zero else "has no point with finite coordinates"
        what = "is empty" if len(points_m) == 0 else what
        return Refusal(status="too few points", reason=f"the cloud {what}")
    return read_m


def nothing_seen(view: ViewInput) -> str:
    """Say why no masked pixel of a view has a depth."""
    masked = int(view.mask.sum())
    if masked == 0:
        return "the mask is empty: no pixel of it is the object"
    if not bool((view.depth_m > 0).any()):
        return "the depth image has no reading at all: every pixel is 0 or NaN"
    return f"none of the {masked} masked pixels has a depth reading"


def _place_refusal(
    given: AnyInput,
    points_m: Float[Tensor, "n 3"],
    kept_m: Float[Tensor, "m 3"],
    model: ObjectModel,
) -> Refusal | None:
    """Refuse what is not before the camera; a cloud about the origin is in no other axes."""
    is_centred = isinstance(given, CloudInput) and _is_centred(points_m, model)
    if is_centred and unit_advice(model.diameter_m, _sized(points_m, kept_m)) is None:
        return Refusal(
            status="unusable input",
            reason="the cloud lies about the origin, where the camera is: it was centred, or is in "
            "the frame of the model; give it in the camera's frame, as it was seen",
        )
    turned = frame_advice(points_m)
    return None if turned is None else Refusal(status="unusable input", reason=turned)


def _sized(points_m: Float[Tensor, "n 3"], kept_m: Float[Tensor, "m 3"]) -> Float[Tensor, "k 3"]:
    """Give the points whose size is the object's: without flying pixels, if those are few."""
    return kept_m if len(kept_m) > _MOST * len(points_m) else points_m


def _size_refusal(
    given: AnyInput,
    points_m: Float[Tensor, "n 3"],
    kept_m: Float[Tensor, "m 3"],
    model: ObjectModel,
) -> Refusal | None:
    """Refuse what is not of this object's size; some background in the mask is none of that."""
    some_m = _sized(points_m, kept_m)
    advice = unit_advice(model.diameter_m, some_m)
    if advice is None or (some_m is kept_m and "larger than the model" in advice):
        return None
    hint = _view_hint(given) if isinstance(given, ViewInput) else ""
    reason = f"{advice} (the object is {model.diameter_m:.3g} m long{hint})"
    return Refusal(status="unusable input", reason=reason)


def _is_centred(points_m: Float[Tensor, "n 3"], model: ObjectModel) -> bool:
    """Whether a cloud lies about the origin; one that was seen is wholly before the camera."""
    is_near = float(points_m.median(0).values.norm()) < model.diameter_m / 2
    least_m = float(take_evenly(points_m[:, 2], 10_000).quantile(0.05))
    return is_near and least_m < _BEFORE * model.diameter_m


def _view_hint(view: ViewInput) -> str:
    """Say what else than the object changes the size of a cloud from a depth image."""
    edge = torch.cat([view.mask[0], view.mask[-1], view.mask[:, 0], view.mask[:, -1]])
    if float(view.mask.float().mean()) > _MOST and float(edge.float().mean()) > _MOST:
        share = float(view.mask.float().mean())
        return f"; the mask covers {share:.0%} of the image and its border: is it inverted?"
    return (
        "; a mask of more than it, or a K of another image size, changes the size of its cloud "
        "too, and so does another depth unit: 0.001 m of most sensors, 0.0002 m of TUM RGB-D, "
        "1/256 m of KITTI"
    )


def _shape_refusal(
    given: AnyInput, points_m: Float[Tensor, "n 3"], model: ObjectModel, cloud: CloudConfig
) -> Refusal | None:
    if (reason := refusal_of(points_m, cloud)) is not None:
        return Refusal(status="too few points", reason=reason)
    centred = points_m.double() - points_m.double().mean(0)
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
