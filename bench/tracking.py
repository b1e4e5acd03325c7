"""Tracking in synthetic sequences of known motion, compared with estimating each frame anew.

    python bench/tracking.py --weights parts --frames 60
    python bench/tracking.py --weights parts --speed 2 --anew 0
    python bench/tracking.py --weights parts --resting --anew 0

Each object of the weights moves on a smooth path before a wall, over a table, between other
boxes, and turns as it goes, at 30 frames a second (``--speed 1``: 0.2 m/s and 40 degrees a second
on average). A plate covers it fully in some frames, it is removed in others, and two
fifths of it are occluded in others. With ``--resting`` it lies on the table, on the largest face of
its convex hull, and slides and turns there. Depth has a sensor's errors. Right is an answer with
ADD (ADD-S where symmetries are declared or were found) below 10 % of the diameter in a frame that
shows the object; lost is no answer in such a frame. "says so" are frames from the start of a
drop-out to the first that is refused, "back" those from its end to the next right answer. "off" is
the error of right answers in percent of the diameter, the median and the 95 % quantile. Seconds are
of the processor, one thread. ``--anew N``: every N-th frame is searched without earlier frames.
"""

import argparse
import math
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from depthpose.core.checkpoint import find_weights
from depthpose.core.loop import sample_generator
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose.config import SyntheticSensorConfig
from depthpose.pose.mesh import drawn_triangles, sample_surface
from depthpose.pose.metrics import add_m, adds_m
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.synthetic.views import random_rotation, simulate_depth
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.report.page import markdown_table

SEED = 0x7AC4
WIDTH, HEIGHT, FOCAL_PX = 640, 480, 572.0
K = torch.tensor([[FOCAL_PX, 0, 319.5], [0, FOCAL_PX, 239.5], [0, 0, 1]], dtype=torch.float64)
COVERED, REMOVED, PARTLY = (0.25, 0.33), (0.5, 0.58), (0.75, 0.85)
"""Stretches of a sequence, as shares of its frames."""
HIDDEN = 0.4
RATE = 30
DOWN_RAD = math.radians(50)
"""How steeply the camera looks down at a table on which things rest."""
UP = torch.tensor([0.0, -math.cos(DOWN_RAD), -math.sin(DOWN_RAD)], dtype=torch.float64)
TABLE_M = torch.tensor([0.0, 0.0, 0.75], dtype=torch.float64)
"""Where the optical axis meets it."""
Row = dict[str, Any]


class Frame(NamedTuple):
    """A view, the true pose, and whether the object is visible."""

    view: ViewInput
    truth: Rigid
    is_seen: bool


def path(number: int, speed: float, generator: torch.Generator) -> Iterator[Rigid]:
    """Move on a smooth closed curve and turn about a slowly changing axis."""
    R = random_rotation(generator).double()
    phase = 2 * math.pi * torch.rand(3, generator=generator).double()
    axis = torch.nn.functional.normalize(torch.randn(3, generator=generator).double(), dim=-1)
    other = torch.nn.functional.normalize(torch.randn(3, generator=generator).double(), dim=-1)
    size_m = torch.tensor([0.12, 0.08, 0.08], dtype=torch.float64)
    for k in range(number):
        s = speed * k / RATE
        angle = phase + 2 * s * torch.tensor([1.0, 1.3, 0.7], dtype=torch.float64)
        middle_m = torch.tensor([0.0, 0.0, 0.75], dtype=torch.float64) + size_m * angle.sin()
        turn = math.radians(40) * speed / RATE
        yield Rigid(R, middle_m)
        way = torch.nn.functional.normalize(axis * math.cos(s) + other * math.sin(s), dim=-1)
        R = rotation_by(turn * way) @ R


def background(generator: torch.Generator) -> Tensor:
    """Render a wall, a table and boxes that are no known object."""
    row = torch.arange(HEIGHT)[:, None].expand(HEIGHT, WIDTH).double()
    table_m = 0.35 / ((row - 239.5) / FOCAL_PX).clamp(min=1e-6)
    depth_m = table_m.clamp(max=1.4)
    for _ in range(3):
        place = (2 * torch.rand(3, generator=generator).double() - 1) * torch.tensor(
            [0.3, 0.1, 0.1]
        )
        corners = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3).double()
        size = 0.05 + 0.15 * torch.rand(3, generator=generator).double()
        box_m = corners * size @ random_rotation(generator).double().mT
        box_m = box_m + place + torch.tensor([0.0, 0.2, 1.05])
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        faces = torch.tensor([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))])
        drawn_m = rasterize(box_m[faces], K, WIDTH, HEIGHT).depth_m
        depth_m = torch.where(drawn_m < depth_m, drawn_m, depth_m)
    return depth_m


