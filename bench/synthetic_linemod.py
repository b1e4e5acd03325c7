"""Held-out synthetic views of known objects: success over occlusion, noise and resolution.

    python bench/synthetic_linemod.py --bop $DEPTHPOSE_DATA/pose/lm --objects 1 5 6 10 \
        --ours pose.safetensors --pointnet pointnet.safetensors \
        --depth-image depth-image.safetensors --open3d 100
    python bench/synthetic_linemod.py --bop $DEPTHPOSE_DATA/pose/lm --objects 1 5 6 10 \
        --parts bracket connector mug --number 25 --register 25 --open3d 25 --sweep 0 \
        --occlusions 0 0.35

Every view is rendered separately, by a seed that no training has. A method poses one view at a
time, on one thread; of several weights each is used for its own objects. Success is ADD (ADD-S of
symmetric objects) below 10 % of the diameter, of ambiguous poses too; a refusal is no success.
"Nothing refused" counts every answer that votes can give, whatever its risk. Writes rows.csv,
rows.json, table.md, views.csv with each view, success.png with all curves, and risks.png with the
share of wrong answers over the share of answered views (ours). ``--also`` adds the results of other
runs.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import torch
from curves import draw_curves
from fpfh import FpfhEstimator
from shared import make_parser, with_cpu_seconds

from depthpose.core.checkpoint import find_weights
from depthpose.core.rigid import Rigid
from depthpose.pose.config import (
    EstimateConfig,
    ObjectsConfig,
    RefusalConfig,
    SensorKind,
    SyntheticSensorConfig,
)
from depthpose.pose.datasets.layouts import read_bop_models, read_models_info
from depthpose.pose.mesh import sample_surface
from depthpose.pose.metrics import add_m, adds_m
from depthpose.pose.network_pose import DepthImageRegressor, GeoPoseNet
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic import PARTS, SyntheticViews, make_part
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput, ViewSample
from depthpose.pose.weights import read_pose_weights
from depthpose.report.page import format_markdown_table, write_table

SEED = 0x7E57ED
POINTS = 1000  # of the surface, by which errors are measured
RIGHT = 0.1  # largest error of a success, in diameters
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


def synthetic_views(
    models: Sequence[ObjectModel], condition: Condition, number: int
) -> SyntheticViews:
    """Render ``number`` views of each object under a condition."""
    config = ObjectsConfig(
        number=number * len(models), seed=SEED, views=None,
        resolution=(condition.resolution, condition.resolution),
        occluded_share=1.0 if condition.occlusion else 0.0,
        occlusion=(condition.occlusion, condition.occlusion),
        sensor=SyntheticSensorConfig(
            kinds=(condition.sensor,), noise=(condition.noise, condition.noise)
        ),
    )  # fmt: skip
    return SyntheticViews(models, config)


def trained_methods(
    name: str, files: Sequence[str], number: int, kind: type[GeoPoseNet | DepthImageRegressor]
) -> Iterator[Method]:
    """Yield a method of trained weights, without and with ICP."""
    for with_icp in (False, True):
        config = EstimateConfig(with_icp=with_icp)
        nets = [kind(read_pose_weights(find_weights(file)), config) for file in files]
        yield from method_of_nets(f"{name} + ICP" if with_icp else name, nets, number)


def without_refusal(name: str, files: Sequence[str], number: int) -> Iterator[Method]:
    """Yield a method of trained weights that answers every view whose points vote."""
    config = EstimateConfig(refusal=RefusalConfig(min_probability=0.0))
    nets = [GeoPoseNet(read_pose_weights(find_weights(file)), config) for file in files]
    yield from method_of_nets(name, nets, number)


def method_of_nets(name: str, nets: Sequence[Any], number: int) -> Iterator[Method]:
    """Yield the method that poses each object by the estimator that knows it; none of no object."""
    net_of_object = {object_name: net for net in nets for object_name in net.objects}
    if net_of_object:
        yield Method(
            name,
            lambda view: net_of_object[view.object].estimate_many([view])[0],
            frozenset(net_of_object),
            number,
        )


def our_registration(models: Sequence[ObjectModel], number: int) -> Iterator[Method]:
    """Yield our registration unless ``number`` is 0; models are prepared once."""
    nets = [Registration([model]) for model in models] if number else []
    for net in nets:
        _, cpu_s = with_cpu_seconds(net.prepare)
        print(f"{net.objects[0]}: prepared in {cpu_s:.1f} s of one core")
    yield from method_of_nets("ours, without training", nets, number)


def open3d_registration(models: Sequence[ObjectModel], number: int) -> Iterator[Method]:
    """Yield Open3D's registration unless ``number`` is 0."""
    if not number:
        return
    estimator = FpfhEstimator(models)
    yield Method(
        "Open3D FPFH + RANSAC + ICP",
        lambda view: estimator.estimate_many([view])[0],
        frozenset(model.name for model in models),
        number,
    )


