"""Preflight: everything that would ruin a month of captures, one plain verdict a line, before
anybody leaves.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any, Literal
from zoneinfo import ZoneInfo

from fieldlum import sun
from fieldlum.devices import (
    FORM_ALONE,
    CameraInfo,
    InstrumentInfo,
    not_offered,
    open_camera,
    open_meter,
    open_pyranometer,
)
from fieldlum.devices.clock import RealClock
from fieldlum.doctor.awake import Lock, has_lid, inhibitors, lock_to_be_had
from fieldlum.errors import FieldlumError, InputError
from fieldlum.profiles import CameraProfile, coverage_text, load_camera_profile
from fieldlum.raw import same_model
from fieldlum.records import IrradianceSample, Progress, Site, SiteFile, Slot, quiet
from fieldlum.session import Session, outcomes, sha256

Verdict = Literal["ok", "warn", "fail"]
DISK_MARGIN = 1.3
CALIBRATION_YEARS = 2.0
CAMERA_CLOCK_WARN_S, CAMERA_CLOCK_FAIL_S = (
    5.0,
    300.0,
)  # import matches by time with a measured offset; slots are 1 h apart
SLOW_FSYNC_S = 0.5
SYNCED_FOLDERS = ("dropbox", "onedrive", "google drive", "googledrive", "icloud", "nextcloud")


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the verdict. exit_code counts when it failed: 4 devices and this computer, 3
    files.
    """

    what: str
    verdict: Verdict
    text: str
    exit_code: int = 4


def run(
    session: Session,
    camera_uri: str,
    pyranometer_uri: str,
    now_utc: datetime,
    progress: Progress = quiet,
    *,
    meter_uri: str = "",
) -> list[Finding]:
    """All checks. A check that breaks is a failed finding, never an exception."""
    checks: list[tuple[str, Callable[[], list[Finding]]]] = [
        ("plan", lambda: check_plan(session, now_utc)),
        ("profile", lambda: check_profile(session, now_utc.date())),
        ("camera", lambda: check_camera(session, camera_uri, now_utc)),
        ("pyranometer", lambda: check_pyranometer(session, pyranometer_uri)),
        ("meter", lambda: check_meter(meter_uri)),
        ("clock", lambda: [check_clock(kernel_clock())]),
        ("disk", lambda: [check_disk(session, now_utc, shutil.disk_usage(session.root).free)]),
        ("writing", lambda: check_writing(session.root)),
        ("sleep", lambda: [check_sleep(inhibitors(), has_lid(), lock_to_be_had())]),
        ("calendar", lambda: check_calendar(session, now_utc)),
    ]
    found: list[Finding] = []
    for number, (name, check) in enumerate(checks):
        progress(number, len(checks), name)
        try:
            found += check()
        except (FieldlumError, OSError, ValueError, KeyError) as error:
            found.append(
                Finding(name, "fail", str(error), 3 if isinstance(error, InputError) else 4)
            )
    return found


def exit_code(findings: Sequence[Finding]) -> int:
    """0 when nothing failed; a bad file (3) comes before a device (4), for without files nothing
    else counts.
    """
    codes = [finding.exit_code for finding in findings if finding.verdict == "fail"]
    return min(codes, default=0)


def as_table(findings: Sequence[Finding]) -> dict[str, Any]:
    return {"ok": exit_code(findings) == 0, "findings": [asdict(finding) for finding in findings]}


# ----------------------------------------------------------------------------------------------
# plan and profile


def owed_slots(session: Session, now_utc: datetime) -> list[Slot]:
    """Slots that can still be taken."""
    settled, grace = outcomes(session), session.grace
    return [
        slot for slot in session.slots() if slot.id not in settled and slot.t_utc + grace >= now_utc
    ]


