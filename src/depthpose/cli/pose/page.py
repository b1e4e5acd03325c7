"""The pages of ``depthpose pose predict`` and ``pose evaluate``."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from depthpose.cli.pose.inputs import Unreadable
from depthpose.cli.pose.methods import PoseMethod
from depthpose.cli.pose.predicting import PAGE
from depthpose.core.files import read_image
from depthpose.core.run import environment
from depthpose.pose.datasets import BopDataset, Instance
from depthpose.pose.evaluate import InstanceRow, match, nearest_copy, read_any
from depthpose.pose.mesh import symmetry_transforms
from depthpose.pose.predictions import Job, Prediction, is_finished
from depthpose.pose.types import PoseEstimate
from depthpose.report.page import (
    Section,
    choose_answers,
    choose_ranked,
    share_views,
    spread_evenly,
    write_page,
)
from depthpose.report.pose import PoseShown, alternative_lines, pose_section

_MOST_ROWS = 1000
_OF_TRUTH = (
    "Mask and cloud are the annotated ones; blue is the estimate, green the truth (of a symmetric "
    "object, the copy nearest to the estimate)."
)
_MEASURED = (
    "metric", "error_m", "diameter_m", "rotation_deg", "translation_m", "visible_fraction", "score",
    "status",
)  # fmt: skip


def write_pose_page(
    out: Path,
    predictions: Sequence[Prediction],
    jobs: Sequence[Job[Any]],
    method: PoseMethod,
    dataset: BopDataset | None = None,
) -> None:
    """Write a page of some of the predictions, and of the reason of each refusal.

    Args:
        out: its folder.
        predictions: all, in the order of the jobs.
        jobs: their inputs.
        method: by which.
        dataset: that they are of, if they are of one.
    """
    sections = _answer_sections(predictions, jobs, method, dataset)
    sections.insert(0, _results(predictions, len(sections)))
    page = out / PAGE
    number = len(predictions)
    write_page(page, f"Poses of {number} input{'s' * (number != 1)}", sections, environment())
    print(f"the page: {page}")


def _answer_sections(
    predictions: Sequence[Prediction],
    jobs: Sequence[Job[Any]],
    method: PoseMethod,
    dataset: BopDataset | None,
) -> list[Section]:
    """Show some of the inputs that could be read, answered and refused."""
    instances = () if dataset is None else dataset.instances
    image_of = {(i.scene_id, i.image_id): i.rgb for i in instances}
    models = {model.name: model for model in method.models}
    readable = [k for k, prediction in enumerate(predictions) if is_finished(prediction)]
    answered = [predictions[k].estimate.is_posed for k in readable]
    sections: list[Section] = []
    for k in (readable[chosen] for chosen in choose_answers(answered)):
        given = jobs[k].read()
        if isinstance(given, Unreadable):  # by now; it was read when it was estimated
            continue
        estimate, place = predictions[k].estimate, predictions[k].place
        rgb = None if place is None else image_of[place[:2]]
        image = None if rgb is None else read_image(rgb)
        model = models[estimate.object]
        shown = PoseShown(given=given, estimate=estimate, model=model, image=image)
        sections.append(pose_section(estimate.name, shown))
    return sections


def instance_sections(
    dataset: BopDataset,
    predictions: Sequence[Path],
    rows: Sequence[Sequence[InstanceRow]],
) -> list[Section]:
    """Show the worst, the median and the best answer of each set of predictions, and a refusal.

    Args:
        dataset: as it was measured.
        predictions: folders or csv files.
        rows: of the instances of each, as they were measured.
    """
    instances = {instance.name: instance for instance in dataset.instances}
    sections: list[Section] = []
    for path, of_path, most in zip(predictions, rows, share_views(len(predictions)), strict=True):
        if not most:
            continue
        found = match(dataset.instances, read_any(path), dataset.objects)
        for role, row in _choose(of_path, most):
            instance = instances[row.instance]
            shown = _shown(dataset, instance, found[instance.name])
            title = f"{path.stem}: {row.object} in {instance.name}, {role}"
            columns = row.columns()
            own = {name: columns[name] for name in _MEASURED}
            sections.append(pose_section(title, shown, _OF_TRUTH, rows=[own]))
    return sections


def _results(predictions: Sequence[Prediction], shown: int) -> Section:
    """List every refusal, then the answers."""
    counts = Counter(prediction.estimate.status for prediction in predictions)
    said = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    rows = [_row(p.estimate) for p in sorted(predictions, key=lambda p: p.estimate.is_posed)]
    text = f"{len(predictions)} inputs: {said}. Shown below: {shown}"
    text += "." if shown == len(predictions) else ", answers and refusals spread evenly."
    if len(rows) > _MOST_ROWS:
        text += f" The table holds the first {_MOST_ROWS}, refusals before answers; all are in "
        text += "poses.json."
    return Section(title="What was found", text=text, rows=rows[:_MOST_ROWS])


def _row(estimate: PoseEstimate) -> dict[str, Any]:
    pose = estimate.camera_from_model
    x_m, y_m, z_m = (None, None, None) if pose is None else pose.t_m.double().tolist()
    tracking = {} if estimate.tracking is None else {"tracking": estimate.tracking}
    return {
        "input": estimate.name,
        "object": estimate.object,
        "status": estimate.status,
        **tracking,
        "x_m": x_m,
        "y_m": y_m,
        "z_m": z_m,
        "fit": None if estimate.fit is None else estimate.fit.agrees,
        "identity": None if estimate.identity is None else estimate.identity.status,
        "certainty": estimate.certainty,
        "alternatives": "; ".join(alternative_lines(estimate)),
        "reason": estimate.reason,
    }


def _choose(rows: Sequence[InstanceRow], most: int) -> list[tuple[str, InstanceRow]]:
    """Choose answers by their error in diameters, and the middle one of the refusals."""
    errors = {row.instance: row.error("error_m") for row in rows}
    answers = [row for row in rows if errors[row.instance] is not None]
    shares = [(errors[row.instance] or 0.0) / row.diameter_m for row in answers]
    chosen = [
        (f"{role} answer of {len(answers)}", answers[k])
        for role, k in choose_ranked(shares, min(most, 3))
    ]
    refused = [r for r in rows if errors[r.instance] is None and r.status != "missing"]
    few = min(most - len(chosen), 1)
    chosen += [
        (f"one of {len(refused)} refused", refused[k]) for k in spread_evenly(len(refused), few)
    ]
    return chosen


def _shown(dataset: BopDataset, instance: Instance, estimate: PoseEstimate) -> PoseShown:
    """Show an estimate beside the truth: of copies that look alike the one nearest to it."""
    model, truth = dataset.objects[instance.object_id], instance.camera_from_model
    if (found := estimate.camera_from_model) is not None:
        truth = nearest_copy(found, truth, symmetry_transforms(model.symmetries), model.symmetries)
    return PoseShown(
        given=dataset.view(instance).input,
        estimate=estimate,
        model=model,
        image=None if instance.rgb is None else read_image(instance.rgb),
        truth=truth,
    )
