"""Evidence of competing poses to probabilities, a status and its reason.

Two questions are asked. Which of the competing poses is it? Each is weighed by the area that
contradicts it, the area that was not observed, and its residual. And is the best of them right at
all? Its evidence is compared with what right and wrong poses leave.

At a right pose a tenth of the visible area is contradicted on average, by edges, reflections and
dents that the model does not have; at a wrong pose half of it. Both shares vary from view to view,
so that a count of contradicting patches has a negative binomial distribution: ten patches more say
much of a small object and little of a large one.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import ObjectCloud, Refusal
from depthpose.pose.config import EstimateConfig, RefusalConfig
from depthpose.pose.copies import PreparedObject, copies_of, difference_of
from depthpose.pose.evidence import Observation
from depthpose.pose.identity import identify
from depthpose.pose.observability import free_motions, observability, without_motions
from depthpose.pose.sensor import INDEPENDENT_SIDES
from depthpose.pose.types import Alternative, AnyInput, Evidence, PoseEstimate, Vote


@dataclass(frozen=True, kw_only=True)
class Rate:
    """Distribution of a share of the visible area: gamma, of a mean and a shape."""

    mean: float
    shape: float

    def log_likelihood(self, count: float, area: float) -> float:
        """Log probability of so many patches in an area, the share unknown (negative binomial)."""
        scale = self.shape / self.mean
        a = self.shape
        log_binomial = math.lgamma(count + a) - math.lgamma(a) - math.lgamma(count + 1)
        log_none = a * (math.log(scale) - math.log(scale + area))
        return log_binomial + log_none + count * (math.log(area) - math.log(scale + area))


RIGHT_CONTRADICTED = Rate(mean=0.1, shape=2.0)
WRONG_CONTRADICTED = Rate(mean=0.5, shape=3.0)
COPY_CONTRADICTED = Rate(mean=0.1, shape=1.0)
"""Of copies, of which the one with the least contradicted is always the likeliest."""
RIGHT_UNOBSERVED = Rate(mean=0.2, shape=1.0)
WRONG_UNOBSERVED = Rate(mean=0.5, shape=3.0)
PRIOR_MASKED = 5.0
"""Odds of the best pose being right before its evidence is seen, where a mask shows the object."""
PRIOR_REGION = 2.0
"""The same where a detector's box or a mask that does not fit says that one is there."""
PRIOR_PROPOSED = 0.02
"""The same where a search proposed the pose: votes of a whole image refine to some fifty poses for
each object that is there."""
PRIOR_MANY = 0.1
"""Odds of a search showing any number of instances of an object, and not one at most."""
WRONG_RMS = 1.2
"""Root mean square residual of what supports a wrong pose, in standard deviations: of residuals
that are as often large as small it is 1.7, and refinement makes it smaller."""
VOTES_RAD = 0.15
"""Mean angle between a network's directions and those to the keypoints at a right pose."""
OTHER_FRAME = (
    ". Or is the cloud not in the camera's frame (x right, y down, z forward)? A robot's base and "
    "the world have z up: give it as the camera saw it"
)
"""What may be wrong with a cloud that fits no pose: its origin is not where the camera was."""
LEAST_AGREEMENT = 2 / 3  #: share of what was compared that must support a pose
LEAST_AREA = 1.0  # independent patches
LEAST_NAMED = 0.01  #: alternatives of a smaller probability are not named


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """A refined pose and the evidence for it.

    Attributes:
        pose: ``camera_from_model``.
        covariance: 6x6, as :class:`~depthpose.pose.types.PoseFit` says.
        residual_m: root mean square distance of the points to the surface.
        evidence: of the pose.
        votes_rad: mean angle between a network's directions and those to the keypoints of the
            pose; None without a network.
        log_color: log likelihood of the colour image; 0 without one.
    """

    pose: Rigid
    covariance: Float[Tensor, "6 6"]
    residual_m: float
    evidence: Evidence
    votes_rad: float | None = None
    log_color: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Competition:
    """Poses that compete for one object, and how they share the probability of one.

    Attributes:
        best: the likeliest pose.
        best_share: its share.
        copies: near-symmetric copies of it, with their shares.
        others: other poses, with theirs.
    """

    best: Hypothesis
    best_share: float
    copies: list[tuple[Hypothesis, float]]
    others: list[tuple[Hypothesis, float]]

    @property
    def group_share(self) -> float:
        """Share of the best pose and its near-symmetric copies together."""
        return self.best_share + sum(share for _, share in self.copies)


