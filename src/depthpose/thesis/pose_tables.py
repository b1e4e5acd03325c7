"""Tables 3.1 and 3.2: published LineMOD rows (ADD(-S) below 10 % of the diameter), and ours."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from depthpose.core.errors import InputError
from depthpose.pose.evaluate import ObjectRow
from depthpose.pose.types import ObjectModel

TITLES = {
    "3.1": "Table 3.1: comparison with baselines on LineMOD, ADD(-S)",
    "3.2": "Table 3.2: 6D pose on LineMOD, ADD(-S)",
    "3.3": "Table 3.3: RANSAC against least squares",
}
"""Titles of the thesis's tables. Its text at hand ends before their numbers: the published rows of
table 3.2 are those that its captions and chapter refer to, from the papers themselves."""

LINEMOD = {
    1: "ape", 2: "benchvise", 4: "camera", 5: "can", 6: "cat", 8: "driller", 9: "duck",
    10: "eggbox*", 11: "glue*", 12: "holepuncher", 13: "iron", 14: "lamp", 15: "phone",
}  # fmt: skip
"""Column of each object, by BOP's number; ADD-S where there is a star."""

LINEMOD_DIAMETERS_M = {
    1: 0.102099, 2: 0.247506, 3: 0.167355, 4: 0.172492, 5: 0.201404, 6: 0.154546, 7: 0.124264,
    8: 0.261472, 9: 0.108999, 10: 0.164628, 11: 0.175889, 12: 0.145543, 13: 0.278078, 14: 0.282601,
    15: 0.212358,
}  # fmt: skip
"""All of LineMOD's diameters, as BOP and Linemod_preprocessed have them; no row has 3 and 7."""

_LINEMOD_NUMBERS = {name.rstrip("*"): number for number, name in LINEMOD.items()} | {
    "bowl": 3, "cam": 4, "cup": 7,
}  # fmt: skip
"""BOP's number of each object, by its name in any of the published forms of LineMOD."""
_TOLERANCE_UNNAMED = 0.02
"""Largest relative difference from LineMOD's diameter, of a model without a name."""
_TOLERANCE_NAMED = 0.25
"""The same of a model with the object's name: tables of the diameters differ by up to 16 %."""

PEERS = ("PointFusion", "DenseFusion, per pixel", "DenseFusion, iterative")
"""Methods of one network for all objects, as ours is; their rows are subtracted from ours."""


@dataclass(frozen=True)
class PublishedRow:
    """One printed row: percent of the objects of :data:`LINEMOD`, in its order, and their mean."""

    method: str  #: name of the method
    input: str  # what it sees: RGB or RGB-D; after "#:" the docs would take the builtin for it
    printed: str  #: percent of each object; empty where only the mean is printed
    mean: float  #: percent
    note: str  #: what else it takes to compare it
    source: str  #: where it is printed


_TABLES = "tables in the READMEs of ethnhe/PVN3D and j96w/DenseFusion"
_FFB6D = "table in the README of ethnhe/FFB6D"
_EACH = "one network an object, some 20,000 synthetic images of each"
_Row = PublishedRow

ROWS = (
    _Row("PVNet", "RGB",
         "43.6 99.9 86.9 95.5 79.3 96.4 52.6 99.2 95.7 82.0 98.9 99.3 92.4", 86.3, _EACH, _TABLES),
    _Row("CDPN", "RGB",
         "64.4 97.8 91.7 95.9 83.8 96.2 66.8 99.7 99.6 85.8 97.9 97.9 90.8", 89.9, "", _TABLES),
    _Row("DPOD", "RGB", "", 95.2, "only the mean is read", _FFB6D),
    _Row("Implicit + ICP", "RGB-D",
         "20.6 64.3 63.2 76.1 72.0 41.6 32.4 98.6 96.4 49.9 63.1 91.7 71.0", 64.7, "",
         _TABLES),
    _Row("SSD-6D + ICP", "RGB-D",
         "65 80 78 86 70 73 66 100 100 49 78 73 79", 79.0,
         "without decimals; the mean of these numbers is 76.7",
         _TABLES),
    _Row("PointFusion", "RGB-D",
         "70.4 80.7 60.8 61.1 79.1 47.3 63.0 99.9 99.3 71.8 83.2 62.3 78.8", 73.7, "",
         _TABLES),
    _Row("DenseFusion, per pixel", "RGB-D",
         "79.5 84.2 76.5 86.6 88.8 77.7 76.3 99.9 99.4 79.0 92.1 92.3 88.0", 86.2,
         "lost detections leave its denominator", _TABLES),
    _Row("DenseFusion, iterative", "RGB-D",
         "92.3 93.2 94.4 93.1 96.5 87.0 92.3 99.8 100.0 92.1 97.0 95.3 92.8", 94.3,
         "lost detections leave its denominator", _TABLES),
    _Row("G2L-Net", "RGB-D", "", 98.7, "only the mean is read", _FFB6D),
    _Row("PVN3D", "RGB-D",
         "97.3 99.7 99.6 99.5 99.8 99.3 98.2 99.8 100.0 99.9 99.7 99.8 99.5", 99.4, _EACH, _TABLES),
    _Row("FFB6D", "RGB-D", "", 99.7, _EACH, _FFB6D),
)  # fmt: skip
"""Every figure as printed. Not like for like: see the notes, and the diameters."""


