"""Every way a file can be wrong, and what is said about it."""

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from depthpose.core.errors import InputError
from depthpose.core.files import (
    PointCloud,
    image_size,
    list_images,
    read_cloud,
    read_depth_png,
    read_image,
    read_json,
    read_key_values,
    read_map,
    read_points_bin,
    read_text,
    write_cloud,
    write_depth_png,
    write_image,
    write_json,
    write_map,
)

READERS: dict[str, Callable[..., object]] = {
    "x.png": read_image,
    "size.png": image_size,
    "depth.png": read_depth_png,
    "disparity.png": read_depth_png,
    "x.npy": read_map,
    "x.pfm": read_map,
    "x.ply": read_cloud,
    "x.pcd": read_cloud,
    "cloud.npy": read_cloud,
    "x.xyz": read_cloud,
    "x.bin": read_points_bin,
    "x.json": read_json,
    "calib.txt": read_key_values,
    "text.txt": read_text,
}


def npy(array: object, **options: bool) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.asarray(array), **options)
    return stream.getvalue()


def npy_header(descr: str, shape: str) -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
    text = text.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def picture(mode: str, form: str = "PNG") -> bytes:
    stream = io.BytesIO()
    Image.new(mode, (4, 3)).save(stream, form)
    return stream.getvalue()


def bomb(width: int, height: int) -> bytes:
    """Make a PNG that declares any size."""
    good = bytearray(picture("RGB"))
    good[16:24] = struct.pack(">II", width, height)
    good[29:33] = struct.pack(">I", zlib.crc32(good[12:29]))
    return bytes(good)


PLY = "ply\nformat ascii 1.0\nelement vertex 1\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"
RGB = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
BINARY_PLY = PLY.replace("ascii", "binary_little_endian")
PCD = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
LZF = f"{PCD}POINTS 1\nDATA binary_compressed\n".encode()
NAN = npy([[np.nan, 1, 2]])

