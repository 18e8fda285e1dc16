"""The web server of the pages, which answers requests that have the token or its cookie.

Every program on this computer, and every web site open in its browser, can send requests to
loopback. So the token is needed on loopback too, and the Host and Origin headers must name this
server. Another site can then not read the pages, even if its name points to 127.0.0.1.
"""

import asyncio
import hmac
import json
import secrets
import socket
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.core.false_colour import colour_table, png_of
from fieldlum.core.records import parse_utc, slot_id
from fieldlum.session import Session
from fieldlum.web.prediction_so_far import Worker, answer_table
from fieldlum.web.snapshot import Snapshots, picture_png


async def json_body(request: Request, max_bytes: int) -> Mapping[str, Any]:
    """Return the JSON object in the body of a request.

    Raises HTTPException with status 415 for a content type other than application/json, 413 for a
    body longer than `max_bytes`, 400 for content that is no JSON object.
    """
    if request.headers.get("content-type", "").partition(";")[0] != "application/json":
        raise HTTPException(415)
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > max_bytes:
            raise HTTPException(413)
    try:
        body = json.loads(data)
    except (ValueError, RecursionError):
        raise HTTPException(400) from None
    if not isinstance(body, dict):
        raise HTTPException(400)
    return body


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


# ----------------------------------------------------------------------------------------------
# server


class PatientProtocol(H11Protocol):
    """A connection that is closed if its first request is not complete after five seconds.

    Otherwise silent connections could use up the number of files that the process may open.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection, and look at it again after five seconds."""
        super().connection_made(transport)
        # Five seconds are chosen: a phone on slow Wi-Fi needs under one.
        self.loop.call_later(5.0, self._end_if_silent)

    def _end_if_silent(self) -> None:
        """Close the connection if no request has arrived with all its headers."""
        if self.cycle is None:
            self.transport.abort()


STATIC = Path(__file__).parent / "static"
# Sent with pictures, which a browser need not request again: the address of a picture contains the
# stamp of its file, so that a picture that is merged again has another address.
_CACHED = {"Cache-Control": "private, max-age=31536000, immutable"}  # 365 days