def find_linemod_number(model: ObjectModel) -> int:
    """Find which object of LineMOD a model is, by its name and diameter; return BOP's number of it.

    A model without a name, only ``obj_000006``, is recognised by that number and its diameter.

    Raises:
        InputError: it is no object of LineMOD.
    """
    is_named = model.name != f"obj_{model.number:06d}"
    number = _LINEMOD_NUMBERS.get(model.name.lower()) if is_named else model.number
    remark = ""
    if number in LINEMOD_DIAMETERS_M:
        diameter_m = LINEMOD_DIAMETERS_M[number]
        tolerance = _TOLERANCE_NAMED if is_named else _TOLERANCE_UNNAMED
        if abs(diameter_m / model.diameter_m - 1) <= tolerance:
            return number
        remark = f"; LineMOD's object {number} is {diameter_m:.4f} m"
    raise InputError(
        f"object {model.number} ({model.name}, {model.diameter_m:.4f} m across) is none of "
        f"LineMOD{remark}. Table 3.2 compares with numbers of LineMOD's objects; for other "
        "datasets take 'reproduce 3.1', or leave the object out by --objects"
    )


def join_by_object(
    rows: Sequence[ObjectRow], numbers: Mapping[str, int], *, with_published: bool
) -> list[dict[str, Any]]:
    """Make the rows of table 3.1 or 3.2: one for each method and kind of masks, in percent.

    Args:
        rows: rows of ``pose.evaluate``, one for each object, with their origin and conditions.
        numbers: BOP's number of each object, by the name in the rows; with printed rows that of
            LineMOD's object (:func:`find_linemod_number`).
        with_published: set the printed rows of LineMOD before ours, and the differences to
            ``PEERS`` after; else (table 3.1) the differences of the first method to the others.

    Returns:
        The columns of each row; ``source`` is ``published``, ``ours`` or ``difference`` (ours less
        the other). The mean of ours is over the objects that were measured; a difference of means
        is given only where both are over the same objects.
    """
    # Ours: a row for each method and kind of masks, a column for each object.
    columns: dict[str, str] = {}
    for name, number in numbers.items():
        columns[name] = LINEMOD.get(number, name) if with_published else name
    groups: dict[tuple[str, str], list[ObjectRow]] = {}
    for row in rows:
        assert row.origin is not None, "rows of an evaluation say whose they are"
        groups.setdefault((row.origin.method, row.origin.masks), []).append(row)
    our_rows = [_make_our_row(group, columns) for group in groups.values()]
    names = list(columns.values())
    if not with_published:
        # Of the same kind of masks: those of the first method less those of each other.
        first = our_rows[0]["method"]
        differences = [
            _subtract_row(row, other, names)
            for row in our_rows
            for other in our_rows
            if row["method"] == first != other["method"] and row["masks"] == other["masks"]
        ]
        return [*our_rows, *differences]

    # The printed ones before them, and the differences to our peers after.
    printed = [_make_published_row(row) for row in ROWS]
    peers = [row for row in printed if row["method"] in PEERS]
    differences = [_subtract_row(row, peer, names) for row in our_rows for peer in peers]
    return [*printed, *our_rows, *differences]


def _make_published_row(row: PublishedRow) -> dict[str, Any]:
    """Make the columns of a printed row."""
    percents = map(float, row.printed.split())
    return {
        "source": "published",
        "method": row.method,
        "masks": "",
        "input": row.input,
        **dict(zip(LINEMOD.values(), percents, strict=False)),  # none where only a mean is printed
        "mean": row.mean,
        "diameters": "pvnet" if row.method == "PVNet" else "bop",
        "note": row.note,
        "printed in": row.source,
    }


def _make_our_row(rows: Sequence[ObjectRow], columns: Mapping[str, str]) -> dict[str, Any]:
    """Make the columns of one of our rows: percent of each object, and what they were measured on.

    Args:
        rows: rows of one method and kind of masks: of each object, and of their mean.
        columns: the table's column of each object, by its name in the rows.
    """
    by_name = {row.object: row for row in rows}
    # Of one object there is no row of means: it is its own.
    mean = by_name.get("mean", rows[0])
    origin = mean.origin
    conditions = mean.conditions
    assert origin is not None
    assert conditions is not None
    return {
        "source": "ours",
        "method": origin.method,
        "masks": origin.masks,
        "input": "depth",
        **{column: 100 * by_name[name].success for name, column in columns.items()},
        "mean": 100 * mean.success,
        "refused": 100 * mean.refused,
        "wrong": 100 * mean.wrong,
        "auc": 100 * (mean.scores["auc"] or 0.0),
        "instances": mean.instances,
        "diameters": conditions.diameters,
        "weights": origin.weights,
        "weights_sha256": origin.weights_sha256,
        "frames": conditions.frames,
        "frames_sha256": conditions.frames_sha256,
        **{f"ms_{stage}": value for stage, value in mean.ms.items()},
    }


def _subtract_row(
    our_row: Mapping[str, Any], other: Mapping[str, Any], names: Sequence[str]
) -> dict[str, Any]:
    """Subtract a row, published or ours, from one of ours; return the columns of the difference.

    ``names``: the columns of our objects.
    """
    # Means are compared only where both are over the same objects.
    compared = names if other["source"] == "ours" else [n for n in LINEMOD.values() if n in other]
    difference = {
        "source": "difference",
        "method": f"{our_row['method']} - {other['method']}",
        "masks": our_row["masks"],
        **{name: our_row[name] - other[name] for name in names if name in compared},
        "mean": our_row["mean"] - other["mean"] if set(compared) == set(names) else None,
    }
    if our_row["diameters"] != other["diameters"]:
        difference["diameters"] = f"{our_row['diameters']} against {other['diameters']}"
    return difference