def resting_path(
    corners_m: Tensor, number: int, speed: float, generator: torch.Generator
) -> Iterator[Rigid]:
    """Slide on a table and turn about its normal, lying on the largest face of the hull."""
    hull = ConvexHull(corners_m.numpy())
    sides = np.unique(hull.equations.round(3), axis=0, return_inverse=True)
    a, b, c = hull.points[hull.simplices].transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    largest = np.bincount(sides[1].reshape(-1), areas).argmax()
    R = turned_onto(torch.from_numpy(sides[0][largest, :3]), -UP)
    phase = 2 * math.pi * torch.rand(3, generator=generator).double()
    right = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    along = torch.linalg.cross(UP, right)
    for k in range(number):
        s = speed * k / RATE
        a, b = (phase[:2] + s * torch.tensor([2.0, 2.6])).sin()
        place_m = TABLE_M + 0.1 * a * right + 0.08 * b * along
        turned = rotation_by((phase[2] + math.radians(40) * s) * UP) @ R
        lowest_m = ((corners_m - corners_m.mean(0)) @ turned.mT @ UP).min()
        yield Rigid(turned, place_m - lowest_m * UP)


def turned_onto(direction: Tensor, wanted: Tensor) -> Tensor:
    """Give a rotation that turns one unit vector onto another."""
    direction = torch.nn.functional.normalize(direction, dim=-1)
    axis = torch.linalg.cross(direction, wanted)
    if float(axis.norm()) < 1e-9:
        axis = torch.linalg.cross(direction, direction.roll(1))
    angle = (direction @ wanted).clamp(-1, 1).arccos()
    return rotation_by(angle * torch.nn.functional.normalize(axis, dim=-1))


def table() -> Tensor:
    """Render a table seen from above."""
    y = (torch.arange(HEIGHT)[:, None].expand(HEIGHT, WIDTH).double() - 239.5) / FOCAL_PX
    slope = UP[1] * y + UP[2]
    depth_m = (UP @ TABLE_M) / slope.clamp(max=-1e-6)
    return depth_m.clamp(max=1.4)


def sequence(
    model: ObjectModel, number: int, speed: float, seed: int, *, is_resting: bool = False
) -> Iterator[Frame]:
    """Render the frames of one object."""
    generator = sample_generator(seed, SEED)
    triangles = drawn_triangles(model).double()
    middle_m = triangles.reshape(-1, 3).mean(0)
    if is_resting:
        behind_m = table()
        poses = resting_path(triangles.reshape(-1, 3), number, speed, generator)
    else:
        behind_m = background(generator)
        poses = path(number, speed, generator)
    for k, pose in enumerate(poses):
        truth = Rigid(pose.R, pose.t_m - pose.R @ middle_m)
        share = k / number
        is_removed = REMOVED[0] <= share < REMOVED[1]
        is_covered = COVERED[0] <= share < COVERED[1]
        corners_m = truth.apply(triangles.reshape(-1, 3)).reshape(-1, 3, 3)
        own_m = rasterize(corners_m, K, WIDTH, HEIGHT).depth_m
        shown = own_m.isfinite() & (own_m < behind_m)
        depth_m = behind_m if is_removed else torch.where(shown, own_m, behind_m)
        if is_covered or PARTLY[0] <= share < PARTLY[1]:
            column = torch.arange(WIDTH).expand(HEIGHT, WIDTH)
            some = column[shown].double()
            cut = torch.inf if is_covered else float(some.quantile(HIDDEN))
            box = (column >= some.min() - 15) & (column <= min(cut, float(some.max()) + 15))
            depth_m = torch.where(box, float(own_m[shown].min()) - 0.08, depth_m)
        measured_m = simulate_depth(
            depth_m, (FOCAL_PX, FOCAL_PX), SyntheticSensorConfig(), generator
        )
        view = ViewInput(
            name=f"{model.name}_{k:04d}", depth_m=measured_m.float(), K=K.float(),
            mask=torch.ones(HEIGHT, WIDTH, dtype=torch.bool), object=model.name,
        )  # fmt: skip
        yield Frame(view, truth.float(), not is_removed | is_covered)