def share_among_poses(
    hypotheses: Sequence[Hypothesis], *, is_masked: bool
) -> Float64[Tensor, " n"]:
    """Share the probability of one among different poses of an object.

    If one of them is right the others are wrong, and wrong poses leave much contradicted: so each
    is weighed by how much better its evidence fits a right pose than a wrong one. They are poses of
    the same readings: where no mask says which, what another pose explains, and a pose does not,
    contradicts it.
    """
    most = 0.0
    if not is_masked:
        most = max(hypothesis.evidence.supported for hypothesis in hypotheses)
    weights: list[float] = []
    for hypothesis in hypotheses:
        evidence = hypothesis.evidence
        unexplained = max(evidence.beside, most - evidence.supported)
        log_odds = log_odds_right(replace(evidence, beside=unexplained))
        weights.append(log_odds + _log_beside_depth(hypothesis))
    return torch.tensor(weights, dtype=torch.float64).softmax(0)


def share_among_copies(hypotheses: Sequence[Hypothesis]) -> Float64[Tensor, " n"]:
    """Share the probability of one among near-symmetric copies of a pose.

    Wrong copies are contradicted little, for they look nearly alike: so each is weighed by how well
    its evidence fits a right pose. A network's votes say nothing here: it saw no more.
    """
    area = max(LEAST_AREA, *(hypothesis.evidence.visible for hypothesis in hypotheses))
    weights: list[float] = []
    for hypothesis in hypotheses:
        evidence = hypothesis.evidence
        fits_right = COPY_CONTRADICTED.log_likelihood(evidence.contradicted, area)
        fits_right += RIGHT_UNOBSERVED.log_likelihood(evidence.unobserved, area)
        weights.append(fits_right + _log_fit(evidence.rms) + hypothesis.log_color)
    return torch.tensor(weights, dtype=torch.float64).softmax(0)


def probability_right(evidence: Evidence, prior_odds: float) -> float:
    """Probability that a pose is right, up to near-symmetry, and not the best of wrong ones.

    It is 0 where less than two thirds of what was observed supports the pose.
    """
    if evidence.agreement < LEAST_AGREEMENT:
        return 0.0
    log_odds = math.log(prior_odds) + log_odds_right(evidence)
    return 1 / (1 + math.exp(-min(log_odds, 50.0)))


def log_odds_right(evidence: Evidence) -> float:
    """Log likelihood ratio of a right and a wrong pose: contradicted, unobserved, residuals.

    It grows with the area that was compared: a pose that shows little has little to support it.
    """
    area = max(LEAST_AREA, evidence.visible)
    # Only what was observed can contradict a pose, and what contradicts it was observed.
    observed_area = max(LEAST_AREA, area - evidence.unobserved)
    rest = max(LEAST_AREA, area - evidence.seen_through - evidence.bulging)
    contradicted = RIGHT_CONTRADICTED.log_likelihood(evidence.contradicted, observed_area)
    contradicted -= WRONG_CONTRADICTED.log_likelihood(evidence.contradicted, observed_area)
    unobserved = RIGHT_UNOBSERVED.log_likelihood(evidence.unobserved, rest)
    unobserved -= WRONG_UNOBSERVED.log_likelihood(evidence.unobserved, rest)
    # Residuals are of the supported part alone.
    fit = evidence.observed * (_log_fit(evidence.rms) - _log_fit(WRONG_RMS))
    return contradicted + unobserved + fit


def _log_fit(rms: float) -> float:
    """Log likelihood of residuals: normal, of a variance of at least the sensor's and object's."""
    return -INDEPENDENT_SIDES / 2 * math.log(1 + rms**2)


def _log_beside_depth(hypothesis: Hypothesis) -> float:
    """Log likelihood of what is known beside depth: a colour image, a network's votes."""
    log_votes = 0.0 if hypothesis.votes_rad is None else -hypothesis.votes_rad / VOTES_RAD
    return log_votes + hypothesis.log_color


