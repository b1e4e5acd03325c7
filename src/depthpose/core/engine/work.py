"""The inputs of a job, their division into blocks, and the shard of results of a block.

Inputs are found in folders, patterns, manifests and tar shards. The first run decides the blocks;
later ones only add to them. Shards are tar files in WebDataset's layout, written whole or not at
all.
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
from depthpose.core.files.disk import file_system, find_partners, refuse_equal_names, refused_write

PLAN = "plan.jsonl"
SHARDS = "shards"
_TARS = (".tar", ".tar.gz", ".tgz")


@dataclass(frozen=True, slots=True)
class Files:
    """The files that an input consists of, by their roles.

    A manifest has a column for each role. In a tar shard the file of a role is
    ``KEY.ROLE.SUFFIX``, or ``KEY.SUFFIX`` where there is only one role.
    """

    roles: tuple[str, ...]  #: a word for each file of an input, such as ``("left", "right")``
    suffixes: tuple[str, ...]  #: suffixes of the files, in lower case, with the dot


@dataclass(frozen=True, slots=True)
class Item:
    """A listed input: its files, and the name of its results."""

    name: str  #: name of its results: unique in a job, relative, without a suffix
    files: tuple[str, ...]  #: paths or URLs, in the order of the roles


def find_items(words: Sequence[str], files: Files) -> list[Item]:
    """List the inputs that files, folders, patterns or manifests name; tar shards are not read.

    Args:
        words: one file, folder or pattern for each role, paired by their names or the numbers in
            them; or, of a single role, any number of them; or manifests.
        files: what files an input consists of.

    Raises:
        InputError: nothing is found, roles cannot be paired, or two inputs have one name.
    """
    manifests = [word for word in words if word.lower().endswith(".csv")]
    paths = [word for word in words if word not in manifests]
    items = [item for word in manifests for item in _read_manifest(word, files.roles)]
    if paths and len(paths) != len(files.roles) > 1:
        raise InputError(
            f"{', '.join(paths)}: an input has {' and '.join(files.roles)}; give a path for each "
            "of them, or one manifest"
        )
    if len(files.roles) == 1:
        for path in paths:
            urls = stores.list_files(path, files.suffixes)
            items += [Item(PurePosixPath(url).stem, (url,)) for url in urls]
    else:
        items += _pair_roles(paths, files.suffixes)

    files_by_name = [(item.name, item.files[0]) for item in items]
    refuse_equal_names(files_by_name, "give a manifest with a column 'name'")
    return items


def _pair_roles(paths: Sequence[str], suffixes: Sequence[str]) -> Iterator[Item]:
    """List the files behind one path for each role, and pair them to inputs by their names.

    Two files that are named themselves are a pair whatever they are called.
    """
    urls_of_role = [stores.list_files(path, suffixes) for path in paths]
    stems_of_role = [[PurePosixPath(url).stem for url in urls] for urls in urls_of_role]
    for k, path in enumerate(paths[1:], 1):
        first_is_file = stems_of_role[0] == [PurePosixPath(paths[0]).stem]
        is_file = stems_of_role[k] == [PurePosixPath(path).stem]
        if not (first_is_file and is_file):
            partners = find_partners(stems_of_role[0], stems_of_role[k], f"{paths[0]} and {path}")
            urls_of_role[k] = [urls_of_role[k][partner] for partner in partners]
    for urls_of_input in zip(*urls_of_role, strict=True):
        yield Item(PurePosixPath(urls_of_input[0]).stem, urls_of_input)


def _read_manifest(url: str, roles: Sequence[str]) -> Iterator[Item]:
    """Read the inputs of a CSV table: a column for each role, with URLs or paths from its folder.

    A column ``name`` may name the results; else the name is that of the first file.
    """
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
        files: list[str] = []
        for role in roles:
            path = row[role]
            is_absolute = "://" in path or path.startswith("/")
            files.append(path if is_absolute else stores.absolute(stores.join(folder, path)))
        name = str(row.get("name") or PurePosixPath(files[0]).stem)
        _refuse_unsafe_name(name, f"{url}: row {number}")
        yield Item(name, tuple(files))


def _refuse_unsafe_name(name: str, source: str) -> None:
    """Refuse a name that would lead out of the folder of the results."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\0" in name or "\\" in name:
        raise InputError(
            f"{source}: the name {name!r} is no name of a result; write letters, digits and '/'"
        )


