"""A queue for one computation at a time, and its time limit."""

import ctypes
import threading
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

import anyio
from starlette.exceptions import HTTPException

Result = TypeVar("Result")

QUEUE_FULL = "too many requests wait for one computation; try again later"
_STOP_S = 10.0
"""Seconds that a computation has to end once it was stopped: one step of it may be long."""


class _Stopped(BaseException):
    """Raised in the thread of a computation to end it; ``except Exception`` does not catch it."""


class TookTooLong(Exception):  # noqa: N818  what happened
    """A computation was stopped, for it took longer than allowed."""


def run_in_time(computation: Callable[[], Result], max_s: float) -> Result:
    """Compute in a thread, and return the result; stop it after ``max_s`` seconds.

    A stopped computation ends at the next step of the interpreter. If it is within a long call of a
    library, it is left to run on beside later computations until that call returns.

    Raises:
        TookTooLong: it did not end in time.
    """
    # One of the two gets an item, unless the thread does not end.
    results = list[Result]()
    errors = list[BaseException]()

    def run() -> None:
        try:
            results.append(computation())
        except BaseException as error:  # noqa: BLE001  raised again in the caller's thread
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(max_s)
    if thread.is_alive():
        # CPython raises the exception in that thread before its next bytecode.
        assert thread.ident is not None
        thread_id = ctypes.c_ulong(thread.ident)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(thread_id, ctypes.py_object(_Stopped))
        thread.join(_STOP_S)
    if results:
        return results[0]
    if errors and not isinstance(errors[0], _Stopped):
        raise errors[0]
    raise TookTooLong


@dataclass(frozen=True, eq=False)
class Queue:
    """Computations, one at a time; a limited number of requests may wait for one."""

    max_waiting: int
    max_s: float  #: longest time of one computation, which is stopped then
    limiter: anyio.CapacityLimiter = field(default_factory=partial(anyio.CapacityLimiter, 1))
    #: tickets of the client that is served and of those that wait
    tickets: list[str] = field(default_factory=list)

    @property
    def is_full(self) -> bool:
        """Whether no further request may wait."""
        return len(self.tickets) > self.max_waiting  # one of them is served

    async def compute(
        self,
        ticket: str,
        computation: Callable[[], Result],
        has_client_gone: Callable[[], Awaitable[bool]],
    ) -> Result | None:
        """Compute in a thread once all earlier computations are done.

        Args:
            ticket: word by which the client asks for its position in the queue.
            computation: a function without arguments.
            has_client_gone: whether nobody waits for the result any longer.

        Returns:
            The result; None if the client has gone before its turn.

        Raises:
            HTTPException: 503: too many wait, or the computation takes too long.
        """
        if self.is_full:
            raise HTTPException(503, QUEUE_FULL)
        self.tickets.append(ticket)
        try:
            async with self.limiter:
                if await has_client_gone():
                    return None
                return await anyio.to_thread.run_sync(run_in_time, computation, self.max_s)
        except TookTooLong as error:
            raise HTTPException(
                503,
                f"the computation took more than {self.max_s:g} s and was stopped; send a smaller "
                "picture, or start 'depthpose serve' with a larger --max-seconds",
            ) from error
        finally:
            self.tickets.remove(ticket)
