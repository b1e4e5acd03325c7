"""An input to the cloud that the network sees, or the reason why it cannot be posed."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.pose.cloud import (
    Voxels,
    cloud_from_depth,
    is_flying,
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
_THIN = 0.002
"""Below this root mean square, in diameters, a cloud has no extent."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """A cloud that can be posed.

    Attributes:
        cloud_m: all usable points, what flies about left out.
        points_m: those that the network sees and that vote, one a voxel.
        voxels: of the network's grid.
    """

    cloud_m: Float[Tensor, "n 3"]
    points_m: Float[Tensor, "m 3"]
    voxels: Voxels


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why there is no pose."""

    status: Status
    reason: str


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
    if (behind := float((points_m[:, 2] <= 0).float().mean())) > _MOST:
        return Refusal(
            status="unusable input",
            reason=f"{behind:.0%} of the points lie behind the camera (z <= 0): is its z backward "
            "or in another frame? Turn the cloud to x right, y down, z forward",
        )
    kept_m = points_m[~is_flying(points_m, cloud.max_offset_diameters * model.diameter_m)]
    refusal = _judge_size(points_m, kept_m, model) or _judge_shape(kept_m, model, cloud)
    if refusal is not None:
        return refusal
    generator = torch.Generator().manual_seed(config.voting.seed)
    sampled_m = sample_points(kept_m, cloud.max_points, generator)
    voxels = voxelise(sampled_m, cloud)
    return Prepared(cloud_m=kept_m, points_m=sampled_m[voxels.kept], voxels=voxels)


def _points_of(given: AnyInput, most: int) -> Float[Tensor, "n 3"] | Refusal:
    if isinstance(given, ViewInput):
        points_m = cloud_from_depth(given.depth_m, given.mask, given.K).float()
        if len(points_m) == 0:
            return Refusal(status="too few points", reason=_nothing_seen(given))
    else:
        points_m = given.points_m.float()
    points_m = take_evenly(points_m, most)
    finite_m = points_m[points_m.isfinite().all(-1)]
    if len(finite_m) == 0:
        what = "is empty" if len(points_m) == 0 else "has no point with finite coordinates"
        return Refusal(status="too few points", reason=f"the cloud {what}")
    return finite_m


def _nothing_seen(view: ViewInput) -> str:
    masked = int(view.mask.sum())
    if masked == 0:
        return "the mask is empty: no pixel of it is the object"
    if not bool((view.depth_m > 0).any()):
        return "the depth image has no reading at all: every pixel is 0 or NaN"
    return f"none of the {masked} masked pixels has a depth reading"


def _judge_size(
    points_m: Float[Tensor, "n 3"], kept_m: Float[Tensor, "m 3"], model: ObjectModel
) -> Refusal | None:
    """Refuse what is not of this object's size; some background in the mask is none of that."""
    some_m = kept_m if len(kept_m) > _MOST * len(points_m) else points_m
    advice = unit_advice(model.diameter_m, some_m)
    if advice is None or (some_m is kept_m and "larger than the model" in advice):
        return None
    return Refusal(
        status="unusable input",
        reason=f"{advice} (the object is {model.diameter_m:.3g} m long; a mask of more than it, "
        "or a K of another image size, changes the size of its cloud too)",
    )


def _judge_shape(
    points_m: Float[Tensor, "n 3"], model: ObjectModel, cloud: CloudConfig
) -> Refusal | None:
    if (reason := refusal_of(points_m, cloud)) is not None:
        return Refusal(status="too few points", reason=reason)
    centred = (points_m - points_m.mean(0)).double()
    extent_m = torch.linalg.eigvalsh(centred.T @ centred / len(centred)).clamp(min=0).sqrt()
    flat = int((extent_m < _THIN * model.diameter_m).sum())
    if flat == 0:
        return None
    shape = {1: "in a plane", 2: "on a line", 3: "in one place"}[flat]
    return Refusal(
        status="not observable",
        reason=f"the points lie {shape}, so that motions along it change nothing that is seen; "
        "look from a side that shows more of the object",
    )
