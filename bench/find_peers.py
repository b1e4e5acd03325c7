"""Search by depth alone, in BOP's language: ours, OpenCV's point pairs, and Open3D, in one run.

    python bench/find_peers.py run out/peers --piles 100 --tables 20 --clutter 20 --jobs 8
    python bench/find_peers.py table out/peers

``run`` writes a row as soon as a method is through with a scene, and leaves out
what has one, so it may be stopped and started again; ``--peers`` gives the first so many scenes of
a kind to the peers too. ``table`` sums up the rows. The peers need an environment of their own,
since OpenCV's contributed modules replace those of ``opencv-python-headless``:

    python -m venv out/peers-env && out/peers-env/bin/pip install -e '.[fast,open3d]'
    out/peers-env/bin/pip install opencv-contrib-python-headless

A pile is of 20 of one part, in turn of each of ``--parts``; a table has two to all of them, and up
to 4 other things (clutter: 8 to 16). As at BOP, every method is told which objects an image shows.
How many of each there are the peers are told too: they judge nothing and would answer without end.
They get the points and normals of our own frame, without the planes that are too wide to be a side
of the object. OpenCV: the best voted poses after its ICP, none within 0.3 diameters of a better
one. Open3D: FPFH, RANSAC and ICP for each region that no jump in depth parts, the best fitness
first. A model is prepared before; seconds are of the image alone,
wall time of ``--threads`` threads, one by default.

``recall`` is the share of right instances of those of which enough is visible (piles 70 %, else
50 %), right and wrong as ``bench/find_tables.py`` has them. AR is BOP's, over what is visible to
10 % at least: of VSD, MSSD and MSPD, each the mean over its thresholds.
"""

import argparse
import json
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from find_tables import Frame, measure, registration, synthetic_frames
from fpfh import FpfhEstimator

from depthpose.core.camera import Camera
from depthpose.core.files import write_depth_png
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import thin
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import Instance
from depthpose.pose.evaluate import error_context, match_instances
from depthpose.pose.evaluate.errors import METRICS
from depthpose.pose.frame import label_regions, prepare_frame
from depthpose.pose.mesh import sample_surface
from depthpose.pose.metrics import BOP_PIXELS, BOP_SHARES, average_recall
from depthpose.pose.predictions import Place, Prediction
from depthpose.pose.surface import Surface, prepare_surface
from depthpose.pose.synthetic.parts import PARTS, make_part
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate
from depthpose.report.page import markdown_table

KINDS = {"piles": (20, (0, 4)), "tables": (0, (0, 4)), "clutter": (0, (8, 16))}
"""By kind how many copies lie on a pile, and how many other things on a table."""
LEAST_VISIBLE = 0.1
"""BOP's targets are of what is visible to so large a share."""
DEPTH_UNIT_M = 1e-4
APART = 0.3
"""Answers of a peer are so many diameters apart at least."""
LEAST_PIXELS = 100
REFERENCES = 600
"""Of so many points OpenCV lets each vote with each of the others, at least."""
CELL, KEEP_ALL = 0.06, 0.01
"""OpenCV's points are so many diameters apart (its training takes minutes where flat parts have
more), and its own thinning, by shares of each side of a box, keeps them."""
Row = dict[str, Any]
_PREPARED: dict[tuple[str, str], Any] = {}
"""By method and object."""


def ours(frame: Frame, counts: dict[str, int]) -> list[PoseEstimate]:
    """Registration: of the objects that are there as many as it finds."""
    height, width = frame.depth_m.shape
    camera = Camera(width=width, height=height, K=frame.K)
    return _PREPARED["ours", ""].find(frame.depth_m, camera, sorted(counts))


