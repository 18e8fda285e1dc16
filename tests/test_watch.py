"""`fieldlum watch`: who may ask, what the tables hold, and the page in a real browser."""

from __future__ import annotations

import http.client
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import click
import numpy as np
import pytest
from browser import CHROMIUM, chromium
from click.testing import CliRunner
from places import SEATTLE
from starlette.responses import PlainTextResponse
from test_session import WRONG_EVENTS
from tiny_field import LADDER, T0, Field, make_session

from fieldlum.cli import watch_command
from fieldlum.core.files import encode_line
from fieldlum.core.records import IrradianceSample, Panorama, SiteFile, Slot, utc_text
from fieldlum.devices.clock import FastClock
from fieldlum.optics.images import write_panorama
from fieldlum.session import (
    DayFiles,
    Journal,
    Session,
    create_session,
    read_journal,
    update_session,
)
from fieldlum.session.files.model_files import ModelConfig, TrainingNote
from fieldlum.session.files.predict_json import DirectionYear, PredictFile, YearWeather
from fieldlum.session.files.sidecar import Sidecar
from fieldlum.web.prediction_so_far import Moment, Worker, answer_table
from fieldlum.web.server import Guard, _json_response, prepare, qr_lines
from fieldlum.web.snapshot import DayBins, JournalFollower, Snapshots

HOSTILE = '<img src=x onerror="document.body.dataset.hacked=1">'
ANSWER = (
    "From 12 captures",
    "S 180°",
    "cannot tell yet (medium is likeliest)",
    "not seen",
    "0.360",
)
MAIN = "import sys; sys.argv[0] = 'fieldlum'; from fieldlum.cli import main; main()"
# The pipe closes when pytest ends, also if it is killed: no server outlives it.
SERVER = f"""
import os, sys, threading
end = threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True)
end.start()
{MAIN}
"""


def _session(folder: Path) -> Session:
    """Two days: the first with a done, a missed and a made-up slot; names are hostile."""
    plan = [Slot(T0 + timedelta(hours=h), 20.0, 120.0, LADDER) for h in (0, 1, 2, 24)]
    plan.append(Slot(T0 + timedelta(hours=48), 20.0, 120.0, LADDER, (f"makeup:{plan[2].id}",)))
    site = SiteFile(replace(SEATTLE, name=HOSTILE))
    session = create_session(folder, site, plan, {"set": "test", "megabytes_per_slot": 100.0})
    journal = Journal(session)
    journal.append("open", T0 - timedelta(minutes=1), pid=0, boot_id="another")
    for slot, event, why in (
        (plan[0], "done", ""),
        (plan[1], "missed", HOSTILE),
        (plan[2], "aborted", "the disk is full"),
        (plan[4], "done", "clipped"),
    ):
        journal.append(event, slot.t_utc + timedelta(minutes=1), slot=slot.id, why=why)
    journal.append("device-lost", T0 + timedelta(hours=3), device="camera", why="no answer")
    journal.close()
    for slot, light in ((plan[0], 100.0), (plan[4], 1000.0)):
        pixels = np.full((20, 40), light, np.float32)
        pixels[5:9, 15:25] = 20 * light
        path = session.panorama(slot.id)
        path.parent.mkdir(exist_ok=True)
        write_panorama(path, Panorama(pixels, 180.0))
        Sidecar(slot.id, verdict=f"good {HOSTILE}").write(session.sidecar(slot.id))
    days = DayFiles(session)
    for k in range(60):
        t = T0 + timedelta(minutes=k)
        status = HOSTILE if k == 5 else ""
        ghi = 5000.0 if k == 20 else 300.0 + k
        days.append(IrradianceSample(t, ghi_wm2=ghi, dhi_wm2=100.0, dni_wm2=400.0, status=status))
    days.close()
    _write_answer(session)
    return session


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return _session(tmp_path_factory.mktemp("watch") / "office & more")


@pytest.fixture(scope="module")
def address(session: Session) -> Iterator[str]:
    yield from _watched(session)


