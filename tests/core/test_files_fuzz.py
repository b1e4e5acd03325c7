"""Whatever bytes a reader gets, it answers or raises InputError, and allocates no gigabytes."""

import io
import os
import struct
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random, SystemRandom

import numpy as np
import pytest
import torch
from PIL import Image

from depthpose.core.camera import read_camera, read_rig
from depthpose.core.errors import InputError
from depthpose.core.files import (
    PointCloud,
    image_size,
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
    write_map,
)

Reader = Callable[..., object]
TEXT_PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
    b"property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    b"element face 1\nproperty list uchar int i\nend_header\n0 1 2 9 8 7\n3 4 5 6 5 4\n3 0 1 1\n"
)
TEXT_PCD = (
    b"VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\n"
    b"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n0 1 2 255\n3 4 5 65535\n"
)
LZF_PCD = (
    TEXT_PCD[: TEXT_PCD.index(b"ascii")]
    + b"binary_compressed\n"
    + struct.pack("<II", 5, 32)
    + b"\x00\x00\xe0\x16\x00"
)
JSON = b'{"width": 640, "height": 480, "K": [[500, 0, 320], [0, 5e2, 240], [0, 0, 1]], '
CAMERA = JSON + b'"baseline_m": 0.5, "cx_right_minus_left_px": 1.5, "depth_unit_m": 0.001}'
pytestmark = pytest.mark.filterwarnings("ignore::depthpose.core.errors.Notice")

ROS = (
    b"image_width: 640\nimage_height: 480\ndistortion_coefficients: {data: [0.0, 0]}\n"
    b"projection_matrix:\n  rows: 3\n  data: [500, 0, 320, -60.0, 0, 5e2, 240, 0, 0, 0, 1, 0]\n"
)
XML = (
    b'<?xml version="1.0"?>\n<opencv_storage><size>640 480</size><K type_id="opencv-matrix">'
    b"<rows>3</rows><cols>3</cols><dt>d</dt><data>500. 0. 320. 0. 500. 240. 0. 0. 1.</data></K>"
    b"<T>-0.1 0. 0.</T></opencv_storage>\n"
)
MIDDLEBURY = b"cam0=[700 0 310; 0 700 240; 0 0 1]\ndoffs=10\nbaseline=193\nwidth=640\nheight=480\n"
CALIB = b"calib_time: 09-Jan-2012\nP2: 7.2e+02 0 6.1e+02\nP_rect_02: 1 2 3\ncam0=[1 0; 0 1]\n"


def encoded(form: str, mode: str = "RGB", **options: object) -> bytes:
    stream = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 256, (9, 8, 3), dtype=np.uint8)
    Image.fromarray(noise).convert(mode).save(stream, form, **options)
    return stream.getvalue()


def written(write: Callable[..., None], name: str, *what: object) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name, *what)
        return (Path(folder) / name).read_bytes()


def turned_jpeg() -> bytes:
    exif = Image.Exif()
    exif[0x0112] = 6
    return encoded("JPEG", exif=exif.tobytes())


