"""Twenty parts of awkward shape (``bench/twenty_parts.py``), and each part's file on its twin.

Section ``parts`` of ``bench/real.py``. A pose is right if its ADD is below a tenth of the diameter
and its rotation within 15 degrees, of toothed parts within half a tooth; its status may be `ok` or
`ambiguous`. Twins are shown from sides where the two differ by 12 mm and more. Ten of the parts
take part in choices, ten are held back.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from score import RIGHT, Job, Row, Section
from score_reports import error_of
from shared import group_rows, with_cpu_seconds
from twenty_parts import PARTS, K, Part, PartView, views

from depthpose import Registration
from depthpose.core.rigid import Rigid
from depthpose.pose.mesh import declare_symmetry, read_model, symmetry_transforms
from depthpose.pose.types import ObjectModel

VIEWS = 20
TWIN_VIEWS = 4
SURE = 0.9  # least probability of a copy that is sure


def jobs(samples: Path, seeds: int) -> list[Job]:
    """Pose views of each part by its own file, and of its twin by the same file."""
    del samples
    return [partial(pose_part, name, seeds) for name in PARTS]


def pose_part(name: str, seeds: int) -> list[Row]:
    """Pose views of a part, then of its twin, by the part's file."""
    part = PARTS[name]
    registration = Registration.load(part.as_trimesh(), unit="mm")
    registration.prepare()
    model = model_of(part, is_twin=False)
    twin = model_of(part, is_twin=True)
    seed = 2 * list(PARTS).index(name)
    part_views = views(model, VIEWS * seeds, seed)
    twin_views = views(twin, TWIN_VIEWS * seeds, seed + 1, unlike=model)
    facts = {"part": name, "is_held": part.is_held}
    rows = list[Row]()
    for is_twin, shown, shown_views in ((False, model, part_views), (True, twin, twin_views)):
        for index, view in enumerate(shown_views):
            row = pose_view(registration, view, shown, part)
            rows.append({**facts, "is_twin": is_twin, "view": index, **row})
    return rows


def model_of(part: Part, *, is_twin: bool) -> ObjectModel:
    """Make the model of a part or of its twin, with the symmetries of its true surface."""
    model = read_model(part.as_trimesh(is_twin=is_twin), "mm", number=1)
    if part.symmetry is None:
        return model
    return declare_symmetry(model, part.symmetry)


def pose_view(registration: Registration, view: PartView, shown: ObjectModel, part: Part) -> Row:
    """Pose one view, and measure whether the estimate or an alternative is right."""

    def is_right(pose: Rigid) -> bool:
        return is_right_pose(pose, view.truth, shown, part.right_deg)

    estimate, cpu_s = with_cpu_seconds(
        lambda: registration.estimate(depth=view.depth_m, mask=view.mask, camera=K)
    )
    best = estimate.camera_from_model
    is_best_right = best is not None and is_right(best)
    alternatives = [alternative.camera_from_model for alternative in estimate.alternatives]
    return {
        "status": estimate.status,
        "certainty": estimate.certainty,
        "copy_certainty": estimate.copy_certainty,
        "reason": estimate.reason,
        "right": is_best_right,
        "named": is_best_right or any(map(is_right, alternatives)),
        "identity": None if estimate.identity is None else estimate.identity.status,
        "cpu_s": cpu_s,
    }


def is_right_pose(pose: Rigid, truth: Rigid, model: ObjectModel, right_deg: float) -> bool:
    """Whether a pose is right, up to the symmetries of the part."""
    true_poses = truth.double() @ symmetry_transforms(model.symmetries).double()
    max_error_mm = 1000 * RIGHT * model.diameter_m
    for k in range(len(true_poses.R)):
        error_mm, error_deg = error_of(pose, true_poses[k], model)
        if error_mm < max_error_mm and error_deg < right_deg:
            return True
    return False


def table(rows: Sequence[Row]) -> list[Row]:
    """Count by part, and by whether it takes part in a choice."""
    lines = [line(part, part_rows) for (part,), part_rows in group_rows(rows, "part").items()]
    choice = [row for row in rows if not row["is_held"]]
    held = [row for row in rows if row["is_held"]]
    return [*lines, line("all of choice", choice), line("all held back", held)]


def line(name: str, rows: Sequence[Row]) -> Row:
    """Count what is right, named, sure, and sure and wrong."""
    twins = [row for row in rows if row["is_twin"]]
    shown = [row for row in rows if not row["is_twin"]]
    sure = [row for row in shown if row["status"] == "ok"]
    sure_copies = [row for row in shown if (row["copy_certainty"] or 0) >= SURE]
    return {
        "part": name,
        "views": len(shown),
        "right": sum(row["right"] for row in shown),
        "named": sum(row["named"] for row in shown),
        "ok": len(sure),
        "ok, not named": sum(not row["named"] for row in sure),
        "copy sure": len(sure_copies),
        "copy sure, wrong": sum(not row["right"] for row in sure_copies),
        "refused": sum(row["certainty"] is None for row in shown),
        "confirmed": sum(row["identity"] == "confirmed" for row in shown),
        "twins": len(twins),
        "twin confirmed": sum(row["identity"] == "confirmed" for row in twins),
    }


PART_SHAPES = Section(
    "Twenty parts, long, thin, toothed, nearly symmetric; exact masks", jobs, table
)
