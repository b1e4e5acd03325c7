"""Masks of objects: pictures, and COCO's run lengths."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Int64, Shaped
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files import read_json
from depthpose.core.files.images import MAX_PIXELS, open_image

_MOST_LABELS = 64  # different values of an image of labels; an image of more is a photograph
_HALF = 127  # of 255: values above it are the object, in masks with soft edges
_SOFT = 32  # of 255: values farther than this from black and white are grey
_MOST_BITS = 40  # of a run length in text: no image has as many pixels


class RunLengths(NamedTuple):
    """A mask as COCO holds it: lengths of runs of equal pixels, column by column."""

    counts: tuple[int, ...]  #: the first of the background, which may be 0
    height: int
    width: int


def read_mask(path: Path) -> Bool[Tensor, "mask_h mask_w"]:
    """Read the mask of one object, as :func:`read_labels` reads it.

    Raises:
        InputError: it is missing, no picture, or shows several objects.
    """
    return mask_from_labels(read_labels(path), str(path))


def read_labels(
    path: Path, labels: Collection[int] | None = None
) -> Int64[Tensor, "mask_h mask_w"]:
    """Read a mask file of any kind: 0 where it is black or transparent, a number for each object.

    In a colour picture the numbers are 1, 2, ... in the order of the colours. In a photograph, or a
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
        runs = read_runs(entries[0], str(path))
        return decode_rle(*runs).long()
    pixels = _read_pixels(path, apply_palette=labels is None)

    # Grey is a number already.
    values = pixels[..., 0]
    is_colored = pixels.shape[2] > 1 and (pixels[..., :3] != values[..., None]).any()
    if is_colored:
        values = _number_colors(pixels)

    # An alpha channel is the mask where the opaque pixels have one colour, or too many for labels.
    if pixels.shape[2] == 4:
        is_opaque = pixels[..., 3] > _HALF
        if 0 < is_opaque.sum() < is_opaque.size:
            is_one_object = len(np.unique(values[is_opaque])) not in range(2, _MOST_LABELS)
            values = np.where(is_opaque, 1 if is_one_object else values, 0)
    return number_objects(values) if labels is None else _keep_labels(values, labels, path)


def _number_colors(pixels: np.ndarray) -> np.ndarray:
    """Number the colours of pixels (h, w, 3 or more): 1, 2, ... in their order; black stays 0."""
    red, green, blue = (pixels[..., channel].astype(np.int32) for channel in range(3))
    color = (red * 2**8 + green) * 2**8 + blue
    colors = np.unique(color)
    has_black = colors[0] == 0
    # Not by the inverse of np.unique, which takes five times the memory.
    place = np.searchsorted(colors, color).astype(np.int32)
    return place if has_black else place + 1


def _read_pixels(path: Path, *, apply_palette: bool) -> np.ndarray:
    """Read the pixels of a mask image (h, w, channels), without loss of a bit.

    A grey image has one channel of numbers, a colour image three. One with transparency has four:
    its colours, or its number three times, and alpha. A JPEG becomes black and white.

    Args:
        path: the image.
        apply_palette: read the colours of an image with a palette, not its indices. If the palette
            has a transparent colour, the colours are always read.

    Raises:
        InputError: the image cannot be read, or is a JPEG of more grey than white.
    """
    with open_image(path) as image:
        has_transparency = "transparency" in image.info  # a value, or alpha of a palette
        if image.mode == "I" or image.mode.startswith("I;16"):
            # Numbers of more than 8 bits, which Pillow's conversion to colours would clip.
            numbers = np.asarray(image).astype(np.int32)
            pixels = numbers[..., None]
            if has_transparency:
                alpha = np.where(numbers == image.info["transparency"], 0, 255)
                pixels = np.stack([numbers, numbers, numbers, alpha], -1)
        elif image.mode in ("LA", "PA", "RGBA", "RGBa", "La") or has_transparency:
            # Colours and alpha.
            pixels = np.asarray(image.convert("RGBA"))
        elif image.mode in ("1", "L") or (image.mode == "P" and not apply_palette):
            # Numbers of up to 8 bits, or indices of a palette.
            pixels = np.asarray(image).astype(np.int32)[..., None]
        elif image.mode == "F":
            # Numbers or probabilities, from a file of floats.
            values = torch.from_numpy(np.array(image))
            pixels = object_numbers(values, str(path)).numpy()[..., None]
        else:
            # Colours, also those of a palette.
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


