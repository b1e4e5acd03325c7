"""Bytes, text, JSON and YAML from and to disks; the order of file names, and their pairing.

Readers refuse what is too large, writers leave a whole file or none. Files in a tar shard are read
as those of a folder, by a path such as ``000000.tar/a.left.png``.
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
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from depthpose.core.errors import InputError

AnyPath = str | os.PathLike[str]
"""A path as users give it."""

MAX_FILE_BYTES = 2**28  # largest file that is read whole; a larger one is a mistake or an attack
MAX_TEXT_BYTES = 2**26  # largest text: a million points, annotations of ten thousand images
MAX_LIST_BYTES = 2**20  # largest text of a few numbers: a calibration, a camera, a config
_MAX_PARSED_BYTES = 700_000_000  # memory of a text once it is parsed, estimated from its signs
_MAX_YAML_DEPTH = 50  # most lists within lists of YAML
_MAX_YAML_VALUES = 2_000_000  # most values of YAML once its references are written out
_SAFE_LOADER: type[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""Ten times faster where PyYAML was built with libyaml, as its wheels are."""
_MERGE = "tag:yaml.org,2002:merge"  # tag of the key ``<<``
_JSON_SIGN_BYTES = {b",": 60, b"[": 100, b"{": 100, b":": 200}
"""Memory of the Python object that begins with such a sign of JSON [bytes]."""
_LONGEST_CAUSE = 200  # letters that are shown of another library's message

_KEY_VALUE = re.compile(r"([^\s:=]+)\s*[:=](.*)")
_BRACKETS_TO_BLANKS = str.maketrans("[];,", "    ")


_ADDRESS = re.compile(r"<[^<>]* at 0x[0-9a-fA-F]+>")  # what Python shows of an object in memory
_PART = ".part-"  # begins the names of files that are being written


@contextmanager
def refused_as(path: AnyPath, kind: str, remedy: str) -> Iterator[None]:
    """Turn any error of a decoder in the block into an :class:`InputError`.

    Warnings of decoders are silenced: they are about metadata that is not read, and about sizes,
    which are checked here.

    Args:
        path: the file, for the error.
        kind: what the file should be, such as ``picture``.
        remedy: what the user can do, with which the error ends.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except InputError:
        raise
    except Exception as error:  # a decoder fed with random bytes may raise anything
        text = _ADDRESS.sub("", f"{type(error).__name__}: {error}")
        cause = " ".join(text.split())[:_LONGEST_CAUSE]
        raise InputError(f"{path}: not a readable {kind} ({cause}); {remedy}") from error


def refuse_broken_link(path: AnyPath) -> None:
    """Refuse a path that leads through a broken symbolic link.

    Raises:
        InputError: a link on the way leads nowhere, or in a circle.
    """
    for link in (Path(path), *Path(path).parents):
        if not os.path.islink(link) or os.path.exists(link):  # noqa: PTH110, PTH114 - never raise
            continue
        try:
            link.stat()
        except OSError as error:
            leads = f"to {os.readlink(link)!r}, which is not there"  # noqa: PTH115
            if error.errno == errno.ELOOP:
                leads = "in a circle"
        else:  # another process has made its target meanwhile
            return
        raise InputError(
            f"{link}: is a link that leads {leads}; remove it, or choose another place"
        )


@contextmanager
def refused_write(path: AnyPath) -> Iterator[None]:
    """Turn errors of the disk in the block, which writes to ``path``, into :class:`InputError`."""
    try:
        yield
    except OSError as error:
        refuse_broken_link(path)
        for parent in Path(path).parents:
            if os.path.isfile(parent):  # noqa: PTH113 - which never raises
                raise InputError(
                    f"{parent}: is a file, but a folder is needed there; choose another place"
                ) from error
        raise InputError(
            f"{path}: cannot be written: {error.strerror or error}; "
            "free the space, or choose another place"
        ) from error


def cache_folder() -> Path:
    """Return the folder for files that can be downloaded or computed again.

    It is ``$DEPTHPOSE_CACHE``, by default ``~/.cache/depthpose``; it need not exist.
    """
    chosen = os.environ.get("DEPTHPOSE_CACHE")
    return Path(chosen) if chosen else Path("~/.cache/depthpose").expanduser()


@contextmanager
def atomic_write(path: AnyPath) -> Iterator[Path]:
    """Write a file whole or not at all.

    Yields a temporary path in the same folder, with the same suffix, which the block writes. On
    success that file replaces ``path``; on any failure or interrupt it is removed, and ``path``
    stays as it was. Missing folders are made.

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
    """Remove partial files that killed writers left in a folder; no writer may be running.

    Subfolders are not searched.
    """
    for part in folder.glob(f"{_PART}*"):
        with suppress(OSError):
            part.unlink()


