"""The work behind ``depthpose reproduce 3.1``, ``3.2`` and ``3.3``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from depthpose.cli.options import PoseDataOptions, PoseTableOptions, refuse_below
from depthpose.cli.pose import evaluating as pose_evaluating
from depthpose.cli.pose import masks as pose_masks
from depthpose.cli.pose import methods as pose_methods
from depthpose.cli.thesis.pose_figures import picture_sections
from depthpose.cli.thesis.views import open_views, settings_of
from depthpose.core.checkpoint import file_sha256, find_weights
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.run import claim_folder, environment
from depthpose.pose.datasets import BopDataset
from depthpose.pose.estimator import GeoPoseNet
from depthpose.report.tables import (
    Section,
    markdown_table,
    table_files,
    write_markdown,
    write_page,
    write_table,
)
from depthpose.thesis.pose_tables import TITLES, join_by_object, linemod_number
from depthpose.thesis.voting import cases_of, compare_voting

_RESULTS = (
    *table_files("rows", "all", "instances", "risk"),
    "report.md", "report.html", "predictions", "detections", "figures",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class TableSpec:
    """What to make: a table, of which instances, the number of each object, how many pictures."""

    number: str
    dataset: BopDataset
    numbers: Mapping[str, int]
    pictures: int


def make_spec(number: str, data: PoseDataOptions, how: PoseTableOptions) -> TableSpec:
    """Open the one data set that was named.

    Raises:
        InputError: none was named, or two, or table 3.2 is asked for of another than LineMOD.
    """
    refuse_below(0, "--pictures", how.pictures, "4")
    if data.folder is None:
        raise InputError(f"table {number}: give --linemod FOLDER, or --bop FOLDER.")
    dataset = pose_evaluating.open_instances(data.folder, data.split, data.objects, how.targets)
    models = dataset.objects.values()
    own = {model.name: linemod_number(model) if number == "3.2" else model.number
           for model in models}  # fmt: skip
    return TableSpec(number=number, dataset=dataset, numbers=own, pictures=how.pictures)


def reproduce_by_object(
    spec: TableSpec,
    weights: Sequence[str],
    how: PoseTableOptions,
    out: Path,
    csv: Sequence[Path] = (),
) -> int:
    """Predict what is missing, measure, join with the published rows, and write everything."""
    dataset = spec.dataset
    methods = pose_methods.pose_methods(weights, how.estimate, tuple(dataset.objects.values()))
    masks = pose_masks.mask_files(how.masks) if methods else []
    files = {"masks": masks, "csv": [pose_masks.named_file(path) for path in csv]}
    claim_folder(out, _settings(spec, methods, how) | files, _RESULTS)
    shown = pose_masks.find_masks(how.masks, dataset, out, how.device) if methods else []
    folders = [pose_methods.predict_all(dataset, m, one, out) for m in methods for one in shown]
    measured = pose_evaluating.measure_all(dataset, [*folders, *csv], how.evaluation)
    joined = join_by_object(measured.rows, spec.numbers, with_published=spec.number == "3.2")
    rows, every = [row.columns() for row in joined], pose_evaluating.table_of(measured.rows)
    write_table(out, rows)
    write_table(out, every, name="all")
    pose_evaluating.write_details(measured, out)
    sections = [
        Section(title="Percent by object", text=_say_how(spec), rows=rows),
        Section(title="All numbers", text=pose_evaluating.HOW, rows=every),
        *picture_sections(dataset, folders, spec.pictures, out),
        *pose_evaluating.detail_sections(measured),
    ]
    return _write(f"{TITLES[spec.number]}, on {dataset.folder.resolve().name}", sections, out)


def reproduce_voting(
    weights: str, data: PoseDataOptions, synthetic: int, points: Sequence[int], out: Path
) -> int:
    """Compare ways of voting on the same directions, block by block of points."""
    path = find_weights(weights)
    net = GeoPoseNet.load(path)
    views = open_views(net, data, None, synthetic)
    sha256 = file_sha256(path)
    facts = {"weights": path.stem, "weights_sha256": sha256[:12], **views.facts}
    files = [*table_files("rows"), "report.md", "report.html"]
    own = {"command": "reproduce 3.3", "weights_sha256": sha256, "points": list(points)}
    claim_folder(out, own | views.settings, files)
    rows: list[dict[str, Any]] = []
    for count in points:
        cases = list(cases_of(net, tqdm(views.samples, f"{count} points", disable=None), count))
        rows += [row.columns() | facts for row in compare_voting(cases, count)]
    write_table(out, rows)
    text = (
        "Success: percent of instances whose ADD(-S) is below 10 % of the diameter, without ICP; "
        "milliseconds: processor time of one thread for all keypoints of a cloud, the median. "
        "'points': at most so many; 'votes': how many the clouds had on average. "
        "Times faster: than the loop. All rows of a block saw the same directions."
    )
    sections = [Section(title="RANSAC against least squares", text=text, rows=rows)]
    return _write(f"{TITLES['3.3']}, {facts['frames']}", sections, out)


def _write(title: str, sections: Sequence[Section], out: Path) -> int:
    write_markdown(out / "report.md", title, sections, environment())
    write_page(out / "report.html", title, sections, environment())
    print(markdown_table(sections[0].rows))
    print(f"the page: {out / 'report.html'}")
    return 0


def _settings(
    spec: TableSpec, methods: Sequence[pose_methods.PoseMethod], how: PoseTableOptions
) -> dict[str, Any]:
    """What decides the results; the files of a run of other settings are not touched."""
    return {
        "table": spec.number,
        **settings_of(spec.dataset),
        "rule": config_to_dict(how.evaluation),
        "methods": {method.name: dict(method.settings) for method in methods},
    }


def _say_how(spec: TableSpec) -> str:
    ours = (
        "Percent of instances whose ADD (ADD-S where there is a star, or a declared symmetry) is "
        "below 10 % of the diameter. Ours: a missing or refused estimate is a failure; see the "
        "columns for masks, diameters and the list of frames."
    )
    if spec.number == "3.1":
        return f"{ours} Differences: the first weights less each of the others."
    return (
        f"{ours} Published rows: as printed, of the 13 objects; those with RGB see what ours does "
        "not, most train a network for each object, and their lists of frames and diameters "
        "differ (see the notes). Differences: ours minus the rows of one network for all objects. "
        "The thesis's own row is not in the text that is at hand."
    )
