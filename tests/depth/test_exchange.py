"""Depth as Open3D, COLMAP and nerfstudio take it: each read back as those tools read it."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from depthpose.cli import main
from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError, MissingExtraError
from depthpose.core.files import write_json, write_map
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.predictions import write_colmap_map
from depthpose.depth.types import DepthEstimate, Match, StereoInput

H, W, F = 4, 6, 8.0
DEPTH_M = torch.arange(1, H * W + 1, dtype=torch.float32).reshape(H, W) * 4
DEPTH_M[1, 2] = torch.nan


def pair() -> StereoInput:
    K = torch.tensor([[F, 0, 2.5], [0, F, 1.5], [0, 0, 1]], dtype=torch.float64)
    rig = StereoRig(width=W, height=H, K=K, baseline_m=0.5)
    left = torch.rand(3, H, W, generator=torch.Generator().manual_seed(0))
    return StereoInput(name="a", left=left, right=left.flip(2), camera=rig)


class KnowsDepth:
    """A matcher that answers ``DEPTH_M`` for every pair."""

    def match(self, left: torch.Tensor, right: torch.Tensor) -> Match:  # noqa: ARG002
        return Match(disparity_px=F * 0.5 / DEPTH_M)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Predictions of a.jpg and b.jpg, as ``depth predict`` leaves them."""
    folder = tmp_path / "results"
    for name in "ab":
        write_map(folder / f"{name}.depth_m.npy", DEPTH_M)
    images = {name: str(tmp_path / "images" / "cam0" / f"{name}.jpg") for name in "ab"}
    write_json(folder / "sources.json", images)
    return folder


def export(results: Path, out: Path, *words: str) -> int:
    return main(["data", "export-depth", str(results), "--out", str(out), *words])


def same(found: np.ndarray, unknown: float = 0.0) -> bool:
    return np.allclose(found, DEPTH_M.nan_to_num(unknown).numpy(), atol=1e-3)


# Open3D


def test_an_estimate_holds_its_coloured_cloud_up_to_a_distance() -> None:
    seen = pair()
    cloud = FakestereoNet(KnowsDepth()).estimate_pair(seen).cloud(far_m=80.0)
    is_near = DEPTH_M.flatten() <= 80
    assert torch.allclose(cloud.points[:, 2], DEPTH_M.flatten()[is_near])
    assert cloud.color is not None
    assert torch.equal(cloud.color, seen.left.permute(1, 2, 0).reshape(-1, 3)[is_near])
    x_m, y_m, z_m = cloud.points[0].tolist()
    assert (x_m, y_m, z_m) == pytest.approx((-2.5 / F * 4, -1.5 / F * 4, 4.0))


def test_an_estimate_from_files_says_that_it_has_no_colours() -> None:
    with pytest.raises(InputError, match="came without its image; estimate again, or set seen="):
        DepthEstimate(depth_m=DEPTH_M, disparity_px=DEPTH_M).to_open3d()


def test_without_open3d_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    found = FakestereoNet(KnowsDepth()).estimate_pair(pair())
    with pytest.raises(MissingExtraError, match=r"pip install -e '.\[open3d\]'"):
        found.to_open3d()


@pytest.mark.skipif(importlib.util.find_spec("open3d") is None, reason="open3d is not installed")
def test_open3d_gets_the_same_points_and_colours() -> None:
    found = FakestereoNet(KnowsDepth()).estimate_pair(pair())
    cloud, theirs = found.cloud(), found.to_open3d()
    assert type(theirs).__name__ == "PointCloud"
    assert np.allclose(np.asarray(theirs.points), cloud.points.numpy())
    assert cloud.color is not None
    assert np.allclose(np.asarray(theirs.colors), cloud.color.numpy())


# COLMAP


def read_as_colmap_does(path: Path) -> np.ndarray:
    """Three numbers, each before an ampersand, then float32 of (width, height) in Fortran order."""
    width, height, channels, body = path.read_bytes().split(b"&", 3)
    shape = (int(width), int(height), int(channels))
    return np.frombuffer(body, np.float32).reshape(shape, order="F").transpose(1, 0, 2)[..., 0]


def test_colmap_maps_come_back(tmp_path: Path) -> None:
    write_colmap_map(tmp_path / "a.bin", DEPTH_M)
    assert (tmp_path / "a.bin").read_bytes().startswith(b"6&4&1&")
    assert same(read_as_colmap_does(tmp_path / "a.bin"))


