"""One block of inputs to one shard of results, whole or not at all.

Shards are tar files in WebDataset's layout, or Parquet.
"""

import io
import json
import shutil
import tarfile
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any, Literal, Protocol, runtime_checkable

from depthpose.core.engine.plan import Block, Files, Item, import_pyarrow, parquet_rows, refuse_name
from depthpose.core.errors import InputError
from depthpose.core.files.disk import refused_write
from depthpose.core.files.store import (
    exists,
    join,
    local_copy,
    local_path,
    opened,
    publish,
    publish_bytes,
    read_from,
)
from depthpose.core.results import file_stamp

ShardFormat = Literal["tar", "parquet"]


AddResult = Callable[[str, Mapping[str, bytes], str], None]
"""Adds a result to a shard: its name, contents by their endings, or why there are none."""
_GROUP_BYTES = 64 * 2**20
"""Size from which on the rows so far are written as one row group of Parquet."""


@contextmanager
def shard_writer(path: Path, form: ShardFormat, endings: Sequence[str]) -> Iterator[AddResult]:
    """Write a tar of ``NAME.ENDING``, or Parquet of a row a name; equal results, equal bytes."""
    if form == "tar":
        with tarfile.open(path, "w", format=tarfile.PAX_FORMAT) as tar:

            def add_members(name: str, files: Mapping[str, bytes], _: str) -> None:
                for ending, data in sorted(files.items()):
                    member = tarfile.TarInfo(f"{name}.{ending}")
                    member.size = len(data)
                    tar.addfile(member, io.BytesIO(data))

            yield add_members
        return
    arrow = import_pyarrow("results in Parquet")
    fields = [("name", arrow.string()), ("reason", arrow.string())]
    schema = arrow.schema([*fields, *((ending, arrow.binary()) for ending in endings)])
    rows: list[dict[str, Any]] = []
    held_bytes = 0
    # Maps hardly shrink, and pictures are compressed already.
    with arrow.parquet.ParquetWriter(path, schema, compression="zstd") as writer:

        def flush() -> None:
            if rows:
                writer.write_table(arrow.Table.from_pylist(rows, schema))
            rows.clear()

        def add_row(name: str, files: Mapping[str, bytes], reason: str) -> None:
            nonlocal held_bytes
            rows.append({"name": name, "reason": reason, **files})
            held_bytes += sum(map(len, files.values()))
            if held_bytes > _GROUP_BYTES:
                flush()
                held_bytes = 0

        yield add_row
        flush()


