"""The loop of a command over many inputs, in one process: depth, poses, searches, measurements.

Inputs that an earlier run finished are skipped, and one that fails does not stop the others. What
is computed for an input is a function; where results are stored is a :class:`Results`. Where a
launcher starts several processes, each runs this loop over its share of the inputs
(``core.processes``); workers on many machines have a loop of their own (``core.engine``).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from depthpose.core.errors import InputError

Input = TypeVar("Input")
Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True, eq=False)
class Job(Generic[Input]):
    """One input of a run, which is read when it is its turn."""

    name: str  #: name of its results, unique in a run
    read: Callable[[], Input]  #: reads the input; called only where there is no result yet
    source: Path | tuple[Path, ...] | None = None  #: its file or files; None: not read from files


class Results(ABC, Generic[Input, Result]):
    """Where the results of a run are stored, and which of them an earlier run has finished."""

    def is_finished(self, job: Job[Input]) -> bool:  # noqa: ARG002  for subclasses
        """Whether an earlier run stored the result of a job; by default none did."""
        return False

    @abstractmethod
    def store(self, job: Job[Input], result: Result) -> None:
        """Store the result of a job.

        Args:
            job: the job.
            result: the result.

        Raises:
            InputError: it cannot be stored: the job has then failed.
        """

    def store_failure(self, job: Job[Input], error: InputError) -> None:
        """Store why a job failed; by default nothing is. What it raises stops the whole run."""

    def flush(self) -> None:
        """Write what is still in memory; called when the run ends, also by an error."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome(Generic[Input, Result]):
    """The outcome of a job: a new result, a failure, or neither if an earlier run finished it."""

    job: Job[Input]
    result: Result | None = None
    failure: InputError | None = None


def run_jobs(
    jobs: Iterable[Job[Input]],
    estimate_many: Callable[[Sequence[Input]], Sequence[Result | InputError]],
    results: Results[Input, Result],
    batch: int = 1,
) -> Generator[Outcome[Input, Result], None, None]:
    """Run the jobs that are not finished, in batches, and yield the outcome of every job in order.

    Args:
        jobs: all jobs, the finished ones too; taken one by one, so that the frames of a video need
            not fit into memory.
        estimate_many: computes the results of some inputs: for each a result, or why it has none.
        results: where the results are stored.
        batch: number of inputs that ``estimate_many`` gets together.
    """
    read_jobs: list[tuple[Job[Input], Input | InputError]] = []

    def estimate_read_jobs() -> Generator[Outcome[Input, Result], None, None]:
        """Estimate the inputs that were read, store the results, and yield the outcomes."""
        inputs = [data for _, data in read_jobs if not isinstance(data, InputError)]
        estimates = iter(estimate_many(inputs) if inputs else ())
        for job, data in read_jobs:
            result = data if isinstance(data, InputError) else next(estimates)
            yield _store_outcome(job, data, result, results)
        read_jobs.clear()

    try:
        for job in jobs:
            if results.is_finished(job):
                yield from estimate_read_jobs()  # outcomes keep the order of the jobs
                yield Outcome(job=job)
                continue
            try:
                read_jobs.append((job, job.read()))
            except InputError as error:
                read_jobs.append((job, error))
            if len(read_jobs) == batch:
                yield from estimate_read_jobs()
        yield from estimate_read_jobs()
    finally:
        results.flush()


def _store_outcome(
    job: Job[Input],
    data: Input | InputError,
    result: Result | InputError,
    results: Results[Input, Result],
) -> Outcome[Input, Result]:
    """Store the result of a job, or its failure: of reading, of estimating or of storing."""
    try:
        if isinstance(data, InputError):
            raise data
        if isinstance(result, InputError):
            raise result
        results.store(job, result)
    except InputError as error:
        results.store_failure(job, error)
        return Outcome(job=job, failure=error)
    return Outcome(job=job, result=result)
