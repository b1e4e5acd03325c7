"""Held-out synthetic views of known objects: success over occlusion, noise and resolution.

    python bench/synthetic_linemod.py --bop $DEPTHPOSE_DATA/pose/lm --objects 1 5 6 10 \
        --ours pose.safetensors --pointnet pointnet.safetensors \
        --depth-image depth-image.safetensors --open3d 100
    python bench/synthetic_linemod.py --bop $DEPTHPOSE_DATA/pose/lm --objects 1 5 6 10 \
        --parts bracket connector mug --number 25 --register 25 --open3d 25 --sweep 0 \
        --occlusions 0 0.35

Every view is rendered separately, by a seed that no training has. A method is given one view at
a time, on one thread; of several weights each is used for its own objects. Success is ADD
(ADD-S of symmetric objects) below 10 % of the diameter, ambiguous poses too; a refusal is no
success. "Nothing refused"
is every answer that votes can give, whatever its risk; for ours risks.png has the share of wrong
answers over the share that is answered. Writes rows.csv, rows.json, table.md, views.csv with each
view, and success.png with all curves. ``--also`` adds the results of other runs.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import torch
from curves import draw_curves
from fpfh import FpfhEstimator

from depthpose.core.checkpoint import find_weights
from depthpose.pose.config import EstimateConfig, ObjectsConfig, SensorKind, SyntheticSensorConfig
from depthpose.pose.datasets.layouts import read_bop_models, read_models_info
from depthpose.pose.mesh import sample_surface
from depthpose.pose.metrics import add_m, adds_m
from depthpose.pose.network_pose import DepthImageRegressor, GeoPoseNet
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic import PARTS, Objects, make_part
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput, ViewSample
from depthpose.pose.weights import read_pose_weights
from depthpose.report.page import markdown_table, write_table

SEED = 0x7E57ED
POINTS = 1000
OCCLUSIONS = (0.0, 0.2, 0.4, 0.6)
NOISES = (0.0, 1.0, 2.0, 4.0, 8.0)
RESOLUTIONS = (1.0, 0.5, 0.25, 0.125)
OPEN = "Geo-PoseNet + ICP, nothing refused"

Row = dict[str, Any]


class Condition(NamedTuple):
    """Conditions of the views of one point of a curve."""

    occlusion: float = 0.0
    noise: float = 1.0
    resolution: float = 1.0
    sensor: SensorKind = "structured light"


class Method(NamedTuple):
    """A method of pose estimation, and its number of views of each object."""

    name: str
    pose: Callable[[ViewInput], PoseEstimate]
    objects: frozenset[str]
    limit: int


def synthetic_views(models: Sequence[ObjectModel], at: Condition, number: int) -> Objects:
    """Render ``number`` views of each object under a condition."""
    config = ObjectsConfig(
        number=number * len(models), seed=SEED, views=None,
        resolution=(at.resolution, at.resolution),
        occluded_share=1.0 if at.occlusion else 0.0, occlusion=(at.occlusion, at.occlusion),
        sensor=SyntheticSensorConfig(kinds=(at.sensor,), noise=(at.noise, at.noise)),
    )  # fmt: skip
    return Objects(models, config)


def loaded(
    name: str, files: Sequence[str], number: int, kind: type[GeoPoseNet | DepthImageRegressor]
) -> Iterator[Method]:
    """Give a method of trained weights, with and without ICP."""
    for with_icp in (False, True):
        found = (read_pose_weights(find_weights(file)) for file in files)
        nets = [kind(weights, EstimateConfig(with_icp=with_icp)) for weights in found]
        yield from _of(f"{name} + ICP" if with_icp else name, nets, number)


def without_refusal(name: str, files: Sequence[str], number: int) -> Iterator[Method]:
    """Give every answer of a network whose points vote, however risky."""
    found = [read_pose_weights(find_weights(file)) for file in files]
    open_ = [
        dataclasses.replace(
            w,
            refusal=dataclasses.replace(w.refusal, min_probability=0.0),
        )
        for w in found
    ]
    yield from _of(name, [GeoPoseNet(weights) for weights in open_], number)


def _of(name: str, nets: Sequence[Any], number: int) -> Iterator[Method]:
    by_object = {which: net for net in nets for which in net.objects}
    if by_object:
        yield Method(
            name,
            lambda given: by_object[given.object].estimate_many([given])[0],
            frozenset(by_object),
            number,
        )


def zero_shot(models: Sequence[ObjectModel], number: int) -> Iterator[Method]:
    """Give our registration without training, where it is asked for; models are prepared once."""
    nets = [Registration([model]) for model in models] if number else []
    for net in nets:
        began = time.process_time()
        net.prepare()
        print(f"{net.objects[0]}: prepared in {time.process_time() - began:.1f} s of one core")
    yield from _of("ours, without training", nets, number)


def registration(models: Sequence[ObjectModel], number: int) -> Iterator[Method]:
    """Give Open3D's registration, where it is asked for."""
    if not number:
        return
    peers = FpfhEstimator(models)
    yield Method(
        "Open3D FPFH + RANSAC + ICP",
        lambda given: peers.estimate_many([given])[0],
        frozenset(model.name for model in models),
        number,
    )


