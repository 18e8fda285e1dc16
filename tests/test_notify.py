"""Messages and heartbeats: real local servers, days without network, and no secret in any file."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import pytest
from places import SEATTLE

from fieldlum.capture import notify, steady_clock
from fieldlum.capture.notify import (
    Alerts,
    Heartbeat,
    Message,
    Outbox,
    apprise_post,
    read_address,
    read_targets,
)
from fieldlum.capture.runner import Options, run
from fieldlum.capture.steady_clock import wait_for_clock
from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure, IrradianceSample, SiteFile, Slot
from fieldlum.devices import Camera, CameraInfo, InstrumentInfo, Pyranometer
from fieldlum.devices.clock import FastClock
from fieldlum.session import Session, create_session
from fieldlum.session.journal import EventFields

T0 = datetime(2027, 3, 20, 15, 30, tzinfo=UTC)
SECRET = "hunter2-very-secret"


@contextmanager
def http_server() -> Iterator[tuple[int, list[tuple[str, str]]]]:
    """A server that keeps (path, body) of each request."""
    requests: list[tuple[str, str]] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self._answer()

        def do_POST(self) -> None:
            self._answer()

        def _answer(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0))).decode()
            requests.append((self.path, body))
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"ok")

        def log_message(self, format: str, *args: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield server.server_address[1], requests
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def smtp_server() -> Iterator[tuple[int, list[str]]]:
    """The few commands of SMTP that a mail client uses; keeps the text of each mail."""
    mails: list[str] = []
    listening = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        while True:
            try:
                connection, _ = listening.accept()
            except OSError:
                return
            with connection, connection.makefile("rwb", buffering=0) as lines:
                lines.write(b"220 test\r\n")
                for line in lines:
                    command = line[:4].upper()
                    if command == b"DATA":
                        lines.write(b"354 go\r\n")
                        text = b""
                        while not text.endswith(b"\r\n.\r\n"):
                            text += lines.readline()
                        mails.append(text.decode())
                    if command == b"QUIT":
                        lines.write(b"221 bye\r\n")
                        break
                    lines.write(b"250 ok\r\n")

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield listening.getsockname()[1], mails
    finally:
        listening.shutdown(socket.SHUT_RDWR)
        listening.close()
        thread.join(5.0)


def until(condition: object, seconds: float = 5.0) -> bool:
    """Wait for a condition that another thread makes true."""
    event = threading.Event()
    for _ in range(int(seconds / 0.02)):
        if condition():  # type: ignore[operator]
            return True
        event.wait(0.02)
    return False


@pytest.fixture
def session(tmp_path: Path) -> Session:
    slots = [Slot(T0 + timedelta(hours=i), 10.0, 120.0, (Exposure(0.5, 5.6),)) for i in range(3)]
    site = SiteFile(SEATTLE)
    return create_session(tmp_path / "session", site, slots, {"set": "test"})


# Targets


@pytest.mark.contract
def test_addresses_come_from_a_file_and_no_error_quotes_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="@FILE") as refused:
        read_targets(f"mailto://user:{SECRET}@example.org")
    assert SECRET not in str(refused.value)
    path = tmp_path / "targets"
    path.write_text(f"# comment\n\njson://127.0.0.1:1/{SECRET}\n")
    assert read_targets(f"@{path}") == (f"json://127.0.0.1:1/{SECRET}",)
    path.write_text(f"# comment\njson://127.0.0.1:1/\nnonsense:{SECRET}\n")
    with pytest.raises(InputError, match=r"targets: .* understand address 2 of 2") as unknown:
        apprise_post(read_targets(f"@{path}"), path)
    assert SECRET not in str(unknown.value)
    for wrong in ("ftp://example.org\n", "http://exam ple.org\n"):
        path.write_text(wrong)
        with pytest.raises(InputError, match="http"):
            read_address(f"@{path}")


@pytest.mark.slow
@pytest.mark.authority
def test_apprise_reaches_http_and_mail(tmp_path: Path) -> None:
    """authority: apprise 2.2 itself, over real sockets."""
    with http_server() as (port, requests), smtp_server() as (mail_port, mails):
        mail = f"mailto://127.0.0.1:{mail_port}?from=a@example.org&to=b@example.org&mode=insecure"
        post = apprise_post([f"json://127.0.0.1:{port}/{SECRET}", mail])
        assert post(Message("fieldlum office: camera is lost", "It stopped answering."))
        assert "camera is lost" in requests[0][1] and "camera is lost" in mails[0]


# The outbox


@pytest.mark.contract
def test_a_day_without_network_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    network = threading.Event()
    arrived: list[str] = []
    said: list[str] = []

    def post(message: Message) -> bool:
        if not network.is_set():
            raise OSError(f"no route to {SECRET}")
        arrived.append(message.title)
        return True

    monkeypatch.setattr(notify, "FIRST_PAUSE_S", 0.01)
    outbox = Outbox(post, said.append)
    for number in range(3):
        outbox.put(Message(f"message {number}", "body"))
    assert until(lambda: said == ["note: messages cannot be sent (OSError); they wait"])
    network.set()
    assert until(lambda: len(arrived) == 3)
    assert outbox.close() == 0 and arrived == ["message 0", "message 1", "message 2"]
    assert said[1:] == ["note: messages are sent again"] and SECRET not in str(said)


@pytest.mark.contract
def test_a_service_that_hangs_delays_nobody() -> None:
    release = threading.Event()
    outbox = Outbox(lambda message: not release.wait(10.0), lambda text: None)
    for number in range(600):
        outbox.put(Message(str(number), ""))  # returns while the service hangs
    assert outbox.close(patience_s=0.05) == 500
    release.set()
    outbox.close()


# What is reported


class Heard:
    """Alerts whose messages are returned by the call that caused them."""

    def __init__(self) -> None:
        self.sent: list[Message] = []
        self.alerts = Alerts("office", "America/Los_Angeles", self.sent.append)

    def event(self, event: str, t_utc: datetime, fields: EventFields) -> list[Message]:
        self.sent.clear()
        self.alerts.listen(event, t_utc, fields)
        return list(self.sent)

    def look(
        self, t_utc: datetime, disk_days: float | None, ghi_wm2: float | None
    ) -> list[Message]:
        self.sent.clear()
        live = SimpleNamespace(t_utc=t_utc, disk_days=disk_days, ghi_wm2=ghi_wm2)
        self.alerts.check(live)  # type: ignore[arg-type]
        return list(self.sent)


def alerts() -> Heard:
    return Heard()


@pytest.mark.analytic
def test_each_fault_gives_one_message() -> None:
    state = alerts()
    assert state.event("device-lost", T0, {"device": "camera", "why": "gone"}) == []
    assert state.look(T0 + timedelta(minutes=9), 20.0, None) == []
    (lost,) = state.look(T0 + timedelta(minutes=10), 20.0, None)
    assert lost.title == "fieldlum office: camera is lost" and "10 minutes" in lost.body
    assert state.look(T0 + timedelta(minutes=11), 20.0, None) == []
    (back,) = state.event("device-back", T0 + timedelta(minutes=30), {"device": "camera"})
    assert "30 minutes" in back.body
    assert state.event("device-lost", T0, {"device": "camera"}) == []
    assert state.event("device-back", T0 + timedelta(minutes=1), {"device": "camera"}) == []


@pytest.mark.analytic
def test_misses_disk_clock_and_clipping() -> None:
    state = alerts()
    slot = {"slot": "20270320T153000Z", "why": "late by 400 s"}
    assert state.event("missed", T0, slot) == []
    (two,) = state.event("aborted", T0, slot)
    assert "2 slots" in two.title and "late by 400 s" in two.body and "08:30" in two.body
    assert state.event("missed", T0, slot) == []
    (disk,) = state.look(T0, 2.5, None)
    assert "2.5 more days" in disk.body
    assert state.look(T0 + timedelta(hours=5), 2.4, None) == []
    assert len(state.look(T0 + timedelta(hours=6), 2.0, None)) == 1
    (clock,) = state.event("clock-step", T0, {"seconds": 3600.0, "followed": False})
    assert "+3600 s" in clock.body and "does not follow" in clock.body
    assert state.event("clock-step", T0 + timedelta(hours=1), {"seconds": 9.0}) == []
    done = {"slot": "20270320T153000Z", "why": "61 % of the shortest exposure's pixels are clipped"}
    (clipped,) = state.event("done", T0, done)
    assert "61 %" in clipped.body
    assert state.event("done", T0 + timedelta(hours=1), done) == []


@pytest.mark.analytic
def test_the_day_is_summed_up_once_at_local_midnight() -> None:
    state = alerts()
    state.event("done", T0, {"slot": "20270320T153000Z", "why": ""})
    state.event("missed", T0, {"slot": "20270320T163000Z", "why": "late"})
    state.look(T0, None, 640.0)
    assert state.look(datetime(2027, 3, 21, 6, 59, tzinfo=UTC), None, None) == []
    (day,) = state.look(datetime(2027, 3, 21, 7, 1, tzinfo=UTC), None, None)
    assert "summary of 2027-03-20" in day.title
    assert "1 brackets done" in day.body and "1 missed" in day.body
    assert state.look(datetime(2027, 3, 22, 12, 0, tzinfo=UTC), None, None) == []


@pytest.mark.contract
def test_the_summary_carries_the_sheet_that_was_written_last(session: Session) -> None:
    """A month of capture: the sheets are written after the capture began, contact-10 after -9."""
    import os

    from fieldlum.capture.notify import open_alerts

    arrived: list[Message] = []

    def post(message: Message) -> bool:
        arrived.append(message)
        return True

    with open_alerts(session, post, "", lambda text: None, with_picture=True) as remote:
        session.panoramas.mkdir(exist_ok=True)
        for second, number in enumerate((9, 10)):
            sheet = session.panoramas / f"contact-{number}.png"
            sheet.write_bytes(b"png")
            os.utime(sheet, (1000 + second, 1000 + second))
        remote.listen("done", T0, {"slot": "20270320T153000Z", "why": ""})
        remote.listen("done", T0 + timedelta(days=1), {"slot": "20270321T153000Z", "why": ""})
        assert until(lambda: bool(arrived))
    assert arrived[0].picture is not None and arrived[0].picture.name == "contact-10.png"


# The capture itself


class DeadCamera(Camera):
    """Opens, and fails at each frame."""

    info = CameraInfo("dead")

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        raise OSError("no answer")


class SteadyPyranometer(Pyranometer):
    info = InstrumentInfo("steady", gives=())

    def __init__(self, clock: FastClock) -> None:
        self.clock = clock

    def read(self) -> IrradianceSample:
        return IrradianceSample(self.clock.now(), ghi_wm2=500.0, dhi_wm2=100.0)


@pytest.mark.slow
@pytest.mark.contract
def test_a_capture_reports_and_no_secret_is_written(session: Session, tmp_path: Path) -> None:
    from fieldlum.capture.notify import open_alerts

    clock = FastClock(T0 - timedelta(minutes=1))
    options = Options(log_around_s=60.0, threaded=False, flush=False, reserve_bytes=4096)
    with http_server() as (port, requests):
        post = apprise_post([f"json://127.0.0.1:{port}/{SECRET}"])
        beat = f"http://127.0.0.1:{port}/beat-{SECRET}"
        with open_alerts(session, post, beat, lambda text: None) as remote:
            run(
                session,
                "dead:",
                "steady:",
                clock=clock,
                options=options,
                watch=remote.check,
                listen=remote.listen,
                trusted=lambda: False,
                open_cam=DeadCamera,
                open_pyr=lambda: SteadyPyranometer(clock),
            )
            wanted = "2 slots in a row gave no bracket"
            assert until(lambda: any(wanted in body for _, body in requests))
        assert any(path == f"/beat-{SECRET}" for path, _ in requests)
        assert sum(wanted in body for _, body in requests) == 1
    for file in session.root.rglob("*"):
        assert not file.is_file() or SECRET.encode() not in file.read_bytes(), file


@pytest.mark.property
def test_heartbeats_come_at_once_and_regularly(monkeypatch: pytest.MonkeyPatch) -> None:
    fetched: list[str] = []
    monkeypatch.setattr(notify, "fetch", fetched.append)
    heart = Heartbeat("http://127.0.0.1/", every_s=0.05)
    assert until(lambda: len(fetched) >= 3)
    heart.end()

    def refuse(address: str) -> None:
        fetched.append("tried")
        raise OSError(SECRET)

    monkeypatch.setattr(notify, "fetch", refuse)
    heart = Heartbeat("http://127.0.0.1/", every_s=60.0)
    assert until(lambda: fetched.count("tried") == 1)
    heart.beat()
    assert until(lambda: fetched.count("tried") == 2)
    heart.end()


@pytest.mark.analytic
def test_an_unset_clock_is_waited_for(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    written = datetime.fromtimestamp(session.toml.stat().st_mtime, UTC)
    clock = FastClock(written - timedelta(days=400))
    tries = iter([False, False, False, True])
    monkeypatch.setattr(steady_clock, "synchronised", lambda: next(tries))
    wait_for_clock(session, clock, said.append)
    assert len(said) == 2 and "has not been set" in said[0]
    monkeypatch.setattr(steady_clock, "synchronised", lambda: False)
    wait_for_clock(session, FastClock(written + timedelta(hours=1)), said.append)
    assert len(said) == 2
