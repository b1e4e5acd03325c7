"""The work behind ``depthpose pose evaluate``."""

import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from depthpose.cli.pose.masks import distinct_names, of_dataset
from depthpose.cli.pose.page import instance_sections
from depthpose.core.checkpoint import file_sha256
from depthpose.core.errors import InputError
from depthpose.core.run import environment, read_settings
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import BopDataset, open_bop, read_targets
from depthpose.pose.evaluate import (
    Evaluation,
    InstanceRow,
    ObjectRow,
    Origin,
    RiskRow,
    evaluate,
    of_targets,
    read_any,
)
from depthpose.report.page import Section, plain_table, write_page, write_table

HOW = (
    "Success: ADD (ADD-S of a symmetric object) below 10 % of the diameter. Refused: no answer, or "
    "no estimate at all; wrong: an answer that is no success. Both stay in every number. AUC: area "
    "to 10 cm. ar, ar_vsd, ar_mssd, ar_mspd: BOP's average recalls. The row 'mean' counts each "
    "object the same, 'all' each instance, as BOP does."
)
_SHOWN = ("method", "masks", "object", "instances", "success", "wrong", "refused", "auc", "ar",
          "rotation_deg_median", "translation_m_median")  # fmt: skip
"""Columns that are printed; the files hold all."""


def open_instances(
    bop: Path, split: str, objects: Sequence[str], targets: Path | None
) -> BopDataset:
    """Open what is to be measured, and say what it is."""
    dataset = open_bop(bop, split)
    if targets is not None:
        dataset = of_targets(dataset, read_targets(targets))
    if objects:
        dataset = dataset.of_objects(*objects)
    names = ", ".join(model.name for model in dataset.objects.values())
    print(f"{bop} {split}: {len(dataset)} instances, layout {dataset.layout}; objects: {names}")
    return dataset


def measure_all(
    dataset: BopDataset, predictions: Sequence[Path], config: EvaluationConfig
) -> Evaluation:
    """Measure several folders or csv files of predictions as one table."""
    return join(measure_each(dataset, predictions, config))


def measure_each(
    dataset: BopDataset, predictions: Sequence[Path], config: EvaluationConfig
) -> list[Evaluation]:
    """Measure folders or csv files of predictions one by one; each row says whose it is."""
    found: list[Evaluation] = []
    show = partial(tqdm, unit=" instances", disable=None)
    for path, origin in zip(predictions, describe(predictions), strict=True):
        _refuse_others(path, dataset)
        one = evaluate(dataset, read_any(path), config, show).of(origin)
        if one.advice is not None:
            print(f"{path}: {one.advice}", file=sys.stderr)
        found.append(one)
    return found


def join(each: Sequence[Evaluation]) -> Evaluation:
    """Put the rows of several evaluations below each other."""
    return Evaluation(
        rows=[row for one in each for row in one.rows],
        per_instance=[row for one in each for row in one.per_instance],
        risk=[row for one in each for row in one.risk],
        advice="; ".join(one.advice for one in each if one.advice) or None,
    )


def describe(predictions: Sequence[Path]) -> list[Origin]:
    """Name whose predictions each of these are.

    Methods of one name that lie in two folders are two, and bear the folders' names too.

    Raises:
        InputError: predictions are given twice.
    """
    found = [_describe_one(path) for path in predictions]
    homes = [path.resolve().parent for path in predictions]
    rows = Counter((home, one.method, one.masks) for home, one in zip(homes, found, strict=True))
    twice = [key for key, count in rows.items() if count > 1]
    if twice:
        home, method, masks = twice[0]
        raise InputError(
            f"{home}: two predictions by {method!r}, masks {masks!r}, are given, and their rows "
            "would be one; give one of them, or rename it"
        )
    own = list({(home, one.method): None for home, one in zip(homes, found, strict=True)})
    names = dict(zip(own, distinct_names(own), strict=True))
    return [
        replace(one, method=names[home, one.method]) for home, one in zip(homes, found, strict=True)
    ]


def _refuse_others(path: Path, dataset: BopDataset) -> None:
    """Refuse predictions whose record says that they are of another data set or split."""
    settings = (read_settings(path) if path.is_dir() else None) or {}
    for what, own in of_dataset(dataset).items():
        theirs = settings.get(what, own)
        if theirs != own:
            raise InputError(
                f"{path}: predictions of the {what} {theirs!r}, but {own!r} is measured; give "
                f"those of this very {what}, or measure that one"
            )


def _describe_one(path: Path) -> Origin:
    settings = read_settings(path) if path.is_dir() else None
    if settings is None:
        # A file of others is its own fingerprint.
        sha256 = "" if path.is_dir() else file_sha256(path)[:12]
        return Origin(method=path.stem, weights_sha256=sha256)
    masks = settings.get("masks", "")
    return Origin(
        method=path.name.removesuffix(f"_{masks}"),
        masks=masks,
        weights=settings.get("weights", ""),
        weights_sha256=settings.get("weights_sha256", "")[:12],
    )


def success_by_masks(rows: Sequence[ObjectRow]) -> list[dict[str, Any]]:
    """Set the successes with each kind of masks side by side, a row a method and object."""
    table: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        assert row.origin is not None
        place = (row.origin.method, row.object)
        entry = table.setdefault(place, {"method": row.origin.method, "object": row.object})
        entry[f"{row.origin.masks or 'their'} masks"] = row.success
    return list(table.values())


def table_of(rows: Iterable[ObjectRow | InstanceRow | RiskRow]) -> list[dict[str, Any]]:
    """Give the columns of rows, as tables and files take them."""
    return [row.columns() for row in rows]


def measure(
    dataset: BopDataset, predictions: Sequence[Path], config: EvaluationConfig, out: Path
) -> int:
    """Measure, write rows.json, rows.csv, table.md, report.html and instances.csv, and print."""
    each = measure_each(dataset, predictions, config)
    measured = join(each)
    rows = table_of(measured.rows)
    said = HOW if measured.advice is None else f"{measured.advice}. {HOW}"
    write_table(out, rows)
    write_details(measured, out)
    sections = [
        Section(title="Success by masks", text=said, rows=success_by_masks(measured.rows)),
        Section(title="All numbers", rows=rows),
        *instance_sections(dataset, predictions, [one.per_instance for one in each]),
        *detail_sections(measured),
    ]
    page = out / "report.html"
    title = f"Poses on {dataset.folder.resolve().name}, {dataset.split}"
    write_page(page, title, sections, environment())
    print(plain_table(rows, _SHOWN))
    print(f"every column: {out / 'table.md'}, rows.csv; the page: {page}")
    return 0


def write_details(measured: Evaluation, out: Path) -> None:
    """Write each instance's numbers, and the risk by coverage."""
    write_table(out, table_of(measured.per_instance), name="instances")
    if measured.risk:
        write_table(out, table_of(measured.risk), name="risk")


def detail_sections(measured: Evaluation) -> list[Section]:
    """Make the parts of a page below its tables."""
    failed = [row for row in measured.per_instance if not row.is_success]
    sections = [
        Section(
            title="Risk by coverage",
            text="How many answers are wrong if only the surest are given.",
            rows=table_of(measured.risk),
        ),
        Section(title="Each instance that is no success", rows=table_of(failed)),
    ]
    return [section for section in sections if section.rows]
