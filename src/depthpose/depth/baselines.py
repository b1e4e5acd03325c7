"""Two baselines: the best constant depth of each image row, and the most similar image's depth.

A street scene is mostly road below and far things above: a network that does not beat both has
learnt little about the picture.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.depth.datasets import Dataset, known_truths, read_known_depth
from depthpose.depth.disparity import disparity_from_depth
from depthpose.depth.types import DepthEstimate, Map, StereoInput, View

_CANONICAL_FOCAL_PX = 721.5377
"""Rows are counted in a camera of this focal length (KITTI's), centred at its principal point."""
_ROWS = 1443
_NEAR_M = 1.0
_FAR_M = 80.0
_STEPS = 4096

Progress = Callable[[Sequence[int]], Iterable[int]]


@dataclass(frozen=True, eq=False)
class RowDepthBaseline:
    """The best constant depth of each image row: it uses the camera and not the image.

    A row is counted by its slope ``(v - cy) / fy``, not by its number: the road at one slope is
    equally far in every camera of one mounting height, whatever its focal length or crop.
    """

    #: one depth a row of the canonical camera, the principal point in the middle
    depth_m: Float64[np.ndarray, " rows"]

    @classmethod
    def fit(cls, dataset: Dataset, progress: Progress = iter) -> "RowDepthBaseline":
        """Find for each row the constant c that minimises the mean of ``|c - t| / t``.

        That is the median of the true depths t weighted by 1 / t (nearest first, where half of the
        weight is reached). Each frame counts the same. Depths are counted in steps of 0.1 %, so
        that any number of frames fits in memory. Rows without truth get what lies between their
        neighbours, in inverse depth, and beyond the last row with truth its value.

        Raises:
            InputError: no frame has both truth and a rig.
        """
        weight = np.zeros((_ROWS, _STEPS))
        for index in progress(range(len(dataset))):
            known_m = read_known_depth(dataset, index)
            rig = dataset.read_rig(index)
            if known_m is None or rig is None:
                continue
            true_m = known_m.double().numpy()
            v, u = np.nonzero((true_m > _NEAR_M) & (true_m < _FAR_M))
            true_m = true_m[v, u]
            slope = (v - float(rig.K[1, 2])) / float(rig.K[1, 1])
            row = np.rint(slope * _CANONICAL_FOCAL_PX + _ROWS // 2).astype(np.int64)
            row = row.clip(0, _ROWS - 1)
            step = np.log(true_m / _NEAR_M) / np.log(_FAR_M / _NEAR_M) * _STEPS
            flat = row * _STEPS + step.astype(np.int64)
            share = 1 / true_m / max(len(true_m), 1)
            weight += np.bincount(flat, share, _ROWS * _STEPS).reshape(_ROWS, _STEPS)
        has_truth = weight.sum(1) > 0
        if not has_truth.any():
            raise _nothing_to_learn(dataset)
        reached = weight.cumsum(1) >= weight.sum(1, keepdims=True) / 2
        # The depth in the middle of a step.
        median_m = _NEAR_M * (_FAR_M / _NEAR_M) ** ((reached.argmax(1) + 0.5) / _STEPS)
        rows = np.arange(_ROWS)
        return cls(1 / np.interp(rows, rows[has_truth], 1 / median_m[has_truth]))

    def estimate_pair(self, pair: StereoInput) -> DepthEstimate:
        """Give every pixel the depth of its row.

        Raises:
            InputError: the input has no rig.
        """
        rig = _rig_of(pair)
        height, width = pair.left.shape[1:]
        slope = (np.arange(height) - float(rig.K[1, 2])) / float(rig.K[1, 1])
        row = slope * _CANONICAL_FOCAL_PX + _ROWS // 2
        inverse = np.interp(row, np.arange(_ROWS), 1 / self.depth_m)
        depth_m = torch.from_numpy(1 / inverse).float()[:, None].expand(height, width)
        depth_m = depth_m.contiguous()
        return DepthEstimate(depth_m=depth_m, disparity_px=disparity_from_depth(depth_m, rig))


@dataclass(frozen=True, eq=False)
class NearestImageBaseline:
    """The depth of the training image that looks most alike.

    Images are compared as colour thumbnails of 24 x 8 cells, by correlation. The truth of the
    nearest one is sparse and is filled in a pyramid: inverse depth is averaged over ever larger
    cells, and a pixel without truth takes the smallest cell that has any. It is then brought to
    the size of the input, and to its focal length: what looks alike through a lens twice as long
    is twice as far.
    """

    dataset: Dataset  #: of training
    indices: list[int]  #: of its frames that have a truth and a rig
    thumbnails: Float[Tensor, "n d"]  #: of their left images

    @classmethod
    def fit(cls, dataset: Dataset, progress: Progress = iter) -> "NearestImageBaseline":
        """Make the thumbnail of every training image that has truth and a rig.

        Raises:
            InputError: none has.
        """
        indices = [
            i
            for i, frame in enumerate(dataset.frames)
            if frame.calibration and known_truths(frame) and dataset.read_rig(i) is not None
        ]
        if not indices:
            raise _nothing_to_learn(dataset)
        lefts = [dataset.frames[i].left for i in indices]
        thumbnails = [_thumbnail(read_image(lefts[k])) for k in progress(range(len(lefts)))]
        return cls(dataset, indices, torch.stack(thumbnails))

    def estimate_pair(self, pair: StereoInput) -> DepthEstimate:
        """Give the left image the depth of its nearest training image.

        Raises:
            InputError: the input has no rig.
        """
        rig = _rig_of(pair)
        height, width = pair.left.shape[1:]
        nearest = self.indices[int((self.thumbnails @ _thumbnail(pair.left)).argmax())]
        known_m = read_known_depth(self.dataset, nearest)
        other = self.dataset.read_rig(nearest)
        assert known_m is not None  # `fit` chose frames that have both
        assert other is not None
        inverse = fill_by_pyramid(1 / known_m)
        inverse = F.interpolate(inverse[None, None], (height, width), mode="bilinear")[0, 0]
        focal, other_focal = (float(c.K[0, 0]) / c.width for c in (rig, other))
        depth_m = focal / other_focal / inverse
        return DepthEstimate(depth_m=depth_m, disparity_px=disparity_from_depth(depth_m, rig))


def fill_by_pyramid(values: Map) -> Map:
    """Fill NaN with the mean of the smallest cell (2, 4, 8, ... pixels) around it that has values.

    All stays NaN where there is no value at all.
    """
    is_known = torch.isfinite(values)
    if bool(is_known.all()) or values.shape == (1, 1):
        return values
    padded = F.pad(torch.stack([values.nan_to_num(0.0), is_known.to(values.dtype)]),
                   (0, values.shape[1] % 2, 0, values.shape[0] % 2))  # fmt: skip
    total, count = F.avg_pool2d(padded, 2)
    coarse = fill_by_pyramid(torch.where(count > 0, total / count, torch.nan))
    fine = coarse.repeat_interleave(2, 0).repeat_interleave(2, 1)
    return torch.where(is_known, values, fine[: values.shape[0], : values.shape[1]])


def _thumbnail(image: View) -> Float[Tensor, " d"]:
    cells = F.interpolate(image[None], (8, 24), mode="area").flatten()
    centred = cells - cells.mean()
    return centred / centred.norm().clamp(min=1e-9)


def _rig_of(pair: StereoInput) -> StereoRig:
    """Give the rig of a pair, which a baseline needs."""
    if not isinstance(pair.camera, StereoRig):
        raise InputError(
            f"{pair.name}: has no rig, and a baseline is measured as disparity; give a camera with "
            "baseline_m"
        )
    return pair.camera


def _nothing_to_learn(dataset: Dataset) -> InputError:
    """Make the error of a dataset to which no baseline can be fitted."""
    return InputError(
        f"{dataset.name}: none of its {len(dataset)} frames has both truth and calibration; give "
        "--train a folder with lidar_depth, disp_occ or LiDAR scans"
    )
