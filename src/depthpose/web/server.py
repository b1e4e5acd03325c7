"""The server: its socket, the hosts of its page, and its time limits for connections."""

import asyncio
import socket
from ipaddress import IPv4Address, IPv6Address, ip_address

import h11
import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.h11_impl import H11Protocol

from depthpose.core.errors import InputError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Names of this machine itself."""

_CONNECTIONS = 400
"""Connections at once; more are answered with 503 before anything of them is read."""
_SHUTDOWN_S = 2
"""Seconds that open connections have to finish after Ctrl+C."""
HEAD_S = 10.0
"""Seconds in which the head of a request must come: a connection that sends none counts among
those that are open at once."""


class TimedProtocol(H11Protocol):
    """Closes a connection on which no head of a request comes in time; uvicorn would wait on."""

    _closing: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Start to wait for the head of the first request."""
        super().connection_made(transport)  # pyright: ignore[reportArgumentType]
        self._wait_for_head()

    def data_received(self, data: bytes) -> None:
        """Pass data on; a head that is not whole does not stop the timer."""
        super().data_received(data)
        self._wait_for_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        super().connection_lost(exc)
        if self._closing is not None:
            self._closing.cancel()

    def _wait_for_head(self) -> None:
        """Start the timer of a request's head if it has not arrived; stop it if it has."""
        is_waiting = self.conn.their_state is h11.IDLE
        if is_waiting and self._closing is None:
            self._closing = self.loop.call_later(HEAD_S, self.transport.close)
        elif not is_waiting and self._closing is not None:
            self._closing.cancel()
            self._closing = None


def open_socket(host: str, port: int) -> socket.socket:
    """Open a listening socket; port 0 takes a free port.

    Raises:
        InputError: the host or port cannot be used.
    """
    if not 0 <= port < 2**16:
        raise InputError(f"port {port}: there are 0 (any that is free) to 65535; 8000 is usual")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        # It listens at once: a browser that comes while weights are loaded waits.
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise InputError(
            f"{host}:{port} cannot be used: {error}; choose another --port (0: any that is free) "
            "or --host (127.0.0.1: this machine alone)"
        ) from error


def find_address_and_hosts(
    host: str, listener: socket.socket
) -> tuple[IPv4Address | IPv6Address, tuple[str, ...] | None]:
    """Find the address of a socket, and the host names under which its page may be requested.

    These are None (any) where the socket listens on all addresses. That is told by the socket and
    not by ``host``: '', '0' and '0x0' mean all addresses too.
    """
    address = ip_address(listener.getsockname()[0])
    if isinstance(address, IPv6Address):
        address = address.ipv4_mapped or address
    if address.is_unspecified:
        return address, None
    return address, (*LOOPBACK, host.lower(), str(address))


def run(app: Starlette, listener: socket.socket) -> None:
    """Answer requests until the process is stopped; only errors are logged."""
    config = uvicorn.Config(
        app,
        http=TimedProtocol,
        log_level="error",
        access_log=False,
        server_header=False,
        limit_concurrency=_CONNECTIONS,
        timeout_graceful_shutdown=_SHUTDOWN_S,
    )
    uvicorn.Server(config).run(sockets=[listener])
