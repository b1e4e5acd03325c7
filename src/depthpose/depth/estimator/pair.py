"""A rectified pair to depth: check it, measure the range of its disparities, match, triangulate."""

import math
from dataclasses import replace

import torch

from depthpose.core.camera import StereoRig, check_image_matches_camera, check_rectified
from depthpose.core.devices import refused_memory
from depthpose.core.errors import InputError
from depthpose.core.files.images import check_image
from depthpose.depth.stereo import (
    CameraMatcher,
    Matcher,
    NetworkMatcher,
    choose_search_range,
    doubt_hidden,
    doubt_outside,
    measure_disparity_range,
    move_match_back,
    move_views,
)
from depthpose.depth.triangulation import estimate_from_pair
from depthpose.depth.types import DepthEstimate, Match, StereoInput


@torch.no_grad()
def depth_from_pair(
    matcher: Matcher, pair: StereoInput, *, with_check: bool = True
) -> DepthEstimate:
    """Estimate depth of a rectified pair.

    Args:
        matcher: pair to disparity. A network that finds the range measures the disparities of the
            pair first, and matches within their range; the estimate's ``warning`` names what lies
            beyond it. Any other matcher searches from 0 px upwards.
        pair: the images, and their rig where it is known.
        with_check: as for :func:`check_pair`.

    Returns:
        Depth, disparity and confidence of the left view.

    Raises:
        InputError: what :func:`check_pair` refuses, principal points farther apart than
            the images are wide, or too little memory.
    """
    warning = check_pair(pair, with_check=with_check)
    cx_difference_px = _read_cx_difference_px(pair)
    with refused_memory(pair.name):
        if isinstance(matcher, NetworkMatcher) and matcher.finds_range:
            match, range_warning = _match_in_range(matcher, pair, cx_difference_px)
            warning = "; ".join(text for text in (warning, range_warning) if text)
        else:
            match = _match_moved_views(matcher, pair, cx_difference_px)
        return estimate_from_pair(pair, match, warning)


def check_pair(pair: StereoInput, *, with_check: bool = True) -> str:
    """Refuse two images that are no rectified pair; return a warning where that is uncertain.

    Args:
        pair: the images, and their rig where it is known.
        with_check: compare what the images show (:func:`~depthpose.core.camera.check_rectified`);
            else check only sizes, value range and camera.

    Returns:
        A warning where the images do not tell whether they are rectified, else "".

    Raises:
        InputError: there is no right view, its size is another, the camera has no baseline, an
            image does not lie in [0, 1]; or the views are swapped, show different scenes, or their
            rows do not correspond. The error says what was measured and what to do.
    """
    if pair.right is None:
        raise InputError(f"{pair.name}: there is no right image; give right=.")
    check_image(pair.left, f"{pair.name}: the left image")
    check_image(pair.right, f"{pair.name}: the right image")
    if pair.right.shape != pair.left.shape:
        left = pair.left.shape[1:]
        right = pair.right.shape[1:]
        raise InputError(
            f"{pair.name}: the left image is {left[1]}x{left[0]} and the right one "
            f"{right[1]}x{right[0]}; a rectified pair has one size. Rectify the pair again."
        )

    if pair.camera is not None:
        height, width = pair.left.shape[1:]
        check_image_matches_camera(pair.camera, width, height, pair.name)
        if not isinstance(pair.camera, StereoRig):
            raise InputError(
                f"{pair.name}: the camera has no baseline, so disparity cannot become metres. Add "
                '"baseline_m" (the distance between the two cameras in metres) to its file.'
            )

    if not with_check:
        return ""
    cx_difference_px = 0.0 if pair.camera is None else pair.camera.cx_right_minus_left_px
    report = check_rectified(pair.left, pair.right, cx_difference_px)
    if report.is_wrong:
        raise InputError(
            f"{pair.name}: {report.message} (--no-check, in Python load(..., "
            "with_check=False), matches them all the same.)"
        )
    return report.message if report.is_rectified is None else ""


def _read_cx_difference_px(pair: StereoInput) -> float:
    """Return cx of the right camera less that of the left one [px]; 0 where no rig is known.

    Raises:
        InputError: the views share nothing that is far away.
    """
    if not isinstance(pair.camera, StereoRig):
        return 0.0
    width = pair.left.shape[2]
    cx_difference_px = pair.camera.cx_right_minus_left_px
    if abs(math.ceil(cx_difference_px)) >= width:
        raise InputError(
            f"cx_right_minus_left_px is {cx_difference_px:g}, and the images are {width} px "
            "wide: the two views share nothing that is far away. Take both principal points "
            "from one calibration of images of this size."
        )
    return cx_difference_px


def _match_in_range(
    matcher: NetworkMatcher, pair: StereoInput, cx_difference_px: float
) -> tuple[Match, str]:
    """Measure the range of a pair's disparities, then match within that range.

    Args:
        matcher: a network that can measure the range.
        pair: the images, and their rig where it is known.
        cx_difference_px: cx of the right camera less that of the left one [px].

    Returns:
        The match; and a warning about disparities beyond the searched range, or "".
    """
    assert pair.right is not None
    left = pair.left
    measured = measure_disparity_range(matcher, left, pair.right, -cx_difference_px)
    search = choose_search_range(matcher, measured, left.shape[1:], pair.camera)
    (match,) = matcher.match_many([(left, pair.right)], pair.camera, search)
    if not matcher.config.with_left_right_check:
        match = doubt_hidden(match, measured)
    return doubt_outside(match, measured, search)


def _match_moved_views(matcher: Matcher, pair: StereoInput, cx_difference_px: float) -> Match:
    """Shift the views so that a disparity of 0 is infinitely far away, match, and shift back.

    The match has the disparities of the views before they were shifted.
    ``cx_difference_px``: cx of the right camera less that of the left one [px].
    """
    assert pair.right is not None
    shift_px = -math.ceil(cx_difference_px)
    left, right = move_views(pair.left, pair.right, shift_px)

    # The rig of the shifted views; columns added on the left move its principal point.
    rig = pair.camera
    if isinstance(rig, StereoRig) and shift_px != 0:
        K = rig.K.clone()
        K[0, 2] += left.shape[2] - pair.left.shape[2]
        remaining_px = cx_difference_px + shift_px
        rig = replace(rig, width=left.shape[2], K=K, cx_right_minus_left_px=remaining_px)

    if isinstance(matcher, CameraMatcher):
        (match,) = matcher.match_many([(left, right)], rig)
    else:
        match = matcher.match(left, right)
    return move_match_back(match, shift_px)
