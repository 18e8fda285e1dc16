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
from typing import Any
from urllib.parse import parse_qs

from starlette.exceptions import HTTPException
from starlette.requests import Request


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


class Access:
    """The token of one run of the server, its cookie, and the host names that the server has.

    names: without the port. After the first request with the token the browser uses the cookie.
    """

    def __init__(self, port: int, names: Iterable[str]) -> None:
        """names: host names and addresses without a port, an IPv6 address in brackets."""
        self.token, cookie = secrets.token_urlsafe(TOKEN_BYTES), secrets.token_urlsafe(TOKEN_BYTES)
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
