"""A job: the folder of the results claimed, blocks done by an engine, one list of all.

Ray Data maps blocks over a pool of workers, each of which starts once. Ray restarts a worker that
dies and does its block again; where a node is lost, others take over. A block's outcome is a line
of text, so that neither queues nor results fill the memory.
"""

import csv
import io
import json
import os
import secrets
import socket
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
"""Processes blocks, on any machine, and yields the outcome of each, in any order."""


@dataclass(frozen=True, kw_only=True)
class ShardedJob:
    """What is done, to which inputs, and where the results go."""

    work: Work  #: what is done
    items: Sequence[Item] = ()  #: listed inputs
    tars: Sequence[str] = ()  #: tar shards of inputs
    out: str  #: folder of the results, by path or URL
    settings: Mapping[str, Any]  #: JSON values that decide the results; others need another folder
    block: int = 64  #: inputs of a shard


def run_job(job: ShardedJob, engine: Engine) -> list[ShardRecord]:
    """Do what is not finished of a job, and write ``manifest.csv``, the list of all its inputs.

    Returns:
        What became of every block, in the order of the shards.

    Raises:
        InputError: the folder holds results of other settings or inputs, or refuses; or two
            samples of tar shards have one name.
    """
    out = stores.absolute(job.out)
    stores.refuse_unsafe(out)
    claim(out, {**job.settings, "shards": "tar"})
    blocks = make_plan(out, job.items, job.tars, job.block)
    done = _finished_shards(out, blocks)
    unfinished = [block for block in blocks if block.shard not in done]
    if unfinished:
        new = engine(unfinished, job.work, out)
        done |= {shard.shard.removesuffix(".tar"): shard for shard in new}
    lost = [block.shard for block in blocks if block.shard not in done]
    if lost:
        raise InputError(
            f"{out}: {len(lost)} of {len(blocks)} shards are missing, first {lost[0]}; start "
            "again: what is finished is kept"
        )
    if (folder := stores.local_path(stores.join(out, SHARDS))) is not None:
        remove_parts(folder)  # of killed workers: all have ended
    shards = [done[block.shard] for block in blocks]
    _write_manifest(out, shards)
    return shards


def _finished_shards(out: str, blocks: Sequence[Block]) -> dict[str, ShardRecord]:
    """Find the blocks whose shards are whole and without failures; give their records by name.

    The record of a shard that is not whole is removed.
    """
    folder = stores.join(out, SHARDS)
    sizes = stores.list_sizes(folder)
    records = {shard.shard: shard for shard in read_results(out)}
    done: dict[str, ShardRecord] = {}
    for block in blocks:
        shard = records.get(f"{block.shard}.tar")
        record = stores.join(folder, f"{block.shard}.json")
        path = None if shard is None else stores.local_path(stores.join(folder, shard.shard))
        if shard is None or shard.block != zlib.crc32(block.to_json().encode()):
            is_whole = False
        elif path is None:  # of a store sizes alone are compared
            is_whole = sizes.get(shard.shard) == shard.stamp[0]
        else:
            is_whole = is_unchanged(path, shard.stamp)
            if is_whole and (time_ns := path.stat().st_mtime_ns) != shard.stamp[1]:  # a copy
                shard = replace(shard, stamp=(shard.stamp[0], time_ns, shard.stamp[2]))
                stores.publish(shard.to_json().encode(), record)
        if shard is not None and is_whole:
            if not shard.failures:
                done[block.shard] = shard
        elif f"{block.shard}.json" in sizes:
            with file_system(record, "removed") as (fs, inner):
                fs.rm_file(inner)
    return done


def _write_manifest(out: str, shards: Sequence[ShardRecord]) -> None:
    """Write ``manifest.csv``: each input with its shard, or the reason why it has no result.

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
    for _, text in sorted(
        stores.read_all(stores.join(stores.absolute(out), SHARDS), ".json").items()
    ):
        with suppress(ValueError, KeyError, TypeError):
            records.append(ShardRecord.from_json(text))
    return records


def shard_results(out: str, done: ShardRecord) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Read the results of a shard one by one: the name, and the content of each ending.

    Raises:
        InputError: the shard is not there, or is damaged.
    """
    url = stores.join(stores.absolute(out), SHARDS, done.shard)
    names = {name for name, reason in done.entries if not reason}
    name = ""
    files = dict[str, bytes]()
    for member, data in read_tar(url):
        # A tar does not separate the names of the results from the endings of their files.
        dots = (k for k, letter in enumerate(member) if letter == ".")
        pairs = ((member[:k], member[k + 1 :]) for k in dots)
        parts = next((pair for pair in pairs if pair[0] in names and pair[1] in done.endings), None)
        if parts is None:
            raise InputError(
                f"{url}: holds {member!r}, which its record does not name; make it anew"
            )
        if files and parts[0] != name:
            yield name, files
            files = {}
        name = parts[0]
        files[parts[1]] = data
    if files:
        yield name, files


