"""Nobody beside it: closed terminals, broken pipes and signals end no capture that they need not
end.
"""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from places import SEATTLE
from tiny_field import T0, Field
from tiny_field import make_session as tiny_session

from fieldlum.capture.runner import Live, Options, run
from fieldlum.cli.capture_command import panel
from fieldlum.core.records import Exposure, Site, SiteFile, Slot
from fieldlum.devices.clock import FastClock
from fieldlum.session import Journal, Session, create_session, read_journal

pytestmark = pytest.mark.contract

COMMAND = [sys.executable, "-c", "from fieldlum.cli import main; main()", "capture"]
DEVICES = ["--camera", "sim:office?seed=1", "--clock", "fast"]


def make_session(folder: Path, first: datetime, slots: int = 2) -> Session:
    ladder = tuple(Exposure(2.0**-i, 5.6) for i in range(2))
    plan = [Slot(first + timedelta(hours=i), 30.0, 180.0, ladder) for i in range(slots)]
    return create_session(folder, SiteFile(SEATTLE), plan, {"set": "test"})


def outcomes(session: Session) -> list[str]:
    return [
        e["event"] for e in read_journal(session) if e["event"] in ("done", "missed", "aborted")
    ]


@pytest.mark.slow
def test_a_display_that_fails_costs_nothing(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s", datetime(2027, 3, 20, 18, 30, tzinfo=UTC))

    def watch(live: Live) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    clock = FastClock(datetime(2027, 3, 20, 18, 29, tzinfo=UTC))
    run(
        session,
        "sim:office?seed=1",
        clock=clock,
        options=Options(threaded=False, flush=False),
        watch=watch,
    )
    assert outcomes(session) == ["done", "done"]


@pytest.mark.parametrize("columns", [40, 60, 120])
def test_the_panel_fits_narrow_terminals_and_takes_any_text(columns: int) -> None:
    from rich.console import Console

    now = datetime(2027, 3, 20, 14, tzinfo=UTC)
    live = Live(
        "waiting",
        now,
        369,
        100,
        3,
        1,
        265,
        "20270320T143000Z",
        1800.0,
        "09.dng [/no tag] [Errno 5]",
        512.3,
        4.0,
        "lost",
        "ok",
        72_000_000_000,
        70.4,
        "disk-full: [red]",
    )
    console = Console(width=columns, record=True, file=io.StringIO())
    console.print(
        panel(live, Site("a room [/x] with a name that is longer than its panel", 47.6, -122.3))
    )
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= columns
    names = [line.split()[1] for line in lines[1:-1]]
    assert names == ["slots", "now", "next", "camera", "global", "disk", "last"]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="closed standard files")
def test_closed_standard_files_never_become_the_journal(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s", datetime(2027, 3, 20, 18, 30, tzinfo=UTC))
    shell = f'exec "$@" {session.root} {" ".join(DEVICES)} <&- >&- 2>&-'
    ended = subprocess.run(["sh", "-c", shell, "sh", *COMMAND], timeout=120)
    assert ended.returncode == 0
    assert [e["why"] for e in read_journal(session) if e["event"] == "done"] == ["", ""]
    assert session.journal.read_bytes().count(b"\n") == len(read_journal(session))


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="POSIX signals")
def test_a_closed_terminal_ends_nothing_and_sigterm_ends_properly(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s", datetime.now(UTC) + timedelta(hours=1), slots=1)
    line = [*COMMAND, str(session.root), "--camera", "sim:office?seed=1"]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60.0
    while not session.journal.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert session.journal.exists()
    process.send_signal(signal.SIGHUP)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(1.5)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130 and "start it again to continue" in said
    assert (
        read_journal(session)[-1]["event"] == "close" and not (session.root / ".reserve").exists()
    )


@pytest.mark.contract
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no flock")
def test_a_journal_held_by_a_stopped_program_does_not_hold_the_capture(tmp_path: Path) -> None:
    """A program that was stopped in the middle of a line holds the lock for ever."""
    import fcntl

    session = tiny_session(tmp_path / "s")
    Journal(session).close()
    with session.journal.open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        field = Field(session, FastClock(T0 - timedelta(minutes=1)))
        thread = threading.Thread(target=field.run, daemon=True)
        thread.start()
        thread.join(60)
        assert not thread.is_alive()
    assert outcomes(session) == ["done"] * 3


@pytest.mark.contract
def test_events_of_people_do_not_move_the_clock_of_the_capture(tmp_path: Path) -> None:
    """A mark, or a note of an earlier version, at a wrong clock must not stop the next start."""
    session = tiny_session(tmp_path / "s")
    journal = Journal(session)
    journal.append("note", T0 + timedelta(days=400), text="x")
    journal.append("marked", T0 + timedelta(days=400), slot=session.slots()[0].id, state="lamp=on")
    journal.close()
    Field(session, FastClock(T0 - timedelta(minutes=1))).run()
    assert outcomes(session) == ["done"] * 3
