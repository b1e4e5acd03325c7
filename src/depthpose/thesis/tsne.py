"""Exact t-SNE onto a line (van der Maaten, Hinton 2008), for the colours of figure 3-2."""

import math

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.errors import InputError

_STEPS = 300
_EARLY_STEPS = 100
"""First steps, in which neighbours attract each other more, so that groups form early."""
_EXAGGERATION = 12.0
"""Factor of that attraction."""
_EARLY_MOMENTUM = 0.5
_LATE_MOMENTUM = 0.8
_START_STD = 1e-4
"""Standard deviation of the numbers at the start: so small that all repel each other alike."""
_GAIN_STEP = 0.2
"""What the gain of a number grows by in each step that goes on in one direction."""
_GAIN_DECAY = 0.8
"""Factor of its gain in a step that turns round."""
_MIN_GAIN = 0.01
_BISECTIONS = 40
"""Steps of the search of a neighbourhood's width."""


def embed_line(features: Float[Tensor, "n c"], perplexity: float = 40.0) -> Float64[Tensor, " n"]:
    """Map features to numbers from 0 to 1, so that alike features get near numbers.

    Exact t-SNE in one dimension, by gradient descent with momentum and gains. It begins along the
    principal component, and so always gives the same answer. Time and memory grow with the square
    of ``n``: it is for thousands of points, not more.

    Args:
        features: features of each point.
        perplexity: about how many neighbours a point has.

    Raises:
        InputError: there are fewer points than three neighbourhoods.
    """
    if not 1 <= perplexity < math.inf:
        raise InputError(f"t-SNE with a perplexity of {perplexity:g}: take 5 to 50, at least 1")
    if len(features) < 3 * perplexity:
        raise InputError(
            f"t-SNE of {len(features)} points with a perplexity of {perplexity:g}: give three "
            "times as many points, or a smaller perplexity"
        )

    # The start: the principal component, very small.
    P = joint_probabilities(features, perplexity)
    centred = features.double() - features.double().mean(0)
    principal_axis = torch.linalg.svd(centred, full_matrices=False)[2][0]
    y = centred @ principal_axis
    y = _START_STD * y / y.std().clamp(min=1e-12)

    # Gradient descent with momentum and gains.
    velocity = torch.zeros_like(y)
    gain = torch.ones_like(y)
    # A rate beyond what the curvature at the start allows tears groups apart, and on a line they
    # never come together again.
    rate = len(y) / (4 * _EXAGGERATION)
    for step in range(_STEPS):
        is_early = step < _EARLY_STEPS
        exaggeration = _EXAGGERATION if is_early else 1.0
        momentum = _EARLY_MOMENTUM if is_early else _LATE_MOMENTUM
        gradient = kl_gradient(P * exaggeration, y)
        goes_on = gradient.sign() != velocity.sign()  # downhill is still where it was
        gain = torch.where(goes_on, gain + _GAIN_STEP, gain * _GAIN_DECAY).clamp(min=_MIN_GAIN)
        velocity = momentum * velocity - rate * gain * gradient
        y = y + velocity

    # Stretched to 0 and 1.
    low = y.amin()
    high = y.amax()
    return (y - low) / (high - low).clamp(min=1e-12)


def joint_probabilities(
    features: Float[Tensor, "n c"], perplexity: float
) -> Float64[Tensor, "n n"]:
    """Compute the similarities P of t-SNE, which are symmetric and sum to 1 over all pairs.

    Each point sees its neighbours through a Gaussian, as wide as the perplexity asks for: about the
    number of neighbours within it.
    """
    # Squared distances, those of nearest neighbours subtracted.
    x = features.double()
    squares = torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist").square()
    squares.fill_diagonal_(torch.inf)
    nearest = squares.amin(1, keepdim=True)
    shifted = squares - nearest  # the nearest neighbour weighs 1, so no row vanishes

    # The precision of each Gaussian, by bisection of its logarithm: the wider it is, the larger is
    # the entropy of its row, whose exponential is the perplexity.
    # It begins between a nearly flat Gaussian and one that sees the nearest neighbour alone.
    low = torch.full_like(nearest, 1e-12)
    high = torch.full_like(nearest, 1e12)
    for _ in range(_BISECTIONS):
        precision = (low * high).sqrt()
        weights = torch.exp(-shifted * precision)
        total = weights.sum(1, keepdim=True)
        mean_square = torch.where(weights > 0, shifted * weights, 0).sum(1, keepdim=True) / total
        entropy = total.log() + precision * mean_square
        is_too_wide = entropy > math.log(perplexity)
        low = torch.where(is_too_wide, precision, low)
        high = torch.where(is_too_wide, high, precision)

    # Each row sums to 1, and then both directions of a pair count alike.
    weights = torch.exp(-shifted * high)
    conditional = weights / weights.sum(1, keepdim=True)
    return (conditional + conditional.T) / (2 * len(x))


def kl_gradient(P: Float64[Tensor, "n n"], y: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
    """Compute the gradient, by y, of the Kullback-Leibler divergence KL(P || Q).

    Q are the similarities of the numbers y by Student's t distribution:
    ``Q_ij ~ 1 / (1 + (y_i - y_j)^2)``, and they sum to 1.
    """
    differences = y[:, None] - y
    weights = 1 / (1 + differences.square())
    weights.fill_diagonal_(0)
    Q = weights / weights.sum()
    return 4 * ((P - Q) * weights * differences).sum(1)
