"""Real images without masks: bins of parts, and whole frames of several objects.

Of the ten bins of elbows, in alphabetical order, the odd ones may take part in a choice; the even
ones, and the bin of tubes, are held back from it. All whole frames have been looked at.
"""

import time
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from find_tables import Frame, Instance, count_answers
from PIL import Image
from real_poses import RealCase
from score import POINTS, RIGHT, Job, Row, Section, add_to_copy
from score_instances import cases

from depthpose import Registration
from depthpose.core.camera import project
from depthpose.core.files import read_json
from depthpose.core.rigid import Rigid
from depthpose.pose.mesh import read_model, sample_surface, symmetries_from_bop
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput

SURE_VISIBLE = 0.7
"""An instance of a bin counts where its truth is sure and so much of its silhouette is visible."""
IGNORED = 0.5
"""An answer with so many of its points in a region without truth is neither right nor wrong."""
BEST = 3
"""So many answers of a bin would be gripped first."""


def bin_jobs(samples: Path, seeds: int) -> list[Job]:
    """Search every bin for its part."""
    del seeds
    home = samples / "pose/bins"
    return [partial(search_bin, home, str(scene.relative_to(home)))
            for scene in [*bins_of(home, "elbows"), *bins_of(home, "tubes")]]  # fmt: skip


def bins_of(home: Path, part: str) -> list[Path]:
    """List the bins of one part in alphabetical order."""
    return sorted(path.parent for path in (home / part).glob("*/truth.json"))


def search_bin(home: Path, name: str) -> list[Row]:
    """Find all parts of one bin, and count what is right."""
    scene = home / name
    registration, model = part_of(scene.parent)
    depth, camera = scene / "depth.png", scene / "camera.json"
    began = time.process_time()
    found = registration.find(depth, camera)
    cpu_s = time.process_time() - began

    facts: Any = read_json(scene / "truth.json")
    truths = [bop_pose(fact) for fact in facts["0"]]
    counted = {k for k, fact in enumerate(facts["0"])
               if fact["my_status"] == "sure" and fact["visib_fract"] >= SURE_VISIBLE}  # fmt: skip
    lens: Any = read_json(camera)
    ignored = torch.from_numpy(np.array(Image.open(scene / "ignore.png")) > 0)
    verdicts = [verdict(one, truths, model, torch.tensor(lens["K"]), ignored) for one in found]
    right = {verdict for verdict in verdicts if isinstance(verdict, int)}
    sure = [verdict for one, verdict in zip(found, verdicts, strict=True) if one.is_ok]
    number = [path.name for path in bins_of(home, scene.parent.name)].index(scene.name)
    is_choice = scene.parent.name == "elbows" and number % 2 == 0
    return [{
        "scene": scene.name, "set": scene.parent.name, "use": "choice" if is_choice else "held",
        "sure": len(counted), "right": len(counted & right), "answers": len(found),
        "wrong": verdicts.count("wrong"), "ok": len(sure), "ok, wrong": sure.count("wrong"),
        f"best {BEST} right": sum(isinstance(verdict, int) for verdict in verdicts[:BEST]),
        "CPU s": cpu_s,
    }]  # fmt: skip


def verdict(
    estimate: PoseEstimate,
    truths: Sequence[Rigid],
    model: ObjectModel,
    K: torch.Tensor,
    ignored: torch.Tensor,
) -> int | str:
    """Give the number of the instance that an answer fits; else whether it is wrong or ignored."""
    pose = estimate.camera_from_model
    assert pose is not None
    errors = [add_to_copy(pose, truth, model) for truth in truths]
    if min(errors) < RIGHT:
        return errors.index(min(errors))
    pixels = project(pose.apply(sample_surface(model, POINTS)[0].to(pose.R)), K.to(pose.R))
    column, row = pixels.nan_to_num(-1.0).round().long().unbind(-1)
    height, width = ignored.shape
    is_inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    share = ignored[row[is_inside], column[is_inside]].float().mean()
    return "ignored" if bool(is_inside.any()) and float(share) > IGNORED else "wrong"


