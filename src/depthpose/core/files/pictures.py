"""Pictures in whatever form a caller has them, as RGB in [0, 1]."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped
from PIL import Image
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files.images import check_image, picture_tensor, read_image

Picture = str | Path | Image.Image | Shaped[Tensor, "..."] | Shaped[np.ndarray, "..."]
"""A file, a picture of Pillow's, an array or a tensor: RGB, RGBA (alpha is dropped) or grey, whole
numbers of 8 bits or floats in [0, 1], (H, W, C), (C, H, W) or (H, W). The order of the channels
cannot be seen in the values: OpenCV reads BGR, which ``image[..., ::-1]`` turns into RGB."""
_CHANNELS = (1, 3, 4)
_VALUES = (
    "give 8-bit numbers, or floats in [0, 1]: divide by the largest value that it can hold (65535 "
    "of 16 bits)"
)


def as_tensor(image: object, name: str = "the image") -> Float[Tensor, "3 h w"]:
    """Read a :data:`Picture`, or bring it to RGB in [0, 1]; a batch of one is its image."""
    match image:
        case str() | Path():
            return read_image(Path(image))
        case Image.Image():
            return picture_tensor(image, name)
        case np.ndarray() if image.dtype != np.uint8 and image.dtype.kind != "f":
            raise InputError(f"{name} is an array of {image.dtype}; {_VALUES}")
        case np.ndarray():
            kind = np.uint8 if image.dtype == np.uint8 else np.float32
            values = torch.from_numpy(np.require(image, kind, requirements=["C", "W"]))
            return _rgb(values, (-1, 0), f"{name} is an array")
        case Tensor() if image.dtype != torch.uint8 and not image.is_floating_point():
            raise InputError(f"{name} is a tensor of {image.dtype}; {_VALUES}")
        case Tensor():
            return _rgb(image, (0, -1), f"{name} is a tensor")
        case _:
            return check_image(image, name)


def _rgb(values: Tensor, sides: tuple[int, int], what: str) -> Float[Tensor, "3 h w"]:
    """Move the channel axis to the front, as three channels in [0, 1]."""
    shape = tuple(values.shape)
    if values.ndim == 4 and shape[0] != 1:
        raise InputError(
            f"{what} of shape {shape}, a batch; give one image, or the batch to "
            "estimate_many(batch, camera)"
        )
    values_3d = values[0] if values.ndim == 4 else values
    planes = values_3d[None] if values_3d.ndim == 2 else values_3d
    channel_axes = (k for k in sides if planes.ndim == 3 and planes.shape[k] in _CHANNELS)
    side = 0 if values_3d.ndim == 2 else next(channel_axes, None)
    if side is None:
        raise InputError(f"{what} of shape {shape}; give (H, W, 3), (3, H, W) or grey (H, W)")
    planes = planes.movedim(side, 0)[:3]
    scaled = planes.float() / 255 if planes.dtype == torch.uint8 else planes.float()
    return check_image(scaled.expand(3, -1, -1), what.partition(" is ")[0])