def write_bytes(path: AnyPath, data: bytes) -> None:
    """Write bytes whole or not at all; see :func:`atomic_write`."""
    with atomic_write(path) as part:
        part.write_bytes(data)


def make_suffix_error(path: AnyPath, kind: str, suffixes: tuple[str, ...]) -> InputError:
    """Make the error of a file whose suffix is none of the known ones.

    ``kind`` is what the file should be, such as ``map``.
    """
    suffix = Path(path).suffix or "no suffix"
    return InputError(f"{path}: {suffix} is no {kind} format; use {', '.join(suffixes)}")


SOURCE = "source.json"
"""File beside shards that are fetched when they are first read: ``{"url": FOLDER}``."""


def read_bytes(path: AnyPath, most: int = MAX_FILE_BYTES) -> bytes:
    """Read the bytes of a regular file, or of one in a tar shard.

    A shard that is not on the disk is fetched first, from the store that ``source.json`` beside it
    names.

    Args:
        path: the file, or ``SHARD.tar/NAME``.
        most: size [bytes] above which the file is refused without reading it.

    Raises:
        InputError: the file is missing, too large, unreadable or not regular; the shard is
            damaged, or its store does not answer.
    """
    file = Path(path)
    try:
        shard = _find_shard(file)
        if shard is not None:
            return _read_in_shard(shard, file.relative_to(shard).as_posix(), most)
        _refuse_irregular(path, most)
        return file.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path") from error
    except (OSError, MemoryError) as error:
        raise InputError(f"{path}: cannot be read: {error or 'no memory left'}") from error
    except InputError:
        raise
    except ValueError as error:  # a NUL byte or half of a surrogate pair in the name
        raise InputError(f"{os.fspath(path)!r}: not a file name: {error}") from error


def _refuse_irregular(path: AnyPath, most: int) -> None:
    """Refuse what is no regular file, or one of more than ``most`` bytes."""
    status = Path(path).stat()
    if stat.S_ISDIR(status.st_mode):
        raise InputError(f"{path}: a folder where a file is needed; name a file inside it")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: a device or pipe; save its content to a regular file first")
    if status.st_size > most:
        raise InputError(
            f"{path}: {status.st_size} bytes, more than the {most} that are read of such a file; "
            "thin it out or split it"
        )


def _find_shard(path: Path) -> Path | None:
    """Find the tar shard that a path leads through, which may not be fetched yet; else None."""
    for parent in path.parents:
        if parent.suffix == ".tar" and not parent.is_dir():
            return parent
    return None


def _read_in_shard(shard: Path, name: str, most: int) -> bytes:
    """Read a file of a tar shard, which is fetched where it is not on the disk."""
    if not shard.exists():
        source = shard.parent / SOURCE
        if not source.is_file():
            raise InputError(f"{shard}: no such file; check the path")
        fetch(f"{_read_store_address(source)}/{shard.name}", shard)
    status = shard.stat()
    extent = _index_shard(shard, status.st_mtime_ns, status.st_size).get(name)
    if extent is None:
        raise InputError(f"{shard}: holds no file {name!r}; pack the dataset again")
    offset, size = extent
    if size > most:
        raise InputError(f"{shard}/{name}: {size} bytes, more than the {most} that are read of it")
    with shard.open("rb") as file:
        file.seek(offset)
        data = file.read(size)
    if len(data) < size:
        raise InputError(f"{shard}: ends within {name!r}; pack or fetch it again")
    return data


