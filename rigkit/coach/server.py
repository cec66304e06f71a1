"""The local server of the coach's page: it answers only the page's own requests, with the token of its address."""

from __future__ import annotations

import hmac
import html
import json
import secrets
import socket
from collections.abc import Callable
from importlib import resources
from itertools import accumulate
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from rigkit.coach.coach import Coach, Take, decoded
from rigkit.core.errors import InputError, InstallationError, RigkitError

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

MAX_UPLOAD_BYTES = 64_000_000
"""A lossless image of 20 megapixels."""
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; img-src 'self' blob: data:; media-src 'self' blob:; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
LOCAL = ("127.0.0.1", "localhost", "[::1]")
NO_SERVER = 'coach: needs a web server; install it with `pip install "rigkit[coach]"`'


def new_token() -> str:
    """Return a random token that cannot be guessed."""
    return secrets.token_urlsafe(24)


def coach_app(coach: Coach, token: str, hosts: tuple[str, ...] = LOCAL, *, camera: str = "page") -> Starlette:
    """Return the application. `hosts` are the host names that it accepts; `camera` is "page" for the browser's camera,
    "server" for cameras of this machine, "folder" and "recording" for files.

    Raises InstallationError where starlette is missing.
    """
    try:
        from starlette.applications import Starlette
        from starlette.concurrency import run_in_threadpool
        from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse
        from starlette.routing import Route
    except ImportError as error:
        raise InstallationError(NO_SERVER) from error

    async def page(request: Request) -> Response:
        refusal = _refused(request, token, hosts)
        text = resources.files("rigkit.coach").joinpath("page.html").read_text(encoding="utf-8")
        names = html.escape(json.dumps(coach.keeper.names), quote=True)
        return refusal or HTMLResponse(text.replace("{{camera}}", camera).replace("{{names}}", names), 200, HEADERS)

    async def act(request: Request) -> Response:
        refusal = _refused(request, token, hosts)
        if refusal is not None:
            return refusal
        data = await _body_of(request)
        if data is None:
            return PlainTextResponse("too large", 413, HEADERS)
        what = request.path_params["what"]
        try:
            parts = _parts(data, request.query_params.get("sizes"))
            state = await run_in_threadpool(_answer, coach, what, parts)
        except RigkitError as error:
            return JSONResponse({"error": str(error)}, 400, HEADERS)
        if state is None:
            return PlainTextResponse("not found", 404, HEADERS)
        return JSONResponse(state, 200, HEADERS)

    async def preview(request: Request) -> Response:
        from starlette.responses import Response as Plain

        refusal = _refused(request, token, hosts)
        picture = coach_preview.get(request.path_params["camera"])
        return refusal or Plain(picture or b"", 200 if picture else 404, {**HEADERS, "Content-Type": "image/jpeg"})

    coach_preview: dict[int, bytes] = {}
    app = Starlette(
        routes=[
            Route("/{token}/", page),
            Route("/{token}/frame{camera:int}.jpg", preview),
            Route("/{token}/{what:str}", act, methods=["POST"]),
        ]
    )
    # A redirect would be sent before token and host are checked.
    app.router.redirect_slashes = False
    app.state.preview = coach_preview
    return app


def _refused(request: Request, token: str, hosts: tuple[str, ...]) -> Response | None:
    """Return a refusal of requests that are not the page's own: another token, host or origin; else None."""
    from starlette.responses import PlainTextResponse

    given = str(request.path_params.get("token", ""))
    if not hmac.compare_digest(given.encode("utf-8", "backslashreplace"), token.encode()):
        return PlainTextResponse("not found", 404, HEADERS)
    origin = request.headers.get("origin")
    try:
        host = urlsplit(f"//{request.headers.get('host', '')}").hostname or ""
        is_foreign = origin is not None and urlsplit(origin).netloc != request.headers.get("host")
    except ValueError:
        return PlainTextResponse("no address", 400, HEADERS)
    if (f"[{host}]" if ":" in host else host) not in hosts:
        return PlainTextResponse("wrong host", 403, HEADERS)
    if is_foreign:
        return PlainTextResponse("wrong origin", 403, HEADERS)
    if request.method == "POST" and origin is None:
        return PlainTextResponse("no origin", 403, HEADERS)
    return None


async def _body_of(request: Request) -> bytes | None:
    """Return the body of a request; None where it is too large, without reading all of it."""
    announced = request.headers.get("content-length", "0")
    if not announced.isdecimal() or len(announced) > len(str(MAX_UPLOAD_BYTES)) or int(announced) > MAX_UPLOAD_BYTES:
        return None
    parts, size = [], 0
    async for chunk in request.stream():
        size += len(chunk)
        if size > MAX_UPLOAD_BYTES:
            return None
        parts.append(chunk)
    return b"".join(parts)


def _parts(data: bytes, sizes: str | None) -> list[bytes]:
    """Return the images in a body, which follow each other with the lengths in bytes given by `sizes` ("12,34");
    raises InputError where these do not add up to the whole."""
    if sizes is None:
        return [data] if data else []
    announced = sizes.split(",")
    counts = [int(part) if part.isdecimal() and len(part) < 10 else -1 for part in announced]
    if min(counts) < 0 or sum(counts) != len(data):
        raise InputError("coach: the images do not have the stated length")
    ends = list(accumulate(counts))
    return [data[end - count : end] for end, count in zip(ends, counts, strict=True)]


def _answer(coach: Coach, what: str, parts: list[bytes]) -> dict[str, Any] | None:
    """Return what the coach answers to the request `what` with its images, None to one that it does not know."""
    if what == "take" and not parts:
        return coach.take_shown()
    if what in ("look", "offer", "take", "photo"):
        images = [decoded(part) for part in parts]
        return coach.look(images, take=Take.YES if what == "photo" else Take(what), photo=what == "photo")
    if what == "undo":
        return coach.undo()
    if what == "finish":
        return {"finished": coach.finish()}
    return coach.state() if what == "state" else None


def address_in_network() -> str:
    """Return the address of this machine in its network, without sending anything; raises InputError without one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Any address outside this network gives the interface by which it would be reached.
            probe.connect(("192.0.2.1", 9))
        except OSError as error:
            raise InputError("coach: --lan: this machine is in no network") from error
        return str(probe.getsockname()[0])


def serve(app: Starlette, host: str, port: int, ready: Callable[[int], None]) -> None:
    """Serve until Ctrl-C; `ready` is called with the port, which the system chooses for 0.

    Raises InstallationError where uvicorn is missing, InputError where the port is taken.
    """
    try:
        import uvicorn
    except ImportError as error:
        raise InstallationError(NO_SERVER) from error
    with socket.socket() as listening:
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind((host, port))
        except (OSError, OverflowError) as error:
            fault = error.strerror if isinstance(error, OSError) else "there are 0 to 65535"
            raise InputError(f"coach: port {port} of {host}: {fault}; give another --port") from error
        ready(int(listening.getsockname()[1]))
        uvicorn.Server(uvicorn.Config(app, log_level="warning")).run(sockets=[listening])
