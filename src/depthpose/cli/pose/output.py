"""Results of the pose commands: the folder, its files and page, and what is printed."""

import operator
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from depthpose.cli.pose.methods import PoseMethod
from depthpose.core import run_folder
from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError
from depthpose.core.files import read_image, write_cloud, write_image
from depthpose.core.processes import find_rank
from depthpose.core.rigid import Rigid
from depthpose.core.run_folder import note_result
from depthpose.pose.datasets import BopDataset
from depthpose.pose.inliers import view_inliers
from depthpose.pose.inputs import AnyInput
from depthpose.pose.predictions import (
    CLOUD,
    PICTURE,
    POSES,
    PoseJob,
    Prediction,
    name_bop_results,
    read_earlier_predictions,
    write_bop_results,
)
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.report import pose as pose_report
from depthpose.report.page import Section, choose_views, format_plain_table, write_page

_PAGE = "report.html"
_WITH_ALTERNATIVES = "depthpose-alternatives"
"""Name of the method in BOP's csv that holds alternatives too."""
_MAX_PRINTED_POSES = 20  # in the table on the terminal; poses.json holds all
_MAX_EXPLAINED = 5  # results whose refusals and alternatives are printed; poses.json holds all
_MAX_PAGE_ROWS = 1000  # in the table of the page
_PRINTED_COLUMNS = (
    "input", "object", "status", "x, y, z [m]", "qx, qy, qz, qw", "base x, y, z [m]",
    "base qx, qy, qz, qw", "agreement", "certainty", "of this copy", "identity", "visible",
    "pick rank", "tracking",
)  # fmt: skip
_SHARES = ("agreement", "certainty", "of this copy", "visible")
"""Columns of numbers from 0 to 1."""
_POSITION_COLUMNS = ("x_m", "y_m", "z_m")
_BASE_POSITION_COLUMNS = ("base_x_m", "base_y_m", "base_z_m")
_LEGEND = """camera_from_model: x right, y down, z forward
certainty: the probability that the pose is right, up to the near-symmetries of the model
of this copy: that it is this very copy of a nearly symmetric model
visible: share of the surface that faces the camera on which readings lie"""
_PICK_RANK_LEGEND = (
    "pick rank: what lies before another comes first, then what is surer and more visible"
)


def claim_for_jobs(
    out: Path,
    settings: dict[str, Any],
    jobs: list[PoseJob[Any]],
    is_result: Callable[[str, str], bool] = operator.eq,
) -> None:
    """Claim a folder for the poses of clouds or depth images, whose jobs name their files.

    Poses of an earlier run are deleted, to be estimated anew, if the record of the files that they
    were estimated from is lost.

    Args:
        out: the folder.
        settings: JSON values that decide the poses.
        jobs: jobs with the files that they read.
        is_result: whether the result of the first name is one of the input of the second name.
    """
    run_folder.claim_folder(out, settings, [POSES, _PAGE])
    if find_rank().world == 1 and not run_folder.read_sources(out):
        (out / POSES).unlink(missing_ok=True)

    def is_finished(name: str) -> bool:
        """Whether an earlier run has a result of an input, which could be read."""
        estimates = [prediction.estimate for prediction in read_earlier_predictions(out).values()]
        return any(
            is_result(estimate.name, name)
            for estimate in estimates
            if estimate.status != "unreadable"
        )

    run_folder.claim_names(
        out,
        {job.name: job.source for job in jobs if job.source is not None},
        [f".{end}" for end in (PICTURE, CLOUD)],
        is_finished=is_finished,
    )


def is_result_of(name: str, image: str) -> bool:
    """Whether a result of a searched image has this name: the image's, perhaps with a number."""
    return re.fullmatch(rf"{re.escape(image)}(_\d+)?", name) is not None


def claim_for_dataset(out: Path, settings: dict[str, Any], dataset: BopDataset) -> None:
    """Claim a folder for the poses of a dataset, with its tables and pictures."""
    images = sorted({(i.scene_id, i.image_id) for i in dataset.instances})
    pictures = [f"{scene:06d}_{image:06d}.{PICTURE}" for scene, image in images]
    tables = [name_bop_results(dataset), name_bop_results(dataset, _WITH_ALTERNATIVES)]
    run_folder.claim_folder(out, settings, [POSES, _PAGE, *tables, *pictures])


