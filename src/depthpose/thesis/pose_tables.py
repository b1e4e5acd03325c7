"""Tables 3.1 and 3.2: published LineMOD rows (ADD(-S) below 10 % of the diameter), and ours."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from depthpose.core.errors import InputError
from depthpose.pose.evaluate import Conditions, ObjectRow, Origin
from depthpose.pose.types import ObjectModel

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

LINEMOD_DIAMETERS_M = {
    1: 0.102099, 2: 0.247506, 3: 0.167355, 4: 0.172492, 5: 0.201404, 6: 0.154546, 7: 0.124264,
    8: 0.261472, 9: 0.108999, 10: 0.164628, 11: 0.175889, 12: 0.145543, 13: 0.278078, 14: 0.282601,
    15: 0.212358,
}  # fmt: skip
"""Of all its objects, as BOP and Linemod_preprocessed have them; 3 and 7 are in no printed row."""

_NUMBERS = {name.rstrip("*"): number for number, name in LINEMOD.items()} | {
    "bowl": 3, "cam": 4, "cup": 7,
}  # fmt: skip
_SAME_DIAMETER = 0.02
"""Of a model without a name, which its diameter has to tell."""
_SAME_NAMED = 0.25
"""Of a model with a name: tables of LineMOD's diameters differ by up to 16 %."""

PEERS = ("PointFusion", "DenseFusion, per pixel", "DenseFusion, iterative")
"""Trained, as ours, as one network of all objects: the rows that differences are taken from."""


@dataclass(frozen=True, kw_only=True)
class PublishedRow:
    """One printed row.

    Attributes:
        method: who.
        input: what the method uses.
        by_object: percent by BOP's number; empty where only the mean is printed.
        mean: percent, as printed.
        diameters: whose table a success is a tenth of.
        note: what else it takes to compare it.
        source: where it is printed.
    """

    method: str
    input: str
    by_object: dict[int, float]
    mean: float
    diameters: str
    note: str
    source: str


_TABLES = "tables in the READMEs of ethnhe/PVN3D and j96w/DenseFusion"
_FFB6D = "table in the README of ethnhe/FFB6D"
_EACH = "one network an object, some 20,000 synthetic images of each"


