"""The pages of ``depthpose depth predict``, ``match`` and ``evaluate``."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from depthpose.core.files.text import read_text
from depthpose.core.run import environment
from depthpose.depth.datasets import Dataset
from depthpose.depth.evaluate import PROTOCOLS, FrameRow, frame_result, ranking_metric
from depthpose.depth.predictions import COLOR_RANGE_M, read_estimate
from depthpose.depth.types import StereoInput
from depthpose.report.depth import DepthError, DepthShown, depth_section
from depthpose.report.page import (
    MOST_VIEWS,
    Section,
    choose_ranked,
    share_views,
    spread_evenly,
    write_page,
)

PAGE = "report.html"
_SAID_ABOVE = ("method", "input", "speed", "weights", "protocol", "dataset")


def write_depth_page(
    out: Path,
    names: Sequence[str],
    read: Callable[[Sequence[str]], Iterator[StereoInput]],
    failures: Sequence[str],
    range_m: tuple[float, float] = COLOR_RANGE_M,
) -> None:
    """Write a page of some of the depth maps that a folder holds, of warnings and of what failed.

    Args:
        out: the folder.
        names: of all that are there.
        read: gives what some of them were made of, as far as that can still be read.
        failures: why others are not there, a sentence each.
        range_m: metres of the brightest and the darkest colour.
    """
    chosen = [names[k] for k in spread_evenly(len(names), MOST_VIEWS)]
    pairs = list(read(chosen))
    which = "all" if len(pairs) == len(names) else "spread evenly"
    text = f"Shown: {len(pairs)} of {_count(len(names), 'depth map')} in this folder ({which})."
    noted = [{"not estimated, because": reason} for reason in failures]
    doubts = {name: out / f"{name}.warning.txt" for name in names}
    noted += [
        {"warning": f"{name}: {read_text(path).strip()}"}
        for name, path in doubts.items()
        if path.is_file()
    ]
    sections = [Section(title="What is here", text=text, rows=noted)]
    for pair in pairs:
        estimate = read_estimate(out, pair.name, pair.camera)
        shown = DepthShown(pair=pair, estimate=estimate, range_m=range_m)
        sections.append(depth_section(pair.name, shown))
    page = out / PAGE
    write_page(page, f"Depth of {_count(len(names), 'image')}", sections, environment())
    print(f"the page: {page}")


def frame_sections(
    dataset: Dataset,
    folders: Sequence[Path],
    rows: Sequence[Sequence[FrameRow]],
    protocol: str,
) -> list[Section]:
    """Show the worst, the median and the best frame of each set of predictions.

    Args:
        dataset: as it was measured.
        folders: of the predictions.
        rows: of each folder's frames, as they were measured.
        protocol: by which.
    """
    sections: list[Section] = []
    for folder, of_folder, most in zip(folders, rows, share_views(len(folders)), strict=True):
        cap_m = of_folder[0].cap_m
        of_cap = [row for row in of_folder if row.cap_m == cap_m and row.pixels]
        metric = ranking_metric(cap_m)
        sign = 1 if metric.better == "lower" else -1
        cap = "" if cap_m is None else f", truth up to {cap_m:g} m"
        for role, k in choose_ranked([sign * row.metrics[metric.name] for row in of_cap], most):
            value = of_cap[k].metrics[metric.name]
            frames = _count(len(of_cap), "frame")
            text = f"The {role} of {frames} by {metric.name}: {value:.4f}{cap}."
            title = f"{folder.name}: {of_cap[k].frame}, {role}"
            sections.append(_frame_section(dataset, of_cap[k], folder, protocol, title, text))
    return sections


def _frame_section(
    dataset: Dataset, row: FrameRow, folder: Path, protocol: str, title: str, text: str
) -> Section:
    index = next(i for i, frame in enumerate(dataset.frames) if frame.name == row.frame)
    found = frame_result(dataset, index, folder, protocol, row.cap_m)
    is_disparity = PROTOCOLS[protocol].truth == "disparity"
    error = DepthError(
        error=found.error, is_disparity=is_disparity, true_depth_m=found.true_depth_m
    )
    shown = DepthShown(pair=dataset.read_input(index), estimate=found.estimate, error=error)
    own = {name: value for name, value in row.columns().items() if name not in _SAID_ABOVE}
    return replace(depth_section(title, shown, text), rows=[own])


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
