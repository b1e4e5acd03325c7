"""Long parts that run out of the image: are they posed where their visible end is?

    python bench/cut_parts.py --views 12

Five of the twenty parts (``bench/twenty_parts.py``) and two profiles with windows, each before a
wall with one end in the image and the other outside, measured by four simulated sensors in turn,
with the exact mask. ICP alone lets such a part slide along itself. A pose is near if its ADD is at
most 12 mm, named if it or one of its alternatives is near.
"""

from collections.abc import Iterator

import numpy as np
import torch
from score_parts import model_of
from score_reports import error_of
from shared import Row, group_rows, make_parser, with_cpu_seconds
from twenty_parts import (
    FOCAL_PX,
    HEIGHT,
    MIN_DISTANCE_M,
    PARTS,
    SENSORS,
    WIDTH,
    K,
    Part,
    PartView,
    render_depth,
    touches_border,
)

from depthpose import Registration
from depthpose.core.camera import project
from depthpose.core.loop import make_sample_generator
from depthpose.core.rigid import Rigid
from depthpose.pose.config import SyntheticSensorConfig
from depthpose.pose.mesh import symmetry_transforms
from depthpose.pose.synthetic.depth_sensors import simulate_depth
from depthpose.pose.synthetic.parts import Mesh, join, make_box, move
from depthpose.pose.synthetic.random_numbers import random_rotation, uniform
from depthpose.pose.types import ObjectModel
from depthpose.report.page import format_markdown_table

Corner = tuple[float, float, float]
NEAR_MM = 12
LENGTH_PX = (700.0, 1000.0)  # of a part in an image of 640 columns
MIN_MASK_PX = 2000
SEED = 0x10C6
MAX_TRIES = 200  # random poses for each view


def place_box(low_mm: Corner, high_mm: Corner) -> Mesh:
    """Make a box between two corners."""
    low = np.array(low_mm, float)
    high = np.array(high_mm, float)
    return move(make_box(tuple(high - low)), tuple((high + low) / 2))


def angle(_: float) -> Mesh:
    """An L profile of 50x30x4 mm, 400 mm long, with a window of 20x35 mm near one end."""
    return join(
        place_box((0, 0, 0), (50, 4, 35)),
        place_box((0, 0, 35), (20, 4, 70)),
        place_box((40, 0, 35), (50, 4, 70)),
        place_box((0, 0, 70), (50, 4, 400)),
        place_box((0, 4, 0), (4, 30, 400)),
    )


def slotted_channel(_: float) -> Mesh:
    """A U profile of 60x40x5 mm, 700 mm long, with a slot near each end, not at equal distances."""
    return join(
        place_box((0, 0, 0), (60, 5, 20)),
        place_box((0, 0, 20), (20, 5, 40)),
        place_box((40, 0, 20), (60, 5, 40)),
        place_box((0, 0, 40), (60, 5, 600)),
        place_box((15, 0, 600), (60, 5, 640)),
        place_box((0, 0, 640), (60, 5, 700)),
        place_box((0, 5, 0), (5, 40, 700)),
        place_box((55, 5, 0), (60, 40, 700)),
    )


LONG_PARTS = {
    name: PARTS[name] for name in ("profile", "channel", "keyed shaft", "flat shaft", "rail")
} | {"angle": Part(angle, 0), "slotted channel": Part(slotted_channel, 0)}