def _read_store_address(source: Path) -> str:
    """Read from ``source.json`` the address of the folder that holds the shards beside it.

    Raises:
        InputError: it is no JSON, or holds no address.
    """
    content = read_json(source)
    address = content.get("url") if isinstance(content, Mapping) else None
    if not isinstance(address, str) or not address:
        raise InputError(
            f'{source}: must be {{"url": ADDRESS}} with the address of the folder that holds the '
            f"shards, got {str(content)[:_LONGEST_CAUSE]}; correct it, or open the dataset by its "
            "address, which writes the file again"
        )
    return address.rstrip("/")


@lru_cache(maxsize=4096)
def _index_shard(shard: Path, _changed_ns: int, _size: int) -> dict[str, tuple[int, int]]:
    """List offset and size [bytes] of each file of a shard, by name.

    Time and size of the shard are arguments so that the cache reads a changed shard again.
    """
    try:
        with tarfile.open(shard, "r:") as tar:
            return {
                member.name: (member.offset_data, member.size)
                for member in tar
                if member.isfile() and not member.sparse
            }
    except (tarfile.TarError, OSError, EOFError) as error:
        raise InputError(f"{shard}: not a readable tar shard ({error}); pack it again") from error


def fetch(url: str, path: Path) -> None:
    """Copy the file of a URL to the disk, whole or not at all."""
    with atomic_write(path) as part, open_file_system(url, "read") as (fs, inner):
        fs.get_file(inner, str(part))


@contextmanager
def open_file_system(url: str, action: str) -> Iterator[tuple[Any, str]]:
    """Open fsspec's file system of a URL; yields it and the URL's path in it.

    Errors inside the block become :class:`InputError`. ``action`` is the participle for them, of
    what the block does: such as ``read``, for "cannot be read".
    """
    try:
        from fsspec.core import url_to_fs  # imported here, as loading it takes time

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
        cause = " ".join(f"{type(error).__name__}: {error}".split())[:_LONGEST_CAUSE]
        raise InputError(
            f"{url}: cannot be {action} ({cause}); check the address and the credentials"
        ) from error


class YamlLoader(_SAFE_LOADER):
    """Loads plain values, never objects, and refuses a repeated key."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Make a mapping; a repeated key, whose first value would be lost, is an error."""
        earlier_keys: set[tuple[str, str]] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag == _MERGE:
                continue
            if (key.tag, key.value) in earlier_keys:
                line = key.start_mark.line + 1
                raise ValueError(f"line {line}: key {key.value!r} is given twice")
            earlier_keys.add((key.tag, key.value))
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
    """Read JSON as its standard defines it, which Python's parser does not.

    Raises:
        InputError: the file is missing or no JSON, has NaN, infinity, a number beyond float64 or a
            repeated key, or would fill the memory.
    """
    text = read_text(path, MAX_FILE_BYTES)
    refuse_heavy_text(path, text.encode(), _JSON_SIGN_BYTES)
    with refused_as(path, "JSON file", "correct it there"):
        return json.loads(
            text,
            parse_constant=parse_finite,
            parse_float=parse_finite,
            object_pairs_hook=_make_json_object,
        )


