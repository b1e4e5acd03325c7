"""What every matcher has, and matchers without weights: a function, and OpenCV's StereoSGBM.

These begin at a disparity of 0, so views are moved until that is infinitely far away.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError, import_opencv
from depthpose.core.files.images import check_image
from depthpose.depth.config import SGBMConfig
from depthpose.depth.disparity import apply_to_maps
from depthpose.depth.types import Map, Match, View

_SLACK = 1e-3  # by which rounding may put a value of an image beyond [0, 1]


@runtime_checkable
class Matcher(Protocol):
    """Anything that estimates the disparity of the left image of a rectified pair."""

    def match(self, left: Tensor, right: Tensor, camera: Camera | None = None) -> Match:
        """Match one pair.

        Args:
            left: left image, ``(3, H, W)`` RGB in [0, 1], float32.
            right: right image, the same size.
            camera: camera of the left image, where it is known. What is infinitely far away has the
                disparity :func:`infinity_px`, which may be negative; :func:`match_from_infinity`
                serves matchers that begin at 0.

        Returns:
            The match, at the size of the images and in their pixels.

        Raises:
            InputError: the images are no such pair, or this matcher cannot take them.
        """
        ...


def infinity_px(camera: Camera | None) -> float:
    """Return the disparity of what is infinitely far away [px]; 0 where no rig is known.

    It is negative where the principal point of the right camera lies farther to the right.

    Raises:
        InputError: the views share nothing that is far away.
    """
    if not isinstance(camera, StereoRig):
        return 0.0
    cx_difference_px = camera.cx_right_minus_left_px
    if abs(math.ceil(cx_difference_px)) >= camera.width:
        raise InputError(
            f"cx_right_minus_left_px is {cx_difference_px:g}, and the images are {camera.width} px "
            "wide: the two views share nothing that is far away. Take both principal points "
            "from one calibration of images of this size."
        )
    return -cx_difference_px


def match_from_infinity(
    match: Callable[[Tensor, Tensor], Match], left: Tensor, right: Tensor, camera: Camera | None
) -> Match:
    """Match a pair by a function that knows no negative disparities.

    Views are moved so that a disparity of 0 is infinitely far away, and their match moved back.

    Args:
        match: from the moved left and right view to their match.
        left: left image, ``(3, H, W)`` RGB in [0, 1].
        right: right image, the same size.
        camera: camera of the left image, where it is known.

    Returns:
        The match, in pixels of the images.

    Raises:
        InputError: the images are no pair, or share nothing that is far away.
    """
    check_views(left, right)
    shift_px = math.floor(infinity_px(camera))
    moved_left, moved_right = move_views(left, right, shift_px)
    return move_match_back(match(moved_left, moved_right), shift_px)


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


class CallableMatcher:
    """A function of the user's as a matcher.

    Example::

        matcher = CallableMatcher(lambda left, right: my_network(left[None], right[None])[0])

    Args:
        function: from the two images to the disparity [px] of the left one, ``(H, W)``, as a tensor
            or array; NaN where it is unknown.
        with_numpy_images: call the function with ``(H, W, 3)`` arrays instead of tensors.
    """

    def __init__(
        self, function: Callable[[Any, Any], Any], *, with_numpy_images: bool = False
    ) -> None:
        if not callable(function):
            raise InputError(f"CallableMatcher needs a function of two images, got {function!r}")
        self.function = function
        self.with_numpy_images = with_numpy_images

    def match(self, left: Tensor, right: Tensor, camera: Camera | None = None) -> Match:
        """Call the function, and refuse a result that is no disparity map.

        Where ``camera`` has principal points apart, the function is given views that are moved so
        that a disparity of 0 is infinitely far away.

        Raises:
            InputError: unusable images, or a result of another type or size, infinite, negative, or
                NaN everywhere.
        """
        return match_from_infinity(self._call, left, right, camera)

    def _call(self, left: Tensor, right: Tensor) -> Match:
        """Call the function, and refuse a result that is no disparity map."""
        views = (left, right)
        if self.with_numpy_images:
            views = tuple(view.permute(1, 2, 0).cpu().numpy() for view in views)
        result = self.function(*views)

        # Refuse what is no map of numbers of the images' size.
        if isinstance(result, np.ndarray) and result.dtype.kind in "fiu":
            result = torch.from_numpy(np.ascontiguousarray(result, dtype=np.float32))
        if not isinstance(result, Tensor) or result.is_complex():
            raise InputError(
                f"the wrapped matcher answered {type(result).__name__}; let it answer a tensor or "
                f"array of disparities"
            )
        disparity_px = result.detach().to(torch.float32)
        size = tuple(left.shape[-2:])
        if tuple(disparity_px.shape) != size:
            raise InputError(
                f"the wrapped matcher answered shape {tuple(disparity_px.shape)} for images of "
                f"{size}; let it answer one disparity a pixel"
            )

        # Refuse disparities that no rectified pair has.
        least_px = float(disparity_px.nan_to_num(0).min())
        faults = {
            "infinite disparity; use NaN for no answer": disparity_px.isinf().any(),
            "NaN for every pixel; is the pair rectified?": disparity_px.isnan().all(),
            f"negative disparity (least {least_px:.4g} px); is the pair swapped? NaN says no "
            "answer": least_px < 0,
        }
        for fault, is_present in faults.items():
            if is_present:
                raise InputError(f"the wrapped matcher answered {fault}")
        return Match(disparity_px=disparity_px)


def check_views(left: object, right: object) -> None:
    """Refuse what is not a pair of images, with a remedy.

    Raises:
        InputError: not tensors, not ``(3, H, W)``, not float, empty, of two sizes, not finite or
            not in [0, 1].
    """
    first = check_image(left, "left image", _SLACK)
    second = check_image(right, "right image", _SLACK)
    if first.shape != second.shape:
        sizes = [f"{image.shape[-2]}x{image.shape[-1]}" for image in (first, second)]
        raise InputError(
            f"left image is {sizes[0]} and right image {sizes[1]}; a rectified pair has one size: "
            "crop or resize both alike"
        )


class SGBMMatcher:
    """OpenCV's StereoSGBM, which needs no weights. Its holes are NaN, unless they are filled.

    The leftmost ``num_disparities`` columns are a hole.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """

    def __init__(self, config: SGBMConfig | None = None) -> None:
        self.config = config or SGBMConfig()
        self._cv2 = import_opencv("matching with StereoSGBM")

    def match(self, left: Tensor, right: Tensor, camera: Camera | None = None) -> Match:
        """Match one pair, from infinity on.

        With filled holes the confidence is 0 there and 1 elsewhere; else it is None.

        Raises:
            InputError: unusable images, or images narrower than the disparity range.
        """
        return match_from_infinity(self._match_from_zero, left, right, camera)

    def _match_from_zero(self, left: Tensor, right: Tensor) -> Match:
        """Match one pair through disparities from 0 px on."""
        if left.shape[-1] <= self.config.num_disparities:
            raise InputError(
                f"images are {left.shape[-1]} px wide and num_disparities is "
                f"{self.config.num_disparities}; take a smaller multiple of 16"
            )
        matcher = self._cv2.StereoSGBM_create(
            minDisparity=0,
            numDisparities=self.config.num_disparities,
            blockSize=3,  # side of the matched window [px]
            # Penalties of a disparity step between neighbours, 8 and 32 times 3 colours x 9 pixels:
            P1=8 * 3 * 9,  # of a step of 1 px
            P2=32 * 3 * 9,  # of a larger one
            disp12MaxDiff=1,  # largest difference of the left-right check [px]
            preFilterCap=63,  # largest horizontal gradient
            uniquenessRatio=10,  # by which the best cost must beat the second [%]
            speckleWindowSize=100,  # islands of at most so many pixels are dropped ...
            speckleRange=2,  # ... where they step by more than this [px]
            mode=self._cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        fixed_point = matcher.compute(_convert_to_bgr(left), _convert_to_bgr(right))
        # OpenCV counts sixteenths of a pixel.
        disparity_px = torch.from_numpy(fixed_point.astype(np.float32) / 16).to(left.device)
        disparity_px = disparity_px.where(disparity_px > 0, torch.nan)
        if not self.config.with_filled_holes:
            return Match(disparity_px=disparity_px)
        confidence = torch.isfinite(disparity_px).to(torch.float32)
        return Match(disparity_px=fill_holes(disparity_px), confidence=confidence)


def _convert_to_bgr(image: View) -> np.ndarray:
    """Convert RGB in [0, 1] to the 8-bit BGR (H, W, 3) that OpenCV reads from a file."""
    rgb = (image.detach().cpu().clamp(0, 1) * 255).round().byte()
    return np.ascontiguousarray(rgb.flip(0).permute(1, 2, 0).numpy())


def fill_holes(disparity_px: Map) -> Map:
    """Fill NaN along rows as the KITTI devkit does.

    A pixel of a hole takes the smaller of the two values that bound the hole in its row, for a hole
    is mostly background; at a border of the image it takes the only one. A row without any value
    takes the nearest row that has one.

    Raises:
        InputError: there is no value at all to fill from.
    """
    is_valid = torch.isfinite(disparity_px)
    if not bool(is_valid.any()):
        raise InputError("no pixel was matched, so no hole can be filled; is the pair rectified?")
    height, width = disparity_px.shape

    # Columns of the last valid pixel before each pixel and the first one after it, or itself.
    column = torch.arange(width, device=disparity_px.device).expand_as(disparity_px)
    column_before = column.where(is_valid, -1).cummax(1).values
    column_after = column.where(is_valid, width).flip(1).cummin(1).values.flip(1)
    # Where there is none, an added column of infinite values, of which the other is the smaller.
    column_before = column_before.where(column_before >= 0, width)
    padded = F.pad(disparity_px.where(is_valid, torch.inf), (0, 1), value=torch.inf)
    filled = torch.minimum(padded.gather(1, column_before), padded.gather(1, column_after))

    rows = torch.arange(height, device=disparity_px.device)
    valid_rows = rows[is_valid.any(1)]
    nearest = (rows[:, None] - valid_rows).abs().argmin(1)  # the row itself where it has values
    return filled[valid_rows[nearest]]
