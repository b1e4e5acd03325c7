"""The lens that a camera file names is read once, in any format, and not taken for another."""

import json
from pathlib import Path
from typing import Any

import pytest

from depthpose.core.camera import read_camera, read_raw_pair
from depthpose.core.camera.lens import is_fisheye_lens
from depthpose.core.errors import InputError

SIZE = (640, 480)
_K = "K: [500, 0, 320, 0, 500, 240, 0, 0, 1]"
_ORB = "".join(
    f"Camera1.{key}: {value}\n"
    for key, value in {"fx": 400, "fy": 400, "cx": 320, "cy": 240}.items()
)
REALSENSE: dict[str, Any] = {
    "width": 640, "height": 480, "fx": 500, "fy": 500, "ppx": 320, "ppy": 240, "coeffs": [0] * 5
}  # fmt: skip
BOP = {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}
FISHEYES = {
    "ROS, coefficients of 0": f"{_K}\nD: [0, 0, 0, 0]\ndistortion_model: equidistant\n",
    "ROS, as drivers name it": f"{_K}\nD: [0, 0, 0, 0]\ncamera_model: fisheye\n",
    "OpenCV's flag": f"{_K}\nD: [0, 0, 0, 0]\nfisheye_model: 1\n",
    "OpenCV's XML": "<opencv_storage><fisheye_model>1</fisheye_model><K>500 0 320 0 500 240 0 0 1"
    "</K></opencv_storage>",
    "ORB-SLAM": f"Camera.type: KannalaBrandt8\n{_ORB}",
    "COLMAP": "1 OPENCV_FISHEYE 640 480 500 500 320 240 0 0 0 0\n",
    "COLMAP, one focal length": "1 SIMPLE_RADIAL_FISHEYE 640 480 500 320 240 0\n",
    "RealSense": json.dumps({**REALSENSE, "model": "distortion.kannala_brandt4"}),
    "RealSense, by number": json.dumps({**REALSENSE, "model": 5}),
    "BOP": json.dumps({**BOP, "camera_model": "OPENCV_FISHEYE"}),
    "Open3D": json.dumps(
        {"width": 640, "height": 480, "model": "fisheye",
         "intrinsic_matrix": [500, 0, 0, 0, 500, 0, 320, 240, 1]}
    ),
}  # fmt: skip
OTHERS = {
    "MEI by its xi": (f"{_K}\nD: [0, 0, 0, 0]\nxi: 1.2\n", r"xi is 1\.2, .*cv2\.omnidir"),
    "MEI of camodocal": ("model_type: MEI\nmirror_parameters: {xi: 1.2}\n", r"'MEI', .*cv2\.omni"),
    "omnidirectional": (f"{_K}\ncamera_model: omnidirectional\n", r"cv2\.omnidir"),
    "double sphere": (f"{_K}\ndistortion_model: double_sphere\n", "the tool that calibrated it"),
    "panorama": (f"{_K}\nprojection: equirectangular\n", "cut views of a pinhole"),
    "a fisheye of no list": (f"{_K}\ncamera_model: superfisheye\n", "'superfisheye', and only"),
    "a distortion of no list": (f"{_K}\ndistortion_model: wobbly\n", "'wobbly', and only"),
    "FOV of COLMAP": ("1 FOV 640 480 500 500 320 240 0\n", "'colmap image_undistorter'"),
    "RealSense": (json.dumps({**REALSENSE, "model": "distortion.ftheta"}), "distortion.ftheta"),
    "two names": (
        f"{_K}\ncamera_model: fisheye\ndistortion_model: plumb_bob\n",
        "distortion_model 'plumb_bob' and camera_model 'fisheye'; keep the true one",
    ),
}
PINHOLES = {
    "ROS": f"{_K}\nD: [0, 0, 0, 0, 0]\ndistortion_model: plumb_bob\ncamera_model: pinhole\n",
    "OpenCV's flag": f"{_K}\nfisheye_model: 0\n",
    "xi of 0": f"{_K}\nxi: 0\n",
    "ORB-SLAM": f"Camera.type: PinHole\n{_ORB}",
    "ORB-SLAM, rectified": f"Camera.type: Rectified\n{_ORB}",
    "COLMAP": "1 OPENCV 640 480 500 500 320 240 0 0 0 0\n",
    "RealSense": json.dumps({**REALSENSE, "model": "distortion.inverse_brown_conrady"}),
    "the name of a product": json.dumps({**BOP, "model": "OmniVision OV9281"}),
}


def saved(folder: Path, text: str) -> Path:
    path = folder / "camera.any"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", FISHEYES)
def test_a_fisheye_is_no_pinhole_whatever_its_coefficients(tmp_path: Path, name: str) -> None:
    how = "colmap image_undistorter" if "COLMAP" in name else r"cv2\.fisheye\.undistortImage"
    with pytest.raises(InputError, match=f"lens distortion of a fisheye .*{how}"):
        read_camera(saved(tmp_path, FISHEYES[name]), SIZE)


def test_a_pair_of_fisheyes_is_rectified_as_fisheyes(tmp_path: Path) -> None:
    lens = "Camera.k1: 0.1\nCamera.k2: 0.01\nCamera.k3: 0\nCamera.k4: 0\n"
    text = f'Camera.type: "KannalaBrandt8"\n{_ORB}{lens}Stereo.b: 0.12\n'
    with pytest.raises(InputError, match=r"or by cv2\.fisheye\.initUndistortRectifyMap"):
        read_camera(saved(tmp_path, text), SIZE)


@pytest.mark.parametrize("name", OTHERS)
def test_other_lenses_are_refused_by_name_with_what_undistorts_them(
    tmp_path: Path, name: str
) -> None:
    text, said = OTHERS[name]
    with pytest.raises(InputError, match=said):
        read_camera(saved(tmp_path, text), SIZE)


@pytest.mark.parametrize("name", PINHOLES)
def test_a_pinhole_by_any_name_is_read(tmp_path: Path, name: str) -> None:
    assert read_camera(saved(tmp_path, PINHOLES[name]), SIZE).width == 640


def test_a_projection_alone_leaves_the_distortion_open() -> None:
    assert is_fisheye_lens({"cameramodel": "pinhole"}) is None
    assert is_fisheye_lens({"cameramodel": "pinhole", "distortionmodel": "equidistant"})


_RAW = f"{_K.replace('K', 'K1')}\n{_K.replace('K', 'K2')}\nD1: [0.1, 0, 0, 0]\nD2: [0.1, 0, 0, 0]\n"
_RAW += "R: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nT: [-0.1, 0, 0]\n"


@pytest.mark.parametrize("line", ["fisheye_model: 1", "camera_model: fisheye", "is_fisheye: true"])
def test_the_two_cameras_of_a_pair_are_what_the_file_names(tmp_path: Path, line: str) -> None:
    assert not read_raw_pair(saved(tmp_path, _RAW)).left.is_fisheye
    pair = read_raw_pair(saved(tmp_path, f"{_RAW}{line}\n"))
    assert pair.left.is_fisheye
    assert pair.right.is_fisheye
    with pytest.raises(InputError, match="'depthpose data rectify'"):
        read_camera(tmp_path / "camera.any", SIZE)
    with pytest.raises(InputError, match=r"xi is 0\.9"):
        read_raw_pair(saved(tmp_path, f"{_RAW}xi: 0.9\n"))