@cache
def part_of(folder: Path) -> tuple[Registration, ObjectModel]:
    """Prepare the part of bins as a user would, and give its model as its data set declares it."""
    path = next((folder / "models").glob("*.ply"))
    info: Any = read_json(folder / "models/models_info.json")
    declared = symmetries_from_bop(next(iter(info.values())), source="models_info.json")
    registration = Registration.load(path, unit="mm")
    registration.prepare()
    return registration, read_model(path, "mm", symmetries=declared)


def bop_pose(fact: Any) -> Rigid:  # noqa: ANN401  an entry of a JSON file
    """Read a pose of BOP's ``scene_gt.json``."""
    R = torch.tensor(fact["cam_R_m2c"]).double().reshape(3, 3)
    return Rigid(R, torch.tensor(fact["cam_t_m2c"]).double() / 1000)


def bin_table(rows: Sequence[Row]) -> list[Row]:
    """List the bins, and add up the halves of the elbows."""
    lines = [{name: row[name] for name in row if name != "set"} for row in rows]
    elbows = [line for row, line in zip(rows, lines, strict=True) if row["set"] == "elbows"]
    for use in ("choice", "held"):
        some = [line for line in elbows if line["use"] == use]
        lines.append(total(f"elbows, {use}", use, some))
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
    asked = dict.fromkeys(names_of(part) for part in frame_searches(samples))
    return [partial(search_frames, samples, names) for names in asked]


def search_frames(samples: Path, names: tuple[str, ...]) -> list[Row]:
    """Search the frames that may show some objects for them."""
    wanted = [part for part in frame_searches(samples) if names_of(part) == names]
    registration = Registration(wanted[0].models)
    registration.prepare()
    return [search_frame(part, registration) for part in wanted]


def search_frame(frame: Frame, registration: Registration) -> Row:
    """Search one frame, and count what is right."""
    began = time.process_time()
    found = registration.find(frame.depth_m, frame.K)
    cpu_s = time.process_time() - began
    counts = count_answers(frame, found)
    sure = [one for one in found if one.is_ok]
    return {
        "search": frame.name, "objects": "one" if len(registration.objects) == 1 else "several",
        **{key: counts[key] for key in ("instances", "right", "wrong", "which")},
        "answers": len(found), "ok": len(sure), "ok, wrong": count_answers(frame, sure)["wrong"],
        "cpu_s": cpu_s,
    }  # fmt: skip


@cache
def frame_searches(samples: Path) -> list[Frame]:
    """Give each real frame once for each object that is searched alone, and once for all of them.

    In both frames of YCB the objects of both are searched together.
    """
    by_frame = dict[str, list[RealCase]]()
    for case in cases(samples).values():
        if isinstance(case.sample.input, ViewInput):
            by_frame.setdefault(case.frame, []).append(case)
    ycb = [case.model for name, case in cases(samples).items() if name.startswith("ycb")]
    alone = [frame_of(case.name, [case]) for some in by_frame.values() for case in some]
    together = [frame_of(name, some, ycb if name.startswith("ycb") else None)
                for name, some in by_frame.items() if len(some) > 1]  # fmt: skip
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
    for objects in ("one", "several"):
        some = [row for row in rows if row["objects"] == objects]
        counts = ("instances", "right", "answers", "wrong", "ok", "ok, wrong")
        lines.append({
            "objects": objects, "use": "choice", "searches": len(some),
            **{key: sum(row[key] for row in some) for key in counts},
            "CPU s a search": sum(row["cpu_s"] for row in some) / max(1, len(some)),
        })  # fmt: skip
    return lines


BINS = Section("Bins of parts without masks", bin_jobs, bin_table)
FRAMES = Section("Whole frames without masks", frame_jobs, frame_table)
