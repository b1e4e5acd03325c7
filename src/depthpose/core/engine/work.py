"""The inputs of a job, their blocks, and one block to one shard of results, whole or not at all.

Inputs are found in folders, patterns, manifests and tar shards; blocks are fixed by the first run.
Shards are tar files in WebDataset's layout.
"""

import csv
import io
import json
import shutil
import tarfile
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from itertools import groupby, islice
from pathlib import Path, PurePosixPath

from depthpose.core.errors import InputError
from depthpose.core.files import stores
from depthpose.core.files.disk import file_system, find_partners, refused_write

PLAN = "plan.jsonl"
SHARDS = "shards"
_TARS = (".tar", ".tar.gz", ".tgz")


@dataclass(frozen=True, slots=True)
class Files:
    """What an input is made of.

    Its roles are the columns of a manifest; a member of a tar shard is ``KEY.ROLE.SUFFIX``, of a
    single role ``KEY.SUFFIX`` does.
    """

    roles: tuple[str, ...]  #: a word for each of its files, such as ``("left", "right")``
    suffixes: tuple[str, ...]  #: that the files may have, in lower case, with the dot


@dataclass(frozen=True, slots=True)
class Item:
    """One input."""

    name: str  #: that of its results: unique in a job, relative, without a suffix
    files: tuple[str, ...]  #: paths or URLs, in the order of the roles of the work


def find_items(words: Sequence[str], files: Files) -> list[Item]:
    """Find inputs that are no tar shards.

    Args:
        words: one file, folder or pattern for each role, paired by their names or the numbers in
            them; or of a single role any number of them; or manifests.
        files: what an input is made of.

    Raises:
        InputError: nothing is there, sides that cannot be paired, or two inputs of one name.
    """
    manifests = [word for word in words if word.lower().endswith(".csv")]
    others = [word for word in words if word not in manifests]
    items = [item for word in manifests for item in _read_manifest(word, files.roles)]
    if others and len(others) != len(files.roles) > 1:
        raise InputError(
            f"{', '.join(others)}: an input has {' and '.join(files.roles)}; give a path for each "
            "of them, or one manifest"
        )
    sides = [stores.list_files(word, files.suffixes) for word in others]
    if len(files.roles) == 1:
        items += [Item(PurePosixPath(url).stem, (url,)) for side in sides for url in side]
    else:
        names = [[PurePosixPath(url).stem for url in side] for side in sides]
        for k, word in enumerate(others[1:], 1):
            # Else two files were named.
            first_stem = PurePosixPath(others[0]).stem
            other = PurePosixPath(word).stem
            if (names[0], names[k]) != ([first_stem], [other]):
                partners = find_partners(names[0], names[k], f"{others[0]} and {word}")
                sides[k] = [sides[k][partner] for partner in partners]
        items += [
            Item(PurePosixPath(files_of_input[0]).stem, files_of_input)
            for files_of_input in zip(*sides, strict=True)
        ]
    first: dict[str, Item] = {}
    for item in items:
        other = first.setdefault(item.name, item)
        if other is not item:
            raise InputError(
                f"{other.files[0]} and {item.files[0]} would both be {item.name!r} in the "
                "results; give a manifest with a column 'name'"
            )
    return items


def _read_manifest(url: str, roles: Sequence[str]) -> Iterator[Item]:
    """Read the inputs of a CSV table: a column for each role, paths beside it or URLs."""
    try:
        text = io.StringIO(stores.read_from(url).decode("utf-8-sig"), newline="")
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
        files = tuple(
            path
            if "://" in path or path.startswith("/")
            else stores.absolute(stores.join(folder, path))
            for path in (row[role] for role in roles)
        )
        name = str(row.get("name") or PurePosixPath(files[0]).stem)
        _refuse_name(name, f"{url}: row {number}")
        yield Item(name, files)


