from collections.abc import Sequence

import pytest

from depthpose.core.errors import InputError
from depthpose.core.runner import Job, Results, run_jobs


class Lengths(Results[str, int]):
    """Results in memory; a word that is too long cannot be stored."""

    def __init__(self, **earlier: int) -> None:
        self.stored = dict(earlier)
        self.reasons: dict[str, str] = {}
        self.flushed: list[dict[str, int]] = []

    def is_finished(self, job: Job[str]) -> bool:
        return job.name in self.stored

    def store(self, job: Job[str], result: int) -> None:
        if result > 5:
            raise InputError(f"{job.name}: too long")
        self.stored[job.name] = result

    def store_failure(self, job: Job[str], error: InputError) -> None:
        self.reasons[job.name] = str(error)

    def flush(self) -> None:
        self.flushed.append(dict(self.stored))


def read(name: str) -> str:
    if name.startswith("lost"):
        raise InputError(f"{name}: cannot be read")
    return name


def jobs_of(*names: str) -> list[Job[str]]:
    return [Job(name=name, read=lambda name=name: read(name)) for name in names]


class Measure:
    """Gives lengths, and remembers what was measured together."""

    def __init__(self) -> None:
        self.batches: list[list[str]] = []

    def __call__(self, words: Sequence[str]) -> list[int | InputError]:
        self.batches.append(list(words))
        return [InputError(f"{word}: odd") if len(word) % 2 else len(word) for word in words]


@pytest.mark.parametrize("batch", [1, 2, 3, 10])
def test_every_job_has_an_outcome_in_the_order_of_the_jobs(batch: int) -> None:
    results = Lengths(done=4)
    measure = Measure()
    names = ["ab", "lost", "abc", "done", "abcd", "abcdef", "abcc"]
    outcomes = list(run_jobs(jobs_of(*names), measure, results, batch))
    assert [outcome.job.name for outcome in outcomes] == names
    assert [outcome.result for outcome in outcomes] == [2, None, None, None, 4, None, 4]
    reasons = {o.job.name: str(o.failure) for o in outcomes if o.failure is not None}
    assert reasons == results.reasons
    assert reasons == {
        "lost": "lost: cannot be read",
        "abc": "abc: odd",
        "abcdef": "abcdef: too long",
    }
    assert results.flushed == [{"done": 4, "ab": 2, "abcd": 4, "abcc": 4}]
    assert [word for words in measure.batches for word in words] == [
        "ab", "abc", "abcd", "abcdef", "abcc",
    ]  # fmt: skip
    assert max(map(len, measure.batches)) <= batch
    assert [] not in measure.batches


def test_what_was_done_before_an_interruption_is_stored_and_skipped_next_time() -> None:
    results = Lengths()
    started = run_jobs(jobs_of("ab", "abcd", "abcc"), Measure(), results)
    assert next(started).result == 2
    started.close()
    assert results.flushed == [{"ab": 2}]
    measure = Measure()
    again = list(run_jobs(jobs_of("ab", "abcd", "abcc"), measure, results))
    assert [outcome.result for outcome in again] == [None, 4, 4]
    assert measure.batches == [["abcd"], ["abcc"]]


def test_inputs_are_read_when_they_are_estimated_and_not_before() -> None:
    events: list[str] = []

    def read_noting(name: str) -> str:
        events.append(f"read {name}")
        return name

    jobs = [Job(name=n, read=lambda n=n: read_noting(n)) for n in ("ab", "abcd", "abcc", "cd")]
    for outcome in run_jobs(jobs, Measure(), Lengths(), batch=2):
        events.append(f"did {outcome.job.name}")  # noqa: PERF401  interleaved with reads
    assert events == [
        "read ab", "read abcd", "did ab", "did abcd",
        "read abcc", "read cd", "did abcc", "did cd",
    ]  # fmt: skip


def test_a_failure_that_is_raised_ends_the_run_and_stores_the_rest() -> None:
    class Strict(Lengths):
        def store_failure(self, job: Job[str], error: InputError) -> None:  # noqa: ARG002
            raise error

    results = Strict()
    with pytest.raises(InputError, match="lost: cannot be read"):
        list(run_jobs(jobs_of("ab", "lost", "abcd"), Measure(), results))
    assert results.flushed == [{"ab": 2}]
