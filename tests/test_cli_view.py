"""``--view``: what is shown of each result, by a stand-in for Rerun and by it where it is."""

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tests.pose.synthetic_objects import Oracle, bottle, bracket, cloud_of, pose_at, tiny_weights

from depthpose.cli import main, pose_methods
from depthpose.core.camera import Camera
from depthpose.core.files import Cloud, write_cloud
from depthpose.core.loop import Progress
from depthpose.depth.types import DepthEstimate, StereoInput
from depthpose.pose.types import CloudInput, PoseEstimate
from depthpose.pose.weights import write_pose_weights
from depthpose.report.viewer import Viewer, open_viewer

TRUTH = pose_at(seed=1)
_SHAPES = ("Pinhole", "Image", "DepthImage", "Points3D", "Mesh3D", "TextLog", "Scalars", "Clear")


class _Stream:
    """Keeps what is logged."""

    def __init__(self, logged: list[tuple[str, Any]]) -> None:
        self.logged, self.state, self.times = logged, [], []

    def log(self, name: str, what: object) -> None:
        self.logged.append((name, what))

    def set_time(self, name: str, *, sequence: int) -> None:
        self.times.append((name, sequence))

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_: self.state.append(name)


class _Rerun(SimpleNamespace):
    """Rerun's names, each giving back what it was given."""

    def __init__(self) -> None:
        self.logged: list[tuple[str, Any]] = []
        self.stream = _Stream(self.logged)
        shapes = {
            name: lambda *a, kind=name, **k: SimpleNamespace(kind=kind, given=a, **k)
            for name in _SHAPES
        }
        super().__init__(RecordingStream=lambda _: self.stream, **shapes)

    def of(self, name: str) -> list[Any]:
        return [what for logged, what in self.logged if logged == name]


@pytest.fixture
def rerun(monkeypatch: pytest.MonkeyPatch) -> _Rerun:
    stand_in = _Rerun()
    monkeypatch.setitem(sys.modules, "rerun", stand_in)
    return stand_in


def _depth(name: str = "a") -> tuple[StereoInput, DepthEstimate]:
    K = torch.tensor([[50.0, 0, 4], [0, 50, 3], [0, 0, 1]]).double()
    camera = Camera(width=8, height=6, K=K)
    given = StereoInput(name=name, left=torch.rand(3, 6, 8), right=None, camera=camera)
    depth_m = torch.full((6, 8), 2.5)
    depth_m[0, 0] = torch.nan
    estimate = DepthEstimate(
        depth_m=depth_m,
        disparity_px=torch.ones(6, 8),
        confidence=torch.full((6, 8), 0.5),
        right=torch.zeros(3, 6, 8),
    )
    return given, estimate


def test_a_depth_map_stands_before_its_camera(rerun: _Rerun) -> None:
    viewer = Viewer("live")
    for name in "ab":
        viewer.show_depth(*_depth(name))
    viewer.close()
    assert rerun.stream.state == ["spawn", "flush", "disconnect"]
    assert rerun.stream.times == [("input", 0), ("input", 1)]
    (first, _) = rerun.of("camera")
    assert first.resolution == [8, 6]
    assert first.image_from_camera[0][2] == 4
    depth = rerun.of("camera/depth")[0]
    assert depth.meter == 1.0
    assert depth.given[0][0, 0] == 0, "no reading"
    assert depth.given[0][1, 1] == 2.5
    assert rerun.of("right")[0].given[0].shape == (6, 8, 3)
    assert rerun.of("confidence")[0].given[0].max() == 128
    given, estimate = _depth()
    bare = DepthEstimate(depth_m=None, disparity_px=estimate.disparity_px)
    Viewer("live").show_depth(given, bare)
    assert len(rerun.of("camera/depth")) == 2


