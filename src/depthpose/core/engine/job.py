"""A job: the folder of the results claimed, blocks done by an engine, one list of all."""

import csv
import hashlib
import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from depthpose.core.engine.plan import PLAN, Block, Item, make_plan
from depthpose.core.engine.shard import ShardFormat, read_shard
from depthpose.core.engine.work import SHARDS, Done, Work
from depthpose.core.errors import InputError
from depthpose.core.files import remove_parts
from depthpose.core.files.store import (
    absolute,
    exists,
    join,
    list_sizes,
    local_path,
    publish_bytes,
    read_all,
    read_from,
    refuse_unsafe,
    remove,
)
from depthpose.core.results import is_unchanged
from depthpose.core.run import RECORD, not_ours, refuse_other_settings, run_record

MANIFEST = "manifest.csv"

Engine = Callable[[Sequence[Block], Work, str, ShardFormat], Iterable[Done]]
"""Processes blocks, on any machine, and yields the outcome of each, in any order."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What is done, to which inputs, and where the results go.

    Attributes:
        work: what is done.
        items: listed inputs.
        tars: tar shards of inputs.
        out: folder of the results, by path or URL.
        settings: JSON values that decide the results; other settings need another folder.
        form: of the shards.
        block: inputs of a shard.
    """

    work: Work
    items: Sequence[Item] = ()
    tars: Sequence[str] = ()
    out: str
    settings: Mapping[str, Any]
    form: ShardFormat = "tar"
    block: int = 64


def run_job(job: Job, engine: Engine) -> list[Done]:
    """Do what is not finished of a job, and write the list of all: ``manifest.csv``.

    Returns:
        What became of every block, in the order of the shards.

    Raises:
        InputError: the folder holds results of other settings or inputs, or refuses; or two
            samples of tar shards have one name.
    """
    out = absolute(job.out)
    refuse_unsafe(out)
    claim(out, {**job.settings, "shards": job.form})
    blocks = make_plan(out, job.items, job.tars, job.block)
    done = _whole(out, blocks)
    left = [block for block in blocks if block.shard not in done]
    if left:
        done |= {_shard(one): one for one in engine(left, job.work, out, job.form)}
    lost = [block.shard for block in blocks if block.shard not in done]
    if lost:
        raise InputError(
            f"{out}: {len(lost)} of {len(blocks)} shards are missing, first {lost[0]}; start "
            "again: what is finished is kept"
        )
    _remove_parts(out)
    every = [done[block.shard] for block in blocks]
    _write_manifest(out, every)
    return every


def claim(out: str, settings: Mapping[str, Any]) -> None:
    """Claim a folder, local or in a store, for a run with these settings, or continue it.

    Raises:
        InputError: it holds a run with other settings; the first difference is named.
    """
    record = join(out, RECORD)
    if exists(record):
        try:
            earlier = json.loads(read_from(record))
        except ValueError as error:
            raise InputError(f"{record}: no JSON ({error}); choose another folder") from error
        refuse_other_settings(out, earlier, settings)
        return
    for name in (MANIFEST, PLAN, SHARDS):
        if exists(join(out, name)):
            raise not_ours(join(out, name))
    publish_bytes(f"{json.dumps(run_record(settings), indent=2)}\n".encode(), record)


def is_job(out: str) -> bool:
    """Whether a folder holds shards of a job."""
    return exists(join(absolute(out), PLAN))


def read_job_settings(out: str) -> dict[str, Any]:
    """Give the settings that made the shards of a folder.

    Raises:
        InputError: there are none.
    """
    record = join(absolute(out), RECORD)
    try:
        return dict(json.loads(read_from(record))["settings"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{record}: not a record of a run. Choose another folder.") from error


def result_items(out: str) -> list[Item]:
    """Take the shards of an earlier job as inputs of another: a record and a shard each.

    The name changes with the record, so that a shard that was made anew is a new input.
    """
    folder = join(absolute(out), SHARDS)
    return [
        Item(
            f"{_shard(done)}-{hashlib.sha256(_untimed(done).encode()).hexdigest()[:12]}",
            (join(folder, f"{_shard(done)}.json"), join(folder, done.shard)),
        )
        for done in read_results(out)
    ]


def read_results(out: str) -> list[Done]:
    """Say what an earlier job left, shard by shard; nothing where there was none."""
    return [one for _, one in sorted(_finished(absolute(out)).items())]


def shard_results(out: str, done: Done) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Read the results of a shard one by one: the name, and the content of each ending.

    Raises:
        InputError: the shard is not there, or is damaged.
    """
    names = {name for name, reason in done.entries if not reason}
    return read_shard(join(absolute(out), SHARDS, done.shard), names, done.endings)


def _finished(out: str) -> dict[str, Done]:
    """Read the records of shards; one that is damaged is as none."""
    found: dict[str, Done] = {}
    for name, text in read_all(join(out, SHARDS), ".json").items():
        with suppress(ValueError, KeyError, TypeError):
            found[name.removesuffix(".json")] = Done.from_json(text)
    return found


def _whole(out: str, blocks: Sequence[Block]) -> dict[str, Done]:
    """Give what is done without failures, its shard as it was written; other records go."""
    folder = join(out, SHARDS)
    sizes, records = list_sizes(folder), _finished(out)
    done: dict[str, Done] = {}
    for block in blocks:
        one = records.get(block.shard)
        is_ours = one is not None and one.block in (None, block.checksum)
        if one is None or not is_ours or not _is_unchanged(folder, one, sizes):
            if f"{block.shard}.json" in sizes:
                remove(join(folder, f"{block.shard}.json"))
        elif not one.failures:
            done[block.shard] = one
    return done


def _is_unchanged(folder: str, done: Done, sizes: Mapping[str, int]) -> bool:
    path = local_path(join(folder, done.shard))
    if path is None or not done.stamp:  # of a store sizes alone; older records have none
        return sizes.get(done.shard) in (done.stamp[:1] or sizes.values())
    is_unchanged_file = is_unchanged(path, done.stamp)
    if is_unchanged_file and (time_ns := path.stat().st_mtime_ns) != done.stamp[1]:  # a copy
        stamp = (done.stamp[0], time_ns, done.stamp[2])
        record = join(folder, f"{_shard(done)}.json")
        publish_bytes(replace(done, stamp=stamp).to_json().encode(), record)
    return is_unchanged_file


def _untimed(done: Done) -> str:
    """Write a record without the time of its shard, which a copy changes."""
    return replace(done, stamp=(*done.stamp[:1], *done.stamp[2:])).to_json()


def _shard(done: Done) -> str:
    return done.shard.rpartition(".")[0]


def _remove_parts(out: str) -> None:
    """Remove what killed workers left; all have ended."""
    folder = local_path(join(out, SHARDS))
    if folder is not None:
        remove_parts(folder)


def _write_manifest(out: str, every: Sequence[Done]) -> None:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["name", "shard", "reason"])
    seen: dict[str, str] = {}
    for done in every:
        for name, reason in done.entries:
            if name in seen:
                raise InputError(
                    f"{out}: {seen[name]} and {done.shard} hold two results called {name!r}; give "
                    "the samples of tar shards names of their own"
                )
            seen[name] = done.shard
            table.writerow([name, done.shard, reason])
    publish_bytes(text.getvalue().encode(errors="surrogateescape"), join(out, MANIFEST))
