"""To the rig that a generator imitates, or a matcher was trained at, and back."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.depth.config import GeneratorConfig
from depthpose.depth.disparity import depth_from_disparity, disparity_from_depth, resize_disparity
from depthpose.depth.estimator.sky import lower_in_sky
from depthpose.depth.types import DepthEstimate, Match, StereoInput


def focal_size(camera: Camera, focal_px: float) -> tuple[int, int]:
    """Rows and columns at which the camera's image has ``focal_px``, with square pixels."""
    rows = round(camera.height * focal_px / float(camera.K[1, 1]))
    columns = round(camera.width * focal_px / float(camera.K[0, 0]))
    return max(rows, 1), max(columns, 1)


def square_camera(size: tuple[int, int], focal_px: float) -> Camera:
    """Make the camera of an image brought to ``focal_px``, its axis through the middle."""
    rows, columns = size
    K = torch.tensor(
        [[focal_px, 0, (columns - 1) / 2], [0, focal_px, (rows - 1) / 2], [0, 0, 1]],
        dtype=torch.float64,
    )
    return Camera(width=columns, height=rows, K=K)


def resize_image(
    image: Float[Tensor, "3 _ _"], height: int, width: int
) -> Float[Tensor, "3 {height} {width}"]:
    """Resize bilinearly, averaging where it shrinks."""
    if image.shape[1:] == (height, width):
        return image
    shrinks = height < image.shape[1] or width < image.shape[2]
    resized = F.interpolate(image[None], (height, width), mode="bilinear", antialias=shrinks)
    return resized[0].clamp(0, 1)


def from_virtual(
    image: StereoInput, rig: GeneratorConfig, right: Tensor, match: Match
) -> DepthEstimate:
    """Bring what was found at the virtual rig back to the image.

    No generator here knows the sky: the confidence there is lowered.
    """
    camera = image.camera
    assert camera is not None
    height, width = image.left.shape[1:]
    seen = resized_match(match, height, width)
    imitated = StereoRig(width=width, height=height, K=camera.K, baseline_m=rig.virtual_baseline_m)
    depth_m = depth_from_disparity(seen.disparity_px, imitated)
    is_rig = isinstance(camera, StereoRig)
    return DepthEstimate(
        depth_m=depth_m,
        disparity_px=disparity_from_depth(depth_m, camera) if is_rig else seen.disparity_px,
        confidence=lower_in_sky(seen.confidence, image.left),
        right=resize_image(right, height, width),
    )


def resized_match(match: Match, height: int, width: int) -> Match:
    """Bring a match to another size of its image."""
    return Match(
        disparity_px=resize_disparity(match.disparity_px, height, width),
        confidence=_resized_map(match.confidence, height, width),
    )


def _resized_map(
    values: Float[Tensor, "_ _"] | None, height: int, width: int
) -> Float[Tensor, "{height} {width}"] | None:
    if values is None or values.shape == (height, width):
        return values
    return F.interpolate(values[None, None], (height, width), mode="bilinear")[0, 0]