def test_a_posed_model_lies_on_its_cloud_and_a_refusal_says_why(rerun: _Rerun) -> None:
    part = bracket()
    cloud_m = cloud_of(part, TRUTH)
    given = CloudInput(name="it", points_m=cloud_m, object=part.name)
    viewer = Viewer("live")
    estimate = PoseEstimate(name="it", object=part.name, status="ok", reason="",
                            camera_from_model=TRUTH)  # fmt: skip
    viewer.show_pose(given, estimate, part)
    (mesh,), (keypoints,) = rerun.of("posed/model"), rerun.of("posed/keypoints")
    seen = rerun.of("seen")[-1]
    expected = TRUTH.apply(part.vertices_m).numpy()
    np.testing.assert_allclose(mesh.vertex_positions, expected)
    assert len(mesh.triangle_indices) == len(part.faces)
    assert seen.given[0].shape == cloud_m.shape
    assert keypoints.given[0].shape == (8, 3)
    refused = PoseEstimate(name="it", object=part.name, status="doubtful", reason="too far")
    viewer.show_pose(given, refused, part)
    assert rerun.of("reason")[0].given == ("it: doubtful: too far",)
    assert len(rerun.of("posed/model")) == 1
    # What stood there before is taken away first.
    assert [what.kind for what in rerun.of("posed")] == ["Clear", "Clear"]


def test_losses_are_curves(rerun: _Rerun) -> None:
    with open_viewer("live") as viewer:
        assert viewer is not None
        viewer.show_step(Progress(step=7, steps=9, numbers={"network/loss": 0.5}))
    assert rerun.stream.times == [("step", 7)]
    assert rerun.of("network/loss")[0].given == ([0.5],)
    assert rerun.stream.state == ["spawn", "flush", "disconnect"]
    with open_viewer(None) as nothing:
        assert nothing is None


def test_poses_are_shown_as_they_come(
    rerun: _Rerun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    oracle = Oracle(tiny_weights(bracket(), bottle()), [TRUTH])
    write_pose_weights(tmp_path / "known.safetensors", oracle.weights)
    monkeypatch.setattr(pose_methods, "GeoPoseNet", lambda *_: oracle)
    for name in "ab":
        write_cloud(tmp_path / "clouds" / f"{name}.ply", Cloud(points=cloud_of(bracket(), TRUTH)))
    words = ["pose", "predict", "--cloud", str(tmp_path / "clouds"), "--object", "bracket",
             "--weights", str(tmp_path / "known.safetensors")]  # fmt: skip
    shown = [*words, "--out", str(tmp_path / "out"), "--view", str(tmp_path / "it.rrd")]
    assert main(shown) == 0
    assert [what.given[0] for what in rerun.of("input")] == ["a", "b"]
    assert len(rerun.of("posed/model")) == 2
    assert rerun.stream.state == ["save", "flush", "disconnect"]
    assert main(shown) == 0, "nothing is left to show"
    assert len(rerun.of("input")) == 2


@pytest.mark.parametrize(
    ("where", "said"),
    [("window", r"say live for a window, or FILE\.rrd"), ("none/x.rrd", "there is no folder none")],
)
def test_another_word_is_refused(
    where: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], rerun: _Rerun
) -> None:
    with pytest.raises(ValueError, match=said):
        Viewer(where)
    part = tmp_path / "run"
    assert main(["pose", "train", "--out", str(part), "--view", where]) == 2
    assert "--view" in capsys.readouterr().err
    assert not part.exists()


def test_without_rerun_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ImportError, match=r"pip install -e '.\[view\]'"):
        Viewer("live")


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun is not installed")
def test_a_recording_is_one_that_rerun_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))  # where the tool keeps its settings
    part, file = bracket(), tmp_path / "it.rrd"
    given = CloudInput(name="it", points_m=cloud_of(part, TRUTH), object=part.name)
    estimate = PoseEstimate(name="it", object=part.name, status="ok", reason="",
                            camera_from_model=TRUTH)  # fmt: skip
    with open_viewer(str(file)) as viewer:
        assert viewer is not None
        viewer.show_depth(*_depth())
        viewer.show_pose(given, estimate, part)
        viewer.show_step(Progress(step=7, steps=9, numbers={"network/loss": 0.5}))
    tool = [str(Path(sys.executable).parent / "rerun"), "rrd", "print", "-v", str(file)]
    said = subprocess.run(tool, capture_output=True, text=True, check=True).stdout
    for name in ("camera/depth", "camera/image", "confidence", "posed/model", "network/loss"):
        assert name in said, said
