"""Columns of point files: PLY (Turk 1994) and PCD (Point Cloud Library, version 0.7).

Text and binary of both byte orders are read; little-endian binary is written.
"""

import math
import re
import warnings
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from io import BytesIO, TextIOWrapper
from itertools import accumulate, islice
from typing import Any

import numpy as np

from depthpose.core.errors import InputError, Notice
from depthpose.core.files.disk import MAX_TEXT_BYTES, AnyPath, read_bytes, refused_as

_WORDS = re.compile(r"[-+]?(?:nan\(\w*\)|1[.,]#(?:QNAN|SNAN|IND|INF)\w*)")
_FEW = "declares {} but {} rows follow; it is truncated, save it again"
Columns = dict[str, np.ndarray]  # one array a name, all equally long


@dataclass(frozen=True, kw_only=True)
class Field:
    """One named column of a record."""

    name: str
    code: str  # numpy's, without byte order, as "f4"
    count: int = 1  # numbers a record; a field of several is stepped over
    size_code: str | None = None  # of a list, the type of its length; None: it is no list


@dataclass(frozen=True, eq=False)
class Ragged:
    """Lists of differing length: how many values each has, and all values one after the other."""

    sizes: np.ndarray
    values: np.ndarray


def split_records(
    path: AnyPath, body: memoryview, fields: list[Field], count: int, order: str = "<"
) -> Columns:
    """Take ``count`` packed records apart into columns, without a copy."""
    # Named by place, since a file may use one name for several fields of padding.
    with refused_as(path, "list of fields", "save it again"):
        dtype = np.dtype([(f"{i}", order + f.code, (f.count,)) for i, f in enumerate(fields)])
    need_bytes(path, len(body), count * dtype.itemsize, f"{count} points")
    records = np.frombuffer(body, dtype, count)
    return {f.name: records[f"{i}"][:, 0] for i, f in enumerate(fields)}


def text_rows(path: AnyPath, body: memoryview) -> Iterator[str]:
    """Give the lines of a body in text; empty ones do not count."""
    if len(body) > MAX_TEXT_BYTES:
        raise InputError(
            f"{path}: {len(body)} bytes of points in text, more than {MAX_TEXT_BYTES}; save it as "
            "binary"
        )
    lines = TextIOWrapper(BytesIO(body), "latin-1")
    return (plain_numbers(line) for line in lines if line.strip())


def plain_numbers(line: str) -> str:
    """Write ``nan`` and ``inf`` for the words by which Microsoft's C library prints them."""
    if "#" not in line and "(" not in line:
        return line
    return _WORDS.sub(lambda match: "inf" if "INF" in match[0] else "nan", line)


def split_rows(path: AnyPath, rows: Iterator[str], fields: list[Field], count: int) -> Columns:
    """Take the next ``count`` rows of text apart into columns of the declared types."""
    table = parse_rows(path, islice(rows, count))
    if len(table) < count:
        raise InputError(f"{path}: {_FEW.format(f'{count} points', len(table))}")
    width = sum(f.count for f in fields)
    if count and table.shape[1] != width:
        raise InputError(f"{path}: rows of {table.shape[1]} values where {width} are declared")
    columns: Columns = {}
    starts = accumulate((f.count for f in fields), initial=0)
    for f, start in zip(fields if count else (), starts, strict=False):
        column = table[:, start]
        dtype = np.dtype(f.code)
        if dtype.kind != "f":
            limits = np.iinfo(dtype)
            if not ((column >= limits.min) & (column <= limits.max)).all():
                raise InputError(
                    f"{path}: {f.name!r} holds a value outside {dtype.name}; correct it"
                )
            # As floats, 64-bit limits round up to what does not fit: those columns stay floats.
            dtype = column.dtype if dtype.itemsize == 8 else dtype
        with np.errstate(over="ignore"):
            columns[f.name] = column.astype(dtype)
    return columns


def parse_rows(path: AnyPath, rows: Iterable[str]) -> np.ndarray:
    """Parse rows of equally many numbers, parted by blanks, to float64; taken one at a time."""
    with refused_as(path, "table of numbers", "give every row as many values, with decimal points"):
        table = np.loadtxt(rows, dtype=np.float64, comments=None, ndmin=2)
    return table if table.size else np.empty((0, 0))


def need_bytes(path: AnyPath, have: int, need: int, what: str) -> None:
    """Refuse a body that is shorter than its header says, before anything is allocated."""
    if have < need:
        raise InputError(
            f"{path}: declares {what} of {need} bytes but {have} follow; it is truncated or "
            "damaged, save it again"
        )