@dataclass(frozen=True, slots=True)
class Block:
    """Inputs whose results go into one shard: listed inputs, or those of a tar shard."""

    shard: str  # name of the shard of results, without its suffix
    items: tuple[Item, ...] = ()
    tar: str | None = None  # path or URL of a WebDataset shard that holds the inputs

    def to_json(self) -> str:
        """Encode the block as one line of JSON."""
        if self.tar is not None:
            return json.dumps({"shard": self.shard, "tar": self.tar})
        items = [[item.name, *item.files] for item in self.items]
        return json.dumps({"shard": self.shard, "items": items})

    @classmethod
    def from_json(cls, line: str) -> "Block":
        """Decode a line of :meth:`to_json`."""
        row = json.loads(line)
        items = tuple(Item(name, tuple(files)) for name, *files in row.get("items", ()))
        return cls(row["shard"], items, row.get("tar"))


def make_plan(out: str, items: Sequence[Item], tars: Sequence[str], size: int) -> list[Block]:
    """Divide inputs into blocks as an earlier run did; new inputs get new blocks.

    The plan is a file in ``out``, so that a shard means the same inputs in every run, whatever
    has been added to a folder since.

    Args:
        out: folder of the results, by path or URL.
        items: listed inputs.
        tars: tar shards of inputs; each becomes one block.
        size: listed inputs of a block.

    Raises:
        InputError: an input has the name of an earlier one, but other files.
    """
    blocks: list[Block] = []
    plan = stores.join(out, PLAN)
    lines = stores.read_from(plan).splitlines() if stores.exists(plan) else []
    # Of a damaged plan the blocks before the damage are taken.
    with suppress(ValueError, KeyError, TypeError, AttributeError):
        for line in lines:
            blocks.append(Block.from_json(line.decode()))  # noqa: PERF401

    planned_count = len(blocks)
    planned_tars = {block.tar for block in blocks}
    planned_files = {item.name: item.files for block in blocks for item in block.items}
    for item in items:
        files = planned_files.get(item.name, item.files)
        if files != item.files:
            raise InputError(
                f"{out}: {item.name!r} is the result of {files[0]}, not of "
                f"{item.files[0]}; two files of one name need two folders: choose another"
            )

    new_items = [item for item in items if item.name not in planned_files]
    for k in range(0, len(new_items), size):
        blocks.append(Block(f"{len(blocks):06d}", tuple(new_items[k : k + size])))
    for tar in tars:
        if tar not in planned_tars:
            blocks.append(Block(f"{len(blocks):06d}", tar=tar))
    if len(blocks) > planned_count:
        stores.publish("".join(f"{block.to_json()}\n" for block in blocks).encode(), plan)
    return blocks


def read_tar(url: str) -> Iterator[tuple[str, bytes]]:
    """Read name and content of each file of a tar, plain or compressed, in the order they stand.

    Raises:
        InputError: it is damaged, holds a link or a device, or two files of one name.
    """
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
    """An input whose files are local."""

    name: str  #: name of its results
    files: tuple[Path, ...] = ()  #: local paths, in the order of the roles
    reason: str = ""  #: why it has no files; such a sample is not passed to a ``Function``


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """The inputs of a command: listed ones and tar shards, and what files an input consists of."""

    items: Sequence[Item]
    tars: Sequence[str] = ()
    files: Files

    @classmethod
    def find(cls, words: Sequence[str], files: Files) -> "Inputs":
        """List the inputs that words name: tar shards, and inputs that :func:`find_items` finds.

        Raises:
            InputError: nothing is found, or as in :func:`find_items`.
        """
        tar_words = [word for word in words if word.lower().endswith(_TARS)]
        item_words = [word for word in words if word not in tar_words]
        items = find_items(item_words, files) if item_words else []
        tars: dict[str, None] = {}  # each once, in their order
        for word in tar_words:
            for url in stores.list_files(word, (".tar", ".tgz", ".gz")):
                if url.lower().endswith(_TARS):
                    tars[url] = None
        return cls(items=items, tars=list(tars), files=files)

    @contextmanager
    def first(self) -> Iterator[Sequence[Path]]:
        """Make the files of the first input local inside the block, for checks before the job.

        Raises:
            InputError: it cannot be read.
        """
        block = Block("", (self.items[0],)) if self.items else Block("", tar=self.tars[0])
        with tempfile.TemporaryDirectory(prefix="depthpose-") as scratch:
            sample = next(_read_samples(block, self.files, Path(scratch)))
            if sample.reason:
                raise InputError(sample.reason)
            yield sample.files


