"""``depthpose pose predict`` of depth images without masks."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from depthpose.cli.pose.inputs import Unreadable, camera_facts, frame_jobs
from depthpose.cli.pose.methods import PoseMethod
from depthpose.cli.pose.page import write_pose_page
from depthpose.cli.pose.predicting import claim, is_result_of, say_result, unread, write_files
from depthpose.core.errors import InputError
from depthpose.core.run import find_rank
from depthpose.pose.config import Unit
from depthpose.pose.estimator.find import explained_mask, nothing_found
from depthpose.pose.estimator.prepare import AnyInput
from depthpose.pose.predictions import (
    Job,
    Prediction,
    is_finished,
    kept_predictions,
    write_predictions,
)
from depthpose.pose.types import PoseEstimate, ViewInput


def find_all(
    method: PoseMethod,
    depth: Path,
    camera: Path,
    objects: tuple[str, ...],
    unit: Unit | None,
    out: Path,
) -> int:
    """Find objects in every depth image, write the files of each, and give the exit code.

    What is found in NAME is called NAME_0, NAME_1, ...; an image where nothing is found has one
    entry, NAME, that says so. A rerun goes on where it was, and reads again what could not be read.

    Raises:
        InputError: weights that take no clouds, several processes, ``--register-refused``, or two
            images of one name.
    """
    _refuse_unable(method)
    jobs = frame_jobs(depth, camera, objects[0], unit, out)
    _refuse_numbered(jobs)
    facts = camera_facts(camera) | ({} if unit is None else {"unit": unit})
    settings = {**method.settings, "find": sorted(objects), **facts}
    claim(out, settings, jobs, depth, is_result_of)
    found = _find_left(jobs, objects, method, out)
    claim(out, settings, [job for _, job in found], depth, is_result_of)
    return _write(found, method, out)


def _find_left(
    jobs: Sequence[Job[Any]], objects: tuple[str, ...], method: PoseMethod, out: Path
) -> list[tuple[Prediction, Job[Any]]]:
    """Search the images of which no earlier run left a result; all are written after each."""
    left = [p for p in kept_predictions(out) if is_finished(p)]
    found: list[tuple[Prediction, Job[Any]]] = []
    for job in tqdm(jobs, disable=None, unit=" images"):
        own = [p for p in left if is_result_of(p.estimate.name, job.name)]
        left = [p for p in left if p not in own]
        found += [(p, explained_job(job, p.estimate, method)) for p in own] or list(
            _find(method, job, objects)
        )
        write_predictions(out, [*(prediction for prediction, _ in found), *left])
    return found


def _refuse_numbered(jobs: Sequence[Job[Any]]) -> None:
    names = {job.name for job in jobs}
    for name in sorted(names):
        if (plain := re.sub(r"_\d+$", "", name)) != name and plain in names:
            raise InputError(
                f"two depth images are called {plain!r} and {name!r}, and so would be what is "
                "found in the first; rename one"
            )


def _refuse_unable(method: PoseMethod) -> None:
    if method.find is None:
        raise InputError("--depth without --mask: these weights need masked views; give --mask")
    if method.settings["estimate"]["register_refused"]:
        raise InputError(
            "--register-refused: without a mask the object is searched for and may not be there, "
            "and nothing is registered then; omit it, or give --mask"
        )
    if find_rank().world > 1:
        raise InputError("--depth without --mask is done by one process; give --mask, or start one")


def _write(found: list[tuple[Prediction, Job[Any]]], method: PoseMethod, out: Path) -> int:
    """Write what was found, files and a page of what was answered; give the exit code."""
    predictions = [prediction for prediction, _ in found]
    answered = [pair for pair in found if pair[0].estimate.is_posed]
    answers, own = [prediction for prediction, _ in answered], [job for _, job in answered]
    write_files(answers, own, out, method)
    write_pose_page(out, answers, own, method)
    return say_result(predictions, out)


def _find(
    method: PoseMethod, job: Job[Any], objects: tuple[str, ...]
) -> Iterator[tuple[Prediction, Job[Any]]]:
    assert method.find is not None
    view = job.read()
    if isinstance(view, Unreadable):
        yield Prediction(estimate=unread(view)), job
        return
    for one in method.find(view, objects) or [nothing_found(view, ", ".join(objects))]:
        yield Prediction(estimate=one), explained_job(job, one, method)


def explained_job(job: Job[Any], estimate: PoseEstimate, method: PoseMethod) -> Job[Any]:
    """Take what was found in a whole depth image as if a mask had given it."""
    model = next((m for m in method.models if m.name == estimate.object), None)

    def read() -> AnyInput | Unreadable:
        view, pose = job.read(), estimate.camera_from_model
        if model is None or pose is None or not isinstance(view, ViewInput):
            return view
        mask = explained_mask(view, pose, model)
        return replace(view, name=estimate.name, mask=mask, object=model.name)

    return replace(job, name=estimate.name, read=read)
