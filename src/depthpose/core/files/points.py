"""PLY point files (Turk 1994), and the named columns that all binary point files share.

Text and binary of both byte orders are read; little-endian binary is written.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from io import BytesIO, TextIOWrapper
from itertools import accumulate, islice

import numpy as np

from depthpose.core.errors import InputError
from depthpose.core.files.disk import AnyPath, refused_as
from depthpose.core.files.shards import read_bytes
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
        raise InputError(f"{path}: {field.name!r} holds a value outside {dtype.name}; correct it")
    # As floats, 64-bit limits round up to what does not fit: those columns stay floats.
    return column if dtype.itemsize == 8 else column.astype(dtype)


_CODES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 2**16
_END = re.compile(rb"(?:^|\n)end_header[ \t]*(?:\r\n|\n|\r)")


@dataclass(kw_only=True)
class _Element:
    name: str
    count: int
    fields: list[Field] = field(default_factory=list)
    has_list: bool = False

    @property
    def row_bytes(self) -> int:
        return sum(np.dtype(f.code).itemsize for f in self.fields)


def read_ply(path: AnyPath) -> Columns:
    """Read the columns of the ``vertex`` element; faces and other elements are stepped over.

    Raises:
        InputError: the file is missing, truncated, damaged, or lays its vertices behind lists.
    """
    data = read_bytes(path)
    end = _END.search(data, 0, _MAX_HEADER)
    if not data.startswith(b"ply") or end is None:
        raise InputError(f"{path}: no PLY header ('ply' ... 'end_header'); is it a PLY file?")
    order, elements = _parse_header(path, data[: end.start()].decode("latin-1").splitlines())
    before, vertex = _find_vertex(path, elements)
    body = memoryview(data)[end.end() :]
    if order:
        skipped = _bytes_of(path, before)
        need_bytes(path, len(body), skipped, "elements before the vertices")
        return split_records(path, body[skipped:], vertex.fields, vertex.count, order)
    first = sum(e.count for e in before)
    return split_rows(path, body, vertex.fields, vertex.count, first)


def encode_ply(points: np.ndarray, color: np.ndarray | None) -> bytes:
    """Encode points, and colours as bytes where there are any, as little-endian PLY."""
    columns = [(name, "<f4", "float", points[:, i]) for i, name in enumerate("xyz")]
    if color is not None:
        names = ("red", "green", "blue")
        columns += [(name, "u1", "uchar", color[:, i]) for i, name in enumerate(names)]
    records = np.empty(len(points), [(name, code) for name, code, _, _ in columns])
    for name, _, _, values in columns:
        records[name] = values
    properties = "".join(f"property {kind} {name}\n" for name, _, kind, _ in columns)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}"
    return f"{header}end_header\n".encode() + records.tobytes()


def _parse_header(path: AnyPath, lines: list[str]) -> tuple[str, list[_Element]]:
    order: str | None = None
    elements: list[_Element] = []
    for line in lines[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", form, "1.0"] if form in _ORDERS:
                order = _ORDERS[form]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,12}", count):
                elements.append(_Element(name=name, count=int(count)))
            case ["property", "list", size, kind, _] if {size, kind} <= _CODES.keys() and elements:
                elements[-1].has_list = True
            case ["property", kind, name] if kind in _CODES and elements:
                elements[-1].fields.append(Field(name=name, code=_CODES[kind]))
            case _:
                raise InputError(
                    f"{path}: PLY header line {line[:60]!r} is not understood; correct it"
                )
    if order is None:
        raise InputError(f"{path}: the PLY header names no format; use {', '.join(_ORDERS)} 1.0")
    return order, elements


def _find_vertex(path: AnyPath, elements: list[_Element]) -> tuple[list[_Element], _Element]:
    names = [e.name for e in elements]
    if names.count("vertex") != 1:
        raise InputError(f"{path}: elements {names}, where exactly one 'vertex' is needed")
    vertex = elements[names.index("vertex")]
    properties = [f.name for f in vertex.fields]
    if vertex.has_list or not properties or len(set(properties)) != len(properties):
        raise InputError(
            f"{path}: vertex properties {properties} are none, a list or repeat a name; give each "
            "vertex x, y and z"
        )
    return elements[: names.index("vertex")], vertex


def _bytes_of(path: AnyPath, elements: list[_Element]) -> int:
    lists = [e.name for e in elements if e.has_list]
    if lists:
        raise InputError(f"{path}: binary lists {lists} lie before the vertices; put them behind")
    return sum(e.count * e.row_bytes for e in elements)