def _refuse_name(name: str, source: str) -> None:
    """Refuse a name that would lead out of the folder of the results."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\0" in name or "\\" in name:
        raise InputError(
            f"{source}: the name {name!r} is no name of a result; write letters, digits and '/'"
        )


@dataclass(frozen=True, slots=True)
class Block:
    """Inputs whose results go into one shard: listed inputs, or those of a tar shard."""

    shard: str
    items: tuple[Item, ...] = ()
    tar: str | None = None  # path or URL of a WebDataset shard that holds the inputs

    def to_json(self) -> str:
        """Write it as a line."""
        row = {"shard": self.shard, "items": [[i.name, *i.files] for i in self.items]}
        return json.dumps(row if self.tar is None else {"shard": self.shard, "tar": self.tar})

    @classmethod
    def from_json(cls, line: str) -> "Block":
        """Read what :meth:`to_json` wrote."""
        row = json.loads(line)
        items = tuple(Item(name, tuple(files)) for name, *files in row.get("items", ()))
        return cls(row["shard"], items, row.get("tar"))


def make_plan(out: str, items: Sequence[Item], tars: Sequence[str], size: int) -> list[Block]:
    """Divide inputs into blocks as an earlier run did; new inputs get new blocks.

    The plan is a file in ``out``, so that a shard means the same inputs in every run, whatever
    has been added to a folder since.
    """
    blocks: list[Block] = []
    plan = stores.join(out, PLAN)
    with suppress(ValueError, KeyError, TypeError, AttributeError):  # what is damaged, and follows
        for line in stores.read_from(plan).splitlines() if stores.exists(plan) else ():
            blocks.append(Block.from_json(line.decode()))  # noqa: PERF401  those before the damage
    files = {item.name: item.files for block in blocks for item in block.items}
    for item in items:
        if files.get(item.name, item.files) != item.files:
            raise InputError(
                f"{out}: {item.name!r} is the result of {files[item.name][0]}, not of "
                f"{item.files[0]}; two files of one name need two folders: choose another"
            )
    count_before = len(blocks)
    planned_tars = {block.tar for block in blocks}
    new = [item for item in items if item.name not in files]
    for k in range(0, len(new), size):
        blocks.append(Block(f"{len(blocks):06d}", tuple(new[k : k + size])))
    for tar in tars:
        if tar not in planned_tars:
            blocks.append(Block(f"{len(blocks):06d}", tar=tar))
    if len(blocks) > count_before:
        stores.publish("".join(f"{b.to_json()}\n" for b in blocks).encode(), plan)
    return blocks


def read_tar(url: str) -> Iterator[tuple[str, bytes]]:
    """Read the files of a tar shard, plain or compressed, from its beginning to its end."""
    names: set[str] = set()
    try:
        with file_system(url, "read") as (fs, inner):
            file = fs.open(inner, "rb")
        with file, tarfile.open(fileobj=file, mode="r|*") as tar:
            for member in tar:
                if not (member.isfile() or member.isdir()):
                    raise InputError(
                        f"{url}: {member.name!r} is a link or device, and no file; pack the files "
                        "themselves (tar --dereference --hard-dereference)"
                    )
                if member.isfile() and member.name in names:
                    raise InputError(
                        f"{url}: holds {member.name!r} twice; keep one of the two, and pack it anew"
                    )
                names.add(member.name)
                content = tar.extractfile(member) if member.isfile() else None
                if content is not None:
                    yield member.name, content.read()
    except (tarfile.TarError, EOFError, OSError) as error:
        raise InputError(f"{url}: not an intact tar file ({error}); make it anew") from error


@dataclass(frozen=True, slots=True)
class Sample:
    """One input, its files at hand."""

    name: str  #: that of its results
    files: tuple[Path, ...] = ()  #: local paths, in the order of the roles
    reason: str = ""  #: why there are none; a ``Function`` is given no such sample


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """The inputs of a command: listed ones and tar shards of them, and the files of each input."""

    items: Sequence[Item]
    tars: Sequence[str] = ()
    files: Files

    @classmethod
    def find(cls, words: Sequence[str], files: Files) -> "Inputs":
        """List files, manifests and tar shards, these by name or by a pattern."""
        tars = [word for word in words if word.lower().endswith(_TARS)]
        others = [word for word in words if word not in tars]
        items = find_items(others, files) if others else []
        listed = (url for word in tars for url in stores.list_files(word, (".tar", ".tgz", ".gz")))
        shards = dict.fromkeys(url for url in listed if url.lower().endswith(_TARS))
        return cls(items=items, tars=list(shards), files=files)

    @contextmanager
    def first(self) -> Iterator[Sequence[Path]]:
        """Give the files of the first input, to look at before any work.

        Raises:
            InputError: it cannot be read.
        """
        block = Block("", tuple(self.items[:1]), None if self.items else self.tars[0])
        with tempfile.TemporaryDirectory(prefix="depthpose-") as scratch:
            sample = next(_read_samples(block, self.files, Path(scratch)))
            if sample.reason:
                raise InputError(sample.reason)
            yield sample.files


def _read_samples(block: Block, wanted: Files, scratch: Path) -> Iterator[Sample]:
    """Make the files of a block's inputs local: of listed inputs, or of those in a tar shard."""
    for item in block.items:
        try:
            sample = Sample(item.name, tuple(stores.local_copy(url, scratch) for url in item.files))
        except InputError as error:
            sample = Sample(item.name, reason=str(error))
        yield sample
    if block.tar is None:
        return
    is_empty = True
    try:
        for sample in _read_tar_samples(block.tar, wanted, scratch):
            is_empty = False
            yield sample
    except InputError as error:
        yield Sample(PurePosixPath(block.tar).name, reason=str(error))
    else:
        if is_empty:
            reason = f"{block.tar}: holds no file; pack inputs into it, or leave it out"
            yield Sample(PurePosixPath(block.tar).name, reason=reason)


