"""Sessions with one mutated file, read as the commands do; used by fuzz_inputs.py.

Paths, links and types are put where a session has other values. An audit hook of Python sees each
file that is opened or changed and each program that is started outside the session's folder.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import sys
import tomllib
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from click.testing import CliRunner

from fieldlum.capture.runner import Options, run
from fieldlum.cli import DISK_TROUBLE, main
from fieldlum.cli.options import device_uris
from fieldlum.core.errors import FieldlumError, InputError
from fieldlum.core.files import decode_line
from fieldlum.core.records import CameraSetup, Exposure, Site, SiteFile, Slot, slot_id
from fieldlum.devices import Camera, CameraInfo, open_camera, open_meter, open_pyranometer
from fieldlum.devices.clock import FastClock
from fieldlum.merge import MergeOptions
from fieldlum.merge.stage import _MergeJob as MergeJob
from fieldlum.merge.stage import merge_slot
from fieldlum.optics.profiles import load_camera_profile
from fieldlum.optics.raw.writing import write_dng
from fieldlum.room.scene import sun_patches
from fieldlum.session import Session, create_session, open_session
from fieldlum.session.files.capture_json import CaptureFile, Frame, frame_fields
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.folder import PlanTable
from fieldlum.session.journal import Journal

KINDS = ("journal", "capture.json", "session.toml", "pairs.csv")
START = datetime(2027, 3, 20, 15, 30, tzinfo=UTC)
LADDER = tuple(Exposure(t, 4.0) for t in (0.1, 0.01, 0.001))
_CAPTURED = slot_id(START)
_FILES = {
    "journal": "journal.jsonl",
    "capture.json": f"raw/{_CAPTURED}/capture.json",
    "session.toml": "session.toml",
    "pairs.csv": "pairs.csv",
}
_NAMES = ("file", "instead_of", "slot", "picture", "camera", "pyranometer", "meter", "revision")
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGES = ("os.remove", "os.rename", "os.rmdir", "os.truncate", "os.mkdir", "os.chmod", "os.link")
_PROGRAMS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "pty.spawn")


def make_originals(folder: Path, profile: Path) -> dict[str, list[Path]]:
    """A small session next to a folder that it must leave alone."""
    outside = folder / "outside"
    outside.mkdir()
    (outside / "victim.txt").write_text("precious")
    (outside / ".victim").write_text("precious")
    (outside / "room.rad").write_text(f"!touch {outside / 'ran'}\n")
    grey = "void plastic grey\n0\n0\n5 .5 .5 .5 0 0\ngrey sphere ball\n0\n0\n4 9 9 9 1\n"
    (outside / "plain.rad").write_text(grey)
    program = outside / "program"
    program.write_text(f"#!/bin/sh\ntouch {outside / 'ran'}\n")
    program.chmod(0o755)
    setup = SiteFile(
        Site("here", 47.6, -122.3, "America/Los_Angeles"), CameraSetup(profile=str(profile))
    )
    slots = [Slot(START + timedelta(hours=i), 10.0, 120.0, LADDER) for i in range(3)]
    plan = PlanTable(set="test", revision=0, seconds_per_slot=20.0, megabytes_per_slot=1.0)
    session = create_session(folder / "session", setup, slots, plan)
    _captured(session)
    PairsFile(session.pairs, (PairRow(START, f"panoramas/{_CAPTURED}.exr", 1.0, 2.0),)).write()
    return {kind: [session.root / name, session.root, outside] for kind, name in _FILES.items()}


def _captured(session: Session) -> None:
    """Write one complete bracket, the beginning of a second one, and the journal."""
    journal = Journal(session)
    for number, slot in enumerate(session.slots()[:2]):
        folder = session.capture_file(slot.id).parent
        folder.mkdir(parents=True)
        journal.append("started", slot.t_utc, slot=slot.id, attempt=1)
        frames = []
        for index, exposure in enumerate(LADDER[: 3 - 2 * number]):
            path = folder / f"0{index}.dng"
            counts = np.full((64, 128), 256 + round(20000 * exposure.shutter_s), np.uint16)
            write_dng(path, counts, exposure, black_dn=(256,) * 4, white_dn=4095)
            frame = Frame(index, path.name, exposure, None, slot.t_utc, 1.0)
            journal.append("frame", slot.t_utc, slot=slot.id, frame=frame_fields(frame))
            frames.append(frame)
        if number == 0:
            journal.append("illuminance", slot.t_utc, slot=slot.id, illuminance_lx=500.0)
            journal.append("done", slot.t_utc, slot=slot.id, frames=3)
            times = slot.t_utc, slot.t_utc + timedelta(seconds=3)
            CaptureFile(slot.id, tuple(frames), *times).write(session.capture_file(slot.id))
    journal.append("marked", START, slot=_CAPTURED, state="lamp=on")
    journal.close()


# ----------------------------------------------------------------------------------------------
# mutations


def mutated(kind: str, data: bytes, outside: Path, rng: np.random.Generator) -> bytes:
    """One or two values of a file replaced by a path or by a value of another type."""
    if kind == "pairs.csv":
        lines = [line.split(",") for line in data.decode().splitlines()]
        lines[1][int(rng.integers(len(lines[1])))] = str(_nasty(outside, rng)).replace("\n", " ")
        return "\n".join(map(",".join, lines)).encode("utf-8", "surrogatepass")
    if kind == "session.toml":
        table = tomllib.loads(data.decode())
        table["devices"] = {"uris": {"camera": "sim:office", "pyranometer": "", "meter": ""}}
        room = {"kind": "radiance", "file": str(outside / "plain.rad"), "viewpoint_m": [1, 1, 1]}
        table["setup"].setdefault("room", room)
        for _ in range(int(rng.integers(1, 3))):
            _replace(table, outside, rng)
        with suppress(TypeError, ValueError, AttributeError):
            return tomli_w.dumps(table).encode()
        return data
    rows = [decode_line(line) or json.loads(line) for line in _lines(kind, data)]
    for _ in range(int(rng.integers(1, 3))):
        _replace(rows, outside, rng)
    if kind == "capture.json":
        return json.dumps(rows[0] if rows else None).encode()
    texts = [json.dumps(row).encode() for row in rows]
    return b"".join(b"%08x %s\n" % (zlib.crc32(text), text) for text in texts)


def _lines(kind: str, data: bytes) -> list[bytes]:
    return [data] if kind == "capture.json" else data.splitlines(keepends=True)


def _replace(tree: Any, outside: Path, rng: np.random.Generator) -> None:
    """Replace, remove or rename one entry somewhere in a tree of lists and dictionaries.

    Half of the time it is an entry that names a file, a slot or a device.
    """
    places = list(_places(tree))
    named = [place for place in places if place[1] in _NAMES]
    chosen = named if named and rng.random() < 0.5 else places
    if not chosen:
        return
    inner, key = chosen[int(rng.integers(len(chosen)))]
    choice = rng.random()
    if choice < 0.8:
        inner[key] = _nasty(outside, rng)
    elif choice < 0.9:
        del inner[key]
    elif isinstance(inner, dict):
        inner[str(_nasty(outside, rng))] = inner.pop(key)


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each container of a tree with each of its keys."""
    keys = list(tree) if isinstance(tree, dict) else range(len(tree))
    for key in keys:
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from _places(tree[key])


