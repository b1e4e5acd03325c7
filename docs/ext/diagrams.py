"""Boxes and arrows as an SVG that takes its colours from the page.

Boxes stand in rows and columns, which are as high and as wide as their largest box.
"""

from collections.abc import Sequence
from html import escape
from typing import NamedTuple

LETTER_PX, LINE_PX = 6.7, 15
PADDING_PX, GAP_X_PX, GAP_Y_PX = 8, 34, 22

Span = tuple[float, float]
"""Where something begins, and how long it is."""


class Box(NamedTuple):
    """One thing: its name for arrows, its place, its lines of text.

    ``kind`` is data, network, step or title, and decides how it looks.
    """

    name: str
    row: int
    column: int
    lines: Sequence[str]
    kind: str = "network"


class Arrow(NamedTuple):
    """From one box to another; a skip is dashed."""

    start: str
    end: str
    is_skip: bool = False


def draw(boxes: Sequence[Box], arrows: Sequence[Arrow], label: str) -> str:
    """Draw a diagram; ``label`` is what a screen reader says."""
    columns = _spans({b.column: [_width(o) for o in boxes if o.column == b.column] for b in boxes},
                     GAP_X_PX)  # fmt: skip
    rows = _spans({b.row: [_height(o) for o in boxes if o.row == b.row] for b in boxes}, GAP_Y_PX)
    places = {b.name: (columns[b.column], rows[b.row], b) for b in boxes}
    width = max(start + length for start, length in columns.values()) + 1
    height = max(start + length for start, length in rows.values()) + 1
    drawn = [_arrow(_rectangle(*places[a.start]), _rectangle(*places[a.end]), a) for a in arrows]
    drawn += [_box(_rectangle(*place), place[2]) for place in places.values()]
    return (
        f'<svg class="network" viewBox="-1 -1 {width + 1:.0f} {height + 1:.0f}" '
        f'style="max-width: {width:.0f}px" role="img" aria-label="{escape(label)}">'
        '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" '
        'markerHeight="8" markerUnits="userSpaceOnUse" orient="auto"><path d="M0 0 8 4 0 8z"/>'
        f"</marker></defs>{''.join(drawn)}</svg>"
    )


class Rectangle(NamedTuple):
    """Left, upper edge, width, height [px]."""

    x: float
    y: float
    width: float
    height: float


def _width(box: Box) -> float:
    return max(len(line) for line in box.lines) * LETTER_PX + 2 * PADDING_PX


def _height(box: Box) -> float:
    return len(box.lines) * LINE_PX + PADDING_PX


def _spans(lengths: dict[int, list[float]], gap: float) -> dict[int, Span]:
    """Put rows or columns one after the other."""
    spans: dict[int, Span] = {}
    start = 0.0
    for number in sorted(lengths):
        length = max(lengths[number])
        spans[number] = (start, length)
        start += length + gap
    return spans


def _rectangle(column: Span, row: Span, box: Box) -> Rectangle:
    """Put a box into the middle of its cell."""
    width, height = _width(box), _height(box)
    return Rectangle(
        column[0] + (column[1] - width) / 2, row[0] + (row[1] - height) / 2, width, height
    )


def _box(at: Rectangle, box: Box) -> str:
    middle = at.x + at.width / 2
    lines = "".join(
        f'<text x="{middle:.1f}" y="{at.y + PADDING_PX / 2 + (k + 0.75) * LINE_PX:.1f}">'
        f"{escape(line)}</text>"
        for k, line in enumerate(box.lines)
    )
    frame = (
        f'<rect x="{at.x:.1f}" y="{at.y:.1f}" width="{at.width:.1f}" '
        f'height="{at.height:.1f}" rx="4"/>'
    )
    return f'<g class="{box.kind}">{"" if box.kind == "title" else frame}{lines}</g>'


def _arrow(start: Rectangle, end: Rectangle, arrow: Arrow) -> str:
    """Go out of the side that faces the other box, and into the side that faces back."""
    (x, y), (to_x, to_y), is_level = _ends(start, end)
    bend = (to_x - x) / 2 if is_level else (to_y - y) / 2
    near = f"{x + bend:.1f} {y:.1f}" if is_level else f"{x:.1f} {y + bend:.1f}"
    far = f"{to_x - bend:.1f} {to_y:.1f}" if is_level else f"{to_x:.1f} {to_y - bend:.1f}"
    kind = "skip" if arrow.is_skip else "flow"
    return (
        f'<path class="{kind}" marker-end="url(#head)" '
        f'd="M{x:.1f} {y:.1f} C{near} {far} {to_x:.1f} {to_y:.1f}"/>'
    )


def _ends(
    start: Rectangle, end: Rectangle
) -> tuple[tuple[float, float], tuple[float, float], bool]:
    middles = [(r.x + r.width / 2, r.y + r.height / 2) for r in (start, end)]
    if end.x >= start.x + start.width:
        return (start.x + start.width, middles[0][1]), (end.x, middles[1][1]), True
    if start.x >= end.x + end.width:
        return (start.x, middles[0][1]), (end.x + end.width, middles[1][1]), True
    if end.y > start.y:
        return (middles[0][0], start.y + start.height), (middles[1][0], end.y), False
    return (middles[0][0], start.y), (middles[1][0], end.y + end.height), False