def _read_tar_samples(tar: str, wanted: Files, scratch: Path) -> Iterator[Sample]:
    """Unpack the inputs of a tar shard; neighbours with one key are an input."""
    is_single = len(wanted.roles) == 1
    members = ((PurePosixPath(name), data) for name, data in read_tar(tar))
    for place, members_of_key in groupby(
        members, lambda member: member[0].parent / member[0].name.partition(".")[0]
    ):
        # Files that have no part in the work, such as a caption, stay in the shard.
        key = str(place)
        files: dict[str, Path] = {}
        for member, data in members_of_key:
            ending = member.name.partition(".")[2]
            role, _, suffix = ending.rpartition(".")
            role = role or (wanted.roles[0] if is_single else "")
            if role in wanted.roles and f".{suffix}".lower() in wanted.suffixes:
                files[role] = Path(tempfile.mkdtemp(dir=scratch)) / f"{role}.{suffix}"
                files[role].write_bytes(data)

        # An input that lacks a file, or has a name of no result, keeps none.
        missing = [role for role in wanted.roles if role not in files]
        reason = ""
        if missing:
            reason = f"{tar}: {key!r} has no {missing[0]}; a sample holds "
            reason += ", ".join(wanted.roles)
        try:
            _refuse_name(key, tar)
        except InputError as error:
            reason = str(error)
        if not reason:
            yield Sample(key, tuple(files[role] for role in wanted.roles))
            continue
        for file in files.values():
            shutil.rmtree(file.parent, ignore_errors=True)
        yield Sample(key, reason=reason)


Function = Callable[[Sequence[Sample], Path], Sequence[str]]
"""Writes ``NAME.ENDING`` for each sample into a folder; gives for each "" or why it failed."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """What a job does; it is sent to every worker, which starts it once."""

    start: Callable[[], Function]  #: loads what all samples need, such as a network
    files: Files  #: what an input is made of
    endings: Sequence[str]  #: of the files of a result
    batch: int = 1  #: samples that are handed over at once


@dataclass(frozen=True, kw_only=True)
class ShardRecord:
    """What became of a block: the shard of its results, and why some inputs have none."""

    shard: str  #: name of the shard, with its suffix
    entries: tuple[tuple[str, str], ...]  #: name and "" or the reason of its failure, of each input
    endings: tuple[str, ...]  #: that the files of a result may have
    stamp: tuple[int, ...]  #: size, time and checksum of the shard
    block: int  #: checksum of the inputs

    @property
    def failures(self) -> list[tuple[str, str]]:
        """Inputs without a result."""
        return [entry for entry in self.entries if entry[1]]

    def to_json(self) -> str:
        """Write it as one line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str | bytes) -> "ShardRecord":
        """Read what :meth:`to_json` wrote."""
        row = json.loads(text)
        row["entries"] = tuple((name, reason) for name, reason in row["entries"])
        return cls(**row | {key: tuple(row[key]) for key in ("endings", "stamp")})


