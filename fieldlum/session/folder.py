"""Define the session folder: its paths, session.toml, and the lock for writers."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import date, timedelta
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal, Required, TypedDict, cast

from filelock import FileLock, Timeout
from msgspec import Meta

from fieldlum.core import files, strict_toml
from fieldlum.core.errors import ChangedFileWarning, InputError, input_errors
from fieldlum.core.files import read_bytes, sha256, write_file
from fieldlum.core.records import SiteFile, Slot
from fieldlum.session.codec import Seconds, convert
from fieldlum.session.plan_file import PLAN_COLUMNS, read_plan, write_plan
from fieldlum.session.safe_paths import is_plain, open_inside, refuse_links
from fieldlum.session.site_toml import site_from_table, site_table, with_paths_from
from fieldlum.version import __version__

# How late a bracket may start; the sun moves by 1.3 degrees in this time. Chosen; `capture --grace`
# sets another.
DEFAULT_GRACE_S = 300.0


# ----------------------------------------------------------------------------------------------
# the tables of session.toml

DeviceTable = dict[str, str | int | float | bool]
"What a device reports about itself."


class PlanTable(TypedDict, total=False):
    """[plan] of session.toml: what was requested, and the plan that resulted.

    Requested are set: name of the capture set, such as month; start: first date; year: of its
    events; days, count: number of days and of slots; seed: of a sample of the year. Resulted have
    revision: number of this version of the plan, 0 for the first; slots: their number; first, last:
    dates; seconds_per_slot, megabytes_per_slot: time and disk space of a bracket at all headings;
    sun_band_percent: of the sky area that the sun crosses in a year, the share within 10 deg of a
    planned sun; sha256: of plan.csv, older_sha256: of the earlier ones.
    """

    set: str
    start: date
    year: int
    days: int
    count: int
    seed: int
    revision: Annotated[int, Meta(ge=0, le=1_000_000)]
    slots: int
    first: date
    last: date
    seconds_per_slot: Seconds
    megabytes_per_slot: float
    sun_band_percent: float
    sha256: str
    older_sha256: list[str]


class DevicesTable(TypedDict, total=False):
    """[devices] of session.toml, of the last capture or log.

    uris: addresses by device (camera, pyranometer, meter), "" for none; camera, pyranometer, meter:
    what each reports about itself.
    """

    uris: dict[str, str]
    camera: DeviceTable
    pyranometer: DeviceTable
    meter: DeviceTable


class LoggerFileTable(TypedDict, total=False):
    """How a logger's file was read.

    file: its name without the folder, because the file may have grown and come from another card;
    utc_offset_s: the logger's clock minus UTC [s]; columns: names of the columns by quantity;
    sensitivities: of pyranometers whose column is a voltage [uV per W/m2].
    """

    file: Required[str]
    utc_offset_s: Annotated[float, Meta(ge=-86400.0, le=86400.0)]
    columns: dict[str, str]
    sensitivities: dict[str, float]


class SessionTable(TypedDict, total=False):
    """The content of session.toml, table by table.

    setup: SITE.toml; plan: what was planned; devices: addresses of camera and instruments;
    simulation: of simulated light; software: versions by name; capture: grace_s, how late a bracket
    may start [s]; imported: the frames that were imported, by card folder, with the offset of the
    camera's clock; logger_files: how each file was read.
    """

    setup: dict[str, Any]
    plan: PlanTable
    devices: DevicesTable
    capture: dict[str, Annotated[float, Meta(ge=0.0, le=86400.0)]]
    imported: dict[str, list[dict[str, str | float]]]
    logger_files: list[LoggerFileTable]
    simulation: dict[str, Any]
    software: dict[str, str]


# ----------------------------------------------------------------------------------------------
# the folder


class _Place:
    """A file or folder of a session; as an attribute of `Session` it is the path.

    parts: names of the folders on the way, and its own, below the session's folder.
    """

    def __init__(self, *parts: str) -> None:
        self._parts, self.top = parts, parts[0]

    def __get__(self, session: Session, owner: type[Session]) -> Path:
        return session.root.joinpath(*self._parts)


class _SlotPlace:
    """A file of each slot; as an attribute of `Session` it is a function from slot id to path.

    parts: names of the folders on the way, and of the file, below the session's folder, with `{}`
    for the slot's id.
    """

    def __init__(self, *parts: str) -> None:
        self._parts, self.top = parts, parts[0]

    def __get__(self, session: Session, owner: type[Session]) -> Callable[[str], Path]:
        """Return the function that gives a slot's path in a session."""

        def path_of(slot: str) -> Path:
            """Return the path for a slot id; raise InputError for an id with a path in it."""
            if not is_plain(slot):  # from the journal or another file that anybody may have written
                found, expected = f"the slot name {slot!r}", "a name such as 20270320T153000Z"
                remedy = "restore the file that names the slot from a copy"
                raise InputError(session.root, found, expected, remedy)
            return session.root.joinpath(*(part.format(slot) for part in self._parts))

        return path_of


