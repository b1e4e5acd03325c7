"""The work behind ``depthpose reproduce`` and ``depthpose figure``."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from depthpose.cli.depth import evaluating
from depthpose.cli.depth.methods import Method, sgbm_method, weights_method
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import write_image
from depthpose.core.run import claim_folder, environment, find_rank
from depthpose.depth.config import MatcherConfig
from depthpose.depth.datasets import Dataset, Frame, has_lidar, lidar_truth
from depthpose.depth.evaluate import find_protocol
from depthpose.depth.predictions import has_prediction, read_estimate
from depthpose.report.choose import spread_evenly
from depthpose.report.tables import (
    Picture,
    Section,
    markdown_table,
    table_files,
    write_markdown,
    write_page,
    write_table,
)
from depthpose.thesis.depth_figures import (
    DEPTH_SCALE,
    Panel,
    arrange,
    draw_figure_2_1,
    draw_figure_2_5,
    shrink_to_width,
)
from depthpose.thesis.depth_tables import PublishedTable, join_published

_PICTURE_WIDTH_PX = 621
_RESULTS = (
    *table_files("rows", "frames", "confidence"),
    "report.md", "report.html", "predictions", "figures",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class TableSpec:
    """What to make: a table, on which frames, measured how."""

    table: PublishedTable
    dataset: Dataset
    protocol: str
    caps_m: tuple[float, ...]
    pictures: int


def refuse_wrong_count(table: PublishedTable, weights: Sequence[str], matcher: str | None) -> None:
    """Refuse, before any work, weights that cannot fill the table's own rows."""
    if matcher is not None and not table.with_right:
        raise InputError(
            f"--matcher {matcher}: matches pairs, and table {table.number} is of one image; "
            "table 2.2 takes it."
        )
    if not weights and matcher is None:
        more = " or --matcher sgbm" if table.with_right else ""
        raise InputError(
            f"table {table.number}: there is nothing to measure; give --weights FILE{more}."
        )
    if len(table.own) > 1 and len(weights) != len(table.own):
        rows = " and ".join(f"'{name}'" for name in table.own)
        raise InputError(
            f"table {table.number}: has the rows {rows}, but {len(weights)} weights were "
            "given; give one for each, in this order."
        )


def own_methods(
    table: PublishedTable, weights: Sequence[str], matcher: str | None, config: MatcherConfig
) -> list[tuple[str, Method]]:
    """Give each method with the thesis's own row that it stands for."""
    is_by_place = len(table.own) == len(weights)
    owns = table.own if is_by_place else [table.own[0]] * len(weights)
    chosen = [
        (own, weights_method(file, config, with_right=table.with_right))
        for own, file in zip(owns, weights, strict=True)
    ]
    names = [method.name for _, method in chosen]
    if len(set(names)) < len(names):
        raise InputError(
            f"two weights are called {names[0]!r}, and so would their predictions be: rename one."
        )
    if matcher is not None:
        chosen.append((table.own[0], sgbm_method(with_filled_holes=True)))
    return chosen


def reproduce_table(spec: TableSpec, methods: Sequence[tuple[str, Method]], out: Path) -> int:
    """Predict what is missing, measure, join with the published rows, and write everything."""
    claim_folder(out, _settings(spec, [method for _, method in methods]), _RESULTS)
    rule = find_protocol(spec.protocol)
    home = out / "predictions"
    folders = [evaluating.predict_all(spec.dataset, m, rule, home) for _, m in methods]
    if find_rank().rank > 0:
        return 0
    measured = evaluating.measure_all(spec.dataset, folders, spec.protocol, spec.caps_m)
    of_each = len(spec.caps_m)
    owns = [own for own, _ in methods for _ in range(of_each)]
    joined = join_published(spec.table, list(zip(owns, measured.rows, strict=True)))
    rows = evaluating.columns(joined)
    write_table(out, rows)
    evaluating.write_details(measured, out)
    sections = [
        Section(title="Published rows, ours, and difference", text=_say_how(spec), rows=rows),
        *_picture_sections(spec, [method for _, method in methods], out),
        *evaluating.detail_sections(measured),
        Section(title="Settings", rows=_setting_rows([method for _, method in methods])),
    ]
    title = f"{spec.table.title}, on {spec.dataset.name}"
    write_markdown(out / "report.md", title, sections, environment())
    write_page(out / "report.html", title, sections, environment())
    print(markdown_table(rows))
    evaluating.say_skipped(measured)
    print(f"the page: {out / 'report.html'}")
    return 0


def choose_frames(dataset: Dataset, names: Sequence[str], number: int) -> list[int]:
    """Give the indices of the frames that were named, or of some from all over the dataset.

    Frames chosen by us have a right view, and LiDAR where any frame has both.

    Raises:
        InputError: no frame of that name, or none with a right view.
    """
    if names:
        known = {frame.name: i for i, frame in enumerate(dataset.frames)}
        unknown = [name for name in names if name not in known]
        if unknown:
            hint = nearest_name(unknown[0], known)[:300]
            raise InputError(f"{dataset.name}: no frame {unknown[0]!r}; {hint}")
        return [known[name] for name in names]
    pairs = [i for i, frame in enumerate(dataset.frames) if frame.right is not None]
    seen = [i for i in pairs if has_lidar(dataset.frames[i], "camera_z")]
    chosen = seen or pairs
    if not chosen:
        raise InputError(f"{dataset.name}: no frame has a right view, which the figures show.")
    return [chosen[place] for place in spread_evenly(len(chosen), max(1, number))]


