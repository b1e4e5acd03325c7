"""Chapter 2 of the thesis: its printed tables joined to our rows, and figures 2-1 and 2-5."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.draw import draw_depth, draw_points
from depthpose.core.errors import InputError
from depthpose.depth.evaluate import EvaluationRow
from depthpose.depth.metrics import METRICS
from depthpose.depth.types import DepthEstimate, DepthInput
from depthpose.report.page import Drawing, make_depth_color_bar

_METRICS = tuple(name for name, metric in METRICS.items() if metric.of == "depth")
_FIRST_COLUMNS = ("source", "method", "weights", "cap_m", *_METRICS, "protocol")


@dataclass(frozen=True)
class PublishedRow:
    """One printed row: the seven numbers of a method for truth up to ``cap_m``."""

    method: str  #: name of the method, as printed
    cap_m: float  #: largest depth of the truth [m]
    printed: str  #: the numbers, in the order of our metrics of depth
    protocol: str = "eigen-raw"  #: protocol by which they were measured
    note: str = ""  #: the row's footnote

    @property
    def errors(self) -> dict[str, float]:
        """The seven numbers, by the names of our metrics."""
        return dict(zip(_METRICS, map(float, self.printed.split()), strict=True))


@dataclass(frozen=True, kw_only=True)
class PublishedTable:
    """One printed table: every author's row, in the order of print."""

    number: str  #: number in the thesis
    title: str  #: title of our page
    rows: tuple[PublishedRow, ...]  #: every printed row
    thesis_rows: tuple[str, ...]  #: methods of the thesis, in the order in which weights are given
    with_right: bool  #: whether the methods see the real right view


def join_published(
    table: PublishedTable, our_rows: Sequence[tuple[str, EvaluationRow]]
) -> list[dict[str, Any]]:
    """Set our rows beside the printed ones, cap by cap: published, ours, difference.

    A difference is ours less the thesis's; across two protocols its ``protocol`` names both.

    Args:
        table: the printed table.
        our_rows: for each of our rows the method of the thesis that it reproduces (one of
            ``table.thesis_rows``; empty: none, as of a baseline), and the row.

    Returns:
        The columns of each row; ``source`` is ``published``, ``ours`` or ``difference``.
    """
    # The printed rows.
    published: list[dict[str, Any]] = []
    for row in table.rows:
        columns: dict[str, Any] = dict.fromkeys(_FIRST_COLUMNS, "")
        columns |= {"source": "published", "method": row.method, "cap_m": row.cap_m}
        columns |= row.errors
        columns |= {"protocol": row.protocol, "note": row.note}
        published.append(columns)

    # Ours, each with its difference to the thesis's.
    rows = list(published)
    for counterpart, row in our_rows:
        assert row.cap_m is not None, "the tables are of depth, and reproduce takes no disparity"
        ours = {**dict.fromkeys(_FIRST_COLUMNS, ""), **row.columns(), "source": "ours"}
        rows.append(ours)
        rows += [
            _subtract_row(ours, theirs)
            for theirs in published
            if theirs["method"] == counterpart and theirs["cap_m"] == row.cap_m
        ]
    return sorted(rows, key=lambda row: -row["cap_m"])


def _subtract_row(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, Any]:
    """Subtract the thesis's row from one of ours."""
    row = {name: ours[name] for name in _FIRST_COLUMNS}
    row["source"] = "difference"
    row["method"] = f"{ours['method']} - {theirs['method']}"
    row |= {name: ours[name] - theirs[name] for name in _METRICS}
    if ours["protocol"] != theirs["protocol"]:
        row["protocol"] = f"{ours['protocol']} against {theirs['protocol']}"
    return row


_Row = PublishedRow
_DENSE = "post-processed truth"
_TUNED = "with end-to-end fine-tuning"
_APART = "without fine-tuning"
_FINETUNED = "fine-tune cGANs"
_OURS_80 = "0.141 1.057 5.20 0.233 0.810 0.932 0.972"
_OURS_50 = "0.136 0.837 4.11 0.222 0.822 0.938 0.975"
"""The thesis's own numbers by the cap [m], which tables 2.1 and 2.3 share."""

