"""How far a depth or disparity map is from the truth.

All arithmetic is float64, so that a mean does not depend on the order of its terms.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.depth.types import View

SMALLEST_DEPTH_M = 1e-3
"""Predicted depth of zero or below becomes this, as in the published script of the Eigen split."""

Numbers = Float[Tensor, " n"]
Quantity = Literal["depth", "disparity", "disparity_noc"]
"""Depth [m]; disparity [px] of all pixels with truth, or of those that both views see."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One number over the pixels of a frame that have truth: a column of every table."""

    name: str  #: of the column
    of: Quantity  #: the values that are compared
    #: from the predicted and the true values, each ``(n,)`` float64
    function: Callable[[Tensor, Tensor], float]
    better: Literal["lower", "higher"] = "lower"  #: which values are the better ones
    is_printed: bool = True  #: whether the printed table has it; files have all


def measure(of: Quantity, predicted: Numbers, true: Numbers) -> dict[str, float]:
    """Give every metric of a kind, in the order of ``METRICS``.

    Args:
        of: what the values are.
        predicted: of depth positive and finite, already clamped as the protocol says.
        true: of depth positive and finite.

    Raises:
        InputError: no pixel at all, or a depth that is not positive and finite.
    """
    if predicted.numel() == 0:
        raise InputError(f"{of}: there is no pixel to compare; the truth may be empty.")
    if of == "depth":
        for role, depth_m in (("predicted", predicted), ("true", true)):
            if not bool((torch.isfinite(depth_m) & (depth_m > 0)).all()):
                raise InputError(
                    f"the {role} depth holds values that are not positive and finite; mask or "
                    "clamp them first, as the protocol says."
                )
    p = predicted.double()
    t = true.double()
    return {metric.name: metric.function(p, t) for metric in METRICS.values() if metric.of == of}


def _end_point_error(p: Tensor, t: Tensor) -> float:
    return float((p - t).abs().mean())


def _share_bad(p: Tensor, t: Tensor) -> float:
    error = (p - t).abs()
    return float(((error > 3) & (error > 0.05 * t)).double().mean())


def _share_within(p: Tensor, t: Tensor, factor: float) -> float:
    return float((torch.maximum(p / t, t / p) < factor).double().mean())


_within = [partial(_share_within, factor=1.25**k) for k in (1, 2, 3)]
METRICS = {
    metric.name: metric
    for metric in (
        Metric(name="abs_rel", of="depth", function=lambda p, t: float(((p - t).abs() / t).mean())),
        Metric(name="sq_rel", of="depth", function=lambda p, t: float(((p - t) ** 2 / t).mean())),
        Metric(name="rmse", of="depth", function=lambda p, t: float(((p - t) ** 2).mean().sqrt())),
        Metric(
            name="rmse_log",
            of="depth",
            function=lambda p, t: float(((p.log() - t.log()) ** 2).mean().sqrt()),
        ),
        Metric(name="d1", of="depth", function=_within[0], better="higher"),
        Metric(name="d2", of="depth", function=_within[1], better="higher", is_printed=False),
        Metric(name="d3", of="depth", function=_within[2], better="higher", is_printed=False),
        Metric(name="epe_px", of="disparity", function=_end_point_error),
        Metric(name="d1_all", of="disparity", function=_share_bad),
        Metric(name="epe_noc_px", of="disparity_noc", function=_end_point_error, is_printed=False),
        Metric(name="d1_noc", of="disparity_noc", function=_share_bad, is_printed=False),
    )
}
"""Metrics by name, in the order of the columns: a new one is a function and one entry here.

Of depth the seven of Eigen et al. (2014), where d1, d2 and d3 are the shares of pixels with
max(p / t, t / p) below 1.25, 1.25^2 and 1.25^3; of disparity those of the KITTI 2015 devkit: the
mean end-point error, and the share off by more than 3 px and by more than 5 % of the truth."""

RANKING: dict[Quantity, str] = {"depth": "abs_rel", "disparity": "epe_px"}
"""The metric by which frames are ranked, and whose error is set beside the confidence."""