@dataclass(frozen=True)
class Session:
    """A session folder: the paths in it, and its own files session.toml and plan.csv.

    root: the folder; each other attribute is a path below it, whether the file or folder exists or
    not, or a function from a slot's id to such a path. Paths are relative if root is.
    """

    root: Path

    toml = _Place("session.toml")  # site, camera, room, plan and devices
    plan = _Place("plan.csv")  # the slots
    journal = _Place("journal.jsonl")  # all events
    irradiance = _Place("irradiance")  # UTC day files 2027-03-20.csv, clean.csv, health.json
    clean_irradiance = _Place("irradiance", "clean.csv")  # quality-checked irradiance
    irradiance_health = _Place("irradiance", "health.json")  # result of the quality checks
    raw = _Place("raw")  # the captured brackets, one folder for each slot
    panoramas = _Place("panoramas")  # merged
    quality = _Place("panoramas", "quality.csv")  # one row for each merged bracket
    suns = _Place("suns.csv")  # the sun of each panorama, completed by `pair`
    sky_view = _Place("sky_view.exr")  # where the camera sees the sky, by `pair`
    sunpatches = _Place("sunpatches")  # maps of sun patches
    pairs = _Place("pairs.csv")  # panoramas with their light
    models = _Place("models")  # trained
    annual = _Place("annual")  # predicted years
    report = _Place("report")
    truth = _Place("truth")  # the simulator's truth, only in simulated sessions
    truth_irradiance = _Place("truth", "irradiance.csv")
    truth_pairs = _Place("truth", "pairs.csv")  # of the simulator's panoramas

    capture_file = _SlotPlace("raw", "{}", "capture.json")
    panorama = _SlotPlace("panoramas", "{}.exr")
    sidecar = _SlotPlace("panoramas", "{}.json")
    sky_picture = _SlotPlace("panoramas", "{}.sky.npz")
    sunpatch = _SlotPlace("sunpatches", "{}.exr")
    sunpatch_sidecar = _SlotPlace("sunpatches", "{}.json")
    truth_panorama = _SlotPlace("truth", "{}.exr")
    truth_sky_picture = _SlotPlace("truth", "{}.sky.npz")
    truth_sunpatch = _SlotPlace("truth", "sunpatches", "{}.exr")

    def captured_folders(self) -> list[Path]:
        """Return the folders in raw/, one for each slot that was begun, in order of time."""
        return sorted(path for path in self.raw.glob("[0-9]*Z") if path.is_dir())

    def slot_bytes(self) -> float:
        """Return the space on the disk to expect for a slot [bytes].

        It is the size that the plan states, or that of the largest of the last five complete
        brackets, because a camera's files may differ much from the profile's estimate. 0 if
        SITE.toml names no camera profile and no bracket is complete. A bracket is complete if it
        has a capture.json. Raises InputError as `table` and `site_file` do.
        """
        folders = reversed(self.captured_folders())
        latest = islice((f for f in folders if self.capture_file(f.name).is_file()), 5)
        sizes = [sum(file.stat().st_size for file in f.glob("[!.]*")) for f in latest]
        is_stated = "profile" not in self.site_file().camera.assumed
        planned = float(self.table().get("plan", {}).get("megabytes_per_slot", 0.0))
        return max(1e6 * planned * is_stated, *sizes, 0.0)

    def panorama_files(self) -> list[Path]:
        """Return the merged panoramas, sorted by name (for names of slots, in order of time)."""
        return sorted(self.panoramas.glob("[!.]*.exr"))

    def sidecar_files(self) -> list[Path]:
        """Return the JSON files of merged panoramas (panoramas/SLOT.json) in order of time."""
        return sorted(self.panoramas.glob("[0-9]*Z.json"))

    def model_folders(self) -> list[Path]:
        """Return the folders in models/ with a config.json, sorted by name."""
        return sorted(path.parent for path in self.models.glob("*/config.json"))

    def trained_models(self) -> list[Path]:
        """Return the model folders with config.json and weights.npz, newest config.json first."""
        complete = (path for path in self.model_folders() if (path / "weights.npz").is_file())
        return sorted(complete, key=lambda path: -(path / "config.json").stat().st_mtime)

    def annual_folders(self) -> list[Path]:
        """Return the folders in annual/ with a predict.json, sorted by name."""
        return sorted(path.parent for path in self.annual.glob("*/predict.json"))

    # ------------------------------------------------------------------------------------------
    # session.toml and plan.csv

    def table(self) -> SessionTable:
        """Return the content of session.toml. Raises InputError if it cannot be read."""
        return cast(SessionTable, strict_toml.read_toml(self.toml))

    def site_file(self) -> SiteFile:
        """Return site, camera, room and pyranometer, as recorded when the session was planned.

        The files that it names are searched from the session's folder upwards (`with_paths_from`).
        Raises InputError if the table [setup] of session.toml is wrong.
        """
        setup = site_from_table(self.table().get("setup", {}), str(self.toml))
        return with_paths_from(setup, self.root)

    def slots(self) -> list[Slot]:
        """Return the planned slots in the order of plan.csv; warn if it was changed by hand.

        Raises InputError for a wrong plan.csv.
        """
        slots = read_plan(self.plan)
        if self.table().get("plan", {}).get("sha256", "") not in ("", sha256(self.plan)):
            text = f"{self.plan}: the content changed after fieldlum wrote it; expected the sha256 "
            text += "in session.toml; restore it from a copy, or plan a new session"
            warnings.warn(text, ChangedFileWarning, stacklevel=2)
        return slots

    @property
    def grace(self) -> timedelta:
        """How late a bracket may start: the --grace of the last capture, else 300 s.

        Raises InputError if session.toml cannot be read.
        """
        return timedelta(seconds=self.table().get("capture", {}).get("grace_s", DEFAULT_GRACE_S))


