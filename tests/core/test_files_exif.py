"""The focal length that EXIF tells, in pixels."""

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, TiffImagePlugin

from depthpose.core.errors import InputError, Notice
from depthpose.core.files import read_exif_focal

Rational = TiffImagePlugin.IFDRational
FULL_FRAME_MM = math.hypot(36, 24)


def photograph(path: Path, tags: dict[int, object], size: tuple[int, int] = (400, 300)) -> Path:
    """Write a picture with tags of the camera in its EXIF."""
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(path, exif=exif.tobytes())
    return path


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_the_focal_length_in_35_mm_is_compared_by_the_diagonal(tmp_path: Path, suffix: str) -> None:
    found = read_exif_focal(photograph(tmp_path / f"a.{suffix}", {0xA405: 26}))
    assert found is not None
    assert found[0] == pytest.approx(26 / FULL_FRAME_MM * 500)
    assert found[1] == "FocalLengthIn35mmFilm 26 mm"


@pytest.mark.parametrize("size", [(400, 300), (300, 400)])
def test_the_size_of_the_sensor_serves_where_it_is_known(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    # 100 pixels a millimetre on the sensor, and the picture is a tenth of what was taken.
    tags = {0x920A: Rational(4, 1), 0xA20E: Rational(1000, 1), 0xA210: 3, 0xA002: 4000, 0xA405: 0}
    found = read_exif_focal(photograph(tmp_path / "a.jpg", tags, size))
    assert found is not None
    assert found[0] == pytest.approx(4 * 100 / 10)
    assert found[1] == "FocalLength 4 mm, 40.0 mm of sensor"


@pytest.mark.parametrize(
    "tags",
    [{}, {0xA405: 0}, {0x920A: Rational(4, 1)}, {0x920A: Rational(0, 0), 0xA20E: Rational(9, 1)},
     {0x920A: Rational(4, 1), 0xA20E: Rational(1000, 1), 0xA210: 77}],
    ids=["no tags", "zero", "no sensor", "a division by zero", "an unknown unit"],
)  # fmt: skip
def test_without_such_tags_there_is_none(tmp_path: Path, tags: dict[int, object]) -> None:
    assert read_exif_focal(photograph(tmp_path / "a.jpg", tags)) is None


def test_a_picture_of_pillow_is_asked_too_and_what_is_no_picture_is_refused(tmp_path: Path) -> None:
    with Image.open(photograph(tmp_path / "a.jpg", {0xA405: 50})) as opened:
        assert read_exif_focal(opened) is not None
    (tmp_path / "b.jpg").write_text("no picture")
    with pytest.raises(InputError, match=r"b\.jpg"):
        read_exif_focal(tmp_path / "b.jpg")


def test_exif_of_a_picture_that_was_cut_is_none(tmp_path: Path) -> None:
    tags: dict[int, object] = {0xA405: 26, 0xA002: 4000, 0xA003: 3000}
    assert read_exif_focal(photograph(tmp_path / "scaled.jpg", tags)) is not None
    assert read_exif_focal(photograph(tmp_path / "turned.jpg", tags, (300, 400))) is not None
    with pytest.warns(Notice, match="EXIF of a picture of 4000x3000, and this one is 400x120, cut"):
        assert read_exif_focal(photograph(tmp_path / "cut.jpg", tags, (400, 120))) is None
