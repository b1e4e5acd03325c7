"""Reading and writing of PLY (Turk 1994) and PCD (Point Cloud Library, version 0.7) by columns.

Text and binary of both byte orders are read; little-endian binary is written.
"""

import math
import re
import warnings
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO, TextIOWrapper
from itertools import accumulate, islice
from typing import Any

import numpy as np

from depthpose.core.errors import InputError, Notice
from depthpose.core.files.disk import MAX_TEXT_BYTES, AnyPath, read_bytes, refused_as

_MICROSOFT_NAN = re.compile(r"[-+]?(?:nan\(\w*\)|1[.,]#(?:QNAN|SNAN|IND|INF)\w*)")
"""NaN and infinity as Microsoft's C library prints them."""
_TOO_FEW_ROWS = "declares {} but {} rows follow; it is truncated, save it again"
Columns = dict[str, np.ndarray]
"""The values of all points by the names of their columns; all are equally long."""


@dataclass(frozen=True, kw_only=True)
class RecordField:
    """A field of the records of a file: a number, several numbers, or a list."""

    name: str
    code: str  #: numpy's type code without byte order, such as "f4"
    count: int = 1  #: numbers of a record; only the first is read
    size_code: str | None = None  #: type code of the length of a list; None: it is no list


@dataclass(frozen=True, eq=False)
class RaggedLists:
    """Lists of differing length."""

    sizes: np.ndarray  #: number of values of each list
    values: np.ndarray  #: the values of all lists, one after the other


def split_records(
    path: AnyPath, body: memoryview, fields: list[RecordField], count: int, order: str = "<"
) -> Columns:
    """Split packed binary records into columns, as views of their bytes.

    Args:
        path: the file, for errors.
        body: the bytes of the records, and perhaps more.
        fields: fields of a record.
        count: number of records.
        order: numpy's sign of the byte order.

    Raises:
        InputError: there are too few bytes.
    """
    # Named by position, since a file may use one name for several fields of padding.
    with refused_as(path, "list of fields", "save it again"):
        dtype = np.dtype([(f"{i}", order + f.code, (f.count,)) for i, f in enumerate(fields)])
    require_bytes(path, len(body), count * dtype.itemsize, f"{count} points")
    records = np.frombuffer(body, dtype, count)
    return {f.name: records[f"{i}"][:, 0] for i, f in enumerate(fields)}


def read_text_rows(path: AnyPath, body: memoryview) -> Iterator[str]:
    """Yield the lines of a text of points without empty ones; NaN is spelled ``nan``.

    Raises:
        InputError: the text is too long.
    """
    if len(body) > MAX_TEXT_BYTES:
        raise InputError(
            f"{path}: {len(body)} bytes of points in text, more than {MAX_TEXT_BYTES}; save it as "
            "binary"
        )
    lines = TextIOWrapper(BytesIO(body), "latin-1")
    return (spell_nan(line) for line in lines if line.strip())


def spell_nan(line: str) -> str:
    """Replace NaN and infinity, as Microsoft's C library prints them, by ``nan`` and ``inf``."""
    if "#" not in line and "(" not in line:
        return line
    return _MICROSOFT_NAN.sub(lambda match: "inf" if "INF" in match[0] else "nan", line)


def split_rows(
    path: AnyPath, rows: Iterator[str], fields: list[RecordField], count: int
) -> Columns:
    """Split the next ``count`` rows of a text into columns of the declared types.

    Raises:
        InputError: there are fewer rows, or a value is no number of its type.
    """
    table = parse_rows(path, islice(rows, count))
    if len(table) < count:
        raise InputError(f"{path}: {_TOO_FEW_ROWS.format(f'{count} points', len(table))}")
    if count == 0:
        return {}
    width = sum(f.count for f in fields)
    if table.shape[1] != width:
        raise InputError(f"{path}: rows of {table.shape[1]} values where {width} are declared")
    columns: Columns = {}
    starts = accumulate((f.count for f in fields), initial=0)
    for f, start in zip(fields, starts, strict=False):  # the last start is the width
        column = table[:, start]
        dtype = np.dtype(f.code)
        if dtype.kind != "f":
            limits = np.iinfo(dtype)
            if not ((column >= limits.min) & (column <= limits.max)).all():
                raise InputError(
                    f"{path}: {f.name!r} holds a value outside {dtype.name}; correct it"
                )
            # Floats round the limits of 64 bits, which then do not fit: such columns stay floats.
            dtype = column.dtype if dtype.itemsize == 8 else dtype
        with np.errstate(over="ignore"):
            columns[f.name] = column.astype(dtype)
    return columns


