"""Images, maps and matches brought to other sizes; sizes that belong to a focal length."""

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import Camera
from depthpose.depth.disparity import resize_disparity
from depthpose.depth.types import Match


def focal_size(camera: Camera, focal_px: float) -> tuple[int, int]:
    """Rows and columns at which the camera's image has ``focal_px``, with square pixels."""
    rows = round(camera.height * focal_px / float(camera.K[1, 1]))
    columns = round(camera.width * focal_px / float(camera.K[0, 0]))
    return max(rows, 1), max(columns, 1)


def resize_image(
    image: Float[Tensor, "3 _ _"], height: int, width: int
) -> Float[Tensor, "3 {height} {width}"]:
    """Resize bilinearly, averaging where it shrinks."""
    if image.shape[1:] == (height, width):
        return image
    shrinks = height < image.shape[1] or width < image.shape[2]
    resized = F.interpolate(image[None], (height, width), mode="bilinear", antialias=shrinks)
    return resized[0].clamp(0, 1)


def resized_match(match: Match, height: int, width: int) -> Match:
    """Bring a match to another size of its image."""
    sure = match.confidence
    return Match(
        disparity_px=resize_disparity(match.disparity_px, height, width),
        confidence=None if sure is None else resized_map(sure, height, width),
    )


def resized_map(
    values: Float[Tensor, "_ _"], height: int, width: int
) -> Float[Tensor, "{height} {width}"]:
    """Bring a map to another size, without averaging."""
    if values.shape == (height, width):
        return values
    return F.interpolate(values[None, None], (height, width), mode="bilinear")[0, 0]