def file_stamp(path: Path) -> tuple[int, int, int]:
    """Give size [bytes], time of the last change [ns] and CRC-32 of a file."""
    status = path.stat()
    checksum = 0
    with path.open("rb") as file:
        while chunk := file.read(2**22):
            checksum = zlib.crc32(chunk, checksum)
    return status.st_size, status.st_mtime_ns, checksum


def is_unchanged(path: Path, stamp: Sequence[int]) -> bool:
    """Whether a file still has this stamp; it is read only if its time differs."""
    try:
        status = path.stat()
        if not path.is_file() or status.st_size != stamp[0]:
            return False
        return status.st_mtime_ns == stamp[1] or file_stamp(path)[2] == stamp[2]
    except (OSError, IndexError):
        return False


@dataclass(eq=False)
class Runner:
    """Does blocks one after the other; the work is started at the first."""

    work: Work
    out: str
    function: Function | None = None  #: what the work has started

    def run(self, block: Block) -> ShardRecord:
        """Do a block, unless a shard of it without failures is there.

        The record ``SHARD.json`` is written after the shard: where it is, the shard is whole.
        """
        record = stores.join(self.out, SHARDS, f"{block.shard}.json")
        if stores.exists(record):
            earlier = ShardRecord.from_json(stores.read_from(record))
            if not earlier.failures:
                return earlier
        temporary = tempfile.TemporaryDirectory(prefix="depthpose-")
        with refused_write(temporary.name), temporary as scratch:
            file = Path(scratch) / f"{block.shard}.tar"
            entries = tuple(self._write(block, file, Path(scratch)))
            url = stores.join(self.out, SHARDS, file.name)
            stores.publish(file, url)
            stamp = file_stamp(stores.local_path(url) or file)
        done = ShardRecord(
            shard=file.name,
            entries=entries,
            endings=tuple(self.work.endings),
            stamp=stamp,
            block=zlib.crc32(block.to_json().encode()),
        )
        stores.publish(done.to_json().encode(), record)
        return done

    def _write(self, block: Block, file: Path, scratch: Path) -> Iterator[tuple[str, str]]:
        """Write the results of a block, and give each name with "" or the reason of a failure."""
        self.function = self.function or self.work.start()
        samples = _read_samples(block, self.work.files, scratch)
        results = scratch / "results"
        results.mkdir()
        with tarfile.open(file, "w", format=tarfile.PAX_FORMAT) as tar:
            while batch := list(islice(samples, self.work.batch)):
                readable = [sample for sample in batch if not sample.reason]
                reasons = iter(self.function(readable, results))
                for sample in batch:
                    copies = [path for path in sample.files if scratch in path.parents]
                    reason = sample.reason or next(reasons)
                    for path in copies:  # of a copy the name alone says something
                        reason = reason.replace(str(path), path.name)
                    self._pack(tar, results, sample.name, is_kept=not reason)
                    yield sample.name, reason
                    for path in copies:  # each is alone in its folder
                        shutil.rmtree(path.parent, ignore_errors=True)

    def _pack(self, tar: tarfile.TarFile, results: Path, name: str, *, is_kept: bool) -> None:
        """Move the files of a result into the tar; delete those of a failed one."""
        for ending in sorted(self.work.endings):
            path = results / f"{name}.{ending}"
            if not path.is_file():
                continue
            if is_kept:
                data = path.read_bytes()
                member = tarfile.TarInfo(f"{name}.{ending}")
                member.size = len(data)  # neither time nor owner: equal bytes
                tar.addfile(member, io.BytesIO(data))
            path.unlink()
