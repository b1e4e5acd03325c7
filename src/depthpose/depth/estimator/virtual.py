"""To the rig that a generator imitates, or a matcher was trained at, and back."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.depth.config import GeneratorConfig, SelectionConfig
from depthpose.depth.disparity import depth_from_disparity, disparity_from_depth
from depthpose.depth.sizes import resize_image, resized_map, resized_match
from depthpose.depth.types import DepthEstimate, Match, StereoInput

SKY_M = 10_000.0
"""What the disparity of the sky says: protocols take a disparity of zero for none, or for near."""


def square_camera(size: tuple[int, int], focal_px: float) -> Camera:
    """Make the camera of an image brought to ``focal_px``, its axis through the middle."""
    rows, columns = size
    K = torch.tensor(
        [[focal_px, 0, (columns - 1) / 2], [0, focal_px, (rows - 1) / 2], [0, 0, 1]],
        dtype=torch.float64,
    )
    return Camera(width=columns, height=rows, K=K)


def from_virtual(
    image: StereoInput,
    rig: GeneratorConfig | SelectionConfig,
    match: Match,
    right: Float[Tensor, "3 _ _"],
    is_sky: Bool[Tensor, "_ _"] | None,
) -> DepthEstimate:
    """Bring what was found at the virtual rig back to the image."""
    camera = image.camera
    assert camera is not None
    height, width = image.left.shape[1:]
    seen = resized_match(match, height, width)
    imitated = StereoRig(width=width, height=height, K=camera.K, baseline_m=rig.virtual_baseline_m)
    depth_m = depth_from_disparity(seen.disparity_px, imitated)
    disparity_px = seen.disparity_px
    if is_sky is not None:
        share = resized_map(is_sky.float(), height, width)
        is_sky = share > 0.5
        depth_m = torch.where(is_sky, SKY_M, depth_m)
        sky_px = float(camera.K[0, 0]) * rig.virtual_baseline_m / SKY_M
        disparity_px = torch.where(is_sky, sky_px, disparity_px)
    if isinstance(camera, StereoRig):
        disparity_px = disparity_from_depth(depth_m, camera)
    return DepthEstimate(
        depth_m=depth_m if is_sky is None else torch.where(is_sky, torch.nan, depth_m),
        disparity_px=disparity_px,
        confidence=seen.confidence,
        right=resize_image(right, height, width),
        is_sky=is_sky,
        seen=image,
    )


def join_matches(one: Match, other: Match) -> Match:
    """Take the mean of two disparities in the logarithm, weighed by their confidence.

    Where ``other`` has no answer, or no confidence, ``one`` stands.
    """
    assert one.confidence is not None
    weight = torch.zeros_like(one.confidence) if other.confidence is None else other.confidence
    weight = torch.where(other.disparity_px > 0, weight, 0.0)
    share = weight / (weight + one.confidence).clamp(min=1e-6)
    logs = [match.disparity_px.clamp(min=1e-3).log() for match in (one, other)]
    log_px = torch.lerp(logs[0], logs[1].nan_to_num(0.0), share)
    return Match(disparity_px=log_px.exp(), confidence=torch.lerp(one.confidence, weight, share))
