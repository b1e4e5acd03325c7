"""The page of ``depthpose depth predict`` and ``depth match``: some results, every failure."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from depthpose.cli.depth.inputs import InputReader, select_result_names
from depthpose.core import run_folder
from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError
from depthpose.core.files.disk import read_text
from depthpose.depth.predictions import is_finished, read_estimate
from depthpose.depth.types import DepthInput
from depthpose.report.depth import make_depth_section
from depthpose.report.page import MOST_VIEWS, Film, Section, spread_evenly, write_page

PAGE = "report.html"
VIDEO_ENDING = ".color.mp4"
"""Ending of the video of a video's depth."""


def write_depth_page(
    sources: Sequence[tuple[Path, ...]],
    reader: InputReader,
    range_m: tuple[float, float],
    out: Path,
    failures: Sequence[str],
) -> None:
    """Write a page of some of the finished depth maps, of every failure and of every warning.

    Args:
        sources: the file of each image or video, or the files of each pair.
        reader: reads those that are shown.
        range_m: depths of the brightest and the darkest colour.
        out: folder of the results, and of the page.
        failures: why inputs have no result.
    """
    # The finished results of each input, and those that are shown.
    finished = {name for name in run_folder.read_results(out) if is_finished(out, name)}
    names_of = {files: select_result_names(finished, files) for files in sources}
    names = [name for names_of_source in names_of.values() for name in names_of_source]
    shown_names = {names[k] for k in spread_evenly(len(names), MOST_VIEWS)}
    shown_inputs = list(_read_shown(names_of, reader, shown_names))

    selection = "all" if len(shown_inputs) == len(names) else "spread evenly"
    number = f"{len(names)} depth map{'s' * (len(names) != 1)}"
    text = f"Shown: {len(shown_inputs)} of {number} in this folder ({selection})."
    rows = [{"not estimated, because": reason} for reason in failures]
    rows += [{"warning": warning} for warning in _read_warnings(names, out)]
    sections = [Section(title="What is here", text=text, rows=rows)]

    near_m, far_m = range_m
    colors = f"depth, {near_m:g} m bright to {far_m:g} m dark"
    videos = sorted(out.glob(f"*{VIDEO_ENDING}"))
    films = [Film(path=path, caption=f"{path.name}: {colors}") for path in videos]
    if films:
        sections.append(Section(title="Videos", films=films))
    for depth_input in shown_inputs:
        estimate = read_estimate(out, depth_input)
        section = make_depth_section(depth_input.name, estimate, range_m=range_m)
        sections.append(section)
    title = f"Depth of {len(names)} image{'s' * (len(names) != 1)}"
    write_page(out / PAGE, title, sections, describe_environment())
    print(f"the page: {out / PAGE}")


def _read_warnings(names: Sequence[str], out: Path) -> Iterator[str]:
    """Read the warnings of results, by their names; most have none."""
    for name in names:
        warning_file = out / f"{name}.warning.txt"
        if warning_file.is_file():
            yield f"{name}: {read_text(warning_file).strip()}"


def _read_shown(
    names_of: Mapping[tuple[Path, ...], Sequence[str]], reader: InputReader, shown: Collection[str]
) -> Iterator[DepthInput]:
    """Read the inputs of the shown results again; one that is unreadable by now is left out.

    ``names_of``: the names of the results of each image, pair or video, by its files.
    """
    for files, names in names_of.items():
        shown_here = [name for name in names if name in shown]
        if not shown_here:
            continue
        with suppress(InputError):
            for job in reader.make_jobs(files):
                if job.name in shown_here:
                    yield job.read()
                if job.name == shown_here[-1]:
                    break
