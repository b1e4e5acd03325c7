"""A row a method, a column an object: ours set beside what is printed."""

from collections.abc import Mapping, Sequence
from typing import Any

from depthpose.pose.tables.published import LINEMOD, PEERS, ROWS, PublishedRow

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
