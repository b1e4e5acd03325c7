"""``depthpose pose train`` and ``depthpose data make objects``."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
from tests.pose.synthetic_objects import write_part

from depthpose.cli import main
from depthpose.core.config import read_config
from depthpose.core.loop import TrainingRun
from depthpose.pose.train import STAGES, PoseTraining
from depthpose.pose.weights import read_pose_weights

_TINY = """
network: {first_kernel: 3, encoder: [4, 4, 8, 8], decoder: [4, 4, 4, 8]}
cloud: {max_points: 200}
objects: {views: 2}
held_out: {number: 2, occlusions: [0.0]}
adam: {warmup_steps: 0}
loop: {steps: 2, batch_size: 2, device: cpu}
"""


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_part("bracket", tmp_path_factory.mktemp("cad"))


@pytest.mark.slow
def test_a_cad_file_becomes_weights_with_a_card(
    part: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, out = tmp_path / "tiny.yaml", tmp_path / "my_part"
    config.write_text(_TINY)
    words = ["pose", "train", "--config", str(config), "--out", str(out)]
    assert main([*words, "--cad", str(part), "--unit", "mm"]) == 0
    said = capsys.readouterr().out
    assert f"trained weights: {out / 'pose.safetensors'}" in said
    assert "| 0 | " in said
    assert "trained; now it is measured" in said
    card = (out / "pose.md").read_text()
    assert f"--cad {part} --unit mm --config config.yaml --out my_part`" in card
    (model,) = read_pose_weights(out / "pose.safetensors").models
    assert model.name == "bracket"
    assert model.diameter_m == pytest.approx(0.160, abs=0.001)
    # The folder is that of this config.
    again = [*words, "--cad", str(part), "--unit", "mm", "--seed", "5", "--resume"]
    assert main(again) == 2
    assert "seed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--cad", "."], "no unit is given, and such a file does not say its own; give --unit mm"),
        ([], "there is no object to learn; name its CAD file (--cad FILE --unit mm)"),
        (["--data", "."], "--data .: the config learns from no dataset"),
        (
            ["--what", "segmentation", "--cad", ".", "--unit", "mm"],
            "--cad and --unit: has no effect here; 'segmentation' learns from pictures",
        ),
        (["--what", "segmentation", "--unit", "mm"], "--unit: has no effect here; 'segmentation'"),
        (["--what", "segmentation", "--symmetries", "found"], "--symmetries: has no effect"),
        (["--cad", "nowhere.stl", "--unit", "mm"], "nowhere.stl"),
    ],
)
def test_words_that_do_not_go_together_are_refused(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["pose", "train", *words, "--out", str(tmp_path / "run")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_synthetic_frames_are_a_data_set_that_the_check_accepts(
    part: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "made"
    words = ["data", "make", "objects", "--cad", str(part), "--unit", "mm", "--out", str(out)]
    assert main([*words, "--number", "2"]) == 0
    assert main(["data", "check", str(out)]) == 0
    assert "2 images, 2 instances" in capsys.readouterr().out
    first = (out / "train" / "000000" / "rgb" / "000000.png").read_bytes()
    assert main([*words, "--number", "2"]) == 0
    assert "0 scenes made, 1 were there" in capsys.readouterr().out
    assert main([*words, "--number", "3"]) == 0
    assert (out / "train" / "000000" / "rgb" / "000000.png").read_bytes() == first
    cameras = json.loads((out / "train" / "000000" / "scene_camera.json").read_text())
    assert sorted(cameras) == ["0", "1", "2"]
    assert main([*words, "--number", "3", "--sensor", "laser"]) == 2
    assert "sensor.kinds = ['structured light'], but now it is" in capsys.readouterr().err
    assert main([*words, "--number", "0"]) == 2
    assert "--number 0: give 1 or more" in capsys.readouterr().err
    assert main([*words, "--number", "3", "--clutter", "8", "16"]) == 2
    assert "frame_clutter = [0, 4], but now it is [8, 16]" in capsys.readouterr().err
    words[-1] = str(tmp_path / "cluttered")
    assert main([*words, "--number", "1", "--clutter", "16", "8"]) == 2
    assert "16" in capsys.readouterr().err
    assert main([*words, "--number", "1", "--clutter", "12", "12"]) == 0
    assert (tmp_path / "cluttered/train/000000/rgb/000000.png").read_bytes() != first


def test_frames_are_not_made_of_two_objects_of_one_name(
    part: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other").mkdir()
    for other in (part, shutil.copy(part, tmp_path / "other")):
        words = ["data", "make", "objects", "--cad", str(part), str(other), "--out"]
        assert main([*words, str(tmp_path / "made")]) == 2
        assert "two models are called 'bracket' (numbers 1 and 2" in capsys.readouterr().err
    assert not (tmp_path / "made").exists()


def test_a_cad_file_begins_with_the_weights_that_ship(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[tuple[str | None, str]] = []
    configs: list[PoseTraining] = []

    def stand_in(config: PoseTraining, run: TrainingRun) -> Path:
        started.append((config.start, config.network.norm))
        configs.append(config)
        return run.folder / "pose.safetensors"

    monkeypatch.setitem(STAGES, "pose", (PoseTraining, stand_in))
    (tmp_path / "c.yaml").write_text("{}")
    words = ["pose", "train", "--cad", str(part), "--unit", "mm", "--out", str(tmp_path / "run")]
    more = [[], ["--start", "nothing"], ["--start", "default"]]
    for extra in [*more, ["--config", str(tmp_path / "c.yaml")]]:
        assert main([*words, *extra]) == 0
    assert started == [("parts", "none"), (None, "batch"), ("default", "none"), (None, "batch")]
    own = read_config(
        Path(__file__).parents[1] / "configs" / "pose" / "own-part.yaml", PoseTraining
    )
    assert dataclasses.replace(own, models=configs[0].models) == configs[0]


def test_a_config_may_hold_the_unit_of_a_cad_file(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    configs: list[PoseTraining] = []

    def stand_in(config: PoseTraining, run: TrainingRun) -> Path:
        configs.append(config)
        return run.folder / "pose.safetensors"

    monkeypatch.setitem(STAGES, "pose", (PoseTraining, stand_in))
    config = tmp_path / "c.yaml"
    config.write_text("models: {unit: mm}")
    words = ["pose", "train", "--cad", str(part), "--config", str(config)]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    assert (configs[0].models.cad, configs[0].models.unit) == ((str(part),), "mm")


@pytest.mark.parametrize("words", [["--seed", "99999999999999999999"], ["--number", "50001"]])
def test_scenes_that_no_reader_could_number_are_not_written(
    part: Path, tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    made = ["data", "make", "objects", "--cad", str(part), "--out", str(tmp_path / "out"), *words]
    assert main(made) == 2
    assert "take a seed of 0 to 999999, and at most 50000 frames" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_data_set_takes_the_place_of_every_folder_of_a_config(part: Path, tmp_path: Path) -> None:
    made, config, run = tmp_path / "made", tmp_path / "masks.yaml", tmp_path / "run"
    words = ["data", "make", "objects", "--cad", str(part), "--unit", "mm", "--number", "1"]
    assert main([*words, "--out", str(made)]) == 0
    config.write_text(
        "images: {folder: nowhere}\nheld_out: {folder: nowhere}\n"
        "network: {widths: [8, 8, 8, 8], long_side_px: 160}\naugment: {crop_px: [96, 128]}\n"
        "adam: {warmup_steps: 0}\nloop: {steps: 1, batch_size: 1, validate_every_steps: 1}\n"
    )
    words = ["pose", "train", "--what", "segmentation", "--config", str(config), "--device", "cpu"]
    assert main([*words, "--data", str(made), "--out", str(run)]) == 0
    assert "held_out/iou_objects" in (run / "metrics.jsonl").read_text()


def test_symmetries_of_a_cad_file_are_printed_and_declared_if_wanted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_part("flange", tmp_path)
    words = ["data", "make", "objects", "--cad", str(file), "--unit", "mm", "--number", "1"]
    assert main([*words, "--out", str(tmp_path / "plain")]) == 0
    assert "if that is so, say --symmetries found" in capsys.readouterr().out
    assert main([*words, "--symmetries", "found", "--out", str(tmp_path / "found")]) == 0
    assert "each copy counts as right" in capsys.readouterr().out
    plain, found = (
        json.loads((tmp_path / name / "models" / "models_info.json").read_text())["1"]
        for name in ("plain", "found")
    )
    assert "symmetries_discrete" not in plain
    assert len(found["symmetries_discrete"]) == 5


def test_frames_of_an_edited_cad_file_go_to_another_folder(
    part: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / part.name, tmp_path / "made"
    file.write_bytes(part.read_bytes())
    words = ["data", "make", "objects", "--cad", str(file), "--unit", "mm", "--out", str(out)]
    assert main([*words, "--number", "1"]) == 0
    models = sorted((path.name, path.read_bytes()) for path in (out / "models").iterdir())
    write_part("flange", tmp_path / "other").replace(file)
    assert main([*words, "--number", "2"]) == 2
    assert "holds results made with cad.object 1.sha256 = " in capsys.readouterr().err
    assert models == sorted((path.name, path.read_bytes()) for path in (out / "models").iterdir())