def parse_rows(path: AnyPath, rows: Iterable[str]) -> np.ndarray:
    """Parse rows of equally many numbers, separated by blanks, to a float64 table.

    Rows are taken one at a time, so that their text need not fit into memory.
    """
    with refused_as(path, "table of numbers", "give every row as many values, with decimal points"):
        table = np.loadtxt(rows, dtype=np.float64, comments=None, ndmin=2)
    return table if table.size else np.empty((0, 0))


def require_bytes(path: AnyPath, have: int, need: int, what: str) -> None:
    """Refuse a file that is shorter than its header declares, before memory is allocated for it.

    Args:
        path: the file, for the error.
        have: bytes that there are.
        need: bytes that are declared.
        what: what the header declares, such as ``100 points``.

    Raises:
        InputError: there are fewer bytes than declared.
    """
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
_MAX_HEADER = 2**16  # bytes in which the end of a header is looked for
_END = re.compile(rb"(?:^|[\r\n])end_header[ \t]*(?:\r\n|\n|\r)")


_MAX_RUNS = 500_000  # most runs of binary rows with lists of one length; more take over 10 s
_LEAST_ROWS_AHEAD = 64  # rows that are tried at least as a run
_SURPLUS_BYTES = 3  # bytes that may follow binary data: a line end


@dataclass(kw_only=True)
class _PlyElement:
    """An element of a PLY header, such as ``vertex`` or ``face``."""

    name: str
    count: int  # number of its records
    fields: list[RecordField] = field(default_factory=list)


def read_ply_elements(
    path: AnyPath, last: str | None = None
) -> tuple[Columns, dict[str, RaggedLists]]:
    """Read the columns of the ``vertex`` element of a PLY file, and the lists of the others.

    Args:
        path: the file.
        last: element after which reading ends; None: the whole file.

    Returns:
        Columns by name, and lists by ``ELEMENT PROPERTY``, such as ``face vertex_indices``.

    Raises:
        InputError: the file is missing, damaged, or not what its header declares.
    """
    data = read_bytes(path)
    end = _END.search(data, 0, _MAX_HEADER)
    if not data.startswith(b"ply") or end is None:
        raise InputError(f"{path}: no PLY header ('ply' ... 'end_header'); is it a PLY file?")
    order, elements = _parse_header(path, data[: end.start()].decode("latin-1").splitlines())
    body = memoryview(data)[end.end() :]

    # Elements follow one another, as binary records or as rows of text.
    rows = None if order else read_text_rows(path, body)
    columns: Columns = {}
    lists: dict[str, RaggedLists] = {}
    for element in elements:
        if element.name == "vertex" and rows is None:
            columns = split_records(path, body, element.fields, element.count, order)
            record_bytes = sum(np.dtype(f.code).itemsize for f in element.fields)
            body = body[element.count * record_bytes :]
        elif element.name == "vertex":
            assert rows is not None
            columns = split_rows(path, rows, element.fields, element.count)
        elif rows is None:
            element_lists, used_bytes = _read_binary_lists(path, body, element, order)
            body = body[used_bytes:]
            lists |= element_lists
        else:
            lists |= _read_text_lists(path, rows, element)
        if element.name == last:
            return columns, lists

    surplus = len(body) if rows is None else sum(1 for _ in rows)
    if surplus > (_SURPLUS_BYTES if rows is None else 0):
        unit = "bytes" if rows is None else "rows"
        declared = ", ".join(f"{element.count} {element.name}" for element in elements)
        raise InputError(
            f"{path}: {surplus} {unit} follow what its header declares ({declared}); correct it, "
            "or save it again"
        )
    return columns, lists


