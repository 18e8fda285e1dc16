"""The web server of the pages: routes, headers, and one process on one port."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.session import Session
from fieldlum.web.access import SECURITY_HEADERS, Access
from fieldlum.web.answer import Worker, answer_table
from fieldlum.web.control import Control, control_routes
from fieldlum.web.pictures import picture_png, scale_png
from fieldlum.web.snapshot import Snapshots, is_slot_id

MAX_CONNECTIONS = 64  # bounds the open files; not measured
_REQUEST_S = 5.0  # for the headers of the first request; a phone on slow Wi-Fi needs under one


class PatientProtocol(H11Protocol):
    """A connection that is closed if its first request is not complete after five seconds.

    If there is no place for a new connection, the oldest one without a request is closed. Refused
    requests end their connection, so that only requests with the token keep a place.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection, if necessary in the place of a silent one."""
        self._began_s = time.monotonic()
        silent = [c for c in self.connections if isinstance(c, PatientProtocol) and c._silent]
        if len(self.connections) >= MAX_CONNECTIONS - 1 and silent:
            oldest = min(silent, key=lambda connection: connection._began_s)
            oldest.connections.discard(oldest)
            oldest.transport.abort()
        super().connection_made(transport)
        self.loop.call_later(_REQUEST_S, self._end_if_silent)

    @property
    def _silent(self) -> bool:
        """Whether no request arrived yet with all its headers."""
        return self.cycle is None

    def _end_if_silent(self) -> None:
        if self._silent:
            self.transport.abort()


STATIC = Path(__file__).parent / "static"
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
_FIRST_YEAR, _LAST_YEAR = 1970, 2999  # of days with a curve; chosen
_YEAR_S = 31_536_000  # 365 days


class Guard:
    """ASGI layer: refuse requests that `Access` does not allow; add security headers.

    Refused requests get the headers too.
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":  # no web sockets here
            return
        headers = dict(Headers(scope=scope).items())
        query = scope["query_string"].decode("latin-1")
        ruling = self._access.rule(scope["method"], scope["path"], query, headers)
        answer: ASGIApp = self._app
        if ruling.status == 303:
            cookie = {"location": "/", "set-cookie": self._access.set_cookie}
            answer = Response(status_code=303, headers=cookie)
        elif ruling.status != 200:
            # a closed connection leaves its place to a browser that has the cookie
            close = {"connection": "close"}
            answer = PlainTextResponse(f"{ruling.text}\n", ruling.status, close)

        async def secured(message: Message) -> None:
            if message["type"] == "http.response.start":
                added = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    added.setdefault(name, value)
            await send(message)

        await answer(scope, receive, secured)


def static_route(path: str, name: str) -> Route:
    """Return a route at `path` for the file `name` of this package."""
    body = (STATIC / name).read_bytes()
    kind = _TYPES[Path(name).suffix]
    return Route(path, lambda request: Response(body, media_type=kind))


def _page(scripts: Sequence[str]) -> Route:
    """Return the route of the watch page, with more scripts at the end of its head."""
    tags = "".join(f'<script src="{name}" defer></script>\n' for name in scripts)
    text = (STATIC / "watch.html").read_text(encoding="utf-8")
    body = text.replace("</head>", f"{tags}</head>", 1)
    return Route("/", lambda request: Response(body, media_type="text/html"))


def picture_routes(session: Session) -> list[Route]:
    """Return the web routes of a session's panoramas in false colour, and of their scale."""

    def picture(request: Request) -> Response:
        slot = request.path_params["slot"]
        try:
            low, high = (float(request.query_params[name]) for name in ("low", "high"))
            width = int(request.query_params.get("width", "920"))
        except (KeyError, ValueError):
            raise HTTPException(400) from None
        if not (is_slot_id(slot) and 1e-6 <= low < high <= 1e12 and width >= 16):
            raise HTTPException(400)
        try:
            data = picture_png(session.panorama(slot), width, low, high)
        except (InputError, OSError):
            raise HTTPException(404) from None
        # the address has the stamp of the file: a picture that is merged again has another one
        return Response(data, media_type="image/png", headers=_cached())

    def scale(request: Request) -> Response:
        return Response(scale_png(), media_type="image/png", headers=_cached())

    return [Route("/picture/{slot}.png", picture), Route("/scale.png", scale)]


def _cached() -> dict[str, str]:
    return {"Cache-Control": f"private, max-age={_YEAR_S}, immutable"}


def watch_routes(
    session: Session,
    snapshots: Snapshots,
    worker: Worker | None = None,
    control: Control | None = None,
) -> list[Route]:
    """Return the web routes of the page of `fieldlum watch`.

    worker: computes the glare classes so far, or None. control: changes the session on request, or
    None for a page that only reads.
    """

    def state() -> Mapping[str, object]:
        answers = session.root / "watch" / "answers.json"
        written = answers.stat().st_mtime_ns if answers.is_file() else 0
        doing = [worker.step, worker.problem] if worker else []
        return {**snapshots.state(), "answer": " ".join([str(written), *doing])}

    def day(request: Request) -> Response:
        try:
            wanted = date.fromisoformat(request.path_params["day"])
            if not _FIRST_YEAR <= wanted.year <= _LAST_YEAR:
                raise ValueError
        except ValueError:
            raise HTTPException(404) from None
        return table(lambda: snapshots.day(wanted))

    changes = []
    if control is not None:
        changes = [static_route("/control.js", "control.js"), *control_routes(control)]
    return [
        _page(["/control.js"] if changes else []),
        *changes,
        static_route("/watch.js", "watch.js"),
        static_route("/page.css", "page.css"),
        Route("/state.json", lambda request: table(state)),
        Route("/answer.json", lambda request: table(lambda: answer_table(session, worker))),
        Route("/calendar.json", lambda request: table(snapshots.calendar)),
        Route("/day/{day}.json", day),
        *picture_routes(session),
    ]


def table(make: Callable[[], Mapping[str, object]]) -> Response:
    """Return the table of `make` as JSON; status 503 if the session cannot be read now."""
    try:
        return JSONResponse(make())
    except (InputError, OSError) as error:
        return JSONResponse({"error": str(error)}, 503)


@dataclass(frozen=True, slots=True)
class Served:
    """A server that is ready to run.

    app: the routes with the access rules; socket: which listens already; address: with the token.
    """

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
            limit_concurrency=MAX_CONNECTIONS,
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
        listener.listen(MAX_CONNECTIONS)  # the printed address works at once
    except OSError as error:
        listener.close()
        raise DeviceError(
            f"port {port} cannot be used ({error.strerror}); "
            f"give another --port N, or --port 0 for a free one"
        ) from None
    port = listener.getsockname()[1]
    lan_name = lan_address() if lan else ""
    own = {"127.0.0.1", "localhost"} | ({lan_name, *_host_names()} if lan else set())
    access = Access(port, own - {""})
    host = lan_name or "127.0.0.1"
    app = Guard(Starlette(routes=list(routes)), access)
    return Served(app, listener, f"http://{host}:{port}/?token={access.token}")


def lan_address() -> str:
    """Return this computer's IPv4 address in its network, "" without one. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # RFC 5737: an address for documentation
            return str(probe.getsockname()[0])
        except OSError:
            return ""


def _host_names() -> set[str]:
    name = socket.gethostname()
    return {name, f"{name}.local"} if name else set()
