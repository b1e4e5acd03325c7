import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.depth.constant_selection import sure_of
from tests.synthetic_street import make_street

from depthpose.core.camera import StereoRig, read_camera
from depthpose.core.errors import InputError
from depthpose.core.files import read_image, read_map
from depthpose.core.run_folder import read_settings
from depthpose.demo import _choose_methods, make_demo, read_motorcycle
from depthpose.depth.disparity import warp_right_to_left
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.synthesis import make_synthesiser
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.predictions import read_predictions
from depthpose.pose.synthetic import PARTS

_SCENE = r'<script type="application/json">(.*?)</script>'


def test_the_disparity_carries_one_view_to_the_other() -> None:
    sample = make_street(0.25)
    assert sample.input.right is not None
    assert sample.truth.disparity_px is not None
    warped = warp_right_to_left(sample.input.right, sample.truth.disparity_px)
    error = (warped - sample.input.left).abs().mean(0)
    shifted = (sample.input.right - sample.input.left).abs().mean(0)
    seen = torch.isfinite(error)
    assert error[seen].median() < 0.3 * shifted[seen].median()


def test_the_road_is_where_geometry_says() -> None:
    sample = make_street(0.25)
    rig = sample.input.camera
    assert isinstance(rig, StereoRig)
    assert sample.truth.depth_m is not None
    v = rig.height - 1
    expected_m = 1.65 * float(rig.K[1, 1]) / (v - float(rig.K[1, 2]))
    assert sample.truth.depth_m[v, rig.width // 2].item() == pytest.approx(expected_m, rel=1e-6)


def test_the_street_is_the_same_every_time() -> None:
    assert torch.equal(make_street(0.1).input.left, make_street(0.1).input.left)


def test_the_demo_leaves_a_page_a_table_and_a_usable_pair(after_demo: Path, tmp_path: Path) -> None:
    demo = after_demo / "out/demo"
    html = (demo / "report.html").read_text()
    assert html.count("data:image/") == 4 + 4 + 2 + 4 + 3 + 3 + 3 + 3
    assert html.index("data:image/") < html.index("<table"), "pictures come first"
    assert html.count(' height="') >= 24, "pictures have their sizes, so that nothing moves"
    assert len(html) < 1e7
    assert "://" not in html, "the page loads nothing"
    scenes = [json.loads(text) for text in re.findall(_SCENE, html, re.DOTALL)]
    assert len(scenes) == 3 + 2 + 1
    assert all(scene["layers"][0]["count"] > 10_000 for scene in scenes)
    rows = json.loads((demo / "depths.json").read_text())
    assert [(row["scene"], row["input"]) for row in rows] == [
        ("motorcycle", "both images"),
        ("motorcycle", "both images"),
        ("street", "both images"),
        ("street", "both images"),
        ("street", "one image"),
    ]
    headings = re.findall(r"<h2[^>]*>(.*?)</h2>", html)
    assert headings[0] == "Parts on a table", "poses lead, one image comes last"
    assert headings[1] == "The motorcycle"
    assert headings[-1].endswith("one image")
    assert all(0 < row["abs_rel"] < 0.2 for row in rows if row["input"] == "both images"), rows
    assert 0 < rows[-1]["abs_rel"] < 0.6
    assert rows[-1]["coverage"] == 1.0
    camera = read_camera(demo / "street/camera.json")
    assert read_image(demo / "street/left.png").shape == (3, camera.height, camera.width)
    depth_m = read_map(demo / "selecting-generator/street.depth_m.npy")
    assert depth_m.shape == (camera.height, camera.width)
    assert read_settings(demo) == {"command": "demo"}
    written = {path.name for path in demo.iterdir()} - {"run.json", ".lock"}
    for k, name in enumerate(sorted(written)):  # nothing is written that was not claimed
        (tmp_path / f"elsewhere{k}" / name).mkdir(parents=True)
        with pytest.raises(InputError, match=f"{name}: is there already"):
            make_demo(tmp_path / f"elsewhere{k}")


def test_the_demo_writes_over_nothing_of_somebody_else(tmp_path: Path) -> None:
    (tmp_path / "part").mkdir()
    with pytest.raises(InputError, match="part: is there already, and no run of this command"):
        make_demo(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["part"]


def test_without_a_matcher_the_pair_is_left_to_opencv() -> None:
    net = FakestereoNet(None, make_synthesiser(sure_of(3)))
    street = make_street(0.1)
    methods = _choose_methods(net, replace(street, input=replace(street.input, name="street")))
    assert {method.name: method.views for method in methods} == {
        "selecting generator": "one image",
        "SGBM, holes filled": "both images",
    }


def test_the_demo_poses_parts_and_answers_none_wrongly(after_demo: Path) -> None:
    demo = after_demo / "out/demo"
    rows = json.loads((demo / "poses.json").read_text())
    assert {row["object"] for row in rows} == set(PARTS)
    answered = [row for row in rows if row["status"] == "ok"]
    assert len(answered) >= 3
    assert all(row["of_diameter"] < 0.1 for row in answered)
    assert {row["object"] for row in rows if row["copies"]} == {"mug"}, "its handle is hidden"
    assert all(row["reason"] for row in rows if row not in answered)
    (scene, *_) = re.findall(_SCENE, (demo / "report.html").read_text(), re.DOTALL)
    names = [layer["name"] for layer in json.loads(scene)["layers"]]
    assert names.count("true box") == len(PARTS)
    assert names.count("posed model") == len(answered)
    found = GeoPoseNet.load("parts").estimate(
        depth=demo / "part/depth.png",
        mask=demo / "part/mask.png",
        camera=demo / "part/camera.json",
        object="flange",
    )
    assert found.is_ok, found.reason
    assert len(read_predictions(demo / "geo-posenet")) == len(PARTS)


def test_the_motorcycle_is_consistent() -> None:
    """The published calibration and disparity: the right view looked up by it is the left one."""
    sample = read_motorcycle()
    assert sample is not None
    assert sample.input.right is not None
    assert sample.truth.disparity_px is not None
    assert sample.truth.depth_m is not None
    warped = warp_right_to_left(sample.input.right, sample.truth.disparity_px)
    assert float((warped - sample.input.left).abs().nanmedian()) < 0.03
    known_m = sample.truth.depth_m[torch.isfinite(sample.truth.depth_m)]
    assert 1.5 < float(known_m.min()) < float(known_m.median()) < 6
