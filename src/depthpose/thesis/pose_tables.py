"""A row a method, a column an object: ours set beside what is printed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

TITLES = {
    "3.1": "Table 3.1: comparison with baselines on LineMOD, ADD(-S)",
    "3.2": "Table 3.2: 6D pose on LineMOD, ADD(-S)",
    "3.3": "Table 3.3: RANSAC against least squares",
}
"""Of the thesis's tables. Its text that is at hand ends before their numbers: the published rows
of table 3.2 are those that its captions and chapter refer to, from the papers themselves."""

LINEMOD = {
    1: "ape", 2: "benchvise", 4: "camera", 5: "can", 6: "cat", 8: "driller", 9: "duck",
    10: "eggbox*", 11: "glue*", 12: "holepuncher", 13: "iron", 14: "lamp", 15: "phone",
}  # fmt: skip
"""Column of each object, by BOP's number; ADD-S where there is a star."""

PEERS = ("PointFusion", "DenseFusion, per pixel", "DenseFusion, iterative")
"""Trained, as ours, as one network of all objects: the rows that differences are taken from."""


@dataclass(frozen=True, kw_only=True)
class PublishedRow:
    """One printed row.

    Attributes:
        method: who.
        sees: what the method looks at.
        by_object: percent by BOP's number; empty where only the mean is printed.
        mean: percent, as printed.
        diameters: whose table a success is a tenth of.
        note: what else it takes to compare it.
        source: where it is printed.
    """

    method: str
    sees: str
    by_object: dict[int, float]
    mean: float
    diameters: str
    note: str
    source: str


_TABLES = "tables in the READMEs of ethnhe/PVN3D and j96w/DenseFusion"
_FFB6D = "table in the README of ethnhe/FFB6D"
_EACH = "one network an object, some 20,000 made images of each"


def _row(method: str, sees: str, printed: str, mean: float, note: str, source: str) -> PublishedRow:
    """Read the thirteen numbers in the order of the objects."""
    numbers = dict(zip(LINEMOD, map(float, printed.split()), strict=True)) if printed else {}
    diameters = "pvnet" if method == "PVNet" else "bop"
    return PublishedRow(
        method=method,
        sees=sees,
        by_object=numbers,
        mean=mean,
        diameters=diameters,
        note=note,
        source=source,
    )


ROWS = (
    _row("PVNet", "RGB",
         "43.6 99.9 86.9 95.5 79.3 96.4 52.6 99.2 95.7 82.0 98.9 99.3 92.4", 86.3, _EACH, _TABLES),
    _row("CDPN", "RGB",
         "64.4 97.8 91.7 95.9 83.8 96.2 66.8 99.7 99.6 85.8 97.9 97.9 90.8", 89.9, "", _TABLES),
    _row("DPOD", "RGB", "", 95.2, "only the mean is read", _FFB6D),
    _row("Implicit + ICP", "RGB-D",
         "20.6 64.3 63.2 76.1 72.0 41.6 32.4 98.6 96.4 49.9 63.1 91.7 71.0", 64.7, "",
         _TABLES),
    _row("SSD-6D + ICP", "RGB-D",
         "65 80 78 86 70 73 66 100 100 49 78 73 79", 79.0,
         "without decimals; the mean of these numbers is 76.7",
         _TABLES),
    _row("PointFusion", "RGB-D",
         "70.4 80.7 60.8 61.1 79.1 47.3 63.0 99.9 99.3 71.8 83.2 62.3 78.8", 73.7, "",
         _TABLES),
    _row("DenseFusion, per pixel", "RGB-D",
         "79.5 84.2 76.5 86.6 88.8 77.7 76.3 99.9 99.4 79.0 92.1 92.3 88.0", 86.2,
         "lost detections leave its denominator", _TABLES),
    _row("DenseFusion, iterative", "RGB-D",
         "92.3 93.2 94.4 93.1 96.5 87.0 92.3 99.8 100.0 92.1 97.0 95.3 92.8", 94.3,
         "lost detections leave its denominator", _TABLES),
    _row("G2L-Net", "RGB-D", "", 98.7, "only the mean is read", _FFB6D),
    _row("PVN3D", "RGB-D",
         "97.3 99.7 99.6 99.5 99.8 99.3 98.2 99.8 100.0 99.9 99.7 99.8 99.5", 99.4, _EACH, _TABLES),
    _row("FFB6D", "RGB-D", "", 99.7, _EACH, _FFB6D),
)  # fmt: skip
"""Every figure as printed. Not like for like: see the notes, and the diameters."""


