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
from depthpose.report.page import page_file
from depthpose.web.answer import KINDS, Answer, Form, keep_file, without_paths
from depthpose.web.depth import answer_depth, depth_example
from depthpose.web.pose import answer_pose, pose_example

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_SAFE = {
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


@dataclass(frozen=True)
class HostCheck:
    """Refuses requests from other pages, and tells the browser what this page may load."""

    app: ASGIApp
    hosts: tuple[str, ...] | None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_SAFE)
            await send(message)

        is_request = scope["type"] == "http"
        refusal = refuse_other_host(Request(scope), self.hosts) if is_request else None
        await (refusal or self.app)(scope, receive, send_safely)


def refuse_other_host(request: Request, hosts: tuple[str, ...] | None) -> Response | None:
    """Refuse a request under another name than ours, or sent by another web page."""
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
    """Answer a refusal with its message; the trace of another error is on the server's terminal."""
    if isinstance(error, HTTPException):
        return JSONResponse({"error": error.detail}, error.status_code, error.headers)
    message = f"depthpose failed ({type(error).__name__}: {error}); see the server's terminal"
    return JSONResponse({"error": message}, 500)


Result = TypeVar("Result")

GRACE_S = 10.0
LEAST_BYTES_S = 20_000
"""An upload with fewer bytes a second, after so many seconds, is ended: it keeps others waiting."""
MOMENT_S = 0.02
_FULL = "too many requests wait for one computation; try again later"
_STOP_S = 10.0  # so long a computation has to end once it was stopped: one step of it may be long


class _Stopped(BaseException):
    """Raised in the thread of a computation to end it; ``except Exception`` does not catch it."""


class TookTooLong(Exception):  # noqa: N818  what happened
    """A computation was stopped after its time."""


def run_in_time(work: Callable[[], Result], most_s: float) -> Result:
    """Compute in a thread, and stop it after a time limit.

    It ends at the next step of Python's; one that is in a long call of a library then goes on
    beside what comes after it, until that call ends.

    Raises:
        TookTooLong: it did not end before.
    """
    results = list[Result]()
    errors = list[BaseException]()

    def run() -> None:
        try:
            results.append(work())
        except BaseException as error:  # noqa: BLE001  raised where it was asked for
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(most_s)
    if thread.is_alive():
        assert thread.ident is not None
        ident = ctypes.c_ulong(thread.ident)
        kind = ctypes.py_object(_Stopped)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ident, kind)
        thread.join(_STOP_S)
    if results:
        return results[0]
    if errors and not isinstance(errors[0], _Stopped):
        raise errors[0]
    raise TookTooLong


@dataclass(frozen=True, eq=False)
class Queue:
    """Computations, one at a time; a limited number of requests may wait for one."""

    most: int
    most_s: float  #: of one computation; it is stopped then
    one: anyio.CapacityLimiter = field(default_factory=partial(anyio.CapacityLimiter, 1))
    tickets: list[str] = field(default_factory=list)

    async def compute(
        self, ticket: str, work: Callable[[], Result], is_gone: Callable[[], Awaitable[bool]]
    ) -> Result | None:
        """Compute in a thread once all earlier computations are done; None: the client has left.

        By the ticket the client asks for its place in the queue; 503 where too many wait, and where
        the computation takes too long.
        """
        if len(self.tickets) > self.most:  # one of them is at work
            raise HTTPException(503, _FULL)
        self.tickets.append(ticket)
        try:
            async with self.one:
                if await is_gone():
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
    # What is still to come of the request is read first, and the server gets a moment to see the
    # end of a connection from which it had stopped reading.
    with anyio.move_on_after(MOMENT_S):
        while (await receive())["type"] != "http.disconnect":
            pass
        return True
    return False


def paced(receive: Receive) -> Receive:
    """Give a request's body as long as it arrives fast enough."""
    start = time.monotonic()
    size = 0

    async def receive_in_time() -> MutableMapping[str, Any]:
        """Receive a part of the request; refuse an upload that comes too slowly."""
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


