"""Poses at which a model looks alike: symmetries, near-symmetric copies, and look-alikes."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
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
from depthpose.pose.types import Axis, ObjectModel
from depthpose.pose.verify.partial_symmetry import find_partial_symmetries

SAME_DIAMETERS = 0.1  #: mean distance of the model's points up to which two poses are the same
SAME_RAD = math.radians(8)  #: angle between them up to which they are; both must hold
_SAMPLES = 2000  # points of the surface by which the extent of a model is measured
_STEP_RAD = math.pi / 32  # half of the step between rotations about an axis: within SAME_RAD
_TRAINED_STEP_RAD = math.pi / 8  # the same of a network's training, which needs them no denser
_TOLERATED_STEP_RAD = math.pi / 24  # the same about an axis of a symmetry within a tolerance
_COPY_DIAMETERS = 0.05  # largest deviation of a near-symmetric copy; a look-alike deviates by more
_CLOSE_RAD = math.radians(45)  # largest angle between copies that follow each other about an axis
_COMPARED = 100  # points of the model by which poses are compared
_PARALLEL_COSINE = math.cos(math.radians(15))  # least cosine between axes that count as parallel
_LONGER = 1.15
"""An axis is called long or short if its length and that of the middle axis have this ratio."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SymmetricCopies:
    """Motions of a model, ``model_from_model``, after which it looks as before, or nearly."""

    symmetries: Rigid  #: exact ones, whose copies are one pose; the identity first
    #: near-symmetries, after which 98 % of the surface is within 5 % of the diameter from itself,
    #: or 80 % of it on itself. Such a copy is another pose, as that of a gear turned by a tooth.
    near_copies: Rigid
    lookalikes: Rigid  #: move a smaller part of the surface onto itself; and half turns
    #: symmetries that a network was trained to treat as one pose; the identity first.
    trained: Rigid
    mirror: float  #: deviation of the mirror image from the model, in diameters
    points_m: Float64[Tensor, "n 3"]  #: points of the model by which poses are compared
    middle_m: Float64[Tensor, "3"]  #: of the model's box
    axes: Float64[Tensor, "3 3"]  #: principal axes of the model, one a row, the longest first
    lengths_m: Float64[Tensor, "3"]  #: extent of the model along each of these axes
    diameter_m: float  #: of the model

    def is_same(self, pose: Rigid, others: Rigid, motions: Rigid) -> Bool[Tensor, " n"]:
        """Mark which of other poses are the same as a pose, up to some motions of the model.

        Args:
            pose: ``camera_from_model``, one.
            others: a batch of such poses.
            motions: ``model_from_model``, such as ``symmetries``.
        """
        moved = others[:, None] @ motions
        offset_m = pose.apply(self.points_m) - moved.apply(self.points_m)
        is_near = offset_m.norm(dim=-1).mean(-1) < SAME_DIAMETERS * self.diameter_m
        angle = geodesic_rad(pose.R.expand_as(moved.R), moved.R)
        is_alike = is_near & ((angle < SAME_RAD) | self._is_ball)
        return is_alike.any(-1)

    @cached_property
    def near_axis(self) -> Axis | None:
        """Axis about which near-symmetric copies follow each other all round; None without one.

        A rotation about it changes little that a camera sees.
        """
        if len(self.near_copies.R) == 0:
            return None
        identity = torch.eye(3).to(self.near_copies.R)
        angle = geodesic_rad(self.near_copies.R, identity.expand_as(self.near_copies.R))
        if float(angle.min()) > _CLOSE_RAD:
            return None
        closest = self.near_copies[int(angle.argmin())]
        direction, point_m = axis_of_turn(closest)
        # Are they enough to lie all round? Near-symmetries about an axis are found at even steps,
        # so their number is enough to tell. Rotations about the axis leave its direction as it is.
        is_about = self.near_copies.R @ direction @ direction > _PARALLEL_COSINE
        if int(is_about.sum()) < 2 * math.pi / _CLOSE_RAD - 1:
            return None
        return Axis(direction=direction.float(), point_m=point_m.float())

    @property
    def _is_ball(self) -> bool:
        """Whether the model is a ball: it has one pose in all rotations, compared by its centre."""
        return len(self.points_m) == 1


def find_copies(model: ObjectModel) -> SymmetricCopies:
    """Find the symmetries, near-symmetries and look-alikes of a model."""
    # The box and the principal axes of the surface.
    points_m = sample_surface(model, _SAMPLES)[0].double()
    middle_m = (points_m.amin(0) + points_m.amax(0)) / 2
    offset_m = points_m - points_m.mean(0)
    axes = torch.linalg.eigh(offset_m.T @ offset_m).eigenvectors.T.flip(0)
    along_m = points_m @ axes.T

    # Exact symmetries. Declared or found ones may hold only within a tolerance: poses are one up to
    # those that the surface really has, but a network was trained to treat poses as one up to all.
    true = true_symmetries(model)
    centre_m = true.ball_centre_m
    no_motion = Rigid(torch.zeros(0, 3, 3).double(), torch.zeros(0, 3).double())
    exact = SymmetricCopies(
        symmetries=symmetry_transforms(true, _STEP_RAD).double(),
        near_copies=no_motion,
        lookalikes=no_motion,
        trained=symmetry_transforms(model.symmetries, _TRAINED_STEP_RAD).double(),
        mirror=mirror_deviation(model),
        points_m=take_evenly(points_m, _COMPARED),
        middle_m=middle_m,
        axes=axes,
        lengths_m=along_m.amax(0) - along_m.amin(0),
        diameter_m=model.diameter_m,
    )
    if centre_m is not None:
        # Every rotation of a ball is the same pose: two poses are compared by its centre alone.
        return replace(exact, points_m=centre_m.to(points_m)[None])

    # Each motion is kept once: as a near-symmetry, or else as a look-alike. Exact symmetries are
    # left out: they are the same as the identity.
    near_motions, lookalike_motions = _propose_motions(model, middle_m, axes)
    identity = Rigid(torch.eye(3)[None].double(), torch.zeros(1, 3).double())
    near_copies = _leave_out_same(near_motions, identity, exact)
    lookalikes = _leave_out_same(lookalike_motions, Rigid.cat([identity, near_copies]), exact)
    return replace(exact, near_copies=near_copies, lookalikes=lookalikes)


