"""The folder itself: where things lie, session.toml, and who may write."""

from __future__ import annotations

import errno
import sys
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

from fieldlum.errors import InputError
from fieldlum.profiles import site_from_table, site_table
from fieldlum.records import SiteFile, Slot
from fieldlum.session.plan_file import PLAN_COLUMNS, read_plan, write_plan
from fieldlum.session.writing import replacing, sha256
from fieldlum.version import __version__

DEFAULT_GRACE_S = 300.0  # the sun moves by 1.3 degrees; `capture --grace` sets another


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
    def pause(self) -> Path:
        """Only while a person has paused the capture."""
        return self.root / "pause.json"

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

    # ------------------------------------------------------------------------------------------
    # files of one slot

    def capture_file(self, slot: str) -> Path:
        return self.raw / slot / "capture.json"

    def panorama(self, slot: str) -> Path:
        return self.panoramas / f"{slot}.exr"

    def sidecar(self, slot: str) -> Path:
        """The provenance of a panorama."""
        return self.panoramas / f"{slot}.json"

    def sunpatch(self, slot: str) -> Path:
        return self.sunpatches / f"{slot}.exr"

    def sunpatch_sidecar(self, slot: str) -> Path:
        return self.sunpatches / f"{slot}.json"

    def truth_panorama(self, slot: str) -> Path:
        return self.truth / f"{slot}.exr"

    # ------------------------------------------------------------------------------------------
    # files of the whole session

    @property
    def clean_irradiance(self) -> Path:
        return self.irradiance / "clean.csv"

    @property
    def irradiance_health(self) -> Path:
        return self.irradiance / "health.json"

    @property
    def quality(self) -> Path:
        return self.panoramas / "quality.csv"

    @property
    def suns(self) -> Path:
        """The sun of each panorama, completed by `pair`."""
        return self.root / "suns.csv"

    def truth_sunpatch(self, slot: str) -> Path:
        return self.truth / "sunpatches" / f"{slot}.exr"

    @property
    def truth_irradiance(self) -> Path:
        return self.truth / "irradiance.csv"

    @property
    def truth_pairs(self) -> Path:
        """pairs.csv of the simulator's own panoramas."""
        return self.truth / "pairs.csv"

    def captured_folders(self) -> list[Path]:
        """Folders of raw/ that hold a bracket, in order of time."""
        return sorted(path for path in self.raw.glob("[0-9]*Z") if path.is_dir())

    def panorama_files(self) -> list[Path]:
        """Merged panoramas in order of time."""
        return sorted(self.panoramas.glob("[!.]*.exr"))

    def sidecar_files(self) -> list[Path]:
        return sorted(self.panoramas.glob("[0-9]*Z.json"))

    def sunpatch_files(self) -> list[Path]:
        return sorted(self.sunpatches.glob("[!.]*.exr"))

    def model_folders(self) -> list[Path]:
        """Folders of models/ that hold a config.json, by name."""
        return sorted(path.parent for path in self.models.glob("*/config.json"))

    def annual_folders(self) -> list[Path]:
        """Folders of annual/ that hold a complete year, by name."""
        return sorted(path.parent for path in self.annual.glob("*/predict.json"))

    # ------------------------------------------------------------------------------------------
    # session.toml and plan.csv

    def table(self) -> dict[str, Any]:
        """The whole of session.toml."""
        return tomllib.loads(self.toml.read_text(encoding="utf-8"))

    def site_file(self) -> SiteFile:
        """Site, camera, room and pyranometer, as they stood when the session was planned."""
        return site_from_table(self.table().get("setup", {}), str(self.toml))

    def slots(self) -> list[Slot]:
        return read_plan(self.plan)

    @property
    def grace(self) -> timedelta:
        """How late a bracket may start: of the last capture, else DEFAULT_GRACE_S."""
        seconds = self.table().get("capture", {}).get("grace_s", DEFAULT_GRACE_S)
        return timedelta(seconds=float(seconds))


def open_session(root: Path) -> Session:
    """Raises InputError when `root` is no session."""
    session = Session(root)
    if not session.toml.is_file():
        raise InputError(
            root,
            "no session.toml in it",
            "a session folder",
            "make one with: fieldlum plan SITE.toml",
        )
    try:
        session.table()
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(session.toml, str(error), "TOML", "restore it from a copy") from None
    return session


def create_session(
    root: Path, setup: SiteFile, slots: Iterable[Slot], plan_about: dict[str, Any]
) -> Session:
    """Write plan.csv and session.toml. The plan is immutable: raises InputError when there is one
    already.

    A plan.csv without session.toml is what a kill between the two leaves, and is written again;
    another file is not.
    """
    session = Session(root)
    if session.toml.exists():
        raise InputError(
            root, "already a session", "a new folder", "choose another --out, or use --replan"
        )
    if session.plan.is_file() and not session.plan.read_bytes().startswith(
        ",".join(PLAN_COLUMNS).encode()
    ):
        raise InputError(
            session.plan, "a file of something else", "a new folder", "choose another --out"
        )
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


def store_grace(session: Session, grace_s: float) -> None:
    """Store how late a bracket may start, so that doctor and re-planning know it too."""
    if session.grace.total_seconds() != grace_s:
        capture = session.table().get("capture", {})
        update_session(session, {"capture": {**capture, "grace_s": grace_s}})


@contextmanager
def sole_user(session: Session, purpose: str) -> Iterator[None]:
    """Only one `purpose` (capture, log) at a time works on a session; the lock goes with the
    process, however it ends.

    Raises InputError when another one runs.
    """
    with (session.root / f".{purpose}.lock").open("a") as file:
        try:
            _lock(file.fileno())
        except OSError as error:
            if error.errno in (
                errno.ENOLCK,
                errno.ENOTSUP,
                errno.ENOSYS,
            ):  # a share that knows no locks
                found = f"a folder that cannot be locked ({error.strerror})"
                raise InputError(
                    session.root, found, "a folder on a disk of this computer", "move it there"
                ) from None
            raise InputError(
                session.root, f"another fieldlum {purpose} runs here", "one", "stop it first"
            ) from None
        yield


def _lock(number: int) -> None:
    """Lock an open file for this process alone. Raises OSError when another one holds it."""
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(number, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
