"""Evidence of competing poses to probabilities, a status and its reason.

Two questions are asked. Which of the competing poses is it? Each is weighed by the area that
contradicts it, the area that was not observed, and its residual. And is the best of them right at
all? Its evidence is compared with what right and wrong poses leave.

At a right pose a tenth of the visible area is contradicted on average, by edges, reflections and
dents that the model has not; at a wrong pose half of it. Both shares vary from view to view, so
that a count of contradicting patches has a negative binomial distribution: ten patches more say
much of a small object and little of a large one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.types import Evidence


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


RIGHT_CONTRADICTED = Rate(mean=0.1, shape=1.0)
WRONG_CONTRADICTED = Rate(mean=0.5, shape=3.0)
RIGHT_UNOBSERVED = Rate(mean=0.2, shape=1.0)
WRONG_UNOBSERVED = Rate(mean=0.5, shape=3.0)
PRIOR_MASKED = 20.0
"""Odds of the best pose being right before its evidence is seen, where a mask shows the object."""
INDEPENDENT_SIDES = 6.0
"""A real object deviates from its model by whole sides, of which a body has about six: its residual
is that of so few independent observations, however many readings there are."""
VOTES_RAD = 0.15
"""Mean angle between a network's directions and those to the keypoints at a right pose."""
LEAST_AREA = 1.0  # independent patches


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
    """

    pose: Rigid
    covariance: Float[Tensor, "6 6"]
    residual_m: float
    evidence: Evidence
    votes_rad: float | None = None


def share_among_poses(hypotheses: Sequence[Hypothesis]) -> Float64[Tensor, " n"]:
    """Share the probability of one among different poses of an object.

    If one of them is right the others are wrong, and wrong poses leave much contradicted: so each
    is weighed by how much better its evidence fits a right pose than a wrong one.
    """
    area = _common_area(hypotheses)
    weights = [
        _log_odds(hypothesis.evidence, area) + _log_weight(hypothesis) for hypothesis in hypotheses
    ]
    return torch.tensor(weights, dtype=torch.float64).softmax(0)


def share_among_copies(hypotheses: Sequence[Hypothesis]) -> Float64[Tensor, " n"]:
    """Share the probability of one among near-symmetric copies of a pose.

    Wrong copies are contradicted little, for they look nearly alike: so each is weighed by how well
    its evidence fits a right pose.
    """
    area = _common_area(hypotheses)
    weights = []
    for hypothesis in hypotheses:
        evidence = hypothesis.evidence
        fits_right = RIGHT_CONTRADICTED.log_likelihood(evidence.contradicted, area)
        fits_right += RIGHT_UNOBSERVED.log_likelihood(evidence.unobserved, area)
        weights.append(fits_right + _log_weight(hypothesis))
    return torch.tensor(weights, dtype=torch.float64).softmax(0)


def probability_right(evidence: Evidence, prior_odds: float) -> float:
    """Probability that a pose is right, up to near-symmetry, and not the best of wrong ones."""
    log_odds = math.log(prior_odds) + _log_odds(evidence, max(LEAST_AREA, evidence.visible))
    return 1 / (1 + math.exp(-min(log_odds, 50.0)))


def _common_area(hypotheses: Sequence[Hypothesis]) -> float:
    """One visible area for all: a pose that shows little would have little to contradict it."""
    return max(LEAST_AREA, *(hypothesis.evidence.visible for hypothesis in hypotheses))


def _log_odds(evidence: Evidence, area: float) -> float:
    """Log likelihood ratio of a right and a wrong pose, by what is contradicted and unobserved."""
    log_odds = RIGHT_CONTRADICTED.log_likelihood(evidence.contradicted, area)
    log_odds -= WRONG_CONTRADICTED.log_likelihood(evidence.contradicted, area)
    log_odds += RIGHT_UNOBSERVED.log_likelihood(evidence.unobserved, area)
    log_odds -= WRONG_UNOBSERVED.log_likelihood(evidence.unobserved, area)
    return log_odds


def _log_weight(hypothesis: Hypothesis) -> float:
    """Log likelihood of the residuals, and of a network's votes where there is one."""
    # Normal residuals of unknown variance, of at least that of the sensor and the object.
    log_weight = -INDEPENDENT_SIDES / 2 * math.log(1 + hypothesis.evidence.rms**2)
    if hypothesis.votes_rad is not None:
        log_weight -= hypothesis.votes_rad / VOTES_RAD
    return log_weight
