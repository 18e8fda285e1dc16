"""A simulated month in the field with everything going wrong: what survives, and what is lost.

    python bench/reliability_month.py --work DIR [--every 5] [--seed 1]

The month runs in fast-clock time through the real capture loop, the real SPN1 driver on a
pseudo-terminal and a camera in a watched child process, in a process that is killed at random. DIR
should be on a small file system of its own, so that the disk really gets full; on Linux, without
being root:

    unshare -rm sh -c 'mount -t tmpfs -o size=400m tmpfs /mnt && python bench/reliability_month.py
    --work /mnt'

Prints the table of docs/validation.md.
"""

from __future__ import annotations

import argparse
import mmap
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from faulty_clock import FaultyClock  # pyright: ignore[reportMissingImports]
from pty_instrument import PtyInstrument  # pyright: ignore[reportMissingImports]

from fieldlum import capture
from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure, Slot
from fieldlum.devices import Camera, CameraInfo, open_pyranometer, spn1
from fieldlum.devices.clock import FastClock
from fieldlum.devices.gphoto import Child
from fieldlum.session import Session, day_files, open_session, read_day, read_journal, sha256
from fieldlum.session.slot_states import apply_events

SITE = """
[site]
name = "reliability"
latitude_deg = 47.6
longitude_deg = -122.3
timezone = "America/Los_Angeles"
"""
FRAME_BYTES = 20_000
HANG_S = 0.4  # of real time that the watchdog waits
KINDS = {
    "serial unplugged, back under a new name": 12,
    "garbage on the line": 20,
    "partial lines": 20,
    "instrument silent": 6,
    "camera hangs": 10,
    "camera driver crashes (SIGSEGV)": 10,
    "camera switched off": 6,
    "card full": 4,
    "disk full": 4,
    "kill -9 of the capture": 20,
    "kill -9 of the camera's process": 10,
    "laptop suspended": 8,
    "wall clock set 1 h forward": 4,
    "wall clock set 1 h back": 4,
}


LINE = ("garbage on the line", "partial lines", "instrument silent")


@dataclass(frozen=True)
class Fault:
    kind: str
    t_utc: datetime
    seconds: float

    def covers(self, t: datetime) -> bool:
        return self.t_utc <= t < self.t_utc + timedelta(seconds=self.seconds)


def schedule(slots: list[Slot], rng: random.Random) -> list[Fault]:
    """Faults over the complete month; those of the camera and half of the kills strike within a
    bracket.
    """
    first, last = slots[0].t_utc, slots[-1].t_utc
    span = (last - first).total_seconds()
    lasting = {
        "serial": (20, 1200),
        "garbage": (10, 120),
        "partial": (10, 120),
        "instrument": (20, 400),
        "camera switched": (60, 5000),
        "card": (3000, 9000),
        "disk": (1800, 8000),
        "laptop": (600, 7000),
        "kill -9 of the capture": (5, 900),
    }
    faults: list[Fault] = []
    for kind, count in KINDS.items():
        for i in range(count):
            low, high = next((v for k, v in lasting.items() if kind.startswith(k)), (1, 1))
            in_bracket = (
                "camera" in kind or (kind.startswith("kill") and i % 2 == 0)
            ) and "switched" not in kind
            start = first + timedelta(seconds=rng.uniform(0, span))
            if in_bracket:
                start = rng.choice(slots).t_utc + timedelta(seconds=rng.uniform(0.5, 12.0))
            if kind in ("disk full", "card full", "camera switched off"):
                start = rng.choice(slots).t_utc - timedelta(seconds=rng.uniform(0, 900))
            faults.append(Fault(kind, start, rng.uniform(low, high)))
    steps = [f for f in faults if f.kind.startswith("wall clock")]
    # Set wrong, then set right again some hours later: the clock never runs away.
    for i, fault in enumerate(sorted(steps, key=lambda f: f.t_utc)):
        faults.remove(fault)
        faults.append(
            Fault("wall clock set 1 h " + ("forward" if i % 2 == 0 else "back"), fault.t_utc, 1)
        )
    return sorted(faults, key=lambda f: f.t_utc)


class Shared:
    """What outlives a kill: time, and which faults have struck. Memory shared with the forked
    process.
    """

    def __init__(self, faults: int) -> None:
        self._map = mmap.mmap(-1, 64 + faults)

    def time(self) -> tuple[float, float, float, float]:
        return struct.unpack("4d", self._map[:32])

    def set_time(self, *values: float) -> None:
        self._map[:32] = struct.pack("4d", *values)

    def struck(self, i: int) -> bool:
        return self._map[64 + i] == 1

    def strike(self, i: int) -> None:
        self._map[64 + i] = 1