def _make_json_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make the dict of a JSON object, and refuse a repeated key."""
    members: dict[str, Any] = {}
    for key, value in pairs:
        if key in members:
            raise ValueError(f"key {key!r} is given twice")
        members[key] = value
    return members


def refuse_heavy_text(path: AnyPath, data: bytes, memory_of_sign: Mapping[bytes, int]) -> None:
    """Refuse JSON, YAML or CSV that would fill the memory once it is parsed, before that.

    Args:
        path: the file, for the error.
        data: its bytes.
        memory_of_sign: by a sign such as ``[``, the memory [bytes] of the Python object that begins
            with it.

    Raises:
        InputError: the estimated memory is too large.
    """
    # The data, and Python's text of it: 1 byte a letter of ASCII, else up to 4.
    bytes_a_letter = 1 + (1 if data.isascii() else 4)
    memory_bytes = bytes_a_letter * len(data)
    # The objects, of which each sign begins one.
    for sign, object_bytes in memory_of_sign.items():
        memory_bytes += object_bytes * data.count(sign)
    if memory_bytes > _MAX_PARSED_BYTES:
        raise InputError(
            f"{path}: {len(data)} bytes that would take about {memory_bytes / 1e6:.0f} MB of "
            f"memory, more than the {_MAX_PARSED_BYTES / 1e6:.0f} MB allowed; split it"
        )


def parse_yaml(path: AnyPath, text: str) -> object:
    """Parse YAML of plain values, with references (``*name``) within a bound.

    Raises:
        InputError: it is no such YAML, or would fill the memory.
    """
    refuse_yaml_bomb(path, text)
    with refused_as(path, "YAML file", "correct it there"):
        return yaml.load(text, YamlLoader)  # noqa: S506  a safe loader


def refuse_yaml_bomb(path: AnyPath, text: str) -> None:
    """Refuse YAML that is too deep, refers to itself, or becomes huge by references (``*name``).

    The values are counted as they would be with each reference written out.
    """
    sizes: dict[str, int] = {}  # values in the part of each anchor (``&name``)
    open_collections: list[tuple[str | None, int]] = []  # anchor, and values so far
    with suppress(yaml.YAMLError):  # raised again where the text is parsed
        for event in yaml.parse(text, YamlLoader):
            anchor = getattr(event, "anchor", None)
            size = 0  # number of values; 0 of an event that ends no value
            match event:
                case yaml.CollectionStartEvent():
                    open_collections.append((anchor, 1))
                    if len(open_collections) > _MAX_YAML_DEPTH:
                        raise InputError(
                            f"{path}: lists of lists, {_MAX_YAML_DEPTH} deep; correct it"
                        )
                    continue
                case yaml.CollectionEndEvent():
                    anchor, size = open_collections.pop()
                case yaml.AliasEvent():
                    if anchor not in sizes:
                        raise InputError(f"{path}: refers to itself (*{anchor}); write it out")
                    size = sizes[anchor]
                    anchor = None
                case yaml.ScalarEvent():
                    size = 1

            # The value counts in its anchor, and in the collection about it.
            if anchor is not None:
                sizes[anchor] = size
            if open_collections:
                outer_anchor, outer_size = open_collections[-1]
                open_collections[-1] = (outer_anchor, outer_size + size)
            if size > _MAX_YAML_VALUES:
                raise InputError(
                    f"{path}: its references (*name) make more than {_MAX_YAML_VALUES} values of "
                    "it; write them out"
                )


def write_json(path: AnyPath, value: object) -> None:
    """Write JSON with an indent of 2, keys in the order of ``value``, ending in a newline.

    Raises:
        InputError: something in it has no JSON form, such as NaN, or the disk refuses.
    """
    try:
        text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False)
        # A name that is not UTF-8 is kept as JSON's escapes of its bytes, which are read back.
        data = f"{text}\n".encode(errors="backslashreplace")
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: cannot be written as JSON: {error}; use null for NaN") from error
    write_bytes(path, data)


def read_key_values(path: AnyPath) -> dict[str, list[float]]:
    """Read ``KEY: numbers`` lines, as of KITTI's calibrations: the numbers by key.

    ``key=[a b; c d]``, as of Middlebury's, is read row by row. Lines with words, such as dates, are
    left out, and so are blank lines and what follows ``#``.

    Raises:
        InputError: the file is missing or not text, a line has no key or repeats one, a number is
            mistyped or not finite.
    """
    keys: set[str] = set()  # of all lines, those of words too
    numbers_of_key: dict[str, list[float]] = {}
    for number, line in enumerate(read_text(path, MAX_LIST_BYTES).splitlines(), start=1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        match = _KEY_VALUE.fullmatch(text)
        if match is None:
            raise InputError(f"{path}: line {number}, {text[:60]!r}, is not 'KEY: numbers'")
        key, content = match.groups()
        if key in keys:
            raise InputError(f"{path}: line {number} gives {key!r} again; keep one of them")
        keys.add(key)

        # Numbers alone, or a text such as a date or a name.
        numbers: list[float] = []
        others: list[str] = []
        words = content.translate(_BRACKETS_TO_BLANKS).split()
        for word in words:
            try:
                numbers.append(float(word))
            except ValueError:
                others.append(word)
        mistyped = [word for word in others if any(map(str.isdigit, word))]
        if numbers and mistyped and words[0] not in others:
            raise InputError(
                f"{path}: line {number}, {key!r}, has {mistyped[0][:60]!r} among its numbers; "
                "correct it, or put a # before the line"
            )
        if others:
            continue
        if not all(map(math.isfinite, numbers)):
            raise InputError(f"{path}: line {number}, {key!r}, holds NaN or infinity")
        if numbers:
            numbers_of_key[key] = numbers
    return numbers_of_key


def parse_finite(text: str) -> float:
    """Convert a number of JSON to float; ValueError for NaN and infinity, which JSON lacks."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a JSON number")
    return value


