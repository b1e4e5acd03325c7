"""Two baselines: the best constant depth of each image row, and the most similar image's depth.

A street scene is mostly road below and far things above: a network that does not beat both has
learnt little about the picture.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Shaped
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.depth.datasets import Dataset, list_truth_kinds, read_true_depth
from depthpose.depth.disparity import disparity_from_depth
from depthpose.depth.types import DepthEstimate, DepthInput, Map, View

_CANONICAL_FOCAL_PX = 721.5377
"""Rows are counted in a camera of this focal length (KITTI's), centred at its principal point."""
_ROWS = 1443
"""Number of rows of that camera, whose slopes are -1 to 1."""
_NEAR_M = 1.0
_FAR_M = 80.0
_DEPTH_BINS = 4096
"""Range of the true depths that are learnt from, and bins of their histogram, of equal widths in
the logarithm of depth."""
_THUMBNAIL_SIZE = (8, 24)
"""Rows and columns of the thumbnails that images are compared by."""

Progress = Callable[[Sequence[int]], Iterable[int]]


@dataclass(frozen=True, eq=False)
class RowDepthBaseline:
    """The best constant depth of each image row: it uses the camera and not the image.

    Rows of all cameras are converted to those of one canonical camera, by their slope
    ``(v - cy) / fy``: the road at one slope is equally far in every camera of one mounting height,
    whatever its focal length or crop.
    """

    #: depth of each row of the canonical camera, the principal point in the middle
    depth_m: Float64[np.ndarray, " rows"]

    @classmethod
    def fit(cls, dataset: Dataset, progress: Progress = iter) -> "RowDepthBaseline":
        """Find for each row the constant c that minimises the mean of ``|c - t| / t``.

        That is the median of the true depths t weighted by 1 / t. Each frame counts the same. The
        depths are counted in a histogram with bins of 0.1 %, so that any number of frames fits in
        memory. Rows without truth are interpolated in inverse depth; beyond the outermost rows
        with truth their values are repeated.

        Args:
            dataset: the frames of the training.
            progress: wraps the sequence of frame indices to show the progress, as ``tqdm`` does.

        Raises:
            InputError: no frame has both truth and a rig.
        """
        weight = np.zeros((_ROWS, _DEPTH_BINS))
        for index in progress(range(len(dataset))):
            true_map_m = read_true_depth(dataset, index)
            rig = dataset.read_rig(index)
            if true_map_m is not None and rig is not None:
                weight += _weigh_depths(true_map_m.double().numpy(), rig)
        has_truth = weight.sum(1) > 0
        if not has_truth.any():
            raise _make_no_truth_error(dataset)

        # The weighted median: the middle of the bin where half of the weight is reached.
        is_half_reached = weight.cumsum(1) >= weight.sum(1, keepdims=True) / 2
        median_bin = is_half_reached.argmax(1) + 0.5
        median_m = _NEAR_M * (_FAR_M / _NEAR_M) ** (median_bin / _DEPTH_BINS)
        rows = np.arange(_ROWS)
        return cls(1 / np.interp(rows, rows[has_truth], 1 / median_m[has_truth]))

    def estimate_input(self, depth_input: DepthInput) -> DepthEstimate:
        """Estimate the depth of every pixel as that of its row.

        Raises:
            InputError: the input has no rig.
        """
        rig = _require_rig(depth_input)
        height, width = depth_input.left.shape[1:]
        rows = _convert_to_canonical_rows(np.arange(height), rig)
        inverse = np.interp(rows, np.arange(_ROWS), 1 / self.depth_m)
        row_depth_m = torch.from_numpy(1 / inverse).float()
        depth_m = row_depth_m[:, None].expand(height, width).contiguous()
        disparity_px = disparity_from_depth(depth_m, rig)
        return DepthEstimate(input=depth_input, depth_m=depth_m, disparity_px=disparity_px)


def _weigh_depths(
    true_depth_m: Float64[np.ndarray, "h w"], rig: StereoRig
) -> Float64[np.ndarray, "rows bins"]:
    """Compute the histogram of a frame's true depths t in each canonical row.

    A pixel weighs 1 / t, divided by the number of the frame's pixels with truth.
    """
    v, u = np.nonzero((true_depth_m > _NEAR_M) & (true_depth_m < _FAR_M))
    true_m = true_depth_m[v, u]
    row = np.rint(_convert_to_canonical_rows(v, rig)).astype(np.int64).clip(0, _ROWS - 1)
    depth_bin = np.log(true_m / _NEAR_M) / np.log(_FAR_M / _NEAR_M) * _DEPTH_BINS
    flat_index = row * _DEPTH_BINS + depth_bin.astype(np.int64)
    pixel_weight = 1 / true_m / max(len(true_m), 1)
    histogram = np.bincount(flat_index, pixel_weight, _ROWS * _DEPTH_BINS)
    return histogram.reshape(_ROWS, _DEPTH_BINS)


def _convert_to_canonical_rows(
    rows: Shaped[np.ndarray, " n"], rig: StereoRig
) -> Float64[np.ndarray, " n"]:
    """Convert rows of a camera's image to fractional rows of the canonical camera."""
    slope = (rows - float(rig.K[1, 2])) / float(rig.K[1, 1])
    return slope * _CANONICAL_FOCAL_PX + _ROWS // 2


@dataclass(frozen=True, eq=False)
class NearestImageBaseline:
    """The depth of the most similar training image.

    Images are compared by the correlation of colour thumbnails. The truth of the most similar one
    is sparse, and its holes are filled (:func:`fill_by_pyramid`). It is resized to the input, and
    scaled by the ratio of the focal lengths: what looks alike through a lens twice as long is twice
    as far.
    """

    dataset: Dataset  #: dataset of the training
    indices: list[int]  #: indices of its frames that have truth and a rig
    #: thumbnails of the left images of these frames, each with mean 0 and norm 1
    thumbnails: Float[Tensor, "n d"]

    @classmethod
    def fit(cls, dataset: Dataset, progress: Progress = iter) -> "NearestImageBaseline":
        """Make the thumbnail of every training image that has truth and a rig.

        Args:
            dataset: the frames of the training.
            progress: wraps the sequence of numbers of these images to show the progress.

        Raises:
            InputError: no image has both.
        """
        indices = [
            i
            for i, frame in enumerate(dataset.frames)
            if frame.calibration and list_truth_kinds(frame) and dataset.read_rig(i) is not None
        ]
        if not indices:
            raise _make_no_truth_error(dataset)
        thumbnails: list[Tensor] = []
        for number in progress(range(len(indices))):
            left_path = dataset.frames[indices[number]].left
            thumbnails.append(_make_thumbnail(read_image(left_path)))
        return cls(dataset, indices, torch.stack(thumbnails))

    def estimate_input(self, depth_input: DepthInput) -> DepthEstimate:
        """Estimate the depth of the left image as that of the most similar training image.

        Raises:
            InputError: the input has no rig.
        """
        rig = _require_rig(depth_input)
        height, width = depth_input.left.shape[1:]
        correlations = self.thumbnails @ _make_thumbnail(depth_input.left)
        nearest = self.indices[int(correlations.argmax())]
        nearest_true_m = read_true_depth(self.dataset, nearest)
        nearest_rig = self.dataset.read_rig(nearest)
        assert nearest_true_m is not None  # `fit` chose frames that have both
        assert nearest_rig is not None
        inverse = fill_by_pyramid(1 / nearest_true_m)
        inverse = F.interpolate(inverse[None, None], (height, width), mode="bilinear")[0, 0]

        # Focal lengths in widths of the images, which now have one size.
        focal = float(rig.K[0, 0]) / rig.width
        nearest_focal = float(nearest_rig.K[0, 0]) / nearest_rig.width
        depth_m = focal / nearest_focal / inverse
        disparity_px = disparity_from_depth(depth_m, rig)
        return DepthEstimate(input=depth_input, depth_m=depth_m, disparity_px=disparity_px)


def fill_by_pyramid(values: Map) -> Map:
    """Fill each NaN with the mean of the smallest cell around it that has values.

    Cells are squares of 2, 4, 8, ... pixels. A map without any value stays NaN.
    """
    has_value = torch.isfinite(values)
    if bool(has_value.all()) or values.shape == (1, 1):
        return values
    height, width = values.shape
    parts = torch.stack([values.nan_to_num(0.0), has_value.to(values.dtype)])
    padded = F.pad(parts, (0, width % 2, 0, height % 2))
    total, count = F.avg_pool2d(padded, 2)
    coarse = fill_by_pyramid(torch.where(count > 0, total / count, torch.nan))
    fine = coarse.repeat_interleave(2, 0).repeat_interleave(2, 1)
    return torch.where(has_value, values, fine[:height, :width])


def _make_thumbnail(image: View) -> Float[Tensor, " d"]:
    """Shrink an image to a vector of mean 0 and norm 1: dot products are correlations."""
    cells = F.interpolate(image[None], _THUMBNAIL_SIZE, mode="area").flatten()
    centred = cells - cells.mean()
    return centred / centred.norm().clamp(min=1e-9)


def _require_rig(depth_input: DepthInput) -> StereoRig:
    """Return the rig of an input.

    Raises:
        InputError: it has none.
    """
    if not isinstance(depth_input.camera, StereoRig):
        raise InputError(
            f"{depth_input.name}: has no rig, and this baseline's depth is measured as disparity; "
            "give a camera with baseline_m"
        )
    return depth_input.camera


def _make_no_truth_error(dataset: Dataset) -> InputError:
    """Make the error of a dataset without a frame that a baseline can be fitted to."""
    return InputError(
        f"{dataset.name}: none of its {len(dataset)} frames has both truth and calibration; give "
        "--train a folder with lidar_depth, disp_occ or LiDAR scans"
    )
