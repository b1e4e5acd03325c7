"""Losses of the depth networks."""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from depthpose.depth.types import Maps, Views

HEAD_WEIGHTS = (0.5, 0.7, 1.0)
"""Weights of the three heads of PSMNet (Chang and Chen 2018)."""


def adversarial_loss(
    logits: Float[Tensor, "b 1 rows columns"], mode: str, *, is_real: bool
) -> Float[Tensor, ""]:
    """Loss of a discriminator's logits against the label ``is_real`` (eq. 2.4 of the thesis).

    ``mode`` is a key of ``ADVERSARIAL_LOSSES``. The generator trains with ``is_real=True``.
    """
    return ADVERSARIAL_LOSSES[mode](logits, torch.full_like(logits, float(is_real)))


ADVERSARIAL_LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "vanilla": F.binary_cross_entropy_with_logits,
    "lsgan": F.mse_loss,  # Mao et al. 2017
}
"""Losses of logits and labels by their names in configs: a new one is one entry here."""


def disparity_loss(
    found_px: Maps, truth_px: Maps, max_px: int, *, sky_weight: float = 0.0
) -> Float[Tensor, ""]:
    """Smooth L1 over the pixels with truth (eq. 2.6 of the thesis); 0 where there are none.

    A pixel of the sky (truth 0) counts as ``sky_weight`` pixels of a disparity of 0.
    """
    is_valid = (truth_px > 0) & (truth_px < max_px)
    weights = is_valid.float() + sky_weight * (truth_px == 0)
    # NaN truth must not reach the subtraction: its gradient would be NaN even where masked.
    difference = torch.where(weights > 0, found_px - truth_px.nan_to_num(0.0), 0.0)
    losses = F.smooth_l1_loss(difference, torch.zeros_like(difference), reduction="none")
    return (weights * losses).sum() / weights.sum().clamp(min=1)


def heads_loss(
    heads_px: Sequence[Maps], truth_px: Maps, max_px: int, *, sky_weight: float = 0.0
) -> Float[Tensor, ""]:
    """Sum the loss of up to three heads, the later the heavier; the last has the weight 1."""
    losses = [disparity_loss(head, truth_px, max_px, sky_weight=sky_weight) for head in heads_px]
    weights = HEAD_WEIGHTS[-len(losses) :]
    return torch.stack([w * x for w, x in zip(weights, losses, strict=True)]).sum()


def sky_loss(probability: Maps, truth_px: Maps) -> Float[Tensor, ""]:
    """Mean cross entropy of the class of the sky, where it is known whether it is (truth 0)."""
    is_known = truth_px >= 0
    is_sky = truth_px == 0
    of_truth = torch.where(is_sky, probability, 1 - probability)
    # Gradients stay finite where a probability is 0 in float32.
    losses = torch.where(is_known, -(of_truth + 1e-4).log(), 0.0)
    return losses.sum() / is_known.sum().clamp(min=1)


def log_disparity_loss(
    found_log_px: Maps, truth_px: Maps, range_px: tuple[float, float]
) -> Float[Tensor, ""]:
    """Mean absolute difference of the logarithm of disparity: a relative error of depth.

    Each image with truth counts the same, however sparse its truth is; truth outside ``range_px``
    counts as its end. NaN and the sky (0) do not count.
    """
    truth = truth_px.nan_to_num(1.0).clamp(*range_px).log()
    return _mean_of_images((found_log_px - truth).abs(), truth_px > 0)


def _mean_of_images(error: Tensor, is_known: Tensor) -> Tensor:
    """Average over the pixels with truth of each image, then over the images that have any."""
    counts = is_known.sum((1, 2))
    means = torch.where(is_known, error, 0.0).sum((1, 2)) / counts.clamp(min=1)
    return means.sum() / (counts > 0).sum().clamp(min=1)


GENERATOR_DISPARITY_LOSSES: dict[str, Callable[[Tensor, Tensor, tuple[float, float]], Tensor]] = {
    "log": log_disparity_loss,
}
"""Losses of a generator that selects, by their names in configs: a new one is a function of the
log of disparity, the true disparity (NaN: unknown, 0: sky) and its range, and one entry here."""


def plane_loss(
    logits: Float[Tensor, "b classes rows columns"],
    truth_px: Float[Tensor, "b rows columns"],
    planes: Float[Tensor, " planes"],
) -> Float[Tensor, ""]:
    """Cross entropy of the classes sky (0) and planes (1, 2, ...), shared between two neighbours.

    Each image with truth counts the same, however sparse its truth is.

    The truth is 0 in the sky and NaN where unknown; planes are evenly spaced in their logarithm.
    """
    is_sky = truth_px == 0
    logs = planes.log()
    place = (truth_px.nan_to_num(1.0).clamp(planes[0], planes[-1]).log() - logs[0]) / (
        logs[1] - logs[0]
    )
    lower = place.floor().clamp(0, len(planes) - 2)
    share = torch.where(is_sky, 0.0, place - lower)
    first = torch.where(is_sky, 0, lower.long() + 1)[:, None]
    scores = logits.float().log_softmax(1)
    near = scores.gather(1, first)[:, 0]
    far = scores.gather(1, first + 1)[:, 0]
    return _mean_of_images(-(near * (1 - share) + far * share), truth_px >= 0)


def view_loss(drawn: Views, real: Views) -> Float[Tensor, " b"]:
    """L1 of a drawn view and of its horizontal gradient, for each image."""
    colour = (drawn - real).abs().mean((1, 2, 3))
    gradient = ((drawn[..., 1:] - drawn[..., :-1]) - (real[..., 1:] - real[..., :-1])).abs()
    return colour + gradient.mean((1, 2, 3))
