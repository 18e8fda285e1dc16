"""Checks before a campaign of all that could ruin a month of captures, one verdict a line."""

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
DISK_MARGIN = 1.3  # free space over planned size; chosen, not measured
CALIBRATION_YEARS = 2.0  # recommended interval of pyranometer makers (Kipp & Zonen, Delta-T)
# Difference of the camera's clock. Import matches frames by time with a measured offset, and slots
# are an hour apart: above the second limit a wrong slot is possible. Chosen, not measured.
CAMERA_CLOCK_WARN_S = 5.0
CAMERA_CLOCK_FAIL_S = 300.0
SLOW_FSYNC_S = 0.5  # for 1 MB; a slower disk delays the frames of a bracket. Chosen, not measured.
SYNCED_FOLDERS = ("dropbox", "onedrive", "google drive", "googledrive", "icloud", "nextcloud")
# State of adjtimex for a clock that is not synchronised (TIME_ERROR, <sys/timex.h>).
_TIME_ERROR = 5


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the verdict.

    exit_code is used if the check failed: 4 for devices and this computer, 3 for files.
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
    """Run all checks. A check that raises an error is a failed finding, never an exception."""
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
    findings: list[Finding] = []
    for number, (name, check) in enumerate(checks):
        progress(number, len(checks), name)
        try:
            findings += check()
        except (FieldlumError, OSError, ValueError, KeyError) as error:
            code = 3 if isinstance(error, InputError) else 4
            findings.append(Finding(name, "fail", str(error), code))
    return findings


def exit_code(findings: Sequence[Finding]) -> int:
    """Return 0 if no check failed, or the exit code of the failure.

    A bad file (3) precedes a device (4): without files the other checks mean nothing.
    """
    codes = [finding.exit_code for finding in findings if finding.verdict == "fail"]
    return min(codes, default=0)


def as_table(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the findings for --json."""
    return {"ok": exit_code(findings) == 0, "findings": [asdict(finding) for finding in findings]}


# ----------------------------------------------------------------------------------------------
# plan and profile


def owed_slots(session: Session, now_utc: datetime) -> list[Slot]:
    """Return the slots that can still be captured."""
    settled, grace = outcomes(session), session.grace
    return [
        slot for slot in session.slots() if slot.id not in settled and slot.t_utc + grace >= now_utc
    ]


def check_plan(session: Session, now_utc: datetime) -> list[Finding]:
    """Check that plan.csv is the planned file, and that some of its slots are ahead."""
    about = session.table().get("plan", {})
    slots, ahead = session.slots(), owed_slots(session, now_utc)
    findings = []
    if about.get("sha256", "") != sha256(session.plan):
        text = (
            "plan.csv differs from the plan that session.toml records: restore it, or run "
            "fieldlum plan --replan"
        )
        findings.append(Finding("plan", "fail", text, 3))
    if not ahead:
        text = f"none of its {len(slots)} slots is ahead: plan again"
        return [*findings, Finding("plan", "warn", text)]
    zone = ZoneInfo(session.site_file().site.timezone)
    first = ahead[0].t_utc.astimezone(zone)
    text = f"{len(ahead)} of {len(slots)} slots ahead, the next on {first:%a %Y-%m-%d at %H:%M %Z}"
    return [*findings, Finding("plan", "ok", text)]


def check_profile(session: Session, today: date) -> list[Finding]:
    """Check that the camera profile is readable, up to date, and fits the planned exposures."""
    setup = session.site_file()
    profile = load_camera_profile(setup.camera.profile)
    blind = coverage_text(profile, setup.camera)
    coverage = [Finding("coverage", "warn", blind)] if blind else []
    return [_age(profile, today), *_fit(profile, session.slots()), *coverage]


def _age(profile: CameraProfile, today: date) -> Finding:
    name = profile.camera.name
    expires, calibrated = _date(profile.expires), _date(profile.camera.date)
    if expires and expires < today:
        text = f"{name} expired on {expires}: calibrate again, or change its expiry date"
        return Finding("profile", "fail", text, 3)
    if calibrated and (today - calibrated).days > CALIBRATION_YEARS * 365.25:
        text = f"{name} was calibrated on {calibrated}, over {CALIBRATION_YEARS:g} years ago"
        return Finding("profile", "warn", f"{text}: calibrate again")
    text = f", calibrated {calibrated}" if calibrated else ", no date of calibration"
    return Finding("profile", "ok", f"{name}{text}")


def _date(text: str) -> date | None:
    """Return an ISO date, None for an empty text. Raises InputError for another text."""
    try:
        return date.fromisoformat(text) if text else None
    except ValueError:
        raise InputError(
            "camera profile", f"date '{text}'", "a date such as 2027-03-20", "correct the date"
        ) from None


def _fit(profile: CameraProfile, slots: Sequence[Slot]) -> list[Finding]:
    """Return a finding for each kind of planned exposure without a calibration in the profile."""
    planned = {exposure for slot in slots for exposure in slot.exposures}
    findings = []
    apertures = {e.f_number for e in planned}
    if profile.scale.f_numbers and (other := sorted(apertures - set(profile.scale.f_numbers))):
        shown = ", ".join(f"f/{f:g}" for f in other)
        text = f"{profile.camera.name} has no scale for {shown}: calibrate it, or plan again"
        findings.append(Finding("profile", "fail", text, 3))
    if missing := {e.nd for e in planned if e.nd} - {nd.name for nd in profile.nd}:
        text = f"{profile.camera.name} has no filter {sorted(missing)[0]}: add it, or plan again"
        findings.append(Finding("profile", "fail", text, 3))
    return findings


# ----------------------------------------------------------------------------------------------
# devices


def check_camera(session: Session, uri: str, now_utc: datetime) -> list[Finding]:
    """Check that the camera opens; report its name, its clock and the free frames on its card."""
    if not uri:
        text = "no camera stated: add --camera URI, or import its card afterwards"
        return [Finding("camera", "warn", text)]
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
    """Return a finding if the camera cannot set some planned exposures."""
    if not refused:
        return []
    shown = "; ".join(refused[:3]) + (f"; {len(refused) - 3} more" if len(refused) > 3 else "")
    text = (
        f"the camera cannot set all of the {planned} planned exposures: {shown}; edit "
        f"[bracket] in the profile and run fieldlum plan again"
    )
    return [Finding("camera", "fail", text)]


def judge_model(info: CameraInfo, profile: CameraProfile) -> list[Finding]:
    """Return a warning if the camera is not the profile's.

    Frames of another camera cannot be merged, and the planned exposures may not be possible.
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
        f"{info.model} is not the camera of profile {profile.camera.name} ({wanted}), with which "
        f"the exposures were planned: use its own profile"
    )
    return [Finding("profile", "warn", text)]


