"""Twenty parts of awkward shape (``bench/twenty_parts.py``), and each one's file on its twin.

Right is, beside an ADD below a tenth of the diameter, a rotation within 15 degrees, or half a
tooth. Twins are shown from sides where they look different by more than the sensor's noise. Ten of
the parts take part in a choice, ten are held back.
"""

import math
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from score import RIGHT, Job, Row, Section, surface_points
from twenty_parts import PARTS, K, views

from depthpose import Registration
from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.mesh import declare_symmetry, read_model, symmetry_transforms
from depthpose.pose.metrics import add_m, adds_m
from depthpose.pose.types import ObjectModel

VIEWS = 20
TWIN_VIEWS = 4


def jobs(samples: Path, seeds: int) -> list[Job]:
    """Pose views of each part by its own file, and of its twin by the same file."""
    del samples
    return [partial(pose_part, name, seeds) for name in PARTS]


def pose_part(name: str, seeds: int) -> list[Row]:
    """Pose views of a part, then of its twin."""
    part = PARTS[name]
    registration = Registration.load(part.as_trimesh(), unit="mm")
    registration.prepare()
    own = read_model(part.as_trimesh(), "mm", number=1)
    rows = list[Row]()
    for is_twin, number in ((False, VIEWS * seeds), (True, TWIN_VIEWS * seeds)):
        shown = read_model(part.as_trimesh(is_twin=is_twin), "mm", number=1)
        if part.symmetry is not None:
            shown = declare_symmetry(shown, part.symmetry)
        seed = 2 * list(PARTS).index(name) + is_twin
        for view_number, view in enumerate(views(shown, number, seed, own if is_twin else None)):
            began = time.process_time()
            estimate = registration.estimate(depth=view.depth_m, mask=view.mask, camera=K)
            cpu_s = time.process_time() - began
            poses = [other.camera_from_model for other in estimate.alternatives]
            if estimate.camera_from_model is not None:
                poses.insert(0, estimate.camera_from_model)
            right = [is_right_pose(pose, view.truth, shown, part.right_deg) for pose in poses]
            rows.append({
                "part": name, "view": view_number, "is_twin": is_twin, "is_held": part.is_held,
                "status": estimate.status, "certainty": estimate.certainty,
                "copy_certainty": estimate.copy_certainty, "reason": estimate.reason,
                "right": bool(right) and right[0], "named": any(right),
                "identity": None if estimate.identity is None else estimate.identity.status,
                "cpu_s": cpu_s,
            })  # fmt: skip
    return rows


def is_right_pose(pose: Rigid, truth: Rigid, model: ObjectModel, right_deg: float) -> bool:
    """Whether a pose is right up to the symmetries of the part."""
    points_m = surface_points(model)
    if model.symmetries.continuous:
        axis = model.symmetries.continuous[0].direction.double()
        tilt_rad = ((pose.R.double() @ axis) @ (truth.R.double() @ axis)).clamp(-1, 1).arccos()
        error_m = adds_m(pose, truth, points_m)
        return (
            float(error_m) < RIGHT * model.diameter_m and math.degrees(float(tilt_rad)) < right_deg
        )
    copies = truth.double() @ symmetry_transforms(model.symmetries).double()
    return any(
        float(add_m(pose, copies[k], points_m)) < RIGHT * model.diameter_m
        and math.degrees(float(geodesic_rad(pose.R.double(), copies[k].R))) < right_deg
        for k in range(len(copies.R))
    )


def table(rows: Sequence[Row]) -> list[Row]:
    """Count by part, and by whether it takes part in a choice."""
    names = dict.fromkeys(row["part"] for row in rows)
    lines = [line(name, [row for row in rows if row["part"] == name]) for name in names]
    chosen = [row for row in rows if not row["is_held"]]
    held = [row for row in rows if row["is_held"]]
    return [*lines, line("all of choice", chosen), line("all held back", held)]


def line(name: str, rows: Sequence[Row]) -> Row:
    """Count what is right, named, sure, and sure and wrong."""
    own = [row for row in rows if not row["is_twin"]]
    twins = [row for row in rows if row["is_twin"]]
    sure = [row for row in own if row["status"] == "ok"]
    surely_copy = [row for row in own if (row["copy_certainty"] or 0) >= 0.9]
    return {
        "part": name, "views": len(own), "right": sum(row["right"] for row in own),
        "named": sum(row["named"] for row in own), "ok": len(sure),
        "ok, not named": sum(not row["named"] for row in sure),
        "copy sure": len(surely_copy),
        "copy sure, wrong": sum(not row["right"] for row in surely_copy),
        "refused": sum(row["certainty"] is None for row in own),
        "twins": len(twins), "twin confirmed": sum(row["identity"] == "confirmed" for row in twins),
    }  # fmt: skip


PART_SHAPES = Section(
    "Twenty parts, long, thin, toothed, nearly symmetric; exact masks", jobs, table
)
