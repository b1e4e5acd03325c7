"""Images of one dataset that show nearly the same as images of another.

    python bench/duplicates.py TRAINED_ON EVALUATION

Training on frames of the evaluation's drives makes every number too good. Left images are compared
by their fine structure over small shifts and zooms: similarity is 1 for the same image and stays
below 0.3 for two different streets. Check the list by eye. Folders may have any layout that
``depthpose data check`` knows.
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
from depthpose.report.page import format_markdown_table

_ROWS, _COLUMNS = 40, 128
_SHIFT_ROWS, _SHIFT_COLUMNS = 2, 6
_BLUR = 9
_ZOOMS = (1.0, 1.12, 1.25, 1.4)
MIN_SIMILARITY = 0.3
"""Of two images that count as near-duplicates."""

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
    at_least: float = MIN_SIMILARITY,
    progress: Progress = iter,
) -> list[Duplicate]:
    """List the pairs of left images, one of either set, that look alike, the most similar first.

    The most similar pair is listed in any case: its similarity says how far the sets are apart.
    The others have a similarity of ``at_least`` or more; ``progress`` wraps the sequence of frames.
    """
    similarity = similarity_matrix(first, second, progress)
    limit = min(at_least, float(similarity.max()))
    duplicates = [
        Duplicate(
            first=first.frames[i].name,
            second=second.frames[j].name,
            similarity=float(similarity[i, j]),
        )
        for i, j in (similarity >= limit).nonzero().tolist()
    ]
    return sorted(duplicates, key=lambda pair: (-pair.similarity, pair.first, pair.second))


def similarity_matrix(
    first: Dataset, second: Dataset, progress: Progress = iter
) -> Float[Tensor, "n m"]:
    """Compute the largest correlation over small shifts and zooms, for every pair of images."""
    first_details = _read_details(first, progress)
    second_details = _read_details(second, progress)
    best = torch.full((len(first), len(second)), -1.0)
    for zoom in range(len(_ZOOMS)):
        best = torch.maximum(best, _best_correlation(first_details[0], second_details[zoom]))
        best = torch.maximum(best, _best_correlation(second_details[0], first_details[zoom]).T)
    return best


def _read_details(images: Dataset, progress: Progress) -> Float[Tensor, "zooms n rows columns"]:
    """Read the fine structure of each image and of its middle, one for each zoom.

    These are grey thumbnails minus their local mean, divided by the local deviation.
    """
    blur = nn.AvgPool2d(_BLUR, 1, _BLUR // 2, count_include_pad=False)
    details = []
    for index in progress(range(len(images))):
        image = read_image(images.frames[index].left).mean(0, keepdim=True)
        height, width = image.shape[1:]
        thumbnails = []
        for zoom in _ZOOMS:
            top = round(height * (1 - 1 / zoom) / 2)
            left = round(width * (1 - 1 / zoom) / 2)
            middle = image[:, top : height - top, left : width - left]
            thumbnails.append(F.interpolate(middle[None], (_ROWS, _COLUMNS), mode="area"))
        grey = torch.cat(thumbnails)
        detail = grey - blur(grey)
        deviation = blur(detail**2).sqrt()
        details.append((detail / (deviation + 0.01))[:, 0])
    return torch.stack(details, 1)


def _best_correlation(
    first: Float[Tensor, "n rows columns"], second: Float[Tensor, "m rows columns"]
) -> Float[Tensor, "n m"]:
    """Compute the largest correlation of each pair over small shifts of the first image."""
    height = _ROWS - 2 * _SHIFT_ROWS
    width = _COLUMNS - 2 * _SHIFT_COLUMNS
    middle = second[:, _SHIFT_ROWS : _SHIFT_ROWS + height, _SHIFT_COLUMNS : _SHIFT_COLUMNS + width]
    normalised_middle = _normalise(middle)
    best = torch.full((len(first), len(second)), -1.0)
    for top in range(2 * _SHIFT_ROWS + 1):
        for left in range(2 * _SHIFT_COLUMNS + 1):
            window = first[:, top : top + height, left : left + width]
            best = torch.maximum(best, _normalise(window) @ normalised_middle.T)
    return best


def _normalise(images: Float[Tensor, "n rows columns"]) -> Float[Tensor, "n pixels"]:
    """Shift and scale each image to mean 0 and length 1."""
    pixels = images.flatten(1)
    pixels = pixels - pixels.mean(1, keepdim=True)
    return pixels / pixels.norm(dim=1, keepdim=True).clamp(min=1e-9)


def main() -> None:
    """Print the pairs that look alike, and the most similar one in any case."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("first", type=Path, help="folder of the first set")
    parser.add_argument("second", type=Path, help="folder of the second set")
    parser.add_argument(
        "--at-least", type=float, default=MIN_SIMILARITY, help="least similarity listed"
    )
    options = parser.parse_args()
    first = open_dataset(options.first)
    second = open_dataset(options.second)
    progress = partial(tqdm, unit=" frames", disable=None)
    duplicates = find_duplicates(first, second, options.at_least, progress)
    rows = [asdict(pair) for pair in duplicates if pair.similarity >= options.at_least]
    print(format_markdown_table(rows) if rows else "none")
    best = duplicates[0]
    print(
        f"{len(first)} x {len(second)} images: {len(rows)} pairs of similarity "
        f"{options.at_least:g} or more; the most similar: {best.first} and {best.second}, "
        f"{best.similarity:.3f}"
    )


if __name__ == "__main__":
    main()
