"""A sharded job: an engine processes the blocks of its inputs, and a manifest lists the results.

Ray Data maps blocks over a pool of workers, each of which starts once. Ray restarts a worker that
dies and processes its block again; where a node is lost, others take over. A block's record is a
line of text, so that neither queues nor results fill the memory.
"""

import csv
import io
import json
import os
import secrets
import socket
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from depthpose.core.engine.work import (
    PLAN,
    SHARDS,
    Block,
    Item,
    Runner,
    ShardRecord,
    Work,
    is_unchanged,
    make_plan,
    read_tar,
)
from depthpose.core.errors import InputError, MissingExtraError, import_extra
from depthpose.core.files import remove_parts, stores
from depthpose.core.files.disk import file_system
from depthpose.core.run import (
    NOT_OURS,
    RECORD,
    environment,
    read_settings,
    refuse_other_settings,
)

MANIFEST = "manifest.csv"

Engine = Callable[[Sequence[Block], Work, str], Iterable[ShardRecord]]
"""Processes blocks, on any machine, and yields the record of each, in any order."""


@dataclass(frozen=True, kw_only=True)
class ShardedJob:
    """A job: the work, its inputs, and the folder of its results."""

    work: Work  #: what is computed
    items: Sequence[Item] = ()  #: listed inputs
    tars: Sequence[str] = ()  #: tar shards of inputs
    out: str  #: folder of the results, by path or URL
    settings: Mapping[str, Any]  #: JSON values that decide the results; others need another folder
    block: int = 64  #: inputs of a shard


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
    claim(out, {**job.settings, "shards": "tar"})
    blocks = make_plan(out, job.items, job.tars, job.block)

    records = _finished_shards(out, blocks)
    unfinished = [block for block in blocks if block.shard not in records]
    if unfinished:
        for record in engine(unfinished, job.work, out):
            records[record.shard.removesuffix(".tar")] = record
    missing = [block.shard for block in blocks if block.shard not in records]
    if missing:
        raise InputError(
            f"{out}: {len(missing)} of {len(blocks)} shards are missing, first {missing[0]}; start "
            "again: what is finished is kept"
        )

    # Partial files of killed workers: by now all workers have ended.
    local_folder = stores.local_path(stores.join(out, SHARDS))
    if local_folder is not None:
        remove_parts(local_folder)
    ordered = [records[block.shard] for block in blocks]
    _write_manifest(out, ordered)
    return ordered


def _finished_shards(out: str, blocks: Sequence[Block]) -> dict[str, ShardRecord]:
    """Find the blocks whose shards are whole and without failures: their records, by shard.

    The record of a shard that is not whole is deleted. Where only the time of a shard differs, as
    of a copy, its record is updated.
    """
    folder = stores.join(out, SHARDS)
    sizes = stores.list_sizes(folder)
    records = {record.shard: record for record in read_results(out)}
    finished: dict[str, ShardRecord] = {}
    for block in blocks:
        record = records.get(f"{block.shard}.tar")
        record_url = stores.join(folder, f"{block.shard}.json")
        if record is None or not _is_shard_whole(folder, block, record, sizes):
            if f"{block.shard}.json" in sizes:
                with file_system(record_url, "removed") as (fs, inner):
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
    """Whether a shard is of this block and as it was written.

    Of an object store only the ``sizes`` of the files are compared.
    """
    if record.block != zlib.crc32(block.to_json().encode()):
        return False
    path = stores.local_path(stores.join(folder, record.shard))
    if path is None:
        return sizes.get(record.shard) == record.stamp[0]
    return is_unchanged(path, record.stamp)


