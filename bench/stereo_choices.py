"""Effect of each choice of the light matcher's recipe, at one number of steps.

    python bench/stereo_choices.py --encoder lite0.safetensors --streets streets \
        --clutter clutter --held-out FOLDER --evaluate PAIRS/kitti2015_eval_drives

The recipe is ``configs/depth/light-stereo.yaml``; each arm changes one thing of it. ``--held-out``
are pairs of training drives; ``--evaluate`` and Middlebury's Motorcycle (scikit-image's) are for
the table alone. Each arm is a separate process; finished ones in ``--out`` are reused, others
resumed.
"""

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from matchers import make_nets, measure, samples

from depthpose.core.config import config_to_dict, read_config
from depthpose.core.files import write_json
from depthpose.core.loop import Run
from depthpose.depth.config import AugmentConfig, PairsConfig
from depthpose.depth.train import STAGES
from depthpose.depth.train.config import StereoTraining
from depthpose.report.page import markdown_table, write_table

RECIPE = Path(__file__).parents[1] / "configs/depth/light-stereo.yaml"
FOCAL_PX = 558.0


@dataclass(frozen=True, kw_only=True)
class Arm:
    """One training of the light matcher.

    Attributes:
        name: in the table.
        augment: changes of the augmentation.
        light: changes of the network.
        change: changes of the rest of the config.
        data: which synthetic scenes.
        seed: of the training.
    """

    name: str
    augment: dict[str, Any] = field(default_factory=dict)
    light: dict[str, Any] = field(default_factory=dict)
    change: dict[str, Any] = field(default_factory=dict)
    data: tuple[str, ...] = ("streets", "clutter")
    seed: int = 0


NO_SKY = {"with_sky": False}
SCRATCH = {"encoder": None, "with_frozen_stem": False, "encoder_rate": 1.0}
ARMS = (
    Arm(name="the recipe"),
    Arm(name="both views degraded alike", augment={"per_view": None}),
    Arm(name="rows aligned", augment={"misaligned_px": 0.0}),
    Arm(name="no patch erased", augment={"erased_share": 0.0}),
    Arm(name="one focal length (558 px)", augment={"scale": (1.5, 1.5)}),
    Arm(name="no clutter", data=("streets",)),
    Arm(name="no streets", data=("clutter",)),
    Arm(name="the sky is a disparity of 0", light=NO_SKY, change={"sky_weight": 1.0}),
    Arm(name="the sky has no truth", light=NO_SKY, change={"sky_weight": 0.0}),
    Arm(name="the sky counts a tenth", light=NO_SKY, change={"sky_weight": 0.1}),
    Arm(name="encoder from scratch", change=SCRATCH),
    Arm(name="the recipe", seed=1),
)


def config_of(arm: Arm, options: argparse.Namespace) -> StereoTraining:
    """Change the recipe."""
    base = read_config(RECIPE, StereoTraining)
    folders = tuple(str(getattr(options, name)) for name in arm.data)
    augment: AugmentConfig = replace(base.pairs.augment, **arm.augment)
    loop = replace(
        base.loop, steps=options.steps, seed=arm.seed, save_every_steps=50,
        validate_every_steps=options.steps, ema_decay=0.99,
    )  # fmt: skip
    return replace(
        base,
        encoder=str(options.encoder),
        adam=replace(base.adam, warmup_steps=30),
        pairs=replace(base.pairs, folders=folders, augment=augment),
        held_out=PairsConfig(folders=(str(options.held_out),), limit=24, focal_px=FOCAL_PX),
        loop=loop,
    )


def run_arm(arm: Arm, options: argparse.Namespace) -> None:
    """Train once; a finished run is reused, another one resumed."""
    folder = options.out / f"{arm.name.replace(' ', '_')}-{arm.seed}"
    base = config_of(arm, options)
    assert base.light is not None
    config = replace(base, **{"light": replace(base.light, **arm.light)} | arm.change)
    weights = STAGES["stereo"][1](config, Run(folder=folder, resume=folder.exists()))
    row: dict[str, Any] = {"arm": arm.name, "seed": arm.seed} | held_out(folder)
    for name, data in (("eval", options.evaluate), ("Motorcycle", None)):
        net = make_nets([str(weights)])[f"{weights}, fine"]
        found = [measure(net, sample) for sample in samples(data, 25)]
        row |= {
            f"{name} {key}": sum(one[key] for one in found) / len(found) for key in ("EPE", "D1")
        }
    write_json(folder / "done.json", row | {"config": config_to_dict(config)})


def held_out(folder: Path) -> dict[str, float]:
    """Read the last validation of a run."""
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    rows = [row for line in lines if "held_out/d1" in (row := json.loads(line))]
    return {"held out EPE": rows[-1]["held_out/epe_px"], "held out D1": rows[-1]["held_out/d1"]}


def main() -> None:
    """Run every arm that is not finished, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    for name in ("encoder", "streets", "clutter", "held-out", "evaluate"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--out", type=Path, default=Path("out/stereo_choices"))
    parser.add_argument("--only", nargs="*", help="names of arms; none: all")
    parser.add_argument("--arm", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.arm is not None:
        run_arm(ARMS[options.arm], options)
        return
    rows = []
    for number, arm in enumerate(ARMS):
        if options.only and arm.name not in options.only:
            continue
        done = options.out / f"{arm.name.replace(' ', '_')}-{arm.seed}" / "done.json"
        if not done.exists():
            subprocess.run([sys.executable, *sys.argv, "--arm", str(number)], check=True)
        row = json.loads(done.read_text())
        rows.append({key: value for key, value in row.items() if key != "config"})
    write_table(options.out, rows, name="stereo_choices")
    print(markdown_table(rows))


if __name__ == "__main__":
    main()
