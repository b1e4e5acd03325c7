"""The range of a pair's disparities: measured in a narrow copy, and searched at a suitable size.

A network searches a fixed number of disparities, and its results are wrong where the true ones lie
beyond. So the pair is first matched in a copy so narrow that every disparity is within reach. The
search then begins at the least disparity of the copy. Where the usual number of disparities does
not reach the largest one, more are searched at a smaller size, so that the volume is no larger:
twice the disparities at four fifths of the sides take the same time and memory.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import Camera
from depthpose.depth.disparity import left_right_difference, matched_blankness
from depthpose.depth.stereo.network_matcher import (
    STEP_PX,
    NetworkMatcher,
    SearchRange,
    lower_where_disagreeing,
)
from depthpose.depth.types import Map, Mask, Match
from depthpose.depth.visible import find_blank_borders

_TAIL = 0.001
"""Share of the copy's pixels that may lie beyond either end: single pixels at edges are wrong."""
_MIN_NEAR_CONFIDENCE = 0.5
"""Confidence from which a near place counts: it is more probable than not. Every far place counts,
for its confidence is low by construction: few disparities are within 15 % of a small one."""
_MIN_WARNED_SHARE = 0.001
"""Share of the image beyond the search from which a warning is given."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DisparityRange:
    """The range of a pair's disparities, and the match of the narrow copy that it is read from.

    Everything is in pixels of the images, and maps have their size.
    """

    low_px: float  #: the least disparity, at least that of what is infinitely far away
    high_px: float  #: the largest disparity
    step_px: float  #: error of both ends, by which they are set outwards
    left_px: Map  #: disparity of the left view in the narrow copy
    right_px: Map  #: disparity of the right view in the narrow copy
    #: left pixels that the right view shows, not blank, with a confidence of 0.5 at least
    is_sure: Mask


def measure_disparity_range(
    matcher: NetworkMatcher, left: Tensor, right: Tensor, infinity_px: float
) -> DisparityRange:
    """Measure the range of a pair's disparities, in a narrow copy of it.

    Args:
        matcher: a network that matches pairs of any size.
        left: left image, ``(3, H, W)`` RGB in [0, 1].
        right: right image, the same size.
        infinity_px: disparity of what is infinitely far away: 0, or less where the principal point
            of the right camera lies farther to the right.
    """
    # A copy so narrow that the network reaches every disparity, matched both ways.
    search = _search_of_narrow_copy(matcher, left.shape[2], infinity_px)
    match = matcher.match_within(left, right, search)
    mirrored_match = matcher.match_within(right.flip(-1), left.flip(-1), search)
    left_px = match.disparity_px
    right_px = mirrored_match.disparity_px.flip(-1)
    step_px = STEP_PX / search.scale

    # The farthest point is measured where both views agree, which excludes hidden places and the
    # left border. The nearest is measured wherever the right view can show it: near things are
    # often in one view alone, so there the views need not agree. Borders without a picture match
    # each other at any disparity.
    is_picture = _find_picture_pixels(left, right, left_px)
    is_agreed = is_picture & (left_right_difference(left_px, right_px) <= step_px)
    is_sure = is_picture & _find_sure_pixels(match)

    low_px, high_px = _find_ends(left_px, is_agreed, is_sure, search.scale)
    low_px = max(low_px - step_px, infinity_px)
    high_px = max(high_px + step_px, low_px + step_px)
    return DisparityRange(
        low_px=low_px,
        high_px=high_px,
        step_px=step_px,
        left_px=left_px,
        right_px=right_px,
        is_sure=is_sure,
    )


def _search_of_narrow_copy(matcher: NetworkMatcher, width: int, infinity_px: float) -> SearchRange:
    """Compute the search in a copy so narrow that every disparity of a pair is within reach.

    ``width``: of the images; ``infinity_px``: as for :func:`measure_disparity_range`.
    """
    trained_px = matcher.network_config.max_disparity_px
    span_px = matcher.whole_steps(trained_px * matcher.largest_span_factor)
    scale = min(1.0, span_px / (width + abs(infinity_px)))
    return SearchRange(
        scale=scale, first_px=_whole_step_below(infinity_px * scale), span_px=span_px
    )


def _whole_step_below(disparity_px: float) -> int:
    """Round a disparity down to one that a network has a score of [px]."""
    return STEP_PX * math.floor(disparity_px / STEP_PX)


def _find_picture_pixels(left: Tensor, right: Tensor, disparity_px: Map) -> Mask:
    """Find the left pixels of which neither they nor their matches lie in a blank border."""
    left_blank = find_blank_borders(left).to(disparity_px.device)
    return ~left_blank & ~(matched_blankness(right, disparity_px) > 0)


def _find_sure_pixels(match: Match) -> Mask:
    """Find the left pixels that the right view can show, and whose match is more than a guess."""
    columns = torch.arange(match.disparity_px.shape[1], device=match.disparity_px.device)
    is_shown = match.disparity_px <= columns
    if match.confidence is None:
        return is_shown
    return is_shown & (match.confidence >= _MIN_NEAR_CONFIDENCE)


def _find_ends(
    disparity_px: Map, is_eligible_far: Mask, is_eligible_near: Mask, scale: float
) -> tuple[float, float]:
    """Find the least and the largest disparity, without the outermost, which may be wrong.

    One pixel is sampled for each pixel of the narrow copy. If either mask has at most ``_TAIL`` of
    the samples, both ends are taken over all samples.

    Args:
        disparity_px: disparities of the narrow copy, at the size of the images.
        is_eligible_far: pixels of which one may be the farthest.
        is_eligible_near: pixels of which one may be the nearest.
        scale: scale of the copy relative to the images (at most 1).
    """
    stride = max(1, round(1 / scale))
    every_stride = slice(None, None, stride)
    sample_index = (every_stride, every_stride)
    sampled_px = disparity_px[sample_index]
    far_px = sampled_px[is_eligible_far[sample_index]].sort().values
    near_px = sampled_px[is_eligible_near[sample_index]].sort().values
    tail = int(_TAIL * sampled_px.numel())
    if min(len(far_px), len(near_px)) <= tail:
        all_px = sampled_px.flatten().sort().values
        far_px = all_px
        near_px = all_px
    return float(far_px[tail]), float(near_px[-1 - tail])


def choose_search_range(
    matcher: NetworkMatcher, measured: DisparityRange, size: Sequence[int], camera: Camera | None
) -> SearchRange:
    """Choose the size and the disparities of a search, so that it holds the measured disparities.

    They are at least as many as the network was trained with.

    Args:
        matcher: a network; its ``max_disparity_px``, where it has one, replaces the largest
            measured disparity.
        measured: the range of the disparities.
        size: rows and columns of the images.
        camera: camera of the left image, where it is known.
    """
    # What must be searched, in pixels of the images.
    high_image_px = matcher.config.max_disparity_px or measured.high_px
    span_image_px = max(high_image_px - measured.low_px, measured.step_px)

    # The volume has scale^2 H W pixels and scale * span disparities: a wider span is searched at a
    # smaller scale, so that scale^3 * span, and with it the memory, stays the same.
    usual = matcher.usual_search(size, camera)
    scale = usual.scale
    if span_image_px * scale > usual.span_px:
        scale = (usual.span_px * scale**2 / span_image_px) ** (1 / 3)

    # The disparities, in pixels at that size.
    first_work_px = _whole_step_below(measured.low_px * scale)
    span_work_px = matcher.whole_steps(high_image_px * scale - first_work_px)
    trained_work_px = matcher.network_config.max_disparity_px
    return SearchRange(
        scale=scale,
        first_px=first_work_px,
        span_px=max(trained_work_px, span_work_px),
    )


def doubt_hidden(match: Match, measured: DisparityRange) -> Match:
    """Lower the confidence where the narrow copy's right view disagrees: mostly hidden places.

    A difference of up to a pixel of the copy is within its error, and does not count. A check at
    full size would find smaller differences too, in twice the time.
    """
    if match.confidence is None:
        return match
    pixel_px = measured.step_px / STEP_PX
    return lower_where_disagreeing(match, measured.right_px, pixel_px, 2 * pixel_px)


def doubt_outside(
    match: Match,
    measured: DisparityRange,
    search: SearchRange,
    max_disparity_px: float | None = None,
) -> Match:
    """Doubt what lies beyond the search, or beyond a largest disparity, and warn of it.

    The confidence becomes 0 where the narrow copy has a larger disparity than was searched, where
    the match is the last disparity of the search, and where it is larger than
    ``max_disparity_px``.

    Args:
        match: the match of the pair.
        measured: the range of the disparities, with those of the narrow copy.
        search: the search of ``match``.
        max_disparity_px: the largest disparity that counts, in pixels of the images; None: any.

    Returns:
        The match. Its ``warning`` is the share of pixels that surely lie beyond, unless that is
        small.
    """
    end_px = search.end_in_images_px
    limit_px = math.inf if max_disparity_px is None else max_disparity_px
    is_beyond_limit = match.disparity_px > limit_px
    if match.is_sky is not None:  # its disparity has no meaning
        is_beyond_limit &= ~match.is_sky

    if match.confidence is not None:
        may_be_beyond = measured.left_px > end_px - measured.step_px
        if bool(may_be_beyond.any()):
            # Neighbours within two pixels of the copy, its error, may lie beyond too.
            may_be_beyond = _dilate(may_be_beyond, round(2 * measured.step_px / STEP_PX))
        is_last = match.disparity_px > end_px - STEP_PX / search.scale
        is_doubtful = may_be_beyond | is_last | is_beyond_limit
        match = replace(match, confidence=match.confidence.masked_fill(is_doubtful, 0.0))

    is_beyond_search = measured.left_px > end_px + measured.step_px
    is_beyond = (is_beyond_search | is_beyond_limit) & measured.is_sure
    share = float(is_beyond.float().mean())
    if share < _MIN_WARNED_SHARE:
        return match
    largest_px = torch.maximum(measured.left_px, match.disparity_px)[is_beyond].max()
    warning = (
        f"{share:.1%} of the image have disparities beyond {min(end_px, limit_px):.0f} px, the "
        f"limit of the search (up to {float(largest_px):.0f} px); they have no confidence. Give a "
        "larger --max-disparity (in Python MatcherConfig(max_disparity_px=...)), or none, and it "
        "is measured"
    )
    return replace(match, warning=warning)


def _dilate(mask: Mask, radius: int) -> Mask:
    """Extend a mask to the square of ``radius`` pixels around each of its pixels."""
    side = 2 * radius + 1
    values = mask.float()[None]
    along_rows = F.max_pool2d(values, (1, side), 1, (0, radius))
    dilated = F.max_pool2d(along_rows, (side, 1), 1, (radius, 0))
    return dilated[0] > 0