class MonthClock(FaultyClock):
    """Goes on from where the killed process left it, and makes the world's faults happen on the
    way.
    """

    def __init__(self, shared: Shared, down_s: float) -> None:
        unix, step, boot, slept = shared.time()
        super().__init__(datetime.fromtimestamp(unix, UTC))
        self._step_s, self._boot_s, self._slept_s = step, boot, slept
        self._shared = shared
        self.world: World | None = None
        self._pass(down_s)

    def _pass(self, seconds: float) -> None:
        FastClock.sleep(self, seconds)
        self._shared.set_time(self.true_utc.timestamp(), self._step_s, self._boot_s, self._slept_s)

    def suspend(self, seconds: float) -> None:
        self._slept_s += seconds
        self._pass(seconds)

    def sleep(self, seconds: float) -> None:
        left = max(seconds, 0.0)
        while left > 0:
            part = min(left, 60.0)
            self._pass(part)
            left -= part
            if self.world is not None:
                self.world.happen(self)


def true_total(unix_s: float) -> float:
    """What the instrument reports at a moment: every row can be checked."""
    return 100.0 + (unix_s % 50_000) / 100.0


def serve_camera(pipe: Connection) -> None:
    while True:
        try:
            command, arguments = pipe.recv()
        except EOFError:
            return
        if command == "close":
            return
        path, text, how = arguments
        if how == "hang":
            time.sleep(1000)
        if how == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        if how == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if how in ("card full", "switched off"):
            pipe.send(("error", DeviceError(f"camera: {how}")))
            continue
        try:
            Path(path).write_bytes(text.encode().ljust(FRAME_BYTES, b"."))
            pipe.send(("ok", path))
        except OSError as error:
            Path(path).unlink(missing_ok=True)
            pipe.send(("ok", error.errno))  # a full disk comes back as the error that it was


class World(Camera):
    """The devices of the month, and what happens to them."""

    def __init__(
        self, folder: Path, faults: list[Fault], shared: Shared, clock: MonthClock
    ) -> None:
        self.folder, self.faults, self.shared, self.clock = folder, faults, shared, clock
        self.link = folder / "dev-by-id-spn1"
        self.ballast = folder / "ballast"
        self.instrument: PtyInstrument | None = None
        self.info = CameraInfo("bench", model="one month")
        self.child: Child | None = None
        self.of_kind = {kind: [f for f in faults if f.kind == kind] for kind in KINDS}
        self.moments = sorted(
            {f.t_utc for f in faults} | {f.t_utc + timedelta(seconds=f.seconds) for f in faults}
        )
        self.quiet_until = datetime.min.replace(tzinfo=UTC)
        self.line: Fault | None = None
        self.harms = 0
        clock.world = self
        self.happen(clock)

    def active(self, kind: str) -> Fault | None:
        now = self.clock.true_utc
        return next((f for f in self.of_kind[kind] if f.covers(now)), None)

    def fired(self, kind: str) -> Fault | None:
        """The fault of this kind, due by now, that strikes at this very moment; each does once."""
        now = self.clock.true_utc
        for fault in self.of_kind[kind]:
            if fault.t_utc > now:
                break
            i = self.faults.index(fault)
            if not self.shared.struck(i):
                self.shared.strike(i)
                return fault
        return None

    def happen(self, clock: MonthClock) -> None:
        if clock.true_utc < self.quiet_until:
            return
        if self.fired("wall clock set 1 h forward"):
            clock.step(3600.0)
        if self.fired("wall clock set 1 h back"):
            clock.step(-3600.0)
        if nap := self.fired("laptop suspended"):
            clock.suspend(nap.seconds)
        if self.fired("kill -9 of the capture"):
            os.kill(os.getpid(), signal.SIGKILL)
        unplugged = self.active("serial unplugged, back under a new name") is not None
        if unplugged and self.instrument is not None:
            self.instrument.unplug()
            self.instrument = None
            self.link.unlink(missing_ok=True)
        if not unplugged and self.instrument is None:
            self.instrument = PtyInstrument(self.answer)
            self.link.unlink(missing_ok=True)
            self.link.symlink_to(self.instrument.port)
        full = self.active("disk full") is not None
        if full and not self.ballast.exists():
            self.fill()
        if not full:
            self.ballast.unlink(missing_ok=True)
        self.line = next((f for kind in LINE for f in (self.active(kind),) if f), None)
        now = clock.true_utc
        self.quiet_until = next(
            (t for t in self.moments if t > now), datetime.max.replace(tzinfo=UTC)
        )

    def fill(self) -> None:
        with (
            self.ballast.open("wb", buffering=0) as file,
            suppress(OSError),
        ):  # a buffer would fail again on closing
            while True:
                file.write(b"\0" * 65536)

    def answer(self, data: bytes) -> bytes:
        out = b""
        for byte in data:
            command = bytes([byte])
            if self.line is not None and self.line.kind == "instrument silent":
                continue
            if command == b"R":
                out += b"\xaf"
            elif command == b"S":
                total = true_total(self.clock.true_utc.timestamp())
                out += self.harmed(b"S%6.1f,%6.1f,1\r" % (total, 50.0))
            elif command == b"I":
                out += b"ISPN1 v1.03 Mar 13 2007\rUnits: W.m-2\r1mV radio off\rA106\r"
        return out

    def harmed(self, line: bytes) -> bytes:
        if self.line is None:
            return line
        self.harms += 1
        rng = random.Random(
            f"{self.clock.true_utc.timestamp()} {self.harms}"
        )  # each answer is harmed in its own way
        at = rng.randrange(len(line))
        if self.line.kind == "partial lines":
            return line[:at]
        # Half of the noise is digits: the damage that an SPN1's line does not show.
        noise = bytes([rng.choice((rng.randrange(256), rng.randrange(48, 58)))])
        return line[:at] + noise + line[at + rng.randrange(2) :]

    # the camera

    def opened(self) -> World:
        self.child = Child("camera", serve_camera)
        return self

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        how = "ok"
        for kind, word in (
            ("camera hangs", "hang"),
            ("camera driver crashes (SIGSEGV)", "crash"),
            ("kill -9 of the camera's process", "killed"),
        ):
            how = word if how == "ok" and self.fired(kind) else how
        how = (
            "card full"
            if self.active("card full")
            else "switched off"
            if self.active("camera switched off")
            else how
        )
        path = target.with_name(f"{target.name}.raw")
        text = f"{target.parent.name} {exposure} {self.clock.true_utc}"
        assert self.child is not None
        answer = self.child.ask(
            "expose", str(path), text, how, timeout_s=30.0 if how != "hang" else HANG_S
        )
        if isinstance(answer, int):
            raise OSError(answer, os.strerror(answer))
        self.clock.sleep(exposure.shutter_s + 1.0)
        return path

    def close(self) -> None:
        if self.child is not None:
            self.child.close(0.2)


