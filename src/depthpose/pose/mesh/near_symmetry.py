"""Motions after which an object looks nearly as before, and symmetries that are exact."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.types import ObjectModel, Symmetries

ALIKE = 0.004
"""Deviation in diameters up to which a symmetry that was found in a shape is exact: as much as a
cylinder of 25 facets deviates. A copy that deviates by more, as a scan's dents or a keyway do, is
another pose, though a view may not tell which."""
ALMOST_ALL = 0.998
"""Share of the surface within ``ALIKE``; a key or a notch is a few percent of it."""
_NEAR_TOLERANCE = 0.05
"""Deviation in diameters at which a sensor's noise begins to mask the difference of two poses: real
points of LineMOD and YCB lie 1.4 to 2.6 % of the diameter off the posed surface. Twice as much is
tried."""
_NEAR_SUPPRESSION_RAD = math.radians(35)  # rotations nearer to each other are the same to ICP
_AXIS_STEP_RAD = math.pi / 8  # an axis that nearly is one of revolution counts as eight rotations
_FINE_AXIS_STEP_RAD = math.pi / 36
_MOST_NEAR = 24  # near-symmetries that are given
_NEAR_STARTS = 24  # rotations that ICP refines


@dataclass(frozen=True, kw_only=True, eq=False)
class NearSymmetry:
    """A motion after which the object looks nearly as before."""

    model_from_model: Rigid  #: the motion
    #: largest distance of the moved surface from the surface, in diameters, without the farthest
    #: 2 % of the points.
    deviation: float


def near_symmetries(model: ObjectModel) -> tuple[NearSymmetry, ...]:
    """Find the motions that leave a model nearly as it is, those of the least deviation first.

    Those of :func:`true_symmetries`, which make no other pose, are not among them. They are
    searched once for each shape, in a few seconds, and kept in ``$DEPTHPOSE_CACHE``.
    """
    near: list[NearSymmetry] = []
    for rows, deviation in cached(model, _search_near_symmetries, "near_symmetries")["near"]:
        matrix = torch.tensor(rows, dtype=torch.float64)
        motion = Rigid(matrix[:3, :3], matrix[:3, 3])
        near.append(NearSymmetry(model_from_model=motion, deviation=deviation))
    return tuple(near)


def true_symmetries(
    model: ObjectModel, alike: tuple[list[bool], list[bool]] | None = None
) -> Symmetries:
    """Select the symmetries whose copies count as one pose.

    These are all that were declared. Of those that were found in the geometry, near-symmetries,
    whose copies deviate by more than ``ALIKE``, are left out.

    Args:
        model: the object.
        alike: which discrete symmetries and which axes deviate by less; None: it is searched.
    """
    symmetries = model.symmetries
    if not symmetries.is_found:
        return symmetries
    if alike is None:
        cached_values = cached(model, _search_near_symmetries, "near_symmetries")
        are_turns_alike, are_axes_alike = cached_values["alike"]
    else:
        are_turns_alike, are_axes_alike = alike
    discrete = symmetries.discrete
    if discrete is not None:
        discrete = discrete[torch.tensor(are_turns_alike)] if any(are_turns_alike) else None
    pairs = zip(symmetries.continuous, are_axes_alike, strict=True)
    continuous = tuple(axis for axis, is_alike in pairs if is_alike)
    return Symmetries(discrete=discrete, continuous=continuous, is_found=True)


def _search_near_symmetries(model: ObjectModel) -> dict[str, Any]:
    """Search near-symmetries of a model, and which of its symmetries the surface has exactly.

    Gives JSON values, which are cached: ``near``, transforms with their deviations, the best first;
    and ``alike``, flags of the discrete and the continuous symmetries.
    """
    # Symmetries that were found, and rotations that nearly are some.
    surface = _prepare_surface(model)
    alike = _find_alike(model.symmetries, surface)
    measured = _measure_deviations(_propose_near_symmetries(model.symmetries, surface), surface)

    # Products of the best candidates are candidates too: a can upside down, then about its axis.
    by_deviation = sorted(measured, key=lambda pair: pair[0])
    good = [motion for deviation, motion in by_deviation if deviation <= _NEAR_TOLERANCE]
    products = [first @ second for first in good[:_NEAR_STARTS] for second in good[:3]]
    measured += _measure_deviations(products, surface)

    # The best, each far from better ones and from all copies of these that look alike.
    same = symmetry_transforms(true_symmetries(model, alike), _FINE_AXIS_STEP_RAD).R.double()
    near: list[tuple[Rigid, float]] = []
    for deviation, motion in sorted(measured, key=lambda pair: pair[0]):
        if len(near) == _MOST_NEAR or deviation > 2 * _NEAR_TOLERANCE:
            break
        better = torch.cat([R @ same for R in (_EYE, *(chosen.R for chosen, _ in near))])
        apart_rad = float(geodesic_rad(motion.R.expand_as(better), better).min())
        if apart_rad > _NEAR_SUPPRESSION_RAD:
            # From the surface's centre and unit to the model's.
            shift_m = surface.centre_m - motion.R @ surface.centre_m + motion.t_m * model.diameter_m
            near.append((Rigid(motion.R, shift_m), deviation))
    rows = [(motion.matrix().tolist(), deviation) for motion, deviation in near]
    return {"near": rows, "alike": alike}


def _find_alike(symmetries: Symmetries, surface: SurfaceDeviation) -> tuple[list[bool], list[bool]]:
    """Find which discrete symmetries, and which axes, have copies that lie on the surface."""
    discrete: list[bool] = []
    if symmetries.discrete is not None:
        R = symmetries.discrete.R.double()
        discrete = (surface.deviation(R, share=ALMOST_ALL) <= ALIKE).tolist()
    circle = torch.arange(1, 8, dtype=torch.float64) * (math.pi / 4)
    continuous: list[bool] = []
    for axis in symmetries.continuous:
        R = _rotate_about(axis.direction.double(), circle)
        continuous.append(float(surface.deviation(R, share=ALMOST_ALL).max()) <= ALIKE)
    return discrete, continuous


def _propose_near_symmetries(symmetries: Symmetries, surface: SurfaceDeviation) -> list[Rigid]:
    """Propose motions as near-symmetries: symmetries that were found, and refined rotations.

    Refinement may shift the surface too: a scan whose points are denser on one side has its centre
    where no symmetry has it.
    """
    # Symmetries that were found.
    candidates: list[Rigid] = []
    if symmetries.is_found:
        copies = symmetry_transforms(symmetries, _AXIS_STEP_RAD).R.double()[1:]
        candidates = [Rigid(R, torch.zeros(3).double()) for R in copies]

    # Refined from quarter turns about the principal axes, and the best of many other rotations.
    quarters = torch.arange(1, 4).double() * (math.pi / 2)
    starts = [R for axis in surface.axes for R in _rotate_about(axis, quarters)]
    for R in _find_promising_turns(surface):
        if len(starts) >= _NEAR_STARTS:
            break
        apart_rad = [float(geodesic_rad(R, start)) for start in (_EYE, *starts)]
        if min(apart_rad) > _NEAR_SUPPRESSION_RAD:
            starts.append(R)
    return candidates + [refine_turn(surface, R) for R in starts]


def _measure_deviations(
    motions: list[Rigid], surface: SurfaceDeviation
) -> list[tuple[float, Rigid]]:
    """Pair each motion with how far it moves the surface off itself, in diameters."""
    if not motions:
        return []
    R = torch.stack([motion.R for motion in motions])
    shift = torch.stack([motion.t_m for motion in motions])
    return list(zip(surface.deviation(R, shift).tolist(), motions, strict=True))
