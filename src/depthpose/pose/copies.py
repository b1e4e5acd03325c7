"""Poses at which a model looks alike: symmetries, near-symmetric copies, and look-alikes."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.mesh import (
    axis_of_turn,
    mirror_deviation,
    near_symmetries,
    read_or_compute,
    sample_surface,
    symmetry_transforms,
    true_symmetries,
)
from depthpose.pose.propose.partial_symmetry import find_partial_symmetries
from depthpose.pose.propose.point_pairs import PairTable, prepare_pairs
from depthpose.pose.surface import Surface
from depthpose.pose.types import Axis, ObjectModel

SAME_DIAMETERS = 0.1  #: mean distance of the model's points up to which two poses are one
SAME_RAD = math.radians(8)  #: and angle; both must hold
_STEP_RAD = math.pi / 32  # half of the step between rotations about an axis: within SAME_RAD
_TRAINED_STEP_RAD = math.pi / 8  # the same of a network's training, which needs them no denser
_TOLERATED_STEP_RAD = math.pi / 24  # the same about an axis of a symmetry within a tolerance
_COPY_DIAMETERS = 0.05  # largest deviation of a near-symmetric copy; a look-alike deviates by more
_CLOSE_RAD = math.radians(45)  # a copy after a smaller rotation is one of a row about its axis
_COMPARED = 100  # points of the model by which poses are compared
_ALONG = math.cos(math.radians(15))  # least cosine between two axes that count as parallel
_LEAST_POINTS = 500  # a model without faces and with fewer points has no surface
_LONGER = 1.15
"""An axis is the longest or the shortest if the lengths along it and the next have this ratio."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SymmetricCopies:
    """Motions of a model, ``model_from_model``, after which it looks as before, or nearly.

    Attributes:
        symmetries: exact ones, whose copies are one pose; the identity first.
        near_copies: near-symmetries, after which 98 % of the surface is within 5 % of the diameter
            from itself, or 80 % of it on itself: another pose that looks nearly alike, such as a
            gear turned by a tooth.
        lookalikes: motions that move a smaller part of the surface onto itself, and half turns.
        trained: symmetries that a network was trained to treat as one pose; the identity first.
        mirror: deviation of the mirror image from the model, in diameters.
        points_m: points of the model by which poses are compared.
        middle_m: middle of the model's box.
        axes: principal axes of the model, one a row, the longest first.
        lengths_m: extent of the model along each of these axes.
        diameter_m: diameter of the model.
    """

    symmetries: Rigid
    near_copies: Rigid
    lookalikes: Rigid
    trained: Rigid
    mirror: float
    points_m: Float64[Tensor, "n 3"]
    middle_m: Float64[Tensor, "3"]
    axes: Float64[Tensor, "3 3"]
    lengths_m: Float64[Tensor, "3"]
    diameter_m: float

    def is_same(self, pose: Rigid, others: Rigid, motions: Rigid) -> Bool[Tensor, " n"]:
        """Which of other poses are a pose, after one of some motions of the model."""
        moved = others[:, None] @ motions
        apart_m = pose.apply(self.points_m) - moved.apply(self.points_m)
        is_near = apart_m.norm(dim=-1).mean(-1) < SAME_DIAMETERS * self.diameter_m
        angle = geodesic_rad(pose.R.expand_as(moved.R), moved.R)
        return (is_near & ((angle < SAME_RAD) | self._is_ball)).any(-1)

    @cached_property
    def near_axis(self) -> Axis | None:
        """Axis about which near-symmetric copies follow each other all round, if there is one.

        A rotation about it changes little that a camera sees.
        """
        if len(self.near_copies.R) == 0:
            return None
        identity = torch.eye(3).to(self.near_copies.R)
        angle = geodesic_rad(self.near_copies.R, identity.expand_as(self.near_copies.R))
        if float(angle.min()) > _CLOSE_RAD:
            return None
        direction, point_m = axis_of_turn(self.near_copies[int(angle.argmin())])
        # Enough of them to lie all round at this angle: near-symmetries about an axis are found at
        # even steps, so their number is enough to tell.
        is_about = self.near_copies.R @ direction @ direction > _ALONG
        if int(is_about.sum()) < 2 * math.pi / _CLOSE_RAD - 1:
            return None
        return Axis(direction=direction.float(), point_m=point_m.float())

    @property
    def _is_ball(self) -> bool:
        """A ball is compared by its middle alone: its rotation says nothing."""
        return len(self.points_m) == 1


