"""The inputs of a job, and their blocks, each of which becomes one shard of results.

Inputs are found in folders, patterns, manifests and tar shards; blocks are fixed by the first run.
"""

import csv
import io
import json
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import PurePosixPath
from typing import Any

from depthpose.core.errors import InputError, import_extra
from depthpose.core.files.disk import find_partners
from depthpose.core.files.store import (
    absolute,
    exists,
    is_url,
    join,
    list_files,
    publish_bytes,
    read_from,
)

TARS = (".tar", ".tgz", ".gz")
MANIFESTS = (".parquet", ".csv")


@dataclass(frozen=True, slots=True)
class Files:
    """What an input is made of.

    Attributes:
        roles: a word for each of its files, such as ``("left", "right")``. They are the columns of
            a manifest; a member of a tar shard is ``KEY.ROLE.SUFFIX``, of a single role
            ``KEY.SUFFIX`` does.
        suffixes: that the files may have, in lower case, with the dot.
    """

    roles: tuple[str, ...]
    suffixes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Item:
    """One input.

    Attributes:
        name: that of its results: unique in a job, relative, without a suffix.
        files: paths or URLs, in the order of the roles of the work.
    """

    name: str
    files: tuple[str, ...]


def find_items(words: Sequence[str], files: Files) -> list[Item]:
    """Find inputs that are no tar shards.

    Args:
        words: one file, folder or pattern for each role, paired by their names or the numbers in
            them; or of a single role any number of them; or manifests.
        files: what an input is made of.

    Raises:
        InputError: nothing is there, sides that cannot be paired, or two inputs of one name.
    """
    manifests = [word for word in words if is_manifest(word)]
    others = [word for word in words if not is_manifest(word)]
    items = [item for word in manifests for item in _read_manifest(word, files.roles)]
    if others and len(files.roles) > 1:
        items += _pair(others, files)
    else:
        listed = [url for word in others for url in list_files(word, files.suffixes)]
        items += [Item(stem(url), (url,)) for url in listed]
    first: dict[str, Item] = {}
    for item in items:
        other = first.setdefault(item.name, item)
        if other is not item:
            raise InputError(
                f"{other.files[0]} and {item.files[0]} would both be {item.name!r} in the "
                "results; give a manifest with a column 'name'"
            )
    return items


def find_tars(words: Iterable[str]) -> list[str]:
    """List tar shards: files themselves, or those of a pattern."""
    tars = [url for word in words for url in list_files(word, TARS) if is_tar(url)]
    return list(dict.fromkeys(tars))


def is_tar(word: str) -> bool:
    """Whether a word names tar shards."""
    return word.lower().endswith((".tar", ".tar.gz", ".tgz"))


def is_manifest(word: str) -> bool:
    """Whether a word names a list of inputs."""
    return word.lower().endswith(MANIFESTS)


def stem(url: str) -> str:
    """Name the result of a file: its name without the suffix."""
    return PurePosixPath(url).stem


def refuse_name(name: str, source: str) -> None:
    """Refuse a name that would lead out of the folder of the results."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\0" in name or "\\" in name:
        raise InputError(
            f"{source}: the name {name!r} is no name of a result; write letters, digits and '/'"
        )


def import_pyarrow(purpose: str) -> Any:  # noqa: ANN401  pyarrow carries no types
    """Import Parquet's reader and writer, which the extra ``ray`` brings."""
    import_extra("pyarrow.parquet", "pyarrow", "ray", purpose)
    return import_module("pyarrow")


def _pair(words: Sequence[str], files: Files) -> list[Item]:
    if len(words) != len(files.roles):
        raise InputError(
            f"{', '.join(words)}: an input has {' and '.join(files.roles)}; give a path for each "
            "of them, or one manifest"
        )
    sides = [list_files(word, files.suffixes) for word in words]
    names = [[stem(url) for url in side] for side in sides]
    for k, word in enumerate(words[1:], 1):
        if [stem(words[0])] != names[0] or [stem(word)] != names[k]:  # else two files were named
            partners = find_partners(names[0], names[k], f"{words[0]} and {word}")
            sides[k] = [sides[k][partner] for partner in partners]
    return [Item(stem(some[0]), some) for some in zip(*sides, strict=True)]


