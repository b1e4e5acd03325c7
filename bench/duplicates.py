"""Images of one data set that show nearly the same as images of another.

    python bench/duplicates.py TRAINED_ON EVALUATION

Training on frames of the evaluation's drives makes every number too good. Left images are compared
by their fine structure over small shifts and zooms: 1 is the same image, two streets stay below
0.3. Check the list by eye. Folders in any layout that ``depthpose data check`` knows.
"""

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import tqdm

from depthpose.core.files import read_image
from depthpose.depth.datasets import Dataset, open_dataset
from depthpose.report.page import markdown_table

_ROWS, _COLUMNS = 40, 128
_SHIFT_ROWS, _SHIFT_COLUMNS = 2, 6
_BLUR = 9
_ZOOMS = (1.0, 1.12, 1.25, 1.4)
LEAST = 0.3
"""Similarity from which two images count as near-duplicates."""

Progress = Callable[[Sequence[int]], Iterable[int]]


@dataclass(frozen=True, kw_only=True)
class Duplicate:
    """Two images that show nearly the same."""

    first: str  #: name of the frame in the first set
    second: str  #: name of the frame in the second set
    similarity: float  #: 1 for the same picture, about 0 for two streets


def find_duplicates(
    first: Dataset,
    second: Dataset,
    at_least: float = LEAST,
    progress: Progress = iter,
) -> list[Duplicate]:
    """List the pairs of left images, one of either set, that look alike, the most similar first.

    The most similar pair is listed in any case: its similarity says how far the sets are apart.
    The others have a similarity of ``at_least`` or more; ``progress`` wraps the sequence of frames.
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
    """Largest correlation of fine structure over small shifts and zooms, for every pair.

    Compared are grey thumbnails of each image and of its middle, one a zoom, contrast evened out.
    """
    found: list[Float[Tensor, "zooms n rows columns"]] = []
    blur = nn.AvgPool2d(_BLUR, 1, _BLUR // 2, count_include_pad=False)
    for images in (first, second):
        details = []
        for index in progress(range(len(images))):
            image = read_image(images.frames[index].left).mean(0, keepdim=True)
            height, width = image.shape[1:]
            parts = []
            for zoom in _ZOOMS:
                top, left = (round(side * (1 - 1 / zoom) / 2) for side in (height, width))
                middle = image[:, top : height - top, left : width - left]
                parts.append(F.interpolate(middle[None], (_ROWS, _COLUMNS), mode="area"))
            grey = torch.cat(parts)
            detail = grey - blur(grey)
            details.append((detail / (blur(detail**2).sqrt() + 0.01))[:, 0])
        found.append(torch.stack(details, 1))
    ours, theirs = found
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
            one, other = (part.flatten(1) for part in (window, middle))
            one, other = (part - part.mean(1, keepdim=True) for part in (one, other))
            lengths = [part.norm(dim=1, keepdim=True).clamp(min=1e-9) for part in (one, other)]
            best = torch.maximum(best, (one / lengths[0]) @ (other / lengths[1]).T)
    return best


def main() -> None:
    """Print the pairs that look alike, and the most similar one in any case."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("first", type=Path, help="folder of the first set")
    parser.add_argument("second", type=Path, help="folder of the second set")
    parser.add_argument("--at-least", type=float, default=LEAST, help="least similarity listed")
    words = parser.parse_args()
    sets = open_dataset(words.first), open_dataset(words.second)
    ranked = find_duplicates(*sets, words.at_least, partial(tqdm, unit=" frames", disable=None))
    rows = [asdict(pair) for pair in ranked if pair.similarity >= words.at_least]
    print(markdown_table(rows) if rows else "none")
    best = f"{ranked[0].first} and {ranked[0].second}, {ranked[0].similarity:.3f}"
    print(f"{len(sets[0])} x {len(sets[1])} images: {len(rows)} pairs of similarity "
          f"{words.at_least:g} or more; the most similar: {best}")  # fmt: skip


if __name__ == "__main__":
    main()
