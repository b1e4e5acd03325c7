"""Symmetries that a user declares: rotations about axes, which are placed by the surface."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from depthpose.core.errors import InputError, Notice, suggest_name
from depthpose.core.files import read_json
from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.mesh.deviation import SurfaceDeviation
from depthpose.pose.mesh.models import symmetries_from_bop, symmetry_transforms, turn_about
from depthpose.pose.types import Axis, ObjectModel, Symmetries

AnySymmetry = str | Path | Mapping[str, Any] | Symmetries
"""A symmetry in words (``z,18``, ``z,free``, ``z,6+x,2``), as BOP's entry of an object or a JSON
file of it, or as it is."""

_FORM = (
    "write AXIS,N for an object that looks alike after each of N equal turns about an axis (z,18), "
    "or AXIS,free for a body of revolution (z,free); AXIS is x, y, z or three numbers ('0 1 1,2'); "
    "several are joined by + (z,6+x,2). Or give a JSON file with BOP's symmetries_discrete and "
    "symmetries_continuous"
)
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_MOST_TURNS = 360  # of one axis: more is a body of revolution
_MOST_COPIES = 720  # of all axes together
_SAME_RAD = 0.005  # angle up to which two rotations are the same
_CONTRADICTED = 0.02
"""Deviation in diameters beyond which a notice doubts a declared symmetry: at it, the certainty of
one found in the shape is one half."""
_FREE_AXIS_TURNS = 12  # rotations in a full circle by which a free axis is measured
_LEAST_MEASURED = 24  # rotations of a symmetry that are measured at least, where it has as many


@dataclass(frozen=True, kw_only=True, eq=False)
class DeclaredTurns:
    """Equal rotations about one axis."""

    direction: Float64[Tensor, "3"]  #: unit vector, in the model file's axes
    turns: int | None  #: rotations in a full circle; None for a free axis

    @property
    def angles_rad(self) -> Float64[Tensor, " a"]:
        """Angles of all rotations but that by 0; of a free axis, eleven by which it is measured."""
        count = self.turns or _FREE_AXIS_TURNS
        return torch.arange(1, count, dtype=torch.float64) * (2 * math.pi / count)


def read_symmetry(text: str) -> tuple[DeclaredTurns, ...]:
    """Read a symmetry in words: ``z,18``, ``z,free``, ``z,6+x,2``.

    Returns:
        The rotations about each axis, in the order of the words.

    Raises:
        InputError: a part of it is no axis with a number of turns.
    """
    declared: list[DeclaredTurns] = []
    for part in text.split("+"):
        turns = _parse_turns(part)
        if turns is None:
            raise InputError(
                f"symmetry {text!r}: {part.strip()!r} is no axis with 2 to {_MOST_TURNS} turns; "
                f"{_FORM}"
            )
        declared.append(turns)
    return tuple(declared)


def _parse_turns(text: str) -> DeclaredTurns | None:
    """Parse an axis and how many turns about it, ``z,18`` or ``0 1 1,free``; None: it is none."""
    axis, _, count = (word.strip().lower() for word in text.rpartition(","))
    try:
        components = _AXES.get(axis) or [float(word) for word in axis.split()]
        direction = torch.tensor(components, dtype=torch.float64).reshape(3)
        turns = None if count == "free" else int(count)
    except (ValueError, RuntimeError):
        return None
    length = float(direction.norm())
    is_in_range = turns is None or 2 <= turns <= _MOST_TURNS
    if not 0 < length < math.inf or not is_in_range:
        return None
    return DeclaredTurns(direction=direction / length, turns=turns)


def declare_symmetry(model: ObjectModel, symmetry: AnySymmetry) -> ObjectModel:
    """Declare the symmetry of a model: its copies count as one pose.

    An axis in words is placed where the surface rotated about it fits best, not through the file's
    origin. A notice is given where the rotated surface lies more than 2 % of the diameter off.

    Args:
        model: the object.
        symmetry: in words, as BOP's entry of an object or a JSON file of it, or ``Symmetries``.

    Returns:
        The model with the symmetry in place of its own.

    Raises:
        InputError: it is no symmetry, or a file of none.
    """
    # From each of its forms.
    surface = SurfaceDeviation(model)
    if isinstance(symmetry, str) and not symmetry.lower().endswith(".json"):
        declared = _place_axes(read_symmetry(symmetry), surface, model)
    elif isinstance(symmetry, Symmetries):
        declared = replace(symmetry, is_found=False)
    elif isinstance(symmetry, str | Path):
        declared = symmetries_from_bop(_read_entry(Path(symmetry), model), source=str(symmetry))
    elif isinstance(symmetry, Mapping):
        declared = symmetries_from_bop(symmetry, source=f"symmetry of {model.name}")
    else:
        raise InputError(f"symmetry is a {type(symmetry).__name__}; {_FORM}")
    if declared.is_none:
        raise InputError(f"symmetry of {model.name}: there is none in it; {_FORM}")

    # Does the surface have it?
    deviation = _measure_deviation(declared, surface, model)
    if deviation > _CONTRADICTED:
        source = symmetry if isinstance(symmetry, str | Path) else "that was given"
        warnings.warn(
            f"{model.name}: turned by the symmetry {source} its surface lies up to {deviation:.1%} "
            f"of its diameter ({1000 * deviation * model.diameter_m:.1f} mm) off itself, so the "
            "copies look different; they count as one pose because you say so",
            Notice,
            stacklevel=2,
        )
    return replace(model, symmetries=declared)


def assign_symmetries(
    declared: AnySymmetry | Mapping[Any, AnySymmetry] | Sequence[str] | None, names: Sequence[str]
) -> dict[str, AnySymmetry]:
    """Find for each declared symmetry the object that has it.

    Args:
        declared: one, where there is one object; a mapping from names; or words that begin by a
            name where there are several objects (``gear:z,18``).
        names: of the objects.

    Returns:
        The symmetries by the names of their objects.

    Raises:
        InputError: no object, or several, could be meant.
    """
    if declared is None:
        return {}

    # A mapping from names.
    is_bop = isinstance(declared, Mapping) and any(
        str(key).startswith("symmetries_") for key in declared
    )
    if isinstance(declared, Mapping) and not is_bop:
        for name in declared:
            _refuse_unknown_name(str(name), names, f"symmetry of {name!r}")
        return dict(declared)

    # One symmetry or several, which may begin by the name of their object.
    is_single = isinstance(declared, str | Path | Mapping | Symmetries)
    declarations: Sequence[AnySymmetry] = [declared] if is_single else list(declared)
    of_objects: dict[str, AnySymmetry] = {}
    for declaration in declarations:
        name = colon = rest = ""
        if isinstance(declaration, str):
            name, colon, rest = declaration.partition(":")
        if colon and (name in names or "," in rest):
            _refuse_unknown_name(name, names, f"symmetry {declaration!r}")
            symmetry: AnySymmetry = rest
        elif len(names) == 1:
            name = names[0]
            symmetry = declaration
        else:
            raise InputError(
                f"symmetry {declaration!r}: {len(names)} objects are known ({', '.join(names)}); "
                f"say whose it is: {names[0]}:z,18, in Python symmetry={{{names[0]!r}: 'z,18'}}"
            )
        if name in of_objects:
            raise InputError(f"symmetry of {name!r} is given twice; join the two by +: z,6+x,2")
        of_objects[name] = symmetry
    return of_objects


def _refuse_unknown_name(name: str, names: Sequence[str], message: str) -> None:
    """Refuse the name of no object; ``message`` says what it was given for."""
    if name not in names:
        raise InputError(f"{message}: no object is called so; {suggest_name(name, names)}")


def _read_entry(path: Path, model: ObjectModel) -> Mapping[str, Any]:
    """Read BOP's entry of an object: the file itself, its only entry, or that of its number."""
    content = read_json(path)
    if isinstance(content, Mapping) and any(str(k).startswith("symmetries_") for k in content):
        return content
    entries = content if isinstance(content, Mapping) else {}
    entry = next(iter(entries.values())) if len(entries) == 1 else entries.get(str(model.number))
    if not isinstance(entry, Mapping):
        raise InputError(
            f"{path}: has no entry {str(model.number)!r} with symmetries of {model.name}; give "
            'the entry alone, as {"symmetries_discrete": [...]}'
        )
    return entry