def _nasty(outside: Path, rng: np.random.Generator) -> Any:
    """A path that leads out of the session, an address of a program, or a value of any type."""
    victim = outside / "victim.txt"
    up = "../../../outside/victim.txt"
    values: tuple[Any, ...] = (
        *(up, up[3:], up[6:], str(victim), str(outside), str(outside / "room.rad"), "/etc/passwd"),
        f"rpicam:0?program={outside / 'program'}",
        *(f"serial:{victim}?kind=spn1", f"modbus:{victim}?kind={victim}.toml&unit=1"),
        *(f"sim:office?profile={victim}", "radiance", "..", ".", "", ".hidden", "a\\b", "C:x"),
        *("a\0b", "a\nb", "x" * 300, "\ud800", "!touch ran", "9999-99-99T00:00:00Z", "nan"),
        *(None, True, -1, 0, 5, 2**70, 1e308, float("nan"), [], {}, [up], {"file": up}, [[[]]]),
    )
    return values[int(rng.integers(len(values)))]


# ----------------------------------------------------------------------------------------------
# reading


class _Camera(Camera):
    """Writes a few bytes a frame."""

    info = CameraInfo("fuzz")

    def __init__(self, clock: FastClock) -> None:
        self._clock = clock

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        self._clock.sleep(1.0)
        written = target.with_name(f"{target.name}.dng")
        written.write_bytes(b"frame")
        return written


def _capture(session: Session) -> None:
    options = Options(log_around_s=60.0, threaded=False, flush=False, reserve_bytes=4096)
    clock = FastClock(START + timedelta(hours=1, minutes=3))
    run(
        session,
        "fuzz:",
        "",
        clock=clock,
        options=options,
        trusted=lambda: True,
        open_cam=lambda: _Camera(clock),
    )


