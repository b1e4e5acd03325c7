"""Named columns of numbers: what text and binary point files have in common."""

from collections.abc import Iterable
from dataclasses import dataclass
from io import BytesIO, TextIOWrapper
from itertools import accumulate, islice

import numpy as np

from depthpose.core.errors import InputError
from depthpose.core.files.disk import AnyPath, refused_as
from depthpose.core.files.text import MAX_TEXT_BYTES

Columns = dict[str, np.ndarray]
"""One array a name, all equally long."""


@dataclass(frozen=True, kw_only=True)
class Field:
    """One named column of a record: ``count`` numbers of one type.

    Attributes:
        name: as the file names it.
        code: numpy's type code without byte order, such as ``f4``.
        count: numbers a record; a field of several is stepped over.
    """

    name: str
    code: str
    count: int = 1


def split_records(
    path: AnyPath, body: memoryview, fields: list[Field], count: int, order: str = "<"
) -> Columns:
    """Take ``count`` packed records apart into columns, without a copy.

    Raises:
        InputError: ``body`` is shorter than the records that the header declares.
    """
    # Named by place, since a file may use one name for several fields of padding.
    with refused_as(path, "list of fields", "save it again"):
        dtype = np.dtype([(f"{i}", order + f.code, (f.count,)) for i, f in enumerate(fields)])
    need_bytes(path, len(body), count * dtype.itemsize, f"{count} points")
    records = np.frombuffer(body, dtype, count)
    return {f.name: records[f"{i}"][:, 0] for i, f in enumerate(fields)}


def split_rows(
    path: AnyPath, body: memoryview, fields: list[Field], count: int, first: int = 0
) -> Columns:
    """Take ``count`` rows of text apart into columns of the declared types.

    Args:
        path: of the file, for errors.
        body: what follows the header.
        fields: the columns.
        count: how many rows.
        first: rows before them that are stepped over; empty ones do not count.

    Raises:
        InputError: rows are missing or ragged, a value does not fit its type, or there is more
            text than is read.
    """
    if len(body) > MAX_TEXT_BYTES:
        raise InputError(
            f"{path}: {len(body)} bytes of points in text, more than {MAX_TEXT_BYTES}; save it as "
            "binary"
        )
    lines = (line for line in TextIOWrapper(BytesIO(body), "latin-1") if line.strip())
    table = parse_rows(path, islice(lines, first, first + count))
    if len(table) < count:
        raise InputError(
            f"{path}: declares {count} points but {len(table)} rows follow; it is truncated, save "
            "it again"
        )
    width = sum(f.count for f in fields)
    if count and table.shape[1] != width:
        raise InputError(f"{path}: rows of {table.shape[1]} values where {width} are declared")
    starts = accumulate((f.count for f in fields), initial=0)
    return {
        f.name: _as_type(path, table[:, start], f)
        for f, start in zip(fields, starts, strict=False)
        if count
    }


def parse_rows(path: AnyPath, rows: Iterable[str]) -> np.ndarray:
    """Parse rows of equally many numbers, parted by blanks, to float64; taken one at a time.

    Raises:
        InputError: a value is no number, or the rows are ragged.
    """
    with refused_as(path, "table of numbers", "give every row the same number of values"):
        table = np.loadtxt(rows, dtype=np.float64, comments=None, ndmin=2)
    return table if table.size else np.empty((0, 0))


def need_bytes(path: AnyPath, have: int, need: int, what: str) -> None:
    """Refuse a body that is shorter than its header says, before anything is allocated."""
    if have < need:
        raise InputError(
            f"{path}: declares {what} of {need} bytes but {have} follow; it is truncated or "
            "damaged, save it again"
        )


def _as_type(path: AnyPath, column: np.ndarray, field: Field) -> np.ndarray:
    dtype = np.dtype(field.code)
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return column.astype(dtype)
    limits = np.iinfo(dtype)
    if not ((column >= limits.min) & (column <= limits.max)).all():
        raise InputError(f"{path}: {field.name!r} holds a value outside {dtype.name}; mend it")
    # As floats, 64-bit limits round up to what does not fit: those columns stay floats.
    return column if dtype.itemsize == 8 else column.astype(dtype)
