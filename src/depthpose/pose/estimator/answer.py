"""The best of the poses that fit, as an answer, or the reason why it is withheld."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from depthpose.pose.config import EstimateConfig, RefusalConfig
from depthpose.pose.estimator.candidates import (
    Candidate,
    PoseAmbiguities,
    alternatives_among,
    observability,
    share_out,
    without_motions,
)
from depthpose.pose.estimator.fit import SHOWN, fit_of, identity_of, seen_about
from depthpose.pose.estimator.inputs import ObjectCloud, Refusal
from depthpose.pose.refine import RefinedPose
from depthpose.pose.surface import Surface
from depthpose.pose.types import Fit, ObjectModel, PoseEstimate, PoseFit, Vote
from depthpose.pose.voting import free_motions


@dataclass
class Clock:
    """Seconds of each stage."""

    seconds: dict[str, float] = field(default_factory=dict)
    last: float = field(default_factory=time.perf_counter)

    def note(self, stage: str) -> None:
        """Give a stage the time since the one before."""
        now = time.perf_counter()
        self.seconds[stage] = now - self.last
        self.last = now


def candidate_of(source: PoseFit | RefinedPose) -> Candidate:
    """Take a fitted or a refined pose as one that may be right."""
    return Candidate(source.camera_from_model.double(), source.covariance, float(source.residual_m))


def answer_of(
    cloud: ObjectCloud,
    model: ObjectModel,
    surface: Surface,
    copies: PoseAmbiguities,
    candidates: Sequence[Candidate],
    evidence: Sequence[dict[str, float]],
    refusal: RefusalConfig,
    config: EstimateConfig,
    clock: Clock,
    vote: Vote | None = None,
) -> PoseEstimate:
    """Choose among poses by the evidence against each; ask whether it fits and is that object."""
    seen = seen_about(cloud.cloud_m, cloud.view, surface.diameter_m)
    shares = share_out(evidence, refusal.candidate_slopes)
    number = int(shares.argsort(descending=True, stable=True)[0])
    fit = fit_of(seen, candidates[number].pose, surface)
    shares = shares * min(1.0, fit.agrees / SHOWN)  # the rest is that of a pose that was not found
    pose, covariance, residual_m = candidates[number]
    free = free_motions(model.symmetries.continuous, pose)
    reason, identity = misfit_of(fit, refusal), None
    if reason is None:
        observable, motion = observability(cloud.cloud_m, pose, surface, free)
        if observable < refusal.min_hold:
            what = "turn" if float(motion[:3].norm()) > math.sqrt(0.5) else "shift"
            reason = Refusal(
                status="not observable",
                reason=f"the seen part of the object leaves one {what} undetermined: it moves the "
                f"surface along its normals by {observable:.1%} of the motion only; no declared "
                "symmetry allows it. Declare the symmetry, or look from a side that shows more",
            )
    if reason is None and config.with_icp and refusal.max_size_error < 1:
        identity = identity_of(cloud, pose, model, surface, fit, seen, refusal.max_size_error)
        if identity.status == "contradicted":
            reason = Refusal(status="doubtful", reason=identity.reason)
    clock.note("check")
    # Worked out in float64, given as points and models come: in float32.
    answer = PoseEstimate(
        name="",
        object=model.name,
        status="ok",
        camera_from_model=pose.float(),
        keypoints_m=None if vote is None else vote.keypoints_m.float(),
        covariance=without_motions(covariance, free).float(),
        free_motions=free.float(),
        inlier_share=None if vote is None else float(vote.inlier_share.mean()),
        residual_m=residual_m,
        signals=evidence[number],
        fit=fit,
        identity=identity,
        certainty=float(shares[number]),
        alternatives=alternatives_among(candidates, evidence, shares, copies),
        seconds=clock.seconds,
    )
    if reason is not None:
        return withheld(answer.object, reason, clock, answer)
    return with_status(answer, config.min_certainty)


def with_status(answer: PoseEstimate, min_certainty: float) -> PoseEstimate:
    """Say that a pose is ambiguous where its certainty is below the limit, and else ok."""
    if answer.camera_from_model is None:
        return answer
    if answer.certainty is None or answer.certainty >= min_certainty:
        return replace(answer, status="ok", reason="")
    others = (
        f"{len(answer.alternatives)} others fit too" if answer.alternatives else "others may fit"
    )
    reason = (
        f"this pose has a certainty of {answer.certainty:.0%}, below min_certainty "
        f"{min_certainty:.0%}: {others}"
    )
    return replace(answer, status="ambiguous", reason=reason)


def misfit_of(fit: Fit, limits: RefusalConfig) -> Refusal | None:
    """Say why a pose does not fit what the camera saw; None where it does."""
    if fit.agrees < limits.min_agreement:
        reason = (
            f"of the posed surface that was seen {1 - fit.agrees:.0%} lies where the camera saw "
            f"something else, and {1 - limits.min_agreement:.0%} may: another object or pose"
        )
    elif fit.beyond > limits.max_beyond:
        reason = (
            f"{fit.beyond:.1%} of the object's readings lie beside the posed silhouette, and "
            f"{limits.max_beyond:.0%} may: another object, a larger one, or a mask of more than it"
        )
    elif fit.explained < limits.min_explained:
        reason = (
            f"{1 - fit.explained:.0%} of the object's readings are nowhere near the posed surface, "
            f"and {1 - limits.min_explained:.0%} may be: another object, or a mask of more than it"
        )
    else:
        return None
    return Refusal(status="doubtful", reason=reason)


def withheld(
    object: str, refusal: Refusal, clock: Clock, answer: PoseEstimate | None = None
) -> PoseEstimate:
    """Keep what was found out but the pose: a refusal cannot be taken for an answer."""
    known = PoseEstimate(name="", object=object, status=refusal.status, reason=refusal.reason,
                         seconds=clock.seconds)  # fmt: skip
    if answer is None:
        return known
    kept = ("keypoints_m", "inlier_share", "residual_m", "fit", "identity", "signals")
    return replace(known, **{name: getattr(answer, name) for name in kept})
