"""``pose predict`` from the words to the files, with an oracle in place of the network."""

import json
import os
import re
import shutil
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.pages.read_page import read_page
from tests.pose.synthetic_frames import make_dataset
from tests.pose.synthetic_objects import (
    K,
    Oracle,
    bottle,
    bracket,
    cloud_of,
    pose_at,
    tiny_weights,
    view_of,
)

from depthpose.cli import main
from depthpose.cli.pose import methods
from depthpose.cli.pose.dataset import choose_objects, match_names
from depthpose.core.camera import Camera, write_camera
from depthpose.core.errors import InputError
from depthpose.core.files import (
    CLOUD_READERS,
    PointCloud,
    read_cloud,
    read_image,
    write_cloud,
    write_depth_png,
    write_image,
)
from depthpose.pose.datasets import BopDataset
from depthpose.pose.metrics import add_m
from depthpose.pose.networks.baselines import DepthImageConfig, DepthImageNet
from depthpose.pose.predictions import read_bop_results, read_predictions
from depthpose.pose.registration import Registration
from depthpose.pose.types import ObjectModel, ViewInput
from depthpose.pose.weights import write_pose_weights

TRUTH = pose_at(seed=1)


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> BopDataset:
    return make_dataset(tmp_path_factory.mktemp("cli") / "made", frames=2)


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Weights of two objects whose directions are the true ones of ``TRUTH``."""
    return oracle_weights(tmp_path, monkeypatch, Oracle(tiny_weights(bracket(), bottle()), [TRUTH]))


def oracle_weights(folder: Path, monkeypatch: pytest.MonkeyPatch, oracle: Oracle) -> Path:
    path = folder / "known.safetensors"
    write_pose_weights(path, oracle.weights)
    monkeypatch.setattr(methods, "GeoPoseNet", lambda *_: oracle)
    return path


def make_method(models: list[ObjectModel]) -> methods.PoseMethod:
    return methods.PoseMethod(name="m", estimator=Registration(models), settings={})


def poses_of(out: Path) -> dict[str, dict]:
    return {row["name"]: row for row in json.loads((out / "poses.json").read_text())}


def test_a_folder_gives_the_poses_of_clouds_of_every_format(weights: Path, tmp_path: Path) -> None:
    folder = tmp_path / "clouds"
    folder.mkdir()
    points = cloud_of(bracket(), TRUTH)
    for suffix in CLOUD_READERS:
        path = folder / f"of{suffix[1:]}{suffix.upper()}"
        if suffix in (".ply", ".pcd"):
            write_cloud(path, PointCloud(points=points))
        elif suffix == ".npy":
            path.write_bytes(npy_bytes(points.numpy()))
        else:
            np.savetxt(path, points.numpy())
    (folder / "notes.md").write_text("no cloud")
    (folder / ".hidden.txt").write_text("no cloud")
    words = ["--cloud", str(folder), "--object", "bracket", "--weights", str(weights)]
    assert main(["pose", "predict", *words, "--out", str(tmp_path / "out")]) == 0
    found = poses_of(tmp_path / "out")
    assert sorted(found) == ["ofnpy", "ofpcd", "ofply", "oftxt", "ofxyz"]
    assert {row["status"] for row in found.values()} == {"ok"}


def npy_bytes(values: np.ndarray) -> bytes:
    buffer = BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


def test_a_cloud_gives_its_pose_and_the_posed_model(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = cloud_of(bracket(), TRUTH)
    write_cloud(tmp_path / "part.ply", PointCloud(points=1000 * cloud))
    words = ["--cloud", str(tmp_path / "part.ply"), "--unit", "mm", "--object", "bracket"]
    out = tmp_path / "out"
    assert main(["pose", "predict", *words, "--weights", str(weights), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "1 input: 1 ok" in said
    found = read_predictions(out)[0].estimate
    assert found.camera_from_model is not None
    heads, answer = (re.split(r"  +", line) for line in said.splitlines()[1:3])
    assert heads[:5] == ["input", "object", "status", "x, y, z [m]", "qx, qy, qz, qw"]
    assert answer[:3] == ["part", "bracket", "ok"]
    np.testing.assert_allclose(np.array(answer[3].split(", "), float),
                               found.camera_from_model.t_m, atol=1e-4)  # fmt: skip
    turn = Rotation.from_quat(np.array(answer[4].split(", "), float)).as_matrix()
    np.testing.assert_allclose(turn, found.camera_from_model.R, atol=1e-3)
    assert float(add_m(found.camera_from_model, TRUTH, bracket().vertices_m)) < 0.001
    row = poses_of(out)["part"]
    assert {"network", "proposal", "icp", "evidence", "decision"} <= row["seconds"].keys()
    assert torch.tensor(row["covariance"]).shape == (6, 6)
    beside = read_cloud(out / "part.pose.ply")
    assert len(beside.points) == len(cloud) + 5000
    assert beside.color is not None


@pytest.mark.slow
def test_a_depth_image_alone_is_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    truths = [pose_at(-0.13, 0.7, seed=1), pose_at(0.12, 0.9, seed=2)]
    oracle = Oracle(tiny_weights(bracket()), truths)
    weights = oracle_weights(tmp_path, monkeypatch, oracle)
    seen, mask = view_of(bracket(), *truths)
    wall = torch.full((240, 320), 1.2)
    (tmp_path / "depth").mkdir()
    write_depth_png(tmp_path / "depth/two.png", torch.where(mask, seen.float(), wall), 0.001)
    write_depth_png(tmp_path / "depth/wall.png", wall, 0.001)
    write_camera(tmp_path / "c.json", Camera(width=320, height=240, K=K, depth_unit_m=0.001))
    words = ["--depth", str(tmp_path / "depth"), "--camera", str(tmp_path / "c.json")]
    out = tmp_path / "out"
    assert main(["pose", "predict", *words, "--weights", str(weights), "--out", str(out)]) == 0
    assert "\n2 inputs, 3 answers: 1 doubtful, 2 ok; " in capsys.readouterr().out
    rows = poses_of(out)
    assert sorted(rows) == ["two_0", "two_1", "wall"]
    assert rows["wall"]["reason"].startswith("nothing before the background of the image is surely")
    for name in ("two_0", "two_1"):
        assert (out / f"{name}.pose.png").is_file()
        assert len(read_cloud(out / f"{name}.pose.ply").points) > 5000
    assert (out / "report.html").is_file()
    _search_again(["pose", "predict", *words, "--weights", str(weights), "--out"], out, capsys)


def _search_again(words: list[str], out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What was found stays, and what could not be read is read again."""
    depth = out.parent / "depth"
    whole = (depth / "wall.png").read_bytes()
    (depth / "torn.png").write_bytes(whole[:100])
    before = poses_of(out)
    assert main([*words, str(out)]) == 1
    assert "failed: torn: cannot be read" in capsys.readouterr().err
    rows = poses_of(out)
    assert rows.pop("torn")["status"] == "unreadable"
    assert rows == before
    (depth / "torn.png").write_bytes(whole)
    assert main([*words, str(out)]) == 0
    assert poses_of(out)["torn"]["status"] == "doubtful"
    other = shutil.copytree(depth, out.parent / "other")
    assert main([*(str(other) if word == str(depth) else word for word in words), str(out)]) == 2
    assert "is the result of" in capsys.readouterr().err
    (depth / "wall_1.png").write_bytes(whole)
    assert main([*words, str(out)]) == 2
    assert "two depth images are called 'wall' and 'wall_1'" in capsys.readouterr().err
    (depth / "wall_1.png").unlink()
    assert main([*words, str(out), "--batch", "2"]) == 2
    assert "--batch: has no effect here; an image without --mask" in capsys.readouterr().err


