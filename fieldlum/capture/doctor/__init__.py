"""Check, before a campaign, what could ruin a month of captures; each finding is one line."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Container, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Any

from fieldlum.capture.doctor.computer import (
    check_clock,
    check_disk,
    check_sleep,
    check_writing,
    has_lid,
)
from fieldlum.capture.doctor.findings import Finding
from fieldlum.capture.doctor.instruments import check_camera, check_meter, check_pyranometer
from fieldlum.capture.doctor.planned import check_journal, check_plan, check_profile, check_sun
from fieldlum.core.errors import FieldlumError, InputError
from fieldlum.core.records import JsonTable, Progress, quiet
from fieldlum.devices.awake import granted_locks
from fieldlum.devices.clock import synchronised
from fieldlum.session import Session
from fieldlum.session.ledger import slots_ahead

# Checks for a page that is shown while a capture uses the devices and writes the journal.
WITHOUT_DEVICES = ("plan", "profile", "clock", "disk", "sleep", "sun")
EVERY = (*WITHOUT_DEVICES, "journal", "camera", "pyranometer", "meter", "writing")


def run(
    session: Session,
    camera_uri: str,
    pyranometer_uri: str,
    now_utc: datetime,
    progress: Progress = quiet,
    *,
    meter_uri: str = "",
    only: Container[str] = EVERY,
) -> list[Finding]:
    """Run all checks and return their findings; a check that raises an error is a failure.

    progress: called with the number of checks done, their total and the name of the next one. An
    empty URI means that the device is not used. only: names of the checks to run.
    """
    checks: list[tuple[str, Callable[[], list[Finding]]]] = [
        ("plan", lambda: check_plan(session, now_utc)),
        ("journal", lambda: check_journal(session)),
        ("profile", lambda: check_profile(session, now_utc.date())),
        ("camera", lambda: check_camera(session, camera_uri, now_utc)),
        ("pyranometer", lambda: check_pyranometer(session, pyranometer_uri)),
        ("meter", lambda: check_meter(meter_uri)),
        ("clock", lambda: [check_clock(synchronised())]),
        ("disk", lambda: [check_disk(session, now_utc, shutil.disk_usage(session.root).free)]),
        ("writing", lambda: check_writing(session.root)),
        ("sleep", lambda: [check_sleep(granted_locks(), lid=has_lid())]),
        ("sun", lambda: check_sun(session, now_utc)),
    ]
    findings: list[Finding] = []
    checks = [(name, check) for name, check in checks if name in only]
    for number, (name, check) in enumerate(checks):
        progress(number, len(checks), name)
        try:
            findings += check()
        except (FieldlumError, OSError, ValueError, KeyError) as error:
            code = 3 if isinstance(error, InputError) else 4
            findings.append(Finding(name, "fail", str(error), code))
    return findings


def exit_code(findings: Sequence[Finding]) -> int:
    """Return 0 if no check failed, else the exit code of the failure.

    A bad file (3) precedes a device (4), because without files the other checks have no meaning.
    """
    codes = [finding.exit_code for finding in findings if finding.verdict == "fail"]
    return min(codes, default=0)


def as_table(findings: Sequence[Finding]) -> JsonTable:
    """Return the object that `doctor --json` prints about the findings."""
    return {"ok": exit_code(findings) == 0, "findings": [asdict(finding) for finding in findings]}
