"""From data on disk to every table by one command, with tiny networks."""

import json
import os
from pathlib import Path

import pytest
import yaml
from tests.pose.synthetic_linemod import make_linemod

from depthpose.cli import main, thesis

ADAM = {"learning_rate": 1e-3}
LOOP = {"steps": 1, "batch_size": 2}
PAIRS = {"truth": "scan", "augment": {"crop_px": [64, 128]}}
GENERATOR = {"width": 4, "levels": 4, "virtual_focal_px": 180.0}
MATCHER = {"width": 4, "max_disparity_px": 48, "blocks": [1, 1, 1, 1], "pools": [8, 4],
           "align_corners": False}  # fmt: skip
FRAMES = {"folder": "there", "with_roll": False}
POSE = {
    "models": {"bop": "there"},
    "frames": FRAMES,
    "held_out": {"number": 1, "occlusions": [0.0]},
    "loop": LOOP,
}
NETWORK = {"norm": "none", "first_kernel": 3, "encoder": [4, 4, 8, 8], "decoder": [4, 4, 4, 8]}
CONFIGS = {
    "depth/view": {"generator": GENERATOR, "discriminator_width": 4, "pairs": PAIRS, "loop": LOOP},
    "depth/stereo": {"matcher": MATCHER, "pairs": PAIRS, "loop": LOOP},
    "depth/finetune": {"pairs": PAIRS, "loop": LOOP},
    "pose/thesis": POSE | {"network": NETWORK},
    "pose/thesis-pointnet": POSE
    | {"network": {"local": [4, 4], "pooled": [4, 8, 8], "head": [8, 8, 8]}},
    "pose/thesis-depth-image": POSE | {"network": {"crop_px": 32, "widths": [4, 4, 8, 8]}},
    "pose/thesis-masks": {
        "images": {"folder": "there"},
        "network": {"widths": [4, 4, 8, 8], "long_side_px": 64},
        "augment": {"crop_px": [32, 64]},
        "loop": LOOP,
    },
}  # fmt: skip


def write_configs(folder: Path) -> Path:
    for name, content in CONFIGS.items():
        path = folder / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(content))
    return folder


@pytest.fixture
def configs(tmp_path: Path) -> Path:
    return write_configs(tmp_path / "configs")


def heads(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What was done, and what was not."""
    printed = capsys.readouterr()
    assert "error" not in printed.err
    lines = [line for line in printed.out.splitlines() if line.startswith("[")]
    return ["skipped" if ": done, " in line else line.split(":")[0] for line in lines]


def rows_of(table: Path) -> list[dict[str, str]]:
    return json.loads((table / "rows.json").read_text())


def methods(table: Path) -> list[str]:
    return [row["method"] for row in rows_of(table) if row.get("source", "ours") == "ours"]


@pytest.mark.slow
def test_kitti_to_tables_of_chapter_2(
    configs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kitti, home = tmp_path / "kitti", tmp_path / "out/depth"
    made = ["data", "make", "streets", "--out", str(kitti), "--number", "2", "--scale", "0.25"]
    assert main(made) == 0
    capsys.readouterr()
    words = ["reproduce", "all", "--kitti", str(kitti), "--configs", str(configs), "--out",
             str(tmp_path / "out"), "--split", "all", "--device", "cpu"]  # fmt: skip
    assert main(words) == 0
    assert heads(capsys) == [
        "[1/7] training by depth/view.yaml",
        "[2/7] training by depth/stereo.yaml",
        "[3/7] both in one file",
        "[4/7] table 2.1",
        "[5/7] table 2.2",
        "[6/7] training by depth/finetune.yaml",
        "[7/7] table 2.3",
    ]
    assert methods(home / "table-2.1") == ["fakestereo"] * 4, "caps of 80 and 50 m, ours beside"
    named = [row.get("weights") for row in rows_of(home / "table-2.1")]
    assert named.count("default") == 2, "the generator that selects stands beside the thesis's"
    assert methods(home / "table-2.2") == ["psmnet"] * 2
    weights = [row.get("weights") for row in rows_of(home / "table-2.3")]
    assert weights.count("apart") == weights.count("fakestereo") > 0
    assert main(words) == 0
    assert heads(capsys) == ["skipped"] * 7
    (home / "table-2.2/report.html").unlink()
    os.utime(home / "view/generator.safetensors")
    assert main(words) == 0
    assert heads(capsys)[:3] == ["skipped", "skipped", "[3/7] both in one file"]
    os.utime(home / "finetune/fakestereo.safetensors")
    assert main(words) == 0
    assert heads(capsys) == ["skipped"] * 6 + ["[7/7] table 2.3"]
    (configs / "depth/view.yaml").write_text(yaml.safe_dump({"loop": {"steps": 2}}))
    assert main(words) == 2
    assert "Two settings never share a folder" in capsys.readouterr().err


def test_linemod_to_tables_of_chapter_3(
    configs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    linemod, home = tmp_path / "Linemod_preprocessed", tmp_path / "out/pose"
    make_linemod(linemod)
    words = ["reproduce", "all", "--linemod", str(linemod), "--configs", str(configs), "--out",
             str(tmp_path / "out"), "--device", "cpu"]  # fmt: skip
    assert main(words) == 0
    assert heads(capsys) == [
        "[1/7] training by pose/thesis.yaml",
        "[2/7] training by pose/thesis-pointnet.yaml",
        "[3/7] training by pose/thesis-depth-image.yaml",
        "[4/7] training by pose/thesis-masks.yaml",
        "[5/7] table 3.1",
        "[6/7] table 3.2",
        "[7/7] table 3.3",
    ]
    shown = {(row["method"], row["masks"]) for row in rows_of(home / "table-3.1")
             if row["source"] == "ours"}  # fmt: skip
    names = ("pose", "pointnet", "depth-image")
    without_icp = {f"{name}-without-icp" for name in names}
    assert {method for method, _ in shown} == without_icp
    assert {masks for _, masks in shown} == {"truth", "segmentation"}
    assert methods(home / "table-3.2") == ["pose-without-icp"] * 2
    assert len(rows_of(home / "table-3.3")) > 0
    assert main(words) == 0
    assert heads(capsys) == ["skipped"] * 7


def test_a_step_that_fails_ends_it_and_says_its_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    steps = [
        thesis.Step("first", ("weights", "show", str(tmp_path / "no")), tmp_path / "a"),
        thesis.Step("second", ("weights", "list"), tmp_path / "b"),
    ]
    assert thesis.walk(steps) == 2
    assert "[2/2]" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "give --kitti or --linemod FOLDER"),
        (["--kitti", "KITTI", "--split", "all", "--configs", "no"], "there is no depth/view.yaml"),
        (["--kitti", "KITTI"], "697 of the 697 frames of eigen-test are missing"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_is(
    words: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from tests.depth.test_kitti_folders import make_raw

    monkeypatch.chdir(tmp_path)
    make_raw(tmp_path / "KITTI")
    assert main(["reproduce", "all", "--out", "out", *words]) == 2
    assert said in capsys.readouterr().err


def test_several_processes_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in {"RANK": "0", "WORLD_SIZE": "2"}.items():
        monkeypatch.setenv(name, value)
    assert main(["reproduce", "all", "--kitti", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "launch the trainings" in capsys.readouterr().err
