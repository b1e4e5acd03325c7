"""The stages of ``depthpose pose evaluate``: instances, their predictions, and the measurement."""

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from depthpose.cli.file_names import distinct_names
from depthpose.cli.pose.dataset import dataset_settings, match_names
from depthpose.cli.pose.masks import Masks
from depthpose.cli.pose.methods import PoseMethod
from depthpose.cli.pose.predict import estimate_unfinished
from depthpose.core.checkpoint import file_sha256
from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.core.run_folder import claim_folder, read_settings
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import BopDataset
from depthpose.pose.evaluate import (
    Evaluation,
    InstanceRow,
    Origin,
    evaluate,
    find_nearest_copy,
    match_instances,
    read_any_predictions,
)
from depthpose.pose.mesh import symmetry_transforms
from depthpose.pose.predictions import (
    POSES,
    PoseResults,
    name_bop_results,
    read_predictions,
    write_bop_results,
)
from depthpose.pose.types import ViewInput
from depthpose.report import page
from depthpose.report.page import Section
from depthpose.report.pose import make_pose_section

SCORING_NOTE = (
    "Refused and wrong answers stay in every number. The row 'mean' counts each object the same, "
    "'all' each instance, as BOP does."
)

_PRINTED_COLUMNS = (
    "method", "masks", "object", "instances", "success", "wrong", "refused", "auc", "ar", "ap",
    "rotation_deg_median", "translation_m_median",
)  # fmt: skip
"""Columns of the table on the terminal; the files hold all."""
_TRUTH_NOTE = (
    "Mask and cloud are the annotated ones; blue is the estimate, green the truth (of a symmetric "
    "object, the copy nearest to the estimate)."
)

_INSTANCE_COLUMNS = (
    "metric", "error_m", "diameter_m", "rotation_deg", "translation_m", "visible_fraction", "score",
    "status",
)  # fmt: skip
"""Columns of the table below the picture of an instance."""


def print_instances(dataset: BopDataset) -> None:
    """Print how many instances are measured, and of which objects."""
    names = ", ".join(model.name for model in dataset.objects.values())
    print(
        f"{dataset.folder} {dataset.split}: {len(dataset)} instances, layout {dataset.layout}; "
        f"objects: {names}"
    )


def predict_instances(
    dataset: BopDataset, method: PoseMethod, masks: Masks, out: Path, batch: int = 1
) -> Path:
    """Estimate every instance that is not estimated yet, and write ``poses.json`` and BOP's csv.

    Args:
        dataset: the instances.
        method: estimates their poses.
        masks: the masks that it is given.
        out: folder of the run.
        batch: views that are estimated together.

    Returns:
        The folder of the predictions, ``OUT/predictions/METHOD_MASKS``.
    """
    jobs = masks.make_jobs(match_names(dataset, method.models))
    predictions_folder = out / "predictions" / f"{method.name}_{masks.name}"
    settings = {
        **method.settings,
        "masks": masks.name,
        **masks.settings,
        **dataset_settings(dataset),
    }
    claim_folder(predictions_folder, settings, [POSES])
    # Every process estimates all instances, for it measures all.
    results = PoseResults[ViewInput](predictions_folder, must_read=True)
    label = f"{method.name}, {masks.name} masks"
    estimate_unfinished(method, jobs, results, batch, label)
    write_bop_results(
        predictions_folder / name_bop_results(dataset), read_predictions(predictions_folder)
    )
    return predictions_folder


def measure_predictions(
    dataset: BopDataset, predictions: Sequence[Path], config: EvaluationConfig
) -> list[Evaluation]:
    """Measure folders or csv files of predictions one by one; the rows say which method made them.

    Args:
        dataset: instances with truth.
        predictions: folders with ``poses.json``, or BOP's csv files.
        config: how they are measured.

    Raises:
        InputError: predictions are of another dataset or split, or two of them have one origin.
    """
    evaluations: list[Evaluation] = []
    with_progress = partial(tqdm, unit=" instances", disable=None)
    for path, origin in zip(predictions, find_origins(predictions), strict=True):
        _refuse_other_dataset(path, dataset)
        evaluation = evaluate(dataset, read_any_predictions(path), config, with_progress, origin)
        if evaluation.advice is not None:
            print(f"{path}: {evaluation.advice}", file=sys.stderr)
        evaluations.append(evaluation)
    return evaluations


