"""``data rectify``, as a user runs it, on synthetic pairs whose cameras and depth are known."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("cv2")
from tests.raw_pairs import DrawnPair, make_raw, opencv_names, write_kalibr, write_opencv
from tests.synthetic_street import make_street

from depthpose.cli import main
from depthpose.core.camera import (
    Rectifier,
    StereoRig,
    back_project,
    check_rectified,
    make_rectifier,
    project,
    read_rig,
)
from depthpose.core.errors import InputError
from depthpose.core.files import read_image, write_image
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.stereo import SGBMMatcher
from depthpose.depth.types import DepthSample


@pytest.fixture(scope="module")
def street() -> DepthSample:
    return make_street(0.4)


EITHER = pytest.mark.parametrize(
    "drawn", [False, True], ids=["pinhole", "fisheye"], indirect=True, scope="module"
)
"""Of both lenses; what does not depend on them is tested with pinholes alone."""


@pytest.fixture(scope="module")
def drawn(request: pytest.FixtureRequest, street: DepthSample) -> DrawnPair:
    return make_raw(street.input, is_fisheye=getattr(request, "param", False))


@pytest.fixture
def home(tmp_path: Path, drawn: DrawnPair) -> Path:
    """A raw pair and its camchain."""
    write_image(tmp_path / "raw/left.png", drawn.left)
    write_image(tmp_path / "raw/right.png", drawn.right)
    write_kalibr(tmp_path / "camchain.yaml", drawn.pair)
    return tmp_path


def rectify(home: Path, *words: str, out: str = "out", camera: str = "camchain.yaml") -> int:
    images = [str(home / "raw/left.png"), str(home / "raw/right.png")]
    given = images if not words or words[0].startswith("--") else []
    fixed = ["--camera", str(home / camera), "--out", str(home / out)]
    return main(["data", "rectify", *given, *words, *fixed])


def rectifier_of(drawn: DrawnPair) -> Rectifier:
    assert drawn.pair.size is not None
    return make_rectifier(drawn.pair, drawn.pair.size)


@EITHER
def test_rows_agree_after_and_not_before(drawn: DrawnPair) -> None:
    assert check_rectified(drawn.left, drawn.right).is_rectified is False
    rectifier = rectifier_of(drawn)
    after = check_rectified(*rectifier.rectify(drawn.left, drawn.right))
    assert after.matches > 50
    assert abs(after.vertical_offset_px) < 0.3
    assert after.is_rectified
    assert not after.is_swapped


@EITHER
def test_depth_of_the_rectified_pair_is_that_of_the_street(
    drawn: DrawnPair, street: DepthSample
) -> None:
    rectifier = rectifier_of(drawn)
    rig = rectifier.rig
    left, right = rectifier.rectify(drawn.left, drawn.right)
    found_m = depth_from_disparity(SGBMMatcher().match(left, right).disparity_px, rig)
    points_m = back_project(found_m.double(), rig.K)[found_m < 40]
    street_from_rectified = (
        torch.from_numpy(drawn.turns[0]) @ rectifier.rectified_from_raw.inverse().R
    )
    there_m = points_m @ street_from_rectified.mT
    seen = street.input.camera
    assert isinstance(seen, StereoRig)
    at = project(there_m, seen.K).round().long()
    inside = (at >= 0).all(-1) & (at[:, 0] < seen.width) & (at[:, 1] < seen.height)
    assert street.truth.depth_m is not None
    true_m = street.truth.depth_m[at[inside, 1], at[inside, 0]].double()
    error = (there_m[inside, 2] / true_m - 1)[true_m.isfinite()]
    assert len(error) > 20_000
    assert float(error.abs().median()) < 0.02
    assert abs(float(error.median())) < 0.01


@EITHER
def test_the_folder_is_what_match_and_check_take(
    home: Path, drawn: DrawnPair, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rectify(home) == 0
    shown = capsys.readouterr().out
    assert "rows of 1 pairs: they differ by 0." in shown
    out = home / "out"
    rig = read_rig(out / "camera.json")
    assert rig.baseline_m == pytest.approx(0.54)
    assert (rig.width, rig.height) == drawn.pair.size
    assert main(["data", "check", str(out)]) == 0
    pair = [str(out / "left"), str(out / "right"), "--camera", str(out / "camera.json")]
    matched = ["depth", "match", *pair, "--matcher", "sgbm", "--out", str(home / "matched")]
    assert main(matched) == 0
    assert (home / "matched/left.depth_m.npy").is_file()


def test_match_refuses_the_raw_pair_and_names_the_command(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rectify(home) == 0
    raw = [str(home / "raw/left.png"), str(home / "raw/right.png")]
    camera = ["--camera", str(home / "out/camera.json"), "--matcher", "sgbm"]
    assert main(["depth", "match", *raw, *camera, "--out", str(home / "no")]) == 2
    assert "rectify the pair ('depthpose data rectify', with" in capsys.readouterr().err


def test_folders_and_patterns_are_paired_by_name(home: Path, drawn: DrawnPair) -> None:
    for number in range(2):
        write_image(home / f"many/l{number}.png", drawn.left)
        write_image(home / f"many/r{number}.png", drawn.right)
    assert rectify(home, str(home / "many/l*.png"), str(home / "many/r*.png")) == 0
    assert sorted(p.name for p in (home / "out/right").iterdir()) == ["l0.png", "l1.png"]
    assert rectify(home, str(home / "out/left"), str(home / "out/right")) == 2


def test_a_rerun_gives_the_same_and_other_settings_are_refused(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rectify(home) == 0
    first = read_image(home / "out/left/left.png")
    assert rectify(home) == 0
    assert torch.equal(read_image(home / "out/left/left.png"), first)
    assert rectify(home, "--keep", "0.5") == 2
    assert "keep" in capsys.readouterr().err


@EITHER
def test_what_is_not_kept_is_black(home: Path, drawn: DrawnPair) -> None:
    assert rectify(home, "--keep", "1") == 0
    assert rectify(home, out="tight") == 0
    black = [(read_image(home / f"{o}/left/left.png") == 0).all(0) for o in ("out", "tight")]
    assert black[0].float().mean() > black[1].float().mean() + 0.01


def test_nothing_is_written_over_inputs(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for side in ("left", "right"):
        write_image(home / f"set/{side}/a.png", read_image(home / f"raw/{side}.png"))
    before = (home / "set/left/a.png").read_bytes()
    words = [str(home / "set/left"), str(home / "set/right")]
    assert rectify(home, *words, out="set") == 2
    assert "would be written over them; choose another folder" in capsys.readouterr().err
    assert (home / "set/left/a.png").read_bytes() == before
    (home / "own").mkdir()
    (home / "own/camera.json").write_text("{}")
    assert rectify(home, out="own") == 2
    assert (home / "own/camera.json").read_text() == "{}"


def test_exchanged_images_are_refused(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [str(home / "raw/right.png"), str(home / "raw/left.png")]
    assert rectify(home, *words) == 2
    assert "exchange LEFT and RIGHT" in capsys.readouterr().err
    assert not (home / "out").exists()


def other_calibration(home: Path, turn_rad: float) -> str:
    """Write a camchain whose right camera is turned about its x-axis."""
    import yaml

    content: dict[str, Any] = yaml.safe_load((home / "camchain.yaml").read_text())
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    turn = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    motion = np.array(content["cam1"]["T_cn_cnm1"])
    motion[:3] = turn @ motion[:3]
    content["cam1"]["T_cn_cnm1"] = motion.tolist()
    (home / "other.yaml").write_text(yaml.safe_dump(content))
    return "other.yaml"


def test_another_rigs_calibration_is_refused_or_warned_of(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = other_calibration(home, 0.008)  # about 3 px at this focal length
    assert rectify(home, camera=camera) == 2
    said = capsys.readouterr().err
    assert "this is not the calibration of these images" in said
    assert "Nothing was written (--no-check writes all the same)" in said
    assert not (home / "out").exists()
    assert rectify(home, "--no-check", camera=camera) == 0
    assert "this is not the calibration" in capsys.readouterr().err
    assert rectify(home, camera=other_calibration(home, 0.002), out="near") == 0
    assert "that is above 0.5 px" in capsys.readouterr().err


def test_a_bare_scene_cannot_be_checked(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grey = torch.full_like(read_image(home / "raw/left.png"), 0.5)
    for side in ("left", "right"):
        write_image(home / f"raw/{side}.png", grey)
    assert rectify(home) == 0
    assert "the rows cannot be checked: the left image shows nothing" in capsys.readouterr().err


def test_images_of_another_size_are_refused(
    home: Path, drawn: DrawnPair, capsys: pytest.CaptureFixture[str]
) -> None:
    write_image(home / "raw/right.png", drawn.right[:, :100])
    assert rectify(home) == 2
    assert "right.png is 497x100, but the cameras were calibrated at 497x150" in (
        capsys.readouterr().err
    )


@EITHER
def test_opencvs_file_with_millimetres_and_no_size(home: Path, drawn: DrawnPair) -> None:
    names = opencv_names(drawn.pair)
    write_opencv(home / "stereo.yml", {**names, "T": 1000 * names["T"]})
    kind = ["--fisheye"] if drawn.pair.left.is_fisheye else []
    assert rectify(home, "--unit", "mm", *kind, camera="stereo.yml") == 0
    camera = json.loads((home / "out/camera.json").read_text())
    assert camera["baseline_m"] == pytest.approx(0.54)


def test_keep_out_of_range_is_refused(drawn: DrawnPair) -> None:
    assert drawn.pair.size is not None
    with pytest.raises(InputError, match=r"--keep 2: 0 keeps what both lenses show"):
        make_rectifier(drawn.pair, drawn.pair.size, 2.0)


def test_distortion_that_no_lens_has_is_refused(drawn: DrawnPair) -> None:
    assert drawn.pair.size is not None
    bent = replace(drawn.pair.left, distortion=(50.0, 200.0, 0.0, 0.0), is_fisheye=False)
    pair = replace(drawn.pair, left=bent, right=bent)
    with pytest.raises(InputError, match="so much no lens bends; check the distortion"):
        make_rectifier(pair, drawn.pair.size, 0.0)


def test_a_mirrored_right_view_has_no_common_difference(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    right = read_image(home / "raw/right.png")
    write_image(home / "raw/right.png", right.flip(1))
    assert rectify(home) == 2
    said = capsys.readouterr().err
    assert "nan" not in said
    assert "this is not the calibration of these images" in said
