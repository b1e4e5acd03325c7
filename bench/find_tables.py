"""Known objects found in depth alone, without masks, on synthetic tables and in piles.

    python bench/find_tables.py --weights parts --tables 20
    python bench/find_tables.py --weights parts --register --piles 20

``--register`` searches by the models alone, without the network. Real frames are those of
``bench/real.py``.

A synthetic table has two to all of the objects, each at most once, between other things, with a
sensor's errors. An instance counts if half its silhouette and 200 pixels are visible. Right is an
answer of that object with ADD (ADD-S where symmetries are declared or were found) below 10 % of the
diameter; an answer is wrong where neither it nor an alternative that it names fits an instance,
however occluded. A pile has 20 of one object; of these an instance counts if 70 % of its silhouette
is visible.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch

from depthpose.core.camera import Camera
from depthpose.core.checkpoint import find_weights
from depthpose.core.rigid import Rigid
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.mesh import sample_surface
from depthpose.pose.metrics import add_m, adds_m
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic import make_frames
from depthpose.pose.types import ObjectModel, PoseEstimate
from depthpose.report.page import markdown_table

SEED = 0x7AB1E
Row = dict[str, Any]


class Shown(NamedTuple):
    """An instance of a frame: its object, its pose, and whether it must be found.

    ``is_adds``: it is measured by ADD-S, though no symmetry is declared. ``visible``: the share of
    its silhouette that is seen.
    """

    model: ObjectModel
    pose: Rigid
    counts: bool
    is_adds: bool = False
    visible: float = 1.0


class Frame(NamedTuple):
    """Depth, camera, the true instances, and which objects may be there; None: those shown."""

    name: str
    depth_m: torch.Tensor
    K: torch.Tensor
    shown: list[Shown]
    known: list[ObjectModel] | None = None


def synthetic_frames(
    models: Sequence[ObjectModel], number: int, pile: int, clutter: tuple[int, int] = (0, 4),
    first: int = 0,
) -> Iterator[Frame]:  # fmt: skip
    """Generate tables, or piles of so many, of another seed than any training."""
    config = ObjectsConfig(
        seed=SEED, distance_m=(0.6, 1.0), frame_pile=pile, frame_clutter=clutter
    )  # fmt: skip
    least = 0.7 if pile else 0.5
    by_number = {model.number: model for model in models}
    for frame in make_frames(models, config, number, first):
        shown = []
        for thing in frame.objects:
            pixels = int(thing.visible.sum())
            share = pixels / int(thing.silhouette.sum())
            counts = pixels >= 200 and share >= least
            model = by_number[thing.number]
            shown.append(Shown(model, thing.camera_from_model, counts, visible=share))
        known = None if pile else list(models)
        yield Frame(f"frame {frame.number}", frame.depth_m, frame.K, shown, known)


def measure(frame: Frame, found: Sequence[PoseEstimate]) -> Row:
    """Count found instances and answers that fit none."""
    right: set[int] = set()
    wrong = []
    for estimate in found:
        pose = estimate.camera_from_model
        assert pose is not None
        same = {k: thing for k, thing in enumerate(frame.shown)
                if thing.model.name == estimate.object}  # fmt: skip
        right |= {k for k, thing in same.items() if error_of(pose, thing) < 0.1}
        named = [pose, *(other.camera_from_model for other in estimate.alternatives)]
        if not any(error_of(one, thing) < 0.1 for thing in same.values() for one in named):
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
    is_adds = thing.is_adds or not thing.model.symmetries.is_none
    measure = adds_m if is_adds else add_m
    return float(measure(pose, thing.pose, points_m)) / thing.model.diameter_m


def main() -> None:
    """Find the objects of every frame, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", nargs="+", default=["parts"])
    parser.add_argument("--register", action="store_true", help="without the network")
    parser.add_argument("--tables", type=int, default=20)
    parser.add_argument("--piles", type=int, default=0, help="in place of tables")
    words = parser.parse_args()
    torch.set_num_threads(1)
    for name in words.weights:
        net = GeoPoseNet.load(find_weights(name))
        models = net.weights.models
        rows = list[Row]()
        number = words.piles or words.tables
        for frame in synthetic_frames(models, number, 20 * bool(words.piles)):
            height, width = frame.depth_m.shape
            camera = Camera(width=width, height=height, K=frame.K)
            known = frame.known or [thing.model for thing in frame.shown]
            used = registration(known) if words.register else net
            asked = sorted({model.name for model in known})
            began, cpu = time.perf_counter(), time.process_time()
            found = used.find(frame.depth_m, camera, asked)
            spent = {"s": time.perf_counter() - began, "cpu s": time.process_time() - cpu}
            rows.append({**measure(frame, found), **spent})
            print(rows[-1], flush=True)
        kinds = ("instances", "right", "missed", "wrong", "s", "cpu s")
        total = {key: sum(row[key] for row in rows) for key in kinds}
        print(markdown_table([{"weights": name, "frames": len(rows), **total}]))


_PREPARED: dict[tuple[str, ...], Registration] = {}


def registration(models: Sequence[ObjectModel]) -> Registration:
    """Prepare models once."""
    by_name = {model.name: model for model in models}
    key = tuple(sorted(by_name))
    if key not in _PREPARED:
        _PREPARED[key] = Registration([by_name[name] for name in key])
        _PREPARED[key].prepare()
    return _PREPARED[key]


if __name__ == "__main__":
    main()
