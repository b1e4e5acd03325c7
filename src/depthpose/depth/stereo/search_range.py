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
from depthpose.depth.disparity import apply_to_maps, warp_right_to_left
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
    """The range of a pair's disparities, in pixels of its images, and the match that found it."""

    low_px: float  #: the least disparity, at least that of what is infinitely far away
    high_px: float  #: the largest disparity
    step_px: float  #: error of both ends, by which they are set outwards
    coarse: Match  #: the match of the narrow copy, at the size of the images
    right_px: Map  #: disparity of the right view in the narrow copy, at the size of the images


def move_views(left: Tensor, right: Tensor, first_px: int) -> tuple[Tensor, Tensor]:
    """Move the views of a pair so that a disparity of ``first_px`` becomes 0.

    The disparity of a point is its column in the left view less that in the right one. So the right
    view moves to the right by ``first_px`` columns, or, where that is negative, the left view by
    ``-first_px`` columns. Columns that become free repeat the border.

    Args:
        left: ``(3, H, W)``.
        right: the same size.
        first_px: in whole pixels, of either sign.

    Returns:
        The left and the right view, both ``(3, H, W)``; where ``first_px`` is negative both are
        ``-first_px`` columns wider, so that nothing is cut off.
    """
    if first_px >= 0:
        # The columns that are cut off match nothing at a disparity of first_px or more.
        shifted_right = F.pad(right[None], (first_px, 0, 0, 0), mode="replicate")[0]
        return left, shifted_right[..., : left.shape[2]]
    # The right view stays in place, and is padded on the right to the width of the left view.
    added = -first_px
    shifted_left = F.pad(left[None], (added, 0, 0, 0), mode="replicate")[0]
    padded_right = F.pad(right[None], (0, added, 0, 0), mode="replicate")[0]
    return shifted_left, padded_right


def move_match_back(match: Match, first_px: int) -> Match:
    """Convert a match of moved views to the pixels of the views before :func:`move_views`."""
    if first_px == 0:
        return match
    added = max(-first_px, 0)
    moved = apply_to_maps(match, lambda values: values[:, added:])
    moved = replace(moved, disparity_px=moved.disparity_px + first_px)
    if moved.confidence is None:
        return moved
    # The right view shows none of the first columns, even of what is farthest.
    columns = torch.arange(moved.confidence.shape[1], device=moved.confidence.device)
    return replace(moved, confidence=moved.confidence.where(columns >= first_px, 0.0))


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
    mirrored = (right.flip(-1), left.flip(-1))
    coarse, mirrored_match = matcher.match_many([(left, right), mirrored], search=search)
    disparity_px = coarse.disparity_px
    right_px = mirrored_match.disparity_px.flip(-1)

    # Borders without a picture match each other at any disparity.
    is_picture = _find_picture_pixels(left, right, disparity_px)
    confidence = coarse.confidence
    if confidence is not None:
        confidence = confidence.where(is_picture, 0.0)
        coarse = replace(coarse, confidence=confidence)

    # The farthest point is measured where both views agree, which excludes hidden places and the
    # left border. The nearest is measured wherever the right view can show it: near things are
    # often in one view alone, so there the views need not agree.
    step_px = STEP_PX / search.scale
    other_px = warp_right_to_left(right_px[None], disparity_px)[0]
    counts_as_far = is_picture & ((disparity_px - other_px).abs() <= step_px)
    columns = torch.arange(disparity_px.shape[1], device=disparity_px.device)
    counts_as_near = is_picture & (disparity_px <= columns)
    if confidence is not None:
        counts_as_near &= confidence >= _MIN_NEAR_CONFIDENCE

    # The maps have the size of the images: one sample for each pixel of the narrow copy.
    stride = max(1, round(1 / search.scale))
    samples = (slice(None, None, stride), slice(None, None, stride))
    sampled_px = disparity_px[samples]
    far_px = sampled_px[counts_as_far[samples]].sort().values
    near_px = sampled_px[counts_as_near[samples]].sort().values

    # The range, without the outermost samples, which may be wrong matches.
    tail = int(_TAIL * sampled_px.numel())
    if min(len(far_px), len(near_px)) <= tail:  # too few are left: all samples count
        far_px = near_px = sampled_px.flatten().sort().values
    low_px = max(float(far_px[tail]) - step_px, infinity_px)
    high_px = max(float(near_px[-1 - tail]) + step_px, low_px + step_px)
    return DisparityRange(
        low_px=low_px,
        high_px=high_px,
        step_px=step_px,
        coarse=coarse,
        right_px=right_px,
    )


def _search_of_narrow_copy(matcher: NetworkMatcher, width: int, infinity_px: float) -> SearchRange:
    """Compute the search in a copy so narrow that every disparity of a pair is within reach.

    ``width``: of the images; ``infinity_px``: as for :func:`measure_disparity_range`.
    """
    trained_px = matcher.network_config.max_disparity_px
    span_px = matcher.whole_steps(trained_px * matcher.largest_span_factor)
    scale = min(1.0, span_px / (width + abs(infinity_px)))
    first_px = STEP_PX * math.floor(infinity_px * scale / STEP_PX)
    return SearchRange(scale=scale, first_px=first_px, span_px=span_px)