def read_shard(
    url: str, names: Collection[str], endings: Collection[str]
) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Read the results of a shard one by one.

    Args:
        url: of the shard.
        names: of the results in it, which a tar does not separate from the endings.
        endings: that their files may have.

    Raises:
        InputError: the shard is not there, or is damaged.
    """
    if url.endswith(".parquet"):
        for row in parquet_rows(url, "results in Parquet"):
            if "name" not in row:
                raise InputError(f"{url}: not a Parquet shard (no 'name'); make it anew")
            contents = {end: row[end] for end in endings if row.get(end) is not None}
            if contents:
                yield row["name"], contents
        return
    files: dict[str, bytes] = {}
    last = ""
    for member, data in read_tar(url):
        dots = [k for k, letter in enumerate(member) if letter == "."]
        fits = (member[:k] for k in dots if member[:k] in names and member[k + 1 :] in endings)
        name = next(fits, None)
        if name is None:
            raise InputError(
                f"{url}: holds {member!r}, which its record does not name; make it anew"
            )
        if name != last and files:
            yield last, files
            files = {}
        last, files[member[len(name) + 1 :]] = name, data
    if files:
        yield last, files


def read_tar(url: str) -> Iterator[tuple[str, bytes]]:
    """Read the files of a tar shard, plain or compressed, from its beginning to its end."""
    seen: set[str] = set()
    try:
        with opened(url) as file, tarfile.open(fileobj=file, mode="r|*") as tar:
            for member in tar:
                if not (member.isfile() or member.isdir()):
                    raise InputError(
                        f"{url}: {member.name!r} is a link or device, and no file; pack the files "
                        "themselves (tar --dereference --hard-dereference)"
                    )
                if member.isfile() and member.name in seen:
                    raise InputError(
                        f"{url}: holds {member.name!r} twice; keep one of the two, and pack it anew"
                    )
                seen.add(member.name)
                content = tar.extractfile(member) if member.isfile() else None
                if content is not None:
                    yield member.name, content.read()
    except (tarfile.TarError, EOFError, OSError) as error:
        raise InputError(f"{url}: not an intact tar file ({error}); make it anew") from error


SHARDS = "shards"


@dataclass(frozen=True, slots=True)
class Sample:
    """One input, its files at hand.

    Attributes:
        name: that of its results.
        files: local paths, in the order of the roles.
    """

    name: str
    files: tuple[Path, ...]


Function = Callable[[Sequence[Sample], Path], Sequence[str]]
"""Writes ``NAME.ENDING`` for each sample into a folder; gives for each "" or why it failed."""


@runtime_checkable
class Work(Protocol):
    """What a job does; it is sent to every worker, which starts it once."""

    @property
    def files(self) -> Files:
        """What an input is made of."""
        ...

    @property
    def endings(self) -> Sequence[str]:
        """Endings of the files of a result."""
        ...

    @property
    def batch(self) -> int:
        """Samples that are handed over at once."""
        ...

    def start(self) -> Function:
        """Load what all samples need, such as a network."""
        ...


@dataclass(frozen=True, kw_only=True)
class Done:
    """What became of a block.

    Attributes:
        shard: name of the shard, with its suffix.
        entries: name and "" or the reason of its failure, for each input.
        endings: that the files of a result may have.
        stamp: size, time and checksum of the shard (``file_stamp`` of core.results).
        block: checksum of the inputs.
    """

    shard: str
    entries: tuple[tuple[str, str], ...]
    endings: tuple[str, ...]
    stamp: tuple[int, ...]
    block: int

    @property
    def name(self) -> str:
        """Name of the shard, without its suffix."""
        return self.shard.rpartition(".")[0]

    @property
    def failures(self) -> list[tuple[str, str]]:
        """Inputs without a result."""
        return [entry for entry in self.entries if entry[1]]

    def to_json(self) -> str:
        """Write it as one line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str | bytes) -> "Done":
        """Read what :meth:`to_json` wrote."""
        row = json.loads(text)
        row["entries"] = tuple((name, reason) for name, reason in row["entries"])
        return cls(**row | {key: tuple(row[key]) for key in ("endings", "stamp")})


class Runner:
    """Does blocks one after the other; what the work needs is loaded at the first.

    Args:
        work: what is done.
        out: folder of the results.
        form: of the shards.
    """

    def __init__(self, work: Work, out: str, form: ShardFormat) -> None:
        self._work, self._out = work, out
        self._form: ShardFormat = form
        self._function: Function | None = None

    def run(self, block: Block) -> Done:
        """Do a block, unless a shard of it without failures is there.

        The record ``SHARD.json`` is written after the shard: where it is, the shard is whole.

        Raises:
            InputError: the place of the results refuses.
        """
        record = join(self._out, SHARDS, f"{block.shard}.json")
        if exists(record):
            done = Done.from_json(read_from(record))
            if not done.failures:
                return done
        temporary = tempfile.TemporaryDirectory(prefix="depthpose-")
        with refused_write(temporary.name), temporary as scratch:
            file = Path(scratch) / f"{block.shard}.{self._form}"
            entries = tuple(self._write(block, file, Path(scratch)))
            url = join(self._out, SHARDS, file.name)
            publish(file, url)
            stamp = tuple(file_stamp(local_path(url) or file))
        done = Done(
            shard=file.name,
            entries=entries,
            endings=tuple(self._work.endings),
            stamp=stamp,
            block=block.checksum,
        )
        publish_bytes(done.to_json().encode(), record)
        return done

    def _write(self, block: Block, file: Path, scratch: Path) -> Iterator[tuple[str, str]]:
        """Write the results of a block, and give each name with "" or the reason of a failure."""
        self._function = self._function or self._work.start()
        samples = _samples(block, self._work.files, scratch)
        results = scratch / "results"
        results.mkdir()
        with shard_writer(file, self._form, self._work.endings) as add:
            while chunk := list(islice(samples, self._work.batch)):
                reasons = iter(self._function([one.sample for one in chunk if one.sample], results))
                for one in chunk:
                    reason = next(reasons) if one.sample else one.reason
                    files: dict[str, bytes] = {}
                    for ending in self._work.endings:
                        path = results / f"{one.name}.{ending}"
                        if path.is_file():
                            files[ending] = path.read_bytes()
                            path.unlink()
                    add(one.name, {} if reason else files, reason)
                    yield one.name, reason
                    for path in one.sample.files if one.sample else ():
                        if scratch in path.parents:  # a copy, alone in its folder
                            shutil.rmtree(path.parent, ignore_errors=True)


