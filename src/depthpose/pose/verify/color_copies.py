"""Poses that colour may tell apart and depth cannot: copies by symmetry, rotated to their print."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.mesh import near_symmetries, turn_about
from depthpose.pose.types import Axis, ObjectModel, ViewInput
from depthpose.pose.verify.color import score_by_color

_SWEEP_STEPS = 72  # steps of a sweep about an axis: narrower print is stepped over
_SWEEP_SAMPLES = 1500  # coloured points that are compared in a sweep
_FINE_STEPS = 5  # fine steps in each step of a sweep
_MOST_PEAKS = 3  # largest number of poses that a sweep about one axis returns
_SAME_RAD = math.radians(3)  # angle up to which two proposed copies are the same
_MOST_COPIES = 8  # largest number of copies that are proposed beside a pose
_SAME_MOTION_RAD = math.radians(10)  # angle up to which two rotations that are tried are the same
_MANY_TURNS = 6  # rotations about one line that make a shape nearly a body of revolution
_PARALLEL_COSINE = math.cos(math.radians(8))  # least cosine of two directions that are the same
_ALIGN_STEP_RAD = math.radians(2)  # step of the small sweep about a pose
_ALIGN_STEPS = 10  # steps of it to each side


def propose_color_copies(
    pose: Rigid, model: ObjectModel, view: ViewInput, *, motions: Rigid | None = None
) -> Rigid:
    """Propose poses that depth cannot tell from a given one, but colour may: its copies.

    They are symmetric copies that were found in the shape, near-symmetric ones, and half turns
    about the principal axes. Each is rotated about axes of revolution, or nearly so, to where its
    print agrees. Declared symmetries make no copies: they count as one pose. Refine a copy by
    depth, and align it (:func:`align_print`), before its evidence is compared.

    Args:
        pose: ``camera_from_model``, one.
        model: the object.
        view: depth and colour.
        motions: of the model, to try in place of those found in its shape.

    Returns:
        A batch of poses: ``pose`` itself, then at most eight others, the best agreement first.
    """
    pose = pose.double()
    if model.colors is None or view.color is None:
        return pose[None]
    ambiguous = _find_ambiguous_motions(model)
    tried = ambiguous.motions
    if motions is not None:
        tried = [motions.double()[k] for k in range(len(motions.R))]

    # Each copy, rotated about the axes to where its print agrees.
    proposed: list[Rigid] = []
    for motion in _drop_alike_motions(tried, ambiguous.axes):
        copy = pose @ motion
        swept = [rotate_to_print(copy, axis, model, view) for axis in ambiguous.axes]
        proposed += swept or [copy[None]]
    copies = Rigid.cat(proposed)

    # The best that are distinct.
    order = score_by_color(copies, model, view).argsort(descending=True, stable=True)
    best = pose[None]
    for k in order.tolist():
        apart_rad = geodesic_rad(copies.R[k].expand_as(best.R), best.R)
        if float(apart_rad.min()) > _SAME_RAD and len(best.R) <= _MOST_COPIES:
            best = Rigid.cat([best, copies[k][None]])
    return best


def _drop_alike_motions(motions: Sequence[Rigid], axes: Sequence[Axis]) -> list[Rigid]:
    """Choose motions of which no two are alike, the identity first.

    Two that differ by a rotation about one of the axes are alike: both are swept about it.
    """
    distinct = [Rigid(torch.eye(3).double(), torch.zeros(3).double())]
    for motion in motions:
        is_swept = any(
            _differ_by_rotation_about(axis, motion, other) for axis in axes for other in distinct
        )
        apart_rad = [float(geodesic_rad(motion.R, other.R)) for other in distinct]
        if not is_swept and min(apart_rad) > _SAME_MOTION_RAD:
            distinct.append(motion)
    return distinct


def rotate_to_print(pose: Rigid, axis: Axis, model: ObjectModel, view: ViewInput) -> Rigid:
    """Rotate a pose about an axis of the model to where its print agrees with the image.

    A sweep of the full circle finds the largest agreements; each is refined by finer steps and by
    the parabola through the best three of them.

    Args:
        pose: ``camera_from_model``, one.
        axis: of revolution, of the model's shape, or nearly so.
        model: the object, with colours.
        view: depth and colour.

    Returns:
        Poses at the largest agreements, at most three, the best first; ``pose`` alone where colour
        says nothing.
    """
    if model.colors is None or view.color is None:
        return pose.double()[None]

    # The largest agreements of a sweep.
    step_rad = 2 * math.pi / _SWEEP_STEPS
    sweep_rad = torch.arange(_SWEEP_STEPS, dtype=torch.float64) * step_rad
    rough = score_by_color(_rotate_about(pose, axis, sweep_rad), model, view, _SWEEP_SAMPLES)
    is_peak = (rough >= rough.roll(1)) & (rough > rough.roll(-1)) & (rough > 0)
    peaks = is_peak.nonzero()[:, 0]
    peaks = peaks[rough[peaks].argsort(descending=True)][:_MOST_PEAKS]
    if len(peaks) == 0:
        return pose.double()[None]

    # Finer steps about each: (peaks, 2 * _FINE_STEPS + 1).
    fine_step_rad = step_rad / _FINE_STEPS
    offsets_rad = torch.arange(-_FINE_STEPS, _FINE_STEPS + 1, dtype=torch.float64) * fine_step_rad
    angles_rad = sweep_rad[peaks, None] + offsets_rad
    fine = score_by_color(_rotate_about(pose, axis, angles_rad.flatten()), model, view)
    fine = fine.reshape(angles_rad.shape)

    # A parabola through the best and its two neighbours.
    best = fine.argmax(1).clamp(1, 2 * _FINE_STEPS - 1)[:, None]
    three = fine.gather(1, best + torch.tensor([-1, 0, 1]))
    middle_rad = angles_rad.gather(1, best)[:, 0]
    best_rad = middle_rad + _find_parabola_peak(three) * step_rad / _FINE_STEPS
    order = three[:, 1].argsort(descending=True)
    return _rotate_about(pose, axis, best_rad[order])


def align_print(pose: Rigid, model: ObjectModel, view: ViewInput) -> Rigid:
    """Rotate a pose a little about axes that depth does not fix, to where its print agrees best.

    Refinement by depth lets a pose drift about an axis of revolution.

    Args:
        pose: ``camera_from_model``, one; within 20 degrees of where it belongs.
        model: the object.
        view: depth and colour.

    Returns:
        The rotated pose; the same one where colour says nothing or the shape has no such axis.
    """
    pose = pose.double()
    if model.colors is None or view.color is None:
        return pose
    steps = torch.arange(-_ALIGN_STEPS, _ALIGN_STEPS + 1).double()
    offsets_rad = steps * _ALIGN_STEP_RAD
    for axis in _find_ambiguous_motions(model).axes:
        scores = score_by_color(_rotate_about(pose, axis, offsets_rad), model, view, _SWEEP_SAMPLES)
        best = int(scores.argmax().clamp(1, len(offsets_rad) - 2))
        if float(scores[best]) > 0:
            peak = _find_parabola_peak(scores[best - 1 : best + 2])
            angle_rad = offsets_rad[best] + peak * _ALIGN_STEP_RAD
            pose = _rotate_about(pose, axis, angle_rad[None])[0]
    return pose


def _rotate_about(pose: Rigid, axis: Axis, angles_rad: Float64[Tensor, " a"]) -> Rigid:
    """Rotate the model at a pose about one of its axes by each angle: a batch of poses."""
    turns = turn_about(axis.direction.double(), axis.point_m.double(), angles_rad)
    return pose.double()[None] @ turns


def _find_parabola_peak(values: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b"]:
    """Find the peak of the parabola through values at -1, 0 and 1; between -1 and 1."""
    before, middle, after = values.unbind(-1)
    bend = (before - 2 * middle + after).clamp(max=-1e-9)
    return ((before - after) / (2 * bend)).clamp(-1, 1)


class _AmbiguousMotions(NamedTuple):
    """Motions of a model after which depth looks alike, or nearly."""

    motions: list[Rigid]  #: ``model_from_model``
    axes: list[Axis]  #: about which any rotation is such a motion


@lru_cache(maxsize=64)
def _find_ambiguous_motions(model: ObjectModel) -> _AmbiguousMotions:
    """Find the motions of a model after which depth looks alike or nearly.

    Declared symmetries are not among them.
    """
    assert model.colors is not None
    # Those of the shape: near-symmetries, and symmetries that were found.
    motions = [near.model_from_model.double() for near in near_symmetries(model)]
    axes: list[Axis] = []
    if model.symmetries.is_found:
        discrete = model.symmetries.discrete
        if discrete is not None:
            motions += [discrete.double()[k] for k in range(len(discrete.R))]
        axes += model.symmetries.continuous
    axes += _find_axes_of_many_turns(motions, axes)

    # A box whose halves differ a little looks alike after half turns about its middle.
    points_m = model.colors.points_m.double()
    centred_m = points_m - points_m.mean(0)
    principal = torch.linalg.eigh(centred_m.T.cov()).eigenvectors.T
    along_m = points_m @ principal.T
    middle_m = (along_m.amin(0) + along_m.amax(0)) / 2 @ principal
    half = torch.tensor(math.pi, dtype=torch.float64)
    motions += [turn_about(direction, middle_m, half) for direction in principal]
    return _AmbiguousMotions(motions, axes)


def _find_axes_of_many_turns(turns: Sequence[Rigid], others: Sequence[Axis]) -> list[Axis]:
    """Find the lines that are the axes of many of the turns; none is parallel to ``others``."""
    # The axis of a rotation is the direction that it leaves as it is: (R - 1) axis = 0.
    eye = torch.eye(3).double()
    directions = [torch.linalg.svd(turn.R - eye).Vh[-1] for turn in turns]
    axes: list[Axis] = []
    for direction in directions:
        earlier = [*others, *axes]
        has_axis = any(_are_parallel(direction, axis.direction.double()) for axis in earlier)
        alike = [k for k, other in enumerate(directions) if _are_parallel(other, direction)]
        if has_axis or len(alike) < _MANY_TURNS:
            continue

        # A point that a turn leaves where it is: (1 - R) point = t.
        points_m = [torch.linalg.pinv(eye - turns[k].R, rtol=1e-3) @ turns[k].t_m for k in alike]
        point_m = torch.stack(points_m).median(0).values
        axes.append(Axis(direction=direction, point_m=point_m))
    return axes


def _are_parallel(first: Float64[Tensor, "3"], second: Float64[Tensor, "3"]) -> bool:
    """Whether two unit vectors are of the same line, within 8 degrees."""
    return abs(float(first @ second)) > _PARALLEL_COSINE


def _differ_by_rotation_about(axis: Axis, first: Rigid, second: Rigid) -> bool:
    """Whether two motions differ by a rotation about an axis: both carry it to one direction."""
    direction = axis.direction.double()
    return float((first.R @ direction) @ (second.R @ direction)) > _PARALLEL_COSINE
