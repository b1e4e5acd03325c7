"""``pose predict`` with boxes, detections and label maps, an oracle in place of the network."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from tests.pages.read_page import read_page
from tests.pose.synthetic_objects import (
    K,
    Oracle,
    bottle,
    bracket,
    pose_at,
    tiny_weights,
    view_of,
)

from depthpose.cli import main
from depthpose.cli.pose import methods
from depthpose.core.camera import Camera, write_camera
from depthpose.core.files import read_image, write_depth_png
from depthpose.pose.datasets import encode_rle
from depthpose.pose.datasets.masks import find_mask_box
from depthpose.pose.search import nothing_found
from depthpose.pose.types import PoseEstimate, ViewInput
from depthpose.pose.weights import write_pose_weights

Scene = tuple[list[str], dict[str, torch.Tensor]]
POSES = {"bracket": pose_at(-0.12, seed=1), "bottle": pose_at(0.14, seed=2)}


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """A depth image of two objects, what poses them, and their masks."""
    weights = tmp_path / "known.safetensors"
    oracle = Oracle(tiny_weights(bracket(), bottle()), list(POSES.values()))
    write_pose_weights(weights, oracle.weights)
    monkeypatch.setattr(methods, "GeoPoseNet", lambda *_: oracle)
    views = {m.name: view_of(m, POSES[m.name]) for m in (bracket(), bottle())}
    depth_m = torch.stack([d.nan_to_num(9.0) for d, _ in views.values()]).amin(0)
    (tmp_path / "depth").mkdir()
    depth_m = torch.where(depth_m < 9, depth_m, torch.nan)
    write_depth_png(tmp_path / "depth" / "000012.png", depth_m, 0.001)
    write_camera(tmp_path / "camera.json", Camera(width=320, height=240, K=K, depth_unit_m=0.001))
    words = ["pose", "predict", "--weights", str(weights), "--out", str(tmp_path / "out")]
    words += ["--camera", str(tmp_path / "camera.json")]
    words += ["--depth", str(tmp_path / "depth" / "000012.png")]
    return words, {name: mask for name, (_, mask) in views.items()}


def answers(folder: Path) -> dict[str, dict]:
    return {row["name"]: row for row in json.loads((folder / "out/poses.json").read_text())}


def assert_right(rows: dict[str, dict], expected: dict[str, str]) -> None:
    assert {name: row["object"] for name, row in rows.items()} == expected
    for row in rows.values():
        pose = torch.tensor(row["camera_from_model"])
        truth = POSES[row["object"]].t_m
        assert float((pose[:3, 3] - truth).norm()) < 0.005, row["name"]


def edges(mask: torch.Tensor, more: int = 2) -> list[int]:
    left, top, width, height = find_mask_box(mask)
    return [left - more, top - more, left + width + more, top + height + more]


def test_a_box_is_enough(scene: Scene, tmp_path: Path) -> None:
    words, masks = scene
    box = ",".join(map(str, edges(masks["bracket"])))
    assert main([*words, "--box", box, "--object", "bracket"]) == 0
    assert_right(answers(tmp_path), {"000012": "bracket"})
    # Another box needs another folder, as every setting does.
    assert main([*words, "--box", "1,1,50,50", "--object", "bracket"]) == 2


def test_a_box_is_drawn_beside_the_pose(scene: Scene, tmp_path: Path) -> None:
    words, masks = scene
    left, top, right, bottom = edges(masks["bracket"], 6)
    box = f"{left},{top},{right},{bottom}"
    assert main([*words, "--box", box, "--object", "bracket"]) == 0
    picture = read_image(tmp_path / "out/000012.pose.png")
    border = torch.cat([picture[:, top, left:right], picture[:, top:bottom, left]], 1)
    red, green, blue = border.mean(1).tolist()
    assert min(red, green) > 0.75, "yellow, but where the pose lies over it"
    assert blue < 0.3
    page = read_page(tmp_path / "out/report.html")
    captions = page.texts["figcaption"]
    assert any("the estimated pose blue, the box yellow" in caption for caption in captions)


def test_boxes_are_those_of_every_image_of_a_folder(scene: Scene, tmp_path: Path) -> None:
    words, masks = scene
    depth = tmp_path / "depth"
    (depth / "000013.png").write_bytes((depth / "000012.png").read_bytes())
    words[-1] = str(depth)
    box = ",".join(map(str, edges(masks["bracket"])))
    assert main([*words, "--box", box, "--object", "bracket"]) == 0
    assert_right(answers(tmp_path), {"000012": "bracket", "000013": "bracket"})


def test_boxes_that_cannot_be_are_named(
    scene: Scene,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words, _ = scene
    for more, reason in (
        (["--box", "9,1,2,50", "--object", "bracket"], "the right edge is to lie right"),
        (["--box", "1,1,50,50"], "say which by --object"),
    ):
        assert main([*words, *more]) == 2
        assert reason in capsys.readouterr().err
    assert main([*words, "--box", "400,1,600,50", "--object", "bracket"]) == 1
    assert "its centre lies outside of the image of 320x240" in capsys.readouterr().err


def coco(masks: dict[str, torch.Tensor], image_id: int) -> list[dict]:
    rows = []
    for k, (name, mask) in enumerate(masks.items(), 1):
        x0, y0, x1, y1 = edges(mask)
        rows.append({"image_id": image_id, "category_id": k, "bbox": [x0, y0, x1 - x0, y1 - y0],
                     "score": 0.5 + 0.1 * k, "name": name})  # fmt: skip
    return rows


def test_detections_of_coco_are_posed(scene: Scene, tmp_path: Path) -> None:
    words, masks = scene
    file = tmp_path / "found.json"
    file.write_text(json.dumps(coco(masks, 12)))
    assert main([*words, "--detections", str(file)]) == 0
    # The surest is the first.
    assert_right(answers(tmp_path), {"000012_1": "bottle", "000012_2": "bracket"})


def test_numbers_of_classes_need_names(
    scene: Scene,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words, masks = scene
    rows = [{k: v for k, v in row.items() if k != "name"} for row in coco(masks, 12)]
    counts, height, width = encode_rle(masks["bottle"])
    rows[1]["segmentation"] = {"size": [height, width], "counts": list(counts)}
    file = tmp_path / "found.json"
    file.write_text(json.dumps(rows))
    words = [*words, "--detections", str(file)]
    assert main(words) == 2
    assert "class 1 is a number without a name" in capsys.readouterr().err
    assert main([*words, "--labels", "1=bracket,2=pot"]) == 2
    assert "class 2 is 'pot', which is no known object" in capsys.readouterr().err
    assert main([*words, "--labels", "1=bracket,2=bottle"]) == 0
    assert_right(answers(tmp_path), {"000012_1": "bottle", "000012_2": "bracket"})


def test_a_folder_of_yolo_s_text_is_posed(
    scene: Scene,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words, masks = scene
    (tmp_path / "labels").mkdir()
    x0, y0, x1, y1 = edges(masks["bracket"])
    shares = ((x0 + x1) / 640, (y0 + y1) / 480, (x1 - x0) / 320, (y1 - y0) / 240)
    line = " ".join(map(str, (0, *shares, 0.9)))
    (tmp_path / "labels" / "000012.txt").write_text(line)
    depth = tmp_path / "depth"
    (depth / "000013.png").write_bytes((depth / "000012.png").read_bytes())
    words[-1] = str(depth)
    words = [*words, "--detections", str(tmp_path / "labels"), "--labels", "0=bracket"]
    assert main(words) == 2
    assert "no file of detections called '000013'" in capsys.readouterr().err
    (tmp_path / "labels" / "000013.txt").write_text("")
    assert main(words) == 0
    rows = answers(tmp_path)
    missing = rows.pop("000013")
    assert_right(rows, {"000012": "bracket"})
    assert (missing["object"], missing["status"]) == ("bracket", "too few points")
    assert "nothing of it is detected in this image" in missing["reason"]
    page = read_page(tmp_path / "out/report.html")
    assert any("nothing of it is detected" in cell for cell in page.texts["td"])


@pytest.mark.parametrize("damaged", ["depth", "mask"])
def test_a_damaged_file_stops_no_other(scene: Scene, tmp_path: Path, damaged: str) -> None:
    words, masks = scene
    depth = tmp_path / "depth"
    good = (depth / "000012.png").read_bytes()
    (depth / "000013.png").write_bytes(good[:2000] if damaged == "depth" else good)
    words[-1] = str(depth)
    (tmp_path / "regions").mkdir()
    if damaged == "depth":
        x0, y0, x1, y1 = edges(masks["bracket"])
        shares = ((x0 + x1) / 640, (y0 + y1) / 480, (x1 - x0) / 320, (y1 - y0) / 240)
        for name in ("000012", "000013"):
            line = " ".join(map(str, (0, *shares, 0.9)))
            (tmp_path / "regions" / f"{name}.txt").write_text(line)
        words += ["--detections", str(tmp_path / "regions"), "--labels", "0=bracket"]
        good_name, bad_name = "000012", "000013"
    else:
        Image.fromarray(masks["bracket"].byte().numpy() * 4).save(tmp_path / "regions/000012.png")
        (tmp_path / "regions/000013.png").write_bytes(b"torn")
        words += ["--mask", str(tmp_path / "regions"), "--labels", "4=bracket"]
        good_name, bad_name = "000012_4", "000013_4"
    assert main(words) == 1
    rows = answers(tmp_path)
    assert rows.pop(bad_name)["status"] == "unreadable"
    assert_right(rows, {good_name: "bracket"})


def test_what_a_detector_did_not_find_has_a_row(scene: Scene, tmp_path: Path) -> None:
    words, masks = scene
    file = tmp_path / "found.json"
    file.write_text(json.dumps(coco({"bracket": masks["bracket"]}, 12)))
    words += ["--detections", str(file), "--labels", "1=bracket,2=bottle"]
    assert main(words) == 0
    rows = answers(tmp_path)
    assert rows.pop("000012_2")["object"] == "bottle"
    assert_right(rows, {"000012_1": "bracket"})


def test_a_label_map_shows_several_objects(
    scene: Scene,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words, masks = scene
    labels = masks["bracket"] * 4 + (masks["bottle"] & ~masks["bracket"]) * 9
    Image.fromarray(labels.byte().numpy()).save(tmp_path / "labels.png")
    words = [*words, "--mask", str(tmp_path / "labels.png")]
    assert main(words) == 2
    assert "which number of the mask is which by --labels 1=bracket,2=bottle" in (
        capsys.readouterr().err
    )
    assert main([*words, "--labels", "bracket=bracket"]) == 2
    assert "the objects of a mask have numbers" in capsys.readouterr().err
    assert main([*words, "--labels", "4=bracket"]) == 2
    assert "pixels have the number 9, which the labels do not name" in capsys.readouterr().err
    assert main([*words, "--labels", "4=bracket,9=bottle"]) == 0
    assert_right(answers(tmp_path), {"000012_4": "bracket", "000012_9": "bottle"})


def test_options_of_regions_are_refused_where_they_do_nothing(
    scene: Scene,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words, masks = scene
    file = tmp_path / "found.json"
    file.write_text(json.dumps(coco(masks, 12)))
    for more, reason in (
        (["--labels", "1=bracket"], "--labels: has no effect here"),
        (["--box", "1,1,9,9", "--labels", "1=bracket"], "all boxes are of one object"),
        (["--box", "1,1,9,9", "--detections", str(file)], "say where objects are; give one"),
        (["--box", "1,1,9,9", "2,2,9,9", "--engine", "ray"], "one pose for each depth image"),
        (["--detections", str(file), "--engine", "ray"], "one pose for each depth image"),
        (["--box", "1,1,9,9", "--mask", str(file), "--engine", "ray"], "give one of them"),
    ):
        assert main([*words, *more]) == 2
        assert reason in capsys.readouterr().err


BASE = [0.0, -1, 0, 0.5, 1, 0, 0, -0.25, 0, 0, 1, 1.5, 0, 0, 0, 1]


def test_poses_stand_in_the_frame_of_a_robot_too(
    scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, masks = scene
    words += ["--box", ",".join(map(str, edges(masks["bracket"]))), "--object", "bracket"]
    given = [f"{value:g}" for value in BASE]
    assert main([*words, "--base-from-camera", *given]) == 0
    (row,) = answers(tmp_path).values()
    base = torch.tensor(BASE, dtype=torch.float64).reshape(4, 4)
    pose = torch.tensor(row["camera_from_model"], dtype=torch.float64)
    expected = base @ pose
    torch.testing.assert_close(torch.tensor(row["base_from_model"]), expected.float())
    said = capsys.readouterr().out
    assert ", ".join(f"{v:.4f}" for v in expected[:3, 3].tolist()) in said
    page = (tmp_path / "out/report.html").read_text()
    assert "base_from_model: R | t [m]" in page
    # A file gives the same; another base is another run.
    (tmp_path / "base.txt").write_text(json.dumps(base.tolist()))
    assert main([*words, "--base-from-camera", str(tmp_path / "base.txt")]) == 0
    assert main(words) == 2
    words[words.index("--out") + 1] = str(tmp_path / "plain")
    assert main(words) == 0
    (plain,) = json.loads((tmp_path / "plain/poses.json").read_text())
    assert plain["base_from_model"] is None


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ("1 2 3", "--base-from-camera: 3 numbers; give the 16"),
        (" ".join(map(str, [*BASE[:3], 900, *BASE[4:]])), "is that in millimetres"),
        (" ".join(map(str, [2, *BASE[1:]])), "base_from_camera is no rigid transform"),
        ("lost.txt", "--base-from-camera: cannot be read as numbers"),
    ],
)
def test_a_base_that_is_none_is_refused(
    scene: Scene, capsys: pytest.CaptureFixture[str], given: str, reason: str
) -> None:
    words, _ = scene
    words += ["--box", "1,1,90,90", "--object", "bracket", "--base-from-camera", *given.split()]
    assert main(words) == 2
    assert reason in capsys.readouterr().err


def test_every_object_that_is_looked_for_has_a_row(
    scene: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The bracket is found, the bottle is not: tables, poses.json and page say both."""
    words, _ = scene

    def find(_: Oracle, view: ViewInput, *, objects: Sequence[str]) -> list[PoseEstimate]:
        rows = [nothing_found(view, name, [], 0.0) for name in objects]
        if bool(view.depth_m.isfinite().any()):
            rows[0] = PoseEstimate(
                name="x", object="bracket", status="ok", camera_from_model=POSES["bracket"]
            )
        return [replace(row, name=f"{view.name}_{k}") for k, row in enumerate(rows)]

    monkeypatch.setattr(Oracle, "find", find)
    write_depth_png(tmp_path / "depth" / "dark.png", torch.full((240, 320), torch.nan), 0.001)
    words[-1] = str(tmp_path / "depth")
    assert main(words) == 0
    rows = answers(tmp_path)
    assert {name: (row["object"], row["status"]) for name, row in rows.items()} == {
        "000012_0": ("bracket", "ok"),
        "000012_1": ("bottle", "doubtful"),
        "dark_0": ("bracket", "too few points"),
        "dark_1": ("bottle", "too few points"),
    }
    said = capsys.readouterr().out
    assert "2 inputs, 4 answers: 1 doubtful, 1 ok, 2 too few points" in said
    reason = rows["000012_1"]["reason"]
    assert "bottle" in reason
    assert f"000012_1: no bottle: {reason}" in said
    page = read_page(tmp_path / "out/report.html")
    assert any(reason in cell for cell in page.texts["td"])
    # A rerun looks for nothing again.
    monkeypatch.setattr(Oracle, "find", lambda *_, **__: pytest.fail("it was searched again"))
    assert main(words) == 0
    assert answers(tmp_path) == rows
