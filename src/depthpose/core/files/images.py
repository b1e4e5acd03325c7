"""Reading and writing of pictures, and of maps: NPY, PFM, and depth in 16-bit PNG."""

import math
import re
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
import torch
from jaxtyping import Float, Float32, Shaped
from PIL import Image
from torch import Tensor

from depthpose.core.errors import InputError, Notice
from depthpose.core.files.disk import (
    AnyPath,
    make_suffix_error,
    natural_sort_key,
    read_bytes,
    refused_as,
    write_bytes,
)

WRITTEN_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Suffixes of pictures that can be written."""
LISTED_SUFFIXES = (
    *WRITTEN_SUFFIXES, ".jpe", ".jfif", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".pnm", ".pbm",
    ".gif", ".apng", ".webp",
)  # fmt: skip
"""Suffixes of pictures in a listed folder; a file that is named may have any."""
_UNREAD = re.compile(
    r"\.(heic|heif|avif|jp2|j2k|jxl|tga|dib|exr|hdr|dng|cr[23w]|nef|arw|orf|rw2|raw|pfm|svg|psd"
    r"|mpo|jps)",
    re.IGNORECASE,
)
"""Suffixes of pictures that are not read; a notice names those in a folder."""
_ARCHIVES = (".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".lz4", ".zip", ".7z", ".rar")
"""Suffixes of archives, which are no pictures whatever they hold."""
FAST_PNG = {"compress_level": 1}
"""Four times faster than zlib's usual 6 and a third larger at most: at 6, writing the pictures of
an estimate took as long as the estimate."""
MAX_PIXELS = 2**25  # 0.4 GB of floats; a small file may declare any size

# Named one by one: Pillow also opens formats that start other programs.
_FORMATS = ("PNG", "JPEG", "BMP", "PPM", "TIFF", "WEBP", "GIF")
_JPEG_COLORS = {"RGB": "RGB", "L": "GRAY"}
"""Names of simplejpeg's colour spaces, by Pillow's modes."""
_HOLE = bytes(16)
"""Zeros that show a damaged JPEG: 2,600 pictures of all qualities have no more than 6 in a row."""
_NEXT_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
"""The marker at which a JPEG's compressed pixels end."""
# Markers of JPEG.
_FILL = 0xFF  # padding before a marker
_PROGRESSIVE = 0xC2  # start of a progressive frame
_HUFFMAN_TABLES = 0xC4
_START_OF_SCAN = 0xDA

