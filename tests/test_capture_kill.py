"""Kill -9 at random moments, twenty times: no frame and no row lost or doubled, the outputs of an
undisturbed run.

The killed processes are real ones (forked from the test, so that they start at once); one test goes
through the command line.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from places import SEATTLE

from fieldlum import capture, merge
from fieldlum.cli import main
from fieldlum.core.records import CameraSetup, PyranometerSetup, SiteFile, Slot
from fieldlum.optics.images import read_panorama
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Lens,
    Sensor,
    Vignetting,
    bracket_exposures,
    save_profile,
)
from fieldlum.session import Session, create_session, day_files, read_day, read_journal, sha256
from fieldlum.session.slot_states import apply_events

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork and SIGKILL")
T0 = datetime(2027, 3, 20, 18, 30, tzinfo=UTC)
KILLS = 20


def tiny_profile() -> CameraProfile:
    return CameraProfile(
        camera=CameraBody("tiny", "raw", 48, 48),
        lens=(Lens((24.0, 24.0), 23.0, 180.0, vignetting=(Vignetting(5.6, (1.0, 0.0, -0.1)),)),),
        bracket=Bracket(5.6, 100.0, (1.0, 0.25, 0.015625, 0.001)),
        sensor=Sensor(
            black_dn=(64.0,) * 4, saturation_dn=(16000.0,) * 4, white_dn=16383.0, gain_e_per_dn=4.0
        ),
    )


def make_session(folder: Path, slots: int = 4) -> Session:
    profile = tiny_profile()
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = folder.parent / "tiny.toml"
    save_profile(path, profile)
    plan = [
        Slot(T0 + timedelta(hours=i), 30.0, 150.0, bracket_exposures(profile.bracket))
        for i in range(slots)
    ]
    site = SEATTLE
    setup = SiteFile(site, CameraSetup(str(path)), None, PyranometerSetup())
    return create_session(folder, setup, plan, {"set": "test"})


def capture_all(session: Session) -> None:
    clock, options = capture.prepare(session, fast=True)
    options = replace(options, reserve_bytes=4096)
    capture.run(session, "sim:office?seed=1", "sim:office?seed=1", clock=clock, options=options)


def merge_all(session: Session) -> None:
    merge.run(session, merge.MergeOptions(height=16))


def start(work: Callable[[], None]) -> int:
    """A process of its own that does `work` and ends without any of pytest's tidying up."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    return child


def ended(child: int, within_s: float) -> bool:
    """Whether it ended by itself, and well, in this time."""
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        pid, state = os.waitpid(child, os.WNOHANG)
        if pid:
            assert os.waitstatus_to_exitcode(state) == 0
            return True
        time.sleep(0.002)
    return False


def kill_until_done(
    fresh: Callable[[int], Session],
    work: Callable[[Session], None],
    whole_s: float,
    seed: int,
    look: Callable[[Session], None] = lambda session: None,
) -> list[Session]:
    """Sessions that were finished in spite of KILLS kills altogether, at random moments."""
    rng = random.Random(seed)
    sessions = [fresh(0)]
    kills = 0
    while True:
        session = sessions[-1]
        child = start(lambda session=session: work(session))
        if kills >= KILLS:
            assert ended(child, 300.0)
            return sessions
        if ended(child, rng.uniform(0.0, whole_s / 3)):
            sessions.append(fresh(len(sessions)))
            continue
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        kills += 1
        look(session)


def timed(work: Callable[[Session], None], session: Session) -> float:
    begun = time.monotonic()
    assert ended(start(lambda: work(session)), 300.0)
    return time.monotonic() - begun


def frames_of(session: Session) -> dict[str, str]:
    """Every file in raw/ but the notes, with its hash: leftovers would show."""
    return {
        str(p.relative_to(session.raw)): sha256(p)
        for p in session.raw.rglob("*")
        if p.is_file() and p.suffix != ".json"
    }


def notes_of(session: Session) -> dict[str, Any]:
    """capture.json of each slot, its times cut to the second.

    A bracket that continues after a kill has its times from the journal, which keeps milliseconds,
    so that its middle may differ by one. How many frames still fit depends on the disk.
    """
    notes = {}
    for path in session.raw.glob("*/capture.json"):
        table = json.loads(path.read_text())
        for frame in table["frames"]:
            frame["t_utc"] = frame["t_utc"][:19]
        notes[path.parent.name] = {
            **table,
            "camera": {**table["camera"], "frames_left": None},
            "t_open_utc": table["t_open_utc"][:19],
            "t_mid_utc": table["t_mid_utc"][:19],
            "t_close_utc": "",
        }
    return notes


