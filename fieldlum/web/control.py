"""What `fieldlum watch --control` lets the page change: notes, marks, an extra bracket, a pause.

Each change is a file that the capture reads when it has time, or a journal line; the capture never
waits for the page. Requests need the cookie and the page's own Origin (`fieldlum.web.access`), and
a content type that a form of another site cannot send.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import NoReturn

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from fieldlum.core.errors import InputError
from fieldlum.core.records import JsonTable
from fieldlum.plan.makeup import add_extra
from fieldlum.session import Session, add_note, mark_slot, pause, resume
from fieldlum.web.access import json_body

_MAX_BODY = 8192  # bytes; a note is far shorter; not measured


@dataclass(slots=True)
class Control:
    """Changes of one session, carried out one at a time.

    state: returns the page's present state, as `Snapshots.state`.
    """

    session: Session
    state: Callable[[], JsonTable]
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def do(self, action: str, asked: Mapping[str, object]) -> str:
        """Carry out `action`: note, mark, extra or pause; return what was done, as a sentence.

        asked: text for a note; slot and state for a mark; minutes for a pause (0 ends it); extra
        plans a bracket now. Raises InputError for what cannot be done now; KeyError, TypeError,
        ValueError or OverflowError for a malformed request.
        """
        with self._lock:
            if action == "note":
                return f"Noted: {add_note(self.session, _text(asked, 'text'))}"
            return {"mark": self._mark, "extra": self._extra, "pause": self._pause}[action](asked)

    def _mark(self, asked: Mapping[str, object]) -> str:
        slot = _text(asked, "slot")
        state = mark_slot(self.session, slot, _text(asked, "state"))
        return f"{slot}: {state or 'as usual'}."

    def _extra(self, asked: Mapping[str, object]) -> str:
        state = self._running()
        if state["next"] is not None and state["next"]["state"] == "running":
            self._refuse(
                "a bracket is being taken now", "no bracket in progress", "try again later"
            )
        slot = add_extra(self.session, datetime.now(UTC))
        return f"An extra bracket is planned at {slot.t_utc:%H:%M} UTC."

    def _pause(self, asked: Mapping[str, object]) -> str:
        minutes = asked["minutes"]
        if isinstance(minutes, bool) or not isinstance(minutes, int | float):
            raise TypeError
        if minutes == 0:
            resume(self.session)
            return "The capture goes on."
        self._running()
        until = pause(self.session, timedelta(minutes=float(minutes)))
        return f"No bracket begins before {until:%H:%M} UTC. Slots until then are missed."

    def _running(self) -> JsonTable:
        """Return the present state; raise InputError unless a capture runs in real time."""
        state = self.state()
        if state["rehearsal"]:
            remedy = "start fieldlum capture without --clock fast"
            self._refuse("a rehearsal in simulated time", "a capture in real time", remedy)
        if state["running"] is False:
            remedy = "start fieldlum capture first"
            self._refuse("no capture runs in this session", "a running capture", remedy)
        return state

    def _refuse(self, found: str, expected: str, remedy: str) -> NoReturn:
        raise InputError(self.session.root, found, expected, remedy)


def _text(asked: Mapping[str, object], key: str) -> str:
    text = asked[key]
    if not isinstance(text, str):
        raise TypeError(key)
    return text


def control_routes(control: Control) -> list[Route]:
    """Return the POST route /control/ACTION; its JSON answer has the key `text` or `error`.

    A malformed request gets status 400.
    """

    async def change(request: Request) -> Response:
        asked = await json_body(request, _MAX_BODY)
        try:
            text = await asyncio.to_thread(control.do, request.path_params["action"], asked)
        except (InputError, OSError) as error:
            return JSONResponse({"error": str(error)})
        except (KeyError, TypeError, ValueError, OverflowError):
            raise HTTPException(400) from None
        return JSONResponse({"text": text})

    return [Route("/control/{action}", change, methods=["POST"])]