_GREY_16_MODES = ("I;16", "I;16L", "I;16B", "I;16N")
_EXIF_ORIENTATION = 0x0112
_PHOTOMETRIC = 0x0106  # tag of TIFF: 0 where the value 0 is white
_SIDEWAYS = (5, 6, 7, 8)  # EXIF orientations that exchange width and height
# How Pillow turns a picture upright, by its EXIF orientation.
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

    Greyscale becomes three equal channels, a palette its colours. Alpha is dropped, the EXIF
    orientation applied, and 16 bits a channel are scaled by ``scale_16_bit``. Of several
    pictures in one file the first is read, with a notice.

    Raises:
        InputError: the file is missing, damaged, too large, not a picture, or holds both views of a
            stereo camera.
    """
    with open_image(path) as image:
        pixels = _decode(path, image)
        # Further pictures of an MPO are previews and the like: two views are refused above.
        count = getattr(image, "n_frames", 1) if image.format != "MPO" else 1
    if count > 1 and _is_first_notice(path, "several"):
        message = (
            f"{path}: holds {count} pictures, of which the first is read (so it is of other files "
            "there); save each in a file of its own to have them all"
        )
        warnings.warn(message, Notice, stacklevel=2)
    return _make_rgb_tensor(pixels, path)


def rgb_from_pillow(image: Image.Image, name: AnyPath) -> Float32[Tensor, "3 h w"]:
    """Convert a picture of Pillow's to RGB in [0, 1], as :func:`read_image` does a file.

    Raises:
        InputError: it has 32 bits a pixel, or its file is damaged.
    """
    with refused_as(name, "picture", "give an intact one"):
        pixels = _decode(name, image)
    return _make_rgb_tensor(pixels, name)


def _decode(name: AnyPath, image: Image.Image) -> np.ndarray:
    """Decode a picture of Pillow's to RGB or grey, of 8 or 16 bits, turned upright by EXIF.

    Pillow keeps only 8 bits of colours of 16 bits, and does not report damaged JPEGs: these formats
    are decoded in other ways.
    """
    rotation = _UPRIGHT.get(_read_orientation(image))
    opened: Any = image  # a picture that is not of a file has neither ``fp`` nor ``tile``
    is_of_file = getattr(image, "fp", None) is not None
    tiles = (getattr(image, "tile", None) or []) if is_of_file else []
    raw_modes = [tile.args if isinstance(tile.args, str) else tile.args[0] for tile in tiles]

    # Colours of 16 bits: Pillow reads the upper bytes, and of exchanged bytes the lower ones.
    if raw_modes and all(re.fullmatch("RGBA?;16[BLN]", str(mode)) for mode in raw_modes):
        lower = _open_with_bytes_exchanged(opened, raw_modes)
        upper_bytes, lower_bytes = (
            _turn_upright(name, part, rotation).astype(np.uint16) for part in (image, lower)
        )
        return upper_bytes * 256 + lower_bytes

    is_binary_ppm = image.format == "PPM" and image.mode == "RGB" and raw_modes
    if is_binary_ppm and tiles[0].codec_name == "ppm":
        # Pillow keeps the largest value of a colour, unless it is 255.
        largest = tiles[0].args[1] if isinstance(tiles[0].args, tuple) else 255
        if largest > 255:
            return _decode_ppm_16(opened, tiles[0].offset, largest)

    if tiles and image.format == "JPEG" and image.mode in _JPEG_COLORS:
        opened.fp.seek(0)
        image = _decode_jpeg(name, opened.fp.read(), _JPEG_COLORS[image.mode])
        return _turn_upright(name, image, rotation)
    return _turn_upright(name, image, rotation)


def _open_with_bytes_exchanged(image: Any, raw_modes: list[str]) -> Image.Image:  # noqa: ANN401
    """Open a picture of 16 bits a colour again, so that Pillow keeps the lower byte of each colour.

    Pillow keeps the upper byte in the byte order of ``raw_modes``, which is exchanged here.
    """
    position = image.fp.tell()
    image.fp.seek(0)
    opened_again: Any = Image.open(BytesIO(image.fp.read()), formats=_FORMATS)
    image.fp.seek(position)

    little_endian = "LN" if sys.byteorder == "little" else "L"  # N: the machine's own order
    tiles: list[Any] = []
    for tile, mode in zip(image.tile, raw_modes, strict=True):
        exchanged = mode[:-1] + ("B" if mode[-1] in little_endian else "L")
        args = exchanged if isinstance(tile.args, str) else (exchanged, *tile.args[1:])
        tiles.append(tile._replace(args=args))
    opened_again.tile = tiles
    return opened_again


def _decode_ppm_16(image: Any, offset: int, largest: int) -> np.ndarray:  # noqa: ANN401
    """Decode a binary PPM of two bytes a colour, from ``offset``; ``largest`` becomes 65535."""
    image.fp.seek(offset)
    pixel_bytes = 6  # three colours of two bytes
    body = image.fp.read(pixel_bytes * image.width * image.height)
    values = np.frombuffer(body, ">u2")
    pixels = values.reshape(image.height, image.width, 3).astype(np.float64)
    return (pixels * (65535 / largest)).round().clip(0, 65535).astype(np.uint16)


def _turn_upright(
    name: AnyPath, image: Image.Image, rotation: Image.Transpose | None
) -> np.ndarray:
    """Turn a picture of Pillow's by ``rotation``; return its pixels as RGB, or grey of 16 bits."""
    picture = image if rotation is None else image.transpose(rotation)
    # Pillow scales 16-bit PGM to 65535.
    if picture.mode in _GREY_16_MODES or (picture.mode == "I" and image.format == "PPM"):
        values = np.asarray(picture).astype(np.uint16)
        tiff: Any = image
        # Where white is 0, grey is inverted; of 8 bits Pillow does this itself.
        is_inverted = image.format == "TIFF" and tiff.tag_v2.get(_PHOTOMETRIC) == 0
        return 65535 - values if is_inverted else values
    if picture.mode in ("I", "F"):
        raise InputError(f"{name}: 32 bits a pixel; save it with 8 or 16 bits a channel")
    if picture.mode == "P" and "transparency" in picture.info:
        picture = picture.convert("RGBA")
    return np.asarray(picture.convert("RGB"))