_MOST_SHOWN = 6  # most file names without a partner that an error lists
_NUMBER = re.compile(r"((?<![\d.])\d+\.\d+(?!\d|\.\d)|\d+)")
"""A decimal, unless a third number follows as in 1.2.10, or a whole number."""


def natural_sort_key(path: Path) -> tuple[list[list[str | tuple[int, str]]], Path]:
    """Make the key by which paths are sorted: by name, but numbers in names by value (2 before 10).

    Two runs of digits with a point between them are a decimal, as of a time in seconds: 0.45 comes
    before 0.5. Three are separate numbers (1.2.10).
    """
    names = (*path.parent.parts, path.stem)
    return [_split_numbers(name) for name in names], path


def _split_numbers(name: str) -> list[str | tuple[int, str]]:
    """Split a name into text and numbers in turn, beginning with text.

    A number is its whole part, and its decimals, which sort as text does.
    """
    pieces: list[str | tuple[int, str]] = []
    for index, piece in enumerate(_NUMBER.split(name)):
        is_number = index % 2 == 1
        if is_number:
            whole, _, decimals = piece.partition(".")
            pieces.append((int(whole), decimals))
        else:
            pieces.append(piece)
    return pieces


def refuse_equal_names(named_files: Iterable[tuple[str, str | Path]], remedy: str) -> None:
    """Refuse two inputs of one name: the results of one would overwrite those of the other.

    Args:
        named_files: the name and the file of each input.
        remedy: what the user can do, for the error.

    Raises:
        InputError: two have one name; both files are named.
    """
    file_of: dict[str, str | Path] = {}
    for name, file in named_files:
        if name in file_of:
            raise InputError(
                f"{file_of[name]} and {file} would both be {name!r} in the results; {remedy}"
            )
        file_of[name] = file


def refuse_equal_stems(files: Iterable[Path]) -> None:
    """Refuse two input files whose names differ in the suffix or the folder alone.

    Raises:
        InputError: as :func:`refuse_equal_names`.
    """
    remedy = "rename one, or give it in a run of its own"
    refuse_equal_names([(path.stem, path) for path in files], remedy)


def normalise_stem(path: Path) -> str:
    """Return a file's name without its suffix, normalised to one Unicode form (NFC).

    A letter with an accent may be stored as one character (NFC) or two (NFD: disks of macOS).
    """
    return unicodedata.normalize("NFC", path.stem)


