"""Bytes, text, JSON and YAML from and to disks; names of files, and which belong together.

Reading is guarded, writing atomic. A path through a tar shard, ``000000.tar/a.left.png``, is read
as through a folder.
"""

import errno
import json
import math
import os
import re
import secrets
import stat
import tarfile
import unicodedata
import warnings
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from depthpose.core.errors import InputError

AnyPath = str | os.PathLike[str]
"""A path as users give it."""

MAX_FILE_BYTES = 2**28  # largest file that is read whole; a bigger one is a mistake or an attack
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


_ADDRESS = re.compile(r"<[^<>]* at 0x[0-9a-fA-F]+>")  # what Python shows of an object in memory
_PART = ".part-"  # begins the names of files that are being written


@contextmanager
def refused_as(path: AnyPath, kind: str, remedy: str) -> Iterator[None]:
    """Turn whatever a decoder raises on bad bytes into an :class:`InputError`.

    Decoders' warnings are silenced on purpose: they speak of metadata that is not read here, and
    sizes are checked by us.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except InputError:
        raise
    except Exception as error:  # a decoder fed with random bytes may raise anything
        text = _ADDRESS.sub("", f"{type(error).__name__}: {error}")
        cause = " ".join(text.split())[:200]
        raise InputError(f"{path}: not a readable {kind} ({cause}); {remedy}") from error


def refuse_broken_link(path: AnyPath) -> None:
    """Refuse a path on whose way a link leads nowhere, or in a circle.

    Raises:
        InputError: the link, and where it leads.
    """
    for place in (Path(path), *Path(path).parents):
        if not os.path.islink(place) or os.path.exists(place):  # noqa: PTH110, PTH114 - never raise
            continue
        try:
            place.stat()
        except OSError as error:
            is_circle = error.errno == errno.ELOOP
            leads = "in a circle" if is_circle else f"to {os.readlink(place)!r}, which is not there"  # noqa: PTH115
        else:  # made by another process meanwhile
            return
        raise InputError(
            f"{place}: is a link that leads {leads}; remove it, or choose another place"
        )


@contextmanager
def refused_write(path: AnyPath) -> Iterator[None]:
    """Turn the errors of a disk that cannot be written into an :class:`InputError`."""
    try:
        yield
    except OSError as error:
        refuse_broken_link(path)
        file = next((folder for folder in Path(path).parents if os.path.isfile(folder)), None)  # noqa: PTH113 - which never raises
        if file is not None:
            raise InputError(
                f"{file}: is a file, but a folder is needed there; choose another place"
            ) from error
        raise InputError(
            f"{path}: cannot be written: {error.strerror or error}; "
            "free the space, or choose another place"
        ) from error


def cache_folder() -> Path:
    """Give the folder for files that can be downloaded or computed again.

    It is ``$DEPTHPOSE_CACHE``, by default ``~/.cache/depthpose``; it need not exist.
    """
    named = os.environ.get("DEPTHPOSE_CACHE")
    return Path(named) if named else Path("~/.cache/depthpose").expanduser()


@contextmanager
def atomic_write(path: AnyPath) -> Iterator[Path]:
    """Write a file whole or not at all.

    Yields a temporary path in the same folder, with the same suffix, to be written inside the
    block. On success it takes the place of ``path``; on any failure or interrupt it is removed
    and ``path`` stays as it was. Missing folders are made.

    Raises:
        InputError: the disk is full, or the place cannot be written to.
    """
    target = Path(path)
    part = target.with_name(f"{_PART}{secrets.token_hex(6)}{target.suffix}")
    try:
        with refused_write(path):
            if target.exists() and not target.is_file():
                # Replacing /dev/null by a file would harm the whole machine.
                raise InputError(
                    f"{target}: a folder or device, which no file may replace; add a name"
                )
            target.parent.mkdir(parents=True, exist_ok=True)
            yield part
            with part.open("rb+") as file:
                os.fsync(file.fileno())
            part.replace(target)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def remove_parts(folder: Path) -> None:
    """Remove partial files of killed writers in a folder, not below; no writer may be running."""
    for part in folder.glob(f"{_PART}*"):
        with suppress(OSError):
            part.unlink()


def write_bytes(path: AnyPath, data: bytes) -> None:
    """Write bytes whole or not at all; see :func:`atomic_write`."""
    with atomic_write(path) as part:
        part.write_bytes(data)


def refused_suffix(path: AnyPath, kind: str, suffixes: tuple[str, ...]) -> InputError:
    """Make the error for a file name with an unknown suffix."""
    suffix = Path(path).suffix or "no suffix"
    return InputError(f"{path}: {suffix} is no {kind} format; use {', '.join(suffixes)}")


SOURCE = "source.json"  # beside shards fetched when first read: {"url": ...}, where from


def read_bytes(path: AnyPath, most: int = MAX_FILE_BYTES) -> bytes:
    """Read a regular file whole, or one in a shard; more than ``most`` bytes are refused unread.

    A shard that is not here yet is fetched first, from where its folder's ``source.json`` says.

    Raises:
        InputError: there is no such file, or it is none that can be read; the shard is damaged, or
            the store that it comes from does not answer.
    """
    inside = Path(path)
    try:
        if ".tar/" in inside.as_posix():
            shards = (folder for folder in inside.parents if folder.suffix == ".tar")
            if (
                shard := next((candidate for candidate in shards if not candidate.is_dir()), None)
            ) is not None:
                return _read_in_shard(shard, inside.relative_to(shard).as_posix(), most)
        status = inside.stat()
        reason = ""
        if stat.S_ISDIR(status.st_mode):
            reason = "a folder where a file is needed; name a file inside it"
        elif not stat.S_ISREG(status.st_mode):
            reason = "a device or pipe; save its content to a regular file first"
        elif status.st_size > most:
            reason = (
                f"{status.st_size} bytes, more than the {most} that are read of such a file; thin "
                "it out or split it"
            )
        if not reason:
            return inside.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path") from error
    except (OSError, MemoryError) as error:
        raise InputError(f"{path}: cannot be read: {error or 'no memory left'}") from error
    except InputError:
        raise
    except ValueError as error:  # a NUL byte in the name
        raise InputError(f"{os.fspath(path)!r}: not a file name: {error}") from error
    raise InputError(f"{path}: {reason}")


def _read_in_shard(shard: Path, name: str, most: int) -> bytes:
    """Read a file of a tar shard, which is fetched if it is not here."""
    if not shard.exists():
        source = shard.parent / SOURCE
        if not source.is_file():
            raise InputError(f"{shard}: no such file; check the path")
        folder = json.loads(source.read_text())["url"].rstrip("/")
        fetch(f"{folder}/{shard.name}", shard)
    status = shard.stat()
    place = _places(shard, status.st_mtime_ns, status.st_size).get(name)
    if place is None:
        raise InputError(f"{shard}: holds no file {name!r}; pack the data set again")
    offset, size = place
    if size > most:
        raise InputError(f"{shard}/{name}: {size} bytes, more than the {most} that are read of it")
    with shard.open("rb") as file:
        file.seek(offset)
        data = file.read(size)
    if len(data) < size:
        raise InputError(f"{shard}: ends within {name!r}; pack or fetch it again")
    return data


@lru_cache(maxsize=4096)
def _places(shard: Path, _changed_ns: int, _size: int) -> dict[str, tuple[int, int]]:
    """Give offset and size [bytes] of each file of a shard."""
    try:
        with tarfile.open(shard, "r:") as tar:
            return {m.name: (m.offset_data, m.size) for m in tar if m.isfile() and not m.sparse}
    except (tarfile.TarError, OSError, EOFError) as error:
        raise InputError(f"{shard}: not a readable tar shard ({error}); pack it again") from error


def fetch(url: str, path: Path) -> None:
    """Copy a file to the disk, whole or not at all."""
    with atomic_write(path) as part, file_system(url, "read") as (fs, inner):
        fs.get_file(inner, str(part))


@contextmanager
def file_system(url: str, done: str) -> Iterator[tuple[Any, str]]:
    """Give the file system of a URL and the path there; its errors become :class:`InputError`."""
    try:
        from fsspec.core import url_to_fs  # takes time to load

        fs, inner = url_to_fs(url)
        fs.invalidate_cache()
        yield fs, inner
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"{url}: no such file; check the path") from error
    except ImportError as error:
        raise InputError(f"{url}: its file system is not installed: {error}") from error
    except Exception as error:  # each file system raises errors of its own
        cause = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(
            f"{url}: cannot be {done} ({cause}); check the address and the credentials"
        ) from error


class YamlLoader(_PLAIN):
    """Plain values alone, and no key twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Give a mapping; of a key that stands twice the first value would be lost."""
        keys_of_map: set[tuple[str, str]] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag == _MERGE:
                continue
            if (key.tag, key.value) in keys_of_map:
                line = key.start_mark.line + 1
                raise ValueError(f"line {line}: key {key.value!r} is given twice")
            keys_of_map.add((key.tag, key.value))
        return super().construct_mapping(node, deep)


def read_text(path: AnyPath, most: int = MAX_TEXT_BYTES) -> str:
    """Read UTF-8 text, with or without a byte order mark.

    Args:
        path: the file.
        most: bytes beyond which it is refused unread.

    Raises:
        InputError: the file is missing, too large or not UTF-8 text.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
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
    text = read_text(path, MAX_FILE_BYTES)
    refuse_heavy(path, text.encode(), _OF_JSON)

    def once_each(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        """Make an object of JSON, in which no key may stand twice."""
        members: dict[str, Any] = {}
        for key, value in pairs:
            if key in members:
                raise ValueError(f"key {key!r} is given twice")
            members[key] = value
        return members

    with refused_as(path, "JSON file", "correct it there"):
        return json.loads(
            text,
            parse_constant=finite_number,
            parse_float=finite_number,
            object_pairs_hook=once_each,
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
            anchor = getattr(event, "anchor", None)
            size = 0
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
                    size = sizes[anchor]
                    anchor = None
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
    (dates) are left out, and so are blank lines and what follows ``#``.

    Raises:
        InputError: the file is missing or not text, a line has no key or repeats one, or a number
            is not finite.
    """
    values: dict[str, list[float]] = {}
    for number, line in enumerate(read_text(path, MAX_LIST_BYTES).splitlines(), start=1):
        text = line.partition("#")[0].strip()
        if not text:
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


def finite_number(text: str) -> float:
    """Read a number of JSON; NaN and infinity, which Python's parser would take, are none."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a JSON number")
    return value


_MOST_SHOWN = 6


_NUMBER = re.compile(r"((?<![\d.])\d+\.\d+(?!\d|\.\d)|\d+)")


def natural_order(path: Path) -> tuple[list[list[str | tuple[int, str]]], Path]:
    """Give the key that sorts paths by name, and numbers in names by value: 2 before 10.

    Two runs of digits with a point between them are a decimal, as of a time in seconds: 0.45 comes
    before 0.5. Three are none (1.2.10).
    """
    pieces = [_NUMBER.split(part) for part in (*path.parent.parts, path.stem)]

    def value(piece: str) -> tuple[int, str]:
        whole, _, decimals = piece.partition(".")
        return int(whole), decimals  # digits behind the point sort as letters do

    # Every second piece is a number, so that like is compared with like.
    return [[value(p) if k % 2 else p for k, p in enumerate(part)] for part in pieces], path


def stem_of(path: Path) -> str:
    """Give a file's name without its suffix, normalised to one Unicode form.

    A letter with an accent may be stored as one character (NFC) or two (NFD: disks of macOS).
    """
    return unicodedata.normalize("NFC", path.stem)


def find_partners(first: Sequence[str], second: Sequence[str], sides: str) -> list[int]:
    """Give for each name of one side the index of its partner on the other.

    Names belong together that are equal; else those that are equal without what all names of their
    side share (``left_0004`` and ``right_0004``, ``1_L`` and ``1_R``), numbers by value. Two lone
    names belong together unless each has numbers and none of them is the other's.
    """
    first, second = (
        [unicodedata.normalize("NFC", name) for name in side] for side in (first, second)
    )
    keys: tuple[Sequence[Hashable], Sequence[Hashable]] = first, second
    if not set(first) & set(second):
        keys = _own_parts(first, second)
    places = {key: place for place, key in enumerate(keys[1])}
    counts = [Counter(side) for side in keys]
    both = [*zip(first, keys[0], strict=True), *zip(second, keys[1], strict=True)]
    lone = [name for name, key in both if counts[0][key] != 1 or counts[1][key] != 1]
    if lone:
        shown = ", ".join(map(repr, lone[:_MOST_SHOWN])) + (", ..." if lone[_MOST_SHOWN:] else "")
        raise InputError(
            f"{sides} hold {len(first)} and {len(second)} files, and no partner of the same name "
            f"or number is there for {shown}; remove these, add their partners, or rename them"
        )
    return [places[key] for key in keys[0]]


def _own_parts(first: Sequence[str], second: Sequence[str]) -> tuple[list[Any], list[Any]]:
    """Remove from each name what all names of its side share, and read numbers by value."""
    split = [[re.split(r"(\d+)", name) for name in side] for side in (first, second)]
    if len(first) == len(second) == 1:
        numbers = [{int(piece) for piece in side[0][1::2]} for side in split]
        is_other = all(numbers) and not numbers[0] & numbers[1]
        return [first[0] if is_other else ""], [second[0] if is_other else ""]
    if len({len(pieces) for side in split for pieces in side}) > 1:
        split = [[[name] for name in side] for side in (first, second)]
    keys: list[list[tuple[str, ...]]] = [[() for _ in side] for side in split]
    for k in range(len(split[0][0])):
        columns = [[pieces[k] for pieces in side] for side in split]
        if all(len(set(column)) == 1 for column in columns):
            continue  # the side, or what both share
        for side, column in enumerate(columns):
            texts = column
            for turn in (1, -1):
                turned = [text[::turn] for text in texts]
                # what these two share, all share
                low = min(turned)
                high = max(turned)
                ends = (k for k, (a, b) in enumerate(zip(low, high, strict=False)) if a != b)
                shared = re.sub(r"\d+$", "", low[: next(ends, len(low))])
                texts = [text[len(shared) :][::turn] for text in turned]
            parts = [re.sub(r"\d+", lambda match: str(int(match[0])), text) for text in texts]
            keys[side] = [(*key, part) for key, part in zip(keys[side], parts, strict=True)]
    return keys[0], keys[1]
