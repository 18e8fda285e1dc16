"""`fieldlum watch --control`: what a page may change, and that the capture never waits for it."""

from __future__ import annotations

import http.client
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from browser import CHROMIUM, chromium
from click.testing import CliRunner
from places import SEATTLE
from tiny_field import LADDER, T0, Field, make_session

from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.records import SiteFile, Slot, utc_text
from fieldlum.devices.clock import FastClock
from fieldlum.plan.makeup import EXTRA, add_extra
from fieldlum.session import (
    Journal,
    Session,
    create_session,
    marks,
    pause,
    paused_until,
    read_journal,
    resume,
)
from fieldlum.session.pause import MAX_PAUSE

MAIN = "import sys; sys.argv[0] = 'fieldlum'; from fieldlum.cli import main; main()"
JSON = "application/json"


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return make_session(tmp_path / "s")


@pytest.fixture
def page(session: Session) -> Iterator[Page]:
    yield from served(session, "--control")


class Page:
    """A running `fieldlum watch` and its cookie."""

    def __init__(self, address: str) -> None:
        self.address, self.place = address, urlsplit(address)
        _, headers, _ = self.ask("GET", "/?" + self.place.query, cookie=False)
        self.cookie = headers["set-cookie"].split(";")[0]

    def ask(
        self,
        method: str,
        path: str,
        body: bytes | None = None,
        *,
        cookie: bool = True,
        more: Mapping[str, str | None] | None = None,
    ) -> tuple[int, dict[str, str], bytes]:
        """more: headers that replace those of the page itself; None leaves one out."""
        own: dict[str, str | None] = {}
        if body is not None:
            own = {"Origin": f"http://{self.place.netloc}", "Content-Type": JSON}
        if cookie:
            own["Cookie"] = self.cookie
        own |= more or {}
        connection = http.client.HTTPConnection(
            self.place.hostname or "", self.place.port, timeout=20
        )
        try:
            headers = {name: value for name, value in own.items() if value is not None}
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            found = {name.lower(): value for name, value in answer.getheaders()}
            return answer.status, found, answer.read()
        finally:
            connection.close()

    def change(self, action: str, **asked: Any) -> dict[str, str]:
        status, _, body = self.ask("POST", f"/control/{action}", json.dumps(asked).encode())
        assert status == 200
        return json.loads(body)


