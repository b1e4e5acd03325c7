"""Pictures: 8-bit files to RGB tensors and back, and the listing of them."""

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from PIL import Image
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files.disk import (
    AnyPath,
    refused_as,
    refused_suffix,
    write_bytes,
)
from depthpose.core.files.names import natural_order
from depthpose.core.files.shards import read_bytes

LISTED_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Of files that count as pictures where a folder is listed; of a file that is named, any."""
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
    orientation applied, and 16-bit greyscale scaled by 65535.

    Raises:
        InputError: the file is missing, damaged, too large or not a picture.
    """
    with opened_image(path) as image:
        return picture_tensor(image, path)


def picture_tensor(image: Image.Image, name: AnyPath) -> Float32[Tensor, "3 h w"]:
    """Bring a picture of Pillow's to RGB in [0, 1], as :func:`read_image` does a file.

    Raises:
        InputError: it has 32 bits a pixel; Pillow's own errors where its file is damaged.
    """
    turn = _UPRIGHT.get(_orientation(image))
    pixels = _rgb_or_grey(name, image if turn is None else image.transpose(turn))
    if pixels.ndim == 2:
        scale = 65535 if pixels.dtype.itemsize == 2 else 255
        grey = torch.from_numpy(pixels.astype(np.float32)).div_(scale)
        return grey.expand(3, -1, -1).contiguous()
    # Channels are parted while a pixel is a byte: the floats are there once.
    planes = np.ascontiguousarray(pixels.transpose(2, 0, 1))
    return torch.from_numpy(planes.astype(np.float32)).div_(255)


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
    if suffix not in LISTED_SUFFIXES:
        raise refused_suffix(name, "picture", LISTED_SUFFIXES)
    _check_image(name, image)
    pixels = image.detach().cpu().float().clamp(0, 1).mul(255).round().byte().permute(1, 2, 0)
    form, options = (
        ("PNG", FAST_PNG) if suffix == ".png" else ("JPEG", {"quality": quality, "subsampling": 0})
    )
    encoded = BytesIO()
    with refused_as(name, "picture", "check its size"):
        Image.fromarray(pixels.contiguous().numpy()).save(encoded, form, **options)
    return encoded.getvalue()


def list_images(path: AnyPath) -> list[Path]:
    """List pictures: a file itself, the PNG and JPEG files of a folder, or those of a pattern.

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
        found = list(wanted.iterdir()) if wanted.is_dir() else _glob(wanted)
    except (OSError, ValueError, NotImplementedError) as error:
        raise InputError(f"{str(path)!r}: cannot be listed: {error}") from error
    pictures = sorted((p for p in found if _is_listed(p)), key=natural_order)
    if not pictures:
        raise InputError(
            f"{path}: no {', '.join(LISTED_SUFFIXES)} file there; "
            "give a picture, a folder of pictures or a pattern such as 'left/*.png'"
        )
    return pictures


@contextmanager
def opened_image(path: AnyPath) -> Iterator[Image.Image]:
    """Open a picture's header; whatever decoding raises inside the block is an input error.

    Raises:
        InputError: the file is missing, too large, damaged or not a picture.
    """
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


def _check_image(path: AnyPath, image: Tensor) -> None:
    if image.ndim != 3 or image.shape[0] != 3 or image.numel() == 0:
        raise InputError(f"{path}: an image is (3, H, W), got {tuple(image.shape)}; permute it")
    if not image.is_floating_point():
        raise InputError(f"{path}: an image is float in [0, 1], got {image.dtype}; divide by 255")
    if not bool(image.isfinite().all()):
        raise InputError(f"{path}: the image holds NaN or infinity; find out where they come from")
    low, high = (float(v) for v in image.detach().aminmax())
    if low < -0.25 or high > 1.25:
        raise InputError(f"{path}: values {low:g}..{high:g} are outside [0, 1]; divide by 255?")


def _glob(pattern: Path) -> list[Path]:
    relative = pattern.relative_to(pattern.anchor)
    return [p for p in Path(pattern.anchor).glob(str(relative)) if p.is_file()]


def _is_listed(path: Path) -> bool:
    return path.suffix.lower() in LISTED_SUFFIXES and not path.name.startswith(".")
