"""Effect of each choice of the selecting generator, at one small size and one number of steps.

    python bench/select_choices.py --encoder lite0.safetensors --streets streets \
        --real FOLDER ... --labelled FOLDER ... --unlabelled FOLDER ... --without NAME ... \
        --held-out FOLDER --evaluate PAIRS/kitti2015_eval_drives --out out/select_choices

``--real`` are pairs with truth, ``--unlabelled`` pairs without, ``--labelled`` the same with the
labels of a matcher ('depthpose data label'). Choose by ``--held-out``, pairs of other training
drives; ``--evaluate`` is for the table alone. Results in ``--out`` are reused: a second
call continues where the first was stopped.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from depthpose.cli import main as depthpose
from depthpose.core.checkpoint import bound_facts
from depthpose.core.files import write_json
from depthpose.core.loop import AdamConfig, LoopConfig, Run
from depthpose.depth.config import (
    Answer,
    AugmentConfig,
    DegradeConfig,
    GeneratorConfig,
    MatcherConfig,
    PairsConfig,
    SelectionConfig,
)
from depthpose.depth.datasets import open_dataset
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.synthesis import (
    SelectionGenerator,
    SelectionSynthesiser,
    SynthesisedViews,
    mix_shifts,
)
from depthpose.depth.train import STAGES
from depthpose.depth.train.config import SelectTraining, ViewTraining
from depthpose.depth.weights import make_matcher, read_generator, read_matcher, write_depth_weights
from depthpose.report.page import markdown_table, write_table

FOCAL_PX = 186.0
"""A quarter of KITTI's resolution: an arm takes minutes on one core."""