def _read_samples(block: Block, files: Files, scratch: Path) -> Iterator[Sample]:
    """Make the files of each input of a block local; copies go to ``scratch``.

    An input that cannot be read, and a tar that is damaged or empty, give a sample with a reason.
    """
    for item in block.items:
        try:
            copies = tuple(stores.local_copy(url, scratch) for url in item.files)
            sample = Sample(item.name, copies)
        except InputError as error:
            sample = Sample(item.name, reason=str(error))
        yield sample
    if block.tar is None:
        return
    is_empty = True
    try:
        for sample in _read_tar_samples(block.tar, files, scratch):
            is_empty = False
            yield sample
    except InputError as error:
        yield Sample(PurePosixPath(block.tar).name, reason=str(error))
    else:
        if is_empty:
            reason = f"{block.tar}: holds no file; pack inputs into it, or leave it out"
            yield Sample(PurePosixPath(block.tar).name, reason=reason)


def _read_tar_samples(tar: str, files: Files, scratch: Path) -> Iterator[Sample]:
    """Unpack the inputs of a tar shard to ``scratch``; files in a row with one key are an input.

    The key is the path up to the first point of the file's name.
    """
    members = ((PurePosixPath(name), data) for name, data in read_tar(tar))
    for key_path, members_of_key in groupby(
        members, lambda member: member[0].parent / member[0].name.partition(".")[0]
    ):
        key = str(key_path)
        unpacked: dict[str, Path] = {}
        for member, data in members_of_key:
            ending = member.name.partition(".")[2]
            role, _, suffix = ending.rpartition(".")
            if not role and len(files.roles) == 1:
                role = files.roles[0]
            # Other files, such as a caption, are no part of the input.
            if role in files.roles and f".{suffix}".lower() in files.suffixes:
                unpacked[role] = Path(tempfile.mkdtemp(dir=scratch)) / f"{role}.{suffix}"
                unpacked[role].write_bytes(data)

        missing = [role for role in files.roles if role not in unpacked]
        reason = ""
        if missing:
            roles = ", ".join(files.roles)
            reason = f"{tar}: {key!r} has no {missing[0]}; a sample holds {roles}"
        try:
            _refuse_unsafe_name(key, tar)
        except InputError as error:
            reason = str(error)
        if not reason:
            yield Sample(key, tuple(unpacked[role] for role in files.roles))
            continue
        for file in unpacked.values():
            shutil.rmtree(file.parent, ignore_errors=True)
        yield Sample(key, reason=reason)


