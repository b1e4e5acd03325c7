"""Tracking in synthetic sequences of known motion, compared with estimating each frame anew.

    python bench/tracking.py --weights parts --frames 60
    python bench/tracking.py --weights parts --speed 2 --anew 0
    python bench/tracking.py --weights parts --resting --anew 0

Each object of the weights moves on a smooth path and rotates, before a wall and a table and
between boxes, at 30 frames a second (``--speed 1``: 0.2 m/s and 40 degrees a second on average). A
plate covers it fully in some frames, in others it is removed, in others two fifths of it are
occluded. With ``--resting`` it lies on the table, on the largest face of its convex hull, and
slides and rotates there. Depth has a sensor's errors.

An answer is right if its ADD (ADD-S where symmetries are declared or were found) is below 10 % of
the diameter in a frame that shows the object; no answer in such a frame is lost. "says so" counts
the frames from the start of a drop-out to the first refusal, "back" those from its end to the next
right answer. "off" is the error of right answers in percent of the diameter, the median and the
95 % quantile. Seconds are of the processor, one thread. ``--anew N``: every N-th frame is searched
without earlier frames.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import ConvexHull
from shared import make_parser, with_cpu_seconds
from torch import Tensor

from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.checkpoint import find_weights
from depthpose.core.loop import make_sample_generator
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose.config import SyntheticSensorConfig
from depthpose.pose.mesh import drawn_triangles, sample_surface
from depthpose.pose.metrics import add_m, adds_m
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.synthetic.depth_sensors import simulate_depth
from depthpose.pose.synthetic.random_numbers import random_rotation
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.report.page import format_markdown_table

SEED = 0x7AC4
WIDTH, HEIGHT, FOCAL_PX = 640, 480, 572.0
CENTRE_X_PX, CENTRE_Y_PX = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
K = intrinsics(FOCAL_PX, FOCAL_PX, CENTRE_X_PX, CENTRE_Y_PX)

# Parts of a sequence in which the object is covered, removed and partly occluded, as shares of it.
COVERED = (0.25, 0.33)
REMOVED = (0.5, 0.58)
OCCLUDED = (0.75, 0.85)
OCCLUDED_SHARE = 0.4

FRAMES_PER_S = 30
TURN_RAD_PER_S = math.radians(40)
FARTHEST_M = 1.4  # the wall, or the end of the table
TABLE_PITCH_RAD = math.radians(50)  # by which the camera looks down at the table
UP = torch.tensor(
    [0.0, -math.cos(TABLE_PITCH_RAD), -math.sin(TABLE_PITCH_RAD)], dtype=torch.float64
)
TABLE_CENTRE_M = torch.tensor([0.0, 0.0, 0.75], dtype=torch.float64)  # on the optical axis
SURFACE_POINTS = 1000
RIGHT = 0.1  # largest error of a right answer, in diameters
Row = dict[str, Any]


class Frame(NamedTuple):
    """A view, the true pose, and whether the object is visible."""

    view: ViewInput
    truth: Rigid
    is_seen: bool


def random_direction(generator: torch.Generator) -> Tensor:
    """Draw a unit vector."""
    return torch.nn.functional.normalize(torch.randn(3, generator=generator).double(), dim=-1)


def path(number: int, speed: float, generator: torch.Generator) -> Iterator[Rigid]:
    """Move on a smooth closed curve and turn about a slowly changing axis."""
    R = random_rotation(generator).double()
    phase = 2 * math.pi * torch.rand(3, generator=generator).double()
    first_axis = random_direction(generator)
    second_axis = random_direction(generator)
    centre_m = torch.tensor([0.0, 0.0, 0.75], dtype=torch.float64)
    amplitude_m = torch.tensor([0.12, 0.08, 0.08], dtype=torch.float64)
    angle_rad = TURN_RAD_PER_S * speed / FRAMES_PER_S
    for k in range(number):
        time_s = speed * k / FRAMES_PER_S
        angles = phase + 2 * time_s * torch.tensor([1.0, 1.3, 0.7], dtype=torch.float64)
        yield Rigid(R, centre_m + amplitude_m * angles.sin())
        mixed_axis = first_axis * math.cos(time_s) + second_axis * math.sin(time_s)
        R = rotation_by(angle_rad * torch.nn.functional.normalize(mixed_axis, dim=-1)) @ R


def background(generator: torch.Generator) -> Tensor:
    """Render a wall, a table and boxes that are no known object."""
    unit_box = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3).double()
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])
    depth_m = (0.35 / ray_slope().clamp(min=1e-6)).clamp(max=FARTHEST_M)
    for _ in range(3):
        position = 2 * torch.rand(3, generator=generator).double() - 1
        offset_m = position * torch.tensor([0.3, 0.1, 0.1])
        size_m = 0.05 + 0.15 * torch.rand(3, generator=generator).double()
        corners_m = unit_box * size_m @ random_rotation(generator).double().mT + offset_m
        corners_m = corners_m + torch.tensor([0.0, 0.2, 1.05])
        box_m = rasterize(corners_m[faces], K, WIDTH, HEIGHT).depth_m
        depth_m = torch.where(box_m < depth_m, box_m, depth_m)
    return depth_m


def ray_slope() -> Tensor:
    """Compute y / z of the ray of each pixel."""
    row = torch.arange(HEIGHT)[:, None].expand(HEIGHT, WIDTH).double()
    return (row - CENTRE_Y_PX) / FOCAL_PX


def resting_path(
    corners_m: Tensor, number: int, speed: float, generator: torch.Generator
) -> Iterator[Rigid]:
    """Slide on a table and turn about its normal, lying on the largest face of the hull."""
    hull = ConvexHull(corners_m.numpy())
    planes, plane_of_triangle = np.unique(hull.equations.round(3), axis=0, return_inverse=True)
    first, second, third = hull.points[hull.simplices].transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(second - first, third - first), axis=-1)
    largest = np.bincount(plane_of_triangle.reshape(-1), areas).argmax()
    R_resting = rotation_onto(torch.from_numpy(planes[largest, :3]), -UP)
    phase = 2 * math.pi * torch.rand(3, generator=generator).double()
    right = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    ahead = torch.linalg.cross(UP, right)
    centred_m = corners_m - corners_m.mean(0)
    for k in range(number):
        time_s = speed * k / FRAMES_PER_S
        x, y = (phase[:2] + time_s * torch.tensor([2.0, 2.6])).sin()
        position_m = TABLE_CENTRE_M + 0.1 * x * right + 0.08 * y * ahead
        R = rotation_by((phase[2] + TURN_RAD_PER_S * time_s) * UP) @ R_resting
        lowest_m = (centred_m @ R.mT @ UP).min()
        yield Rigid(R, position_m - lowest_m * UP)


def rotation_onto(direction: Tensor, target: Tensor) -> Tensor:
    """Compute a rotation that brings one unit vector onto another."""
    direction = torch.nn.functional.normalize(direction, dim=-1)
    axis = torch.linalg.cross(direction, target)
    if float(axis.norm()) < 1e-9:
        axis = torch.linalg.cross(direction, direction.roll(1))
    angle = (direction @ target).clamp(-1, 1).arccos()
    return rotation_by(angle * torch.nn.functional.normalize(axis, dim=-1))


def table() -> Tensor:
    """Render the depth [m] of a table seen from above."""
    slope = UP[1] * ray_slope() + UP[2]
    depth_m = (UP @ TABLE_CENTRE_M) / slope.clamp(max=-1e-6)
    return depth_m.clamp(max=FARTHEST_M)


def sequence(
    model: ObjectModel, number: int, speed: float, seed: int, *, is_resting: bool = False
) -> Iterator[Frame]:
    """Render the frames of one object."""
    generator = make_sample_generator(seed, SEED)
    corners_m = drawn_triangles(model).double().reshape(-1, 3)
    centre_of_model_m = corners_m.mean(0)
    if is_resting:
        background_m = table()
        poses = resting_path(corners_m, number, speed, generator)
    else:
        background_m = background(generator)
        poses = path(number, speed, generator)
    for k, pose in enumerate(poses):
        truth = Rigid(pose.R, pose.t_m - pose.R @ centre_of_model_m)
        share = k / number
        is_removed = is_within(share, REMOVED)
        is_covered = is_within(share, COVERED)
        object_m = rasterize(truth.apply(corners_m).reshape(-1, 3, 3), K, WIDTH, HEIGHT).depth_m
        is_object = object_m.isfinite() & (object_m < background_m)
        depth_m = background_m if is_removed else torch.where(is_object, object_m, background_m)
        if is_covered or is_within(share, OCCLUDED):
            is_plate = plate_columns(is_object, is_whole=is_covered)
            depth_m = torch.where(is_plate, float(object_m[is_object].min()) - 0.08, depth_m)
        sensor = SyntheticSensorConfig()
        measured_m = simulate_depth(depth_m, (FOCAL_PX, FOCAL_PX), sensor, generator)
        view = ViewInput(
            name=f"{model.name}_{k:04d}",
            depth_m=measured_m.float(),
            K=K.float(),
            mask=torch.ones(HEIGHT, WIDTH, dtype=torch.bool),
            object=model.name,
        )
        yield Frame(view, truth.float(), is_seen=not (is_removed or is_covered))


def is_within(share: float, limits: tuple[float, float]) -> bool:
    """Whether a share of a sequence lies in a part of it."""
    return limits[0] <= share < limits[1]


def plate_columns(is_object: Tensor, *, is_whole: bool) -> Tensor:
    """Compute the pixels of a plate before an object: before all of it, or its left part."""
    column = torch.arange(WIDTH).expand(HEIGHT, WIDTH)
    object_columns = column[is_object].double()
    last = float(object_columns.max()) + 15
    if not is_whole:
        last = min(float(object_columns.quantile(OCCLUDED_SHARE)), last)
    return (column >= object_columns.min() - 15) & (column <= last)


def verdict(
    model: ObjectModel, points_m: Tensor, frame: Frame, estimate: PoseEstimate
) -> tuple[str, float]:
    """Classify an estimate as right, wrong, lost, or rightly none; and its error in diameters."""
    pose = estimate.camera_from_model
    if pose is None:
        return ("lost" if frame.is_seen else "none"), math.nan
    metric = add_m if model.symmetries.is_none else adds_m
    error = float(metric(pose, frame.truth, points_m)) / model.diameter_m
    return ("right" if frame.is_seen and error < RIGHT else "wrong"), error


def delays(frames: Sequence[Frame], verdicts: Sequence[str]) -> tuple[list[int], list[int]]:
    """Count frames from the start of each drop-out to a refusal, from its end to a right answer."""
    until_refusal = list[int]()
    until_right = list[int]()
    for k in range(1, len(frames)):
        if frames[k - 1].is_seen and not frames[k].is_seen:
            until_refusal.append(frames_until("none", verdicts[k:]))
        if frames[k].is_seen and not frames[k - 1].is_seen:
            until_right.append(frames_until("right", verdicts[k:]))
    return until_refusal, until_right


def frames_until(wanted: str, verdicts: Sequence[str]) -> int:
    """Count the frames before the first of a verdict; all if there is none."""
    return verdicts.index(wanted) if wanted in verdicts else len(verdicts)


def track(net: GeoPoseNet, model: ObjectModel, frames: Sequence[Frame]) -> Row:
    """Track the object through the frames, and count verdicts, delays and times."""
    points_m = sample_surface(model, SURFACE_POINTS)[0]
    verdicts = list[str]()
    states = list[str | None]()
    seconds = list[float]()
    errors_percent = list[float]()
    estimates = net.track([frame.view for frame in frames], object=model.name)
    for frame in frames:
        estimate, cpu_s = with_cpu_seconds(lambda: next(estimates))
        answer, error = verdict(model, points_m, frame, estimate)
        verdicts.append(answer)
        states.append(estimate.tracking)
        seconds.append(cpu_s)
        if answer == "right":
            errors_percent.append(100 * error)
    errors_percent.sort()
    tracked_s = sorted(
        cpu_s for cpu_s, state in zip(seconds, states, strict=True) if state == "tracked"
    )
    until_refusal, until_right = delays(frames, verdicts)
    quantiles = None
    if errors_percent:
        count = len(errors_percent)
        quantiles = [round(errors_percent[int(q * count)], 1) for q in (0.5, 0.95)]
    return {
        "object": model.name,
        "frames": len(frames),
        **counts(verdicts),
        "tracked": states.count("tracked"),
        "found": states.count("found"),
        "says so": until_refusal,
        "back": until_right,
        "off": quantiles,
        "ms tracked": round(1000 * tracked_s[len(tracked_s) // 2], 1) if tracked_s else None,
        "frames a second": round(len(frames) / sum(seconds), 1),
    }


def counts(verdicts: Sequence[str]) -> Row:
    """Count verdicts."""
    return {name: verdicts.count(name) for name in ("right", "wrong", "lost", "none")}


def search_each(net: GeoPoseNet, model: ObjectModel, frames: Sequence[Frame]) -> Row:
    """Search every frame without earlier frames, and count verdicts."""
    points_m = sample_surface(model, SURFACE_POINTS)[0]
    estimates, cpu_s = with_cpu_seconds(
        lambda: [net.find(frame.view, objects=model.name)[0] for frame in frames]
    )
    verdicts = [
        verdict(model, points_m, frame, estimate)[0]
        for frame, estimate in zip(frames, estimates, strict=True)
    ]
    return {
        "object": model.name,
        "frames": len(frames),
        **counts(verdicts),
        "frames a second": round(len(frames) / cpu_s, 2),
    }


def main() -> None:
    """Track every object of the weights."""
    parser = make_parser(__doc__)
    parser.add_argument("--weights", nargs="+", default=["parts"])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--objects", nargs="*", help="of the weights; all by default")
    parser.add_argument("--anew", type=int, default=6)
    parser.add_argument("--resting", action="store_true", help="on a table")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for name in options.weights:
        net = GeoPoseNet.load(find_weights(name))
        tracked: list[Row] = []
        searched: list[Row] = []
        for model in net.weights.models:
            if options.objects and model.name not in options.objects:
                continue
            frames = list(
                sequence(
                    model, options.frames, options.speed, options.seed, is_resting=options.resting
                )
            )
            tracked.append(track(net, model, frames))
            print(tracked[-1], flush=True)
            if options.anew:
                every_nth = frames[options.anew // 2 :: options.anew]
                searched.append(search_each(net, model, every_nth))
        print(f"{name}, followed\n{format_markdown_table(tracked)}")
        if searched:
            print(f"{name}, every {options.anew} frames anew\n{format_markdown_table(searched)}")


if __name__ == "__main__":
    main()
