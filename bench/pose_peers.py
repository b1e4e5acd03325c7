"""Real instances of known pose: ours beside Open3D's FPFH + RANSAC + ICP, in one run.

    python bench/pose_peers.py $DEPTHPOSE_DATA/pose --seeds 5 [--weights W.safetensors ...]

``pip install -e '.[open3d]'`` first. Ours runs on the objects of the weights. Seconds
are wall time, one thread each (``OMP_NUM_THREADS=1``), without the preparation of models.
Success is ADD (ADD-S where the table has it) below 10 % of the diameter; other answers are
wrong, no answer is refused. A second table uses ADD alone, to the nearest of the
copies that the data set declares: right, right among the alternatives, refused, wrong, and
wrong with a certainty of 0.9 and more. ``--no-peer`` leaves Open3D out.
"""

import argparse
import os
import time
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from fpfh import VOXEL_DIAMETERS, FpfhEstimator
from real_poses import RealCase, real_cases

from depthpose.core.checkpoint import find_weights
from depthpose.core.rigid import Rigid
from depthpose.pose.config import EstimateConfig, VotingConfig
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.registration import Registration
from depthpose.pose.evaluate import nearest_copy
from depthpose.pose.mesh import symmetry_transforms
from depthpose.pose.metrics import add_m, adds_m, auc
from depthpose.pose.types import CloudInput, PoseEstimate, ViewInput
from depthpose.pose.weights import PoseWeights, read_pose_weights
from depthpose.report.page import markdown_table, write_table

POINTS = 2000
AnyInput = CloudInput | ViewInput
Row = dict[str, Any]
Method = Callable[[AnyInput], PoseEstimate]
_PREPARED: dict[str, Registration] = {}
"""By object: the model is prepared once, whatever the seed."""