Function = Callable[[Sequence[Sample], Path], Sequence[str]]
"""Writes the files ``NAME.ENDING`` of each sample into a folder; returns "" for each, or why it
failed."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """The work of a job; it is sent to every worker, which starts it once."""

    start: Callable[[], Function]  #: loads what all samples need, such as a network
    files: Files  #: what files an input consists of
    endings: Sequence[str]  #: endings of the files of a result
    batch: int = 1  #: samples that the function gets at once


@dataclass(frozen=True, kw_only=True)
class ShardRecord:
    """The record of a processed block: its shard of results, and why some inputs have none."""

    shard: str  #: name of the shard, with its suffix
    entries: tuple[tuple[str, str], ...]  #: name of each input, and "" or why it failed
    endings: tuple[str, ...]  #: endings of the files of a result
    stamp: tuple[int, ...]  #: size [bytes], time of the last change [ns] and CRC-32 of the shard
    block: int  #: CRC-32 of the block, as JSON

    @property
    def failures(self) -> list[tuple[str, str]]:
        """List the entries of the inputs without a result."""
        return [(name, reason) for name, reason in self.entries if reason]

    def to_json(self) -> str:
        """Encode the record as one line of JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str | bytes) -> "ShardRecord":
        """Decode the text of :meth:`to_json`."""
        row = json.loads(text)
        row["entries"] = tuple((name, reason) for name, reason in row["entries"])
        row["endings"] = tuple(row["endings"])
        row["stamp"] = tuple(row["stamp"])
        return cls(**row)


_CHUNK_BYTES = 2**22  # bytes of a file that are read at a time for its checksum


def file_stamp(path: Path) -> tuple[int, int, int]:
    """Compute size [bytes], time of the last change [ns] and CRC-32 of a file."""
    status = path.stat()
    checksum = 0
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            checksum = zlib.crc32(chunk, checksum)
    return status.st_size, status.st_mtime_ns, checksum


def is_unchanged(path: Path, stamp: Sequence[int]) -> bool:
    """Whether a file is as its stamp says; its content is read only if its time differs."""
    try:
        status = path.stat()
        if not path.is_file() or status.st_size != stamp[0]:
            return False
        return status.st_mtime_ns == stamp[1] or file_stamp(path)[2] == stamp[2]
    except (OSError, IndexError):
        return False


@dataclass(eq=False)
class Runner:
    """Processes blocks one after the other; the work is started with the first."""

    work: Work
    out: str  #: folder of the results, by path or URL
    function: Function | None = None  #: function of the work, once it has started

    def run(self, block: Block) -> ShardRecord:
        """Process a block to its shard and record, unless both exist and no input failed.

        The record ``SHARD.json`` is written after the shard: where it exists, the shard is whole.
        """
        record = stores.join(self.out, SHARDS, f"{block.shard}.json")
        if stores.exists(record):
            earlier = ShardRecord.from_json(stores.read_from(record))
            if not earlier.failures:
                return earlier
        temporary = tempfile.TemporaryDirectory(prefix="depthpose-")
        with refused_write(temporary.name), temporary as scratch:
            file = Path(scratch) / f"{block.shard}.tar"
            entries = tuple(self._write_shard(block, file, Path(scratch)))
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

    def _write_shard(self, block: Block, file: Path, scratch: Path) -> Iterator[tuple[str, str]]:
        """Write the results of a block to a tar; yield each name, and "" or why it failed."""
        self.function = self.function or self.work.start()
        samples = _read_samples(block, self.work.files, scratch)
        results = scratch / "results"
        results.mkdir()
        with tarfile.open(file, "w", format=tarfile.PAX_FORMAT) as tar:
            while batch := list(islice(samples, self.work.batch)):
                readable = [sample for sample in batch if not sample.reason]
                reasons = iter(self.function(readable, results))
                for sample in batch:
                    reason = sample.reason or next(reasons)
                    copies = [path for path in sample.files if scratch in path.parents]
                    for path in copies:  # the path of a temporary copy tells the user nothing
                        reason = reason.replace(str(path), path.name)
                    self._move_result(results, sample.name, None if reason else tar)
                    yield sample.name, reason
                    for path in copies:  # each is alone in its folder
                        shutil.rmtree(path.parent, ignore_errors=True)

    def _move_result(self, folder: Path, name: str, tar: tarfile.TarFile | None) -> None:
        """Move the files of a result from a folder into a tar; without a tar they are deleted."""
        for ending in sorted(self.work.endings):
            path = folder / f"{name}.{ending}"
            if not path.is_file():
                continue
            if tar is not None:
                data = path.read_bytes()
                # Without time and owner, so that equal results make equal shards.
                member = tarfile.TarInfo(f"{name}.{ending}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))
            path.unlink()
