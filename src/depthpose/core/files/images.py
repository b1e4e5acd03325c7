"""Pictures: 8-bit files to RGB tensors and back, their listing, and the focal length of EXIF."""

import math
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from PIL import Image
from torch import Tensor

from depthpose.core.arrays import check_image
from depthpose.core.errors import InputError, Notice
from depthpose.core.files.disk import (
    AnyPath,
    natural_order,
    refused_as,
    refused_suffix,
    write_bytes,
)
from depthpose.core.files.store import read_bytes

WRITTEN_SUFFIXES = (".png", ".jpg", ".jpeg")  # suffixes of pictures that can be written
LISTED_SUFFIXES = (*WRITTEN_SUFFIXES, ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".pnm", ".webp")
"""Suffixes of pictures in a listed folder; a file that is named may have any."""
FAST_PNG = {"compress_level": 1}
"""Four times faster than zlib's usual 6 and a third larger at most: at 6, writing the pictures of
an estimate took as long as the estimate."""
MAX_PIXELS = 2**25
"""A small file may declare any size; this many pixels are 0.4 GB of floats, before any work."""

# Named one by one: Pillow also opens formats that start other programs.
_FORMATS = ("PNG", "JPEG", "BMP", "PPM", "TIFF", "WEBP", "GIF")
_GREY_16 = ("I;16", "I;16L", "I;16B", "I;16N")
_EXIF_ORIENTATION = 0x0112
_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


def read_image(path: AnyPath) -> Float32[Tensor, "3 h w"]:
    """Read a picture as RGB in [0, 1].

    Greyscale becomes three equal channels, a palette its colours; alpha is dropped, the EXIF
    orientation applied, and 16 bits a channel scaled by ``from_16_bit``.

    Raises:
        InputError: the file is missing, damaged, too large or not a picture.
    """
    with opened_image(path) as image:
        pixels = _decoded(path, image)
    return _tensor_of(pixels, path)


def picture_tensor(image: Image.Image, name: AnyPath) -> Float32[Tensor, "3 h w"]:
    """Bring a picture of Pillow's to RGB in [0, 1], as :func:`read_image` does a file.

    Raises:
        InputError: it has 32 bits a pixel, or its file is damaged.
    """
    with refused_as(name, "picture", "give an intact one"):
        pixels = _decoded(name, image)
    return _tensor_of(pixels, name)


def _decoded(name: AnyPath, image: Image.Image) -> np.ndarray:
    """Give RGB or grey, upright, of 8 or 16 bits."""
    turn = _UPRIGHT.get(_orientation(image))
    deep, low_bytes = _deep_ppm(image), _low_bytes(image)
    if deep is not None:
        return deep
    parts = [image] if low_bytes is None else [image, low_bytes]
    pixels, *low = (
        _rgb_or_grey(name, one if turn is None else one.transpose(turn)) for one in parts
    )
    return pixels.astype(np.uint16) * 256 + low[0] if low else pixels


def _tensor_of(pixels: np.ndarray, name: AnyPath) -> Float32[Tensor, "3 h w"]:
    """Bring pixels to RGB in [0, 1]: apart from decoding, during which warnings are silenced."""
    # Channels are parted while a pixel is an integer: the floats are there once.
    planes = np.ascontiguousarray(pixels[None] if pixels.ndim == 2 else pixels.transpose(2, 0, 1))
    if planes.dtype.itemsize == 2:
        rgb = torch.from_numpy(from_16_bit(planes, name))
    else:
        rgb = torch.from_numpy(planes.astype(np.float32)).div_(255)
    return rgb.expand(3, -1, -1).contiguous()


def from_16_bit(values: np.ndarray, name: AnyPath) -> np.ndarray:
    """Bring 16-bit numbers to floats in [0, 1], and say so where not by 65535.

    Cameras of 10, 12 or 14 bits, and thermal ones, use a part of the range: black and white are
    then what 0.1 % of the values lie below and above; black is 0 unless all lie far from it.
    """
    low, high = value_range(values)
    if not _LEAST_SPAN <= high - low < _FULL_SPAN:
        return values.astype(np.float32) / 65535
    black = low if low > high - low else 0
    if (folder := Path(name).parent) not in _REPORTED:
        _REPORTED.add(folder)
        said = (
            f"{name}: of 16 bits, and its values are {low} to {high}: {black} is taken as black "
            f"and {high} as white; so are those of other pictures there"
        )
        warnings.warn(said, Notice, stacklevel=2)
    return ((values.astype(np.float32) - black) / (high - black)).clip(0, 1)


