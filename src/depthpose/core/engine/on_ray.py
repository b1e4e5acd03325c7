"""Blocks on a Ray cluster: Ray Data maps them over a pool of workers, each of which starts once.

Ray restarts a worker that dies and does its block again; where a node is lost, others take over.
A block's outcome is a line of text, so that neither queues nor results fill the memory.
"""

import os
import secrets
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from depthpose.core.engine.plan import Block
from depthpose.core.engine.shard import ShardFormat
from depthpose.core.engine.work import Done, Runner, Work
from depthpose.core.errors import InputError, MissingExtraError

_LEAST_VERSION = (2, 52)
"""Since which Ray has passwords."""


@dataclass(frozen=True, kw_only=True)
class RayEngine:
    """Does blocks by Ray Data.

    Attributes:
        address: of a running cluster, ``auto`` for the one of this machine; None starts one here,
            and ends it afterwards.
        workers: at most; None: as many as fit into the cluster when the job begins.
        worker_cpus: cores that a worker asks for.
        worker_gpus: GPUs that it asks for; a part lets workers share one.
    """

    address: str | None = None
    workers: int | None = None
    worker_cpus: float = 1.0
    worker_gpus: float = 0.0

    def __call__(
        self, blocks: Sequence[Block], work: Work, out: str, form: ShardFormat
    ) -> Iterator[Done]:
        """Do blocks, and give what became of each as it is done.

        Raises:
            InputError: no cluster at the address, or one worker does not fit into it.
            MissingExtraError: Ray is not installed.
        """
        if self.address is None:
            _keep_to_this_machine()
        ray = _import_ray()
        with _connected(ray, self.address, self._cores_here()):
            # In a list the work stays a reference, which a worker that starts again reads again.
            shipped = [ray.put(work)]
            lines = [{"block": block.to_json()} for block in blocks]
            rows = (
                ray.data.from_items(lines, override_num_blocks=len(lines))
                .map_batches(
                    _Worker,
                    batch_size=1,
                    fn_constructor_args=(shipped, out, form),
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
                    yield Done.from_json(row["done"])
            except ray.exceptions.RayError as error:
                raise _cause(error) from error

    def _cores_here(self) -> float | None:
        return None if self.workers is None else max(1.0, self.workers * self.worker_cpus)

    def _capacity(self, ray: Any) -> int:  # noqa: ANN401  Ray is loaded where it is used
        """Say how many workers fit into the cluster."""
        there: Mapping[str, float] = ray.cluster_resources()
        asked = {"CPU": self.worker_cpus, "GPU": self.worker_gpus}
        most = min(int(there.get(name, 0) / n) for name, n in asked.items() if n > 0)
        if most < 1:
            had = ", ".join(f"{there.get(name, 0):g} {name}" for name in asked)
            wanted = ", ".join(f"{n:g} {name}" for name, n in asked.items())
            raise InputError(
                f"a worker asks for {wanted}, but the cluster has {had}; ask for less by "
                "--worker-cpus and --worker-gpus"
            )
        return most


class _Worker:
    """What Ray runs: a runner that lives as long as its process."""

    def __init__(self, shipped: list[Any], out: str, form: ShardFormat) -> None:
        self._runner = Runner(_import_ray().get(shipped[0]), out, form)

    def __call__(self, batch: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        lines = [self._runner.run(Block.from_json(str(line))).to_json() for line in batch["block"]]
        return {"done": np.array(lines, dtype=object)}


@contextmanager
def _connected(ray: Any, address: str | None, cores: float | None) -> Iterator[None]:  # noqa: ANN401
    """Stay connected to a cluster; one that was started for this ends with it."""
    is_ours = not ray.is_initialized()
    if is_ours:
        here = {"num_cpus": cores, "include_dashboard": False} if address is None else {}
        try:
            _refuse_unreachable(address)
            ray.init(address=address or "local", **here)
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(
                f"--address {address}: no Ray cluster answers there ({error}); start one by 'ray "
                "start --head', or omit the address"
            ) from error
    try:
        yield
    finally:
        if is_ours:
            ray.shutdown()


def _refuse_unreachable(address: str | None) -> None:
    """Connect to HOST:PORT first: Ray waits for minutes where nothing answers."""
    host, _, port = (address or "").rpartition(":")
    if host and "/" not in host and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=10).close()


def _cause(error: BaseException) -> BaseException:
    """Find the error of ours that a worker raised behind Ray's own, if there is one."""
    inner: BaseException | None = error
    while inner is not None:
        if isinstance(inner, InputError):
            return InputError(str(getattr(inner, "cause", inner)))
        inner = getattr(inner, "cause", None) or inner.__cause__
    return error


def _keep_to_this_machine() -> None:
    """Let a cluster that is started here listen to this machine alone, and ask for a password.

    Whoever reaches a port of Ray may run any code. Ray reads these variables as it is imported.
    """
    # Without clusters of several machines, which is what its name is about, a node is 127.0.0.1.
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    os.environ.setdefault("RAY_AUTH_MODE", "token")
    if "RAY_AUTH_TOKEN_PATH" not in os.environ:
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))


def _import_ray() -> Any:  # noqa: ANN401  Ray is loaded where it is used
    """Import Ray, which sends no statistics of its use unless it is set to.

    Raises:
        MissingExtraError: it is not installed, or too old to ask for a password.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import_module("ray.data")
        ray = import_module("ray")
    except ImportError as error:
        raise MissingExtraError("ray[data]", "ray", "--engine ray") from error
    if tuple(map(int, ray.__version__.split(".")[:2])) < _LEAST_VERSION:
        raise MissingExtraError(
            f"ray[data] 2.52 or later, not {ray.__version__}, which lets anybody in", "ray",
            "--engine ray",
        )  # fmt: skip
    return ray
