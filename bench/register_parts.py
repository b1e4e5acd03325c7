"""Registration of random parts without training, and of what is not the part.

    python bench/register_parts.py --parts 20 --simple 10

Each part is seen in eight depth images with up to 60 % hidden, and in its place one negative of
each of eight kinds: another part, a scaled copy, a mirrored one where that differs, a blob, a
plate, a box or cylinder, a ball and a hand. Counts answers that are ok and right, ok and wrong,
ambiguous with the right pose among them, and refused; then, of random parts and of simple ones
(boxes, tubes, cups, L, T and U profiles, whose symmetries are found and taken, as
``Registration.load`` does), the certainty beside the share that is right.
"""

import argparse
import dataclasses
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

import torch
from negatives import NegativeKind, negative_kinds, negative_of, random_part, random_simple_part

from depthpose.core.loop import sample_generator
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.estimator import Registration
from depthpose.pose.mesh import with_found_symmetries
from depthpose.pose.synthetic import Objects
from depthpose.pose.train.clouds import add_error
from depthpose.pose.types import ObjectModel
from depthpose.report.page import markdown_table

SEED = 0x9A27
VIEWS = 8
ITSELF = "itself"
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
    registration = Registration([part])
    config = ObjectsConfig(
        number=len(shown), seed=SEED + number, views=None, resolution=(1.0, 1.0),
        occluded_share=0.8, occlusion=(0.0, 0.6),
    )  # fmt: skip
    views = Objects([model for _, model in shown], config)
    for k, (kind, _) in enumerate(shown):
        sample = views.view(k)
        found = registration.estimate_many([sample.input])[0]
        poses = [found.camera_from_model, *(a.camera_from_model for a in found.alternatives)]
        truth = sample.truth.camera_from_model
        is_right = [kind == ITSELF and add_error(pose, truth, part) < 0.1 for pose in poses]
        share = 1.0 if found.certainty is None else found.certainty
        yield {
            "part": number, "kind": kind, "status": found.status,
            "fit": found.fit and vars(found.fit),
            "identity": found.identity and found.identity.status, "share": share,
            "right": is_right[0], "named": any(is_right),
        }  # fmt: skip


def counts(rows: Sequence[Row]) -> Iterator[Row]:
    """Count right, ambiguous, refused and wrong answers of each kind."""
    for kind in (ITSELF, *get_args(NegativeKind)):
        some = [row for row in rows if row["kind"] == kind]
        ok = [row for row in some if row["status"] == "ok"]
        unsure = [row for row in some if row["status"] == "ambiguous"]
        posed = len(ok) + len(unsure)
        yield {
            "seen": kind, "views": len(some), "ok and right": sum(row["right"] for row in ok),
            "ok and wrong": sum(not row["right"] for row in ok), "ambiguous": len(unsure),
            "of these right or named": sum(row["named"] for row in unsure),
            "refused": len(some) - posed,
            "confirmed": sum(row["identity"] == "confirmed" for row in (*ok, *unsure)),
        }  # fmt: skip


def certainties(rows: Sequence[Row]) -> Iterator[Row]:
    """Set the certainty of the poses beside the share of them that is right."""
    own = [row for row in rows if row["kind"] == ITSELF and row["status"] in ("ok", "ambiguous")]
    answers = [(row["share"], row["right"]) for row in own]
    for low, high in itertools.pairwise(_CERTAINTIES):
        some = [(p, right) for p, right in answers if low <= p < high]
        if some:
            said, right = (sum(column) / len(some) for column in zip(*some, strict=True))
            yield {"certainty from": low, "answers": len(some), "mean": said, "right": right}


def main() -> None:
    """Register and count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", type=int, default=20)
    parser.add_argument("--simple", type=int, default=10, help="parts of simple shapes")
    parser.add_argument("--out", type=Path, default=Path("out/register_parts"))
    words = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[Row] = []
    words.out.mkdir(parents=True, exist_ok=True)
    last = words.parts + words.simple
    for number in range(last):
        rows += rows_of(number, is_simple=number >= words.parts)
        (words.out / "rows.json").write_text(json.dumps(rows))
        print(f"part {number + 1} of {last}", flush=True)
    for name, numbers in (("random", range(words.parts)), ("simple", range(words.parts, last))):
        some = [row for row in rows if row["part"] in numbers]
        if some:
            print(f"\n{name} parts\n{markdown_table(list(counts(some)))}")
            print(markdown_table(list(certainties(some))))


if __name__ == "__main__":
    main()