SEEDED = torch.Generator().manual_seed(0)
CLOUD = PointCloud(
    points=torch.rand(3, 3, generator=SEEDED), color=torch.rand(3, 3, generator=SEEDED)
)
CASES: dict[str, tuple[str, tuple[Reader, ...], bytes]] = {
    "png": (".png", (read_image, image_size), encoded("PNG")),
    "palette": (".png", (read_image,), encoded("PNG", "P", transparency=bytes(9))),
    "jpeg": (".jpg", (read_image, image_size), turned_jpeg()),
    "tiff": (".tif", (read_image,), encoded("TIFF")),
    "webp": (".webp", (read_image,), encoded("WEBP")),
    "gif": (".gif", (read_image,), encoded("GIF")),
    "bmp": (".bmp", (read_image,), encoded("BMP")),
    "ppm": (".ppm", (read_image,), encoded("PPM")),
    "depth": (
        ".png",
        (read_depth_png,),
        written(write_depth_png, "x.png", torch.rand(5, 6, generator=SEEDED) * 200),
    ),
    "npy": (
        ".npy",
        (read_map, read_cloud),
        written(write_map, "x.npy", torch.rand(4, 3, generator=SEEDED)),
    ),
    "pfm": (".pfm", (read_map,), written(write_map, "x.pfm", torch.rand(4, 3, generator=SEEDED))),
    "ply": (".ply", (read_cloud,), written(write_cloud, "x.ply", CLOUD)),
    "text ply": (".ply", (read_cloud,), TEXT_PLY),
    "pcd": (".pcd", (read_cloud,), written(write_cloud, "x.pcd", CLOUD)),
    "text pcd": (".pcd", (read_cloud,), TEXT_PCD),
    "packed pcd": (".pcd", (read_cloud,), LZF_PCD),
    "xyz": (".xyz", (read_cloud,), b"# x y z\n1 2 3\n4,5,6\n"),
    "velodyne": (".bin", (read_points_bin,), np.ones((3, 4), "<f4").tobytes()),
    "camera": (".json", (read_camera, read_rig, read_json), CAMERA),
    "ROS camera": (".yaml", (read_camera, read_rig), ROS),
    "OpenCV camera": (".xml", (read_camera, read_rig), XML),
    "Middlebury camera": (".txt", (read_camera, read_rig), MIDDLEBURY),
    "TUM camera": (".txt", (read_camera,), b"535.4 539.2 320.1 247.6 0 0 0 0 0\n"),
    "calibration": (".txt", (read_key_values, read_text), CALIB),
}


def test_the_valid_files_are_valid(tmp_path: Path) -> None:
    for suffix, readers, good in CASES.values():
        path = tmp_path / f"x{suffix}"
        path.write_bytes(good)
        for reader in readers:
            reader(path)


def damaged(good: bytes, random: Random) -> bytes:
    """Random bytes, or a valid file that was cut, flipped, overwritten or lengthened."""
    kind = random.choice(("random", "cut", "flip", "flip", "splice", "number"))
    at = random.randrange(len(good))
    if kind == "random":
        return good[: random.choice((0, 4, 16))] + random.randbytes(random.randint(0, 200))
    if kind == "cut":
        return good[:at]
    if kind == "splice":
        return (
            good[:at] + random.randbytes(random.randint(0, 16)) + good[at + random.randint(0, 16) :]
        )
    if kind == "number":  # sizes are where a few bytes ask for gigabytes
        big = random.choice((b"99999999", b"-1", b"nan", b"1e999", b"\xff" * 4, b"0"))
        return good[:at] + big + good[at + len(big) :]
    data = bytearray(good)
    for _ in range(random.randint(1, 8)):
        data[random.randrange(len(good))] ^= 1 << random.randrange(8)
    return bytes(data)


def fuzz(folder: Path, name: str, seed: str, cases: int) -> None:
    """Read damaged files; the error of one that fails tells how to make it again."""
    resource = pytest.importorskip("resource", reason="a system that says no peak of memory")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    suffix, readers, good = CASES[name]
    path = folder / f"x{suffix}"
    for case in range(cases):
        path.write_bytes(damaged(good, Random(f"{seed} {name} {case}")))
        for reader in readers:
            try:
                reader(path)
            except InputError:
                pass
            except Exception as error:
                error.add_note(f"DEPTHPOSE_SEED={seed}, {name}, case {case}: {reader.__name__}")
                raise
    grown_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown_kib < 1_500_000


@pytest.mark.parametrize("name", CASES)
def test_nothing_but_input_error_escapes(tmp_path: Path, name: str) -> None:
    fuzz(tmp_path, name, "quick", 300)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_nothing_but_input_error_escapes_in_a_long_run(tmp_path: Path, name: str) -> None:
    """Other cases in each run, unless ``DEPTHPOSE_SEED`` names those of an earlier one."""
    seed = os.environ.get("DEPTHPOSE_SEED") or str(SystemRandom().randrange(10**9))
    fuzz(tmp_path, name, seed, 2000)


@pytest.mark.parametrize("name", CASES)
def test_every_truncation_is_read_or_refused(tmp_path: Path, name: str) -> None:
    suffix, readers, good = CASES[name]
    path = tmp_path / f"x{suffix}"
    for length in range(0, len(good), 1 + len(good) // 60):
        path.write_bytes(good[:length])
        for reader in readers:
            with suppress(InputError):
                reader(path)