def _devices(session: Session) -> None:
    clock = FastClock(START)
    camera, pyranometer, meter = device_uris(session, None, None, None)
    if camera:
        open_camera(camera, clock=clock, session=session).close()
    if pyranometer and not pyranometer.startswith("sim:"):
        open_pyranometer(pyranometer, clock=clock, session=session).close()
    if meter:
        open_meter(meter, clock=clock).close()


def _room(session: Session) -> None:
    room = session.site_file().room
    if room is not None:
        sun_patches(room, [[0.0, -0.7, 0.7]], 1.0, height=8, heading_deg=180.0)


def _merge(session: Session) -> None:
    """Merge the complete bracket, without the summary that `merge` draws afterwards."""
    setup = session.site_file()
    profile = load_camera_profile(Path(setup.camera.profile))
    options = MergeOptions(height=8)
    job = MergeJob(_CAPTURED, profile, "", setup.camera.heading_deg, setup.site, options, False)
    verdict = merge_slot(session.root, job)
    if verdict.state == "failed":
        raise InputError(session.raw, verdict.text)


def _command(*words: str) -> Callable[[Session], None]:
    def command(session: Session) -> None:
        result = CliRunner().invoke(main, [*words, str(session.root)])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        if result.exit_code not in (0, 3, 4, 5):
            raise AssertionError(f"exit code {result.exit_code}")
        if result.exit_code:
            complaints = [line for line in result.stderr.splitlines() if f"{words[0]}: " in line]
            if len(complaints) > 1:
                raise AssertionError(f"not one line: {result.stderr}")
            raise InputError(session.root, "; ".join(complaints))

    return command


_STEPS: dict[str, tuple[Callable[[Session], None], ...]] = {
    "journal": (_command("status"), _capture),
    "capture.json": (_merge,),
    "session.toml": (_command("status"), _devices, _room, _command("plan", "--replan")),
    "pairs.csv": (_command("status"), lambda session: _read_pairs(session)),
}


def _read_pairs(session: Session) -> None:
    PairsFile.read(session.pairs)


def read(kind: str, path: Path, root: Path, outside: Path) -> None:
    """Run what uses a file, in a copy of the session that has `path` in its place.

    Raises AssertionError if something outside was opened, changed or started.
    """
    case = root.parent / "case"
    shutil.rmtree(case, ignore_errors=True)
    shutil.copytree(root, case)
    shutil.copyfile(path, case / _FILES[kind])
    before = _state(outside)
    errors = []
    with _Watch(outside, reads=kind != "session.toml") as watch:
        for step in _STEPS[kind]:
            try:
                step(open_session(case))
            except (FieldlumError, OSError) as error:  # the command line prints these as one line
                if isinstance(error, OSError) and error.errno not in DISK_TROUBLE:
                    raise
                errors.append(" ".join(str(error).splitlines()))
    if watch.seen or _state(outside) != before:
        raise AssertionError(f"left the folder: {watch.seen[:3]}")
    if errors:
        raise InputError(path, errors[0])


def _state(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path): base64.b64encode(path.read_bytes()).decode() for path in files}


class _Watch:
    """Collects what happens outside the session's folder.

    reads : whether an opened file counts too; a site may name the file of a room or a profile.
    """

    active: _Watch | None = None
    hooked = False

    def __init__(self, outside: Path, *, reads: bool) -> None:
        self._outside, self._reads = str(outside), reads
        self.seen: list[str] = []

    def __enter__(self) -> _Watch:
        if not _Watch.hooked:
            sys.addaudithook(_heard)
            _Watch.hooked = True
        _Watch.active = self
        return self

    def __exit__(self, *error: object) -> None:
        _Watch.active = None

    def hear(self, event: str, values: tuple[Any, ...]) -> None:
        """Note a program that has to do with the case, and a path outside."""
        is_theirs = self._outside in str(values[:1]) or "touch" in str(values)
        if event in _PROGRAMS and is_theirs:
            self.seen.append(f"{event} {values[0]}")
        elif event in _CHANGES or event == "open":
            texts = [os.fsdecode(value) for value in values if isinstance(value, str | bytes)]
            touched = [text for text in texts if self._is_outside(text)]
            is_read = event == "open" and not (int(values[2] or 0) & _WRITES)
            if touched and (self._reads or not is_read):
                self.seen.append(f"{event} {touched[0]}")

    def _is_outside(self, text: str) -> bool:
        with suppress(ValueError, OSError):
            path = str(Path(text).resolve())
            return path.startswith(self._outside) or path == "/etc/passwd"
        return False


def _heard(event: str, values: tuple[Any, ...]) -> None:
    if _Watch.active is not None:
        _Watch.active.hear(event, values)
