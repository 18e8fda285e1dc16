"""Check camera, pyranometer and illuminance meter."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from fieldlum.capture.doctor.findings import (
    CALIBRATION_YEARS,
    Finding,
    Verdict,
    iso_date,
)
from fieldlum.core.records import IrradianceSample, Site, SiteFile, Slot
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
from fieldlum.optics.profiles import CameraProfile, load_camera_profile
from fieldlum.optics.raw import same_model
from fieldlum.session import Session
from fieldlum.session.ledger import slots_ahead
from fieldlum.sky import sun

# Limits of the error of the camera's clock: warning and failure. Import matches frames by time with
# a measured offset, and slots are an hour apart: above the second limit a wrong slot is possible.
# Chosen, not measured.
CAMERA_CLOCK_WARN_S = 5.0


CAMERA_CLOCK_FAIL_S = 300.0  # the default grace of a slot; chosen, not measured


def check_camera(session: Session, uri: str, now_utc: datetime) -> list[Finding]:
    """Check that the camera opens, has the planned exposures, and is that of the profile.

    The findings also report its name, its clock and the free space of its card. An empty URI is a
    warning. Raises DeviceError if the camera does not open, InputError for a file of the session or
    the profile.
    """
    if not uri:
        text = "no camera stated: add --camera URI, or import its card afterwards"
        return [Finding("camera", "warn", text)]
    camera = open_camera(uri, clock=RealClock(), session=session)
    try:
        ahead, setup = slots_ahead(session, now_utc), session.site_file()
        exposures = list(dict.fromkeys(e for slot in ahead for e in slot.exposures))
        return [
            *judge_camera(camera.info, uri, frames_planned(ahead, setup)),
            *judge_exposures(not_offered(camera, exposures), len(exposures)),
            *judge_model(camera.info, load_camera_profile(setup.camera.profile)),
        ]
    finally:
        camera.close()


def judge_exposures(refused: Sequence[str], planned: int) -> list[Finding]:
    """Return one failed finding if the camera cannot be set to some planned exposures, else [].

    refused: a sentence on each of these; planned: number of planned exposures.
    """
    if not refused:
        return []
    shown = "; ".join(refused[:3]) + (f"; {len(refused) - 3} more" if len(refused) > 3 else "")
    text = (
        f"the camera cannot set some of the {planned} planned exposures: {shown}; edit [bracket] "
        "in the profile and plan a new session (fieldlum plan SITE.toml --out NEW)"
    )
    return [Finding("camera", "fail", text)]


def judge_model(info: CameraInfo, profile: CameraProfile) -> list[Finding]:
    """Return a warning if the camera's model is not that of the profile, else an empty list.

    Simulated and replayed cameras, and unknown models, give none. Frames of another camera cannot
    be merged, and the planned exposures may be impossible.
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
        f"{info.model} is not the camera of profile {profile.camera.name} ({wanted}), for "
        f"which the exposures were planned: use a profile of the {info.model}, and plan again"
    )
    return [Finding("profile", "warn", text)]


def frames_planned(slots: Sequence[Slot], setup: SiteFile) -> int:
    """Return the number of frames of all these slots, at all headings of a turned head."""
    return sum(len(slot.exposures) for slot in slots) * max(len(setup.camera.headings), 1)


def judge_camera(info: CameraInfo, uri: str, frames: int) -> list[Finding]:
    """Return the findings about a camera's name, clock and card.

    frames: number that is planned. The clock warns over 5 s from the computer's and fails over 300
    s; an unknown time is a warning, and so is a card with less space than planned.
    """
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
        text = f"space for {info.frames_left} frames; {frames} are planned"
        text += "" if enough else ": use a larger card, or empty this one"
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
    hint = (
        ": full hours, so the camera's time zone or daylight saving time is probably wrong; "
        "correct it in the camera's menu"
        if is_time_zone
        else ""
    )
    text = f"{offset_s:+.1f} s compared with this computer's clock{hint}"
    return Finding("camera clock", verdict, text)


def check_pyranometer(session: Session, uri: str) -> list[Finding]:
    """Check that the instrument opens, gives a plausible reading, and is calibrated.

    An empty URI is a warning. Raises DeviceError if it does not open or answer.
    """
    if not uri:
        text = "no pyranometer stated: add --pyranometer URI, or import a logger's file"
        return [Finding("pyranometer", "warn", text)]
    instrument = open_pyranometer(uri, clock=RealClock(), session=session)
    try:
        return judge_pyranometer(instrument.info, instrument.read(), session.site_file().site)
    finally:
        instrument.close()


def check_meter(uri: str) -> list[Finding]:
    """Check that the illuminance meter next to the lens answers; nothing for an empty URI.

    Raises DeviceError if it does not answer.
    """
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
        findings.append(Finding("meter", "warn", "the meter's battery is low: change it"))
    return findings


def judge_pyranometer(info: InstrumentInfo, sample: IrradianceSample, site: Site) -> list[Finding]:
    """Return findings on an instrument: its reading, faults, and age of calibration.

    A reading that is impossible for the sun's altitude fails. A reported fault, an instrument of
    global irradiance only, lines without a checksum, and a calibration over two years ago are
    warnings.
    """
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
        text = f"the instrument reports a fault: {status}: see its manual"
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
            "the instrument measures only global irradiance: direct and diffuse will be "
            "derived from it, with an error of about 30 % in direct irradiance"
        )
        findings.append(Finding("pyranometer", "warn", text))
    if info.guard == FORM_ALONE:
        text = (
            "the instrument's lines have no checksum: under moving clouds up to 2 of 100 damaged "
            "lines are not detected and give wrong values"
        )
        remedy = (
            "let the instrument's program print a CRC-16 (profile arduino-crc), or at least one "
            "line per second, so that each row has three lines"
        )
        findings.append(Finding("pyranometer", "warn", f"{text}; {remedy}"))
    calibrated = iso_date(info.calibration_date, f"profile of the pyranometer {who}")
    if calibrated and (sample.t_utc.date() - calibrated).days > CALIBRATION_YEARS * 365.25:
        text = (
            f"last calibrated on {calibrated}, over {CALIBRATION_YEARS:g} years ago: calibrate "
            "again"
        )
        findings.append(Finding("pyranometer", "warn", text))
    return findings