def _row(
    method: str, input: str, printed: str, mean: float, note: str, source: str
) -> PublishedRow:
    """Read the thirteen numbers in the order of the objects."""
    numbers = dict(zip(LINEMOD, map(float, printed.split()), strict=True)) if printed else {}
    diameters = "pvnet" if method == "PVNet" else "bop"
    return PublishedRow(
        method=method,
        input=input,
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


@dataclass(frozen=True, kw_only=True)
class ComparedRow:
    """A method, or the difference of two, in percent; None: there is no such number.

    Attributes:
        source: ``published``, ``ours`` or ``difference`` (ours minus the other).
        method: who.
        masks: that it was given.
        input: what the method uses.
        by_object: percent by column.
        mean: over the objects.
        refused: percent of instances.
        wrong: percent of instances.
        auc: to 10 cm, in percent.
        instances: how many.
        diameters: whose table a success is a tenth of.
        note: what else it takes to compare it.
        printed_in: where it is printed.
        origin: whose predictions are measured.
        conditions: of the evaluation.
        ms: mean milliseconds of each stage.
    """

    source: Literal["published", "ours", "difference"]
    method: str
    masks: str
    input: str | None = None
    by_object: Mapping[str, float]
    mean: float | None
    refused: float | None = None
    wrong: float | None = None
    auc: float | None = None
    instances: int | None = None
    diameters: str | None = None
    note: str | None = None
    printed_in: str | None = None
    origin: Origin | None = None
    conditions: Conditions | None = None
    ms: Mapping[str, float | None] = field(default_factory=dict)

    def columns(self) -> dict[str, Any]:
        """Give the columns of a table, in its order."""
        found: dict[str, Any] = {
            "source": self.source,
            "method": self.method,
            "masks": self.masks,
            "input": self.input,
            **self.by_object,
            "mean": self.mean,
            "refused": self.refused,
            "wrong": self.wrong,
            "auc": self.auc,
            "instances": self.instances,
            "diameters": self.diameters,
            "note": self.note,
            "printed in": self.printed_in,
        }
        found = {name: v for name, v in found.items() if v is not None or name == "mean"}
        if self.origin is not None and self.conditions is not None:
            found |= {
                "weights": self.origin.weights,
                "weights_sha256": self.origin.weights_sha256,
                "frames": self.conditions.frames,
                "frames_sha256": self.conditions.frames_sha256,
            }
        return found | {f"ms_{stage}": value for stage, value in self.ms.items()}


def linemod_number(model: ObjectModel) -> int:
    """Give BOP's number of the object of LineMOD that a model is, by its name and diameter.

    A model without a name is known by its number and diameter.

    Raises:
        InputError: it is none of them.
    """
    is_named = model.name != f"obj_{model.number:06d}"
    number = _NUMBERS.get(model.name.lower(), 0) if is_named else model.number
    theirs_m = LINEMOD_DIAMETERS_M.get(number, 0.0)
    if abs(theirs_m / model.diameter_m - 1) <= (_SAME_NAMED if is_named else _SAME_DIAMETER):
        return number
    theirs = f"; LineMOD's object {number} is {theirs_m:.4f} m" if theirs_m else ""
    raise InputError(
        f"object {model.number} ({model.name}, {model.diameter_m:.4f} m across) is none of "
        f"LineMOD{theirs}. Table 3.2 compares with numbers of LineMOD's objects; for other data "
        "sets take 'reproduce 3.1', or leave the object out by --objects"
    )


def join_by_object(
    rows: Sequence[ObjectRow], numbers: Mapping[str, int], *, with_published: bool
) -> list[ComparedRow]:
    """Turn the rows of evaluations into a row a method and kind of masks, in percent.

    Args:
        rows: of ``pose.evaluate``, with their origin and conditions.
        numbers: BOP's number of each object, by the name in the rows; with printed rows that of
            LineMOD's object (:func:`linemod_number`).
        with_published: set the printed rows of LineMOD before ours, and the differences to
            ``PEERS`` after; else (table 3.1) the differences of the first method to the others.

    Returns:
        The mean of ours is over the objects that were measured; a difference of means is given only
        where both are over the same objects.
    """
    columns = [_column(name, number, with_published) for name, number in numbers.items()]
    ours = [_own(group, numbers, with_published) for group in _grouped(rows)]
    if not with_published:
        return [*ours, *(_difference(ours[0], other, columns) for other in ours[1:])]
    printed = [_published(row) for row in ROWS]
    peers = [row for row in printed if row.method in PEERS]
    differences = [_difference(row, peer, columns) for row in ours for peer in peers]
    return [*printed, *ours, *differences]


def _column(name: str, number: int, with_published: bool) -> str:
    return LINEMOD.get(number, name) if with_published else name


def _grouped(rows: Sequence[ObjectRow]) -> list[list[ObjectRow]]:
    groups: dict[tuple[str, str], list[ObjectRow]] = {}
    for row in rows:
        assert row.origin is not None, "rows of an evaluation say whose they are"
        groups.setdefault((row.origin.method, row.origin.masks), []).append(row)
    return list(groups.values())


def _own(
    rows: Sequence[ObjectRow], numbers: Mapping[str, int], with_published: bool
) -> ComparedRow:
    by_name = {row.object: row for row in rows}
    # Of one object there is no row of means: it is its own.
    mean = by_name.get("mean", rows[0])
    assert mean.origin is not None
    assert mean.conditions is not None
    return ComparedRow(
        source="ours",
        method=mean.origin.method,
        masks=mean.origin.masks,
        input="depth",
        by_object={
            _column(name, number, with_published): 100 * by_name[name].success
            for name, number in numbers.items()
        },
        mean=100 * mean.success,
        refused=100 * mean.refused,
        wrong=100 * mean.wrong,
        auc=100 * (mean.scores["auc"] or 0.0),
        instances=mean.instances,
        diameters=mean.conditions.diameters,
        origin=mean.origin,
        conditions=mean.conditions,
        ms=mean.ms,
    )


def _published(row: PublishedRow) -> ComparedRow:
    return ComparedRow(
        source="published",
        method=row.method,
        masks="",
        input=row.input,
        by_object={LINEMOD[number]: percent for number, percent in row.by_object.items()},
        mean=row.mean,
        diameters=row.diameters,
        note=row.note,
        printed_in=row.source,
    )


def _difference(ours: ComparedRow, other: ComparedRow, columns: Sequence[str]) -> ComparedRow:
    is_same = other.source == "ours" or set(other.by_object) == set(columns)
    is_comparable = is_same and ours.mean is not None and other.mean is not None
    differ = ours.diameters != other.diameters
    return ComparedRow(
        source="difference",
        method=f"{ours.method} - {other.method}",
        masks=ours.masks,
        by_object={
            column: ours.by_object[column] - other.by_object[column]
            for column in columns
            if column in other.by_object
        },
        mean=(ours.mean or 0.0) - (other.mean or 0.0) if is_comparable else None,
        diameters=f"{ours.diameters} against {other.diameters}" if differ else None,
    )
