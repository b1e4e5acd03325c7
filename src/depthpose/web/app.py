"""The web application: checks of requests, a queue for one computation, routes, the server.

Host and origin, sizes and files are checked; uploads that are too slow are ended. Nothing is kept
on the disk.
"""

import asyncio
import ctypes
import io
import secrets
import socket
import threading
import time
import zipfile
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from dataclasses import dataclass, field
from functools import cache, partial
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar
from urllib.parse import urlsplit

import anyio
import h11
import uvicorn
from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image
from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders, UploadFile
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from depthpose import __version__
from depthpose.core.errors import InputError, MissingExtraError
from depthpose.depth.estimator import FakestereoNet
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.report.page import read_page_file
from depthpose.web.answer import KINDS, Answer, Form, keep_file, remove_paths
from depthpose.web.depth import answer_depth, depth_example
from depthpose.web.pose import answer_pose, pose_example

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_SAFE_HEADERS = {
    # Nothing is loaded from elsewhere, and nobody else may show the page in a frame.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_MOST_FILES = 6
_MOST_FIELDS = 30
_LONGEST_FIELD = 4096
"""Longest value of a field [bytes]."""


@dataclass(frozen=True)
class HostCheck:
    """Refuses requests from other pages, and tells the browser what this page may load.

    ``hosts``: names under which this page may be requested; None: any.
    """

    app: ASGIApp
    hosts: tuple[str, ...] | None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request by the application, or by a refusal; safe headers are added."""

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_SAFE_HEADERS)
            await send(message)

        is_request = scope["type"] == "http"
        refusal = refuse_other_host(Request(scope), self.hosts) if is_request else None
        await (refusal or self.app)(scope, receive, send_safely)


def refuse_other_host(request: Request, hosts: tuple[str, ...] | None) -> Response | None:
    """Refuse a request under another host name, or sent by another page; else give None."""
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


async def error_response(_: Request, error: Exception) -> Response:
    """Answer a refusal or an error with its message; an error's trace is on the terminal."""
    if isinstance(error, HTTPException):
        return JSONResponse({"error": error.detail}, error.status_code, error.headers)
    message = f"depthpose failed ({type(error).__name__}: {error}); see the server's terminal"
    return JSONResponse({"error": message}, 500)


Result = TypeVar("Result")

GRACE_S = 10.0
"""Seconds after which an upload must have come at the least rate."""
LEAST_BYTES_S = 20_000
"""Least bytes a second of an upload; a slower one is ended, for it keeps others waiting."""
DISCONNECT_WAIT_S = 0.02
"""Seconds in which the server sees that a connection was closed."""
_QUEUE_FULL = "too many requests wait for one computation; try again later"
_STOP_S = 10.0
"""Seconds that a computation has to end once it was stopped: one step of it may be long."""


class _Stopped(BaseException):
    """Raised in the thread of a computation to end it; ``except Exception`` does not catch it."""


class TookTooLong(Exception):  # noqa: N818  what happened
    """A computation was stopped, for it took longer than allowed."""


def run_in_time(work: Callable[[], Result], most_s: float) -> Result:
    """Compute in a thread, and stop it after a time limit.

    A stopped computation ends at the next step of the interpreter. If it is within a long call of a
    library, it is left to run on beside later computations until that call returns.

    Raises:
        TookTooLong: it did not end within ``most_s`` seconds.
    """
    results = list[Result]()
    errors = list[BaseException]()

    def run() -> None:
        try:
            results.append(work())
        except BaseException as error:  # noqa: BLE001  raised again in the caller's thread
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(most_s)
    if thread.is_alive():
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
    most_s: float  #: longest time of one computation, which is stopped then
    limiter: anyio.CapacityLimiter = field(default_factory=partial(anyio.CapacityLimiter, 1))
    #: tickets of the client that is served and of those that wait
    tickets: list[str] = field(default_factory=list)

    @property
    def is_full(self) -> bool:
        """Whether no further request may wait."""
        return len(self.tickets) > self.max_waiting

    async def compute(
        self,
        ticket: str,
        work: Callable[[], Result],
        has_client_gone: Callable[[], Awaitable[bool]],
    ) -> Result | None:
        """Compute in a thread once all earlier computations are done.

        Args:
            ticket: word by which the client asks for its position in the queue.
            work: the computation.
            has_client_gone: whether nobody waits for the result any longer.

        Returns:
            The result; None if the client has gone before its turn.

        Raises:
            HTTPException: 503: too many wait, or the computation takes too long.
        """
        if self.is_full:
            raise HTTPException(503, _QUEUE_FULL)
        self.tickets.append(ticket)
        try:
            async with self.limiter:
                if await has_client_gone():
                    return None
                return await anyio.to_thread.run_sync(run_in_time, work, self.most_s)
        except TookTooLong as error:
            raise HTTPException(
                503,
                f"the computation took more than {self.most_s:g} s and was stopped; send a smaller "
                "picture, or start 'depthpose serve' with a larger --max-seconds",
            ) from error
        finally:
            self.tickets.remove(ticket)


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


_MOST_DIGITS = 18
"""Most digits of a Content-Length: Python reads no number of thousands of digits."""
TICKET = "x-ticket"
"""Header of a request: a random name, by which the page asks for its position in the queue."""
_STORED_ANSWERS = 3
"""Answers whose files stay in memory for downloads."""
_MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".json": "application/json",
          ".zip": "application/zip"}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Limits:
    """The limits beyond which the page refuses a request."""

    upload_bytes: int = 64 * 10**6
    """All files of one request together."""
    waiting: int = 4
    """Requests that may wait for the one that is computed."""
    compute_s: float = 120.0
    """Seconds of one computation: longer ones are stopped."""
    uploads: int = 32
    """Requests whose files may arrive at the same time."""
    hosts: tuple[str, ...] | None = LOOPBACK
    """Host names under which a browser may request the page; None: any. They keep other web pages
    in the same browser from reading answers by a name of their own (DNS rebinding)."""