def _read_manifest(url: str, roles: Sequence[str]) -> Iterator[Item]:
    if url.lower().endswith(".parquet"):
        rows: Iterable[Mapping[str, Any]] = parquet_rows(url, "a Parquet manifest")
    else:
        try:
            text = io.StringIO(read_from(url).decode("utf-8-sig"), newline="")
            rows = list(csv.DictReader(text, strict=True))
        except (UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"{url}: not a CSV table in UTF-8 ({error}); save it so") from error
    folder = url.rpartition("/")[0] or "."
    for number, row in enumerate(rows, 1):
        missing = [role for role in roles if not isinstance(row.get(role), str) or not row[role]]
        if missing:
            raise InputError(
                f"{url}: row {number} has no {missing[0]!r}; the columns are "
                f"{', '.join(roles)} (paths or URLs) and, if you like, name"
            )
        paths = [row[role] for role in roles]
        is_full = [is_url(path) or path.startswith("/") for path in paths]
        files = tuple(
            path if full else absolute(join(folder, path))
            for path, full in zip(paths, is_full, strict=True)
        )
        name = row.get("name") or stem(files[0])
        refuse_name(str(name), f"{url}: row {number}")
        yield Item(str(name), files)


def parquet_rows(url: str, purpose: str) -> Iterator[dict[str, Any]]:
    """Read the rows of a Parquet file one by one, few at a time."""
    arrow = import_pyarrow(purpose)
    try:
        file = arrow.parquet.ParquetFile(io.BytesIO(read_from(url)))
        for batch in file.iter_batches(batch_size=8):
            yield from batch.to_pylist()
    except (arrow.ArrowException, OSError) as error:
        raise InputError(f"{url}: not a Parquet file ({error}); write it anew") from error


PLAN = "plan.jsonl"


@dataclass(frozen=True, slots=True)
class Block:
    """Inputs whose results are one shard: listed ones, or those of a tar shard.

    Attributes:
        shard: name of the shard, without a suffix.
        items: the inputs; none where ``tar`` holds them.
        tar: path or URL of a WebDataset shard.
    """

    shard: str
    items: tuple[Item, ...] = ()
    tar: str | None = None

    def to_json(self) -> str:
        """Write it as a line."""
        row = {"shard": self.shard, "items": [[i.name, *i.files] for i in self.items]}
        return json.dumps(row if self.tar is None else {"shard": self.shard, "tar": self.tar})

    @property
    def checksum(self) -> int:
        """CRC-32 of what it is made of."""
        return zlib.crc32(self.to_json().encode())

    @classmethod
    def from_json(cls, line: str) -> "Block":
        """Read what :meth:`to_json` wrote."""
        row = json.loads(line)
        items = tuple(Item(name, tuple(files)) for name, *files in row.get("items", ()))
        return cls(row["shard"], items, row.get("tar"))


def make_plan(out: str, items: Sequence[Item], tars: Sequence[str], size: int) -> list[Block]:
    """Divide inputs into blocks as an earlier run did; what is new gets blocks of its own.

    The plan is a file in ``out``, so that a shard means the same inputs in every run, whatever
    has been added to a folder since.
    """
    known: list[Block] = []
    plan = join(out, PLAN)
    with suppress(ValueError, KeyError, TypeError, AttributeError):  # what is damaged, and follows
        for line in read_from(plan).splitlines() if exists(plan) else ():
            known.append(Block.from_json(line.decode()))  # noqa: PERF401  those before the damage
    files = {item.name: item.files for block in known for item in block.items}
    for item in items:
        if files.get(item.name, item.files) != item.files:
            raise InputError(
                f"{out}: {item.name!r} is the result of {files[item.name][0]}, not of "
                f"{item.files[0]}; two files of one name need two folders: choose another"
            )
    new = [item for item in items if item.name not in files]
    there = {block.tar for block in known}
    lots: list[tuple[tuple[Item, ...], str | None]] = [
        (tuple(new[k : k + size]), None) for k in range(0, len(new), size)
    ]
    lots += [((), tar) for tar in tars if tar not in there]
    blocks = known + [
        Block(f"{len(known) + k:06d}", some, tar) for k, (some, tar) in enumerate(lots)
    ]
    if lots:
        lines = "".join(f"{block.to_json()}\n" for block in blocks)
        publish_bytes(lines.encode(), plan)
    return blocks