def _write_manifest(out: str, shards: Sequence[ShardRecord]) -> None:
    """Write ``manifest.csv``: the name, the shard and the reason of failure, if any, of each input.

    Raises:
        InputError: two results have one name.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["name", "shard", "reason"])
    shard_of: dict[str, str] = {}
    for shard in shards:
        for name, reason in shard.entries:
            if name in shard_of:
                raise InputError(
                    f"{out}: {shard_of[name]} and {shard.shard} hold two results called {name!r}; "
                    "give the samples of tar shards names of their own"
                )
            shard_of[name] = shard.shard
            table.writerow([name, shard.shard, reason])
    manifest = text.getvalue().encode(errors="surrogateescape")
    stores.publish(manifest, stores.join(out, MANIFEST))


def claim(out: str, settings: Mapping[str, Any]) -> None:
    """Claim a folder, local or in a store, for a run with these settings, or continue it."""
    if (earlier := read_settings(out)) is not None:
        refuse_other_settings(out, earlier, settings)
        return
    for name in (MANIFEST, PLAN, SHARDS):
        if stores.exists(stores.join(out, name)):
            raise InputError(f"{stores.join(out, name)}: {NOT_OURS}")
    content = {"settings": dict(settings), "environment": environment()}
    record = f"{json.dumps(content, indent=2)}\n"
    stores.publish(record.encode(), stores.join(out, RECORD))


def read_results(out: str) -> list[ShardRecord]:
    """Read the records of the shards that earlier runs left; damaged records are skipped."""
    records: list[ShardRecord] = []
    record_files = stores.read_all(stores.join(stores.absolute(out), SHARDS), ".json")
    for _, content in sorted(record_files.items()):
        with suppress(ValueError, KeyError, TypeError):
            records.append(ShardRecord.from_json(content))
    return records


def shard_results(out: str, done: ShardRecord) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Read the results of a shard one by one: the name, and the content of its files by ending.

    Raises:
        InputError: the shard is missing or damaged.
    """
    url = stores.join(stores.absolute(out), SHARDS, done.shard)
    names = {name for name, reason in done.entries if not reason}
    result_name = ""
    files: dict[str, bytes] = {}
    for member, data in read_tar(url):
        name, ending = _split_member(member, names, done.endings)
        if not name:
            raise InputError(
                f"{url}: holds {member!r}, which its record does not name; make it anew"
            )
        if files and name != result_name:
            yield result_name, files
            files = {}
        result_name = name
        files[ending] = data
    if files:
        yield result_name, files


def _split_member(member: str, names: Collection[str], endings: Collection[str]) -> tuple[str, str]:
    """Split a file name into the name of a result and an ending, each of which may hold points.

    Both are "" where the file is of no result.
    """
    for place, letter in enumerate(member):
        name = member[:place]
        ending = member[place + 1 :]
        if letter == "." and name in names and ending in endings:
            return name, ending
    return "", ""


_LEAST_VERSION = (2, 52)  # the first version of Ray that has passwords
_CONNECT_TIMEOUT_S = 10