def _refuse_other_dataset(path: Path, dataset: BopDataset) -> None:
    """Refuse a folder of predictions whose record names another dataset or split."""
    recorded = (read_settings(path) if path.is_dir() else None) or {}
    for key, value in dataset_settings(dataset).items():
        if recorded.get(key, value) != value:
            raise InputError(
                f"{path}: predictions of the {key} {recorded[key]!r}, but {value!r} is "
                f"measured; give those of this very {key}, or measure that one"
            )


def join_evaluations(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Join the rows of several evaluations into one."""
    advice = [evaluation.advice for evaluation in evaluations if evaluation.advice]
    return Evaluation(
        rows=[row for evaluation in evaluations for row in evaluation.rows],
        per_instance=[row for evaluation in evaluations for row in evaluation.per_instance],
        risk=[row for evaluation in evaluations for row in evaluation.risk],
        advice="; ".join(advice) or None,
    )


def find_origins(predictions: Sequence[Path]) -> list[Origin]:
    """Find which method, masks and weights made each folder or file of predictions.

    Methods of one name in two folders are told apart by the folders' names in front of theirs.

    Raises:
        InputError: two of them in one folder have one method and masks.
    """
    origins = [_read_origin(path) for path in predictions]
    parents = [path.resolve().parent for path in predictions]
    placed_origins = list(zip(parents, origins, strict=True))
    uses = Counter((parent, origin.method, origin.masks) for parent, origin in placed_origins)
    for (parent, method, masks), count in uses.items():
        if count > 1:
            raise InputError(
                f"{parent}: two predictions by {method!r}, masks {masks!r}, are given, and their "
                "rows would be one; give one of them, or rename it"
            )
    # Each method of a folder once: its predictions may be of several kinds of masks.
    methods = list(dict.fromkeys((parent, origin.method) for parent, origin in placed_origins))
    names = dict(zip(methods, distinct_names(methods), strict=True))
    return [
        replace(origin, method=names[parent, origin.method]) for parent, origin in placed_origins
    ]


def _read_origin(path: Path) -> Origin:
    """Read the origin of predictions from the record of their folder, else from their name."""
    settings = read_settings(path) if path.is_dir() else None
    if settings is None:  # made by other software
        sha256 = "" if path.is_dir() else file_sha256(path)[:12]
        return Origin(method=path.stem, weights_sha256=sha256)
    masks = settings.get("masks", "")
    return Origin(
        method=path.name.removesuffix(f"_{masks}"),
        masks=masks,
        weights=settings.get("weights", ""),
        weights_sha256=settings.get("weights_sha256", "")[:12],
    )


def measure_and_report(
    dataset: BopDataset, predictions: Sequence[Path], config: EvaluationConfig, out: Path
) -> int:
    """Measure predictions, write rows, tables and a page, and print the table.

    Args:
        dataset: instances with truth.
        predictions: folders with ``poses.json``, or BOP's csv files.
        config: how they are measured.
        out: folder of rows.json, rows.csv, table.md, report.html and instances.csv.

    Returns:
        The exit code.
    """
    evaluations = measure_predictions(dataset, predictions, config)
    measured = join_evaluations(evaluations)
    rows = [row.columns() for row in measured.rows]
    text = SCORING_NOTE
    if measured.advice is not None:
        text = f"{measured.advice}. {text}"
    page.write_table(out, rows)

    # The page: both tables, then some instances of each set of predictions.
    view_counts = page.share_views(len(predictions))
    instance_sections: list[Section] = []
    for path, evaluation, count in zip(predictions, evaluations, view_counts, strict=True):
        if count:
            instance_sections += _make_instance_sections(
                dataset, path, evaluation.per_instance, count
            )
    sections = [
        Section(title="Success by masks", text=text, rows=_list_success_by_masks(measured)),
        Section(title="All numbers", rows=rows),
        *instance_sections,
        *write_detail_tables(measured, out),
    ]
    title = f"Poses on {dataset.folder.resolve().name}, {dataset.split}"
    page.write_page(out / "report.html", title, sections, describe_environment())
    print(page.format_plain_table(rows, _PRINTED_COLUMNS))
    print(f"every column: {out / 'table.md'}, rows.csv; the page: {out / 'report.html'}")
    return 0


def _list_success_by_masks(measured: Evaluation) -> list[dict[str, Any]]:
    """List the success of each method and object, with a column for each kind of masks."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for row in measured.rows:
        assert row.origin is not None
        method = row.origin.method
        masks = row.origin.masks
        columns = rows.setdefault((method, row.object), {"method": method, "object": row.object})
        columns[f"{masks or 'their'} masks"] = row.success
    return list(rows.values())


def _make_instance_sections(
    dataset: BopDataset, predictions: Path, rows: Sequence[InstanceRow], max_count: int
) -> list[Section]:
    """Make sections of the worst, the median and the best posed instance, and of a refused one.

    Each shows the estimate and the true pose.

    Args:
        dataset: the instances.
        predictions: folder with ``poses.json``, or BOP's csv file.
        rows: measurements of these predictions.
        max_count: most instances that are shown.
    """
    instances = {instance.name: instance for instance in dataset.instances}
    estimates = match_instances(
        dataset.instances, read_any_predictions(predictions), dataset.objects
    )
    sections: list[Section] = []
    for caption, row in _choose_instances(rows, max_count):
        instance = instances[row.instance]
        estimate = estimates[row.instance]
        model = dataset.objects[instance.object_id]
        # The true pose of a symmetric object has copies; the one nearest to the estimate is drawn.
        truth = instance.camera_from_model
        if (pose := estimate.camera_from_model) is not None:
            transforms = symmetry_transforms(model.symmetries)
            truth = find_nearest_copy(pose, truth, transforms, declared=model.symmetries)
        columns = row.columns()
        section = make_pose_section(
            f"{predictions.stem}: {row.object} in {row.instance}, {caption}",
            dataset.view(instance).input,
            estimate,
            model,
            _TRUTH_NOTE,
            image=None if instance.rgb is None else read_image(instance.rgb),
            truth=truth,
            rows=[{name: columns[name] for name in _INSTANCE_COLUMNS}],
        )
        sections.append(section)
    return sections


def write_detail_tables(measured: Evaluation, out: Path) -> list[Section]:
    """Write tables of instances and of the risk by coverage; return the sections that show them."""
    risk = [row.columns() for row in measured.risk]
    page.write_table(out, [row.columns() for row in measured.per_instance], name="instances")
    if risk:
        page.write_table(out, risk, name="risk")
    else:  # no instance is posed, but some may have been in an earlier run here
        for file in page.list_table_files("risk"):
            (out / file).unlink(missing_ok=True)
    failed = [row.columns() for row in measured.per_instance if not row.is_success]
    text = "How many answers are wrong if only the surest are given."
    sections = [
        Section(title="Risk by coverage", text=text, rows=risk),
        Section(title="Each instance that is no success", rows=failed),
    ]
    return [section for section in sections if section.rows]


def _choose_instances(rows: Sequence[InstanceRow], max_count: int) -> list[tuple[str, InstanceRow]]:
    """Choose the worst, the median and the best posed instance, and a refused one.

    Posed instances are ranked by their error, as a share of the diameter.

    Returns:
        The caption of each, such as "worst answer of 12", and its row; ``max_count`` at most.
    """
    posed: list[InstanceRow] = []
    refused: list[InstanceRow] = []
    relative_errors: list[float] = []
    for row in rows:
        error_m = row.error("error_m")
        if error_m is not None:
            posed.append(row)
            relative_errors.append(error_m / row.diameter_m)
        elif row.status != "missing":
            refused.append(row)

    chosen = [
        (f"{rank} answer of {len(posed)}", posed[k])
        for rank, k in page.choose_ranked(relative_errors, max_count)
    ]
    refused_count = min(max_count - len(chosen), 1)
    chosen += [
        (f"one of {len(refused)} refused", refused[k])
        for k in page.spread_evenly(len(refused), refused_count)
    ]
    return chosen
