"""The work behind ``depthpose pose predict``."""

import operator
import re
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation
from torch import Tensor
from tqdm import tqdm

from depthpose.cli.pose.inputs import Unreadable
from depthpose.cli.pose.methods import EstimateMany, PoseMethod
from depthpose.core.files import write_cloud, write_image
from depthpose.core.results import is_whole, note_result
from depthpose.core.rigid import numbers_text
from depthpose.core.run import (
    ProcessRank,
    claim_folder,
    claim_names,
    find_rank,
    read_sources,
    wait_for,
)
from depthpose.pose.cloud import object_points
from depthpose.pose.datasets import BopDataset, Instance
from depthpose.pose.predictions import (
    CLOUD,
    PICTURE,
    POSES,
    Job,
    Prediction,
    alternatives_name,
    is_finished,
    kept_predictions,
    predict,
    results_name,
    write_bop_results,
    write_predictions,
)
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.report.page import plain_table
from depthpose.report.pose import alternative_lines, draw_pose, grey_depth, picture_of, posed_cloud
from depthpose.report.viewer import Viewer, open_viewer

PAGE = "report.html"
_MOST_SHOWN = 20
"""Of the answers, on the terminal; poses.json holds all."""
_FRAME = """camera_from_model: x right, y down, z forward
certainty: the chance that the pose is right and not one of its alternatives"""
_SAID = 5
"""Of so many inputs the alternatives are printed; of all they are in poses.json."""


def claim(
    out: Path,
    settings: dict[str, Any],
    jobs: list[Job[Any]],
    source: Path,
    is_result: Callable[[str, str], bool] = operator.eq,
) -> None:
    """Claim a folder for the poses of clouds or depth images.

    Args:
        out: the folder.
        settings: that decide the results.
        jobs: inputs.
        source: of those that name none.
        is_result: whether a result of the first name is of the input of the second.

    Raises:
        InputError: it is another run's, or holds a file of somebody else that would be written
            over.
    """
    claim_folder(out, settings, [POSES, PAGE])
    if find_rank().world == 1 and not read_sources(out):  # lost: of what the poses are
        (out / POSES).unlink(missing_ok=True)
    endings = [f".{end}" for end in (PICTURE, CLOUD)]
    done = _finished(out)
    sources = {job.name: job.source or source for job in jobs}
    claim_names(
        out, sources, endings, is_finished=lambda name: any(is_result(n, name) for n in done)
    )


def is_result_of(name: str, image: str) -> bool:
    """Whether a result is of an image without a mask: its name, or that and a number."""
    return re.fullmatch(rf"{re.escape(image)}(_\d+)?", name) is not None


def claim_bop(out: Path, settings: dict[str, Any], dataset: BopDataset) -> None:
    """Claim a folder for the poses of a data set; raises as :func:`claim`."""
    images = {(i.scene_id, i.image_id) for i in dataset.instances}
    pictures = (_picture_name(*image) for image in sorted(images))
    tables = [results_name(dataset), alternatives_name(dataset)]
    claim_folder(out, settings, [POSES, PAGE, *tables, *pictures])


def predict_all(method: PoseMethod, jobs: list[Job[Any]], out: Path, settings: dict[str, Any],
                batch: int, view: str | None) -> list[Prediction] | None:  # fmt: skip
    """Estimate what is not finished; several processes share the work through the files.

    Returns:
        All predictions in the order of the jobs; None in a process that is not the first.
    """
    process = find_rank()
    home = out if process.world == 1 else out / f"part-{process.rank}"
    done = _finished(out)
    left = [jobs[k] for k in process.share(len(jobs)) if jobs[k].name not in done]
    if left:
        with open_viewer(None if process.rank else view) as viewer:
            shown = method if viewer is None else _watched(method, viewer)
            names = predict(_safely(shown), left, home, settings, batch)
            for _ in tqdm(names, total=len(left), disable=None, unit=" poses"):
                pass
    if process.rank:
        return None
    return _gather(jobs, out, process)


def estimate_jobs(method: PoseMethod, jobs: Sequence[Job[Any]]) -> list[PoseEstimate]:
    """Estimate some inputs together; what cannot be read has the status ``unreadable``."""
    return list(_safely(method)([job.read() for job in jobs]))


def say_result(predictions: list[Prediction], out: Path) -> int:
    """Print how many were posed and why others were not; give the exit code."""
    reasons: dict[str, int] = defaultdict(int)
    failed = [p.estimate for p in predictions if not is_finished(p)]
    for prediction in predictions:
        if prediction.estimate not in failed:
            reasons[prediction.estimate.status] += 1
    for estimate in failed:
        print(f"depthpose: failed: {estimate.name}: {estimate.reason}", file=sys.stderr)
    shown = [p.estimate for p in predictions if is_finished(p)]
    if shown:
        print(plain_table([_answer_row(estimate) for estimate in shown[:_MOST_SHOWN]]), end="")
        print(_FRAME)
    if len(shown) == 1 and not shown[0].is_ok:
        what = "refused" if shown[0].camera_from_model is None else shown[0].status
        print(f"{what}: {shown[0].reason}")
    for prediction in predictions[:_SAID]:
        for line in alternative_lines(prediction.estimate):
            print(f"{prediction.estimate.name}: {line}")
    said = ", ".join(f"{count} {status}" for status, count in sorted(reasons.items()))
    inputs = "1 input" if len(predictions) == 1 else f"{len(predictions)} inputs"
    print(f"{inputs}: {said or 'none readable'}; {out / 'poses.json'}")
    return 1 if failed else 0


