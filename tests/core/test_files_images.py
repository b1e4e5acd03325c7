import re
import struct
from contextlib import nullcontext
from io import BytesIO
from pathlib import Path
from typing import Any, cast
from zlib import compress, crc32

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from depthpose.core.errors import InputError, Notice
from depthpose.core.files import (
    image_size,
    list_images,
    read_depth_png,
    read_image,
    write_depth_png,
    write_image,
)
from depthpose.core.files.disk import find_partners
from depthpose.core.files.stores import list_files


def bytes_image(height: int = 5, width: int = 7) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


@given(seed=st.integers(0, 2**32 - 1), height=st.integers(1, 9), width=st.integers(1, 9))
def test_png_gives_back_every_byte(
    tmp_path_factory: pytest.TempPathFactory, seed: int, height: int, width: int
) -> None:
    path = tmp_path_factory.mktemp("png") / "x.png"
    torch.manual_seed(seed)
    image = torch.randint(0, 256, (3, height, width)) / 255
    write_image(path, image)
    assert torch.equal(read_image(path), image)
    assert image_size(path) == (width, height)


def test_writing_rounds_to_the_nearest_level_and_clips_overshoot(tmp_path: Path) -> None:
    image = torch.tensor([0.4, 0.6, 254.6, 260.0, -3.0])[None, None].expand(3, 1, -1) / 255
    write_image(tmp_path / "x.png", image)
    assert (read_image(tmp_path / "x.png")[0, 0] * 255).tolist() == [0, 1, 255, 255, 0]


def test_jpeg_comes_back_close(tmp_path: Path) -> None:
    ramp = torch.linspace(0, 1, 64).expand(3, 32, 64).contiguous()
    write_image(tmp_path / "x.jpg", ramp)
    assert float((read_image(tmp_path / "x.jpg") - ramp).abs().max()) < 0.02


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGBA", "CMYK", "I;16"])
def test_every_mode_becomes_three_channels(tmp_path: Path, mode: str) -> None:
    grey = Image.fromarray(bytes_image()[:, :, 0])
    picture = (
        Image.fromarray(bytes_image()[:, :, 0].astype(np.uint16) * 257)
        if mode == "I;16"
        else grey.convert("RGB").convert(mode)
    )
    path = tmp_path / ("x.tif" if mode == "CMYK" else "x.png")
    picture.save(path)
    image = read_image(path)
    assert image.shape == (3, 5, 7)
    assert torch.equal(image[0], image[2])
    if mode not in ("1", "P"):
        expected = torch.from_numpy(bytes_image()[:, :, 0] / 255).float()
        torch.testing.assert_close(image[0], expected)


def test_a_transparent_palette_keeps_its_colours(tmp_path: Path) -> None:
    picture = Image.new("P", (2, 1))
    picture.putpalette([255, 0, 0, 0, 0, 255])
    picture.putdata([0, 1])
    picture.save(tmp_path / "x.png", transparency=bytes([0, 128]))
    assert read_image(tmp_path / "x.png")[:, 0].T.tolist() == [[1, 0, 0], [0, 0, 1]]


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_exif_orientation_is_applied_to_pixels_and_size(
    tmp_path: Path, orientation: int, suffix: str
) -> None:
    pixels = np.zeros((16, 32, 3), np.uint8)
    pixels[:8, :16] = 255  # the first corner of what the file stores
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / f"x{suffix}"
    Image.fromarray(pixels).save(path, exif=exif.tobytes())
    image = read_image(path)
    assert image_size(path) == (image.shape[2], image.shape[1])
    assert (image.shape[1] > image.shape[2]) == (orientation >= 5)
    # EXIF 2.32, tag 274: where the stored first row and first column belong.
    row, column = {
        **{1: (0, 0), 2: (0, -1), 3: (-1, -1), 4: (-1, 0)},
        **{5: (0, 0), 6: (0, -1), 7: (-1, -1), 8: (-1, 0)},
    }[orientation]
    corners = {(r, c): float(image[0, r, c]) for r in (0, -1) for c in (0, -1)}
    assert max(corners, key=lambda at: corners[at]) == (row, column)


def test_depth_png_follows_kitti_to_the_digit(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 1, 256, 65535]], np.uint16)).save(tmp_path / "d.png")
    depth_m = read_depth_png(tmp_path / "d.png")
    assert torch.isnan(depth_m[0, 0])
    assert depth_m[0, 1:].tolist() == [1 / 256, 1.0, 65535 / 256]


