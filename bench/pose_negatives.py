"""Clouds that do not show the requested object: shares ``ok``, ambiguous, identity confirmed.

    python bench/pose_negatives.py --weights parts ycb linemod.safetensors --number 40

Eight kinds of negatives, ``--number`` of each: another object of the weights (or one of our parts,
if they have one only), copies scaled by 0.8, 0.9, 1.1 and 1.25 (``--number`` each), mirrored ones,
blobs, plates, boxes and cylinders, balls, and hands of capsules. The mirror image of
an object that it deviates from by 3 % of the diameter at most is no negative: "mirror image alike".
Views are rendered like held-out ones, half of them with up to a half occluded. Also the objects
themselves, four times as many: right is an ADD (to the nearest symmetric pose) below 10 % of
the diameter. ``--seed`` draws other views.
Each is a depth image with a mask; ``--clouds`` gives the points in the mask alone.
``--method register`` registers the objects without a network, ``both`` what the network doubts.
``--save`` writes fit and signals as JSON; then nothing is refused for its fit.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

import torch
from negatives import SCALES, NegativeKind, negative_of

from depthpose.core.checkpoint import find_weights
from depthpose.core.loop import sample_generator
from depthpose.pose.config import EstimateConfig, ObjectsConfig
from depthpose.pose.estimator import PoseEstimator
from depthpose.pose.mesh import MIRROR_ALIKE, mirror_deviation
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic import Objects
from depthpose.pose.train.clouds import add_error
from depthpose.pose.types import CloudSample, ObjectModel, ViewSample
from depthpose.report.page import markdown_table

SEED = 0x0DD
TOGETHER = 32
ITSELF = "itself"
ALIKE = "mirror image alike"
Row = dict[str, Any]


def seen(
    models: Sequence[ObjectModel], seed: int, with_scene: bool
) -> Iterator[CloudSample | ViewSample]:
    """Render each of some models once: a depth image and a mask, or the cloud of the mask alone."""
    config = ObjectsConfig(
        number=len(models), seed=seed, views=None, resolution=(1.0, 1.0), occluded_share=0.5,
        occlusion=(0.0, 0.5),
    )  # fmt: skip
    objects = Objects(models, config)
    return (objects.view(k) if with_scene else objects[k] for k in range(len(models)))


def things(
    known: Sequence[ObjectModel], kind: str, number: int, seed: int
) -> tuple[list[ObjectModel], list[int]]:
    """Give the model in view, and the number of the requested object."""
    generator = sample_generator(sum(map(ord, kind)), seed)
    asked = [k % len(known) for k in range(number)]
    models = [known[k] for k in asked]
    if kind == ITSELF:
        return models, asked
    name, _, times = kind.partition(" by ")
    scale = float(times) if times else None
    found: Any = name
    return [negative_of(m, found, known, generator, scale) for m in models], asked


def kinds() -> Iterator[str]:
    """Give the name of the model in view."""
    for kind in get_args(NegativeKind):
        if kind == "scaled":
            yield from (f"scaled by {times}" for times in SCALES)
        else:
            yield kind


def measure(
    net: PoseEstimator, kind: str, number: int, seed: int, with_scene: bool = True
) -> list[Row]:
    """Estimate every negative of a kind, or the objects themselves."""
    models, asked = things(net.models, kind, number, seed)
    samples = list(seen(models, seed, with_scene))
    starts = range(0, len(samples), TOGETHER)
    parts = ([sample.input for sample in samples[k : k + TOGETHER]] for k in starts)
    estimates = [estimate for part in parts for estimate in net.estimate_many(part)]
    rows = []
    for sample, which, found in zip(samples, asked, estimates, strict=True):
        error = add_error(
            found.camera_from_model, sample.truth.camera_from_model, net.models[which]
        )
        is_right = kind == ITSELF and error < 0.1
        is_alike = kind == "mirrored" and mirror_deviation(net.models[which]) <= MIRROR_ALIKE
        rows.append({
            "kind": ALIKE if is_alike else kind, "object": sample.input.object,
            "status": found.status,
            "right": is_right, "evidence": found.evidence and vars(found.evidence),
            "identity": found.identity and found.identity.status,
            "hidden": 1 - (sample.truth.visible_fraction or 0.0),
        })  # fmt: skip
    return rows


def groups(rows: Sequence[Row]) -> list[list[Row]]:
    """Part the rows of one kind: mirror images that are nearly the object are no negatives."""
    parts = [[row for row in rows if (row["kind"] == ALIKE) == alike] for alike in (True, False)]
    return [part for part in parts if part]


def summary(rows: Sequence[Row]) -> Row:
    """Count answers."""
    ok = sum(row["status"] == "ok" for row in rows)
    row: Row = {"kind": rows[0]["kind"], "number": len(rows), "ok": ok / len(rows)}
    row["ambiguous"] = sum(row["status"] == "ambiguous" for row in rows) / len(rows)
    posed = [row for row in rows if row["status"] in ("ok", "ambiguous")]
    row["confirmed"] = sum(row["identity"] == "confirmed" for row in posed) / len(rows)
    if rows[0]["kind"] == ITSELF:
        row["right"] = sum(row["right"] for row in rows) / len(rows)
        row["ok and wrong"] = sum(r["status"] == "ok" and not r["right"] for r in rows) / len(rows)
    return row


def main() -> None:
    """Measure every set of weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", nargs="+", default=["parts"])
    parser.add_argument("--number", type=int, default=40)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--clouds", action="store_true", help="clouds in place of depth images")
    parser.add_argument("--method", choices=("network", "register", "both"), default="network")
    parser.add_argument("--kinds", nargs="*", help="some of the kinds alone")
    parser.add_argument("--save", type=Path, help="a folder for the signals of each set")
    words = parser.parse_args()
    if words.save and words.method == "both":
        parser.error("--save opens one refusal, and both methods have their own; save each alone")
    torch.set_num_threads(1)
    for name in words.weights:
        config = EstimateConfig(register_refused=words.method == "both")
        net = GeoPoseNet.load(find_weights(name), config)
        opened = dataclasses.replace(net.refusal, min_probability=0.0)
        if words.method == "register":
            net = Registration(net.models, refusal=opened if words.save else None)
        elif words.save:
            net.weights = dataclasses.replace(net.weights, refusal=opened)
        began, rows = time.process_time(), []
        for kind in words.kinds or [ITSELF, *kinds()]:
            number = 4 * words.number if kind == ITSELF else words.number
            some = groups(measure(net, kind, number, words.seed, not words.clouds))
            print(*map(summary, some), sep="\n", flush=True)
            rows += some
        every = [row for some in rows for row in some if row["kind"] not in (ITSELF, ALIKE)]
        table = [summary(some) for some in rows]
        if every:
            table.append({**summary(every), "kind": "all negatives"})
        print(f"{name}, {time.process_time() - began:.0f} s\n{markdown_table(table)}")
        if words.save:
            words.save.mkdir(parents=True, exist_ok=True)
            path = words.save / f"{Path(name).stem}.json"
            path.write_text(json.dumps([row for some in rows for row in some]))


if __name__ == "__main__":
    main()
