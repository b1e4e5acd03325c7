"""Tables and figures of chapter 2: predict, measure, join with the printed rows, draw, write."""

import hashlib
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from depthpose.cli import depth_evaluate as evaluation
from depthpose.cli.depth_predict import DepthMethod
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import write_image
from depthpose.core.run import claim_folder, environment, find_rank
from depthpose.depth.datasets import Dataset, has_lidar, lidar_truth
from depthpose.depth.evaluate import find_protocol
from depthpose.depth.predictions import has_prediction, read_estimate
from depthpose.report import page
from depthpose.report.page import Drawing, Picture, Section
from depthpose.thesis.depth import (
    DEPTH_SCALE,
    PublishedTable,
    arrange,
    draw_figure_2_1,
    draw_figure_2_5,
    join_published,
    shrink_to_width,
)

_PICTURE_WIDTH_PX = 621


def reproduce_table(
    table: PublishedTable,
    dataset: Dataset,
    methods: Sequence[tuple[str, DepthMethod]],
    out: Path,
    protocol: str,
    caps_m: Sequence[float],
    pictures: int,
) -> int:
    """Predict what is missing, measure, join with the published rows, and write everything."""
    # All that decides the numbers.
    listed = "".join(f"{frame.left.resolve()}\n" for frame in dataset.frames)
    settings = {
        "table": table.number,
        "dataset": dataset.name,
        "frames": len(dataset),
        "frames_sha256": hashlib.sha256(listed.encode()).hexdigest(),
        "protocol": protocol,
        "caps_m": list(caps_m),
        "methods": {method.name: method.settings for _, method in methods},
    }
    results = (*page.table_files("rows", "frames", "confidence"), "report.md", "report.html")
    claim_folder(out, settings, (*results, "predictions", "figures"))

    # Predict, in all processes; the first measures and joins.
    rule = find_protocol(protocol)
    home = out / "predictions"
    folders = [evaluation.predict_dataset(dataset, method, rule, home) for _, method in methods]
    if find_rank().rank > 0:
        return 0
    measured = evaluation.join(evaluation.measure_each(dataset, folders, protocol, caps_m))
    own_rows = [own_row for own_row, _ in methods for _ in caps_m]
    rows = join_published(table, list(zip(own_rows, measured.rows, strict=True)))
    page.write_table(out, rows)

    # The page: the table, figures of some frames, the details, the settings.
    method_note = (
        f"Ours: {protocol}: {rule.summary}. The printed rows are of the 697 frames of "
        "eigen-test. Difference: ours minus the thesis's own row. A row of another protocol, or of "
        "other frames (see the columns), does not compare with the printed ones."
    )
    figures = [
        section
        for _, method in methods
        if pictures > 0
        for section in _figures_of(method, dataset, out, pictures)
    ]
    sections = [
        Section(title="Published rows, ours, and difference", text=method_note, rows=rows),
        *figures,
        *evaluation.write_details(measured, out),
        Section(
            title="Settings",
            rows=[
                {"method": method.name, "setting": name, "value": str(value)}
                for _, method in methods
                for name, value in method.settings.items()
            ],
        ),
    ]
    write_report(f"{table.title}, on {dataset.name}", sections, out)
    for name, reason in measured.skipped.items():
        print(f"skipped: {name}: {reason}", file=sys.stderr)
    print(f"{len(measured.skipped)} frames skipped")
    return 0


def _figures_of(method: DepthMethod, dataset: Dataset, out: Path, number: int) -> list[Section]:
    """Draw figure 2-5 of some frames that a method predicted, and figure 2-1 of the first."""
    predictions = out / "predictions" / method.name
    home = out / "figures" / method.name
    frames = [frame for frame in dataset.frames if has_prediction(predictions, frame.name)]
    predicted = replace(dataset, frames=frames)
    sections: list[Section] = []
    for place, index in enumerate(choose_frames(predicted, (), number)):
        pair = predicted.read_input(index)
        frame = frames[index]
        lidar_m = lidar_truth(frame, "camera_z") if has_lidar(frame, "camera_z") else None
        estimate = read_estimate(predictions, pair.name, pair.camera)
        figures = {"2-5": draw_figure_2_5(pair, lidar_m, estimate)}
        if place == 0 and estimate.right is not None and pair.right is not None:
            stereo = method.net.estimate_pair(pair)
            figures["2-1"] = draw_figure_2_1(pair, lidar_m, estimate, stereo)
        for figure, panels in figures.items():
            title = f"Figure {figure}: {method.name}, {pair.name}"
            sections.append(_panel_section(title, panels, home / f"{figure}_{pair.name}"))
    return sections