def _watched(session: Session, *options: str) -> Iterator[str]:
    """The first line that `fieldlum watch` prints."""
    command = [
        sys.executable,
        "-c",
        SERVER,
        "watch",
        str(session.root),
        "--port",
        "0",
        "--no-compute",
    ]
    command += options
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stderr is not None
    try:
        line = process.stdout.readline().strip()
        assert line.startswith("http://127.0.0.1:"), process.stderr.read()
        yield line
    finally:
        process.terminate()
        process.communicate(timeout=20)


def _ask(
    address: str, path: str, headers: dict[str, str] | None = None, method: str = "GET"
) -> tuple[int, dict[str, str], bytes]:
    place = urlsplit(address)
    connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=20)
    try:
        connection.putrequest(method, path, skip_host=headers is not None and "Host" in headers)
        for name, value in (headers or {}).items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        found = {name.lower(): value for name, value in answer.getheaders()}
        return answer.status, found, answer.read()
    finally:
        connection.close()


@pytest.fixture(scope="module")
def cookie(address: str) -> str:
    status, headers, _ = _ask(address, "/?" + urlsplit(address).query)
    assert (status, headers["location"]) == (303, "/")
    assert {"HttpOnly", "SameSite=Strict"} <= set(headers["set-cookie"].split("; "))
    token = urlsplit(address).query.removeprefix("token=")
    assert token not in headers["set-cookie"]
    return headers["set-cookie"].split(";")[0]


# ----------------------------------------------------------------------------------------------
# who may ask


@pytest.mark.contract
def test_without_the_token_nothing_is_answered(address: str, cookie: str) -> None:
    for path in ("/", "/state.json", "/watch.js", "/picture/20270320T153000Z.png", "/nothing"):
        assert _ask(address, path)[0] == 401
    other = Guard(PlainTextResponse(""), 1, ("127.0.0.1",))
    for token in ("", "x", other.token, "%00", "é".encode().hex(), "a" * 5000):
        assert _ask(address, f"/?token={token}")[0] == 401
    for old in (f"fieldlum-1={other.token}", cookie + "x", cookie[:-1], "fieldlum-1=", ";;=;"):
        assert _ask(address, "/state.json", {"Cookie": old})[0] == 401
    status, headers, _ = _ask(address, "/state.json", {"Cookie": f"other=1; {cookie}"})
    assert status == 200
    assert "default-src 'none'" in headers["content-security-policy"]
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["x-content-type-options"] == "nosniff"
    assert "server" not in headers


@pytest.mark.contract
def test_other_hosts_origins_and_methods_are_refused(address: str, cookie: str) -> None:
    """A name that a foreign site points to 127.0.0.1 is not this server."""
    place = urlsplit(address)
    good = {"Cookie": cookie}
    for host in ("evil.example", f"evil.example:{place.port}", "127.0.0.1", "127.0.0.1:1", ""):
        assert _ask(address, "/state.json", good | {"Host": host})[0] in (400, 421)
    assert _ask(address, "/state.json", good | {"Host": f"localhost:{place.port}"})[0] == 200
    for origin in ("https://evil.example", "null", f"https://127.0.0.1:{place.port}"):
        assert _ask(address, "/state.json", good | {"Origin": origin})[0] == 403
    assert _ask(address, "/state.json", good | {"Sec-Fetch-Site": "cross-site"})[0] == 403
    own = {"Origin": f"http://127.0.0.1:{place.port}"}
    assert _ask(address, "/state.json", good | own)[0] == 200
    assert _ask(address, "/state.json", good, "POST")[0] == 403
    for method in ("PUT", "DELETE", "OPTIONS", "TRACE"):
        assert _ask(address, "/state.json", good | own, method)[0] == 405