def _find_picture_pixels(left: Tensor, right: Tensor, disparity_px: Map) -> Mask:
    """Find the left pixels of which neither they nor their matches lie in a blank border."""
    left_blank = find_blank_borders(left).to(disparity_px.device)
    right_blank = find_blank_borders(right).to(disparity_px)
    matched_blank = warp_right_to_left(right_blank[None], disparity_px)[0]
    return ~left_blank & ~(matched_blank > 0)


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
    scale, usual_span_px = _choose_usual_scale_and_span(matcher, size, camera)
    high_px = measured.high_px
    if matcher.config.max_disparity_px is not None:
        high_px = matcher.config.max_disparity_px
    # The volume has scale^2 H W pixels and scale * span disparities: a wider span is searched at a
    # smaller scale, so that scale^3 * span, and with it the memory, stays the same.
    span_px = max(high_px - measured.low_px, measured.step_px)
    if span_px * scale > usual_span_px:
        scale = (usual_span_px * scale**2 / span_px) ** (1 / 3)
    first_px = STEP_PX * math.floor(measured.low_px * scale / STEP_PX)
    trained_px = matcher.network_config.max_disparity_px
    searched_px = max(trained_px, matcher.whole_steps(high_px * scale - first_px))
    return SearchRange(scale=scale, first_px=first_px, span_px=searched_px)


def _choose_usual_scale_and_span(
    matcher: NetworkMatcher, size: Sequence[int], camera: Camera | None
) -> tuple[float, int]:
    """Compute the scale and the span of a search, where the disparities need no wider span.

    With a camera, the scale follows from the focal length; without one, a fine match has a fixed
    number of pixels.

    Returns:
        The size at which the images are matched, as a multiple of their own; and how many
        disparities are searched [px at that size].
    """
    trained = matcher.network_config
    if camera is not None and trained.work_focal_px is not None:
        scale = matcher.matching_focal_px(camera) / float(camera.K[0, 0])
        return scale, matcher.work_disparities(camera)
    if matcher.config.speed == "quick" or trained.work_focal_px is None:
        return 1.0, trained.max_disparity_px
    scale = math.sqrt(matcher.fine_pixels / (size[0] * size[1]))
    span_px = matcher.whole_steps(trained.max_disparity_px * matcher.largest_span_factor)
    return min(scale, matcher.largest_upscale), span_px


def doubt_hidden(match: Match, measured: DisparityRange) -> Match:
    """Lower the confidence where the narrow copy's right view disagrees: mostly hidden places.

    A difference of up to a pixel of the copy is within its error, and does not count. A check at
    full size would find smaller differences too, in twice the time.
    """
    if match.confidence is None:
        return match
    pixel_px = measured.step_px / STEP_PX
    return lower_where_disagreeing(match, measured.right_px, pixel_px, 2 * pixel_px)


def doubt_outside(match: Match, measured: DisparityRange, search: SearchRange) -> tuple[Match, str]:
    """Set the confidence to 0 where the true disparity may lie beyond what was searched.

    That is where the narrow copy has a larger disparity than was searched, and where the match is
    the last disparity of the search.

    Args:
        match: the match of the pair.
        measured: the range of the disparities, with the match of the narrow copy.
        search: the search of ``match``.

    Returns:
        The match; and a warning with the share of pixels beyond the search, counted where the copy
        is sure and the right view can show them; "" where the share is small.
    """
    if match.confidence is None:
        return match, ""
    coarse_px = measured.coarse.disparity_px
    coarse_confidence = measured.coarse.confidence
    end_px = search.end_in_images_px
    # Neighbours within two pixels of the copy, its error, may lie beyond too.
    may_be_beyond = coarse_px > end_px - measured.step_px
    if bool(may_be_beyond.any()):
        may_be_beyond = _dilate(may_be_beyond, round(2 * measured.step_px / STEP_PX))
    is_last = match.disparity_px > end_px - STEP_PX / search.scale
    doubted = replace(match, confidence=match.confidence.masked_fill(may_be_beyond | is_last, 0.0))

    # What is surely beyond is counted for the warning.
    is_beyond = coarse_px > end_px + measured.step_px
    is_beyond &= coarse_px <= torch.arange(coarse_px.shape[1], device=coarse_px.device)
    if coarse_confidence is not None:
        is_beyond &= coarse_confidence >= _MIN_NEAR_CONFIDENCE
    share = float(is_beyond.float().mean())
    if share < _MIN_WARNED_SHARE:
        return doubted, ""
    return doubted, (
        f"{share:.1%} of the image have disparities beyond {end_px:.0f} px, the largest "
        f"that was searched (up to {float(coarse_px[is_beyond].max()):.0f} px); their confidence "
        "is 0. Give a larger --max-disparity (in Python MatcherConfig(max_disparity_px=...)), or "
        "none, and it is measured"
    )


def _dilate(mask: Mask, radius: int) -> Mask:
    """Extend a mask to the square of ``radius`` pixels around each of its pixels."""
    side = 2 * radius + 1
    values = mask.float()[None]
    along_rows = F.max_pool2d(values, (1, side), 1, (0, radius))
    dilated = F.max_pool2d(along_rows, (side, 1), 1, (radius, 0))
    return dilated[0] > 0
