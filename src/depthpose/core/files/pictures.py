"""Conversion of pictures in any form that a caller has them in to RGB in [0, 1]."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped
from PIL import Image
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files.images import check_image, read_image, rgb_from_pillow

AnyPicture = str | Path | Image.Image | Shaped[Tensor, "..."] | Shaped[np.ndarray, "..."]
"""A file, a picture of Pillow's, an array or a tensor: RGB, RGBA (alpha is dropped) or grey, whole
numbers of 8 bits or floats in [0, 1], (H, W, C), (C, H, W) or (H, W). The order of the channels
cannot be seen in the values: OpenCV reads BGR, which ``image[..., ::-1]`` turns into RGB."""
_CHANNEL_COUNTS = (1, 3, 4)  # grey, RGB, RGBA
_ALLOWED_VALUES = (
    "give 8-bit numbers, or floats in [0, 1]: divide by the largest value that it can hold (65535 "
    "of 16 bits)"
)


def rgb_from_picture(image: object, name: str = "the image") -> Float[Tensor, "3 h w"]:
    """Read or convert a picture in any form (``AnyPicture``) to RGB in [0, 1].

    Args:
        image: the picture; a batch of one image is taken as that image.
        name: what errors call it.

    Raises:
        InputError: it is no picture.
    """
    match image:
        case str() | Path():
            return read_image(Path(image))
        case Image.Image():
            return rgb_from_pillow(image, name)
        case np.ndarray() if image.dtype != np.uint8 and image.dtype.kind != "f":
            raise InputError(f"{name} is an array of {image.dtype}; {_ALLOWED_VALUES}")
        case np.ndarray():
            kind = np.uint8 if image.dtype == np.uint8 else np.float32
            values = torch.from_numpy(np.require(image, kind, requirements=["C", "W"]))
            return _to_rgb(values, (-1, 0), f"{name} is an array")
        case Tensor() if image.dtype != torch.uint8 and not image.is_floating_point():
            raise InputError(f"{name} is a tensor of {image.dtype}; {_ALLOWED_VALUES}")
        case Tensor():
            return _to_rgb(image, (0, -1), f"{name} is a tensor")
        case _:
            raise InputError(
                f"{name} must be a tensor, got {type(image).__name__}; or give a file, an array "
                "or a picture of Pillow's"
            )


def _to_rgb(
    values: Tensor, channel_axes: tuple[int, int], described: str
) -> Float[Tensor, "3 h w"]:
    """Convert the values of an image to RGB in [0, 1].

    Args:
        values: grey (H, W), or with a channel axis, or a batch of one such image; bytes or floats.
        channel_axes: axes that may be that of the channels; the first of fitting length is taken.
        described: ``NAME is a tensor`` or the like, with which errors begin.
    """
    shape = tuple(values.shape)
    if values.ndim == 4:
        if shape[0] != 1:
            raise InputError(
                f"{described} of shape {shape}, a batch; give one image, or the batch to "
                "estimate_many(batch, camera)"
            )
        values = values[0]

    channel_axis = None
    if values.ndim == 2:
        values = values[None]
        channel_axis = 0
    elif values.ndim == 3:
        fitting = (axis for axis in channel_axes if values.shape[axis] in _CHANNEL_COUNTS)
        channel_axis = next(fitting, None)
    if channel_axis is None:
        raise InputError(f"{described} of shape {shape}; give (H, W, 3), (3, H, W) or grey (H, W)")

    channels = values.movedim(channel_axis, 0)[:3]
    scaled = channels.float() / 255 if channels.dtype == torch.uint8 else channels.float()
    return check_image(scaled.expand(3, -1, -1), described.partition(" is ")[0])
