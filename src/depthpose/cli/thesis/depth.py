"""Tables and figures of chapter 2: predict, measure, join with the printed rows, draw, write."""

import hashlib
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from depthpose.cli.depth.evaluate import (
    join_evaluations,
    measure_folders,
    predict_depth_of_dataset,
    write_detail_tables,
)
from depthpose.cli.depth.methods import DepthMethod
from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError, suggest_name
from depthpose.core.files import write_image
from depthpose.core.processes import find_rank
from depthpose.core.run_folder import claim_folder
from depthpose.depth.datasets import Dataset, FramePaths, has_lidar, read_lidar_depth
from depthpose.depth.predictions import has_prediction, read_estimate
from depthpose.depth.protocols import find_protocol
from depthpose.report import page
from depthpose.report.page import Drawing, PictureFile, Section
from depthpose.thesis.depth import (
    DEPTH_SCALE,
    PANEL_WIDTH_PX,
    PublishedTable,
    arrange_columns,
    draw_figure_2_1,
    draw_figure_2_5,
    join_published,
    resize_to_width,
)

_MAX_HINT_LENGTH = 300
"""Characters of an error's hint, which may list the names of all frames."""


def write_reproduced_table(
    table: PublishedTable,
    dataset: Dataset,
    methods: Sequence[tuple[str, DepthMethod]],
    out: Path,
    protocol: str,
    caps_m: Sequence[float],
    pictures: int,
) -> int:
    """Make a table of chapter 2: predict what is missing, measure, join with printed rows, write.

    Args:
        table: the printed table.
        dataset: frames with truth.
        methods: each with the name of the printed row that it reproduces, or "" for none.
        out: folder of the files.
        protocol: name of the protocol by which the predictions are measured.
        caps_m: truth beyond a cap [m] does not count; a row for each.
        pictures: frames of each method that the page shows.

    Returns:
        The exit code.
    """
    # All that decides the numbers.
    settings = {
        "table": table.number,
        "dataset": dataset.name,
        "frames": len(dataset),
        "frames_sha256": _hash_frames(dataset.frames),
        "protocol": protocol,
        "caps_m": list(caps_m),
        "methods": {method.name: method.settings for _, method in methods},
    }
    results = (*page.list_table_files("rows", "frames", "confidence"), "report.md", "report.html")
    claim_folder(out, settings, (*results, "predictions", "figures"))

    # Predict, in all processes; the first measures and joins.
    rule = find_protocol(protocol)
    predictions_folder = out / "predictions"
    folders = [
        predict_depth_of_dataset(dataset, method, rule, predictions_folder) for _, method in methods
    ]
    if find_rank().rank > 0:
        return 0
    evaluations = measure_folders(dataset, folders, protocol, caps_m)
    measured = join_evaluations(evaluations)
    reproduced = [printed_row for printed_row, _ in methods for _ in caps_m]
    rows = join_published(table, list(zip(reproduced, measured.rows, strict=True)))
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
        *write_detail_tables(measured, out),
        _make_settings_section([method for _, method in methods]),
    ]
    write_report(f"{table.title}, on {dataset.name}", sections, out)
    for name, reason in measured.skipped.items():
        print(f"skipped: {name}: {reason}", file=sys.stderr)
    print(f"{len(measured.skipped)} frames skipped")
    return 0


def _hash_frames(frames: Sequence[FramePaths]) -> str:
    """Compute the SHA-256 of the paths of the left images."""
    paths = "".join(f"{frame.left.resolve()}\n" for frame in frames)
    return hashlib.sha256(paths.encode()).hexdigest()


def _make_settings_section(methods: Sequence[DepthMethod]) -> Section:
    """Make a section of the settings of each method, a row for each setting."""
    rows = [
        {"method": method.name, "setting": name, "value": str(value)}
        for method in methods
        for name, value in method.settings.items()
    ]
    return Section(title="Settings", rows=rows)


def _make_figure_sections(
    method: DepthMethod, dataset: Dataset, out: Path, frame_count: int
) -> list[Section]:
    """Draw figure 2-5 of some frames that a method predicted, and figure 2-1 of the first.

    Figure 2-1 is left out where the method synthesised no right view, or there is no real one.

    Args:
        method: its predictions are in ``OUT/predictions/METHOD``.
        dataset: the frames.
        out: folder of the report; the panels are written to ``OUT/figures/METHOD``.
        frame_count: how many frames.
    """
    predictions = out / "predictions" / method.name
    figures_folder = out / "figures" / method.name
    frames = [frame for frame in dataset.frames if has_prediction(predictions, frame.name)]
    predicted = replace(dataset, frames=frames)
    sections: list[Section] = []
    for k, index in enumerate(choose_frames(predicted, frame_count)):
        pair = predicted.read_input(index)
        lidar_m = _read_lidar(frames[index])
        estimate = read_estimate(predictions, pair)
        figures = {"2-5": draw_figure_2_5(pair, lidar_m, estimate)}
        if k == 0 and estimate.right is not None and pair.right is not None:
            stereo = method.estimator.estimate_input(pair)
            figures["2-1"] = draw_figure_2_1(pair, lidar_m, estimate, stereo)
        for figure, panels in figures.items():
            title = f"Figure {figure}: {method.name}, {pair.name}"
            sections.append(
                _make_panel_section(title, panels, figures_folder / f"{figure}_{pair.name}")
            )
    return sections


