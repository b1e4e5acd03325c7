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


@lru_cache(maxsize=64)
def cached(model: ObjectModel, compute: Callable[..., Any], name: str, *settings: float) -> Any:  # noqa: ANN401
    """Give JSON values of a model that take long to compute.

    They are kept in ``$DEPTHPOSE_CACHE``, where that can be written to, by the bytes of the shape
    and its symmetries, and by the code that computes.
    """
    symmetries = model.symmetries
    tensors = [model.vertices_m, model.faces]
    if symmetries.discrete is not None:
        tensors.append(symmetries.discrete.R)
    tensors += [axis.direction for axis in symmetries.continuous]
    digest = sha256(f"{symmetries.is_found}".encode())
    code = {*Path(__file__).parent.glob("*.py"), Path(compute.__code__.co_filename)}
    for path in sorted(code):
        digest.update(path.read_bytes())
    for tensor in tensors:
        digest.update(tensor.contiguous().numpy().tobytes())
    folder = "_".join(map(str, (name, *settings)))
    path = cache_folder() / folder / f"{digest.hexdigest()}.json"
    try:
        return read_json(path)
    except (InputError, OSError):
        value = compute(model, *settings)
        with suppress(InputError, OSError):
            write_json(path, value)
        return value


_EYE = torch.eye(3, dtype=torch.float64)
_COARSE_ORDERS = (2, 3, 4, 5, 6)
_ORDERS = range(2, 13)
_TEETH = range(13, 61)  #: orders of which one step is tried: gears and knurls
_CIRCLE_TURNS = 36
_NEAREST_SAMPLES = 4
_MAX_ROUGH_DEVIATION = 0.04
"""Deviation, in diameters, from which following the surface may still find a symmetry: an axis
that is off by 4 degrees moves the surface by about as much."""
_SAME_RAD = 0.15
_SUPPRESSION_RAD = 0.25
SURE = 0.5  #: certainty from which a proposal is taken: that of a copy that is off by the tolerance
_FOLLOW_STEPS = 15  # steps of ICP
_MOST_AXES = 40  # a cube has 13 axes, an icosahedron 31


class SymmetryProposal(NamedTuple):
    """One way in which an object may look alike, in numbers that JSON holds."""

    kind: str  #: ``discrete`` or ``continuous``
    direction: Sequence[float]  #: unit vector of the axis to turn about
    point_m: Sequence[float]  #: a point that the axis goes through
    angle_rad: float | None  #: by how much; nothing for a continuous symmetry
    #: distance of the turned surface from the surface, in diameters: the largest but for 2 % of the
    #: points, and for ``continuous`` over all turns.
    deviation: float
    certainty: float  #: 1 for an exact copy, 1/2 at the tolerance, toward 0 beyond


