"""Pictures that hold both views of a stereo camera: side by side, or one above the other."""

from typing import Literal

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from depthpose.core.camera.rectified import check_rectified, grey_of

Arrangement = Literal["side by side", "top and bottom"]
_ROWS = 32
_COLUMNS = 64
_REACH = 12
"""Of the small copies of both halves, and by how many columns they are moved."""
_ALIKE = 0.6
"""Least correlation of the halves, less what is common to whole rows and columns: 0.77 to 0.95 of
both views of 25 KITTI pairs put together, -0.2 to 0.43 of the halves of their left images."""
_LEAST_DEVIATION = 0.01
_MIN_MATCHES = 25


def halves(image: Float[Tensor, "3 h w"], arrangement: Arrangement) -> tuple[Tensor, Tensor]:
    """Split a picture into its left and right half, or its upper and lower one."""
    if arrangement == "side by side":
        width = image.shape[2] // 2
        return image[:, :, :width].contiguous(), image[:, :, -width:].contiguous()
    height = image.shape[1] // 2
    return image[:, :height].contiguous(), image[:, -height:].contiguous()


def find_two_views(image: Float[Tensor, "3 h w"]) -> Arrangement | None:
    """Give the arrangement of two views of one scene in a picture; None where it is one view."""
    if min(image.shape[1:]) < 2 * _ROWS:
        return None
    for arrangement in ("side by side", "top and bottom"):
        first_half, second_half = halves(image, arrangement)
        if (
            _likeness(first_half, second_half) > _ALIKE
            and check_rectified(first_half, second_half).matches >= _MIN_MATCHES
        ):
            return arrangement
    return None


def _likeness(first_half: Tensor, second_half: Tensor) -> float:
    """Give the correlation of small copies of both halves, at the shift where it is largest."""
    small_copies: list[Tensor] = []
    for half in (first_half, second_half):
        grey = grey_of(half).float()[None, None]
        copy = functional.interpolate(grey, (_ROWS, _COLUMNS), mode="area")
        small_copies.append(copy[0, 0])
    first, second = small_copies
    best = 0.0
    for shift in range(-_REACH, _REACH + 1):
        a = _centred(first[:, max(shift, 0) : _COLUMNS + min(shift, 0)])
        b = _centred(second[:, max(-shift, 0) : _COLUMNS + min(-shift, 0)])
        if min(float(a.std()), float(b.std())) > _LEAST_DEVIATION:
            best = max(best, float((a * b).sum() / (a.norm() * b.norm())))
    return best


def _centred(grey: Tensor) -> Tensor:
    """Subtract the mean of each row and column: bright sky above a road is common to all halves."""
    return grey - grey.mean(0) - grey.mean(1, keepdim=True) + grey.mean()


def order_views(
    first: Float[Tensor, "3 h w"], second: Float[Tensor, "3 h w"]
) -> tuple[Tensor, Tensor]:
    """Put the left view first: files for crossed eyes, such as JPS, begin with the right one."""
    return (second, first) if check_rectified(first, second).is_swapped else (first, second)