def value_range(values: np.ndarray) -> tuple[int, int]:
    """Give the values that all but 0.1 % lie above, and below; defective pixels do not count."""
    low, high = np.quantile(values, (0.001, 0.999), method="nearest")
    return int(low), int(high)


_LEAST_SPAN, _FULL_SPAN = 64, 2**14
"""Masks and labels have fewer values than a picture; more than 14 bits are taken for all 16."""


_REPORTED: set[Path] = set()  # folders whose range of values has been reported


def _deep_ppm(image: Image.Image) -> np.ndarray | None:
    """Take a binary PPM of 16 bits a colour, of which Pillow keeps 8."""
    tiles, file = getattr(image, "tile", None), getattr(image, "fp", None)
    if image.format != "PPM" or image.mode != "RGB" or not tiles or file is None:
        return None
    most = tiles[0].args[1] if isinstance(tiles[0].args, tuple) else 255
    if tiles[0].codec_name != "ppm" or most <= 255:
        return None
    file.seek(tiles[0].offset)
    values = np.frombuffer(file.read(6 * image.width * image.height), ">u2")
    whole = values.reshape(image.height, image.width, 3).astype(np.float64)
    return (whole * (65535 / most)).round().clip(0, 65535).astype(np.uint16)


def _low_bytes(image: Image.Image) -> Image.Image | None:
    """Open a picture of 16 bits a colour again, so that it gives the lower bytes."""
    tiles, file = getattr(image, "tile", None), getattr(image, "fp", None)
    if not tiles or file is None:
        return None
    raws = [tile.args if isinstance(tile.args, str) else tile.args[0] for tile in tiles]
    if not all(re.fullmatch("RGBA?;16[BLN]", str(raw)) for raw in raws):
        return None
    at = file.tell()
    file.seek(0)
    other = Image.open(BytesIO(file.read()), formats=_FORMATS)
    file.seek(at)
    is_little = sys.byteorder == "little"
    swapped = [
        raw[:-1] + ("B" if raw[-1] == "L" or (raw[-1] == "N" and is_little) else "L")
        for raw in raws
    ]
    other.tile = [
        tile._replace(args=raw if isinstance(tile.args, str) else (raw, *tile.args[1:]))
        for tile, raw in zip(tiles, swapped, strict=True)
    ]
    return other


def image_size(path: AnyPath) -> tuple[int, int]:
    """Say (width, height) of a picture as :func:`read_image` would return it, without decoding.

    Raises:
        InputError: the file is missing, too large or not a picture.
    """
    with opened_image(path) as image:
        width, height = image.size
        return (height, width) if _orientation(image) in (5, 6, 7, 8) else (width, height)


def write_image(path: AnyPath, image: Tensor) -> None:
    """Write RGB ``(3, h, w)`` in [0, 1] as 8-bit PNG or JPEG, by suffix, rounding to the nearest.

    What resampling overshoots (a quarter of the range at most) is clipped.

    Raises:
        InputError: the shape, the values or the suffix are wrong, or the disk refuses.
    """
    write_bytes(path, encode_image(image, path))


def encode_image(image: Tensor, name: AnyPath, quality: int = 95) -> bytes:
    """Give the bytes that :func:`write_image` writes to a file of this name.

    Args:
        image: see there.
        name: decides the format by its suffix.
        quality: of a JPEG, 1 to 95.

    Raises:
        InputError: the shape, the values or the suffix are wrong.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in WRITTEN_SUFFIXES:
        raise refused_suffix(name, "picture", WRITTEN_SUFFIXES)
    check_image(image, f"{name}: the image", slack=0.25)
    pixels = image.detach().cpu().float().clamp(0, 1).mul(255).round().byte().permute(1, 2, 0)
    form, options = (
        ("PNG", FAST_PNG) if suffix == ".png" else ("JPEG", {"quality": quality, "subsampling": 0})
    )
    encoded = BytesIO()
    with refused_as(name, "picture", "check its size"):
        Image.fromarray(pixels.contiguous().numpy()).save(encoded, form, **options)
    return encoded.getvalue()


def list_images(path: AnyPath) -> list[Path]:
    """List pictures: a file itself, those of a folder by their suffixes, or those of a pattern.

    Args:
        path: a file, a folder or a pattern with ``*``, ``?``, ``[...]`` or ``**``.

    Returns:
        Paths in the order of their names, numbers in them by value; hidden files are left out.

    Raises:
        InputError: nothing was found.
    """
    wanted = Path(path)
    try:
        if wanted.is_file():
            return [wanted]
        if wanted.is_dir():
            files = list(wanted.iterdir())
        else:
            home, parts = Path(wanted.anchor), list(wanted.relative_to(wanted.anchor).parts)
            while len(parts) > 1 and (home / parts[0]).is_dir():  # its brackets are no pattern
                home /= parts.pop(0)
            files = [p for p in home.glob("/".join(parts)) if p.is_file()]
    except (OSError, ValueError, NotImplementedError) as error:
        raise InputError(f"{str(path)!r}: cannot be listed: {error}") from error
    shown = (p for p in files if p.suffix.lower() in LISTED_SUFFIXES and p.name[0] != ".")
    pictures = sorted(shown, key=natural_order)
    if not pictures:
        raise InputError(
            f"{path}: no {', '.join(LISTED_SUFFIXES)} file there; "
            "give a picture, a folder of pictures or a pattern such as 'left/*.png'"
        )
    return pictures


@contextmanager
def opened_image(path: AnyPath) -> Iterator[Image.Image]:
    """Open a picture's header; whatever decoding raises inside the block is an input error."""
    data = read_bytes(path)
    with (
        refused_as(path, "picture", "give an intact PNG or JPEG"),
        Image.open(BytesIO(data), formats=_FORMATS) as image,
    ):
        width, height = image.size
        if width * height > MAX_PIXELS:
            raise InputError(
                f"{path}: declares {width}x{height} pixels, more than the {MAX_PIXELS} allowed; "
                "scale it down"
            )
        yield image


