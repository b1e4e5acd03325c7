"""Symmetries found in a shape: rotations after which its surface lies on itself."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.rigid import Rigid, fit_rigid, geodesic_rad
from depthpose.pose.mesh.cache import read_or_compute
from depthpose.pose.mesh.deviation import SurfaceDeviation, sample_deviation
from depthpose.pose.mesh.models import fibonacci_directions, turn_about
from depthpose.pose.types import Axis, ObjectModel, Symmetries

_EYE = torch.eye(3, dtype=torch.float64)
_COARSE_ORDERS = (2, 3, 4, 5, 6)  # of rotations that are tried in all directions
_DIRECTIONS = 400  # of axes that are tried, beside the principal ones
_MAX_ROUGH_DEVIATION = 0.04
"""Mean deviation, in diameters, from which ICP may still reach a symmetry: an axis that is off by 4
degrees moves the surface by about as much."""
_ICP_STEPS = 15
_SAME_RAD = 0.15  # angle up to which two axes or rotations are the same
_MOST_AXES = 40  # a cube has 13 axes, an icosahedron 31

# Rotations about one axis.
_CIRCLE_TURNS = 36  # by which a full circle is measured
_ORDERS = range(2, 13)  # of rotations that are measured one by one
_SUPPRESSION_RAD = 0.25  # angle up to which a rotation is that of a better one
_TEETH = range(13, 61)  # orders of which one step is tried: gears and knurls
_TOOTH_CONTRAST = 0.004  # diameters by which a rotation between teeth must deviate more

_SURE = 0.5  # certainty from which a proposal is accepted: that of a deviation of the tolerance
_MOST_GROUP = 2 * max(_TEETH)  # of a wheel whose sides are alike; an icosahedron has 60
_SAME_STEPS = 0.4  # share of the smallest rotation up to which two rotations are the same


class SymmetryProposal(NamedTuple):
    """A rotation after which an object may look alike, in numbers that JSON holds."""

    kind: str  #: ``discrete`` or ``continuous``
    direction: Sequence[float]  #: unit vector of the axis
    point_m: Sequence[float]  #: a point on the axis
    angle_rad: float | None  #: of the rotation; None for a continuous symmetry
    #: largest distance of the rotated surface from the surface, in diameters, without the farthest
    #: 2 % of the points; for ``continuous`` over all rotations.
    deviation: float
    certainty: float  #: 1 for an exact copy, 1/2 at the tolerance, toward 0 beyond


def propose_symmetries(model: ObjectModel, tolerance: float = 0.02) -> list[SymmetryProposal]:
    """Search for rotations that leave the shape as it is, each with a certainty.

    Every symmetry leaves the centre of the surface where it is. Rotations by 1/2 to 1/6 of the
    circle about the principal axes and about 400 directions are measured roughly; those that fit
    are refined by ICP to an exact axis; about it, rotations of order 2 to 12 and a full circle are
    measured. Texture does not count. Bumps smaller than the tolerance are overlooked, so that the
    handle of a cup breaks a symmetry and its seam does not. Takes some seconds. A sphere is
    reported as two axes of revolution.

    Args:
        model: the object.
        tolerance: deviation in diameters at which the certainty is one half.

    Returns:
        Proposals of a certainty of 1/5 and more, continuous first, then the surest.
    """
    surface = sample_deviation(model)
    proposals: list[SymmetryProposal] = []
    tried_axes: list[Tensor] = []
    revolution_axes: list[Tensor] = []
    for rough_R in find_rough_symmetries(surface):
        if len(revolution_axes) >= 2 or len(tried_axes) >= _MOST_AXES:
            break
        if _is_covered(_find_axis(rough_R), tried_axes, revolution_axes):
            continue

        # Refined to an exact axis, about which all rotations are measured.
        axis = _find_axis(_refine_about_centre(surface, rough_R))
        if not _is_covered(axis, tried_axes, revolution_axes):
            tried_axes.append(axis)
            about_axis = _propose_about_axis(surface, axis, tolerance)
            revolution_axes += [axis for p in about_axis if p.kind == "continuous"]
            proposals += about_axis
    return sorted(proposals, key=lambda p: (p.kind != "continuous", -p.certainty))


def _find_axis(R: Tensor) -> Tensor:
    """Find the axis of a rotation, the direction that it leaves as it is; of half turns too."""
    return torch.linalg.svd(R - _EYE).Vh[-1]


def _refine_about_centre(surface: SurfaceDeviation, R: Tensor) -> Tensor:
    """Refine a rotation that nearly maps a surface onto itself, by ICP about the fixed centre."""
    points = surface.compared_points
    weight = torch.ones(2 * len(points), dtype=torch.float64)
    previous = None
    for _ in range(_ICP_STEPS):
        _, index = surface.find_nearest(points @ R.mT)
        if previous is not None and np.array_equal(index, previous):
            break  # the same neighbours give the same rotation
        previous = index
        target = surface.points[torch.from_numpy(index)]
        # With each point its mirror image through the centre, the fit cannot shift.
        source_pairs = torch.cat([points, -points])
        target_pairs = torch.cat([target, -target])
        R = fit_rigid(source_pairs, target_pairs, weight).R
    return R


def symmetries_from_proposals(proposals: list[SymmetryProposal]) -> Symmetries:
    """Make symmetries of the proposals of a certainty of one half and more.

    They are axes of revolution, and rotations that do not follow from an axis. Without an axis the
    rotations are completed to a group, for the product of two symmetries is one.
    """
    sure = [p for p in proposals if p.certainty >= _SURE]
    lines = [
        Axis(
            direction=torch.tensor(p.direction, dtype=torch.float64),
            point_m=torch.tensor(p.point_m, dtype=torch.float64),
        )
        for p in sure
    ]
    axes = tuple(line for line, p in zip(lines, sure, strict=True) if p.kind == "continuous")

    # Rotations that follow neither from an axis nor from an earlier rotation.
    turns: list[Rigid] = []
    for line, proposal in zip(lines, sure, strict=True):
        if proposal.angle_rad is None:
            continue
        angle_rad = torch.tensor(proposal.angle_rad, dtype=torch.float64)
        turn = turn_about(line.direction, line.point_m, angle_rad)
        if not any(_are_equivalent(turn, earlier, axes) for earlier in turns):
            turns.append(turn)
    if not turns:
        return Symmetries(continuous=axes)

    group = turns if axes else _complete_group(turns)
    return Symmetries(discrete=Rigid.stack(group), continuous=axes)


def _are_equivalent(turn: Rigid, other: Rigid, axes: Sequence[Axis]) -> bool:
    """Whether two rotations are the same, or differ by a rotation about an axis of revolution."""
    if float(geodesic_rad(turn.R, other.R)) < _SAME_RAD:
        return True
    # Two that move an axis alike differ by a rotation about it.
    for axis in axes:
        change = turn.R @ axis.direction - other.R @ axis.direction
        if float(change.norm()) < _SAME_RAD:
            return True
    return False


def _complete_group(turns: list[Rigid]) -> list[Rigid]:
    """Add products of rotations until there is no new one; the rotations alone where that fails."""
    smallest_rad = min(float(geodesic_rad(turn.R, _EYE)) for turn in turns)
    same_rad = min(_SAME_RAD, _SAME_STEPS * smallest_rad)
    group = list(turns)
    for first in group:  # the list grows while it is read
        for second in turns:
            product = first @ second
            rotations = torch.stack([_EYE, *(turn.R for turn in group)])
            if float(geodesic_rad(product.R.expand_as(rotations), rotations).min()) > same_rad:
                group.append(product)
        if len(group) > _MOST_GROUP:
            return turns
    return group


def with_found_symmetries(model: ObjectModel, tolerance: float = 0.02) -> ObjectModel:
    """Search the symmetries of a model that declares none, and return it with those of its shape.

    They are searched once for each shape, and kept in ``$DEPTHPOSE_CACHE``. ``tolerance`` is that
    of :func:`propose_symmetries`.
    """
    if not model.symmetries.is_none:
        return model
    rows = read_or_compute(model, propose_symmetries, "symmetries", tolerance)
    symmetries = symmetries_from_proposals([SymmetryProposal(*row) for row in rows])
    if symmetries.is_none:
        return model
    return replace(model, symmetries=replace(symmetries, is_found=True))


def describe_found_symmetries(
    models: Sequence[ObjectModel], searched: Sequence[ObjectModel], *, are_used: bool
) -> list[str]:
    """Describe the symmetries that a search found, in a sentence for each model that has some.

    Args:
        models: as they were before the search.
        searched: the same after it, by :func:`with_found_symmetries`.
        are_used: whether the symmetries stay, so that each copy counts as right.
    """
    consequence = "each copy counts as right"
    if not are_used:
        consequence = "if that is so, say --symmetries found: no network can distinguish the copies"
    sentences: list[str] = []
    for before, model in zip(models, searched, strict=True):
        symmetries = model.symmetries
        if before.symmetries.is_none and symmetries.is_found:
            turns = 0 if symmetries.discrete is None else len(symmetries.discrete.R)
            sentences.append(
                f"{model.name}: looks the same after {turns} turns, and after any turn about "
                f"{len(symmetries.continuous)} axes; {consequence}"
            )
    return sentences


def rotations_about(
    direction: Float[Tensor, "3"], angles_rad: Float[Tensor, " a"]
) -> Float[Tensor, "a 3 3"]:
    """Make the rotation matrices about an axis of some direction by each angle."""
    return turn_about(direction, torch.zeros_like(direction), angles_rad).R


@lru_cache(maxsize=4)
def find_rough_symmetries(surface: SurfaceDeviation) -> tuple[Float[Tensor, "3 3"], ...]:
    """Find rotations of order 2 to 6 after which a surface lies roughly on itself, the best first.

    Their axes are the principal ones and 400 directions.
    """
    directions = torch.cat([surface.axes, fibonacci_directions(_DIRECTIONS)])
    angles = torch.tensor([2 * math.pi / order for order in _COARSE_ORDERS], dtype=torch.float64)
    rotations = torch.cat([rotations_about(direction, angles) for direction in directions])
    distance = surface.rough_distance(rotations)
    by_distance = distance.argsort().tolist()
    return tuple(rotations[i] for i in by_distance if distance[i] <= _MAX_ROUGH_DEVIATION)


def _is_covered(direction: Tensor, tried_axes: list[Tensor], revolution_axes: list[Tensor]) -> bool:
    """Whether an axis was tried, or is equivalent to one that was.

    All lines at right angles to an axis of revolution are equivalent.
    """
    if any(abs(float(direction @ tried)) > math.cos(_SAME_RAD) for tried in tried_axes):
        return True
    # Is there an axis of revolution across both this line and one that was tried?
    across = [axis for axis in revolution_axes if _are_perpendicular(axis, direction)]
    return any(_are_perpendicular(axis, tried) for axis in across for tried in tried_axes)


def _are_perpendicular(first: Tensor, second: Tensor) -> bool:
    """Whether two lines, given by unit vectors, are about at right angles."""
    return abs(float(first @ second)) < math.sin(_SAME_RAD)


class _MeasuredTurn(NamedTuple):
    """A rotation about an axis, and how far the surface lies off itself then."""

    angle_rad: float | None  #: None: all rotations, of which the worst is measured
    deviation: float  #: in diameters


def _propose_about_axis(
    surface: SurfaceDeviation, direction: Tensor, tolerance: float
) -> list[SymmetryProposal]:
    """Propose the rotations about an axis that deviate by less than twice the tolerance.

    They are the full circle and, unless that is within the tolerance, rotations of order 2 to 12;
    and, unless the full circle is proposed, a rotation by one of many teeth.
    """
    limit = 2 * tolerance
    worst = _measure_full_circle(surface, direction)
    turns = [_MeasuredTurn(None, worst)] if worst <= limit else []
    if worst > tolerance:
        turns += _measure_orders(surface, direction, limit)
    if worst > limit:
        turns += _measure_teeth(surface, direction, tolerance)
    return [
        SymmetryProposal(
            kind="continuous" if turn.angle_rad is None else "discrete",
            direction=direction.tolist(),
            point_m=surface.centre_m.tolist(),
            angle_rad=turn.angle_rad,
            deviation=turn.deviation,
            certainty=1 / (1 + (turn.deviation / tolerance) ** 2),
        )
        for turn in turns
    ]


def _measure_full_circle(surface: SurfaceDeviation, direction: Tensor) -> float:
    """Measure the largest deviation of all rotations about an axis; infinite if one fits badly."""
    step = 2 * math.pi / _CIRCLE_TURNS
    circle = rotations_about(direction, torch.arange(1, _CIRCLE_TURNS) * step)
    if bool((surface.rough_distance(circle) > _MAX_ROUGH_DEVIATION).any()):
        return math.inf
    return float(surface.deviation(circle).max())


def _measure_orders(
    surface: SurfaceDeviation, direction: Tensor, limit: float
) -> list[_MeasuredTurn]:
    """Measure rotations of order 2 to 12, and choose the best of each symmetry within ``limit``.

    Rotations by multiples of a step are several symmetries.
    """
    # Those that fit roughly.
    shares = sorted({k / order for order in _ORDERS for k in range(1, order)})
    angles = torch.tensor(shares, dtype=torch.float64) * (2 * math.pi)
    rough = surface.rough_distance(rotations_about(direction, angles))
    angles = angles[rough <= _MAX_ROUGH_DEVIATION]
    if len(angles) == 0:
        return []

    # The best of each symmetry: one near a better one is the same (non-maximum suppression).
    deviation = surface.deviation(rotations_about(direction, angles))
    chosen_rad: list[float] = []
    chosen: list[_MeasuredTurn] = []
    for i in deviation.argsort().tolist():
        angle_rad = float(angles[i])
        is_suppressed = any(abs(angle_rad - better) < _SUPPRESSION_RAD for better in chosen_rad)
        if float(deviation[i]) <= limit and not is_suppressed:
            chosen_rad.append(angle_rad)
            chosen.append(_MeasuredTurn(angle_rad, float(deviation[i])))
    return chosen


def _measure_teeth(
    surface: SurfaceDeviation, direction: Tensor, tolerance: float
) -> list[_MeasuredTurn]:
    """Measure rotations by one tooth of 13 to 60, which fit where those between teeth do not.

    Returns:
        The rotation that fits best; an empty list where none does.
    """
    measured: list[_MeasuredTurn] = []
    for order in _TEETH:
        step = 2 * math.pi / order
        # A wheel of one tooth more or less looks alike after one tooth, but not after many.
        many = order // 2 * step
        angles = torch.tensor([step, many, 0.5 * step, 1.5 * step], dtype=torch.float64)
        tooth_R, many_R, *between_R = rotations_about(direction, angles)
        if float(surface.rough_distance(tooth_R)) > _MAX_ROUGH_DEVIATION:
            continue
        # A lower bound first, which is faster.
        turn = Rigid(tooth_R, torch.zeros(3, dtype=torch.float64))
        if float(surface.deviation_one_way(turn)) > tolerance:
            continue
        tooth_deviation = float(surface.deviation(torch.stack([tooth_R, many_R])).max())
        if tooth_deviation > tolerance:
            continue
        between_deviation = float(surface.deviation(torch.stack(between_R)).min())
        if between_deviation > 2 * tooth_deviation + _TOOTH_CONTRAST:
            measured.append(_MeasuredTurn(step, tooth_deviation))
    return sorted(measured, key=lambda turn: turn.deviation)[:1]
