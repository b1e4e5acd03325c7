"""Reliability of both probabilities: the share of right answers for each of their values.

    python bench/certainty.py --weights linemod.safetensors bunny.safetensors parts ycb

Synthetic views of all objects by seeds that no training has, three in ten unoccluded, the others
occluded by up to 60 %, a third of all at three times the noise. An answer is right if ADD to the
nearest true copy (a declared symmetry, or a detected one that is exact to 1 % of the diameter) is
below a tenth of the diameter, and named if it or one of its alternatives is right. The certainty
claims the latter, the copy certainty the former. Refused views are not counted. Writes answers.csv,
answers.json, and reliability.png: the share of right answers over the mean certainty of each band.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from curves import draw_curves
from shared import make_parser, mean_of

from depthpose.core.checkpoint import find_weights
from depthpose.core.rigid import Rigid
from depthpose.pose.config import ObjectsConfig, SyntheticSensorConfig
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.synthetic import SyntheticViews
from depthpose.pose.verify.copies import SymmetricCopies, find_copies
from depthpose.pose.weights import read_pose_weights
from depthpose.report.page import format_markdown_table, write_table

SEED = 0xCE47
NOISES = (1.0, 1.0, 3.0)  # times the sensor's usual noise; a third of the views for each
RIGHT = 0.1  # largest error of a right answer, in diameters
BANDS = ((0.0, 0.5), (0.5, 0.8), (0.8, 0.9), (0.9, 0.95), (0.95, 0.99), (0.99, 1.01))
MIN_PROBABILITIES = (0.9, 0.99)
MIN_ANSWERS = 5  # of a band in the table


class Answer(NamedTuple):
    """Probabilities of an answer, and whether it is right, by itself or by an alternative."""

    weights: str
    object: str
    certainty: float
    copy_certainty: float
    is_right: bool
    is_named: bool


def answers_of(name: str, number: int) -> Iterator[Answer | None]:
    """Pose synthetic views of each object of weights; None for a refusal."""
    weights = read_pose_weights(find_weights(name))
    net = GeoPoseNet(weights)
    copies = [find_copies(model) for model in weights.models]
    count = math.ceil(number / len(NOISES)) * len(weights.models)
    for third, noise in enumerate(NOISES):
        config = ObjectsConfig(
            number=count, seed=SEED + third, views=None, resolution=(1.0, 1.0), occluded_share=0.7,
            occlusion=(0.0, 0.6), sensor=SyntheticSensorConfig(noise=(0.5 * noise, 1.5 * noise)),
        )  # fmt: skip
        views = SyntheticViews(weights.models, config, weights.cloud)
        for index in range(count):
            view = views[index]
            estimate = net.estimate_many([view.input])[0]
            best = estimate.camera_from_model
            if best is None:
                yield None
                continue
            truth = view.truth.camera_from_model
            alternatives = [other.camera_from_model for other in estimate.alternatives]
            copies_of_object = copies[index % len(copies)]
            is_right = [
                add_in_diameters(pose, truth, copies_of_object) < RIGHT
                for pose in (best, *alternatives)
            ]
            yield Answer(
                weights=Path(name).stem,
                object=estimate.object,
                certainty=1.0 if estimate.certainty is None else estimate.certainty,
                copy_certainty=(
                    1.0 if estimate.copy_certainty is None else estimate.copy_certainty
                ),
                is_right=is_right[0],
                is_named=any(is_right),
            )


def add_in_diameters(pose: Rigid, truth: Rigid, copies: SymmetricCopies) -> float:
    """Compute ADD to the nearest near-symmetric copy of the truth, in diameters."""
    copies_of_truth = truth.double() @ Rigid.cat([copies.symmetries, copies.near_copies])
    posed_m = pose.double().apply(copies.points_m)
    true_m = copies_of_truth.apply(copies.points_m.expand(len(copies_of_truth.R), -1, -1))
    return float((posed_m - true_m).norm(dim=-1).mean(-1).min()) / copies.diameter_m


def band_rows(answers: Sequence[Answer]) -> list[dict[str, Any]]:
    """Compute a row for each band of certainty."""
    rows = []
    for low, high in BANDS:
        in_band = [answer._asdict() for answer in answers if low <= answer.certainty < high]
        if len(in_band) >= MIN_ANSWERS:
            rows.append(
                {
                    "certainty": f"{low:g} to {min(high, 1):g}",
                    "answers": len(in_band),
                    "mean": mean_of(in_band, "certainty"),
                    "right": mean_of(in_band, "is_right"),
                    "right or named": mean_of(in_band, "is_named"),
                }
            )
    return rows


def limit_rows(answers: Sequence[Answer]) -> list[dict[str, Any]]:
    """Count wrong answers above a probability, beside the number that it allows."""
    rows = []
    for probability, limit in itertools.product(("certainty", "copy_certainty"), MIN_PROBABILITIES):
        sure = [answer for answer in answers if getattr(answer, probability) >= limit]
        allowed = (1 - limit) * len(sure)
        rows.append(
            {
                "probability": f"{probability}, at least {limit}",
                "answers": len(sure),
                "wrong": sum(not answer.is_right for answer in sure),
                "neither right nor named": sum(not answer.is_named for answer in sure),
                "allowed": allowed,
                "two standard deviations": 2 * math.sqrt(allowed * limit),
            }
        )
    return rows


def main() -> None:
    """Print both tables, for all weights together and for each."""
    parser = make_parser(__doc__)
    parser.add_argument("--weights", nargs="+", default=["parts", "ycb"])
    parser.add_argument("--number", type=int, default=60, help="views of each object")
    parser.add_argument("--out", type=Path, default=Path("out/certainty"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    answers_by_weights: dict[str, list[Answer]] = {}
    for name in options.weights:
        answers_or_refusals = list(answers_of(name, options.number))
        answers = [answer for answer in answers_or_refusals if answer is not None]
        print(f"{name}: {len(answers_or_refusals)} views, {len(answers)} answered", flush=True)
        print(format_markdown_table(limit_rows(answers)), flush=True)
        answers_by_weights[Path(name).stem] = answers
    all_answers = [answer for answers in answers_by_weights.values() for answer in answers]
    print(format_markdown_table(band_rows(all_answers)))
    print(format_markdown_table(limit_rows(all_answers)))
    write_table(options.out, [answer._asdict() for answer in all_answers], name="answers")
    curves = {
        name: [(row["mean"], row["right"]) for row in band_rows(answers)]
        for name, answers in {**answers_by_weights, "all": all_answers}.items()
    }
    curves["as said"] = [(0.0, 0.0), (1.0, 1.0)]
    draw_curves(options.out / "reliability.png", {"certainty": curves}, "share that is right")


if __name__ == "__main__":
    main()