class SurfaceDeviation:
    """Measures how far a turned surface lies from itself, in diameters.

    Attributes:
        centre_m: of the surface, about which it is turned.
        points: samples of the surface about the centre, in diameters.
        few: a hundred of them, for a rough measure of thousands of turns.
        many: a thousand.
        dense: five thousand.
        axes: principal axes, one a row.
    """

    def __init__(self, model: ObjectModel) -> None:
        samples_m, normals = sample_surface(model, 20000)
        self.centre_m = samples_m.double().mean(0)
        self.points = (samples_m.double() - self.centre_m) / model.diameter_m
        self._normals = normals.double().numpy()
        self._tree = KDTree(self.points.numpy())
        self.few = take_evenly(self.points, 100)
        self.many = take_evenly(self.points, 1000)
        self.dense = take_evenly(self.points, 5000)
        self._rough_tree = KDTree(take_evenly(self.points, 2500).numpy())
        self.axes = torch.linalg.eigh(self.points.T @ self.points).eigenvectors.T

    def nearest(self, moved: Float[Tensor, "*batch m 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Give the distance [diameters] and index of the sample nearest to each point."""
        distance, index = self._tree.query(moved.numpy(), workers=torch.get_num_threads())
        return np.asarray(distance), np.asarray(index)

    def rough_distance(self, R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
        """Mean distance of few turned points to a rough surface: for thousands of turns."""
        turned = (self.few @ R.mT).numpy()
        distance, _ = self._rough_tree.query(turned, workers=torch.get_num_threads())
        return torch.from_numpy(np.asarray(distance)).mean(-1)

    def deviation(
        self,
        R: Float[Tensor, "*batch 3 3"],
        shift: Float[Tensor, "*batch 3"] | None = None,
        share: float = 0.98,
    ) -> Float[Tensor, "*batch"]:
        """Distance to the surface after a rotation and a shift that a share of it stays within.

        The larger of both ways is given, from the rotated surface to the other and back.
        """
        points, near = (self.many, 1) if share < ALMOST_ALL else (self.dense, _NEAREST_SAMPLES)
        turn = Rigid(R, torch.zeros_like(R[..., 0]) if shift is None else shift)
        spacing = 2.0 / math.sqrt(len(self.points))
        farthest: list[Float[Tensor, "*batch"]] = []
        for motion in (turn, turn.inverse()):
            moved = motion.apply(points)
            nearest = self._tree.query(moved.numpy(), k=near, workers=torch.get_num_threads())
            distance, index = (np.reshape(part, (*moved.shape[:-1], near)) for part in nearest)
            gap = moved.numpy()[..., None, :] - self.points.numpy()[index]
            height = np.abs((gap * self._normals[index]).sum(-1))
            # Between samples the plane says the distance; beside an edge, the sample does. Of the
            # few points that decide, the nearest sample may lie on the other side of an edge: the
            # next ones count too.
            beside = np.maximum(distance - spacing, 0)
            off = torch.from_numpy(np.maximum(height, beside).min(-1))
            farthest.append(off.quantile(share, dim=-1))
        return torch.maximum(*farthest)


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
    proposals: list[SymmetryProposal] = []
    tried_axes: list[Tensor] = []
    revolution_axes: list[Tensor] = []
    for coarse in promising_turns(surface):
        if len(revolution_axes) >= 2 or len(tried_axes) >= _MOST_AXES:
            break
        if _is_covered(_axis_of(coarse), tried_axes, revolution_axes):
            continue
        axis = _axis_of(_follow_surface(surface, coarse))
        if not _is_covered(axis, tried_axes, revolution_axes):
            tried_axes.append(axis)
            measured = _measure_axis(surface, axis, limit, tolerance)
            revolution_axes += [axis for p in measured if p.kind == "continuous"]
            proposals += measured
    return sorted(proposals, key=lambda p: (p.kind != "continuous", -p.certainty))


def _axis_of(R: Tensor) -> Tensor:
    """Give the direction that a rotation leaves alone; well defined for half turns too."""
    return torch.linalg.svd(R - _EYE).Vh[-1]


def _follow_surface(surface: SurfaceDeviation, R: Tensor) -> Tensor:
    """Refine a rotation that nearly maps a surface onto itself, by ICP about the fixed centre."""
    weight = torch.ones(2 * len(surface.many), dtype=torch.float64)
    for _ in range(_FOLLOW_STEPS):
        _, index = surface.nearest(surface.many @ R.mT)
        target = surface.points[torch.from_numpy(index)]
        # With each point its mirror image through the centre, the fit cannot shift.
        source_pairs = torch.cat([surface.many, -surface.many])
        target_pairs = torch.cat([target, -target])
        R = fit_rigid(source_pairs, target_pairs, weight).R
    return R


def symmetries_from_proposals(proposals: list[SymmetryProposal]) -> Symmetries:
    """Take the sure proposals: axes of revolution, and rotations that do not follow from an axis.

    Without an axis the rotations are completed to a group: the product of two symmetries is one.
    """
    sure = [p for p in proposals if p.certainty >= SURE]
    lines = [
        Axis(
            direction=torch.tensor(p.direction, dtype=torch.float64),
            point_m=torch.tensor(p.point_m, dtype=torch.float64),
        )
        for p in sure
    ]
    axes = tuple(line for line, p in zip(lines, sure, strict=True) if p.kind == "continuous")
    turns: list[Rigid] = []
    for line, proposal in zip(lines, sure, strict=True):
        if proposal.angle_rad is None:
            continue
        angle_rad = torch.tensor(proposal.angle_rad, dtype=torch.float64)
        turn = turn_about(line.direction, line.point_m, angle_rad)
        # Two that move an axis of revolution alike differ by a rotation about that axis.
        is_same = any(
            float(geodesic_rad(turn.R, earlier.R)) < _SAME_RAD
            or any(
                float((turn.R @ axis.direction - earlier.R @ axis.direction).norm()) < _SAME_RAD
                for axis in axes
            )
            for earlier in turns
        )
        if not is_same:
            turns.append(turn)
    if not turns:
        return Symmetries(continuous=axes)

    group = list(turns)
    for first in group if not axes else ():  # grows under way: products until there is no new one
        for second in turns:
            product = first @ second
            rotations = [_EYE, *(turn.R for turn in group)]
            if all(float(geodesic_rad(product.R, R)) > _SAME_RAD for R in rotations):
                group.append(product)
        if len(group) > 60:  # what passes 60 was no group (an icosahedron's)
            group = turns
            break
    return Symmetries(discrete=Rigid.stack(group), continuous=axes)


def with_found_symmetries(
    model: ObjectModel,
    on_message: Callable[[str], None] | None,
    *,
    is_taken: bool,
    tolerance: float = 0.02,
) -> ObjectModel:
    """Look for the symmetries of a model that declares none, and count them if that is wanted.

    They are searched once for each shape, and kept in ``$DEPTHPOSE_CACHE``. ``on_message`` is told
    what was found, taken or not; without it, symmetries that are not taken are not searched.
    """
    declared = model.symmetries
    if not (is_taken or on_message) or declared.discrete is not None or declared.continuous:
        return model
    rows = cached(model, propose_symmetries, "symmetries", tolerance)
    proposals = [SymmetryProposal(*row) for row in rows]
    symmetries = replace(symmetries_from_proposals(proposals), is_found=True)
    if symmetries.discrete is None and not symmetries.continuous:
        return model
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


def _turns(direction: Float[Tensor, "3"], angles: Float[Tensor, " a"]) -> Float[Tensor, "a 3 3"]:
    return turn_about(direction, torch.zeros_like(direction), angles).R


def promising_turns(surface: SurfaceDeviation) -> list[Float[Tensor, "3 3"]]:
    """Try turns about principal axes and many directions; those that fit, the best first."""
    candidates = torch.cat([surface.axes, fibonacci_directions(400)])
    angles = torch.tensor([2 * math.pi / order for order in _COARSE_ORDERS], dtype=torch.float64)
    turns = torch.stack([_turns(direction, angles) for direction in candidates]).flatten(0, 1)
    coarse = surface.rough_distance(turns)
    return [turns[i] for i in coarse.argsort().tolist() if coarse[i] <= _MAX_ROUGH_DEVIATION]


def _is_covered(direction: Tensor, tried_axes: list[Tensor], revolution_axes: list[Tensor]) -> bool:
    """Whether an axis was tried, or is like one that was.

    All lines at right angles to an axis of revolution look alike, so one of them is enough.
    """
    is_tried = any(abs(float(direction @ t)) > math.cos(_SAME_RAD) for t in tried_axes)
    most = math.sin(_SAME_RAD)  # cosine of what counts as a right angle
    perpendicular = [a for a in revolution_axes if abs(float(a @ direction)) < most]
    is_alike = any(abs(float(a @ t)) < most for a in perpendicular for t in tried_axes)
    return is_tried or is_alike


def _measure_axis(
    surface: SurfaceDeviation, direction: Tensor, limit: float, tolerance: float
) -> list[SymmetryProposal]:
    """Measure the full circle about an axis and, unless that is sure, turns of order 2 to 12."""
    circle = _turns(direction, torch.arange(1, _CIRCLE_TURNS) * (2 * math.pi / _CIRCLE_TURNS))
    full: list[tuple[None, float]] = []  # angle and deviation, of every rotation about the axis
    turns: list[tuple[float, float]] = []  # and of single ones
    worst = math.inf
    if bool((surface.rough_distance(circle) <= _MAX_ROUGH_DEVIATION).all()):
        worst = float(surface.deviation(circle).max())
        full = [(None, worst)] if worst <= limit else []
    # Every turn of order 2 to 12, each once.
    shares = sorted({k / order for order in _ORDERS for k in range(1, order)})
    angles = torch.tensor(shares, dtype=torch.float64) * (2 * math.pi)
    angles = angles[surface.rough_distance(_turns(direction, angles)) <= _MAX_ROUGH_DEVIATION]
    if worst > tolerance and len(angles):
        deviation = surface.deviation(_turns(direction, angles))
        for i in deviation.argsort().tolist():
            angle = float(angles[i])
            value = float(deviation[i])
            # A turn near a better one is the same symmetry (non-maximum suppression).
            is_shadow = any(abs(angle - other) < _SUPPRESSION_RAD for other, _ in turns)
            if value <= limit and not is_shadow:
                turns.append((angle, value))
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


def _measure_teeth(
    surface: SurfaceDeviation, direction: Tensor, tolerance: float
) -> list[tuple[float, float]]:
    """Measure rotations by one of many teeth, and by half of one, which is to look otherwise.

    Gives the angle and the deviation of the order that fits best, if there is one.
    """
    measured: list[tuple[float, float]] = []
    for order in _TEETH:
        step = 2 * math.pi / order
        angles = torch.tensor([step, 0.5 * step, 1.5 * step], dtype=torch.float64)
        if float(surface.rough_distance(_turns(direction, angles[:1]))) > _MAX_ROUGH_DEVIATION:
            continue
        tooth, *between = surface.deviation(_turns(direction, angles)).tolist()
        if tooth <= tolerance and min(between) > 2 * tooth + ALIKE:
            measured.append((step, tooth))
    return sorted(measured, key=lambda pair: pair[1])[:1]


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

    The mirror image is laid on the model by ICP from the best of 400 mirror planes and rotary
    reflections; the deviation is the largest distance but for 2 % of the points. It takes about a
    second, once for each shape: it is kept in ``$DEPTHPOSE_CACHE``.

    Args:
        model: the object, a mesh or points with normals.
    """
    return float(cached(model, _search_mirror, "mirror_deviation"))


def _search_mirror(model: ObjectModel) -> float:
    """Give the least deviation of a surface from its mirror images, in diameters."""
    surface = SurfaceDeviation(model)
    # Reflections, or reflections with a quarter turn or a half, that fit roughly: by 0, 90, 180
    # and 270 degrees about the normal n: cos (1 - nn') + sin [n] - nn'.
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
        if all(
            float(geodesic_rad(reflections[k], start)) > _MIN_START_DISTANCE_RAD for start in starts
        ):
            starts.append(reflections[k])

    # From each to where the mirror image fits best.
    turns = [refine_turn(surface, R @ _FLIP, _FLIP) for R in starts]
    R = torch.stack([t.R for t in turns]) @ _FLIP
    shift = torch.stack([t.t_m for t in turns])
    return float(surface.deviation(R, shift).min())


def refine_turn(
    surface: SurfaceDeviation, R: Float64[Tensor, "3 3"], flip: Float64[Tensor, "3 3"] | None = None
) -> Rigid:
    """Refine a rotation that nearly maps a surface, or its mirror image, onto the surface (ICP).

    Args:
        surface: in units of the object's diameter.
        R: the rotation to begin with, about the middle of the surface's box.
        flip: the reflection that makes the mirror image; None: the surface itself.

    Returns:
        The motion of the surface, or of its mirror image.
    """
    points = surface.many if flip is None else surface.many @ flip
    linear = R if flip is None else R @ flip
    middle = (surface.points.amin(0) + surface.points.amax(0)) / 2
    turn = Rigid(R, middle - linear @ middle)
    for _ in range(_ICP_STEPS):
        moved = turn.apply(points)
        distance, index = surface.nearest(moved)
        near = torch.from_numpy(distance <= np.quantile(distance, _ICP_SHARE)).double()
        turn = fit_rigid(points, surface.points[torch.from_numpy(index)], near)
    return turn


ALIKE = 0.004
"""Deviation in diameters up to which a symmetry that was found in a shape is exact: as much as a
cylinder of 25 facets deviates. A copy that deviates by more, as a scan's dents or a keyway do, is
another pose, though a view may not tell which."""
ALMOST_ALL = 0.998  #: share of the surface that must be so near: a key or a notch is a few percent
_NEAR_TOLERANCE = 0.05
"""Deviation in diameters at which a sensor's noise begins to mask the difference of two poses: real
points of LineMOD and YCB lie 1.4 to 2.6 % of the diameter off the posed surface. Twice as much is
tried."""
_NEAR_SUPPRESSION_RAD = math.radians(35)  # turns nearer to each other are one to ICP
_AXIS_STEP_RAD = math.pi / 8  # an axis that nearly is one of revolution counts as eight turns
_FINE_AXIS_STEP_RAD = math.pi / 36
_MOST_NEAR = 24
_NEAR_STARTS = 24  # turns that ICP refines


@dataclass(frozen=True, kw_only=True, eq=False)
class NearSymmetry:
    """A turn after which the object looks nearly as before."""

    model_from_model: Rigid  #: the turn
    #: distance of the turned surface from the surface, in diameters: the largest but for 2 % of the
    #: points.
    deviation: float


def near_symmetries(model: ObjectModel) -> tuple[NearSymmetry, ...]:
    """Find the turns that leave a model nearly as it is, the nearest first.

    Not among them are those of :func:`true_symmetries`, which are no other pose. They are searched
    once for each shape, which takes a second or a few, and kept in ``$DEPTHPOSE_CACHE``.
    """
    near = cached(model, _search_near_symmetries, "near_symmetries")["near"]
    turns = [(torch.tensor(matrix, dtype=torch.float64), deviation) for matrix, deviation in near]
    return tuple(
        NearSymmetry(model_from_model=Rigid(M[:3, :3], M[:3, 3]), deviation=deviation)
        for M, deviation in turns
    )


def true_symmetries(
    model: ObjectModel, alike: tuple[list[bool], list[bool]] | None = None
) -> Symmetries:
    """Give the symmetries whose copies are one pose.

    Declared ones are all. Of those that were found in the geometry, copies that lie 1 % of the
    diameter and more off the surface are left out: near-symmetries.

    ``alike``: which discrete symmetries and which axes look so; None: as a search finds them.
    """
    declared = model.symmetries
    if not declared.is_found:
        return declared
    turns, axes = (
        cached(model, _search_near_symmetries, "near_symmetries")["alike"]
        if alike is None
        else alike
    )
    discrete = declared.discrete
    if discrete is not None:
        discrete = discrete[torch.tensor(turns)] if any(turns) else None
    continuous = tuple(a for a, is_alike in zip(declared.continuous, axes, strict=True) if is_alike)
    return Symmetries(discrete=discrete, continuous=continuous, is_found=True)


def _search_near_symmetries(model: ObjectModel) -> dict[str, Any]:
    """Search near-symmetries of a model, and which of its declared symmetries the surface has.

    Gives JSON values, which are cached: ``near``, transforms with their deviations, the best first;
    and ``alike``, flags of the discrete and the continuous symmetries.
    """
    surface = SurfaceDeviation(model)
    # Which discrete symmetries, and which axes, have copies that lie on the surface.
    declared = model.symmetries
    circle = torch.arange(1, 8, dtype=torch.float64) * (math.pi / 4)
    turns = [_turns(axis.direction.double(), circle) for axis in declared.continuous]
    axes = [float(surface.deviation(R, share=ALMOST_ALL).max()) <= ALIKE for R in turns]
    discrete = list[bool]()
    if declared.discrete is not None:
        R = declared.discrete.R.double()
        discrete = (surface.deviation(R, share=ALMOST_ALL) <= ALIKE).tolist()
    alike = (discrete, axes)
    same = symmetry_transforms(true_symmetries(model, alike), _FINE_AXIS_STEP_RAD).R
    # Symmetries that were found, and turns refined to where they fit best: a scan whose points lie
    # denser on one side has its centre where no symmetry has it.
    copies = symmetry_transforms(declared, _AXIS_STEP_RAD).R.double()[1:]
    tried = [
        Rigid(R, torch.zeros(3).double()) for R in (copies if declared.is_found else copies[:0])
    ]
    # From quarter turns about the principal axes, and the best of thousands of other turns.
    quarters = torch.arange(1, 4).double() * (math.pi / 2)
    starts = [R for axis in surface.axes for R in _turns(axis, quarters)]
    for R in promising_turns(surface):
        if len(starts) >= _NEAR_STARTS:
            break
        if all(float(geodesic_rad(R, o)) > _NEAR_SUPPRESSION_RAD for o in (_EYE, *starts)):
            starts.append(R)
    tried += [refine_turn(surface, R) for R in starts]
    measured = _deviations(tried, surface)
    good = [
        turn for off, turn in sorted(measured, key=lambda pair: pair[0]) if off <= _NEAR_TOLERANCE
    ]
    # Two turns one after the other are one: of a can, upside down and then about its axis.
    measured += _deviations([a @ b for a in good[:_NEAR_STARTS] for b in good[:3]], surface)
    near: list[tuple[Rigid, float]] = []
    for off, turn in sorted(measured, key=lambda pair: pair[0]):
        if len(near) == _MOST_NEAR or off > 2 * _NEAR_TOLERANCE:
            break
        # New is what is far from the others and from all copies of them that look alike.
        others = torch.cat([R @ same.double() for R in (_EYE, *(motion.R for motion, _ in near))])
        apart_rad = float(geodesic_rad(turn.R.expand_as(others), others).min())
        if apart_rad > _NEAR_SUPPRESSION_RAD:  # from the surface's centre and unit to the model's
            shift_m = surface.centre_m - turn.R @ surface.centre_m + turn.t_m * model.diameter_m
            near.append((Rigid(turn.R, shift_m), off))
    return {"near": [(turn.matrix().tolist(), off) for turn, off in near], "alike": alike}


def _deviations(turns: list[Rigid], surface: SurfaceDeviation) -> list[tuple[float, Rigid]]:
    """Measure how far each transform moves the surface off itself, in diameters."""
    if not turns:
        return []
    R = torch.stack([t.R for t in turns])
    shift = torch.stack([t.t_m for t in turns])
    return list(zip(surface.deviation(R, shift).tolist(), turns, strict=True))
