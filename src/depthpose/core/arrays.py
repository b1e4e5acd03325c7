"""The conventions of arrays, the type of an image, its brightness, and thinning.

All data are tensors. Batched forms have ``*batch`` axes in front. Invalid values of a map are NaN
in memory and in NPY files, and 0 in 16-bit PNG files.
"""

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

Image = Float[Tensor, "3 h w"]
"""RGB in [0, 1], float32: red first. OpenCV's images are BGR, blue first."""

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
"""Mean and standard deviation of red, green and blue in ImageNet, which networks are normalised by.
"""
_LUMA = (0.299, 0.587, 0.114)  # shares of red, green and blue in the brightness, ITU-R BT.601


def grey_from_rgb(image: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
    """Compute the brightness of an RGB image (luma of ITU-R BT.601)."""
    return (image * image.new_tensor(_LUMA)[:, None, None]).sum(0)


def take_evenly(rows: Shaped[Tensor, "n ..."], count: int) -> Shaped[Tensor, "m ..."]:
    """Take ``count`` rows at even steps, beginning with the first; all where there are fewer."""
    if len(rows) <= count:
        return rows
    return rows[torch.arange(count, device=rows.device) * len(rows) // count]
