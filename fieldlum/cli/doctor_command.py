"""`fieldlum doctor`: check devices, clock, disk and plan before a campaign."""

import sys
from contextlib import suppress
from datetime import UTC, datetime

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import OpenSession, command_of, device_uris

# Word and colour of each verdict of a check.
MARKS = {"ok": ("ok  ", "green"), "warn": ("look", "yellow"), "fail": ("FAIL", "red")}


@command_of("doctor")
def command(
    session: OpenSession,
    camera: str | None = None,
    pyranometer: str | None = None,
    meter: str | None = None,
    as_json: bool = False,
) -> None:
    """Check devices, clock, disk and plan before you leave.

    Exit code 0: nothing failed. 4: a device or this computer failed. 3: a file is invalid.

    \b
    Example:
      fieldlum doctor office-2027 --camera gphoto: --pyranometer "serial:/dev/ttyUSB0?kind=spn1"
    """
    from fieldlum.capture import doctor
    from fieldlum.room.scene.drawing import write_room

    camera_uri, pyranometer_uri, meter_uri = device_uris(session, camera, pyranometer, meter)
    now = datetime.now(UTC)
    with terminal.progress("looking"):
        findings = doctor.run(session, camera_uri, pyranometer_uri, now, meter_uri=meter_uri)
    if as_json:
        terminal.emit_json(doctor.as_table(findings))
        sys.exit(doctor.exit_code(findings))
    for finding in findings:
        click.echo(click.style(*MARKS[finding.verdict]), nl=False)
        terminal.tell(f"  {finding.what:13} {finding.text}")
    svg = session.root / "room.svg"
    with suppress(OSError):  # a full or read-only disk is reported by another check
        if write_room(session.site_file(), svg):
            terminal.tell(f"      room          drawn in {svg}: check windows, camera and north")
    sys.exit(doctor.exit_code(findings))
