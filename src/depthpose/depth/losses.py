"""What the networks of the depth room are punished for."""

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

GanMode = Literal["vanilla", "lsgan"]
HEAD_WEIGHTS = (0.5, 0.7, 1.0)
"""Weights of the three heads of PSMNet (Chang and Chen 2018)."""


def adversarial_loss(
    logits: Float[Tensor, "b 1 rows columns"], mode: GanMode, *, is_real: bool
) -> Float[Tensor, ""]:
    """Punish logits that do not say ``is_real`` (eq. 2.4 of the thesis).

    ``vanilla`` is binary cross entropy, ``lsgan`` the squared distance from 1 or 0 (Mao et al.
    2017). For the generator, ``is_real`` is what it wants the discriminator to say.
    """
    wanted = torch.full_like(logits, float(is_real))
    if mode == "lsgan":
        return F.mse_loss(logits, wanted)
    return F.binary_cross_entropy_with_logits(logits, wanted)


def discriminator_loss(
    real: Float[Tensor, "b 1 rows columns"],
    fake: Float[Tensor, "b 1 rows columns"],
    mode: GanMode,
) -> Float[Tensor, ""]:
    """Half the sum of both mistakes, which slows the discriminator (pix2pix)."""
    real_loss = adversarial_loss(real, mode, is_real=True)
    return (real_loss + adversarial_loss(fake, mode, is_real=False)) / 2


def l1_loss(made: Float[Tensor, "b 3 h w"], real: Float[Tensor, "b 3 h w"]) -> Float[Tensor, ""]:
    """Mean absolute difference (eq. 2.5 of the thesis)."""
    return (made - real).abs().mean()


def valid_disparity(truth_px: Float[Tensor, "b h w"], max_px: int) -> Bool[Tensor, "b h w"]:
    """Where the truth can be learnt: known, positive and inside the matcher's range."""
    return (truth_px > 0) & (truth_px < max_px)


def disparity_loss(
    found_px: Float[Tensor, "b h w"], truth_px: Float[Tensor, "b h w"], max_px: int
) -> Float[Tensor, ""]:
    """Smooth L1 over the pixels with truth (eq. 2.6 of the thesis); 0 where there are none."""
    is_valid = valid_disparity(truth_px, max_px)
    # NaN truth must not reach the subtraction: its gradient would be NaN even where masked.
    difference = torch.where(is_valid, found_px - truth_px.nan_to_num(0.0), 0.0)
    losses = F.smooth_l1_loss(difference, torch.zeros_like(difference), reduction="sum")
    return losses / is_valid.sum().clamp(min=1)


def heads_loss(
    heads_px: Sequence[Float[Tensor, "b h w"]], truth_px: Float[Tensor, "b h w"], max_px: int
) -> Float[Tensor, ""]:
    """Sum the loss of PSMNet's three heads, the later the heavier."""
    losses = [disparity_loss(head, truth_px, max_px) for head in heads_px]
    return torch.stack([w * x for w, x in zip(HEAD_WEIGHTS, losses, strict=True)]).sum()
