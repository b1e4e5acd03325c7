"""Metrics of a depth or disparity map against the truth.

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
    """A metric over the pixels of a frame that have truth: a column of every table."""

    name: str  #: name of the column
    of: Quantity  #: the values that are compared
    #: from the predicted and the true values, each ``(n,)`` float64
    function: Callable[[Tensor, Tensor], float]
    better: Literal["lower", "higher"] = "lower"  #: which values are the better ones
    is_printed: bool = True  #: whether the printed table has it; files have all


def measure(of: Quantity, predicted: Numbers, true: Numbers) -> dict[str, float]:
    """Compute all metrics of one quantity, by name, in the order of ``METRICS``.

    Args:
        of: the quantity that is compared.
        predicted: its predicted values, already clamped as the protocol says; depth is positive and
            finite.
        true: its true values; depth is positive and finite.

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


def _measure_end_point_error(p: Tensor, t: Tensor) -> float:
    """Compute the mean absolute error of disparity [px], from predicted ``p`` and true ``t``."""
    return float((p - t).abs().mean())


def _measure_bad_share(p: Tensor, t: Tensor) -> float:
    """Compute KITTI's D1: the share of disparities off by more than 3 px and more than 5 %."""
    error_px = (p - t).abs()
    is_bad = (error_px > 3) & (error_px > 0.05 * t)
    return float(is_bad.double().mean())


def _measure_share_within(p: Tensor, t: Tensor, factor: float) -> float:
    """Compute the share of depths with max(p / t, t / p) below a factor."""
    ratio = torch.maximum(p / t, t / p)
    return float((ratio < factor).double().mean())


_within = [partial(_measure_share_within, factor=1.25**k) for k in (1, 2, 3)]
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
        Metric(name="epe_px", of="disparity", function=_measure_end_point_error),
        Metric(name="d1_all", of="disparity", function=_measure_bad_share),
        Metric(
            name="epe_noc_px",
            of="disparity_noc",
            function=_measure_end_point_error,
            is_printed=False,
        ),
        Metric(name="d1_noc", of="disparity_noc", function=_measure_bad_share, is_printed=False),
    )
}
"""Metrics by name, in the order of the columns: a new one is a function and one entry here.

Of depth the seven of Eigen et al. (2014), where d1, d2 and d3 are the shares of pixels with
max(p / t, t / p) below 1.25, 1.25^2 and 1.25^3; of disparity those of the KITTI 2015 devkit: the
mean end-point error, and the share off by more than 3 px and by more than 5 % of the truth."""

RANKING: dict[Quantity, str] = {"depth": "abs_rel", "disparity": "epe_px"}
"""The metric by which frames are ranked, and whose error is set beside the confidence."""


def garg_crop(height: int, width: int) -> Bool[Tensor, "height width"]:
    """Make the mask of Garg et al. (2016): True in the part of a KITTI image that counts.

    Its borders are rounded down as in the published script.
    """
    mask = torch.zeros(height, width, dtype=torch.bool)
    top = int(0.40810811 * height)
    bottom = int(0.99189189 * height)
    left = int(0.03594771 * width)
    right = int(0.96405229 * width)
    mask[top:bottom, left:right] = True
    return mask


def sparsification_area(error: Numbers, confidence: Numbers, steps: int = 50) -> float:
    """Compute AUSE, the area under the sparsification error (Ilg et al. 2018).

    Pixels are removed step by step, once those of least confidence first, and once those of largest
    error first (the oracle). Either way the mean error of the remaining pixels is a curve.

    Args:
        error: error of each pixel, of any unit.
        confidence: its confidence, of any scale; only the order counts.
        steps: number of steps; by default 0 %, 2 %, ..., 98 % of the pixels are removed.

    Returns:
        The area between both curves, divided by the mean error of all pixels. It is 0 for an
        oracle, and for a constant confidence the area between the oracle's curve and 1.

    Raises:
        InputError: no pixel at all.
    """
    if error.numel() == 0:
        raise InputError("sparsification_area: there is no pixel to compare.")
    if float(error.double().mean()) == 0:
        return 0.0
    error = error.double()
    by_confidence = _compute_sparsification_curve(error, confidence.double(), steps)
    by_error = _compute_sparsification_curve(error, -error, steps)
    return float(((by_confidence - by_error) / error.mean()).mean())


def _compute_sparsification_curve(
    error: Numbers, score: Numbers, steps: int
) -> Float[Tensor, " steps"]:
    """Compute the mean error of the pixels that remain at each step, the lowest scores removed."""
    descending = torch.argsort(score, descending=True)
    counts = torch.arange(1, len(error) + 1)
    mean_of_first = _average_ties(error, score)[descending].cumsum(0) / counts
    # At step k a share of k / steps is removed; one pixel remains at least.
    remaining = len(error) * (1 - torch.arange(steps, dtype=error.dtype) / steps)
    return mean_of_first[remaining.ceil().long().clamp(min=1) - 1]


def score_confidence(error: Numbers, confidence: Numbers) -> dict[str, float]:
    """Measure how well a confidence ranks errors; see :func:`sparsification_area`.

    Returns:
        ``ause`` of the confidence; ``ause_random``, that of a constant confidence; and their ratio
        ``ause_share``: 0 for an oracle, 1 for chance, above 1 for a misleading confidence. Where
        all errors are equal every order is as good as the oracle's, and the share is 0.
    """
    ause = sparsification_area(error, confidence)
    ause_random = sparsification_area(error, torch.zeros_like(error))
    share = ause / ause_random if ause_random > 0 else 0.0
    return {"ause": ause, "ause_random": ause_random, "ause_share": share}


def error_by_decile(error: Numbers, confidence: Numbers) -> Float[Tensor, "10"]:
    """Compute the mean error of each tenth of the pixels, from the least confidence to the largest.

    Pixels of equal confidence share their mean error. NaN for a tenth without a pixel.
    """
    ascending = torch.argsort(confidence)
    sorted_error = _average_ties(error.double(), confidence)[ascending]
    return torch.stack([tenth.mean() for tenth in sorted_error.tensor_split(10)])


def _average_ties(error: Numbers, score: Numbers) -> Numbers:
    """Replace each error by the mean over all pixels of its score: ties then have no order."""
    values, group = score.unique(return_inverse=True)
    zeros = torch.zeros(len(values), dtype=error.dtype)
    counts = zeros.index_add(0, group, torch.ones_like(error))
    sums = zeros.index_add(0, group, error)
    return (sums / counts)[group]


def view_errors(synthesised: View, real: View) -> dict[str, float]:
    """Compare a synthesised right view with the real one, both RGB in [0, 1].

    Returns:
        ``right_l1``: mean absolute difference; ``right_psnr_db``: peak signal-to-noise ratio [dB];
        ``right_sharpness``: mean absolute gradient as a share of that of the real view: 1 is as
        sharp, less is blurred.
    """
    difference = synthesised.double() - real.double()
    mean_square = difference.square().mean().clamp(min=1e-12)
    sharpness = _measure_mean_gradient(synthesised) / _measure_mean_gradient(real).clamp(min=1e-12)
    return {
        "right_l1": float(difference.abs().mean()),
        "right_psnr_db": float(-10 * torch.log10(mean_square)),
        "right_sharpness": float(sharpness),
    }


def _measure_mean_gradient(image: View) -> Float[Tensor, ""]:
    """Compute the mean absolute difference of neighbours in rows, plus that of those in columns."""
    along_rows = image.diff(dim=2).abs().double().mean()
    along_columns = image.diff(dim=1).abs().double().mean()
    return along_rows + along_columns
