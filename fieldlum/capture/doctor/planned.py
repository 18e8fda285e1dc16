"""Check plan, journal, camera profile, and slots with the sun in view."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date, datetime
from zoneinfo import ZoneInfo

from fieldlum.capture.doctor.findings import CALIBRATION_YEARS, Finding, iso_date
from fieldlum.core.records import Slot
from fieldlum.optics.profiles import (
    CameraProfile,
    assumed_texts,
    coverage_text,
    load_camera_profile,
    sun_text,
    uncalibrated_text,
)
from fieldlum.session import Session, sha256
from fieldlum.session.journal import damage_text, damaged_lines
from fieldlum.session.ledger import read_ledger, slots_ahead
from fieldlum.session.makeups import without_capture


def check_plan(session: Session, now_utc: datetime) -> list[Finding]:
    """Return findings on plan.csv: it fails if changed since it was planned.

    It is a warning if no slot can still be captured.
    """
    about = session.table().get("plan", {})
    slots, ahead = session.slots(), slots_ahead(session, now_utc)
    findings = []
    if about.get("sha256", "") != sha256(session.plan):
        text = (
            "plan.csv differs from the plan that session.toml records: restore it from a copy, or "
            "plan a new session (fieldlum plan SITE.toml --set SET --out NEW)"
        )
        findings.append(Finding("plan", "fail", text, 3))
    if not ahead:
        return [*findings, Finding("plan", "warn", _nothing_ahead(session, slots))]
    zone = ZoneInfo(session.site_file().site.timezone)
    first = ahead[0].t_utc.astimezone(zone)
    text = (
        f"{len(ahead)} of {len(slots)} slots are in the future, the next on "
        f"{first:%a %Y-%m-%d at %H:%M %Z}"
    )
    return [*findings, Finding("plan", "ok", text)]


def check_journal(session: Session) -> list[Finding]:
    """Return a warning that names the journal's damaged lines; none without such a line."""
    text = damage_text(damaged_lines(session))
    remedy = "; what they recorded is lost: restore the journal from a copy if there is one"
    return [Finding("journal", "warn", text + remedy)] if text else []


def _nothing_ahead(session: Session, slots: Sequence[Slot]) -> str:
    """Return the text for a plan without a coming slot: how many were not captured, what to do."""
    states = read_ledger(session).slots
    captured = {slot for slot, state in states.items() if state.outcome == "done"}
    missing, count = without_capture(slots, captured)
    if not missing:
        return f"no slot of the plan can still be captured: all {count} were captured"
    return (
        f"no slot of the plan can still be captured, and {missing} of {count} were not captured: "
        f"add make-up slots with fieldlum plan {session.root} --replan"
    )


def check_profile(session: Session, today: date) -> list[Finding]:
    """Return findings on the camera profile: its age, calibration and coverage of the view.

    See `judge_age` and `judge_calibration`. Directions that no lens covers are a warning. Raises
    InputError for an unreadable profile.
    """
    setup = session.site_file()
    profile = load_camera_profile(setup.camera.profile)
    blind = coverage_text(profile, setup.camera)
    coverage = [Finding("coverage", "warn", blind)] if blind else []
    assumed = [Finding("camera", "warn", text) for text in assumed_texts(setup.camera)]
    return [
        *assumed,
        judge_age(profile, today),
        *judge_calibration(profile, session.slots()),
        *coverage,
    ]


def judge_age(profile: CameraProfile, today: date) -> Finding:
    """Return a finding on a profile: fail if expired, warn if calibrated never or 2 years ago."""
    name = profile.camera.name
    expires, calibrated = iso_date(profile.expires), iso_date(profile.camera.date)
    if expires and expires < today:
        text = f"{name} expired on {expires}: calibrate again, or change its expiry date"
        return Finding("profile", "fail", text, 3)
    if calibrated and (today - calibrated).days > CALIBRATION_YEARS * 365.25:
        text = f"{name} was calibrated on {calibrated}, over {CALIBRATION_YEARS:g} years ago"
        return Finding("profile", "warn", f"{text}: calibrate again")
    if uncalibrated := uncalibrated_text(profile):
        return Finding("profile", "warn", uncalibrated)
    return Finding("profile", "ok", f"{name}, calibrated {calibrated}")


def judge_calibration(profile: CameraProfile, slots: Sequence[Slot]) -> list[Finding]:
    """Return a failed finding for apertures without a scale, and one for unknown filters.

    slots: with the planned exposures; the list is empty if all are in the profile.
    """
    planned = {exposure for slot in slots for exposure in slot.exposures}
    findings = []
    apertures = {e.f_number for e in planned}
    if profile.scale.f_numbers and (other := sorted(apertures - set(profile.scale.f_numbers))):
        shown = ", ".join(f"f/{f:g}" for f in other)
        text = (
            f"{profile.camera.name} has no scale k for {shown}: calibrate this aperture, or plan "
            "again"
        )
        findings.append(Finding("profile", "fail", text, 3))
    if missing := {e.nd for e in planned if e.nd} - {nd.name for nd in profile.nd}:
        text = (
            f"{profile.camera.name} has no filter {sorted(missing)[0]}: add it to [[nd]], or plan "
            "again"
        )
        findings.append(Finding("profile", "fail", text, 3))
    return findings


def check_sun(session: Session, now_utc: datetime) -> list[Finding]:
    """Return a warning if coming slots have the sun in view of the lens, else an empty list.

    It asks who moves a planned filter, or names the way without one.
    """
    text = sun_text(slots_ahead(session, now_utc))
    return [Finding("sun", "warn", text)] if text else []
