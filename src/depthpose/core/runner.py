"""One loop for every command over many inputs: depth, poses, searches and measurements.

What an earlier run finished is skipped, and an input that fails stops no other. How inputs are
estimated is a function; where results are stored is a :class:`Results`.
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
    """One input: what it is called, how it is read, and the files that it is read from."""

    name: str  #: unique in a run; its results bear it
    read: Callable[[], Input]  #: called only where there is no result yet
    source: Path | tuple[Path, ...] | None = None  #: file or files; None: not of files


class Results(ABC, Generic[Input, Result]):
    """Where the results of a run are stored, and which are there already."""

    def is_finished(self, job: Job[Input]) -> bool:  # noqa: ARG002  for classes to say
        """Whether an earlier run left the result of a job whole; by default none did."""
        return False

    @abstractmethod
    def store(self, job: Job[Input], data: Input, result: Result) -> None:
        """Store a result.

        Raises:
            InputError: it cannot be stored; the job has failed then.
        """

    def store_failure(self, job: Job[Input], error: InputError) -> None:
        """Store why a job has no result, where that is stored; raise the error to stop the run."""

    def flush(self) -> None:
        """Write what is still in memory: the run has ended, or was interrupted."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome(Generic[Input, Result]):
    """What became of a job: a new result, a failure, or neither, as an earlier run finished it."""

    job: Job[Input]
    result: Result | None = None
    failure: InputError | None = None


def run_jobs(
    jobs: Iterable[Job[Input]],
    estimate_many: Callable[[Sequence[Input]], Sequence[Result | InputError]],
    results: Results[Input, Result],
    batch: int = 1,
) -> Generator[Outcome[Input, Result], None, None]:
    """Do the jobs that are not finished, and yield what became of each, in the order of the jobs.

    Args:
        jobs: all that there are to do, the finished ones too; taken one by one, so that frames of a
            video need not fit into memory.
        estimate_many: gives a result, or the reason why there is none, for each input.
        results: where they are stored.
        batch: how many inputs are estimated together.
    """
    waiting: list[tuple[Job[Input], Input | InputError]] = []

    def finish_waiting() -> Generator[Outcome[Input, Result], None, None]:
        """Estimate the inputs that were read, store the results, and yield the outcomes."""
        inputs = [data for _, data in waiting if not isinstance(data, InputError)]
        estimated = iter(estimate_many(inputs) if inputs else ())
        for job, data in waiting:
            result = data if isinstance(data, InputError) else next(estimated)
            yield _stored(job, data, result, results)
        waiting.clear()

    try:
        for job in jobs:
            if results.is_finished(job):
                yield from finish_waiting()
                yield Outcome(job=job)
                continue
            try:
                waiting.append((job, job.read()))
            except InputError as error:
                waiting.append((job, error))
            if len(waiting) == batch:
                yield from finish_waiting()
        yield from finish_waiting()
    finally:
        results.flush()


def _stored(
    job: Job[Input],
    data: Input | InputError,
    result: Result | InputError,
    results: Results[Input, Result],
) -> Outcome[Input, Result]:
    """Store the result of a job, or why there is none."""
    try:
        if isinstance(data, InputError):
            raise data
        if isinstance(result, InputError):
            raise result
        results.store(job, data, result)
    except InputError as error:
        results.store_failure(job, error)
        return Outcome(job=job, failure=error)
    return Outcome(job=job, result=result)