TABLES = {table.number: table for table in (
    PublishedTable(
        number="2.1",
        title="Table 2.1: monocular depth on the Eigen test split",
        rows=(
            _Row("Eigen et al. [21]", 80.0, "0.215 1.515 7.156 0.270 0.692 0.899 0.967"),
            _Row("Zhou et al. [137]", 80.0, "0.183 1.595 6.709 0.270 0.734 0.902 0.959"),
            _Row("Godard et al. [28]", 80.0, "0.114 0.898 4.935 0.206 0.861 0.949 0.976"),
            _Row("Kuznietsov et al. [59]", 80.0, "0.113 0.741 4.621 0.189 0.862 0.960 0.986"),
            _Row("Luo et al. [73]", 80.0, "0.102 0.700 4.681 0.200 0.872 0.954 0.978"),
            _Row("Luo et al. [73] a", 80.0, "0.094 0.626 4.252 0.177 0.891 0.965 0.984",
                 note=_TUNED),
            _Row("Fu et al. [24] (ResNet)", 80.0, "0.072 0.307 2.727 0.120 0.932 0.984 0.994",
                 _DENSE, "with dense depth map as ground truth"),
            _Row("thesis, Ours", 80.0, _OURS_80),
            _Row("Luo et al. [73]", 50.0, "0.097 0.539 3.503 0.187 0.885 0.960 0.981"),
            _Row("Luo et al. [73] a", 50.0, "0.090 0.499 3.266 0.167 0.902 0.968 0.986",
                 note=_TUNED),
            _Row("Fu et al. [24] (ResNet)", 50.0, "0.071 0.268 2.271 0.116 0.936 0.985 0.995",
                 _DENSE, "with dense depth map as ground truth"),
            _Row("thesis, Ours", 50.0, _OURS_50),
        ),
        thesis_rows=("thesis, Ours",),
        with_right=False,
    ),
    PublishedTable(
        number="2.2",
        title="Table 2.2: depth from the real stereo pair on the Eigen test split",
        rows=(
            _Row("Luo et al. [73]", 80.0, "0.062 0.424 3.677 0.164 0.939 0.968 0.981"),
            _Row("thesis, Ours", 80.0, "0.076 0.531 3.585 0.176 0.937 0.964 0.978"),
            _Row("Luo et al. [73]", 50.0, "0.058 0.316 2.675 0.152 0.947 0.971 0.983"),
            _Row("thesis, Ours", 50.0, "0.074 0.423 2.862 0.168 0.940 0.966 0.980"),
        ),
        thesis_rows=("thesis, Ours",),
        with_right=True,
    ),
    PublishedTable(
        number="2.3",
        title="Table 2.3: monocular depth with and without fine-tuning",
        rows=(
            _Row(_APART, 80.0, _OURS_80),
            _Row(_FINETUNED, 80.0, "0.126 0.851 4.865 0.217 0.837 0.945 0.976"),
            _Row(_APART, 50.0, _OURS_50),
            _Row(_FINETUNED, 50.0, "0.121 0.674 3.817 0.207 0.849 0.950 0.978"),
        ),
        thesis_rows=(_APART, _FINETUNED),
        with_right=False,
    ),
)}  # fmt: skip
"""Tables by the thesis's numbers; every figure as printed."""


_NEAR_M = 3.0
_FAR_M = 80.0
"""Depth of the brightest and of the darkest colour."""
_GAP_PX = 8
"""White space between panels."""
PANEL_WIDTH_PX = 621
"""Width of a panel: half of a frame of KITTI."""
_BAR_PX = 18
"""Height of the bar of colours."""

DEPTH_SCALE = (
    f"Depth in every panel: {_NEAR_M:.0f} m (bright) to {_FAR_M:.0f} m (dark), logarithmic"
)
"""What the colours mean; the bar below a grid runs from near to far."""


def draw_figure_2_5(
    pair: DepthInput, lidar_m: Float[Tensor, "h w"] | None, estimate: DepthEstimate
) -> list[Drawing]:
    """Draw a column of figure 2-5: left, real right, predicted depth, predicted right, LiDAR.

    A panel whose image does not exist is left out. Where the real right view was matched, no right
    view is predicted.

    Args:
        pair: left view, and the real right one if there is one.
        lidar_m: one scan drawn into the left image, NaN where no point falls, if there is one.
        estimate: depth of this pair, or of its left view alone.
    """
    panels = [Drawing(caption="left image", image=pair.left)]
    if pair.right is not None:
        panels.append(Drawing(caption="real right image", image=pair.right))
    panels.append(_draw_depth_panel("predicted depth", pair, estimate))
    if estimate.right is not None:
        panels.append(Drawing(caption="predicted right image", image=estimate.right))
    return panels + _draw_lidar_panels(pair, lidar_m)


