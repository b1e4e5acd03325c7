"""Near-symmetries: turns of a model that a depth sensor hardly distinguishes from none."""

import math
from collections import OrderedDict
from dataclasses import dataclass
from hashlib import sha256
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.rigid import Rigid, geodesic_rad
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
_KEPT_MODELS = 64


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
    """What is kept of a model: turns that look alike, and those that nearly do."""

    alike: Symmetries
    near: tuple[NearSymmetry, ...]


_known: OrderedDict[str, _Known] = OrderedDict()


def near_symmetries(model: ObjectModel) -> tuple[NearSymmetry, ...]:
    """Find the turns that leave a model nearly as it is, the nearest first.

    Not among them are those of :func:`true_symmetries`, which are no other pose. They are searched
    once for each shape in a process, which takes a second or a few.

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
    return _look_up(model).alike


def _look_up(model: ObjectModel) -> _Known:
    key = _key_of(model)
    if key not in _known:
        _known[key] = _search(model)
        while len(_known) > _KEPT_MODELS:
            _known.popitem(last=False)
    return _known[key]


def _key_of(model: ObjectModel) -> str:
    """Name a shape and its symmetries by their bytes."""
    symmetries = model.symmetries
    every = [model.vertices_m, model.faces]
    if symmetries.discrete is not None:
        every.append(symmetries.discrete.R)
    every += [axis.direction for axis in symmetries.continuous]
    digest = sha256(str(symmetries.is_found).encode())
    for tensor in every:
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def _search(model: ObjectModel) -> _Known:
    surface = SurfaceDeviation(model)
    given = model.symmetries
    alike = _alike(given, surface) if given.is_found else given
    same = symmetry_transforms(alike, _FINE_STEP).R.double()
    kept: list[NearSymmetry] = []
    for off, turn in sorted(_measured(model, surface), key=lambda pair: pair[0]):
        others = [torch.eye(3).double(), *(one.model_from_model.R for one in kept)]
        if len(kept) < _MOST and off <= 2 * _TOLERANCE and _is_new(turn.R, others, same):
            kept.append(NearSymmetry(model_from_model=turn, deviation=off))
    return _Known(alike, tuple(kept))


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


def _alike(given: Symmetries, surface: SurfaceDeviation) -> Symmetries:
    """Keep the symmetries whose copies lie on the surface."""
    circle = torch.arange(1, 8, dtype=torch.float64) * (math.pi / 4)
    axes = tuple(
        axis
        for axis in given.continuous
        if float(
            surface.deviation(
                turn_about(axis.direction.double(), torch.zeros(3).double(), circle).R
            ).max()
        )
        <= ALIKE
    )
    discrete = given.discrete
    if discrete is not None:
        is_alike = surface.deviation(discrete.R.double()) <= ALIKE
        discrete = discrete[is_alike] if is_alike.any() else None
    return Symmetries(discrete=discrete, continuous=axes, is_found=True)


def _is_new(
    R: Float[Tensor, "3 3"], others: list[Float[Tensor, "3 3"]], same: Float[Tensor, "s 3 3"]
) -> bool:
    """Whether a turn is far from the others and from all copies of them that look alike."""
    every = torch.cat([other @ same for other in others])
    return float(geodesic_rad(R.expand_as(every), every).min()) > _SUPPRESSION_RAD