class Handlers:
    """The handlers of the routes, with the networks and the files of the latest answers."""

    def __init__(self, depth: FakestereoNet, pose: GeoPoseNet, limits: Limits) -> None:
        self._limits = limits
        self._estimators: dict[str, Callable[[Form], Answer]] = {
            "depth": partial(answer_depth, net=depth),
            "pose": partial(answer_pose, net=pose),
        }
        self._examples: dict[str, Callable[[], dict[str, Any]]] = {
            "depth": cache(depth_example),
            "pose": cache(partial(pose_example, pose)),
        }
        self._queue = Queue(limits.waiting, limits.compute_s)
        self._upload_count = 0
        self._stored_files: OrderedDict[str, Mapping[str, bytes]] = OrderedDict()

        # The page and its parts, as they are sent.
        loader = PackageLoader("depthpose.web", ".")
        template = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
        page = template.get_template("page.html").render(
            version=__version__,
            objects=pose.objects,
            kinds=KINDS,
            limit_mb=limits.upload_bytes // 10**6,
            has_one_image=depth.synthesiser is not None,
            has_pair=depth.matcher is not None,
        )
        folder = Path(__file__).parent
        self._assets = {
            "": ("text/html", page),
            "page.css": ("text/css", read_page_file("page.css") + (folder / "web.css").read_text()),
            "viewer.js": ("text/javascript", read_page_file("viewer.js")),
            "web.js": ("text/javascript", (folder / "web.js").read_text()),
        }

    async def asset(self, request: Request) -> Response:
        """Answer with the page, a script or the style."""
        name = request.path_params.get("name", "")
        if name not in self._assets:
            raise HTTPException(404, f"there is no {name!r}; the page is at /")
        media_type, text = self._assets[name]
        return Response(text, media_type=media_type)

    async def example(self, request: Request) -> Response:
        """Answer with an example: files and fields of a form, made at the first request."""
        kind = request.path_params["kind"]
        if kind not in self._examples:
            raise HTTPException(404, f"only {' and '.join(self._examples)} are estimated here")
        make_example = self._examples[kind]
        try:
            content = await self._queue.compute(
                "", make_example, partial(has_gone, request.receive)
            )
        except InputError as error:
            raise HTTPException(400, str(error)) from error
        return JSONResponse(content)

    async def position(self, request: Request) -> Response:
        """Answer with the number of computations before that of a ticket, or null if none waits."""
        ticket = request.path_params["ticket"]
        waiting = self._queue.tickets
        return JSONResponse({"before": waiting.index(ticket) if ticket in waiting else None})

    async def estimate(self, request: Request) -> Response:
        """Estimate for a form, and answer with the result as JSON; 400 if the client has gone."""
        self._refuse_large_body(request)
        kind = request.path_params["kind"]
        if kind not in self._estimators:
            raise HTTPException(404, f"only {' and '.join(self._estimators)} are estimated here")
        if self._queue.is_full:  # before the files are received in vain
            raise HTTPException(503, _QUEUE_FULL)
        with TemporaryDirectory(prefix="depthpose-") as folder:
            try:
                form = await self._receive_form(request, Path(folder))
                ticket = request.headers.get(TICKET, "")
                work = partial(self._estimators[kind], form)
                answer = await self._queue.compute(ticket, work, partial(has_gone, request.receive))
            except (InputError, MissingExtraError) as error:
                raise HTTPException(400, remove_paths(str(error), Path(folder))) from error
            except ClientDisconnect:
                answer = None
        if answer is None:
            return Response(status_code=400)
        return JSONResponse(self._store(answer))

    def _refuse_large_body(self, request: Request) -> None:
        """Refuse a body that is too large before it is read, by the size that is announced.

        A server reads no more than that.
        """
        text = request.headers.get("content-length", "")
        if not text.isdecimal() or "transfer-encoding" in request.headers:
            raise HTTPException(
                411, "the request has no Content-Length, or comes in chunks; send it whole, with "
                "its size",
            )  # fmt: skip
        size = int(text) if len(text) <= _MOST_DIGITS else 10**_MOST_DIGITS
        max_size = self._limits.upload_bytes
        if size > max_size:
            raise HTTPException(
                413,
                f"the files are {size / 1e6:.1f} MB together, more than the {max_size / 1e6:.0f} "
                "MB allowed; send smaller ones, or start 'depthpose serve' with a larger "
                "--max-upload-mb",
            )

    async def _receive_form(self, request: Request, folder: Path) -> Form:
        """Receive the fields of a form, and write its files into a folder.

        503 where too many uploads arrive at the same time, 408 where this one is too slow.
        """
        if self._upload_count >= self._limits.uploads:
            raise HTTPException(503, "too many uploads at the same time; try again later")
        self._upload_count += 1
        try:
            fields: dict[str, str] = {}
            files: dict[str, Path] = {}
            async with Request(request.scope, limit_pace(request.receive)).form(
                max_files=_MOST_FILES, max_fields=_MOST_FIELDS, max_part_size=_LONGEST_FIELD
            ) as form:
                for name, value in form.multi_items():
                    if not isinstance(value, UploadFile):
                        fields[name] = value
                    elif name in files:
                        raise InputError(f"{name}: two files; choose one")
                    elif value.filename:
                        files[name] = keep_file(folder, name, value.filename, await value.read())
            return Form(folder=folder, fields=fields, files=files)
        finally:
            self._upload_count -= 1

    async def download(self, request: Request) -> Response:
        """Answer with a file of one of the latest answers, or with all of them as a ZIP."""
        key = request.path_params["key"]
        name = request.path_params["name"]
        files = self._stored_files.get(key)
        if files is None or name not in {*files, "all.zip"}:
            raise HTTPException(
                404,
                f"only the last {_STORED_ANSWERS} answers are kept, and not {name!r}; ask again",
            )
        data = files[name] if name in files else _pack_files(files)
        media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        return Response(data, media_type=media_type, headers=headers)

    def _store(self, answer: Answer) -> dict[str, Any]:
        """Store the files of an answer in place of the oldest ones; give what the page shows."""
        key = secrets.token_urlsafe(12)
        self._stored_files[key] = answer.files
        while len(self._stored_files) > _STORED_ANSWERS:
            self._stored_files.popitem(last=False)
        pictures: list[dict[str, Any]] = []
        for picture in answer.pictures:
            with Image.open(io.BytesIO(answer.files[picture.file])) as image:
                size = list(image.size)  # with it, the page does not move while pictures load
            scale = None if picture.scale is None else vars(picture.scale)
            pictures.append({**vars(picture), "scale": scale, "size": size})
        return {
            "ok": answer.is_ok,
            "said": answer.sentence,
            "terms": answer.terms,
            "facts": list(answer.facts),
            "tables": dict(answer.tables),
            "pictures": pictures,
            "scene": answer.scene.encode(),
            "files": [{"name": name, "bytes": len(data)} for name, data in answer.files.items()],
            "folder": f"results/{key}/",
        }


def _pack_files(files: Mapping[str, bytes]) -> bytes:
    """Pack files into a ZIP, uncompressed: most of them are compressed already."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return packed.getvalue()


def make_app(depth: FakestereoNet, pose: GeoPoseNet, limits: Limits | None = None) -> Starlette:
    """Build the application, with networks for the tabs Depth and Pose."""
    limits = Limits() if limits is None else limits
    handlers = Handlers(depth, pose, limits)
    return Starlette(
        routes=[
            Route("/", handlers.asset),
            Route("/assets/{name}", handlers.asset),
            Route("/examples/{kind}", handlers.example),
            Route("/estimate/{kind}", handlers.estimate, methods=["POST"]),
            Route("/queue/{ticket}", handlers.position),
            Route("/results/{key}/{name}", handlers.download),
        ],
        middleware=[Middleware(HostCheck, hosts=limits.hosts)],
        exception_handlers={HTTPException: error_response, Exception: error_response},
    )


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
    """Open a listening socket; port 0 takes a free one.

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


def address_and_hosts(
    host: str, listener: socket.socket
) -> tuple[IPv4Address | IPv6Address, tuple[str, ...] | None]:
    """Give the address of a socket, and the host names under which its page may be requested.

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
