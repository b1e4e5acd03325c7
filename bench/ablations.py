"""Effect of each choice of the training, by one small configuration and one number of steps.

    python bench/ablations.py --synthetic streets --real PAIRS/kitti2015_train_drives \
        --evaluate PAIRS/kitti2015_eval_drives --out out/ablations

L1 alone against cGAN + L1, patch against pixel discriminator; and how accuracy grows with the
number of synthetic and real pairs. Every arm is trained apart, measured, fine-tuned and measured
again: on real pairs, and on synthetic streets of a seed of their own.
Results in ``--out`` are reused: a second call continues where the first was stopped.
"""

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from curves import draw_curves
from view_quality import measure

from depthpose.cli import main as depthpose
from depthpose.core.checkpoint import bound_facts
from depthpose.core.files import write_json
from depthpose.core.loop import AdamConfig, LoopConfig, Run
from depthpose.depth.config import (
    AugmentConfig,
    GeneratorConfig,
    PairsConfig,
    PSMNetConfig,
    StreetsConfig,
)
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.synthetic import draw_street
from depthpose.depth.train import STAGES
from depthpose.depth.train.config import FinetuneTraining, StereoTraining, ViewTraining
from depthpose.depth.weights import read_generator, read_matcher, write_depth_weights
from depthpose.report.page import markdown_table, write_table

FOCAL_PX = 186.0
"""A quarter of KITTI's resolution: an arm takes minutes on one core."""

GENERATOR = GeneratorConfig(width=16, levels=5, virtual_focal_px=FOCAL_PX)
MATCHER = PSMNetConfig(
    width=16, max_disparity_px=48, blocks=(2, 4, 2, 2), pools=(16, 8, 4, 2),
    align_corners=False, work_focal_px=FOCAL_PX,
)  # fmt: skip
STEPS = {"stereo": 1200, "view": 1000, "view on real": 400, "finetune": 300}
HELD_OUT_STREETS = 20


@dataclass(frozen=True, kw_only=True)
class Arm:
    """One training.

    Attributes:
        synthetic: number of synthetic pairs of both stages, where ``real`` is None.
        real: number of real pairs of both stages, after training on the synthetic ones.
        discriminator: kind of discriminator of the generator; none: L1 alone.
        seed: of weights, order and augmentation.
    """

    synthetic: int = 1000
    real: int | None = None
    discriminator: Literal["patch", "pixel", "none"] = "patch"
    seed: int = 0

    @property
    def name(self) -> str:
        """Of its folder."""
        data = f"synthetic{self.synthetic}" if self.real is None else f"real{self.real}"
        return f"{data}-{self.discriminator}-{self.seed}"


def arms(real_pairs: tuple[int, ...], seeds: int) -> list[Arm]:
    """Every arm; those from which others start come first."""
    found: list[Arm] = []
    for seed in range(seeds):
        found += [Arm(seed=seed), Arm(seed=seed, discriminator="none")]
        found += [Arm(seed=seed, real=number) for number in real_pairs]
        found += [Arm(seed=seed, synthetic=number) for number in (30, 100, 300)]
        found += [Arm(seed=seed, discriminator="pixel")]
    return found


