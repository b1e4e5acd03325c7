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
from jaxtyping import Float
from jinja2 import Environment, PackageLoader, StrictUndefined
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.draw import NEAR_TO_FAR
from depthpose.core.files import Cloud, encode_image, image_size, read_image, write_json
from depthpose.core.files.disk import write_bytes

MOST_POINTS = 60_000
"""Most points of one cloud on a page: 0.7 MB of text."""
MOST_LINES = 20_000

_GREY = 0.55  # grey of points without a colour: visible on white and on black
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
    """What one 3D view shows."""

    caption: str  #: stands below it
    layers: Sequence[Layer]  #: drawn together

    def encoded(self) -> dict[str, Any]:
        """Give the JSON that ``viewer.js`` reads: base64 of 16-bit places and 8-bit colours.

        Places are steps of 1/65535 of their extent: of a street of 80 m, 1.2 mm. ``note`` says
        which layers are thinned.
        """
        layers: list[dict[str, Any]] = []
        thinned: list[str] = []
        for layer in self.layers:
            shape = layer.shape
            if isinstance(shape, Cloud):
                kind = "points"
                most = MOST_POINTS
                places = shape.points
                color = shape.color
                color = torch.full_like(places, _GREY) if color is None else color
            else:
                kind = "lines"
                most = MOST_LINES
                places = shape.ends_m
                color = shape.color
            if len(places) > most:
                thinned.append(f"{layer.name}: {most} of {len(places)}, thinned evenly")
                # One of each of equal runs, by chance, always the same ones: equal steps through
                # the rows of a depth image would leave lines of points.
                fixed = torch.Generator().manual_seed(0)
                chance = torch.rand(most, generator=fixed, dtype=torch.float64)
                sampled = ((torch.arange(most) + chance) * (len(places) / most)).long()
                sampled = sampled.clamp(max=len(places) - 1)
                places = places[sampled]
                color = color[sampled]
            bytes_of_color = (color.detach().cpu().clamp(0, 1) * 255).round().byte().numpy()
            flat_m = places.detach().cpu().numpy().astype(np.float64).reshape(-1, 3)
            low = flat_m.min(0) if len(flat_m) else np.zeros(3)
            step = (flat_m.max(0) - low) / 65535 if len(flat_m) else np.zeros(3)
            steps = np.round((flat_m - low) / np.where(step > 0, step, 1))
            encoded = {
                "name": layer.name,
                "kind": kind,
                "shown": layer.is_shown,
                "count": len(places),
                "low": low.tolist(),
                "step": step.tolist(),
                "places": base64.b64encode(steps.astype("<u2").tobytes()).decode(),
                "colors": base64.b64encode(bytes_of_color.tobytes()).decode(),
            }
            layers.append(encoded)
        return {"caption": self.caption, "note": "; ".join(thinned), "layers": layers}


def page_file(name: Literal["viewer.js", "page.css"]) -> str:
    """Read the viewer, which defines ``showScene(element, scene)``, or the style of all pages."""
    return files("depthpose.report").joinpath(name).read_text(encoding="utf-8")


def colored_lines(ends_m: Float[Tensor, "n 2 3"], color: tuple[float, float, float]) -> Lines:
    """Make lines of one colour."""
    return Lines(ends_m=ends_m, color=torch.tensor(color).expand(len(ends_m), 3))


def frame_axes(origin_m: Float[Tensor, "3"], R: Float[Tensor, "3 3"], length_m: float) -> Lines:
    """Draw the axes (columns of R) of a frame at a place of the camera: x red, y green, z blue."""
    tips_m = origin_m + length_m * R.mT
    ends_m = torch.stack([origin_m.expand(3, 3), tips_m], 1)
    return Lines(ends_m=ends_m.float(), color=torch.tensor(_RED_GREEN_BLUE))


MOST_VIEWS = 6
_REFUSED = 2  # refusals shown at least, where there are so many