def draw_figure_2_1(
    pair: DepthInput,
    lidar_m: Float[Tensor, "h w"] | None,
    mono: DepthEstimate,
    stereo: DepthEstimate,
) -> list[Drawing]:
    """Draw the six panels of figure 2-1, in its order.

    Args:
        pair: left and right view.
        lidar_m: one scan drawn into the left image, NaN where no point falls; None: left out.
        mono: depth from the left view and the right one that was synthesised of it.
        stereo: depth from the real pair, by the same matcher.

    Raises:
        InputError: the frame has no right view, or ``mono`` no synthesised one.
    """
    if pair.right is None or mono.right is None:
        reason = "the frame has no right view" if pair.right is None else "no view was synthesised"
        raise InputError(f"{pair.name}: figure 2-1 compares two right views, but {reason}.")
    return [
        Drawing(caption="(a) left image", image=pair.left),
        Drawing(caption="(b) real right image", image=pair.right),
        Drawing(caption="(c) synthesised right image", image=mono.right),
        _draw_depth_panel("(d) depth from left and synthesised right", pair, mono),
        _draw_depth_panel("(e) depth from left and real right", pair, stereo),
        *_draw_lidar_panels(pair, lidar_m, "(f) LiDAR"),
    ]


def arrange_columns(
    columns: Sequence[Sequence[Drawing]], width_px: int = PANEL_WIDTH_PX
) -> Float[Tensor, "3 h w"]:
    """Lay panels out on white in columns ``width_px`` wide, over the depth scale.

    Raises:
        InputError: there is no panel.
    """
    if not any(columns):
        raise InputError("a figure of no panel cannot be arranged; give a frame at least.")
    shrunk = [[resize_to_width(panel.image, width_px) for panel in column] for column in columns]

    # The panels of one row have equal height; a shorter column is filled up with white.
    row_heights: list[int] = []
    for k in range(max(map(len, shrunk))):
        heights = [column[k].shape[1] for column in shrunk if k < len(column)]
        row_heights.append(max(heights) + _GAP_PX)

    filled_columns: list[Tensor] = []
    for column in shrunk:
        cells = [
            F.pad(panel, (0, _GAP_PX, 0, height - panel.shape[1]), value=1.0)
            for panel, height in zip(column, row_heights, strict=False)
        ]
        stacked = torch.cat(cells, 1)
        missing_px = sum(row_heights) - stacked.shape[1]
        filled_columns.append(F.pad(stacked, (0, 0, 0, missing_px), value=1.0))
    grid = torch.cat(filled_columns, 2)[..., :-_GAP_PX]

    # The bar of colours below them.
    ramp_m = torch.logspace(0, 1, grid.shape[2], base=_FAR_M / _NEAR_M) * _NEAR_M
    bar = draw_depth(ramp_m[None], _NEAR_M, _FAR_M).expand(-1, _BAR_PX, -1)
    return torch.cat([grid, bar], 1)


def _draw_depth_panel(caption: str, pair: DepthInput, estimate: DepthEstimate) -> Drawing:
    """Draw estimated depth, in the colours of every panel."""
    if estimate.depth_m is None:
        raise InputError(f"{pair.name}: a figure shows metres; give a camera with a baseline.")
    image = draw_depth(estimate.depth_m, _NEAR_M, _FAR_M)
    return Drawing(caption=caption, image=image, color_bar=make_depth_color_bar(_NEAR_M, _FAR_M))


def _draw_lidar_panels(
    pair: DepthInput, lidar_m: Float[Tensor, "h w"] | None, caption: str = "LiDAR"
) -> list[Drawing]:
    """Draw the LiDAR points over the left image; no panel without a scan."""
    if lidar_m is None:
        return []
    # Figures show frames at half their size, where a single pixel would fade: points are 5 wide.
    image = draw_points(pair.left, lidar_m, _FAR_M, radius_px=2)
    return [Drawing(caption=caption, image=image, color_bar=make_depth_color_bar(_NEAR_M, _FAR_M))]


def resize_to_width(image: Float[Tensor, "3 _ _"], width_px: int) -> Float[Tensor, "3 _ _"]:
    """Shrink or enlarge a picture to a width with its proportions kept, by area averaging."""
    height = max(1, round(image.shape[1] * width_px / image.shape[2]))
    return F.interpolate(image[None], (height, width_px), mode="area")[0]
