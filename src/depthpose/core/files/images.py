"""Pictures as RGB tensors, their listing, EXIF; maps in NPY and PFM, depth in 16-bit PNG."""

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
    natural_order,
    read_bytes,
    refused_as,
    refused_suffix,
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
"""Suffixes of pictures that are not read: in a folder they are named."""
_ARCHIVES = (".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".lz4", ".zip", ".7z", ".rar")
"""Suffixes of archives, which are no pictures whatever they hold."""
FAST_PNG = {"compress_level": 1}
"""Four times faster than zlib's usual 6 and a third larger at most: at 6, writing the pictures of
an estimate took as long as the estimate."""
MAX_PIXELS = 2**25  # 0.4 GB of floats; a small file may declare any size

# Named one by one: Pillow also opens formats that start other programs.
_FORMATS = ("PNG", "JPEG", "BMP", "PPM", "TIFF", "WEBP", "GIF")
_JPEG_COLOURS = {"RGB": "RGB", "L": "GRAY"}
"""Modes of Pillow's, and what simplejpeg calls them."""
_HOLE = bytes(16)
"""More zeros than 2,600 compressed pictures of all qualities hold in a row, which is 6."""
_NEXT_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
"""The end of a JPEG's compressed pixels."""
_GREY_16 = ("I;16", "I;16L", "I;16B", "I;16N")
_EXIF_ORIENTATION = 0x0112
_PHOTOMETRIC = 0x0106  # of TIFF: 0 where the value 0 is white
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
    orientation applied, and 16 bits a channel scaled by ``from_16_bit``. Of several pictures in one
    file the first is read, with a notice.

    Raises:
        InputError: the file is missing, damaged, too large, not a picture, or holds both views of a
            stereo camera.
    """
    with opened_image(path) as image:
        pixels = _decoded(path, image)
        count = getattr(image, "n_frames", 1) if image.format != "MPO" else 1
    if count > 1 and _is_new(path, "several"):
        message = (
            f"{path}: holds {count} pictures, of which the first is read (so it is of other files "
            "there); save each in a file of its own to have them all"
        )
        warnings.warn(message, Notice, stacklevel=2)
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
    """Decode to RGB or grey of 8 or 16 bits, turned upright by EXIF."""
    turn = _UPRIGHT.get(_orientation(image))
    parts = [image]
    opened: Any = image  # a picture that is not of a file has neither
    tiles = [] if getattr(image, "fp", None) is None else getattr(image, "tile", None) or []
    raws = [tile.args if isinstance(tile.args, str) else tile.args[0] for tile in tiles]
    if raws and all(re.fullmatch("RGBA?;16[BLN]", str(raw)) for raw in raws):
        # Pillow keeps the upper byte of a colour; opened again, bytes exchanged, the lower one.
        file = opened.fp
        at = file.tell()
        file.seek(0)
        other: Any = Image.open(BytesIO(file.read()), formats=_FORMATS)
        file.seek(at)
        little = "LN" if sys.byteorder == "little" else "L"
        swapped = [raw[:-1] + ("B" if raw[-1] in little else "L") for raw in raws]
        other.tile = [
            tile._replace(args=raw if isinstance(tile.args, str) else (raw, *tile.args[1:]))
            for tile, raw in zip(tiles, swapped, strict=True)
        ]
        parts.append(other)
    elif raws and image.format == "PPM" and image.mode == "RGB" and tiles[0].codec_name == "ppm":
        most = tiles[0].args[1] if isinstance(tiles[0].args, tuple) else 255
        if most > 255:  # of which Pillow keeps 8 bits too
            opened.fp.seek(tiles[0].offset)
            values = np.frombuffer(opened.fp.read(6 * image.width * image.height), ">u2")
            whole = values.reshape(image.height, image.width, 3).astype(np.float64)
            return (whole * (65535 / most)).round().clip(0, 65535).astype(np.uint16)
    elif tiles and image.format == "JPEG" and image.mode in _JPEG_COLOURS:
        opened.fp.seek(0)
        parts = [_decoded_jpeg(name, opened.fp.read(), _JPEG_COLOURS[image.mode])]
    read: list[np.ndarray] = []
    for part in parts:
        picture = part if turn is None else part.transpose(turn)
        # Pillow scales 16-bit PGM to 65535.
        if picture.mode in _GREY_16 or (picture.mode == "I" and image.format == "PPM"):
            values = np.asarray(picture).astype(np.uint16)
            # Of 8 bits Pillow does this itself.
            is_inverted = image.format == "TIFF" and opened.tag_v2.get(_PHOTOMETRIC) == 0
            read.append(65535 - values if is_inverted else values)
            continue
        if picture.mode in ("I", "F"):
            raise InputError(f"{name}: 32 bits a pixel; save it with 8 or 16 bits a channel")
        if picture.mode == "P" and "transparency" in picture.info:
            picture = picture.convert("RGBA")
        read.append(np.asarray(picture.convert("RGB")))
    pixels, *low = read
    return pixels.astype(np.uint16) * 256 + low[0] if low else pixels


def _decoded_jpeg(name: AnyPath, data: bytes, colours: str) -> Image.Image:
    """Decode a JPEG by the same library as Pillow, and refuse what its decoder warns of.

    Of damaged pixels libjpeg warns alone, and goes on with shifted, wrong or grey ones; Pillow does
    not pass its warnings on.
    """
    try:
        pixels = simplejpeg.decode_jpeg(data, colours, strict=True).squeeze()
    except ValueError as error:
        raise _damaged_jpeg(name, str(error)) from error
    if _has_hole(data):
        raise _damaged_jpeg(name, "zeros in place of compressed pixels")
    return Image.fromarray(pixels)


def _damaged_jpeg(name: AnyPath, reason: str) -> InputError:
    return InputError(
        f"{name}: a damaged JPEG ({reason}), whose pixels are wrong from there on; copy it anew, "
        "or save it again where it looks whole"
    )


def _has_hole(data: bytes) -> bool:
    """Whether zeros stand in place of compressed pixels, as of a file that was not copied whole.

    Zeros are the first code of a Huffman table. Where that is a coefficient of 1, sixteen bytes of
    them are forty such in a row, which no picture has. Where it ends a block, as in progressive
    files, zeros are a plain surface, and nothing can be said.
    """
    if _HOLE not in data:
        return False
    first_codes: dict[int, int] = {}
    place = 2
    while data[place : place + 1] == b"\xff" and place + 4 < len(data):
        marker = data[place + 1]
        if marker == 0xFF:  # filling
            place += 1
            continue
        end = place + 2 + int.from_bytes(data[place + 2 : place + 4], "big")
        segment = data[place + 4 : end]
        if marker == 0xC2:  # progressive
            return False
        while marker == 0xC4 and len(segment) > 17:  # Huffman tables: kind, 16 counts, symbols
            first_codes[segment[0]] = segment[17]
            segment = segment[17 + sum(segment[1:17]) :]
        if marker == 0xDA and len(segment) > 2:
            # The table of the first component's coefficients, 16 and up.
            table = 16 + (segment[2] & 15)
            stop = _NEXT_MARKER.search(data, end)
            is_coefficient = first_codes.get(table, 0) & 15 > 0
            return is_coefficient and _HOLE in data[end : stop.start() if stop else None]
        place = end
    return False


def _tensor_of(pixels: np.ndarray, name: AnyPath) -> Float32[Tensor, "3 h w"]:
    """Convert pixels to RGB in [0, 1]; apart from decoding, where warnings are silenced."""
    # Channels are parted while a pixel is an integer: the floats are there once.
    planes = np.ascontiguousarray(pixels[None] if pixels.ndim == 2 else pixels.transpose(2, 0, 1))
    if planes.dtype.itemsize == 2:
        rgb = torch.from_numpy(from_16_bit(planes, name))
    else:
        rgb = torch.from_numpy(planes.astype(np.float32)).div_(255)
    return rgb.expand(3, -1, -1).contiguous()


def from_16_bit(values: np.ndarray, name: AnyPath) -> np.ndarray:
    """Convert 16-bit numbers to floats in [0, 1]; a notice names a divisor other than 65535.

    Cameras of 10, 12 or 14 bits, and thermal ones, use a part of the range: black and white are
    then what 0.1 % of the values lie below and above; black is 0 unless all lie far from it.
    """
    low, high = value_range(values)
    if not _LEAST_SPAN <= high - low < _FULL_SPAN:
        return values.astype(np.float32) / 65535
    black = low if low > high - low else 0
    if _is_new(name, "range"):
        message = (
            f"{name}: of 16 bits, and its values are {low} to {high}: {black} is taken as black "
            f"and {high} as white; so are those of other pictures there"
        )
        warnings.warn(message, Notice, stacklevel=2)
    return ((values.astype(np.float32) - black) / (high - black)).clip(0, 1)


def check_image(image: object, name: str, slack: float = 0.5) -> Float[Tensor, "3 h w"]:
    """Return an RGB image, or refuse what is not one; values may leave [0, 1] by ``slack``."""
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


def value_range(values: np.ndarray) -> tuple[int, int]:
    """Give the values that all but 0.1 % lie above, and below; defective pixels do not count."""
    low, high = np.quantile(values, (0.001, 0.999), method="nearest")
    return int(low), int(high)


_LEAST_SPAN = 64  # values between the darkest and the brightest; a mask has fewer
_FULL_SPAN = 2**14  # what spans more is taken for 16 bits
_REPORTED: set[tuple[Path, str]] = set()  # folders, and what has been reported of them


def _is_new(name: AnyPath, what: str) -> bool:
    """Whether this has not been reported of a folder yet; it counts as reported from now on."""
    key = Path(name).parent, what
    is_new = key not in _REPORTED
    _REPORTED.add(key)
    return is_new


def image_size(path: AnyPath) -> tuple[int, int]:
    """Give (width, height) of a picture as :func:`read_image` returns it, without decoding.

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
    form = "PNG"
    options = FAST_PNG
    if suffix != ".png":
        form = "JPEG"
        options = {"quality": quality, "subsampling": 0}
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
        if wanted.is_file() and wanted.suffix.lower() not in _ARCHIVES:
            return [wanted]
        if wanted.is_dir():
            files = list(wanted.iterdir())
        else:
            home = Path(wanted.anchor)
            parts = list(wanted.relative_to(wanted.anchor).parts)
            while len(parts) > 1 and (home / parts[0]).is_dir():  # its brackets are no pattern
                home /= parts.pop(0)
            files = [p for p in home.glob("/".join(parts)) if p.is_file()]
    except (OSError, ValueError, NotImplementedError) as error:
        raise InputError(f"{str(path)!r}: cannot be listed: {error}") from error
    shown = (p for p in files if p.suffix.lower() in LISTED_SUFFIXES and p.name[0] != ".")
    pictures = sorted(shown, key=natural_order)
    unread = [p.name for p in files if _UNREAD.fullmatch(p.suffix) and p.name[0] != "."]
    if unread and pictures:
        message = f"{path}: {len(unread)} files are left out, {min(unread)} first: save them as PNG"
        warnings.warn(message, Notice, stacklevel=2)
    if not pictures:
        remedy = "give a picture, a folder of pictures or a pattern such as 'left/*.png'"
        if any(p.suffix.lower() in _ARCHIVES for p in files):
            remedy = "unpack the archive (with --engine ray, .tar and .tar.gz are read)"
        raise InputError(f"{path}: no {', '.join(LISTED_SUFFIXES)} file there; {remedy}")
    return pictures


def refuse_among_inputs(out: Path, words: Iterable[str | Path], files: Iterable[Path]) -> None:
    """Refuse to write results beside the inputs: the next run would read them as inputs.

    Args:
        out: where the results go.
        words: as given: files, folders or patterns.
        files: that they name.

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
    """Read the pictures of a file as :func:`read_image` does: two of an MPO, else one.

    Raises:
        InputError: as there; a file of a stereo camera is none here.
    """
    with opened_image(path, with_views=True) as image:
        pixels = [_decoded(path, image)]
        if image.format == "MPO":
            image.seek(1)
            pixels.append(_decoded(path, image))
    return [_tensor_of(view, path) for view in pixels]


@contextmanager
def opened_image(path: AnyPath, *, with_views: bool = False) -> Iterator[Image.Image]:
    """Open a picture's header; whatever decoding raises inside the block is an input error.

    Files of stereo cameras are refused, unless ``with_views``.
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
    has_jps_segment = any(what == "APP3" and b"_JPSJPS_" in data for what, data in segments)
    layout = ""
    if has_jps_segment or file_name.lower().endswith(".jps"):
        layout = "JPS, side by side"
    elif image.format == "MPO":
        # Telephones keep smaller pictures in an MPO, such as maps of gain; a second view is as
        # large as the first.
        frames: Any = image
        first_size = image.size
        other_sizes = []
        for frame in range(1, frames.n_frames):
            frames.seek(frame)
            other_sizes.append(frames.size)
        frames.seek(0)
        layout = "MPO, one after the other" if first_size in other_sizes else ""
    if layout:
        raise InputError(
            f"{path}: holds both views of a stereo camera ({layout}); "
            f"'depthpose data split {file_name} --out DIR' parts them, and 'depthpose depth match' "
            "takes the two"
        )


def _orientation(image: Image.Image) -> int:
    # Pillow turns TIFF itself, and would decode a PNG to look for EXIF behind the pixels.
    is_turned = image.format == "TIFF"
    is_hidden = image.format == "PNG" and "exif" not in image.info
    return 1 if is_turned or is_hidden else image.getexif().get(_EXIF_ORIENTATION, 1)


_EXIF_IFD = 0x8769
_FOCAL_MM = 0x920A
_FOCAL_35MM = 0xA405
_RESOLUTION = 0xA20E
_RESOLUTION_UNIT = 0xA210
_PIXELS = 0xA002
_PIXELS_DOWN = 0xA003
_SAME_ASPECT = 1.02  # scaled pictures are rounded to whole pixels, and cameras cut some rows
_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # of a unit of resolution: inch, cm, mm, micrometre
_DIAGONAL_MM = math.hypot(36, 24)


def read_exif_focal(picture: AnyPath | Image.Image) -> tuple[float, str] | None:
    """Read the focal length of a photograph [px], and the tags that it follows from.

    ``FocalLengthIn35mmFilm`` is compared by the diagonal, as CIPA DC-008 defines it; else
    ``FocalLength`` is divided by the width of a pixel on the sensor (``FocalPlaneXResolution``),
    times the ratio of this width and the one that was taken (``PixelXDimension``).

    Returns:
        None where the picture has no such tags, or zeros, which mean unknown; and, with a notice,
        where they are of a picture of another aspect, from which this one was cut.

    Raises:
        InputError: the file is no picture.
    """
    if isinstance(picture, Image.Image):
        focal, doubt = _exif_focal(picture)
    else:
        with opened_image(picture) as opened:
            focal, doubt = _exif_focal(opened)
    if doubt:
        warnings.warn(doubt, Notice, stacklevel=2)
    return focal


def _exif_focal(picture: Image.Image) -> tuple[tuple[float, str] | None, str]:
    """Read the focal length; or say why there is none although its tags are present."""
    if picture.format == "PNG" and "exif" not in picture.info:
        return None, ""
    tags = picture.getexif().get_ifd(_EXIF_IFD)
    film_mm = _positive(tags.get(_FOCAL_35MM))
    focal_mm = _positive(tags.get(_FOCAL_MM))
    across = _positive(tags.get(_PIXELS))
    down = _positive(tags.get(_PIXELS_DOWN))
    if (film_mm or focal_mm) and across and down:
        taken = max(across, down) / min(across, down)
        aspect = max(picture.size) / min(picture.size)
        if not 1 / _SAME_ASPECT < taken / aspect < _SAME_ASPECT:
            message = (
                f"EXIF of a picture of {across:g}x{down:g}, and this one is {picture.size[0]}x"
                f"{picture.size[1]}, cut from it: the focal length there is not that of this one"
            )
            return None, message
    if film_mm is not None:
        focal_px = film_mm / _DIAGONAL_MM * math.hypot(*picture.size)
        return (focal_px, f"FocalLengthIn35mmFilm {film_mm:g} mm"), ""
    per_unit = _positive(tags.get(_RESOLUTION))
    unit_mm = _MM.get(tags.get(_RESOLUTION_UNIT, 2))
    if focal_mm is None or per_unit is None or unit_mm is None:
        return None, ""
    taken = _positive(tags.get(_PIXELS)) or max(picture.size)
    # A picture stored turned has the sensor's width along its longer side.
    focal_px = focal_mm * per_unit / unit_mm * max(picture.size) / taken
    sensor_mm = taken * unit_mm / per_unit
    return (focal_px, f"FocalLength {focal_mm:g} mm, {sensor_mm:.1f} mm of sensor"), ""


def _positive(value: Any) -> float | None:  # noqa: ANN401  whatever a file holds
    """Give a value of a file as a positive finite number, else None."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < math.inf else None


MAP_SUFFIXES = (".npy", ".pfm")
"""Suffixes of files that hold a map of floats."""
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", *MAP_SUFFIXES)
"""Suffixes of depth images of a sensor."""
_HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_MAX_DIMENSIONS = 8
_MAX_VALUES = 2**26
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
        data = read_bytes(path)
        header = _PFM_HEADER.match(data)
        if header is None:
            raise InputError(
                f"{path}: no PFM header ('Pf', width, height, scale); is it a PFM file?"
            )
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
        rows = np.frombuffer(body, "<f4" if scale < 0 else ">f4").reshape(height, width)
        array = to_float32(rows[::-1])
        array[~np.isfinite(array)] = np.nan
        return torch.from_numpy(array)
    if suffix != ".npy":
        raise refused_suffix(path, "map", MAP_SUFFIXES)
    array = read_npy(path)
    if array.ndim != 2 or array.size == 0:
        raise InputError(f"{path}: a map is (H, W), got {array.shape}; save one channel alone")
    if np.isinf(array).any():
        raise InputError(f"{path}: holds infinity; mark invalid pixels by NaN")
    return torch.from_numpy(array)


def write_map(path: AnyPath, map: Float[Tensor, "h w"]) -> None:
    """Write a map as float32 ``.npy`` (NaN: invalid) or ``.pfm`` (infinity: invalid).

    Raises:
        InputError: the map is empty or holds infinity, the suffix is another, the disk refuses.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in MAP_SUFFIXES:
        raise refused_suffix(path, "map", MAP_SUFFIXES)
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
    """Read a float array of any shape as float32; never unpickles."""
    array = read_numbers(path)
    if array.dtype.kind != "f":
        raise InputError(
            f"{path}: holds {array.dtype}, not float16, 32 or 64; save floats in the unit that is "
            "meant (millimetres as whole numbers: .astype('float32') / 1000 are metres; disparity "
            "of OpenCV's matchers: / 16 are pixels)"
        )
    return to_float32(array)


def read_numbers(path: AnyPath) -> np.ndarray:
    """Read an array of floats or whole numbers of any shape as it is; never unpickles."""
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
    """Copy to native contiguous float32; what float32 cannot hold becomes infinity."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.array(array, dtype=np.float32, order="C")


KITTI_UNIT = 1 / 256  # KITTI stores metres and pixels of disparity times 256
_NO_UNIT = "a unit of {} is not positive; KITTI's is 1/256, BOP's 0.001"


def read_depth_png(path: AnyPath, unit_m: float = KITTI_UNIT) -> Float32[Tensor, "h w"]:
    """Read depth [m], or KITTI's disparity [px], from a 16-bit PNG; NaN where the file holds 0.

    Args:
        path: a 16-bit greyscale PNG, or a TIFF of that kind, as BOP's ITODD has.
        unit_m: metres (or pixels) a unit.

    Raises:
        InputError: the file is missing, damaged, 8-bit or coloured, or the unit makes no sense.
    """
    if not 0 < unit_m < math.inf:
        raise InputError(f"{path}: {_NO_UNIT.format(unit_m)}")
    with opened_image(path) as image:
        if image.format not in ("PNG", "TIFF") or image.mode not in ("I;16", "I;16B"):
            raise InputError(
                f"{path}: a {image.format} of mode {image.mode}, where depth or disparity needs a "
                "16-bit greyscale PNG; an 8-bit or colour file is a picture of it, not the data"
            )
        units = torch.from_numpy(np.asarray(image).astype(np.float32))
    return torch.where(units > 0, units * unit_m, torch.nan)


def read_stored_depth(path: AnyPath) -> Shaped[Tensor, "h w"]:
    """Read depth as it is stored: whole numbers of a 16-bit PNG, TIFF or NPY; floats of the others.

    Whole numbers are 0 where there is no reading, floats NaN.

    Raises:
        InputError: the file is missing, damaged, no map, or a picture of one.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        raise refused_suffix(path, "depth image", DEPTH_SUFFIXES)
    if suffix == ".npy" and (array := read_numbers(path)).dtype.kind != "f":
        if array.ndim != 2:
            raise InputError(f"{path}: depth is (H, W), got {array.shape}; save one channel alone")
        return torch.from_numpy(array.astype(np.int64))
    if suffix in MAP_SUFFIXES:
        return read_map(path)
    if suffix != ".png":
        with opened_image(path) as image:
            if image.mode in ("F", "I"):
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
