"""The scale of the model that fits a cloud best: a copy of another size is not the object."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose.compiled import serves
from depthpose.pose.surface import NEAR, Surface

POINTS = 400
"""Of the cloud, evenly taken."""
_STEPS = 12
_WIDE = 2.0
"""Times the usual limit of a distance in the first step."""
_INDEPENDENT = 10.0
"""So many neighbouring readings err alike: the variance is as many times as large."""
_STARTS = (1.0, 0.87, 1.15)
"""Scales at which the search begins: from one alone it stays there where the copy is smaller."""
_ROUGH_POINTS = 150
_TRUST = 0.03
"""A scale beside 1 must lower the mean squared distance, in squared limits, by so much."""
_CONVERGED = 3e-4


@dataclass(frozen=True)
class Scale:
    """How many times as large as the model the seen object is, and how sure that is.

    Attributes:
        times: 1 for the model itself.
        sigma: standard deviation of it.
        gain: by how much it lowers the root mean square distance of the points to the surface, in
            units of the distance up to which a point is near.
    """

    times: float
    sigma: float
    gain: float


def scale_of(cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface) -> Scale:
    """Measure the scale of the model that fits a cloud best, the pose moving with it.

    Point-to-plane ICP with a seventh unknown: the model grows about its middle ``c`` by ``s``,
    which moves its point ``p`` across the surface by ``n . (p - c) s``.

    Args:
        cloud_m: of the object, in the camera frame.
        pose: after ICP.
        surface: of the model.
    """
    local_m = pose.inverse().apply(take_evenly(cloud_m.double(), POINTS))
    middle_m = (surface.points_m.amin(0) + surface.points_m.amax(0)) / 2
    starts = torch.tensor(_STARTS, dtype=torch.float64)
    few_m = take_evenly(local_m, _ROUGH_POINTS).expand(len(starts), -1, -1)
    times, turned_m, _ = _grow(few_m, starts, middle_m, surface, is_exact=False)
    costs = _distance(turned_m, times, middle_m, surface, is_exact=False).square()
    costs[0] -= _TRUST
    start = starts[costs.argmin()][None]
    times, turned_m, sigma = _grow(local_m[None], start, middle_m, surface, is_exact=True)
    reached = _distance(turned_m, times, middle_m, surface, is_exact=True)
    gain = distance_to(local_m, surface, is_exact=True) - reached[0]
    return Scale(float(times), float(sigma), float(gain))


def _grow(
    local_m: Float64[Tensor, "b n 3"],
    times: Float64[Tensor, " b"],
    middle_m: Float64[Tensor, "3"],
    surface: Surface,
    *,
    is_exact: bool,
) -> tuple[Float64[Tensor, " b"], Float64[Tensor, "b n 3"], Float64[Tensor, " b"]]:
    """Step by step to the scale and place that fit; give also the moved points and the spread."""
    widths = (1 + (_WIDE - 1) * max(0.0, 1 - 2 * step / _STEPS) for step in range(_STEPS))
    limits_m = [NEAR * surface.diameter_m * width for width in widths]
    if serves(local_m, times):
        from depthpose.pose.compiled.scale import grown

        start = (local_m, times, middle_m)
        times, local_m, variance = grown(start, surface.target, limits_m, _CONVERGED, is_exact)
        return times, local_m, (_INDEPENDENT * variance).sqrt()
    sigma = torch.ones_like(times)
    for near_m in limits_m:
        motion, variance = _similar_step(
            local_m, times, (middle_m, near_m), surface, is_exact=is_exact
        )
        times = (times * (1 + motion[:, 6].clamp(-0.1, 0.1))).clamp(0.5, 2.0)
        sigma = variance.clamp(min=0).sqrt()
        turn = rotation_by(motion[:, :3])
        local_m = (local_m - middle_m - motion[:, None, 3:6]) @ turn + middle_m
        if float(motion[:, [0, 1, 2, 6]].abs().max()) < _CONVERGED:
            break
    return times, local_m, sigma


def _similar_step(
    local_m: Float64[Tensor, "b n 3"],
    times: Float64[Tensor, " b"],
    about: tuple[Float64[Tensor, "3"], float],
    surface: Surface,
    *,
    is_exact: bool,
) -> tuple[Float64[Tensor, "b 7"], Float64[Tensor, " b"]]:
    """One step of turn, shift and growth about the middle, with a limit; the growth's variance."""
    middle_m, limit_m = about
    own_m = (local_m - middle_m) / times[:, None, None] + middle_m
    index = surface.find(own_m, is_exact=is_exact)
    normal = surface.normals[index]
    arm_m = times[:, None, None] * (surface.points_m[index] - middle_m)
    gap_m = local_m - middle_m - arm_m
    residual_m = (normal * gap_m).sum(-1)
    weight = (1 - gap_m.square().sum(-1) / limit_m**2).clamp(min=0).square()
    growth_m = (normal * arm_m).sum(-1, keepdim=True)
    J = torch.cat([torch.linalg.cross(arm_m, normal), normal, growth_m], -1)
    weighted = J.mT * weight[:, None]
    H = weighted @ J
    size = H.diagonal(dim1=1, dim2=2).amax(-1)[:, None, None].clamp(min=1e-9)
    inverse = torch.linalg.inv(H + 1e-9 * size * torch.eye(7, dtype=torch.float64))
    motion = (inverse @ (weighted @ residual_m[..., None])).squeeze(-1)
    left_m = residual_m - (J @ motion[..., None]).squeeze(-1)
    variance = (weight * left_m.square()).sum(-1) / (weight.sum(-1) - 7).clamp(min=1)
    return motion, _INDEPENDENT * variance * inverse[:, 6, 6]


def _distance(
    local_m: Float64[Tensor, "b n 3"],
    times: Float64[Tensor, " b"],
    middle_m: Float64[Tensor, "3"],
    surface: Surface,
    *,
    is_exact: bool,
) -> Float64[Tensor, " b"]:
    """Distance to the surface so many times as large."""
    own_m = (local_m - middle_m) / times[:, None, None] + middle_m
    return distance_to(own_m, surface, times, is_exact=is_exact)


def distance_to(
    local_m: Float64[Tensor, "*batch n 3"],
    surface: Surface,
    times: Float64[Tensor, "*batch"] | None = None,
    *,
    is_exact: bool,
) -> Float64[Tensor, "*batch"]:
    """Root mean square distance of points to a surface, in limits of nearness, cut off at 1.

    Args:
        local_m: in the model frame, where the surface has its own size.
        surface: of the model.
        times: by which all lengths are measured; None: 1.
        is_exact: whether the nearest point is searched, or looked up.
    """
    gap_m = (local_m - surface.points_m[surface.find(local_m, is_exact=is_exact)]).norm(dim=-1)
    if times is not None:
        gap_m = times[..., None] * gap_m
    return (gap_m / (NEAR * surface.diameter_m)).clamp(max=1).square().mean(-1).sqrt()
