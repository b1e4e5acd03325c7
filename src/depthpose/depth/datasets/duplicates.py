"""Near-duplicates between two sets of images: evaluation frames that training has seen.

Every street has sky above and asphalt below, so whole thumbnails of unrelated streets correlate by
0.9; what is left after each pixel's surroundings are subtracted does not. The comparison is made
over small shifts and zooms, for a car turns and drives on between two frames.

The threshold is where frames of KITTI whose drives are known separate (95 pairs of KITTI 2015
from 20 drives): of some 4200 pairs from two drives none but those of one crossing, which two drives
show, reaches 0.3; of frames of one drive a second apart 19 of 24 do, those in a turn do not. So
the search finds the same view again, and not every frame of the same drive.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.files import read_image
from depthpose.depth.datasets.dataset import Dataset

_ROWS, _COLUMNS = 40, 128
_SHIFT_ROWS, _SHIFT_COLUMNS = 2, 6
_BLUR = 9
_ZOOMS = (1.0, 1.12, 1.25, 1.4)
DUPLICATE_SIMILARITY = 0.3
"""Similarity from which two images count as near-duplicates."""

Progress = Callable[[Sequence[int]], Iterable[int]]


@dataclass(frozen=True, kw_only=True)
class Duplicate:
    """Two images that show nearly the same.

    Attributes:
        first: name of the frame in the first set.
        second: name of the frame in the second set.
        similarity: 1 for the same picture, about 0 for two streets.
    """

    first: str
    second: str
    similarity: float


def shrink(image: Float[Tensor, "c h w"], rows: int, columns: int) -> Float[Tensor, "c rows cols"]:
    """Average an image over a grid of cells."""
    return F.interpolate(image[None], (rows, columns), mode="area")[0]


def find_duplicates(
    first: Dataset,
    second: Dataset,
    at_least: float = DUPLICATE_SIMILARITY,
    progress: Progress = iter,
) -> list[Duplicate]:
    """List the pairs of left images, one of either set, that look alike, the most similar first.

    The most similar pair is listed in any case: its similarity says how far the sets are apart.

    Args:
        first: usually the training set.
        second: usually the evaluation set.
        at_least: smallest similarity that is listed; a lower one lists more pairs to compare.
        progress: wraps the sequence of frames, to show how far it is.
    """
    similarity = similarity_matrix(first, second, progress)
    pairs = (similarity >= min(at_least, float(similarity.max()))).nonzero().tolist()
    found = [
        Duplicate(
            first=first.frames[i].name,
            second=second.frames[j].name,
            similarity=float(similarity[i, j]),
        )
        for i, j in pairs
    ]
    return sorted(found, key=lambda pair: (-pair.similarity, pair.first, pair.second))


def similarity_matrix(
    first: Dataset, second: Dataset, progress: Progress = iter
) -> Float[Tensor, "n m"]:
    """Largest correlation of fine structure over small shifts and zooms, for every pair."""
    ours, theirs = (
        torch.stack([_fine_structure(images, i) for i in progress(range(len(images)))], 1)
        for images in (first, second)
    )
    best = torch.full((len(first), len(second)), -1.0)
    for zoomed in range(len(_ZOOMS)):
        best = torch.maximum(best, _best_shift(ours[0], theirs[zoomed]))
        best = torch.maximum(best, _best_shift(theirs[0], ours[zoomed]).T)
    return best


def _best_shift(
    ours: Float[Tensor, "n h w"], theirs: Float[Tensor, "m h w"]
) -> Float[Tensor, "n m"]:
    height, width = _ROWS - 2 * _SHIFT_ROWS, _COLUMNS - 2 * _SHIFT_COLUMNS
    middle = theirs[:, _SHIFT_ROWS : _SHIFT_ROWS + height, _SHIFT_COLUMNS : _SHIFT_COLUMNS + width]
    best = torch.full((len(ours), len(theirs)), -1.0)
    for top in range(2 * _SHIFT_ROWS + 1):
        for left in range(2 * _SHIFT_COLUMNS + 1):
            window = ours[:, top : top + height, left : left + width]
            best = torch.maximum(best, _unit(window) @ _unit(middle).T)
    return best


def _fine_structure(dataset: Dataset, index: int) -> Float[Tensor, "zooms rows columns"]:
    """Make grey thumbnails of the image and of its middle, one a zoom, contrast evened out."""
    image = read_image(dataset.frames[index].left).mean(0, keepdim=True)
    grey = torch.stack([shrink(_middle(image, zoom), _ROWS, _COLUMNS) for zoom in _ZOOMS])
    detail = grey - _blur(grey)
    return (detail / (_blur(detail**2).sqrt() + 0.01))[:, 0]


def _middle(image: Float[Tensor, "c h w"], zoom: float) -> Float[Tensor, "c rows columns"]:
    height, width = image.shape[1:]
    top, left = (round(side * (1 - 1 / zoom) / 2) for side in (height, width))
    return image[:, top : height - top, left : width - left]


def _blur(image: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    return F.avg_pool2d(image, _BLUR, 1, _BLUR // 2, count_include_pad=False)


def _unit(windows: Float[Tensor, "n h w"]) -> Float[Tensor, "n hw"]:
    flat = windows.flatten(1)
    centred = flat - flat.mean(1, keepdim=True)
    return centred / centred.norm(dim=1, keepdim=True).clamp(min=1e-9)
