"""The parts of a report page, and their writing: 3D views, pictures, videos and tables.

A page is one HTML file that needs no other; ``viewer.js``, which is written into it, draws the 3D
views. Tables are written as Markdown, CSV and JSON too.
"""

import base64
import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import numpy as np
import torch
from jaxtyping import Float, Int64
from jinja2 import Environment, PackageLoader, StrictUndefined
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.draw import NEAR_TO_FAR, Rgb
from depthpose.core.files import PointCloud, encode_image, image_size, read_image, write_json
from depthpose.core.files.disk import write_bytes

MOST_POINTS = 60_000
"""Most points of one cloud on a page: 0.7 MB of text."""
MOST_LINES = 20_000
"""Most pieces of line of one layer on a page."""

_GREY = 0.55
"""Grey of points without a colour: visible on white and on black."""
_STEPS = 65535
"""Steps into which the extent of a layer is divided along each axis, for 16 bits."""
_AXIS_COLORS: tuple[Rgb, ...] = ((0.85, 0.2, 0.2), (0.15, 0.65, 0.25), (0.25, 0.45, 0.95))
"""Red, green and blue, of the axes x, y and z."""
_SAMPLING_SEED = 0
"""Makes the thinning of a layer the same every time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LineSegments:
    """Line segments in a 3D view."""

    ends_m: Float[Tensor, "n 2 3"]  #: both ends of each [m]
    color: Float[Tensor, "n 3"]  #: RGB in [0, 1] of each


@dataclass(frozen=True, kw_only=True, eq=False)
class Layer:
    """A part of a 3D view that can be shown and hidden."""

    name: str  #: label in the viewer; layers of one name are hidden together
    shape: PointCloud | LineSegments  #: finite, in metres, in the camera's frame
    is_shown: bool = True  #: whether it is visible when the page opens


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A 3D view: layers drawn together."""

    caption: str  #: text below the view
    layers: Sequence[Layer]

    def encode(self) -> dict[str, Any]:
        """Encode the view as the JSON object that ``viewer.js`` reads.

        Coordinates are 16-bit steps of 1/65535 of a layer's extent (1.2 mm in a street of 80 m),
        colours 8 bits a channel, both in base64. Large layers are thinned, and ``note`` names them.
        """
        encoded_layers: list[dict[str, Any]] = []
        notes: list[str] = []
        for layer in self.layers:
            shape = layer.shape
            if isinstance(shape, PointCloud):
                kind = "points"
                max_count = MOST_POINTS
                coordinates_m = shape.points
                color = shape.color
                color = torch.full_like(coordinates_m, _GREY) if color is None else color
            else:
                kind = "lines"
                max_count = MOST_LINES
                coordinates_m = shape.ends_m
                color = shape.color

            count = len(coordinates_m)
            if count > max_count:
                notes.append(f"{layer.name}: {max_count} of {count}, thinned evenly")
                sampled = _sample_runs(count, max_count)
                coordinates_m = coordinates_m[sampled]
                color = color[sampled]
            encoded = {
                "name": layer.name,
                "kind": kind,
                "shown": layer.is_shown,
                "count": len(coordinates_m),
                **_encode_coordinates(coordinates_m),
                "colors": _encode_colors(color),
            }
            encoded_layers.append(encoded)
        return {"caption": self.caption, "note": "; ".join(notes), "layers": encoded_layers}


def _sample_runs(total: int, count: int) -> Int64[Tensor, " count"]:
    """Choose ``count`` of ``total`` indices: a random one of each of ``count`` equal runs.

    Equal steps through the pixels of a depth image would leave lines of points. The choice is the
    same every time.
    """
    generator = torch.Generator().manual_seed(_SAMPLING_SEED)
    offsets = torch.rand(count, generator=generator, dtype=torch.float64)  # within each run
    chosen = ((torch.arange(count) + offsets) * (total / count)).long()
    return chosen.clamp(max=total - 1)