def test_results_never_take_the_place_of_inputs(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = frames(tmp_path)
    one = tmp_path / "one"
    one.mkdir()
    for kind in ("depth", "mask"):
        shutil.copy(tmp_path / kind / "seen.png", one / f"{kind}.png")
    write_cloud(one / "scan.ply", PointCloud(points=cloud_of(bracket(), TRUTH)))
    before = {path: path.read_bytes() for path in one.iterdir()}
    depth = ["--depth", str(one / "depth.png"), "--mask", str(one / "mask.png"), *words[4:]]
    cloud = ["--cloud", str(one / "scan.ply"), "--object", "bracket"]
    end = ["--weights", str(weights), "--out", str(one)]
    assert main(["pose", "predict", *depth, *end]) == 0
    shutil.move(one / "run.json", tmp_path / "of_depth.json")  # a cloud has other settings
    assert main(["pose", "predict", *cloud, *end]) == 2
    assert "sources.json: is there already, and no run of this" in capsys.readouterr().err
    for name in ("sources.json", "poses.json", "report.html"):
        (one / name).unlink()
    assert main(["pose", "predict", *cloud, *end]) == 0
    assert (one / "depth.pose.png").is_file()
    assert (one / "scan.pose.ply").is_file()
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize("name", ["poses.json", "report.html", "part.pose.ply", "part.pose.png"])
def test_a_file_of_somebody_else_is_not_written_over(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    write_cloud(tmp_path / "part.ply", PointCloud(points=cloud_of(bracket(), TRUTH)))
    (tmp_path / name).write_text("mine")
    words = ["pose", "predict", "--cloud", str(tmp_path / "part.ply"), "--object", "bracket"]
    assert main([*words, "--weights", str(weights), "--out", str(tmp_path)]) == 2
    assert f"{name}: is there already, and no run of this command wrote it" in (
        capsys.readouterr().err
    )
    assert (tmp_path / name).read_text() == "mine"


def test_a_folder_of_inputs_takes_no_results(
    weights: Path, synthetic: BopDataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = frames(tmp_path)
    end = ["--weights", str(weights), "--out", str(tmp_path / "depth")]
    assert main(["pose", "predict", *words, *end]) == 2
    assert "the inputs lie there, and a second run would take the results" in (
        capsys.readouterr().err
    )


def frames(folder: Path) -> list[str]:
    """A folder of two depth images, one of them without the object, and their masks."""
    depth_m, mask = view_of(bracket(), TRUTH)
    for name, pixels in (("seen", mask), ("hidden", mask & False)):
        (folder / "depth").mkdir(parents=True, exist_ok=True)
        (folder / "mask").mkdir(exist_ok=True)
        write_depth_png(folder / "depth" / f"{name}.png", depth_m, 0.001)
        write_image(folder / "mask" / f"{name}.png", pixels.float().expand(3, -1, -1))
    camera = Camera(width=320, height=240, K=K, depth_unit_m=0.001)
    write_camera(folder / "camera.json", camera)
    words = ["--depth", str(folder / "depth"), "--mask", str(folder / "mask")]
    return [*words, "--camera", str(folder / "camera.json"), "--object", "bracket"]


@pytest.mark.parametrize("with_mask", [True, False])
def test_a_focal_length_is_enough_of_a_camera(
    weights: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    *,
    with_mask: bool,
) -> None:
    """What is posed or searched is that of a camera file of this focal length, centred."""
    words = frames(tmp_path)
    centred = torch.tensor([[500.0, 0, 159.5], [0, 500, 119.5], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(width=320, height=240, K=centred, depth_unit_m=0.001)
    write_camera(tmp_path / "camera.json", camera)
    searched: list[ViewInput] = []
    if not with_mask:
        words = [words[0], f"{words[1]}/seen.png", *words[4:]]
        # A search takes seconds: what it is given is looked at.
        monkeypatch.setattr(Oracle, "find", lambda _, view, **__: searched.append(view) or [])
    at = words.index("--camera")
    bare = [*words[:at], "--focal-px", "500", "--unit", "mm", *words[at + 2 :]]
    given = ["pose", "predict", "--weights", str(weights), "--out"]
    assert main([*given, str(tmp_path / "file"), *words]) == 0
    assert main([*given, str(tmp_path / "bare"), *bare]) == 0
    expected, found = poses_of(tmp_path / "file"), poses_of(tmp_path / "bare")
    assert found.keys() == expected.keys()
    if with_mask:
        assert any(row["status"] == "ok" for row in found.values())
        for name, row in found.items():
            assert row["camera_from_model"] == expected[name]["camera_from_model"]
    else:
        of_file, of_bare = searched
        assert torch.equal(of_file.K, of_bare.K)
        assert torch.equal(of_file.depth_m.nan_to_num(), of_bare.depth_m.nan_to_num())
    without_unit = [word for word in bare if word not in ("--unit", "mm")]
    assert main([*given, str(tmp_path / "no unit"), *without_unit]) == 1
    assert "its depth is in whole numbers, and nothing says of what" in capsys.readouterr().err
    bare[bare.index("--focal-px") + 1] = "0"
    assert main([*given, str(tmp_path / "zero"), *bare]) != 0
    assert "focal_px is 0.0: not a focal length in pixels" in capsys.readouterr().err


def test_a_changed_mask_is_noticed(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["pose", "predict", *frames(tmp_path), "--weights", str(weights)]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    shutil.copy(tmp_path / "mask" / "seen.png", tmp_path / "mask" / "hidden.png")
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert "hidden.png: has changed since its result 'hidden'" in capsys.readouterr().err


def test_masks_of_a_data_set_are_refused_beside_a_depth_image(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["pose", "predict", *frames(tmp_path), "--weights", str(weights), "--masks", "m.png"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert "--masks: has no effect here; --bop names no dataset" in capsys.readouterr().err


def test_a_search_without_masks_registers_nothing(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    depth, _, *rest = frames(tmp_path)[1:]
    words = ["--depth", depth, *rest[1:], "--weights", str(weights), "--register-refused"]
    assert main(["pose", "predict", *words, "--out", str(tmp_path / "out")]) == 2
    assert "--register-refused: has no effect here; an image without --mask" in (
        capsys.readouterr().err
    )


def test_a_folder_of_depth_images_is_done_once(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = ["pose", "predict", *frames(tmp_path), "--weights", str(weights), "--out", str(out)]
    assert main(words) == 0
    assert "2 inputs: 1 ok, 1 too few points" in capsys.readouterr().out
    rows = poses_of(out)
    assert rows["hidden"]["reason"] == "the mask is empty: no pixel of it is the object"
    assert rows["hidden"]["camera_from_model"] is None
    assert (out / "seen.pose.ply").is_file()
    assert not (out / "hidden.pose.ply").exists()
    blue = read_image(out / "seen.pose.png")
    assert blue.shape == (3, 240, 320)
    assert int(((blue[2] > 0.9) & (blue[0] < 0.3)).sum()) > 100
    before = (out / "poses.json").read_text()
    assert main(words) == 0
    assert (out / "poses.json").read_text() == before
    assert main([*words, "--no-icp"]) == 2
    assert "holds results made with" in capsys.readouterr().err
    seen = tmp_path / "depth/seen.png"
    whole = seen.read_bytes()
    facts = seen.stat()
    shutil.copy(tmp_path / "mask/hidden.png", seen)
    assert main(words) == 2, "another image of that name"
    assert "has changed since its result 'seen'" in capsys.readouterr().err
    seen.write_bytes(whole)
    os.utime(seen, ns=(facts.st_atime_ns, facts.st_mtime_ns))
    camera = tmp_path / "camera.json"
    camera.write_text(camera.read_text().replace("0.001", "0.0010001"))
    assert main(words) == 2, "the same file with another content"
    assert "camera_sha256" in capsys.readouterr().err


def test_the_page_says_each_refusal_and_shows_few_of_many(weights: Path, tmp_path: Path) -> None:
    words = frames(tmp_path)
    for k in range(8):
        for folder, name in (("depth", "seen"), ("mask", "seen")):
            shutil.copy(tmp_path / folder / f"{name}.png", tmp_path / folder / f"<b>{k}.png")
    (tmp_path / "depth" / "torn.png").write_bytes(b"no picture")
    shutil.copy(tmp_path / "mask" / "seen.png", tmp_path / "mask" / "torn.png")
    out = tmp_path / "out"
    given = ["pose", "predict", *words, "--weights", str(weights), "--out", str(out)]
    assert main(given) == 1
    page = read_page(out / "report.html")
    assert page.texts["h1"] == ["Poses of 11 inputs"]
    (said,) = [text for text in page.texts["p"] if text.startswith("11 inputs")]
    assert said == (
        "11 inputs: 9 ok, 1 too few points, 1 unreadable. Shown below: 6, answers and refusals "
        "spread evenly."
    )
    rows = poses_of(out)
    for row in rows.values():
        assert row["name"] in page.texts["td"]
        assert row["reason"] in page.texts["td"], "each refusal in words"
    assert "b" not in page.tags, "a name is no markup"
    shown = page.texts["h2"][1:]
    assert len(shown) == 6
    assert "hidden" in shown
    assert "torn" not in shown
    for name, scene in zip(shown, page.scenes, strict=True):
        layers = [layer["name"] for layer in scene["layers"]]
        assert ("posed model" in layers) == (rows[name]["status"] == "ok")
        x, y, z = (line[3] for line in (rows[name]["camera_from_model"] or [[0] * 4] * 3)[:3])
        place = f"The bracket is at x {x:.4f}, y {y:.4f}, z {z:.4f} m in the camera's frame."
        refusal = f"Refused (too few points): {rows[name]['reason']}."
        assert (refusal if name == "hidden" else place) in page.texts["p"]


def test_an_unreadable_image_stops_no_other_and_is_read_when_mended(
    weights: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = frames(tmp_path)
    (tmp_path / "depth" / "hidden.png").write_bytes(b"no picture")
    out = tmp_path / "out"
    assert main(["pose", "predict", *words, "--weights", str(weights), "--out", str(out)]) == 1
    said = capsys.readouterr()
    assert "failed: hidden: cannot be read: " in said.err
    assert "2 inputs: 1 ok" in said.out
    assert poses_of(out)["hidden"]["status"] == "unreadable"
    depth_m, _ = view_of(bracket(), TRUTH)
    write_depth_png(tmp_path / "depth" / "hidden.png", depth_m, 0.001)
    given = ["pose", "predict", *words, "--weights", str(weights), "--out", str(out)]
    monkeypatch.setenv("WORLD_SIZE", "2")
    for rank in ("1", "0"):
        monkeypatch.setenv("RANK", rank)
        assert main(given) == 0
    assert poses_of(out)["hidden"]["reason"] == "the mask is empty: no pixel of it is the object"


def test_the_first_process_takes_no_failure_of_an_earlier_run(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["pose", "predict", *frames(tmp_path), "--weights", str(weights)]
    words += ["--out", str(tmp_path / "out")]
    names = sorted(path.stem for path in (tmp_path / "depth").glob("*.png"))
    content = {name: (tmp_path / "depth" / f"{name}.png").read_bytes() for name in names}
    for name in names:
        (tmp_path / "depth" / f"{name}.png").write_bytes(b"no picture")
    monkeypatch.setenv("WORLD_SIZE", "2")
    for rank in "10":
        monkeypatch.setenv("RANK", rank)
        main(words)
    for name in names:
        (tmp_path / "depth" / f"{name}.png").write_bytes(content[name])
    assert main(words) == 0, "the other process has not tried again yet"
    assert "unreadable" not in {row["status"] for row in poses_of(tmp_path / "out").values()}


def test_a_data_set_gives_the_csv_and_pictures(
    synthetic: BopDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truths = [instance.camera_from_model for instance in synthetic.instances]
    models = [synthetic.objects[number] for number in sorted(synthetic.objects)]
    path = oracle_weights(tmp_path, monkeypatch, Oracle(tiny_weights(*models), truths))
    out = tmp_path / "out"
    words = ["--bop", str(synthetic.folder), "--weights", str(path), "--out", str(out)]
    assert main(["pose", "predict", *words]) == 0
    answered = [p for p in read_predictions(out) if p.estimate.is_posed]
    assert len(read_predictions(out)) == len(synthetic.instances)
    results = read_bop_results(out / f"depthpose_{synthetic.folder.name}-test.csv")
    assert len(results) == len(answered) > 0
    images = {(p.place.scene_id, p.place.image_id) for p in answered if p.place is not None}
    assert {f"{s:06d}_{i:06d}.pose.png" for s, i in images} == {p.name for p in out.glob("*.png")}
    page = read_page(out / "report.html")
    assert page.texts["h2"][1:] == [instance.name for instance in synthetic.instances]
    assert any(picture["alt"].startswith("picture; ") for picture in page.pictures)


def test_of_a_data_set_one_object_is_posed_by_name_or_number(
    synthetic: BopDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    truths = [instance.camera_from_model for instance in synthetic.instances]
    models = [synthetic.objects[number] for number in sorted(synthetic.objects)]
    path = oracle_weights(tmp_path, monkeypatch, Oracle(tiny_weights(*models), truths))
    words = ["--bop", str(synthetic.folder), "--weights", str(path)]
    words = ["pose", "predict", *words, "--out", str(tmp_path / "out")]
    assert main([*words, "--object", "7"]) == 0
    assert {p.place and p.place.object_id for p in read_predictions(tmp_path / "out")} == {7}
    assert main(words) == 2, "all objects are another run"
    assert main([*words, "--object", "cup"]) == 2
    assert "no instance of 'cup'; objects here: 7 (bracket), 10 (bottle)" in capsys.readouterr().err
    by_name = choose_objects(synthetic, make_method(models), "bracket")
    assert {instance.object_id for instance in by_name.instances} == {7}


def test_the_name_of_the_weights_serves_where_the_data_set_has_none(synthetic: BopDataset) -> None:
    method = make_method([replace(bracket("part"), number=7)])
    chosen = choose_objects(synthetic, method, "part")
    assert {instance.object_id for instance in chosen.instances} == {7}


def test_a_model_of_another_name_in_the_data_set_is_not_matched_by_its_number(
    synthetic: BopDataset, capsys: pytest.CaptureFixture[str]
) -> None:
    # The dataset calls its object 7 bracket and its object 10 bottle.
    models = [replace(bottle(), number=7)]
    chosen = choose_objects(synthetic, make_method(models), None)
    assert {instance.object_id for instance in chosen.instances} == {10}
    assert "do not know them: objects [7]" in capsys.readouterr().err
    assert match_names(chosen, models) == {10: "bottle"}
    with pytest.raises(InputError, match=r"object 7 \(bracket\) is none of those"):
        match_names(synthetic, models)


def test_two_processes_share_the_work(
    synthetic: BopDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    models = [synthetic.objects[number] for number in sorted(synthetic.objects)]
    truths = [instance.camera_from_model for instance in synthetic.instances]
    path = oracle_weights(tmp_path, monkeypatch, Oracle(tiny_weights(*models), truths))
    words = ["pose", "predict", "--bop", str(synthetic.folder), "--weights", str(path), "--out"]
    monkeypatch.setenv("WORLD_SIZE", "2")
    for rank in ("1", "0"):
        monkeypatch.setenv("RANK", rank)
        assert main([*words, str(tmp_path / "two")]) == 0
    monkeypatch.setenv("WORLD_SIZE", "1")
    assert main([*words, str(tmp_path / "one")]) == 0
    one, two = (poses_of(tmp_path / name) for name in ("one", "two"))
    assert list(one) == list(two)
    for name, row in one.items():
        assert row["camera_from_model"] == two[name]["camera_from_model"]
    parts = [len(read_predictions(tmp_path / "two" / f"part-{k}")) for k in (0, 1)]
    assert sum(parts) == len(synthetic.instances)
    assert min(parts) >= 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "give one of --cloud, --depth, --left and --bop"),
        (["--cloud", ".", "--bop", "."], "give one of --cloud, --depth, --left and --bop"),
        (["--cloud", "."], "the weights know bracket, bottle; say which by --object"),
        (["--cloud", ".", "--object", "bracke"], "did you mean 'bracket'?"),
        (["--depth", ".", "--object", "bottle"], "--depth needs --camera or --focal-px beside it"),
        (
            ["--depth", ".", "--camera", ".", "--focal-px", "9"],
            "--focal-px: has no effect here; --camera has the focal length",
        ),
        (["--cloud", ".", "--focal-px", "9"], "Leave --focal-px out"),
        (
            ["--bop", ".", "--focal-px", "9"],
            "--focal-px: has no effect here; a dataset says its cameras",
        ),
        (["--cloud", ".", "--object", "bottle"], "no .ply, .pcd, .npy, .xyz, .txt file there"),
        (["--cloud", ".", "--object", "bottle", "--batch", "0"], "--batch 0: give 1 or more"),
        (["--cloud", ".", "--mask", ".", "--camera", "."], "Leave --mask and --camera out"),
        (
            ["--bop", ".", "--mask", ".", "--unit", "m"],
            "--mask and --unit: has no effect here; a data",
        ),
    ],
)
def test_what_cannot_be_predicted_is_refused(
    weights: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    said: str,
) -> None:
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    given = [*words, "--weights", str(weights), "--out", str(tmp_path / "out")]
    assert main(["pose", "predict", *given]) == 2
    assert said in capsys.readouterr().err


def test_a_mask_of_another_name_is_refused(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = frames(tmp_path)
    (tmp_path / "mask" / "seen.png").rename(tmp_path / "mask" / "scene.png")
    out = str(tmp_path / "out")
    assert main(["pose", "predict", *words, "--weights", str(weights), "--out", out]) == 2
    assert "no mask called 'seen'" in capsys.readouterr().err


def test_weights_of_other_objects_are_refused(
    synthetic: BopDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    unknown = bracket("stranger")
    unknown = type(unknown)(**{**vars(unknown), "number": 99})
    path = oracle_weights(tmp_path, monkeypatch, Oracle(tiny_weights(unknown), [TRUTH]))
    words = ["--bop", str(synthetic.folder), "--weights", str(path), "--out", str(tmp_path / "out")]
    assert main(["pose", "predict", *words]) == 2
    assert "but the weights know stranger; give weights of its objects" in capsys.readouterr().err


def test_inputs_of_an_earlier_run_stay_in_the_file(weights: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["pose", "predict", "--object", "bracket", "--weights", str(weights), "--out", str(out)]
    for name in ("a", "b"):
        write_cloud(tmp_path / f"{name}.ply", PointCloud(points=cloud_of(bracket(), TRUTH)))
        assert main([*words, "--cloud", str(tmp_path / f"{name}.ply")]) == 0
    assert list(poses_of(out)) == ["a", "b"]


def test_two_inputs_of_one_name_are_refused(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.ply", "a.pcd"):
        write_cloud(tmp_path / "clouds" / name, PointCloud(points=cloud_of(bracket(), TRUTH)))
    words = ["pose", "predict", "--weights", str(weights), "--out", str(tmp_path / "out")]
    cloud = ["--cloud", str(tmp_path / "clouds"), "--object", "bracket"]
    assert main([*words, *cloud]) == 2
    clouds = tmp_path / "clouds"
    message = f"{clouds / 'a.pcd'} and {clouds / 'a.ply'} would both be 'a' in the results; rename"
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    views = frames(tmp_path)
    mask = read_image(tmp_path / "mask" / "seen.png")
    write_image(tmp_path / "mask" / "seen.jpg", mask)
    assert main([*words, *views]) == 2
    assert "mask/seen.png would both be 'seen'" in capsys.readouterr().err


def test_a_cloud_for_weights_that_regress_a_depth_image_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = DepthImageNet(DepthImageConfig(crop_px=32, widths=(4, 4, 8, 8))).eval()
    path = tmp_path / "depth-image.safetensors"
    write_pose_weights(path, replace(tiny_weights(bracket()), network=network))
    write_cloud(tmp_path / "a.ply", PointCloud(points=cloud_of(bracket(), TRUTH)))
    words = ["pose", "predict", "--weights", str(path), "--out", str(tmp_path / "out")]
    assert main([*words, "--cloud", str(tmp_path / "a.ply")]) == 2
    said = capsys.readouterr().err
    assert "need depth images; give --depth, --mask and --camera, or weights that vote" in said
    assert main([*words, *frames(tmp_path)]) == 0
    assert poses_of(tmp_path / "out")["seen"]["status"] == "ok"
