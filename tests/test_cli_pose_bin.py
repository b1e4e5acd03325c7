"""``pose predict`` before a bin that is known, by its CAD file or an empty frame."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.pose.synthetic_objects import CAMERA, bracket, view_of, write_stl
from tests.pose.test_background import FIXTURE, TRUTH, empty_frame, full_frame, posed_bin

from depthpose.cli import main
from depthpose.core.camera import write_camera
from depthpose.core.files import write_depth_png
from depthpose.core.rigid import Rigid
from depthpose.pose.predictions import Prediction, write_predictions
from depthpose.pose.types import PoseEstimate


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    """A frame of a bin, which has a bracket of its own, with one in it."""
    write_depth_png(tmp_path / "d.png", full_frame(), 0.0001)
    write_depth_png(tmp_path / "empty.png", empty_frame(), 0.0001)
    write_camera(tmp_path / "c.json", replace(CAMERA, depth_unit_m=0.0001))
    cad = write_stl(tmp_path / "bracket.stl", bracket())
    write_stl(tmp_path / "bin.stl", posed_bin().model)
    words = ["pose", "predict", "--cad", str(cad), "--cad-unit", "mm", "--out", str(tmp_path / "o")]
    return [*words, "--depth", str(tmp_path / "d.png"), "--camera", str(tmp_path / "c.json")]


def places_m(folder: Path) -> list[list[float]]:
    rows = json.loads((folder / "poses.json").read_text())
    poses = [row["camera_from_model"] for row in rows if row["camera_from_model"] is not None]
    return [[row[3] for row in pose[:3]] for pose in poses]


def test_the_part_alone_is_found_before_an_empty_frame(words: list[str], tmp_path: Path) -> None:
    assert main([*words, "--empty-frame", str(tmp_path / "empty.png")]) == 0
    assert places_m(tmp_path / "o") == [pytest.approx(TRUTH.t_m.tolist(), abs=0.005)]
    # Without it, the one of the bin is found too, and belongs into another folder.
    assert main(words) == 2


def test_the_pose_of_a_bin_comes_from_the_run_that_posed_it(
    words: list[str], tmp_path: Path
) -> None:
    pose = posed_bin().camera_from_model
    posed = PoseEstimate(name="empty", object="bin", status="ok", camera_from_model=pose)
    write_predictions(tmp_path, [Prediction(estimate=posed)])
    words += ["--bin", str(tmp_path / "bin.stl"), "--bin-pose", str(tmp_path / "poses.json")]
    _, fixture = view_of(bracket(), FIXTURE)
    left, top = fixture.nonzero().amin(0).flip(0).tolist()
    right, bottom = fixture.nonzero().amax(0).flip(0).tolist()
    assert main([*words, "--box", f"{left},{top},{right},{bottom}"]) == 0
    assert places_m(tmp_path / "o") == [], "what is in the box belongs to the bin"


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        (["--bin", "bin.stl"], "where is it? Give --bin-pose"),
        (["--bin-pose", "poses.json"], "it is of --bin; give the CAD file of the bin too"),
        (["--bin", "bin.stl", "--bin-pose", "poses.json"], "holds 2 poses; give a poses.json of"),
        (
            ["--bin", "bin.stl", "--empty-frame", "empty.png"],
            "--empty-frame: has no effect here; --bin says",
        ),
        (
            ["--bin", "bin.stl", "--bin-pose", "poses.json", "--engine", "ray"],
            "workers do not read it",
        ),
    ],
)
def test_options_that_do_not_fit_are_named(
    words: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    more: list[str],
    reason: str,
) -> None:
    estimates = [
        PoseEstimate(name=name, object="bin", status="ok", camera_from_model=pose)
        for name, pose in (("a", TRUTH), ("b", Rigid(torch.eye(3), torch.ones(3))))
    ]
    write_predictions(tmp_path, [Prediction(estimate=estimate) for estimate in estimates])
    more = [str(tmp_path / word) if "." in word else word for word in more]
    assert main([*words, *more]) == 2
    assert reason in capsys.readouterr().err