def _decode_jpeg(name: AnyPath, data: bytes, color_space: str) -> Image.Image:
    """Decode a JPEG with libjpeg, as Pillow does, and refuse damaged pixels.

    libjpeg only warns of these, and goes on with shifted, wrong or grey ones; Pillow does not pass
    its warnings on.

    Args:
        name: the file, for errors.
        data: its bytes.
        color_space: simplejpeg's name of it.
    """
    try:
        pixels = simplejpeg.decode_jpeg(data, color_space, strict=True).squeeze()
    except ValueError as error:
        raise _make_jpeg_error(name, str(error)) from error
    if _has_hole(data):
        raise _make_jpeg_error(name, "zeros in place of compressed pixels")
    return Image.fromarray(pixels)


def _make_jpeg_error(name: AnyPath, reason: str) -> InputError:
    """Make the error of a JPEG whose pixels are damaged."""
    return InputError(
        f"{name}: a damaged JPEG ({reason}), whose pixels are wrong from there on; copy it anew, "
        "or save it again where it looks whole"
    )


def _has_hole(data: bytes) -> bool:
    """Whether zeros stand in place of compressed pixels of a JPEG, as after an incomplete copy.

    Zeros are the first code of a Huffman table. Where that is a coefficient of 1, sixteen bytes of
    them are forty such coefficients in a row, which no picture has. Where it ends a block, as in
    progressive files, zeros are a plain surface, and damage cannot be told from it.
    """
    if _HOLE not in data:
        return False
    first_symbols: dict[int, int] = {}  # the symbol of the first code of each Huffman table
    position = 2
    while data[position : position + 1] == b"\xff" and position + 4 < len(data):
        marker = data[position + 1]
        if marker == _FILL:
            position += 1
            continue
        end = position + 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        segment = data[position + 4 : end]
        if marker == _PROGRESSIVE:
            return False
        if marker == _HUFFMAN_TABLES:
            while len(segment) > 17:  # a table: its number, 16 counts of codes, the symbols
                first_symbols[segment[0]] = segment[17]
                segment = segment[17 + sum(segment[1:17]) :]
        if marker == _START_OF_SCAN and len(segment) > 2:
            # Tables of coefficients begin at 16. The low four bits of the third byte name that of
            # the first component, and those of a symbol are the coefficient's size: 0 ends a block.
            table = 16 + (segment[2] & 15)
            is_coefficient = first_symbols.get(table, 0) & 15 > 0
            next_marker = _NEXT_MARKER.search(data, end)
            compressed = data[end : next_marker.start() if next_marker else None]
            return is_coefficient and _HOLE in compressed
        position = end
    return False


def _make_rgb_tensor(pixels: np.ndarray, name: AnyPath) -> Float32[Tensor, "3 h w"]:
    """Convert decoded pixels to RGB in [0, 1].

    Not done while decoding, where warnings are silenced: this may warn of the range of 16 bits.
    """
    # Channels are separated while a pixel is an integer, so that the floats exist only once.
    planes = np.ascontiguousarray(pixels[None] if pixels.ndim == 2 else pixels.transpose(2, 0, 1))
    if planes.dtype.itemsize == 2:
        rgb = torch.from_numpy(scale_16_bit(planes, name))
    else:
        rgb = torch.from_numpy(planes.astype(np.float32)).div_(255)
    return rgb.expand(3, -1, -1).contiguous()


def scale_16_bit(values: np.ndarray, name: AnyPath) -> np.ndarray:
    """Scale 16-bit values to floats in [0, 1]: by 65535, or by the part of the range in use.

    Cameras of 10, 12 or 14 bits, and thermal ones, use a part of it. White is then the value that
    only 0.1 % exceed, and black 0, or the value that only 0.1 % fall below if all lie far above 0.

    Warns:
        Notice: black or white is another value than 0 and 65535; once for a folder.
    """
    low, high = find_value_range(values)
    if not _LEAST_SPAN <= high - low < _FULL_SPAN:
        return values.astype(np.float32) / 65535
    black = low if low > high - low else 0
    if _is_first_notice(name, "range"):
        message = (
            f"{name}: of 16 bits, and its values are {low} to {high}: {black} is taken as black "
            f"and {high} as white; so are those of other pictures there"
        )
        warnings.warn(message, Notice, stacklevel=2)
    return ((values.astype(np.float32) - black) / (high - black)).clip(0, 1)


