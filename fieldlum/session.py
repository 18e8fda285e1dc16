"""The session folder on disk: the only module that knows its file names.

Everything multi-byte is written to a temporary name in the same folder, flushed, then renamed; the journal and the
irradiance day files are append-only with a CRC per line and are cut back to their last whole line on opening.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import threading
import tomllib
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any
from zoneinfo import ZoneInfo

from fieldlum import __version__
from fieldlum.errors import InputError
from fieldlum.profiles import site_from_table, site_table
from fieldlum.records import Exposure, IrradianceSample, SiteFile, Slot, parse_utc, slot_id, utc_text

PLAN_COLUMNS = ("slot", "t_utc", "t_local", "sun_altitude_deg", "sun_azimuth_deg", "exposures", "tags")
_TAIL_BYTES = 1 << 20  # how far back a torn tail is looked for


# ---------------------------------------------------------------------------------------------- writing safely


@contextmanager
def replacing(path: Path, mode: str = "wb", **kwargs: Any) -> Iterator[IO[Any]]:
    """A file that appears under its name only when it is whole: written beside, fsynced, then renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open(mode, **kwargs) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


@contextmanager
def replacing_path(path: Path) -> Iterator[Path]:
    """As `replacing`, for writers that want a path: yields a temporary one with the same suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.tmp.{path.name}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make a rename durable (POSIX; elsewhere there is nothing to do)."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# ---------------------------------------------------------------------------------------------- append-only lines


def encode_line(row: dict[str, Any]) -> bytes:
    """One journal line: CRC-32 in hex, a space, compact JSON, newline."""
    text = json.dumps(row, separators=(",", ":"), ensure_ascii=False)
    return f"{zlib.crc32(text.encode()):08x} {text}\n".encode()


def decode_line(line: bytes) -> dict[str, Any] | None:
    """The row of a whole and unharmed line, else None."""
    crc, _, text = line.rstrip(b"\n").partition(b" ")
    try:
        sound = line.endswith(b"\n") and len(crc) == 8 and int(crc, 16) == zlib.crc32(text)
        return json.loads(text) if sound else None
    except ValueError:
        return None


def append_durably(handle: int, data: bytes, *, flush: bool = True) -> None:
    """Write all of `data` to a file opened with O_APPEND and flush it to the disk before returning."""
    while data:
        data = data[os.write(handle, data) :]
    if flush:
        os.fdatasync(handle) if hasattr(os, "fdatasync") else os.fsync(handle)


def cut_torn_tail(path: Path, sound: Callable[[bytes], bool]) -> int:
    """Cut `path` back to its last sound line; returns how many bytes went (to ``NAME.torn`` beside it, never away).

    A kill or a power cut in the middle of a write leaves half a line, or a page of zeros. Unsound lines further up
    are left where they are: readers skip and count them. Raises InputError when no line at all is sound.
    """
    if not path.is_file():
        return 0
    with path.open("rb+") as file:
        size = file.seek(0, os.SEEK_END)
        start = max(0, size - _TAIL_BYTES)
        file.seek(start)
        tail = file.read()
        keep = len(tail)
        while keep:
            begin = tail.rfind(b"\n", 0, keep - 1) + 1
            if sound(tail[begin:keep]):
                break
            keep = begin
        if keep == 0 and tail.count(b"\n") > 2:
            raise InputError(path, "no line of it is sound", "what fieldlum wrote", "was it edited? restore or move it")
        cut = len(tail) - keep
        if cut:
            with path.with_name(f"{path.name}.torn").open("ab") as torn:
                torn.write(tail[keep:])
            file.truncate(start + keep)
            os.fsync(file.fileno())
    return cut


@contextmanager
def sole_user(session: Session, purpose: str) -> Iterator[None]:
    """Only one `purpose` (capture, log) at a time works on a session; the lock goes with the process, however it ends.

    Raises InputError when another one runs.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on Windows
        yield
        return
    with (session.root / f".{purpose}.lock").open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(session.root, f"another fieldlum {purpose} runs here", "one", "stop it first") from None
        yield


# ---------------------------------------------------------------------------------------------- journal


class Journal:
    """The session's events: appended with a CRC and flushed to disk one by one, by any thread; never rewritten."""

    def __init__(self, session: Session, *, flush: bool = True) -> None:
        """flush False: survives a kill, but not a power cut; for simulated time."""
        self._path, self._flush = session.journal, flush
        self._lock = threading.Lock()
        self.cut_bytes = cut_torn_tail(self._path, lambda line: decode_line(line) is not None)
        self._handle = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def append(self, event: str, t_utc: datetime, **fields: Any) -> None:
        """Durable when this returns. Raises OSError on a full disk; half a line is then taken back."""
        data = encode_line({"event": event, "t_utc": utc_text(t_utc), **fields})
        with self._lock:
            append_whole(self._handle, data, flush=self._flush)

    def close(self) -> None:
        os.close(self._handle)