def metric_of(model: ObjectModel) -> Callable[..., torch.Tensor]:
    """ADD, of a symmetric object ADD-S."""
    return add_m if model.symmetries.is_none else adds_m


def measure(method: Method, view: ViewSample, model: ObjectModel, points_m: torch.Tensor) -> Row:
    """Pose one view."""
    began = time.perf_counter()
    estimate = method.pose(view.input)
    seconds = time.perf_counter() - began
    error = None  # where there is no answer
    if estimate.camera_from_model is not None:
        truth = view.truth.camera_from_model
        error = float(metric_of(model)(estimate.camera_from_model, truth, points_m))
        error /= model.diameter_m
    risk = None if estimate.certainty is None else 1 - estimate.certainty
    row = {"method": method.name, "object": model.name, "error": error, "risk": risk}
    is_named = any(
        float(metric_of(model)(a.camera_from_model, view.truth.camera_from_model, points_m))
        < 0.1 * model.diameter_m
        for a in estimate.alternatives
    )
    status = {"refused": not estimate.is_posed, "ok": estimate.is_ok, "named": is_named}
    return row | status | {"s": seconds}


def run_condition(
    methods: Sequence[Method], models: Sequence[ObjectModel], at: Condition, number: int
) -> tuple[list[Row], list[Row]]:
    """Give a row for each method and object and one for all objects together, and all views."""
    objects = synthetic_views(models, at, number)
    surfaces = [sample_surface(model, POINTS)[0] for model in models]
    found: list[Row] = []
    for index in range(len(objects)):
        view, which = objects.view(index), index % len(models)
        for method in methods:
            if index // len(models) < method.limit and models[which].name in method.objects:
                row = measure(method, view, models[which], surfaces[which])
                found.append({**at._asdict(), **row})
    summed = []
    for method in methods:
        for name in (*(model.name for model in models), "all"):
            own = [r for r in found if r["method"] == method.name and name in (r["object"], "all")]
            if own:
                head = {**at._asdict(), "method": method.name, "object": name}
                summed.append(head | shares(own))
    return summed, found


def finite(rows: Sequence[Row], name: str) -> torch.Tensor:
    """Give a column, infinite where there is no answer."""
    return torch.tensor([torch.inf if row[name] is None else row[name] for row in rows])


def shares(rows: Sequence[Row]) -> Row:
    """Count successes, refusals and wrong answers, and take medians."""
    errors = finite(rows, "error")
    refused = sum(row["refused"] for row in rows)
    right, middle = int((errors < 0.1).sum()), float(errors.median())
    wrong = [r for r in rows if not r["refused"] and (r["error"] or 0.0) >= 0.1]
    named = sum(r.get("named", False) for r in wrong)
    return {
        "views": len(rows),
        "success": right / len(rows),
        "refused": refused / len(rows),
        "right among the named": named / len(rows),
        "wrong": (len(wrong) - named) / len(rows),
        "ok and wrong": sum(r.get("ok", True) for r in wrong) / len(rows),
        # Where more than half is refused, the median is infinite.
        "median error [diameters]": round(middle, 4) if middle < torch.inf else None,
        "median ms": round(1000 * float(torch.tensor([row["s"] for row in rows]).median()), 1),
    }


def conditions(words: argparse.Namespace) -> Iterator[tuple[Condition, int]]:
    """List the conditions, each once."""
    for occlusion in words.occlusions:
        yield Condition(occlusion=occlusion), words.number
    yield from ((Condition(sensor=kind), words.number) for kind in words.sensors)
    if words.sweep:
        yield from ((Condition(noise=n), words.sweep) for n in NOISES if n != 1)
        yield from ((Condition(resolution=r), words.sweep) for r in RESOLUTIONS if r != 1)


def earlier(folders: Sequence[Path], name: str) -> Iterator[Row]:
    """Give the rows that earlier runs wrote."""
    for folder in folders:
        yield from json.loads((folder / f"{name}.json").read_text())


