"""Losses of the depth networks."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.depth.types import Maps, Views

HEAD_WEIGHTS = (0.5, 0.7, 1.0)
"""Weights of the three heads of PSMNet (Chang and Chen 2018)."""


def adversarial_loss(
    logits: Float[Tensor, "b 1 rows columns"], mode: str, *, is_real: bool
) -> Float[Tensor, ""]:
    """Compute the mean loss of a discriminator's logits for one label (eq. 2.4 of the thesis).

    Args:
        logits: logits that a patch or pixel is real.
        mode: a key of ``ADVERSARIAL_LOSSES``.
        is_real: the label. The generator is trained with True for its own views.
    """
    return ADVERSARIAL_LOSSES[mode](logits, torch.full_like(logits, float(is_real)))


ADVERSARIAL_LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "vanilla": F.binary_cross_entropy_with_logits,
    "lsgan": F.mse_loss,  # Mao et al. 2017
}
"""Losses of logits and labels by their names in configs: a new one is one entry here."""


def disparity_loss(
    predicted_px: Maps, truth_px: Maps, max_px: int, *, sky_weight: float = 0.0
) -> Float[Tensor, ""]:
    """Compute the mean smooth L1 loss of disparity [px] (eq. 2.6 of the thesis).

    Args:
        predicted_px: predicted disparity.
        truth_px: true disparity; 0 in the sky, NaN where it is unknown.
        max_px: truth from here on does not count.
        sky_weight: weight of a pixel of the sky; other pixels with truth have the weight 1.

    Returns:
        The weighted mean over the pixels with truth; 0 where there is none.
    """
    is_valid = (truth_px > 0) & (truth_px < max_px)
    weights = is_valid.float() + sky_weight * (truth_px == 0)
    # NaN truth must not reach the subtraction: its gradient would be NaN even where masked.
    difference = torch.where(weights > 0, predicted_px - truth_px.nan_to_num(0.0), 0.0)
    losses = F.smooth_l1_loss(difference, torch.zeros_like(difference), reduction="none")
    return (weights * losses).sum() / weights.sum().clamp(min=1)


def heads_loss(
    heads_px: Sequence[Maps], truth_px: Maps, max_px: int, *, sky_weight: float = 0.0
) -> Float[Tensor, ""]:
    """Sum :func:`disparity_loss` over up to three heads, weighted by ``HEAD_WEIGHTS``.

    With fewer than three heads, the last weights count.
    """
    losses = [disparity_loss(head, truth_px, max_px, sky_weight=sky_weight) for head in heads_px]
    weights = HEAD_WEIGHTS[-len(losses) :]
    weighted = [weight * loss for weight, loss in zip(weights, losses, strict=True)]
    return torch.stack(weighted).sum()


_MIN_PROBABILITY = 1e-4
"""Added to probabilities, so that gradients of their logarithms are finite where they are 0."""


class StereoLoss(NamedTuple):
    """The loss of a stereo network, and the part of it that is for the sky."""

    total: Float[Tensor, ""]
    sky: Float[Tensor, ""] | None  # not weighted; None of a network without a class of the sky


def stereo_loss(
    heads_px: Sequence[Maps],
    sky_probability: Maps | None,
    truth_px: Maps,
    max_px: int,
    sky_weight: float,
) -> StereoLoss:
    """Compute the loss by which all stereo networks are trained.

    Args:
        heads_px: disparities of the network's heads, the final one last.
        sky_probability: probability of the sky, of a network that has a class for it.
        truth_px: true disparity; 0 in the sky, NaN where it is unknown.
        max_px: truth from here on does not count.
        sky_weight: weight of the sky: of the cross entropy of its class, or without such a class of
            its pixels, which are taught a disparity of 0.
    """
    if sky_probability is None:
        return StereoLoss(heads_loss(heads_px, truth_px, max_px, sky_weight=sky_weight), None)
    sky = sky_loss(sky_probability, truth_px)
    return StereoLoss(heads_loss(heads_px, truth_px, max_px) + sky_weight * sky, sky)


def sky_loss(probability: Maps, truth_px: Maps) -> Float[Tensor, ""]:
    """Compute the mean binary cross entropy of the sky over the pixels with truth.

    ``probability``: that a pixel shows the sky; ``truth_px``: 0 in the sky, NaN where unknown.
    """
    has_truth = truth_px >= 0
    is_sky = truth_px == 0
    true_probability = torch.where(is_sky, probability, 1 - probability)
    losses = torch.where(has_truth, -(true_probability + _MIN_PROBABILITY).log(), 0.0)
    return losses.sum() / has_truth.sum().clamp(min=1)


def log_disparity_loss(
    predicted_log_px: Maps, truth_px: Maps, range_px: tuple[float, float]
) -> Float[Tensor, ""]:
    """Compute the mean absolute error of the log of disparity, which is a relative error of depth.

    Each image with truth counts the same, however sparse its truth is.

    Args:
        predicted_log_px: natural logarithm of the predicted disparity [px].
        truth_px: true disparity; 0 in the sky and NaN where unknown, which do not count.
        range_px: least and largest disparity, to which the truth is clamped.
    """
    true_log_px = truth_px.nan_to_num(1.0).clamp(*range_px).log()
    return _average_images((predicted_log_px - true_log_px).abs(), truth_px > 0)


def _average_images(error: Maps, has_truth: Bool[Tensor, "b h w"]) -> Float[Tensor, ""]:
    """Average over the pixels with truth of each image, then over the images that have any."""
    counts = has_truth.sum((1, 2))
    means = torch.where(has_truth, error, 0.0).sum((1, 2)) / counts.clamp(min=1)
    return means.sum() / (counts > 0).sum().clamp(min=1)


def plane_loss(
    logits: Float[Tensor, "b classes rows columns"],
    truth_px: Float[Tensor, "b rows columns"],
    planes: Float[Tensor, " planes"],
) -> Float[Tensor, ""]:
    """Compute the mean cross entropy of the classes: the sky (0), and planes of disparity (1, ...).

    A true disparity between two planes divides the target probability between both, linearly in its
    logarithm. Each image with truth counts the same, however sparse its truth is.

    Args:
        logits: logits of the classes.
        truth_px: true disparity; 0 in the sky, NaN where it is unknown.
        planes: disparities of the planes [px], evenly spaced in their logarithm.
    """
    # The fractional number of the plane at the true disparity.
    is_sky = truth_px == 0
    log_planes = planes.log()
    log_truth = truth_px.nan_to_num(1.0).clamp(planes[0], planes[-1]).log()
    position = (log_truth - log_planes[0]) / (log_planes[1] - log_planes[0])

    # The classes of the planes around it; all of the sky belongs to class 0.
    lower_plane = position.floor().clamp(0, len(planes) - 2)
    upper_share = torch.where(is_sky, 0.0, position - lower_plane)
    lower_class = torch.where(is_sky, 0, lower_plane.long() + 1)[:, None]

    log_probabilities = logits.float().log_softmax(1)
    lower_log = log_probabilities.gather(1, lower_class)[:, 0]
    upper_log = log_probabilities.gather(1, lower_class + 1)[:, 0]
    cross_entropy = -(lower_log * (1 - upper_share) + upper_log * upper_share)
    return _average_images(cross_entropy, truth_px >= 0)


def view_loss(synthesised: Views, real: Views) -> Float[Tensor, " b"]:
    """Compute L1 of each synthesised view plus L1 of its horizontal gradient."""
    color_loss = (synthesised - real).abs().mean((1, 2, 3))
    synthesised_gradient = synthesised[..., 1:] - synthesised[..., :-1]
    real_gradient = real[..., 1:] - real[..., :-1]
    gradient_loss = (synthesised_gradient - real_gradient).abs().mean((1, 2, 3))
    return color_loss + gradient_loss
