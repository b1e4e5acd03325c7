"""The best of the poses that fit, as an answer, or the reason why it is withheld."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.config import RefusalConfig
from depthpose.pose.estimator.alternatives import (
    Candidate,
    PoseAmbiguities,
    alternatives_among,
    share_out,
)
from depthpose.pose.estimator.doubt import Posed, find_refusal
from depthpose.pose.estimator.evidence import without_motions
from depthpose.pose.estimator.prepare import Refusal
from depthpose.pose.estimator.refusal import risk_of
from depthpose.pose.refine import Refined
from depthpose.pose.types import Alternative, ObjectModel, PoseEstimate, PoseFit, Vote
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


class Found(NamedTuple):
    """A pose, its covariance and residual, the evidence against it, and which others fit."""

    pose: Rigid
    covariance: Float[Tensor, "6 6"]
    residual_m: float
    signals: dict[str, float]
    share: float
    alternatives: tuple[Alternative, ...]


def candidate_of(source: PoseFit | Refined) -> Candidate:
    """Take a fitted or a refined pose as one that may be right."""
    return Candidate(source.camera_from_model.double(), source.covariance, float(source.residual_m))


def choose(
    candidates: Sequence[Candidate],
    evidence: Sequence[dict[str, float]],
    signals: dict[str, float],
    copies: PoseAmbiguities,
    refusal: RefusalConfig,
) -> Found:
    """Choose among the poses that fit by the evidence against each."""
    shares = share_out(evidence, refusal.candidate_slopes)
    number = int(shares.argsort(descending=True, stable=True)[0])
    alternatives = alternatives_among(candidates, evidence, shares, copies)
    every = {**signals, **evidence[number]}
    return Found(*candidates[number], every, float(shares[number]), alternatives)


def answer_of(model: ObjectModel, found: Found, vote: Vote | None = None) -> PoseEstimate:
    """Make an answer of what was found; checked it is not yet."""
    free = free_motions(model.symmetries.continuous, found.pose)
    # Worked out in float64, given as points and models come: in float32.
    return PoseEstimate(
        name="",
        object=model.name,
        status="ok",
        camera_from_model=found.pose.float(),
        keypoints_m=None if vote is None else vote.keypoints_m.float(),
        covariance=without_motions(found.covariance, free).float(),
        free_motions=free.float(),
        inlier_share=None if vote is None else float(vote.inlier_share.mean()),
        residual_m=found.residual_m,
        signals=found.signals,
    )


def checked(
    posed: Posed,
    found: Found,
    answer: PoseEstimate,
    refusal: RefusalConfig,
    clock: Clock,
    *,
    with_icp: bool = True,
) -> PoseEstimate:
    """Withhold an answer that is doubtful; its signals gain those that are measured last."""
    reason = find_refusal(posed, found.signals, refusal, with_icp=with_icp)
    clock.note("check")
    risk = risk_of(found.signals, refusal)
    if reason is not None:
        return withheld(answer.object, reason, clock, answer, risk)
    return _with_certainty(replace(answer, risk=risk, seconds=clock.seconds), found)


def _with_certainty(answer: PoseEstimate, found: Found) -> PoseEstimate:
    """Share what the risk leaves among the pose and its alternatives."""
    if answer.risk is None and not found.alternatives:
        return answer
    known = 1.0 if answer.risk is None else 1 - answer.risk
    others = tuple(replace(a, probability=known * a.probability) for a in found.alternatives)
    return replace(answer, certainty=known * found.share, alternatives=others)


def withheld(
    object: str,
    refusal: Refusal,
    clock: Clock,
    answer: PoseEstimate | None = None,
    risk: float | None = None,
) -> PoseEstimate:
    """Keep what was found out but the pose: a refusal cannot be taken for an answer."""
    known = answer is not None
    return PoseEstimate(
        name="",
        object=object,
        status=refusal.status,
        reason=refusal.reason,
        keypoints_m=answer.keypoints_m if known else None,
        inlier_share=answer.inlier_share if known else None,
        residual_m=answer.residual_m if known else None,
        risk=risk,
        signals=answer.signals if known else {},
        seconds=clock.seconds,
    )
