"""The web server of the pages, which answers requests with the token or its cookie.

Every program on this computer, and every web site open in its browser, can send requests to
loopback. So the token is needed on loopback too, and the Host and Origin headers must name this
server. Another site can then not read the pages, even if its name points to 127.0.0.1.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import secrets
import socket
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.core.records import parse_utc, slot_id
from fieldlum.session import Session
from fieldlum.web.answer import Worker, answer_table
from fieldlum.web.snapshot import Snapshots, picture_png, scale_png


async def json_body(request: Request, max_bytes: int) -> Mapping[str, Any]:
    """Return the JSON object of a request of at most `max_bytes`, else raise HTTPException.

    Its status is 415 for another content type, 413 for a longer body, 400 for other content.
    """
    if request.headers.get("content-type", "").partition(";")[0] != "application/json":
        raise HTTPException(415)
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > max_bytes:
            raise HTTPException(413)
    try:
        asked = json.loads(data)
    except (ValueError, RecursionError):
        raise HTTPException(400) from None
    if not isinstance(asked, dict):
        raise HTTPException(400)
    return asked


SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "Cache-Control": "no-store",
}
"""Sent with each answer."""


class Access:
    """The token of one run of the server, its cookie, and the host names that the server has.

    names: without the port. After the first request with the token the browser uses the cookie.
    """

    def __init__(self, port: int, names: Iterable[str]) -> None:
        """names: host names and addresses without a port, an IPv6 address in brackets."""
        # 256 random bits cannot be guessed, so wrong tokens need no counting
        self.token, cookie = secrets.token_urlsafe(32), secrets.token_urlsafe(32)
        # Cookies are shared by all ports of a host: two sessions that are watched need two names.
        self._cookie = f"fieldlum-{port}={cookie}"
        self.hosts = frozenset(f"{name}:{port}".lower() for name in names)

    @property
    def set_cookie(self) -> str:
        """Value of the Set-Cookie header whose cookie replaces the token."""
        return f"{self._cookie}; Path=/; HttpOnly; SameSite=Strict"

    def rule(
        self, method: str, path: str, query: str, headers: Mapping[str, str]
    ) -> tuple[int, str]:
        """Decide about one request by its names, origin, method, and token or cookie.

        method: in capitals; query: without the question mark; headers: by name in lower case. The
        first result is 200: answer it; 303: turn the token into a cookie and remove it from the
        address; or the status of a refusal, whose text is the second result.
        """
        if headers.get("host", "").lower() not in self.hosts:
            return 421, "This server does not have that name."
        origin = headers.get("origin", "")
        own = not origin or origin.lower() in {f"http://{host}" for host in self.hosts}
        if not own or headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return 403, "The request comes from another site."
        if method not in ("GET", "HEAD", "POST"):
            return 405, "Only GET, HEAD and POST are answered."
        if method == "POST" and not origin:
            return 403, "A change needs the header Origin."
        tokens = parse_qs(query).get("token", [])
        cookies = (part.strip() for part in headers.get("cookie", "").split(";"))
        if any(_same(cookie, self._cookie) for cookie in cookies):
            return (303 if path == "/" and tokens else 200), ""
        if path == "/" and method == "GET" and tokens and _same(tokens[0], self.token):
            return 303, ""
        return 401, "Open the address with the token that the terminal printed first."


def _same(text: str, wanted: str) -> bool:
    """Compare in constant time."""
    return hmac.compare_digest(text.encode(), wanted.encode())


# ----------------------------------------------------------------------------------------------
# server


class PatientProtocol(H11Protocol):
    """A connection that is closed if its first request is not complete after five seconds.

    So silent connections cannot use up the files that the process may open.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection."""
        super().connection_made(transport)
        # a phone on slow Wi-Fi needs under a second
        self.loop.call_later(5.0, self._end_if_silent)

    def _end_if_silent(self) -> None:
        if self.cycle is None:  # no request arrived with all its headers
            self.transport.abort()


STATIC = Path(__file__).parent / "static"
_FIRST_YEAR, _LAST_YEAR = 1970, 2999  # of days with a curve; chosen
# The address of a picture has the stamp of its file: one that is merged again has another address.
_CACHED = {"Cache-Control": "private, max-age=31536000, immutable"}  # 365 days


class Guard:
    """ASGI layer: refuse requests that `Access` does not allow; add security headers.

    Refused requests get the headers too.
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] != "http":  # no web sockets here
            return
        headers = dict(Headers(scope=scope).items())
        query = scope["query_string"].decode("latin-1")
        status, text = self._access.rule(scope["method"], scope["path"], query, headers)
        answer: ASGIApp = self._app
        if status == 303:
            cookie = {"location": "/", "set-cookie": self._access.set_cookie}
            answer = Response(status_code=303, headers=cookie)
        elif status != 200:
            answer = PlainTextResponse(f"{text}\n", status, {"connection": "close"})

        async def secured(message: Message) -> None:
            if message["type"] == "http.response.start":
                added = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    added.setdefault(name, value)
            await send(message)

        await answer(scope, receive, secured)


def static_route(path: str, name: str) -> Route:
    """Return a route at `path` for the file `name` of this package."""
    return Route(path, lambda request: FileResponse(STATIC / name))