@pytest.mark.slow
@pytest.mark.property
def test_capture_killed_twenty_times_equals_an_undisturbed_run(tmp_path: Path) -> None:
    calm = make_session(tmp_path / "calm" / "s")
    capture_all(calm)  # here, so that the children find everything imported
    whole_s = timed(capture_all, make_session(tmp_path / "timed" / "s"))
    acknowledged: list[tuple[Session, set[str], set[datetime]]] = []

    def look(session: Session) -> None:
        hashes = {e["frame"]["sha256"] for e in read_journal(session) if e["event"] == "frame"}
        rows = {s.t_utc for path in day_files(session) for s in read_day(path)[0]}
        acknowledged.append((session, hashes, rows))

    killed = kill_until_done(
        lambda k: make_session(tmp_path / f"killed{k}" / "s"),
        capture_all,
        whole_s,
        seed=1,
        look=look,
    )
    for session in killed:
        assert frames_of(session) == frames_of(calm), "none lost, none doubled, none different"
        strip = {"profile": ""}
        calm_notes = {k: {**v, **strip} for k, v in notes_of(calm).items()}
        assert {k: {**v, **strip} for k, v in notes_of(session).items()} == calm_notes
        outcomes = [state.outcome for state in apply_events(read_journal(session)).slots.values()]
        assert outcomes == ["done"] * 4
    for session, hashes, rows in acknowledged:
        assert hashes <= set(frames_of(session).values()), "an acknowledged frame is never lost"
        assert rows <= {s.t_utc for path in day_files(session) for s in read_day(path)[0]}
        assert all(read_day(path)[1] == 0 for path in day_files(session)), "no broken row stays"


@pytest.mark.slow
@pytest.mark.property
def test_merge_killed_twenty_times_equals_an_undisturbed_run(tmp_path: Path) -> None:
    import shutil

    calm = make_session(tmp_path / "calm" / "s")
    capture_all(calm)

    def fresh(k: int) -> Session:
        target = tmp_path / f"killed{k}" / "s"
        shutil.copytree(calm.root, target, ignore=shutil.ignore_patterns("panoramas"))
        return Session(target)

    first = fresh(0)
    whole_s = timed(merge_all, first)
    for session in kill_until_done(lambda k: fresh(k + 1), merge_all, whole_s, seed=2):
        # A kill between a file and its checksum leaves a file that is not checked, and a temporary
        # file that stays for a day, as it may be that of another process.
        names, again = (
            sorted(p.name for p in s.panoramas.glob("[!.]*") if p.suffix != ".sha256")
            for s in (first, session)
        )
        assert again == names and len(names) >= 8
        for path in first.panoramas.glob("*.exr"):
            there, here = read_panorama(path), read_panorama(session.panoramas / path.name)
            for a, b in ((there.luminance_cdm2, here.luminance_cdm2), (there.u_cdm2, here.u_cdm2)):
                np.testing.assert_array_equal(a, b)
            np.testing.assert_array_equal(there.flags, here.flags)
            assert (there.t_utc, there.sun, there.heading_deg) == (
                here.t_utc,
                here.sun,
                here.heading_deg,
            )
            side = path.with_suffix(".json").name
            assert json.loads((first.panoramas / side).read_text()) == json.loads(
                (session.panoramas / side).read_text()
            )


@pytest.mark.slow
@pytest.mark.contract
def test_the_command_itself_goes_on_after_a_kill(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s", slots=2)
    words = [
        sys.executable,
        "-c",
        "from fieldlum.cli import main; main()",
        "capture",
        str(session.root),
    ]
    words += [
        "--camera",
        "sim:office?seed=1",
        "--pyranometer",
        "sim:office?seed=1",
        "--clock",
        "fast",
    ]
    child = subprocess.Popen(words, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    until = time.monotonic() + 300.0
    while (
        not any(e["event"] == "frame" for e in read_journal(session)) and time.monotonic() < until
    ):
        time.sleep(0.005)
    child.kill()
    child.wait()
    done = CliRunner().invoke(main, [*words[3:5], "--clock", "fast"])
    assert done.exit_code == 0 and "brackets: 2 done, 0 missed, 0 aborted" in done.stdout, (
        done.stderr
    )
    assert len(frames_of(session)) == 8