@pytest.mark.contract
@pytest.mark.parametrize(
    "path",
    [
        "/picture/..%2F..%2Fsession.toml.png?low=1&high=9",
        "/picture/../../session.toml?low=1&high=9",
        "/picture/20270320T153000Z%00.png?low=1&high=9",
        "/picture/20270320T153000Z.png?low=9&high=1",
        "/picture/20270320T153000Z.png?low=nan&high=inf",
        "/picture/20270320T153000Z.png?low=1&high=9&width=15",
        "/picture/20270320T153000Z.png",
        "/picture/19990320T153000Z.png?low=1&high=9",
        "/day/../session.toml",
        "/day/..%2F..%2Fetc%2Fpasswd.json",
        "/static/../access.py",
        "//etc/passwd",
        "/session.toml",
    ],
)
def test_no_other_file_can_be_had(address: str, cookie: str, path: str) -> None:
    status, _, body = _ask(address, path, {"Cookie": cookie})
    assert status in (400, 404)
    assert len(body) < 200


@pytest.mark.contract
def test_the_smallest_picture_has_16_columns(session: Session, address: str, cookie: str) -> None:
    slot = session.slots()[0].id
    status, _, body = _ask(
        address, f"/picture/{slot}.png?low=1&high=9&width=16", {"Cookie": cookie}
    )
    assert status == 200 and body.startswith(b"\x89PNG")


@pytest.mark.contract
def test_a_server_starts_again_at_its_port_while_old_connections_end() -> None:
    first = prepare((), 0, lan=False)
    client = socket.create_connection(first.socket.getsockname())
    first.socket.accept()[0].close()  # the side that closes first waits a minute (TIME_WAIT)
    first.socket.close()
    client.close()
    again = prepare((), int(first.address.rpartition(":")[2].partition("/")[0]), lan=False)
    again.socket.close()


@pytest.mark.contract
def test_the_address_for_the_lan_can_be_opened() -> None:
    served = prepare((), 0, lan=True)
    try:
        host, port = urlsplit(served.address).hostname or "", urlsplit(served.address).port
        assert host != "0.0.0.0" and f"{host}:{port}" in served.app.hosts
        socket.create_connection((host, port), timeout=20).close()
    finally:
        served.socket.close()


@pytest.mark.slow
@pytest.mark.contract
def test_silent_connections_lock_nobody_out(address: str, cookie: str) -> None:
    """Twice as many as there are places; every other one begins a request and does not end it."""
    place = urlsplit(address)
    silent = [socket.create_connection((place.hostname, place.port)) for _ in range(128)]
    try:
        for connection in silent[::2]:
            with suppress(OSError):  # closed already, in favour of a newer one
                connection.sendall(b"GET / HTTP/1.1\r\nHost: ")
        for _ in range(3):
            assert _ask(address, "/state.json", {"Cookie": cookie})[0] == 200
        silent[-1].settimeout(20.0)
        assert silent[-1].recv(1) == b"", "no request within five seconds"
    finally:
        for connection in silent:
            connection.close()


@pytest.mark.contract
def test_a_refused_request_gives_its_place_back(address: str) -> None:
    assert _ask(address, "/")[1]["connection"] == "close"


@pytest.mark.contract
@pytest.mark.parametrize("day", ["9999-12-31", "0001-01-01", "2027-02-30", "today"])
def test_a_day_outside_calendars_is_not_found(address: str, cookie: str, day: str) -> None:
    assert _ask(address, f"/day/{day}.json", {"Cookie": cookie})[0] == 404


@pytest.mark.contract
def test_a_port_in_use_is_one_line(address: str, session: Session) -> None:
    port = str(urlsplit(address).port)
    command = [sys.executable, "-c", MAIN, "watch", str(session.root), "--port", port]
    shown = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert shown.returncode == 4
    assert f"port {port} cannot be used" in shown.stderr


@pytest.mark.slow
@pytest.mark.contract
def test_without_the_library_the_remedy_is_named(session: Session) -> None:
    code = f"import sys; sys.modules['uvicorn'] = None; {MAIN}"
    command = [sys.executable, "-c", code, "watch", str(session.root)]
    shown = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert shown.returncode == 3
    assert "pip install '.[web]'" in shown.stderr


