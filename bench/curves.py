"""Curves as a PNG, without a plotting library."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from PIL import Image, ImageDraw

SIZE, LEFT, TOP, BOTTOM = (760, 460), 60, 40, 60
COLORS = ("#1f5fbf", "#c0392b", "#2e8b57", "#8e44ad", "#d68910", "#555555", "#17a2b8")

Curves = Mapping[str, Sequence[tuple[float, float]]]


def draw_curves(path: Path, title: str, x_name: str, curves: Curves) -> None:
    """Draw curves of shares (0 to 1) over a number, evenly spaced where values are listed.

    Args:
        path: the PNG.
        title: above.
        x_name: below.
        curves: points (x, y) by name; the legend stands in their order.
    """
    picture = Image.new("RGB", SIZE, "white")
    pen = ImageDraw.Draw(picture)
    ticks = sorted({x for points in curves.values() for x, _ in points})
    wide, tall = SIZE[0] - LEFT - 200, SIZE[1] - TOP - BOTTOM
    place = {x: LEFT + wide * k / max(len(ticks) - 1, 1) for k, x in enumerate(ticks)}
    for k in range(6):
        y = TOP + tall * (1 - k / 5)
        pen.line([(LEFT, y), (LEFT + wide, y)], fill="#dddddd")
        pen.text((LEFT - 35, y - 6), f"{20 * k} %", fill="black")
    for x, at in place.items():
        pen.text((at - 8, TOP + tall + 8), f"{x:g}", fill="black")
    pen.text((LEFT, 12), title, fill="black")
    pen.text((LEFT + wide / 2 - 40, SIZE[1] - 28), x_name, fill="black")
    for k, (name, points) in enumerate(curves.items()):
        color = COLORS[k % len(COLORS)]
        line = [(place[x], TOP + tall * (1 - y)) for x, y in sorted(points)]
        pen.line(line, fill=color, width=3)
        for x, y in line:
            pen.ellipse([x - 4, y - 4, x + 4, y + 4], fill=color)
        pen.rectangle([LEFT + wide + 15, TOP + 20 * k + 3, LEFT + wide + 27, TOP + 20 * k + 9],
                      fill=color)  # fmt: skip
        pen.text((LEFT + wide + 32, TOP + 20 * k), name, fill="black")
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(path)
