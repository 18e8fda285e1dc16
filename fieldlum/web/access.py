"""Decide which requests are answered: those with the token or its cookie, from the page itself.

Every program on this computer, and every web site open in its browser, can send requests to
loopback. So the token is needed on loopback too, and the Host and Origin headers must name this
server. Another site can then not read the pages, even if its name points to 127.0.0.1.
"""

from __future__ import annotations

import hmac
import json
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qs

from starlette.exceptions import HTTPException
from starlette.requests import Request


async def json_body(request: Request, most_bytes: int) -> Mapping[str, Any]:
    """Return the JSON object of a request of at most `most_bytes`, else raise HTTPException.

    Its status is 415 for another content type, 413 for a longer body, 400 for other content.
    """
    if request.headers.get("content-type", "").partition(";")[0] != "application/json":
        raise HTTPException(415)
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > most_bytes:
            raise HTTPException(413)
    try:
        asked = json.loads(data)
    except (ValueError, RecursionError):
        raise HTTPException(400) from None
    if not isinstance(asked, dict):
        raise HTTPException(400)
    return asked


TOKEN_BYTES = 32  # 256 random bits cannot be guessed, so wrong tokens need no counting; chosen

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


@dataclass(frozen=True, slots=True)
class Ruling:
    """Decision about a request.

    status 200: answer it; 303: turn the token into a cookie and remove it from the address; any
    other: refuse it with `text`.
    """

    status: int
    text: str = ""


class Access:
    """The token of one run of the server, its cookie, and the host names that the server has.

    names: without the port. After the first request with the token the browser uses the cookie.
    """

    def __init__(self, port: int, names: Iterable[str]) -> None:
        """names: host names and addresses without a port, an IPv6 address in brackets."""
        self.token = secrets.token_urlsafe(TOKEN_BYTES)
        self._cookie = secrets.token_urlsafe(TOKEN_BYTES)
        # Cookies are shared by all ports of a host: two sessions that are watched need two names.
        self._cookie_name = f"fieldlum-{port}"
        self.hosts = frozenset(f"{name}:{port}".lower() for name in names)

    @property
    def set_cookie(self) -> str:
        """Value of the Set-Cookie header whose cookie replaces the token."""
        return f"{self._cookie_name}={self._cookie}; Path=/; HttpOnly; SameSite=Strict"

    def rule(self, method: str, path: str, query: str, headers: Mapping[str, str]) -> Ruling:
        """Decide about one request by its names, origin, method, and token or cookie.

        method: in capitals; query: without the question mark; headers: by name in lower case.
        """
        if headers.get("host", "").lower() not in self.hosts:
            return Ruling(421, "This server does not have that name.")
        origin = headers.get("origin", "")
        if origin and origin.lower() not in {f"http://{host}" for host in self.hosts}:
            return Ruling(403, "The request comes from another site.")
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return Ruling(403, "The request comes from another site.")
        if method not in ("GET", "HEAD", "POST"):
            return Ruling(405, "Only GET, HEAD and POST are answered.")
        if method == "POST" and not origin:
            return Ruling(403, "A change needs the header Origin.")
        if self._has_cookie(headers.get("cookie", "")):
            return Ruling(303 if path == "/" and "token" in parse_qs(query) else 200)
        token = parse_qs(query).get("token", [""])[0]
        if path == "/" and method == "GET" and _same(token, self.token):
            return Ruling(303)
        return Ruling(401, "Open the address with the token that the terminal printed first.")

    def _has_cookie(self, header: str) -> bool:
        pairs = (part.strip().partition("=") for part in header.split(";"))
        return any(
            name == self._cookie_name and _same(value, self._cookie) for name, _, value in pairs
        )


def _same(token: str, wanted: str) -> bool:
    """Compare in constant time."""
    return hmac.compare_digest(token.encode(), wanted.encode())
