"""Real images without masks: bins of parts, and whole frames of several objects.

Sections ``bins`` and ``frames`` of ``bench/real.py``. Of the ten bins of elbows, in alphabetical
order, the odd ones may take part in a choice; the even ones, and the bin of tubes, are held back.
All whole frames take part in choices.
"""

from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from find_tables import Frame, Instance, count_answers
from PIL import Image
from real_poses import RealCase
from score import POINTS, RIGHT, Job, Row, Section, add_to_copy
from score_instances import cases
from shared import with_cpu_seconds

from depthpose import Registration
from depthpose.core.camera import project
from depthpose.core.files import read_json
from depthpose.core.rigid import Rigid
from depthpose.pose.mesh import read_model, sample_surface, symmetries_from_bop
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput

MIN_VISIBLE = 0.7
"""An instance of a bin counts if its truth is sure and this share of its silhouette is visible."""
MAX_IGNORED = 0.5
"""An answer with a larger share of its points in a region without truth is not counted."""
BEST = 3
"""Answers of a bin that would be gripped first."""


def bin_jobs(samples: Path, seeds: int) -> list[Job]:
    """Search every bin for its part."""
    del seeds
    home = samples / "pose/bins"
    scenes = [*bins_of(home, "elbows"), *bins_of(home, "tubes")]
    return [partial(search_bin, home, str(scene.relative_to(home))) for scene in scenes]


def bins_of(home: Path, part: str) -> list[Path]:
    """List the bins of one part in alphabetical order."""
    return sorted(path.parent for path in (home / part).glob("*/truth.json"))


def search_bin(home: Path, name: str) -> list[Row]:
    """Find all parts of one bin, and count right answers."""
    scene = home / name
    depth = scene / "depth.png"
    camera = scene / "camera.json"
    registration, model = part_of(scene.parent)
    answers, cpu_s = with_cpu_seconds(lambda: registration.find(depth, camera))
    estimates = [estimate for estimate in answers if estimate.is_posed]

    instances = cast(Any, read_json(scene / "truth.json"))["0"]
    truths = [bop_pose(instance) for instance in instances]
    counted = {
        index
        for index, instance in enumerate(instances)
        if instance["my_status"] == "sure" and instance["visib_fract"] >= MIN_VISIBLE
    }
    K = torch.tensor(cast(Any, read_json(camera))["K"])
    ignored = torch.from_numpy(np.array(Image.open(scene / "ignore.png")) > 0)
    verdicts = [verdict(estimate, truths, model, K, ignored) for estimate in estimates]
    right = {verdict for verdict in verdicts if isinstance(verdict, int)}
    ok_verdicts = [
        verdict for estimate, verdict in zip(estimates, verdicts, strict=True) if estimate.is_ok
    ]
    part = scene.parent.name
    position = [path.name for path in bins_of(home, part)].index(scene.name)
    is_choice = part == "elbows" and position % 2 == 0
    row = {
        "scene": scene.name,
        "set": part,
        "use": "choice" if is_choice else "held",
        "sure": len(counted),
        "right": len(counted & right),
        "answers": len(estimates),
        "wrong": verdicts.count("wrong"),
        "ok": len(ok_verdicts),
        "ok, wrong": ok_verdicts.count("wrong"),
        f"best {BEST} right": sum(isinstance(verdict, int) for verdict in verdicts[:BEST]),
        "CPU s": cpu_s,
    }
    return [row]


def verdict(
    estimate: PoseEstimate,
    truths: Sequence[Rigid],
    model: ObjectModel,
    K: torch.Tensor,
    ignored: torch.Tensor,
) -> int | str:
    """Return the index of the instance that an answer fits, else "wrong" or "ignored"."""
    pose = estimate.camera_from_model
    assert pose is not None
    errors = [add_to_copy(pose, truth, model) for truth in truths]
    if min(errors) < RIGHT:
        return errors.index(min(errors))
    points_m = sample_surface(model, POINTS)[0].to(pose.R)
    pixels = project(pose.apply(points_m), K.to(pose.R))
    column, row = pixels.nan_to_num(-1.0).round().long().unbind(-1)
    height, width = ignored.shape
    is_inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    if not bool(is_inside.any()):
        return "wrong"
    ignored_share = ignored[row[is_inside], column[is_inside]].float().mean()
    return "ignored" if float(ignored_share) > MAX_IGNORED else "wrong"


@cache
def part_of(folder: Path) -> tuple[Registration, ObjectModel]:
    """Prepare the part of bins as a user would; return its model with declared symmetries too."""
    path = next((folder / "models").glob("*.ply"))
    info: Any = read_json(folder / "models/models_info.json")
    declared = symmetries_from_bop(next(iter(info.values())), source="models_info.json")
    registration = Registration.load(path, unit="mm")
    registration.prepare()
    return registration, read_model(path, "mm", symmetries=declared)