def check_image(image: object, name: str, slack: float = 0.5) -> Float[Tensor, "3 h w"]:
    """Check that a tensor is an RGB image, and return it.

    Args:
        image: the tensor.
        name: what errors call it.
        slack: by how much its values may lie beyond [0, 1], as interpolation overshoots; the values
            of 8 bits, or normalised to a mean of 0, usually lie farther out.

    Raises:
        InputError: it is not a float tensor (3, h, w), is empty, not finite, or out of range.
    """
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
    low = float(image.min())
    high = float(image.max())
    if low < -slack or high > 1 + slack:
        raise InputError(
            f"{name} must lie in [0, 1], got {low:.4g} .. {high:.4g}; divide 8-bit values by 255, "
            f"and do not normalise: the network does"
        )
    return image


def find_value_range(values: np.ndarray) -> tuple[int, int]:
    """Find the 0.1st and the 99.9th percentile of values: values beyond may be defects."""
    low, high = np.quantile(values, (0.001, 0.999), method="nearest")
    return int(low), int(high)


_LEAST_SPAN = 64  # difference of the brightest and the darkest value; a mask's is smaller
_FULL_SPAN = 2**14  # a larger difference is taken for the full range of 16 bits
_NOTICED: set[tuple[Path, str]] = set()  # folders, and topics of notices about their files


def _is_first_notice(name: AnyPath, topic: str) -> bool:
    """Whether this is the first notice on a topic about the files of a folder; it is remembered."""
    key = Path(name).parent, topic
    is_first = key not in _NOTICED
    _NOTICED.add(key)
    return is_first


def image_size(path: AnyPath) -> tuple[int, int]:
    """Read (width, height) of a picture, as :func:`read_image` returns it, without decoding it.

    Raises:
        InputError: the file is missing, too large or not a picture.
    """
    with open_image(path) as image:
        width, height = image.size
        return (height, width) if _read_orientation(image) in _SIDEWAYS else (width, height)


def write_image(path: AnyPath, image: Tensor) -> None:
    """Write RGB ``(3, h, w)`` in [0, 1] as 8-bit PNG or JPEG, by suffix, rounding to the nearest.

    Values beyond [0, 1], as resampling makes them, are clipped: by a quarter of the range at most.

    Raises:
        InputError: the shape, the values or the suffix are wrong, or the disk refuses.
    """
    write_bytes(path, encode_image(image, path))


def encode_image(image: Tensor, name: AnyPath, quality: int = 95) -> bytes:
    """Encode an image as PNG or JPEG, as :func:`write_image` writes it to a file of this name.

    Args:
        image: RGB ``(3, h, w)`` in [0, 1].
        name: its suffix decides the format.
        quality: quality of a JPEG, 1 to 95.

    Raises:
        InputError: the shape, the values or the suffix are wrong.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in WRITTEN_SUFFIXES:
        raise make_suffix_error(name, "picture", WRITTEN_SUFFIXES)
    check_image(image, f"{name}: the image", slack=0.25)
    pixels = image.detach().cpu().float().clamp(0, 1).mul(255).round().byte().permute(1, 2, 0)
    format_name = "PNG"
    options = FAST_PNG
    if suffix != ".png":
        format_name = "JPEG"
        options = {"quality": quality, "subsampling": 0}  # 0: colours at full resolution
    encoded = BytesIO()
    with refused_as(name, "picture", "check its size"):
        Image.fromarray(pixels.contiguous().numpy()).save(encoded, format_name, **options)
    return encoded.getvalue()


def list_images(path: AnyPath) -> list[Path]:
    """List pictures: a single file, those of a folder by their suffixes, or those of a pattern.

    Args:
        path: a file, a folder or a pattern with ``*``, ``?``, ``[...]`` or ``**``.

    Returns:
        Paths in the order of their names, numbers in them by value; hidden files are left out.

    Raises:
        InputError: nothing was found.
    """
    named = Path(path)
    try:
        if named.is_file() and named.suffix.lower() not in _ARCHIVES:
            return [named]
        files = list(named.iterdir()) if named.is_dir() else _glob_files(named)
    except (OSError, ValueError, NotImplementedError) as error:
        raise InputError(f"{str(path)!r}: cannot be listed: {error}") from error
    visible = [file for file in files if file.name[0] != "."]
    pictures = [file for file in visible if file.suffix.lower() in LISTED_SUFFIXES]
    pictures.sort(key=natural_sort_key)
    unread = [file.name for file in visible if _UNREAD.fullmatch(file.suffix)]
    if unread and pictures:
        message = f"{path}: {len(unread)} files are left out, {min(unread)} first: save them as PNG"
        warnings.warn(message, Notice, stacklevel=2)
    if not pictures:
        remedy = "give a picture, a folder of pictures or a pattern such as 'left/*.png'"
        if any(file.suffix.lower() in _ARCHIVES for file in files):
            remedy = "unpack the archive (with --engine ray, .tar and .tar.gz are read)"
        raise InputError(f"{path}: no {', '.join(LISTED_SUFFIXES)} file there; {remedy}")
    return pictures


def _glob_files(pattern: Path) -> list[Path]:
    """List the files that match a pattern, in which names of existing folders stand as they are."""
    folder = Path(pattern.anchor)
    parts = list(pattern.relative_to(pattern.anchor).parts)
    while len(parts) > 1 and (folder / parts[0]).is_dir():
        folder /= parts.pop(0)
    return [path for path in folder.glob("/".join(parts)) if path.is_file()]


def refuse_among_inputs(out: Path, words: Iterable[str | Path], files: Iterable[Path]) -> None:
    """Refuse to write results beside the inputs: the next run would read them as inputs.

    Args:
        out: folder of the results.
        words: files, folders or patterns, as the user named them.
        files: the files that these words stand for.

    Raises:
        InputError: ``out`` holds such files, and they were not named one by one.
    """
    named = {Path(word) for word in words}
    if any(path not in named and path.parent.resolve() == out.resolve() for path in files):
        raise InputError(
            f"--out {out}: the inputs lie there, and a second run would take the results for "
            "inputs too; choose a folder of their own"
        )


def read_views(path: AnyPath) -> list[Float32[Tensor, "3 _ _"]]:
    """Read all views of a picture file, RGB in [0, 1]: two of an MPO of a stereo camera, else one.

    Raises:
        InputError: the file is missing, damaged, too large or not a picture.
    """
    with open_image(path, with_views=True) as image:
        pixels = [_decode(path, image)]
        if image.format == "MPO":
            image.seek(1)
            pixels.append(_decode(path, image))
    return [_make_rgb_tensor(view, path) for view in pixels]


@contextmanager
def open_image(path: AnyPath, *, with_views: bool = False) -> Iterator[Image.Image]:
    """Open a picture, decoding only its header; errors inside the block become :class:`InputError`.

    Files that hold both views of a stereo camera are refused, unless ``with_views``.
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
        if not with_views:
            _refuse_two_views(path, image)
        yield image


