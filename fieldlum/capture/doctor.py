"""Check before a campaign what could spoil a month of captures; each finding is one line."""

import shutil
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Literal
from zoneinfo import ZoneInfo

from fieldlum import devices
from fieldlum.capture.steady_clock import synchronised
from fieldlum.core.errors import FieldlumError, InputError
from fieldlum.core.progress import progress
from fieldlum.core.records import IrradianceSample, JsonTable, Site, Slot, listed
from fieldlum.devices.awake import kept_awake
from fieldlum.devices.clock import Clock
from fieldlum.optics import profiles, raw
from fieldlum.session import DEFAULT_GRACE_S, Session, check_writable, journal, sha256
from fieldlum.session.slot_states import captured_ids, slots_ahead, without_capture
from fieldlum.sky import sun

Verdict = Literal["ok", "warn", "fail"]
_CALIBRATION_YEARS = 2.0  # recommended interval of pyranometer makers (Kipp & Zonen, Delta-T)


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check of `doctor`.

    what: subject of the check, such as "camera clock"; verdict: "ok", "warn" (look at it) or
    "fail"; text: a sentence, with the remedy for a fault; exit_code: of the command if the check
    failed: 4 for devices and this computer, 3 for files.
    """

    what: str
    verdict: Verdict
    text: str
    exit_code: int = 4


def ok(what: str, text: str) -> Finding:
    """Return a finding without a fault; what: subject of the check; text: a sentence."""
    return Finding(what, "ok", text)


def warn(what: str, text: str) -> Finding:
    """Return a warning; what: subject of the check; text: a sentence with the remedy."""
    return Finding(what, "warn", text)


def fail(what: str, text: str, exit_code: int = 4) -> Finding:
    """Return a failure; what: subject of the check; text: a sentence with the remedy.

    exit_code: of the command: 4 for devices and this computer, 3 for files.
    """
    return Finding(what, "fail", text, exit_code)


def iso_date(text: str, source: str = "camera profile") -> date | None:
    """Return the date of an ISO text such as 2027-03-20; None for an empty text.

    source: what states the date, for the error. Raises InputError for any other text.
    """
    try:
        return date.fromisoformat(text) if text else None
    except ValueError:
        expected = "a date such as 2027-03-20"
        raise InputError(source, f"date '{text}'", expected, "correct the profile") from None


def age_text(calibrated: date | None, today: date) -> str:
    """Return a sentence on a calibration that is over two years old, else "".

    calibrated: its date; None if unknown, which gives "".
    """
    if calibrated is None or (today - calibrated).days <= _CALIBRATION_YEARS * 365.25:
        return ""
    years = f"over {_CALIBRATION_YEARS:g} years ago"
    return f"last calibrated on {calibrated}, {years}: calibrate again"


# Names of checks for a page that is shown while a capture uses the devices and writes the journal.
WITHOUT_DEVICES = ("plan", "profile", "clock", "disk", "sleep", "sun")


def run(
    session: Session,
    camera_uri: str,
    pyranometer_uri: str,
    now_utc: datetime,
    *,
    meter_uri: str = "",
    only: Container[str] | None = None,
) -> list[Finding]:
    """Run checks and return their findings; a check that raises an error gives a failure.

    camera_uri, pyranometer_uri, meter_uri: addresses such as gphoto: or serial:/dev/ttyUSB0; ""
    means that the device is not used. only: names of the checks to run, None for all, of: plan,
    journal, profile, camera, pyranometer, meter, clock, disk, writing, sleep, sun.
    """
    checks: dict[str, Callable[[], Iterable[Finding]]] = {
        "plan": lambda: check_plan(session, now_utc),
        "journal": lambda: check_journal(session),
        "profile": lambda: check_profile(session, now_utc.date()),
        "camera": lambda: check_camera(session, camera_uri, now_utc),
        "pyranometer": lambda: check_pyranometer(session, pyranometer_uri),
        "meter": lambda: check_meter(meter_uri),
        "clock": lambda: [check_clock(synchronised())],
        "disk": lambda: [check_disk(session, now_utc, shutil.disk_usage(session.root).free)],
        "writing": lambda: check_writing(session.root),
        "sleep": check_awake,
        "sun": lambda: check_sun(session, now_utc),
    }
    findings: list[Finding] = []
    names = [name for name in checks if only is None or name in only]
    for number, name in enumerate(names):
        progress(number, len(names), name)
        try:
            findings += checks[name]()
        except (FieldlumError, OSError, ValueError, KeyError) as error:
            findings.append(fail(name, str(error), 3 if isinstance(error, InputError) else 4))
    return findings


def exit_code(findings: Sequence[Finding]) -> int:
    """Return 0 if no check failed, else 3 if a file is faulty, else 4 for a device.

    Files come first, because without them the other checks have no meaning.
    """
    return min([finding.exit_code for finding in findings if finding.verdict == "fail"], default=0)


def as_table(findings: Sequence[Finding]) -> JsonTable:
    """Return the answer of `doctor --json`.

    ok: whether no check failed; findings: a table for each, with the fields of `Finding`.
    """
    return {"ok": exit_code(findings) == 0, "findings": [asdict(finding) for finding in findings]}


# ----------------------------------------------------------------------------------------------
# the plan and the camera profile


def check_plan(session: Session, now_utc: datetime) -> Iterator[Finding]:
    """Yield findings on plan.csv: a failure if the file was changed since it was planned.

    Also yield how many slots are in the future, or a warning if no slot can still be captured.
    Raises InputError if the plan or session.toml cannot be used.
    """
    slots, ahead = session.slots(), slots_ahead(session, now_utc)
    if session.table().get("plan", {}).get("sha256", "") != sha256(session.plan):
        text = "plan.csv differs from the plan that session.toml records: restore it from a copy, "
        text += "or plan a new session (fieldlum plan SITE.toml --set SET --out NEW)"
        yield fail("plan", text, exit_code=3)
    if ahead:
        next_local = ahead[0].t_utc.astimezone(ZoneInfo(session.site_file().site.timezone))
        when = f"the next on {next_local:%a %Y-%m-%d at %H:%M %Z}"
        yield ok("plan", f"{len(ahead)} of {len(slots)} slots are in the future, {when}")
        return
    missing, count = without_capture(slots, captured_ids(session))
    remedy = f"add make-up slots with fieldlum plan {session.root} --replan"
    lack = f", and {missing} of {count} were not captured: {remedy}"
    result = lack if missing else f": all {count} were captured"
    yield warn("plan", f"no slot of the plan can still be captured{result}")


def check_journal(session: Session) -> Iterator[Finding]:
    """Yield a warning that names the journal's damaged lines; nothing without any.

    Raises OSError if the journal cannot be read.
    """
    if text := journal.damage_text(journal.damaged_lines(session)):
        remedy = "what they recorded is lost: restore the journal from a copy if there is one"
        yield warn("journal", f"{text}; {remedy}")


def check_profile(session: Session, today: date) -> Iterator[Finding]:
    """Yield findings on the camera profile: its age, its calibration and its coverage of the view.

    See `judge_age` and `judge_calibration`. Directions that no lens covers, and headings to which a
    person turns the camera, are warnings. Raises InputError for an unreadable profile.
    """
    setup = session.site_file()
    profile = profiles.load_camera_profile(setup.camera.profile)
    yield from (warn("camera", text) for text in profiles.assumed_texts(setup.camera))
    if "profile" not in setup.camera.assumed:
        yield judge_age(profile, today)
    yield from judge_calibration(profile, session.slots())
    blind = profiles.coverage_text(profile, setup.camera)
    turning = profiles.turning_text(setup.camera)
    yield from (warn(what, t) for what, t in (("coverage", blind), ("headings", turning)) if t)


def judge_age(profile: profiles.CameraProfile, today: date) -> Finding:
    """Return a finding on a profile's age.

    A failure if it has expired, a warning if it was never calibrated or over two years ago. today:
    the present date. Raises InputError for a date in the profile that is not in ISO form.
    """
    name = profile.camera.name
    expires, calibrated = iso_date(profile.expires), iso_date(profile.camera.date)
    if expires and expires < today:
        text = f"{name} expired on {expires}: calibrate again, or change its expiry date"
        return fail("profile", text, exit_code=3)
    if text := age_text(calibrated, today):
        return warn("profile", f"{name}: {text}")
    if uncalibrated := profiles.uncalibrated_text(profile):
        return warn("profile", uncalibrated)
    return ok("profile", f"{name}, calibrated {calibrated}")


def judge_calibration(profile: profiles.CameraProfile, slots: Sequence[Slot]) -> Iterator[Finding]:
    """Yield a failure for planned apertures without a scale, and one for unknown filters.

    The scale is the profile's factor k of each calibrated aperture. slots: whose planned exposures
    are judged. Nothing is yielded if all apertures and filters are known.
    """
    planned = {exposure for slot in slots for exposure in slot.exposures}
    name, scaled = profile.camera.name, set(profile.scale.f_numbers)
    if scaled and (unscaled := sorted({e.f_number for e in planned} - scaled)):
        shown = ", ".join(f"f/{f_number:g}" for f_number in unscaled)
        text = f"{name} has no scale k for {shown}: calibrate this aperture, or plan again"
        yield fail("profile", text, exit_code=3)
    if missing := {e.nd for e in planned if e.nd} - {nd.name for nd in profile.nd}:
        text = f"{name} has no filter {sorted(missing)[0]}: add it to [[nd]], or plan again"
        yield fail("profile", text, exit_code=3)


def check_sun(session: Session, now_utc: datetime) -> Iterator[Finding]:
    """Yield a warning if a future slot has a filter, or the sun in view of the lens.

    The warning states who puts on the planned filter, or how the disc is measured without one.
    Raises InputError if the plan or session.toml cannot be used.
    """
    if text := profiles.sun_text(slots_ahead(session, now_utc)):
        yield warn("sun", text)


# ----------------------------------------------------------------------------------------------
# camera and instruments

# The camera's clock minus this computer's [s]. Beyond the second limit, which is the default grace
# of a slot, import may match frames to a wrong slot. The first is chosen.
CAMERA_CLOCK_WARN_S, CAMERA_CLOCK_FAIL_S = 5.0, DEFAULT_GRACE_S


def check_camera(session: Session, uri: str, now_utc: datetime) -> Iterator[Finding]:
    """Check that the camera opens, has the planned exposures, and is that of the profile.

    uri: address of the camera; "" gives a warning. The findings also report its name, its clock and
    the free space of its card. Raises DeviceError if the camera does not open, InputError for a
    file of the session or the profile that cannot be used.
    """
    if not uri:
        yield warn("camera", "no camera stated: add --camera URI, or import its card afterwards")
        return
    with closing(devices.open_camera(uri, clock=Clock(), session=session)) as camera:
        ahead, setup = slots_ahead(session, now_utc), session.site_file().camera
        exposures = dict.fromkeys(e for slot in ahead for e in slot.exposures)
        frames = sum(len(slot.exposures) for slot in ahead) * max(len(setup.headings), 1)
        yield from judge_camera(camera.info, uri, frames)
        if setup.headings and camera.info.kind != "sim":
            yield fail("headings", "capture cannot turn this camera, so each bracket would abort")
        yield from judge_exposures(devices.not_offered(camera, exposures), len(exposures))
        yield from judge_model(camera.info, profiles.load_camera_profile(setup.profile))


def judge_exposures(refused: Sequence[str], planned: int) -> Iterator[Finding]:
    """Yield a failure if the camera cannot be set to some planned exposures, else nothing.

    refused: a sentence on each of these; planned: number of planned exposures.
    """
    if refused:
        text = f"the camera cannot set some of the {planned} planned exposures: "
        text += f"{listed(refused, 3)}; edit [bracket] in the profile and plan a new session "
        yield fail("camera", f"{text}(fieldlum plan SITE.toml --out NEW)")


def judge_model(info: devices.CameraInfo, profile: profiles.CameraProfile) -> Iterator[Finding]:
    """Yield a warning if the camera's model is not that of the profile, else nothing.

    Frames of another camera cannot be merged, and the planned exposures may be impossible.
    Simulated cameras and unknown models are not compared.
    """
    model, body = info.model, profile.camera
    is_known = model and body.model and info.kind != "sim"
    if is_known and not raw.same_model(model, body.model):
        text = f"{model} is not the camera of profile {body.name} ({body.model}), for which the "
        text += f"exposures were planned: use a profile of the {model}, and plan again"
        yield warn("profile", text)


def judge_camera(info: devices.CameraInfo, uri: str, frames: int) -> Iterator[Finding]:
    """Yield the findings about a camera's name, clock and card.

    uri: of the camera, for the text; frames: number of planned frames. For the clock see
    `_judge_clock`; a card with space for fewer frames is a warning.
    """
    make = "" if info.model.startswith(info.make) else info.make  # "Canon", "Canon EOS 5D"
    who = " ".join(filter(None, (make, info.model, info.serial))) or info.kind
    battery = f", battery {info.battery}" if info.battery else ""
    yield ok("camera", f"{who} answers at {uri}{battery}")
    yield _judge_clock(info.clock_offset_s)
    if info.frames_left is not None:
        text = f"space for {info.frames_left} frames; {frames} are planned"
        too_small = warn("camera card", f"{text}: use a larger card or disk, or empty this one")
        yield too_small if info.frames_left < frames else ok("camera card", text)


def _judge_clock(offset_s: float | None) -> Finding:
    """Return a finding on a camera's clock: a warning over 5 s, a failure over 300 s.

    offset_s: the camera's clock minus this computer's; None if unknown, which is a warning.
    """
    what = "camera clock"
    if offset_s is None:
        text = "the camera does not report its time: photograph this computer's clock once"
        return warn(what, text)
    text = f"{offset_s:+.1f} s compared with this computer's clock"
    if abs(offset_s) <= CAMERA_CLOCK_WARN_S:
        return ok(what, text)
    text += ": correct time, time zone and daylight saving time in the camera's menu"
    return (fail if abs(offset_s) > CAMERA_CLOCK_FAIL_S else warn)(what, text)


def check_pyranometer(session: Session, uri: str) -> Iterator[Finding]:
    """Check that the pyranometer opens, gives a plausible reading, and is calibrated.

    uri: of the pyranometer; "" gives a warning. Raises DeviceError if it does not open or answer,
    InputError for a profile of the instrument or a session.toml that cannot be used.
    """
    if not uri:
        text = "no pyranometer stated: add --pyranometer URI, or import a logger's file"
        yield warn("pyranometer", text)
        return
    with closing(devices.open_pyranometer(uri, clock=Clock(), session=session)) as instrument:
        sample, site = instrument.read(), session.site_file().site
        yield from judge_pyranometer(instrument.info, sample, site)


def check_meter(uri: str) -> Iterator[Finding]:
    """Check that the illuminance meter next to the lens answers.

    uri: of the meter; "" yields nothing. Raises DeviceError if it does not answer.
    """
    if not uri:
        return
    with closing(devices.open_meter(uri, clock=Clock())) as meter:
        info, illuminance_lx = meter.info, meter.read()
    who = f"{info.model} {info.serial}".strip() or info.kind
    yield ok("meter", f"{who} answers: {illuminance_lx:.4g} lx")


def judge_pyranometer(
    info: devices.InstrumentInfo, sample: IrradianceSample, site: Site
) -> Iterator[Finding]:
    """Yield findings on a pyranometer: its reading, its faults, and the age of its calibration.

    A reading [W/m2] that is impossible for the sun's altitude is a failure. A fault that the
    instrument reports, one that measures only global irradiance, lines without a checksum, and a
    calibration over two years ago are warnings. The limits are the physically possible ones of BSRN
    (`sun.bsrn_limits`); site: where the instrument is. Raises InputError for a date of calibration
    that is no ISO date.
    """
    what, who = "pyranometer", f"{info.model or info.kind} {info.serial}".strip()
    parts = {"global": sample.ghi_wm2, "diffuse": sample.dhi_wm2, "direct": sample.dni_wm2}
    measured = {name: value for name, value in parts.items() if value is not None}
    reading = ", ".join(f"{name} {value:.0f}" for name, value in measured.items())
    yield ok(what, f"{who} answers: {reading} W/m2")
    altitude_deg = sun.position([sample.t_utc], site).altitude_deg  # [1]
    limits = sun.bsrn_limits(altitude_deg, sun.extraterrestrial_wm2([sample.t_utc]))
    possible = {"global": limits.ghi_wm2, "diffuse": limits.dhi_wm2, "direct": limits.dni_wm2}
    for name, value in measured.items():
        low_wm2, (high_wm2,) = possible[name]
        if not low_wm2 <= value <= high_wm2:
            found = f"{name} {value:.0f} W/m2 with the sun at {altitude_deg[0]:.0f} deg"
            bounds = f"limits {low_wm2:g} to {high_wm2:.0f} W/m2"
            yield fail(what, f"{found} is impossible ({bounds}): check mounting, wiring and time")
    if status := sample.status or info.status:
        yield warn(what, f"the instrument reports a fault: {status}: see its manual")
    if info.gives == ("ghi",):
        text = "the instrument measures only global irradiance: direct and diffuse will be derived "
        yield warn(what, f"{text}from it, with an error of about 30 % in direct irradiance")
    if not info.is_checked:
        text = "the instrument's lines have no checksum: some damaged lines give wrong values; let "
        text += "the instrument's program print a CRC-16 (profile arduino-crc), or a line a second"
        yield warn(what, text)
    calibrated = iso_date(info.calibration_date, f"profile of the pyranometer {who}")
    if text := age_text(calibrated, sample.t_utc.date()):
        yield warn(what, text)


# ----------------------------------------------------------------------------------------------
# this computer

SYNCED_FOLDERS = ("dropbox", "onedrive", "google drive", "googledrive", "icloud", "nextcloud")


def check_clock(synchronised: bool | None) -> Finding:
    """Return a finding on this computer's clock: a warning unless it is synchronised.

    synchronised: whether a time server controls it; None if unknown, which is a warning too.
    """
    now = f"this computer has {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"
    if synchronised:
        return ok("clock", f"{now}, synchronised by a time server")
    if synchronised is None:
        why = "it is unknown whether it is synchronised: compare it with a time server"
    else:
        why = "its clock is not synchronised: switch network time on, or set the clock by hand"
    return warn("clock", f"{now}, and {why}")


def check_disk(session: Session, now_utc: datetime, free_bytes: int) -> Finding:
    """Return a finding on the disk: a failure without space for all future slots and 30 % more.

    free_bytes: free space. The size of a slot is `Session.slot_bytes`; if it is unknown, that is a
    warning. The 30 % are chosen. Raises InputError if plan or session.toml cannot be used.
    """
    ahead, slot_bytes = len(slots_ahead(session, now_utc)), session.slot_bytes()
    needed = ahead * slot_bytes * 1.3
    need = f"{needed / 1e9:.1f} GB for {ahead} slots, with 30 % in reserve"
    free = f"{free_bytes / 1e9:.1f} GB free"
    if not slot_bytes:
        return warn("disk", f"{free}; the size of {ahead} slots is unknown until one is captured")
    if free_bytes < needed:
        return fail("disk", f"{free}; needed: {need}; delete files or use a larger disk")
    return ok("disk", f"{free}, enough: {need}")


def check_writing(folder: Path) -> Iterator[Finding]:
    """Check that files can be written into the folder; warn if its path names a cloud service.

    Raises OSError or InputError if nothing can be written.
    """
    check_writable(folder)
    yield ok("writing", f"files can be written into {folder}")
    if any(name in str(folder.resolve()).lower() for name in SYNCED_FOLDERS):
        text = "the folder's path has the name of a cloud service, which can lock files that it "
        yield warn("writing", f"{text}synchronises: if it does, move the session to a local folder")


def check_awake() -> Iterator[Finding]:
    """Yield the finding of `check_sleep` on the locks against sleep that this computer grants."""
    with kept_awake() as locks:
        yield check_sleep(locks, lid=any(Path("/proc/acpi/button/lid").glob("*")))


def check_sleep(locks: str, *, lid: bool = False) -> Finding:
    """Return a finding on sleep: a warning if a capture cannot keep this computer awake.

    locks: names of the locks that a capture is granted, joined by colons; lid: whether the computer
    has a lid. By logind's default a closed lid overrides a lock on sleep; only a lock on
    handle-lid-switch prevents this.
    """
    how = "switch sleep off in the settings of this computer"
    if "sleep" not in locks.split(":"):
        return warn("sleep", f"capture is granted no lock that keeps this computer awake: {how}")
    text = "prevented by capture itself while it runs"
    if lid and "handle-lid-switch" not in locks:
        return warn("sleep", f"{text}, but a closed lid would still send it to sleep: {how}")
    return ok("sleep", text)