def spread_evenly(total: int, count: int) -> list[int]:
    """Choose ``count`` of 0 .. total - 1, the middle of each equal part; all where there are fewer.

    None where ``count`` is 0.
    """
    count = min(count, total)
    return [(2 * k + 1) * total // (2 * count) for k in range(count)]


def choose_answers(is_ok: Sequence[bool]) -> list[int]:
    """Choose answers and some refusals, each spread evenly; give their places in order."""
    answered = [k for k, ok in enumerate(is_ok) if ok]
    refused = [k for k, ok in enumerate(is_ok) if not ok]
    refused_count = min(len(refused), max(_REFUSED, MOST_VIEWS - len(answered)))
    chosen = [refused[i] for i in spread_evenly(len(refused), refused_count)]
    chosen += [answered[i] for i in spread_evenly(len(answered), MOST_VIEWS - refused_count)]
    return sorted(chosen)


def choose_ranked(errors: Sequence[float], most: int = 3) -> list[tuple[str, int]]:
    """Choose the worst, the median and the best of finite errors; at most ``most``, each once."""
    order = sorted(range(len(errors)), key=errors.__getitem__)
    if len(order) <= 1:
        return [("only", place) for place in order][:most]
    places = [("worst", order[-1]), ("median", order[(len(order) - 1) // 2]), ("best", order[0])]
    if len(order) == 2:
        del places[1]
    return places[:most]


def share_views(sets: int) -> list[int]:
    """Give each of several sets of predictions its number of views; the last may get none."""
    each = max(1, MOST_VIEWS // max(1, sets))
    return [each if k * each < MOST_VIEWS else 0 for k in range(sets)]


Row = Mapping[str, Any]

_LEAST_GAP = 0.08  # of two marks on a bar, as a share of its length: nearer ones would touch
_MOST_PIXELS = 480_000
"""Most pixels of a drawing on a page of many; a frame of KITTI keeps its size."""
_QUALITY = 85
_ERRORS = "backslashreplace"  # of names of files whose bytes are no UTF-8
_MOST_BYTES = 250_000  # largest picture file that goes onto a page as it is
_MOST_FILM_BYTES = 8_000_000  # largest video file on a page; a larger one is shown from beside it


@dataclass(frozen=True, kw_only=True)
class Scale:
    """What the colours of a picture mean, for a colour bar."""

    title: str  #: of what, with its unit
    colors: Sequence[tuple[float, float, float]]  #: RGB in [0, 1] at even steps from left to right
    marks: Sequence[tuple[float, str]]  #: places, 0 (left) to 1, and what is written there


def depth_scale(near_m: float = 3.0, far_m: float = 80.0) -> Scale:
    """Give the bar of ``core.draw.draw_depth``, with round metres between its ends."""
    whole = math.log(far_m / near_m)
    ends = [(0.0, f"{near_m:g}"), (1.0, f"{far_m:g}")]
    exponents = range(math.floor(math.log10(near_m)), math.ceil(math.log10(far_m)) + 1)
    for round_m in (digit * 10.0**k for k in exponents for digit in (1, 2, 5)):
        place = math.log(round_m / near_m) / whole
        if all(abs(place - other) >= _LEAST_GAP for other, _ in ends) and 0 < place < 1:
            ends.append((place, f"{round_m:g}"))
    return Scale(title="depth [m]", colors=NEAR_TO_FAR, marks=sorted(ends))


def rising_scale(title: str, top: float, *, has_more: bool = False) -> Scale:
    """Give the bar of what is dark at 0 and bright at ``top``.

    Args:
        title: of what, with its unit.
        top: the brightest.
        has_more: whether what is beyond it is as bright.
    """
    marks = [(0.0, "0"), (0.5, f"{top / 2:g}"), (1.0, f"{top:g}{'+' if has_more else ''}")]
    return Scale(title=title, colors=NEAR_TO_FAR[::-1], marks=marks)


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture file with a caption, and with the bar of its colours where they are numbers."""

    path: Path
    caption: str
    scale: Scale | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawing:
    """A picture without a file of its own, small enough for a page of many."""

    image: Float[Tensor, "3 h w"]
    caption: str
    scale: Scale | None = None


def embedded(picture: Picture | Drawing, most_pixels: int = _MOST_PIXELS) -> tuple[int, int, str]:
    """Give a picture's width and height [px], and the picture as a ``data:`` address.

    So the page needs no other file, and does not move when the picture comes. A small file's own
    bytes are taken; another picture is shrunk to about so many pixels, its proportions kept.
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
    data = base64.b64encode(encode_image(image, "drawing.jpg", _QUALITY)).decode()
    return width, height, f"data:image/jpeg;base64,{data}"


@dataclass(frozen=True, kw_only=True)
class Film:
    """A video file beside the page; a small one is on the page itself."""

    path: Path
    caption: str

    @property
    def address(self) -> str:
        """Its bytes as a ``data:`` address, or its name."""
        if self.path.stat().st_size > _MOST_FILM_BYTES:
            return quote(self.path.name)
        return "data:video/mp4;base64," + base64.b64encode(self.path.read_bytes()).decode()


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of a page, in this order: its heading, a paragraph, names and values, pictures, films.

    Then a table that sorts, small tables by what they show (rows of equal length), and 3D views.
    """

    title: str
    text: str = ""
    facts: Sequence[tuple[str, str]] = ()
    pictures: Sequence[Picture | Drawing] = field(default_factory=tuple)
    films: Sequence[Film] = ()
    rows: Sequence[Row] = ()
    tables: Mapping[str, Sequence[Sequence[str]]] = field(default_factory=dict)
    scenes: Sequence[Scene] = field(default_factory=tuple)


def table_files(*names: str) -> list[str]:
    """Name the files that :func:`write_table` writes."""
    return [
        file
        for name in names
        for file in (f"{name}.json", f"{name}.csv", f"{'table' if name == 'rows' else name}.md")
    ]


def write_table(folder: Path, rows: Sequence[Row], name: str = "rows") -> None:
    """Write ``NAME.json``, ``NAME.csv`` (with every digit) and ``table.md``, else ``NAME.md``."""
    as_json, as_csv, as_markdown = table_files(name)
    write_json(folder / as_json, [dict(row) for row in rows])
    text = io.StringIO()
    writer = csv.DictWriter(text, column_names(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_bytes(folder / as_csv, text.getvalue().encode(errors=_ERRORS))
    write_bytes(folder / as_markdown, markdown_table(rows).encode(errors=_ERRORS))


def markdown_table(rows: Sequence[Row]) -> str:
    """Format rows as a Markdown table, columns by first appearance; no rows are the word none."""
    if not rows:
        return "none\n"
    names = column_names(rows)
    lines = [names, ["---"] * len(names)]
    lines += [[show_value(row.get(name)).replace("|", "\\|") for name in names] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def plain_table(rows: Sequence[Row], names: Sequence[str] = ()) -> str:
    """Format rows for a terminal, in columns of their own width: all, or those of some names.

    Columns without a value are left out.
    """
    wanted = [
        n for n in names or column_names(rows) if any(row.get(n) not in (None, "") for row in rows)
    ]
    cells = [wanted, *([show_value(row.get(name)) for name in wanted] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "".join(
        "  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() + "\n"
        for line in cells
    )


def write_markdown(
    path: Path, title: str, sections: Sequence[Section], environment: Mapping[str, str]
) -> None:
    """Write the text and tables of :func:`write_page` as Markdown, without pictures."""
    parts = [f"# {title}\n"]
    for section in sections:
        parts += [f"## {section.title}\n"] + ([f"{section.text}\n"] if section.text else [])
        parts += [markdown_table(section.rows)] if section.rows else []
    parts.append(" · ".join(f"{name} {value}" for name, value in environment.items()) + "\n")
    write_bytes(path, "\n".join(parts).encode(errors=_ERRORS))


def column_names(rows: Sequence[Row]) -> list[str]:
    """Give the union of the rows' names, in order of their first appearance."""
    return list(dict.fromkeys(name for row in rows for name in row))


_ABOUT = {
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
"""What the head of a column says of it when it is pointed at."""


def show_value(value: object) -> str:
    """Show a value to a person: four digits after the point, nothing for None."""
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
        embedded=embedded,
        about=_ABOUT,
    )
    html = pages.get_template("report.html").render(
        title=title, sections=sections, environment=environment
    )
    write_bytes(path, html.encode(errors=_ERRORS))
