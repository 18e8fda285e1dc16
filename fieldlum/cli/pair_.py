"""`fieldlum pair`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import (
    force_option,
    scheduler_of,
    scheduler_option,
    session_argument,
)


@click.command("pair")
@session_argument
@scheduler_option
@force_option
def command(session_folder: Path, scheduler_text: str, force: bool) -> None:
    """Match panoramas with irradiance, sun and sun patches.

    \b
    Example:
      fieldlum pair office-2027
    """
    from fieldlum import irradiance, pair
    from fieldlum.irradiance.day_curves import draw_days
    from fieldlum.session import open_session

    scheduler = scheduler_of(scheduler_text)
    session = open_session(session_folder)
    with terminal.progress("irradiance") as progress:
        health = irradiance.run(session, force=force, progress=progress)
    for warning in health.warnings:
        terminal.say(f"note: {warning}")
    if (picture := draw_days(session, force=force)) is not None:
        terminal.say(f"irradiance of each day: {picture}")
    with terminal.progress("pair") as progress:
        pairs = pair.run(session, force=force, scheduler=scheduler, progress=progress)
    usable = sum(p.ok for p in pairs)
    click.echo(
        f"{session.pairs}: {usable} of {len(pairs)} panoramas paired, {health.rows} rows of "
        f"irradiance"
    )
    for why, count in Counter(p.why for p in pairs if p.why).most_common(5):
        terminal.say(f"refused {count}: {why}")
    for caution, count in Counter(
        c for p in pairs if p.ok for c in p.caution.split("; ") if c
    ).most_common(5):
        terminal.say(f"caution {count}: {caution}")