def check_plan(session: Session, now_utc: datetime) -> list[Finding]:
    """The plan is the one that was made, and something of it is still ahead."""
    about = session.table().get("plan", {})
    slots, ahead = session.slots(), owed_slots(session, now_utc)
    found = []
    if about.get("sha256", "") != sha256(session.plan):
        text = (
            "plan.csv is not the file that session.toml was written for: restore it, or run "
            "fieldlum plan --replan"
        )
        found.append(Finding("plan", "fail", text, 3))
    if not ahead:
        return [*found, Finding("plan", "warn", f"none of its {len(slots)} slots is still ahead")]
    zone = ZoneInfo(session.site_file().site.timezone)
    first = ahead[0].t_utc.astimezone(zone)
    text = f"{len(ahead)} of {len(slots)} slots ahead, the next on {first:%a %Y-%m-%d at %H:%M %Z}"
    return [*found, Finding("plan", "ok", text)]


def check_profile(session: Session, today: date) -> list[Finding]:
    """The camera profile reads, is not out of date, and fits the planned exposures."""
    setup = session.site_file()
    profile = load_camera_profile(setup.camera.profile)
    blind = coverage_text(profile, setup.camera)
    coverage = [Finding("coverage", "warn", blind)] if blind else []
    return [_age(profile, today), *_fit(profile, session.slots()), *coverage]


def _age(profile: CameraProfile, today: date) -> Finding:
    name = profile.camera.name
    expires, made = _date(profile.expires), _date(profile.camera.date)
    if expires and expires < today:
        return Finding(
            "profile",
            "fail",
            f"{name} expired on {expires}: calibrate again, or move its date on",
            3,
        )
    if made and (today - made).days > CALIBRATION_YEARS * 365.25:
        return Finding(
            "profile",
            "warn",
            f"{name} was calibrated on {made}, over {CALIBRATION_YEARS:g} years ago",
        )
    return Finding(
        "profile",
        "ok",
        f"{name}" + (f", calibrated {made}" if made else ", no date of calibration"),
    )


def _date(text: str) -> date | None:
    """Raises InputError for what is no ISO date."""
    try:
        return date.fromisoformat(text) if text else None
    except ValueError:
        raise InputError("camera profile", f"date '{text}'", "like 2027-03-20") from None


def _fit(profile: CameraProfile, slots: Sequence[Slot]) -> list[Finding]:
    """Exposures that the profile holds no calibration for."""
    planned = {exposure for slot in slots for exposure in slot.exposures}
    found = []
    apertures = {e.f_number for e in planned}
    if profile.scale.f_numbers and (other := sorted(apertures - set(profile.scale.f_numbers))):
        said = ", ".join(f"f/{f:g}" for f in other)
        found.append(
            Finding("profile", "fail", f"{profile.camera.name} has no scale for {said}", 3)
        )
    if missing := {e.nd for e in planned if e.nd} - {nd.name for nd in profile.nd}:
        found.append(
            Finding(
                "profile",
                "fail",
                f"{profile.camera.name} does not know filter {sorted(missing)[0]}",
                3,
            )
        )
    return found


# ----------------------------------------------------------------------------------------------
# devices


def check_camera(session: Session, uri: str, now_utc: datetime) -> list[Finding]:
    """The camera opens and says who it is, what time it has, and how many frames fit on its
    card.
    """
    if not uri:
        return [
            Finding(
                "camera", "warn", "none named: give --camera URI, or import its card afterwards"
            )
        ]
    camera = open_camera(uri, clock=RealClock(), session=session)
    try:
        ahead, setup = owed_slots(session, now_utc), session.site_file()
        exposures = list(dict.fromkeys(e for slot in ahead for e in slot.exposures))
        return [
            *judge_camera(camera.info, uri, frames_owed(ahead, setup)),
            *judge_exposures(not_offered(camera, exposures), len(exposures)),
            *judge_model(camera.info, load_camera_profile(setup.camera.profile)),
        ]
    finally:
        camera.close()


def judge_exposures(refused: Sequence[str], planned: int) -> list[Finding]:
    if not refused:
        return []
    shown = "; ".join(refused[:3]) + (f"; {len(refused) - 3} more" if len(refused) > 3 else "")
    text = (
        f"of {planned} planned exposures not all can be set: {shown}: write [bracket] of the "
        f"profile so, and plan anew"
    )
    return [Finding("camera", "fail", text)]


