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
    """Compute ``compute(model, *settings)``, JSON values that take long, or read them from a cache.

    The cache is ``$DEPTHPOSE_CACHE``, where that can be written to. Its key is made of the bytes of
    the shape and its symmetries, and of the code that computes.

    Args:
        model: the object.
        compute: the function.
        name: of the folder of its values in the cache.
        settings: further arguments.
    """
    # What the values depend on.
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

    # Read, or computed and written.
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


class SurfaceDeviation:
    """Measures how far a moved surface lies from itself, in diameters."""

    def __init__(self, model: ObjectModel) -> None:
        samples_m, normals = sample_surface(model, 20000)
        self.centre_m = samples_m.double().mean(0)  #: of the surface, about which it is rotated
        #: samples of the surface about the centre, in diameters.
        self.points = (samples_m.double() - self.centre_m) / model.diameter_m
        self.few = take_evenly(self.points, 100)  #: of them, to measure thousands of rotations
        self.many = take_evenly(self.points, 1000)  #: of them, for usual measures
        self.dense = take_evenly(self.points, 5000)  #: of them, for exact measures
        self.axes = torch.linalg.eigh(
            self.points.T @ self.points
        ).eigenvectors.T  #: principal, rows
        self._normals = normals.double().numpy()
        self._tree = KDTree(self.points.numpy())
        self._rough_tree = KDTree(take_evenly(self.points, 2500).numpy())

    def nearest(self, moved: Float[Tensor, "*batch m 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Find the sample nearest to each point: its distance [diameters] and index."""
        distance, index = self._tree.query(moved.numpy(), workers=torch.get_num_threads())
        return np.asarray(distance), np.asarray(index)

    def rough_distance(self, R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
        """Measure the mean distance of few rotated points to few samples, for many rotations."""
        rotated = (self.few @ R.mT).numpy()
        distance, _ = self._rough_tree.query(rotated, workers=torch.get_num_threads())
        return torch.from_numpy(np.asarray(distance)).mean(-1)

    def deviation(
        self,
        R: Float[Tensor, "*batch 3 3"],
        shift: Float[Tensor, "*batch 3"] | None = None,
        share: float = 0.98,
    ) -> Float[Tensor, "*batch"]:
        """Measure how far the surface lies off itself after a rotation and a shift.

        It is the distance within which a share of the points lies, and the larger one of two ways:
        from the moved surface to the other and back.

        Args:
            R: rotation about the centre.
            shift: in diameters; None: none.
            share: of the points; from ``ALMOST_ALL`` on more points and samples are compared.
        """
        forward = Rigid(R, torch.zeros_like(R[..., 0]) if shift is None else shift)
        forward_deviation = self.deviation_one_way(forward, share)
        backward_deviation = self.deviation_one_way(forward.inverse(), share)
        return torch.maximum(forward_deviation, backward_deviation)

    def deviation_one_way(self, motion: Rigid, share: float = 0.98) -> Float[Tensor, "*batch"]:
        """Measure how far the moved surface lies off the surface, as :meth:`deviation` does.

        It is a lower bound of that, in half of the time.
        """
        # The nearest samples of each moved point; in an exact measure several.
        is_exact = share >= ALMOST_ALL
        points = self.dense if is_exact else self.many
        count = _NEAREST_SAMPLES if is_exact else 1
        spacing = 2.0 / math.sqrt(len(self.points))
        moved = motion.apply(points)
        nearest = self._tree.query(moved.numpy(), k=count, workers=torch.get_num_threads())
        distance, index = (np.reshape(part, (*moved.shape[:-1], count)) for part in nearest)

        # Between samples the distance is that to the tangent plane, beside an edge that to the
        # sample. The least of several samples counts, since the nearest one may lie on the other
        # side of an edge.
        gap = moved.numpy()[..., None, :] - self.points.numpy()[index]
        height = np.abs((gap * self._normals[index]).sum(-1))
        beside = np.maximum(distance - spacing, 0)
        off = torch.from_numpy(np.maximum(height, beside).min(-1))
        return off.quantile(share, dim=-1)


@lru_cache(maxsize=4)
def _prepare_surface(model: ObjectModel) -> SurfaceDeviation:
    """Prepare the surface of a model, once for its several searches."""
    return SurfaceDeviation(model)


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


def refine_turn(
    surface: SurfaceDeviation, R: Float64[Tensor, "3 3"], flip: Float64[Tensor, "3 3"] | None = None
) -> Rigid:
    """Refine a rotation that nearly maps a surface, or its mirror image, onto the surface (ICP).

    Args:
        surface: in units of the object's diameter.
        R: the rotation to begin with, about the middle of the surface's box.
        flip: the reflection that makes the mirror image; None for the surface itself.

    Returns:
        The motion of the surface, or of its mirror image.
    """
    points = surface.many if flip is None else surface.many @ flip
    linear = R if flip is None else R @ flip
    middle = (surface.points.amin(0) + surface.points.amax(0)) / 2
    motion = Rigid(R, middle - linear @ middle)
    for _ in range(_ICP_STEPS):
        distance, index = surface.nearest(motion.apply(points))
        is_near = torch.from_numpy(distance <= np.quantile(distance, _ICP_SHARE)).double()
        motion = fit_rigid(points, surface.points[torch.from_numpy(index)], is_near)
    return motion


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
