"""A sharded job: an engine processes the blocks of its inputs, and a manifest lists the results."""

import csv
import io
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from depthpose.core.engine.inputs import PLAN, Block, ListedInput, plan_blocks, read_tar
from depthpose.core.engine.shards import (
    SHARDS,
    Computation,
    ShardRecord,
    checksum_block,
    is_unchanged,
)
from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError
from depthpose.core.files import remove_parts, stores
from depthpose.core.files.disk import open_file_system
from depthpose.core.run_folder import NOT_OURS, RECORD, read_settings, refuse_other_settings

MANIFEST = "manifest.csv"

Engine = Callable[[Sequence[Block], Computation, str], Iterable[ShardRecord]]
"""Processes blocks, on any machine, and yields the record of each, in any order."""


@dataclass(frozen=True, kw_only=True)
class ShardedJob:
    """A job: its inputs, what is computed of them, and the folder of the results."""

    computation: Computation  #: what is computed
    inputs: Sequence[ListedInput] = ()  #: listed inputs
    tars: Sequence[str] = ()  #: tar shards of further inputs
    out: str  #: folder of the results, by path or URL
    settings: Mapping[str, Any]  #: JSON values that decide the results; others need another folder
    block_size: int = 64  #: number of listed inputs of a block


def run_job(job: ShardedJob, engine: Engine) -> list[ShardRecord]:
    """Process the unfinished blocks of a job, and write ``manifest.csv``, the list of its inputs.

    Returns:
        The records of all blocks, in the order of the shards.

    Raises:
        InputError: the folder holds results of other settings or inputs, or cannot be written; or
            two samples of tar shards have one name.
    """
    out = stores.absolute(job.out)
    stores.refuse_unsafe(out)
    _claim_url(out, {**job.settings, "shards": "tar"})
    blocks = plan_blocks(out, job.inputs, job.tars, job.block_size)

    records = _find_finished(out, blocks)
    unfinished = [block for block in blocks if block.shard not in records]
    if unfinished:
        for record in engine(unfinished, job.computation, out):
            records[record.shard.removesuffix(".tar")] = record
    missing = [block.shard for block in blocks if block.shard not in records]
    if missing:
        raise InputError(
            f"{out}: {len(missing)} of {len(blocks)} shards are missing, first {missing[0]}; start "
            "again: what is finished is kept"
        )

    # Partial files of killed processes: by now all workers have ended.
    for folder in (out, stores.join(out, SHARDS)):
        local_folder = stores.local_path(folder)
        if local_folder is not None:
            remove_parts(local_folder)
    records_in_order = [records[block.shard] for block in blocks]
    _write_manifest(out, records_in_order)
    return records_in_order


def _find_finished(out: str, blocks: Sequence[Block]) -> dict[str, ShardRecord]:
    """Find the blocks whose shards are whole and without failures: their records, by shard.

    The record of a shard that is not whole is deleted. Where only the time of a shard differs, as
    of a copy, its record is updated.
    """
    folder = stores.join(out, SHARDS)
    sizes = stores.list_sizes(folder)
    records = {record.shard: record for record in read_records(out)}
    finished: dict[str, ShardRecord] = {}
    for block in blocks:
        record = records.get(f"{block.shard}.tar")
        record_url = stores.join(folder, f"{block.shard}.json")
        if record is None or not _is_shard_whole(folder, block, record, sizes):
            if f"{block.shard}.json" in sizes:
                with open_file_system(record_url, "removed") as (fs, inner):
                    fs.rm_file(inner)
            continue

        path = stores.local_path(stores.join(folder, record.shard))
        if path is not None:
            size, recorded_time_ns, checksum = record.stamp
            time_ns = path.stat().st_mtime_ns
            if time_ns != recorded_time_ns:
                record = replace(record, stamp=(size, time_ns, checksum))
                stores.publish(record.to_json().encode(), record_url)
        if not record.failures:
            finished[block.shard] = record
    return finished