def decide(
    cloud: ObjectCloud,
    prepared: PreparedObject,
    competition: Competition,
    observation: Observation,
    refusal: RefusalConfig,
    config: EstimateConfig,
    seconds: dict[str, float],
    prior_odds: float,
    vote: Vote | None = None,
) -> PoseEstimate:
    """Give the likeliest of competing poses as the estimate, or say why it is withheld.

    Args:
        cloud: points of the object.
        prepared: the object.
        competition: of its poses.
        observation: that they were compared with.
        refusal: limits.
        config: settings of the estimate.
        seconds: spent in the stages before.
        prior_odds: of the best pose being right, before its evidence is seen.
        vote: of a network.
    """
    began = time.perf_counter()
    surface, model = prepared.surface, prepared.model
    best = competition.best
    evidence = best.evidence
    probability = probability_right(evidence, prior_odds)

    # Does the view determine a pose, and is it of this object?
    free = free_motions(model.symmetries.continuous, best.pose)
    observable, weakest = observability(cloud.cloud_m, best.pose, surface, free)
    identity = None
    withheld = None
    if observable < refusal.min_observability:
        motion = "rotation" if float(weakest[:3].norm()) > math.sqrt(0.5) else "shift"
        withheld = Refusal(
            status="not observable",
            reason=f"the visible part of the object leaves one {motion} undetermined: it moves the "
            f"surface along its normals by {observable:.1%} of the motion only; no declared "
            "symmetry allows it. Declare the symmetry, or look from a side that shows more",
        )
    elif probability < refusal.min_probability:
        withheld = Refusal(status="doubtful", reason=contradiction(evidence, probability))
    elif config.with_icp and refusal.max_size_error < 1:
        identity = identify(
            cloud.cloud_m,
            best.pose,
            model.name,
            surface,
            copies_of(prepared).mirror,
            evidence,
            observation.step * float(observation.K[0, 0]),
            refusal.max_size_error,
            config.object_deviation_m,
        )
        if identity.status == "contradicted":
            withheld = Refusal(status="doubtful", reason=identity.reason)
    facts: dict[str, Any] = {
        "name": cloud.name,
        "object": model.name,
        "keypoints_m": None if vote is None else vote.keypoints_m.float(),
        "inlier_share": None if vote is None else float(vote.inlier_share.mean()),
        "residual_m": best.residual_m,
        "evidence": evidence,
        "identity": identity,
        "seconds": {**seconds, "decision": time.perf_counter() - began},
    }
    if withheld is not None:  # all but the pose, so that nobody takes it for an estimate
        is_doubtful_cloud = cloud.view is None and withheld.status == "doubtful"
        words = withheld.reason + OTHER_FRAME * is_doubtful_cloud
        return PoseEstimate(status=withheld.status, reason=words, **facts)

    covariance = without_motions(best.covariance, free) if len(free) else best.covariance
    competitors = [(h, share, True) for h, share in competition.copies]
    competitors += [(h, share, False) for h, share in competition.others]
    competitors.sort(key=lambda competitor: -competitor[1])
    alternatives = tuple(
        Alternative(
            camera_from_model=hypothesis.pose.float(),
            probability=probability * share,
            difference=difference_of(hypothesis.pose, best.pose, copies_of(prepared)),
            is_copy=is_copy,
        )
        for hypothesis, share, is_copy in competitors
        if probability * share >= LEAST_NAMED
    )
    estimate = PoseEstimate(
        status="ok",
        camera_from_model=best.pose.float(),  # computed in double precision
        covariance=covariance.float(),
        free_motions=free.float(),
        certainty=probability * competition.group_share,
        copy_certainty=probability * competition.best_share,
        alternatives=alternatives,
        **facts,
    )
    answer = with_status(estimate, config.min_certainty)
    if answer.status == "ambiguous" and cloud.view is None:
        return replace(answer, reason=answer.reason + OTHER_FRAME)
    return answer


def contradiction(evidence: Evidence, probability: float) -> str:
    """Say what contradicts a pose most."""
    compared = max(evidence.supported + evidence.contradicted, 1e-9)
    visible = max(evidence.visible, 1e-9)
    parts = {
        f"the camera saw through {evidence.seen_through / visible:.0%} of the posed surface": (
            evidence.seen_through
        ),
        f"{evidence.bulging / compared:.0%} of its readings lie before the posed surface": (
            evidence.bulging
        ),
        f"{evidence.beside / compared:.0%} of the object's readings lie beside the posed "
        "silhouette": evidence.beside,
        f"{evidence.unobserved / visible:.0%} of the posed surface was not observed": (
            evidence.unobserved / 2
        ),
    }
    worst = max(parts, key=lambda words: parts[words])
    if parts[worst] < LEAST_AREA / 4:
        worst = "too little of the object was observed"
        if evidence.rms > WRONG_RMS:
            worst = f"its residuals are {evidence.rms:.1f} times what the sensor explains"
    return (
        f"the best pose is right with a probability of {probability:.0%}: {worst}. Another object, "
        "a mask of more than the object, or too little of it"
    )


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
    while digits < 17 and len({f"{percent:.{digits}g}" for percent in percents}) == 1:
        digits += 1  # until one is seen to be below the other
    reason = (
        f"this pose has a certainty of {percents[0]:.{digits}g} %, below min_certainty "
        f"{percents[1]:.{digits}g} %: "
        + (f"{others} others fit too" if others else "others may fit")
    )
    return replace(estimate, status="ambiguous", reason=reason)


def refused(given: AnyInput, refusal: Refusal, seconds: dict[str, float]) -> PoseEstimate:
    """Give the estimate of an input without a pose."""
    return PoseEstimate(
        name=given.name,
        object=given.object,
        status=refusal.status,
        reason=refusal.reason,
        seconds=seconds,
    )
