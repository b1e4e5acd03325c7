"""Short rendered sequences of known motion (``bench/tracking.py``), followed by registration.

Section ``tracking`` of ``bench/real.py``. In each sequence the object is partly covered, fully
covered and removed for a while; all take part in choices. Right is an ADD below a tenth of the
diameter. "ok, wrong" counts the `ok` answers that are wrong by ADD-S too, for `ok` holds up to
near-symmetric copies.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from score import RIGHT, Job, Row, Section, surface_points
from shared import with_cpu_seconds
from torch import Tensor
from tracking import Frame, counts, sequence, verdict

from depthpose import Registration
from depthpose.pose.metrics import adds_m
from depthpose.pose.synthetic.parts import make_part
from depthpose.pose.types import ObjectModel, PoseEstimate

PARTS = ("bracket", "flange", "mug")
FRAMES = 20
SPEED = 1.0
SEED = 1


def jobs(samples: Path, seeds: int) -> list[Job]:
    """Follow each part through one sequence."""
    del samples, seeds
    return [partial(follow, name) for name in PARTS]


def follow(name: str) -> list[Row]:
    """Follow one part."""
    model = make_part(name, 1)
    registration = Registration([model])
    registration.prepare()
    frames = list(sequence(model, FRAMES, SPEED, SEED))
    depths_m = [frame.view.depth_m for frame in frames]
    estimates, cpu_s = with_cpu_seconds(
        lambda: list(registration.track(iter(depths_m), frames[0].view.K))
    )
    points_m = surface_points(model)
    verdicts = list[str]()
    ok_and_wrong = 0
    for frame, estimate in zip(frames, estimates, strict=True):
        verdicts.append(verdict(model, points_m, frame, estimate)[0])
        ok_and_wrong += estimate.is_ok and not is_right_by_adds(model, points_m, frame, estimate)
    states = [estimate.tracking for estimate in estimates]
    row = {
        "part": name,
        "use": "choice",
        "frames": len(frames),
        **counts(verdicts),
        "ok, wrong": ok_and_wrong,
        "tracked": states.count("tracked"),
        "found": states.count("found"),
        "CPU s": cpu_s,
    }
    return [row]


def is_right_by_adds(
    model: ObjectModel, points_m: Tensor, frame: Frame, estimate: PoseEstimate
) -> bool:
    """Whether a pose of a visible object is right up to near-symmetric copies."""
    pose = estimate.camera_from_model
    if pose is None or not frame.is_seen:
        return False
    return float(adds_m(pose, frame.truth, points_m)) < RIGHT * model.diameter_m


def table(rows: Sequence[Row]) -> list[Row]:
    """List the parts."""
    return list(rows)


TRACKING = Section("Rendered sequences of 20 frames, followed", jobs, table)
