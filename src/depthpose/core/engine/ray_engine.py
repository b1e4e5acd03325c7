"""The engine of a sharded job that runs its workers by Ray Data.

Ray Data maps blocks over a pool of workers, each of which starts once. Ray restarts a worker that
dies and processes its block again; where a node is lost, others take over. Between processes a
block and its record are a line of text, so that neither queues nor results fill the memory.
"""

import os
import secrets
import socket
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from depthpose.core.engine.inputs import Block
from depthpose.core.engine.shards import BlockProcessor, Computation, ShardRecord
from depthpose.core.errors import InputError, MissingExtraError, import_extra

_LEAST_VERSION = (2, 52)  # the first version of Ray that has passwords
_CONNECT_TIMEOUT_S = 10
_BLOCKS_A_WORKER = 2  # blocks that a worker has at a time: the next waits while one is processed


@dataclass(frozen=True, kw_only=True)
class RayEngine:
    """Processes blocks with Ray Data, on this machine or a cluster."""

    address: str | None = None  #: a running cluster, or ``auto``; None starts one for this job
    workers: int | None = None  #: most workers; None: as many as fit when the job begins
    worker_cpus: float = 1.0  #: cores that a worker asks for
    worker_gpus: float = 0.0  #: GPUs that it asks for; a fraction lets workers share one

    def __call__(
        self, blocks: Sequence[Block], computation: Computation, out: str
    ) -> Iterator[ShardRecord]:
        """Process blocks, and yield the record of each as it is finished.

        Args:
            blocks: at least one.
            computation: what is computed of their inputs.
            out: folder of the results, by path or URL.

        Raises:
            InputError: no cluster at the address, or one worker does not fit into it; or a worker
                raised it.
            MissingExtraError: Ray is not installed.
        """
        if self.address is None:
            _protect_local_cluster()
        ray = _import_ray()
        starts_ray = not ray.is_initialized()
        if starts_ray:
            self._connect(ray)
        try:
            # In a list it stays a reference, which a restarted worker reads again; Ray would
            # replace a bare one by the object.
            computation_reference = [ray.put(computation)]
            most_workers = self.workers or self._count_fitting_workers(ray)
            pool = ray.data.ActorPoolStrategy(
                min_size=1,
                max_size=min(most_workers, len(blocks)),
                max_tasks_in_flight_per_actor=_BLOCKS_A_WORKER,
            )
            lines = [{"block": block.to_json()} for block in blocks]
            records = ray.data.from_items(lines, override_num_blocks=len(lines)).map_batches(
                _Worker,
                batch_size=1,
                fn_constructor_args=(computation_reference, out),
                compute=pool,
                num_cpus=self.worker_cpus,
                num_gpus=self.worker_gpus,
            )
            try:
                for row in records.iter_rows():
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
        """Connect to the cluster of ``address``, or start Ray on this machine.

        Raises:
            InputError: no cluster answers there.
        """
        options: dict[str, Any] = {}
        if self.address is None:
            # None: all cores of this machine.
            cores = None if self.workers is None else max(1.0, self.workers * self.worker_cpus)
            options = {"num_cpus": cores, "include_dashboard": False}
        try:
            host, _, port = (self.address or "").rpartition(":")
            if host and "/" not in host and port.isdecimal():
                # HOST:PORT, not ray://...: tried first, because Ray waits for minutes where nothing
                # answers.
                socket.create_connection((host, int(port)), timeout=_CONNECT_TIMEOUT_S).close()
            ray.init(address=self.address or "local", **options)
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(
                f"--address {self.address}: no Ray cluster answers there ({error}); start one by "
                "'ray start --head', or omit the address"
            ) from error

    def _count_fitting_workers(self, ray: Any) -> int:  # noqa: ANN401
        """Count the workers that fit into the cluster by their cores and GPUs.

        Raises:
            InputError: not even one does.
        """
        resources: Mapping[str, float] = ray.cluster_resources()
        needs = {"CPU": self.worker_cpus, "GPU": self.worker_gpus}
        workers = min(
            int(resources.get(name, 0) / need) for name, need in needs.items() if need > 0
        )
        if workers < 1:
            available = ", ".join(f"{resources.get(name, 0):g} {name}" for name in needs)
            needed = ", ".join(f"{need:g} {name}" for name, need in needs.items())
            raise InputError(
                f"a worker asks for {needed}, but the cluster has {available}; ask for less by "
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
    """Find the :class:`InputError` that a worker raised among the causes of an error of Ray."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, InputError):
        cause = getattr(cause, "cause", None) or cause.__cause__
    return cause


class _Worker:
    """A worker of Ray, which loads its network once for all of its blocks."""

    def __init__(self, computation_reference: list[Any], out: str) -> None:
        computation = _import_ray().get(computation_reference[0])
        self._processor = BlockProcessor(computation, out)

    def __call__(self, batch: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Process the blocks of a batch; return their records, as lines of JSON."""
        records: list[str] = []
        for line in batch["block"]:
            record = self._processor.process(Block.from_json(str(line)))
            records.append(record.to_json())
        return {"record": np.array(records, dtype=object)}


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