def cut_views(model: ObjectModel, number: int, seed: int) -> Iterator[PartView]:
    """Render views of a part that runs out of the image at one end."""
    vertices_m = model.vertices_m.double()
    middle_m = (vertices_m.amin(0) + vertices_m.amax(0)) / 2
    # The middles of both ends, along the longest side of the box about the part.
    longest = int((vertices_m.amax(0) - vertices_m.amin(0)).argmax())
    ends_m = middle_m.repeat(2, 1)
    ends_m[0, longest] = vertices_m[:, longest].min()
    ends_m[1, longest] = vertices_m[:, longest].max()
    view_count = 0
    for attempt in range(MAX_TRIES * number):
        generator = make_sample_generator(attempt, SEED + seed)
        distance_m = FOCAL_PX * model.diameter_m / uniform(generator, *LENGTH_PX)
        distance_m = max(MIN_DISTANCE_M, distance_m)
        R = random_rotation(generator).double()
        # An end near the middle of the image.
        end_m = ends_m[int(torch.randint(2, (), generator=generator))]
        sideways_m = (torch.rand(2, generator=generator).double() - 0.5) * 0.4 * distance_m
        place_m = torch.cat([sideways_m, torch.tensor([distance_m], dtype=torch.float64)])
        truth = Rigid(R, place_m - R @ end_m)
        posed_ends_m = truth.apply(ends_m)
        if float(posed_ends_m[:, 2].min()) < MIN_DISTANCE_M:
            continue
        column, row = project(posed_ends_m, K).unbind(-1)
        is_inside = (column > 0) & (column < WIDTH) & (row > 0) & (row < HEIGHT)
        part_m = render_depth(model, truth)
        mask = part_m.isfinite()
        if int(is_inside.sum()) != 1 or not touches_border(mask) or int(mask.sum()) < MIN_MASK_PX:
            continue
        wall_m = float(posed_ends_m[:, 2].max()) + 0.3
        scene_m = torch.where(mask, part_m, wall_m).float()
        sensor = SyntheticSensorConfig(kinds=(SENSORS[view_count % len(SENSORS)],))
        depth_m = simulate_depth(scene_m, (FOCAL_PX, FOCAL_PX), sensor, generator)
        yield PartView(depth_m, mask, truth)
        view_count += 1
        if view_count == number:
            return


def pose_views(name: str, number: int) -> list[Row]:
    """Pose views of a part by its file, and measure how near the estimate and all named are."""
    part = LONG_PARTS[name]
    registration = Registration.load(part.as_trimesh(), unit="mm")
    registration.prepare()
    model = model_of(part, is_twin=False)
    symmetries = symmetry_transforms(model.symmetries).double()

    def is_near(pose: Rigid, truth: Rigid) -> bool:
        """Whether a pose is near the true one, up to the symmetries of the part."""
        true_poses = truth @ symmetries
        errors_mm = [error_of(pose, true_poses[k], model)[0] for k in range(len(true_poses.R))]
        return min(errors_mm) <= NEAR_MM

    rows: list[Row] = []
    for view in cut_views(model, number, list(LONG_PARTS).index(name)):
        estimate, cpu_s = with_cpu_seconds(
            lambda view=view: registration.estimate(depth=view.depth_m, mask=view.mask, camera=K)
        )
        poses = [alternative.camera_from_model for alternative in estimate.alternatives]
        best = estimate.camera_from_model
        if best is not None:
            poses.insert(0, best)
        is_named = any(is_near(pose, view.truth) for pose in poses)
        rows.append(
            {
                "part": name,
                "posed": best is not None,
                "near": best is not None and is_near(best, view.truth),
                "named": is_named,
                "ok": estimate.is_ok,
                "ok, not named": estimate.is_ok and not is_named,
                "cpu_s": cpu_s,
            }
        )
    return rows


def count(name: str, rows: list[Row]) -> Row:
    """Count the views of a part."""
    columns = ("posed", "near", "named", "ok", "ok, not named")
    counts = {column: sum(row[column] for row in rows) for column in columns}
    cpu_s = sum(row["cpu_s"] for row in rows) / max(1, len(rows))
    return {"part": name, "views": len(rows), **counts, "CPU s": round(cpu_s, 2)}


def main() -> None:
    """Pose all views, and print the counts of each part and of all."""
    parser = make_parser(__doc__)
    parser.add_argument("--views", type=int, default=12, help="of each part")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = [row for name in LONG_PARTS for row in pose_views(name, options.views)]
    lines = [count(name, part_rows) for (name,), part_rows in group_rows(rows, "part").items()]
    print(format_markdown_table([*lines, count("all", rows)]))


if __name__ == "__main__":
    main()
