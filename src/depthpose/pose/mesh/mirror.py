"""How far the mirror image of a model is from it: whether a left and a right part differ."""

import math

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from depthpose.core.rigid import Rigid, fit_rigid, geodesic_rad
from depthpose.pose.mesh.kept import kept
from depthpose.pose.mesh.propose import SurfaceDeviation
from depthpose.pose.mesh.sampling import fibonacci_directions
from depthpose.pose.types import ObjectModel

MIRROR_ALIKE = 0.03
"""Deviation in diameters up to which the mirror image is as good as the model: as much as the size
of an object may differ."""
_DIRECTIONS = 400
_STARTS = 8
_APART_RAD = math.radians(25)
_STEPS = 20
_NEAREST = 0.9
"""Points that count in each step of ICP."""
_FLIP = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))


def mirror_deviation(model: ObjectModel) -> float:
    """Measure how far the mirror image of a model deviates from it, in diameters.

    The mirror image is laid on the model by ICP from the best of 400 mirror planes and rotary
    reflections; the deviation is the largest distance but for 2 % of the points. It takes about a
    second, once for each shape: it is kept in ``$DEPTHPOSE_CACHE``.

    Args:
        model: the object, a mesh or points with normals.
    """
    return kept(model, "mirror_deviation", _deviation, float)


def _deviation(model: ObjectModel) -> float:
    surface = SurfaceDeviation(model)
    found = [slid(surface, R @ _FLIP, _FLIP) for R in _starts(surface)]
    R, shift = torch.stack([t.R for t in found]) @ _FLIP, torch.stack([t.t_m for t in found])
    return float(surface.deviation(R, shift).min())


def is_mirror_alike(model: ObjectModel) -> bool:
    """Whether the mirror image of a model is the model itself as far as a depth sensor can tell."""
    return mirror_deviation(model) <= MIRROR_ALIKE


def slid(
    surface: SurfaceDeviation, R: Float64[Tensor, "3 3"], flip: Float64[Tensor, "3 3"] | None = None
) -> Rigid:
    """Refine the turn of a surface about the middle of its box onto itself (ICP).

    Args:
        surface: of the model.
        R: where it begins.
        flip: turns the points before; a reflection lays the mirror image on the surface.
    """
    points = surface.many if flip is None else surface.many @ flip
    middle = (surface.points.amin(0) + surface.points.amax(0)) / 2
    turn = Rigid(R, middle - (R if flip is None else R @ flip) @ middle)
    for _ in range(_STEPS):
        moved = turn.apply(points)
        distance, index = surface.nearest(moved)
        near = torch.from_numpy(distance <= np.quantile(distance, _NEAREST)).double()
        turn = fit_rigid(points, surface.points[torch.from_numpy(index)], near)
    return turn


def _starts(surface: SurfaceDeviation) -> list[Float64[Tensor, "3 3"]]:
    """Choose reflections, or reflections with a quarter turn or a half, that fit roughly."""
    axes = torch.linalg.eigh(surface.points.T @ surface.points).eigenvectors.T
    normals = torch.cat([axes, fibonacci_directions(_DIRECTIONS)])
    along = normals[:, :, None] * normals[:, None]
    across = torch.eye(3, dtype=torch.float64) - along
    crossed = torch.linalg.cross(normals[:, None], torch.eye(3, dtype=torch.float64)[None])
    # By 0, 90, 180 and 270 degrees about the normal: cos (1 - nn') + sin [n] - nn'.
    turns = [c * across + s * crossed - along for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    every = torch.cat(turns)
    chosen: list[Float64[Tensor, "3 3"]] = []
    for k in surface.rough_distance(every).argsort().tolist():
        if len(chosen) < _STARTS and all(_is_apart(every[k], other) for other in chosen):
            chosen.append(every[k])
    return chosen


def _is_apart(first: Float64[Tensor, "3 3"], second: Float64[Tensor, "3 3"]) -> bool:
    return float(geodesic_rad(first @ _FLIP, second @ _FLIP)) > _APART_RAD
