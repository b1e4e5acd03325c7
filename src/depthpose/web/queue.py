"""One computation at a time, first come, first served; uploads that are too slow are ended."""

import time
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, TypeVar

import anyio
from starlette.exceptions import HTTPException

Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Result = TypeVar("Result")

GRACE_S, LEAST_BYTES_S = 10.0, 20_000
"""An upload with fewer bytes a second, after so many seconds, is ended: it keeps others waiting."""
MOMENT_S = 0.02
_FULL = "too many requests wait for one computation; try again later"


class Queue:
    """Computations, one at a time.

    Args:
        most: requests that may wait for the one that is computed.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._one = anyio.CapacityLimiter(1)
        self._tickets: list[str] = []

    def refuse_full(self) -> None:
        """Refuse one more.

        Raises:
            HTTPException: too many wait.
        """
        if len(self._tickets) > self._most:  # one of them is at work
            raise HTTPException(503, _FULL)

    def before(self, ticket: str) -> int | None:
        """Count the computations that end before that of a ticket; None: it does not wait here."""
        return self._tickets.index(ticket) if ticket in self._tickets else None

    async def compute(
        self, ticket: str, work: Callable[[], Result], is_gone: Callable[[], Awaitable[bool]]
    ) -> Result | None:
        """Compute in a thread once all earlier computations are done.

        Args:
            ticket: name by which the client asks for its place in the queue.
            work: what is computed.
            is_gone: whether the client has left.

        Returns:
            The result; None where the client has left: then nothing was computed.

        Raises:
            HTTPException: too many wait.
        """
        self.refuse_full()
        self._tickets.append(ticket)
        try:
            async with self._one:
                if await is_gone():
                    return None
                return await anyio.to_thread.run_sync(work)
        finally:
            self._tickets.remove(ticket)


async def has_gone(receive: Receive) -> bool:
    """Whether the client of a request that was read whole has closed its connection.

    What is still to come of the request is read first, and the server gets a moment to see the
    end of a connection from which it had stopped reading.
    """
    with anyio.move_on_after(MOMENT_S):
        while (await receive())["type"] != "http.disconnect":
            pass
        return True
    return False


def paced(receive: Receive) -> Receive:
    """Give a request's body as long as it keeps a pace.

    Raises:
        HTTPException: when it is awaited: the client sends too slowly.
    """
    start, size = time.monotonic(), 0

    async def receive_in_time() -> MutableMapping[str, Any]:
        nonlocal size
        left_s = start + GRACE_S + size / LEAST_BYTES_S - time.monotonic()
        try:
            with anyio.fail_after(max(left_s, 0.0)):
                message = await receive()
        except TimeoutError as error:
            raise HTTPException(
                408,
                f"the upload came too slowly ({size} bytes in {time.monotonic() - start:.0f} s, "
                f"less than {LEAST_BYTES_S} a second); send smaller files",
                # What is still to come is not waited for.
                headers={"Connection": "close"},
            ) from error
        size += len(message.get("body", b""))
        return message

    return receive_in_time
