"""Checks of requests before they are answered: host and origin, and the pace of an upload."""

import time
from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import anyio
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_SAFE_HEADERS = {
    # Nothing is loaded from elsewhere, and nobody else may show the page in a frame.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True)
class HostCheck:
    """Refuses requests from other pages, and tells the browser what this page may load.

    ``hosts``: names under which this page may be requested; None: any.
    """

    app: ASGIApp
    hosts: tuple[str, ...] | None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request by the application, or by a refusal; ``_SAFE_HEADERS`` are added."""

        async def send_safely(message: Message) -> None:
            """Send a part of the answer; its first one holds the headers."""
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_SAFE_HEADERS)
            await send(message)

        is_request = scope["type"] == "http"
        refusal = refuse_other_host(Request(scope), self.hosts) if is_request else None
        await (refusal or self.app)(scope, receive, send_safely)


def refuse_other_host(request: Request, hosts: tuple[str, ...] | None) -> Response | None:
    """Refuse a request under another host name, or sent by another page; else return None."""
    host = request.headers.get("host", "")
    try:
        name = urlsplit(f"//{host}").hostname
    except ValueError:  # such as half of a bracket
        name = None
    if hosts is not None and name not in hosts:
        message = (
            f"this page answers to {', '.join(hosts)}, not to {host!r}; start 'depthpose serve' "
            "with --host to name another"
        )
        return JSONResponse({"error": message}, 403)
    origin = request.headers.get("origin")
    if origin is not None and origin.partition("://")[2] != host:
        message = f"the request comes from another page, {origin}; open this one"
        return JSONResponse({"error": message}, 403)
    return None


GRACE_S = 10.0
"""Seconds after which an upload must have come at the least rate."""
LEAST_BYTES_S = 20_000
"""Least bytes a second of an upload; a slower one is ended, for it keeps others waiting."""
DISCONNECT_WAIT_S = 0.02
"""Seconds in which the server sees that a connection was closed."""


async def has_gone(receive: Receive) -> bool:
    """Whether the client of a request that was read whole has closed its connection."""
    # The rest of the request is read first, and the server gets a moment to see the end of a
    # connection from which it had stopped reading.
    with anyio.move_on_after(DISCONNECT_WAIT_S):
        while (await receive())["type"] != "http.disconnect":
            pass
        return True
    return False


def limit_pace(receive: Receive) -> Receive:
    """Make a function that receives a request's body, and refuses one that comes too slowly."""
    start = time.monotonic()
    size = 0

    async def receive_in_time() -> MutableMapping[str, Any]:
        """Receive a part of the body; 408 if it comes too late for the bytes before it."""
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
                # The rest of the body is not waited for.
                headers={"Connection": "close"},
            ) from error
        size += len(message.get("body", b""))
        return message

    return receive_in_time
