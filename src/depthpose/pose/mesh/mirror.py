"""How far a model is from its mirror image."""

import math

import torch
from jaxtyping import Float64
from torch import Tensor

from depthpose.core.rigid import geodesic_rad
from depthpose.pose.mesh.cache import cached
from depthpose.pose.mesh.deviation import measure_surface, refine_turn
from depthpose.pose.mesh.models import fibonacci_directions
from depthpose.pose.types import ObjectModel

MIRROR_ALIKE = 0.03
"""Deviation in diameters up to which the mirror image is as good as the model: as much as the size
of an object may differ."""
_MIRROR_PLANES = 400
_MIRROR_STARTS = 8
_MIN_START_DISTANCE_RAD = math.radians(25)
_ICP_STEPS = 20
_ICP_SHARE = 0.9  # points that count in each step of ICP
_FLIP = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))


def mirror_deviation(model: ObjectModel) -> float:
    """Measure how far the mirror image of a model deviates from it, in diameters.

    The mirror image is aligned with the model by ICP, from the best of 400 mirror planes and
    rotary reflections. The deviation is the largest distance, without the farthest 2 % of the
    points. It takes about a second, once for each shape: it is kept in ``$DEPTHPOSE_CACHE``.

    Args:
        model: the object, a mesh or points with normals.
    """
    return float(cached(model, _search_mirror, "mirror_deviation"))


def _search_mirror(model: ObjectModel) -> float:
    """Search the least deviation of a surface from its mirror images, in diameters."""
    surface = _prepare_surface(model)
    # Reflections across planes with normal n, followed by rotations about n by 0, 90, 180 and 270
    # degrees: cos (1 - nn') + sin [n] - nn'. The best that are distinct are the starts.
    normals = torch.cat([surface.axes, fibonacci_directions(_MIRROR_PLANES)])
    along = normals[:, :, None] * normals[:, None]
    across = _EYE - along
    crossed = torch.linalg.cross(normals[:, None], _EYE[None])
    quarter_turns = ((1, 0), (0, 1), (-1, 0), (0, -1))  # cosine and sine
    reflections = torch.cat([c * across + s * crossed - along for c, s in quarter_turns])
    starts: list[Float64[Tensor, "3 3"]] = []
    for k in surface.rough_distance(reflections).argsort().tolist():
        if len(starts) == _MIRROR_STARTS:
            break
        apart_rad = [float(geodesic_rad(reflections[k], start)) for start in starts]
        if all(angle_rad > _MIN_START_DISTANCE_RAD for angle_rad in apart_rad):
            starts.append(reflections[k])

    # Each is refined.
    refined = [refine_turn(surface, R @ _FLIP, _FLIP) for R in starts]
    R = torch.stack([motion.R for motion in refined]) @ _FLIP
    shift = torch.stack([motion.t_m for motion in refined])
    return float(surface.deviation(R, shift).min())