def error_of(pose: Rigid, view: ViewSample, model: ObjectModel, points_m: torch.Tensor) -> float:
    """Compute ADD, of a symmetric object ADD-S, in diameters."""
    metric = add_m if model.symmetries.is_none else adds_m
    return float(metric(pose, view.truth.camera_from_model, points_m)) / model.diameter_m


def measure(method: Method, view: ViewSample, model: ObjectModel, points_m: torch.Tensor) -> Row:
    """Pose one view."""
    start_s = time.perf_counter()
    estimate = method.pose(view.input)
    wall_s = time.perf_counter() - start_s
    pose = estimate.camera_from_model
    errors_of_alternatives = [
        error_of(alternative.camera_from_model, view, model, points_m)
        for alternative in estimate.alternatives
    ]
    return {
        "method": method.name,
        "object": model.name,
        "error": None if pose is None else error_of(pose, view, model, points_m),
        "risk": None if estimate.certainty is None else 1 - estimate.certainty,
        "refused": not estimate.is_posed,
        "ok": estimate.is_ok,
        "named": any(error < RIGHT for error in errors_of_alternatives),
        "s": wall_s,
    }


def run_condition(
    methods: Sequence[Method], models: Sequence[ObjectModel], condition: Condition, number: int
) -> tuple[list[Row], list[Row]]:
    """Pose all views of a condition.

    Returns a row for each method and object and one for all objects together, and a row for each
    view.
    """
    objects = synthetic_views(models, condition, number)
    surfaces_m = [sample_surface(model, POINTS)[0] for model in models]
    views: list[Row] = []
    for index in range(len(objects)):
        view = objects.view(index)
        view_of_object, model_index = divmod(index, len(models))
        model = models[model_index]
        for method in methods:
            if view_of_object < method.limit and model.name in method.objects:
                row = measure(method, view, model, surfaces_m[model_index])
                views.append({**condition._asdict(), **row})
    rows = []
    for method in methods:
        method_views = [view for view in views if view["method"] == method.name]
        for name in (*(model.name for model in models), "all"):
            chosen = [view for view in method_views if name in (view["object"], "all")]
            if chosen:
                facts = {**condition._asdict(), "method": method.name, "object": name}
                rows.append(facts | shares(chosen))
    return rows, views


def column_of(rows: Sequence[Row], name: str) -> torch.Tensor:
    """Return a column as a tensor, infinite where there is no answer."""
    return torch.tensor([torch.inf if row[name] is None else row[name] for row in rows])


def shares(views: Sequence[Row]) -> Row:
    """Compute shares of successes, refusals and wrong answers, and medians."""
    count = len(views)
    errors = column_of(views, "error")
    median_error = float(errors.median())
    median_s = float(torch.tensor([view["s"] for view in views]).median())
    wrong = [view for view in views if not view["refused"] and (view["error"] or 0.0) >= RIGHT]
    named = sum(view.get("named", False) for view in wrong)
    return {
        "views": count,
        "success": int((errors < RIGHT).sum()) / count,
        "refused": sum(view["refused"] for view in views) / count,
        "right among the named": named / count,
        "wrong": (len(wrong) - named) / count,
        "ok and wrong": sum(view.get("ok", True) for view in wrong) / count,
        # Where more than half is refused, the median is infinite.
        "median error [diameters]": round(median_error, 4) if median_error < torch.inf else None,
        "median ms": round(1000 * median_s, 1),
    }


def conditions(options: argparse.Namespace) -> Iterator[tuple[Condition, int]]:
    """List the conditions, each once, with the number of views of each object."""
    for occlusion in options.occlusions:
        yield Condition(occlusion=occlusion), options.number
    for kind in options.sensors:
        yield Condition(sensor=kind), options.number
    if not options.sweep:
        return
    for noise in NOISES:
        if noise != 1:
            yield Condition(noise=noise), options.sweep
    for resolution in RESOLUTIONS:
        if resolution != 1:
            yield Condition(resolution=resolution), options.sweep


