"""Short rendered sequences of known motion (``bench/tracking.py``), followed by registration.

In each the object is covered in part, covered wholly and removed for a while. Rendered, and looked
at while tracking was developed: choice. Right is an ADD below a tenth of the diameter; wrong and
`ok` is what is not right by ADD-S either, for `ok` holds up to near-symmetric copies.
"""

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from score import Job, Row, Section, surface_points
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
    began = time.process_time()
    found = list(registration.track((frame.view.depth_m for frame in frames), frames[0].view.K))
    cpu_s = time.process_time() - began
    points_m = surface_points(model)
    said = [verdict(model, points_m, frame, estimate)[0]
            for frame, estimate in zip(frames, found, strict=True)]  # fmt: skip
    is_wrong = [estimate.is_ok and not is_right_by_adds(model, points_m, frame, estimate)
                for frame, estimate in zip(frames, found, strict=True)]  # fmt: skip
    kinds = [estimate.tracking for estimate in found]
    return [{
        "part": name, "use": "choice", "frames": len(frames), **counts(said),
        "ok, wrong": sum(is_wrong), "tracked": kinds.count("tracked"),
        "found": kinds.count("found"), "CPU s": cpu_s,
    }]  # fmt: skip


def is_right_by_adds(
    model: ObjectModel, points_m: Tensor, frame: Frame, estimate: PoseEstimate
) -> bool:
    """Whether a pose of a visible object is right up to near-symmetric copies."""
    pose = estimate.camera_from_model
    if pose is None or not frame.is_seen:
        return False
    return float(adds_m(pose, frame.truth, points_m)) < 0.1 * model.diameter_m


def table(rows: Sequence[Row]) -> list[Row]:
    """List the parts."""
    return list(rows)


TRACKING = Section("Rendered sequences of 20 frames, followed", jobs, table)
