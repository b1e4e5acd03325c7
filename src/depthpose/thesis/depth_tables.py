"""Tables 2.1, 2.2 and 2.3 of the thesis as data, and our rows joined to them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Literal

from depthpose.core.errors import InputError, nearest_name
from depthpose.depth.evaluate import MeanRow, Row
from depthpose.depth.evaluate.rows import Cell
from depthpose.depth.metrics import DepthErrors

_METRICS = tuple(DepthErrors.__dataclass_fields__)
_FIRST = ("method", "weights", "cap_m", "protocol", *_METRICS)


@dataclass(frozen=True)
class PublishedRow:
    """One printed row: the seven numbers of a method for truth up to ``cap_m``.

    ``protocol`` is what they were measured by: the thesis says ``eigen-raw`` of all but one;
    ``note`` is the row's footnote.
    """

    method: str
    cap_m: float
    printed: str
    protocol: str = "eigen-raw"
    note: str = ""

    @property
    def errors(self) -> DepthErrors:
        """The seven numbers."""
        return DepthErrors(*map(float, self.printed.split()))


@dataclass(frozen=True, kw_only=True)
class PublishedTable:
    """One printed table: every author's row, in the order of print.

    ``own``: names of the thesis's own methods, in the order in which weights are given;
    ``with_right``: whether the methods see the real right view.
    """

    number: str
    title: str
    rows: tuple[PublishedRow, ...]
    own: tuple[str, ...]
    with_right: bool


@dataclass(frozen=True, kw_only=True)
class JoinedRow(Row):
    """A printed row, one of ours, or the difference (ours minus the thesis's).

    ``protocol`` of a difference across two protocols names both; ``others`` are further columns:
    the note of a printed row, all others of ours.
    """

    source: Literal["published", "ours", "difference"]
    method: str
    weights: str = ""
    cap_m: float
    metrics: Mapping[str, float]
    protocol: str
    others: Mapping[str, Cell] = field(default_factory=dict)


def find_table(number: str) -> PublishedTable:
    """Give a table by its number in the thesis.

    Raises:
        InputError: there is none of that number.
    """
    if number not in TABLES:
        raise InputError(f"table {number!r}: {nearest_name(number, TABLES)}")
    return TABLES[number]


def join_published(table: PublishedTable, ours: Sequence[tuple[str, MeanRow]]) -> list[JoinedRow]:
    """Set our rows beside the printed ones, cap by cap: published, ours, difference.

    Args:
        table: the printed table.
        ours: for each of our rows the name of the thesis's own method that it stands for (one of
            ``table.own``, or empty where it stands for none, as a baseline), and the row.
    """
    rows = [
        JoinedRow(
            source="published",
            method=row.method,
            cap_m=row.cap_m,
            metrics=asdict(row.errors),
            protocol=row.protocol,
            others={"note": row.note},
        )
        for row in table.rows
    ]
    printed_rows = tuple(rows)
    for own, row in ours:
        assert row.cap_m is not None, "the tables are of depth, and reproduce takes no disparity"
        columns = row.columns()
        one = JoinedRow(
            source="ours",
            method=row.method or "",
            weights=row.weights or "",
            cap_m=row.cap_m,
            metrics={name: row.metrics[name] for name in _METRICS},
            protocol=row.protocol,
            others={name: cell for name, cell in columns.items() if name not in _FIRST},
        )
        rows.append(one)
        for printed in printed_rows:
            if (printed.method, printed.cap_m) == (own, one.cap_m):
                same = one.protocol == printed.protocol
                difference = replace(
                    one,
                    source="difference",
                    method=f"{row.method} - {own}",
                    metrics={n: one.metrics[n] - printed.metrics[n] for n in _METRICS},
                    protocol=one.protocol if same else f"{one.protocol} against {printed.protocol}",
                    others={},
                )
                rows.append(difference)
    return sorted(rows, key=lambda row: -row.cap_m)


_Row = PublishedRow
_DENSE = "post-processed truth"
_TUNED = "with end-to-end fine-tuning"
_APART = "without fine-tuning"
_FINETUNED = "fine-tune cGANs"
_OURS_80 = "0.141 1.057 5.20 0.233 0.810 0.932 0.972"
_OURS_50 = "0.136 0.837 4.11 0.222 0.822 0.938 0.975"

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
        own=("thesis, Ours",),
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
        own=("thesis, Ours",),
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
        own=(_APART, _FINETUNED),
        with_right=False,
    ),
)}  # fmt: skip
"""By the thesis's numbers; every figure as printed."""