def write_report(title: str, sections: Sequence[Section], out: Path) -> None:
    """Write report.md and report.html of a table, and print its rows."""
    page.write_markdown(out / "report.md", title, sections, environment())
    page.write_page(out / "report.html", title, sections, environment())
    print(page.markdown_table(sections[0].rows))
    print(f"the page: {out / 'report.html'}")


def choose_frames(dataset: Dataset, names: Sequence[str], number: int) -> list[int]:
    """Give the indices of the frames that were named, or of some from all over the dataset.

    Frames chosen by us have a right view, and LiDAR where any frame has both.
    """
    if names:
        index_of = {frame.name: i for i, frame in enumerate(dataset.frames)}
        unknown = [name for name in names if name not in index_of]
        if unknown:
            hint = nearest_name(unknown[0], index_of)[:300]
            raise InputError(f"{dataset.name}: no frame {unknown[0]!r}; {hint}")
        return [index_of[name] for name in names]
    pairs = [i for i, frame in enumerate(dataset.frames) if frame.right is not None]
    chosen = [i for i in pairs if has_lidar(dataset.frames[i], "camera_z")] or pairs
    if not chosen:
        raise InputError(f"{dataset.name}: no frame has a right view, which the figures show.")
    return [chosen[place] for place in page.spread_evenly(len(chosen), max(1, number))]


def write_figure(
    number: str, dataset: Dataset, indices: Sequence[int], method: DepthMethod, out: Path
) -> int:
    """Estimate the frames, draw the figure, and write it with a page that explains it."""
    frames = [dataset.frames[index] for index in indices]
    listed = "".join(f"{frame.left.resolve()}\n" for frame in frames)
    settings = {
        "command": f"figure {number}",
        "frames": [frame.name for frame in frames],
        "frames_sha256": hashlib.sha256(listed.encode()).hexdigest(),
        "method": method.settings,
    }
    claim_folder(out, settings, (f"figure-{number}.png", "panels", "report.html"))
    columns: list[list[Drawing]] = []
    sections: list[Section] = []
    for index, frame in zip(tqdm(indices, unit=" frames", disable=None), frames, strict=True):
        pair = dataset.read_input(index)
        lidar_m = lidar_truth(frame, "camera_z") if has_lidar(frame, "camera_z") else None
        views = pair if method.with_right else replace(pair, right=None)
        estimate = method.net.estimate_pair(views)
        if number == "2-5":
            columns.append(draw_figure_2_5(pair, lidar_m, estimate))
        else:
            stereo = method.net.estimate_pair(pair)
            columns.append(draw_figure_2_1(pair, lidar_m, estimate, stereo))
        sections.append(_panel_section(frame.name, columns[-1], out / "panels" / frame.name))
    path = out / f"figure-{number}.png"
    write_image(path, arrange(columns))
    rows = [
        {"method": method.name, "setting": name, "value": str(value)}
        for name, value in method.settings.items()
    ]
    sections.append(Section(title="Settings", rows=rows))
    page.write_page(out / "report.html", f"Figure {number}", sections, environment())
    captions = "; ".join(panel.caption for panel in columns[0])
    print(f"{path}: each column from top to bottom: {captions}. {DEPTH_SCALE}; see the bar below.")
    return 0


def _panel_section(title: str, panels: Sequence[Drawing], home: Path) -> Section:
    """Write each panel as a file, small enough for a page of many."""
    pictures: list[Picture] = []
    for k, panel in enumerate(panels, 1):
        path = home.with_name(f"{home.name}.{k}.jpg")
        write_image(path, shrink_to_width(panel.image, _PICTURE_WIDTH_PX))
        pictures.append(Picture(path=path, caption=panel.caption, scale=panel.scale))
    return Section(title=title, text=DEPTH_SCALE, pictures=pictures)