def _refuse_two_views(path: AnyPath, image: Image.Image) -> None:
    """Refuse the formats of stereo cameras, which hold both views in one file."""
    file_name = Path(path).name
    segments = getattr(image, "applist", ())  # of a JPEG
    has_jps_segment = any(
        segment_name == "APP3" and b"_JPSJPS_" in data for segment_name, data in segments
    )
    layout = ""
    if has_jps_segment or file_name.lower().endswith(".jps"):
        layout = "JPS, side by side"
    elif image.format == "MPO":
        # Telephones keep smaller pictures in an MPO, such as gain maps; a second view is as large
        # as the first.
        frames: Any = image
        first_size = image.size
        other_sizes = []
        for frame in range(1, frames.n_frames):
            frames.seek(frame)
            other_sizes.append(frames.size)
        frames.seek(0)
        if first_size in other_sizes:
            layout = "MPO, one after the other"

    if layout:
        raise InputError(
            f"{path}: holds both views of a stereo camera ({layout}); "
            f"'depthpose data split {file_name} --out DIR' parts them, and 'depthpose depth match' "
            "takes the two"
        )


def _read_orientation(image: Image.Image) -> int:
    """Read the EXIF orientation that is still to be applied, 1 (upright) to 8."""
    is_turned_by_pillow = image.format == "TIFF"
    if is_turned_by_pillow or _has_hidden_exif(image):
        return 1
    return image.getexif().get(_EXIF_ORIENTATION, 1)


def _has_hidden_exif(image: Image.Image) -> bool:
    """Whether EXIF can only follow the pixels of a PNG, which Pillow would have to decode first."""
    return image.format == "PNG" and "exif" not in image.info


# Tags of EXIF.
_EXIF_IFD = 0x8769
_FOCAL_MM = 0x920A  # FocalLength
_FOCAL_35MM = 0xA405  # FocalLengthIn35mmFilm
_RESOLUTION = 0xA20E  # FocalPlaneXResolution
_RESOLUTION_UNIT = 0xA210  # FocalPlaneResolutionUnit
_TAKEN_WIDTH = 0xA002  # PixelXDimension
_TAKEN_HEIGHT = 0xA003  # PixelYDimension
_SAME_ASPECT = 1.02  # ratio of aspects of one picture: scaling rounds sizes, cameras cut some rows
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # TIFF's units: inch, cm, mm, micrometre
_FILM_DIAGONAL_MM = math.hypot(36, 24)


