"""The web application: routes, limits, one computation at a time, nothing kept on the disk."""

import secrets
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route

from depthpose import __version__
from depthpose.core.errors import InputError, MissingExtraError
from depthpose.depth.estimator import FakestereoNet
from depthpose.pose.estimator import GeoPoseNet
from depthpose.report.scene import page_file
from depthpose.web.answer import KINDS, Answer, Form, Shown, without_paths
from depthpose.web.depth import answer_depth
from depthpose.web.examples import depth_example, pose_example
from depthpose.web.guard import (
    LOOPBACK,
    AdaptationCheck,
    crash_response,
    error_response,
    read_form,
    refuse_size,
    zip_files,
)
from depthpose.web.pose import answer_pose
from depthpose.web.queue import Queue, has_gone, paced

TICKET = "x-ticket"
"""Header of a request: a random name, by which the page asks for its place in the queue."""
_RESULTS = 3
"""Answers whose files are kept in memory for downloads."""
_TYPES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".json": "application/json",
    ".zip": "application/zip",
}


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What the page refuses to take."""

    upload_bytes: int = 64 * 10**6
    """All files of one request together."""

    waiting: int = 4
    """Requests that may wait for the one that is computed."""

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
        self._queue = Queue(limits.waiting)
        self._uploads = 0
        self._kept: OrderedDict[str, Mapping[str, bytes]] = OrderedDict()
        loader = PackageLoader("depthpose.web", ".")
        template = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
        self._page = template.get_template("page.html").render(
            version=__version__,
            objects=pose.objects,
            kinds=KINDS,
            limit_mb=limits.upload_bytes // 10**6,
            has_one_image=depth.synthesiser is not None,
            has_pair=depth.matcher is not None,
        )
        own = Path(__file__).parent
        self._assets = {
            "page.css": ("text/css", page_file("page.css") + (own / "web.css").read_text()),
            "viewer.js": ("text/javascript", page_file("viewer.js")),
            "web.js": ("text/javascript", (own / "web.js").read_text()),
        }

    async def home(self, _: Request) -> Response:
        """Give the page."""
        return HTMLResponse(self._page)

    async def asset(self, request: Request) -> Response:
        """Give a script or the style."""
        name = request.path_params["name"]
        if name not in self._assets:
            raise HTTPException(404, f"there is no {name!r}; the page is at /")
        media_type, text = self._assets[name]
        return Response(text, media_type=media_type)

    async def example(self, request: Request) -> Response:
        """Give files and fields to fill a form with; they are made at the first request."""
        make = self._examples.get(request.path_params["kind"])
        if make is None:
            raise HTTPException(404, f"only {' and '.join(self._kinds)} are estimated here")
        try:
            made = await self._queue.compute("", make, partial(has_gone, request.receive))
        except InputError as error:
            raise HTTPException(400, str(error)) from error
        return JSONResponse(made)

    async def place(self, request: Request) -> Response:
        """Give the number of computations before that of a ticket; null: it does not wait here."""
        return JSONResponse({"before": self._queue.before(request.path_params["ticket"])})

    async def estimate(self, request: Request) -> Response:
        """Answer a form."""
        refuse_size(request, self._limits.upload_bytes)
        estimate = self._kinds.get(request.path_params["kind"])
        if estimate is None:
            raise HTTPException(404, f"only {' and '.join(self._kinds)} are estimated here")
        self._queue.refuse_full()
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
            return await read_form(Request(request.scope, paced(request.receive)), folder)
        finally:
            self._uploads -= 1

    async def download(self, request: Request) -> Response:
        """Give a file of one of the latest answers, or all of them as a ZIP."""
        key, name = request.path_params["key"], request.path_params["name"]
        files = self._kept.get(key)
        if files is None or name not in {*files, "all.zip"}:
            raise HTTPException(
                404, f"only the last {_RESULTS} answers are kept, and not {name!r}; ask again"
            )
        data = files[name] if name in files else zip_files(files)
        media_type = _TYPES.get(Path(name).suffix, "application/octet-stream")
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        return Response(data, media_type=media_type, headers=headers)

    def _keep(self, answer: Answer) -> dict[str, Any]:
        key = secrets.token_urlsafe(12)
        self._kept[key] = answer.files
        while len(self._kept) > _RESULTS:
            self._kept.popitem(last=False)
        sizes = [{"name": name, "bytes": len(data)} for name, data in answer.files.items()]
        return {
            "ok": answer.is_ok,
            "said": answer.said,
            "terms": answer.terms,
            "facts": list(answer.facts),
            "tables": dict(answer.tables),
            "pictures": [_picture(picture, answer.files) for picture in answer.pictures],
            "scene": answer.scene.encoded(),
            "files": sizes,
            "folder": f"results/{key}/",
        }


def _picture(shown: Shown, files: Mapping[str, bytes]) -> dict[str, Any]:
    """Give what the page needs of a picture: its size too, so that nothing moves when it comes."""
    with Image.open(BytesIO(files[shown.file])) as image:  # a file of our own
        width, height = image.size
    return {**vars(shown), "scale": shown.scale and vars(shown.scale), "size": [width, height]}


def make_app(depth: FakestereoNet, pose: GeoPoseNet, limits: Limits | None = None) -> Starlette:
    """Build the application.

    Args:
        depth: for the tab Depth.
        pose: for the tab Pose.
        limits: what is refused.
    """
    limits = Limits() if limits is None else limits
    pages = Pages(depth, pose, limits)

    return Starlette(
        routes=[
            Route("/", pages.home),
            Route("/assets/{name}", pages.asset),
            Route("/examples/{kind}", pages.example),
            Route("/estimate/{kind}", pages.estimate, methods=["POST"]),
            Route("/queue/{ticket}", pages.place),
            Route("/results/{key}/{name}", pages.download),
        ],
        middleware=[Middleware(AdaptationCheck, hosts=limits.hosts)],
        exception_handlers={HTTPException: error_response, Exception: crash_response},
    )