def served(session: Session, *options: str) -> Iterator[Page]:
    command = [sys.executable, "-c", MAIN, "watch", str(session.root), "--port", "0"]
    process = subprocess.Popen(
        [*command, "--no-compute", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=dict(os.environ),
    )
    assert process.stdout is not None and process.stderr is not None
    try:
        line = process.stdout.readline().strip()
        assert line.startswith("http://127.0.0.1:"), process.stderr.read()
        yield Page(line)
    finally:
        process.terminate()
        process.communicate(timeout=20)


def events(session: Session) -> list[str]:
    return [row["event"] for row in read_journal(session)]


@pytest.mark.slow
@pytest.mark.contract
def test_notes_and_marks_come_into_the_journal(page: Page, session: Session) -> None:
    slot = session.slots()[0].id
    assert page.change("note", text="  blind\nrepaired \x1b[31m") == {
        "text": "Noted: blind repaired [31m"
    }
    assert page.change("mark", slot=slot, state="lamp=on;blind=up") == {"text": f"{slot}: lamp=on."}
    assert marks(session) == {slot: "lamp=on"}
    assert [row.get("text") for row in read_journal(session)] == ["blind repaired [31m", None]
    for action, asked in (
        ("note", {"text": " "}),
        ("note", {"text": "x" * 501}),
        ("mark", {"slot": slot, "state": "lamp=blue"}),
        ("mark", {"slot": "../../x", "state": "lamp=on"}),
        ("extra", {}),  # no capture runs
        ("pause", {"minutes": 15}),
    ):
        assert "error" in page.change(action, **asked)
    assert len(events(session)) == 2
    assert page.change("pause", minutes=0) == {"text": "The capture goes on."}


@pytest.mark.slow
@pytest.mark.contract
def test_another_site_or_a_form_changes_nothing(page: Page, session: Session) -> None:
    note = json.dumps({"text": "x"}).encode()
    for status, headers in (
        (401, {"Cookie": None}),
        (401, {"Cookie": page.cookie + "x"}),
        (403, {"Origin": None}),
        (403, {"Origin": "https://evil.example"}),
        (403, {"Origin": "null"}),
        (403, {"Sec-Fetch-Site": "cross-site"}),
        (403, {"Sec-Fetch-Site": "same-site"}),
        (421, {"Host": "evil.example"}),
        (415, {"Content-Type": "text/plain"}),
        (415, {"Content-Type": "application/x-www-form-urlencoded"}),
    ):
        assert page.ask("POST", "/control/note", note, more=headers)[0] == status, headers
    assert page.ask("GET", "/control/note")[0] == 405
    assert page.ask("POST", "/control/other", note)[0] == 400
    for body in (b"", b"[]", b"{", b"[" * 8000, b'{"text": 5}', b'{"note": "x"}', b"\xff"):
        assert page.ask("POST", "/control/note", body)[0] == 400
    assert page.ask("POST", "/control/note", b" " * 9000)[0] == 413
    for minutes in ("15", None, True, [], {}):
        body = json.dumps({"minutes": minutes}).encode()
        assert page.ask("POST", "/control/pause", body)[0] == 400
    assert events(session) == []


@pytest.mark.slow
@pytest.mark.contract
def test_without_the_option_the_page_only_reads(session: Session) -> None:
    for page in served(session):
        assert page.ask("POST", "/control/note", b'{"text": "x"}')[0] in (404, 405)
        assert page.ask("GET", "/control.js")[0] == 404
        assert b"control.js" not in page.ask("GET", "/")[2]


@pytest.mark.contract
def test_control_in_the_network_is_refused_unless_asked_for_twice(session: Session) -> None:
    answer = CliRunner().invoke(main, ["watch", str(session.root), "--lan", "--control"])
    assert answer.exit_code == 2
    assert "Give --control twice" in answer.output


# ----------------------------------------------------------------------------------------------
# pause


@pytest.mark.contract
def test_a_paused_capture_begins_no_bracket_and_names_why(session: Session) -> None:
    """A pause over the first of three slots; the others are taken."""
    until = T0 + timedelta(minutes=30)
    session.pause.write_text(json.dumps({"until_utc": utc_text(until)}), encoding="utf-8")
    field = Field(session, FastClock(T0 - timedelta(minutes=1)))
    field.run()
    outcomes = [row for row in read_journal(session) if row["event"] in ("done", "missed")]
    assert [row["event"] for row in outcomes] == ["missed", "done", "done"]
    assert outcomes[0]["why"].endswith("the capture was paused")


@pytest.mark.contract
def test_a_pause_that_ends_within_the_grace_costs_no_slot(session: Session) -> None:
    until = T0 + timedelta(minutes=2)
    session.pause.write_text(json.dumps({"until_utc": utc_text(until)}), encoding="utf-8")
    field = Field(session, FastClock(T0 - timedelta(minutes=1)))
    field.run()
    rows = read_journal(session)
    assert [row["event"] for row in rows if row["event"] in ("done", "missed")] == ["done"] * 3
    began = next(row["t_utc"] for row in rows if row["event"] == "started")
    assert utc_text(until) <= began


@pytest.mark.contract
@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", '{"until_utc": 5}', '{"until_utc": "2999-01-01T00:00:00Z"}', '{"x": "y"}'],
)
def test_a_wrong_pause_file_costs_no_bracket(session: Session, text: str) -> None:
    session.pause.write_text(text, encoding="utf-8")
    assert paused_until(session, T0) is None


@pytest.mark.contract
def test_a_pause_is_limited_and_ends_on_request(session: Session) -> None:
    for wrong in (timedelta(0), -MAX_PAUSE, MAX_PAUSE + timedelta(seconds=1)):
        with pytest.raises(InputError, match="minutes"):
            pause(session, wrong)
    until = pause(session, timedelta(minutes=5))
    assert paused_until(session, datetime.now(UTC)) == until
    resume(session)
    resume(session)
    assert paused_until(session, datetime.now(UTC)) is None
    assert events(session) == ["paused", "resumed"]


# ----------------------------------------------------------------------------------------------
# an extra bracket


@pytest.mark.contract
def test_an_extra_bracket_fits_between_planned_ones(tmp_path: Path) -> None:
    noon = datetime(2027, 3, 20, 20, 30, tzinfo=UTC)
    plan = [Slot(noon + timedelta(hours=h), 40.0, 180.0, LADDER) for h in (0, 1)]
    session = create_session(
        tmp_path / "s", SiteFile(SEATTLE), plan, {"set": "test", "seconds_per_slot": 40.0}
    )
    before = session.plan.read_bytes()
    for now in (noon - timedelta(seconds=150), noon - timedelta(seconds=40)):
        with pytest.raises(InputError, match="too close"):
            add_extra(session, now)
    with pytest.raises(InputError, match="below the horizon"):
        add_extra(session, noon + timedelta(hours=10))
    assert session.plan.read_bytes() == before
    slot = add_extra(session, noon + timedelta(minutes=20, seconds=20))
    assert slot.t_utc == noon + timedelta(minutes=22)
    assert slot.exposures == LADDER and EXTRA in slot.tags
    assert [s.id for s in session.slots()] == [plan[0].id, slot.id, plan[1].id]
    with pytest.raises(InputError, match="is already planned"):
        add_extra(session, noon + timedelta(minutes=20, seconds=30))