def read_exif_focal(picture: AnyPath | Image.Image) -> tuple[float, str] | None:
    """Read the focal length of a photograph [px] from EXIF.

    ``FocalLengthIn35mmFilm`` is scaled by the diagonal, as CIPA DC-008 defines it. Without it,
    ``FocalLength`` is divided by the width of a pixel on the sensor (``FocalPlaneXResolution``),
    and scaled by the ratio of this width to the one that was taken (``PixelXDimension``).

    Returns:
        The focal length [px], and a text that names its tags. None where the picture has no such
        tags, or zeros, which mean unknown; and, with a notice, where they are of a picture of
        another aspect, from which this one was cropped.

    Raises:
        InputError: the file is no picture.
    """
    if isinstance(picture, Image.Image):
        focal, doubt = _read_exif_tags(picture)
    else:
        with open_image(picture) as opened:
            focal, doubt = _read_exif_tags(opened)
    if doubt:
        warnings.warn(doubt, Notice, stacklevel=2)
    return focal


def _read_exif_tags(picture: Image.Image) -> tuple[tuple[float, str] | None, str]:
    """Read what :func:`read_exif_focal` returns, and its notice: "" where there is none."""
    if _has_hidden_exif(picture):
        return None, ""
    tags = picture.getexif().get_ifd(_EXIF_IFD)
    film_mm = _read_positive_number(tags.get(_FOCAL_35MM))
    focal_mm = _read_positive_number(tags.get(_FOCAL_MM))

    # A crop has another aspect than the picture that was taken.
    taken_width = _read_positive_number(tags.get(_TAKEN_WIDTH))
    taken_height = _read_positive_number(tags.get(_TAKEN_HEIGHT))
    if (film_mm or focal_mm) and taken_width and taken_height:
        taken_aspect = max(taken_width, taken_height) / min(taken_width, taken_height)
        aspect = max(picture.size) / min(picture.size)
        if not 1 / _SAME_ASPECT < taken_aspect / aspect < _SAME_ASPECT:
            doubt = (
                f"EXIF of a picture of {taken_width:g}x{taken_height:g}, and this one is "
                f"{picture.size[0]}x{picture.size[1]}, cut from it: the focal length there is not "
                "that of this one"
            )
            return None, doubt

    # By the diagonal of 35 mm film, or else by the pixels of the sensor in a unit of length.
    if film_mm is not None:
        focal_px = film_mm / _FILM_DIAGONAL_MM * math.hypot(*picture.size)
        return (focal_px, f"FocalLengthIn35mmFilm {film_mm:g} mm"), ""
    pixels_per_unit = _read_positive_number(tags.get(_RESOLUTION))
    unit_mm = _UNIT_MM.get(tags.get(_RESOLUTION_UNIT, 2))  # inches where no unit is named
    if focal_mm is None or pixels_per_unit is None or unit_mm is None:
        return None, ""
    # The longer side, because a picture may be stored turned.
    sensor_px = taken_width or max(picture.size)
    focal_px = focal_mm * pixels_per_unit / unit_mm * max(picture.size) / sensor_px
    sensor_mm = sensor_px * unit_mm / pixels_per_unit
    return (focal_px, f"FocalLength {focal_mm:g} mm, {sensor_mm:.1f} mm of sensor"), ""


def _read_positive_number(value: Any) -> float | None:  # noqa: ANN401  whatever a file holds
    """Convert a value of EXIF to a positive finite number; None where it is none."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < math.inf else None


MAP_SUFFIXES = (".npy", ".pfm")
"""Suffixes of files that hold a map of floats."""
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", *MAP_SUFFIXES)
"""Suffixes of depth images of a sensor."""
# Readers of NPY headers, by version.
_HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_MAX_DIMENSIONS = 8  # most axes of an array
_MAX_VALUES = 2**26  # most numbers of an array
_PFM_HEADER = re.compile(
    rb"P([fF])\s+(\d{1,9})\s+(\d{1,9})\s+([-+]?[0-9.]{1,32}(?:[eE][-+]?\d{1,3})?)(?:\r\n|\s)"
)


def read_map(path: AnyPath) -> Float32[Tensor, "h w"]:
    """Read a map from ``.npy`` (float16, 32 or 64) or one-channel ``.pfm``; NaN where invalid.

    A PFM file marks invalid pixels by infinity, as Middlebury's do; the magnitude of its scale
    is not applied. An NPY file marks them by NaN and may not hold infinity.

    Raises:
        InputError: the file is missing, damaged, of another type or shape, or holds infinity.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".pfm":
        return torch.from_numpy(_read_pfm(path))
    if suffix != ".npy":
        raise make_suffix_error(path, "map", MAP_SUFFIXES)
    array = read_npy(path)
    if array.ndim != 2 or array.size == 0:
        raise InputError(f"{path}: a map is (H, W), got {array.shape}; save one channel alone")
    if np.isinf(array).any():
        raise InputError(f"{path}: holds infinity; mark invalid pixels by NaN")
    return torch.from_numpy(array)


