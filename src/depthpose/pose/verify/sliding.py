"""A pose slid to where the image fits it best, along directions that its points do not fix.

ICP compares points with the surface: a long profile that runs out of the image may slide along
itself while its points stay on it. Where it ends, and where its holes are, shows in the image
alone: there the camera saw through the posed surface, or readings of the object lie beside it.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, move_reference
from depthpose.pose.geometry.surface import Surface
from depthpose.pose.types import Evidence, PoseFit
from depthpose.pose.verify.evidence import Observation, compare
from depthpose.pose.verify.probability import LEAST_AGREEMENT

_POINTS = 1000  # of the cloud, by which directions are judged
_LEAST_NORMAL_RMS = 0.4
"""Root mean square component of the observed normals along a direction, from which the points fix
the pose along it."""
_COARSE_DIAMETERS = 0.025  # a coarse step
_FINE_STEPS = 4  # fine steps in a coarse one
_CLEARER_PATCHES = 1.0
"""Independent patches by which the first step must be better."""
_EQUAL_PATCHES = 0.5
"""Places that differ by less fit equally well."""
_FIXED_DIAMETERS = (0.0125, 0.025, 0.05)
"""Shifts that are tried, the smallest first: by one of them an image that fixes a pose contradicts
it."""
_FIXED_PATCHES = 1.0
"""Independent patches by which it contradicts the shifted pose more."""


def slide(
    fit: PoseFit, evidence: Evidence, observation: Observation, surface: Surface
) -> tuple[PoseFit, Evidence]:
    """Slide a pose along directions that its points do not fix, if the image contradicts it.

    Args:
        fit: the pose, refined by ICP.
        evidence: of it.
        observation: of the object.
        surface: of the model.

    Returns:
        The pose in the middle of the places that fit the image best, with their extent as its
        deviation, and its evidence. Both are unchanged if no place is better by a patch, or if so
        much contradicts the pose that it is wrong in another way.
    """
    # A part that is seen whole is held by its two ends. And without a mask nothing contradicts a
    # pose that leaves readings of its object uncovered.
    if not observation.leaves_image or not observation.is_masked:
        return fit, evidence
    if evidence.contradicted == 0 or evidence.agreement < LEAST_AGREEMENT:
        return fit, evidence
    for direction in _find_free_directions(fit.camera_from_model.double(), observation, surface):
        fit, evidence = _slide_along(direction, fit, evidence, observation, surface)
    return fit, evidence


def _find_free_directions(
    pose: Rigid, observation: Observation, surface: Surface
) -> list[Float64[Tensor, "3"]]:
    """Find directions across which few observed normals point, in the camera frame.

    Returns:
        Unit vectors, that of the smallest components first: two of a plate, one of a profile.
    """
    points_m = pose.inverse().apply(take_evenly(observation.cloud_m, _POINTS))
    nearest = surface.nearest(points_m, is_exact=False)
    normals = surface.normals[nearest.sample][nearest.distance_m < surface.near_m] @ pose.R.mT
    if len(normals) == 0:
        return []
    squares, directions = torch.linalg.eigh(normals.T @ normals / len(normals))
    return [directions[:, k] for k in range(2) if float(squares[k]) < _LEAST_NORMAL_RMS**2]


def _slide_along(
    direction: Float64[Tensor, "3"],
    fit: PoseFit,
    evidence: Evidence,
    observation: Observation,
    surface: Surface,
) -> tuple[PoseFit, Evidence]:
    """Slide a pose along a direction; arguments and result are those of :func:`slide`."""
    pose = fit.camera_from_model.double()

    def shift(shift_m: float) -> Rigid:
        """Shift the pose along the direction."""
        return Rigid(pose.R, pose.t_m + shift_m * direction)

    def measure_misfit(shift_m: float) -> float:
        """Add up the patches that contradict the shifted pose, or where it was not observed."""
        shifted = compare(observation, shift(shift_m), surface)
        return shifted.contradicted + shifted.continued + shifted.unobserved

    # In coarse steps, to the side that is better, as long as it grows better.
    step_m = _COARSE_DIAMETERS * surface.diameter_m
    start_misfit = evidence.contradicted + evidence.continued + evidence.unobserved
    backward = measure_misfit(-step_m)
    forward = measure_misfit(step_m)
    best_misfit = min(backward, forward)
    if best_misfit > start_misfit - _CLEARER_PATCHES:
        return fit, evidence
    signed_step_m = step_m if forward < backward else -step_m
    best_m = signed_step_m
    next_misfit = measure_misfit(best_m + signed_step_m)
    while next_misfit < best_misfit and abs(best_m) < surface.diameter_m:
        best_m += signed_step_m
        best_misfit = next_misfit
        next_misfit = measure_misfit(best_m + signed_step_m)

    # In fine steps about the best place. Edges are not compared: several places fit equally well.
    around = torch.linspace(-1, 1, 2 * _FINE_STEPS + 1).tolist()
    fine_m = [best_m + step * step_m for step in around]
    misfits = [measure_misfit(shift_m) for shift_m in fine_m]
    first = last = misfits.index(min(misfits))
    most = min(misfits) + _EQUAL_PATCHES
    while first > 0 and misfits[first - 1] <= most:
        first -= 1
    while last + 1 < len(misfits) and misfits[last + 1] <= most:
        last += 1
    fixed = FixedShift(
        direction=direction,
        middle_m=observation.cloud_m.mean(0),
        deviation_m=(fine_m[last] - fine_m[first]) / 2 + step_m / _FINE_STEPS,
    )
    slid = replace(
        fit,
        camera_from_model=shift((fine_m[first] + fine_m[last]) / 2),
        covariance=fixed.set_deviation(fit.covariance),
    )
    return slid, compare(observation, slid.camera_from_model, surface)


class FixedShift(NamedTuple):
    """A shift of a pose that its points leave free, and the image does not."""

    direction: Float64[Tensor, "3"]  #: unit vector, in the camera frame
    middle_m: Float64[Tensor, "3"]  #: of the points
    deviation_m: float  #: standard deviation of the middle along the direction

    def set_deviation(self, covariance: Float[Tensor, "6 6"]) -> Float[Tensor, "6 6"]:
        """Return the covariance of a pose with this deviation of its middle.

        ``covariance``: of (rotation, translation) about the camera, as that of a fit.
        """
        along = torch.cat([torch.zeros(3, dtype=torch.float64), self.direction])
        variance_along = torch.outer(along, along)
        others = torch.eye(6, dtype=torch.float64) - variance_along
        about_middle = move_reference(covariance.double(), -self.middle_m)
        about_middle = others @ about_middle @ others + self.deviation_m**2 * variance_along
        return move_reference(about_middle, self.middle_m).to(covariance)


def find_fixed_shift(
    pose: Rigid, direction: Float64[Tensor, "3"], observation: Observation, surface: Surface
) -> FixedShift | None:
    """Find how far a pose may shift along a direction until the image contradicts it more.

    Args:
        pose: ``camera_from_model``.
        direction: unit vector, in the camera frame.
        observation: of the object.
        surface: of the model.

    Returns:
        The smallest shift that is tried and contradicted both ways; None if none is.
    """

    def count_contradicting(shift_m: float) -> float:
        """Count the patches that contradict the shifted pose."""
        shifted = Rigid(pose.R, pose.t_m + shift_m * direction)
        evidence = compare(observation, shifted, surface)
        return evidence.contradicted + evidence.continued

    limit = count_contradicting(0.0) + _FIXED_PATCHES
    for diameters in _FIXED_DIAMETERS:
        shift_m = diameters * surface.diameter_m
        if min(count_contradicting(-shift_m), count_contradicting(shift_m)) >= limit:
            return FixedShift(direction, observation.cloud_m.mean(0), shift_m)
    return None