BAD: list[tuple[str, str | bytes, str]] = [
    ("x.png", b"", r"x\.png: not a readable picture .*; give an intact PNG or JPEG"),
    ("x.png", b"hello", r"cannot identify image file\); give an intact PNG or JPEG"),
    ("x.png", picture("RGB")[:45], "not a readable picture"),
    ("x.png", bomb(60000, 60000), "not a readable picture .*decompression bomb"),
    ("x.png", bomb(9000, 9000), "declares 9000x9000 pixels, more than the 33554432 allowed"),
    ("size.png", bomb(9000, 9000), "scale it down"),
    ("x.tif", picture("F", "TIFF"), "32 bits a pixel; save it with 8 or 16 bits a channel"),
    ("depth.png", picture("L"), "a PNG of mode L, where .* a 16-bit greyscale PNG; an 8-bit"),
    ("depth.png", picture("RGB"), "a PNG of mode RGB, .* is a picture of it, not the data"),
    ("disparity.png", picture("L", "JPEG"), "a JPEG of mode L"),
    ("x.npy", b"\x93NUMPY\x01", "not a readable NPY file .*; save it again with numpy.save"),
    ("x.npy", npy(np.ones((2, 2), np.int64)), "int64, not float16, 32 or 64; save floats in the"),
    ("x.npy", npy(np.array([{}]), allow_pickle=True), "holds object, not float16"),
    ("x.npy", npy(np.ones(3)), r"a map is \(H, W\), got \(3,\)"),
    ("x.npy", npy(np.ones((0, 3))), r"a map is \(H, W\), got \(0, 3\)"),
    ("x.npy", npy([[np.inf, 1]]), "holds infinity; mark invalid pixels by NaN"),
    ("x.npy", npy([[1e300, 1]]), "holds infinity"),
    ("x.npy", npy(np.ones((2, 2)))[:-1], r"declares float64 \(2, 2\) but 31 bytes follow"),
    ("x.npy", npy_header("'<f4'", "(1000000, 1000000)"), "but 0 bytes follow; it is truncated"),
    ("x.npy", npy_header("'<f4'", "(-1, -1)") + b"1234", "but 4 bytes follow"),
    ("x.npy", b"PK\x03\x04" + bytes(40), "not a readable NPY file"),
    ("x.tiff", b"", r"x\.tiff: \.tiff is no map format; use \.npy, \.pfm"),
    ("x.pfm", "P5\n2 2\n255\n", r"no PFM header \('Pf', width, height, scale\)"),
    ("x.pfm", "PF\n1 1\n-1\n" + " " * 12, r"a colour PFM \(PF\), not a map"),
    ("x.pfm", "Pf\n1 1\n0\n" + " " * 4, r"PFM scale 0\.0; its sign gives the byte order"),
    ("x.pfm", "Pf\n1 1\n1.2.3\n" + " " * 4, "not a readable PFM scale"),
    ("x.pfm", "Pf\n99999999 99999999\n-1\n", "declares 99999999x99999999 floats but 0 bytes"),
    ("x.pfm", "Pf\n0 1\n-1\n", "declares 0x1 floats"),
    ("x.ply", "solid", r"no PLY header \('ply' \.\.\. 'end_header'\)"),
    ("x.ply", f"{PLY}{XYZ}end_header\n", "declares 1 points but 0 rows follow; it is truncated"),
    ("x.ply", f"{PLY}{XYZ}end_header\n1 2\n", "rows of 2 values where 3 are declared"),
    ("x.ply", f"{PLY}{XYZ}end_header\n1 2 z\n", "not a readable table of numbers"),
    ("x.ply", f"{PLY}{XYZ}end_header\n1 2 inf\n", "a coordinate is infinite or beyond float32"),
    ("x.ply", f"{PLY}{XYZ}end_header\n1 2 1e99\n", "a coordinate is infinite or beyond float32"),
    ("x.ply", f"{PLY}{XYZ}end_header\n1 2 nan\n", "1 points, none with finite coordinates"),
    ("x.ply", f"{PLY}{XYZ[17:]}end_header\n1 2\n", r"no \['x'\] among the columns \['y', 'z'\]"),
    ("x.ply", f"{PLY}{XYZ}{RGB}end_header\n1 2 3 256 0 0\n", "'red' holds a value outside uint8"),
    (
        "x.ply",
        f"{PLY}{XYZ}{RGB.replace('uchar', 'float')}end_header\n1 2 3 255 0 0\n",
        r"colours beyond \[0, 1\]; store floats in \[0, 1\], or uchar",
    ),
    ("x.ply", f"{BINARY_PLY}{XYZ}end_header\n1234", "declares 1 points of 12 bytes but 4 follow"),
    ("x.ply", f"{BINARY_PLY}end_header\n", r"vertex properties \[\] are none"),
    ("x.ply", f"{PLY}property half x\nend_header\n", "header line 'property half x' is not under"),
    ("x.ply", "ply\nelement vertex 1\nend_header\n", "the PLY header names no format"),
    ("x.ply", "ply\nformat ascii 1.0\nend_header\n", "where exactly one 'vertex' is needed"),
    (
        "x.ply",
        f"{PLY}{XYZ}{XYZ}end_header\n",
        "are none, a list or repeat a name; give each vertex",
    ),
    (
        "x.ply",
        f"{BINARY_PLY}property list uchar int i\nend_header\n",
        r"vertex properties \['i'\] are none, a list or",
    ),
    ("x.ply", f"{BINARY_PLY[:-2]}999999999999\n{XYZ}end_header\n", "bytes but 0 follow"),
    ("x.pcd", "FIELDS x y z\n", r"no PCD header \('FIELDS' \.\.\. 'DATA'\)"),
    (
        "x.pcd",
        "FIELDS x\nSIZE 3\nTYPE F\nDATA ascii\n",
        "is not understood; save it as version 0.7",
    ),
    ("x.pcd", f"{PCD}DATA ascii\n", "says no number of POINTS"),
    ("x.pcd", f"{PCD}POINTS 2\nDATA ascii\n1 2 3\n", "declares 2 points but 1 rows follow"),
    ("x.pcd", f"{PCD}POINTS 9999999999\nDATA binary\n", "declares 9999999999 points of"),
    ("x.pcd", PCD.replace("y", "x") + "POINTS 1\nDATA ascii\n1 2 3\n", "repeat a name; keep one"),
    ("x.pcd", LZF, "the two compressed sizes of 8 bytes but 0 follow"),
    ("x.pcd", LZF + struct.pack("<II", 9, 12), "compressed points of 9 bytes but 0 follow"),
    ("x.pcd", LZF + struct.pack("<II", 1, 2**32 - 1) + b"1", "where the header needs 12"),
    ("x.pcd", LZF + struct.pack("<II", 2, 12) + b"\xe0\x00", "end in the middle of a reference"),
    ("x.pcd", LZF + struct.pack("<II", 2, 12) + b"\x20\x00", "refer to before their beginning"),
    ("x.pcd", LZF + struct.pack("<II", 2, 12) + b"\x00a", "do not unpack to 12; save it as DATA"),
    ("cloud.npy", npy(np.ones((4, 2))), r"rows of 3 numbers or more, got shape \(4, 2\)"),
    ("cloud.npy", NAN, "1 points, none with finite coordinates"),
    ("x.xyz", "", r"points are rows of 3 numbers or more, got shape \(0, 0\)"),
    ("x.xyz", "1 2 3\n4 5\n", "give every row as many values, with decimal points"),
    ("x.obj", "", r"\.obj is no point cloud format; use \.ply, \.pcd, \.npy, \.xyz, \.txt"),
    ("x.bin", b"", "0 bytes are no whole number of rows of 4 float32"),
    ("x.bin", bytes(17), "17 bytes are no whole number of rows of 4 float32; it is empty"),
    ("x.bin", struct.pack("<4f", 0, 0, np.nan, 0), "holds NaN or infinity; it is damaged"),
    ("x.json", "{", "not a readable JSON file .*; correct it there"),
    ("x.json", '{"a": NaN}', "NaN is not a JSON number"),
    ("x.json", '{"a": -Infinity}', "-Infinity is not a JSON number"),
    ("x.json", "[1e999]", "1e999|inf.* is not a JSON number"),
    ("x.json", '{"a": 1, "a": 2}', "key 'a' is given twice"),
    ("x.json", "[" * 200_000, "not a readable JSON file .*RecursionError"),
    ("x.json", "9" * 5000, "not a readable JSON file"),
    ("x.json", b"\xff\xfe", r"not UTF-8 text \(byte 0: .*\); save it as UTF-8"),
    ("calib.txt", "P2: 1\nP2: 2\n", "line 2 gives 'P2' again; keep one of them"),
    ("calib.txt", "P2 1 2 3\n", "line 1, 'P2 1 2 3', is not 'KEY: numbers'"),
    ("calib.txt", "P2: 1 nan\n", "line 1, 'P2', holds NaN or infinity"),
    ("text.txt", b"\x80", "not UTF-8 text"),
]


