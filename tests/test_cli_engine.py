"""``--engine ray`` from the words to the shards; a double in this process stands for the cluster.

What a real cluster does is in ``test_ray.py``.
"""

import json
import shutil
import tarfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tests.core.engine.doubles import InProcessEngine, unpacked
from tests.depth.small_training import write_tiny_weights
from tests.pose.synthetic_objects import (
    CAMERA,
    bottle,
    bracket,
    cloud_of,
    pose_at,
    tiny_weights,
    view_of,
    write_part,
    write_stl,
)
from tests.test_cli_depth import write_doubtful_pairs

from depthpose.cli import engine, main
from depthpose.cli.depth import methods
from depthpose.cli.depth.inputs import PAIRS
from depthpose.cli.depth.methods import make_pair_spec, settings_on_workers
from depthpose.core.camera import write_camera
from depthpose.core.engine import list_inputs
from depthpose.core.errors import InputError
from depthpose.core.files import (
    PointCloud,
    write_cloud,
    write_depth_png,
    write_image,
)
from depthpose.depth.config import MatcherConfig
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.synthetic import SyntheticViews, make_part
from depthpose.pose.weights import write_pose_weights

RIG = {"width": 64, "height": 48, "K": [[70, 0, 31.5], [0, 70, 23.5], [0, 0, 1]], "baseline_m": 0.5}
RAY = ["--engine", "ray"]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small weights of both networks, five pairs and a rig."""
    return make_home(tmp_path_factory.mktemp("engine"))


def make_home(folder: Path) -> Path:
    write_tiny_weights(folder)
    for number in range(5):
        image = torch.rand(3, 48, 70, generator=torch.Generator().manual_seed(number))
        write_image(folder / "left" / f"{number}.png", image[:, :, 4:68])
        write_image(folder / "right" / f"{number}.png", image[:, :, 6:])
    (folder / "rig.json").write_text(json.dumps(RIG))
    return folder


@pytest.fixture
def double(monkeypatch: pytest.MonkeyPatch) -> InProcessEngine:
    """A test double of the cluster."""
    double = InProcessEngine()
    monkeypatch.setattr(engine.EngineOptions, "build", lambda _: double)
    return double


def files_of(out: Path) -> dict[str, dict[str, bytes]]:
    """The files of a plain run, by input and ending."""
    found: dict[str, dict[str, bytes]] = {}
    for path in sorted(out.glob("*.*.*")) + sorted(out.glob("*.ply")):
        name, _, ending = path.name.partition(".")
        found.setdefault(name, {})[ending] = path.read_bytes()
    return found


def predict(home: Path, out: Path, *words: str) -> int:
    fixed = ["--camera", str(home / "rig.json"), "--weights", str(home / "w.safetensors")]
    return main(["depth", "predict", *words, *fixed, "--out", str(out), "--cloud"])


def match(home: Path, out: Path, *words: str) -> int:
    fixed = ["--camera", str(home / "rig.json"), "--weights", str(home / "m.safetensors")]
    return main(["depth", "match", *words, *fixed, "--out", str(out), "--no-check"])


def test_shards_hold_the_files_of_the_plain_command(
    home: Path, tmp_path: Path, double: InProcessEngine
) -> None:
    assert predict(home, tmp_path / "plain", str(home / "left")) == 0
    words = [str(home / "left"), *RAY, "--block", "2"]
    assert predict(home, tmp_path / "big", *words) == 0
    assert len(list((tmp_path / "big" / "shards").glob("*.tar"))) == 3
    wanted = files_of(tmp_path / "plain")
    assert len(wanted) == 5
    assert len(wanted["0"]) == 7
    assert unpacked(tmp_path / "big") == wanted


def test_pairs_come_from_folders_a_manifest_or_tar_shards(
    home: Path, tmp_path: Path, double: InProcessEngine
) -> None:
    sides = [str(home / "left"), str(home / "right")]
    assert match(home, tmp_path / "plain", *sides) == 0
    wanted = files_of(tmp_path / "plain")
    assert len(wanted) == 5
    assert match(home, tmp_path / "folders", *sides, *RAY) == 0
    rows = [f"left/{k}.png,right/{k}.png" for k in range(5)]
    (home / "list.csv").write_text("\n".join(["left,right", *rows]))
    assert match(home, tmp_path / "manifest", str(home / "list.csv"), *RAY) == 0
    with tarfile.open(tmp_path / "in.tar", "w") as tar:
        for k in range(5):
            for side in ("left", "right"):
                tar.add(home / side / f"{k}.png", f"{k}.{side}.png")
    assert match(home, tmp_path / "tar", str(tmp_path / "in.tar"), *RAY) == 0
    for out in ("folders", "manifest", "tar"):
        assert unpacked(tmp_path / out) == wanted, out


def test_what_fails_is_named_and_stops_no_other(
    home: Path, tmp_path: Path, double: InProcessEngine, capsys: pytest.CaptureFixture[str]
) -> None:
    images = shutil.copytree(home / "left", tmp_path / "in")
    (images / "3.png").write_bytes(b"no picture")
    assert predict(home, tmp_path / "out", str(images), *RAY) == 1
    said = capsys.readouterr()
    assert "4 of 5 depth maps are in 1 shards" in said.out
    assert f"failed: 3: {images / '3.png'}: not a readable picture" in said.err
    assert set(unpacked(tmp_path / "out")) == set("0124")
    assert "3,000000.tar," in (tmp_path / "out" / "manifest.csv").read_text()


def test_workers_check_every_pair(
    tmp_path: Path, double: InProcessEngine, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["depth", "match", *write_doubtful_pairs(tmp_path), "--matcher", "sgbm", *RAY]
    assert main([*words, "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr()
    assert "2 of 5 pairs are in 1 shards" in said.out
    assert "failed: b: b: left and right look swapped" in said.err
    assert "failed: d: d: the images do not belong together" in said.err
    assert "warning: e: only 0 of the 25 matches needed: cannot tell" in said.err
    found = unpacked(tmp_path / "out")
    assert set(found) == {"a", "e"}
    assert b"cannot tell whether the pair is rectified" in found["e"]["warning.txt"]


def test_files_of_two_sides_are_paired_by_number(tmp_path: Path) -> None:
    for name in ("left/left_2", "left/left_10", "right/right_10", "right/right_2", "odd/right_3"):
        (tmp_path / f"{name}.png").parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.png").touch()
    sides = [str(tmp_path / "left"), str(tmp_path / "right")]
    found = [[Path(file).stem for file in item.files] for item in list_inputs(sides, PAIRS)]
    assert found == [["left_2", "right_2"], ["left_10", "right_10"]]
    (tmp_path / "odd/right_3.png").rename(tmp_path / "right/right_3.png")
    with pytest.raises(InputError, match=r"hold 2 and 3 files, and no partner .* 'right_3'"):
        list_inputs(sides, PAIRS)


def test_other_settings_need_another_folder(
    home: Path, tmp_path: Path, double: InProcessEngine, capsys: pytest.CaptureFixture[str]
) -> None:
    assert predict(home, tmp_path, str(home / "left"), *RAY) == 0
    assert predict(home, tmp_path, str(home / "left"), *RAY, "--color-range", "1", "9") == 2
    assert "color_range_m" in capsys.readouterr().err


def test_a_manifest_of_somebody_else_is_not_written_over(
    home: Path, tmp_path: Path, double: InProcessEngine, capsys: pytest.CaptureFixture[str]
) -> None:
    images = shutil.copytree(home / "left", tmp_path / "in")
    (images / "manifest.csv").write_text("image\n0.png\n")
    assert predict(home, images, str(images / "manifest.csv"), *RAY) == 2
    assert "manifest.csv: is there already, and no run" in capsys.readouterr().err
    assert (images / "manifest.csv").read_text() == "image\n0.png\n"


@pytest.fixture
def truth(home: Path, tmp_path: Path) -> Path:
    """The five pairs as a dataset with truth; the last one has none."""
    data = tmp_path / "data"
    for side in ("left", "right"):
        shutil.copytree(home / side, data / side)
    for number in range(4):
        made = torch.Generator().manual_seed(number)
        disparity_px = 1 + 14 * torch.rand(48, 64, generator=made)
        write_depth_png(data / "disp_occ" / f"{number}.png", disparity_px)
        write_depth_png(data / "lidar_depth" / f"{number}.png", 35 / disparity_px)
    shutil.copyfile(home / "rig.json", data / "camera.json")
    return data


@pytest.mark.parametrize("protocol", ["kitti-2015", "eigen-improved-garg"])
def test_shards_measure_exactly_as_files_do(
    home: Path, truth: Path, tmp_path: Path, double: InProcessEngine, protocol: str
) -> None:
    sides = [str(home / "left"), str(home / "right")]
    assert match(home, tmp_path / "files", *sides) == 0
    assert match(home, tmp_path / "shards", *sides, *RAY, "--block", "2") == 0
    rows: list[dict[str, Any]] = []
    for name in ("files", "shards"):
        out = tmp_path / f"measured-{len(rows)}"
        given = ["--predictions", str(tmp_path / name), "--protocol", protocol]
        assert main(["depth", "evaluate", "--data", str(truth), *given, "--out", str(out)]) == 0
        rows.append(
            {
                kind: json.loads((out / f"{kind}.json").read_text())
                for kind in ("rows", "frames", "confidence")
            }
        )
    assert rows[0] == rows[1]
    assert len(rows[0]["frames"]) % 4 == 0


def test_a_frame_that_no_shard_holds_is_missed(
    home: Path, truth: Path, tmp_path: Path, double: InProcessEngine,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    (home / "some.csv").write_text("left,right\nleft/0.png,right/0.png\nleft/4.png,right/4.png")
    assert match(home, tmp_path / "shards", str(home / "some.csv"), *RAY) == 0
    words = ["--predictions", str(tmp_path / "shards"), "--protocol", "kitti-2015"]
    out = ["--out", str(tmp_path / "out")]
    assert main(["depth", "evaluate", "--data", str(truth), *words, *out]) == 2
    assert "no prediction for frame '1'" in capsys.readouterr().err


def test_a_shard_made_anew_is_measured_anew(
    home: Path, truth: Path, tmp_path: Path, double: InProcessEngine
) -> None:
    images = tmp_path / "in"
    for side in ("left", "right"):
        shutil.copytree(home / side, images / side)
    whole = (images / "left" / "2.png").read_bytes()
    (images / "left" / "2.png").write_bytes(b"no picture")
    sides = [str(images / "left"), str(images / "right")]
    words = ["--predictions", str(tmp_path / "shards"), "--protocol", "kitti-2015"]
    measure = ["depth", "evaluate", "--data", str(truth), *words, "--out", str(tmp_path / "out")]
    assert match(home, tmp_path / "shards", *sides, *RAY) == 1
    assert main(measure) == 2, "frame 2 is missing"
    (images / "left" / "2.png").write_bytes(whole)
    assert match(home, tmp_path / "shards", *sides, *RAY) == 0
    assert main(measure) == 0


def test_clouds_have_the_poses_of_the_plain_command(
    tmp_path: Path, double: InProcessEngine
) -> None:
    write_pose_weights(tmp_path / "w.safetensors", tiny_weights(bracket(), bottle()))
    for seed in range(3):
        cloud = PointCloud(points=cloud_of(bracket(), pose_at(seed=seed)))
        write_cloud(tmp_path / "in" / f"{seed}.ply", cloud)
    (tmp_path / "in" / "9.ply").write_bytes(b"ply\nnothing")
    words = ["pose", "predict", "--cloud", str(tmp_path / "in"), "--object", "bracket",
             "--weights", str(tmp_path / "w.safetensors"), "--out"]  # fmt: skip
    assert main([*words, str(tmp_path / "plain")]) == 1
    assert main([*words, str(tmp_path / "big"), *RAY, "--block", "2"]) == 1
    wanted = {row["name"]: row for row in json.loads((tmp_path / "plain/poses.json").read_text())}
    found = {
        name: json.loads(files["pose.json"]) for name, files in unpacked(tmp_path / "big").items()
    }
    assert set(found) == set("012")
    for name, row in found.items():
        assert {**row, "seconds": 0} == {**wanted[name], "seconds": 0}


@pytest.mark.slow
def test_a_box_is_that_of_every_depth_image(tmp_path: Path, double: InProcessEngine) -> None:
    cad = write_stl(tmp_path / "bracket.stl", bracket())
    for seed in (1, 2):
        seen, mask = view_of(bracket(), pose_at(seed=seed))
        depth_m = torch.where(mask, seen.float(), 1.2)
        write_depth_png(tmp_path / "in" / f"{seed}.png", depth_m, 0.0001)
    write_camera(tmp_path / "c.json", replace(CAMERA, depth_unit_m=0.0001))
    words = ["pose", "predict", "--cad", str(cad), "--cad-unit", "mm", "--box", "90,50,230,190",
             "--depth", str(tmp_path / "in"), "--camera", str(tmp_path / "c.json")]  # fmt: skip
    assert main([*words, "--out", str(tmp_path / "plain")]) == 0
    assert main([*words, "--out", str(tmp_path / "big"), *RAY]) == 0
    wanted = {row["name"]: row for row in json.loads((tmp_path / "plain/poses.json").read_text())}
    found = unpacked(tmp_path / "big")
    assert set(found) == set(wanted) == {"1", "2"}
    for name, files in found.items():
        row = json.loads(files["pose.json"])
        assert row["camera_from_model"] is not None
        assert {**row, "seconds": 0} == {**wanted[name], "seconds": 0}


@pytest.mark.slow
def test_a_cad_file_alone_is_registered_by_workers_too(
    tmp_path: Path, double: InProcessEngine
) -> None:
    write_part("connector", tmp_path)
    views = SyntheticViews(
        [make_part("connector")], ObjectsConfig(views=None, occluded_share=0.0, seed=5)
    )
    write_cloud(tmp_path / "in" / "0.ply", PointCloud(points=1000 * views[0].input.points_m))
    words = ["pose", "predict", "--method", "register", "--cad", str(tmp_path / "connector.stl"),
             "--unit", "mm", "--cloud", str(tmp_path / "in"), "--out"]  # fmt: skip
    assert main([*words, str(tmp_path / "plain")]) == 0
    assert main([*words, str(tmp_path / "big"), *RAY]) == 0
    (wanted,) = json.loads((tmp_path / "plain" / "poses.json").read_text())
    found = json.loads(unpacked(tmp_path / "big")["0"]["pose.json"])
    assert wanted["status"] in ("ok", "ambiguous"), "it has a pose"
    assert {**found, "seconds": 0} == {**wanted, "seconds": 0}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--workers", "2"], "--engine ray takes it, and is not given"),
        ([*RAY, "--block", "0"], "--block 0"),
        ([*RAY, "--workers", "0"], "--workers 0"),
        ([*RAY, "--worker-cpus", "0"], "needs a core or a GPU"),
    ],
)
def test_options_that_mean_nothing_are_refused(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    assert predict(home, tmp_path, str(home / "left"), *words) == 2
    assert said in capsys.readouterr().err


def test_what_no_engine_takes_is_refused(
    home: Path, tmp_path: Path, double: InProcessEngine, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "drive.mp4").touch()
    assert predict(home, tmp_path, str(tmp_path / "drive.mp4"), *RAY) == 2
    assert "takes no videos" in capsys.readouterr().err
    assert match(home, tmp_path, str(home / "left")) == 2
    assert "there is no right image beside it" in capsys.readouterr().err


def test_without_ray_the_extra_is_named(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    monkeypatch.setitem(__import__("sys").modules, "ray.data", None)
    assert predict(home, tmp_path, str(home / "left"), *RAY) == 2
    assert "pip install -e '.[ray]'" in capsys.readouterr().err


def test_settings_on_workers_are_those_that_are_asked_of_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # This machine has neither the device nor the precision.
    monkeypatch.setattr(methods, "usable_precision", lambda *_: "fp32")
    config = MatcherConfig(device="cuda", precision="bf16")
    settings = settings_on_workers(make_pair_spec(None, "psmnet-compact", config))
    assert (settings["device"], settings["precision"]) == ("cuda", "bf16")