def write_files(
    predictions: list[Prediction],
    jobs: list[PoseJob[Any]],
    out: Path,
    method: PoseMethod,
    dataset: BopDataset | None = None,
    input_count: int | None = None,
) -> None:
    """Write the files of each input or of a dataset, and the page.

    Args:
        predictions: the poses and refusals.
        jobs: for each of them the job that reads its input.
        out: folder of the results.
        method: the method that made them.
        dataset: dataset of the inputs; None: they are clouds or depth images.
        input_count: number of inputs, where one may have several predictions; None: one each.
    """
    models = {model.name: model for model in method.models}
    if dataset is None:
        _write_job_files(predictions, jobs, out, models)
    else:
        _write_dataset_files(predictions, dataset, out, models)
    _write_page(out, predictions, jobs, models, dataset, input_count)


def make_picture_job(job: PoseJob[Any], prediction: Prediction, method: PoseMethod) -> PoseJob[Any]:
    """Make the job that reads an image as pictures and the page show a predicted object in it."""
    read = partial(_read_masked_by_pose, job, prediction, method)
    return replace(job, name=prediction.estimate.name, read=read)


def _read_masked_by_pose(job: PoseJob[Any], prediction: Prediction, method: PoseMethod) -> AnyInput:
    """Read a whole depth image, masked to the pixels that a predicted pose explains.

    A cloud, and an image whose object has no pose, are read as they are.
    """
    view = job.read()
    estimate = prediction.estimate
    pose = estimate.camera_from_model
    estimator = method.estimator
    if pose is None or not isinstance(view, ViewInput) or estimate.object not in estimator.objects:
        return view
    mask = view_inliers(view, pose, estimator.surface_of(estimate.object))
    return replace(view, name=estimate.name, mask=mask, object=estimate.object)


def _write_dataset_files(
    predictions: Sequence[Prediction],
    dataset: BopDataset,
    out: Path,
    models: Mapping[str, ObjectModel],
) -> None:
    """Write BOP's csv of a dataset's poses, and a picture of each image with its poses.

    ``models``: by the names of the objects.
    """
    write_bop_results(out / name_bop_results(dataset), predictions)
    if any(p.estimate.alternatives for p in predictions):
        table = out / name_bop_results(dataset, _WITH_ALTERNATIVES)
        write_bop_results(table, predictions, with_alternatives=True)

    image_of = {(i.scene_id, i.image_id): i for i in dataset.instances}
    posed: dict[tuple[int, int], list[PoseEstimate]] = defaultdict(list)
    for prediction in predictions:
        if prediction.place is not None and prediction.estimate.is_posed:
            posed[prediction.place[:2]].append(prediction.estimate)
    for (scene_id, image_id), estimates in posed.items():
        # Drawn anew, for this run may have posed more of its objects.
        name = f"{scene_id:06d}_{image_id:06d}.{PICTURE}"
        instance = image_of[scene_id, image_id]
        picture = pose_report.read_instance_image(instance)
        for estimate in estimates:
            pose = estimate.camera_from_model
            assert pose is not None
            picture = pose_report.draw_pose(picture, pose, models[estimate.object], instance.K)
        write_image(out / name, picture)
        note_result(out, name, [out / name])