_CODES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 2**16
_END = re.compile(rb"(?:^|[\r\n])end_header[ \t]*(?:\r\n|\n|\r)")


_MOST_RUNS = 500_000  # of equally long binary lists, each read at once; more take over 10 s


@dataclass(kw_only=True)
class _Element:
    name: str
    count: int
    fields: list[Field] = field(default_factory=list)


def read_ply_elements(path: AnyPath, last: str | None = None) -> tuple[Columns, dict[str, Ragged]]:
    """Read the columns of the ``vertex`` element, and the lists of the others."""
    data = read_bytes(path)
    end = _END.search(data, 0, _MAX_HEADER)
    if not data.startswith(b"ply") or end is None:
        raise InputError(f"{path}: no PLY header ('ply' ... 'end_header'); is it a PLY file?")
    order, elements = _parse_header(path, data[: end.start()].decode("latin-1").splitlines())
    body = memoryview(data)[end.end() :]
    rows = None if order else text_rows(path, body)
    columns: Columns = {}
    lists: dict[str, Ragged] = {}
    for element in elements:
        if element.name == "vertex" and rows is None:
            columns = split_records(path, body, element.fields, element.count, order)
            row_bytes = sum(np.dtype(f.code).itemsize for f in element.fields)
            body = body[element.count * row_bytes :]
        elif element.name == "vertex":
            assert rows is not None
            columns = split_rows(path, rows, element.fields, element.count)
        elif rows is None:
            more_lists, used_bytes = _binary_lists(path, body, element, order)
            body = body[used_bytes:]
            lists = lists | more_lists
        else:
            sizes = {f.name: array("q") for f in element.fields if f.size_code}
            values = {name: array("d") for name in sizes}
            row_count = 0
            for row_count, row in enumerate(islice(rows, element.count), 1):
                words = row.split()
                at = 0
                try:
                    for f in element.fields:
                        if f.size_code:
                            count = int(words[at])
                            sizes[f.name].append(count)
                            values[f.name].extend(map(float, words[at + 1 : at + 1 + count]))
                            at += max(count, 0)
                        at += 1
                except (ValueError, IndexError, OverflowError):
                    at = -1
                if at != len(words):
                    raise InputError(
                        f"{path}: row {row_count} of {element.name}, {row.strip()[:60]!r}, is not "
                        "what the header declares (the number of values, then as many); save it "
                        "again"
                    )
            if row_count < element.count:
                what = f"{element.count} {element.name}"
                raise InputError(f"{path}: {_FEW.format(what, row_count)}")
            lists |= {
                f"{element.name} {name}": Ragged(
                    np.array(sizes[name], np.int64), np.array(values[name])
                )
                for name in sizes
            }
        if element.name == last:
            return columns, lists
    surplus = len(body) if rows is None else sum(1 for _ in rows)
    if surplus > (3 if rows is None else 0):  # a line end behind binary data does no harm
        what = "bytes" if rows is None else "rows"
        raise InputError(
            f"{path}: {surplus} {what} follow what its header declares "
            f"({', '.join(f'{e.count} {e.name}' for e in elements)}); correct it, or save it again"
        )
    return columns, lists