@dataclass(kw_only=True, eq=False)
class PreparedObject:
    """A known object, and what is computed of its model once, when it is first asked for."""

    number: int  #: among the models of an estimator
    model: ObjectModel
    surface: Surface

    def prepare(self) -> "PreparedObject":
        """Compute now what else is computed when first asked for, in the seconds of no input."""
        _ = self.copies, self.pairs
        return self

    @cached_property
    def copies(self) -> SymmetricCopies:
        """Poses at which it looks alike."""
        return find_copies(self.model)

    @cached_property
    def pairs(self) -> PairTable:
        """Pairs of points that vote for its pose.

        Raises:
            InputError: the model has no surface.
        """
        require_surface(self.model)
        return prepare_pairs(self.surface)


def require_surface(model: ObjectModel) -> None:
    """Raise an :class:`InputError` if a model is a few points without faces."""
    points = len(model.vertices_m)
    if len(model.faces) == 0 and points < _LEAST_POINTS:
        raise InputError(
            f"{model.name}: {points} points without faces are no surface; export the part as a "
            f"mesh with triangles, such as STL, or give {_LEAST_POINTS} points"
        )


def find_copies(model: ObjectModel) -> SymmetricCopies:
    """Search a model for its symmetries, near-symmetries and look-alikes."""
    points_m = sample_surface(model, 2000)[0].double()
    middle_m = (points_m.amin(0) + points_m.amax(0)) / 2
    offset_m = points_m - points_m.mean(0)
    axes = torch.linalg.eigh(offset_m.T @ offset_m).eigenvectors.T.flip(0)
    along_m = points_m @ axes.T

    # Of a ball every rotation is the same pose, of which its centre alone says where it is.
    centre_m = true_symmetries(model).ball_centre_m
    compared_m = (
        take_evenly(points_m, _COMPARED) if centre_m is None else centre_m.to(points_m)[None]
    )
    exact = _exact_copies(model, compared_m, middle_m, axes, along_m.amax(0) - along_m.amin(0))
    if centre_m is not None:
        return exact

    # Each motion is kept once: as a near-symmetry, or else as a look-alike. Exact symmetries are
    # left out: they are the same as the identity, with which the distinct ones begin.
    near_motions, lookalike_motions = _propose_motions(model, middle_m, axes)
    identity = Rigid(torch.eye(3)[None].double(), torch.zeros(1, 3).double())
    near_copies = _distinct(near_motions, identity, exact)
    lookalikes = _distinct(lookalike_motions, Rigid.cat([identity, near_copies]), exact)
    return replace(exact, near_copies=near_copies, lookalikes=lookalikes)


def _exact_copies(
    model: ObjectModel,
    compared_m: Float64[Tensor, "n 3"],
    middle_m: Float64[Tensor, "3"],
    axes: Float64[Tensor, "3 3"],
    lengths_m: Float64[Tensor, "3"],
) -> SymmetricCopies:
    """Give the exact symmetries of a model, without near-symmetries or look-alikes yet.

    Declared or found symmetries may be exact only within a tolerance: poses are one after those
    that the surface has, and a network was trained to treat poses as one after all of them.
    """
    return SymmetricCopies(
        symmetries=symmetry_transforms(true_symmetries(model), _STEP_RAD).double(),
        near_copies=_empty(),
        lookalikes=_empty(),
        trained=symmetry_transforms(model.symmetries, _TRAINED_STEP_RAD).double(),
        mirror=mirror_deviation(model),
        points_m=compared_m,
        middle_m=middle_m,
        axes=axes,
        lengths_m=lengths_m,
        diameter_m=model.diameter_m,
    )