def _propose_motions(
    model: ObjectModel, middle_m: Float64[Tensor, "3"], axes: Float64[Tensor, "3 3"]
) -> tuple[Rigid, Rigid]:
    """Propose motions that may be near-symmetries, and others that may be look-alikes.

    Exact symmetries are among them, and a motion may be there several times.

    Args:
        model: the object.
        middle_m: of its box.
        axes: its principal axes, one a row.
    """
    # The model's symmetries, which may be exact only within the tolerance of their search.
    tolerated = symmetry_transforms(model.symmetries, _TOLERATED_STEP_RAD).double()

    # Motions of the whole surface, by the distance of the moved surface from itself: up to 5 % of
    # the diameter they are near-symmetries, up to 10 % look-alikes.
    near_whole: list[Rigid] = []
    farther_whole: list[Rigid] = []
    for near in near_symmetries(model):
        motions = near_whole if near.deviation <= _COPY_DIAMETERS else farther_whole
        motions.append(near.model_from_model[None])

    # Motions of a part of the surface, by the share that they move onto it: from 80 % on they are
    # near-symmetries, which come first, from 25 % on look-alikes. A mug without its handle.
    by_pairs = read_or_compute(model, find_partial_symmetries, "turns")
    matrices = torch.tensor(by_pairs["turns"], dtype=torch.float64).reshape(-1, 4, 4)
    partial_motions = Rigid(matrices[:, :3, :3], matrices[:, :3, 3])
    near_count = by_pairs["near"]

    # Half turns about the principal axes a, the usual mistake about a long or flat part:
    # R = 2 a a^T - 1, and the middle stays where it is.
    half_R = 2 * axes[:, :, None] * axes[:, None] - torch.eye(3).double()
    half_turns = Rigid(half_R, middle_m - half_R @ middle_m)

    near_motions = Rigid.cat([tolerated, *near_whole, partial_motions[:near_count]])
    lookalike_motions = Rigid.cat([*farther_whole, partial_motions[near_count:], half_turns])
    return near_motions, lookalike_motions


def _leave_out_same(motions: Rigid, others: Rigid, exact: SymmetricCopies) -> Rigid:
    """Return the motions that are neither the same as one of ``others`` nor as an earlier motion.

    They are the same up to the symmetries of ``exact``.
    """
    distinct = others
    for k in range(len(motions.R)):
        if not bool(exact.is_same(motions[k], distinct, exact.symmetries).any()):
            distinct = Rigid.cat([distinct, motions[k][None]])
    return distinct[len(others.R) :]


def describe_near_symmetries(model: ObjectModel) -> list[str]:
    """Describe the near-symmetries of a model: the rotation of each, and the deviation after it.

    The deviation is a share of the diameter.
    """
    copies = find_copies(model)
    identity = Rigid(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    return [
        f"{describe_difference(near.model_from_model, identity, copies)} ({near.deviation:.1%})"
        for near in near_symmetries(model)
    ]


def describe_difference(pose: Rigid, reference: Rigid, copies: SymmetricCopies) -> str:
    """Describe how a pose differs from a reference: the rotation about an axis of the model.

    Args:
        pose: ``camera_from_model``.
        reference: the same, of another pose.
        copies: of the model.

    Returns:
        Such as "rotated by 180 degrees about the long axis and shifted by 12 mm".
    """
    # The axis is the direction that the rotation leaves as it is, signed so that the angle is
    # positive: R - R^T = 2 sin(angle) [axis]_x.
    eye = torch.eye(3, dtype=torch.float64)
    R = reference.R.double().mT @ pose.R.double()
    angle_deg = math.degrees(float(geodesic_rad(R, eye)))
    axis = torch.linalg.svd(R - eye).Vh[-1]
    sine_axis = torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    axis = axis if float(axis @ sine_axis) >= 0 else -axis
    text = f"rotated by {angle_deg:.0f} degrees about {_name_axis(axis, copies)}"

    # A shift is named only where it is large.
    middle_m = copies.middle_m[None]
    shift_m = float((pose.apply(middle_m) - reference.apply(middle_m)).norm())
    if shift_m > SAME_DIAMETERS / 2 * copies.diameter_m:
        text += f" and shifted by {1000 * shift_m:.0f} mm"
    return text


def _name_axis(axis: Float64[Tensor, "3"], copies: SymmetricCopies) -> str:
    """Name an axis of a model: "the long axis" and the like, or its coordinates."""
    longest_m, second_m, shortest_m = copies.lengths_m.tolist()
    names: dict[int, str] = {}  # by the row of ``copies.axes``
    if longest_m > _LONGER * second_m:
        names[0] = "the long axis"
    if second_m > _LONGER * shortest_m:
        names[2] = "the short axis"
    if len(names) == 2:
        names[1] = "the middle axis"
    for row, name in names.items():
        if abs(float(copies.axes[row] @ axis)) > _PARALLEL_COSINE:
            return name
    x, y, z = (round(value, 2) + 0.0 for value in axis.tolist())  # no -0.00
    return f"the model's axis ({x:.2f}, {y:.2f}, {z:.2f})"
