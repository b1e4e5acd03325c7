"""The risk of a wrong registration, calibrated on random parts and checked on others.

    python bench/calibrate_register.py --parts 60 --check 20 --simple 40

Each part is seen in eight depth images with up to 60 % hidden, and in its place one negative of
each of eight kinds: another part, a scaled copy, a mirrored one where that differs, a blob, a
plate, a box or cylinder, a ball and a hand. Nothing is refused for its risk while signals are
collected; ``calibrate_refusal`` then weighs them, and chooses the limit so that at most 1 % of the
answers are wrong (neither the answer nor one of its alternatives is right) and at most 1 % of the
negatives are answered. Prints the settings that ``src/depthpose/pose/estimator/register.py`` holds
and what they answer on the parts kept back, then what the shipped settings answer on all parts, and
on simple ones (boxes, tubes, cups, L, T and U profiles), whose symmetries are found and taken, as
``Registration.load`` does. All signals go to ``rows.json``; ``--rows`` takes those of an earlier
run.
"""

import argparse
import dataclasses
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast, get_args

import torch

from depthpose.core.loop import sample_generator
from depthpose.pose.config import ObjectsConfig, RefusalConfig
from depthpose.pose.estimator import calibrate_refusal, risk_of
from depthpose.pose.estimator.evidence import CONTEXT
from depthpose.pose.estimator.register import CANDIDATE_SLOPES, REFUSAL, Registration
from depthpose.pose.mesh import with_found_symmetries
from depthpose.pose.synthetic import Objects, random_part, random_simple_part
from depthpose.pose.synthetic.negatives import NegativeKind, negative_kinds, negative_of
from depthpose.pose.train.held_out import pose_error
from depthpose.pose.types import ObjectModel, PoseEstimate
from depthpose.report.tables import markdown_table

SEED = 0x9A27
VIEWS = 8
ITSELF = "itself"
MAX_WRONG = 0.01
OPEN = RefusalConfig(max_risk=1.0, candidate_slopes=CANDIDATE_SLOPES)
_CERTAINTIES = (0.0, 0.5, 0.8, 0.9, 0.99, 1.01)
Row = dict[str, Any]


def seen_in_place(
    number: int, *, is_simple: bool
) -> tuple[ObjectModel, list[tuple[str, ObjectModel]]]:
    """Make a part, and what is seen in each of its views."""
    generator = sample_generator(number, SEED)
    make = random_simple_part if is_simple else random_part
    part, other = (make(generator) for _ in range(2))
    part = with_found_symmetries(part, None, is_taken=True)
    others = [dataclasses.replace(other, name="other")]
    shown = [(ITSELF, part)] * VIEWS
    for kind in negative_kinds(part):
        shown.append((kind, negative_of(part, kind, others, generator)))
    return part, shown


def rows_of(number: int, *, is_simple: bool) -> Iterator[Row]:
    """Register every view of a random part, and of what is not it."""
    part, shown = seen_in_place(number, is_simple=is_simple)
    registration = Registration([part], refusal=OPEN)
    config = ObjectsConfig(
        number=len(shown), seed=SEED + number, views=None, resolution=(1.0, 1.0),
        occluded_share=0.8, occlusion=(0.0, 0.6),
    )  # fmt: skip
    views = Objects([model for _, model in shown], config)
    for k, (kind, _) in enumerate(shown):
        sample = views.view(k)
        found = registration.estimate_many([sample.input])[0]
        poses = [found.camera_from_model, *(a.camera_from_model for a in found.alternatives)]
        answers = [dataclasses.replace(found, camera_from_model=pose) for pose in poses]
        is_right = [kind == ITSELF and pose_error(answer, sample.truth, part) < 0.1
                    for answer in answers]  # fmt: skip
        share = 1.0 if found.certainty is None else found.certainty
        yield {
            "part": number, "kind": kind, "status": found.status, "signals": found.signals,
            "share": share, "right": is_right[0], "named": any(is_right),
        }  # fmt: skip


def calibrated(rows: Sequence[Row]) -> RefusalConfig:
    """Weigh the signals that registration has."""
    own = [row for row in rows if row["kind"] == ITSELF]
    others = [row for row in rows if row["kind"] != ITSELF]
    found = calibrate_refusal(
        estimates(own), [row["named"] for row in own], MAX_WRONG, estimates(others), without=CONTEXT
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
    """Count right, refused and wrong answers of each kind, and those that only name the truth."""
    for kind in (ITSELF, *get_args(NegativeKind)):
        some = [row for row in rows if row["kind"] == kind]
        ok = [row for row in some if row["status"] == "ok"
              and (risk_of(row["signals"], refusal) or 0.0) <= refusal.max_risk]  # fmt: skip
        right, named = (sum(row[key] for row in ok) for key in ("right", "named"))
        yield {"seen": kind, "views": len(some), "right": right, "among the others": named - right,
               "wrong": len(ok) - named, "refused": len(some) - len(ok)}  # fmt: skip


def certainties(rows: Sequence[Row], refusal: RefusalConfig) -> Iterator[Row]:
    """Set the certainty of the answers beside the share of them that is right."""
    own = [row for row in rows if row["kind"] == ITSELF and row["status"] == "ok"]
    known = [(1 - (risk_of(row["signals"], refusal) or 0.0), row) for row in own]
    answers = [(p * row["share"], row["right"]) for p, row in known if 1 - p <= refusal.max_risk]
    for low, high in itertools.pairwise(_CERTAINTIES):
        some = [(p, right) for p, right in answers if low <= p < high]
        if some:
            said, right = (sum(column) / len(some) for column in zip(*some, strict=True))
            yield {"certainty from": low, "answers": len(some), "mean": said, "right": right}


def main() -> None:
    """Collect, calibrate, check."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", type=int, default=60, help="by which is calibrated")
    parser.add_argument("--check", type=int, default=20, help="by which is checked")
    parser.add_argument("--simple", type=int, default=40, help="parts of simple shapes")
    parser.add_argument("--rows", type=Path, help="rows.json of an earlier run")
    parser.add_argument("--out", type=Path, default=Path("out/calibrate_register"))
    words = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[Row] = json.loads(words.rows.read_text()) if words.rows else []
    known = {row["part"] for row in rows}
    words.out.mkdir(parents=True, exist_ok=True)
    random = words.parts + words.check
    last = random + words.simple
    for number in range(last):
        if number not in known:
            rows += rows_of(number, is_simple=number >= random)
            (words.out / "rows.json").write_text(json.dumps(rows))
            print(f"part {number + 1} of {last}", flush=True)
    refusal = calibrated([row for row in rows if row["part"] < words.parts])
    print(refusal)
    for name, settings, numbers in (
        ("calibrated here, random parts kept back", refusal, range(words.parts, random)),
        ("as shipped, random parts", REFUSAL, range(random)),
        ("as shipped, simple parts", REFUSAL, range(random, last)),
    ):
        some = [row for row in rows if row["part"] in numbers]
        print(f"\n{name}\n{markdown_table(list(counts(some, settings)))}")
        print(markdown_table(list(certainties(some, settings))))


if __name__ == "__main__":
    main()