@dataclass(frozen=True, kw_only=True)
class RayEngine:
    """Processes blocks with Ray Data, on this machine or a cluster."""

    address: str | None = None  #: a running cluster, or ``auto``; None starts one for this job
    workers: int | None = None  #: at most; None: as many as fit when the job begins
    worker_cpus: float = 1.0  #: cores that a worker asks for
    worker_gpus: float = 0.0  #: GPUs that it asks for; a fraction lets workers share one

    def __call__(self, blocks: Sequence[Block], work: Work, out: str) -> Iterator[ShardRecord]:
        """Process blocks, and yield the record of each as it is finished.

        Raises:
            InputError: no cluster at the address, or one worker does not fit into it.
            MissingExtraError: Ray is not installed.
        """
        if self.address is None:
            _protect_local_cluster()
        ray = _import_ray()
        starts_ray = not ray.is_initialized()
        if starts_ray:
            self._connect(ray)
        try:
            # In a list the work stays a reference, which a restarted worker reads again.
            work_reference = [ray.put(work)]
            lines = [{"block": block.to_json()} for block in blocks]
            rows = (
                ray.data.from_items(lines, override_num_blocks=len(lines))
                .map_batches(
                    _Worker,
                    batch_size=1,
                    fn_constructor_args=(work_reference, out),
                    compute=ray.data.ActorPoolStrategy(
                        min_size=1,
                        max_size=min(self.workers or self._count_fitting_workers(ray), len(lines)),
                        max_tasks_in_flight_per_actor=2,
                    ),
                    num_cpus=self.worker_cpus,
                    num_gpus=self.worker_gpus,
                )
                .iter_rows()
            )
            try:
                for row in rows:
                    yield ShardRecord.from_json(row["record"])
            except ray.exceptions.RayError as error:
                input_error = _find_input_error(error)
                if input_error is None:
                    raise
                raise InputError(str(getattr(input_error, "cause", input_error))) from error
        finally:
            if starts_ray:
                ray.shutdown()

    def _connect(self, ray: Any) -> None:  # noqa: ANN401  Ray is loaded where it is used
        """Connect to the cluster of ``address``, or start Ray on this machine."""
        options: dict[str, Any] = {}
        if self.address is None:
            cores = None if self.workers is None else max(1.0, self.workers * self.worker_cpus)
            options = {"num_cpus": cores, "include_dashboard": False}
        try:
            host, _, port = (self.address or "").rpartition(":")
            if host and "/" not in host and port.isdecimal():
                # Tried first, because Ray waits for minutes where nothing answers.
                socket.create_connection((host, int(port)), timeout=_CONNECT_TIMEOUT_S).close()
            ray.init(address=self.address or "local", **options)
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(
                f"--address {self.address}: no Ray cluster answers there ({error}); start one by "
                "'ray start --head', or omit the address"
            ) from error

    def _count_fitting_workers(self, ray: Any) -> int:  # noqa: ANN401
        """Compute how many workers fit into the cluster.

        Raises:
            InputError: not even one does.
        """
        resources: Mapping[str, float] = ray.cluster_resources()
        needs = {"CPU": self.worker_cpus, "GPU": self.worker_gpus}
        workers = min(
            int(resources.get(name, 0) / need) for name, need in needs.items() if need > 0
        )
        if workers < 1:
            had = ", ".join(f"{resources.get(name, 0):g} {name}" for name in needs)
            wanted = ", ".join(f"{need:g} {name}" for name, need in needs.items())
            raise InputError(
                f"a worker asks for {wanted}, but the cluster has {had}; ask for less by "
                "--worker-cpus and --worker-gpus"
            )
        return workers


def _protect_local_cluster() -> None:
    """Make a cluster that Ray starts listen to this machine alone, and ask for a password.

    Whoever reaches a port of Ray may run any code. Ray reads these variables as it is imported.
    """
    # On every system, in spite of its name: "0" makes Ray listen on 127.0.0.1 alone.
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    os.environ.setdefault("RAY_AUTH_MODE", "token")
    if "RAY_AUTH_TOKEN_PATH" not in os.environ:
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))


def _find_input_error(error: BaseException) -> InputError | None:
    """Find the :class:`InputError` behind an error of Ray, through its causes."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, InputError):
        cause = getattr(cause, "cause", None) or cause.__cause__
    return cause


class _Worker:
    """A worker of Ray, which starts its work once for all of its blocks."""

    def __init__(self, work_reference: list[Any], out: str) -> None:
        self._runner = Runner(_import_ray().get(work_reference[0]), out)

    def __call__(self, batch: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Process the blocks of a batch; return their records, as lines of JSON."""
        lines = [self._runner.run(Block.from_json(str(line))).to_json() for line in batch["block"]]
        return {"record": np.array(lines, dtype=object)}


def _import_ray() -> Any:  # noqa: ANN401  Ray is loaded where it is used
    """Import Ray, with its usage statistics switched off unless the user switched them on.

    Raises:
        MissingExtraError: Ray is not installed, or too old to have passwords.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import_extra("ray.data", "ray[data]", "ray", "--engine ray")
    ray = import_module("ray")
    major_and_minor = tuple(map(int, ray.__version__.split(".")[:2]))
    if major_and_minor < _LEAST_VERSION:
        raise MissingExtraError(
            f"ray[data] 2.52 or later, not {ray.__version__}, which lets anybody in", "ray",
            "--engine ray",
        )  # fmt: skip
    return ray