def frames_owed(slots: Sequence[Slot], setup: SiteFile) -> int:
    """Return the count of frames of some slots, over all headings."""
    return sum(len(slot.exposures) for slot in slots) * max(len(setup.camera.headings), 1)


def judge_camera(info: CameraInfo, uri: str, frames: int) -> list[Finding]:
    """Return the findings about a camera's name, clock and card."""
    make = "" if info.model.startswith(info.make) else info.make  # "Canon", "Canon EOS 5D"
    who = " ".join(part for part in (make, info.model, info.serial) if part) or info.kind
    battery = f", battery {info.battery}" if info.battery else ""
    findings = [Finding("camera", "ok", f"{who} answers at {uri}{battery}")]
    if info.clock_offset_s is None:
        text = "the camera does not report its time: photograph this computer's clock once"
        findings.append(Finding("camera clock", "warn", text))
    else:
        findings.append(_judge_camera_clock(info.clock_offset_s))
    if info.frames_left is not None:
        enough = info.frames_left >= frames
        text = f"space for {info.frames_left} frames, {frames} are planned"
        findings.append(Finding("camera card", "ok" if enough else "warn", text))
    return findings


def _judge_camera_clock(offset_s: float) -> Finding:
    difference = abs(offset_s)
    verdict: Verdict = "ok"
    if difference > CAMERA_CLOCK_WARN_S:
        verdict = "warn"
    if difference > CAMERA_CLOCK_FAIL_S:
        verdict = "fail"
    hours = round(offset_s / 3600.0)
    is_time_zone = hours and abs(offset_s - 3600.0 * hours) < CAMERA_CLOCK_FAIL_S
    hint = ": full hours, so a time zone or daylight saving is likely" if is_time_zone else ""
    text = f"{offset_s:+.1f} s compared with this computer{hint}"
    return Finding("camera clock", verdict, text)