_MOST_DIGITS = 18  # of a Content-Length
TICKET = "x-ticket"
"""Header of a request: a random name, by which the page asks for its place in the queue."""
_RESULTS = 3  # answers whose files are kept in memory for downloads
_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".json": "application/json",
          ".zip": "application/zip"}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What the page refuses to take."""

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


class Pages:
    """Handlers of the routes, with the networks and the latest answers' files."""

    def __init__(self, depth: FakestereoNet, pose: GeoPoseNet, limits: Limits) -> None:
        self._limits = limits
        self._kinds: dict[str, Callable[[Form], Answer]] = {
            "depth": partial(answer_depth, net=depth),
            "pose": partial(answer_pose, net=pose),
        }
        self._examples: dict[str, Callable[[], dict[str, Any]]] = {
            "depth": cache(depth_example),
            "pose": cache(partial(pose_example, pose)),
        }
        self._queue = Queue(limits.waiting, limits.compute_s)
        self._uploads = 0
        self._kept: OrderedDict[str, Mapping[str, bytes]] = OrderedDict()
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
            "page.css": ("text/css", page_file("page.css") + (folder / "web.css").read_text()),
            "viewer.js": ("text/javascript", page_file("viewer.js")),
            "web.js": ("text/javascript", (folder / "web.js").read_text()),
        }

    async def asset(self, request: Request) -> Response:
        """Give the page, a script or the style."""
        name = request.path_params.get("name", "")
        if name not in self._assets:
            raise HTTPException(404, f"there is no {name!r}; the page is at /")
        media_type, text = self._assets[name]
        return Response(text, media_type=media_type)

    async def example(self, request: Request) -> Response:
        """Give files and fields to fill a form with; they are made at the first request."""
        if (kind := request.path_params["kind"]) not in self._examples:
            raise HTTPException(404, f"only {' and '.join(self._examples)} are estimated here")
        make = self._examples[kind]
        try:
            fields = await self._queue.compute("", make, partial(has_gone, request.receive))
        except InputError as error:
            raise HTTPException(400, str(error)) from error
        return JSONResponse(fields)

    async def place(self, request: Request) -> Response:
        """Give the number of computations before that of a ticket; null: it does not wait here."""
        ticket = request.path_params["ticket"]
        waiting = self._queue.tickets
        return JSONResponse({"before": waiting.index(ticket) if ticket in waiting else None})

    async def estimate(self, request: Request) -> Response:
        """Answer a form."""
        # What is too large is refused unread: a server reads no more than is announced.
        text = request.headers.get("content-length", "")
        most = self._limits.upload_bytes
        if not text.isdecimal() or "transfer-encoding" in request.headers:
            raise HTTPException(
                411, "the request has no Content-Length, or comes in chunks; send it whole, with "
                "its size",
            )  # fmt: skip
        # Of more digits than these Python makes no number.
        size = int(text) if len(text) <= _MOST_DIGITS else 10**_MOST_DIGITS
        if size > most:
            raise HTTPException(
                413,
                f"the files are {size / 1e6:.1f} MB together, more than the {most / 1e6:.0f} "
                "MB allowed; send smaller ones, or start 'depthpose serve' with a larger "
                "--max-upload-mb",
            )
        if (kind := request.path_params["kind"]) not in self._kinds:
            raise HTTPException(404, f"only {' and '.join(self._kinds)} are estimated here")
        estimate = self._kinds[kind]
        if len(self._queue.tickets) > self._queue.most:
            raise HTTPException(503, _FULL)
        with TemporaryDirectory(prefix="depthpose-") as folder:
            try:
                form = await self._upload(request, Path(folder))
                ticket = request.headers.get(TICKET, "")
                work = partial(estimate, form)
                answer = await self._queue.compute(ticket, work, partial(has_gone, request.receive))
            except (InputError, MissingExtraError) as error:
                raise HTTPException(400, without_paths(str(error), Path(folder))) from error
            except ClientDisconnect:
                answer = None
        return Response(status_code=400) if answer is None else JSONResponse(self._keep(answer))

    async def _upload(self, request: Request, folder: Path) -> Form:
        """Read the form, one of a few at the same time, as long as it keeps coming."""
        if self._uploads >= self._limits.uploads:
            raise HTTPException(503, "too many uploads at the same time; try again later")
        self._uploads += 1
        try:
            fields: dict[str, str] = {}
            files: dict[str, Path] = {}
            async with Request(request.scope, paced(request.receive)).form(
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
            self._uploads -= 1

    async def download(self, request: Request) -> Response:
        """Give a file of one of the latest answers, or all of them as a ZIP."""
        key = request.path_params["key"]
        name = request.path_params["name"]
        files = self._kept.get(key)
        if files is None or name not in {*files, "all.zip"}:
            raise HTTPException(
                404, f"only the last {_RESULTS} answers are kept, and not {name!r}; ask again"
            )
        if name == "all.zip" and name not in files:
            packed = io.BytesIO()
            with zipfile.ZipFile(packed, "w") as archive:  # most files are compressed already
                for file_name, data in files.items():
                    archive.writestr(file_name, data)
            files = {name: packed.getvalue()}
        media_type = _TYPES.get(Path(name).suffix, "application/octet-stream")
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        return Response(files[name], media_type=media_type, headers=headers)

    def _keep(self, answer: Answer) -> dict[str, Any]:
        """Keep the files of an answer, the latest few alone; give what the page shows."""
        key = secrets.token_urlsafe(12)
        self._kept[key] = answer.files
        while len(self._kept) > _RESULTS:
            self._kept.popitem(last=False)
        pictures = []
        for picture in answer.pictures:  # with their sizes, so that nothing moves when they come
            with Image.open(io.BytesIO(answer.files[picture.file])) as image:  # a file of our own
                size_and_scale = {
                    "scale": picture.scale and vars(picture.scale),
                    "size": list(image.size),
                }
            pictures.append({**vars(picture), **size_and_scale})
        return {
            "ok": answer.is_ok,
            "said": answer.sentence,
            "terms": answer.terms,
            "facts": list(answer.facts),
            "tables": dict(answer.tables),
            "pictures": pictures,
            "scene": answer.scene.encoded(),
            "files": [{"name": n, "bytes": len(data)} for n, data in answer.files.items()],
            "folder": f"results/{key}/",
        }


def make_app(depth: FakestereoNet, pose: GeoPoseNet, limits: Limits | None = None) -> Starlette:
    """Build the application, with networks for the tabs Depth and Pose."""
    limits = Limits() if limits is None else limits
    pages = Pages(depth, pose, limits)

    return Starlette(
        routes=[
            Route("/", pages.asset),
            Route("/assets/{name}", pages.asset),
            Route("/examples/{kind}", pages.example),
            Route("/estimate/{kind}", pages.estimate, methods=["POST"]),
            Route("/queue/{ticket}", pages.place),
            Route("/results/{key}/{name}", pages.download),
        ],
        middleware=[Middleware(HostCheck, hosts=limits.hosts)],
        exception_handlers={HTTPException: error_response, Exception: error_response},
    )


_CONNECTIONS = 400
"""Connections at once; more are answered with 503 before anything of them is read."""
_LEAVE_S = 2  # seconds that open connections have to finish after Ctrl+C
HEAD_S = 10.0
"""Seconds in which the head of a request must come: a connection that sends none counts among
those that are open at once."""


class TimedProtocol(H11Protocol):
    """Closes a connection whose request's head does not come in time; uvicorn would wait for it."""

    _closing: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to wait for the first request."""
        super().connection_made(transport)  # pyright: ignore[reportArgumentType]
        self._wait_for_head()

    def data_received(self, data: bytes) -> None:
        """Read on; half of a head changes nothing."""
        super().data_received(data)
        self._wait_for_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing more."""
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
    """Take a port before anything heavy is loaded; port 0 takes a free one."""
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


def known_names(
    host: str, listener: socket.socket
) -> tuple[IPv4Address | IPv6Address, tuple[str, ...] | None]:
    """Give the address that was taken, and the host names under which the page may be requested.

    None: any, it is open to all. How the address was written does not say that: '', '0' and '0x0'
    mean all addresses too.
    """
    address = ip_address(listener.getsockname()[0])
    if isinstance(address, IPv6Address):
        address = address.ipv4_mapped or address
    return address, None if address.is_unspecified else (*LOOPBACK, host.lower(), str(address))


def run(app: Starlette, listener: socket.socket) -> None:
    """Answer requests until the process is stopped; only errors are logged."""
    config = uvicorn.Config(
        app,
        http=TimedProtocol,
        log_level="error",
        access_log=False,
        server_header=False,
        limit_concurrency=_CONNECTIONS,
        timeout_graceful_shutdown=_LEAVE_S,
    )
    uvicorn.Server(config).run(sockets=[listener])
