"""Text, JSON and calibration files."""

import json
import math
import re
from typing import Any, NoReturn

from depthpose.core.errors import InputError
from depthpose.core.files.disk import AnyPath, read_bytes, refused_as, write_bytes

_KEY_VALUE = re.compile(r"([^\s:=]+)\s*[:=](.*)")
_BRACKETS = str.maketrans("[];,", "    ")


def read_text(path: AnyPath) -> str:
    """Read UTF-8 text, with or without a byte order mark.

    Raises:
        InputError: the file is missing or not UTF-8 text.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: not UTF-8 text (byte {error.start}: {error.reason}); save it as UTF-8"
        ) from error


def read_json(path: AnyPath) -> object:
    """Read JSON strictly.

    Raises:
        InputError: the file is missing or no JSON, holds NaN, infinity or a number beyond float64,
            or gives a key twice.
    """
    text = read_text(path)
    with refused_as(path, "JSON file", "mend it there"):
        return json.loads(
            text,
            parse_constant=_refuse_number,
            parse_float=_finite,
            object_pairs_hook=_once_each,
        )


def write_json(path: AnyPath, obj: object) -> None:
    """Write JSON with an indent of 2, keys in the order they were put in, ending in a newline.

    Raises:
        InputError: something in ``obj`` has no JSON form, NaN among them, or the disk refuses.
    """
    try:
        text = json.dumps(obj, indent=2, allow_nan=False, ensure_ascii=False)
        data = f"{text}\n".encode()
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: cannot be written as JSON: {error}; use null for NaN") from error
    write_bytes(path, data)


def read_key_values(path: AnyPath) -> dict[str, list[float]]:
    """Read ``KEY: numbers`` lines, as in KITTI's calibration files.

    ``key=[a b; c d]``, as in Middlebury's, is read row by row. Values that are not all numbers
    (dates) are left out, and so are blank lines and those that start with ``#``.

    Raises:
        InputError: the file is missing or not text, a line has no key or repeats one, or a number
            is not finite.
    """
    values: dict[str, list[float]] = {}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        found = _KEY_VALUE.fullmatch(text)
        if found is None:
            raise InputError(f"{path}: line {number}, {text[:60]!r}, is not 'KEY: numbers'")
        if found[1] in values:
            raise InputError(f"{path}: line {number} gives {found[1]!r} again; keep one of them")
        numbers = _numbers(found[2])
        if not all(map(math.isfinite, numbers)):
            raise InputError(f"{path}: line {number}, {found[1]!r}, holds NaN or infinity")
        if numbers:
            values[found[1]] = numbers
    return values


def _numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.translate(_BRACKETS).split()]
    except ValueError:
        return []


def _refuse_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a JSON number")


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _refuse_number(text)


def _once_each(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    seen: dict[str, Any] = {}
    for key, value in pairs:
        if key in seen:
            raise ValueError(f"key {key!r} is given twice")
        seen[key] = value
    return seen
