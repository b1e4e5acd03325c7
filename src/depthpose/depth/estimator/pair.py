"""A rectified pair to depth: check it, match it, triangulate."""

from dataclasses import replace

import torch

from depthpose.core.camera import StereoRig, check_image_matches_camera, check_rectified
from depthpose.core.devices import refused_memory
from depthpose.core.errors import InputError
from depthpose.core.files.images import check_image
from depthpose.depth.stereo import Matcher
from depthpose.depth.triangulation import estimate_from_pair, join_warnings
from depthpose.depth.types import DepthEstimate, DepthInput


@torch.no_grad()
def depth_from_pair(
    matcher: Matcher, pair: DepthInput, *, with_check: bool = True
) -> DepthEstimate:
    """Estimate depth of a rectified pair.

    Args:
        matcher: pair to disparity, by a search of its own.
        pair: the images, and their rig where it is known.
        with_check: as for :func:`check_rectified_pair`.

    Returns:
        Depth, disparity and confidence of the left view.

    Raises:
        InputError: what :func:`check_rectified_pair` and the matcher refuse, or too little memory.
    """
    warning = check_rectified_pair(pair, with_check=with_check)
    assert pair.right is not None
    with refused_memory(pair.name):
        match = matcher.match(pair.left, pair.right, pair.camera)
        estimate = estimate_from_pair(pair, match)
    return replace(estimate, warning=join_warnings(warning, estimate.warning))


def check_rectified_pair(pair: DepthInput, *, with_check: bool = True) -> str:
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
