"""Known objects found in depth alone, without masks: synthetic tables, piles, and real frames.

    python bench/find_tables.py --weights parts --tables 20
    python bench/find_tables.py --weights parts --register --piles 20
    python bench/find_tables.py --weights linemod.safetensors ycb --real $DEPTHPOSE_DATA/pose
    python bench/find_tables.py --register --real $DEPTHPOSE_DATA/pose

``--register`` searches by the models alone, without the network; real frames then show the basket
and the bottle too, and each object is searched alone, then, where there are several, all at once.

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
from pathlib import Path
from typing import Any, NamedTuple

import torch

from depthpose.core.camera import Camera
from depthpose.core.checkpoint import find_weights
from depthpose.core.files import read_depth_png, read_json
from depthpose.core.rigid import Rigid
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.datasets import open_bop
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.registration import Registration
from depthpose.pose.mesh import read_model, sample_surface, with_found_symmetries
from depthpose.pose.metrics import add_m, adds_m
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


def real_frames(folder: Path, models: Sequence[ObjectModel] | None) -> Iterator[Frame]:
    """Give the frames of LineMOD and YCB that show an object of the weights; None: all there is."""
    if models is None:
        yield from single_scenes(folder / "real_frames")
    for part in ("lm", "ycb_frames"):
        data = open_bop(folder / part)
        by_name = {model.name: model for model in models or data.objects.values()}
        for image in sorted({(i.scene_id, i.image_id) for i in data.instances}):
            here = [i for i in data.instances if (i.scene_id, i.image_id) == image]
            named = [(data.objects[i.object_id].name, i) for i in here]
            is_ycb = part == "ycb_frames"  # geometry alone shows neither faces of boxes nor turns
            shown = [Shown(by_name[name], i.camera_from_model, True, is_ycb)
                     for name, i in named if name in by_name]  # fmt: skip
            if shown:
                depth_m = read_depth_png(here[0].depth, here[0].depth_unit_m)
                every = list(data.objects.values()) if is_ycb else None
                yield Frame(f"{part} {image[1]}", depth_m, here[0].K, shown, every)


def single_scenes(folder: Path) -> Iterator[Frame]:
    """Give the frame of the basket and the two of the bottle."""
    facts: Any = read_json(folder / "basket/truth.json")
    pose = Rigid(torch.tensor(facts["cam_R_m2c"]).reshape(3, 3),
                 torch.tensor(facts["cam_t_m2c_mm"]) / 1000)  # fmt: skip
    model = read_model(folder / "basket/obj_000019.ply", "mm", name="basket")
    model = with_found_symmetries(model, None, is_taken=True)
    lens: Any = read_json(folder / "basket/camera.json")
    K = torch.tensor(lens["K"]).double()
    depth_m = read_depth_png(folder / "basket/depth.png", 0.001)
    yield Frame("basket", depth_m, K, [Shown(model, pose, True)])
    facts = read_json(folder / "bottle/poses.json")
    fx, fy, cx, cy = facts["depth_K"]
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]).double()
    to_color = torch.tensor(facts["depth_camera_to_color_camera"]).double()
    there = torch.tensor(facts["model_to_color_camera_authors_test_pose"]).double()
    matrix = (to_color.inverse() @ there).float()
    model = read_model(folder / "bottle/bottle.obj", "m", name="bottle")
    model = with_found_symmetries(model, None, is_taken=True)
    for number in facts["frames"]:
        depth_m = read_depth_png(folder / f"bottle/depth_{number}.png", 0.001)
        pose = Rigid(matrix[:3, :3], matrix[:3, 3])
        yield Frame(f"bottle {number}", depth_m, K, [Shown(model, pose, True)])


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


def searches(frame: Frame, alone: bool) -> Iterator[Frame]:
    """Give a frame for each object that is searched in it alone, and one for all of them."""
    names = sorted({thing.model.name for thing in frame.shown})
    for name in names if alone else []:
        shown = [thing for thing in frame.shown if thing.model.name == name]
        yield frame._replace(name=f"{frame.name} {name}", shown=shown, known=[shown[0].model])
    if len(names) > 1 or not alone:
        yield frame


def main() -> None:
    """Find the objects of every frame, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", nargs="+", default=["parts"])
    parser.add_argument("--register", action="store_true", help="without the network")
    parser.add_argument("--tables", type=int, default=20)
    parser.add_argument("--piles", type=int, default=0, help="in place of tables")
    parser.add_argument("--real", type=Path, help="real frames in place of tables")
    words = parser.parse_args()
    torch.set_num_threads(1)
    for name in words.weights:
        net = GeoPoseNet.load(find_weights(name))
        models = net.weights.models
        if words.real:
            frames = real_frames(words.real, None if words.register else models)
        else:
            frames = synthetic_frames(models, words.piles or words.tables, 20 * bool(words.piles))
        rows, alone = [], bool(words.register and words.real)
        for frame in (part for whole in frames for part in searches(whole, alone)):
            height, width = frame.depth_m.shape
            camera = Camera(width=width, height=height, K=frame.K)
            known = frame.known or [thing.model for thing in frame.shown]
            used = registration(known) if words.register else net
            asked = [model.name for model in known if model.name in used.objects]
            began, cpu = time.perf_counter(), time.process_time()
            found = used.find(frame.depth_m, camera, sorted(set(asked)))
            spent = {"s": time.perf_counter() - began, "cpu s": time.process_time() - cpu}
            rows.append({**measure(frame, found), "known": len(set(asked)), **spent})
            print(rows[-1], flush=True)
        print(markdown_table(summary(name, rows)))


def summary(name: str, rows: Sequence[Row]) -> list[Row]:
    """Add up the searches for one object, and those for several."""
    table = []
    for several in sorted({row["known"] > 1 for row in rows}):
        some = [row for row in rows if (row["known"] > 1) == several]
        kinds = ("instances", "right", "missed", "wrong", "s", "cpu s")
        total = {key: sum(row[key] for row in some) for key in kinds}
        objects = "several" if several else "one"
        table.append({"weights": name, "searches": len(some), "objects": objects, **total})
    return table


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