def test_infinite_depth_is_no_colmap_map(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds infinity"):
        write_colmap_map(tmp_path / "a.bin", DEPTH_M / 0)


def test_predictions_go_where_colmap_looks_for_them(results: Path, tmp_path: Path) -> None:
    dense = tmp_path / "dense"
    assert export(results, dense, "--format", "colmap", "--scale", "0.5") == 0
    maps = sorted(path.name for path in (dense / "stereo" / "depth_maps").iterdir())
    assert maps == ["a.jpg.geometric.bin", "b.jpg.geometric.bin"]
    assert same(2 * read_as_colmap_does(dense / "stereo" / "depth_maps" / maps[0]))


def test_images_in_folders_keep_colmaps_names(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--format", "colmap", "--images")
    (tmp_path / "images").mkdir()
    assert export(results, tmp_path / "dense", *words, str(tmp_path / "images")) == 0
    assert (tmp_path / "dense/stereo/depth_maps/cam0/a.jpg.geometric.bin").is_file()
    (tmp_path / "others").mkdir()
    assert export(results, tmp_path / "two", *words, str(tmp_path / "others")) == 2
    assert "does not lie in --images" in capsys.readouterr().err


# nerfstudio


def data_set(folder: Path, names: str) -> Path:
    frames = [{"file_path": f"images/{n}.jpg", "transform_matrix": []} for n in names]
    write_json(folder / "transforms.json", {"fl_x": F, "frames": frames})
    return folder


def test_predictions_become_depth_of_a_nerfstudio_data_set(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = data_set(tmp_path / "data", "ba")
    before = (data / "transforms.json").read_bytes()
    assert export(results, data, "--format", "nerfstudio") == 0
    transforms = json.loads((data / "transforms_depth.json").read_text())
    assert [f["depth_file_path"] for f in transforms["frames"]] == ["depths/b.png", "depths/a.png"]
    assert transforms["fl_x"] == F
    units = np.asarray(Image.open(data / transforms["frames"][0]["depth_file_path"]))
    assert units.dtype == np.uint16
    is_far = DEPTH_M.numpy() > 65.535
    depth_m = units * transforms["depth_unit_scale_factor"]
    assert np.allclose(depth_m, np.where(is_far, 0, DEPTH_M.nan_to_num().numpy()), atol=1e-3)
    assert f"{2 * is_far.sum()} pixels are beyond 65.535 m" in capsys.readouterr().err
    assert (data / "transforms.json").read_bytes() == before


def test_npy_files_hold_what_is_far_too(results: Path, tmp_path: Path) -> None:
    assert export(results, tmp_path / "data", "--format", "nerfstudio", "--files", "npy") == 0
    assert same(np.load(tmp_path / "data" / "depths" / "a.npy") * 0.001)


@pytest.mark.parametrize(
    ("frames", "said"),
    [("abc", "frame 'c' has no prediction"), (None, "has no list of 'frames'")],
)
def test_a_frame_without_depth_is_refused_before_anything_is_written(
    results: Path, tmp_path: Path, frames: str | None, said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    data = tmp_path / "data"
    if frames is None:
        write_json(data / "transforms.json", {"frames": 3})
    else:
        data_set(data, frames)
    assert export(results, data, "--format", "nerfstudio") == 2
    assert said in capsys.readouterr().err
    assert [path.name for path in data.iterdir()] == ["transforms.json"]


# both


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--scale", "0"], "--scale 0: units per metre must be positive"),
        (["--images", "."], "--images: has no effect here; it is for --format colmap"),
    ],
)
def test_options_that_make_no_sense_are_refused(
    results: Path, tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(results, tmp_path / "o", "--format", "nerfstudio", *words) == 2
    assert said in capsys.readouterr().err


def test_a_folder_without_predictions_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(tmp_path, tmp_path / "o", "--format", "colmap") == 2
    assert "no NAME.depth_m.npy in it" in capsys.readouterr().err
    assert export(tmp_path / "nowhere", tmp_path / "o", "--format", "colmap") == 2
    assert "there is no such file or folder" in capsys.readouterr().err


def test_files_of_somebody_else_are_not_written_over(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = tmp_path / "dense" / "stereo" / "depth_maps" / "b.jpg.geometric.bin"
    there.parent.mkdir(parents=True)
    there.write_bytes(b"theirs")
    assert export(results, tmp_path / "dense", "--format", "colmap") == 2
    assert "no run of this command wrote it" in capsys.readouterr().err
    assert there.read_bytes() == b"theirs"