def _answer_row(estimate: PoseEstimate) -> dict[str, Any]:
    """Say what was found of one input: object, status, translation, quaternion, the answers."""
    row: dict[str, Any] = {
        "input": estimate.name,
        "object": estimate.object,
        "status": estimate.status,
    }
    pose = estimate.camera_from_model
    if pose is not None:
        quaternion = Rotation.from_matrix(pose.R.double().numpy()).as_quat()
        row |= {"x, y, z [m]": numbers_text(pose.t_m.tolist())}
        row |= {"qx, qy, qz, qw": numbers_text(quaternion.tolist())}
    fit, certainty, identity = estimate.fit, estimate.certainty, estimate.identity
    row["fit"] = None if fit is None else f"{fit.agrees:.3f}"
    row["certainty"] = None if certainty is None else f"{certainty:.3f}"
    row["identity"] = None if identity is None else identity.status
    return row if estimate.tracking is None else row | {"tracking": estimate.tracking}


def write_files(
    predictions: list[Prediction], jobs: list[Job[Any]], out: Path, method: PoseMethod
) -> None:
    """Write NAME.pose.ply, and NAME.pose.png where there is a depth image."""
    for prediction, job in zip(predictions, jobs, strict=True):
        estimate = prediction.estimate
        pose = estimate.camera_from_model
        if pose is None:
            continue
        given, model = job.read(), _model(method, estimate.object)
        points_m = object_points(given, model.diameter_m)
        files = [out / f"{job.name}.{CLOUD}"]
        write_cloud(files[0], posed_cloud(points_m, pose, model))
        if isinstance(given, ViewInput):
            picture = draw_pose(grey_depth(given.depth_m), pose, model, given.K)
            files.append(out / f"{job.name}.{PICTURE}")
            write_image(files[1], picture)
        note_result(out, job.name, files)


def write_bop_files(
    predictions: list[Prediction], dataset: BopDataset, out: Path, method: PoseMethod
) -> None:
    """Write BOP's csv, and a picture SCENE_IMAGE.pose.png of each image."""
    write_bop_results(out / results_name(dataset), predictions)
    if any(p.estimate.alternatives for p in predictions):
        write_bop_results(out / alternatives_name(dataset), predictions, with_alternatives=True)
    image_of = {(i.scene_id, i.image_id): i for i in dataset.instances}
    found: dict[tuple[int, int], list[PoseEstimate]] = defaultdict(list)
    for prediction in predictions:
        if prediction.place is not None and prediction.estimate.is_posed:
            found[prediction.place[:2]].append(prediction.estimate)
    for (scene, image), estimates in found.items():
        name = _picture_name(scene, image)
        if not is_whole(out, name, [name]):
            write_image(out / name, _overlay(image_of[scene, image], estimates, method))
            note_result(out, name, [out / name])


def _picture_name(scene: int, image: int) -> str:
    return f"{scene:06d}_{image:06d}.{PICTURE}"


def _overlay(instance: Instance, estimates: Iterable[PoseEstimate], method: PoseMethod) -> Tensor:
    picture = picture_of(instance)
    for estimate in estimates:
        assert estimate.camera_from_model is not None
        model = _model(method, estimate.object)
        picture = draw_pose(picture, estimate.camera_from_model, model, instance.K)
    return picture


def _finished(out: Path) -> set[str]:
    return {name for name, prediction in _known(out).items() if is_finished(prediction)}


def _known(out: Path) -> dict[str, Prediction]:
    folders = [out, *sorted(out.glob("part-*"))]
    every = [p for folder in folders for p in kept_predictions(folder)]
    # What was read at last counts, whatever another part said of an earlier try.
    return {p.estimate.name: p for p in sorted(every, key=is_finished)}


def _gather(jobs: list[Job[Any]], out: Path, process: ProcessRank) -> list[Prediction]:
    if process.world > 1:
        seen: dict[str, Any] = {"at": -10.0, "names": set()}

        def is_there(name: str) -> bool:
            # Files of all parts are read for all names at once, every second.
            if name not in seen["names"] and time.monotonic() - seen["at"] > 1:
                seen["names"], seen["at"] = set(_known(out)), time.monotonic()
            return name in seen["names"]

        wait_for([job.name for job in jobs], is_there)
    known = _known(out)
    predictions = [known.pop(job.name) for job in jobs]
    # Inputs of earlier runs stay in the file.
    write_predictions(out, [*known.values(), *predictions])
    return predictions


def _model(method: PoseMethod, name: str) -> ObjectModel:
    return next(model for model in method.models if model.name == name)


def _safely(method: PoseMethod) -> EstimateMany:
    """Let a method skip what could not be read."""

    def estimate_many(inputs: Sequence[Any]) -> list[PoseEstimate]:
        found = iter(method.estimate_many([g for g in inputs if not isinstance(g, Unreadable)]))
        return [unread(g) if isinstance(g, Unreadable) else next(found) for g in inputs]

    return estimate_many


def unread(given: Unreadable) -> PoseEstimate:
    """Give the estimate of an input that could not be read."""
    return PoseEstimate(
        name=given.name,
        object=given.object,
        status="unreadable",
        reason=f"cannot be read: {given.reason}",
    )


def _watched(method: PoseMethod, viewer: Viewer) -> PoseMethod:
    """Give a method whose every estimate is shown as soon as it is there."""
    models = {model.name: model for model in method.models}

    def estimate_many(inputs: Sequence[Any]) -> list[PoseEstimate]:
        found = list(method.estimate_many(inputs))
        for given, estimate in zip(inputs, found, strict=True):
            viewer.show_pose(given, estimate, models[given.object])
        return found

    return replace(method, estimate_many=estimate_many)