def run_here(blocks: Sequence[Block], work: Work, out: str, form: ShardFormat) -> Iterator[Done]:
    """Do blocks in this process, one after the other: the engine that needs no cluster."""
    runner = Runner(work, out, form)
    for block in blocks:
        yield runner.run(block)


@dataclass(frozen=True, kw_only=True)
class _Opened:
    """An input whose files are at hand, or the reason why not."""

    name: str
    sample: Sample | None = None
    reason: str = ""


@contextmanager
def first_sample(items: Sequence[Item], tars: Sequence[str], files: Files) -> Iterator[Sample]:
    """Give the first input, to look at before any work.

    Raises:
        InputError: it cannot be read.
    """
    block = Block("", tuple(items[:1])) if items else Block("", tar=tars[0])
    with tempfile.TemporaryDirectory(prefix="depthpose-") as scratch:
        one = next(_samples(block, files, Path(scratch)))
        if one.sample is None:
            raise InputError(one.reason)
        yield one.sample


def _samples(block: Block, wanted: Files, scratch: Path) -> Iterator[_Opened]:
    if block.tar is not None:
        yield from _tar_samples(block.tar, wanted, scratch)
        return
    for item in block.items:
        try:
            files = tuple(local_copy(url, scratch) for url in item.files)
        except InputError as error:
            yield _Opened(name=item.name, reason=str(error))
            continue
        yield _Opened(name=item.name, sample=Sample(item.name, files))


def _tar_samples(tar: str, wanted: Files, scratch: Path) -> Iterator[_Opened]:
    """Group the members of a WebDataset shard by their key, which neighbours share."""
    key, files = "", dict[str, Path]()
    try:
        for member, data in read_tar(tar):
            path = PurePosixPath(member)
            start, _, ending = path.name.partition(".")
            next_key = str(path.parent / start)
            if next_key != key and key:
                yield _grouped(tar, key, files, wanted)
                files = {}
            key = next_key
            role, dot, suffix = f".{ending}".rpartition(".")
            suffix = f"{dot}{suffix}"
            role = role.removeprefix(".") or (wanted.roles[0] if len(wanted.roles) == 1 else "")
            if role in wanted.roles and suffix.lower() in wanted.suffixes:
                files[role] = Path(tempfile.mkdtemp(dir=scratch)) / f"{role}{suffix}"
                files[role].write_bytes(data)
        if key:
            yield _grouped(tar, key, files, wanted)
    except InputError as error:
        yield _Opened(name=PurePosixPath(tar).name, reason=str(error))


def _grouped(tar: str, key: str, files: dict[str, Path], wanted: Files) -> _Opened:
    missing = [role for role in wanted.roles if role not in files]
    reason = ""
    if missing:
        reason = f"{tar}: {key!r} has no {missing[0]}; a sample holds {', '.join(wanted.roles)}"
    try:
        refuse_name(key, tar)
    except InputError as error:
        reason = str(error)
    if reason:
        for file in files.values():
            shutil.rmtree(file.parent, ignore_errors=True)
        return _Opened(name=key, reason=reason)
    return _Opened(name=key, sample=Sample(key, tuple(files[role] for role in wanted.roles)))