def picture_routes(session: Session) -> list[Route]:
    """Return the web routes of a session's panoramas in false colour, and of their scale."""

    def picture(request: Request) -> Response:
        slot = request.path_params["slot"]
        try:
            low, high = (float(request.query_params[name]) for name in ("low", "high"))
            width = int(request.query_params.get("width", "920"))
            safe = slot_id(parse_utc(slot)) == slot  # as a part of a file's name
        except (KeyError, ValueError):
            raise HTTPException(400) from None
        if not (safe and 1e-6 <= low < high <= 1e12 and width >= 16):
            raise HTTPException(400)
        try:
            data = picture_png(session.panorama(slot), width, low, high)
        except (InputError, OSError):
            raise HTTPException(404) from None
        return Response(data, media_type="image/png", headers=_CACHED)

    def scale(request: Request) -> Response:
        return Response(scale_png(), media_type="image/png", headers=_CACHED)

    return [Route("/picture/{slot}.png", picture), Route("/scale.png", scale)]


def watch_routes(
    session: Session, snapshots: Snapshots, worker: Worker | None = None
) -> list[Route]:
    """Return the web routes of the page of `fieldlum watch`.

    worker: computes the glare classes so far, or None.
    """

    def state() -> Mapping[str, object]:
        answer = session.root / "watch" / "answer.json"
        written = answer.stat().st_mtime_ns if answer.is_file() else 0
        doing = [worker.step, worker.problem] if worker else []
        return {**snapshots.state(), "answer": " ".join([str(written), *doing])}

    def day(request: Request) -> Response:
        try:
            wanted = date.fromisoformat(request.path_params["day"])
        except ValueError:
            raise HTTPException(404) from None
        if not _FIRST_YEAR <= wanted.year <= _LAST_YEAR:
            raise HTTPException(404)
        return _table(lambda: snapshots.day(wanted))

    return [
        static_route("/", "watch.html"),
        static_route("/watch.js", "watch.js"),
        static_route("/page.css", "page.css"),
        Route("/state.json", lambda request: _table(state)),
        Route("/answer.json", lambda request: _table(lambda: answer_table(session, worker))),
        Route("/calendar.json", lambda request: _table(snapshots.calendar)),
        Route("/day/{day}.json", day),
        *picture_routes(session),
    ]


def _table(make: Callable[[], Mapping[str, object]]) -> Response:
    """Return the table of `make` as JSON; status 503 if the session cannot be read now."""
    try:
        return JSONResponse(make())
    except (InputError, OSError) as error:
        return JSONResponse({"error": str(error)}, 503)


@dataclass(frozen=True, slots=True)
class Served:
    """A server that is ready to run: the socket, which listens, and the address with the token."""

    app: ASGIApp
    socket: socket.socket
    address: str

    def run(self) -> None:
        """Serve until the process is interrupted."""
        config = uvicorn.Config(
            self.app,
            log_level="warning",
            access_log=False,  # addresses hold the token
            server_header=False,
            http=PatientProtocol,
            timeout_graceful_shutdown=2,
            ws="none",
            lifespan="off",
        )
        uvicorn.Server(config).run(sockets=[self.socket])


def prepare(routes: Sequence[Route], port: int, *, lan: bool) -> Served:
    """Listen on loopback, or on all interfaces for `lan`; return the server of `routes`.

    Port 0 chooses a free port. Raises DeviceError if the port cannot be used.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("0.0.0.0" if lan else "127.0.0.1", port))
        listener.listen()  # the printed address works at once
    except OSError as error:
        listener.close()
        raise DeviceError(
            f"port {port} cannot be used ({error.strerror}); "
            f"give another --port N, or --port 0 for a free one"
        ) from None
    port = listener.getsockname()[1]
    names, host = {"127.0.0.1", "localhost"}, "127.0.0.1"
    if lan:
        name = socket.gethostname()
        host = _lan_address() or host
        names |= {host, *((name, f"{name}.local") if name else ())}
    access = Access(port, names)
    app = Guard(Starlette(routes=list(routes)), access)
    return Served(app, listener, f"http://{host}:{port}/?token={access.token}")


def _lan_address() -> str:
    """Return this computer's IPv4 address in its network, "" without one. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # RFC 5737: an address for documentation
            return str(probe.getsockname()[0])
        except OSError:
            return ""


def qr_lines(text: str) -> list[str]:
    """Return a QR code as lines of half blocks, with the required margin.

    Light modules are drawn: print the lines in white on black.
    """
    import cv2

    code = np.asarray(cv2.QRCodeEncoder.create().encode(text)) > 127  # light modules are true
    code = np.pad(code, 2, constant_values=True)  # the encoder adds two of the four modules
    if len(code) % 2:
        code = np.pad(code, ((0, 1), (0, 0)), constant_values=True)
    words = {(True, True): "█", (True, False): "▀", (False, True): "▄", (False, False): " "}
    pairs = zip(code[0::2], code[1::2], strict=True)
    return ["".join(words[bool(a), bool(b)] for a, b in zip(*pair, strict=True)) for pair in pairs]