def _encode_coordinates(coordinates_m: Float[Tensor, "*shape 3"]) -> dict[str, Any]:
    """Encode coordinates as ``places``: base64 of 16-bit steps from the least along each axis.

    Returns:
        ``places``; ``low``, the least coordinates [m]; ``step``, the length of a step [m].
    """
    flat_m = coordinates_m.detach().cpu().numpy().astype(np.float64).reshape(-1, 3)
    low = flat_m.min(0) if len(flat_m) else np.zeros(3)
    step = (flat_m.max(0) - low) / _STEPS if len(flat_m) else np.zeros(3)
    # Along an axis without extent all are at step 0.
    steps = np.round((flat_m - low) / np.where(step > 0, step, 1))
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "places": base64.b64encode(steps.astype("<u2").tobytes()).decode(),
    }


def _encode_colors(color: Float[Tensor, "n 3"]) -> str:
    """Encode colours in [0, 1] as base64 of 8 bits a channel."""
    values = (color.detach().cpu().clamp(0, 1) * 255).round().byte()
    return base64.b64encode(values.numpy().tobytes()).decode()


def read_page_file(name: Literal["viewer.js", "page.css"]) -> str:
    """Read a file that pages embed: ``page.css``, the style of all, or ``viewer.js``.

    The script defines ``showScene(element, scene)``, which draws a scene of :meth:`Scene.encode`.
    """
    return files("depthpose.report").joinpath(name).read_text(encoding="utf-8")


def make_lines(ends_m: Float[Tensor, "n 2 3"], color: Rgb) -> LineSegments:
    """Make line segments of one colour from both ends of each [m]."""
    return LineSegments(ends_m=ends_m, color=torch.tensor(color).expand(len(ends_m), 3))


def make_frame_axes(
    origin_m: Float[Tensor, "3"], R: Float[Tensor, "3 3"], length_m: float
) -> LineSegments:
    """Make three line segments that show a frame: its x axis red, y green, z blue.

    Args:
        origin_m: origin of the frame, in the camera's frame [m].
        R: rotation from the frame to the camera's; its columns are the axes.
        length_m: length of each segment [m].
    """
    tips_m = origin_m + length_m * R.mT
    ends_m = torch.stack([origin_m.expand(3, 3), tips_m], 1)
    return LineSegments(ends_m=ends_m.float(), color=torch.tensor(_AXIS_COLORS))


MOST_VIEWS = 6
"""Most inputs that a page shows with pictures."""
_LEAST_REFUSALS = 2
"""Refused inputs among them at least, if there are as many."""