def _read_pfm(path: AnyPath) -> np.ndarray:
    """Read a one-channel PFM file as (h, w), NaN where a value is not finite."""
    data = read_bytes(path)
    header = _PFM_HEADER.match(data)
    if header is None:
        raise InputError(f"{path}: no PFM header ('Pf', width, height, scale); is it a PFM file?")
    if header[1] == b"F":
        raise InputError(f"{path}: a colour PFM (PF), not a map; save one channel (Pf)")
    width = int(header[2])
    height = int(header[3])
    body = memoryview(data)[header.end() :]
    if width * height == 0 or width * height * 4 != len(body):
        raise InputError(
            f"{path}: declares {width}x{height} floats but {len(body)} bytes follow; it is "
            "truncated or damaged, save it again"
        )
    with refused_as(path, "PFM scale", "it must be a number other than 0"):
        scale = float(header[4])
    if scale == 0 or not math.isfinite(scale):
        raise InputError(f"{path}: PFM scale {scale}; its sign gives the byte order, so not 0")
    # The first row of the file is the lowest of the map.
    rows_upwards = np.frombuffer(body, "<f4" if scale < 0 else ">f4").reshape(height, width)
    array = to_float32(rows_upwards[::-1])
    array[~np.isfinite(array)] = np.nan
    return array


def write_map(path: AnyPath, map: Float[Tensor, "h w"]) -> None:
    """Write a map as float32 ``.npy`` (NaN: invalid) or ``.pfm`` (infinity: invalid).

    Raises:
        InputError: the map is empty or holds infinity, the suffix is another, the disk refuses.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in MAP_SUFFIXES:
        raise make_suffix_error(path, "map", MAP_SUFFIXES)
    array = map.detach().cpu().float().contiguous().numpy()
    if array.size == 0 or np.isinf(array).any():
        raise InputError(f"{path}: the map is empty or holds infinity; mark invalid pixels by NaN")
    if suffix == ".npy":
        encoded = BytesIO()
        np.save(encoded, array, allow_pickle=False)
        write_bytes(path, encoded.getvalue())
    else:
        height, width = array.shape
        rows = np.where(np.isnan(array), np.inf, array)[::-1].astype("<f4")
        write_bytes(path, f"Pf\n{width} {height}\n-1.0\n".encode() + rows.tobytes())


def read_npy(path: AnyPath) -> np.ndarray:
    """Read a float array of any shape from ``.npy`` as float32; pickled objects are refused.

    Raises:
        InputError: the file is missing or damaged, or holds other things than floats.
    """
    array = read_numbers(path)
    if array.dtype.kind != "f":
        raise InputError(
            f"{path}: holds {array.dtype}, not float16, 32 or 64; save floats in the unit that is "
            "meant (millimetres as whole numbers: .astype('float32') / 1000 are metres; disparity "
            "of OpenCV's matchers: / 16 are pixels)"
        )
    return to_float32(array)


def read_numbers(path: AnyPath) -> np.ndarray:
    """Read numbers of any shape and type from ``.npy``; pickled objects are refused.

    Raises:
        InputError: the file is missing, damaged or too large, or holds other things than numbers.
    """
    stream = BytesIO(read_bytes(path))
    with refused_as(path, "NPY file", "save it again with numpy.save"):
        version = np.lib.format.read_magic(stream)
        if version not in _HEADER_READERS:
            raise InputError(f"{path}: NPY version {version}; save plain floats with numpy.save")
        shape, is_fortran, dtype = _HEADER_READERS[version](stream)

        if dtype.kind not in "fiu" or dtype.itemsize > 8:
            raise InputError(
                f"{path}: holds {dtype}, not float16, 32 or 64; save .astype('float32')"
            )
        body = stream.getbuffer()[stream.tell() :]

        if len(shape) > _MAX_DIMENSIONS or any(type(side) is not int for side in shape):
            raise InputError(
                f"{path}: declares an array of shape {str(shape)[:60]}; give whole numbers, "
                f"{_MAX_DIMENSIONS} at most"
            )
        if min(shape, default=1) < 0 or math.prod(shape) * dtype.itemsize != len(body):
            raise InputError(
                f"{path}: declares {dtype} {str(shape)[:60]} but {len(body)} bytes follow; it is "
                "truncated or damaged, save it again"
            )
        if math.prod(shape) > _MAX_VALUES:
            raise InputError(
                f"{path}: {math.prod(shape)} values, more than {_MAX_VALUES}; split it"
            )
        return np.frombuffer(body, dtype).reshape(shape, order="F" if is_fortran else "C")


def to_float32(array: np.ndarray) -> np.ndarray:
    """Copy an array to contiguous float32; numbers beyond the range of float32 become infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.array(array, dtype=np.float32, order="C")


