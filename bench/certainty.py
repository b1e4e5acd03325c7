"""Reliability of the certainty: how often answers of each certainty are right.

    python bench/certainty.py --weights linemod.safetensors bunny.safetensors parts ycb

Synthetic views of all objects by seeds that no training has, three in ten unoccluded, the others
occluded by up to 60 %, a third of all at three times the noise. An answer is right where ADD to the
nearest true copy (a declared symmetry, or a detected one that is exact to 1 % of the diameter) is
below a tenth of the diameter. Refused views count nowhere. Writes answers.csv, answers.json, and
reliability.png: the share that is right over the mean certainty of each band.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from curves import draw_curves

from depthpose.core.checkpoint import find_weights
from depthpose.core.rigid import Rigid
from depthpose.pose.config import ObjectsConfig, SyntheticSensorConfig
from depthpose.pose.copies import SymmetricCopies, find_copies
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.synthetic import Objects
from depthpose.pose.weights import read_pose_weights
from depthpose.report.page import markdown_table, write_table

SEED = 0xCE47
NOISES = (1.0, 1.0, 3.0)
BANDS = ((0.0, 0.5), (0.5, 0.8), (0.8, 0.9), (0.9, 0.95), (0.95, 0.99), (0.99, 1.01))
LEAST = (0.9, 0.99)
FEWEST = 5
"""Bands of fewer answers say nothing."""


class Answer(NamedTuple):
    """An answer's certainty, and whether it is right, by itself or by one of its alternatives."""

    weights: str
    object: str
    certainty: float
    is_right: bool
    is_named: bool


def answers_of(name: str, number: int) -> Iterator[Answer | None]:
    """Pose synthetic views of each object of weights; None where one is refused."""
    weights = read_pose_weights(find_weights(name))
    net = GeoPoseNet(weights)
    copies = [find_copies(model) for model in weights.models]
    count = math.ceil(number / len(NOISES)) * len(weights.models)
    for part, factor in enumerate(NOISES):
        config = ObjectsConfig(
            number=count, seed=SEED + part, views=None, resolution=(1.0, 1.0), occluded_share=0.7,
            occlusion=(0.0, 0.6), sensor=SyntheticSensorConfig(noise=(0.5 * factor, 1.5 * factor)),
        )  # fmt: skip
        views = Objects(weights.models, config, weights.cloud)
        for k in range(count):
            estimate = net.estimate_many([views[k].input])[0]
            pose, truth = estimate.camera_from_model, views[k].truth.camera_from_model
            if pose is None:
                yield None
                continue
            every = [pose, *(other.camera_from_model for other in estimate.alternatives)]
            errors = [add_in_diameters(one, truth, copies[k % len(copies)]) for one in every]
            right = [error < 0.1 for error in errors]
            certainty = 1.0 if estimate.certainty is None else estimate.certainty
            yield Answer(Path(name).stem, estimate.object, certainty, right[0], any(right))


def add_in_diameters(pose: Rigid, truth: Rigid, copies: SymmetricCopies) -> float:
    """ADD to the nearest near-symmetric copy of the truth, in diameters: what a certainty is of."""
    copies_of_truth = truth.double() @ Rigid.cat([copies.symmetries, copies.near_copies])
    posed_m = pose.double().apply(copies.points_m)
    true_m = copies_of_truth.apply(copies.points_m.expand(len(copies_of_truth.R), -1, -1))
    return float((posed_m - true_m).norm(dim=-1).mean(-1).min()) / copies.diameter_m


def band_rows(answers: Sequence[Answer]) -> list[dict[str, Any]]:
    """One row for each band of certainty."""
    rows = []
    for low, high in BANDS:
        some = [a for a in answers if low <= a.certainty < high]
        if len(some) >= FEWEST:
            rows.append({
                "certainty": f"{low:g} to {min(high, 1):g}", "answers": len(some),
                "mean": sum(a.certainty for a in some) / len(some),
                "right": sum(a.is_right for a in some) / len(some),
                "right or named": sum(a.is_named for a in some) / len(some),
            })  # fmt: skip
    return rows


def limit_rows(answers: Sequence[Answer]) -> list[dict[str, Any]]:
    """Wrong answers above a certainty, beside what its complement allows in so many."""
    rows = []
    for least in LEAST:
        some = [a for a in answers if a.certainty >= least]
        allowed = (1 - least) * len(some)
        rows.append({
            "certainty at least": least, "answers": len(some),
            "wrong": sum(not a.is_right for a in some), "allowed": allowed,
            "two standard deviations": 2 * math.sqrt(allowed * least),
        })  # fmt: skip
    return rows


def main() -> None:
    """Print both tables, for all weights together and for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", nargs="+", default=["parts", "ycb"])
    parser.add_argument("--number", type=int, default=60, help="views of each object")
    parser.add_argument("--out", type=Path, default=Path("out/certainty"))
    words = parser.parse_args()
    torch.set_num_threads(1)
    answers: dict[str, list[Answer]] = {}
    for name in words.weights:
        views = list(answers_of(name, words.number))
        answers[Path(name).stem] = [a for a in views if a is not None]
        print(f"{name}: {len(views)} views, {len(answers[Path(name).stem])} answered", flush=True)
        print(markdown_table(limit_rows(answers[Path(name).stem])), flush=True)
    every = [a for some in answers.values() for a in some]
    print(markdown_table(band_rows(every)))
    print(markdown_table(limit_rows(every)))
    write_table(words.out, [a._asdict() for a in every], name="answers")
    curves = {
        name: [(row["mean"], row["right"]) for row in band_rows(some)]
        for name, some in {**answers, "all": every}.items()
    }
    curves["as said"] = [(0.0, 0.0), (1.0, 1.0)]
    draw_curves(words.out / "reliability.png", {"certainty": curves}, "share that is right")


if __name__ == "__main__":
    main()
