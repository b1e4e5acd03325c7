"""Symmetries found: what a new CAD file looks like when it is turned, and how sure that is."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, fit_rigid, geodesic_rad
from depthpose.pose.mesh.sampling import fibonacci_directions, sample_surface
from depthpose.pose.mesh.symmetry import turn_about
from depthpose.pose.types import Axis, ObjectModel, Symmetries

_ORDERS = (2, 3, 4, 5, 6)
_TRIED_ORDERS = range(2, 13)
_TURNS = 36
_COARSE = 0.04
"""Deviation, in diameters, from which following the surface may still find a symmetry: an axis
that is off by 4 degrees moves the surface by about as much."""
_SAME_RAD = 0.15
_SUPPRESSION_RAD = 0.25
SURE = 0.5
"""Certainty from which a proposal is taken: that of a copy that is off by the tolerance."""
_MOST_AXES = 40
"""A cube has 13 axes, an icosahedron 31."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SymmetryProposal:
    """One way in which an object may look alike.

    Attributes:
        kind: ``discrete`` or ``continuous``.
        axis: what to turn about.
        angle_rad: by how much; nothing for a continuous symmetry.
        deviation: distance of the turned surface from the surface, in diameters: the largest but
            for 2 % of the points, and for ``continuous`` over all turns.
        certainty: 1 for an exact copy, 1/2 at the tolerance, toward 0 beyond.
    """

    kind: str
    axis: Axis
    angle_rad: float | None
    deviation: float
    certainty: float


