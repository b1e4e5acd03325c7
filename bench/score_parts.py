"""Twenty parts of awkward shape (``bench/twenty_parts.py``), and each one's file on its twin.

Right is an ADD below a tenth of the diameter and a rotation within 15 degrees, of toothed parts
within half a tooth; it may be `ok` or `ambiguous`. Twins are shown from sides where the two differ
by 12 mm and more. Ten of the parts take part in choices, ten are held back.
"""

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from score import RIGHT, Job, Row, Section
from score_reports import error_of
from twenty_parts import PARTS, K, Part, PartView, views

from depthpose import Registration
from depthpose.core.rigid import Rigid
from depthpose.pose.mesh import declare_symmetry, read_model, symmetry_transforms
from depthpose.pose.types import ObjectModel

VIEWS = 20
TWIN_VIEWS = 4
SURE = 0.9  # probability of one of the copies


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
    rows = [pose_view(registration, view, model, part) for view in part_views]
    twin_rows = [pose_view(registration, view, twin, part) for view in twin_views]
    facts = {"part": name, "is_held": part.is_held}
    return [
        *({**facts, "is_twin": False, "view": k, **row} for k, row in enumerate(rows)),
        *({**facts, "is_twin": True, "view": k, **row} for k, row in enumerate(twin_rows)),
    ]


def model_of(part: Part, *, is_twin: bool) -> ObjectModel:
    """Give the model of a part or of its twin, with the symmetries that its true surface has."""
    model = read_model(part.as_trimesh(is_twin=is_twin), "mm", number=1)
    return model if part.symmetry is None else declare_symmetry(model, part.symmetry)


def pose_view(registration: Registration, view: PartView, shown: ObjectModel, part: Part) -> Row:
    """Pose one view, and say whether the estimate or an alternative is right."""
    began = time.process_time()
    estimate = registration.estimate(depth=view.depth_m, mask=view.mask, camera=K)
    cpu_s = time.process_time() - began
    best = estimate.camera_from_model
    alternatives = [other.camera_from_model for other in estimate.alternatives]
    is_right = best is not None and is_right_pose(best, view.truth, shown, part.right_deg)
    return {
        "status": estimate.status, "certainty": estimate.certainty,
        "copy_certainty": estimate.copy_certainty, "reason": estimate.reason,
        "right": is_right,
        "named": is_right or any(
            is_right_pose(pose, view.truth, shown, part.right_deg) for pose in alternatives
        ),
        "identity": None if estimate.identity is None else estimate.identity.status,
        "cpu_s": cpu_s,
    }  # fmt: skip


def is_right_pose(pose: Rigid, truth: Rigid, model: ObjectModel, right_deg: float) -> bool:
    """Whether a pose is right, up to the symmetries of the part."""
    copies = truth.double() @ symmetry_transforms(model.symmetries).double()
    errors = (error_of(pose, copies[k], model) for k in range(len(copies.R)))
    return any(mm < 1000 * RIGHT * model.diameter_m and deg < right_deg for mm, deg in errors)


def table(rows: Sequence[Row]) -> list[Row]:
    """Count by part, and by whether it takes part in a choice."""
    names = dict.fromkeys(row["part"] for row in rows)
    lines = [line(name, [row for row in rows if row["part"] == name]) for name in names]
    chosen = [row for row in rows if not row["is_held"]]
    held = [row for row in rows if row["is_held"]]
    return [*lines, line("all of choice", chosen), line("all held back", held)]


def line(name: str, rows: Sequence[Row]) -> Row:
    """Count what is right, named, sure, and sure and wrong."""
    twins = [row for row in rows if row["is_twin"]]
    shown = [row for row in rows if not row["is_twin"]]
    sure = [row for row in shown if row["status"] == "ok"]
    sure_copies = [row for row in shown if (row["copy_certainty"] or 0) >= SURE]
    return {
        "part": name, "views": len(shown), "right": sum(row["right"] for row in shown),
        "named": sum(row["named"] for row in shown), "ok": len(sure),
        "ok, not named": sum(not row["named"] for row in sure),
        "copy sure": len(sure_copies),
        "copy sure, wrong": sum(not row["right"] for row in sure_copies),
        "refused": sum(row["certainty"] is None for row in shown),
        "confirmed": sum(row["identity"] == "confirmed" for row in shown),
        "twins": len(twins), "twin confirmed": sum(row["identity"] == "confirmed" for row in twins),
    }  # fmt: skip


PART_SHAPES = Section(
    "Twenty parts, long, thin, toothed, nearly symmetric; exact masks", jobs, table
)
