"""Shards of results: tar files in WebDataset's layout, or Parquet; written and read."""

import io
import tarfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from depthpose.core.engine.plan import import_pyarrow
from depthpose.core.errors import InputError
from depthpose.core.files.store import opened, read_from

ShardFormat = Literal["tar", "parquet"]


@runtime_checkable
class ShardWriter(Protocol):
    """Takes the files of one result after the other."""

    def add(self, name: str, files: Mapping[str, bytes], reason: str = "") -> None:
        """Add a result: contents by their endings, or the reason why there are none."""
        ...


@contextmanager
def shard_writer(path: Path, form: ShardFormat, endings: Sequence[str]) -> Iterator[ShardWriter]:
    """Write a shard, the same bytes for the same results.

    Args:
        path: a local file.
        form: tar holds members ``NAME.ENDING``; Parquet has a row for each name, with columns
            ``name``, ``reason`` and the content of each ending.
        endings: that a result may have.

    Raises:
        MissingExtraError: Parquet without the extra ``ray``.
    """
    if form == "tar":
        with tarfile.open(path, "w", format=tarfile.PAX_FORMAT) as tar:
            yield _TarWriter(tar)
        return
    arrow = import_pyarrow("results in Parquet")
    fields = [("name", arrow.string()), ("reason", arrow.string())]
    schema = arrow.schema([*fields, *((ending, arrow.binary()) for ending in endings)])
    # Maps hardly shrink, and pictures are compressed already.
    with arrow.parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        rows = _ParquetWriter(arrow, schema, writer)
        yield rows
        rows.flush()


class _TarWriter:
    def __init__(self, tar: tarfile.TarFile) -> None:
        self._tar = tar

    def add(self, name: str, files: Mapping[str, bytes], reason: str = "") -> None:  # noqa: ARG002
        for ending, data in sorted(files.items()):
            member = tarfile.TarInfo(f"{name}.{ending}")
            member.size = len(data)
            self._tar.addfile(member, io.BytesIO(data))


class _ParquetWriter:
    _GROUP_BYTES = 64 * 2**20

    def __init__(self, arrow: Any, schema: Any, writer: Any) -> None:  # noqa: ANN401
        self._arrow, self._schema, self._writer = arrow, schema, writer
        self._rows: list[dict[str, Any]] = []
        self._bytes = 0

    def add(self, name: str, files: Mapping[str, bytes], reason: str = "") -> None:
        self._rows.append({"name": name, "reason": reason, **files})
        self._bytes += sum(map(len, files.values()))
        if self._bytes > self._GROUP_BYTES:
            self.flush()

    def flush(self) -> None:
        if self._rows:
            self._writer.write_table(self._arrow.Table.from_pylist(self._rows, self._schema))
        self._rows, self._bytes = [], 0


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
        yield from _read_parquet(url)
        return
    files: dict[str, bytes] = {}
    last = ""
    for member, data in read_tar(url):
        name = _name_of(member, names, endings, url)
        if name != last and files:
            yield last, files
            files = {}
        last, files[member[len(name) + 1 :]] = name, data
    if files:
        yield last, files


def read_tar(url: str) -> Iterator[tuple[str, bytes]]:
    """Read the files of a tar shard, plain or compressed, from its beginning to its end.

    Raises:
        InputError: it is not there, is no intact tar file, or holds a link or one name twice.
    """
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


def _read_parquet(url: str) -> Iterator[tuple[str, dict[str, bytes]]]:
    arrow = import_pyarrow("results in Parquet")
    try:
        file = arrow.parquet.ParquetFile(io.BytesIO(read_from(url)))
        for batch in file.iter_batches(batch_size=8):
            for row in batch.to_pylist():
                name, _ = row.pop("name"), row.pop("reason")
                files = {ending: data for ending, data in row.items() if data is not None}
                if files:
                    yield name, files
    except (arrow.ArrowException, OSError, KeyError) as error:
        raise InputError(f"{url}: not a Parquet shard ({error}); make it anew") from error


def _name_of(member: str, names: Collection[str], endings: Collection[str], url: str) -> str:
    for k, letter in enumerate(member):
        if letter == "." and member[:k] in names and member[k + 1 :] in endings:
            return member[:k]
    raise InputError(f"{url}: holds {member!r}, which its record does not name; make it anew")
