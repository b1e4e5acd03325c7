"""Shape names, and the units and conventions they carry; rows taken at even steps.

All data are tensors; only files hold bytes. Batched forms put ``*batch`` in front. Invalid values
of a map are NaN in memory and in NPY files, and 0 in 16-bit PNG files.
"""

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from depthpose.core.errors import InputError

Image = Float[Tensor, "3 h w"]
"""RGB in [0, 1], float32: red first. OpenCV's images are BGR, blue first."""

_LUMA = (0.299, 0.587, 0.114)  # shares of red, green and blue in the brightness, ITU-R BT.601


def take_evenly(rows: Shaped[Tensor, "n ..."], count: int) -> Shaped[Tensor, "m ..."]:
    """Take ``count`` rows at even steps, the first among them; all where there are no more."""
    if len(rows) <= count:
        return rows
    return rows[torch.arange(count, device=rows.device) * len(rows) // count]


def grey_of(image: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
    """Give the brightness of an RGB image (luma of ITU-R BT.601)."""
    return (image * image.new_tensor(_LUMA)[:, None, None]).sum(0)


def check_image(image: object, name: str, slack: float = 0.5) -> Image:
    """Give an RGB image back, or refuse what is none; values may leave [0, 1] by ``slack``."""
    if not isinstance(image, Tensor):
        raise InputError(
            f"{name} must be a tensor, got {type(image).__name__}; read files with "
            f"core.files.read_image, or use torch.from_numpy"
        )
    if image.ndim != 3 or image.shape[0] != 3:
        raise InputError(
            f"{name} must have shape (3, H, W), got {tuple(image.shape)}; move channels first, "
            f"drop alpha, repeat grey three times, and give one image at a time"
        )
    if not image.is_floating_point():
        raise InputError(f"{name} must be float in [0, 1], got {image.dtype}; divide by 255")
    if not image.numel():
        raise InputError(f"{name} is empty: shape {tuple(image.shape)}; give it pixels")
    if not bool(torch.isfinite(image).all()):
        raise InputError(f"{name} holds NaN or infinite values; replace or mask them first")
    low, high = float(image.min()), float(image.max())
    if low < -slack or high > 1 + slack:
        raise InputError(
            f"{name} must lie in [0, 1], got {low:.4g} .. {high:.4g}; divide 8-bit values by 255, "
            f"and do not normalise: the network does"
        )
    return image
