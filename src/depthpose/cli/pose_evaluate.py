"""The work behind ``depthpose pose evaluate``."""

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from depthpose.cli.pose_methods import dataset_settings, distinct_names
from depthpose.core.checkpoint import file_sha256
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.core.run import environment, read_settings
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import BopDataset, open_bop, read_targets
from depthpose.pose.evaluate import (
    Evaluation,
    InstanceRow,
    Origin,
    evaluate,
    match_instances,
    nearest_copy,
    read_any,
    select_targets,
)
from depthpose.pose.mesh import symmetry_transforms
from depthpose.report import page
from depthpose.report.page import Section
from depthpose.report.pose import pose_section

HOW = (
    "Refused and wrong answers stay in every number. The row 'mean' counts each object the same, "
    "'all' each instance, as BOP does."
)

_SHOWN = ("method", "masks", "object", "instances", "success", "wrong", "refused", "auc", "ar",
          "ap", "rotation_deg_median", "translation_m_median")  # fmt: skip
"""Columns that are printed; the files hold all."""


def open_instances(
    bop: Path, split: str, objects: Sequence[str], targets: Path | None
) -> BopDataset:
    """Open the instances that are measured, and print what they are."""
    dataset = open_bop(bop, split)
    if targets is not None:
        dataset = select_targets(dataset, read_targets(targets, bop))
    if objects:
        dataset = dataset.of_objects(*objects)
    names = ", ".join(model.name for model in dataset.objects.values())
    print(f"{bop} {split}: {len(dataset)} instances, layout {dataset.layout}; objects: {names}")
    return dataset


def measure_each(
    dataset: BopDataset, predictions: Sequence[Path], config: EvaluationConfig
) -> list[Evaluation]:
    """Measure folders or csv files of predictions one by one; each row says whose it is."""
    evaluations: list[Evaluation] = []
    show = partial(tqdm, unit=" instances", disable=None)
    for path, origin in zip(predictions, describe(predictions), strict=True):
        settings = (read_settings(path) if path.is_dir() else None) or {}
        for what, setting in dataset_settings(dataset).items():
            predicted = settings.get(what, setting)
            if predicted != setting:
                raise InputError(
                    f"{path}: predictions of the {what} {predicted!r}, but {setting!r} is "
                    f"measured; give those of this very {what}, or measure that one"
                )
        evaluations.append(evaluate(dataset, read_any(path), config, show, origin))
        if (advice := evaluations[-1].advice) is not None:
            print(f"{path}: {advice}", file=sys.stderr)
    return evaluations


