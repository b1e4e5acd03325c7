"""Calibrations of raw pairs, as OpenCV, ROS and Kalibr write them."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

pytest.importorskip("cv2")
from tests.raw_pairs import DrawnPair, make_raw, opencv_names, write_kalibr, write_opencv, write_ros

from depthpose.core.camera import RawPair, StereoRig, read_camera, read_raw_pair
from depthpose.core.errors import InputError, Notice
from depthpose.depth.types import DepthInput

SIZE = (64, 48)


@pytest.fixture(scope="module", params=[False, True], ids=["pinhole", "fisheye"])
def drawn(request: pytest.FixtureRequest) -> DrawnPair:
    K = torch.tensor([[70, 0, 31.5], [0, 70, 23.5], [0, 0, 1]], dtype=torch.float64)
    rig = StereoRig(width=64, height=48, K=K, baseline_m=0.12)
    image = torch.rand(3, 48, 64)
    seen = DepthInput(name="pair", left=image, right=image, camera=rig)
    return make_raw(seen, is_fisheye=request.param)


def same(read: RawPair, pair: RawPair, coefficients: int) -> None:
    for one, other in ((read.left, pair.left), (read.right, pair.right)):
        assert torch.allclose(one.K, other.K)
        assert one.distortion[:coefficients] == pytest.approx(other.distortion[:coefficients])
        assert one.is_fisheye == other.is_fisheye
    assert torch.allclose(read.right_from_left.R, pair.right_from_left.R)
    assert torch.allclose(read.right_from_left.t_m, pair.right_from_left.t_m)


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_opencvs_file_is_read(tmp_path: Path, drawn: DrawnPair, suffix: str) -> None:
    path = write_opencv(tmp_path / f"stereo{suffix}", opencv_names(drawn.pair), SIZE)
    read = read_raw_pair(path, is_fisheye=drawn.pair.left.is_fisheye)
    same(read, drawn.pair, 5)
    assert read.size == SIZE


def test_opencvs_two_files_are_a_folder(tmp_path: Path, drawn: DrawnPair) -> None:
    names = opencv_names(drawn.pair)
    renamed = {"M1": "K1", "D1": "D1", "M2": "K2", "D2": "D2"}
    write_opencv(tmp_path / "intrinsics.yml", {new: names[old] for new, old in renamed.items()})
    write_opencv(tmp_path / "extrinsics.yml", {name: names[name] for name in ("R", "T")})
    read = read_raw_pair(tmp_path, is_fisheye=drawn.pair.left.is_fisheye)
    same(read, drawn.pair, 5)
    assert read.size is None


def test_a_camchain_of_kalibr_is_read(tmp_path: Path, drawn: DrawnPair) -> None:
    read = read_raw_pair(write_kalibr(tmp_path / "camchain.yaml", drawn.pair))
    same(read, drawn.pair, 4)
    assert read.size == SIZE


def test_two_camera_info_of_ros_are_read(tmp_path: Path, drawn: DrawnPair) -> None:
    read = read_raw_pair(write_ros(tmp_path / "calibration", drawn, 0.12))
    same(read, drawn.pair, 5)
    assert read.size == SIZE


def test_millimetres_become_metres(tmp_path: Path, drawn: DrawnPair) -> None:
    names = opencv_names(drawn.pair)
    path = write_opencv(tmp_path / "stereo.yml", {**names, "T": 1000 * names["T"]})
    is_fisheye = drawn.pair.left.is_fisheye
    same(read_raw_pair(path, unit_m=0.001, is_fisheye=is_fisheye), drawn.pair, 5)
    with pytest.raises(InputError, match=r"baseline_m is 120, .* millimetres.*--unit cm or mm"):
        read_raw_pair(path, is_fisheye=is_fisheye)


GOOD: dict[str, Any] = {
    "K1": [500, 0, 320, 0, 500, 240, 0, 0, 1],
    "D1": [-0.2, 0.1, 0, 0, 0],
    "K2": [500, 0, 320, 0, 500, 240, 0, 0, 1],
    "D2": [-0.2, 0.1, 0, 0, 0],
    "R": np.eye(3).ravel().tolist(),
    "T": [-0.1, 0, 0],
}
KALIBR: dict[str, Any] = {
    "intrinsics": [500, 500, 320, 240],
    "distortion_model": "radtan",
    "distortion_coeffs": [-0.2, 0.1, 0, 0],
    "resolution": [640, 480],
    "T_cn_cnm1": [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
}
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "no camera": ({"a": 1}, "it has no camera matrices K1 and K2; give .* a camchain"),
    "one camera": (
        {"camera_matrix": GOOD["K1"]},
        "it describes a single camera; give the calibration of a pair",
    ),
    "one matrix": ({**GOOD, "K2": [1, 2]}, "no camera matrix of 9 numbers of the right camera"),
    "no distortion": ({**GOOD, "D1": None}, "no distortion of the left camera; write D1 and D2"),
    "six coefficients": ({**GOOD, "D2": [0.1] * 6}, "right camera has 6 coefficients .* 4 or 5 or"),
    "no motion": ({**GOOD, "T": None}, "no R of 9 numbers and T of 3"),
    "no rotation": ({**GOOD, "R": [2, 0, 0, 0, 1, 0, 0, 0, 1]}, "which is no rotation"),
    "no distance": ({**GOOD, "T": [0, 0, 0]}, "both cameras stand in one place"),
    "exchanged": ({**GOOD, "T": [0.1, 0, 0]}, "second camera stands to the left of its first"),
    "one above the other": ({**GOOD, "T": [0, -0.1, 0]}, "turn the images by 90 degrees"),
    "millimetres": (
        {**GOOD, "T": [-100, 0, 0]},
        "looks like millimetres; divide by 1000 .--unit cm or mm",
    ),
    "centimetres": ({**GOOD, "T": [-6, 0, 0]}, "looks like centimetres; .*--unit cm or mm"),
    "squeezed": ({**GOOD, "K1": [500, 0, 320, 0, 1000, 240, 0, 0, 1]}, "2 times wider than high"),
    "other size": (
        {**GOOD, "K2": [250, 0, 160, 0, 250, 120, 0, 0, 1]},
        "fx is 500 on the left and 250 on the right, as of images of two sizes",
    ),
    "scaled twice": ({**GOOD, "T": [-1e-4, 0, 0]}, "less than two lenses can stand apart"),
    "another model": (
        {**GOOD, "distortion_model": "fov"},
        "distortion_model is 'fov', and only pinholes and the equidistant fisheye",
    ),
    "transposed": (
        {**GOOD, "K1": [500, 0, 0, 0, 500, 0, 320, 240, 1]},
        "it looks transposed",
    ),
    "one of Kalibr": ({"cam0": KALIBR}, "without cam0 and cam1"),
    "no motion in Kalibr": (
        {"cam0": KALIBR, "cam1": {**KALIBR, "T_cn_cnm1": None}},
        "cam1 has no T_cn_cnm1",
    ),
    "two sizes": (
        {"cam0": KALIBR, "cam1": {**KALIBR, "resolution": [320, 240]}},
        "images of two sizes",
    ),
    "omnidirectional": (
        {"cam0": {**KALIBR, "camera_model": "omni"}, "cam1": KALIBR},
        r"cam0's camera_model is 'omni', .*cv2\.omnidir.*in Kalibr: pinhole-radtan",
    ),
    "two kinds": (
        {"cam0": {**KALIBR, "distortion_model": "equidistant"}, "cam1": KALIBR},
        "one lens is a fisheye and the other is none",
    ),
    "no intrinsics": (
        {"cam0": {**KALIBR, "intrinsics": [1]}, "cam1": KALIBR},
        "cam0 has no intrinsics",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_a_calibration_says_why(tmp_path: Path, name: str) -> None:
    content, said = WRONG[name]
    path = tmp_path / "stereo.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match=said) as caught:
        read_raw_pair(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_good_ones_are_read(tmp_path: Path) -> None:
    path = tmp_path / "stereo.yaml"
    for content in (GOOD, {"cam0": KALIBR, "cam1": KALIBR}):
        path.write_text(yaml.safe_dump(content))
        assert read_raw_pair(path).right_from_left.t_m.tolist() == [-0.1, 0, 0]


def test_a_fisheye_that_the_file_denies_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump({"cam0": KALIBR, "cam1": KALIBR}))
    with pytest.raises(InputError, match="that of a pinhole, no fisheye; omit --fisheye"):
        read_raw_pair(path, is_fisheye=True)


def test_a_camchain_given_for_a_rectified_camera_names_the_command(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump({"cam0": KALIBR, "cam1": KALIBR}))
    with pytest.raises(InputError, match="'depthpose data rectify' rectifies them"):
        read_camera(path)


def test_two_camera_info_of_single_cameras_are_no_pair(tmp_path: Path, drawn: DrawnPair) -> None:
    folder = write_ros(tmp_path / "calibration", drawn, 0.0)
    with pytest.raises(InputError, match=r"Tx 0 and -?0, .*calibrate them as a pair"):
        read_raw_pair(folder)


def test_a_rotation_that_looks_transposed_is_told_of(tmp_path: Path) -> None:
    turn = math.radians(0.3)
    R = np.array(
        [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]]
    )
    T = R @ [-0.5, 0, 0]  # the left camera stands square to the line between both
    path = tmp_path / "stereo.yaml"
    path.write_text(yaml.safe_dump({**GOOD, "R": R.ravel().tolist(), "T": T.tolist()}))
    read_raw_pair(path)
    path.write_text(yaml.safe_dump({**GOOD, "R": R.T.ravel().tolist(), "T": T.tolist()}))
    with pytest.warns(Notice, match=r"is R transposed\? .* turned 0\.90 .* transpose by 0\.30"):
        read_raw_pair(path)
