"""`fieldlum watch`: show a session as a live page in the browser."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import Port, command_of

DEFAULT_PORT = 8765  # chosen, because other programs rarely use it; scene click has the next number


@command_of("watch")
def command(session_folder: Path, port: Port = DEFAULT_PORT, lan: bool = False) -> None:
    """Show a session as a live page in the browser.

    The command first prints the page's address, with a token that is new in each run. The page
    only reads files: a running capture does not wait for it.

    \b
    Example:
      fieldlum watch office-2027
      fieldlum watch office-2027 --lan --port 8080

    Options:
      --port: Port of the page; 0 takes a free one.
      --lan: Let other devices of this network open the page. It is plain HTTP: anyone who
          can listen to the network can read it.
    """
    from fieldlum.session import open_session

    session = open_session(session_folder)
    with terminal.web_library():
        from fieldlum.web.server import prepare, watch_routes
    from fieldlum.web.snapshot import Snapshots

    served = prepare(watch_routes(session, Snapshots(session)), port, lan=lan)
    click.echo(served.address)
    sys.stdout.flush()
    if lan:
        _show_lan(served.address)
    with terminal.unattended():
        served.run()


def _show_lan(address: str) -> None:
    from fieldlum.web.server import qr_lines

    terminal.say("note: --lan is plain HTTP without encryption: use it in a network that you trust")

    for line in qr_lines(address):
        # 231 is white and 16 black in every theme: scanners need light modules lighter
        click.echo(click.style(line, fg=231, bg=16), err=True)
