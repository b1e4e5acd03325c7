"""The process that answers: a socket of this machine, and uvicorn on it."""

import socket
from ipaddress import IPv4Address, IPv6Address, ip_address

import uvicorn
from starlette.applications import Starlette

from depthpose.core.errors import InputError
from depthpose.web.guard import LOOPBACK

_CONNECTIONS = 400
"""At once; beyond, a connection is answered with 503 before anything of it is read."""
_LEAVE_S = 2
"""Seconds that open connections have to finish after Ctrl+C."""


def open_socket(host: str, port: int) -> socket.socket:
    """Take a port before anything heavy is loaded; port 0 takes a free one.

    Raises:
        InputError: there is no such address here, or the port is in use.
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


def taken_address(taken: socket.socket) -> IPv4Address | IPv6Address:
    """Give the address that was taken, however it was written."""
    found = ip_address(taken.getsockname()[0])
    return found.ipv4_mapped or found if isinstance(found, IPv6Address) else found


def known_names(host: str, address: IPv4Address | IPv6Address) -> tuple[str, ...] | None:
    """Give the host names under which a page may be requested; None: any, it is open to all.

    Args:
        host: the address as the user wrote it. '', '0', '0x0' and '::0' mean all addresses too, so
            it does not say whether the page is open.
        address: what was taken for it.
    """
    return None if address.is_unspecified else (*LOOPBACK, host.lower(), str(address))


def run(app: Starlette, taken: socket.socket) -> None:
    """Answer requests until the process is stopped; only errors are logged."""
    config = uvicorn.Config(
        app,
        log_level="error",
        access_log=False,
        server_header=False,
        limit_concurrency=_CONNECTIONS,
        timeout_graceful_shutdown=_LEAVE_S,
    )
    uvicorn.Server(config).run(sockets=[taken])