def measure(case: RealCase, estimate: PoseEstimate) -> Row:
    """Errors of one estimate in diameters, and the verdict."""
    row: Row = {
        "metric": "ADD-S" if case.is_symmetric else "ADD",
        "add": None, "adds": None, "error_m": None,
        "success": False, "refused": not estimate.is_posed, "wrong": False,
        "add_declared": None, "named": False, "certainty": estimate.certainty,
    }  # fmt: skip
    if estimate.camera_from_model is None:
        return row
    step = max(1, len(case.model.vertices_m) // POINTS)
    points_m = case.model.vertices_m[::step]
    pair = (estimate.camera_from_model, case.sample.truth.camera_from_model, points_m)
    row["add"] = float(add_m(*pair)) / case.model.diameter_m
    row["adds"] = float(adds_m(*pair)) / case.model.diameter_m
    error = row["adds" if case.is_symmetric else "add"]
    row["success"], row["error_m"] = error < 0.1, error * case.model.diameter_m
    row["add_declared"] = declared_add(case, estimate.camera_from_model, points_m)
    others = [a.camera_from_model for a in estimate.alternatives]
    row["named"] = any(declared_add(case, pose, points_m) < 0.1 for pose in others)
    return row | {"wrong": not row["success"]}


def declared_add(case: RealCase, pose: Rigid, points_m: torch.Tensor) -> float:
    """ADD in diameters to the nearest copy of the truth that the data set declares."""
    truth = case.sample.truth.camera_from_model
    declared = case.model.symmetries
    truth = nearest_copy(pose, truth, symmetry_transforms(declared), declared)
    return float(add_m(pose, truth, points_m)) / case.model.diameter_m


def open3d_method(case: RealCase, seed: int, words: argparse.Namespace) -> Method:
    """Open3D's registration for one model."""
    peer = FpfhEstimator([case.model], words.voxel, seed)
    cloud = CloudInput(name=case.name, points_m=case.points_m, object=case.model.name)
    return lambda _: peer.estimate_many([cloud])[0]


def zero_shot_method(case: RealCase, seed: int) -> Method:
    """Our registration without training; the seed draws points of the cloud."""
    if case.model.name not in _PREPARED:
        _PREPARED[case.model.name] = Registration([case.model])
        _PREPARED[case.model.name].prepare()
    net = _PREPARED[case.model.name]
    net.config = EstimateConfig(voting=VotingConfig(seed=seed))
    return lambda given: net.estimate_many([given])[0]


def our_method(weights: Sequence[str], case: RealCase, seed: int, with_icp: bool) -> Method:
    """Trained weights with the object; the seed draws points and pairs of votes."""
    config = EstimateConfig(with_icp=with_icp, voting=VotingConfig(seed=seed))
    net = next(n for n in map(read_weights, weights) if case.sample.input.object in names_in(n))
    estimator = GeoPoseNet(net, config)
    estimator.estimate_many([case.sample.input])  # the model's surface is prepared once
    return lambda given: estimator.estimate_many([given])[0]


@cache
def read_weights(name: str) -> PoseWeights:
    """Read a file once."""
    return read_pose_weights(find_weights(name))


def names_in(weights: PoseWeights) -> set[str]:
    """List the objects of weights."""
    return {model.name for model in weights.models}


def run_method(
    name: str, cases: Sequence[RealCase], make: Callable[[RealCase, int], Method], seeds: int
) -> list[Row]:
    """Pose every case with every seed."""
    rows = []
    for case in cases:
        for seed in range(seeds):
            method = make(case, seed)
            began = time.perf_counter()
            estimate = method(case.sample.input)
            seconds = time.perf_counter() - began
            row = {"instance": case.name, "method": name, "seed": seed, **measure(case, estimate)}
            rows.append(row | {"seconds": seconds})
    return rows


def grouped(rows: list[Row]) -> dict[tuple[str, str], list[Row]]:
    """Rows of all seeds by instance and method, in the order in which they come."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["instance"], row["method"]), []).append(row)
    return groups


def summary(rows: list[Row]) -> list[Row]:
    """One row for each instance and method, over its seeds."""
    table = []
    for (instance, method), group in grouped(rows).items():
        shares = {
            name: sum(bool(r[name]) for r in group) for name in ("success", "refused", "wrong")
        }
        key = "adds" if group[0]["metric"] == "ADD-S" else "add"
        errors = sorted(float(r[key]) for r in group if r[key] is not None)
        lost = [torch.inf if r["error_m"] is None else r["error_m"] for r in group]
        seconds = sorted(float(r["seconds"]) for r in group)
        table.append({
            "instance": instance, "method": method, "metric": group[0]["metric"],
            "of": len(group), **shares,
            "AUC": round(auc(torch.tensor(lost)), 3),
            "median error [diameters]": round(errors[len(errors) // 2], 4) if errors else None,
            "median s": round(seconds[len(seconds) // 2], 3),
        })  # fmt: skip
    return table


def verdicts(rows: list[Row]) -> list[Row]:
    """One row for each instance and method: verdicts by ADD with declared symmetries alone."""
    table = []
    for (instance, method), group in grouped(rows).items():
        answered = [r for r in group if not r["refused"]]
        wrong = [r for r in answered if r["add_declared"] >= 0.1]
        sure = [r for r in wrong if (1.0 if r["certainty"] is None else r["certainty"]) >= 0.9]
        named = sum(bool(r["named"]) for r in wrong)
        certainties = sorted(r["certainty"] for r in answered if r["certainty"] is not None)
        table.append({
            "instance": instance, "method": method, "of": len(group),
            "right": len(answered) - len(wrong), "right among the named": named,
            "refused": len(group) - len(answered), "wrong": len(wrong) - named,
            "wrong and sure": len(sure),
            "median certainty": certainties[len(certainties) // 2] if certainties else None,
        })  # fmt: skip
    return table


def main() -> None:
    """Run the methods on the cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(os.environ.get("DEPTHPOSE_DATA", ".")) / "pose"
    parser.add_argument("samples", type=Path, nargs="?", default=default)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="", help="instances whose name contains this")
    parser.add_argument("--voxel", type=float, default=VOXEL_DIAMETERS)
    parser.add_argument("--weights", nargs="*", default=[], help="of ours")
    parser.add_argument("--no-peer", action="store_true", help="ours alone")
    parser.add_argument("--register", action="store_true", help="ours without training too")
    parser.add_argument("--out", type=Path, default=Path("out/pose_peers"))
    words = parser.parse_args()
    torch.set_num_threads(1)
    cases = [case for case in real_cases(words.samples) if words.only in case.name]
    rows = [] if words.no_peer else run_method(
        "Open3D FPFH + RANSAC + ICP", cases,
        lambda case, seed: open3d_method(case, seed, words), words.seeds,
    )  # fmt: skip
    objects = set[str]().union(*(names_in(read_weights(name)) for name in words.weights))
    known = [case for case in cases if case.sample.input.object in objects]
    for name, with_icp in (("Geo-PoseNet", False), ("Geo-PoseNet + ICP", True)):
        make = partial(our_method, words.weights, with_icp=with_icp)
        rows += run_method(name, known, make, words.seeds)
    if words.register:
        rows += run_method("ours, without training", cases, zero_shot_method, words.seeds)
    write_table(words.out, rows)
    print(markdown_table(summary(rows)))
    print(markdown_table(verdicts(rows)))


if __name__ == "__main__":
    main()
