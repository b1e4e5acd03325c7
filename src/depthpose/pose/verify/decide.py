"""Competing poses and their probabilities to an estimate: a pose, or the reason for none."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.nn.functional import normalize

from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import OTHER_FRAME
from depthpose.pose.config import EstimateConfig, RefusalConfig
from depthpose.pose.geometry.surface import Surface
from depthpose.pose.refusals import Refused
from depthpose.pose.types import Alternative, Evidence, Identity, PoseEstimate
from depthpose.pose.verify.copies import describe_difference
from depthpose.pose.verify.evidence import Observation
from depthpose.pose.verify.hypotheses import Competition, Hypothesis
from depthpose.pose.verify.identity import identify
from depthpose.pose.verify.observability import free_motions, observability, without_motions
from depthpose.pose.verify.probability import (
    LEAST_AREA,
    WRONG_RMS,
    is_on_larger,
    probability_right,
    share_among_objects,
)
from depthpose.pose.verify.sliding import FixedShift, find_fixed_shift
from depthpose.pose.verify.target_object import TargetObject

_HIDDEN_WEIGHT = 0.5
"""Of an area that was not observed beside one that contradicts: it may only be hidden."""
_LEAST_CONTRADICTING = LEAST_AREA / 4
"""Independent patches: a smaller area does not explain why a pose is doubted."""
_LARGEST_ROTATION = 0.2
"""Largest part of a unit motion that is rotation, where it counts as a shift."""
LEAST_NAMED = 0.005
"""Alternatives of a smaller probability are not named."""
LEAST_SHARE = 0.8
"""Where no object among several has so large a share of the probability, none is reported."""


def decide(
    competition: Competition,
    observation: Observation,
    target: TargetObject,
    config: EstimateConfig,
    *,
    is_expected: bool,
) -> PoseEstimate:
    """Return the likeliest of competing poses as the estimate, still without a name.

    Args:
        competition: of the poses.
        observation: that they were compared with.
        target: the object.
        config: of limits; without ICP size and mirror image are not tested.
        is_expected: whether a mask or a detector's box says that the object is there.

    Raises:
        Refused: it is not observable, doubtful, or of another object.
    """
    model = target.model
    best = competition.best
    probability = probability_right(best.evidence, is_expected=is_expected)
    free = free_motions(model.symmetries.continuous, best.pose)

    # A cloud, other than a depth image, may be in another frame than the camera's.
    hint = f". {OTHER_FRAME}" if observation.view is None else ""

    # Does the view determine a pose, is it right, and is it of this object?
    measured: dict[str, Any] = {
        "residual_m": float(best.refined.residual_m),
        "evidence": best.evidence,
    }
    try:
        fixed = require_observable(observation, target, best.pose, free, config.limits)
        require_right(best.evidence, probability, config.limits, is_masked=observation.is_masked)
        identity = _require_identity(best, observation, target, config)
    except Refused as refused:  # all but the pose, so that nobody takes it for an estimate
        reason = refused.reason + (hint if refused.status == "doubtful" else "")
        measured = {**measured, **refused.measured}
        raise Refused(refused.status, reason, **measured) from refused

    covariance = best.refined.covariance
    if fixed is not None:
        covariance = fixed.set_deviation(covariance)
    estimate = PoseEstimate(
        name="",
        object=model.name,
        status="ok",
        camera_from_model=best.pose.float(),  # computed in double precision
        covariance=without_motions(covariance, free).float(),
        free_motions=free.float(),
        certainty=probability * competition.group_share,
        copy_certainty=probability * competition.best_share,
        identity=identity,
        alternatives=_list_alternatives(competition, probability, target),
        **measured,
    )
    estimate = with_status(estimate, config.min_certainty)
    if estimate.status == "ambiguous":
        return replace(estimate, reason=estimate.reason + hint)
    return estimate


def require_observable(
    observation: Observation,
    target: TargetObject,
    pose: Rigid,
    free: Float[Tensor, "k 6"],
    limits: RefusalConfig,
) -> FixedShift | None:
    """Raise :class:`Refused` where a view leaves a motion beside the free ones undetermined.

    A shift that the image alone determines is returned. The rotation about an axis of
    near-symmetry may stay undetermined: the copies about it are named as alternatives.

    Args:
        observation: of the object.
        target: the object.
        pose: of it.
        free: motions of declared symmetries, by
            :func:`~depthpose.pose.verify.observability.free_motions`.
        limits: the least share by which every other motion must move the visible surface.

    Returns:
        The shift that an end or a hole in the image determines, and the points do not; None where
        the points determine all motions.
    """
    near_axis = target.copies.near_axis
    if near_axis is not None:
        free = torch.cat([free, free_motions((near_axis,), pose)])
    observed = observability(observation.cloud_m, pose, target.surface, free)
    if observed is None:
        raise Refused("doubtful", "too few points lie on the posed surface to determine a pose")
    observable, weakest = observed
    if observable >= limits.min_observability:
        return None
    motion = "rotation" if float(weakest[:3].norm()) > math.sqrt(0.5) else "shift"
    fixed = _find_fixed_shift(observation, target.surface, pose, free, weakest, limits)
    if fixed is not None:
        return fixed
    raise Refused(
        "not observable",
        f"the visible part of the object leaves one {motion} undetermined: it moves the "
        f"surface along its normals by {observable:.1%} of the motion only; no declared "
        "symmetry allows it. Declare the symmetry, or look from a side that shows more",
    )


def _find_fixed_shift(
    observation: Observation,
    surface: Surface,
    pose: Rigid,
    free: Float[Tensor, "k 6"],
    weakest: Float64[Tensor, "6"],
    limits: RefusalConfig,
) -> FixedShift | None:
    """Find whether the weakest motion is a shift that the image determines, and the only weak one.

    Arguments are those of :func:`require_observable`, and ``weakest`` that of ``observability``.
    """
    if float(weakest[:3].norm()) > _LARGEST_ROTATION:
        return None
    direction = normalize(weakest[3:], dim=0)
    along = torch.cat([torch.zeros(3, dtype=torch.float64), direction])[None]
    others = observability(observation.cloud_m, pose, surface, torch.cat([free.double(), along]))
    if others is None or others[0] < limits.min_observability:
        return None
    return find_fixed_shift(pose, direction, observation, surface)


def require_right(
    evidence: Evidence, probability: float, limits: RefusalConfig, *, is_masked: bool
) -> None:
    """Raise :class:`Refused` where a pose is right with too small a probability.

    Args:
        evidence: of the pose.
        probability: of its being right.
        limits: the least probability.
        is_masked: whether all points were taken for the object's, as a mask gives them.
    """
    if probability < limits.min_probability:
        raise Refused("doubtful", explain_doubt(evidence, probability, is_masked=is_masked))


def _require_identity(
    best: Hypothesis,
    observation: Observation,
    target: TargetObject,
    config: EstimateConfig,
) -> Identity | None:
    """Raise :class:`Refused` where another size or the mirror image of the object fits better.

    Returns:
        Whether it is this object; None where that is not tested.
    """
    max_size_error = config.limits.max_size_error
    if not config.with_icp or max_size_error >= 1:
        return None
    identity = identify(best, observation, target, max_size_error)
    if identity.status == "contradicted":
        raise Refused("doubtful", identity.reason, identity=identity)
    return identity


def _list_alternatives(
    competition: Competition, probability: float, target: TargetObject
) -> tuple[Alternative, ...]:
    """List the poses that may be right in place of the best, the likeliest first."""
    competitors = [(h, share, True) for h, share in competition.copies]
    competitors += [(h, share, False) for h, share in competition.others]
    competitors.sort(key=lambda competitor: -competitor[1])
    return tuple(
        Alternative(
            camera_from_model=hypothesis.pose.float(),
            probability=probability * share,
            difference=describe_difference(hypothesis.pose, competition.best.pose, target.copies),
            is_copy=is_copy,
        )
        for hypothesis, share, is_copy in competitors
        if probability * share >= LEAST_NAMED
    )


def explain_doubt(evidence: Evidence, probability: float, *, is_masked: bool) -> str:
    """Explain why a pose is doubted: what contradicts it most, and what may be the cause.

    Args:
        evidence: of the pose.
        probability: of its being right, too low.
        is_masked: whether all points were taken for the object's, as a mask gives them.
    """
    compared = max(evidence.supported + evidence.contradicted, 1e-9)
    visible = max(evidence.visible, 1e-9)
    through_share = evidence.seen_through / visible
    bulging_share = evidence.bulging / compared
    beside_share = evidence.beside / compared
    unobserved_share = evidence.unobserved / visible
    goes_on = "the surface within the posed silhouette goes on beyond it"
    findings = [
        (evidence.seen_through, f"the camera saw through {through_share:.0%} of the posed surface"),
        (evidence.bulging, f"{bulging_share:.0%} of its readings lie before the posed surface"),
        (
            evidence.beside,
            f"{beside_share:.0%} of the object's readings lie beside the posed silhouette",
        ),
        (evidence.continued, goes_on),
        (
            _HIDDEN_WEIGHT * evidence.unobserved,
            f"{unobserved_share:.0%} of the posed surface was not observed",
        ),
    ]
    area, worst = max(findings)
    if is_on_larger(evidence):
        worst = goes_on
    elif area < _LEAST_CONTRADICTING:
        worst = "too little of the object was observed"
        if evidence.rms > WRONG_RMS:
            worst = f"its residuals are {evidence.rms:.1f} times what the sensor explains"
    causes = "Another object, or too little of it"
    if is_masked:
        causes = "Another object, a mask of more than the object, or too little of it"
    return f"the best pose is right with a probability of {probability:.0%}: {worst}. {causes}"


def with_status(estimate: PoseEstimate, min_certainty: float) -> PoseEstimate:
    """Set the status by the certainty: ``ambiguous`` below the limit, else ``ok``."""
    certainty = estimate.certainty
    if certainty is None:  # refused, or not compared
        return estimate
    if certainty >= min_certainty:
        return replace(estimate, status="ok", reason="")
    others = sum(not alternative.is_copy for alternative in estimate.alternatives)
    percents = (100 * certainty, 100 * min_certainty)
    digits = 3
    # As many digits as show that one is below the other; 17 tell any two floats apart.
    while digits < 17 and len({f"{percent:.{digits}g}" for percent in percents}) == 1:
        digits += 1
    reason = (
        f"this pose has a certainty of {percents[0]:.{digits}g} %, below min_certainty "
        f"{percents[1]:.{digits}g} %: "
        + (f"{others} others fit too" if others else "others may fit")
    )
    return replace(estimate, status="ambiguous", reason=reason)


def choose_object(estimates: Sequence[PoseEstimate], min_certainty: float) -> PoseEstimate:
    """Choose which object one input shows, from the estimates for every object that it may be.

    An object that was refused is not the one; one of the others is.

    Args:
        estimates: for the same input, one an object.
        min_certainty: of an estimate that is ``ok``.

    Returns:
        The best, its certainty given the others; refused where none is posed, or where another
        object is too likely.
    """
    posed = [estimate for estimate in estimates if estimate.is_posed]
    seconds = seconds_of_all(estimates)
    if not posed:
        nearest = max(estimates, key=lambda e: 0.0 if e.evidence is None else e.evidence.agreement)
        names = ", ".join(estimate.object for estimate in estimates)
        reason = f"none of {names} surely; {nearest.object} comes nearest: {nearest.reason}"
        return replace(nearest, reason=reason, seconds=seconds)
    best, shares = likeliest_object(posed)
    if float(shares.max()) < LEAST_SHARE:
        candidates = ", ".join(
            f"{estimate.object} ({float(its_share):.0%})"
            for estimate, its_share in zip(posed, shares, strict=True)
        )
        return PoseEstimate(
            name=best.name,
            object=best.object,
            status="doubtful",
            reason=f"it may be {candidates}; say which by object",
            seconds=seconds,
        )
    return with_status(replace(best, seconds=seconds), min_certainty)


def seconds_of_all(estimates: Iterable[PoseEstimate]) -> dict[str, float]:
    """Add up what each stage took for several estimates."""
    seconds: dict[str, float] = {}
    for estimate in estimates:
        for stage, stage_s in estimate.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + stage_s
    return seconds


def likeliest_object(
    estimates: Sequence[PoseEstimate],
) -> tuple[PoseEstimate, Float64[Tensor, " n"]]:
    """Choose the likeliest of the estimates for one place; return it and the share of each object.

    All of them have evidence. The probabilities of the likeliest are multiplied by its share.
    """
    evidences: list[Evidence] = []
    for estimate in estimates:
        assert estimate.evidence is not None
        evidences.append(estimate.evidence)
    shares = share_among_objects(evidences)
    best = int(shares.argmax())
    share = float(shares[best])
    estimate = estimates[best]
    chosen = with_share(estimate, share)
    if len(estimates) > 1 and estimate.identity is not None and share < 1 - LEAST_NAMED:
        second = estimates[int(shares.topk(2).indices[1])].object
        reason = f"it may be {second} ({1 - share:.0%} for all other objects)"
        identity = replace(estimate.identity, status="not excluded", other=second, reason=reason)
        chosen = replace(chosen, identity=identity)
    return chosen, shares


def with_share(estimate: PoseEstimate, share: float) -> PoseEstimate:
    """Multiply the probabilities of an estimate by a share."""
    certainty, copy_certainty = estimate.certainty, estimate.copy_certainty
    return replace(
        estimate,
        certainty=None if certainty is None else share * certainty,
        copy_certainty=None if copy_certainty is None else share * copy_certainty,
        alternatives=tuple(
            replace(alternative, probability=share * alternative.probability)
            for alternative in estimate.alternatives
        ),
    )
