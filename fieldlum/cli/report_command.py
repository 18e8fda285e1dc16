"""`fieldlum report`: write one self-contained page of a session."""

from pathlib import Path
from typing import Literal

import click

from fieldlum.cli.options import OpenSession, command_of
from fieldlum.cli.terminal import progress, say


@command_of("report")
def command(
    session: OpenSession, out: Path | None = None, for_reader: Literal["user", "assessor"] = "user"
) -> None:
    """Write a page that shows in which direction to sit, and why.

    Writes index.html, which loads no other file. For an assessor it writes assessor.html: EN
    17037, BREEAM, LEED and WELL, with instruments, method and intervals.

    \b
    Example:
      fieldlum report office-2027

    Options:
      --out: Folder of the page to write. [default: SESSION/report]
      --for: The reader of the page.
    """
    from fieldlum.report import run

    with progress("report"):
        page = run(session, out, for_assessor=for_reader == "assessor")
    say(f"report: {page.stat().st_size / 1e6:.2g} MB")
    click.echo(str(page))