def garg_crop(height: int, width: int) -> Bool[Tensor, "height width"]:
    """Mask of Garg et al. (2016), its corners truncated as in the published script."""
    mask = torch.zeros(height, width, dtype=torch.bool)
    top = int(0.40810811 * height)
    bottom = int(0.99189189 * height)
    mask[top:bottom, int(0.03594771 * width) : int(0.96405229 * width)] = True
    return mask


def sparsification_area(error: Numbers, confidence: Numbers, steps: int = 50) -> float:
    """AUSE: how far removing the least confident pixels is from removing the worst ones.

    Both orders remove 0 %, 2 %, ... of the pixels; the area between the two curves of the mean
    remaining error, divided by the mean error of all pixels (Ilg et al. 2018). 0 is an oracle;
    a confidence that knows nothing, such as a constant, gives the area under (1 - oracle).

    Raises:
        InputError: no pixel at all.
    """
    if error.numel() == 0:
        raise InputError("sparsification_area: there is no pixel to compare.")
    if float(error.double().mean()) == 0:
        return 0.0
    error = error.double()
    curves = []
    for keep_first in (confidence.double(), -error):
        # The mean error of what is left, the pixels of low ``keep_first`` removed first.
        descending = torch.argsort(keep_first, descending=True)
        counts = torch.arange(1, len(error) + 1)
        running = _shared_error(error, keep_first)[descending].cumsum(0) / counts
        remaining = len(error) * (1 - torch.arange(steps, dtype=error.dtype) / steps)
        curves.append(running[remaining.ceil().long().clamp(min=1) - 1])
    return float(((curves[0] - curves[1]) / error.mean()).mean())


def score_confidence(error: Numbers, confidence: Numbers) -> dict[str, float]:
    """Compare a confidence with an oracle and with chance; see :func:`sparsification_area`.

    Returns:
        ``ause`` of the confidence, ``ause_random`` of one that knows nothing, and their ratio
        ``ause_share``: 0 an oracle, 1 no better than chance, above 1 misleading. Where all errors
        are equal every order is as good as the oracle's, and the share is 0.
    """
    ause = sparsification_area(error, confidence)
    ause_random = sparsification_area(error, torch.zeros_like(error))
    share = ause / ause_random if ause_random > 0 else 0.0
    return {"ause": ause, "ause_random": ause_random, "ause_share": share}


def error_by_decile(error: Numbers, confidence: Numbers) -> Float[Tensor, "10"]:
    """Mean error of the least sure tenth of the pixels, of the next, ..., of the surest.

    Pixels of equal confidence share their mean error. NaN for a tenth without a pixel.
    """
    ascending = torch.argsort(confidence)
    tenths = _shared_error(error.double(), confidence)[ascending].tensor_split(10)
    return torch.stack([tenth.mean() for tenth in tenths])


def _shared_error(error: Numbers, key: Numbers) -> Numbers:
    """Give pixels of an equal key their mean error: their order must not matter."""
    values, group = key.unique(return_inverse=True)
    count = torch.zeros(len(values), dtype=error.dtype).index_add_(0, group, torch.ones_like(error))
    mean = torch.zeros(len(values), dtype=error.dtype).index_add_(0, group, error) / count
    return mean[group]


def view_errors(drawn: View, real: View) -> dict[str, float]:
    """Compare a drawn right view with the real one, both RGB in [0, 1].

    Returns:
        ``right_l1``: mean absolute difference; ``right_psnr_db``: peak signal-to-noise ratio [dB];
        ``right_sharpness``: mean size of the drawn view's gradient as a share of the real one's: 1
        as sharp, less blurred.
    """
    difference = drawn.double() - real.double()
    mean_square = difference.square().mean().clamp(min=1e-12)
    gradient, real_gradient = (
        image.diff(dim=2).abs().double().mean() + image.diff(dim=1).abs().double().mean()
        for image in (drawn, real)
    )
    return {
        "right_l1": float(difference.abs().mean()),
        "right_psnr_db": float(-10 * torch.log10(mean_square)),
        "right_sharpness": float(gradient / real_gradient.clamp(min=1e-12)),
    }