def find_partners(first: Sequence[str], second: Sequence[str], sides: str) -> list[int]:
    """Pair the names of two sets of files, such as left and right images.

    Equal names are partners. If none are equal, those are partners that are equal without what all
    names of their set share (``left_0004`` and ``right_0004``, ``1_L`` and ``1_R``), numbers by
    value. Single names are partners unless both have numbers, and none in common.

    Args:
        first: names of the first set, without suffixes.
        second: names of the second set.
        sides: what errors call the two sets.

    Returns:
        For each name of the first set the index of its partner in the second.

    Raises:
        InputError: a name has no partner, or several.
    """
    first = [unicodedata.normalize("NFC", name) for name in first]
    second = [unicodedata.normalize("NFC", name) for name in second]
    first_keys: Sequence[Hashable] = first
    second_keys: Sequence[Hashable] = second
    if not set(first) & set(second):
        first_keys, second_keys = _make_pairing_keys(first, second)

    first_counts = Counter(first_keys)
    second_counts = Counter(second_keys)
    named_keys = [
        *zip(first, first_keys, strict=True),
        *zip(second, second_keys, strict=True),
    ]
    unpaired = [
        name for name, key in named_keys if first_counts[key] != 1 or second_counts[key] != 1
    ]
    if unpaired:
        shown = ", ".join(map(repr, unpaired[:_MOST_SHOWN]))
        if len(unpaired) > _MOST_SHOWN:
            shown += ", ..."
        raise InputError(
            f"{sides} hold {len(first)} and {len(second)} files, and no partner of the same name "
            f"or number is there for {shown}; remove these, add their partners, or rename them"
        )
    index_of_key = {key: index for index, key in enumerate(second_keys)}
    return [index_of_key[key] for key in first_keys]


def _make_pairing_keys(
    first: Sequence[str], second: Sequence[str]
) -> tuple[list[Hashable], list[Hashable]]:
    """Make keys of names that are equal if two names are partners (:func:`find_partners`).

    Returns:
        Keys of the first and of the second names.
    """
    # Text and numbers in turn, beginning with text: the numbers have odd indices.
    pieces = [[re.split(r"(\d+)", name) for name in side] for side in (first, second)]

    # Single names are partners unless both have numbers, and none in common.
    if len(first) == len(second) == 1:
        first_numbers, second_numbers = (
            {int(number) for number in side[0][1::2]} for side in pieces
        )
        has_other_number = first_numbers and second_numbers and not first_numbers & second_numbers
        return ([first[0]], [second[0]]) if has_other_number else ([""], [""])

    # Names of differing structure are compared as a whole.
    piece_counts = {len(split_name) for side in pieces for split_name in side}
    if len(piece_counts) > 1:
        pieces = [[[name] for name in side] for side in (first, second)]

    keys: list[list[tuple[str, ...]]] = [[() for _ in side] for side in pieces]
    for index in range(len(pieces[0][0])):
        columns = [[split_name[index] for split_name in side] for side in pieces]
        if all(len(set(column)) == 1 for column in columns):
            continue  # all names of a set share it
        for side, column in enumerate(columns):
            keys_of_pieces = map(_strip_leading_zeros, _remove_common_ends(column))
            keys[side] = [
                (*key, piece) for key, piece in zip(keys[side], keys_of_pieces, strict=True)
            ]
    return [*keys[0]], [*keys[1]]


def _remove_common_ends(texts: Sequence[str]) -> list[str]:
    """Remove the beginning and the ending that all texts share, but no part of a number."""
    without_prefix = _remove_common_prefix(texts)
    reversed_texts = _remove_common_prefix([text[::-1] for text in without_prefix])
    return [text[::-1] for text in reversed_texts]


def _remove_common_prefix(texts: Sequence[str]) -> list[str]:
    """Remove the beginning that all texts share, up to digits that it ends with."""
    # What the first and the last in alphabetical order share, all share.
    first = min(texts)
    last = max(texts)
    length = 0
    while length < len(first) and first[: length + 1] == last[: length + 1]:
        length += 1
    prefix = re.sub(r"\d+$", "", first[:length])
    return [text[len(prefix) :] for text in texts]


def _strip_leading_zeros(text: str) -> str:
    """Write the numbers in a text without leading zeros."""
    return re.sub(r"\d+", lambda match: str(int(match[0])), text)
