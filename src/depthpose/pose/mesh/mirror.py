"""How far the mirror image of a model deviates from it."""

import math

import torch
from jaxtyping import Float64
from torch import Tensor

from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.mesh.cache import read_or_compute
from depthpose.pose.mesh.deviation import SurfaceDeviation, refine_motion, sample_deviation
from depthpose.pose.mesh.models import fibonacci_directions
from depthpose.pose.types import ObjectModel

MIRROR_ALIKE = 0.03
"""Deviation in diameters up to which the mirror image is as good as the model: as much as the size
of an object may differ."""
_PLANES = 400  # mirror planes that are tried, beside those across the principal axes
_STARTS = 8  # reflections that ICP refines
_START_DISTANCE_RAD = math.radians(25)  # least angle between two of them
_QUARTER_TURNS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # cosine and sine of 0, 90, 180, 270 degrees
_EYE = torch.eye(3, dtype=torch.float64)
_FLIP = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))  # the reflection x to -x


def mirror_deviation(model: ObjectModel) -> float:
    """Measure how far the mirror image of a model deviates from it, in diameters.

    The mirror image is aligned with the model by ICP, from the best of 400 mirror planes and
    rotary reflections. The deviation is the largest distance, without the farthest 2 % of the
    points. It takes about a second for a new shape, and is then kept in ``$DEPTHPOSE_CACHE``.

    Args:
        model: the object, a mesh or points with normals.
    """
    return float(read_or_compute(model, _search_mirror, "mirror_deviation"))


def _search_mirror(model: ObjectModel) -> float:
    """Search the least deviation of a surface from its mirror images, in diameters."""
    surface = sample_deviation(model)
    mirrored = surface.compared_points @ _FLIP
    motions: list[Rigid] = []
    for reflection in _choose_reflections(surface):
        # A reflection is the flip, which makes the mirror image, and a rotation of that.
        R = reflection @ _FLIP
        start = Rigid(R, surface.middle - reflection @ surface.middle)
        motions.append(refine_motion(surface, mirrored, start))
    refined = Rigid.stack(motions)
    return float(surface.deviation(refined.R @ _FLIP, refined.t_m).min())


def _choose_reflections(surface: SurfaceDeviation) -> list[Float64[Tensor, "3 3"]]:
    """Choose the reflections and rotary reflections that fit best roughly, each far from the rest.

    A rotary reflection is one across the plane with normal n, followed by a rotation about n:
    ``cos (I - n n^T) + sin [n]_x - n n^T``. Quarter turns are tried.
    """
    n = torch.cat([surface.axes, fibonacci_directions(_PLANES)])
    along = n[:, :, None] * n[:, None]
    across = _EYE - along
    crossed = torch.linalg.cross(n[:, None], _EYE[None])  # [n]_x, but for its sign
    reflections = torch.cat([
        cosine * across + sine * crossed - along for cosine, sine in _QUARTER_TURNS
    ])  # fmt: skip

    chosen: list[Float64[Tensor, "3 3"]] = []
    for k in surface.rough_distance(reflections).argsort().tolist():
        if len(chosen) == _STARTS:
            break
        apart_rad = [float(geodesic_rad(reflections[k], better)) for better in chosen]
        if all(angle_rad > _START_DISTANCE_RAD for angle_rad in apart_rad):
            chosen.append(reflections[k])
    return chosen