def _read_text_lists(
    path: AnyPath, rows: Iterator[str], element: _PlyElement
) -> dict[str, RaggedLists]:
    """Read the lists of an element from rows of text: in a row the length of each, then its values.

    The keys of the result are ``ELEMENT PROPERTY``.
    """
    sizes = {f.name: array("q") for f in element.fields if f.size_code}
    values = {name: array("d") for name in sizes}
    row_count = 0
    for row_count, row in enumerate(islice(rows, element.count), 1):
        words = row.split()
        position = 0
        try:
            for f in element.fields:
                if f.size_code:
                    size = int(words[position])
                    if size < 0:
                        position = -1  # refused below
                        break
                    sizes[f.name].append(size)
                    first = position + 1
                    values[f.name].extend(map(float, words[first : first + size]))
                    position += size
                position += 1
        except (ValueError, IndexError, OverflowError):
            position = -1  # refused below, as a row of another length
        if position != len(words):
            raise InputError(
                f"{path}: row {row_count} of {element.name}, {row.strip()[:60]!r}, is not what the "
                "header declares (the number of values, then as many); save it again"
            )

    if row_count < element.count:
        declared = f"{element.count} {element.name}"
        raise InputError(f"{path}: {_TOO_FEW_ROWS.format(declared, row_count)}")
    return {
        f"{element.name} {name}": RaggedLists(
            np.array(sizes[name], np.int64), np.array(values[name])
        )
        for name in sizes
    }


