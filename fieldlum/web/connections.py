"""Connections of the web server: one that sends no request leaves its place to another."""

from __future__ import annotations

import asyncio
import time

from uvicorn.protocols.http.h11_impl import H11Protocol

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
