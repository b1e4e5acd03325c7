"""Matchers without weights: a function of the user's, and OpenCV's StereoSGBM.

:class:`Matcher` and :class:`CameraMatcher` say what every matcher has.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from depthpose.core.camera import Camera
from depthpose.core.errors import InputError, import_opencv
from depthpose.core.files.images import check_image
from depthpose.depth.config import SGBMConfig
from depthpose.depth.types import Match


@runtime_checkable
class Matcher(Protocol):
    """Anything that turns a rectified pair into the disparity of its left image.

    A matcher may be a :class:`CameraMatcher` too, which is given several pairs at once and what
    camera took them.
    """

    def match(self, left: Tensor, right: Tensor) -> Match:
        """Match one pair.

        Args:
            left: left image, ``(3, H, W)`` RGB in [0, 1], float32.
            right: right image, the same size.

        Raises:
            InputError: the images are no such pair, or this matcher cannot take them.
        """
        ...


@runtime_checkable
class CameraMatcher(Matcher, Protocol):
    """A matcher that chooses the size at which pairs are matched, and takes several at once."""

    def match_many(
        self, pairs: Sequence[tuple[Tensor, Tensor]], camera: Camera | None = None
    ) -> list[Match]:
        """Match pairs of one camera.

        Args:
            pairs: left and right images, as for ``match``.
            camera: camera of the left images; None: it is not known.

        Raises:
            InputError: as for ``match``.
        """
        ...

    def work_size(self, camera: Camera) -> tuple[int, int]:
        """Give the rows and columns at which the images of a camera are matched [px]."""
        ...


class CallableMatcher:
    """A function of the user's as a matcher.

    Example::

        matcher = CallableMatcher(lambda left, right: my_network(left[None], right[None])[0])

    Args:
        function: takes the two images and answers disparity [px] of the left one, ``(H, W)``,
            as a tensor or array; NaN where it has no answer.
        with_numpy_images: give the function ``(H, W, 3)`` arrays instead of tensors.
    """

    def __init__(
        self, function: Callable[[Any, Any], Any], *, with_numpy_images: bool = False
    ) -> None:
        if not callable(function):
            raise InputError(f"CallableMatcher needs a function of two images, got {function!r}")
        self.function = function
        self.with_numpy_images = with_numpy_images

    def match(self, left: Tensor, right: Tensor) -> Match:
        """Call the function, and refuse a result that is no disparity map.

        Raises:
            InputError: unusable images, or an answer of another type or size, infinite, negative,
                or without a single value.
        """
        check_pair(left, right)
        views = (left, right)
        if self.with_numpy_images:
            views = tuple(view.permute(1, 2, 0).cpu().numpy() for view in views)
        answer = self.function(*views)

        # Refuse what is no map of numbers of the images' size.
        if isinstance(answer, np.ndarray) and answer.dtype.kind in "fiu":
            answer = torch.from_numpy(np.ascontiguousarray(answer, dtype=np.float32))
        if not isinstance(answer, Tensor) or answer.is_complex():
            raise InputError(
                f"the wrapped matcher answered {type(answer).__name__}; let it answer a tensor or "
                f"array of disparities"
            )
        disparity_px = answer.detach().to(torch.float32)
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
        for fault, is_there in faults.items():
            if is_there:
                raise InputError(f"the wrapped matcher answered {fault}")
        return Match(disparity_px=disparity_px)


def check_pair(left: object, right: object) -> None:
    """Refuse what is not a pair of images, with a remedy.

    Raises:
        InputError: not tensors, not ``(3, H, W)``, not float, empty, of two sizes, not finite or
            not in [0, 1].
    """
    first = check_image(left, "left image", 1e-3)
    second = check_image(right, "right image", 1e-3)
    if first.shape != second.shape:
        sizes = [f"{image.shape[-2]}x{image.shape[-1]}" for image in (first, second)]
        raise InputError(
            f"left image is {sizes[0]} and right image {sizes[1]}; a rectified pair has one size: "
            "crop or resize both alike"
        )


class SGBMMatcher:
    """A matcher that needs no weights; holes are NaN unless it fills them.

    OpenCV has no answer in the leftmost ``num_disparities`` columns.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """

    def __init__(self, config: SGBMConfig | None = None) -> None:
        self.config = config or SGBMConfig()
        self._cv2 = import_opencv("matching with StereoSGBM")

    def match(self, left: Tensor, right: Tensor) -> Match:
        """Match one pair. With filled holes the confidence is 0 there and 1 elsewhere; else None.

        Raises:
            InputError: unusable images, or images narrower than the disparity range.
        """
        check_pair(left, right)
        if left.shape[-1] <= self.config.num_disparities:
            raise InputError(
                f"images are {left.shape[-1]} px wide and num_disparities is "
                f"{self.config.num_disparities}; take a smaller multiple of 16"
            )
        matcher = self._cv2.StereoSGBM_create(
            minDisparity=0,
            numDisparities=self.config.num_disparities,
            blockSize=3,  # side of the matched window [px]
            P1=8 * 3 * 9,  # penalty of a disparity step of 1 between neighbours
            P2=32 * 3 * 9,  # and of a larger step
            disp12MaxDiff=1,  # largest difference of the left-right check [px]
            preFilterCap=63,  # largest horizontal gradient
            uniquenessRatio=10,  # by which the best cost must beat the second [%]
            speckleWindowSize=100,  # islands of at most so many pixels are dropped ...
            speckleRange=2,  # ... where they step by more than this [px]
            mode=self._cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        # The 8-bit BGR that OpenCV reads from a file.
        images = ((view.detach().cpu().clamp(0, 1) * 255).round().byte() for view in (left, right))
        fixed_point = matcher.compute(
            *(np.ascontiguousarray(image.flip(0).permute(1, 2, 0).numpy()) for image in images)
        )
        disparity_px = torch.from_numpy(fixed_point.astype(np.float32) / 16).to(left.device)
        disparity_px = disparity_px.where(disparity_px > 0, torch.nan)
        if not self.config.with_filled_holes:
            return Match(disparity_px=disparity_px)
        confidence = torch.isfinite(disparity_px).to(torch.float32)
        return Match(disparity_px=fill_holes(disparity_px), confidence=confidence)


def fill_holes(disparity_px: Tensor) -> Tensor:
    """Fill NaN along rows as the KITTI devkit does.

    A hole takes the smaller of its row's two valid neighbours, for a hole is mostly background;
    at a border of the row it takes the one neighbour it has. A row without any value takes the
    nearest row that has some.

    Args:
        disparity_px: ``(H, W)``.

    Raises:
        InputError: there is no value at all to fill from.
    """
    valid = torch.isfinite(disparity_px)
    if not bool(valid.any()):
        raise InputError("no pixel was matched, so no hole can be filled; is the pair rectified?")
    values = disparity_px.where(valid, torch.inf)
    column = torch.arange(values.shape[1], device=values.device).expand_as(values)
    before = column.where(valid, -1).cummax(1).values
    after = column.where(valid, values.shape[1]).flip(1).cummin(1).values.flip(1)
    # An absent neighbour is infinite, so the smaller of the two is the one that is there.
    padded = F.pad(values, (0, 1), value=torch.inf)
    before = before.where(before >= 0, values.shape[1])
    filled = torch.minimum(padded.gather(1, before), padded.gather(1, after))
    rows = torch.arange(len(valid), device=valid.device)
    filled_rows = rows[valid.any(1)]
    return filled[filled_rows[(rows[:, None] - filled_rows).abs().argmin(1)]]
