"""Near-symmetries: turns of a model that a depth sensor hardly distinguishes from none."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.mesh.kept import kept
from depthpose.pose.mesh.mirror import slid
from depthpose.pose.mesh.propose import SurfaceDeviation, promising_turns
from depthpose.pose.mesh.symmetry import symmetry_transforms, turn_about
from depthpose.pose.types import ObjectModel, Symmetries

ALIKE = 0.01
"""Deviation in diameters up to which a symmetry that was found in a scan is one; a copy that
deviates by more differs in dents that are seen from near by, and is another pose."""
_TOLERANCE = 0.05
"""Deviation in diameters at which a sensor's noise begins to mask the difference of two poses: real
points of LineMOD and YCB lie 1.4 to 2.6 % of the diameter off the posed surface. Twice as much is
tried."""
_SUPPRESSION_RAD = math.radians(35)
"""Turns nearer to each other are one: ICP goes from one to the other."""
_STEP = math.pi / 8
"""An axis that nearly is one of revolution counts as eight turns."""
_FINE_STEP = math.pi / 36
_MOST = 24
_STARTS = 24
"""Turns that ICP refines."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NearSymmetry:
    """A turn after which the object looks nearly as before.

    Attributes:
        model_from_model: the turn.
        deviation: distance of the turned surface from the surface, in diameters: the largest but
            for 2 % of the points.
    """

    model_from_model: Rigid
    deviation: float


class _Known(NamedTuple):
    """What is kept of a model.

    Attributes:
        near: turns that nearly look alike.
        alike: which discrete symmetries that were found look alike, and which axes.
    """

    near: tuple[NearSymmetry, ...]
    alike: tuple[list[bool], list[bool]]


def near_symmetries(model: ObjectModel) -> tuple[NearSymmetry, ...]:
    """Find the turns that leave a model nearly as it is, the nearest first.

    Not among them are those of :func:`true_symmetries`, which are no other pose. They are searched
    once for each shape, which takes a second or a few, and kept in ``$DEPTHPOSE_CACHE``.

    Args:
        model: the object, a mesh or points with normals.
    """
    return _look_up(model).near


def true_symmetries(model: ObjectModel) -> Symmetries:
    """Give the symmetries whose copies are one pose.

    Declared ones are all. Of those that were found in the geometry, copies that lie 1 % of the
    diameter and more off the surface are left out: near-symmetries.
    """
    if not model.symmetries.is_found:
        return model.symmetries
    return _true(model.symmetries, _look_up(model).alike)


def _look_up(model: ObjectModel) -> _Known:
    return kept(model, "near_symmetries", _search, _decoded)


def _decoded(found: Any) -> _Known:  # noqa: ANN401
    turns = torch.tensor([matrix for matrix, _ in found["near"]], dtype=torch.float64)
    near = [
        NearSymmetry(model_from_model=Rigid(M[:3, :3], M[:3, 3]), deviation=deviation)
        for M, (_, deviation) in zip(turns.reshape(-1, 4, 4), found["near"], strict=True)
    ]
    discrete, axes = found["alike"]
    return _Known(tuple(near), (discrete, axes))


def _search(model: ObjectModel) -> dict[str, Any]:
    surface = SurfaceDeviation(model)
    alike = _alike(model.symmetries, surface)
    same = symmetry_transforms(_true(model.symmetries, alike), _FINE_STEP).R.double()
    near: list[tuple[Rigid, float]] = []
    for off, turn in sorted(_measured(model, surface), key=lambda pair: pair[0]):
        others = [torch.eye(3).double(), *(one.R for one, _ in near)]
        if len(near) < _MOST and off <= 2 * _TOLERANCE and _is_new(turn.R, others, same):
            near.append((turn, off))
    return {"near": [(turn.matrix().tolist(), off) for turn, off in near], "alike": alike}


def _measured(model: ObjectModel, surface: SurfaceDeviation) -> list[tuple[float, Rigid]]:
    """Measure symmetries that were found, and turns refined to where they fit best.

    A scan whose points lie denser on one side has its centre where no symmetry has it.
    """
    found = symmetry_transforms(model.symmetries, _STEP).R.double()[1:]
    exact = found if model.symmetries.is_found else found[:0]
    tried = [Rigid(R, torch.zeros(3).double()) for R in exact]
    tried += [slid(surface, R) for R in _starts(surface)]
    measured = _deviations(tried, surface)
    good = [turn for off, turn in sorted(measured, key=lambda pair: pair[0]) if off <= _TOLERANCE]
    # Two turns one after the other are one: of a can, upside down and then about its axis.
    measured += _deviations([a @ b for a in good[:_STARTS] for b in good[:3]], surface)
    return [(off, _in_model(turn, surface, model)) for off, turn in measured]


def _deviations(turns: list[Rigid], surface: SurfaceDeviation) -> list[tuple[float, Rigid]]:
    if not turns:
        return []
    R, shift = torch.stack([t.R for t in turns]), torch.stack([t.t_m for t in turns])
    return list(zip(surface.deviation(R, shift).tolist(), turns, strict=True))


def _starts(surface: SurfaceDeviation) -> list[Float[Tensor, "3 3"]]:
    """Give quarter turns about the principal axes, and the best of thousands of other turns."""
    axes = torch.linalg.eigh(surface.points.T @ surface.points).eigenvectors.T
    quarters = torch.arange(1, 4).double() * (math.pi / 2)
    zero = torch.zeros(3).double()
    starts = [R for axis in axes for R in turn_about(axis, zero, quarters).R]
    eye = torch.eye(3).double()
    for R in promising_turns(surface):
        if len(starts) == _STARTS:
            break
        if all(float(geodesic_rad(R, other)) > _SUPPRESSION_RAD for other in [eye, *starts]):
            starts.append(R)
    return starts


def _in_model(turn: Rigid, surface: SurfaceDeviation, model: ObjectModel) -> Rigid:
    """Write a turn about the centre of the surface, in diameters, in the model's frame."""
    centre_m = surface.centre_m
    return Rigid(turn.R, centre_m - turn.R @ centre_m + turn.t_m * model.diameter_m)


def _alike(given: Symmetries, surface: SurfaceDeviation) -> tuple[list[bool], list[bool]]:
    """Mark the discrete symmetries, and the axes, whose copies lie on the surface."""
    circle = torch.arange(1, 8, dtype=torch.float64) * (math.pi / 4)
    zero = torch.zeros(3).double()
    turns = [turn_about(axis.direction.double(), zero, circle).R for axis in given.continuous]
    axes = [float(surface.deviation(R).max()) <= ALIKE for R in turns]
    if given.discrete is None:
        return [], axes
    return (surface.deviation(given.discrete.R.double()) <= ALIKE).tolist(), axes


def _true(given: Symmetries, alike: tuple[list[bool], list[bool]]) -> Symmetries:
    """Give the symmetries that were marked; declared ones are all true."""
    if not given.is_found:
        return given
    discrete = given.discrete
    if discrete is not None:
        discrete = discrete[torch.tensor(alike[0])] if any(alike[0]) else None
    marked = zip(given.continuous, alike[1], strict=True)
    axes = tuple(axis for axis, is_alike in marked if is_alike)
    return Symmetries(discrete=discrete, continuous=axes, is_found=True)


def _is_new(
    R: Float[Tensor, "3 3"], others: list[Float[Tensor, "3 3"]], same: Float[Tensor, "s 3 3"]
) -> bool:
    """Whether a turn is far from the others and from all copies of them that look alike."""
    every = torch.cat([other @ same for other in others])
    return float(geodesic_rad(R.expand_as(every), every).min()) > _SUPPRESSION_RAD
