"""What a page shows: tables (also as Markdown, CSV, JSON), pictures, and clouds in 3D.

``viewer.js`` draws the clouds; the page is one HTML file that needs no other.
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

from depthpose.core.draw import NEAR_TO_FAR
from depthpose.core.files import Cloud, encode_image, image_size, read_image, write_json
from depthpose.core.files.disk import write_bytes

MOST_POINTS = 60_000
"""Most points of one cloud on a page: 0.7 MB of text."""
MOST_LINES = 20_000
"""Most pieces of line of one layer on a page."""

_GREY = 0.55
"""Grey of points without a colour: visible on white and on black."""
_STEPS = 65535
"""Steps into which the extent of a layer is divided along each axis, for 16 bits."""
_RED_GREEN_BLUE = ((0.85, 0.2, 0.2), (0.15, 0.65, 0.25), (0.25, 0.45, 0.95))


@dataclass(frozen=True, kw_only=True, eq=False)
class Lines:
    """Straight pieces of line."""

    ends_m: Float[Tensor, "n 2 3"]  #: both ends of each
    color: Float[Tensor, "n 3"]  #: RGB in [0, 1], one for each piece


@dataclass(frozen=True, kw_only=True, eq=False)
class Layer:
    """A part of a scene that can be hidden."""

    name: str  #: what the viewer calls it; layers of one name are hidden together
    shape: Cloud | Lines  #: coloured points (NaN left out), or lines; metres, camera frame
    is_shown: bool = True  #: whether it is seen at first


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """The content of one 3D view."""

    caption: str  #: stands below it
    layers: Sequence[Layer]  #: drawn together

    def encoded(self) -> dict[str, Any]:
        """Encode as the JSON that ``viewer.js`` reads: base64 of 16-bit places and 8-bit colours.

        Places are steps of 1/65535 of their extent: of a street of 80 m, 1.2 mm. ``note`` says
        which layers are thinned.
        """
        encoded_layers: list[dict[str, Any]] = []
        notes: list[str] = []
        for layer in self.layers:
            shape = layer.shape
            if isinstance(shape, Cloud):
                kind = "points"
                max_count = MOST_POINTS
                places = shape.points
                color = shape.color
                color = torch.full_like(places, _GREY) if color is None else color
            else:
                kind = "lines"
                max_count = MOST_LINES
                places = shape.ends_m
                color = shape.color

            if len(places) > max_count:
                notes.append(f"{layer.name}: {max_count} of {len(places)}, thinned evenly")
                sampled = _sample_runs(len(places), max_count)
                places = places[sampled]
                color = color[sampled]
            encoded = {
                "name": layer.name,
                "kind": kind,
                "shown": layer.is_shown,
                "count": len(places),
                **_encode_places(places),
                "colors": _encode_colors(color),
            }
            encoded_layers.append(encoded)
        return {"caption": self.caption, "note": "; ".join(notes), "layers": encoded_layers}


def _sample_runs(total: int, count: int) -> Int64[Tensor, " count"]:
    """Choose ``count`` of ``total`` rows: one at random of each of equal runs, always the same.

    Equal steps through the rows of a depth image would leave lines of points.
    """
    generator = torch.Generator().manual_seed(0)
    offsets = torch.rand(count, generator=generator, dtype=torch.float64)
    chosen = ((torch.arange(count) + offsets) * (total / count)).long()
    return chosen.clamp(max=total - 1)


def _encode_places(places: Float[Tensor, "*shape 3"]) -> dict[str, Any]:
    """Encode places as 16-bit steps from their least coordinates, with ``low`` and ``step``."""
    flat_m = places.detach().cpu().numpy().astype(np.float64).reshape(-1, 3)
    low = flat_m.min(0) if len(flat_m) else np.zeros(3)
    step = (flat_m.max(0) - low) / _STEPS if len(flat_m) else np.zeros(3)
    steps = np.round((flat_m - low) / np.where(step > 0, step, 1))
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "places": base64.b64encode(steps.astype("<u2").tobytes()).decode(),
    }


def _encode_colors(color: Float[Tensor, "n 3"]) -> str:
    """Encode colours in [0, 1] by 8 bits a channel."""
    values = (color.detach().cpu().clamp(0, 1) * 255).round().byte()
    return base64.b64encode(values.numpy().tobytes()).decode()


def page_file(name: Literal["viewer.js", "page.css"]) -> str:
    """Read the viewer, which defines ``showScene(element, scene)``, or the style of all pages."""
    return files("depthpose.report").joinpath(name).read_text(encoding="utf-8")


def colored_lines(ends_m: Float[Tensor, "n 2 3"], color: tuple[float, float, float]) -> Lines:
    """Make lines of one colour."""
    return Lines(ends_m=ends_m, color=torch.tensor(color).expand(len(ends_m), 3))


def frame_axes(origin_m: Float[Tensor, "3"], R: Float[Tensor, "3 3"], length_m: float) -> Lines:
    """Draw the axes of a frame (columns of R) in the camera frame: x red, y green, z blue.

    ``length_m``: length of each axis.
    """
    tips_m = origin_m + length_m * R.mT
    ends_m = torch.stack([origin_m.expand(3, 3), tips_m], 1)
    return Lines(ends_m=ends_m.float(), color=torch.tensor(_RED_GREEN_BLUE))


MOST_VIEWS = 6
"""Most inputs that a page shows by pictures."""
_LEAST_REFUSALS = 2
"""Refusals that are shown at least, if there are as many."""


def spread_evenly(total: int, count: int) -> list[int]:
    """Choose ``count`` numbers of 0 .. total - 1, the middle of each of equal parts.

    All of them where there are fewer.
    """
    count = min(count, total)
    return [(2 * k + 1) * total // (2 * count) for k in range(count)]


def choose_answers(is_ok: Sequence[bool]) -> list[int]:
    """Choose answers and some refusals to show, each spread evenly; give their indices in order."""
    answered = [k for k, ok in enumerate(is_ok) if ok]
    refused = [k for k, ok in enumerate(is_ok) if not ok]
    refused_count = min(len(refused), max(_LEAST_REFUSALS, MOST_VIEWS - len(answered)))
    chosen = [refused[i] for i in spread_evenly(len(refused), refused_count)]
    chosen += [answered[i] for i in spread_evenly(len(answered), MOST_VIEWS - refused_count)]
    return sorted(chosen)


def choose_ranked(errors: Sequence[float], most: int = 3) -> list[tuple[str, int]]:
    """Choose the worst, the median and the best of finite errors, ``most`` of them at most.

    Gives the role of each and its index; of two errors there is no median, and one is the only.
    """
    order = sorted(range(len(errors)), key=errors.__getitem__)
    if len(order) <= 1:
        return [("only", index) for index in order][:most]
    chosen = [("worst", order[-1]), ("best", order[0])]
    if len(order) > 2:
        chosen.insert(1, ("median", order[(len(order) - 1) // 2]))
    return chosen[:most]


def share_views(sets: int) -> list[int]:
    """Give the number of views of each of several sets of predictions on a page.

    Of many sets the last get none.
    """
    each = max(1, MOST_VIEWS // max(1, sets))
    return [each if k * each < MOST_VIEWS else 0 for k in range(sets)]


Row = Mapping[str, Any]

_LEAST_GAP = 0.08
"""Between two marks of a bar, as a share of its length: nearer ones would touch."""
_MOST_PIXELS = 480_000
"""Most pixels of a drawing on a page of many; a frame of KITTI keeps its size."""
_JPEG_QUALITY = 85
_ENCODING_ERRORS = "backslashreplace"
"""How names of files are written whose bytes are no UTF-8."""
_MOST_BYTES = 250_000
"""Largest size of a picture file that goes onto a page as it is."""
_MOST_FILM_BYTES = 8_000_000
"""Largest size of a video file on a page; a larger one is shown from its own file."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """The colour bar of a picture: its colours and their meaning."""

    title: str  #: the quantity, with its unit
    colors: Sequence[tuple[float, float, float]]  #: RGB in [0, 1] at even steps from left to right
    marks: Sequence[tuple[float, str]]  #: positions, 0 (left) to 1, and the text at each


def depth_scale(near_m: float = 3.0, far_m: float = 80.0) -> Scale:
    """Make the colour bar of ``core.draw.draw_depth``: logarithmic, with marks at round metres."""
    marks = [(0.0, f"{near_m:g}"), (1.0, f"{far_m:g}")]
    exponents = range(math.floor(math.log10(near_m)), math.ceil(math.log10(far_m)) + 1)
    round_metres = [digit * 10.0**exponent for exponent in exponents for digit in (1, 2, 5)]
    for round_m in round_metres:
        position = math.log(round_m / near_m) / math.log(far_m / near_m)
        has_room = all(abs(position - other) >= _LEAST_GAP for other, _ in marks)
        if has_room and 0 < position < 1:
            marks.append((position, f"{round_m:g}"))
    return Scale(title="depth [m]", colors=NEAR_TO_FAR, marks=sorted(marks))


def rising_scale(title: str, top: float, *, has_more: bool = False) -> Scale:
    """Make the colour bar of a quantity that is dark at 0 and bright at ``top``.

    Args:
        title: the quantity, with its unit.
        top: value of the brightest colour.
        has_more: larger values have that colour too.
    """
    marks = [(0.0, "0"), (0.5, f"{top / 2:g}"), (1.0, f"{top:g}{'+' if has_more else ''}")]
    return Scale(title=title, colors=NEAR_TO_FAR[::-1], marks=marks)


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture file with a caption."""

    path: Path
    caption: str
    scale: Scale | None = None  #: what its colours mean; None: they are no numbers


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawing:
    """A picture without a file of its own, small enough for a page of many."""

    image: Float[Tensor, "3 h w"]
    caption: str
    scale: Scale | None = None