def spread_evenly(total: int, count: int) -> list[int]:
    """Choose ``count`` indices below ``total``: the middle of each of ``count`` equal parts.

    All indices where there are fewer.
    """
    count = min(count, total)
    return [(2 * k + 1) * total // (2 * count) for k in range(count)]


def choose_views(has_estimate: Sequence[bool]) -> list[int]:
    """Choose the inputs that a page shows: some with an estimate and some refused ones.

    Returns:
        Indices of ``MOST_VIEWS`` inputs at most, in order; of either kind spread evenly.
    """
    estimated = [index for index, is_estimated in enumerate(has_estimate) if is_estimated]
    refused = [index for index, is_estimated in enumerate(has_estimate) if not is_estimated]
    # Refused inputs get the room that the others leave, but never less than a few places.
    refused_count = min(len(refused), max(_LEAST_REFUSALS, MOST_VIEWS - len(estimated)))
    chosen = [refused[i] for i in spread_evenly(len(refused), refused_count)]
    chosen += [estimated[i] for i in spread_evenly(len(estimated), MOST_VIEWS - refused_count)]
    return sorted(chosen)


def choose_ranked(errors: Sequence[float], most: int = 3) -> list[tuple[str, int]]:
    """Choose the worst, the median and the best of finite errors: the first ``most`` of these.

    Returns:
        The word and the index of each. Of two errors there is no median; a single one is ``only``.
    """
    order = sorted(range(len(errors)), key=errors.__getitem__)
    if len(order) <= 1:
        return [("only", index) for index in order][:most]
    chosen = [("worst", order[-1]), ("best", order[0])]
    if len(order) > 2:
        chosen.insert(1, ("median", order[(len(order) - 1) // 2]))
    return chosen[:most]


def share_views(sets: int) -> list[int]:
    """Share the views of a page among sets of predictions; return the number of views of each set.

    Where there are more than ``MOST_VIEWS`` sets, the last get none.
    """
    each = max(1, MOST_VIEWS // max(1, sets))
    return [each if index * each < MOST_VIEWS else 0 for index in range(sets)]


Row = Mapping[str, Any]
"""A row of a table: values by the names of their columns."""

_LEAST_GAP = 0.08
"""Between two marks of a colour bar, as a share of its length: nearer ones would touch."""
_MOST_PIXELS = 480_000
"""Most pixels of a picture that is encoded for a page; a frame of KITTI keeps its size."""
_JPEG_QUALITY = 85
_ENCODING_ERRORS = "backslashreplace"
"""How names of files are written whose bytes are no UTF-8."""
_MOST_PICTURE_BYTES = 250_000
"""Largest picture file that is embedded as it is; a larger one is encoded anew."""
_MOST_FILM_BYTES = 8_000_000
"""Largest video file that is embedded; the page links to a larger one."""


@dataclass(frozen=True, kw_only=True)
class ColorBar:
    """The colour bar of a picture: its colours and their meaning."""

    title: str  #: the quantity, with its unit
    colors: Sequence[Rgb]  #: colours at even steps from left to right
    marks: Sequence[tuple[float, str]]  #: positions, 0 (left) to 1, and the text at each


def make_depth_color_bar(near_m: float = 3.0, far_m: float = 80.0) -> ColorBar:
    """Make the colour bar of ``core.draw.draw_depth``: logarithmic, marked at round metres."""
    marks = [(0.0, f"{near_m:g}"), (1.0, f"{far_m:g}")]
    exponents = range(math.floor(math.log10(near_m)), math.ceil(math.log10(far_m)) + 1)
    round_metres = [digit * 10.0**exponent for exponent in exponents for digit in (1, 2, 5)]
    for round_m in round_metres:
        position = math.log(round_m / near_m) / math.log(far_m / near_m)
        has_room = all(abs(position - other) >= _LEAST_GAP for other, _ in marks)
        if has_room and 0 < position < 1:
            marks.append((position, f"{round_m:g}"))
    return ColorBar(title="depth [m]", colors=NEAR_TO_FAR, marks=sorted(marks))


def make_rising_color_bar(title: str, top: float, *, has_more: bool = False) -> ColorBar:
    """Make the colour bar of a quantity that is dark at 0 and bright at ``top``.

    Args:
        title: the quantity, with its unit.
        top: value of the brightest colour.
        has_more: larger values have that colour too, which a ``+`` says.
    """
    last_mark = f"{top:g}+" if has_more else f"{top:g}"
    marks = [(0.0, "0"), (0.5, f"{top / 2:g}"), (1.0, last_mark)]
    return ColorBar(title=title, colors=NEAR_TO_FAR[::-1], marks=marks)


@dataclass(frozen=True, kw_only=True)
class PictureFile:
    """A picture file on a page."""

    path: Path
    caption: str
    color_bar: ColorBar | None = None  #: meaning of its colours; None: they are no values


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawing:
    """A picture on a page that has no file of its own."""

    image: Float[Tensor, "3 h w"]
    caption: str
    color_bar: ColorBar | None = None


def embed_picture(
    picture: PictureFile | Drawing, most_pixels: int = _MOST_PIXELS
) -> tuple[int, int, str]:
    """Encode a picture as a ``data:`` address, so that a page needs no other file.

    A small file is taken as it is. Any other picture becomes a JPEG, shrunk to about
    ``most_pixels`` with its proportions kept.

    Returns:
        Width and height of the picture before it is shrunk [px], with which a page reserves its
        place, and the address.
    """
    if isinstance(picture, PictureFile) and picture.path.stat().st_size <= _MOST_PICTURE_BYTES:
        kind = "jpeg" if picture.path.suffix.lower() in (".jpg", ".jpeg") else "png"
        data = base64.b64encode(picture.path.read_bytes()).decode()
        return *image_size(picture.path), f"data:image/{kind};base64,{data}"
    image = read_image(picture.path) if isinstance(picture, PictureFile) else picture.image
    height, width = image.shape[1:]
    scale = math.sqrt(most_pixels / (height * width))
    if scale < 1:
        size = (max(1, int(height * scale)), max(1, int(width * scale)))
        image = F.interpolate(image[None], size, mode="area")[0]
    data = base64.b64encode(encode_image(image, "drawing.jpg", _JPEG_QUALITY)).decode()
    return width, height, f"data:image/jpeg;base64,{data}"


@dataclass(frozen=True, kw_only=True)
class Film:
    """A video file on a page: embedded if it is small, else linked."""

    path: Path
    caption: str

    @property
    def address(self) -> str:
        """Make the address of the video: its content (``data:``), or its name if it is large."""
        if self.path.stat().st_size > _MOST_FILM_BYTES:
            return quote(self.path.name)
        return "data:video/mp4;base64," + base64.b64encode(self.path.read_bytes()).decode()


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of a page; its contents are shown in the order of these fields."""

    title: str
    text: str = ""  #: a paragraph
    facts: Sequence[tuple[str, str]] = ()  #: names and values
    pictures: Sequence[PictureFile | Drawing] = field(default_factory=tuple)
    films: Sequence[Film] = ()
    rows: Sequence[Row] = ()  #: rows of a table that can be sorted
    tables: Mapping[str, Sequence[Sequence[str]]] = field(default_factory=dict)
    """Small tables by their captions; the rows of each are of equal length."""
    scenes: Sequence[Scene] = field(default_factory=tuple)  #: 3D views


def list_table_files(*names: str) -> list[str]:
    """List the files that :func:`write_table` writes for tables of these names."""
    files: list[str] = []
    for name in names:
        markdown_stem = "table" if name == "rows" else name
        files += [f"{name}.json", f"{name}.csv", f"{markdown_stem}.md"]
    return files


def write_table(folder: Path, rows: Sequence[Row], name: str = "rows") -> None:
    """Write a table as ``NAME.json`` and ``NAME.csv``, with every digit, and as ``NAME.md``.

    The last is called ``table.md`` where the name is ``rows``.
    """
    as_json, as_csv, as_markdown = list_table_files(name)
    write_json(folder / as_json, [dict(row) for row in rows])
    text = io.StringIO()
    writer = csv.DictWriter(text, list_columns(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_bytes(folder / as_csv, text.getvalue().encode(errors=_ENCODING_ERRORS))
    write_bytes(folder / as_markdown, format_markdown_table(rows).encode(errors=_ENCODING_ERRORS))


def format_markdown_table(rows: Sequence[Row]) -> str:
    """Format a table as Markdown; "none" if it has no rows."""
    if not rows:
        return "none\n"
    names = list_columns(rows)
    lines = [names, ["---"] * len(names)]
    lines += [[format_value(row.get(name)).replace("|", "\\|") for name in names] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def format_plain_table(rows: Sequence[Row], names: Sequence[str] = ()) -> str:
    """Format a table for a terminal; columns without a value are left out.

    Args:
        rows: the rows.
        names: columns to show, in this order; by default all.
    """
    shown_names = [
        name
        for name in names or list_columns(rows)
        if any(row.get(name) not in (None, "") for row in rows)
    ]
    lines = [shown_names]
    lines += [[format_value(row.get(name)) for name in shown_names] for row in rows]

    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    text = ""
    for line in lines:
        cells = [cell.ljust(width) for cell, width in zip(line, widths, strict=True)]
        text += "  ".join(cells).rstrip() + "\n"
    return text


def write_markdown(
    path: Path, title: str, sections: Sequence[Section], environment: Mapping[str, str]
) -> None:
    """Write the titles, texts and rows of the sections as Markdown, and below them the environment.

    Arguments are those of :func:`write_page`.
    """
    parts = [f"# {title}\n"]
    for section in sections:
        parts.append(f"## {section.title}\n")
        if section.text:
            parts.append(f"{section.text}\n")
        if section.rows:
            parts.append(format_markdown_table(section.rows))
    parts.append(" · ".join(f"{name} {value}" for name, value in environment.items()) + "\n")
    write_bytes(path, "\n".join(parts).encode(errors=_ENCODING_ERRORS))


def list_columns(rows: Sequence[Row]) -> list[str]:
    """List the names of all columns that any row has, in order of their first appearance."""
    return list(dict.fromkeys(name for row in rows for name in row))


_COLUMN_MEANINGS = {
    "abs_rel": "mean of |predicted - true| / true",
    "alternatives": "other poses that fit as well, and their probability",
    "ar": "BOP's average recall: the mean of ar_vsd, ar_mssd and ar_mspd",
    "auc": "area under the recall of ADD(-S) up to 10 cm",
    "ause": "how badly the confidence ranks the errors: 0 as the errors themselves",
    "certainty": "probability that this pose, and none that looks alike, is the right one",
    "copies": "near-symmetric copies that fit too and are named; the error is the nearest one's",
    "coverage": "share that has an answer",
    "d1": "share of pixels whose depth is within a factor of 1.25; d2, d3: of its powers",
    "d1_all": "share of pixels off by more than 3 px and by more than 5 % of the truth",
    "epe_px": "mean error of disparity",
    "error_mm": "ADD, or ADD-S where the part is symmetric",
    "fit": "share of what the camera saw of the posed surface that agrees with it",
    "identity": "whether copies of other sizes and the mirror image are excluded",
    "ms_total": "milliseconds of the whole estimate; ms_network: of its network",
    "of_diameter": "the error as a share of the part's diameter; right below a tenth",
    "refused": "share without an answer",
    "rmse": "root of the mean squared error of depth [m]",
    "success": "share with ADD(-S) below a tenth of the diameter; 84 % of 25 stand for 65 to 94 %",
    "visible_fraction": "share of the part's pixels that nothing hides",
    "wrong": "share with an answer that is no success",
}
"""Shown when the pointer is on the head of a column."""


def format_value(value: object) -> str:
    """Format a cell of a table; None as ``""``.

    Whole floats other than 0 have no decimals; all others, and 0 (``0.0000``), have four.
    """
    match value:
        case None:
            return ""
        case float():
            return f"{value:.0f}" if value.is_integer() and abs(value) >= 1 else f"{value:.4f}"
        case _:
            return str(value)


def write_page(
    path: Path, title: str, sections: Sequence[Section], environment: Mapping[str, str]
) -> None:
    """Write one HTML file that shows the sections and needs neither network nor other files.

    Args:
        path: the file.
        title: title of the page.
        sections: contents of the page.
        environment: what the results were computed with, by name
            (:func:`depthpose.core.environment.describe_environment`).
    """
    templates = Environment(
        loader=PackageLoader("depthpose.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.globals.update(
        format_value=format_value,
        list_columns=list_columns,
        read_page_file=read_page_file,
        embed_picture=embed_picture,
        about=_COLUMN_MEANINGS,
    )
    html = templates.get_template("report.html").render(
        title=title, sections=sections, environment=environment
    )
    write_bytes(path, html.encode(errors=_ENCODING_ERRORS))
