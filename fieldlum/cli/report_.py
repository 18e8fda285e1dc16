"""`fieldlum report`: write one self-contained page of a session."""

from __future__ import annotations

from pathlib import Path

import click

from fieldlum.cli.options import command_of
from fieldlum.cli.terminal import progress, say


@command_of("report")
def command(session_folder: Path, out: Path | None = None) -> None:
    """Write a page that shows in which direction to sit, and why.

    Writes index.html, which loads no other file, and report.json.

    \b
    Example:
      fieldlum report office-2027

    Options:
      --out: Folder of the page to write. [default: SESSION/report]
    """
    from fieldlum.report import run
    from fieldlum.session import open_session

    with progress("report") as shown:
        page = run(open_session(session_folder), out, progress=shown)
    say(f"report: {page.stat().st_size / 1e6:.1f} MB")
    click.echo(str(page))