@pytest.mark.property
def test_the_code_in_the_terminal_reads_as_the_address() -> None:
    import cv2

    text = f"http://192.168.178.40:8765/?token={'aB3_' * 11}"
    blocks = {"█": (255, 255), "▀": (255, 0), "▄": (0, 255), " ": (0, 0)}
    rows: list[list[int]] = []
    for line in qr_lines(text):
        rows += [[blocks[sign][half] for sign in line] for half in (0, 1)]
    picture = np.kron(np.array(rows, np.uint8), np.ones((8, 8), np.uint8))
    assert cv2.QRCodeDetector().detectAndDecode(picture)[0] == text


@pytest.mark.contract
def test_the_code_is_white_on_black_in_every_terminal() -> None:
    shown = click.command()(lambda: watch_command._show_lan("http://192.168.178.40:8765/"))
    assert "\x1b[38;5;231m\x1b[48;5;16m██" in CliRunner().invoke(shown, color=True).stderr


# ----------------------------------------------------------------------------------------------
# tables


@pytest.mark.contract
def test_the_tables_hold_plan_verdicts_and_flags(session: Session) -> None:
    now = T0 + timedelta(hours=2)
    tables = Snapshots(session, lambda: now)
    state = tables.state()
    assert state["rehearsal"] is True  # the journal is a day ahead of this clock
    days = tables.calendar()["days"]
    states = [slot["state"] for day in days for slot in day["slots"]]
    assert states == ["done", "missed", "made up", "missed", "done"]
    assert state["running"] is False  # another start of the computer
    assert list(state["devices"]["away"]) == ["camera"]
    day = tables.day(date(2027, 3, 20))
    assert day["slots"][0]["verdict"].startswith("good")
    curve = day["irradiance"]
    assert curve["flagged_bins"] == 1 and curve["impossible_bins"] == 1
    assert max(value for value in curve["dhi"] if value is not None) == 100.0
    json.dumps(state)


@pytest.mark.contract
@pytest.mark.parametrize("offset", ["abc", float("nan"), 1e300])
def test_what_a_camera_says_about_itself_does_not_stop_the_page(
    tmp_path: Path, offset: str | float
) -> None:
    session = make_session(tmp_path / "s")
    update_session(session, {"devices": {"camera": {"clock_offset_s": offset}}})
    state = Snapshots(session).state()
    assert json.dumps(state, allow_nan=False)