def check_pyranometer(session: Session, uri: str) -> list[Finding]:
    """Check that the instrument opens, gives a plausible reading, and is calibrated."""
    if not uri:
        text = "no pyranometer stated: add --pyranometer URI, or import a logger's file"
        return [Finding("pyranometer", "warn", text)]
    instrument = open_pyranometer(uri, clock=RealClock(), session=session)
    try:
        return judge_pyranometer(instrument.info, instrument.read(), session.site_file().site)
    finally:
        instrument.close()


def check_meter(uri: str) -> list[Finding]:
    """Check that the illuminance meter next to the lens answers, if one is stated."""
    if not uri:
        return []
    meter = open_meter(uri, clock=RealClock())
    try:
        who = " ".join(part for part in (meter.info.model, meter.info.serial) if part)
        reading = meter.read()
    finally:
        meter.close()
    text = f"{who or meter.info.kind} answers: {reading.illuminance_lx:.4g} lx"
    findings = [Finding("meter", "ok", text)]
    if reading.low_battery:
        findings.append(Finding("meter", "warn", "its battery is low: change it"))
    return findings


def judge_pyranometer(info: InstrumentInfo, sample: IrradianceSample, site: Site) -> list[Finding]:
    """Return the findings about an instrument's reading, status, guard and calibration."""
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
    findings = [Finding("pyranometer", "ok", f"{who} answers: {reading} W/m2")]
    if status := sample.status or info.status:
        text = f"it reports a fault: {status}: see its manual"
        findings.append(Finding("pyranometer", "warn", text))
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
                f"{name[:3]} {value:.0f} W/m2 with the sun at {altitude[0]:.0f} deg is impossible "
                f"(limits {possible} W/m2): check mounting, wiring and time"
            )
            findings.append(Finding("pyranometer", "fail", text))
    if info.gives == ("ghi",):
        text = (
            "it measures global only: direct and diffuse will be derived, with an error of about "
            "30 % of direct"
        )
        findings.append(Finding("pyranometer", "warn", text))
    if info.guard == FORM_ALONE:
        text = (
            "its lines have no checksum: under moving clouds up to 2 in 100 damaged lines are read "
            "as another number"
        )
        remedy = (
            "let the sketch print a CRC-16 (profile arduino-crc), or at least a line a "
            "second, three for each row"
        )
        findings.append(Finding("pyranometer", "warn", f"{text}; {remedy}"))
    calibrated = _date(info.calibration_date)
    if calibrated and (sample.t_utc.date() - calibrated).days > CALIBRATION_YEARS * 365.25:
        text = f"calibrated on {calibrated}, over {CALIBRATION_YEARS:g} years ago: calibrate again"
        findings.append(Finding("pyranometer", "warn", text))
    return findings


# ----------------------------------------------------------------------------------------------
# this computer


def kernel_clock() -> bool | None:
    """Return whether the kernel reports a synchronised clock (Linux, adjtimex), None if unknown."""
    if not sys.platform.startswith("linux"):
        return None
    timex = ctypes.create_string_buffer(512)  # struct timex, all zero: modes 0 only reads
    try:
        state = ctypes.CDLL(ctypes.util.find_library("c"), use_errno=True).adjtimex(timex)
    except (OSError, AttributeError):
        return None
    return None if state < 0 else state != _TIME_ERROR


def check_clock(synchronised: bool | None) -> Finding:
    """Return the finding about this computer's clock."""
    now = f"this computer has {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"
    if synchronised is None:
        text = f"{now}, and does not report whether it is synchronised: compare it with a server"
        return Finding("clock", "warn", text)
    if not synchronised:
        text = f"{now}, not synchronised: switch network time on, or set it by hand today"
        return Finding("clock", "warn", text)
    return Finding("clock", "ok", f"{now}, synchronised by a time server")


def check_disk(session: Session, now_utc: datetime, free_bytes: int) -> Finding:
    """Check the space for the frames of all slots ahead, with a margin."""
    ahead = owed_slots(session, now_utc)
    planned = 1e6 * float(session.table().get("plan", {}).get("megabytes_per_slot", 0.0))
    wanted = len(ahead) * max(planned, _largest_bracket_bytes(session)) * DISK_MARGIN
    text = (
        f"{free_bytes / 1e9:.1f} GB free, {wanted / 1e9:.1f} GB needed for {len(ahead)} slots "
        f"(with {100 * (DISK_MARGIN - 1):.0f} % in reserve)"
    )
    return Finding("disk", "ok" if free_bytes >= wanted else "fail", text)


