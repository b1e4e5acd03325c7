"""Cases that users reported: whether status, identity and alternatives of the answer are true.

Section ``reports`` of ``bench/real.py``: rendered parts of awkward shape, in
``reports/third/pose``, whose README describes each problem. All of them may take part in a choice.

A long part can be far rotated though its ADD is small beside its diameter. So a pose is right if
its ADD is below a tenth of the diameter and its rotation within 10 degrees, half a tooth of the
gear.
"""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from score import RIGHT, Job, Row, Section, surface_points
from shared import with_cpu_seconds

from depthpose import Registration
from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.metrics import add_m
from depthpose.pose.types import ObjectModel, PoseEstimate

RIGHT_DEG = 10.0


class Case(NamedTuple):
    """An image and the CAD files by which it is searched.

    ``view``: prefix of the files of depth, mask and pose. ``is_doubtful``: the part or the image
    is not what the CAD file and the camera say, so that a ``confirmed`` identity misleads. Without
    a mask the whole image is searched.
    """

    name: str
    view: str
    cad: tuple[str, ...]
    is_doubtful: bool = False
    with_mask: bool = True


TWINS = ("B_twin_other", "B_twin_real")
CASES = (
    Case("A1 profile", "A1_profile", ("A1_profile",)),
    Case("A2 stray body", "A2_stray_body", ("A2_stray_body",)),
    Case("A3 keyed shaft", "A3_keyed_shaft", ("A3_keyed_shaft",)),
    Case("B the twin's file", "B_twin", TWINS[:1], is_doubtful=True),
    Case("B both files", "B_twin", TWINS),
    Case("B both, no mask", "B_twin", TWINS, with_mask=False),
    Case("E depth along the ray", "E_radial", ("clamp",), is_doubtful=True),
    *(Case(f"gear {k}", f"gear_{k}", ("gear",)) for k in range(3)),
)


def jobs(samples: Path, seeds: int) -> list[Job]:
    """Pose every case once."""
    del seeds
    home = samples / "reports/third/pose"
    return [partial(pose_case, home, case) for case in CASES]


def pose_case(home: Path, case: Case) -> list[Row]:
    """Pose one case, and measure the answer and its alternatives."""
    is_gear = case.view.startswith("gear")
    camera = home / ("gear_camera.json" if is_gear else "camera.json")
    matrix = np.loadtxt(home / f"{case.view}_{'pose' if is_gear else 'truth'}.txt")
    truth = Rigid(torch.from_numpy(matrix[:3, :3]), torch.from_numpy(matrix[:3, 3]))
    registration = Registration.load(*(home / f"{name}.stl" for name in case.cad), unit="mm")
    registration.prepare()

    depth = home / f"{case.view}_depth.png"
    mask = home / f"{case.view}_mask.png"

    def search() -> list[PoseEstimate]:
        if case.with_mask:
            return [registration.estimate(depth=depth, mask=mask, camera=camera)]
        answers = registration.find(depth, camera)
        return [estimate for estimate in answers if estimate.is_posed]

    estimates, cpu_s = with_cpu_seconds(search)
    if not estimates:  # though the part is in full view
        return [{"case": case.name, "is fair": False, "status": "nothing found", "CPU s": cpu_s}]

    best = estimates[0]
    model = next(model for model in registration.models if model.name == best.object)
    errors = case_errors(best, truth, model)
    row = {
        "case": case.name,
        "is fair": is_fair(case, best, errors),
        "status": best.status,
        "certainty": best.certainty,
        **errors,
        "part": best.object if len(case.cad) > 1 else None,
        "identity": None if best.identity is None else best.identity.status,
        "or": None if best.identity is None else best.identity.other,
        "CPU s": cpu_s,
    }
    return [row]


def is_fair(case: Case, best: PoseEstimate, errors: Row) -> bool:
    """Whether an answer misleads nobody: it is a refusal, or it names the true pose and part."""
    identity = best.identity
    if identity is not None and identity.status == "confirmed" and case.is_doubtful:
        return False
    if case.cad == TWINS:
        named_parts = (best.object, identity and identity.other)
        if TWINS[1] not in named_parts:
            return False
    return not best.is_posed or errors["named"]


def case_errors(estimate: PoseEstimate, truth: Rigid, model: ObjectModel) -> Row:
    """Compute the error of the answer, and whether it or an alternative is right."""
    best = estimate.camera_from_model
    if best is None:
        return {"mm": None, "deg": None, "right": False, "named": False, "alternatives": 0}
    alternatives = [alternative.camera_from_model for alternative in estimate.alternatives]
    errors = [error_of(pose, truth, model) for pose in (best, *alternatives)]
    max_error_mm = 1000 * RIGHT * model.diameter_m
    is_right = [mm < max_error_mm and deg < RIGHT_DEG for mm, deg in errors]
    best_mm, best_deg = errors[0]
    return {
        "mm": best_mm,
        "deg": best_deg,
        "right": is_right[0],
        "named": any(is_right),
        "alternatives": len(alternatives),
    }


def error_of(pose: Rigid, truth: Rigid, model: ObjectModel) -> tuple[float, float]:
    """Compute ADD [mm] and the angle between the rotations [degrees]."""
    add_mm = 1000 * float(add_m(pose, truth, surface_points(model)))
    angle_rad = float(geodesic_rad(pose.R.double(), truth.R.double()))
    return add_mm, math.degrees(angle_rad)


def table(rows: Sequence[Row]) -> list[Row]:
    """List the cases."""
    columns = ("case", "is fair", "status", "certainty", "mm", "deg", "right", "named",
               "alternatives", "part", "identity", "or", "CPU s")  # fmt: skip
    return [{column: row.get(column) for column in columns} for row in rows]


REPORTS = Section("Cases that users' trials found (all: choice)", jobs, table)
