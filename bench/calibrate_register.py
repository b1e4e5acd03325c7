"""The risk of a wrong registration, calibrated on random parts and checked on others.

    python bench/calibrate_register.py --parts 60 --check 20

Each random part is seen in eight depth images with up to 60 % hidden, and in its place one negative
of each of eight kinds: another part, a scaled copy, a mirrored one where that differs, a blob, a
plate, a box or cylinder, a ball and a hand. Nothing is refused for its risk while signals are
collected; ``calibrate_refusal`` then weighs them, and chooses the limit so that at most 1 % of the
answers are wrong and at most 1 % of the negatives are answered. Prints the settings that
``src/depthpose/pose/estimator/register.py`` holds, and what they answer on the parts kept back;
writes all signals to ``rows.json``. ``--rows`` takes those of an earlier run.
"""

import argparse
import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast, get_args

import torch

from depthpose.core.loop import sample_generator
from depthpose.pose.config import ObjectsConfig, RefusalConfig
from depthpose.pose.estimator import calibrate_refusal, risk_of
from depthpose.pose.estimator.evidence import CONTEXT
from depthpose.pose.estimator.register import CANDIDATE_SLOPES, Registration
from depthpose.pose.synthetic import Objects, random_part
from depthpose.pose.synthetic.negatives import NegativeKind, negative_kinds, negative_of
from depthpose.pose.train.held_out import pose_error
from depthpose.pose.types import ObjectModel, PoseEstimate
from depthpose.report.tables import markdown_table

SEED = 0x9A27
VIEWS = 8
ITSELF = "itself"
MAX_WRONG = 0.01
OPEN = RefusalConfig(max_risk=1.0, candidate_slopes=CANDIDATE_SLOPES)
Row = dict[str, Any]


def seen_in_place(number: int) -> tuple[ObjectModel, list[tuple[str, ObjectModel]]]:
    """Make a part, and what is seen in each of its views."""
    generator = sample_generator(number, SEED)
    part, other = (random_part(generator) for _ in range(2))
    others = [dataclasses.replace(other, name="other")]
    shown = [(ITSELF, part)] * VIEWS
    for kind in negative_kinds(part):
        shown.append((kind, negative_of(part, kind, others, generator)))
    return part, shown


def rows_of(number: int) -> Iterator[Row]:
    """Register every view of a random part, and of what is not it."""
    part, shown = seen_in_place(number)
    registration = Registration([part], refusal=OPEN)
    config = ObjectsConfig(
        number=len(shown), seed=SEED + number, views=None, resolution=(1.0, 1.0),
        occluded_share=0.8, occlusion=(0.0, 0.6),
    )  # fmt: skip
    views = Objects([model for _, model in shown], config)
    for k, (kind, _) in enumerate(shown):
        sample = views.view(k)
        found = registration.estimate_many([sample.input])[0]
        error = pose_error(found, sample.truth, part) if kind == ITSELF else 1.0
        yield {
            "part": number, "kind": kind, "status": found.status, "signals": found.signals,
            "right": found.is_ok and error < 0.1,
        }  # fmt: skip


def calibrated(rows: Sequence[Row]) -> RefusalConfig:
    """Weigh the signals that registration has."""
    own = [row for row in rows if row["kind"] == ITSELF]
    others = [row for row in rows if row["kind"] != ITSELF]
    found = calibrate_refusal(
        estimates(own), [row["right"] for row in own], MAX_WRONG, estimates(others), without=CONTEXT
    )
    slopes = {name: round(k, 3) for name, k in found.slopes.items() if k > 1e-3}
    return dataclasses.replace(
        OPEN, max_risk=round(found.max_risk, 4), bias=round(found.bias, 3), slopes=slopes,
        means={name: round(found.means[name], 2) for name in slopes},
    )  # fmt: skip


def estimates(rows: Sequence[Row]) -> list[PoseEstimate]:
    """Give what calibration asks of estimates."""
    return [cast(PoseEstimate, Answer(row["signals"], row["status"] == "ok")) for row in rows]


@dataclasses.dataclass(frozen=True)
class Answer:
    """What calibration asks of an estimate."""

    signals: dict[str, float]
    is_ok: bool


def counts(rows: Sequence[Row], refusal: RefusalConfig) -> Iterator[Row]:
    """Count right, refused and wrong answers of each kind."""
    for kind in (ITSELF, *get_args(NegativeKind)):
        some = [row for row in rows if row["kind"] == kind]
        ok = [row for row in some if row["status"] == "ok"
              and (risk_of(row["signals"], refusal) or 0.0) <= refusal.max_risk]  # fmt: skip
        right = sum(row["right"] for row in ok)
        yield {"seen": kind, "views": len(some), "right": right, "wrong": len(ok) - right,
               "refused": len(some) - len(ok)}  # fmt: skip


def main() -> None:
    """Collect, calibrate, check."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", type=int, default=60, help="by which is calibrated")
    parser.add_argument("--check", type=int, default=20, help="by which is checked")
    parser.add_argument("--rows", type=Path, help="rows.json of an earlier run")
    parser.add_argument("--out", type=Path, default=Path("out/calibrate_register"))
    words = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[Row] = json.loads(words.rows.read_text()) if words.rows else []
    known = {row["part"] for row in rows}
    words.out.mkdir(parents=True, exist_ok=True)
    for number in range(words.parts + words.check):
        if number not in known:
            rows += rows_of(number)
            (words.out / "rows.json").write_text(json.dumps(rows))
            print(f"part {number + 1} of {words.parts + words.check}", flush=True)
    refusal = calibrated([row for row in rows if row["part"] < words.parts])
    print(refusal)
    last = words.parts + words.check
    held_back = [row for row in rows if words.parts <= row["part"] < last]
    print(markdown_table(list(counts(held_back, refusal))))


if __name__ == "__main__":
    main()