Row = dict[str, Any]


def join_by_object(
    rows: Sequence[Mapping[str, Any]], numbers: Mapping[str, int], *, with_published: bool
) -> list[Row]:
    """Turn the rows of evaluations into a row a method and kind of masks, in percent.

    Args:
        rows: of ``pose.evaluate``, with ``method`` and ``masks``.
        numbers: BOP's number of each object, by the name that the rows bear.
        with_published: set the printed rows of LineMOD before ours, and the differences to
            ``PEERS`` after; else (table 3.1) the differences of the first method to the others.

    Returns:
        Rows with ``source``: ``published``, ``ours`` or ``difference`` (ours minus the other). The
        mean of ours is over the objects that were measured; a difference of means is given only
        where both are over the same objects.
    """
    columns = [_column(name, number, with_published) for name, number in numbers.items()]
    ours = [_own(group, numbers, with_published) for group in _grouped(rows)]
    if not with_published:
        return [*ours, *(_difference(ours[0], other, columns) for other in ours[1:])]
    printed = [_published(row) for row in ROWS]
    peers = [row for row in printed if row["method"] in PEERS]
    differences = [_difference(row, peer, columns) for row in ours for peer in peers]
    return [*printed, *ours, *differences]


def _column(name: str, number: int, with_published: bool) -> str:
    return LINEMOD.get(number, name) if with_published else name


def _grouped(rows: Sequence[Mapping[str, Any]]) -> list[list[Mapping[str, Any]]]:
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["method"], row["masks"]), []).append(row)
    return list(groups.values())


def _own(
    rows: Sequence[Mapping[str, Any]], numbers: Mapping[str, int], with_published: bool
) -> Row:
    of = {row["object"]: row for row in rows}
    first = rows[0]
    found: Row = {"source": "ours", "method": first["method"], "masks": first["masks"]}
    found |= {"sees": "depth"}
    for name, number in numbers.items():
        found[_column(name, number, with_published)] = 100 * of[name]["success"]
    # Of one object there is no row of means: it is its own.
    mean = of.get("mean", first)
    found["mean"] = 100 * mean["success"]
    found |= {name: 100 * mean[name] for name in ("refused", "wrong", "auc")}
    for name in ("instances", "diameters", "weights", "weights_sha256", "frames", "frames_sha256"):
        found[name] = mean[name]
    return found | {name: value for name, value in mean.items() if name.startswith("ms_")}


def _published(row: PublishedRow) -> Row:
    found: Row = {"source": "published", "method": row.method, "masks": "", "sees": row.sees}
    found |= {LINEMOD[number]: percent for number, percent in row.by_object.items()}
    return found | {
        "mean": row.mean, "diameters": row.diameters, "note": row.note, "printed in": row.source,
    }  # fmt: skip


def _difference(ours: Row, other: Row, columns: Sequence[str]) -> Row:
    name = f"{ours['method']} - {other['method']}"
    found: Row = {"source": "difference", "method": name, "masks": ours["masks"]}
    for column in columns:
        if other.get(column) is not None:
            found[column] = ours[column] - other[column]
    printed = [column for column in LINEMOD.values() if column in other]
    is_same = other["source"] == "ours" or set(printed) == set(columns)
    found["mean"] = ours["mean"] - other["mean"] if is_same else None
    if ours["diameters"] != other["diameters"]:
        found["diameters"] = f"{ours['diameters']} against {other['diameters']}"
    return found