def opencv(frame: Frame, counts: dict[str, int]) -> list[PoseEstimate]:
    """Point pair features (Drost et al. 2010), and their ICP at one resolution."""
    import cv2

    match3d: Any = cv2.ppf_match_3d  # pyright: ignore[reportAttributeAccessIssue]
    seen, found = prepare_frame(frame.depth_m, frame.K), list[PoseEstimate]()
    for name, count in counts.items():
        detector, surface = prepared("opencv", model_of(frame, name))
        used = seen.is_smooth & (seen.background_limit_m < surface.diameter_m)
        if int(used.sum()) < LEAST_PIXELS:
            continue
        points_m, normals = seen.points_m[used], seen.normals[used]
        dense, sparse = (with_normals(points_m, normals, CELL / k * surface.diameter_m)
                         for k in (2, 1))  # fmt: skip
        every = max(1, len(sparse) // REFERENCES)
        voted = detector.match(sparse, 1 / every, KEEP_ALL)[: max(20, 4 * count)]
        icp, matrices = match3d.ICP(100, 0.005, 2.5, 1), list[torch.Tensor]()
        for matrix in (torch.from_numpy(np.array(one.pose)) for one in voted):
            # Of the model only what is seen, of the scene what is near: the rest would pull.
            pose = Rigid(matrix[:3, :3], matrix[:3, 3])
            views, middle_m = surface.views, pose.apply(surface.middle_m[None])[0]
            side = int((views.toward @ (pose.inverse().t_m - surface.middle_m)).argmax())
            local = torch.cat(
                [pose.apply(views.points_m[side]), views.normals[side] @ pose.R.mT], 1
            )
            local = local[local.isfinite().all(1)].float().numpy()
            near = np.linalg.norm(dense[:, :3] - middle_m.numpy(), axis=1) < surface.diameter_m / 2
            motion = torch.eye(4, dtype=torch.float64)
            if min(int(near.sum()), len(local)) >= 30:
                found_motion = icp.registerModelToScene(local, dense[near])[2]
                motion = torch.from_numpy(np.array(found_motion))
            matrices.append(motion @ matrix)
        found += best_apart(matrices, count, surface, name)
    return found


def with_normals(
    points_m: torch.Tensor, normals: torch.Tensor, cell_m: float
) -> np.ndarray:  # fmt: skip
    """Thin points to one a cell, and give them with their normals as OpenCV takes them."""
    kept = thin(points_m.double(), normals.double(), cell_m)
    return torch.cat([points_m[kept], normals[kept]], 1).float().numpy()


def open3d(frame: Frame, counts: dict[str, int]) -> list[PoseEstimate]:
    """FPFH, RANSAC and ICP: a pose of each object for each region."""
    seen, found = prepare_frame(frame.depth_m, frame.K), list[PoseEstimate]()
    for name, count in counts.items():
        peer, surface = prepared("open3d", model_of(frame, name))
        used = seen.is_smooth & (seen.background_limit_m < surface.diameter_m)
        label = label_regions(seen.depth_m, used)
        clouds = [
            CloudInput(name="", points_m=seen.points_m[used & (label == k)], object=name)
            for k in torch.bincount(label[used]).ge(LEAST_PIXELS).nonzero()[:, 0]
        ]
        posed = [one for one in peer.estimate_many(clouds) if one.is_posed]
        posed.sort(key=lambda one: -(one.inlier_share or 0.0))
        matrices = list[torch.Tensor]()
        for pose in (one.camera_from_model for one in posed):
            assert pose is not None
            matrices.append(pose.matrix().double())
        found += best_apart(matrices, count, surface, name)
    return found


METHODS: dict[str, Callable[[Frame, dict[str, int]], list[PoseEstimate]]] = {
    "ours": ours, "OpenCV PPF + ICP": opencv, "Open3D FPFH + RANSAC + ICP": open3d,
}  # fmt: skip


def model_of(frame: Frame, name: str) -> ObjectModel:
    """Give the model of an object that is shown."""
    return next(thing.model for thing in frame.shown if thing.model.name == name)


def prepared(method: str, model: ObjectModel) -> Any:  # noqa: ANN401  neither peer has types
    """Prepare a peer's model once in a process."""
    if (method, model.name) not in _PREPARED:
        surface = prepare_surface(model)
        if method == "open3d":
            _PREPARED[method, model.name] = FpfhEstimator([model]), surface
        else:
            import cv2

            cv2.setNumThreads(1)
            points_m, normals = sample_surface(model, 20_000)
            points = with_normals(points_m, normals, CELL * surface.diameter_m)
            match3d: Any = cv2.ppf_match_3d  # pyright: ignore[reportAttributeAccessIssue]
            detector = match3d.PPF3DDetector(0.03, 0.05)
            detector.trainModel(points)
            _PREPARED[method, model.name] = detector, surface
    return _PREPARED[method, model.name]


def best_apart(
    matrices: Sequence[torch.Tensor], count: int, surface: Surface, name: str
) -> list[PoseEstimate]:
    """Keep so many of the poses, the best of which come first, of different places."""
    found, middles_m = list[PoseEstimate](), list[torch.Tensor]()
    for matrix in matrices:
        pose = Rigid(matrix[:3, :3], matrix[:3, 3])
        middle_m = pose.apply(surface.middle_m[None])[0]
        apart_m = [float((middle_m - other).norm()) for other in middles_m]
        if len(found) < count and min(apart_m, default=torch.inf) > APART * surface.diameter_m:
            middles_m.append(middle_m)
            found.append(PoseEstimate(
                name=f"{name} {len(found)}", object=name, status="ok", camera_from_model=pose,
                inlier_share=1 / (1 + len(found)),
            ))  # fmt: skip
    return found


def scene(kind: str, index: int, models: Sequence[ObjectModel]) -> Frame:
    """Make one scene."""
    pile, clutter = KINDS[kind]
    some = [models[index % len(models)]] if pile else models
    return next(synthetic_frames(some, 1, pile, clutter, index))


def run_scene(
    wanted: tuple[str, int, tuple[str, ...]], models: Sequence[ObjectModel], rows: Path | None
) -> None:
    """Search one scene by some methods; measure what each has found, and write it at once."""
    kind, index, methods = wanted
    frame = scene(kind, index, models)
    names = [thing.model.name for thing in frame.shown]
    counts = {name: names.count(name) for name in sorted(set(names))}
    for model in {thing.model.name: thing.model for thing in frame.shown}.values():
        for method in methods:
            if method != "ours":
                prepared(method.split()[0].lower(), model)
    for method in methods:
        began, cpu = time.perf_counter(), time.process_time()
        found = METHODS[method](frame, counts)
        spent = {"s": time.perf_counter() - began, "cpu s": time.process_time() - cpu}
        sure = [one for one in found if one.is_ok]
        row = {
            "kind": kind, "scene": index, "method": method, **spent, "part": "+".join(counts),
            "answers": len(found), **measure(frame, found), "ok": len(sure),
            "ok wrong": measure(frame, sure)["wrong"],
        }  # fmt: skip
        if rows is not None:
            print(row, flush=True)
            line = json.dumps(row | {"errors": recall_errors(frame, found)}) + "\n"
            with rows.open("ab", buffering=0) as file:  # a row is one write, whoever else writes
                file.write(line.encode())


def recall_errors(frame: Frame, found: Sequence[PoseEstimate]) -> list[Row]:
    """Measure VSD, MSSD in diameters and MSPD of each of BOP's targets."""
    with tempfile.TemporaryDirectory() as folder:
        depth = Path(folder) / "depth.png"
        write_depth_png(depth, frame.depth_m, DEPTH_UNIT_M)
        shown = [thing for thing in frame.shown if thing.visible >= LEAST_VISIBLE]
        instances = [
            Instance(
                scene_id=0, image_id=0, index=k, object_id=thing.model.number, K=frame.K,
                depth=depth, depth_unit_m=DEPTH_UNIT_M, mask=None, rgb=None,
                camera_from_model=thing.pose, visible_fraction=thing.visible,
            )
            for k, thing in enumerate(shown)
        ]  # fmt: skip
        models = {thing.model.number: thing.model for thing in shown}
        numbers = {model.name: number for number, model in models.items()}
        given = [Prediction(estimate=one, place=Place(0, 0, numbers[one.object]))
                 for one in found if one.object in numbers]  # fmt: skip
        answers, rows = match_instances(instances, given, models), list[Row]()
        for instance in instances:
            model = models[instance.object_id]
            context = error_context(model, EvaluationConfig())
            answer = answers.get(instance.name)
            pose = None if answer is None else answer.camera_from_model
            vsd, mssd_m, mspd_px = (
                torch.as_tensor(
                    metric.missing if pose is None else metric.measure(pose, instance, context)
                )
                for metric in (METRICS["vsd"], METRICS["mssd_m"], METRICS["mspd_px"])
            )
            rows.append({
                "vsd": vsd.tolist(),
                "mssd": [float(mssd_m) / model.diameter_m],
                "mspd": [float(mspd_px)],
            })  # fmt: skip
    return rows


def read_rows(folder: Path) -> list[Row]:
    """Read the rows of all files; one that was being written when the run was stopped is none."""
    found = list[Row]()
    for path in sorted(folder.glob("*.jsonl")):
        for line in path.read_text().splitlines():
            try:
                found.append(json.loads(line))
            except json.JSONDecodeError:
                print(f"{path}: a row that is not whole is left out", file=sys.stderr)
    return found


def left_to_do(words: argparse.Namespace) -> Iterator[tuple[str, int, tuple[str, ...]]]:
    """Give the scenes, and the methods that have no row of them."""
    done = {(row["kind"], row["scene"], row["method"]) for row in read_rows(words.out)}
    numbers = {kind: getattr(words, kind) for kind in KINDS}
    for index in range(words.first, words.first + max(numbers.values())):
        for kind, number in numbers.items():
            if index < words.first + number:
                peers = index < words.first + words.peers
                methods = [name for name in words.methods if name == "ours" or peers]
                methods = [name for name in methods if (kind, index, name) not in done]
                if methods:
                    yield kind, index, tuple(methods)


def run(words: argparse.Namespace) -> None:
    """Prepare the models, then search scene after scene in so many processes."""
    torch.set_num_threads(1)
    models = [make_part(name, number) for number, name in enumerate(words.parts, start=1)]
    words.out.mkdir(parents=True, exist_ok=True)
    wanted = list(left_to_do(words))
    if wanted and "ours" in words.methods:  # compiles, too, what each process would compile
        _PREPARED["ours", ""] = registration(models)
        run_scene((*wanted[0][:2], ("ours",)), models, None)
    # Processes are forked: what is prepared here is prepared in each.
    with multiprocessing.get_context("fork").Pool(
        words.jobs, initializer=torch.set_num_threads, initargs=(words.threads,)
    ) as pool:
        work = partial(run_scene, models=models, rows=words.out / f"rows-{words.first}.jsonl")
        for _ in pool.imap_unordered(work, wanted):
            pass


def table(words: argparse.Namespace) -> None:
    """Sum up the rows: by kind and method, of all scenes and of those that every method has."""
    rows = read_rows(words.out)
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        methods = {one["method"] for one in rows
                   if (one["kind"], one["scene"]) == (row["kind"], row["scene"])}  # fmt: skip
        groups.setdefault((row["kind"], row["method"], "all"), []).append(row)
        if len(methods) > 1:
            groups.setdefault((row["kind"], row["method"], "beside peers"), []).append(row)
        if row["kind"] == "piles":
            groups.setdefault((row["part"], row["method"], "all"), []).append(row)
    print(markdown_table([summary(*key, some) for key, some in sorted(groups.items())]))


def summary(kind: str, method: str, scenes: str, rows: Sequence[Row]) -> Row:
    """Sum up one method on one kind of scene."""
    total = {key: sum(row[key] for row in rows)
             for key in ("instances", "right", "answers", "wrong", "ok", "ok wrong")}  # fmt: skip
    errors = [one for row in rows for one in row["errors"]]
    seconds = sorted(row["s"] for row in rows)
    recalls = {
        f"AR {name.upper()}": average_recall(
            torch.tensor([one[name] for one in errors], dtype=torch.float64), limits
        )
        for name, limits in (("vsd", BOP_SHARES), ("mssd", BOP_SHARES), ("mspd", BOP_PIXELS))
    }
    return {
        "scenes": kind, "method": method, "which": scenes, "number": len(rows), **total,
        "recall": total["right"] / max(1, total["instances"]), **recalls,
        "AR": sum(recalls.values()) / len(recalls), "targets": len(errors),
        "mean s": sum(seconds) / len(seconds), "most s": seconds[-1],
        "mean cpu s": sum(row["cpu s"] for row in rows) / len(rows),
    }  # fmt: skip


def main() -> None:
    """Run, or make the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("out", type=Path, help="folder of the rows")
    for kind in KINDS:
        parser.add_argument(f"--{kind}", type=int, default=0, help=f"so many {kind}")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    parser.add_argument("--peers", type=int, default=0, help="scenes of each kind for the peers")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--threads", type=int, default=1, help="of each process")
    words = parser.parse_args()
    (run if words.what == "run" else table)(words)


if __name__ == "__main__":
    main()