# Names, up to their first dot, of the entries of a session's folder in which links are rejected:
# pairs stands for pairs.csv, pairs.csv.sha256 and pairs.alignment.csv. fieldlum opens more than the
# attributes of a session.
_MORE_STEMS = {"scene", "watch", "export", "compare", "room", "demo"}
_PLACES = [place for place in vars(Session).values() if isinstance(place, _Place | _SlotPlace)]
_CHECKED_STEMS = {place.top.partition(".")[0] for place in _PLACES} | _MORE_STEMS


def _open(path: Path, flags: int) -> int:
    """Return the handle of a file that is opened with `flags` of os.open.

    In the checked entries of a session, a link on the way to the file raises OSError.
    """
    place = Path(os.path.abspath(path))  # noqa: PTH100  (links remain)
    # The outermost session: a link in it may lead to a folder with another session.toml.
    for root, entry in zip(reversed(place.parents), place.parts[1:], strict=True):
        if entry.partition(".")[0] in _CHECKED_STEMS and (root / "session.toml").exists():
            return open_inside(root, place, flags)
    return files.open_file(path, flags, follow_links=True)


files.opener = _open


def open_session(root: Path) -> Session:
    """Return the session of a folder.

    Raises InputError if `root` has no session.toml, if that is no TOML or has a value of a wrong
    type, or if the folder has a link that the user did not permit, a pipe or a device where
    fieldlum reads or writes (`refuse_links`).
    """
    session = Session(root)
    if not session.toml.is_file():
        found = "this is a file" if root.is_file() else "no session.toml in this folder"
        found = found if root.exists() else "no such folder"
        remedy = "correct the path, or plan a session with: fieldlum plan SITE.toml"
        of_year = (f"{folder}predict.json" for folder in ("", "*/", "models/*/*/"))
        if results := [path for name in of_year for path in sorted(root.glob(name))]:
            remedy = f"the year of a csv is in predict.json and hourly.csv of {results[0].parent}"
        if root.name == "session.toml":
            remedy = f"name its folder: {root.parent}"
        raise InputError(root, found, "a session folder", remedy)
    remedy = "correct that place, or restore session.toml from a copy"
    refuse_links(root, _CHECKED_STEMS)
    with input_errors(session.toml, "TOML with the types that fieldlum writes", remedy, ValueError):
        convert(session.table(), SessionTable, strict=True)
    return session


