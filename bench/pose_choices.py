"""Effect of voxels, points, features, width and network for one part, at equal steps.

    python bench/own_part.py valve.stl
    python bench/pose_choices.py valve.stl --out out/pose_choices

Each arm is a training of ``configs/pose/own-part.yaml`` from random weights, with one change, and
is evaluated on the same 200 held-out synthetic views at each occlusion: ADD below a tenth of the
diameter, by votes alone, nothing refused. Seconds are of the training on one thread, including the
rendering of views.
Results in ``--out`` are reused: a second call continues where the first was stopped.
"""

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from depthpose.core.config import read_config
from depthpose.core.files import write_json
from depthpose.core.loop import Run
from depthpose.pose.baselines import PointNetConfig
from depthpose.pose.train import STAGES, PoseTraining
from depthpose.pose.train.config import HeldOutConfig, ModelsConfig
from depthpose.report.page import markdown_table, write_table

CONFIG = Path(__file__).parents[1] / "configs" / "pose" / "own-part.yaml"
WIDE = {"encoder": (32, 64, 128, 256), "decoder": (64, 64, 64, 128)}
ARMS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "8 mm, 1,000 points": ("cloud", {}),
    "without shape": ("cloud", {"with_shape": False}),
    "5 mm": ("cloud", {"voxel_m": 0.005}),
    "12 mm": ("cloud", {"voxel_m": 0.012}),
    "300 points": ("cloud", {"max_points": 300}),
    "3,000 points": ("cloud", {"max_points": 3000}),
    "twice as wide": ("network", WIDE),
    "PointNet": ("network", PointNetConfig()),  # pyright: ignore[reportAssignmentType]
}
"""Changes of each arm: a part of the config, and its options (or a network)."""


def config_of(arm: str, cad: Path, steps: int, seed: int) -> tuple[str, PoseTraining]:
    """Give the stage and the config of an arm."""
    part, change = ARMS[arm]
    stage = "pointnet" if isinstance(change, PointNetConfig) else "pose"
    base = read_config(CONFIG, STAGES["pose"][0])
    settings = {name: getattr(base, name) for name in vars(base)}
    settings |= {
        "models": ModelsConfig(cad=(str(cad),), unit="mm"),
        "start": None,
        "held_out": HeldOutConfig(number=200),
        "loop": replace(base.loop, steps=steps, validate_every_steps=steps, seed=seed),
        part: change if stage == "pointnet" else replace(settings[part], **change),
    }
    return stage, STAGES[stage][0](**settings)


def run_arm(arm: str, cad: Path, steps: int, seed: int, out: Path) -> dict[str, Any]:
    """Train, or read the result of an earlier call."""
    home = out / f"{arm}, seed {seed}".replace(" ", "_").replace(",", "")
    if (home / "row.json").exists():
        return json.loads((home / "row.json").read_text())
    stage, config = config_of(arm, cad, steps, seed)
    began = time.perf_counter()
    STAGES[stage][1](config, Run(folder=home, resume=(home / "state.pt").exists()))
    spent_s = time.perf_counter() - began
    lines = map(json.loads, (home / "metrics.jsonl").read_text().splitlines())
    last = next(line for line in reversed(list(lines)) if any("held_out" in name for name in line))
    row = {"arm": arm, "seed": seed, "steps": steps, "seconds": round(spent_s)}
    for hidden in (0, 30):
        row[f"{hidden} % hidden"] = last[f"held_out/occluded_{hidden}/ransac_add_10"]
    write_json(home / "row.json", row)
    return row


def main() -> None:
    """Run every arm with every seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cad", type=Path, help="a part, in millimetres")
    parser.add_argument("--arms", nargs="*", choices=list(ARMS), default=list(ARMS))
    parser.add_argument("--steps", type=int, default=3400)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--out", type=Path, default=Path("out/pose_choices"))
    words = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for seed in words.seeds:
        for arm in words.arms:
            rows.append(run_arm(arm, words.cad.resolve(), words.steps, seed, words.out))
            write_table(words.out, rows)
            print(markdown_table(rows[-1:]), flush=True)


if __name__ == "__main__":
    main()