def write_figure(
    number: str, dataset: Dataset, indices: Sequence[int], method: Method, out: Path
) -> int:
    """Estimate the frames, draw the figure, and write it with a page that explains it."""
    frames = [dataset.frames[index] for index in indices]
    about = {"frames": [f.name for f in frames], "frames_sha256": _frames_hash(frames)}
    claim_figure(out, number, {**about, "method": method.settings})
    columns = [
        _draw_column(number, dataset, index, method)
        for index in tqdm(indices, unit=" frames", disable=None)
    ]
    path = out / f"figure-{number}.png"
    write_image(path, arrange(columns))
    sections = [
        Section(
            title=dataset.frames[index].name,
            text=DEPTH_SCALE,
            pictures=_write_panels(column, out / "panels" / dataset.frames[index].name),
        )
        for index, column in zip(indices, columns, strict=True)
    ]
    settings = Section(title="Settings", rows=_setting_rows([method]))
    write_page(out / "report.html", f"Figure {number}", [*sections, settings], environment())
    captions = "; ".join(panel.caption for panel in columns[0])
    print(f"{path}: each column from top to bottom: {captions}. {DEPTH_SCALE}; see the bar below.")
    return 0


def claim_figure(out: Path, number: str, settings: Mapping[str, Any]) -> None:
    """Claim a folder for a figure.

    Args:
        out: the folder.
        number: of the figure.
        settings: what decides its panels.

    Raises:
        InputError: it is another command's or another figure's, or holds files that would be
            written over.
    """
    files = (f"figure-{number}.png", "panels", "report.html")
    claim_folder(out, {"command": f"figure {number}", **settings}, files)


def _draw_column(number: str, dataset: Dataset, index: int, method: Method) -> list[Panel]:
    pair, lidar_m = dataset.read_input(index), _lidar(dataset, index)
    seen = pair if method.with_right else replace(pair, right=None)
    estimate = method.net.estimate_pair(seen)
    if number == "2-5":
        return draw_figure_2_5(pair, lidar_m, estimate)
    return draw_figure_2_1(pair, lidar_m, estimate, method.net.estimate_pair(pair))


def _picture_sections(spec: TableSpec, methods: Sequence[Method], out: Path) -> list[Section]:
    """Draw some frames of each method, from the files that were measured."""
    if spec.pictures < 1:
        return []
    sections: list[Section] = []
    for method in methods:
        folder = out / "predictions" / method.name
        frames = [f for f in spec.dataset.frames if has_prediction(folder, f.name)]
        shown = replace(spec.dataset, frames=frames)
        for place, index in enumerate(choose_frames(shown, (), spec.pictures)):
            pair, lidar_m = shown.read_input(index), _lidar(shown, index)
            estimate = read_estimate(folder, pair.name, pair.camera)
            figures = {"2-5": draw_figure_2_5(pair, lidar_m, estimate)}
            if place == 0 and estimate.right is not None and pair.right is not None:
                stereo = method.net.estimate_pair(pair)
                figures["2-1"] = draw_figure_2_1(pair, lidar_m, estimate, stereo)
            home = out / "figures" / method.name
            sections += [
                Section(
                    title=f"Figure {number}: {method.name}, {pair.name}",
                    text=DEPTH_SCALE,
                    pictures=_write_panels(panels, home / f"{number}_{pair.name}"),
                )
                for number, panels in figures.items()
            ]
    return sections


def _write_panels(panels: Sequence[Panel], home: Path) -> list[Picture]:
    """Write each panel as a picture of its own, small enough for a page of many."""
    pictures: list[Picture] = []
    for k, panel in enumerate(panels, 1):
        path = home.with_name(f"{home.name}.{k}.jpg")
        write_image(path, shrink_to_width(panel.image, _PICTURE_WIDTH_PX))
        pictures.append(Picture(path=path, caption=panel.caption, scale=panel.scale))
    return pictures


def _lidar(dataset: Dataset, index: int) -> Float[Tensor, "h w"] | None:
    frame = dataset.frames[index]
    return lidar_truth(frame, "camera_z") if has_lidar(frame, "camera_z") else None


def _settings(spec: TableSpec, methods: Sequence[Method]) -> dict[str, Any]:
    """What decides the results; the files of a run of other settings are not touched."""
    return {
        "table": spec.table.number,
        "dataset": spec.dataset.name,
        "frames": len(spec.dataset),
        "frames_sha256": _frames_hash(spec.dataset.frames),
        "protocol": spec.protocol,
        "caps_m": list(spec.caps_m),
        "methods": {method.name: method.settings for method in methods},
    }


def _frames_hash(frames: Sequence[Frame]) -> str:
    """Give the SHA-256 of the list of left images, a line each."""
    lines = "".join(f"{frame.left.resolve()}\n" for frame in frames)
    return hashlib.sha256(lines.encode()).hexdigest()


def _setting_rows(methods: Sequence[Method]) -> list[dict[str, Any]]:
    return [
        {"method": method.name, "setting": name, "value": str(value)}
        for method in methods
        for name, value in method.settings.items()
    ]


def _say_how(spec: TableSpec) -> str:
    how = evaluating.describe_protocol(spec.protocol)
    return (
        f"Ours: {how} The printed rows are of the 697 frames of eigen-test. Difference: ours minus "
        "the thesis's own row. A row of another protocol, or of other frames (see the columns), "
        "does not compare with the printed ones."
    )
