"""fieldlum watch."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import session_argument

DEFAULT_PORT = 8765


@click.command("watch")
@session_argument
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=DEFAULT_PORT,
    show_default=True,
    help="Port of the page; 0 takes a free one.",
)
@click.option(
    "--lan",
    is_flag=True,
    help="Let other devices of this network open the page. It is plain HTTP: whoever can listen "
    "to the network can read it.",
)
def command(session_folder: Path, port: int, lan: bool) -> None:
    """Show a session as a page in the browser, live.

    The first line is the address, with a token that is new in each run. The page reads the
    session's files only; a capture that runs does not wait for it.

    \b
    Example:
      fieldlum watch office-2027
      fieldlum watch office-2027 --lan --port 8080
    """
    from fieldlum.session import open_session

    session = open_session(session_folder)
    with terminal.web_library():
        from fieldlum.web.server import prepare, watch_routes
    served = prepare(watch_routes(session), port, lan=lan)
    click.echo(served.address)
    sys.stdout.flush()
    if lan:
        _show_lan(served.address)
    served.run()


def _show_lan(address: str) -> None:
    from fieldlum.web.qr import qr_lines

    terminal.say("note: --lan is plain HTTP without encryption: use it in a network that you trust")
    for line in qr_lines(address):
        terminal.say(line)
