"""`fieldlum log`: log irradiance without a camera."""

from contextlib import suppress
from typing import Annotated

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import OpenSession, command_of


@command_of("log")
def command(
    session: OpenSession,
    pyranometer: str,
    every_s: Annotated[float, click.FloatRange(min=0.1)] = 5.0,
) -> None:
    """Log irradiance without a camera, until Ctrl-C.

    \b
    Example:
      fieldlum log office-2027 --pyranometer "serial:/dev/ttyUSB0?kind=spn1"

    Options:
      --pyranometer URI: For example serial:/dev/ttyUSB0?kind=spn1.
      --every S: Seconds between rows.
    """
    from fieldlum.capture.irradiance_log import log
    from fieldlum.devices.clock import Clock

    try:
        with terminal.unattended(), terminal.awake():
            log(session, pyranometer, clock=Clock(), every_s=every_s, rows=None, say=terminal.say)
    except KeyboardInterrupt:
        with suppress(OSError):  # the terminal may be closed by now
            click.echo(f"{session.irradiance}: stopped")
