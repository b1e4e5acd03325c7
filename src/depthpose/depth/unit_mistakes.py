"""Predicted maps in a wrong unit or of a wrong sign, recognised by their truth."""

import warnings
from collections.abc import Mapping

import torch

from depthpose.core.errors import Notice
from depthpose.depth.types import Map

_UNIT_MISTAKES = {
    1000.0: "is its depth in millimetres (divide by 1000), or its disparity in shares of the width "
    "(multiply by it)?",
    256.0: "is its depth metres x 256, as KITTI's PNG holds it (divide by 256)?",
    1 / 256: "is its disparity pixels x 256, as KITTI's PNG holds it (divide by 256)?",
}
"""Certain mistakes, by the ratio of predicted to true depth that they cause."""
_POSSIBLE_MISTAKES = {
    1000 / 256: "is it a PNG of millimetres, read as metres x 256?",
    256 / 1000: "is its truth a PNG of millimetres, read as metres x 256?",
    1 / 16: "is its disparity pixels x 16, as OpenCV's matchers give it?",
    1 / 5.4: "is it of monodepth2, trained with a baseline of 0.1 m (multiply its depth by 5.4)?",
}
"""Possible mistakes, by ratios that a poor estimate may have too."""
_MISTAKE_TOLERANCE = 1.4
"""A ratio within this factor of one of ``_UNIT_MISTAKES`` is that mistake: no estimate, however
poor, is wrong by 250 or 1000 in the median."""
_POSSIBLE_TOLERANCE = 1.1
"""A ratio within this factor of one of ``_POSSIBLE_MISTAKES`` may be that mistake."""
_POOR_RATIO = 3.0
"""Ratio of median depths from which a notice is given: that of a good estimate is near 1."""
_NEGATIVE_SHARE = 0.9
"""Share of the pixels with a negative disparity from which the sign is wrong."""
_OPPOSITE_CORRELATION = -0.8
"""Correlation of the logarithms of prediction and truth, below which one is inverted."""


def find_unit_mistake(
    predicted_px: Map, true_px: Map, given_notices: set[str] | None = None
) -> str | None:
    """Find the mistake of unit or sign in a predicted disparity, by its truth.

    Args:
        predicted_px: the prediction.
        true_px: the truth.
        given_notices: notices on earlier frames of the dataset, which are not given again; those on
            this frame are added. None: there is no earlier frame.

    Returns:
        The mistake and its remedy, as a sentence for an error; None where there is none, or only
        one that a poor estimate could look like too. Of such a one a notice is given.
    """
    given_notices = set() if given_notices is None else given_notices
    is_compared = torch.isfinite(predicted_px) & torch.isfinite(true_px)
    if not bool(is_compared.any()):
        return None
    predicted_px = predicted_px[is_compared]
    true_px = true_px[is_compared]

    # Certain mistakes: nearly all signs, or a ratio that no estimate has.
    negative_share = float((predicted_px < 0).float().mean())
    if negative_share > _NEGATIVE_SHARE:
        return (
            f"{negative_share:.0%} of the disparities are negative: left and right were exchanged, "
            "or the sign is the other one; a left pixel at u is seen at u - disparity on the right"
        )
    median_px = float(predicted_px.median())
    depth_ratio = float(true_px.median()) / median_px if median_px > 0 else 0.0
    mistake = _find_mistake(depth_ratio, _UNIT_MISTAKES, _MISTAKE_TOLERANCE)
    if mistake is not None:
        return f"it lies {depth_ratio:.4g} times as far as the truth: {mistake}"

    # Possible mistakes: a wrong scale, or inverse depth.
    if depth_ratio > 0 and not 1 / _POOR_RATIO < depth_ratio < _POOR_RATIO:
        question = _find_mistake(depth_ratio, _POSSIBLE_MISTAKES, _POSSIBLE_TOLERANCE)
        if question is None:
            question = "is it without a scale, or of another focal length or baseline?"
        times = f"{depth_ratio:.3g} times as far as the truth in the median"
        _give_notice_once(f"lies {times}:", question, given_notices)
    logarithms = torch.stack([predicted_px, true_px]).double().clamp_min(1e-3).log()
    if len(true_px) > 1 and float(logarithms.corrcoef()[0, 1]) < _OPPOSITE_CORRELATION:
        statement = "is the nearer the farther its truth is:"
        _give_notice_once(statement, "is it inverse depth?", given_notices)
    return None


def _find_mistake(
    depth_ratio: float, mistakes: Mapping[float, str], tolerance: float
) -> str | None:
    """Find the first of ``mistakes`` whose ratio is ``depth_ratio``, within a factor; or None."""
    for ratio, question in mistakes.items():
        if ratio / tolerance < depth_ratio < ratio * tolerance:
            return question
    return None


def _give_notice_once(statement: str, question: str, given_notices: set[str]) -> None:
    """Give a notice about a prediction, once for all frames of a dataset.

    ``statement`` goes on from "a prediction"; ``question`` asks for a mistake. It is added to
    ``given_notices``.
    """
    if question not in given_notices:
        given_notices.add(question)
        warnings.warn(f"a prediction {statement} {question}", Notice, stacklevel=3)
