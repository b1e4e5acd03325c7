"""Cases that users' trials found: what the answer says of itself, and whether that is true.

Rendered parts of awkward shape, in ``reports/third/pose``; its README says what was wrong. All
of them may take part in a choice.

The diameter says little of long parts, whose turns move no point far: right is, beside an ADD below
a tenth of the diameter, a rotation within 10 degrees, half a tooth of the gear.
"""

import math
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from score import RIGHT, Job, Row, Section, surface_points

from depthpose import Registration
from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.metrics import add_m
from depthpose.pose.types import ObjectModel, PoseEstimate

RIGHT_DEG = 10.0


class Case(NamedTuple):
    """An image, the CAD files that are given, and what of the answer is right.

    ``view``: what the files of depth, mask and pose are called. ``is_doubtful``: something is wrong
    with the part or the image, so that an identity that is ``confirmed`` misleads. ``with_mask``:
    else the whole image is searched.
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
    """Pose one case, and say how far off the answer and the nearest of what it names are."""
    is_gear = case.view.startswith("gear")
    camera = home / ("gear_camera.json" if is_gear else "camera.json")
    matrix = np.loadtxt(home / f"{case.view}_{'pose' if is_gear else 'truth'}.txt")
    truth = Rigid(torch.from_numpy(matrix[:3, :3]), torch.from_numpy(matrix[:3, 3]))
    registration = Registration.load(*(home / f"{name}.stl" for name in case.cad), unit="mm")
    registration.prepare()

    depth = home / f"{case.view}_depth.png"
    began = time.process_time()
    if case.with_mask:
        found = [registration.estimate(depth=depth, mask=home / f"{case.view}_mask.png",
                                       camera=camera)]  # fmt: skip
    else:
        found = registration.find(depth, camera)
    cpu_s = time.process_time() - began
    if not found:
        nothing = {"is fair": False, "status": "nothing found"}  # the part is there, in full view
        return [{"case": case.name, **nothing, "CPU s": cpu_s}]

    best = found[0]
    model = next(one for one in registration.models if one.name == best.object)
    errors = case_errors(best, truth, model)
    return [{
        "case": case.name, "is fair": is_fair(case, best, errors), "status": best.status,
        "certainty": best.certainty, **errors,
        "part": best.object if len(case.cad) > 1 else None,
        "identity": None if best.identity is None else best.identity.status,
        "or": None if best.identity is None else best.identity.other,
        "CPU s": cpu_s,
    }]  # fmt: skip


def is_fair(case: Case, best: PoseEstimate, errors: Row) -> bool:
    """Whether an answer misleads nobody: a refusal does not, nor one that names what is true."""
    if best.identity is not None and best.identity.status == "confirmed" and case.is_doubtful:
        return False
    if case.cad == TWINS and TWINS[1] not in (best.object, best.identity and best.identity.other):
        return False
    return not best.is_posed or errors["named"]


def case_errors(estimate: PoseEstimate, truth: Rigid, model: ObjectModel) -> Row:
    """Give the error of the answer, and whether it or an alternative is right."""
    answer = estimate.camera_from_model
    if answer is None:
        return {"mm": None, "deg": None, "right": False, "named": False, "alternatives": 0}
    others = [other.camera_from_model for other in estimate.alternatives]
    errors = [error_of(pose, truth, model) for pose in (answer, *others)]
    right = [mm < 1000 * RIGHT * model.diameter_m and deg < RIGHT_DEG for mm, deg in errors]
    mm, deg = errors[0]
    return {"mm": mm, "deg": deg, "right": right[0], "named": any(right),
            "alternatives": len(others)}  # fmt: skip


def error_of(pose: Rigid, truth: Rigid, model: ObjectModel) -> tuple[float, float]:
    """ADD [mm] and the angle between the rotations [degrees]."""
    add_mm = 1000 * float(add_m(pose, truth, surface_points(model)))
    return add_mm, math.degrees(float(geodesic_rad(pose.R.double(), truth.R.double())))


def table(rows: Sequence[Row]) -> list[Row]:
    """List the cases."""
    names = ("case", "is fair", "status", "certainty", "mm", "deg", "right", "named",
             "alternatives", "part", "identity", "or", "CPU s")  # fmt: skip
    return [{name: row.get(name) for name in names} for row in rows]


REPORTS = Section("Cases that users' trials found (all: choice)", jobs, table)