def judge_model(info: CameraInfo, profile: CameraProfile) -> list[Finding]:
    """Frames of another camera than the profile's cannot be merged; its exposures and sizes are
    not this one's.
    """
    wanted = profile.camera.model
    if (
        not info.model
        or not wanted
        or info.kind in ("sim", "replay")
        or same_model(info.model, wanted)
    ):
        return []
    text = (
        f"{info.model} is not the camera of profile {profile.camera.name} ({wanted}), by which "
        f"exposures are planned"
    )
    return [Finding("profile", "warn", text)]


def frames_owed(slots: Sequence[Slot], setup: SiteFile) -> int:
    return sum(len(slot.exposures) for slot in slots) * max(len(setup.camera.headings), 1)


def judge_camera(info: CameraInfo, uri: str, frames: int) -> list[Finding]:
    who = " ".join(part for part in (info.make, info.model, info.serial) if part) or info.kind
    found = [
        Finding(
            "camera",
            "ok",
            f"{who} answers at {uri}" + (f", battery {info.battery}" if info.battery else ""),
        )
    ]
    if info.clock_offset_s is None:
        found.append(
            Finding(
                "camera clock",
                "warn",
                "the camera does not tell its time: photograph this clock once",
            )
        )
    else:
        off = abs(info.clock_offset_s)
        verdict = (
            "fail" if off > CAMERA_CLOCK_FAIL_S else "warn" if off > CAMERA_CLOCK_WARN_S else "ok"
        )
        hours = round(info.clock_offset_s / 3600.0)
        civil = hours and abs(info.clock_offset_s - 3600.0 * hours) < CAMERA_CLOCK_FAIL_S
        hint = ": by whole hours, so a time zone or daylight saving" if civil else ""
        found.append(
            Finding(
                "camera clock", verdict, f"{info.clock_offset_s:+.1f} s against this computer{hint}"
            )
        )
    if info.frames_left is not None:
        enough = info.frames_left >= frames
        text = f"room for {info.frames_left} frames, {frames} still to come"
        found.append(Finding("camera card", "ok" if enough else "warn", text))
    return found


def check_pyranometer(session: Session, uri: str) -> list[Finding]:
    """The instrument opens, answers with a plausible reading, and is within its calibration."""
    if not uri:
        return [
            Finding(
                "pyranometer",
                "warn",
                "none named: give --pyranometer URI, or import a logger's file",
            )
        ]
    instrument = open_pyranometer(uri, clock=RealClock(), session=session)
    try:
        return judge_pyranometer(instrument.info, instrument.read(), session.site_file().site)
    finally:
        instrument.close()


def check_meter(uri: str) -> list[Finding]:
    """The illuminance meter beside the lens, where there is one, answers."""
    if not uri:
        return []
    meter = open_meter(uri, clock=RealClock())
    try:
        who, reading = (
            " ".join(part for part in (meter.info.model, meter.info.serial) if part),
            meter.read(),
        )
    finally:
        meter.close()
    found = [
        Finding("meter", "ok", f"{who or meter.info.kind} answers: {reading.illuminance_lx:.4g} lx")
    ]
    return (
        [*found, Finding("meter", "warn", "its battery is low")] if reading.low_battery else found
    )