def draw(rows: Sequence[Row], out: Path) -> None:
    """Plot success of all objects over each condition, the others at their usual value."""
    usual = Condition()._asdict()
    plots: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for setting, what in (("occlusion", "share of the silhouette that is hidden"),
                       ("noise", "times the sensor's usual noise"),
                       ("resolution", "times 640 x 480")):  # fmt: skip
        curves: dict[str, list[tuple[float, float]]] = {}
        for row in rows:
            others_usual = all(row.get(k, v) == v for k, v in usual.items() if k != setting)
            if row["object"] == "all" and others_usual:
                curves.setdefault(row["method"], []).append((row[setting], row["success"]))
        if any(len(points) > 1 for points in curves.values()):
            plots[what] = curves
    if plots:
        draw_curves(out / "success.png", plots, "share with ADD(-S) < 10 %")


def draw_risks(views: Sequence[Row], out: Path) -> None:
    """Plot the share of wrong answers over the share that is answered, for each occlusion."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for occlusion in OCCLUSIONS:
        at = Condition(occlusion=occlusion)._asdict()
        own = [
            v for v in views if v["method"] == OPEN and all(v.get(k, at[k]) == at[k] for k in at)
        ]
        if own:
            risk, order = finite(own, "risk").sort(stable=True)
            wrong = (finite(own, "error")[order] >= 0.1).double().cumsum(0)
            answered = torch.arange(1, len(own) + 1).double()
            # Views of one risk are refused together: the last of them counts for all.
            kept = risk.isfinite() & torch.cat([risk.diff() > 0, torch.ones(1).bool()])
            both = (answered / len(own))[kept], (wrong / answered)[kept]
            points = list(zip(*(share.tolist() for share in both), strict=True))
            curves[f"{occlusion:.0%} hidden"] = points[:: max(1, len(points) // 40)]
    if curves:
        draw_curves(out / "risks.png", {"share of views answered": curves}, "wrong among answers")


def main() -> None:
    """Run every method under every condition."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bop", type=Path, required=True, help="data set of the models")
    parser.add_argument("--objects", type=int, nargs="*", help="their numbers; all by default")
    parser.add_argument("--ours", nargs="*", default=[])
    parser.add_argument("--pointnet", nargs="*", default=[])
    parser.add_argument("--depth-image", nargs="*", default=[])
    parser.add_argument("--parts", nargs="*", default=[], choices=PARTS, help="models too")
    parser.add_argument("--register", type=int, default=0, help="views of each object; 0: not run")
    parser.add_argument("--occlusions", type=float, nargs="*", default=OCCLUSIONS)
    parser.add_argument(
        "--sensors", nargs="*", default=[], choices=get_args(SensorKind), help="others, unoccluded"
    )
    parser.add_argument("--open3d", type=int, default=0, help="views of each object; 0: not run")
    parser.add_argument("--number", type=int, default=250, help="views of each object")
    parser.add_argument("--sweep", type=int, default=50, help="views at each noise and resolution")
    parser.add_argument(
        "--also",
        type=Path,
        nargs="*",
        default=[],
        help="folders of earlier runs, of other methods on the same views",
    )
    parser.add_argument("--out", type=Path, default=Path("out/synthetic_linemod"))
    words = parser.parse_args()
    torch.set_num_threads(1)
    numbers = words.objects or sorted(read_models_info(words.bop)[1])
    models = list(read_bop_models(words.bop, numbers).values())
    models += [make_part(name, 100 + k) for k, name in enumerate(words.parts)]
    methods = [
        *loaded("Geo-PoseNet", words.ours, words.number, GeoPoseNet),
        *without_refusal(OPEN, words.ours, words.number),
        *loaded("PointNet", words.pointnet, words.number, GeoPoseNet),
        *without_refusal("PointNet + ICP, nothing refused", words.pointnet, words.number),
        *loaded("depth image", words.depth_image, words.number, DepthImageRegressor),
        *zero_shot(models, words.register),
        *registration(models, words.open3d),
    ]
    rows, views = ([*earlier(words.also, name)] for name in ("rows", "views"))
    for at, number in conditions(words):
        summed, every = run_condition(methods, models, at, number)
        rows, views = rows + summed, views + every
        print(markdown_table([row for row in rows if row["object"] == "all"][-len(methods) :]),
              flush=True)  # fmt: skip
        write_table(words.out, rows)
        write_table(words.out, views, name="views")
        draw(rows, words.out)
        draw_risks(views, words.out)


if __name__ == "__main__":
    main()
