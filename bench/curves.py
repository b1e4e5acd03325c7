"""Plots of other scripts of this folder, each a PNG."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

mpl.use("Agg")

_MAX_NAMES_INSIDE = 5
"""Largest number of names in a legend inside a plot; a longer one is placed beside it."""

Curves = Mapping[str, Sequence[tuple[float, float]]]


def draw_curves(
    path: Path, axes_of: Mapping[str, Curves], y_name: str, *, log: bool = False
) -> None:
    """Draw curves side by side over one vertical axis.

    Args:
        path: the PNG.
        axes_of: for each plot, by the name of its horizontal axis: points (x, y) by name. Several
            points at one x stay visible; the line goes through their mean.
        y_name: of the vertical axis.
        log: horizontal axes in powers of ten, with a place for 0.
    """
    names = list(dict.fromkeys(name for curves in axes_of.values() for name in curves))
    is_beside = len(names) > _MAX_NAMES_INSIDE
    width = 1.5 + 4 * len(axes_of) + (2.5 if is_beside else 0)
    figure = Figure(figsize=(width, 3.8), layout="constrained")
    plots = figure.subplots(1, len(axes_of), sharey=True, squeeze=False)[0]
    for axes, (x_name, curves) in zip(plots, axes_of.items(), strict=True):
        _draw(axes, curves)
        axes.set_xlabel(x_name)
        axes.grid(alpha=0.3)
        if log:
            axes.set_xscale("symlog", linthresh=10)
    plots[0].set_ylabel(y_name)
    beside = {"loc": "center left", "bbox_to_anchor": (1.02, 0.5)} if is_beside else {}
    plots[-1].legend(**beside)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def _draw(axes: Axes, curves: Curves) -> None:
    for name, points in curves.items():
        values_at: dict[float, list[float]] = {}
        for x, y in sorted(points):
            values_at.setdefault(x, []).append(y)
        means = [sum(values) / len(values) for values in values_at.values()]
        (line,) = axes.plot(list(values_at), means, "o-", label=name)
        if len(points) > len(values_at):
            axes.plot(*zip(*points, strict=True), ".", color=line.get_color())