def append_whole(handle: int, data: bytes, *, flush: bool) -> None:
    """`append_durably`, and back to the length before when the disk has no room for all of it."""
    before = os.fstat(handle).st_size
    try:
        append_durably(handle, data, flush=flush)
    except OSError:
        with suppress(OSError):
            os.ftruncate(handle, before)
        raise


def read_journal(session: Session) -> list[dict[str, Any]]:
    """All sound events, in the order written; no journal yet is no event."""
    if not session.journal.is_file():
        return []
    with session.journal.open("rb") as file:
        return [row for line in file if (row := decode_line(line)) is not None]


# ---------------------------------------------------------------------------------------------- irradiance day files


DAY_COLUMNS = ("t_utc", "ghi_wm2", "dhi_wm2", "dni_wm2", "temperature_c", "status", "raw", "crc")
_DAY_HEADER = (",".join(DAY_COLUMNS) + "\n").encode()


def encode_sample(sample: IrradianceSample) -> bytes:
    """One row of a day file; its last column is the CRC-32 of what stands before that column's comma."""
    figures = (sample.ghi_wm2, sample.dhi_wm2, sample.dni_wm2, sample.temperature_c)
    row = io.StringIO()
    texts = [text.encode("ascii", "backslashreplace").decode() for text in (sample.status, sample.raw)]
    printable = ["".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text) for text in texts]
    shown = ["" if value is None or not math.isfinite(value) else f"{value:.7g}" for value in figures]
    csv.writer(row, lineterminator="").writerow([utc_text(sample.t_utc), *shown, *printable])
    body = row.getvalue().encode()
    return body + b",%08x\n" % zlib.crc32(body)


def decode_sample(line: bytes) -> IrradianceSample | None:
    """The sample of a whole and unharmed row, else None."""
    body, _, crc = line.rstrip(b"\n").rpartition(b",")
    try:
        if not line.endswith(b"\n") or len(crc) != 8 or int(crc, 16) != zlib.crc32(body):
            return None
        t_utc, *figures, status, raw = next(csv.reader([body.decode()]))
        ghi, dhi, dni, temperature = (float(text) if text else None for text in figures)
        return IrradianceSample(parse_utc(t_utc), ghi, dhi, dni, temperature, status, raw)
    except (ValueError, StopIteration):
        return None


class DayFiles:
    """Appends samples to UTC day files, each row durable when `append` returns."""

    def __init__(self, session: Session, *, flush: bool = True) -> None:
        self._folder, self._flush = session.irradiance, flush
        self._day, self._handle = "", -1
        self.cut_bytes = 0
        self._folder.mkdir(parents=True, exist_ok=True)

    def append(self, sample: IrradianceSample) -> None:
        """Raises OSError on a full disk; half a row is then taken back."""
        day = sample.t_utc.astimezone(UTC).strftime("%Y-%m-%d")
        if day != self._day:
            self._open(day)
        append_whole(self._handle, encode_sample(sample), flush=self._flush)

    def _open(self, day: str) -> None:
        self.close()
        path = self._folder / f"{day}.csv"
        self.cut_bytes += cut_torn_tail(path, lambda line: line == _DAY_HEADER or decode_sample(line) is not None)
        handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            if os.fstat(handle).st_size == 0:
                append_whole(handle, _DAY_HEADER, flush=self._flush)
                sync_folder(self._folder)
        except OSError:
            os.close(handle)
            raise
        self._day, self._handle = day, handle

    def close(self) -> None:
        if self._handle >= 0:
            os.close(self._handle)
        self._day, self._handle = "", -1


def day_files(session: Session) -> list[Path]:
    return sorted(session.irradiance.glob("[0-9][0-9][0-9][0-9]-[0-9][0-9]-[0-9][0-9].csv"))


def read_day(path: Path) -> tuple[list[IrradianceSample], int]:
    """Samples of one day file and the number of unsound lines that were skipped."""
    samples: list[IrradianceSample] = []
    broken = 0
    with path.open("rb") as file:
        for line in file:
            sample = decode_sample(line)
            if sample is not None:
                samples.append(sample)
            elif line != _DAY_HEADER:
                broken += 1
    return samples, broken


# ---------------------------------------------------------------------------------------------- the folder