def _place_axes(
    declared: Sequence[DeclaredTurns], surface: SurfaceDeviation, model: ObjectModel
) -> Symmetries:
    """Place axes by the surface, and complete their rotations to a group.

    Args:
        declared: rotations about each axis.
        surface: of the model.
        model: the object.

    Raises:
        InputError: the rotations make more copies than a symmetry has.
    """
    # Free axes, and the smallest rotation about each of the others.
    free: list[Axis] = []
    generators: list[Rigid] = []
    for turns in declared:
        point_m = _find_point_on_axis(turns, surface, model)
        if turns.turns is None:
            free.append(Axis(direction=turns.direction, point_m=point_m))
        else:
            generators.append(turn_about(turns.direction, point_m, turns.angles_rad[0]))

    # Products are added until there is no new one: the list grows while it is read.
    copies = [Rigid(torch.eye(3).double(), torch.zeros(3).double())]
    for copy in copies:
        for turn in generators:
            product = turn @ copy
            copies_R = Rigid.stack(copies).R
            apart_rad = geodesic_rad(product.R.expand_as(copies_R), copies_R)
            if float(apart_rad.min()) > _SAME_RAD:
                copies.append(product)
        if len(copies) > _MOST_COPIES:
            raise InputError(
                f"symmetry of {model.name}: its turns make more than {_MOST_COPIES} copies, so "
                "their axes are no symmetry together; correct them"
            )
    discrete = Rigid.stack(copies[1:]) if len(copies) > 1 else None
    return Symmetries(discrete=discrete, continuous=tuple(free))


