"""The focal length that a photograph's EXIF tells, in pixels."""

import math
from typing import Any

from PIL import Image

from depthpose.core.files.disk import AnyPath
from depthpose.core.files.images import opened_image

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
