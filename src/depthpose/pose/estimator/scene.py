"""What a camera saw in the direction of a posed object: before, beside and behind it."""

from dataclasses import replace

from jaxtyping import Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.estimator.prepare import AnyInput
from depthpose.pose.surface import Surface
from depthpose.pose.types import ViewInput

MARGIN = 0.15
"""Of the diameter: points so far from the surface at the last or the predicted pose may be the
object's; between two frames it moves by less."""
_MOST_POINTS = 10_000
"""Of what a camera saw about the object, evenly taken."""


def scene_about(given: AnyInput, poses: Rigid, surface: Surface) -> Float64[Tensor, "n 3"]:
    """Give all points in the direction of the object at one of several poses, and about it.

    Args:
        given: a cloud of more than the object, or a view, whose mask limits what is taken.
        poses: a batch, ``camera_from_model``.
        surface: of the model.
    """
    middles_m = (poses.R @ surface.points_m.mean(0)) + poses.t_m
    middle_m = middles_m.mean(0)
    radius_m = (0.5 + 2 * MARGIN) * surface.diameter_m
    radius_m += float((middles_m - middle_m).norm(dim=-1).max())
    if isinstance(given, ViewInput):
        window = _window(given, middle_m, radius_m)
        points_m = cloud_from_depth(window.depth_m, window.mask, window.K).double()
        return take_evenly(points_m, _MOST_POINTS)
    points_m = given.points_m.double()
    points_m = points_m[points_m.isfinite().all(-1) & (points_m[:, 2] > 0)]
    offset = points_m[:, :2] / points_m[:, 2:] - middle_m[:2] / middle_m[2]
    near = offset.abs().amax(-1) < radius_m / (middle_m[2] - radius_m).clamp(min=0.1 * middle_m[2])
    return take_evenly(points_m[near], _MOST_POINTS)


def _window(view: ViewInput, middle_m: Float64[Tensor, "3"], radius_m: float) -> ViewInput:
    """Cut the square about a ball out of a view."""
    z_m = float(middle_m[2])
    K, near_m = view.K.double(), max(z_m - radius_m, 0.1 * z_m)
    u, v = (K @ (middle_m / z_m))[:2].tolist()
    reach = [float(K[k, k]) * radius_m / near_m for k in range(2)]
    height, width = view.depth_m.shape
    left, right = (min(max(round(u + s * reach[0]), 0), width) for s in (-1, 1))
    top, bottom = (min(max(round(v + s * reach[1]), 0), height) for s in (-1, 1))
    part = (slice(top, bottom), slice(left, right))
    shifted = K.clone()
    shifted[0, 2] -= left
    shifted[1, 2] -= top
    return replace(view, depth_m=view.depth_m[part], mask=view.mask[part], K=shifted)
