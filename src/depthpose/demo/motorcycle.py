"""The real pair of the demo: Middlebury's Motorcycle, from scikit-image's own package."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.types import StereoInput, StereoSample, StereoTruth


def read_motorcycle() -> StereoSample | None:
    """Read the pair with its true disparity, or None where scikit-image is not installed.

    Calibration is that of scikit-image's documentation: images a quarter of the original size,
    principal points 31.086 px apart, baseline 193.001 mm.
    """
    try:
        from skimage.data import stereo_motorcycle
    except ImportError:
        return None
    left, right, disparity = stereo_motorcycle()
    K = torch.tensor([[994.978, 0, 311.193], [0, 994.978, 254.877], [0, 0, 1]], dtype=torch.float64)
    rig = StereoRig(
        width=left.shape[1],
        height=left.shape[0],
        K=K,
        baseline_m=0.193001,
        cx_right_minus_left_px=31.086,
    )
    disparity_px = torch.from_numpy(np.array(disparity, np.float32))
    disparity_px[~torch.isfinite(disparity_px)] = torch.nan
    truth = StereoTruth(disparity_px=disparity_px, depth_m=depth_from_disparity(disparity_px, rig))
    pair = StereoInput(name="motorcycle", left=_image(left), right=_image(right), camera=rig)
    return StereoSample(input=pair, truth=truth)


def _image(pixels: np.ndarray) -> Float[Tensor, "3 h w"]:
    return torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1).float() / 255