_AXIS_STEPS = 20  # by which an axis is placed
_NEAREST_SHARE = 0.9  # of the points, which place an axis: those of a keyway do not
_COMPARED_TURNS = 6  # approximate number of rotations by which places of an axis are compared


def _find_point_on_axis(
    turns: DeclaredTurns, surface: SurfaceDeviation, model: ObjectModel
) -> Float64[Tensor, "3"]:
    """Find a point of the axis, of given direction, about which the surface fits itself best.

    The axis is shifted from three starts, and the best of the three results is taken.

    Returns:
        The point (3,) in the model frame [m].
    """
    # In the frame of ``surface``: about its centroid, in diameters.
    centroid = torch.zeros(3).double()
    middle_of_box = surface.middle
    origin_of_file = -surface.centre_m / model.diameter_m
    starts = (centroid, middle_of_box, origin_of_file)
    points = [_shift_axis(start, turns, surface) for start in starts]
    best_point = min(points, key=lambda point: _measure_axis(point, turns, surface))

    # In the model frame, in metres.
    return best_point * model.diameter_m + surface.centre_m


def _measure_axis(
    point: Float64[Tensor, "3"], turns: DeclaredTurns, surface: SurfaceDeviation
) -> float:
    """Measure how far the surface rotated about an axis through a point lies off itself.

    The point is about the centroid of the surface, and both lengths are in diameters. Some of the
    rotations are compared, and the worst of them counts.
    """
    step = max(1, len(turns.angles_rad) // _COMPARED_TURNS)
    rotations = turn_about(turns.direction, point, turns.angles_rad[::step])
    shift = rotations.t_m  # in diameters, as the point is
    return float(surface.deviation(rotations.R, shift).max())


def _shift_axis(
    start: Float64[Tensor, "3"], turns: DeclaredTurns, surface: SurfaceDeviation
) -> Float64[Tensor, "3"]:
    """Shift an axis through a point until the surface rotated about it lies on itself.

    In each step the surface is rotated by about a half turn, and the axis moves to where the
    rotated points would lie on the surface. Points are those of the surface's frame, in diameters.
    """
    count = turns.turns or 2
    half_turn_rad = torch.tensor(2 * math.pi * (count // 2) / count, dtype=torch.float64)
    across = torch.linalg.svd(turns.direction[None]).Vh[1:]  # two directions across the axis
    point = start
    for _ in range(_AXIS_STEPS):
        turn = turn_about(turns.direction, point, half_turn_rad)
        moved = turn.apply(surface.compared_points)
        distance, index = surface.find_nearest(moved)
        is_near = torch.from_numpy(distance <= np.quantile(distance, _NEAREST_SHARE))
        gap = (surface.points[torch.from_numpy(index)] - moved)[is_near].mean(0)
        # Moving the axis by p shifts the rotated points by (I - R) p, solved across the axis.
        lever = across @ (torch.eye(3).double() - turn.R) @ across.T
        point = point + across.T @ torch.linalg.solve(lever, across @ gap)
    return point


def _measure_deviation(
    declared: Symmetries, surface: SurfaceDeviation, model: ObjectModel
) -> float:
    """Measure how far the surface lies off itself after the worst rotation, in diameters."""
    # All rotations but the identity. Of 48 or more every second, third, ... is measured: 24 to 47.
    half_step_rad = math.pi / _FREE_AXIS_TURNS
    turns = symmetry_transforms(declared, half_step_rad).double()[1:]
    turns = turns[:: max(1, len(turns.R) // _LEAST_MEASURED)]

    # A point c + p moves to R (c + p) + t = c + R p + shift: the same motion about the centre c.
    shift_m = turns.R @ surface.centre_m + turns.t_m - surface.centre_m
    return float(surface.deviation(turns.R, shift_m / model.diameter_m).max())
