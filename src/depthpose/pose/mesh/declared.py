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
from depthpose.pose.mesh.models import symmetries_from_bop, symmetry_transforms, turn_about
from depthpose.pose.mesh.symmetry import SurfaceDeviation
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
_MOST_TURNS = 360  # of one axis: more is a body of revolution
_MOST_COPIES = 720  # of all axes together
_SAME_RAD = 0.005  # angle up to which two rotations are the same
_CONTRADICTED = 0.02
"""Deviation in diameters beyond which a notice doubts a declared symmetry: at it, the certainty of
one found in the shape is one half."""
_CHECKED = 12  # rotations of a symmetry that are measured


@dataclass(frozen=True, kw_only=True, eq=False)
class DeclaredTurns:
    """Equal rotations about one axis."""

    direction: Float64[Tensor, "3"]  #: unit vector, in the model file's axes
    turns: int | None  #: rotations in a full circle; None for a free axis

    @property
    def angles_rad(self) -> Float64[Tensor, " a"]:
        """Angles of all rotations but that by 0; of a free axis some, by which it is measured."""
        count = self.turns or _CHECKED
        return torch.arange(1, count, dtype=torch.float64) * (2 * math.pi / count)


def read_symmetry(text: str) -> tuple[DeclaredTurns, ...]:
    """Read a symmetry in words: ``z,18``, ``z,free``, ``z,6+x,2``.

    Raises:
        InputError: it is none.
    """
    declared: list[DeclaredTurns] = []
    for part in text.split("+"):
        # An axis and how many turns about it; a length of 0 where it is none.
        axis, _, count = (word.strip().lower() for word in part.rpartition(","))
        try:
            directions = {"x": (1.0, 0, 0), "y": (0, 1.0, 0), "z": (0, 0, 1.0)}
            numbers = directions.get(axis) or [float(word) for word in axis.split()]
            direction = torch.tensor(numbers, dtype=torch.float64).reshape(3)
            length = float(direction.norm())
            turns = None if count == "free" else int(count)
        except (ValueError, RuntimeError):
            length = 0.0
            turns = 0
            direction = torch.zeros(3)
        if not 0 < length < math.inf or not (turns is None or 2 <= turns <= _MOST_TURNS):
            raise InputError(
                f"symmetry {text!r}: {part.strip()!r} is no axis with 2 to {_MOST_TURNS} turns; "
                f"{_FORM}"
            )
        declared.append(DeclaredTurns(direction=direction / length, turns=turns))
    return tuple(declared)


def declare_symmetry(model: ObjectModel, symmetry: AnySymmetry) -> ObjectModel:
    """Declare the symmetry of a model: its copies are one answer.

    An axis in words is placed where the surface rotated about it fits best, not through the file's
    origin. A notice is given where the rotated surface lies more than 2 % of the diameter off.

    Args:
        model: the object.
        symmetry: in words, BOP's form, or as it is.

    Raises:
        InputError: it is no symmetry, or a file of none.
    """
    # In whatever form it is given.
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
    given: AnySymmetry | Mapping[str, AnySymmetry] | Sequence[str] | None, names: Sequence[str]
) -> dict[str, AnySymmetry]:
    """Assign declared symmetries to the objects that have one.

    Args:
        given: one, where one object is known; a mapping from names; or words that begin by a name
            where there are several (``gear:z,18``).
        names: of the objects.

    Raises:
        InputError: no object, or several, could be meant.
    """
    if given is None:
        return {}

    # A mapping from names.
    is_bop = isinstance(given, Mapping) and any(key.startswith("symmetries_") for key in given)
    if isinstance(given, Mapping) and not is_bop:
        for name in given:
            _refuse_unknown_name(name, names, f"symmetry of {name!r}")
        return dict(given)

    # One symmetry or several, which may begin by the name of their object.
    is_single = isinstance(given, str | Path | Mapping | Symmetries)
    declarations: Sequence[AnySymmetry] = [given] if is_single else list(given)
    declared: dict[str, AnySymmetry] = {}
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
        if name in declared:
            raise InputError(f"symmetry of {name!r} is given twice; join the two by +: z,6+x,2")
        declared[name] = symmetry
    return declared


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
    terms: Sequence[DeclaredTurns], surface: SurfaceDeviation, model: ObjectModel
) -> Symmetries:
    """Place the axes by the surface, and complete their rotations to a group.

    Args:
        terms: of the symmetry in words.
        surface: of the model.
        model: the object.

    Raises:
        InputError: the rotations make more copies than a symmetry has.
    """
    axes = [
        Axis(direction=term.direction, point_m=_find_point_on_axis(term, surface, model))
        for term in terms
    ]
    pairs = list(zip(terms, axes, strict=True))
    free = tuple(axis for term, axis in pairs if term.turns is None)
    generators = [
        turn_about(axis.direction, axis.point_m, term.angles_rad[0])
        for term, axis in pairs
        if term.turns is not None
    ]

    # Products are added until there is no new one: the list grows while it is read.
    copies = [Rigid(torch.eye(3).double(), torch.zeros(3).double())]
    for first in copies:
        for turn in generators:
            product = turn @ first
            copies_R = torch.stack([copy.R for copy in copies])
            apart_rad = geodesic_rad(product.R.expand_as(copies_R), copies_R)
            if float(apart_rad.min()) > _SAME_RAD:
                copies.append(product)
        if len(copies) > _MOST_COPIES:
            raise InputError(
                f"symmetry of {model.name}: its turns make more than {_MOST_COPIES} copies, so "
                "their axes are no symmetry together; correct them"
            )
    return Symmetries(discrete=Rigid.stack(copies[1:]) if copies[1:] else None, continuous=free)