def create_session(
    root: Path, setup: SiteFile, slots: Iterable[Slot], plan_about: PlanTable
) -> Session:
    """Write plan.csv and session.toml into a folder, and return it as a session.

    root: the folder, which is created; setup: for the table [setup]; plan_about: the table [plan],
    without sha256. Raises InputError if the folder is a session or inside one, or has a plan.csv
    that fieldlum did not write. A plan.csv of fieldlum without session.toml, from an interrupted
    plan, is written again. Raises OSError if nothing can be written.
    """
    session = Session(root)
    if session.toml.exists():
        remedy = "choose another --out; to plan missed hours again: fieldlum plan SESSION --replan"
        raise InputError(root, "this folder is already a session", "a new folder", remedy)
    if outer := next((p for p in root.absolute().parents if (p / "session.toml").is_file()), None):
        found, remedy = f"a folder inside the session {outer}", "choose another --out"
        raise InputError(root, found, "a folder outside of other sessions", remedy)
    header, plan = ",".join(PLAN_COLUMNS).encode(), session.plan
    if plan.is_file() and not read_bytes(plan).startswith(header):
        found = "a plan.csv of another program"
        raise InputError(plan, found, "a new folder", "choose another --out")
    write_plan(plan, slots, setup.site.timezone)
    about: PlanTable = {**plan_about, "sha256": sha256(plan)}
    software = {"fieldlum": __version__}
    update_session(session, {"setup": site_table(setup), "plan": about, "software": software})
    return session


def update_session(session: Session, tables: SessionTable) -> None:
    """Write tables into session.toml; each replaces the table of the same name, others remain.

    Raises InputError if session.toml cannot be read, OSError if it cannot be written.
    """
    import tomli_w

    before = session.table() if session.toml.exists() else {}
    write_file(session.toml, tomli_w.dumps({**before, **tables}))


def store_grace(session: Session, grace_s: float) -> None:
    """Store in session.toml how late a bracket may start [s], for other commands."""
    if session.grace.total_seconds() != grace_s:
        update_session(session, {"capture": {"grace_s": grace_s}})


# What a process with the lock does, for errors.
_LOCKED = {"capture": "captures or imports into", "log": "logs irradiance into"}


@contextmanager
def sole_user(session: Session, purpose: Literal["capture", "log"]) -> Iterator[None]:
    """Hold a lock on a session in the `with` block, so that only one process at a time adds to it.

    purpose: "capture" (frames, also those of `import`) or "log" (irradiance). The lock ends with
    the process, even after a crash. Raises InputError if another process has it, OSError if the
    folder's file system has no locks.
    """
    path = session.root / f".{purpose}.lock"
    lock = FileLock(path, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        other = "another fieldlum"
        with suppress(OSError, ValueError):  # on Windows nobody can read a locked file
            number = int(path.read_text(encoding="utf-8"))
            other += f" (process {number})" if number > 0 else ""
        found, remedy = f"{other} {_LOCKED[purpose]} this session", "stop the other process first"
        raise InputError(session.root, found, "one process at a time", remedy) from None
    try:
        # The number is for errors of other processes only; a full disk must not prevent a capture.
        with suppress(OSError), os.fdopen(open_inside(path.parent, path, os.O_WRONLY), "w") as file:
            file.write(f"{os.getpid()}\n")
            file.truncate()
        yield
    finally:
        lock.release()