def join(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Put the rows of several evaluations below each other."""
    return Evaluation(
        rows=[row for evaluation in evaluations for row in evaluation.rows],
        per_instance=[row for evaluation in evaluations for row in evaluation.per_instance],
        risk=[row for evaluation in evaluations for row in evaluation.risk],
        advice="; ".join(evaluation.advice for evaluation in evaluations if evaluation.advice)
        or None,
    )


def describe(predictions: Sequence[Path]) -> list[Origin]:
    """Name whose predictions each of these are.

    Methods of one name that lie in two folders are two, and bear the folders' names too.
    """
    origins: list[Origin] = []
    for path in predictions:
        settings = read_settings(path) if path.is_dir() else None
        if settings is None:  # a file of others is its own fingerprint
            sha256 = "" if path.is_dir() else file_sha256(path)[:12]
            origins.append(Origin(method=path.stem, weights_sha256=sha256))
            continue
        masks = settings.get("masks", "")
        origin = Origin(
            method=path.name.removesuffix(f"_{masks}"),
            masks=masks,
            weights=settings.get("weights", ""),
            weights_sha256=settings.get("weights_sha256", "")[:12],
        )
        origins.append(origin)
    pairs = list(zip([path.resolve().parent for path in predictions], origins, strict=True))
    rows = Counter((home, origin.method, origin.masks) for home, origin in pairs)
    for (home, method, masks), count in rows.items():
        if count > 1:
            raise InputError(
                f"{home}: two predictions by {method!r}, masks {masks!r}, are given, and their "
                "rows would be one; give one of them, or rename it"
            )
    places = list({(home, origin.method): None for home, origin in pairs})
    names = dict(zip(places, distinct_names(places), strict=True))
    return [replace(origin, method=names[home, origin.method]) for home, origin in pairs]


def measure(
    dataset: BopDataset, predictions: Sequence[Path], config: EvaluationConfig, out: Path
) -> int:
    """Measure folders or files of predictions against the truth; write tables and page, and print.

    The files: rows.json, rows.csv, table.md, report.html and instances.csv.
    """
    evaluations = measure_each(dataset, predictions, config)
    measured = join(evaluations)
    rows = [row.columns() for row in measured.rows]
    text = HOW if measured.advice is None else f"{measured.advice}. {HOW}"
    page.write_table(out, rows)

    # Success of each method and object, a column for each kind of masks.
    by_masks: dict[tuple[str, str], dict[str, Any]] = {}
    for row in measured.rows:
        assert row.origin is not None
        method = row.origin.method
        masks = row.origin.masks
        entry = by_masks.setdefault((method, row.object), {"method": method, "object": row.object})
        entry[f"{masks or 'their'} masks"] = row.success

    # The page: both tables, then some instances of each set of predictions.
    shares = page.share_views(len(predictions))
    instance_sections = [
        section
        for path, evaluation, most in zip(predictions, evaluations, shares, strict=True)
        if most
        for section in _instance_sections(dataset, path, evaluation.per_instance, most)
    ]
    sections = [
        Section(title="Success by masks", text=text, rows=list(by_masks.values())),
        Section(title="All numbers", rows=rows),
        *instance_sections,
        *write_details(measured, out),
    ]
    title = f"Poses on {dataset.folder.resolve().name}, {dataset.split}"
    page.write_page(out / "report.html", title, sections, environment())
    print(page.plain_table(rows, _SHOWN))
    print(f"every column: {out / 'table.md'}, rows.csv; the page: {out / 'report.html'}")
    return 0


def _instance_sections(
    dataset: BopDataset, predictions: Path, rows: Sequence[InstanceRow], most: int
) -> list[Section]:
    """Show at most so many instances of a set of predictions, with their truth."""
    instances = {instance.name: instance for instance in dataset.instances}
    estimates = match_instances(dataset.instances, read_any(predictions), dataset.objects)
    sections: list[Section] = []
    for role, row in _choose(rows, most):
        instance = instances[row.instance]
        estimate = estimates[row.instance]
        model = dataset.objects[instance.object_id]
        # Of copies that look alike the one nearest to the estimate.
        truth = instance.camera_from_model
        if (pose := estimate.camera_from_model) is not None:
            symmetries = symmetry_transforms(model.symmetries)
            truth = nearest_copy(pose, truth, symmetries, model.symmetries)
        columns = row.columns()
        section = pose_section(
            f"{predictions.stem}: {row.object} in {row.instance}, {role}",
            dataset.view(instance).input,
            estimate,
            model,
            _OF_TRUTH,
            image=None if instance.rgb is None else read_image(instance.rgb),
            truth=truth,
            rows=[{name: columns[name] for name in _MEASURED}],
        )
        sections.append(section)
    return sections


def write_details(measured: Evaluation, out: Path) -> list[Section]:
    """Write each instance's numbers, and the risk by coverage; give them as parts of a page."""
    risk = [row.columns() for row in measured.risk]
    page.write_table(out, [row.columns() for row in measured.per_instance], name="instances")
    if risk:
        page.write_table(out, risk, name="risk")
    failed = [row.columns() for row in measured.per_instance if not row.is_success]
    text = "How many answers are wrong if only the surest are given."
    sections = [
        Section(title="Risk by coverage", text=text, rows=risk),
        Section(title="Each instance that is no success", rows=failed),
    ]
    return [section for section in sections if section.rows]


_OF_TRUTH = (
    "Mask and cloud are the annotated ones; blue is the estimate, green the truth (of a symmetric "
    "object, the copy nearest to the estimate)."
)

_MEASURED = (
    "metric", "error_m", "diameter_m", "rotation_deg", "translation_m", "visible_fraction", "score",
    "status",
)  # fmt: skip


def _choose(rows: Sequence[InstanceRow], most: int) -> list[tuple[str, InstanceRow]]:
    """Choose estimates by their error in diameters, and a middle one of the refusals."""
    errors = {row.instance: row.error("error_m") for row in rows}
    answers = [row for row in rows if errors[row.instance] is not None]
    shares = [(errors[row.instance] or 0.0) / row.diameter_m for row in answers]
    chosen = [
        (f"{role} answer of {len(answers)}", answers[k])
        for role, k in page.choose_ranked(shares, min(most, 3))
    ]
    refused = [r for r in rows if errors[r.instance] is None and r.status != "missing"]
    refused_count = min(most - len(chosen), 1)
    chosen += [
        (f"one of {len(refused)} refused", refused[k])
        for k in page.spread_evenly(len(refused), refused_count)
    ]
    return chosen