def judge_pyranometer(info: InstrumentInfo, sample: IrradianceSample, site: Site) -> list[Finding]:
    who = " ".join(part for part in (info.model or info.kind, info.serial) if part)
    reading = ", ".join(
        f"{name} {value:.0f}"
        for name, value in (
            ("global", sample.ghi_wm2),
            ("diffuse", sample.dhi_wm2),
            ("direct", sample.dni_wm2),
        )
        if value is not None
    )
    found = [Finding("pyranometer", "ok", f"{who} answers: {reading} W/m2")]
    if sample.status or info.status:
        found.append(
            Finding(
                "pyranometer", "warn", f"its status is not clean: {sample.status or info.status}"
            )
        )
    altitude = sun.position([sample.t_utc], site).altitude_deg
    limits = sun.bsrn_limits(altitude, sun.extraterrestrial_wm2([sample.t_utc]))
    for name, value in (
        ("ghi_wm2", sample.ghi_wm2),
        ("dhi_wm2", sample.dhi_wm2),
        ("dni_wm2", sample.dni_wm2),
    ):
        low, high = getattr(limits, name)
        if value is not None and not low <= value <= high[0]:
            possible = f"{low:g} to {high[0]:.0f}"
            text = (
                f"{name[:3]} {value:.0f} W/m2 with the sun at {altitude[0]:.0f} deg is "
                f"impossible ({possible})"
            )
            found.append(Finding("pyranometer", "fail", text))
    if info.gives == ("ghi",):
        text = (
            "gives global only: direct and diffuse will be derived, with an error of about 30 "
            "% of direct"
        )
        found.append(Finding("pyranometer", "warn", text))
    if info.guard == FORM_ALONE:
        text = (
            "its lines have no checksum: under moving clouds up to 2 in 100 damaged ones pass "
            "as another number"
        )
        remedy = (
            "let the sketch print a CRC-16 (profile arduino-crc), or at least a line a "
            "second, three for each row"
        )
        found.append(Finding("pyranometer", "warn", f"{text}; {remedy}"))
    made = _date(info.calibration_date)
    if made and (sample.t_utc.date() - made).days > CALIBRATION_YEARS * 365.25:
        found.append(
            Finding(
                "pyranometer", "warn", f"calibrated on {made}, over {CALIBRATION_YEARS:g} years ago"
            )
        )
    return found


# ----------------------------------------------------------------------------------------------
# this computer


def kernel_clock() -> bool | None:
    """Whether the kernel holds the clock to be synchronised (Linux, adjtimex); None: it does not
    tell.
    """
    if not sys.platform.startswith("linux"):
        return None
    timex = ctypes.create_string_buffer(512)  # struct timex, all zero: modes 0 only reads
    try:
        state = ctypes.CDLL(ctypes.util.find_library("c"), use_errno=True).adjtimex(timex)
    except (OSError, AttributeError):
        return None
    return None if state < 0 else state != 5  # TIME_ERROR: not synchronised


def check_clock(synchronised: bool | None) -> Finding:
    now = f"this computer has {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"
    if synchronised is None:
        return Finding(
            "clock",
            "warn",
            f"{now}, and does not tell whether a time server holds it: compare it with one",
        )
    if not synchronised:
        return Finding(
            "clock",
            "warn",
            f"{now}, held by no time server: switch network time on, or set it by hand today",
        )
    return Finding("clock", "ok", f"{now}, held by a time server")


def check_disk(session: Session, now_utc: datetime, free_bytes: int) -> Finding:
    """Room for the frames of all that is owed, with a margin."""
    ahead = owed_slots(session, now_utc)
    planned = 1e6 * float(session.table().get("plan", {}).get("megabytes_per_slot", 0.0))
    wanted = len(ahead) * max(planned, _largest_bracket_bytes(session)) * DISK_MARGIN
    text = (
        f"{free_bytes / 1e9:.1f} GB free, {wanted / 1e9:.1f} GB wanted for {len(ahead)} slots "
        f"(with a third to spare)"
    )
    return Finding("disk", "ok" if free_bytes >= wanted else "fail", text)


def _largest_bracket_bytes(session: Session) -> int:
    """Of the last brackets taken: what the camera really writes may be far from the profile's
    estimate.
    """
    taken = [
        folder
        for folder in session.captured_folders()
        if session.capture_file(folder.name).is_file()
    ]
    return max(
        (sum(file.stat().st_size for file in folder.glob("[!.]*")) for folder in taken[-5:]),
        default=0,
    )


