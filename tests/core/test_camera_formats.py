"""Camera files of other people: what each says; distortion is never ignored."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from depthpose.core.camera import Camera, StereoRig, read_camera, read_rig, resize_camera
from depthpose.core.errors import InputError, Notice

SIZE = (640, 480)
ROS = """image_width: 640
image_height: 480
camera_name: narrow
camera_matrix: {{rows: 3, cols: 3, data: [500, 0, 320, 0, 501, 240, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {distortion}}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix:
  rows: 3
  cols: 4
  data: [490, 0, {cx}, {Tx}, 0, 491, 241, 0, 0, 0, 1, 0]
"""
ECHO = """header:
  frame_id: left
height: 480
width: 640
distortion_model: plumb_bob
d: [0.0, 0.0]
k: [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [500.0, 0.0, 320.0, -30.0, 0.0, 501.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
---
"""
ORB = """%YAML:1.0
# Camera Parameters
Camera.fx: 535.4
Camera.fy: 539.2
Camera.cx: 320.1
Camera.cy: 247.6
Camera.k1: {k1}
Camera.width: 640
Camera.height: 480
Camera.bf: 40.0
{factor}
"""
P2 = "P2: 700 0 310 35 0 700 240 0 0 0 1 0\n"
P3 = "P3: 700 0 312 -315 0 700 240 0 0 0 1 0\n"
MIDDLEBURY = (
    "cam0=[700 0 310; 0 700 240; 0 0 1]\ncam1=[700 0 320; 0 700 240; 0 0 1]\ndoffs=10\n"
    "baseline=193\nwidth=640\nheight=480\nndisp=70\n"
)
BOP = {"cx": 320.5, "cy": 240.5, "depth_scale": 0.1, "fx": 500, "fy": 501, "width": 640}
SCENE = {str(n): {"cam_K": [500, 0, 320, 0, 501, 240, 0, 0, 1], "depth_scale": 1} for n in (0, 7)}


FLAT = [500, 0, 320, 0, 501, 240, 0, 0, 1]
OPEN3D = {"width": 640, "height": 480, "intrinsic_matrix": [500, 0, 0, 0, 501, 0, 320, 240, 1]}
REALSENSE = {"width": 640, "height": 480, "fx": 500, "fy": 501, "ppx": 320, "ppy": 240}
ROSBRIDGE = {"width": 640, "height": 480, "distortion_model": "plumb_bob",
             "P": [500, 0, 320, -30, 0, 501, 240, 0, 0, 0, 1, 0]}  # fmt: skip


def ros(distortion: object = (0, 0, 0, 0, 0), Tx: float = 0, cx: float = 321) -> str:
    return ROS.format(distortion=list(distortion), Tx=Tx, cx=cx)  # pyright: ignore[reportArgumentType]


def orb(k1: float = 0.0, factor: str = "") -> str:
    return ORB.format(k1=k1, factor=factor)


# Content, (fx, fy, cx, cy), then baseline, difference of the principal points and metres a unit.
READ: dict[str, tuple[str, tuple[float, ...], tuple[float | None, ...]]] = {
    "KITTI": (P2 + P3 + "R0_rect: 1 0 0 0 1 0 0 0 1\n", (700, 700, 310, 240), (0.5, 2, None)),
    "KITTI raw": (
        "calib_time: 09-Jan-2012 13:57:47\nS_rect_02: 6.4e+02 4.8e+02\n"
        + (P2 + P3).replace("P2", "P_rect_02").replace("P3", "P_rect_03"),
        (700, 700, 310, 240),
        (0.5, 2, None),
    ),
    "KITTI, one camera": (P2, (700, 700, 310, 240), (None, None, None)),
    "Middlebury": (MIDDLEBURY, (700, 700, 310, 240), (0.193, 10, None)),
    "lines": ("focal_px: 700\ncx: 310\ncy: 240\nbaseline_m: 0.1\n", (700, 700, 310, 240),
              (0.1, 0, None)),
    "fx fy cx cy": ("# my camera\n525.0 526.0 319.5 239.5\n", (525, 526, 319.5, 239.5),
                    (None, None, None)),
    "TUM": ("535.4 539.2 320.1 247.6", (535.4, 539.2, 320.1, 247.6), (None, None, 1 / 5000)),
    "without distortion": ("525 526 319.5 239.5 0 0 0 0 0", (525, 526, 319.5, 239.5),
                           (None, None, None)),
    "matrix": ("500 0 320\n0 501 240\n0 0 1\n", (500, 501, 320, 240), (None, None, None)),
    "matrix and baseline": ("500 0 320 0 501 240 0 0 1\n0.12\n", (500, 501, 320, 240),
                            (0.12, 0, None)),
    "matrix of four columns": ("500 0 320 0\n0 501 240 0\n0 0 1 0\n", (500, 501, 320, 240),
                               (None, None, None)),
    "projection": ("500 0 320 -60 0 501 240 0 0 0 1 0", (500, 501, 320, 240), (0.12, 0, None)),
    "matrix of 16": ("500 0 320 0 0 501 240 0 0 0 1 0 0 0 0 1", (500, 501, 320, 240),
                     (None, None, None)),
    "BOP, one image": (json.dumps({"cam_K": FLAT, "depth_scale": 0.1}), (500, 501, 320, 240),
                       (None, None, 0.0001)),
    "BOP and a baseline": (json.dumps({**BOP, "height": 480, "baseline_m": 0.05}),
                           (500, 501, 320.5, 240.5), (0.05, 0, 0.0001)),
    "RealSense and a baseline": (json.dumps({**REALSENSE, "baseline_m": 0.05}),
                                 (500, 501, 320, 240), (0.05, 0, None)),
    "ROS echo, twice": (ECHO + ECHO, (500, 501, 320, 240), (0.06, 0, None)),
    "BOP": (json.dumps({**BOP, "height": 480}), (500, 501, 320.5, 240.5), (None, None, 0.0001)),
    "BOP scene": (json.dumps(SCENE), (500, 501, 320, 240), (None, None, 0.001)),
    "Middlebury, commas": (
        MIDDLEBURY.replace(" 0", ", 0").replace("cam0=", "cam0 = ").replace("640", "640.0"),
        (700, 700, 310, 240), (0.193, 10, None)),
    "flat K": (json.dumps({"width": 640.0, "height": 480, "K": FLAT}), (500, 501, 320, 240),
               (None, None, None)),
    "K alone in JSON": (json.dumps([FLAT[:3], FLAT[3:6], FLAT[6:]]), (500, 501, 320, 240),
                        (None, None, None)),
    "Open3D": (json.dumps(OPEN3D), (500, 501, 320, 240), (None, None, None)),
    "Open3D, parameters": (
        json.dumps({"class_name": "PinholeCameraParameters", "intrinsic": OPEN3D}),
        (500, 501, 320, 240), (None, None, None)),
    "RealSense": (json.dumps({**REALSENSE, "coeffs": [0] * 5, "depth_scale": 0.001}),
                  (500, 501, 320, 240), (None, None, 0.001)),
    "COLMAP": ("# Camera list\n1 PINHOLE 640 480 500 501 320.5 240.5\n", (500, 501, 320, 240),
               (None, None, None)),
    "COLMAP, one focal length": ("3 SIMPLE_RADIAL 640 480 500 320.5 240.5 0\n",
                                 (500, 500, 320, 240), (None, None, None)),
    "ROS in JSON": (json.dumps({**ROSBRIDGE, "K": FLAT, "D": [0] * 5}), (500, 501, 320, 240),
                    (0.06, 0, None)),
    "ROS": (ros(), (490, 491, 321, 241), (None, None, None)),
    "ROS right": (ros(Tx=-49), (490, 491, 321, 241), (0.1, 0, None)),
    "ROS echo": (ECHO, (500, 501, 320, 240), (0.06, 0, None)),
    "ORB-SLAM stereo": (orb(), (535.4, 539.2, 320.1, 247.6), (40 / 535.4, 0, None)),
    "ORB-SLAM RGB-D": (orb(factor="DepthMapFactor: 5000.0"), (535.4, 539.2, 320.1, 247.6),
                       (None, None, 0.0002)),
}  # fmt: skip


def saved(folder: Path, text: str, name: str = "camera.any") -> Path:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def pinhole(camera: Camera) -> tuple[float, ...]:
    return tuple(float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))


RIGHT_ALONE = pytest.mark.filterwarnings("ignore:a camera_info of ROS. it is the right one alone")


@RIGHT_ALONE
@pytest.mark.parametrize("name", READ)
def test_a_format_is_recognised_by_its_content(tmp_path: Path, name: str) -> None:
    text, lengths, more = READ[name]
    camera = read_camera(saved(tmp_path, text), SIZE)
    assert (camera.width, camera.height) == SIZE
    assert pinhole(camera) == pytest.approx(lengths)
    rig = (camera.baseline_m, camera.cx_right_minus_left_px) if isinstance(camera, StereoRig) else (
        None, None)  # fmt: skip
    assert (*rig, camera.depth_unit_m) == pytest.approx(more)


@pytest.mark.parametrize("name", ["KITTI raw", "Middlebury", "TUM", "BOP", "ROS", "ORB-SLAM RGB-D"])
def test_these_say_the_size_themselves(tmp_path: Path, name: str) -> None:
    camera = read_camera(saved(tmp_path, READ[name][0]))
    assert (camera.width, camera.height) == SIZE


@pytest.mark.parametrize("name", ["KITTI", "fx fy cx cy", "matrix", "BOP scene"])
def test_these_do_not_and_it_is_asked_for(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="without the image's size; give it beside the image"):
        read_camera(saved(tmp_path, READ[name][0]))


def test_a_pair_of_ros_is_a_folder_recognised_by_its_content(tmp_path: Path) -> None:
    saved(tmp_path, ros(), "z.yaml")
    saved(tmp_path, ros(Tx=-49, cx=325), "a.yaml")
    rig = read_rig(tmp_path)
    assert (rig.baseline_m, rig.cx_right_minus_left_px) == pytest.approx((0.1, 4))
    assert pinhole(rig) == (490, 491, 321, 241)
    saved(tmp_path, ros(Tx=-49), "z.yaml")
    with pytest.raises(InputError, match=r"have Tx -49 and -49, where that of the right one"):
        read_rig(tmp_path)
    saved(tmp_path, ros(), "b.yml")
    with pytest.raises(InputError, match=r"a folder with 3 files .* left\.yaml and right\.yaml"):
        read_camera(tmp_path)


def test_a_pair_of_ros_may_be_counted_from_a_third_camera(tmp_path: Path) -> None:
    saved(tmp_path, ros(Tx=49 * 0.3), "left.yaml")
    saved(tmp_path, ros(Tx=-49 * 0.7), "right.yaml")
    assert read_rig(tmp_path).baseline_m == pytest.approx(0.1)
    alone = tmp_path / "right.yaml"
    with pytest.warns(
        Notice, match=r"alone, whose Tx gives a baseline of 0\.07 m: that of the pair"
    ):
        read_rig(alone)


def test_exchanged_cameras_are_asked_about(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"baseline_m is -0\.1, .* left and right exchanged"):
        read_rig(saved(tmp_path, ros(Tx=49)))


BENT: dict[str, tuple[str, str]] = {
    "ROS": (ros((-0.3, 0.1, 0, 0, 0)), r"cv2\.undistort\(image, K, distortion, None, P\[:, :3\]\)"),
    "ROS pair": (ros((-0.3, 0.1, 0, 0, 0), Tx=-49), r"cv2\.initUndistortRectifyMap"),
    "TUM": ("517.3 516.5 318.6 255.3 0.2624 -0.9531 -0.0054 0.0026 1.1633", r"cv2\.undistort\("),
    "ORB-SLAM": (orb(k1=0.26), r"cv2\.undistort\(image, K, distortion\)"),
    "RealSense": (json.dumps({**REALSENSE, "coeffs": [0.1, 0, 0, 0, 0]}), r"cv2\.undistort\("),
    "BOP": (json.dumps({**BOP, "height": 480, "k1": 0.1}), r"cv2\.undistort\("),
    "COLMAP": ("1 RADIAL 640 480 500 320 240 0.1 0.2\n", "colmap image_undistorter"),
    "loose": ("camera_matrix: [[500, 0, 320], [0, 500, 240], [0, 0, 1]]\nk1: -0.2", "-0.2"),
    "named": (
        "camera_matrix: [500, 0, 320, 0, 500, 240, 0, 0, 1]\ndistortion_parameters: {k1: 0.1}",
        "0.1",
    ),
    "fisheye": (
        "K: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nD: [0.1, 0, 0, 0]\ndistortion_model: equidistant",
        r"cv2\.fisheye\.undistortImage",
    ),
}


@pytest.mark.parametrize("name", BENT)
def test_distortion_is_an_error_with_the_camera_of_the_remedy(tmp_path: Path, name: str) -> None:
    text, how = BENT[name]
    with pytest.raises(InputError, match=f"lens distortion .*{how}") as caught:
        read_camera(saved(tmp_path, text), SIZE)
    remedy = str(caught.value).partition("camera of the result: ")[2]
    camera = read_camera(saved(tmp_path, remedy, "camera.json"))
    assert (camera.width, camera.height) == SIZE
    assert isinstance(camera, StereoRig) == (name in ("ROS pair", "ORB-SLAM"))


WRONG: dict[str, tuple[str, str]] = {
    "no camera": ("hello: world\n", r"no camera that is known; it begins with 'hello: world'\. K"),
    "prose": ("It was a dark: and stormy: night", "not a readable camera file .* known are our J"),
    "bytes": ("\x00\x01", "not a readable camera file"),
    "reference": ("a: &a [1]\nK: &k [*k]\n", r"refers to itself \(\*k\)"),
    "entity": ("<!DOCTYPE x [<!ENTITY a 'b'>]><opencv_storage/>", "XML with declarations"),
    "other XML": ("<html><body/></html>", "no camera that is known"),
    "NaN": ("K: [.nan, 0, 1, 0, 1, 1, 0, 0, 1]", "holds NaN or infinity; calibrate again"),
    "P3 short": (P2 + "P3: 1 2 3\n", "P3 holds 3 numbers instead of 12"),
    "several cameras": (
        json.dumps({**SCENE, "9": {"cam_K": [1] * 9}}),
        "whose 3 images have several cameras",
    ),
    "another fx": (P2 + P3.replace("700", "800"), "fx of the left camera is 700 and of the right"),
    "another cy": (P2 + P3.replace("240", "243"), "cy of the left camera is 240 .* right one 243"),
    "centimetres": (
        P2.replace("35", "0") + P3.replace("-315", "-4200"),
        r"baseline_m is 6, .* centimetres; divide by 100 \(0\.06\)",
    ),
    "squares": (
        P2.replace("35", "0") + P3.replace("-315", "-3360"),
        r"baseline_m is 4\.8, .* squares of the calibration board",
    ),
    "doffs": (MIDDLEBURY.replace("doffs=10", "doffs=0"), "doffs is 0, but cx of cam1 .* is 10"),
    "Middlebury in metres": (MIDDLEBURY.replace("=193", "=0.193"), "in metres, write 193"),
    "squeezed": ("500 0 320 0 1000 240 0 0 1", "fx 500 and fy 1000, as if pixels were 2 times"),
    "far too long": ("500000 0 320 0 500000 240 0 0 1", "sees less than 0.3 degrees"),
    "ZED": ("[LEFT_CAM_HD]\nfx=699\nfy=699\n", "factory calibration of a ZED, .* SDK"),
    "several of COLMAP": ("1 PINHOLE 9 9 5 5 4 4\n2 PINHOLE 9 9 6 6 4 4\n", "2 different cameras"),
    "NeRF": (
        json.dumps({"fl_x": 500, "frames": []}),
        "no camera that is known; its keys are 'fl_x'",
    ),
    "window": (
        ECHO.replace("---", "roi: {x_offset: 400, y_offset: 0, width: 320, height: 9}"),
        r"its roi, 320x9 at \(400, 0\), leaves the image of 640x480",
    ),
    "one above the other": (
        P2 + "P3: 700 0 310 35 0 700 240 -300 0 0 1 0\n",
        "one above the other; turn the images by 90 degrees",
    ),
    "turned pair": (
        "K: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nT: [-0.1, 0.02, 0]",
        r"not rectified, and no P1 and P2; rectify the images by 'depthpose data rectify'",
    ),
    "units a metre": (
        json.dumps({**BOP, "height": 480, "depth_scale": 5000000}),
        r"depth_unit_m is 5000, which looks like units a metre; .*: write 0\.0002",
    ),
    "half the size": (
        "260 260 160 120",
        r"\(160, 120\) lies far off the centre of the image of 640x480: K looks like that of about "
        r"32\dx24\d\. Multiply fx, fy, cx and cy by (2|1\.99)",
    ),
    "distortion in words": (
        "K: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nD: '[-0.3, 0.1]'",
        "its d are no list of numbers; write",
    ),
    "transposed": ("500 0 0\n0 500 0\n320 240 1\n", "it looks transposed"),
    "a baseline of some unit": (
        json.dumps({**REALSENSE, "baseline": 50}),
        "its 'baseline' may be in any unit; write basel",
    ),
    "two messages": (
        ECHO + ECHO.replace("500", "400"),
        "describes several cameras, one after the other",
    ),
    "level pair of two lengths": (
        "K1: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nK2: [540, 0, 320, 0, 540, 240, 0, 0, 1]\n"
        "T: [-0.1, 0, 0]",
        "fx of the left camera is 500 and of the right one 540",
    ),
    "no centre": ("500 500 0 0", r"lies in the corner .* take the centre, \(319\.5, 239\.5\)"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_a_camera_says_why(tmp_path: Path, name: str) -> None:
    text, said = WRONG[name]
    path = saved(tmp_path, text)
    with pytest.raises(InputError, match=said) as caught:
        read_camera(path, SIZE)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_rectified_pair_without_projections_is_a_rig(tmp_path: Path) -> None:
    text = "K1: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nT: [-0.1, 0, 0]"
    assert read_rig(saved(tmp_path, text), SIZE).baseline_m == 0.1
    text += "\nK2: [500, 0, 331, 0, 500, 240, 0, 0, 1]"
    assert read_rig(saved(tmp_path, text), SIZE).cx_right_minus_left_px == 11


@pytest.fixture(scope="module")
def stereo() -> dict[str, np.ndarray]:
    """What OpenCV makes of a slightly turned pair."""
    cv2 = pytest.importorskip("cv2")
    K1 = np.array([[500.0, 0, 322], [0, 502, 241], [0, 0, 1]])
    K2 = np.array([[505.0, 0, 318], [0, 503, 239], [0, 0, 1]])
    R, _ = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))
    T, D = np.array([[-0.12], [0.002], [0.001]]), np.zeros((1, 5))
    R1, R2, first, second, Q, *_ = cv2.stereoRectify(K1, D, K2, D, SIZE, R, T, flags=0)
    return {"M1": K1, "D1": D, "M2": K2, "D2": D, "R": R, "T": T,
            "R1": R1, "R2": R2, "P1": first, "P2": second, "Q": Q}  # fmt: skip


def stored(path: Path, matrices: dict[str, Any]) -> Path:
    cv2 = pytest.importorskip("cv2")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in matrices.items():
        storage.write(name, value)
    storage.release()
    return path


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_what_opencv_writes_is_read(
    tmp_path: Path, stereo: dict[str, np.ndarray], suffix: str
) -> None:
    projected = {name: stereo[name] for name in ("R", "T", "R1", "R2", "P1", "P2")}
    rig = read_rig(stored(tmp_path / f"extrinsics{suffix}", projected), SIZE)
    first, second = stereo["P1"], stereo["P2"]
    assert rig.baseline_m == pytest.approx(-second[0, 3] / second[0, 0])
    assert rig.baseline_m == pytest.approx(float(np.linalg.norm(stereo["T"])))
    assert rig.K.numpy() == pytest.approx(first[:, :3])
    assert rig.cx_right_minus_left_px == pytest.approx(second[0, 2] - first[0, 2])
    mono = {"image_width": 640, "image_height": 480, "camera_matrix": stereo["M1"],
            "distortion_coefficients": stereo["D1"]}  # fmt: skip
    camera = read_camera(stored(tmp_path / f"camera{suffix}", mono))
    assert type(camera) is Camera
    assert camera.K.numpy() == pytest.approx(stereo["M1"])
    assert (camera.width, camera.height) == SIZE


def test_q_says_the_same_as_the_projections(tmp_path: Path, stereo: dict[str, np.ndarray]) -> None:
    by_q = read_rig(stored(tmp_path / "q.yml", {"Q": stereo["Q"]}), SIZE)
    both = {"P1": stereo["P1"], "P2": stereo["P2"]}
    by_p = read_rig(stored(tmp_path / "p.yml", both), SIZE)
    assert torch.allclose(by_q.K, by_p.K)
    assert by_q.baseline_m == pytest.approx(by_p.baseline_m)
    assert by_q.cx_right_minus_left_px == pytest.approx(by_p.cx_right_minus_left_px, abs=1e-9)


def test_the_two_files_of_opencvs_calibration_are_a_folder(
    tmp_path: Path, stereo: dict[str, np.ndarray]
) -> None:
    inner = {name: stereo[name] for name in ("M1", "D1", "M2", "D2")}
    stored(tmp_path / "intrinsics.yml", inner)
    stored(tmp_path / "extrinsics.yml", {k: v for k, v in stereo.items() if k not in inner})
    assert read_rig(tmp_path, SIZE).K.numpy() == pytest.approx(stereo["P1"][:, :3])
    stored(tmp_path / "intrinsics.yml", {**inner, "D2": np.array([[0.1, 0, 0, 0, 0]])})
    with pytest.raises(InputError, match=r"lens distortion .*cv2\.initUndistortRectifyMap"):
        read_rig(tmp_path, SIZE)


@pytest.mark.parametrize("key", ["K", "camera_matrix"])
def test_yaml_takes_the_keys_of_our_json_too(tmp_path: Path, key: str) -> None:
    K = "[300, 0, 320, 0, 300, 240, 0, 0, 1]"
    text = f"width: 640\nheight: 480\n{key}: {K}\nbaseline_m: 0.12\n"
    path = tmp_path / "rig.yaml"
    path.write_text(f"{text}cx_right_minus_left_px: 4.5\ndepth_unit_m: 0.001\n")
    rig = read_rig(path)
    assert (rig.baseline_m, rig.cx_right_minus_left_px, rig.depth_unit_m) == (0.12, 4.5, 0.001)
    path.write_text(text.replace("0.12", "wide"))
    with pytest.raises(InputError, match=r"baseline_m is 'wide'; write a number"):
        read_rig(path)
    path.write_text(f"{text}baseline_m: 0.2\n")
    with pytest.raises(InputError, match="key 'baseline_m' is given twice"):
        read_rig(path)


@RIGHT_ALONE
def test_a_camera_of_ros_is_that_of_the_window_and_binning(tmp_path: Path) -> None:
    window = "roi: {x_offset: 100, y_offset: 40, width: 320, height: 240, do_rectify: false}"
    cut = read_rig(saved(tmp_path, ECHO.replace("---", window)))
    assert (cut.width, cut.height) == (320, 240)
    assert pinhole(cut) == (500, 501, 220, 200)
    assert cut.baseline_m == pytest.approx(0.06)
    binned = read_rig(saved(tmp_path, ECHO.replace("---", "binning_x: 2\nbinning_y: 2")))
    halved = resize_camera(read_rig(saved(tmp_path, ECHO)), 320, 240)
    assert (binned.width, binned.height) == (320, 240)
    assert torch.allclose(binned.K, halved.K)
    assert binned.baseline_m == pytest.approx(0.06)


def test_a_wide_rig_is_believed_where_its_unit_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="truly this wide is written as ours"):
        read_rig(saved(tmp_path, P2.replace("35", "0") + P3.replace("-315", "-2100")), SIZE)
    ours = {"width": 640, "height": 480, "K": FLAT, "baseline_m": 3}
    assert read_rig(saved(tmp_path, json.dumps(ours))).baseline_m == 3
