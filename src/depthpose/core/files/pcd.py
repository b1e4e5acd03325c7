"""PCD point files (Point Cloud Library, version 0.7): text, binary and compressed, to columns."""

import re

import numpy as np

from depthpose.core.errors import InputError
from depthpose.core.files.disk import AnyPath
from depthpose.core.files.points import (
    Columns,
    Field,
    need_bytes,
    split_records,
    split_rows,
    text_rows,
)
from depthpose.core.files.shards import read_bytes

_CODES = {
    **{("F", "4"): "f4", ("F", "8"): "f8"},
    **{("I", size): f"i{size}" for size in "1248"},
    **{("U", size): f"u{size}" for size in "1248"},
}
_MAX_HEADER = 2**16
_MAX_PACKED, _MAX_UNPACKED = 2**25, 2**27
"""Of compressed points, which are unpacked byte by byte: eight million points."""
_DATA = re.compile(rb"(?:^|\n)DATA[ \t]+(ascii|binary|binary_compressed)[ \t]*(?:\r\n|\n)")


def read_pcd(path: AnyPath) -> Columns:
    """Read the columns of a PCD file; ``rgb`` stays packed.

    Raises:
        InputError: the file is missing, truncated or damaged.
    """
    data = read_bytes(path)
    end = _DATA.search(data, 0, _MAX_HEADER)
    if end is None:
        raise InputError(f"{path}: no PCD header ('FIELDS' ... 'DATA'); is it a PCD file?")
    header = _parse_header(data[: end.start()].decode("latin-1"))
    fields, count = _parse_fields(path, header), _parse_count(path, header)
    body = memoryview(data)[end.end() :]
    if end[1] == b"binary":
        return split_records(path, body, fields, count)
    if end[1] == b"binary_compressed":
        return _split_compressed(path, body, fields, count)
    return split_rows(path, text_rows(path, body), fields, count)


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


def unpack_rgb(packed: np.ndarray) -> np.ndarray:
    """Take PCL's packed colour apart: a 4-byte number, float or not, of bytes (-, r, g, b)."""
    if packed.dtype.kind == "f":
        bits = packed.astype(np.float32).view(np.uint32)
    else:
        bits = packed.astype(np.int64).astype(np.uint32)
    return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], -1).astype(np.uint8)


def decompress_lzf(packed: memoryview, size: int) -> bytes:
    """Undo LZF, the compression of ``binary_compressed`` files.

    A control byte below 32 announces that many literal bytes and one; any other holds a length
    (3 bits, 7: a further byte is added) and a distance (13 bits) back into what is there already.

    Raises:
        ValueError: the stream does not unpack to exactly ``size`` bytes.
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
        length = control >> 5
        if length == 7:
            length += _byte(packed, at)
            at += 1
        start = len(out) - ((control & 31) << 8) - _byte(packed, at) - 1
        at += 1
        _repeat(out, start, length + 2)
    if len(out) != size or at > len(packed):
        raise ValueError(f"the compressed bytes do not unpack to {size}")
    return bytes(out)


def _byte(packed: memoryview, at: int) -> int:
    if at >= len(packed):
        raise ValueError("the compressed bytes end in the middle of a reference")
    return packed[at]


def _repeat(out: bytearray, start: int, length: int) -> None:
    if start < 0:
        raise ValueError("the compressed bytes refer to before their beginning")
    piece = out[start : start + length]  # shorter than length where source and target overlap
    out += (piece * (length // len(piece) + 1))[:length]


def _split_compressed(path: AnyPath, body: memoryview, fields: list[Field], count: int) -> Columns:
    need_bytes(path, len(body), 8, "the two compressed sizes")
    packed_size, size = (int(n) for n in np.frombuffer(body, "<u4", 2))
    need_bytes(path, len(body) - 8, packed_size, "compressed points")
    declared = count * sum(f.count * np.dtype(f.code).itemsize for f in fields)
    if size != declared or size > _MAX_UNPACKED or packed_size > _MAX_PACKED:
        raise InputError(
            f"{path}: {packed_size} bytes, {size} unpacked, where the header needs {declared} (and "
            f"{_MAX_PACKED} and {_MAX_UNPACKED} are allowed); save it as DATA binary"
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


def _parse_header(text: str) -> dict[str, list[str]]:
    lines = (line.split() for line in text.splitlines() if not line.startswith("#"))
    return {words[0]: words[1:] for words in lines if words}


def _parse_fields(path: AnyPath, header: dict[str, list[str]]) -> list[Field]:
    names = header.get("FIELDS", [])
    counts = header.get("COUNT", ["1"] * len(names))
    rows = list(zip(names, header.get("TYPE", []), header.get("SIZE", []), counts, strict=False))
    is_known = all((kind, size) in _CODES for _, kind, size, _ in rows)
    is_counted = all(re.fullmatch(r"[1-9][0-9]{0,3}", count) for count in counts)
    real = [name for name in names if name != "_"]  # "_" is padding, any number of times
    if not rows or len(rows) != len(names) or not (is_known and is_counted):
        raise InputError(
            f"{path}: PCD header of FIELDS {names}, TYPE {header.get('TYPE')}, SIZE "
            f"{header.get('SIZE')}, COUNT {counts} is not understood; save it as version 0.7"
        )
    if len(set(real)) != len(real):
        raise InputError(f"{path}: PCD fields {names} repeat a name; keep one of them")
    return [Field(name=n, code=_CODES[k, s], count=int(c)) for n, k, s, c in rows]


def _parse_count(path: AnyPath, header: dict[str, list[str]]) -> int:
    match header.get("POINTS"), header.get("WIDTH"), header.get("HEIGHT"):
        case [points], _, _ if _is_count(points):
            return int(points)
        case None, [width], [height] if _is_count(width) and _is_count(height):
            return int(width) * int(height)
        case _:
            raise InputError(f"{path}: the PCD header says no number of POINTS; add that line")


def _is_count(text: str) -> bool:
    return re.fullmatch(r"[0-9]{1,10}", text) is not None
