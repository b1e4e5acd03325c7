"""Semi-global block matching: OpenCV's StereoSGBM as a matcher."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from depthpose.core.errors import InputError, import_opencv
from depthpose.depth.config import SGBMConfig
from depthpose.depth.stereo.matcher import check_pair
from depthpose.depth.types import Match

_MODES = {
    "sgbm": "STEREO_SGBM_MODE_SGBM",
    "hh": "STEREO_SGBM_MODE_HH",
    "sgbm_3way": "STEREO_SGBM_MODE_SGBM_3WAY",
    "hh4": "STEREO_SGBM_MODE_HH4",
}


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
        found = self._matcher().compute(_opencv_image(left), _opencv_image(right))
        disparity_px = torch.from_numpy(found.astype(np.float32) / 16).to(left.device)
        disparity_px = disparity_px.where(disparity_px > 0, torch.nan)
        if not self.config.with_filled_holes:
            return Match(disparity_px=disparity_px)
        confidence = torch.isfinite(disparity_px).to(torch.float32)
        return Match(disparity_px=fill_holes(disparity_px), confidence=confidence)

    def _matcher(self) -> Any:  # noqa: ANN401  OpenCV's classes carry no types
        config = self.config
        return self._cv2.StereoSGBM_create(
            minDisparity=0,
            numDisparities=config.num_disparities,
            blockSize=config.block_size,
            P1=config.p1,
            P2=config.p2,
            disp12MaxDiff=config.disp12_max_diff,
            preFilterCap=config.pre_filter_cap,
            uniquenessRatio=config.uniqueness_ratio,
            speckleWindowSize=config.speckle_window_size,
            speckleRange=config.speckle_range,
            mode=getattr(self._cv2, _MODES[config.mode]),
        )


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
    padded = torch.nn.functional.pad(values, (0, 1), value=torch.inf)
    before = before.where(before >= 0, values.shape[1])
    filled = torch.minimum(padded.gather(1, before), padded.gather(1, after))
    return filled[_nearest_true(valid.any(1))]


def _nearest_true(flags: Tensor) -> Tensor:
    """For each place of ``flags``, ``(n,)``, the nearest place that is true."""
    places = torch.arange(len(flags), device=flags.device)
    true_places = places[flags]
    return true_places[(places[:, None] - true_places).abs().argmin(1)]


def _opencv_image(image: Tensor) -> np.ndarray:
    """Convert to the 8-bit BGR that OpenCV reads from a file."""
    bytes_ = (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8)
    return np.ascontiguousarray(bytes_.flip(0).permute(1, 2, 0).numpy())
