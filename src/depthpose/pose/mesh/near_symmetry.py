"""Motions after which an object looks nearly as before, and symmetries that are exact."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.mesh.cache import read_or_compute
from depthpose.pose.mesh.deviation import (
    EXACT_SHARE,
    SurfaceDeviation,
    refine_motion,
    sample_deviation,
)
from depthpose.pose.mesh.models import symmetry_transforms
from depthpose.pose.mesh.symmetry import find_rough_symmetries, rotations_about
from depthpose.pose.types import ObjectModel, Symmetries

EXACT_DEVIATION = 0.004
"""Deviation in diameters up to which a symmetry that was found in a shape is exact: as much as a
cylinder of 25 facets deviates whose diameter is its length. A copy that deviates by more, as a
scan's dents or a keyway do, is another pose, though a view may not tell which."""
_EXACT_DEVIATION_M = 0.002
"""The same in metres, of which the smaller counts: a large part has small details."""
_NEAR_TOLERANCE = 0.05
"""Deviation in diameters at which a sensor's noise begins to mask the difference of two poses: real
points of LineMOD and YCB lie 1.4 to 2.6 % of the diameter off the posed surface. Twice as much is
tried."""
_NEAR_SUPPRESSION_RAD = math.radians(35)  # rotations nearer to each other are the same to ICP
_AXIS_STEP_RAD = math.pi / 8  # an axis that nearly is one of revolution counts as eight rotations
_FINE_AXIS_STEP_RAD = math.pi / 36  # half the step of copies from which others must be far
_MOST_NEAR = 24  # near-symmetries that are kept
_STARTS = 24  # rotations that ICP refines
_SECOND_FACTORS = 3  # best motions that the best _STARTS are multiplied by
_CIRCLE_RAD = torch.arange(1, 8, dtype=torch.float64) * (math.pi / 4)  # by which an axis is tested
_EYE = torch.eye(3, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class NearSymmetry:
    """A motion after which the object looks nearly as before."""

    model_from_model: Rigid  #: the motion
    #: largest distance of the moved surface from the surface, in diameters, without the farthest
    #: 2 % of the points.
    deviation: float


class _Exactness(NamedTuple):
    """Which symmetries of a model the surface has exactly."""

    discrete: list[bool]  #: whether each discrete symmetry is exact
    continuous: list[bool]  #: whether each axis is


class _Candidate(NamedTuple):
    """A motion that may be a near-symmetry."""

    deviation: float  #: of the moved surface from itself, in diameters
    motion: Rigid  #: about the surface's centre, its translation in diameters


def near_symmetries(model: ObjectModel) -> tuple[NearSymmetry, ...]:
    """Find the motions that leave a model nearly as it is, those of the least deviation first.

    Those of :func:`true_symmetries`, which make no other pose, are not among them. The search takes
    a few seconds for a new shape, whose motions are then kept in ``$DEPTHPOSE_CACHE``.
    """
    values = read_or_compute(model, _search_near_symmetries, "near_symmetries")
    near: list[NearSymmetry] = []
    for rows, deviation in values["near"]:
        matrix = torch.tensor(rows, dtype=torch.float64)
        motion = Rigid(matrix[:3, :3], matrix[:3, 3])
        near.append(NearSymmetry(model_from_model=motion, deviation=deviation))
    return tuple(near)


def true_symmetries(model: ObjectModel) -> Symmetries:
    """Select the symmetries of a model whose copies count as one pose.

    These are all that were declared. Of those that were found in the geometry, near-symmetries,
    whose copies deviate by more than the smaller of ``EXACT_DEVIATION`` and 2 mm, are left out.
    """
    if not model.symmetries.is_found:
        return model.symmetries
    values = read_or_compute(model, _search_near_symmetries, "near_symmetries")
    return _select_exact(model.symmetries, _Exactness(*values["exact"]))


def _select_exact(symmetries: Symmetries, exactness: _Exactness) -> Symmetries:
    """Select those of found symmetries that are exact; declared ones are all kept."""
    if not symmetries.is_found:
        return symmetries
    discrete = symmetries.discrete
    if discrete is not None:
        is_exact = torch.tensor(exactness.discrete)
        discrete = discrete[is_exact] if any(exactness.discrete) else None
    pairs = zip(symmetries.continuous, exactness.continuous, strict=True)
    continuous = tuple(axis for axis, is_exact in pairs if is_exact)
    return Symmetries(discrete=discrete, continuous=continuous, is_found=True)


def _search_near_symmetries(model: ObjectModel) -> dict[str, Any]:
    """Search near-symmetries of a model, and which of its symmetries the surface has exactly.

    Returns:
        JSON values: ``near``, pairs of a 4x4 matrix ``model_from_model`` in metres and its
        deviation, the best first; and ``exact``, the flags of :class:`_Exactness`.
    """
    # Symmetries that were found, and rotations that nearly are some.
    surface = sample_deviation(model)
    limit = min(EXACT_DEVIATION, _EXACT_DEVIATION_M / model.diameter_m)
    exactness = _measure_exactness(model.symmetries, surface, limit)
    candidates = _measure_deviations(_propose_motions(model.symmetries, surface), surface)

    # Products of the best candidates are candidates too: a can upside down, then about its axis.
    by_deviation = sorted(candidates, key=lambda candidate: candidate.deviation)
    good = [c.motion for c in by_deviation if c.deviation <= _NEAR_TOLERANCE]
    products = [first @ second for first in good[:_STARTS] for second in good[:_SECOND_FACTORS]]
    candidates += _measure_deviations(products, surface)

    # The best, each far from better ones and from all copies of these that look alike.
    exact = _select_exact(model.symmetries, exactness)
    exact_R = symmetry_transforms(exact, _FINE_AXIS_STEP_RAD).R.double()
    better_R = exact_R
    near: list[tuple[list[list[float]], float]] = []
    for deviation, motion in sorted(candidates, key=lambda candidate: candidate.deviation):
        if len(near) == _MOST_NEAR or deviation > 2 * _NEAR_TOLERANCE:
            break
        apart_rad = float(geodesic_rad(motion.R.expand_as(better_R), better_R).min())
        if apart_rad > _NEAR_SUPPRESSION_RAD:
            better_R = torch.cat([better_R, motion.R @ exact_R])
            # From the surface's centre and unit to the model's.
            shift_m = surface.centre_m - motion.R @ surface.centre_m + motion.t_m * model.diameter_m
            near.append((Rigid(motion.R, shift_m).matrix().tolist(), deviation))
    return {"near": near, "exact": exactness}


def _measure_exactness(
    symmetries: Symmetries, surface: SurfaceDeviation, limit: float
) -> _Exactness:
    """Measure which discrete symmetries, and which axes, have copies that lie on the surface.

    ``limit``: their largest deviation, in diameters.
    """
    discrete: list[bool] = []
    if symmetries.discrete is not None:
        R = symmetries.discrete.R.double()
        discrete = (surface.deviation(R, share=EXACT_SHARE) <= limit).tolist()
    continuous: list[bool] = []
    for axis in symmetries.continuous:
        R = rotations_about(axis.direction.double(), _CIRCLE_RAD)
        worst = float(surface.deviation(R, share=EXACT_SHARE).max())
        continuous.append(worst <= limit)
    return _Exactness(discrete, continuous)


def _propose_motions(symmetries: Symmetries, surface: SurfaceDeviation) -> list[Rigid]:
    """Propose motions as near-symmetries: symmetries that were found, and refined rotations.

    Refinement may shift the surface too: a scan whose points are denser on one side has its centre
    where no symmetry has it.
    """
    # Symmetries that were found.
    proposals: list[Rigid] = []
    if symmetries.is_found:
        copies = symmetry_transforms(symmetries, _AXIS_STEP_RAD).R.double()[1:]
        proposals = [Rigid(R, torch.zeros(3).double()) for R in copies]

    # Quarter turns about the principal axes, and the best of many other rotations.
    quarters = torch.arange(1, 4).double() * (math.pi / 2)
    starts = [R for axis in surface.axes for R in rotations_about(axis, quarters)]
    for R in find_rough_symmetries(surface):
        if len(starts) >= _STARTS:
            break
        apart_rad = [float(geodesic_rad(R, start)) for start in (_EYE, *starts)]
        if min(apart_rad) > _NEAR_SUPPRESSION_RAD:
            starts.append(R)

    # Refined, from rotations about the middle of the box.
    for R in starts:
        start = Rigid(R, surface.middle - R @ surface.middle)
        proposals.append(refine_motion(surface, surface.compared_points, start))
    return proposals


def _measure_deviations(motions: list[Rigid], surface: SurfaceDeviation) -> list[_Candidate]:
    """Measure how far each motion moves the surface off itself."""
    if not motions:
        return []
    stacked = Rigid.stack(motions)
    deviations = surface.deviation(stacked.R, stacked.t_m).tolist()
    return [_Candidate(d, motion) for d, motion in zip(deviations, motions, strict=True)]