class Guard:
    """ASGI layer that passes requests with the token or its cookie on to `app`, and refuses others.

    A request must also name this server as Host, and come from its own pages. All answers, also
    refusals, get security headers. After the first request with the token the browser uses the
    cookie. port: of this server; names: host names and addresses of this computer. Attributes:
    token: random, new for each object; hosts: the allowed values of Host, "name:port".
    """

    def __init__(self, app: ASGIApp, port: int, names: Iterable[str]) -> None:
        # 256 random bits cannot be guessed, so wrong tokens need no counting
        self._app, self.token = app, secrets.token_urlsafe(32)
        # All ports of a host share cookies: two servers need two names.
        self._cookie_name, self._cookie = f"fieldlum-{port}", secrets.token_urlsafe(32)
        self.hosts = frozenset(f"{name}:{port}".lower() for name in names)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request with `app`, or refuse it with a status from 401 to 421.

        scope, receive, send: as ASGI defines them. Anything but HTTP is ignored.
        """
        if scope["type"] != "http":  # no web sockets here
            return

        async def send_secured(message: Message) -> None:
            """Send a message, with the security headers in the first one of an answer."""
            if message["type"] == "http.response.start":
                added = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    added.setdefault(name, value)
            await send(message)

        answer: ASGIApp = self._refusal_or_cookie(Request(scope)) or self._app
        await answer(scope, receive, send_secured)

    def _refusal_or_cookie(self, request: Request) -> Response | None:
        """Return a refusal, or an answer that sets the cookie; None to pass the request on."""

        def refused(status: int, text: str) -> Response:
            """Return a refusal, after which the connection is closed.

            status: of HTTP; text: a sentence, which is the answer's body.
            """
            return PlainTextResponse(f"{text}\n", status, {"connection": "close"})

        headers, method = request.headers, request.method
        if headers.get("host", "").lower() not in self.hosts:
            return refused(421, "This server does not have that name.")
        origin = headers.get("origin", "")
        is_own = not origin or origin.lower() in {f"http://{host}" for host in self.hosts}
        if not is_own or headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return refused(403, "The request comes from another site.")
        if method not in ("GET", "HEAD", "POST"):
            return refused(405, "Only GET, HEAD and POST are answered.")
        if method == "POST" and not origin:
            return refused(403, "A change needs the header Origin.")
        token = request.query_params.get("token", "") if request.scope["path"] == "/" else ""
        has_cookie = _same(request.cookies.get(self._cookie_name, ""), self._cookie)
        if has_cookie and not token:
            return None
        if has_cookie or (method == "GET" and _same(token, self.token)):
            cookie = f"{self._cookie_name}={self._cookie}; Path=/; HttpOnly; SameSite=Strict"
            # A redirect, so that the browser does not keep the token in its address.
            return Response(status_code=303, headers={"location": "/", "set-cookie": cookie})
        return refused(401, "Open the address with the token that the terminal printed first.")


def _same(text: str, wanted: str) -> bool:
    """Return whether two texts are equal; the time does not depend on where they differ."""
    return hmac.compare_digest(text.encode(), wanted.encode())


def static_route(path: str, name: str) -> Route:
    """Return a route that answers requests of `path` with the file `name` in web/static/.

    path: of the address, such as "/page.css".
    """
    return Route(path, lambda request: FileResponse(STATIC / name))


def picture_routes(session: Session) -> list[Route]:
    """Return the routes of a session's panoramas in false colour (PNG), and of their scale.

    Their paths are /picture/SLOT.png and /scale.png; queries: see `picture`.
    """

    def picture(request: Request) -> Response:
        """Answer with a panorama as PNG, in false colours from `low` to `high` cd/m2.

        Queries of the request: low and high; width in pixels, 920 if missing. Raises HTTPException
        with status 400 for a wrong slot or query, 404 for a panorama that cannot be read.
        """
        slot = request.path_params["slot"]
        try:
            low, high = (float(request.query_params[name]) for name in ("low", "high"))
            width = int(request.query_params.get("width", "920"))
            is_slot = slot_id(parse_utc(slot)) == slot  # else it could be the path of another file
        except (KeyError, ValueError):
            raise HTTPException(400) from None
        if not (is_slot and 1e-6 <= low < high <= 1e12 and width >= 16):
            raise HTTPException(400)
        try:
            data = picture_png(session.panorama(slot), width, low, high)
        except (InputError, OSError):
            raise HTTPException(404) from None
        return Response(data, media_type="image/png", headers=_CACHED)

    def scale(request: Request) -> Response:
        """Answer with the colours of the scale from low to high, 256 x 1 pixels."""
        return Response(png_of(colour_table()[None]), media_type="image/png", headers=_CACHED)

    return [Route("/picture/{slot}.png", picture), Route("/scale.png", scale)]


def watch_routes(
    session: Session, snapshots: Snapshots, worker: Worker | None = None
) -> list[Route]:
    """Return the web routes of the page of `fieldlum watch`.

    snapshots: of `session`; worker: computes the glare classes so far, None if nothing does.
    """

    def state() -> Mapping[str, object]:
        """Return `Snapshots.state` and the key answer: a text that changes with /answer.json."""
        predicted = session.root / "watch" / "annual" / "predict.json"
        written_ns = predicted.stat().st_mtime_ns if predicted.is_file() else 0
        doing = [worker.step, worker.problem] if worker else []
        return {**snapshots.state(), "answer": " ".join([str(written_ns), *doing])}

    def day(request: Request) -> Response:
        """Answer with `Snapshots.day` of the date in the address, such as /day/2027-03-20.json.

        Raises HTTPException with status 404 for no date of the years 1970 to 2999.
        """
        try:
            local_day = date.fromisoformat(request.path_params["day"])
        except ValueError:
            raise HTTPException(404) from None
        if not 1970 <= local_day.year <= 2999:
            raise HTTPException(404)
        return _json_response(lambda: snapshots.day(local_day))

    return [
        static_route("/", "watch.html"),
        static_route("/watch.js", "watch.js"),
        static_route("/page.css", "page.css"),
        Route("/state.json", lambda _: _json_response(state)),
        Route("/answer.json", lambda _: _json_response(lambda: answer_table(session, worker))),
        Route("/calendar.json", lambda _: _json_response(snapshots.calendar)),
        Route("/day/{day}.json", day),
        *picture_routes(session),
    ]


def _json_response(compute: Callable[[], Mapping[str, object]]) -> Response:
    """Return the table that `compute` returns as JSON; status 503 if it cannot be computed now."""
    try:
        return JSONResponse(compute())
    except (InputError, OSError, ValueError) as error:  # ValueError: JSON has no NaN
        return JSONResponse({"error": str(error)}, 503)


class Served(NamedTuple):
    """A server that is ready to run.

    app: answers the requests; socket: listens already; address: of the page, with the token.
    """

    app: ASGIApp
    socket: socket.socket
    address: str

    def run(self) -> None:
        """Serve until the process is interrupted."""
        how: dict[str, Any] = {"http": PatientProtocol, "ws": "none", "lifespan": "off"}
        how |= {"log_level": "warning", "server_header": False, "timeout_graceful_shutdown": 2}
        config = uvicorn.Config(self.app, access_log=False, **how)  # addresses hold the token
        uvicorn.Server(config).run(sockets=[self.socket])


def prepare(routes: Sequence[Route], port: int, *, lan: bool) -> Served:
    """Open a port and return the server that answers `routes` there.

    port: 0 chooses a free one; lan: whether other computers of the network can reach it. The port
    listens at once; requests are answered after `Served.run` is called. Raises DeviceError if the
    port cannot be used.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("0.0.0.0" if lan else "127.0.0.1", port))
        listener.listen()  # before the address is printed, so that it works at once
    except OSError as error:
        listener.close()
        remedy = "give another --port N, or --port 0 for a free one"
        raise DeviceError(f"port {port} cannot be used ({error.strerror}); {remedy}") from None
    port = listener.getsockname()[1]
    names, host = {"127.0.0.1", "localhost"}, "127.0.0.1"
    if lan:
        name = socket.gethostname()
        host = _lan_address() or host
        names |= {host, *((name, f"{name}.local") if name else ())}
    app = Guard(Starlette(routes=list(routes)), port, names)
    return Served(app, listener, f"http://{host}:{port}/?token={app.token}")


def _lan_address() -> str:
    """Return this computer's IPv4 address in its network, "" without one.

    Nothing is sent: to connect a UDP socket only chooses the interface.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # RFC 5737: an address for documentation
            return str(probe.getsockname()[0])
        except OSError:
            return ""


def qr_lines(text: str) -> list[str]:
    """Return a QR code of `text` as lines of half blocks, with the required margin.

    text: such as an address; OpenCV's error is raised above about 2900 bytes, the capacity of a QR
    code. A line shows two rows of modules. Light modules are drawn: print the lines in white on
    black.
    """
    import cv2

    light = np.asarray(cv2.QRCodeEncoder.create().encode(text)) > 127  # [n, n] modules
    light = np.pad(light, 2, constant_values=True)  # the encoder adds two of the four modules
    light = np.pad(light, ((0, len(light) % 2), (0, 0)), constant_values=True)  # full pairs of rows
    blocks = np.array([" ", "▄", "▀", "█"])  # by 2 x upper + lower module
    return ["".join(line) for line in blocks[2 * light[0::2] + light[1::2]]]
