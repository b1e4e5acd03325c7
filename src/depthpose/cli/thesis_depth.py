"""Tables and figures of chapter 2: predict, measure, join with the printed rows, draw, write."""

import hashlib
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from depthpose.cli import depth_evaluate as evaluation
from depthpose.cli.depth_methods import DepthMethod
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import write_image
from depthpose.core.run import claim_folder, environment, find_rank
from depthpose.depth.datasets import Dataset, Frame, has_lidar, lidar_truth
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

_PANEL_WIDTH_PX = 621
"""Width of a panel on a page: half of a frame of KITTI."""


def reproduce_table(
    table: PublishedTable,
    dataset: Dataset,
    methods: Sequence[tuple[str, DepthMethod]],
    out: Path,
    protocol: str,
    caps_m: Sequence[float],
    pictures: int,
) -> int:
    """Predict what is missing, measure, join with the published rows, and write everything.

    Args:
        table: the printed table.
        dataset: frames with truth.
        methods: each with the name of the printed row that it reproduces, or "" for none.
        out: folder of the files.
        protocol: protocol by which the predictions are measured.
        caps_m: truth beyond a cap does not count; a row for each.
        pictures: frames of each method that the page shows.
    """
    # All that decides the numbers.
    settings = {
        "table": table.number,
        "dataset": dataset.name,
        "frames": len(dataset),
        "frames_sha256": _frames_sha256(dataset.frames),
        "protocol": protocol,
        "caps_m": list(caps_m),
        "methods": {method.name: method.settings for _, method in methods},
    }
    results = (*page.table_files("rows", "frames", "confidence"), "report.md", "report.html")
    claim_folder(out, settings, (*results, "predictions", "figures"))

    # Predict, in all processes; the first measures and joins.
    rule = find_protocol(protocol)
    home = out / "predictions"
    folders = [
        evaluation.predict_depth_of_dataset(dataset, method, rule, home) for _, method in methods
    ]
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
    figures: list[Section] = []
    if pictures > 0:
        for _, method in methods:
            figures += _make_figure_sections(method, dataset, out, pictures)
    sections = [
        Section(title="Published rows, ours, and difference", text=method_note, rows=rows),
        *figures,
        *evaluation.write_details(measured, out),
        _make_settings_section([method for _, method in methods]),
    ]
    write_report(f"{table.title}, on {dataset.name}", sections, out)
    for name, reason in measured.skipped.items():
        print(f"skipped: {name}: {reason}", file=sys.stderr)
    print(f"{len(measured.skipped)} frames skipped")
    return 0


def _frames_sha256(frames: Sequence[Frame]) -> str:
    """Give the SHA-256 of the paths of the left images."""
    paths = "".join(f"{frame.left.resolve()}\n" for frame in frames)
    return hashlib.sha256(paths.encode()).hexdigest()


def _make_settings_section(methods: Sequence[DepthMethod]) -> Section:
    """Show what decides the results of each method, a row for each setting."""
    rows = [
        {"method": method.name, "setting": name, "value": str(value)}
        for method in methods
        for name, value in method.settings.items()
    ]
    return Section(title="Settings", rows=rows)


def _make_figure_sections(
    method: DepthMethod, dataset: Dataset, out: Path, number: int
) -> list[Section]:
    """Draw figure 2-5 of some frames that a method predicted, and figure 2-1 of the first.

    Figure 2-1 is left out where the method synthesised no right view, or there is no real one.
    """
    predictions = out / "predictions" / method.name
    home = out / "figures" / method.name
    frames = [frame for frame in dataset.frames if has_prediction(predictions, frame.name)]
    predicted = replace(dataset, frames=frames)
    sections: list[Section] = []
    for k, index in enumerate(choose_frames(predicted, (), number)):
        pair = predicted.read_input(index)
        lidar_m = _read_lidar(frames[index])
        estimate = read_estimate(predictions, pair.name, pair.camera)
        figures = {"2-5": draw_figure_2_5(pair, lidar_m, estimate)}
        if k == 0 and estimate.right is not None and pair.right is not None:
            stereo = method.estimator.estimate_input(pair)
            figures["2-1"] = draw_figure_2_1(pair, lidar_m, estimate, stereo)
        for figure, panels in figures.items():
            title = f"Figure {figure}: {method.name}, {pair.name}"
            sections.append(_make_panel_section(title, panels, home / f"{figure}_{pair.name}"))
    return sections