def embed_picture(
    picture: Picture | Drawing, most_pixels: int = _MOST_PIXELS
) -> tuple[int, int, str]:
    """Embed a picture: its width and height [px], and its data as a ``data:`` address.

    With these the page needs no other file, and does not move while a picture loads. A small file
    is taken as it is; another picture is shrunk to about ``most_pixels``, its proportions kept.
    """
    if isinstance(picture, Picture) and picture.path.stat().st_size <= _MOST_BYTES:
        kind = "jpeg" if picture.path.suffix.lower() in (".jpg", ".jpeg") else "png"
        data = base64.b64encode(picture.path.read_bytes()).decode()
        return *image_size(picture.path), f"data:image/{kind};base64,{data}"
    image = read_image(picture.path) if isinstance(picture, Picture) else picture.image
    height, width = image.shape[1:]
    scale = math.sqrt(most_pixels / (height * width))
    if scale < 1:
        size = (max(1, int(height * scale)), max(1, int(width * scale)))
        image = F.interpolate(image[None], size, mode="area")[0]
    data = base64.b64encode(encode_image(image, "drawing.jpg", _JPEG_QUALITY)).decode()
    return width, height, f"data:image/jpeg;base64,{data}"


@dataclass(frozen=True, kw_only=True)
class Film:
    """A video file beside the page; a small one is on the page itself."""

    path: Path
    caption: str

    @property
    def address(self) -> str:
        """Make the address of the video: its bytes (``data:``), or its name if it is large."""
        if self.path.stat().st_size > _MOST_FILM_BYTES:
            return quote(self.path.name)
        return "data:video/mp4;base64," + base64.b64encode(self.path.read_bytes()).decode()


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of a page; what it holds is shown in this order."""

    title: str
    text: str = ""  #: a paragraph
    facts: Sequence[tuple[str, str]] = ()  #: names and values
    pictures: Sequence[Picture | Drawing] = field(default_factory=tuple)
    films: Sequence[Film] = ()
    rows: Sequence[Row] = ()  #: rows of a table that can be sorted
    tables: Mapping[str, Sequence[Sequence[str]]] = field(default_factory=dict)
    """Small tables by their captions; the rows of each are of equal length."""
    scenes: Sequence[Scene] = field(default_factory=tuple)  #: 3D views


def table_files(*names: str) -> list[str]:
    """Give the names of the files that :func:`write_table` writes for tables of these names."""
    files: list[str] = []
    for name in names:
        markdown_stem = "table" if name == "rows" else name
        files += [f"{name}.json", f"{name}.csv", f"{markdown_stem}.md"]
    return files


def write_table(folder: Path, rows: Sequence[Row], name: str = "rows") -> None:
    """Write rows as ``NAME.json``, ``NAME.csv`` with every digit and ``NAME.md``.

    The last is ``table.md`` where the name is ``rows``.
    """
    as_json, as_csv, as_markdown = table_files(name)
    write_json(folder / as_json, [dict(row) for row in rows])
    text = io.StringIO()
    writer = csv.DictWriter(text, column_names(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_bytes(folder / as_csv, text.getvalue().encode(errors=_ENCODING_ERRORS))
    write_bytes(folder / as_markdown, markdown_table(rows).encode(errors=_ENCODING_ERRORS))


def markdown_table(rows: Sequence[Row]) -> str:
    """Format rows as a Markdown table; "none" if there are no rows."""
    if not rows:
        return "none\n"
    names = column_names(rows)
    lines = [names, ["---"] * len(names)]
    lines += [[show_value(row.get(name)).replace("|", "\\|") for name in names] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def plain_table(rows: Sequence[Row], names: Sequence[str] = ()) -> str:
    """Format rows as a table for a terminal, with the columns of these names, by default all.

    Columns without a value are left out.
    """

    def has_value(name: str) -> bool:
        """Whether any row has a value in a column."""
        return any(row.get(name) not in (None, "") for row in rows)

    shown_names = list(filter(has_value, names or column_names(rows)))
    lines = [shown_names]
    lines += [[show_value(row.get(name)) for name in shown_names] for row in rows]

    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    text = ""
    for line in lines:
        cells = [cell.ljust(width) for cell, width in zip(line, widths, strict=True)]
        text += "  ".join(cells).rstrip() + "\n"
    return text


def write_markdown(
    path: Path, title: str, sections: Sequence[Section], environment: Mapping[str, str]
) -> None:
    """Write the text and tables of :func:`write_page` as Markdown, without pictures."""
    parts = [f"# {title}\n"]
    for section in sections:
        parts.append(f"## {section.title}\n")
        if section.text:
            parts.append(f"{section.text}\n")
        if section.rows:
            parts.append(markdown_table(section.rows))
    parts.append(" · ".join(f"{name} {value}" for name, value in environment.items()) + "\n")
    write_bytes(path, "\n".join(parts).encode(errors=_ENCODING_ERRORS))


def column_names(rows: Sequence[Row]) -> list[str]:
    """Give the names of all columns that any row has, in order of their first appearance."""
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


def show_value(value: object) -> str:
    """Format a value for a person: four decimals, whole numbers without any, nothing for None."""
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
    """Write one HTML file that shows the sections and needs no network and no other file.

    ``environment``: what the numbers were measured with (see ``core.run.environment``).
    """
    pages = Environment(
        loader=PackageLoader("depthpose.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    pages.globals.update(
        show_value=show_value,
        column_names=column_names,
        page_file=page_file,
        embed_picture=embed_picture,
        about=_COLUMN_MEANINGS,
    )
    html = pages.get_template("report.html").render(
        title=title, sections=sections, environment=environment
    )
    write_bytes(path, html.encode(errors=_ENCODING_ERRORS))