def _binary_lists(
    path: AnyPath, body: memoryview, element: _Element, order: str
) -> tuple[dict[str, Ragged], int]:
    """Read the lists of an element, rows of equal length at once; give the bytes read."""
    what = f"{element.count} {element.name}"
    steps = [(f, np.dtype(order + (f.size_code or "u1")), np.dtype(order + f.code))
             for f in element.fields]  # fmt: skip
    runs: list[Any] = []
    dtypes: dict[tuple[int, ...], np.dtype] = {}
    at = 0
    left = element.count
    ahead = 64
    while left:
        lengths = []
        end = at
        for f, size, value in steps:
            length = 1
            if f.size_code:
                need_bytes(path, len(body), end + size.itemsize, what)
                length = int(np.frombuffer(body, size, 1, end)[0])
                if length < 0:
                    raise InputError(f"{path}: a list of {what} has {length} values; save it anew")
                end += size.itemsize
            lengths.append(length)
            end += length * value.itemsize
        need_bytes(path, len(body), end, what)
        key = tuple(lengths)
        if key not in dtypes:
            kinds: list[Any] = []
            for (f, size, value), length in zip(steps, key, strict=True):
                kinds += [(f"{f.name} size", size)] if f.size_code else []
                kinds.append((f.name, value, (length,)))
            dtypes[key] = np.dtype(kinds)
        dtype = dtypes[key]
        rows = min(left, ahead, (len(body) - at) // dtype.itemsize)
        records: Any = np.frombuffer(body, dtype, rows, at)
        sizes = [records[f"{f.name} size"] for f in element.fields if f.size_code]
        is_equal = np.array([size == size[0] for size in sizes] or [[True]]).all(0)
        records = records if is_equal.all() else records[: int(is_equal.argmin())]
        runs.append(records)
        if len(runs) > _MOST_RUNS:
            raise InputError(f"{path}: {what} of ever other lengths; export triangles alone")
        at = at + records.nbytes
        left = left - len(records)
        ahead = 2 * len(records) + 64
    return {
        f"{element.name} {f.name}": Ragged(
            sizes=np.concatenate([np.empty(0, int), *(r[f"{f.name} size"] for r in runs)]),
            values=np.concatenate([np.empty(0, f.code), *(r[f.name].reshape(-1) for r in runs)]),
        )
        for f in element.fields
        if f.size_code
    }, at


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
    """Parse the header of a PLY file: byte order ("" for text) and elements with their fields."""
    order: str | None = None
    elements: list[_Element] = []
    for line in lines[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", form, "1.0"] if form in _ORDERS:
                order = _ORDERS[form]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,18}", count):
                elements.append(_Element(name=name, count=int(count)))
            case ["property", "list", size, kind, name] if (
                {size, kind} <= _CODES.keys() and _CODES[size][0] != "f" and elements
            ):
                elements[-1].fields.append(
                    Field(name=name, code=_CODES[kind], size_code=_CODES[size])
                )
            case ["property", kind, name] if kind in _CODES and elements:
                elements[-1].fields.append(Field(name=name, code=_CODES[kind]))
            case _:
                raise InputError(
                    f"{path}: PLY header line {line[:60]!r} is not understood; correct it"
                )
    if order is None:
        raise InputError(f"{path}: the PLY header names no format; use {', '.join(_ORDERS)} 1.0")
    names = [e.name for e in elements]
    if names.count("vertex") != 1:
        raise InputError(f"{path}: elements {names}, where exactly one 'vertex' is needed")
    for element in elements:
        properties = [f.name for f in element.fields]
        has_list = element.name == "vertex" and any(f.size_code for f in element.fields)
        if has_list or not properties or len(set(properties)) != len(properties):
            raise InputError(
                f"{path}: {element.name} properties {properties} are none, a list or repeat a "
                "name; give each vertex x, y and z"
            )
    return order, elements


_PCD_CODES = {
    **{("F", "4"): "f4", ("F", "8"): "f8"},
    **{("I", size): f"i{size}" for size in "1248"},
    **{("U", size): f"u{size}" for size in "1248"},
}
# of compressed points: eight million, byte by byte
_MAX_PACKED = 2**25
_MAX_UNPACKED = 2**27
_DATA = re.compile(rb"(?:^|\n)DATA[ \t]+(ascii|binary|binary_compressed)[ \t]*(?:\r\n|\n)")


def read_pcd(path: AnyPath) -> Columns:
    """Read the columns of a PCD file; ``rgb`` stays packed.

    Warns:
        Notice: its ``VIEWPOINT`` is not the identity, so that the points may be in a frame that is
            not the sensor's. Programs differ in what they mean by it, so it is not applied.
    """
    data = read_bytes(path)
    end = _DATA.search(data, 0, _MAX_HEADER)
    if end is None:
        raise InputError(f"{path}: no PCD header ('FIELDS' ... 'DATA'); is it a PCD file?")
    lines = data[: end.start()].decode("latin-1").splitlines()
    rows = (line.split() for line in lines if not line.startswith("#"))
    header = {words[0]: words[1:] for words in rows if words}
    names = header.get("FIELDS", [])
    counts = header.get("COUNT", ["1"] * len(names))
    rows = list(zip(names, header.get("TYPE", []), header.get("SIZE", []), counts, strict=False))
    is_known = all((kind, size) in _PCD_CODES for _, kind, size, _ in rows)
    is_counted = all(re.fullmatch(r"[1-9][0-9]{0,3}", count) for count in counts)
    real = [name for name in names if name != "_"]  # "_" is padding, any number of times
    if not rows or len(rows) != len(names) or not (is_known and is_counted):
        raise InputError(
            f"{path}: PCD header of FIELDS {names}, TYPE {header.get('TYPE')}, SIZE "
            f"{header.get('SIZE')}, COUNT {counts} is not understood; save it as version 0.7"
        )
    if len(set(real)) != len(real):
        raise InputError(f"{path}: PCD fields {names} repeat a name; keep one of them")
    viewpoint = " ".join(header.get("VIEWPOINT", []))
    if viewpoint and not _is_identity(viewpoint):
        warnings.warn(
            f"{path}: its VIEWPOINT {viewpoint[:100]} (x y z, qw qx qy qz of the sensor) is not "
            "applied: the points are taken as they are. If they are in that other frame, turn them "
            "into the sensor's (x right, y down, z forward) and write VIEWPOINT 0 0 0 1 0 0 0",
            Notice,
            stacklevel=4,
        )
    fields = [Field(name=n, code=_PCD_CODES[k, s], count=int(c)) for n, k, s, c in rows]
    sides = [header.get(name, []) for name in ("WIDTH", "HEIGHT")]
    sides = [header["POINTS"]] if "POINTS" in header else sides
    if not all(re.fullmatch(r"[0-9]{1,10}", " ".join(side)) for side in sides):
        raise InputError(f"{path}: the PCD header says no number of POINTS; add that line")
    count = math.prod(int(side[0]) for side in sides)
    body = memoryview(data)[end.end() :]
    if end[1] == b"binary":
        return split_records(path, body, fields, count)
    if end[1] == b"binary_compressed":
        need_bytes(path, len(body), 8, "the two compressed sizes")
        packed_size, size = (int(n) for n in np.frombuffer(body, "<u4", 2))
        need_bytes(path, len(body) - 8, packed_size, "compressed points")
        declared = count * sum(f.count * np.dtype(f.code).itemsize for f in fields)
        if size != declared or size > _MAX_UNPACKED or packed_size > _MAX_PACKED:
            raise InputError(
                f"{path}: {packed_size} bytes, {size} unpacked, where the header needs {declared} "
                f"(and {_MAX_PACKED} and {_MAX_UNPACKED} are allowed); save it as DATA binary"
            )
        try:
            unpacked = memoryview(decompress_lzf(body[8 : 8 + packed_size], size))
        except ValueError as error:
            raise InputError(f"{path}: damaged: {error}; save it as DATA binary") from error
        columns: Columns = {}
        for f in fields:  # one field after the other, each for all points
            values = np.frombuffer(unpacked, f"<{f.code}", count * f.count)
            columns[f.name] = values.reshape(count, f.count)[:, 0]
            unpacked = unpacked[values.nbytes :]
        return columns
    return split_rows(path, text_rows(path, body), fields, count)


def _is_identity(viewpoint: str) -> bool:
    """Whether a viewpoint, ``x y z qw qx qy qz``, moves nothing; writers without one put 0."""
    try:
        *moved, qw, qx, qy, qz = (float(word) for word in viewpoint.split())
    except ValueError:
        return False
    return len(moved) == 3 and not any((*moved, qx, qy, qz)) and math.isfinite(qw)


def encode_pcd(points: np.ndarray, color: np.ndarray | None) -> bytes:
    """Encode points, and colours as one packed ``rgb`` where there are any, as binary PCD."""
    table = np.ascontiguousarray(points, dtype="<f4")
    if color is not None:
        red, green, blue = color.astype("<u4").T
        packed = ((red << 16) | (green << 8) | blue).astype("<u4").view("<f4")
        table = np.column_stack([table, packed])
    names = "x y z" if color is None else "x y z rgb"
    width = table.shape[1]
    header = (
        f"VERSION 0.7\nFIELDS {names}\nSIZE {' '.join('4' * width)}\nTYPE {' '.join('F' * width)}\n"
        f"COUNT {' '.join('1' * width)}\nWIDTH {len(points)}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA binary\n"
    )
    return header.encode() + table.tobytes()


def decompress_lzf(packed: memoryview, size: int) -> bytes:
    """Undo LZF, the compression of ``binary_compressed`` files.

    A control byte below 32 announces that many literal bytes and one; any other holds a length
    (3 bits, 7: a further byte is added) and a distance (13 bits) back into what is there already.
    """
    out = bytearray()
    at = 0
    while at < len(packed) and len(out) <= size:
        control = packed[at]
        at += 1
        if control < 32:
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        more_bytes = (control >> 5) // 7  # bytes of the length that follow
        if at + more_bytes >= len(packed):
            raise ValueError("the compressed bytes end in the middle of a reference")
        length = (control >> 5) + more_bytes * packed[at]
        start = len(out) - ((control & 31) << 8) - packed[at + more_bytes] - 1
        at += more_bytes + 1
        if start < 0:
            raise ValueError("the compressed bytes refer to before their beginning")
        piece = out[start : start + length + 2]  # shorter where source and target overlap
        out += (piece * ((length + 2) // len(piece) + 1))[: length + 2]
    if len(out) != size or at > len(packed):
        raise ValueError(f"the compressed bytes do not unpack to {size}")
    return bytes(out)
