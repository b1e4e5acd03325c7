"""Text, JSON and calibration files."""

import json
import math
import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NoReturn

import yaml

from depthpose.core.errors import InputError
from depthpose.core.files.disk import AnyPath, read_bytes, refused_as, write_bytes

MAX_TEXT_BYTES = 2**26  # a table of a million points, annotations of ten thousand images
MAX_LIST_BYTES = 2**20  # largest text that lists a few numbers: a calibration, a camera, a config
_MOST_MEMORY = 700_000_000  # [bytes] of JSON or YAML once it is read, by counting its signs
_MOST_DEPTH = 50
_MOST_VALUES = 2_000_000  # most values of YAML whose references are written out
_PLAIN: type[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""Ten times faster where PyYAML was built with libyaml, as its wheels are."""
_MERGE = "tag:yaml.org,2002:merge"
_OF_JSON = {b",": 60, b"[": 100, b"{": 100, b":": 200}

_KEY_VALUE = re.compile(r"([^\s:=]+)\s*[:=](.*)")
_BRACKETS = str.maketrans("[];,", "    ")


class YamlLoader(_PLAIN):
    """Plain values alone, and no key twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Give a mapping; of a key that stands twice the first value would be lost."""
        seen: set[tuple[str, str]] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag == _MERGE:
                continue
            if (key.tag, key.value) in seen:
                line = key.start_mark.line + 1
                raise ValueError(f"line {line}: key {key.value!r} is given twice")
            seen.add((key.tag, key.value))
        return super().construct_mapping(node, deep)


def read_text(path: AnyPath, most: int = MAX_TEXT_BYTES) -> str:
    """Read UTF-8 text, with or without a byte order mark.

    Args:
        path: the file.
        most: bytes beyond which it is refused unread.

    Raises:
        InputError: the file is missing, too large or not UTF-8 text.
    """
    return _decoded(path, read_bytes(path, most))


def _decoded(path: AnyPath, data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: not UTF-8 text (byte {error.start}: {error.reason}); save it as UTF-8"
        ) from error


def read_json(path: AnyPath) -> object:
    """Read JSON strictly.

    Raises:
        InputError: the file is missing or no JSON, holds NaN, infinity or a number beyond float64,
            gives a key twice, or would fill the memory.
    """
    data = read_bytes(path)
    refuse_heavy(path, data, _OF_JSON)
    text = _decoded(path, data)

    def once_each(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        seen: dict[str, Any] = {}
        for key, value in pairs:
            if key in seen:
                raise ValueError(f"key {key!r} is given twice")
            seen[key] = value
        return seen

    def finite(word: str) -> float:
        value = float(word)
        return value if math.isfinite(value) else refuse_number(word)

    with refused_as(path, "JSON file", "correct it there"):
        return json.loads(
            text, parse_constant=refuse_number, parse_float=finite, object_pairs_hook=once_each
        )


def refuse_heavy(path: AnyPath, data: bytes, memory_of: Mapping[bytes, int]) -> None:
    """Refuse a tree in text that would fill the memory."""
    a_letter = 2 if data.isascii() else 5
    need = a_letter * len(data) + sum(size * data.count(sign) for sign, size in memory_of.items())
    if need > _MOST_MEMORY:
        raise InputError(
            f"{path}: {len(data)} bytes that would take about {need / 1e6:.0f} MB of memory, more "
            f"than the {_MOST_MEMORY / 1e6:.0f} MB allowed; split it"
        )


def parse_yaml(path: AnyPath, text: str) -> object:
    """Parse YAML of plain values; references (``*name``) are followed within a bound."""
    refuse_yaml_bomb(path, text)
    with refused_as(path, "YAML file", "correct it there"):
        return yaml.load(text, YamlLoader)  # noqa: S506  a safe loader


def refuse_yaml_bomb(path: AnyPath, text: str) -> None:
    """Refuse YAML that refers to itself, is too deep, or grows beyond all bounds by references."""
    sizes: dict[str, int] = {}
    unfinished: list[tuple[str | None, int]] = []
    with suppress(yaml.YAMLError):  # what is no YAML the parser refuses
        for event in yaml.parse(text, YamlLoader):
            anchor, size = getattr(event, "anchor", None), 0
            match event:
                case yaml.CollectionStartEvent():
                    unfinished.append((anchor, 1))
                    if len(unfinished) > _MOST_DEPTH:
                        raise InputError(f"{path}: lists of lists, {_MOST_DEPTH} deep; correct it")
                    continue
                case yaml.CollectionEndEvent():
                    anchor, size = unfinished.pop()
                case yaml.AliasEvent():
                    if anchor not in sizes:
                        raise InputError(f"{path}: refers to itself (*{anchor}); write it out")
                    anchor, size = None, sizes[anchor]
                case yaml.ScalarEvent():
                    size = 1
            if anchor is not None:
                sizes[anchor] = size
            if unfinished:
                unfinished[-1] = (unfinished[-1][0], unfinished[-1][1] + size)
            if size > _MOST_VALUES:
                raise InputError(
                    f"{path}: its references (*name) make more than {_MOST_VALUES} values of it; "
                    "write them out"
                )


def write_json(path: AnyPath, obj: object) -> None:
    """Write JSON with an indent of 2, keys in the order they were put in, ending in a newline.

    Raises:
        InputError: something in ``obj`` has no JSON form, NaN among them, or the disk refuses.
    """
    try:
        text = json.dumps(obj, indent=2, allow_nan=False, ensure_ascii=False)
        # A name that is not UTF-8 is kept as JSON's escapes of its bytes, which are read back.
        data = f"{text}\n".encode(errors="backslashreplace")
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
    for number, line in enumerate(read_text(path, MAX_LIST_BYTES).splitlines(), start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        match = _KEY_VALUE.fullmatch(text)
        if match is None:
            raise InputError(f"{path}: line {number}, {text[:60]!r}, is not 'KEY: numbers'")
        if match[1] in values:
            raise InputError(f"{path}: line {number} gives {match[1]!r} again; keep one of them")
        numbers: list[float] = []
        with suppress(ValueError):  # a date, or other words
            numbers = [float(word) for word in match[2].translate(_BRACKETS).split()]
        if not all(map(math.isfinite, numbers)):
            raise InputError(f"{path}: line {number}, {match[1]!r}, holds NaN or infinity")
        if numbers:
            values[match[1]] = numbers
    return values


def refuse_number(text: str) -> NoReturn:
    """Refuse NaN and infinity, which Python's parser of JSON would take."""
    raise ValueError(f"{text} is not a JSON number")