KITTI_UNIT = 1 / 256  # what 1 stands for in KITTI's PNGs of depth [m] and disparity [px]
_NO_UNIT = "a unit of {} is not positive; KITTI's is 1/256, BOP's 0.001"


def read_depth_png(path: AnyPath, unit_m: float = KITTI_UNIT) -> Float32[Tensor, "h w"]:
    """Read depth [m], or KITTI's disparity [px], from a 16-bit PNG; NaN where the file holds 0.

    Args:
        path: a 16-bit greyscale PNG, or a TIFF of that kind, as BOP's ITODD has.
        unit_m: length of one stored unit [m], or its pixels of disparity.

    Raises:
        InputError: the file is missing, damaged, 8-bit or coloured, or the unit makes no sense.
    """
    if not 0 < unit_m < math.inf:
        raise InputError(f"{path}: {_NO_UNIT.format(unit_m)}")
    with open_image(path) as image:
        if image.format not in ("PNG", "TIFF") or image.mode not in ("I;16", "I;16B"):
            raise InputError(
                f"{path}: a {image.format} of mode {image.mode}, where depth or disparity needs a "
                "16-bit greyscale PNG; an 8-bit or colour file is a picture of it, not the data"
            )
        units = torch.from_numpy(np.asarray(image).astype(np.float32))
    return torch.where(units > 0, units * unit_m, torch.nan)


def read_stored_depth(path: AnyPath) -> Shaped[Tensor, "h w"]:
    """Read depth as its file stores it: whole numbers of a 16-bit PNG, TIFF or NPY, else floats.

    Without a reading, whole numbers are 0 and floats NaN.

    Raises:
        InputError: the file is missing, damaged, no map, or a picture of a map.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        raise make_suffix_error(path, "depth image", DEPTH_SUFFIXES)
    if suffix == ".npy":
        array = read_numbers(path)
        if array.dtype.kind != "f":
            if array.ndim != 2:
                raise InputError(
                    f"{path}: depth is (H, W), got {array.shape}; save one channel alone"
                )
            return torch.from_numpy(array.astype(np.int64))
    if suffix in MAP_SUFFIXES:
        return read_map(path)
    if suffix != ".png":
        with open_image(path) as image:
            if image.mode in ("F", "I"):  # 32 bits: floats, whole numbers
                return torch.from_numpy(np.array(image))
    return read_depth_png(path, 1.0).nan_to_num(0.0).int()


def write_depth_png(
    path: AnyPath, depth_m: Float[Tensor, "h w"], unit_m: float = KITTI_UNIT
) -> None:
    """Write depth [m], or disparity [px] as KITTI does, as a 16-bit PNG.

    It holds 0 where the map is NaN, not positive or beyond 65535 units.

    Raises:
        InputError: the map is empty, the unit makes no sense, or the disk refuses.
    """
    if not 0 < unit_m < math.inf:
        raise InputError(f"{path}: {_NO_UNIT.format(unit_m)}")
    if depth_m.numel() == 0:
        raise InputError(f"{path}: an empty map {tuple(depth_m.shape)} makes no PNG; give pixels")
    units = (depth_m.detach().cpu().double() / unit_m).round()
    units = torch.where((units >= 1) & (units <= 65535), units, 0)
    encoded = BytesIO()
    with refused_as(path, "map", "check its size"):
        Image.fromarray(units.numpy().astype(np.uint16)).save(encoded, "PNG", **FAST_PNG)
    write_bytes(path, encoded.getvalue())