def _largest_bracket_bytes(session: Session) -> int:
    """Return the size of the largest of the last five brackets.

    The files that the camera writes may differ much from the profile's estimate.
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
    """Check that a file can be written, flushed to the disk, renamed and read back."""
    path = folder / f".doctor.{os.getpid()}.tmp"
    payload = os.urandom(1 << 20)
    start = time.perf_counter()
    try:
        with path.open("wb") as file:
            file.write(payload)
            file.flush()
            os.fsync(file.fileno())
        took = time.perf_counter() - start
        renamed = path.replace(path.with_suffix(".renamed"))
        same = renamed.read_bytes() == payload
    except OSError as error:
        return [Finding("writing", "fail", f"{folder}: {error.strerror}")]
    finally:
        path.unlink(missing_ok=True)
        path.with_suffix(".renamed").unlink(missing_ok=True)
    if not same:
        text = f"{folder}: the bytes read differ from those written: use another disk"
        return [Finding("writing", "fail", text)]
    verdict: Verdict = "warn" if took > SLOW_FSYNC_S else "ok"
    findings = [Finding("writing", verdict, f"1 MB written and flushed in {took * 1000:.0f} ms")]
    if any(name in str(folder.resolve()).lower() for name in SYNCED_FOLDERS):
        text = (
            "the folder is synchronised by a cloud service, which can lock files: move it to a "
            "local disk"
        )
        findings.append(Finding("writing", "warn", text))
    return findings


def check_sleep(locks: list[Lock] | None, lid: bool = False, own: str = "") -> Finding:
    """Check that something keeps this computer awake: a lock, or `own`, the lock of `capture`.

    By logind's default a closed lid overrides a lock on sleep; only a lock on handle-lid-switch
    prevents that.
    """
    how = {
        "linux": "systemd-inhibit --what=sleep:idle:handle-lid-switch fieldlum capture ...",
        "darwin": "caffeinate -dims fieldlum capture ...",
    }.get(sys.platform, "switch sleep off in the power settings")
    if locks is None and not own:
        return Finding("sleep", "warn", f"it is unknown whether this computer will sleep: {how}")
    held = [lock for lock in locks or () if lock.mode == "block"]
    if own:
        held.append(Lock("capture itself while it runs", frozenset(own.split(":")), "block"))
    by = next((lock.who for lock in held if "sleep" in lock.what), "")
    if not by:
        return Finding("sleep", "warn", f"nothing keeps this computer awake: {how}")
    if lid and not any("handle-lid-switch" in lock.what for lock in held):
        text = f"prevented by {by}, but a closed lid would still send it to sleep: {how}"
        return Finding("sleep", "warn", text)
    return Finding("sleep", "ok", f"prevented by {by}")


# ----------------------------------------------------------------------------------------------
# calendar


def check_calendar(session: Session, now_utc: datetime) -> list[Finding]:
    """Report clock changes ahead, and in how many slots the sun is in view of the lens."""
    ahead, site = owed_slots(session, now_utc), session.site_file().site
    if not ahead:
        return []
    first, last = (sun.standard_date(slot.t_utc, site.timezone) for slot in (ahead[0], ahead[-1]))
    changes = sun.clock_changes(first, last, site.timezone)
    zone = ZoneInfo(site.timezone)
    parts = []
    for moment, change in changes:
        way = "forward" if change > timedelta() else "back"
        hours = abs(change.total_seconds()) / 3600
        parts.append(f"{way} {hours:g} h on {moment.astimezone(zone):%Y-%m-%d}")
    text = "no clock changes"
    if parts:
        text = f"clocks go {'; '.join(parts)}: the plan is in UTC and does not change"
    findings = [Finding("calendar", "ok", text)]
    in_view = [slot for slot in ahead if "sun-in-view" in slot.tags]
    if in_view:
        filtered = all(any(e.nd for e in slot.exposures) for slot in in_view)
        text = f"the sun is in view of the lens in {len(in_view)} slots"
        remedy = (
            "the bracket has a filter for it"
            if filtered
            else "without a filter its energy must come from DNI"
        )
        findings.append(Finding("sun", "ok" if filtered else "warn", f"{text}: {remedy}"))
    return findings
