"""``pose predict --color``: a colour picture beside a depth image, and what does not fit."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tests.pose.textured_objects import (
    HEIGHT,
    WIDTH,
    K,
    drawn_view,
    random_pose,
    saved_glb,
    textured_box,
    trimesh,
)

from depthpose.cli import main
from depthpose.core.camera import Camera, write_camera
from depthpose.core.errors import Notice
from depthpose.core.files import write_depth_png, write_image
from depthpose.core.rigid import Rigid
from depthpose.pose.registration import Registration
from depthpose.pose.types import PoseEstimate, ViewInput


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A box with print, its depth image, mask, camera, and two colour pictures of it."""
    folder = tmp_path_factory.mktemp("box")
    mesh, pose = textured_box(), random_pose(3)
    saved_glb(mesh, folder / "box.glb")
    trimesh.Trimesh(mesh.vertices, mesh.faces).export(folder / "plain.stl")
    view = drawn_view(mesh, pose)
    assert view.color is not None
    write_depth_png(folder / "view.png", view.depth_m, 0.0001)
    write_image(folder / "mask.png", view.mask.float().expand(3, -1, -1))
    (folder / "pictures").mkdir()
    write_image(folder / "pictures/view.png", view.color.rgb)
    write_image(folder / "small.png", view.color.rgb[:, ::2, ::2])
    camera = Camera(width=WIDTH, height=HEIGHT, K=K, depth_unit_m=0.0001)
    write_camera(folder / "camera.json", camera)
    own = Camera(width=WIDTH // 2, height=HEIGHT // 2, K=K / torch.tensor([[2.0], [2], [1]]))
    write_camera(folder / "own.json", own)
    np.savetxt(folder / "beside.txt", np.eye(4) + 0.05 * np.eye(4, k=3))
    return folder


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[ViewInput]:
    """What an estimator was given; it refuses all."""
    given: list[ViewInput] = []

    def refuse(self: Registration, inputs: Sequence[Any], **_: object) -> list[PoseEstimate]:
        del self
        given.extend(inputs)
        return [
            PoseEstimate(name=v.name, object=v.object, status="not observable", reason="a test")
            for v in inputs
        ]

    monkeypatch.setattr(Registration, "estimate_many", refuse)
    monkeypatch.setattr(Registration, "find", lambda self, view, **_: refuse(self, [view])[:0])
    return given


def predict(folder: Path, out: Path, *words: str, cad: str = "box.glb") -> int:
    files = ["--cad", str(folder / cad), "--cad-unit", "m", "--depth", str(folder / "view.png")]
    files += ["--camera", str(folder / "camera.json"), "--out", str(out)]
    paths = [str(folder / word[1:]) if word.startswith("@") else word for word in words]
    return main(["pose", "predict", "--method", "register", *files, *paths])


MASK = ("--mask", "@mask.png")


@pytest.mark.parametrize("color", ["@pictures", "@pictures/view.png"])
def test_a_picture_goes_with_its_depth_image(
    drawn: Path, tmp_path: Path, seen: list[ViewInput], color: str
) -> None:
    assert predict(drawn, tmp_path / "out", *MASK, "--color", color) == 0
    assert predict(drawn, tmp_path / "found", "--color", color) == 0
    for view in seen:
        assert view.color is not None
        assert view.color.rgb.shape == (3, HEIGHT, WIDTH)
        assert torch.equal(view.color.K, view.K)
    assert len(seen) == 2
    # Results with colour are other results.
    assert predict(drawn, tmp_path / "out", *MASK) == 2


def test_a_colour_camera_of_its_own(drawn: Path, tmp_path: Path, seen: list[ViewInput]) -> None:
    words = ("--color", "@small.png", "--color-camera", "@own.json")
    words += ("--color-from-depth", "@beside.txt")
    assert predict(drawn, tmp_path / "out", *MASK, *words) == 0
    (view,) = seen
    assert view.color is not None
    assert float(view.color.K[0, 0]) == 300
    assert isinstance(view.color.color_from_depth, Rigid)
    assert view.color.color_from_depth.t_m.tolist() == pytest.approx([0.05, 0, 0])


@pytest.mark.slow
def test_a_model_without_colours_is_named(
    drawn: Path, tmp_path: Path, seen: list[ViewInput]
) -> None:
    with pytest.warns(Notice, match="the model file of plain has no colours"):
        predict(drawn, tmp_path / "out", *MASK, "--color", "@pictures", cad="plain.stl")
    assert seen


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--color-camera", "@own.json"), "--color-camera: has no effect here; it is of --color"),
        (("--color", "@pictures/view.png", "--color-from-depth", "@camera.json"),
         "cannot be read as numbers"),
        (("--color", "@nowhere.png"), "nowhere.png"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_said(
    drawn: Path,
    tmp_path: Path,
    words: tuple[str, ...],
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert predict(drawn, tmp_path / "out", *MASK, *words) == 2
    assert said in capsys.readouterr().err


def test_a_picture_of_another_size_or_name(
    drawn: Path, tmp_path: Path, seen: list[ViewInput], capsys: pytest.CaptureFixture[str]
) -> None:
    predict(drawn, tmp_path / "out", *MASK, "--color", "@small.png")
    (row,) = json.loads((tmp_path / "out/poses.json").read_text())
    assert row["status"] == "unreadable"
    assert "the colour image is 160x120 and the depth image 320x240" in row["reason"]
    assert not seen
    (tmp_path / "pictures").mkdir()
    for name in ("other", "third"):
        shutil.copy(drawn / "small.png", tmp_path / f"pictures/{name}.png")
    words = (*MASK, "--color", str(tmp_path / "pictures"))
    assert predict(drawn, tmp_path / "again", *words) == 2
    assert "no colour picture called 'view'" in capsys.readouterr().err