def bop_pose(instance: Any) -> Rigid:  # noqa: ANN401  an entry of a JSON file
    """Read a pose of BOP's ``scene_gt.json``."""
    R = torch.tensor(instance["cam_R_m2c"]).double().reshape(3, 3)
    t_mm = torch.tensor(instance["cam_t_m2c"]).double()
    return Rigid(R, t_mm / 1000)


def bin_table(rows: Sequence[Row]) -> list[Row]:
    """List the bins, and add up the halves of the elbows."""
    lines = list[Row]()
    elbows = list[Row]()
    for row in rows:
        line = {column: row[column] for column in row if column != "set"}
        lines.append(line)
        if row["set"] == "elbows":
            elbows.append(line)
    for use in ("choice", "held"):
        lines.append(total(f"elbows, {use}", use, [line for line in elbows if line["use"] == use]))
    return [*lines, total("elbows, all", "", elbows)]


def total(name: str, use: str, rows: Sequence[Row]) -> Row:
    """Add up the numbers of rows."""
    numbers = [key for key in rows[0] if key not in ("scene", "use")] if rows else []
    return {"scene": name, "use": use, **{key: sum(row[key] for row in rows) for key in numbers}}


def frame_jobs(samples: Path, seeds: int) -> list[Job]:
    """Search whole frames for each object alone, then for all of them at once.

    A job is all searches for the same models, which are prepared once for them.
    """
    del seeds
    objects = dict.fromkeys(names_of(frame) for frame in frame_searches(samples))
    return [partial(search_frames, samples, names) for names in objects]


def search_frames(samples: Path, names: tuple[str, ...]) -> list[Row]:
    """Search for some objects in all frames that are searched for just these."""
    frames = [frame for frame in frame_searches(samples) if names_of(frame) == names]
    registration = Registration(frames[0].models)
    registration.prepare()
    return [search_frame(frame, registration) for frame in frames]


def search_frame(frame: Frame, registration: Registration) -> Row:
    """Search one frame, and count right answers."""
    answers, cpu_s = with_cpu_seconds(lambda: registration.find(frame.depth_m, frame.K))
    estimates = [estimate for estimate in answers if estimate.is_posed]
    counts = count_answers(frame, estimates)
    ok = [estimate for estimate in estimates if estimate.is_ok]
    return {
        "search": frame.name,
        "objects": "one" if len(registration.objects) == 1 else "several",
        **{column: counts[column] for column in ("instances", "right", "wrong", "which")},
        "answers": len(estimates),
        "ok": len(ok),
        "ok, wrong": count_answers(frame, ok)["wrong"],
        "cpu_s": cpu_s,
    }


@cache
def frame_searches(samples: Path) -> list[Frame]:
    """List each real frame once for each object that it is searched for, and once for all of them.

    Frames of YCB are searched for the objects of all of these frames together.
    """
    cases_of_frame = dict[str, list[RealCase]]()
    for case in cases(samples).values():
        if isinstance(case.sample.input, ViewInput):
            cases_of_frame.setdefault(case.frame, []).append(case)
    ycb_models = [case.model for name, case in cases(samples).items() if name.startswith("ycb")]
    alone = list[Frame]()
    together = list[Frame]()
    for name, frame_cases in cases_of_frame.items():
        alone += [frame_of(case.name, [case]) for case in frame_cases]
        if len(frame_cases) > 1:
            searched = ycb_models if name.startswith("ycb") else None
            together.append(frame_of(name, frame_cases, searched))
    return alone + together


def frame_of(
    name: str, frame_cases: Sequence[RealCase], searched: list[ObjectModel] | None = None
) -> Frame:
    """Make the frame of some instances of one image, all of which are to be found.

    ``searched`` are the models to search for; None: those of the instances.
    """
    view = frame_cases[0].sample.input
    assert isinstance(view, ViewInput)
    instances = [
        Instance(case.model, case.sample.truth.camera_from_model, True, case.is_symmetric)
        for case in frame_cases
    ]
    return Frame(name, view.depth_m, view.K, instances, searched)


def names_of(frame: Frame) -> tuple[str, ...]:
    """List the names of the objects that a frame is searched for."""
    return tuple(model.name for model in frame.models)


def frame_table(rows: Sequence[Row]) -> list[Row]:
    """Add up the searches for one object, and those for several."""
    lines = list[Row]()
    counts = ("instances", "right", "answers", "wrong", "ok", "ok, wrong")
    for objects in ("one", "several"):
        searches = [row for row in rows if row["objects"] == objects]
        lines.append(
            {
                "objects": objects,
                "use": "choice",
                "searches": len(searches),
                **{column: sum(row[column] for row in searches) for column in counts},
                "CPU s a search": sum(row["cpu_s"] for row in searches) / max(1, len(searches)),
            }
        )
    return lines


BINS = Section("Bins of parts without masks", bin_jobs, bin_table)
FRAMES = Section("Whole frames without masks", frame_jobs, frame_table)