def verdict(
    model: ObjectModel, points_m: Tensor, frame: Frame, found: PoseEstimate
) -> tuple[str, float]:
    """Classify an estimate as right, wrong, lost, or rightly none; and its error in diameters."""
    if found.camera_from_model is None:
        return ("lost" if frame.is_seen else "none"), math.nan
    is_adds = not model.symmetries.is_none
    measured = adds_m if is_adds else add_m
    error = float(measured(found.camera_from_model, frame.truth, points_m)) / model.diameter_m
    return ("right" if frame.is_seen and error < 0.1 else "wrong"), error


def delays(frames: Sequence[Frame], said: Sequence[str]) -> tuple[list[int], list[int]]:
    """Count frames from the begin of each drop-out to a refusal, from its end to a right answer."""
    seen = [frame.is_seen for frame in frames]
    begins = [k for k in range(1, len(seen)) if seen[k - 1] and not seen[k]]
    ends = [k for k in range(1, len(seen)) if seen[k] and not seen[k - 1]]
    far = len(seen)
    noticed = [next((j for j in range(k, far) if said[j] == "none"), far) - k for k in begins]
    back = [next((j for j in range(k, far) if said[j] == "right"), far) - k for k in ends]
    return noticed, back


def followed(net: GeoPoseNet, model: ObjectModel, frames: Sequence[Frame]) -> Row:
    """Follow the object, and count."""
    points_m = sample_surface(model, 1000)[0]
    said, kinds, spent = list[str](), list[str | None](), list[float]()
    off = list[float]()
    answers = net.track_in([frame.view for frame in frames], model.name)
    for frame in frames:
        began = time.process_time()
        found = next(answers)
        spent.append(time.process_time() - began)
        word, error = verdict(model, points_m, frame, found)
        said.append(word)
        off += [100 * error] if word == "right" else []
        kinds.append(found.tracking)
    off.sort()
    icp = sorted(s for s, kind in zip(spent, kinds, strict=True) if kind == "tracked")
    noticed, back = delays(frames, said)
    return {
        "object": model.name, "frames": len(frames), **counts(said),
        "tracked": kinds.count("tracked"), "found": kinds.count("found"),
        "says so": noticed, "back": back,
        "off": [round(off[int(q * len(off))], 1) for q in (0.5, 0.95)] if off else None,
        "ms tracked": round(1000 * icp[len(icp) // 2], 1) if icp else None,
        "frames a second": round(len(frames) / sum(spent), 1),
    }  # fmt: skip


def counts(said: Sequence[str]) -> Row:
    """Count verdicts."""
    return {word: said.count(word) for word in ("right", "wrong", "lost", "none")}


def anew(net: GeoPoseNet, model: ObjectModel, frames: Sequence[Frame]) -> Row:
    """Search every frame without earlier frames."""
    points_m = sample_surface(model, 1000)[0]
    said = []
    began = time.process_time()
    for frame in frames:
        best = net.find_in(frame.view, [model.name])[0]
        said.append(verdict(model, points_m, frame, best)[0])
    spent = time.process_time() - began
    return {"object": model.name, "frames": len(frames), **counts(said),
            "frames a second": round(len(frames) / spent, 2)}  # fmt: skip


def main() -> None:
    """Follow every object of the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", nargs="+", default=["parts"])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--objects", nargs="*", help="of the weights; all by default")
    parser.add_argument("--anew", type=int, default=6)
    parser.add_argument("--resting", action="store_true", help="on a table")
    words = parser.parse_args()
    torch.set_num_threads(1)
    for name in words.weights:
        net = GeoPoseNet.load(find_weights(name))
        rows, others = [], []
        for model in net.weights.models:
            if words.objects and model.name not in words.objects:
                continue
            frames = list(sequence(
                model, words.frames, words.speed, words.seed, is_resting=words.resting
            ))  # fmt: skip
            rows.append(followed(net, model, frames))
            print(rows[-1], flush=True)
            if words.anew:
                others.append(anew(net, model, frames[words.anew // 2 :: words.anew]))
        print(f"{name}, followed\n{markdown_table(rows)}")
        if others:
            print(f"{name}, every {words.anew} frames anew\n{markdown_table(others)}")


if __name__ == "__main__":
    main()
