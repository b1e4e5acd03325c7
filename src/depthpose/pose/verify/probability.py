"""How likely a pose is right, given the evidence for and against it.

At a right pose a tenth of the visible area is contradicted on average, by edges, reflections and
dents that the model does not have; at a wrong pose half of it. Both shares vary from view to view,
so that a count of contradicting patches has a negative binomial distribution: ten patches more say
much of a small object and little of a large one. Likewise the part of the silhouette across which
the surface goes on, but of the length of the silhouette.

How patches are counted :mod:`depthpose.pose.verify.evidence` says; what a count then means is said
by the coefficients of this file alone. ``bench/fit_probability.py`` fits the shares of right and
wrong poses and ``WRONG_RMS``, and prints the odds of views that do show their object.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor
from torch.nn.functional import softplus

from depthpose.pose.sensor import INDEPENDENT_SIDES
from depthpose.pose.types import Evidence


@dataclass(frozen=True, kw_only=True)
class GammaShare:
    """Distribution of a share of the visible area from view to view: gamma, of a mean and a shape.

    A count of patches in an area whose share varies so has a negative binomial distribution.
    """

    mean: float
    shape: float

    def log_likelihood(self, count: float, area: float) -> float:
        """Compute the log probability of a count of patches in an area, in independent patches."""
        rate = self.shape / self.mean
        shape = self.shape
        log_binomial = math.lgamma(count + shape) - math.lgamma(shape) - math.lgamma(count + 1)
        log_none = shape * (math.log(rate) - math.log(rate + area))
        return log_binomial + log_none + count * (math.log(area) - math.log(rate + area))


RIGHT_CONTRADICTED = GammaShare(mean=0.1, shape=2.0)
WRONG_CONTRADICTED = GammaShare(mean=0.5, shape=3.0)
"""Share of what was observed of the visible area that contradicts a right and a wrong pose."""
COPY_CONTRADICTED = GammaShare(mean=0.1, shape=1.0)
"""Of copies, of which the one with the least contradicted is always the likeliest."""
RIGHT_UNOBSERVED = GammaShare(mean=0.2, shape=1.0)
WRONG_UNOBSERVED = GammaShare(mean=0.5, shape=3.0)
"""Share of the visible area that has no reading, or is hidden."""
RIGHT_CONTINUED = GammaShare(mean=0.05, shape=1.0)
LARGER_CONTINUED = GammaShare(mean=0.3, shape=2.0)
"""Share of the silhouette across which the surface goes on: at a right pose, where objects touch,
and at a pose on something larger, such as the side of a larger box."""
WRONG_ON_LARGER = 0.5
"""Share of the wrong poses that lie on something larger; others end where the surface does."""
PRIOR_EXPECTED = 2.0
"""Odds of the best pose being right before its evidence is seen, where a mask or a detector's box
says that the object is there. Of views that do show it the fit gives 5; some masks show another
thing."""
PRIOR_UNEXPECTED = 0.02
"""The same where nothing says so: votes of a whole image refine to some fifty poses for each object
that is there."""
PRIOR_MANY = 0.1
"""Odds of an image holding any number of instances of an object, rather than one at most."""
WRONG_RMS = 1.2
"""Root mean square residual of what supports a wrong pose, in standard deviations: of residuals
that are as often large as small it is 1.7, and refinement makes it smaller."""
VOTES_RAD = 0.15
"""Mean angle between a network's directions and those to the keypoints at a right pose."""
LEAST_AGREEMENT = 2 / 3
"""Share of what was compared that must support a pose."""
MOST_CONTINUED = 0.3
"""Where the surface goes on across more of the silhouette, the pose lies on something larger: one
side in four may touch a thing of the same height."""
LEAST_POSSIBLE = 0.02
"""A proposal of a search that is less likely goes no further."""
LEAST_AREA = 1.0
"""Independent patches: of less nothing is said."""


def probability_right(evidence: Evidence, *, is_expected: bool) -> float:
    """Compute the probability that a pose is right, and not merely the best of the wrong ones.

    Right is a pose up to near-symmetry. The probability is 0 where less than two thirds of what was
    observed supports the pose, and where the surface goes on across much of its silhouette.

    Args:
        evidence: of the pose.
        is_expected: whether a mask or a detector's box says that the object is there.
    """
    if evidence.agreement < LEAST_AGREEMENT or is_on_larger(evidence):
        return 0.0
    return 1 / (1 + math.exp(-log_odds_right(evidence, is_expected=is_expected)))


def log_odds_right(evidence: Evidence, *, is_expected: bool) -> float:
    """Compute the log odds of a pose being right; arguments as of :func:`probability_right`."""
    prior_odds = PRIOR_EXPECTED if is_expected else PRIOR_UNEXPECTED
    return math.log(prior_odds) + log_likelihood_ratio(evidence)