def _read_lidar(frame: FramePaths) -> Float[Tensor, "h w"] | None:
    """Read the LiDAR depth (camera z) of a frame; None where it has none."""
    return read_lidar_depth(frame, "camera_z") if has_lidar(frame, "camera_z") else None


def write_report(title: str, sections: Sequence[Section], out: Path) -> None:
    """Write report.md and report.html of a table, and print its rows."""
    page.write_markdown(out / "report.md", title, sections, describe_environment())
    page.write_page(out / "report.html", title, sections, describe_environment())
    print(page.format_markdown_table(sections[0].rows))
    print(f"the page: {out / 'report.html'}")


def find_frames(dataset: Dataset, names: Sequence[str]) -> list[int]:
    """Find the indices of frames by their names.

    Raises:
        InputError: there is no frame of a name.
    """
    index_of = {frame.name: i for i, frame in enumerate(dataset.frames)}
    unknown = [name for name in names if name not in index_of]
    if unknown:
        hint = suggest_name(unknown[0], index_of)[:_MAX_HINT_LENGTH]
        raise InputError(f"{dataset.name}: no frame {unknown[0]!r}; {hint}")
    return [index_of[name] for name in names]


def choose_frames(dataset: Dataset, count: int) -> list[int]:
    """Choose frames, spread over the dataset; return their indices.

    They have a right view if any frame has one, and LiDAR too, if any such frame has.
    """
    frames = range(len(dataset.frames))
    pairs = [i for i in frames if dataset.frames[i].right is not None] or list(frames)
    candidates = [i for i in pairs if has_lidar(dataset.frames[i], "camera_z")] or pairs
    return [candidates[k] for k in page.spread_evenly(len(candidates), max(1, count))]


def write_figure(
    figure: str, dataset: Dataset, indices: Sequence[int], method: DepthMethod, out: Path
) -> int:
    """Estimate frames, draw figure 2-1 or 2-5 of them, and write it with a page.

    Args:
        figure: number of the figure in the thesis.
        dataset: the frames.
        indices: which of them, a column of the figure each.
        method: estimates their depth; for figure 2-1 from the left view, and from the real pair.
        out: folder of the figure.

    Returns:
        The exit code.
    """
    frames = [dataset.frames[index] for index in indices]
    settings = {
        "command": f"figure {figure}",
        "frames": [frame.name for frame in frames],
        "frames_sha256": _hash_frames(frames),
        "method": method.settings,
    }
    claim_folder(out, settings, (f"figure-{figure}.png", "panels", "report.html"))

    columns: list[list[Drawing]] = []
    sections: list[Section] = []
    for index, frame in zip(tqdm(indices, unit=" frames", disable=None), frames, strict=True):
        pair = dataset.read_input(index)
        lidar_m = _read_lidar(frame)
        views = pair if method.with_right else replace(pair, right=None)
        estimate = method.estimator.estimate_input(views)
        if figure == "2-5":
            panels = draw_figure_2_5(pair, lidar_m, estimate)
        else:
            stereo = method.estimator.estimate_input(pair)  # with the real right view
            panels = draw_figure_2_1(pair, lidar_m, estimate, stereo)
        columns.append(panels)
        sections.append(_make_panel_section(frame.name, panels, out / "panels" / frame.name))

    path = out / f"figure-{figure}.png"
    write_image(path, arrange_columns(columns))
    sections.append(_make_settings_section([method]))
    page.write_page(out / "report.html", f"Figure {figure}", sections, describe_environment())
    captions = "; ".join(panel.caption for panel in columns[0])
    print(f"{path}: each column from top to bottom: {captions}. {DEPTH_SCALE}; see the bar below.")
    return 0


def _make_panel_section(title: str, panels: Sequence[Drawing], stem: Path) -> Section:
    """Write each panel as a file, STEM.1.jpg, ..., and make a section that shows them.

    The files are small, since a page may show many.
    """
    pictures: list[PictureFile] = []
    for k, panel in enumerate(panels, 1):
        path = stem.with_name(f"{stem.name}.{k}.jpg")
        write_image(path, resize_to_width(panel.image, PANEL_WIDTH_PX))
        pictures.append(PictureFile(path=path, caption=panel.caption, color_bar=panel.color_bar))
    return Section(title=title, text=DEPTH_SCALE, pictures=pictures)