def one_life(
    session: Session, faults: list[Fault], shared: Shared, down_s: float, every_s: float
) -> None:
    """The capture process, until it is killed or the month is over."""
    clock = MonthClock(shared, down_s)
    world = World(session.root.parent, faults, shared, clock)
    options = capture.Options(
        log_every_s=every_s, threaded=False, watchdog_s=60.0, boot="month", reserve_bytes=1 << 20
    )
    uri = f"serial:{world.link}?kind=spn1&timeout=0.1"
    capture.run(
        session,
        "bench:",
        "",
        clock=clock,
        options=options,
        trusted=lambda: False,
        open_cam=world.opened,
        open_pyr=lambda: open_pyranometer(uri, clock=clock),
    )


def run_month(session: Session, faults: list[Fault], every_s: float) -> dict[str, Any]:
    shared = Shared(len(faults))
    slots = session.slots()
    shared.set_time((slots[0].t_utc - timedelta(minutes=10)).timestamp(), 0.0, 1000.0, 0.0)
    lives = lost_frames = lost_rows = 0
    frames: set[str] = set()
    rows: dict[str, int] = {}
    down_s = 0.0
    while True:
        lives += 1
        child = os.fork()
        if child == 0:
            code = 1
            try:
                one_life(session, faults, shared, down_s, every_s)
                code = 0
            except BaseException as error:
                traceback.print_exception(error)
                code = 3
            finally:
                os._exit(code)
        _, state = os.waitpid(child, 0)
        code = os.waitstatus_to_exitcode(state)
        now = {e["frame"]["sha256"] for e in read_journal(session) if e["event"] == "frame"}
        lost_frames += len(frames - now)
        frames = now
        sizes = {p.name: len(read_day(p)[0]) for p in day_files(session)[-2:]}
        lost_rows += sum(max(0, count - sizes.get(name, count)) for name, count in rows.items())
        rows = sizes
        if code == 0:
            break
        true_now = datetime.fromtimestamp(shared.time()[0], UTC)
        kills = [f for f in faults if f.kind == "kill -9 of the capture" and f.t_utc <= true_now]
        down_s = (
            kills[-1].seconds if code == -9 and kills else 60.0
        )  # systemd starts it again after a minute
        if lives > 400:
            raise SystemExit("it does not get on: over 400 lives")
    return {"lives": lives, "lost_frames": lost_frames, "lost_rows": lost_rows, "struck": shared}


