"""Options and summaries of commands that can run on a cluster."""

import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from depthpose.cli.arguments import refuse_below, shown_as
from depthpose.core.errors import InputError

if TYPE_CHECKING:  # --help imports this module and must answer at once
    from depthpose.core.engine import Computation, JobInputs, RayEngine, ShardRecord


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """The choice of where the work is done: in this process, or by Ray."""

    engine: Literal["here", "ray"] = "here"
    """here: in this process, a file for each result. ray: by workers of a Ray cluster (an extra),
    many results to a shard, OUT/shards/*.tar, listed in OUT/manifest.csv; inputs and OUT may be
    URLs (s3://, gs://, file://), inputs also WebDataset shards (*.tar) or a manifest (*.csv)."""
    address: Annotated[str | None, shown_as(metavar="HOST:PORT")] = None
    """running Ray cluster: auto, or HOST:PORT; without it one is started on this machine."""
    workers: int | None = None
    """largest number of workers; by default as many as fit into the cluster."""
    worker_cpus: float = 1.0
    """cores of each worker."""
    worker_gpus: float = 0.0
    """GPUs of each worker (with --device cuda); with 0.5 two share one."""
    block: int = 64
    """inputs of a shard, which are done again when their worker dies."""

    def refuse_unusable(self) -> None:
        """Refuse too few workers, cores, GPUs or inputs of a shard."""
        if self.workers is not None:
            refuse_below(1, "--workers", self.workers, "4")
        refuse_below(0, "--worker-cpus", self.worker_cpus, "1")
        refuse_below(0, "--worker-gpus", self.worker_gpus, "1")
        refuse_below(1, "--block", self.block, "64")
        if not self.worker_cpus + self.worker_gpus:
            raise InputError("a worker needs a core or a GPU; give --worker-cpus 1")

    def build(self) -> "RayEngine":
        """Build the engine of these options."""
        from depthpose.core.engine import RayEngine

        return RayEngine(
            address=self.address, workers=self.workers,
            worker_cpus=self.worker_cpus, worker_gpus=self.worker_gpus,
        )  # fmt: skip

    def run(
        self, computation: "Computation", inputs: "JobInputs", out: str, settings: dict[str, Any]
    ) -> "Sequence[ShardRecord]":
        """Process all inputs by Ray, and return the records of the shards of their results.

        Args:
            computation: what is computed for each input.
            inputs: the inputs.
            out: folder of the results, by path or URL.
            settings: JSON values that decide the results.
        """
        from depthpose.core.engine import ShardedJob, run_job

        job = ShardedJob(
            computation=computation,
            inputs=inputs.listed,
            tars=inputs.tars,
            out=out,
            settings=settings,
            block_size=self.block,
        )
        return run_job(job, self.build())


@dataclass(frozen=True, kw_only=True)
class PackedWeights:
    """The content of a weights file in memory, to be sent to workers of other machines."""

    name: str  #: name of the file
    data: bytes = field(repr=False)

    @classmethod
    def read(cls, weights: str) -> "PackedWeights":
        """Read weights by name or file.

        Raises:
            InputError: there are no such weights.
        """
        from depthpose.core.checkpoint import find_weights

        path = find_weights(weights)
        return cls(name=path.name, data=path.read_bytes())

    @contextmanager
    def unpacked(self) -> Iterator[str]:
        """Write the weights to a temporary file, which exists inside the block; yield its path."""
        from depthpose.core.files.disk import refused_write

        with tempfile.TemporaryDirectory(prefix="depthpose-") as folder:
            path = Path(folder) / self.name
            with refused_write(path):
                path.write_bytes(self.data)
            yield str(path)


_MAX_LISTED_FAILURES = 20
"""Failed inputs that are printed; manifest.csv lists all."""


def print_shards(shards: "Sequence[ShardRecord]", out: str, noun: str) -> int:
    """Print the failed inputs and how many are done, and return the exit code, 1 if any failed.

    ``noun``: the word for the inputs, in the plural.
    """
    failures = [failure for shard in shards for failure in shard.failures]
    for name, reason in failures[:_MAX_LISTED_FAILURES]:
        print(f"depthpose: failed: {name}: {reason}", file=sys.stderr)
    if len(failures) > _MAX_LISTED_FAILURES:
        print(f"depthpose: {len(failures)} failed; all are in manifest.csv", file=sys.stderr)
    total = sum(len(shard.entries) for shard in shards)
    print(f"{total - len(failures)} of {total} {noun} are in {len(shards)} shards of {out}")
    return 1 if failures else 0
