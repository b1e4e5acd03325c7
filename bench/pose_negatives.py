"""Views that do not show the requested object: how often the answer is ok, ambiguous, confirmed.

    python bench/pose_negatives.py --weights parts ycb linemod.safetensors --number 40

Eight kinds of negatives, ``--number`` of each: another object of the weights (or one of our parts,
if they have only one), copies scaled by 0.8, 0.9, 1.1 and 1.25 (``--number`` each), mirror images,
blobs, plates, boxes and cylinders, balls, and hands of capsules. A mirror image that deviates from
the object by at most 3 % of the diameter is no negative and counted apart ("mirror image alike").
For comparison also the objects themselves, four times as many: right is an ADD (to the nearest
symmetric pose) below 10 % of the diameter.

Views are rendered like held-out ones, half of them with up to a half occluded; ``--seed`` draws
others. Each is a depth image with a mask; with ``--clouds`` only the points in the mask are given.
``--method register`` registers the objects without a network, ``both`` only where the network
refuses. ``--save`` writes status and evidence as JSON; then nothing is refused for its fit.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast, get_args

import torch
from negatives import SCALES, NegativeKind, negative_of
from shared import make_parser, with_cpu_seconds

from depthpose.core.checkpoint import find_weights
from depthpose.core.loop import make_sample_generator
from depthpose.pose.config import EstimateConfig, ObjectsConfig, RefusalConfig
from depthpose.pose.estimator import PoseEstimator
from depthpose.pose.mesh import MIRROR_ALIKE, mirror_deviation
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic import SyntheticViews
from depthpose.pose.train.held_out import measure_add
from depthpose.pose.types import CloudSample, ObjectModel, ViewSample
from depthpose.report.page import format_markdown_table

SEED = 0x0DD
BATCH_SIZE = 32
RIGHT = 0.1  # largest error of a right answer, in diameters
ITSELF = "itself"
ALIKE = "mirror image alike"
Row = dict[str, Any]


def render_views(
    models: Sequence[ObjectModel], seed: int, with_scene: bool
) -> Iterator[CloudSample | ViewSample]:
    """Render each of some models once: a depth image and a mask, or the cloud of the mask alone."""
    config = ObjectsConfig(
        number=len(models), seed=seed, views=None, resolution=(1.0, 1.0), occluded_share=0.5,
        occlusion=(0.0, 0.5),
    )  # fmt: skip
    objects = SyntheticViews(models, config)
    return (objects.view(k) if with_scene else objects[k] for k in range(len(models)))


def models_in_view(
    requested: Sequence[ObjectModel], kind: str, objects: Sequence[ObjectModel], seed: int
) -> list[ObjectModel]:
    """Make the model that is in view for each requested object: itself or a negative of it."""
    if kind == ITSELF:
        return list(requested)
    generator = make_sample_generator(sum(map(ord, kind)), seed)
    name, _, factor = kind.partition(" by ")
    scale = float(factor) if factor else None
    negative_kind = cast(NegativeKind, name)
    return [negative_of(model, negative_kind, objects, generator, scale) for model in requested]


def negative_kinds() -> Iterator[str]:
    """List the kinds of negatives, each scale by itself."""
    for kind in get_args(NegativeKind):
        if kind == "scaled":
            yield from (f"scaled by {scale}" for scale in SCALES)
        else:
            yield kind


def measure(
    net: PoseEstimator, kind: str, number: int, seed: int, with_scene: bool = True
) -> list[Row]:
    """Estimate every negative of a kind, or the objects themselves."""
    requested = [net.models[k % len(net.models)] for k in range(number)]
    models = models_in_view(requested, kind, net.models, seed)
    samples = list(render_views(models, seed, with_scene))
    inputs = [sample.input for sample in samples]
    estimates = []
    for start in range(0, len(inputs), BATCH_SIZE):
        estimates += net.estimate_many(inputs[start : start + BATCH_SIZE])
    rows = []
    for sample, model, estimate in zip(samples, requested, estimates, strict=True):
        error = measure_add(estimate.camera_from_model, sample.truth.camera_from_model, model)
        is_alike = kind == "mirrored" and mirror_deviation(model) <= MIRROR_ALIKE
        rows.append(
            {
                "kind": ALIKE if is_alike else kind,
                "object": sample.input.object,
                "status": estimate.status,
                "right": kind == ITSELF and error < RIGHT,
                "evidence": estimate.evidence and vars(estimate.evidence),
                "identity": estimate.identity and estimate.identity.status,
                "hidden": 1 - (sample.truth.visible_fraction or 0.0),
            }
        )
    return rows


def without_alike(rows: Sequence[Row]) -> list[list[Row]]:
    """Separate mirror images that are nearly the object: they are no negatives."""
    alike = [row for row in rows if row["kind"] == ALIKE]
    others = [row for row in rows if row["kind"] != ALIKE]
    return [group for group in (alike, others) if group]


def summary(rows: Sequence[Row]) -> Row:
    """Count answers."""
    count = len(rows)
    ok = [row for row in rows if row["status"] == "ok"]
    ambiguous = [row for row in rows if row["status"] == "ambiguous"]
    confirmed = sum(row["identity"] == "confirmed" for row in ok + ambiguous)
    line: Row = {
        "kind": rows[0]["kind"],
        "number": count,
        "ok": len(ok) / count,
        "ambiguous": len(ambiguous) / count,
        "confirmed": confirmed / count,
    }
    if rows[0]["kind"] == ITSELF:
        line["right"] = sum(row["right"] for row in rows) / count
        line["ok and wrong"] = sum(not row["right"] for row in ok) / count
    return line


def main() -> None:
    """Measure every set of weights."""
    parser = make_parser(__doc__)
    parser.add_argument("--weights", nargs="+", default=["parts"])
    parser.add_argument("--number", type=int, default=40)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--clouds", action="store_true", help="clouds in place of depth images")
    parser.add_argument("--method", choices=("network", "register", "both"), default="network")
    parser.add_argument("--kinds", nargs="*", help="some of the kinds alone")
    parser.add_argument("--save", type=Path, help="a folder for the signals of each set")
    options = parser.parse_args()
    if options.save and options.method == "both":
        parser.error("--save refuses nothing, so nothing is left to register; save each alone")
    torch.set_num_threads(1)
    kinds = options.kinds or [ITSELF, *negative_kinds()]
    for name in options.weights:
        config = EstimateConfig(
            refusal=RefusalConfig(min_probability=0.0) if options.save else None,
            register_refused=options.method == "both",
        )
        net = GeoPoseNet.load(find_weights(name), config)
        if options.method == "register":
            net = Registration(net.models, config)

        groups: list[list[Row]] = []
        total_s = 0.0
        for kind in kinds:
            number = 4 * options.number if kind == ITSELF else options.number
            rows, cpu_s = with_cpu_seconds(
                lambda net=net, kind=kind, number=number: measure(
                    net, kind, number, options.seed, not options.clouds
                )
            )
            kind_groups = without_alike(rows)
            print(*map(summary, kind_groups), sep="\n", flush=True)
            groups += kind_groups
            total_s += cpu_s
        table = [summary(group) for group in groups]
        all_rows = [row for group in groups for row in group]
        negatives = [row for row in all_rows if row["kind"] not in (ITSELF, ALIKE)]
        if negatives:
            table.append({**summary(negatives), "kind": "all negatives"})
        print(f"{name}, {total_s:.0f} s\n{format_markdown_table(table)}")
        if options.save:
            options.save.mkdir(parents=True, exist_ok=True)
            path = options.save / f"{Path(name).stem}.json"
            path.write_text(json.dumps(all_rows))


if __name__ == "__main__":
    main()