@pytest.mark.parametrize(("name", "content", "said"), BAD)
def test_bad_content_is_named(tmp_path: Path, name: str, content: str | bytes, said: str) -> None:
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    by_suffix = {".tif": read_image, ".tiff": read_map, ".obj": read_cloud}
    reader = READERS.get(name) or by_suffix[path.suffix]
    with pytest.raises(InputError, match=said) as caught:
        reader(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_file_is_named(tmp_path: Path, name: str) -> None:
    reader = READERS[name]
    with pytest.raises(InputError, match=rf"{name}: no such file; check the path"):
        reader(tmp_path / name)
    (tmp_path / name).mkdir()
    with pytest.raises(InputError, match=rf"{name}: a folder where a file is needed"):
        reader(tmp_path / name)
    with pytest.raises(InputError, match="not a file name: embedded null byte"):
        reader(f"a\0{Path(name).suffix}")
    with pytest.raises(InputError, match=r"cannot be read: .*File name too long"):
        reader("a" * 999 + Path(name).suffix)


def test_a_device_is_not_read() -> None:
    with pytest.raises(InputError, match="/dev/zero: a device or pipe; save its content"):
        read_image("/dev/zero")


@pytest.mark.parametrize("unit_m", [0.0, -1.0, float("nan"), float("inf")])
def test_a_unit_is_positive(tmp_path: Path, unit_m: float) -> None:
    said = f"a unit of {unit_m} is not positive"
    with pytest.raises(InputError, match=said):
        read_depth_png(tmp_path / "x.png", unit_m)
    with pytest.raises(InputError, match=said):
        write_depth_png(tmp_path / "x.png", torch.ones(1, 1), unit_m)


IMAGE = torch.zeros(3, 2, 2)
BAD_WRITES: list[tuple[Callable[[Path], None], str]] = [
    (lambda p: write_image(p / "x.gif", IMAGE), r"\.gif is no picture format; use \.png, \.jpg"),
    (lambda p: write_image(p / "x", IMAGE), "no suffix is no picture format"),
    (
        lambda p: write_image(p / "x.png", IMAGE.mT[:2]),
        r"must have shape \(3, H, W\), got \(2, 2, 2\)",
    ),
    (lambda p: write_image(p / "x.png", IMAGE[:, :0]), r"is empty: shape \(3, 0, 2\)"),
    (lambda p: write_image(p / "x.png", IMAGE.byte()), r"got torch\.uint8; divide by 255"),
    (lambda p: write_image(p / "x.png", IMAGE / 0), "holds NaN or infinite"),
    (lambda p: write_image(p / "x.png", IMAGE + 255), r"must lie in \[0, 1\], got 255 \.\. 255"),
    (lambda p: write_depth_png(p / "x.png", IMAGE[0, :0]), r"an empty map \(0, 2\) makes no PNG"),
    (lambda p: write_map(p / "x.npy", IMAGE[0] + torch.inf), "mark invalid pixels by NaN"),
    (lambda p: write_map(p / "x.tif", IMAGE[0]), r"\.tif is no map format"),
    (
        lambda p: write_cloud(p / "x.obj", PointCloud(points=IMAGE[:, 0].new_ones(1, 3))),
        "use .ply, .pcd",
    ),
    (
        lambda p: write_cloud(p / "x.ply", PointCloud(points=torch.ones(1, 3) / 0)),
        "NaN or infinity",
    ),
    (lambda p: write_json(p / "x.json", float("nan")), "cannot be written as JSON: .*; use null"),
    (lambda p: write_json(p / "x.json", {"a": {1, 2}}), "cannot be written as JSON: .* set"),
    (lambda _: write_json("/proc/none/x.json", {}), r"/proc/none/x\.json: cannot be written"),
]


@pytest.mark.parametrize(("write", "said"), BAD_WRITES)
def test_bad_writes_are_named_and_leave_nothing(
    tmp_path: Path, write: Callable[[Path], None], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        write(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("pattern", ["a\0*", "a**b/*.png"])
def test_a_pattern_that_is_none(pattern: str) -> None:
    with pytest.raises(InputError, match=r"cannot be listed|file there"):
        list_images(pattern)