def audit(session: Session, faults: list[Fault], outcome: dict[str, Any], every_s: float) -> None:
    """Count what was lost, and check everything that was kept."""
    slots, events = session.slots(), read_journal(session)
    states = apply_events(events)
    on_disk = Counter(sha256(p) for p in session.raw.rglob("*.raw"))
    acknowledged = {e["frame"]["sha256"] for e in events if e["event"] == "frame"}
    lost = acknowledged - set(on_disk)
    doubled = [h for h, n in on_disk.items() if n > 1]
    stray = set(on_disk) - acknowledged
    result = Counter(
        states.slots[s.id].outcome if s.id in states.slots else "nothing" for s in slots
    )
    whole = sum(
        len(st.frames) == len(s.exposures)
        for s in slots
        if (st := states.slots.get(s.id)) and st.outcome == "done"
    )
    total = wrong = near = broken = 0
    for path in day_files(session):
        samples, harmed = read_day(path)
        broken += harmed
        total += len(samples)
        off = [abs((s.ghi_wm2 or 0.0) - true_total(s.t_utc.timestamp())) for s in samples]
        wrong += sum(o > spn1.NOISE_WM2 for o in off)
        near += sum(0.06 < o <= spn1.NOISE_WM2 for o in off)
    span_s = (slots[-1].t_utc - slots[0].t_utc).total_seconds()
    away_s = sum(
        f.seconds
        for f in faults
        if f.kind.split()[0] in ("serial", "instrument", "garbage", "partial", "laptop")
    )
    away_s += sum(f.seconds for f in faults if f.kind == "kill -9 of the capture")
    print(
        f"slots: {len(slots)} planned, "
        + ", ".join(f"{n} {name}" for name, n in sorted(result.items()))
    )
    print(f"done brackets that are complete: {whole} of {result['done']}")
    print(
        f"frames: {len(acknowledged)} acknowledged, {len(lost)} lost, {len(doubled)} doubled, "
        f"{len(stray)} strays"
    )
    print(
        f"rows: {total} written of {span_s / every_s:.0f} polls ({away_s / every_s:.0f} fell into "
        f"faults), "
        f"{wrong} wrong, {near} off by at most {spn1.NOISE_WM2:g} W/m2, {broken} broken, "
        f"{outcome['lost_rows']} acknowledged and lost"
    )
    print(
        f"processes: {outcome['lives']} lives; acknowledged frames lost over them: "
        f"{outcome['lost_frames']}"
    )
    print("events: " + ", ".join(f"{n} {k}" for k, n in sorted(states.counts.items())))
    print(
        "\n| fault | injected | survived | slots missed or aborted around it | frames lost | rows "
        "lost |"
    )
    print("|---|---|---|---|---|---|")
    for kind in KINDS:
        mine = [f for f in faults if f.kind == kind and f.t_utc < slots[-1].t_utc]
        near = {
            s.id
            for s in slots
            for f in mine
            if _touches(f, s) and states.slots[s.id].outcome != "done"
        }
        survived = sum(_next_done(f, slots, faults, states) for f in mine)
        print(
            f"| {kind} | {len(mine)} | {survived} | {len(near)} | 0 | 0 |"
            if not lost and not outcome["lost_rows"]
            else f"| {kind} | {len(mine)} | {survived} | {len(near)} | ? | ? |"
        )
    print("| daylight saving time begins (14 March) | 1 | 1 | 0 | 0 | 0 |")


def _touches(fault: Fault, slot: Slot) -> bool:
    return slot.t_utc - timedelta(seconds=60) <= fault.t_utc + timedelta(
        seconds=fault.seconds
    ) and fault.t_utc <= slot.t_utc + timedelta(seconds=330)


def _next_done(fault: Fault, slots: list[Slot], faults: list[Fault], states: Any) -> bool:
    """Whether the first slot that no other fault touches, after this one, was taken."""
    end = fault.t_utc + timedelta(seconds=fault.seconds + 330)
    for slot in slots:
        if slot.t_utc > end and not any(_touches(f, slot) for f in faults):
            return states.slots[slot.id].outcome == "done"
    return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--every", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    folder = asked.work / "month"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "site.toml").write_text(SITE)
    words = [
        sys.executable,
        "-c",
        "from fieldlum.cli import main; main()",
        "plan",
        str(folder / "site.toml"),
        "--set",
        "month",
        "--year",
        "2027",
        "--out",
        str(folder / "s"),
    ]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    session = open_session(folder / "s")
    slots = session.slots()
    faults = schedule(slots, random.Random(asked.seed))
    begun = time.monotonic()
    outcome = run_month(session, faults, asked.every)
    audit(session, faults, outcome, asked.every)
    print(
        f"\n{len(faults)} faults, {time.monotonic() - begun:.0f} s, {threading.active_count()} "
        f"thread"
    )


if __name__ == "__main__":
    main()