_FOLLOW_STEPS = 20  # by which an axis is placed
_NEAREST = 0.9  # share of the points that place an axis: a keyway, without a counterpart, does not


def _find_point_on_axis(
    term: DeclaredTurns, surface: SurfaceDeviation, model: ObjectModel
) -> Float64[Tensor, "3"]:
    """Find a point on an axis of given direction, such that the surface rotated about it fits best.

    Starts are the centroid, the middle of the box and the file's origin. In each step the surface
    is rotated by about a half turn, and the axis moves to where the rotated points would lie on
    the surface.
    """
    # The rotation that is tried, and where the axis may be to begin with.
    axis = term.direction
    across = torch.linalg.svd(axis[None]).Vh[1:]  # two axes across it
    half = (term.turns or 2) // 2
    angle_rad = torch.tensor(2 * math.pi * half / (term.turns or 2), dtype=torch.float64)
    low = surface.points.amin(0)
    high = surface.points.amax(0)
    origin = -surface.centre_m / model.diameter_m
    candidates: list[tuple[float, Tensor]] = []
    for start in (torch.zeros(3).double(), (low + high) / 2, origin):
        # Moved until the rotated surface lies on itself.
        point = start
        for _ in range(_FOLLOW_STEPS):
            turn = turn_about(axis, point, angle_rad)
            moved = turn.apply(surface.many)
            distance, index = surface.nearest(moved)
            is_near = torch.from_numpy(distance <= np.quantile(distance, _NEAREST))
            gap = (surface.points[torch.from_numpy(index)] - moved)[is_near].mean(0)
            # Moving the axis by p shifts the rotated points by (1 - R) p, solved across the axis.
            lever = across @ (torch.eye(3).double() - turn.R) @ across.T
            point = point + across.T @ torch.linalg.solve(lever, across @ gap)

        # How well that fits, by some of the rotations.
        turns = turn_about(axis, point, term.angles_rad[:: max(1, len(term.angles_rad) // 6)])
        candidates.append((float(surface.deviation(turns.R, turns.t_m).max()), point))
    _, best = min(candidates, key=lambda pair: pair[0])
    return best * model.diameter_m + surface.centre_m


def _measure_deviation(
    declared: Symmetries, surface: SurfaceDeviation, model: ObjectModel
) -> float:
    """Measure how far the surface lies off itself after any of the rotations, in diameters."""
    # Not all of many rotations are measured.
    turns = symmetry_transforms(declared, 2 * math.pi / _CHECKED / 2).double()[1:]
    turns = turns[:: max(1, len(turns.R) // (2 * _CHECKED))]

    # From the model's frame and metres to the surface's centre and unit.
    moved_m = turns.R @ surface.centre_m + turns.t_m - surface.centre_m
    return float(surface.deviation(turns.R, moved_m / model.diameter_m).max())