def _propose_motions(
    model: ObjectModel, middle_m: Float64[Tensor, "3"], axes: Float64[Tensor, "3 3"]
) -> tuple[Rigid, Rigid]:
    """Give motions that may be near-symmetries, and those that may be look-alikes.

    They hold exact symmetries too, and the same motion several times: :func:`_distinct` leaves
    these out.
    """
    # The model's symmetries, which may be exact only within the tolerance of their search.
    tolerated = symmetry_transforms(model.symmetries, _TOLERATED_STEP_RAD).double()

    # Motions of the whole surface, by the distance of the moved surface from itself: up to 5 % of
    # the diameter they are near-symmetries, up to 10 % look-alikes.
    slightly_off: list[Rigid] = []
    farther_off: list[Rigid] = []
    for near in near_symmetries(model):
        motions = slightly_off if near.deviation <= _COPY_DIAMETERS else farther_off
        motions.append(near.model_from_model[None])

    # Motions of a part of the surface, by the share that they move onto it: from 80 % on they are
    # near-symmetries, which come first, from 25 % on look-alikes. A mug without its handle.
    by_pairs = read_or_compute(model, find_partial_symmetries, "turns")
    matrices = torch.tensor(by_pairs["turns"], dtype=torch.float64).reshape(-1, 4, 4)
    partial_motions = Rigid(matrices[:, :3, :3], matrices[:, :3, 3])
    near_count = by_pairs["near"]

    # Half turns about the principal axes: the usual mistake about a long or flat part.
    half_R = 2 * axes[:, :, None] * axes[:, None] - torch.eye(3).double()
    half_turns = Rigid(half_R, middle_m - half_R @ middle_m)

    near_motions = Rigid.cat([tolerated, *slightly_off, partial_motions[:near_count]])
    lookalike_motions = Rigid.cat([*farther_off, partial_motions[near_count:], half_turns])
    return near_motions, lookalike_motions


def _distinct(motions: Rigid, others: Rigid, exact: SymmetricCopies) -> Rigid:
    """Leave out motions that are, up to an exact symmetry, one of ``others`` or one before them."""
    chosen = others
    for k in range(len(motions.R)):
        if not bool(exact.is_same(motions[k], chosen, exact.symmetries).any()):
            chosen = Rigid.cat([chosen, motions[k][None]])
    return chosen[len(others.R) :]


def _empty() -> Rigid:
    return Rigid(torch.zeros(0, 3, 3).double(), torch.zeros(0, 3).double())


def near_symmetry_lines(model: ObjectModel) -> list[str]:
    """Say after which rotations a model looks nearly as before, and by how much it deviates."""
    copies = find_copies(model)
    identity = Rigid(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    return [
        f"{difference_of(near.model_from_model, identity, copies)} ({near.deviation:.1%})"
        for near in near_symmetries(model)
    ]


def difference_of(pose: Rigid, from_pose: Rigid, copies: SymmetricCopies) -> str:
    """Say how a pose differs from another: by which rotation about which axis of the model."""
    turn = from_pose.R.double().mT @ pose.R.double()
    angle = math.degrees(float(geodesic_rad(turn, torch.eye(3, dtype=torch.float64))))
    middle_m = copies.middle_m[None]
    shift_m = float((pose.apply(middle_m) - from_pose.apply(middle_m)).norm())
    # The direction that the turn leaves alone, of the sign of a turn by up to 180 degrees.
    axis = torch.linalg.svd(turn - torch.eye(3, dtype=turn.dtype)).Vh[-1]
    skew = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    axis = axis if float(axis @ skew) >= 0 else -axis
    lengths = copies.lengths_m
    names = {}
    if lengths[0] > _LONGER * lengths[1]:
        names[0] = "the long axis"
    if lengths[1] > _LONGER * lengths[2]:
        names[2] = "the short axis"
    if len(names) == 2:  # then the one between is known too
        names[1] = "the middle axis"
    x, y, z = (round(value, 2) + 0.0 for value in axis.tolist())  # no -0.00
    along = [name for k, name in names.items() if abs(float(copies.axes[k] @ axis)) > _ALONG]
    about = along[0] if along else f"the model's axis ({x:.2f}, {y:.2f}, {z:.2f})"
    words = f"rotated by {angle:.0f} degrees about {about}"
    if shift_m > SAME_DIAMETERS / 2 * copies.diameter_m:
        words += f" and shifted by {1000 * shift_m:.0f} mm"
    return words
