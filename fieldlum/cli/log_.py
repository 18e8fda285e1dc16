"""`fieldlum log`: log irradiance without a camera."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import session_argument
from fieldlum.core.records import counted


@click.command("log")
@session_argument
@click.option(
    "--pyranometer",
    "uri",
    metavar="URI",
    required=True,
    help="For example serial:/dev/ttyUSB0?kind=spn1.",
)
@click.option(
    "--every",
    "every_s",
    metavar="S",
    type=click.FloatRange(min=0.1),
    default=5.0,
    show_default=True,
    help="Seconds between rows.",
)
@click.option(
    "--rows", type=click.IntRange(min=1), help="Stop after this many rows. [default: at Ctrl-C]"
)
def command(session_folder: Path, uri: str, every_s: float, rows: int | None) -> None:
    """Log irradiance without a camera, until Ctrl-C or --rows.

    \b
    Example:
      fieldlum log office-2027 --pyranometer "serial:/dev/ttyUSB0?kind=spn1"
    """
    from fieldlum.capture.logger import log
    from fieldlum.devices.clock import RealClock
    from fieldlum.session import open_session

    session = open_session(session_folder)
    try:
        with terminal.unattended(), terminal.awake():
            written = log(
                session, uri, clock=RealClock(), every_s=every_s, rows=rows, say=terminal.say
            )
        message = counted(written, "row")
    except KeyboardInterrupt:
        message = "stopped"
    with suppress(OSError):  # the terminal may be closed by now
        click.echo(f"{session.irradiance}: {message}")
