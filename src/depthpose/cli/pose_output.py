"""Results of the pose commands: the folder, its files and page, and what is printed."""

import operator
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from depthpose.cli.pose_methods import PoseMethod
from depthpose.core import run
from depthpose.core.errors import InputError
from depthpose.core.files import read_image, write_cloud, write_image
from depthpose.core.rigid import Rigid
from depthpose.core.run import is_whole, note_result
from depthpose.pose.datasets import BopDataset
from depthpose.pose.predictions import (
    CLOUD,
    PICTURE,
    POSES,
    PoseJob,
    Prediction,
    earlier_predictions,
    results_name,
    write_bop_results,
)
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.report import pose as drawn
from depthpose.report.page import Section, choose_answers, plain_table, write_page

_PAGE = "report.html"
_WITH_ALTERNATIVES = "depthpose-alternatives"  # the method of a csv that has them too
_MOST_SHOWN = 20  # of the answers, on the terminal; poses.json holds all
_MOST_PRINTED = 5  # inputs whose alternatives are printed; poses.json holds those of all
_MOST_ROWS = 1000  # of the answers, in the table of the page
_PRINTED = ("input", "object", "status", "x, y, z [m]", "qx, qy, qz, qw", "base x, y, z [m]",
            "base qx, qy, qz, qw", "agreement", "certainty", "of this copy", "identity",
            "visible", "pick rank", "tracking")  # fmt: skip
