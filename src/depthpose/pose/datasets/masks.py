"""Masks of objects: pictures, and COCO's run lengths."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files import read_json
from depthpose.core.files.images import MAX_PIXELS, open_image

Runs = tuple[tuple[int, ...], int, int]  #: run lengths, height and width
_MOST_LABELS = 64  # different values of an image of labels; one of more is a picture
_HALF = 127  # of 255: values above it are the object, in masks with soft edges
_SOFT = 32  # of 255: values farther than this from black and white are grey
_MOST_BITS = 40  # of a run length in text: no image has as many pixels


def read_mask(path: Path) -> Bool[Tensor, "mask_h mask_w"]:
    """Read the mask of one object, as :func:`read_labels` reads it.

    Raises:
        InputError: it is missing, no picture, or shows several objects.
    """
    return one_mask(read_labels(path), str(path))


def read_labels(
    path: Path, labels: Collection[int] | None = None
) -> Int64[Tensor, "mask_h mask_w"]:
    """Read a mask image of any kind: 0 where it is black or transparent, a number for each object.

    Of a picture in colour they are 1, 2, ... in the order of the colours. In a photograph, or a
    picture of one colour, with an alpha channel the opaque pixels are the object. A ``.json`` file
    holds COCO's run lengths (``size`` and ``counts``, compressed or not), an annotation or a
    detection with such a ``segmentation``, or a list of one of these.

    Args:
        path: picture or ``.json``.
        labels: numbers of a label map: each keeps its value, also where it is alone, and another
            number is refused; None: the objects of the picture are numbered.

    Raises:
        InputError: the file is missing, no picture, a JPEG of numbered objects, or no list of one
            mask; or it holds a number that is not among the labels.
    """
    if path.suffix.lower() == ".json":
        if labels is not None:
            raise InputError(
                f"{path}: run lengths have no numbers of a label map; give a picture, or name the "
                "file by --detections, whose entries have classes"
            )
        content = read_json(path)
        entries = content if isinstance(content, list) else [content]
        if len(entries) != 1:
            raise InputError(
                f"{path}: holds {len(entries)} masks, where one is needed; leave one there, or "
                "name a list of BOP detections by --masks, beside --bop"
            )
        return decode_rle(*read_runs(entries[0], str(path))).long()
    pixels = _read_pixels(path, with_palette=labels is None)

    # Each colour becomes a number.
    values = pixels[..., 0]
    if pixels.shape[2] > 1 and (pixels[..., :3] != values[..., None]).any():
        colour = values.astype(np.int32)
        for part in (pixels[..., 1], pixels[..., 2]):
            colour = colour * 2**8 + part
        colours = np.unique(colour)
        # Not by the inverse of np.unique, which takes five times the memory.
        values = np.searchsorted(colours, colour).astype(np.int32) + (colours[0] != 0)

    # An alpha channel is the mask where the opaque pixels have one colour, or too many for labels.
    is_opaque = pixels[..., 3] > _HALF if pixels.shape[2] == 4 else values != 0
    if pixels.shape[2] == 4 and 0 < is_opaque.sum() < is_opaque.size:
        is_one_object = len(np.unique(values[is_opaque])) not in range(2, _MOST_LABELS)
        values = np.where(is_opaque, 1 if is_one_object else values, 0)
    return number_objects(values) if labels is None else _keep_labels(values, labels, path)


def _read_pixels(path: Path, *, with_palette: bool) -> np.ndarray:
    """Read the pixels of a mask image (h, w, channels): 1 of numbers, 3 of colours, 4 with alpha.

    ``with_palette`` gives the colours of a palette, else its indices.
    """
    with open_image(path) as image:
        # With alpha, indices of a palette, numbers, or colours.
        if image.mode in ("LA", "PA", "RGBA", "RGBa", "La") or "transparency" in image.info:
            pixels = np.asarray(image.convert("RGBA"))
        elif not with_palette and image.mode == "P":
            pixels = np.asarray(image).astype(np.int32)[..., None]
        elif image.mode in ("1", "L", "I", "F") or image.mode.startswith("I;16"):
            kind = np.int64 if image.mode == "F" else np.int32
            pixels = np.asarray(image).astype(kind)[..., None]
        else:
            pixels = np.asarray(image.convert("RGB"))

        # Compression of JPEG leaves grey pixels at edges, which are no object.
        if image.format == "JPEG":
            is_grey = (pixels > _SOFT) & (pixels < 255 - _SOFT)
            if is_grey.sum() > (pixels >= 255 - _SOFT).sum():
                raise InputError(
                    f"{path}: a JPEG of more grey than white, whose numbers of objects are lost by "
                    "its compression; save masks as PNG"
                )
            pixels = np.where(pixels > _HALF, 255, 0)
    return pixels


def _keep_labels(
    values: np.ndarray, labels: Collection[int], path: Path
) -> Int64[Tensor, "mask_h mask_w"]:
    """Set pixels of no label to 0.

    Raises:
        InputError: another number fills a square of three by three pixels somewhere.
    """
    for other in sorted(_find_solid_numbers(values) - set(labels)):
        raise InputError(
            f"{path}: {int((values == other).sum())} pixels have the number {other}, which the "
            f"labels do not name; add {other}=OBJECT, or {other}= to leave it out"
        )
    return torch.from_numpy(np.where(np.isin(values, list(labels)), values, 0)).long()


def _find_solid_numbers(values: np.ndarray) -> set[int]:
    """Find the numbers other than 0 that fill a square of three by three pixels somewhere."""
    # Pixels whose eight neighbours have the same number.
    middle = values[1:-1, 1:-1]
    is_solid = middle != 0
    for row, column in np.ndindex(3, 3):
        height, width = middle.shape
        is_solid &= values[row : row + height, column : column + width] == middle
    return {int(number) for number in np.unique(middle[is_solid])}


def number_objects(values: np.ndarray) -> Int64[Tensor, "h w"]:
    """Label the objects of a mask (h, w) of whole numbers by these; one object gets the number 1.

    A number is an object where it fills a square of three by three pixels; the values at the soft
    borders of a mask do not. A mask of more than 64 numbers is one object.
    """
    shown = values[values != 0]
    if len(shown) == 0 or (shown == shown[0]).all():
        return torch.from_numpy(values != 0).long()
    numbers = _find_solid_numbers(values)
    if not 2 <= len(numbers) <= _MOST_LABELS:
        return torch.from_numpy(values != 0).long()
    return torch.from_numpy(np.where(np.isin(values, list(numbers)), values, 0)).long()


def one_mask(labels: Int64[Tensor, "h w"], name: str) -> Bool[Tensor, "h w"]:
    """Turn labels into the mask of their only object.

    Raises:
        InputError: there are several objects.
    """
    numbers = np.unique(labels.cpu().numpy())
    numbers = numbers[numbers != 0]
    if len(numbers) > 1:
        sizes = [f"{k} ({int((labels == k).sum())} px)" for k in numbers.tolist()]
        raise InputError(
            f"{name}: shows {len(numbers)} objects, numbered {', '.join(sizes[:5])}"
            f"{', ...' if len(sizes) > 5 else ''}, where one mask is of one; give that of one "
            "(mask == 1), or take each as an instance (estimate_instances, pose predict)"
        )
    return labels != 0


def decode_rle(counts: tuple[int, ...], height: int, width: int) -> Bool[Tensor, "h w"]:
    """Turn run lengths, column by column and beginning with the background, into a mask.

    Args:
        counts: the run lengths.
        height: rows of the mask.
        width: its columns.
    """
    values = np.arange(len(counts)) % 2 == 1
    flat = np.repeat(values, counts)
    return torch.from_numpy(flat.reshape(width, height).T.copy())


def encode_rle(mask: Bool[Tensor, "h w"]) -> Runs:
    """Turn a mask into run lengths and its size."""
    # A run ends where the next pixel of a column differs.
    flat = mask.cpu().numpy().T.reshape(-1)
    ends = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], ends, [flat.size]])).tolist()
    # The first run is of the background: of no pixel, where the mask starts on the object.
    starts_on_object = flat.size > 0 and bool(flat[0])
    return tuple([0, *runs] if starts_on_object else runs), mask.shape[0], mask.shape[1]


def read_runs(entry: object, source: str) -> Runs:
    """Read and check COCO's run lengths, compressed (text) or not, and their size.

    The entry may also be one that holds them as its ``segmentation``.

    Raises:
        InputError: there are none, or they do not add up to their size.
    """
    # Run lengths, and neither a polygon nor anything else.
    if isinstance(entry, Mapping) and "segmentation" in entry:
        entry = entry["segmentation"]
    what = f"{source}: the segmentation is no run lengths"
    if isinstance(entry, list) and entry:
        raise InputError(
            f"{source}: the segmentation is a polygon; turn it into run lengths by pycocotools "
            "(annToRLE), or draw it into a mask image"
        )
    if not isinstance(entry, Mapping) or "counts" not in entry:
        raise InputError(f'{what}; write {{"size": [height, width], "counts": [...]}}')

    # Their size.
    size = entry.get("size")
    counts = entry["counts"]
    if (
        not isinstance(size, list)
        or len(size) != 2
        or not all(type(v) is int and v > 0 for v in size)
    ):
        raise InputError(f"{what}: its size is {size!r}, where [height, width] belongs")

    # Numbers that add up to it.
    height, width = size
    text = counts.decode("latin-1") if isinstance(counts, bytes) else counts
    runs: Any = _decompress_runs(text, what) if isinstance(text, str) else text
    is_list = isinstance(runs, list) and all(type(v) is int and v >= 0 for v in runs)
    if not is_list or sum(runs) != height * width or height * width > MAX_PIXELS:
        raise InputError(f"{what} of {height}x{width} pixels: they do not add up to it")
    return tuple(runs), height, width


def _decompress_runs(text: str, what: str) -> list[int]:
    """Read COCO's compressed run lengths; ``what`` names them in errors.

    A character holds five bits of a number, the lowest first, and a bit that says whether more
    follow. From the fourth run on the numbers are differences from the last run but one.
    """
    runs: list[int] = []
    value = 0
    shift = 0
    for bits in (ord(character) - 48 for character in text):
        value |= (bits & 0x1F) << shift
        shift += 5
        if shift > _MOST_BITS:
            raise InputError(f"{what}: its text has a number of more than {_MOST_BITS} bits")
        has_more = bits & 0x20
        if has_more:
            continue

        # The last bits of a number say whether it is negative.
        is_negative = bits & 0x10
        if is_negative:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = 0
        shift = 0
    return runs


def mask_box(mask: Bool[Tensor, "h w"]) -> list[int]:
    """Give left, top, width and height of a mask [px]; -1 four times, as BOP, for an empty one."""
    rows, columns = mask.nonzero(as_tuple=True)
    if len(rows) == 0:
        return [-1] * 4
    left = int(columns.min())
    top = int(rows.min())
    return [left, top, int(columns.max()) - left + 1, int(rows.max()) - top + 1]
