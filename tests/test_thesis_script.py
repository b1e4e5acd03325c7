"""From data on disk to every table by one script, with tiny networks."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from tests.pose.synthetic_linemod import make_linemod
from tests.written import ROOT

from depthpose.cli import main

SCRIPT = ROOT / "configs/thesis.sh"
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
    "depth/stereo": {"network": MATCHER, "pairs": PAIRS, "loop": LOOP},
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


@pytest.fixture
def configs(tmp_path: Path) -> Path:
    folder = tmp_path / "configs"
    for name, content in CONFIGS.items():
        path = folder / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(content))
    return folder


def run_script(chapter: str, data: Path, out: Path, configs: Path) -> list[str]:
    """Run the script with our own python; give the commands that it said."""
    own = out.parent / "bin" / "depthpose"
    own.parent.mkdir(exist_ok=True)
    own.write_text(f'#!/bin/sh\nexec {sys.executable} -m depthpose "$@"\n')
    own.chmod(0o755)
    path = f"{own.parent}:{os.environ['PATH']}"
    settings = {**os.environ, "PATH": path, "CONFIGS": str(configs), "SPLIT": "all"}
    command = ["bash", str(SCRIPT), chapter, str(data), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=settings)
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stderr.splitlines()]
    return [" ".join(words[1:4]) for words in lines if words[:1] == ["depthpose"]]


def rows_of(table: Path) -> list[dict[str, str]]:
    return json.loads((table / "rows.json").read_text())


def methods(table: Path) -> list[str]:
    return [row["method"] for row in rows_of(table) if row.get("source", "ours") == "ours"]


@pytest.mark.slow
def test_kitti_to_tables_of_chapter_2(configs: Path, tmp_path: Path) -> None:
    kitti, out = tmp_path / "kitti", tmp_path / "out"
    made = ["data", "make", "streets", "--out", str(kitti), "--number", "2", "--scale", "0.25"]
    assert main(made) == 0
    said = run_script("kitti", kitti, out, configs)
    tables = [f"reproduce 2.{k} --kitti" for k in (1, 2, 3)]
    assert said[2].startswith("weights pack")
    assert [*said[:2], *said[3:]] == [
        f"depth train {s}" for s in ("view", "stereo", "finetune")
    ] + tables
    home = out / "depth"
    assert methods(home / "table-2.1") == ["fakestereo"] * 4, "caps of 80 and 50 m, ours beside"
    named = [row.get("weights") for row in rows_of(home / "table-2.1")]
    assert named.count("default") == 2, "the generator that selects stands beside the thesis's"
    assert methods(home / "table-2.2") == ["psmnet"] * 2
    weights = [row.get("weights") for row in rows_of(home / "table-2.3")]
    assert weights.count("apart") == weights.count("fakestereo") > 0
    assert run_script("kitti", kitti, out, configs) == tables, "trainings are not repeated"


@pytest.mark.slow
def test_linemod_to_tables_of_chapter_3(configs: Path, tmp_path: Path) -> None:
    linemod, out = tmp_path / "Linemod_preprocessed", tmp_path / "out"
    make_linemod(linemod)
    said = run_script("linemod", linemod, out, configs)
    tables = ["reproduce 3.1 --linemod", "reproduce 3.2 --linemod", "reproduce 3.3 --linemod"]
    assert said == ["pose train --what"] * 4 + tables
    shown = {(row["method"], row["masks"]) for row in rows_of(out / "pose/table-3.1")
             if row["source"] == "ours"}  # fmt: skip
    names = ("pose", "pointnet", "depth-image")
    without_icp = {f"{name}-without-icp" for name in names}
    assert {method for method, _ in shown} == without_icp
    assert {masks for _, masks in shown} == {"truth", "segmentation"}
    assert methods(out / "pose/table-3.2") == ["pose-without-icp"] * 2
    assert len(rows_of(out / "pose/table-3.3")) > 0
    assert run_script("linemod", linemod, out, configs) == tables, "trainings are not repeated"


@pytest.mark.parametrize(
    ("words", "said"), [([], "bash configs/thesis.sh kitti KITTI OUT"), (["a", "b", "c"], "not a")]
)
def test_what_the_script_is_not_told_it_says(words: list[str], said: str) -> None:
    command = ["bash", str(SCRIPT), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert said in done.stderr
