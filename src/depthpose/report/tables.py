"""Rows to Markdown, CSV, JSON and one self-contained HTML page."""

import base64
import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxtyping import Float
from jinja2 import Environment, PackageLoader, StrictUndefined
from torch import Tensor

from depthpose.core.draw import Scale, shrink_to_pixels
from depthpose.core.files import encode_image, image_size, read_image, write_json
from depthpose.core.files.disk import write_bytes
from depthpose.report.scene import Scene, page_file

Row = Mapping[str, Any]

_MOST_PIXELS = 480_000
"""Of a drawing on a page of many: a frame of KITTI is whole."""
_QUALITY = 85
_MOST_BYTES = 250_000
"""Of a picture file that goes onto a page as it is."""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture file with a caption, and with the bar of its colours where they are numbers."""

    path: Path
    caption: str
    scale: Scale | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]: a page that knows them does not move when the picture comes."""
        return image_size(self.path)

    @property
    def data_uri(self) -> str:
        """The picture as a ``data:`` address, so that the page needs no other file.

        A small file's own bytes; a large one is shrunk to what a page of many takes.
        """
        if self.path.stat().st_size > _MOST_BYTES:
            return Drawing(image=read_image(self.path), caption=self.caption).data_uri
        kind = "jpeg" if self.path.suffix.lower() in (".jpg", ".jpeg") else "png"
        return f"data:image/{kind};base64," + base64.b64encode(self.path.read_bytes()).decode()


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawing:
    """A picture without a file of its own, small enough for a page of many."""

    image: Float[Tensor, "3 h w"]
    caption: str
    scale: Scale | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.image.shape[2], self.image.shape[1]

    @property
    def data_uri(self) -> str:
        """The picture as a ``data:`` address."""
        encoded = encode_image(shrink_to_pixels(self.image, _MOST_PIXELS), "drawing.jpg", _QUALITY)
        return "data:image/jpeg;base64," + base64.b64encode(encoded).decode()


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of a page, in this order: its heading, a paragraph, names and values, pictures.

    Then a table that sorts, small tables by what they show (rows of equal length), and 3D views.
    """

    title: str
    text: str = ""
    facts: Sequence[tuple[str, str]] = ()
    pictures: Sequence[Picture | Drawing] = field(default_factory=tuple)
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
    """Write ``NAME.json``, ``NAME.csv`` and ``table.md`` (``NAME.md`` for other names)."""
    as_json, as_csv, as_markdown = table_files(name)
    write_json(folder / as_json, [dict(row) for row in rows])
    _write_text(folder / as_csv, csv_table(rows))
    _write_text(folder / as_markdown, markdown_table(rows))


def _write_text(path: Path, text: str) -> None:
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


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


def csv_table(rows: Sequence[Row]) -> str:
    """Format rows as CSV with a header, every digit kept."""
    text = io.StringIO()
    writer = csv.DictWriter(text, column_names(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_markdown(
    path: Path, title: str, sections: Sequence[Section], environment: Mapping[str, str]
) -> None:
    """Write the text and tables of :func:`write_page` as Markdown, without pictures."""
    parts = [f"# {title}\n"]
    for section in sections:
        parts += [f"## {section.title}\n"] + ([f"{section.text}\n"] if section.text else [])
        parts += [markdown_table(section.rows)] if section.rows else []
    parts.append(" · ".join(f"{name} {value}" for name, value in environment.items()) + "\n")
    _write_text(path, "\n".join(parts))


def column_names(rows: Sequence[Row]) -> list[str]:
    """Give the union of the rows' names, in order of their first appearance."""
    return list(dict.fromkeys(name for row in rows for name in row))


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
    pages.globals.update(show_value=show_value, column_names=column_names, page_file=page_file)
    html = pages.get_template("report.html").render(
        title=title, sections=sections, environment=environment
    )
    _write_text(path, html)
