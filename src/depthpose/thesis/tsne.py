"""Exact t-SNE onto a line: features of points to one number each (van der Maaten, Hinton 2008)."""

import math

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.errors import InputError

_STEPS = 300
_EXAGGERATED = 100
"""At first near ones attract each other twelve times as much, so that groups form early."""
_EXAGGERATION = 12.0
_SEARCH = 40


def embed_line(features: Float[Tensor, "n c"], perplexity: float = 40.0) -> Float64[Tensor, " n"]:
    """Map features to numbers from 0 to 1, so that alike features get near numbers.

    Begins along the principal component, and so always gives the same answer; gradient descent
    with momentum and gains. Time and memory grow with the square of ``n``: thousands, not more.

    Args:
        features: of any scale.
        perplexity: how many neighbours a point has, about.

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
    P = joint_probabilities(features, perplexity)
    y = _principal(features.double())
    y = 1e-4 * y / y.std().clamp(min=1e-12)
    speed, gain = torch.zeros_like(y), torch.ones_like(y)
    # A larger one than the curvature at the start allows tears groups apart, and on a line they
    # never come together again.
    rate = len(y) / (4 * _EXAGGERATION)
    for step in range(_STEPS):
        is_early = step < _EXAGGERATED
        gradient = kl_gradient(P * (_EXAGGERATION if is_early else 1.0), y)
        agrees = gradient.sign() != speed.sign()
        gain = torch.where(agrees, gain + 0.2, gain * 0.8).clamp(min=0.01)
        speed = (0.5 if is_early else 0.8) * speed - rate * gain * gradient
        y = y + speed
    low, high = y.amin(), y.amax()
    return (y - low) / (high - low).clamp(min=1e-12)


def joint_probabilities(
    features: Float[Tensor, "n c"], perplexity: float
) -> Float64[Tensor, "n n"]:
    """Say how near each pair is: Gaussian neighbourhoods of equal perplexity, made symmetric."""
    x = features.double()
    squares = torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist").square()
    squares.fill_diagonal_(torch.inf)
    near = squares.amin(1, keepdim=True)
    shifted = squares - near  # the nearest counts 1, so nothing vanishes
    low, high = torch.full_like(near, 1e-12), torch.full_like(near, 1e12)
    for _ in range(_SEARCH):
        precision = (low * high).sqrt()
        is_wide = _entropy(shifted, precision) > math.log(perplexity)
        low, high = torch.where(is_wide, precision, low), torch.where(is_wide, high, precision)
    rows = torch.exp(-shifted * high)
    rows = rows / rows.sum(1, keepdim=True)
    return (rows + rows.T) / (2 * len(x))


def kl_gradient(P: Float64[Tensor, "n n"], y: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
    """Gradient of the divergence of P from the Student neighbourhoods of y."""
    gap = y[:, None] - y
    near = 1 / (1 + gap.square())
    near.fill_diagonal_(0)
    return 4 * ((P - near / near.sum()) * near * gap).sum(1)


def _entropy(shifted: Tensor, precision: Tensor) -> Float64[Tensor, "n 1"]:
    rows = torch.exp(-shifted * precision)
    total = rows.sum(1, keepdim=True)
    mean = torch.where(rows > 0, shifted * rows, 0).sum(1, keepdim=True) / total
    return total.log() + precision * mean


def _principal(x: Float64[Tensor, "n c"]) -> Float64[Tensor, " n"]:
    centred = x - x.mean(0)
    _, _, rows = torch.linalg.svd(centred, full_matrices=False)
    return centred @ rows[0]