def _read_lidar(frame: Frame) -> Float[Tensor, "h w"] | None:
    """Read the LiDAR depth (camera z) of a frame; None where it has none."""
    return lidar_truth(frame, "camera_z") if has_lidar(frame, "camera_z") else None


def write_report(title: str, sections: Sequence[Section], out: Path) -> None:
    """Write report.md and report.html of a table, and print its rows."""
    page.write_markdown(out / "report.md", title, sections, environment())
    page.write_page(out / "report.html", title, sections, environment())
    print(page.markdown_table(sections[0].rows))
    print(f"the page: {out / 'report.html'}")


def choose_frames(dataset: Dataset, names: Sequence[str], number: int) -> list[int]:
    """Give the indices of the named frames, or else of some from all over the dataset.

    The latter have a right view, and LiDAR too if any frame has both.
    """
    if names:
        index_of = {frame.name: i for i, frame in enumerate(dataset.frames)}
        unknown = [name for name in names if name not in index_of]
        if unknown:
            hint = nearest_name(unknown[0], index_of)[:300]
            raise InputError(f"{dataset.name}: no frame {unknown[0]!r}; {hint}")
        return [index_of[name] for name in names]
    pairs = [i for i, frame in enumerate(dataset.frames) if frame.right is not None]
    candidates = [i for i in pairs if has_lidar(dataset.frames[i], "camera_z")] or pairs
    if not candidates:
        raise InputError(f"{dataset.name}: no frame has a right view, which the figures show.")
    return [candidates[k] for k in page.spread_evenly(len(candidates), max(1, number))]


def write_figure(
    number: str, dataset: Dataset, indices: Sequence[int], method: DepthMethod, out: Path
) -> int:
    """Estimate the frames, draw the figure, and write it with a page that explains it."""
    frames = [dataset.frames[index] for index in indices]
    settings = {
        "command": f"figure {number}",
        "frames": [frame.name for frame in frames],
        "frames_sha256": _frames_sha256(frames),
        "method": method.settings,
    }
    claim_folder(out, settings, (f"figure-{number}.png", "panels", "report.html"))

    columns: list[list[Drawing]] = []
    sections: list[Section] = []
    for index, frame in zip(tqdm(indices, unit=" frames", disable=None), frames, strict=True):
        pair = dataset.read_input(index)
        lidar_m = _read_lidar(frame)
        views = pair if method.with_right else replace(pair, right=None)
        estimate = method.estimator.estimate_input(views)
        if number == "2-5":
            panels = draw_figure_2_5(pair, lidar_m, estimate)
        else:
            stereo = method.estimator.estimate_input(pair)
            panels = draw_figure_2_1(pair, lidar_m, estimate, stereo)
        columns.append(panels)
        sections.append(_make_panel_section(frame.name, panels, out / "panels" / frame.name))

    path = out / f"figure-{number}.png"
    write_image(path, arrange(columns))
    sections.append(_make_settings_section([method]))
    page.write_page(out / "report.html", f"Figure {number}", sections, environment())
    captions = "; ".join(panel.caption for panel in columns[0])
    print(f"{path}: each column from top to bottom: {captions}. {DEPTH_SCALE}; see the bar below.")
    return 0


def _make_panel_section(title: str, panels: Sequence[Drawing], stem: Path) -> Section:
    """Write each panel as a file, STEM.1.jpg, ..., small enough for a page of many; show them."""
    pictures: list[Picture] = []
    for k, panel in enumerate(panels, 1):
        path = stem.with_name(f"{stem.name}.{k}.jpg")
        write_image(path, shrink_to_width(panel.image, _PANEL_WIDTH_PX))
        pictures.append(Picture(path=path, caption=panel.caption, scale=panel.scale))
    return Section(title=title, text=DEPTH_SCALE, pictures=pictures)
