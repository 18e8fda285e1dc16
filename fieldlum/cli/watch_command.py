"""`fieldlum watch`: show a session as a live page in the browser."""

import sys
from contextlib import closing, nullcontext
from pathlib import Path

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import OpenSession, Port, command_of
from fieldlum.core.errors import InputError

DEFAULT_PORT = 8765  # chosen, because other programs rarely use it; scene click has the next number


@command_of("watch")
def command(
    session: OpenSession,
    port: Port = DEFAULT_PORT,
    lan: bool = False,
    weather: str = "synthetic",
    compute: bool = True,
) -> None:
    """Show a session as a live page in the browser.

    The command first prints the page's address, with a token that is new in each run. A running
    capture does not wait for the page: computing for the page stops before each slot.

    \b
    Example:
      fieldlum watch office-2027
      fieldlum watch office-2027 --lan --port 8080

    Options:
      --port: Port of the page; 0 takes a free one.
      --lan: Let other devices of this network open the page. It is plain HTTP: anyone who
          can listen to the network can read it.
      --weather FILE|synthetic: Weather year for the prediction so far, as for predict.
      --compute/--no-compute: Merge new brackets and compute the prediction so far, at
          lowest priority between slots.
    """
    from fieldlum.web.prediction_so_far import Worker
    from fieldlum.web.server import prepare, watch_routes
    from fieldlum.web.snapshot import Snapshots

    if weather != "synthetic" and not Path(weather).is_file():
        expected = "a weather year, or the word synthetic"
        raise InputError(weather, "no such file", expected, "check the path")
    snapshots = Snapshots(session)
    worker = Worker(session, snapshots.moment, weather) if compute else None
    served = prepare(watch_routes(session, snapshots, worker), port, lan=lan)
    click.echo(served.address)
    sys.stdout.flush()
    if lan:
        _show_lan(served.address)
    if worker is not None:
        worker.start()
    with nullcontext() if worker is None else closing(worker), terminal.unattended():
        served.run()


def _show_lan(address: str) -> None:
    """Print a caution about --lan, and the page's address as a QR code for a phone."""
    from fieldlum.web.server import qr_lines

    terminal.say("note: --lan is plain HTTP without encryption: use it in a network that you trust")

    for line in qr_lines(address):
        # 231 is white and 16 black in every theme: scanners need light modules lighter
        click.echo(click.style(line, fg=231, bg=16), err=True)
