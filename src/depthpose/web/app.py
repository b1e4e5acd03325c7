"""The web application: its routes, and what they answer.

Sizes, files and the pace of uploads are checked. Nothing is kept on the disk.
"""

import io
import secrets
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image
from starlette.applications import Starlette
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from depthpose import __version__
from depthpose.core.errors import InputError, MissingExtraError
from depthpose.depth.estimator import FakestereoNet
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.report.page import read_page_file
from depthpose.web.answer import FILE_FIELDS, Answer, Form, remove_paths, write_upload
from depthpose.web.checks import HostCheck, has_gone, limit_pace
from depthpose.web.computation import QUEUE_FULL, Queue
from depthpose.web.depth import answer_depth, make_depth_example
from depthpose.web.pose import answer_pose, make_pose_example
from depthpose.web.server import LOOPBACK

_MAX_FILES = 6
_MAX_FIELDS = 30
_MAX_FIELD_BYTES = 4096
"""Most files and fields of one request, and longest value of a field."""


async def make_error_response(_: Request, error: Exception) -> Response:
    """Make the response to a refusal or an error: its message; a trace is on the terminal."""
    if isinstance(error, HTTPException):
        return JSONResponse({"error": error.detail}, error.status_code, error.headers)
    message = f"depthpose failed ({type(error).__name__}: {error}); see the server's terminal"
    return JSONResponse({"error": message}, 500)


_MAX_DIGITS = 18
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
            "depth": cache(make_depth_example),
            "pose": cache(partial(make_pose_example, pose)),
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
            kinds=FILE_FIELDS,
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
        """Answer with the number of computations before a ticket's; null if it does not wait."""
        ticket = request.path_params["ticket"]
        waiting = self._queue.tickets
        return JSONResponse({"before": waiting.index(ticket) if ticket in waiting else None})

    async def estimate(self, request: Request) -> Response:
        """Answer with the estimate for a form as JSON; 400 if the form is wrong."""
        self._refuse_large_body(request)
        kind = request.path_params["kind"]
        if kind not in self._estimators:
            raise HTTPException(404, f"only {' and '.join(self._estimators)} are estimated here")
        if self._queue.is_full:  # before the files are received in vain
            raise HTTPException(503, QUEUE_FULL)
        with TemporaryDirectory(prefix="depthpose-") as folder:
            try:
                form = await self._receive_form(request, Path(folder))
                ticket = request.headers.get(TICKET, "")
                computation = partial(self._estimators[kind], form)
                has_client_gone = partial(has_gone, request.receive)
                answer = await self._queue.compute(ticket, computation, has_client_gone)
            except (InputError, MissingExtraError) as error:
                raise HTTPException(400, remove_paths(str(error), Path(folder))) from error
            except ClientDisconnect:
                answer = None
        if answer is None:  # the client has gone
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
        size = int(text) if len(text) <= _MAX_DIGITS else 10**_MAX_DIGITS
        max_size = self._limits.upload_bytes
        if size > max_size:
            raise HTTPException(
                413,
                f"the files are {size / 1e6:.1f} MB together, more than the {max_size / 1e6:.0f} "
                "MB allowed; send smaller ones, or start 'depthpose serve' with a larger "
                "--max-upload-mb",
            )

    async def _receive_form(self, request: Request, folder: Path) -> Form:
        """Receive a form: its fields, and its files, which are written into ``folder``.

        503 where too many uploads arrive at the same time, 408 where this one is too slow.
        """
        if self._upload_count >= self._limits.uploads:
            raise HTTPException(503, "too many uploads at the same time; try again later")
        self._upload_count += 1
        try:
            fields: dict[str, str] = {}
            files: dict[str, Path] = {}
            async with Request(request.scope, limit_pace(request.receive)).form(
                max_files=_MAX_FILES, max_fields=_MAX_FIELDS, max_part_size=_MAX_FIELD_BYTES
            ) as form:
                for name, value in form.multi_items():
                    if not isinstance(value, UploadFile):
                        fields[name] = value
                    elif name in files:
                        raise InputError(f"{name}: two files; choose one")
                    elif value.filename:
                        files[name] = write_upload(folder, name, value.filename, await value.read())
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
        """Store the files of an answer in place of the oldest ones; return the page's JSON."""
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
            "sentence": answer.sentence,
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
    """Build the application.

    Args:
        depth: networks of the tab Depth.
        pose: network of the tab Pose.
        limits: limits beyond which requests are refused; None: the usual ones.
    """
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
        exception_handlers={HTTPException: make_error_response, Exception: make_error_response},
    )
