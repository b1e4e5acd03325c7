"""Known objects found in depth alone, without masks: synthetic tables, and the real frames.

    python bench/find_tables.py --weights parts --tables 20
    python bench/find_tables.py --weights linemod.safetensors ycb --real $DEPTHPOSE_DATA/pose

A synthetic table has two to all of the objects, each at most once, between other things, with a
sensor's errors. An instance counts if half its silhouette and 200 pixels are visible. Right is an
answer of that object with ADD (ADD-S where symmetries are declared or were found) below 10 % of the
diameter; an answer that fits no instance, however occluded, is wrong.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from depthpose.core.camera import Camera
from depthpose.core.checkpoint import find_weights
from depthpose.core.files import read_depth_png
from depthpose.core.rigid import Rigid
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.datasets import open_bop
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.mesh import sample_surface
from depthpose.pose.metrics import add_share
from depthpose.pose.synthetic import make_frames
from depthpose.pose.types import ObjectModel, PoseEstimate
from depthpose.report.page import markdown_table

SEED = 0x7AB1E
Row = dict[str, Any]


class Shown(NamedTuple):
    """An instance of a frame: its object, its pose, and whether it must be found."""

    model: ObjectModel
    pose: Rigid
    counts: bool


class Frame(NamedTuple):
    """Depth, camera and the true instances."""

    name: str
    depth_m: torch.Tensor
    K: torch.Tensor
    shown: list[Shown]


def synthetic_tables(models: Sequence[ObjectModel], number: int) -> Iterator[Frame]:
    """Generate tables of another seed than any training."""
    config = ObjectsConfig(seed=SEED, distance_m=(0.6, 1.0))
    by_number = {model.number: model for model in models}
    for frame in make_frames(models, config, number):
        shown = []
        for thing in frame.objects:
            pixels = int(thing.visible.sum())
            counts = pixels >= 200 and pixels >= 0.5 * int(thing.silhouette.sum())
            shown.append(Shown(by_number[thing.number], thing.camera_from_model, counts))
        yield Frame(f"table {frame.number}", frame.depth_m, frame.K, shown)


def real_frames(folder: Path, models: Sequence[ObjectModel]) -> Iterator[Frame]:
    """Give the frames of LineMOD and YCB that show an object of the weights."""
    by_name = {model.name: model for model in models}
    for part in ("lm", "ycb_frames"):
        data = open_bop(folder / part)
        for image in sorted({(i.scene_id, i.image_id) for i in data.instances}):
            here = [i for i in data.instances if (i.scene_id, i.image_id) == image]
            named = [(data.objects[i.object_id].name, i) for i in here]
            shown = [Shown(by_name[name], i.camera_from_model, True)
                     for name, i in named if name in by_name]  # fmt: skip
            if shown:
                depth_m = read_depth_png(here[0].depth, here[0].depth_unit_m)
                yield Frame(f"{part} {image[1]}", depth_m, here[0].K, shown)


def measure(frame: Frame, found: Sequence[PoseEstimate]) -> Row:
    """Count found instances and answers that fit none."""
    right: set[int] = set()
    wrong = []
    for estimate in found:
        pose = estimate.camera_from_model
        assert pose is not None
        near = [k for k, thing in enumerate(frame.shown)
                if thing.model.name == estimate.object and error_of(pose, thing) < 0.1]  # fmt: skip
        right |= set(near)
        if not near:
            wrong.append(f"{estimate.object} ({estimate.certainty or 0:.2f})")
    counted = {k for k, thing in enumerate(frame.shown) if thing.counts}
    missed = [frame.shown[k].model.name for k in sorted(counted - right)]
    return {
        "frame": frame.name, "instances": len(counted), "right": len(counted & right),
        "missed": len(missed), "wrong": len(wrong),
        "which": "; ".join([*(f"missed {m}" for m in missed), *(f"wrong {w}" for w in wrong)]),
    }  # fmt: skip


def error_of(pose: Rigid, thing: Shown) -> float:
    """ADD(-S) in diameters."""
    points_m = sample_surface(thing.model, 1000)[0]
    is_adds = not thing.model.symmetries.is_none
    return add_share(pose, thing.pose, points_m, thing.model.diameter_m, is_adds=is_adds)


def main() -> None:
    """Find the objects of every frame, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", nargs="+", default=["parts"])
    parser.add_argument("--tables", type=int, default=20)
    parser.add_argument("--real", type=Path, help="frames of LineMOD and YCB in place of tables")
    words = parser.parse_args()
    torch.set_num_threads(1)
    for name in words.weights:
        net = GeoPoseNet.load(find_weights(name))
        models = net.weights.models
        frames = real_frames(words.real, models) if words.real else synthetic_tables(
            models, words.tables)  # fmt: skip
        rows = []
        for frame in frames:
            height, width = frame.depth_m.shape
            camera = Camera(width=width, height=height, K=frame.K)
            began, cpu = time.perf_counter(), time.process_time()
            found = net.find(frame.depth_m, camera)
            spent = {"s": time.perf_counter() - began, "cpu s": time.process_time() - cpu}
            rows.append(measure(frame, found) | spent)
            print(rows[-1], flush=True)
        total = {key: sum(row[key] for row in rows)
                 for key in ("instances", "right", "missed", "wrong", "s", "cpu s")}  # fmt: skip
        print(markdown_table([{"weights": name, "frames": len(rows), **total}]))


if __name__ == "__main__":
    main()