@pytest.mark.contract
def test_a_plan_without_slots_takes_no_extra_bracket(tmp_path: Path) -> None:
    session = create_session(tmp_path / "s", SiteFile(SEATTLE), [], {"set": "test"})
    with pytest.raises(InputError, match="no slot, so the exposures"):
        add_extra(session, datetime(2027, 3, 20, 20, 30, tzinfo=UTC))


@pytest.mark.contract
def test_a_running_capture_takes_an_extra_bracket(tmp_path: Path) -> None:
    plan = [Slot(T0 + timedelta(hours=h), 20.0, 120.0, LADDER) for h in (0, 2)]
    session = create_session(tmp_path / "s", SiteFile(SEATTLE), plan, {"set": "test"})
    field = Field(session, FastClock(T0 - timedelta(minutes=1)))
    added: list[Slot] = []

    class Looks(list[Any]):
        def append(self, live: Any) -> None:
            if live.done == 1 and not added:
                added.append(add_extra(session, live.t_utc))

    field.shown = Looks()
    field.run()
    done = [row["slot"] for row in read_journal(session) if row["event"] == "done"]
    assert done == [plan[0].id, added[0].id, plan[1].id]


# ----------------------------------------------------------------------------------------------
# the capture never waits


@pytest.mark.contract
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no flock")
def test_a_journal_held_by_a_stopped_program_does_not_hold_the_capture(session: Session) -> None:
    """A program that was stopped in the middle of a line holds the lock for ever."""
    import fcntl

    Journal(session).close()
    with session.journal.open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        field = Field(session, FastClock(T0 - timedelta(minutes=1)))
        thread = threading.Thread(target=field.run, daemon=True)
        thread.start()
        thread.join(60)
        assert not thread.is_alive()
    assert events(session).count("done") == 3


@pytest.mark.contract
def test_events_of_people_do_not_move_the_clock_of_the_capture(session: Session) -> None:
    """A note at a wrong clock must not make the capture refuse to start again."""
    journal = Journal(session)
    journal.append("note", T0 + timedelta(days=400), text="x")
    journal.append("marked", T0 + timedelta(days=400), slot=session.slots()[0].id, state="lamp=on")
    journal.close()
    Field(session, FastClock(T0 - timedelta(minutes=1))).run()
    assert events(session).count("done") == 3


# ----------------------------------------------------------------------------------------------
# in a browser


@pytest.mark.contract
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_the_controls_work_in_a_browser(page: Page, session: Session, tmp_path: Path) -> None:
    slot = session.slots()[0].id
    journal = Journal(session)
    journal.append("open", datetime.now(UTC), pid=os.getpid(), boot_id="")
    journal.append("done", datetime.now(UTC), slot=slot)
    with chromium(tmp_path) as browser:
        browser.size(390, 800, phone=True)
        browser.open(page.address)
        browser.until("document.getElementById('mark-slot').options.length === 1")
        assert browser.run("document.documentElement.scrollWidth") == 390
        browser.run("document.getElementById('note').value = '<b>lamp changed</b>'")
        browser.run("document.getElementById('note').focus()")
        browser.key("Enter", 13)
        browser.until("document.body.innerText.includes('Note: <b>lamp changed</b>')")
        browser.run("document.getElementById('mark-lamp').value = 'on'")
        roles = browser.named_parts()
        assert {("button", "Pause"), ("button", "Mark"), ("button", "Extra bracket now")} <= set(
            roles
        )
        browser.run(
            "[...document.querySelectorAll('button')].find(b => b.textContent === 'Mark').click()"
        )
        browser.until("document.getElementById('control-line').textContent.includes('lamp=on')")
        browser.run(
            "[...document.querySelectorAll('button')].find(b => b.textContent === 'Pause').click()"
        )
        browser.until("document.getElementById('running').textContent.startsWith('paused until')")
        assert browser.complaints() == []
    journal.close()
    assert marks(session) == {slot: "lamp=on"}
    end = time.monotonic() + 5
    while paused_until(session, datetime.now(UTC)) is None:
        assert time.monotonic() < end