def object_numbers(values: Shaped[Tensor, "h w"], name: str) -> Int64[Tensor, "h w"]:
    """Convert the numbers of a mask to whole ones; fractions are probabilities of an object.

    Those above a half are the object, 1; other pixels are 0.

    Args:
        values: whole numbers, or fractions in [0, 1].
        name: of the mask, in errors.

    Raises:
        InputError: there are other fractions, or NaN.
    """
    is_whole = not values.is_floating_point() or bool((values % 1 == 0).all())
    if is_whole:
        return values.long()
    if not bool(((values >= 0) & (values <= 1)).all()):
        raise InputError(
            f"{name}: the mask holds fractions outside [0, 1], or NaN; give True and False "
            "(logits > 0), whole numbers of objects, or probabilities"
        )
    return (values > 0.5).long()


def _keep_labels(
    values: np.ndarray, labels: Collection[int], path: Path
) -> Int64[Tensor, "mask_h mask_w"]:
    """Keep the numbers of a mask that are labels, and set other pixels to 0.

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
    """Keep the numbers of a mask (h, w) that are objects, 0 elsewhere; a single object becomes 1.

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


def mask_from_labels(labels: Int64[Tensor, "h w"], name: str) -> Bool[Tensor, "h w"]:
    """Convert labels to the mask of their only object; ``name`` is that of the mask, in errors.

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
    """Convert run lengths to a mask; the arguments are those of ``RunLengths``."""
    is_object = np.arange(len(counts)) % 2 == 1  # every other run
    flat = np.repeat(is_object, counts)
    return torch.from_numpy(flat.reshape(width, height).T.copy())


def encode_rle(mask: Bool[Tensor, "h w"]) -> RunLengths:
    """Convert a mask to run lengths."""
    # A run ends where the next pixel of a column differs.
    flat = mask.cpu().numpy().T.reshape(-1)
    ends = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], ends, [flat.size]])).tolist()
    # The first run is of the background: of no pixel, where the mask starts on the object.
    starts_on_object = flat.size > 0 and bool(flat[0])
    counts = tuple([0, *runs] if starts_on_object else runs)
    return RunLengths(counts, height=mask.shape[0], width=mask.shape[1])


def read_runs(entry: object, source: str) -> RunLengths:
    """Read and check COCO's run lengths, compressed (text) or not.

    The entry may also be one that holds them as its ``segmentation``. ``source`` names it in
    errors.

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
    sides = size if isinstance(size, list) else []
    if len(sides) != 2 or not all(type(side) is int and side > 0 for side in sides):
        raise InputError(f"{what}: its size is {size!r}, where [height, width] belongs")

    # Numbers that add up to it.
    height, width = sides
    counts: Any = entry["counts"]
    if isinstance(counts, bytes):
        counts = counts.decode("latin-1")
    if isinstance(counts, str):
        counts = _decompress_counts(counts, what)
    is_list = isinstance(counts, list) and all(type(n) is int and n >= 0 for n in counts)
    if not is_list or sum(counts) != height * width or height * width > MAX_PIXELS:
        raise InputError(f"{what} of {height}x{width} pixels: they do not add up to it")
    return RunLengths(tuple(counts), height=height, width=width)


def _decompress_counts(text: str, what: str) -> list[int]:
    """Decode COCO's compressed run lengths; ``what`` begins an error.

    A character holds five bits of a number, the lowest first, and a bit that says whether more
    follow. From the fourth run on the numbers are differences from the last run but one.
    """
    counts: list[int] = []
    value = 0
    shift = 0
    for character in text:
        bits = ord(character) - ord("0")
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
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        value = 0
        shift = 0
    return counts


def find_mask_box(mask: Bool[Tensor, "h w"]) -> list[int]:
    """Find the box about a mask: left, top, width and height [px]; -1 four times if it is empty."""
    rows, columns = mask.nonzero(as_tuple=True)
    if len(rows) == 0:
        return [-1] * 4
    left = int(columns.min())
    top = int(rows.min())
    return [left, top, int(columns.max()) - left + 1, int(rows.max()) - top + 1]