def _write_job_files(
    predictions: Sequence[Prediction],
    jobs: Sequence[PoseJob[Any]],
    out: Path,
    models: Mapping[str, ObjectModel],
) -> None:
    """Write the posed model beside each cloud, and a picture of each depth image with its pose.

    ``models``: by the names of the objects.
    """
    for prediction, job in zip(predictions, jobs, strict=True):
        pose = prediction.estimate.camera_from_model
        if pose is None:
            continue
        model = models[prediction.estimate.object]
        # The input is read once more: none is kept after its estimate, for all together would fill
        # the memory, and earlier runs or other processes made some of the estimates.
        try:
            view = job.read()
        except InputError:  # unreadable by now
            continue
        points_m = pose_report.select_object_points(view, model.diameter_m)
        cloud_file = out / f"{job.name}.{CLOUD}"
        write_cloud(cloud_file, pose_report.join_posed_cloud(points_m, pose.double(), model))
        files = [cloud_file]
        if isinstance(view, ViewInput):
            picture = pose_report.draw_region(pose_report.draw_grey_depth(view.depth_m), view, pose)
            picture = pose_report.draw_pose(picture, pose, model, view.K)
            picture_file = out / f"{job.name}.{PICTURE}"
            write_image(picture_file, picture)
            files.append(picture_file)
        note_result(out, job.name, files)


def print_result(predictions: list[Prediction], out: Path, input_count: int | None = None) -> int:
    """Print the poses, their alternatives and the reasons of refusals; return the exit code.

    It is 1 where an input could not be read.

    Args:
        predictions: the poses.
        out: folder of the results.
        input_count: number of inputs, where one may have several poses; None: one each.
    """
    estimates = [prediction.estimate for prediction in predictions]
    unreadable = [estimate for estimate in estimates if estimate.status == "unreadable"]
    readable = [estimate for estimate in estimates if estimate.status != "unreadable"]
    for estimate in unreadable:
        print(f"depthpose: failed: {estimate.name}: {estimate.reason}", file=sys.stderr)
    if readable:
        _print_table(readable)

    # Why there is no sure pose, and what else fits.
    if len(readable) == 1 and not readable[0].is_ok:
        estimate = readable[0]
        status = "refused" if estimate.camera_from_model is None else estimate.status
        print(f"{status}: {estimate.reason}")
    if len(readable) > 1:
        refused = [estimate for estimate in readable if not estimate.is_posed]
        for estimate in refused[:_MAX_EXPLAINED]:
            print(f"{estimate.name}: no {estimate.object}: {estimate.reason}")
    for estimate in estimates[:_MAX_EXPLAINED]:
        for alternative in estimate.alternatives:
            print(f"{estimate.name}: {alternative}")

    counts = Counter(estimate.status for estimate in readable)
    statuses = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    total = _describe_counts(predictions, input_count)
    print(f"{total}: {statuses or 'none readable'}; {out / 'poses.json'}")
    return 1 if unreadable else 0


def _print_table(estimates: Sequence[PoseEstimate]) -> None:
    """Print a table of the first estimates, and what its columns mean."""
    rows: list[dict[str, Any]] = []
    for estimate in estimates[:_MAX_PRINTED_POSES]:
        row = _make_row(estimate)
        row |= _format_pose(estimate.camera_from_model)
        row |= _format_pose(estimate.base_from_model, prefix="base ")
        row |= {name: f"{row[name]:.3f}" for name in _SHARES if row[name] is not None}
        rows.append(row)
    print(format_plain_table(rows, _PRINTED_COLUMNS), end="")
    print(_LEGEND)
    if any(estimate.pick_rank is not None for estimate in estimates):
        print(_PICK_RANK_LEGEND)


def _format_pose(pose: Rigid | None, prefix: str = "") -> dict[str, str]:
    """Format the position and the quaternion of a pose, each for a column of the terminal."""
    if pose is None:
        return {}
    quaternion = Rotation.from_matrix(pose.R.double()).as_quat()
    return {
        f"{prefix}x, y, z [m]": ", ".join(f"{value:.4f}" for value in pose.t_m.tolist()),
        f"{prefix}qx, qy, qz, qw": ", ".join(f"{value:.4f}" for value in quaternion.tolist()),
    }


def _describe_counts(predictions: Sequence[Prediction], input_count: int | None) -> str:
    """Describe the number of inputs, and of poses and refusals where that differs."""
    prediction_count = len(predictions)
    count = prediction_count if input_count is None else input_count
    text = f"{count} input{'s' * (count != 1)}"
    if count != prediction_count:
        text += f", {prediction_count} answer{'s' * (prediction_count != 1)}"
    return text