def is_on_larger(evidence: Evidence) -> bool:
    """Whether the surface goes on across so much of the silhouette that it is a larger thing's."""
    return evidence.continued > MOST_CONTINUED * max(LEAST_AREA, evidence.silhouette)


def log_likelihood_ratio(evidence: Evidence) -> float:
    """Compute the log likelihood ratio of a right and a wrong pose, by all the evidence.

    It grows with the area that was compared: a pose that shows little has little to support it, and
    one that shows less than one independent patch has nothing.
    """
    area = evidence.visible
    if area < LEAST_AREA:
        return 0.0
    # Only what was observed can contradict a pose, and what contradicts it was observed.
    observed_area = max(LEAST_AREA, area - evidence.unobserved)
    contradicted = _log_ratio(
        RIGHT_CONTRADICTED, WRONG_CONTRADICTED, evidence.contradicted, observed_area
    )
    rest = max(LEAST_AREA, area - evidence.seen_through - evidence.bulging)
    unobserved = _log_ratio(RIGHT_UNOBSERVED, WRONG_UNOBSERVED, evidence.unobserved, rest)
    continued = _log_ratio_of_continued(evidence.continued, evidence.silhouette)
    # Residuals are of the supported part alone.
    residuals = _log_likelihood_of_residuals(evidence.rms)
    residuals -= _log_likelihood_of_residuals(WRONG_RMS)
    return contradicted + unobserved + continued + evidence.supported_share * residuals


def _log_ratio(right: GammaShare, wrong: GammaShare, count: float, area: float) -> float:
    """Compute the log likelihood ratio, right to wrong pose, of a count of patches in an area."""
    return right.log_likelihood(count, area) - wrong.log_likelihood(count, area)


def _log_ratio_of_continued(continued: float, silhouette: float) -> float:
    """Compute the log likelihood ratio of the silhouette across which the surface goes on."""
    if silhouette < LEAST_AREA:
        return 0.0
    larger = -_log_ratio(RIGHT_CONTINUED, LARGER_CONTINUED, continued, silhouette)
    return -math.log(1 - WRONG_ON_LARGER + WRONG_ON_LARGER * math.exp(larger))


def log_likelihood_of_copy(evidence: Evidence, area: float) -> float:
    """Compute the log likelihood of the evidence for one of several copies, if it is right.

    Args:
        evidence: of the copy.
        area: the largest visible area of the copies, in independent patches.
    """
    contradicted = COPY_CONTRADICTED.log_likelihood(evidence.contradicted, area)
    unobserved = RIGHT_UNOBSERVED.log_likelihood(evidence.unobserved, area)
    continued = 0.0
    if evidence.silhouette >= LEAST_AREA:
        continued = RIGHT_CONTINUED.log_likelihood(evidence.continued, evidence.silhouette)
    residuals = _log_likelihood_of_residuals(evidence.rms)
    return contradicted + unobserved + continued + residuals


def _log_likelihood_of_residuals(rms: float) -> float:
    """Compute the log likelihood of residuals, up to a constant: normal, of variance 1 + rms^2.

    The variance is fitted to them, and at least 1, that of the sensor and the object.
    """
    return -INDEPENDENT_SIDES / 2 * math.log(1 + rms**2)


def probability_of_instances(
    log_odds: Float64[Tensor, " n"], *, is_single: bool
) -> Float64[Tensor, " n"]:
    """Compute the probability of each place of one object, by those of the others.

    A table holds one of each object, a bin holds many: so a second place needs more evidence than
    the first, and where several have it further ones need no more.

    Args:
        log_odds: of each place being right, by itself.
        is_single: whether there is one instance at most, as in a detector's box, and no bin.
    """
    prior_many = 0.0 if is_single else PRIOR_MANY
    by_itself = log_odds.sigmoid()
    log_weights_none_or_one = torch.cat([log_odds.new_zeros(1), log_odds])
    # Weights relative to no instance: of one of them the sum of the odds; of any subset of the
    # places the prior times the product of 1 + odds.
    log_weight_many = log_odds.new_tensor(prior_many).log() + softplus(log_odds).sum()
    probability_many = (log_weight_many - log_weights_none_or_one.logsumexp(0)).sigmoid()
    return (
        probability_many * by_itself
        + (1 - probability_many) * log_weights_none_or_one.softmax(0)[1:]
    )


def share_among_objects(evidences: Sequence[Evidence]) -> Float64[Tensor, " n"]:
    """Compute the probability of each object, if the readings are of one of them.

    Each is weighed by the evidence of its best pose.
    """
    log_ratios = [log_likelihood_ratio(evidence) for evidence in evidences]
    return torch.tensor(log_ratios, dtype=torch.float64).softmax(0)