def _orientation(image: Image.Image) -> int:
    # Pillow turns TIFF itself, and would decode a PNG to look for EXIF behind the pixels.
    is_turned = image.format == "TIFF"
    is_hidden = image.format == "PNG" and "exif" not in image.info
    return 1 if is_turned or is_hidden else image.getexif().get(_EXIF_ORIENTATION, 1)


def _rgb_or_grey(path: AnyPath, image: Image.Image) -> np.ndarray:
    if image.mode in _GREY_16:
        return np.asarray(image).astype(np.uint16)
    if image.mode == "I" and image.format == "PPM":  # Pillow scales 16-bit PGM to 65535
        return np.asarray(image).astype(np.uint16)
    if image.mode in ("I", "F"):
        raise InputError(f"{path}: 32 bits a pixel; save it with 8 or 16 bits a channel")
    if image.mode == "P" and "transparency" in image.info:
        image = image.convert("RGBA")
    return np.asarray(image.convert("RGB"))


_EXIF_IFD = 0x8769
_FOCAL_MM, _FOCAL_35MM = 0x920A, 0xA405
_RESOLUTION, _RESOLUTION_UNIT, _PIXELS = 0xA20E, 0xA210, 0xA002
_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""Millimetres of each unit of resolution: inch, centimetre, millimetre, micrometre."""
_DIAGONAL_MM = math.hypot(36, 24)


def read_exif_focal(picture: AnyPath | Image.Image) -> tuple[float, str] | None:
    """Read the focal length of a photograph [px], and by which tags it is known.

    ``FocalLengthIn35mmFilm`` is compared by the diagonal, as CIPA DC-008 defines it; else
    ``FocalLength`` is divided by the width of a pixel on the sensor (``FocalPlaneXResolution``),
    times the ratio of this width and the one that was taken (``PixelXDimension``).

    Returns:
        None where the picture has no such tags, or zeros, which mean unknown.

    Raises:
        InputError: the file is no picture.
    """
    if not isinstance(picture, Image.Image):
        with opened_image(picture) as opened:
            return read_exif_focal(opened)
    if picture.format == "PNG" and "exif" not in picture.info:
        return None
    tags = picture.getexif().get_ifd(_EXIF_IFD)
    film_mm, focal_mm = _positive(tags.get(_FOCAL_35MM)), _positive(tags.get(_FOCAL_MM))
    if film_mm is not None:
        focal_px = film_mm / _DIAGONAL_MM * math.hypot(*picture.size)
        return focal_px, f"FocalLengthIn35mmFilm {film_mm:g} mm"
    per_unit, unit_mm = _positive(tags.get(_RESOLUTION)), _MM.get(tags.get(_RESOLUTION_UNIT, 2))
    if focal_mm is None or per_unit is None or unit_mm is None:
        return None
    taken = _positive(tags.get(_PIXELS)) or max(picture.size)
    # A picture stored turned has the sensor's width along its longer side.
    focal_px = focal_mm * per_unit / unit_mm * max(picture.size) / taken
    return focal_px, f"FocalLength {focal_mm:g} mm, {taken * unit_mm / per_unit:.1f} mm of sensor"


def _positive(value: Any) -> float | None:  # noqa: ANN401  whatever a file holds
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < math.inf else None
