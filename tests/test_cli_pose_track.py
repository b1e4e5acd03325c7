"""``pose track`` from the words to the files, with an oracle in place of the network."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tests.pages.read_page import read_page
from tests.pose.synthetic_frames import make_dataset
from tests.pose.synthetic_objects import K, Oracle, bottle, bracket, tiny_weights, view_of
from tests.pose.test_track import moving

from depthpose.cli import main
from depthpose.cli.pose import methods
from depthpose.cli.pose.file_jobs import make_cloud_jobs
from depthpose.core.camera import Camera, back_project, write_camera
from depthpose.core.files import read_cloud, write_depth_png
from depthpose.pose import track as tracking_module
from depthpose.pose.metrics import add_m
from depthpose.pose.predictions import read_bop_results, read_predictions
from depthpose.pose.weights import write_pose_weights

POSES = moving(4)


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    oracle = Oracle(tiny_weights(bracket(), bottle()), POSES)
    path = tmp_path / "known.safetensors"
    write_pose_weights(path, oracle.weights)
    monkeypatch.setattr(methods, "GeoPoseNet", lambda *_: oracle)
    return path


@pytest.mark.slow
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


def test_an_interrupted_sequence_keeps_its_poses_in_the_order_of_the_numbers(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for k, pose in enumerate(POSES, start=8):
        seen, _ = view_of(bracket(), pose)
        write_depth_png(tmp_path / f"depth/{k}.png", seen.float().nan_to_num(1.2), 0.001)
    (tmp_path / "depth/9.png").write_bytes(b"no picture")
    write_camera(tmp_path / "c.json", Camera(width=320, height=240, K=K, depth_unit_m=0.001))
    (tmp_path / "first.txt").write_text(str(POSES[0].matrix().tolist()))  # no search, of seconds
    words = ["--depth", str(tmp_path / "depth"), "--camera", str(tmp_path / "c.json")]
    words += ["--first", str(tmp_path / "first.txt")]
    words += ["--object", "bracket", "--weights", str(weights), "--out", str(tmp_path / "out")]

    def names() -> list[str]:
        return [p.estimate.name for p in read_predictions(tmp_path / "out")]

    with monkeypatch.context() as patch:
        interrupt_after(2, patch)
        assert main(["pose", "track", *words]) == 130
    assert names() == ["8", "9", "10"]
    assert main(["pose", "track", *words]) == 1
    assert names() == ["8", "9", "10", "11"]
    interrupt_after(1, monkeypatch)
    assert main(["pose", "track", *words]) == 130
    assert names() == ["8", "9", "10", "11"], "what an earlier run found stays"


def interrupt_after(count: int, patch: pytest.MonkeyPatch) -> None:
    """Interrupt the work in the frame after so many."""
    real, done = tracking_module._follow_or_search, iter(range(count))

    def until(*given: Any) -> Any:  # noqa: ANN401
        if next(done, None) is None:
            raise KeyboardInterrupt
        return real(*given)

    patch.setattr(tracking_module, "_follow_or_search", until)


def test_clouds_are_taken_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for k in (1, 10, 2):
        (tmp_path / f"{k}.ply").touch()
    jobs = make_cloud_jobs(tmp_path, "m", "bracket", tmp_path / "out")
    assert [job.name for job in jobs] == ["1", "2", "10"]


def test_clouds_of_the_scene_are_followed_from_a_first_pose(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "clouds").mkdir()
    for k, pose in enumerate(POSES):
        seen, mask = view_of(bracket(), pose)
        depth_m = torch.where(mask, seen.float(), torch.tensor(1.2))
        points_m = back_project(depth_m.double(), K).reshape(-1, 3)
        np.save(tmp_path / f"clouds/{k}.npy", points_m.numpy())
    matrix = torch.eye(4).double()
    matrix[:3, :3], matrix[:3, 3] = POSES[0].R, POSES[0].t_m
    (tmp_path / "first.txt").write_text(str(matrix.tolist()))
    words = ["--cloud", str(tmp_path / "clouds"), "--object", "bracket", "--weights", str(weights)]
    words += ["--first", str(tmp_path / "first.txt"), "--out", str(tmp_path / "out")]
    assert main(["pose", "track", *words]) == 0
    found = read_predictions(tmp_path / "out")
    assert [p.estimate.tracking for p in found] == ["tracked"] * 4
    last = found[3].estimate.camera_from_model
    assert last is not None
    assert float(add_m(last, POSES[3], bracket().vertices_m)) < 0.003
    # Another first pose is another sequence.
    (tmp_path / "first.txt").write_text(str(torch.eye(4).tolist()))
    assert main(["pose", "track", *words]) == 2
    capsys.readouterr()
    for text, said in (("1 2 3", "3 numbers"), ("a b", "cannot be read as numbers"),
                       ("2 " * 16, "no rigid transform")):  # fmt: skip
        (tmp_path / "first.txt").write_text(text)
        assert main(["pose", "track", *words]) == 2
        assert said in capsys.readouterr().err


def test_the_objects_of_a_scene_are_followed(weights: Path, tmp_path: Path) -> None:
    synthetic = make_dataset(tmp_path / "made", frames=2)
    words = ["--bop", str(synthetic.folder), "--object", "bracket", "--weights", str(weights)]
    assert main(["pose", "track", *words, "--out", str(tmp_path / "out")]) == 0
    found = read_predictions(tmp_path / "out")
    assert [p.place for p in found] == [(1, 0, 7), (1, 1, 7)]
    assert all(p.estimate.tracking is not None for p in found)
    answered = [p for p in found if p.estimate.is_posed]
    assert len(read_bop_results(tmp_path / "out/depthpose_made-test.csv")) == len(answered)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "give one of --depth with --camera, --cloud and --bop"),
        (["--depth", ".", "--cloud", "."], "give one of --depth with --camera"),
        (["--depth", "."], "--depth needs --camera beside it"),
        (["--bop", ".", "--camera", ".", "--unit", "m"], "Leave --camera and --unit out"),
        (["--bop", ".", "--first", "."], "--first: has no effect here"),
        (["--cloud", ".", "--camera", "."], "--camera: has no effect here; clouds are in the"),
    ],
)
def test_wrong_words_are_refused(
    words: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["pose", "track", *words, "--out", str(tmp_path / "out")]) == 2
    assert text in capsys.readouterr().err