"""Columns on the terminal."""
_BASE_COLUMNS = ("base_x_m", "base_y_m", "base_z_m")
_FRAME = """camera_from_model: x right, y down, z forward
certainty: the probability that the pose is right, up to the near-symmetries of the model
of this copy: that it is this very copy of a nearly symmetric model
visible: share of the surface that faces the camera on which readings lie"""
_RANKED = "pick rank: what lies before another comes first, then what is surer and more visible"


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
        jobs: each with the files that it reads.
        is_result: whether a result of the first name is of the input of the second.
    """
    run.claim_folder(out, settings, [POSES, _PAGE])
    if run.find_rank().world == 1 and not run.read_sources(out):
        (out / POSES).unlink(missing_ok=True)

    def is_finished(name: str) -> bool:
        predictions = earlier_predictions(out).values()
        done = [p.estimate.name for p in predictions if p.estimate.status != "unreadable"]
        return any(is_result(result_name, name) for result_name in done)

    run.claim_names(
        out,
        {job.name: job.source for job in jobs if job.source is not None},
        [f".{end}" for end in (PICTURE, CLOUD)],
        is_finished=is_finished,
    )


def is_result_of(name: str, image: str) -> bool:
    """Whether a result is of an image without a mask: its name, or that and a number."""
    return re.fullmatch(rf"{re.escape(image)}(_\d+)?", name) is not None


def claim_for_dataset(out: Path, settings: dict[str, Any], dataset: BopDataset) -> None:
    """Claim a folder for the poses of a data set."""
    images = sorted({(i.scene_id, i.image_id) for i in dataset.instances})
    pictures = [f"{scene:06d}_{image:06d}.{PICTURE}" for scene, image in images]
    tables = [results_name(dataset), results_name(dataset, _WITH_ALTERNATIVES)]
    run.claim_folder(out, settings, [POSES, _PAGE, *tables, *pictures])


def write_files(
    predictions: list[Prediction],
    jobs: list[PoseJob[Any]],
    out: Path,
    method: PoseMethod,
    dataset: BopDataset | None = None,
    input_count: int | None = None,
) -> None:
    """Write the page of poses, and the files of each input, or of a data set."""
    models = {model.name: model for model in method.models}
    if dataset is None:
        _write_job_files(predictions, jobs, out, models)
    else:
        _write_dataset_files(predictions, dataset, out, models)
    _write_page(out, predictions, jobs, models, dataset, input_count)


def _write_dataset_files(
    predictions: Sequence[Prediction],
    dataset: BopDataset,
    out: Path,
    models: Mapping[str, ObjectModel],
) -> None:
    """Write BOP's csv of a data set's poses, and a picture of each image with its poses."""
    write_bop_results(out / results_name(dataset), predictions)
    if any(p.estimate.alternatives for p in predictions):
        table = out / results_name(dataset, _WITH_ALTERNATIVES)
        write_bop_results(table, predictions, with_alternatives=True)

    image_of = {(i.scene_id, i.image_id): i for i in dataset.instances}
    posed: dict[tuple[int, int], list[PoseEstimate]] = defaultdict(list)
    for prediction in predictions:
        if prediction.place is not None and prediction.estimate.is_posed:
            posed[prediction.place[:2]].append(prediction.estimate)
    for image, estimates in posed.items():
        name = f"{image[0]:06d}_{image[1]:06d}.{PICTURE}"
        if is_whole(out, name, [name]):
            continue
        picture = drawn.picture_of(image_of[image])
        for estimate in estimates:
            pose = estimate.camera_from_model
            assert pose is not None
            picture = drawn.draw_pose(picture, pose, models[estimate.object], image_of[image].K)
        write_image(out / name, picture)
        note_result(out, name, [out / name])


def _write_job_files(
    predictions: Sequence[Prediction],
    jobs: Sequence[PoseJob[Any]],
    out: Path,
    models: Mapping[str, ObjectModel],
) -> None:
    """Write the posed model beside each cloud, and a picture of each depth image with its pose."""
    for prediction, job in zip(predictions, jobs, strict=True):
        pose = prediction.estimate.camera_from_model
        if pose is None:
            continue
        model = models[prediction.estimate.object]
        try:
            view = job.read()
        except InputError:  # unreadable by now
            continue
        points_m = drawn.object_points(view, model.diameter_m)
        files = [out / f"{job.name}.{CLOUD}"]
        write_cloud(files[0], drawn.posed_cloud(points_m, pose.double(), model))
        if isinstance(view, ViewInput):
            files.append(out / f"{job.name}.{PICTURE}")
            picture = drawn.draw_region(drawn.grey_depth(view.depth_m), view, pose)
            write_image(files[1], drawn.draw_pose(picture, pose, model, view.K))
        note_result(out, job.name, files)


def print_result(predictions: list[Prediction], out: Path, input_count: int | None = None) -> int:
    """Print the poses, their alternatives and the reasons of refusals; give the exit code.

    ``input_count``: where an input may have several estimates; None: one each.
    """
    failed = [p.estimate for p in predictions if p.estimate.status == "unreadable"]
    shown = [p.estimate for p in predictions if p.estimate.status != "unreadable"]
    for estimate in failed:
        print(f"depthpose: failed: {estimate.name}: {estimate.reason}", file=sys.stderr)

    # A table of the first estimates.
    if shown:
        rows: list[dict[str, Any]] = []
        for estimate in shown[:_MOST_SHOWN]:
            row = _row(estimate)
            row |= _pose_words(estimate.camera_from_model, "")
            row |= _pose_words(estimate.base_from_model, "base ")
            certain = {
                key: value
                for key in ("agreement", "certainty", "of this copy", "visible")
                if (value := row[key]) is not None
            }
            rows.append(row | {key: f"{value:.3f}" for key, value in certain.items()})
        print(plain_table(rows, _PRINTED), end="")
        print(_FRAME)
        if any(estimate.pick_rank is not None for estimate in shown):
            print(_RANKED)

    # Why there is no sure pose, and what else fits.
    if len(shown) == 1 and not shown[0].is_ok:
        what = "refused" if shown[0].camera_from_model is None else shown[0].status
        print(f"{what}: {shown[0].reason}")
    refused = [estimate for estimate in shown if not estimate.is_posed]
    for estimate in refused[:_MOST_PRINTED] if len(shown) > 1 else ():
        print(f"{estimate.name}: no {estimate.object}: {estimate.reason}")
    for prediction in predictions[:_MOST_PRINTED]:
        for other in prediction.estimate.alternatives:
            print(f"{prediction.estimate.name}: {other}")

    counts = Counter(estimate.status for estimate in shown)
    statuses = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    total = _count_inputs(predictions, input_count)
    print(f"{total}: {statuses or 'none readable'}; {out / 'poses.json'}")
    return 1 if failed else 0


def _pose_words(pose: Rigid | None, before: str) -> dict[str, str]:
    """Format position and quaternion of a pose for the columns of a table."""
    if pose is None:
        return {}
    quaternion = Rotation.from_matrix(pose.R.double()).as_quat()
    return {
        f"{before}x, y, z [m]": ", ".join(f"{value:.4f}" for value in pose.t_m.tolist()),
        f"{before}qx, qy, qz, qw": ", ".join(f"{value:.4f}" for value in quaternion.tolist()),
    }


def _count_inputs(predictions: Sequence[Prediction], input_count: int | None) -> str:
    """Give the number of inputs, and that of estimates where it is another."""
    count = len(predictions) if input_count is None else input_count
    answers = len(predictions)
    total = f"{count} input{'s' * (count != 1)}"
    return total if count == answers else f"{total}, {answers} answer{'s' * (answers != 1)}"


def _row(estimate: PoseEstimate) -> dict[str, Any]:
    """Give the row of an estimate for the page and the terminal."""
    pose = estimate.camera_from_model
    evidence = estimate.evidence
    identity = estimate.identity
    place = [None] * 3 if pose is None else pose.t_m.double().tolist()
    base = estimate.base_from_model
    return {
        "input": estimate.name,
        "object": estimate.object,
        "status": estimate.status,
        **({} if estimate.tracking is None else {"tracking": estimate.tracking}),
        **dict(zip(("x_m", "y_m", "z_m"), place, strict=True)),
        **({} if base is None else dict(zip(_BASE_COLUMNS, base.t_m.tolist(), strict=True))),
        "agreement": None if evidence is None else evidence.agreement,
        "identity": None if identity is None else identity.status,
        "certainty": estimate.certainty,
        "of this copy": estimate.copy_certainty,
        "visible": estimate.visible_share,
        **({} if estimate.pick_rank is None else {"pick rank": estimate.pick_rank}),
        "alternatives": "; ".join(map(str, estimate.alternatives)),
        "reason": estimate.reason,
    }


def _write_page(
    out: Path,
    predictions: Sequence[Prediction],
    jobs: Sequence[PoseJob[Any]],
    models: dict[str, ObjectModel],
    dataset: BopDataset | None,
    input_count: int | None,
) -> None:
    """Write a page with some of the predictions and the reason of every refusal."""
    # The table: refusals first, for they are what is looked for.
    estimates = [prediction.estimate for prediction in predictions]
    numbers = Counter(estimate.status for estimate in estimates)
    counts = ", ".join(f"{count} {status}" for status, count in sorted(numbers.items()))
    rows = [
        _row(listed)
        for listed in sorted(estimates, key=lambda listed: listed.is_posed)[:_MOST_ROWS]
    ]

    # Some inputs with their poses, and some that were refused.
    instances = () if dataset is None else dataset.instances
    image_of = {(i.scene_id, i.image_id): i.rgb for i in instances}
    readable = [k for k, listed in enumerate(estimates) if listed.status != "unreadable"]
    sections: list[Section] = []
    for k in choose_answers([predictions[k].estimate.is_posed for k in readable]):
        estimate = predictions[readable[k]].estimate
        place = predictions[readable[k]].place
        try:
            shown_input = jobs[readable[k]].read()
        except InputError:  # unreadable by now
            continue
        is_searched = isinstance(shown_input, ViewInput) and bool(shown_input.mask.all())
        if is_searched and not estimate.is_posed:  # a whole image; its row says why
            continue
        rgb = None if place is None else image_of[place[:2]]
        model = models[estimate.object]
        image = None if rgb is None else read_image(rgb)
        section = drawn.pose_section(estimate.name, shown_input, estimate, model, image=image)
        sections.append(section)

    number = len(predictions)
    total = _count_inputs(predictions, input_count)
    text = f"{total}: {counts}. Shown below: {len(sections)}"
    text += "." if len(sections) == number else ", answers and refusals spread evenly."
    if number > _MOST_ROWS:
        text += f" The table holds the first {_MOST_ROWS}, refusals before answers; all are in "
        text += "poses.json."
    results = Section(title="What was found", text=text, rows=rows)
    title = f"Poses of {total}"
    write_page(out / _PAGE, title, [results, *sections], run.environment())
    print(f"the page: {out / _PAGE}")