class SurfaceDeviation:
    """Measures how far a turned surface lies from itself, in diameters."""

    def __init__(self, model: ObjectModel) -> None:
        dense, normals = sample_surface(model, 20000)
        self.centre_m = dense.double().mean(0)
        self.points = (dense.double() - self.centre_m) / model.diameter_m
        self._normals = normals.double().numpy()
        self._tree = KDTree(self.points.numpy())
        self.few, self.many = (self._every(count) for count in (100, 1000))
        self._rough_tree = KDTree(self._every(2500).numpy())

    def _every(self, count: int) -> Float[Tensor, "m 3"]:
        return take_evenly(self.points, count)

    def nearest(self, moved: Float[Tensor, "*batch m 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Give distance and index of the nearest sample."""
        distance, index = self._tree.query(moved.numpy(), workers=torch.get_num_threads())
        return np.asarray(distance), np.asarray(index)

    def rough_distance(self, R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
        """Mean distance of few turned points to a rough surface: for thousands of turns."""
        turned = (self.few @ R.mT).numpy()
        distance, _ = self._rough_tree.query(turned, workers=torch.get_num_threads())
        return torch.from_numpy(np.asarray(distance)).mean(-1)

    def is_promising(self, R: Float[Tensor, "*batch 3 3"]) -> Tensor:
        """Say coarsely, by few points, whether a turn is worth measuring."""
        return self.rough_distance(R) <= _COARSE

    def deviation(
        self, R: Float[Tensor, "*batch 3 3"], shift: Float[Tensor, "*batch 3"] | None = None
    ) -> Float[Tensor, "*batch"]:
        """The 98th percentile of the distance to the surface, both ways.

        Args:
            R: turns about the centre of the surface.
            shift: after the turn, in diameters.
        """
        turn = Rigid(R, torch.zeros_like(R[..., 0]) if shift is None else shift)
        return torch.maximum(self._one_way(turn), self._one_way(turn.inverse()))

    def _one_way(self, turn: Rigid) -> Float[Tensor, "*batch"]:
        moved = self.many @ turn.R.mT + turn.t_m[..., None, :]
        distance, index = self.nearest(moved)
        gap = moved.numpy() - self.points.numpy()[index]
        height = np.abs((gap * self._normals[index]).sum(-1))
        # Between samples the plane says the distance; beside an edge, the sample does.
        spacing = 2.0 / math.sqrt(len(self.points))
        beside = np.maximum(distance - spacing, 0)
        return torch.from_numpy(np.maximum(height, beside)).quantile(0.98, dim=-1)


def propose_symmetries(model: ObjectModel, tolerance: float = 0.02) -> list[SymmetryProposal]:
    """Search for turns that leave the shape as it is, and say how sure each is.

    Every symmetry fixes the centre of the surface. Turns by a half to a sixth about the principal
    axes and about 400 directions are tried coarsely; the promising ones follow the surface to an
    exact axis; there, turns of order 2 to 12 and a full circle are measured. Texture does not
    count: neither does it to a method that sees depth alone. Bumps smaller than the tolerance are
    overlooked, so that a cup's handle is seen and its seam is not. Takes some seconds. A sphere is
    reported as two axes of revolution.

    Args:
        model: the object.
        tolerance: deviation in diameters at which the certainty is one half.

    Returns:
        Proposals of a certainty of 1/5 and more, continuous first, then the surest.
    """
    surface = SurfaceDeviation(model)
    limit = 2 * tolerance
    found: list[SymmetryProposal] = []
    tried: list[Tensor] = []
    for R in promising_turns(surface):
        revolved = [p.axis.direction for p in found if p.kind == "continuous"]
        if len(revolved) >= 2 or len(tried) >= _MOST_AXES:
            break
        if _is_known(_axis_of(R), tried, revolved):
            continue
        direction = _axis_of(_follow(surface, R))
        if not _is_known(direction, tried, revolved):
            tried.append(direction)
            found += _measure(surface, direction, limit, tolerance)
    return sorted(found, key=lambda p: (p.kind != "continuous", -p.certainty))


def symmetries_from_proposals(
    proposals: list[SymmetryProposal],
) -> Symmetries:
    """Take the sure ones: turns that an axis of revolution does not already say, and the axes.

    Without an axis the turns are completed to a group: two symmetries one after the other are one.
    """
    sure = [p for p in proposals if p.certainty >= SURE]
    axes = tuple(p.axis for p in sure if p.kind == "continuous")
    kept: list[Rigid] = []
    for proposal in sure:
        if proposal.angle_rad is None:
            continue
        turn = turn_about(proposal.axis.direction, proposal.axis.point_m,
                          torch.tensor(proposal.angle_rad, dtype=torch.float64))  # fmt: skip
        if not any(float(geodesic_rad(turn.R, other.R)) < _SAME_RAD for other in kept) and not any(
            _is_same_about(axis.direction, turn.R, [other.R for other in kept]) for axis in axes
        ):
            kept.append(turn)
    if not kept:
        return Symmetries(continuous=axes)
    kept = kept if axes else _completed(kept)
    discrete = Rigid.stack(kept)
    return Symmetries(discrete=discrete, continuous=axes)


def with_found_symmetries(
    model: ObjectModel,
    on_message: Callable[[str], None] | None,
    *,
    is_taken: bool,
    tolerance: float = 0.02,
) -> ObjectModel:
    """Look for the symmetries of a model that declares none, and count them if that is wanted.

    Args:
        model: a mesh, or points with normals.
        on_message: called with what was found, taken or not; None: symmetries that are not taken
            are not searched.
        is_taken: give the model these symmetries.
        tolerance: as for :func:`propose_symmetries`.
    """
    if not (is_taken or on_message) or not model.symmetries.is_none:
        return model
    proposals = propose_symmetries(model, tolerance)
    found = replace(symmetries_from_proposals(proposals), is_found=True)
    if found.is_none:
        return model
    turns = 0 if found.discrete is None else len(found.discrete.R)
    certainty = min(p.certainty for p in proposals if p.certainty >= SURE)
    if on_message is not None:
        on_message(
            f"{model.name}: looks the same after {turns} turns, about {len(found.continuous)} axes "
            f"(certainty {certainty:.2f} and more); "
            + (
                "each copy counts as right"
                if is_taken
                else "if that is so, say --symmetries found: no network can distinguish the copies"
            )
        )
    return replace(model, symmetries=found) if is_taken else model


def _completed(turns: list[Rigid]) -> list[Rigid]:
    """Add products until there is no new one; what passes 60 was no group (an icosahedron's)."""
    every = list(turns)
    eye = torch.eye(3, dtype=torch.float64)
    for first in every:  # grows under way
        for second in turns:
            product = first @ second
            known = [eye, *(turn.R for turn in every)]
            if all(float(geodesic_rad(product.R, R)) > _SAME_RAD for R in known):
                every.append(product)
        if len(every) > 60:
            return turns
    return every


def _is_same_about(axis: Tensor, R: Tensor, kept: list[Tensor]) -> bool:
    """Whether a turn about the axis makes ``R`` one of those kept: they move the axis alike."""
    return any(float((R @ axis - other @ axis).norm()) < _SAME_RAD for other in kept)


def _proposal(
    kind: str, axis: Axis, angle_rad: float | None, deviation: float, tolerance: float
) -> SymmetryProposal:
    certainty = 1 / (1 + (deviation / tolerance) ** 2)
    return SymmetryProposal(
        kind=kind, axis=axis, angle_rad=angle_rad, deviation=deviation, certainty=certainty
    )


def _fractions() -> Float[Tensor, " a"]:
    """Every turn of order 2 to 12, each once."""
    turns = {k / order for order in _TRIED_ORDERS for k in range(1, order)}
    return torch.tensor(sorted(turns), dtype=torch.float64) * (2 * math.pi)


def _turns(direction: Float[Tensor, "3"], angles: Float[Tensor, " a"]) -> Float[Tensor, "a 3 3"]:
    return turn_about(direction, torch.zeros_like(direction), angles).R


def promising_turns(surface: SurfaceDeviation) -> list[Float[Tensor, "3 3"]]:
    """Try turns about principal axes and many directions; those that fit, the best first."""
    spread = surface.points.T @ surface.points
    candidates = torch.cat([torch.linalg.eigh(spread).eigenvectors.T, fibonacci_directions(400)])
    angles = torch.tensor([2 * math.pi / order for order in _ORDERS], dtype=torch.float64)
    turns = torch.stack([_turns(direction, angles) for direction in candidates]).flatten(0, 1)
    coarse = surface.rough_distance(turns)
    return [turns[i] for i in coarse.argsort().tolist() if coarse[i] <= _COARSE]


def _is_known(direction: Tensor, tried: list[Tensor], revolved: list[Tensor]) -> bool:
    """Whether an axis was tried, or follows: all lines across an axis of revolution are alike."""
    near = math.cos(_SAME_RAD)
    across = [a for a in revolved if abs(float(a @ direction)) < math.sin(_SAME_RAD)]
    is_across = any(abs(float(a @ t)) < math.sin(_SAME_RAD) for a in across for t in tried)
    return is_across or any(abs(float(direction @ t)) > near for t in tried)


def _measure(
    surface: SurfaceDeviation, direction: Tensor, limit: float, tolerance: float
) -> list[SymmetryProposal]:
    """Measure the full circle about an axis and, unless that is sure, turns of order 2 to 12.

    A rough square block is nearly round, and surely square.
    """
    axis = Axis(direction=direction, point_m=surface.centre_m)
    circle = _turns(direction, torch.arange(1, _TURNS) * (2 * math.pi / _TURNS))
    found: list[SymmetryProposal] = []
    if bool(surface.is_promising(circle).all()):
        worst = float(surface.deviation(circle).max())
        if worst <= limit:
            found = [_proposal("continuous", axis, None, worst, tolerance)]
        if worst <= tolerance:
            return found
    angles = _fractions()
    angles = angles[surface.is_promising(_turns(direction, angles))]
    if len(angles) == 0:
        return found
    deviation = surface.deviation(_turns(direction, angles))
    kept: list[SymmetryProposal] = []
    for i in deviation.argsort().tolist():
        angle, value = float(angles[i]), float(deviation[i])
        # A turn near a better one is the same symmetry (non-maximum suppression).
        is_shadow = any(abs(angle - (p.angle_rad or 0)) < _SUPPRESSION_RAD for p in kept)
        if value <= limit and not is_shadow:
            kept.append(_proposal("discrete", axis, angle, value, tolerance))
    return found + kept


def _follow(surface: SurfaceDeviation, R: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """Refine the turned surface onto the surface (ICP about the fixed centre)."""
    points = surface.many
    weight = torch.ones(2 * len(points), dtype=torch.float64)
    for _ in range(15):
        _, index = surface.nearest(points @ R.mT)
        target = surface.points[torch.from_numpy(index)]
        # With each point its mirror image through the centre, the fit cannot shift.
        R = fit_rigid(torch.cat([points, -points]), torch.cat([target, -target]), weight).R
    return R


def _axis_of(R: Float[Tensor, "3 3"]) -> Float[Tensor, "3"]:
    """The direction that a rotation leaves alone; well defined for half turns too."""
    _, _, vh = torch.linalg.svd(R - torch.eye(3, dtype=R.dtype))
    return vh[-1]
