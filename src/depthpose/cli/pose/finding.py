"""``depthpose pose predict`` of depth images without masks."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from depthpose.cli.pose.inputs import Unreadable
from depthpose.cli.pose.methods import PoseMethod
from depthpose.cli.pose.page import write_pose_page
from depthpose.cli.pose.predicting import claim, say_result, write_files
from depthpose.core.errors import InputError
from depthpose.core.files import list_images
from depthpose.core.run import find_rank, refuse_among_inputs
from depthpose.pose.config import Unit
from depthpose.pose.estimator.find import explained_mask, nothing_found
from depthpose.pose.estimator.given import view_input
from depthpose.pose.estimator.prepare import AnyInput
from depthpose.pose.predictions import Job, Prediction, write_predictions
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
    entry, NAME, that says so.

    Raises:
        InputError: weights that take no clouds, several processes, or two images of one name.
    """
    _refuse_unable(method)
    depths = list_images(depth)
    refuse_among_inputs(out, [depth], depths)
    facts = {"camera": str(camera.resolve())} | ({} if unit is None else {"unit": unit})
    settings = {**method.settings, "find": sorted(objects), **facts}
    claim(out, settings, [], depth)
    found: list[tuple[Prediction, Job[Any]]] = []
    for path in tqdm(depths, disable=None, unit=" images"):
        found += _find(method, view_input(path, None, camera, objects[0], path.stem, unit), objects)
    claim(out, settings, [job for _, job in found], depth)
    return _write(found, method, out)


def _refuse_unable(method: PoseMethod) -> None:
    if method.find is None:
        raise InputError("--depth without --mask: these weights need masked views; give --mask")
    if find_rank().world > 1:
        raise InputError("--depth without --mask is done by one process; give --mask, or start one")


def _write(found: list[tuple[Prediction, Job[Any]]], method: PoseMethod, out: Path) -> int:
    """Write what was found, files and a page of what was answered; give the exit code."""
    predictions = [prediction for prediction, _ in found]
    write_predictions(out, predictions)
    answered = [pair for pair in found if pair[0].estimate.is_ok]
    answers, own = [prediction for prediction, _ in answered], [job for _, job in answered]
    write_files(answers, own, out, method)
    write_pose_page(out, answers, own, method)
    return say_result(predictions, out)


def _find(
    method: PoseMethod, view: ViewInput, objects: tuple[str, ...]
) -> Iterator[tuple[Prediction, Job[Any]]]:
    assert method.find is not None
    whole = Job[Any](name=view.name, read=lambda: view)
    for one in method.find(view, objects) or [nothing_found(view.name, ", ".join(objects))]:
        yield Prediction(estimate=one), explained_job(whole, one, method)


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