_LEAST_VERSION = (2, 52)  # the first version of Ray that has passwords


@dataclass(frozen=True, kw_only=True)
class RayEngine:
    """Does blocks by Ray Data."""

    address: str | None = None  #: of a running cluster, or ``auto``; None starts one for this job
    workers: int | None = None  #: at most; None: as many as fit when the job begins
    worker_cpus: float = 1.0  #: cores that a worker asks for
    worker_gpus: float = 0.0  #: GPUs that it asks for; a part lets workers share one

    def __call__(self, blocks: Sequence[Block], work: Work, out: str) -> Iterator[ShardRecord]:
        """Do blocks, and give what became of each as it is done.

        Raises:
            InputError: no cluster at the address, or one worker does not fit into it.
            MissingExtraError: Ray is not installed.
        """
        if self.address is None:
            # A cluster that is started here listens to this machine alone, and asks for a password:
            # whoever reaches a port of Ray may run any code. Ray reads these as it is imported.
            # Without clusters of several machines, which is what its name is about, a node is
            # 127.0.0.1.
            os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
            os.environ.setdefault("RAY_AUTH_MODE", "token")
            if "RAY_AUTH_TOKEN_PATH" not in os.environ:
                os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        ray = _import_ray()
        is_ours = not ray.is_initialized()
        if is_ours:
            self._connect(ray)
        try:
            # In a list the work stays a reference, which a worker that starts again reads again.
            shipped = [ray.put(work)]
            lines = [{"block": block.to_json()} for block in blocks]
            rows = (
                ray.data.from_items(lines, override_num_blocks=len(lines))
                .map_batches(
                    _Worker,
                    batch_size=1,
                    fn_constructor_args=(shipped, out),
                    compute=ray.data.ActorPoolStrategy(
                        min_size=1,
                        max_size=min(self.workers or self._capacity(ray), len(lines)),
                        max_tasks_in_flight_per_actor=2,
                    ),
                    num_cpus=self.worker_cpus,
                    num_gpus=self.worker_gpus,
                )
                .iter_rows()
            )
            try:
                for row in rows:
                    yield ShardRecord.from_json(row["done"])
            except ray.exceptions.RayError as error:
                inner: BaseException | None = error  # one of ours may be behind Ray's own
                while inner is not None and not isinstance(inner, InputError):
                    inner = getattr(inner, "cause", None) or inner.__cause__
                if inner is None:
                    raise
                raise InputError(str(getattr(inner, "cause", inner))) from error
        finally:
            if is_ours:
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
                # Ray waits for minutes where nothing answers.
                socket.create_connection((host, int(port)), timeout=10).close()
            ray.init(address=self.address or "local", **options)
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(
                f"--address {self.address}: no Ray cluster answers there ({error}); start one by "
                "'ray start --head', or omit the address"
            ) from error

    def _capacity(self, ray: Any) -> int:  # noqa: ANN401
        """Say how many workers fit into the cluster."""
        resources: Mapping[str, float] = ray.cluster_resources()
        needs = {"CPU": self.worker_cpus, "GPU": self.worker_gpus}
        most = min(int(resources.get(name, 0) / n) for name, n in needs.items() if n > 0)
        if most < 1:
            had = ", ".join(f"{resources.get(name, 0):g} {name}" for name in needs)
            wanted = ", ".join(f"{n:g} {name}" for name, n in needs.items())
            raise InputError(
                f"a worker asks for {wanted}, but the cluster has {had}; ask for less by "
                "--worker-cpus and --worker-gpus"
            )
        return most


class _Worker:
    """What a worker of Ray runs; it keeps its runner for all its blocks."""

    def __init__(self, shipped: list[Any], out: str) -> None:
        self._runner = Runner(_import_ray().get(shipped[0]), out)

    def __call__(self, batch: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        lines = [self._runner.run(Block.from_json(str(line))).to_json() for line in batch["block"]]
        return {"done": np.array(lines, dtype=object)}


def _import_ray() -> Any:  # noqa: ANN401  Ray is loaded where it is used
    """Import Ray, with its statistics of use switched off unless the user switched them on."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import_extra("ray.data", "ray[data]", "ray", "--engine ray")
    ray = import_module("ray")
    if tuple(map(int, ray.__version__.split(".")[:2])) < _LEAST_VERSION:
        raise MissingExtraError(
            f"ray[data] 2.52 or later, not {ray.__version__}, which lets anybody in", "ray",
            "--engine ray",
        )  # fmt: skip
    return ray