def _is_shard_whole(
    folder: str, block: Block, record: ShardRecord, sizes: Mapping[str, int]
) -> bool:
    """Whether a shard is of this block, as it was written, and no older than what it is made from.

    In an object store only its size is compared, by ``sizes``: those of the files of the folder.
    """
    if record.block != checksum_block(block):
        return False
    path = stores.local_path(stores.join(folder, record.shard))
    if path is None:
        return sizes.get(record.shard) == record.stamp[0]
    # Copied, a shard may be older or newer than when it was written.
    written_ns = max(record.stamp[1], path.stat().st_mtime_ns) if path.is_file() else 0
    return is_unchanged(path, record.stamp) and not _has_newer_input(block, written_ns)


def _has_newer_input(block: Block, written_ns: int) -> bool:
    """Whether a local input of a block was changed after its results were written."""
    urls = [file for listed in block.listed for file in listed.files]
    urls += [] if block.tar is None else [block.tar]
    paths = [path for url in urls if (path := stores.local_path(url)) is not None]
    return any(path.is_file() and path.stat().st_mtime_ns > written_ns for path in paths)


def _write_manifest(out: str, records: Sequence[ShardRecord]) -> None:
    """Write ``manifest.csv``: the name, the shard and the reason of failure, if any, of each input.

    Raises:
        InputError: two results have one name.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["name", "shard", "reason"])
    shard_of_name: dict[str, str] = {}
    for record in records:
        for name, reason in record.entries:
            if name in shard_of_name:
                raise InputError(
                    f"{out}: {shard_of_name[name]} and {record.shard} hold two results called "
                    f"{name!r}; give the samples of tar shards names of their own"
                )
            shard_of_name[name] = record.shard
            table.writerow([name, record.shard, reason])
    manifest = text.getvalue().encode(errors="surrogateescape")
    stores.publish(manifest, stores.join(out, MANIFEST))


def _claim_url(out: str, settings: Mapping[str, Any]) -> None:
    """Make a folder, local or in a store, that of a job with these settings, or continue its job.

    Unlike :func:`depthpose.core.run_folder.claim_folder`, it takes no lock, which object stores do
    not have.

    Raises:
        InputError: the folder holds results of other settings, or files that no job wrote.
    """
    earlier = read_settings(out)
    if earlier is not None:
        refuse_other_settings(out, earlier, settings)
        return
    for name in (MANIFEST, PLAN, SHARDS):
        url = stores.join(out, name)
        if stores.exists(url):
            raise InputError(f"{url}: {NOT_OURS}")
    content = {"settings": dict(settings), "environment": describe_environment()}
    record = f"{json.dumps(content, indent=2)}\n"
    stores.publish(record.encode(), stores.join(out, RECORD))


def read_records(out: str) -> list[ShardRecord]:
    """Read the records of the shards in the folder of a job, sorted; damaged ones are left out."""
    records: list[ShardRecord] = []
    record_files = stores.read_all(stores.join(stores.absolute(out), SHARDS), ".json")
    for _, content in sorted(record_files.items()):
        with suppress(ValueError, KeyError, TypeError):
            records.append(ShardRecord.from_json(content))
    return records


def read_shard(out: str, record: ShardRecord) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Yield the results of a shard: the name, and the content of its files by their endings.

    Args:
        out: folder of the job.
        record: record of the shard.

    Raises:
        InputError: the shard is missing or damaged.
    """
    url = stores.join(stores.absolute(out), SHARDS, record.shard)
    names = {name for name, reason in record.entries if not reason}
    result_name = ""
    files: dict[str, bytes] = {}
    for member, content in read_tar(url):
        name, ending = _split_member(member, names, record.endings)
        if not name:
            raise InputError(
                f"{url}: holds {member!r}, which its record does not name; make it anew"
            )
        if files and name != result_name:
            yield result_name, files
            files = {}
        result_name = name
        files[ending] = content
    if files:
        yield result_name, files


def _split_member(member: str, names: Collection[str], endings: Collection[str]) -> tuple[str, str]:
    """Split a file name into the name of a result and an ending; both "" if it is of no result.

    Names and endings may hold points: so the split is one of the known ``names`` and ``endings``.
    """
    for place, letter in enumerate(member):
        name = member[:place]
        ending = member[place + 1 :]
        if letter == "." and name in names and ending in endings:
            return name, ending
    return "", ""
