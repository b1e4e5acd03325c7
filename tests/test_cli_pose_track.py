"""``pose track`` from the words to the files, with an oracle in place of the network."""

from pathlib import Path

import pytest
import torch
from tests.pages.read_page import read_page
from tests.pose.synthetic_frames import make_dataset
from tests.pose.synthetic_objects import K, Oracle, bottle, bracket, tiny_weights, view_of
from tests.pose.test_track import moving

from depthpose.cli import main
from depthpose.cli.pose import methods as pose_methods
from depthpose.core.camera import Camera, write_camera
from depthpose.core.files import read_cloud, write_depth_png
from depthpose.pose.datasets.results import read_results
from depthpose.pose.metrics import add_m
from depthpose.pose.predictions import read_predictions
from depthpose.pose.weights import write_pose_weights

POSES = moving(4)


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    oracle = Oracle(tiny_weights(bracket(), bottle()), POSES)
    path = tmp_path / "known.safetensors"
    write_pose_weights(path, oracle.weights)
    monkeypatch.setattr(pose_methods, "GeoPoseNet", lambda *_: oracle)
    return path


def test_a_folder_of_depth_images_is_followed(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wall = torch.full((240, 320), 1.2)
    (tmp_path / "depth").mkdir()
    for k, pose in enumerate(POSES):
        seen, mask = view_of(bracket(), pose)
        depth_m = wall if k == 2 else torch.where(mask, seen.float(), wall)
        write_depth_png(tmp_path / f"depth/{k}.png", depth_m, 0.001)
    (tmp_path / "depth/4.png").write_bytes(b"no picture")
    write_camera(tmp_path / "c.json", Camera(width=320, height=240, K=K, depth_unit_m=0.001))
    words = ["--depth", str(tmp_path / "depth"), "--camera", str(tmp_path / "c.json")]
    end = ["--object", "bracket", "--weights", str(weights), "--out", str(tmp_path / "out")]
    assert main(["pose", "track", *words, *end]) == 1  # one frame cannot be read
    said = capsys.readouterr()
    assert "4.png" in said.err
    assert "1 tracked, 2 found, 1 lost" in said.out
    found = {p.estimate.name: p.estimate for p in read_predictions(tmp_path / "out")}
    kinds = [found[name].tracking for name in "01234"]
    assert kinds == ["found", "tracked", "lost", "found", None]
    pose = found["1"].camera_from_model
    assert pose is not None
    assert float(add_m(pose, POSES[1], bracket().vertices_m)) < 0.003
    # Beside the posed model lies what it explains, not the wall.
    own = len(read_cloud(tmp_path / "out/1.pose.ply").points) - 5000
    assert own == pytest.approx(int(view_of(bracket(), POSES[1])[1].sum()), rel=0.02)
    assert "tracked" in read_page(tmp_path / "out/report.html").texts["td"]


def test_the_objects_of_a_scene_are_followed(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    synthetic = make_dataset(tmp_path / "made", frames=2)
    words = ["--bop", str(synthetic.folder), "--object", "bracket", "--weights", str(weights)]
    assert main(["pose", "track", *words, "--out", str(tmp_path / "out")]) == 0
    found = read_predictions(tmp_path / "out")
    assert [p.place for p in found] == [(1, 0, 7), (1, 1, 7)]
    assert all(p.estimate.tracking is not None for p in found)
    answered = [p for p in found if p.estimate.is_ok]
    assert len(read_results(tmp_path / "out/depthpose_made-test.csv")) == len(answered)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "give one of --depth with --camera, --cloud and --bop"),
        (["--depth", ".", "--cloud", "."], "give one of --depth with --camera"),
        (["--depth", "."], "--depth needs --camera beside it"),
    ],
)
def test_wrong_words_are_refused(
    words: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["pose", "track", *words, "--out", str(tmp_path / "out")]) == 2
    assert text in capsys.readouterr().err
