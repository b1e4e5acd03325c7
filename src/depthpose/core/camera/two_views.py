"""Pictures that hold both views of a stereo camera: side by side, or one above the other."""

from typing import Literal

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from depthpose.core.arrays import grey_from_rgb
from depthpose.core.camera.rectified import check_rectified

Arrangement = Literal["side by side", "top and bottom"]
_ROWS = 32  # rows of the small copies of both halves, which are compared
_COLUMNS = 64  # columns of these copies
_MAX_SHIFT = 12  # most columns by which one copy is shifted against the other
_MIN_CORRELATION = 0.6
"""Least correlation of the two halves, without the means of rows and columns, where they are two
views: it is 0.77 to 0.95 for the two views of 25 KITTI pairs put together, and -0.2 to 0.43 for the
halves of their left images."""
_MIN_DEVIATION = 0.01  # standard deviation of the grey values of a copy in [0, 1]
_MIN_MATCHES = 25  # least matches of corners between both halves


def split_halves(image: Float[Tensor, "3 h w"], arrangement: Arrangement) -> tuple[Tensor, Tensor]:
    """Split a picture into its left and right half, or its upper and lower one.

    Where the number of columns or rows is odd, the middle one is in neither half.
    """
    if arrangement == "side by side":
        width = image.shape[2] // 2
        return image[:, :, :width].contiguous(), image[:, :, -width:].contiguous()
    height = image.shape[1] // 2
    return image[:, :height].contiguous(), image[:, -height:].contiguous()


def find_two_views(image: Float[Tensor, "3 h w"]) -> Arrangement | None:
    """Find out how a picture combines two views of one scene; None where it is a single view."""
    if min(image.shape[1:]) < 2 * _ROWS:
        return None
    for arrangement in ("side by side", "top and bottom"):
        first_half, second_half = split_halves(image, arrangement)
        if (
            _find_best_correlation(first_half, second_half) > _MIN_CORRELATION
            and check_rectified(first_half, second_half).matches >= _MIN_MATCHES
        ):
            return arrangement
    return None


def _find_best_correlation(first_half: Tensor, second_half: Tensor) -> float:
    """Compute the largest correlation of small copies of two halves over shifts along the rows."""
    small_copies: list[Tensor] = []
    for half in (first_half, second_half):
        grey = grey_from_rgb(half).float()[None, None]
        copy = functional.interpolate(grey, (_ROWS, _COLUMNS), mode="area")
        small_copies.append(copy[0, 0])
    first, second = small_copies
    best = 0.0
    for shift in range(-_MAX_SHIFT, _MAX_SHIFT + 1):
        # The columns that both copies share at this shift.
        first_columns = slice(max(shift, 0), _COLUMNS + min(shift, 0))
        second_columns = slice(max(-shift, 0), _COLUMNS + min(-shift, 0))
        a = _subtract_means(first[:, first_columns])
        b = _subtract_means(second[:, second_columns])
        if min(float(a.std()), float(b.std())) > _MIN_DEVIATION:
            correlation = float((a * b).sum() / (a.norm() * b.norm()))
            best = max(best, correlation)
    return best


def _subtract_means(grey: Tensor) -> Tensor:
    """Subtract the means of rows and columns, since most halves have a bright sky above a road."""
    return grey - grey.mean(0) - grey.mean(1, keepdim=True) + grey.mean()


def order_views(
    first: Float[Tensor, "3 h w"], second: Float[Tensor, "3 h w"]
) -> tuple[Tensor, Tensor]:
    """Return the left view, then the right one, as the images tell; JPS begins with the right."""
    is_swapped = check_rectified(first, second).is_swapped
    return (second, first) if is_swapped else (first, second)