RIG = SelectionConfig(virtual_focal_px=FOCAL_PX, disparity_px=(0.6, 44.0))
CROP = AugmentConfig(crop_px=(96, 288), scale=(0.9, 1.15), jitter=0.0)
HARSH = DegradeConfig(
    colour=0.5, hue_share=0.25, haze_share=0.4, glare_share=0.4, blur_share=0.6, blur_px=2.0,
    noise_share=0.8, noise=0.08, jpeg_share=0.5,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Arm:
    """One training of the generator that selects.

    Attributes:
        name: in the table.
        change: of the config.
        data: which pairs: streets, real ones, or both (three real ones for each street).
        unlabelled: what pairs without truth are seen as: with labels of a matcher, as they are, or
            not at all.
        seed: of the training.
    """

    name: str
    change: dict[str, Any] = field(default_factory=dict)
    data: str = "both"
    unlabelled: str = "labelled"
    seed: int = 0


ARMS = (
    Arm(name="as shipped"),
    Arm(name="as shipped", seed=1),
    Arm(name="streets alone", data="streets"),
    Arm(name="streets alone, encoder's rate 0.05", data="streets", change={"encoder_rate": 0.05}),
    Arm(name="streets alone, harsher degrade", data="streets", change={"degrade": HARSH}),
    Arm(name="real alone", data="real"),
    Arm(
        name="encoder from scratch",
        change={"encoder": None, "with_frozen_stem": False, "encoder_rate": 1.0},
    ),
    Arm(name="no cross entropy", change={"plane_weight": 0.0}),
    Arm(name="no view loss", change={"view_weight": 0.0}),
    Arm(name="pairs without truth teach by the view alone", unlabelled="unlabelled"),
    Arm(name="pairs without truth left out", unlabelled="none"),
    Arm(name="pairs without truth left out", unlabelled="none", seed=1),
    Arm(name="streets alone", data="streets", seed=1),
)


class MixingSynthesiser(SelectionSynthesiser):
    """Renders the right view as a mixture of shifts instead of by one shift per pixel."""

    def draw(self, left: torch.Tensor, *larger: torch.Tensor) -> SynthesisedViews:
        """Synthesise right views; images are RGB in [0, 1]."""
        height, width = left.shape[-2:]
        size = (round(height / 32) * 32, round(width / 32) * 32)
        given = torch.nn.functional.interpolate(left, size, mode="bilinear", antialias=True)
        with torch.no_grad():
            logits = self.generator(given)[1].float()
            planes = self.generator.planes / 2
            small = torch.nn.functional.avg_pool2d(given, 2)
            drawn = mix_shifts(small, logits, planes)
        right = torch.nn.functional.interpolate(drawn, (height, width), mode="bilinear")
        return replace(super().draw(left, *larger), right=right.clamp(0, 1))


class Bench:
    """Folders of data and runs."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.out = options, options.out

    def pairs(self, folders: list[str], limit: int | None = None) -> PairsConfig:
        """Give pairs of some folders at the size of this bench."""
        return PairsConfig(
            folders=tuple(map(str, folders)), exclude=tuple(self.options.without), limit=limit,
            focal_px=FOCAL_PX, with_cache=True, augment=CROP,
        )  # fmt: skip

    def sources(self, arm: Arm) -> dict[str, Any]:
        """Give the training data of an arm."""
        streets = replace(self.pairs([self.options.streets]), exclude=(), truth="disparity")
        if arm.data == "streets":
            return {"pairs": streets}
        more = {
            "labelled": self.options.labelled, "unlabelled": self.options.unlabelled, "none": [],
        }[arm.unlabelled]  # fmt: skip
        found: dict[str, Any] = {"pairs": self.pairs([*self.options.real, *more])}
        return found if arm.data == "real" else found | {"more": streets, "more_share": 0.3}

    def loop(self, seed: int) -> LoopConfig:
        """Give the length of an arm."""
        return LoopConfig(
            steps=self.options.steps, batch_size=8, seed=seed, precision="bf16", clip_norm=5.0,
            ema_decay=0.99, save_every_steps=100, validate_every_steps=self.options.steps,
            log_every_steps=50,
        )  # fmt: skip

    def train(self, stage: str, config: Any, folder: Path) -> Path:  # noqa: ANN401 - any stage
        """Train once; a finished run is reused."""
        if not (folder / "done.json").exists():
            run = Run(folder=folder, resume=folder.exists())
            STAGES[stage][1](config, run)
            write_json(folder / "done.json", {"stage": stage})
        return folder / "generator.safetensors"

    def selecting(self, arm: Arm) -> dict[str, Any]:
        """Train and measure the generator that selects."""
        folder = self.out / f"{arm.name.replace(' ', '_')}-{arm.seed}"
        base = SelectTraining(
            generator=RIG, encoder=str(self.options.encoder), loop=self.loop(arm.seed),
            held_out=replace(self.pairs([self.options.held_out]), exclude=()),
            adam=AdamConfig(
                learning_rate=1e-3, schedule="cosine", warmup_steps=30, weight_decay=1e-2
            ),
            **self.sources(arm),
        )  # fmt: skip
        weights = self.train("select", replace(base, **arm.change), folder)
        held = last_held_out(folder)
        return {"arm": arm.name, "seed": arm.seed} | held | self.measure(folder, "own", weights)

    def painting(self) -> dict[str, Any]:
        """Train the U-Net generator on the same pairs, and match its views."""
        folder = self.out / "painted"
        generator = GeneratorConfig(width=24, levels=5, virtual_focal_px=FOCAL_PX)
        adam = AdamConfig(learning_rate=5e-4, beta1=0.5, schedule="cosine")
        found = self.sources(Arm(name=""))
        folders = [*found["pairs"].folders, *found["more"].folders]
        config = ViewTraining(
            generator=generator, discriminator_width=32, generator_adam=adam,
            discriminator_adam=adam, loop=replace(self.loop(0), clip_norm=None, ema_decay=None),
            pairs=replace(self.pairs(folders), truth=None, augment=replace(CROP, scale=(1.0, 1.0))),
        )  # fmt: skip
        both = self.packed(self.train("view", config, folder), "matched", folder)
        return {"arm": "painted view, matched", "seed": 0} | self.measure(folder, "matched", both)

    def packed(self, weights: Path, answer: Answer, folder: Path) -> Path:
        """Write a generator with the matcher of the shipped set beside it."""
        generator = read_generator(weights)
        if isinstance(generator, SelectionGenerator):
            generator.config = replace(generator.config, answer=answer)
        path = folder / f"{answer}.safetensors"
        facts = bound_facts({}, [weights])
        matcher = read_matcher(self.options.matcher)
        write_depth_weights(path, generator=generator, matcher=matcher, facts=facts)
        return path

    def measure(self, folder: Path, name: str, weights: Path) -> dict[str, Any]:
        """Measure weights on the evaluation pairs, once."""
        return self.evaluated(folder / f"measured-{name}", ["--weights", str(weights)])

    def evaluated(self, out: Path, what: list[str]) -> dict[str, Any]:
        """Run the evaluation, once."""
        if not (out / "rows.json").exists():
            data = ["--data", str(self.options.evaluate), "--cap", "80"]
            rule = ["--protocol", "eigen-raw-camera", "--out", str(out)]
            assert depthpose(["depth", "evaluate", *data, *rule, *what]) == 0
        row = json.loads((out / "rows.json").read_text())[0]
        return {f"eval {name}": row[name] for name in ("abs_rel", "rmse", "d1")}

    def answers(self) -> list[dict[str, Any]]:
        """Measure other uses of the first arm's distributions."""
        folder = self.out / "as_shipped-0"
        weights = folder / "generator.safetensors"
        found = self.measure(folder, "matched", self.packed(weights, "matched", folder))
        matched = {"arm": "as shipped, matched", "seed": 0} | found
        generator = read_generator(weights)
        assert isinstance(generator, SelectionGenerator)
        generator.config = replace(generator.config, answer="matched")
        matcher = make_matcher(read_matcher(self.options.matcher), MatcherConfig())
        mixing = FakestereoNet(matcher, MixingSynthesiser(generator))
        predictions = folder / "mixture"
        predict(mixing, self.options.evaluate, predictions)
        found = self.evaluated(folder / "measured-mixture", ["--predictions", str(predictions)])
        return [matched, {"arm": "as shipped, matched on a mixture of shifts", "seed": 0} | found]


def predict(net: FakestereoNet, data: Path, folder: Path) -> None:
    """Write depth of every left image of a data set."""
    folder.mkdir(parents=True, exist_ok=True)
    dataset = open_dataset(data)
    for index, frame in enumerate(dataset.frames):
        given = dataset.read_input(index)
        found = net.estimate(given.left, given.camera)
        assert found.depth_m is not None
        np.save(folder / f"{frame.name}.depth_m.npy", found.depth_m.numpy())


def last_held_out(folder: Path) -> dict[str, float]:
    """Give the last validation of a run."""
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    last = next(line for line in reversed(lines) if "held_out/abs_rel" in line)
    return {f"held out {n}": last[f"held_out/{n}"] for n in ("abs_rel", "d1")}


def main() -> None:
    """Train and measure all arms; write the table after each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    for name in ("encoder", "streets", "held-out", "evaluate"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    for name in ("real", "labelled", "unlabelled", "without"):
        parser.add_argument(f"--{name}", nargs="+", default=[])
    parser.add_argument("--matcher", type=Path, help="weights of the matcher of synthesised views")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--out", type=Path, default=Path("out/select_choices"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    bench, rows = Bench(options), list[dict[str, Any]]()

    def add(measure: Callable[[], list[dict[str, Any]]]) -> None:
        rows.extend(measure())
        write_table(options.out, rows, name="select_choices")

    for arm in ARMS:
        add(lambda arm=arm: [bench.selecting(arm)])
    add(bench.answers)
    add(lambda: [bench.painting()])
    print(markdown_table(rows))


if __name__ == "__main__":
    main()
