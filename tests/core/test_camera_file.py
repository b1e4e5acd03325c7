import json
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from depthpose.core.camera import (
    Camera,
    StereoRig,
    check_image_matches_camera,
    read_camera,
    read_rig,
    write_camera,
)
from depthpose.core.errors import InputError, Notice

KITTI: dict[str, Any] = {
    "width": 1242,
    "height": 375,
    "K": [[721.5377, 0, 609.5593], [0, 721.5377, 172.854], [0, 0, 1]],
    "baseline_m": 0.5327,
}
LENGTHS = st.floats(200, 5000)


def saved(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_a_rig_is_read_as_written_by_hand(tmp_path: Path) -> None:
    rig = read_rig(saved(tmp_path / "c.json", KITTI))
    assert (rig.width, rig.height, rig.baseline_m) == (1242, 375, 0.5327)
    assert rig.K.tolist() == KITTI["K"]
    assert rig.K.dtype == torch.float64
    assert (rig.cx_right_minus_left_px, rig.depth_unit_m) == (0, None)


def test_a_camera_without_baseline_is_no_rig(tmp_path: Path) -> None:
    mono = {k: v for k, v in KITTI.items() if k != "baseline_m"}
    path = saved(tmp_path / "c.json", {**mono, "depth_unit_m": 0.001})
    camera = read_camera(path)
    assert type(camera) is Camera
    assert camera.depth_unit_m == 0.001
    with pytest.raises(
        InputError, match=r"c\.json: no 'baseline_m', without which disparity .* ad"
    ):
        read_rig(path)


@pytest.mark.filterwarnings("ignore:.*The file names that size itself")
@given(
    lengths=st.tuples(LENGTHS, st.floats(0.6, 1.7), st.floats(0, 1241)),
    baseline_m=st.none() | st.floats(0.01, 4.9),
    offset_px=st.floats(-50, 50),
    unit_m=st.none() | st.floats(1e-6, 1),
)
def test_a_written_camera_comes_back_to_the_bit(
    tmp_path_factory: pytest.TempPathFactory,
    lengths: tuple[float, float, float],
    baseline_m: float | None,
    offset_px: float,
    unit_m: float | None,
) -> None:
    fx, squeezed, cx = lengths
    fy = fx * squeezed
    K = torch.tensor([[fx, 0.1, cx], [0, fy, 99.9], [0, 0, 1]], dtype=torch.float64)
    mono = Camera(width=1242, height=375, K=K, depth_unit_m=unit_m)
    camera = (
        mono
        if baseline_m is None
        else StereoRig(
            width=1242,
            height=375,
            K=K,
            depth_unit_m=unit_m,
            baseline_m=baseline_m,
            cx_right_minus_left_px=offset_px,
        )
    )
    path = tmp_path_factory.mktemp("camera") / "c.json"
    write_camera(path, camera)
    back = read_camera(path)
    assert type(back) is type(camera)
    assert torch.equal(back.K, K)
    assert {**vars(back), "K": 0} == {**vars(camera), "K": 0}


BAD: list[tuple[dict[str, Any], str]] = [
    ({"baselin_m": 1}, "unknown key 'baselin_m'; did you mean 'baseline_m'"),
    ({"width": None}, "'width' is None; give a whole number of pixels"),
    ({"width": 1242.5}, r"'width' is 1242\.5; give a whole number of pixels"),
    ({"height": True}, "'height' is True; give a whole number"),
    ({"height": 0}, "height is 0, but an image has 1 to 1048576 pixels"),
    ({"K": 721.5}, r"'K' is 721\.5; write \[\[fx, skew, cx\]"),
    ({"K": [[1, 2, 3], [4, 5, 6]]}, r"'K' is \[\[1, 2, 3\], \[4, 5, 6\]\]; write"),
    ({"K": [721, 0, 609, 0, 721, 172, 0, 0]}, r"'K' is \[721, 0, .*; write"),
    ({"K": [["a", 0, 0], [0, 1, 0], [0, 0, 1]]}, "'K' is .*; write"),
    ({"K": [[10**400, 0, 0], [0, 1, 0], [0, 0, 1]]}, "'K' is .*; write"),
    ({"K": [[700, 0, 0], [0, 700, 0], [600, 170, 1]]}, "K is .*; it looks transposed; write"),
    ({"K": [[-7, 0, 6], [0, 7, 1], [0, 0, 1]]}, "has fx -7 and fy 7, but focal lengths are positi"),
    (
        {"K": [[0.58, 0, 0.5], [0, 1.92, 0.5], [0, 0, 1]]},
        r"fx 0\.58 for 1242x375 pixels, so it looks normalised; multiply its first row by",
    ),
    (
        {"K": [[35, 0, 600], [0, 35, 170], [0, 0, 1]]},
        "fx 35 for 1242x375 pixels, so it looks like millimetres; divide by the width of a pixel",
    ),
    (
        {"K": [[721, 0, 1300], [0, 721, 170], [0, 0, 1]]},
        r"principal point \(1300, 170\) lies outside the image of 1242x375; do K and the size",
    ),
    ({"baseline_m": "0.54"}, "'baseline_m' is '0.54'; give a number"),
    ({"baseline_m": False}, "'baseline_m' is False; give a number"),
    ({"baseline_m": 0}, r"baseline_m is 0\.0, but the right camera stands"),
    ({"baseline_m": 532.7}, r"baseline_m is 532\.7, which looks like millimetres; divide by 1000"),
    ({"baseline_m": 54}, "baseline_m is 54, which looks like millimetres; divide by 1000"),
    ({"baseline_m": 6}, r"looks like centimetres; divide by 100 \(0\.06\)"),
    ({"baseline_m": 12}, "looks like centimetres; .* in millimetres, divide by 1000"),
    ({"baseline_m": 1e-9}, "baseline_m is 1e-09, less than two lenses can stand apart"),
    ({"depth_unit_m": 1e-9}, "depth_unit_m is 1e-09, finer than any sensor's"),
    (
        {"baseline_m": 0.1, "cx_right_minus_left_px": 2000},
        "principal points differ by 2000 px, more than the image",
    ),
    ({"depth_unit_m": -1}, r"depth_unit_m is -1\.0, but a unit is a positive number of metres"),
]


@pytest.mark.parametrize(("change", "said"), BAD)
def test_a_wrong_value_is_named(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    path = saved(tmp_path / "c.json", {**KITTI, **change})
    with pytest.raises(InputError, match=said) as caught:
        read_camera(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize("key", ["width", "height", "K"])
def test_a_missing_key_is_named(tmp_path: Path, key: str) -> None:
    content = {k: v for k, v in KITTI.items() if k != key}
    with pytest.raises(InputError, match=f"missing '{key}'; add it to the camera"):
        read_camera(saved(tmp_path / "c.json", content))


def test_an_offset_needs_its_baseline(tmp_path: Path) -> None:
    content = {k: v for k, v in KITTI.items() if k != "baseline_m"}
    path = saved(tmp_path / "c.json", {**content, "cx_right_minus_left_px": 3})
    with pytest.raises(InputError, match="'cx_right_minus_left_px' needs 'baseline_m' beside it"):
        read_camera(path)


def test_what_is_no_object_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a camera is a JSON object with the keys .*, not a list"):
        read_camera(saved(tmp_path / "c.json", [1]))


def test_an_image_of_another_size_is_refused_with_both_sizes(tmp_path: Path) -> None:
    camera = read_camera(saved(tmp_path / "c.json", KITTI))
    check_image_matches_camera(camera, 1242, 375, "left.png")
    said = r"left\.png is 621x188 but its camera is 1242x375; the aspect agrees: resize the image"
    with pytest.raises(InputError, match=said):
        check_image_matches_camera(camera, 621, 188, "left.png")
    said = r"left\.png is 1226x340 .*; the aspect differs too: follow a crop with crop_camera"
    with pytest.raises(InputError, match=said):
        check_image_matches_camera(camera, 1226, 340, "left.png")


def test_a_matrix_of_another_size_than_the_file_names_is_told_of(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    twice = {"width": 320, "height": 240, "K": [[500, 0, 310], [0, 500, 232], [0, 0, 1]]}
    path.write_text(json.dumps(twice))
    with pytest.warns(Notice, match="K looks like that of about 620x465.*names that size itself"):
        read_camera(path)
