"""What a worker does with a block: it computes the results of its inputs, and writes their shard.

A shard is a tar file in WebDataset's layout, written whole or not at all, with a record beside it.
"""

import io
import json
import shutil
import tarfile
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path

from depthpose.core.engine.inputs import Block, InputFormat, LocalInput, fetch_inputs
from depthpose.core.files import stores
from depthpose.core.files.disk import refused_write

SHARDS = "shards"
"""Folder of the shards and their records, in the folder of the results."""
_CHUNK_BYTES = 2**22  # bytes of a file that are read at a time for its checksum

ResultWriter = Callable[[Sequence[LocalInput], Path], Sequence[str]]
"""Computes the results of some inputs, and writes them into a folder as ``NAME.ENDING``.

Returns for each input "", or why it has no result.
"""


@dataclass(frozen=True, kw_only=True)
class Computation:
    """What a job computes of its inputs; it is sent to every worker."""

    make_writer: Callable[[], ResultWriter]
    """Loads what all inputs need, such as a network; called once in each worker."""
    input_format: InputFormat  #: the files that each input consists of
    endings: Sequence[str]  #: endings of the files of a result
    batch: int = 1  #: number of inputs that the writer gets together


@dataclass(frozen=True, kw_only=True)
class ShardRecord:
    """The record of a processed block: its shard of results, and why some inputs have none."""

    shard: str  #: name of the shard, with its suffix
    entries: tuple[tuple[str, str], ...]  #: name of each input, and "" or why it failed
    endings: tuple[str, ...]  #: endings of the files of a result
    stamp: tuple[int, ...]  #: size [bytes], time of the last change [ns] and CRC-32 of the shard
    block: int  #: CRC-32 of the block (``checksum_block``)

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


def checksum_block(block: Block) -> int:
    """Compute the CRC-32 of a block as JSON, which changes with its inputs."""
    return zlib.crc32(block.to_json().encode())


def read_stamp(path: Path) -> tuple[int, int, int]:
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
        return status.st_mtime_ns == stamp[1] or read_stamp(path)[2] == stamp[2]
    except (OSError, IndexError):
        return False


@dataclass(eq=False)
class BlockProcessor:
    """Processes blocks one after the other; its writer is made with the first."""

    computation: Computation
    out: str  #: folder of the results, by path or URL
    writer: ResultWriter | None = None  #: None before the first block

    def process(self, block: Block) -> ShardRecord:
        """Write the shard and the record of a block, unless both exist and no input failed.

        The record ``SHARD.json`` is written after the shard: where it exists, the shard is whole.
        """
        record_url = stores.join(self.out, SHARDS, f"{block.shard}.json")
        if stores.exists(record_url):
            earlier = ShardRecord.from_json(stores.read_from(record_url))
            if not earlier.failures:
                return earlier

        temporary = tempfile.TemporaryDirectory(prefix="depthpose-")
        with refused_write(temporary.name), temporary as scratch:
            file = Path(scratch) / f"{block.shard}.tar"
            entries = tuple(self._write_shard(block, file, Path(scratch)))
            url = stores.join(self.out, SHARDS, file.name)
            stores.publish(file, url)
            stamp = read_stamp(stores.local_path(url) or file)
        record = ShardRecord(
            shard=file.name,
            entries=entries,
            endings=tuple(self.computation.endings),
            stamp=stamp,
            block=checksum_block(block),
        )
        stores.publish(record.to_json().encode(), record_url)
        return record

    def _write_shard(self, block: Block, file: Path, scratch: Path) -> Iterator[tuple[str, str]]:
        """Write the results of a block to a tar; yield each name, and "" or why it failed.

        Args:
            block: the block.
            file: the tar.
            scratch: folder for copies of inputs, and for results before they are packed.
        """
        self.writer = self.writer or self.computation.make_writer()
        inputs = fetch_inputs(block, self.computation.input_format, scratch)
        results = scratch / "results"
        results.mkdir()
        with tarfile.open(file, "w", format=tarfile.PAX_FORMAT) as tar:
            while batch := list(islice(inputs, self.computation.batch)):
                readable = [local for local in batch if not local.failure]
                reasons = iter(self.writer(readable, results))
                for local in batch:
                    reason = local.failure or next(reasons)
                    copies = [path for path in local.files if scratch in path.parents]
                    for path in copies:  # the path of a temporary copy tells the user nothing
                        reason = reason.replace(str(path), path.name)
                    self._move_result(results, local.name, None if reason else tar)
                    yield local.name, reason
                    for path in copies:  # each is alone in its folder
                        shutil.rmtree(path.parent, ignore_errors=True)

    def _move_result(self, folder: Path, name: str, tar: tarfile.TarFile | None) -> None:
        """Move the files of a result from a folder into a tar; without a tar they are deleted."""
        for ending in sorted(self.computation.endings):
            path = folder / f"{name}.{ending}"
            if not path.is_file():
                continue
            if tar is not None:
                content = path.read_bytes()
                # Without time and owner, so that equal results make equal shards.
                member = tarfile.TarInfo(f"{name}.{ending}")
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
            path.unlink()