def read_earlier(folders: Sequence[Path], name: str) -> Iterator[Row]:
    """Read the rows that earlier runs wrote."""
    for folder in folders:
        yield from json.loads((folder / f"{name}.json").read_text())


def agrees(row: Row, settings: Row) -> bool:
    """Whether a row has these settings; earlier runs do not have all of them."""
    return all(row.get(name, value) == value for name, value in settings.items())


def draw_success(rows: Sequence[Row], out: Path) -> None:
    """Plot success of all objects over each condition, the others at their usual value."""
    usual = Condition()._asdict()
    plots: dict[str, dict[str, list[tuple[float, float]]]] = {}
    x_names = {
        "occlusion": "share of the silhouette that is hidden",
        "noise": "times the sensor's usual noise",
        "resolution": "times 640 x 480",
    }
    for setting, x_name in x_names.items():
        other_settings = {name: value for name, value in usual.items() if name != setting}
        curves: dict[str, list[tuple[float, float]]] = {}
        for row in rows:
            if row["object"] == "all" and agrees(row, other_settings):
                curves.setdefault(row["method"], []).append((row[setting], row["success"]))
        if any(len(points) > 1 for points in curves.values()):
            plots[x_name] = curves
    if plots:
        draw_curves(out / "success.png", plots, "share with ADD(-S) < 10 %")


def draw_risks(views: Sequence[Row], out: Path) -> None:
    """Plot the share of wrong answers over the share that is answered, for each occlusion."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for occlusion in OCCLUSIONS:
        settings = Condition(occlusion=occlusion)._asdict()
        chosen = [view for view in views if view["method"] == OPEN and agrees(view, settings)]
        if not chosen:
            continue
        risk, order = column_of(chosen, "risk").sort(stable=True)
        wrong = (column_of(chosen, "error")[order] >= RIGHT).double().cumsum(0)
        answered = torch.arange(1, len(chosen) + 1).double()
        # Views of one risk are refused together: the last of them counts for all.
        is_last = torch.cat([risk.diff() > 0, torch.ones(1).bool()])
        is_drawn = risk.isfinite() & is_last
        answered_share = (answered / len(chosen))[is_drawn].tolist()
        wrong_share = (wrong / answered)[is_drawn].tolist()
        points = list(zip(answered_share, wrong_share, strict=True))
        curves[f"{occlusion:.0%} hidden"] = points[:: max(1, len(points) // 40)]
    if curves:
        draw_curves(out / "risks.png", {"share of views answered": curves}, "wrong among answers")


def main() -> None:
    """Run every method under every condition."""
    parser = make_parser(__doc__)
    parser.add_argument("--bop", type=Path, required=True, help="dataset of the models")
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
    options = parser.parse_args()
    torch.set_num_threads(1)
    numbers = options.objects or sorted(read_models_info(options.bop)[1])
    models = list(read_bop_models(options.bop, numbers).values())
    models += [make_part(name, 100 + k) for k, name in enumerate(options.parts)]
    methods = [
        *trained_methods("Geo-PoseNet", options.ours, options.number, GeoPoseNet),
        *without_refusal(OPEN, options.ours, options.number),
        *trained_methods("PointNet", options.pointnet, options.number, GeoPoseNet),
        *without_refusal("PointNet + ICP, nothing refused", options.pointnet, options.number),
        *trained_methods("depth image", options.depth_image, options.number, DepthImageRegressor),
        *our_registration(models, options.register),
        *open3d_registration(models, options.open3d),
    ]
    rows = list(read_earlier(options.also, "rows"))
    views = list(read_earlier(options.also, "views"))
    for condition, number in conditions(options):
        new_rows, new_views = run_condition(methods, models, condition, number)
        rows += new_rows
        views += new_views
        rows_of_all = [row for row in rows if row["object"] == "all"]
        print(format_markdown_table(rows_of_all[-len(methods) :]), flush=True)
        write_table(options.out, rows)
        write_table(options.out, views, name="views")
        draw_success(rows, options.out)
        draw_risks(views, options.out)


if __name__ == "__main__":
    main()