@given(st.integers(0, 2**32 - 1), st.sampled_from([1 / 256, 0.001, 0.0001]))
def test_depth_png_round_trips_every_unit(
    tmp_path_factory: pytest.TempPathFactory, seed: int, unit_m: float
) -> None:
    path = tmp_path_factory.mktemp("depth") / "d.png"
    torch.manual_seed(seed)
    units = torch.randint(0, 65536, (4, 5))
    depth_m = torch.where(units > 0, units.double() * unit_m, torch.nan).float()
    write_depth_png(path, depth_m, unit_m)
    torch.testing.assert_close(read_depth_png(path, unit_m), depth_m, equal_nan=True)
    again = torch.from_numpy(np.asarray(Image.open(path)).astype(np.int64))
    assert torch.equal(again, units)


def test_what_16_bits_cannot_hold_becomes_zero(tmp_path: Path) -> None:
    bad = torch.tensor([[torch.nan, -1, 0, 256, torch.inf, 255.999, 0.001]])
    write_depth_png(tmp_path / "d.png", bad)
    assert torch.isnan(read_depth_png(tmp_path / "d.png")).all()


def test_listing_a_file_a_folder_and_a_pattern(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("b.png", "a.JPG", "c.jpeg", "note.txt", ".hidden.png", "sub/d.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    names = [p.name for p in list_images(tmp_path)]
    assert names == ["a.JPG", "b.png", "c.jpeg"]
    assert list_images(tmp_path / "b.png") == [tmp_path / "b.png"]
    assert [p.name for p in list_images(f"{tmp_path}/*.png")] == ["b.png"]
    assert [p.name for p in list_images(tmp_path / "**" / "*.png")] == ["b.png", "d.png"]
    monkeypatch.chdir(tmp_path)
    assert list_images("sub/*") == [Path("sub/d.png")]


def test_numbers_in_names_are_in_the_order_of_their_values(tmp_path: Path) -> None:
    names = ["1.png", "2.png", "02.png", "10.png", "a1b9.png", "a1b10.png", "a.png"]
    for name in (*names, "sub9/1.png", "sub10/0.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    listed = [p.name for p in list_images(tmp_path)]
    assert listed == ["1.png", "02.png", "2.png", "10.png", "a.png", "a1b9.png", "a1b10.png"]
    assert [p.name for p in list_images(tmp_path / "sub*" / "*.png")] == ["1.png", "0.png"]


def test_brackets_in_the_name_of_a_folder_are_no_pattern(tmp_path: Path) -> None:
    home = tmp_path / "run[1]" / "left"
    home.mkdir(parents=True)
    for name in ("a.PNG", "b.tif", "c.webp", "d.bmp", "e.ppm", "f.txt"):
        (home / name).touch()
    pictures = ["a.PNG", "b.tif", "c.webp", "d.bmp", "e.ppm"]
    for wanted in (home, home / "*", home / "[a-e].*"):
        assert [path.name for path in list_images(wanted)] == pictures
    found = list_files(str(home / "*"), (".png", ".tif"))
    assert [Path(path).name for path in found] == ["a.PNG", "b.tif"]


def test_pictures_that_are_not_read_are_named(tmp_path: Path) -> None:
    for name in ("a.png", "b.JFIF", "c.gif", "d.HEIC", "e.avif", ".f.heic", "times.txt"):
        (tmp_path / name).touch()
    with pytest.warns(Notice, match=r"2 files are left out, d\.HEIC first: save them as PNG"):
        assert [p.name for p in list_images(tmp_path)] == ["a.png", "b.JFIF", "c.gif"]


@pytest.mark.parametrize("wanted", ["", "nothing", "*.bmp", "empty"])
def test_listing_nothing_names_what_was_sought(tmp_path: Path, wanted: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no \.png, .*\.webp file there; give a picture"):
        list_images(tmp_path / wanted)


def levels() -> np.ndarray:
    """Each of 256 levels on 100 pixels, so that 0.1 % is less than a level."""
    return np.arange(256, dtype=np.uint16).repeat(100).reshape(160, 160)


@pytest.mark.parametrize(
    ("times", "offset", "said"),
    [(4, 0, "0 to 1020: 0 is"), (16, 0, "0 to 4080: 0 is"), (64, 0, "0 to 16320: 0 is"),
     (4, 7600, "7600 to 8620: 7600 is"), (4, 30000, "30000 to 31020: 30000 is"), (257, 0, None)],
)  # fmt: skip
def test_fewer_than_16_bits_in_16_are_scaled_by_the_values_and_said(
    tmp_path: Path, times: int, offset: int, said: str | None
) -> None:
    path = tmp_path / "grey.png"
    Image.fromarray(levels() * times + offset).save(path)
    expected = pytest.warns(Notice, match=said) if said else nullcontext()
    with expected:
        grey = read_image(path)
    assert torch.allclose(grey[1], torch.from_numpy(levels() / 255).float(), atol=1e-6)


def test_few_values_are_a_mask_and_stay(tmp_path: Path) -> None:
    labels = np.ones((40, 40), np.uint16)
    labels[0, 0] = 0
    Image.fromarray(labels).save(tmp_path / "mask.png")
    assert int((read_image(tmp_path / "mask.png")[0] > 0).sum()) == 1599


def png_of_48_bits(pixels: np.ndarray) -> bytes:
    """Write a PNG by its specification: colour type 2, 16 bits, rows without filter."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", crc32(name + body))

    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize("suffix", ["png", "ppm"])
@pytest.mark.parametrize("times", [4, 257])
def test_colours_of_16_bits_keep_their_lower_bytes(tmp_path: Path, suffix: str, times: int) -> None:
    grey = levels()
    pixels = np.stack([grey, grey[::-1], grey.T], -1) * times
    path = tmp_path / f"colour.{suffix}"
    ppm = b"P6 160 160 65535\n" + pixels.astype(">u2").tobytes()
    path.write_bytes(png_of_48_bits(pixels) if suffix == "png" else ppm)
    with pytest.warns(Notice, match="0 to 1020") if times == 4 else nullcontext():
        found = read_image(path)
    wanted = torch.from_numpy(pixels / (255 * times)).permute(2, 0, 1).float()
    assert torch.allclose(found, wanted, atol=1e-6)


@pytest.mark.parametrize(
    ("first", "second", "places"),
    [
        ("a b", "b a", [1, 0]),
        ("a_left b_left", "a_right b_right", [0, 1]),
        ("left_0000 left_0004", "right_0004 right_0000", [1, 0]),
        ("1_L 2_L 10_L", "10_R 1_R 2_R", [1, 2, 0]),
        ("cam0_8_rect cam0_9_rect", "cam1_9_rect cam1_8_rect", [1, 0]),
        ("2024_L_1 2024_L_2 2025_L_1", "2025_R_1 2024_R_2 2024_R_1", [2, 1, 0]),
        ("frame_08 frame_09", "cam1_frame_9 cam1_frame_8", [1, 0]),
        ("kitchen_L hall_L", "hall_R kitchen_R", [1, 0]),
        ("left", "right", [0]),
        ("cam0_0007", "cam1_0007", [0]),
    ],
)
def test_partners_share_a_name_or_a_number(first: str, second: str, places: list[int]) -> None:
    assert find_partners(first.split(), second.split(), "two folders") == places


@pytest.mark.parametrize(
    ("first", "second", "lone"),
    [
        ("a b c", "b c d", "'a', 'd'"),
        ("left_0 left_2 left_4 left_6", "right_0 right_4 right_6 right_8", "'left_2', 'right_8'"),
        ("1_L 2_L", "2_R 3_R", "'1_L', '3_R'"),
        ("100 101", "200 201", "'100', '101', '200', '201'"),
        ("frame2", "img3", "'frame2', 'img3'"),
        ("l_1_1 l_1_2", "r_1_1 r_2_1", "'l_1_2', 'r_2_1'"),
        ("f1 f2 f3", "g1 g2", "'f3'"),
        ("f1 f01", "g1 g2", "'f1', 'f01', 'g1', 'g2'"),
        ("dog cat", "hund katze", "'dog', 'cat', 'hund', 'katze'"),
    ],
)
def test_files_without_a_partner_are_named(first: str, second: str, lone: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"number is there for {lone}; remove these")):
        find_partners(first.split(), second.split(), "two folders")


@pytest.mark.parametrize("name", ["frames.tar", "frames.TGZ", "frames.tar.xz", "frames.zip"])
def test_an_archive_is_named_for_what_it_is(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_bytes(b"PK")
    with pytest.raises(InputError, match="unpack the archive"):
        list_images(file)


def jpeg(
    folder: Path, data: bytes | None = None, options: dict[str, int] | None = None
) -> tuple[Path, bytes]:
    """Write a JPEG of a picture with texture, or these bytes, and give both."""
    encoded = BytesIO()
    tiles = np.random.default_rng(0).integers(0, 256, (12, 20, 3), dtype=np.uint8)
    pixels = tiles.repeat(8, 0).repeat(8, 1)
    Image.fromarray(pixels).save(encoded, "JPEG", **cast("Any", {"quality": 95, **(options or {})}))
    path = folder / "street.jpg"
    path.write_bytes(encoded.getvalue() if data is None else data)
    return path, path.read_bytes()


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"subsampling": 0}], ids=str)
def test_a_damaged_jpeg_is_refused(tmp_path: Path, options: dict[str, int]) -> None:
    path, whole = jpeg(tmp_path, options=options)
    with Image.open(path) as pillow:
        assert np.array_equal(np.asarray(pillow), (read_image(path) * 255).byte().permute(1, 2, 0))
    cut = whole[: len(whole) * 6 // 10]
    damaged = {
        "cut, and closed by an end marker": cut + b"\xff\xd9",
        "cut": cut,
        "bytes lost": whole[: len(whole) // 2] + whole[len(whole) // 2 + 40 :],
    }
    for how, data in damaged.items():
        path, _ = jpeg(tmp_path, data)
        with pytest.raises(InputError, match="JPEG"):
            pytest.fail(f"{how}: {read_image(path).shape}")
    assert image_size(path) == (160, 96)


@pytest.mark.parametrize("quality", [50, 75, 95])
@pytest.mark.parametrize("options", [{}, {"optimize": True}, {"subsampling": 0}], ids=str)
def test_zeros_in_place_of_compressed_pixels_are_refused(
    tmp_path: Path, options: dict[str, int], quality: int
) -> None:
    """As of a file that was not copied whole: the decoder itself warns of half of them."""
    grains = np.random.default_rng(0).normal(0, 12, (96, 160, 3))
    pixels = (100 + 5 * np.cumsum(grains, 1) / 12 + grains).clip(0, 255).astype(np.uint8)
    encoded = BytesIO()
    Image.fromarray(pixels).save(encoded, "JPEG", quality=quality, **cast("Any", options))
    whole = encoded.getvalue()
    path, _ = jpeg(tmp_path, whole)
    assert read_image(path).shape == (3, 96, 160)
    begin = whole.rindex(b"\xff\xda") + 14
    for place in range(begin, len(whole) - 60, len(whole) // 20):
        holed = whole[:place] + bytes(40) + whole[place + 40 :]
        path, _ = jpeg(tmp_path, holed)
        with pytest.raises(InputError, match="a damaged JPEG"):
            pytest.fail(f"zeros at {place}: {read_image(path).shape}")


@pytest.mark.parametrize("options", [{"optimize": True}, {"progressive": True}], ids=str)
def test_zeros_that_are_a_plain_surface_are_read(tmp_path: Path, options: dict[str, int]) -> None:
    pixels = np.full((640, 640, 3), 255, np.uint8)
    pixels[:8, :8] = 0
    path = tmp_path / "plain.jpg"
    Image.fromarray(pixels).save(path, quality=75, **cast("Any", options))
    assert bytes(40) in path.read_bytes()
    assert float(read_image(path)[:, 40:].min()) == 1


def test_zeros_of_a_progressive_picture_are_no_coefficients(tmp_path: Path) -> None:
    """Whatever table stands before its first scan, which is of no coefficients but the first."""
    plain = BytesIO()
    Image.new("RGB", (2000, 2000), "white").save(plain, "JPEG", progressive=True)
    counts = bytes([0, 1, *[0] * 14])
    table = b"\xff\xc4\x00\x14\x10" + counts + b"\x01"
    data = plain.getvalue()
    path, _ = jpeg(tmp_path, data[:2] + table + data[2:])
    assert bytes(16) in path.read_bytes()
    assert float(read_image(path).min()) == 1


def test_zeros_behind_a_picture_are_no_damage(tmp_path: Path) -> None:
    _, whole = jpeg(tmp_path)
    path, _ = jpeg(tmp_path, whole + bytes(400))
    assert read_image(path).shape == (3, 96, 160)


def test_of_several_pictures_in_a_file_the_first_is_read_with_a_notice(tmp_path: Path) -> None:
    one, other = (Image.new("L", (8, 6), value) for value in (51, 255))
    for suffix in ("tif", "gif", "png"):
        path = tmp_path / suffix / f"x.{suffix}"
        path.parent.mkdir()
        one.save(path, save_all=True, append_images=[other])
        with pytest.warns(
            Notice, match=f"x.{suffix}: holds 2 pictures, of which the first is read"
        ):
            assert float(read_image(path).mean()) == pytest.approx(0.2, abs=0.01)
    read_image(tmp_path / "tif" / "x.tif")  # a folder is told of once


def test_a_16_bit_tiff_whose_0_is_white_is_not_read_inverted(tmp_path: Path) -> None:
    values = np.linspace(0, 65535, 48).astype(np.uint16).reshape(6, 8)
    path = tmp_path / "x.tif"
    Image.fromarray(values).save(path, tiffinfo={0x0106: 0})
    assert np.allclose(read_image(path)[0], 1 - values / 65535)


def test_files_of_stereo_cameras_are_no_single_picture(tmp_path: Path) -> None:
    left, right, small = (Image.new("RGB", size) for size in ((64, 48), (64, 48), (32, 24)))
    left.save(tmp_path / "x.mpo", save_all=True, append_images=[right])
    left.save(tmp_path / "x.jps", "JPEG")
    for name in ("x.mpo", "x.jps"):
        with pytest.raises(InputError, match=rf"{name}: holds both views .* data split {name}"):
            read_image(tmp_path / name)
    left.save(tmp_path / "gain.jpg", "MPO", save_all=True, append_images=[small])
    assert read_image(tmp_path / "gain.jpg").shape == (3, 48, 64)