def _make_row(estimate: PoseEstimate) -> dict[str, Any]:
    """Make the columns of an estimate for the page and the terminal."""
    row: dict[str, Any] = {
        "input": estimate.name,
        "object": estimate.object,
        "status": estimate.status,
    }
    if estimate.tracking is not None:
        row["tracking"] = estimate.tracking
    pose = estimate.camera_from_model
    position = [None] * 3 if pose is None else pose.t_m.double().tolist()
    row |= zip(_POSITION_COLUMNS, position, strict=True)
    if estimate.base_from_model is not None:
        base_position = estimate.base_from_model.t_m.tolist()
        row |= zip(_BASE_POSITION_COLUMNS, base_position, strict=True)

    evidence = estimate.evidence
    identity = estimate.identity
    row |= {
        "agreement": None if evidence is None else evidence.agreement,
        "identity": None if identity is None else identity.status,
        "certainty": estimate.certainty,
        "of this copy": estimate.copy_certainty,
        "visible": estimate.visible_share,
    }
    if estimate.pick_rank is not None:
        row["pick rank"] = estimate.pick_rank
    row["alternatives"] = "; ".join(map(str, estimate.alternatives))
    row["reason"] = estimate.reason
    return row


def _write_page(
    out: Path,
    predictions: Sequence[Prediction],
    jobs: Sequence[PoseJob[Any]],
    models: dict[str, ObjectModel],
    dataset: BopDataset | None,
    input_count: int | None,
) -> None:
    """Write a page with some of the predictions and the reason of every refusal.

    The arguments are those of :func:`write_files`; ``models``: by the names of the objects.
    """
    # The table: refusals first, for they are what is looked for.
    estimates = [prediction.estimate for prediction in predictions]
    refusals_first = sorted(estimates, key=lambda estimate: estimate.is_posed)
    rows = [_make_row(estimate) for estimate in refusals_first[:_MAX_PAGE_ROWS]]
    sections = _make_pose_sections(predictions, jobs, models, dataset)

    status_counts = Counter(estimate.status for estimate in estimates)
    counts = ", ".join(f"{count} {status}" for status, count in sorted(status_counts.items()))
    total = _describe_counts(predictions, input_count)
    text = f"{total}: {counts}. Shown below: {len(sections)}"
    text += "." if len(sections) == len(predictions) else ", answers and refusals spread evenly."
    if len(predictions) > _MAX_PAGE_ROWS:
        text += f" The table holds the first {_MAX_PAGE_ROWS}, refusals before answers; all are in "
        text += "poses.json."
    results = Section(title="What was found", text=text, rows=rows)
    write_page(out / _PAGE, f"Poses of {total}", [results, *sections], describe_environment())
    print(f"the page: {out / _PAGE}")


def _make_pose_sections(
    predictions: Sequence[Prediction],
    jobs: Sequence[PoseJob[Any]],
    models: Mapping[str, ObjectModel],
    dataset: BopDataset | None,
) -> list[Section]:
    """Make sections of some inputs with their poses, and of some that were refused."""
    instances = () if dataset is None else dataset.instances
    rgb_of = {(i.scene_id, i.image_id): i.rgb for i in instances}
    readable = [
        (prediction, job)
        for prediction, job in zip(predictions, jobs, strict=True)
        if prediction.estimate.status != "unreadable"
    ]

    sections: list[Section] = []
    for k in choose_views([prediction.estimate.is_posed for prediction, _ in readable]):
        prediction, job = readable[k]
        estimate = prediction.estimate
        try:
            pose_input = job.read()
        except InputError:  # unreadable by now
            continue

        is_whole_image = isinstance(pose_input, ViewInput) and bool(pose_input.mask.all())
        if is_whole_image and not estimate.is_posed:
            continue  # there is no part of the image to show; the row says why

        rgb = None if prediction.place is None else rgb_of[prediction.place[:2]]
        image = None if rgb is None else read_image(rgb)
        section = pose_report.make_pose_section(
            estimate.name, pose_input, estimate, models[estimate.object], image=image
        )
        sections.append(section)
    return sections
