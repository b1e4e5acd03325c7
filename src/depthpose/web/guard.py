"""Checks of requests: host and origin, size, files; and how errors are answered."""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders, UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from depthpose.core.errors import InputError
from depthpose.web.answer import Form, keep_file

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
_MOST_FILES, _MOST_FIELDS, _LONGEST_FIELD = 6, 30, 4096


class AdaptationCheck:
    """Refuses requests from other pages, and tells the browser what this page may load.

    Args:
        app: what answers all other requests.
        hosts: host names under which the page may be requested; None: any.
    """

    def __init__(self, app: ASGIApp, hosts: tuple[str, ...] | None) -> None:
        self._app, self._hosts = app, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_SAFE)
            await send(message)

        is_request = scope["type"] == "http"
        refusal = refuse_other_host(Request(scope), self._hosts) if is_request else None
        await (refusal or self._app)(scope, receive, send_safely)


def refuse_other_host(request: Request, hosts: tuple[str, ...] | None) -> Response | None:
    """Refuse a request under another name than ours, or sent by another web page."""
    host = request.headers.get("host", "")
    name = _host_name(host)
    if hosts is not None and name not in hosts:
        return _sentence(
            403, f"this page answers to {', '.join(hosts)}, not to {host!r}; start "
            "'depthpose serve' with --host to name another"
        )  # fmt: skip
    origin = request.headers.get("origin")
    if origin is not None and origin.partition("://")[2] != host:
        return _sentence(403, f"the request comes from another page, {origin}; open this one")
    return None


def _host_name(host: str) -> str | None:
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:  # such as half of a bracket
        return None


def refuse_size(request: Request, most: int) -> None:
    """Refuse what is too large before it is read.

    A server reads no more than the announced size, except of a body in chunks.

    Raises:
        HTTPException: no size, or too large a one.
    """
    text = request.headers.get("content-length", "")
    if not text.isdecimal() or "transfer-encoding" in request.headers:
        raise HTTPException(
            411,
            "the request has no Content-Length, or comes in chunks; send it whole, with its size",
        )
    if int(text) > most:
        raise HTTPException(
            413,
            f"the files are {int(text) / 1e6:.1f} MB together, more than the {most / 1e6:.0f} MB "
            "allowed; send smaller ones, or start 'depthpose serve' with a larger --max-upload-mb",
        )


async def read_form(request: Request, folder: Path) -> Form:
    """Read the fields, and put the files into the folder.

    Raises:
        InputError: a file of a type that its field does not take.
        HTTPException: more files or fields than the page has, or no form at all.
    """
    fields: dict[str, str] = {}
    files: dict[str, Path] = {}
    async with request.form(
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


def zip_files(files: Mapping[str, bytes]) -> bytes:
    """Put files into one ZIP, as they are: most are compressed already."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return packed.getvalue()


async def error_response(_: Request, error: Exception) -> Response:
    """Answer a refusal with its message."""
    assert isinstance(error, HTTPException)
    return _sentence(error.status_code, error.detail, error.headers)


async def crash_response(_: Request, error: Exception) -> Response:
    """Answer an unexpected error; the trace is on the server's terminal."""
    kind = type(error).__name__
    return _sentence(500, f"depthpose failed ({kind}: {error}); see the server's terminal")


def _sentence(status: int, said: str, headers: Mapping[str, str] | None = None) -> Response:
    return JSONResponse({"error": said}, status_code=status, headers=headers)