@dataclass(frozen=True, slots=True)
class Session:
    root: Path

    @property
    def toml(self) -> Path:
        return self.root / "session.toml"

    @property
    def plan(self) -> Path:
        return self.root / "plan.csv"

    @property
    def journal(self) -> Path:
        return self.root / "journal.jsonl"

    @property
    def irradiance(self) -> Path:
        """Folder of UTC day files ``2027-03-20.csv`` and of ``clean.csv``."""
        return self.root / "irradiance"

    @property
    def raw(self) -> Path:
        return self.root / "raw"

    @property
    def panoramas(self) -> Path:
        return self.root / "panoramas"

    @property
    def sunpatches(self) -> Path:
        return self.root / "sunpatches"

    @property
    def pairs(self) -> Path:
        return self.root / "pairs.csv"

    @property
    def models(self) -> Path:
        return self.root / "models"

    @property
    def annual(self) -> Path:
        return self.root / "annual"

    @property
    def report(self) -> Path:
        return self.root / "report"

    @property
    def truth(self) -> Path:
        """Only in simulated sessions: what the simulator knows."""
        return self.root / "truth"

    def table(self) -> dict[str, Any]:
        """The whole of session.toml."""
        return tomllib.loads(self.toml.read_text(encoding="utf-8"))

    def site_file(self) -> SiteFile:
        """Site, camera, room and pyranometer, as they stood when the session was planned."""
        return site_from_table(self.table().get("setup", {}), str(self.toml))

    def slots(self) -> list[Slot]:
        return read_plan(self.plan)


def open_session(root: Path) -> Session:
    """Raises InputError when `root` is no session."""
    session = Session(root)
    if not session.toml.is_file():
        raise InputError(root, "no session.toml in it", "a session folder", "make one with: fieldlum plan SITE.toml")
    try:
        session.table()
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(session.toml, str(error), "TOML", "restore it from a copy") from None
    return session


def create_session(root: Path, setup: SiteFile, slots: Iterable[Slot], plan_about: dict[str, Any]) -> Session:
    """Write plan.csv and session.toml. The plan is immutable: raises InputError when there is one already."""
    session = Session(root)
    if session.toml.exists():
        raise InputError(root, "already a session", "a new folder", "choose another --out, or use --replan")
    write_plan(session.plan, slots, setup.site.timezone)
    update_session(
        session,
        {
            "setup": site_table(setup),
            "plan": {**plan_about, "sha256": sha256(session.plan)},
            "software": {"fieldlum": __version__},
        },
    )
    return session


def update_session(session: Session, tables: dict[str, Any]) -> None:
    """Merge top-level tables into session.toml (a table given replaces the one of that name)."""
    import tomli_w

    known = session.table() if session.toml.exists() else {}
    with replacing(session.toml) as file:
        file.write(tomli_w.dumps({**known, **tables}).encode())


# ---------------------------------------------------------------------------------------------- plan.csv


def exposure_text(exposure: Exposure) -> str:
    """``1/250 f/5.6 ISO100`` with an optional `` ND=name``; read back by `parse_exposure`."""
    shutter = exposure.shutter_s
    shown = f"1/{1 / shutter:.6g}" if shutter < 0.5 else f"{shutter:.6g}"
    return f"{shown} f/{exposure.f_number:g} ISO{exposure.iso:g}" + (f" ND={exposure.nd}" if exposure.nd else "")


def parse_exposure(text: str) -> Exposure:
    """Raises ValueError for anything that is no exposure."""
    shutter, f_number, iso, *nd = text.split()
    seconds = 1.0 / float(shutter[2:]) if shutter.startswith("1/") else float(shutter)
    if not f_number.startswith("f/") or not iso.startswith("ISO"):
        raise ValueError(text)
    return Exposure(seconds, float(f_number[2:]), float(iso[3:]), nd[0].removeprefix("ND=") if nd else "")


def write_plan(path: Path, slots: Iterable[Slot], timezone: str) -> None:
    zone = ZoneInfo(timezone)
    with replacing(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(PLAN_COLUMNS)
        for slot in slots:
            writer.writerow(
                (
                    slot.id,
                    utc_text(slot.t_utc),
                    slot.t_utc.astimezone(zone).strftime("%Y-%m-%d %H:%M %Z"),
                    f"{slot.sun_altitude_deg:.3f}",
                    f"{slot.sun_azimuth_deg:.3f}",
                    "; ".join(exposure_text(e) for e in slot.exposures),
                    " ".join(slot.tags),
                )
            )


def read_plan(path: Path) -> list[Slot]:
    """Raises InputError naming the line."""
    if not path.is_file():
        raise InputError(path, "no such file", "the plan of a session", "make one with: fieldlum plan SITE.toml")
    slots: list[Slot] = []
    with path.open(newline="", encoding="utf-8") as file:
        for number, row in enumerate(csv.DictReader(file), start=2):
            try:
                t_utc: datetime = parse_utc(row["t_utc"])
                if slot_id(t_utc) != row["slot"]:
                    raise ValueError(f"slot {row['slot']} does not match t_utc {row['t_utc']}")
                exposures = tuple(parse_exposure(text) for text in row["exposures"].split(";") if text.strip())
                angles = float(row["sun_altitude_deg"]), float(row["sun_azimuth_deg"])
                slots.append(Slot(t_utc, *angles, exposures, tuple(row["tags"].split())))
            except (KeyError, ValueError, TypeError, AttributeError) as error:
                expected = f"columns {', '.join(PLAN_COLUMNS)}"
                raise InputError(f"{path}:{number}", f"{error}", expected, "restore the plan from a copy") from None
    return slots