@pytest.mark.contract
def test_an_answer_that_no_page_can_show_is_said(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s")
    _write_answer(session)
    path = session.root / "watch" / "annual" / "predict.json"
    path.with_name("predict.json.sha256").unlink()
    path.write_text(path.read_text("utf-8").replace("0.41", "NaN"), "utf-8")
    assert _json_response(lambda: answer_table(session, None)).status_code == 503


@pytest.mark.contract
def test_before_the_first_slot_it_counts_down(tmp_path: Path) -> None:
    plain = make_session(tmp_path / "s")
    state = Snapshots(plain, lambda: T0 - timedelta(days=3)).state()
    Journal(plain).append("open", T0, pid=os.getpid(), boot_id="")
    for before_s, quiet in ((100.0, True), (60.0, False)):
        at = T0 - timedelta(seconds=before_s)
        assert Snapshots(plain, lambda at=at: at).moment() == (quiet, 0)
    assert state["next"]["t_utc"] == utc_text(T0)
    assert state["latest"] is None and state["irradiance"] is None
    assert state["counts"] == {"to do": 3}


@pytest.mark.property
def test_followed_files_give_what_a_whole_reading_gives(tmp_path: Path) -> None:
    """A line that is written in two pieces, a torn tail that is cut, a file that is replaced."""
    plain = make_session(tmp_path / "s")
    follower = JournalFollower(plain.journal)
    journal = Journal(plain)
    for k in range(3):
        journal.append("bad-reading", T0 + timedelta(minutes=k), device="pyranometer", why=str(k))
        follower.update()
    journal.close()
    with plain.journal.open("ab") as file:
        for row in WRONG_EVENTS:
            file.write(encode_line(row))  # type: ignore[arg-type]
        file.write(b"deadbeef {")
    follower.update()
    Journal(plain).close()  # cuts the torn tail
    journal = Journal(plain)
    journal.append("suspend", T0 + timedelta(minutes=9), seconds=5.0)
    journal.close()
    assert list(follower.update().events) == read_journal(plain)
    plain.journal.write_bytes(b"")
    assert not follower.update().events
    days = DayFiles(plain)
    bins = DayBins(plain.irradiance / f"{T0:%Y-%m-%d}.csv")
    for k in range(10):
        days.append(IrradianceSample(T0 + timedelta(seconds=12 * k), ghi_wm2=100.0 + k))
        bins.update()
    assert np.nansum(bins.means_wm2[:, 0]) == pytest.approx(104.5)
    days.close()


# ----------------------------------------------------------------------------------------------
# the answer so far


@pytest.mark.contract
def test_a_step_is_stopped_while_a_slot_is_near(tmp_path: Path) -> None:
    """The step writes numbers; while a bracket is taken it has the state T and writes nothing."""
    plain = make_session(tmp_path / "s")
    code = (
        "import sys, time, os\n"
        "for k in range(40):\n print(k, os.nice(0), file=sys.stderr)\n time.sleep(.05)"
    )
    near = [False]
    worker = Worker(
        plain,
        lambda: Moment(not near[0], 0),
        program=(sys.executable, "-c", code),
        look_every_s=0.02,
    )
    good: list[bool] = []
    thread = threading.Thread(target=lambda: good.append(worker._run("merge")))
    out = worker.folder / "merge.err"
    thread.start()
    _until(lambda: out.is_file() and len(out.read_text().splitlines()) > 3)
    near[0] = True
    time.sleep(0.4)
    before = out.read_text()
    time.sleep(0.4)
    assert out.read_text() == before
    assert before.splitlines()[-1].endswith(" 19")
    near[0] = False
    thread.join(20)
    assert good == [True]
    assert len(out.read_text().splitlines()) == 40


@pytest.mark.slow
@pytest.mark.contract
def test_steps_run_once_for_new_captures_and_their_faults_are_named(tmp_path: Path) -> None:
    plain = make_session(tmp_path / "s")
    code = "import sys; sys.exit('pair: no light' if sys.argv[1] == 'pair' else 0)"
    moments = [Moment(False, 9), Moment(True, 0), Moment(True, 9)]
    worker = Worker(plain, lambda: moments[0], program=(sys.executable, "-c", code))
    for _ in range(2):
        worker.work()
        assert not worker.folder.exists()
        moments.pop(0)
    worker.work()
    assert worker.problem == "pair: no light"
    (worker.folder / "merge.err").unlink()
    worker.work()
    assert not (worker.folder / "merge.err").exists()
    assert answer_table(plain, worker)["last"] is None


@pytest.mark.slow
@pytest.mark.contract
def test_new_brackets_are_merged_as_the_user_merged_the_others(tmp_path: Path) -> None:
    plain = make_session(tmp_path / "s")
    inputs = {"height": 115, "fit": False}
    plain.panoramas.mkdir()
    Sidecar(plain.slots()[0].id, inputs=inputs).write(plain.sidecar(plain.slots()[0].id))
    code = "import sys; print(*sys.argv[1:], file=sys.stderr)"
    worker = Worker(plain, lambda: Moment(True, 1), program=(sys.executable, "-c", code))
    worker.work()
    said = (worker.folder / "merge.err").read_text().split()
    assert said[4:] == ["--size", "230x115", "--no-fit"]


def _until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def _write_answer(session: Session) -> None:
    figures = ((0.0, True, 0.36), (180.0, False, 0.41), (270.0, False, None))
    rows = (
        DirectionYear(
            azimuth,
            "medium",
            certain=certain,
            dgp_exceeded=value,
            low=None if value is None else value - 0.02,
            high=None if value is None else value + 0.02,
        )
        for azimuth, certain, value in figures
    )
    year = PredictFile(weather=YearWeather(HOSTILE, True), notes=(HOSTILE,), protection=tuple(rows))
    note = TrainingNote(slots=tuple(map(str, range(12))))
    for folder, file in (("annual", year), ("model", ModelConfig("transport", training=note))):
        (session.root / "watch" / folder).mkdir(parents=True)
        file.write(session.root / "watch" / folder)


# ----------------------------------------------------------------------------------------------
# in a browser

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")


@pytest.mark.contract
@pytest.mark.slow
@needs_browser
def test_the_page_shows_the_session_and_takes_names_as_text(address: str, tmp_path: Path) -> None:
    with chromium(tmp_path) as page:
        page.size(390, 800, phone=True)
        page.open(address)
        page.until("document.body.dataset.polls >= 1")
        assert page.run("location.href").endswith("/")  # no token
        text = page.text()
        for part in (HOSTILE, "camera stopped answering", "was not taken", *ANSWER):
            assert part in text
        assert page.run("document.querySelectorAll('img[onerror]').length") == 0
        assert page.run("document.body.dataset.hacked || ''") == ""
        assert page.run("document.documentElement.scrollWidth") == 390
        page.until("document.getElementById('latest').naturalWidth > 0")
        roles = page.named_parts()
        assert ("button", "Day before") in roles and ("heading", "Latest panorama") in roles
        # steps through the days: by a click and by the keyboard
        first = page.run("document.getElementById('day-name').textContent")
        page.click_on("#before")
        page.until(f"document.getElementById('day-name').textContent !== {first!r}")
        page.run("document.getElementById('strip').focus()")
        page.key("PageDown", 34)
        page.until(f"document.getElementById('day-name').textContent === {first!r}")
        page.click_on("#calendar button")
        page.until("document.getElementById('day-name').textContent.includes('20 March 2027')")
        page.until("document.querySelector('#curve polyline.ghi') !== null")
        assert "impossible values: 1" in page.text()
        roles = page.named_parts()
        assert any(role == "image" and name.startswith("Irradiance") for role, name in roles)
        assert not [name for role, name in roles if role in ("button", "image") and not name]
        assert page.complaints() == []
        assert page.asked_hosts() == {address.split("/?")[0]}
        ground = "getComputedStyle(document.body).backgroundColor"
        light = page.run(ground)
        page.size(1200, 800, dark=True)
        assert page.run(ground) != light
        # a second run of the server has another token and another cookie
        assert page.run("document.cookie") == ""


@pytest.mark.contract
@pytest.mark.slow
@needs_browser
def test_a_month_with_the_page_open_is_as_without_it_and_the_page_does_not_grow(
    tmp_path: Path,
) -> None:
    """31 days at full speed: the journal is the same, and after the first days the page's heap
    and nodes stay.
    """

    def month(folder: Path) -> Field:
        folder.mkdir()
        plan = [Slot(T0 + timedelta(hours=24 * d), 10.0, 120.0, LADDER) for d in range(31)]
        made = create_session(folder / "s", SiteFile(SEATTLE), plan, {"set": "test"})
        return Field(made, FastClock(T0 - timedelta(minutes=1)))

    def events(field: Field) -> list[tuple[str, str, str]]:
        rows = read_journal(field.session)
        return [(row["event"], row["t_utc"], row.get("slot", "")) for row in rows]

    alone = month(tmp_path / "alone")
    alone.run()
    watched = month(tmp_path / "watched")
    sizes: list[tuple[int, int]] = []
    for address in _watched(watched.session):
        with chromium(tmp_path / "profile") as page:
            page.open(address)
            page.until("document.body.dataset.polls >= 1")

            class Looks(list[Any]):
                def append(self, live: Any) -> None:
                    if live.done % 3 == 0:  # on other days the page asks by itself
                        page.run("refresh()")
                        sizes.append(page.memory())

            watched.shown = Looks()
            watched.run()
            page.until("document.getElementById('running').textContent === 'finished'")
            assert "31 done" in page.text()
            assert page.complaints() == []
    assert events(watched) == events(alone)
    early, late = sizes[3], sizes[-1]
    assert late[0] < early[0] + 300_000 and late[1] < early[1] + 400, sizes