def check_writing(folder: Path) -> list[Finding]:
    """A file is written, flushed to the disk, renamed and read back."""
    path = folder / f".doctor.{os.getpid()}.tmp"
    payload = os.urandom(1 << 20)
    began = time.perf_counter()
    try:
        with path.open("wb") as file:
            file.write(payload)
            file.flush()
            os.fsync(file.fileno())
        took = time.perf_counter() - began
        renamed = path.replace(path.with_suffix(".renamed"))
        same = renamed.read_bytes() == payload
    except OSError as error:
        return [Finding("writing", "fail", f"{folder}: {error.strerror}")]
    finally:
        path.unlink(missing_ok=True)
        path.with_suffix(".renamed").unlink(missing_ok=True)
    if not same:
        return [Finding("writing", "fail", f"{folder}: what was read is not what was written")]
    verdict: Verdict = "warn" if took > SLOW_FSYNC_S else "ok"
    found = [Finding("writing", verdict, f"1 MB written and flushed in {took * 1000:.0f} ms")]
    if any(name in str(folder.resolve()).lower() for name in SYNCED_FOLDERS):
        text = (
            "the folder is synchronised by a cloud service, which can lock files: move it to a "
            "plain disk"
        )
        found.append(Finding("writing", "warn", text))
    return found


def check_sleep(locks: list[Lock] | None, lid: bool = False, own: str = "") -> Finding:
    """Whether something keeps this computer awake for the whole time: a lock that is held, or
    `own`, `capture`'s.

    A closed lid is another matter: by logind's default it overrides a lock on sleep, and only one
    on handle-lid-switch holds.
    """
    how = {
        "linux": "systemd-inhibit --what=sleep:idle:handle-lid-switch fieldlum capture ...",
        "darwin": "caffeinate -dims fieldlum capture ...",
    }.get(sys.platform, "switch sleep off in the power settings")
    if locks is None and not own:
        return Finding("sleep", "warn", f"cannot tell whether this computer will sleep: {how}")
    held = [lock for lock in locks or () if lock.mode == "block"]
    if own:
        held.append(Lock("capture itself while it runs", frozenset(own.split(":")), "block"))
    by = next((lock.who for lock in held if "sleep" in lock.what), "")
    if not by:
        return Finding("sleep", "warn", f"nothing keeps this computer awake: {how}")
    if lid and not any("handle-lid-switch" in lock.what for lock in held):
        return Finding(
            "sleep",
            "warn",
            f"held off by {by}, but closing the lid would still send it to sleep: {how}",
        )
    return Finding("sleep", "ok", f"held off by {by}")


# ----------------------------------------------------------------------------------------------
# calendar


def check_calendar(session: Session, now_utc: datetime) -> list[Finding]:
    """Clock changes ahead, and how often the sun looks into the lens."""
    ahead, site = owed_slots(session, now_utc), session.site_file().site
    if not ahead:
        return []
    first, last = (sun.standard_date(slot.t_utc, site.timezone) for slot in (ahead[0], ahead[-1]))
    changes = sun.clock_changes(first, last, site.timezone)
    zone = ZoneInfo(site.timezone)
    text = "; ".join(
        f"{'forward' if change > timedelta() else 'back'} {abs(change.total_seconds()) / 3600:g} "
        f"h on "
        f"{moment.astimezone(zone):%Y-%m-%d}"
        for moment, change in changes
    )
    found = [
        Finding(
            "calendar",
            "ok",
            f"clocks go {text}: the plan is in UTC and stays" if text else "no clock changes",
        )
    ]
    in_view = [slot for slot in ahead if "sun-in-view" in slot.tags]
    if in_view:
        filtered = all(any(e.nd for e in slot.exposures) for slot in in_view)
        said = f"the sun looks into the lens in {len(in_view)} slots"
        remedy = (
            "the bracket has a filter for it"
            if filtered
            else "without a filter its energy must come from DNI"
        )
        found.append(Finding("sun", "ok" if filtered else "warn", f"{said}: {remedy}"))
    return found
