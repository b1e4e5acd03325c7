"""Motions after which a part of a model's surface lies on itself: the model searched in itself."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.geometry.surface import Surface, prepare_surface
from depthpose.pose.icp import refine_roughly
from depthpose.pose.mesh import true_symmetries
from depthpose.pose.propose.point_pairs import prepare_pairs, vote_poses
from depthpose.pose.types import ObjectModel

_SELF_REFERENCES = 40
"""Points of the model that vote with each of the others."""
_SELF_PEAKS = 48
"""Motions that each of these points proposes."""
_SELF_COMPARED = 250
"""Points of the surface by which motions are compared."""
_LEAST_SHARE = 0.25
"""Share of the surface that a motion must move onto the surface, at least."""
_LEAST_OF_BEST = 0.85
"""That share over the share of the best motion, at least."""
_NEAR_SYMMETRY = 0.8
"""Share from which a motion is a near-symmetry, and may differ little from another motion."""
_MIN_COSINE = 0.7
"""Least cosine between the normal of a moved point and that of the surface there."""
_APART_RAD = math.radians(12)
"""Least angle of a near-symmetry from better motions."""
_FAR_APART_RAD = 5 * _APART_RAD
"""The same of any other motion."""
_MOST_MOTIONS = 36
"""Largest number of motions that are kept."""


def find_partial_symmetries(model: ObjectModel) -> dict[str, Any]:
    """Find the motions after which a part of a model's surface lies on itself; symmetries left out.

    A mug has them about its axis: but for its handle it looks alike. A bracket has half turns,
    after which half of it lies on itself.

    Returns:
        JSON values: ``turns``, 4x4 matrices ``model_from_model`` in metres, the best first, and
        ``near``, how many of the first ones are near-symmetries, with 80 % of the surface or more.
    """
    # Motions that pairs of points vote for.
    surface = prepare_surface(replace(model, symmetries=true_symmetries(model)))
    table = prepare_pairs(surface)
    # References from all sides, not from the first faces alone.
    references = take_evenly(torch.arange(len(table.points_m)), _SELF_REFERENCES)
    normals = table.bases[..., 0]
    candidates, _ = vote_poses(table.points_m, normals, references, table, _SELF_PEAKS)
    candidates = candidates[_choose_partial_symmetries(candidates, surface).indices]

    # Refined as poses before a camera in the middle of the model, from where all is visible.
    points_m = surface.points_m - surface.middle_m
    starts = Rigid(candidates.R, candidates.t_m - surface.middle_m)
    candidates = refine_roughly(points_m, starts, surface)
    candidates = Rigid(candidates.R, candidates.t_m + surface.middle_m)
    candidates = candidates[_choose_partial_symmetries(candidates, surface).indices]

    # Products of two are candidates too, which fill gaps between those that were found.
    products = candidates[:, None] @ candidates
    products = Rigid(products.R.flatten(0, 1), products.t_m.flatten(0, 1))
    candidates = Rigid.cat([candidates, products])
    choice = _choose_partial_symmetries(candidates, surface)
    matrices = candidates[choice.indices].matrix()
    return {"turns": matrices.tolist(), "near": choice.near_symmetries}


class _Choice(NamedTuple):
    """Motions that are chosen among others."""

    indices: list[int]  #: the best first
    near_symmetries: int  #: how many of the first ones are near-symmetries


def _choose_partial_symmetries(motions: Rigid, surface: Surface) -> _Choice:
    """Choose the motions that move the largest share of a surface onto itself.

    None is within 12 degrees of a better one, of a symmetry, or of a product of these; one that is
    no near-symmetry is not within 60 degrees, since any small motion leaves the surface near
    itself.
    """
    share = _measure_shared_surface(motions, surface)
    chosen: list[int] = []
    excluded_R = surface.symmetries.R  # of symmetries, and of chosen motions after them
    for k in share.argsort(descending=True).tolist():
        best_share = float(share[chosen[0]]) if chosen else 0.0
        least_share = max(_LEAST_OF_BEST * best_share, _LEAST_SHARE)
        if share[k] < least_share or len(chosen) == _MOST_MOTIONS:
            break
        limit_rad = _APART_RAD if share[k] >= _NEAR_SYMMETRY else _FAR_APART_RAD
        R = motions.R[k]
        if float(geodesic_rad(R.expand_as(excluded_R), excluded_R).min()) > limit_rad:
            chosen.append(k)
            excluded_R = torch.cat([excluded_R, R @ surface.symmetries.R])
    return _Choice(chosen, int((share[chosen] >= _NEAR_SYMMETRY).sum()))


def _measure_shared_surface(motions: Rigid, surface: Surface) -> Float64[Tensor, " b"]:
    """Measure the share of a surface that each motion moves onto the surface."""
    step = max(1, len(surface.points_m) // _SELF_COMPARED)
    local_m = motions.inverse().apply(surface.points_m[::step])
    nearest = surface.nearest(local_m, is_exact=False)
    is_near = nearest.distance_m < surface.near_m
    cosine = ((surface.normals[nearest.sample] @ motions.R.mT) * surface.normals[::step]).sum(-1)
    return (is_near & (cosine.abs() > _MIN_COSINE)).double().mean(-1)
