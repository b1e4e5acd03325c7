"""Symmetries found in a shape, near-symmetries, and how far it is from its mirror image."""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError
from depthpose.core.files import cache_folder, read_json, write_json
from depthpose.core.rigid import Rigid, fit_rigid, geodesic_rad
from depthpose.pose.mesh.models import (
    fibonacci_directions,
    sample_surface,
    symmetry_transforms,
    turn_about,
)
from depthpose.pose.types import Axis, ObjectModel, Symmetries


_EYE = torch.eye(3, dtype=torch.float64)
_COARSE_ORDERS = (2, 3, 4, 5, 6)  # of rotations that are tried in all directions
_ORDERS = range(2, 13)  # of rotations that are measured about an axis
_TEETH = range(13, 61)  #: orders of which one step is tried: gears and knurls
_CIRCLE_TURNS = 36  # by which a full circle is measured
_NEAREST_SAMPLES = 4  # of the surface, that are compared with a point in an exact measure
_MAX_ROUGH_DEVIATION = 0.04
"""Deviation, in diameters, from which ICP may still reach a symmetry: an axis that is off by 4
degrees moves the surface by about as much."""
_SAME_RAD = 0.15  # angle up to which two axes or rotations are the same
_SUPPRESSION_RAD = 0.25  # angle up to which a rotation about one axis is that of a better one
SURE = 0.5  #: certainty from which a proposal is accepted: that of a deviation of the tolerance
_MOST_GROUP = 60  # discrete symmetries of an icosahedron: no group of a body is larger
_FOLLOW_STEPS = 15  # steps of ICP
_MOST_AXES = 40  # a cube has 13 axes, an icosahedron 31
_DIRECTIONS = 400  # of axes that are tried, beside the principal ones


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
    circle about the principal axes and about 400 directions are measured coarsely; the promising
    ones are refined by ICP to an exact axis; about it, rotations of order 2 to 12 and a full circle
    are measured. Texture does not count. Bumps smaller than the tolerance are overlooked, so that
    the handle of a cup breaks a symmetry and its seam does not. Takes some seconds. A sphere is
    reported as two axes of revolution.

    Args:
        model: the object.
        tolerance: deviation in diameters at which the certainty is one half.

    Returns:
        Proposals of a certainty of 1/5 and more, continuous first, then the surest.
    """
    surface = _prepare_surface(model)
    limit = 2 * tolerance
    proposals: list[SymmetryProposal] = []
    tried_axes: list[Tensor] = []
    revolution_axes: list[Tensor] = []
    for coarse in _find_promising_turns(surface):
        if len(revolution_axes) >= 2 or len(tried_axes) >= _MOST_AXES:
            break
        if _is_covered(_find_axis(coarse), tried_axes, revolution_axes):
            continue

        # Refined to an exact axis, about which all rotations are measured.
        axis = _find_axis(_follow_surface(surface, coarse))
        if not _is_covered(axis, tried_axes, revolution_axes):
            tried_axes.append(axis)
            measured = _measure_axis(surface, axis, limit, tolerance)
            revolution_axes += [axis for p in measured if p.kind == "continuous"]
            proposals += measured
    return sorted(proposals, key=lambda p: (p.kind != "continuous", -p.certainty))


def _find_axis(R: Tensor) -> Tensor:
    """Find the direction that a rotation leaves alone; well defined for half turns too."""
    return torch.linalg.svd(R - _EYE).Vh[-1]


def _follow_surface(surface: SurfaceDeviation, R: Tensor) -> Tensor:
    """Refine a rotation that nearly maps a surface onto itself, by ICP about the fixed centre."""
    weight = torch.ones(2 * len(surface.many), dtype=torch.float64)
    previous = None
    for _ in range(_FOLLOW_STEPS):
        _, index = surface.nearest(surface.many @ R.mT)
        if previous is not None and np.array_equal(index, previous):
            break  # the same neighbours give the same rotation
        previous = index
        target = surface.points[torch.from_numpy(index)]
        # With each point its mirror image through the centre, the fit cannot shift.
        source_pairs = torch.cat([surface.many, -surface.many])
        target_pairs = torch.cat([target, -target])
        R = fit_rigid(source_pairs, target_pairs, weight).R
    return R


def symmetries_from_proposals(proposals: list[SymmetryProposal]) -> Symmetries:
    """Make symmetries of the certain proposals.

    They are axes of revolution, and rotations that do not follow from an axis. Without an axis the
    rotations are completed to a group, for the product of two symmetries is one.
    """
    # The axes of the certain ones.
    sure = [p for p in proposals if p.certainty >= SURE]
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
    apart = [float((turn.R @ a.direction - other.R @ a.direction).norm()) for a in axes]
    return any(distance < _SAME_RAD for distance in apart)


def _complete_group(turns: list[Rigid]) -> list[Rigid]:
    """Add products of rotations until there is no new one; the rotations alone where that fails."""
    group = list(turns)
    for first in group:  # the list grows while it is read
        for second in turns:
            product = first @ second
            rotations = [_EYE, *(turn.R for turn in group)]
            if all(float(geodesic_rad(product.R, R)) > _SAME_RAD for R in rotations):
                group.append(product)
        if len(group) > _MOST_GROUP:
            return turns
    return group


def with_found_symmetries(
    model: ObjectModel,
    on_message: Callable[[str], None] | None,
    *,
    is_taken: bool,
    tolerance: float = 0.02,
) -> ObjectModel:
    """Search the symmetries of a model that declares none; give the model with them, if wanted.

    They are searched once for each shape, and kept in ``$DEPTHPOSE_CACHE``.

    Args:
        model: the object.
        on_message: called with a sentence on symmetries that were found; without it nothing is
            searched where ``is_taken`` is false.
        is_taken: whether the model gets the symmetries.
        tolerance: as of :func:`propose_symmetries`.
    """
    declared = model.symmetries
    if not (is_taken or on_message) or declared.discrete is not None or declared.continuous:
        return model

    # What the shape has.
    rows = cached(model, propose_symmetries, "symmetries", tolerance)
    proposals = [SymmetryProposal(*row) for row in rows]
    symmetries = replace(symmetries_from_proposals(proposals), is_found=True)
    if symmetries.discrete is None and not symmetries.continuous:
        return model

    # Said, and taken if wanted.
    turns = 0 if symmetries.discrete is None else len(symmetries.discrete.R)
    certainty = min(p.certainty for p in proposals if p.certainty >= SURE)
    if on_message is not None:
        on_message(
            f"{model.name}: looks the same after {turns} turns, about "
            f"{len(symmetries.continuous)} axes (certainty {certainty:.2f} and more); "
            + (
                "each copy counts as right"
                if is_taken
                else "if that is so, say --symmetries found: no network can distinguish the copies"
            )
        )
    return replace(model, symmetries=symmetries) if is_taken else model


def _rotate_about(
    direction: Float[Tensor, "3"], angles: Float[Tensor, " a"]
) -> Float[Tensor, "a 3 3"]:
    """Make the rotation matrices about a direction by each angle."""
    return turn_about(direction, torch.zeros_like(direction), angles).R


@lru_cache(maxsize=4)
def _find_promising_turns(surface: SurfaceDeviation) -> tuple[Float[Tensor, "3 3"], ...]:
    """Find the rotations about principal axes and many directions that fit roughly, best first."""
    directions = torch.cat([surface.axes, fibonacci_directions(_DIRECTIONS)])
    angles = torch.tensor([2 * math.pi / order for order in _COARSE_ORDERS], dtype=torch.float64)
    rotations = torch.stack([_rotate_about(direction, angles) for direction in directions])
    rotations = rotations.flatten(0, 1)
    distance = surface.rough_distance(rotations)
    order = distance.argsort().tolist()
    return tuple(rotations[i] for i in order if distance[i] <= _MAX_ROUGH_DEVIATION)


def _is_covered(direction: Tensor, tried_axes: list[Tensor], revolution_axes: list[Tensor]) -> bool:
    """Whether an axis was tried, or is equivalent to one that was.

    All lines at right angles to an axis of revolution are equivalent.
    """
    is_tried = any(abs(float(direction @ tried)) > math.cos(_SAME_RAD) for tried in tried_axes)

    def are_perpendicular(first: Tensor, second: Tensor) -> bool:
        """Whether two lines are at right angles."""
        return abs(float(first @ second)) < math.sin(_SAME_RAD)

    # Is there an axis of revolution across both this line and one that was tried?
    across = [axis for axis in revolution_axes if are_perpendicular(axis, direction)]
    is_equivalent = any(are_perpendicular(axis, tried) for axis in across for tried in tried_axes)
    return is_tried or is_equivalent


def _measure_axis(
    surface: SurfaceDeviation, direction: Tensor, limit: float, tolerance: float
) -> list[SymmetryProposal]:
    """Measure the rotations about an axis; give those within ``limit``, in diameters.

    They are the full circle and, unless that is within the tolerance, rotations of order 2 to 12;
    and a rotation by one of many teeth.
    """
    # The full circle, as an angle of None with its deviation.
    step = 2 * math.pi / _CIRCLE_TURNS
    circle = _rotate_about(direction, torch.arange(1, _CIRCLE_TURNS) * step)
    full: list[tuple[None, float]] = []
    worst = math.inf
    if bool((surface.rough_distance(circle) <= _MAX_ROUGH_DEVIATION).all()):
        worst = float(surface.deviation(circle).max())
        full = [(None, worst)] if worst <= limit else []

    # Else single rotations, as angles with their deviations.
    turns = _measure_orders(surface, direction, limit) if worst > tolerance else []
    teeth = [] if full else _measure_teeth(surface, direction, tolerance)
    return [
        SymmetryProposal(
            kind="continuous" if angle is None else "discrete",
            direction=direction.tolist(),
            point_m=surface.centre_m.tolist(),
            angle_rad=angle,
            deviation=value,
            certainty=1 / (1 + (value / tolerance) ** 2),
        )
        for angle, value in (*full, *turns, *teeth)
    ]


def _measure_orders(
    surface: SurfaceDeviation, direction: Tensor, limit: float
) -> list[tuple[float, float]]:
    """Measure rotations of order 2 to 12; give angle and deviation of the best within ``limit``."""
    # Those that fit roughly.
    shares = sorted({k / order for order in _ORDERS for k in range(1, order)})
    angles = torch.tensor(shares, dtype=torch.float64) * (2 * math.pi)
    rough = surface.rough_distance(_rotate_about(direction, angles))
    angles = angles[rough <= _MAX_ROUGH_DEVIATION]
    if len(angles) == 0:
        return []

    # The best of each symmetry.
    deviation = surface.deviation(_rotate_about(direction, angles))
    chosen: list[tuple[float, float]] = []
    for i in deviation.argsort().tolist():
        angle = float(angles[i])
        # A rotation near a better one is the same symmetry (non-maximum suppression).
        is_suppressed = any(abs(angle - better) < _SUPPRESSION_RAD for better, _ in chosen)
        if float(deviation[i]) <= limit and not is_suppressed:
            chosen.append((angle, float(deviation[i])))
    return chosen


def _measure_teeth(
    surface: SurfaceDeviation, direction: Tensor, tolerance: float
) -> list[tuple[float, float]]:
    """Measure rotations by one of many teeth, which fit, and between teeth, which do not.

    Gives angle and deviation of the number of teeth that fits best; an empty list where none does.
    """
    measured: list[tuple[float, float]] = []
    for order in _TEETH:
        step = 2 * math.pi / order
        angles = torch.tensor([step, 0.5 * step, 1.5 * step], dtype=torch.float64)
        tooth_R, *between_R = _rotate_about(direction, angles)
        if float(surface.rough_distance(tooth_R)) > _MAX_ROUGH_DEVIATION:
            continue
        # The fast lower bound first.
        turn = Rigid(tooth_R, torch.zeros(3, dtype=torch.float64))
        if float(surface.deviation_one_way(turn)) > tolerance:
            continue
        tooth_deviation = float(surface.deviation(tooth_R))
        if tooth_deviation > tolerance:
            continue
        between_deviation = float(surface.deviation(torch.stack(between_R)).min())
        if between_deviation > 2 * tooth_deviation + ALIKE:
            measured.append((step, tooth_deviation))
    return sorted(measured, key=lambda pair: pair[1])[:1]