def _read_binary_lists(
    path: AnyPath, body: memoryview, element: _PlyElement, order: str
) -> tuple[dict[str, RaggedLists], int]:
    """Read the lists of an element from binary rows.

    A run of rows whose lists have equal lengths is read at once, as records whose type follows from
    the lengths of the first row.

    Returns:
        The lists by ``ELEMENT PROPERTY``, and the number of bytes of all rows.
    """
    declared = f"{element.count} {element.name}"
    runs: list[Any] = []  # structured arrays, one row each record
    record_types: dict[tuple[int, ...], np.dtype] = {}
    position = 0
    rows_left = element.count
    rows_ahead = _LEAST_ROWS_AHEAD
    while rows_left:
        lengths = _read_list_lengths(path, body, position, element, order)
        if lengths not in record_types:
            record_types[lengths] = _make_record_type(element.fields, lengths, order)
        record_type = record_types[lengths]

        # Rows up to the first whose lists have other lengths.
        rows = min(rows_left, rows_ahead, (len(body) - position) // record_type.itemsize)
        records: Any = np.frombuffer(body, record_type, rows, position)
        sizes = [records[f"{f.name} size"] for f in element.fields if f.size_code]
        # Without a list all rows are alike.
        is_equal = np.array([size == size[0] for size in sizes] or [[True]]).all(0)
        if not is_equal.all():
            records = records[: int(is_equal.argmin())]
        runs.append(records)
        if len(runs) > _MAX_RUNS:
            raise InputError(f"{path}: {declared} of ever other lengths; export triangles alone")
        position += records.nbytes
        rows_left -= len(records)
        rows_ahead = 2 * len(records) + _LEAST_ROWS_AHEAD  # long runs follow long runs

    lists: dict[str, RaggedLists] = {}
    for f in element.fields:
        if f.size_code:
            sizes = [run[f"{f.name} size"] for run in runs]
            values = [run[f.name].reshape(-1) for run in runs]
            lists[f"{element.name} {f.name}"] = RaggedLists(
                sizes=np.concatenate([np.empty(0, int), *sizes]),
                values=np.concatenate([np.empty(0, f.code), *values]),
            )
    return lists, position


def _read_list_lengths(
    path: AnyPath, body: memoryview, position: int, element: _PlyElement, order: str
) -> tuple[int, ...]:
    """Read the length of each list of the binary row at ``position``; 1 of a field without one."""
    declared = f"{element.count} {element.name}"
    lengths: list[int] = []
    end = position
    for f in element.fields:
        length = 1
        if f.size_code:
            size_type = np.dtype(order + f.size_code)
            require_bytes(path, len(body), end + size_type.itemsize, declared)
            length = int(np.frombuffer(body, size_type, 1, end)[0])
            if length < 0:
                raise InputError(f"{path}: a list of {declared} has {length} values; save it anew")
            end += size_type.itemsize
        lengths.append(length)
        end += length * np.dtype(f.code).itemsize
    require_bytes(path, len(body), end, declared)
    return tuple(lengths)


def _make_record_type(fields: list[RecordField], lengths: tuple[int, ...], order: str) -> np.dtype:
    """Make numpy's type of a binary row from the number of values of each field."""
    parts: list[Any] = []
    for f, length in zip(fields, lengths, strict=True):
        if f.size_code:
            parts.append((f"{f.name} size", order + f.size_code))
        parts.append((f.name, order + f.code, (length,)))
    return np.dtype(parts)


def encode_ply(points: np.ndarray, color: np.ndarray | None) -> bytes:
    """Encode points (n, 3), and colours of 8 bits where there are any, as little-endian PLY."""
    # Name, numpy's type, PLY's type and the values of each column.
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


def _parse_header(path: AnyPath, lines: list[str]) -> tuple[str, list[_PlyElement]]:
    """Parse the header of a PLY file: byte order ("" for text) and elements with their fields."""
    order: str | None = None
    elements: list[_PlyElement] = []
    for line in lines[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", form, "1.0"] if form in _ORDERS:
                order = _ORDERS[form]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,18}", count):
                elements.append(_PlyElement(name=name, count=int(count)))
            case ["property", "list", size, kind, name] if (
                {size, kind} <= _CODES.keys() and _CODES[size][0] != "f" and elements
            ):
                elements[-1].fields.append(
                    RecordField(name=name, code=_CODES[kind], size_code=_CODES[size])
                )
            case ["property", kind, name] if kind in _CODES and elements:
                elements[-1].fields.append(RecordField(name=name, code=_CODES[kind]))
            case _:
                raise InputError(
                    f"{path}: PLY header line {line[:60]!r} is not understood; correct it"
                )
    if order is None:
        raise InputError(f"{path}: the PLY header names no format; use {', '.join(_ORDERS)} 1.0")
    _refuse_unusable_elements(path, elements)
    return order, elements


def _refuse_unusable_elements(path: AnyPath, elements: Sequence[_PlyElement]) -> None:
    """Refuse a header without one element of vertices, or with unusable properties."""
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


_PCD_CODES = {
    **{("F", "4"): "f4", ("F", "8"): "f8"},
    **{("I", size): f"i{size}" for size in "1248"},
    **{("U", size): f"u{size}" for size in "1248"},
}
_MAX_PACKED = 2**25  # most bytes of compressed points, since decompressing them is slow
_MAX_UNPACKED = 2**27  # most bytes of them once decompressed: eight million points
_DATA = re.compile(rb"(?:^|\n)DATA[ \t]+(ascii|binary|binary_compressed)[ \t]*(?:\r\n|\n)")


def read_pcd(path: AnyPath) -> Columns:
    """Read the columns of a PCD file; a packed colour, ``rgb``, stays packed.

    Raises:
        InputError: the file is missing, damaged, or not what its header declares.

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
    fields = _read_pcd_fields(path, header)
    _warn_of_viewpoint(path, " ".join(header.get("VIEWPOINT", [])))

    # The number of points, and their values.
    sides = [header.get(name, []) for name in ("WIDTH", "HEIGHT")]
    sides = [header["POINTS"]] if "POINTS" in header else sides
    if not all(re.fullmatch(r"[0-9]{1,10}", " ".join(side)) for side in sides):
        raise InputError(f"{path}: the PCD header says no number of POINTS; add that line")
    count = math.prod(int(side[0]) for side in sides)
    body = memoryview(data)[end.end() :]
    if end[1] == b"binary":
        return split_records(path, body, fields, count)
    if end[1] == b"binary_compressed":
        return _split_compressed(path, body, fields, count)
    return split_rows(path, read_text_rows(path, body), fields, count)


def _read_pcd_fields(path: AnyPath, header: Mapping[str, list[str]]) -> list[RecordField]:
    """Read the fields that a PCD header declares.

    ``header``: the further words of each line, by its first word.
    """
    names = header.get("FIELDS", [])
    counts = header.get("COUNT", ["1"] * len(names))
    rows = list(zip(names, header.get("TYPE", []), header.get("SIZE", []), counts, strict=False))
    is_readable = all((kind, size) in _PCD_CODES for _, kind, size, _ in rows)
    is_counted = all(re.fullmatch(r"[1-9][0-9]{0,3}", count) for count in counts)
    real = [name for name in names if name != "_"]  # "_" is padding, any number of times
    if not rows or len(rows) != len(names) or not (is_readable and is_counted):
        raise InputError(
            f"{path}: PCD header of FIELDS {names}, TYPE {header.get('TYPE')}, SIZE "
            f"{header.get('SIZE')}, COUNT {counts} is not understood; save it as version 0.7"
        )
    if len(set(real)) != len(real):
        raise InputError(f"{path}: PCD fields {names} repeat a name; keep one of them")
    return [RecordField(name=n, code=_PCD_CODES[k, s], count=int(c)) for n, k, s, c in rows]


def _warn_of_viewpoint(path: AnyPath, viewpoint: str) -> None:
    """Warn that the sensor's pose in a PCD header is not applied, unless it is the identity."""
    if viewpoint and not _is_identity(viewpoint):
        warnings.warn(
            f"{path}: its VIEWPOINT {viewpoint[:100]} (x y z, qw qx qy qz of the sensor) is not "
            "applied: the points are taken as they are. If they are in that other frame, turn them "
            "into the sensor's (x right, y down, z forward) and write VIEWPOINT 0 0 0 1 0 0 0",
            Notice,
            stacklevel=5,
        )


def _split_compressed(
    path: AnyPath, body: memoryview, fields: list[RecordField], count: int
) -> Columns:
    """Split the body of a ``binary_compressed`` PCD file into columns.

    It is the compressed and the uncompressed size (4 bytes each), then the columns of all points,
    one after the other, compressed by LZF.
    """
    head_bytes = 8  # of the two sizes
    require_bytes(path, len(body), head_bytes, "the two compressed sizes")
    packed_size, size = (int(n) for n in np.frombuffer(body, "<u4", 2))
    require_bytes(path, len(body) - head_bytes, packed_size, "compressed points")
    declared = count * sum(f.count * np.dtype(f.code).itemsize for f in fields)
    if size != declared or size > _MAX_UNPACKED or packed_size > _MAX_PACKED:
        raise InputError(
            f"{path}: {packed_size} bytes, {size} unpacked, where the header needs {declared} "
            f"(and {_MAX_PACKED} and {_MAX_UNPACKED} are allowed); save it as DATA binary"
        )
    try:
        packed = body[head_bytes : head_bytes + packed_size]
        unpacked = memoryview(decompress_lzf(packed, size))
    except ValueError as error:
        raise InputError(f"{path}: damaged: {error}; save it as DATA binary") from error
    columns: Columns = {}
    for f in fields:
        values = np.frombuffer(unpacked, f"<{f.code}", count * f.count)
        columns[f.name] = values.reshape(count, f.count)[:, 0]
        unpacked = unpacked[values.nbytes :]
    return columns


def _is_identity(viewpoint: str) -> bool:
    """Whether a viewpoint, ``x y z qw qx qy qz``, is the identity.

    A quaternion of 0 counts as the identity: programs without a viewpoint write it.
    """
    try:
        *translation, qw, qx, qy, qz = (float(word) for word in viewpoint.split())
    except ValueError:
        return False
    is_unmoved = len(translation) == 3 and not any(translation)
    return is_unmoved and not any((qx, qy, qz)) and math.isfinite(qw)


def encode_pcd(points: np.ndarray, color: np.ndarray | None) -> bytes:
    """Encode points (n, 3), and colours of 8 bits as one packed ``rgb``, as binary PCD."""
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
    """Decompress LZF, the compression of ``binary_compressed`` files, to ``size`` bytes.

    A control byte c below 32 announces c + 1 literal bytes. Any other begins a reference to bytes
    that are decompressed already: its upper 3 bits hold the length less 2 (7: the next byte is
    added), its lower 5 bits and the last byte the distance less 1.

    Raises:
        ValueError: the compressed bytes are damaged, or decompress to another size.
    """
    out = bytearray()
    position = 0
    while position < len(packed) and len(out) <= size:
        control = packed[position]
        position += 1
        if control < 32:
            out += packed[position : position + control + 1]
            position += control + 1
            continue

        has_length_byte = control >> 5 == 7
        if position + has_length_byte >= len(packed):
            raise ValueError("the compressed bytes end in the middle of a reference")
        length = (control >> 5) + 2
        if has_length_byte:
            length += packed[position]
            position += 1
        distance = ((control & 31) << 8) + packed[position] + 1
        position += 1
        start = len(out) - distance
        if start < 0:
            raise ValueError("the compressed bytes refer to before their beginning")
        # Where the reference reaches beyond the end, its bytes repeat.
        piece = out[start : start + length]
        out += (piece * (length // len(piece) + 1))[:length]
    if len(out) != size or position > len(packed):
        raise ValueError(f"the compressed bytes do not unpack to {size}")
    return bytes(out)