class Bench:
    """Folders of data and runs."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.out = options, options.out

    def pairs(self, arm: Arm) -> PairsConfig:
        """Give the training data of an arm."""
        folder = self.options.synthetic if arm.real is None else self.options.real
        return PairsConfig(
            folders=(str(folder),), limit=arm.synthetic if arm.real is None else arm.real,
            focal_px=FOCAL_PX, with_cache=True, augment=AugmentConfig(crop_px=(96, 224)),
        )  # fmt: skip

    def matcher(self) -> Path:
        """Train the matcher that all arms share, on synthetic streets."""
        pairs = self.pairs(Arm())
        pairs = replace(pairs, augment=AugmentConfig(crop_px=(64, 160), scale=(0.9, 1.4)))
        config = StereoTraining(
            matcher=MATCHER, pairs=pairs, loop=self.loop("stereo", 4),
            adam=AdamConfig(learning_rate=1e-3, schedule="cosine", warmup_steps=50),
        )  # fmt: skip
        return self.train("stereo", config, self.out / "matcher") / "matcher.safetensors"

    def apart(self, arm: Arm) -> Path:
        """Train the generator of an arm; give its file."""
        start = None
        if arm.real is not None:
            start = self.apart(replace(arm, real=None))
        adam = AdamConfig(learning_rate=5e-4, beta1=0.5, schedule="cosine")
        config = ViewTraining(
            generator=GENERATOR, discriminator=arm.discriminator, discriminator_width=32,
            generator_adam=adam, discriminator_adam=adam, pairs=self.pairs(arm),
            start=None if start is None else str(start),
            loop=self.loop("view" if start is None else "view on real", 4, arm.seed),
        )  # fmt: skip
        return self.train("view", config, self.out / arm.name / "view") / "generator.safetensors"

    def tuned(self, arm: Arm, generator: Path) -> Path:
        """Fine-tune an arm's generator; give the file of both networks."""
        config = FinetuneTraining(
            generator=str(generator), matcher=str(self.matcher()), pairs=self.pairs(arm),
            adam=AdamConfig(learning_rate=3e-4, beta1=0.5, schedule="cosine"),
            loop=self.loop("finetune", 2, arm.seed),
        )  # fmt: skip
        folder = self.train("finetune", config, self.out / arm.name / "finetune")
        return folder / "fakestereo.safetensors"

    def loop(self, stage: str, batch: int, seed: int = 0) -> LoopConfig:
        """Give the length of a stage."""
        return LoopConfig(
            steps=STEPS[stage], batch_size=batch, seed=seed, precision="bf16",
            save_every_steps=100, validate_every_steps=10**6, log_every_steps=50,
        )  # fmt: skip

    def train(self, stage: str, config: Any, folder: Path) -> Path:  # noqa: ANN401 - any stage
        """Train once; a finished run is reused."""
        if not (folder / "done.json").exists():

            def show(progress: Any) -> None:  # noqa: ANN401
                if progress.numbers:
                    print(folder.name, progress.step, dict(progress.numbers), flush=True)

            run = Run(folder=folder, resume=folder.exists(), on_step=show)
            STAGES[stage][1](config, run)
            write_json(folder / "done.json", {"stage": stage})
        return folder

    def measure(self, arm: Arm, stage: str, weights: Path) -> dict[str, Any]:
        """Measure weights on real pairs and on synthetic streets, once."""
        folder = self.out / arm.name / f"measured-{stage}"
        if not (folder / "row.json").exists():
            real = ("depth", "evaluate", "--data", str(self.options.evaluate), "--cap", "80")
            rule = ("--protocol", "eigen-raw-camera", "--weights", str(weights))
            assert depthpose([*real, *rule, "--out", str(folder / "real")]) == 0
            row: dict[str, Any] = json.loads((folder / "real" / "rows.json").read_text())[0]
            kept = ("abs_rel", "rmse", "d1", "right_l1", "right_psnr_db")
            row = {name: row[name] for name in kept if name in row} | synthetic_quality(weights)
            write_json(folder / "row.json", row)
        found = json.loads((folder / "row.json").read_text())
        facts = {"discriminator": arm.discriminator, "synthetic": arm.synthetic, "real": arm.real}
        return facts | {"seed": arm.seed, "stage": stage} | found

    def rows_of(self, arm: Arm) -> list[dict[str, Any]]:
        """Train and measure one arm: apart, and fine-tuned."""
        generator = self.apart(arm)
        home = self.out / arm.name
        both = home / "apart.safetensors"
        facts = bound_facts({}, [generator, self.matcher()])
        write_depth_weights(
            both, generator=read_generator(generator), matcher=read_matcher(self.matcher()),
            facts=facts,
        )  # fmt: skip
        rows = [self.measure(arm, "apart", both)]
        return [*rows, self.measure(arm, "fine-tuned", self.tuned(arm, generator))]


def synthetic_quality(weights: Path) -> dict[str, float]:
    """Errors of the generated view and of depth, in visible and in occluded regions."""
    net = FakestereoNet.load(weights, allow_ood=True)
    config = StreetsConfig(seed=9, scale=0.25)
    rows = [measure(net, draw_street(config, index)) for index in range(HELD_OUT_STREETS)]
    return {key: float(torch.tensor([r[key] for r in rows]).nanmean()) for key in rows[0]}


def draw_growth(path: Path, rows: list[dict[str, Any]]) -> None:
    """Plot AbsRel on the real pairs over the number of training pairs."""
    of = [row for row in rows if row["discriminator"] == "patch" and "batch" not in row["stage"]]
    synthetic, real = [{row["stage"]: list[tuple[float, float]]() for row in of} for _ in range(2)]
    for row in of:
        if row["real"] is None:
            synthetic[row["stage"]].append((row["synthetic"], row["abs_rel"]))
        if row["synthetic"] == Arm.synthetic:  # without real pairs: the synthetic ones alone
            real[row["stage"]].append((row["real"] or 0, row["abs_rel"]))
    draw_curves(
        path, {"synthetic pairs": synthetic, "real pairs": real}, "AbsRel, 25 real pairs", log=True
    )


def main() -> None:
    """Train and measure all arms; write the table and the plot after each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--synthetic", type=Path, required=True)
    parser.add_argument("--real", type=Path, required=True)
    parser.add_argument("--evaluate", type=Path, required=True)
    parser.add_argument("--pairs", type=int, nargs="+", default=[10, 30, 70])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/ablations"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    bench, rows = Bench(options), []
    for arm in arms(tuple(options.pairs), options.seeds):
        rows += bench.rows_of(arm)
        write_table(options.out, rows, name="ablations")
        draw_growth(options.out / "growth.png", rows)
    print(markdown_table(rows))


if __name__ == "__main__":
    main()
